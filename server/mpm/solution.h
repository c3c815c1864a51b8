// Exact and manufactured solutions: docs/method.md section 11 has the formula of each.
#pragma once
#include "server/mpm/mpm.h"

// What a solution needs to know of the matter and of the scene.
struct mpm_medium {
    double rho;                // kg/m^3
    double mu, lambda;         // Pa, of a solid
    double bulk, viscosity;    // Pa, Pa s, of a fluid
    double g[MPM_MAX_DIM];     // m/s^2
    bool is_fluid, is_elastic; // newtonian; elastic at small strain
    bool is_neo_hookean;
};
struct mpm_medium mpm_medium_of(const struct mpm_material *model, const double *parameters,
                                const double *gravity);

// A solution made ready for a medium.
struct mpm_exact {
    struct mpm_solution q;
    struct mpm_medium medium;
    double *radius;   // (n_radii, 2) of a cylinder: r and its slope, evenly spaced in R; owned
    size_t n_radii;   // 0: none
    double c, c_rate; // of a tube, at the time that it was last moved to: r^2 - R^2, m^2
};
// What it says of a particle: displacement (m), velocity (m/s), Cauchy stress (Pa, 3 x 3).
struct mpm_exact_state {
    double u[3], v[3], sigma[9];
};

// Whether a solution tells the field, holds in the medium, and does not change with time.
bool mpm_solution_tells(enum mpm_solution_kind kind, enum mpm_field field);
bool mpm_solution_holds(enum mpm_solution_kind kind, const struct mpm_medium *medium);
bool mpm_solution_is_static(enum mpm_solution_kind kind);
// Largest speed at t = 0, m/s.
double mpm_solution_speed(const struct mpm_solution *q);
// Velocity at t = 0 at reference position X; of solutions whose start does not depend on the
// medium.
void mpm_solution_start(const struct mpm_solution *q, const double *X, int dim, double *v);

// ERR_RANGE where there is no such solution (a pressure that nothing can hold), ERR_MEMORY.
enum mpm_status mpm_exact_create(struct mpm_exact *e, const struct mpm_solution *q,
                                 const struct mpm_medium *medium);
void mpm_exact_free(struct mpm_exact *e);
// To time t, s; then the state of a particle that began at X and is at x now (dim components).
void mpm_exact_move(struct mpm_exact *e, double t);
void mpm_exact_state(const struct mpm_exact *e, const double *X, const double *x, double t, int dim,
                     struct mpm_exact_state *out);
// The body force per mass (m/s^2) that makes a manufactured solution one.
void mpm_exact_force(const struct mpm_solution *q, const struct mpm_medium *medium, const double *X,
                     double t, int dim, double *b);
