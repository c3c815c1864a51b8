// Wall conditions: what holds on the plane, what is left alone, and the force that the wall takes.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/basis.h"
#include "server/mpm/sim.h"
#include "tests/unit/nodes.h"

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

static uint64_t seed;
static double uniform(void) { // in [-1, 1)
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 4503599627370496.0 - 1;
}

#define H 0.125
#define DT 5e-4
#define MAX_WALLS 6

// A block (rubber or water) in a box of 1 m, walls as a test adds them; one problem at a time.
static struct {
    struct mpm_def def;
    struct mpm_material_def material;
    struct mpm_body_def bodies[2];
    struct mpm_stage_def stage;
    struct mpm_wall_def walls[MAX_WALLS];
    struct mpm_probe_def probes[MAX_WALLS]; // the reaction of each wall
} world;

static void define(int dim, int basis, bool fluid) {
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.material = fluid ? (struct mpm_material_def){.name = "water",
                                                       .model = mpm_material_find("newtonian"),
                                                       .parameters = {1000, 1e5, 1}}
                           : (struct mpm_material_def){.name = "rubber",
                                                       .model = mpm_material_find("neo_hookean"),
                                                       .parameters = {1000, 1e5, 0.3}};
    world.material.fbar = true;
    for (int b = 0; b < 2; b++) {
        world.bodies[b] =
            (struct mpm_body_def){.name = b ? "other" : "block", .particles_per_direction = 2};
        for (int d = 0; d < 3; d++) {
            world.bodies[b].shape.max[d] = 0.5;
            world.def.domain_max[d] = 1;
        }
    }
    world.stage = (struct mpm_stage_def){.name = "main", .duration = 10};
    world.def.dimension = dim;
    world.def.basis = (enum mpm_basis)basis;
    world.def.cell = H;
    world.def.settings.dt = DT;
    world.def.n_materials = world.def.n_bodies = world.def.n_stages = 1;
    world.def.materials = &world.material;
    world.def.bodies = world.bodies;
    world.def.stages = &world.stage;
    world.def.walls = world.walls;
    world.def.probes = world.probes;
}

