// Loads: which particles they choose, with what force, and that they follow them.
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
#include "tests/unit/nodes.h"

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

#define H 0.125
#define DT 1e-3
#define FOR_KERNELS(dim, basis)                                                                    \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int basis = 0; basis < MPM_N_BASES; basis++)

// A block of rubber and another one away from it, in a box of 2 m; one problem at a time.
static struct {
    struct mpm_def def;
    struct mpm_material_def material;
    struct mpm_body_def bodies[2];
    struct mpm_stage_def stages[2];
    struct mpm_load_def loads[2];
    bool removes[2];
} world;

#define LOW 0.75
#define HIGH 1.25

static void define(int dim, int basis) {
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.material = (struct mpm_material_def){.name = "rubber",
                                               .model = mpm_material_find("neo_hookean"),
                                               .parameters = {1000, 1e5, 0.3},
                                               .fbar = true};
    for (int k = 0; k < 2; k++) {
        world.bodies[k] = (struct mpm_body_def){.name = "block", .particles_per_direction = 2};
        world.stages[k] = (struct mpm_stage_def){.name = "stage", .duration = 0.05};
        world.loads[k] = (struct mpm_load_def){.name = k ? "second" : "push"};
    }
    for (int d = 0; d < 3; d++) {
        world.bodies[0].shape.min[d] = LOW;
        world.bodies[0].shape.max[d] = HIGH;
        world.bodies[1].shape.min[d] = 0.125;
        world.bodies[1].shape.max[d] = 0.25;
        world.def.domain_max[d] = 2;
    }
    world.def.dimension = dim;
    world.def.basis = (enum mpm_basis)basis;
    world.def.cell = H;
    world.def.settings.dt = DT;
    world.def.n_materials = world.def.n_bodies = world.def.n_stages = world.def.n_loads = 1;
    world.def.materials = &world.material;
    world.def.bodies = world.bodies;
    world.def.stages = world.stages;
    world.def.loads = world.loads;
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

// The force in all, after an update for time t.
static void total(struct mpm_sim *sim, double t, double *F) {
    struct mpm_load *load = &sim->loads[0];
    const struct mpm_particles *s = &sim->sets[load->def.body];
    mpm_load_update(load, s, t);
    memset(F, 0, 3 * sizeof *F);
    for (size_t k = 0; k < load->n; k++) {
        for (int d = 0; d < s->dim; d++) {
            F[d] += load->force[k * (size_t)s->dim + (size_t)d];
        }
    }
}

// One layer of 8 (2D) or 64 (3D) particles on each of the sides, and none that is not on it.
static void test_load_chooses_the_outermost_layer(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int side = 0; side < 2 * dim; side++) {
            define(dim, MPM_GIMP);
            world.loads[0].axis = side / 2;
            world.loads[0].max_side = side % 2;
            world.loads[0].force[0] = 1;
            struct mpm_sim *sim = create();
            const struct mpm_load *load = &sim->loads[0];
            assert_int_equal(load->n, dim == 2 ? 8 : 64);
            for (size_t k = 0; k < load->n; k++) {
                const double x = sim->sets[0].x[mpm_at(
                    mpm_place_of(&sim->sets[load->def.body], load->particle[k]), dim, side / 2)];
                assert_near(x, side % 2 ? HIGH - H / 4 : LOW + H / 4, 1e-15);
                assert_true(k == 0 || load->particle[k] > load->particle[k - 1]);
            }
            mpm_free(sim);
        }
    }
}

