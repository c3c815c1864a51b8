// All runs of the daemon: creation, look-up, deletion, and what is found on disk at the start.
#pragma once
#include "server/run.h"

struct runs;

struct runs *runs_create(const struct run_host *host, int slots, int queue);
// Lists the runs that earlier daemons left, and continues those that `how` says.
void runs_restore(struct runs *runs, enum run_restore how);
// No more runs; every run makes its checkpoint and ends its thread.
void runs_stop(struct runs *runs);
void runs_free(struct runs *runs); // after runs_stop

// Of the ids of runs, and of the names of recorders.
#define RUNS_ID_PATTERN "[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
bool runs_id_valid(const char *id); // whether it matches

enum runs_result {
    RUNS_CREATED,
    RUNS_THERE,      // created before by the same request of the same key: `out` is that run
    RUNS_KEY_REUSED, // the key was used for another request
    RUNS_DUPLICATE,
    RUNS_FULL,
    RUNS_STORAGE,
    RUNS_MEMORY,
    RUNS_STOPPED,
};
// What runs_add would say now of a run with this key and id (NULL: none; then no id is taken), as
// far as that is known without its scene: RUNS_CREATED where nothing speaks against it. Of `out`
// and `why` the same holds, but that nothing is made.
enum runs_result runs_admit(struct runs *runs, const struct run_definition *definition,
                            struct run **out, char *why);
// On RUNS_CREATED and RUNS_THERE `out` is retained for the caller; on RUNS_CREATED the scene is the
// run's; else the scene stays the caller's and `why` (JOURNAL_WHY bytes) says why. An id of NULL
// has one made from the name.
enum runs_result runs_add(struct runs *runs, const struct run_definition *definition,
                          struct run **out, char *why);
struct run *runs_find(struct runs *runs, const char *id); // retained; NULL when there is none
// All, oldest first, each retained; the caller releases them and frees the array.
struct run **runs_all(struct runs *runs, size_t *count);

enum runs_removal { RUNS_REMOVED, RUNS_MISSING, RUNS_ALIVE, RUNS_REMOVAL_FAILED };
enum runs_removal runs_remove(struct runs *runs, const char *id, enum run_state *state, char *why);
bool runs_ready(struct runs *runs, char *why); // able to take a run; else `why` (JOURNAL_WHY bytes)