static struct mpm_wall_def *add_wall(int axis, double at, bool keeps_above,
                                     enum mpm_wall_condition condition) {
    const size_t k = world.def.n_walls++;
    world.def.n_probes = world.def.n_walls;
    world.walls[k] = (struct mpm_wall_def){
        .name = "wall", .axis = axis, .at = at, .keeps_above = keeps_above, .condition = condition};
    world.probes[k] = (struct mpm_probe_def){
        .name = "reaction", .kind = MPM_PROBE_REACTION, .body = -1, .wall = (int)k, .scale = 1};
    return &world.walls[k];
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

static bool folds(int basis) {
    return basis == MPM_BSPLINE2 || basis == MPM_BSPLINE3;
}

// Velocity that the basis gives at a point, from the last step's nodes.
static void velocity_at(const struct mpm_sim *sim, const double *x, double *v) {
    const struct mpm_grid *g = &sim->grid;
    const int reach = mpm_support(sim->def->basis);
    double w[2][MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT];
    int base[2];
    for (int d = 0; d < 2; d++) {
        base[d] =
            (int)mpm_weights(sim->def->basis, (x[d] - g->origin[d]) / g->h, 0.25, 1, w[d], dw);
        v[d] = 0;
    }
    for (int i = 0; i < reach; i++) {
        for (int j = 0; j < reach; j++) {
            const size_t node = mpm_node_at(g, (int[]){base[0] + i, base[1] + j, 0});
            for (int d = 0; d < 2; d++) {
                v[d] += w[0][i] * w[1][j] * g->velocity[node * 4 + (size_t)d];
            }
        }
    }
}

// Water thrown into a corner. B-splines: the velocity field itself has no component through the
// wall, anywhere on it. Others, and B-splines that are told so: all nodes on and behind it have
// none.
static void test_boundary_normal_velocity_vanishes(void **state) {
    (void)state;
    for (int way = 0; way < 2 * MPM_N_BASES; way++) {
        const int basis = way / 2;
        const bool mirrors = folds(basis) && way % 2 == 0;
        for (int condition = MPM_WALL_FIXED; condition <= MPM_WALL_SLIP; condition++) {
            define(2, basis, true);
            world.def.walls_hold_nodes = !mirrors;
            add_wall(0, 0, true, (enum mpm_wall_condition)condition);
            add_wall(1, 0, true, (enum mpm_wall_condition)condition);
            world.bodies[0].velocity = (struct mpm_velocity){.vector = {-0.3, -0.5}};
            struct mpm_sim *sim = create();
            const struct mpm_grid *g = &sim->grid;
            for (int k = 0; k < 50; k++) {
                step(sim);
                for (int i = 0; i < 40 && mirrors; i++) {
                    for (int axis = 0; axis < 2; axis++) {
                        double x[2] = {0, 0}, v[2];
                        x[1 - axis] = 0.5 * i / 40;
                        velocity_at(sim, x, v);
                        assert_near(v[axis], 0, 1e-16); // opposite terms of at most 0.5 / 6
                        if (condition == MPM_WALL_FIXED) {
                            assert_near(v[1 - axis], 0, 1e-16);
                        }
                    }
                }
                FOR_NODES(g, n) {
                    const double *v = g->velocity + 4 * n;
                    int place[MPM_MAX_DIM];
                    node_place(g, n, place);
                    const int i = place[0], j = place[1];
                    if (!mirrors) {
                        assert_true(i > MPM_PAD || v[0] == 0);
                        assert_true(j > MPM_PAD || v[1] == 0);
                        if (condition == MPM_WALL_FIXED && (i <= MPM_PAD || j <= MPM_PAD)) {
                            assert_true(v[0] == 0 && v[1] == 0);
                        }
                    }
                }
            }
            mpm_free(sim);
        }
    }
}

// Sliding along a slip wall, nothing happens.
static void test_boundary_slip_keeps_tangential_velocity(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            define(dim, basis, false);
            add_wall(1, 0, true, MPM_WALL_SLIP);
            world.bodies[0].velocity = (struct mpm_velocity){.vector = {1, 0, 0.5}};
            struct mpm_sim *sim = create();
            for (int k = 0; k < 200; k++) {
                step(sim);
            }
            const struct mpm_particles *s = &sim->sets[0];
            for (size_t p = 0; p < s->n; p++) { // round-off of 200 steps
                assert_near(s->v[mpm_at(p, dim, 0)], 1, 1e-12);
                assert_near(s->v[mpm_at(p, dim, 1)], 0, 1e-12);
                if (dim == 3) {
                    assert_near(s->v[mpm_at(p, dim, 2)], 0.5, 1e-12);
                }
            }
            mpm_free(sim);
        }
    }
}

static void test_boundary_fixed_holds_back(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        define(2, basis, false);
        add_wall(1, 0, true, MPM_WALL_FIXED);
        world.bodies[0].velocity = (struct mpm_velocity){.vector = {1, 0}};
        struct mpm_sim *sim = create();
        step(sim);
        double reaction[2];
        mpm_probe_value(sim, 0, reaction);
        assert_true(reaction[0] > 0); // the wall is dragged along
        struct mpm_balance balance;
        mpm_balance(sim, &balance);
        assert_near(balance.momentum[0], balance.mass - reaction[0] * DT, 1e-12 * balance.mass);
        mpm_free(sim);
    }
}

// `separate` lets a body go with all its momentum, where `slip` holds it...
static void test_boundary_separate_lets_go(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        for (int axis = 0; axis < 2; axis++) {
            for (int above = 0; above < 2; above++) {
                for (int c = MPM_WALL_SLIP; c <= MPM_WALL_SEPARATE; c++) {
                    define(2, basis, false);
                    add_wall(axis, above ? 0.25 : 0.75, above, (enum mpm_wall_condition)c);
                    for (int d = 0; d < 2; d++) {
                        world.bodies[0].shape.min[d] = 0.25;
                        world.bodies[0].shape.max[d] = 0.75;
                    }
                    world.bodies[0].velocity.vector[axis] = above ? 0.5 : -0.5;
                    struct mpm_sim *sim = create();
                    for (int k = 0; k < 100; k++) {
                        step(sim);
                    }
                    struct mpm_balance balance;
                    mpm_balance(sim, &balance);
                    const double kept =
                        balance.momentum[axis] / (above ? 0.5 : -0.5) / balance.mass;
                    if (c == MPM_WALL_SEPARATE) {
                        assert_near(kept, 1, 1e-12);
                    } else {
                        assert_true(kept < 0.9);
                    }
                    mpm_free(sim);
                }
            }
        }
    }
}

