// Which points lie in a shape: one by one, or a lattice of them row by row.
#pragma once
#include <stdint.h>

#include "server/mpm/mpm.h"

#define MPM_ROW 1024       // points that are looked at together, at most
#define MPM_SHAPE_DEPTH 16 // shapes in shapes; deeper ones are looked at point by point

// Bounding box, m. False for an empty shape.
bool mpm_shape_bounds(const struct mpm_shape *shape, int dim, double *min, double *max);
// Whether a point lies strictly inside the shape, off its edge by more than `margin` (m).
bool mpm_shape_contains(const struct mpm_shape *shape, const double *x, int dim, double margin);
// The same for many points of one shape, which must outlive it: NULL without memory.
struct mpm_region;
struct mpm_region *mpm_region_create(const struct mpm_shape *shape, int dim, double margin);
bool mpm_region_contains(const struct mpm_region *region, const double *x);
void mpm_region_free(struct mpm_region *region); // NULL is fine

// Points in rows along the last direction. Shapes are looked at in lengths of `unit` from `origin`,
// and whether a point lies on an edge is decided to 1e-7 of a unit.
struct mpm_lattice {
    int dim;
    double origin[MPM_MAX_DIM]; // m
    double unit;                // m
    // Point k of direction d is at first[d] + (k + 1/2) spacing (m); where `spacing` is 0, at the
    // odd multiple 2k + 1 of the unit, exactly.
    double first[MPM_MAX_DIM], spacing;
};

struct mpm_form; // a shape made ready
struct mpm_rows {
    const struct mpm_shape *shape;
    struct mpm_lattice lattice;
    struct mpm_form *form; // NULL without memory: then every point is held against every edge
    struct mpm_crossing {
        double at;
        uint32_t edge;
    } * crossings; // of a polygon with a row; room for the polygon with the most edges
    size_t (*doubts)[2];
    long long index[MPM_MAX_DIM]; // of the row's first point
    double place[MPM_MAX_DIM];    // units; the last is not used
    long long u_from;
    size_t n, n_u;                 // points of the row, and of `u`
    double u[MPM_ROW], v[MPM_ROW]; // places along the last direction, and along y in 3D
    long long v_from;
    bool has_v;
    signed char side[MPM_SHAPE_DEPTH + 1][MPM_ROW];
};
// `shape` must outlive the rows. Always works, more slowly without memory.
void mpm_rows_create(struct mpm_rows *rows, const struct mpm_shape *shape,
                     const struct mpm_lattice *lattice);
// Of n <= MPM_ROW points from `index` on along the last direction: 1 inside, 0 on the edge, -1
// outside. Quickest where rows come in the order of their index. Valid until the next call.
const signed char *mpm_rows_at(struct mpm_rows *rows, const long long *index, size_t n);
void mpm_rows_free(struct mpm_rows *rows);

// About how many looks at one point of a row (each well below 1 ns) it takes to look at the lattice
// points of a box, `spacing` apart.
double mpm_shape_looks(const struct mpm_shape *shape, int dim, const double *min, const double *max,
                       double spacing);
// Its simple shapes and their corners, all told.
double mpm_shape_edges(const struct mpm_shape *shape);
