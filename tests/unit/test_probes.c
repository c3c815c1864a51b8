// Probes on states whose values are known, moving means, and the balance of conserved quantities.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
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

#define DT 1e-3

// Two blocks of 4 x 4 cells of 1/8 m, 2 x 2 (x 2) particles each: x from 0 to 0.5 and from 1
// to 1.5.
static struct {
    struct mpm_def def;
    struct mpm_material_def materials[2];
    struct mpm_body_def bodies[2];
    struct mpm_stage_def stages[2];
    struct mpm_wall_def wall;
    struct mpm_probe_def probes[16];
} world;

static void define(int dim) {
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.materials[0] = (struct mpm_material_def){.name = "rubber",
                                                   .model = mpm_material_find("neo_hookean"),
                                                   .parameters = {1000, 1e4, 0.3}};
    world.materials[1] = (struct mpm_material_def){
        .name = "water", .model = mpm_material_find("newtonian"), .parameters = {500, 1e4, 0}};
    for (int b = 0; b < 2; b++) {
        world.bodies[b] = (struct mpm_body_def){.name = b ? "right" : "left",
                                                .material = b,
                                                .particles_per_direction = 2,
                                                .shape = {.min = {b}, .max = {b + 0.5, 0.5, 0.5}}};
    }
    for (int d = 0; d < 3; d++) {
        world.def.domain_min[d] = -1;
        world.def.domain_max[d] = 3;
    }
    world.stages[0] = (struct mpm_stage_def){.name = "main", .duration = 10};
    world.def.dimension = dim;
    world.def.cell = 0.125;
    world.def.settings.dt = DT;
    world.def.n_materials = world.def.n_bodies = 2;
    world.def.n_stages = 1;
    world.def.materials = world.materials;
    world.def.bodies = world.bodies;
    world.def.stages = world.stages;
    world.def.walls = &world.wall;
    world.def.probes = world.probes;
}

static struct mpm_probe_def *add_probe(enum mpm_probe_kind kind, int body) {
    struct mpm_probe_def *q = &world.probes[world.def.n_probes++];
    *q = (struct mpm_probe_def){
        .name = "probe", .kind = kind, .body = body, .scale = 1, .quantile = 1};
    return q;
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

static double value(struct mpm_sim *sim, size_t probe) {
    double out[MPM_MAX_COMPONENTS];
    mpm_probe_value(sim, probe, out);
    return out[0];
}

static void test_probe_extent_is_the_outermost_particle(void **state) {
    (void)state;
    define(2);
    for (int body = -1; body < 2; body++) {
        for (int side = 0; side < 2; side++) {
            add_probe(MPM_PROBE_EXTENT, body)->max_side = side;
        }
    }
    add_probe(MPM_PROBE_EXTENT, 1)->axis = 1;
    add_probe(MPM_PROBE_EXTENT, 1)->scale = -10;
    struct mpm_sim *sim = create();
    const double expected[] = {1.0 / 32,     1.5 - 1.0 / 32, 1.0 / 32, 0.5 - 1.0 / 32,
                               1 + 1.0 / 32, 1.5 - 1.0 / 32, 1.0 / 32, -10 * (1 + 1.0 / 32)};
    for (size_t k = 0; k < 8; k++) {
        assert_int_equal(mpm_probe_components(sim, k), 1);
        assert_string_equal(mpm_probe_component_name(sim, k, 0), "");
        assert_near(value(sim, k), expected[k], 1e-15);
    }
    mpm_free(sim);
}

// The p-quantile of n values is the smallest value that at least p n of them do not exceed; from
// the low side, the mirror image.
static void test_probe_extent_takes_a_quantile(void **state) {
    (void)state;
    define(2);
    const double p[] = {1e-9, 0.1, 0.25, 0.5, 0.7, 0.9, 0.999, 1};
    for (int k = 0; k < 8; k++) {
        for (int side = 0; side < 2; side++) {
            struct mpm_probe_def *q = add_probe(MPM_PROBE_EXTENT, 0);
            q->quantile = p[k];
            q->max_side = side;
        }
    }
    struct mpm_sim *sim = create();
    const size_t n = sim->sets[0].n;
    for (int shuffle = 0; shuffle < 20; shuffle++) {
        // Values 1 .. n in some order, with some of them equal in later rounds.
        const size_t stride[] = {1, 3, 7, 27, 63};
        for (size_t i = 0; i < n; i++) {
            const size_t rank = (i * stride[shuffle % 5] + (size_t)shuffle) % n;
            sim->sets[0].x[mpm_at(i, 2, 0)] =
                (double)(shuffle < 10 ? rank + 1 : rank / 4 * 4 + 1) / (double)n;
        }
        for (size_t k = 0; k < 16; k++) {
            const double wanted = p[k / 2] * (double)n;
            double best = k % 2 ? INFINITY : -INFINITY;
            for (size_t i = 0; i < n; i++) {
                const double x = sim->sets[0].x[mpm_at(i, 2, 0)];
                size_t reached = 0;
                for (size_t j = 0; j < n; j++) {
                    const double y = sim->sets[0].x[mpm_at(j, 2, 0)];
                    reached += k % 2 ? y <= x : y >= x;
                }
                if ((double)reached >= wanted) {
                    best = k % 2 ? fmin(best, x) : fmax(best, x);
                }
            }
            assert_near(value(sim, k), best, 0);
        }
    }
    mpm_free(sim);
}

// A displacement follows the particle that was nearest to the point; with a box, the mean over the
// particles that were in it.
static void test_probe_displacement_follows_its_particle(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim);
        struct mpm_probe_def *q = add_probe(MPM_PROBE_DISPLACEMENT, -1);
        q->at[0] = 1.4, q->at[1] = 0.2, q->at[2] = 0.2;
        q = add_probe(MPM_PROBE_DISPLACEMENT, 0); // the same point, but of the other body
        q->at[0] = 1.4, q->at[1] = 0.2, q->at[2] = 0.2;
        q = add_probe(MPM_PROBE_DISPLACEMENT, 0);
        q->has_box = true;
        q->box_max[0] = 0.125, q->box_max[1] = q->box_max[2] = 1;
        world.bodies[0].velocity = (struct mpm_velocity){.vector = {0, -0.5, 0.25}};
        world.bodies[1].velocity = (struct mpm_velocity){.vector = {1, 0.25, 0}};
        struct mpm_sim *sim = create();
        for (int k = 0; k < 100; k++) {
            step(sim);
        }
        double u[3][MPM_MAX_COMPONENTS];
        for (size_t k = 0; k < 3; k++) {
            assert_int_equal(mpm_probe_components(sim, k), dim);
            mpm_probe_value(sim, k, u[k]);
        }
        for (int d = 0; d < dim; d++) { // round-off of 100 steps
            assert_near(u[0][d], 0.1 * world.bodies[1].velocity.vector[d], 1e-13);
            assert_near(u[1][d], 0.1 * world.bodies[0].velocity.vector[d], 1e-13);
            assert_near(u[2][d], 0.1 * world.bodies[0].velocity.vector[d], 1e-13);
        }
        assert_string_equal(mpm_probe_component_name(sim, 0, 1), "y");
        mpm_free(sim);
    }
}

