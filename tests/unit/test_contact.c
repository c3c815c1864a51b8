// Contact with rigid bodies: distances, the barrier, no penetration, impulse, friction, work,
// removal, state.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/sim.h"

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

// ---- Distances ----------------------------------------------------------------------------------

static double uniform(double min, double max) { // the same numbers everywhere
    static uint64_t state = 1;
    state = state * 6364136223846793005ULL + 1442695040888963407ULL;
    return min + (max - min) * (double)(state >> 11) / 9007199254740992.0;
}

// An L, counter-clockwise, with a reflex corner at (1, 1); and the same the other way round.
static const double ell[2][12] = {{0, 0, 3, 0, 3, 1, 1, 1, 1, 2, 0, 2},
                                  {0, 2, 1, 2, 1, 1, 3, 1, 3, 0, 0, 0}};
static const struct mpm_shape shapes[] = {
    {.kind = MPM_SHAPE_BOX, .min = {-1, 0.5, 2}, .max = {1, 1, 2.25}},
    {.kind = MPM_SHAPE_BALL, .centre = {0.5, -0.25, 1}, .radius = 0.75},
    {.kind = MPM_SHAPE_POLYGON, .n_points = 6, .points = ell[0]},
    {.kind = MPM_SHAPE_POLYGON, .n_points = 6, .points = ell[1]},
};
#define N_SHAPES (sizeof shapes / sizeof *shapes)

static double segment_distance(const double *a, const double *b, const double *x) {
    double least = INFINITY, best = 0, from = 0, to = 1; // brute force, in four rounds
    for (int round = 0; round < 4; round++) {
        for (int k = 0; k <= 100; k++) {
            const double t = from + (to - from) * k / 100;
            const double r =
                hypot(a[0] + t * (b[0] - a[0]) - x[0], a[1] + t * (b[1] - a[1]) - x[1]);
            if (r < least) {
                least = r;
                best = t;
            }
        }
        const double width = (to - from) / 100;
        from = fmax(0, best - width);
        to = fmin(1, best + width);
    }
    return least;
}

// Distance from the surface by looking at its points, and whether x is inside.
static double brute_distance(const struct mpm_shape *s, const double *x, int dim) {
    double least = INFINITY;
    bool inside = true;
    if (s->kind == MPM_SHAPE_BALL) {
        double r2 = 0;
        for (int d = 0; d < dim; d++) {
            r2 += (x[d] - s->centre[d]) * (x[d] - s->centre[d]);
        }
        return sqrt(r2) - s->radius;
    }
    if (s->kind == MPM_SHAPE_POLYGON) {
        for (size_t i = 0; i < s->n_points; i++) {
            least = fmin(least, segment_distance(s->points + 2 * i,
                                                 s->points + 2 * ((i + 1) % s->n_points), x));
        }
        inside = (x[0] > 0 && x[0] < 3 && x[1] > 0 && x[1] < 1) ||
                 (x[0] > 0 && x[0] < 1 && x[1] > 0 && x[1] < 2);
        return inside ? -least : least;
    }
    for (int face = 0; face < 2 * dim; face++) { // the nearest point of each face
        double r2 = 0;
        for (int d = 0; d < dim; d++) {
            const double near = d != face / 2 ? fmin(fmax(x[d], s->min[d]), s->max[d])
                                : face % 2    ? s->max[d]
                                              : s->min[d];
            r2 += (x[d] - near) * (x[d] - near);
        }
        least = fmin(least, sqrt(r2));
    }
    for (int d = 0; d < dim; d++) {
        inside &= x[d] > s->min[d] && x[d] < s->max[d];
    }
    return inside ? -least : least;
}

static double dot(const double *a, const double *b, int dim) {
    double sum = 0;
    for (int d = 0; d < dim; d++) {
        sum += a[d] * b[d];
    }
    return sum;
}

// The distance is the brute one, the normal a unit vector; a walk of d along it ends on the
// surface.
static void test_contact_distance_is_the_nearest(void **state) {
    (void)state;
    for (size_t k = 0; k < N_SHAPES; k++) {
        const struct mpm_shape *s = &shapes[k];
        for (int dim = 2; dim <= (s->kind == MPM_SHAPE_POLYGON ? 2 : 3); dim++) {
            for (int i = 0; i < 3000; i++) {
                double x[3], n[3], y[3], m[3];
                for (int d = 0; d < 3; d++) {
                    x[d] = uniform(d == 2 ? 0 : -1.5, d == 0 ? 4 : 3);
                }
                const double distance = mpm_shape_distance(s, x, dim, n);
                assert_near(distance, brute_distance(s, x, dim), 2e-8); // its last width squared
                assert_near(dot(n, n, dim), 1, 1e-14);
                for (int d = 0; d < dim; d++) {
                    y[d] = x[d] - distance * n[d];
                }
                assert_near(mpm_shape_distance(s, y, dim, m), 0, 1e-14);
                for (int d = 0; d < dim; d++) { // outwards: further on, the distance grows
                    y[d] = x[d] + 1e-6 * n[d];
                }
                assert_near(mpm_shape_distance(s, y, dim, m), distance + 1e-6, 1e-12);
            }
        }
    }
}

