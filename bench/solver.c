// What the solver costs, and against what: `make bench-solver`.
//
// Machines are noisy, so nothing here is measured alone: the things compared take turns, round by
// round, in one process, and what is printed is the median of the rounds' ratios. Two calibrations
// take their turn, too: independent fused multiply-adds in vectors, and an update in place of an
// array that no cache holds. They say what the machine could do in the same moments, and the limits
// in the table are those of its arithmetic or its memory, from the counts of docs/design.md. One
// thread is timed by its own processor time, so that it does not matter what it had to wait for;
// where two threads are compared, the wall clock counts.
//
// bench-solver [--quick] [--json FILE] [FILTER]: only groups whose name contains FILTER.
#include <math.h>
#include <omp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "bench/bench.h"
#include "server/mpm/basis.h"
#include "server/mpm/kernels.h"

enum { RUBBER, WATER, CLAY, FLOWING, N_MATERIALS };
static const char *const material_names[] = {"neo_hookean", "newtonian", "hencky_j2",
                                             "hencky_j2 flowing"};

bool quick;
static FILE *json;
static const char *filter = "";
static int n_rows, n_failed;

static double read_clock(clockid_t which) {
    struct timespec t;
    clock_gettime(which, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
double now(void) {
    return read_clock(CLOCK_THREAD_CPUTIME_ID);
}
double wall_now(void) {
    return read_clock(CLOCK_MONOTONIC);
}

// ---- Calibration ----

#if defined __x86_64__
#include <immintrin.h>
// Seconds of one fused multiply-add of the widest vectors, with enough of them independent.
// Variables of their own, not an array: that the compiler might keep in memory.
#define EACH_12(X) X(a) X(b) X(c) X(d) X(e) X(f) X(g) X(h) X(i) X(j) X(k) X(l)
#define DECLARE(a) a = y,
#define MULTIPLY_ADD_512(a)                                                                        \
    a = _mm512_fmadd_pd(a, x, y);                                                                  \
    __asm__ volatile("" : "+v"(a));
#define MULTIPLY_ADD_256(a)                                                                        \
    a = _mm256_fmadd_pd(a, x, y);                                                                  \
    __asm__ volatile("" : "+x"(a));
__attribute__((target("avx512f"))) static double fma_512(long n) {
    const __m512d x = _mm512_set1_pd(0.9999999), y = _mm512_set1_pd(1e-9);
    __m512d EACH_12(DECLARE) last;
    const double begin = now();
    for (long left = n; left > 0; left -= 12) {
        EACH_12(MULTIPLY_ADD_512)
    }
    return (void)last, (now() - begin) / (double)n;
}
__attribute__((target("avx2,fma"))) static double fma_256(long n) {
    const __m256d x = _mm256_set1_pd(0.9999999), y = _mm256_set1_pd(1e-9);
    __m256d EACH_12(DECLARE) last;
    const double begin = now();
    for (long left = n; left > 0; left -= 12) {
        EACH_12(MULTIPLY_ADD_256)
    }
    return (void)last, (now() - begin) / (double)n;
}
#endif

// Seconds per multiply-add of one double, in the widest vectors that the kernels use.
double fma_seconds(void) {
#if defined __x86_64__
    if (mpm_isa_available(MPM_ISA_AVX512)) {
        return fma_512(12000000) / 8;
    }
    if (mpm_isa_available(MPM_ISA_AVX2)) {
        return fma_256(12000000) / 4;
    }
#endif
    return NAN;
}

// Seconds per byte that is read or written, of an array of 64 MB updated in place.
static double memory_seconds(void) {
    static double *array;
    const size_t n = 8 << 20;
    if (!array) {
        array = malloc(n * sizeof *array);
        for (size_t i = 0; i < n; i++) { // pages that exist
            array[i] = 1;
        }
    }
    const double t = now();
    for (size_t i = 0; i < n; i++) {
        array[i] = array[i] * 0.5 + 1;
    }
    return (now() - t) / (double)(n * 2 * sizeof *array);
}

// ---- Cases ----

struct block {
    int dim, per_direction, material, n_threads;
    double n; // particles
    enum mpm_basis basis;
    enum mpm_fbar_scheme scheme;
    enum mpm_isa isa;
    double room; // cells of domain beyond the block on every side
    // What a scene may have and not use:
    int n_probes;          // declared, none of them asked for
    bool fbar_once;        // F-bar was on in the first step
    bool fbar_excepted;    // F-bar is on, but the material is excepted
    bool material_besides; // a plastic material that no body has
    bool contact_over;     // a rigid body that the first stage removed
    bool load_over;        // a load that the first stage removed
    bool rigid_far;        // a rigid body out of reach: looked at, block by block
};

static struct world {
    struct mpm_def def;
    struct mpm_material_def materials[2];
    struct mpm_body_def body;
    struct mpm_stage_def stages[2];
    struct mpm_probe_def probes[8];
    struct mpm_rigid_def rigid;
    struct mpm_load_def load;
} worlds[3];
static const bool yes = true;

// A free block in its second free mode along x, v ~ cos(2 pi s/L): it stays where it is, strains
// everywhere, and moves by less than a quarter of a cell, which is where particles of a 2 x 2
// lattice cross. (What crosses with linear functions reaches nodes with next to no mass, and blows
// up with any kernel: a block that drifts is no case for them.)
#define AMPLITUDE 0.3 // m/s; c is about 60 m/s
static struct mpm_sim *create(int which, struct block b) {
    struct world *w = &worlds[which];
    memset(w, 0, sizeof *w);
    static const char *const models[] = {"neo_hookean", "newtonian", "hencky_j2", "hencky_j2"};
    static const double parameters[N_MATERIALS][6] = {
        [RUBBER] = {1000, 1e6, 0.45},
        [WATER] = {1000, 1e6, 1},
        [CLAY] = {1000, 1e6, 0.45, 1e5, 1e5, 0},
        [FLOWING] = {1000, 1e6, 0.45, 10, 5, 3},
    };
    w->def = mpm_def_default();
    const int kinds[] = {b.material, CLAY};
    for (int k = 0; k < 2; k++) {
        w->materials[k] = (struct mpm_material_def){.name = k ? "besides" : "material",
                                                    .model = mpm_material_find(models[kinds[k]]),
                                                    .fbar = !b.fbar_excepted};
        memcpy(w->materials[k].parameters, parameters[kinds[k]], sizeof parameters[0]);
    }
    const int cells = (int)lround(pow(b.n / pow(b.per_direction, b.dim), 1.0 / b.dim));
    w->body = (struct mpm_body_def){.name = "block", .particles_per_direction = b.per_direction};
    for (int d = 0; d < b.dim; d++) {
        w->body.shape.min[d] = 4;
        w->body.shape.max[d] = 4 + cells;
        w->def.domain_max[d] = cells + 8 + b.room;
    }
    w->body.velocity = (struct mpm_velocity){
        .kind = MPM_VELOCITY_MODE,
        .number = 1,
        .from = 4 - cells / 4.0,
        .length = cells / 4.0,
        // Nothing stops what flows.
        .amplitude = b.material == WATER || b.material == FLOWING ? AMPLITUDE / 10 : AMPLITUDE};
    for (int k = 0; k < b.n_probes; k++) {
        w->probes[k] = (struct mpm_probe_def){
            .name = "probe", .kind = MPM_PROBE_ENERGY, .body = -1, .scale = 1};
    }
    w->rigid = (struct mpm_rigid_def){.name = "plate", .stiffness = 1e3, .distance = 0.01};
    for (int d = 0; d < b.dim; d++) {
        w->rigid.shape.min[d] = d == 0 ? cells + 6.5 : 4;
        w->rigid.shape.max[d] = d == 0 ? cells + 7.5 : 4 + cells;
    }
    w->load = (struct mpm_load_def){.name = "pull", .max_side = true, .force = {1e-9}};
    const bool over = b.contact_over || b.load_over;
    w->stages[0] = (struct mpm_stage_def){.name = "first", .duration = 1e-9};
    w->stages[1] = (struct mpm_stage_def){.name = "main",
                                          .duration = 1e9,
                                          .removes_rigid = b.contact_over ? &yes : NULL,
                                          .removes_load = b.load_over ? &yes : NULL};
    w->def.dimension = b.dim;
    w->def.cell = 1;
    w->def.basis = b.basis;
    w->def.settings.fbar.scheme = b.scheme;
    w->def.isa = b.isa;
    w->def.n_threads = b.n_threads;
    w->def.clock = now;
    w->def.n_materials = b.material_besides ? 2 : 1;
    w->def.n_bodies = 1;
    w->def.n_stages = over ? 2 : 1;
    w->def.n_rigids = b.contact_over || b.rigid_far;
    w->def.n_loads = b.load_over;
    w->def.rigids = &w->rigid;
    w->def.loads = &w->load;
    w->def.n_probes = (size_t)b.n_probes;
    w->def.probes = w->probes;
    w->def.materials = w->materials;
    w->def.bodies = &w->body;
    w->def.stages = over ? w->stages : w->stages + 1;
    struct mpm_sim *sim = NULL;
    struct mpm_error err = {0};
    struct mpm_settings on = w->def.settings;
    on.fbar.scheme = MPM_FBAR_ZHAO;
    if (mpm_create(&w->def, &sim, &err) ||
        (b.fbar_once && (mpm_change(sim, &on, MPM_SET_FBAR, &err) || mpm_step(sim, &err) ||
                         mpm_change(sim, &w->def.settings, MPM_SET_FBAR, &err))) ||
        (over && mpm_step(sim, &err))) {
        printf("FAILED: %s %s\n", err.pointer, err.message);
        n_failed++;
        mpm_free(sim);
        return NULL;
    }
    return sim;
}

// Seconds per particle and step, of steps that take about the time given. A case that fails says
// so, and gives NaN; the others go on.
struct turn {
    double (*clock)(void);
    struct mpm_sim *sim;
    double seconds, a_step; // a_step: of them and a particle
};
static void take_turn(void *context) {
    struct turn *turn = context;
    struct mpm_error err = {0};
    const double t = turn->clock();
    int steps = 0;
    do {
        if (mpm_step(turn->sim, &err)) {
            printf("FAILED: %s\n", err.message);
            n_failed++;
            turn->a_step = NAN;
            return;
        }
        steps++;
    } while (turn->clock() - t < turn->seconds);
    turn->a_step = (turn->clock() - t) / (double)mpm_n_particles(turn->sim) / steps;
}
// As the daemon runs it: threads stand by between the steps.
static double timed_by(double (*clock)(void), struct mpm_sim *sim, double seconds) {
    struct turn turn = {.clock = clock, .sim = sim, .seconds = seconds};
    mpm_hold(sim, take_turn, &turn);
    return turn.a_step;
}
double timed(struct mpm_sim *sim, double seconds) {
    return timed_by(sim->def->n_threads > 1 ? wall_now : now, sim, seconds);
}

static int by_value(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}
double median(const double *values, int n) {
    double sorted[MAX_ROUNDS];
    memcpy(sorted, values, (size_t)n * sizeof *sorted);
    qsort(sorted, (size_t)n, sizeof *sorted, by_value);
    return n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) / 2;
}

static double least(const double *values, int n) {
    double found = INFINITY;
    for (int k = 0; k < n; k++) {
        found = fmin(found, values[k]);
    }
    return found;
}

static double bytes_per_particle(const struct mpm_sim *sim) {
    return (double)mpm_bytes(sim) / (double)mpm_n_particles(sim);
}

void open_row(const char *group) {
    fprintf(json, "%s\n  {\"group\": \"%s\"", n_rows++ ? "," : "", group);
}
void number(const char *key, double value) {
    if (isfinite(value)) {
        fprintf(json, ", \"%s\": %.6g", key, value);
    }
}
void text(const char *key, const char *value) {
    fprintf(json, ", \"%s\": \"%s\"", key, value);
}
static void describe(struct block b, size_t n) {
    number("dimension", b.dim);
    number("particles_per_cell", pow(b.per_direction, b.dim));
    number("particles", (double)n);
    text("basis", mpm_basis_name(b.basis));
    text("fbar", mpm_fbar_name(b.scheme));
    text("material", material_names[b.material]);
    text("isa", mpm_isa_name(mpm_isa_in_use(b.isa)));
    number("threads", b.n_threads);
}

void close_row(void) {
    fprintf(json, "}");
    fflush(json);
    fflush(stdout);
}
bool wanted(const char *group) {
    return strstr(group, filter) != NULL;
}

bool asked_for(const char *group) {
    return strcmp(filter, group) == 0;
}

// ---- Kernels against the plain ones ----

// Multiply-adds of one double and bytes that a particle takes at the least (docs/design.md), with
// three nodes along each direction.
struct limit {
    double flops, bytes;
};
static struct limit limit_of(struct block b) {
    const bool fbar = b.scheme != MPM_FBAR_OFF;
    return b.dim == 2 ? (struct limit){fbar ? 315 : 240, fbar ? 320 : 144}
                      : (struct limit){fbar ? 1150 : 960, fbar ? 520 : 256};
}

// What is asked for: times as fast as the plain kernels, 0 = nothing; and, where the machine of the
// goals has been measured (2.4 GHz with AVX-512, 0.21 ns a multiply-add), ns there and the limit
// there in ns: so the goals in percent of that machine's limit, which no other machine's clock, or
// plain kernel, changes.
struct goal {
    double times, ns, limit;
};

static const char *verdict_of(double times, double goal) {
    return times >= goal ? "goal met" : times >= goal / 1.25 ? "gate met" : "missed";
}

static void kernel_row(const char *group, struct block b, struct goal goal) {
    const int rounds = quick ? 3 : 9;
    const double turn = quick ? 0.03 : 0.06;
    struct block plain = b;
    plain.isa = MPM_ISA_BASELINE;
    struct mpm_sim *fast = create(0, b), *slow = create(1, plain);
    if (!fast || !slow) {
        mpm_free(fast);
        mpm_free(slow);
        return;
    }
    double ns[MAX_ROUNDS], slow_ns[MAX_ROUNDS], ratio[MAX_ROUNDS], fma[MAX_ROUNDS],
        memory[MAX_ROUNDS];
    timed(fast, turn / 2);
    timed(slow, turn / 2);
    for (int r = 0; r < rounds; r++) {
        const double f = timed(fast, turn), s = timed(slow, turn);
        ns[r] = 1e9 * f;
        slow_ns[r] = 1e9 * s;
        ratio[r] = s / f;
        fma[r] = 1e9 * fma_seconds();
        memory[r] = 1e9 * memory_seconds();
    }
    const double times = median(ratio, rounds), wanted_share = goal.limit / goal.ns;
    // Of the best that the machine did in these moments, since others use its memory, too.
    const struct limit limit = limit_of(b);
    const double through_memory =
        (double)mpm_bytes(fast) < 8e6 ? 0 : limit.bytes * least(memory, rounds);
    const double share =
        mpm_support(b.basis) == 3
            ? fmax(limit.flops * least(fma, rounds), through_memory) / median(ns, rounds)
            : NAN;
    char percent[16] = "  -";
    if (isfinite(share)) {
        snprintf(percent, sizeof percent, "%3.0f %%", 100 * share);
    }
    printf("%dD %2.0f/cell %7zu %-8s %-8s %-17s %-6s %6.1f ns %5.1f M/s %5.2fx plain %s of "
           "limit %4.0f B",
           b.dim, pow(b.per_direction, b.dim), mpm_n_particles(fast), mpm_basis_name(b.basis),
           mpm_fbar_name(b.scheme), material_names[b.material], mpm_isa_name(fast->isa),
           median(ns, rounds), 1e3 / median(ns, rounds), times, percent, bytes_per_particle(fast));
    if (goal.times > 0) {
        printf("  %s (goal %.1fx, gate %.1fx", verdict_of(times, goal.times), goal.times,
               goal.times / 1.25);
        if (goal.ns > 0) {
            printf("; there %.0f ns, %.0f %% of limit", goal.ns, 100 * wanted_share);
        }
        printf(")");
    }
    puts("");
    open_row(group);
    describe(b, mpm_n_particles(fast));
    number("ns_per_particle_step", median(ns, rounds));
    number("plain_ns_per_particle_step", median(slow_ns, rounds));
    number("times_plain", times);
    number("share_of_limit", share);
    number("fma_ns", median(fma, rounds));
    number("ns_per_byte_in_place", median(memory, rounds));
    number("bytes_per_particle", bytes_per_particle(fast));
    if (goal.times > 0) {
        number("goal_times_plain", goal.times);
        text("verdict", verdict_of(times, goal.times));
    }
    if (goal.ns > 0) {
        number("goal_ns_on_the_machine_of_the_goals", goal.ns);
        number("goal_share_of_limit", wanted_share);
    }
    close_row();
    mpm_free(fast);
    mpm_free(slow);
}

static struct block block_of(int dim, int per_direction, double n, enum mpm_fbar_scheme scheme) {
    return (struct block){.dim = dim,
                          .per_direction = per_direction,
                          .n = n,
                          .basis = MPM_BSPLINE2,
                          .scheme = scheme,
                          .n_threads = 1};
}

static void kernels(void) {
    if (!wanted("kernels")) {
        return;
    }
    puts("\nKernels: the machine's best against the plain scalar ones of the same binary");
    // Goals: standard, F-bar.
    static const struct {
        int dim, per_direction;
        double n;
        struct goal goal[2];
    } cases[] = {
        {2, 2, 1e4, {{6, 18, 6.2}, {5.3, 27, 8.2}}}, {2, 2, 1e5, {{6, 0, 0}, {5.3, 0, 0}}},
        {2, 2, 1e6, {{6, 23, 7.7}, {5.3, 36, 17}}},  {2, 4, 1e4, {{7.5, 13, 6.2}, {7, 20, 8.2}}},
        {2, 4, 1e5, {{7.5, 0, 0}, {7, 0, 0}}},       {2, 4, 1e6, {{7.5, 0, 0}, {7, 0, 0}}},
        {3, 2, 1e5, {{6, 57, 25}, {6, 78, 30}}},     {3, 2, 1e6, {{6, 60, 25}, {6, 84, 30}}}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            if (quick && cases[k].n > 1e5) {
                continue;
            }
            kernel_row("kernels",
                       block_of(cases[k].dim, cases[k].per_direction, cases[k].n,
                                (enum mpm_fbar_scheme)scheme),
                       cases[k].goal[scheme > 0]);
        }
    }
    puts("\nOther bases");
    for (int dim = 2; dim <= 3; dim++) {
        static const enum mpm_basis bases[] = {MPM_LINEAR, MPM_GIMP, MPM_BSPLINE3};
        for (int k = 0; k < 3; k++) {
            struct block b = block_of(dim, 2, dim == 2 ? 1e4 : 1e5, MPM_FBAR_ZHAO);
            b.basis = bases[k];
            kernel_row("bases", b, (struct goal){0});
        }
    }
    puts("\nOther materials");
    for (int dim = 2; dim <= 3; dim++) {
        for (int material = WATER; material < N_MATERIALS; material++) {
            struct block b = block_of(dim, 2, dim == 2 ? 1e4 : 1e5, MPM_FBAR_ZHAO);
            b.material = material;
            kernel_row("materials", b, (struct goal){0});
        }
    }
    if (mpm_isa_in_use(MPM_ISA_AUTO) == MPM_ISA_AVX512) {
        puts("\nAVX2");
        for (int k = 0; k < 4; k++) {
            struct block b =
                block_of(2 + k / 2, 2, k < 2 ? 1e4 : 1e5, k % 2 ? MPM_FBAR_ZHAO : MPM_FBAR_OFF);
            b.isa = MPM_ISA_AVX2;
            kernel_row("avx2", b, (struct goal){.times = k < 2 ? 4 : 4.5});
        }
    }
}

