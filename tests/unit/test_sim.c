// The life of a simulation: stages, clock, settings, failures as statuses, memory.
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

// ---- Counting allocations: the allocator's entry points, taken over by this program ------------

#if defined __has_feature
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define SANITIZED
#endif
#endif
#if defined __SANITIZE_ADDRESS__ || defined __SANITIZE_THREAD__
#define SANITIZED
#endif

// LLVM's OpenMP runtime allocates for every parallel region, a serial one too.
#if defined __GLIBC__ && !defined SANITIZED && !defined __clang__
#define COUNTS_ALLOCATIONS
static size_t n_allocations;
void *__libc_malloc(size_t size);
void *__libc_calloc(size_t n, size_t size);
void *__libc_realloc(void *old, size_t size);
void *__libc_memalign(size_t alignment, size_t size);
void *malloc(size_t size) {
    n_allocations++;
    return __libc_malloc(size);
}
void *calloc(size_t n, size_t size) {
    n_allocations++;
    return __libc_calloc(n, size);
}
void *realloc(void *old, size_t size) {
    n_allocations++;
    return __libc_realloc(old, size);
}
void *aligned_alloc(size_t alignment, size_t size) {
    n_allocations++;
    return __libc_memalign(alignment, size);
}
#endif

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

#define H 0.125
#define MAX_STAGES 4

// A block in a box of 1 m; one problem at a time.
static struct {
    struct mpm_def def;
    struct mpm_material_def materials[2], patched[2];
    struct mpm_body_def bodies[2];
    struct mpm_stage_def stages[MAX_STAGES];
    struct mpm_wall_def walls[3];
    struct mpm_probe_def probes[8];
    bool removes[3];
} world;

enum { RUBBER, WATER, CLAY, N_KINDS };

static void define(int dim, int kind) {
    const struct mpm_material_def materials[N_KINDS] = {
        {.name = "rubber",
         .model = mpm_material_find("neo_hookean"),
         .parameters = {1000, 1e5, 0.3}},
        {.name = "water", .model = mpm_material_find("newtonian"), .parameters = {1000, 1e5, 1}},
        {.name = "clay",
         .model = mpm_material_find("hencky_j2"),
         .parameters = {1000, 1e5, 0.3, 100, 50, 3}},
    };
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.def.basis = MPM_GIMP;
    for (int k = 0; k < 2; k++) {
        world.materials[k] = materials[kind];
        world.materials[k].fbar = true;
        world.bodies[k] =
            (struct mpm_body_def){.name = k ? "other" : "block", .particles_per_direction = 2};
    }
    for (int d = 0; d < 3; d++) {
        world.bodies[0].shape.max[d] = 0.5;
        world.bodies[1].shape.min[d] = 0.5;
        world.bodies[1].shape.max[d] = 1;
        world.def.domain_max[d] = 1;
    }
    world.stages[0] = (struct mpm_stage_def){.name = "main", .duration = 10};
    for (int k = 0; k < 3; k++) {
        world.walls[k] = (struct mpm_wall_def){.name = k == 0   ? "left"
                                                       : k == 1 ? "floor"
                                                                : "gate",
                                               .axis = k == 1,
                                               .at = k == 2 ? 0.5 : 0,
                                               .keeps_above = k != 2,
                                               .condition = MPM_WALL_SLIP};
    }
    world.def.dimension = dim;
    world.def.cell = H;
    world.def.settings.dt = 1e-3;
    world.def.n_materials = world.def.n_bodies = world.def.n_stages = 1;
    world.def.materials = world.materials;
    world.def.bodies = world.bodies;
    world.def.stages = world.stages;
    world.def.walls = world.walls;
    world.def.probes = world.probes;
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

// ---- Clock
// ---------------------------------------------------------------------------------------

// dt = 1e-5 is not exact in binary; the 20,000 steps to 0.2 s must be that many, none a sliver.
static void test_sim_fixed_dt_takes_exactly_its_steps(void **state) {
    (void)state;
    const struct {
        double dt, end;
        unsigned steps;
    } cases[] = {{1e-5, 0.2, 20000}, {1e-3, 1, 1000},      {3e-4, 0.3, 1000},
                 {7e-4, 0.7, 1000},  {1e-3, 0.9995, 1000}, {1e-3, 0.0001, 1}};
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        define(2, RUBBER);
        const double point[] = {0.3, 0.3, 1e-3};
        world.bodies[0].shape =
            (struct mpm_shape){.kind = MPM_SHAPE_POINTS, .n_points = 1, .points = point};
        world.def.settings.dt = cases[c].dt;
        world.stages[0].duration = cases[c].end;
        struct mpm_estimate estimate;
        mpm_estimate(&world.def, &estimate);
        assert_int_equal(estimate.steps, cases[c].steps);
        struct mpm_sim *sim = create();
        unsigned n = 0;
        while (!mpm_finished(sim)) {
            const double t = mpm_time(sim), dt = mpm_next_dt(sim);
            assert_true(dt > 0 && dt <= cases[c].dt);
            // No drift: t is n dt to one rounding.
            assert_near(t, n * cases[c].dt, 2e-16 * cases[c].end);
            step(sim);
            n++;
            assert_true(n <= cases[c].steps);
        }
        assert_int_equal(n, cases[c].steps);
        assert_int_equal(mpm_step_count(sim), n);
        assert_true(mpm_time(sim) == cases[c].end);
        mpm_free(sim);
    }
}

