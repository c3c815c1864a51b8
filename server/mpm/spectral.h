// Logarithm and exponential of symmetric tensors in lanes, in the storage of tensor.h: 4 components
// in 2D (the out-of-plane one stands alone), 6 in 3D. Right for repeated and for extreme
// eigenvalues: series near the identity, and one by one by eigenvalues elsewhere.
//
// A series in a tensor A needs no eigenvalues and few products: A^3 = I1 A^2 - I2 A + I3 1 (Cayley,
// Hamilton) keeps every polynomial in the form p0 1 + p1 A + p2 A^2.
#pragma once
#include "server/mpm/tensor.h"

// ln(b)/2 of a positive definite b: the Hencky strain of b = F F^T.
MPM_KERNEL void mpm_half_log(const mpm_vec *b, mpm_vec *e, const int dim);
// exp(2 e), its inverse.
MPM_KERNEL void mpm_exp_twice(const mpm_vec *e, mpm_vec *b, const int dim);
// The same of a strain whose deviator has shrunk: exp(2 (mean 1 + (1 - part) D)), from b = exp(2
// (mean 1 + D)), which is known and may be overwritten, and norm2 = |D|^2.
MPM_KERNEL void mpm_exp_twice_less(const mpm_vec *b, const mpm_vec *D, mpm_vec norm2, mpm_vec part,
                                   mpm_vec mean, mpm_vec *less, const int dim);

// The same by eigenvalues, for any size, of those of n_lanes tensors whose bit is set in `lanes`:
// component k of tensor i is b[k * n_lanes + i].
void mpm_half_log_far(const double *b, double *e, int dim, int n_lanes, unsigned lanes);
void mpm_exp_twice_far(const double *e, double *b, int dim, int n_lanes, unsigned lanes);

// The tensor with eigenvalues w along the columns of the row-major Q, in 3D.
void mpm_from_eigen(const double *w, const double *Q, double *s);

// The series reach to this Frobenius norm of their argument.
#define MPM_SERIES_REACH 0.2

// Replaces the lanes of y that are out of a series' reach.
MPM_KERNEL void mpm_far_lanes(void (*far)(const double *, double *, int, int, unsigned),
                              mpm_mask near, const mpm_vec *x, mpm_vec *y, const int dim) {
    const unsigned lanes = mpm_bits(mpm_not(near));
    if (MPM_UNLIKELY(lanes)) {
        double from[6 * MPM_LANES], to[6 * MPM_LANES];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            mpm_store(from + k * MPM_LANES, x[k]);
            mpm_store(to + k * MPM_LANES, y[k]);
        }
        far(from, to, dim, MPM_LANES, lanes);
        for (int k = 0; k < MPM_SYM(dim); k++) {
            y[k] = mpm_load(to + k * MPM_LANES);
        }
    }
}

// Product of two tensors that commute.
MPM_KERNEL void mpm_commuting_product(const mpm_vec *a, const mpm_vec *b, mpm_vec *c,
                                      const int dim) {
    c[0] = a[0] * b[0] + a[3] * b[3];
    c[1] = a[3] * b[3] + a[1] * b[1];
    c[2] = a[2] * b[2];
    c[3] = a[0] * b[3] + a[3] * b[1];
    if (dim == 3) {
        c[0] += a[5] * b[5];
        c[1] += a[4] * b[4];
        c[2] += a[5] * b[5] + a[4] * b[4];
        c[3] += a[5] * b[4];
        c[4] = a[3] * b[5] + a[1] * b[4] + a[4] * b[2];
        c[5] = a[0] * b[5] + a[3] * b[4] + a[5] * b[2];
    }
}

// p0 1 + p1 A + p2 A^2
MPM_KERNEL void mpm_quadratic(mpm_vec p0, mpm_vec p1, mpm_vec p2, const mpm_vec *A,
                              const mpm_vec *A2, mpm_vec *out, const int dim) {
    for (int k = 0; k < MPM_SYM(dim); k++) {
        out[k] = p1 * A[k] + p2 * A2[k];
        if (k < 3) {
            out[k] += p0;
        }
    }
}

