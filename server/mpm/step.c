// One explicit time step, update stress last: Zhao, Jiang, Choo, section 2.2 and Algorithm 1.
// The stages below are those of docs/method.md, in its order; equation numbers are the paper's.
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "server/mpm/pass.h"

#define UNSTABLE_CFL                                                                               \
    1.0 // no basis is stable at dt >= 0.9 h/c (docs/method.md): beyond this it is not tried

// What is told anew in every step (team->given); the third to fifth are gravity.
enum given { GIVEN_DT, GIVEN_PASS, GIVEN_GRAVITY };
_Static_assert(GIVEN_GRAVITY + MPM_MAX_DIM <= MPM_GIVEN, "room for gravity");

// Work on nodes. Each thread has the blocks around its part of the particles, so that most of what
// it adds to the grid, moves and gathers stays with it: to fetch what another core has just changed
// takes longer than all else that is done with a node.

// A thread's share of an array of nodes, with slot 0, where no block is.
static void clear(const struct mpm_sim *sim, double *array, int width, int own) {
    const size_t block = (size_t)MPM_BLOCK_NODES(sim->grid.dim) * (size_t)width;
    memset(array + sim->cut[own] * block, 0,
           (sim->cut[own + 1] - sim->cut[own]) * block * sizeof(double));
}

// The sums of a step are cleared for the next one as soon as they have been read, by who has them
// in its cache: so this is work of its own only after a sort.
static void clear_sums(const struct mpm_sim *sim, int own) {
    clear(sim, sim->grid.node, MPM_NODE, own);
}

// What walls have in common is done by one thread: no other touches it before the barrier.
static void move_nodes(const struct mpm_step_work *w, int own, int there) {
    struct mpm_sim *sim = w->sim;
    struct mpm_grid *grid = &sim->grid;
    const double *g = w->plan.motion.gravity, dt = w->plan.motion.dt;
    const uint32_t first = sim->cut[own] > 0 ? sim->cut[own] : 1, last = sim->cut[own + 1];
    mpm_walls_fold(sim->walls, sim->n_walls, grid, g, dt, own);
    if (sim->walls_in_common) {
        if (own == 0) {
            mpm_walls_fold(sim->walls, sim->n_walls, grid, g, dt, there);
        }
        mpm_team_barrier(sim->team, own, there);
    }
    if (first < last) {
        sim->kernels->move_nodes(grid, first, last, &w->plan.motion);
    }
    if (w->plan.fbar) {
        clear(sim, grid->fbar, grid->fbar_stride, own);
    }
    mpm_walls_apply(sim->walls, sim->n_walls, grid, g, dt, own);
    if (sim->walls_in_common) {
        mpm_team_barrier(sim->team, own, there);
        if (own == 0) {
            mpm_walls_apply(sim->walls, sim->n_walls, grid, g, dt, there);
        }
    }
}

