// Inside of a constitutive model: one file in material/ with its law and its descriptor, and its
// place in laws.h. docs/design.md says how to add one.
#pragma once
#include <float.h>

#include "server/mpm/mpm.h"
#include "server/mpm/tensor.h"

#define MPM_MAX_CONSTANTS 8 // doubles that a law may prepare from its parameters

struct mpm_particles;

// What a model keeps of the deformation.
enum mpm_kinematics {
    MPM_KEEPS_F, // the deformation gradient
    MPM_KEEPS_J, // the volume ratio only (fluids)
    MPM_KEEPS_B, // the elastic left Cauchy-Green tensor (plasticity)
};

struct mpm_material {
    const char *name, *doc;
    enum mpm_kinematics kinematics;
    const struct mpm_parameter *parameters; // ends with a NULL key; the first is the density
    bool plastic;                           // has an equivalent plastic strain
    // Index of a parameter that does not go with the others, with the reason; -1 = none. NULL =
    // none.
    int (*conflict)(const double *parameters, const char **why);
    // P-wave speed, m/s, at rest.
    double (*wave_speed)(const double *parameters);
    // Largest kinematic viscosity, m^2/s, that limits dt; NULL = none.
    double (*diffusivity)(const double *parameters);
    // What the law needs of the parameters, at most MPM_MAX_CONSTANTS doubles; once for many
    // particles.
    void (*prepare)(const double *parameters, void *constants);
    // Cauchy stress of particles [begin, end) from their deformation, in 2D and 3D. A model with a
    // rate part adds to what `rate_stress` left.
    void (*stress[2])(struct mpm_particles *s, size_t begin, size_t end);
    // The part that depends on the velocity gradient L ((end - begin), 9; row-major dim x dim in
    // the first entries), written over sigma; NULL = none.
    void (*rate_stress[2])(struct mpm_particles *s, size_t begin, size_t end, double (*L)[9]);
    // Strain energy per reference volume, J/m^3, of particle p.
    double (*energy)(const struct mpm_particles *s, size_t p);
};

// Parameters that several models have. The density is every model's first.
// clang-format off
#define MPM_DENSITY_PARAMETER                                                                      \
    {.key = "density", .unit = "kg/m^3", .doc = "reference density",                               \
     .min = 0, .min_open = true, .max = DBL_MAX, .required = true}
#define MPM_YOUNGS_MODULUS_PARAMETER                                                               \
    {.key = "youngs_modulus", .unit = "Pa", .doc = "Young's modulus at rest",                      \
     .min = 0, .min_open = true, .max = DBL_MAX, .required = true}
#define MPM_POISSON_RATIO_PARAMETER                                                                \
    {.key = "poisson_ratio", .unit = "1", .doc = "Poisson's ratio at rest",                        \
     .min = -1, .min_open = true, .max = 0.5, .max_open = true, .required = true}
// clang-format on
