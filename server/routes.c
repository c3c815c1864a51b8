// The table of routes, and the way from a request to one of them.
#include <stdio.h>
#include <string.h>
#include <strings.h>

#include "server/log.h"
#include "server/routes_inside.h"

#define SEGMENTS_MAX 8

// ---- The table --------------------------------------------------------------------------------

#define JSON "application/json"
#define FRAME "application/vnd.fbard.frame"
#define THINNING                                                                                   \
    "max_particles: send every n-th particle, so that there are no more than this\n"               \
    "fields: comma-separated; send these fields only, as far as the frame has them"
#define ACTION(verb, code, text)                                                                   \
    {                                                                                              \
        "POST", "/v1/runs/{id}:" verb, routes_serve_action, RUN_DO_##code, text, "Empty", false,   \
            false, 200, "Run", JSON, NULL, "409 503 507"                                           \
    }

const struct route routes_table[] = {
    {"GET", "/", routes_serve_page, -1, "The live page", NULL, false, false, 200, "Text",
     "text/html",
     "header If-None-Match: ETag of the copy that the browser has; 304 when it is still the same",
     "304"},
    {"GET", "/page/{file}", routes_serve_page, -1, "What the live page is made of", NULL, false,
     false, 200, "Text", "text/javascript text/css image/svg+xml",
     "header If-None-Match: ETag of the copy that the browser has; 304 when it is still the same",
     "304"},
    {"GET", "/healthz", routes_serve_health, -1, "Alive", NULL, false, false, 200, "Health", JSON,
     NULL, NULL},
    {"GET", "/readyz", routes_serve_ready, -1, "Able to take a run", NULL, false, false, 200,
     "Health", JSON, NULL, "503"},
    {"GET", "/openapi.json", routes_serve_openapi, -1, "This document", NULL, false, false, 200,
     "Object", JSON, NULL, NULL},
    {"GET", "/v1", routes_serve_service, -1, "Version, limits and endpoints", NULL, false, false,
     200, "Service", JSON, NULL, NULL},
    {"GET", "/metrics", routes_serve_metrics, -1, "Counters and gauges for Prometheus", NULL, false,
     false, 200, "Text", "text/plain", NULL, NULL},
    {"GET", "/v1/schemas/scene.json", routes_serve_schema, -1, "JSON Schema of a scene", NULL,
     false, false, 200, "Object", JSON, NULL, NULL},
    {"GET", "/v1/materials", routes_serve_materials, -1, "Material models with their parameters",
     NULL, false, false, 200, "Materials", JSON, NULL, NULL},
    {"GET", "/v1/scenes", routes_serve_scenes, -1, "Built-in scenes", NULL, false, false, 200,
     "Scenes", JSON, NULL, NULL},
    {"GET", "/v1/scenes/{name}", routes_serve_scene, -1, "A built-in scene, fit to be posted back",
     NULL, false, false, 200, "Scene", JSON, NULL, NULL},
    {"POST", "/v1/scenes:validate", routes_serve_validate, -1,
     "Every fault of a scene, or its cost", "Validate", true, false, 200, "Valid", JSON, NULL,
     NULL},
    {"POST", "/v1/runs", routes_serve_create, -1, "Create a run", "Create", true, false, 201, "Run",
     JSON,
     "header Idempotency-Key: 1 to 255 visible ASCII characters; the same key with the same body "
     "creates one run, however often it is sent",
     "409 503 507"},
    {"GET", "/v1/runs", routes_serve_runs, -1, "All runs, oldest first", NULL, false, false, 200,
     "Runs", JSON,
     "state: only runs in these states, with commas between\n"
     "limit: only the newest so many; `older` counts those left out\n"
     "before: only runs that are older than this one",
     "400"},
    {"GET", "/v1/events", routes_serve_all_events, -1,
     "Server-sent events of all runs: run, gone, ready, end", NULL, false, false, 200, "Text",
     "text/event-stream", NULL, "503"},
    {"GET", "/v1/runs/{id}", routes_serve_run, -1, "A run", NULL, false, false, 200, "Run", JSON,
     NULL, NULL},
    {"DELETE", "/v1/runs/{id}", routes_serve_delete, -1, "Remove a finished run and its files",
     NULL, false, false, 204, NULL, NULL, NULL, "409 507"},
    ACTION("start", START, "Start a run that was created paused"),
    ACTION("pause", PAUSE, "Pause, with a checkpoint"),
    ACTION("resume", RESUME, "Go on"),
    {"POST", "/v1/runs/{id}:step", routes_serve_action, RUN_DO_STEP,
     "Run for a number of steps or until a time, then pause", "Step", true, false, 200, "Run", JSON,
     NULL, "409 503 507"},
    ACTION("cancel", CANCEL, "End the run where it is"),
    ACTION("checkpoint", CHECKPOINT, "Write a checkpoint now"),
    ACTION("snapshot", SNAPSHOT, "Take a frame now"),
    {"GET", "/v1/runs/{id}/config", routes_serve_config, -1, "What may change while it runs", NULL,
     false, false, 200, "Config", JSON, NULL, NULL},
    {"PATCH", "/v1/runs/{id}/config", routes_serve_configure, RUN_DO_CONFIGURE,
     "Change it, from the next step on", "Patch", true, true, 200, "Config", JSON,
     "header If-Match: ETag of the configuration that is to be changed; 412 when it is another",
     "409 412 503 507"},
    {"GET", "/v1/runs/{id}/changes", routes_serve_changes, -1,
     "All changes of the configuration, oldest first", NULL, false, false, 200, "Changes", JSON,
     "since_revision: only changes after this one", "400"},
    {"GET", "/v1/runs/{id}/scene", routes_serve_run_scene, -1, "The scene as run", NULL, false,
     false, 200, "Scene", JSON, NULL, NULL},
    {"GET", "/v1/runs/{id}/probes", routes_serve_probes, -1, "Time series of all probes", NULL,
     false, false, 200, "Probes", JSON " text/csv", "since_step: only samples after this step",
     "400 503"},
    {"GET", "/v1/runs/{id}/events", routes_serve_events, -1,
     "Server-sent events: state, config, epoch, progress, end", NULL, false, false, 200, "Text",
     "text/event-stream",
     "header Last-Event-ID: replay what came after this event (0: all); without it, from the "
     "present "
     "state on",
     "400 503"},
    {"GET", "/v1/runs/{id}/stream", routes_serve_stream, -1,
     "Frames as they come, back to back; the newest where the reader is behind", NULL, false, false,
     200, "Frame", FRAME, THINNING, "400 503"},
    {"GET", "/v1/runs/{id}/recorders", routes_serve_recorders, -1,
     "Who records the run, and how far", NULL, false, false, 200, "Recorders", JSON, NULL, NULL},
    {"PUT", "/v1/runs/{id}/recorders/{name}", routes_serve_record, -1,
     "Register a recorder, or acknowledge frames that are safe with it", "Acknowledge", true, false,
     200, "Recorder", JSON, NULL, "409 507"},
    {"DELETE", "/v1/runs/{id}/recorders/{name}", routes_serve_unrecord, -1,
     "Unregister a recorder: no frame is kept for it any more", NULL, false, false, 200,
     "Recorders", JSON, NULL, "409 507"},
    {"GET", "/v1/runs/{id}/frames", routes_serve_frames, -1, "Index of the frames", NULL, false,
     false, 200, "Frames", JSON, "since_seq: only frames after this one", "400"},
    {"GET", "/v1/runs/{id}/frames/{seq}", routes_serve_frame, -1,
     "A frame by its number, or `latest`: the bytes that were published", NULL, false, false, 200,
     "Frame", FRAME, THINNING, "400 500 503"},
};
const size_t routes_count = sizeof routes_table / sizeof *routes_table;
_Static_assert(sizeof routes_table / sizeof *routes_table <= ROUTES_MAX, "counted for /metrics");

