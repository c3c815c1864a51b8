// The whole state as bytes, so that a restored simulation continues with the same bits. The grid is
// rebuilt by every step and is not part of it.
#include <stdio.h>
#include <string.h>

#include "server/mpm/sim.h"

#define STATE_MAGIC 0x31746174534d504dULL // "MPMStat1"

struct header {
    uint64_t magic, bytes, n_sets, n_walls, n_probes, n_stages, n_particles;
    int32_t dimension, basis;
};

static struct header header_of(const struct mpm_sim *sim, size_t bytes) {
    return (struct header){.magic = STATE_MAGIC,
                           .bytes = bytes,
                           .n_sets = sim->n_sets,
                           .n_walls = sim->n_walls,
                           .n_probes = sim->def->n_probes,
                           .n_stages = sim->def->n_stages,
                           .n_particles = sim->n_particles,
                           .dimension = sim->grid.dim,
                           .basis = (int32_t)sim->def->basis};
}

// One walk over all parts serves counting, saving and loading.
typedef void visit(void *context, void *part, size_t bytes);

static void walk(struct mpm_sim *sim, visit *each, void *context) {
    each(context, &sim->c, sizeof sim->c);
    for (size_t b = 0; b < sim->n_sets; b++) {
        each(context, sim->sets[b].memory, sim->sets[b].memory_bytes);
    }
    for (size_t k = 0; k < sim->n_walls; k++) {
        each(context, &sim->walls[k].active, sizeof sim->walls[k].active);
        each(context, sim->walls[k].reaction, sizeof sim->walls[k].reaction);
    }
    for (size_t k = 0; k < sim->n_loads; k++) {
        each(context, &sim->loads[k].active, sizeof sim->loads[k].active);
    }
    for (size_t k = 0; k < sim->n_rigids; k++) {
        each(context, &sim->rigids[k].active, sizeof sim->rigids[k].active);
        each(context, sim->rigids[k].offset, sizeof sim->rigids[k].offset);
        each(context, sim->rigids[k].reaction, sizeof sim->rigids[k].reaction);
        if (sim->rigids[k].anchor) {
            each(context, sim->rigids[k].anchor, sim->rigids[k].anchor_bytes);
        }
    }
    if (sim->averages) {
        each(context, sim->averages, sim->def->n_probes * sizeof *sim->averages);
    }
}

static void count(void *context, void *part, size_t bytes) {
    (void)part;
    *(size_t *)context += bytes;
}

static void save(void *context, void *part, size_t bytes) {
    char **out = context;
    memcpy(*out, part, bytes);
    *out += bytes;
}

static void load(void *context, void *part, size_t bytes) {
    const char **in = context;
    memcpy(part, *in, bytes);
    *in += bytes;
}

size_t mpm_state_bytes(const struct mpm_sim *sim) {
    size_t bytes = sizeof(struct header);
    walk((struct mpm_sim *)sim, count, &bytes);
    return bytes;
}

void mpm_state_save(const struct mpm_sim *sim, void *out) {
    const struct header header = header_of(sim, mpm_state_bytes(sim));
    memcpy(out, &header, sizeof header);
    char *rest = (char *)out + sizeof header;
    walk((struct mpm_sim *)sim, save, &rest);
}

enum mpm_status mpm_state_load(struct mpm_sim *sim, const void *in, size_t bytes,
                               struct mpm_error *err) {
    const struct header mine = header_of(sim, mpm_state_bytes(sim));
    struct header theirs = {0};
    if (bytes >= sizeof theirs) {
        memcpy(&theirs, in, sizeof theirs);
    }
    if (bytes != mine.bytes || memcmp(&mine, &theirs, sizeof mine) != 0) {
        return mpm_fail(err, MPM_ERR_STATE, "",
                        "the saved state (%zu bytes, %llu particles) does not fit this scene (%llu "
                        "bytes, %llu particles)",
                        bytes, (unsigned long long)theirs.n_particles,
                        (unsigned long long)mine.bytes, (unsigned long long)mine.n_particles);
    }
    const char *rest = (const char *)in + sizeof mine;
    walk(sim, load, &rest);
    mpm_restore_stage(sim);
    if (!mpm_provide_fbar(sim, sim->c.now.fbar.scheme)) {
        return mpm_fail(err, MPM_ERR_MEMORY, "/fbar", "no memory for what F-bar needs");
    }
    return MPM_OK;
}
