// Hencky elasticity with J2 plasticity on single particles: the return map against closed forms.
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

#include "server/mpm/laws.h"
#include "server/mpm/sim.h"
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

#define MU 1000.0
#define NU 0.3
#define K_BULK (2 * MU * (1 + NU) / (3 * (1 - 2 * NU)))
#define PEAK 5.0
#define RESIDUAL 1.0
#define RATE 20.0
static const double perfect[MPM_MAX_PARAMETERS] = {2, 2 * MU *(1 + NU), NU, PEAK};
static const double softening[MPM_MAX_PARAMETERS] = {2, 2 * MU *(1 + NU), NU, PEAK, RESIDUAL, RATE};

static double strength(const double *par, double a) {
    return par == perfect ? PEAK : RESIDUAL + (PEAK - RESIDUAL) * exp(-RATE * a);
}

static struct mpm_particles s; // one at a time
static void create(const double *parameters, int dim, size_t n) {
    s = (struct mpm_particles){.material = mpm_material_find("hencky_j2"), .dim = dim};
    memcpy(s.parameters, parameters, MPM_MAX_PARAMETERS * sizeof *parameters);
    s.density = parameters[0];
    assert_true(mpm_particles_create(&s, n, 0));
}

#define FOR_LAWS(dim, par)                                                                         \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (const double *par = perfect; par; par = par == perfect ? softening : NULL)

static void full(const double *field, size_t p, double T[9]) {
    memset(T, 0, 9 * sizeof *T);
    for (int k = 0; k < MPM_SYM(s.dim); k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        T[i * 3 + j] = T[j * 3 + i] = field[mpm_at(p, MPM_SYM(s.dim), k)];
    }
}

static void multiply(const double *A, const double *B, bool transposed, double *out) {
    double C[9];
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            C[i * 3 + j] = 0;
            for (int k = 0; k < 3; k++) {
                C[i * 3 + j] += A[i * 3 + k] * (transposed ? B[j * 3 + k] : B[k * 3 + j]);
            }
        }
    }
    memcpy(out, C, sizeof C);
}

// b <- dF b dF^T for a 3 x 3 dF, then the return map.
static void deform(const double *dF) {
    double b[9];
    full(s.b, 0, b);
    multiply(dF, b, false, b);
    multiply(b, dF, true, b);
    for (int k = 0; k < MPM_SYM(s.dim); k++) {
        s.b[mpm_at(0, MPM_SYM(s.dim), k)] = b[mpm_sym_row(k) * 3 + mpm_sym_column(k)];
    }
    s.material->stress[s.dim - 2](&s, 0, s.n);
}

static double ratio(void) {
    return mpm_ratio_in_use(&s, 0);
}

// tau = J sigma, its mean, and |dev tau|.
static double kirchhoff(double tau[9], double *mean) {
    const double J = ratio();
    double norm2 = 0;
    full(s.sigma, 0, tau);
    for (int k = 0; k < 9; k++) {
        tau[k] *= J;
    }
    *mean = (tau[0] + tau[4] + tau[8]) / 3;
    for (int k = 0; k < 9; k++) {
        const double t = tau[k] - (k % 4 == 0 ? *mean : 0);
        norm2 += t * t;
    }
    return sqrt(norm2);
}

// A random increment of size 1e-3 (some elastic strain at yield, 2.5e-3) to 1.
static void random_increment(double *dF, int dim, double size) {
    memset(dF, 0, 9 * sizeof *dF);
    dF[8] = 1;
    for (int i = 0; i < dim; i++) {
        for (int j = 0; j < dim; j++) {
            dF[i * 3 + j] = (i == j) + size * uniform();
        }
    }
}

// |dev tau| = sqrt(2/3) sigma_y where it flows and below where not, to round-off: of tau's mean
// through sigma (K tr eps, up to K), and of b (2 mu eps).
static void test_plasticity_meets_the_strength(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        int flowed = 0, held = 0;
        for (int trial = 0; trial < 300; trial++) {
            create(par, dim, 1);
            for (int k = 0; k < 10; k++) {
                double dF[9], tau[9], mean;
                const double a = s.plastic_strain[0], J = ratio();
                random_increment(dF, dim, pow(10, -3.5 + 1.5 * (1 + uniform()) / 2 * 2));
                const double det = mpm_det(dF, 3);
                if (det < 0.5) {
                    continue;
                }
                deform(dF);
                const double norm = kirchhoff(tau, &mean);
                const double radius = sqrt(2.0 / 3) * strength(par, s.plastic_strain[0]);
                const double tol = 1e-14 * (K_BULK + fabs(mean));
                assert_true(s.plastic_strain[0] >= a);
                assert_true(norm <= radius + tol);
                if (s.plastic_strain[0] > a) {
                    assert_near(norm, radius, tol);
                    flowed++;
                } else {
                    held++;
                }
                // Plastic flow keeps the volume: det b = J^2. Large strains cancel in det.
                assert_near(ratio() / (J * det), 1, 1e-13);
                assert_near(mean, K_BULK * log(ratio()), tol + 1e-13 * K_BULK);
            }
            mpm_particles_free(&s);
        }
        assert_true(flowed > 500 && held > 100);
    }
}