// ...and lets nothing in: a block thrown at it turns round, and none of it gets through.
static void test_boundary_separate_lets_nothing_in(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        for (int fluid = 0; fluid < 2; fluid++) {
            define(2, basis, fluid);
            add_wall(1, 0.25, true, MPM_WALL_SEPARATE);
            world.bodies[0].shape = (struct mpm_shape){.min = {0.25, 0.375}, .max = {0.75, 0.75}};
            world.bodies[0].velocity.vector[1] = -1;
            world.def.domain_min[0] = -1;
            world.def.domain_max[0] = 2;
            struct mpm_sim *sim = create();
            double lowest = 1;
            for (int k = 0; k < 600; k++) {
                step(sim);
                for (size_t p = 0; p < sim->sets[0].n; p++) {
                    lowest = fmin(lowest, sim->sets[0].x[mpm_at(p, 2, 1)]);
                }
            }
            // Half a particle (1/4 cell) is the leak that sim.c allows for direct conditions.
            assert_true(lowest > 0.25 - 0.25 * H);
            struct mpm_balance balance;
            mpm_balance(sim, &balance);
            if (!fluid) { // rubber bounces
                assert_true(balance.momentum[1] > 0.3 * balance.mass);
            }
            mpm_free(sim);
        }
    }
}

// Two blocks fall; the floor reaches under one of them only.
static void test_boundary_span_ends_where_it_says(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        define(2, basis, false);
        struct mpm_wall_def *floor = add_wall(1, 0.5, true, MPM_WALL_SLIP);
        floor->has_span = true;
        floor->span_max[0] = 0.375;
        world.def.n_bodies = 2;
        world.bodies[0].shape = (struct mpm_shape){.min = {0, 0.5}, .max = {0.25, 0.75}};
        world.bodies[1].shape = (struct mpm_shape){.min = {0.75, 0.5}, .max = {1, 0.75}};
        world.def.settings.gravity[1] = -10;
        struct mpm_sim *sim = create();
        for (int k = 0; k < 200; k++) {
            step(sim);
        }
        for (size_t p = 0; p < sim->sets[0].n; p++) {
            assert_true(sim->sets[0].x[mpm_at(p, 2, 1)] > 0.5);
            assert_near(sim->sets[1].v[mpm_at(p, 2, 1)], -10 * 200 * DT, 1e-12);
        }
        mpm_free(sim);
    }
}

// Couette flow: from rest to the linear profile between a fixed wall and one that moves along
// itself. The strip is 8 times as long as high, so its free ends (decaying as exp(-pi x/H)) are not
// felt in the middle; after t = 24 H^2/(pi^2 nu) nothing is left of the exact solution's transient.
// It is the grid's velocity that must be linear: a FLIP particle keeps its share of the start.
static void test_boundary_moving_wall_makes_couette_flow(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        define(2, basis, true);
        world.material.parameters[2] = 1000; // nu = 1 m^2/s
        world.def.domain_min[0] = -2.5;
        world.def.domain_max[0] = 2.5;
        world.def.domain_max[1] = 0.5;
        world.bodies[0].shape = (struct mpm_shape){.min = {-2, 0}, .max = {2, 0.5}};
        add_wall(1, 0, true, MPM_WALL_FIXED);
        add_wall(1, 0.5, false, MPM_WALL_FIXED)->velocity[0] = 0.05;
        struct mpm_sim *sim = create();
        while (mpm_time(sim) < 24 * 0.25 / (M_PI * M_PI)) {
            step(sim);
        }
        const struct mpm_particles *s = &sim->sets[0];
        for (size_t p = 0; p < s->n; p++) {
            if (fabs(s->x[mpm_at(p, 2, 0)]) < 0.5) {
                double v[2], x[2] = {s->x[mpm_at(p, 2, 0)], s->x[mpm_at(p, 2, 1)]};
                velocity_at(sim, x, v);
                // 3e-3 of the wall's speed is what is left of the grid's own slow modes.
                assert_near(v[0] / 0.05, x[1] / 0.5, 5e-3);
                assert_near(s->sigma[mpm_at(p, 4, 3)], 1000 * 0.05 / 0.5, 1);
            }
        }
        // The moving wall does work, the fixed one none.
        struct mpm_balance balance;
        double reaction[2];
        mpm_balance(sim, &balance);
        mpm_probe_value(sim, 1, reaction);
        assert_true(balance.external_work > 0);
        assert_near(reaction[0], -1000 * 0.05 / 0.5 * 4, 0.05 * 400); // 4 m of it, less its ends
        mpm_free(sim);
    }
}

