// Wall conditions on the grid.
//
// uGIMP and linear: nodes on and beyond the wall get the condition. B-splines: the ghost nodes
// behind the wall are mirror-folded, as if an image of the body moved on the other side: normal
// components are odd, tangential ones even (slip) or odd (fixed), mass and volume even. So v_n =
// v_wall exactly on the plane; merely fixing nodes lets water sink into the wall (docs/method.md
// section 5).
#pragma once
#include "server/mpm/grid.h"

// One line of nodes across a wall: ghost, plane and inner node (numbers) of a folding wall. Of a
// direct one `plane` is any node on or beyond it, and the others are unused.
struct mpm_column {
    uint32_t ghost, plane, inner;
    int place[MPM_MAX_DIM]; // of the plane node
};

// Which columns, or nodes beyond, each thread sees to: part k has item[begin[k]] up to
// item[begin[k + 1]], ascending; what belongs to no one alone comes last.
struct mpm_shares {
    uint32_t *item;  // (capacity)
    uint32_t *begin; // (n_threads + 2)
    size_t capacity;
};

struct mpm_wall {
    struct mpm_wall_def def;
    bool active, folds;                   // in force; mirror-folded (B-splines)
    int plane;                            // node index of the wall along its axis
    int ghost, inner;                     // the node planes behind it and in front of it
    int lo[MPM_MAX_DIM], hi[MPM_MAX_DIM]; // its nodes in the other directions: lo <= i < hi
    bool wants_reaction;                  // a probe asks for it, or the wall moves
    double reaction[MPM_MAX_DIM];         // N, force on the wall in the last step

    // Its nodes among the grid's blocks: mpm_walls_find_nodes.
    size_t n_columns, capacity;
    struct mpm_column *column;
    size_t n_beyond, beyond_capacity;
    struct mpm_beyond *beyond; // nodes behind the ghosts of a folding wall, and their columns
    double *real;        // (columns, 3 planes; m, f) before folding, where the reaction is wanted
    unsigned char *open; // (columns) one of `separate` that leaves its wall
    int n_threads, n_parts; // at most, and shared out to now
    struct mpm_shares columns_of, beyond_of;
};
struct mpm_beyond {
    uint32_t node, column;
};

// The definition's wall of that number. `wants_reaction`: a probe asks for it.
void mpm_wall_create(struct mpm_wall *wall, const struct mpm_def *def, size_t number,
                     const struct mpm_grid *grid, bool wants_reaction);
void mpm_wall_free(struct mpm_wall *wall);

// Adds to the grid's blocks what folding walls need: where one of a column's three nodes exists,
// all do. False when memory is short.
bool mpm_walls_activate(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *grid);
// Finds the walls' nodes among the blocks: whenever these, or which walls are active, have changed.
// False when memory is short.
bool mpm_walls_find_nodes(struct mpm_wall *walls, size_t n_walls, const struct mpm_grid *grid);

// Shares the walls' nodes out among n threads, where thread k has the nodes of the slots
// [cut[k], cut[k + 1]), so that each sees to those that lie in its own core's cache. What touches
// nodes of two threads, directly or through other walls, or adds to a sum (a reaction) is common to
// all. Returns whether there is any such.
bool mpm_walls_share(struct mpm_wall *walls, size_t n_walls, const struct mpm_grid *grid,
                     const uint32_t *cut, int n);

// The following four do the part of one thread; then that of all, part n, by one of them. No two
// parts touch the same nodes.

// Before the nodes move: folds mass, momentum and force of the ghost nodes (B-splines only).
void mpm_walls_fold(struct mpm_wall *walls, size_t n_walls, struct mpm_grid *grid,
                    const double *gravity, double dt, int part);
// After: the condition on v^{n+1} (and, where folded, the ghost nodes' values), and the reactions.
void mpm_walls_apply(struct mpm_wall *walls, size_t n_walls, struct mpm_grid *grid,
                     const double *gravity, double dt, int part);
// Folds the volume and the sums that F-bar averages (even); and, once they are averages, gives the
// ghosts theirs.
void mpm_walls_fold_fbar(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *grid,
                         int part);
void mpm_walls_mirror_fbar(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *grid,
                           int part);