// The stored b is that of the returned stress: asked again, nothing flows but round-off.
static void test_plasticity_returned_state_is_at_rest(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int trial = 0; trial < 200; trial++) {
            create(par, dim, 1);
            double dF[9], before[9], after[9];
            random_increment(dF, dim, 0.2);
            deform(dF);
            const double a = s.plastic_strain[0];
            full(s.sigma, 0, before);
            s.material->stress[dim - 2](&s, 0, 1);
            full(s.sigma, 0, after);
            assert_near(s.plastic_strain[0], a, 1e-14);
            for (int k = 0; k < 9; k++) {
                assert_near(after[k], before[k], 1e-12 * K_BULK);
            }
            mpm_particles_free(&s);
        }
    }
}

// sigma_y(a) on the closed form of a return from a trial state: with x = |d eps_p|,
// 2 mu x + sqrt(2/3) sigma_y(a + sqrt(2/3) x) = |dev tau_trial|, solved here by bisection.
static double multiplier(const double *par, double norm, double a) {
    double low = 0, high = norm / (2 * MU);
    for (int k = 0; k < 200; k++) {
        const double x = (low + high) / 2;
        const double left =
            norm - 2 * MU * x - sqrt(2.0 / 3) * strength(par, a + sqrt(2.0 / 3) * x);
        *(left > 0 ? &low : &high) = x;
    }
    return (low + high) / 2;
}

static void test_plasticity_return_solves_its_equation(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int trial = 0; trial < 500; trial++) {
            create(par, dim, 1);
            // Diagonal strains: a trial deviator of any size, from just above the surface on.
            const double a = trial % 3 ? 0.1 * (1 + uniform()) : 0;
            const double radius = sqrt(2.0 / 3) * strength(par, a);
            const double norm = radius * (1 + pow(10, -12 + 14 * (1 + uniform()) / 2));
            double e[3] = {uniform(), uniform(), uniform()};
            const double mean = (e[0] + e[1] + e[2]) / 3;
            const double size =
                sqrt(pow(e[0] - mean, 2) + pow(e[1] - mean, 2) + pow(e[2] - mean, 2));
            for (int d = 0; d < 3; d++) {
                e[d] = (e[d] - mean) / size * norm / (2 * MU);
                s.b[mpm_at(0, MPM_SYM(dim), d)] = exp(2 * e[d]);
            }
            s.plastic_strain[0] = a;
            s.material->stress[dim - 2](&s, 0, 1);
            const double x = multiplier(par, norm, a);
            // eps of b is eps/2 of the strain; softening amplifies by 1/(1 - RATE fall/3 mu).
            assert_near(s.plastic_strain[0] - a, sqrt(2.0 / 3) * x, 2e-15 * (1 + norm / MU));
            mpm_particles_free(&s);
        }
    }
}

// The return alone on both sides of its reaches, against its equation in long double, d = d0 - q
// h(d). Within them nothing but roundings, beyond them what its iterates stop at.
static void test_plasticity_return_within_its_reaches(void **state) {
    (void)state;
    static const double parts[] = {1e-6, 1e-3, 0.1, 0.5, 1 - 1e-12, 1 + 1e-12, 2, 30, 1e4};
    for (double q = 1e-8; q < 50; q *= 1.7) {
        for (size_t k = 0; k < sizeof parts / sizeof *parts; k++) {
            const double d0 = parts[k] * fmin(HENCKY_J2_REACH, HENCKY_J2_SLOPE / q), a = 0.02;
            struct hencky_j2 c = {
                .residual = 1e-4, .softening = RATE, .rate = sqrt(2.0 / 3) * RATE};
            const double soft = q / (1 + q) / c.rate, x0 = d0 / c.rate;
            c.fall = soft * exp(RATE * a);
            const double norm = c.residual + soft + x0 / (1 + q);
            const double x = hencky_j2_return(&c, norm * norm, x0, q, a);
            long double d = d0;
            for (int i = 0; i < 60; i++) { // from above: h is convex
                const long double e = expm1l(-d);
                d -= (d - d0 + q * (e + d)) / (1 - q * e);
            }
            const bool far = d0 > HENCKY_J2_REACH || q * d0 > HENCKY_J2_SLOPE;
            const double tol = 2 * DBL_EPSILON * x0 + (far ? 4 * DBL_EPSILON * norm * (1 + q) : 0);
            assert_near(x, (double)(d / c.rate), tol);
        }
    }
}

