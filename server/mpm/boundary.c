// Wall conditions on the grid: direct for uGIMP and linear, mirror-folded for B-splines.
#include "server/mpm/boundary.h"

#include <stdlib.h>
#include <string.h>

bool mpm_wall_create(struct mpm_wall *wall, const struct mpm_wall_def *def,
                     const struct mpm_grid *grid, enum mpm_basis basis, bool wants_reaction) {
    *wall = (struct mpm_wall){.def = *def, .active = true, .wants_reaction = wants_reaction};
    const int axis = def->axis;
    wall->plane = (int)lround((def->at - grid->origin[axis]) * grid->inv_h);
    wall->ghost = wall->plane + (def->keeps_above ? -1 : 1);
    wall->inner = wall->plane + (def->keeps_above ? 1 : -1);
    wall->folds = basis == MPM_BSPLINE2 || basis == MPM_BSPLINE3;
    size_t columns = 1;
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
        columns *= (size_t)grid->n[d];
    }
    for (int d = 0; d < grid->dim; d++) {
        wall->wants_reaction |= def->velocity[d] != 0;
    }
    if (wall->folds && def->condition == MPM_WALL_SEPARATE) {
        wall->open = calloc(columns, 1);
        if (!wall->open) {
            return false;
        }
    }
    if (wall->folds && wall->wants_reaction) {
        wall->real = calloc(columns * 3 * (size_t)(1 + grid->dim), sizeof *wall->real);
        return wall->real != NULL;
    }
    return true;
}

void mpm_wall_free(struct mpm_wall *wall) {
    free(wall->real);
    free(wall->open);
    *wall = (struct mpm_wall){0};
}

// The wall's columns inside the window: for each, `column` is its node in plane 0 of the wall's
// axis and `k` counts them.
#define FOR_COLUMNS(wall, g, column, k)                                                            \
    for (int u_ = (wall)->def.axis == 0 ? 1 : 0,                                                   \
             w_ = (g)->dim == 2           ? 2                                                      \
                  : (wall)->def.axis == 2 ? 1                                                      \
                                          : 2,                                                     \
             ua_ = first_of(wall, g, u_), ub_ = last_of(wall, g, u_), wa_ = first_of(wall, g, w_), \
             wb_ = last_of(wall, g, w_), i_ = ua_;                                                 \
         i_ < ub_; i_++)                                                                           \
        for (int j_ = wa_; j_ < wb_; j_++)                                                         \
            for (size_t column = (size_t)i_ * (g)->stride[u_] + (size_t)j_ * (g)->stride[w_],      \
                        k = (size_t)i_ * (size_t)(g)->n[w_] + (size_t)j_, once_ = 1;               \
                 once_; once_ = 0)

static int first_of(const struct mpm_wall *w, const struct mpm_grid *g, int d) {
    return d >= g->dim ? 0 : w->lo[d] > g->lo[d] ? w->lo[d] : g->lo[d];
}

static int last_of(const struct mpm_wall *w, const struct mpm_grid *g, int d) {
    return d >= g->dim ? 1 : w->hi[d] < g->hi[d] ? w->hi[d] : g->hi[d];
}

// Whether plane i of the wall's axis lies in the window.
static bool in_window(const struct mpm_wall *w, const struct mpm_grid *g, int i) {
    return i >= g->lo[w->def.axis] && i < g->hi[w->def.axis];
}

static bool reaches_window(const struct mpm_wall *w, const struct mpm_grid *g) {
    return in_window(w, g, w->ghost) && in_window(w, g, w->inner);
}

void mpm_walls_extend_window(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g) {
    for (size_t k = 0; k < n_walls; k++) {
        const struct mpm_wall *w = &walls[k];
        const int axis = w->def.axis;
        if (w->active && w->folds && w->plane >= g->lo[axis] - 1 && w->plane <= g->hi[axis]) {
            g->lo[axis] = w->plane - 1 < g->lo[axis] ? w->plane - 1 : g->lo[axis];
            g->hi[axis] = w->plane + 2 > g->hi[axis] ? w->plane + 2 : g->hi[axis];
        }
    }
}

// +1 where the component is the same in the mirror image, -1 where it changes sign.
static double parity(const struct mpm_wall *w, int component) {
    return component == w->def.axis || w->def.condition == MPM_WALL_FIXED ? -1 : 1;
}