static void stages(void) {
    if (!wanted("stages") || mpm_isa_in_use(MPM_ISA_AUTO) == MPM_ISA_BASELINE) {
        return;
    }
    for (int k = 0; k < 4; k++) {
        struct block b =
            block_of(2 + k / 2, 2, k < 2 ? 1e4 : 1e5, k % 2 ? MPM_FBAR_ZHAO : MPM_FBAR_OFF);
        struct mpm_sim *sim = create(0, b);
        printf(
            "\nStages of the passes, %dD, B-spline, F-bar %s: ns a particle, each what it adds\n",
            b.dim, mpm_fbar_name(b.scheme));
        if (sim) {
            stages_of(sim);
        }
        mpm_free(sim);
    }
}

// ---- One against another ----

double pair_of(struct mpm_sim *one, struct mpm_sim *other, double *ns) {
    const int rounds = quick ? 5 : 15;
    const double turn = quick ? 0.02 : 0.05;
    double ratio[MAX_ROUNDS], first[MAX_ROUNDS];
    double (*const clock)(void) = now;
    timed(one, turn);
    timed(other, turn);
    for (int r = 0; r < rounds; r++) { // who begins takes turns, too
        double x, y;
        if (r % 2) {
            y = timed_by(clock, other, turn);
            x = timed_by(clock, one, turn);
        } else {
            x = timed_by(clock, one, turn);
            y = timed_by(clock, other, turn);
        }
        ratio[r] = x / y;
        first[r] = 1e9 * x;
    }
    *ns = median(first, rounds);
    return median(ratio, rounds);
}