// Uniaxial strain in n small steps, F = diag(lambda, 1, 1). Before yield s = 2 mu (2/3) ln lambda
// along it; after it von Mises = sigma_y(a) with a = ln lambda - sigma_y(a)/(3 mu)... exactly,
// since the flow is radial: the axes of strain never turn. In 2D the same.
static void test_plasticity_uniaxial_strain(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int axis = 0; axis < dim; axis++) {
            for (int sign = -1; sign <= 1; sign += 2) {
                create(par, dim, 1);
                double total = 0;
                for (int k = 0; k < 200; k++) {
                    double dF[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, tau[9], mean;
                    dF[axis * 4] = exp(sign * 5e-4);
                    total += 5e-4;
                    deform(dF);
                    // von Mises of the elastic part: 2 mu (total - 3/2 a), as the plastic strain
                    // along the axis is 2/3 of... d eps_p = a, -a/2, -a/2: deviator total - 3/2 a.
                    double a = 0;
                    if (2 * MU * total > PEAK) { // fixed point of 2 mu total - 3 mu a = sigma_y(a)
                        for (int i = 0; i < 200; i++) {
                            a = (2 * MU * total - strength(par, a)) / (3 * MU);
                        }
                    }
                    const double mises = 2 * MU * total - 3 * MU * a;
                    assert_near(s.plastic_strain[0], a, 1e-13); // 200 steps of a few eps
                    kirchhoff(tau, &mean);
                    const double other = tau[(axis + 1) % 3 * 4];
                    assert_near(sign * (tau[axis * 4] - other), mises, 1e-9 * PEAK);
                    assert_near(tau[(axis + 2) % 3 * 4], other, 1e-9 * PEAK);
                    assert_near(mean, sign * K_BULK * total, 1e-10 * K_BULK);
                }
                assert_true(s.plastic_strain[0] > 0.05);
                mpm_particles_free(&s);
            }
        }
    }
}

// Uniaxial stress in 3D: the lateral stretch is chosen so that nothing acts across: sigma =
// sigma_y.
static void test_plasticity_uniaxial_stress_is_the_strength(void **state) {
    (void)state;
    for (const double *par = perfect; par; par = par == perfect ? softening : NULL) {
        create(par, 3, 1);
        for (int k = 1; k <= 40; k++) {
            const double b[6] = {s.b[0 * MPM_BLOCK], s.b[1 * MPM_BLOCK], s.b[2 * MPM_BLOCK]};
            const double a = s.plastic_strain[0];
            double low = -0.01, high = 0.01, tau[9], mean;
            for (int i = 0; i < 100; i++) { // lateral strain of this step
                const double lateral = (low + high) / 2;
                for (int d = 0; d < 3; d++) {
                    s.b[d * MPM_BLOCK] = b[d];
                }
                s.plastic_strain[0] = a;
                const double dF[9] = {exp(2e-3), 0, 0, 0, exp(lateral), 0, 0, 0, exp(lateral)};
                deform(dF);
                kirchhoff(tau, &mean);
                *(tau[4] < 0 ? &low : &high) = lateral;
            }
            const double a_now = s.plastic_strain[0];
            if (a_now > a) {
                assert_near(tau[0], strength(par, a_now), 1e-10 * K_BULK * 1e-2);
                // All but the elastic strain is plastic: a = eps - tau/E.
                assert_near(a_now, 2e-3 * k - tau[0] / (2 * MU * (1 + NU)), 1e-12);
            } else {
                assert_near(tau[0], 2 * MU * (1 + NU) * 2e-3 * k, 1e-8);
            }
        }
        assert_true(s.plastic_strain[0] > 0.07);
        mpm_particles_free(&s);
    }
}

