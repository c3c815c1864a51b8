// Cook's membrane, the paper's section 4.1: a clamped trapezoid of nearly incompressible rubber
// under a shear load on its right edge. Pressure and the displacement of the loaded column against
// finite elements (P2/P1 on three meshes, 1.5e-4 Pa and 1.4e-5 m apart; tests/data/).
//
// tests/data/ has the FEM values at the particles of h = 1, 0.25 + 0.5 k. A particle of h = 2 is
// the centre of four of them, and is compared with their mean: that differs from the value at the
// centre by (0.25 m)^2/2 times the Laplacian, nothing here. Those on the slanted edges that have
// not all four are left out.
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/mpm.h"

#define CORNER 6.0 // m around (0, 44), where the exact stress is singular: left out
#define MAX_X 96   // columns and rows of the FEM's points
#define MAX_Y 120

static double fem_stress[MAX_X][MAX_Y], fem_column[2][MAX_Y]; // NaN where there is no point

static FILE *open_data(const char *name) {
    char path[256];
    snprintf(path, sizeof path, "tests/data/%s", name);
    FILE *in = fopen(path, "r");
    if (!in) {
        fail_msg("%s: run from the root of the repository", path);
    }
    while (fgetc(in) != '\n') { // the heading
    }
    return in;
}

static void read_fem(void) {
    for (int i = 0; i < MAX_X; i++) {
        for (int j = 0; j < MAX_Y; j++) {
            fem_stress[i][j] = NAN;
        }
    }
    FILE *in = open_data("cook_mean_stress.csv");
    double X, Y, value;
    int n = 0;
    while (fscanf(in, "%lf,%lf", &X, &Y) == 2) {
        for (int j = (int)(2 * Y); fscanf(in, ",%lf", &value) == 1; j++) {
            fem_stress[(int)(2 * X)][j] = value;
            n++;
        }
    }
    fclose(in);
    assert_int_equal(n, 5776);
    for (int j = 0; j < MAX_Y; j++) {
        fem_column[0][j] = fem_column[1][j] = NAN;
    }
    in = open_data("cook_loaded_columns.csv");
    while (fscanf(in, "%lf,%lf,%lf", &X, &Y, &value) == 3) {
        fem_column[X > 47.5][(int)(2 * Y)] = value;
    }
    fclose(in);
}

// The FEM's values at a point of the lattice of spacing h/2, NaN where they are not known.
static double fem_at(double h, double X, double Y) {
    const int i = (int)(2 * X), j = (int)(2 * Y);
    if (h == 1) {
        return fem_stress[i][j];
    }
    return (fem_stress[i][j] + fem_stress[i - 1][j] + fem_stress[i][j - 1] +
            fem_stress[i - 1][j - 1]) /
           4;
}
static double fem_column_at(double h, double Y) {
    const int j = (int)(2 * Y);
    return h == 1 ? fem_column[1][j]
                  : (fem_column[0][j] + fem_column[1][j] + fem_column[0][j - 1] +
                     fem_column[1][j - 1]) /
                        4;
}

static struct mpm_material_def material;
static struct mpm_body_def body;
static struct mpm_wall_def clamp;
static struct mpm_load_def load;
static struct mpm_stage_def stage;
static struct mpm_def def;
static double *x0, *buffer;
static size_t n;

