// The thread of a run: commands, steps, samples, frames, checkpoints, in this order at every step
// boundary. Nothing that others do (reading the status, snapshots, subscribers, pauses) changes the
// results; a change of the configuration does, and is in the event log with its step.
//
// After a restart the run continues from its newest checkpoint. Frames that the journal has already
// are simulated again and compared; changes that the log has are made again at their step.
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "server/log.h"
#include "server/run_inside.h"

#define WARNING_ROOM "waits for room "
#define WARNING_LONELY "waits for subscribers: "
#define QUEUED_SECONDS 2.0   // between two looks for what a run waits that has no slot
#define LONELY_SECONDS 0.02  // between two looks whether somebody has come
#define PUBLISH_SECONDS 0.02 // between two copies of the status
#define HELD_SECONDS 0.005   // that solver threads stand by before the state is looked at again
#define WAITING_SECONDS 0.25 // a shorter wait for the disk is not worth a change of state
#define CHECKPOINT_FLUSH 5.0 // s to wait for frames on their way before a checkpoint is given up

// ---- Step boundary ----------------------------------------------------------------------------

// Frames and changes that belong to this step, in the order in which they were first made. A frame
// that finds no room stays `due`.
void run_boundary(struct run *r) {
    const struct history_change *change;
    struct journal_frame there;
    uint64_t step = mpm_step_count(r->sim);
    while (r->next_seq < r->replay.end && r->ending == RUN_N_STATES) {
        if ((change = run_change_due(r)) != NULL && change->frames <= r->next_seq) {
            run_change_next(r);
            continue;
        }
        journal_frame(r->journal, r->next_seq, &there);
        if (there.step > step) { // what the journal holds is the schedule
            r->due = false;
            return;
        }
        if (there.step < step) {
            run_begin_epoch(r, "the continued run has no frame where the run before had one");
            break;
        }
        if (there.end)
            return; // written as the run ends
        r->due = false;
        run_frame_take(r, (enum run_state)there.state, false);
    }
    while (r->ending == RUN_N_STATES) {
        change = run_change_due(r);
        if (change != NULL && (change->frames <= r->next_seq || !r->due)) {
            run_change_next(r);
        } else if (r->due && publish_has_room(r->outlet)) {
            r->due = false;
            run_frame_take(r, r->now.state == RUN_PAUSED ? RUN_PAUSED : RUN_RUNNING, false);
        } else {
            return;
        }
    }
}

static void after_step(struct run *r, double dt) {
    double time = mpm_time(r->sim);
    bool finished = mpm_finished(r->sim);
    if (run_reached(time, r->next_sample, dt)) {
        r->next_sample = run_next_multiple(time, r->config.output.probe_interval, dt);
        run_sample(r);
    }
    if (run_reached(time, r->next_frame, dt)) {
        r->next_frame = run_next_multiple(time, r->config.output.interval, dt);
        r->due = !finished; // the last frame is taken as the run ends
    }
    if (r->due || r->next_seq < r->replay.end || r->replay.change < r->history.n_changes)
        run_boundary(r);
    if (finished)
        run_end_with(r, RUN_COMPLETED);
}

// ---- Actions ----------------------------------------------------------------------------------

static void pause_run(struct run *r) {
    char why[JOURNAL_WHY];
    run_wall_leave(r);
    slots_leave(r->host->slots, &r->slot);
    r->stop_step = UINT64_MAX;
    r->stop_time = INFINITY;
    // Before the event: a run that the log calls paused can be found at the step where it paused.
    if (r->sim != NULL)
        run_checkpoint(r, why);
    run_state_enter(r, RUN_PAUSED);
}

static void go(struct run *r) {
    size_t needs = r->sim == NULL && r->slot.reserved == 0 ? r->sim_bytes : 0;
    if (!slots_ask(r->host->slots, &r->slot, needs))
        run_state_enter(r, RUN_QUEUED);
    else if (r->lonely)
        run_state_enter(r, RUN_WAITING); // for now: the loop looks who is there
    else if (run_sim_begin(r))
        run_state_enter(r, RUN_RUNNING);
}