// On the surface, and within round-off of it, the normal is the face's own.
static void test_contact_normal_on_the_surface(void **state) {
    (void)state;
    static const struct {
        size_t shape;
        double x[2], n[2];
    } at[] = {{0, {0.3, 1}, {0, 1}},  {0, {-1, 0.7}, {-1, 0}},    {0, {1, 0.9}, {1, 0}},
              {2, {2.1, 1}, {0, 1}},  {2, {1, 1.7}, {1, 0}},      {2, {0.7, 0}, {0, -1}},
              {2, {0, 1.3}, {-1, 0}}, {2, {3, 0.2}, {1, 0}},      {3, {2.1, 1}, {0, 1}},
              {3, {1, 1.7}, {1, 0}},  {3, {0.7, 0}, {0, -1}},     {3, {0, 1.3}, {-1, 0}},
              {3, {3, 0.2}, {1, 0}},  {1, {1.25, -0.25}, {1, 0}}, {1, {0.5, 0.5}, {0, 1}}};
    for (size_t k = 0; k < sizeof at / sizeof *at; k++) {
        for (int off = -2; off <= 2; off++) {
            const double x[2] = {at[k].x[0] + off * 1e-16 * at[k].n[0],
                                 at[k].x[1] + off * 1e-16 * at[k].n[1]};
            double n[2];
            assert_near(mpm_shape_distance(&shapes[at[k].shape], x, 2, n), 0, 5e-16);
            assert_near(n[0], at[k].n[0], 1e-14);
            assert_near(n[1], at[k].n[1], 1e-14);
        }
    }
    // A slanted edge, whose points are on it to round-off only.
    static const double wedge[2][6] = {{0, 0, 1, 0, 0, 0.37}, {0, 0.37, 1, 0, 0, 0}};
    for (int way = 0; way < 2; way++) {
        const struct mpm_shape s = {.kind = MPM_SHAPE_POLYGON, .n_points = 3, .points = wedge[way]};
        const double length = hypot(1, 0.37);
        for (int k = 1; k < 1000; k++) {
            const double x[2] = {k / 1000.0, 0.37 * (1 - k / 1000.0)};
            double n[2];
            assert_near(mpm_shape_distance(&s, x, 2, n), 0, 2e-16);
            assert_near(n[0], 0.37 / length, 1e-14);
            assert_near(n[1], 1 / length, 1e-14);
        }
    }
    // On a corner any direction between the edges' normals will do.
    double n[3];
    for (size_t k = 0; k < N_SHAPES; k++) {
        const double corner[3] = {k == 0 ? 1 : 3, k == 0 ? 1 : 1, 2.25};
        if (shapes[k].kind != MPM_SHAPE_BALL) {
            assert_near(mpm_shape_distance(&shapes[k], corner, 2, n), 0, 0);
            assert_near(dot(n, n, 2), 1, 1e-15);
            assert_true(n[0] >= 0 && n[1] >= 0);
        }
    }
    assert_near(mpm_shape_distance(&shapes[1], shapes[1].centre, 3, n), -0.75, 0);
    assert_near(dot(n, n, 3), 1, 0);
}

// p is k/D times the derivative of (d - D)^2 ln(d/D), falls from D/100 to D, and ends smoothly in
// 0.
static void test_contact_barrier_is_a_derivative(void **state) {
    (void)state;
    const struct mpm_rigid_def q = {.stiffness = 500, .distance = 1e-3};
    const double D = q.distance, step = 1e-9;
    double before = INFINITY;
    for (int k = 1; k <= 1000; k++) {
        const double d = 0.01 * D + k * 0.99 * D / 1000, p = mpm_barrier_pressure(&q, d);
        assert_true(p >= 0 && p < before);
        before = p;
        if (k < 1000) {
            const double a = d - step, b = d + step;
            const double slope =
                ((b - D) * (b - D) * log(b / D) - (a - D) * (a - D) * log(a / D)) / (2 * step);
            // Central difference: (step/d)^2 of it, and the round-off of a small difference.
            assert_near(p, q.stiffness / D * slope, 2e-4 * p + 1e-4);
        }
    }
    assert_true(before == 0 && mpm_barrier_pressure(&q, 2 * D) == 0);
    assert_true(mpm_barrier_pressure(&q, D * (1 - 1e-8)) < 1e-12 * q.stiffness); // no jump, no kink
    const double most = mpm_barrier_pressure(&q, 0.01 * D);
    assert_near(most / q.stiffness, 2 * -0.99 * log(0.01) + 98.01, 1e-12);
    assert_true(mpm_barrier_pressure(&q, 0) == most && mpm_barrier_pressure(&q, -1) == most);
}

