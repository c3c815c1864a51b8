// The recording loop. What it promises and why it holds is in proto/README.md ("Recording"):
//   1. a frame is appended to FILE.h5.log in the order of seq, without gaps, after its digest was
//   checked;
//   2. only what fdatasync has confirmed is acknowledged;
//   3. FILE.h5 is built from the log and renamed into place; then the log goes.
// Killed at any instant, the next call reads the log, cuts a torn tail and asks for what is
// missing.
#include "client/recorder_inside.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "client/assemble.h"
#include "client/interrupt.h"
#include "client/progress.h"
#include "client/store.h"
#include "client/terminal.h"

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

double recorder_now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

enum recorder_outcome recorder_disk(struct recorder *r) {
    terminal_error("%s", r->why);
    return RECORDER_DISK;
}

// ---- Frames ------------------------------------------------------------------------------------

// The next frame over HTTP. RECORDER_OVER: the daemon does not have it (yet).
static enum recorder_outcome fetch_next(struct recorder *r) {
    struct frameinfo info;
    struct reply reply;
    char after[64];
    snprintf(after, sizeof after, "/frames/%llu", (unsigned long long)r->next);
    for (int attempt = 0; attempt < FETCH_TRIES; attempt++) {
        enum recorder_outcome outcome =
            recorder_get(r, after, "application/vnd.fbard.frame", &reply);
        if (outcome != RECORDER_GOOD)
            return outcome;
        if (reply.status != 200) {
            request_reply_free(&reply);
            return RECORDER_OVER;
        }
        if (frameinfo_read(reply.body, reply.bytes, &info, r->why, sizeof r->why) == 0 &&
            info.total_bytes == reply.bytes && info.seq == r->next &&
            strcmp(info.run, r->options->run) == 0) {
            outcome = recorder_take(r, &info, reply.body);
            request_reply_free(&reply);
            r->result->repaired++;
            return outcome;
        }
        request_reply_free(&reply);
    }
    terminal_error("frame %llu of %s is damaged at the daemon: it %s", (unsigned long long)r->next,
                   r->options->run, r->why);
    return RECORDER_LOST;
}

// Everything before `until` that is not here yet.
static enum recorder_outcome fetch_until(struct recorder *r, uint64_t until) {
    while (r->next < until && !r->ended) {
        const enum recorder_outcome outcome = fetch_next(r);
        if (outcome == RECORDER_OVER) {
            terminal_error("frame %llu of %s is gone from the daemon%s; the recording cannot be "
                           "completed",
                           (unsigned long long)r->next, r->options->run,
                           r->no_recorders ? ", which keeps no frames for recorders" : "");
            return RECORDER_LOST;
        }
        if (outcome != RECORDER_GOOD)
            return outcome;
    }
    return RECORDER_GOOD;
}

// One message of the live stream. A damaged or foreign one is passed over: polling finds the gap.
static enum recorder_outcome take_message(struct recorder *r, const void *body, size_t bytes) {
    struct frameinfo info;
    if (frameinfo_read(body, bytes, &info, r->why, sizeof r->why) != 0 ||
        info.total_bytes != bytes || strcmp(info.run, r->options->run) != 0) {
        terminal_note("a frame on the live stream %s; fetching it over HTTP", r->why);
        r->heard_at = 0; // poll at once
        return RECORDER_GOOD;
    }
    if (info.seq > r->next) {
        const enum recorder_outcome outcome = fetch_until(r, info.seq);
        if (outcome != RECORDER_GOOD)
            return outcome;
    }
    return r->ended && info.seq >= r->next ? RECORDER_GOOD : recorder_take(r, &info, body);
}

