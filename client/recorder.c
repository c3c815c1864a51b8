// The recording loop. What it promises and why it holds is in proto/README.md ("Recording"):
//   1. a frame is appended to FILE.h5.log in the order of seq, without gaps, after its digest was
//   checked;
//   2. only what fdatasync has confirmed is acknowledged;
//   3. FILE.h5 is built from the log and renamed into place; then the log goes.
// Killed at any instant, the next call reads the log, cuts a torn tail and asks for what is
// missing.
#include "client/recorder.h"

#include <cjson/cJSON.h>
#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <xxhash.h>

#include "client/assemble.h"
#include "client/framelog.h"
#include "client/interrupt.h"
#include "client/progress.h"
#include "client/request.h"
#include "client/store.h"
#include "client/subscribe.h"
#include "client/terminal.h"

#define LOG_FORMAT "fbard-recording-log-1"
// Silence after which the run is asked over HTTP whether anything was missed.
#define POLL_S 0.5
// The index of frames is long: a run that stands still is asked for it only this often.
#define INDEX_S 5.0
// Durability is confirmed whenever the stream pauses, and at the latest after this much.
#define SYNC_S 1.0
#define SYNC_BYTES (64u << 20)
#define FETCH_TRIES 3
// A run that is cancelled by Ctrl-C is given this long to publish its last frame.
#define CANCEL_S 15.0

// How a step of the recording went; CODE values are final and printed.
enum outcome { GOOD, AWAY, OVER, LOST, DISK };

struct recorder {
    struct client *client;
    const struct recorder_options *options;
    struct recorder_result *result;
    struct framelog *log;
    struct subscription *subscription;
    char *log_name;
    char created[64], code_version[64], publish[256], name[40];
    uint64_t *digests; // of the frames in the log, by seq
    uint64_t next;     // seq of the next frame
    size_t capacity;
    uint64_t synced_frames, synced_bytes;
    double synced_at, heard_at, shown_at, indexed_at, polled_step;
    bool has_scene, complete, ended, registered, no_recorders;
    char why[512];
};

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static const char *text_of(const cJSON *object, const char *key) {
    const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return text ? text : "";
}

static enum outcome disk(struct recorder *r) {
    terminal_error("%s", r->why);
    return DISK;
}

// ---- Talking to the daemon --------------------------------------------------------------------

// A GET of /v1/runs/{id}<after>: GOOD with the reply of any status, or AWAY.
static enum outcome get(struct recorder *r, const char *after, const char *accept,
                        struct reply *out) {
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {.method = "GET", .path = path ? path : "/", .accept = accept};
    const int status = request_send(r->client->requests, &spec, out, r->why, sizeof r->why);
    free(path);
    if (status == 0 && out->status >= 500) {
        snprintf(r->why, sizeof r->why, "it answered %ld", out->status);
        request_reply_free(out);
        return AWAY;
    }
    return status == 0 ? GOOD : AWAY;
}

static enum outcome get_json(struct recorder *r, const char *after, cJSON **out) {
    struct reply reply;
    *out = NULL;
    if (get(r, after, "application/json", &reply) != GOOD)
        return AWAY;
    if (reply.status != 200) {
        request_complain(&reply);
        request_reply_free(&reply);
        return LOST;
    }
    *out = cJSON_Parse(reply.body);
    request_reply_free(&reply);
    snprintf(r->why, sizeof r->why, "its answer is no JSON");
    return *out ? GOOD : AWAY;
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

// Learns the publisher from GET /v1 and subscribes, anew where it has moved.
static enum outcome connect_stream(struct recorder *r) {
    struct reply reply;
    char endpoint[256];
    const struct request_spec spec = {.method = "GET", .path = "/v1", .accept = "application/json"};
    if (request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why) != 0)
        return AWAY;
    cJSON *about = reply.status == 200 ? cJSON_Parse(reply.body) : NULL;
    request_reply_free(&reply);
    const cJSON *endpoints = cJSON_GetObjectItemCaseSensitive(about, "endpoints");
    resolve_endpoint(r->client->url, text_of(endpoints, "publish"), endpoint, sizeof endpoint);
    snprintf(r->code_version, sizeof r->code_version, "%s", text_of(about, "version"));
    cJSON_Delete(about);
    if (r->subscription && strcmp(endpoint, r->publish) == 0)
        return GOOD;
    subscribe_close(r->subscription);
    r->subscription =
        *endpoint ? subscribe_open(endpoint, r->options->run, r->why, sizeof r->why) : NULL;
    snprintf(r->publish, sizeof r->publish, "%s", endpoint);
    if (!r->subscription) // polling over HTTP records every frame just as well
        terminal_note("no live stream (%s); fetching frames over HTTP",
                      *endpoint ? r->why : "the daemon names no publish endpoint");
    return GOOD;
}

