// Logarithm and exponential of symmetric tensors, against what they must be eigenvalue by
// eigenvalue.
#include <fenv.h>
#include <float.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/spectral.h"

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

// A random rotation: from a random unit quaternion; in 2D about the third direction.
static void rotation(double *Q, int dim) {
    double q[4], length = 0;
    for (int k = 0; k < 4; k++) {
        q[k] = dim == 2 && (k == 1 || k == 2) ? 0 : uniform();
        length += q[k] * q[k];
    }
    for (int k = 0; k < 4; k++) {
        q[k] /= sqrt(length);
    }
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double R[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                         2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    memcpy(Q, R, sizeof R);
}

// A tensor with these eigenvalues along the columns of Q.
static void compose(const double *w, const double *Q, double *s, int dim) {
    double all[6];
    mpm_from_eigen(w, Q, all);
    memcpy(s, all, (size_t)MPM_SYM(dim) * sizeof *s);
}

static double size_of(const double *s, int dim) {
    double largest = 0;
    for (int k = 0; k < MPM_SYM(dim); k++) {
        largest = fmax(largest, fabs(s[k]));
    }
    return largest;
}

// As mpm_half_log, whose series is held against the eigenvalues wherever it is used. b carries eps
// |b|, which is worth eps |b| |b^-1|, at most 2.25 in the series' reach.
static void half_log(const double *b, double *e, int dim) {
    double far[6];
    if (dim == 2) {
        mpm_half_log(b, e, 2);
    } else {
        mpm_half_log(b, e, 3);
    }
    mpm_half_log_far(b, far, dim, 1, 1);
    double largest = 0;
    for (int k = 0; k < MPM_SYM(dim); k++) {
        largest = fmax(largest, fabs(far[k]));
    }
    for (int k = 0; largest < MPM_SERIES_REACH && k < MPM_SYM(dim); k++) {
        assert_near(e[k], far[k], 4 * DBL_EPSILON);
    }
}

static void exp_twice(const double *e, double *b, int dim) {
    double far[6];
    if (dim == 2) {
        mpm_exp_twice(e, b, 2);
    } else {
        mpm_exp_twice(e, b, 3);
    }
    mpm_exp_twice_far(e, far, dim, 1, 1);
    for (int k = 0; k < MPM_SYM(dim); k++) {
        assert_near(b[k], far[k], 8 * DBL_EPSILON * size_of(far, dim) * (1 + size_of(e, dim)));
    }
}

#define FOR_ROTATED(dim, trial)                                                                    \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int trial = 0; trial < 200; trial++)

// log(exp(2 e))/2 = e. b carries eps |b|, which is worth eps |b| |b^-1| in e: the condition.
static void test_spectral_log_undoes_exp(void **state) {
    (void)state;
    FOR_ROTATED(dim, trial) {
        for (double size = 1e-12; size < 3.1; size *= 10) {
            double w[3], Q[9], e[6], b[6], back[6];
            for (int d = 0; d < 3; d++) {
                w[d] = size * uniform();
            }
            rotation(Q, dim);
            compose(w, Q, e, dim);
            exp_twice(e, b, dim);
            half_log(b, back, dim);
            const double spread = fmax(fmax(w[0], w[1]), w[2]) - fmin(fmin(w[0], w[1]), w[2]);
            for (int k = 0; k < MPM_SYM(dim); k++) {
                assert_near(back[k], e[k], 16 * DBL_EPSILON * (exp(2 * spread) + size));
            }
        }
    }
}

// The same from the other side, and each against its value eigenvalue by eigenvalue.
static void test_spectral_log_and_exp_are_those_of_the_eigenvalues(void **state) {
    (void)state;
    FOR_ROTATED(dim, trial) {
        for (double size = 1e-12; size < 3.1; size *= 10) {
            double w[3], twice[3], Q[9], e[6], b[6], exact[6];
            for (int d = 0; d < 3; d++) {
                w[d] = size * uniform();
                twice[d] = exp(2 * w[d]);
            }
            rotation(Q, dim);
            compose(w, Q, e, dim);
            compose(twice, Q, exact, dim);
            exp_twice(e, b, dim);
            for (int k = 0; k < MPM_SYM(dim); k++) { // a few eps of the largest eigenvalue
                assert_near(b[k], exact[k], 32 * DBL_EPSILON * (1 + size) * size_of(exact, dim));
            }
            const double spread = fmax(fmax(w[0], w[1]), w[2]) - fmin(fmin(w[0], w[1]), w[2]);
            half_log(exact, b, dim);
            for (int k = 0; k < MPM_SYM(dim); k++) {
                assert_near(b[k], e[k], 16 * DBL_EPSILON * (exp(2 * spread) + size));
            }
        }
    }
}

// Repeated eigenvalues: all three, each pair, and pairs that differ by round-off or a little more.
static void test_spectral_repeated_eigenvalues(void **state) {
    (void)state;
    const double gaps[] = {0, 1e-300, 1e-17, 1e-16, 1e-12, 1e-8, 1e-5, 1e-4, 2e-4};
    FOR_ROTATED(dim, trial) {
        for (size_t g = 0; g < sizeof gaps / sizeof *gaps; g++) {
            for (int odd = 0; odd < 4; odd++) { // the one that differs, 3 = none
                double w[3], wb[3], Q[9], e[6], b[6], exact[6];
                for (int d = 0; d < 3; d++) {
                    w[d] = 0.3 + (d == odd ? -0.4 : d * gaps[g]);
                    wb[d] = exp(2 * w[d]);
                }
                rotation(Q, dim);
                if (trial == 0) {
                    for (int k = 0; k < 9; k++) { // exactly diagonal
                        Q[k] = k % 4 == 0;
                    }
                }
                compose(w, Q, exact, dim);
                compose(wb, Q, b, dim);
                half_log(b, e, dim);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    assert_near(e[k], exact[k], 2e-15); // a few eps at a condition of 2
                }
                exp_twice(exact, e, dim);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    assert_near(e[k], b[k], 1e-14); // b reaches 1.8
                }
            }
        }
    }
}

