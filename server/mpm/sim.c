// Create, free, settings and stages of a simulation.
#include "server/mpm/sim.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/laws.h"
#include "server/mpm/seed.h"
#include "server/mpm/stability.h"

struct mpm_settings mpm_settings_default(void) {
    return (struct mpm_settings){
        .fbar = {.scheme = MPM_FBAR_OFF, .a = 0.05, .C = 1}, .blend = 1, .cfl = 0.3};
}

struct mpm_def mpm_def_default(void) {
    return (struct mpm_def){
        .dimension = 2, .basis = MPM_BSPLINE2, .settings = mpm_settings_default(), .n_threads = 1};
}

const struct mpm_material_def *mpm_material_of(const struct mpm_def *def, int material,
                                               size_t stage) {
    for (size_t k = stage + 1; k-- > 0;) {
        if (def->stages[k].materials) {
            return &def->stages[k].materials[material];
        }
    }
    return &def->materials[material];
}

double mpm_wave_speed(const struct mpm_sim *sim) {
    double largest = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const double c = sim->sets[b].material->wave_speed(sim->sets[b].parameters);
        largest = c > largest ? c : largest;
    }
    return largest;
}

static double diffusivity(const struct mpm_sim *sim) {
    double largest = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        const double nu = s->material->diffusivity ? s->material->diffusivity(s->parameters) : 0;
        largest = nu > largest ? nu : largest;
    }
    return largest;
}

double mpm_largest_speed(const struct mpm_sim *sim) {
    double largest = sqrt(sim->c.v2_max);
    for (size_t k = 0; k < sim->n_rigids; k++) {
        if (sim->rigids[k].active) {
            largest = fmax(largest, mpm_rigid_speed(&sim->rigids[k].def, sim->grid.dim));
        }
    }
    return largest;
}

static double dt_limit_with(const struct mpm_sim *sim, const struct mpm_settings *settings) {
    return mpm_stability_limit(mpm_stability_of(sim->def), sim->grid.h,
                               mpm_wave_speed(sim) + mpm_largest_speed(sim), diffusivity(sim),
                               settings->damping_mass);
}

double mpm_dt_limit(const struct mpm_sim *sim) {
    return dt_limit_with(sim, &sim->c.now);
}

double mpm_next_dt(const struct mpm_sim *sim) {
    const struct mpm_clockwork *c = &sim->c;
    const double dt = c->now.dt > 0
                          ? c->now.dt
                          : c->now.cfl / mpm_stability_of(sim->def).wave * mpm_dt_limit(sim);
    const double left = c->stage_end - c->time;
    // Fit the last step to the end, but leave a whole step whole whatever round-off says.
    return left > 0 && left < dt * (1 - 1e-6) ? left : dt;
}

void mpm_gravity_at(const struct mpm_sim *sim, double t, double *g) {
    const struct mpm_clockwork *c = &sim->c;
    const double ramp = sim->def->stages[c->stage].gravity_ramp;
    const double part = ramp > 0 ? fmin(1, (t - c->stage_begin) / ramp) : 1;
    for (int d = 0; d < MPM_MAX_DIM; d++) {
        g[d] = part * c->now.gravity[d] + (1 - part) * c->gravity_before[d];
    }
}

static void overlay(struct mpm_settings *on, const struct mpm_settings *from, unsigned which) {
    if (which & MPM_SET_FBAR) {
        on->fbar = from->fbar;
    }
    if (which & MPM_SET_GRAVITY) {
        memcpy(on->gravity, from->gravity, sizeof on->gravity);
    }
    if (which & MPM_SET_DAMPING) {
        on->damping_local = from->damping_local;
        on->damping_mass = from->damping_mass;
    }
    if (which & MPM_SET_BLEND) {
        on->blend = from->blend;
    }
    if (which & MPM_SET_TIME) {
        on->dt = from->dt;
        on->cfl = from->cfl;
    }
}

struct mpm_settings mpm_stage_settings(const struct mpm_def *def, size_t stage,
                                       const struct mpm_settings *base) {
    struct mpm_settings now = *base;
    overlay(&now, &def->stages[stage].settings, def->stages[stage].states);
    return now;
}

