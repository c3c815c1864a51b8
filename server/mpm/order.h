// Order of a body's particles: by block of the grid, then by cell (stable, so that equal cells keep
// their order); and the tiles, which are the units of parallel work.
//
// A tile is the particles of one block at the time of the last sort. Until the next one none of
// them may drift by a whole cell: then tiles that are two blocks apart (three with cubic B-splines)
// reach no common node. Tiles have colours, such that those of one colour are so far apart. A tile
// may add to the grid once those of lower colours near it have: so no two threads add to a node at
// the same time, and each node's sum has one order, whatever the number of threads. Within a tile a
// stale order costs speed only: kernels look at each particle's cell.
#pragma once
#include <stdatomic.h>

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

#define MPM_APART 16   // numbers, so that each has a cache line of its own
#define MPM_FEWEST 128 // particles of a chunk, and a sixteenth of the body's up to MPM_MOST
#define MPM_MOST 512

struct mpm_order {
    size_t n_tiles, capacity;
    struct mpm_tile *tile; // by block
    uint8_t *colour;       // (n_tiles)
    int n_colours;
    uint32_t *before_begin, *before; // of tile t [before_begin[t], before_begin[t + 1]) of the
                                     // tiles near it with lower colours
    size_t before_capacity;
    uint64_t
        *work_before; // (n_tiles + 1) particles of the tiles before, and what tiles cost besides
    // Chunks of tiles that follow each other, of so many particles or more: whatever a pass works
    // by, tiles or chunks, the cuts between the parts fall between the same particles, since to
    // move a particle from one core's cache to another's takes longer than all else that is done
    // with it. Never depends on the number of threads: sums go by chunks.
    uint32_t *chunk; // (n_chunks + 1) first tile of each, and n_tiles
    size_t n_chunks;
    atomic_uint *done; // (n_tiles, MPM_APART) the pass in which a tile has last been done
    unsigned pass;
    // The tiles in parts of chunks, each in an order that keeps what they wait for and is near that
    // of memory.
    uint32_t *share;
    uint8_t *when; // (n_tiles) for sharing out
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
// Gives the tiles their colours and finds what they wait for: after they were found or restored.
// False when memory is short.
bool mpm_order_colour(struct mpm_order *order, const struct mpm_grid *grid, enum mpm_basis basis);
// The chunk before which there is about a share (0 to 1) of the body's work.
size_t mpm_order_cut(const struct mpm_order *order, double share);
// Shares the tiles out in n parts, of which part k begins with chunk parts[k], and n ends the last.
void mpm_order_share(struct mpm_order *order, const uint32_t *parts, int n);
// Gives every block that particles of the tiles can reach before the next sort its slot. False when
// memory is short.
bool mpm_order_activate(const struct mpm_order *order, struct mpm_grid *grid, enum mpm_basis basis);
// The same for one particle of a body of which only the position is known: to count blocks.
bool mpm_activate_around(struct mpm_grid *grid, enum mpm_basis basis, const double *x);
