// The dam break of Zhao, Jiang and Choo, section 4.3, at a bulk modulus of 2e7 Pa (which changes
// the front by half a percent): fronts with F-bar and without, and the energy after the gate opens.
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/mpm.h"

// 4 m x 2 m of water in a tank 6 m long, n particles a cell and direction; the gate at x = 4 m goes
// at t = 0. The water splashes up to y = 8 m at the far wall.
static struct mpm_material_def water;
static struct mpm_body_def body;
static struct mpm_wall_def walls[6];
static struct mpm_stage_def stages[2];
static struct mpm_probe_def probes[1];
static const bool opens[6] = {false, false, false, true};

static struct mpm_def dam(int dim, int basis, enum mpm_fbar_scheme scheme, int n, double end) {
    const double h = 0.25;
    water = (struct mpm_material_def){.name = "water",
                                      .model = mpm_material_find("newtonian"),
                                      .parameters = {997.5, 2e7, 1e-3},
                                      .fbar = true};
    body = (struct mpm_body_def){
        .name = "water", .particles_per_direction = n, .shape = {.max = {4, 2, h}}};
    const struct {
        const char *name;
        int axis;
        double at;
        bool above;
    } places[] = {{"floor", 1, 0, true}, {"left", 0, 0, true}, {"right", 0, 6, false},
                  {"gate", 0, 4, false}, {"back", 2, 0, true}, {"front", 2, h, false}};
    for (int k = 0; k < 6; k++) {
        walls[k] = (struct mpm_wall_def){.name = places[k].name,
                                         .axis = places[k].axis,
                                         .at = places[k].at,
                                         .keeps_above = places[k].above,
                                         .condition = MPM_WALL_SLIP};
    }
    // At least 10 times 4 H/c = 0.57 s, damped, to the hydrostatic state.
    stages[0] =
        (struct mpm_stage_def){.name = "settle", .duration = 0.6, .states = MPM_SET_DAMPING};
    stages[0].settings.damping_local = 0.5;
    stages[1] = (struct mpm_stage_def){
        .name = "run", .duration = end, .resets = MPM_RESET_VELOCITY, .removes_wall = opens};
    probes[0] = (struct mpm_probe_def){.name = "front",
                                       .kind = MPM_PROBE_EXTENT,
                                       .body = -1,
                                       .max_side = true,
                                       .quantile = 1,
                                       .scale = 1};
    struct mpm_def def = mpm_def_default();
    def.dimension = dim;
    def.domain_max[0] = 6;
    def.domain_max[1] = 16;
    def.domain_max[2] = h;
    def.cell = h;
    def.basis = (enum mpm_basis)basis;
    def.settings.gravity[1] = -9.81;
    def.settings.cfl = 0.3;
    def.settings.fbar.scheme = scheme;
    def.n_materials = def.n_bodies = def.n_probes = 1;
    def.n_walls = dim == 3 ? 6 : 4;
    def.n_stages = 2;
    def.materials = &water;
    def.bodies = &body;
    def.walls = walls;
    def.stages = stages;
    def.probes = probes;
    return def;
}

struct outcome {
    double at_5, at_5_5;      // s, when the front passes (infinite if it does not)
    double energy, most, end; // J: total at the opening, its largest value after, and the last
    double volume_error;      // of sum V against mass/density, largest
    double drift;             // largest |ln V/V0|
};

// F-bar switched while the water flows.
struct change {
    double at; // s
    enum mpm_fbar_scheme scheme;
};

// Copies of what may not jump: stress, both volume ratios and density (so, volume), bit for bit.
static double *snapshot(const struct mpm_sim *sim, size_t *n) {
    const enum mpm_field fields[] = {MPM_FIELD_STRESS, MPM_FIELD_MEAN_STRESS,
                                     MPM_FIELD_VOLUME_RATIO_BAR, MPM_FIELD_DENSITY};
    double *all = calloc(mpm_n_particles(sim) * 7, sizeof *all);
    *n = 0;
    for (size_t k = 0; k < sizeof fields / sizeof *fields; k++) {
        mpm_field_copy(sim, fields[k], all + *n);
        *n += mpm_n_particles(sim) * mpm_field_components(fields[k], 2);
    }
    return all;
}

