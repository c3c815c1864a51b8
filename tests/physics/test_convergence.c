// Observed rates of convergence of error probes under refinement of the verification scenes, at a
// fixed number of particles per cell and a fixed CFL number; two resolutions in `make check`, three
// with FBARD_LONG=1, which prints them.
//
// The bases' second moments and the step are of second and first order, and the quadrature on
// particles of second order while they still lie about as they were seeded: hence early times.
// Later the noise that FLIP keeps in its null space takes over, and finer cells do not help
// (scenes/README.md). A free edge in steps of a particle is of first order in displacement, and of
// order 1/2 in an L2 norm of the stress: a layer of the width of a cell is off.
#include "tests/physics/scene_run.h"

struct series {
    const char *scene, *patch, *body;
    int particles_per_cell;
    double time, coarse; // s, m: of the coarsest cell
    const char *probes[3];
    double rates[3]; // at least, log2 of the ratio of errors
};

static void check(const struct series *s) {
    const int n = getenv("FBARD_LONG") ? 3 : 2;
    double before[3] = {0};
    for (int level = 0; level < n; level++) {
        char patch[400];
        const double h = s->coarse / (1 << level);
        snprintf(patch, sizeof patch,
                 "{\"cell\":%g,\"bodies\":{\"%s\":{\"particles_per_cell\":%d}}%s%s}", h, s->body,
                 s->particles_per_cell, *s->patch ? "," : "", s->patch);
        struct scene_run run = scene_run_open(s->scene, patch);
        scene_run_to(&run, s->time);
        for (int k = 0; k < 3 && s->probes[k]; k++) {
            const double error = scene_run_value(&run, s->probes[k]);
            const double rate = level ? log2(before[k] / error) : INFINITY;
            if (getenv("FBARD_LONG"))
                print_message("%-22s %-28s h = %-8g %-18s %.3e  rate %.2f\n", s->scene, s->patch, h,
                              s->probes[k], error, rate);
            if (!(rate >= s->rates[k]))
                fail_msg("%s at h = %g: %s converges at the rate %.2f and not %.2f (error %g)",
                         s->scene, h, s->probes[k], rate, s->rates[k], error);
            before[k] = error;
        }
        scene_run_close(&run);
    }
}

// At a quarter of the swing, shear up to 2.2: 2.2 and 2.2 in displacement, 2.0 and 1.7 in stress
// (B-spline, nu = 0.3).
static void test_convergence_of_the_vortex(void **state) {
    (void)state;
    check(&(struct series){.scene = "vortex",
                           .patch = "",
                           .body = "ring",
                           .particles_per_cell = 4,
                           .time = 0.25,
                           .coarse = 0.125,
                           .probes = {"displacement_error", "stress_error", "pressure_error"},
                           .rates = {1.8, 1.4, 1.3}});
}

// At nu = 0.499 with both F-bars: no locking at any resolution, and the rates stay: 2.2 and 1.8.
// With uGIMP the stress's is 1.3 and then 0.6: under a shear of 2.2 the fixed size of its particles
// leaves gaps and overlaps.
static void test_convergence_of_the_incompressible_vortex(void **state) {
    (void)state;
    static const char *const patches[] = {"", "\"fbar\":true", "\"basis\":\"gimp\""};
    static const double of_stress[] = {1.5, 1.5, 0.4};
    for (int k = 0; k < 3; k++) {
        check(&(struct series){.scene = "vortex-incompressible",
                               .patch = patches[k],
                               .body = "ring",
                               .particles_per_cell = 4,
                               .time = 0.25,
                               .coarse = 0.125,
                               .probes = {"displacement_error", "stress_error"},
                               .rates = {1.8, of_stress[k]}});
    }
}

