// One table of numbers serves writing and reading of the status, so that they cannot disagree.
#include "server/history.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

void history_now(char *out) {
    struct timespec now;
    struct tm utc;
    clock_gettime(CLOCK_REALTIME, &now);
    gmtime_r(&now.tv_sec, &utc);
    size_t n = strftime(out, HISTORY_TIME, "%Y-%m-%dT%H:%M:%S", &utc);
    snprintf(out + n, HISTORY_TIME - n, ".%03ldZ", now.tv_nsec / 1000000);
}

static void add(cJSON *object, const char *key, double value) {
    cJSON_AddItemToObject(object, key, json_number(value));
}

static double number(const cJSON *object, const char *key, double otherwise) {
    const cJSON *item = json_member(object, key);
    if (item == NULL)
        return otherwise;
    return cJSON_IsNumber(item) ? item->valuedouble : NAN;
}

static void text(const cJSON *object, const char *key, char *out, size_t bytes) {
    const char *value = cJSON_GetStringValue(json_member(object, key));
    snprintf(out, bytes, "%s", value != NULL ? value : "");
}

cJSON *history_event(const char *kind, const struct run_status *status) {
    char now[HISTORY_TIME];
    cJSON *event = cJSON_CreateObject();
    history_now(now);
    cJSON_AddStringToObject(event, "event", kind);
    cJSON_AddStringToObject(event, "at", now);
    add(event, "step", (double)status->step);
    add(event, "time", status->time);
    return event;
}

// ---- run.json ---------------------------------------------------------------------------------

char *history_meta_text(const char *id, const struct history_meta *meta) {
    cJSON *json = cJSON_CreateObject();
    cJSON_AddStringToObject(json, "format", "fbard-run-1");
    cJSON_AddStringToObject(json, "id", id);
    cJSON_AddStringToObject(json, "scene", meta->name);
    cJSON_AddStringToObject(json, "created", meta->created);
    cJSON_AddStringToObject(json, "version", FBARD_VERSION);
    if (meta->wait_subscribers > 0)
        add(json, "wait_subscribers", (double)meta->wait_subscribers);
    if (meta->key[0] != '\0') {
        cJSON_AddStringToObject(json, "idempotency_key", meta->key);
        cJSON_AddStringToObject(json, "request", meta->request);
    }
    cJSON *list = cJSON_AddArrayToObject(json, "references");
    for (size_t k = 0; k < meta->n_references; k++) {
        const struct run_reference *reference = &meta->references[k];
        cJSON *item = cJSON_CreateObject();
        cJSON_AddStringToObject(item, "name", reference->name);
        add(item, "probe", (double)reference->probe);
        add(item, "component", reference->component);
        if (!reference->at_end)
            add(item, "at", reference->at);
        add(item, "value", reference->value);
        add(item, "tolerance", reference->tolerance);
        cJSON_AddStringToObject(item, "source", reference->source);
        cJSON_AddItemToArray(list, item);
    }
    char *printed = json_print(json, true);
    cJSON_Delete(json);
    return printed;
}

bool history_meta_read(const char *given, size_t bytes, struct history_meta *out) {
    struct faults faults = {0};
    cJSON *json = json_parse(given, bytes, &faults);
    faults_free(&faults);
    *out = (struct history_meta){0};
    const char *name = cJSON_GetStringValue(json_member(json, "scene"));
    const cJSON *list = json_member(json, "references"), *item;
    size_t count = (size_t)cJSON_GetArraySize(list);
    bool valid = json != NULL && name != NULL;
    text(json, "created", out->created, sizeof out->created);
    text(json, "idempotency_key", out->key, sizeof out->key);
    text(json, "request", out->request, sizeof out->request);
    const cJSON *wait = json_member(json, "wait_subscribers");
    out->wait_subscribers =
        cJSON_IsNumber(wait) && wait->valuedouble > 0 && wait->valuedouble <= RUN_SUBSCRIBERS_MAX
            ? (uint64_t)wait->valuedouble
            : 0;
    out->name = strdup(name != NULL ? name : "");
    out->references = calloc(count + 1, sizeof *out->references);
    cJSON_ArrayForEach(item, list) {
        const char *source = cJSON_GetStringValue(json_member(item, "source"));
        const char *probe = cJSON_GetStringValue(json_member(item, "name"));
        if (out->references == NULL)
            break;
        out->references[out->n_references++] =
            (struct run_reference){.probe = (size_t)number(item, "probe", 0),
                                   .component = (int)number(item, "component", 0),
                                   .at_end = json_member(item, "at") == NULL,
                                   .at = number(item, "at", 0),
                                   .value = number(item, "value", NAN),
                                   .tolerance = number(item, "tolerance", NAN),
                                   .name = strdup(probe != NULL ? probe : ""),
                                   .source = strdup(source != NULL ? source : "")};
    }
    cJSON_Delete(json);
    return valid && out->name != NULL && out->references != NULL;
}

