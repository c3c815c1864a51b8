// One explicit time step, update stress last: Zhao, Jiang, Choo, section 2.2 and Algorithm 1.
// The stages below are those of docs/method.md, in its order; equation numbers are the paper's.
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "server/mpm/sim.h"

#define UNSTABLE_CFL                                                                               \
    1.0 // no basis is stable at dt >= 0.9 h/c (docs/method.md): beyond this it is not tried

// Work on nodes. Each thread has the blocks around its part of the tiles, so that most of what it
// adds to the grid, moves and gathers stays with it: to fetch what another core has just changed
// takes longer than all else that is done with a node.
struct nodes_work {
    struct mpm_sim *sim;
    struct mpm_motion motion;
    bool fbar;
};

static void share_nodes(struct mpm_sim *sim) {
    const int n = sim->team->n_there;
    size_t most = 0;
    for (size_t b = 1; b < sim->n_sets; b++) {
        most = sim->sets[b].n > sim->sets[most].n ? b : most;
    }
    const struct mpm_order *order = &sim->orders[most];
    uint32_t slot = 0;
    for (int k = 0; k < n; k++) {
        sim->turns[k].first_slot = slot;
        const size_t t = k + 1 < n ? mpm_order_part(order, k + 1, n) : order->n_tiles;
        const uint32_t cut =
            t < order->n_tiles ? sim->grid.slot[order->tile[t].block] : sim->grid.n_slots;
        slot = cut > slot ? cut : slot;
        sim->turns[k].last_slot = slot;
    }
}

// Slot 0, where no block is, is only cleared.
static void clear_nodes(void *context, int own, int there) {
    const struct nodes_work *w = context;
    const struct mpm_grid *grid = &w->sim->grid;
    const struct mpm_turn *part = &w->sim->turns[own];
    const size_t nodes = (size_t)MPM_BLOCK_NODES(grid->dim), scalars = (size_t)grid->fbar_stride;
    const size_t first = part->first_slot * nodes, n = part->last_slot * nodes - first;
    (void)there;
    memset(grid->node + first * MPM_NODE, 0, n * MPM_NODE * sizeof(double));
    if (w->fbar) {
        memset(grid->fbar + first * scalars, 0, n * scalars * sizeof(double));
    }
}

static void move_nodes(void *context, int own, int there) {
    const struct nodes_work *w = context;
    const struct mpm_turn *part = &w->sim->turns[own];
    const uint32_t first = part->first_slot > 0 ? part->first_slot : 1;
    (void)there;
    if (first < part->last_slot) {
        w->sim->kernels->move_nodes(&w->sim->grid, first, part->last_slot, &w->motion);
    }
}

static void divide_nodes(void *context, int own, int there) {
    struct mpm_sim *sim = context;
    const struct mpm_turn *part = &sim->turns[own];
    (void)there;
    mpm_fbar_divide(&sim->grid, part->first_slot > 0 ? part->first_slot : 1, part->last_slot);
}

static void join(struct mpm_span_result *joined, const struct mpm_span_result *r,
                 const struct mpm_particles *s) {
    for (int d = 0; d < s->dim; d++) {
        joined->min[d] = r->min[d] < joined->min[d] ? r->min[d] : joined->min[d];
        joined->max[d] = r->max[d] > joined->max[d] ? r->max[d] : joined->max[d];
        joined->mass_dx[d] += r->mass_dx[d];
    }
    joined->v2_max = r->v2_max > joined->v2_max ? r->v2_max : joined->v2_max;
    joined->dx_max = r->dx_max > joined->dx_max ? r->dx_max : joined->dx_max;
    joined->n_runs += r->n_runs;
    if (joined->bad == SIZE_MAX && r->bad != SIZE_MAX) {
        joined->bad = s->first_id + s->id[r->bad];
        joined->status = r->status;
        joined->value = r->value;
    }
}

typedef void span_work(const struct mpm_sim *sim, const struct mpm_span *span,
                       struct mpm_span_result *result);

