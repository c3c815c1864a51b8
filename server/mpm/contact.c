// Barrier contact with rigid bodies, with Coulomb friction, on the particles.
//
// Pressure and friction act on particles that are nearer to the surface than `distance` and go to
// the grid with their weights, like loads. The barrier alone keeps particles out while a step moves
// them by less than their distance; INNERMOST catches those that a fast step would carry past it.
//
// Friction is elastic up to Coulomb's limit (Cundall and Strack 1979): a spring from where on the
// body the particle first touched, or where it last slid to, with critical damping. A drag on the
// velocity alone would let a body that should stick creep, at tau dt/(density spacing) under a
// shear stress tau.
#include "server/mpm/contact.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/seed.h"

#define INNERMOST                                                                                  \
    0.01         // of `distance`: the barrier's pressure there is about 108 times its stiffness
#define TRIES 8  // pushes out of a concave corner, where leaving one side may lead to another
#define BATCH 64 // contacts that are sent to the grid at a time

bool mpm_rigid_shape_is_known(const struct mpm_shape *shape) {
    return shape->kind == MPM_SHAPE_BOX || shape->kind == MPM_SHAPE_BALL ||
           shape->kind == MPM_SHAPE_POLYGON;
}

size_t mpm_rigid_bytes(const struct mpm_rigid_def *def, int dim, size_t n_particles) {
    return def->friction > 0 ? n_particles * (size_t)dim * sizeof(double) : 0;
}

bool mpm_rigid_create(struct mpm_rigid *rigid, const struct mpm_rigid_def *def, int dim,
                      size_t n_particles) {
    *rigid = (struct mpm_rigid){
        .def = *def, .active = true, .anchor_bytes = mpm_rigid_bytes(def, dim, n_particles)};
    mpm_shape_bounds(&def->shape, dim, rigid->min, rigid->max);
    if (rigid->anchor_bytes == 0) {
        return true;
    }
    rigid->anchor = malloc(rigid->anchor_bytes);
    for (size_t i = 0; rigid->anchor && i < n_particles * (size_t)dim; i++) {
        rigid->anchor[i] = INFINITY;
    }
    return rigid->anchor != NULL;
}

void mpm_rigid_free(struct mpm_rigid *rigid) {
    free(rigid->anchor);
    rigid->anchor = NULL;
}

double mpm_rigid_speed(const struct mpm_rigid_def *def, int dim) {
    double speed = 0;
    for (int d = 0; d < dim; d++) {
        speed = hypot(speed, def->velocity[d]);
    }
    return speed;
}

static double box_distance(const struct mpm_shape *box, const double *x, int dim, double *n) {
    double outside2 = 0, least = -INFINITY, q[MPM_MAX_DIM];
    int face = 0;
    for (int d = 0; d < dim; d++) {
        const double below = box->min[d] - x[d], above = x[d] - box->max[d];
        q[d] = fmax(below, above);
        n[d] = 0;
        if (q[d] > least) {
            least = q[d];
            face = d;
        }
        if (q[d] > 0) {
            outside2 += q[d] * q[d];
        }
    }
    if (least <= 0) {
        n[face] = x[face] - box->max[face] == least ? 1 : -1;
        return least;
    }
    const double distance = sqrt(outside2);
    for (int d = 0; d < dim; d++) {
        if (q[d] > 0) {
            n[d] = (x[d] > box->max[d] ? q[d] : -q[d]) / distance;
        }
    }
    return distance;
}

static double ball_distance(const struct mpm_shape *ball, const double *x, int dim, double *n) {
    double r2 = 0;
    for (int d = 0; d < dim; d++) {
        n[d] = x[d] - ball->centre[d];
        r2 += n[d] * n[d];
    }
    const double r = sqrt(r2);
    for (int d = 0; d < dim; d++) {
        n[d] = r > 0 ? n[d] / r : d == 0;
    }
    return r - ball->radius;
}

// Nearest to the inside of an edge, distance and normal are the edge's own, to round-off whatever
// the distance; at a corner they are those of the way to it, and a ray tells inside from outside.
static double polygon_distance(const struct mpm_shape *polygon, const double *x, double *n) {
    double least2 = INFINITY, away[2] = {0}, edge[2] = {0}, area = 0, side = 0;
    bool inside = false, at_corner = false;
    for (size_t i = 0, j = polygon->n_points - 1; i < polygon->n_points; j = i++) {
        const double *a = polygon->points + 2 * j, *b = polygon->points + 2 * i;
        const double e[2] = {b[0] - a[0], b[1] - a[1]}, r[2] = {x[0] - a[0], x[1] - a[1]};
        const double length2 = e[0] * e[0] + e[1] * e[1], along = r[0] * e[0] + r[1] * e[1];
        const double t = fmin(1, fmax(0, along / length2)), across = r[0] * e[1] - r[1] * e[0];
        const double q[2] = {r[0] - t * e[0], r[1] - t * e[1]};
        const bool corner = along <= 0 || along >= length2;
        const double r2 = corner ? q[0] * q[0] + q[1] * q[1] : across * across / length2;
        if (r2 < least2) {
            least2 = r2;
            at_corner = corner;
            side = across;
            memcpy(away, q, sizeof away);
            memcpy(edge, e, sizeof edge);
        }
        if ((a[1] > x[1]) != (b[1] > x[1])) {
            inside ^= x[0] < a[0] + (x[1] - a[1]) / e[1] * e[0];
        }
        area += (a[0] - x[0]) * (b[1] - x[1]) - (b[0] - x[0]) * (a[1] - x[1]);
    }
    const double length = hypot(edge[0], edge[1]), way = area > 0 ? 1 : -1;
    if (!at_corner || least2 == 0) { // the outward side of the edge, right of it on the way round
        n[0] = way * edge[1] / length;
        n[1] = -way * edge[0] / length;
        return at_corner ? 0 : way * side / length;
    }
    const double distance = (inside ? -1 : 1) * sqrt(least2);
    n[0] = away[0] / distance;
    n[1] = away[1] / distance;
    return distance;
}

