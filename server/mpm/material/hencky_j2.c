// Hencky elasticity with J2 (von Mises) plasticity and exponential softening, at finite strain.
//
// The elastic left Cauchy-Green tensor b_e is kept. eps = ln(b_e)/2, tau = J sigma = 2 mu dev(eps)
// + K tr(eps) 1; yield f = |dev tau| - sqrt(2/3) sigma_y(a), with the equivalent plastic strain a =
// sum sqrt(2/3) |d eps_p| and sigma_y(a) = residual + (peak - residual) exp(-softening a). With
// logarithmic strains the return map is the radial return of small strains (Simo 1992), and plastic
// flow keeps the volume: J = sqrt(det b_e).
#ifndef MPM_LAW_ONLY
#include "server/mpm/material_spans.h"
#include "server/mpm/spectral.h"

enum { DENSITY, YOUNGS_MODULUS, POISSON_RATIO, YIELD_STRENGTH, RESIDUAL_STRENGTH, SOFTENING };

static const struct mpm_parameter parameters[] = {
    [DENSITY] = MPM_DENSITY_PARAMETER,
    [YOUNGS_MODULUS] = MPM_YOUNGS_MODULUS_PARAMETER,
    [POISSON_RATIO] = MPM_POISSON_RATIO_PARAMETER,
    [YIELD_STRENGTH] = {.key = "yield_strength",
                        .unit = "Pa",
                        .doc = "uniaxial yield strength at no plastic strain",
                        .min = 0,
                        .min_open = true,
                        .max = DBL_MAX,
                        .required = true},
    [RESIDUAL_STRENGTH] = {.key = "residual_strength",
                           .unit = "Pa",
                           .doc = "uniaxial yield strength at large plastic strain; 0 = as "
                                  "yield_strength, perfect plasticity",
                           .min = 0,
                           .max = DBL_MAX,
                           .fallback = 0},
    [SOFTENING] = {.key = "softening",
                   .unit = "1",
                   .doc = "rate at which the strength falls with the equivalent plastic strain",
                   .min = 0,
                   .max = DBL_MAX,
                   .fallback = 0},
    {.key = NULL},
};

static double shear_modulus(const double *par) {
    return par[YOUNGS_MODULUS] / (2 * (1 + par[POISSON_RATIO]));
}

static double bulk_modulus(const double *par) {
    return par[YOUNGS_MODULUS] / (3 * (1 - 2 * par[POISSON_RATIO]));
}

static double residual_strength(const double *par) {
    return par[RESIDUAL_STRENGTH] > 0 ? par[RESIDUAL_STRENGTH] : par[YIELD_STRENGTH];
}

static double wave_speed(const double *par) {
    return sqrt((bulk_modulus(par) + 4.0 / 3 * shear_modulus(par)) / par[DENSITY]);
}

static int conflict(const double *par, const char **why) {
    if (residual_strength(par) > par[YIELD_STRENGTH]) {
        *why = "must not exceed yield_strength";
        return RESIDUAL_STRENGTH;
    }
    // The return map has one solution while the strength falls slower than the elastic stress.
    if (par[SOFTENING] * (par[YIELD_STRENGTH] - residual_strength(par)) >= 3 * shear_modulus(par)) {
        *why = "must be below 3 mu / (yield_strength - residual_strength), or the strength falls "
               "faster than elastic unloading can follow";
        return SOFTENING;
    }
    return -1;
}