// ln(b)/2 = atanh(X) with X = (b - 1)(b + 1)^-1: X g(X^2) with g(y) = atanh(sqrt(y))/sqrt(y), a
// minimax polynomial (Remez, 1.4e-17 for y <= 0.0401).
MPM_KERNEL void mpm_half_log(const mpm_vec *b, mpm_vec *e, const int dim) {
    static const double g[] = {1,
                               0.3333333333333783,
                               0.19999999997658027,
                               0.14285714750409342,
                               0.11111065895132118,
                               0.09093291839488891,
                               0.0762313428117756,
                               0.07697570205607637};
    mpm_vec B[6], inverse[6], X[6], Y[6];
    for (int k = 0; k < MPM_SYM(dim); k++) {
        B[k] = k < 3 ? b[k] - 1.0 : b[k];
    }
    const mpm_vec a0 = b[0] + 1.0, a1 = b[1] + 1.0, a2 = b[2] + 1.0; // (b + 1)^-1 by cofactors
    inverse[0] = a1 * a2;
    inverse[1] = a0 * a2;
    inverse[2] = a0 * a1 - b[3] * b[3];
    inverse[3] = -b[3] * a2;
    mpm_vec det = a2 * inverse[2];
    if (dim == 3) {
        inverse[0] -= b[4] * b[4];
        inverse[1] -= b[5] * b[5];
        inverse[3] += b[5] * b[4];
        inverse[4] = b[3] * b[5] - a0 * b[4];
        inverse[5] = b[3] * b[4] - b[5] * a1;
        det += b[4] * inverse[4] + b[5] * inverse[5];
    }
    const mpm_vec r = 1.0 / det;
    for (int k = 0; k < MPM_SYM(dim); k++) {
        inverse[k] *= r;
    }
    mpm_commuting_product(B, inverse, X, dim);
    mpm_commuting_product(X, X, Y, dim);

    // Invariants of X (J) and of Y = X^2 (I); g(Y) = p0 1 + p1 Y + p2 Y^2 by Horner's rule.
    const mpm_vec J1 = X[0] + X[1] + X[2], J3 = mpm_det_sym(X, dim);
    const mpm_vec I1 = Y[0] + Y[1] + Y[2], J2 = 0.5 * (J1 * J1 - I1);
    const mpm_vec I2 = J2 * J2 - 2.0 * J1 * J3, I3 = J3 * J3;
    mpm_vec p0 = mpm_splat(g[5]), p1 = mpm_splat(g[6]), p2 = mpm_splat(g[7]);
    for (int k = 4; k >= 0; k--) {
        const mpm_vec top = p2;
        p2 = p1 + top * I1;
        p1 = p0 - top * I2;
        p0 = g[k] + top * I3;
    }
    // X g(Y) = p0 X + p1 X^3 + p2 X^5, once more with Cayley and Hamilton.
    const mpm_vec q = p1 + p2 * (J1 * J1 - J2);
    mpm_quadratic(J3 * q, p0 - J2 * q + p2 * (J1 * J3), J1 * q + p2 * (J3 - J1 * J2), X, Y, e, dim);
    mpm_far_lanes(mpm_half_log_far, I1 <= MPM_SERIES_REACH * MPM_SERIES_REACH, b, e, dim);
}

