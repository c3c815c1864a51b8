// What others see of a run: its states, the way commands take to its thread, how it begins and how
// it is found again after a restart. The thread itself is run_loop.c.
#include "server/run.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "server/log.h"
#include "server/run_inside.h"

// ---- Names ------------------------------------------------------------------------------------

const char *run_state_name(enum run_state state) {
    static const char *const names[] = {
#define X(code, text) text,
        RUN_STATE_LIST(X)
#undef X
    };
    return names[state];
}

int run_state_parse(const char *name) {
    for (int k = 0; k < RUN_N_STATES; k++)
        if (strcmp(name, run_state_name((enum run_state)k)) == 0)
            return k;
    return -1;
}

bool run_state_is_final(enum run_state state) {
    return state == RUN_COMPLETED || state == RUN_FAILED || state == RUN_CANCELLED;
}

const char *run_action_name(enum run_action action) {
    static const char *const names[] = {
#define X(code, text) text,
        RUN_ACTION_LIST(X)
#undef X
    };
    return names[action];
}

const char *run_phase_name(int phase) {
    static const char *const names[] = {
#define X(code, text) text,
        RUN_PHASE_LIST(X)
#undef X
    };
    return phase < MPM_N_PHASES ? mpm_phase_name((enum mpm_phase)phase)
                                : names[phase - RUN_PHASE_FIRST - 1];
}

void run_warn(struct run_status *status, const char *format, ...) {
    char text[sizeof status->warnings[0]];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    for (unsigned k = 0; k < status->n_warnings; k++)
        if (strcmp(status->warnings[k], text) == 0)
            return;
    if (status->n_warnings < RUN_WARNINGS)
        memcpy(status->warnings[status->n_warnings++], text, sizeof text);
}

void run_unwarn(struct run_status *status, const char *beginning) {
    unsigned kept = 0;
    for (unsigned k = 0; k < status->n_warnings; k++)
        if (strncmp(status->warnings[k], beginning, strlen(beginning)) != 0)
            memmove(status->warnings[kept++], status->warnings[k], sizeof status->warnings[0]);
    status->n_warnings = kept;
}

// ---- States -----------------------------------------------------------------------------------

enum run_verdict run_verdict(enum run_action action, enum run_state state) {
    enum { no = RUN_REFUSED, acts = RUN_ACTS, is = RUN_ALREADY };
    static const unsigned char table[RUN_N_ACTIONS][RUN_N_STATES] = {
        // queued running waiting paused completed failed cancelled
        [RUN_DO_START] = {is, is, is, acts, no, no, no},
        [RUN_DO_PAUSE] = {acts, acts, acts, is, no, no, no},
        [RUN_DO_RESUME] = {is, is, is, acts, no, no, no},
        [RUN_DO_STEP] = {no, no, no, acts, no, no, no},
        [RUN_DO_CANCEL] = {acts, acts, acts, acts, no, no, is},
        [RUN_DO_CHECKPOINT] = {no, acts, acts, acts, no, no, no},
        [RUN_DO_SNAPSHOT] = {no, acts, acts, acts, no, no, no},
        [RUN_DO_CONFIGURE] = {acts, acts, acts, acts, no, no, no},
    };
    return (enum run_verdict)table[action][state];
}

// ---- Reading ----------------------------------------------------------------------------------

const char *run_id(const struct run *r) {
    return r->id;
}
const char *run_name(const struct run *r) {
    return r->meta.name;
}
const char *run_created(const struct run *r) {
    return r->meta.created;
}
const char *run_key(const struct run *r) {
    return r->meta.key;
}
const char *run_request(const struct run *r) {
    return r->meta.request;
}
struct journal *run_journal(struct run *r) {
    return r->journal;
}
struct recorders *run_recorders(struct run *r) {
    return r->recorders;
}
const struct run_reference *run_references(const struct run *r, size_t *count) {
    *count = r->meta.n_references;
    return r->meta.references;
}

struct run_status run_status(struct run *r) {
    pthread_mutex_lock(&r->lock);
    struct run_status status = r->status;
    pthread_mutex_unlock(&r->lock);
    return status;
}

struct series *run_series(struct run *r) {
    pthread_mutex_lock(&r->lock);
    struct series *series = r->series;
    pthread_mutex_unlock(&r->lock);
    return series;
}

char *run_scene_text(struct run *r) {
    pthread_mutex_lock(&r->lock);
    char *text = r->scene_text != NULL ? strdup(r->scene_text) : NULL;
    pthread_mutex_unlock(&r->lock);
    return text;
}

