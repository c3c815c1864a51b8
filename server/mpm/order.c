// Sorting of particles by cell: radix sort of their keys, then one field at a time changes places.
#include "server/mpm/order.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/memory.h"

#define DIGIT 11 // bits of one pass of the radix sort: its counters fit the first-level cache
#define N_DIGITS (1 << DIGIT)
#define TILE_WORK 16 // particles' worth of what a tile costs besides, for sharing work out

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

void mpm_order_free(struct mpm_order *order) {
    free(order->tile);
    free(order->colour);
    free(order->before_begin);
    free(order->before);
    free(order->work_before);
    free(order->chunk);
    free(order->done);
    free(order->share);
    free(order->when);
    *order = (struct mpm_order){0};
}

// What is there is kept. False when memory is short.
static bool resize(void *array, size_t bytes) {
    void *moved = realloc(*(void **)array, bytes);
    if (moved) {
        *(void **)array = moved;
    }
    return moved != NULL;
}

bool mpm_order_reserve(struct mpm_order *order, size_t n) {
    if (n <= order->capacity) {
        return true;
    }
    const size_t room = n + n / 2 + 8;
    if (!resize(&order->tile, room * sizeof *order->tile) || !resize(&order->colour, room) ||
        !resize(&order->before_begin, (room + 1) * sizeof *order->before_begin) ||
        !resize(&order->work_before, (room + 1) * sizeof *order->work_before) ||
        !resize(&order->chunk, (room + 1) * sizeof *order->chunk) ||
        !resize(&order->done, room * MPM_APART * sizeof *order->done) ||
        !resize(&order->share, room * sizeof *order->share) || !resize(&order->when, room)) {
        return false;
    }
    order->capacity = room;
    return true;
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
    mpm_team_barrier(r->team, there);
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
    mpm_team_barrier(r->team, there);
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
        mpm_team_barrier(m->team, there); // the field is read
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

// Tiles of one colour are two blocks apart, of cubic B-splines three: a stencil of 3 nodes, from
// one cell before the block to one behind it, ends in the second node of the next block; one of 4
// would meet what comes from the block after that.
static int colours_along(enum mpm_basis basis) {
    return basis == MPM_BSPLINE3 ? 3 : 2;
}

// For all tiles at an offset, in blocks, from another one: how many of lower colour there are near
// each (before_begin[t + 1]), or, to `write`, which (before[before_begin[t]++]). Tiles ascend by
// block, and so do the blocks at one offset from them.
static void find_before(struct mpm_order *order, const struct mpm_grid *grid, const int *offset,
                        bool write) {
    int64_t distance = 0;
    for (int d = 0; d < grid->dim; d++) {
        distance = distance * grid->n_blocks[d] + offset[d];
    }
    size_t other = 0;
    for (size_t t = 0; t < order->n_tiles; t++) {
        int place[MPM_MAX_DIM];
        bool inside = true;
        mpm_grid_block_place(grid, order->tile[t].block, place);
        for (int d = 0; d < grid->dim; d++) {
            inside &= place[d] + offset[d] >= 0 && place[d] + offset[d] < (int)grid->n_blocks[d];
        }
        if (!inside) {
            continue;
        }
        const int64_t block = order->tile[t].block + distance;
        while (other < order->n_tiles && order->tile[other].block < block) {
            other++;
        }
        if (other < order->n_tiles && order->tile[other].block == block &&
            order->colour[other] < order->colour[t]) {
            if (write) {
                order->before[order->before_begin[t]++] = (uint32_t)other;
            } else {
                order->before_begin[t + 1]++;
            }
        }
    }
}

bool mpm_order_colour(struct mpm_order *order, const struct mpm_grid *grid, enum mpm_basis basis) {
    const int along = colours_along(basis), dim = grid->dim, width = 2 * along - 1;
    order->n_colours = dim == 2 ? along * along : along * along * along;
    order->n_chunks = 0;
    if (order->n_tiles == 0) {
        return true;
    }
    const size_t n = order->tile[order->n_tiles - 1].end;
    const size_t least = n / 16 < MPM_FEWEST ? MPM_FEWEST : n / 16 > MPM_MOST ? MPM_MOST : n / 16;
    uint64_t work = 0;
    for (size_t t = 0; t < order->n_tiles; t++) {
        int place[MPM_MAX_DIM], colour = 0;
        mpm_grid_block_place(grid, order->tile[t].block, place);
        for (int d = 0; d < dim; d++) {
            colour = colour * along + place[d] % along;
        }
        order->colour[t] = (uint8_t)colour;
        order->work_before[t] = work;
        work += order->tile[t].end - order->tile[t].begin + TILE_WORK;
        atomic_init(&order->done[t * MPM_APART], order->pass);
        const size_t last = order->n_chunks > 0 ? order->chunk[order->n_chunks - 1] : 0;
        if (order->n_chunks == 0 || order->tile[t].begin - order->tile[last].begin >= least) {
            order->chunk[order->n_chunks++] = (uint32_t)t;
        }
    }
    order->chunk[order->n_chunks] = (uint32_t)order->n_tiles;
    order->work_before[order->n_tiles] = work;
    memset(order->before_begin, 0, (order->n_tiles + 1) * sizeof *order->before_begin);
    for (int write = 0; write < 2; write++) { // first their numbers, then they themselves
        for (int k = 0; k < (dim == 2 ? width * width : width * width * width); k++) {
            int offset[MPM_MAX_DIM];
            for (int d = dim, rest = k; d-- > 0; rest /= width) {
                offset[d] = rest % width - (along - 1);
            }
            find_before(order, grid, offset, write);
        }
        if (write) { // each begin has moved on to the next one's
            memmove(order->before_begin + 1, order->before_begin,
                    order->n_tiles * sizeof *order->before_begin);
            order->before_begin[0] = 0;
            break;
        }
        for (size_t t = 0; t < order->n_tiles; t++) {
            order->before_begin[t + 1] += order->before_begin[t];
        }
        const size_t n_before = order->before_begin[order->n_tiles];
        if (n_before > order->before_capacity) {
            if (!resize(&order->before, (n_before + n_before / 2) * sizeof *order->before)) {
                return false;
            }
            order->before_capacity = n_before + n_before / 2;
        }
    }
    return true;
}

static uint64_t work_before_chunk(const struct mpm_order *order, size_t chunk) {
    return order->work_before[order->chunk[chunk]];
}

size_t mpm_order_cut(const struct mpm_order *order, double share) {
    if (order->n_tiles == 0) {
        return 0;
    }
    const double wanted = share * (double)order->work_before[order->n_tiles];
    size_t lo = 0, hi = order->n_chunks;
    while (lo < hi) { // the first chunk with at least so much before it
        const size_t middle = lo + (hi - lo) / 2;
        if ((double)work_before_chunk(order, middle) < wanted) {
            lo = middle + 1;
        } else {
            hi = middle;
        }
    }
    const bool nearer = lo > 0 && wanted - (double)work_before_chunk(order, lo - 1) <
                                      (double)work_before_chunk(order, lo) - wanted;
    return nearer ? lo - 1 : lo;
}

// When a part comes to a tile: first those that tiles of other parts wait for, last those that wait
// for tiles of other parts, each with what has to come before or after it.
enum when { BETWEEN, FIRST, LAST, PLACED };

static void find_first_and_last(struct mpm_order *order, const uint32_t *parts, int n) {
    memset(order->when, BETWEEN, order->n_tiles);
    for (int k = 0; k < n; k++) {
        const size_t begin = order->chunk[parts[k]], end = order->chunk[parts[k + 1]];
        for (size_t t = begin; t < end; t++) {
            for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
                const uint32_t q = order->before[b];
                if (q < begin || q >= end) {
                    order->when[q] = FIRST;
                    order->when[t] = order->when[t] == FIRST ? FIRST : LAST;
                }
            }
        }
    }
    for (int step = 0; step < 2 * order->n_colours; step++) { // colours down, then up
        const bool down = step < order->n_colours;
        const int colour = down ? order->n_colours - 1 - step : step - order->n_colours;
        for (int k = 0; k < n; k++) {
            const size_t begin = order->chunk[parts[k]], end = order->chunk[parts[k + 1]];
            for (size_t t = begin; t < end; t++) {
                if (order->colour[t] != colour || (down && order->when[t] != FIRST)) {
                    continue;
                }
                for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
                    const uint32_t q = order->before[b];
                    if (down && q >= begin && q < end) {
                        order->when[q] = FIRST;
                    } else if (!down && order->when[q] == LAST && order->when[t] != FIRST) {
                        order->when[t] = LAST;
                    }
                }
            }
        }
    }
}