static void work_on(const struct mpm_sim *sim, struct mpm_span span, size_t begin, size_t end,
                    size_t next, span_work *work, struct mpm_span_result *result) {
    span.begin = begin;
    span.end = end;
    span.next = next;
    work(sim, &span, result);
}

struct particles_work {
    const struct mpm_sim *sim;
    struct mpm_order *order;
    struct mpm_span span;
    span_work *work;
    int n_parts; // one a thread
};

// The next of a part, if there is one. Of another's part only while more than one is left: what
// lies in another core's cache takes longer to fetch than to work on.
static bool take(struct mpm_turn *turn, bool own, size_t *next) {
    if (!own && atomic_load_explicit(&turn->next, memory_order_relaxed) + 1 >= turn->end) {
        return false;
    }
    *next = atomic_fetch_add(&turn->next, 1);
    return *next < turn->end;
}

// Work that adds to the grid goes tile by tile. A tile waits for those near it with lower colours,
// so that every node's sum has one order whatever the number of threads (order.h). Each thread does
// its own part of the tiles first, then what others have not begun. Nobody waits for a tile that
// nobody will do: those that other parts wait for come first and by colour (order.c), so that of
// all that are being done there, the one with the lowest colour waits for none that is, and a
// part's next is always done or taken by the one whose part it is.
static void work_on_tiles(void *context, int own, int there) {
    const struct particles_work *w = context;
    const struct mpm_order *order = w->order;
    struct mpm_team *team = w->sim->team;
    for (int k = 0; k < w->n_parts; k++) {
        struct mpm_turn *turn = &w->sim->turns[(own + k) % w->n_parts];
        for (size_t i; take(turn, k == 0, &i);) {
            const uint32_t t = order->share[i], next = order->share[i + 1 < turn->end ? i + 1 : i];
            for (uint32_t q = order->before_begin[t]; there > 1 && q < order->before_begin[t + 1];
                 q++) {
                atomic_uint *done = &order->done[order->before[q]];
                for (unsigned pass; (pass = atomic_load(done)) != order->pass;) {
                    mpm_team_await(team, done, pass);
                }
            }
            work_on(w->sim, w->span, order->tile[t].begin, order->tile[t].end,
                    order->tile[next].begin, w->work, &w->sim->results[t]);
            if (there > 1) {
                atomic_store(&order->done[t], order->pass);
                mpm_team_tell(team, &order->done[t]);
            }
        }
    }
}

static void for_tiles(struct particles_work *w) {
    const int n_parts = w->n_parts;
    if (w->order->n_parts != n_parts) {
        mpm_order_share(w->order, n_parts);
    }
    w->order->pass++;
    for (int k = 0; k < n_parts; k++) {
        atomic_store(&w->sim->turns[k].next, mpm_order_part(w->order, k, n_parts));
        w->sim->turns[k].end = mpm_order_part(w->order, k + 1, n_parts);
    }
    mpm_team_run(w->sim->team, work_on_tiles, w);
}

// All other work goes in chunks of equal size, in the same parts to a chunk, so that particles stay
// with their core. They do not take equal time, since what flows costs more.
static void work_on_chunks(void *context, int own, int there) {
    const struct particles_work *w = context;
    const size_t n = w->span.s->n;
    (void)there;
    for (int k = 0; k < w->n_parts; k++) {
        struct mpm_turn *turn = &w->sim->turns[(own + k) % w->n_parts];
        for (size_t i; take(turn, k == 0, &i);) {
            const size_t begin = i * MPM_CHUNK, end = begin + MPM_CHUNK;
            work_on(w->sim, w->span, begin, end < n ? end : n, end < n ? end : begin, w->work,
                    &w->sim->results[i]);
        }
    }
}