// Asks over HTTP what the live stream may have lost. RECORDER_OVER: the run has ended and every
// frame is here.
static enum recorder_outcome poll_run(struct recorder *r) {
    cJSON *run, *index;
    enum recorder_outcome outcome = recorder_get_json(r, "", &run);
    if (outcome != RECORDER_GOOD)
        return outcome;
    const bool over = progress_over(run);
    const cJSON *step = cJSON_GetObjectItemCaseSensitive(run, "step");
    const double at = cJSON_IsNumber(step) ? step->valuedouble : -1;
    // A run that stands still has nothing new; but one that waits may wait for us.
    const bool quiet = !over && at == r->polled_step && recorder_now() - r->indexed_at < INDEX_S &&
                       strcmp(progress_state(run), "waiting") != 0;
    r->polled_step = at;
    if (strcmp(recorder_text(run, "created"), r->created) != 0) {
        terminal_error("%s is another run than the one in %s", r->options->run, r->log_name);
        cJSON_Delete(run);
        return RECORDER_LOST;
    }
    cJSON_Delete(run);
    if (quiet && r->heard_at > 0)
        return RECORDER_GOOD;
    r->indexed_at = recorder_now();
    // The index is asked after the state, so nothing can come after it when the run is over.
    outcome = recorder_get_json(r, "/frames", &index);
    if (outcome != RECORDER_GOOD)
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
    return outcome == RECORDER_GOOD && (r->ended || over) ? RECORDER_OVER : outcome;
}

// FILE.h5 from the log; the log goes when the file is complete.
static enum recorder_outcome build(struct recorder *r) {
    struct assemble_result built;
    if (assemble(r->log, r->options->file, r->options->compress, &built, r->why, sizeof r->why) !=
        0) {
        terminal_error("%s", r->why);
        terminal_note("nothing is lost: make room, then repeat the command, or `fbar recover %s`",
                      r->options->file);
        return RECORDER_DISK;
    }
    r->result->n_frames = built.n_frames;
    r->result->bytes = built.bytes;
    r->result->complete = built.complete;
    if (built.complete && unlink(r->log_name) != 0) {
        snprintf(r->why, sizeof r->why, "%s: %s", r->log_name, strerror(errno));
        return recorder_disk(r);
    }
    return RECORDER_GOOD;
}

// ---- The loop ---------------------------------------------------------------------------------

static void show(struct recorder *r) {
    cJSON *run;
    if (!r->options->progress || recorder_now() - r->shown_at < progress_interval())
        return;
    r->shown_at = recorder_now();
    if (recorder_get_json(r, "", &run) == RECORDER_GOOD)
        progress_show(run);
    cJSON_Delete(run);
}

// After RECORDER_AWAY: RECORDER_GOOD once the daemon is back, or on a signal; RECORDER_AWAY when
// patience is over.
static enum recorder_outcome wait_for_daemon(struct recorder *r) {
    const double deadline = recorder_now() + r->options->patience_s;
    if (interrupt_count() > r->interrupts) // in the middle of what broke off
        return RECORDER_GOOD;
    terminal_note("the daemon at %s is away (%s); waiting up to %.0f s", r->client->url, r->why,
                  r->options->patience_s);
    while (recorder_now() < deadline) {
        usleep(200000);
        if (interrupt_count() > r->interrupts)
            return RECORDER_GOOD;
        if (recorder_connect(r) == RECORDER_GOOD) {
            terminal_note("the daemon is back");
            if (*r->name) // none yet before the log is begun
                recorder_acknowledge(r, r->synced_frames);
            r->heard_at = 0; // poll at once
            return RECORDER_GOOD;
        }
    }
    return RECORDER_AWAY;
}

// The first Ctrl-C, passed on as `fbar run` wants it. RECORDER_GOOD: go on, until the run has
// ended.
static enum recorder_outcome pass_on_interrupt(struct recorder *r, double *deadline) {
    struct reply reply;
    char after[16];
    const char *action = r->options->on_interrupt;
    if (!action || interrupt_count() > 1)
        return RECORDER_OVER;
    snprintf(after, sizeof after, ":%s", action);
    terminal_note("asking the daemon to %s the run; Ctrl-C again leaves at once", action);
    char *path = request_path("/v1/runs/", r->options->run, after);
    const struct request_spec spec = {
        .method = "POST", .path = path ? path : "/", .timeout_ms = 10000};
    const int status = request_send(r->client->requests, &spec, &reply, r->why, sizeof r->why);
    free(path);
    if (status != 0)
        return RECORDER_OVER;
    request_reply_free(&reply);
    *deadline = recorder_now() + CANCEL_S;
    if (strcmp(action, "pause") == 0) {
        const enum recorder_outcome outcome = poll_run(r);
        return outcome == RECORDER_GOOD ? RECORDER_OVER : outcome;
    }
    return RECORDER_GOOD;
}

