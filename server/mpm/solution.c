// Exact and manufactured solutions, each in the notation of docs/method.md section 11, which has
// the formulas and where they come from. The round ones lie in the plane of x and y about an axis
// through their centre, in plane strain; so in 3D they hold in a slice between rollers.
#include "server/mpm/solution.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/material.h"

#define N_RADII 400     // steps over the wall of a cylinder: fourth order, so 1e-10 of its radius
#define TUBE_STEP 0.005 // of the time in which a shear wave crosses the hole
#define N_HEIGHTS 64    // Simpson's rule over the column below a particle
#define MAX_ITERATIONS 200 // of Newton's method and bisections: each ends long before

// ---- The medium ---------------------------------------------------------------------------------

static double parameter_of(const struct mpm_material *model, const double *parameters,
                           const char *key) {
    const struct mpm_parameter *q;
    for (size_t k = 0; (q = mpm_material_parameter(model, k)); k++) {
        if (strcmp(q->key, key) == 0) {
            return parameters[k];
        }
    }
    return 0;
}

struct mpm_medium mpm_medium_of(const struct mpm_material *model, const double *parameters,
                                const double *gravity) {
    const double E = parameter_of(model, parameters, "youngs_modulus");
    const double nu = parameter_of(model, parameters, "poisson_ratio");
    struct mpm_medium m = {.rho = parameters[0],
                           .mu = E / (2 * (1 + nu)),
                           .lambda = E * nu / ((1 + nu) * (1 - 2 * nu)),
                           .bulk = parameter_of(model, parameters, "bulk_modulus"),
                           .viscosity = parameter_of(model, parameters, "viscosity"),
                           .is_fluid = model == mpm_material_find("newtonian"),
                           .is_elastic = E > 0,
                           .is_neo_hookean = model == mpm_material_find("neo_hookean")};
    memcpy(m.g, gravity, sizeof m.g);
    return m;
}

bool mpm_solution_holds(enum mpm_solution_kind kind, const struct mpm_medium *m) {
    switch (kind) {
    case MPM_SOLUTION_ROTATION:
        return true;
    case MPM_SOLUTION_COLUMN:
        return m->is_fluid || m->is_neo_hookean;
    case MPM_SOLUTION_MODE:
    case MPM_SOLUTION_LAME:
        return m->is_elastic;
    case MPM_SOLUTION_CYLINDER:
    case MPM_SOLUTION_TUBE:
    case MPM_SOLUTION_VORTEX:
        return m->is_neo_hookean;
    case MPM_SOLUTION_TAYLOR_GREEN:
    case MPM_SOLUTION_RITTER:
        return m->is_fluid;
    case MPM_N_SOLUTIONS:
        break;
    }
    return false;
}

bool mpm_solution_tells(enum mpm_solution_kind kind, enum mpm_field field) {
    switch (field) {
    case MPM_FIELD_POSITION:
    case MPM_FIELD_DISPLACEMENT:
        return kind != MPM_SOLUTION_TAYLOR_GREEN;
    case MPM_FIELD_VELOCITY:
        return true;
    case MPM_FIELD_STRESS:
        return kind != MPM_SOLUTION_TAYLOR_GREEN && kind != MPM_SOLUTION_TUBE &&
               kind != MPM_SOLUTION_RITTER;
    case MPM_FIELD_MEAN_STRESS:
    case MPM_FIELD_MEAN_STRESS_SMOOTH:
        return kind != MPM_SOLUTION_TUBE && kind != MPM_SOLUTION_RITTER;
    default:
        return false;
    }
}

bool mpm_solution_is_static(enum mpm_solution_kind kind) {
    return kind == MPM_SOLUTION_COLUMN || kind == MPM_SOLUTION_LAME ||
           kind == MPM_SOLUTION_CYLINDER;
}

double mpm_solution_speed(const struct mpm_solution *q) {
    switch (q->kind) {
    case MPM_SOLUTION_MODE:
    case MPM_SOLUTION_TAYLOR_GREEN:
        return fabs(q->amplitude);
    case MPM_SOLUTION_TUBE:
        return fabs(q->rate) / (2 * q->inner);
    case MPM_SOLUTION_VORTEX: // h <= 1
        return fabs(q->amplitude) * M_PI / q->period * q->outer;
    default:
        return 0;
    }
}

