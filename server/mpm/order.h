// Order of a body's particles: by block of the grid, then by cell (stable, so that equal cells keep
// their order); and the stretches, which are the units of parallel work.
//
// A tile is the particles of one block at the time of the last sort. Until the next one none of
// them may drift by a whole cell: then the particles of blocks that are two apart (three with cubic
// B-splines) reach no common node. Blocks that follow each other along the last direction are a
// row, and their particles lie one after another; a stretch is some hundred of these, which may
// begin and end within a block. Of two stretches that reach common nodes one comes before the other
// (by colour, then by place), and adds to the grid before it: so no two threads add to a node at
// the same time, and each node's sum has one order, whatever the number of threads. Within a
// stretch a stale order costs speed only: kernels look at each particle's cell.
#pragma once
#include <stdatomic.h>

#include "server/mpm/grid.h"
#include "server/mpm/particles.h"
#include "server/mpm/team.h"

struct mpm_tile {
    uint32_t begin, end; // particles
    uint32_t block;      // of the grid
    uint32_t padding;    // 0: the state is saved as bytes
    uint64_t cells;      // bits: the cells of the block (place of the first node) in use
};

struct mpm_stretch {
    uint32_t begin, end;  // particles
    uint32_t first, last; // the blocks of these, of the grid
    uint32_t row;         // of blocks
};

#define MPM_APART 16  // numbers, so that what lies between shares no cache line
#define MPM_FEWEST 64 // particles of a chunk, and 1/32 of the body's up to MPM_MOST
#define MPM_MOST 512

// Ties of a stretch to other parts, by itself or through stretches of its own part, as bits.
#define MPM_AWAITED 1 // one there waits for it
#define MPM_AWAITS 2  // it waits for one there

struct mpm_order {
    size_t n_tiles, tile_capacity;
    struct mpm_tile *tile; // by block
    size_t n_stretches, capacity;
    struct mpm_stretch *stretch; // by row and place
    // (n_stretches) By which they come before each other. In two of one colour that reach common
    // nodes the first of them does.
    uint8_t *colour;
    int n_colours;
    uint32_t *before_begin, *before; // of stretch t [before_begin[t], before_begin[t + 1]) of those
                                     // near it that come before it
    size_t before_capacity;
    uint64_t *work_before; // (n_stretches + 1) particles of those before, and what each costs
                           // besides
    // Chunks of stretches that follow each other, of so many particles or more: whatever a pass
    // works by, the cuts between the parts fall between the same particles, since to move a
    // particle from one core's cache to another's takes longer than all else that is done with it.
    // Never depends on the number of threads: sums go by chunks.
    uint32_t *chunk; // (n_chunks + 1) first stretch of each, and n_stretches
    size_t n_chunks;
    atomic_uint *done; // (n_stretches + parts * MPM_APART) the pass that has last done one: of
                       // those that another thread may look at, the others' say nothing
    size_t n_flags;    // room in `done`
    // The stretches in parts of chunks, each in an order that keeps what they wait for and is near
    // that of memory.
    uint32_t *share;
    uint32_t *flag;  // (n_stretches) where in `done`: a part's side by side, for who waits for many
    uint8_t *ties;   // (n_stretches)
    uint64_t *ended; // (n_stretches) work at which one is over, as if all threads were as fast
    struct mpm_part *parts; // (most_parts) while they are shared out; stretch.c
    int most_parts;
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
// Finds the stretches and what they wait for: after the tiles were found or restored. There is room
// for n_threads parts. False when memory is short.
bool mpm_order_stretches(struct mpm_order *order, const struct mpm_grid *grid, enum mpm_basis basis,
                         int n_threads);
// The chunk before which there is about a share (0 to 1) of the body's work; where a row begins, if
// one does near there.
size_t mpm_order_cut(const struct mpm_order *order, double share);
// Shares the stretches out in n parts, of which part k begins with chunk cuts[k], and cuts[n] ends
// the last.
void mpm_order_share(struct mpm_order *order, const uint32_t *cuts, int n);
// Gives every block that particles of the tiles can reach before the next sort its slot. False when
// memory is short.
bool mpm_order_activate(const struct mpm_order *order, struct mpm_grid *grid, enum mpm_basis basis);
// The same for one particle of a body of which only the position is known: to count blocks.
bool mpm_activate_around(struct mpm_grid *grid, enum mpm_basis basis, const double *x);