static struct mpm_sim *create(double h, int basis, int scheme, double cfl) {
    static const double corners[] = {0, 0, 48, 44, 48, 60, 0, 44};
    read_fem();
    material = (struct mpm_material_def){.name = "rubber",
                                         .model = mpm_material_find("neo_hookean"),
                                         .parameters = {1, 70, 0.499},
                                         .fbar = true};
    body = (struct mpm_body_def){
        .name = "membrane",
        .shape = {.kind = MPM_SHAPE_POLYGON, .n_points = 4, .points = corners},
        .particles_per_direction = 2,
        .closed = true};
    clamp = (struct mpm_wall_def){
        .name = "clamp", .axis = 0, .keeps_above = true, .condition = MPM_WALL_FIXED};
    load = (struct mpm_load_def){.name = "shear", .max_side = true, .force = {0, 1}};
    stage = (struct mpm_stage_def){.name = "main", .duration = 1000};
    def = mpm_def_default();
    def.domain_min[1] = -4;
    def.domain_max[0] = 54;
    def.domain_max[1] = 68;
    def.cell = h;
    def.basis = (enum mpm_basis)basis;
    def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
    def.settings.damping_mass = 0.2;
    def.settings.cfl = cfl;
    def.n_materials = def.n_bodies = def.n_walls = def.n_loads = def.n_stages = 1;
    def.materials = &material;
    def.bodies = &body;
    def.walls = &clamp;
    def.loads = &load;
    def.stages = &stage;
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    n = mpm_n_particles(sim);
    assert_int_equal(n, h == 1 ? 5776 : 1448);
    x0 = malloc(n * 2 * sizeof *x0);
    buffer = malloc(n * 2 * sizeof *buffer);
    mpm_field_copy(sim, MPM_FIELD_POSITION, x0);
    return sim;
}

static void close_run(struct mpm_sim *sim) {
    mpm_free(sim);
    free(x0);
    free(buffer);
}

static void advance(struct mpm_sim *sim, double end) {
    struct mpm_error err = {0};
    while (mpm_time(sim) < end) {
        if (mpm_step(sim, &err)) {
            fail_msg("%s", err.message);
        }
    }
}

// RMS of the error of the mean normal stress, over the standard deviation of the FEM's, `corner`
// metres around the singular one left out.
static double pressure_error(const struct mpm_sim *sim, double corner) {
    double error2 = 0, sum = 0, sum2 = 0, count = 0;
    mpm_field_copy(sim, MPM_FIELD_MEAN_STRESS, buffer);
    for (size_t p = 0; p < n; p++) {
        const double X = x0[2 * p], Y = x0[2 * p + 1], fem = fem_at(def.cell, X, Y);
        if (hypot(X, Y - 44) >= corner && !isnan(fem)) {
            error2 += (buffer[p] - fem) * (buffer[p] - fem);
            sum += fem;
            sum2 += fem * fem;
            count++;
        }
    }
    assert_true(count > 0.94 * (double)n); // the corner is 2.4 %, the edges of h = 2 some more
    return sqrt(error2 / count) / sqrt(sum2 / count - sum / count * (sum / count));
}

// Vertical displacement of the loaded column over the FEM's at the same points, less 1.
static double column_error(const struct mpm_sim *sim) {
    double u = 0, fem = 0, count = 0;
    mpm_field_copy(sim, MPM_FIELD_POSITION, buffer);
    for (size_t p = 0; p < n; p++) {
        const double at = fem_column_at(def.cell, x0[2 * p + 1]);
        if (x0[2 * p] > 48 - def.cell / 2 && !isnan(at)) {
            u += buffer[2 * p + 1] - x0[2 * p + 1];
            fem += at;
            count++;
        }
    }
    assert_true(count >= 32 / def.cell - 1);
    return u / fem - 1;
}

struct errors {
    double pressure, everywhere, column; // pressure without the corner, and with it
};
static struct errors measure(const struct mpm_sim *sim) {
    const struct errors e = {pressure_error(sim, CORNER), pressure_error(sim, 0),
                             column_error(sim)};
    if (getenv("FBARD_LONG")) {
        print_message(
            "h = %g %-8s %-8s cfl %.2f t = %5.1f s: pressure error %.3f (%.3f with the corner), "
            "column %+.2f %%\n",
            def.cell, mpm_basis_name(def.basis), mpm_fbar_name(def.settings.fbar.scheme),
            def.settings.cfl, mpm_time(sim), e.pressure, e.everywhere, 100 * e.column);
    }
    return e;
}

static struct errors run(double h, int basis, int scheme, double cfl, double end) {
    struct mpm_sim *sim = create(h, basis, scheme, cfl);
    advance(sim, end);
    const struct errors e = measure(sim);
    close_run(sim);
    return e;
}

