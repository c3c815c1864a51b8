// GET /v1/events: what happens to all runs on one connection, so that whoever shows a list of them,
// or several at a time, asks nothing while nothing happens.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "server/routes_inside.h"

#define PROGRESS_SECONDS 0.5   // between two events that tell how far a run is
#define HEARTBEAT_SECONDS 10.0 // a peer that is gone is noticed when something is sent to it
#define WAIT_SECONDS 0.5       // the server looks in between whether the peer is still there
#define REST_NS 50000000       // between two rounds, however often something happens

// A run as it was told last.
struct told {
    char id[RUN_ID_MAX + 1];
    char created[40]; // another run of the same id is another run
    enum run_state state;
    uint64_t step, revision, epoch, frames;
    unsigned n_warnings;
    double at;
    bool there; // seen in this round
};

struct watch {
    struct routes *routes;
    struct told *told;
    size_t n_told, capacity;
    uint64_t news;
    double sent_at;
    char *text; // of the last round, being sent
    size_t bytes, sent;
    bool ready, ended;
};

static void watch_close(void *context) {
    struct watch *w = context;
    atomic_fetch_sub(&w->routes->streams, 1);
    free(w->told);
    free(w->text);
    free(w);
}

// `place`: where it most likely is, since both lists keep their order.
static struct told *told_of(struct watch *w, const char *id, size_t place) {
    if (place < w->n_told && strcmp(w->told[place].id, id) == 0)
        return &w->told[place];
    for (size_t k = 0; k < w->n_told; k++)
        if (strcmp(w->told[k].id, id) == 0)
            return &w->told[k];
    if (w->n_told == w->capacity) {
        size_t larger = w->capacity < 16 ? 16 : 2 * w->capacity;
        struct told *moved = realloc(w->told, larger * sizeof *moved);
        if (moved == NULL)
            return NULL;
        w->told = moved;
        w->capacity = larger;
    }
    struct told *fresh = &w->told[w->n_told++];
    *fresh = (struct told){0};
    snprintf(fresh->id, sizeof fresh->id, "%s", id);
    return fresh;
}

// Tells of a run what is new: a change at once, how far it is every PROGRESS_SECONDS.
static void tell_run(struct watch *w, struct run *run, size_t place, FILE *out) {
    struct told *told = told_of(w, run_id(run), place);
    if (told == NULL)
        return;
    told->there = true;
    if (strcmp(run_created(run), told->created) == 0 && run_state_is_final(told->state))
        return; // there is nothing more to tell, however many of them are listed
    struct run_status status = run_status(run);
    struct journal *journal = run_journal(run);
    double t = run_clock();
    struct told now = {.state = status.state,
                       .step = status.step,
                       .revision = status.revision,
                       .epoch = status.epoch,
                       .frames = journal != NULL ? journal_n_frames(journal) : 0,
                       .n_warnings = status.n_warnings,
                       .at = t,
                       .there = true};
    memcpy(now.id, told->id, sizeof now.id);
    snprintf(now.created, sizeof now.created, "%s", run_created(run));
    bool changed = strcmp(now.created, told->created) != 0 || now.state != told->state ||
                   now.revision != told->revision || now.epoch != told->epoch ||
                   now.n_warnings != told->n_warnings;
    bool further = now.step != told->step || now.frames != told->frames;
    if (!changed && (!further || t - told->at < PROGRESS_SECONDS))
        return;
    cJSON *json = routes_run_json(run);
    char *text = json_print(json, false);
    cJSON_Delete(json);
    if (text == NULL)
        return;
    fprintf(out, "event: run\ndata: %s\n\n", text);
    free(text);
    *told = now;
}

// Looks at all runs and writes what is new; true when there is something to send.
static bool watch_round(struct watch *w) {
    size_t count;
    char *text = NULL;
    FILE *out = open_memstream(&text, &w->bytes);
    if (out == NULL)
        return false;
    bool ending = atomic_load(&w->routes->ending);
    for (size_t k = 0; k < w->n_told; k++)
        w->told[k].there = false;
    struct run **all = runs_all(w->routes->runs, &count);
    for (size_t k = 0; k < count; k++) {
        tell_run(w, all[k], k, out);
        run_release(all[k]);
    }
    free(all);
    size_t kept = 0;
    for (size_t k = 0; k < w->n_told && !ending; k++)
        if (w->told[k].there)
            w->told[kept++] = w->told[k];
        else
            fprintf(out, "event: gone\ndata: {\"event\":\"gone\",\"id\":\"%s\"}\n\n",
                    w->told[k].id);
    w->n_told = ending ? w->n_told : kept;
    if (!w->ready)
        fputs("event: ready\ndata: {\"event\":\"ready\"}\n\n", out);
    w->ready = true;
    if (ending)
        fputs("event: end\ndata: {\"event\":\"end\",\"reason\":\"stopping\"}\n\n", out);
    w->ended = ending;
    fflush(out);
    if (w->bytes == 0 && run_clock() - w->sent_at >= HEARTBEAT_SECONDS)
        fputs(": still here\n\n", out);
    fclose(out);
    free(w->text);
    w->text = text;
    w->sent = 0;
    return w->bytes > 0;
}

static size_t watch_produce(void *context, char *out, size_t bytes) {
    struct watch *w = context;
    if (w->sent == w->bytes) {
        if (w->ended)
            return HTTP_END;
        if (w->ready) {
            nanosleep(&(struct timespec){.tv_nsec = REST_NS}, NULL);
            w->news = run_bell_wait(w->routes->host->bell, w->news, WAIT_SECONDS);
        }
        w->sent = w->bytes = 0;
        if (!watch_round(w))
            return 0;
        w->sent_at = run_clock();
    }
    size_t n = w->bytes - w->sent < bytes ? w->bytes - w->sent : bytes;
    memcpy(out, w->text + w->sent, n);
    w->sent += n;
    return n;
}

void routes_serve_all_events(struct call *c) {
    struct watch *w = routes_stream_begins(c, sizeof *w);
    if (w == NULL)
        return;
    w->routes = c->routes;
    w->sent_at = run_clock();
    c->reply->status = 200;
    c->reply->type = "text/event-stream";
    c->reply->produce = watch_produce;
    c->reply->close = watch_close;
    c->reply->stream = w;
}
