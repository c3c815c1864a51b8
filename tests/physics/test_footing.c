// A rough strip footing pressed into clay, the paper's section 4.2: load over settlement against
// the exact bearing capacity, 2 + pi times the undrained shear strength (Prandtl 1920).
//
// B = 1 m, right half, 2.5 B x 1.5 B of soil: Prandtl's mechanism (1.5 B wide, 0.71 B deep) fits
// in. Finite elements give 5.29 at h = B/10 and 5.22 at B/20 (docs/method.md).
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include <cmocka.h>

#include "server/mpm/mpm.h"

#define EXACT (2 + M_PI)
#define STRENGTH 100.0 // s_u, Pa
#define WIDE 2.5
#define DEEP 1.5
#define RATE 0.005 // m/s; at 0.04 m/s the load is all waves
#define DISTANCE 1e-3
#define AVERAGE 0.05 // s: waves ring by several per cent

static struct mpm_material_def material;
static struct mpm_body_def soil;
static struct mpm_wall_def walls[4];
static struct mpm_rigid_def footing;
static struct mpm_stage_def stage;
static struct mpm_probe_def probes[2];
static struct mpm_def def;

// h/n is the particles' spacing. The half of it to the right of the plane of symmetry, or all.
static struct mpm_sim *create_part(double h, int n, int basis, int scheme, bool whole) {
    material = (struct mpm_material_def){.name = "clay",
                                         .model = mpm_material_find("hencky_j2"),
                                         .parameters = {1000, 1e6, 0.49, STRENGTH * sqrt(3)},
                                         .fbar = true};
    soil = (struct mpm_body_def){.name = "soil",
                                 .shape = {.min = {whole ? -WIDE : 0, 0}, .max = {WIDE, DEEP}},
                                 .particles_per_direction = n};
    walls[0] = (struct mpm_wall_def){.name = whole ? "left" : "symmetry",
                                     .axis = 0,
                                     .at = whole ? -WIDE : 0,
                                     .keeps_above = true,
                                     .condition = MPM_WALL_SLIP};
    walls[1] =
        (struct mpm_wall_def){.name = "side", .axis = 0, .at = WIDE, .condition = MPM_WALL_SLIP};
    walls[2] = (struct mpm_wall_def){
        .name = "base", .axis = 1, .keeps_above = true, .condition = MPM_WALL_FIXED};
    footing = (struct mpm_rigid_def){.name = "footing",
                                     .shape = {.min = {-0.5, DEEP - h / n / 2 + DISTANCE},
                                               .max = {0.5, DEEP + 0.5}}, // from zero force on
                                     .velocity = {0, -RATE},
                                     .stiffness = 500,
                                     .distance = DISTANCE,
                                     .friction = 10};
    stage = (struct mpm_stage_def){.name = "main", .duration = 10};
    probes[0] = (struct mpm_probe_def){.name = "load",
                                       .kind = MPM_PROBE_REACTION,
                                       .wall = -1,
                                       .scale = 1 / (0.5 * STRENGTH),
                                       .average = AVERAGE};
    probes[1] = (struct mpm_probe_def){.name = "settlement",
                                       .kind = MPM_PROBE_DISPLACEMENT,
                                       .body = -1,
                                       .scale = 1,
                                       .has_box = true,
                                       .box_min = {0, DEEP - 0.75 * h / n},
                                       .box_max = {0.5, DEEP}};
    def = mpm_def_default();
    def.domain_min[0] = whole ? -WIDE : 0;
    def.domain_max[0] = WIDE;
    def.domain_max[1] = DEEP + 0.5;
    def.cell = h;
    def.basis = (enum mpm_basis)basis;
    def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
    def.settings.damping_local = 0.002;
    def.settings.dt = 1.529e-4 * h / 0.05; // 0.4 h/c
    def.n_materials = def.n_bodies = def.n_rigids = def.n_stages = 1;
    def.n_walls = 3;
    def.n_probes = 2;
    def.materials = &material;
    def.bodies = &soil;
    def.walls = walls;
    def.rigids = &footing;
    def.stages = &stage;
    def.probes = probes;
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    return sim;
}

// The same with walls that hold nodes, for B-splines as well.
static struct mpm_sim *create_held(double h, int n, int basis, int scheme) {
    mpm_free(create_part(h, n, basis, scheme, false));
    def.walls_hold_nodes = true;
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    return sim;
}

static struct mpm_sim *create(double h, int n, int basis, int scheme) {
    return create_part(h, n, basis, scheme, false);
}

// q/s_u at each of n settlements u/B of the particles under the footing.
static void press(struct mpm_sim *sim, int n, const double *at, double *load) {
    for (int k = 0; k < n;) {
        double q[MPM_MAX_COMPONENTS], u[MPM_MAX_COMPONENTS];
        struct mpm_error err = {0};
        if (mpm_step(sim, &err)) {
            fail_msg("%s", err.message);
        }
        mpm_probe_value(sim, 1, u);
        if (-u[1] >= at[k]) {
            mpm_probe_value(sim, 0, q);
            load[k++] = q[1];
        }
    }
    printf("    %s, F-bar %s, h = B/%g: q/s_u", mpm_basis_name(def.basis),
           mpm_fbar_name(def.settings.fbar.scheme), 1 / def.cell);
    for (int k = 0; k < n; k++) {
        printf(" %.3f (%.4f)", load[k], at[k]);
    }
    printf("\n");
    mpm_free(sim);
}

