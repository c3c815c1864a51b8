// Nearly incompressible Newtonian fluid: sigma = -p 1 + 2 mu dev(d), p = -K (J - 1), d = sym(L).
// Keeps no deformation but the volume ratio.
#include "server/mpm/tensor.h"

struct newtonian {
    double K, mu; // Pa, Pa s
};

// The mean of dev(d) is 0, so the mean stress is -p whatever the rate part holds.
MPM_KERNEL void newtonian_stress(const struct newtonian *c, mpm_vec J, mpm_vec *sigma,
                                 const int dim) {
    (void)dim;
    const mpm_vec minus_p = c->K * (J - 1.0);
    for (int k = 0; k < 3; k++) {
        sigma[k] += minus_p;
    }
}

MPM_KERNEL void newtonian_rate(const struct newtonian *c, const mpm_vec *L, mpm_vec *sigma,
                               const int dim) {
    mpm_vec trace = mpm_splat(0);
    for (int d = 0; d < dim; d++) {
        trace += L[d * dim + d];
    }
    for (int k = 0; k < MPM_SYM(dim); k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        mpm_vec twice_d = mpm_splat(0);
        if (i < dim && j < dim) {
            twice_d = L[i * dim + j] + L[j * dim + i];
        }
        sigma[k] = c->mu * (i == j ? twice_d - 2.0 / 3 * trace : twice_d);
    }
}

#ifndef MPM_LAW_ONLY
#include "server/mpm/material_spans.h"

enum { DENSITY, BULK_MODULUS, VISCOSITY };

static const struct mpm_parameter parameters[] = {
    [DENSITY] = MPM_DENSITY_PARAMETER,
    [BULK_MODULUS] = {.key = "bulk_modulus",
                      .unit = "Pa",
                      .doc = "bulk modulus",
                      .min = 0,
                      .min_open = true,
                      .max = DBL_MAX,
                      .required = true},
    [VISCOSITY] = {.key = "viscosity",
                   .unit = "Pa s",
                   .doc = "dynamic viscosity",
                   .min = 0,
                   .max = DBL_MAX,
                   .fallback = 0},
    {.key = NULL},
};

static double wave_speed(const double *par) {
    return sqrt(par[BULK_MODULUS] / par[DENSITY]);
}

static double diffusivity(const double *par) {
    return par[VISCOSITY] / par[DENSITY];
}

static void prepare(const double *par, void *constants) {
    struct newtonian *c = constants;
    c->K = par[BULK_MODULUS];
    c->mu = par[VISCOSITY];
}
MPM_SPANS_KEEPS_J(newtonian)

static double energy(const struct mpm_particles *s, size_t p) {
    const double e = s->Jbar[p] - 1;
    return s->parameters[BULK_MODULUS] / 2 * e * e;
}

extern const struct mpm_material mpm_material_newtonian;
const struct mpm_material mpm_material_newtonian = {
    .name = "newtonian",
    .doc = "Nearly incompressible Newtonian fluid: sigma = K (J - 1) 1 + 2 mu dev(d).",
    .kinematics = MPM_KEEPS_J,
    .parameters = parameters,
    .wave_speed = wave_speed,
    .diffusivity = diffusivity,
    .prepare = prepare,
    .stress = {stress_2d, stress_3d},
    .rate_stress = {rate_stress_2d, rate_stress_3d},
    .energy = energy,
};
#endif
