// Wall conditions on the grid: direct for uGIMP and linear, mirror-folded for B-splines (direct
// there, too, where the scene asks for it).
#include "server/mpm/boundary.h"

#include <stdlib.h>
#include <string.h>

void mpm_wall_create(struct mpm_wall *wall, const struct mpm_def *whole, size_t number,
                     const struct mpm_grid *grid, bool wants_reaction) {
    const struct mpm_wall_def *def = &whole->walls[number];
    *wall = (struct mpm_wall){.def = *def,
                              .active = true,
                              .wants_reaction = wants_reaction,
                              .n_threads = whole->n_threads};
    const int axis = def->axis;
    wall->plane = (int)lround((def->at - grid->origin[axis]) * grid->inv_h);
    wall->ghost = wall->plane + (def->keeps_above ? -1 : 1);
    wall->inner = wall->plane + (def->keeps_above ? 1 : -1);
    wall->folds =
        (whole->basis == MPM_BSPLINE2 || whole->basis == MPM_BSPLINE3) && !whole->walls_hold_nodes;
    for (int d = 0; d < MPM_MAX_DIM; d++) {
        wall->lo[d] = 0;
        wall->hi[d] = grid->n[d];
        if (d == axis || d >= grid->dim) {
            continue;
        }
        if (def->has_span) {
            const double slack = 1e-9; // cells: an end that is meant to be a node is one
            const double from = (def->span_min[d] - grid->origin[d]) * grid->inv_h;
            const double to = (def->span_max[d] - grid->origin[d]) * grid->inv_h;
            wall->lo[d] = (int)fmax(0, ceil(from - slack));
            wall->hi[d] = (int)fmin(grid->n[d], floor(to + slack) + 1);
        }
    }
    for (int d = 0; d < grid->dim; d++) {
        wall->wants_reaction |= def->velocity[d] != 0;
    }
}

void mpm_wall_free(struct mpm_wall *wall) {
    free(wall->column);
    free(wall->beyond);
    free(wall->real);
    free(wall->open);
    free(wall->columns_of.item);
    free(wall->columns_of.begin);
    free(wall->beyond_of.item);
    free(wall->beyond_of.begin);
    *wall = (struct mpm_wall){0};
}

// ---- The walls' nodes ----

// Whether a place lies within the wall in all directions but its normal.
static bool in_span(const struct mpm_wall *w, const int *place, int dim) {
    for (int d = 0; d < dim; d++) {
        if (d != w->def.axis && (place[d] < w->lo[d] || place[d] >= w->hi[d])) {
            return false;
        }
    }
    return true;
}

// The same of any node of a block.
static bool block_in_span(const struct mpm_wall *w, const int *block, int dim) {
    for (int d = 0; d < dim; d++) {
        if (d != w->def.axis &&
            (block[d] * MPM_EDGE + MPM_EDGE - 1 < w->lo[d] || block[d] * MPM_EDGE >= w->hi[d])) {
            return false;
        }
    }
    return true;
}

bool mpm_walls_activate(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g) {
    uint32_t before;
    do { // what one wall adds may touch another
        before = g->n_slots;
        for (size_t k = 0; k < n_walls; k++) {
            const struct mpm_wall *w = &walls[k];
            const int planes[] = {w->ghost, w->plane, w->inner}, axis = w->def.axis;
            for (uint32_t s = 1; w->active && w->folds && s < g->n_slots; s++) {
                int block[MPM_MAX_DIM];
                mpm_grid_block_place(g, g->block[s], block);
                const int first = block[axis] * MPM_EDGE;
                bool near = false;
                for (int q = 0; q < 3; q++) {
                    near |= planes[q] >= first && planes[q] < first + MPM_EDGE;
                }
                if (!near || !block_in_span(w, block, g->dim)) {
                    continue;
                }
                for (int q = 0; q < 3; q++) {
                    block[axis] = planes[q] / MPM_EDGE;
                    if (!mpm_grid_activate(g, block)) {
                        return false;
                    }
                }
            }
        }
    } while (g->n_slots > before);
    return true;
}

