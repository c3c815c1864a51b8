// Where a run stands and what it has gone through: clocks, the status copy, the event log, changes
// of state, failures. Part of the run's thread (run_loop.c).
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/log.h"
#include "server/run_inside.h"

#define BALANCE_SHARE 0.01      // of the time may go into sums that only the status shows
#define ETA_SECONDS 1.0         // between two samples of the speed; the ring holds 16
#define RATIO_COMPRESSIBLE 0.45 // Poisson's ratio below which F-bar has nothing to cure
#define RATIO_DT_CLOSE 0.9      // of the stability limit

// ---- Clocks -----------------------------------------------------------------------------------

void run_account(struct run *r, enum run_phase phase, double since) {
    if (!isnan(r->wall_from))
        r->now.phases[phase] += run_clock() - since;
}

void run_wall_enter(struct run *r) {
    double t = run_clock();
    if (!isnan(r->wait_from))
        r->now.phases[RUN_PHASE_WAITING] += t - r->wait_from;
    r->wait_from = NAN;
    if (isnan(r->wall_from))
        r->wall_from = t;
}

void run_wall_leave(struct run *r) {
    double t = run_clock();
    if (!isnan(r->wall_from))
        r->now.wall_s += t - r->wall_from;
    if (!isnan(r->wait_from))
        r->now.phases[RUN_PHASE_WAITING] += t - r->wait_from;
    r->wall_from = r->wait_from = NAN;
}

void run_wall_wait(struct run *r) {
    if (!isnan(r->wait_from))
        return;
    run_wall_leave(r);
    r->wait_from = run_clock();
}

// ---- Status -----------------------------------------------------------------------------------

void run_warn_scene(struct run_status *now, const struct mpm_def *def) {
    for (size_t k = 0; now->fbar && k < def->n_materials; k++) {
        const struct mpm_material_def *material = &def->materials[k];
        const struct mpm_parameter *parameter;
        for (size_t p = 0; p < MPM_MAX_PARAMETERS &&
                           (parameter = mpm_material_parameter(material->model, p)) != NULL;
             p++)
            if (material->fbar && strcmp(parameter->key, "poisson_ratio") == 0 &&
                material->parameters[p] < RATIO_COMPRESSIBLE)
                run_warn(now,
                         "F-bar is on for the compressible material %.60s (poisson_ratio %g): it "
                         "is meant for nearly incompressible ones; \"fbar\": false in the material "
                         "excepts it",
                         material->name, material->parameters[p]);
    }
    if (def->basis == MPM_LINEAR)
        run_warn(now, "the linear basis is for comparison only: a particle that barely reaches a "
                      "node throws it away, whatever the time increment");
    if (now->dt_limit > 0 && now->dt > now->dt_limit)
        run_warn(now, "dt = %g s is above the stability limit %g s", now->dt, now->dt_limit);
    else if (now->dt_limit > 0 && now->dt > RATIO_DT_CLOSE * now->dt_limit)
        run_warn(now, "dt = %g s is above %g of the stability limit %g s", now->dt, RATIO_DT_CLOSE,
                 now->dt_limit);
}

void run_describe(struct run *r) {
    char *scene = r->scene_json != NULL ? json_print(r->scene_json, false) : NULL;
    cJSON *json = r->scene_json != NULL ? scene_config_json(r->scene_json) : NULL;
    char *config = json != NULL ? json_print(json, false) : NULL;
    cJSON_Delete(json);
    pthread_mutex_lock(&r->lock);
    char *old_scene = r->scene_text, *old_config = r->config_text;
    r->scene_text = scene;
    r->config_text = config;
    pthread_mutex_unlock(&r->lock);
    free(old_scene);
    free(old_config);
    if (r->scene != NULL)
        run_warn_scene(&r->now, scene_def(r->scene));
}

// Rate of simulated time over the last seconds of running; earlier ones say less about what is to
// come.
static void eta_update(struct run *r) {
    double wall = r->now.wall_s + (isnan(r->wall_from) ? 0 : run_clock() - r->wall_from);
    unsigned newest = (r->n_eta + ETA_SAMPLES - 1) % ETA_SAMPLES;
    if (r->n_eta == 0 || wall - r->eta_wall[newest] >= ETA_SECONDS) {
        r->eta_wall[r->n_eta % ETA_SAMPLES] = wall;
        r->eta_time[r->n_eta % ETA_SAMPLES] = r->now.time;
        r->n_eta++;
    }
    unsigned oldest = r->n_eta > ETA_SAMPLES ? r->n_eta % ETA_SAMPLES : 0;
    double span = wall - r->eta_wall[oldest], done = r->now.time - r->eta_time[oldest];
    bool running = r->now.state == RUN_RUNNING || r->now.state == RUN_WAITING;
    r->now.eta_s = running && done > 0 ? (r->now.end_time - r->now.time) * span / done : NAN;
}