double threads_pair(struct mpm_sim *two, struct mpm_sim *const one[2], double *ns) {
    const int rounds = quick ? 5 : MAX_ROUNDS;
    const double turn = quick ? 0.02 : 0.05;
    double ratio[MAX_ROUNDS], shared[MAX_ROUNDS];
    timed_by(wall_now, two, turn);
    for (int r = 0; r < rounds; r++) {
        double apart[2] = {0};
        const double x = timed_by(wall_now, two, turn);
#pragma omp parallel for num_threads(2) schedule(static, 1)
        for (int k = 0; k < 2; k++) {
            apart[k] = timed_by(wall_now, one[k], turn);
        }
        shared[r] = 1e9 * x;
        ratio[r] = x / (0.5 * (apart[0] + apart[1]));
    }
    *ns = median(shared, rounds);
    return median(ratio, rounds);
}

#define CALLS 20000

double line_there_and_back(void) {
    static struct { _Alignas(64) atomic_uint word; } to[2];
    double seconds = NAN;
    atomic_store(&to[0].word, 0);
    atomic_store(&to[1].word, 0);
#pragma omp parallel num_threads(2)
    {
        const int own = omp_get_thread_num();
        const double t = wall_now();
        for (unsigned k = 1; omp_get_num_threads() == 2 && k <= CALLS; k++) {
            if (own == 0) {
                atomic_store_explicit(&to[1].word, k, memory_order_release);
            }
            while (atomic_load_explicit(&to[own].word, memory_order_acquire) != k) {
            }
            if (own == 1) {
                atomic_store_explicit(&to[0].word, k, memory_order_release);
            }
        }
        if (own == 0 && omp_get_num_threads() == 2) {
            seconds = (wall_now() - t) / CALLS;
        }
    }
    return seconds;
}