// dt = cfl h/(c + v), refreshed as the particles speed up; the last step ends on the end.
static void test_sim_cfl_follows_the_speed(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.settings.dt = 0;
    world.def.settings.cfl = 0.25;
    world.def.settings.gravity[0] = 5;
    world.stages[0].duration = 0.2;
    struct mpm_sim *sim = create();
    const double c = world.materials[0].model->wave_speed(world.materials[0].parameters);
    double t = 0;
    while (!mpm_finished(sim)) {
        const double dt = mpm_next_dt(sim), full = 0.25 * H / (c + 5 * t);
        assert_near(mpm_dt_limit(sim), 2 * full, 1e-12); // the limit is CFL 0.5
        assert_near(dt, fmin(full, 0.2 - t), 1e-12);
        step(sim);
        t += dt;
        assert_near(mpm_time(sim), t, 1e-14);
    }
    assert_true(mpm_time(sim) == 0.2);
    mpm_free(sim);
}

static void test_sim_end_can_be_moved(void **state) {
    (void)state;
    define(2, RUBBER);
    world.stages[0].duration = 0.005;
    struct mpm_sim *sim = create();
    step(sim), step(sim), step(sim);
    struct mpm_error err;
    assert_int_equal(mpm_change_end(sim, 0.002, &err), MPM_ERR_RANGE);
    assert_string_equal(err.pointer, "/time/end");
    assert_int_equal(mpm_change_end(sim, -1, &err), MPM_ERR_RANGE);
    assert_int_equal(mpm_change_end(sim, INFINITY, &err), MPM_ERR_RANGE);
    assert_near(mpm_end_time(sim), 0.005, 0);
    assert_int_equal(mpm_change_end(sim, 0.0035, &err), MPM_OK);
    assert_near(mpm_next_dt(sim), 0.0005, 1e-15);
    step(sim);
    assert_true(mpm_finished(sim));
    assert_true(mpm_time(sim) == 0.0035);
    assert_int_equal(mpm_change_end(sim, 0.0055, &err), MPM_OK); // and go on
    assert_false(mpm_finished(sim));
    step(sim), step(sim);
    assert_true(mpm_finished(sim) && mpm_time(sim) == 0.0055);
    mpm_free(sim);
}

// ---- Stages
// --------------------------------------------------------------------------------------

// Settle (behind a gate, damped, with PIC and F-bar), hold, go: t = 0 is where the last stage
// starts, the gate goes just then, and what a stage states goes back after it.
static void test_sim_stages_begin_and_end_on_time(void **state) {
    (void)state;
    define(2, WATER);
    world.def.n_walls = 3;
    world.def.n_stages = 3;
    world.def.settings.gravity[1] = -10;
    world.stages[0] = (struct mpm_stage_def){.name = "settle",
                                             .duration = 0.03,
                                             .states = MPM_SET_DAMPING | MPM_SET_BLEND |
                                                       MPM_SET_FBAR | MPM_SET_TIME};
    world.stages[0].settings = mpm_settings_default();
    world.stages[0].settings.damping_local = 0.7;
    world.stages[0].settings.damping_mass = 1;
    world.stages[0].settings.blend = 0.5;
    world.stages[0].settings.fbar.scheme = MPM_FBAR_ZHAO;
    world.stages[0].settings.dt = 5e-4;
    world.stages[1] = (struct mpm_stage_def){.name = "hold", .duration = 0.02};
    world.stages[2] = (struct mpm_stage_def){
        .name = "go", .duration = 0.05, .resets = MPM_RESET_VELOCITY | MPM_RESET_DISPLACEMENT};
    world.removes[2] = true;
    world.stages[2].removes_wall = world.removes;
    world.def.wants_displacement = true;
    struct mpm_sim *sim = create();
    assert_near(mpm_start_time(sim), -0.05, 1e-17);
    assert_near(mpm_time(sim), -0.05, 1e-17);

    unsigned steps[3] = {0};
    while (!mpm_finished(sim)) {
        const size_t stage = mpm_stage(sim);
        const struct mpm_settings now = mpm_settings_now(sim);
        const bool first = stage == 0;
        assert_true(now.damping_local == (first ? 0.7 : 0));
        assert_true(now.damping_mass == (first ? 1 : 0));
        assert_true(now.blend == (first ? 0.5 : 1));
        assert_true(now.dt == (first ? 5e-4 : 1e-3));
        assert_true(now.fbar.scheme == (first ? MPM_FBAR_ZHAO : MPM_FBAR_OFF));
        assert_true(now.gravity[1] == -10);
        assert_true(sim->walls[2].active == (stage < 2));
        const double begin = stage == 0 ? -0.05 : stage == 1 ? -0.02 : 0;
        assert_near(mpm_time(sim), begin + steps[stage] * now.dt, 1e-16);
        if (stage == 2 && steps[2] == 0) {
            double v[64 * 2], u[64 * 2];
            mpm_field_copy(sim, MPM_FIELD_VELOCITY, v);
            mpm_field_copy(sim, MPM_FIELD_DISPLACEMENT, u);
            for (int k = 0; k < 128; k++) {
                assert_true(v[k] == 0 && u[k] == 0);
            }
        }
        step(sim);
        steps[stage]++;
    }
    assert_int_equal(steps[0], 60);
    assert_int_equal(steps[1], 20);
    assert_int_equal(steps[2], 50);
    assert_true(mpm_time(sim) == 0.05);
    mpm_free(sim);
}

