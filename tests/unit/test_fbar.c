// F-bar: what the averages reproduce and conserve, and that they are the ones of docs/method.md.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/basis.h"
#include "server/mpm/sim.h"
#include "tests/unit/nodes.h"

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

static uint64_t seed;
static double uniform(void) { // in [-1, 1)
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 4503599627370496.0 - 1;
}

#define H 0.125
#define DT 1e-3
#define FOR_CASES(dim, basis, scheme, kind)                                                        \
    for (int dim = 2; dim <= 3; dim++)                                                             \
        for (int basis = 0; basis < MPM_N_BASES; basis++)                                          \
            for (int scheme = MPM_FBAR_ZHAO; scheme <= MPM_FBAR_ANCHORED; scheme++)                \
                for (int kind = 0; kind < N_KINDS; kind++)

enum {
    RUBBER,
    FLUID,
    CLAY,
    N_KINDS
}; // one that keeps F, one J, one b (and flows from the first step)

// One or two bodies (of two materials) in a box of 2 m; one problem at a time.
static struct {
    struct mpm_def def;
    struct mpm_material_def materials[2];
    struct mpm_body_def bodies[2];
    struct mpm_stage_def stage;
    struct mpm_wall_def walls[2];
} world;

static void define(int dim, int basis, int scheme, int kind) {
    const struct mpm_material_def materials[N_KINDS] = {
        [RUBBER] = {.name = "rubber",
                    .model = mpm_material_find("neo_hookean"),
                    .parameters = {1000, 1e4, 0.45},
                    .fbar = true},
        [FLUID] = {.name = "water",
                   .model = mpm_material_find("newtonian"),
                   .parameters = {1000, 1e4, 1},
                   .fbar = true},
        [CLAY] = {.name = "clay",
                  .model = mpm_material_find("hencky_j2"),
                  .parameters = {1000, 1e4, 0.45, 5, 2, 10},
                  .fbar = true},
    };
    memset(&world, 0, sizeof world);
    world.def = mpm_def_default();
    for (int k = 0; k < 2; k++) {
        world.materials[k] = materials[kind];
        world.bodies[k] =
            (struct mpm_body_def){.name = "block",
                                  .material = k,
                                  .shape = {.min = {0.5, 0.5, 0.5}, .max = {1, 0.875, 0.75}},
                                  .particles_per_direction = 2};
        world.def.domain_max[0] = 2;
        world.def.domain_max[1] = world.def.domain_max[2] = 1.25;
    }
    world.stage = (struct mpm_stage_def){.name = "main", .duration = 10};
    world.def.dimension = dim;
    world.def.basis = (enum mpm_basis)basis;
    world.def.cell = H;
    world.def.settings.dt = DT;
    world.def.settings.fbar.scheme = (enum mpm_fbar_scheme)scheme;
    world.def.n_bodies = world.def.n_stages = 1;
    world.def.n_materials = 2;
    world.def.materials = world.materials;
    world.def.bodies = world.bodies;
    world.def.stages = &world.stage;
    world.def.walls = world.walls;
}

static struct mpm_sim *create(void) {
    struct mpm_sim *sim;
    struct mpm_error err = {0};
    if (mpm_create(&world.def, &sim, &err)) {
        fail_msg("%s: %s", err.pointer, err.message);
    }
    return sim;
}

static void step(struct mpm_sim *sim) {
    struct mpm_error err = {0};
    if (mpm_step(sim, &err)) {
        fail_msg("%s", err.message);
    }
}

// Velocities at random, which differ enough within a cell for J to vary by 1e-2 a step.
static void shake(struct mpm_sim *sim, double size) {
    for (size_t b = 0; b < sim->n_sets; b++) {
        struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            for (int d = 0; d < s->dim; d++) {
                s->v[mpm_at(p, s->dim, d)] = size * uniform();
            }
        }
    }
    sim->c.v2_max = 3 * size * size;
}

