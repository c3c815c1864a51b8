// Particle-grid transfers, and the table of kernels specialised for dimension and basis.
#pragma once
#include "server/mpm/grid.h"
#include "server/mpm/particles.h"

// What one call of a kernel works on: particles [begin, end) of one body.
struct mpm_span {
    struct mpm_particles *s;
    struct mpm_grid *grid;
    size_t begin, end;
    double dt, blend;
    double a, C; // of the anchored F-bar scheme
    bool fbar;   // this body takes part in F-bar in this step
};

// What a pass found in its span, joined in span order.
struct mpm_span_result {
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM]; // m, new positions
    double v2_max;                             // (m/s)^2
    double mass_dx[MPM_MAX_DIM];               // kg m, sum of mass times displacement of this step
    size_t bad;                                // first particle at fault, or SIZE_MAX
    enum mpm_status status;                    // of its fault
    double value;
};

struct mpm_kernels {
    // eqs. 7, 8, 10: mass, momentum and internal force to the grid.
    void (*p2g)(const struct mpm_span *span);
    // A force on each of n particles (indices, ascending) to the grid: f_i += w_ip f_p.
    void (*force)(const struct mpm_span *span, const uint32_t *particle, const double *f, size_t n);
    // eqs. 11-17: velocity, and the deformation with the plain increment; then, where F-bar is off,
    // stress and position. With F-bar on it leaves dx and dJ for fbar_finish.
    void (*g2p)(const struct mpm_span *span, struct mpm_span_result *result);
    // eq. 19, with the volume of time n: V and V Jbar dJ (or the sums of the anchored scheme) to
    // the grid.
    void (*fbar_scatter[MPM_N_FBAR_SCHEMES])(const struct mpm_span *span);
    // eqs. 20, 25: averaged ratio to the particles, deformation scaled to it; then stress and
    // position.
    void (*fbar_finish[MPM_N_FBAR_SCHEMES])(const struct mpm_span *span,
                                            struct mpm_span_result *result);
};

// The kernels of a dimension (2, 3) and basis; static.
const struct mpm_kernels *mpm_kernels(int dim, enum mpm_basis basis);
