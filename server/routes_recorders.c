// Routes about who records a run: registration, acknowledgement, and what the journal keeps for
// them.
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "server/bodies.h"
#include "server/routes_inside.h"

static cJSON *recorder_json(struct journal *journal, const struct recorder *recorder) {
    cJSON *json = cJSON_CreateObject();
    uint64_t n = journal_n_frames(journal), from = (uint64_t)(recorder->acked + 1);
    cJSON_AddStringToObject(json, "name", recorder->name);
    reply_add(json, "acked", (double)recorder->acked);
    reply_add(json, "lag_frames", n > from ? (double)(n - from) : 0);
    reply_add(json, "lag_bytes", (double)journal_bytes_from(journal, from));
    reply_add(json, "silent_s", recorder->heard);
    return json;
}

cJSON *routes_recorders_json(struct run *run) {
    struct recorder all[RECORDERS_MAX];
    size_t n = run_recorders(run) != NULL ? recorders_list(run_recorders(run), all) : 0;
    cJSON *list = cJSON_CreateArray();
    for (size_t k = 0; k < n; k++)
        cJSON_AddItemToArray(list, recorder_json(run_journal(run), &all[k]));
    return list;
}

cJSON *routes_journal_json(struct run *run) {
    struct journal *journal = run_journal(run);
    if (journal == NULL)
        return cJSON_CreateNull();
    cJSON *json = cJSON_CreateObject();
    reply_add(json, "frames", (double)journal_n_frames(journal));
    reply_add(json, "first", (double)journal_n_gone(journal));
    reply_add(json, "bytes", (double)journal_frame_bytes(journal));
    return json;
}

static void reply_recorders(struct call *c, struct run *run) {
    cJSON *json = cJSON_CreateObject();
    cJSON_AddItemToObject(json, "recorders", routes_recorders_json(run));
    reply_json(c->reply, 200, json);
}

// The run of the path where it has a journal; else the reply is filled.
static struct run *recorded_run(struct call *c) {
    struct run *run = routes_run_of(c);
    if (run != NULL && run_recorders(run) == NULL) {
        reply_problem(c->reply, 409, NULL, "run %.80s is %s: its journal cannot be read",
                      c->names[0], run_state_name(run_status(run).state));
        run_release(run);
        return NULL;
    }
    return run;
}

void routes_serve_recorders(struct call *c) {
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    reply_recorders(c, run);
    run_release(run);
}

static void check_body(const struct call *c, struct faults *faults) {
    bodies_check(c->route->request, c->body, faults);
    if (!runs_id_valid(c->names[1]))
        faults_add(faults, "", "pattern", RUNS_ID_PATTERN, c->names[1],
                   "the recorder's name must match " RUNS_ID_PATTERN ", got %.80s", c->names[1]);
}

static void put(struct call *c, struct run *run) {
    struct faults faults = {0};
    char why[JOURNAL_WHY] = "", expected[64];
    check_body(c, &faults);
    if (faults.count > 0) {
        reply_faults(c->reply, 422, &faults);
        faults_free(&faults);
        return;
    }
    const cJSON *acked = json_member(c->body, "acked");
    struct recorder recorder = {.acked = (int64_t)acked->valuedouble};
    snprintf(recorder.name, sizeof recorder.name, "%.64s", c->names[1]);
    cJSON *json;
    switch (recorders_put(run_recorders(run), recorder.name, recorder.acked, why)) {
    case RECORDERS_OK:
        run_nudge(run);
        json = recorder_json(run_journal(run), &recorder);
        // What was dropped before it came: it cannot have these.
        reply_add(json, "first", (double)journal_n_gone(run_journal(run)));
        reply_json(c->reply, 200, json);
        break;
    case RECORDERS_AHEAD:
        snprintf(expected, sizeof expected, "below %.20s, the number of frames so far", why);
        routes_value_fault(&faults, "acked", "range", expected, acked);
        reply_faults(c->reply, 422, &faults);
        break;
    case RECORDERS_TOO_MANY:
    case RECORDERS_UNKNOWN:
        reply_problem(c->reply, 409, NULL, "%s", why);
        break;
    case RECORDERS_STORAGE:
        reply_problem(c->reply, 507, NULL, "%s", why);
        break;
    }
    faults_free(&faults);
}

void routes_serve_record(struct call *c) {
    struct run *run = recorded_run(c);
    if (run == NULL)
        return;
    put(c, run);
    run_release(run);
}

void routes_serve_unrecord(struct call *c) {
    char why[JOURNAL_WHY] = "";
    struct run *run = recorded_run(c);
    if (run == NULL)
        return;
    switch (recorders_remove(run_recorders(run), c->names[1], why)) {
    case RECORDERS_OK:
        run_nudge(run);
        reply_recorders(c, run);
        break;
    case RECORDERS_STORAGE:
        reply_problem(c->reply, 507, NULL, "%s", why);
        break;
    case RECORDERS_UNKNOWN:
    case RECORDERS_TOO_MANY:
    case RECORDERS_AHEAD:
        reply_problem(c->reply, 404, NULL, "run %.80s has no recorder %.80s", c->names[0],
                      c->names[1]);
        break;
    }
    run_release(run);
}