// ---- Round ones ---------------------------------------------------------------------------------

struct polar {
    double R, cos, sin; // of X about the centre
};

static struct polar polar_of(const struct mpm_solution *q, const double *X) {
    const double dx = X[0] - q->centre[0], dy = X[1] - q->centre[1], R = hypot(dx, dy);
    return (struct polar){.R = R, .cos = R > 0 ? dx / R : 1, .sin = R > 0 ? dy / R : 0};
}

// Stress from its components along the radius, across it, and along the axis.
static void polar_stress(double cos, double sin, double rr, double rt, double tt, double zz,
                         double *sigma) {
    sigma[0] = rr * cos * cos - 2 * rt * cos * sin + tt * sin * sin;
    sigma[4] = rr * sin * sin + 2 * rt * cos * sin + tt * cos * cos;
    sigma[1] = sigma[3] = (rr - tt) * cos * sin + rt * (cos * cos - sin * sin);
    sigma[8] = zz;
}

static void radial(const struct polar *at, double u, double v, struct mpm_exact_state *out) {
    out->u[0] = u * at->cos;
    out->u[1] = u * at->sin;
    out->v[0] = v * at->cos;
    out->v[1] = v * at->sin;
}

// Lame's thick-walled cylinder at small strain: pressure p inside.
static void lame(const struct mpm_exact *e, const double *X, struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const struct mpm_medium *m = &e->medium;
    const struct polar at = polar_of(q, X);
    const double a2 = q->inner * q->inner, b2 = q->outer * q->outer, R2 = at.R * at.R;
    const double c = q->pressure * a2 / (b2 - a2), nu = m->lambda / (2 * (m->lambda + m->mu));
    radial(&at, c / (2 * m->mu) * ((1 - 2 * nu) * at.R + b2 / at.R), 0, out);
    polar_stress(at.cos, at.sin, c * (1 - b2 / R2), 0, c * (1 + b2 / R2), 2 * nu * c, out->sigma);
}

// ---- The cylinder at finite strain: dP_R/dR + (P_R - P_T)/R = 0, P_R(A) = -p r/R, P_R(B) = 0 ----

// Of the energy mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2.
static double nominal(const struct mpm_medium *m, double stretch, double J) {
    return m->mu * (stretch - 1 / stretch) + m->lambda * log(J) / stretch;
}

// The radial stretch at which the nominal radial stress is P, next to the hoop stretch: Newton's
// method on a function that rises with the stretch.
static double radial_stretch(const struct mpm_medium *m, double P, double hoop, double guess) {
    double s = guess;
    for (int k = 0; k < MAX_ITERATIONS; k++) {
        const double J = s * hoop, f = nominal(m, s, J) - P;
        const double slope =
            m->mu * (1 + 1 / (s * s)) + m->lambda * (1 - log(J)) / (s * s); // > 0 up to J = e
        const double next = s - f / slope;
        const double change = next - s;
        s = next > s / 2 ? next : s / 2;
        if (fabs(change) < 1e-14 * s) {
            break;
        }
    }
    return s;
}

struct cylinder_state {
    double r, P;
};

static struct cylinder_state cylinder_slope(const struct mpm_medium *m, double R,
                                            struct cylinder_state at, double *stretch) {
    const double hoop = at.r / R;
    *stretch = radial_stretch(m, at.P, hoop, *stretch);
    const double J = hoop * *stretch;
    return (struct cylinder_state){*stretch, -(at.P - nominal(m, hoop, J)) / R};
}

