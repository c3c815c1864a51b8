// What the library can see to be wrong with a definition, each fault with its place in the scene.
#include <stdio.h>
#include <string.h>

#include "server/mpm/check_inside.h"
#include "server/mpm/seed.h"
#include "server/mpm/sim.h"
#include "server/mpm/stability.h"

#define MAX_PER_DIRECTION 32 // particles per cell and direction: beyond it a smaller cell is meant
#define MAX_PARTICLES 2000000000.0 // ids are 32 bits
#define MAX_NODES 1e9  // with whole blocks of 4 a direction, node numbers still fit 32 bits
#define MAX_STEPS 1e15 // beyond it doubles soon no longer count one by one
#define MADE_OF                                                                                    \
    4 // times that a body is filled: to check it, for two estimates, and as a run begins
#define NODE_PLANE_TOLERANCE 1e-6 // cells: round-off of a wall's place, far below any offset meant

static double largest_speed(const struct mpm_def *def) {
    double largest = 0;
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_velocity *v = &def->bodies[b].velocity;
        double min[MPM_MAX_DIM], max[MPM_MAX_DIM], speed2 = 0;
        if (!mpm_shape_bounds(&def->bodies[b].shape, def->dimension, min, max)) {
            continue;
        }
        if (v->kind == MPM_VELOCITY_MODE) {
            speed2 = v->amplitude * v->amplitude;
        } else if (v->kind == MPM_VELOCITY_SOLUTION) {
            speed2 = mpm_solution_speed(&v->solution) * mpm_solution_speed(&v->solution);
        } else { // linear in x: largest at a corner of the bounding box
            for (int corner = 0; corner < 1 << def->dimension; corner++) {
                double x[MPM_MAX_DIM], at[MPM_MAX_DIM], here = 0;
                for (int d = 0; d < def->dimension; d++) {
                    x[d] = corner >> d & 1 ? max[d] : min[d];
                }
                mpm_velocity_at(v, x, def->dimension, at);
                for (int d = 0; d < def->dimension; d++) {
                    here += at[d] * at[d];
                }
                speed2 = fmax(speed2, here);
            }
        }
        largest = fmax(largest, sqrt(speed2));
    }
    for (size_t k = 0; k < def->n_rigids; k++) { // what it hits moves on as fast
        largest = fmax(largest, mpm_rigid_speed(&def->rigids[k], def->dimension));
    }
    return largest;
}

double mpm_def_dt_limit(const struct mpm_def *def, size_t stage) {
    double c = 0, nu = 0;
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_material_def *m = mpm_material_of(def, def->bodies[b].material, stage);
        c = fmax(c, m->model->wave_speed(m->parameters));
        nu = fmax(nu, m->model->diffusivity ? m->model->diffusivity(m->parameters) : 0);
    }
    return mpm_stability_limit(
        mpm_stability_of(def), def->cell, c + largest_speed(def), nu,
        fmax(0, mpm_stage_settings(def, stage, &def->settings).damping_mass));
}

static enum mpm_status range_fault(struct mpm_error *err, const char *pointer, const char *key,
                                   const char *expected, double value) {
    return mpm_fail_value(err, MPM_ERR_RANGE, TEXT("%s%s", pointer, key), expected,
                          TEXT("%.9g", value), "must be %s, got %.9g", expected, value);
}

enum mpm_status mpm_check_settings(const struct mpm_settings *s, const char *pointer, int dim,
                                   double dt_limit, double cfl_limit, bool unstable_ok,
                                   struct mpm_error *err) {
    if ((int)s->fbar.scheme < 0 || s->fbar.scheme >= MPM_N_FBAR_SCHEMES) {
        return range_fault(err, pointer, "/fbar/scheme", "a known scheme", (double)s->fbar.scheme);
    }
    if (s->fbar.scheme == MPM_FBAR_ANCHORED) {
        if (!(s->fbar.a > 0 && s->fbar.a <= 1)) {
            return range_fault(err, pointer, "/fbar/a", "above 0 and at most 1", s->fbar.a);
        }
        if (!(s->fbar.C >= 0 && is_finite(s->fbar.C))) {
            return range_fault(err, pointer, "/fbar/C", "at least 0", s->fbar.C);
        }
        if (!(s->fbar.keep >= 0 && s->fbar.keep <= 1)) {
            return range_fault(err, pointer, "/fbar/keep", "at least 0 and at most 1",
                               s->fbar.keep);
        }
    }
    for (int d = 0; d < dim; d++) {
        if (!is_finite(s->gravity[d])) {
            return range_fault(err, pointer, TEXT("/gravity/%d", d), "finite, m/s^2",
                               s->gravity[d]);
        }
    }
    if (!(s->damping_local >= 0 && s->damping_local < 1)) {
        return range_fault(err, pointer, "/damping/local", "at least 0 and below 1",
                           s->damping_local);
    }
    if (!(s->damping_mass >= 0 && is_finite(s->damping_mass))) {
        return range_fault(err, pointer, "/damping/mass", "at least 0, 1/s", s->damping_mass);
    }
    if (!(s->blend >= 0 && s->blend <= 1)) {
        return range_fault(err, pointer, "/transfer/blend", "0 (PIC) to 1 (FLIP)", s->blend);
    }
    if (!(s->dt >= 0 && is_finite(s->dt))) {
        return range_fault(err, pointer, "/time/dt", "above 0, s", s->dt);
    }
    if (s->dt > 0 && s->dt > dt_limit && !unstable_ok) {
        return mpm_fail_value(
            err, MPM_ERR_UNSTABLE_DT, TEXT("%s/time/dt", pointer), TEXT("at most %.6g s", dt_limit),
            TEXT("%.9g", s->dt),
            "dt = %.6g s is above the stability limit of %.6g s for this cell, wave speed and "
            "damping; use time.cfl, or \"unstable_ok\": true",
            s->dt, dt_limit);
    }
    if (s->dt == 0 && !(s->cfl > 0 && is_finite(s->cfl))) {
        return range_fault(err, pointer, "/time/cfl", "above 0", s->cfl);
    }
    if (s->dt == 0 && s->cfl > cfl_limit && !unstable_ok) {
        return mpm_fail_value(err, MPM_ERR_UNSTABLE_DT, TEXT("%s/time/cfl", pointer),
                              TEXT("at most %.6g", cfl_limit), TEXT("%.9g", s->cfl),
                              "a CFL number of %.6g is above the stability limit of %.6g for this "
                              "basis and particles_per_cell; or set \"unstable_ok\": true",
                              s->cfl, cfl_limit);
    }
    return MPM_OK;
}

