// Particle arrays of one body.
//
// Structure of arrays in blocks of MPM_BLOCK particles: component c of particle p of a field with n
// components is field[mpm_at(p, n, c)], so one component of a block is one cache line and the order
// of memory is the same on every instruction set. No pointers inside, so a block can go to another
// process or a GPU as it is. A field that the body does not need is NULL.
//
// The particles are kept in the order of the grid's cells and change places as they move
// (server/mpm/order.h): `id` says which is where. What belongs to a particle for good (the choice
// of a load, the anchor of friction, the place in a frame) goes by id.
#pragma once
#include <stddef.h>
#include <stdint.h>

#include "server/mpm/material.h"

#define MPM_BLOCK 8
#define MPM_BATCH 64 // particles that kernels in lanes work on at a time

struct mpm_particles {
    size_t n, capacity; // particles; rounded up to whole blocks
    uint32_t first_id;  // of the body's particles; their ids are consecutive
    int body, dim;
    const struct mpm_material *material;
    int law; // enum mpm_law of the material
    double parameters[MPM_MAX_PARAMETERS];
    double constants[MPM_MAX_CONSTANTS]; // what the law has prepared of them
    double density;                      // kg/m^3, reference; a particle's mass is density * V0
    double half, inv_4_half;             // uGIMP: half the particle size, in cells; 1 / (4 half)
    bool wants_fbar;                     // false: the material is excepted from F-bar

    uint32_t *id; // (n) less first_id; unaligned with the blocks: plain order
    uint32_t *at; // (n) the place of each id, where something asks for it, else NULL

    double *x;     // (n, dim) m
    double *v;     // (n, dim) m/s
    double *V0;    // (n) m^3, reference volume
    double *V;     // (n) m^3, current volume; V/V0 is the volume ratio that forces use
    double *sigma; // (n, MPM_SYM(dim)) Pa, Cauchy stress
    double *F;     // (n, dim, dim) deformation gradient that the stress uses (solids)
    double *b; // (n, MPM_SYM(dim)) elastic left Cauchy-Green tensor that the stress uses (plastic)
    double *plastic_strain; // (n) equivalent plastic strain (plastic)
    double *Jbar;           // (n) volume ratio that the stress uses (fluids; a solid's is det F)
    double *x0;             // (n, dim) m, reference position, where a displacement is asked for
    double *J_raw; // (n) the unaveraged volume ratio of a fluid, where something asks for it
    double *dx;    // (n, dim) m, displacement of this step, while F-bar is on
    double *dJ;    // (n) det of this step's relative deformation gradient, while F-bar is on
    const double
        *smooth; // Pa, by id of all particles, borrowed: what server/mpm/smooth.h found last
    void *memory, *fbar_memory; // owned: all of the above; dx and dJ
    size_t memory_bytes, fbar_bytes;
};

static inline size_t mpm_at(size_t p, int n_components, int c) {
    return (p / MPM_BLOCK * (size_t)n_components + (size_t)c) * MPM_BLOCK + p % MPM_BLOCK;
}

// The id of the particle at place p of the storage.
static inline size_t mpm_particle_id(const struct mpm_particles *s, size_t p) {
    return (size_t)s->first_id + s->id[p];
}

#if MPM_LANES == 1
// Volume ratio that the stress uses at particle p: det F; sqrt(det b), since plastic flow keeps the
// volume; or Jbar of a fluid.
static inline double mpm_ratio_in_use(const struct mpm_particles *s, size_t p) {
    if (s->Jbar) {
        return s->Jbar[p];
    }
    if (s->b) {
        double b[6] = {0};
        for (int k = 0; k < MPM_SYM(s->dim); k++) {
            b[k] = s->b[mpm_at(p, MPM_SYM(s->dim), k)];
        }
        return sqrt(mpm_det_sym(b, s->dim));
    }
    double F[9] = {0};
    for (int k = 0; k < s->dim * s->dim; k++) {
        F[k] = s->F[mpm_at(p, s->dim * s->dim, k)];
    }
    return mpm_det(F, s->dim);
}
#endif

// Mean normal stress of particle p, Pa.
double mpm_mean_stress(const struct mpm_particles *s, size_t p);
// The place of the particle with an id (less first_id): s->at must be there.
static inline size_t mpm_place_of(const struct mpm_particles *s, size_t id) {
    return s->at[id];
}
// Optional arrays of a body.
enum mpm_wanted { MPM_WANTS_X0 = 1, MPM_WANTS_J_RAW = 2, MPM_WANTS_PLACES = 4 };
// Takes one block of memory for `n` particles of the material and hands out the arrays: F = 1,
// ratios 1, ids in order, everything else 0. False when memory is short.
bool mpm_particles_create(struct mpm_particles *s, size_t n, unsigned wanted);
// The arrays that F-bar needs; keeps them once taken.
bool mpm_particles_add_fbar(struct mpm_particles *s);
void mpm_particles_free(struct mpm_particles *s);
// Bytes that mpm_particles_create would take, with F-bar or without.
size_t mpm_particles_bytes(const struct mpm_material *material, int dim, size_t n, unsigned wanted,
                           bool fbar);
// Calls `each` with every array of doubles that moves with the particles, and its components.
void mpm_particles_each(struct mpm_particles *s,
                        void (*each)(void *context, double *field, int components), void *context);
