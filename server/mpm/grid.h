// Background grid: node arrays over the domain, of which only the window that particles reach is
// used.
//
// Node (i, j, k) is stored at i * stride[0] + j * stride[1] + k * stride[2]; node planes lie at
// origin + i h. The first and last MPM_PAD planes are outside the domain, as room for the bases.
#pragma once
#include <stdbool.h>
#include <stddef.h>

#include "server/mpm/mpm.h"
#include "server/mpm/tensor.h"

#define MPM_PAD 2 // cubic B-splines reach two nodes past a particle on the domain's edge

// One node's sums (P2G): m, then dim of momentum, then dim of force.
#define MPM_NODE(dim) (2 * (dim) + 1)
// One node's result: dim of v^{n+1}, then dim of v^{n+1} - v^n.
#define MPM_VELOCITY(dim) (2 * (dim))

struct mpm_grid {
    int dim, n[MPM_MAX_DIM]; // stored nodes per direction; 1 in an unused direction
    size_t stride[MPM_MAX_DIM], n_nodes;
    double h, inv_h, origin[MPM_MAX_DIM]; // m; position of node (0, 0, 0)
    int lo[MPM_MAX_DIM], hi[MPM_MAX_DIM]; // window of nodes in use this step: lo <= i < hi
    double *node;                         // (n_nodes, MPM_NODE)
    double *velocity;                     // (n_nodes, MPM_VELOCITY)
    double *fbar; // (n_nodes, 1 + scalars): V, then the averaged sums; NULL while F-bar is off
    int fbar_stride, fbar_capacity; // 1 + scalars of the scheme in force, and of the widest so far
    size_t bytes;
};

// Sizes only (no memory): how many nodes a grid over the domain stores.
void mpm_grid_layout(struct mpm_grid *grid, const struct mpm_def *def);
bool mpm_grid_create(struct mpm_grid *grid, const struct mpm_def *def);
// `scalars`: sums besides V that the F-bar scheme averages (1 or 2).
bool mpm_grid_add_fbar(struct mpm_grid *grid, int scalars);
void mpm_grid_free(struct mpm_grid *grid);
// The window of nodes that particles with positions in [min, max] (m) reach.
void mpm_grid_set_window(struct mpm_grid *grid, const double *min, const double *max);
// Zeroes the node sums in the window.
void mpm_grid_clear(struct mpm_grid *grid, bool fbar);

// Calls body for each row of the window: `first` is the row's first node, `n` its nodes. Rows run
// along the last direction in use, whose stride is 1.
#define MPM_FOR_ROWS(grid, first, n)                                                               \
    for (int row_i = (grid)->lo[0]; row_i < (grid)->hi[0]; row_i++)                                \
        for (int row_j = (grid)->dim == 3 ? (grid)->lo[1] : 0,                                     \
                 row_j_end = (grid)->dim == 3 ? (grid)->hi[1] : 1;                                 \
             row_j < row_j_end; row_j++)                                                           \
            for (size_t first = (size_t)row_i * (grid)->stride[0] +                                \
                                ((grid)->dim == 3 ? (size_t)row_j * (grid)->stride[1] : 0) +       \
                                (size_t)(grid)->lo[(grid)->dim - 1],                               \
                        n = (size_t)((grid)->hi[(grid)->dim - 1] - (grid)->lo[(grid)->dim - 1]),   \
                        once = 1;                                                                  \
                 once; once = 0)
