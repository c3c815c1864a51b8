// Basis functions: what every basis must satisfy whatever its order, and the textbook values.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

#include <cmocka.h>

#include "server/mpm/basis.h"

#define EPS 2.220446049250313e-16

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

// uGIMP half sizes are 1/(2 n), n particles per direction; other bases ignore the half size.
#define FOR_BASES(basis, half)                                                                     \
    for (int basis = 0; basis < MPM_N_BASES; basis++)                                              \
        for (int n_ = 1; n_ <= (basis == MPM_GIMP ? 8 : 1); n_++)                                  \
            for (double half = 0.5 / n_, once_ = 1; once_ > 0; once_ = 0)

// Coordinates to try: fractions of a cell that include nodes, middles, the places where a uGIMP
// particle's edge crosses a node, both neighbours of each, and a spread of others.
static size_t samples(double half, double *xi) {
    size_t n = 0;
    const double special[] = {0, 0.5, half, 1 - half, 0.25, 0.75};
    for (size_t k = 0; k < sizeof special / sizeof *special; k++) {
        const double x = 3 + special[k];
        xi[n++] = x;
        xi[n++] = nextafter(x, 0);
        xi[n++] = nextafter(x, 9);
    }
    for (int k = 0; k < 100; k++) {
        xi[n++] = 3 + fmod(0.6180339887498949 * k, 1);
    }
    return n;
}
#define MAX_SAMPLES 128

static int weights(int basis, double xi, double half, double *w, double *dw) {
    return mpm_weights((enum mpm_basis)basis, xi, half, 0.25 / half, w, dw);
}

// Weight (or gradient) of one node, 0 where the particle does not reach it.
static double of_node(int basis, double xi, double half, int node, bool gradient) {
    double w[MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT];
    const int k = node - weights(basis, xi, half, w, dw);
    return k < 0 || k >= mpm_support((enum mpm_basis)basis) ? 0 : gradient ? dw[k] : w[k];
}

static double moment(int basis, double xi, double half, int power, bool gradient) {
    double w[MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT], sum = 0;
    const int base = weights(basis, xi, half, w, dw);
    for (int k = 0; k < mpm_support((enum mpm_basis)basis); k++) {
        sum += (gradient ? dw : w)[k] * pow(base + k - xi, power);
    }
    return sum;
}

// Round-off of a sum of at most 4 terms, each a short product: a few eps.
#define ROUND_OFF (8 * EPS)

static void test_basis_sums_to_one(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        double xi[MAX_SAMPLES];
        for (size_t k = samples(half, xi); k-- > 0;) {
            assert_near(moment(basis, xi[k], half, 0, false), 1, ROUND_OFF);
        }
    }
}

static void test_basis_gradients_sum_to_zero(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        double xi[MAX_SAMPLES];
        for (size_t k = samples(half, xi); k-- > 0;) {
            assert_near(moment(basis, xi[k], half, 0, true), 0, ROUND_OFF);
        }
    }
}

// A negative weight would give a node negative mass.
static void test_basis_is_not_negative(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        double xi[MAX_SAMPLES], w[MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT];
        for (size_t k = samples(half, xi); k-- > 0;) {
            weights(basis, xi[k], half, w, dw);
            for (int i = 0; i < mpm_support((enum mpm_basis)basis); i++) {
                assert_true(w[i] >= 0);
            }
        }
    }
}

// All four reproduce linear fields: sum w x_i = x and sum dw x_i = 1. (uGIMP too, as the average of
// a linear function over a particle is its value at the centre.) Terms are of the size of 2 cells;
// uGIMP divides differences of size eps by the particle's size, up to 16 times.
static void test_basis_reproduces_linear_fields(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        const double tol = 4 * ROUND_OFF / (basis == MPM_GIMP ? half : 1);
        double xi[MAX_SAMPLES];
        for (size_t k = samples(half, xi); k-- > 0;) {
            assert_near(moment(basis, xi[k], half, 1, false), 0, tol);
            assert_near(moment(basis, xi[k], half, 1, true), 1, tol);
        }
    }
}

// Second moments tell the bases apart: that of a B-spline of order k is (k + 1)/12 everywhere, so
// it reproduces quadratic fields up to a constant; the linear one's is t (1 - t).
static void test_basis_has_its_second_moment(void **state) {
    (void)state;
    double xi[MAX_SAMPLES];
    for (size_t k = samples(0.25, xi); k-- > 0;) {
        const double t = xi[k] - floor(xi[k]);
        assert_near(moment(MPM_LINEAR, xi[k], 0.25, 2, false), t * (1 - t), 4 * ROUND_OFF);
        assert_near(moment(MPM_BSPLINE2, xi[k], 0.25, 2, false), 3.0 / 12, 4 * ROUND_OFF);
        assert_near(moment(MPM_BSPLINE3, xi[k], 0.25, 2, false), 4.0 / 12, 4 * ROUND_OFF);
    }
}