static size_t for_chunks(struct particles_work *w) {
    const size_t n_chunks = (w->span.s->n + MPM_CHUNK - 1) / MPM_CHUNK;
    size_t begin = 0;
    for (int k = 0; k < w->n_parts; k++) {
        const size_t tile = mpm_order_part(w->order, k + 1, w->n_parts);
        const size_t end = tile < w->order->n_tiles
                               ? (w->order->tile[tile].begin + MPM_CHUNK / 2) / MPM_CHUNK
                               : n_chunks;
        atomic_store(&w->sim->turns[k].next, begin);
        begin = w->sim->turns[k].end = end;
    }
    mpm_team_run(w->sim->team, work_on_chunks, w);
    return n_chunks;
}

// What was found is joined in the order of the tiles or chunks.
static void for_particles(const struct mpm_sim *sim, size_t body, struct mpm_span span, bool adds,
                          span_work *work, struct mpm_span_result *joined) {
    span.s = &sim->sets[body];
    span.grid = (struct mpm_grid *)&sim->grid;
    struct particles_work w = {sim, &sim->orders[body], span, work, sim->team->n_there};
    size_t n = sim->orders[body].n_tiles;
    if (adds) {
        for_tiles(&w);
    } else {
        n = for_chunks(&w);
    }
    for (size_t k = 0; k < n; k++) {
        join(joined, &sim->results[k], span.s);
    }
}

static void p2g(const struct mpm_sim *sim, const struct mpm_span *span, struct mpm_span_result *r) {
    sim->kernels->p2g(span, r);
}

static void g2p(const struct mpm_sim *sim, const struct mpm_span *span, struct mpm_span_result *r) {
    sim->kernels->g2p(span, r);
}

static void fbar(const struct mpm_sim *sim, const struct mpm_span *span,
                 struct mpm_span_result *r) {
    sim->kernels->fbar(span, r);
}

static enum mpm_status step_failure(const struct mpm_sim *sim, enum mpm_status status, double time,
                                    int64_t particle, const char *quantity, double value,
                                    struct mpm_error *err) {
    const char *advice = status == MPM_ERR_VOLUME
                             ? "use a smaller time.dt or time.cfl, a finer cell, or F-bar if the "
                               "material is nearly incompressible"
                         : status == MPM_ERR_LEFT_DOMAIN
                             ? "give the domain more room, or close that side with a wall"
                         : status == MPM_ERR_UNSTABLE_DT
                             ? "use a smaller time.dt, or time.cfl instead of it"
                             : "use a smaller time.dt or time.cfl; look at the last good frame for "
                               "where it began";
    char which[40] = "";
    if (particle >= 0) {
        snprintf(which, sizeof which, ", particle %lld", (long long)particle);
    }
    mpm_fail(err, status, "", "step %llu, t = %.9g s: %s%s: %s is %.6g",
             (unsigned long long)sim->c.step + 1, time, mpm_status_meaning(status), which, quantity,
             value);
    if (err) {
        err->step = sim->c.step + 1;
        err->time = time;
        err->particle = particle;
        err->quantity = quantity;
        err->value = value;
        err->advice = advice;
    }
    return status;
}

// The first particle outside the domain, by id: the joined bounds say that there is one.
static enum mpm_status left_domain(const struct mpm_sim *sim, double time, struct mpm_error *err) {
    static const char *const names[] = {"position.x", "position.y", "position.z"};
    int64_t first = INT64_MAX;
    int axis = 0;
    double value = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            for (int d = 0; d < s->dim; d++) {
                const double x = s->x[mpm_at(p, s->dim, d)];
                const int64_t id = s->first_id + s->id[p];
                if (!(x >= sim->exit_min[d] && x <= sim->exit_max[d]) && id < first) {
                    first = id;
                    axis = d;
                    value = x;
                }
            }
        }
    }
    return first == INT64_MAX
               ? MPM_OK
               : step_failure(sim, MPM_ERR_LEFT_DOMAIN, time, first, names[axis], value, err);
}