// Registers, or tells the daemon that all before `next` is durable here.
static void acknowledge(struct recorder *r, uint64_t next) {
    char after[80], body[64];
    struct reply reply;
    if (r->no_recorders)
        return;
    snprintf(after, sizeof after, "/recorders/%s", r->name);
    snprintf(body, sizeof body, "{\"acked\":%lld}", (long long)next - 1); // -1: nothing yet
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {.method = "PUT", .path = path ? path : "/", .body = body};
    if (request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why) == 0) {
        if (reply.status >= 200 && reply.status < 300) {
            r->registered = true;
        } else if (!r->registered && reply.status < 500) {
            r->no_recorders = true; // of interest only once a frame is gone
        }
        request_reply_free(&reply);
    }
    free(path);
}

static void unregister(struct recorder *r) {
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

// ---- Frames into the log ----------------------------------------------------------------------

static enum outcome remember(struct recorder *r, const struct frameinfo *info) {
    if (r->next == r->capacity) {
        const size_t capacity = r->capacity ? 2 * r->capacity : 256;
        uint64_t *grown = realloc(r->digests, capacity * sizeof *grown);
        if (!grown) {
            snprintf(r->why, sizeof r->why, "out of memory");
            return disk(r);
        }
        r->digests = grown;
        r->capacity = capacity;
    }
    r->digests[r->next++] = info->digest;
    r->ended = r->ended || info->end;
    return GOOD;
}

static enum outcome append(struct recorder *r, enum framelog_kind kind, const void *payload,
                           size_t bytes) {
    return framelog_append(r->log, kind, payload, bytes, r->why, sizeof r->why) == 0 ? GOOD
                                                                                     : disk(r);
}

// A frame that was checked: the next one is kept, an earlier one must be the same again.
static enum outcome take(struct recorder *r, const struct frameinfo *info, const void *frame) {
    if (info->seq < r->next) {
        if (info->digest == r->digests[info->seq])
            return GOOD;
        terminal_error("frame %llu of %s was published twice with different contents",
                       (unsigned long long)info->seq, r->options->run);
        return LOST;
    }
    const enum outcome outcome = append(r, FRAMELOG_FRAME, frame, info->total_bytes);
    return outcome == GOOD ? remember(r, info) : outcome;
}

// The next frame over HTTP. OVER: the daemon does not have it (yet).
static enum outcome fetch_next(struct recorder *r) {
    struct frameinfo info;
    struct reply reply;
    char after[64];
    snprintf(after, sizeof after, "/frames/%llu", (unsigned long long)r->next);
    for (int attempt = 0; attempt < FETCH_TRIES; attempt++) {
        enum outcome outcome = get(r, after, "application/vnd.fbard.frame", &reply);
        if (outcome != GOOD)
            return outcome;
        if (reply.status != 200) {
            request_reply_free(&reply);
            return OVER;
        }
        if (frameinfo_read(reply.body, reply.bytes, &info, r->why, sizeof r->why) == 0 &&
            info.total_bytes == reply.bytes && info.seq == r->next &&
            strcmp(info.run, r->options->run) == 0) {
            outcome = take(r, &info, reply.body);
            request_reply_free(&reply);
            r->result->repaired++;
            return outcome;
        }
        request_reply_free(&reply);
    }
    terminal_error("frame %llu of %s is damaged at the daemon: it %s", (unsigned long long)r->next,
                   r->options->run, r->why);
    return LOST;
}

// Everything before `until` that is not here yet.
static enum outcome fetch_until(struct recorder *r, uint64_t until) {
    while (r->next < until && !r->ended) {
        const enum outcome outcome = fetch_next(r);
        if (outcome == OVER) {
            terminal_error("frame %llu of %s is gone from the daemon%s; the recording cannot be "
                           "completed",
                           (unsigned long long)r->next, r->options->run,
                           r->no_recorders ? ", which keeps no frames for recorders" : "");
            return LOST;
        }
        if (outcome != GOOD)
            return outcome;
    }
    return GOOD;
}

// One message of the live stream. A damaged or foreign one is passed over: polling finds the gap.
static enum outcome take_message(struct recorder *r, const void *body, size_t bytes) {
    struct frameinfo info;
    if (frameinfo_read(body, bytes, &info, r->why, sizeof r->why) != 0 ||
        info.total_bytes != bytes || strcmp(info.run, r->options->run) != 0) {
        terminal_note("a frame on the live stream %s; fetching it over HTTP", r->why);
        r->heard_at = 0; // poll at once
        return GOOD;
    }
    if (info.seq > r->next) {
        const enum outcome outcome = fetch_until(r, info.seq);
        if (outcome != GOOD)
            return outcome;
    }
    return r->ended && info.seq >= r->next ? GOOD : take(r, &info, body);
}

// Asks over HTTP what the live stream may have lost. OVER: the run has ended and every frame is
// here.
static enum outcome poll_run(struct recorder *r) {
    cJSON *run, *index;
    enum outcome outcome = get_json(r, "", &run);
    if (outcome != GOOD)
        return outcome;
    const bool over = progress_over(run);
    const cJSON *step = cJSON_GetObjectItemCaseSensitive(run, "step");
    const double at = cJSON_IsNumber(step) ? step->valuedouble : -1;
    // A run that stands still has nothing new; but one that waits may wait for us.
    const bool quiet = !over && at == r->polled_step && now() - r->indexed_at < INDEX_S &&
                       strcmp(progress_state(run), "waiting") != 0;
    r->polled_step = at;
    if (strcmp(text_of(run, "created"), r->created) != 0) {
        terminal_error("%s is another run than the one in %s", r->options->run, r->log_name);
        cJSON_Delete(run);
        return LOST;
    }
    cJSON_Delete(run);
    if (quiet && r->heard_at > 0)
        return GOOD;
    r->indexed_at = now();
    // The index is asked after the state, so nothing can come after it when the run is over.
    outcome = get_json(r, "/frames", &index);
    if (outcome != GOOD)
        return outcome;
    uint64_t until = 0;
    const cJSON *frame;
    cJSON_ArrayForEach(frame, cJSON_GetObjectItemCaseSensitive(index, "frames")) {
        const cJSON *seq = cJSON_GetObjectItemCaseSensitive(frame, "seq");
        if (cJSON_IsNumber(seq) && (uint64_t)seq->valuedouble + 1 > until)
            until = (uint64_t)seq->valuedouble + 1;
    }
    cJSON_Delete(index);
    outcome = fetch_until(r, until);
    return outcome == GOOD && (r->ended || over) ? OVER : outcome;
}

static enum outcome make_durable(struct recorder *r) {
    if (framelog_sync(r->log, r->why, sizeof r->why) != 0)
        return disk(r);
    r->synced_at = now();
    r->synced_bytes = framelog_bytes(r->log);
    if (r->synced_frames != r->next) {
        r->synced_frames = r->next;
        acknowledge(r, r->next);
    }
    return GOOD;
}

// ---- The log at the start ---------------------------------------------------------------------

// One recorder a file: the same name when the same command is started again.
static void name_recorder(struct recorder *r) {
    char folder[PATH_MAX], host[256] = "";
    char *real = realpath(r->options->file, NULL), *whole = NULL;
    gethostname(host, sizeof host - 1);
    if (!getcwd(folder, sizeof folder))
        folder[0] = '\0';
    if (asprintf(&whole, "%s:%s/%s", host, real ? "" : folder, real ? real : r->options->file) < 0)
        whole = NULL;
    snprintf(r->name, sizeof r->name, "fbar-%016llx",
             (unsigned long long)(whole ? XXH3_64bits(whole, strlen(whole)) : 0));
    free(whole);
    free(real);
}

static enum outcome start_log(struct recorder *r) {
    name_recorder(r);
    cJSON *head = cJSON_CreateObject();
    cJSON_AddStringToObject(head, "format", LOG_FORMAT);
    cJSON_AddStringToObject(head, "run", r->options->run);
    cJSON_AddStringToObject(head, "created", r->created);
    cJSON_AddStringToObject(head, "code_version", r->code_version);
    cJSON_AddStringToObject(head, "recorder", r->name);
    char *text = cJSON_PrintUnformatted(head);
    cJSON_Delete(head);
    const enum outcome outcome =
        append(r, FRAMELOG_RUN, text ? text : "{}", text ? strlen(text) : 2);
    free(text);
    return outcome;
}

static enum outcome resume_head(struct recorder *r, const struct framelog_record *record) {
    cJSON *head = cJSON_ParseWithLength(record->payload, record->bytes);
    enum outcome outcome = GOOD;
    if (strcmp(text_of(head, "format"), LOG_FORMAT) != 0) {
        terminal_error("%s is no log of this version of fbar", r->log_name);
        outcome = DISK;
    } else if (strcmp(text_of(head, "run"), r->options->run) != 0) {
        terminal_error("%s holds a recording of run %s; choose another -o", r->log_name,
                       text_of(head, "run"));
        outcome = DISK;
    }
    snprintf(r->created, sizeof r->created, "%s", text_of(head, "created"));
    snprintf(r->name, sizeof r->name, "%s", text_of(head, "recorder"));
    cJSON_Delete(head);
    return outcome;
}

// Reads a log that a former recording left. *empty: there is nothing in it.
static enum outcome resume_log(struct recorder *r, bool *empty) {
    struct framelog_record record;
    struct frameinfo info;
    uint64_t cut = 0;
    int got;
    *empty = true;
    while ((got = framelog_read(r->log, &record, &cut, r->why, sizeof r->why)) == 1) {
        enum outcome outcome = GOOD;
        if (*empty && record.kind != FRAMELOG_RUN) {
            snprintf(r->why, sizeof r->why, "%s is no log of fbar", r->log_name);
            return disk(r);
        }
        *empty = false;
        switch (record.kind) {
        case FRAMELOG_RUN:
            outcome = resume_head(r, &record);
            break;
        case FRAMELOG_SCENE:
            r->has_scene = true;
            break;
        case FRAMELOG_COMPLETE:
            r->complete = true;
            break;
        case FRAMELOG_FRAME:
            if (frameinfo_read(record.payload, record.bytes, &info, r->why, sizeof r->why) != 0 ||
                info.seq != r->next) {
                snprintf(r->why, sizeof r->why, "%s: the frames in it are not in order",
                         r->log_name);
                return disk(r);
            }
            outcome = remember(r, &info);
            break;
        case FRAMELOG_PROBES:
        case FRAMELOG_CHANGES:
            break;
        }
        if (outcome != GOOD)
            return outcome;
    }
    if (got < 0)
        return disk(r);
    if (cut > 0)
        terminal_note("%s: cut %llu bytes of an unfinished record", r->log_name,
                      (unsigned long long)cut);
    return GOOD;
}

// ---- The end ----------------------------------------------------------------------------------

static enum outcome append_texts(struct recorder *r) {
    struct reply reply;
    enum outcome outcome;
    if (!r->has_scene) {
        if ((outcome = get(r, "/scene", "application/json", &reply)) != GOOD)
            return outcome;
        if (reply.status == 200)
            outcome = append(r, FRAMELOG_SCENE, reply.body, reply.bytes);
        r->has_scene = true;
        request_reply_free(&reply);
        if (outcome != GOOD)
            return outcome;
    }
    if ((outcome = get(r, "/probes", "text/csv", &reply)) != GOOD)
        return outcome;
    if (reply.status == 200)
        outcome = append(r, FRAMELOG_PROBES, reply.body, reply.bytes);
    request_reply_free(&reply);
    return outcome;
}

// The parameter changes: member "changes" of the run object, where the daemon tells them.
static enum outcome append_changes(struct recorder *r) {
    cJSON *run;
    enum outcome outcome = get_json(r, "", &run);
    const cJSON *changes = cJSON_GetObjectItemCaseSensitive(run, "changes");
    if (outcome == GOOD && cJSON_IsArray(changes)) {
        char *text = cJSON_PrintUnformatted(changes);
        if (text)
            outcome = append(r, FRAMELOG_CHANGES, text, strlen(text));
        free(text);
    }
    cJSON_Delete(run);
    return outcome;
}

// Every frame is in the log. The rest of it is asked once the daemon calls the run over, so that it
// does not depend on when we ask.
static enum outcome complete_log(struct recorder *r) {
    const double deadline = now() + 10;
    for (;;) {
        cJSON *run;
        const enum outcome outcome = get_json(r, "", &run);
        const bool over = progress_over(run);
        if (over && r->options->progress)
            progress_show(run);
        cJSON_Delete(run);
        if (outcome != GOOD)
            return outcome;
        if (over || now() > deadline)
            break;
        usleep(20000);
    }
    enum outcome outcome = append_texts(r);
    if (outcome == GOOD)
        outcome = append_changes(r);
    if (outcome == GOOD)
        outcome = make_durable(r);
    if (outcome == GOOD)
        outcome = append(r, FRAMELOG_COMPLETE, "", 0);
    if (outcome == GOOD)
        outcome = make_durable(r);
    r->complete = outcome == GOOD;
    return outcome;
}

// FILE.h5 from the log; the log goes when the file is complete.
static enum outcome build(struct recorder *r) {
    struct assemble_result built;
    if (assemble(r->log, r->options->file, r->options->compress, false, &built, r->why,
                 sizeof r->why) != 0) {
        terminal_error("%s", r->why);
        terminal_note("nothing is lost: make room, then repeat the command, or `fbar recover %s`",
                      r->options->file);
        return DISK;
    }
    r->result->n_frames = built.n_frames;
    r->result->bytes = built.bytes;
    r->result->complete = built.complete;
    if (built.complete && unlink(r->log_name) != 0) {
        snprintf(r->why, sizeof r->why, "%s: %s", r->log_name, strerror(errno));
        return disk(r);
    }
    return GOOD;
}

// ---- The loop ---------------------------------------------------------------------------------

static void show(struct recorder *r) {
    cJSON *run;
    if (!r->options->progress || now() - r->shown_at < progress_interval())
        return;
    r->shown_at = now();
    if (get_json(r, "", &run) == GOOD)
        progress_show(run);
    cJSON_Delete(run);
}

// After AWAY: GOOD once the daemon is back, or on a signal; AWAY when patience is over.
static enum outcome wait_for_daemon(struct recorder *r) {
    const double deadline = now() + r->options->patience_s;
    const int interrupts = interrupt_count();
    terminal_note("the daemon at %s is away (%s); waiting up to %.0f s", r->client->url, r->why,
                  r->options->patience_s);
    while (now() < deadline) {
        usleep(200000);
        if (interrupt_count() > interrupts)
            return GOOD;
        if (connect_stream(r) == GOOD) {
            terminal_note("the daemon is back");
            acknowledge(r, r->synced_frames);
            r->heard_at = 0; // poll at once
            return GOOD;
        }
    }
    return AWAY;
}

// The first Ctrl-C, passed on as `fbar run` wants it. GOOD: go on, until the run has ended.
static enum outcome pass_on_interrupt(struct recorder *r, double *deadline) {
    struct reply reply;
    char after[16];
    const char *action = r->options->on_interrupt;
    if (!action || interrupt_count() > 1)
        return OVER;
    snprintf(after, sizeof after, ":%s", action);
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {
        .method = "POST", .path = path ? path : "/", .timeout_ms = 10000};
    const int status = request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why);
    free(path);
    if (status != 0)
        return OVER;
    request_reply_free(&reply);
    *deadline = now() + CANCEL_S;
    if (strcmp(action, "pause") == 0) {
        const enum outcome outcome = poll_run(r);
        return outcome == GOOD ? OVER : outcome;
    }
    return GOOD;
}