static void test_load_chooses_a_box(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim, MPM_GIMP);
        world.loads[0].has_box = true;
        for (int d = 0; d < 3; d++) { // 3 lattice points a direction; edges belong to it
            world.loads[0].box_min[d] = LOW + H / 4;
            world.loads[0].box_max[d] = LOW + 5 * H / 4;
        }
        world.loads[0].force[1] = 9;
        struct mpm_sim *sim = create();
        assert_int_equal(sim->loads[0].n, dim == 2 ? 9 : 27);
        double F[3];
        total(sim, 0, F);
        assert_near(F[1], 9, 1e-14);
        mpm_free(sim);
        // The body is chosen too: the other one has nothing in this box.
        world.def.n_bodies = 2;
        world.loads[0].body = 1;
        struct mpm_error err = {0};
        assert_int_equal(mpm_create(&world.def, &sim, &err), MPM_ERR_EMPTY);
        assert_string_equal(err.pointer, "/loads/push/select");
        assert_null(sim);
    }
}

// The forces on the particles, and the momentum that they bring in a step by way of the nodes, sum
// to the force given.
static void test_load_total_is_the_given_force(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        define(dim, basis);
        world.loads[0].max_side = true;
        const double given[3] = {3, -5, 7};
        memcpy(world.loads[0].force, given, sizeof given);
        struct mpm_sim *sim = create();
        double F[3], nodes[3] = {0};
        total(sim, 0, F);
        step(sim); // from rest: no force but the load's
        for (size_t b = 0; b < sim->n_sets; b++) {
            const struct mpm_particles *s = &sim->sets[b];
            for (size_t p = 0; p < s->n; p++) {
                for (int d = 0; d < dim; d++) {
                    nodes[d] += s->density * s->V0[p] * s->v[mpm_at(p, dim, d)] / DT;
                }
            }
        }
        for (int d = 0; d < dim; d++) {
            assert_near(F[d], given[d], 1e-14 * 64);
            assert_near(nodes[d], given[d], 1e-14 * 64);
        }
        mpm_free(sim);
    }
}

static void test_load_ramps_up_from_the_first_step(void **state) {
    (void)state;
    define(2, MPM_GIMP);
    world.loads[0].ramp = 0.08;
    world.loads[0].force[0] = 10;
    world.def.n_stages = 2; // the ramp reaches over the stages: 0.05 s of it lie before t = 0
    struct mpm_sim *sim = create();
    const double mass = 1000 * 0.25;
    double impulse = 0;
    for (int k = 0; k < 100; k++) {
        double F[3];
        total(sim, k * DT, F);
        assert_near(F[0], 10 * fmin(1, k * DT / 0.08), 1e-13);
        impulse += DT * F[0];
        step(sim);
        struct mpm_balance b;
        mpm_balance(sim, &b);
        assert_near(b.momentum[0], impulse, 1e-13 * mass); // round-off of 100 steps
    }
    assert_int_equal(mpm_stage(sim), 1);
    mpm_free(sim);
}

// A free body gains just what the force gives it, wherever it goes: 2.5 cells here.
static void test_load_follows_its_particles(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            if (dim == 3 && (scheme == MPM_FBAR_ZHAO || basis == MPM_LINEAR)) {
                continue;
            }
            define(dim, basis);
            world.stages[0].duration = dim == 2 ? 0.25 : 0.05;
            world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
            const double given[3] = {600, -300, 200};
            memcpy(world.loads[0].force, given, sizeof given);
            for (int d = 0; d < dim; d++) {
                world.bodies[0].velocity.vector[d] = given[d] / 600;
            }
            world.loads[0].max_side = true;
            struct mpm_sim *sim = create();
            struct mpm_balance first, b;
            mpm_balance(sim, &first);
            const size_t followed = sim->loads[0].particle[0];
            while (!mpm_finished(sim)) {
                step(sim);
            }
            mpm_balance(sim, &b);
            assert_int_equal(sim->loads[0].particle[0], followed);
            for (int d = 0; d < dim; d++) {
                assert_near(b.momentum[d] - first.momentum[d], given[d] * world.stages[0].duration,
                            1e-12 * first.mass); // 250 steps of round-off
            }
            mpm_free(sim);
        }
    }
}

