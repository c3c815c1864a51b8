// Logarithm and exponential of symmetric tensors, in the storage of tensor.h: 4 components in 2D
// (the out-of-plane one stands alone), 6 in 3D. Right for repeated and for extreme eigenvalues.
#pragma once
#include "server/mpm/tensor.h"

// ln(b)/2 of a positive definite b: the Hencky strain of b = F F^T.
MPM_KERNEL void mpm_half_log(const double *b, double *e, const int dim);
// exp(2 e), its inverse.
MPM_KERNEL void mpm_exp_twice(const double *e, double *b, const int dim);

// Symmetric 3 x 3 product of two commuting tensors.
MPM_KERNEL void mpm_commuting_product(const double *a, const double *b, double *c) {
    c[0] = a[0] * b[0] + a[3] * b[3] + a[5] * b[5];
    c[1] = a[3] * b[3] + a[1] * b[1] + a[4] * b[4];
    c[2] = a[5] * b[5] + a[4] * b[4] + a[2] * b[2];
    c[3] = a[0] * b[3] + a[3] * b[1] + a[5] * b[4];
    c[4] = a[3] * b[5] + a[1] * b[4] + a[4] * b[2];
    c[5] = a[0] * b[5] + a[3] * b[4] + a[5] * b[2];
}

// Eigenvalues w and eigenvectors (columns of the row-major Q) by cyclic Jacobi rotations.
static inline void mpm_eigen_sym3(const double *s, double *w, double *Q) {
    double A[9] = {s[0], s[3], s[5], s[3], s[1], s[4], s[5], s[4], s[2]};
    for (int k = 0; k < 9; k++) {
        Q[k] = k % 4 == 0;
    }
    for (int sweep = 0; sweep < 50; sweep++) { // converges quadratically: 6 or 7 in practice
        int rotated = 0;
        for (int p = 0; p < 2; p++) {
            for (int q = p + 1; q < 3; q++) {
                const double a = A[3 * p + q];
                // Off-diagonals below round-off of both diagonals: keeps small eigenvalues
                // relative.
                if (fabs(a) <= 1e-17 * sqrt(fabs(A[4 * p] * A[4 * q]))) {
                    continue;
                }
                rotated = 1;
                const double theta = (A[4 * q] - A[4 * p]) / (2 * a);
                const double t = copysign(1, theta) / (fabs(theta) + sqrt(theta * theta + 1));
                const double c = 1 / sqrt(t * t + 1), n = t * c;
                A[4 * p] -= t * a;
                A[4 * q] += t * a;
                A[3 * p + q] = A[3 * q + p] = 0;
                const int r = 3 - p - q;
                const double arp = A[3 * r + p], arq = A[3 * r + q];
                A[3 * r + p] = A[3 * p + r] = c * arp - n * arq;
                A[3 * r + q] = A[3 * q + r] = n * arp + c * arq;
                for (int k = 0; k < 3; k++) {
                    const double kp = Q[3 * k + p], kq = Q[3 * k + q];
                    Q[3 * k + p] = c * kp - n * kq;
                    Q[3 * k + q] = n * kp + c * kq;
                }
            }
        }
        if (!rotated) {
            break;
        }
    }
    for (int k = 0; k < 3; k++) {
        w[k] = A[4 * k];
    }
}

MPM_KERNEL void mpm_from_eigen(const double *w, const double *Q, double *s) {
    for (int k = 0; k < 6; k++) {
        const int i = mpm_sym_row(k), j = mpm_sym_column(k);
        s[k] = 0;
        for (int d = 0; d < 3; d++) {
            s[k] += w[d] * Q[3 * i + d] * Q[3 * j + d];
        }
    }
}

// 3D near the identity: ln(b)/2 = atanh(X) with X = (b - 1)(b + 1)^-1, as its series to X^9; the
// first term left out is below round-off of the first while |X| is below this.
#define MPM_SERIES_REACH 0.02

