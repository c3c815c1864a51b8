// Which points lie in a shape.
//
// A lattice point sits at odd multiples of half a spacing from the domain's corner. Whether it lies
// on an edge is decided in those units: an edge within SNAP of a multiple of half a spacing is
// taken to be that multiple, so that round-off in the input cannot move it across a particle.
//
// Rows of points are filled run by run: the crossings of a polygon's edges with the row, sorted, so
// that the work is that of points plus crossings and not their product. Points that are nearer than
// CLEAR to an edge are held against each edge as a single point is, so that both ways find the
// same.
#include "server/mpm/shape.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define SNAP 1e-7 // units
// Units. On an edge means within SNAP of its line with (a - x).(b - x) <= SNAP, so never further
// off than sqrt(SNAP) = 3.2e-4. What is further off than this is inside or outside by topology
// alone.
#define CLEAR 1e-3
// Of a polygon's largest coordinate, where that is more: far above the round-off of crossings
// (2e-16 of it) and of the products in cross_edge (9e-16 of it, times the edge's length).
#define CLEAR_RATIO 0x1p-32
#define WINDOW_MAX 1e15        // units: beyond it a double is not good to half a unit
#define CYLINDER_MAX 4194304.0 // units: differences of squares are good to 1e-2 below it
#define BANDS 32               // of a polygon's height

// Whose shape lies within it by `reach` to each side, in units.
struct window {
    double low[MPM_MAX_DIM], high[MPM_MAX_DIM];
};
static const struct window everywhere = {.low = {-INFINITY, -INFINITY, -INFINITY},
                                         .high = {INFINITY, INFINITY, INFINITY}};

struct begins {
    double at; // least x of an edge
    uint32_t edge;
};

// A polygon's edges, for each band of their height those that reach into it (for single points),
// and by where they begin along x (for rows).
struct outline {
    size_t n;
    double (*edges)[4]; // from (x, y) to (x, y), snapped
    uint32_t *banded;
    size_t begin[BANDS + 1];
    double low, high; // heights that they reach, with 1 to spare
    bool swept;       // whether rows are
    double clear;     // CLEAR, or more
    struct begins *order;
    uint32_t *active; // edges within `clear` of swept_to
    size_t n_begun, n_active;
    double swept_to;
    signed char *plane; // of an extrusion: of points along y at index plane_at
    long long plane_at[2];
};

// A shape's tree once more, with what makes looking quick.
struct mpm_form {
    struct mpm_form *children; // those of the shape
    struct outline *outline;
    struct window window;
};

static double snapped(double value, double origin, double unit) {
    const double u = (value - origin) / unit, whole = round(u);
    return fabs(u - whole) < SNAP ? whole : u;
}

// 1 between two places, 0 on either, -1 beyond.
static int between(double from, double to, double origin, double unit, double point) {
    const double a = snapped(from, origin, unit), b = snapped(to, origin, unit);
    return point < a || point > b ? -1 : point == a || point == b ? 0 : 1;
}

// ---- Forms ------------------------------------------------------------------------------------

static void outline_free(struct outline *o) {
    if (o) {
        free(o->edges);
        free(o->banded);
        free(o->order);
        free(o->active);
        free(o->plane);
    }
    free(o);
}

static void form_clear(struct mpm_form *form, const struct mpm_shape *shape) {
    for (size_t k = 0; form->children && k < shape->n_children; k++) {
        form_clear(&form->children[k], &shape->children[k]);
    }
    free(form->children);
    outline_free(form->outline);
}

static size_t band_of(const struct outline *o, double height) {
    const double band = (height - o->low) / (o->high - o->low) * BANDS;
    return band < 0 ? 0 : band < BANDS - 1 ? (size_t)band : BANDS - 1;
}

static bool fill_bands(struct outline *o) {
    size_t count = 0;
    for (int pass = 0; pass < 2; pass++) { // counts, then puts them there
        count = 0;
        for (size_t band = 0; band < BANDS; band++) {
            o->begin[band] = count;
            for (size_t i = 0; i < o->n; i++) {
                const double lower = fmin(o->edges[i][1], o->edges[i][3]) - 1;
                const double upper = fmax(o->edges[i][1], o->edges[i][3]) + 1;
                if (band < band_of(o, lower) || band > band_of(o, upper)) {
                    continue;
                }
                if (pass == 1) {
                    o->banded[count] = (uint32_t)i;
                }
                count++;
            }
        }
        o->begin[BANDS] = count;
        if (pass == 0 && !(o->banded = calloc(count + 1, sizeof *o->banded))) {
            return false;
        }
    }
    return true;
}

