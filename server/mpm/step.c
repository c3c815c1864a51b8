// One explicit time step, update stress last: Zhao, Jiang, Choo, section 2.2 and Algorithm 1.
// The stages below are those of docs/method.md, in its order; equation numbers are the paper's.
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "server/mpm/sim.h"

#define UNSTABLE_CFL                                                                               \
    1.0 // no basis is stable at dt >= 0.9 h/c (docs/method.md): beyond this it is not tried

// eq. 9: nodal velocities. Damping acts on the total force, before boundary conditions; FLIP's
// increment is taken from v^n before boundary conditions.
MPM_KERNEL void update_nodes(struct mpm_grid *grid, const double *gravity,
                             const struct mpm_settings *now, double dt, const int dim) {
    const double local = now->damping_local, mass = now->damping_mass;
    MPM_FOR_ROWS(grid, first, n) {
        for (size_t i = first; i < first + n; i++) {
            const double *node = grid->node + i * MPM_NODE(dim);
            double *velocity = grid->velocity + i * MPM_VELOCITY(dim);
            const double m = node[0];
            if (!(m > 0)) {
                memset(velocity, 0, MPM_VELOCITY(dim) * sizeof *velocity);
                continue;
            }
            const double r = 1 / m;
            for (int d = 0; d < dim; d++) {
                const double v = node[1 + d] * r;
                double f = node[1 + dim + d] + m * gravity[d];
                if (local != 0 && v != 0) {
                    f -= copysign(local * fabs(f), v);
                }
                f -= mass * node[1 + d];
                const double dv = dt * f * r;
                velocity[d] = v + dv;
                velocity[dim + d] = dv;
            }
        }
    }
}