static void switch_fbar(struct mpm_sim *sim, enum mpm_fbar_scheme scheme) {
    size_t n;
    double *before = snapshot(sim, &n);
    struct mpm_settings settings = mpm_settings_now(sim);
    settings.fbar = (struct mpm_fbar){.scheme = scheme, .a = 0.05, .C = 1};
    assert_int_equal(mpm_change(sim, &settings, MPM_SET_FBAR, NULL), MPM_OK);
    double *after = snapshot(sim, &n);
    assert_memory_equal(before, after, n * sizeof *before);
    free(before);
    free(after);
}

static struct outcome run_switched(int dim, int basis, enum mpm_fbar_scheme scheme, int n,
                                   double end, const struct change *changes, size_t n_changes) {
    const struct mpm_def def = dam(dim, basis, scheme, n, end);
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    assert_int_equal(mpm_n_particles(sim), 16 * 8 * (dim == 2 ? n * n : n * n * n));
    struct outcome o = {.at_5 = INFINITY, .at_5_5 = INFINITY};
    double x = 4, t = 0;
    size_t changed = 0;
    double *ratio = malloc(mpm_n_particles(sim) * sizeof *ratio);
    while (!mpm_finished(sim)) {
        if (mpm_step(sim, &err)) {
            fail_msg("%s %s: %s", mpm_basis_name((enum mpm_basis)basis), mpm_fbar_name(scheme),
                     err.message);
        }
        if (mpm_stage(sim) == 0) {
            continue;
        }
        if (changed < n_changes && mpm_time(sim) >= changes[changed].at) {
            switch_fbar(sim, changes[changed++].scheme);
        }
        double front;
        struct mpm_balance balance;
        mpm_probe_value(sim, 0, &front);
        mpm_balance(sim, &balance);
        const double now = mpm_time(sim), energy = balance.kinetic_energy + balance.strain_energy +
                                                   balance.potential_energy;
        const double places[] = {5, 5.5};
        double *times[] = {&o.at_5, &o.at_5_5};
        for (int k = 0; k < 2; k++) {
            if (*times[k] == INFINITY && front >= places[k]) {
                *times[k] = t + (now - t) * (places[k] - x) / (front - x);
            }
        }
        if (now == 0) {
            o.energy = o.most = energy;
        }
        o.most = fmax(o.most, energy);
        o.end = energy;
        x = front;
        t = now;
    }
    assert_int_equal(changed, n_changes);
    mpm_field_copy(sim, MPM_FIELD_VOLUME_RATIO, ratio);
    for (size_t p = 0; p < mpm_n_particles(sim); p++) {
        o.volume_error += ratio[p] - 1;
        o.drift = fmax(o.drift, fabs(log(ratio[p])));
    }
    o.volume_error /= (double)mpm_n_particles(sim);
    free(ratio);
    mpm_free(sim);
    if (getenv("FBARD_LONG")) {
        print_message("%dD %s %s: x = 5 at %.4f s, 5.5 at %.4f s, most energy %+.2e, left %.3f, "
                      "volume %+.1e, largest |ln V/V0| %.3f\n",
                      dim, mpm_basis_name((enum mpm_basis)basis), mpm_fbar_name(scheme), o.at_5,
                      o.at_5_5, o.most / o.energy - 1, o.end / o.energy, o.volume_error, o.drift);
    }
    return o;
}

static struct outcome run(int dim, int basis, enum mpm_fbar_scheme scheme, int n, double end) {
    return run_switched(dim, basis, scheme, n, end, NULL, 0);
}

static void check_fronts(const struct outcome *o, double at_5, double at_5_5) {
    // 2 %: what two independent prototypes and the choice of K leave open.
    if (!(fabs(o->at_5 / at_5 - 1) < 0.02 && fabs(o->at_5_5 / at_5_5 - 1) < 0.02)) {
        fail_msg("the front passes 5 m at %.4f s and 5.5 m at %.4f s instead of %.3f and %.3f",
                 o->at_5, o->at_5_5, at_5, at_5_5);
    }
}

// The potential energy at the opening is measured from the floor; nothing may be added to the sum.
static void check_energy(const struct outcome *o) {
    if (!(o->most <= o->energy * (1 + 1e-3))) {
        fail_msg("the total energy rises by %.3g of its value at the opening",
                 o->most / o->energy - 1);
    }
}

