// Filling shapes with particles: an n^dim lattice in each cell, kept where the shape holds the
// point. A lattice point sits at odd multiples of half a spacing from the domain's corner.
#include "server/mpm/seed.h"

#include <math.h>
#include <string.h>

#include "server/mpm/solution.h"

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

// Of `each`: what is asked of the particles besides.
struct asking {
    const struct mpm_sieve *sieve;
    bool (*each)(void *context, const double *x, double volume);
    void *context;
    size_t count;
};

static bool in_box(const struct mpm_sieve *sieve, const double *x, int dim) {
    for (int d = 0; d < dim; d++) {
        if (!(x[d] >= sieve->min[d] && x[d] <= sieve->max[d])) {
            return false;
        }
    }
    return true;
}

static void seed_points(const struct mpm_shape *shape, int dim, struct asking *a) {
    const struct mpm_sieve *sieve = a->sieve;
    struct mpm_region *region =
        sieve && sieve->shape ? mpm_region_create(sieve->shape, dim, sieve->margin) : NULL;
    for (size_t k = 0; k < shape->n_points; k++) {
        const double *x = shape->points + k * (size_t)(dim + 1);
        if (sieve && sieve->has_box && !in_box(sieve, x, dim)) {
            continue;
        }
        if (sieve && sieve->shape &&
            (region ? mpm_region_contains(region, x)
                    : mpm_shape_contains(sieve->shape, x, dim, sieve->margin)) != sieve->inside) {
            continue;
        }
        if (a->each && !a->each(a->context, x, x[dim])) {
            break;
        }
        a->count++;
    }
    mpm_region_free(region);
}

// Lattice indices [from, to) that can hold particles which the sieve lets through.
static void narrow(const struct mpm_sieve *sieve, const struct mpm_def *def, double spacing,
                   long long *from, long long *to) {
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM];
    for (int pass = 0; pass < 2; pass++) {
        if (pass == 0 ? !sieve->has_box : !(sieve->shape && sieve->inside)) {
            continue;
        }
        const bool there = pass == 0 || mpm_shape_bounds(sieve->shape, def->dimension, min, max);
        for (int d = 0; d < def->dimension; d++) {
            const double low = pass == 0 ? sieve->min[d] : min[d];
            const double high = pass == 0 ? sieve->max[d] : max[d];
            // Two to spare: round-off is far below one.
            const double begin =
                fmax((double)from[d], floor((low - def->domain_min[d]) / spacing) - 2);
            const double end = fmin((double)to[d], ceil((high - def->domain_min[d]) / spacing) + 2);
            if (!there || begin >= end) {
                to[d] = from[d];
                continue;
            }
            from[d] = (long long)begin;
            to[d] = (long long)end;
        }
    }
}

// One row of the lattice; `other` are the same points as the sieve's shape sees them, or NULL.
// False when no more are wanted.
static bool seed_row(const struct mpm_lattice *l, int least, const signed char *sides,
                     const signed char *other, const long long *index, size_t n, double volume,
                     struct asking *a) {
    const int dim = l->dim;
    const double spacing = 2 * l->unit;
    const struct mpm_sieve *sieve = a->sieve;
    const bool has_box = sieve && sieve->has_box;
    double x[MPM_MAX_DIM];
    size_t count = 0;
    if (!a->each && !has_box && !other) {
        for (size_t k = 0; k < n; k++) {
            count += sides[k] >= least;
        }
        a->count += count;
        return true;
    }
    for (int d = 0; d < dim; d++) {
        x[d] = l->origin[d] + ((double)index[d] + 0.5) * spacing;
    }
    for (size_t k = 0; k < n; k++) {
        if (sides[k] < least || (other && (other[k] > 0) != sieve->inside)) {
            continue;
        }
        x[dim - 1] = l->origin[dim - 1] + ((double)(index[dim - 1] + (long long)k) + 0.5) * spacing;
        if (has_box && !in_box(sieve, x, dim)) {
            continue;
        }
        if (a->each && !a->each(a->context, x, volume)) {
            return false;
        }
        a->count++;
    }
    return true;
}

