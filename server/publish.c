// One thread, one PUB socket (XPUB, which also tells who subscribes), one queue a run. Order of a
// frame: digest, journal, socket; so nothing is ever seen on the wire that a crash could take back.
//
// A frame's memory is free again as soon as the journal has it. What ZeroMQ sends is a mapping of
// the journal's file, so that subscribers that stall, each at its own frame, hold pages of the file
// cache and none of the daemon's memory; SEND_HIGH_WATER bounds how many.
#include "server/publish.h"

#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <zmq.h>

#include "proto/frame.h"
#include "server/log.h"
#include "server/zap.h"

#define SEND_HIGH_WATER 8 // messages a subscriber may lag before it loses some
#define LINGER_MS 1000
#define SPARE_SLACK 4096   // bytes
#define RETRY_SECONDS 0.5  // between two tries on a full disk
#define LOG_SECONDS 60     // between two lines about the same trouble
#define EVENTS_MAX 256     // queued events of a run; the log has them all
#define AWAIT_SECONDS 0.02 // between two looks for subscriptions while a run waits for them
#define TOPIC_MAX 80       // bytes; a longer one matches nothing
#define TOPICS_MAX 4096 // different ones that are counted; bounds what subscribers can make us hold

struct item {
    struct item *next;
    struct outlet_frame *frame; // or else
    char *event;
};

struct outlet {
    struct outlet *next;
    struct publisher *publisher;
    struct journal *journal;
    void (*wake)(void *context);
    void *context;
    char frame_topic[80], event_topic[80];
    // Under the publisher's lock:
    struct item *first, *last;
    unsigned n_frames, n_events;
    struct outlet_frame *spare[OUTLET_DEPTH + 1]; // what was in flight at a time, for the next ones
    unsigned n_spare;
    bool retired;
    bool busy; // the thread is at work on one of its items
    bool awaits;
    enum journal_result status;
    struct timespec retry, log_again;
    char why[JOURNAL_WHY];
};

struct topic {
    char text[TOPIC_MAX];
    size_t bytes;
    uint64_t count;
};

struct publisher {
    void *context, *socket;
    struct zap *zap; // NULL: not encrypted
    pthread_t thread;
    pthread_mutex_t lock;
    pthread_cond_t work, done; // both on CLOCK_MONOTONIC
    struct outlet *outlets;
    struct outlet *turn; // whose item was taken last
    bool stop;
    unsigned n_awaiting; // outlets
    struct topic *topics;
    size_t n_topics, topics_capacity;
    struct publish_counts counts;
};

// ---- Buffers ----------------------------------------------------------------------------------

// Buffers are used again: fresh pages cost more than what is written into them, and blocks of this
// size that come and go between others would leave gaps in malloc's arena, several times their
// size.

static void buffer_free(struct outlet_frame *frame) {
    if (frame == NULL)
        return;
    free(frame->frame);
    free(frame);
}

struct outlet_frame *publish_buffer(struct outlet *o, size_t bytes) {
    struct outlet_frame *frame = NULL;
    pthread_mutex_lock(&o->publisher->lock);
    if (o->n_spare > 0)
        frame = o->spare[--o->n_spare];
    pthread_mutex_unlock(&o->publisher->lock);
    if (frame != NULL && (frame->room < bytes || frame->room / 2 > bytes + SPARE_SLACK)) {
        buffer_free(frame);
        frame = NULL;
    }
    if (frame == NULL) {
        frame = calloc(1, sizeof *frame);
        if (frame == NULL)
            return NULL;
        frame->room = (bytes / SPARE_SLACK + 1) * SPARE_SLACK; // headers differ by some digits
        frame->frame = aligned_alloc(FRAME_ALIGN, frame->room);
        if (frame->frame == NULL) {
            free(frame);
            return NULL;
        }
    }
    frame->info = (struct journal_frame){.bytes = bytes};
    return frame;
}