// The load of a mechanism that flows is flat; locked soil bears ever more.
struct expected {
    double low, high; // with F-bar, relative to the exact load
    double off;       // without, q/s_u at the end at least
};
static void compare(double h, int per_direction, int n, const double *at,
                    const struct expected *expected) {
    double load[8];
    for (int basis = MPM_GIMP; basis <= MPM_BSPLINE2; basis++) {
        const struct expected *e = &expected[basis - MPM_GIMP];
        press(create(h, per_direction, basis, MPM_FBAR_ZHAO), n, at, load);
        for (int k = 1; k < n; k++) {
            assert_true(load[k] > EXACT * e->low && load[k] < EXACT * e->high);
            assert_true(fabs(load[k] / load[1] - 1) < 0.015); // waves ring by 0.8 %
        }
        const double flowing = load[n - 1];
        press(create(h, per_direction, basis, MPM_FBAR_OFF), n, at, load);
        assert_true(load[n - 1] > e->off && load[n - 1] > 1.1 * flowing);
        assert_true(load[n - 1] > 1.02 * load[1]); // and still rising
    }
}

// Stiffer than finite elements, as at every resolution: 5.71 and 5.58 against their 5.29; without
// F-bar 9.6 and 6.5.
static void test_footing_meets_the_bearing_capacity(void **state) {
    (void)state;
    const double at[] = {0.001, 0.0018, 0.0025};
    const struct expected expected[] = {{1, 1.13, 9}, {1, 1.11, 6.2}};
    compare(0.1, 3, 3, at, expected);
}

// As far as the paper goes: 5.43 and 5.33; without F-bar 8.5 and 6.1.
static void test_footing_meets_the_bearing_capacity_on_a_finer_grid(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    const double at[] = {0.001, 0.002, 0.003, 0.004, 0.005, 0.006};
    const struct expected expected[] = {{0.97, 1.08, 7.5}, {0.97, 1.08, 5.9}};
    compare(0.05, 4, 6, at, expected);
}

// Without F-bar a quadratic B-spline bears 6.1 at u/B = 0.006 with our walls, and 6.65, rising,
// with walls that hold nodes as the prototype's, whose mark is 6.3 (see the last test).
static void test_footing_locks_more_where_nodes_are_held(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    const double at[] = {0.003, 0.006};
    double load[2];
    press(create_held(0.05, 4, MPM_BSPLINE2, MPM_FBAR_OFF), 2, at, load);
    assert_true(load[1] >= 6.3 && load[1] > 1.02 * load[0]);
}

// The paper's figure 9: the error of the contact pressure falls at a rate slightly below one. 0.91
// by least squares, from 10.6, 5.5 and 3.0 %; waves of 0.8 % of the load may move it by 0.15.
static void test_footing_converges_at_first_order(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    double at[21], load[21], error[3];
    for (int k = 0; k < 21; k++) {
        at[k] = 0.004 + 1e-4 * k;
    }
    for (int level = 0; level < 3; level++) {
        press(create(0.1 / (1 << level), 4, MPM_GIMP, MPM_FBAR_ZHAO), 21, at, load);
        error[level] = -1;
        for (int k = 0; k < 21; k++) {
            error[level] += load[k] / EXACT / 21;
        }
    }
    const double rate = log2(error[0] / error[2]) / 2; // of three: that of the outer two
    printf("    errors %.4f %.4f %.4f, rate %.2f\n", error[0], error[1], error[2], rate);
    assert_true(error[0] > error[1] && error[1] > error[2] && error[2] > 0);
    assert_true(rate > 0.75 && rate < 1.05);
}

// A mirror-folded wall is a plane of symmetry: the whole footing bears twice what its half does, to
// 4e-5. (What is left is the rule that FLIP's increment is taken from v^n before the boundary
// condition: v^n of a half is not 0 on the plane.) That is why B-splines lock less here than where
// the nodes on and behind a wall are merely held: held, the normal strain is 0 on the plane, half
// and whole differ by 0.6 to 1.7 % here, and without F-bar the footing at h = B/20 has 6.5 at u/B =
// 0.0025 and rises, where the folded one has 5.9.
static void test_footing_half_is_half_of_the_whole(void **state) {
    (void)state;
    for (int basis = MPM_BSPLINE2; basis <= MPM_BSPLINE3; basis++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            double load[2];
            for (int whole = 0; whole < 2; whole++) {
                struct mpm_sim *sim = create_part(0.1, 2, basis, scheme, whole);
                for (int k = 0; k < 400; k++) {
                    double q[MPM_MAX_COMPONENTS];
                    struct mpm_error err = {0};
                    if (mpm_step(sim, &err)) {
                        fail_msg("%s", err.message);
                    }
                    mpm_probe_value(sim, 0, q);
                    load[whole] = q[1];
                }
                mpm_free(sim);
            }
            if (!(fabs(load[1] / (2 * load[0]) - 1) < 1e-4)) {
                fail_msg("%s, F-bar %s: the half bears %.15g, the whole %.15g",
                         mpm_basis_name((enum mpm_basis)basis),
                         mpm_fbar_name((enum mpm_fbar_scheme)scheme), load[0], load[1]);
            }
        }
    }
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_footing_meets_the_bearing_capacity),
        cmocka_unit_test(test_footing_meets_the_bearing_capacity_on_a_finer_grid),
        cmocka_unit_test(test_footing_locks_more_where_nodes_are_held),
        cmocka_unit_test(test_footing_converges_at_first_order),
        cmocka_unit_test(test_footing_half_is_half_of_the_whole),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