static void check_domain(struct report *r, const struct mpm_def *def) {
    double nodes = 1;
    if (!(def->cell > 0 && is_finite(def->cell))) {
        FAULT(r, MPM_ERR_RANGE, "/cell", "above 0, m", TEXT("%.9g", def->cell),
              "the cell size must be above 0, got %.9g", def->cell);
        return;
    }
    for (int d = 0; d < def->dimension; d++) {
        const double length = def->domain_max[d] - def->domain_min[d];
        if (!(length > 0 && is_finite(length))) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/domain/max/%d", d),
                  TEXT("above %.9g (domain.min)", def->domain_min[d]),
                  TEXT("%.9g", def->domain_max[d]), "the domain has no extent in direction %d", d);
            return;
        }
        nodes *= length / def->cell + 1 + 2 * MPM_PAD;
    }
    if (nodes > MAX_NODES) {
        FAULT(r, MPM_ERR_RANGE, "/cell", TEXT("at most %.0f nodes", MAX_NODES),
              TEXT("about %.3g nodes", nodes),
              "the domain would have about %.3g nodes; use a larger cell or a smaller domain",
              nodes);
    }
}

static void check_material_whole(struct report *r, const struct mpm_material_def *m,
                                 const char *prefix) {
    const char *why = NULL;
    const int k = m->model->conflict ? m->model->conflict(m->parameters, &why) : -1;
    if (k >= 0) {
        const char *key = mpm_material_parameter(m->model, (size_t)k)->key;
        FAULT(r, MPM_ERR_CONFLICT, TEXT("%s/materials/%s/%s", prefix, m->name, key), why,
              TEXT("%.9g", m->parameters[k]), "%s %s, got %.9g", key, why, m->parameters[k]);
    }
}

static void check_material(struct report *r, const struct mpm_material_def *m, const char *prefix) {
    const size_t before = r->count;
    for (size_t k = 0; mpm_material_parameter(m->model, k); k++) {
        const struct mpm_parameter *q = mpm_material_parameter(m->model, k);
        const double value = m->parameters[k];
        const bool low = q->min_open ? !(value > q->min) : !(value >= q->min);
        const bool high = q->max_open ? !(value < q->max) : !(value <= q->max);
        if (low || high) {
            const char *bound =
                low ? TEXT("%s %.9g %s", q->min_open ? "above" : "at least", q->min, q->unit)
                    : TEXT("%s %.9g %s", q->max_open ? "below" : "at most", q->max, q->unit);
            FAULT(r, MPM_ERR_RANGE, TEXT("%s/materials/%s/%s", prefix, m->name, q->key), bound,
                  TEXT("%.9g", value), "%s must be %s, got %.9g", q->key, bound, value);
        }
    }
    if (r->count == before) {
        check_material_whole(r, m, prefix);
    }
}

// ---- Work ---------------------------------------------------------------------------------------

bool mpm_check_affords(struct report *r, double looks) {
    r->looks += looks;
    if (r->looks > MPM_MAX_LOOKS && !r->exhausted) {
        r->exhausted = true;
        FAULT(
            r, MPM_ERR_WORK, "",
            TEXT("at most %.0e looks of a lattice point at a shape", MPM_MAX_LOOKS),
            TEXT("about %.2g so far", r->looks),
            "it would take too long to check the scene: more than %.0e looks of a lattice point at "
            "a shape; use fewer shapes, corners, bodies, loads or probes, or fewer particles",
            MPM_MAX_LOOKS);
    }
    return !r->exhausted;
}

struct search {
    bool (*takes)(void *context, const double *x);
    void *context;
    double looks_each, looks;
    double looks_left;
    bool found;
};

static bool search_on(void *context, const double *x, double volume) {
    struct search *s = context;
    (void)volume;
    s->looks += s->looks_each;
    s->found = !s->takes || s->takes(s->context, x);
    return !s->found && s->looks <= s->looks_left;
}