// Measured with two prototypes (docs/method.md): 0.336 and 0.414 s with uGIMP, 0.347 and 0.426 s
// with folded quadratic B-splines.
static void test_dam_break_front_with_gimp(void **state) {
    (void)state;
    const struct outcome o = run(2, MPM_GIMP, MPM_FBAR_ZHAO, 5, 0.45);
    check_fronts(&o, 0.336, 0.414);
    check_energy(&o);
}

static void test_dam_break_front_with_bspline2(void **state) {
    (void)state;
    const struct outcome o = run(2, MPM_BSPLINE2, MPM_FBAR_ZHAO, 5, 0.45);
    check_fronts(&o, 0.347, 0.426);
    check_energy(&o);
}

static void test_dam_break_front_anchored(void **state) {
    (void)state;
    const struct outcome o = run(2, MPM_GIMP, MPM_FBAR_ANCHORED, 5, 0.45);
    check_fronts(&o, 0.336, 0.414);
    check_energy(&o);
    assert_true(o.drift < 0.05); // docs/method.md: volume ratios 0.98 .. 1.01
}

// Locked: more than 15 % late at both places.
static void test_dam_break_locks_without_fbar(void **state) {
    (void)state;
    const struct outcome o = run(2, MPM_GIMP, MPM_FBAR_OFF, 5, 0.49);
    if (!(o.at_5 > 1.15 * 0.336 && o.at_5_5 > 1.15 * 0.414)) {
        fail_msg("the front passes 5 m at %.4f s and 5.5 m at %.4f s", o.at_5, o.at_5_5);
    }
    check_energy(&o);
}

// On, off, on, anchored and off again as it flows: nothing jumps at a switch, no energy appears
// after it, and the front comes between those with F-bar all the time and never.
static void test_dam_break_switched_in_mid_run(void **state) {
    (void)state;
    const struct change changes[] = {
        {0.05, MPM_FBAR_OFF}, {0.12, MPM_FBAR_ZHAO}, {0.2, MPM_FBAR_ANCHORED}, {0.3, MPM_FBAR_OFF}};
    const int bases[] = {MPM_GIMP, MPM_BSPLINE2};
    for (int k = 0; k < 2; k++) {
        const struct outcome o = run_switched(2, bases[k], MPM_FBAR_ZHAO, 5, 0.45, changes,
                                              sizeof changes / sizeof *changes);
        check_energy(&o);
        const double on = bases[k] == MPM_GIMP ? 0.336 : 0.347;
        const double off = bases[k] == MPM_GIMP ? 0.402 : 0.355; // docs/method.md, prototypes
        if (!(o.at_5 > 0.98 * on && o.at_5 < 1.02 * off)) {
            fail_msg("%s: the front passes 5 m at %.4f s, not between %.3f and %.3f",
                     mpm_basis_name((enum mpm_basis)bases[k]), o.at_5, on, off);
        }
    }
}

static void test_dam_break_to_2s(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    for (int basis = MPM_GIMP; basis < MPM_N_BASES; basis++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            const struct outcome o = run(2, basis, (enum mpm_fbar_scheme)scheme, 5, 2);
            check_energy(&o);
            if (scheme == MPM_FBAR_ANCHORED) {
                assert_true(o.drift < 0.1);
            }
        }
    }
}

// One cell of it in 3D between rollers is plane strain: a fluid's F-bar knows no F33.
static void test_dam_break_slice_in_3d(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    for (int basis = MPM_GIMP; basis <= MPM_BSPLINE2; basis++) {
        const struct outcome flat = run(2, basis, MPM_FBAR_ZHAO, 2, 0.45),
                             slice = run(3, basis, MPM_FBAR_ZHAO, 2, 0.45);
        // The same equations; but in a splash round-off grows.
        if (!(fabs(slice.at_5 / flat.at_5 - 1) < 1e-3)) {
            fail_msg("the front passes 5 m at %.5f s instead of %.5f s", slice.at_5, flat.at_5);
        }
        check_energy(&slice);
    }
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_dam_break_front_with_gimp),
        cmocka_unit_test(test_dam_break_front_with_bspline2),
        cmocka_unit_test(test_dam_break_front_anchored),
        cmocka_unit_test(test_dam_break_switched_in_mid_run),
        cmocka_unit_test(test_dam_break_locks_without_fbar),
        cmocka_unit_test(test_dam_break_to_2s),
        cmocka_unit_test(test_dam_break_slice_in_3d),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
