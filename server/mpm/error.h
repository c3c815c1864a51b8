// Status codes and the one error record of the solver.
#pragma once
#include <stddef.h>
#include <stdint.h>

// X(code, "name", "what it means"). The first group is about a definition, the second about a step
// that failed.
#define MPM_STATUS_LIST(X)                                                                         \
    X(OK, "ok", "no error")                                                                        \
    X(ERR_MEMORY, "memory", "out of memory, or over the stated memory limit")                      \
    X(ERR_RANGE, "range", "a value outside its bounds")                                            \
    X(ERR_REFERENCE, "reference", "a name that nothing carries")                                   \
    X(ERR_CONFLICT, "conflict", "two settings that exclude each other")                            \
    X(ERR_EMPTY, "empty", "nothing where something is needed")                                     \
    X(ERR_WORK, "work", "more than is checked of one definition")                                  \
    X(ERR_UNSTABLE_DT, "unstable_dt", "a time increment above the stability limit")                \
    X(ERR_NOT_FINITE, "not_finite", "a value that is not finite")                                  \
    X(ERR_VOLUME, "volume", "a volume ratio in use that is not positive")                          \
    X(ERR_LEFT_DOMAIN, "left_domain", "a particle outside the domain")                             \
    X(ERR_STATE, "state", "a saved state that does not fit the definition")

enum mpm_status {
#define X(code, name, text) MPM_##code,
    MPM_STATUS_LIST(X)
#undef X
};

// Filled by the innermost function that knows the cause; callers pass it up untouched.
struct mpm_error {
    enum mpm_status status;
    char pointer[256];  // RFC 6901 place in the scene ("" = the whole scene)
    char expected[160]; // what would have been right, with its unit
    char actual[96];    // what was there
    char message[512];  // one sentence: what is wrong and, where it helps, what to do
    // Of a failed step only (status >= MPM_ERR_UNSTABLE_DT):
    uint64_t step;        // the step that failed, counted from 1
    double time;          // s, at the end of that step
    int64_t particle;     // id, or -1 when it is not about one particle
    const char *quantity; // static text: "position", "volume_ratio", ...
    double value;
    const char *advice; // static text
};

// Fills *err (which may be NULL) and returns `status`, so that a failure is one expression.
enum mpm_status mpm_fail(struct mpm_error *err, enum mpm_status status, const char *pointer,
                         const char *format, ...) __attribute__((format(printf, 4, 5)));
// As mpm_fail, with what was expected and what came.
enum mpm_status mpm_fail_value(struct mpm_error *err, enum mpm_status status, const char *pointer,
                               const char *expected, const char *actual, const char *format, ...)
    __attribute__((format(printf, 6, 7)));

// The name, and what it means; static texts.
const char *mpm_status_name(enum mpm_status status);
const char *mpm_status_meaning(enum mpm_status status);
