// The HTTP API (docs/api.md): a table of routes, one function each. The table also makes
// /openapi.json.
#pragma once
#include <stdatomic.h>

#include "server/guard.h"
#include "server/http.h"
#include "server/options.h"
#include "server/runs.h"

#define ROUTES_MAX 48      // routes that are counted
#define ROUTES_STATUSES 19 // statuses, the last for any other

struct routes {
    const struct options *options;
    const struct run_host *host;
    struct runs *runs;
    struct guard guard;
    char http_url[320], publish_url[320];
    char publish_key[PUBLISH_KEY]; // of the encrypted ZeroMQ socket, or ""
    struct http_server *http;
    atomic_int streams;                        // open
    atomic_ullong stream_sent, stream_skipped; // frames
    struct {
        atomic_ullong replies[ROUTES_STATUSES], microseconds;
    } tally[ROUTES_MAX + 1]; // by route; the last: what reached none
    atomic_bool ending;      // the daemon is
    atomic_bool open;        // the runs of earlier daemons are listed; until then 503
};

// What http_start calls; `routes` must outlive the server.
struct http_service routes_service(struct routes *routes);

// ---- For openapi.c ----------------------------------------------------------------------------

struct call;
struct route {
    const char *method,
        *pattern; // {name} stands for one path segment, {name}:verb for one that ends so
    void (*serve)(struct call *call);
    int action; // enum run_action of the routes that post one, else -1
    const char *summary;
    const char *request; // schema of the body, NULL = none
    bool request_needed;
    bool merge_patch; // application/merge-patch+json is taken as well
    int success;
    const char *response; // schema of the success, NULL = no body
    const char *type;     // its media types, space-separated
    // "name: what it is" of the query, "header Name: what it is", ... separated by newlines, or
    // NULL
    const char *parameters;
    const char *problems; // statuses of its own, space-separated
};
extern const struct route routes_table[];
extern const size_t routes_count;
