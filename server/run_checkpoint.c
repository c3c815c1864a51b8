// The simulation comes and goes: checkpoints, and the beginning from one. Part of the run's thread
// (run_loop.c).
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/log.h"
#include "server/run_inside.h"

#define CHECKPOINT_FLUSH 5.0 // s to wait for frames on their way before a checkpoint is given up

// ---- Checkpoints ------------------------------------------------------------------------------

enum journal_result run_checkpoint(struct run *r, char *why) {
    double t = run_clock();
    why[0] = '\0';
    r->last_checkpoint = t;
    run_status_fill(r, true);
    if (r->has_checkpoint && r->checkpoint_step == r->now.step &&
        r->checkpoint_revision == r->now.revision)
        return JOURNAL_OK;
    // A checkpoint must not be ahead of the frames and samples that it counts: those on their way
    // are written even where a recorder holds the budget; no other is taken before there is room.
    journal_overdraw(r->journal, true);
    publish_retry(r->outlet);
    bool flushed = publish_flush(r->outlet, CHECKPOINT_FLUSH);
    journal_overdraw(r->journal, r->ending != RUN_N_STATES);
    if (!flushed) {
        snprintf(why, JOURNAL_WHY, "the journal of frames cannot be written");
        return JOURNAL_FULL;
    }
    int error = series_flush(r->series);
    if (error == 0)
        error = series_sync(r->series);
    if (error != 0) {
        snprintf(why, JOURNAL_WHY, "the probes' log cannot be written: %s", strerror(error));
        return error == ENOSPC ? JOURNAL_FULL : JOURNAL_ERROR;
    }
    struct run_status status = run_status_until_now(r);
    size_t bytes = mpm_state_bytes(r->sim);
    void *state = malloc(bytes > 0 ? bytes : 1);
    cJSON *json = cJSON_CreateObject();
    cJSON_AddItemToObject(json, "status", history_status(&status));
    cJSON_AddNumberToObject(json, "next_frame", (double)r->next_seq);
    cJSON_AddNumberToObject(json, "events", (double)journal_n_events(r->journal));
    cJSON_AddNumberToObject(json, "rows", (double)series_n_rows(r->series));
    cJSON_AddBoolToObject(json, "due", r->due);
    char *meta = json_print(json, false);
    enum journal_result result = JOURNAL_ERROR;
    if (state != NULL && meta != NULL) {
        mpm_state_save(r->sim, state);
        result = journal_checkpoint(r->journal, meta, state, bytes, why);
    } else {
        snprintf(why, JOURNAL_WHY, "no memory for a checkpoint of %zu bytes", bytes);
    }
    if (result == JOURNAL_OK) {
        r->has_checkpoint = true;
        r->checkpoint_step = r->now.step;
        r->checkpoint_revision = r->now.revision;
        run_unwarn(&r->now, "the last checkpoint failed");
    } else {
        run_warn(&r->now, "the last checkpoint failed: %.150s", why);
        log_error("checkpoint", "run=%s why=\"%s\"", r->id, why);
    }
    free(state);
    free(meta);
    cJSON_Delete(json);
    run_account(r, RUN_PHASE_CHECKPOINTS, t);
    return result;
}

// ---- The simulation comes and goes ------------------------------------------------------------

