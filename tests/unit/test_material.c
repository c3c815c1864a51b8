// Constitutive models on single particles: energy, objectivity, exact states, wave speeds.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/particles.h"

// Models that are elastic here, with the name of what they keep of the deformation.
#define FOR_SOLIDS(dim, m)                                                                         \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int m = 0; m < 2; m++)

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

#define MU 1.0
#define NU 0.3
#define LAMBDA (2 * MU * NU / (1 - 2 * NU))
#define DENSITY 2.0
static const double neo_hookean[] = {DENSITY, 2 * MU *(1 + NU), NU, 0, 0, 0};
static const double hencky[] = {DENSITY, 2 * MU *(1 + NU), NU, 1e9, 0, 0}; // never yields
static const double hencky_soft[] = {DENSITY, 2 * MU *(1 + NU), NU, 0.1, 0.02, 3};
static const char *const solids[] = {"neo_hookean", "hencky_j2"};
static const double *const solid_parameters[] = {neo_hookean, hencky};
static const double newtonian[] = {DENSITY, 100, 3, 0, 0, 0}; // density, K, viscosity

static void create(struct mpm_particles *s, const char *model, const double *parameters, int dim,
                   size_t n) {
    *s = (struct mpm_particles){.material = mpm_material_find(model), .dim = dim};
    memcpy(s->parameters, parameters, 6 * sizeof *parameters);
    s->density = parameters[0];
    assert_true(mpm_particles_create(s, n, 0));
}

// F, or b = F F^T where that is kept.
static void put_F(struct mpm_particles *s, size_t p, const double *F) {
    for (int k = 0; s->b && k < MPM_SYM(s->dim); k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        double b = i >= s->dim; // out of plane
        for (int d = 0; d < s->dim && i < s->dim; d++) {
            b += F[i * s->dim + d] * F[j * s->dim + d];
        }
        s->b[mpm_at(p, MPM_SYM(s->dim), k)] = b;
    }
    if (!s->F) {
        return;
    }
    for (int k = 0; k < s->dim * s->dim; k++) {
        s->F[mpm_at(p, s->dim * s->dim, k)] = F[k];
    }
}

// Stress as a full 3 x 3 tensor.
static void stress(struct mpm_particles *s, size_t p, double sigma[9]) {
    s->material->stress[s->dim - 2](s, 0, s->n);
    memset(sigma, 0, 9 * sizeof *sigma);
    for (int k = 0; k < MPM_SYM(s->dim); k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        sigma[i * 3 + j] = sigma[j * 3 + i] = s->sigma[mpm_at(p, MPM_SYM(s->dim), k)];
    }
}

static void random_F(double *F, int dim) {
    do {
        for (int k = 0; k < dim * dim; k++) {
            F[k] = (k % (dim + 1) == 0) + 0.4 * uniform();
        }
    } while (mpm_det(F, dim) < 0.3);
}

// J sigma = dW/dF F^T. Central differences with e = 1e-5: truncation e^2 W'''/6 (W''' up to
// 1e3 at det F = 0.3) and rounding eps W/e both stay below 1e-7.
static void test_material_stress_is_the_derivative_of_energy(void **state) {
    (void)state;
    const double e = 1e-5;
    FOR_SOLIDS(dim, m) {
        struct mpm_particles s;
        create(&s, solids[m], solid_parameters[m], dim, 1);
        for (int trial = 0; trial < 50; trial++) {
            double F[9], P[9], sigma[9];
            random_F(F, dim);
            for (int k = 0; k < dim * dim; k++) {
                double moved[9], W[2];
                for (int side = 0; side < 2; side++) {
                    memcpy(moved, F, sizeof moved);
                    moved[k] += side ? e : -e;
                    put_F(&s, 0, moved);
                    s.material->stress[dim - 2](&s, 0, 1); // hencky_j2's energy is taken from it
                    W[side] = s.material->energy(&s, 0);
                }
                P[k] = (W[1] - W[0]) / (2 * e);
            }
            put_F(&s, 0, F);
            stress(&s, 0, sigma);
            for (int i = 0; i < dim; i++) {
                for (int j = 0; j < dim; j++) {
                    double tau = 0;
                    for (int k = 0; k < dim; k++) {
                        tau += P[i * dim + k] * F[j * dim + k];
                    }
                    assert_near(mpm_det(F, dim) * sigma[i * 3 + j], tau, 1e-6);
                }
            }
        }
        mpm_particles_free(&s);
    }
}

