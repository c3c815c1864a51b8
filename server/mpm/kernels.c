// Which kernels a simulation uses: by the instruction sets that the machine has.
#include "server/mpm/kernels.h"

bool mpm_isa_available(enum mpm_isa isa) {
    switch (isa) {
    case MPM_ISA_AUTO:
    case MPM_ISA_BASELINE:
        return true;
#ifdef MPM_HAS_LANES
    case MPM_ISA_AVX2:
        return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
               __builtin_cpu_supports("bmi2");
    case MPM_ISA_AVX512:
        return mpm_isa_available(MPM_ISA_AVX2) && __builtin_cpu_supports("avx512f") &&
               __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
               __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd");
#endif
    default:
        return false;
    }
}

enum mpm_isa mpm_isa_in_use(enum mpm_isa isa) {
    if (isa != MPM_ISA_AUTO && mpm_isa_available(isa)) {
        return isa;
    }
    return mpm_isa_available(MPM_ISA_AVX512) ? MPM_ISA_AVX512
           : mpm_isa_available(MPM_ISA_AVX2) ? MPM_ISA_AVX2
                                             : MPM_ISA_BASELINE;
}

const struct mpm_kernels *mpm_kernels(int dim, enum mpm_basis basis, enum mpm_isa isa) {
#ifdef MPM_HAS_LANES
    if (isa == MPM_ISA_AVX2) {
        return dim == 2 ? &mpm_kernels_avx2_2d[basis] : &mpm_kernels_avx2_3d[basis];
    }
    if (isa == MPM_ISA_AVX512) {
        return dim == 2 ? &mpm_kernels_avx512_2d[basis] : &mpm_kernels_avx512_3d[basis];
    }
#endif
    (void)isa;
    return &mpm_kernels_plain[(dim - 2) * MPM_N_BASES + (int)basis];
}
