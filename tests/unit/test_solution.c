// Exact solutions: against tables that were computed otherwise (their origin is in
// docs/method.md section 11), and against the balance laws that they solve, by finite differences.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/material.h"
#include "server/mpm/solution.h"
#include "server/mpm/table.h"

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.12g is not within %g of %.12g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

static struct mpm_medium rubber(double rho, double E, double nu) {
    const double parameters[MPM_MAX_PARAMETERS] = {rho, E, nu};
    return mpm_medium_of(mpm_material_find("neo_hookean"), parameters, (double[3]){0, -10, 0});
}
static struct mpm_medium water(double rho, double K, double viscosity) {
    const double parameters[MPM_MAX_PARAMETERS] = {rho, K, viscosity};
    return mpm_medium_of(mpm_material_find("newtonian"), parameters, (double[3]){0, -10, 0});
}

static struct mpm_exact make(struct mpm_solution q, struct mpm_medium medium) {
    struct mpm_exact e;
    assert_int_equal(mpm_exact_create(&e, &q, &medium), MPM_OK);
    return e;
}
static struct mpm_exact_state at(struct mpm_exact *e, double X, double Y, double t) {
    struct mpm_exact_state out;
    mpm_exact_move(e, t);
    mpm_exact_state(e, (double[3]){X, Y, 0}, (double[3]){X, Y, 0}, t, 2, &out);
    return out;
}

// ---- Against tables -----------------------------------------------------------------------------

static void test_solution_column_at_finite_strain(void **state) {
    (void)state;
    struct mpm_medium m = rubber(80, 1e4, 0);
    struct mpm_exact e =
        make((struct mpm_solution){.kind = MPM_SOLUTION_COLUMN, .axis = 1, .length = 50}, m);
    struct mpm_exact_state s = at(&e, 3, 25, 7); // Simpson's rule: 1e-7 of the height at F = 0.12
    assert_near(25 + s.u[1], 4.19602262221, 1e-5);
    assert_near(s.sigma[4], -20000, 1e-9);
    assert_near(s.sigma[0], 0, 1e-12); // nu = 0
    mpm_exact_free(&e);
    m = rubber(1000, 1e5, 0.499);
    m.g[1] = -9.81;
    e = make((struct mpm_solution){.kind = MPM_SOLUTION_COLUMN, .axis = 1, .length = 5}, m);
    assert_near(5 + at(&e, 0, 5, 0).u[1], 4.99268347822, 1e-10);
    assert_near(2.45 + at(&e, 0, 2.45, 0).u[1], 2.44458927, 5e-5 * 1e-3 + 6e-8);
    s = at(&e, 0, 2.45, 0); // sigma_xx = lambda ln F / F
    assert_near(s.sigma[0], m.lambda * log(0.998506407913) / 0.998506407913, 1e-5);
    mpm_exact_free(&e);
}

static void test_solution_column_of_water(void **state) {
    (void)state;
    struct mpm_exact e =
        make((struct mpm_solution){.kind = MPM_SOLUTION_COLUMN, .axis = 1, .from = 1, .length = 2},
             water(1000, 2e6, 0));
    const struct mpm_exact_state s = at(&e, 0, 1.5, 0);
    assert_near(s.u[1], -1000 * 10 / 2e6 * (2 * 0.5 - 0.5 * 0.5 / 2), 1e-15);
    assert_near(s.sigma[0], -1000 * 10 * 1.5, 1e-9);
    assert_near(s.sigma[8], -1000 * 10 * 1.5, 1e-9);
    mpm_exact_free(&e);
}