// One turn: a message, or what silence asks for.
static enum outcome turn(struct recorder *r) {
    const void *body;
    size_t bytes;
    enum outcome outcome = GOOD;
    enum subscribe_kind kind = SUBSCRIBE_NOTHING;
    const bool unsynced = r->synced_frames != r->next;
    if (r->subscription)
        kind = subscribe_receive(r->subscription, unsynced ? 5 : 100, &body, &bytes);
    else
        usleep(100000);
    if (kind == SUBSCRIBE_FRAME) {
        r->heard_at = now();
        outcome = take_message(r, body, bytes);
    } else if (kind == SUBSCRIBE_ERROR) {
        terminal_note("the live stream broke; fetching frames over HTTP");
        subscribe_close(r->subscription);
        r->subscription = NULL;
    } else if (now() - r->heard_at > POLL_S) {
        outcome = poll_run(r);
        r->heard_at = now();
    }
    const bool pause = kind == SUBSCRIBE_NOTHING;
    if ((outcome == GOOD || outcome == OVER) && r->synced_frames != r->next &&
        (pause || now() - r->synced_at > SYNC_S ||
         framelog_bytes(r->log) - r->synced_bytes > SYNC_BYTES)) {
        const enum outcome durable = make_durable(r);
        if (durable != GOOD)
            return durable;
    }
    return outcome == GOOD && r->ended ? OVER : outcome;
}