// Runge-Kutta from the hole outwards; the nominal stress that is left on the outside.
static double cylinder_shoot(const struct mpm_exact *e, double a, double *radius) {
    const struct mpm_solution *q = &e->q;
    const struct mpm_medium *m = &e->medium;
    const double dR = (q->outer - q->inner) / (N_RADII - 1);
    struct cylinder_state y = {a, -q->pressure * a / q->inner};
    double stretch = q->inner / a; // nearly incompressible
    for (size_t k = 0;; k++) {
        const double R = q->inner + (double)k * dR;
        const struct cylinder_state k1 = cylinder_slope(m, R, y, &stretch);
        if (radius) {
            radius[2 * k] = y.r;
            radius[2 * k + 1] = k1.r;
        }
        if (k + 1 == N_RADII || !(y.r > 0 && y.r < 1e6 * q->outer)) {
            return y.P;
        }
        const struct cylinder_state y2 = {y.r + dR / 2 * k1.r, y.P + dR / 2 * k1.P};
        const struct cylinder_state k2 = cylinder_slope(m, R + dR / 2, y2, &stretch);
        const struct cylinder_state y3 = {y.r + dR / 2 * k2.r, y.P + dR / 2 * k2.P};
        const struct cylinder_state k3 = cylinder_slope(m, R + dR / 2, y3, &stretch);
        const struct cylinder_state y4 = {y.r + dR * k3.r, y.P + dR * k3.P};
        const struct cylinder_state k4 = cylinder_slope(m, R + dR, y4, &stretch);
        y.r += dR / 6 * (k1.r + 2 * k2.r + 2 * k3.r + k4.r);
        y.P += dR / 6 * (k1.P + 2 * k2.P + 2 * k3.P + k4.P);
    }
}

// The inner radius at which nothing pulls on the outside: what is left there rises with it, until
// the rubber yields to any pressure (p -> mu ln(B/A) as it is blown up without end).
static enum mpm_status cylinder_solve(struct mpm_exact *e) {
    const struct mpm_solution *q = &e->q;
    e->radius = calloc(2 * N_RADII, sizeof *e->radius);
    if (!e->radius) {
        return MPM_ERR_MEMORY;
    }
    e->n_radii = N_RADII;
    // Steps outwards (or, under a suction, inwards) to the first change of sign, then halves.
    const double sign = q->pressure < 0 ? -1 : 1, step = 0.005 * q->inner;
    double low = q->inner, high = low;
    const double first = cylinder_shoot(e, low, NULL);
    bool found = first == 0;
    for (int k = 0; k < 1000 && !found && high > 2 * step; k++) {
        low = high;
        high += sign * step * (1 + 0.02 * k);
        found = cylinder_shoot(e, high, NULL) * first <= 0;
    }
    if (!found) {
        return MPM_ERR_RANGE;
    }
    for (int k = 0; k < MAX_ITERATIONS && fabs(high - low) > 1e-15 * q->inner; k++) {
        const double middle = (low + high) / 2;
        *(cylinder_shoot(e, middle, NULL) * first > 0 ? &low : &high) = middle;
    }
    cylinder_shoot(e, (low + high) / 2, e->radius);
    return MPM_OK;
}

// Cubic interpolation of r(R) between the steps, from values and slopes.
static void cylinder(const struct mpm_exact *e, const double *X, struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const struct polar at = polar_of(q, X);
    const double dR = (q->outer - q->inner) / (N_RADII - 1);
    const double place = fmin(fmax((at.R - q->inner) / dR, 0), N_RADII - 1);
    const size_t k = (size_t)fmin(floor(place), N_RADII - 2);
    const double s = place - (double)k, *y = e->radius + 2 * k;
    const double d = y[2] - y[0], c2 = 3 * d - dR * (2 * y[1] + y[3]),
                 c3 = dR * (y[1] + y[3]) - 2 * d;
    const double r = y[0] + s * (dR * y[1] + s * (c2 + s * c3));
    const double stretch = y[1] + s * (2 * c2 + 3 * s * c3) / dR;
    const double hoop = r / at.R, J = stretch * hoop, mu = e->medium.mu;
    const double pressure = e->medium.lambda * log(J);
    radial(&at, r - at.R, 0, out);
    polar_stress(at.cos, at.sin, (mu * (stretch * stretch - 1) + pressure) / J, 0,
                 (mu * (hoop * hoop - 1) + pressure) / J, pressure / J, out->sigma);
}

// ---- The tube of Knowles: r^2 = R^2 + c(t), incompressible, free inside and out -----------------

