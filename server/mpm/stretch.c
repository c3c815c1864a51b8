// Stretches of particles, the units of the work that adds to the grid: what each has to wait for,
// and which thread does which, when.
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/order.h"

#define SHORTEST (2 * MPM_BATCH) // particles
#define LONGEST 512              // in a body of many
// For sharing work out: what these cost besides, as particles.
#define STRETCH_WORK 12
#define CUT_WORK 32  // a cut within a row, along which more nodes are common to the parts
#define HOP_WORK 128 // until what one thread has done is where another needs it

// A thread's part of the stretches, while it is shared out.
struct mpm_part {
    size_t begin, end;  // stretches
    size_t n_placed;    // from the begin of its `share` on
    size_t n_tied;      // to other parts and not placed: up to the end of its `share`
    size_t untied;      // before this all that are not tied are placed
    uint64_t clock;     // work at which its thread is done with what is placed
    uint64_t next_look; // and at which it looks for more
};

void mpm_order_free(struct mpm_order *order) {
    free(order->tile);
    free(order->stretch);
    free(order->colour);
    free(order->before_begin);
    free(order->before);
    free(order->work_before);
    free(order->chunk);
    free(order->done);
    free(order->share);
    free(order->flag);
    free(order->ties);
    free(order->ended);
    free(order->parts);
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
    if (n > order->tile_capacity) {
        const size_t room = n + n / 2 + 8;
        if (!resize(&order->tile, room * sizeof *order->tile)) {
            return false;
        }
        order->tile_capacity = room;
    }
    return true;
}

static bool reserve_stretches(struct mpm_order *order, size_t n) {
    if (n <= order->capacity) {
        return true;
    }
    const size_t room = n + n / 2 + 8;
    if (!resize(&order->stretch, room * sizeof *order->stretch) || !resize(&order->colour, room) ||
        !resize(&order->before_begin, (room + 1) * sizeof *order->before_begin) ||
        !resize(&order->work_before, (room + 1) * sizeof *order->work_before) ||
        !resize(&order->chunk, (room + 1) * sizeof *order->chunk) ||
        !resize(&order->share, room * sizeof *order->share) ||
        !resize(&order->flag, room * sizeof *order->flag) || !resize(&order->ties, room) ||
        !resize(&order->ended, room * sizeof *order->ended)) {
        return false;
    }
    order->capacity = room;
    return true;
}

// ---- Finding ----

// Blocks of a row follow each other along the last direction.
static uint32_t blocks_of_row(const struct mpm_grid *grid) {
    return (uint32_t)grid->n_blocks[grid->dim - 1];
}

// Stencils of particles that are in blocks so far apart reach no common node: a stencil of 3 nodes,
// from one cell before the block to one behind it, ends in the second node of the next block; one
// of 4 would meet what comes from the block after that.
static int apart(enum mpm_basis basis) {
    return basis == MPM_BSPLINE3 ? 3 : 2;
}

// Whole batches from the first one that a row has particles of, so that no lane of a vector is idle
// but at a row's ends; the last stretch of a row takes what would be left over. Rows far from each
// other can have one colour, and so can the even stretches of a row and its odd ones.
static bool find_stretches(struct mpm_order *order, const struct mpm_grid *grid,
                           enum mpm_basis basis) {
    const int along = apart(basis), dim = grid->dim;
    const size_t n = order->n_tiles > 0 ? order->tile[order->n_tiles - 1].end : 0;
    size_t length = n / 64 / MPM_BATCH * MPM_BATCH;
    length = length < SHORTEST ? SHORTEST : length > LONGEST ? LONGEST : length;
    order->n_stretches = 0;
    order->n_colours = 2 * (dim == 2 ? along : along * along);
    for (size_t t = 0; t < order->n_tiles;) {
        const uint32_t row = order->tile[t].block / blocks_of_row(grid);
        size_t end = t; // of the row's tiles
        while (end < order->n_tiles && order->tile[end].block / blocks_of_row(grid) == row) {
            end++;
        }
        int place[MPM_MAX_DIM], colour = 0;
        mpm_grid_block_place(grid, order->tile[t].block, place);
        for (int d = 0; d < dim - 1; d++) {
            colour = colour * along + place[d] % along;
        }
        const uint32_t begin = order->tile[t].begin, past = order->tile[end - 1].end;
        const size_t number = (past - begin) / length;
        for (size_t k = 0; k == 0 || k < number; k++) {
            if (!reserve_stretches(order, order->n_stretches + 1)) {
                return false;
            }
            struct mpm_stretch stretch = {.begin = begin, .end = past, .row = row};
            if (k > 0) {
                stretch.begin = order->stretch[order->n_stretches - 1].end;
            }
            if (k + 1 < number) {
                stretch.end = (uint32_t)(begin / MPM_BLOCK * MPM_BLOCK + (k + 1) * length);
            }
            while (order->tile[t].end <= stretch.begin) {
                t++;
            }
            stretch.first = order->tile[t].block;
            while (order->tile[t].end < stretch.end) {
                t++;
            }
            stretch.last = order->tile[t].block;
            order->colour[order->n_stretches] = (uint8_t)(2 * colour + (int)(k & 1));
            order->stretch[order->n_stretches++] = stretch;
        }
        t = end;
    }
    return true;
}

