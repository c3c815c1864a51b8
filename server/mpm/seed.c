// Filling shapes with particles: an n^dim lattice in each cell, kept where the shape holds the
// point.
//
// A lattice point sits at odd multiples of half a spacing from the domain's corner. Whether it lies
// on an edge is decided in those units: an edge within SNAP of a multiple of half a spacing is
// taken to be that multiple, so that round-off in the input cannot move it across a particle.
#include "server/mpm/seed.h"

#include <math.h>
#include <stdlib.h>

#include "server/mpm/solution.h"

#define SNAP 1e-7 // half spacings

struct lattice {
    int dim;
    double origin[MPM_MAX_DIM]; // m
    double unit;                // m, half a spacing
    bool closed;
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

// ---- Forms: polygons made ready for many points -----------------------------------------------

#define BANDS 64 // of a polygon's height

// A shape's tree once more, with what its polygons need: for each band of their height the edges
// that reach into it, so that a point looks at few of them. A form without edges says nothing.
struct form {
    struct form *children; // those of the shape
    double (*edges)[4];    // from (x, y) to (x, y), snapped, band by band
    size_t begin[BANDS + 1];
    double low, high; // heights that they reach, with 1 to spare
};

static void form_clear(struct form *form, const struct mpm_shape *shape) {
    for (size_t k = 0; form->children && k < shape->n_children; k++) {
        form_clear(&form->children[k], &shape->children[k]);
    }
    free(form->children);
    free(form->edges);
}

static size_t band_of(const struct form *form, double height) {
    const double band = (height - form->low) / (form->high - form->low) * BANDS;
    return band < 0 ? 0 : band < BANDS - 1 ? (size_t)band : BANDS - 1;
}

// Without memory the form stays empty: then every edge is looked at.
static void form_polygon(struct form *form, const struct mpm_shape *shape,
                         const struct lattice *l) {
    const size_t n = shape->n_points;
    double(*edges)[4] = calloc(n + 1, sizeof *edges);
    form->low = INFINITY;
    form->high = -INFINITY;
    for (size_t i = 0, j = n - 1; edges && i < n; j = i++) {
        for (size_t d = 0; d < 2; d++) {
            edges[i][d] = snapped(shape->points[2 * j + d], l->origin[d], l->unit);
            edges[i][2 + d] = snapped(shape->points[2 * i + d], l->origin[d], l->unit);
        }
        form->low = fmin(form->low, edges[i][1] - 1);
        form->high = fmax(form->high, edges[i][1] + 1);
    }
    size_t count = 0;
    for (int pass = 0; edges && pass < 2; pass++) { // counts, then puts them there
        count = 0;
        for (size_t band = 0; band < BANDS; band++) {
            form->begin[band] = count;
            for (size_t i = 0; i < n; i++) {
                const double lower = fmin(edges[i][1], edges[i][3]) - 1;
                const double upper = fmax(edges[i][1], edges[i][3]) + 1;
                if (band < band_of(form, lower) || band > band_of(form, upper)) {
                    continue;
                }
                if (pass == 1) {
                    for (size_t d = 0; d < 4; d++) {
                        form->edges[count][d] = edges[i][d];
                    }
                }
                count++;
            }
        }
        form->begin[BANDS] = count;
        if (pass == 0 && !(form->edges = calloc(count + 1, sizeof *edges))) {
            break;
        }
    }
    free(edges);
}

static void form_fill(struct form *form, const struct mpm_shape *shape, const struct lattice *l) {
    *form = (struct form){0};
    if (shape->kind == MPM_SHAPE_POLYGON || shape->kind == MPM_SHAPE_EXTRUDE) {
        form_polygon(form, shape, l);
    } else if (shape->n_children > 0) {
        form->children = calloc(shape->n_children, sizeof *form->children);
        for (size_t k = 0; form->children && k < shape->n_children; k++) {
            form_fill(&form->children[k], &shape->children[k], l);
        }
    }
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
static int polygon_side(const struct mpm_shape *shape, const struct form *form,
                        const struct lattice *l, const double *point) {
    struct crossing c = {0};
    if (form && form->edges) {
        if (point[1] < form->low || point[1] > form->high) {
            return -1;
        }
        const size_t band = band_of(form, point[1]);
        for (size_t k = form->begin[band]; !c.on_edge && k < form->begin[band + 1]; k++) {
            cross_edge(&c, form->edges[k], form->edges[k] + 2, point);
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

static int cylinder_side(const struct mpm_shape *shape, const struct lattice *l,
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
static int side(const struct mpm_shape *shape, const struct form *form, const struct lattice *l,
                const double *point) {
    const struct form *children = form ? form->children : NULL;
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
        for (int d = 0; d < l->dim; d++) {
            const double e = point[d] - snapped(shape->centre[d], l->origin[d], l->unit);
            r2 += e * e;
        }
        const double radius = snapped(shape->radius, 0, l->unit), gap = radius * radius - r2;
        return fabs(gap) < SNAP * radius ? 0 : gap > 0 ? 1 : -1;
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
            const int here =
                side(&shape->children[k], children ? &children[k] : NULL, l, point);
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
    struct lattice lattice; // in units of the margin: "on the edge" is closer than SNAP margins
    struct form form;
};

static bool contains(const struct mpm_shape *shape, const struct form *form,
                     const struct lattice *l, const double *x) {
    double point[MPM_MAX_DIM];
    for (int d = 0; d < l->dim; d++) {
        point[d] = x[d] / l->unit;
    }
    return side(shape, form, l, point) > 0;
}

bool mpm_shape_contains(const struct mpm_shape *shape, const double *x, int dim, double margin) {
    const struct lattice l = {.dim = dim, .unit = margin};
    return contains(shape, NULL, &l, x);
}

struct mpm_region *mpm_region_create(const struct mpm_shape *shape, int dim, double margin) {
    struct mpm_region *region = calloc(1, sizeof *region);
    if (region) {
        region->shape = shape;
        region->lattice = (struct lattice){.dim = dim, .unit = margin};
        form_fill(&region->form, shape, &region->lattice);
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

// Lattice indices [first, last) per direction that can hold points of the shape.
static bool lattice_range(const struct mpm_def *def, const struct mpm_body_def *body, double *first,
                          double *last) {
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM];
    if (!mpm_shape_bounds(&body->shape, def->dimension, min, max)) {
        return false;
    }
    const double spacing = def->cell / body->particles_per_direction;
    for (int d = 0; d < def->dimension; d++) {
        first[d] = floor((min[d] - def->domain_min[d]) / spacing - 1);
        last[d] = ceil((max[d] - def->domain_min[d]) / spacing + 1);
    }
    return true;
}

double mpm_seed_bound(const struct mpm_def *def, const struct mpm_body_def *body) {
    if (body->shape.kind == MPM_SHAPE_POINTS) {
        return (double)body->shape.n_points;
    }
    double first[MPM_MAX_DIM], last[MPM_MAX_DIM], bound = 1;
    if (!lattice_range(def, body, first, last)) {
        return 0;
    }
    for (int d = 0; d < def->dimension; d++) {
        bound *= last[d] - first[d];
    }
    return bound;
}

// Lattice points of a box, direction by direction: no need to visit them.
static size_t count_box(const struct mpm_shape *box, const struct lattice *l, const long long *from,
                        const long long *to) {
    size_t count = 1;
    for (int d = 0; d < l->dim; d++) {
        const double a = snapped(box->min[d], l->origin[d], l->unit);
        const double b = snapped(box->max[d], l->origin[d], l->unit);
        size_t here = 0;
        for (long long k = from[d]; k < to[d]; k++) {
            const double point = (double)(2 * k + 1);
            here += l->closed ? point >= a && point <= b : point > a && point < b;
        }
        count *= here;
    }
    return count;
}

size_t mpm_seed(const struct mpm_def *def, const struct mpm_body_def *body,
                bool (*each)(void *context, const double *x, double volume), void *context) {
    const int dim = def->dimension;
    if (body->shape.kind == MPM_SHAPE_POINTS) {
        for (size_t k = 0; k < body->shape.n_points; k++) {
            const double *point = body->shape.points + k * (size_t)(dim + 1);
            if (each && !each(context, point, point[dim])) {
                return k;
            }
        }
        return body->shape.n_points;
    }
    double first[MPM_MAX_DIM], last[MPM_MAX_DIM];
    if (!lattice_range(def, body, first, last)) {
        return 0;
    }
    const double spacing = def->cell / body->particles_per_direction;
    struct lattice l = {.dim = dim, .unit = spacing / 2, .closed = body->closed};
    long long from[MPM_MAX_DIM] = {0}, to[MPM_MAX_DIM] = {1, 1, 1};
    double volume = 1;
    for (int d = 0; d < dim; d++) {
        l.origin[d] = def->domain_min[d];
        from[d] = (long long)first[d];
        to[d] = (long long)last[d];
        volume *= spacing;
    }
    if (!each && body->shape.kind == MPM_SHAPE_BOX) {
        return count_box(&body->shape, &l, from, to);
    }
    struct form form;
    form_fill(&form, &body->shape, &l);
    size_t count = 0;
    bool wanted = true;
    for (long long i = from[0]; wanted && i < to[0]; i++) {
        for (long long j = from[1]; wanted && j < to[1]; j++) {
            for (long long k = from[2]; wanted && k < to[2]; k++) {
                const long long index[MPM_MAX_DIM] = {i, j, k};
                double point[MPM_MAX_DIM], x[MPM_MAX_DIM];
                for (int d = 0; d < dim; d++) {
                    point[d] = (double)(2 * index[d] + 1);
                    x[d] = l.origin[d] + ((double)index[d] + 0.5) * spacing;
                }
                if (side(&body->shape, &form, &l, point) < (l.closed ? 0 : 1)) {
                    continue;
                }
                wanted = !each || each(context, x, volume);
                count += wanted;
            }
        }
    }
    form_clear(&form, &body->shape);
    return count;
}

void mpm_velocity_at(const struct mpm_velocity *field, const double *x, int dim, double *v) {
    double r[MPM_MAX_DIM];
    for (int d = 0; d < dim; d++) {
        v[d] = 0;
        r[d] = x[d] - field->centre[d];
    }
    switch (field->kind) {
    case MPM_VELOCITY_UNIFORM:
        for (int d = 0; d < dim; d++) {
            v[d] = field->vector[d];
        }
        break;
    case MPM_VELOCITY_ROTATION:
        if (dim == 2) {
            v[0] = -field->rate * r[1];
            v[1] = field->rate * r[0];
        } else {
            const double *n = field->vector;
            v[0] = field->rate * (n[1] * r[2] - n[2] * r[1]);
            v[1] = field->rate * (n[2] * r[0] - n[0] * r[2]);
            v[2] = field->rate * (n[0] * r[1] - n[1] * r[0]);
        }
        break;
    case MPM_VELOCITY_MODE:
        v[field->axis] = field->amplitude * sin((2 * field->number - 1) * M_PI / 2 *
                                                (x[field->axis] - field->from) / field->length);
        break;
    case MPM_VELOCITY_SOLUTION:
        mpm_solution_start(&field->solution, x, dim, v);
        break;
    }
}

double mpm_seed_half(const struct mpm_body_def *body) {
    return 1 / (2.0 * body->particles_per_direction);
}