// Simple shear in small steps: elastic to tau = mu gamma, then |tau| = sigma_y/sqrt(3) = s_u, with
// a = (gamma - tau/mu)/sqrt(3). At finite strain rotation is of the order of the elastic strain
// squared, (s_u/mu)^2 = 8e-6 of s_u, and gamma^2 of what flows past: not felt, as plastic flow has
// no memory but a. Softening integrated: a from gamma by the same equation.
static void test_plasticity_simple_shear(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int plane = 0; plane < (dim == 2 ? 1 : 3); plane++) {
            create(par, dim, 1);
            const int i = plane, j = (plane + 1) % 3, n_steps = 2000;
            double dF[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, tau[9], mean, gamma = 0, top = 0;
            dF[i * 3 + j] = 0.1 / n_steps;
            for (int k = 0; k < n_steps; k++) {
                deform(dF);
                gamma += 0.1 / n_steps;
                kirchhoff(tau, &mean);
                top = fmax(top, tau[i * 3 + j]);
                double a = 0;
                if (MU * gamma > PEAK / sqrt(3)) { // mu (gamma - sqrt(3) a) = sigma_y(a)/sqrt(3)
                    for (int m = 0; m < 100; m++) {
                        a = (gamma - strength(par, a) / sqrt(3) / MU) / sqrt(3);
                    }
                }
                const double shear = a > 0 ? strength(par, a) / sqrt(3) : MU * gamma;
                assert_near(tau[i * 3 + j], shear, 1e-4 * PEAK); // (gamma/step)^0: see above
                assert_near(s.plastic_strain[0], a, 1e-4 * 0.1);
                assert_near(mean, 0, 1e-11 * K_BULK); // of 2000 steps
                assert_near(ratio(), 1, 1e-12);
            }
            // The undrained strength in plane strain is sigma_y/sqrt(3): the footing's s_u.
            assert_near(top, PEAK / sqrt(3), par == perfect ? 1e-5 * PEAK : 2e-3 * PEAK);
            mpm_particles_free(&s);
        }
    }
}

// Plane-strain pure shear F = diag(l, 1/l): half the difference of the stresses is sigma_y/sqrt(3).
static void test_plasticity_plane_strain_strength(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        create(perfect, dim, 1);
        double dF[9] = {exp(1e-3), 0, 0, 0, exp(-1e-3), 0, 0, 0, 1}, tau[9], mean;
        for (int k = 0; k < 50; k++) {
            deform(dF);
        }
        kirchhoff(tau, &mean);
        assert_near((tau[0] - tau[4]) / 2, PEAK / sqrt(3), 1e-11 * K_BULK);
        assert_near(tau[8], 0, 1e-11 * K_BULK);
        mpm_particles_free(&s);
    }
}

// Work done on the particle less the gain of stored energy: what flow dissipates, step by step
// sigma_y da at least up to the second order of the step.
static void test_plasticity_work_is_dissipated(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int path = 0; path < 20; path++) {
            create(par, dim, 1);
            double dissipated = 0, expected = 0, worked = 0;
            double before[9], mean, W = s.material->energy(&s, 0);
            assert_true(W == 0);
            for (int k = 0; k < 400; k++) {
                double dF[9], d[9], tau[9];
                const double a = s.plastic_strain[0];
                kirchhoff(before, &mean);
                random_increment(d, dim, 2e-4);
                // With a direction that lasts for a while, so that it flows, and is then turned.
                const int turn = k / 40;
                d[(turn % dim) * 4] += turn % 4 < 2 ? 3e-4 : -3e-4;
                d[1] += turn % 3 == 0 ? 3e-4 : -2e-4;
                memcpy(dF, d, sizeof dF);
                deform(dF);
                kirchhoff(tau, &mean);
                double work = 0; // (tau + tau_before)/2 : d, of the third order in the step
                for (int i = 0; i < 3; i++) {
                    for (int j = 0; j < 3; j++) {
                        work +=
                            (tau[i * 3 + j] + before[i * 3 + j]) / 2 * (dF[i * 3 + j] - (i == j));
                    }
                }
                const double now = s.material->energy(&s, 0);
                worked += work;
                expected += strength(par, s.plastic_strain[0]) * (s.plastic_strain[0] - a);
                assert_true(now >= 0 && s.plastic_strain[0] >= a);
                dissipated = worked - now;
            }
            // sum of sigma_y da: 0.5 % off at these steps (strains of 5e-4 of a yield strain of
            // 2.5e-3).
            assert_true(dissipated > 0 && expected > 0);
            assert_near(dissipated / expected, 1, 0.01);
            mpm_particles_free(&s);
        }
    }
}

// Energy is that of the elastic part alone, and its derivative is the stress (elastic range).
static void test_plasticity_energy_is_of_the_elastic_part(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int trial = 0; trial < 50; trial++) {
            create(par, dim, 1);
            double dF[9], b[6], e[6], norm2 = 0;
            random_increment(dF, dim, 0.1);
            deform(dF);
            for (int k = 0; k < MPM_SYM(dim); k++) {
                b[k] = s.b[mpm_at(0, MPM_SYM(dim), k)];
            }
            mpm_half_log(b, e, dim);
            const double trace = e[0] + e[1] + e[2];
            for (int k = 0; k < MPM_SYM(dim); k++) {
                const double d = e[k] - (k < 3 ? trace / 3 : 0);
                norm2 += (k < 3 ? 1 : 2) * d * d;
            }
            const double W = MU * norm2 + K_BULK / 2 * trace * trace;
            assert_near(s.material->energy(&s, 0), W, 1e-12 * (W + PEAK * PEAK / MU));
            mpm_particles_free(&s);
        }
    }
}