// Room for element n; what is new is not set.
static bool room_for(void *array, size_t n, size_t *capacity, size_t width) {
    if (n < *capacity) {
        return true;
    }
    const size_t wider = n + n / 2 + 64;
    void *memory = realloc(*(void **)array, wider * width);
    if (memory) {
        *(void **)array = memory;
        *capacity = wider;
    }
    return memory != NULL;
}

static int by_plane(const void *one, const void *other) {
    const uint32_t a = ((const struct mpm_column *)one)->plane,
                   b = ((const struct mpm_column *)other)->plane;
    return (a > b) - (a < b);
}

// The column through a place, or NULL where the plane's node does not exist. Columns ascend by
// their plane node, as the blocks do.
static const struct mpm_column *column_through(const struct mpm_wall *w, const struct mpm_grid *g,
                                               const int *place) {
    int at[MPM_MAX_DIM] = {place[0], place[1], place[2]};
    at[w->def.axis] = w->plane;
    const struct mpm_column key = {.plane = mpm_node_at(g, at)};
    return bsearch(&key, w->column, w->n_columns, sizeof key, by_plane);
}

static bool add_column(struct mpm_wall *w, const struct mpm_grid *g, const int *place) {
    const int axis = w->def.axis;
    struct mpm_column c = {.plane = mpm_node_at(g, place)};
    memcpy(c.place, place, sizeof c.place);
    if (w->folds) {
        int at[MPM_MAX_DIM] = {place[0], place[1], place[2]};
        at[axis] = w->ghost;
        c.ghost = mpm_node_at(g, at);
        at[axis] = w->inner;
        c.inner = mpm_node_at(g, at);
    }
    if (!room_for(&w->column, w->n_columns, &w->capacity, sizeof c)) {
        return false;
    }
    w->column[w->n_columns++] = c;
    return true;
}

// Calls `add` for every existing node within the wall's span whose place along the axis lies in
// [first, last].
static bool each_node(struct mpm_wall *w, const struct mpm_grid *g, int first, int last,
                      bool (*add)(struct mpm_wall *, const struct mpm_grid *, const int *)) {
    const int dim = g->dim, axis = w->def.axis;
    for (uint32_t s = 1; s < g->n_slots; s++) {
        int block[MPM_MAX_DIM], place[MPM_MAX_DIM] = {0};
        mpm_grid_block_place(g, g->block[s], block);
        if (block[axis] * MPM_EDGE > last || block[axis] * MPM_EDGE + MPM_EDGE - 1 < first ||
            !block_in_span(w, block, dim)) {
            continue;
        }
        for (int i = 0; i < MPM_BLOCK_NODES(dim); i++) {
            for (int d = 0; d < dim; d++) {
                place[d] = block[d] * MPM_EDGE + (i >> 2 * (dim - 1 - d) & 3);
            }
            if (place[axis] >= first && place[axis] <= last && in_span(w, place, dim) &&
                !add(w, g, place)) {
                return false;
            }
        }
    }
    return true;
}

static bool add_beyond(struct mpm_wall *w, const struct mpm_grid *g, const int *place) {
    const struct mpm_column *through = column_through(w, g, place);
    if (!room_for(&w->beyond, w->n_beyond, &w->beyond_capacity, sizeof *w->beyond)) {
        return false;
    }
    w->beyond[w->n_beyond++] = (struct mpm_beyond){
        .node = mpm_node_at(g, place),
        .column = through ? (uint32_t)(through - w->column) : UINT32_MAX,
    };
    return true;
}

static bool find_nodes(struct mpm_wall *w, const struct mpm_grid *g) {
    const int end = g->n[w->def.axis] - 1;
    const size_t before = w->capacity;
    w->n_columns = w->n_beyond = 0;
    if (!w->active) {
        return true;
    }
    if (!w->folds) { // all nodes on it and beyond
        return each_node(w, g, w->def.keeps_above ? 0 : w->plane,
                         w->def.keeps_above ? w->plane : end, add_column);
    }
    if (!each_node(w, g, w->plane, w->plane, add_column) ||
        !each_node(w, g, w->def.keeps_above ? 0 : w->ghost + 1,
                   w->def.keeps_above ? w->ghost - 1 : end, add_beyond)) {
        return false;
    }
    if (w->capacity > before) {
        free(w->real);
        free(w->open);
        const bool separates = w->def.condition == MPM_WALL_SEPARATE;
        w->open = separates ? calloc(w->capacity, 1) : NULL;
        w->real = w->wants_reaction
                      ? calloc(w->capacity * 3 * (size_t)(1 + g->dim), sizeof *w->real)
                      : NULL;
        if ((separates && !w->open) || (w->wants_reaction && !w->real)) {
            w->capacity = 0;
            return false;
        }
    }
    return true;
}