static void test_sim_gravity_ramps_up(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.n_stages = 2;
    world.def.settings.gravity[1] = -10;
    world.stages[0] =
        (struct mpm_stage_def){.name = "ramp", .duration = 0.05, .gravity_ramp = 0.02};
    world.stages[1] = (struct mpm_stage_def){
        .name = "turn", .duration = 0.05, .gravity_ramp = 0.04, .states = MPM_SET_GRAVITY};
    world.stages[1].settings.gravity[1] = 20;
    struct mpm_sim *sim = create();
    double v = 0;
    for (int k = 0; k < 100; k++) {
        double g[3];
        mpm_gravity_at(sim, mpm_time(sim), g);
        const double t = 1e-3 * (k < 50 ? k : k - 50);
        const double expected = k < 50 ? -10 * fmin(1, t / 0.02) : -10 + 30 * fmin(1, t / 0.04);
        assert_near(g[1], expected, 1e-11);
        v += 1e-3 * g[1];
        step(sim);
        double all[64 * 2];
        mpm_field_copy(sim, MPM_FIELD_VELOCITY, all);
        assert_near(all[1], v, 1e-12);
    }
    mpm_free(sim);
}

// A stage may end early, once its motion has died down; the clock jumps to the next stage's start.
static void test_sim_stage_ends_at_rest(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.n_walls = 2;
    world.def.n_stages = 2;
    world.def.settings.gravity[1] = -10;
    world.stages[0] = (struct mpm_stage_def){
        .name = "settle", .duration = 100, .kinetic_energy_ratio = 1e-3, .states = MPM_SET_DAMPING};
    world.stages[0].settings.damping_local = 0.5;
    world.stages[1] = (struct mpm_stage_def){.name = "main", .duration = 1};
    struct mpm_sim *sim = create();
    double most = 0, now = 0;
    while (mpm_stage(sim) == 0) {
        step(sim);
        now = mpm_kinetic_energy(sim);
        most = fmax(most, now);
        assert_true(mpm_step_count(sim) < 5000);
        assert_true((mpm_stage(sim) == 1) == (now <= 1e-3 * most));
    }
    assert_true(mpm_time(sim) == 0);
    assert_true(mpm_step_count(sim) > 20);
    mpm_free(sim);
}

// Material patches of a stage: the stress follows at once from the new parameters, and a fluid
// keeps its rate part.
static void test_sim_stage_patches_materials(void **state) {
    (void)state;
    for (int kind = RUBBER; kind <= WATER; kind++) {
        define(2, kind);
        world.def.n_walls = 2;
        world.def.n_stages = 2;
        world.def.settings.gravity[1] = -10;
        memcpy(world.patched, world.materials, sizeof world.patched);
        world.patched[0].parameters[1] *= 0.25;
        world.stages[0] = (struct mpm_stage_def){.name = "stiff", .duration = 0.05};
        world.stages[1] =
            (struct mpm_stage_def){.name = "soft", .duration = 0.05, .materials = world.patched};
        struct mpm_sim *sim = create();
        for (int k = 0; k < 49; k++) {
            step(sim);
        }
        double mean[2][64], shear[2][64 * 4], J[64];
        // The same step with and without the stage's end after it.
        void *saved = malloc(mpm_state_bytes(sim));
        mpm_state_save(sim, saved);
        step(sim);
        assert_int_equal(mpm_stage(sim), 1);
        mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS, mean[1]);
        mpm_field_copy(sim, MPM_FIELD_STRESS, shear[1]);
        mpm_free(sim);
        world.stages[0].duration = 0.06;
        sim = create();
        for (int k = 0; k < 50; k++) {
            step(sim);
        }
        assert_int_equal(mpm_stage(sim), 0);
        mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS, mean[0]);
        mpm_field_copy(sim, MPM_FIELD_STRESS, shear[0]);
        mpm_field_copy(sim, MPM_FIELD_VOLUME_RATIO_BAR, J);
        for (int p = 0; p < 64; p++) { // both laws are linear in their modulus
            assert_near(mean[1][p], 0.25 * mean[0][p], 1e-9);
            assert_near(shear[1][4 * p + 1], (kind == WATER ? 1 : 0.25) * shear[0][4 * p + 1],
                        1e-9);
        }
        mpm_free(sim);
        free(saved);
    }
}