// ---- Routing ----------------------------------------------------------------------------------

struct path {
    size_t count;
    char segments[SEGMENTS_MAX][ROUTES_SEGMENT]; // decoded
};

// 0, or the status of what is wrong.
static int path_split(const char *text, struct path *out) {
    out->count = 0;
    if (*text != '/')
        return 404;
    for (text++;; text++) {
        size_t n = strcspn(text, "/");
        if (out->count == SEGMENTS_MAX || n >= ROUTES_SEGMENT)
            return 404;
        char *segment = out->segments[out->count++];
        memcpy(segment, text, n);
        segment[n] = '\0';
        if (!http_decode(segment))
            return 400;
        text += n;
        if (*text == '\0')
            return 0;
    }
}

// One segment against one of the pattern; {name} and {name}:verb put what they stand for into
// `name`.
static bool segment_matches(const char *pattern, size_t n, const char *segment, char *name,
                            bool *named) {
    if (pattern[0] != '{')
        return strlen(segment) == n && memcmp(segment, pattern, n) == 0;
    const char *close = memchr(pattern, '}', n);
    size_t tail = n - (size_t)(close + 1 - pattern), length = strlen(segment);
    if (length <= tail || memcmp(segment + length - tail, close + 1, tail) != 0)
        return false;
    if (tail == 0 && strchr(segment, ':') != NULL)
        return false; // an action that there is not
    memcpy(name, segment, length - tail);
    name[length - tail] = '\0';
    *named = true;
    return true;
}