// v = A x on the nodes, then the two F-bar passes of one step.
static void step_with_affine_velocity(struct mpm_sim *sim, const double *A) {
    struct mpm_grid *g = &sim->grid;
    struct mpm_particles *s = &sim->sets[0];
    const int dim = g->dim;
    const enum mpm_fbar_scheme scheme = sim->c.now.fbar.scheme;
    g->fbar_stride = mpm_fbar_scalars(scheme);
    assert_true(mpm_sort(sim)); // which may give nodes other places
    FOR_NODES(g, i) {
        int place[MPM_MAX_DIM];
        node_place(g, i, place);
        for (int d = 0; d < dim; d++) {
            double *v = &g->velocity[i * (size_t)MPM_VELOCITY(dim) + (size_t)d];
            *v = 0;
            for (int e = 0; e < dim; e++) {
                *v += A[d * dim + e] * g->h * place[e];
            }
        }
    }
    const size_t n_nodes = g->n_slots * (size_t)MPM_BLOCK_NODES(dim);
    memset(g->node, 0, n_nodes * MPM_NODE * sizeof *g->node);
    memset(g->fbar, 0, n_nodes * (size_t)g->fbar_stride * sizeof *g->fbar);
    const struct mpm_span span = {.s = s,
                                  .grid = g,
                                  .end = s->n,
                                  .dt = DT,
                                  .a = sim->c.now.fbar.a,
                                  .C = sim->c.now.fbar.C,
                                  .keep = sim->c.now.fbar.keep,
                                  .fbar = true,
                                  .scheme = scheme};
    struct mpm_span_result result;
    sim->kernels->p2g(&span, &result);
    sim->kernels->g2p(&span, &result);
    mpm_fbar_divide(g, 1, g->n_slots);
    sim->kernels->fbar(&span, &result);
    assert_true(result.bad == SIZE_MAX);
}

// A uniform increment is reproduced: the same J, Jbar and V as without F-bar, step after step.
static void test_fbar_reproduces_a_uniform_field(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme, kind) {
        define(dim, basis, scheme, kind);
        struct mpm_sim *sim = create();
        const struct mpm_particles *s = &sim->sets[0];
        double A[9], F[9] = {0}, D[9], J = 1;
        for (int k = 0; k < dim * dim; k++) {
            A[k] = 0.2 * uniform();
            D[k] = DT * A[k];
        }
        for (int d = 0; d < dim; d++) {
            F[d * dim + d] = 1;
        }
        for (int k = 0; k < 20; k++) {
            step_with_affine_velocity(sim, A);
            double G[9];
            for (int i = 0; i < dim * dim; i++) {
                G[i] = F[i];
                for (int j = 0; j < dim; j++) {
                    G[i] += D[i / dim * dim + j] * F[j * dim + i % dim];
                }
            }
            memcpy(F, G, sizeof F);
            J *= 1 + mpm_det_minus_one(D, dim);
        }
        assert_true(fabs(J - 1) > 1e-5);
        for (size_t p = 0; p < s->n; p++) {
            // 20 steps of a few eps each.
            assert_near(mpm_ratio_in_use(s, p), J, 1e-13);
            assert_near(s->V[p] / s->V0[p], J, 1e-13);
            for (int k = 0; s->F && k < dim * dim; k++) {
                assert_near(s->F[mpm_at(p, dim * dim, k)], F[k], 1e-13);
            }
        }
        assert_near(mpm_fbar_drift(s), 0, 1e-13);
        mpm_free(sim);
    }
}

