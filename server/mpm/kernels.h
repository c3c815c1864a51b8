// The tables of kernels: one for each instruction set, by (dimension - 2) * MPM_N_BASES + basis.
#pragma once
#include "server/mpm/transfer.h"

extern const struct mpm_kernels mpm_kernels_plain[2 * MPM_N_BASES];
// Without `force`, of which the plain one serves; only where MPM_HAS_LANES.
extern const struct mpm_kernels mpm_kernels_avx2[2 * MPM_N_BASES];
extern const struct mpm_kernels mpm_kernels_avx512[2 * MPM_N_BASES];
