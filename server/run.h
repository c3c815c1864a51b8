// One run: the thread that owns its simulation, its states, and the commands that reach it.
//
// The run's thread is the only one that touches the simulation. Others post a command, which takes
// effect between two steps, or read the status copy (docs/design.md).
#pragma once
#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/journal.h"
#include "server/publish.h"
#include "server/recorders.h"
#include "server/scene.h"
#include "server/series.h"
#include "server/slots.h"

#define RUN_ID_MAX 64
#define RUN_NAME_MAX 128
#define RUN_QUEUE 32 // commands that may wait for the next step boundary
#define RUN_WARNINGS 8
#define RUN_KEY_MAX 255
#define RUN_SUBSCRIBERS_MAX 10000

#define RUN_STATE_LIST(X)                                                                          \
    X(QUEUED, "queued")                                                                            \
    X(RUNNING, "running")                                                                          \
    X(WAITING, "waiting")                                                                          \
    X(PAUSED, "paused") X(COMPLETED, "completed") X(FAILED, "failed") X(CANCELLED, "cancelled")
enum run_state {
#define X(code, text) RUN_##code,
    RUN_STATE_LIST(X)
#undef X
        RUN_N_STATES
};
const char *run_state_name(enum run_state state);
int run_state_parse(const char *name); // -1 when there is none
bool run_state_is_final(enum run_state state);

#define RUN_ACTION_LIST(X)                                                                         \
    X(START, "start")                                                                              \
    X(PAUSE, "pause")                                                                              \
    X(RESUME, "resume")                                                                            \
    X(STEP, "step")                                                                                \
    X(CANCEL, "cancel")                                                                            \
    X(CHECKPOINT, "checkpoint") X(SNAPSHOT, "snapshot") X(CONFIGURE, "configure")
enum run_action {
#define X(code, text) RUN_DO_##code,
    RUN_ACTION_LIST(X)
#undef X
        RUN_N_ACTIONS
};
const char *run_action_name(enum run_action action);

// Where the seconds of the step loop go: the solver's phases, then these.
#define RUN_PHASE_LIST(X)                                                                          \
    X(PROBES, "probes")                                                                            \
    X(OUTPUT, "output") X(CHECKPOINTS, "checkpoints") X(OTHER, "other") X(WAITING, "waiting")
enum run_phase {
    RUN_PHASE_FIRST = MPM_N_PHASES - 1,
#define X(code, text) RUN_PHASE_##code,
    RUN_PHASE_LIST(X)
#undef X
        RUN_N_PHASES
};
const char *run_phase_name(int phase);

struct run_error {
    bool present;
    char kind[32]; // mpm_status_name, or "journal"
    uint64_t step;
    double time;
    int64_t particle; // -1: not about one
    char quantity[32];
    double value;
    char advice[256], detail[512];
};

// What others see of a run; a plain copy.
struct run_status {
    enum run_state state;
    uint64_t step, stage, particles, nodes, bytes;
    int threads;
    double time, start_time, end_time; // s
    double dt, dt_limit;               // s, of the next step
    double eta_s;                      // s of wall time, NaN when unknown
    bool fbar;
    enum mpm_fbar_scheme fbar_scheme;
    uint64_t epoch, revision; // revision: changes of the configuration so far
    double wall_s;            // inside the step loop
    double phases[RUN_N_PHASES];
    struct mpm_balance balance;
    uint64_t balance_step;
    struct run_error error;
    unsigned n_warnings;
    char warnings[RUN_WARNINGS][240];
};

// A reference value that the scene cites.
struct run_reference {
    size_t probe;  // index in the series
    int component; // of a vector probe
    char *name;    // of the probe; owned by the run
    bool at_end;
    double at, value, tolerance;
    char *source; // owned by the run
};

// What all runs have done since the daemon began.
struct run_meters {
    atomic_ullong steps, particle_steps;
};

// Rung when something has happened to any run, for those who watch all of them.
struct run_bell {
    pthread_mutex_t lock;
    pthread_cond_t rung;
    uint64_t count;
};
void run_bell_init(struct run_bell *bell);
void run_bell_destroy(struct run_bell *bell);
void run_bell_ring(struct run_bell *bell); // NULL is nobody's
// As run_news: waits until it was rung since `seen` was returned, at most `seconds`.
uint64_t run_bell_wait(struct run_bell *bell, uint64_t seen, double seconds);

// What a run needs of the daemon; outlives every run.
struct run_host {
    const char *data_dir;
    struct publisher *publisher;
    struct slots *slots;
    int threads;      // of a run,
    bool threads_fit; // or fewer, as many as its size repays (run_threads)
    enum mpm_isa isa;
    size_t memory_limit;
    struct run_meters *meters; // may be NULL
    struct run_bell *bell;     // may be NULL
};

