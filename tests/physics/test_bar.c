// Axial vibration of a bar, fixed at one end, in its first mode: v = v0 cos(w t) sin(beta X) with
// beta = pi/(2 L), w = beta sqrt(E/rho), at a strain of 1 % (nu = 0, so that width plays no part).
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/mpm.h"

#define LENGTH 25.0
#define SPEED 0.1
#define PERIOD (4 * LENGTH / 10) // wave speed sqrt(E/rho) = 10 m/s

static struct mpm_material_def material;
static struct mpm_body_def body;
static struct mpm_wall_def wall;
static struct mpm_stage_def stage;

struct outcome {
    double period;    // from the zero crossings of the momentum, over the exact one
    double amplitude; // of the momentum in the last period, over the exact one
    double gained;    // largest total energy over the first, less 1
    double left;      // last total energy over the first
};

static struct outcome run(int basis, double h, int periods) {
    material = (struct mpm_material_def){
        .name = "bar", .model = mpm_material_find("neo_hookean"), .parameters = {1, 100, 0}};
    body = (struct mpm_body_def){
        .name = "bar",
        .particles_per_direction = 2,
        .shape = {.max = {LENGTH, h}},
        .velocity = {.kind = MPM_VELOCITY_MODE, .number = 1, .length = LENGTH, .amplitude = SPEED}};
    wall = (struct mpm_wall_def){
        .name = "clamp", .axis = 0, .keeps_above = true, .condition = MPM_WALL_SLIP};
    stage = (struct mpm_stage_def){.name = "main", .duration = periods * PERIOD};
    struct mpm_def def = mpm_def_default();
    def.domain_min[1] = -h;
    def.domain_max[0] = LENGTH + 2 * h;
    def.domain_max[1] = 2 * h;
    def.cell = h;
    def.basis = (enum mpm_basis)basis;
    def.n_materials = def.n_bodies = def.n_walls = def.n_stages = 1;
    def.materials = &material;
    def.bodies = &body;
    def.walls = &wall;
    def.stages = &stage;
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    struct mpm_balance b;
    mpm_balance(sim, &b);
    const double first = b.kinetic_energy + b.strain_energy;
    // Mean of sin(beta X) over the bar is 2/pi.
    const double momentum = b.mass * SPEED * 2 / M_PI;
    double before = b.momentum[0], t = 0, crossing = 0, since = -1;
    int crossings = 0;
    struct outcome o = {0};
    while (!mpm_finished(sim)) {
        if (mpm_step(sim, &err)) {
            fail_msg("%s", err.message);
        }
        mpm_balance(sim, &b);
        const double now = mpm_time(sim), energy = b.kinetic_energy + b.strain_energy;
        if (before > 0 && b.momentum[0] <= 0) { // once a period
            crossing = t + (now - t) * before / (before - b.momentum[0]);
            if (since < 0) {
                since = crossing;
            } else {
                crossings++;
            }
        }
        if (now > stage.duration - PERIOD) {
            o.amplitude = fmax(o.amplitude, fabs(b.momentum[0]) / momentum);
        }
        o.gained = fmax(o.gained, energy / first - 1);
        o.left = energy / first;
        before = b.momentum[0];
        t = now;
    }
    o.period = (crossing - since) / crossings / PERIOD;
    mpm_free(sim);
    if (getenv("FBARD_LONG")) {
        print_message(
            "%-8s h = %-5g period %+.2e, amplitude %.4f, energy gained %+.1e, left %.4f\n",
            mpm_basis_name((enum mpm_basis)basis), h, o.period - 1, o.amplitude, o.gained, o.left);
    }
    return o;
}

static void within(double value, double tol, const char *what) {
    if (!(fabs(value) <= tol)) {
        fail_msg("%s: %g is not within %g", what, value, tol);
    }
}

// Kinetic energy at t - dt/2 and strain energy at t: the symplectic step's total swings by w dt/2
// of itself about its mean, and must not grow beyond that.
static void check_energy(const struct outcome *o, double h) {
    const double dt = 0.3 * h / (10 + SPEED), w = 2 * M_PI / PERIOD;
    within(o->gained, 1.02 * w * dt / 2, "energy gained");
}

// Period, amplitude and energy lost in 5 periods are of second order in h, as the bases' second
// moments are; halving h must leave less than 0.4 of the error.
static void test_bar_vibrates_in_its_mode(void **state) {
    (void)state;
    for (int basis = MPM_GIMP; basis < MPM_N_BASES; basis++) {
        const struct outcome coarse = run(basis, 1, 5), fine = run(basis, 0.5, 5);
        within(coarse.period - 1, 2e-3, "period");
        within(fine.period - 1, 0.4 * fabs(coarse.period - 1), "period with half the cell");
        within(coarse.amplitude - 1, 4e-3, "amplitude");
        within(fine.amplitude - 1, 0.4 * fabs(coarse.amplitude - 1),
               "amplitude with half the cell");
        within(coarse.left - 1, 5e-3, "energy lost");
        within(fine.left - 1, 0.4 * fabs(coarse.left - 1), "energy lost with half the cell");
        check_energy(&coarse, 1);
        check_energy(&fine, 0.5);
        if (getenv("FBARD_LONG")) {
            const struct outcome finer = run(basis, 0.25, 5);
            within(finer.period - 1, 0.4 * fabs(fine.period - 1), "period with a quarter");
            within(finer.left - 1, 0.5 * fabs(fine.left - 1), "energy lost with a quarter");
        }
    }
}

// The linear basis too, as long as no particle crosses a node (the tip moves by 0.16 m).
static void test_bar_of_linear_elements(void **state) {
    (void)state;
    const struct outcome o = run(MPM_LINEAR, 1, 5);
    within(o.period - 1, 2e-3, "period");
    within(o.amplitude - 1, 4e-3, "amplitude");
    check_energy(&o, 1);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_bar_vibrates_in_its_mode),
        cmocka_unit_test(test_bar_of_linear_elements),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
