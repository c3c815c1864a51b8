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

struct mpm_kernels {
    // eqs. 7, 8, 10: mass, momentum, internal force and, with F-bar, volume to the grid.
    void (*p2g)(const struct mpm_span *span, struct mpm_span_result *result);
    // A force on each of n particles (their places) to the grid: f_i += w_ip f_p.
    void (*force)(const struct mpm_span *span, const uint32_t *particle, const double *f, size_t n);
    // eqs. 11-17: velocity, and the deformation with the plain increment; then, where F-bar is off,
    // stress and position. With F-bar on it leaves dx and dJ for fbar_finish.
    void (*g2p)(const struct mpm_span *span, struct mpm_span_result *result);
    // eq. 19, with the volume of time n: V Jbar dJ (or the sums of the anchored scheme) to the
    // grid, where P2G has left V.
    void (*fbar_scatter[MPM_N_FBAR_SCHEMES])(const struct mpm_span *span);
    // eqs. 20, 25: averaged ratio to the particles, deformation scaled to it; then stress and
    // position.
    void (*fbar_finish[MPM_N_FBAR_SCHEMES])(const struct mpm_span *span,
                                            struct mpm_span_result *result);
};

// The plain scalar kernels of a dimension (2, 3) and basis; static.
const struct mpm_kernels *mpm_kernels_plain(int dim, enum mpm_basis basis);