// One kernel over all particles of a body, in chunks that do not depend on the number of threads;
// what the chunks found is joined in their order.
static void run_chunks(struct mpm_sim *sim, struct mpm_span span,
                       void (*kernel)(const struct mpm_span *, struct mpm_span_result *),
                       struct mpm_span_result *joined) {
    const size_t n = span.s->n;
    const long n_chunks = (long)((n + MPM_CHUNK - 1) / MPM_CHUNK);
    const int n_threads = sim->def->n_threads;
    (void)n_threads; // without OpenMP
#pragma omp parallel for schedule(static) num_threads(n_threads) if (n_threads > 1 && n_chunks > 1)
    for (long k = 0; k < n_chunks; k++) {
        struct mpm_span chunk = span;
        chunk.begin = (size_t)k * MPM_CHUNK;
        chunk.end = chunk.begin + MPM_CHUNK < n ? chunk.begin + MPM_CHUNK : n;
        kernel(&chunk, &sim->results[k]);
    }
    for (long k = 0; k < n_chunks; k++) {
        const struct mpm_span_result *r = &sim->results[k];
        for (int d = 0; d < sim->grid.dim; d++) {
            joined->min[d] = fmin(joined->min[d], r->min[d]);
            joined->max[d] = fmax(joined->max[d], r->max[d]);
            joined->mass_dx[d] += r->mass_dx[d];
        }
        joined->v2_max = r->v2_max > joined->v2_max ? r->v2_max : joined->v2_max;
        if (joined->bad == SIZE_MAX && r->bad != SIZE_MAX) {
            joined->bad = r->bad + span.s->first_id; // its id
            joined->status = r->status;
            joined->value = r->value;
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
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            for (int d = 0; d < s->dim; d++) {
                const double x = s->x[mpm_at(p, s->dim, d)];
                if (!(x >= sim->exit_min[d] && x <= sim->exit_max[d])) {
                    return step_failure(sim, MPM_ERR_LEFT_DOMAIN, time, (int64_t)(s->first_id + p),
                                        names[d], x, err);
                }
            }
        }
    }
    return MPM_OK;
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
        for (size_t b = 0; b < sim->n_sets; b++) {
            mpm_contact_keep_out(rigid, &sim->sets[b], dt, found);
        }
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

enum mpm_status mpm_step(struct mpm_sim *sim, struct mpm_error *err) {
    const struct mpm_settings *now = &sim->c.now;
    const int dim = sim->grid.dim;
    const double dt = mpm_next_dt(sim), time = sim->c.time + dt;
    const double cfl = dt * (mpm_wave_speed(sim) + mpm_largest_speed(sim)) / sim->grid.h;
    if (cfl > UNSTABLE_CFL && !sim->def->unstable_ok) {
        return step_failure(sim, MPM_ERR_UNSTABLE_DT, time, -1, "CFL number", cfl, err);
    }
    double gravity[MPM_MAX_DIM];
    mpm_gravity_at(sim, sim->c.time, gravity);
    double clock = now_or_zero(sim);

    // P2G, eqs. 7, 8, 10
    const bool any_fbar = now->fbar.scheme != MPM_FBAR_OFF;
    sim->grid.fbar_stride = 1 + mpm_fbar_scalars(now->fbar.scheme);
    mpm_grid_set_window(&sim->grid, sim->c.min, sim->c.max);
    mpm_walls_extend_window(sim->walls, sim->n_walls, &sim->grid);
    mpm_grid_clear(&sim->grid, any_fbar);
    for (size_t b = 0; b < sim->n_sets; b++) {
        sim->kernels->p2g(&(struct mpm_span){
            .s = &sim->sets[b], .grid = &sim->grid, .begin = 0, .end = sim->sets[b].n, .dt = dt});
    }
    for (size_t k = 0; k < sim->n_loads; k++) {
        struct mpm_load *load = &sim->loads[k];
        struct mpm_particles *s = &sim->sets[load->def.body];
        if (load->active) {
            mpm_load_update(load, s, sim->c.time - mpm_start_time(sim));
            sim->kernels->force(&(struct mpm_span){.s = s, .grid = &sim->grid}, load->particle,
                                load->force, load->n);
        }
    }
    for (size_t b = 0; sim->body_forces && b < sim->n_sets; b++) {
        mpm_body_force_apply(&sim->body_forces[b], &sim->def->body_force, sim->c.time,
                             &sim->sets[b], &sim->grid, sim->kernels);
    }
    for (size_t k = 0; k < sim->n_rigids; k++) {
        struct mpm_rigid *rigid = &sim->rigids[k];
        memset(rigid->reaction, 0, sizeof rigid->reaction);
        for (size_t b = 0; rigid->active && b < sim->n_sets; b++) {
            mpm_contact_forces(rigid, sim->kernels, &sim->sets[b], &sim->grid, dt);
        }
    }
    charge(sim, MPM_PHASE_P2G, &clock);

    // Grid, eq. 9, and boundary conditions
    mpm_walls_fold(sim->walls, sim->n_walls, &sim->grid, gravity, dt);
    if (dim == 2) {
        update_nodes(&sim->grid, gravity, now, dt, 2);
    } else {
        update_nodes(&sim->grid, gravity, now, dt, 3);
    }
    mpm_walls_apply(sim->walls, sim->n_walls, &sim->grid, gravity, dt);
    charge(sim, MPM_PHASE_GRID, &clock);

    // G2P, eqs. 11-17
    struct mpm_span_result found = {.min = {INFINITY, INFINITY, INFINITY},
                                    .max = {-INFINITY, -INFINITY, -INFINITY},
                                    .bad = SIZE_MAX};
    for (size_t b = 0; b < sim->n_sets; b++) {
        struct mpm_particles *s = &sim->sets[b];
        const struct mpm_span span = {.s = s,
                                      .grid = &sim->grid,
                                      .dt = dt,
                                      .blend = now->blend,
                                      .fbar = any_fbar && s->wants_fbar};
        run_chunks(sim, span, sim->kernels->g2p, &found);
    }
    charge(sim, MPM_PHASE_G2P, &clock);

    // F-bar, eqs. 19-27: Algorithm 1, steps 3 to 5
    if (any_fbar) {
        const enum mpm_fbar_scheme scheme = now->fbar.scheme;
        for (size_t b = 0; b < sim->n_sets; b++) {
            struct mpm_particles *s = &sim->sets[b];
            if (s->wants_fbar) {
                sim->kernels->fbar_scatter[scheme](&(struct mpm_span){
                    .s = s, .grid = &sim->grid, .begin = 0, .end = s->n, .a = now->fbar.a});
            }
        }
        mpm_fbar_average(&sim->grid, sim->walls, sim->n_walls, scheme);
        for (size_t b = 0; b < sim->n_sets; b++) {
            struct mpm_particles *s = &sim->sets[b];
            if (s->wants_fbar) {
                const struct mpm_span span = {
                    .s = s, .grid = &sim->grid, .fbar = true, .C = now->fbar.C};
                run_chunks(sim, span, sim->kernels->fbar_finish[scheme], &found);
            }
        }
        charge(sim, MPM_PHASE_FBAR, &clock);
    }

    enum mpm_status status = check_result(sim, &found, time, err);
    if (!status && sim->n_rigids > 0) {
        move_rigid_bodies(sim, dt, &found);
        status = check_result(sim, &found, time, err); // none was pushed out of the domain
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
    advance_clock(sim, dt);
    mpm_probes_after_step(sim, dt);
    leave_stage_if_over(sim);
    return MPM_OK;
}
