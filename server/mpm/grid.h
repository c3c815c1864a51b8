// Background grid: blocks of 4^dim nodes, of which only those near particles exist.
//
// Node planes lie at origin + i h; the first and last MPM_PAD planes are outside the domain, as
// room for the bases. The domain is cut into blocks of MPM_EDGE^dim nodes; a block that particles
// can reach has a slot, and its nodes lie together in memory: node (i, j, k) is number
// slot * MPM_BLOCK_NODES + the place in its block, row-major. Slot 0 stands for all blocks that do
// not exist: its sums stay 0, and nothing that particles see is read from it. So time and memory
// follow the occupied cells, whatever the size of the domain.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/mpm/mpm.h"
#include "server/mpm/tensor.h"

#define MPM_PAD 2  // cubic B-splines reach two nodes past a particle on the domain's edge
#define MPM_EDGE 4 // nodes of a block along each direction
#define MPM_BLOCK_NODES(dim) ((dim) == 2 ? 16 : 64)
#define MPM_BLOCK_BITS(dim) (2 * (dim))
#define MPM_MAX_STENCIL 64  // nodes that a particle reaches at most: 4^3
#define MPM_STENCIL_ROOM 64 // of an array of them, which is filled eight at a time

// One node's sums (P2G), one cache line. 2D: m, mv (2), V, f (2); 3D: m, mv (3), f (3), V. So what
// goes with the weight's gradient, and with it needs more arithmetic, lies in the upper half.
#define MPM_NODE 8
#define MPM_NODE_FORCE 4
#define MPM_NODE_VOLUME(dim) ((dim) == 2 ? 3 : 7)
// One node's result: dim of v^{n+1}, then dim of v^{n+1} - v^n.
#define MPM_VELOCITY(dim) (2 * (dim))

struct mpm_grid {
    int dim, n[MPM_MAX_DIM], n_blocks[MPM_MAX_DIM]; // nodes, blocks a direction; 1 in unused ones
    double h, inv_h, origin[MPM_MAX_DIM];           // m; position of node (0, 0, 0)
    uint32_t *slot;   // (blocks of the domain) its slot, 0 = it does not exist
    uint32_t n_slots; // in use, slot 0 with them
    uint32_t *block;  // (block_capacity) which block has the slot
    uint32_t block_capacity;
    uint32_t (*near)[8]; // (capacity) first nodes of the 2^dim blocks at +0 and +1 along each
                         // direction, row-major: what a stencil that begins in the block reaches
    uint32_t capacity;   // slots that there is memory for
    // Of each cell of a block, for the nodes of its stencil: which of the blocks near, and where in
    // it. Rows of MPM_MAX_STENCIL.
    uint8_t *which, *place;
    double *node;        // (nodes, MPM_NODE)
    double *velocity;    // (nodes, MPM_VELOCITY)
    double *fbar;        // (nodes, scalars) sums that F-bar averages; NULL while F-bar is off
    int fbar_stride, fbar_capacity; // scalars of the scheme in force, and of the widest so far
    size_t bytes;
};

// Sizes only (no memory). Block and cell of a particle must fit 32 bits: false when the domain has
// more nodes.
bool mpm_grid_layout(struct mpm_grid *grid, const struct mpm_def *def);
// Without blocks. `support`: nodes per direction that a particle reaches.
bool mpm_grid_create(struct mpm_grid *grid, const struct mpm_def *def, int support);
// `scalars`: sums that the F-bar scheme averages (1 or 2).
bool mpm_grid_add_fbar(struct mpm_grid *grid, int scalars);
void mpm_grid_free(struct mpm_grid *grid);
size_t mpm_grid_bytes(const struct mpm_grid *grid, uint32_t slots, int fbar_scalars);

// Forgets all blocks.
void mpm_grid_deactivate(struct mpm_grid *grid);
// Gives a block (coordinates within the domain's blocks, else ignored) a slot. False when memory is
// short.
bool mpm_grid_activate(struct mpm_grid *grid, const int *block);
// Once all blocks have their slots: memory for their nodes, and the neighbours of each. False when
// memory is short.
bool mpm_grid_connect(struct mpm_grid *grid);
// Coordinates of a block of the domain.
void mpm_grid_block_place(const struct mpm_grid *grid, uint32_t block, int *place);

// The node number of (i, j, k); in slot 0 where its block does not exist.
static inline uint32_t mpm_node_at(const struct mpm_grid *g, const int *place) {
    uint32_t block = 0, in = 0;
    for (int d = 0; d < g->dim; d++) {
        block = block * (uint32_t)g->n_blocks[d] + ((uint32_t)place[d] >> 2);
        in = in * MPM_EDGE + ((uint32_t)place[d] & 3);
    }
    return g->slot[block] * (uint32_t)MPM_BLOCK_NODES(g->dim) + in;
}

// Block and place in it of the first node of a stencil, in one number; equal for all particles of a
// cell (of the cells that the basis makes). The particles are sorted by it.
MPM_KERNEL uint32_t mpm_cell_key(const struct mpm_grid *g, const int *base, const int dim) {
    uint32_t block = 0, in = 0;
    for (int d = 0; d < dim; d++) {
        block = block * (uint32_t)g->n_blocks[d] + ((uint32_t)base[d] >> 2);
        in = in * MPM_EDGE + ((uint32_t)base[d] & 3);
    }
    return block << MPM_BLOCK_BITS(dim) | in;
}

// Node numbers of the support^dim nodes of a stencil, row-major.
MPM_KERNEL void mpm_grid_stencil(const struct mpm_grid *g, uint32_t key, const int support,
                                 const int dim, uint32_t *nodes) {
    const uint32_t in = key & (MPM_BLOCK_NODES(dim) - 1);
    const uint32_t *near = g->near[g->slot[key >> MPM_BLOCK_BITS(dim)]];
    const int i = (int)(in >> (2 * (dim - 1))), j = (int)(in >> (2 * (dim - 2))) & 3,
              k = (int)in & 3;
    for (int a = 0; a < support; a++) {
        for (int b = 0; b < support; b++) {
            if (dim == 2) {
                *nodes++ =
                    near[(i + a) / 4 * 2 + (j + b) / 4] + (uint32_t)((i + a) % 4 * 4 + (j + b) % 4);
                continue;
            }
            for (int c = 0; c < support; c++) {
                *nodes++ = near[(i + a) / 4 * 4 + (j + b) / 4 * 2 + (k + c) / 4] +
                           (uint32_t)((i + a) % 4 * 16 + (j + b) % 4 * 4 + (k + c) % 4);
            }
        }
    }
}
