// One explicit time step, update stress last: Zhao, Jiang, Choo, section 2.2 and Algorithm 1.
// The stages below are those of docs/method.md, in its order; equation numbers are the paper's.
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/sim.h"

#define UNSTABLE_CFL                                                                               \
    1.0 // no basis is stable at dt >= 0.9 h/c (docs/method.md): beyond this it is not tried

// What is told anew in every step (team->given); the third to fifth are gravity.
enum given { GIVEN_DT, GIVEN_PASS, GIVEN_GRAVITY };
_Static_assert(GIVEN_GRAVITY + MPM_MAX_DIM <= MPM_GIVEN, "room for gravity");

// What a thread knows of a step.
struct step_work {
    struct mpm_sim *sim;
    struct mpm_plan plan;
    unsigned number; // of the last pass that added to the grid
    int pass;        // of the step, from 0; a body's own
};

static uint32_t *parts_of(const struct mpm_sim *sim, size_t body) {
    return sim->parts + body * ((size_t)sim->def->n_threads + 1);
}

// What threads get through in a second differs: with what flows in their parts, and with what else
// wants their cores. So each one's share follows what it did with the last; nothing that is
// computed depends on the shares.
static void follow_speeds(struct mpm_sim *sim, int n) {
    double all = 0, speeds = 0;
    for (int k = 0; k < n; k++) {
        struct mpm_turn *turn = &sim->turns[k];
        turn->speed = turn->seconds > 0 ? turn->work / turn->seconds : 0;
        turn->share = turn->share > 0 ? turn->share : 1.0 / n;
        speeds += turn->speed;
        turn->work = turn->seconds = 0;
    }
    for (int k = 0; k < n; k++) {
        struct mpm_turn *turn = &sim->turns[k];
        const double wanted = turn->speed > 0 ? turn->speed / speeds : 1.0 / n;
        turn->share += 0.5 * (fmin(fmax(wanted, 0.5 / n), 2.0 / n) - turn->share);
        all += turn->share;
    }
    for (int k = 0; k < n; k++) {
        sim->turns[k].share /= all;
    }
}