// Boundary-value problem of the log neo-Hookean cylinder, solved to 1e-10 by other means.
static void test_solution_cylinder_at_finite_strain(void **state) {
    (void)state;
    const struct mpm_solution q = {
        .kind = MPM_SOLUTION_CYLINDER, .inner = 1, .outer = 2, .pressure = 8};
    static const double rows[][6] = {
        // R, r, s_rr, s_tt, s_zz, mean
        {1, 1.3434077332, -8, 21.1899177111, 2.40390044093, 5.197939384},
        {1.5, 1.7478802342, -2.54836251325, 11.9441326297, 3.59210619053, 4.32929210233},
        {2, 2.1921801592, 0, 8.60125729549, 3.90004910332, 4.16710213293}};
    struct mpm_exact e = make(q, rubber(1, 70, 0.499));
    for (int k = 0; k < 3; k++) {
        const double *row = rows[k];
        const struct mpm_exact_state x = at(&e, row[0], 0, 0), y = at(&e, 0, -row[0], 0);
        assert_near(row[0] + x.u[0], row[1], 1e-8);
        assert_near(y.u[1], -(row[1] - row[0]), 1e-8);
        assert_near(x.sigma[0], row[2], 1e-6); // lambda = 1e4 times the error of J
        assert_near(x.sigma[4], row[3], 1e-6);
        assert_near(y.sigma[0], row[3], 1e-6);
        assert_near(y.sigma[4], row[2], 1e-6);
        assert_near((x.sigma[0] + x.sigma[4] + x.sigma[8]) / 3, row[5], 1e-6);
        assert_near(x.sigma[1], 0, 1e-12);
    }
    mpm_exact_free(&e);
}

// Beyond mu ln(B/A) = 16.2 Pa it grows without end; a little below it there is a solution. A
// suction has one too.
static void test_solution_cylinder_holds_so_much(void **state) {
    (void)state;
    struct mpm_solution q = {.kind = MPM_SOLUTION_CYLINDER, .inner = 1, .outer = 2, .pressure = 17};
    const struct mpm_medium m = rubber(1, 70, 0.499);
    struct mpm_exact e;
    assert_int_equal(mpm_exact_create(&e, &q, &m), MPM_ERR_RANGE);
    mpm_exact_free(&e);
    q.pressure = 15;
    e = make(q, m);
    assert_near(at(&e, 1, 0, 0).sigma[0], -15, 1e-5);
    mpm_exact_free(&e);
    q.pressure = -5;
    e = make(q, m);
    assert_near(at(&e, 1, 0, 0).sigma[0], 5, 1e-5);
    assert_true(at(&e, 1, 0, 0).u[0] < 0);
    mpm_exact_free(&e);
}

static void test_solution_lame_is_the_small_cylinder(void **state) {
    (void)state;
    struct mpm_solution q = {.kind = MPM_SOLUTION_LAME, .inner = 1, .outer = 2, .pressure = 1};
    const struct mpm_medium m = rubber(1, 70, 0.499);
    struct mpm_exact e = make(q, m);
    const struct mpm_exact_state s = at(&e, 1.5, 0, 0);
    assert_near(s.u[0], 0.0190563349206, 1e-12);
    assert_near(s.sigma[0], -0.259259259259, 1e-11);
    assert_near(s.sigma[4], 0.925925925926, 1e-11);
    assert_near(s.sigma[8], 0.332666666667, 1e-11);
    mpm_exact_free(&e);
    q.pressure = 1e-5; // both: the difference is of second order in the strain, 3e-7
    e = make(q, m);
    q.kind = MPM_SOLUTION_CYLINDER;
    struct mpm_exact f = make(q, m);
    const struct mpm_exact_state a = at(&e, 1, 0.5, 0), b = at(&f, 1, 0.5, 0);
    for (int k = 0; k < 9; k++) {
        assert_near(a.sigma[k], b.sigma[k], 1e-5 * 1e-4);
    }
    assert_near(a.u[0], b.u[0], 1e-6 * fabs(b.u[0]) + 1e-12);
    mpm_exact_free(&e);
    mpm_exact_free(&f);
}

static void test_solution_tube_swings(void **state) {
    (void)state;
    struct mpm_exact e =
        make((struct mpm_solution){.kind = MPM_SOLUTION_TUBE, .inner = 1, .outer = 2, .rate = 8},
             rubber(1, 70, 0.499));
    static const double rows[][4] = {// t, a, b, c'
                                     {0, 1, 2, 8},
                                     {0.25, 1.5951430448, 2.35467223481, 1.19063232958},
                                     {0.5, 1.16127070768, 2.08531763924, -8.35390014924},
                                     {1, 1.45174515612, 2.25999203501, 6.45539862889}};
    for (int k = 0; k < 4; k++) {
        const struct mpm_exact_state a = at(&e, 1, 0, rows[k][0]), b = at(&e, 0, 2, rows[k][0]);
        assert_near(1 + a.u[0], rows[k][1], 1e-8);
        assert_near(2 + b.u[1], rows[k][2], 1e-8);
        assert_near(a.v[0], rows[k][3] / (2 * rows[k][1]), 1e-7);
    }
    mpm_exact_free(&e);
}