static int by_begin(const void *one, const void *other) {
    const struct begins *a = one, *b = other;
    return (a->at > b->at) - (a->at < b->at);
}

static bool fill_order(struct outline *o) {
    o->order = calloc(o->n + 1, sizeof *o->order);
    o->active = calloc(o->n + 1, sizeof *o->active);
    if (!o->order || !o->active) {
        return false;
    }
    for (size_t i = 0; i < o->n; i++) {
        o->order[i] =
            (struct begins){.at = fmin(o->edges[i][0], o->edges[i][2]), .edge = (uint32_t)i};
    }
    qsort(o->order, o->n, sizeof *o->order, by_begin);
    o->swept_to = INFINITY; // not begun
    return true;
}

// NULL without memory: then every edge is looked at.
static struct outline *outline_create(const struct mpm_shape *shape, const struct mpm_lattice *l,
                                      bool rows) {
    struct outline *o = calloc(1, sizeof *o);
    const size_t n = shape->n_points;
    if (!o || n > UINT32_MAX || !(o->edges = calloc(n + 1, sizeof *o->edges))) {
        outline_free(o);
        return NULL;
    }
    double farthest = 0;
    o->n = n;
    o->low = INFINITY;
    o->high = -INFINITY;
    for (size_t i = 0, j = n - 1; i < n; j = i++) {
        for (size_t d = 0; d < 2; d++) {
            o->edges[i][d] = snapped(shape->points[2 * j + d], l->origin[d], l->unit);
            o->edges[i][2 + d] = snapped(shape->points[2 * i + d], l->origin[d], l->unit);
            farthest = fmax(farthest, fabs(o->edges[i][2 + d]));
        }
        o->low = fmin(o->low, o->edges[i][1] - 1);
        o->high = fmax(o->high, o->edges[i][1] + 1);
    }
    o->clear = fmax(CLEAR, CLEAR_RATIO * farthest);
    o->swept = rows && fill_order(o);
    if (!fill_bands(o)) {
        outline_free(o);
        return NULL;
    }
    return o;
}

// What lies further out than this is outside. Two units or more to spare, for round-off.
static struct window window_of(const struct mpm_form *form, const struct mpm_shape *shape,
                               const struct mpm_lattice *l) {
    struct window w = everywhere;
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM];
    const bool flat = shape->kind == MPM_SHAPE_POLYGON || shape->kind == MPM_SHAPE_EXTRUDE;
    if (shape->n_children > 0 && form->children) {
        w = form->children[0].window;
        for (size_t k = 1; shape->kind != MPM_SHAPE_DIFFERENCE && k < shape->n_children; k++) {
            const struct window *child = &form->children[k].window;
            const bool both = shape->kind == MPM_SHAPE_INTERSECTION;
            for (int d = 0; d < l->dim; d++) {
                w.low[d] = both ? fmax(w.low[d], child->low[d]) : fmin(w.low[d], child->low[d]);
                w.high[d] =
                    both ? fmin(w.high[d], child->high[d]) : fmax(w.high[d], child->high[d]);
            }
        }
        return w;
    }
    if (shape->kind > MPM_SHAPE_EXTRUDE && shape->kind != MPM_SHAPE_CYLINDER) {
        return w;
    }
    if ((flat && !(form->outline && form->outline->swept)) ||
        !mpm_shape_bounds(shape, l->dim, min, max)) {
        return w;
    }
    for (int d = 0; d < l->dim; d++) {
        const double low = (min[d] - l->origin[d]) / l->unit,
                     high = (max[d] - l->origin[d]) / l->unit;
        const double farthest = fmax(fabs(low), fabs(high));
        if (!(farthest <= (shape->kind == MPM_SHAPE_CYLINDER ? CYLINDER_MAX : WINDOW_MAX))) {
            return everywhere;
        }
        w.low[d] = low - fmax(2, CLEAR_RATIO * farthest);
        w.high[d] = high + fmax(2, CLEAR_RATIO * farthest);
    }
    return w;
}

static void form_fill(struct mpm_form *form, const struct mpm_shape *shape,
                      const struct mpm_lattice *l, bool rows, size_t *most_edges) {
    *form = (struct mpm_form){.window = everywhere};
    if (shape->kind == MPM_SHAPE_POLYGON || shape->kind == MPM_SHAPE_EXTRUDE) {
        form->outline = outline_create(shape, l, rows);
        if (form->outline && form->outline->n > *most_edges) {
            *most_edges = form->outline->n;
        }
    } else if (shape->n_children > 0) {
        form->children = calloc(shape->n_children, sizeof *form->children);
        for (size_t k = 0; form->children && k < shape->n_children; k++) {
            form_fill(&form->children[k], &shape->children[k], l, rows, most_edges);
        }
    }
    form->window = window_of(form, shape, l);
}