// ---- Problems -----------------------------------------------------------------------------------

#define H 0.125
#define DISTANCE 4e-3
#define FOR_KERNELS(dim, basis)                                                                    \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int basis = 0; basis < MPM_N_BASES; basis++)

// Linear functions throw particles about as they cross cells (f/m of a node that is hardly
// touched).
#define FOR_SMOOTH(dim, basis)                                                                     \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int basis = MPM_GIMP; basis < MPM_N_BASES; basis++)

// A rubber block from 0.75 to 1.25 m in a space of 3 m, and one rigid body; one problem at a time.
static struct {
    struct mpm_def def;
    struct mpm_material_def material;
    struct mpm_body_def body;
    struct mpm_stage_def stages[2];
    struct mpm_rigid_def rigid;
    struct mpm_probe_def probe;
    bool removes;
} world;
#define LOW 0.75
#define HIGH 1.25

static void define(int dim, int basis, double youngs_modulus) {
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.material = (struct mpm_material_def){.name = "rubber",
                                               .model = mpm_material_find("neo_hookean"),
                                               .parameters = {1000, youngs_modulus, 0.3},
                                               .fbar = true};
    world.body = (struct mpm_body_def){.name = "block", .particles_per_direction = 2};
    for (int k = 0; k < 2; k++) {
        world.stages[k] = (struct mpm_stage_def){.name = "stage", .duration = 100};
    }
    world.probe = (struct mpm_probe_def){
        .name = "force", .kind = MPM_PROBE_REACTION, .body = -1, .wall = -1, .scale = 1};
    world.rigid = (struct mpm_rigid_def){.name = "anvil", .stiffness = 1e4, .distance = DISTANCE};
    for (int d = 0; d < 3; d++) {
        world.body.shape.min[d] = LOW;
        world.body.shape.max[d] = HIGH;
        world.def.domain_min[d] = -1;
        world.def.domain_max[d] = 3;
        // Below the block, its surface `distance` away from the lowest particles.
        world.rigid.shape.min[d] = d == 1 ? 0 : -1;
        world.rigid.shape.max[d] = d == 1 ? LOW + H / 4 - DISTANCE : 3;
    }
    world.def.dimension = dim;
    world.def.basis = (enum mpm_basis)basis;
    world.def.cell = H;
    world.def.settings.cfl = 0.3;
    world.def.n_materials = world.def.n_bodies = world.def.n_stages = world.def.n_rigids = 1;
    world.def.n_probes = 1;
    world.def.materials = &world.material;
    world.def.bodies = &world.body;
    world.def.stages = world.stages;
    world.def.rigids = &world.rigid;
    world.def.probes = &world.probe;
}

static struct mpm_sim *create(void) {
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&world.def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    return sim;
}

static void step(struct mpm_sim *sim) {
    struct mpm_error err = {0};
    if (mpm_step(sim, &err)) {
        fail_msg("%s", err.message);
    }
}

static double least_distance(const struct mpm_sim *sim) {
    const struct mpm_rigid *rigid = &sim->rigids[0];
    double least = INFINITY;
    const struct mpm_particles *s = &sim->sets[0];
    for (size_t p = 0; p < s->n; p++) {
        double x[3], n[3];
        for (int d = 0; d < s->dim; d++) {
            x[d] = s->x[mpm_at(p, s->dim, d)] - rigid->offset[d];
        }
        least = fmin(least, mpm_shape_distance(&rigid->def.shape, x, s->dim, n));
    }
    return least;
}

static void mean_of(const struct mpm_sim *sim, bool velocity, double *mean) {
    const struct mpm_particles *s = &sim->sets[0];
    const double *from = velocity ? s->v : s->x;
    memset(mean, 0, 3 * sizeof *mean);
    for (size_t p = 0; p < s->n; p++) {
        for (int d = 0; d < s->dim; d++) {
            mean[d] += from[mpm_at(p, s->dim, d)] / (double)s->n;
        }
    }
}