static void test_basis_gradient_is_the_derivative(void **state) {
    (void)state;
    const double e = 1e-6;
    // Rounding 4 eps/e = 1e-9, truncation e^2/6 less; a kink within e adds up to w'' e / 2, where
    // w'' is at most 2/(4 half) = 8.
    const double tol = 2e-9;
    FOR_BASES(basis, half) {
        for (int k = 0; k < 200; k++) {
            const double xi = 3 + fmod(0.6180339887498949 * k + 1e-3, 1), t = xi - 3;
            if (fmin(t, 1 - t) < 2 * e || fabs(t - 0.5) < 2 * e || fabs(t - half) < 2 * e ||
                fabs(t - 1 + half) < 2 * e) {
                continue;
            }
            for (int node = 1; node < 7; node++) {
                const double slope = (of_node(basis, xi + e, half, node, false) -
                                      of_node(basis, xi - e, half, node, false)) /
                                     (2 * e);
                assert_near(of_node(basis, xi, half, node, true), slope, tol);
            }
        }
    }
}

static void test_basis_vanishes_outside_its_support(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        const double reach = basis == MPM_LINEAR     ? 1
                             : basis == MPM_GIMP     ? 1 + half
                             : basis == MPM_BSPLINE2 ? 1.5
                                                     : 2;
        for (double xi = 2.5; xi < 7.5; xi += 1.0 / 64) { // exact fractions
            const double w = of_node(basis, xi, half, 5, false);
            if (fabs(xi - 5) >= reach) {
                assert_true(w == 0);
            } else {
                assert_true(w > 0);
            }
        }
    }
}

// Over every place where the formula changes, weights are continuous; gradients too, but the linear
// basis'. The step is 2e-12; slopes are at most 1, those of gradients at most 1/(2 half) = 8.
static void test_basis_is_continuous(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        const double kinks[] = {0, 0.5, half, 1 - half};
        for (size_t k = 0; k < sizeof kinks / sizeof *kinks; k++) {
            for (int node = 1; node < 7; node++) {
                const double a = 3 + kinks[k] - 1e-12, b = 3 + kinks[k] + 1e-12;
                assert_near(of_node(basis, a, half, node, false),
                            of_node(basis, b, half, node, false), 4e-12);
                if (basis != MPM_LINEAR) {
                    assert_near(of_node(basis, a, half, node, true),
                                of_node(basis, b, half, node, true), 4e-11);
                }
            }
        }
    }
}

// The textbook forms, as functions of the distance between particle and node.
static double textbook(int basis, double x, double half) {
    const double r = fabs(x);
    switch (basis) {
    case MPM_LINEAR:
        return r < 1 ? 1 - r : 0;
    case MPM_GIMP: // Bardenhagen and Kober 2004, half <= 1/2
        return r < half       ? 1 - (r * r + half * half) / (2 * half)
               : r < 1 - half ? 1 - r
               : r < 1 + half ? (1 + half - r) * (1 + half - r) / (4 * half)
                              : 0;
    case MPM_BSPLINE2:
        return r < 0.5 ? 0.75 - r * r : r < 1.5 ? 0.5 * (1.5 - r) * (1.5 - r) : 0;
    default:
        return r < 1 ? 2.0 / 3 - r * r + r * r * r / 2 : r < 2 ? pow(2 - r, 3) / 6 : 0;
    }
}

static void test_basis_matches_the_textbook(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        double xi[MAX_SAMPLES];
        for (size_t k = samples(half, xi); k-- > 0;) {
            for (int node = 0; node < 8; node++) {
                // 1/half multiplies the round-off of (1 + half - r)^2, as above.
                assert_near(of_node(basis, xi[k], half, node, false),
                            textbook(basis, xi[k] - node, half), 2 * ROUND_OFF / half);
            }
        }
    }
}

// A particle exactly on a node sees it symmetrically.
static void test_basis_on_a_node_is_symmetric(void **state) {
    (void)state;
    FOR_BASES(basis, half) {
        const double tol = ROUND_OFF / (basis == MPM_GIMP ? half : 1), // as above
            side = of_node(basis, 4, half, 3, false);
        assert_near(of_node(basis, 4, half, 5, false), side, tol);
        assert_near(of_node(basis, 4, half, 4, false), 1 - 2 * side, 2 * tol);
        assert_near(of_node(basis, 4, half, 5, true) + of_node(basis, 4, half, 3, true),
                    basis == MPM_LINEAR ? 1 : 0, tol); // linear takes the slope of one side
        const double expected = basis == MPM_LINEAR     ? 0
                                : basis == MPM_GIMP     ? half / 4
                                : basis == MPM_BSPLINE2 ? 1.0 / 8
                                                        : 1.0 / 6;
        assert_near(side, expected, tol);
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_basis_sums_to_one),
        cmocka_unit_test(test_basis_gradients_sum_to_zero),
        cmocka_unit_test(test_basis_is_not_negative),
        cmocka_unit_test(test_basis_reproduces_linear_fields),
        cmocka_unit_test(test_basis_has_its_second_moment),
        cmocka_unit_test(test_basis_gradient_is_the_derivative),
        cmocka_unit_test(test_basis_vanishes_outside_its_support),
        cmocka_unit_test(test_basis_is_continuous),
        cmocka_unit_test(test_basis_matches_the_textbook),
        cmocka_unit_test(test_basis_on_a_node_is_symmetric),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
