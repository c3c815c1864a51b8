// Compiled once for each instruction set: see lanes.h.
#include "tests/unit/lanes.h"

#define PASTE_(a, b) a##b
#define PASTE(a, b) PASTE_(a, b)

#define X(f)                                                                                       \
    static void vector_##f(const double *x, double *y, size_t n) {                                 \
        for (size_t i = 0; i < n; i += MPM_LANES) {                                                \
            mpm_store(y + i, mpm_##f(mpm_load(x + i)));                                            \
        }                                                                                          \
    }
LANES_FUNCTIONS(X)
#undef X

static void load(const double *from, int first, int last, double other, double *out) {
    mpm_store(out, mpm_load_lanes_or(from, first, last, other));
}

static void store(double *to, const double *in, int first, int last) {
    mpm_store_lanes(to, mpm_load(in), first, last);
}

static void to_int32(int32_t *to, const double *in) {
    mpm_store_int32(to, mpm_load(in));
}

static double sum(const double *in) {
    return mpm_hsum(mpm_load(in));
}
static double min(const double *in) {
    return mpm_hmin(mpm_load(in));
}
static double max(const double *in) {
    return mpm_hmax(mpm_load(in));
}

static unsigned less(const double *a, const double *b, double *out) {
    const mpm_vec x = mpm_load(a), y = mpm_load(b);
    const mpm_mask mask = x < y;
    mpm_store(out, mpm_select(mask, x, y));
    return (unsigned)mpm_any(mask) | (unsigned)mpm_all(mask) << 1 |
           (unsigned)mpm_any(mpm_not(mask)) << 2 | (unsigned)mpm_all(mpm_not(mask)) << 3;
}

MPM_KERNEL void get(const double *from, size_t n, size_t p, int components, mpm_vec *to) {
    for (int k = 0; k < components; k++) {
        to[k] = mpm_load(from + (size_t)k * n + p);
    }
}

MPM_KERNEL void put(double *to, size_t n, size_t p, int components, const mpm_vec *from) {
    for (int k = 0; k < components; k++) {
        mpm_store(to + (size_t)k * n + p, from[k]);
    }
}

MPM_KERNEL void tensors(const double *x, double *y, size_t n, bool log, const int dim) {
    for (size_t p = 0; p < n; p += MPM_LANES) {
        mpm_vec in[6], out[6];
        get(x, n, p, MPM_SYM(dim), in);
        if (log) {
            mpm_half_log(in, out, dim);
        } else {
            mpm_exp_twice(in, out, dim);
        }
        put(y, n, p, MPM_SYM(dim), out);
    }
}

static void half_log(const double *b, double *e, size_t n, int dim) {
    if (dim == 2) {
        tensors(b, e, n, true, 2);
    } else {
        tensors(b, e, n, true, 3);
    }
}

static void exp_twice(const double *e, double *b, size_t n, int dim) {
    if (dim == 2) {
        tensors(e, b, n, false, 2);
    } else {
        tensors(e, b, n, false, 3);
    }
}

// One vector of particles.
#define KEEPS_F(name)                                                                              \
    {                                                                                              \
        mpm_vec F[9];                                                                              \
        get(s->kept, s->n, p, dim *dim, F);                                                        \
        name##_stress(constants, F, sigma, dim);                                                   \
    }
#define KEEPS_J(name)                                                                              \
    {                                                                                              \
        mpm_vec L[9];                                                                              \
        get(s->L, s->n, p, dim *dim, L);                                                           \
        name##_rate(constants, L, sigma, dim);                                                     \
        name##_stress(constants, mpm_load(s->kept + p), sigma, dim);                               \
    }
#define KEEPS_B(name)                                                                              \
    {                                                                                              \
        mpm_vec b[6], a = mpm_load(s->a + p);                                                      \
        get(s->kept, s->n, p, MPM_SYM(dim), b);                                                    \
        name##_stress(constants, 1, &b, &a, &sigma, dim);                                          \
        put(s->kept, s->n, p, MPM_SYM(dim), b);                                                    \
        mpm_store(s->a + p, a);                                                                    \
    }
#define X(name, keeps)                                                                             \
    MPM_KERNEL void run_##name(const void *constants, struct lanes_states *s, const int dim) {     \
        for (size_t p = 0; p < s->n; p += MPM_LANES) {                                             \
            mpm_vec sigma[6];                                                                      \
            keeps(name) put(s->sigma, s->n, p, MPM_SYM(dim), sigma);                               \
        }                                                                                          \
    }
MPM_LAWS(X)
#undef X

static void stress(enum mpm_law law, int dim, const double *parameters, struct lanes_states *s) {
    double constants[MPM_MAX_CONSTANTS];
    mpm_material_at(law)->prepare(parameters, constants);
    switch (law) {
#define X(name, keeps)                                                                             \
    case MPM_LAW_##name:                                                                           \
        if (dim == 2) {                                                                            \
            run_##name(constants, s, 2);                                                           \
        } else {                                                                                   \
            run_##name(constants, s, 3);                                                           \
        }                                                                                          \
        break;
        MPM_LAWS(X)
#undef X
    case MPM_N_LAWS:
        break;
    }
}

const struct lanes PASTE(lanes_, MPM_LANES) = {
#if MPM_LANES == 1
    .name = "plain",
#elif MPM_LANES == 4
    .name = "AVX2",
#else
    .name = "AVX-512",
#endif
    .count = MPM_LANES,
#define X(f) .f = vector_##f,
    LANES_FUNCTIONS(X)
#undef X
        .load = load,
    .store = store,
    .to_int32 = to_int32,
    .sum = sum,
    .min = min,
    .max = max,
    .less = less,
    .half_log = half_log,
    .exp_twice = exp_twice,
    .stress = stress,
};