static void share_out(struct mpm_sim *sim) {
    const int n = sim->team->n_there;
    if (sim->n_shared == n) {
        return;
    }
    follow_speeds(sim, n);
    size_t most = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        struct mpm_order *order = &sim->orders[b];
        uint32_t *parts = parts_of(sim, b);
        double before = 0;
        most = sim->sets[b].n > sim->sets[most].n ? b : most;
        for (int k = 0; k < n; k++) {
            const uint32_t cut = (uint32_t)mpm_order_cut(order, before);
            parts[k] = k > 0 && cut < parts[k - 1] ? parts[k - 1] : cut;
            before += sim->turns[k].share;
        }
        parts[n] = (uint32_t)order->n_chunks;
        mpm_order_share(order, parts, n);
    }
    const struct mpm_order *order = &sim->orders[most];
    for (int k = 1; k < n; k++) {
        const size_t t = order->chunk[parts_of(sim, most)[k]];
        const uint32_t slot =
            t < order->n_stretches ? sim->grid.slot[order->stretch[t].first] : sim->grid.n_slots;
        sim->cut[k] = slot > sim->cut[k - 1] ? slot : sim->cut[k - 1];
    }
    sim->cut[n] = sim->grid.n_slots;
    sim->walls_in_common = mpm_walls_share(sim->walls, sim->n_walls, &sim->grid, sim->cut, n);
    sim->n_shared = n;
}

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
static void move_nodes(const struct step_work *w, int own, int there) {
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

// All but the sums, which are not the same in any order.
static void join(struct mpm_span_result *joined, const struct mpm_span_result *r, int dim) {
    for (int d = 0; d < dim; d++) {
        joined->min[d] = r->min[d] < joined->min[d] ? r->min[d] : joined->min[d];
        joined->max[d] = r->max[d] > joined->max[d] ? r->max[d] : joined->max[d];
    }
    joined->v2_max = r->v2_max > joined->v2_max ? r->v2_max : joined->v2_max;
    joined->dx_max = r->dx_max > joined->dx_max ? r->dx_max : joined->dx_max;
    joined->n_runs += r->n_runs;
    if (r->bad < joined->bad) {
        joined->bad = r->bad;
        joined->status = r->status;
        joined->value = r->value;
    }
}

typedef void span_work(const struct mpm_sim *sim, const struct mpm_span *span,
                       struct mpm_span_result *result);

// Arrays of the grid.
enum { USES_SUMS = 1, USES_VELOCITY = 2, USES_FBAR = 4 };
#define FAR_GRID ((size_t)2 << 20) // bytes; as much of it as a core's own cache has room for

struct particles_work {
    const struct mpm_sim *sim;
    const struct mpm_order *order;
    struct mpm_span span;
    span_work *work;
    size_t body;
    int pass;                       // of the step, from 0; a body's own
    unsigned number;                // that no pass before had, of those that add to the grid
    const uint32_t *parts;          // (n_parts + 1) first chunk of each
    int n_parts;                    // one a thread
    double (*mass_dx)[MPM_MAX_DIM]; // of the body's chunks
    unsigned uses;                  // arrays of the grid, as bits
    bool adds;                      // to the grid
    bool grid_is_far;               // and has not stayed in the cache
    bool clears_sums;               // which nobody will read any more
};

static size_t grid_bytes_in_use(const struct mpm_grid *g) {
    const int width = MPM_NODE + MPM_VELOCITY(g->dim);
    return (size_t)g->n_slots * (size_t)MPM_BLOCK_NODES(g->dim) * (size_t)width * sizeof(double);
}

static void work_on(const struct particles_work *w, size_t begin, size_t end, size_t next,
                    struct mpm_span_result *found, double *mass_dx) {
    struct mpm_span span = w->span;
    struct mpm_span_result result;
    span.begin = begin;
    span.end = end;
    span.next = next;
    w->work(w->sim, &span, &result);
    join(found, &result, span.s->dim);
    if (mass_dx) {
        memcpy(mass_dx, result.mass_dx, sizeof result.mass_dx);
    }
}

// A thread takes over from another only while much of its part is left, as when it lost its core:
// what lies in another core's cache takes longer to fetch than to work on. Of a few it takes none:
// what the other is at keeps it as long as they would, and to ask takes time, too.
#define MUCH 3 // one of so many parts is

// A part's next stretch or chunk in the lower half of its turn, the end in the upper one. Its own
// thread sets it as it begins; until then, as at the end of all work, nothing is left.
static void begin_turn(struct mpm_turn *turn, size_t begin, size_t end) {
    atomic_store_explicit(&turn->next, (uint64_t)end << 32 | begin, memory_order_release);
}

// The next of a part of n, if there is one.
static bool take(struct mpm_turn *turn, bool own, size_t n, size_t *next) {
    if (!own) {
        const uint64_t now = atomic_load_explicit(&turn->next, memory_order_relaxed);
        if ((now & UINT32_MAX) + n / MUCH + 1 >= now >> 32) {
            return false;
        }
    }
    const uint64_t now = atomic_fetch_add_explicit(&turn->next, 1, memory_order_acquire);
    *next = now & UINT32_MAX;
    return *next < now >> 32;
}

// The next of a part [begin, end), `own` or another's; *at goes through an own part of a few.
static bool next_of_part(struct mpm_turn *turn, bool own, size_t begin, size_t end, size_t *at,
                         size_t *next) {
    if (end - begin >= MPM_FEW) {
        return take(turn, own, end - begin, next);
    }
    *next = own ? (*at)++ : end;
    return *next < end;
}

static double now_or_zero(const struct mpm_sim *sim) {
    return sim->def->clock ? sim->def->clock() : 0;
}

// What a thread has found in the step so far, on how many particles, and since when: for
// follow_speeds. Of faults the first pass' counts.
static void end_turn(const struct particles_work *w, int own, struct mpm_span_result *found,
                     size_t work, double since) {
    struct mpm_turn *turn = &w->sim->turns[own];
    if (w->pass == 0) {
        turn->found = *found;
        turn->fault_pass = 0;
        turn->fault_body = w->body;
    } else {
        if (turn->found.bad != SIZE_MAX) {
            found->bad = SIZE_MAX;
        } else {
            turn->fault_pass = w->pass;
            turn->fault_body = w->body;
        }
        join(&turn->found, found, w->span.s->dim);
    }
    if (since > 0) {
        turn->work += (double)work;
        turn->seconds += now_or_zero(w->sim) - since;
    }
}

static double (*mass_dx_of(const struct mpm_sim *sim, size_t body))[MPM_MAX_DIM] {
    return sim->mass_dx + sim->sets[body].first_id / MPM_FEWEST + body;
}

// What all have found in the step: of faults the first pass' first, by its particle's id; and the
// sums, in the order of the chunks.
static void join_found(const struct mpm_sim *sim, struct mpm_span_result *joined) {
    int pass = 0;
    size_t body = 0;
    for (int k = 0; k < sim->team->n_there; k++) {
        const struct mpm_turn *turn = &sim->turns[k];
        struct mpm_span_result found = turn->found;
        if (found.bad != SIZE_MAX && (joined->bad == SIZE_MAX || turn->fault_pass < pass)) {
            joined->bad = SIZE_MAX;
            pass = turn->fault_pass;
            body = turn->fault_body;
        } else if (turn->fault_pass > pass) {
            found.bad = SIZE_MAX;
        }
        join(joined, &found, sim->grid.dim);
    }
    if (joined->bad != SIZE_MAX) {
        joined->bad = sim->sets[body].first_id + sim->sets[body].id[joined->bad];
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        for (size_t k = 0; k < sim->orders[b].n_chunks; k++) {
            for (int d = 0; d < sim->grid.dim; d++) {
                joined->mass_dx[d] += mass_dx_of(sim, b)[k][d];
            }
        }
    }
}

static void lines_ahead(const double *array, uint32_t first, size_t n, int width, bool writes) {
    const double *from = array + (size_t)first * (size_t)width;
    for (size_t i = 0; i < n * (size_t)width; i += 8) {
        if (writes) {
            mpm_prefetch_to_write(from + i);
        } else {
            __builtin_prefetch(from + i);
        }
    }
}

// The nodes of a stretch that comes next, after t, on the way to the cache: of other blocks than t's
// all, where the grid is too large to have stayed there; those that other threads have just changed,
// which are theirs; and, if it waits for them, those of its blocks.
static void nodes_ahead(const struct particles_work *w, uint32_t t, uint32_t next, int own) {
    const struct mpm_grid *g = &w->sim->grid;
    const struct mpm_stretch *stretch = &w->order->stretch[next], *now = &w->order->stretch[t];
    const uint32_t nodes = (uint32_t)MPM_BLOCK_NODES(g->dim), *cut = w->sim->cut;
    const uint32_t reach = (uint32_t)mpm_support(w->sim->def->basis) - 1;
    for (uint32_t block = stretch->first; block <= stretch->last; block++) {
        const uint32_t slot = g->slot[block];
        const bool far = w->grid_is_far && (block < now->first || block > now->last);
        for (uint32_t k = 0; slot > 0 && k < 1u << g->dim; k++) {
            const uint32_t first = g->near[slot][k], near = first / nodes;
            const bool theirs = near > 0 && (near < cut[own] || near >= cut[own + 1]);
            const bool awaited = k == 0 && (w->order->ties[next] & MPM_AWAITS);
            if ((k & 1 && block < stretch->last) || // the next one's own
                !(far || theirs || awaited)) {
                continue;
            }
            const size_t n = k >> (g->dim - 1) ? reach * nodes / MPM_EDGE : nodes; // reached
            if (w->uses & USES_SUMS) {
                lines_ahead(g->node, first, n, MPM_NODE, true);
            }
            if (w->uses & USES_FBAR) {
                lines_ahead(g->fbar, first, n, g->fbar_stride, w->adds);
            }
            if (w->uses & USES_VELOCITY) {
                lines_ahead(g->velocity, first, n, MPM_VELOCITY(g->dim), false);
            }
        }
    }
}

// Waits until those are done that come before a stretch of the part [begin, end), and are not
// surely done by who comes to it. Adds the seconds that it takes to *since.
static void await_before(const struct particles_work *w, uint32_t t, size_t begin, size_t end,
                         double *since) {
    const struct mpm_order *order = w->order;
    const bool few = end - begin < MPM_FEW; // all by one thread, one after the other
    if (few && !(order->ties[t] & MPM_AWAITS)) {
        return;
    }
    for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
        const uint32_t q = order->before[b];
        if (few && q >= begin && q < end) {
            continue;
        }
        atomic_uint *done = &order->done[order->flag[q]];
        for (unsigned pass;
             (pass = atomic_load_explicit(done, memory_order_acquire)) != w->number;) {
            const double waits = now_or_zero(w->sim);
            mpm_team_await(w->sim->team, done, pass);
            *since += now_or_zero(w->sim) - waits;
        }
    }
}