// ---- Settings
// ------------------------------------------------------------------------------------

static void test_sim_change_is_checked(void **state) {
    (void)state;
    const int traps = fedisableexcept(FE_ALL_EXCEPT); // NaN is compared
    define(2, RUBBER);
    struct mpm_sim *sim = create();
    const struct mpm_settings was = mpm_settings_now(sim);
    const struct {
        unsigned which;
        const char *pointer;
        enum mpm_status status;
        struct mpm_settings to;
    } cases[] = {
        {MPM_SET_BLEND, "/transfer/blend", MPM_ERR_RANGE, {.blend = 1.5}},
        {MPM_SET_BLEND, "/transfer/blend", MPM_ERR_RANGE, {.blend = NAN}},
        {MPM_SET_DAMPING, "/damping/local", MPM_ERR_RANGE, {.damping_local = 1}},
        {MPM_SET_DAMPING, "/damping/mass", MPM_ERR_RANGE, {.damping_mass = -1}},
        {MPM_SET_GRAVITY, "/gravity/1", MPM_ERR_RANGE, {.gravity = {0, INFINITY}}},
        {MPM_SET_TIME, "/time/dt", MPM_ERR_UNSTABLE_DT, {.dt = 1}},
        {MPM_SET_TIME, "/time/dt", MPM_ERR_RANGE, {.dt = -1}},
        {MPM_SET_TIME, "/time/cfl", MPM_ERR_UNSTABLE_DT, {.cfl = 0.6}},
        {MPM_SET_TIME, "/time/cfl", MPM_ERR_RANGE, {.cfl = 0}},
        {MPM_SET_FBAR,
         "/fbar/a",
         MPM_ERR_RANGE,
         {.fbar = {.scheme = MPM_FBAR_ANCHORED, .a = 0, .C = 1}}},
        {MPM_SET_FBAR,
         "/fbar/keep",
         MPM_ERR_RANGE,
         {.fbar = {.scheme = MPM_FBAR_ANCHORED, .a = 1, .C = 1, .keep = -0.1}}},
        {MPM_SET_FBAR,
         "/fbar/C",
         MPM_ERR_RANGE,
         {.fbar = {.scheme = MPM_FBAR_ANCHORED, .a = 0.05, .C = -1}}},
    };
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        struct mpm_error err = {0};
        assert_int_equal(mpm_change(sim, &cases[c].to, cases[c].which, &err), cases[c].status);
        assert_int_equal(err.status, cases[c].status);
        assert_string_equal(err.pointer, cases[c].pointer);
        assert_int_equal(mpm_change(sim, &cases[c].to, cases[c].which, NULL), cases[c].status);
        const struct mpm_settings now = mpm_settings_now(sim);
        assert_memory_equal(&now, &was, sizeof now); // nothing has changed
    }
    mpm_free(sim);
    feclearexcept(FE_ALL_EXCEPT);
    feenableexcept(traps);
}

// A change takes effect with the next step, leaves what it does not name, and outlives the stage;
// what the next stage states wins over it.
static void test_sim_change_lasts(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.n_stages = 3;
    for (int k = 0; k < 3; k++) {
        world.stages[k] = (struct mpm_stage_def){.name = "part", .duration = 0.005};
    }
    world.stages[1].states = MPM_SET_BLEND;
    world.stages[1].settings.blend = 0.25;
    struct mpm_sim *sim = create();
    step(sim);
    struct mpm_settings to = {.gravity = {3, 0, 0}, .dt = 5e-4, .blend = 0.75};
    assert_int_equal(mpm_change(sim, &to, MPM_SET_GRAVITY | MPM_SET_TIME | MPM_SET_BLEND, NULL),
                     MPM_OK);
    assert_near(mpm_next_dt(sim), 5e-4, 0);
    step(sim);
    assert_near(mpm_time(sim), -0.01 + 1e-3 + 5e-4, 1e-16);
    double v[64 * 2];
    mpm_field_copy(sim, MPM_FIELD_VELOCITY, v);
    assert_near(v[0], 3 * 5e-4, 1e-15);
    while (mpm_stage(sim) == 0) {
        step(sim);
    }
    assert_true(mpm_settings_now(sim).blend == 0.25 && mpm_settings_now(sim).gravity[0] == 3);
    while (mpm_stage(sim) == 1) {
        step(sim);
    }
    assert_true(mpm_settings_now(sim).blend == 0.75 && mpm_settings_now(sim).dt == 5e-4);
    mpm_free(sim);
}