// With `select`: the mean over the layer that a load would act on.
static void test_probe_selects_as_a_load_does(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim);
        struct mpm_probe_def *q = add_probe(MPM_PROBE_MEAN, 1);
        q->field = MPM_FIELD_POSITION;
        q->has_select = true;
        q->select = (struct mpm_load_def){.axis = 0, .max_side = true};
        q = add_probe(MPM_PROBE_DISPLACEMENT, 0);
        q->has_select = true;
        q->select = (struct mpm_load_def){.axis = 1};
        q = add_probe(MPM_PROBE_MINIMUM, 1); // of the layer, what is in the box too
        q->field = MPM_FIELD_POSITION;
        q->has_select = q->has_box = true;
        q->select = (struct mpm_load_def){.axis = 0, .max_side = true};
        q->box_min[1] = 0.25, q->box_max[0] = 9, q->box_max[1] = q->box_max[2] = 9;
        world.bodies[0].velocity = (struct mpm_velocity){.vector = {0, -0.5, 0.25}};
        struct mpm_sim *sim = create();
        double x[MPM_MAX_COMPONENTS];
        mpm_probe_value(sim, 0, x);
        assert_near(x[0], 1.5 - 1.0 / 32, 1e-14);
        assert_near(x[1], 0.25, 1e-14);
        mpm_probe_value(sim, 2, x);
        assert_near(x[0], 1.5 - 1.0 / 32, 1e-14);
        assert_near(x[1], 0.25 + 1.0 / 32, 1e-14);
        for (int k = 0; k < 10; k++) {
            step(sim);
        }
        mpm_probe_value(sim, 1, x);
        assert_near(x[1], -0.5 * 10 * DT, 1e-13);
        mpm_free(sim);
    }
}

