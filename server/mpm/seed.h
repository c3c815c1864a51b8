// Filling shapes with particles on a lattice in the cells.
#pragma once
#include "server/mpm/shape.h"

struct mpm_particles;

// An upper bound on the particles of a body, quickly, from the shape's bounding box.
double mpm_seed_bound(const struct mpm_def *def, const struct mpm_body_def *body);
// Number of particles of a body; where `each` is not NULL, calls it with position (m) and volume
// (m^3, per metre of thickness in 2D) of each, in lattice order (last direction fastest), until it
// returns false.
size_t mpm_seed(const struct mpm_def *def, const struct mpm_body_def *body,
                bool (*each)(void *context, const double *x, double volume), void *context);
// Which of them: those in a box, and those strictly inside a shape (off its edge by more than
// `margin`, m), or, with `inside` false, the others.
struct mpm_sieve {
    bool has_box;
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM]; // m, both taken in
    const struct mpm_shape *shape;             // or NULL
    double margin;
    bool inside;
};
// mpm_seed for those that the sieve lets through; the work is that of the box and the shape.
size_t mpm_seed_sifted(const struct mpm_def *def, const struct mpm_body_def *body,
                       const struct mpm_sieve *sieve,
                       bool (*each)(void *context, const double *x, double volume), void *context);
// About how long that takes, in looks (mpm_shape_looks); the sieve may be NULL.
double mpm_seed_looks(const struct mpm_def *def, const struct mpm_body_def *body,
                      const struct mpm_sieve *sieve);
// The velocity field of a body at reference position x, m/s.
void mpm_velocity_at(const struct mpm_velocity *field, const double *x, int dim, double *v);
// Half the particle size in cells that uGIMP uses for the body: 1 / (2 n).
double mpm_seed_half(const struct mpm_body_def *body);