// Behind the items there is room for their owners.
static bool room_to_share(struct mpm_shares *shares, size_t n, int n_threads) {
    if (!shares->begin) {
        shares->begin = calloc((size_t)n_threads + 2, sizeof *shares->begin);
    }
    return shares->begin && room_for(&shares->item, 2 * n, &shares->capacity, sizeof *shares->item);
}

bool mpm_walls_find_nodes(struct mpm_wall *walls, size_t n_walls, const struct mpm_grid *g) {
    for (size_t k = 0; k < n_walls; k++) {
        struct mpm_wall *w = &walls[k];
        if (!find_nodes(w, g) || !room_to_share(&w->columns_of, w->n_columns, w->n_threads) ||
            !room_to_share(&w->beyond_of, w->n_beyond, w->n_threads)) {
            return false;
        }
    }
    return true;
}

// ---- Who sees to what ----

// A box of nodes that holds whatever depends on one another: what lies on a wall's planes or behind
// it hangs together with all three planes.
struct box {
    int lo[MPM_MAX_DIM], hi[MPM_MAX_DIM];
};

static bool widen(struct box *box, const struct mpm_wall *w) {
    int *lo = &box->lo[w->def.axis], *hi = &box->hi[w->def.axis];
    const int first = w->plane - 1, last = w->plane + 1;
    if (w->def.keeps_above ? *lo > last : *hi < first) {
        return false;
    }
    const bool wider = *lo > first || *hi < last;
    *lo = *lo > first ? first : *lo;
    *hi = *hi < last ? last : *hi;
    return wider;
}

// The thread that has all nodes of the box, or n.
static int owner_of(const struct box *box, const struct mpm_grid *g, const uint32_t *cut, int n) {
    int from[MPM_MAX_DIM] = {0}, to[MPM_MAX_DIM] = {0}, at[MPM_MAX_DIM], owner = -1;
    for (int d = 0; d < g->dim; d++) {
        from[d] = (box->lo[d] > 0 ? box->lo[d] : 0) / MPM_EDGE;
        to[d] = box->hi[d] / MPM_EDGE;
        to[d] = to[d] < g->n_blocks[d] ? to[d] : g->n_blocks[d] - 1;
    }
    for (at[0] = from[0]; at[0] <= to[0]; at[0]++) {
        for (at[1] = from[1]; at[1] <= to[1]; at[1]++) {
            for (at[2] = from[2]; at[2] <= to[2]; at[2]++) {
                uint32_t block = 0;
                for (int d = 0; d < g->dim; d++) {
                    block = block * (uint32_t)g->n_blocks[d] + (uint32_t)at[d];
                }
                const uint32_t slot = g->slot[block];
                int part = 0;
                while (slot > 0 && slot >= cut[part + 1]) {
                    part++;
                }
                if (slot > 0 && owner >= 0 && part != owner) {
                    return n;
                }
                owner = slot > 0 ? part : owner;
            }
        }
    }
    return owner >= 0 ? owner : n;
}

static int owner_of_place(const struct mpm_wall *walls, size_t n_walls, const int *place,
                          const struct mpm_grid *g, const uint32_t *cut, int n) {
    struct box box;
    memcpy(box.lo, place, sizeof box.lo);
    memcpy(box.hi, place, sizeof box.hi);
    for (bool wider = walls->folds; wider;) {
        wider = false;
        for (size_t k = 0; k < n_walls; k++) {
            wider |= walls[k].active && widen(&box, &walls[k]);
        }
    }
    return owner_of(&box, g, cut, n);
}

static void place_of_node(const struct mpm_grid *g, uint32_t node, int *place) {
    const uint32_t nodes = (uint32_t)MPM_BLOCK_NODES(g->dim), in = node % nodes;
    memset(place, 0, MPM_MAX_DIM * sizeof *place);
    mpm_grid_block_place(g, g->block[node / nodes], place);
    for (int d = 0; d < g->dim; d++) {
        place[d] = place[d] * MPM_EDGE + (int)(in >> 2 * (g->dim - 1 - d) & 3);
    }
}

