// Changes of the configuration between two steps: made once, logged, and made again at their step
// after a restart. Part of the run's thread (run_loop.c).
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/log.h"
#include "server/run_inside.h"

#define STEPS_MAX 1e15  // as of a new run: beyond it doubles soon no longer count one by one
#define EVENT_BYTES 256 // of an event in the log but for its patch: names, date, five numbers

// ---- Changes of the configuration -------------------------------------------------------------

static bool change_apply(struct run *r, const struct scene_config *next, unsigned which,
                         bool end_changed, struct faults *faults) {
    struct mpm_error error = {.status = MPM_OK};
    struct mpm_settings before = mpm_settings_now(r->sim);
    enum mpm_status status = MPM_OK;
    if (end_changed && next->end < mpm_time(r->sim)) {
        char expected[64], actual[64];
        snprintf(expected, sizeof expected, ">= %.9g s", mpm_time(r->sim));
        snprintf(actual, sizeof actual, "%.9g s", next->end);
        faults_add(faults, "/time/end", "range", expected, actual,
                   "must not lie before the present time %.9g s, got %.9g s", mpm_time(r->sim),
                   next->end);
        return false;
    }
    double dt = next->settings.dt > 0 ? next->settings.dt : mpm_next_dt(r->sim);
    if ((next->end - mpm_time(r->sim)) / dt > STEPS_MAX) {
        char actual[64];
        snprintf(actual, sizeof actual, "%.3g steps", (next->end - mpm_time(r->sim)) / dt);
        faults_add(faults, end_changed ? "/time/end" : "/time", "range", "at most 1e15 steps",
                   actual, "from now to %.9g s would take more than 1e15 steps of %.6g s",
                   next->end, dt);
        return false;
    }
    if (which != 0)
        status = mpm_change(r->sim, &next->settings, which, &error);
    if (status == MPM_OK && end_changed) {
        status = mpm_change_end(r->sim, next->end, &error);
        if (status != MPM_OK && which != 0)
            mpm_change(r->sim, &before, which, NULL);
    }
    if (status != MPM_OK)
        faults_add(faults, error.pointer, mpm_status_name(status),
                   error.expected[0] != '\0' ? error.expected : NULL,
                   error.actual[0] != '\0' ? error.actual : NULL, "%s", error.message);
    return status == MPM_OK;
}

void run_power(struct run *r) {
    char why[JOURNAL_WHY];
    if (journal_power(r->journal, r->config.output.durability_power, why) == JOURNAL_OK)
        return;
    run_warn(&r->now, "what is recorded may not survive a power failure: %.150s", why);
    log_error("durability", "run=%s why=\"%s\"", r->id, why);
}

static void config_adopt(struct run *r, cJSON *patched, const struct scene_config *next) {
    cJSON_Delete(r->scene_json);
    r->scene_json = patched;
    r->config = *next;
    r->now.n_warnings = 0;
    journal_budget(r->journal, (uint64_t)next->output.journal_bytes);
    run_power(r);
    if (r->sim != NULL)
        run_schedule(r);
}

// Remembers a change that was made while there was no simulation, to be made as it begins.
static bool change_postpone(struct run *r, const cJSON *patch) {
    struct history *h = &r->history;
    struct history_change *moved = realloc(h->changes, (h->n_changes + 1) * sizeof *h->changes);
    if (moved == NULL)
        return false;
    h->changes = moved;
    h->changes[h->n_changes++] = (struct history_change){.number = journal_n_events(r->journal) - 1,
                                                         .step = r->now.step,
                                                         .frames = r->next_seq,
                                                         .patch = cJSON_Duplicate(patch, true)};
    return true;
}

// To the last bit: cJSON_Compare takes numbers that differ in it as equal.
static bool same_json(const cJSON *a, const cJSON *b) {
    char *one = json_print(a, false), *two = json_print(b, false);
    bool same = one != NULL && two != NULL && strcmp(one, two) == 0;
    free(one);
    free(two);
    return same;
}

