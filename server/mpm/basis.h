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

// The first node that a particle reaches, for MPM_LANES particles at once, as a whole number. Of
// uGIMP only: `half` is half the particle's size in cells, at most 1/2.
MPM_KERNEL mpm_vec mpm_base(const enum mpm_basis basis, const mpm_vec xi, const double half) {
    switch (basis) {
    case MPM_LINEAR:
        return mpm_trunc(xi);
    case MPM_GIMP:
        return mpm_trunc(xi - half);
    case MPM_BSPLINE2:
        return mpm_trunc(xi - 0.5);
    default:
        return mpm_trunc(xi) - 1.0;
    }
}

// The weights from t = xi - base. inv_4_half is 1/(4 half), which the caller divides once.
MPM_KERNEL void mpm_weights_at(const enum mpm_basis basis, const mpm_vec t, const double half,
                               const double inv_4_half, mpm_vec *w, mpm_vec *dw) {
    switch (basis) {
    case MPM_LINEAR:
        w[0] = 1.0 - t, w[1] = t;
        dw[0] = mpm_splat(-1), dw[1] = mpm_splat(1);
        return;
    case MPM_GIMP: {
        // The hat functions averaged over [xi - half, xi + half]. left and right: how far the two
        // ends lie from node base + 1, to its left; b: how far the right end lies beyond it.
        const double r = inv_4_half;
        const mpm_vec left = (1.0 + half) - t, right = (1.0 - half) - t;
        const mpm_vec zero = mpm_splat(0), d1 = mpm_max(right, zero), b = mpm_max(-right, zero);
        w[0] = r * (left * left - d1 * d1);
        w[2] = r * (b * b);
        w[1] = 1.0 - w[0] - w[2];
        dw[0] = -2.0 * r * (left - d1);
        dw[2] = 2.0 * r * b;
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
    const mpm_vec base = mpm_base(basis, xi, half);
    mpm_weights_at(basis, xi - base, half, inv_4_half, w, dw);
    return base;
}