// Loaded past yield, unloaded and loaded again: elastic until it comes back to where it flowed.
static void test_plasticity_unloads_elastically(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        create(par, dim, 1);
        const double up[9] = {exp(1e-3), 0, 0, 0, exp(-1e-3), 0, 0, 0, 1};
        const double down[9] = {exp(-1e-4), 0, 0, 0, exp(1e-4), 0, 0, 0, 1};
        const double again[9] = {exp(1e-4), 0, 0, 0, exp(-1e-4), 0, 0, 0, 1};
        double loaded[9], tau[9], mean;
        for (int k = 0; k < 20; k++) {
            deform(up);
        }
        kirchhoff(loaded, &mean);
        const double a = s.plastic_strain[0];
        assert_true(a > 0.01);
        for (int k = 1; k <= 8; k++) { // back by 8e-4 of up to 2 x 1.4e-3 (residual: 4e-4)
            deform(down);
            kirchhoff(tau, &mean);
            if (par == perfect) {
                assert_near(tau[0] - loaded[0], -2 * MU * 1e-4 * k, 1e-9);
                assert_true(s.plastic_strain[0] == a);
            }
        }
        if (par == perfect) {
            for (int k = 1; k <= 8; k++) {
                deform(again);
            }
            kirchhoff(tau, &mean);
            assert_near(tau[0], loaded[0], 1e-9);
            assert_near(s.plastic_strain[0], a, 1e-13); // round-off may touch the surface
            deform(again);
            assert_near(s.plastic_strain[0] - a, 2 / sqrt(3) * 1e-4, 1e-10);
        }
        mpm_particles_free(&s);
    }
}

