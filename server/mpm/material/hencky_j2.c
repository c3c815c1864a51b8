// Hencky elasticity with J2 (von Mises) plasticity and exponential softening, at finite strain.
//
// The elastic left Cauchy-Green tensor b_e is kept. eps = ln(b_e)/2, tau = J sigma = 2 mu dev(eps)
// + K tr(eps) 1; yield f = |dev tau| - sqrt(2/3) sigma_y(a), with the equivalent plastic strain a =
// sum sqrt(2/3) |d eps_p| and sigma_y(a) = residual + (peak - residual) exp(-softening a). With
// logarithmic strains the return map is the radial return of small strains (Simo 1992), and plastic
// flow keeps the volume: J = sqrt(det b_e).
#include "server/mpm/spectral.h"

struct hencky_j2 {
    double two_mu, K;  // Pa
    double per_two_mu; // 1/Pa
    double residual;   // Pa, sqrt(2/3) of the residual strength
    double fall;       // Pa, sqrt(2/3) of the peak's excess over it
    double softening;  // 1
    double rate;       // 1, sqrt(2/3) softening: d soft/dx = -rate soft
    double per_rate;   // 1, its inverse, 0 without softening
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
    const double rate = c->rate;
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
MPM_KERNEL void hencky_j2_return(const struct hencky_j2 *c, mpm_vec norm, mpm_vec compliance,
                                 mpm_mask yields, mpm_vec *a, mpm_vec *soft) {
    if (!(c->softening > 0)) {
        *a = mpm_select(yields, *a + HENCKY_J2_ROOT / c->two_mu * (norm - c->residual - *soft), *a);
        return;
    }
    const mpm_vec r = c->rate * compliance, q = *soft * r;
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

MPM_KERNEL void hencky_j2_stress(const struct hencky_j2 *c, const int n, mpm_vec (*b)[6],
                                 mpm_vec *a, mpm_vec (*sigma)[6], const int dim) {
    mpm_vec dev[MPM_VECTORS][6], trace[MPM_VECTORS], norm2[MPM_VECTORS], soft[MPM_VECTORS];
    mpm_vec back[MPM_VECTORS];
    mpm_mask yields[MPM_VECTORS];
    int flowing[MPM_VECTORS], n_flowing = 0; // the vectors in which something flows
    for (int v = 0; v < n; v++) {
        mpm_vec e[6], sum = mpm_splat(0);
        mpm_half_log(b[v], e, dim);
        trace[v] = e[0] + e[1] + e[2];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            dev[v][k] = k < 3 ? e[k] - trace[v] * (1.0 / 3) : e[k];
            sum += (k < 3 ? 1.0 : 2.0) * dev[v][k] * dev[v][k];
        }
        norm2[v] = sum;
        soft[v] = hencky_j2_soft(c, a[v]);
        const mpm_vec radius = (c->residual + soft[v]) * c->per_two_mu; // as |dev eps|
        flowing[n_flowing] = v;
        n_flowing += mpm_any(sum > radius * radius); // the same as `yields` but for round-off
    }
    for (int k = 0; k < n_flowing; k++) {
        const int v = flowing[k];
        const mpm_vec norm = c->two_mu * mpm_sqrt(norm2[v]), limit = c->residual + soft[v];
        const mpm_vec most = mpm_max(norm, limit), stiffness = c->two_mu - c->rate * soft[v];
        const mpm_vec inverse = 1.0 / (most * stiffness); // of both: a division takes its time
        yields[v] = norm > limit;
        hencky_j2_return(c, norm, inverse * most, yields[v], &a[v], &soft[v]);
        back[v] =
            mpm_select(yields[v], (c->residual + soft[v]) * (inverse * stiffness), mpm_splat(1));
    }
    for (int k = 0; k < n_flowing; k++) {
        const int v = flowing[k];
        mpm_vec flowed[6];
        mpm_exp_twice_less(b[v], dev[v], 1.0 - back[v], trace[v] * (1.0 / 3), flowed, dim);
        for (int i = 0; i < MPM_SYM(dim); i++) {
            dev[v][i] *= back[v];
            b[v][i] = mpm_select(yields[v], flowed[i], b[v][i]);
        }
    }
    for (int v = 0; v < n; v++) {
        const mpm_vec r = mpm_exp(-trace[v]), pressure_part = c->K * trace[v];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            sigma[v][k] =
                r * (k < 3 ? c->two_mu * dev[v][k] + pressure_part : c->two_mu * dev[v][k]);
        }
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
    c->per_two_mu = 1 / c->two_mu;
    c->K = bulk_modulus(par);
    c->residual = sqrt(2.0 / 3) * residual_strength(par);
    c->fall = sqrt(2.0 / 3) * (par[YIELD_STRENGTH] - residual_strength(par));
    c->softening = c->fall > 0 ? par[SOFTENING] : 0;
    c->rate = HENCKY_J2_ROOT * c->softening;
    c->per_rate = c->softening > 0 ? 1 / c->rate : 0;
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
