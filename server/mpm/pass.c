// Who works on which particles, and what comes before what: parts of a body's stretches and chunks
// (order.h), which follow the threads' speeds; within them waiting, taking over and looking ahead.
#include "server/mpm/pass.h"

#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

#include "server/mpm/basis.h"

#define FAR_GRID ((size_t)4 << 20) // bytes: what a core has of its caches holds less

bool mpm_grid_is_far(const struct mpm_grid *g) {
    const size_t width = MPM_NODE + (size_t)MPM_VELOCITY(g->dim);
    return g->n_slots * (size_t)MPM_BLOCK_NODES(g->dim) * width * sizeof(double) > FAR_GRID;
}

double mpm_now_or_zero(const struct mpm_sim *sim) {
    return sim->def->clock ? sim->def->clock() : 0;
}

static uint32_t *parts_of(const struct mpm_sim *sim, size_t body) {
    return sim->parts + body * ((size_t)sim->def->n_threads + 1);
}

#define SHARE_STEPS 64 // after which work is shared out anew without a sort

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

void mpm_share_out(struct mpm_sim *sim) {
    const int n = sim->team->n_there;
    if (sim->n_shared == n && (n == 1 || ++sim->steps_shared < SHARE_STEPS)) {
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
    sim->steps_shared = 0;
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

// A thread's share of a pass.
struct part_work {
    const struct mpm_pass *pass;
    const struct mpm_sim *sim;
    const struct mpm_order *order;
    struct mpm_span span;
    size_t body;
    int number;            // of the pass in the step, from 0
    unsigned adding;       // that no pass before had, of those that add to the grid
    const uint32_t *parts; // (n_parts + 1) first chunk of each
    int n_parts;           // one a thread
    bool grid_is_far;
    double (*mass_dx)[MPM_MAX_DIM]; // of the body's chunks
};

static void work_on(const struct part_work *w, size_t begin, size_t end, size_t next,
                    struct mpm_span_result *found, double *mass_dx) {
    struct mpm_span span = w->span;
    struct mpm_span_result result;
    span.begin = begin;
    span.end = end;
    span.next = next;
    w->pass->work(&span, &result);
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

// What a thread has found in the step so far, on how many particles, and since when: for
// follow_speeds. Of faults the first pass' counts.
static void end_turn(const struct part_work *w, int own, struct mpm_span_result *found, size_t work,
                     double since) {
    struct mpm_turn *turn = &w->sim->turns[own];
    if (w->number == 0) {
        turn->found = *found;
        turn->fault_pass = 0;
        turn->fault_body = w->body;
    } else {
        if (turn->found.bad != SIZE_MAX) {
            found->bad = SIZE_MAX;
        } else {
            turn->fault_pass = w->number;
            turn->fault_body = w->body;
        }
        join(&turn->found, found, w->span.s->dim);
    }
    if (since > 0) {
        turn->work += (double)work;
        turn->seconds += mpm_now_or_zero(w->sim) - since;
    }
}

static double (*mass_dx_of(const struct mpm_sim *sim, size_t body))[MPM_MAX_DIM] {
    return sim->mass_dx + sim->sets[body].first_id / MPM_FEWEST + body;
}

void mpm_join_found(const struct mpm_sim *sim, struct mpm_span_result *joined) {
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

// The nodes of a stretch that comes next, after t, on the way to the cache: of other blocks than
// t's all, where the grid is too large to have stayed there; those that other threads have just
// changed, which are theirs; and, if it waits for them, those of its blocks.
static void nodes_ahead(const struct part_work *w, uint32_t t, uint32_t next, int own) {
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
            if (w->pass->uses & MPM_USES_SUMS) {
                lines_ahead(g->node, first, n, MPM_NODE, true);
            }
            if (w->pass->uses & MPM_USES_FBAR) {
                lines_ahead(g->fbar, first, n, g->fbar_stride, w->pass->adds);
            }
            if (w->pass->uses & MPM_USES_VELOCITY) {
                lines_ahead(g->velocity, first, n, MPM_VELOCITY(g->dim), false);
            }
        }
    }
}

// Waits until those are done that come before a stretch of the part [begin, end), and are not
// surely done by who comes to it. Adds the seconds that it takes to *since.
static void await_before(const struct part_work *w, int own, uint32_t t, size_t begin, size_t end,
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
             (pass = atomic_load_explicit(done, memory_order_acquire)) != w->adding;) {
            const double waits = mpm_now_or_zero(w->sim);
            mpm_team_await(w->sim->team, own, done, pass);
            *since += mpm_now_or_zero(w->sim) - waits;
        }
    }
}

// What nobody looks at is not said: each time, the flags' cache line has to come back from who has
// looked last.
static void say_done(const struct part_work *w, uint32_t t, size_t begin, size_t end) {
    if (end - begin >= MPM_FEW || (w->order->ties[t] & MPM_AWAITED)) {
        atomic_uint *done = &w->order->done[w->order->flag[t]];
        atomic_store_explicit(done, w->adding, memory_order_release);
        mpm_team_tell(w->sim->team, done);
    }
}

