// Routes about runs: create, look, act, configure, delete. Each posts one command or reads one
// status.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/bodies.h"
#include "server/history.h"
#include "server/routes_inside.h"
#include "server/scene_fault.h"

// ---- Run objects ------------------------------------------------------------------------------

static cJSON *accuracy_json(struct run *run, const struct run_status *status) {
    size_t count;
    const struct run_reference *references = run_references(run, &count);
    struct series *series = run_series(run);
    cJSON *list = cJSON_CreateArray();
    for (size_t k = 0; k < count; k++) {
        const struct run_reference *r = &references[k];
        double value = NAN;
        const struct series_probe *probe = series != NULL && r->probe < series_n_probes(series)
                                               ? series_probe(series, r->probe)
                                               : NULL;
        if (probe != NULL && (size_t)r->component < probe->n_components) {
            size_t column = probe->column + (size_t)r->component;
            bool ended = status->state == RUN_COMPLETED;
            if (!r->at_end || ended)
                series_at_time(series, column, r->at_end ? status->time : r->at, &value);
        }
        cJSON *item = cJSON_CreateObject();
        cJSON_AddStringToObject(item, "probe", r->name);
        if (probe != NULL && (size_t)r->component < probe->n_components &&
            probe->components[r->component][0] != '\0')
            cJSON_AddStringToObject(item, "component", probe->components[r->component]);
        if (r->at_end)
            cJSON_AddStringToObject(item, "at", "end");
        else
            reply_add(item, "at", r->at);
        reply_add(item, "value", value);
        reply_add(item, "reference", r->value);
        // Of a reference of 0, as an error's is: how far from it.
        const double size = r->value != 0 ? fabs(r->value) : 1;
        reply_add(item, "relative_error", fabs(value - r->value) / size);
        reply_add(item, "tolerance", r->tolerance);
        cJSON_AddStringToObject(item, "source", r->source);
        cJSON_AddItemToArray(list, item);
    }
    return list;
}

static cJSON *vector_json(const double *values, int from, int to) {
    cJSON *list = cJSON_CreateArray();
    for (int d = from; d < to; d++)
        cJSON_AddItemToArray(list, json_number(values[d]));
    return list;
}

static cJSON *balance_json(const struct run_status *status) {
    const struct mpm_balance *balance = &status->balance;
    cJSON *json = cJSON_CreateObject();
    reply_add(json, "mass", balance->mass);
    cJSON_AddItemToObject(json, "momentum", vector_json(balance->momentum, 0, MPM_MAX_DIM));
    cJSON_AddItemToObject(json, "angular_momentum",
                          vector_json(balance->angular_momentum, 0, MPM_MAX_DIM));
    reply_add(json, "kinetic_energy", balance->kinetic_energy);
    reply_add(json, "strain_energy", balance->strain_energy);
    reply_add(json, "potential_energy", balance->potential_energy);
    reply_add(json, "external_work", balance->external_work);
    reply_add(json, "step", (double)status->balance_step);
    return json;
}

// Of clocks: a microsecond is what they are good for, and short numbers are printed quickly.
static double shown_seconds(double value) {
    return round(1e6 * value) / 1e6;
}

static cJSON *performance_json(const struct run_status *status) {
    cJSON *json = cJSON_CreateObject(), *phases;
    double work = (double)status->particles * (double)status->step;
    reply_add(json, "wall_s", shown_seconds(status->wall_s));
    reply_add(json, "particle_steps_per_s",
              status->wall_s > 0 ? round(work / status->wall_s) : NAN);
    reply_add(json, "bytes_per_particle",
              status->particles > 0 ? (double)status->bytes / (double)status->particles : NAN);
    reply_add(json, "threads", status->threads > 0 ? status->threads : NAN);
    phases = cJSON_AddObjectToObject(json, "phases");
    for (int k = 0; k < RUN_N_PHASES; k++)
        reply_add(phases, run_phase_name(k), shown_seconds(status->phases[k]));
    return json;
}

static cJSON *error_json(const struct run_error *error) {
    cJSON *json = history_error(error);
    if (error->present) {
        cJSON_AddStringToObject(json, "type", "about:blank");
        cJSON_AddStringToObject(json, "title", "Run Failed");
    }
    return json;
}

double routes_progress(const struct run_status *status) {
    double span = status->end_time - status->start_time;
    double done = span > 0 ? (status->time - status->start_time) / span : 0;
    if (status->state == RUN_COMPLETED)
        return 1;
    return done > 0 ? (done < 1 ? done : 1) : 0; // 0 for NaN as well
}