// A block is thrown at a box and a disk, at up to half its wave speed: no particle ever gets in,
// and what it loses in momentum is the reaction's impulse, step by step.
static void throw(int dim, int basis, double speed, bool ball, double friction, int scheme) {
    define(dim, basis, 1e7); // waves at 116 m/s
    world.rigid.friction = friction;
    world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
    world.body.velocity.vector[0] = 0.3 * speed;
    world.body.velocity.vector[1] = -speed;
    if (ball) {
        world.rigid.shape = (struct mpm_shape){.kind = MPM_SHAPE_BALL,
                                               .centre = {1.1, LOW + H / 4 - 0.4, 1.1},
                                               .radius = 0.4 - DISTANCE};
    }
    struct mpm_sim *sim = create();
    struct mpm_balance first, b, last;
    mpm_balance(sim, &first);
    last = first;
    bool touched = false;
    const int n_steps = dim == 2 ? 150 : 40;
    for (int k = 0; k < n_steps; k++) {
        const double dt = mpm_next_dt(sim);
        double F[MPM_MAX_COMPONENTS];
        step(sim);
        assert_true(least_distance(sim) >= 0.01 * DISTANCE * (1 - 1e-9));
        mpm_balance(sim, &b);
        mpm_probe_value(sim, 0, F);
        for (int d = 0; d < dim; d++) {
            assert_near(b.momentum[d] - last.momentum[d], -F[d] * dt, 1e-12 * b.mass * speed);
        }
        touched |= F[1] < 0;
        last = b;
    }
    assert_true(touched && b.momentum[1] > first.momentum[1]);
    assert_true(b.kinetic_energy + b.strain_energy < 1.02 * first.kinetic_energy);
    mpm_free(sim);
}

static void test_contact_lets_nothing_in(void **state) {
    (void)state;
    const double speeds[] = {0.1, 1, 10, 50};
    FOR_KERNELS(dim, basis) {
        for (int k = 0; k < (basis == MPM_LINEAR ? 2 : 4); k++) {
            for (int ball = 0; ball < 2; ball++) {
                if (dim == 3 && (k + ball) % 2) {
                    continue;
                }
                throw(dim, basis, speeds[k], ball, 0.3 * (k % 2), MPM_FBAR_OFF);
                if (dim == 2 && basis == MPM_GIMP) {
                    throw(dim, basis, speeds[k], ball, 10, MPM_FBAR_ZHAO);
                    throw(dim, basis, speeds[k], ball, 10, MPM_FBAR_ANCHORED);
                }
            }
        }
    }
}

// The same when the rigid body is what moves, into a corner of the L.
static void test_contact_lets_nothing_in_when_it_moves(void **state) {
    (void)state;
    static double corner[2][12];
    for (int way = 0; way < 2; way++) {
        for (int i = 0; i < 6; i++) { // its reflex corner under the block
            corner[way][2 * i] = LOW - 0.25 + (ell[way][2 * i] - 1) / 2;
            corner[way][2 * i + 1] = LOW - 0.25 + (ell[way][2 * i + 1] - 1) / 2;
        }
        for (int basis = MPM_GIMP; basis < MPM_N_BASES; basis++) {
            for (double speed = 0.1; speed < 60; speed *= 8) {
                define(2, basis, 1e7);
                world.rigid.friction = 0.5;
                world.rigid.shape = (struct mpm_shape){
                    .kind = MPM_SHAPE_POLYGON, .n_points = 6, .points = corner[way]};
                world.rigid.velocity[0] = world.rigid.velocity[1] = speed;
                world.rigid.shape.points = corner[way];
                struct mpm_sim *sim = create();
                double v[3], end = 0.5 / speed;
                for (int k = 0; k < 400 && mpm_time(sim) < end; k++) {
                    step(sim);
                    assert_true(least_distance(sim) >= 0.01 * DISTANCE * (1 - 1e-9));
                }
                mean_of(sim, true, v);
                assert_true(speed < 5 || (v[0] > 0.5 * speed && v[1] > 0.5 * speed));
                mpm_free(sim);
            }
        }
    }
}

// ---- Friction -----------------------------------------------------------------------------------

#define G 10.0

