// Nearly incompressible Newtonian fluid: sigma = -p 1 + 2 mu dev(d), p = -K (J - 1), d = sym(L).
// Keeps no deformation but the volume ratio.
#include <float.h>

#include "server/mpm/particles.h"

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

// The mean of dev(d) is 0, so the mean stress is -p whatever the rate part holds.
MPM_KERNEL void stress(struct mpm_particles *s, size_t begin, size_t end, const int dim) {
    const double K = s->parameters[BULK_MODULUS];
    for (size_t p = begin; p < end; p++) {
        const double minus_p = K * (s->Jbar[p] - 1);
        for (int k = 0; k < 3; k++) {
            s->sigma[mpm_at(p, MPM_SYM(dim), k)] += minus_p;
        }
    }
}
MPM_STRESS_2D_3D(stress)

MPM_KERNEL void rate_stress(struct mpm_particles *s, size_t begin, size_t end, double (*L)[9],
                            const int dim) {
    const double mu = s->parameters[VISCOSITY];
    for (size_t p = begin; p < end; p++) {
        const double *l = L[p - begin];
        double trace = 0;
        for (int d = 0; d < dim; d++) {
            trace += l[d * dim + d];
        }
        for (int k = 0; k < MPM_SYM(dim); k++) {
            const int i = mpm_sym_row(k), j = mpm_sym_column(k);
            double twice_d = i < dim && j < dim ? l[i * dim + j] + l[j * dim + i] : 0;
            if (i == j) {
                twice_d -= 2.0 / 3 * trace;
            }
            s->sigma[mpm_at(p, MPM_SYM(dim), k)] = mu * twice_d;
        }
    }
}

static void rate_stress_2d(struct mpm_particles *s, size_t begin, size_t end, double (*L)[9]) {
    rate_stress(s, begin, end, L, 2);
}
static void rate_stress_3d(struct mpm_particles *s, size_t begin, size_t end, double (*L)[9]) {
    rate_stress(s, begin, end, L, 3);
}

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
    .stress = {stress_2d, stress_3d},
    .rate_stress = {rate_stress_2d, rate_stress_3d},
    .energy = energy,
};