static bool pattern_matches(const char *pattern, const struct path *path, struct call *call) {
    size_t names = 0;
    for (size_t k = 0; k < path->count; k++) {
        bool named = false;
        if (*pattern != '/')
            return false;
        pattern++;
        size_t n = strcspn(pattern, "/");
        if (names == 2 ||
            !segment_matches(pattern, n, path->segments[k], call->names[names], &named))
            return false;
        names += named;
        pattern += n;
    }
    return *pattern == '\0';
}

// Fills call->route. Else the reply is a 404 or a 405.
static bool route(struct call *c) {
    struct path path;
    char allow[64] = "";
    const char *method = http_method(c->request);
    bool head = strcmp(method, "HEAD") == 0;
    int wrong = path_split(http_path(c->request), &path);
    if (wrong != 0) {
        reply_problem(c->reply, wrong, NULL,
                      wrong == 404 ? "there is nothing at this path"
                                   : "the path has a %% without two hexadecimal digits, or %%00");
        return false;
    }
    for (size_t k = 0; k < routes_count; k++) {
        const struct route *candidate = &routes_table[k];
        if (!pattern_matches(candidate->pattern, &path, c))
            continue;
        if (strcmp(candidate->method, head ? "GET" : method) == 0) {
            c->route = candidate;
            return true;
        }
        size_t n = strlen(allow);
        snprintf(allow + n, sizeof allow - n, "%s%s%s", n > 0 ? ", " : "", candidate->method,
                 strcmp(candidate->method, "GET") == 0 ? ", HEAD" : "");
    }
    if (allow[0] == '\0') {
        reply_problem(c->reply, 404, NULL, "there is nothing at %.200s", http_path(c->request));
        return false;
    }
    reply_problem(c->reply, 405, NULL, "%.16s is not possible here; possible: %s", method, allow);
    http_reply_header(c->reply, "Allow", "%s", allow);
    return false;
}

// The names of the query parameters that a route knows, one after the other: "" at the end.
static void next_parameter(const char **at, char *name, size_t bytes) {
    name[0] = '\0';
    while (*at != NULL && name[0] == '\0') {
        const char *line = *at, *colon = strstr(line, ": "), *end = strchr(line, '\n');
        if (strncmp(line, "header ", 7) != 0 && colon != NULL)
            snprintf(name, bytes, "%.*s", (int)(colon - line), line);
        *at = end != NULL ? end + 1 : NULL;
    }
}

// Whether the query has nothing but parameters that the route declares, each once. Else the reply
// is a 400.
static bool query_known(struct call *c) {
    char key[64], name[64], list[128] = "";
    bool sound = true, twice = false, known = true;
    unsigned seen = 0;
    for (size_t at = 0; sound && known && !twice &&
                        http_query_next(c->request, &at, key, sizeof key, NULL, 0, &sound);) {
        const char *line = c->route->parameters;
        unsigned bit = 1;
        known = false;
        for (next_parameter(&line, name, sizeof name); name[0] != '\0' && !known; bit <<= 1) {
            known = strcmp(name, key) == 0;
            twice = known && (seen & bit) != 0;
            seen |= known ? bit : 0;
            next_parameter(&line, name, sizeof name);
        }
    }
    if (sound && known && !twice)
        return true;
    const char *line = c->route->parameters;
    for (next_parameter(&line, name, sizeof name); name[0] != '\0';
         next_parameter(&line, name, sizeof name)) {
        size_t n = strlen(list);
        snprintf(list + n, sizeof list - n, "%s%s", n > 0 ? ", " : "", name);
    }
    if (twice)
        reply_problem(c->reply, 400, NULL, "the query has %.40s twice", key);
    else if (!sound)
        reply_problem(
            c->reply, 400, NULL,
            "the query has a name that is too long, or a %% without two hexadecimal digits, "
            "or %%00");
    else
        reply_problem(c->reply, 400, NULL, "there is no query parameter \"%.40s\" here; %s%s", key,
                      list[0] != '\0' ? "there are: " : "there is none", list);
    return false;
}

static const char *guard_detail(int status) {
    switch (status) {
    case 401:
        return "a bearer token is needed: Authorization: Bearer TOKEN";
    case 403:
        return "the Origin header names another site";
    default:
        return "the Host header does not name this server";
    }
}