// A block on a slope of angle theta: gravity tilted over a flat body, or a wedge and gravity
// upright. It settles on it with much friction; velocity and place along the slope after `wait`.
struct slide {
    double v0, v1, x0, x1, t;
};
static struct slide slide(int dim, int basis, double theta, double mu, bool wedge, double seconds) {
    static double points[6];
    define(dim, basis, 1e6);
    double t[3] = {1, 0, 0}, n[3] = {0, 1, 0}; // along and off the slope
    world.rigid.stiffness = 2e4;               // 5 kPa under the block
    world.rigid.friction = mu;
    if (wedge) {
        t[0] = n[1] = cos(theta);
        t[1] = -sin(theta);
        n[0] = sin(theta);
        // The block stands upright in its cells, so it is cut along the slope.
        static double block[8];
        const double c = cos(theta), s = sin(theta);
        for (int k = 0; k < 4; k++) { // 0.5 x 0.5 along the slope, about (1, 1)
            const double a = k == 1 || k == 2 ? 0.25 : -0.25, b = k >= 2 ? 0.25 : -0.25;
            block[2 * k] = 1 + c * a + s * b;
            block[2 * k + 1] = 1 - s * a + c * b;
        }
        world.body.shape =
            (struct mpm_shape){.kind = MPM_SHAPE_POLYGON, .n_points = 4, .points = block};
        world.body.particles_per_direction = 4;
        const double off = -0.25 - DISTANCE; // every particle is at least this far from the slope
        const double mid[2] = {1 + s * off, 1 + c * off};
        points[0] = mid[0] - 1.5 * c;
        points[1] = mid[1] + 1.5 * s;
        points[2] = mid[0] - 1.5 * c - s;
        points[3] = mid[1] + 1.5 * s - 2;
        points[4] = mid[0] + 1.5 * c;
        points[5] = mid[1] - 1.5 * s;
        world.rigid.shape =
            (struct mpm_shape){.kind = MPM_SHAPE_POLYGON, .n_points = 3, .points = points};
        world.def.settings.gravity[1] = -G;
    } else {
        world.def.settings.gravity[0] = G * sin(theta);
        world.def.settings.gravity[1] = -G * cos(theta);
    }
    // Much damping while the block settles: ringing would unload it. It starts from rest then.
    world.def.n_stages = 2;
    world.stages[0].duration = 0.3;
    world.stages[0].states = MPM_SET_DAMPING;
    world.stages[0].settings.damping_mass = 100;
    world.stages[1].resets = MPM_RESET_VELOCITY;
    struct mpm_sim *sim = create();
    struct slide out = {0};
    double x[3], v[3];
    while (mpm_time(sim) < 0 || mpm_stage(sim) == 0) {
        step(sim);
    }
    while (mpm_time(sim) < seconds / 4) {
        step(sim);
    }
    out.t = mpm_time(sim);
    mean_of(sim, false, x);
    mean_of(sim, true, v);
    out.x0 = dot(x, t, dim);
    out.v0 = dot(v, t, dim);
    while (mpm_time(sim) < seconds) {
        step(sim);
    }
    out.t = mpm_time(sim) - out.t;
    mean_of(sim, false, x);
    mean_of(sim, true, v);
    out.x1 = dot(x, t, dim);
    out.v1 = dot(v, t, dim);
    mpm_free(sim);
    return out;
}

static void test_contact_sticks_below_the_angle_of_friction(void **state) {
    (void)state;
    FOR_SMOOTH(dim, basis) {
        for (int wedge = 0; wedge < (dim == 2 ? 2 : 1); wedge++) {
            const double theta = 0.35; // tan 0.365
            const double seconds = dim == 2 ? 0.8 : 0.4;
            const struct slide a = slide(dim, basis, theta, 0.5, wedge, seconds);
            // Free, it would have gone 1 m; it stays but for elastic swinging, about a static slip
            // of tau D/k = 0.3 mm.
            assert_near(a.x1, a.x0, 1e-3);
        }
    }
}

static void test_contact_slides_above_the_angle_of_friction(void **state) {
    (void)state;
    FOR_SMOOTH(dim, basis) {
        for (int wedge = 0; wedge < (dim == 2 ? 2 : 1); wedge++) {
            for (int k = 0; k < 2; k++) {
                const double theta = 0.35, mu = 0.2 * k;
                const double seconds = dim == 2 ? 0.4 : 0.2;
                const struct slide a = slide(dim, basis, theta, mu, wedge, seconds);
                const double exact = G * (sin(theta) - mu * cos(theta));
                assert_near((a.v1 - a.v0) / a.t, exact, 0.02 * exact);
            }
        }
    }
}

// ---- Work, stages, state ------------------------------------------------------------------------

// Energy in the barrier: its integral over the gap, for every particle in contact.
static double barrier_energy(const struct mpm_sim *sim) {
    const struct mpm_rigid *rigid = &sim->rigids[0];
    const struct mpm_particles *s = &sim->sets[0];
    double sum = 0;
    for (size_t p = 0; p < s->n; p++) {
        double x[3], n[3];
        for (int d = 0; d < s->dim; d++) {
            x[d] = s->x[mpm_at(p, s->dim, d)] - rigid->offset[d];
        }
        const double D = DISTANCE, d = mpm_shape_distance(&rigid->def.shape, x, s->dim, n);
        if (d < D) {
            sum += rigid->def.stiffness / D * (d - D) * (d - D) * log(D / d) *
                   (s->dim == 2 ? sqrt(s->V0[p]) : pow(cbrt(s->V0[p]), 2));
        }
    }
    return sum;
}