// Particles that repay a thread: with fewer each, the barriers of a step take longer than its work
// is shortened by, many times longer where other programs want the cores (`make bench-threads`).
#define RUN_PARTICLES_PER_THREAD 4096
// Solver threads of a run of so many particles. Its results do not depend on them.
int run_threads(const struct run_host *host, uint64_t particles);

// The warnings that the scene alone calls for, of the F-bar, dt and dt_limit in `status`.
void run_warn_scene(struct run_status *status, const struct mpm_def *def);

double run_clock(void); // monotonic seconds

struct run;

struct run_definition {
    const char *id;
    const char *name;    // of the scene: a built-in's name, or the inline scene's title
    struct scene *scene; // valid; the run owns it once it is created
    bool start;
    const char *recorders[RECORDERS_MAX]; // registered before its first frame
    size_t n_recorders;
    uint64_t wait_subscribers; // who must listen before its first frame is taken
    const char *key;           // of an idempotent creation, or NULL
    const char *request;       // with it: what the key stands for, at most 16 characters
};
// A new run with its folder and its thread. NULL with a sentence in `why`; then the scene is still
// the caller's. `storage`: whether it was the disk that refused, and not memory or threads.
struct run *run_create(const struct run_host *host, const struct run_definition *definition,
                       bool *storage, char *why);
// A run that an earlier daemon left. Never fails but for memory: what cannot be read is a run that
// has failed, with the reason as its error.
enum run_restore { RUN_RESTORE_CONTINUE, RUN_RESTORE_PAUSE, RUN_RESTORE_KEEP };
struct run *run_restore(const struct run_host *host, const char *id, enum run_restore how);
// Ends the thread, with a checkpoint; the files stay. First ask all, then stop each.
void run_ask_to_stop(struct run *run);
void run_join(struct run *run);
// Joins the thread of a run that is over: until then its stack stays. Not by two at once.
void run_reap(struct run *run);
// A run is shared: run_release by the last one ends its thread and frees it.
void run_retain(struct run *run);
void run_release(struct run *run);

const char *run_id(const struct run *run);
const char *run_name(const struct run *run);
const char *run_created(const struct run *run); // RFC 3339
const char *run_key(const struct run *run);     // Idempotency-Key of its creation, or ""
const char *run_request(const struct run *run); // and the digest of that request
struct run_status run_status(struct run *run);
char *run_scene_text(struct run *run);                      // JSON as run; the caller frees it
char *run_config_text(struct run *run, uint64_t *revision); // the settable part of it
#define RUN_CHANGES 32               // of the configuration that a run object tells of: the newest
cJSON *run_changes(struct run *run); // [{revision, step, time, patch}] of them; new
struct series *run_series(struct run *run);       // NULL before there are probes
struct journal *run_journal(struct run *run);     // NULL when its folder is damaged
struct recorders *run_recorders(struct run *run); // likewise
// Waits until something has happened to the run since `seen` was returned (an event, a frame, a
// change of state), at most `seconds`; what to pass the next time.
uint64_t run_news(struct run *run, uint64_t seen, double seconds);
bool run_stopping(const struct run *run); // the daemon ends
// A viewer over HTTP, who counts among those that a run waits for.
void run_viewers(struct run *run, int change);
void run_nudge(struct run *run); // a recorder has acknowledged frames or is gone: there may be room
// Who asks often, or many who ask at once, mostly ask for what has been said already. Two views of
// a run that are equal make the same run object; take the view before what it is made of.
struct run_view {
    uint64_t version, frames, frames_gone, frame_bytes, samples;
};
// False where the object tells of a clock: of how long a recorder has been silent.
bool run_view(struct run *run, struct run_view *out);
char *run_view_text(struct run *run, const struct run_view *view); // as it was kept, new; or NULL
void run_view_keep(struct run *run, const struct run_view *view, const char *text);
const struct run_reference *run_references(const struct run *run, size_t *count);

enum run_outcome {
    RUN_DONE,
    RUN_ILLEGAL,  // not in this state
    RUN_INVALID,  // see faults
    RUN_STALE,    // the configuration is not the one that the caller expects
    RUN_BUSY,     // too many commands wait, or no memory now
    RUN_STORAGE,  // the disk refuses
    RUN_STOPPING, // the daemon ends
};
struct run_command {
    enum run_action action;
    uint64_t steps;     // of STEP, or 0 and
    double until;       // s
    const cJSON *patch; // of CONFIGURE, borrowed
    bool has_revision;  // CONFIGURE only when the revision is still this one
    uint64_t revision;
    // The answer:
    enum run_outcome outcome;
    enum run_state state; // that it was judged in
    uint64_t effective_step, frame_seq;
    struct faults faults; // the caller's to free
    char why[JOURNAL_WHY];
    // The run's:
    bool answered;
    struct run_command *next;
};
// Posts the command and waits until it has taken effect (or was refused).
void run_command(struct run *run, struct run_command *command);