// A plain transcription of docs/method.md (Algorithm 1 and section 8) over dense arrays.
struct reference {
    double ratio[512], V[512]; // what a step must make of Jbar and V
};
static void reference_step(const struct mpm_sim *before, const struct mpm_sim *after, size_t n_sets,
                           struct reference out[]) {
    const struct mpm_grid *g = &before->grid;
    const int dim = g->dim;
    const struct mpm_fbar f = before->c.now.fbar;
    const size_t n[3] = {(size_t)g->n[0], (size_t)g->n[1], (size_t)g->n[2]};
    double *sums = calloc(n[0] * n[1] * n[2] * 3, sizeof *sums);
    for (int pass = 0; pass < 2; pass++) {
        for (size_t b = 0; b < n_sets; b++) {
            const struct mpm_particles *s = &before->sets[b], *t = &after->sets[b];
            for (size_t p = 0; p < s->n; p++) {
                double w[3][MPM_MAX_SUPPORT] = {{0}, {0}, {1}}, dw[MPM_MAX_SUPPORT], moved = 0;
                int base[3] = {0};
                for (int d = 0; d < dim; d++) {
                    const double x = s->x[mpm_at(p, dim, d)];
                    base[d] = (int)mpm_weights(before->def->basis, (x - g->origin[d]) / g->h,
                                               s->half, s->inv_4_half, w[d], dw);
                    moved += pow(t->x[mpm_at(p, dim, d)] - x, 2);
                }
                const double V = s->V[p], J = mpm_ratio_in_use(s, p), dJ = t->dJ[p];
                const double anchor = (1 - f.a) * J + f.a * V / s->V0[p];
                double A = 0, B = 0;
                for (int i = 0; i < MPM_MAX_SUPPORT; i++) {
                    for (int j = 0; j < MPM_MAX_SUPPORT; j++) {
                        for (int k = 0; k < (dim == 3 ? MPM_MAX_SUPPORT : 1); k++) {
                            const int reach = mpm_support(before->def->basis);
                            if (i >= reach || j >= reach || (dim == 3 && k >= reach)) {
                                continue;
                            }
                            const double W = w[0][i] * w[1][j] * w[2][k];
                            double *node =
                                sums +
                                3 * (((size_t)(base[0] + i) * n[1] + (size_t)(base[1] + j)) * n[2] +
                                     (dim == 3 ? (size_t)(base[2] + k) : 0));
                            if (pass == 0) {
                                node[0] += W * V;
                                node[1] += W * V * dJ * (f.scheme == MPM_FBAR_ZHAO ? J : 1);
                                node[2] += W * V * dJ * anchor;
                            } else if (node[0] > 0) {
                                A += W * node[1] / node[0];
                                B += W * node[2] / node[0];
                            }
                        }
                    }
                }
                if (f.scheme == MPM_FBAR_ZHAO) {
                    out[b].ratio[p] = A;
                    out[b].V[p] = s->Jbar ? A / J * V : V * dJ;
                } else {
                    const double beta = fmin(1, f.C * sqrt(moved) / g->h);
                    const double rate = (1 - f.keep) * A + f.keep * dJ;
                    out[b].ratio[p] = (1 - f.keep) * B + f.keep * rate * V / s->V0[p];
                    out[b].V[p] = (1 - beta) * V * rate + beta * s->V0[p] * out[b].ratio[p];
                }
            }
        }
    }
    free(sums);
}

// Two simulations in step: `behind` is one step behind `sim`, so the increments of a step are
// known.
static void test_fbar_is_algorithm_1_and_section_8(void **state) {
    (void)state;
    static struct reference expected[1];
    FOR_CASES(dim, basis, scheme, kind)
    for (int keeps = 0; keeps < (scheme == MPM_FBAR_ANCHORED ? 2 : 1); keeps++) {
        define(dim, basis, scheme, kind);
        world.def.settings.fbar.keep = 0.25 * keeps;
        struct mpm_sim *sim = create(), *behind = create();
        seed = 7;
        shake(sim, 0.3);
        seed = 7;
        shake(behind, 0.3);
        assert_true(sim->sets[0].n <= 512);
        for (int k = 0; k < 6; k++) {
            step(sim);
            reference_step(behind, sim, 1, expected);
            step(behind);
            double spread = 0, flowed = 0;
            for (size_t p = 0; p < sim->sets[0].n; p++) {
                const double ratio = mpm_ratio_in_use(&sim->sets[0], p);
                assert_near(ratio, expected[0].ratio[p], 1e-13); // order of sums
                assert_near(sim->sets[0].V[p], expected[0].V[p], 1e-13 * sim->sets[0].V0[p]);
                spread = fmax(spread, fabs(ratio - 1));
                flowed += kind == CLAY ? sim->sets[0].plastic_strain[p] : 0;
            }
            assert_true(spread > 1e-5); // something was averaged
            assert_true(flowed > 0 || kind != CLAY || k == 0);
        }
        mpm_free(sim);
        mpm_free(behind);
    }
}