bool mpm_provide_fbar(struct mpm_sim *sim, enum mpm_fbar_scheme scheme) {
    if (scheme == MPM_FBAR_OFF) {
        return true;
    }
    bool ok = mpm_grid_add_fbar(&sim->grid, mpm_fbar_scalars(scheme));
    for (size_t b = 0; ok && b < sim->n_sets; b++) {
        if (sim->sets[b].wants_fbar) {
            ok = mpm_particles_add_fbar(&sim->sets[b]);
        }
    }
    return ok;
}

static void update_stress(struct mpm_particles *s) {
    const int n = MPM_SYM(s->dim);
    if (s->material->rate_stress[s->dim - 2]) { // keep the rate part, whose mean is 0
        for (size_t p = 0; p < s->n; p++) {
            double mean = 0;
            for (int k = 0; k < 3; k++) {
                mean += s->sigma[mpm_at(p, n, k)] / 3;
            }
            for (int k = 0; k < 3; k++) {
                s->sigma[mpm_at(p, n, k)] -= mean;
            }
        }
    }
    s->material->stress[s->dim - 2](s, 0, s->n);
}

// Length of the stages before the last, from `stage` on.
static double time_before_last(const struct mpm_def *def, size_t stage) {
    double t = 0;
    for (size_t k = stage; k + 1 < def->n_stages; k++) {
        t += def->stages[k].duration;
    }
    return t;
}

static void reset(struct mpm_sim *sim, unsigned what) {
    for (size_t b = 0; b < sim->n_sets; b++) {
        struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            if ((what & MPM_RESET_PLASTIC_STRAIN) && s->plastic_strain) {
                s->plastic_strain[p] = 0;
            }
            for (int d = 0; d < s->dim; d++) {
                const size_t at = mpm_at(p, s->dim, d);
                if (what & MPM_RESET_VELOCITY) {
                    s->v[at] = 0;
                }
                if ((what & MPM_RESET_DISPLACEMENT) && s->x0) {
                    s->x0[at] = s->x[at];
                }
            }
        }
    }
    if (what & MPM_RESET_VELOCITY) {
        sim->c.v2_max = 0;
    }
}

void mpm_restore_stage(struct mpm_sim *sim) {
    for (size_t b = 0; b < sim->n_sets; b++) {
        struct mpm_particles *s = &sim->sets[b];
        const struct mpm_material_def *m =
            mpm_material_of(sim->def, sim->def->bodies[b].material, sim->c.stage);
        memcpy(s->parameters, m->parameters, sizeof s->parameters);
        s->material->prepare(s->parameters, s->constants);
        s->density = m->parameters[0];
    }
}

void mpm_enter_stage(struct mpm_sim *sim, size_t stage) {
    const struct mpm_def *def = sim->def;
    const struct mpm_stage_def *s = &def->stages[stage];
    struct mpm_clockwork *c = &sim->c;
    if (stage > 0) {
        mpm_gravity_at(sim, c->time, c->gravity_before);
    }
    const double begin = -time_before_last(def, stage);
    if (sim->averages && begin != c->time) { // no mean reaches over a jump of the clock
        memset(sim->averages, 0, def->n_probes * sizeof *sim->averages);
    }
    c->stage = stage;
    c->stage_begin = c->time = c->anchor_time = begin;
    c->stage_end = stage + 1 == def->n_stages ? c->end : -time_before_last(def, stage + 1);
    c->steps_since_anchor = 0;
    c->kinetic_max = 0;
    c->now = mpm_stage_settings(def, stage, &c->base);
    for (size_t k = 0; s->removes_wall && k < sim->n_walls; k++) {
        sim->c.is_sorted &= !s->removes_wall[k]; // the walls' nodes are found with the order
        sim->walls[k].active &= !s->removes_wall[k];
        if (s->removes_wall[k]) {
            memset(sim->walls[k].reaction, 0, sizeof sim->walls[k].reaction);
        }
    }
    for (size_t k = 0; s->removes_load && k < sim->n_loads; k++) {
        sim->loads[k].active &= !s->removes_load[k];
    }
    for (size_t k = 0; s->removes_rigid && k < sim->n_rigids; k++) {
        sim->rigids[k].active &= !s->removes_rigid[k];
        if (s->removes_rigid[k]) {
            memset(sim->rigids[k].reaction, 0, sizeof sim->rigids[k].reaction);
        }
    }
    reset(sim, s->resets); // before the patch, which may return the stress onto its yield surface
    if (s->materials) {
        mpm_restore_stage(sim);
        for (size_t b = 0; b < sim->n_sets; b++) {
            update_stress(&sim->sets[b]);
        }
    }
}

