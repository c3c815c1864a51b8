// Hencky elasticity with J2 (von Mises) plasticity and exponential softening, at finite strain.
//
// The elastic left Cauchy-Green tensor b_e is kept. eps = ln(b_e)/2, tau = J sigma = 2 mu dev(eps)
// + K tr(eps) 1; yield f = |dev tau| - sqrt(2/3) sigma_y(a), with the equivalent plastic strain a =
// sum sqrt(2/3) |d eps_p| and sigma_y(a) = residual + (peak - residual) exp(-softening a). With
// logarithmic strains the return map is the radial return of small strains (Simo 1992), and plastic
// flow keeps the volume: J = sqrt(det b_e).
#include "server/mpm/spectral.h"

struct hencky_j2 {
    double two_mu, K; // Pa
    double residual;  // Pa, sqrt(2/3) of the residual strength
    double fall;      // Pa, sqrt(2/3) of the peak's excess over it
    double softening; // 1
    double per_rate;  // 1, the inverse of sqrt(2/3) softening, 0 without softening
};

#define HENCKY_J2_ROOT 0.81649658092772603 // sqrt(2/3)

// sqrt(2/3) (sigma_y(a) - residual)
MPM_KERNEL mpm_vec hencky_j2_soft(const struct hencky_j2 *c, mpm_vec a) {
    return c->fall > 0 ? c->fall * mpm_exp(-c->softening * a) : mpm_splat(0);
}

// The radial return from |dev tau| = norm, where `yields`: the new plastic strain a, and soft at
// it. g(x) = norm - 2 mu x - residual - soft(a + sqrt(2/3) x), with x = |d eps_p|, is concave and
// falling, so Newton's iterates come down to the root from above after the first.
MPM_KERNEL mpm_vec hencky_j2_far_return(const struct hencky_j2 *c, mpm_vec norm, mpm_mask going,
                                        mpm_vec a, mpm_vec *soft) {
    const double rate = HENCKY_J2_ROOT * c->softening; // soft' = -rate soft
    mpm_vec x = mpm_splat(0);
    for (int k = 0; k < 50; k++) { // quadratic: 2 or 3 in practice
        const mpm_vec g = norm - c->two_mu * x - c->residual - *soft;
        const mpm_vec step = g / (c->two_mu - rate * *soft), d = rate * step;
        // What a short step leaves of g is its second order, soft d^2/2.
        const mpm_mask done = (*soft * d * d <= DBL_EPSILON * norm) & (d * d < 0.01);
        x = mpm_select(going, x + step, x);
        *soft = mpm_select(going, *soft * (1.0 - d + 0.5 * d * d), *soft);
        going &= mpm_not(done);
        if (!mpm_any(going)) {
            break;
        }
        *soft = mpm_select(going, hencky_j2_soft(c, a + HENCKY_J2_ROOT * x), *soft);
    }
    return x;
}