static void test_spectral_isotropic_is_exact(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int k = -140; k <= 140; k++) {
            const double lambda = pow(10, k / 10.0);
            const double b[6] = {lambda, lambda, lambda};
            double e[6], back[6];
            half_log(b, e, dim);
            exp_twice(e, back, dim);
            for (int c = 0; c < MPM_SYM(dim); c++) {
                const double expected = c < 3 ? log(lambda) / 2 : 0;
                assert_near(e[c], expected, c < 3 ? 4 * DBL_EPSILON * (1 + fabs(expected)) : 0);
                // exp turns eps |e| (|e| up to 16) into the same relative error.
                assert_near(back[c], b[c], 64 * 4 * DBL_EPSILON * b[c]);
            }
        }
        const double one[6] = {1, 1, 1};
        double e[6];
        half_log(one, e, dim);
        for (int c = 0; c < MPM_SYM(dim); c++) {
            assert_true(e[c] == 0);
        }
        double b[6];
        exp_twice(e, b, dim);
        assert_memory_equal(b, one, (size_t)MPM_SYM(dim) * sizeof *b);
    }
}

// Extreme eigenvalues along the axes: nothing is lost, each is right to its own size.
static void test_spectral_extreme_on_the_axes(void **state) {
    (void)state;
    const double extremes[] = {1e-14, 1e-7, 0.5, 1, 3, 1e7, 1e14};
    for (int dim = 2; dim <= 3; dim++) {
        for (int i = 0; i < 7 * 7 * 7; i++) {
            const double b[6] = {extremes[i % 7], extremes[i / 7 % 7], extremes[i / 49]};
            double e[6], back[6];
            half_log(b, e, dim);
            for (int c = 0; c < MPM_SYM(dim); c++) {
                const double expected = c < 3 ? log(b[c]) / 2 : 0;
                assert_near(e[c], expected, 8 * DBL_EPSILON * 32); // logarithms of the size of 32
            }
            exp_twice(e, back, dim);
            for (int c = 0; c < MPM_SYM(dim); c++) {
                assert_near(back[c], b[c], c < 3 ? 1e-13 * b[c] : 0); // 2 e eps = 64 eps, twice
            }
        }
    }
}