// ---- Create
// ---------------------------------------------------------------------------------------

struct filling {
    struct mpm_sim *sim;
    struct mpm_particles *s;
    const struct mpm_body_def *body;
    size_t p;
};

static bool place(void *context, const double *x, double volume) {
    struct filling *f = context;
    struct mpm_particles *s = f->s;
    double v[MPM_MAX_DIM], v2 = 0;
    mpm_velocity_at(&f->body->velocity, x, s->dim, v);
    for (int d = 0; d < s->dim; d++) {
        const size_t at = mpm_at(f->p, s->dim, d);
        s->x[at] = x[d];
        s->v[at] = v[d];
        if (s->x0) {
            s->x0[at] = x[d];
        }
        f->sim->c.min[d] = fmin(f->sim->c.min[d], x[d]);
        f->sim->c.max[d] = fmax(f->sim->c.max[d], x[d]);
        v2 += v[d] * v[d];
    }
    f->sim->c.v2_max = fmax(f->sim->c.v2_max, v2);
    s->V0[f->p] = s->V[f->p] = volume;
    f->p++;
    return true;
}

static bool wants_x0(const struct mpm_def *def) {
    bool wanted = def->wants_displacement || def->body_force.kind == MPM_BODY_FORCE_SOLUTION;
    for (size_t k = 0; k < def->n_probes; k++) {
        wanted |= def->probes[k].kind == MPM_PROBE_DISPLACEMENT || def->probes[k].has_box ||
                  def->probes[k].kind == MPM_PROBE_ERROR ||
                  (def->probes[k].kind != MPM_PROBE_ENERGY &&
                   def->probes[k].field == MPM_FIELD_DISPLACEMENT);
    }
    return wanted;
}

static bool wants_J_raw(const struct mpm_def *def) {
    bool wanted = def->wants_volume_ratio;
    for (size_t k = 0; k < def->n_probes; k++) {
        const struct mpm_probe_def *probe = &def->probes[k];
        wanted |= probe->kind == MPM_PROBE_DRIFT || probe->field == MPM_FIELD_VOLUME_RATIO;
    }
    return wanted;
}

static bool wants_smooth(const struct mpm_def *def) {
    bool wanted = def->wants_mean_stress_smooth;
    for (size_t k = 0; k < def->n_probes; k++) {
        wanted |= mpm_probe_reads(&def->probes[k], MPM_FIELD_MEAN_STRESS_SMOOTH);
    }
    return wanted;
}

static bool wants_places(const struct mpm_def *def) {
    bool follows = def->n_loads > 0;
    for (size_t k = 0; k < def->n_probes; k++) {
        const struct mpm_probe_def *probe = &def->probes[k];
        follows |= probe->kind == MPM_PROBE_FIELD || probe->kind == MPM_PROBE_DISPLACEMENT;
    }
    return follows;
}

static unsigned wanted(const struct mpm_def *def) {
    return (wants_x0(def) ? MPM_WANTS_X0 : 0) | (wants_J_raw(def) ? MPM_WANTS_J_RAW : 0) |
           (wants_places(def) ? MPM_WANTS_PLACES : 0);
}

static bool wants_reaction(const struct mpm_def *def, size_t wall) {
    for (size_t k = 0; k < def->n_probes; k++) {
        if (def->probes[k].kind == MPM_PROBE_REACTION && def->probes[k].wall == (int)wall) {
            return true;
        }
    }
    return false;
}