// Plastic multiplier |d eps_p| of the radial return from |dev tau| = norm, and the new yield
// radius. g(x) = norm - 2 mu x - sqrt(2/3) sigma_y(a + sqrt(2/3) x) is concave and falling, so
// Newton's iterates come down to the root from above after the first.
static double plastic_multiplier(const double *par, double norm, double a, double *radius) {
    const double root = sqrt(2.0 / 3), two_mu = 2 * shear_modulus(par);
    const double residual = residual_strength(par), fall = par[YIELD_STRENGTH] - residual;
    double x = 0;
    for (int k = 0; k < 50; k++) { // quadratic: 2 where nothing softens, else 3 or 4 in practice
        const double soft = fall * exp(-par[SOFTENING] * (a + root * x));
        *radius = root * (residual + soft);
        const double step =
            (norm - two_mu * x - *radius) / (two_mu - 2.0 / 3 * par[SOFTENING] * soft);
        x += step;
        if (fabs(step) <= 4 * DBL_EPSILON * norm / two_mu) { // round-off of the residual
            break;
        }
    }
    return x;
}

MPM_KERNEL void stress(struct mpm_particles *s, size_t begin, size_t end, const int dim) {
    const double *par = s->parameters;
    const double two_mu = 2 * shear_modulus(par), K = bulk_modulus(par), root = sqrt(2.0 / 3);
    const double residual = residual_strength(par), fall = par[YIELD_STRENGTH] - residual;
    for (size_t p = begin; p < end; p++) {
        double b[6], e[6], norm2 = 0;
        for (int k = 0; k < MPM_SYM(dim); k++) {
            b[k] = s->b[mpm_at(p, MPM_SYM(dim), k)];
        }
        mpm_half_log(b, e, dim);
        const double trace = e[0] + e[1] + e[2];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            e[k] -= k < 3 ? trace / 3 : 0;
            norm2 += (k < 3 ? 1 : 2) * e[k] * e[k];
        }
        const double norm = two_mu * sqrt(norm2), a = s->plastic_strain[p];
        double radius = root * (residual + (fall > 0 ? fall * exp(-par[SOFTENING] * a) : 0));
        if (norm > radius) {
            s->plastic_strain[p] = a + root * plastic_multiplier(par, norm, a, &radius);
            const double back = radius / norm;
            double elastic[6];
            for (int k = 0; k < MPM_SYM(dim); k++) {
                e[k] *= back;
                elastic[k] = e[k] + (k < 3 ? trace / 3 : 0);
            }
            mpm_exp_twice(elastic, b, dim);
            for (int k = 0; k < MPM_SYM(dim); k++) {
                s->b[mpm_at(p, MPM_SYM(dim), k)] = b[k];
            }
        }
        const double r = exp(-trace);
        for (int k = 0; k < MPM_SYM(dim); k++) {
            s->sigma[mpm_at(p, MPM_SYM(dim), k)] = r * (two_mu * e[k] + (k < 3 ? K * trace : 0));
        }
    }
}
MPM_SPANS_2D_3D(stress)

// mu |dev eps|^2 + K/2 (tr eps)^2, with eps from the stress.
static double energy(const struct mpm_particles *s, size_t p) {
    const double J = mpm_ratio_in_use(s, p), log_J = log(J), mean = mpm_mean_stress(s, p);
    double norm2 = 0;
    for (int k = 0; k < MPM_SYM(s->dim); k++) {
        const double t = J * (s->sigma[mpm_at(p, MPM_SYM(s->dim), k)] - (k < 3 ? mean : 0));
        norm2 += (k < 3 ? 1 : 2) * t * t;
    }
    return norm2 / (4 * shear_modulus(s->parameters)) +
           bulk_modulus(s->parameters) / 2 * log_J * log_J;
}

extern const struct mpm_material mpm_material_hencky_j2;
const struct mpm_material mpm_material_hencky_j2 = {
    .name = "hencky_j2",
    .doc =
        "Hencky elasticity with J2 plasticity, perfect or with exponential softening: |dev tau| <= "
        "sqrt(2/3) sigma_y.",
    .kinematics = MPM_KEEPS_B,
    .parameters = parameters,
    .plastic = true,
    .conflict = conflict,
    .wave_speed = wave_speed,
    .stress = {stress_2d, stress_3d},
    .energy = energy,
};
#endif
