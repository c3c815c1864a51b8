// Walking over the nodes that exist.
#pragma once
#include "server/mpm/grid.h"

#define FOR_NODES(g, i)                                                                            \
    for (size_t i = (size_t)MPM_BLOCK_NODES((g)->dim),                                             \
                i##_end = (g)->n_slots * (size_t)MPM_BLOCK_NODES((g)->dim);                        \
         i < i##_end; i++)

// Coordinates of a node in the domain's grid; its position, m.
static inline void node_place(const struct mpm_grid *g, size_t node, int *place) {
    const size_t nodes = (size_t)MPM_BLOCK_NODES(g->dim);
    mpm_grid_block_place(g, g->block[node / nodes], place);
    for (int d = 0; d < g->dim; d++) {
        place[d] = place[d] * MPM_EDGE + (int)(node % nodes >> 2 * (g->dim - 1 - d) & 3);
    }
}

static inline void node_position(const struct mpm_grid *g, size_t node, double *x) {
    int place[MPM_MAX_DIM];
    node_place(g, node, place);
    for (int d = 0; d < g->dim; d++) {
        x[d] = g->origin[d] + g->h * place[d];
    }
}