// The schemes that the definition itself can come to use.
static enum mpm_fbar_scheme widest_fbar(const struct mpm_def *def) {
    enum mpm_fbar_scheme widest = def->settings.fbar.scheme;
    for (size_t k = 0; k < def->n_stages; k++) {
        const struct mpm_stage_def *s = &def->stages[k];
        if ((s->states & MPM_SET_FBAR) && s->settings.fbar.scheme > widest) {
            widest = s->settings.fbar.scheme;
        }
    }
    return widest;
}

static bool create_sets(struct mpm_sim *sim) {
    const struct mpm_def *def = sim->def;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_body_def *body = &def->bodies[b];
        const struct mpm_material_def *m = mpm_material_of(def, body->material, 0);
        struct mpm_particles *s = &sim->sets[b];
        *s = (struct mpm_particles){.first_id = (uint32_t)sim->n_particles,
                                    .body = (int)b,
                                    .dim = def->dimension,
                                    .material = m->model,
                                    .law = (int)mpm_material_law(m->model),
                                    .density = m->parameters[0],
                                    .half = mpm_seed_half(body),
                                    .inv_4_half = 0.25 / mpm_seed_half(body),
                                    .wants_fbar = m->fbar};
        memcpy(s->parameters, m->parameters, sizeof s->parameters);
        s->material->prepare(s->parameters, s->constants);
        const size_t n = mpm_seed(def, body, NULL, NULL);
        if (!mpm_particles_create(s, n, wanted(def))) {
            return false;
        }
        struct filling f = {.sim = sim, .s = s, .body = body};
        mpm_seed(def, body, place, &f);
        sim->n_particles += n;
    }
    return true;
}

#define ON_THE_WALL 1e-6 // cells: the round-off of 1e9 steps that each move it by 1e-15 of a cell

// Where a particle counts as having left the domain. uGIMP and linear walls hold nodes, not
// particles: a particle pressed against one may sink past it by a fraction of its own size (2 % of
// a cell was seen in the dam break), so where such a wall stands on the domain's edge, half a
// particle more is allowed. One that begins on a B-spline's wall stays there but for round-off.
static void set_exit(struct mpm_sim *sim) {
    const struct mpm_def *def = sim->def;
    double half = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        half = fmax(half, sim->sets[b].half * def->cell);
    }
    for (int d = 0; d < def->dimension; d++) {
        sim->exit_min[d] = def->domain_min[d];
        sim->exit_max[d] = def->domain_max[d];
    }
    for (size_t k = 0; k < sim->n_walls; k++) {
        const struct mpm_wall_def *w = &sim->walls[k].def;
        const double beyond = sim->walls[k].folds ? ON_THE_WALL * def->cell : half;
        if (w->keeps_above && w->at - beyond < sim->exit_min[w->axis]) {
            sim->exit_min[w->axis] = w->at - beyond;
        }
        if (!w->keeps_above && w->at + beyond > sim->exit_max[w->axis]) {
            sim->exit_max[w->axis] = w->at + beyond;
        }
    }
}

static bool create_probes(struct mpm_sim *sim) {
    const size_t n = sim->def->n_probes;
    bool averages = false;
    for (size_t k = 0; k < n; k++) {
        averages |= sim->def->probes[k].average > 0;
    }
    sim->probe_set = calloc(n + 1, sizeof *sim->probe_set);
    sim->probe_particle = calloc(n + 1, sizeof *sim->probe_particle);
    sim->averages = averages ? calloc(n, sizeof *sim->averages) : NULL;
    sim->compares = calloc(n + 1, sizeof *sim->compares);
    bool sorts = false;
    for (size_t k = 0; k < n; k++) {
        sorts |= sim->def->probes[k].kind == MPM_PROBE_EXTENT && sim->def->probes[k].quantile < 1;
    }
    sim->scratch = sorts ? calloc(sim->n_particles, sizeof *sim->scratch) : NULL;
    if (!sim->probe_set || !sim->probe_particle || (averages && !sim->averages) ||
        (sorts && !sim->scratch) || !sim->compares) {
        return false;
    }
    for (size_t k = 0; k < n; k++) {
        if (!mpm_compare_create(&sim->compares[k], sim, &sim->def->probes[k])) {
            return false;
        }
    }
    mpm_probes_find_particles(sim);
    return true;
}