static double tube_acceleration(const struct mpm_exact *e, double c, double rate) {
    const double A2 = e->q.inner * e->q.inner, B2 = e->q.outer * e->q.outer;
    const double a2 = A2 + c, b2 = B2 + c;
    const double W = (log(a2 / A2) - log(b2 / B2) + c / a2 - c / b2) / 2;
    return 4 / log(b2 / a2) *
           (-e->medium.mu * W / e->medium.rho - rate * rate / 8 * (1 / b2 - 1 / a2));
}

static void tube_move(struct mpm_exact *e, double t) {
    const double A2 = e->q.inner * e->q.inner;
    const double longest = TUBE_STEP * e->q.inner * sqrt(e->medium.rho / e->medium.mu);
    const double n = fmin(fmax(ceil(fabs(t) / longest), 1), 1e7), dt = t / n;
    double c = 0, rate = e->q.rate;
    for (double k = 0; k < n && c > -A2; k++) {
        const double a1 = tube_acceleration(e, c, rate), r2 = rate + dt / 2 * a1;
        const double a2 = tube_acceleration(e, c + dt / 2 * rate, r2), r3 = rate + dt / 2 * a2;
        const double a3 = tube_acceleration(e, c + dt / 2 * r2, r3), r4 = rate + dt * a3;
        const double a4 = tube_acceleration(e, c + dt * r3, r4);
        c += dt / 6 * (rate + 2 * r2 + 2 * r3 + r4);
        rate += dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4);
    }
    e->c = c;
    e->c_rate = rate;
}

static void tube(const struct mpm_exact *e, const double *X, struct mpm_exact_state *out) {
    const struct polar at = polar_of(&e->q, X);
    const double r = sqrt(at.R * at.R + e->c);
    radial(&at, r - at.R, e->c_rate / (2 * r), out);
}

// ---- The generalised vortex: x = Q(g(t) h(R)) X, J = 1 everywhere at all times ------------------

struct vortex {
    double g, g_t, g_tt;    // rad, by time
    double h, h_R, h_RR;    // by radius; 0 outside the ring
    double angle, cos, sin; // of the turn and of the place that it leads to
};

static struct vortex vortex_at(const struct mpm_solution *q, const struct polar *at, double t) {
    const double w = M_PI / q->period, width = q->outer - q->inner;
    const double s = (at->R - (q->inner + q->outer) / 2) / width;
    struct vortex o = {.g = q->amplitude * sin(w * t),
                       .g_t = q->amplitude * w * cos(w * t),
                       .g_tt = -q->amplitude * w * w * sin(w * t)};
    if (fabs(s) < 0.5) {
        o.h = 1 - 8 * s * s + 16 * s * s * s * s;
        o.h_R = (-16 * s + 64 * s * s * s) / width;
        o.h_RR = (-16 + 192 * s * s) / (width * width);
    }
    o.angle = o.g * o.h;
    const double c = cos(o.angle), n = sin(o.angle);
    o.cos = at->cos * c - at->sin * n;
    o.sin = at->sin * c + at->cos * n;
    return o;
}

static void vortex(const struct mpm_exact *e, const double *X, double t,
                   struct mpm_exact_state *out) {
    const struct polar at = polar_of(&e->q, X);
    const struct vortex o = vortex_at(&e->q, &at, t);
    const double speed = at.R * o.g_t * o.h, shear = at.R * o.g * o.h_R, mu = e->medium.mu;
    out->u[0] = at.R * (o.cos - at.cos);
    out->u[1] = at.R * (o.sin - at.sin);
    out->v[0] = -speed * o.sin;
    out->v[1] = speed * o.cos;
    polar_stress(o.cos, o.sin, 0, mu * shear, mu * shear * shear, 0, out->sigma);
}

// ---- Taylor and Green's decaying vortices: at the place where the particle is now ---------------

static void taylor_green(const struct mpm_exact *e, const double *x, double t,
                         struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const double k = 2 * M_PI / q->length, U = q->amplitude, rho = e->medium.rho;
    const double X = k * (x[0] - q->centre[0]), Y = k * (x[1] - q->centre[1]);
    const double decay = rho > 0 ? exp(-2 * e->medium.viscosity / rho * k * k * t) : 1;
    out->v[0] = U * decay * sin(X) * cos(Y);
    out->v[1] = -U * decay * cos(X) * sin(Y);
    const double p = rho * U * U / 4 * decay * decay * (cos(2 * X) + cos(2 * Y));
    out->sigma[0] = out->sigma[4] = out->sigma[8] = -p;
}