static bool admit(void *context, struct http_request *request, struct http_reply *reply) {
    struct routes *routes = context;
    struct call call = {.routes = routes, .request = request, .reply = reply};
    int status = guard_verdict(&routes->guard, http_host(request), http_header(request, "Origin"),
                               http_header(request, "Authorization"));
    if (status != 0 && (status != 401 || !routes_is_page(http_path(request)))) {
        reply_problem(reply, status, NULL, "%s", guard_detail(status));
    } else if (route(&call) && query_known(&call)) {
        // The page tells nothing about this daemon, and is where a browser is asked for the token.
        if (atomic_load(&routes->open) || call.route->serve == routes_serve_health ||
            call.route->serve == routes_serve_page)
            return true;
        reply_problem(reply, 503, NULL, "the daemon is reading its earlier runs");
    }
    routes_tally(routes, call.route, reply->status, 0);
    log_line(LOG_LEVEL_DEBUG, "refused", "method=%s path=\"%.200s\" status=%d",
             http_method(request), http_path(request), reply->status);
    return false;
}

static void malformed(void *context, int status, const char *why, struct http_reply *reply) {
    reply_problem(reply, status, NULL, "%s", why);
    routes_tally(context, NULL, status, 0);
}

static void too_large(void *context, struct http_reply *reply) {
    struct routes *routes = context;
    reply_problem(reply, 413, NULL, "the body is over the limit of %zu bytes",
                  routes->options->max_body);
    routes_tally(routes, NULL, reply->status, 0);
}

static void too_many(void *context, const struct http_counts *counts, struct http_reply *reply) {
    reply_problem(reply, 503, NULL,
                  "there are %u connections already, or %u from your address, and all are busy",
                  counts->most, counts->most_of_address);
    routes_tally(context, NULL, reply->status, 0);
}

// Media type without its parameters.
static bool type_is(const char *header, const char *type) {
    header += strspn(header, " \t");
    size_t n = strcspn(header, "; \t");
    return n == strlen(type) && strncasecmp(header, type, n) == 0;
}

// Parses the body where the route takes one. Else the reply is a 400 or a 415.
static bool parse_body(struct call *c) {
    size_t bytes;
    const char *text = http_body(c->request, &bytes);
    const char *type = http_header(c->request, "Content-Type");
    if (c->route->request == NULL || (bytes == 0 && !c->route->request_needed))
        return true;
    if (bytes > 0 && type != NULL && !type_is(type, "application/json") &&
        !(c->route->merge_patch && type_is(type, "application/merge-patch+json"))) {
        reply_problem(c->reply, 415, NULL, "Content-Type must be application/json%s, got %.80s%s",
                      c->route->merge_patch ? " or application/merge-patch+json" : "", type,
                      type_is(type, "application/x-www-form-urlencoded")
                          ? "; with curl, use --json in the place of -d"
                          : "");
        return false;
    }
    const char *coding = http_header(c->request, "Content-Encoding");
    if (bytes > 0 && coding != NULL && strcasecmp(coding, "identity") != 0) {
        reply_problem(c->reply, 415, NULL, "Content-Encoding must be identity, got %.80s", coding);
        return false;
    }
    struct faults faults = {0};
    if (bytes == 0 && c->route->action == RUN_DO_STEP)
        c->body = cJSON_CreateObject(); // which then lacks what it needs: 422
    else
        c->body = json_parse(text, bytes, &faults);
    if (c->body == NULL) {
        reply_faults(c->reply, 400, &faults);
    } else if (!cJSON_IsObject(c->body)) {
        faults_add(&faults, "", "type", "object", routes_type_name(c->body), "must be an object");
        reply_faults(c->reply, 422, &faults);
        cJSON_Delete(c->body);
        c->body = NULL;
    }
    faults_free(&faults);
    return c->body != NULL;
}

static void serve(void *context, struct http_request *request, struct http_reply *reply) {
    struct call call = {.routes = context, .request = request, .reply = reply};
    double began = run_clock();
    if (!route(&call))
        return;
    if (parse_body(&call))
        call.route->serve(&call);
    cJSON_Delete(call.body);
    double seconds = run_clock() - began;
    routes_tally(context, call.route, reply->status, seconds);
    log_line(LOG_LEVEL_DEBUG, "request", "method=%s path=\"%.200s\" status=%d ms=%.3f",
             http_method(request), http_path(request), reply->status, 1e3 * seconds);
}

struct http_service routes_service(struct routes *routes) {
    return (struct http_service){.context = routes,
                                 .max_body = routes->options->max_body,
                                 .admit = admit,
                                 .serve = serve,
                                 .malformed = malformed,
                                 .too_large = too_large,
                                 .too_many = too_many};
}