// One turn: a message, or what silence asks for.
static enum recorder_outcome turn(struct recorder *r) {
    const void *body;
    size_t bytes;
    enum recorder_outcome outcome = RECORDER_GOOD;
    enum subscribe_kind kind = SUBSCRIBE_NOTHING;
    const bool unsynced = r->synced_frames != r->next;
    const int patience_ms = r->heard_at == 0 ? 0 : unsynced ? 5 : 100;
    if (r->subscription)
        kind = subscribe_receive(r->subscription, patience_ms, &body, &bytes);
    else
        usleep(100000);
    if (kind == SUBSCRIBE_FRAME) {
        r->heard_at = recorder_now();
        outcome = take_message(r, body, bytes);
    } else if (kind == SUBSCRIBE_ERROR) {
        terminal_note("the live stream broke; fetching frames over HTTP");
        subscribe_close(r->subscription);
        r->subscription = NULL;
    } else if (recorder_now() - r->heard_at > POLL_S) {
        outcome = poll_run(r);
        r->heard_at = recorder_now();
    }
    const bool pause = kind == SUBSCRIBE_NOTHING;
    if ((outcome == RECORDER_GOOD || outcome == RECORDER_OVER) && r->synced_frames != r->next &&
        (pause || recorder_now() - r->synced_at > SYNC_S ||
         framelog_bytes(r->log) - r->synced_bytes > SYNC_BYTES)) {
        const enum recorder_outcome durable = recorder_make_durable(r);
        if (durable != RECORDER_GOOD)
            return durable;
    }
    return outcome == RECORDER_GOOD && r->ended ? RECORDER_OVER : outcome;
}

// Until every frame is in the log: RECORDER_OVER; RECORDER_AWAY, RECORDER_LOST or RECORDER_DISK
// otherwise. RECORDER_GOOD: interrupted before.
static enum recorder_outcome follow(struct recorder *r) {
    double deadline = INFINITY;
    for (;;) {
        if (interrupt_count() > r->interrupts) {
            r->interrupts = interrupt_count();
            const enum recorder_outcome outcome = pass_on_interrupt(r, &deadline);
            if (outcome != RECORDER_GOOD)
                return outcome == RECORDER_OVER && !r->ended ? RECORDER_GOOD : outcome;
        }
        if (recorder_now() > deadline)
            return RECORDER_GOOD;
        enum recorder_outcome outcome = turn(r);
        if (outcome == RECORDER_AWAY)
            outcome = wait_for_daemon(r);
        else if (outcome == RECORDER_GOOD)
            show(r);
        if (outcome != RECORDER_GOOD)
            return outcome;
    }
}

static int exit_code(enum recorder_outcome outcome) {
    switch (outcome) {
    case RECORDER_GOOD:
    case RECORDER_OVER:
        return CLIENT_DONE;
    case RECORDER_AWAY:
        return CLIENT_UNREACHABLE;
    case RECORDER_LOST:
    case RECORDER_DISK:
        return CLIENT_IO;
    }
    return CLIENT_IO;
}

// Whether the log can be made there: better now than after the run was created.
static int check_place(const char *file) {
    char *name = assemble_log_name(file);
    const bool there = name && access(name, F_OK) == 0;
    const int fd = name ? open(name, O_RDWR | O_CREAT | O_CLOEXEC, 0666) : -1;
    const int error = errno;
    if (fd >= 0)
        close(fd);
    if (fd >= 0 && !there)
        unlink(name);
    free(name);
    if (fd >= 0)
        return CLIENT_DONE;
    terminal_error("%s: %s; choose another -o", file, strerror(error));
    return CLIENT_IO;
}