char *run_config_text(struct run *r, uint64_t *revision) {
    pthread_mutex_lock(&r->lock);
    char *text = r->config_text != NULL ? strdup(r->config_text) : NULL;
    *revision = r->status.revision;
    pthread_mutex_unlock(&r->lock);
    return text;
}

cJSON *run_changes(struct run *r) {
    pthread_mutex_lock(&r->lock);
    cJSON *changes = cJSON_Duplicate(r->changes, true);
    pthread_mutex_unlock(&r->lock);
    return changes;
}

// ---- Commands ---------------------------------------------------------------------------------

static void wake(void *context) {
    struct run *r = context;
    pthread_mutex_lock(&r->lock);
    atomic_store(&r->knock, true);
    pthread_cond_signal(&r->wake);
    r->news++;
    pthread_cond_broadcast(&r->told);
    pthread_mutex_unlock(&r->lock);
}

void run_tell(struct run *r) {
    pthread_mutex_lock(&r->lock);
    r->news++;
    pthread_cond_broadcast(&r->told);
    pthread_mutex_unlock(&r->lock);
    run_bell_ring(r->host->bell);
}

static struct timespec from_now(double seconds) {
    struct timespec until;
    clock_gettime(CLOCK_MONOTONIC, &until);
    double sum = 1e-9 * (double)until.tv_nsec + seconds;
    until.tv_sec += (time_t)sum;
    until.tv_nsec = (long)((sum - floor(sum)) * 1e9);
    return until;
}

uint64_t run_news(struct run *r, uint64_t seen, double seconds) {
    struct timespec until = from_now(seconds);
    pthread_mutex_lock(&r->lock);
    while (r->news == seen && !atomic_load(&r->stop))
        if (pthread_cond_timedwait(&r->told, &r->lock, &until) != 0)
            break;
    uint64_t news = r->news;
    pthread_mutex_unlock(&r->lock);
    return news;
}

void run_bell_init(struct run_bell *bell) {
    pthread_condattr_t monotonic;
    pthread_condattr_init(&monotonic);
    pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
    pthread_mutex_init(&bell->lock, NULL);
    pthread_cond_init(&bell->rung, &monotonic);
    pthread_condattr_destroy(&monotonic);
    bell->count = 0;
}

void run_bell_destroy(struct run_bell *bell) {
    pthread_mutex_destroy(&bell->lock);
    pthread_cond_destroy(&bell->rung);
}

void run_bell_ring(struct run_bell *bell) {
    if (bell == NULL)
        return;
    pthread_mutex_lock(&bell->lock);
    bell->count++;
    pthread_cond_broadcast(&bell->rung);
    pthread_mutex_unlock(&bell->lock);
}

uint64_t run_bell_wait(struct run_bell *bell, uint64_t seen, double seconds) {
    struct timespec until = from_now(seconds);
    pthread_mutex_lock(&bell->lock);
    while (bell->count == seen)
        if (pthread_cond_timedwait(&bell->rung, &bell->lock, &until) != 0)
            break;
    uint64_t count = bell->count;
    pthread_mutex_unlock(&bell->lock);
    return count;
}

bool run_stopping(const struct run *r) {
    return atomic_load(&r->stop);
}

void run_viewers(struct run *r, int change) {
    atomic_fetch_add(&r->viewers, change);
}

void run_command(struct run *r, struct run_command *command) {
    pthread_mutex_lock(&r->lock);
    command->state = r->status.state;
    command->effective_step = r->status.step;
    if (run_state_is_final(r->status.state)) {
        command->outcome =
            run_verdict(command->action, r->status.state) == RUN_ALREADY ? RUN_DONE : RUN_ILLEGAL;
    } else if (!r->accepts) {
        command->outcome = RUN_STOPPING;
    } else if (r->n_queued == RUN_QUEUE) {
        command->outcome = RUN_BUSY;
        snprintf(command->why, sizeof command->why,
                 "%d commands wait for the next step boundary already", RUN_QUEUE);
    } else {
        struct run_command **link = &r->queue;
        while (*link != NULL)
            link = &(*link)->next;
        command->next = NULL;
        command->answered = false;
        *link = command;
        r->n_queued++;
        atomic_store(&r->knock, true);
        pthread_cond_signal(&r->wake);
        while (!command->answered)
            pthread_cond_wait(&r->done, &r->lock);
    }
    pthread_mutex_unlock(&r->lock);
    // A frame that was asked for is there to be fetched when the answer arrives.
    if (command->outcome == RUN_DONE && command->action == RUN_DO_SNAPSHOT)
        publish_flush(r->outlet, 10);
}