// Until every frame is in the log: OVER; AWAY, LOST or DISK otherwise. GOOD: interrupted before.
static enum outcome follow(struct recorder *r) {
    int interrupts_seen = 0;
    double deadline = INFINITY;
    for (;;) {
        if (interrupt_count() > interrupts_seen) {
            interrupts_seen = interrupt_count();
            const enum outcome outcome = pass_on_interrupt(r, &deadline);
            if (outcome != GOOD)
                return outcome == OVER && !r->ended ? GOOD : outcome;
        }
        if (now() > deadline)
            return GOOD;
        enum outcome outcome = turn(r);
        if (outcome == AWAY)
            outcome = wait_for_daemon(r);
        else if (outcome == GOOD)
            show(r);
        if (outcome != GOOD)
            return outcome;
    }
}

static int exit_code(enum outcome outcome) {
    switch (outcome) {
    case GOOD:
    case OVER:
        return CLIENT_DONE;
    case AWAY:
        return CLIENT_UNREACHABLE;
    case LOST:
    case DISK:
        return CLIENT_IO;
    }
    return CLIENT_IO;
}

int recorder_check_file(const char *file, const char *run) {
    char why[512];
    bool foreign;
    struct store_file *h5 = store_open(file, &foreign, why, sizeof why);
    if (!h5) {
        if (access(file, F_OK) != 0)
            return CLIENT_DONE;
        terminal_error("%s; choose another -o, or move it away", why);
        return CLIENT_IO;
    }
    int code = CLIENT_DONE;
    if (!run || strcmp(store_contents(h5)->run, run) != 0) {
        terminal_error("%s holds the run %s; choose another -o, or move it away", file,
                       store_contents(h5)->run);
        code = CLIENT_IO;
    }
    store_close(h5);
    return code;
}