// ---- Ritter's dam break: shallow water, from a gate at x0 with depth H in front of it -----------
// A column of water at X stands until the wave has come back to it, t0 = (x0 - X)/c, c^2 = g H; its
// path in u = 2/3 (c + (x - x0)/t) is then x = x0 + 2 c t - 3 c t0^(1/3) t^(2/3). It keeps its
// volume, so its points sink with the depth h = (2 c - (x - x0)/t)^2/(9 g).

static void ritter(const struct mpm_exact *e, const double *X, double t, int dim,
                   struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const int up = dim - 1;
    const double H = q->length, c = sqrt(fabs(e->medium.g[up]) * H);
    const double t0 = fmax(q->from - X[0], 0) / c;
    if (t <= t0 || t <= 0) {
        return;
    }
    const double path = 2 * c * t - 3 * c * cbrt(t0 * t * t);
    const double wave = 2 * c - path / t, depth = wave * wave / (9 * c * c); // h / H
    const double rate = 2 * c - 2 * c * cbrt(t0 / t);
    out->u[0] = q->from + path - X[0];
    out->v[0] = rate;
    out->u[up] = X[up] * (depth - 1);
    out->v[up] = X[up] * 2 * wave / (9 * c * c) * (path / t - rate) / t;
}

// ---- Straight ones ------------------------------------------------------------------------------

// Axial vibration between slip walls, at small strain.
static void mode(const struct mpm_exact *e, const double *X, double t,
                 struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const struct mpm_medium *m = &e->medium;
    const double beta = (2 * q->number - 1) * M_PI / (2 * q->length);
    const double modulus = m->lambda + 2 * m->mu;
    const double w = m->rho > 0 ? beta * sqrt(modulus / m->rho) : 0;
    const double at = beta * (X[q->axis] - q->from);
    out->v[q->axis] = q->amplitude * cos(w * t) * sin(at);
    if (w > 0) {
        out->u[q->axis] = q->amplitude / w * sin(w * t) * sin(at);
        const double strain = beta * q->amplitude / w * sin(w * t) * cos(at);
        for (int d = 0; d < 3; d++) {
            out->sigma[4 * d] = (d == q->axis ? modulus : m->lambda) * strain;
        }
    }
}

// Stretch of a confined column where the nominal stress along it is P. The stress is concave in the
// stretch, so Newton's method comes from below, once it is there.
static double column_stretch(const struct mpm_medium *m, double P) {
    if (m->is_fluid) {
        return 1 + P / m->bulk;
    }
    double F = 1;
    for (int k = 0; k < MAX_ITERATIONS; k++) {
        const double slope = m->mu * (1 + 1 / (F * F)) + m->lambda * (1 - log(F)) / (F * F);
        const double next = F - (nominal(m, F, F) - P) / slope, change = next - F;
        F = next > F / 4 ? next : F / 4;
        if (fabs(change) < 1e-15 * F) {
            break;
        }
    }
    return F;
}

// A confined column at rest, fixed at `from`, free at from + length: the nominal stress is the
// weight beyond, P = rho g (from + length - X), whatever the material.
static void column(const struct mpm_exact *e, const double *X, struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const struct mpm_medium *m = &e->medium;
    const double up = X[q->axis] - q->from, weight = m->rho * m->g[q->axis];
    double sum = 0;
    for (int k = 0; k <= N_HEIGHTS; k++) {
        const double F = column_stretch(m, weight * (q->length - up * k / N_HEIGHTS));
        sum += (k == 0 || k == N_HEIGHTS ? 1 : k % 2 ? 4 : 2) * (F - 1);
    }
    out->u[q->axis] = sum * up / (3 * N_HEIGHTS);
    const double P = weight * (q->length - up), F = column_stretch(m, P);
    for (int d = 0; d < 3; d++) {
        out->sigma[4 * d] = d == q->axis || m->is_fluid ? P : m->lambda * log(F) / F;
    }
}