static enum mpm_status check_result(const struct mpm_sim *sim, const struct mpm_span_result *r,
                                    double time, struct mpm_error *err) {
    if (r->bad != SIZE_MAX) {
        return step_failure(sim, r->status, time, (int64_t)r->bad,
                            r->status == MPM_ERR_VOLUME ? "volume_ratio" : "velocity", r->value,
                            err);
    }
    for (int d = 0; d < sim->grid.dim; d++) {
        if (!(r->min[d] >= sim->exit_min[d] && r->max[d] <= sim->exit_max[d])) {
            return left_domain(sim, time, err);
        }
    }
    return MPM_OK;
}

static double now_or_zero(const struct mpm_sim *sim) {
    return sim->def->clock ? sim->def->clock() : 0;
}

// Adds the time since *since to a phase.
static void charge(struct mpm_sim *sim, enum mpm_phase phase, double *since) {
    const double now = now_or_zero(sim);
    sim->phase_seconds[phase] += now - *since;
    *since = now;
}

static void advance_clock(struct mpm_sim *sim, double dt) {
    struct mpm_clockwork *c = &sim->c;
    c->step++;
    c->steps_since_anchor++;
    if (c->now.dt > 0 && dt == c->now.dt) {
        c->time = c->anchor_time + (double)c->steps_since_anchor * dt;
    } else {
        c->time += dt;
        c->anchor_time = c->time;
        c->steps_since_anchor = 0;
    }
    // The last increment was fitted to the end; do not let round-off leave a sliver.
    if (c->stage_end - c->time < 1e-6 * dt) {
        c->time = c->stage_end;
    }
}

static void move_rigid_bodies(struct mpm_sim *sim, double dt, struct mpm_span_result *found) {
    for (size_t k = 0; k < sim->n_rigids; k++) {
        struct mpm_rigid *rigid = &sim->rigids[k];
        if (!rigid->active) {
            continue;
        }
        for (int d = 0; d < sim->grid.dim; d++) {
            rigid->offset[d] += dt * rigid->def.velocity[d];
        }
        struct mpm_span_result pushed = *found;
        pushed.dx_max = 0;
        for (size_t b = 0; b < sim->n_sets; b++) {
            mpm_contact_keep_out(rigid, &sim->sets[b], &sim->orders[b], &sim->grid, dt, &pushed);
        }
        pushed.dx_max += found->dx_max;
        *found = pushed;
        for (int d = 0; d < sim->grid.dim; d++) {
            sim->c.external_work -= dt * rigid->reaction[d] * rigid->def.velocity[d];
        }
    }
}

static void leave_stage_if_over(struct mpm_sim *sim) {
    struct mpm_clockwork *c = &sim->c;
    if (c->stage + 1 == sim->def->n_stages) {
        return;
    }
    const double ratio = sim->def->stages[c->stage].kinetic_energy_ratio;
    bool over = c->time >= c->stage_end;
    if (!over && ratio > 0) {
        const double kinetic = mpm_kinetic_energy(sim);
        c->kinetic_max = kinetic > c->kinetic_max ? kinetic : c->kinetic_max;
        over = kinetic <= ratio * c->kinetic_max;
    }
    if (over) {
        mpm_enter_stage(sim, c->stage + 1);
    }
}

#define MOST_DRIFT 0.999 // cells: below 1 by more than the round-off of a position in cells
#define SORT_COST 3.0    // of a sort, in steps: 1 in cache, 3 beyond
#define RUN_COST 1.5     // of a run, beside its particles, in particles
#define LEAST_STEPS 120  // between two sorts for speed's sake: so they take 3 % at most

// A sort is due when a particle may have drifted out of its tile's reach, or when runs that have
// been broken since the last one have cost as much as a sort does: they grow about linearly. That
// depends on the state alone, so it comes at the same steps for any number of threads and after a
// restart.
static bool sort_is_due(const struct mpm_sim *sim) {
    const struct mpm_clockwork *c = &sim->c;
    const double steps = (double)c->steps_since_sort;
    const double broken = (double)c->runs - (double)c->runs_at_sort;
    return !c->is_sorted || c->drift > MOST_DRIFT ||
           (c->steps_since_sort >= LEAST_STEPS &&
            0.5 * steps * broken * RUN_COST > SORT_COST * (double)sim->n_particles);
}