// What a piston spends is what the block has: it squeezes it against a wall, slowly. And a force
// that acts for a time on a free body gives it its impulse (the throws above).
static void test_contact_does_the_work_that_is_gained(void **state) {
    (void)state;
    FOR_SMOOTH(dim, basis) {
        define(dim, basis, 1e5);
        struct mpm_wall_def wall = {
            .name = "roof", .axis = 1, .at = HIGH, .condition = MPM_WALL_SLIP};
        world.def.walls = &wall;
        world.def.n_walls = 1;
        world.rigid.stiffness = 2e4;
        world.rigid.velocity[1] = 0.05; // waves: 11.6 m/s
        struct mpm_sim *sim = create();
        struct mpm_balance b;
        while (mpm_time(sim) < 0.8) { // 4 cm, 8 % of its height
            step(sim);
        }
        mpm_balance(sim, &b);
        const double gained = b.kinetic_energy + b.strain_energy + barrier_energy(sim);
        assert_true(b.external_work > 0.5 * 1e5 * 0.06 * 0.06 * 0.5 * (dim == 2 ? 0.5 : 0.25));
        assert_true(b.kinetic_energy < 0.1 * gained);
        // What is lost goes with the waves of the sudden start: 3.5 % (quadratic B-spline) at 0.2
        // m/s.
        assert_near(gained, b.external_work, 0.02 * gained);
        mpm_free(sim);
    }
}

static void test_contact_ends_with_a_stage(void **state) {
    (void)state;
    define(2, MPM_GIMP, 1e6);
    world.def.settings.gravity[1] = -G;
    world.rigid.friction = 0.5;
    world.def.n_stages = 2;
    world.stages[0].duration = 0.3;
    world.removes = true;
    world.stages[1].removes_rigid = &world.removes;
    struct mpm_sim *sim = create();
    double F[MPM_MAX_COMPONENTS], v[3];
    while (mpm_stage(sim) == 0) {
        step(sim);
    }
    mpm_probe_value(sim, 0, F);
    assert_true(F[0] == 0 && F[1] == 0);
    mean_of(sim, true, v);
    const double before = v[1];
    while (mpm_time(sim) < 0.2) {
        step(sim);
        mpm_probe_value(sim, 0, F);
        assert_true(F[0] == 0 && F[1] == 0);
    }
    mean_of(sim, true, v);
    assert_near(v[1] - before, -G * mpm_time(sim), 1e-10); // free fall, through where it was
    mpm_free(sim);
    world.def.n_stages = 1; // from the start it may even stand inside the block
    world.stages[0].removes_rigid = &world.removes;
    world.rigid.shape.max[1] = 1;
    sim = create();
    step(sim);
    mpm_probe_value(sim, 0, F);
    assert_true(F[1] == 0);
    mpm_free(sim);
}

// The block rests on the body, which carries its weight.
static void test_contact_carries_the_weight(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        define(dim, basis, 1e6);
        world.def.settings.gravity[1] = -G;
        world.def.settings.damping_mass = 40;
        world.stages[0].duration = 0.4;
        world.probe.average = 0.05;
        struct mpm_sim *sim = create();
        while (!mpm_finished(sim)) {
            step(sim);
        }
        double F[MPM_MAX_COMPONENTS];
        mpm_probe_value(sim, 0, F);
        const double weight = 1000 * G * pow(HIGH - LOW, dim);
        assert_near(F[1], -weight, 0.01 * weight); // exp(-40 * 0.35 / 2) of it still swings
        assert_near(F[0], 0, 0.001 * weight);
        mpm_free(sim);
    }
}

// Thrown at the body aslant, with friction and F-bar.
static struct mpm_sim *create_thrown(int dim, int n_threads) {
    define(dim, MPM_GIMP, 1e6);
    world.rigid.friction = 0.3;
    world.rigid.velocity[0] = 0.1;
    world.probe.average = 0.01;
    world.rigid.stiffness = 1e5;
    world.body.velocity.vector[0] = 0.3;
    world.body.velocity.vector[1] = -0.3;
    world.body.particles_per_direction = dim == 2 ? 12 : 4; // some chunks of 1024
    world.rigid.shape.max[1] = LOW + H / (dim == 2 ? 24 : 8) - DISTANCE;
    world.def.settings.fbar.scheme = MPM_FBAR_ZHAO;
    world.def.n_threads = n_threads;
    return create();
}

