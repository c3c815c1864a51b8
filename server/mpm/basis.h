// Basis functions: weights and gradients of one particle along one direction.
//
// `xi` is the particle's coordinate in cells, measured from the grid's first stored node, so it is
// positive. The weights are those of nodes base, base + 1, ...; they sum to 1 and the derivatives
// (per cell) to 0. Linear and B-splines: Steffen, Kirby, Berzins 2008; uGIMP: Bardenhagen, Kober
// 2004, with the fixed half size of Wallstedt, Guilkey 2008.
#pragma once
#include "server/mpm/mpm.h"
#include "server/mpm/simd.h"
#include "server/mpm/tensor.h"

#define MPM_MAX_SUPPORT 4

// Nodes per direction that a particle reaches.
MPM_KERNEL int mpm_support(const enum mpm_basis basis) {
    return basis == MPM_LINEAR ? 2 : basis == MPM_BSPLINE3 ? 4 : 3;
}

// The first of the nodes whose weights are given, for MPM_LANES particles at once, as a whole
// number. uGIMP reaches less than 3/2 of a cell to either side, so the node nearest to the particle
// is always the middle one, as with quadratic B-splines: then particles that lie on a lattice do so
// well within the reach of their nodes, and not on its edge.
MPM_KERNEL mpm_vec mpm_base(const enum mpm_basis basis, const mpm_vec xi) {
    switch (basis) {
    case MPM_LINEAR:
        return mpm_trunc(xi);
    case MPM_GIMP:
    case MPM_BSPLINE2:
        return mpm_trunc(xi - 0.5);
    default:
        return mpm_trunc(xi) - 1.0;
    }
}

// The weights from t = xi - base. Of uGIMP only: `half` is half the particle's size in cells, at
// most 1/2, and inv_4_half is 1/(4 half), which the caller divides once.
MPM_KERNEL void mpm_weights_at(const enum mpm_basis basis, const mpm_vec t, const double half,
                               const double inv_4_half, mpm_vec *w, mpm_vec *dw) {
    switch (basis) {
    case MPM_LINEAR:
        w[0] = 1.0 - t, w[1] = t;
        dw[0] = mpm_splat(-1), dw[1] = mpm_splat(1);
        return;
    case MPM_GIMP: {
        // The hat functions averaged over [t - half, t + half]: how far its two ends lie before the
        // middle node, and how far beyond it.
        const double r = inv_4_half;
        const mpm_vec zero = mpm_splat(0);
        const mpm_vec left = mpm_max((1.0 + half) - t, zero),
                      right = mpm_max((1.0 - half) - t, zero);
        const mpm_vec a = mpm_max(t - (1.0 + half), zero), b = mpm_max(t - (1.0 - half), zero);
        w[0] = r * (left * left - right * right);
        w[2] = r * (b * b - a * a);
        w[1] = 1.0 - w[0] - w[2];
        dw[0] = -2.0 * r * (left - right);
        dw[2] = 2.0 * r * (b - a);
        dw[1] = -dw[0] - dw[2];
        return;
    }
    case MPM_BSPLINE2: {
        const mpm_vec l = 1.5 - t, c = t - 1.0, r = t - 0.5;
        w[0] = 0.5 * l * l, w[1] = 0.75 - c * c, w[2] = 0.5 * r * r;
        dw[0] = -l, dw[1] = -2.0 * c, dw[2] = r;
        return;
    }
    default: { // MPM_BSPLINE3
        const mpm_vec u = t - 1.0, s = 2.0 - t;
        w[0] = s * s * s * (1.0 / 6), w[3] = u * u * u * (1.0 / 6);
        w[1] = (3.0 * u - 6.0) * u * u * (1.0 / 6) + 2.0 / 3;
        w[2] = (3.0 * s - 6.0) * s * s * (1.0 / 6) + 2.0 / 3;
        dw[0] = -0.5 * s * s, dw[3] = 0.5 * u * u;
        dw[1] = (1.5 * u - 2.0) * u, dw[2] = -(1.5 * s - 2.0) * s;
        return;
    }
    }
}

// Both: returns base.
MPM_KERNEL mpm_vec mpm_weights(const enum mpm_basis basis, const mpm_vec xi, const double half,
                               const double inv_4_half, mpm_vec *w, mpm_vec *dw) {
    const mpm_vec base = mpm_base(basis, xi);
    mpm_weights_at(basis, xi - base, half, inv_4_half, w, dw);
    return base;
}