// eqs. 7, 8, 10, and the forces of loads and rigid bodies.
static void particles_to_grid(struct mpm_sim *sim, double dt, bool any_fbar, double *clock) {
    struct mpm_span_result found = mpm_nothing_found();
    share_nodes(sim);
    mpm_team_run(sim->team, clear_nodes, &(struct nodes_work){.sim = sim, .fbar = any_fbar});
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_span span = {.dt = dt, .fbar = any_fbar && sim->sets[b].wants_fbar};
        for_particles(sim, b, span, true, p2g, &found);
    }
    sim->c.runs = found.n_runs;
    sim->c.runs_at_sort = sim->c.steps_since_sort == 0 ? found.n_runs : sim->c.runs_at_sort;
    charge(sim, MPM_PHASE_P2G, clock);
    for (size_t k = 0; k < sim->n_loads; k++) {
        struct mpm_load *load = &sim->loads[k];
        struct mpm_particles *s = &sim->sets[load->def.body];
        if (load->active) {
            mpm_load_update(load, s, sim->c.time - mpm_start_time(sim));
            sim->plain->force(&(struct mpm_span){.s = s, .grid = &sim->grid}, load->place,
                              load->force, load->n);
        }
    }
    for (size_t b = 0; sim->body_forces && b < sim->n_sets; b++) {
        mpm_body_force_apply(&sim->body_forces[b], &sim->def->body_force, sim->c.time,
                             &sim->sets[b], &sim->grid, sim->plain);
    }
    for (size_t k = 0; k < sim->n_rigids; k++) {
        struct mpm_rigid *rigid = &sim->rigids[k];
        memset(rigid->reaction, 0, sizeof rigid->reaction);
        for (size_t b = 0; rigid->active && b < sim->n_sets; b++) {
            mpm_contact_forces(rigid, sim->plain, &sim->sets[b], &sim->orders[b], &sim->grid, dt);
        }
    }
    if (sim->n_loads + sim->n_rigids > 0) {
        charge(sim, MPM_PHASE_CONTACT, clock);
    }
}

static bool takes_part_in_fbar(const struct mpm_sim *sim) {
    bool any = false;
    for (size_t b = 0; b < sim->n_sets; b++) {
        any |= sim->sets[b].wants_fbar;
    }
    return any && sim->c.now.fbar.scheme != MPM_FBAR_OFF;
}

static enum mpm_status step(struct mpm_sim *sim, struct mpm_error *err) {
    const struct mpm_settings *now = &sim->c.now;
    const int dim = sim->grid.dim;
    const double dt = mpm_next_dt(sim), time = sim->c.time + dt;
    const double cfl = dt * (mpm_wave_speed(sim) + mpm_largest_speed(sim)) / sim->grid.h;
    if (cfl > UNSTABLE_CFL && !sim->def->unstable_ok) {
        return step_failure(sim, MPM_ERR_UNSTABLE_DT, time, -1, "CFL number", cfl, err);
    }
    double gravity[MPM_MAX_DIM] = {0};
    mpm_gravity_at(sim, sim->c.time, gravity);
    double clock = now_or_zero(sim);
    if (sort_is_due(sim)) {
        if (!mpm_sort(sim)) {
            return step_failure(sim, MPM_ERR_MEMORY, time, -1, "bytes of particles and grid",
                                (double)mpm_bytes(sim), err);
        }
        charge(sim, MPM_PHASE_SORT, &clock);
    }

    // P2G, eqs. 7, 8, 10
    const enum mpm_fbar_scheme scheme = now->fbar.scheme;
    const bool any_fbar = takes_part_in_fbar(sim);
    sim->grid.fbar_stride = mpm_fbar_scalars(scheme);
    particles_to_grid(sim, dt, any_fbar, &clock);