double mpm_shape_distance(const struct mpm_shape *shape, const double *x, int dim, double *normal) {
    switch (shape->kind) {
    case MPM_SHAPE_BOX:
        return box_distance(shape, x, dim, normal);
    case MPM_SHAPE_BALL:
        return ball_distance(shape, x, dim, normal);
    case MPM_SHAPE_POLYGON:
        return polygon_distance(shape, x, normal);
    default:
        return INFINITY; // mpm_check lets none of these through
    }
}

double mpm_barrier_pressure(const struct mpm_rigid_def *def, double d) {
    const double D = def->distance;
    if (d >= D) {
        return 0;
    }
    d = fmax(d, INNERMOST * D);
    const double gap = d - D;
    return def->stiffness * (2 * gap * log(d / D) + gap * gap / d) / D;
}

// Distance of particle p if it is nearer than `reach`, else INFINITY.
static double distance_within(const struct mpm_rigid *rigid, const struct mpm_particles *s,
                              size_t p, double reach, double *normal) {
    double x[MPM_MAX_DIM];
    for (int d = 0; d < s->dim; d++) {
        x[d] = s->x[mpm_at(p, s->dim, d)] - rigid->offset[d];
        if (x[d] < rigid->min[d] - reach || x[d] > rigid->max[d] + reach) {
            return INFINITY;
        }
    }
    return mpm_shape_distance(&rigid->def.shape, x, s->dim, normal);
}

static double area_of(const struct mpm_particles *s, size_t p) {
    return s->dim == 2 ? sqrt(s->V0[p]) : pow(cbrt(s->V0[p]), 2);
}

// Relative velocity of a particle: its part along the normal (returned), and the rest.
static double split_velocity(const struct mpm_rigid *rigid, const struct mpm_particles *s, size_t p,
                             const double *normal, double *tangential) {
    double along = 0;
    for (int d = 0; d < s->dim; d++) {
        tangential[d] = s->v[mpm_at(p, s->dim, d)] - rigid->def.velocity[d];
        along += tangential[d] * normal[d];
    }
    for (int d = 0; d < s->dim; d++) {
        tangential[d] -= along * normal[d];
    }
    return along;
}

static double length_of(const double *v, int dim) {
    double sum = 0;
    for (int d = 0; d < dim; d++) {
        sum += v[d] * v[d];
    }
    return sqrt(sum);
}

// The friction force (N) that holds particle p back under the normal force `push`, and the anchor
// with it: the particle sticks to it, or drags it along.
static void friction(struct mpm_rigid *rigid, const struct mpm_particles *s, size_t p,
                     const double *normal, double push, double dt, double *force) {
    const int dim = s->dim;
    double *anchor = &rigid->anchor[(s->first_id + s->id[p]) * (size_t)dim];
    double slip[MPM_MAX_DIM], tangential[MPM_MAX_DIM], along = 0;
    for (int d = 0; d < dim; d++) {
        const double x = s->x[mpm_at(p, dim, d)] - rigid->offset[d];
        slip[d] = anchor[0] < INFINITY ? x - anchor[d] : 0;
    }
    for (int d = 0; d < dim; d++) {
        along += slip[d] * normal[d];
    }
    for (int d = 0; d < dim; d++) {
        slip[d] -= along * normal[d];
    }
    split_velocity(rigid, s, p, normal, tangential);
    const double m = s->density * s->V0[p], limit = rigid->def.friction * push;
    // The barrier's own scale of stiffness; at most what stops the particle within two steps.
    const double stiffness =
        fmin(rigid->def.stiffness / rigid->def.distance * area_of(s, p), m / (4 * dt * dt));
    const double viscosity = 2 * sqrt(stiffness * m); // critical
    for (int d = 0; d < dim; d++) {
        force[d] = stiffness * slip[d] + viscosity * tangential[d];
    }
    const double size = length_of(force, dim), stretch = stiffness * length_of(slip, dim);
    const double part = size > limit ? limit / size : 1,
                 kept = stretch > limit ? limit / stretch : 1;
    for (int d = 0; d < dim; d++) {
        force[d] *= part;
        anchor[d] = s->x[mpm_at(p, dim, d)] - rigid->offset[d] - kept * slip[d];
    }
}