bool mpm_check_finds(struct report *r, const struct mpm_def *def, const struct mpm_body_def *body,
                     const struct mpm_sieve *sieve, double looks_each,
                     bool (*takes)(void *context, const double *x), void *context) {
    const double looks = mpm_seed_looks(def, body, sieve);
    if (!mpm_check_affords(r, looks)) {
        return true;
    }
    struct search search = {.takes = takes,
                            .context = context,
                            .looks_each = looks_each,
                            .looks_left = MPM_MAX_LOOKS - r->looks};
    mpm_seed_sifted(def, body, sieve, search_on, &search);
    if (search.found) { // mostly at once
        r->looks -= looks;
    }
    return !mpm_check_affords(r, search.looks) || search.found;
}

// ---- Shapes -------------------------------------------------------------------------------------

// > 0 where c lies left of the way from a to b, 0 on their line.
static double turn(const double *a, const double *b, const double *c) {
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
}

// Of a point on the line through a and b: whether it lies between them.
static bool is_between(const double *a, const double *b, const double *c) {
    return c[0] >= fmin(a[0], b[0]) && c[0] <= fmax(a[0], b[0]) && c[1] >= fmin(a[1], b[1]) &&
           c[1] <= fmax(a[1], b[1]);
}

static bool segments_meet(const double *a, const double *b, const double *c, const double *d) {
    for (int k = 0; k < 2; k++) { // most pairs are far apart
        if (fmax(a[k], b[k]) < fmin(c[k], d[k]) || fmax(c[k], d[k]) < fmin(a[k], b[k])) {
            return false;
        }
    }
    const double abc = turn(a, b, c), abd = turn(a, b, d), cda = turn(c, d, a), cdb = turn(c, d, b);
    if (((abc > 0 && abd < 0) || (abc < 0 && abd > 0)) &&
        ((cda > 0 && cdb < 0) || (cda < 0 && cdb > 0))) {
        return true;
    }
    return (abc == 0 && is_between(a, b, c)) || (abd == 0 && is_between(a, b, d)) ||
           (cda == 0 && is_between(c, d, a)) || (cdb == 0 && is_between(c, d, b));
}

// A simple polygon with an area: no corner twice, and no two edges that meet but at their corner.
static void check_polygon(struct report *r, const struct mpm_shape *shape, const char *pointer) {
    const size_t n = shape->n_points;
    const double *x = shape->points;
    double area = 0;
    if (n < 3) {
        FAULT(r, MPM_ERR_EMPTY, pointer, "at least 3 points", TEXT("%zu", n),
              "a polygon has at least 3 corners, got %zu", n);
        return;
    }
    for (size_t i = 0; i < 2 * n; i++) {
        if (!is_finite(x[i])) {
            FAULT(r, MPM_ERR_RANGE, pointer, "finite coordinates, m", TEXT("%.9g", x[i]),
                  "corner %zu of the polygon is not finite", i / 2);
            return;
        }
    }
    for (size_t i = 0; i < n; i++) {
        area += turn(x, x + 2 * i, x + 2 * ((i + 1) % n)) / 2;
    }
    for (size_t i = 0; i < n; i++) {
        const double *a = x + 2 * i, *b = x + 2 * ((i + 1) % n);
        if (a[0] == b[0] && a[1] == b[1]) {
            FAULT(r, MPM_ERR_CONFLICT, pointer, "every corner once",
                  TEXT("corners %zu and %zu are the same", i, (i + 1) % n),
                  "corners %zu and %zu of the polygon are the same point; it closes by itself", i,
                  (i + 1) % n);
            return;
        }
    }
    if (!mpm_check_affords(r, (double)n * (double)n)) {
        return;
    }
    if (area == 0) {
        FAULT(r, MPM_ERR_EMPTY, pointer, "a polygon with an area", "0 m^2",
              "the polygon has no area: its corners lie on a line, or its edges cross");
        return;
    }
    for (size_t i = 0; i < n; i++) {
        const double *a = x + 2 * i, *b = x + 2 * ((i + 1) % n), *c = x + 2 * ((i + 2) % n);
        const double back = (a[0] - b[0]) * (c[0] - b[0]) + (a[1] - b[1]) * (c[1] - b[1]);
        size_t other = turn(a, b, c) == 0 && back > 0 ? (i + 1) % n : n; // folds back on itself
        for (size_t j = i + 2; other == n && j < n; j++) {
            if ((j + 1) % n != i && segments_meet(a, b, x + 2 * j, x + 2 * ((j + 1) % n))) {
                other = j;
            }
        }
        if (other < n) {
            FAULT(r, MPM_ERR_CONFLICT, pointer, "edges that do not meet again",
                  TEXT("the edges from corners %zu and %zu meet", i, other),
                  "the polygon meets itself: the edge from corner %zu at (%.9g, %.9g) and that "
                  "from corner %zu at (%.9g, %.9g)",
                  i, a[0], a[1], other, x[2 * other], x[2 * other + 1]);
            return;
        }
    }
}