#define below(value, limit) below_at(value, limit, __LINE__)
static void below_at(double value, double limit, int line) {
    if (!(value < limit)) {
        print_error("%g is not below %g\n", value, limit);
        _fail(__FILE__, line);
    }
}

// Pressure of the standard MPM is noise: 6.3 (uGIMP) and 1.1 (B-spline) times the whole variation
// of the true one at h = 2 (method.md: 4.7 and 1.3 at h = 1). The B-spline's grows with time, 0.83
// at 15 s.
static void test_cook_locks_without_fbar(void **state) {
    (void)state;
    below(3, run(2, MPM_GIMP, MPM_FBAR_OFF, 0.3, 15).pressure);
    below(1, run(2, MPM_BSPLINE2, MPM_FBAR_OFF, 0.3, 38).pressure);
}

// With F-bar it is 0.10 to 0.15 of it at h = 2: the error of the cells, and what still swings at
// these times (0.2 1/s of damping: exp(-t/10 s) of the load).
static void test_cook_pressure_of_fbar(void **state) {
    (void)state;
    for (int basis = MPM_GIMP; basis <= MPM_BSPLINE2; basis++) {
        below(run(2, basis, MPM_FBAR_ZHAO, 0.3, 25).pressure, 0.25);
        const struct errors e = run(2, basis, MPM_FBAR_ANCHORED, 0.5, 50);
        below(e.pressure, 0.2);
        below(fabs(e.column), 0.02); // exp(-5) = 0.7 % still swings; 0.3 % shown
    }
}

// h = 1 at the paper's time. Algorithm 1 creeps (docs/method.md), so that only its pressure is
// compared. Standard quadratic B-splines: the pressure is off by 1.34 over all particles and by
// 0.67 without those 6 m around the corner, since its noise sits at the edges: 1.4 within two cells
// of them, 0.23 away from them. A prototype's 1.30 must be with the corner, then. An independent
// transcription of the method (other code for basis, walls, law and sums; particles from the FEM's
// table) gives the same three digits at 38 s: 1.338, 0.666 and -2.68 % for the column; with the
// clamp's nodes held instead of folded 1.249 and 0.655. uGIMP's noise is everywhere: 4.653 and
// 4.043 in both codes (a prototype: 4.67).
static void test_cook_at_h_1(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    below(3, run(1, MPM_GIMP, MPM_FBAR_OFF, 0.3, 38).pressure);
    const struct errors smooth = run(1, MPM_BSPLINE2, MPM_FBAR_OFF, 0.3, 38);
    below(0.6, smooth.pressure);
    below(1.2, smooth.everywhere);
    for (int basis = MPM_GIMP; basis <= MPM_BSPLINE3; basis++) {
        below(run(1, basis, MPM_FBAR_ZHAO, 0.3, 38).pressure, 0.2);
        below(run(1, basis, MPM_FBAR_ANCHORED, 0.3, 38).pressure, 0.2);
    }
}

// The anchored scheme comes to rest within 2 % of the FEM, whatever the time step.
static void test_cook_does_not_creep_when_anchored(void **state) {
    (void)state;
    if (!getenv("FBARD_LONG")) {
        skip();
    }
    const double cfl[] = {0.5, 0.3, 0.15};
    for (double h = 2; h >= 1; h -= 1) {
        for (int basis = MPM_GIMP; basis <= MPM_BSPLINE2; basis++) {
            for (int k = 0; k < 3; k++) {
                struct mpm_sim *sim = create(h, basis, MPM_FBAR_ANCHORED, cfl[k]);
                for (double t = 60; t <= 240; t += 20) {
                    advance(sim, t);
                    const struct errors e = measure(sim);
                    below(fabs(e.column), 0.02);
                    below(e.pressure, 0.2);
                }
                close_run(sim);
            }
        }
    }
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_cook_locks_without_fbar),
        cmocka_unit_test(test_cook_pressure_of_fbar),
        cmocka_unit_test(test_cook_at_h_1),
        cmocka_unit_test(test_cook_does_not_creep_when_anchored),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