// What nobody looks at is not said: each time, the flags' cache line has to come back from who has
// looked last.
static void say_done(const struct particles_work *w, uint32_t t, size_t begin, size_t end) {
    if (end - begin >= MPM_FEW || (w->order->ties[t] & MPM_AWAITED)) {
        atomic_uint *done = &w->order->done[w->order->flag[t]];
        atomic_store_explicit(done, w->number, memory_order_release);
        mpm_team_tell(w->sim->team, done);
    }
}

// Work that adds to the grid goes by stretches. One waits for those near it that come before it, so
// that every node's sum has one order whatever the number of threads (order.h). Each thread does
// its own part first, then what others are far from. Nobody waits for one that nobody will do: the
// parts' orders are those of one order of all stretches (stretch.c), so that of those that are not
// done the first waits for none, and is always taken by the one whose part it is, if not before.
static void work_on_stretches(const struct particles_work *w, int own, int there) {
    const struct mpm_order *order = w->order;
    struct mpm_span_result found = mpm_nothing_found();
    double since = there > 1 ? now_or_zero(w->sim) : 0;
    size_t work = 0;
    for (int k = 0; k < w->n_parts; k++) {
        const int part = (own + k) % w->n_parts;
        struct mpm_turn *turn = &w->sim->turns[part];
        const size_t begin = order->chunk[w->parts[part]], end = order->chunk[w->parts[part + 1]];
        if (k == 0 && end - begin >= MPM_FEW) {
            begin_turn(turn, begin, end);
        }
        size_t at = begin;
        for (size_t i; next_of_part(turn, k == 0, begin, end, &at, &i);) {
            const uint32_t t = order->share[i], next = order->share[i + 1 < end ? i + 1 : i];
            const struct mpm_stretch *stretch = &order->stretch[t];
            if (there > 1) {
                await_before(w, t, begin, end, &since);
            }
            if (next != t && (w->grid_is_far || order->ties[next])) {
                nodes_ahead(w, t, next, own);
            }
            work_on(w, stretch->begin, stretch->end, order->stretch[next].begin, &found, NULL);
            work += stretch->end - stretch->begin;
            if (there > 1) {
                say_done(w, t, begin, end);
            }
        }
    }
    end_turn(w, own, &found, work, since);
}

