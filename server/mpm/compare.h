// Error probes: a field of the particles against an exact solution or a table.
#pragma once
#include "server/mpm/solution.h"

#define MPM_COMPARE_EDGE 1e-9 // cells: how far inside an excluded shape a particle must be

struct mpm_sim;

// One of each probe of a simulation.
struct mpm_compare {
    uint8_t *chosen;        // (n_particles) by id: whether the probe reads it; NULL = all
    struct mpm_exact exact; // of an error against a solution
    double *reference;      // (n_particles, width) by id, NaN where there is none: of what does not
                            // change with time
};

// Whether the probe's `select`, `exclude` or `against` needs one. Reads the particles where they
// begin. False when memory is short.
bool mpm_compare_create(struct mpm_compare *c, const struct mpm_sim *sim,
                        const struct mpm_probe_def *q);
void mpm_compare_free(struct mpm_compare *c);
// Bytes that it takes.
size_t mpm_compare_bytes(const struct mpm_probe_def *q, int dim, size_t n_particles);
// Value of an error probe, before its scale; NaN where it has none.
double mpm_compare_error(struct mpm_compare *c, const struct mpm_sim *sim,
                         const struct mpm_probe_def *q);
// Components of the field that an error compares.
size_t mpm_compare_width(const struct mpm_probe_def *q, int dim);