// On a flat side a pressure's force is p times the side, onto the body.
static void test_load_pressure_on_a_side(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int side = 0; side < 2 * dim; side++) {
            define(dim, MPM_GIMP);
            world.loads[0] = (struct mpm_load_def){.name = "push",
                                                   .axis = side / 2,
                                                   .max_side = side % 2,
                                                   .is_pressure = true,
                                                   .pressure = 100};
            struct mpm_sim *sim = create();
            double F[3];
            total(sim, 0, F);
            const double area = pow(HIGH - LOW, dim - 1);
            for (int d = 0; d < dim; d++) {
                const double expected = d != side / 2 ? 0 : side % 2 ? -100 * area : 100 * area;
                assert_near(F[d], expected, 1e-13 * 64);
            }
            mpm_free(sim);
        }
    }
}

// A ring of inner radius a and outer radius b about the centre, or the quarter of it at x, y > 0;
// in 3D a tube along `axis`, 0.25 m long.
static struct mpm_shape parts[4], cut[2];
static const double tube_centre[3] = {1, 1, 1};
static void define_ring(int dim, int axis, int n, bool quarter, bool outer, double a, double b) {
    define(dim, MPM_GIMP);
    for (int k = 0; k < 2; k++) {
        parts[k] = (struct mpm_shape){.kind = dim == 2 ? MPM_SHAPE_BALL : MPM_SHAPE_CYLINDER,
                                      .radius = k ? a : b};
        for (int d = 0; d < 3; d++) {
            parts[k].centre[d] = parts[k].min[d] = parts[k].max[d] = tube_centre[d];
        }
        parts[k].min[axis] -= k ? 1 : 0.125;
        parts[k].max[axis] += k ? 1 : 0.125;
    }
    cut[0] = (struct mpm_shape){.kind = MPM_SHAPE_DIFFERENCE, .n_children = 2, .children = parts};
    cut[1] = (struct mpm_shape){.kind = MPM_SHAPE_BOX, .max = {2, 2, 2}};
    for (int d = 0; quarter && d < dim; d++) {
        cut[1].min[d] = dim == 3 && d == axis ? 0 : 1;
    }
    world.bodies[0].shape =
        (struct mpm_shape){.kind = MPM_SHAPE_INTERSECTION, .n_children = 2, .children = cut};
    world.bodies[0].particles_per_direction = n;
    world.loads[0] = (struct mpm_load_def){.name = "push",
                                           .round = true,
                                           .max_side = outer,
                                           .axis = dim == 2 ? 0 : axis,
                                           .is_pressure = true,
                                           .pressure = 100};
    memcpy(world.loads[0].centre, tube_centre, sizeof tube_centre);
}

// A whole ring is in balance, and every force is along its radius, outwards from the inner surface
// and inwards from the outer one; their sizes sum to p times the circumference.
static void test_load_pressure_in_a_ring(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int axis = dim == 2 ? 2 : 0; axis < 3; axis++) {
            for (int outer = 0; outer < 2; outer++) {
                define_ring(dim, axis, 4, false, outer, 0.4, 0.8);
                struct mpm_sim *sim = create();
                double F[3], size = 0;
                total(sim, 0, F);
                for (int d = 0; d < dim; d++) {
                    assert_near(F[d], 0, 1e-11);
                }
                const struct mpm_load *load = &sim->loads[0];
                for (size_t k = 0; k < load->n; k++) {
                    double dot = 0, r2 = 0, f2 = 0;
                    for (int d = 0; d < dim; d++) {
                        const double r =
                            sim->sets[0].x[mpm_at(
                                mpm_place_of(&sim->sets[load->def.body], load->particle[k]), dim,
                                d)] -
                            1;
                        const double f = load->force[k * (size_t)dim + (size_t)d];
                        dot += d == axis && dim == 3 ? 0 : r * f;
                        r2 += d == axis && dim == 3 ? 0 : r * r;
                        f2 += f * f;
                    }
                    assert_near(dot, (outer ? -1 : 1) * sqrt(r2 * f2), 1e-13);
                    size += sqrt(f2);
                }
                // The mean radius of a layer is known to O(spacing/radius), here 1/13 and 1/26.
                const double radius = outer ? 0.8 : 0.4, length = dim == 2 ? 1 : 0.25;
                assert_near(size / (100 * 2 * M_PI * radius * length), 1, H / 4 / radius / 4);
                mpm_free(sim);
            }
        }
    }
}