    // Grid, eq. 9, and boundary conditions
    mpm_walls_fold(sim->walls, sim->n_walls, &sim->grid, gravity, dt);
    struct nodes_work motion = {.sim = sim,
                                .motion = {.dt = dt,
                                           .local = now->damping_local,
                                           .mass = now->damping_mass,
                                           .gravity = {gravity[0], gravity[1], gravity[2]}}};
    mpm_team_run(sim->team, move_nodes, &motion);
    mpm_walls_apply(sim->walls, sim->n_walls, &sim->grid, gravity, dt);
    charge(sim, MPM_PHASE_GRID, &clock);

    // G2P, eqs. 11-17; with F-bar, eq. 19 (Algorithm 1, step 3) with it
    struct mpm_span_result found = mpm_nothing_found();
    for (size_t b = 0; b < sim->n_sets; b++) {
        const bool averaged = any_fbar && sim->sets[b].wants_fbar;
        const struct mpm_span span = {.dt = dt,
                                      .blend = now->blend,
                                      .fbar = averaged,
                                      .scheme = scheme,
                                      .a = now->fbar.a,
                                      .C = now->fbar.C,
                                      .keep = now->fbar.keep};
        for_particles(sim, b, span, averaged, g2p, &found);
    }
    charge(sim, MPM_PHASE_G2P, &clock);

    // F-bar, eqs. 20-27: Algorithm 1, steps 4 and 5
    if (any_fbar) {
        mpm_walls_fold_fbar(sim->walls, sim->n_walls, &sim->grid);
        mpm_team_run(sim->team, divide_nodes, sim);
        mpm_walls_mirror_fbar(sim->walls, sim->n_walls, &sim->grid);
        for (size_t b = 0; b < sim->n_sets; b++) {
            if (sim->sets[b].wants_fbar) {
                const struct mpm_span span = {.fbar = true,
                                              .scheme = scheme,
                                              .C = now->fbar.C,
                                              .keep = now->fbar.keep};
                for_particles(sim, b, span, false, fbar, &found);
            }
        }
        charge(sim, MPM_PHASE_FBAR, &clock);
    }

    enum mpm_status status = check_result(sim, &found, time, err);
    if (!status && sim->n_rigids > 0) {
        move_rigid_bodies(sim, dt, &found);
        status = check_result(sim, &found, time, err); // none was pushed out of the domain
        charge(sim, MPM_PHASE_CONTACT, &clock);
    }
    if (status) {
        return status;
    }
    for (int d = 0; d < dim; d++) {
        sim->c.external_work += gravity[d] * found.mass_dx[d];
        sim->c.min[d] = found.min[d];
        sim->c.max[d] = found.max[d];
    }
    for (size_t k = 0; k < sim->n_walls; k++) {
        for (int d = 0; sim->walls[k].active && d < dim; d++) {
            sim->c.external_work -= dt * sim->walls[k].reaction[d] * sim->walls[k].def.velocity[d];
        }
    }
    for (size_t k = 0; k < sim->n_loads; k++) {
        if (sim->loads[k].active) {
            sim->c.external_work +=
                mpm_load_work(&sim->loads[k], &sim->sets[sim->loads[k].def.body]);
        }
    }
    for (size_t b = 0; sim->body_forces && b < sim->n_sets; b++) {
        sim->c.external_work += mpm_body_force_work(&sim->body_forces[b], &sim->sets[b]);
    }
    sim->c.v2_max = found.v2_max;
    sim->c.drift += found.dx_max * sim->grid.inv_h;
    sim->c.steps_since_sort++;
    advance_clock(sim, dt);
    mpm_probes_after_step(sim, dt);
    leave_stage_if_over(sim);
    return MPM_OK;
}

struct step_call {
    struct mpm_sim *sim;
    struct mpm_error *err;
    enum mpm_status status;
};

static void run_step(void *context) {
    struct step_call *call = context;
    call->status = step(call->sim, call->err);
}

enum mpm_status mpm_step(struct mpm_sim *sim, struct mpm_error *err) {
    struct step_call call = {.sim = sim, .err = err};
    mpm_team_hold(sim->team, run_step, &call); // its threads stand by for the parallel parts
    return call.status;
}