static void rotation(double *R, int dim) {
    double q[4], length = 0;
    for (int k = 0; k < 4; k++) {
        q[k] = dim == 2 && (k == 1 || k == 2) ? 0 : uniform();
        length += q[k] * q[k];
    }
    for (int k = 0; k < 4; k++) {
        q[k] /= sqrt(length);
    }
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double Q[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                         2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    memcpy(R, Q, sizeof Q);
}

// A rotation laid over any path, also in the middle of flow: the same plastic strain, stress
// turned.
static void test_plasticity_is_objective(void **state) {
    (void)state;
    FOR_LAWS(dim, par) {
        for (int trial = 0; trial < 50; trial++) {
            double path[6][9], Q[6][9], T[9], turned[9], a;
            for (int k = 0; k < 6; k++) {
                random_increment(path[k], dim, 0.02);
                rotation(Q[k], dim);
            }
            create(par, dim, 1);
            for (int k = 0; k < 6; k++) {
                deform(path[k]);
            }
            a = s.plastic_strain[0];
            full(s.sigma, 0, T);
            mpm_particles_free(&s);
            assert_true(a > 1e-3);
            create(par, dim, 1);
            for (int k = 0; k < 6; k++) { // Q_k F_k Q_{k-1}^T
                double dF[9];
                multiply(Q[k], path[k], false, dF);
                if (k > 0) {
                    multiply(dF, Q[k - 1], true, dF);
                }
                deform(dF);
            }
            full(s.sigma, 0, turned);
            assert_near(s.plastic_strain[0], a, 1e-14 * 10);
            mpm_particles_free(&s);
            multiply(Q[5], T, false, T);
            multiply(T, Q[5], true, T);
            for (int k = 0; k < 9; k++) {
                assert_near(turned[k], T[k], 1e-13 * K_BULK);
            }
        }
    }
}

static void test_plasticity_plane_strain_is_3d(void **state) {
    (void)state;
    for (const double *par = perfect; par; par = par == perfect ? softening : NULL) {
        for (int trial = 0; trial < 50; trial++) {
            double path[20][9], T[2][9], a[2], b33[2];
            for (int k = 0; k < 20; k++) {
                random_increment(path[k], 2, 5e-3);
            }
            for (int dim = 2; dim <= 3; dim++) {
                create(par, dim, 1);
                for (int k = 0; k < 20; k++) {
                    deform(path[k]);
                }
                full(s.sigma, 0, T[dim - 2]);
                a[dim - 2] = s.plastic_strain[0];
                b33[dim - 2] = s.b[mpm_at(0, MPM_SYM(dim), 2)];
                mpm_particles_free(&s);
            }
            assert_near(a[0], a[1], 1e-13);
            assert_near(b33[0], b33[1], 1e-13); // elastic strain out of plane: not 1 after flow
            assert_true(a[0] > 1e-3);
            for (int k = 0; k < 9; k++) {
                assert_near(T[0][k], T[1][k], 1e-12 * K_BULK);
            }
        }
    }
}

// residual_strength 0 is perfect plasticity, as is softening 0: the same bits.
static void test_plasticity_defaults_are_perfect(void **state) {
    (void)state;
    const double same[][MPM_MAX_PARAMETERS] = {{2, 2 * MU * (1 + NU), NU, PEAK, 0, 0},
                                               {2, 2 * MU * (1 + NU), NU, PEAK, 0, 30},
                                               {2, 2 * MU * (1 + NU), NU, PEAK, PEAK, 30},
                                               {2, 2 * MU * (1 + NU), NU, PEAK, 1, 0}};
    double first[9] = {0}, T[9], dF[9];
    random_increment(dF, 3, 0.1);
    for (int k = 0; k < 4; k++) {
        create(same[k], 3, 1);
        deform(dF);
        full(s.sigma, 0, T);
        for (int c = 0; c < 9; c++) {
            first[c] = k == 0 ? T[c] : first[c];
            assert_near(T[c], first[c], 1e-13 * K_BULK);
        }
        mpm_particles_free(&s);
    }
}

// ---- Definitions and stages
// ----------------------------------------------------------------------

static struct {
    struct mpm_def def;
    struct mpm_material_def material, patched;
    struct mpm_body_def body;
    struct mpm_stage_def stages[2];
} world;

static void define(int dim, const double *par) {
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.material = (struct mpm_material_def){
        .name = "clay", .model = mpm_material_find("hencky_j2"), .fbar = true};
    memcpy(world.material.parameters, par, sizeof world.material.parameters);
    world.body = (struct mpm_body_def){
        .name = "block",
        .shape = {.min = {0.5, 0.5, 0.5}, .max = {1, 1, 0.75}},
        .particles_per_direction = 2,
        .velocity = {
            .kind = MPM_VELOCITY_MODE, .number = 2, .from = 0.5, .length = 0.5, .amplitude = 1}};
    for (int k = 0; k < 2; k++) {
        world.stages[k] = (struct mpm_stage_def){.name = "stage", .duration = 0.02};
    }
    world.def.dimension = dim;
    for (int d = 0; d < 3; d++) {
        world.def.domain_max[d] = 1.5;
    }
    world.def.cell = 0.125;
    world.def.settings.dt = 5e-4;
    world.def.n_materials = world.def.n_bodies = world.def.n_stages = 1;
    world.def.materials = &world.material;
    world.def.bodies = &world.body;
    world.def.stages = world.stages;
}

static struct mpm_sim *create_sim(void) {
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&world.def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    return sim;
}

static void step(struct mpm_sim *sim) {
    struct mpm_error err = {0};
    if (mpm_step(sim, &err)) {
        fail_msg("%s", err.message);
    }
}

static void keep(void *context, const struct mpm_error *fault) {
    *(struct mpm_error *)context = *fault;
}

static void test_plasticity_conflicts_are_refused(void **state) {
    (void)state;
    const struct {
        double par[MPM_MAX_PARAMETERS];
        const char *key;
        enum mpm_status status;
    } cases[] = {
        {{2, 1000, 0.3, 5, 5.1, 1}, "residual_strength", MPM_ERR_CONFLICT},
        // 3 mu = 3000 at E = 2600, nu = 0.3: softening * 4 must be below it.
        {{2, 2600, 0.3, 5, 1, 750}, "softening", MPM_ERR_CONFLICT},
        {{2, 2600, 0.3, 5, 1, 1e6}, "softening", MPM_ERR_CONFLICT},
        {{2, 2600, 0.3, 0, 0, 0}, "yield_strength", MPM_ERR_RANGE},
        {{2, 2600, 0.3, -1, 0, 0}, "yield_strength", MPM_ERR_RANGE},
        {{2, 2600, 0.3, 5, -1, 0}, "residual_strength", MPM_ERR_RANGE},
        {{2, 2600, 0.3, 5, 1, -1}, "softening", MPM_ERR_RANGE},
        {{2, 2600, 0.5, 5, 1, 1}, "poisson_ratio", MPM_ERR_RANGE},
        {{2, 2600, 0.3, 5, 5, 1e6}, NULL, MPM_OK},
        {{2, 2600, 0.3, 5, 0, 1e6}, NULL, MPM_OK},
        {{2, 2600, 0.3, 5, 1, 749}, NULL, MPM_OK},
    };
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        for (int in_stage = 0; in_stage < 2; in_stage++) {
            define(2, in_stage ? softening : cases[c].par);
            world.patched = world.material;
            memcpy(world.patched.parameters, cases[c].par, sizeof world.patched.parameters);
            world.def.n_stages = 2;
            world.stages[1].materials = in_stage ? &world.patched : NULL;
            struct mpm_error fault = {0};
            const size_t n = mpm_check(&world.def, keep, &fault);
            assert_int_equal(n, cases[c].key ? 1 : 0);
            if (cases[c].key) {
                char pointer[128] = "";
                strcat(pointer, in_stage ? "/stages/1" : "");
                strcat(strcat(pointer, "/materials/clay/"), cases[c].key);
                assert_string_equal(fault.pointer, pointer);
                assert_int_equal(fault.status, cases[c].status);
            }
        }
    }
}