// A step's strain is mostly so small that soft needs no exponential: soft(a + sqrt(2/3) x) =
// soft(a) (1 - d + h) with d = rate x and h(d) = exp(-d) - 1 + d, its series to d^7. So d = d0 - q
// h(d) with q = rate soft / (2 mu - rate soft), which two steps of Newton's method from d0 solve:
// d exceeds the solution by a part of q d/2, (q d/2)^3 and (q d)^5 or less of itself.
#define HENCKY_J2_REACH 0.02 // of d: the series' next term is 6e-19
#define HENCKY_J2_SLOPE 1e-3 // of q d
MPM_KERNEL void hencky_j2_return(const struct hencky_j2 *c, mpm_vec norm, mpm_mask yields,
                                 mpm_vec *a, mpm_vec *soft) {
    if (!(c->softening > 0)) {
        *a = mpm_select(yields, *a + HENCKY_J2_ROOT / c->two_mu * (norm - c->residual - *soft), *a);
        return;
    }
    const double rate = HENCKY_J2_ROOT * c->softening; // soft' = -rate soft
    const mpm_vec r = rate / (c->two_mu - rate * *soft), q = *soft * r;
    const mpm_vec above = (norm - c->residual - *soft) * r;
    const mpm_vec d0 = mpm_min(mpm_max(above, mpm_splat(0)), mpm_splat(HENCKY_J2_REACH));
    const mpm_vec d2 = d0 * d0;
    const mpm_vec h0 = d2 * ((0.5 - d0 * (1.0 / 6)) + d2 * ((1.0 / 24 - d0 * (1.0 / 120)) +
                                                            d2 * (1.0 / 720 - d0 * (1.0 / 5040))));
    const mpm_vec slope = d0 - h0, curve = 0.5 - 0.5 * slope; // h' and h''/2, here 1/2 exp(-d)
    const mpm_vec s = q * slope, per_slope = 1.0 - s + s * s; // 1/(1 + s)
    const mpm_vec one = -(q * h0) * per_slope;
    const mpm_vec h1 = h0 + one * (slope + one * (curve - one * curve * (1.0 / 3)));
    const mpm_vec two = -(one + q * h1) * per_slope;
    const mpm_vec d = d0 + (one + two), h = h1 + two * slope;
    mpm_vec x = d * c->per_rate, soft_now = *soft * (1.0 - d + h);
    const mpm_mask far =
        yields & mpm_not((above <= HENCKY_J2_REACH) & (q * above <= HENCKY_J2_SLOPE));
    if (MPM_UNLIKELY(mpm_any(far))) {
        mpm_vec soft_far = *soft;
        x = mpm_select(far, hencky_j2_far_return(c, norm, far, *a, &soft_far), x);
        soft_now = mpm_select(far, soft_far, soft_now);
    }
    *soft = mpm_select(yields, soft_now, *soft);
    *a = mpm_select(yields, *a + HENCKY_J2_ROOT * x, *a);
}

MPM_KERNEL void hencky_j2_stress(const struct hencky_j2 *c, mpm_vec *b, mpm_vec *a, mpm_vec *sigma,
                                 const int dim) {
    mpm_vec e[6], norm2 = mpm_splat(0);
    mpm_half_log(b, e, dim);
    const mpm_vec trace = e[0] + e[1] + e[2], mean = trace * (1.0 / 3);
    for (int k = 0; k < MPM_SYM(dim); k++) {
        e[k] = k < 3 ? e[k] - mean : e[k];
        norm2 += (k < 3 ? 1.0 : 2.0) * e[k] * e[k];
    }
    mpm_vec soft = hencky_j2_soft(c, *a);
    const mpm_vec radius = (c->residual + soft) / c->two_mu; // as |dev eps|
    if (mpm_any(norm2 > radius * radius)) { // the same as `yields` but for round-off
        const mpm_vec norm = c->two_mu * mpm_sqrt(norm2), limit = c->residual + soft;
        const mpm_mask yields = norm > limit;
        const mpm_vec inverse = 1.0 / mpm_max(norm, limit); // ready before the return is
        hencky_j2_return(c, norm, yields, a, &soft);
        const mpm_vec back = mpm_select(yields, (c->residual + soft) * inverse, mpm_splat(1));
        mpm_vec flowed[6];
        mpm_exp_twice_less(b, e, 1.0 - back, mean, flowed, dim);
        for (int k = 0; k < MPM_SYM(dim); k++) {
            e[k] *= back;
            b[k] = mpm_select(yields, flowed[k], b[k]);
        }
    }
    const mpm_vec r = mpm_exp(-trace);
    for (int k = 0; k < MPM_SYM(dim); k++) {
        sigma[k] = r * (k < 3 ? c->two_mu * e[k] + c->K * trace : c->two_mu * e[k]);
    }
}

#ifndef MPM_LAW_ONLY
#include "server/mpm/material_spans.h"

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

static void prepare(const double *par, void *constants) {
    struct hencky_j2 *c = constants;
    c->two_mu = 2 * shear_modulus(par);
    c->K = bulk_modulus(par);
    c->residual = sqrt(2.0 / 3) * residual_strength(par);
    c->fall = sqrt(2.0 / 3) * (par[YIELD_STRENGTH] - residual_strength(par));
    c->softening = c->fall > 0 ? par[SOFTENING] : 0;
    c->per_rate = c->softening > 0 ? 1 / (HENCKY_J2_ROOT * c->softening) : 0;
}
MPM_SPANS_KEEPS_B(hencky_j2)

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
    .prepare = prepare,
    .stress = {stress_2d, stress_3d},
    .energy = energy,
};
#endif
