// Stretches of random bodies: whole, in one order that any number of threads can keep, and apart.
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/order.h"

static uint32_t state_of_random;
static uint32_t random_below(uint32_t n) {
    state_of_random = state_of_random * 1664525u + 1013904223u;
    return (uint32_t)(((uint64_t)state_of_random * n) >> 32);
}

// Blocks in use at random, from nearly none to nearly all, each with up to `most` particles.
static size_t make_tiles(struct mpm_order *order, const struct mpm_grid *grid, uint32_t per_cent,
                         uint32_t most) {
    const uint32_t n_blocks = (uint32_t)(grid->n_blocks[0] * grid->n_blocks[1] * grid->n_blocks[2]);
    uint32_t at = 0;
    order->n_tiles = 0;
    for (uint32_t block = 0; block < n_blocks; block++) {
        if (random_below(100) < per_cent) {
            assert_true(mpm_order_reserve(order, order->n_tiles + 1));
            const uint32_t end = at + 1 + random_below(most);
            order->tile[order->n_tiles++] =
                (struct mpm_tile){.begin = at, .end = end, .block = block};
            at = end;
        }
    }
    return at;
}

static bool reach_common_nodes(const struct mpm_grid *grid, const struct mpm_stretch *a,
                               const struct mpm_stretch *b, int apart) {
    int of_a[2][MPM_MAX_DIM], of_b[2][MPM_MAX_DIM];
    mpm_grid_block_place(grid, a->first, of_a[0]);
    mpm_grid_block_place(grid, a->last, of_a[1]);
    mpm_grid_block_place(grid, b->first, of_b[0]);
    mpm_grid_block_place(grid, b->last, of_b[1]);
    for (int d = 0; d < grid->dim; d++) {
        if (of_a[0][d] - of_b[1][d] >= apart || of_b[0][d] - of_a[1][d] >= apart) {
            return false;
        }
    }
    return true;
}

static bool is_listed(const struct mpm_order *order, size_t t, size_t other) {
    for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
        if (order->before[b] == other) {
            return true;
        }
    }
    return false;
}

static void check_stretches(const struct mpm_order *order, const struct mpm_grid *grid, size_t n,
                            int apart) {
    const int last = grid->dim - 1;
    size_t at = 0, tile = 0;
    for (size_t t = 0; t < order->n_stretches; t++) {
        const struct mpm_stretch *s = &order->stretch[t];
        assert_int_equal(s->begin, at);
        assert_true(s->end > s->begin);
        while (order->tile[tile].end <= s->begin) {
            tile++;
        }
        assert_int_equal(s->first, order->tile[tile].block);
        while (order->tile[tile].end < s->end) {
            tile++;
        }
        assert_int_equal(s->last, order->tile[tile].block);
        assert_int_equal(s->first / (uint32_t)grid->n_blocks[last],
                         s->last / (uint32_t)grid->n_blocks[last]);
        at = s->end;
        for (size_t other = 0; other < order->n_stretches; other++) {
            const bool meet =
                t != other && reach_common_nodes(grid, s, &order->stretch[other], apart);
            const int listed = is_listed(order, t, other) + is_listed(order, other, t);
            if (listed != meet) {
                fail_msg("%zu and %zu: %d times listed", t, other, listed);
            }
        }
    }
    assert_int_equal(at, n);
}

// Threads that each go through their part, whoever is next at random: all come to an end, and
// nobody passes one that it waits for.
static void check_shares(struct mpm_order *order, int n_parts) {
    uint32_t parts[9], next[8];
    bool *done = calloc(order->n_stretches + 1, sizeof *done);
    for (int k = 0; k <= n_parts; k++) {
        const uint32_t cut = (uint32_t)mpm_order_cut(order, (double)k / n_parts);
        parts[k] = k > 0 && cut < parts[k - 1] ? parts[k - 1] : cut;
    }
    mpm_order_share(order, parts, n_parts);
    for (int k = 0; k < n_parts; k++) {
        next[k] = order->chunk[parts[k]];
        for (uint32_t i = order->chunk[parts[k]]; i < order->chunk[parts[k + 1]]; i++) {
            assert_in_range(order->share[i], order->chunk[parts[k]],
                            order->chunk[parts[k + 1]] - 1);
        }
    }
    // Who waits for a stretch of another part knows that it has to look, and whose it is that it
    // has to be told (pass.c: await_before, say_done).
    for (size_t t = 0; t < order->n_stretches; t++) {
        for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
            const uint32_t q = order->before[b];
            bool together = false;
            for (int k = 0; k < n_parts; k++) {
                const uint32_t begin = order->chunk[parts[k]], end = order->chunk[parts[k + 1]];
                together |= t >= begin && t < end && q >= begin && q < end;
            }
            assert_true(together || ((order->ties[q] & MPM_AWAITED) != 0 &&
                                     (order->ties[t] & MPM_AWAITS) != 0));
        }
    }
    size_t left = order->n_stretches;
    for (size_t idle = 0; left > 0; idle++) {
        assert_true(idle < 1000); // nobody could go on
        const int k = (int)random_below((uint32_t)n_parts);
        if (next[k] == order->chunk[parts[k + 1]]) {
            continue;
        }
        const uint32_t t = order->share[next[k]];
        bool ready = true;
        for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
            ready &= done[order->before[b]];
        }
        if (ready) {
            assert_false(done[t]);
            done[t] = true;
            next[k]++;
            left--;
            idle = 0;
        }
    }
    free(done);
}