static void check_shape(struct report *r, const struct mpm_shape *shape, const char *pointer,
                        int dim) {
    static const char *const sets[] = {[MPM_SHAPE_UNION] = "union",
                                       [MPM_SHAPE_DIFFERENCE] = "difference",
                                       [MPM_SHAPE_INTERSECTION] = "intersection"};
    double length = 0;
    switch (shape->kind) {
    case MPM_SHAPE_BOX:
    case MPM_SHAPE_BALL:
    case MPM_SHAPE_POINTS:
        break; // whatever they say, they hold particles or do not
    case MPM_SHAPE_POLYGON:
        if (dim != 2) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("%s/polygon", pointer), "a scene in 2D", "3D",
                  "a polygon alone is for scenes in 2D; extrude it");
        }
        check_polygon(r, shape, TEXT("%s/polygon/points", pointer));
        break;
    case MPM_SHAPE_EXTRUDE:
        if (dim != 3) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("%s/extrude", pointer), "a scene in 3D", "2D",
                  "an extrusion is for scenes in 3D");
        }
        check_polygon(r, shape, TEXT("%s/extrude/polygon", pointer));
        if (!(shape->max[2] > shape->min[2] && is_finite(shape->max[2] - shape->min[2]))) {
            FAULT(r, MPM_ERR_RANGE, TEXT("%s/extrude/to", pointer),
                  TEXT("above %.9g m (from)", shape->min[2]), TEXT("%.9g", shape->max[2]),
                  "an extrusion must end above where it begins");
        }
        break;
    case MPM_SHAPE_CYLINDER:
        if (dim != 3) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("%s/cylinder", pointer), "a scene in 3D", "2D",
                  "a cylinder is for scenes in 3D");
        }
        for (int d = 0; d < dim; d++) {
            length = hypot(length, shape->max[d] - shape->min[d]);
        }
        if (!(length > 0 && is_finite(length))) {
            FAULT(r, MPM_ERR_RANGE, TEXT("%s/cylinder/to", pointer), "another point than `from`",
                  TEXT("%.9g m from it", length), "a cylinder must have a length");
        }
        if (!(shape->radius > 0 && is_finite(shape->radius))) {
            FAULT(r, MPM_ERR_RANGE, TEXT("%s/cylinder/radius", pointer), "above 0, m",
                  TEXT("%.9g", shape->radius), "a cylinder must have a radius");
        }
        break;
    case MPM_SHAPE_UNION:
    case MPM_SHAPE_DIFFERENCE:
    case MPM_SHAPE_INTERSECTION:
        for (size_t k = 0; k < shape->n_children; k++) {
            check_shape(r, &shape->children[k], TEXT("%s/%s/%zu", pointer, sets[shape->kind], k),
                        dim);
        }
        break;
    }
}

// ---- Bodies -------------------------------------------------------------------------------------

struct outside {
    const struct mpm_def *def;
    size_t out_of_domain, beyond_wall, bad_volume;
    int wall;
    double unit;
};

// Whether a point lies behind a wall that is there from the start.
static int wall_in_front(const struct mpm_def *def, const double *x) {
    for (size_t k = 0; k < def->n_walls; k++) {
        const struct mpm_wall_def *w = &def->walls[k];
        bool in_span = true;
        for (int d = 0; w->has_span && d < def->dimension; d++) {
            in_span &= d == w->axis || (x[d] >= w->span_min[d] && x[d] <= w->span_max[d]);
        }
        const double over = (x[w->axis] - w->at) / def->cell * (w->keeps_above ? -1 : 1);
        const bool gone = def->stages[0].removes_wall && def->stages[0].removes_wall[k];
        if (in_span && !gone && over > NODE_PLANE_TOLERANCE) {
            return (int)k;
        }
    }
    return -1;
}

// Whether the whole bounding box of a shape lies in the domain and behind no wall.
static bool surely_inside(const struct mpm_def *def, const struct mpm_shape *shape) {
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM];
    bool inside = mpm_shape_bounds(shape, def->dimension, min, max);
    for (int d = 0; inside && d < def->dimension; d++) {
        inside = min[d] >= def->domain_min[d] && max[d] <= def->domain_max[d];
    }
    for (size_t k = 0; inside && k < def->n_walls; k++) {
        const struct mpm_wall_def *w = &def->walls[k];
        inside = w->keeps_above ? min[w->axis] >= w->at : max[w->axis] <= w->at;
    }
    return inside;
}

static bool look_at(void *context, const double *x, double volume) {
    struct outside *o = context;
    bool in = true;
    for (int d = 0; d < o->def->dimension; d++) {
        in &= x[d] >= o->def->domain_min[d] && x[d] <= o->def->domain_max[d];
    }
    o->out_of_domain += !in;
    const int wall = wall_in_front(o->def, x);
    if (wall >= 0) {
        o->beyond_wall++;
        o->wall = wall;
    }
    o->bad_volume += !(volume > 0 && is_finite(volume));
    return true;
}

static bool boxes_meet(const struct mpm_shape *a, const struct mpm_shape *b, int dim) {
    double a0[MPM_MAX_DIM], a1[MPM_MAX_DIM], b0[MPM_MAX_DIM], b1[MPM_MAX_DIM];
    bool meet = mpm_shape_bounds(a, dim, a0, a1) && mpm_shape_bounds(b, dim, b0, b1);
    for (int d = 0; meet && d < dim; d++) {
        meet = a0[d] < b1[d] && b0[d] < a1[d];
    }
    return meet;
}