// ---- What each waits for ----

static bool comes_before(const struct mpm_order *order, size_t a, size_t b) {
    return order->colour[a] < order->colour[b] || (order->colour[a] == order->colour[b] && a < b);
}

// For all stretches, in the row at an offset, in blocks, from theirs: how many near each come
// before it (before_begin[t + 1]), or, to `write`, which (before[before_begin[t]++]). Stretches
// ascend by row and by block, and so do those at one offset from them.
static void find_before(struct mpm_order *order, const struct mpm_grid *grid, const int *offset,
                        int apart, bool write) {
    int64_t distance = 0;
    for (int d = 0; d < grid->dim - 1; d++) {
        distance = distance * grid->n_blocks[d] + offset[d];
    }
    size_t other = 0;
    for (size_t t = 0; t < order->n_stretches; t++) {
        const struct mpm_stretch *own = &order->stretch[t];
        int place[MPM_MAX_DIM];
        bool inside = true;
        mpm_grid_block_place(grid, own->first, place);
        for (int d = 0; d < grid->dim - 1; d++) {
            inside &= place[d] + offset[d] >= 0 && place[d] + offset[d] < (int)grid->n_blocks[d];
        }
        if (!inside) {
            continue;
        }
        // Places in that row, as blocks: those of the own row's, moved.
        const int64_t row = own->row + distance, width = blocks_of_row(grid);
        const int64_t move = distance * width;
        const int64_t from = own->first + move - (apart - 1), to = own->last + move + (apart - 1);
        while (other < order->n_stretches &&
               (order->stretch[other].row < row ||
                (order->stretch[other].row == row && order->stretch[other].last < from))) {
            other++;
        }
        for (size_t q = other; q < order->n_stretches && order->stretch[q].first <= to &&
                               order->stretch[q].row == row;
             q++) {
            if (!comes_before(order, q, t)) {
                continue;
            }
            if (write) {
                order->before[order->before_begin[t]++] = (uint32_t)q;
            } else {
                order->before_begin[t + 1]++;
            }
        }
    }
}

static bool find_all_before(struct mpm_order *order, const struct mpm_grid *grid,
                            enum mpm_basis basis) {
    const int along = apart(basis), dim = grid->dim, width = 2 * along - 1;
    const size_t n = order->n_stretches;
    memset(order->before_begin, 0, (n + 1) * sizeof *order->before_begin);
    for (int write = 0; write < 2; write++) { // first their numbers, then they themselves
        for (int k = 0; k < (dim == 2 ? width : width * width); k++) {
            int offset[MPM_MAX_DIM];
            for (int d = dim - 1, rest = k; d-- > 0; rest /= width) {
                offset[d] = rest % width - (along - 1);
            }
            find_before(order, grid, offset, along, write);
        }
        if (write) { // each begin has moved on to the next one's
            memmove(order->before_begin + 1, order->before_begin, n * sizeof *order->before_begin);
            order->before_begin[0] = 0;
            break;
        }
        for (size_t t = 0; t < n; t++) {
            order->before_begin[t + 1] += order->before_begin[t];
        }
        const size_t n_before = order->before_begin[n];
        if (n_before > order->before_capacity) {
            if (!resize(&order->before, (n_before + n_before / 2) * sizeof *order->before)) {
                return false;
            }
            order->before_capacity = n_before + n_before / 2;
        }
    }
    return true;
}

