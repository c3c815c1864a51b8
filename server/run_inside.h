// The inside of struct run, for run.c (what others call) and run_loop.c (the thread) only.
#pragma once
#include <pthread.h>
#include <stdatomic.h>

#include "server/history.h"
#include "server/run.h"

#define ETA_SAMPLES 16

// Frames that an earlier daemon wrote and that are simulated again: compared, not published.
struct replay {
    uint64_t end;  // frames in the journal when this began
    size_t change; // next of the changes to make again
    cJSON *scene;  // as run, with those made so far
};

struct run {
    // Fixed from creation on.
    const struct run_host *host;
    char id[RUN_ID_MAX + 1];
    struct history_meta meta;
    struct journal *journal;     // NULL: the folder is damaged
    struct recorders *recorders; // NULL with the journal
    struct outlet *outlet;
    struct slot slot;
    pthread_t thread;
    bool has_thread;
    atomic_uint references;

    // Under `lock`, which is never held while stepping.
    pthread_mutex_t lock;
    pthread_cond_t wake; // of the run's thread
    pthread_cond_t done; // a command was answered
    pthread_cond_t told; // something has happened that others may want to know
    uint64_t news;       // how much
    struct run_command *queue;
    unsigned n_queued;
    bool accepts;             // commands are still being answered
    struct run_status status; // the copy that others read
    uint64_t version;         // of what others read here
    struct run_view viewed;   // what `view` tells of
    char *view;               // see run_view_text(); NULL before it was asked for
    char *scene_text, *config_text;
    cJSON *changes;        // of the configuration, as the API tells them
    struct series *series; // set once

    atomic_bool knock;  // look at the queue, the slot or the outlet
    atomic_bool stop;   // the daemon ends
    atomic_int viewers; // over HTTP
    atomic_bool over;   // the thread has nothing more to do: joining it takes no time

    // The thread's own.
    struct run_status now; // what `status` is copied from
    struct scene *scene;
    cJSON *scene_json; // as run, with all changes so far
    struct scene_config config;
    struct mpm_sim *sim;
    size_t sim_bytes; // estimate
    double *row;      // (columns) scratch for a sample
    struct history history;
    struct replay replay;
    size_t memory_told; // bytes that RUN_WARNING_MEMORY says are free; SIZE_MAX: it is not there
    bool wants_sim;   // a new run that is paused: so that its first frame is there
    bool due;         // a frame has to be taken at this step
    bool lonely;      // waits for subscribers before its first frame
    uint64_t metered; // steps that the daemon's meters have counted
    uint64_t next_seq;
    uint64_t stop_step; // of :step
    double stop_time;
    enum run_state ending; // a final state that waits for its last frame, or RUN_N_STATES
    bool end_pushed;
    double wall_from;                // when the step loop was entered, NaN outside
    double wait_from;                // likewise waiting
    double phase_base[MPM_N_PHASES]; // of an earlier daemon
    double next_frame, next_sample;  // s of simulated time
    double last_published, last_checkpoint, last_balance, balance_cost, last_flush;
    uint64_t checkpoint_step, checkpoint_revision; // what the newest checkpoint holds
    bool has_checkpoint;
    double eta_wall[ETA_SAMPLES], eta_time[ETA_SAMPLES]; // a ring of the last seconds
    unsigned n_eta;
};

#define RUN_WARNING_MEMORY "waits for memory: " // of a run that is queued

// What an action means in a state.
enum run_verdict { RUN_REFUSED, RUN_ACTS, RUN_ALREADY };
enum run_verdict run_verdict(enum run_action action, enum run_state state);

void run_tell(struct run *run); // wakes who waits for news
// ---- run_loop.c
void *run_thread(void *run);
// Takes the frames and makes the changes that belong to this step, in the order in which they were
// first made. A frame that finds no room stays `due`.
void run_boundary(struct run *run);

// ---- run_status.c
// Fills now.* that come from the scene alone, and scene_text and config_text.
void run_describe(struct run *run);
void run_warn(struct run_status *status, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
// Drops the warnings that begin so: what they tell of is over.
void run_unwarn(struct run_status *status, const char *beginning);
void run_account(struct run *run, enum run_phase phase,
                 double since);       // seconds, inside the step loop
void run_wall_enter(struct run *run); // the step loop
void run_wall_leave(struct run *run);
void run_wall_wait(struct run *run);               // leaves it to wait
void run_status_fill(struct run *run, bool exact); // `now` from the simulation; exact: sums as well
void run_status_publish(struct run *run, bool exact);
struct run_status
run_status_until_now(const struct run *run); // with the present stretch of running
// Appends to the event log and publishes; takes the event.
enum journal_result run_event_log(struct run *run, cJSON *event, char *why);
void run_state_enter(struct run *run, enum run_state state);
// From here on the run only waits to write its last frame.
void run_end_with(struct run *run, enum run_state state);
void run_fail(struct run *run, const char *kind, const char *advice, const char *detail);
void run_fail_with(struct run *run, const struct mpm_error *error);

// ---- run_frames.c
double run_next_multiple(double time, double interval, double dt);
bool run_reached(double time, double next, double dt);
void run_schedule(struct run *run); // next_frame and next_sample from the present time
void run_begin_epoch(struct run *run, const char *what);
void run_sample(struct run *run);
bool run_series_prepare(struct run *run); // false without memory
void run_frame_take(struct run *run, enum run_state state, bool end);
struct outlet_frame *run_frame_again(struct run *run, enum run_state state);

// ---- run_config.c
void run_power(struct run *run); // the journal's durability as configured; warns where it fails
enum run_outcome run_configure(struct run *run, struct run_command *command);
const struct history_change *run_change_due(const struct run *run); // NULL when there is none
void run_change_next(struct run *run);                              // makes it again
void run_changes_forget(struct run *run);                           // once all are made again
bool run_replay_scene(struct run *run);

// ---- run_checkpoint.c
enum journal_result run_checkpoint(struct run *run, char *why);
bool run_sim_begin(struct run *run);      // with a slot
bool run_sim_begin_idle(struct run *run); // without one; false when there is no memory now