static void divide_nodes(struct mpm_sim *sim, int own, int there) {
    struct mpm_grid *grid = &sim->grid;
    mpm_walls_fold_fbar(sim->walls, sim->n_walls, grid, own);
    if (sim->walls_in_common) {
        if (own == 0) {
            mpm_walls_fold_fbar(sim->walls, sim->n_walls, grid, there);
        }
        mpm_team_barrier(sim->team, own, there);
    }
    const uint32_t first = sim->cut[own] > 0 ? sim->cut[own] : 1, last = sim->cut[own + 1];
    if (first < last) {
        sim->kernels->divide_nodes(grid, first, last);
    }
    clear(sim, grid->node, MPM_NODE, own);
    mpm_walls_mirror_fbar(sim->walls, sim->n_walls, grid, own);
    if (sim->walls_in_common) {
        mpm_team_barrier(sim->team, own, there);
        if (own == 0) {
            mpm_walls_mirror_fbar(sim->walls, sim->n_walls, grid, there);
        }
    }
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

// Adds the time since the end of the last one to a phase.
static void charge(struct mpm_sim *sim, enum mpm_phase phase) {
    const double now = mpm_now_or_zero(sim);
    sim->phase_seconds[phase] += now - sim->phase_begin;
    sim->phase_begin = now;
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
#define LEAST_STEPS 60   // between two sorts for speed's sake: so they take 5 % at most

// A sort is due when a particle may have drifted out of its stretch's reach, or when runs that have
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

static bool has_active_load(const struct mpm_sim *sim) {
    bool any = false;
    for (size_t k = 0; k < sim->n_loads; k++) {
        any |= sim->loads[k].active;
    }
    return any;
}

static bool has_active_rigid(const struct mpm_sim *sim) {
    bool any = false;
    for (size_t k = 0; k < sim->n_rigids; k++) {
        any |= sim->rigids[k].active;
    }
    return any;
}

// The forces of loads and rigid bodies.
static void external_forces(struct mpm_sim *sim, double dt) {
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
}

static bool takes_part_in_fbar(const struct mpm_sim *sim) {
    bool any = false;
    for (size_t b = 0; b < sim->n_sets; b++) {
        any |= sim->sets[b].wants_fbar;
    }
    return any && sim->c.now.fbar.scheme != MPM_FBAR_OFF;
}

// All have done a phase: who comes next needs what others have done in it.
static void meet(const struct mpm_step_work *w, enum mpm_phase done, int own, int there) {
    mpm_team_barrier(w->sim->team, own, there);
    if (own == 0) {
        charge(w->sim, done);
    }
}

// One thread's share of a step's transfers, through which all go side by side.
static void transfers(void *context, int own, int there) {
    struct mpm_sim *sim = context;
    const double *given = sim->team->given;
    struct mpm_step_work work = {
        .sim = sim, .plan = sim->plan, .number = (unsigned)given[GIVEN_PASS]};
    struct mpm_step_work *w = &work;
    w->plan.span.dt = w->plan.motion.dt = given[GIVEN_DT];
    memcpy(w->plan.motion.gravity, given + GIVEN_GRAVITY, sizeof w->plan.motion.gravity);

    // P2G, eqs. 7, 8, 10
    const struct mpm_pass p2g = {.work = sim->kernels->p2g, .uses = MPM_USES_SUMS, .adds = true};
    if (w->plan.clears_sums) {
        clear_sums(sim, own);
        mpm_team_barrier(sim->team, own, there);
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        mpm_pass(w, b, &p2g, own, there);
    }
    meet(w, MPM_PHASE_P2G, own, there);
    if (w->plan.forces) {
        if (own == 0) {
            external_forces(sim, w->plan.span.dt);
        }
        meet(w, MPM_PHASE_CONTACT, own, there);
    }

    // Grid, eq. 9, and boundary conditions
    move_nodes(w, own, there);
    meet(w, MPM_PHASE_GRID, own, there);

    // G2P, eqs. 11-17; with F-bar, eq. 19 (Algorithm 1, step 3) with it
    if (!w->plan.fbar) {
        clear_sums(sim, own); // which nobody will read any more
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        const bool averaged = w->plan.fbar && sim->sets[b].wants_fbar;
        const struct mpm_pass g2p = {.work = sim->kernels->g2p,
                                     .uses = MPM_USES_VELOCITY | (averaged ? MPM_USES_FBAR : 0),
                                     .adds = averaged};
        mpm_pass(w, b, &g2p, own, there);
    }
    if (!w->plan.fbar) {
        return;
    }
    meet(w, MPM_PHASE_G2P, own, there);

    // F-bar, eqs. 20-27: Algorithm 1, steps 4 and 5
    divide_nodes(sim, own, there);
    mpm_team_barrier(sim->team, own, there);
    const struct mpm_pass fbar = {.work = sim->kernels->fbar, .uses = MPM_USES_FBAR};
    for (size_t b = 0; b < sim->n_sets; b++) {
        if (sim->sets[b].wants_fbar) {
            mpm_pass(w, b, &fbar, own, there);
        }
    }
}

// What of a step is as it was in the last one is not written again: so it stays where all threads
// have it at hand, and what changes lies in the line that tells them that there is work.
static void run_transfers(struct mpm_sim *sim, double dt, const double *gravity) {
    const struct mpm_settings *now = &sim->c.now;
    struct mpm_plan plan;
    memset(&plan, 0, sizeof plan); // its padding, too
    plan.fbar = takes_part_in_fbar(sim);
    plan.forces = sim->body_forces || has_active_load(sim) || has_active_rigid(sim);
    plan.clears_sums = !sim->sums_are_clear;
    plan.span.blend = now->blend;
    plan.span.scheme = now->fbar.scheme;
    plan.span.a = now->fbar.a;
    plan.span.C = now->fbar.C;
    plan.span.keep = now->fbar.keep;
    plan.motion.local = now->damping_local;
    plan.motion.mass = now->damping_mass;
    if (memcmp(&plan, &sim->plan, sizeof plan) != 0) {
        memcpy(&sim->plan, &plan, sizeof plan);
    }
    double *given = sim->team->given;
    given[GIVEN_DT] = dt;
    given[GIVEN_PASS] = sim->pass;
    memcpy(given + GIVEN_GRAVITY, gravity, MPM_MAX_DIM * sizeof *gravity);
    mpm_team_run(sim->team, transfers, sim);
    for (size_t b = 0; b < sim->n_sets; b++) {
        const bool there_are = sim->orders[b].n_stretches > 0;
        sim->pass += there_are ? 1 + (plan.fbar && sim->sets[b].wants_fbar) : 0;
    }
    sim->sums_are_clear = true;
    charge(sim, plan.fbar ? MPM_PHASE_FBAR : MPM_PHASE_G2P);
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
    sim->phase_begin = mpm_now_or_zero(sim);
    if (sort_is_due(sim)) {
        if (!mpm_sort(sim)) {
            return step_failure(sim, MPM_ERR_MEMORY, time, -1, "bytes of particles and grid",
                                (double)mpm_bytes(sim), err);
        }
        charge(sim, MPM_PHASE_SORT);
    }

    if (sim->grid.fbar_stride != mpm_fbar_scalars(now->fbar.scheme)) {
        sim->grid.fbar_stride = mpm_fbar_scalars(now->fbar.scheme);
    }
    mpm_share_out(sim);
    run_transfers(sim, dt, gravity);
    struct mpm_span_result found = mpm_nothing_found();
    mpm_join_found(sim, &found);
    sim->c.runs = found.n_runs;
    sim->c.runs_at_sort = sim->c.steps_since_sort == 0 ? found.n_runs : sim->c.runs_at_sort;

    enum mpm_status status = check_result(sim, &found, time, err);
    if (!status && has_active_rigid(sim)) {
        move_rigid_bodies(sim, dt, &found);
        status = check_result(sim, &found, time, err); // none was pushed out of the domain
        charge(sim, MPM_PHASE_CONTACT);
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

void mpm_hold(struct mpm_sim *sim, void (*body)(void *context), void *context) {
    mpm_team_hold(sim->team, body, context);
}

enum mpm_status mpm_step(struct mpm_sim *sim, struct mpm_error *err) {
    struct step_call call = {.sim = sim, .err = err};
    mpm_team_hold(sim->team, run_step, &call); // its threads stand by for the parallel parts
    return call.status;
}