// Sums of V, which anchored with C = 0 conserves: sum V^{n+1} = sum V^n dJ; Algorithm 1 conserves
// sum V^n Jbar^{n+1} = sum V^n Jbar^n dJ, and its solids' V = V^n dJ. Neither makes a new extreme.
static void test_fbar_conserves_volume(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme, kind) {
        define(dim, basis, scheme, kind);
        world.def.settings.fbar.C = 0;
        world.def.settings.fbar.keep = 0.1;
        struct mpm_sim *sim = create(), *behind = create();
        seed = 3;
        shake(sim, 0.3);
        seed = 3;
        shake(behind, 0.3);
        for (int k = 0; k < 6; k++) {
            step(sim);
            const struct mpm_particles *s = &behind->sets[0], *t = &sim->sets[0];
            double V = 0, V_dJ = 0, trial_sum = 0, ratio_sum = 0, least = INFINITY, most = 0;
            for (size_t p = 0; p < s->n; p++) {
                const double trial = mpm_ratio_in_use(s, p) * t->dJ[p];
                V += t->V[p];
                V_dJ += s->V[p] * t->dJ[p];
                trial_sum += s->V[p] * trial;
                ratio_sum += s->V[p] * mpm_ratio_in_use(t, p);
                least = fmin(least, trial);
                most = fmax(most, trial);
            }
            if (scheme == MPM_FBAR_ANCHORED) {
                assert_near(V, V_dJ, 1e-13 * V);
            } else {
                assert_near(ratio_sum, trial_sum, 1e-13 * ratio_sum);
                for (size_t p = 0; p < s->n; p++) {
                    const double ratio = mpm_ratio_in_use(t, p);
                    assert_true(ratio >= least - 1e-14 && ratio <= most + 1e-14);
                    if (kind != FLUID) {
                        assert_near(t->V[p], s->V[p] * t->dJ[p], 1e-15 * t->V0[p]);
                    } else { // a fluid's volume follows its ratio
                        assert_near(t->V[p], t->V0[p] * ratio, 1e-14 * t->V0[p]);
                    }
                }
            }
            step(behind);
        }
        mpm_free(sim);
        mpm_free(behind);
    }
}

// A lone particle shares its nodes with nobody: what it averages is its own.
static void test_fbar_leaves_a_lone_particle_alone(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme, kind) {
        // Anywhere, on a node, in the middle of a cell, and at the edge of a node's reach, where
        // the node has next to no mass (the linear basis does not bear that).
        const double places[] = {0.53, 0.5625, 0.5, 0.5 + 1e-9, 0.5625 + 1e-9};
        for (int k = 0; k < (basis == MPM_LINEAR ? 2 : 5); k++) {
            const double x = places[k], V0 = pow(H / 2, dim);
            const double flat[] = {x, x, V0}, solid[] = {x, x, x, V0};
            double J[2], V[2];
            for (int on = 0; on < 2; on++) {
                define(dim, basis, on ? scheme : MPM_FBAR_OFF, kind);
                world.bodies[0].shape = (struct mpm_shape){
                    .kind = MPM_SHAPE_POINTS, .n_points = 1, .points = dim == 2 ? flat : solid};
                struct mpm_sim *sim = create();
                struct mpm_particles *s = &sim->sets[0];
                // Pre-stressed, so that its nodes fly apart.
                if (s->Jbar) {
                    s->Jbar[0] = 1.02;
                } else {
                    *(s->F ? &s->F[mpm_at(0, dim * dim, 0)] : &s->b[mpm_at(0, MPM_SYM(dim), 0)]) =
                        s->F ? 1.02 : 1.02 * 1.02;
                }
                s->V[0] = 1.02 * V0;
                s->material->stress[dim - 2](s, 0, 1);
                for (int i = 0; i < 20; i++) {
                    step(sim);
                }
                J[on] = mpm_ratio_in_use(s, 0);
                V[on] = s->V[0] / V0;
                mpm_free(sim);
            }
            assert_true(fabs(J[1] - 1.02) > 1e-4); // it did strain
            // 20 steps with stiff nodes: round-off of 1e-16 in J, times K/(rho h^2) dt^2 a step.
            assert_near(J[1], J[0], 1e-12);
            assert_near(V[1], V[0], 1e-12);
        }
    }
}