// Particles of the body that it would have at most; adds to `total`, the sum over the bodies. False
// without a material: then there is no wave speed.
static bool check_body(struct report *r, const struct mpm_def *def, size_t b, double *total) {
    const struct mpm_body_def *body = &def->bodies[b];
    if (body->material < 0 || (size_t)body->material >= def->n_materials) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/bodies/%s/material", body->name), "a material", "",
              "body '%s' has no material", body->name);
        return false;
    }
    if (body->particles_per_direction < 1 || body->particles_per_direction > MAX_PER_DIRECTION) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/bodies/%s/particles_per_cell", body->name),
              TEXT("n^%d with n from 1 to %d", def->dimension, MAX_PER_DIRECTION),
              TEXT("n = %d", body->particles_per_direction),
              "particles_per_cell must be a power of whole numbers from 1 to %d per direction",
              MAX_PER_DIRECTION);
        return true;
    }
    const double bound = mpm_seed_bound(def, body);
    *total += bound;
    if (!(*total <= MAX_PARTICLES) ||
        (def->memory_limit && (double)mpm_particles_bytes(def->materials[body->material].model,
                                                          def->dimension, 1, 0, false) /
                                      MPM_BLOCK * bound / 4 >
                                  (double)def->memory_limit)) {
        FAULT(
            r, MPM_ERR_MEMORY, TEXT("/bodies/%s/shape", body->name),
            def->memory_limit ? TEXT("at most %.3g bytes in all", (double)def->memory_limit)
                              : TEXT("at most %.0f particles", MAX_PARTICLES),
            TEXT("about %.3g particles", bound),
            "body '%s' would have about %.3g particles; use a larger cell, a smaller body or fewer "
            "particles per cell",
            body->name, bound);
        *total = INFINITY; // nothing of this size is counted one by one
        return true;
    }
    struct outside o = {.def = def, .unit = def->cell / 2 / body->particles_per_direction};
    // One by one only where something can be wrong with a particle.
    const bool clear = body->shape.kind != MPM_SHAPE_POINTS && surely_inside(def, &body->shape);
    if (!mpm_check_affords(r, MADE_OF * mpm_seed_looks(def, body, NULL) +
                                  (clear ? 0 : bound * (double)def->n_walls))) {
        return true;
    }
    const size_t n = mpm_seed(def, body, clear ? NULL : look_at, &o);
    const char *place = body->shape.kind == MPM_SHAPE_POINTS ? "/shape/points" : "/shape";
    if (n == 0) {
        FAULT(
            r, MPM_ERR_EMPTY, TEXT("/bodies/%s%s", body->name, place), "at least one particle", "0",
            "body '%s' has no particles: the shape is empty, or smaller than the spacing of %.6g m",
            body->name, 2 * o.unit);
    }
    if (o.out_of_domain) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/bodies/%s%s", body->name, place), "inside the domain",
              TEXT("%zu of %zu particles outside", o.out_of_domain, n),
              "%zu of %zu particles of body '%s' lie outside the domain", o.out_of_domain, n,
              body->name);
    }
    if (o.beyond_wall) {
        FAULT(r, MPM_ERR_CONFLICT, TEXT("/bodies/%s%s", body->name, place),
              TEXT("on the side that wall '%s' keeps", def->walls[o.wall].name),
              TEXT("%zu of %zu particles beyond it", o.beyond_wall, n),
              "%zu of %zu particles of body '%s' lie beyond wall '%s'", o.beyond_wall, n,
              body->name, def->walls[o.wall].name);
    }
    if (o.bad_volume) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/bodies/%s%s", body->name, place), "volumes above 0",
              TEXT("%zu that are not", o.bad_volume), "%zu points of body '%s' have no volume",
              o.bad_volume, body->name);
    }
    for (size_t a = 0; a < b; a++) {
        const struct mpm_sieve inside = {
            .shape = &def->bodies[a].shape, .margin = o.unit, .inside = true};
        if (!boxes_meet(inside.shape, &body->shape, def->dimension)) {
            continue;
        }
        if (!mpm_check_affords(r, mpm_seed_looks(def, body, &inside))) {
            return true;
        }
        const size_t n_inside = mpm_seed_sifted(def, body, &inside, NULL, NULL);
        if (n_inside) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("/bodies/%s%s", body->name, place),
                  TEXT("outside body '%s'", def->bodies[a].name),
                  TEXT("%zu particles inside it", n_inside),
                  "bodies '%s' and '%s' overlap: %zu particles of one lie inside the other",
                  def->bodies[a].name, body->name, n_inside);
        }
    }
    return true;
}

// ---- Walls, loads, rigid bodies, probes, stages -------------------------------------------------

static void check_wall(struct report *r, const struct mpm_def *def, const struct mpm_wall_def *w) {
    if (w->axis < 0 || w->axis >= def->dimension) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/walls/%s/axis", w->name), "a direction of the scene",
              TEXT("%d", w->axis), "wall '%s' has no axis of this scene", w->name);
        return;
    }
    const double min = def->domain_min[w->axis], max = def->domain_max[w->axis];
    const double cells = (w->at - min) / def->cell;
    if (!(w->at >= min && w->at <= max + def->cell * NODE_PLANE_TOLERANCE)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/walls/%s/at", w->name), TEXT("%.9g to %.9g m", min, max),
              TEXT("%.9g", w->at), "wall '%s' lies outside the domain", w->name);
    } else if (fabs(cells - round(cells)) > NODE_PLANE_TOLERANCE) {
        const double below = min + floor(cells) * def->cell;
        FAULT(r, MPM_ERR_RANGE, TEXT("/walls/%s/at", w->name),
              TEXT("on a node plane, as %.9g or %.9g m", below, below + def->cell),
              TEXT("%.9g", w->at), "wall '%s' must lie on a node plane: domain.min + k cell",
              w->name);
    }
}