static void eta_restart(struct run *r) {
    r->n_eta = 0;
}

void run_status_fill(struct run *r, bool exact) {
    if (r->sim != NULL && r->now.state != RUN_FAILED && r->ending != RUN_FAILED) {
        struct mpm_settings settings = mpm_settings_now(r->sim);
        r->now.step = mpm_step_count(r->sim);
        r->now.stage = mpm_stage(r->sim);
        r->now.time = mpm_time(r->sim) + 0.0; // no -0
        r->now.start_time = mpm_start_time(r->sim) + 0.0;
        r->now.end_time = mpm_end_time(r->sim);
        r->now.particles = mpm_n_particles(r->sim);
        if (r->host->meters != NULL && r->now.step > r->metered) {
            atomic_fetch_add(&r->host->meters->steps, r->now.step - r->metered);
            atomic_fetch_add(&r->host->meters->particle_steps,
                             (r->now.step - r->metered) * r->now.particles);
        }
        r->metered = r->now.step;
        r->now.nodes = mpm_n_nodes(r->sim);
        r->now.bytes = mpm_bytes(r->sim);
        r->now.fbar_scheme = settings.fbar.scheme;
        r->now.fbar = settings.fbar.scheme != MPM_FBAR_OFF;
        double t = run_clock();
        if (exact || t - r->last_balance > r->balance_cost / BALANCE_SHARE) {
            mpm_balance(r->sim, &r->now.balance);
            r->now.balance_step = r->now.step;
            r->now.dt = mpm_next_dt(r->sim);
            r->now.dt_limit = mpm_dt_limit(r->sim);
            r->last_balance = run_clock();
            r->balance_cost = r->last_balance - t;
        }
    }
    if (r->sim != NULL)
        for (int k = 0; k < MPM_N_PHASES; k++)
            r->now.phases[k] = r->phase_base[k] + mpm_phase_seconds(r->sim, (enum mpm_phase)k);
    eta_update(r);
}

// r->now with the seconds of the present stretch of running or waiting.
struct run_status run_status_until_now(const struct run *r) {
    double t = run_clock(), known = 0;
    struct run_status copy = r->now;
    copy.wall_s += isnan(r->wall_from) ? 0 : t - r->wall_from;
    copy.phases[RUN_PHASE_WAITING] += isnan(r->wait_from) ? 0 : t - r->wait_from;
    for (int k = 0; k < RUN_N_PHASES; k++)
        if (k != RUN_PHASE_OTHER && k != RUN_PHASE_WAITING)
            known += copy.phases[k];
    copy.phases[RUN_PHASE_OTHER] = fmax(copy.wall_s - known, 0);
    return copy;
}

void run_status_publish(struct run *r, bool exact) {
    run_status_fill(r, exact);
    struct run_status copy = run_status_until_now(r);
    pthread_mutex_lock(&r->lock);
    r->status = copy;
    r->version++;
    pthread_mutex_unlock(&r->lock);
    r->last_published = run_clock();
}

bool run_view(struct run *r, struct run_view *out) {
    struct recorder recorders[RECORDERS_MAX];
    *out = (struct run_view){0};
    if (r->recorders != NULL && recorders_list(r->recorders, recorders) > 0)
        return false;
    if (r->journal != NULL) {
        out->frames = journal_n_frames(r->journal);
        out->frames_gone = journal_n_gone(r->journal);
        out->frame_bytes = journal_frame_bytes(r->journal);
    }
    pthread_mutex_lock(&r->lock);
    struct series *series = r->series;
    out->version = r->version;
    pthread_mutex_unlock(&r->lock);
    out->samples = series != NULL ? series_n_rows(series) : 0;
    return true;
}

char *run_view_text(struct run *r, const struct run_view *view) {
    pthread_mutex_lock(&r->lock);
    char *text =
        r->view != NULL && memcmp(&r->viewed, view, sizeof *view) == 0 ? strdup(r->view) : NULL;
    pthread_mutex_unlock(&r->lock);
    return text;
}

void run_view_keep(struct run *r, const struct run_view *view, const char *text) {
    char *kept = strdup(text);
    pthread_mutex_lock(&r->lock);
    char *old = r->view;
    r->view = kept;
    r->viewed = *view;
    pthread_mutex_unlock(&r->lock);
    free(old);
}

