// Order of a body's particles: by block of the grid, then by cell (stable, so that equal cells keep
// their order); and the tiles, which are the units of parallel work.
//
// A tile is the particles of one block at the time of the last sort. Until the next one none of
// them may drift by a whole cell: then tiles that are two blocks apart (three with cubic B-splines)
// reach no common node, and those of one colour can add to the grid at the same time, without
// atomics and in an order that no thread count changes. Within a tile a stale order costs speed
// only: kernels look at each particle's cell.
#pragma once
#include "server/mpm/grid.h"
#include "server/mpm/particles.h"
#include "server/mpm/team.h"

#define MPM_MAX_COLOURS 27

struct mpm_tile {
    uint32_t begin, end; // particles
    uint32_t block;      // of the grid
    uint32_t padding;    // 0: the state is saved as bytes
    uint64_t cells;      // bits: the cells of the block (place of the first node) in use
};

struct mpm_order {
    size_t n_tiles, capacity;
    struct mpm_tile *tile; // by block
    uint32_t *by_colour;   // tiles by colour
    uint64_t *work_before; // (n_tiles + 1) of by_colour: particles, and what a tile costs besides
    size_t colour_begin[MPM_MAX_COLOURS + 1]; // of by_colour; n_colours + 1 in use
    int n_colours;
};

// Memory for sorting any body of up to n particles.
struct mpm_sorter {
    uint32_t *key[2], *from[2]; // (n) each; key also serves as one array of doubles
    uint32_t *count;            // (threads, digits) of the radix sort
    struct mpm_team *team;      // borrowed
    size_t bytes;
};

bool mpm_sorter_create(struct mpm_sorter *sorter, size_t n, struct mpm_team *team);
void mpm_sorter_free(struct mpm_sorter *sorter);
size_t mpm_sorter_bytes(size_t n, int n_threads);

void mpm_order_free(struct mpm_order *order);
// Room for n tiles. False when memory is short.
bool mpm_order_reserve(struct mpm_order *order, size_t n);
// Sorts the particles and finds the tiles. False when memory is short: then the particles are
// sorted, and the order must not be used.
bool mpm_order_sort(struct mpm_order *order, struct mpm_particles *s, const struct mpm_grid *grid,
                    enum mpm_basis basis, struct mpm_sorter *sorter);
// Sorts the tiles by colour: after they were found or restored.
void mpm_order_colour(struct mpm_order *order, const struct mpm_grid *grid, enum mpm_basis basis);
// Gives every block that particles of the tiles can reach before the next sort its slot. False when
// memory is short.
bool mpm_order_activate(const struct mpm_order *order, struct mpm_grid *grid, enum mpm_basis basis);
// The same for one particle of a body of which only the position is known: to count blocks.
bool mpm_activate_around(struct mpm_grid *grid, enum mpm_basis basis, const double *x);