// Whose a place is: 0 .. n - 1, or n, which is all of them. `sums`: a wall adds to a reaction.
static uint32_t share_of(const struct mpm_wall *walls, size_t n_walls, const int *place,
                         const struct mpm_grid *g, const uint32_t *cut, int n, bool sums) {
    if (n == 1) {
        return 0;
    }
    return (uint32_t)(sums ? n : owner_of_place(walls, n_walls, place, g, cut, n));
}

// Owners (n_items), 0 .. n, to lists.
static void list_by_owner(struct mpm_shares *shares, const uint32_t *owner, size_t n_items, int n) {
    memset(shares->begin, 0, ((size_t)n + 2) * sizeof *shares->begin);
    for (size_t i = 0; i < n_items; i++) {
        shares->begin[owner[i] + 1]++;
    }
    for (int k = 0; k <= n; k++) {
        shares->begin[k + 1] += shares->begin[k];
    }
    for (size_t i = 0; i < n_items; i++) {
        shares->item[shares->begin[owner[i]]++] = (uint32_t)i;
    }
    for (int k = n + 1; k > 0; k--) { // each begin has moved on to the next one's
        shares->begin[k] = shares->begin[k - 1];
    }
    shares->begin[0] = 0;
}

bool mpm_walls_share(struct mpm_wall *walls, size_t n_walls, const struct mpm_grid *g,
                     const uint32_t *cut, int n) {
    bool sums = false, any_common = false; // with reactions, all of it goes in one order
    for (size_t k = 0; k < n_walls; k++) {
        sums |= walls[k].active && walls[k].wants_reaction;
    }
    for (size_t k = 0; k < n_walls; k++) {
        struct mpm_wall *w = &walls[k];
        uint32_t *owner = w->columns_of.item + w->n_columns;
        for (size_t i = 0; i < w->n_columns; i++) {
            owner[i] = share_of(walls, n_walls, w->column[i].place, g, cut, n, sums);
        }
        list_by_owner(&w->columns_of, owner, w->n_columns, n);
        owner = w->beyond_of.item + w->n_beyond;
        for (size_t i = 0; i < w->n_beyond; i++) {
            int place[MPM_MAX_DIM];
            place_of_node(g, w->beyond[i].node, place);
            owner[i] = share_of(walls, n_walls, place, g, cut, n, sums);
        }
        list_by_owner(&w->beyond_of, owner, w->n_beyond, n);
        w->n_parts = n;
        if (!w->wants_reaction) {
            memset(w->reaction, 0, sizeof w->reaction);
        }
        any_common |= w->columns_of.begin[n] < w->n_columns || w->beyond_of.begin[n] < w->n_beyond;
    }
    return any_common;
}

// ---- Conditions ----

// +1 where the component is the same in the mirror image, -1 where it changes sign.
static double parity(const struct mpm_wall *w, int component) {
    return component == w->def.axis || w->def.condition == MPM_WALL_FIXED ? -1 : 1;
}

// Each index of a part's columns, or nodes beyond.
#define FOR_ITEMS(i, shares, part)                                                                 \
    for (const uint32_t *i = (shares).item + (shares).begin[part],                                 \
                        *end_ = (shares).item + (shares).begin[(part) + 1];                        \
         i < end_; i++)

static double *sums(const struct mpm_grid *g, uint32_t node) {
    return g->node + (size_t)node * MPM_NODE;
}

static double *result(const struct mpm_grid *g, uint32_t node) {
    return g->velocity + (size_t)node * (size_t)MPM_VELOCITY(g->dim);
}

// Keeps m and f of the three planes before anything is folded, for the reaction.
static void keep_real(struct mpm_wall *w, const struct mpm_grid *g, const double *gravity) {
    const int dim = g->dim;
    double *out = w->real;
    for (size_t k = 0; k < w->n_columns; k++) {
        const struct mpm_column *c = &w->column[k];
        const uint32_t nodes[] = {c->ghost, c->plane, c->inner};
        for (int q = 0; q < 3; q++, out += 1 + dim) {
            const double *node = sums(g, nodes[q]);
            out[0] = node[0];
            for (int d = 0; d < dim; d++) {
                out[1 + d] = node[MPM_NODE_FORCE + d] + node[0] * gravity[d];
            }
        }
    }
}

