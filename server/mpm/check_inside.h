// What the files that check a definition share: where faults go.
#pragma once
#include <stdarg.h>
#include <stdio.h>

#include "server/mpm/seed.h"

// Looks at one lattice point of one shape, and what takes as long (1 ns or less), that the check of
// a definition may take: with it seconds, whatever is posted.
#define MPM_MAX_LOOKS 2e10

struct report {
    void (*call)(void *context, const struct mpm_error *fault);
    void *context;
    size_t count;
    double looks;   // so far
    bool exhausted; // MPM_MAX_LOOKS; said already
};

static inline void add(struct report *r, const struct mpm_error *fault) {
    r->count++;
    if (r->call) {
        r->call(r->context, fault);
    }
}

#define FAULT(r, status, pointer, expected, actual, ...)                                           \
    do {                                                                                           \
        struct mpm_error fault_;                                                                   \
        mpm_fail_value(&fault_, status, pointer, expected, actual, __VA_ARGS__);                   \
        add(r, &fault_);                                                                           \
    } while (0)

// Text that lives until the end of the statement it stands in.
#define TEXT(...) text((char[256]){0}, __VA_ARGS__)
static const char *text(char *out, const char *format, ...)
    __attribute__((format(printf, 2, 3), unused));
static const char *text(char *out, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(out, 256, format, arguments);
    va_end(arguments);
    return out;
}

static inline bool is_finite(double x) {
    return x - x == 0;
}

// Whether there is work left for so many looks; says once that there is not.
bool mpm_check_affords(struct report *r, double looks);
// Whether a particle of the body passes the sieve (which may be NULL) and is taken (by NULL: any).
// True as well when the work is exhausted, so that nothing else is said of it.
bool mpm_check_finds(struct report *r, const struct mpm_def *def, const struct mpm_body_def *body,
                     const struct mpm_sieve *sieve, double looks_each,
                     bool (*takes)(void *context, const double *x), void *context);
// check_probe.c. A solution's own numbers, of which `pointer` is the place.
void mpm_check_solution(struct report *r, const struct mpm_solution *q, const char *pointer);
void mpm_check_probe(struct report *r, const struct mpm_def *def, const struct mpm_probe_def *q);
// That the probe finds a particle to read where it chooses; of bodies that can be seeded.
void mpm_check_probe_particles(struct report *r, const struct mpm_def *def,
                               const struct mpm_probe_def *q);
void mpm_check_body_force(struct report *r, const struct mpm_def *def);
