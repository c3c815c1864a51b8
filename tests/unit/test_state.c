// Saved states and determinism: a run that is interrupted, or uses more threads, has the same bits.
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/mpm.h"

// A fluid, a rubber block and one of clay on it behind a gate, thrown at the walls, F-bar excepted
// for none; three stages, of which the second is under way when the state is saved. Probes of all
// the kinds that keep something between steps.
static struct {
    struct mpm_def def;
    struct mpm_material_def materials[3], patched[3];
    struct mpm_body_def bodies[3];
    struct mpm_stage_def stages[3];
    struct mpm_wall_def walls[4];
    struct mpm_probe_def probes[4];
    bool removes[4];
} world;

#define N_STEPS 60 // 20 in each stage
#define SAVED_AT 27

static void define(int dim, int basis, int scheme, int n_threads) {
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.materials[0] = (struct mpm_material_def){.name = "water",
                                                   .model = mpm_material_find("newtonian"),
                                                   .parameters = {1000, 1e5, 1},
                                                   .fbar = true};
    world.materials[1] = (struct mpm_material_def){.name = "rubber",
                                                   .model = mpm_material_find("neo_hookean"),
                                                   .parameters = {800, 5e4, 0.45},
                                                   .fbar = true};
    world.materials[2] = (struct mpm_material_def){.name = "clay",
                                                   .model = mpm_material_find("hencky_j2"),
                                                   .parameters = {900, 5e4, 0.45, 300, 100, 20},
                                                   .fbar = true};
    memcpy(world.patched, world.materials, sizeof world.patched);
    world.patched[1].parameters[1] = 4e4;
    world.patched[2].parameters[3] = 200;
    for (int b = 0; b < 3; b++) {
        world.bodies[b] = (struct mpm_body_def){
            .name = b == 2 ? "lump"
                    : b    ? "block"
                           : "pool",
            .material = b,
            .particles_per_direction = dim == 2 ? 4 : 2,
            .shape = {.min = {0, b ? 0.25 + b * 0.25 : 0, 0}, .max = {0.5, 0.5 + b * 0.25, 0.25}},
            .velocity = {.vector = {0.3, -0.5 * b, 0.1}}};
    }
    world.def.domain_min[0] = world.def.domain_min[1] = world.def.domain_min[2] = -0.5;
    world.def.domain_max[0] = world.def.domain_max[1] = world.def.domain_max[2] = 1.5;
    for (int k = 0; k < 4; k++) {
        world.walls[k] =
            (struct mpm_wall_def){.name = "wall",
                                  .axis = k == 1   ? 1
                                          : k == 3 ? dim - 1
                                                   : 0,
                                  .at = k == 2 ? 0.5 : 0,
                                  .keeps_above = k != 2,
                                  .condition = k == 0 ? MPM_WALL_SEPARATE : MPM_WALL_SLIP};
    }
    world.walls[1].velocity[0] = 0.1; // without effect on a slip wall but for its work
    for (int k = 0; k < 3; k++) {
        world.stages[k] = (struct mpm_stage_def){.name = "stage", .duration = 0.02};
    }
    world.removes[2] = true;
    world.stages[1].removes_wall = world.removes;
    world.stages[1].materials = world.patched;
    world.stages[1].resets = MPM_RESET_PLASTIC_STRAIN;
    world.stages[1].gravity_ramp = 0.015;
    world.stages[1].states = MPM_SET_GRAVITY | MPM_SET_BLEND | MPM_SET_DAMPING;
    world.stages[1].settings = mpm_settings_default();
    world.stages[1].settings.gravity[0] = 5;
    world.stages[1].settings.blend = 0.9;
    world.stages[1].settings.damping_local = 0.1;
    world.probes[0] = (struct mpm_probe_def){.kind = MPM_PROBE_REACTION, .wall = 1, .body = -1};
    world.probes[1] = (struct mpm_probe_def){
        .kind = MPM_PROBE_MEAN, .field = MPM_FIELD_STRESS, .body = 1, .average = 0.008};
    world.probes[2] = (struct mpm_probe_def){.kind = MPM_PROBE_DISPLACEMENT, .at = {0.3, 0.6}};
    world.probes[3] = (struct mpm_probe_def){.kind = MPM_PROBE_DRIFT, .body = -1};
    for (int k = 0; k < 4; k++) {
        world.probes[k].name = "probe";
        world.probes[k].scale = 1;
    }
    world.def.dimension = dim;
    world.def.basis = (enum mpm_basis)basis;
    world.def.cell = 0.125;
    world.def.settings.dt = 1e-3;
    world.def.settings.gravity[1] = -10;
    world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
    world.def.n_threads = n_threads;
    world.def.n_materials = world.def.n_bodies = 3;
    world.def.n_stages = 3;
    world.def.n_walls = 3 + (dim == 3);
    world.def.n_probes = 4;
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

static void advance(struct mpm_sim *sim, int n) {
    for (int k = 0; k < n; k++) {
        struct mpm_error err = {0};
        if (mpm_step(sim, &err)) {
            fail_msg("%s", err.message);
        }
    }
}

// All that can be seen of a simulation.
struct view {
    size_t bytes;
    char *memory;
};
static struct view look(struct mpm_sim *sim, int dim) {
    const size_t n = mpm_n_particles(sim);
    struct view v = {.memory = calloc(MPM_N_FIELDS * 9 * n + 1000, sizeof(double))};
    for (int f = 0; f < MPM_N_FIELDS; f++) {
        mpm_field_copy(sim, (enum mpm_field)f, v.memory + v.bytes);
        v.bytes += n * mpm_field_components((enum mpm_field)f, dim) * sizeof(double);
    }
    for (size_t k = 0; k < 4; k++) {
        mpm_probe_value(sim, k, (double *)(v.memory + v.bytes));
        v.bytes += mpm_probe_components(sim, k) * sizeof(double);
    }
    struct mpm_balance balance;
    mpm_balance(sim, &balance);
    memcpy(v.memory + v.bytes, &balance, sizeof balance);
    v.bytes += sizeof balance;
    const double clock[] = {mpm_time(sim), mpm_next_dt(sim), (double)mpm_step_count(sim),
                            (double)mpm_stage(sim)};
    memcpy(v.memory + v.bytes, clock, sizeof clock);
    v.bytes += sizeof clock;
    return v;
}

static void same(struct mpm_sim *a, struct mpm_sim *b, int dim) {
    const struct view u = look(a, dim), v = look(b, dim);
    assert_int_equal(u.bytes, v.bytes);
    assert_memory_equal(u.memory, v.memory, u.bytes);
    free(u.memory);
    free(v.memory);
}

#define FOR_CASES(dim, basis, scheme)                                                              \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int basis = 0; basis < MPM_N_BASES; basis++)                                          \
            for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++)