// Whether a particle of a tile can be within the body's `distance`, or has been in the step before.
// Since the last sort none has drifted by a whole cell, nor moves by one in a step; nor does the
// body, or all may touch it.
static bool may_touch(const struct mpm_rigid *rigid, const struct mpm_grid *g,
                      const struct mpm_tile *tile, double dt) {
    const double reach = rigid->def.distance;
    int place[MPM_MAX_DIM];
    if (mpm_rigid_speed(&rigid->def, g->dim) * dt > g->h) {
        return true;
    }
    mpm_grid_block_place(g, tile->block, place);
    for (int d = 0; d < g->dim; d++) {
        // A stencil begins at most 1.5 cells before its particle (cubic B-splines), or in its cell.
        const double from = g->origin[d] + (place[d] * MPM_EDGE - 2) * g->h - rigid->offset[d];
        const double to = from + (MPM_EDGE + 6) * g->h;
        if (to < rigid->min[d] - reach || from > rigid->max[d] + reach) {
            return false;
        }
    }
    return true;
}

void mpm_contact_forces(struct mpm_rigid *rigid, const struct mpm_kernels *kernels,
                        struct mpm_particles *s, const struct mpm_order *order,
                        struct mpm_grid *grid, double dt) {
    const int dim = s->dim;
    uint32_t particle[BATCH];
    double force[BATCH * MPM_MAX_DIM];
    size_t n = 0;
    for (size_t t = 0; t < order->n_tiles; t++) {
        const struct mpm_tile *tile = &order->tile[t];
        const bool near = may_touch(rigid, grid, tile, dt);
        for (size_t p = tile->begin; near && p < tile->end; p++) {
            double normal[MPM_MAX_DIM], drag[MPM_MAX_DIM] = {0};
            const double d = distance_within(rigid, s, p, rigid->def.distance, normal);
            if (!(d < rigid->def.distance)) {
                if (rigid->anchor) {
                    rigid->anchor[(s->first_id + s->id[p]) * (size_t)dim] = INFINITY;
                }
                continue;
            }
            const double push = mpm_barrier_pressure(&rigid->def, d) * area_of(s, p);
            if (rigid->anchor) {
                friction(rigid, s, p, normal, push, dt, drag);
            }
            particle[n] = (uint32_t)p;
            for (int e = 0; e < dim; e++) {
                const double f = push * normal[e] - drag[e];
                force[n * (size_t)dim + (size_t)e] = f;
                rigid->reaction[e] -= f;
            }
            if (++n == BATCH) {
                kernels->force(&(struct mpm_span){.s = s, .grid = grid}, particle, force, n);
                n = 0;
            }
        }
    }
    kernels->force(&(struct mpm_span){.s = s, .grid = grid}, particle, force, n);
}

// Whether particle p was too near or inside, and has been put back.
static bool put_back(struct mpm_rigid *rigid, struct mpm_particles *s, size_t p, double dt,
                     struct mpm_span_result *found) {
    const double innermost = INNERMOST * rigid->def.distance;
    double normal[MPM_MAX_DIM], tangential[MPM_MAX_DIM], v2 = 0;
    const double d = distance_within(rigid, s, p, innermost, normal);
    if (!(d < innermost * (1 - 1e-9))) { // round-off of where it was put
        return false;
    }
    const double m = s->density * s->V0[p];
    const double along = split_velocity(rigid, s, p, normal, tangential);
    const double impulse = along < 0 ? -m * along : 0, speed = length_of(tangential, s->dim);
    const double drag = speed > 0 ? fmin(m, rigid->def.friction * impulse / speed) : 0;
    for (int e = 0; e < s->dim; e++) {
        const double kick = impulse * normal[e] - drag * tangential[e];
        const double back = (innermost - d) * normal[e];
        double *x = &s->x[mpm_at(p, s->dim, e)], *v = &s->v[mpm_at(p, s->dim, e)];
        *x += back;
        *v += kick / m;
        v2 += *v * *v;
        found->mass_dx[e] += m * back;
        found->dx_max = fmax(found->dx_max, fabs(back)); // beside what the step has moved it
        found->min[e] = fmin(found->min[e], *x);
        found->max[e] = fmax(found->max[e], *x);
        rigid->reaction[e] -= kick / dt;
    }
    found->v2_max = fmax(found->v2_max, v2);
    return true;
}

void mpm_contact_keep_out(struct mpm_rigid *rigid, struct mpm_particles *s,
                          const struct mpm_order *order, const struct mpm_grid *grid, double dt,
                          struct mpm_span_result *found) {
    for (size_t t = 0; t < order->n_tiles; t++) {
        const struct mpm_tile *tile = &order->tile[t];
        const bool near = may_touch(rigid, grid, tile, dt);
        for (size_t p = tile->begin; near && p < tile->end; p++) {
            for (int k = 0; k < TRIES && put_back(rigid, s, p, dt, found); k++) {
            }
        }
    }
}
