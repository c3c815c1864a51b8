// Columns at rest under their own weight, against exact solutions: water, and rubber at finite
// strain. Laterally confined, so that the stress is -rho0 g (H - Y) in the reference height Y
// whatever the material.
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/mpm.h"

static struct mpm_material_def material;
static struct mpm_body_def body;
static struct mpm_wall_def walls[3];
static struct mpm_stage_def stages[2];

struct column {
    int basis;
    enum mpm_fbar_scheme scheme;
    double height, gravity; // m, m/s^2
    int cells;              // over the height; two wide, 2 x 2 particles each
};

struct errors {
    double stress, position; // RMS; over rho g H, and over H
    double kinetic;          // kinetic energy left, over rho g H^2 per metre of width
};

// Position and vertical stress at reference height Y of the exact solution.
typedef double exact_position(const struct column *c, double Y);

static struct errors settle(const struct column *c, exact_position *position, double seconds) {
    const double h = c->height / c->cells;
    body = (struct mpm_body_def){
        .name = "column", .particles_per_direction = 2, .shape = {.max = {2 * h, c->height}}};
    for (int k = 0; k < 3; k++) {
        walls[k] = (struct mpm_wall_def){.name = k == 0 ? "floor" : "side",
                                         .axis = k == 0 ? 1 : 0,
                                         .at = k == 2 ? 2 * h : 0,
                                         .keeps_above = k < 2,
                                         .condition = MPM_WALL_SLIP};
    }
    // The load is brought up slowly, then the rest of the motion is damped away.
    stages[0] =
        (struct mpm_stage_def){.name = "settle", .duration = seconds, .gravity_ramp = seconds / 3};
    struct mpm_def def = mpm_def_default();
    def.domain_max[0] = 2 * h;
    def.domain_max[1] = c->height + 2 * h;
    def.cell = h;
    def.basis = (enum mpm_basis)c->basis;
    def.settings.gravity[1] = -c->gravity;
    def.settings.damping_local = 0.5;
    def.settings.fbar.scheme = c->scheme;
    def.n_materials = def.n_bodies = def.n_stages = 1;
    def.n_walls = 3;
    def.materials = &material;
    def.bodies = &body;
    def.walls = walls;
    def.stages = stages;
    def.wants_displacement = true;
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    while (!mpm_finished(sim)) {
        if (mpm_step(sim, &err)) {
            fail_msg("%s", err.message);
        }
    }
    const size_t n = mpm_n_particles(sim);
    double *x = malloc(2 * n * sizeof *x), *u = malloc(2 * n * sizeof *u),
           *stress = malloc(4 * n * sizeof *stress);
    mpm_field_copy(sim, MPM_FIELD_POSITION, x);
    mpm_field_copy(sim, MPM_FIELD_DISPLACEMENT, u);
    mpm_field_copy(sim, MPM_FIELD_STRESS, stress);
    struct errors e = {0};
    const double load = material.parameters[0] * c->gravity * c->height;
    for (size_t p = 0; p < n; p++) {
        const double Y = x[2 * p + 1] - u[2 * p + 1];
        e.stress += pow(stress[4 * p + 3] / load + (1 - Y / c->height), 2) / (double)n;
        e.position += pow((x[2 * p + 1] - position(c, Y)) / c->height, 2) / (double)n;
    }
    struct mpm_balance balance;
    mpm_balance(sim, &balance);
    e = (struct errors){.stress = sqrt(e.stress),
                        .position = sqrt(e.position),
                        .kinetic = balance.kinetic_energy / (load * c->height * 2 * h)};
    free(x);
    free(u);
    free(stress);
    mpm_free(sim);
    if (getenv("FBARD_LONG")) {
        print_message("%-8s %-8s %3d cells: stress %.2e, position %.2e, kinetic %.1e\n",
                      mpm_basis_name((enum mpm_basis)c->basis), mpm_fbar_name(c->scheme), c->cells,
                      e.stress, e.position, e.kinetic);
    }
    return e;
}

// ---- Water: p = -K (J - 1) = rho g (H - Y), so y = Y - rho g (H Y - Y^2/2)/K
// ---------------------

static double water_position(const struct column *c, double Y) {
    return Y - material.parameters[0] * c->gravity * (c->height * Y - Y * Y / 2) /
                   material.parameters[1];
}

static struct errors water(int basis, enum mpm_fbar_scheme scheme, int cells) {
    material = (struct mpm_material_def){.name = "water",
                                         .model = mpm_material_find("newtonian"),
                                         .parameters = {997.5, 2e7, 1e-3},
                                         .fbar = true};
    const struct column c = {
        .basis = basis, .scheme = scheme, .height = 2, .gravity = 9.81, .cells = cells};
    return settle(&c, water_position, 0.6); // 10 periods of 4 H/c
}

static bool smooth(int basis) {
    return basis == MPM_BSPLINE2 || basis == MPM_BSPLINE3;
}

static void check(const struct errors *e, double stress, double position) {
    if (!(e->stress < stress && e->position < position)) {
        fail_msg("stress is off by %.3g (allowed %.3g), position by %.3g (allowed %.3g)", e->stress,
                 stress, e->position, position);
    }
}