// Errors of a made-up state: the reference is a rigid rotation by a quarter turn, or a table.
static void test_probe_error_by_every_norm(void **state) {
    (void)state;
    define(2);
    static const double points[] = {0, 1.0 / 32, 0.25, 0.5}, values[] = {0, 1, 8, 16}; // 32 Y
    for (int norm = 0; norm < MPM_N_NORMS; norm++) {
        struct mpm_probe_def *q = add_probe(MPM_PROBE_ERROR, 0);
        q->field = MPM_FIELD_DISPLACEMENT;
        q->component = -1;
        q->norm = (enum mpm_norm)norm;
        q->against.solution =
            (struct mpm_solution){.kind = MPM_SOLUTION_ROTATION, .rate = M_PI / 2 / DT};
    }
    for (int norm = 0; norm < MPM_N_NORMS; norm++) {
        struct mpm_probe_def *q = add_probe(MPM_PROBE_ERROR, 0);
        q->field = MPM_FIELD_MEAN_STRESS;
        q->component = -1;
        q->norm = (enum mpm_norm)norm;
        q->against = (struct mpm_against){
            .is_table = true, .n = 4, .n_axes = 1, .axis = {1}, .points = points, .values = values};
        if (norm == MPM_NORM_ABSOLUTE) { // only the upper half, without its right end
            q->has_box = q->has_exclude = true;
            q->box_min[1] = 0.25, q->box_max[0] = q->box_max[1] = 9;
            q->scale = 3;
            q->exclude.min[0] = 0.25;
            q->exclude.max[0] = q->exclude.max[1] = 9;
        }
    }
    struct mpm_sim *sim = create();
    struct mpm_particles *s = &sim->sets[0];
    // Displaced by X, Y instead of by -Y - X, X - Y: off by (2X + Y, 2Y - X), of size sqrt(5) R.
    double R2 = 0, largest = 0, sum[2] = {0}, error2 = 0, size2 = 0, mean = 0;
    for (size_t p = 0; p < s->n; p++) {
        const double X = s->x[mpm_at(p, 2, 0)], Y = s->x[mpm_at(p, 2, 1)];
        s->x[mpm_at(p, 2, 0)] = 2 * X;
        s->x[mpm_at(p, 2, 1)] = 2 * Y;
        R2 += X * X + Y * Y;
        largest = fmax(largest, hypot(X, Y));
        sum[0] += -X - Y;
        sum[1] += X - Y;
        const double stress = 32 * Y + (X > 0.25 ? 1 : -2);
        error2 += X > 0.25 ? 1 : 4;
        size2 += 32 * Y * 32 * Y;
        mean += 32 * Y;
        for (int k = 0; k < 3; k++) {
            s->sigma[mpm_at(p, MPM_SYM(2), k)] = stress;
        }
    }
    const double n = (double)s->n;
    assert_true(isnan(value(sim, MPM_NORM_L2))); // at t = 0 the reference is no displacement
    sim->c.time = DT;
    const double spread = sqrt(2 * R2 / n - (sum[0] * sum[0] + sum[1] * sum[1]) / (n * n));
    assert_near(value(sim, MPM_NORM_RMS), sqrt(5 * R2 / n) / spread, 1e-12);
    assert_near(value(sim, MPM_NORM_L2), sqrt(2.5), 1e-12);
    assert_near(value(sim, MPM_NORM_MAX), sqrt(2.5), 1e-12);
    assert_near(value(sim, MPM_NORM_ABSOLUTE), sqrt(5 * R2 / n), 1e-12);
    assert_near(value(sim, MPM_N_NORMS + MPM_NORM_RMS),
                sqrt(error2 / n) / sqrt(size2 / n - mean * mean / (n * n)), 1e-12);
    assert_near(value(sim, MPM_N_NORMS + MPM_NORM_L2), sqrt(error2 / size2), 1e-12);
    assert_near(value(sim, MPM_N_NORMS + MPM_NORM_MAX), 2 / 15.0, 1e-12);
    assert_near(value(sim, MPM_N_NORMS + MPM_NORM_ABSOLUTE), 3 * 2, 1e-12);
    mpm_free(sim);
}

// Of a solution that stands, in the material of the last stage.
static void test_probe_error_of_a_column(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim);
        world.def.settings.gravity[1] = -10;
        world.stages[1] = world.stages[0];
        static struct mpm_material_def stiff[2];
        memcpy(stiff, world.materials, sizeof stiff);
        stiff[0].parameters[1] = 4e4;
        world.stages[1].materials = stiff;
        world.def.n_stages = 2;
        struct mpm_probe_def *q = add_probe(MPM_PROBE_ERROR, 0);
        q->field = MPM_FIELD_STRESS;
        q->component = dim + 1; // yy
        q->against.solution =
            (struct mpm_solution){.kind = MPM_SOLUTION_COLUMN, .axis = 1, .length = 0.5};
        q = add_probe(MPM_PROBE_ERROR, 0);
        q->field = MPM_FIELD_POSITION;
        q->component = 1;
        q->norm = MPM_NORM_ABSOLUTE;
        q->against.solution = world.probes[0].against.solution;
        struct mpm_sim *sim = create();
        struct mpm_particles *s = &sim->sets[0];
        const struct mpm_medium m =
            mpm_medium_of(stiff[0].model, stiff[0].parameters, world.def.settings.gravity);
        struct mpm_exact e;
        mpm_exact_create(&e, &q->against.solution, &m);
        for (size_t p = 0; p < s->n; p++) {
            struct mpm_exact_state at;
            double X[MPM_MAX_DIM] = {0};
            for (int d = 0; d < dim; d++) {
                X[d] = s->x[mpm_at(p, dim, d)];
            }
            mpm_exact_state(&e, X, X, 0, dim, &at);
            s->x[mpm_at(p, dim, 1)] += at.u[1];
            s->sigma[mpm_at(p, MPM_SYM(dim), 1)] = -1000 * 10 * (0.5 - X[1]);
        }
        assert_near(value(sim, 0), 0, 1e-12);
        assert_near(value(sim, 1), 0, 1e-15);
        mpm_free(sim);
    }
}

