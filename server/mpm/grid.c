// Memory of the background grid, and which of its blocks exist.
#include "server/mpm/grid.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/memory.h"

#define FIRST_CAPACITY 32 // slots

bool mpm_grid_layout(struct mpm_grid *grid, const struct mpm_def *def) {
    *grid = (struct mpm_grid){.dim = def->dimension, .h = def->cell, .inv_h = 1 / def->cell};
    double n_nodes = 1;
    for (int d = 0; d < MPM_MAX_DIM; d++) {
        grid->n[d] = grid->n_blocks[d] = 1;
        if (d < def->dimension) {
            // The last node plane at or beyond the domain's end, whose edge need not be a node
            // plane.
            const double cells = (def->domain_max[d] - def->domain_min[d]) / def->cell;
            if (!(cells < INT32_MAX / 2)) {
                return false;
            }
            grid->n[d] = (int)ceil(cells - 1e-9 * cells) + 1 + 2 * MPM_PAD;
            grid->n_blocks[d] = (grid->n[d] + MPM_EDGE - 1) / MPM_EDGE;
            grid->origin[d] = def->domain_min[d] - MPM_PAD * def->cell;
            n_nodes *= grid->n_blocks[d] * (double)MPM_EDGE;
        }
    }
    return n_nodes < UINT32_MAX;
}

static size_t n_blocks(const struct mpm_grid *g) {
    return (size_t)g->n_blocks[0] * (size_t)g->n_blocks[1] * (size_t)g->n_blocks[2];
}

size_t mpm_grid_bytes(const struct mpm_grid *g, uint32_t slots, int fbar_scalars) {
    const size_t per_node = MPM_NODE + (size_t)MPM_VELOCITY(g->dim) + (size_t)fbar_scalars;
    return n_blocks(g) * sizeof *g->slot +
           slots * (sizeof *g->near + (size_t)MPM_BLOCK_NODES(g->dim) * per_node * sizeof(double));
}

// (capacity blocks, components) of zeros.
static double *take(const struct mpm_grid *g, uint32_t capacity, int components) {
    const size_t bytes =
        capacity * (size_t)MPM_BLOCK_NODES(g->dim) * (size_t)components * sizeof(double);
    return mpm_memory(bytes);
}

// The sums and results of a step do not outlive it, so nothing is copied.
static bool reserve(struct mpm_grid *g, uint32_t capacity) {
    uint32_t(*near)[8] = malloc(capacity * sizeof *near);
    double *node = take(g, capacity, MPM_NODE);
    double *velocity = take(g, capacity, MPM_VELOCITY(g->dim));
    double *fbar = g->fbar_capacity > 0 ? take(g, capacity, g->fbar_capacity) : NULL;
    if (!near || !node || !velocity || (g->fbar_capacity > 0 && !fbar)) {
        free(near);
        free(node);
        free(velocity);
        free(fbar);
        return false;
    }
    free(g->near);
    free(g->node);
    free(g->velocity);
    free(g->fbar);
    g->near = near;
    g->node = node;
    g->velocity = velocity;
    g->fbar = fbar;
    g->capacity = capacity;
    g->bytes = mpm_grid_bytes(g, capacity, g->fbar_capacity);
    return true;
}

// For every cell: the stencil of a block whose neighbours begin at 0, 256, 512, ...
static void fill_tables(struct mpm_grid *g, int support) {
    uint32_t slot = 0, near[1][8], nodes[MPM_MAX_STENCIL];
    for (uint32_t k = 0; k < 8; k++) {
        near[0][k] = k << 8;
    }
    const struct mpm_grid one = {.dim = g->dim, .slot = &slot, .near = near};
    const int n = g->dim == 2 ? support * support : support * support * support;
    for (uint32_t cell = 0; cell < (uint32_t)MPM_BLOCK_NODES(g->dim); cell++) {
        if (g->dim == 2) {
            mpm_grid_stencil(&one, cell, support, 2, nodes);
        } else {
            mpm_grid_stencil(&one, cell, support, 3, nodes);
        }
        for (int k = 0; k < n; k++) {
            g->which[cell * MPM_MAX_STENCIL + (uint32_t)k] = (uint8_t)(nodes[k] >> 8);
            g->place[cell * MPM_MAX_STENCIL + (uint32_t)k] = (uint8_t)(nodes[k] & 255);
        }
    }
}

