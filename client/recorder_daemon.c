// Talking to the daemon: requests about the run, the live stream, acknowledgements.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/recorder_inside.h"
#include "client/terminal.h"

const char *recorder_text(const cJSON *object, const char *key) {
    const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return text ? text : "";
}

// ---- Talking to the daemon --------------------------------------------------------------------

// A GET of /v1/runs/{id}<after>: RECORDER_GOOD with the reply of any status, or RECORDER_AWAY.
enum recorder_outcome recorder_get(struct recorder *r, const char *after, const char *accept,
                                   struct reply *out) {
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {.method = "GET", .path = path ? path : "/", .accept = accept};
    const int status = request_send(r->client->requests, &spec, out, r->why, sizeof r->why);
    free(path);
    if (status == 0 && out->status >= 500) {
        snprintf(r->why, sizeof r->why, "it answered %ld", out->status);
        request_reply_free(out);
        return RECORDER_AWAY;
    }
    return status == 0 ? RECORDER_GOOD : RECORDER_AWAY;
}

enum recorder_outcome recorder_get_json(struct recorder *r, const char *after, cJSON **out) {
    struct reply reply;
    *out = NULL;
    if (recorder_get(r, after, "application/json", &reply) != RECORDER_GOOD)
        return RECORDER_AWAY;
    if (reply.status != 200) {
        request_complain(&reply);
        request_reply_free(&reply);
        return RECORDER_LOST;
    }
    *out = cJSON_Parse(reply.body);
    request_reply_free(&reply);
    snprintf(r->why, sizeof r->why, "its answer is no JSON");
    return *out ? RECORDER_GOOD : RECORDER_AWAY;
}

// A publisher bound to all interfaces is reached where the HTTP side was.
static void resolve_endpoint(const char *url, const char *publish, char *out, size_t n) {
    static const char *const wild[] = {"tcp://0.0.0.0:", "tcp://*:", "tcp://[::]:"};
    for (size_t i = 0; i < sizeof wild / sizeof *wild; i++)
        if (strncmp(publish, wild[i], strlen(wild[i])) == 0) {
            const char *host = strstr(url, "://");
            host = host ? host + 3 : url;
            const size_t length = *host == '[' ? strcspn(host, "]") + 1 : strcspn(host, ":/");
            snprintf(out, n, "tcp://%.*s:%s", (int)length, host, publish + strlen(wild[i]));
            return;
        }
    snprintf(out, n, "%s", publish);
}

// Subscribes with the keys that the publisher calls for; NULL with a sentence in r->why.
static struct subscription *subscribe(struct recorder *r, const char *endpoint, bool encrypted) {
    struct subscribe_keys keys;
    const char *file = r->client->curve_file;
    if (encrypted && !file) {
        snprintf(r->why, sizeof r->why, "it is encrypted: --curve-file has the keys");
        return NULL;
    }
    if (encrypted && subscribe_keys_read(file, &keys, r->why, sizeof r->why) != 0)
        return NULL;
    return subscribe_open(endpoint, r->options->run, encrypted ? &keys : NULL, r->why,
                          sizeof r->why);
}

// Learns the publisher from GET /v1 and subscribes, anew where it has moved.
enum recorder_outcome recorder_connect(struct recorder *r) {
    struct reply reply;
    char endpoint[256];
    const struct request_spec spec = {.method = "GET", .path = "/v1", .accept = "application/json"};
    if (request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why) != 0)
        return RECORDER_AWAY;
    cJSON *about = reply.status == 200 ? cJSON_Parse(reply.body) : NULL;
    request_reply_free(&reply);
    const cJSON *endpoints = cJSON_GetObjectItemCaseSensitive(about, "endpoints");
    resolve_endpoint(r->client->url, recorder_text(endpoints, "publish"), endpoint,
                     sizeof endpoint);
    snprintf(r->code_version, sizeof r->code_version, "%s", recorder_text(about, "version"));
    const bool encrypted = *recorder_text(endpoints, "publish_key");
    cJSON_Delete(about);
    if (r->subscription && strcmp(endpoint, r->publish) == 0)
        return RECORDER_GOOD;
    subscribe_close(r->subscription);
    r->subscription = *endpoint ? subscribe(r, endpoint, encrypted) : NULL;
    snprintf(r->publish, sizeof r->publish, "%s", endpoint);
    if (!r->subscription) // polling over HTTP records every frame just as well
        terminal_note("no live stream (%s); fetching frames over HTTP",
                      *endpoint ? r->why : "the daemon names no publish endpoint");
    return RECORDER_GOOD;
}

// The status of the answer, or 0 when there was none.
static long put_acknowledgement(struct recorder *r, long long acked) {
    char after[80], body[64];
    struct reply reply;
    snprintf(after, sizeof after, "/recorders/%s", r->name);
    snprintf(body, sizeof body, "{\"acked\":%lld}", acked);
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {.method = "PUT", .path = path ? path : "/", .body = body};
    long status = 0;
    if (request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why) == 0) {
        status = reply.status;
        request_reply_free(&reply);
    }
    free(path);
    return status;
}

void recorder_acknowledge(struct recorder *r, uint64_t next) {
    if (r->no_recorders)
        return;
    long status = put_acknowledgement(r, (long long)next - 1); // -1: nothing yet
    // A power failure can take frames from the daemon that are safe here; it makes them again.
    if (status == 422 && !r->registered)
        status = put_acknowledgement(r, -1);
    if (status >= 200 && status < 300)
        r->registered = true;
    else if (!r->registered && status >= 400 && status < 500)
        r->no_recorders = true; // of interest only once a frame is gone
}

void recorder_unregister(struct recorder *r) {
    char after[80];
    struct reply reply;
    if (r->no_recorders)
        return;
    snprintf(after, sizeof after, "/recorders/%s", r->name);
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {
        .method = "DELETE", .path = path ? path : "/", .timeout_ms = 5000};
    if (request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why) == 0)
        request_reply_free(&reply);
    free(path);
}
