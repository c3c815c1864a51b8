// What the functions behind the routes share: routes.c calls them, routes_*.c have them.
#pragma once
#include "server/reply.h"
#include "server/routes.h"
#include "server/thin.h"

#define ROUTES_SEGMENT 256     // bytes of one segment of a path
#define ROUTES_STREAMS_MAX 128 // at a time, so that some connections are left for all else

struct call {
    struct routes *routes;
    const struct route *route;
    struct http_request *request;
    struct http_reply *reply;
    char names[2][ROUTES_SEGMENT]; // what stood for {...} in the path
    cJSON *body;                   // parsed, NULL when there is none
};

void routes_serve_action(struct call *c);
void routes_serve_all_events(struct call *c);
void routes_serve_changes(struct call *c);
void routes_serve_config(struct call *c);
void routes_serve_configure(struct call *c);
void routes_serve_create(struct call *c);
void routes_serve_delete(struct call *c);
void routes_serve_events(struct call *c);
void routes_serve_frame(struct call *c);
void routes_serve_frames(struct call *c);
void routes_serve_health(struct call *c);
void routes_serve_materials(struct call *c);
void routes_serve_metrics(struct call *c);
void routes_serve_openapi(struct call *c);
void routes_serve_page(struct call *c);
void routes_serve_probes(struct call *c);
void routes_serve_ready(struct call *c);
void routes_serve_record(struct call *c);
void routes_serve_recorders(struct call *c);
void routes_serve_run(struct call *c);
void routes_serve_run_scene(struct call *c);
void routes_serve_runs(struct call *c);
void routes_serve_scene(struct call *c);
void routes_serve_scenes(struct call *c);
void routes_serve_schema(struct call *c);
void routes_serve_service(struct call *c);
void routes_serve_stream(struct call *c);
void routes_serve_unrecord(struct call *c);
void routes_serve_validate(struct call *c);

// Counts a reply for /metrics; `route` is NULL where there was none.
void routes_tally(struct routes *routes, const struct route *route, int status, double seconds);
bool routes_is_page(const char *path);                   // of the live page, which needs no token
cJSON *routes_run_json(struct run *run);                 // the run object, new
double routes_progress(const struct run_status *status); // 0..1
// The run that the path names, retained; NULL when the reply is a 404.
struct run *routes_run_of(struct call *c);
// The recorders of a run, [{name, acked, lag_frames, lag_bytes, heard_s}], new; and what its
// journal holds.
cJSON *routes_recorders_json(struct run *run);
cJSON *routes_journal_json(struct run *run);
// Counts a stream; its state, zeroed, which the stream frees when it ends. NULL when the reply is a
// 503: too many are open, or there is no memory.
void *routes_stream_begins(struct call *c, size_t bytes);
// What of a frame is asked for in the query; false when the reply is a 400.
bool routes_thinning(struct call *c, struct thin *out);
// A whole number of the query, 0 or more, `absent` when it is not there; false when the reply is a
// 400.
bool routes_query_number(struct call *c, const char *key, uint64_t absent, uint64_t *out);
// "must be EXPECTED, got ..." of a member of the body.
void routes_value_fault(struct faults *faults, const char *key, const char *code,
                        const char *expected, const cJSON *value);
const char *routes_type_name(const cJSON *item);
// {"scene": name or object, "overrides": object}, checked by bodies_check: the merged scene, new;
// NULL with faults.
cJSON *routes_merged_scene(const cJSON *body, struct faults *faults);
// scene_read and scene_examine with this daemon's limit of memory and the pointers of faults below
// `prefix`.
struct scene *routes_read_scene(const struct call *c, const cJSON *json, const char *prefix,
                                struct faults *faults);
bool routes_examine_scene(const struct call *c, struct scene *scene, const char *prefix,
                          struct faults *faults);