// The body force of a manufactured solution acts on the matter that began at a place; a uniform one
// is gravity but for the potential energy.
static void test_body_force_moves_as_gravity_does(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_balance b[2];
        double x[2];
        for (int way = 0; way < 2; way++) {
            define(dim);
            add_probe(MPM_PROBE_EXTENT, -1)->max_side = true;
            world.bodies[0].velocity = (struct mpm_velocity){.vector = {0.5, 0, 0}};
            double *g = way ? world.def.settings.gravity : world.def.body_force.vector;
            g[0] = 3, g[1] = -10;
            world.def.body_force.kind = way ? MPM_BODY_FORCE_NONE : MPM_BODY_FORCE_UNIFORM;
            struct mpm_sim *sim = create();
            struct mpm_estimate estimate;
            mpm_estimate(&world.def, &estimate);
            assert_near((double)estimate.bytes, (double)mpm_bytes(sim), 64); // whole cache lines
            for (int k = 0; k < 50; k++) {
                step(sim);
            }
            mpm_balance(sim, &b[way]);
            x[way] = value(sim, 0);
            mpm_free(sim);
        }
        assert_near(x[0], x[1], 1e-13);
        assert_near(b[0].kinetic_energy, b[1].kinetic_energy, 1e-12 * b[1].kinetic_energy);
        assert_near(b[0].external_work, b[1].external_work, 1e-11 * fabs(b[1].external_work));
        assert_near(b[0].potential_energy, 0, 0);
    }
}

// A daemon admits runs by the estimate, so it must not be short of what the smooth mean stress
// takes, nor beyond a table of all nodes in the blocks: a power of two of places that is at most
// half full, beside the half as large one that it grew from, is less than 6 places a node.
static void test_smooth_mean_stress_is_in_the_estimate(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int by_probe = 0; by_probe < 2; by_probe++) {
            define(dim);
            struct mpm_estimate without, with;
            mpm_estimate(&world.def, &without);
            struct mpm_probe_def *mean = add_probe(MPM_PROBE_MEAN, -1);
            mean->field = by_probe ? MPM_FIELD_MEAN_STRESS_SMOOTH : MPM_FIELD_MEAN_STRESS;
            world.def.wants_mean_stress_smooth = !by_probe;
            mpm_estimate(&world.def, &with);
            struct mpm_sim *sim = create();
            const size_t before = mpm_bytes(sim);
            double *field = malloc(mpm_n_particles(sim) * sizeof *field);
            assert_non_null(field);
            if (by_probe) {
                assert_true(isfinite(value(sim, 0)));
            } else {
                mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS_SMOOTH, field);
            }
            free(field);
            const size_t taken = mpm_bytes(sim) - before, told = with.bytes - without.bytes;
            assert_true(taken >= mpm_n_particles(sim) * sizeof(double));
            assert_in_range(told, taken,
                            mpm_n_particles(sim) * sizeof(double) + 6 * (with.nodes + 64) * 32);
            mpm_free(sim);
        }
    }
}

static void test_body_force_of_a_vortex_follows_its_matter(void **state) {
    (void)state;
    define(2);
    world.def.n_bodies = 1;
    world.def.body_force = (struct mpm_body_force_def){
        .kind = MPM_BODY_FORCE_SOLUTION,
        .solution = {.kind = MPM_SOLUTION_VORTEX,
                     .inner = 0.1, // about the body's corner: the sum of its forces is not 0
                     .outer = 0.4,
                     .amplitude = 0.1,
                     .period = 1}};
    struct mpm_sim *sim = create();
    for (int k = 0; k < 3; k++) { // F = ma of the whole body
        double force[2] = {0};
        struct mpm_balance before, after;
        mpm_balance(sim, &before);
        const struct mpm_particles *s = &sim->sets[0];
        const struct mpm_medium m = mpm_medium_of(s->material, s->parameters, (double[3]){0});
        for (size_t p = 0; p < s->n; p++) {
            const double X[3] = {s->x0[mpm_at(p, 2, 0)], s->x0[mpm_at(p, 2, 1)], 0};
            double b[3];
            mpm_exact_force(&world.def.body_force.solution, &m, X, mpm_time(sim), 2, b);
            force[0] += 1000 * s->V0[p] * b[0];
            force[1] += 1000 * s->V0[p] * b[1];
        }
        step(sim);
        mpm_balance(sim, &after);
        for (int d = 0; d < 2; d++) {
            assert_near(after.momentum[d] - before.momentum[d], DT * force[d], 1e-12);
            assert_true(fabs(DT * force[d]) > 1e-6);
        }
    }
    mpm_free(sim);
}