// ---- On which side of a shape a point lies ----------------------------------------------------

struct crossing {
    bool inside; // so far: an odd number of edges lies to the right
    bool on_edge;
};

static void cross_edge(struct crossing *c, const double *from, const double *to,
                       const double *point) {
    const double a[2] = {from[0] - point[0], from[1] - point[1]};
    const double b[2] = {to[0] - point[0], to[1] - point[1]};
    if ((a[1] > 1 && b[1] > 1) || (a[1] < -1 && b[1] < -1)) {
        return; // neither near it nor across the ray
    }
    const double cross = a[0] * b[1] - a[1] * b[0];
    const double length = hypot(b[0] - a[0], b[1] - a[1]);
    const double dot = a[0] * b[0] + a[1] * b[1];
    if (fabs(cross) <= SNAP * length && dot <= SNAP) {
        c->on_edge = true; // between the ends of this edge
    }
    if ((a[1] > 0) != (b[1] > 0)) { // the edge crosses the ray to +x on the one side of it
        c->inside ^= (cross > 0) == (b[1] > a[1]);
    }
}

// The vertices are snapped, so with vertices on the half-spacing lattice every product is exact.
static int polygon_side(const struct mpm_shape *shape, const struct mpm_form *form,
                        const struct mpm_lattice *l, const double *point) {
    struct crossing c = {0};
    const struct outline *o = form ? form->outline : NULL;
    if (o) {
        if (point[1] < o->low || point[1] > o->high) {
            return -1;
        }
        const size_t band = band_of(o, point[1]);
        for (size_t k = o->begin[band]; !c.on_edge && k < o->begin[band + 1]; k++) {
            const double *edge = o->edges[o->banded[k]];
            cross_edge(&c, edge, edge + 2, point);
        }
        return c.on_edge ? 0 : c.inside ? 1 : -1;
    }
    for (size_t i = 0, j = shape->n_points - 1; !c.on_edge && i < shape->n_points; j = i++) {
        double a[2], b[2];
        for (size_t d = 0; d < 2; d++) {
            a[d] = snapped(shape->points[2 * j + d], l->origin[d], l->unit);
            b[d] = snapped(shape->points[2 * i + d], l->origin[d], l->unit);
        }
        cross_edge(&c, a, b, point);
    }
    return c.on_edge ? 0 : c.inside ? 1 : -1;
}

// `r2` across the last direction, `e` along it.
static int ball_side(double r2, double e, double radius) {
    const double gap = radius * radius - (r2 + e * e);
    return fabs(gap) < SNAP * radius ? 0 : gap > 0 ? 1 : -1;
}

static int cylinder_side(const struct mpm_shape *shape, const struct mpm_lattice *l,
                         const double *point) {
    double axis[3], from[3], length2 = 0, along = 0, r2 = 0;
    for (int d = 0; d < 3; d++) {
        from[d] = point[d] - snapped(shape->min[d], l->origin[d], l->unit);
        axis[d] = (shape->max[d] - shape->min[d]) / l->unit;
        length2 += axis[d] * axis[d];
        along += from[d] * axis[d];
        r2 += from[d] * from[d];
    }
    const double length = sqrt(length2), z = along / length, radius = shape->radius / l->unit;
    const double gap = radius * radius - (r2 - z * z);
    const int across = fabs(gap) < SNAP * radius ? 0 : gap > 0 ? 1 : -1;
    const int ends = fabs(z) < SNAP || fabs(z - length) < SNAP ? 0 : z > 0 && z < length ? 1 : -1;
    return across < ends ? across : ends;
}