static void check_load(struct report *r, const struct mpm_def *def, const struct mpm_load_def *q) {
    if (q->body < 0 || (size_t)q->body >= def->n_bodies) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/loads/%s/body", q->name), "a body", TEXT("%d", q->body),
              "load '%s' names no body", q->name);
    }
    if (!q->has_box && (q->axis < 0 || q->axis >= def->dimension)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/loads/%s/select/%s", q->name, q->round ? "axis" : "extreme"),
              "a direction of the scene", TEXT("%d", q->axis),
              "load '%s' has no axis of this scene", q->name);
    }
    if (q->has_box && q->is_pressure) {
        FAULT(r, MPM_ERR_CONFLICT, TEXT("/loads/%s/pressure", q->name), "absent",
              TEXT("%.9g", q->pressure),
              "a pressure acts on a layer and not on a box; select an extreme");
    }
    for (int d = 0; d < def->dimension; d++) {
        if (q->has_box && !(q->box_min[d] <= q->box_max[d])) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/loads/%s/select/box/max/%d", q->name, d),
                  TEXT("at least %.9g m (min)", q->box_min[d]), TEXT("%.9g", q->box_max[d]),
                  "the box of load '%s' is empty", q->name);
        }
        if (!q->is_pressure && !is_finite(q->force[d])) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/loads/%s/force/%d", q->name, d), "finite, N",
                  TEXT("%.9g", q->force[d]), "the force of load '%s' must be finite", q->name);
        }
        if (q->round && !q->has_box && !is_finite(q->centre[d])) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/loads/%s/select/center/%d", q->name, d), "finite, m",
                  TEXT("%.9g", q->centre[d]), "the centre of load '%s' must be finite", q->name);
        }
    }
    if (q->is_pressure && !is_finite(q->pressure)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/loads/%s/pressure", q->name), "finite, Pa",
              TEXT("%.9g", q->pressure), "the pressure of load '%s' must be finite", q->name);
    }
    if (!(q->ramp >= 0 && is_finite(q->ramp))) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/loads/%s/ramp", q->name), "at least 0, s",
              TEXT("%.9g", q->ramp), "the ramp of load '%s' must not be negative", q->name);
    }
}

struct round {
    const struct mpm_load_def *load;
    int dim;
    double inner, outer; // radii, m
};

static bool is_in_ring(void *context, const double *x) {
    const struct round *o = context;
    double radius = 0;
    for (int d = 0; d < o->dim; d++) {
        if (o->dim == 2 || d != o->load->axis) {
            radius = hypot(radius, x[d] - o->load->centre[d]);
        }
    }
    return radius >= o->inner && radius < o->outer;
}

// What the load finds among the particles of its body, which has some.
static void check_load_particles(struct report *r, const struct mpm_def *def,
                                 const struct mpm_load_def *q) {
    const struct mpm_body_def *body = &def->bodies[q->body];
    struct mpm_sieve sieve = {.has_box = true};
    if (q->has_box) {
        memcpy(sieve.min, q->box_min, sizeof sieve.min);
        memcpy(sieve.max, q->box_max, sizeof sieve.max);
        if (!mpm_check_finds(r, def, body, &sieve, 0, NULL, NULL)) {
            FAULT(r, MPM_ERR_EMPTY, TEXT("/loads/%s/select", q->name), "at least one particle", "0",
                  "load '%s' selects no particle of body '%s'", q->name, body->name);
        }
        return;
    }
    if (!(q->round && q->is_pressure)) {
        return; // there always is an outermost particle
    }
    // A pressure on a particle in the middle has no direction.
    const double spacing = def->cell / body->particles_per_direction;
    const double at_centre = spacing * NODE_PLANE_TOLERANCE;
    for (int d = 0; d < def->dimension; d++) {
        const bool across = def->dimension == 2 || d != q->axis;
        sieve.min[d] = across ? q->centre[d] - 2 * at_centre : -INFINITY;
        sieve.max[d] = across ? q->centre[d] + 2 * at_centre : INFINITY;
    }
    struct round middle = {.load = q, .dim = def->dimension, .outer = at_centre};
    struct round around = {.load = q, .dim = def->dimension, .inner = spacing, .outer = INFINITY};
    if (mpm_check_finds(r, def, body, &sieve, 0, is_in_ring, &middle) &&
        (!q->max_side || !mpm_check_finds(r, def, body, NULL, 1, is_in_ring, &around)) &&
        !r->exhausted) {
        FAULT(r, MPM_ERR_CONFLICT, TEXT("/loads/%s/select/center", q->name),
              "off the particles that are loaded", "a particle at the centre",
              "load '%s' presses on a particle at its centre, which has no direction", q->name);
    }
}