// A stage's patch of the strength takes effect at once: what is above the new one flows; nothing is
// outside it.
static void test_plasticity_patched_strength_takes_effect(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim, perfect);
        world.patched = world.material;
        world.patched.parameters[3] = PEAK / 4;
        world.def.n_stages = 2;
        world.stages[1].materials = &world.patched;
        struct mpm_sim *sim = create_sim();
        const size_t n = mpm_n_particles(sim);
        double *mises = malloc(n * sizeof *mises), *J = malloc(n * sizeof *J), most = 0;
        while (mpm_stage(sim) == 0) {
            mpm_field_copy(sim, MPM_FIELD_VON_MISES, mises);
            mpm_field_copy(sim, MPM_FIELD_VOLUME_RATIO_BAR, J);
            most = 0;
            for (size_t p = 0; p < n; p++) {
                most = fmax(most, mises[p] * J[p]);
            }
            step(sim);
        }
        assert_near(most, PEAK, 1e-9); // something was at the old strength
        for (int k = 0; k < 3; k++) {
            mpm_field_copy(sim, MPM_FIELD_VON_MISES, mises);
            mpm_field_copy(sim, MPM_FIELD_VOLUME_RATIO_BAR, J);
            most = 0;
            for (size_t p = 0; p < n; p++) {
                most = fmax(most, mises[p] * J[p]);
            }
            assert_near(most, PEAK / 4, 1e-9);
            step(sim);
        }
        free(mises);
        free(J);
        mpm_free(sim);
    }
}

// The plastic strain is reset before the new strength is asked for: with it back at 0, the peak
// divided by 1.65 (the landslide's second stage) is far above what a softened particle bears, so
// that nothing flows by the reset.
static void test_plasticity_reset_comes_before_the_patch(void **state) {
    (void)state;
    define(2, softening);
    world.patched = world.material;
    world.def.n_stages = 2;
    world.stages[1].resets = MPM_RESET_PLASTIC_STRAIN | MPM_RESET_VELOCITY;
    world.stages[1].materials = &world.patched;
    world.patched.parameters[3] = PEAK * 0.9;
    struct mpm_sim *sim = create_sim();
    struct mpm_particles *t = &sim->sets[0];
    step(sim);
    // Elastic and far inside the peak, but outside what its plastic strain would leave of it.
    for (size_t p = 0; p < t->n; p++) {
        t->b[mpm_at(p, 4, 0)] = exp(2 * 0.6 * PEAK / (2 * MU * sqrt(3)));
        t->b[mpm_at(p, 4, 1)] = exp(-2 * 0.6 * PEAK / (2 * MU * sqrt(3)));
        t->b[mpm_at(p, 4, 2)] = 1;
        t->b[mpm_at(p, 4, 3)] = 0;
        t->plastic_strain[p] = 1;
    }
    mpm_enter_stage(sim, 1);
    for (size_t p = 0; p < t->n; p++) {
        assert_true(t->plastic_strain[p] == 0);
        assert_near(t->b[mpm_at(p, 4, 0)], exp(2 * 0.6 * PEAK / (2 * MU * sqrt(3))), 1e-15);
    }
    mpm_free(sim);
}

static void test_plasticity_strain_is_reset(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        define(dim, softening);
        world.def.n_stages = 2;
        world.stages[1].resets = MPM_RESET_PLASTIC_STRAIN;
        struct mpm_sim *sim = create_sim();
        assert_true(mpm_field_present(sim, MPM_FIELD_PLASTIC_STRAIN));
        double a[512], most = 0;
        assert_true(mpm_n_particles(sim) <= 512);
        while (mpm_stage(sim) == 0) {
            mpm_field_copy(sim, MPM_FIELD_PLASTIC_STRAIN, a);
            most = 0;
            for (size_t p = 0; p < mpm_n_particles(sim); p++) {
                most = fmax(most, a[p]);
            }
            step(sim);
        }
        assert_true(most > 1e-3);
        mpm_field_copy(sim, MPM_FIELD_PLASTIC_STRAIN, a);
        for (size_t p = 0; p < mpm_n_particles(sim); p++) {
            assert_true(a[p] == 0);
        }
        mpm_free(sim);
    }
}