int recorder_check_file(const char *file, const char *run) {
    char why[512];
    bool foreign;
    struct store_file *h5 = store_open(file, &foreign, why, sizeof why);
    if (!h5 && access(file, F_OK) != 0)
        return check_place(file);
    if (!h5) {
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

// Opens the log and the stream and registers. RECORDER_GOOD, or how it ended.
static enum recorder_outcome start(struct recorder *r) {
    bool empty = true;
    cJSON *run;
    r->log = framelog_open(r->log_name, false, r->why, sizeof r->why);
    if (!r->log && errno != ENOENT)
        return recorder_disk(r);
    if (r->log) {
        const enum recorder_outcome outcome = recorder_resume_log(r, &empty);
        if (outcome != RECORDER_GOOD || r->complete)
            return outcome;
    }
    enum recorder_outcome outcome = recorder_connect(r);
    if (outcome == RECORDER_GOOD)
        outcome = recorder_get_json(r, "", &run);
    // A recording that goes on waits as it would have done had it never stopped; a new one waits for
    // a daemon that was there a moment ago.
    while (outcome == RECORDER_AWAY && (!empty || request_broken_off(r->client->requests)) &&
           !interrupt_count() && wait_for_daemon(r) == RECORDER_GOOD)
        outcome = recorder_get_json(r, "", &run);
    if (outcome != RECORDER_GOOD) {
        if (outcome == RECORDER_AWAY)
            terminal_error("cannot reach the daemon at %s: %s", r->client->url, r->why);
        return outcome;
    }
    char created[64];
    snprintf(created, sizeof created, "%s", recorder_text(run, "created"));
    cJSON_Delete(run);
    if (!empty && strcmp(created, r->created) != 0) {
        terminal_error("%s holds an earlier run of the name %s; choose another -o", r->log_name,
                       r->options->run);
        return RECORDER_DISK;
    }
    snprintf(r->created, sizeof r->created, "%s", created);
    if (!r->log) {
        r->log = framelog_open(r->log_name, true, r->why, sizeof r->why);
        uint64_t cut;
        struct framelog_record none;
        if (!r->log || framelog_read(r->log, &none, &cut, r->why, sizeof r->why) < 0)
            return recorder_disk(r);
    }
    if (empty)
        outcome = recorder_start_log(r);
    if (outcome == RECORDER_GOOD && framelog_sync(r->log, r->why, sizeof r->why) != 0)
        return recorder_disk(r);
    r->synced_frames = r->next;
    recorder_acknowledge(r, r->next);
    return outcome;
}

static int record(struct recorder *r) {
    bool complete;
    int code = already_complete(r, &complete);
    if (code != CLIENT_DONE || complete) {
        r->result->complete = r->result->was_complete = complete;
        return code;
    }
    enum recorder_outcome outcome = start(r);
    if (outcome != RECORDER_GOOD) // a refused run id is a usage fault, and nothing was recorded
        return outcome == RECORDER_LOST ? CLIENT_USAGE : exit_code(outcome);
    if (!r->complete) {
        outcome = follow(r);
        while (outcome == RECORDER_OVER && (outcome = recorder_complete_log(r)) == RECORDER_AWAY)
            if (interrupt_count() || (outcome = wait_for_daemon(r)) == RECORDER_AWAY)
                break;
            else
                outcome = RECORDER_OVER;
        if (r->options->progress)
            progress_end();
    }
    const bool interrupted = outcome == RECORDER_GOOD && !r->complete;
    if (outcome == RECORDER_AWAY)
        terminal_error("the daemon at %s is gone: %s", r->client->url, r->why);
    if (outcome == RECORDER_DISK) {
        terminal_note("what was recorded is safe in %s; repeat the command to go on", r->log_name);
        return CLIENT_IO;
    }
    if (r->complete)
        recorder_unregister(r);
    else if (outcome == RECORDER_GOOD &&
             recorder_append_texts(r) == RECORDER_DISK) // what is known so far
        return CLIENT_IO;
    if (build(r) == RECORDER_DISK)
        return CLIENT_IO;
    if (!r->complete && !r->options->on_interrupt)
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
    r.synced_at = recorder_now(); // heard_at 0: catch up at once
    const int code = record(&r);
    framelog_close(r.log);
    subscribe_close(r.subscription);
    free(r.digests);
    free(r.log_name);
    return code;
}
