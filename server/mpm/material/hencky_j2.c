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
    // Strengths as the |dev eps| that they allow, sqrt(2/3) sigma_y/(2 mu).
    double residual;  // 1
    double fall;      // 1, the peak's excess over it
    double softening; // 1
    double rate;      // 1, sqrt(2/3) softening: d soft/dx = -rate soft
};

#define HENCKY_J2_ROOT 0.81649658092772603 // sqrt(2/3)

// What the strength at a exceeds the residual one by, as |dev eps|.
MPM_KERNEL mpm_vec hencky_j2_soft(const struct hencky_j2 *c, mpm_vec a) {
    return c->fall > 0 ? c->fall * mpm_exp(-c->softening * a) : mpm_splat(0);
}

// The radial return from |dev eps| = norm where `going`, a being that before: x = |d eps_p|, by
// Newton's method from a given x in [0, norm]. g(x) = norm - x - residual - soft(a + sqrt(2/3) x)
// is concave and falling, so the iterates come down to the root from above after the first.
MPM_KERNEL mpm_vec hencky_j2_far_return(const struct hencky_j2 *c, mpm_vec norm, mpm_vec x,
                                        mpm_mask going, mpm_vec a) {
    for (int k = 0; k < 50; k++) { // quadratic: 1 to 3 in practice
        const mpm_vec soft = hencky_j2_soft(c, a + HENCKY_J2_ROOT * x);
        const mpm_vec step = (norm - x - c->residual - soft) / (1.0 - c->rate * soft);
        const mpm_vec d = c->rate * step;
        x = mpm_select(going, x + step, x);
        // What a short step leaves of g is its second order, soft d^2/2.
        going &= mpm_not((soft * d * d <= DBL_EPSILON * norm) & (d * d < 0.01));
        if (!mpm_any(going)) {
            break;
        }
    }
    return x;
}

// The same from x0, what would flow if soft fell linearly from a on. A step's strain is mostly so
// small that it needs no exponential: soft(a + sqrt(2/3) x) = soft(a) (1 - d + h) with d = rate x
// and h(d) = exp(-d) - 1 + d, here its series to d^5. With q = rate soft/(1 - rate soft), d0 = rate
// x0 and h, h', h'' at d0, d = d0 - q h(d) = d0 - q h + q^2 h h' - q^3 (h h'^2 + h^2 h''/2) + ...
// (Lagrange): d0 - q h (1 - s + 5/4 s^2) with s = q h', since h h'' is h'^2/2 but for a third of
// d0.
#define HENCKY_J2_REACH 6e-3 // of d0: the next term of h is 1e-16 of d, q d0 being within
#define HENCKY_J2_SLOPE 5e-5 // of q d0: the next term of d is 7/8 (q d0)^4 = 5e-18 of it
MPM_KERNEL mpm_vec hencky_j2_return(const struct hencky_j2 *c, mpm_vec norm2, mpm_vec x0, mpm_vec q,
                                    mpm_vec a) {
    if (!(c->softening > 0)) {
        return x0;
    }
    const mpm_vec d = c->rate * x0, qd = q * d;
    const mpm_vec qh = qd * (0.5 + d * (-1.0 / 6 + d * (1.0 / 24 - d * (1.0 / 120)))); // over d
    const mpm_vec s = qd - qh * d;
    mpm_vec x = x0 - x0 * (qh * (1.0 - s * (1.0 - 1.25 * s)));
    const mpm_mask far = mpm_max(qd, d * (HENCKY_J2_SLOPE / HENCKY_J2_REACH)) > HENCKY_J2_SLOPE;
    if (MPM_UNLIKELY(mpm_any(far))) {
        const mpm_vec start = mpm_min(mpm_max(x, mpm_splat(0)), x0);
        x = mpm_select(far, hencky_j2_far_return(c, mpm_sqrt(norm2), start, far, a), x);
    }
    return x;
}

MPM_KERNEL void hencky_j2_stress(const struct hencky_j2 *c, const int n, mpm_vec (*b)[6],
                                 mpm_vec *a, mpm_vec (*sigma)[6], const int dim) {
    mpm_vec dev[MPM_VECTORS][6], trace[MPM_VECTORS], norm2[MPM_VECTORS], soft[MPM_VECTORS];
    mpm_vec x0[MPM_VECTORS], q[MPM_VECTORS], per_norm[MPM_VECTORS];
    mpm_vec part[MPM_VECTORS];               // of the deviator, that flows away
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
        part[v] = mpm_splat(0);
        const mpm_vec radius = c->residual + soft[v];
        flowing[n_flowing] = v;
        n_flowing += mpm_any(sum > radius * radius);
    }
    for (int k = 0; k < n_flowing; k++) {
        const int v = flowing[k];
        const mpm_vec radius = c->residual + soft[v];
        // Where nothing flows, most = radius: x0 and all that comes of it is 0, b and a keep their
        // bits.
        const mpm_vec most = mpm_max(mpm_sqrt(norm2[v]), radius);
        const mpm_vec slope = c->rate * soft[v], net = 1.0 - slope;
        const mpm_vec inverse = 1.0 / (most * net); // of both: a division takes its time
        const mpm_vec per_net = inverse * most;
        x0[v] = (most - radius) * per_net;
        q[v] = slope * per_net;
        per_norm[v] = inverse * net;
    }
    for (int k = 0; k < n_flowing; k++) {
        const int v = flowing[k];
        const mpm_vec x = hencky_j2_return(c, norm2[v], x0[v], q[v], a[v]);
        a[v] += HENCKY_J2_ROOT * x;
        part[v] = x * per_norm[v];
    }
    for (int k = 0; k < n_flowing; k++) {
        const int v = flowing[k];
        mpm_exp_twice_less(b[v], dev[v], norm2[v], part[v], trace[v] * (1.0 / 3), b[v], dim);
    }
    for (int v = 0; v < n; v++) {
        const mpm_vec r = mpm_exp(-trace[v]), pressure_part = c->K * trace[v];
        const mpm_vec two_mu = c->two_mu - c->two_mu * part[v];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            sigma[v][k] = r * (k < 3 ? two_mu * dev[v][k] + pressure_part : two_mu * dev[v][k]);
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
    c->K = bulk_modulus(par);
    c->residual = HENCKY_J2_ROOT * residual_strength(par) / c->two_mu;
    c->fall = HENCKY_J2_ROOT * (par[YIELD_STRENGTH] - residual_strength(par)) / c->two_mu;
    c->softening = c->fall > 0 ? par[SOFTENING] : 0;
    c->rate = HENCKY_J2_ROOT * c->softening;
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