static void test_order_stretches_of_random_bodies(void **state) {
    (void)state;
    static const enum mpm_basis bases[] = {MPM_LINEAR, MPM_BSPLINE2, MPM_BSPLINE3};
    for (uint32_t k = 0; k < 400; k++) {
        struct mpm_order order = {0};
        state_of_random = k;
        const int dim = 2 + (int)(k & 1);
        const uint32_t most = dim == 2 ? 24 : 8;
        struct mpm_grid grid = {.dim = dim, .n_blocks = {1, 1, 1}};
        for (int d = 0; d < dim; d++) {
            grid.n_blocks[d] = 1 + (int)random_below(most);
        }
        static const uint32_t particles[] = {4, 64, 700};
        const enum mpm_basis basis = bases[random_below(3)];
        // The same order again and again, as a simulation does.
        for (int again = 0; again < 2; again++) {
            const size_t n =
                make_tiles(&order, &grid, 1 + random_below(100), particles[random_below(3)]);
            assert_true(mpm_order_stretches(&order, &grid, basis, 8));
            check_stretches(&order, &grid, n, basis == MPM_BSPLINE3 ? 3 : 2);
            for (int n_parts = 1; n > 0 && n_parts <= 8; n_parts++) {
                check_shares(&order, n_parts);
            }
        }
        mpm_order_free(&order);
    }
}

// The time, in particles, in which threads that are as fast as each other get through their parts,
// when each hears of what another has done `late`; and the longest part's.
static double time_of_parts(const struct mpm_order *order, const uint32_t *cuts, int n, double late,
                            double *longest) {
    uint32_t next[8];
    double clock[8] = {0}, all = 0;
    double *ended = calloc(order->n_stretches, sizeof *ended);
    assert_non_null(ended);
    *longest = 0;
    for (int k = 0; k < n; k++) {
        next[k] = order->chunk[cuts[k]];
    }
    size_t left = order->n_stretches;
    for (size_t turn = 0; left > 0; turn++) {
        assert_true(turn <= order->n_stretches); // in each somebody goes on
        for (int k = 0; k < n; k++) {
            const uint32_t begin = order->chunk[cuts[k]], end = order->chunk[cuts[k + 1]];
            bool ready = next[k] < end;
            while (ready) {
                const uint32_t t = order->share[next[k]];
                double at = clock[k];
                for (uint32_t b = order->before_begin[t]; b < order->before_begin[t + 1]; b++) {
                    const uint32_t q = order->before[b];
                    ready &= ended[q] > 0;
                    at = fmax(at, q >= begin && q < end ? 0 : ended[q] + late);
                }
                if (ready) {
                    ended[t] = clock[k] = at + order->stretch[t].end - order->stretch[t].begin;
                    left--;
                    ready = ++next[k] < end;
                }
            }
        }
    }
    for (int k = 0; k < n; k++) {
        double work = 0;
        for (uint32_t t = order->chunk[cuts[k]]; t < order->chunk[cuts[k + 1]]; t++) {
            work += order->stretch[t].end - order->stretch[t].begin;
        }
        all = fmax(all, clock[k]);
        *longest = fmax(*longest, work);
    }
    free(ended);
    return all;
}

// A pool that two threads share: wherever the cut is, within a row of blocks too, neither waits for
// the other, though news take as long as a stretch's work.
static void test_order_of_two_parts_without_waiting(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        struct mpm_order order = {0};
        struct mpm_grid grid = {.dim = dim, .n_blocks = {8, dim == 2 ? 6 : 3, dim == 2 ? 1 : 6}};
        const uint32_t n_blocks =
            (uint32_t)(grid.n_blocks[0] * grid.n_blocks[1] * grid.n_blocks[2]);
        const uint32_t per_block = dim == 2 ? 64 : 128;
        for (uint32_t block = 0; block < n_blocks; block++) {
            assert_true(mpm_order_reserve(&order, block + 1));
            order.tile[order.n_tiles++] = (struct mpm_tile){
                .begin = block * per_block, .end = (block + 1) * per_block, .block = block};
        }
        assert_true(mpm_order_stretches(&order, &grid, MPM_BSPLINE2, 2));
        for (uint32_t cut = (uint32_t)order.n_chunks / 3; cut <= 2 * order.n_chunks / 3; cut++) {
            const uint32_t cuts[] = {0, cut, (uint32_t)order.n_chunks};
            double longest;
            mpm_order_share(&order, cuts, 2);
            const double time = time_of_parts(&order, cuts, 2, 128, &longest);
            if (time > longest) {
                fail_msg("%dD, cut at chunk %u of %zu: %g, where the longer part is %g", dim, cut,
                         order.n_chunks, time, longest);
            }
        }
        mpm_order_free(&order);
    }
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_order_stretches_of_random_bodies),
        cmocka_unit_test(test_order_of_two_parts_without_waiting),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