// Who asks for a step or a frame now does not wait for others to come.
static void stop_waiting_for_others(struct run *r) {
    if (r->lonely) {
        r->lonely = false;
        publish_await(r->outlet, false);
        run_unwarn(&r->now, WARNING_LONELY);
    }
}

static enum run_outcome step_run(struct run *r, struct run_command *c) {
    stop_waiting_for_others(r);
    if (!run_sim_begin_idle(r)) {
        snprintf(c->why, sizeof c->why, "no memory for the simulation now");
        return RUN_BUSY;
    }
    if (c->steps == 0 && c->until <= mpm_time(r->sim)) {
        char expected[64], actual[64];
        double now = mpm_time(r->sim) + 0.0; // no -0
        snprintf(expected, sizeof expected, "> %.9g s", now);
        snprintf(actual, sizeof actual, "%.9g s", c->until);
        faults_add(&c->faults, "/until", "range", expected, actual,
                   "must lie after the present time %.9g s, got %.9g s", now, c->until);
        return RUN_INVALID;
    }
    uint64_t at = mpm_step_count(r->sim);
    r->stop_step = c->steps == 0 || c->steps > UINT64_MAX - 1 - at ? UINT64_MAX : at + c->steps;
    r->stop_time = c->steps == 0 ? c->until : INFINITY;
    go(r);
    return RUN_DONE;
}

static enum run_outcome snapshot(struct run *r, struct run_command *c) {
    struct journal_frame last;
    stop_waiting_for_others(r);
    if (!run_sim_begin_idle(r)) {
        snprintf(c->why, sizeof c->why, "no memory for the simulation now");
        return RUN_BUSY;
    }
    if (r->next_seq < r->replay.end || !publish_has_room(r->outlet)) {
        snprintf(c->why, sizeof c->why, "%s",
                 journal_held(r->journal)
                     ? "the journal is full of frames that a recorder has not acknowledged"
                     : "frames are still on their way to the disk");
        return RUN_BUSY;
    }
    // Idempotent: what is there already of this very step is not taken again.
    publish_flush(r->outlet, 1);
    bool there = r->next_seq > 0 && journal_frame(r->journal, r->next_seq - 1, &last) &&
                 last.step == mpm_step_count(r->sim) && last.epoch == r->now.epoch;
    if (!there) {
        r->due = false;
        run_frame_take(r, r->now.state == RUN_PAUSED ? RUN_PAUSED : RUN_RUNNING, false);
    }
    c->frame_seq = r->next_seq - 1;
    return RUN_DONE;
}

static enum run_outcome act(struct run *r, struct run_command *c) {
    switch (c->action) {
    case RUN_DO_START:
    case RUN_DO_RESUME:
        go(r);
        return RUN_DONE;
    case RUN_DO_PAUSE:
        pause_run(r);
        return RUN_DONE;
    case RUN_DO_STEP:
        return step_run(r, c);
    case RUN_DO_CANCEL:
        run_end_with(r, RUN_CANCELLED);
        return RUN_DONE;
    case RUN_DO_CHECKPOINT:
        if (r->lonely)
            return RUN_DONE; // nothing has happened that would have to be kept
        if (!run_sim_begin_idle(r)) {
            snprintf(c->why, sizeof c->why, "no memory for the simulation now");
            return RUN_BUSY;
        }
        return run_checkpoint(r, c->why) == JOURNAL_OK ? RUN_DONE : RUN_STORAGE;
    case RUN_DO_SNAPSHOT:
        return snapshot(r, c);
    case RUN_DO_CONFIGURE:
        if (r->now.state != RUN_QUEUED && !r->lonely && !run_sim_begin_idle(r)) {
            snprintf(c->why, sizeof c->why, "no memory for the simulation now");
            return RUN_BUSY;
        }
        return run_configure(r, c);
    case RUN_N_ACTIONS:
        break;
    }
    return RUN_ILLEGAL;
}

static struct run_command *take_command(struct run *r) {
    pthread_mutex_lock(&r->lock);
    struct run_command *c = r->queue;
    if (c != NULL) {
        r->queue = c->next;
        r->n_queued--;
    }
    pthread_mutex_unlock(&r->lock);
    return c;
}