static void test_fbar_leaves_a_translation_alone(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme, kind) {
        define(dim, basis, scheme, kind);
        world.bodies[0].velocity = (struct mpm_velocity){.vector = {1, 0.5, 0.25}};
        struct mpm_sim *sim = create();
        for (int k = 0; k < 200; k++) { // 1.6 cells
            step(sim);
        }
        const struct mpm_particles *s = &sim->sets[0];
        for (size_t p = 0; p < s->n; p++) {
            assert_near(mpm_ratio_in_use(s, p), 1, 1e-13); // round-off of 200 steps
            assert_near(s->V[p] / s->V0[p], 1, 1e-13);
            for (int k = 0; s->F && k < dim * dim; k++) {
                assert_near(s->F[mpm_at(p, dim * dim, k)], k % (dim + 1) == 0, 1e-12);
            }
            for (int k = 0; s->b && k < MPM_SYM(dim); k++) {
                assert_near(s->b[mpm_at(p, MPM_SYM(dim), k)], k < 3, 1e-12);
            }
        }
        mpm_free(sim);
    }
}

// A material with "fbar": false goes on as if F-bar were off, and its neighbour averages without
// it.
static void test_fbar_leaves_an_excepted_material_alone(void **state) {
    (void)state;
    static struct reference expected[2];
    FOR_CASES(dim, basis, scheme, kind) {
        define(dim, basis, scheme, kind);
        world.materials[0].fbar = false;
        world.def.n_bodies = 2;
        world.bodies[1].shape.min[0] = 1; // side by side, sharing nodes
        world.bodies[1].shape.max[0] = 1.5;
        struct mpm_sim *sim = create(), *behind = create();
        assert_null(sim->sets[0].dJ);
        assert_non_null(sim->sets[1].dJ);
        seed = 5;
        shake(sim, 0.3);
        seed = 5;
        shake(behind, 0.3);
        for (int k = 0; k < 3; k++) {
            step(sim);
            struct mpm_sim alone = *behind, alone_after = *sim;
            alone.sets = &behind->sets[1];
            alone_after.sets = &sim->sets[1];
            reference_step(&alone, &alone_after, 1, expected);
            step(behind);
            for (size_t p = 0; p < sim->sets[1].n; p++) {
                assert_near(mpm_ratio_in_use(&sim->sets[1], p), expected[0].ratio[p], 1e-13);
            }
            const struct mpm_particles *s = &sim->sets[0];
            for (size_t p = 0; p < s->n; p++) {
                assert_near(s->V[p] / s->V0[p], mpm_ratio_in_use(s, p), 1e-14);
            }
        }
        mpm_free(sim);
        mpm_free(behind);
    }
}