bool mpm_order_stretches(struct mpm_order *order, const struct mpm_grid *grid, enum mpm_basis basis,
                         int n_threads) {
    order->n_chunks = 0;
    if (!find_stretches(order, grid, basis)) {
        return false;
    }
    const size_t n_flags = order->capacity + (size_t)n_threads * MPM_APART;
    if (n_flags > order->n_flags) {
        if (!resize(&order->done, n_flags * sizeof *order->done)) {
            return false;
        }
        order->n_flags = n_flags;
    }
    if (n_threads > order->most_parts) {
        if (!resize(&order->parts, (size_t)n_threads * sizeof *order->parts)) {
            return false;
        }
        order->most_parts = n_threads;
    }
    if (order->n_stretches == 0) {
        return true;
    }
    const size_t n = order->stretch[order->n_stretches - 1].end;
    const size_t least = n / 32 < MPM_FEWEST ? MPM_FEWEST : n / 32 > MPM_MOST ? MPM_MOST : n / 32;
    uint64_t work = 0;
    for (size_t t = 0; t < order->n_stretches; t++) {
        order->work_before[t] = work;
        work += order->stretch[t].end - order->stretch[t].begin + STRETCH_WORK;
        const size_t last = order->n_chunks > 0 ? order->chunk[order->n_chunks - 1] : 0;
        if (order->n_chunks == 0 || order->stretch[t].begin - order->stretch[last].begin >= least) {
            order->chunk[order->n_chunks++] = (uint32_t)t;
        }
    }
    order->chunk[order->n_chunks] = (uint32_t)order->n_stretches;
    order->work_before[order->n_stretches] = work;
    return find_all_before(order, grid, basis);
}

// ---- Sharing out ----

static uint64_t work_before_chunk(const struct mpm_order *order, size_t chunk) {
    return order->work_before[order->chunk[chunk]];
}

static bool begins_row(const struct mpm_order *order, size_t chunk) {
    const size_t t = order->chunk[chunk];
    return t == 0 || t == order->n_stretches || order->stretch[t].row != order->stretch[t - 1].row;
}

size_t mpm_order_cut(const struct mpm_order *order, double share) {
    if (order->n_stretches == 0) {
        return 0;
    }
    const double wanted = share * (double)order->work_before[order->n_stretches];
    size_t best = 0;
    double least = INFINITY;
    for (size_t chunk = 0; chunk <= order->n_chunks; chunk++) {
        const double off = fabs((double)work_before_chunk(order, chunk) - wanted);
        const double cost = begins_row(order, chunk) ? off : off + CUT_WORK;
        if (cost < least) {
            least = cost;
            best = chunk;
        }
    }
    return best;
}

static bool is_of(const struct mpm_part *part, uint32_t t) {
    return t >= part->begin && t < part->end;
}

// What of other parts waits for t, or t for it, by itself or through others of t's part.
static void find_ties(struct mpm_order *order, const struct mpm_part *parts, int n) {
    memset(order->ties, 0, order->n_stretches);
    for (int colour = order->n_colours; colour-- > 0;) { // from what comes last
        for (int k = n; k-- > 0;) {
            for (size_t t = parts[k].end; t-- > parts[k].begin;) {
                for (uint32_t b = order->before_begin[t];
                     order->colour[t] == colour && b < order->before_begin[t + 1]; b++) {
                    const uint32_t q = order->before[b];
                    if (!is_of(&parts[k], q) || (order->ties[t] & MPM_AWAITED)) {
                        order->ties[q] |= MPM_AWAITED;
                    }
                }
            }
        }
    }
    for (int colour = 0; colour < order->n_colours; colour++) {
        for (int k = 0; k < n; k++) {
            for (size_t t = parts[k].begin; t < parts[k].end; t++) {
                for (uint32_t b = order->before_begin[t];
                     order->colour[t] == colour && b < order->before_begin[t + 1]; b++) {
                    const uint32_t q = order->before[b];
                    if (!is_of(&parts[k], q) || (order->ties[q] & MPM_AWAITS)) {
                        order->ties[t] |= MPM_AWAITS;
                    }
                }
            }
        }
    }
}

// The tied ones of a part by colour: first those that others wait for.
static void list_tied(struct mpm_order *order, struct mpm_part *part) {
    for (size_t t = part->begin; t < part->end; t++) {
        part->n_tied += order->ties[t] != 0;
    }
    size_t at = part->end - part->n_tied;
    for (int awaited = MPM_AWAITED; awaited >= 0; awaited -= MPM_AWAITED) {
        for (int colour = 0; colour < order->n_colours; colour++) {
            for (size_t t = part->begin; t < part->end; t++) {
                if (order->colour[t] == colour && order->ties[t] &&
                    (order->ties[t] & MPM_AWAITED) == awaited) {
                    order->share[at++] = (uint32_t)t;
                }
            }
        }
    }
}

#define NEVER UINT64_MAX