cJSON *routes_run_json(struct run *run) {
    struct run_status status = run_status(run);
    struct series *series = run_series(run);
    cJSON *json = cJSON_CreateObject(), *warnings;
    cJSON_AddStringToObject(json, "id", run_id(run));
    cJSON_AddStringToObject(json, "state", run_state_name(status.state));
    reply_add(json, "step", (double)status.step);
    reply_add(json, "time", status.time);
    reply_add(json, "start_time", status.start_time);
    reply_add(json, "end_time", status.end_time);
    reply_add(json, "stage", (double)status.stage);
    reply_add(json, "progress", routes_progress(&status));
    reply_add(json, "eta_s", shown_seconds(status.eta_s));
    reply_add(json, "dt", status.dt);
    reply_add(json, "dt_limit", status.dt_limit);
    cJSON_AddBoolToObject(json, "fbar", status.fbar);
    cJSON_AddStringToObject(json, "fbar_scheme", mpm_fbar_name(status.fbar_scheme));
    reply_add(json, "particles", (double)status.particles);
    reply_add(json, "nodes", (double)status.nodes);
    cJSON_AddStringToObject(json, "scene", run_name(run));
    cJSON_AddStringToObject(json, "created", run_created(run));
    reply_add(json, "epoch", (double)status.epoch);
    cJSON_AddItemToObject(json, "error", error_json(&status.error));
    warnings = cJSON_AddArrayToObject(json, "warnings");
    for (unsigned k = 0; k < status.n_warnings; k++)
        cJSON_AddItemToArray(warnings, cJSON_CreateString(status.warnings[k]));
    cJSON *changes = run_changes(run), *newest = NULL;
    if (changes != NULL && changes->child != NULL)
        newest = changes->child->prev; // the last one, with cJSON
    reply_add(json, "revision", newest != NULL ? json_member(newest, "revision")->valuedouble : 0);
    cJSON_AddItemToObject(json, "changes", changes);
    cJSON_AddItemToObject(json, "journal", routes_journal_json(run));
    cJSON_AddItemToObject(json, "recorders", routes_recorders_json(run));
    cJSON_AddItemToObject(json, "performance", performance_json(&status));
    cJSON_AddItemToObject(json, "balance", balance_json(&status));
    cJSON_AddItemToObject(
        json, "probes", series != NULL ? series_values(series, UINT64_MAX) : cJSON_CreateObject());
    cJSON_AddItemToObject(json, "accuracy", accuracy_json(run, &status));
    return json;
}

// A 404 that says what was perhaps meant: an id that is near, or else the newest one that begins
// with the word (ids that the daemon makes up begin with the scene's name).
static void reply_no_run(struct call *c) {
    const char *word = c->names[0];
    struct scene_suggestion s = {.word = word};
    size_t count;
    struct run **all = runs_all(c->routes->runs, &count);
    for (size_t k = 0; k < count; k++)
        scene_suggest(&s, run_id(all[k]));
    for (size_t k = count; s.best == NULL && k-- > 0;)
        if (word[0] != '\0' && strncmp(run_id(all[k]), word, strlen(word)) == 0)
            s.best = run_id(all[k]);
    if (s.best != NULL)
        reply_problem(c->reply, 404, NULL, "there is no run %.80s; did you mean %s?", word, s.best);
    else
        reply_problem(c->reply, 404, NULL, "there is no run %.80s", word);
    for (size_t k = 0; k < count; k++)
        run_release(all[k]);
    free(all);
}

// The run that the path names, retained; NULL when the reply is a 404.
struct run *routes_run_of(struct call *c) {
    struct run *run = runs_find(c->routes->runs, c->names[0]);
    if (run == NULL)
        reply_no_run(c);
    return run;
}

// "running,paused" -> bits by state. False when the reply is a 400.
static bool states_asked(struct call *c, unsigned *out) {
    char text[128], *rest = text;
    *out = (1U << RUN_N_STATES) - 1;
    if (!http_query(c->request, "state", text, sizeof text))
        return true;
    *out = 0;
    for (char *word; (word = strsep(&rest, ",")) != NULL;) {
        int state = run_state_parse(word);
        if (state < 0) {
            reply_problem(c->reply, 400, NULL,
                          "state must be names of states with commas between, got \"%.40s\"", word);
            return false;
        }
        *out |= 1U << state;
    }
    return true;
}