// Whether FILE.h5 already is the whole recording of this run, as far as the daemon can tell.
static int already_complete(struct recorder *r, bool *complete) {
    char why[512];
    bool foreign;
    *complete = false;
    const int code = recorder_check_file(r->options->file, r->options->run);
    if (code != CLIENT_DONE)
        return code;
    struct store_file *h5 = store_open(r->options->file, &foreign, why, sizeof why);
    if (!h5)
        return CLIENT_DONE;
    const struct store_contents *c = store_contents(h5);
    *complete = c->complete && access(r->log_name, F_OK) != 0;
    r->result->n_frames = c->n_frames;
    int result = CLIENT_DONE;
    if (*complete &&
        c->n_frames > 0) { // an id that was used again for another run has other frames
        const char *kept = r->options->run;
        struct reply reply;
        char after[64];
        snprintf(after, sizeof after, "/frames/%llu", (unsigned long long)c->seq[c->n_frames - 1]);
        char *path = request_path("/v1/runs/", kept, after);
        const struct request_spec spec = {.method = "GET", .path = path ? path : "/"};
        struct frameinfo info;
        if (request_send(r->client->requests, &spec, &reply, why, sizeof why) == 0) {
            if (reply.status == 200 &&
                frameinfo_read(reply.body, reply.bytes, &info, why, sizeof why) == 0 &&
                info.digest != c->digest[c->n_frames - 1]) {
                terminal_error("%s holds an earlier run of the name %s; choose another -o, or move "
                               "it away",
                               r->options->file, kept);
                result = CLIENT_IO;
            }
            request_reply_free(&reply);
        }
        free(path);
    }
    store_close(h5);
    return result;
}