// Rigid rotation about an axis through the centre (in 2D: z), by Rodrigues' formula.
static void rotation(const struct mpm_exact *e, const double *X, double t, int dim,
                     struct mpm_exact_state *out) {
    const struct mpm_solution *q = &e->q;
    const double n[3] = {dim == 3 ? q->vector[0] : 0, dim == 3 ? q->vector[1] : 0,
                         dim == 3 ? q->vector[2] : 1};
    double r[3] = {0}, now[3], along = 0;
    for (int d = 0; d < dim; d++) {
        r[d] = X[d] - q->centre[d];
        along += n[d] * r[d];
    }
    const double c = cos(q->rate * t), s = sin(q->rate * t);
    for (int d = 0; d < 3; d++) {
        const int i = (d + 1) % 3, j = (d + 2) % 3;
        now[d] = c * r[d] + s * (n[i] * r[j] - n[j] * r[i]) + (1 - c) * along * n[d];
        out->u[d] = now[d] - r[d];
    }
    for (int d = 0; d < 3; d++) {
        const int i = (d + 1) % 3, j = (d + 2) % 3;
        out->v[d] = q->rate * (n[i] * now[j] - n[j] * now[i]);
    }
}

// ---- All ----------------------------------------------------------------------------------------

enum mpm_status mpm_exact_create(struct mpm_exact *e, const struct mpm_solution *q,
                                 const struct mpm_medium *medium) {
    *e = (struct mpm_exact){.q = *q, .medium = *medium, .c_rate = q->rate};
    return q->kind == MPM_SOLUTION_CYLINDER ? cylinder_solve(e) : MPM_OK;
}

void mpm_exact_free(struct mpm_exact *e) {
    free(e->radius);
    *e = (struct mpm_exact){0};
}

void mpm_exact_move(struct mpm_exact *e, double t) {
    if (e->q.kind == MPM_SOLUTION_TUBE) {
        tube_move(e, t);
    }
}

void mpm_exact_state(const struct mpm_exact *e, const double *X, const double *x, double t, int dim,
                     struct mpm_exact_state *out) {
    *out = (struct mpm_exact_state){0};
    switch (e->q.kind) {
    case MPM_SOLUTION_ROTATION:
        rotation(e, X, t, dim, out);
        break;
    case MPM_SOLUTION_MODE:
        mode(e, X, t, out);
        break;
    case MPM_SOLUTION_COLUMN:
        column(e, X, out);
        break;
    case MPM_SOLUTION_LAME:
        lame(e, X, out);
        break;
    case MPM_SOLUTION_CYLINDER:
        cylinder(e, X, out);
        break;
    case MPM_SOLUTION_TUBE:
        tube(e, X, out);
        break;
    case MPM_SOLUTION_VORTEX:
        vortex(e, X, t, out);
        break;
    case MPM_SOLUTION_TAYLOR_GREEN:
        taylor_green(e, x, t, out);
        break;
    case MPM_SOLUTION_RITTER:
        ritter(e, X, t, dim, out);
        break;
    case MPM_N_SOLUTIONS:
        break;
    }
}

void mpm_solution_start(const struct mpm_solution *q, const double *X, int dim, double *v) {
    const struct mpm_exact e = {.q = *q, .c_rate = q->rate};
    struct mpm_exact_state at;
    mpm_exact_state(&e, X, X, 0, dim, &at);
    memcpy(v, at.v, (size_t)dim * sizeof *v);
}

void mpm_exact_force(const struct mpm_solution *q, const struct mpm_medium *m, const double *X,
                     double t, int dim, double *b) {
    memset(b, 0, (size_t)dim * sizeof *b);
    if (q->kind != MPM_SOLUTION_VORTEX) {
        return; // the others need none
    }
    const struct polar at = polar_of(q, X);
    const struct vortex o = vortex_at(q, &at, t);
    const double turn = o.g_t * o.h, slope = o.g * o.h_R, stiffness = m->mu / m->rho;
    const double b_r = -at.R * turn * turn + stiffness * at.R * slope * slope;
    const double b_t = at.R * o.g_tt * o.h - stiffness * (3 * slope + at.R * o.g * o.h_RR);
    b[0] = b_r * o.cos - b_t * o.sin;
    b[1] = b_r * o.sin + b_t * o.cos;
}
