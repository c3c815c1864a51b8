// Where things lie: the particles by cell, the blocks of the grid around them, the walls' nodes
// among these; and when that is to be found anew.
#include <stdlib.h>

#include "server/mpm/sim.h"

// Blocks, walls and stretches from the tiles.
static bool lay_out(struct mpm_sim *sim) {
    const enum mpm_basis basis = sim->def->basis;
    mpm_grid_deactivate(&sim->grid);
    sim->n_shared = 0;
    sim->sums_are_clear = false;
    for (size_t b = 0; b < sim->n_sets; b++) {
        if (!mpm_order_stretches(&sim->orders[b], &sim->grid, basis, sim->def->n_threads) ||
            !mpm_order_activate(&sim->orders[b], &sim->grid, basis)) {
            return false;
        }
    }
    return mpm_walls_activate(sim->walls, sim->n_walls, &sim->grid) &&
           mpm_grid_connect(&sim->grid) &&
           mpm_walls_find_nodes(sim->walls, sim->n_walls, &sim->grid);
}

bool mpm_sort(struct mpm_sim *sim) {
    for (size_t b = 0; b < sim->n_sets; b++) {
        if (!mpm_order_sort(&sim->orders[b], &sim->sets[b], &sim->grid, sim->def->basis,
                            &sim->sorter)) {
            return false;
        }
    }
    sim->c.is_sorted = 1;
    sim->c.steps_since_sort = sim->c.runs_at_sort = 0;
    sim->c.drift = 0;
    return lay_out(sim);
}

bool mpm_restore_order(struct mpm_sim *sim) {
    const uint32_t n_blocks = (uint32_t)sim->grid.n_blocks[0] * (uint32_t)sim->grid.n_blocks[1] *
                              (uint32_t)sim->grid.n_blocks[2];
    for (size_t b = 0; b < sim->n_sets; b++) {
        uint32_t at = 0;
        for (size_t k = 0; k < sim->orders[b].n_tiles; k++) {
            const struct mpm_tile *tile = &sim->orders[b].tile[k];
            if (tile->begin != at || tile->end <= at || tile->block >= n_blocks) {
                return false;
            }
            at = tile->end;
        }
        if (at != sim->sets[b].n) {
            return false;
        }
    }
    return lay_out(sim);
}