// Opens the log and the stream and registers. GOOD, or how it ended.
static enum outcome start(struct recorder *r) {
    bool empty = true;
    cJSON *run;
    r->log = framelog_open(r->log_name, false, r->why, sizeof r->why);
    if (!r->log && errno != ENOENT)
        return disk(r);
    if (r->log) {
        const enum outcome outcome = resume_log(r, &empty);
        if (outcome != GOOD || r->complete)
            return outcome;
    }
    enum outcome outcome = connect_stream(r);
    if (outcome == GOOD)
        outcome = get_json(r, "", &run);
    if (outcome != GOOD) {
        if (outcome == AWAY)
            terminal_error("cannot reach the daemon at %s: %s", r->client->url, r->why);
        return outcome;
    }
    char created[64];
    snprintf(created, sizeof created, "%s", text_of(run, "created"));
    cJSON_Delete(run);
    if (!empty && strcmp(created, r->created) != 0) {
        terminal_error("%s holds an earlier run of the name %s; choose another -o", r->log_name,
                       r->options->run);
        return DISK;
    }
    snprintf(r->created, sizeof r->created, "%s", created);
    if (!r->log) {
        r->log = framelog_open(r->log_name, true, r->why, sizeof r->why);
        uint64_t cut;
        struct framelog_record none;
        if (!r->log || framelog_read(r->log, &none, &cut, r->why, sizeof r->why) < 0)
            return disk(r);
    }
    if (empty)
        outcome = start_log(r);
    if (outcome == GOOD && framelog_sync(r->log, r->why, sizeof r->why) != 0)
        return disk(r);
    r->synced_frames = r->next;
    acknowledge(r, r->next);
    return outcome;
}