enum run_outcome run_configure(struct run *r, struct run_command *c) {
    struct scene_config next;
    unsigned which;
    bool end_changed, output_changed;
    if (c->has_revision && c->revision != r->now.revision)
        return RUN_STALE;
    if (r->sim != NULL && r->next_seq < r->replay.end) {
        snprintf(c->why, sizeof c->why,
                 "after a restart the run is still repeating steps that were published");
        return RUN_BUSY;
    }
    // Its state, which decides what is possible, is in a checkpoint that nobody has read yet.
    if (r->sim == NULL && journal_n_frames(r->journal) > 0) {
        snprintf(c->why, sizeof c->why,
                 "after a restart the run waits for its slot before it goes on from step %llu: try "
                 "again when it runs, or pause it first",
                 (unsigned long long)r->now.step);
        return RUN_BUSY;
    }
    cJSON *patched = scene_config_patch(r->scene_json, c->patch, &next, &which, &end_changed,
                                        &output_changed, &c->faults);
    if (patched == NULL)
        return RUN_INVALID;
    if (same_json(patched, r->scene_json)) {
        cJSON_Delete(patched);
        return RUN_DONE;
    }
    // A change that is made but not logged could not be made again after a crash, and it cannot be
    // taken back to the last bit: a disk without room refuses it before it is made.
    char *patch = json_print(c->patch, false);
    size_t bytes = (patch != NULL ? strlen(patch) : 0) + EVENT_BYTES;
    free(patch);
    if (journal_events_room(r->journal, bytes, c->why) != JOURNAL_OK) {
        cJSON_Delete(patched);
        return RUN_STORAGE;
    }
    if (r->sim != NULL) {
        if (!change_apply(r, &next, which, end_changed, &c->faults)) {
            cJSON_Delete(patched);
            return RUN_INVALID;
        }
    } else {
        struct scene *checked = scene_create(patched, &c->faults);
        scene_free(checked);
        if (checked == NULL) {
            cJSON_Delete(patched);
            return RUN_INVALID;
        }
    }
    if (r->sim != NULL) { // the copy for readers may be some steps old; the log must not be
        r->now.step = mpm_step_count(r->sim);
        r->now.time = mpm_time(r->sim);
    }
    cJSON *event = history_event("config", &r->now);
    cJSON_AddItemToObject(event, "patch", cJSON_Duplicate(c->patch, true));
    cJSON_AddNumberToObject(event, "frames", (double)r->next_seq);
    cJSON_AddNumberToObject(event, "revision", (double)r->now.revision + 1);
    if (run_event_log(r, event, c->why) != JOURNAL_OK) {
        // The change is made but could not be repeated after a crash: the run must not go on.
        cJSON_Delete(patched);
        run_fail(r, "journal", "make room on the disk and start the run again", c->why);
        return RUN_STORAGE;
    }
    r->now.revision++;
    if (r->sim == NULL && !change_postpone(r, c->patch))
        run_fail(r, "memory", "", "no memory for a change of the configuration");
    config_adopt(r, patched, &next);
    if (r->sim == NULL) {
        r->now.fbar_scheme = next.settings.fbar.scheme;
        r->now.fbar = r->now.fbar_scheme != MPM_FBAR_OFF;
        r->now.end_time = next.end;
    } else {
        run_status_fill(r, true);
    }
    run_describe(r);
    log_info("config", "run=%s step=%llu revision=%llu", r->id, (unsigned long long)r->now.step,
             (unsigned long long)r->now.revision);
    return RUN_DONE;
}

// Makes again the next change of the log. The scene's JSON has it already; `config` may be ahead.
static void change_repeat(struct run *r, const struct history_change *change, cJSON **scene_then) {
    struct scene_config next;
    unsigned which;
    bool end_changed, output_changed;
    struct faults faults = {0};
    cJSON *patched = scene_config_patch(*scene_then, change->patch, &next, &which, &end_changed,
                                        &output_changed, &faults);
    if (patched == NULL || !change_apply(r, &next, which, end_changed, &faults)) {
        char what[160];
        snprintf(what, sizeof what, "a change at step %llu could not be repeated: %.90s",
                 (unsigned long long)change->step, faults.count > 0 ? faults.items[0].detail : "");
        cJSON_Delete(patched);
        run_begin_epoch(r, what);
    } else {
        cJSON_Delete(*scene_then);
        *scene_then = patched;
        r->config = next;
        run_schedule(r);
    }
    faults_free(&faults);
}

const struct history_change *run_change_due(const struct run *r) {
    const struct history *h = &r->history;
    if (r->replay.change == h->n_changes ||
        h->changes[r->replay.change].step > mpm_step_count(r->sim))
        return NULL;
    return &h->changes[r->replay.change];
}

void run_change_next(struct run *r) {
    change_repeat(r, &r->history.changes[r->replay.change++], &r->replay.scene);
    run_changes_forget(r);
}

// Those that are made are in the log and, together, in the scene.
void run_changes_forget(struct run *r) {
    if (r->sim == NULL || r->replay.change < r->history.n_changes)
        return;
    history_changes_free(&r->history);
    r->replay.change = 0;
}

// The scene as it was after the changes that the simulation has in it already.
bool run_replay_scene(struct run *r) {
    cJSON_Delete(r->replay.scene);
    r->replay.scene = cJSON_Duplicate(scene_json(r->scene), true);
    r->config = *scene_config(r->scene);
    for (size_t k = 0; k < r->replay.change; k++) {
        unsigned which;
        bool end, output;
        struct faults faults = {0};
        struct scene_config next;
        cJSON *patched = scene_config_patch(r->replay.scene, r->history.changes[k].patch, &next,
                                            &which, &end, &output, &faults);
        if (patched != NULL) {
            cJSON_Delete(r->replay.scene);
            r->replay.scene = patched;
            r->config = next;
        }
        faults_free(&faults);
    }
    return r->replay.scene != NULL;
}