static void test_probe_folds_a_field(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim);
        const enum mpm_probe_kind kinds[] = {MPM_PROBE_MAXIMUM, MPM_PROBE_MINIMUM, MPM_PROBE_MEAN,
                                             MPM_PROBE_FIELD};
        for (int k = 0; k < 4; k++) {
            struct mpm_probe_def *q = add_probe(kinds[k], 1);
            q->field = MPM_FIELD_MEAN_STRESS;
            q->at[0] = 1 + 1.0 / 32;
            q = add_probe(kinds[k], k == 3 ? 0 : -1);
            q->field = MPM_FIELD_STRESS;
            q->scale = 1e-3;
        }
        struct mpm_probe_def *q = add_probe(MPM_PROBE_MEAN, -1); // over none
        q->field = MPM_FIELD_VELOCITY;
        q->has_box = true;
        q->box_min[0] = 2, q->box_max[0] = 3;
        q = add_probe(MPM_PROBE_MAXIMUM, -1); // of the left body's left column of cells
        q->field = MPM_FIELD_POSITION;
        q->has_box = true;
        q->box_max[0] = 0.125, q->box_max[1] = q->box_max[2] = 9;
        struct mpm_sim *sim = create();
        const int n = MPM_SYM(dim);
        for (size_t b = 0; b < 2; b++) {
            struct mpm_particles *s = &sim->sets[b];
            for (size_t p = 0; p < s->n; p++) {
                for (int k = 0; k < n; k++) { // 0 .. n - 1 times a factor of the body's
                    s->sigma[mpm_at(p, n, k)] = (b ? 3 : -1) * (double)p * (k < 3 ? 1 : k);
                }
            }
        }
        const double last = (double)sim->sets[0].n - 1;
        assert_near(value(sim, 0), 3 * last, 1e-10);
        assert_near(value(sim, 2), 0, 0);
        assert_near(value(sim, 4), 3 * last / 2, 1e-10);
        assert_near(value(sim, 6), 0, 0); // the field at particle 0
        double t[MPM_MAX_COMPONENTS];
        assert_int_equal(mpm_probe_components(sim, 1), dim * dim);
        mpm_probe_value(sim, 1, t);
        assert_near(t[0], 3e-3 * last, 1e-12);
        assert_near(t[1], 3e-3 * 3 * last, 1e-12); // xy
        assert_near(t[dim], t[1], 0);              // yx
        mpm_probe_value(sim, 3, t);
        assert_near(t[0], -1e-3 * last, 1e-12);
        mpm_probe_value(sim, 5, t);
        assert_near(t[0], 1e-3 * last / 2, 1e-12);
        assert_string_equal(mpm_probe_component_name(sim, 1, 1), "xy");
        assert_string_equal(mpm_probe_component_name(sim, 1, (size_t)(dim * dim - 1)),
                            dim == 2 ? "yy" : "zz");
        mpm_probe_value(sim, 8, t);
        assert_true(isnan(t[0]) && isnan(t[1]));
        mpm_probe_value(sim, 9, t);
        assert_near(t[0], 3.0 / 32, 1e-15);
        assert_near(t[1], 0.5 - 1.0 / 32, 1e-15);
        mpm_free(sim);
    }
}