// Sign of how far the point is inside the shape: > 0 inside, 0 on the edge, < 0 outside.
// `form` may be NULL.
static int side(const struct mpm_shape *shape, const struct mpm_form *form,
                const struct mpm_lattice *l, const double *point) {
    const struct mpm_form *children = form ? form->children : NULL;
    switch (shape->kind) {
    case MPM_SHAPE_BOX: {
        int least = 1;
        for (int d = 0; d < l->dim; d++) {
            const int here = between(shape->min[d], shape->max[d], l->origin[d], l->unit, point[d]);
            least = here < least ? here : least;
        }
        return least;
    }
    case MPM_SHAPE_BALL: {
        double r2 = 0;
        for (int d = 0; d + 1 < l->dim; d++) {
            const double e = point[d] - snapped(shape->centre[d], l->origin[d], l->unit);
            r2 += e * e;
        }
        const int last = l->dim - 1;
        return ball_side(r2, point[last] - snapped(shape->centre[last], l->origin[last], l->unit),
                         snapped(shape->radius, 0, l->unit));
    }
    case MPM_SHAPE_POLYGON:
        return polygon_side(shape, form, l, point);
    case MPM_SHAPE_EXTRUDE: {
        const int across = polygon_side(shape, form, l, point);
        const int along = between(shape->min[2], shape->max[2], l->origin[2], l->unit, point[2]);
        return across < along ? across : along;
    }
    case MPM_SHAPE_CYLINDER:
        return cylinder_side(shape, l, point);
    case MPM_SHAPE_POINTS:
        return -1;
    case MPM_SHAPE_UNION: {
        int most = -1;
        for (size_t k = 0; most < 1 && k < shape->n_children; k++) {
            const int here = side(&shape->children[k], children ? &children[k] : NULL, l, point);
            most = here > most ? here : most;
        }
        return most;
    }
    case MPM_SHAPE_DIFFERENCE:
    case MPM_SHAPE_INTERSECTION: {
        int least = 1;
        for (size_t k = 0; least > -1 && k < shape->n_children; k++) {
            const int sign = shape->kind == MPM_SHAPE_DIFFERENCE && k > 0 ? -1 : 1;
            const int here =
                sign * side(&shape->children[k], children ? &children[k] : NULL, l, point);
            least = here < least ? here : least;
        }
        return least;
    }
    }
    return -1;
}

struct mpm_region {
    const struct mpm_shape *shape;
    struct mpm_lattice lattice; // in units of the margin: "on the edge" is closer than SNAP margins
    struct mpm_form form;
};

static bool contains(const struct mpm_shape *shape, const struct mpm_form *form,
                     const struct mpm_lattice *l, const double *x) {
    double point[MPM_MAX_DIM];
    for (int d = 0; d < l->dim; d++) {
        point[d] = x[d] / l->unit;
    }
    return side(shape, form, l, point) > 0;
}

bool mpm_shape_contains(const struct mpm_shape *shape, const double *x, int dim, double margin) {
    const struct mpm_lattice l = {.dim = dim, .unit = margin};
    return contains(shape, NULL, &l, x);
}

struct mpm_region *mpm_region_create(const struct mpm_shape *shape, int dim, double margin) {
    struct mpm_region *region = calloc(1, sizeof *region);
    if (region) {
        region->shape = shape;
        region->lattice = (struct mpm_lattice){.dim = dim, .unit = margin};
        size_t most = 0;
        form_fill(&region->form, shape, &region->lattice, false, &most);
    }
    return region;
}

bool mpm_region_contains(const struct mpm_region *region, const double *x) {
    return contains(region->shape, &region->form, &region->lattice, x);
}

void mpm_region_free(struct mpm_region *region) {
    if (region) {
        form_clear(&region->form, region->shape);
    }
    free(region);
}

bool mpm_shape_bounds(const struct mpm_shape *shape, int dim, double *min, double *max) {
    for (int d = 0; d < dim; d++) {
        min[d] = INFINITY;
        max[d] = -INFINITY;
    }
    switch (shape->kind) {
    case MPM_SHAPE_BOX:
        for (int d = 0; d < dim; d++) {
            min[d] = shape->min[d];
            max[d] = shape->max[d];
        }
        break;
    case MPM_SHAPE_BALL:
        for (int d = 0; d < dim; d++) {
            min[d] = shape->centre[d] - shape->radius;
            max[d] = shape->centre[d] + shape->radius;
        }
        break;
    case MPM_SHAPE_CYLINDER:
        for (int d = 0; d < dim; d++) { // the axis, and a circle's reach across it
            double length2 = 0;
            for (int e = 0; e < dim; e++) {
                length2 += (shape->max[e] - shape->min[e]) * (shape->max[e] - shape->min[e]);
            }
            const double a = shape->max[d] - shape->min[d];
            const double reach = shape->radius * sqrt(fmax(0, 1 - a * a / length2));
            min[d] = fmin(shape->min[d], shape->max[d]) - reach;
            max[d] = fmax(shape->min[d], shape->max[d]) + reach;
        }
        break;
    case MPM_SHAPE_POLYGON:
    case MPM_SHAPE_EXTRUDE:
    case MPM_SHAPE_POINTS:
        if (shape->kind == MPM_SHAPE_EXTRUDE) {
            min[2] = shape->min[2];
            max[2] = shape->max[2];
        }
        for (size_t k = 0; k < shape->n_points; k++) {
            const int given = shape->kind == MPM_SHAPE_POINTS ? dim : 2;
            const size_t width = shape->kind == MPM_SHAPE_POINTS ? (size_t)dim + 1 : 2;
            for (int d = 0; d < given; d++) {
                const double x = shape->points[k * width + (size_t)d];
                min[d] = fmin(min[d], x);
                max[d] = fmax(max[d], x);
            }
        }
        break;
    case MPM_SHAPE_DIFFERENCE: // what is taken away cannot make it larger
        if (shape->n_children > 0) {
            return mpm_shape_bounds(&shape->children[0], dim, min, max);
        }
        break;
    case MPM_SHAPE_UNION:
    case MPM_SHAPE_INTERSECTION:
        for (size_t k = 0; k < shape->n_children; k++) {
            double a[MPM_MAX_DIM], b[MPM_MAX_DIM];
            mpm_shape_bounds(&shape->children[k], dim, a, b);
            for (int d = 0; d < dim; d++) {
                const bool all = shape->kind == MPM_SHAPE_INTERSECTION && k > 0;
                min[d] = all ? fmax(min[d], a[d]) : fmin(min[d], a[d]);
                max[d] = all ? fmin(max[d], b[d]) : fmax(max[d], b[d]);
            }
        }
        break;
    }
    for (int d = 0; d < dim; d++) {
        if (!(min[d] <= max[d])) {
            return false;
        }
    }
    return true;
}