// Which columns of a wall that separates leave it: those whose node on the wall would, left alone,
// move away. Behind another wall the image decides.
static void open_columns(const struct mpm_wall *walls, size_t n_walls, struct mpm_wall *w,
                         const struct mpm_grid *g, const double *gravity, double dt, int part) {
    const int dim = g->dim, axis = w->def.axis;
    FOR_ITEMS(k, w->columns_of, part) {
        const double *plane = sums(g, w->column[*k].plane), m = plane[0];
        const double v = m > 0 ? (plane[1 + axis] + dt * plane[MPM_NODE_FORCE + axis]) / m +
                                     dt * gravity[axis] - w->def.velocity[axis]
                               : 0;
        w->open[*k] = w->def.keeps_above ? v > 0 : v < 0;
    }
    for (const struct mpm_wall *o = walls; o < walls + n_walls; o++) {
        if (!o->active || !o->folds || o->def.axis == axis) {
            continue;
        }
        FOR_ITEMS(k, w->columns_of, part) {
            int place[MPM_MAX_DIM];
            memcpy(place, w->column[*k].place, sizeof place);
            if (place[o->def.axis] == o->ghost && in_span(o, place, dim)) {
                place[o->def.axis] = o->inner;
                const struct mpm_column *image = column_through(w, g, place);
                w->open[*k] = image ? w->open[image - w->column] : w->open[*k];
            }
        }
    }
}

static void fold(const struct mpm_wall *w, struct mpm_grid *g, const double *gravity, int part) {
    const int dim = g->dim;
    FOR_ITEMS(k, w->columns_of, part) {
        if (w->open && w->open[*k]) {
            continue;
        }
        double *ghost = sums(g, w->column[*k].ghost), *inner = sums(g, w->column[*k].inner);
        const double m_ghost = ghost[0];
        for (int d = 0; d < dim; d++) {
            const double s = parity(w, d), v_wall = w->def.velocity[d];
            double *p = &inner[1 + d], *f = &inner[MPM_NODE_FORCE + d];
            *p += s * ghost[1 + d];
            *f += s * ghost[MPM_NODE_FORCE + d];
            if (s < 0) {
                // The image moves at 2 v_wall - v; its weight points the other way, and the gravity
                // that the grid update adds for its mass is taken back twice.
                *p += 2 * m_ghost * v_wall;
                *f -= 2 * m_ghost * gravity[d];
            }
        }
        inner[0] += m_ghost;
        ghost[0] = 0; // the grid update passes it by; mpm_walls_apply fills its velocity
    }
}

// The folding walls in the order in which they fold, k = 0 .. 2 n_walls - 1, with NULL for gaps:
// those that separate come last, so that each of their columns decides with all that its images
// bring.
static struct mpm_wall *in_order(struct mpm_wall *walls, size_t n_walls, size_t k) {
    struct mpm_wall *w = &walls[k % n_walls];
    const bool separates = w->def.condition == MPM_WALL_SEPARATE;
    return w->active && w->folds && separates == (k >= n_walls) ? w : NULL;
}

// Where a reaction is wanted all is in one part (mpm_walls_share).
static bool sees_to_reaction(const struct mpm_wall *w, int part) {
    return w->wants_reaction && part == (w->n_parts > 1 ? w->n_parts : 0);
}

void mpm_walls_fold(struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g,
                    const double *gravity, double dt, int part) {
    for (size_t k = 0; k < n_walls; k++) {
        struct mpm_wall *w = &walls[k];
        if (w->active && w->folds && sees_to_reaction(w, part)) {
            keep_real(w, g, gravity);
        }
    }
    for (size_t k = 0; k < 2 * n_walls; k++) {
        struct mpm_wall *w = in_order(walls, n_walls, k);
        if (w && w->open) {
            open_columns(walls, n_walls, w, g, gravity, dt, part);
        }
        if (w) {
            fold(w, g, gravity, part);
        }
    }
}