// Called with the lock.
static void give_back(struct outlet *o, struct outlet_frame *frame) {
    if (frame != NULL && !o->retired && o->n_spare < sizeof o->spare / sizeof *o->spare)
        o->spare[o->n_spare++] = frame;
    else
        buffer_free(frame);
}

void publish_drop(struct outlet *o, struct outlet_frame *frame) {
    pthread_mutex_lock(&o->publisher->lock);
    give_back(o, frame);
    pthread_mutex_unlock(&o->publisher->lock);
}

static void message_free(void *bytes, void *hint) {
    struct journal_map *map = hint;
    (void)bytes;
    journal_frame_unmap(map);
    free(map);
}

// ---- Sending -----------------------------------------------------------------------------------

static struct timespec after(double seconds) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    t.tv_sec += (time_t)seconds;
    t.tv_nsec += (long)((seconds - (double)(time_t)seconds) * 1e9);
    if (t.tv_nsec >= 1000000000) {
        t.tv_nsec -= 1000000000;
        t.tv_sec++;
    }
    return t;
}

static bool is_past(const struct timespec *t) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec > t->tv_sec || (now.tv_sec == t->tv_sec && now.tv_nsec >= t->tv_nsec);
}

// PUB never blocks; a message that a subscriber's pipe has no room for is dropped for that one.
static void send_frame(struct publisher *p, const struct outlet *outlet, uint64_t seq) {
    zmq_msg_t message;
    char why[JOURNAL_WHY];
    struct journal_map *map = malloc(sizeof *map);
    if (map == NULL || !journal_frame_map(outlet->journal, seq, map, why)) {
        log_warn("not_published", "topic=%s seq=%llu why=\"%s\"", outlet->frame_topic,
                 (unsigned long long)seq, map == NULL ? "out of memory" : why);
        free(map); // subscribers see the gap and fetch it
        return;
    }
    const uint64_t bytes = map->bytes; // the map is gone once it is sent
    if (zmq_msg_init_data(&message, map->frame, map->bytes, message_free, map) != 0) {
        message_free(NULL, map);
        return;
    }
    if (zmq_send(p->socket, outlet->frame_topic, strlen(outlet->frame_topic),
                 ZMQ_SNDMORE | ZMQ_DONTWAIT) < 0 ||
        zmq_msg_send(&message, p->socket, ZMQ_DONTWAIT) < 0) {
        zmq_msg_close(&message);
        return;
    }
    pthread_mutex_lock(&p->lock);
    p->counts.frames++;
    p->counts.frame_bytes += bytes;
    pthread_mutex_unlock(&p->lock);
}

static void send_event(struct publisher *p, const struct outlet *outlet, const char *json) {
    if (zmq_send(p->socket, outlet->event_topic, strlen(outlet->event_topic),
                 ZMQ_SNDMORE | ZMQ_DONTWAIT) >= 0)
        zmq_send(p->socket, json, strlen(json), ZMQ_DONTWAIT);
    pthread_mutex_lock(&p->lock);
    p->counts.events++;
    pthread_mutex_unlock(&p->lock);
}

static void announce_gone(struct publisher *p, struct outlet *outlet, uint64_t before) {
    uint64_t gone = journal_n_gone(outlet->journal);
    char json[96];
    if (gone == before)
        return;
    snprintf(json, sizeof json, "{\"event\":\"dropped\",\"from\":%llu,\"to\":%llu}",
             (unsigned long long)before, (unsigned long long)gone - 1);
    send_event(p, outlet, json);
    log_warn("frames_dropped", "topic=%s from=%llu to=%llu", outlet->frame_topic,
             (unsigned long long)before, (unsigned long long)gone - 1);
}

// ---- Who subscribes ---------------------------------------------------------------------------