void run_nudge(struct run *r) {
    if (r->outlet != NULL)
        publish_retry(r->outlet);
    wake(r);
}

void run_ask_to_stop(struct run *r) {
    atomic_store(&r->stop, true);
    wake(r);
}

// ---- Beginning and end ------------------------------------------------------------------------

double run_clock(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static struct run *run_new(const struct run_host *host, const char *id) {
    struct run *r = calloc(1, sizeof *r);
    if (r == NULL)
        return NULL;
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(&r->wake, &attributes);
    pthread_cond_init(&r->told, &attributes);
    pthread_condattr_destroy(&attributes);
    pthread_cond_init(&r->done, NULL);
    pthread_mutex_init(&r->lock, NULL);
    atomic_init(&r->references, 1);
    r->host = host;
    r->changes = cJSON_CreateArray();
    snprintf(r->id, sizeof r->id, "%s", id);
    r->slot = (struct slot){.wake = wake, .context = r};
    r->now = (struct run_status){.state = RUN_PAUSED, .eta_s = NAN, .error.particle = -1};
    r->now.balance = (struct mpm_balance){.mass = NAN, // not known before there is a simulation
                                          .momentum = {NAN, NAN, NAN},
                                          .angular_momentum = {NAN, NAN, NAN},
                                          .kinetic_energy = NAN,
                                          .strain_energy = NAN,
                                          .potential_energy = NAN,
                                          .external_work = NAN};
    r->ending = RUN_N_STATES;
    r->memory_told = SIZE_MAX;
    r->stop_step = UINT64_MAX;
    r->stop_time = INFINITY;
    r->wall_from = r->wait_from = NAN;
    return r;
}

void run_join(struct run *r) {
    if (r->has_thread)
        pthread_join(r->thread, NULL);
    r->has_thread = false;
}

void run_reap(struct run *r) {
    if (atomic_load(&r->over))
        run_join(r);
}

static void run_free(struct run *r) {
    if (r == NULL)
        return;
    run_ask_to_stop(r);
    run_join(r);
    publish_close(r->outlet);
    mpm_free(r->sim);
    scene_free(r->scene);
    cJSON_Delete(r->scene_json);
    series_free(r->series);
    recorders_free(r->recorders);
    journal_close(r->journal);
    cJSON_Delete(r->changes);
    free(r->view);
    cJSON_Delete(r->replay.scene);
    history_free(&r->history);
    history_meta_free(&r->meta);
    free(r->scene_text);
    free(r->config_text);
    free(r->row);
    pthread_mutex_destroy(&r->lock);
    pthread_cond_destroy(&r->wake);
    pthread_cond_destroy(&r->done);
    pthread_cond_destroy(&r->told);
    free(r);
}

void run_retain(struct run *r) {
    atomic_fetch_add(&r->references, 1);
}

void run_release(struct run *r) {
    if (r != NULL && atomic_fetch_sub(&r->references, 1) == 1)
        run_free(r);
}

int run_threads(const struct run_host *host, uint64_t particles) {
    const uint64_t repaid = particles / RUN_PARTICLES_PER_THREAD;
    if (!host->threads_fit || repaid >= (uint64_t)host->threads)
        return host->threads;
    return repaid > 1 ? (int)repaid : 1;
}

// What the scene alone says of the run, so that a run that waits for its slot can be shown.
static void describe_from_scene(struct run *r) {
    struct mpm_def *def = scene_def(r->scene);
    struct mpm_estimate estimate;
    def->n_threads = r->host->threads;
    def->isa = r->host->isa;
    def->clock = run_clock;
    def->memory_limit = r->host->memory_limit;
    mpm_estimate(def, &estimate); // of memory for all threads, some kB more than for fewer
    def->n_threads = run_threads(r->host, estimate.particles);
    r->now.threads = def->n_threads;
    double before = 0; // the last stage begins at t = 0
    for (size_t k = 0; k + 1 < def->n_stages; k++)
        before += def->stages[k].duration;
    r->sim_bytes = estimate.bytes;
    r->config = *scene_config(r->scene);
    r->now.particles = estimate.particles;
    r->now.nodes = estimate.nodes;
    r->now.bytes = estimate.bytes;
    r->now.dt = estimate.dt;
    r->now.dt_limit = estimate.dt_limit;
    r->now.end_time = r->config.end;
    r->now.time = r->now.start_time = 0 - before;
    r->now.fbar_scheme = r->config.settings.fbar.scheme;
    r->now.fbar = r->now.fbar_scheme != MPM_FBAR_OFF;
}

static bool meta_from_scene(struct run *r, const char *name) {
    size_t count;
    const struct scene_reference *references = scene_references(r->scene, &count);
    const struct mpm_def *def = scene_def(r->scene);
    history_now(r->meta.created);
    r->meta.name = strdup(name);
    r->meta.references = calloc(count + 1, sizeof *r->meta.references);
    if (r->meta.name == NULL || r->meta.references == NULL)
        return false;
    for (size_t k = 0; k < count; k++) {
        struct run_reference *to = &r->meta.references[k];
        *to = (struct run_reference){
            .probe = references[k].probe,
            .component = references[k].component,
            .name = strdup(def->probes[references[k].probe].name),
            .at_end = references[k].at_end,
            .at = references[k].at,
            .value = references[k].value,
            .tolerance = references[k].tolerance,
            .source = strdup(references[k].source != NULL ? references[k].source : "")};
        r->meta.n_references++;
        if (to->name == NULL || to->source == NULL)
            return false;
    }
    return true;
}

static bool begin_thread(struct run *r) {
    r->outlet = publish_open(r->host->publisher, r->id, r->journal, wake, r);
    r->status = r->now;
    r->accepts = r->outlet != NULL;
    r->has_thread = r->outlet != NULL && pthread_create(&r->thread, NULL, run_thread, r) == 0;
    return r->has_thread;
}

struct run *run_create(const struct run_host *host, const struct run_definition *definition,
                       bool *storage, char *why) {
    struct run *r = run_new(host, definition->id);
    char *scene = NULL, *meta = NULL, *event = NULL;
    cJSON *json = NULL;
    snprintf(why, JOURNAL_WHY, "out of memory");
    *storage = false;
    if (r == NULL)
        return NULL;
    r->scene = definition->scene;
    describe_from_scene(r);
    r->scene_json = cJSON_Duplicate(scene_json(r->scene), true);
    if (r->scene_json == NULL || !meta_from_scene(r, definition->name))
        goto fail;
    r->now.state = definition->start ? RUN_QUEUED : RUN_PAUSED;
    r->meta.wait_subscribers = definition->wait_subscribers;
    if (definition->key != NULL) {
        snprintf(r->meta.key, sizeof r->meta.key, "%s", definition->key);
        snprintf(r->meta.request, sizeof r->meta.request, "%s", definition->request);
    }
    r->lonely = definition->wait_subscribers > 0;
    r->wants_sim = !definition->start && !r->lonely; // its first frame comes with the simulation
    run_describe(r);
    scene = json_print(r->scene_json, true);
    meta = history_meta_text(r->id, &r->meta);
    json = history_event("state", &r->now);
    cJSON_AddStringToObject(json, "state", run_state_name(r->now.state));
    event = json_print(json, false);
    if (scene == NULL || meta == NULL || event == NULL)
        goto fail;
    *storage = true;
    r->journal = journal_create(host->data_dir, r->id, scene, meta, why);
    if (r->journal == NULL)
        goto fail;
    journal_budget(r->journal, (uint64_t)r->config.output.journal_bytes);
    r->recorders = recorders_open(r->journal, why);
    bool made = r->recorders != NULL &&
                journal_power(r->journal, r->config.output.durability_power, why) == JOURNAL_OK &&
                journal_append_event(r->journal, event, why) == JOURNAL_OK;
    for (size_t k = 0; made && k < definition->n_recorders; k++)
        made = recorders_put(r->recorders, definition->recorders[k], -1, why) == RECORDERS_OK;
    if (made && definition->start) // here and not in its thread, so that first come is first served
        slots_ask(host->slots, &r->slot, r->sim_bytes);
    if (made) {
        *storage = false;
        snprintf(why, JOURNAL_WHY, "no memory for the run's thread");
    }
    if (!made || !begin_thread(r)) {
        slots_leave(host->slots, &r->slot);
        slots_unreserve(host->slots, &r->slot);
        journal_rest(r->journal); // to clear its folder takes a descriptor
        journal_remove(host->data_dir, r->id, NULL);
        goto fail;
    }
    log_info("created", "run=%s scene=\"%s\" state=%s particles=%zu", r->id, r->meta.name,
             definition->start ? "queued" : "paused", (size_t)run_status(r).particles);
    free(scene);
    free(meta);
    free(event);
    cJSON_Delete(json);
    return r;
fail:
    free(scene);
    free(meta);
    free(event);
    cJSON_Delete(json);
    r->scene = NULL; // the caller's
    run_free(r);
    return NULL;
}

// ---- After a restart --------------------------------------------------------------------------

static void restore_failed(struct run *r, const char *kind, const char *why) {
    r->now.state = RUN_FAILED;
    r->now.error = (struct run_error){
        .present = true, .step = r->now.step, .time = r->now.time, .particle = -1, .value = NAN};
    snprintf(r->now.error.kind, sizeof r->now.error.kind, "%s", kind);
    snprintf(r->now.error.detail, sizeof r->now.error.detail, "%s", why);
    snprintf(r->now.error.advice, sizeof r->now.error.advice,
             "look at its folder, or delete the run");
    log_error("restore", "run=%s kind=%s why=\"%s\"", r->id, kind, why);
}

static bool restore_files(struct run *r, char *why) {
    size_t bytes;
    char *text = journal_text_of(r->host->data_dir, r->id, "run.json", &bytes);
    bool valid = text != NULL && history_meta_read(text, bytes, &r->meta);
    free(text);
    if (!valid) {
        snprintf(why, JOURNAL_WHY, "run.json is missing or damaged");
        return false;
    }
    text = journal_text_of(r->host->data_dir, r->id, "scene.json", &bytes);
    struct faults faults = {0};
    r->scene_json = text != NULL ? json_parse(text, bytes, &faults) : NULL;
    faults_free(&faults);
    free(text);
    if (r->scene_json == NULL) {
        snprintf(why, JOURNAL_WHY, "scene.json is missing or damaged");
        return false;
    }
    r->journal = journal_open(r->host->data_dir, r->id, why);
    if (r->journal == NULL)
        return false;
    r->recorders = recorders_open(r->journal, why);
    if (r->recorders == NULL)
        return false;
    if (journal_cut_bytes(r->journal) > 0)
        log_warn("torn_tail_cut", "run=%s bytes=%llu", r->id,
                 (unsigned long long)journal_cut_bytes(r->journal));
    text = journal_text(r->journal, "events.jsonl", &bytes);
    valid = text != NULL && history_read(text, bytes, &r->history, why);
    free(text);
    return valid;
}

// The status of the newest whole checkpoint, or (final) of the end; false when there is none.
static bool restore_status(struct run *r) {
    size_t bytes;
    struct faults faults = {0};
    char *text = journal_text(r->journal, "status.json", &bytes);
    cJSON *json = text != NULL ? json_parse(text, bytes, &faults) : NULL;
    bool found = history_status_read(json, &r->now);
    cJSON_Delete(json);
    free(text);
    for (int which = 0; which < 2 && !found; which++) {
        if (!journal_checkpoint_read(r->journal, which, &text, NULL, NULL))
            continue;
        json = json_parse(text, strlen(text), &faults);
        found = history_status_read(json_member(json, "status"), &r->now);
        r->next_seq = found ? (uint64_t)json_member(json, "next_frame")->valuedouble : 0;
        cJSON_Delete(json);
        free(text);
    }
    faults_free(&faults);
    return found;
}

// Patches the scene as it was created with every change that the log tells of.
static void restore_changes(struct run *r) {
    for (size_t k = 0; k < r->history.n_changes; k++) {
        struct scene_config config;
        struct faults faults = {0};
        unsigned which;
        bool end, output;
        cJSON *patched = scene_config_patch(r->scene_json, r->history.changes[k].patch, &config,
                                            &which, &end, &output, &faults);
        if (patched != NULL) {
            cJSON_Delete(r->scene_json);
            r->scene_json = patched;
            r->config = config;
        }
        const struct history_change *change = &r->history.changes[k];
        if (k + RUN_CHANGES >= r->history.n_changes) // the newest
            cJSON_AddItemToArray(r->changes,
                                 history_change_json(k + 1, change->step, change->time,
                                                     cJSON_Duplicate(change->patch, true)));
        faults_free(&faults);
    }
    r->now.revision = r->history.n_changes;
}

static void restore_series(struct run *r) {
    char path[4096 + 64], why[JOURNAL_WHY];
    journal_path(r->journal, "probes.log", path, sizeof path);
    r->series = series_load(path, why); // without it, a continued run samples again
}

// The end of a run is written in this order: last frame, status.json, event. A daemon killed in
// between left a run that is over without an event that says so.
static bool is_over(const struct run *r, bool has_status) {
    struct journal_frame last;
    uint64_t n = journal_n_frames(r->journal);
    if (has_status && run_state_is_final(r->now.state))
        return true;
    return n > 0 && journal_frame(r->journal, n - 1, &last) && last.end &&
           last.state == RUN_CANCELLED;
}

static void restore_final(struct run *r, enum run_state state, bool logged) {
    char why[JOURNAL_WHY];
    r->now.state = state;
    if (!r->now.error.present)
        r->now.error = r->history.error;
    if (!logged) {
        cJSON *event = history_event("state", &r->now);
        cJSON_AddStringToObject(event, "state", run_state_name(state));
        cJSON_AddItemToObject(event, "error", history_error(&r->now.error));
        char *text = json_print(event, false);
        if (text != NULL)
            journal_append_event(r->journal, text, why);
        free(text);
        cJSON_Delete(event);
    }
}

static bool restore_live(struct run *r, enum run_restore how) {
    struct faults faults = {0};
    enum run_state was = r->history.has_state ? r->history.state : RUN_PAUSED;
    r->scene = scene_create(r->scene_json, &faults);
    if (r->scene == NULL) {
        char why[JOURNAL_WHY];
        snprintf(why, sizeof why, "the scene is not valid for this version: %.100s: %.300s",
                 faults.count > 0 ? faults.items[0].pointer : "",
                 faults.count > 0 ? faults.items[0].detail : "");
        faults_free(&faults);
        restore_failed(r, "scene", why);
        return false;
    }
    faults_free(&faults);
    describe_from_scene(r);
    bool has_status = restore_status(r);
    restore_changes(r);
    restore_series(r);
    if (r->sim_bytes > r->host->memory_limit)
        run_warn(&r->now, "cannot go on here: it needs %zu bytes of memory, this daemon gives %zu",
                 r->sim_bytes, r->host->memory_limit);
    if (is_over(r, has_status)) {
        restore_final(r,
                      has_status && run_state_is_final(r->now.state) ? r->now.state : RUN_CANCELLED,
                      false);
        return false;
    }
    r->lonely = r->meta.wait_subscribers > 0 && journal_n_frames(r->journal) == 0;
    r->stop_step = r->history.stop_step;
    r->stop_time = r->history.stop_time;
    r->now.state = was != RUN_PAUSED && how == RUN_RESTORE_CONTINUE ? RUN_QUEUED : RUN_PAUSED;
    r->now.eta_s = NAN;
    r->now.epoch = r->history.epoch;
    journal_budget(r->journal, (uint64_t)r->config.output.journal_bytes);
    run_power(r);
    if (was != RUN_PAUSED && how == RUN_RESTORE_PAUSE) {
        char why[JOURNAL_WHY];
        cJSON *event = history_event("state", &r->now);
        cJSON_AddStringToObject(event, "state", run_state_name(RUN_PAUSED));
        char *text = json_print(event, false);
        if (text != NULL)
            journal_append_event(r->journal, text, why);
        free(text);
        cJSON_Delete(event);
    }
    return true;
}

struct run *run_restore(const struct run_host *host, const char *id, enum run_restore how) {
    char why[JOURNAL_WHY];
    struct run *r = run_new(host, id);
    if (r == NULL)
        return NULL;
    bool live = false;
    if (!restore_files(r, why)) {
        restore_failed(r, "journal", why);
        recorders_free(r->recorders);
        r->recorders = NULL;
        journal_close(r->journal);
        r->journal = NULL;
    } else if (r->history.has_state && run_state_is_final(r->history.state)) {
        restore_status(r);
        restore_changes(r);
        restore_series(r);
        restore_final(r, r->history.state, true);
    } else {
        live = restore_live(r, how);
    }
    if (!live) {
        journal_rest(r->journal);
        series_rest(r->series);
        history_free(&r->history);
    }
    if (r->meta.name == NULL)
        r->meta.name = strdup("");
    run_describe(r);
    r->status = r->now;
    if (live && !begin_thread(r)) {
        restore_failed(r, "memory", "cannot start its thread");
        r->status = r->now;
    }
    struct run_status seen = run_status(r);
    log_info("restored", "run=%s state=%s step=%llu frames=%llu", r->id, run_state_name(seen.state),
             (unsigned long long)seen.step,
             (unsigned long long)(r->journal != NULL ? journal_n_frames(r->journal) : 0));
    return r;
}