// The condition on one node's v^{n+1}; the increment that FLIP sees changes with it.
static void condition(const struct mpm_wall *w, double *velocity, int dim) {
    const int axis = w->def.axis;
    for (int d = 0; d < dim; d++) {
        if (d != axis && w->def.condition != MPM_WALL_FIXED) {
            continue;
        }
        double v = w->def.velocity[d];
        if (w->def.condition == MPM_WALL_SEPARATE) {
            v = w->def.keeps_above ? fmax(v, velocity[d]) : fmin(v, velocity[d]);
        }
        velocity[dim + d] += v - velocity[d];
        velocity[d] = v;
    }
}

// Whether an earlier wall has set component d of a node, given its place in the grid, already.
static bool set_before(const struct mpm_wall *walls, const struct mpm_wall *w, const int *place,
                       int d, int dim) {
    for (const struct mpm_wall *o = walls; o < w; o++) {
        const int along = place[o->def.axis];
        if (o->active && !o->folds && parity(o, d) < 0 &&
            (o->def.keeps_above ? along <= o->plane : along >= o->plane) &&
            in_span(o, place, dim)) {
            return true;
        }
    }
    return false;
}

// Nodes on and beyond the wall. What forces (without damping, which on a held node is no force on
// anything) and momentum would have done but for the condition is the force on the wall.
static void apply_direct(const struct mpm_wall *walls, struct mpm_wall *w, struct mpm_grid *g,
                         const double *gravity, double dt, int part) {
    const int dim = g->dim;
    double reaction[MPM_MAX_DIM] = {0};
    FOR_ITEMS(k, w->columns_of, part) {
        const struct mpm_column *c = &w->column[*k];
        const double *node = sums(g, c->plane), m = node[0], *f = node + MPM_NODE_FORCE;
        if (!(m > 0)) {
            continue;
        }
        double *v = result(g, c->plane), before[MPM_MAX_DIM];
        memcpy(before, v, (size_t)dim * sizeof *v);
        condition(w, v, dim);
        for (int d = 0; d < dim; d++) {
            if (v[d] != before[d]) {
                reaction[d] += set_before(walls, w, c->place, d, dim)
                                   ? m * (before[d] - v[d]) / dt
                                   : f[d] + m * gravity[d] - m * v[dim + d] / dt;
            }
        }
    }
    if (sees_to_reaction(w, part)) {
        memcpy(w->reaction, reaction, sizeof reaction);
    }
}

static void hold_plane(const struct mpm_wall *w, struct mpm_grid *g, int part) {
    const int dim = g->dim;
    FOR_ITEMS(k, w->columns_of, part) {
        if (w->open && w->open[*k]) {
            continue;
        }
        double *plane = result(g, w->column[*k].plane);
        for (int d = 0; d < dim; d++) {
            if (parity(w, d) < 0) {
                // FLIP sees the increment from the velocity before the condition, as everywhere.
                plane[dim + d] += w->def.velocity[d] - plane[d];
                plane[d] = w->def.velocity[d];
            }
        }
    }
}

static void fill_ghosts(const struct mpm_wall *w, struct mpm_grid *g, int part) {
    const int dim = g->dim;
    FOR_ITEMS(k, w->columns_of, part) {
        if (w->open && w->open[*k]) {
            continue;
        }
        double *ghost = result(g, w->column[*k].ghost);
        const double *inner = result(g, w->column[*k].inner);
        for (int d = 0; d < dim; d++) {
            const double s = parity(w, d);
            ghost[d] = s * inner[d] + (s < 0 ? 2 * w->def.velocity[d] : 0);
            ghost[dim + d] = s * inner[dim + d];
        }
    }
    // What has come to lie beyond the image's reach is held as by a direct condition.
    FOR_ITEMS(k, w->beyond_of, part) {
        const struct mpm_beyond *b = &w->beyond[*k];
        if (!(w->open && b->column != UINT32_MAX && w->open[b->column])) {
            condition(w, result(g, b->node), dim);
        }
    }
}