// In whole blocks of particles: of one that two stretches share no lane is idle.
static size_t chunk_begin(const struct mpm_order *order, size_t chunk) {
    return order->stretch[order->chunk[chunk]].begin / MPM_BLOCK * MPM_BLOCK;
}

// All other work goes by chunks, in the same parts. They do not take equal time, since what flows
// costs more.
static void work_on_chunks(const struct particles_work *w, int own, int there) {
    const struct mpm_order *order = w->order;
    const size_t n = w->span.s->n;
    if (w->clears_sums) {
        clear_sums(w->sim, own);
    }
    struct mpm_span_result found = mpm_nothing_found();
    double since = there > 1 ? now_or_zero(w->sim) : 0;
    size_t work = 0;
    for (int k = 0; k < w->n_parts; k++) {
        const int part = (own + k) % w->n_parts;
        struct mpm_turn *turn = &w->sim->turns[part];
        const size_t first = w->parts[part], last = w->parts[part + 1];
        if (k == 0 && last - first >= MPM_FEW) {
            begin_turn(turn, first, last);
        }
        size_t at = first;
        for (size_t i; next_of_part(turn, k == 0, first, last, &at, &i);) {
            const size_t end = i + 1 < order->n_chunks ? chunk_begin(order, i + 1) : n;
            const size_t next = chunk_begin(order, i + 1 < last ? i + 1 : first);
            for (uint32_t t = order->chunk[i + 1];
                 w->grid_is_far && i + 1 < last && t < order->chunk[i + 2]; t++) {
                nodes_ahead(w, t - 1, t, own);
            }
            work_on(w, chunk_begin(order, i), end, next, &found, w->mass_dx[i]);
            work += end - chunk_begin(order, i);
        }
    }
    end_turn(w, own, &found, work, since);
}

