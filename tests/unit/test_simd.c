// Lanes on every instruction set that this processor has: elementary functions against long double,
// and that a lane never touches another one's memory or value.
#include <fenv.h>
#include <float.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include <cmocka.h>

#include "tests/unit/lanes.h"

#define N 4096
static double x[N], y[N];

static uint64_t seed;
static double uniform(void) { // in [-1, 1)
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 4503599627370496.0 - 1;
}

// Distance of a value from the exact one, in units in the last place of the exact one's double.
static double ulps(double value, long double exact) {
    int exponent;
    frexp((double)exact, &exponent);
    const long double ulp = ldexpl(1, exponent < -1021 ? -1074 : exponent - 53);
    return (double)(fabsl(value - exact) / ulp);
}

static void assert_accurate(const struct lanes *l, const char *what, double bound,
                            void (*f)(const double *, double *, size_t),
                            long double (*exact)(long double), double (*argument)(void)) {
    for (int round = 0; round < 25; round++) {
        for (int i = 0; i < N; i++) {
            x[i] = argument();
        }
        f(x, y, N);
        for (int i = 0; i < N; i++) {
            const double off = ulps(y[i], exact(x[i]));
            if (!(off <= bound)) {
                fail_msg("%s: %s(%a) = %a is %g ulp off", l->name, what, x[i], y[i], off);
            }
        }
    }
}

static double any_positive(void) {
    return ldexp(1.5 + 0.5 * uniform(), (int)(1022 * uniform()));
}
static double any_subnormal(void) {
    return DBL_MIN * (0.5 + 0.5 * uniform());
}
static double near_one(void) { // to 1 +- 2^-52
    return 1 + uniform() * exp2(-26 - 26 * uniform());
}
static double ratio(void) {
    return exp2(2 * uniform());
}
static double exponent(void) {
    return 708 * uniform();
}
static double exponent_of_subnormal(void) {
    return -726 + 18 * uniform();
}
static double small_exponent(void) {
    return uniform() * exp2(-20 + 20 * uniform());
}

// Bounds are those measured (simd.h) and some. The plain lanes are libm's, whose cbrt holds 4 ulp.
static void test_simd_log_is_accurate(void **state) {
    (void)state;
    FOR_LANES(l) {
        assert_accurate(l, "log", 1, l->log, logl, any_positive);
        assert_accurate(l, "log", 1, l->log, logl, any_subnormal);
        assert_accurate(l, "log", 1, l->log, logl, near_one);
        assert_accurate(l, "log", 1, l->log, logl, ratio);
    }
}

static void test_simd_exp_is_accurate(void **state) {
    (void)state;
    FOR_LANES(l) {
        assert_accurate(l, "exp", 1.25, l->exp, expl, exponent);
        assert_accurate(l, "exp", 1.25, l->exp, expl, exponent_of_subnormal);
        assert_accurate(l, "exp", 1.25, l->exp, expl, small_exponent);
    }
}

static void test_simd_cbrt_is_accurate(void **state) {
    (void)state;
    FOR_LANES(l) {
        const double bound = l->count == 1 ? 4 : 1;
        assert_accurate(l, "cbrt", bound, l->cbrt, cbrtl, any_positive);
        assert_accurate(l, "cbrt", bound, l->cbrt, cbrtl, any_subnormal);
        assert_accurate(l, "cbrt", bound, l->cbrt, cbrtl, near_one);
        assert_accurate(l, "cbrt", bound, l->cbrt, cbrtl, ratio);
    }
}

static bool same(double a, double b) {
    return (isnan(a) && isnan(b)) || memcmp(&a, &b, sizeof a) == 0;
}

// In every lane, beside ordinary neighbours, whose bits do not change.
static void test_simd_edges(void **state) {
    (void)state;
    const double edges[] = {0,       -0.0,    1,        -1,        INFINITY, -INFINITY, NAN,
                            DBL_MIN, DBL_MAX, 5e-324,   -5e-324,   -DBL_MAX, 709,       709.78,
                            709.79,  710,     1e10,     -708,      -708.4,   -745.1,    -745.2,
                            -746,    -1e10,   0x1p-900, 0x1p-1000, 0x1p1000, 0x1p1001,  0x1p1023};
    const int traps = fedisableexcept(FE_ALL_EXCEPT);
    FOR_LANES(l) {
        const struct {
            void (*f)(const double *, double *, size_t);
            double (*exact)(double);
        } functions[] = {{l->log, log}, {l->exp, exp}, {l->cbrt, cbrt}};
        for (size_t k = 0; k < 3; k++) {
            double usual[8], mixed[8], in[8];
            for (int i = 0; i < 8; i++) {
                in[i] = 1.25 + 0.125 * i;
            }
            functions[k].f(in, usual, 8);
            for (size_t e = 0; e < sizeof edges / sizeof *edges; e++) {
                for (int i = 0; i < 8; i++) {
                    const double keep = in[i];
                    in[i] = edges[e];
                    functions[k].f(in, mixed, 8);
                    in[i] = keep;
                    const double exact = functions[k].exact(edges[e]);
                    if (isfinite(exact) && exact != 0) {
                        assert_true(ulps(mixed[i], exact) <= 5); // two bounds of the tests above
                    } else {
                        assert_true(same(mixed[i], exact));
                    }
                    for (int j = 0; j < 8; j++) {
                        assert_true(j == i || same(mixed[j], usual[j]));
                    }
                }
            }
        }
        const double one[8] = {1, 1, 1, 1, 1, 1, 1, 1}, zero[8] = {0};
        double out[8];
        l->log(one, out, 8);
        assert_memory_equal(out, zero, sizeof out);
        l->exp(zero, out, 8);
        assert_memory_equal(out, one, sizeof out);
        l->cbrt(one, out, 8);
        assert_memory_equal(out, one, sizeof out);
    }
    feenableexcept(traps);
}

