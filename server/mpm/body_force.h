// A body force that differs from particle to particle, and with time.
#pragma once
#include "server/mpm/transfer.h"

struct mpm_body_force { // on one body
    uint32_t *particle; // (n) all of them
    double *force;      // (n, dim) N, of this step, in the order of storage
    double *x_before;   // (n, dim) m, for the work that it does
};

// False when memory is short.
bool mpm_body_force_create(struct mpm_body_force *f, const struct mpm_particles *s);
void mpm_body_force_free(struct mpm_body_force *f);
size_t mpm_body_force_bytes(int dim, size_t n);
// The force at time t (s), to the grid.
void mpm_body_force_apply(struct mpm_body_force *f, const struct mpm_body_force_def *def, double t,
                          struct mpm_particles *s, struct mpm_grid *grid,
                          const struct mpm_kernels *kernels);
// J, its work over the way that the particles have gone since.
double mpm_body_force_work(const struct mpm_body_force *f, const struct mpm_particles *s);
