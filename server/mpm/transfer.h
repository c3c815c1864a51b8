// Particle-grid transfers, and the table of kernels specialised for dimension and basis.
#pragma once
#include "server/mpm/grid.h"
#include "server/mpm/particles.h"

// What one call of a kernel works on: particles [begin, end) of one body.
struct mpm_span {
    struct mpm_particles *s;
    struct mpm_grid *grid;
    size_t begin, end;
    size_t next; // where the next span of the same thread begins, to fetch it early; may be `begin`
    double dt, blend;
    bool fbar;                   // this body takes part in F-bar in this step
    enum mpm_fbar_scheme scheme; // if so, by which scheme
    double a, C, keep;           // of the anchored one
};

// What a pass found in its span, joined in span order.
struct mpm_span_result {
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM]; // m, new positions
    double v2_max;                             // (m/s)^2
    double dx_max;                             // m, largest displacement along an axis
    double mass_dx[MPM_MAX_DIM];               // kg m, sum of mass times displacement of this step
    uint32_t n_runs;                           // particles of one cell that follow each other
    enum mpm_status status;                    // of the first fault
    size_t bad;                                // first particle at fault, or SIZE_MAX
    double value;
};
static inline struct mpm_span_result mpm_nothing_found(void) {
    return (struct mpm_span_result){
        .min = {INFINITY, INFINITY, INFINITY},
        .max = {-INFINITY, -INFINITY, -INFINITY},
        .bad = SIZE_MAX,
    };
}

// What moves the nodes: eq. 9.
struct mpm_motion {
    double dt, local, mass; // s; damping: alpha of local, 1/s of mass-proportional
    double gravity[MPM_MAX_DIM];
};

struct mpm_kernels {
    // eqs. 7, 8, 10: mass, momentum, internal force and, with F-bar, volume to the grid.
    void (*p2g)(const struct mpm_span *span, struct mpm_span_result *result);
    // eq. 9: nodal velocities of the blocks with slots [begin, end). Damping acts on the total
    // force, before boundary conditions; FLIP's increment is taken from v^n before boundary
    // conditions.
    void (*move_nodes)(const struct mpm_grid *grid, uint32_t begin, uint32_t end,
                       const struct mpm_motion *motion);
    // eqs. 11-17: velocity, and the deformation with the plain increment; then, where F-bar is off,
    // stress and position. With F-bar on it leaves dx and dJ for fbar, and sends V Jbar dJ (or the
    // sums of the anchored scheme), with the volume of time n, to the grid, where P2G has left V:
    // eq. 19.
    void (*g2p)(const struct mpm_span *span, struct mpm_span_result *result);
    // eq. 20, once walls have folded: F-bar's sums become averages, in the blocks with slots
    // [begin, end); a node without volume stays out.
    void (*divide_nodes)(const struct mpm_grid *grid, uint32_t begin, uint32_t end);
    // eqs. 20, 25: averaged ratio to the particles, deformation scaled to it; then stress and
    // position.
    void (*fbar)(const struct mpm_span *span, struct mpm_span_result *result);
    // A force on each of n particles (their places) to the grid: f_i += w_ip f_p.
    void (*force)(const struct mpm_span *span, const uint32_t *particle, const double *f, size_t n);
};

// X(dimension, basis) for every combination.
#define MPM_EACH_KERNEL(X)                                                                         \
    X(2, LINEAR)                                                                                   \
    X(2, GIMP) X(2, BSPLINE2) X(2, BSPLINE3) X(3, LINEAR) X(3, GIMP) X(3, BSPLINE2) X(3, BSPLINE3)

// The kernels of a dimension (2, 3), basis and instruction set, which the machine must have;
// static.
const struct mpm_kernels *mpm_kernels(int dim, enum mpm_basis basis, enum mpm_isa isa);