static bool create_body_forces(struct mpm_sim *sim) {
    bool ok = true;
    if (sim->def->body_force.kind == MPM_BODY_FORCE_NONE) {
        return true;
    }
    sim->body_forces = calloc(sim->n_sets, sizeof *sim->body_forces);
    for (size_t b = 0; sim->body_forces && b < sim->n_sets; b++) {
        ok &= mpm_body_force_create(&sim->body_forces[b], &sim->sets[b]);
    }
    return ok && sim->body_forces;
}

static void keep_first(void *context, const struct mpm_error *fault) {
    struct mpm_error *first = context;
    if (first && first->status == MPM_OK) {
        *first = *fault;
    }
}

enum mpm_status mpm_create(const struct mpm_def *def, struct mpm_sim **out, struct mpm_error *err) {
    *out = NULL;
    struct mpm_error first = {.status = MPM_OK};
    if (mpm_check(def, keep_first, &first)) {
        if (err) {
            *err = first;
        }
        return first.status;
    }
    struct mpm_sim *sim = aligned_alloc(64, sizeof *sim);
    if (!sim) {
        return mpm_fail(err, MPM_ERR_MEMORY, "", "no memory for the simulation");
    }
    memset(sim, 0, sizeof *sim);
    sim->def = def;
    sim->isa = mpm_isa_in_use(def->isa);
    sim->kernels = mpm_kernels(def->dimension, def->basis, sim->isa);
    sim->plain = mpm_kernels(def->dimension, def->basis, MPM_ISA_BASELINE);
    sim->n_sets = def->n_bodies;
    sim->sets = calloc(def->n_bodies, sizeof *sim->sets);
    sim->orders = calloc(def->n_bodies, sizeof *sim->orders);
    sim->walls = calloc(def->n_walls + 1, sizeof *sim->walls);
    sim->loads = calloc(def->n_loads + 1, sizeof *sim->loads);
    sim->rigids = calloc(def->n_rigids + 1, sizeof *sim->rigids);
    sim->smooth = calloc(1, sizeof *sim->smooth);
    for (int d = 0; d < MPM_MAX_DIM; d++) {
        sim->c.min[d] = INFINITY;
        sim->c.max[d] = -INFINITY;
    }
    if (!sim->sets || !sim->orders || !sim->walls || !sim->loads || !sim->rigids || !sim->smooth ||
        !mpm_grid_create(&sim->grid, def, mpm_support(def->basis)) || !create_sets(sim)) {
        goto fail;
    }
    for (; sim->n_walls < def->n_walls; sim->n_walls++) {
        mpm_wall_create(&sim->walls[sim->n_walls], def, sim->n_walls, &sim->grid,
                        wants_reaction(def, sim->n_walls));
    }
    for (; sim->n_rigids < def->n_rigids; sim->n_rigids++) {
        if (!mpm_rigid_create(&sim->rigids[sim->n_rigids], &def->rigids[sim->n_rigids],
                              def->dimension, sim->n_particles)) {
            goto fail;
        }
    }
    for (; sim->n_loads < def->n_loads; sim->n_loads++) {
        struct mpm_load *load = &sim->loads[sim->n_loads];
        const struct mpm_load_def *q = &def->loads[sim->n_loads];
        if (!mpm_load_create(load, q, &sim->sets[q->body])) {
            goto fail;
        }
        if (load->n == 0) {
            char pointer[256];
            snprintf(pointer, sizeof pointer, "/loads/%s/select", q->name);
            mpm_free(sim);
            return mpm_fail_value(err, MPM_ERR_EMPTY, pointer, "at least one particle", "none",
                                  "load '%s' chooses no particle of body '%s'", q->name,
                                  def->bodies[q->body].name);
        }
    }
    set_exit(sim);
    size_t largest = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        largest = sim->sets[b].n > largest ? sim->sets[b].n : largest;
    }
    sim->turns = aligned_alloc(128, (size_t)def->n_threads * sizeof *sim->turns);
    sim->team = mpm_team_create(def->n_threads);
    sim->mass_dx = calloc(sim->n_particles / MPM_FEWEST + sim->n_sets, sizeof *sim->mass_dx);
    sim->parts = calloc(sim->n_sets * ((size_t)def->n_threads + 1), sizeof *sim->parts);
    sim->cut = calloc((size_t)def->n_threads + 1, sizeof *sim->cut);
    if (!sim->turns || !sim->team || !sim->mass_dx || !sim->cut || !sim->parts) {
        goto fail;
    }
    memset(sim->turns, 0, (size_t)def->n_threads * sizeof *sim->turns);
    if (!mpm_sorter_create(&sim->sorter, largest, sim->team) || !create_probes(sim) ||
        !create_body_forces(sim) || !mpm_provide_fbar(sim, widest_fbar(def))) {
        goto fail;
    }
    sim->c.base = def->settings;
    sim->c.end = def->stages[def->n_stages - 1].duration;
    const double v2_max = sim->c.v2_max;
    mpm_enter_stage(sim, 0);
    sim->c.v2_max = def->stages[0].resets & MPM_RESET_VELOCITY ? 0 : v2_max;
    for (size_t b = 0; b < sim->n_sets; b++) {
        update_stress(&sim->sets[b]);
    }
    if (!mpm_sort(sim)) {
        goto fail;
    }
    *out = sim;
    return MPM_OK;
