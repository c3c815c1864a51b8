// F-bar (Zhao, Jiang, Choo, Algorithm 1; the anchored scheme of docs/method.md): the node stage.
//
// Switching needs no conversion. The particles keep F (or Jbar) that the stress uses and the volume
// V apart at all times, so a scheme merely says how each goes on: neither stress nor volume can
// jump.
#include "server/mpm/fbar.h"

int mpm_fbar_scalars(enum mpm_fbar_scheme scheme) {
    return scheme == MPM_FBAR_OFF ? 0 : scheme == MPM_FBAR_ZHAO ? 1 : 2;
}

void mpm_fbar_average(struct mpm_grid *grid, const struct mpm_wall *walls, size_t n_walls,
                      enum mpm_fbar_scheme scheme) {
    const int scalars = mpm_fbar_scalars(scheme), stride = grid->fbar_stride;
    mpm_walls_fold_fbar(walls, n_walls, grid);
    MPM_FOR_ROWS(grid, first, n) {
        for (size_t i = first; i < first + n; i++) {
            double *node = grid->fbar + i * (size_t)stride;
            if (node[0] > 0) {
                for (int k = 1; k <= scalars; k++) {
                    node[k] /= node[0];
                }
            }
        }
    }
    mpm_walls_mirror_fbar(walls, n_walls, grid);
}

double mpm_fbar_drift(const struct mpm_particles *s) {
    double largest = 0;
    for (size_t p = 0; p < s->n; p++) {
        const double J = s->J_raw ? s->J_raw[p] : s->V[p] / s->V0[p];
        const double drift = J > 0 ? fabs(log(J / mpm_ratio_in_use(s, p))) : INFINITY;
        largest = drift > largest ? drift : largest;
    }
    return largest;
}