void verdict_row(const char *group, const char *what, double ns, double ratio, double most) {
    printf("%-66s %7.1f ns  ratio %.3f  %s (at most %.2f)\n", what, ns, ratio,
           ratio <= most ? "met" : "MISSED", most);
    open_row(group);
    text("what", what);
    number("ns_per_particle_step", ns);
    number("ratio", ratio);
    number("at_most", most);
    text("verdict", ratio <= most ? "met" : "missed");
}

static void pair_row(const char *group, const char *what, struct block one, struct block other,
                     double most) {
    struct mpm_sim *a = create(0, one), *b = create(1, other);
    if (a && b) {
        double ns;
        const double ratio = pair_of(a, b, &ns);
        verdict_row(group, what, ns, ratio, most);
        describe(one, mpm_n_particles(a));
        number("bytes_per_particle", bytes_per_particle(a));
        number("bytes_per_particle_of_the_other", bytes_per_particle(b));
        close_row();
    }
    mpm_free(a);
    mpm_free(b);
}

static void ratios(void) {
    if (!wanted("ratios")) {
        return;
    }
    puts("\nOne against another, in turns");
    const struct block std2 = block_of(2, 2, 1e4, MPM_FBAR_OFF),
                       std3 = block_of(3, 2, 1e5, MPM_FBAR_OFF);
    struct block one = std2, other = std2;
    one.scheme = MPM_FBAR_ZHAO;
    pair_row("ratios", "zhao / standard, 2D in cache", one, std2, 1.55);
    other = one;
    one.scheme = MPM_FBAR_ANCHORED;
    pair_row("ratios", "anchored / zhao, 2D", one, other, 1.10);
    one = other = std3;
    one.scheme = MPM_FBAR_ZHAO;
    pair_row("ratios", "zhao / standard, 3D", one, other, 1.4);
    other = one;
    one.scheme = MPM_FBAR_ANCHORED;
    pair_row("ratios", "anchored / zhao, 3D", one, other, 1.10);
    for (int dim = 2; dim <= 3; dim++) {
        one = other = block_of(dim, 2, dim == 2 ? 1e4 : 1e5, MPM_FBAR_ZHAO);
        one.basis = MPM_GIMP;
        pair_row("ratios", dim == 2 ? "uGIMP / B-spline, 2D" : "uGIMP / B-spline, 3D", one, other,
                 1.05);
        one = other;
        one.material = CLAY;
        pair_row("ratios",
                 dim == 2 ? "Hencky + J2, elastic / neo-Hookean, 2D"
                          : "Hencky + J2, elastic / neo-Hookean, 3D",
                 one, other, 1.5);
        one.material = FLOWING;
        pair_row("ratios",
                 dim == 2 ? "Hencky + J2, all flowing / neo-Hookean, 2D"
                          : "Hencky + J2, all flowing / neo-Hookean, 3D",
                 one, other, 1.5);
    }
}