static void assert_same_state(const struct mpm_sim *a, const struct mpm_sim *b) {
    const struct mpm_rigid *r = &a->rigids[0], *q = &b->rigids[0];
    assert_memory_equal(a->sets[0].memory, b->sets[0].memory, a->sets[0].memory_bytes);
    assert_memory_equal(r->offset, q->offset, sizeof r->offset);
    assert_memory_equal(r->reaction, q->reaction, sizeof r->reaction);
    assert_memory_equal(r->anchor, q->anchor, r->anchor_bytes);
    assert_memory_equal(a->averages, b->averages, sizeof *a->averages);
    assert_true(a->c.external_work == b->c.external_work && a->c.time == b->c.time);
}

static void test_contact_does_not_depend_on_threads(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_sim *one = create_thrown(dim, 1);
        for (int k = 0; k < 15; k++) {
            step(one);
        }
        assert_true(fabs(one->rigids[0].reaction[1]) > 0);
        for (int n = 2; n <= 3; n++) {
            struct mpm_sim *many = create_thrown(dim, n);
            for (int k = 0; k < 15; k++) {
                step(many);
            }
            assert_same_state(one, many);
            mpm_free(many);
        }
        mpm_free(one);
    }
}

static void test_contact_goes_on_from_a_saved_state(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_sim *sim = create_thrown(dim, 1);
        for (int k = 0; k < 10; k++) {
            step(sim);
        }
        assert_true(fabs(sim->rigids[0].reaction[0]) > 0 && sim->rigids[0].offset[0] > 0);
        const size_t bytes = mpm_state_bytes(sim);
        char *saved = malloc(bytes);
        mpm_state_save(sim, saved);
        struct mpm_sim *again = create();
        assert_int_equal(mpm_state_load(again, saved, bytes, NULL), MPM_OK);
        free(saved);
        for (int k = 0; k < 40; k++) {
            step(sim);
            step(again);
        }
        assert_same_state(sim, again);
        mpm_free(sim);
        mpm_free(again);
    }
}

// Without a rigid body nothing is kept for it; with friction, one place a particle.
static void test_contact_costs_what_it_uses(void **state) {
    (void)state;
    define(2, MPM_GIMP, 1e6);
    for (int k = 0; k < 3; k++) {
        world.def.n_rigids = k > 0;
        world.def.n_probes = 0;
        world.rigid.friction = k == 2;
        struct mpm_estimate estimate;
        mpm_estimate(&world.def, &estimate);
        struct mpm_sim *sim = create();
        static size_t bytes, state_bytes, estimated;
        const size_t anchors = k == 2 ? mpm_n_particles(sim) * 2 * sizeof(double) : 0;
        if (k == 0) {
            bytes = mpm_bytes(sim);
            state_bytes = mpm_state_bytes(sim);
            estimated = estimate.bytes;
        }
        assert_int_equal(mpm_bytes(sim), bytes + anchors);
        assert_int_equal(estimate.bytes, estimated + anchors);
        assert_true(mpm_state_bytes(sim) - state_bytes ==
                    (k > 0 ? 6 * sizeof(double) + 1 : 0) + anchors);
        mpm_free(sim);
    }
}

// A body far away changes no bit.
static void test_contact_at_a_distance_is_none(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        struct mpm_sim *sims[2];
        define(dim, basis, 1e6);
        world.rigid.shape.max[1] = LOW - 0.1;
        world.rigid.friction = 1;
        world.body.velocity.vector[0] = 1;
        world.def.settings.dt = 1e-3;
        world.def.n_probes = 0;
        for (int k = 0; k < 2; k++) {
            world.def.n_rigids = (size_t)k;
            sims[k] = create();
            for (int i = 0; i < 20; i++) {
                step(sims[k]);
            }
        }
        assert_memory_equal(sims[0]->sets[0].memory, sims[1]->sets[0].memory,
                            sims[0]->sets[0].memory_bytes);
        mpm_free(sims[0]);
        mpm_free(sims[1]);
    }
}

// What a body pushes out of the domain fails the step that does it, before a particle out there is
// used as an index.
static void test_contact_cannot_push_out_of_the_domain(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        define(dim, basis, 1e7);
        world.def.domain_max[1] = HIGH;
        world.rigid.velocity[1] = 300;
        world.def.unstable_ok = true;
        struct mpm_sim *sim = create();
        struct mpm_error err = {0};
        enum mpm_status status = MPM_OK;
        for (int k = 0; k < 500 && !status; k++) {
            status = mpm_step(sim, &err);
        }
        assert_true(status == MPM_ERR_LEFT_DOMAIN || status == MPM_ERR_VOLUME);
        mpm_free(sim);
        world.rigid.shape.min[1] = -3;
        world.rigid.velocity[1] = 1e6; // out in one step, by far more than the grid's rim
        world.def.settings.dt = 1e-6;
        sim = create();
        assert_int_equal(mpm_step(sim, &err), MPM_ERR_LEFT_DOMAIN);
        mpm_free(sim);
    }
}

