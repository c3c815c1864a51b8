// The stability limit: factors that were measured (`make report`, dt-ladder.csv), and how two
// limits add up.
#include "server/mpm/stability.h"

#include <math.h>

// uGIMP comes the nearer to the linear basis, which no increment makes stable, the smaller its
// particles are (n in each direction of a cell): the wave factor at which it still held without
// F-bar is, for n = 2, 3, 4, 6, in 2D 0.5, 0.5, 0.45, 0.4, in 3D 0.44, 0.4, 0.38; the viscous one
// 0.125, 0.125, 0.1, 0.05. With F-bar it holds at 0.5 and more. With 7 and 10 in each
// direction (2D) it holds at 0.375 and 0.3, the default CFL number, below which it is never taken,
// and at 0.065 and 0.04 (with F-bar, less than without); with 5 in 3D at 0.42.
static struct mpm_stability gimp(int dim, int n) {
    return (struct mpm_stability){
        .wave = fmax(0.3, dim == 2 ? fmin(0.5, 0.55 - 0.025 * n) : 0.475 - 0.03 * n),
        .viscous = fmax(0.03, fmin(0.12, fmax(0.155 - 0.017 * n, 0.073 - 0.0033 * n)))};
}

// B-splines bear more, but for a single particle a cell: quadratic ones held at 0.675 (2D) and 0.6
// (3D), with one particle at 0.5; cubic ones at 0.83 and 0.75, with one particle at 0.7.
static struct mpm_stability factors(enum mpm_basis basis, int dim, int n) {
    switch (basis) {
    case MPM_LINEAR: // blows up at any increment once a particle barely reaches a node
        return (struct mpm_stability){.wave = 0.5, .viscous = 0.12};
    case MPM_BSPLINE2:
        return n == 1 ? (struct mpm_stability){.wave = dim == 2 ? 0.5 : 0.45, .viscous = 0.14}
                      : (struct mpm_stability){.wave = dim == 2 ? 0.6 : 0.55, .viscous = 0.17};
    case MPM_BSPLINE3:
        return n == 1 ? (struct mpm_stability){.wave = 0.65, .viscous = 0.2}
                      : (struct mpm_stability){.wave = dim == 2 ? 0.75 : 0.7, .viscous = 0.27};
    case MPM_GIMP:
    case MPM_N_BASES:
        break;
    }
    return gimp(dim, n);
}

struct mpm_stability mpm_stability_of(const struct mpm_def *def) {
    struct mpm_stability least = {1, 1};
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_stability s =
            factors(def->basis, def->dimension, def->bodies[b].particles_per_direction);
        least.wave = fmin(least.wave, s.wave);
        least.viscous = fmin(least.viscous, s.viscous);
    }
    return least;
}

double mpm_stability_limit(struct mpm_stability s, double cell, double speed, double diffusivity,
                           double alpha) {
    const double wave = speed / (s.wave * cell);
    const double damped = diffusivity / (s.viscous * cell * cell) + alpha / 2;
    return 2 / (damped + sqrt(damped * damped + 4 * wave * wave));
}