static void test_material_pressure_is_the_derivative_of_energy(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_particles s;
        create(&s, "newtonian", newtonian, dim, 1);
        for (double J = 0.5; J < 2; J += 0.1) {
            const double e = 1e-5;
            double W[2], sigma[9];
            s.Jbar[0] = J - e;
            W[0] = s.material->energy(&s, 0);
            s.Jbar[0] = J + e;
            W[1] = s.material->energy(&s, 0);
            s.Jbar[0] = J;
            memset(s.sigma, 0, (size_t)MPM_SYM(dim) * MPM_BLOCK * sizeof *s.sigma);
            stress(&s, 0, sigma);
            // W is quadratic: only rounding, eps W/e = 1e-9.
            assert_near(sigma[0], (W[1] - W[0]) / (2 * e), 1e-7);
            assert_near(sigma[4], sigma[0], 0);
            assert_near(sigma[8], sigma[0], 0);
            assert_near(sigma[1], 0, 0);
        }
        mpm_particles_free(&s);
    }
}

// Exactly, in this build: GCC 12.2 with AVX-512 once turned {1,1,1,0,0,0} into {1,1,1,1,0,0}.
static void test_material_identity_has_no_stress(void **state) {
    (void)state;
    const struct {
        const char *model;
        const double *parameters;
    } cases[] = {{"neo_hookean", neo_hookean},
                 {"newtonian", newtonian},
                 {"hencky_j2", hencky},
                 {"hencky_j2", hencky_soft}};
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        for (int dim = 2; dim <= 3; dim++) {
            for (size_t n = 1; n <= 33; n++) { // whole and broken blocks and vectors
                struct mpm_particles s;
                create(&s, cases[c].model, cases[c].parameters, dim, n);
                double L[64][9] = {{0}};
                if (s.material->rate_stress[dim - 2]) {
                    s.material->rate_stress[dim - 2](&s, 0, n, L);
                }
                for (size_t p = 0; p < n; p++) {
                    double sigma[9];
                    stress(&s, p, sigma);
                    for (int k = 0; k < 9; k++) {
                        assert_true(sigma[k] == 0);
                    }
                    assert_true(s.material->energy(&s, p) == 0);
                }
                mpm_particles_free(&s);
            }
        }
    }
}

static void rotation(double *Q, int dim) {
    double n[3] = {0, 0, 1}, angle = 3 * uniform();
    if (dim == 3) {
        double length = 0;
        for (int d = 0; d < 3; d++) {
            n[d] = uniform();
            length += n[d] * n[d];
        }
        for (int d = 0; d < 3; d++) {
            n[d] /= sqrt(length);
        }
    }
    const double c = cos(angle), s = sin(angle);
    const double R[9] = {c + n[0] * n[0] * (1 - c),        n[0] * n[1] * (1 - c) - n[2] * s,
                         n[0] * n[2] * (1 - c) + n[1] * s, n[1] * n[0] * (1 - c) + n[2] * s,
                         c + n[1] * n[1] * (1 - c),        n[1] * n[2] * (1 - c) - n[0] * s,
                         n[2] * n[0] * (1 - c) - n[1] * s, n[2] * n[1] * (1 - c) + n[0] * s,
                         c + n[2] * n[2] * (1 - c)};
    for (int i = 0; i < dim; i++) {
        for (int j = 0; j < dim; j++) {
            Q[i * dim + j] = R[i * 3 + j];
        }
    }
}

static void multiply(const double *A, const double *B, double *out, int dim) {
    for (int i = 0; i < dim; i++) {
        for (int j = 0; j < dim; j++) {
            out[i * dim + j] = 0;
            for (int k = 0; k < dim; k++) {
                out[i * dim + j] += A[i * dim + k] * B[k * dim + j];
            }
        }
    }
}

