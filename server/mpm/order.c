// Sorting of particles by cell: radix sort of their keys, then one field at a time changes places.
#include "server/mpm/order.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/memory.h"

#define DIGIT 11 // bits of one pass of the radix sort: its counters fit the first-level cache
#define N_DIGITS (1 << DIGIT)

static size_t numbers_bytes(size_t n) {
    return (n * sizeof(uint32_t) + 63) / 64 * 64;
}

size_t mpm_sorter_bytes(size_t n, int n_threads) {
    return 4 * numbers_bytes(n) + (size_t)n_threads * N_DIGITS * sizeof(uint32_t);
}

bool mpm_sorter_create(struct mpm_sorter *sorter, size_t n, struct mpm_team *team) {
    *sorter = (struct mpm_sorter){.team = team, .bytes = mpm_sorter_bytes(n, team->n_threads)};
    char *memory = mpm_memory(sorter->bytes);
    if (!memory) {
        return false;
    }
    uint32_t **const arrays[] = {&sorter->key[0], &sorter->key[1], &sorter->from[0],
                                 &sorter->from[1], &sorter->count};
    for (size_t k = 0; k < 5; k++) {
        *arrays[k] = (uint32_t *)(void *)(memory + k * numbers_bytes(n));
    }
    return true;
}

void mpm_sorter_free(struct mpm_sorter *sorter) {
    free(sorter->key[0]);
    *sorter = (struct mpm_sorter){0};
}

// The part of n that part k of n_parts takes.
static size_t part_begin(size_t n, int k, int n_parts) {
    return n * (size_t)k / (size_t)n_parts;
}

struct keying {
    const struct mpm_particles *s;
    const struct mpm_grid *grid;
    enum mpm_basis basis;
    uint32_t *key;
};

static void find_keys(void *context, int own, int there) {
    const struct keying *k = context;
    const struct mpm_grid *g = k->grid;
    const size_t n = k->s->n, end = part_begin(n, own + 1, there);
    for (size_t p = part_begin(n, own, there); p < end; p++) {
        int base[MPM_MAX_DIM];
        for (int d = 0; d < g->dim; d++) {
            base[d] =
                (int)mpm_base(k->basis, (k->s->x[mpm_at(p, g->dim, d)] - g->origin[d]) * g->inv_h);
        }
        k->key[p] = g->dim == 2 ? mpm_cell_key(g, base, 2) : mpm_cell_key(g, base, 3);
    }
}

// One stable pass by the digit at `shift`, in parts, one a thread, that count and then move by
// themselves; the outcome does not depend on their number.
struct radix_pass {
    const uint32_t *key, *from;
    uint32_t *key_out, *from_out, (*count)[N_DIGITS];
    size_t n;
    uint32_t least;
    int shift;
    bool first;
    struct mpm_team *team;
};

static void run_radix_pass(void *context, int own, int there) {
    const struct radix_pass *r = context;
    const size_t begin = part_begin(r->n, own, there), end = part_begin(r->n, own + 1, there);
    uint32_t *count = r->count[own];
    memset(count, 0, sizeof r->count[own]);
    for (size_t i = begin; i < end; i++) {
        count[(r->key[i] - r->least) >> r->shift & (N_DIGITS - 1)]++;
    }
    mpm_team_barrier(r->team, own, there);
    if (own == 0) {
        uint32_t sum = 0;
        for (int digit = 0; digit < N_DIGITS; digit++) {
            for (int k = 0; k < there; k++) {
                const uint32_t c = r->count[k][digit];
                r->count[k][digit] = sum;
                sum += c;
            }
        }
    }
    mpm_team_barrier(r->team, own, there);
    for (size_t i = begin; i < end; i++) {
        const uint32_t to = count[(r->key[i] - r->least) >> r->shift & (N_DIGITS - 1)]++;
        r->key_out[to] = r->key[i];
        r->from_out[to] = r->first ? (uint32_t)i : r->from[i];
    }
}

struct moving {
    const uint32_t *from;
    double *room, *field;
    size_t n;
    int components;
    struct mpm_team *team;
};

static void move_components(void *context, int own, int there) {
    const struct moving *m = context;
    const size_t begin = part_begin(m->n, own, there), end = part_begin(m->n, own + 1, there);
    for (int c = 0; c < m->components; c++) {
        for (size_t p = begin; p < end; p++) {
            m->room[p] = m->field[mpm_at(m->from[p], m->components, c)];
        }
        mpm_team_barrier(m->team, own, there); // the field is read
        for (size_t p = begin; p < end; p++) {
            m->field[mpm_at(p, m->components, c)] = m->room[p];
        }
    }
}

static void move_field(void *context, double *field, int components) {
    struct moving *m = context;
    m->field = field;
    m->components = components;
    mpm_team_run(m->team, move_components, m);
}

static void move_particles(struct mpm_particles *s, const uint32_t *from,
                           struct mpm_sorter *sorter) {
    // Both arrays of keys lie together: room for n doubles.
    struct moving m = {
        .from = from, .room = (double *)(void *)sorter->key[0], .n = s->n, .team = sorter->team};
    mpm_particles_each(s, move_field, &m);
    uint32_t *ids = sorter->key[0];
    for (size_t p = 0; p < s->n; p++) {
        ids[p] = s->id[from[p]];
    }
    memcpy(s->id, ids, s->n * sizeof *ids);
    for (size_t p = 0; s->at && p < s->n; p++) {
        s->at[s->id[p]] = (uint32_t)p;
    }
}

