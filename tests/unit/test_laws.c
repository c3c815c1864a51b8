// The laws in lanes of every instruction set that this processor has, against the plain ones (which
// test_material, test_plasticity and test_spectral hold against exact solutions).
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
#include "tests/unit/lanes.h"

#define N 1024

static uint64_t seed;
static double uniform(void) { // in [-1, 1)
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 4503599627370496.0 - 1;
}

// Parameters of each law, with the modulus that its stresses are measured by. Soft materials yield
// at strains of 1e-3, strong ones never.
#define MU 1000.0
#define NU 0.3
#define E_MODULUS (2 * MU * (1 + NU))
#define K_BULK (E_MODULUS / (3 * (1 - 2 * NU)))
static const struct variant {
    enum mpm_law law;
    double parameters[MPM_MAX_PARAMETERS], modulus;
} variants[] = {
    {MPM_LAW_neo_hookean, {2, E_MODULUS, NU}, K_BULK},
    {MPM_LAW_neo_hookean, {2, E_MODULUS, 0.4999}, E_MODULUS / (3 * (1 - 2 * 0.4999))},
    {MPM_LAW_newtonian, {2, K_BULK, 3}, K_BULK},
    {MPM_LAW_hencky_j2, {2, E_MODULUS, NU, 1e9}, K_BULK},
    {MPM_LAW_hencky_j2, {2, E_MODULUS, NU, 2}, K_BULK},
    {MPM_LAW_hencky_j2, {2, E_MODULUS, NU, 2, 0.5, 20}, K_BULK},
    {MPM_LAW_hencky_j2, {2, E_MODULUS, 0.4999, 2, 0.5, 0}, E_MODULUS / (3 * (1 - 2 * 0.4999))},
    {MPM_LAW_hencky_j2, {2, E_MODULUS, NU, 2, 1e-3, 1400}, K_BULK}, // nearly the limit, 3 mu/2
};
#define FOR_VARIANTS(dim, v)                                                                       \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (const struct variant *v = variants;                                                   \
             v < variants + sizeof variants / sizeof *variants; v++)

struct memory {
    double kept[9 * N], a[N], L[9 * N], sigma[6 * N];
};
static struct memory start, plain, fast, turned;

static struct lanes_states states(struct memory *m) {
    return (struct lanes_states){.n = N, .kept = m->kept, .a = m->a, .L = m->L, .sigma = m->sigma};
}

static int components(enum mpm_law law, int dim) {
    switch (mpm_material_at(law)->kinematics) {
    case MPM_KEEPS_F:
        return dim * dim;
    case MPM_KEEPS_J:
        return 1;
    default:
        return MPM_SYM(dim);
    }
}

// F of the p-th of the states: the identity; small, middling and large strains; equal stretches;
// one direction that differs; extreme stretches along the axes.
static void deformation(int p, int dim, double *F) {
    const double sizes[] = {1e-12, 1e-6, 1e-3, 3e-3, 0.03, 0.3};
    const int kind = p % 11;
    memset(F, 0, 9 * sizeof *F);
    const double stretch = 1 + 0.3 * uniform();
    for (int i = 0; i < dim; i++) {
        for (int j = 0; j < dim; j++) {
            F[i * dim + j] = i == j;
            if (kind >= 1 && kind <= 6) {
                F[i * dim + j] += sizes[kind - 1] * uniform() / (kind == 6 ? dim : 1);
            } else if (kind == 7) {
                F[i * dim + j] *= stretch;
            } else if (kind == 8) {
                F[i * dim + j] *= i == 0 ? stretch : 0.9;
            } else if (kind == 9) {
                F[i * dim + j] *= pow(10, 3 * uniform());
            }
        }
    }
}

static void begin(const struct variant *v, int dim) {
    const enum mpm_kinematics keeps = mpm_material_at(v->law)->kinematics;
    memset(&start, 0, sizeof start);
    for (int p = 0; p < N; p++) {
        double F[9];
        deformation(p, dim, F);
        start.a[p] = p % 3 ? 0.01 * (1 + uniform()) : 0;
        for (int k = 0; k < dim * dim; k++) {
            start.L[k * N + p] = p % 11 ? uniform() : 0;
        }
        if (keeps == MPM_KEEPS_J) {
            start.kept[p] = mpm_det(F, dim);
        }
        for (int k = 0; keeps == MPM_KEEPS_F && k < dim * dim; k++) {
            start.kept[k * N + p] = F[k];
        }
        for (int k = 0; keeps == MPM_KEEPS_B && k < MPM_SYM(dim); k++) {
            const int i = mpm_sym_row(k), j = mpm_sym_column(k);
            double b = i < dim ? 0 : p % 2 && p % 11 ? 1 + 1e-3 * uniform() : 1;
            for (int d = 0; d < dim && i < dim; d++) {
                b += F[i * dim + d] * F[j * dim + d];
            }
            start.kept[k * N + p] = b;
        }
    }
}