// When all that t waits for is done, and known to be where t is done.
static uint64_t ready_at(const struct mpm_order *order, const struct mpm_part *part, uint32_t t) {
    uint64_t ready = 0;
    for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
        const uint32_t q = order->before[b];
        if (order->ended[q] == NEVER) {
            return NEVER;
        }
        const uint64_t at = order->ended[q] + (is_of(part, q) ? 0 : HOP_WORK);
        ready = at > ready ? at : ready;
    }
    return ready;
}

static void place(struct mpm_order *order, struct mpm_part *part, uint32_t t) {
    part->clock = part->next_look + order->stretch[t].end - order->stretch[t].begin + STRETCH_WORK;
    part->next_look = part->clock;
    order->ended[t] = part->clock;
    order->share[part->begin + part->n_placed++] = t;
}

static void place_tied(struct mpm_order *order, struct mpm_part *part, size_t i) {
    uint32_t *tied = order->share + part->end - part->n_tied;
    const uint32_t t = tied[i];
    memmove(tied + 1, tied, i * sizeof *tied);
    part->n_tied--;
    place(order, part, t);
}

// What t waits for that is not yet placed, or itself.
static uint32_t first_of(const struct mpm_order *order, uint32_t t) {
    for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
        if (order->ended[order->before[b]] == NEVER) {
            return order->before[b];
        }
    }
    return t;
}

// The next untied stretch near the order of memory, after those that it waits for.
static bool place_untied(struct mpm_order *order, struct mpm_part *part) {
    for (size_t i = part->untied; i < part->end; i++) {
        if (order->ties[i] || order->ended[i] != NEVER) {
            part->untied += i == part->untied;
            continue;
        }
        uint32_t t = (uint32_t)i, first;
        while ((first = first_of(order, t)) != t) {
            t = first;
        }
        if (!order->ties[t]) {
            place(order, part, t);
            return true;
        }
    }
    return false;
}

// What a part's thread takes up next: what others wait for, if it can; else what is not tied to
// others; else what waits for them. If it can none of these, it looks again when it can. It begins
// with one that is not tied, while the nodes of the next are on their way.
static bool place_next(struct mpm_order *order, struct mpm_part *part) {
    const uint32_t *tied = order->share + part->end - part->n_tied;
    size_t next = part->n_tied;
    uint64_t soonest = NEVER;
    if (part->n_placed == 0 && place_untied(order, part)) {
        return true;
    }
    for (size_t i = 0; i < part->n_tied; i++) {
        const uint64_t ready = ready_at(order, part, tied[i]);
        if (ready <= part->next_look && (order->ties[tied[i]] & MPM_AWAITED)) {
            place_tied(order, part, i);
            return true;
        }
        next = ready <= part->next_look && next == part->n_tied ? i : next;
        soonest = ready < soonest ? ready : soonest;
    }
    if (place_untied(order, part)) {
        return true;
    }
    if (next < part->n_tied) {
        place_tied(order, part, next);
        return true;
    }
    part->next_look = soonest;
    return false;
}

// All parts are gone through side by side, as their threads will: so that of all stretches that are
// not done, the one that comes first here waits for none, and is the next of its part.
void mpm_order_share(struct mpm_order *order, const uint32_t *cuts, int n) {
    struct mpm_part *parts = order->parts;
    if (order->n_stretches == 0) {
        return;
    }
    for (int k = 0; k < n; k++) {
        const size_t begin = order->chunk[cuts[k]];
        parts[k] =
            (struct mpm_part){.begin = begin, .end = order->chunk[cuts[k + 1]], .untied = begin};
    }
    find_ties(order, parts, n);
    for (int k = 0; k < n; k++) {
        list_tied(order, &parts[k]);
    }
    for (size_t t = 0; t < order->n_stretches; t++) {
        order->ended[t] = NEVER;
    }
    for (size_t placed = 0; placed < order->n_stretches;) {
        struct mpm_part *part = NULL; // that looks first
        for (int k = 0; k < n; k++) {
            if (parts[k].begin + parts[k].n_placed < parts[k].end &&
                (!part || parts[k].next_look < part->next_look)) {
                part = &parts[k];
            }
        }
        if (place_next(order, part)) {
            placed++;
            for (int k = 0; k < n; k++) {
                parts[k].next_look = parts[k].clock; // it may be able to go on
            }
        }
    }
    for (int k = 0; k < n; k++) {
        for (size_t i = parts[k].begin; i < parts[k].end; i++) {
            order->flag[order->share[i]] = (uint32_t)(i + (size_t)k * MPM_APART);
            atomic_init(&order->done[i + (size_t)k * MPM_APART], 0);
        }
    }
}
