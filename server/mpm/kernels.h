// The tables of kernels: one for each dimension and instruction set, by basis.
#pragma once
#include "server/mpm/transfer.h"

extern const struct mpm_kernels mpm_kernels_plain[2 * MPM_N_BASES]; // both dimensions
// Without `force`, of which the plain one serves; only where MPM_HAS_LANES.
extern const struct mpm_kernels mpm_kernels_avx2_2d[MPM_N_BASES], mpm_kernels_avx2_3d[MPM_N_BASES];
extern const struct mpm_kernels mpm_kernels_avx512_2d[MPM_N_BASES],
    mpm_kernels_avx512_3d[MPM_N_BASES];