// A thread's share of work that adds to the grid, or that moves particles: then with m dx of these.
// What is found stays with the threads until the step is over. One body comes after the other.
static void for_particles(struct step_work *step, size_t body, struct particles_work w, int own,
                          int there) {
    struct mpm_sim *sim = step->sim;
    w.span = step->plan.span;
    w.span.s = &sim->sets[body];
    w.span.grid = &sim->grid;
    w.span.fbar = step->plan.fbar && sim->sets[body].wants_fbar;
    w.sim = sim;
    w.order = &sim->orders[body];
    if (body > 0) {
        mpm_team_barrier(sim->team, own, there);
    }
    if (w.order->n_stretches == 0) {
        return;
    }
    w.body = body;
    w.pass = step->pass++;
    w.parts = parts_of(sim, body);
    w.n_parts = there;
    w.mass_dx = mass_dx_of(sim, body);
    w.grid_is_far = grid_bytes_in_use(&sim->grid) > FAR_GRID;
    if (w.adds) {
        w.number = ++step->number;
        work_on_stretches(&w, own, there);
    } else {
        work_on_chunks(&w, own, there);
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

// Adds the time since the end of the last one to a phase.
static void charge(struct mpm_sim *sim, enum mpm_phase phase) {
    const double now = now_or_zero(sim);
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
static void meet(const struct step_work *w, enum mpm_phase done, int own, int there) {
    mpm_team_barrier(w->sim->team, own, there);
    if (own == 0) {
        charge(w->sim, done);
    }
}

// One thread's share of a step's transfers, through which all go side by side.
static void transfers(void *context, int own, int there) {
    struct mpm_sim *sim = context;
    const double *given = sim->team->given;
    struct step_work work = {.sim = sim, .plan = sim->plan, .number = (unsigned)given[GIVEN_PASS]};
    struct step_work *w = &work;
    w->plan.span.dt = w->plan.motion.dt = given[GIVEN_DT];
    memcpy(w->plan.motion.gravity, given + GIVEN_GRAVITY, sizeof w->plan.motion.gravity);

    // P2G, eqs. 7, 8, 10
    if (w->plan.clears_sums) {
        clear_sums(sim, own);
        mpm_team_barrier(sim->team, own, there);
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct particles_work p = {.work = p2g, .uses = USES_SUMS, .adds = true};
        for_particles(w, b, p, own, there);
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
    for (size_t b = 0; b < sim->n_sets; b++) {
        const bool averaged = w->plan.fbar && sim->sets[b].wants_fbar;
        const struct particles_work g = {.work = g2p,
                                         .uses = USES_VELOCITY | (averaged ? USES_FBAR : 0),
                                         .adds = averaged,
                                         .clears_sums = !w->plan.fbar && b == 0};
        for_particles(w, b, g, own, there);
    }
    if (!w->plan.fbar) {
        return;
    }
    meet(w, MPM_PHASE_G2P, own, there);

    // F-bar, eqs. 20-27: Algorithm 1, steps 4 and 5
    divide_nodes(sim, own, there);
    mpm_team_barrier(sim->team, own, there);
    for (size_t b = 0; b < sim->n_sets; b++) {
        if (sim->sets[b].wants_fbar) {
            for_particles(w, b, (struct particles_work){.work = fbar, .uses = USES_FBAR}, own,
                          there);
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
    sim->phase_begin = now_or_zero(sim);
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
    share_out(sim);
    run_transfers(sim, dt, gravity);
    struct mpm_span_result found = mpm_nothing_found();
    join_found(sim, &found);
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