// Slip walls, a fluid: 1.4 in velocity; it starts without the pressure that it should have.
static void test_convergence_of_taylor_green(void **state) {
    (void)state;
    check(&(struct series){.scene = "taylor-green",
                           .patch = "",
                           .body = "vortex",
                           .particles_per_cell = 9,
                           .time = 0.2,
                           .coarse = 0.125,
                           .probes = {"velocity_error"},
                           .rates = {1.2}});
}

static void test_convergence_of_the_cylinder(void **state) {
    (void)state;
    check(&(struct series){.scene = "thick-cylinder",
                           .patch = "",
                           .body = "ring",
                           .particles_per_cell = 9,
                           .time = 4,
                           .coarse = 0.25,
                           .probes = {"displacement_error", "stress_error"},
                           .rates = {1, 0.2}});
}

// A slice of one cell between rollers is plane strain: the same errors as in 2D, to the round-off
// of sums over the layers. With F-bar the two are not the same method: the power of the ratio that
// scales F is 1/3 in 3D, F33 with it, and 1/2 in 2D, where F33 stays 1. What differs is a shear
// strain of a sixth of ln(J/Jbar), which changes the errors by 0.2 % here. (tests/unit/test_fbar.c
// has fluids, which are the same to the last digit, and these powers.)
static void test_convergence_has_no_third_dimension(void **state) {
    (void)state;
    static const char *const schemes[] = {"false", "true", "{\"scheme\":\"anchored\"}"};
    // Not the stress, of which there are more components in 3D; its mean holds sigma33.
    static const char *const probes[] = {"displacement_error", "velocity_error", "pressure_error"};
    for (int basis = MPM_GIMP; basis <= MPM_BSPLINE3; basis++) {
        for (int scheme = 0; scheme < 3; scheme++) {
            double value[2][3];
            for (int dim = 2; dim <= 3; dim++) {
                char patch[400];
                snprintf(patch, sizeof patch,
                         "{\"cell\":0.125,\"basis\":\"%s\",\"fbar\":%s,\"bodies\":{\"ring\":{"
                         "\"particles_per_cell\":%d%s}}%s}",
                         mpm_basis_name((enum mpm_basis)basis), schemes[scheme], dim == 2 ? 4 : 8,
                         dim == 2 ? ""
                                  : ",\"shape\":{\"intersection\":[{\"box\":{\"min\":[-2,-2,0],"
                                    "\"max\":[2,2,0.125]}},{\"difference\":[{\"cylinder\":{"
                                    "\"from\":[0,0,-1],\"to\":[0,0,1],\"radius\":1.5}},{"
                                    "\"cylinder\":{\"from\":[0,0,-1],\"to\":[0,0,1],\"radius\":"
                                    "0.5}}]}]}",
                         dim == 2 ? ""
                                  : ",\"domain\":{\"max\":[1.625,1.625,0.125]},\"walls\":{"
                                    "\"front\":{\"at\":0.125}}");
                struct scene_run run =
                    scene_run_open(dim == 2 ? "vortex-incompressible" : "vortex-slice", patch);
                scene_run_to(&run, 0.05);
                for (int k = 0; k < 3; k++)
                    value[dim - 2][k] = scene_run_value(&run, probes[k]);
                scene_run_close(&run);
            }
            const double tol = scheme == 0 ? 1e-9 : 1e-2; // 20 steps of round-off; lambda/mu = 500
            for (int k = 0; k < 3; k++)
                if (!(fabs(value[0][k] - value[1][k]) <= tol * value[0][k]))
                    fail_msg("%s %s %s: %.15g in 2D, %.15g in a slice",
                             mpm_basis_name((enum mpm_basis)basis), schemes[scheme], probes[k],
                             value[0][k], value[1][k]);
        }
    }
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_convergence_of_the_vortex),
        cmocka_unit_test(test_convergence_of_the_incompressible_vortex),
        cmocka_unit_test(test_convergence_of_taylor_green),
        cmocka_unit_test(test_convergence_of_the_cylinder),
        cmocka_unit_test(test_convergence_has_no_third_dimension),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