// What FLIP adds to the particles is what forces and walls give the nodes, to round-off: in a
// slumping block d(momentum) = dt (weight - what the walls took), whatever walls meet in a corner.
static void check_balance(int dim, int basis, const enum mpm_wall_condition *conditions, int fluid,
                          bool upper, bool holds_nodes) {
    define(dim, basis, fluid);
    world.def.walls_hold_nodes = holds_nodes;
    for (int axis = 0; axis < dim; axis++) {
        add_wall(axis, upper ? 0.5 : 0, !upper, conditions[axis]);
    }
    const double g[3] = {upper ? 1 : -1, upper ? 10 : -10, upper ? 2 : -2};
    memcpy(world.def.settings.gravity, g, sizeof g);
    struct mpm_sim *sim = create();
    struct mpm_particles *s = &sim->sets[0];
    seed = 1;
    for (size_t p = 0; p < s->n; p++) {
        for (int d = 0; d < dim; d++) {
            s->v[mpm_at(p, dim, d)] = 0.1 * uniform();
        }
    }
    struct mpm_balance before, after;
    mpm_balance(sim, &before);
    double seen = 0;
    for (int k = 0; k < 20; k++) {
        step(sim);
        mpm_balance(sim, &after);
        for (int d = 0; d < dim; d++) {
            double taken = 0;
            for (size_t w = 0; w < sim->n_walls; w++) {
                double reaction[3];
                mpm_probe_value(sim, w, reaction);
                taken += reaction[d];
                seen = fmax(seen, fabs(reaction[d]));
                if (conditions[w] != MPM_WALL_FIXED && d != (int)w) {
                    assert_near(reaction[d], 0, 1e-9 * before.mass); // no friction
                }
            }
            // Momenta of the size of m g dt, times eps and the number of particles.
            assert_near((after.momentum[d] - before.momentum[d]) / DT, before.mass * g[d] - taken,
                        1e-9 * before.mass);
        }
        before = after;
    }
    assert_true(seen > before.mass); // the walls did push
    mpm_free(sim);
}

static void test_boundary_momentum_balances_in_corners(void **state) {
    (void)state;
    const enum mpm_wall_condition F = MPM_WALL_FIXED, S = MPM_WALL_SLIP, X = MPM_WALL_SEPARATE;
    const enum mpm_wall_condition cases[][3] = {{S, S, S}, {F, F, F}, {S, F, S}, {F, S, S},
                                                {X, S, F}, {F, X, S}, {X, X, X}};
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            const size_t n = sizeof cases / sizeof *cases;
            for (size_t c = 0; c < n; c++) {
                check_balance(dim, basis, cases[c], c % 2 == 0, c % 3 == 0, false);
                check_balance(dim, basis, cases[c], c % 2 == 0, c % 3 == 0, true);
            }
        }
    }
}

// At rest the floor carries the weight, to the last of it, and the sides what the pressure pushes.
static void test_boundary_floor_carries_the_weight(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            define(2, basis, true);
            add_wall(1, 0, true, MPM_WALL_SLIP);
            add_wall(0, 0, true, MPM_WALL_SLIP);
            add_wall(0, 0.5, false, MPM_WALL_SLIP);
            world.def.settings.gravity[1] = -10;
            world.def.settings.damping_local = 0.5;
            world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
            struct mpm_sim *sim = create();
            for (int k = 0; k < 2000; k++) {
                step(sim);
            }
            struct mpm_balance balance;
            mpm_balance(sim, &balance);
            double mean[3][2] = {{0}};
            for (int k = 0; k < 200; k++) { // local damping leaves a twitch, which a mean removes
                step(sim);
                for (size_t w = 0; w < 3; w++) {
                    double reaction[2];
                    mpm_probe_value(sim, w, reaction);
                    for (int d = 0; d < 2; d++) {
                        mean[w][d] += reaction[d] / 200;
                    }
                }
            }
            const double weight = balance.mass * 10;
            // Without F-bar to the accuracy of the rest state; with it the state creeps, and local
            // damping makes a force of every speed.
            const double tol = (scheme == MPM_FBAR_OFF ? 5e-3 : 0.1) * weight;
            assert_near(mean[0][1], -weight, tol);
            assert_near(mean[0][0], 0, 1e-9 * weight);
            // Both sides alike; the pressure's resultant rho g H^2/2 is half the weight here.
            assert_near(mean[1][0] + mean[2][0], 0, tol);
            assert_near(mean[2][0], weight / 2, 0.1 * weight / 2 + tol);
            mpm_free(sim);
        }
    }
}