// The body force of the vortex with rho = E = 1000 and nu = 0.3 at R = 0.975.
static void test_solution_vortex_force(void **state) {
    (void)state;
    const struct mpm_medium m = rubber(1000, 1000, 0.3);
    const struct mpm_solution q = {.kind = MPM_SOLUTION_VORTEX,
                                   .centre = {3, -1},
                                   .inner = 0.75,
                                   .outer = 1.25,
                                   .amplitude = 1,
                                   .period = 1};
    const double rows[][4] = {// t, angle, b_r, b_theta in the turned basis
                              {0.125, 0.375068032061, -7.75218781862, 4.60020575796},
                              {0.25, 0.693035356241, -4.15139499183, 8.50007189024},
                              {0.75, 0.693035356241, -4.15139499183, 8.50007189024}};
    for (int k = 0; k < 3; k++) {
        double b[3];
        mpm_exact_force(&q, &m, (double[3]){3 + 0.975, -1, 0}, rows[k][0], 2, b);
        const double c = cos(rows[k][1]), s = sin(rows[k][1]);
        assert_near(b[0] * c + b[1] * s, rows[k][2], 2e-5); // its mu is 384.615
        assert_near(b[1] * c - b[0] * s, rows[k][3], 2e-5);
        struct mpm_exact e = make(q, m);
        const struct mpm_exact_state x = at(&e, 3 + 0.975, -1, rows[k][0]);
        assert_near(0.975 + x.u[0], 0.975 * c, 1e-9);
        assert_near(x.u[1], 0.975 * s, 1e-9);
        mpm_exact_free(&e);
    }
}

// ---- Against the laws ---------------------------------------------------------------------------

// Velocity is the rate of the displacement, of a particle.
static void test_solution_velocity_is_a_rate(void **state) {
    (void)state;
    const struct mpm_solution solutions[] = {
        {.kind = MPM_SOLUTION_ROTATION, .centre = {0.1, 0.2}, .rate = 3},
        {.kind = MPM_SOLUTION_MODE,
         .axis = 1,
         .from = -1,
         .length = 3,
         .number = 2,
         .amplitude = 2},
        {.kind = MPM_SOLUTION_VORTEX, .inner = 0.5, .outer = 2, .amplitude = 0.7, .period = 3},
        {.kind = MPM_SOLUTION_TUBE, .inner = 0.5, .outer = 2, .rate = 1},
    };
    for (size_t k = 0; k < sizeof solutions / sizeof *solutions; k++) {
        struct mpm_exact e = make(solutions[k], rubber(2, 50, 0.3));
        for (double t = 0.1; t < 2; t += 0.4) {
            const double d = 1e-5;
            const struct mpm_exact_state a = at(&e, 0.8, 0.5, t - d), b = at(&e, 0.8, 0.5, t + d),
                                         c = at(&e, 0.8, 0.5, t);
            for (int i = 0; i < 2; i++) {
                assert_near(c.v[i], (b.u[i] - a.u[i]) / (2 * d), 1e-7);
            }
        }
        double v[2];
        mpm_solution_start(&solutions[k], (double[3]){0.8, 0.5, 0}, 2, v);
        const struct mpm_exact_state start = at(&e, 0.8, 0.5, 0);
        assert_near(v[0], start.v[0], 1e-14);
        assert_near(v[1], start.v[1], 1e-14);
        assert_true(hypot(v[0], v[1]) <= mpm_solution_speed(&solutions[k]) + 1e-12 || k == 0);
        mpm_exact_free(&e);
    }
    struct mpm_exact e = make(
        (struct mpm_solution){.kind = MPM_SOLUTION_RITTER, .from = 4, .length = 2}, water(1, 1, 0));
    for (double t = 0.5; t < 2; t += 0.3) { // X = 3 begins to move at 0.22 s
        const struct mpm_exact_state a = at(&e, 3, 1.5, t - 1e-5), b = at(&e, 3, 1.5, t + 1e-5),
                                     c = at(&e, 3, 1.5, t);
        const double x = 3 + c.u[0] - 4, speed = sqrt(20.0);
        assert_near(c.v[0], (b.u[0] - a.u[0]) / 2e-5, 1e-7);
        assert_near(c.v[1], (b.u[1] - a.u[1]) / 2e-5, 1e-7);
        assert_near(c.v[0], 2 * (speed + x / t) / 3, 1e-9); // Ritter's velocity where it is now
    }
    assert_near(at(&e, 3, 1.5, 0.2).u[0], 0, 0);
    mpm_exact_free(&e);
}