// Keeps m and f of the three planes before anything is folded, for the reaction.
static void keep_real(struct mpm_wall *w, const struct mpm_grid *g, const double *gravity) {
    const int dim = g->dim, planes[3] = {w->ghost, w->plane, w->inner};
    const size_t stride = g->stride[w->def.axis];
    double *out = w->real;
    FOR_COLUMNS(w, g, column, k) {
        for (int q = 0; q < 3; q++, out += 1 + dim) {
            const double *node = g->node + (column + (size_t)planes[q] * stride) * MPM_NODE(dim);
            out[0] = node[0];
            for (int d = 0; d < dim; d++) {
                out[1 + d] = node[1 + dim + d] + node[0] * gravity[d];
            }
        }
        (void)k;
    }
}

// Which columns of a wall that separates leave it: those whose node on the wall would, left alone,
// move away. Behind another wall the image decides.
static void open_columns(const struct mpm_wall *walls, size_t n_walls, struct mpm_wall *w,
                         const struct mpm_grid *g, const double *gravity, double dt) {
    const int dim = g->dim, axis = w->def.axis;
    FOR_COLUMNS(w, g, column, k) {
        const double *plane =
            g->node + (column + (size_t)w->plane * g->stride[axis]) * MPM_NODE(dim);
        const double m = plane[0];
        const double v = m > 0 ? (plane[1 + axis] + dt * plane[1 + dim + axis]) / m +
                                     dt * gravity[axis] - w->def.velocity[axis]
                               : 0;
        w->open[k] = w->def.keeps_above ? v > 0 : v < 0;
    }
    for (const struct mpm_wall *o = walls; o < walls + n_walls; o++) {
        if (!o->active || !o->folds || o->def.axis == axis || !reaches_window(o, g)) {
            continue;
        }
        FOR_COLUMNS(w, g, column, k) {
            (void)column;
            if (o->def.axis == u_ && i_ == o->ghost) {
                w->open[k] = w->open[(size_t)o->inner * (size_t)g->n[w_] + (size_t)j_];
            } else if (o->def.axis == w_ && j_ == o->ghost) {
                w->open[k] = w->open[(size_t)i_ * (size_t)g->n[w_] + (size_t)o->inner];
            }
        }
    }
}