// The excepted body does not notice the switch at all when it shares no node with another: the same
// bits.
static void test_fbar_of_one_body_is_nothing_to_another(void **state) {
    (void)state;
    FOR_CASES(dim, basis, scheme, kind) {
        double *x[2] = {0};
        size_t bytes = 0;
        for (int on = 0; on < 2; on++) {
            define(dim, basis, on ? scheme : MPM_FBAR_OFF, kind);
            world.materials[0].fbar = false;
            world.def.n_bodies = 2;
            world.bodies[1].shape.min[0] = 1.5;
            world.bodies[1].shape.max[0] = 1.75;
            struct mpm_sim *sim = create();
            seed = 5;
            shake(sim, 0.3);
            for (int k = 0; k < 20; k++) {
                step(sim);
            }
            x[on] = malloc(sim->sets[0].memory_bytes);
            memcpy(x[on], sim->sets[0].memory, sim->sets[0].memory_bytes);
            bytes = sim->sets[0].memory_bytes;
            mpm_free(sim);
        }
        assert_memory_equal(x[0], x[1], bytes);
        free(x[0]);
        free(x[1]);
    }
}

// Two bodies that share nodes and both take part are averaged as one.
static void test_fbar_averages_over_both_bodies(void **state) {
    (void)state;
    static struct reference expected[2];
    FOR_CASES(dim, basis, scheme, kind) {
        define(dim, basis, scheme, kind);
        world.def.n_bodies = 2;
        world.bodies[1].shape.min[0] = 1;
        world.bodies[1].shape.max[0] = 1.5;
        struct mpm_sim *sim = create(), *behind = create();
        seed = 9;
        shake(sim, 0.3);
        seed = 9;
        shake(behind, 0.3);
        for (int k = 0; k < 3; k++) {
            step(sim);
            reference_step(behind, sim, 2, expected);
            step(behind);
            for (size_t b = 0; b < 2; b++) {
                for (size_t p = 0; p < sim->sets[b].n; p++) {
                    assert_near(mpm_ratio_in_use(&sim->sets[b], p), expected[b].ratio[p], 1e-13);
                }
            }
        }
        mpm_free(sim);
        mpm_free(behind);
    }
}

// Plane strain, or one cell of it in 3D between two slip walls.
static struct mpm_sim *create_slice(int dim, int basis, int scheme, int kind) {
    define(dim, basis, scheme, kind);
    world.def.domain_max[2] = H;
    world.bodies[0].shape.min[2] = 0;
    world.bodies[0].shape.max[2] = H;
    world.bodies[0].velocity = (struct mpm_velocity){.kind = MPM_VELOCITY_MODE,
                                                     .axis = 0,
                                                     .number = 2,
                                                     .from = 0.5,
                                                     .length = 0.5,
                                                     .amplitude = 0.2};
    for (int k = 0; k < 2; k++) {
        world.walls[k] = (struct mpm_wall_def){.name = k ? "front" : "back",
                                               .axis = 2,
                                               .at = k ? H : 0,
                                               .keeps_above = !k,
                                               .condition = MPM_WALL_SLIP};
    }
    world.def.n_walls = dim == 3 ? 2 : 0;
    return create();
}

static size_t place_of(const struct mpm_particles *s, size_t id) {
    size_t p = 0;
    while (s->id[p] != id) {
        p++;
    }
    return p;
}

// Without a cube root of the ratio in the third direction nothing tells a slice from plane strain:
// fluids with any scheme, solids without F-bar.
static void test_fbar_slice_is_plane_strain(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        for (int scheme = 0; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            for (int kind = 0; kind < N_KINDS; kind++) {
                if (scheme != MPM_FBAR_OFF && kind != FLUID) {
                    continue;
                }
                struct mpm_sim *flat = create_slice(2, basis, scheme, kind);
                for (int k = 0; k < 100; k++) {
                    step(flat);
                }
                struct mpm_sim *solid = create_slice(3, basis, scheme, kind);
                for (int k = 0; k < 100; k++) {
                    step(solid);
                }
                const struct mpm_particles *s = &flat->sets[0], *t = &solid->sets[0];
                assert_int_equal(t->n, 2 * s->n);
                for (size_t p = 0; p < t->n; p++) { // the third direction is the fastest
                    const size_t q = place_of(s, t->id[p] / 2);
                    for (int d = 0; d < 2; d++) {
                        // Sums in another order, over 100 steps of a smooth motion.
                        assert_near(t->x[mpm_at(p, 3, d)], s->x[mpm_at(q, 2, d)], 1e-12);
                    }
                    assert_near(t->v[mpm_at(p, 3, 2)], 0, 1e-13);
                    assert_near(mpm_ratio_in_use(t, p), mpm_ratio_in_use(s, q), 1e-12);
                    assert_near(mpm_mean_stress(t, p), mpm_mean_stress(s, q), 1e-7); // of 1e4
                }
                mpm_free(flat);
                mpm_free(solid);
            }
        }
    }
}