static void answer(struct run *r, struct run_command *c, enum run_outcome outcome) {
    run_status_publish(r, true);
    pthread_mutex_lock(&r->lock);
    c->outcome = outcome;
    c->effective_step = r->status.step;
    c->answered = true;
    pthread_cond_broadcast(&r->done);
    pthread_mutex_unlock(&r->lock);
}

static void finish_soon(struct run *r);

// To run is more than to do some steps, also where these still wait for a slot. The log is told,
// for a daemon that comes after a kill.
static void forget_stop(struct run *r) {
    if (r->stop_step == UINT64_MAX && !isfinite(r->stop_time))
        return;
    r->stop_step = UINT64_MAX;
    r->stop_time = INFINITY;
    run_state_enter(r, r->now.state);
}

static void obey(struct run *r) {
    struct run_command *c;
    atomic_store(&r->knock, false);
    while ((c = take_command(r)) != NULL) {
        enum run_verdict verdict = run_verdict(c->action, r->now.state);
        enum run_outcome outcome = verdict == RUN_ALREADY ? RUN_DONE : RUN_ILLEGAL;
        bool ends = r->ending != RUN_N_STATES; // only its last frame is missing
        c->state = r->now.state;
        if (ends && c->action != RUN_DO_CANCEL && verdict == RUN_ACTS) {
            snprintf(c->why, sizeof c->why, "the run is ending");
            outcome = RUN_BUSY;
        } else if (verdict == RUN_ACTS) {
            outcome = act(r, c);
        } else if (verdict == RUN_ALREADY && !ends && !run_state_is_final(r->now.state)) {
            forget_stop(r);
        }
        if (outcome == RUN_DONE && c->action == RUN_DO_CANCEL)
            finish_soon(r);
        answer(r, c, outcome);
    }
}

// ---- The end ----------------------------------------------------------------------------------

// Also while a recorder holds the budget: at the end of a run that is no obstacle.
static bool journal_works(struct run *r) {
    char why[JOURNAL_WHY];
    enum journal_result status = publish_status(r->outlet, why);
    return status == JOURNAL_OK || status == JOURNAL_HELD;
}

// The probes are in their log before the run is over. Where the disk has no room that is waited for
// (but not by an end by force); another fault is the run's.
static bool probes_safe(struct run *r) {
    int error = series_flush(r->series);
    if (error == 0 && r->config.output.durability_power)
        error = series_sync(r->series);
    if (error == 0 || r->ending != RUN_COMPLETED)
        return true;
    bool full = error == ENOSPC || error == EDQUOT;
    if (!full || !r->config.output.when_full_block) {
        char why[JOURNAL_WHY];
        snprintf(why, sizeof why, "the probes' log cannot be written: %s", strerror(error));
        run_fail(r, "journal", "look at the disk of the data folder", why);
    } else {
        run_unwarn(&r->now, WARNING_ROOM);
        run_warn(&r->now, WARNING_ROOM "on the disk: the probes' log cannot be written");
    }
    return false;
}

// Takes the last frame. False when it has to wait for the disk.
static bool end_push(struct run *r) {
    char why[JOURNAL_WHY];
    enum journal_result status = publish_status(r->outlet, why);
    if (!journal_works(r) && r->ending != RUN_COMPLETED)
        return true; // an end by force does not wait for the disk
    if (status == JOURNAL_ERROR || (status == JOURNAL_FULL && !r->config.output.when_full_block)) {
        run_fail(r, "journal", "look at the disk of the data folder", why);
        return false;
    }
    run_unwarn(&r->now, WARNING_ROOM);
    if (status == JOURNAL_FULL)
        run_warn(&r->now, WARNING_ROOM "on the disk: %.150s", why);
    if (status != JOURNAL_OK)
        return false;
    bool from_sim = r->sim != NULL && r->ending != RUN_FAILED;
    if (!publish_has_room(r->outlet) || (!from_sim && !publish_flush(r->outlet, 0)))
        return false;
    if (from_sim) {
        enum run_state ending = r->ending;
        if (ending == RUN_CANCELLED)
            run_checkpoint(r, why);
        run_sample(r);
        if (!probes_safe(r))
            return false;
        run_frame_take(r, ending, true);
        if (r->ending != ending) // no memory for it
            return false;
    } else if (journal_n_frames(r->journal) > 0) {
        struct journal_frame last;
        uint64_t n = journal_n_frames(r->journal);
        if (r->series != NULL)
            series_flush(r->series);
        bool there = journal_frame(r->journal, n - 1, &last) && last.end; // killed after it
        struct outlet_frame *frame = there ? NULL : run_frame_again(r, r->ending);
        if (frame != NULL)
            publish_push(r->outlet, frame);
    }
    return true;
}