// sigma(Q F) = Q sigma(F) Q^T and W(Q F) = W(F): a few roundings of stresses of the size of 10.
static void test_material_is_objective(void **state) {
    (void)state;
    FOR_SOLIDS(dim, m) {
        struct mpm_particles s;
        create(&s, solids[m], solid_parameters[m], dim, 1);
        for (int trial = 0; trial < 50; trial++) {
            double F[9], Q[9], QF[9], before[9], after[9];
            random_F(F, dim);
            rotation(Q, dim);
            multiply(Q, F, QF, dim);
            put_F(&s, 0, F);
            stress(&s, 0, before);
            const double W = s.material->energy(&s, 0);
            put_F(&s, 0, QF);
            stress(&s, 0, after);
            assert_near(s.material->energy(&s, 0), W, 1e-13);
            assert_near(after[8], dim == 2 ? before[8] : after[8], 1e-13);
            for (int i = 0; i < dim; i++) {
                for (int j = 0; j < dim; j++) {
                    double expected = 0;
                    for (int k = 0; k < dim; k++) {
                        for (int l = 0; l < dim; l++) {
                            expected += Q[i * dim + k] * before[k * 3 + l] * Q[j * dim + l];
                        }
                    }
                    assert_near(after[i * 3 + j], expected, 1e-13);
                }
            }
        }
        mpm_particles_free(&s);
    }
}

// b = Q Q^T differs from 1 by a few eps, whatever the angle.
static void test_material_rotation_has_no_stress(void **state) {
    (void)state;
    FOR_SOLIDS(dim, m) {
        struct mpm_particles s;
        create(&s, solids[m], solid_parameters[m], dim, 1);
        for (int trial = 0; trial < 50; trial++) {
            double Q[9], sigma[9];
            rotation(Q, dim);
            put_F(&s, 0, Q);
            stress(&s, 0, sigma);
            for (int k = 0; k < 9; k++) {
                assert_near(sigma[k], 0, 5e-15);
            }
        }
        mpm_particles_free(&s);
    }
}

// F = 1 + gamma e1 x e2: s_xx = mu gamma^2, s_xy = mu gamma, all else 0.
static void test_material_simple_shear_is_exact(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_particles s;
        create(&s, "neo_hookean", neo_hookean, dim, 1);
        for (double gamma = 0; gamma <= 2; gamma += 0.1) {
            double F[9] = {0}, sigma[9];
            for (int d = 0; d < dim; d++) {
                F[d * dim + d] = 1;
            }
            F[1] = gamma;
            put_F(&s, 0, F);
            stress(&s, 0, sigma);
            const double expected[9] = {
                MU * gamma * gamma, MU * gamma, 0, MU * gamma, 0, 0, 0, 0, 0};
            for (int k = 0; k < 9; k++) {
                assert_near(sigma[k], expected[k], 2e-15); // eps times 1 + gamma^2
            }
        }
        mpm_particles_free(&s);
    }
}

static void test_material_plane_strain_is_3d_with_F33_1(void **state) {
    (void)state;
    struct mpm_particles flat, solid;
    for (int trial = 0; trial < 100; trial++) {
        double F[9], a[9], b[9];
        create(&flat, solids[trial % 2], solid_parameters[trial % 2], 2, 1);
        create(&solid, solids[trial % 2], solid_parameters[trial % 2], 3, 1);
        random_F(F, 2);
        const double G[9] = {F[0], F[1], 0, F[2], F[3], 0, 0, 0, 1};
        put_F(&flat, 0, F);
        put_F(&solid, 0, G);
        stress(&flat, 0, a);
        stress(&solid, 0, b);
        for (int k = 0; k < 9; k++) {
            assert_near(a[k], b[k], 1e-14); // the same sums, rounded in another order
        }
        assert_near(flat.material->energy(&flat, 0), solid.material->energy(&solid, 0), 1e-14);
        mpm_particles_free(&flat);
        mpm_particles_free(&solid);
    }
}

// c = sqrt((lambda + 2 mu)/rho), which is also the slope of the stress in uniaxial strain.
static void test_material_wave_speed_is_the_p_wave(void **state) {
    (void)state;
    struct mpm_particles s;
    for (int m = 0; m < 2; m++) {
        create(&s, solids[m], solid_parameters[m], 3, 1);
        const double c = s.material->wave_speed(s.parameters), e = 1e-6;
        assert_near(c, sqrt((LAMBDA + 2 * MU) / DENSITY), 1e-15);
        double F[9] = {1 + e, 0, 0, 0, 1, 0, 0, 0, 1}, plus[9], minus[9];
        put_F(&s, 0, F);
        stress(&s, 0, plus);
        F[0] = 1 - e;
        put_F(&s, 0, F);
        stress(&s, 0, minus);
        assert_near((plus[0] - minus[0]) / (2 * e) / DENSITY, c * c, 1e-9); // eps/e
        assert_null(s.material->diffusivity);
        mpm_particles_free(&s);
    }

    create(&s, "newtonian", newtonian, 3, 1);
    assert_near(s.material->wave_speed(s.parameters), sqrt(100 / DENSITY), 1e-15);
    assert_near(s.material->diffusivity(s.parameters), 3 / DENSITY, 0);
    mpm_particles_free(&s);
}

