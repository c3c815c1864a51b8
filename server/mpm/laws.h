// The list of all constitutive models, with their laws in lanes of this unit (simd.h).
//
// A law is written once, in its model's file, for MPM_LANES particles at once, and turns what the
// model keeps of the deformation into the Cauchy stress in Pa, MPM_SYM(dim) components:
//
//   KEEPS_F  name_stress(constants, F, sigma, dim)       F: dim x dim
//   KEEPS_B  name_stress(constants, n, b, a, sigma, dim) n vectors, at most MPM_VECTORS, each with
//            its b[v], MPM_SYM(dim) components, and equivalent plastic strain a[v], both changed
//            where it flows; a return map is a long chain of dependent operations, so it goes in
//            short loops over the vectors, of which the processor has several in work at a time
//   KEEPS_J  name_stress(constants, J, sigma, dim)       adds to sigma what depends on J
//            name_rate(constants, L, sigma, dim)         writes what depends on L, dim x dim
//
// `constants` is a const void * to what the descriptor's `prepare` made of the parameters. Lanes
// without a particle hold the identity (F, b, J), so that they raise nothing and cost nothing.
#pragma once
#include "server/mpm/material.h"

// X(name, what it keeps), in the order in which models are listed to users.
#define MPM_LAWS(X)                                                                                \
    X(neo_hookean, KEEPS_F)                                                                        \
    X(newtonian, KEEPS_J)                                                                          \
    X(hencky_j2, KEEPS_B)

#define MPM_LAW_ONLY // without the descriptor, which the file's own unit has
#include "server/mpm/material/hencky_j2.c"
#include "server/mpm/material/neo_hookean.c"
#include "server/mpm/material/newtonian.c"
#undef MPM_LAW_ONLY

enum mpm_law {
#define X(name, keeps) MPM_LAW_##name,
    MPM_LAWS(X)
#undef X
        MPM_N_LAWS
};
// The law of a descriptor.
enum mpm_law mpm_material_law(const struct mpm_material *model);