size_t mpm_seed_sifted(const struct mpm_def *def, const struct mpm_body_def *body,
                       const struct mpm_sieve *sieve,
                       bool (*each)(void *context, const double *x, double volume), void *context) {
    const int dim = def->dimension, last = dim - 1;
    struct asking a = {.sieve = sieve, .each = each, .context = context};
    if (body->shape.kind == MPM_SHAPE_POINTS) {
        seed_points(&body->shape, dim, &a);
        return a.count;
    }
    double first[MPM_MAX_DIM], past[MPM_MAX_DIM];
    if (!lattice_range(def, body, first, past)) {
        return 0;
    }
    const double spacing = def->cell / body->particles_per_direction;
    struct mpm_lattice l = {.dim = dim, .unit = spacing / 2};
    long long from[MPM_MAX_DIM] = {0}, to[MPM_MAX_DIM] = {1, 1, 1};
    double volume = 1;
    for (int d = 0; d < dim; d++) {
        l.origin[d] = def->domain_min[d];
        from[d] = (long long)first[d];
        to[d] = (long long)past[d];
        volume *= spacing;
    }
    const bool looks = sieve && sieve->shape;
    struct mpm_lattice seen = {.dim = dim, .spacing = spacing};
    if (sieve) {
        narrow(sieve, def, spacing, from, to);
    }
    if (looks) {
        seen.unit = sieve->margin;
        memcpy(seen.first, def->domain_min, sizeof seen.first);
    }
    struct mpm_rows rows, other;
    mpm_rows_create(&rows, &body->shape, &l);
    if (looks) {
        mpm_rows_create(&other, sieve->shape, &seen);
    }
    const int least = body->closed ? 0 : 1;
    bool wanted = true;
    for (long long i = from[0]; wanted && i < to[0]; i++) {
        for (long long j = dim == 3 ? from[1] : 0; wanted && j < (dim == 3 ? to[1] : 1); j++) {
            for (long long k = from[last]; wanted && k < to[last]; k += MPM_ROW) {
                const size_t n = (size_t)(to[last] - k < MPM_ROW ? to[last] - k : MPM_ROW);
                const long long index[MPM_MAX_DIM] = {i, dim == 3 ? j : k, k};
                const signed char *sides = mpm_rows_at(&rows, index, n);
                if (!looks) {
                    wanted = seed_row(&l, least, sides, NULL, index, n, volume, &a);
                    continue;
                }
                size_t here = 0;
                for (size_t p = 0; p < n; p++) {
                    here += sides[p] >= least;
                }
                if (here > 0) {
                    wanted = seed_row(&l, least, sides, mpm_rows_at(&other, index, n), index, n,
                                      volume, &a);
                }
            }
        }
    }
    mpm_rows_free(&rows);
    if (looks) {
        mpm_rows_free(&other);
    }
    return a.count;
}

// That a particle takes besides. It takes more where something is done with it, but how many there
// are is a matter of memory.
#define PARTICLE_LOOKS 1.0
#define SINGLE_LOOKS 5.0 // that one point takes with one edge

double mpm_seed_looks(const struct mpm_def *def, const struct mpm_body_def *body,
                      const struct mpm_sieve *sieve) {
    const int dim = def->dimension;
    const struct mpm_shape *seen = sieve ? sieve->shape : NULL;
    const double spacing = def->cell / body->particles_per_direction;
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM], low[MPM_MAX_DIM], high[MPM_MAX_DIM], looks;
    if (!mpm_shape_bounds(&body->shape, dim, min, max)) {
        return 0;
    }
    const bool narrows = seen && sieve->inside && mpm_shape_bounds(seen, dim, low, high);
    for (int d = 0; d < dim; d++) {
        if (sieve && sieve->has_box) {
            min[d] = fmax(min[d], sieve->min[d]);
            max[d] = fmin(max[d], sieve->max[d]);
        }
        if (narrows) {
            min[d] = fmax(min[d], low[d]);
            max[d] = fmin(max[d], high[d]);
        }
    }
    if (body->shape.kind == MPM_SHAPE_POINTS) { // each against, at worst, every edge
        const double each = seen ? SINGLE_LOOKS * mpm_shape_edges(seen) : 0;
        return (double)body->shape.n_points * (PARTICLE_LOOKS + each);
    }
    looks = mpm_shape_looks(&body->shape, dim, min, max, spacing);
    if (seen) {
        looks += mpm_shape_looks(seen, dim, min, max, spacing);
    }
    double points = 1;
    for (int d = 0; d < dim; d++) {
        points *= fmax(0, (max[d] - min[d]) / spacing + 1);
    }
    return looks + PARTICLE_LOOKS * points;
}

size_t mpm_seed(const struct mpm_def *def, const struct mpm_body_def *body,
                bool (*each)(void *context, const double *x, double volume), void *context) {
    return mpm_seed_sifted(def, body, NULL, each, context);
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