// Whether a folding wall sets component d of the node with the given place in the grid.
static bool holds(const struct mpm_wall *w, const struct mpm_grid *g, const int *place, int d) {
    if (!w->active || !w->folds || parity(w, d) > 0 || abs(place[w->def.axis] - w->plane) > 1 ||
        !in_span(w, place, g->dim)) {
        return false;
    }
    const struct mpm_column *through = w->open ? column_through(w, g, place) : NULL;
    return !(through && w->open[through - w->column]);
}

// Real momentum change of the three planes less what forces gave them: that came from the wall.
// Only the components that the wall holds, which elsewhere cancel over the planes; and where walls
// meet, what an earlier one holds is the earlier one's.
static void folded_reaction(const struct mpm_wall *walls, struct mpm_wall *w,
                            const struct mpm_grid *g, double dt) {
    const int dim = g->dim, axis = w->def.axis, planes[3] = {w->ghost, w->plane, w->inner};
    const double *real = w->real;
    memset(w->reaction, 0, sizeof w->reaction);
    for (size_t k = 0; k < w->n_columns; k++) {
        const struct mpm_column *c = &w->column[k];
        const uint32_t nodes[] = {c->ghost, c->plane, c->inner};
        int place[MPM_MAX_DIM];
        memcpy(place, c->place, sizeof place);
        for (int q = 0; q < 3; q++, real += 1 + dim) {
            const double *v = result(g, nodes[q]);
            place[axis] = planes[q];
            for (int d = 0; d < dim; d++) {
                bool mine = holds(w, g, place, d);
                for (const struct mpm_wall *o = walls; mine && o < w; o++) {
                    mine = !holds(o, g, place, d);
                }
                if (mine) {
                    w->reaction[d] -= real[0] * v[dim + d] / dt - real[1 + d];
                }
            }
        }
    }
}

void mpm_walls_apply(struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g,
                     const double *gravity, double dt, int part) {
    for (size_t k = 0; k < n_walls; k++) {
        if (walls[k].active && !walls[k].folds) {
            apply_direct(walls, &walls[k], g, gravity, dt, part);
        }
    }
    // All planes before any ghost: of two walls one cell apart, each one's plane is the other's
    // inner plane. Backwards: the corner's ghost is the image of an image.
    for (size_t k = 2 * n_walls; k-- > 0;) {
        const struct mpm_wall *w = in_order(walls, n_walls, k);
        if (w) {
            hold_plane(w, g, part);
        }
    }
    for (size_t k = 2 * n_walls; k-- > 0;) {
        const struct mpm_wall *w = in_order(walls, n_walls, k);
        if (w) {
            fill_ghosts(w, g, part);
        }
    }
    for (size_t k = 0; k < n_walls; k++) {
        struct mpm_wall *w = &walls[k];
        if (w->active && w->folds && sees_to_reaction(w, part)) {
            folded_reaction(walls, w, g, dt);
        }
    }
}

void mpm_walls_fold_fbar(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g,
                         int part) {
    const int volume = MPM_NODE_VOLUME(g->dim), stride = g->fbar_stride;
    // Sums first, so that the image of an image is folded too; then the ghosts take their image's
    // value.
    for (size_t k = 0; k < n_walls; k++) {
        const struct mpm_wall *w = &walls[k];
        if (!w->active || !w->folds) {
            continue;
        }
        FOR_ITEMS(c, w->columns_of, part) {
            const size_t from = w->column[*c].ghost, to = w->column[*c].inner;
            g->node[to * MPM_NODE + (size_t)volume] += g->node[from * MPM_NODE + (size_t)volume];
            g->node[from * MPM_NODE + (size_t)volume] = 0;
            double *ghost = g->fbar + from * (size_t)stride, *inner = g->fbar + to * (size_t)stride;
            for (int q = 0; q < stride; q++) {
                inner[q] += ghost[q];
                ghost[q] = 0;
            }
        }
    }
}

void mpm_walls_mirror_fbar(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g,
                           int part) {
    const size_t stride = (size_t)g->fbar_stride;
    for (size_t k = n_walls; k-- > 0;) {
        const struct mpm_wall *w = &walls[k];
        if (!w->active || !w->folds) {
            continue;
        }
        FOR_ITEMS(c, w->columns_of, part) {
            memcpy(g->fbar + w->column[*c].ghost * stride, g->fbar + w->column[*c].inner * stride,
                   stride * sizeof *g->fbar);
        }
    }
}