static void test_probe_energy_and_momentum_are_the_balance(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim);
        add_probe(MPM_PROBE_ENERGY, -1);
        add_probe(MPM_PROBE_MOMENTUM, -1);
        world.bodies[0].velocity = (struct mpm_velocity){.vector = {2, 1, 3}};
        world.def.settings.gravity[1] = -10;
        struct mpm_sim *sim = create();
        const double V = pow(0.5, dim), v2 = dim == 2 ? 5 : 14;
        sim->sets[1].Jbar[0] = 1.1; // 1/2 K 0.1^2 of one particle
        double e[4], mv[3];
        assert_int_equal(mpm_probe_components(sim, 0), 4);
        mpm_probe_value(sim, 0, e);
        assert_near(e[0], 0.5 * 1000 * V * v2, 1e-10);
        assert_near(e[1], 0.5 * 1e4 * 0.01 * pow(1.0 / 16, dim), 1e-12);
        assert_near(e[2], (1000 + 500) * V * 10 * 0.25, 1e-10); // centres at half the height
        assert_near(e[3], e[0] + e[1] + e[2], 1e-10);
        const char *names[] = {"kinetic", "strain", "potential", "total"};
        for (size_t k = 0; k < 4; k++) {
            assert_string_equal(mpm_probe_component_name(sim, 0, k), names[k]);
        }
        mpm_probe_value(sim, 1, mv);
        for (int d = 0; d < dim; d++) {
            assert_near(mv[d], 1000 * V * world.bodies[0].velocity.vector[d], 1e-10);
        }
        struct mpm_balance balance;
        mpm_balance(sim, &balance);
        assert_near(balance.mass, 1500 * V, 1e-10);
        // x v_y - y v_x about the origin, of a uniform velocity: that of the centre.
        assert_near(balance.angular_momentum[2], 1000 * V * (0.25 * 1 - 0.25 * 2), 1e-10);
        if (dim == 3) {
            assert_near(balance.angular_momentum[0], 1000 * V * (0.25 * 3 - 0.25 * 1), 1e-10);
            assert_near(balance.angular_momentum[1], 1000 * V * (0.25 * 2 - 0.25 * 3), 1e-10);
        }
        assert_near(balance.external_work, 0, 0);
        mpm_free(sim);
    }
}

// Gravity's work on a falling body is what it loses in potential and gains in kinetic energy.
static void test_balance_of_work_in_free_fall(void **state) {
    (void)state;
    define(2);
    world.def.settings.gravity[1] = -10;
    struct mpm_sim *sim = create();
    struct mpm_balance first, last;
    mpm_balance(sim, &first);
    for (int k = 0; k < 200; k++) {
        step(sim);
    }
    mpm_balance(sim, &last);
    assert_near(last.external_work, first.potential_energy - last.potential_energy, 1e-9);
    // The symplectic step falls g dt t/2 further than the parabola: 1/2 g t^2 (1 + dt/t).
    assert_near(last.kinetic_energy, last.external_work / (1 + DT / 0.2), 1e-9);
    mpm_free(sim);
}

static void test_probe_drift_is_of_its_body(void **state) {
    (void)state;
    define(2);
    add_probe(MPM_PROBE_DRIFT, -1);
    add_probe(MPM_PROBE_DRIFT, 0);
    add_probe(MPM_PROBE_DRIFT, 1);
    struct mpm_sim *sim = create();
    sim->sets[0].V[3] *= 2;
    assert_non_null(sim->sets[1].J_raw); // what a fluid's drift is measured with
    sim->sets[1].J_raw[4] = 0.25;
    assert_near(value(sim, 0), log(4), 1e-15);
    assert_near(value(sim, 1), log(2), 1e-15);
    assert_near(value(sim, 2), log(4), 1e-15);
    mpm_free(sim);
}

// A quantity that grows linearly: v_x = 5 t under gravity. Its mean over the last w seconds is
// 5 (t - w/2); the sum of right-hand values adds 5 dt/2. Before a whole window: the mean so far.
static void test_probe_average_of_a_linear_quantity(void **state) {
    (void)state;
    const double windows[] = {0.05, 0.013, 0.002, 0.25};
    for (int w = 0; w < 4; w++) {
        define(2);
        world.def.settings.gravity[0] = 5;
        struct mpm_probe_def *q = add_probe(MPM_PROBE_MEAN, 0);
        q->field = MPM_FIELD_VELOCITY;
        q->average = windows[w];
        q->scale = 2;
        struct mpm_sim *sim = create();
        assert_near(value(sim, 0), 0, 0); // nothing to average yet: the present value
        for (int k = 1; k <= 400; k++) {
            step(sim);
            const double t = k * DT, length = fmin(t, windows[w]);
            // The window's start may lie between two of the points kept, w/63 or dt apart: the
            // interpolated integral is off by the second derivative 5 times their distance^2/8.
            const double apart = fmax(DT, windows[w] / 63 + DT);
            assert_near(value(sim, 0), 2 * 5 * (t - length / 2 + DT / 2),
                        2 * 5 * apart * apart / 8 / length + 1e-10);
        }
        mpm_free(sim);
    }
}

// A stage that ends early makes the clock jump; a mean of a constant must not notice.
static void test_probe_average_survives_a_jump_of_the_clock(void **state) {
    (void)state;
    define(2);
    world.def.n_stages = 2;
    world.stages[0] = (struct mpm_stage_def){
        .name = "settle", .duration = 5, .kinetic_energy_ratio = 0.5, .states = MPM_SET_DAMPING};
    world.stages[0].settings.damping_mass = 10;
    world.stages[1] = (struct mpm_stage_def){.name = "main", .duration = 1};
    world.bodies[0].velocity = (struct mpm_velocity){.vector = {0.1, 0}};
    struct mpm_probe_def *q = add_probe(MPM_PROBE_MEAN, 1);
    q->field = MPM_FIELD_DENSITY; // 500 in the body at rest
    q->average = 0.02;
    struct mpm_sim *sim = create();
    while (mpm_step_count(sim) < 200) {
        step(sim);
        assert_near(value(sim, 0), 500, 1e-8);
    }
    assert_int_equal(mpm_stage(sim), 1);
    mpm_free(sim);
}

