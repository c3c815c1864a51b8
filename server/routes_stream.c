// Routes without an end: events as they happen (server-sent events), frames as they come. Each has
// a thread of its own, which waits for news of the run.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "server/log.h"
#include "server/routes_inside.h"

#define PROGRESS_SECONDS 0.5   // between two events that tell how far the run is
#define HEARTBEAT_SECONDS 10.0 // a peer that is gone is noticed when something is sent to it
#define WAIT_SECONDS 0.5       // the server looks in between whether the peer is still there

void *routes_stream_begins(struct call *c, size_t bytes) {
    void *stream = NULL;
    if (atomic_fetch_add(&c->routes->streams, 1) < ROUTES_STREAMS_MAX) {
        stream = calloc(1, bytes);
        if (stream != NULL)
            return stream;
        reply_problem(c->reply, 503, NULL, "no memory for another stream now");
    } else {
        reply_problem(c->reply, 503, NULL, "%d streams are open already", ROUTES_STREAMS_MAX);
    }
    atomic_fetch_sub(&c->routes->streams, 1);
    return NULL;
}

// Whether nothing more will come. Ask it before looking for what has come.
static bool is_over(struct run *run) {
    return run_state_is_final(run_status(run).state) || run_stopping(run);
}

// ---- Events -----------------------------------------------------------------------------------

struct event_stream {
    struct routes *routes;
    struct run *run;
    uint64_t offset, number; // of the next line in the event log; the first is number 0
    uint64_t news;
    uint64_t told_step; // of the last event about progress
    double progress_at, sent_at;
    char *text; // being sent
    size_t bytes, sent;
    bool progress_told, ended;
};

static void events_close(void *context) {
    struct event_stream *s = context;
    atomic_fetch_sub(&s->routes->streams, 1);
    run_release(s->run);
    free(s->text);
    free(s);
}

static void event_put(struct event_stream *s, const char *id, const char *kind, const char *json) {
    size_t bytes = 64 + strlen(id) + strlen(kind) + strlen(json);
    free(s->text);
    s->text = malloc(bytes);
    s->sent = 0;
    s->bytes = s->text == NULL ? 0
                               : (size_t)snprintf(s->text, bytes, "%s%s%sevent: %s\ndata: %s\n\n",
                                                  id[0] != '\0' ? "id: " : "", id,
                                                  id[0] != '\0' ? "\n" : "", kind, json);
}

// The next line of the log, as it stands there; its number is its id.
static bool put_logged(struct event_stream *s) {
    struct journal *journal = run_journal(s->run);
    struct faults faults = {0};
    char id[24];
    char *line = journal != NULL ? journal_event_next(journal, &s->offset) : NULL;
    if (line == NULL)
        return false;
    cJSON *json = json_parse(line, strlen(line), &faults);
    const char *kind = cJSON_GetStringValue(json_member(json, "event"));
    snprintf(id, sizeof id, "%llu", (unsigned long long)++s->number);
    event_put(s, id, kind != NULL ? kind : "message", line);
    cJSON_Delete(json);
    faults_free(&faults);
    free(line);
    return true;
}

static void put_progress(struct event_stream *s, const struct run_status *status) {
    cJSON *json = cJSON_CreateObject();
    double work = (double)status->particles * (double)status->step;
    cJSON_AddStringToObject(json, "event", "progress");
    cJSON_AddStringToObject(json, "state", run_state_name(status->state));
    reply_add(json, "step", (double)status->step);
    reply_add(json, "time", status->time);
    reply_add(json, "end_time", status->end_time);
    reply_add(json, "progress", routes_progress(status));
    reply_add(json, "eta_s", status->eta_s);
    reply_add(json, "dt", status->dt);
    reply_add(json, "wall_s", status->wall_s);
    reply_add(json, "particle_steps_per_s", status->wall_s > 0 ? work / status->wall_s : NAN);
    char *text = json_print(json, false);
    if (text != NULL)
        event_put(s, "", "progress", text);
    free(text);
    cJSON_Delete(json);
    s->progress_at = run_clock();
    s->progress_told = true;
    s->told_step = status->step;
}

// The last that is sent: so that a client can tell the end of the run from a broken line.
static void put_end(struct event_stream *s) {
    char json[96];
    bool over = run_state_is_final(run_status(s->run).state);
    snprintf(json, sizeof json, "{\"event\":\"end\",\"state\":\"%s\",\"reason\":\"%s\"}",
             run_state_name(run_status(s->run).state), over ? "over" : "stopping");
    event_put(s, "", "end", json);
    s->ended = true;
}

static bool events_next(struct event_stream *s) {
    bool over = is_over(s->run);
    if (put_logged(s))
        return true;
    struct run_status status = run_status(s->run);
    double t = run_clock();
    if (!s->progress_told ||
        (status.step != s->told_step && (over || t - s->progress_at >= PROGRESS_SECONDS))) {
        put_progress(s, &status);
        return true;
    }
    if (over) {
        put_end(s);
        return true;
    }
    if (t - s->sent_at < HEARTBEAT_SECONDS)
        return false;
    free(s->text);
    s->text = strdup(": still here\n\n");
    s->bytes = s->text != NULL ? strlen(s->text) : 0;
    s->sent = 0;
    return true;
}

static size_t events_produce(void *context, char *out, size_t bytes) {
    struct event_stream *s = context;
    if (s->sent == s->bytes) {
        if (s->ended)
            return HTTP_END;
        if (!events_next(s)) {
            s->news = run_news(s->run, s->news, WAIT_SECONDS);
            return 0;
        }
        s->sent_at = run_clock();
    }
    size_t n = s->bytes - s->sent < bytes ? s->bytes - s->sent : bytes;
    memcpy(out, s->text + s->sent, n);
    s->sent += n;
    return n;
}

