// The enumerations that appear in a scene: enumerator <-> text, from the lists in mpm.h.
#include <string.h>

#include "server/mpm/mpm.h"

static int find(const char *const *names, int n, const char *text) {
    for (int k = 0; k < n; k++) {
        if (strcmp(names[k], text) == 0) {
            return k;
        }
    }
    return -1;
}

#define X(code, text) text,
#define NAMES(function, type, LIST)                                                                \
    static const char *const function##_names[] = {LIST(X)};                                       \
    const char *mpm_##function##_name(enum type value) {                                           \
        return function##_names[value];                                                            \
    }                                                                                              \
    int mpm_##function##_parse(const char *text) {                                                 \
        return find(function##_names, (int)(sizeof function##_names / sizeof *function##_names),   \
                    text);                                                                         \
    }

NAMES(basis, mpm_basis, MPM_BASIS_LIST)
NAMES(fbar, mpm_fbar_scheme, MPM_FBAR_LIST)
NAMES(wall_condition, mpm_wall_condition, MPM_WALL_LIST)
NAMES(probe_kind, mpm_probe_kind, MPM_PROBE_LIST)
NAMES(isa, mpm_isa, MPM_ISA_LIST)
NAMES(norm, mpm_norm, MPM_NORM_LIST)
NAMES(solution, mpm_solution_kind, MPM_SOLUTION_LIST)