// sigma = -p 1 + 2 mu dev(d): pure shear, and the rate part of any flow has no mean.
static void test_material_newtonian_rate_part(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_particles s;
        create(&s, "newtonian", newtonian, dim, 1);
        double L[1][9] = {{0}}, sigma[9];
        L[0][1] = 7; // v_x = 7 y
        s.Jbar[0] = 0.99;
        s.material->rate_stress[dim - 2](&s, 0, 1, L);
        stress(&s, 0, sigma);
        const double p = -100 * (0.99 - 1);
        const double expected[9] = {-p, 3 * 7, 0, 3 * 7, -p, 0, 0, 0, -p};
        for (int k = 0; k < 9; k++) {
            assert_near(sigma[k], expected[k], 1e-13);
        }
        for (int trial = 0; trial < 20; trial++) {
            double trace = 0;
            for (int k = 0; k < dim * dim; k++) {
                L[0][k] = uniform();
            }
            for (int d = 0; d < dim; d++) {
                trace += L[0][d * dim + d];
            }
            s.material->rate_stress[dim - 2](&s, 0, 1, L);
            stress(&s, 0, sigma);
            assert_near((sigma[0] + sigma[4] + sigma[8]) / 3, -p, 1e-14);
            for (int i = 0; i < 3; i++) {
                for (int j = 0; j < 3; j++) {
                    const double d =
                        i < dim && j < dim ? (L[0][i * dim + j] + L[0][j * dim + i]) / 2 : 0;
                    assert_near(sigma[i * 3 + j], (i == j ? -p - 2 * trace : 0) + 6 * d, 1e-13);
                }
            }
        }
        mpm_particles_free(&s);
    }
}

// A skew velocity gradient is a rotation: no viscous stress.
static void test_material_newtonian_rotation_has_no_stress(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_particles s;
        create(&s, "newtonian", newtonian, dim, 1);
        double L[1][9] = {{0}}, sigma[9];
        for (int i = 0; i < dim; i++) {
            for (int j = 0; j < i; j++) {
                L[0][i * dim + j] = uniform();
                L[0][j * dim + i] = -L[0][i * dim + j];
            }
        }
        s.material->rate_stress[dim - 2](&s, 0, 1, L);
        stress(&s, 0, sigma);
        for (int k = 0; k < 9; k++) {
            assert_true(sigma[k] == 0);
        }
        mpm_particles_free(&s);
    }
}

static void test_material_list_is_complete(void **state) {
    (void)state;
    assert_true(mpm_material_count() >= 3);
    for (size_t k = 0; k < mpm_material_count(); k++) {
        const struct mpm_material *m = mpm_material_at(k);
        assert_ptr_equal(mpm_material_find(mpm_material_name(m)), m);
        assert_true(strlen(mpm_material_doc(m)) > 0);
        assert_string_equal(mpm_material_parameter(m, 0)->key, "density");
        size_t n = 0;
        for (const struct mpm_parameter *q; (q = mpm_material_parameter(m, n)); n++) {
            assert_true(strlen(q->unit) > 0 && strlen(q->doc) > 0);
            assert_true(q->min < q->max);
            assert_true(q->required || (q->fallback >= q->min && q->fallback <= q->max));
        }
        assert_true(n <= MPM_MAX_PARAMETERS);
        assert_null(mpm_material_parameter(m, n));
        assert_null(mpm_material_parameter(m, n + 1));
    }
    assert_null(mpm_material_find("unobtainium"));
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_material_stress_is_the_derivative_of_energy),
        cmocka_unit_test(test_material_pressure_is_the_derivative_of_energy),
        cmocka_unit_test(test_material_identity_has_no_stress),
        cmocka_unit_test(test_material_is_objective),
        cmocka_unit_test(test_material_rotation_has_no_stress),
        cmocka_unit_test(test_material_simple_shear_is_exact),
        cmocka_unit_test(test_material_plane_strain_is_3d_with_F33_1),
        cmocka_unit_test(test_material_wave_speed_is_the_p_wave),
        cmocka_unit_test(test_material_newtonian_rate_part),
        cmocka_unit_test(test_material_newtonian_rotation_has_no_stress),
        cmocka_unit_test(test_material_list_is_complete),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