// `spoiled`: the simulation holds a state that did not fit, and must be made anew.
static bool load_checkpoint(struct run *r, int which, bool *spoiled) {
    char *meta;
    void *state;
    size_t bytes;
    struct faults faults = {0};
    struct mpm_error error;
    struct run_status status;
    if (!journal_checkpoint_read(r->journal, which, &meta, &state, &bytes))
        return false;
    cJSON *json = json_parse(meta, strlen(meta), &faults);
    const cJSON *next = json_member(json, "next_frame"), *events = json_member(json, "events");
    const cJSON *rows = json_member(json, "rows");
    size_t n_rows = r->series != NULL ? series_n_rows(r->series) : 0;
    // Frames, events or samples that it counts and that are gone (a power failure, a damaged file)
    // would be missing for ever if the run went on from here.
    bool valid = cJSON_IsNumber(next) && cJSON_IsNumber(events) && cJSON_IsNumber(rows) &&
                 rows->valuedouble <= (double)n_rows &&
                 events->valuedouble <= (double)journal_n_events(r->journal) &&
                 history_status_read(json_member(json, "status"), &status) &&
                 next->valuedouble <= (double)journal_n_frames(r->journal);
    if (valid && mpm_state_load(r->sim, state, bytes, &error) != MPM_OK) {
        log_error("checkpoint", "run=%s which=%d why=\"%s\"", r->id, which, error.message);
        valid = false;
        *spoiled = true;
    }
    if (valid) {
        r->next_seq = (uint64_t)next->valuedouble;
        r->due = cJSON_IsTrue(json_member(json, "due"));
        r->now.wall_s = status.wall_s;
        memcpy(r->now.phases, status.phases, sizeof r->now.phases);
        memcpy(r->phase_base, status.phases, sizeof r->phase_base);
        r->replay.change = 0;
        while (r->replay.change < r->history.n_changes &&
               (double)r->history.changes[r->replay.change].number < events->valuedouble)
            r->replay.change++;
        r->has_checkpoint = which == 0;
        r->checkpoint_step = mpm_step_count(r->sim);
        r->checkpoint_revision = r->replay.change;
    }
    free(meta);
    free(state);
    cJSON_Delete(json);
    faults_free(&faults);
    return valid;
}

static bool sim_create(struct run *r) {
    struct mpm_error error = {.status = MPM_OK, .particle = -1, .value = NAN};
    mpm_free(r->sim);
    r->sim = NULL;
    if (mpm_create(scene_def(r->scene), &r->sim, &error) == MPM_OK)
        return true;
    r->sim = NULL;
    error.particle = -1;
    error.value = NAN;
    if (error.status == MPM_ERR_MEMORY)
        error.advice = "use larger cells or fewer particles, or run it where there is more memory";
    run_fail_with(r, &error);
    return false;
}

// Makes the simulation: from the newest checkpoint that fits the journal, or from the start.
bool run_sim_begin(struct run *r) {
    if (r->sim != NULL)
        return true;
    uint64_t frames = journal_n_frames(r->journal), gone = journal_n_gone(r->journal);
    bool loaded = false;
    r->replay = (struct replay){.end = frames};
    r->next_seq = 0;
    if (!sim_create(r))
        return false;
    for (int which = 0; which < 2 && !loaded; which++) {
        bool spoiled = false;
        loaded = load_checkpoint(r, which, &spoiled);
        if (spoiled && !sim_create(r))
            return false;
    }
    if (!run_series_prepare(r) || !run_replay_scene(r)) {
        run_fail(r, "memory", "", "no memory for the run's probes");
        return false;
    }
    if (!loaded) {
        memset(r->phase_base, 0, sizeof r->phase_base);
        memset(r->now.phases, 0, sizeof r->now.phases);
        r->now.wall_s = 0;
        r->due = true;
    }
    if (r->next_seq < gone)
        r->next_seq = gone;
    r->metered = mpm_step_count(r->sim); // those of an earlier daemon are not this one's
    run_changes_forget(r);
    run_schedule(r);
    if (!loaded)
        run_sample(r);
    r->last_checkpoint = r->last_flush = run_clock();
    run_boundary(r);
    run_status_publish(r, true);
    if (frames > 0)
        log_info("continued", "run=%s step=%llu time=%.9g repeats_frames=%llu", r->id,
                 (unsigned long long)mpm_step_count(r->sim), mpm_time(r->sim),
                 (unsigned long long)(frames - r->next_seq));
    return r->ending == RUN_N_STATES;
}

// A simulation outside of the step loop: there is no slot, but memory is needed.
bool run_sim_begin_idle(struct run *r) {
    if (r->sim != NULL)
        return true;
    if (r->slot.reserved == 0 && !slots_reserve(r->host->slots, &r->slot, r->sim_bytes))
        return false;
    return run_sim_begin(r);
}