void history_meta_free(struct history_meta *meta) {
    for (size_t k = 0; k < meta->n_references; k++) {
        free(meta->references[k].name);
        free(meta->references[k].source);
    }
    free(meta->references);
    free(meta->name);
    *meta = (struct history_meta){0};
}

// ---- Status -----------------------------------------------------------------------------------

#define U64_LIST(X)                                                                                \
    X(step) X(stage) X(particles) X(nodes) X(bytes) X(epoch) X(revision) X(balance_step)
#define DOUBLE_LIST(X) X(time) X(start_time) X(end_time) X(dt) X(dt_limit) X(wall_s)
#define BALANCE_LIST(X)                                                                            \
    X(mass) X(kinetic_energy) X(strain_energy) X(potential_energy) X(external_work)
#define BALANCE_VECTOR_LIST(X) X(momentum) X(angular_momentum)

cJSON *history_error(const struct run_error *error) {
    if (!error->present)
        return cJSON_CreateNull();
    cJSON *json = cJSON_CreateObject();
    cJSON_AddStringToObject(json, "kind", error->kind);
    add(json, "step", (double)error->step);
    add(json, "time", error->time);
    if (error->particle >= 0)
        add(json, "particle", (double)error->particle);
    else
        cJSON_AddNullToObject(json, "particle");
    if (error->quantity[0] != '\0')
        cJSON_AddStringToObject(json, "quantity", error->quantity);
    else
        cJSON_AddNullToObject(json, "quantity");
    add(json, "value", error->value);
    cJSON_AddStringToObject(json, "advice", error->advice);
    cJSON_AddStringToObject(json, "detail", error->detail);
    return json;
}

static void error_read(const cJSON *json, struct run_error *out) {
    *out = (struct run_error){.present = cJSON_IsObject(json), .particle = -1};
    if (!out->present)
        return;
    double particle = number(json, "particle", NAN);
    text(json, "kind", out->kind, sizeof out->kind);
    text(json, "quantity", out->quantity, sizeof out->quantity);
    text(json, "advice", out->advice, sizeof out->advice);
    text(json, "detail", out->detail, sizeof out->detail);
    out->step = (uint64_t)fmax(number(json, "step", 0), 0);
    out->time = number(json, "time", NAN);
    out->value = number(json, "value", NAN);
    out->particle = isnan(particle) ? -1 : (int64_t)particle;
}