bool mpm_grid_create(struct mpm_grid *grid, const struct mpm_def *def, int support) {
    if (!mpm_grid_layout(grid, def)) {
        return false;
    }
    const size_t cells = (size_t)MPM_BLOCK_NODES(grid->dim);
    grid->which = calloc(2 * cells, MPM_MAX_STENCIL);
    if (!grid->which) {
        return false;
    }
    grid->place = grid->which + cells * MPM_MAX_STENCIL;
    fill_tables(grid, support);
    grid->n_slots = 1;
    grid->slot = calloc(n_blocks(grid), sizeof *grid->slot);
    grid->block_capacity = FIRST_CAPACITY;
    grid->block = calloc(grid->block_capacity, sizeof *grid->block);
    return grid->slot && grid->block;
}

bool mpm_grid_add_fbar(struct mpm_grid *grid, int scalars) {
    if (grid->fbar_capacity >= scalars) {
        return true;
    }
    double *fbar = grid->capacity > 0 ? take(grid, grid->capacity, scalars) : NULL;
    if (grid->capacity > 0 && !fbar) {
        return false;
    }
    free(grid->fbar); // the wider array takes its place
    grid->fbar = fbar;
    grid->fbar_capacity = scalars;
    grid->bytes = mpm_grid_bytes(grid, grid->capacity, scalars);
    return true;
}

void mpm_grid_free(struct mpm_grid *grid) {
    free(grid->which);
    free(grid->slot);
    free(grid->block);
    free(grid->near);
    free(grid->node);
    free(grid->velocity);
    free(grid->fbar);
    *grid = (struct mpm_grid){0};
}

void mpm_grid_deactivate(struct mpm_grid *grid) {
    for (uint32_t s = 1; s < grid->n_slots; s++) {
        grid->slot[grid->block[s]] = 0;
    }
    grid->n_slots = 1;
}

static uint32_t block_at(const struct mpm_grid *g, const int *place) {
    uint32_t block = 0;
    for (int d = 0; d < g->dim; d++) {
        if (place[d] < 0 || place[d] >= g->n_blocks[d]) {
            return UINT32_MAX;
        }
        block = block * (uint32_t)g->n_blocks[d] + (uint32_t)place[d];
    }
    return block;
}

bool mpm_grid_activate(struct mpm_grid *grid, const int *place) {
    const uint32_t block = block_at(grid, place);
    if (block == UINT32_MAX || grid->slot[block] > 0) {
        return true;
    }
    if (grid->n_slots == grid->block_capacity) {
        const uint32_t wider = 2 * grid->block_capacity;
        uint32_t *blocks = realloc(grid->block, wider * sizeof *blocks);
        if (!blocks) {
            return false;
        }
        grid->block = blocks;
        grid->block_capacity = wider;
    }
    grid->slot[block] = grid->n_slots;
    grid->block[grid->n_slots++] = block;
    return true;
}

void mpm_grid_block_place(const struct mpm_grid *grid, uint32_t block, int *place) {
    for (int d = grid->dim; d-- > 0;) {
        place[d] = (int)(block % (uint32_t)grid->n_blocks[d]);
        block /= (uint32_t)grid->n_blocks[d];
    }
}

bool mpm_grid_connect(struct mpm_grid *grid) {
    // What the scene begins with exactly; what it spreads to later with room to spare.
    const uint32_t wider = grid->capacity + grid->capacity / 4;
    if (grid->n_slots > grid->capacity &&
        !reserve(grid, wider > grid->n_slots ? wider : grid->n_slots)) {
        return false;
    }
    const uint32_t nodes = (uint32_t)MPM_BLOCK_NODES(grid->dim);
    memset(grid->near[0], 0, sizeof grid->near[0]);
    for (uint32_t s = 1; s < grid->n_slots; s++) {
        int place[MPM_MAX_DIM], other[MPM_MAX_DIM];
        mpm_grid_block_place(grid, grid->block[s], place);
        for (int k = 0; k < 8; k++) {
            for (int d = 0; d < grid->dim; d++) {
                other[d] = place[d] + (k >> (grid->dim - 1 - d) & 1);
            }
            const uint32_t block = k < 1 << grid->dim ? block_at(grid, other) : UINT32_MAX;
            grid->near[s][k] = block == UINT32_MAX ? 0 : grid->slot[block] * nodes;
        }
    }
    return true;
}
