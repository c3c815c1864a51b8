// Small dense algebra on row-major dim x dim matrices, and symmetric tensors in plane-strain
// storage.
//
// Symmetric tensors (stress) are kept as 4 components in 2D (xx, yy, zz, xy) and 6 in 3D
// (xx, yy, zz, xy, yz, zx). Tensors are passed by pointer: GCC 12.2 with AVX-512 miscompiles small
// structs of doubles passed by value (docs/method.md). Components are lanes (simd.h): double in
// plain units.
#pragma once
#include "server/mpm/simd.h"

#define MPM_SYM(dim) ((dim) == 2 ? 4 : 6) // stored components of a symmetric tensor

MPM_KERNEL mpm_vec mpm_det(const mpm_vec *F, const int dim) {
    if (dim == 2) {
        return F[0] * F[3] - F[1] * F[2];
    }
    return F[0] * (F[4] * F[8] - F[5] * F[7]) - F[1] * (F[3] * F[8] - F[5] * F[6]) +
           F[2] * (F[3] * F[7] - F[4] * F[6]);
}

// det(1 + D) - 1 without the cancellation of forming 1 + D first.
MPM_KERNEL mpm_vec mpm_det_minus_one(const mpm_vec *D, const int dim) {
    if (dim == 2) {
        return D[0] + D[3] + (D[0] * D[3] - D[1] * D[2]);
    }
    const mpm_vec trace = D[0] + D[4] + D[8];
    const mpm_vec minors =
        D[0] * D[4] - D[1] * D[3] + D[0] * D[8] - D[2] * D[6] + D[4] * D[8] - D[5] * D[7];
    return trace + (minors + mpm_det(D, 3));
}

// Determinant of a symmetric tensor in its storage; in 2D the out-of-plane component is a factor.
MPM_KERNEL mpm_vec mpm_det_sym(const mpm_vec *s, const int dim) {
    if (dim == 2) {
        return (s[0] * s[1] - s[3] * s[3]) * s[2];
    }
    return s[0] * (s[1] * s[2] - s[4] * s[4]) - s[3] * (s[3] * s[2] - s[4] * s[5]) +
           s[5] * (s[3] * s[4] - s[1] * s[5]);
}

// Row and column of stored component k of a symmetric tensor.
MPM_KERNEL int mpm_sym_row(const int k) {
    return k < 3 ? k : k == 3 ? 0 : k == 4 ? 1 : 2;
}
MPM_KERNEL int mpm_sym_column(const int k) {
    return k < 3 ? k : k == 3 ? 1 : k == 4 ? 2 : 0;
}
// Stored position of entry (i, j), i and j < dim.
MPM_KERNEL int mpm_sym_index(const int i, const int j) {
    return i == j ? i : i + j == 1 ? 3 : i + j == 3 ? 4 : 5;
}