// ---- Failures
// ------------------------------------------------------------------------------------

// Steps until a step fails; the error must say all of it.
static struct mpm_error fails(struct mpm_sim *sim, enum mpm_status status, const char *quantity) {
    // The failing step computes with what it then reports.
    const int traps = fedisableexcept(FE_ALL_EXCEPT);
    struct mpm_error err = {0};
    for (int k = 0; k < 2000; k++) {
        const uint64_t n = mpm_step_count(sim);
        const double end = mpm_time(sim) + mpm_next_dt(sim);
        if (mpm_step(sim, &err)) {
            assert_int_equal(err.status, status);
            assert_string_equal(err.quantity, quantity);
            assert_int_equal(err.step, n + 1);
            assert_near(err.time, end, 1e-15);
            assert_true(strlen(err.message) > 0 && strlen(err.advice) > 0);
            mpm_free(sim); // which must be possible
            feclearexcept(FE_ALL_EXCEPT);
            feenableexcept(traps);
            return err;
        }
    }
    fail_msg("no step failed");
    return err;
}

static void test_sim_particle_that_leaves_is_a_status(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            for (int side = 0; side < 2 * dim; side++) {
                define(dim, RUBBER);
                world.def.basis = (enum mpm_basis)basis;
                world.bodies[0].velocity.vector[side / 2] = side % 2 ? 20 : -20;
                const char *names[] = {"position.x", "position.y", "position.z"};
                const struct mpm_error err = fails(create(), MPM_ERR_LEFT_DOMAIN, names[side / 2]);
                assert_true(side % 2 ? err.value > 1 : err.value < 0);
                // 0 is in the corner at the origin, the last one in the other.
                assert_true(err.particle >= 0 && err.particle < (dim == 2 ? 64 : 512));
                if (side % 2 == 0) {
                    assert_int_equal(err.particle, 0);
                }
            }
        }
    }
}

// A velocity that is far from any sound one: not finite after its square, or turned inside out.
static void test_sim_wild_velocities_are_a_status(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            for (int kind = 0; kind < N_KINDS; kind++) {
                define(dim, kind);
                world.def.unstable_ok = true;
                world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
                struct mpm_sim *sim = create();
                for (size_t p = 0; p < sim->sets[0].n; p++) {
                    sim->sets[0].v[mpm_at(p, dim, 1)] = 1e200;
                }
                assert_int_equal(fails(sim, MPM_ERR_NOT_FINITE, "velocity").step, 1);

                sim = create();
                sim->sets[0].v[mpm_at(5, dim, 0)] = NAN;
                const struct mpm_error err = fails(sim, MPM_ERR_NOT_FINITE, "velocity");
                assert_true(err.step == 1 && err.particle >= 0 && isnan(err.value));

                // Closing in faster than dt allows: det dF <= 0.
                world.bodies[0].velocity = (struct mpm_velocity){
                    .kind = MPM_VELOCITY_MODE, .number = 1, .length = 0.5, .amplitude = -2000};
                assert_true(fails(create(), MPM_ERR_VOLUME, "volume_ratio").value <= 0);
            }
        }
    }
}

// A step that became too long as the body sped up.
static void test_sim_unstable_dt_is_a_status(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.settings.gravity[0] = 1e5;
    world.def.domain_max[0] = 1000;
    world.def.domain_max[1] = 0.5;
    const struct mpm_error err = fails(create(), MPM_ERR_UNSTABLE_DT, "CFL number");
    assert_true(err.value > 1 && err.value < 2 && err.particle == -1);
    // "unstable_ok" means what it says.
    world.def.unstable_ok = true;
    struct mpm_sim *sim = create();
    for (uint64_t k = 0; k < err.step; k++) {
        step(sim);
    }
    mpm_free(sim);
}

static double kinetic_after(double dt, double mass_damping, int steps) {
    define(2, RUBBER);
    world.def.settings.dt = dt;
    world.def.settings.damping_mass = mass_damping;
    world.def.unstable_ok = true;
    world.bodies[0].velocity = (struct mpm_velocity){
        .kind = MPM_VELOCITY_MODE, .number = 1, .length = 0.5, .amplitude = 1e-3};
    struct mpm_sim *sim = create();
    struct mpm_balance first, last;
    mpm_balance(sim, &first);
    for (int k = 0; k < steps; k++) {
        step(sim);
    }
    mpm_balance(sim, &last);
    mpm_free(sim);
    return last.kinetic_energy / first.kinetic_energy;
}