// rho (dv/dt - b) = div sigma, with the divergence in the present place: of a map x(X) that is
// inverted by the chain rule.
static void check_balance(const struct mpm_solution *q, struct mpm_medium m, double X, double Y,
                          double t, double tol) {
    const double d = 1e-5;
    struct mpm_exact e = make(*q, m);
    const struct mpm_exact_state e0 = at(&e, X - d, Y, t), e1 = at(&e, X + d, Y, t),
                                 n0 = at(&e, X, Y - d, t), n1 = at(&e, X, Y + d, t),
                                 t0 = at(&e, X, Y, t - d), t1 = at(&e, X, Y, t + d);
    double F[4], b[3];
    F[0] = 1 + (e1.u[0] - e0.u[0]) / (2 * d);
    F[2] = (e1.u[1] - e0.u[1]) / (2 * d);
    F[1] = (n1.u[0] - n0.u[0]) / (2 * d);
    F[3] = 1 + (n1.u[1] - n0.u[1]) / (2 * d);
    const double J = F[0] * F[3] - F[1] * F[2];
    const double inverse[4] = {F[3] / J, -F[1] / J, -F[2] / J, F[0] / J};
    mpm_exact_force(q, &m, (double[3]){X, Y, 0}, t, 2, b);
    for (int i = 0; i < 2; i++) {
        double divergence = 0;
        for (int j = 0; j < 2; j++) {
            divergence += (e1.sigma[3 * i + j] - e0.sigma[3 * i + j]) / (2 * d) * inverse[j] +
                          (n1.sigma[3 * i + j] - n0.sigma[3 * i + j]) / (2 * d) * inverse[2 + j];
        }
        const double acceleration = (t1.v[i] - t0.v[i]) / (2 * d);
        assert_near(m.rho * (acceleration - b[i]), divergence, tol);
    }
    mpm_exact_free(&e);
}

static void test_solution_balances_momentum(void **state) {
    (void)state;
    const struct mpm_solution
        vortex = {.kind = MPM_SOLUTION_VORTEX,
                  .inner = 0.75,
                  .outer = 1.25,
                  .amplitude = 1,
                  .period = 1},
        lame = {.kind = MPM_SOLUTION_LAME, .inner = 1, .outer = 2, .pressure = 1e-4},
        cylinder = {.kind = MPM_SOLUTION_CYLINDER, .inner = 1, .outer = 2, .pressure = 5};
    // Differences of stresses of up to 3e3 Pa over 2e-5 m, round-off 1e-13 of them.
    check_balance(&vortex, rubber(1000, 1000, 0.3), 0.7, -0.6, 0.3, 1e-2);
    check_balance(&vortex, rubber(1000, 1000, 0.3), -0.2, 1.05, 0.8, 1e-2);
    check_balance(&vortex, rubber(1000, 1000, 0.499), 0.9, 0.1, 0.45, 1e-2);
    check_balance(&lame, rubber(1, 70, 0.3), 1, 0.9, 0, 1e-7);
    check_balance(&cylinder, rubber(1, 70, 0.49), 1, 0.9, 0, 1e-4); // r(R) is interpolated
}