// F-bar scales b as it would F F^T: in 2D by q in the plane and not across it, in 3D by q^(2/3),
// where q is the ratio of the averaged to the plain volume ratio; before any flow, compared with
// the plain b of the same step, which a twin without F-bar makes.
static void test_plasticity_fbar_scales_b(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            for (int scheme = MPM_FBAR_ZHAO; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
                struct mpm_sim *sim[2];
                double strong[MPM_MAX_PARAMETERS];
                memcpy(strong, perfect, sizeof strong);
                strong[3] = 1e6;
                for (int on = 0; on < 2; on++) {
                    define(dim, strong);
                    world.def.basis = (enum mpm_basis)basis;
                    world.def.settings.fbar.scheme =
                        on ? (enum mpm_fbar_scheme)scheme : MPM_FBAR_OFF;
                    sim[on] = create_sim();
                    // b33 other than 1, as plastic flow leaves it
                    struct mpm_particles *t = &sim[on]->sets[0];
                    for (size_t p = 0; p < t->n; p++) {
                        t->b[mpm_at(p, MPM_SYM(dim), 2)] = 1.01;
                        t->b[mpm_at(p, MPM_SYM(dim), 0)] = 1 / 1.01;
                    }
                    step(sim[on]);
                }
                const struct mpm_particles *t = &sim[0]->sets[0], *u = &sim[1]->sets[0];
                double largest = 0;
                for (size_t p = 0; p < t->n; p++) {
                    const double q = mpm_ratio_in_use(u, p) / mpm_ratio_in_use(t, p);
                    largest = fmax(largest, fabs(q - 1));
                    for (int k = 0; k < MPM_SYM(dim); k++) {
                        const size_t at = mpm_at(p, MPM_SYM(dim), k);
                        const double scale = dim == 3 ? cbrt(q * q) : k == 2 ? 1 : q;
                        assert_near(u->b[at], t->b[at] * scale, 1e-14);
                    }
                }
                assert_true(largest > 1e-6);
                mpm_free(sim[0]);
                mpm_free(sim[1]);
            }
        }
    }
}

// A free body that flows: energy is only lost. The mechanical energy swings by w dt/2 of itself
// (the symplectic step takes kinetic energy at t - dt/2), here 1.7 % in the first step, which
// strains with the velocity that it starts with.
static void test_plasticity_loses_energy(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            define(dim, softening);
            world.stages[0].duration = 0.1;
            world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
            struct mpm_sim *sim = create_sim();
            struct mpm_balance b;
            mpm_balance(sim, &b);
            const double first = b.kinetic_energy + b.strain_energy;
            double left = 1;
            while (!mpm_finished(sim)) {
                step(sim);
                mpm_balance(sim, &b);
                left = (b.kinetic_energy + b.strain_energy) / first;
                assert_true(left < 1.02);
            }
            assert_true(left < 0.7);
            mpm_free(sim);
        }
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_plasticity_meets_the_strength),
        cmocka_unit_test(test_plasticity_returned_state_is_at_rest),
        cmocka_unit_test(test_plasticity_return_solves_its_equation),
        cmocka_unit_test(test_plasticity_return_within_its_reaches),
        cmocka_unit_test(test_plasticity_uniaxial_strain),
        cmocka_unit_test(test_plasticity_uniaxial_stress_is_the_strength),
        cmocka_unit_test(test_plasticity_simple_shear),
        cmocka_unit_test(test_plasticity_plane_strain_strength),
        cmocka_unit_test(test_plasticity_work_is_dissipated),
        cmocka_unit_test(test_plasticity_energy_is_of_the_elastic_part),
        cmocka_unit_test(test_plasticity_unloads_elastically),
        cmocka_unit_test(test_plasticity_is_objective),
        cmocka_unit_test(test_plasticity_plane_strain_is_3d),
        cmocka_unit_test(test_plasticity_defaults_are_perfect),
        cmocka_unit_test(test_plasticity_conflicts_are_refused),
        cmocka_unit_test(test_plasticity_patched_strength_takes_effect),
        cmocka_unit_test(test_plasticity_reset_comes_before_the_patch),
        cmocka_unit_test(test_plasticity_strain_is_reset),
        cmocka_unit_test(test_plasticity_fbar_scales_b),
        cmocka_unit_test(test_plasticity_loses_energy),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