// ---- Rows -------------------------------------------------------------------------------------

struct span {
    size_t from, to;
};

// Index of the first of n ascending places that is >= value, or > value. They are evenly spaced but
// for round-off, so the guess is near.
static size_t first_at(const double *u, size_t n, double value, bool above) {
    if (!(value >= u[0])) {
        return 0;
    }
    if (!(value <= u[n - 1])) {
        return n;
    }
    const double step = n > 1 ? (u[n - 1] - u[0]) / (double)(n - 1) : 1;
    size_t k = (size_t)((value - u[0]) / step);
    k = k < n - 1 ? k : n - 1;
    while (k > 0 && (above ? u[k - 1] > value : u[k - 1] >= value)) {
        k--;
    }
    while (k < n && (above ? u[k] <= value : u[k] < value)) {
        k++;
    }
    return k;
}

static struct span span_of(const double *u, size_t n, double low, double high) {
    return (struct span){first_at(u, n, low, false), first_at(u, n, high, true)};
}

// The edges within `clear` of x.
static void sweep(struct outline *o, double x) {
    if (!(x >= o->swept_to)) { // back, or the first time
        o->n_begun = o->n_active = 0;
    } else if (x == o->swept_to) {
        return;
    }
    size_t kept = 0;
    while (o->n_begun < o->n && o->order[o->n_begun].at <= x + o->clear) {
        o->active[o->n_active++] = o->order[o->n_begun++].edge;
    }
    for (size_t k = 0; k < o->n_active; k++) {
        const double *edge = o->edges[o->active[k]];
        if (fmax(edge[0], edge[2]) >= x - o->clear) {
            o->active[kept++] = o->active[k];
        }
    }
    o->n_active = kept;
    o->swept_to = x;
}

// Heights that the edge has within `clear` of x, with as much to spare.
static void heights_near(const double *edge, double x, double clear, double *low, double *high) {
    const double dx = edge[2] - edge[0], dy = edge[3] - edge[1];
    double t0 = 0, t1 = 1;
    if (fabs(dx) > clear) {
        const double a = (x - clear - edge[0]) / dx, b = (x + clear - edge[0]) / dx;
        t0 = fmax(0, fmin(a, b));
        t1 = fmin(1, fmax(a, b));
    }
    *low = edge[1] + fmin(t0 * dy, t1 * dy) - clear;
    *high = edge[1] + fmax(t0 * dy, t1 * dy) + clear;
}