// Taylor-Green: no divergence, and rho (dv/dt + v grad v) = -grad p + mu lap v.
static void test_solution_taylor_green_solves_navier_stokes(void **state) {
    (void)state;
    const struct mpm_medium m = water(2, 100, 0.3);
    struct mpm_exact e = make(
        (struct mpm_solution){
            .kind = MPM_SOLUTION_TAYLOR_GREEN, .centre = {0.1, 0.2}, .length = 2, .amplitude = 1.5},
        m);
    const double x = 0.37, y = 0.81, t = 0.4, d = 1e-4;
    const struct mpm_exact_state c = at(&e, x, y, t), e0 = at(&e, x - d, y, t),
                                 e1 = at(&e, x + d, y, t), n0 = at(&e, x, y - d, t),
                                 n1 = at(&e, x, y + d, t), t0 = at(&e, x, y, t - d),
                                 t1 = at(&e, x, y, t + d);
    assert_near((e1.v[0] - e0.v[0] + n1.v[1] - n0.v[1]) / (2 * d), 0, 1e-7);
    for (int i = 0; i < 2; i++) {
        const double rate = (t1.v[i] - t0.v[i]) / (2 * d);
        const double along =
            c.v[0] * (e1.v[i] - e0.v[i]) / (2 * d) + c.v[1] * (n1.v[i] - n0.v[i]) / (2 * d);
        const double push =
            i == 0 ? (e1.sigma[0] - e0.sigma[0]) / (2 * d) : (n1.sigma[0] - n0.sigma[0]) / (2 * d);
        const double lap = (e1.v[i] + e0.v[i] + n1.v[i] + n0.v[i] - 4 * c.v[i]) / (d * d);
        assert_near(m.rho * (rate + along), push + m.viscosity * lap, 1e-4); // lap: 1e-16/d^2
    }
    mpm_exact_free(&e);
}

static void test_solution_rotation_in_3d(void **state) {
    (void)state;
    const double n[3] = {2.0 / 3, -1.0 / 3, 2.0 / 3}, X[3] = {1, 2, 3};
    struct mpm_exact e = make((struct mpm_solution){.kind = MPM_SOLUTION_ROTATION,
                                                    .vector = {n[0], n[1], n[2]},
                                                    .centre = {0.5, 0, 0},
                                                    .rate = 2 * M_PI},
                              rubber(1, 1, 0));
    struct mpm_exact_state s;
    mpm_exact_state(&e, X, X, 1, 3, &s); // a whole turn
    for (int d = 0; d < 3; d++) {
        assert_near(s.u[d], 0, 1e-14);
    }
    mpm_exact_state(&e, X, X, 0.25, 3, &s);
    double along = 0, length = 0, before = 0;
    for (int d = 0; d < 3; d++) {
        const double r = X[d] - (d == 0 ? 0.5 : 0);
        along += n[d] * s.u[d];
        length += (r + s.u[d]) * (r + s.u[d]);
        before += r * r;
    }
    assert_near(along, 0, 1e-14);
    assert_near(length, before, 1e-13);
}

static void test_solution_holds_for_its_material(void **state) {
    (void)state;
    const double clay[MPM_MAX_PARAMETERS] = {1000, 1e6, 0.3, 1e3, 1e3, 0};
    const struct mpm_medium r = rubber(1, 1, 0.3), w = water(1, 1, 0),
                            c = mpm_medium_of(mpm_material_find("hencky_j2"), clay, (double[3]){0});
    for (int k = 0; k < MPM_N_SOLUTIONS; k++) {
        const enum mpm_solution_kind kind = (enum mpm_solution_kind)k;
        const bool fluid = kind == MPM_SOLUTION_TAYLOR_GREEN || kind == MPM_SOLUTION_RITTER;
        const bool any = kind == MPM_SOLUTION_ROTATION;
        assert_int_equal(mpm_solution_holds(kind, &r), any || !fluid);
        assert_int_equal(mpm_solution_holds(kind, &w), any || fluid || kind == MPM_SOLUTION_COLUMN);
        assert_int_equal(mpm_solution_holds(kind, &c),
                         any || kind == MPM_SOLUTION_MODE || kind == MPM_SOLUTION_LAME);
        assert_int_equal(mpm_solution_parse(mpm_solution_name(kind)), k);
        assert_true(mpm_solution_tells(kind, MPM_FIELD_VELOCITY));
        assert_false(mpm_solution_tells(kind, MPM_FIELD_ID));
    }
}