// In rotated frames b itself carries eps times its largest entry. What that is worth in the
// logarithm is eps max/min as long as that is small: down to 1e-14 beside 1.
static void test_spectral_extreme_in_rotated_frames(void **state) {
    (void)state;
    FOR_ROTATED(dim, trial) {
        for (int k = 0; k <= 14; k++) {
            for (int common = -14; common <= 14; common += 7) {
                double w[3], e[6], b[6], Q[9], wb[3];
                const int which = trial % dim;
                for (int d = 0; d < 3; d++) {
                    wb[d] = pow(10, common) * (d == which ? pow(10, -k) : 1 + 0.5 * uniform());
                    w[d] = log(wb[d]) / 2;
                }
                rotation(Q, dim);
                compose(wb, Q, b, dim);
                half_log(b, e, dim);
                // Trace = ln(det)/2, whose error is that of the small eigenvalue alone.
                const double tol = 16 * DBL_EPSILON * (pow(10, k) + 32); // of logarithms up to 32
                double exact[6];
                compose(w, Q, exact, dim);
                for (int c = 0; c < MPM_SYM(dim); c++) {
                    assert_near(e[c], exact[c], tol);
                }
            }
        }
    }
}

// A large strain with its inverse: exp keeps the determinant, so that plastic flow keeps the
// volume.
static void test_spectral_exp_keeps_the_determinant(void **state) {
    (void)state;
    FOR_ROTATED(dim, trial) {
        for (double size = 1e-8; size < 4; size *= 4) {
            double w[3], Q[9], e[6], b[6];
            for (int d = 0; d < 3; d++) {
                w[d] = size * uniform();
            }
            rotation(Q, dim);
            compose(w, Q, e, dim);
            exp_twice(e, b, dim);
            const double trace = w[0] + w[1] + w[2];
            const double spread = fmax(fmax(w[0], w[1]), w[2]) - fmin(fmin(w[0], w[1]), w[2]);
            // det in this form cancels terms of the size of the largest products.
            assert_near(mpm_det_sym(b, dim) / exp(2 * trace), 1,
                        64 * DBL_EPSILON * (1 + size) * exp(4 * spread));
        }
    }
}

// With an out-of-plane direction that stands alone, 3D gives what 2D gives.
static void test_spectral_2d_is_3d(void **state) {
    (void)state;
    for (int trial = 0; trial < 500; trial++) {
        for (double size = 1e-10; size < 3; size *= 7) {
            double w[3], Q[9], e[6], flat[4], solid[6];
            for (int d = 0; d < 3; d++) {
                w[d] = size * uniform();
            }
            rotation(Q, 2);
            compose(w, Q, e, 2);
            const double spread = fmax(fmax(w[0], w[1]), w[2]) - fmin(fmin(w[0], w[1]), w[2]);
            const double full[6] = {e[0], e[1], e[2], e[3]};
            exp_twice(e, flat, 2);
            exp_twice(full, solid, 3);
            for (int k = 0; k < 6; k++) {
                assert_near(solid[k], k < 4 ? flat[k] : 0,
                            32 * DBL_EPSILON * (1 + size) * size_of(flat, 2));
            }
            double in[6] = {flat[0], flat[1], flat[2], flat[3]};
            half_log(flat, e, 2);
            half_log(in, solid, 3);
            for (int k = 0; k < 6; k++) {
                assert_near(solid[k], k < 4 ? e[k] : 0,
                            16 * DBL_EPSILON * (exp(2 * spread) + size));
            }
        }
    }
}

static double norm_of(const double *s, int dim) {
    double norm2 = 0;
    for (int k = 0; k < MPM_SYM(dim); k++) {
        norm2 += (k < 3 ? 1 : 2) * s[k] * s[k];
    }
    return sqrt(norm2);
}