static bool find_tiles(struct mpm_order *order, const struct mpm_grid *g, const uint32_t *key,
                       size_t n) {
    const int bits = MPM_BLOCK_BITS(g->dim);
    order->n_tiles = 0;
    for (size_t p = 0; p < n;) {
        struct mpm_tile tile = {.begin = (uint32_t)p, .block = key[p] >> bits};
        for (; p < n && key[p] >> bits == tile.block; p++) {
            tile.cells |= (uint64_t)1 << (key[p] & ((1u << bits) - 1));
        }
        tile.end = (uint32_t)p;
        if (!mpm_order_reserve(order, order->n_tiles + 1)) {
            return false;
        }
        order->tile[order->n_tiles++] = tile;
    }
    return true;
}

bool mpm_order_sort(struct mpm_order *order, struct mpm_particles *s, const struct mpm_grid *grid,
                    enum mpm_basis basis, struct mpm_sorter *sorter) {
    const size_t n = s->n;
    uint32_t *key = sorter->key[0];
    mpm_team_run(sorter->team, find_keys, &(struct keying){s, grid, basis, key});
    uint32_t least = UINT32_MAX, most = 0;
    bool sorted = true;
    for (size_t p = 0; p < n; p++) {
        sorted &= p == 0 || key[p] >= key[p - 1];
        least = key[p] < least ? key[p] : least;
        most = key[p] > most ? key[p] : most;
    }
    if (sorted) {
        return find_tiles(order, grid, key, n);
    }
    int turn = 0;
    for (int shift = 0; shift < 32 && (most - least) >> shift > 0; shift += DIGIT, turn ^= 1) {
        struct radix_pass pass = {.key = sorter->key[turn],
                                  .from = sorter->from[turn],
                                  .key_out = sorter->key[!turn],
                                  .from_out = sorter->from[!turn],
                                  .count = (uint32_t(*)[N_DIGITS])(void *)sorter->count,
                                  .n = n,
                                  .least = least,
                                  .shift = shift,
                                  .first = shift == 0,
                                  .team = sorter->team};
        mpm_team_run(sorter->team, run_radix_pass, &pass);
    }
    const bool found = find_tiles(order, grid, sorter->key[turn], n);
    move_particles(s, sorter->from[turn], sorter);
    return found;
}

// The nodes that a particle of a cell can reach while it drifts by less than a cell are
// base - 1 .. base + support along each direction. As bits: which of the 3^dim blocks around its
// own they touch.
static uint32_t blocks_near(int cell, int support, int dim) {
    uint32_t near = 1;
    for (int d = 0; d < dim; d++) {
        const int base = cell >> 2 * (dim - 1 - d) & 3;
        const bool touched[3] = {base == 0, true, base + support >= MPM_EDGE};
        uint32_t wider = 0;
        for (uint32_t at = 0; at < 27; at++) {
            for (uint32_t k = 0; near >> at & 1 && k < 3; k++) {
                wider |= (uint32_t)touched[k] << (at * 3 + k);
            }
        }
        near = wider;
    }
    return near;
}

static bool activate(struct mpm_grid *grid, uint32_t block, uint32_t near) {
    int place[MPM_MAX_DIM] = {0}, at[MPM_MAX_DIM] = {0};
    mpm_grid_block_place(grid, block, place);
    for (int k = 0; k < (grid->dim == 2 ? 9 : 27); k++) {
        for (int d = grid->dim, rest = k; d-- > 0; rest /= 3) {
            at[d] = place[d] + rest % 3 - 1;
        }
        if (near >> k & 1 && !mpm_grid_activate(grid, at)) {
            return false;
        }
    }
    return true;
}

bool mpm_order_activate(const struct mpm_order *order, struct mpm_grid *grid,
                        enum mpm_basis basis) {
    uint32_t near[MPM_MAX_STENCIL] = {0};
    for (int cell = 0; cell < MPM_BLOCK_NODES(grid->dim); cell++) {
        near[cell] = blocks_near(cell, mpm_support(basis), grid->dim);
    }
    for (size_t k = 0; k < order->n_tiles; k++) {
        const struct mpm_tile *tile = &order->tile[k];
        uint32_t all = 0;
        for (int cell = 0; cell < MPM_BLOCK_NODES(grid->dim); cell++) {
            all |= tile->cells >> cell & 1 ? near[cell] : 0;
        }
        if (!activate(grid, tile->block, all)) {
            return false;
        }
    }
    return true;
}

bool mpm_activate_around(struct mpm_grid *grid, enum mpm_basis basis, const double *x) {
    int base[MPM_MAX_DIM];
    for (int d = 0; d < grid->dim; d++) {
        base[d] = (int)mpm_base(basis, (x[d] - grid->origin[d]) * grid->inv_h);
    }
    const uint32_t key = grid->dim == 2 ? mpm_cell_key(grid, base, 2) : mpm_cell_key(grid, base, 3);
    const int cell = (int)(key & (uint32_t)(MPM_BLOCK_NODES(grid->dim) - 1));
    return activate(grid, key >> MPM_BLOCK_BITS(grid->dim),
                    blocks_near(cell, mpm_support(basis), grid->dim));
}