// A solid slice scales F33 with the cube root, plane strain keeps it 1 with the square root: after
// one step from rest Jbar is the same, and F33 and the rest differ by just these powers of it.
static void test_fbar_slice_scales_F33(void **state) {
    (void)state;
    for (int basis = 0; basis < MPM_N_BASES; basis++) {
        for (int scheme = MPM_FBAR_ZHAO; scheme < MPM_N_FBAR_SCHEMES; scheme++) {
            struct mpm_sim *flat = create_slice(2, basis, scheme, RUBBER);
            step(flat);
            struct mpm_sim *solid = create_slice(3, basis, scheme, RUBBER);
            step(solid);
            const struct mpm_particles *s = &flat->sets[0], *t = &solid->sets[0];
            double largest = 0;
            for (size_t p = 0; p < t->n; p++) {
                const size_t twin = place_of(s, t->id[p] / 2);
                const double J = mpm_ratio_in_use(s, twin), q = J / s->dJ[twin];
                assert_near(mpm_ratio_in_use(t, p), J, 1e-14);
                assert_near(t->F[mpm_at(p, 9, 8)], cbrt(q), 1e-15);
                for (int k = 0; k < 4; k++) {
                    assert_near(t->F[mpm_at(p, 9, k / 2 * 3 + k % 2)],
                                s->F[mpm_at(twin, 4, k)] * cbrt(q) / sqrt(q), 1e-14);
                }
                largest = fmax(largest, fabs(q - 1));
            }
            assert_true(largest > 1e-6);
            mpm_free(flat);
            mpm_free(solid);
        }
    }
}

// drift is max |ln(J/Jbar)|: it grows with Algorithm 1, and is infinite where J is not positive.
static void test_fbar_drift_is_the_largest_ratio(void **state) {
    (void)state;
    define(2, MPM_GIMP, MPM_FBAR_ZHAO, RUBBER);
    struct mpm_sim *sim = create();
    struct mpm_particles *s = &sim->sets[0];
    assert_near(mpm_fbar_drift(s), 0, 0);
    s->V[3] = 0.5 * s->V0[3];
    s->V[5] = 1.5 * s->V0[5];
    assert_near(mpm_fbar_drift(s), log(2), 1e-15);
    s->V[7] = -s->V0[7];
    assert_true(mpm_fbar_drift(s) == INFINITY);
    mpm_free(sim);
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_fbar_reproduces_a_uniform_field),
        cmocka_unit_test(test_fbar_is_algorithm_1_and_section_8),
        cmocka_unit_test(test_fbar_conserves_volume),
        cmocka_unit_test(test_fbar_leaves_a_lone_particle_alone),
        cmocka_unit_test(test_fbar_leaves_a_translation_alone),
        cmocka_unit_test(test_fbar_leaves_an_excepted_material_alone),
        cmocka_unit_test(test_fbar_of_one_body_is_nothing_to_another),
        cmocka_unit_test(test_fbar_averages_over_both_bodies),
        cmocka_unit_test(test_fbar_slice_is_plane_strain),
        cmocka_unit_test(test_fbar_slice_scales_F33),
        cmocka_unit_test(test_fbar_drift_is_the_largest_ratio),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
