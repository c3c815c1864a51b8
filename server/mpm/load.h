// Loads: forces on chosen particles, which they follow.
#pragma once
#include "server/mpm/particles.h"

struct mpm_load {
    struct mpm_load_def def;
    bool active;
    size_t n;
    uint32_t *particle; // (n) ids in the body, ascending
    uint32_t *place;    // (n) where they are in this step
    double *area;       // (n) m^2 that a pressure acts on; of a round one, per metre of radius now
    double *force;      // (n, dim) N, of this step
    double *x_before;   // (n, dim) m, for the work that it does
};

// Chooses the particles of the load. False when memory is short; n is 0 when it chooses none.
bool mpm_load_create(struct mpm_load *load, const struct mpm_load_def *def,
                     const struct mpm_particles *s);
void mpm_load_free(struct mpm_load *load);
// The force on each chosen particle at time `since_start` (s since the first step), and its
// position.
void mpm_load_update(struct mpm_load *load, const struct mpm_particles *s, double since_start);
// J, the work of these forces over the way that the particles have gone since.
double mpm_load_work(const struct mpm_load *load, const struct mpm_particles *s);