// Where the runs that are older than the one that `before` names end; all when it is not given.
// False when the reply is a 400.
static bool older_than(struct call *c, struct run **all, size_t *count) {
    char id[RUN_ID_MAX + 1];
    if (!http_query(c->request, "before", id, sizeof id))
        return true;
    size_t k = 0;
    while (k < *count && strcmp(run_id(all[k]), id) != 0)
        k++;
    if (k == *count) {
        reply_problem(c->reply, 400, NULL, "before must be the id of a run, got \"%.64s\"", id);
        return false;
    }
    *count = k;
    return true;
}

void routes_serve_runs(struct call *c) {
    size_t count;
    uint64_t limit, listed = 0, older = 0;
    unsigned states;
    if (!states_asked(c, &states) || !routes_query_number(c, "limit", UINT64_MAX, &limit))
        return;
    struct run **all = runs_all(c->routes->runs, &count);
    size_t end = count;
    if (older_than(c, all, &end)) {
        cJSON *json = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(json, "runs");
        for (size_t k = end; k > 0; k--) { // the newest of them, oldest first
            if ((states >> run_status(all[k - 1]).state & 1) == 0)
                continue;
            if (listed == limit) {
                older++;
                continue;
            }
            cJSON_InsertItemInArray(list, 0, routes_run_json(all[k - 1]));
            listed++;
        }
        if (limit != UINT64_MAX)
            reply_add(json, "older", (double)older);
        reply_json(c->reply, 200, json);
    }
    for (size_t k = 0; k < count; k++)
        run_release(all[k]);
    free(all);
}

void routes_serve_run(struct call *c) {
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    struct run_view view;
    const bool plain = run_view(run, &view);
    char *kept = plain ? run_view_text(run, &view) : NULL;
    if (kept != NULL) {
        reply_text(c->reply, 200, "application/json", kept);
    } else {
        reply_json(c->reply, 200, routes_run_json(run));
        if (plain && c->reply->body != NULL)
            run_view_keep(run, &view, c->reply->body);
    }
    run_release(run);
}

void routes_serve_delete(struct call *c) {
    enum run_state state = RUN_QUEUED;
    char why[JOURNAL_WHY] = "";
    switch (runs_remove(c->routes->runs, c->names[0], &state, why)) {
    case RUNS_REMOVED:
        c->reply->status = 204;
        break;
    case RUNS_MISSING:
        reply_no_run(c);
        break;
    case RUNS_ALIVE:
        reply_problem(c->reply, 409, NULL, "run %.80s is %s: cancel it first", c->names[0],
                      run_state_name(state));
        break;
    case RUNS_REMOVAL_FAILED:
        reply_problem(c->reply, 507, NULL, "%s", why);
        break;
    }
}

// ---- Creating ---------------------------------------------------------------------------------

// What the body says of the run, as far as it is sound.
static void read_create(const cJSON *body, struct run_definition *out, struct faults *faults) {
    const size_t before = faults->count;
    bodies_check("Create", body, faults);
    if (faults->count != before)
        return;
    const cJSON *wait = json_member(body, "wait_subscribers"), *item;
    out->id = cJSON_GetStringValue(json_member(body, "id"));
    out->start = !cJSON_IsFalse(json_member(body, "start"));
    out->wait_subscribers = wait != NULL ? (uint64_t)wait->valuedouble : 0;
    cJSON_ArrayForEach(item, json_member(body, "recorders")) out->recorders[out->n_recorders++] =
        item->valuestring;
}

// The key of a request that may be sent twice, and a digest of its body. False when the reply is a
// 400.
static bool idempotency(struct call *c, struct run_definition *out, char *digest) {
    const char *key = http_header(c->request, "Idempotency-Key");
    if (key == NULL)
        return true;
    size_t n = 0;
    while (key[n] > ' ' && key[n] < 127)
        n++;
    if (n == 0 || key[n] != '\0' || n > RUN_KEY_MAX) {
        reply_problem(c->reply, 400, NULL,
                      "Idempotency-Key must be 1 to %d visible ASCII characters", RUN_KEY_MAX);
        return false;
    }
    char *text = json_print(c->body, false); // white space makes no other request
    json_digest(text != NULL ? text : "", digest);
    free(text);
    out->key = key;
    out->request = digest;
    return true;
}

