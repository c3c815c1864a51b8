// Memory and window of the background grid.
#include "server/mpm/grid.h"

#include <stdlib.h>
#include <string.h>

void mpm_grid_layout(struct mpm_grid *grid, const struct mpm_def *def) {
    *grid = (struct mpm_grid){.dim = def->dimension, .h = def->cell, .inv_h = 1 / def->cell};
    grid->n_nodes = 1;
    for (int d = MPM_MAX_DIM - 1; d >= 0; d--) {
        grid->n[d] = 1;
        if (d < def->dimension) {
            // The last node plane at or beyond the domain's end, whose edge need not be a node
            // plane.
            const double cells = (def->domain_max[d] - def->domain_min[d]) / def->cell;
            grid->n[d] = (int)ceil(cells - 1e-9 * cells) + 1 + 2 * MPM_PAD;
            grid->origin[d] = def->domain_min[d] - MPM_PAD * def->cell;
        }
        grid->stride[d] = grid->n_nodes;
        grid->n_nodes *= (size_t)grid->n[d];
    }
}

static size_t bytes_for(const struct mpm_grid *grid, int components) {
    return (grid->n_nodes * (size_t)components * sizeof(double) + 63) / 64 * 64;
}

static double *take(struct mpm_grid *grid, int components) {
    const size_t bytes = bytes_for(grid, components);
    double *memory = aligned_alloc(64, bytes);
    if (memory) {
        memset(memory, 0, bytes);
        grid->bytes += bytes;
    }
    return memory;
}

bool mpm_grid_create(struct mpm_grid *grid, const struct mpm_def *def) {
    mpm_grid_layout(grid, def);
    grid->node = take(grid, MPM_NODE(grid->dim));
    grid->velocity = take(grid, MPM_VELOCITY(grid->dim));
    return grid->node && grid->velocity;
}

bool mpm_grid_add_fbar(struct mpm_grid *grid, int scalars) {
    if (grid->fbar_capacity >= 1 + scalars) {
        return true;
    }
    double *fbar = take(grid, 1 + scalars);
    if (!fbar) {
        return false;
    }
    if (grid->fbar) { // the wider array takes its place
        free(grid->fbar);
        grid->bytes -= bytes_for(grid, grid->fbar_capacity);
    }
    grid->fbar = fbar;
    grid->fbar_capacity = 1 + scalars;
    return true;
}

void mpm_grid_free(struct mpm_grid *grid) {
    free(grid->node);
    free(grid->velocity);
    free(grid->fbar);
    *grid = (struct mpm_grid){0};
}

void mpm_grid_set_window(struct mpm_grid *grid, const double *min, const double *max) {
    for (int d = 0; d < grid->dim; d++) {
        // The widest basis reaches one node below a particle's cell and two above it.
        const int lo = (int)((min[d] - grid->origin[d]) * grid->inv_h) - 1;
        const int hi = (int)((max[d] - grid->origin[d]) * grid->inv_h) + 3;
        grid->lo[d] = lo > 0 ? lo : 0;
        grid->hi[d] = hi < grid->n[d] ? hi : grid->n[d];
    }
}

void mpm_grid_clear(struct mpm_grid *grid, bool fbar) {
    const size_t width = (size_t)MPM_NODE(grid->dim), fbar_width = (size_t)grid->fbar_stride;
    MPM_FOR_ROWS(grid, first, n) {
        memset(grid->node + first * width, 0, n * width * sizeof(double));
        if (fbar) {
            memset(grid->fbar + first * fbar_width, 0, n * fbar_width * sizeof(double));
        }
    }
}
