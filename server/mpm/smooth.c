// The mean stress averaged over the grid with the basis functions and the volumes of the particles,
// body by body:
//
//     p_i = sum_p w_ip V_p p_p / sum_p w_ip V_p,    smooth p_p = sum_i w_ip p_i
//
// Forces never see it. Pressure oscillates from particle to particle where a mesh locks, and from
// node to node where F-bar has averaged it once (the anchored scheme); both have little in common
// with the pressure that a cell carries, and this takes them off (docs/method.md, section 5). Walls
// are not seen.
//
// The nodes are kept in a table of their own, by their coordinates: between steps a particle may
// have left the reach of the grid's blocks, which the next step's sort would mend, but what is only
// looked at must not change the order of the particles.
#include "server/mpm/smooth.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/sim.h"

#define FIRST_CAPACITY 1024

static size_t place_of(const struct mpm_smooth *m, const int32_t *at) {
    // Teschner et al. 2003; the product spreads what neighbours have in common.
    const uint32_t key =
        (uint32_t)at[0] * 73856093u ^ (uint32_t)at[1] * 19349663u ^ (uint32_t)at[2] * 83492791u;
    size_t k = (size_t)((key * UINT64_C(0x9E3779B97F4A7C15)) >> 20) & (m->capacity - 1);
    while (m->nodes[k].used && memcmp(m->nodes[k].at, at, sizeof m->nodes[k].at) != 0) {
        k = (k + 1) & (m->capacity - 1);
    }
    return k;
}

static bool grow(struct mpm_smooth *m) {
    struct mpm_smooth wider = {.capacity = m->capacity ? 2 * m->capacity : FIRST_CAPACITY};
    wider.nodes = calloc(wider.capacity, sizeof *wider.nodes);
    if (!wider.nodes) {
        return false;
    }
    for (size_t k = 0; k < m->capacity; k++) {
        if (m->nodes[k].used) {
            wider.nodes[place_of(&wider, m->nodes[k].at)] = m->nodes[k];
        }
    }
    free(m->nodes);
    m->nodes = wider.nodes;
    m->capacity = wider.capacity;
    return true;
}

// The nodes around one particle: their places in the table and their weights.
struct around {
    int32_t base[3];
    bool known;
    size_t place[MPM_MAX_STENCIL];
    double w[MPM_MAX_STENCIL];
};

// False when memory is short. Particles of one cell mostly follow each other, and share the places.
static bool look_around(const struct mpm_sim *sim, const struct mpm_particles *s, size_t p,
                        struct mpm_smooth *m, struct around *a) {
    const int dim = s->dim, support = mpm_support(sim->def->basis);
    double w[3][MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT];
    int32_t base[3] = {0};
    for (int d = 0; d < dim; d++) {
        const double xi = (s->x[mpm_at(p, dim, d)] - sim->grid.origin[d]) * sim->grid.inv_h;
        base[d] = (int32_t)mpm_weights(sim->def->basis, xi, s->half, s->inv_4_half, w[d], dw);
    }
    const bool same = a->known && memcmp(a->base, base, sizeof base) == 0;
    if (!same) {
        while (2 * (m->n + MPM_MAX_STENCIL) > m->capacity) {
            if (!grow(m)) {
                return false;
            }
        }
        memcpy(a->base, base, sizeof base);
        a->known = true;
    }
    int k = 0;
    for (int i = 0; i < support; i++) {
        for (int j = 0; j < support; j++) {
            for (int l = 0; l < (dim == 3 ? support : 1); l++, k++) {
                a->w[k] = w[0][i] * w[1][j] * (dim == 3 ? w[2][l] : 1);
                if (!same) {
                    const int32_t at[3] = {base[0] + i, base[1] + j, base[2] + l};
                    a->place[k] = place_of(m, at);
                    struct mpm_smooth_node *node = &m->nodes[a->place[k]];
                    if (!node->used) {
                        *node = (struct mpm_smooth_node){.at = {at[0], at[1], at[2]}, .used = 1};
                        m->n++;
                    }
                }
            }
        }
    }
    return true;
}

static bool average(const struct mpm_sim *sim, const struct mpm_particles *s,
                    struct mpm_smooth *m) {
    const int support = mpm_support(sim->def->basis);
    const int n_nodes = support * support * (s->dim == 3 ? support : 1);
    if (m->nodes) {
        memset(m->nodes, 0, m->capacity * sizeof *m->nodes);
    }
    m->n = 0;
    struct around a = {.known = false};
    for (size_t p = 0; p < s->n; p++) {
        if (!look_around(sim, s, p, m, &a)) {
            return false;
        }
        const double V = s->V[p], V_p = V * mpm_mean_stress(s, p);
        for (int k = 0; k < n_nodes; k++) {
            m->nodes[a.place[k]].V += a.w[k] * V;
            m->nodes[a.place[k]].V_p += a.w[k] * V_p;
        }
    }
    a.known = false; // the table may have grown since
    for (size_t p = 0; p < s->n; p++) {
        if (!look_around(sim, s, p, m, &a)) {
            return false;
        }
        double sum = 0;
        for (int k = 0; k < n_nodes; k++) {
            const struct mpm_smooth_node *node = &m->nodes[a.place[k]];
            sum += a.w[k] * (node->V_p / fmax(node->V, DBL_MIN)); // with weight 0 both may be 0
        }
        m->value[mpm_particle_id(s, p)] = sum;
    }
    return true;
}

void mpm_smooth_update(const struct mpm_sim *sim) {
    struct mpm_smooth *m = sim->smooth;
    if (m->step == sim->c.step + 1) {
        return;
    }
    m->step = sim->c.step + 1;
    if (!m->value && !(m->value = calloc(sim->n_particles, sizeof *m->value))) {
        return;
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        sim->sets[b].smooth = m->value;
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        if (!average(sim, &sim->sets[b], m)) {
            for (size_t p = 0; p < sim->n_particles; p++) {
                m->value[p] = NAN;
            }
            return;
        }
    }
}

void mpm_smooth_free(struct mpm_smooth *m) {
    if (m) {
        free(m->nodes);
        free(m->value);
        free(m);
    }
}

size_t mpm_smooth_bytes(const struct mpm_smooth *m) {
    return m->capacity * sizeof *m->nodes;
}

size_t mpm_smooth_estimate(size_t n_nodes, size_t n_particles) {
    size_t capacity = FIRST_CAPACITY, before = 0;
    while (2 * (n_nodes + MPM_MAX_STENCIL) > capacity) { // as look_around has it
        before = capacity;
        capacity *= 2;
    }
    return (capacity + before) * sizeof(struct mpm_smooth_node) + n_particles * sizeof(double);
}
