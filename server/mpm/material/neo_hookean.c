// Compressible Neo-Hookean solid: psi = mu/2 (tr b - 3) - mu ln J + lambda/2 (ln J)^2,
// sigma = [mu (b - 1) + lambda ln J 1] / J with b = F F^T, and F33 = 1 in plane strain.
#include "server/mpm/tensor.h"

struct neo_hookean {
    double mu, lambda; // Pa
};

MPM_KERNEL void neo_hookean_stress(const struct neo_hookean *c, const mpm_vec *F, mpm_vec *sigma,
                                   const int dim) {
    const mpm_vec J = mpm_det(F, dim), r = 1.0 / J, pressure_part = c->lambda * mpm_log(J);
    for (int k = 0; k < MPM_SYM(dim); k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        mpm_vec b = mpm_splat(i == j); // b33 = 1 in plane strain
        if (i < dim && j < dim) {
            b = F[i * dim] * F[j * dim];
            for (int d = 1; d < dim; d++) {
                b += F[i * dim + d] * F[j * dim + d];
            }
        }
        sigma[k] = r * (i == j ? c->mu * (b - 1.0) + pressure_part : c->mu * b);
    }
}

#ifndef MPM_LAW_ONLY
#include "server/mpm/material_spans.h"

enum { DENSITY, YOUNGS_MODULUS, POISSON_RATIO };

static const struct mpm_parameter parameters[] = {
    [DENSITY] = MPM_DENSITY_PARAMETER,
    [YOUNGS_MODULUS] = MPM_YOUNGS_MODULUS_PARAMETER,
    [POISSON_RATIO] = MPM_POISSON_RATIO_PARAMETER,
    {.key = NULL},
};

static double shear_modulus(const double *par) {
    return par[YOUNGS_MODULUS] / (2 * (1 + par[POISSON_RATIO]));
}

static double lame_lambda(const double *par) {
    const double nu = par[POISSON_RATIO];
    return par[YOUNGS_MODULUS] * nu / ((1 + nu) * (1 - 2 * nu));
}

static double wave_speed(const double *par) {
    return sqrt((lame_lambda(par) + 2 * shear_modulus(par)) / par[DENSITY]);
}

static void prepare(const double *par, void *constants) {
    struct neo_hookean *c = constants;
    c->mu = shear_modulus(par);
    c->lambda = lame_lambda(par);
}
MPM_SPANS_KEEPS_F(neo_hookean)

static double energy(const struct mpm_particles *s, size_t p) {
    const double mu = shear_modulus(s->parameters), lambda = lame_lambda(s->parameters);
    const int n = s->dim * s->dim;
    double trace_b = s->dim == 2; // b33
    for (int k = 0; k < n; k++) {
        const double f = s->F[mpm_at(p, n, k)];
        trace_b += f * f;
    }
    const double log_J = log(mpm_ratio_in_use(s, p));
    return mu / 2 * (trace_b - 3) - mu * log_J + lambda / 2 * log_J * log_J;
}

extern const struct mpm_material mpm_material_neo_hookean;
const struct mpm_material mpm_material_neo_hookean = {
    .name = "neo_hookean",
    .doc = "Compressible Neo-Hookean solid: sigma = [mu (b - 1) + lambda ln J 1] / J.",
    .kinematics = MPM_KEEPS_F,
    .parameters = parameters,
    .wave_speed = wave_speed,
    .prepare = prepare,
    .stress = {stress_2d, stress_3d},
    .energy = energy,
};
#endif
