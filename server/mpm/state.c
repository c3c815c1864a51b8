// The whole state as bytes, so that a restored simulation continues with the same bits. The grid is
// rebuilt by every step and is not part of it.
#include <stdio.h>
#include <string.h>

#include "server/mpm/sim.h"

#define STATE_MAGIC 0x34746174534d504dULL // "MPMStat4"

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

// One walk over all parts serves counting, saving and loading. `each` is false when there is no
// more to load.
typedef bool visit(void *context, void *part, size_t bytes);

static bool walk_tiles(struct mpm_order *order, size_t n, visit *each, void *context) {
    // Loading, the number comes first and makes room for the rest.
    return each(context, &order->n_tiles, sizeof order->n_tiles) && order->n_tiles <= n &&
           mpm_order_reserve(order, order->n_tiles) &&
           each(context, order->tile, order->n_tiles * sizeof *order->tile);
}

static bool walk(struct mpm_sim *sim, visit *each, void *context) {
    bool ok = each(context, &sim->c, sizeof sim->c);
    for (size_t b = 0; b < sim->n_sets; b++) {
        struct mpm_particles *s = &sim->sets[b];
        ok = ok && each(context, s->memory, s->memory_bytes) &&
             walk_tiles(&sim->orders[b], s->n, each, context);
    }
    for (size_t k = 0; k < sim->n_walls; k++) {
        struct mpm_wall *w = &sim->walls[k];
        ok = ok && each(context, &w->active, sizeof w->active) &&
             each(context, w->reaction, sizeof w->reaction);
    }
    for (size_t k = 0; k < sim->n_loads; k++) {
        ok = ok && each(context, &sim->loads[k].active, sizeof sim->loads[k].active);
    }
    for (size_t k = 0; k < sim->n_rigids; k++) {
        struct mpm_rigid *r = &sim->rigids[k];
        ok = ok && each(context, &r->active, sizeof r->active) &&
             each(context, r->offset, sizeof r->offset) &&
             each(context, r->reaction, sizeof r->reaction) &&
             (!r->anchor || each(context, r->anchor, r->anchor_bytes));
    }
    return ok && (!sim->averages ||
                  each(context, sim->averages, sim->def->n_probes * sizeof *sim->averages));
}

static bool count(void *context, void *part, size_t bytes) {
    (void)part;
    *(size_t *)context += bytes;
    return true;
}

static bool save(void *context, void *part, size_t bytes) {
    char **out = context;
    memcpy(*out, part, bytes);
    *out += bytes;
    return true;
}

struct reading {
    const char *at, *end;
};

static bool load(void *context, void *part, size_t bytes) {
    struct reading *in = context;
    if ((size_t)(in->end - in->at) < bytes) {
        return false;
    }
    memcpy(part, in->at, bytes);
    in->at += bytes;
    return true;
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
    const struct header mine = header_of(sim, bytes); // the bytes follow from the rest
    struct header theirs = {0};
    if (bytes >= sizeof theirs) {
        memcpy(&theirs, in, sizeof theirs);
    }
    if (bytes >= sizeof theirs && theirs.magic != mine.magic) {
        return mpm_fail(err, MPM_ERR_STATE, "",
                        "the saved state is of another build of the program, or of none: it begins "
                        "with %016llx, expected %016llx",
                        (unsigned long long)theirs.magic, (unsigned long long)mine.magic);
    }
    struct reading rest = {.at = (const char *)in + sizeof mine, .end = (const char *)in + bytes};
    if (bytes < sizeof theirs || memcmp(&mine, &theirs, sizeof mine) != 0 ||
        !walk(sim, load, &rest) || rest.at != rest.end || !mpm_restore_order(sim)) {
        return mpm_fail(err, MPM_ERR_STATE, "",
                        "the saved state (%zu bytes, %llu particles) does not fit this scene (%llu "
                        "particles)",
                        bytes, (unsigned long long)theirs.n_particles,
                        (unsigned long long)mine.n_particles);
    }
    sim->smooth->step = 0;
    mpm_restore_stage(sim);
    if (!mpm_provide_fbar(sim, sim->c.now.fbar.scheme)) {
        return mpm_fail(err, MPM_ERR_MEMORY, "/fbar", "no memory for what F-bar needs");
    }
    return MPM_OK;
}