// Brings the run to its final state, or leaves it waiting for the disk. On the disk: last frame,
// then status, then event; the state is seen by others after that.
static void finish(struct run *r) {
    char why[JOURNAL_WHY];
    if (run_state_is_final(r->now.state))
        return;
    if (!r->end_pushed)
        r->end_pushed = end_push(r);
    // The frames on their way may fail after the last one was pushed behind them.
    enum journal_result status = publish_status(r->outlet, why);
    if (r->end_pushed && r->ending == RUN_COMPLETED &&
        (status == JOURNAL_ERROR || (status == JOURNAL_FULL && !r->config.output.when_full_block)))
        run_fail(r, "journal", "look at the disk of the data folder", why);
    bool forced = r->ending != RUN_COMPLETED && !journal_works(r);
    if (!r->end_pushed || (!publish_flush(r->outlet, 0) && !forced))
        return;
    run_wall_leave(r);
    run_unwarn(&r->now, WARNING_ROOM);
    run_status_fill(r, r->ending != RUN_FAILED);
    struct run_status last = run_status_until_now(r);
    last.state = r->ending;
    cJSON *json = history_status(&last);
    char *text = json_print(json, true);
    if (text == NULL ||
        journal_replace(r->journal, "status.json", text, strlen(text), why) != JOURNAL_OK)
        log_error("status", "run=%s why=\"%s\"", r->id, text == NULL ? "out of memory" : why);
    free(text);
    cJSON_Delete(json);
    run_state_enter(r, r->ending);
}

// The last frame is on its way: worth waiting for, so that the answer names the final state.
static void finish_soon(struct run *r) {
    for (int k = 0; k < 40; k++) {
        finish(r);
        if (run_state_is_final(r->now.state))
            return;
        publish_flush(r->outlet, 0.05);
    }
}

// ---- The loop ---------------------------------------------------------------------------------

static void wait_for_knock(struct run *r, double seconds) {
    struct timespec until;
    clock_gettime(CLOCK_MONOTONIC, &until);
    double sum = (double)until.tv_nsec * 1e-9 + seconds;
    until.tv_sec += (time_t)sum;
    until.tv_nsec = (long)((sum - floor(sum)) * 1e9);
    pthread_mutex_lock(&r->lock);
    while (r->queue == NULL && !atomic_load(&r->knock) && !atomic_load(&r->stop))
        if (pthread_cond_timedwait(&r->wake, &r->lock, &until) == ETIMEDOUT)
            break;
    pthread_mutex_unlock(&r->lock);
}

// "recorder NAME, silent for 12 s, has acknowledged frame 3 of 80"
static void explain_held(struct run *r, char *out) {
    struct recorder slowest;
    if (recorders_slowest(r->recorders, &slowest))
        snprintf(out, JOURNAL_WHY,
                 "recorder %s, silent for %.0f s, has acknowledged %lld of %llu frames",
                 slowest.name, slowest.heard, (long long)slowest.acked + 1,
                 (unsigned long long)journal_n_frames(r->journal));
}