static void test_state_continues_with_the_same_bits(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme) {
        define(dim, basis, scheme, 1);
        struct mpm_sim *whole = create(), *first = create(), *second = create();
        advance(whole, N_STEPS);
        advance(first, SAVED_AT);
        double a[2048], flowed = 0; // the clay has flowed since its reset
        assert_true(mpm_n_particles(first) <= 2048);
        mpm_field_copy(first, MPM_FIELD_PLASTIC_STRAIN, a);
        for (size_t p = 0; p < mpm_n_particles(first); p++) {
            flowed += a[p];
        }
        assert_true(flowed > 0);
        assert_int_equal(mpm_stage(first), 1);
        const size_t bytes = mpm_state_bytes(first);
        void *saved = malloc(bytes);
        mpm_state_save(first, saved);
        assert_int_equal(mpm_state_load(second, saved, bytes, NULL), MPM_OK);
        same(first, second, dim);
        mpm_free(first);
        advance(second, N_STEPS - SAVED_AT);
        assert_true(mpm_finished(second) && mpm_finished(whole));
        same(whole, second, dim);
        mpm_free(whole);
        mpm_free(second);
        free(saved);
    }
}

// Settings changed since the start are part of the state, and so is an F-bar scheme for which the
// fresh simulation has no memory yet.
static void test_state_carries_changed_settings(void **state) {
    (void)state;
    for (int scheme = MPM_FBAR_ZHAO; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
        define(2, MPM_BSPLINE2, MPM_FBAR_OFF, 1);
        struct mpm_sim *whole = create(), *second = create();
        advance(whole, 10);
        struct mpm_settings to = {
            .fbar = {.scheme = (enum mpm_fbar_scheme)scheme, .a = 0.1, .C = 0.5},
            .blend = 0.95,
            .dt = 5e-4};
        assert_int_equal(mpm_change(whole, &to, MPM_SET_FBAR | MPM_SET_BLEND | MPM_SET_TIME, NULL),
                         MPM_OK);
        assert_int_equal(mpm_change_end(whole, 0.03, NULL), MPM_OK);
        advance(whole, 5);
        const size_t bytes = mpm_state_bytes(whole);
        void *saved = malloc(bytes);
        mpm_state_save(whole, saved);
        assert_int_equal(mpm_state_load(second, saved, bytes, NULL), MPM_OK);
        free(saved);
        while (!mpm_finished(whole)) {
            advance(whole, 1);
            advance(second, 1);
        }
        same(whole, second, 2);
        mpm_free(whole);
        mpm_free(second);
    }
}