static void fold(const struct mpm_wall *w, struct mpm_grid *g, const double *gravity) {
    const int dim = g->dim;
    const size_t stride = g->stride[w->def.axis];
    FOR_COLUMNS(w, g, column, k) {
        double *ghost = g->node + (column + (size_t)w->ghost * stride) * MPM_NODE(dim);
        double *inner = g->node + (column + (size_t)w->inner * stride) * MPM_NODE(dim);
        if (w->open && w->open[k]) {
            continue;
        }
        const double m_ghost = ghost[0];
        for (int d = 0; d < dim; d++) {
            const double s = parity(w, d), v_wall = w->def.velocity[d];
            double *p = &inner[1 + d], *f = &inner[1 + dim + d];
            *p += s * ghost[1 + d];
            *f += s * ghost[1 + dim + d];
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
static struct mpm_wall *in_order(struct mpm_wall *walls, size_t n_walls, const struct mpm_grid *g,
                                 size_t k) {
    struct mpm_wall *w = &walls[k % n_walls];
    const bool separates = w->def.condition == MPM_WALL_SEPARATE;
    return w->active && w->folds && separates == (k >= n_walls) && reaches_window(w, g) ? w : NULL;
}

void mpm_walls_fold(struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g,
                    const double *gravity, double dt) {
    for (size_t k = 0; k < n_walls; k++) {
        struct mpm_wall *w = &walls[k];
        if (w->active && w->folds && w->wants_reaction && reaches_window(w, g)) {
            keep_real(w, g, gravity);
        }
    }
    for (size_t k = 0; k < 2 * n_walls; k++) {
        struct mpm_wall *w = in_order(walls, n_walls, g, k);
        if (w && w->open) {
            open_columns(walls, n_walls, w, g, gravity, dt);
        }
        if (w) {
            fold(w, g, gravity);
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
        bool in =
            o->active && !o->folds && parity(o, d) < 0 &&
            (o->def.keeps_above ? place[o->def.axis] <= o->plane : place[o->def.axis] >= o->plane);
        for (int e = 0; e < dim; e++) {
            in &= e == o->def.axis || (place[e] >= o->lo[e] && place[e] < o->hi[e]);
        }
        if (in) {
            return true;
        }
    }
    return false;
}

// Nodes on and beyond the wall. What forces (without damping, which on a held node is no force on
// anything) and momentum would have done but for the condition is the force on the wall.
static void apply_direct(const struct mpm_wall *walls, struct mpm_wall *w, struct mpm_grid *g,
                         const double *gravity, double dt) {
    const int dim = g->dim, axis = w->def.axis;
    const int first = w->def.keeps_above ? g->lo[axis] : (int)fmax(w->plane, g->lo[axis]);
    const int last = w->def.keeps_above ? (int)fmin(w->plane + 1, g->hi[axis]) : g->hi[axis];
    memset(w->reaction, 0, sizeof w->reaction);
    FOR_COLUMNS(w, g, column, k) {
        int place[MPM_MAX_DIM] = {0};
        for (int e = 0; e < dim; e++) {
            place[e] = (int)(column / g->stride[e] % (size_t)g->n[e]);
        }
        for (int i = first; i < last; i++) {
            const size_t node = column + (size_t)i * g->stride[axis];
            const double m = g->node[node * MPM_NODE(dim)];
            if (m > 0) {
                const double *f = g->node + node * MPM_NODE(dim) + 1 + dim;
                double *v = g->velocity + node * MPM_VELOCITY(dim), before[MPM_MAX_DIM];
                memcpy(before, v, (size_t)dim * sizeof *v);
                condition(w, v, dim);
                place[axis] = i;
                for (int d = 0; d < dim; d++) {
                    if (v[d] != before[d]) {
                        w->reaction[d] += set_before(walls, w, place, d, dim)
                                              ? m * (before[d] - v[d]) / dt
                                              : f[d] + m * gravity[d] - m * v[dim + d] / dt;
                    }
                }
            }
        }
        (void)k;
    }
}

static void hold_plane(const struct mpm_wall *w, struct mpm_grid *g) {
    const int dim = g->dim;
    FOR_COLUMNS(w, g, column, k) {
        if (w->open && w->open[k]) {
            continue;
        }
        double *plane =
            g->velocity + (column + (size_t)w->plane * g->stride[w->def.axis]) * MPM_VELOCITY(dim);
        for (int d = 0; d < dim; d++) {
            if (parity(w, d) < 0) {
                // FLIP sees the increment from the velocity before the condition, as everywhere.
                plane[dim + d] += w->def.velocity[d] - plane[d];
                plane[d] = w->def.velocity[d];
            }
        }
    }
}

static void fill_ghosts(const struct mpm_wall *w, struct mpm_grid *g) {
    const int dim = g->dim, axis = w->def.axis;
    const size_t stride = g->stride[axis];
    FOR_COLUMNS(w, g, column, k) {
        if (w->open && w->open[k]) {
            continue;
        }
        double *ghost = g->velocity + (column + (size_t)w->ghost * stride) * MPM_VELOCITY(dim);
        const double *inner =
            g->velocity + (column + (size_t)w->inner * stride) * MPM_VELOCITY(dim);
        for (int d = 0; d < dim; d++) {
            const double s = parity(w, d);
            ghost[d] = s * inner[d] + (s < 0 ? 2 * w->def.velocity[d] : 0);
            ghost[dim + d] = s * inner[dim + d];
        }
        // What has come to lie beyond the image's reach is held as by a direct condition.
        const int step = w->ghost - w->plane;
        for (int i = w->ghost + step; in_window(w, g, i); i += step) {
            condition(w, g->velocity + (column + (size_t)i * stride) * MPM_VELOCITY(dim), dim);
        }
    }
}

// Whether a folding wall sets component d of the node with the given place in the grid.
static bool holds(const struct mpm_wall *w, const struct mpm_grid *g, const int *place, int d) {
    if (!w->active || !w->folds || !reaches_window(w, g) || parity(w, d) > 0) {
        return false;
    }
    bool in = abs(place[w->def.axis] - w->plane) <= 1;
    for (int e = 0; e < g->dim; e++) {
        in &= e == w->def.axis || (place[e] >= w->lo[e] && place[e] < w->hi[e]);
    }
    const int u = w->def.axis == 0 ? 1 : 0, v = g->dim == 2 ? 2 : w->def.axis == 2 ? 1 : 2;
    return in && !(w->open && w->open[(size_t)place[u] * (size_t)g->n[v] + (size_t)place[v]]);
}

// Real momentum change of the three planes less what forces gave them: that came from the wall.
// Only the components that the wall holds, which elsewhere cancel over the planes; and where walls
// meet, what an earlier one holds is the earlier one's.
static void folded_reaction(const struct mpm_wall *walls, struct mpm_wall *w,
                            const struct mpm_grid *g, double dt) {
    const int dim = g->dim, axis = w->def.axis, planes[3] = {w->ghost, w->plane, w->inner};
    const size_t stride = g->stride[axis];
    const double *real = w->real;
    memset(w->reaction, 0, sizeof w->reaction);
    FOR_COLUMNS(w, g, column, k) {
        int place[MPM_MAX_DIM] = {0};
        for (int e = 0; e < dim; e++) {
            place[e] = (int)(column / g->stride[e] % (size_t)g->n[e]);
        }
        for (int q = 0; q < 3; q++, real += 1 + dim) {
            const double *v =
                g->velocity + (column + (size_t)planes[q] * stride) * MPM_VELOCITY(dim);
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
        (void)k;
    }
}

void mpm_walls_apply(struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g,
                     const double *gravity, double dt) {
    for (size_t k = 0; k < n_walls; k++) {
        if (walls[k].active && !walls[k].folds) {
            apply_direct(walls, &walls[k], g, gravity, dt);
        }
    }
    // All planes before any ghost: of two walls one cell apart, each one's plane is the other's
    // inner plane. Backwards: the corner's ghost is the image of an image.
    for (size_t k = 2 * n_walls; k-- > 0;) {
        const struct mpm_wall *w = in_order(walls, n_walls, g, k);
        if (w) {
            hold_plane(w, g);
        }
    }
    for (size_t k = 2 * n_walls; k-- > 0;) {
        const struct mpm_wall *w = in_order(walls, n_walls, g, k);
        if (w) {
            fill_ghosts(w, g);
        }
    }
    for (size_t k = 0; k < n_walls; k++) {
        struct mpm_wall *w = &walls[k];
        if (w->active && w->folds && w->wants_reaction) {
            if (reaches_window(w, g)) {
                folded_reaction(walls, w, g, dt);
            } else {
                memset(w->reaction, 0, sizeof w->reaction);
            }
        }
    }
}

void mpm_walls_fold_fbar(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g) {
    const int stride = g->fbar_stride;
    // Sums first, so that the image of an image is folded too; then the ghosts take their image's
    // value.
    for (size_t k = 0; k < n_walls; k++) {
        const struct mpm_wall *w = &walls[k];
        if (!w->active || !w->folds || !reaches_window(w, g)) {
            continue;
        }
        FOR_COLUMNS(w, g, column, c) {
            const size_t plane_stride = g->stride[w->def.axis];
            double *ghost = g->fbar + (column + (size_t)w->ghost * plane_stride) * (size_t)stride;
            double *inner = g->fbar + (column + (size_t)w->inner * plane_stride) * (size_t)stride;
            for (int q = 0; q < stride; q++) {
                inner[q] += ghost[q];
                ghost[q] = 0;
            }
            (void)c;
        }
    }
}

void mpm_walls_mirror_fbar(const struct mpm_wall *walls, size_t n_walls, struct mpm_grid *g) {
    for (size_t k = n_walls; k-- > 0;) {
        const struct mpm_wall *w = &walls[k];
        if (!w->active || !w->folds || !reaches_window(w, g)) {
            continue;
        }
        FOR_COLUMNS(w, g, column, c) {
            const size_t plane_stride = g->stride[w->def.axis], stride = (size_t)g->fbar_stride;
            double *ghost = g->fbar + (column + (size_t)w->ghost * plane_stride) * stride;
            const double *inner = g->fbar + (column + (size_t)w->inner * plane_stride) * stride;
            memcpy(ghost, inner, stride * sizeof *ghost);
            (void)c;
        }
    }
}