// A quarter of a ring: p a in x and in y, to O(spacing/a): a seventh of it at most.
static void test_load_pressure_in_a_quarter_ring(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int outer = 0; outer < 2; outer++) {
            const double radius = outer ? 0.8 : 0.4;
            double worst = 0;
            for (int n = 2; n <= (dim == 2 ? 16 : 8); n *= 2) {
                define_ring(dim, 2, n, true, outer, 0.4, 0.8);
                struct mpm_sim *sim = create();
                double F[3];
                total(sim, 0, F);
                const double expected = (outer ? -100 : 100) * radius * (dim == 2 ? 1 : 0.25);
                assert_near(F[0], F[1], 1e-11);
                worst = fabs(F[0] / expected - 1);
                assert_true(worst < H / n / radius / 7);
                mpm_free(sim);
            }
            assert_true(worst < 0.002);
        }
    }
}

// The pressure's direction goes with the particle: about the centre, whatever way it has gone. Its
// area is that of the surface as it has widened.
static void test_load_pressure_turns_with_its_particles(void **state) {
    (void)state;
    define_ring(2, 2, 2, true, false, 0.4, 0.8);
    struct mpm_sim *sim = create();
    struct mpm_particles *s = &sim->sets[0];
    double before[3], after[3];
    total(sim, 0, before);
    for (size_t p = 0; p < s->n; p++) { // a quarter turn about the centre
        const double x = s->x[mpm_at(p, 2, 0)] - 1, y = s->x[mpm_at(p, 2, 1)] - 1;
        s->x[mpm_at(p, 2, 0)] = 1 - y;
        s->x[mpm_at(p, 2, 1)] = 1 + x;
    }
    total(sim, 0, after);
    assert_near(after[0], -before[1], 1e-12);
    assert_near(after[1], before[0], 1e-12);
    for (size_t p = 0; p < s->n; p++) {
        for (int d = 0; d < 2; d++) {
            s->x[mpm_at(p, 2, d)] = 1 + 1.5 * (s->x[mpm_at(p, 2, d)] - 1);
        }
    }
    total(sim, 0, after);
    assert_near(after[0], -1.5 * before[1], 1e-12);
    assert_near(after[1], 1.5 * before[0], 1e-12);
    mpm_free(sim);
}

// Work of a force on a free body is what it gains in kinetic and strain energy; the swing of the
// symplectic step is w dt/2 of the strain energy, and FLIP loses some. With a soft push: 1 %.
static void test_load_work_is_external_work(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        if (dim == 3 && basis != MPM_GIMP) {
            continue;
        }
        define(dim, basis);
        world.stages[0].duration = 0.4;
        world.loads[0].force[0] = dim == 2 ? 250 : 125; // 1 m/s^2
        world.loads[0].ramp = 0.1;
        struct mpm_sim *sim = create();
        struct mpm_balance b;
        while (!mpm_finished(sim)) {
            step(sim);
        }
        mpm_balance(sim, &b);
        assert_true(b.external_work > 10 * (dim == 2 ? 1 : 0.5)); // m v^2/2 of 0.35 m/s
        assert_near((b.kinetic_energy + b.strain_energy) / b.external_work, 1, 0.01);
        mpm_free(sim);
    }
}

static void test_load_is_removed_in_a_stage(void **state) {
    (void)state;
    FOR_KERNELS(dim, basis) {
        define(dim, basis);
        world.def.n_loads = world.def.n_stages = 2;
        for (int k = 0; k < 2; k++) {
            world.loads[k].force[k] = 100;
        }
        world.removes[0] = true;
        world.stages[1].removes_load = world.removes;
        struct mpm_sim *sim = create();
        while (!mpm_finished(sim)) {
            step(sim);
        }
        struct mpm_balance b;
        mpm_balance(sim, &b);
        assert_near(b.momentum[0], 100 * 0.05, 1e-12 * b.mass);
        assert_near(b.momentum[1], 100 * 0.1, 1e-12 * b.mass);
        assert_false(sim->loads[0].active);
        assert_true(sim->loads[1].active);
        mpm_free(sim);
    }
}