// exp(2 e) = exp(trace(2 e)/3) exp(A) with the deviator A; its Taylor series to A^11 (8e-18).
MPM_KERNEL void mpm_exp_twice(const mpm_vec *e, mpm_vec *b, const int dim) {
    static const double c[] = {
        1,         1,          1.0 / 2,     1.0 / 6,      1.0 / 24,      1.0 / 120,
        1.0 / 720, 1.0 / 5040, 1.0 / 40320, 1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800};
    const mpm_vec mean = (e[0] + e[1] + e[2]) * (1.0 / 3);
    mpm_vec A[6], A2[6];
    for (int k = 0; k < MPM_SYM(dim); k++) {
        A[k] = 2.0 * (k < 3 ? e[k] - mean : e[k]);
    }
    mpm_commuting_product(A, A, A2, dim);
    const mpm_vec norm2 = A2[0] + A2[1] + A2[2], I2 = -0.5 * norm2, I3 = mpm_det_sym(A, dim);
    mpm_vec p0 = mpm_splat(c[9]), p1 = mpm_splat(c[10]), p2 = mpm_splat(c[11]);
    for (int k = 8; k >= 0; k--) {
        const mpm_vec top = p2;
        p2 = p1;
        p1 = p0 - top * I2;
        p0 = c[k] + top * I3;
    }
    const mpm_vec scale = mpm_exp(2.0 * mean);
    mpm_quadratic(scale * p0, scale * p1, scale * p2, A, A2, b, dim);
    mpm_far_lanes(mpm_exp_twice_far, norm2 <= MPM_SERIES_REACH * MPM_SERIES_REACH, e, b, dim);
}

// b + b (exp(A) - 1) with A = -t D, which commutes with b: the series to A^5, by the invariants J2
// = -I2 and J3 = I3 of t D.
#define MPM_SHORT_REACH 6e-3 // of A's norm: the next term is 2e-17 at most
MPM_KERNEL void mpm_exp_twice_less(const mpm_vec *b, const mpm_vec *D, mpm_vec norm2, mpm_vec part,
                                   mpm_vec mean, mpm_vec *less, const int dim) {
    const mpm_vec half = 0.5 * norm2, t = 2.0 * part, t2 = t * t, J2 = t2 * half;
    const mpm_vec minor = D[2] * D[2] - half; // of the plane's components, in 2D
    const mpm_vec J3 = t2 * (t * (dim == 2 ? D[2] * minor : mpm_det_sym(D, dim)));
    const mpm_vec p0 = -J3 * (1.0 / 6 + J2 * (1.0 / 120));
    const mpm_vec p1 = -t * (1.0 - J3 * (1.0 / 24) + J2 * (1.0 / 6 + J2 * (1.0 / 120)));
    const mpm_vec p2 = t2 * (0.5 + J2 * (1.0 / 24) - J3 * (1.0 / 120));
    mpm_vec E[6], bE[6];
    if (dim == 2) { // in the plane D^2 = -D[2] D - minor 1 (Cayley, Hamilton, and no trace)
        const mpm_vec q0 = p0 - p2 * minor, q1 = p1 - p2 * D[2];
        E[0] = q0 + q1 * D[0];
        E[1] = q0 + q1 * D[1];
        E[2] = p0 + D[2] * (p1 + p2 * D[2]);
        E[3] = q1 * D[3];
    } else {
        mpm_vec D2[6];
        mpm_commuting_product(D, D, D2, dim);
        for (int k = 0; k < MPM_SYM(dim); k++) {
            E[k] = (k < 3 ? p0 + p1 * D[k] : p1 * D[k]) + p2 * D2[k];
        }
    }
    mpm_commuting_product(b, E, bE, dim);
    for (int k = 0; k < MPM_SYM(dim); k++) {
        less[k] = b[k] + bE[k];
    }
    const mpm_mask near = J2 <= 0.5 * MPM_SHORT_REACH * MPM_SHORT_REACH;
    if (MPM_UNLIKELY(!mpm_all(near))) {
        mpm_vec e[6], far[6];
        for (int k = 0; k < MPM_SYM(dim); k++) {
            e[k] = k < 3 ? mean + (1.0 - part) * D[k] : (1.0 - part) * D[k];
        }
        mpm_exp_twice(e, far, dim);
        for (int k = 0; k < MPM_SYM(dim); k++) {
            less[k] = mpm_select(near, less[k], far[k]);
        }
    }
}
