// Memory of the particle arrays: one block a body, carved into the fields that its material needs.
#include "server/mpm/particles.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/memory.h"

#define ALIGNMENT 64 // one cache line, one AVX-512 register

#define N_ARRAYS 11

struct array {
    double **field;
    int components; // 0: the body does without it
};

static void list(struct mpm_particles *s, unsigned wanted, struct array *arrays) {
    const int dim = s->dim;
    const enum mpm_kinematics kept = s->material->kinematics;
    const bool fluid = kept == MPM_KEEPS_J;
    const struct array all[N_ARRAYS] = {
        {&s->x, dim},
        {&s->v, dim},
        {&s->V0, 1},
        {&s->V, 1},
        {&s->sigma, MPM_SYM(dim)},
        {&s->F, kept == MPM_KEEPS_F ? dim * dim : 0},
        {&s->b, kept == MPM_KEEPS_B ? MPM_SYM(dim) : 0},
        {&s->plastic_strain, s->material->plastic ? 1 : 0},
        {&s->Jbar, fluid ? 1 : 0},
        {&s->x0, wanted & MPM_WANTS_X0 ? dim : 0},
        {&s->J_raw, fluid && wanted & MPM_WANTS_J_RAW ? 1 : 0},
    };
    memcpy(arrays, all, sizeof all);
}

// Processors fetch what lies ahead, past the end of an array too: of the next array the first
// particles, which another thread may have just changed and then has to fetch back. So there is
// room for that between the arrays of bodies that threads share.
// Not whole pages either, of which all would begin in one set of the cache.
#define AHEAD 65    // cache lines: the next page, too
#define SHARED 1024 // particles or more; does not depend on the threads, as a saved state does not

static size_t array_bytes(size_t capacity, int components) {
    return components > 0 ? capacity * (size_t)components * sizeof(double) +
                                (capacity >= SHARED ? AHEAD * 64 : 0)
                          : 0;
}

// One walk over all fields serves counting (base NULL) and carving.
static size_t carve(struct mpm_particles *s, char *base, unsigned wanted) {
    struct array fields[N_ARRAYS];
    list(s, wanted, fields);
    size_t bytes = 0;
    for (size_t k = 0; k < N_ARRAYS; k++) {
        if (base) {
            *fields[k].field = fields[k].components ? (double *)(base + bytes) : NULL;
        }
        bytes += array_bytes(s->capacity, fields[k].components);
    }
    uint32_t **const numbers[] = {&s->id, wanted & MPM_WANTS_PLACES ? &s->at : NULL};
    for (size_t k = 0; k < sizeof numbers / sizeof *numbers; k++) {
        if (base && numbers[k]) {
            *numbers[k] = (uint32_t *)(base + bytes);
        }
        bytes += numbers[k] ? s->capacity * sizeof(uint32_t) : 0;
    }
    return (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
}

void mpm_particles_each(struct mpm_particles *s,
                        void (*each)(void *context, double *field, int components), void *context) {
    struct array fields[N_ARRAYS];
    list(s, MPM_WANTS_X0 | MPM_WANTS_J_RAW, fields);
    for (size_t k = 0; k < N_ARRAYS; k++) {
        if (*fields[k].field) {
            each(context, *fields[k].field, fields[k].components);
        }
    }
}

static size_t whole_blocks(size_t n) {
    return (n + MPM_BLOCK - 1) / MPM_BLOCK * MPM_BLOCK;
}

static size_t fbar_bytes(int dim, size_t capacity) {
    return array_bytes(capacity, dim) + array_bytes(capacity, 1);
}

bool mpm_particles_create(struct mpm_particles *s, size_t n, unsigned wanted) {
    s->n = n;
    s->capacity = whole_blocks(n);
    s->memory_bytes = carve(s, NULL, wanted);
    s->memory = mpm_memory(s->memory_bytes);
    if (!s->memory) {
        return false;
    }
    carve(s, s->memory, wanted);
    for (size_t p = 0; p < n; p++) {
        s->id[p] = (uint32_t)p;
        if (s->at) {
            s->at[p] = (uint32_t)p;
        }
        if (s->F) {
            for (int d = 0; d < s->dim; d++) {
                s->F[mpm_at(p, s->dim * s->dim, d * s->dim + d)] = 1;
            }
        }
        for (int k = 0; s->b && k < 3; k++) {
            s->b[mpm_at(p, MPM_SYM(s->dim), k)] = 1;
        }
        if (s->Jbar) {
            s->Jbar[p] = 1;
        }
        if (s->J_raw) {
            s->J_raw[p] = 1;
        }
    }
    return true;
}

bool mpm_particles_add_fbar(struct mpm_particles *s) {
    if (s->fbar_memory) {
        return true;
    }
    const size_t bytes = fbar_bytes(s->dim, s->capacity);
    s->fbar_memory = mpm_memory(bytes);
    if (!s->fbar_memory) {
        return false;
    }
    s->fbar_bytes = bytes;
    s->dx = s->fbar_memory;
    s->dJ = s->dx + array_bytes(s->capacity, s->dim) / sizeof(double);
    return true;
}

void mpm_particles_free(struct mpm_particles *s) {
    free(s->memory);
    free(s->fbar_memory);
    *s = (struct mpm_particles){0};
}

size_t mpm_particles_bytes(const struct mpm_material *material, int dim, size_t n, unsigned wanted,
                           bool fbar) {
    struct mpm_particles s = {.material = material, .dim = dim, .capacity = whole_blocks(n)};
    return carve(&s, NULL, wanted) + (fbar ? fbar_bytes(dim, s.capacity) : 0);
}
