// Routes about the daemon itself, its materials and scenes, and scenes in a body.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/bodies.h"
#include "server/openapi.h"
#include "server/routes_inside.h"
#include "server/scene_fault.h"

// ---- The daemon itself ------------------------------------------------------------------------

void routes_serve_health(struct call *c) {
    cJSON *json = cJSON_CreateObject();
    cJSON_AddStringToObject(json, "status", "ok");
    reply_json(c->reply, 200, json);
}

void routes_serve_ready(struct call *c) {
    char why[JOURNAL_WHY] = "";
    if (!runs_ready(c->routes->runs, why)) {
        reply_problem(c->reply, 503, NULL, "no room for another run now: %s", why);
        return;
    }
    cJSON *json = cJSON_CreateObject();
    cJSON_AddStringToObject(json, "status", "ready");
    reply_json(c->reply, 200, json);
}

void routes_serve_openapi(struct call *c) {
    reply_json(c->reply, 200, openapi_document());
}

void routes_serve_service(struct call *c) {
    const struct options *options = c->routes->options;
    cJSON *json = cJSON_CreateObject(), *limits, *endpoints;
    struct http_counts counts;
    http_count(c->routes->http, &counts);
    cJSON_AddStringToObject(json, "name", "fbard");
    cJSON_AddStringToObject(json, "version", FBARD_VERSION);
    cJSON_AddStringToObject(json, "build", "C17, " __VERSION__);
    cJSON_AddStringToObject(json, "instruction_set", mpm_isa_name(mpm_isa_in_use(options->isa)));
    cJSON_AddNumberToObject(json, "threads", options->threads);
    cJSON_AddNumberToObject(json, "slots", options->slots);
    limits = cJSON_AddObjectToObject(json, "limits");
    reply_add(limits, "body_bytes", (double)options->max_body);
    reply_add(limits, "header_bytes", HTTP_HEADER_BYTES);
    reply_add(limits, "memory_bytes", (double)options->memory_limit);
    reply_add(limits, "queue", options->queue);
    reply_add(limits, "json_depth", JSON_MAX_DEPTH);
    reply_add(limits, "connections", counts.most);
    reply_add(limits, "connections_of_address", counts.most_of_address);
    reply_add(limits, "streams", ROUTES_STREAMS_MAX);
    endpoints = cJSON_AddObjectToObject(json, "endpoints");
    cJSON_AddStringToObject(endpoints, "http", c->routes->http_url);
    cJSON_AddStringToObject(endpoints, "publish", c->routes->publish_url);
    if (c->routes->publish_key[0] != '\0')
        cJSON_AddStringToObject(endpoints, "publish_key", c->routes->publish_key);
    reply_json(c->reply, 200, json);
}

void routes_serve_schema(struct call *c) {
    reply_json(c->reply, 200, scene_schema());
}

void routes_serve_materials(struct call *c) {
    reply_json(c->reply, 200, scene_materials_json());
}

void routes_serve_scenes(struct call *c) {
    cJSON *json = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(json, "scenes");
    for (size_t k = 0; k < scene_builtin_count(); k++) {
        cJSON *item = cJSON_CreateObject(), *scene = scene_builtin(scene_builtin_name(k));
        const char *title = cJSON_GetStringValue(json_member(scene, "title"));
        const cJSON *dimension = json_member(scene, "dimension");
        cJSON_AddStringToObject(item, "name", scene_builtin_name(k));
        cJSON_AddStringToObject(item, "title", title != NULL ? title : "");
        if (cJSON_IsNumber(dimension))
            reply_add(item, "dimension", dimension->valuedouble);
        cJSON_AddItemToArray(list, item);
        cJSON_Delete(scene);
    }
    reply_json(c->reply, 200, json);
}

// ---- Scenes in a body -------------------------------------------------------------------------

// Adds the faults of a scene, with their pointers below `prefix` of the body.
static void faults_below(struct faults *to, const char *prefix, const struct faults *from) {
    for (size_t k = 0; k < from->count; k++) {
        const struct fault *fault = &from->items[k];
        char pointer[512];
        snprintf(pointer, sizeof pointer, "%s%.400s", prefix, fault->pointer);
        faults_add(to, pointer, fault->code, fault->expected, fault->actual, "%s", fault->detail);
    }
    to->more += from->more;
}

const char *routes_type_name(const cJSON *item) {
    return cJSON_IsString(item)   ? "string"
           : cJSON_IsNumber(item) ? "number"
           : cJSON_IsObject(item) ? "object"
           : cJSON_IsArray(item)  ? "array"
           : cJSON_IsBool(item)   ? "boolean"
                                  : "null";
}

void routes_value_fault(struct faults *faults, const char *key, const char *code,
                        const char *expected, const cJSON *value) {
    struct scene_cursor root = {0}, at = {.parent = &root, .key = key};
    scene_value_fault(faults, &at, code, expected, value);
}

// What was perhaps meant by the name of a scene that there is not: a near word, or else the first
// name that holds it ("footing").
static const char *nearest_scene(const char *name) {
    struct scene_suggestion s = {.word = name};
    for (size_t k = 0; k < scene_builtin_count(); k++)
        scene_suggest(&s, scene_builtin_name(k));
    for (size_t k = 0; s.best == NULL && strlen(name) > 2 && k < scene_builtin_count(); k++)
        if (strstr(scene_builtin_name(k), name) != NULL)
            s.best = scene_builtin_name(k);
    return s.best;
}

