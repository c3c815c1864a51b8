// The threads of one simulation, which stand by for a whole step.
//
// A step is parallel work with some meetings. To open an OpenMP region for it, and to meet at
// its barriers, takes some microseconds a piece, as long as a small scene's work itself; threads
// that stand by for the step take a fraction of that. OpenMP makes the threads and lends them for
// the step.
#pragma once
#include <stdatomic.h>
#include <stdbool.h>

// What thread `own` of `there` does of a piece of work. All take part, each once.
typedef void mpm_team_work(void *context, int own, int there);

// What one thread says to the others has a cache line of its own, and all that is said at once lies
// in one: to fetch a line that another core has changed takes longer than all else of a meeting.
struct mpm_seat {
    _Alignas(64) atomic_uint met; // barriers and ends of rounds that the thread has come to
    // For itself: how often it looks before it sleeps, and what came of that in so many waits.
    _Alignas(64) int looks, waits, slept;
};

#define MPM_GIVEN 5 // numbers; they fill up the line that says that there is work
struct mpm_team {
    int n_threads; // wanted; OpenMP may give fewer
    int n_there;   // that stand by; 1 outside mpm_team_hold
    bool held;
    bool fences;            // the kernel has no barrier for all threads at once: see mpm_team_tell
    struct mpm_seat *seats; // (n_threads)
    _Alignas(64) atomic_uint round; // of work, which is what follows
    bool over;
    mpm_team_work *work;
    void *context;
    double given[MPM_GIVEN]; // for the work: what changes from one to the next, in the same line
    _Alignas(64) atomic_uint asleep; // threads that wait in the kernel
};

// NULL when memory is short.
struct mpm_team *mpm_team_create(int n_threads);
void mpm_team_free(struct mpm_team *team);
// Calls body(context) with the team standing by. Within another of the same team it is just called.
void mpm_team_hold(struct mpm_team *team, void (*body)(void *context), void *context);
// Has all do their parts and waits for them; outside mpm_team_hold in an OpenMP region of its own.
// Memory that was written before is seen by all parts, and what they write by who called.
void mpm_team_run(struct mpm_team *team, mpm_team_work *work, void *context);
// Within such work: waits until all `there` have come here.
void mpm_team_barrier(struct mpm_team *team, int own, int there);
// Within such work: thread `own` waits until the word is not `old`. Who changes it stores with
// release order, and then tells the team.
void mpm_team_await(struct mpm_team *team, int own, atomic_uint *word, unsigned old);
void mpm_team_tell(struct mpm_team *team, atomic_uint *word);
