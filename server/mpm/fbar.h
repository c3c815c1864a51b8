// F-bar as a stage: average of the volume ratio over the grid, and the switch between schemes.
#pragma once
#include "server/mpm/boundary.h"
#include "server/mpm/particles.h"

// Sums besides V that a scheme averages: 0, 1 or 2.
int mpm_fbar_scalars(enum mpm_fbar_scheme scheme);
// The plain kernel divide_nodes (transfer.h).
void mpm_fbar_divide(const struct mpm_grid *grid, uint32_t begin, uint32_t end);
// max |ln(J/Jbar)| over the particles of one body: how far the volume that forces use (or, for a
// fluid under F-bar, its raw volume ratio) has come from the ratio that stress uses. Infinite when
// a raw ratio is not positive.
double mpm_fbar_drift(const struct mpm_particles *s);