static void reply_created(struct call *c, struct run *run, bool again) {
    reply_json(c->reply, 201, routes_run_json(run));
    if (again)
        http_reply_header(c->reply, "Idempotency-Replayed", "true");
    http_reply_header(c->reply, "Location", "/v1/runs/%s", run_id(run));
    run_release(run);
}

// The reply to a request for a run that was not made now.
static void reply_not_made(struct call *c, enum runs_result result, struct run *run,
                           const struct run_definition *definition, const char *why) {
    struct faults faults = {0};
    struct run *twin = NULL;
    switch (result) {
    case RUNS_CREATED:
        break;
    case RUNS_THERE:
        reply_created(c, run, true);
        break;
    case RUNS_KEY_REUSED:
        faults_add(&faults, "", "idempotency_key", "the body that the key was first sent with",
                   "another body", "%s", why);
        reply_faults(c->reply, 422, &faults);
        break;
    case RUNS_DUPLICATE:
        twin = runs_find(c->routes->runs, definition->id);
        reply_problem(c->reply, 409, NULL, "%s, and it is %s", why,
                      twin != NULL ? run_state_name(run_status(twin).state) : "gone by now");
        run_release(twin);
        break;
    case RUNS_FULL:
    case RUNS_MEMORY:
    case RUNS_STOPPED:
        reply_problem(c->reply, 503, NULL, "%s", why);
        break;
    case RUNS_STORAGE:
        reply_problem(c->reply, 507, NULL, "%s", why);
        break;
    }
    faults_free(&faults);
}

// What is quick to tell goes first: a repeated request is answered whatever its scene would be
// judged today, and no shape is filled for a run that there is no place for.
void routes_serve_create(struct call *c) {
    struct faults faults = {0};
    struct run_definition definition = {0};
    struct run *run = NULL;
    cJSON *merged = NULL;
    struct scene *scene = NULL;
    enum runs_result result;
    char why[JOURNAL_WHY] = "", digest[JSON_DIGEST];
    if (!idempotency(c, &definition, digest))
        return;
    if (definition.key != NULL) {
        result = runs_admit(c->routes->runs, &definition, &run, why);
        if (result == RUNS_THERE || result == RUNS_KEY_REUSED) {
            reply_not_made(c, result, run, &definition, why);
            return;
        }
    }
    read_create(c->body, &definition, &faults);
    merged = routes_merged_scene(c->body, &faults);
    if (merged != NULL)
        scene = routes_read_scene(c, merged, "/scene", &faults);
    result = scene != NULL && faults.count == 0
                 ? runs_admit(c->routes->runs, &definition, &run, why)
                 : RUNS_CREATED;
    if (result != RUNS_CREATED) {
        reply_not_made(c, result, run, &definition, why);
    } else if (scene == NULL || !routes_examine_scene(c, scene, "/scene", &faults) ||
               faults.count > 0) {
        reply_faults(c->reply, 422, &faults);
    } else {
        const char *named = cJSON_GetStringValue(json_member(c->body, "scene"));
        definition.name = named != NULL ? named : scene_title(scene);
        definition.scene = scene;
        result = runs_add(c->routes->runs, &definition, &run, why);
        if (result == RUNS_CREATED) {
            scene = NULL;
            reply_created(c, run, false);
        } else {
            reply_not_made(c, result, run, &definition, why);
        }
    }
    scene_free(scene);
    cJSON_Delete(merged);
    faults_free(&faults);
}

// ---- Actions ----------------------------------------------------------------------------------

// The reply to a command that was not carried out.
static void refuse(struct call *c, const struct run_command *command) {
    bool configures = command->action == RUN_DO_CONFIGURE;
    switch (command->outcome) {
    case RUN_DONE:
        break;
    case RUN_ILLEGAL:
        reply_problem(c->reply, 409, NULL, "run %.80s is %s: %s %s", c->names[0],
                      run_state_name(command->state),
                      configures ? "its configuration cannot" : "it cannot",
                      configures ? "change" : run_action_name(command->action));
        break;
    case RUN_INVALID:
        reply_faults(c->reply, 422, &command->faults);
        break;
    case RUN_STALE:
        reply_problem(c->reply, 412, NULL,
                      "the configuration has changed meanwhile: read it again");
        break;
    case RUN_BUSY:
        reply_problem(c->reply, 503, NULL, "%s", command->why);
        break;
    case RUN_STORAGE:
        reply_problem(c->reply, 507, NULL, "%s", command->why);
        break;
    case RUN_STOPPING:
        reply_problem(c->reply, 503, NULL, "the daemon is ending");
        break;
    }
}