// A subscription (1) or the end of one (0). Called with the lock.
static void note_subscription(struct publisher *p, bool begins, const char *text, size_t bytes) {
    size_t k = 0;
    while (k < p->n_topics &&
           (p->topics[k].bytes != bytes || memcmp(p->topics[k].text, text, bytes) != 0))
        k++;
    if (k == p->n_topics) {
        if (!begins || p->n_topics == TOPICS_MAX)
            return;
        if (p->n_topics == p->topics_capacity) {
            size_t larger = p->topics_capacity == 0 ? 16 : 2 * p->topics_capacity;
            struct topic *moved = realloc(p->topics, larger * sizeof *moved);
            if (moved == NULL)
                return;
            p->topics = moved;
            p->topics_capacity = larger;
        }
        p->topics[k] = (struct topic){.bytes = bytes};
        memcpy(p->topics[k].text, text, bytes);
        p->n_topics++;
    }
    p->counts.subscriptions += begins ? 1 : (uint64_t)-1;
    p->topics[k].count += begins ? 1 : (uint64_t)-1;
    if (p->topics[k].count == 0)
        p->topics[k] = p->topics[--p->n_topics];
}

// Takes what subscribers have told. Called with the lock, which it gives up while it asks.
static void read_subscriptions(struct publisher *p) {
    char message[1 + TOPIC_MAX];
    for (;;) {
        pthread_mutex_unlock(&p->lock);
        int n = zmq_recv(p->socket, message, sizeof message, ZMQ_DONTWAIT);
        pthread_mutex_lock(&p->lock);
        if (n < 0)
            return;
        if (n > 0 && (size_t)n <= sizeof message && (message[0] == 0 || message[0] == 1))
            note_subscription(p, message[0] == 1, message + 1, (size_t)n - 1);
    }
}

uint64_t publish_subscribers(struct outlet *o) {
    uint64_t count = 0;
    pthread_mutex_lock(&o->publisher->lock);
    for (size_t k = 0; k < o->publisher->n_topics; k++) {
        const struct topic *topic = &o->publisher->topics[k];
        if (topic->bytes <= strlen(o->frame_topic) &&
            memcmp(topic->text, o->frame_topic, topic->bytes) == 0)
            count += topic->count;
    }
    pthread_mutex_unlock(&o->publisher->lock);
    return count;
}

void publish_await(struct outlet *o, bool awaits) {
    pthread_mutex_lock(&o->publisher->lock);
    if (awaits != o->awaits) {
        o->awaits = awaits;
        o->publisher->n_awaiting += awaits ? 1 : (unsigned)-1;
        pthread_cond_signal(&o->publisher->work);
    }
    pthread_mutex_unlock(&o->publisher->lock);
}

void publish_count(struct publisher *p, struct publish_counts *out) {
    pthread_mutex_lock(&p->lock);
    *out = p->counts;
    pthread_mutex_unlock(&p->lock);
}

// ---- The thread -------------------------------------------------------------------------------

// The next item that may be worked on, of the outlets in turn.
static struct outlet *next_outlet(struct publisher *p) {
    struct outlet *start = p->turn != NULL && p->turn->next != NULL ? p->turn->next : p->outlets;
    struct outlet *o = start;
    if (o == NULL)
        return NULL;
    do {
        bool failed = o->status == JOURNAL_ERROR;
        bool waits =
            (o->status == JOURNAL_FULL || o->status == JOURNAL_HELD) && !is_past(&o->retry);
        if (o->first != NULL && !waits && !failed)
            return o;
        o = o->next != NULL ? o->next : p->outlets;
    } while (o != start);
    return NULL;
}