static void check_rigid(struct report *r, const struct mpm_def *def,
                        const struct mpm_rigid_def *q) {
    const struct mpm_shape *shape = &q->shape;
    if (!mpm_rigid_shape_is_known(shape)) {
        FAULT(r, MPM_ERR_CONFLICT, TEXT("/rigid_bodies/%s/shape", q->name),
              "a box, disk, sphere or polygon", "another shape",
              "rigid body '%s' must be a box, disk, sphere or polygon", q->name);
        return;
    }
    check_shape(r, shape, TEXT("/rigid_bodies/%s/shape", q->name), def->dimension);
    for (int d = 0; d < def->dimension; d++) {
        if (shape->kind == MPM_SHAPE_BOX &&
            !(shape->max[d] > shape->min[d] && is_finite(shape->max[d] - shape->min[d]))) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/rigid_bodies/%s/shape/box/max/%d", q->name, d),
                  TEXT("above %.9g m (min)", shape->min[d]), TEXT("%.9g", shape->max[d]),
                  "the box of rigid body '%s' is empty", q->name);
        }
        if (shape->kind == MPM_SHAPE_BALL && !is_finite(shape->centre[d])) {
            FAULT(r, MPM_ERR_RANGE,
                  TEXT("/rigid_bodies/%s/shape/%s/center/%d", q->name,
                       def->dimension == 2 ? "disk" : "sphere", d),
                  "finite, m", TEXT("%.9g", shape->centre[d]),
                  "the centre of rigid body '%s' must be finite", q->name);
        }
        if (!is_finite(q->velocity[d])) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/rigid_bodies/%s/velocity/%d", q->name, d), "finite, m/s",
                  TEXT("%.9g", q->velocity[d]), "the velocity of rigid body '%s' must be finite",
                  q->name);
        }
    }
    if (shape->kind == MPM_SHAPE_BALL && !(shape->radius > 0 && is_finite(shape->radius))) {
        FAULT(r, MPM_ERR_RANGE,
              TEXT("/rigid_bodies/%s/shape/%s/radius", q->name,
                   def->dimension == 2 ? "disk" : "sphere"),
              "above 0, m", TEXT("%.9g", shape->radius), "rigid body '%s' must have a radius",
              q->name);
    }
    if (!(q->stiffness > 0 && is_finite(q->stiffness))) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/rigid_bodies/%s/contact/stiffness", q->name), "above 0, Pa",
              TEXT("%.9g", q->stiffness), "the contact of rigid body '%s' must have a stiffness",
              q->name);
    }
    if (!(q->distance > 0 && q->distance < def->cell)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/rigid_bodies/%s/contact/distance", q->name),
              TEXT("above 0 and below %.9g m (cell)", def->cell), TEXT("%.9g", q->distance),
              "the contact distance of rigid body '%s' must be above 0 and less than a cell",
              q->name);
    }
    if (!(q->friction >= 0 && is_finite(q->friction))) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/rigid_bodies/%s/contact/friction", q->name), "at least 0",
              TEXT("%.9g", q->friction), "the friction of rigid body '%s' must not be negative",
              q->name);
    }
}

#define SIDE_LOOKS 15 // that the distance from one side of a rigid body takes as long as

struct intrusion {
    const struct mpm_rigid_def *rigid;
    int dim;
    size_t inside;
};

static bool look_in_rigid(void *context, const double *x, double volume) {
    (void)volume;
    struct intrusion *o = context;
    double normal[MPM_MAX_DIM];
    o->inside += mpm_shape_distance(&o->rigid->shape, x, o->dim, normal) <= 0;
    return true;
}

// No particle starts in a rigid body, or on its surface.
static void check_rigid_place(struct report *r, const struct mpm_def *def, size_t k) {
    const struct mpm_rigid_def *q = &def->rigids[k];
    if (def->stages[0].removes_rigid && def->stages[0].removes_rigid[k]) {
        return;
    }
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_body_def *body = &def->bodies[b];
        struct intrusion o = {.rigid = q, .dim = def->dimension};
        struct mpm_sieve near = {.has_box = true};
        if (boxes_meet(&q->shape, &body->shape, def->dimension) &&
            mpm_shape_bounds(&q->shape, def->dimension, near.min, near.max)) {
            const double sides = SIDE_LOOKS * (1 + (double)q->shape.n_points);
            if (!mpm_check_affords(r, (1 + sides) * mpm_seed_looks(def, body, &near))) {
                return;
            }
            mpm_seed_sifted(def, body, &near, look_in_rigid, &o);
        }
        if (o.inside) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("/rigid_bodies/%s/shape", q->name),
                  TEXT("outside body '%s'", body->name), TEXT("%zu particles inside it", o.inside),
                  "%zu particles of body '%s' lie inside rigid body '%s' or on its surface",
                  o.inside, body->name, q->name);
        }
    }
}

// ---- Stages and times
// -----------------------------------------------------------------------------

static void check_stages(struct report *r, const struct mpm_def *def) {
    for (size_t k = 0; k < def->n_stages; k++) {
        const struct mpm_stage_def *s = &def->stages[k];
        const bool last = k + 1 == def->n_stages;
        if (!(s->duration > 0 && is_finite(s->duration))) {
            FAULT(r, MPM_ERR_RANGE, last ? "/time/end" : TEXT("/stages/%zu/duration", k),
                  "above 0, s", TEXT("%.9g", s->duration), "stage '%s' must last some time",
                  s->name);
        }
        // On top of the defaults, so that a fault is the stage's own; dt is looked at in
        // check_times.
        const struct mpm_settings defaults = mpm_settings_default(),
                                  now = mpm_stage_settings(def, k, &defaults);
        struct mpm_error fault;
        if (mpm_check_settings(&now, TEXT("/stages/%zu", k), def->dimension, INFINITY, INFINITY,
                               true, &fault)) {
            add(r, &fault);
        }
        for (size_t m = 0; s->materials && m < def->n_materials; m++) {
            check_material(r, &s->materials[m], TEXT("/stages/%zu", k));
        }
    }
}