// The step of a scene is short enough for its rigid bodies.
static void test_contact_speed_limits_the_step(void **state) {
    (void)state;
    define(2, MPM_GIMP, 1e6);
    struct mpm_estimate slow, fast;
    mpm_estimate(&world.def, &slow);
    struct mpm_sim *sim = create();
    assert_near(mpm_dt_limit(sim), slow.dt_limit, 0);
    mpm_free(sim);
    world.rigid.velocity[0] = -3;
    world.rigid.velocity[1] = -4;
    mpm_estimate(&world.def, &fast);
    sim = create();
    assert_near(mpm_dt_limit(sim), fast.dt_limit, 0);
    mpm_free(sim);
    const double c = 0.5 * H / slow.dt_limit; // m/s
    assert_near(0.5 * H / fast.dt_limit, c + 5, 1e-9);
}

static void assert_refused(enum mpm_status status, const char *pointer) {
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    assert_int_equal(mpm_create(&world.def, &sim, &err), status);
    assert_string_equal(err.pointer, pointer);
    assert_null(sim);
}

static void test_contact_refuses_bodies_that_are_none(void **state) {
    (void)state;
    fedisableexcept(FE_INVALID); // infinities are looked at
    const struct mpm_shape inner = {.kind = MPM_SHAPE_BALL, .radius = 0.1};
#define REFUSED(status, pointer, ...)                                                              \
    do {                                                                                           \
        define(2, MPM_GIMP, 1e6);                                                                  \
        __VA_ARGS__;                                                                               \
        assert_refused(status, "/rigid_bodies/anvil/" pointer);                                    \
    } while (0)
    REFUSED(MPM_ERR_RANGE, "contact/stiffness", world.rigid.stiffness = 0);
    REFUSED(MPM_ERR_RANGE, "contact/stiffness", world.rigid.stiffness = INFINITY);
    REFUSED(MPM_ERR_RANGE, "contact/distance", world.rigid.distance = 0);
    REFUSED(MPM_ERR_RANGE, "contact/distance", world.rigid.distance = H);
    REFUSED(MPM_ERR_RANGE, "contact/friction", world.rigid.friction = -0.1);
    REFUSED(MPM_ERR_RANGE, "velocity/1", world.rigid.velocity[1] = INFINITY);
    REFUSED(MPM_ERR_RANGE, "shape/box/max/0", world.rigid.shape.max[0] = -1);
    REFUSED(MPM_ERR_RANGE, "shape/disk/radius", world.rigid.shape = inner,
            world.rigid.shape.radius = 0);
    REFUSED(MPM_ERR_CONFLICT, "shape",
            world.rigid.shape =
                (struct mpm_shape){.kind = MPM_SHAPE_UNION, .n_children = 1, .children = &inner});
    REFUSED(MPM_ERR_CONFLICT, "shape", world.rigid.shape.max[1] = LOW + H / 4); // on the surface
    REFUSED(MPM_ERR_CONFLICT, "shape", world.rigid.shape.max[1] = 1);
    define(2, MPM_GIMP, 1e6);
    world.rigid.shape.max[1] = LOW + H / 4 - 1e-9;
    mpm_free(create());
    define(2, MPM_GIMP, 1e6);
    world.probe.rigid = 1;
    assert_refused(MPM_ERR_REFERENCE, "/probes/force/wall");
    feclearexcept(FE_ALL_EXCEPT);
    feenableexcept(FE_INVALID);
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_contact_distance_is_the_nearest),
        cmocka_unit_test(test_contact_normal_on_the_surface),
        cmocka_unit_test(test_contact_barrier_is_a_derivative),
        cmocka_unit_test(test_contact_lets_nothing_in),
        cmocka_unit_test(test_contact_lets_nothing_in_when_it_moves),
        cmocka_unit_test(test_contact_sticks_below_the_angle_of_friction),
        cmocka_unit_test(test_contact_slides_above_the_angle_of_friction),
        cmocka_unit_test(test_contact_carries_the_weight),
        cmocka_unit_test(test_contact_does_the_work_that_is_gained),
        cmocka_unit_test(test_contact_ends_with_a_stage),
        cmocka_unit_test(test_contact_does_not_depend_on_threads),
        cmocka_unit_test(test_contact_goes_on_from_a_saved_state),
        cmocka_unit_test(test_contact_costs_what_it_uses),
        cmocka_unit_test(test_contact_at_a_distance_is_none),
        cmocka_unit_test(test_contact_cannot_push_out_of_the_domain),
        cmocka_unit_test(test_contact_speed_limits_the_step),
        cmocka_unit_test(test_contact_refuses_bodies_that_are_none),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
