// What the library can see to be wrong with a definition, each fault with its place in the scene.
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "server/mpm/seed.h"
#include "server/mpm/sim.h"

#define MAX_PER_DIRECTION 32 // particles per cell and direction: beyond it a smaller cell is meant
#define MAX_PARTICLES 2000000000.0 // ids are 32 bits
#define MAX_NODES 4000000000.0
#define MAX_STEPS 1e15            // beyond it doubles soon no longer count one by one
#define NODE_PLANE_TOLERANCE 1e-6 // cells: round-off of a wall's place, far below any offset meant

struct report {
    void (*call)(void *context, const struct mpm_error *fault);
    void *context;
    size_t count;
};

static void add(struct report *r, const struct mpm_error *fault) {
    r->count++;
    if (r->call) {
        r->call(r->context, fault);
    }
}

#define FAULT(r, status, pointer, expected, actual, ...)                                           \
    do {                                                                                           \
        struct mpm_error fault_;                                                                   \
        mpm_fail_value(&fault_, status, pointer, expected, actual, __VA_ARGS__);                   \
        add(r, &fault_);                                                                           \
    } while (0)

// Text that lives until the end of the statement it stands in.
#define TEXT(...) text((char[256]){0}, __VA_ARGS__)
static const char *text(char *out, const char *format, ...) __attribute__((format(printf, 2, 3)));
static const char *text(char *out, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(out, 256, format, arguments);
    va_end(arguments);
    return out;
}

static bool is_finite(double x) {
    return x - x == 0;
}

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
    return largest;
}

double mpm_def_dt_limit(const struct mpm_def *def, size_t stage) {
    double c = 0, nu = 0;
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_material_def *m = mpm_material_of(def, def->bodies[b].material, stage);
        c = fmax(c, m->model->wave_speed(m->parameters));
        nu = fmax(nu, m->model->diffusivity ? m->model->diffusivity(m->parameters) : 0);
    }
    return mpm_dt_limit_at(def->cell, c, largest_speed(def), nu, def->dimension);
}

static enum mpm_status range_fault(struct mpm_error *err, const char *pointer, const char *key,
                                   const char *expected, double value) {
    return mpm_fail_value(err, MPM_ERR_RANGE, TEXT("%s%s", pointer, key), expected,
                          TEXT("%.9g", value), "must be %s, got %.9g", expected, value);
}

enum mpm_status mpm_check_settings(const struct mpm_settings *s, const char *pointer, int dim,
                                   double dt_limit, bool unstable_ok, struct mpm_error *err) {
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
            "dt = %.6g s is above the stability limit of %.6g s for this cell and "
            "wave speed; use time.cfl, or \"unstable_ok\": true",
            s->dt, dt_limit);
    }
    if (s->dt == 0 && !(s->cfl > 0 && is_finite(s->cfl))) {
        return range_fault(err, pointer, "/time/cfl", "above 0", s->cfl);
    }
    if (s->dt == 0 && s->cfl > 0.5 && !unstable_ok) {
        return mpm_fail_value(err, MPM_ERR_UNSTABLE_DT, TEXT("%s/time/cfl", pointer), "at most 0.5",
                              TEXT("%.9g", s->cfl),
                              "a CFL number of %.6g is above the stability limit of 0.5; or set "
                              "\"unstable_ok\": true",
                              s->cfl);
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

static void check_material(struct report *r, const struct mpm_material_def *m, const char *prefix) {
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
}

struct outside {
    const struct mpm_def *def;
    const struct mpm_shape *other;
    size_t out_of_domain, beyond_wall, in_other, bad_volume;
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

static bool look_in_other(void *context, const double *x, double volume) {
    (void)volume;
    struct outside *o = context;
    o->in_other += mpm_shape_contains(o->other, x, o->def->dimension, o->unit);
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
                                                          def->dimension, 1, false, false, false) /
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
        o.other = &def->bodies[a].shape;
        o.in_other = 0;
        if (boxes_meet(o.other, &body->shape, def->dimension)) {
            mpm_seed(def, body, look_in_other, &o);
        }
        if (o.in_other) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("/bodies/%s%s", body->name, place),
                  TEXT("outside body '%s'", def->bodies[a].name),
                  TEXT("%zu particles inside it", o.in_other),
                  "bodies '%s' and '%s' overlap: %zu particles of one lie inside the other",
                  def->bodies[a].name, body->name, o.in_other);
        }
    }
    return true;
}

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

static void check_probe(struct report *r, const struct mpm_def *def,
                        const struct mpm_probe_def *q) {
    if (q->body >= (int)def->n_bodies) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/probes/%s/body", q->name), "a body", TEXT("%d", q->body),
              "probe '%s' names no body", q->name);
    }
    if (q->kind == MPM_PROBE_REACTION && (q->wall < 0 || (size_t)q->wall >= def->n_walls)) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/probes/%s/wall", q->name), "a wall", TEXT("%d", q->wall),
              "probe '%s' names no wall", q->name);
    }
    if (q->kind == MPM_PROBE_EXTENT && !(q->quantile > 0 && q->quantile <= 1)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/probes/%s/quantile", q->name), "above 0 and at most 1",
              TEXT("%.9g", q->quantile), "the quantile of probe '%s' must be in (0, 1]", q->name);
    }
    if (!(q->average >= 0 && is_finite(q->average))) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/probes/%s/average", q->name), "at least 0, s",
              TEXT("%.9g", q->average), "the averaging window of probe '%s' must not be negative",
              q->name);
    }
}

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
        if (mpm_check_settings(&now, TEXT("/stages/%zu", k), def->dimension, INFINITY, true,
                               &fault)) {
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
                               def->unstable_ok, &fault)) {
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
    if (mpm_check_settings(&def->settings, "", def->dimension, INFINITY, true, &fault)) {
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
        check_probe(&r, def, &def->probes[k]);
    }
    if (r.count) {
        return r.count; // what follows would divide by them
    }
    double total = 0;
    bool made_of = true;
    for (size_t b = 0; b < def->n_bodies && total < INFINITY; b++) {
        made_of &= check_body(&r, def, b, &total);
    }
    if (made_of) {
        check_times(&r, def);
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
