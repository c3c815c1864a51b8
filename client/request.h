// HTTP requests to the daemon, and its problem documents as lines for people.
#pragma once
#include <cjson/cJSON.h>
#include <stddef.h>

#include "client/client.h"

struct request; // a kept-alive connection

struct reply {
    long status;
    char *body; // owned; ended by a zero that `bytes` does not count
    size_t bytes;
};
void request_reply_free(struct reply *reply);

// Reads the token file, if any. NULL with the fault printed.
struct request *request_create(const char *url, const char *token_file);
void request_free(struct request *request);

struct request_spec {
    const char *method, *path;
    const char *accept; // NULL: anything
    const char *body;   // JSON text, NULL: none
    long timeout_ms;    // 0: as long as bytes keep coming
};
// 0 with the reply, whatever its status; -1 when the daemon was not reached, with a sentence in
// `why`.
int request_send(struct request *request, const struct request_spec *spec, struct reply *out,
                 char *why, size_t why_bytes);

// Whether the last request was taken and then broken off, as by a daemon that is killed: there was
// one, and it may come back.
bool request_broken_off(const struct request *request);

// A path with `id` escaped: request_path("/v1/runs/", id, "/frames"). The caller frees it.
char *request_path(const char *before, const char *id, const char *after);

// Sends and expects success: exit code CLIENT_DONE with the reply, otherwise faults are printed.
int request_expect(struct client *client, const struct request_spec *spec, struct reply *out);
// The same, with the answer parsed; *out may be NULL where it is not wanted.
int request_json(struct client *client, const char *method, const char *path, const char *body,
                 cJSON **out);
// Prints a refused reply (one `fbar: <pointer>: <message>` line a fault); returns the exit code.
int request_complain(const struct reply *reply);