// ---- Tables -------------------------------------------------------------------------------------

// A linear field on scattered points is met everywhere near them, exactly; their own values too.
static void test_table_is_linear(void **state) {
    (void)state;
    for (int axes = 1; axes <= 3; axes++) {
        double points[300], values[200];
        srand(7);
        for (int k = 0; k < 100; k++) {
            double sum = 1;
            for (int d = 0; d < axes; d++) {
                points[k * axes + d] = rand() / (double)RAND_MAX;
                sum += (d + 2) * points[k * axes + d];
            }
            values[2 * k] = sum;
            values[2 * k + 1] = k;
        }
        struct mpm_against of = {.is_table = true,
                                 .n = 100,
                                 .n_axes = axes,
                                 .axis = {0, 1, 2},
                                 .points = points,
                                 .values = values};
        struct mpm_table table;
        assert_true(mpm_table_create(&table, &of, 2));
        for (int k = 0; k < 100; k++) {
            double X[3] = {0}, out[2], sum = 1;
            for (int d = 0; d < axes; d++) {
                X[d] = 0.1 + 0.8 * rand() / (double)RAND_MAX;
                sum += (d + 2) * X[d];
            }
            if (mpm_table_at(&table, X, out)) { // 1e-9: badly shaped neighbours
                assert_near(out[0], sum, 1e-7);
            }
            memcpy(X, points + k * axes, (size_t)axes * sizeof *X);
            assert_true(mpm_table_at(&table, X, out));
            assert_near(out[1], k, 0);
        }
        double far[3] = {3, 3, 3}, out[2];
        assert_false(mpm_table_at(&table, far, out));
        mpm_table_free(&table);
    }
}

// The centre of four lattice points has their mean; a second axis of a table by height is no
// matter.
static void test_table_between_points(void **state) {
    (void)state;
    const double points[] = {0, 0, 1, 0, 0, 1, 1, 1, 0, 2, 1, 2}, values[] = {1, 2, 3, 10, 5, 6};
    struct mpm_against of = {
        .n = 6, .n_axes = 2, .axis = {0, 1}, .points = points, .values = values};
    struct mpm_table table;
    double out;
    assert_true(mpm_table_create(&table, &of, 1));
    assert_true(mpm_table_at(&table, (double[3]){0.5, 0.5, 9}, &out));
    assert_near(out, 4, 1e-12);
    mpm_table_free(&table);
    const double heights[] = {2, 0, 1}, squares[] = {4, 0, 1};
    of = (struct mpm_against){
        .n = 3, .n_axes = 1, .axis = {1}, .points = heights, .values = squares};
    assert_true(mpm_table_create(&table, &of, 1));
    assert_true(mpm_table_at(&table, (double[3]){77, 0.25, 0}, &out));
    assert_near(out, 0.25, 1e-12);
    assert_true(mpm_table_at(&table, (double[3]){77, 1.5, 0}, &out));
    assert_near(out, 2.5, 1e-12);
    mpm_table_free(&table);
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_solution_column_at_finite_strain),
        cmocka_unit_test(test_solution_column_of_water),
        cmocka_unit_test(test_solution_cylinder_at_finite_strain),
        cmocka_unit_test(test_solution_cylinder_holds_so_much),
        cmocka_unit_test(test_solution_lame_is_the_small_cylinder),
        cmocka_unit_test(test_solution_tube_swings),
        cmocka_unit_test(test_solution_vortex_force),
        cmocka_unit_test(test_solution_velocity_is_a_rate),
        cmocka_unit_test(test_solution_balances_momentum),
        cmocka_unit_test(test_solution_taylor_green_solves_navier_stokes),
        cmocka_unit_test(test_solution_rotation_in_3d),
        cmocka_unit_test(test_solution_holds_for_its_material),
        cmocka_unit_test(test_table_is_linear),
        cmocka_unit_test(test_table_between_points),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