// A wall that is not reached takes no force and costs no crash.
static void test_boundary_far_wall_is_idle(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        define(2, basis, false);
        add_wall(0, 1, false, MPM_WALL_FIXED);
        add_wall(1, 0, true, MPM_WALL_SEPARATE);
        world.bodies[0].shape = (struct mpm_shape){.min = {0.25, 0.375}, .max = {0.375, 0.5}};
        struct mpm_sim *sim = create();
        for (int k = 0; k < 10; k++) {
            step(sim);
            double reaction[2] = {1, 1};
            mpm_probe_value(sim, 0, reaction);
            assert_true(reaction[0] == 0 && reaction[1] == 0);
        }
        mpm_free(sim);
    }
}

// Thrown into a corner of walls, across the cuts between the threads' parts: each sees to its own
// columns, and what is common to them is in one order.
static struct mpm_sim *thrown(int dim, int basis, int variant, int n_threads) {
    define(dim, basis, variant % 2);
    world.def.n_threads = n_threads;
    world.def.cell = dim == 2 ? H / 4 : H / 2;
    world.def.walls_hold_nodes = variant == 3;
    for (int d = 0; d < 3; d++) {
        world.bodies[0].shape.min[d] = 0.25;
        world.bodies[0].shape.max[d] = d == 0 ? 0.75 : 0.5;
        world.bodies[0].velocity.vector[d] = d == 1 ? -6 : -3;
    }
    add_wall(1, 0.25, true, (enum mpm_wall_condition)(variant % 3));
    add_wall(0, 0.25, true, MPM_WALL_SLIP);
    add_wall(0, 0.75, false, (enum mpm_wall_condition)((variant + 1) % 3));
    add_wall(1, 0.5, false, MPM_WALL_SEPARATE);
    if (dim == 3) {
        add_wall(2, 0.25, true, MPM_WALL_FIXED);
    }
    if (variant != 2) {
        world.def.n_probes = 0; // no reactions: they are sums, in one order
    }
    return create();
}

static void test_boundary_does_not_depend_on_threads(void **state) {
    (void)state;
    int n_common = 0, n_apart = 0;
    for (int k = 0; k < 2 * MPM_N_BASES * 4; k++) {
        const int dim = 2 + k % 2, basis = k / 2 % MPM_N_BASES, variant = k / 2 / MPM_N_BASES;
        struct mpm_sim *one = thrown(dim, basis, variant, 1);
        for (int s = 0; s < 25; s++) {
            step(one);
        }
        const int n_threads[] = {2, 3, 5};
        for (int q = 0; q < 3; q++) {
            struct mpm_sim *sim = thrown(dim, basis, variant, n_threads[q]);
            for (int s = 0; s < 25; s++) {
                step(sim);
            }
            n_common += sim->walls_in_common;
            n_apart += !sim->walls_in_common;
            if (memcmp(sim->sets[0].memory, one->sets[0].memory, one->sets[0].memory_bytes) != 0) {
                fail_msg("%dD, basis %d, variant %d: %d threads", dim, basis, variant,
                         n_threads[q]);
            }
            for (size_t w = 0; w < sim->n_walls; w++) {
                assert_memory_equal(sim->walls[w].reaction, one->walls[w].reaction,
                                    sizeof one->walls[w].reaction);
            }
            mpm_free(sim);
        }
        mpm_free(one);
    }
    assert_true(n_common > 0 && n_apart > 0); // both ways were tried
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_boundary_normal_velocity_vanishes),
        cmocka_unit_test(test_boundary_slip_keeps_tangential_velocity),
        cmocka_unit_test(test_boundary_fixed_holds_back),
        cmocka_unit_test(test_boundary_separate_lets_go),
        cmocka_unit_test(test_boundary_separate_lets_nothing_in),
        cmocka_unit_test(test_boundary_span_ends_where_it_says),
        cmocka_unit_test(test_boundary_moving_wall_makes_couette_flow),
        cmocka_unit_test(test_boundary_momentum_balances_in_corners),
        cmocka_unit_test(test_boundary_floor_carries_the_weight),
        cmocka_unit_test(test_boundary_far_wall_is_idle),
        cmocka_unit_test(test_boundary_does_not_depend_on_threads),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