fail:
    mpm_free(sim);
    struct mpm_estimate estimate; // what was to be made, not how far it came
    mpm_estimate(def, &estimate);
    return mpm_fail(err, MPM_ERR_MEMORY, "",
                    "no memory for %zu particles and their grid: %zu bytes", estimate.particles,
                    estimate.bytes);
}

void mpm_free(struct mpm_sim *sim) {
    if (!sim) {
        return;
    }
    for (size_t b = 0; sim->sets && b < sim->n_sets; b++) {
        mpm_particles_free(&sim->sets[b]);
    }
    for (size_t b = 0; sim->orders && b < sim->n_sets; b++) {
        mpm_order_free(&sim->orders[b]);
    }
    mpm_sorter_free(&sim->sorter);
    mpm_smooth_free(sim->smooth);
    mpm_team_free(sim->team);
    free(sim->turns);
    free(sim->cut);
    free(sim->parts);
    for (size_t k = 0; sim->walls && k < sim->n_walls; k++) {
        mpm_wall_free(&sim->walls[k]);
    }
    for (size_t k = 0; sim->loads && k < sim->n_loads; k++) {
        mpm_load_free(&sim->loads[k]);
    }
    for (size_t k = 0; sim->rigids && k < sim->n_rigids; k++) {
        mpm_rigid_free(&sim->rigids[k]);
    }
    for (size_t k = 0; sim->compares && k < sim->def->n_probes; k++) {
        mpm_compare_free(&sim->compares[k]);
    }
    for (size_t b = 0; sim->body_forces && b < sim->n_sets; b++) {
        mpm_body_force_free(&sim->body_forces[b]);
    }
    mpm_grid_free(&sim->grid);
    free(sim->compares);
    free(sim->body_forces);
    free(sim->sets);
    free(sim->orders);
    free(sim->walls);
    free(sim->loads);
    free(sim->rigids);
    free(sim->mass_dx);
    free(sim->averages);
    free(sim->probe_set);
    free(sim->probe_particle);
    free(sim->scratch);
    free(sim);
}

#define STRIDE 3 // cells; see count_blocks

struct counting {
    const struct mpm_def *def;
    struct mpm_grid grid; // of which only the slots are used
    bool out_of_memory;
    bool begun, pending;      // whether there are:
    double counted;           // place along the row of the last particle that was counted
    double last[MPM_MAX_DIM]; // the last particle
};

static void count_around(struct counting *c, const double *x) {
    c->out_of_memory |= !mpm_activate_around(&c->grid, c->def->basis, x);
    c->counted = x[c->def->dimension - 1];
    c->pending = false;
}