// Damping in proportion to mass flips a velocity in a step of 2/alpha: the limit knows of it, and a
// change that it makes unstable is refused.
static void test_sim_limit_counts_mass_damping(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.settings.dt = 0;
    struct mpm_sim *sim = create();
    const double plain = mpm_dt_limit(sim), alpha = 100 / plain;
    struct mpm_settings now = mpm_settings_now(sim);
    struct mpm_error err = {0};
    now.damping_mass = alpha;
    assert_int_equal(mpm_change(sim, &now, MPM_SET_DAMPING, &err), MPM_OK); // with a CFL number
    const double limit = mpm_dt_limit(sim);
    assert_true(limit < 2 / alpha && limit > 1.99 / alpha);
    now.dt = 0.5 * plain;
    assert_int_equal(mpm_change(sim, &now, MPM_SET_TIME, &err), MPM_ERR_UNSTABLE_DT);
    now.damping_mass = 0;
    assert_int_equal(mpm_change(sim, &now, MPM_SET_TIME | MPM_SET_DAMPING, &err), MPM_OK);
    now.damping_mass = alpha;
    assert_int_equal(mpm_change(sim, &now, MPM_SET_DAMPING, &err), MPM_ERR_UNSTABLE_DT);
    mpm_free(sim);
    assert_true(kinetic_after(0.99 * limit, alpha, 100) < 1);
    assert_true(kinetic_after(1.05 * limit, alpha, 100) > 100);
}

// uGIMP's walls hold nodes, so that a particle pressed against one may sink in by half its own size
// before it counts as lost, where the wall stands on the domain's edge; elsewhere it may not.
static void test_sim_exit_leaves_room_at_direct_walls(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        const bool direct = basis == MPM_LINEAR || basis == MPM_GIMP;
        for (int walls = 0; walls < 2; walls++) {
            define(2, RUBBER);
            world.def.basis = (enum mpm_basis)basis;
            world.def.n_walls = walls ? 2 : 0;
            struct mpm_sim *sim = create();
            const double room = walls && direct ? 0.25 * H : 0;
            for (int inside = 1; inside >= 0; inside--) {
                sim->sets[0].x[0] = -room + (inside ? 1e-6 : -1e-6);
                sim->sets[0].v[0] = 0;
                sim->c.min[0] = sim->sets[0].x[0];
                const enum mpm_status status = mpm_step(sim, NULL);
                assert_int_equal(status, inside ? MPM_OK : MPM_ERR_LEFT_DOMAIN);
            }
            mpm_free(sim);
        }
    }
}

// ---- Definitions
// ---------------------------------------------------------------------------------

struct faults {
    size_t n;
    struct mpm_error list[16];
};
static void collect(void *context, const struct mpm_error *fault) {
    struct faults *f = context;
    if (f->n < 16) {
        f->list[f->n] = *fault;
    }
    f->n++;
}

static void check(size_t n, const char *pointer, enum mpm_status status, int line) {
    const int traps = fedisableexcept(FE_ALL_EXCEPT); // NaN is compared
    struct faults f = {0};
    const size_t count = mpm_check(&world.def, collect, &f);
    bool found = false;
    for (size_t k = 0; k < f.n && k < 16; k++) {
        found |= strcmp(f.list[k].pointer, pointer) == 0 && f.list[k].status == status;
        if (strlen(f.list[k].message) == 0) {
            _fail(__FILE__, line);
        }
    }
    if (count != n || f.n != n || !found) {
        for (size_t k = 0; k < f.n && k < 16; k++) {
            print_error("%s: %s\n", f.list[k].pointer, f.list[k].message);
        }
        print_error("%zu faults, expected %zu with %s at '%s'\n", f.n, n, mpm_status_name(status),
                    pointer);
        _fail(__FILE__, line);
    }
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&world.def, &sim, &err) != f.list[0].status || sim ||
        strcmp(err.pointer, f.list[0].pointer) != 0 || mpm_create(&world.def, &sim, NULL) == 0) {
        _fail(__FILE__, line);
    }
    feclearexcept(FE_ALL_EXCEPT);
    feenableexcept(traps);
}
#define one_fault(pointer, status) check(1, pointer, status, __LINE__)

