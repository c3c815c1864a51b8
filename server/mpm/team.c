// Threads that stand by for a step: they look at a word of memory for a while, and then wait for it
// in the kernel, so that threads that outnumber the cores give way to each other. How long they
// look follows what came of it.
#include "server/mpm/team.h"

#include <limits.h>
#include <sched.h>
#include <stddef.h>
#include <stdlib.h>
#ifdef __linux__
#include <linux/futex.h>
#include <linux/membarrier.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif
#ifdef _OPENMP
#include <omp.h>
#endif

#include "server/mpm/simd.h"

// How often a thread looks at a word before it sleeps: each time takes some 17 ns, up to three
// times that where the processor's pause is long. To be woken takes as long as one or two thousand
// looks; so it goes on while that mostly spares the sleep. Where threads outnumber the cores it
// does not: then looks take time from who is waited for.
#define MANY_LOOKS 4000
#define FEW_LOOKS 100
// Waits that outlast the few, after which it decides: half of them may outlast the many, too. After
// so many sleeps it tries again.
#define WAITS_OF_MANY 16
#define WAITS_OF_FEW 256

// Who goes to sleep says so and then looks at the word again; who changes the word then looks
// whether anyone sleeps. One of them sees the other only if neither's store waits behind its look.
// Words change at every stretch and sleep is rare, so the sleeper pays for both: the kernel has
// every running thread of the process pass a barrier (membarrier(2)). Where it cannot, each pays
// its own.
static void fence_all(const struct mpm_team *team) {
    atomic_thread_fence(memory_order_seq_cst);
#ifdef __linux__
    if (!team->fences) {
        syscall(SYS_membarrier, MEMBARRIER_CMD_PRIVATE_EXPEDITED, 0, 0);
    }
#else
    (void)team;
#endif
}

static void learn(struct mpm_seat *seat, bool slept) {
    const bool many = seat->looks == MANY_LOOKS;
    seat->slept += slept;
    if (++seat->waits == (many ? WAITS_OF_MANY : WAITS_OF_FEW)) {
        seat->looks = many && seat->slept > WAITS_OF_MANY / 2 ? FEW_LOOKS : MANY_LOOKS;
        seat->waits = seat->slept = 0;
    }
}

void mpm_team_await(struct mpm_team *team, int own, atomic_uint *word, unsigned old) {
    struct mpm_seat *seat = &team->seats[own];
    for (int k = 0; k < seat->looks; k++) {
        if (atomic_load_explicit(word, memory_order_acquire) != old) {
            if (k >= FEW_LOOKS) {
                learn(seat, false);
            }
            return;
        }
        mpm_pause();
    }
    learn(seat, true);
    atomic_fetch_add(&team->asleep, 1);
    fence_all(team);
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
    if (team->fences) {
        atomic_thread_fence(memory_order_seq_cst);
    } else {
        atomic_signal_fence(memory_order_seq_cst); // the compiler keeps the order
    }
    if (atomic_load_explicit(&team->asleep, memory_order_relaxed) > 0) {
        syscall(SYS_futex, word, FUTEX_WAKE_PRIVATE, INT_MAX, NULL, NULL, 0);
    }
#else
    (void)team;
    (void)word;
#endif
}

struct mpm_team *mpm_team_create(int n_threads) {
    const size_t seats = (size_t)n_threads * sizeof(struct mpm_seat);
    struct mpm_team *team = aligned_alloc(64, sizeof *team);
    struct mpm_seat *seat = aligned_alloc(64, seats);
    if (!team || !seat) {
        free(team);
        free(seat);
        return NULL;
    }
    *team = (struct mpm_team){.n_threads = n_threads, .n_there = 1, .seats = seat};
    for (int k = 0; k < n_threads; k++) {
        seat[k] = (struct mpm_seat){.looks = MANY_LOOKS};
    }
#ifdef __linux__
    team->fences =
        n_threads > 1 && syscall(SYS_membarrier, MEMBARRIER_CMD_REGISTER_PRIVATE_EXPEDITED, 0, 0);
#endif
    return team;
}

void mpm_team_free(struct mpm_team *team) {
    if (team) {
        free(team->seats);
        free(team);
    }
}

// Says that a thread has come to a barrier, and returns which it is.
static unsigned come(struct mpm_team *team, int own) {
    atomic_uint *met = &team->seats[own].met;
    const unsigned barrier = atomic_load_explicit(met, memory_order_relaxed) + 1;
    atomic_store_explicit(met, barrier, memory_order_release);
    mpm_team_tell(team, met);
    return barrier;
}

// Waits until a thread has come to a barrier; it may be past it.
static void await_at(struct mpm_team *team, int own, int other, unsigned barrier) {
    atomic_uint *met = &team->seats[other].met;
    for (unsigned now;
         (int)((now = atomic_load_explicit(met, memory_order_acquire)) - barrier) < 0;) {
        mpm_team_await(team, own, met, now);
    }
}

// Each looks at all others: so it takes one way between two cores, not the way to a common word and
// back.
void mpm_team_barrier(struct mpm_team *team, int own, int there) {
    if (there == 1) {
        return;
    }
    const unsigned barrier = come(team, own);
    for (int k = 0; k < there; k++) {
        if (k != own) {
            await_at(team, own, k, barrier);
        }
    }
}

static void next_round(struct mpm_team *team) {
    const unsigned round = atomic_load_explicit(&team->round, memory_order_relaxed) + 1;
    atomic_store_explicit(&team->round, round, memory_order_release);
    mpm_team_tell(team, &team->round);
}

static void serve(struct mpm_team *team, unsigned round, int own, int there) {
    for (;;) {
        mpm_team_await(team, own, &team->round, round++);
        if (team->over) {
            return;
        }
        team->work(team->context, own, there);
        come(team, own);
    }
}

void mpm_team_hold(struct mpm_team *team, void (*body)(void *context), void *context) {
#ifdef _OPENMP
    if (team->n_threads > 1 && !team->held) {
        const unsigned round = atomic_load(&team->round);
        for (int k = 0; k < team->n_threads; k++) {
            atomic_init(&team->seats[k].met, 0);
        }
        team->over = false;
#pragma omp parallel num_threads(team->n_threads)
        {
            const int own = omp_get_thread_num(), there = omp_get_num_threads();
            if (own > 0) {
                serve(team, round, own, there);
            } else {
                team->n_there = there;
                team->held = true;
                body(context);
                team->held = false;
                team->n_there = 1;
                team->over = true;
                next_round(team);
            }
        }
        return;
    }
#endif
    body(context);
}

void mpm_team_run(struct mpm_team *team, mpm_team_work *work, void *context) {
    const int there = team->n_there;
    if (there > 1) {
        team->work = work;
        team->context = context;
        next_round(team);
        work(context, 0, there);
        const unsigned end = come(team, 0);
        for (int k = 1; k < there; k++) {
            await_at(team, 0, k, end);
        }
        return;
    }
#ifdef _OPENMP
    if (team->n_threads > 1 && !team->held) {
        for (int k = 0; k < team->n_threads; k++) {
            atomic_init(&team->seats[k].met, 0);
        }
#pragma omp parallel num_threads(team->n_threads)
        work(context, omp_get_thread_num(), omp_get_num_threads());
        return;
    }
#endif
    work(context, 0, 1);
}