// Called with the lock, which it gives up while it works.
static void work_on(struct publisher *p, struct outlet *o) {
    struct item *item = o->first;
    enum journal_result result = JOURNAL_OK;
    char why[JOURNAL_WHY] = "", before[JOURNAL_WHY];
    memcpy(before, o->why, sizeof before);
    o->busy = true;
    p->turn = o;
    pthread_mutex_unlock(&p->lock);
    if (item->frame != NULL) {
        struct outlet_frame *frame = item->frame;
        uint64_t gone = journal_n_gone(o->journal);
        frame->info.digest = frame_seal(frame->frame);
        result = journal_append_frame(o->journal, frame->frame, &frame->info, why);
        if (result == JOURNAL_OK) {
            announce_gone(p, o, gone);
            send_frame(p, o, frame->info.seq);
        } else if (strcmp(why, before) != 0 || is_past(&o->log_again)) {
            o->log_again = after(LOG_SECONDS);
            log_line(result == JOURNAL_HELD ? LOG_LEVEL_WARN : LOG_LEVEL_ERROR, "journal",
                     "topic=%s seq=%llu result=%s why=\"%s\"", o->frame_topic,
                     (unsigned long long)frame->info.seq,
                     result == JOURNAL_HELD   ? "held"
                     : result == JOURNAL_FULL ? "full"
                                              : "error",
                     why);
        }
    } else {
        send_event(p, o, item->event);
    }
    pthread_mutex_lock(&p->lock);
    o->busy = false;
    o->status = result;
    memcpy(o->why, why, sizeof why);
    if (result == JOURNAL_OK) {
        o->first = item->next;
        if (o->first == NULL)
            o->last = NULL;
        if (item->frame != NULL) {
            o->n_frames--;
            give_back(o, item->frame);
        } else {
            o->n_events--;
            free(item->event);
        }
        free(item);
    } else {
        o->retry = after(RETRY_SECONDS);
    }
    pthread_cond_broadcast(&p->done);
    void (*wake)(void *context) = o->wake;
    void *context = o->context;
    // The outlet cannot be freed in between: publish_close waits for `busy`.
    o->busy = true;
    pthread_mutex_unlock(&p->lock);
    wake(context);
    pthread_mutex_lock(&p->lock);
    o->busy = false;
    pthread_cond_broadcast(&p->done);
}

static void *publisher_thread(void *argument) {
    struct publisher *p = argument;
    pthread_setname_np(pthread_self(), "publish");
    pthread_mutex_lock(&p->lock);
    for (;;) {
        read_subscriptions(p);
        struct outlet *o = next_outlet(p);
        if (o != NULL) {
            work_on(p, o);
            continue;
        }
        if (p->stop)
            break;
        struct timespec until = after(p->n_awaiting > 0 ? AWAIT_SECONDS : RETRY_SECONDS);
        pthread_cond_timedwait(&p->work, &p->lock, &until);
    }
    pthread_mutex_unlock(&p->lock);
    zmq_close(p->socket); // by the thread that used it
    return NULL;
}

// ---- Start and stop ---------------------------------------------------------------------------

static void condition_init(pthread_cond_t *condition) {
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(condition, &attributes);
    pthread_condattr_destroy(&attributes);
}

// In draft interfaces of libzmq only. Without it, a socket whose ZAP handler is gone would admit
// anybody; ours is there as long as the socket.
#ifndef ZMQ_ZAP_ENFORCE_DOMAIN
#define ZMQ_ZAP_ENFORCE_DOMAIN 93
#endif

// Encrypts the socket and has zap.c asked who may subscribe.
static bool encrypt(struct publisher *p, const char *folder, char *key, char *why) {
    char secret[ZAP_KEY];
    int one = 1;
    p->zap = zap_start(p->context, folder, key, secret, why);
    if (p->zap == NULL)
        return false;
    bool set = zmq_setsockopt(p->socket, ZMQ_CURVE_SERVER, &one, sizeof one) == 0 &&
               zmq_setsockopt(p->socket, ZMQ_CURVE_SECRETKEY, secret, sizeof secret) == 0 &&
               zmq_setsockopt(p->socket, ZMQ_ZAP_DOMAIN, ZAP_DOMAIN, strlen(ZAP_DOMAIN)) == 0;
    explicit_bzero(secret, sizeof secret);
    if (!set)
        snprintf(why, JOURNAL_WHY, "--curve-dir: %s", zmq_strerror(errno));
    else if (zmq_setsockopt(p->socket, ZMQ_ZAP_ENFORCE_DOMAIN, &one, sizeof one) != 0)
        log_line(LOG_LEVEL_DEBUG, "zap", "enforced_by=handler");
    return set;
}

