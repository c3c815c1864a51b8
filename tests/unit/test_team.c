// Threads that stand by: each part is done once, what was written before is seen, and all meet.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <cmocka.h>

#include "server/mpm/team.h"

#define MOST 7 // threads: more than most machines have cores, so that some wait in the kernel
#define ROUNDS 300

struct count {
    struct mpm_team *team;
    int there;
    unsigned done[MOST]; // parts, by each thread
    unsigned sum, given; // sum: of what all have read of `given`
    unsigned read[MOST];
};

static void take_part(void *context, int own, int there) {
    struct count *c = context;
    c->done[own]++;
    c->read[own] = c->given;
    if (own == 0) {
        c->there = there;
    }
    mpm_team_barrier(c->team, own, there);
    if (own == there - 1) { // what all wrote before the barrier is there after it
        for (int k = 0; k < there; k++) {
            c->sum += c->read[k];
        }
    }
    mpm_team_barrier(c->team, own, there);
    c->read[own] = 0;
}

static void rounds(void *context) {
    struct count *c = context;
    for (unsigned k = 1; k <= ROUNDS; k++) {
        c->given = k;
        c->sum = 0;
        mpm_team_run(c->team, take_part, c);
        if (c->sum != k * (unsigned)c->there) {
            fail_msg("round %u: %u of %d threads", k, c->sum, c->there);
        }
        for (int own = 0; own < c->there; own++) { // the end of the work is a barrier, too
            assert_int_equal(c->read[own], 0);
        }
    }
}

static void test_team_does_each_part_once(void **state) {
    (void)state;
    for (int n = 1; n <= MOST; n += 3) {
        struct mpm_team *team = mpm_team_create(n);
        assert_non_null(team);
        for (int held = 0; held < 2; held++) {
            struct count c = {.team = team};
            if (held) {
                mpm_team_hold(team, rounds, &c);
            } else {
                rounds(&c); // each in a region of its own
            }
            assert_true(c.there >= 1 && c.there <= n);
            for (int own = 0; own < MOST; own++) {
                assert_int_equal(c.done[own], own < c.there ? ROUNDS : 0);
            }
        }
        mpm_team_free(team);
    }
}

static void hold_again(void *context) {
    struct count *c = context;
    c->given = 1;
    mpm_team_run(c->team, take_part, c);
}

// A step after the other: what one leaves does not end or begin the next.
static void test_team_can_be_held_again(void **state) {
    (void)state;
    struct mpm_team *team = mpm_team_create(3);
    assert_non_null(team);
    struct count c = {.team = team};
    for (int k = 0; k < ROUNDS; k++) {
        mpm_team_hold(team, hold_again, &c);
        assert_int_equal(c.done[0], k + 1);
    }
    mpm_team_free(team);
}

static void come_late(void *context, int own, int there) {
    struct mpm_team *team = context;
    if (own == there - 1) {
        const struct timespec a_while = {.tv_nsec = 1000000}; // many looks take a fifth of it
        nanosleep(&a_while, NULL);
    }
    mpm_team_barrier(team, own, there);
}

static void wait_for_late_ones(void *context) {
    struct mpm_team *team = context;
    const int *looks = &team->seats[0].looks, many = *looks;
    int k = 0;
    for (; k < 10 * ROUNDS && team->n_there > 1 && *looks == many; k++) {
        mpm_team_run(team, come_late, team);
    }
    assert_true(*looks < many || team->n_there == 1);
    for (; k < 20 * ROUNDS && *looks < many; k++) {
        mpm_team_run(team, come_late, team);
    }
    assert_int_equal(*looks, many);
}

// Who waits in vain looks less often before it sleeps, and later tries again.
static void test_team_learns_how_long_to_look(void **state) {
    (void)state;
    struct mpm_team *team = mpm_team_create(2);
    assert_non_null(team);
    mpm_team_hold(team, wait_for_late_ones, team);
    mpm_team_free(team);
}

static void race(void *context, int own, int there) {
    (void)own, (void)there;
    ++*(int *)context;
}

// Wrong on purpose, and run only when asked for by name: what ThreadSanitizer has to see, or its
// silence on the solver says nothing (make check-tsan-solver).
static void test_race(void **state) {
    (void)state;
    int n = 0;
    struct mpm_team *team = mpm_team_create(2);
    assert_non_null(team);
    for (int k = 0; k < ROUNDS; k++) {
        mpm_team_run(team, race, &n);
    }
    mpm_team_free(team);
}

int main(int argc, char **argv) {
    if (argc > 1 && strcmp(argv[1], "test_race") == 0) {
        const struct CMUnitTest wrong[] = {cmocka_unit_test(test_race)};
        return cmocka_run_group_tests(wrong, NULL, NULL);
    }
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_team_does_each_part_once),
        cmocka_unit_test(test_team_can_be_held_again),
        cmocka_unit_test(test_team_learns_how_long_to_look),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