// What the run object tells of a change that is in the log.
static void remember_change(struct run *r, const cJSON *event) {
    const char *kind = cJSON_GetStringValue(json_member(event, "event"));
    if (kind == NULL || strcmp(kind, "config") != 0)
        return;
    cJSON *change = history_change_json(r->now.revision + 1, r->now.step, r->now.time, // as there
                                        cJSON_Duplicate(json_member(event, "patch"), true));
    pthread_mutex_lock(&r->lock);
    cJSON_AddItemToArray(r->changes, change);
    if (cJSON_GetArraySize(r->changes) > RUN_CHANGES)
        cJSON_DeleteItemFromArray(r->changes, 0);
    r->version++;
    pthread_mutex_unlock(&r->lock);
}

// Appends to the event log and publishes.
enum journal_result run_event_log(struct run *r, cJSON *event, char *why) {
    char *text = json_print(event, false);
    enum journal_result result = JOURNAL_ERROR;
    snprintf(why, JOURNAL_WHY, "out of memory");
    if (text != NULL)
        result = journal_append_event(r->journal, text, why);
    if (result == JOURNAL_OK) {
        publish_event(r->outlet, text);
        remember_change(r, event);
        run_tell(r);
    } else {
        log_error("event_log", "run=%s why=\"%s\"", r->id, why);
    }
    free(text);
    cJSON_Delete(event);
    return result;
}

void run_state_enter(struct run *r, enum run_state state) {
    char why[JOURNAL_WHY];
    enum run_state before = r->now.state;
    if (state == RUN_RUNNING)
        run_wall_enter(r);
    else if (state == RUN_WAITING)
        run_wall_wait(r);
    else
        run_wall_leave(r);
    r->now.state = state;
    if (state != RUN_QUEUED) {
        run_unwarn(&r->now, RUN_WARNING_MEMORY);
        r->memory_told = SIZE_MAX;
    }
    if (state == RUN_RUNNING && before != RUN_WAITING)
        eta_restart(r);
    run_status_fill(r, true);
    cJSON *event = history_event("state", &r->now);
    cJSON_AddStringToObject(event, "state", run_state_name(state));
    if (r->stop_step != UINT64_MAX)
        cJSON_AddNumberToObject(event, "until_step", (double)r->stop_step);
    if (isfinite(r->stop_time))
        cJSON_AddItemToObject(event, "until_time", json_number(r->stop_time));
    if (r->now.error.present)
        cJSON_AddItemToObject(event, "error", history_error(&r->now.error));
    run_unwarn(&r->now, "the event log cannot be written");
    if (run_event_log(r, event, why) != JOURNAL_OK)
        run_warn(&r->now, "the event log cannot be written: %.150s", why);
    run_status_publish(r, true);
    run_tell(r);
    log_info("state", "run=%s state=%s before=%s step=%llu time=%.9g", r->id, run_state_name(state),
             run_state_name(before), (unsigned long long)r->now.step, r->now.time);
}

// ---- Failing ----------------------------------------------------------------------------------

// From here on the run only waits to write its last frame.
void run_end_with(struct run *r, enum run_state state) {
    if (r->ending == RUN_N_STATES)
        r->end_pushed = false;
    r->ending = state;
    // The few frames on their way and the last one go over the budget where a recorder holds it:
    // after them there is nothing that could wait for it.
    journal_overdraw(r->journal, true);
    publish_retry(r->outlet);
}

void run_fail(struct run *r, const char *kind, const char *advice, const char *detail) {
    run_status_fill(r, false);
    r->now.error = (struct run_error){
        .present = true, .step = r->now.step, .time = r->now.time, .particle = -1, .value = NAN};
    snprintf(r->now.error.kind, sizeof r->now.error.kind, "%s", kind);
    snprintf(r->now.error.advice, sizeof r->now.error.advice, "%s", advice);
    snprintf(r->now.error.detail, sizeof r->now.error.detail, "%s", detail);
    run_end_with(r, RUN_FAILED);
}

void run_fail_with(struct run *r, const struct mpm_error *error) {
    struct run_error *out = &r->now.error;
    if (r->sim != NULL) {
        r->now.step = mpm_step_count(r->sim);
        r->now.time = mpm_time(r->sim);
    }
    *out = (struct run_error){.present = true,
                              .step = error->step,
                              .time = error->time,
                              .particle = error->particle,
                              .value = error->value};
    snprintf(out->kind, sizeof out->kind, "%s", mpm_status_name(error->status));
    snprintf(out->quantity, sizeof out->quantity, "%s",
             error->quantity != NULL ? error->quantity : "");
    snprintf(out->advice, sizeof out->advice, "%s", error->advice != NULL ? error->advice : "");
    snprintf(out->detail, sizeof out->detail, "%s", error->message);
    run_end_with(r, RUN_FAILED);
}