static void threads(void) {
    if (!wanted("threads")) {
        return;
    }
    puts("\nTwo threads against one, both cores at work");
    for (int dim = 2; dim <= 3; dim++) {
        const struct block alone = block_of(dim, 2, 1e5, MPM_FBAR_ZHAO);
        struct block shared = alone;
        shared.n_threads = 2;
        struct mpm_sim *two = create(0, shared), *one[2] = {create(1, alone), create(2, alone)};
        if (two && one[0] && one[1]) {
            double ns;
            const double ratio = threads_pair(two, one, &ns);
            verdict_row("threads",
                        dim == 2 ? "two threads / one, 2D, 100k" : "two threads / one, 3D, 100k",
                        ns, ratio, 0.55);
            describe(shared, mpm_n_particles(two));
            number("line_there_and_back_ns", 1e9 * line_there_and_back());
            close_row();
        }
        mpm_free(two);
        mpm_free(one[0]);
        mpm_free(one[1]);
    }
}

// What a scene does not use costs it nothing: each against the same block without it.
static void features(void) {
    if (!wanted("features")) {
        return;
    }
    puts("\nOnly what a scene needs: declared and not used, against not there");
    const struct block std2 = block_of(2, 2, 1e4, MPM_FBAR_OFF);
    pair_row("features", "nothing: the block against itself, which is the noise", std2, std2, 1.02);
    struct block one = std2;
    one.n_probes = 8;
    pair_row("features", "8 probes, none due", one, std2, 1.02);
    one = std2;
    one.fbar_once = true;
    pair_row("features", "F-bar, switched off again", one, std2, 1.02);
    one = std2;
    one.scheme = MPM_FBAR_ZHAO;
    one.fbar_excepted = true;
    pair_row("features", "F-bar, from which the material is excepted", one, std2, 1.02);
    one = std2;
    one.material_besides = true;
    pair_row("features", "a plastic material that no body has", one, std2, 1.02);
    one = std2;
    one.contact_over = true;
    pair_row("features", "a rigid body that a stage removed", one, std2, 1.02);
    one = std2;
    one.load_over = true;
    pair_row("features", "a load that a stage removed", one, std2, 1.02);
    one = std2;
    one.rigid_far = true;
    pair_row("features", "a rigid body out of reach (in use: it is looked for)", one, std2, 1.1);
    one = block_of(2, 2, 1e3, MPM_FBAR_ZHAO);
    struct block wide = one;
    wide.room = 1000;
    pair_row("features", "1,000 particles in 1,000 x 1,000 cells / in a tight domain", wide, one,
             1.15);
    struct mpm_sim *sim = create(0, wide);
    if (sim) {
        printf("  all of it in the wide domain: %.2f MB\n", 1e-6 * (double)mpm_bytes(sim));
    }
    mpm_free(sim);

    puts("Bytes a particle, with its share of the grid: 2D and 3D, 100k, 4 and 8 per cell");
    for (int material = RUBBER; material < FLOWING; material++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            double bytes[2] = {0};
            for (int dim = 2; dim <= 3; dim++) {
                struct block b = block_of(dim, 2, 1e5, (enum mpm_fbar_scheme)scheme);
                b.material = material;
                sim = create(0, b);
                bytes[dim - 2] = sim ? bytes_per_particle(sim) : NAN;
                mpm_free(sim);
                open_row("bytes");
                describe(b, (size_t)b.n);
                number("bytes_per_particle", bytes[dim - 2]);
                close_row();
            }
            printf("  %-12s %-8s %4.0f %4.0f\n", material_names[material],
                   mpm_fbar_name((enum mpm_fbar_scheme)scheme), bytes[0], bytes[1]);
        }
    }
}

