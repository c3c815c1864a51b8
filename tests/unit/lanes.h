// simd.h and laws.h as they are compiled for each instruction set, behind plain functions on
// arrays. Component k of particle p of n is at [k * n + p]; every n is a multiple of 8.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/mpm/laws.h"

// y = f(x) elementwise.
#define LANES_FUNCTIONS(X) X(log) X(exp) X(cbrt) X(sqrt) X(abs) X(trunc) X(floor)

// What one law is given and gives.
struct lanes_states {
    size_t n;
    double *kept; // F, b or J
    double *a;    // equivalent plastic strain
    double *L;    // velocity gradient, where J is kept
    double *sigma;
};

struct lanes {
    const char *name;
    int count;
#define X(f) void (*f)(const double *x, double *y, size_t n);
    LANES_FUNCTIONS(X)
#undef X
    // On one vector.
    void (*load)(const double *from, int first, int last, double other, double *out);
    void (*store)(double *to, const double *in, int first, int last);
    void (*to_int32)(int32_t *to, const double *in);
    double (*sum)(const double *in), (*min)(const double *in), (*max)(const double *in);
    // a where a < b, else b; returns bits 0 and 1: any and all of a < b; 2 and 3: of not (a < b).
    unsigned (*less)(const double *a, const double *b, double *out);
    void (*half_log)(const double *b, double *e, size_t n, int dim);
    void (*exp_twice)(const double *e, double *b, size_t n, int dim);
    void (*stress)(enum mpm_law law, int dim, const double *parameters, struct lanes_states *s);
};

extern const struct lanes lanes_1, lanes_4, lanes_8;

// Those that this processor can run, the plain ones first; ends with NULL.
static inline const struct lanes *const *lanes_here(void) {
    static const struct lanes *list[4] = {&lanes_1};
#ifdef __x86_64__
    int n = 1;
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
        list[n++] = &lanes_4;
    }
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw")) {
        list[n++] = &lanes_8;
    }
#endif
    return list;
}
#define FOR_LANES(l) for (const struct lanes *const *l##_ = lanes_here(), *l; (l = *l##_); l##_++)