// Needs the wave speeds and shapes.
static void check_times(struct report *r, const struct mpm_def *def) {
    struct mpm_error fault;
    for (size_t k = 0; k < def->n_stages; k++) {
        const struct mpm_stage_def *s = &def->stages[k];
        const struct mpm_settings now = mpm_stage_settings(def, k, &def->settings);
        char pointer[32] = "";
        if (s->states & MPM_SET_TIME) {
            snprintf(pointer, sizeof pointer, "/stages/%zu", k);
        } else if (k > 0 && !s->materials) {
            continue; // said already
        }
        if (mpm_check_settings(&now, pointer, def->dimension, mpm_def_dt_limit(def, k),
                               mpm_stability_of(def).wave, def->unstable_ok, &fault)) {
            add(r, &fault);
        }
    }
}

size_t mpm_check(const struct mpm_def *def,
                 void (*report)(void *context, const struct mpm_error *fault), void *context) {
    struct report r = {.call = report, .context = context};
    if (def->dimension != 2 && def->dimension != 3) {
        FAULT(&r, MPM_ERR_RANGE, "/dimension", "2 or 3", TEXT("%d", def->dimension),
              "the dimension must be 2 or 3, got %d", def->dimension);
        return r.count;
    }
    check_domain(&r, def);
    struct mpm_error fault;
    for (size_t k = 0; k < def->n_materials; k++) {
        check_material(&r, &def->materials[k], "");
    }
    if (mpm_check_settings(&def->settings, "", def->dimension, INFINITY, INFINITY, true, &fault)) {
        add(&r, &fault);
    }
    for (size_t k = 0; k < def->n_walls; k++) {
        check_wall(&r, def, &def->walls[k]);
    }
    if (def->n_bodies == 0) {
        FAULT(&r, MPM_ERR_EMPTY, "/bodies", "at least one body", "0", "the scene has no body");
    }
    if (def->n_stages == 0) {
        FAULT(&r, MPM_ERR_EMPTY, "/stages", "at least one stage", "0", "the scene has no stage");
        return r.count;
    }
    check_stages(&r, def);
    for (size_t k = 0; k < def->n_probes; k++) {
        const struct mpm_probe_def *q = &def->probes[k];
        mpm_check_probe(&r, def, q);
        if (q->has_exclude) {
            check_shape(&r, &q->exclude, TEXT("/probes/%s/exclude", q->name), def->dimension);
        }
    }
    mpm_check_body_force(&r, def);
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_body_def *body = &def->bodies[b];
        if (body->velocity.kind == MPM_VELOCITY_SOLUTION) {
            const struct mpm_solution *q = &body->velocity.solution;
            mpm_check_solution(
                &r, q, TEXT("/bodies/%s/velocity/%s", body->name, mpm_solution_name(q->kind)));
        }
        check_shape(&r, &body->shape, TEXT("/bodies/%s/shape", body->name), def->dimension);
    }
    for (size_t k = 0; k < def->n_loads; k++) {
        check_load(&r, def, &def->loads[k]);
    }
    for (size_t k = 0; k < def->n_rigids; k++) {
        check_rigid(&r, def, &def->rigids[k]);
    }
    if (r.count) {
        return r.count; // what follows would divide by them
    }
    double total = 0;
    bool made_of = true;
    for (size_t b = 0; b < def->n_bodies && total < INFINITY && !r.exhausted; b++) {
        made_of &= check_body(&r, def, b, &total);
    }
    if (made_of) {
        check_times(&r, def);
    }
    for (size_t k = 0; k < def->n_loads && r.count == 0; k++) {
        check_load_particles(&r, def, &def->loads[k]);
    }
    for (size_t k = 0; k < def->n_probes && r.count == 0; k++) {
        mpm_check_probe_particles(&r, def, &def->probes[k]);
    }
    for (size_t k = 0; k < def->n_rigids && total < INFINITY && !r.exhausted; k++) {
        check_rigid_place(&r, def, k);
    }
    if (r.count) {
        return r.count;
    }
    struct mpm_estimate estimate;
    mpm_estimate(def, &estimate);
    if ((double)estimate.steps > MAX_STEPS) {
        FAULT(&r, MPM_ERR_RANGE, "/time/end", TEXT("at most %.0e steps", MAX_STEPS),
              TEXT("%.9g s", def->stages[def->n_stages - 1].duration),
              "the run would take more than %.0e steps of %.6g s", MAX_STEPS, estimate.dt);
    }
    if (def->memory_limit && estimate.bytes > def->memory_limit) {
        FAULT(
            &r, MPM_ERR_MEMORY, "", TEXT("at most %zu bytes", def->memory_limit),
            TEXT("%zu bytes", estimate.bytes),
            "the simulation needs %zu bytes for %zu particles and %zu nodes, over the limit of %zu",
            estimate.bytes, estimate.particles, estimate.nodes, def->memory_limit);
    }
    return r.count;
}