// A frame is due and there is no room: the disk is behind or full, or a recorder is behind.
static void wait_for_room(struct run *r) {
    char why[JOURNAL_WHY] = "";
    enum journal_result status = publish_status(r->outlet, why);
    if (status == JOURNAL_HELD || (status == JOURNAL_OK && journal_held(r->journal))) {
        status = JOURNAL_HELD;
        explain_held(r, why);
    }
    run_wall_wait(r);
    if (status == JOURNAL_ERROR) {
        run_fail(r, "journal", "look at the disk of the data folder", why);
    } else if (status == JOURNAL_FULL && !r->config.output.when_full_block) {
        run_fail(r, "journal", "make room on the disk, or set output.when_full to \"block\"", why);
    } else if (status == JOURNAL_HELD && !r->config.output.when_full_block) {
        run_fail(r, "journal",
                 "record faster, raise output.journal_bytes, or set output.when_full to \"block\"",
                 why);
    } else {
        run_unwarn(&r->now, WARNING_ROOM);
        if (status == JOURNAL_FULL)
            run_warn(&r->now, WARNING_ROOM "on the disk: %.150s", why);
        else if (status == JOURNAL_HELD)
            run_warn(&r->now, WARNING_ROOM "in the journal: %.150s", why);
        if (r->now.state == RUN_RUNNING && run_clock() - r->wait_from > WAITING_SECONDS)
            run_state_enter(r, RUN_WAITING);
        else if (run_clock() - r->last_published >= PUBLISH_SECONDS)
            run_status_publish(r, false);
        wait_for_knock(r, 0.05);
        run_boundary(r);
    }
}

static void advance(struct run *r) {
    struct mpm_error error = {.status = MPM_OK, .particle = -1};
    double before = mpm_time(r->sim);
    char why[JOURNAL_WHY];
    if (r->due) {
        run_boundary(r);
        if (r->due) {
            wait_for_room(r);
            return;
        }
        run_unwarn(&r->now, WARNING_ROOM);
    }
    if (r->now.state == RUN_WAITING)
        run_state_enter(r, RUN_RUNNING);
    run_wall_enter(r);
    if (mpm_finished(r->sim)) {
        run_end_with(r, RUN_COMPLETED);
        return;
    }
    if (mpm_step_count(r->sim) >= r->stop_step ||
        run_reached(before, r->stop_time, mpm_next_dt(r->sim))) {
        pause_run(r);
        return;
    }
    if (!r->has_checkpoint && mpm_step_count(r->sim) == 0)
        run_checkpoint(r, why); // so that one is there however early the run fails
    if (mpm_step(r->sim, &error) != MPM_OK) {
        run_fail_with(r, &error);
        return;
    }
    after_step(r, mpm_time(r->sim) - before);
    double t = run_clock();
    if (t - r->last_published >= PUBLISH_SECONDS)
        run_status_publish(r, false);
    if (t - r->last_checkpoint >= r->config.output.checkpoint_interval && r->ending == RUN_N_STATES)
        run_checkpoint(r, why);
}

// Goes on while nothing else is to be done, for some milliseconds. What ends a run is left to the
// next turn, which may free the simulation.
static void advance_for_a_while(void *context) {
    struct run *r = context;
    const double since = run_clock();
    do
        advance(r);
    while (r->now.state == RUN_RUNNING && r->ending == RUN_N_STATES && !r->due &&
           !atomic_load(&r->knock) && !atomic_load(&r->stop) && run_clock() - since < HELD_SECONDS);
}

// Whether the run still waits for those who are to see its first frame. What it has of memory it
// keeps meanwhile, and its slot.
static bool is_lonely(struct run *r) {
    if (!r->lonely)
        return false;
    uint64_t there = publish_subscribers(r->outlet) + (uint64_t)atomic_load(&r->viewers);
    r->lonely = there < r->meta.wait_subscribers;
    run_unwarn(&r->now, WARNING_LONELY);
    if (r->lonely)
        run_warn(&r->now, WARNING_LONELY "%llu of %llu listen to run/%s/frame",
                 (unsigned long long)there, (unsigned long long)r->meta.wait_subscribers, r->id);
    publish_await(r->outlet, r->lonely);
    return r->lonely;
}

static void wait_for_subscribers(struct run *r) {
    run_wall_wait(r);
    if (r->now.state != RUN_WAITING)
        run_state_enter(r, RUN_WAITING);
    else if (run_clock() - r->last_published > PUBLISH_SECONDS)
        run_status_publish(r, false);
    wait_for_knock(r, LONELY_SECONDS);
}

// Makes the simulation where there is none yet, and runs.
static void begin_running(struct run *r) {
    if (is_lonely(r))
        wait_for_subscribers(r);
    else if (run_sim_begin(r))
        run_state_enter(r, RUN_RUNNING);
}