static void run(const struct lanes *l, const struct variant *v, int dim, struct memory *m) {
    struct lanes_states s = states(m);
    l->stress(v->law, dim, v->parameters, &s);
}

// How large the terms are that cancel in the stress of particle p: of the size of b, and of 1/J.
static double size_of(const struct variant *v, int dim, int p) {
    double largest = 1, J = 1;
    for (int k = 0; k < components(v->law, dim); k++) {
        largest = fmax(largest, fabs(start.kept[k * N + p]));
    }
    if (mpm_material_at(v->law)->kinematics == MPM_KEEPS_F) {
        double F[9];
        for (int k = 0; k < dim * dim; k++) {
            F[k] = start.kept[k * N + p];
        }
        J = mpm_det(F, dim);
        largest = pow(largest, dim);
    } else if (mpm_material_at(v->law)->kinematics == MPM_KEEPS_B) {
        double b[6];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            b[k] = start.kept[k * N + p];
        }
        J = sqrt(mpm_det_sym(b, dim));
        largest *= 10; // logarithms
    }
    return largest / fmin(J, 1);
}

// To 1e-13 of the modulus. A few eps: of b, which a logarithm turns into the same of strain.
static void test_laws_agree_with_the_plain_ones(void **state) {
    (void)state;
    int yielded = 0, held = 0;
    FOR_VARIANTS(dim, v) {
        begin(v, dim);
        plain = start;
        run(&lanes_1, v, dim, &plain);
        FOR_LANES(l) {
            fast = start;
            run(l, v, dim, &fast);
            for (int p = 0; p < N; p++) {
                const double tol = 1e-13 * size_of(v, dim, p);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    const double off = fabs(fast.sigma[k * N + p] - plain.sigma[k * N + p]);
                    if (!(off <= tol * v->modulus)) {
                        fail_msg("%s, %s in %dD, particle %d: %.17g against %.17g", l->name,
                                 mpm_material_at(v->law)->name, dim, p, fast.sigma[k * N + p],
                                 plain.sigma[k * N + p]);
                    }
                }
                for (int k = 0; k < components(v->law, dim); k++) {
                    const double off = fabs(fast.kept[k * N + p] - plain.kept[k * N + p]);
                    assert_true(off <= tol);
                    if (fast.a[p] == start.a[p]) { // what does not flow keeps its bits
                        assert_true(fast.kept[k * N + p] == start.kept[k * N + p]);
                    }
                }
                assert_true(fabs(fast.a[p] - plain.a[p]) <= tol);
                *(fast.a[p] > start.a[p] ? &yielded : &held) += 1;
            }
        }
    }
    assert_true(yielded > 1000 && held > 1000);
}

// A particle gets the same bits in every lane, whatever its neighbours are.
static void test_laws_do_not_depend_on_the_lane(void **state) {
    (void)state;
    FOR_VARIANTS(dim, v) {
        begin(v, dim);
        FOR_LANES(l) {
            fast = start;
            run(l, v, dim, &fast);
            for (int by = 1; by < 11; by++) {
                for (int p = 0; p < N; p++) {
                    const int to = (p * by * 2 + p + by) % N; // odd factor: a permutation
                    for (int k = 0; k < 9; k++) {
                        turned.kept[k * N + to] = start.kept[k * N + p];
                        turned.L[k * N + to] = start.L[k * N + p];
                    }
                    turned.a[to] = start.a[p];
                }
                run(l, v, dim, &turned);
                for (int p = 0; p < N; p++) {
                    const int to = (p * by * 2 + p + by) % N;
                    assert_true(turned.a[to] == fast.a[p]);
                    for (int k = 0; k < MPM_SYM(dim); k++) {
                        assert_true(turned.sigma[k * N + to] == fast.sigma[k * N + p]);
                    }
                    for (int k = 0; k < components(v->law, dim); k++) {
                        assert_true(turned.kept[k * N + to] == fast.kept[k * N + p]);
                    }
                }
            }
        }
    }
}

