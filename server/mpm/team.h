// The threads of one simulation, which stand by for a whole step.
//
// A step is a dozen short pieces of parallel work. To open an OpenMP region for each, and to meet
// at its barriers, takes some microseconds a piece, as long as a small scene's work itself; threads
// that stand by for the step take a fraction of that. OpenMP makes the threads and lends them for
// the step.
#pragma once
#include <stdatomic.h>

// What thread `own` of `there` does of a piece of work. All take part, each once.
typedef void mpm_team_work(void *context, int own, int there);

struct mpm_team {
    int n_threads; // wanted; OpenMP may give fewer
    int n_there;   // that stand by; 1 outside mpm_team_hold
    int over;
    mpm_team_work *work;
    void *context;
    // What others wait for, a cache line each.
    _Alignas(64) atomic_uint round;   // of work
    _Alignas(64) atomic_uint at_work; // threads that have not yet done their part
    _Alignas(64) atomic_uint met;     // at the barrier
    _Alignas(64) atomic_uint meeting; // barriers that all have come to
    _Alignas(64) atomic_uint asleep;  // threads that wait in the kernel
};

void mpm_team_create(struct mpm_team *team, int n_threads);
// Calls body(context) with the team standing by. Not within another of the same team.
void mpm_team_hold(struct mpm_team *team, void (*body)(void *context), void *context);
// Has all do their parts and waits for them; outside mpm_team_hold in an OpenMP region of its own.
// Memory that was written before is seen by all parts, and what they write by who called.
void mpm_team_run(struct mpm_team *team, mpm_team_work *work, void *context);
// Within such work: waits until all `there` have come here.
void mpm_team_barrier(struct mpm_team *team, int there);
// Within such work: waits until the word is not `old`; who changes it tells the team.
void mpm_team_await(struct mpm_team *team, atomic_uint *word, unsigned old);
void mpm_team_tell(struct mpm_team *team, atomic_uint *word);