// Without F-bar the stress of linear elements is constant in a cell, so a quarter of a cell off at
// its particles: 1/(4 cells) of the load, first order; that of B-splines is smoother. Algorithm 1
// creeps (docs/method.md: 1.7 % at rest, uGIMP), which is of first order here; the anchored scheme
// does not (0.2 %), and comes to rest: 5e-6 of rho g H^2 still moves (cubic B-spline), 1e-9 with
// uGIMP.
static void test_column_of_water_is_hydrostatic(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            const struct errors coarse = water(basis, (enum mpm_fbar_scheme)scheme, 8),
                                fine = water(basis, (enum mpm_fbar_scheme)scheme, 16);
            switch (scheme) {
            case MPM_FBAR_OFF:
                check(&coarse, smooth(basis) ? 0.01 : 1.02 / 32, 2e-6);
                check(&fine, (smooth(basis) ? 0.4 : 0.52) * coarse.stress, 0.5 * coarse.position);
                break;
            case MPM_FBAR_ZHAO:
                check(&coarse, 0.03, 0.01);
                check(&fine, 0.6 * coarse.stress, 0.6 * coarse.position);
                break;
            default:
                check(&coarse, 0.005, 5e-4);
                check(&fine, fmax(0.85 * coarse.stress, 1e-3), 0.4 * coarse.position);
                assert_true(coarse.kinetic < 1e-5 && fine.kinetic < 1e-5); // and it is at rest
            }
        }
    }
}

// ---- Rubber: P(F) = mu (F - 1/F) + lambda ln F/F = -rho g (L - Y), y = integral of F ------------

static double stretch_at(const struct column *c, double Y) {
    const double E = material.parameters[1], nu = material.parameters[2];
    const double mu = E / (2 * (1 + nu)), lambda = E * nu / ((1 + nu) * (1 - 2 * nu));
    const double P = -material.parameters[0] * c->gravity * (c->height - Y);
    double low = 1e-3, high = 1; // P grows with F
    for (int k = 0; k < 60; k++) {
        const double F = (low + high) / 2;
        *(mu * (F - 1 / F) + lambda * log(F) / F > P ? &high : &low) = F;
    }
    return (low + high) / 2;
}

static double rubber_position(const struct column *c, double Y) {
    const int n = 200; // Simpson: relative error 1e-9
    double sum = 0;
    for (int k = 0; k <= n; k++) {
        sum += (k == 0 || k == n ? 1 : k % 2 ? 4 : 2) * stretch_at(c, Y * k / n);
    }
    return sum * Y / (3 * n);
}

static struct errors rubber(int basis, enum mpm_fbar_scheme scheme, double nu, int cells) {
    // Down to F = 0.48 at the foot with nu = 0; nearly incompressible, to 0.994.
    material = (struct mpm_material_def){.name = "rubber",
                                         .model = mpm_material_find("neo_hookean"),
                                         .parameters = {80, 1e4, nu},
                                         .fbar = true};
    const struct column c = {
        .basis = basis, .scheme = scheme, .height = 10, .gravity = 10, .cells = cells};
    return settle(&c, rubber_position, nu < 0.4 ? 60 : 8);
}

// The linear basis cannot: a particle that crosses into a cell of its own throws the far node away.
// uGIMP's fixed particle size leaves gaps or overlaps at this strain (docs/method.md keeps it as
// the paper has it), so it is not quite of first order; B-splines converge faster until the damped
// rest state itself is the limit (about 1e-4 of the height).
static void test_column_of_rubber_at_finite_strain(void **state) {
    (void)state;
    for (int basis = MPM_GIMP; basis < MPM_N_BASES; basis++) {
        const struct errors coarse = rubber(basis, MPM_FBAR_OFF, 0, 8),
                            fine = rubber(basis, MPM_FBAR_OFF, 0, 16);
        check(&coarse, smooth(basis) ? 0.02 : 0.06, smooth(basis) ? 1e-3 : 0.007);
        check(&fine, 0.7 * coarse.stress, 0.6 * coarse.position);
        if (getenv("FBARD_LONG")) {
            rubber(basis, MPM_FBAR_OFF, 0, 32);
        }
    }
}

// nu = 0.499, 0.6 % strain. Locking is no matter in a confined column. Algorithm 1's creep is: its
// positions are not tested (3 to 5 % of the height in 8 s), nor what it makes of linear elements.
static void test_column_of_rubber_nearly_incompressible(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        const struct errors off = rubber(basis, MPM_FBAR_OFF, 0.499, 8);
        check(&off, smooth(basis) ? 0.01 : 1.02 / 32, 1e-5);
        const struct errors anchored = rubber(basis, MPM_FBAR_ANCHORED, 0.499, 8);
        check(&anchored, 0.008, 1e-3);
        assert_true(anchored.kinetic < 5e-5); // 1.3e-5 (quadratic B-spline) and less
        if (basis != MPM_LINEAR) {
            const struct errors zhao = rubber(basis, MPM_FBAR_ZHAO, 0.499, 8);
            check(&zhao, 0.03, 0.1);
        }
    }
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_column_of_water_is_hydrostatic),
        cmocka_unit_test(test_column_of_rubber_at_finite_strain),
        cmocka_unit_test(test_column_of_rubber_nearly_incompressible),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