cJSON *history_status(const struct run_status *status) {
    cJSON *json = cJSON_CreateObject(), *balance, *list, *phases, *warnings;
    cJSON_AddStringToObject(json, "state", run_state_name(status->state));
#define X(name) add(json, #name, (double)status->name);
    U64_LIST(X)
    DOUBLE_LIST(X)
#undef X
    cJSON_AddStringToObject(json, "fbar", mpm_fbar_name(status->fbar_scheme));
    balance = cJSON_AddObjectToObject(json, "balance");
#define X(name) add(balance, #name, status->balance.name);
    BALANCE_LIST(X)
#undef X
#define X(name)                                                                                    \
    list = cJSON_AddArrayToObject(balance, #name);                                                 \
    for (int d = 0; d < MPM_MAX_DIM; d++)                                                          \
        cJSON_AddItemToArray(list, json_number(status->balance.name[d]));
    BALANCE_VECTOR_LIST(X)
#undef X
    phases = cJSON_AddObjectToObject(json, "phases");
    for (int k = 0; k < RUN_N_PHASES; k++)
        add(phases, run_phase_name(k), status->phases[k]);
    cJSON_AddItemToObject(json, "error", history_error(&status->error));
    warnings = cJSON_AddArrayToObject(json, "warnings");
    for (unsigned k = 0; k < status->n_warnings; k++)
        cJSON_AddItemToArray(warnings, cJSON_CreateString(status->warnings[k]));
    return json;
}

bool history_status_read(const cJSON *json, struct run_status *out) {
    const char *name = cJSON_GetStringValue(json_member(json, "state"));
    int state = name != NULL ? run_state_parse(name) : -1;
    const char *scheme = cJSON_GetStringValue(json_member(json, "fbar"));
    int fbar = scheme != NULL ? mpm_fbar_parse(scheme) : -1;
    const cJSON *balance = json_member(json, "balance"), *warning;
    if (state < 0 || fbar < 0)
        return false;
    *out = (struct run_status){.state = (enum run_state)state,
                               .fbar = fbar != MPM_FBAR_OFF,
                               .fbar_scheme = (enum mpm_fbar_scheme)fbar,
                               .eta_s = NAN};
#define X(name) out->name = (uint64_t)fmax(number(json, #name, 0), 0);
    U64_LIST(X)
#undef X
#define X(name) out->name = number(json, #name, 0);
    DOUBLE_LIST(X)
#undef X
#define X(name) out->balance.name = number(balance, #name, NAN);
    BALANCE_LIST(X)
#undef X
#define X(name)                                                                                    \
    for (int d = 0; d < MPM_MAX_DIM; d++) {                                                        \
        const cJSON *item = cJSON_GetArrayItem(json_member(balance, #name), d);                    \
        out->balance.name[d] = cJSON_IsNumber(item) ? item->valuedouble : NAN;                     \
    }
    BALANCE_VECTOR_LIST(X)
#undef X
    for (int k = 0; k < RUN_N_PHASES; k++)
        out->phases[k] = number(json_member(json, "phases"), run_phase_name(k), 0);
    error_read(json_member(json, "error"), &out->error);
    cJSON_ArrayForEach(warning, json_member(json, "warnings")) {
        if (cJSON_IsString(warning) && out->n_warnings < RUN_WARNINGS)
            snprintf(out->warnings[out->n_warnings++], sizeof out->warnings[0], "%s",
                     warning->valuestring);
    }
    return true;
}

// ---- The event log ----------------------------------------------------------------------------

static bool change_add(struct history *out, uint64_t number_of_line, const cJSON *event) {
    struct history_change *moved =
        realloc(out->changes, (out->n_changes + 1) * sizeof *out->changes);
    if (moved == NULL)
        return false;
    out->changes = moved;
    out->changes[out->n_changes++] =
        (struct history_change){.number = number_of_line,
                                .step = (uint64_t)fmax(number(event, "step", 0), 0),
                                .time = number(event, "time", NAN),
                                .frames = (uint64_t)fmax(number(event, "frames", 0), 0),
                                .patch = cJSON_Duplicate(json_member(event, "patch"), true)};
    return true;
}

static bool event_read(struct history *out, uint64_t line, const cJSON *event) {
    const char *kind = cJSON_GetStringValue(json_member(event, "event"));
    if (kind == NULL)
        return false;
    if (strcmp(kind, "state") == 0) {
        const char *name = cJSON_GetStringValue(json_member(event, "state"));
        int state = name != NULL ? run_state_parse(name) : -1;
        if (state < 0)
            return false;
        out->has_state = true;
        out->state = (enum run_state)state;
        double stop = number(event, "until_step", NAN);
        out->stop_step = isnan(stop) ? UINT64_MAX : (uint64_t)stop;
        out->stop_time = number(event, "until_time", INFINITY);
        error_read(json_member(event, "error"), &out->error);
    } else if (strcmp(kind, "config") == 0) {
        return change_add(out, line, event);
    } else if (strcmp(kind, "epoch") == 0) {
        out->epoch = (uint64_t)fmax(number(event, "epoch", 0), 0);
    }
    return true;
}

cJSON *history_change_json(uint64_t revision, uint64_t step, double time, cJSON *patch) {
    cJSON *json = cJSON_CreateObject();
    add(json, "revision", (double)revision);
    add(json, "step", (double)step);
    add(json, "time", time);
    cJSON_AddItemToObject(json, "patch", patch);
    return json;
}

cJSON *history_change_of(const char *line) {
    static const char start[] = "{\"event\":\"config\""; // as history_event writes it
    if (strncmp(line, start, sizeof start - 1) != 0)
        return NULL;
    struct faults faults = {0};
    cJSON *event = json_parse(line, strlen(line), &faults), *change = NULL;
    if (event != NULL)
        change = history_change_json((uint64_t)fmax(number(event, "revision", 0), 0),
                                     (uint64_t)fmax(number(event, "step", 0), 0),
                                     number(event, "time", NAN),
                                     cJSON_Duplicate(json_member(event, "patch"), true));
    cJSON_Delete(event);
    faults_free(&faults);
    return change;
}

bool history_read(const char *given, size_t bytes, struct history *out, char *why) {
    *out = (struct history){.stop_step = UINT64_MAX, .stop_time = INFINITY};
    uint64_t line = 0;
    for (size_t at = 0; at < bytes; line++) {
        const char *end = memchr(given + at, '\n', bytes - at);
        if (end == NULL)
            break; // torn: the journal has cut it
        struct faults faults = {0};
        cJSON *event = json_parse(given + at, (size_t)(end - given) - at, &faults);
        bool valid = event != NULL && event_read(out, line, event);
        cJSON_Delete(event);
        faults_free(&faults);
        if (!valid) {
            snprintf(why, JOURNAL_WHY, "events.jsonl: damaged line %llu",
                     (unsigned long long)line + 1);
            return false;
        }
        at = (size_t)(end - given) + 1;
    }
    return true;
}

void history_changes_free(struct history *history) {
    for (size_t k = 0; k < history->n_changes; k++)
        cJSON_Delete(history->changes[k].patch);
    free(history->changes);
    history->changes = NULL;
    history->n_changes = 0;
}

void history_free(struct history *history) {
    history_changes_free(history);
    *history = (struct history){0};
}