// atanh(r/m)/r for 0 <= r < m, with its limit 1/m; log_det = ln(m^2 - r^2) is better known than m -
// r where the eigenvalues lie far apart.
MPM_KERNEL double mpm_atanh_ratio(const double r, const double m, const double log_det) {
    const double q = r / m;
    return q < 1e-4 ? (1 + q * q / 3) / m : q < 0.5 ? atanh(q) / r : (log(m + r) - log_det / 2) / r;
}

MPM_KERNEL void mpm_half_log(const double *b, double *e, const int dim) {
    if (dim == 2) {
        // ln b = ln(det)/2 1 + atanh(r/m)/r (b - m 1), with eigenvalues m +- r
        const double m = 0.5 * (b[0] + b[1]), half = 0.5 * (b[0] - b[1]);
        const double r = sqrt(half * half + b[3] * b[3]);
        const double det = b[0] * b[1] - b[3] * b[3];
        const double log_det = log(det), mean = 0.25 * log_det;
        const double f = 0.5 * mpm_atanh_ratio(r, m, log_det);
        e[0] = mean + f * half;
        e[1] = mean - f * half;
        e[2] = 0.5 * log(b[2]);
        e[3] = f * b[3];
        return;
    }
    double B[6], size = 0;
    for (int k = 0; k < 6; k++) {
        B[k] = b[k] - (k < 3);
        size += fabs(B[k]);
    }
    if (size < 2 * MPM_SERIES_REACH) {
        // (b + 1)^-1 by cofactors
        const double a0 = b[0] + 1, a1 = b[1] + 1, a2 = b[2] + 1;
        const double c0 = a1 * a2 - b[4] * b[4], c3 = b[5] * b[4] - b[3] * a2;
        const double c5 = b[3] * b[4] - b[5] * a1;
        const double r = 1 / (a0 * c0 + b[3] * c3 + b[5] * c5);
        const double inverse[6] = {
            r * c0, r * (a0 * a2 - b[5] * b[5]),   r * (a0 * a1 - b[3] * b[3]),
            r * c3, r * (b[3] * b[5] - a0 * b[4]), r * c5};
        double X[6], X2[6], sum[6], next[6];
        mpm_commuting_product(B, inverse, X);
        mpm_commuting_product(X, X, X2);
        for (int k = 0; k < 6; k++) { // Horner in X^2: 1/9, 1/7, 1/5, 1/3, 1
            sum[k] = X2[k] / 9 + (k < 3 ? 1.0 / 7 : 0);
        }
        for (int n = 5; n >= 1; n -= 2) {
            mpm_commuting_product(X2, sum, next);
            for (int k = 0; k < 6; k++) {
                sum[k] = next[k] + (k < 3 ? 1.0 / n : 0);
            }
        }
        mpm_commuting_product(X, sum, e);
        return;
    }
    double w[3], Q[9];
    mpm_eigen_sym3(b, w, Q);
    for (int d = 0; d < 3; d++) {
        w[d] = 0.5 * log(w[d]);
    }
    mpm_from_eigen(w, Q, e);
}

MPM_KERNEL void mpm_exp_twice(const double *e, double *b, const int dim) {
    if (dim == 2) {
        const double m = e[0] + e[1], half = e[0] - e[1], shear = 2 * e[3]; // of 2 e
        const double r = sqrt(half * half + shear * shear), scale = exp(m);
        const double s = r < 1e-4 ? 1 + r * r / 6 : sinh(r) / r, c = cosh(r);
        b[2] = exp(2 * e[2]);
        b[3] = scale * s * shear;
        // The smaller diagonal entry from the determinant, scale^2: c - s |half| would cancel.
        const int large = half < 0;
        b[large] = scale * (c + s * fabs(half));
        b[!large] = (scale * scale + b[3] * b[3]) / b[large];
        return;
    }
    double w[3], Q[9];
    mpm_eigen_sym3(e, w, Q);
    for (int d = 0; d < 3; d++) {
        w[d] = exp(2 * w[d]);
    }
    mpm_from_eigen(w, Q, b);
}
