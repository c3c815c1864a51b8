// Values at scattered points, interpolated at other points.
#pragma once
#include "server/mpm/mpm.h"

struct mpm_table {
    const struct mpm_against *of; // borrowed
    size_t width;                 // values of a point
    double spacing;               // m, of a square lattice of as many points over the same box
    size_t *order;                // (n) by the first coordinate; owned
};

// False when memory is short.
bool mpm_table_create(struct mpm_table *table, const struct mpm_against *of, size_t width);
void mpm_table_free(struct mpm_table *table);
// The values at X: those of a point that lies there, else of the plane (line, hyperplane) that fits
// the 2^axes nearest points best, the nearer ones more. False where no point is nearer than the
// typical spacing.
bool mpm_table_at(const struct mpm_table *table, const double *X, double *out);
