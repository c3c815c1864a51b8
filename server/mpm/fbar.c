// F-bar (Zhao, Jiang, Choo, Algorithm 1; the anchored scheme of docs/method.md): the node stage.
//
// Switching needs no conversion. The particles keep F (or Jbar) that the stress uses and the volume
// V apart at all times, so a scheme merely says how each goes on: neither stress nor volume can
// jump.
#include "server/mpm/fbar.h"

int mpm_fbar_scalars(enum mpm_fbar_scheme scheme) {
    return scheme == MPM_FBAR_OFF ? 0 : scheme == MPM_FBAR_ZHAO ? 1 : 2;
}

void mpm_fbar_divide(const struct mpm_grid *grid, uint32_t begin, uint32_t end) {
    const size_t scalars = (size_t)grid->fbar_stride, nodes = (size_t)MPM_BLOCK_NODES(grid->dim);
    const size_t volume = (size_t)MPM_NODE_VOLUME(grid->dim);
    for (size_t i = begin * nodes; i < end * nodes; i++) {
        const double V = grid->node[i * MPM_NODE + volume];
        for (size_t k = 0; V > 0 && k < scalars; k++) {
            grid->fbar[i * scalars + k] /= V;
        }
    }
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