void routes_serve_action(struct call *c) {
    struct run_command command = {.action = (enum run_action)c->route->action};
    struct faults faults = {0};
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    const cJSON *steps = json_member(c->body, "steps"), *until = json_member(c->body, "until");
    bodies_check(c->route->request, c->body, &faults);
    if (faults.count == 0) {
        // No run does as many steps as doubles can count.
        command.steps = steps != NULL ? (uint64_t)fmin(steps->valuedouble, JSON_COUNTED) : 0;
        command.until = until != NULL ? until->valuedouble : NAN;
    }
    if (faults.count > 0) {
        reply_faults(c->reply, 422, &faults);
    } else {
        run_command(run, &command);
        if (command.outcome == RUN_DONE) {
            cJSON *json = routes_run_json(run);
            reply_add(json, "effective_step", (double)command.effective_step);
            if (command.action == RUN_DO_SNAPSHOT)
                reply_add(json, "frame_seq", (double)command.frame_seq);
            reply_json(c->reply, 200, json);
        } else {
            refuse(c, &command);
        }
    }
    faults_free(&command.faults);
    faults_free(&faults);
    run_release(run);
}

// ---- Configuration ----------------------------------------------------------------------------

static void reply_config(struct call *c, struct run *run, const struct run_command *command) {
    uint64_t revision;
    char *text = run_config_text(run, &revision);
    if (text == NULL) {
        reply_problem(c->reply, 404, NULL, "run %.80s has no configuration that can be read",
                      c->names[0]);
        return;
    }
    if (command != NULL) {
        struct faults faults = {0};
        cJSON *json = json_parse(text, strlen(text), &faults);
        reply_add(json, "effective_step", (double)command->effective_step);
        free(text);
        text = json_print(json, false);
        cJSON_Delete(json);
        faults_free(&faults);
    }
    reply_text(c->reply, 200, "application/json", text);
    http_reply_header(c->reply, "ETag", "\"%llu\"", (unsigned long long)revision);
}

void routes_serve_config(struct call *c) {
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    reply_config(c, run, NULL);
    run_release(run);
}

// All changes, which the run object has the newest of: read from the log, however many they are.
void routes_serve_changes(struct call *c) {
    uint64_t since;
    if (!routes_query_number(c, "since_revision", 0, &since))
        return;
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    struct journal *journal = run_journal(run);
    cJSON *json = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(json, "changes");
    uint64_t offset = 0, revision = 0;
    char *line;
    while (journal != NULL && (line = journal_event_next(journal, &offset)) != NULL) {
        cJSON *change = history_change_of(line);
        if (change != NULL && ++revision > since)
            cJSON_AddItemToArray(list, change);
        else
            cJSON_Delete(change);
        free(line);
    }
    reply_json(c->reply, 200, json);
    run_release(run);
}

// Whether one of the entity tags in an If-Match header is that of `revision`.
static bool tag_matches(const char *header, uint64_t revision) {
    char tag[32];
    snprintf(tag, sizeof tag, "\"%llu\"", (unsigned long long)revision);
    size_t n = strlen(tag);
    for (const char *at = header; at != NULL; at = strchr(at, ',')) {
        at += strspn(at, ", \t");
        if (strncmp(at, tag, n) == 0 && strchr(", \t", at[n]) != NULL) // or the end
            return true;
    }
    return false;
}

void routes_serve_configure(struct call *c) {
    struct run_command command = {.action = RUN_DO_CONFIGURE, .patch = c->body};
    const char *match = http_header(c->request, "If-Match");
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    command.state = RUN_N_STATES;
    if (match != NULL && strcmp(match, "*") != 0) {
        command.has_revision = true;
        command.revision = run_status(run).revision;
    }
    if (command.has_revision && !tag_matches(match, command.revision))
        command.outcome = RUN_STALE;
    else
        run_command(run, &command);
    if (command.outcome == RUN_DONE)
        reply_config(c, run, &command);
    else
        refuse(c, &command);
    faults_free(&command.faults);
    run_release(run);
}

void routes_serve_run_scene(struct call *c) {
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    char *text = run_scene_text(run);
    if (text == NULL)
        reply_problem(c->reply, 404, NULL, "run %.80s has no scene that can be read", c->names[0]);
    else
        reply_text(c->reply, 200, "application/json", text);
    run_release(run);
}
