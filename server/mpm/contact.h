// Barrier contact with rigid bodies (docs/method.md section 9).
#pragma once
#include "server/mpm/order.h"
#include "server/mpm/transfer.h"

struct mpm_rigid {
    struct mpm_rigid_def def;
    bool active;
    double offset[MPM_MAX_DIM];                // m, how far it has moved
    double reaction[MPM_MAX_DIM];              // N, force on it in the last step
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM]; // m, its bounding box before it moved
    // (n_particles, dim) where on the body each particle in contact sticks, m before it moved;
    // INFINITY of one that is not. NULL without friction.
    double *anchor;
    size_t anchor_bytes;
};

// `n_particles` in all; false when there is no memory.
bool mpm_rigid_create(struct mpm_rigid *rigid, const struct mpm_rigid_def *def, int dim,
                      size_t n_particles);
void mpm_rigid_free(struct mpm_rigid *rigid);
size_t mpm_rigid_bytes(const struct mpm_rigid_def *def, int dim, size_t n_particles);
double mpm_rigid_speed(const struct mpm_rigid_def *def, int dim); // m/s
// Whether a shape has a distance function here: a box, ball or polygon.
bool mpm_rigid_shape_is_known(const struct mpm_shape *shape);
// Signed distance (m) of x from the surface of a shape, negative inside, and the outward unit
// normal.
double mpm_shape_distance(const struct mpm_shape *shape, const double *x, int dim, double *normal);
// The barrier's pressure at distance d, Pa; 0 from `distance` on.
double mpm_barrier_pressure(const struct mpm_rigid_def *def, double d);

// With the particles at x^n: contact and friction forces of one body's particles to the grid, and
// their sum onto rigid->reaction (which the caller has zeroed). Tiles that are too far from the
// body for any of their particles are passed by.
void mpm_contact_forces(struct mpm_rigid *rigid, const struct mpm_kernels *kernels,
                        struct mpm_particles *s, const struct mpm_order *order,
                        struct mpm_grid *grid, double dt);
// With the particles at x^{n+1} and the rigid body moved: none stays behind the surface. A particle
// that a step has carried deeper than the barrier can answer is put back onto its innermost
// distance and loses its velocity into the body; the impulse is part of the reaction. What this
// changes of the particles' bounds, largest speed and displacement goes into `found`.
void mpm_contact_keep_out(struct mpm_rigid *rigid, struct mpm_particles *s,
                          const struct mpm_order *order, const struct mpm_grid *grid, double dt,
                          struct mpm_span_result *found);