static void test_simd_exact_functions(void **state) {
    (void)state;
    FOR_LANES(l) {
        for (int i = 0; i < N; i++) {
            x[i] = ldexp(uniform(), i % 64);
        }
        l->abs(x, y, N);
        for (int i = 0; i < N; i++) {
            assert_true(same(y[i], fabs(x[i])));
        }
        l->trunc(x, y, N);
        for (int i = 0; i < N; i++) {
            assert_true(same(y[i], trunc(x[i])));
        }
        l->floor(x, y, N);
        for (int i = 0; i < N; i++) {
            assert_true(same(y[i], floor(x[i])));
        }
        for (int i = 0; i < N; i++) {
            int32_t to[8];
            x[i] = fabs(x[i]);
            if (i % 8 == 7 && i % 64 < 32) {
                l->to_int32(to, x + i - 7);
                for (int k = 0; k < l->count; k++) {
                    assert_int_equal(to[k], (int32_t)x[i - 7 + k]);
                }
            }
        }
        l->sqrt(x, y, N);
        for (int i = 0; i < N; i++) {
            assert_true(same(y[i], sqrt(x[i])));
        }
        for (int i = 0; i < N; i += 8) {
            double a = x[i], b = x[i], total = 0;
            for (int k = 0; k < l->count; k++) {
                a = fmin(a, x[i + k]);
                b = fmax(b, x[i + k]);
                total += x[i + k];
            }
            assert_true(l->min(x + i) == a && l->max(x + i) == b);
            assert_true(fabs(l->sum(x + i) - total) <= 8 * DBL_EPSILON * total);
        }
    }
}

static void test_simd_masks(void **state) {
    (void)state;
    FOR_LANES(l) {
        for (unsigned bits = 0; bits < 1u << l->count; bits++) {
            double a[8], b[8], out[8];
            for (int i = 0; i < l->count; i++) {
                a[i] = uniform();
                b[i] = bits >> i & 1 ? a[i] + 1 : a[i] - (i % 2);
            }
            const unsigned found = l->less(a, b, out), all = (1u << l->count) - 1;
            assert_int_equal(found, (bits != 0) | (bits == all) << 1 | (bits != all) << 2 |
                                        (bits == 0) << 3);
            for (int i = 0; i < l->count; i++) {
                assert_true(same(out[i], bits >> i & 1 ? a[i] : b[i]));
            }
        }
    }
}

// Lanes outside [first, last) lie on pages that may not be touched.
static void test_simd_leaves_other_lanes_alone(void **state) {
    (void)state;
    const size_t page = (size_t)sysconf(_SC_PAGESIZE), each = page / sizeof(double);
    double *pages = mmap(NULL, 3 * page, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    assert_true(pages != MAP_FAILED);
    double *open = pages + each;
    assert_int_equal(mprotect(open, page, PROT_READ | PROT_WRITE), 0);
    FOR_LANES(l) {
        for (int first = -1; first <= l->count + 1; first++) {
            for (int last = -1; last <= l->count + 1; last++) {
                // The first lane of the range begins the page, or the last one ends it.
                for (int side = 0; side < 2; side++) {
                    const int from = first < 0 ? 0 : first, to = last > l->count ? l->count : last;
                    const bool empty = from >= to;
                    double *base = empty ? pages : side ? open + each - to : open - from;
                    double in[8], out[8];
                    for (size_t i = 0; i < each; i++) {
                        open[i] = (double)i;
                    }
                    l->load(base, first, last, -7, out);
                    for (int i = 0; i < l->count; i++) {
                        in[i] = 1000 + i;
                        assert_true(out[i] == (i >= from && i < to ? base[i] : -7));
                    }
                    l->store(base, in, first, last);
                    for (size_t i = 0; i < each; i++) {
                        const ptrdiff_t lane = open + i - base;
                        const bool inside = !empty && lane >= from && lane < to;
                        assert_true(open[i] == (inside ? in[lane] : (double)i));
                    }
                }
            }
        }
    }
    munmap(pages, 3 * page);
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_simd_log_is_accurate),
        cmocka_unit_test(test_simd_exp_is_accurate),
        cmocka_unit_test(test_simd_cbrt_is_accurate),
        cmocka_unit_test(test_simd_edges),
        cmocka_unit_test(test_simd_exact_functions),
        cmocka_unit_test(test_simd_masks),
        cmocka_unit_test(test_simd_leaves_other_lanes_alone),
    };
    FOR_LANES(l) {
        print_message("%s: %d lanes\n", l->name, l->count);
    }
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