// Blocks are 4 cells wide and each particle needs two nodes a direction or more: in a row without
// gaps of more than a cell, one particle every STRIDE cells and the last one need the same blocks
// as all of them.
static bool count_blocks(void *context, const double *x, double volume) {
    struct counting *c = context;
    const int along = c->def->dimension - 1;
    (void)volume;
    bool on = c->begun;
    for (int d = 0; d < along; d++) {
        on = on && x[d] == c->last[d];
    }
    on = on && x[along] > c->last[along] && x[along] - c->last[along] < c->def->cell * (1 + 1e-6);
    if (!on && c->pending) {
        count_around(c, c->last);
    }
    memcpy(c->last, x, (size_t)c->def->dimension * sizeof *x);
    if (!on || x[along] - c->counted >= STRIDE * c->def->cell) {
        count_around(c, x);
    } else {
        c->pending = true;
    }
    c->begun = true;
    return !c->out_of_memory;
}

void mpm_estimate(const struct mpm_def *def, struct mpm_estimate *out) {
    *out = (struct mpm_estimate){0};
    struct counting c = {.def = def};
    if (!mpm_grid_create(&c.grid, def, mpm_support(def->basis))) {
        mpm_grid_free(&c.grid);
        out->bytes = SIZE_MAX;
        return;
    }
    const bool fbar = widest_fbar(def) != MPM_FBAR_OFF;
    size_t largest = 0;
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_material_def *m = &def->materials[def->bodies[b].material];
        const size_t n = mpm_seed(def, &def->bodies[b], count_blocks, &c);
        if (c.pending) {
            count_around(&c, c.last);
        }
        c.begun = false;
        out->particles += n;
        largest = n > largest ? n : largest;
        out->bytes +=
            mpm_particles_bytes(m->model, def->dimension, n, wanted(def), fbar && m->fbar);
    }
    struct mpm_wall *walls = calloc(def->n_walls + 1, sizeof *walls);
    for (size_t k = 0; walls && k < def->n_walls; k++) {
        mpm_wall_create(&walls[k], def, k, &c.grid, false);
    }
    c.out_of_memory |= !walls || !mpm_walls_activate(walls, def->n_walls, &c.grid);
    free(walls);
    out->nodes = (size_t)(c.grid.n_slots - 1) * (size_t)MPM_BLOCK_NODES(def->dimension);
    out->bytes += mpm_grid_bytes(&c.grid, c.grid.n_slots, mpm_fbar_scalars(widest_fbar(def))) +
                  mpm_sorter_bytes(largest, def->n_threads);
    if (wants_smooth(
            def)) { // of the nodes it takes those that particles reach: fewer than blocks have
        out->bytes += mpm_smooth_estimate(out->nodes, out->particles);
    }
    for (size_t k = 0; k < def->n_rigids; k++) {
        out->bytes += mpm_rigid_bytes(&def->rigids[k], def->dimension, out->particles);
    }
    for (size_t k = 0; k < def->n_probes; k++) {
        out->bytes += mpm_compare_bytes(&def->probes[k], def->dimension, out->particles);
    }
    if (def->body_force.kind != MPM_BODY_FORCE_NONE) {
        out->bytes += mpm_body_force_bytes(def->dimension, out->particles);
    }
    if (c.out_of_memory) {
        out->bytes = SIZE_MAX;
    }
    mpm_grid_free(&c.grid);
    double steps = 0;
    for (size_t k = 0; k < def->n_stages; k++) {
        const struct mpm_settings now = mpm_stage_settings(def, k, &def->settings);
        out->dt_limit = mpm_def_dt_limit(def, k);
        out->dt = now.dt > 0 ? now.dt : now.cfl / mpm_stability_of(def).wave * out->dt_limit;
        steps += ceil(def->stages[k].duration / out->dt * (1 - 1e-9));
    }
    out->steps = (uint64_t)fmin(steps, 9e18); // what is beyond has no whole number
}

// ---- Queries and changes
// --------------------------------------------------------------------------