// Moves to the state that the run is in: the last event of a state in the log.
static void events_skip_to_state(struct event_stream *s) {
    struct journal *journal = run_journal(s->run);
    uint64_t offset = 0, number = 0;
    if (journal == NULL)
        return;
    for (;;) {
        uint64_t at = offset;
        char *line = journal_event_next(journal, &offset);
        if (line == NULL)
            return;
        if (strncmp(line, "{\"event\":\"state\"", 16) == 0) {
            s->offset = at;
            s->number = number;
        }
        number++;
        free(line);
    }
}

static void events_skip(struct event_stream *s, uint64_t last) {
    struct journal *journal = run_journal(s->run);
    char *line;
    while (s->number < last && journal != NULL &&
           (line = journal_event_next(journal, &s->offset)) != NULL) {
        s->number++;
        free(line);
    }
}

void routes_serve_events(struct call *c) {
    const char *last = http_header(c->request, "Last-Event-ID");
    if (last != NULL &&
        (last[0] == '\0' || strlen(last) > 19 || strspn(last, "0123456789") != strlen(last))) {
        reply_problem(c->reply, 400, NULL,
                      "Last-Event-ID must be the id of an event of this run, a whole number, got "
                      "%.40s",
                      last);
        return;
    }
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    struct event_stream *s = routes_stream_begins(c, sizeof *s);
    if (s == NULL) {
        run_release(run);
        return;
    }
    *s = (struct event_stream){.routes = c->routes, .run = run, .sent_at = run_clock()};
    if (last != NULL)
        events_skip(s, strtoull(last, NULL, 10));
    else
        events_skip_to_state(s);
    c->reply->status = 200;
    c->reply->type = "text/event-stream";
    c->reply->produce = events_produce;
    c->reply->close = events_close;
    c->reply->stream = s;
}

// ---- Frames -----------------------------------------------------------------------------------

struct frame_stream {
    struct routes *routes;
    struct run *run;
    uint64_t next; // frame
    uint64_t news;
    struct thin thin;
    int fd;                 // of the frame being sent, where it is sent as it stands; else -1
    unsigned char *thinned; // or else what is sent
    uint64_t at;            // what is left of it: place in the file or in `thinned`
    size_t left;
};

static void frame_done(struct frame_stream *s) {
    if (s->fd >= 0)
        close(s->fd);
    free(s->thinned);
    s->fd = -1;
    s->thinned = NULL;
    s->left = 0;
}

static void frames_close(void *context) {
    struct frame_stream *s = context;
    frame_done(s);
    atomic_fetch_sub(&s->routes->streams, 1);
    run_viewers(s->run, -1);
    run_release(s->run);
    free(s);
}

// Whether there is a frame to send: the newest, whatever came between.
static bool frames_next(struct frame_stream *s) {
    struct journal *journal = run_journal(s->run);
    char why[JOURNAL_WHY];
    uint64_t n = journal != NULL ? journal_n_frames(journal) : 0;
    frame_done(s);
    if (n <= s->next)
        return false;
    struct journal_frame frame = {0};
    if (thin_asked(&s->thin)) {
        unsigned char *whole = journal_frame_read(journal, n - 1, &frame, why);
        if (whole != NULL) {
            snprintf(why, sizeof why, "no memory to thin it");
            s->thinned = thin_frame(&s->thin, whole, frame.bytes, &s->left);
        }
        free(whole);
        s->at = 0;
    } else {
        s->fd = journal_frame_open(journal, n - 1, &frame, why);
        s->at = frame.offset;
        s->left = s->fd >= 0 ? frame.bytes : 0;
    }
    if (s->left == 0) {
        log_warn("stream", "run=%s seq=%llu why=\"%s\"", run_id(s->run), (unsigned long long)n - 1,
                 why);
        s->next = n;
        return false;
    }
    atomic_fetch_add(&s->routes->stream_skipped, n - 1 - s->next);
    atomic_fetch_add(&s->routes->stream_sent, 1);
    s->next = n;
    return true;
}

static size_t frames_produce(void *context, char *out, size_t bytes) {
    struct frame_stream *s = context;
    if (s->left == 0) {
        bool over = is_over(s->run);
        if (!frames_next(s)) {
            if (over)
                return HTTP_END;
            s->news = run_news(s->run, s->news, WAIT_SECONDS);
            return 0;
        }
    }
    size_t n = s->left < bytes ? s->left : bytes;
    if (s->thinned != NULL) {
        memcpy(out, s->thinned + s->at, n);
    } else {
        ssize_t got = pread(s->fd, out, n, (off_t)s->at);
        if (got <= 0)
            return HTTP_END; // in the midst of a frame: the reader must not take the next for its
                             // rest
        n = (size_t)got;
    }
    s->at += n;
    s->left -= n;
    return n;
}

void routes_serve_stream(struct call *c) {
    struct thin thin;
    if (!routes_thinning(c, &thin))
        return;
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    struct frame_stream *s = routes_stream_begins(c, sizeof *s);
    if (s == NULL) {
        run_release(run);
        return;
    }
    uint64_t n = run_journal(run) != NULL ? journal_n_frames(run_journal(run)) : 0;
    *s = (struct frame_stream){
        .routes = c->routes, .run = run, .thin = thin, .fd = -1, .next = n > 0 ? n - 1 : 0};
    run_viewers(run, 1);
    c->reply->status = 200;
    c->reply->type = "application/vnd.fbard.frame";
    c->reply->produce = frames_produce;
    c->reply->close = frames_close;
    c->reply->stream = s;
}
