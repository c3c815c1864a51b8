// The body force of the scene. A manufactured solution's is that of the matter that began at a
// place, so it goes to the grid from the particles, f_i = sum_p w_ip m_p b(X_p, t), as loads do.
#include "server/mpm/body_force.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/solution.h"

bool mpm_body_force_create(struct mpm_body_force *f, const struct mpm_particles *s) {
    const size_t dim = (size_t)s->dim;
    *f = (struct mpm_body_force){.particle = calloc(s->n + 1, sizeof *f->particle),
                                 .force = calloc(s->n * dim + 1, sizeof *f->force),
                                 .x_before = calloc(s->n * dim + 1, sizeof *f->x_before)};
    for (size_t p = 0; f->particle && p < s->n; p++) {
        f->particle[p] = (uint32_t)p;
    }
    return f->particle && f->force && f->x_before;
}

void mpm_body_force_free(struct mpm_body_force *f) {
    free(f->particle);
    free(f->force);
    free(f->x_before);
    *f = (struct mpm_body_force){0};
}

size_t mpm_body_force_bytes(int dim, size_t n) {
    return n * (sizeof(uint32_t) + 2 * (size_t)dim * sizeof(double));
}

void mpm_body_force_apply(struct mpm_body_force *f, const struct mpm_body_force_def *def, double t,
                          struct mpm_particles *s, struct mpm_grid *grid,
                          const struct mpm_kernels *kernels) {
    const struct mpm_medium medium =
        mpm_medium_of(s->material, s->parameters, (double[MPM_MAX_DIM]){0});
    const size_t dim = (size_t)s->dim;
    for (size_t p = 0; p < s->n; p++) {
        const double m = s->density * s->V0[p];
        double b[MPM_MAX_DIM], X[MPM_MAX_DIM] = {0};
        memcpy(b, def->vector, sizeof b);
        if (def->kind == MPM_BODY_FORCE_SOLUTION) {
            for (int d = 0; d < s->dim; d++) {
                X[d] = s->x0[mpm_at(p, s->dim, d)];
            }
            mpm_exact_force(&def->solution, &medium, X, t, s->dim, b);
        }
        for (size_t d = 0; d < dim; d++) {
            f->force[p * dim + d] = m * b[d];
            f->x_before[p * dim + d] = s->x[mpm_at(p, s->dim, (int)d)];
        }
    }
    kernels->force(&(struct mpm_span){.s = s, .grid = grid}, f->particle, f->force, s->n);
}

double mpm_body_force_work(const struct mpm_body_force *f, const struct mpm_particles *s) {
    const size_t dim = (size_t)s->dim;
    double work = 0;
    for (size_t p = 0; p < s->n; p++) {
        for (size_t d = 0; d < dim; d++) {
            work += f->force[p * dim + d] *
                    (s->x[mpm_at(p, s->dim, (int)d)] - f->x_before[p * dim + d]);
        }
    }
    return work;
}