static int record(struct recorder *r) {
    bool complete;
    int code = already_complete(r, &complete);
    if (code != CLIENT_DONE || complete) {
        r->result->complete = r->result->was_complete = complete;
        return code;
    }
    enum outcome outcome = start(r);
    if (outcome != GOOD) // a refused run id is a usage fault, and nothing was recorded
        return outcome == LOST ? CLIENT_USAGE : exit_code(outcome);
    bool interrupted = false;
    if (!r->complete) {
        outcome = follow(r);
        interrupted = outcome == GOOD;
        while (outcome == OVER && (outcome = complete_log(r)) == AWAY)
            if (interrupt_count() || (outcome = wait_for_daemon(r)) == AWAY)
                break;
            else
                outcome = OVER;
        if (r->options->progress)
            progress_end();
    }
    if (outcome == AWAY)
        terminal_error("the daemon at %s is gone: %s", r->client->url, r->why);
    if (outcome == DISK) {
        terminal_note("what was recorded is safe in %s; repeat the command to go on", r->log_name);
        return CLIENT_IO;
    }
    if (r->complete)
        unregister(r);
    else if (outcome == GOOD && append_texts(r) == DISK) // what is known so far
        return CLIENT_IO;
    if (build(r) == DISK)
        return CLIENT_IO;
    if (!r->complete)
        terminal_note("%s holds the first %zu frames; repeat the command to go on",
                      r->options->file, r->result->n_frames);
    return interrupted || (interrupt_count() && r->options->on_interrupt) ? CLIENT_INTERRUPTED
                                                                          : exit_code(outcome);
}

int recorder_record(struct client *client, const struct recorder_options *options,
                    struct recorder_result *result) {
    *result = (struct recorder_result){0};
    struct recorder r = {.client = client, .options = options, .result = result};
    r.log_name = assemble_log_name(options->file);
    if (!r.log_name) {
        terminal_error("out of memory");
        return CLIENT_IO;
    }
    r.synced_at = now(); // heard_at 0: catch up at once
    const int code = record(&r);
    framelog_close(r.log);
    subscribe_close(r.subscription);
    free(r.digests);
    free(r.log_name);
    return code;
}