void routes_serve_scene(struct call *c) {
    const char *name = c->names[0], *near = nearest_scene(name);
    cJSON *scene = scene_builtin(name);
    if (scene != NULL)
        reply_json(c->reply, 200, scene);
    else if (near != NULL)
        reply_problem(c->reply, 404, NULL, "there is no built-in scene %.80s; did you mean %s?",
                      name, near);
    else
        reply_problem(c->reply, 404, NULL, "there is no built-in scene %.80s", name);
}

static cJSON *builtin_named(const char *name, struct faults *faults) {
    cJSON *scene = scene_builtin(name);
    if (scene != NULL)
        return scene;
    char *list = NULL, actual[96];
    size_t bytes;
    FILE *text = open_memstream(&list, &bytes);
    if (text != NULL) {
        fputs("one of", text);
        for (size_t k = 0; k < scene_builtin_count(); k++)
            fprintf(text, "%s %s", k > 0 ? "," : "", scene_builtin_name(k));
        fclose(text);
    }
    const char *near = nearest_scene(name);
    snprintf(actual, sizeof actual, "%.90s", name);
    if (near != NULL)
        faults_add(faults, "/scene", "unknown_scene", list, actual,
                   "there is no built-in scene %.90s; did you mean %s?", name, near);
    else
        faults_add(faults, "/scene", "unknown_scene", list, actual,
                   "there is no built-in scene %.90s", name);
    free(list);
    return NULL;
}

// {"scene": name or object, "overrides": object}, checked by bodies_check: the merged scene, new;
// NULL with faults.
cJSON *routes_merged_scene(const cJSON *body, struct faults *faults) {
    const cJSON *given = json_member(body, "scene"), *overrides = json_member(body, "overrides");
    cJSON *scene = NULL;
    if (cJSON_IsString(given))
        scene = builtin_named(given->valuestring, faults);
    else if (cJSON_IsObject(given))
        scene = cJSON_Duplicate(given, true);
    if (overrides == NULL)
        return scene;
    if (!cJSON_IsObject(overrides)) { // what bodies_check has found
        cJSON_Delete(scene);
        return NULL;
    }
    if (scene == NULL)
        return NULL;
    cJSON *merged = json_merge_patch(scene, overrides);
    cJSON_Delete(scene);
    return merged;
}

struct scene *routes_read_scene(const struct call *c, const cJSON *json, const char *prefix,
                                struct faults *faults) {
    struct faults inner = {0};
    struct scene *scene = scene_read(json, c->routes->host->memory_limit, &inner);
    faults_below(faults, prefix, &inner);
    faults_free(&inner);
    return scene;
}

bool routes_examine_scene(const struct call *c, struct scene *scene, const char *prefix,
                          struct faults *faults) {
    struct faults inner = {0};
    const bool valid = scene_examine(scene, c->routes->host->memory_limit, &inner);
    faults_below(faults, prefix, &inner);
    faults_free(&inner);
    return valid;
}

// What a run of the scene would be warned of.
static void add_warnings(cJSON *json, struct scene *scene, const struct mpm_estimate *estimate) {
    struct run_status status = {.dt = estimate->dt, .dt_limit = estimate->dt_limit};
    status.fbar = scene_config(scene)->settings.fbar.scheme != MPM_FBAR_OFF;
    run_warn_scene(&status, scene_def(scene));
    cJSON *list = cJSON_AddArrayToObject(json, "warnings");
    for (unsigned k = 0; k < status.n_warnings; k++)
        cJSON_AddItemToArray(list, cJSON_CreateString(status.warnings[k]));
}

void routes_serve_validate(struct call *c) {
    struct faults faults = {0};
    bool bare = json_member(c->body, "scene") == NULL;
    cJSON *merged = NULL;
    if (!bare) {
        bodies_check(c->route->request, c->body, &faults);
        merged = routes_merged_scene(c->body, &faults);
    }
    const char *prefix = bare ? "" : "/scene";
    struct scene *scene = NULL;
    if (bare || merged != NULL)
        scene = routes_read_scene(c, bare ? c->body : merged, prefix, &faults);
    if (scene == NULL || !routes_examine_scene(c, scene, prefix, &faults) || faults.count > 0) {
        reply_faults(c->reply, 422, &faults);
    } else {
        struct mpm_estimate estimate;
        mpm_estimate(scene_def(scene), &estimate);
        cJSON *json = cJSON_CreateObject(), *costs;
        cJSON_AddTrueToObject(json, "valid");
        costs = cJSON_AddObjectToObject(json, "estimate");
        reply_add(costs, "particles", (double)estimate.particles);
        reply_add(costs, "nodes", (double)estimate.nodes);
        reply_add(costs, "dt", estimate.dt);
        reply_add(costs, "dt_limit", estimate.dt_limit);
        reply_add(costs, "steps", (double)estimate.steps);
        reply_add(costs, "bytes", (double)estimate.bytes);
        add_warnings(json, scene, &estimate);
        reply_json(c->reply, 200, json);
    }
    scene_free(scene);
    cJSON_Delete(merged);
    faults_free(&faults);
}