// Points (x, u[k]) of a polygon, all of them.
static void paint_outline(struct mpm_rows *r, const struct mpm_shape *shape,
                          const struct mpm_form *form, double x, const double *u, size_t n,
                          signed char *out) {
    struct outline *o = form->outline;
    struct mpm_crossing *crossings = r->crossings;
    size_t n_crossings = 0, n_doubts = 0, n_others = 0;
    sweep(o, x);
    for (size_t k = 0; k < o->n_active; k++) {
        const uint32_t e = o->active[k];
        const double *edge = o->edges[e];
        double low, high;
        if ((edge[0] > x) != (edge[2] > x)) {
            const double y = edge[1] + (x - edge[0]) / (edge[2] - edge[0]) * (edge[3] - edge[1]);
            size_t place = n_crossings++;
            for (; place > 0 && crossings[place - 1].at > y; place--) {
                crossings[place] = crossings[place - 1];
            }
            crossings[place] = (struct mpm_crossing){.at = y, .edge = e};
        } else {
            o->active[n_others++] = e;
        }
        heights_near(edge, x, o->clear, &low, &high);
        const struct span near = span_of(u, n, low, high);
        if (near.from < near.to) {
            r->doubts[n_doubts][0] = near.from;
            r->doubts[n_doubts++][1] = near.to;
        }
    }
    // Edges that do not meet cross the next row in the same order: then there is little to sort.
    for (size_t k = 0; k < n_crossings; k++) {
        o->active[n_others + k] = crossings[k].edge;
    }
    memset(out, -1, n);
    for (size_t k = 0; k + 1 < n_crossings; k += 2) { // the outline is closed: an even number
        const struct span in = span_of(u, n, crossings[k].at, crossings[k + 1].at);
        if (in.from < in.to) {
            memset(out + in.from, 1, in.to - in.from);
        }
    }
    for (size_t k = 0; k < n_doubts; k++) {
        memset(out + r->doubts[k][0], 2, r->doubts[k][1] - r->doubts[k][0]);
    }
    for (size_t k = 0; k < n_doubts; k++) {
        for (size_t i = r->doubts[k][0]; i < r->doubts[k][1]; i++) {
            if (out[i] == 2) {
                const double point[2] = {x, u[i]};
                out[i] = (signed char)polygon_side(shape, form, &r->lattice, point);
            }
        }
    }
}

static double place_of(const struct mpm_lattice *l, int d, long long k) {
    return l->spacing > 0 ? (l->first[d] + ((double)k + 0.5) * l->spacing) / l->unit
                          : (double)(2 * k + 1);
}

// Of an extrusion's section at the row's (x, y): looked at along y, for many rows at once.
static int section_side(struct mpm_rows *r, const struct mpm_shape *shape,
                        const struct mpm_form *form) {
    struct outline *o = form->outline;
    const long long from = r->index[1] & ~(long long)(MPM_ROW - 1);
    if (!o || !o->swept) {
        return polygon_side(shape, form, &r->lattice, r->place);
    }
    if (!o->plane || o->plane_at[0] != r->index[0] || o->plane_at[1] != from) {
        if (!o->plane && !(o->plane = malloc(MPM_ROW))) {
            return polygon_side(shape, form, &r->lattice, r->place);
        }
        for (size_t k = 0; k < MPM_ROW && !(r->has_v && r->v_from == from); k++) {
            r->v[k] = place_of(&r->lattice, 1, from + (long long)k);
        }
        r->has_v = true;
        r->v_from = from;
        o->plane_at[0] = r->index[0];
        o->plane_at[1] = from;
        paint_outline(r, shape, form, r->place[0], r->v, MPM_ROW, o->plane);
    }
    return o->plane[r->index[1] - from];
}

// A run between two places along the last direction, of a side known across it.
static struct span paint_between(const struct mpm_rows *r, double from, double to, int across,
                                 signed char *out) {
    const int last = r->lattice.dim - 1;
    const double a = snapped(from, r->lattice.origin[last], r->lattice.unit);
    const double b = snapped(to, r->lattice.origin[last], r->lattice.unit);
    struct span s = {0, 0};
    if (across < 0 || !(a <= b)) {
        return s;
    }
    s = span_of(r->u, r->n, a, b);
    for (size_t k = s.from; k < s.to; k++) {
        out[k] = (signed char)across;
    }
    for (size_t k = s.from; k < s.to && r->u[k] == a; k++) {
        out[k] = 0;
    }
    for (size_t k = s.to; k > s.from && r->u[k - 1] == b; k--) {
        out[k - 1] = 0;
    }
    return s;
}

// First index in [from, to) whose side is at least (or, falling, below) `least`; the sides of a
// ball rise towards its centre and fall behind it, to the last bit, for each operation is monotone.
static size_t ball_turn(const struct mpm_rows *r, double r2, double centre, double radius,
                        size_t from, size_t to, int least, bool falling) {
    while (from < to) {
        const size_t middle = (from + to) / 2;
        if ((ball_side(r2, r->u[middle] - centre, radius) >= least) != falling) {
            to = middle;
        } else {
            from = middle + 1;
        }
    }
    return from;
}

