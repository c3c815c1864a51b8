// Kernels in lanes against the plain ones, for every combination; and the same bits for any number
// of threads, with sorts on the way, and whoever does what.
#include <math.h>
#include <sched.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/pass.h"

#define H 0.125
enum { RUBBER, FLUID, CLAY, N_KINDS };

static struct {
    struct mpm_def def;
    struct mpm_material_def material;
    struct mpm_body_def body;
    struct mpm_stage_def stage;
    struct mpm_wall_def walls[3];
} world;

static uint64_t seed;
static double uniform(void) { // [-1, 1)
    seed = seed * 6364136223846793005 + 1442695040888963407;
    return (double)(int64_t)seed / 9223372036854775808.0;
}

static double bulk_modulus(int kind) {
    const double *par = world.material.parameters;
    return kind == FLUID ? par[1] : par[1] / (3 * (1 - 2 * par[2]));
}

// A block in a corner of two walls, of `cells` cells a side.
static void define(int dim, int basis, int scheme, int kind, int cells, int per_direction) {
    static const struct mpm_material_def materials[N_KINDS] = {
        [RUBBER] = {.model = NULL, .parameters = {1000, 1e5, 0.45}},
        [FLUID] = {.model = NULL, .parameters = {1000, 1e5, 5}},
        [CLAY] = {.model = NULL, .parameters = {1000, 1e5, 0.45, 300, 100, 10}},
    };
    static const char *const models[] = {"neo_hookean", "newtonian", "hencky_j2"};
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    world.material = materials[kind];
    world.material.name = "material";
    world.material.model = mpm_material_find(models[kind]);
    world.material.fbar = true;
    world.body = (struct mpm_body_def){.name = "block", .particles_per_direction = per_direction};
    for (int d = 0; d < dim; d++) {
        world.body.shape.max[d] = cells * H;
        world.def.domain_min[d] = -H;
        world.def.domain_max[d] = (2 * cells + 4) * H;
        world.walls[d] = (struct mpm_wall_def){.name = "wall",
                                               .axis = d,
                                               .keeps_above = true,
                                               .condition = d ? MPM_WALL_SLIP : MPM_WALL_FIXED};
    }
    world.stage = (struct mpm_stage_def){.name = "main", .duration = 10};
    world.def.dimension = dim;
    world.def.basis = (enum mpm_basis)basis;
    world.def.cell = H;
    world.def.settings.cfl = 0.2;
    world.def.settings.gravity[1] = basis == MPM_LINEAR ? -0.1 : -10;
    world.def.settings.damping_local = 0.01;
    world.def.settings.damping_mass = 0.1;
    world.def.settings.blend = 0.95;
    world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
    world.def.wants_volume_ratio = true;
    world.def.n_materials = world.def.n_bodies = world.def.n_stages = 1;
    world.def.n_walls = 2;
    world.def.materials = &world.material;
    world.def.bodies = &world.body;
    world.def.stages = &world.stage;
    world.def.walls = world.walls;
}