static void test_state_that_does_not_fit_is_refused(void **state) {
    (void)state;
    define(2, MPM_GIMP, MPM_FBAR_ZHAO, 1);
    struct mpm_sim *sim = create();
    advance(sim, SAVED_AT);
    const size_t bytes = mpm_state_bytes(sim);
    char *saved = malloc(bytes + 8);
    mpm_state_save(sim, saved);
    mpm_free(sim);

    sim = create();
    const struct view before = look(sim, 2);
    struct mpm_error err = {0};
    assert_int_equal(mpm_state_load(sim, saved, bytes - 1, &err), MPM_ERR_STATE);
    assert_int_equal(err.status, MPM_ERR_STATE);
    assert_int_equal(mpm_state_load(sim, saved, bytes + 8, NULL), MPM_ERR_STATE);
    assert_int_equal(mpm_state_load(sim, saved, 0, NULL), MPM_ERR_STATE);
    assert_int_equal(mpm_state_load(sim, saved, 12, NULL), MPM_ERR_STATE);
    saved[0] ^= 1;
    assert_int_equal(mpm_state_load(sim, saved, bytes, &err), MPM_ERR_STATE);
    assert_non_null(strstr(err.message, "another build"));
    saved[0] ^= 1;
    const struct view after = look(sim, 2);
    assert_memory_equal(before.memory, after.memory, before.bytes); // untouched
    free(before.memory);
    free(after.memory);
    mpm_free(sim);

    // Another scene: other basis, other particles, fewer stages.
    define(2, MPM_BSPLINE2, MPM_FBAR_ZHAO, 1);
    sim = create();
    assert_int_equal(mpm_state_load(sim, saved, bytes, NULL), MPM_ERR_STATE);
    mpm_free(sim);
    define(2, MPM_GIMP, MPM_FBAR_ZHAO, 1);
    world.bodies[1].shape.max[0] = 0.375;
    sim = create();
    assert_int_equal(mpm_state_load(sim, saved, bytes, NULL), MPM_ERR_STATE);
    mpm_free(sim);
    define(2, MPM_GIMP, MPM_FBAR_ZHAO, 1);
    world.def.n_stages = 1;
    sim = create();
    assert_int_equal(mpm_state_load(sim, saved, bytes, NULL), MPM_ERR_STATE);
    mpm_free(sim);
    free(saved);
}

// More particles than one chunk (1024), so that the threads share them.
static void test_state_does_not_depend_on_threads(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme) {
        if (dim == 3 && basis != MPM_GIMP) {
            continue; // the sharing is the same code
        }
        struct mpm_sim *one = NULL;
        for (int n_threads = 1; n_threads <= 3; n_threads++) {
            define(dim, basis, scheme, n_threads);
            if (dim == 2) {
                world.bodies[0].particles_per_direction = 12; // 2304
            } else {
                world.bodies[0].particles_per_direction = 4; // 2048
            }
            struct mpm_sim *sim = create();
            advance(sim, 25);
            if (!one) {
                one = sim;
            } else {
                same(one, sim, dim);
                mpm_free(sim);
            }
        }
        mpm_free(one);
    }
}

// The same definition gives the same bits again; nothing is kept outside the simulation.
static void test_state_of_two_simulations_is_apart(void **state) {
    (void)state;
    define(2, MPM_GIMP, MPM_FBAR_ANCHORED, 1);
    struct mpm_sim *a = create(), *b = create(), *c = create();
    advance(c, N_STEPS);
    for (int k = 0; k < N_STEPS; k++) { // in turns
        advance(a, 1);
        advance(b, 1);
    }
    same(a, b, 2);
    same(a, c, 2);
    mpm_free(a);
    mpm_free(b);
    mpm_free(c);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_state_continues_with_the_same_bits),
        cmocka_unit_test(test_state_carries_changed_settings),
        cmocka_unit_test(test_state_that_does_not_fit_is_refused),
        cmocka_unit_test(test_state_does_not_depend_on_threads),
        cmocka_unit_test(test_state_of_two_simulations_is_apart),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