// Where the series hand over to the eigenvalues, and these to their limits (2D), the two sides
// agree: along a line through the switch there is no step beyond the slope.
static void test_spectral_is_continuous_at_its_switches(void **state) {
    (void)state;
    for (int trial = 0; trial < 200; trial++) {
        for (int dim = 2; dim <= 3; dim++) {
            double w[3], Q[9], wb[3], x[6], in[6], e[2][6];
            rotation(Q, dim);
            for (int d = 0; d < 3; d++) {
                w[d] = uniform();
            }
            compose(w, Q, x, dim);
            const double scale = MPM_SERIES_REACH / norm_of(x, dim);
            for (int side = 0; side < 2; side++) {
                for (int d = 0; d < 3; d++) {
                    const double X = w[d] * scale * (1 + (side ? 1e-14 : -1e-14));
                    wb[d] = (1 + X) / (1 - X);
                }
                compose(wb, Q, in, dim);
                mpm_half_log(in, e[side], dim);
            }
            for (int k = 0; k < MPM_SYM(dim); k++) {
                assert_near(e[1][k], e[0][k], 5e-15); // slope 1 over 4e-15, and round-off
            }
            const double mean = (w[0] + w[1] + w[2]) / 3;
            for (int d = 0; d < 3; d++) {
                w[d] -= mean;
            }
            compose(w, Q, x, dim);
            const double half = MPM_SERIES_REACH / norm_of(x, dim) / 2;
            for (int side = 0; side < 2; side++) {
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    in[k] = x[k] * half * (1 + (side ? 1e-14 : -1e-14));
                }
                mpm_exp_twice(in, e[side], dim);
            }
            for (int k = 0; k < MPM_SYM(dim); k++) {
                assert_near(e[1][k], e[0][k], 6e-15); // slope 1.2 over 4e-15, and round-off
            }
        }
        const double c = cos(3 * uniform()), s = sqrt(1 - c * c);
        double e[2][4];
        for (int side = 0; side < 2; side++) {
            const double r = 1e-4 * (1 + (side ? 1e-14 : -1e-14));
            const double b[4] = {1 + r * c, 1 - r * c, 2, r * s}; // 2: out of the series' reach
            mpm_half_log(b, e[side], 2);
        }
        for (int k = 0; k < 4; k++) {
            assert_near(e[1][k], e[0][k], 1e-15);
        }
        for (int side = 0; side < 2; side++) {
            const double r = 0.5e-4 * (1 + (side ? 1e-14 : -1e-14)); // of e; half of that of 2 e
            const double in[4] = {r * c / 2, -r * c / 2, 0.2, r * s / 2};
            mpm_exp_twice(in, e[side], 2);
        }
        for (int k = 0; k < 4; k++) {
            assert_near(e[1][k], e[0][k], 1e-15);
        }
        for (int side = 0; side < 2; side++) { // where atanh gives way to logarithms
            const double r = 0.5 * (1 + (side ? 1e-14 : -1e-14));
            const double b[4] = {1 + r * c, 1 - r * c, 1.1, r * s};
            mpm_half_log(b, e[side], 2);
        }
        for (int k = 0; k < 4; k++) {
            assert_near(e[1][k], e[0][k], 1.5e-14); // slope 1 over 1e-14
        }
    }
}

// Near the identity nothing is lost against b - 1, which is exact: log(1 + B)/2 = B/2 - B^2/4 + ...
static void test_spectral_log_is_linear_near_the_identity(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int k = 2; k <= 12; k++) {
            const double t = ldexp(1, -3 * k);
            for (int trial = 0; trial < 50; trial++) {
                double b[6], e[6];
                for (int c = 0; c < MPM_SYM(dim); c++) {
                    b[c] = (c < 3) + t * uniform();
                }
                half_log(b, e, dim);
                for (int c = 0; c < MPM_SYM(dim); c++) {
                    assert_near(e[c], (b[c] - (c < 3)) / 2, t * t * 1.5 + DBL_EPSILON);
                }
            }
        }
    }
}