static void test_fields_describe_themselves(void **state) {
    (void)state;
    define(3);
    struct mpm_sim *sim = create();
    for (int f = 0; f < MPM_N_FIELDS; f++) {
        const struct mpm_field_info *info = mpm_field_info((enum mpm_field)f);
        assert_int_equal(mpm_field_parse(info->name), f);
        assert_true(strlen(info->unit) > 0 && strlen(info->doc) > 0);
        const size_t width = mpm_field_components((enum mpm_field)f, 3);
        assert_int_equal(width, info->shape == MPM_SCALAR ? 1 : info->shape == MPM_VECTOR ? 3 : 9);
        assert_true(width <= MPM_MAX_COMPONENTS);
    }
    assert_int_equal(mpm_field_parse("charm"), -1);
    assert_false(mpm_field_present(sim, MPM_FIELD_DISPLACEMENT)); // nobody asked
    assert_false(mpm_field_present(sim, MPM_FIELD_PLASTIC_STRAIN));
    mpm_free(sim);
    world.def.wants_displacement = true;
    sim = create();
    assert_true(mpm_field_present(sim, MPM_FIELD_DISPLACEMENT));
    mpm_free(sim);
}

// Values of derived fields, from a stress whose invariants are known; ids and bodies in order.
static void test_fields_have_their_values(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim);
        struct mpm_sim *sim = create();
        const size_t n = mpm_n_particles(sim), half = n / 2;
        struct mpm_particles *s = &sim->sets[1];
        for (size_t p = 0; p < s->n; p++) {
            const double sigma[] = {7, 1, 1, 2, 0, 0}; // deviator 4, -2, -2, shear 2
            for (int k = 0; k < MPM_SYM(dim); k++) {
                s->sigma[mpm_at(p, MPM_SYM(dim), k)] = sigma[k];
            }
            s->V[p] = 0.8 * s->V0[p];
        }
        double *out = calloc(n * 9, sizeof *out);
        mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS, out);
        assert_near(out[0], 0, 0), assert_near(out[n - 1], 3, 1e-15);
        mpm_field_copy(sim, MPM_FIELD_VON_MISES, out);
        assert_near(out[n - 1], sqrt(1.5 * (16 + 4 + 4 + 2 * 4)), 1e-14);
        mpm_field_copy(sim, MPM_FIELD_VOLUME_RATIO, out);
        assert_near(out[0], 1, 0), assert_near(out[n - 1], 0.8, 1e-15);
        mpm_field_copy(sim, MPM_FIELD_VOLUME_RATIO_BAR, out);
        assert_near(out[n - 1], 1, 0);
        mpm_field_copy(sim, MPM_FIELD_DENSITY, out);
        assert_near(out[0], 1000, 0), assert_near(out[n - 1], 500 / 0.8, 1e-12);
        mpm_field_copy(sim, MPM_FIELD_STRESS, out);
        assert_near(out[(n - 1) * (size_t)(dim * dim) + 1], 2, 0);
        uint32_t *id = (uint32_t *)out;
        mpm_field_copy(sim, MPM_FIELD_ID, id);
        for (size_t p = 0; p < n; p++) {
            assert_int_equal(id[p], p);
        }
        mpm_field_copy(sim, MPM_FIELD_BODY, id);
        assert_int_equal(id[half - 1], 0), assert_int_equal(id[half], 1);
        free(out);
        mpm_free(sim);
    }
}

// The weights of docs/method.md, section 5, as functions of the distance from the node in cells.
static double hat_of(enum mpm_basis basis, double r) {
    const double l = 0.25; // uGIMP: half a particle, two in each direction
    r = fabs(r);
    switch (basis) {
    case MPM_LINEAR:
        return fmax(0, 1 - r);
    case MPM_GIMP:
        return r < l       ? 1 - (r * r + l * l) / (2 * l)
               : r < 1 - l ? 1 - r
               : r < 1 + l ? (1 + l - r) * (1 + l - r) / (4 * l)
                           : 0;
    case MPM_BSPLINE2:
        return r < 0.5 ? 0.75 - r * r : r < 1.5 ? 0.5 * (1.5 - r) * (1.5 - r) : 0;
    default:
        return r < 1 ? 2.0 / 3 - r * r + 0.5 * r * r * r : r < 2 ? pow(2 - r, 3) / 6 : 0;
    }
}

