// Filling shapes with particles on a lattice in the cells.
#pragma once
#include "server/mpm/mpm.h"

struct mpm_particles;

// An upper bound on the particles of a body, quickly, from the shape's bounding box.
double mpm_seed_bound(const struct mpm_def *def, const struct mpm_body_def *body);
// Number of particles of a body; where `each` is not NULL, calls it with position (m) and volume
// (m^3, per metre of thickness in 2D) of each, in lattice order (last direction fastest), until it
// returns false.
size_t mpm_seed(const struct mpm_def *def, const struct mpm_body_def *body,
                bool (*each)(void *context, const double *x, double volume), void *context);
// Whether a point lies strictly inside the shape, off its edge by more than `margin` (m).
bool mpm_shape_contains(const struct mpm_shape *shape, const double *x, int dim, double margin);
// The same for many points of one shape, which must outlive it: NULL without memory.
struct mpm_region;
struct mpm_region *mpm_region_create(const struct mpm_shape *shape, int dim, double margin);
bool mpm_region_contains(const struct mpm_region *region, const double *x);
void mpm_region_free(struct mpm_region *region); // NULL is fine
// Bounding box, m. False for an empty shape.
bool mpm_shape_bounds(const struct mpm_shape *shape, int dim, double *min, double *max);
// The velocity field of a body at reference position x, m/s.
void mpm_velocity_at(const struct mpm_velocity *field, const double *x, int dim, double *v);
// Half the particle size in cells that uGIMP uses for the body: 1 / (2 n).
double mpm_seed_half(const struct mpm_body_def *body);
