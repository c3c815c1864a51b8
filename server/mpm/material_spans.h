// The plain loops of a law over particles, one at a time: the baseline of the kernels in lanes.
// MPM_SPANS_KEEPS_F(neo_hookean) makes stress_2d and stress_3d of neo_hookean_stress, for the
// descriptor in the same file, which has a `prepare`.
#pragma once
#include "server/mpm/particles.h"

MPM_KERNEL void mpm_load_components(const double *field, size_t p, int n, mpm_vec *out) {
    for (int k = 0; k < n; k++) {
        out[k] = field[mpm_at(p, n, k)];
    }
}
MPM_KERNEL void mpm_store_components(double *field, size_t p, int n, const mpm_vec *in) {
    for (int k = 0; k < n; k++) {
        field[mpm_at(p, n, k)] = in[k];
    }
}

// clang-format off
#define MPM_SPANS_2D_3D(span)                                                                      \
    static void span##_2d(struct mpm_particles *s, size_t begin, size_t end) {                     \
        span(s, begin, end, 2);                                                                    \
    }                                                                                              \
    static void span##_3d(struct mpm_particles *s, size_t begin, size_t end) {                     \
        span(s, begin, end, 3);                                                                    \
    }

#define MPM_SPANS_KEEPS_F(law)                                                                     \
    MPM_KERNEL void stress(struct mpm_particles *s, size_t begin, size_t end, const int dim) {     \
        double constants[MPM_MAX_CONSTANTS];                                                       \
        prepare(s->parameters, constants);                                                         \
        for (size_t p = begin; p < end; p++) {                                                     \
            double F[9], sigma[6];                                                                 \
            mpm_load_components(s->F, p, dim * dim, F);                                            \
            law##_stress((const void *)constants, F, sigma, dim);                                  \
            mpm_store_components(s->sigma, p, MPM_SYM(dim), sigma);                                \
        }                                                                                          \
    }                                                                                              \
    MPM_SPANS_2D_3D(stress)

#define MPM_SPANS_KEEPS_B(law)                                                                     \
    MPM_KERNEL void stress(struct mpm_particles *s, size_t begin, size_t end, const int dim) {     \
        double constants[MPM_MAX_CONSTANTS], none = 0;                                             \
        prepare(s->parameters, constants);                                                         \
        for (size_t p = begin; p < end; p++) {                                                     \
            double b[1][6], sigma[1][6];                                                           \
            mpm_load_components(s->b, p, MPM_SYM(dim), b[0]);                                      \
            law##_stress((const void *)constants, 1, b,                                            \
                         s->plastic_strain ? &s->plastic_strain[p] : &none, sigma, dim);           \
            mpm_store_components(s->b, p, MPM_SYM(dim), b[0]);                                     \
            mpm_store_components(s->sigma, p, MPM_SYM(dim), sigma[0]);                             \
        }                                                                                          \
    }                                                                                              \
    MPM_SPANS_2D_3D(stress)

// rate_stress_2d and rate_stress_3d of law##_rate, too.
#define MPM_SPANS_KEEPS_J(law)                                                                     \
    MPM_KERNEL void stress(struct mpm_particles *s, size_t begin, size_t end, const int dim) {     \
        double constants[MPM_MAX_CONSTANTS];                                                       \
        prepare(s->parameters, constants);                                                         \
        for (size_t p = begin; p < end; p++) {                                                     \
            double sigma[6];                                                                       \
            mpm_load_components(s->sigma, p, MPM_SYM(dim), sigma);                                 \
            law##_stress((const void *)constants, s->Jbar[p], sigma, dim);                         \
            mpm_store_components(s->sigma, p, MPM_SYM(dim), sigma);                                \
        }                                                                                          \
    }                                                                                              \
    MPM_SPANS_2D_3D(stress)                                                                        \
    MPM_KERNEL void rate_stress(struct mpm_particles *s, size_t begin, size_t end, double (*L)[9], \
                                const int dim) {                                                   \
        double constants[MPM_MAX_CONSTANTS];                                                       \
        prepare(s->parameters, constants);                                                         \
        for (size_t p = begin; p < end; p++) {                                                     \
            double sigma[6];                                                                       \
            law##_rate((const void *)constants, L[p - begin], sigma, dim);                         \
            mpm_store_components(s->sigma, p, MPM_SYM(dim), sigma);                                \
        }                                                                                          \
    }                                                                                              \
    static void rate_stress_2d(struct mpm_particles *s, size_t begin, size_t end,                  \
                               double (*L)[9]) {                                                   \
        rate_stress(s, begin, end, L, 2);                                                          \
    }                                                                                              \
    static void rate_stress_3d(struct mpm_particles *s, size_t begin, size_t end,                  \
                               double (*L)[9]) {                                                   \
        rate_stress(s, begin, end, L, 3);                                                          \
    }
// clang-format on