static double weight_of(const struct mpm_sim *sim, const struct mpm_particles *s, size_t p,
                        const int *node) {
    double w = 1;
    for (int d = 0; d < s->dim; d++) {
        w *= hat_of(sim->def->basis,
                    (s->x[mpm_at(p, s->dim, d)] - sim->grid.origin[d]) * sim->grid.inv_h - node[d]);
    }
    return w;
}

// The average by its formula, from all particles of a body at every node around one of them.
static double smooth_of(const struct mpm_sim *sim, const struct mpm_particles *s, size_t p) {
    double sum = 0;
    int base[3] = {0}, node[3] = {0};
    for (int d = 0; d < s->dim; d++) {
        base[d] =
            (int)floor((s->x[mpm_at(p, s->dim, d)] - sim->grid.origin[d]) * sim->grid.inv_h) - 2;
    }
    for (int k = 0; k < (s->dim == 3 ? 216 : 36); k++) {
        double V = 0, V_p = 0;
        node[0] = base[0] + k % 6, node[1] = base[1] + k / 6 % 6, node[2] = base[2] + k / 36;
        const double w = weight_of(sim, s, p, node);
        for (size_t q = 0; w > 0 && q < s->n; q++) {
            V += weight_of(sim, s, q, node) * s->V[q];
            V_p += weight_of(sim, s, q, node) * s->V[q] * mpm_mean_stress(s, q);
        }
        sum += w > 0 ? w * V_p / V : 0;
    }
    return sum;
}

static void test_smooth_mean_stress_is_the_average_over_the_grid(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            define(dim);
            world.def.basis = (enum mpm_basis)basis;
            struct mpm_probe_def *q = add_probe(MPM_PROBE_MAXIMUM, 1);
            q->field = MPM_FIELD_MEAN_STRESS_SMOOTH;
            struct mpm_sim *sim = create();
            assert_int_equal(mpm_smooth_bytes(sim->smooth), 0); // nobody has asked yet
            struct mpm_particles *s = &sim->sets[0];
            uint32_t random = 7;
            for (size_t p = 0; p < s->n; p++) { // scattered, one of them far out, and unequal
                for (int d = 0; d < dim; d++) {
                    random = random * 1664525u + 1013904223u;
                    s->x[mpm_at(p, dim, d)] = p == 5 ? 2.7 : 0.5 * random / 4294967296.0;
                }
                random = random * 1664525u + 1013904223u;
                s->V[p] *= 0.5 + random / 4294967296.0;
                for (int k = 0; k < 3; k++) {
                    s->sigma[mpm_at(p, MPM_SYM(dim), k)] = 1000 * sin((double)p);
                }
            }
            for (size_t p = 0; p < sim->sets[1].n; p++) { // a body of its own, with one stress
                for (int k = 0; k < 3; k++) {
                    sim->sets[1].sigma[mpm_at(p, MPM_SYM(dim), k)] = -200;
                }
            }
            double *out = calloc(sim->n_particles, sizeof *out);
            mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS_SMOOTH, out);
            for (size_t p = 0; p < s->n; p++) {
                assert_near(out[mpm_particle_id(s, p)], smooth_of(sim, s, p), 1e-10); // of 1000
            }
            for (size_t k = s->n; k < sim->n_particles; k++) {
                assert_near(out[k], -200, 1e-11); // weights sum to 1
            }
            assert_near(value(sim, 0), -200, 1e-11);
            free(out);
            mpm_free(sim);
        }
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_probe_extent_is_the_outermost_particle),
        cmocka_unit_test(test_probe_extent_takes_a_quantile),
        cmocka_unit_test(test_probe_displacement_follows_its_particle),
        cmocka_unit_test(test_probe_selects_as_a_load_does),
        cmocka_unit_test(test_probe_error_by_every_norm),
        cmocka_unit_test(test_probe_error_of_a_column),
        cmocka_unit_test(test_body_force_moves_as_gravity_does),
        cmocka_unit_test(test_smooth_mean_stress_is_in_the_estimate),
        cmocka_unit_test(test_body_force_of_a_vortex_follows_its_matter),
        cmocka_unit_test(test_probe_folds_a_field),
        cmocka_unit_test(test_probe_energy_and_momentum_are_the_balance),
        cmocka_unit_test(test_balance_of_work_in_free_fall),
        cmocka_unit_test(test_probe_drift_is_of_its_body),
        cmocka_unit_test(test_probe_average_of_a_linear_quantity),
        cmocka_unit_test(test_probe_average_survives_a_jump_of_the_clock),
        cmocka_unit_test(test_fields_describe_themselves),
        cmocka_unit_test(test_fields_have_their_values),
        cmocka_unit_test(test_smooth_mean_stress_is_the_average_over_the_grid),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