static struct span paint_ball(const struct mpm_rows *r, const struct mpm_shape *shape,
                              signed char *out) {
    const struct mpm_lattice *l = &r->lattice;
    const int last = l->dim - 1;
    const double centre = snapped(shape->centre[last], l->origin[last], l->unit);
    const double radius = snapped(shape->radius, 0, l->unit);
    double r2 = 0;
    for (int d = 0; d < last; d++) {
        const double e = r->place[d] - snapped(shape->centre[d], l->origin[d], l->unit);
        r2 += e * e;
    }
    const size_t middle = first_at(r->u, r->n, centre, false);
    struct span s, in;
    s.from = ball_turn(r, r2, centre, radius, 0, middle, 0, false);
    s.to = ball_turn(r, r2, centre, radius, middle, r->n, 0, true);
    in.from = ball_turn(r, r2, centre, radius, s.from, middle, 1, false);
    in.to = ball_turn(r, r2, centre, radius, middle, s.to, 1, true);
    if (s.from < s.to) {
        memset(out + s.from, 0, s.to - s.from);
    }
    if (in.from < in.to) {
        memset(out + in.from, 1, in.to - in.from);
    }
    return s;
}

static struct span paint_singly(const struct mpm_rows *r, const struct mpm_shape *shape,
                                const struct mpm_form *form, struct span s, signed char *out) {
    double point[MPM_MAX_DIM];
    memcpy(point, r->place, sizeof point);
    for (size_t k = s.from; k < s.to; k++) {
        point[r->lattice.dim - 1] = r->u[k];
        out[k] = (signed char)side(shape, form, &r->lattice, point);
    }
    return s;
}

static struct span common(struct span a, struct span b) {
    const struct span s = {a.from > b.from ? a.from : b.from, a.to < b.to ? a.to : b.to};
    return s.from < s.to ? s : (struct span){0, 0};
}

static struct span paint(struct mpm_rows *r, const struct mpm_shape *shape, struct mpm_form *form,
                         int depth, signed char *out);

static struct span paint_set(struct mpm_rows *r, const struct mpm_shape *shape,
                             struct mpm_form *form, int depth, struct span s, signed char *out) {
    signed char *other = r->side[depth + 1];
    if (shape->kind == MPM_SHAPE_UNION) {
        memset(out + s.from, -1, s.to - s.from);
    } else {
        s = paint(r, &shape->children[0], &form->children[0], depth, out);
    }
    for (size_t k = shape->kind == MPM_SHAPE_UNION ? 0 : 1; s.from < s.to && k < shape->n_children;
         k++) {
        const struct span there =
            paint(r, &shape->children[k], &form->children[k], depth + 1, other);
        const struct span both = common(s, there);
        switch (shape->kind) {
        case MPM_SHAPE_UNION:
            for (size_t i = both.from; i < both.to; i++) {
                out[i] = out[i] > other[i] ? out[i] : other[i];
            }
            break;
        case MPM_SHAPE_DIFFERENCE:
            for (size_t i = both.from; i < both.to; i++) {
                const signed char not_there = (signed char)-other[i];
                out[i] = out[i] < not_there ? out[i] : not_there;
            }
            break;
        default: // intersection
            s = both;
            for (size_t i = both.from; i < both.to; i++) {
                out[i] = out[i] < other[i] ? out[i] : other[i];
            }
        }
    }
    return s;
}

// Writes the sides of the row's points in the span that is returned; the others are outside.
static struct span paint(struct mpm_rows *r, const struct mpm_shape *shape, struct mpm_form *form,
                         int depth, signed char *out) {
    const int last = r->lattice.dim - 1;
    const struct window *w = &form->window;
    for (int d = 0; d < last; d++) {
        if (r->place[d] < w->low[d] || r->place[d] > w->high[d]) {
            return (struct span){0, 0};
        }
    }
    const struct span s = span_of(r->u, r->n, w->low[last], w->high[last]);
    if (s.from >= s.to) {
        return (struct span){0, 0};
    }
    switch (shape->kind) {
    case MPM_SHAPE_BOX: {
        int across = 1;
        for (int d = 0; d < last; d++) {
            const int here = between(shape->min[d], shape->max[d], r->lattice.origin[d],
                                     r->lattice.unit, r->place[d]);
            across = here < across ? here : across;
        }
        return paint_between(r, shape->min[last], shape->max[last], across, out);
    }
    case MPM_SHAPE_BALL:
        return paint_ball(r, shape, out);
    case MPM_SHAPE_POLYGON:
        if (form->outline && form->outline->swept && last == 1) {
            paint_outline(r, shape, form, r->place[0], r->u + s.from, s.to - s.from, out + s.from);
            return s;
        }
        return paint_singly(r, shape, form, s, out);
    case MPM_SHAPE_EXTRUDE:
        return paint_between(r, shape->min[2], shape->max[2], section_side(r, shape, form), out);
    case MPM_SHAPE_POINTS:
        return (struct span){0, 0};
    case MPM_SHAPE_CYLINDER:
        return paint_singly(r, shape, form, s, out);
    case MPM_SHAPE_UNION:
    case MPM_SHAPE_DIFFERENCE:
    case MPM_SHAPE_INTERSECTION:
        if (form->children && depth < MPM_SHAPE_DEPTH) {
            return paint_set(r, shape, form, depth, s, out);
        }
    }
    return paint_singly(r, shape, form, s, out);
}