// The tiles of a part that are done at a time, by colour; shared out from `at` on. Returns where
// they end.
static size_t share_by_colour(struct mpm_order *order, size_t begin, size_t end, enum when when,
                              size_t at) {
    for (int colour = 0; colour < order->n_colours; colour++) {
        for (size_t t = begin; t < end; t++) {
            if (order->colour[t] == colour && order->when[t] == when) {
                order->share[at++] = (uint32_t)t;
            }
        }
    }
    return at;
}

// A tile, after those that it waits for, which have lower colours: the calls end soon.
static size_t share_in_place(struct mpm_order *order, size_t t, size_t at) {
    order->when[t] = PLACED;
    for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
        if (order->when[order->before[b]] == BETWEEN) {
            at = share_in_place(order, order->before[b], at);
        }
    }
    order->share[at] = (uint32_t)t;
    return at + 1;
}

void mpm_order_share(struct mpm_order *order, const uint32_t *parts, int n) {
    if (order->n_tiles == 0) {
        return;
    }
    find_first_and_last(order, parts, n);
    for (int k = 0; k < n; k++) {
        const size_t begin = order->chunk[parts[k]], end = order->chunk[parts[k + 1]];
        size_t at = share_by_colour(order, begin, end, FIRST, begin);
        for (size_t t = begin; t < end; t++) {
            if (order->when[t] == BETWEEN) {
                at = share_in_place(order, t, at);
            }
        }
        share_by_colour(order, begin, end, LAST, at);
    }
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