// Places and velocities at random, so that runs, tiles and vectors end anywhere.
static struct mpm_sim *create(enum mpm_isa isa, int n_threads, double speed) {
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    world.def.isa = isa;
    world.def.n_threads = n_threads;
    if (mpm_create(&world.def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    assert_int_equal(sim->isa, isa);
    struct mpm_particles *s = &sim->sets[0];
    // Linear functions blow up where a particle barely reaches a node: with them, none crosses.
    const double calm = world.def.basis == MPM_LINEAR ? 0.05 : 1;
    const double spacing = H / world.body.particles_per_direction;
    size_t *place = malloc(s->n * sizeof *place);
    for (size_t p = 0; p < s->n; p++) {
        place[s->id[p]] = p;
    }
    seed = 11;
    for (size_t id = 0; id < s->n; id++) {
        const size_t p = place[id];
        s->V0[p] *= 1 + 0.1 * uniform();
        s->V[p] = s->V0[p];
        for (int d = 0; d < s->dim; d++) {
            s->x[mpm_at(p, s->dim, d)] += calm * 0.2 * spacing * uniform();
            s->v[mpm_at(p, s->dim, d)] = calm * (speed * (d == 0) + 0.05 * uniform());
        }
    }
    free(place);
    sim->c.v2_max = (speed + 1) * (speed + 1);
    assert_true(mpm_sort(sim));
    return sim;
}

static void advance(struct mpm_sim *sim, int n) {
    for (int k = 0; k < n; k++) {
        struct mpm_error err = {0};
        if (mpm_step(sim, &err)) {
            fail_msg("%s", err.message);
        }
    }
}

static double *field(const struct mpm_sim *sim, enum mpm_field which, size_t *n) {
    *n = mpm_n_particles(sim) * mpm_field_components(which, sim->grid.dim);
    double *values = malloc(*n * sizeof *values);
    mpm_field_copy(sim, which, values);
    return values;
}

static void near(const struct mpm_sim *sim, const struct mpm_sim *plain, enum mpm_field which,
                 double size, const char *what) {
    size_t n;
    double *a = field(sim, which, &n), *b = field(plain, which, &n);
    for (size_t i = 0; i < n; i++) {
        if (!(fabs(a[i] - b[i]) <= 1e-12 * size)) {
            fail_msg("%s: %s %zu: %.17g, of the plain kernels %.17g, in units of %g", what,
                     mpm_field_info(which)->name, i, a[i], b[i], size);
        }
    }
    free(a);
    free(b);
}

// Round-off only: positions in units of the body, velocities of the largest, stresses of the bulk
// modulus. 100 steps of CFL 0.2 are 20 cells of a wave's way; round-off grows little on it.
static void test_kernels_agree_with_the_plain_ones(void **state) {
    (void)state;
    static const char *const kinds[] = {"rubber", "fluid", "clay"};
    for (int dim = 2; dim <= 3; dim++) {
        for (int basis = 0; basis < MPM_N_BASES; basis++) {
            for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
                for (int kind = 0; kind < N_KINDS; kind++) {
                    define(dim, basis, scheme, kind, dim == 2 ? 7 : 3, dim == 2 ? 3 : 2);
                    struct mpm_sim *plain = create(MPM_ISA_BASELINE, 1, 0.2);
                    advance(plain, 100);
                    size_t n;
                    double *v = field(plain, MPM_FIELD_VELOCITY, &n), largest = 0;
                    for (size_t i = 0; i < n; i++) {
                        largest = fmax(largest, fabs(v[i]));
                    }
                    free(v);
                    // Round-off of the stress, eps rho c^2, moves velocities by eps c a step.
                    largest = fmax(largest, 0.01 * mpm_wave_speed(plain));
                    for (int isa = MPM_ISA_AVX2; isa < MPM_N_ISAS; isa++) {
                        if (!mpm_isa_available((enum mpm_isa)isa)) {
                            continue;
                        }
                        char what[100];
                        snprintf(what, sizeof what, "%s %dD %s %s %s",
                                 mpm_isa_name((enum mpm_isa)isa), dim,
                                 mpm_basis_name((enum mpm_basis)basis),
                                 mpm_fbar_name((enum mpm_fbar_scheme)scheme), kinds[kind]);
                        struct mpm_sim *sim = create((enum mpm_isa)isa, 1, 0.2);
                        advance(sim, 100);
                        near(sim, plain, MPM_FIELD_POSITION, world.body.shape.max[0], what);
                        near(sim, plain, MPM_FIELD_VELOCITY, largest, what);
                        near(sim, plain, MPM_FIELD_STRESS, bulk_modulus(kind), what);
                        near(sim, plain, MPM_FIELD_VOLUME_RATIO, 1, what);
                        near(sim, plain, MPM_FIELD_VOLUME_RATIO_BAR, 1, what);
                        mpm_free(sim);
                    }
                    mpm_free(plain);
                }
            }
        }
    }
}

// Whole states: all particles in their order, the clock, the tiles.
static void same(const struct mpm_sim *a, const struct mpm_sim *b) {
    const size_t bytes = mpm_state_bytes(a);
    assert_int_equal(bytes, mpm_state_bytes(b));
    char *one = malloc(bytes), *other = malloc(bytes);
    mpm_state_save(a, one);
    mpm_state_save(b, other);
    assert_memory_equal(one, other, bytes);
    free(one);
    free(other);
}

// Carried along fast enough to change cells many times, so that the sorts come while the threads
// are at work. Seven threads on any machine: more than cores, so that they come and go.
static void test_kernels_give_the_same_bits_on_any_number_of_threads(void **state) {
    (void)state;
    static const int threads[] = {2, 3, 4, 7};
    for (int isa = MPM_ISA_BASELINE; isa < MPM_N_ISAS; isa++) {
        for (int k = 0; mpm_isa_available((enum mpm_isa)isa) && k < 6; k++) {
            const int dim = 2 + k % 2, scheme = k / 2, kind = (k + isa) % N_KINDS;
            define(dim, k % 3 == 2 ? MPM_BSPLINE3 : MPM_GIMP, scheme, kind, dim == 2 ? 14 : 7, 2);
            struct mpm_sim *one = create((enum mpm_isa)isa, 1, 8);
            advance(one, 30);
            assert_true(one->c.steps_since_sort < 30);
            for (size_t t = 0; t < sizeof threads / sizeof *threads; t++) {
                struct mpm_sim *many = create((enum mpm_isa)isa, threads[t], 8);
                advance(many, 30);
                same(one, many);
                mpm_free(many);
            }
            mpm_free(one);
        }
    }
}

// Nodes that are fetched ahead, in all passes, also of parts that threads take over.
static void test_kernels_give_the_same_bits_of_many_nodes_on_any_number_of_threads(void **state) {
    (void)state;
    static const int schemes[] = {MPM_FBAR_OFF, MPM_FBAR_ANCHORED};
    for (int dim = 2; dim <= 3; dim++) {
        for (size_t k = 0; k < sizeof schemes / sizeof *schemes; k++) {
            define(dim, MPM_GIMP, schemes[k], CLAY, dim == 2 ? 230 : 38, 1);
            struct mpm_sim *one = create(MPM_ISA_BASELINE, 1, 8);
            assert_true(mpm_grid_is_far(&one->grid));
            advance(one, 3);
            for (int n = 2; n <= 3; n++) {
                struct mpm_sim *many = create(MPM_ISA_BASELINE, n, 8);
                advance(many, 3);
                same(one, many);
                mpm_free(many);
            }
            mpm_free(one);
        }
    }
}

// Kernels that have threads take over from a part's own one, whatever the machine does: all wait
// until it has begun, and in the middle it waits for one that takes the next. If none does, because
// all others have come to the end of the pass, it goes on.
enum { P2G, G2P, FBAR, N_PASSES };
static struct {
    struct mpm_sim *sim;
    const struct mpm_kernels *kernels; // that do the work
    int part;                          // whose thread waits; -1: none
    atomic_uint begun;                 // number of the pass in which it has last begun
    atomic_int n_taken;                // in how many another has taken over
} eased;

// Of a part [begin, end) of stretches the first waits for no other part, nor does one wait for any
// of the second half: else threads would wait here for each other, for ever.
static bool can_wait(const struct mpm_order *order, size_t begin, size_t end) {
    bool can = order->ties[order->share[begin]] == 0;
    for (size_t i = begin + (end - begin) / 2; i < end; i++) {
        can &= (order->ties[order->share[i]] & MPM_AWAITED) == 0;
    }
    return can;
}

// Whether another thread takes what comes after place i of the part. Relaxed, so that it orders
// nothing that the step does not.
static bool is_taken_over(const struct mpm_sim *sim, int part, size_t i) {
    const struct mpm_seat *seats = sim->team->seats;
    for (bool alone = false; !alone;) {
        const unsigned met = atomic_load_explicit(&seats[part].met, memory_order_relaxed);
        alone = true;
        for (int k = 0; k < sim->n_shared; k++) {
            alone &= k == part || atomic_load_explicit(&seats[k].met, memory_order_relaxed) != met;
        }
        const uint64_t next =
            atomic_load_explicit(&sim->turns[part].next, memory_order_relaxed) & UINT32_MAX;
        if (next > i + 1) {
            return true;
        }
        sched_yield();
    }
    return false;
}

static void ease(const struct mpm_span *span, int pass) {
    const struct mpm_sim *sim = eased.sim;
    const struct mpm_order *order = &sim->orders[0];
    if (eased.part < 0 || eased.part >= sim->n_shared) {
        return;
    }
    const uint32_t *chunk = order->chunk, *cuts = &sim->parts[eased.part];
    const bool by_chunks = pass == FBAR;
    const size_t begin = by_chunks ? cuts[0] : chunk[cuts[0]];
    const size_t end = by_chunks ? cuts[1] : chunk[cuts[1]], middle = begin + (end - begin) / 2;
    const uint32_t *place = by_chunks ? chunk : order->share;
    if (!by_chunks && !can_wait(order, begin, end)) {
        return;
    }
    const unsigned number = (unsigned)sim->c.step * N_PASSES + (unsigned)pass + 1;
    const size_t whole = by_chunks ? MPM_BLOCK : 1; // chunks are of whole blocks
    if (span->begin == order->stretch[place[begin]].begin / whole * whole) {
        atomic_store(&eased.begun, number);
    }
    while (atomic_load(&eased.begun) != number) {
        sched_yield();
    }
    if (span->begin == order->stretch[place[middle]].begin / whole * whole) {
        atomic_fetch_add(&eased.n_taken, is_taken_over(sim, eased.part, middle));
    }
}

static void eased_p2g(const struct mpm_span *span, struct mpm_span_result *result) {
    ease(span, P2G);
    eased.kernels->p2g(span, result);
}

static void eased_g2p(const struct mpm_span *span, struct mpm_span_result *result) {
    ease(span, G2P);
    eased.kernels->g2p(span, result);
}

static void eased_fbar(const struct mpm_span *span, struct mpm_span_result *result) {
    ease(span, FBAR);
    eased.kernels->fbar(span, result);
}

// Parts of many stretches and chunks; if there is a `small` one, that one has few.
static void check_parts(const struct mpm_sim *sim, int n, int small) {
    assert_int_equal(sim->n_shared, n);
    for (int k = 0; k < n; k++) {
        const uint32_t *chunk = sim->orders[0].chunk;
        const uint32_t first = sim->parts[k], last = sim->parts[k + 1];
        if (k == small) {
            assert_in_range(chunk[last] - chunk[first], 1, MPM_FEW - 1);
        } else {
            assert_true(chunk[last] - chunk[first] >= MPM_FEW && last - first >= MPM_FEW);
        }
    }
}

// Parts of so many stretches that threads take over from each other, in every second step without
// fail, in all passes. Also with a part of few between, which its thread goes through alone, of the
// least share that a thread can have: then parts of many wait for one of few, and that for them.
static void test_kernels_give_the_same_bits_when_threads_take_over(void **state) {
    (void)state;
    static const struct {
        int n_threads, small; // part; -1: all are equal
    } cases[] = {{2, -1}, {2, 0}, {3, -1}, {3, 1}};
    const enum mpm_isa isa = mpm_isa_in_use(MPM_ISA_AUTO);
    const int n_steps = 12;
    define(2, MPM_GIMP, MPM_FBAR_ZHAO, RUBBER, 60, 4); // 105 stretches of 512 particles and more
    struct mpm_sim *one = create(isa, 1, 40);
    advance(one, n_steps);
    assert_in_range(one->c.steps_since_sort, 1, n_steps - 1);
    for (size_t q = 0; q < sizeof cases / sizeof *cases; q++) {
        const int n = cases[q].n_threads, small = cases[q].small;
        struct mpm_sim *many = create(isa, n, 40);
        struct mpm_kernels kernels = *many->kernels;
        kernels.p2g = eased_p2g;
        kernels.g2p = eased_g2p;
        kernels.fbar = eased_fbar;
        eased.sim = many;
        eased.kernels = many->kernels;
        atomic_store(&eased.n_taken, 0);
        atomic_store(&eased.begun, 0);
        many->kernels = &kernels;
        for (int k = 0; k < n_steps; k++) {
            for (int i = 0; small >= 0 && i < n; i++) { // a sort brings them halfway to equal ones
                many->turns[i].share = i == small ? 1e-9 : 1.0 / (n - 1);
            }
            eased.part = k % 2 ? (small + 1) % n : -1;
            advance(many, 1);
            check_parts(many, n, small);
        }
        assert_int_equal(atomic_load(&eased.n_taken), n_steps / 2 * N_PASSES);
        same(one, many);
        mpm_free(many);
    }
    mpm_free(one);
}

// Time goes three times as fast for all threads but the test's: so they get through a third.
static _Thread_local bool is_slow = true;
static double clock_of_threads(void) {
    static _Thread_local double now = 1;
    return now += is_slow ? 3 : 1;
}

// A body that is never sorted is shared out anew, too, when cores are not equally fast.
static void test_kernels_go_to_the_faster_of_threads_without_a_sort(void **state) {
    (void)state;
    define(2, MPM_GIMP, MPM_FBAR_ZHAO, RUBBER, 40, 2);
    world.def.settings.gravity[1] = 0;
    const enum mpm_isa isa = mpm_isa_in_use(MPM_ISA_AUTO);
    struct mpm_sim *one = create(isa, 1, 0);
    world.def.clock = clock_of_threads;
    is_slow = false;
    struct mpm_sim *two = create(isa, 2, 0);
    for (size_t i = 0; i < 2 * one->sets[0].n; i++) { // so that no particle drifts
        one->sets[0].v[i] *= 1e-3;
        two->sets[0].v[i] *= 1e-3;
    }
    advance(two, 1);
    const uint32_t cut = two->parts[1];
    const size_t n_chunks = two->orders[0].n_chunks;
    advance(two, 299);
    advance(one, 300);
    assert_int_equal(two->c.steps_since_sort, 300);
    assert_int_equal(two->orders[0].n_chunks, n_chunks);
    // A half and three quarters of the work, to within the few chunks that ends of rows and the
    // cost of a stretch beside its particles move them by.
    assert_in_range(100 * cut, 40 * n_chunks, 60 * n_chunks);
    assert_in_range(100 * two->parts[1], 70 * n_chunks, 80 * n_chunks);
    same(one, two);
    mpm_free(one);
    mpm_free(two);
}

// What AUTO comes to is available; what is not there falls back to it.
static void test_kernels_are_those_of_the_machine(void **state) {
    (void)state;
    assert_true(mpm_isa_available(MPM_ISA_AUTO) && mpm_isa_available(MPM_ISA_BASELINE));
    const enum mpm_isa best = mpm_isa_in_use(MPM_ISA_AUTO);
    assert_true(best != MPM_ISA_AUTO && mpm_isa_available(best));
    for (int isa = MPM_ISA_BASELINE; isa < MPM_N_ISAS; isa++) {
        const bool there = mpm_isa_available((enum mpm_isa)isa);
        assert_int_equal(mpm_isa_in_use((enum mpm_isa)isa), there ? isa : (int)best);
        assert_int_equal(mpm_isa_parse(mpm_isa_name((enum mpm_isa)isa)), isa);
    }
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_kernels_agree_with_the_plain_ones),
        cmocka_unit_test(test_kernels_give_the_same_bits_on_any_number_of_threads),
        cmocka_unit_test(test_kernels_give_the_same_bits_of_many_nodes_on_any_number_of_threads),
        cmocka_unit_test(test_kernels_give_the_same_bits_when_threads_take_over),
        cmocka_unit_test(test_kernels_go_to_the_faster_of_threads_without_a_sort),
        cmocka_unit_test(test_kernels_are_those_of_the_machine),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
