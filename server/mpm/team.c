// Threads that stand by for a step: they look at a word of memory for some ten microseconds, as
// long as a wake-up takes, and then wait for it in the kernel, so that threads that outnumber the
// cores give way to each other.
#include "server/mpm/team.h"

#include <limits.h>
#include <sched.h>
#include <stddef.h>
#ifdef __linux__
#include <linux/futex.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif
#ifdef _OPENMP
#include <omp.h>
#endif

#define LOOKS 1000

static void pause_a_moment(void) {
#if defined __x86_64__
    __builtin_ia32_pause();
#endif
}

void mpm_team_await(struct mpm_team *team, atomic_uint *word, unsigned old) {
    for (int k = 0; k < LOOKS; k++) {
        if (atomic_load_explicit(word, memory_order_acquire) != old) {
            return;
        }
        pause_a_moment();
    }
    // In this order, with mpm_team_tell() in the opposite one: either it sees a sleeper or we its
    // change.
    atomic_fetch_add(&team->asleep, 1);
    while (atomic_load(word) == old) {
#ifdef __linux__
        syscall(SYS_futex, word, FUTEX_WAIT_PRIVATE, old, NULL, NULL, 0);
#else
        sched_yield();
#endif
    }
    atomic_fetch_sub(&team->asleep, 1);
}

void mpm_team_tell(struct mpm_team *team, atomic_uint *word) {
#ifdef __linux__
    if (atomic_load(&team->asleep) > 0) {
        syscall(SYS_futex, word, FUTEX_WAKE_PRIVATE, INT_MAX, NULL, NULL, 0);
    }
#else
    (void)team;
    (void)word;
#endif
}

void mpm_team_create(struct mpm_team *team, int n_threads) {
    *team = (struct mpm_team){.n_threads = n_threads, .n_there = 1};
}

void mpm_team_barrier(struct mpm_team *team, int there) {
    if (there == 1) {
        return;
    }
    const unsigned meeting = atomic_load_explicit(&team->meeting, memory_order_relaxed);
    if (atomic_fetch_add(&team->met, 1) + 1 < (unsigned)there) {
        mpm_team_await(team, &team->meeting, meeting);
        return;
    }
    atomic_store_explicit(&team->met, 0, memory_order_relaxed);
    atomic_fetch_add(&team->meeting, 1);
    mpm_team_tell(team, &team->meeting);
}

static void serve(struct mpm_team *team, unsigned round, int own, int there) {
    for (;;) {
        mpm_team_await(team, &team->round, round++);
        if (team->over) {
            return;
        }
        team->work(team->context, own, there);
        if (atomic_fetch_sub(&team->at_work, 1) == 1) {
            mpm_team_tell(team, &team->at_work);
        }
    }
}

static void next_round(struct mpm_team *team) {
    atomic_fetch_add(&team->round, 1);
    mpm_team_tell(team, &team->round);
}

void mpm_team_hold(struct mpm_team *team, void (*body)(void *context), void *context) {
#ifdef _OPENMP
    if (team->n_threads > 1) {
        const unsigned round = atomic_load(&team->round);
        team->over = 0;
#pragma omp parallel num_threads(team->n_threads)
        {
            const int own = omp_get_thread_num(), there = omp_get_num_threads();
            if (own > 0) {
                serve(team, round, own, there);
            } else {
                team->n_there = there;
                body(context);
                team->n_there = 1;
                team->over = 1;
                next_round(team);
            }
        }
        return;
    }
#endif
    body(context);
}

void mpm_team_run(struct mpm_team *team, mpm_team_work *work, void *context) {
    if (team->n_there > 1) {
        team->work = work;
        team->context = context;
        atomic_store_explicit(&team->at_work, (unsigned)team->n_there - 1, memory_order_relaxed);
        next_round(team);
        work(context, 0, team->n_there);
        for (unsigned left; (left = atomic_load(&team->at_work)) > 0;) {
            mpm_team_await(team, &team->at_work, left);
        }
        return;
    }
#ifdef _OPENMP
    if (team->n_threads > 1) {
#pragma omp parallel num_threads(team->n_threads)
        work(context, omp_get_thread_num(), omp_get_num_threads());
        return;
    }
#endif
    work(context, 0, 1);
}