bool mpm_finished(const struct mpm_sim *sim) {
    return sim->c.stage + 1 == sim->def->n_stages && sim->c.time >= sim->c.end;
}

uint64_t mpm_step_count(const struct mpm_sim *sim) {
    return sim->c.step;
}

double mpm_time(const struct mpm_sim *sim) {
    return sim->c.time;
}

double mpm_end_time(const struct mpm_sim *sim) {
    return sim->c.end;
}

double mpm_start_time(const struct mpm_sim *sim) {
    return 0 - time_before_last(sim->def, 0);
}

size_t mpm_stage(const struct mpm_sim *sim) {
    return sim->c.stage;
}

size_t mpm_n_particles(const struct mpm_sim *sim) {
    return sim->n_particles;
}

size_t mpm_n_nodes(const struct mpm_sim *sim) {
    return (size_t)(sim->grid.n_slots - 1) * (size_t)MPM_BLOCK_NODES(sim->grid.dim);
}

size_t mpm_bytes(const struct mpm_sim *sim) {
    size_t bytes = sim->grid.bytes + sim->sorter.bytes + mpm_smooth_bytes(sim->smooth) +
                   (sim->smooth->value ? sim->n_particles * sizeof(double) : 0);
    for (size_t b = 0; b < sim->n_sets; b++) {
        bytes += sim->sets[b].memory_bytes + sim->sets[b].fbar_bytes;
    }
    for (size_t k = 0; k < sim->n_rigids; k++) {
        bytes += sim->rigids[k].anchor_bytes;
    }
    for (size_t k = 0; k < sim->def->n_probes; k++) {
        bytes += mpm_compare_bytes(&sim->def->probes[k], sim->grid.dim, sim->n_particles);
    }
    if (sim->body_forces) {
        bytes += mpm_body_force_bytes(sim->grid.dim, sim->n_particles);
    }
    return bytes;
}

struct mpm_settings mpm_settings_now(const struct mpm_sim *sim) {
    return sim->c.now;
}

enum mpm_status mpm_change(struct mpm_sim *sim, const struct mpm_settings *settings, unsigned which,
                           struct mpm_error *err) {
    struct mpm_settings now = sim->c.now;
    overlay(&now, settings, which);
    const enum mpm_status status =
        mpm_check_settings(&now, "", sim->def->dimension, dt_limit_with(sim, &now),
                           mpm_stability_of(sim->def).wave, sim->def->unstable_ok, err);
    if (status) {
        return status;
    }
    if (!mpm_provide_fbar(sim, now.fbar.scheme)) {
        return mpm_fail(err, MPM_ERR_MEMORY, "/fbar", "no memory for what F-bar needs");
    }
    sim->c.now = now;
    overlay(&sim->c.base, settings, which);
    if (which & MPM_SET_TIME) {
        sim->c.anchor_time = sim->c.time;
        sim->c.steps_since_anchor = 0;
    }
    if (which & MPM_SET_GRAVITY) { // at once: a ramp that was under way ends
        memcpy(sim->c.gravity_before, now.gravity, sizeof now.gravity);
    }
    return MPM_OK;
}

enum mpm_status mpm_change_end(struct mpm_sim *sim, double end, struct mpm_error *err) {
    const bool last = sim->c.stage + 1 == sim->def->n_stages;
    if (!(end > 0 && end < INFINITY) || (last && end < sim->c.time)) {
        char actual[32];
        snprintf(actual, sizeof actual, "%.9g", end);
        return mpm_fail_value(err, MPM_ERR_RANGE, "/time/end", "a time not yet passed, s", actual,
                              "the end must be above 0 and not before the present time, %.9g s",
                              sim->c.time);
    }
    sim->c.end = end;
    if (last) {
        sim->c.stage_end = end;
    }
    return MPM_OK;
}

static const char *const phase_names[] = {
#define X(code, text) text,
    MPM_PHASE_LIST(X)
#undef X
};

const char *mpm_phase_name(enum mpm_phase phase) {
    return phase_names[phase];
}

double mpm_phase_seconds(const struct mpm_sim *sim, enum mpm_phase phase) {
    return sim->phase_seconds[phase];
}