static void sorting(void) {
    if (!wanted("sort")) {
        return;
    }
    puts("\nSorting: one sort against one step");
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_sim *sim = create(0, block_of(dim, 2, 1e5, MPM_FBAR_ZHAO));
        if (!sim) {
            continue;
        }
        double steps[MAX_ROUNDS];
        const int rounds = quick ? 3 : 9;
        timed(sim, 0.05);
        for (int r = 0; r < rounds; r++) {
            const double step = timed(sim, 0.05) * (double)mpm_n_particles(sim);
            const double t = now();
            mpm_sort(sim);
            steps[r] = (now() - t) / step;
        }
        printf("%dD, 100k: a sort that finds all in order takes %.2f steps\n", dim,
               median(steps, rounds));
        open_row("sort");
        number("dimension", dim);
        number("steps_per_sort", median(steps, rounds));
        close_row();
        mpm_free(sim);
    }
}

static void growth(void) {
    if (!wanted("growth")) {
        return;
    }
    puts("\nGrowth: 2D, 4 per cell, B-spline, zhao");
    for (double n = 1e4; n <= (quick ? 1e6 : 1e7); n *= 10) {
        struct mpm_sim *sim = create(0, block_of(2, 2, n, MPM_FBAR_ZHAO));
        if (!sim) {
            continue;
        }
        double ns[5];
        timed(sim, 0.05);
        for (int r = 0; r < 5; r++) {
            ns[r] = 1e9 * timed(sim, 0.1);
        }
        printf("%9zu particles: %.1f ns, %.1f M particle-steps/s, %.0f B a particle\n",
               mpm_n_particles(sim), median(ns, 5), 1e3 / median(ns, 5), bytes_per_particle(sim));
        fflush(stdout);
        open_row("growth");
        number("particles", (double)mpm_n_particles(sim));
        number("ns_per_particle_step", median(ns, 5));
        number("bytes_per_particle", bytes_per_particle(sim));
        close_row();
        mpm_free(sim);
    }
}