// A thread on its way through the parts.
struct walk {
    int own, there;
    size_t begin, end; // of the part that it is in: stretches, or chunks
    struct mpm_span_result found;
    double since; // s, when it began, and what it has waited since
};

// Work that adds to the grid goes by stretches. One waits for those near it that come before it, so
// that every node's sum has one order whatever the number of threads (order.h). Each thread does
// its own part first, then what others are far from. Nobody waits for one that nobody will do: the
// parts' orders are those of one order of all stretches (stretch.c), so that of those that are not
// done the first waits for none, and is always taken by the one whose part it is, if not before.
// Returns how many particles that were.
static size_t work_on_stretch(const struct part_work *w, struct walk *walk, size_t i) {
    const struct mpm_order *order = w->order;
    const size_t begin = walk->begin, end = walk->end;
    const uint32_t t = order->share[i], next = order->share[i + 1 < end ? i + 1 : i];
    const struct mpm_stretch *stretch = &order->stretch[t];
    if (walk->there > 1) {
        await_before(w, walk->own, t, begin, end, &walk->since);
    }
    if (next != t && (w->grid_is_far || order->ties[next])) {
        nodes_ahead(w, t, next, walk->own);
    }
    work_on(w, stretch->begin, stretch->end, order->stretch[next].begin, &walk->found, NULL);
    if (walk->there > 1) {
        say_done(w, t, begin, end);
    }
    return stretch->end - stretch->begin;
}

// In whole blocks of particles: of one that two stretches share no lane is idle.
static size_t chunk_begin(const struct mpm_order *order, size_t chunk) {
    return order->stretch[order->chunk[chunk]].begin / MPM_BLOCK * MPM_BLOCK;
}

// All other work goes by chunks, in the same parts. They do not take equal time, since what flows
// costs more.
static size_t work_on_chunk(const struct part_work *w, struct walk *walk, size_t i) {
    const struct mpm_order *order = w->order;
    const bool last_of_part = i + 1 == walk->end;
    const size_t begin = chunk_begin(order, i);
    const size_t end = i + 1 < order->n_chunks ? chunk_begin(order, i + 1) : w->span.s->n;
    const size_t next = chunk_begin(order, last_of_part ? walk->begin : i + 1);
    for (uint32_t t = order->chunk[i + 1];
         w->grid_is_far && !last_of_part && t < order->chunk[i + 2]; t++) {
        nodes_ahead(w, t - 1, t, walk->own);
    }
    work_on(w, begin, end, next, &walk->found, w->mass_dx[i]);
    return end - begin;
}

static void work_on_parts(const struct part_work *w, int own, int there) {
    const bool adds = w->pass->adds;
    struct walk walk = {.own = own,
                        .there = there,
                        .found = mpm_nothing_found(),
                        .since = there > 1 ? mpm_now_or_zero(w->sim) : 0};
    size_t work = 0;
    for (int k = 0; k < w->n_parts; k++) {
        const int part = (own + k) % w->n_parts;
        const uint32_t first = w->parts[part], last = w->parts[part + 1];
        struct mpm_turn *turn = &w->sim->turns[part];
        walk.begin = adds ? w->order->chunk[first] : first;
        walk.end = adds ? w->order->chunk[last] : last;
        if (k == 0 && walk.end - walk.begin >= MPM_FEW) {
            begin_turn(turn, walk.begin, walk.end);
        }
        size_t at = walk.begin;
        for (size_t i; next_of_part(turn, k == 0, walk.begin, walk.end, &at, &i);) {
            work += adds ? work_on_stretch(w, &walk, i) : work_on_chunk(w, &walk, i);
        }
    }
    end_turn(w, own, &walk.found, work, walk.since);
}

void mpm_pass(struct mpm_step_work *step, size_t body, const struct mpm_pass *pass, int own,
              int there) {
    struct mpm_sim *sim = step->sim;
    struct part_work w = {.pass = pass,
                          .sim = sim,
                          .order = &sim->orders[body],
                          .span = step->plan.span,
                          .body = body,
                          .parts = parts_of(sim, body),
                          .n_parts = there,
                          .grid_is_far = mpm_grid_is_far(&sim->grid),
                          .mass_dx = mass_dx_of(sim, body)};
    w.span.s = &sim->sets[body];
    w.span.grid = &sim->grid;
    w.span.fbar = step->plan.fbar && sim->sets[body].wants_fbar;
    if (body > 0) {
        mpm_team_barrier(sim->team, own, there);
    }
    if (w.order->n_stretches == 0) {
        return;
    }
    w.number = step->pass++;
    if (pass->adds) {
        w.adding = ++step->number;
    }
    work_on_parts(&w, own, there);
}