struct publisher *publish_start(const char *address, const char *curve_dir, char *endpoint,
                                size_t endpoint_bytes, char *key, char *why) {
    key[0] = '\0';
    struct publisher *p = calloc(1, sizeof *p);
    if (p == NULL) {
        snprintf(why, JOURNAL_WHY, "out of memory");
        return NULL;
    }
    pthread_mutex_init(&p->lock, NULL);
    condition_init(&p->work);
    condition_init(&p->done);
    int linger = LINGER_MS, high_water = SEND_HIGH_WATER, one = 1,
        v6 = strchr(address, '[') != NULL;
    p->context = zmq_ctx_new();
    p->socket = p->context != NULL ? zmq_socket(p->context, ZMQ_XPUB) : NULL;
    if (p->socket != NULL && curve_dir != NULL && !encrypt(p, curve_dir, key, why))
        goto fail;
    if (p->socket == NULL || zmq_setsockopt(p->socket, ZMQ_LINGER, &linger, sizeof linger) != 0 ||
        zmq_setsockopt(p->socket, ZMQ_SNDHWM, &high_water, sizeof high_water) != 0 ||
        zmq_setsockopt(p->socket, ZMQ_IPV6, &v6, sizeof v6) != 0 ||
        zmq_setsockopt(p->socket, ZMQ_XPUB_VERBOSER, &one, sizeof one) != 0 ||
        zmq_bind(p->socket, address) != 0 ||
        zmq_getsockopt(p->socket, ZMQ_LAST_ENDPOINT, endpoint, &endpoint_bytes) != 0) {
        snprintf(why, JOURNAL_WHY, "cannot publish on %s: %s", address, zmq_strerror(errno));
        goto fail;
    }
    int error = pthread_create(&p->thread, NULL, publisher_thread, p);
    if (error != 0) {
        snprintf(why, JOURNAL_WHY, "cannot start the output thread: %s", strerror(error));
        goto fail;
    }
    return p;
fail:
    if (p->socket != NULL)
        zmq_close(p->socket);
    if (p->context != NULL)
        zmq_ctx_term(p->context);
    zap_join(p->zap);
    free(p);
    return NULL;
}

void publish_stop(struct publisher *p) {
    if (p == NULL)
        return;
    pthread_mutex_lock(&p->lock);
    p->stop = true;
    pthread_cond_broadcast(&p->work);
    pthread_mutex_unlock(&p->lock);
    pthread_join(p->thread, NULL);
    zmq_ctx_term(p->context); // waits LINGER_MS at most for subscribers
    zap_join(p->zap);
    pthread_cond_destroy(&p->work);
    pthread_cond_destroy(&p->done);
    pthread_mutex_destroy(&p->lock);
    free(p->topics);
    free(p);
}

// ---- Outlets ----------------------------------------------------------------------------------

struct outlet *publish_open(struct publisher *publisher, const char *run, struct journal *journal,
                            void (*wake)(void *context), void *context) {
    struct outlet *o = calloc(1, sizeof *o);
    if (o == NULL)
        return NULL;
    o->publisher = publisher;
    o->journal = journal;
    o->wake = wake;
    o->context = context;
    snprintf(o->frame_topic, sizeof o->frame_topic, "run/%.64s/frame", run);
    snprintf(o->event_topic, sizeof o->event_topic, "run/%.64s/event", run);
    pthread_mutex_lock(&publisher->lock);
    o->next = publisher->outlets;
    publisher->outlets = o;
    pthread_mutex_unlock(&publisher->lock);
    return o;
}

static void item_free(struct item *item) {
    buffer_free(item->frame);
    free(item->event);
    free(item);
}

