// Basis functions: weights and gradients of one particle along one direction.
//
// `xi` is the particle's coordinate in cells, measured from the grid's first stored node, so it is
// positive. The weights are those of nodes base, base + 1, ...; they sum to 1 and the derivatives
// (per cell) to 0. Linear and B-splines: Steffen, Kirby, Berzins 2008; uGIMP: Bardenhagen, Kober
// 2004, with the fixed half size of Wallstedt, Guilkey 2008.
#pragma once
#include "server/mpm/mpm.h"
#include "server/mpm/tensor.h"

#define MPM_MAX_SUPPORT 4

// Nodes per direction that a particle reaches.
MPM_KERNEL int mpm_support(const enum mpm_basis basis) {
    return basis == MPM_LINEAR ? 2 : basis == MPM_BSPLINE3 ? 4 : 3;
}

// The first node that a particle reaches: base of mpm_weights.
MPM_KERNEL int mpm_base(const enum mpm_basis basis, const double xi, const double half) {
    switch (basis) {
    case MPM_LINEAR:
        return (int)xi;
    case MPM_GIMP:
        return (int)(xi - half);
    case MPM_BSPLINE2:
        return (int)(xi - 0.5);
    default:
        return (int)xi - 1;
    }
}

// Returns base. Of uGIMP only: `half` is half the particle's size in cells, at most 1/2, and
// inv_4_half is 1/(4 half), which the caller divides once.
MPM_KERNEL int mpm_weights(const enum mpm_basis basis, const double xi, const double half,
                           const double inv_4_half, double *w, double *dw) {
    switch (basis) {
    case MPM_LINEAR: {
        const int base = (int)xi;
        const double t = xi - base;
        w[0] = 1 - t, w[1] = t;
        dw[0] = -1, dw[1] = 1;
        return base;
    }
    case MPM_GIMP: {
        // The hat functions averaged over [xi - half, xi + half]. d0 and d1: how far the two ends
        // lie from node base + 1, to its left; b: how far the right end lies beyond it.
        const int base = (int)(xi - half);
        const double r = inv_4_half;
        const double left = base + 1 - (xi - half), right = base + 1 - (xi + half);
        const double d1 = right > 0 ? right : 0, b = right < 0 ? -right : 0;
        w[0] = r * (left * left - d1 * d1);
        w[2] = r * (b * b);
        w[1] = 1 - w[0] - w[2];
        dw[0] = -2 * r * (left - d1);
        dw[2] = 2 * r * b;
        dw[1] = -dw[0] - dw[2];
        return base;
    }
    case MPM_BSPLINE2: {
        const int base = (int)(xi - 0.5);
        const double t = xi - base, l = 1.5 - t, c = t - 1, r = t - 0.5;
        w[0] = 0.5 * l * l, w[1] = 0.75 - c * c, w[2] = 0.5 * r * r;
        dw[0] = -l, dw[1] = -2 * c, dw[2] = r;
        return base;
    }
    default: { // MPM_BSPLINE3
        const int cell = (int)xi;
        const double t = xi - cell, s = 1 - t;
        w[0] = s * s * s / 6, w[3] = t * t * t / 6;
        w[1] = (3 * t - 6) * t * t / 6 + 2.0 / 3, w[2] = (3 * s - 6) * s * s / 6 + 2.0 / 3;
        dw[0] = -0.5 * s * s, dw[3] = 0.5 * t * t;
        dw[1] = (1.5 * t - 2) * t, dw[2] = -(1.5 * s - 2) * s;
        return cell - 1;
    }
    }
}