// Deviators with a zero eigenvalue, as of pure shear, where nothing is relative to the diagonal.
static void test_spectral_exp_of_pure_shear(void **state) {
    (void)state;
    for (double size = 1e-12; size < 3; size *= 10) {
        for (int trial = 0; trial < 300; trial++) {
            const double w[3] = {size, -size, 0}, wb[3] = {exp(2 * size), exp(-2 * size), 1};
            double Q[9], e[6], b[6], exact[6];
            rotation(Q, trial % 2 ? 3 : 2);
            compose(w, Q, e, 3);
            compose(wb, Q, exact, 3);
            exp_twice(e, b, 3);
            for (int k = 0; k < 6; k++) {
                assert_near(b[k], exact[k], 32 * DBL_EPSILON * (1 + size) * wb[0]);
            }
        }
        for (int c = 3; c < 6; c++) { // a zero diagonal
            double e[6] = {0}, b[6];
            e[c] = size;
            exp_twice(e, b, 3);
            assert_near(b[c], sinh(2 * size), 8 * DBL_EPSILON * cosh(2 * size));
            assert_near(b[mpm_sym_row(c)], cosh(2 * size), 8 * DBL_EPSILON * cosh(2 * size));
            const int alone = 3 - mpm_sym_row(c) - mpm_sym_column(c);
            assert_near(b[alone], 1, 8 * DBL_EPSILON);
        }
    }
}

// b of a strain whose deviator shrinks by a part, on both sides of the series' reach, against the
// eigenvalues in long double. Rounded are b, what is added and the sum; beyond the reach as
// mpm_exp_twice is.
static void test_spectral_exp_of_less(void **state) {
    (void)state;
    static const double norms[] = {1e-9, 1e-5, 1e-3, 5e-3, 1 - 1e-12, 1 + 1e-12, 0.02, 0.5};
    FOR_ROTATED(dim, trial) {
        const double mean = 0.1 * uniform();
        for (size_t n = 0; n < sizeof norms / sizeof *norms; n++) {
            const double A = fabs(norms[n] - 1) < 1e-9 ? norms[n] * MPM_SHORT_REACH : norms[n];
            const double part = trial % 3 ? fmax(0.5 * A, 0.5 * (1 + uniform())) : 1; // |D| <= 1
            double w[3], Q[9], D[6], b[6], less[6];
            long double wide[6] = {0}, exact[6] = {0};
            const double shift[3] = {uniform(), uniform(), uniform()};
            for (int d = 0; d < 3; d++) {
                w[d] = shift[d] - (shift[0] + shift[1] + shift[2]) / 3;
            }
            rotation(Q, dim);
            compose(w, Q, D, dim);
            const double scale = A / (2 * part) / norm_of(D, dim);
            for (int d = 0; d < 3; d++) {
                w[d] *= scale;
            }
            for (int k = 0; k < MPM_SYM(dim); k++) {
                D[k] *= scale;
                for (int d = 0; d < 3; d++) {
                    const long double q2 =
                        (long double)Q[3 * mpm_sym_row(k) + d] * Q[3 * mpm_sym_column(k) + d];
                    wide[k] += q2 * expl(2 * (mean + (long double)w[d]));
                    exact[k] += q2 * expl(2 * (mean + (1 - (long double)part) * w[d]));
                }
                b[k] = (double)wide[k];
            }
            const double norm = norm_of(D, dim);
            if (dim == 2) {
                mpm_exp_twice_less(b, D, norm * norm, part, mean, less, 2);
            } else {
                mpm_exp_twice_less(b, D, norm * norm, part, mean, less, 3);
            }
            const double ulps = A <= MPM_SHORT_REACH ? 1 + 4 * A : 8;
            for (int k = 0; k < MPM_SYM(dim); k++) {
                assert_near(less[k], (double)exact[k], ulps * DBL_EPSILON * size_of(b, dim));
            }
        }
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_spectral_log_undoes_exp),
        cmocka_unit_test(test_spectral_log_and_exp_are_those_of_the_eigenvalues),
        cmocka_unit_test(test_spectral_repeated_eigenvalues),
        cmocka_unit_test(test_spectral_isotropic_is_exact),
        cmocka_unit_test(test_spectral_extreme_on_the_axes),
        cmocka_unit_test(test_spectral_extreme_in_rotated_frames),
        cmocka_unit_test(test_spectral_exp_keeps_the_determinant),
        cmocka_unit_test(test_spectral_2d_is_3d),
        cmocka_unit_test(test_spectral_is_continuous_at_its_switches),
        cmocka_unit_test(test_spectral_log_is_linear_near_the_identity),
        cmocka_unit_test(test_spectral_exp_of_pure_shear),
        cmocka_unit_test(test_spectral_exp_of_less),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