int main(int argc, char **argv) {
    const char *path = "/dev/null";
    for (int k = 1; k < argc; k++) {
        if (strcmp(argv[k], "--quick") == 0) {
            quick = true;
        } else if (strcmp(argv[k], "--json") == 0 && k + 1 < argc) {
            path = argv[++k];
        } else if (argv[k][0] == '-') {
            fprintf(stderr,
                    "usage: bench-solver [--quick] [--json FILE] [GROUP]\n"
                    "groups: kernels stages ratios threads features sort growth scenes; and, "
                    "only where it is named, runout\n");
            return 2;
        } else {
            filter = argv[k];
        }
    }
    json = fopen(path, "w");
    if (!json) {
        perror(path);
        return 1;
    }
    fprintf(json, "[");
    printf("calibration: %.3f ns for a multiply-add of the widest vectors, %.1f GB/s updated in "
           "place\n",
           1e9 * fma_seconds() * (mpm_isa_available(MPM_ISA_AVX512) ? 8 : 4),
           1e-9 / memory_seconds());
    open_row("calibration");
    number("multiply_add_ns", 1e9 * fma_seconds() * (mpm_isa_available(MPM_ISA_AVX512) ? 8 : 4));
    number("in_place_gb_s", 1e-9 / memory_seconds());
    close_row();
    kernels();
    stages();
    ratios();
    threads();
    features();
    sorting();
    growth();
    scenes();
    fprintf(json, "\n]\n");
    if (n_failed > 0) {
        printf("\n%d cases FAILED: their rows are missing or of what was measured before\n",
               n_failed);
    }
    return fclose(json) || n_failed > 0;
}