static void test_laws_identity_has_no_stress(void **state) {
    (void)state;
    FOR_VARIANTS(dim, v) {
        begin(v, dim);
        FOR_LANES(l) {
            fast = start;
            run(l, v, dim, &fast);
            for (int p = 0; p < N; p += 11) {
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    assert_true(fast.sigma[k * N + p] == 0);
                }
            }
        }
    }
}

// Of flowing particles: on the yield surface, to round-off of the trial strain.
static void test_laws_return_meets_the_strength(void **state) {
    (void)state;
    FOR_VARIANTS(dim, v) {
        if (v->law != MPM_LAW_hencky_j2) {
            continue;
        }
        begin(v, dim);
        const double *par = v->parameters;
        const double residual = par[4] > 0 ? par[4] : par[3];
        const double mu = par[1] / (2 * (1 + par[2]));
        FOR_LANES(l) {
            fast = start;
            run(l, v, dim, &fast);
            for (int p = 0; p < N; p++) {
                double b[6], e[6], norm2 = 0;
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    b[k] = fast.kept[k * N + p];
                }
                mpm_half_log_far(b, e, dim, 1, 1);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    const double dev = e[k] - (k < 3 ? (e[0] + e[1] + e[2]) / 3 : 0);
                    norm2 += (k < 3 ? 1 : 2) * dev * dev;
                }
                const double strength = residual + (par[3] - residual) * exp(-par[5] * fast.a[p]);
                const double off = 2 * mu * sqrt(norm2) - sqrt(2.0 / 3) * strength;
                const double tol = 1e-14 * mu * size_of(v, dim, p);
                assert_true(off <= tol);
                assert_true(fast.a[p] == start.a[p] || off >= -tol);
            }
        }
    }
}

// The series and the exact functions meet at the series' reach, in lanes: random tensors around it.
static void test_laws_tensor_functions_in_lanes(void **state) {
    (void)state;
    static double in[6 * N], out[6 * N];
    for (int dim = 2; dim <= 3; dim++) {
        FOR_LANES(l) {
            for (int p = 0; p < N; p++) {
                const double size = p % 7 ? 0.15 * pow(10, 0.5 * uniform() - 0.5) : 0.4;
                double root[6] = {0}, b[6];
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    root[k] = size * uniform() + (k < 3);
                }
                mpm_commuting_product(root, root, b, 3);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    in[k * N + p] = b[k];
                }
            }
            l->half_log(in, out, N, dim);
            for (int p = 0; p < N; p++) {
                double x[6], y[6];
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    x[k] = in[k * N + p];
                }
                mpm_half_log_far(x, y, dim, 1, 1);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    assert_true(fabs(out[k * N + p] - y[k]) <= 2e-15); // a few eps
                }
            }
            for (int k = 0; k < MPM_SYM(dim) * N; k++) {
                in[k] -= k < 3 * N;
            }
            l->exp_twice(in, out, N, dim);
            for (int p = 0; p < N; p++) {
                double x[6], y[6];
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    x[k] = in[k * N + p];
                }
                mpm_exp_twice_far(x, y, dim, 1, 1);
                for (int k = 0; k < MPM_SYM(dim); k++) {
                    assert_true(fabs(out[k * N + p] - y[k]) <= 2e-15);
                }
            }
        }
    }
}

static void test_laws_list_agrees_with_the_materials(void **state) {
    (void)state;
    static const struct {
        const char *name;
        enum mpm_kinematics keeps;
    } list[] = {
#define X(name, keeps) [MPM_LAW_##name] = {#name, MPM_##keeps},
        MPM_LAWS(X)
#undef X
    };
    assert_int_equal(mpm_material_count(), MPM_N_LAWS);
    for (int law = 0; law < MPM_N_LAWS; law++) {
        const struct mpm_material *m = mpm_material_at((size_t)law);
        assert_string_equal(m->name, list[law].name);
        assert_int_equal(m->kinematics, list[law].keeps);
        assert_int_equal(mpm_material_law(m), law);
        bool tried = false;
        for (size_t k = 0; k < sizeof variants / sizeof *variants; k++) {
            tried |= (int)variants[k].law == law;
        }
        assert_true(tried); // a new law gets a variant above
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_laws_agree_with_the_plain_ones),
        cmocka_unit_test(test_laws_do_not_depend_on_the_lane),
        cmocka_unit_test(test_laws_identity_has_no_stress),
        cmocka_unit_test(test_laws_return_meets_the_strength),
        cmocka_unit_test(test_laws_tensor_functions_in_lanes),
        cmocka_unit_test(test_laws_list_agrees_with_the_materials),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