// Takes the queue of an outlet that the thread is not at work on. Called with the lock.
static struct item *take_queue(struct outlet *o) {
    while (o->busy)
        pthread_cond_wait(&o->publisher->done, &o->publisher->lock);
    struct item *first = o->first;
    o->first = o->last = NULL;
    o->n_frames = o->n_events = 0;
    return first;
}

static void queue_free(struct item *first) {
    while (first != NULL) {
        struct item *next = first->next;
        item_free(first);
        first = next;
    }
}

void publish_retire(struct outlet *o) {
    struct publisher *p = o->publisher;
    pthread_mutex_lock(&p->lock);
    struct item *first = take_queue(o);
    o->retired = true;
    while (o->n_spare > 0)
        buffer_free(o->spare[--o->n_spare]);
    for (struct outlet **link = &p->outlets; *link != NULL; link = &(*link)->next)
        if (*link == o) {
            *link = o->next;
            break;
        }
    if (p->turn == o)
        p->turn = NULL;
    p->n_awaiting -= o->awaits;
    o->awaits = false;
    pthread_mutex_unlock(&p->lock);
    queue_free(first);
}

void publish_close(struct outlet *o) {
    if (o == NULL)
        return;
    publish_retire(o);
    free(o);
}

void publish_retry(struct outlet *o) {
    pthread_mutex_lock(&o->publisher->lock);
    o->retry = after(0);
    pthread_cond_signal(&o->publisher->work);
    pthread_mutex_unlock(&o->publisher->lock);
}

bool publish_has_room(struct outlet *o) {
    if (journal_held(o->journal))
        return false;
    pthread_mutex_lock(&o->publisher->lock);
    bool room = o->n_frames < OUTLET_DEPTH;
    pthread_mutex_unlock(&o->publisher->lock);
    return room;
}

static void append(struct outlet *o, struct item *item) {
    if (o->last != NULL)
        o->last->next = item;
    else
        o->first = item;
    o->last = item;
    pthread_cond_signal(&o->publisher->work);
}

void publish_push(struct outlet *o, struct outlet_frame *frame) {
    struct item *item = calloc(1, sizeof *item);
    pthread_mutex_lock(&o->publisher->lock);
    if (item == NULL) {
        o->status = JOURNAL_ERROR;
        snprintf(o->why, sizeof o->why, "out of memory");
    } else {
        item->frame = frame;
        o->n_frames++;
        append(o, item);
    }
    pthread_mutex_unlock(&o->publisher->lock);
    if (item == NULL)
        publish_drop(o, frame);
}

void publish_event(struct outlet *o, const char *json) {
    struct item *item = calloc(1, sizeof *item);
    char *copy = strdup(json);
    pthread_mutex_lock(&o->publisher->lock);
    bool takes = item != NULL && copy != NULL && o->n_events < EVENTS_MAX;
    if (takes) {
        item->event = copy;
        o->n_events++;
        append(o, item);
    }
    pthread_mutex_unlock(&o->publisher->lock);
    if (!takes) {
        free(item);
        free(copy);
    }
}

enum journal_result publish_status(struct outlet *o, char *why) {
    pthread_mutex_lock(&o->publisher->lock);
    enum journal_result status = o->status;
    memcpy(why, o->why, sizeof o->why);
    pthread_mutex_unlock(&o->publisher->lock);
    return status;
}

bool publish_flush(struct outlet *o, double seconds) {
    struct publisher *p = o->publisher;
    struct timespec until = after(seconds < 0 ? 0 : seconds);
    pthread_mutex_lock(&p->lock);
    while (o->first != NULL && o->status != JOURNAL_ERROR) {
        if (seconds < 0)
            pthread_cond_wait(&p->done, &p->lock);
        else if (pthread_cond_timedwait(&p->done, &p->lock, &until) == ETIMEDOUT)
            break;
    }
    bool flushed = o->first == NULL && o->status != JOURNAL_ERROR;
    pthread_mutex_unlock(&p->lock);
    return flushed;
}
