// What the stages of the particle passes take: each pass is run up to every one of its stages, in
// turns, and the differences are what the last of them adds. The particles stand still meanwhile.
// bench/stages_2d.c and stages_3d.c are the kernels in lanes with a way out after every stage.
#include "bench/bench.h"
#include "server/mpm/kernels.h"

#define MAX_STAGES 6

extern int bench_stages; // the last one that is run
int bench_stages;

#ifdef MPM_HAS_LANES

extern const struct mpm_kernels bench_kernels_avx2_2d[MPM_N_BASES],
    bench_kernels_avx2_3d[MPM_N_BASES], bench_kernels_avx512_2d[MPM_N_BASES],
    bench_kernels_avx512_3d[MPM_N_BASES];

typedef void pass(const struct mpm_span *span, struct mpm_span_result *result);

static const struct {
    const char *name;
    int n;
    const char *stage[MAX_STAGES];
} passes[] = {
    {"P2G", 5, {"cells", "nodes", "weights", "records", "scatter"}},
    {"G2P", 6, {"cells", "nodes", "gather", "update, law", "weights", "scatter"}},
    {"F-bar", 4, {"cells", "nodes", "gather", "rescale, law"}},
};

static void run(pass *work, const struct mpm_sim *sim, struct mpm_span span) {
    const struct mpm_order *order = &sim->orders[0];
    for (size_t t = 0; t < order->n_stretches; t++) {
        span.begin = order->stretch[t].begin;
        span.end = order->stretch[t].end;
        span.next = t + 1 < order->n_stretches ? order->stretch[t + 1].begin : span.begin;
        struct mpm_span_result found;
        work(&span, &found);
    }
}

// ns per particle of one pass up to each of its stages.
static void row(struct mpm_sim *sim, int which, pass *work, struct mpm_span span) {
    const int rounds = quick ? 3 : 9, n = passes[which].n - (span.fbar || which != 1 ? 0 : 2);
    double ns[MAX_STAGES + 1][MAX_ROUNDS];
    for (int r = 0; r < rounds; r++) {
        for (bench_stages = 0; bench_stages <= n; bench_stages++) {
            int times = 0;
            const double begin = now();
            do {
                run(work, sim, span);
                times++;
            } while (now() - begin < 0.01);
            ns[bench_stages][r] = 1e9 * (now() - begin) / times / (double)mpm_n_particles(sim);
        }
    }
    printf("  %-6s %5.1f ns:", passes[which].name, median(ns[n], rounds));
    open_row("stages");
    text("pass", passes[which].name);
    text("fbar", span.fbar ? "zhao" : "off");
    number("dimension", sim->grid.dim);
    number("ns_per_particle", median(ns[n], rounds));
    for (int k = 0; k < n; k++) {
        double added[MAX_ROUNDS];
        for (int r = 0; r < rounds; r++) {
            added[r] = ns[k + 1][r] - ns[k][r];
        }
        printf(" %s %.1f", passes[which].stage[k], median(added, rounds));
        number(passes[which].stage[k], median(added, rounds));
    }
    puts("");
    close_row();
}

void stages_of(struct mpm_sim *sim) {
    const int dim = sim->grid.dim;
    const bool wide = sim->isa == MPM_ISA_AVX512;
    const struct mpm_kernels *kernels =
        &(dim == 2 ? wide ? bench_kernels_avx512_2d : bench_kernels_avx2_2d
          : wide   ? bench_kernels_avx512_3d
                   : bench_kernels_avx2_3d)[MPM_BSPLINE2];
    timed(sim, 0.01);
    const enum mpm_fbar_scheme scheme = sim->c.now.fbar.scheme;
    const struct mpm_span span = {.s = &sim->sets[0],
                                  .grid = &sim->grid,
                                  .blend = 1,
                                  .fbar = scheme != MPM_FBAR_OFF,
                                  .scheme = scheme};
    const size_t nodes = (size_t)sim->grid.n_slots * (size_t)MPM_BLOCK_NODES(dim);
    memset(sim->grid.velocity, 0, nodes * (size_t)MPM_VELOCITY(dim) * sizeof(double));
    row(sim, 0, kernels->p2g, span);
    row(sim, 1, kernels->g2p, span);
    if (span.fbar) {
        // The averages of what is there: then nothing is rescaled.
        memset(sim->grid.node, 0, nodes * MPM_NODE * sizeof(double));
        memset(sim->grid.fbar, 0, nodes * (size_t)sim->grid.fbar_stride * sizeof(double));
        run(sim->kernels->p2g, sim, span);
        run(sim->kernels->g2p, sim, span);
        mpm_walls_fold_fbar(sim->walls, sim->n_walls, &sim->grid, 0);
        mpm_fbar_divide(&sim->grid, 1, sim->grid.n_slots);
        mpm_walls_mirror_fbar(sim->walls, sim->n_walls, &sim->grid, 0);
        row(sim, 2, kernels->fbar, span);
    }
}

#else

void stages_of(struct mpm_sim *sim) {
    (void)sim;
}

#endif