// A slot may be free, and the run wait all the same: it says for how much memory.
static void explain_queued(struct run *r) {
    size_t left, told = r->memory_told;
    bool lacks = slots_lack_memory(r->host->slots, &r->slot, &left);
    r->memory_told = lacks ? left : SIZE_MAX;
    if (r->memory_told == told)
        return;
    run_unwarn(&r->now, RUN_WARNING_MEMORY);
    if (lacks)
        run_warn(&r->now,
                 RUN_WARNING_MEMORY "it needs %zu bytes, and %zu are free; runs that are paused "
                                    "keep theirs until they are over",
                 r->slot.needs, left);
    run_status_publish(r, false);
}

// One turn of the loop in the present state.
static void turn(struct run *r) {
    if (r->ending != RUN_N_STATES) {
        finish(r);
        if (!run_state_is_final(r->now.state)) {
            run_wall_wait(r);
            if (r->now.state == RUN_RUNNING && run_clock() - r->wait_from > WAITING_SECONDS)
                run_state_enter(r, RUN_WAITING);
            wait_for_knock(r, 0.05);
        }
        return;
    }
    switch (r->now.state) {
    case RUN_QUEUED:
        if (slots_granted(r->host->slots, &r->slot)) {
            begin_running(r);
        } else {
            explain_queued(r);
            wait_for_knock(r, QUEUED_SECONDS);
        }
        break;
    case RUN_WAITING:
        if (r->lonely) {
            begin_running(r);
            break;
        }
        advance(r);
        break;
    case RUN_RUNNING:
        mpm_hold(r->sim, advance_for_a_while, r);
        break;
    case RUN_PAUSED:
        if (r->wants_sim) {
            r->wants_sim = false;
            run_sim_begin_idle(r); // without memory it begins later
        } else {
            if (r->due && r->sim != NULL)
                run_boundary(r);
            if (!r->due)
                run_unwarn(&r->now, WARNING_ROOM);
            wait_for_knock(r, r->due ? 0.2 : 60);
        }
        break;
    case RUN_COMPLETED:
    case RUN_FAILED:
    case RUN_CANCELLED:
    case RUN_N_STATES:
        break;
    }
}

// After the last turn no command is accepted, and what still waits is answered.
static void close_door(struct run *r) {
    struct run_command *c;
    pthread_mutex_lock(&r->lock);
    r->accepts = false;
    pthread_mutex_unlock(&r->lock);
    while ((c = take_command(r)) != NULL) {
        bool final = run_state_is_final(r->now.state);
        c->state = r->now.state;
        answer(r, c,
               !final                                                ? RUN_STOPPING
               : run_verdict(c->action, r->now.state) == RUN_ALREADY ? RUN_DONE
                                                                     : RUN_ILLEGAL);
    }
}

void *run_thread(void *argument) {
    struct run *r = argument;
    char why[JOURNAL_WHY], title[16];
    snprintf(title, sizeof title, "run %.11s", r->id); // and its solver threads, for `top -H`
    pthread_setname_np(pthread_self(), title);
    if (r->now.state == RUN_QUEUED)
        slots_ask(r->host->slots, &r->slot, r->sim_bytes);
    while (!run_state_is_final(r->now.state) && !atomic_load(&r->stop)) {
        if (atomic_load(&r->knock))
            obey(r);
        if (!run_state_is_final(r->now.state))
            turn(r);
    }
    run_wall_leave(r);
    if (r->sim != NULL && r->ending == RUN_N_STATES)
        run_checkpoint(r, why);
    close_door(r);
    slots_leave(r->host->slots, &r->slot);
    mpm_free(r->sim);
    r->sim = NULL;
    slots_unreserve(r->host->slots, &r->slot);
    if (!run_state_is_final(r->now.state) || journal_works(r))
        publish_flush(r->outlet, CHECKPOINT_FLUSH);
    if (run_state_is_final(r->now.state)) { // it may be listed for years: it keeps what is read
        publish_retire(r->outlet);
        journal_rest(r->journal);
        series_rest(r->series);
        scene_free(r->scene);
        r->scene = NULL;
        cJSON_Delete(r->scene_json);
        cJSON_Delete(r->replay.scene);
        r->scene_json = r->replay.scene = NULL;
        history_changes_free(&r->history);
    }
    atomic_store(&r->over, true);
    return NULL;
}