// Saved while a load pushes and another has been removed; the same bits after it.
static void test_load_is_part_of_the_state(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim, MPM_BSPLINE2);
        world.def.n_loads = world.def.n_stages = 2;
        world.loads[0].force[1] = 300;
        world.loads[1] = (struct mpm_load_def){
            .name = "second", .is_pressure = true, .pressure = 500, .axis = 1, .ramp = 0.09};
        world.removes[0] = true;
        world.stages[1].removes_load = world.removes;
        struct mpm_sim *whole = create(), *second = create();
        for (int k = 0; k < 70; k++) {
            step(whole);
        }
        const size_t bytes = mpm_state_bytes(whole);
        void *saved = malloc(bytes);
        mpm_state_save(whole, saved);
        assert_int_equal(mpm_state_load(second, saved, bytes, NULL), MPM_OK);
        free(saved);
        assert_false(second->loads[0].active);
        for (int k = 0; k < 30; k++) {
            step(whole);
            step(second);
        }
        assert_memory_equal(whole->sets[0].memory, second->sets[0].memory,
                            whole->sets[0].memory_bytes);
        assert_true(whole->c.external_work == second->c.external_work);
        mpm_free(whole);
        mpm_free(second);
    }
}

// The force on the reaction: pressed on a fixed wall, the wall bears it all once it rests.
static void test_load_is_borne_by_a_wall(void **state) {
    (void)state;
    for (int basis = MPM_GIMP; basis < MPM_N_BASES; basis++) {
        define(2, basis);
        struct mpm_wall_def wall = {
            .name = "floor", .axis = 1, .at = LOW, .keeps_above = true, .condition = MPM_WALL_SLIP};
        struct mpm_probe_def probe = {
            .name = "load", .kind = MPM_PROBE_REACTION, .body = -1, .scale = 1};
        world.def.n_walls = world.def.n_probes = 1;
        world.def.walls = &wall;
        world.def.probes = &probe;
        world.loads[0] = (struct mpm_load_def){
            .name = "push", .is_pressure = true, .pressure = 1000, .axis = 1, .max_side = true};
        world.def.settings.damping_local = 0.5;
        world.stages[0].duration = 2;
        struct mpm_sim *sim = create();
        while (!mpm_finished(sim)) {
            step(sim);
        }
        double reaction[3];
        mpm_probe_value(sim, 0, reaction);
        // The force on the body or that on the wall, by the probe's sign: p times 0.5 m.
        assert_near(fabs(reaction[1]), 1000 * (HIGH - LOW), 1);
        double stress[64];
        mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS, stress);
        assert_true(stress[27] < 0); // in the middle
        mpm_free(sim);
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_load_chooses_the_outermost_layer),
        cmocka_unit_test(test_load_chooses_a_box),
        cmocka_unit_test(test_load_total_is_the_given_force),
        cmocka_unit_test(test_load_ramps_up_from_the_first_step),
        cmocka_unit_test(test_load_follows_its_particles),
        cmocka_unit_test(test_load_pressure_on_a_side),
        cmocka_unit_test(test_load_pressure_in_a_ring),
        cmocka_unit_test(test_load_pressure_in_a_quarter_ring),
        cmocka_unit_test(test_load_pressure_turns_with_its_particles),
        cmocka_unit_test(test_load_work_is_external_work),
        cmocka_unit_test(test_load_is_removed_in_a_stage),
        cmocka_unit_test(test_load_is_part_of_the_state),
        cmocka_unit_test(test_load_is_borne_by_a_wall),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