void mpm_rows_create(struct mpm_rows *r, const struct mpm_shape *shape,
                     const struct mpm_lattice *lattice) {
    size_t most = 0;
    r->shape = shape;
    r->lattice = *lattice;
    r->n_u = 0;
    r->has_v = false;
    r->crossings = NULL;
    r->doubts = NULL;
    r->form = calloc(1, sizeof *r->form);
    if (!r->form) {
        return;
    }
    form_fill(r->form, shape, lattice, true, &most);
    r->crossings = calloc(most + 1, sizeof *r->crossings);
    r->doubts = calloc(most + 1, sizeof *r->doubts);
    if (!r->crossings || !r->doubts) {
        mpm_rows_free(r);
    }
}

const signed char *mpm_rows_at(struct mpm_rows *r, const long long *index, size_t n) {
    const int last = r->lattice.dim - 1;
    signed char *out = r->side[0];
    for (int d = 0; d <= last; d++) {
        r->index[d] = index[d];
        r->place[d] = place_of(&r->lattice, d, index[d]);
    }
    if (r->u_from != index[last] || n > r->n_u) {
        for (size_t k = 0; k < n; k++) {
            r->u[k] = place_of(&r->lattice, last, index[last] + (long long)k);
        }
        r->u_from = index[last];
        r->n_u = n;
    }
    r->n = n;
    if (!r->form) {
        paint_singly(r, r->shape, NULL, (struct span){0, n}, out);
        return out;
    }
    const struct span s = paint(r, r->shape, r->form, 0, out);
    memset(out, -1, s.from);
    memset(out + s.to, -1, n - s.to);
    return out;
}

void mpm_rows_free(struct mpm_rows *r) {
    if (r->form) {
        form_clear(r->form, r->shape);
    }
    free(r->form);
    free(r->crossings);
    free(r->doubts);
    r->form = NULL;
    r->crossings = NULL;
    r->doubts = NULL;
}

// ---- Work -------------------------------------------------------------------------------------

// What takes as long as so many looks at a point of a row, measured.
#define ROW_LOOKS 50.0   // to begin a row
#define CROSS_LOOKS 30.0 // an edge with a row
#define EDGE_LOOKS 100.0 // to make an edge ready
#define POINT_LOOKS 20.0 // a point alone

double mpm_shape_looks(const struct mpm_shape *shape, int dim, const double *min, const double *max,
                       double spacing) {
    double low[MPM_MAX_DIM], high[MPM_MAX_DIM], n[MPM_MAX_DIM], points = 1, looks = ROW_LOOKS;
    for (size_t k = 0; k < shape->n_children; k++) {
        looks += mpm_shape_looks(&shape->children[k], dim, min, max, spacing);
    }
    if (shape->n_children > 0 || shape->kind == MPM_SHAPE_POINTS ||
        !mpm_shape_bounds(shape, dim, low, high)) {
        return looks;
    }
    const bool flat = shape->kind == MPM_SHAPE_POLYGON || shape->kind == MPM_SHAPE_EXTRUDE;
    looks += flat ? EDGE_LOOKS * (double)shape->n_points : 0;
    for (int d = 0; d < dim; d++) {
        n[d] = (fmin(high[d], max[d]) - fmax(low[d], min[d])) / spacing + 1;
        if (!(n[d] > 0)) {
            return looks;
        }
        points *= n[d];
    }
    looks += points * (shape->kind == MPM_SHAPE_CYLINDER ? POINT_LOOKS : 1) +
             ROW_LOOKS * points / n[dim - 1];
    const double *a = flat ? shape->points + 2 * (shape->n_points - 1) : NULL;
    for (size_t i = 0; flat && i < shape->n_points; i++) {
        const double *b = shape->points + 2 * i;
        const double length = fmin(fmax(a[0], b[0]), max[0]) - fmax(fmin(a[0], b[0]), min[0]);
        looks += length > 0 ? CROSS_LOOKS * (length / spacing + 1) : 0;
        a = b;
    }
    return looks;
}

double mpm_shape_edges(const struct mpm_shape *shape) {
    double edges = 1 + (shape->kind == MPM_SHAPE_POINTS ? 0 : (double)shape->n_points);
    for (size_t k = 0; k < shape->n_children; k++) {
        edges += mpm_shape_edges(&shape->children[k]);
    }
    return edges;
}