static void test_sim_check_finds_faults(void **state) {
    (void)state;
    define(2, RUBBER);
    assert_int_equal(mpm_check(&world.def, NULL, NULL), 0);
    world.def.dimension = 4;
    one_fault("/dimension", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.cell = 0;
    one_fault("/cell", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.cell = NAN;
    one_fault("/cell", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.cell = 1e-6;
    one_fault("/cell", MPM_ERR_RANGE); // too many nodes
    define(2, RUBBER), world.def.domain_max[1] = 0;
    one_fault("/domain/max/1", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.n_bodies = 0;
    one_fault("/bodies", MPM_ERR_EMPTY);
    define(2, RUBBER), world.def.n_stages = 0;
    one_fault("/stages", MPM_ERR_EMPTY);
    define(2, RUBBER), world.materials[0].parameters[0] = 0;
    one_fault("/materials/rubber/density", MPM_ERR_RANGE);
    define(2, RUBBER), world.materials[0].parameters[2] = 0.5;
    one_fault("/materials/rubber/poisson_ratio", MPM_ERR_RANGE);
    define(2, RUBBER), world.materials[0].parameters[1] = NAN;
    one_fault("/materials/rubber/youngs_modulus", MPM_ERR_RANGE);
    define(2, WATER), world.materials[0].parameters[2] = -1;
    one_fault("/materials/water/viscosity", MPM_ERR_RANGE);
    define(2, RUBBER), world.bodies[0].material = 7;
    one_fault("/bodies/block/material", MPM_ERR_REFERENCE);
    define(2, RUBBER), world.bodies[0].particles_per_direction = 0;
    one_fault("/bodies/block/particles_per_cell", MPM_ERR_RANGE);
    define(2, RUBBER), world.bodies[0].shape.max[0] = 1.5;
    one_fault("/bodies/block/shape", MPM_ERR_RANGE); // out of the domain
    define(2, RUBBER), world.bodies[0].shape.max[0] = 0.01;
    one_fault("/bodies/block/shape", MPM_ERR_EMPTY);
    define(2, RUBBER), world.def.n_bodies = 2, world.bodies[1].shape.min[0] = 0.25,
                       world.bodies[1].shape.min[1] = 0.25;
    one_fault("/bodies/other/shape", MPM_ERR_CONFLICT); // overlap
    define(2, RUBBER), world.def.n_walls = 3, world.walls[2].at = 0.25;
    one_fault("/bodies/block/shape", MPM_ERR_CONFLICT); // beyond the gate
    define(2, RUBBER), world.def.n_walls = 3, world.walls[2].at = 0.3;
    one_fault("/walls/gate/at", MPM_ERR_RANGE); // between node planes
    define(2, RUBBER), world.def.n_walls = 3, world.walls[2].at = 2;
    one_fault("/walls/gate/at", MPM_ERR_RANGE); // out of the domain
    define(2, RUBBER), world.def.n_walls = 3, world.walls[2].axis = 2;
    one_fault("/walls/gate/axis", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.settings.blend = 2;
    one_fault("/transfer/blend", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.settings.dt = 0.1;
    one_fault("/time/dt", MPM_ERR_UNSTABLE_DT);
    define(2, RUBBER), world.def.settings.dt = 0, world.def.settings.cfl = 0.9;
    one_fault("/time/cfl", MPM_ERR_UNSTABLE_DT);
    define(2, RUBBER), world.stages[0].duration = 0;
    one_fault("/time/end", MPM_ERR_RANGE);
    define(2, RUBBER), world.def.memory_limit = 15000; // 12 kB of grid, 7 kB of particles
    one_fault("", MPM_ERR_MEMORY);
    define(2, RUBBER), world.def.memory_limit = 1000; // so little that nothing is counted
    one_fault("/bodies/block/shape", MPM_ERR_MEMORY);
    define(2, RUBBER), world.def.n_probes = 1,
                       world.probes[0] = (struct mpm_probe_def){
                           .name = "load", .kind = MPM_PROBE_REACTION, .wall = 3, .scale = 1};
    one_fault("/probes/load/wall", MPM_ERR_REFERENCE);
    define(2, RUBBER), world.def.n_probes = 1,
                       world.probes[0] = (struct mpm_probe_def){
                           .name = "front", .kind = MPM_PROBE_EXTENT, .quantile = 0, .scale = 1};
    one_fault("/probes/front/quantile", MPM_ERR_RANGE);
    define(2, RUBBER),
        world.def.n_probes = 1,
        world.probes[0] =
            (struct mpm_probe_def){.name = "mean", .kind = MPM_PROBE_MEAN, .body = 4, .scale = 1};
    one_fault("/probes/mean/body", MPM_ERR_REFERENCE);
}

static void test_sim_check_finds_faults_of_stages(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.n_stages = 2;
    world.stages[1] = (struct mpm_stage_def){.name = "main", .duration = 1};
    const struct mpm_stage_def good = {.name = "settle", .duration = 1};
    world.stages[0] = good, world.stages[0].duration = -1;
    one_fault("/stages/0/duration", MPM_ERR_RANGE);
    world.stages[0] = good, world.stages[0].states = MPM_SET_TIME,
    world.stages[0].settings.dt = 0.1;
    one_fault("/stages/0/time/dt", MPM_ERR_UNSTABLE_DT);
    world.stages[0] = good, world.stages[0].states = MPM_SET_DAMPING,
    world.stages[0].settings.damping_local = 1.5;
    one_fault("/stages/0/damping/local", MPM_ERR_RANGE);
    world.stages[0] = good, world.stages[0].states = MPM_SET_GRAVITY,
    world.stages[0].settings.gravity[0] = NAN;
    one_fault("/stages/0/gravity/0", MPM_ERR_RANGE);
    world.stages[0] = good, world.stages[0].materials = world.patched;
    memcpy(world.patched, world.materials, sizeof world.patched);
    world.patched[0].parameters[1] = -1;
    one_fault("/stages/0/materials/rubber/youngs_modulus", MPM_ERR_RANGE);
}

// All faults at once.
static void test_sim_check_reports_all_faults(void **state) {
    (void)state;
    define(2, RUBBER);
    world.def.n_walls = 3;
    world.walls[2].at = 0.3;
    world.materials[0].parameters[0] = -1;
    world.def.settings.blend = -1;
    world.stages[0].duration = 0;
    check(4, "/walls/gate/at", MPM_ERR_RANGE, __LINE__);
}

// ---- Memory
// --------------------------------------------------------------------------------------

// No allocation inside a step, with all that a step can do; and no surprise after create.
static void test_sim_steps_without_allocating(void **state) {
    (void)state;
#ifdef COUNTS_ALLOCATIONS
    define(2, RUBBER);
    struct mpm_sim *first = create(); // the OpenMP runtime allocates once, in the first region
    step(first);
    mpm_free(first);
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
                define(dim, basis % 2 ? WATER : CLAY);
                world.def.basis = (enum mpm_basis)basis;
                world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
                world.def.settings.gravity[1] = -10;
                world.def.n_walls = 3;
                world.walls[0].condition = MPM_WALL_SEPARATE;
                world.def.n_stages = 2;
                world.stages[0] = (struct mpm_stage_def){.name = "settle", .duration = 0.01};
                world.stages[1] = (struct mpm_stage_def){.name = "main", .duration = 0.01};
                world.removes[2] = true;
                world.stages[1].removes_wall = world.removes;
                world.def.n_probes = 3;
                world.probes[0] = (struct mpm_probe_def){.name = "load",
                                                         .kind = MPM_PROBE_REACTION,
                                                         .wall = 1,
                                                         .body = -1,
                                                         .scale = 1,
                                                         .average = 0.003};
                world.probes[1] = (struct mpm_probe_def){.name = "front",
                                                         .kind = MPM_PROBE_EXTENT,
                                                         .quantile = 0.9,
                                                         .body = -1,
                                                         .scale = 1,
                                                         .average = 0.005};
                world.probes[2] = (struct mpm_probe_def){
                    .name = "drift", .kind = MPM_PROBE_DRIFT, .body = -1, .scale = 1};
                struct mpm_sim *sim = create();
                double value[3];
                struct mpm_balance balance;
                const size_t before = n_allocations;
                assert_true(before > 0);
                while (!mpm_finished(sim)) {
                    step(sim);
                    for (size_t k = 0; k < 3; k++) {
                        mpm_probe_value(sim, k, value);
                    }
                    mpm_balance(sim, &balance);
                }
                const size_t after = n_allocations;
                assert_int_equal(after, before);
                mpm_free(sim);
            }
        }
    }
#else
    skip(); // a sanitizer or the OpenMP runtime is in the way
#endif
}

static void test_sim_bytes_are_those_estimated(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            for (int kind = 0; kind < N_KINDS; kind++) {
                define(dim, kind);
                world.def.n_bodies = 2;
                world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
                struct mpm_estimate estimate;
                mpm_estimate(&world.def, &estimate);
                struct mpm_sim *sim = create();
                assert_int_equal(estimate.particles, mpm_n_particles(sim));
                assert_int_equal(estimate.nodes, mpm_n_nodes(sim));
                assert_near(estimate.dt, mpm_next_dt(sim), 0);
                assert_near(estimate.dt_limit, mpm_dt_limit(sim), 1e-15);
                assert_int_equal(mpm_bytes(sim), estimate.bytes);
                mpm_free(sim);
            }
        }
    }
    mpm_free(NULL);
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_sim_fixed_dt_takes_exactly_its_steps),
        cmocka_unit_test(test_sim_cfl_follows_the_speed),
        cmocka_unit_test(test_sim_end_can_be_moved),
        cmocka_unit_test(test_sim_stages_begin_and_end_on_time),
        cmocka_unit_test(test_sim_gravity_ramps_up),
        cmocka_unit_test(test_sim_stage_ends_at_rest),
        cmocka_unit_test(test_sim_stage_patches_materials),
        cmocka_unit_test(test_sim_change_is_checked),
        cmocka_unit_test(test_sim_change_lasts),
        cmocka_unit_test(test_sim_particle_that_leaves_is_a_status),
        cmocka_unit_test(test_sim_wild_velocities_are_a_status),
        cmocka_unit_test(test_sim_unstable_dt_is_a_status),
        cmocka_unit_test(test_sim_limit_counts_mass_damping),
        cmocka_unit_test(test_sim_exit_leaves_room_at_direct_walls),
        cmocka_unit_test(test_sim_check_finds_faults),
        cmocka_unit_test(test_sim_check_finds_faults_of_stages),
        cmocka_unit_test(test_sim_check_reports_all_faults),
        cmocka_unit_test(test_sim_steps_without_allocating),
        cmocka_unit_test(test_sim_bytes_are_those_estimated),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
