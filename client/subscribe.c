// Messages are two parts, topic `run/<id>/frame` or `run/<id>/event` and body; others are passed
// over.
#include "client/subscribe.h"

#include <errno.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zmq.h>

// Frames that may wait here; more would only hold memory, since lost ones are fetched over HTTP.
#define HIGH_WATER_MARK 8

struct subscription {
    void *context, *socket;
    zmq_msg_t body;
    char frame_topic[96], event_topic[96];
};

int subscribe_keypair(char *public, char *secret) {
    return zmq_curve_keypair(public, secret) == 0 ? 0 : -1;
}

static bool is_key(const char *text) {
    unsigned char raw[32];
    return strlen(text) == SUBSCRIBE_KEY - 1 && zmq_z85_decode(raw, text) != NULL;
}

int subscribe_keys_read(const char *path, struct subscribe_keys *out, char *why, size_t why_bytes) {
    char line[256], name[32], value[128];
    FILE *file = fopen(path, "re");
    *out = (struct subscribe_keys){0};
    if (!file) {
        snprintf(why, why_bytes, "%s: %s", path, strerror(errno));
        return -1;
    }
    while (fgets(line, sizeof line, file)) {
        if (sscanf(line, "%31s %127s", name, value) != 2 || !is_key(value))
            continue; // a comment, or what keys_complete misses below
        char *to = strcmp(name, "server") == 0   ? out->server
                   : strcmp(name, "public") == 0 ? out->public
                   : strcmp(name, "secret") == 0 ? out->secret
                                                 : NULL;
        if (to)
            memcpy(to, value, SUBSCRIBE_KEY);
    }
    fclose(file);
    if (*out->server && *out->public && *out->secret)
        return 0;
    snprintf(
        why, why_bytes,
        "%s: must have the lines \"server KEY\", \"public KEY\" and \"secret KEY\", keys of %d "
        "characters (Z85); lacks %s; fbar keygen makes it",
        path, SUBSCRIBE_KEY - 1,
        !*out->server   ? "server"
        : !*out->public ? "public"
                        : "secret");
    return -1;
}

static bool encrypt(void *socket, const struct subscribe_keys *keys) {
    return zmq_setsockopt(socket, ZMQ_CURVE_SERVERKEY, keys->server, SUBSCRIBE_KEY) == 0 &&
           zmq_setsockopt(socket, ZMQ_CURVE_PUBLICKEY, keys->public, SUBSCRIBE_KEY) == 0 &&
           zmq_setsockopt(socket, ZMQ_CURVE_SECRETKEY, keys->secret, SUBSCRIBE_KEY) == 0;
}

struct subscription *subscribe_open(const char *endpoint, const char *run,
                                    const struct subscribe_keys *keys, char *why,
                                    size_t why_bytes) {
    struct subscription *s = calloc(1, sizeof *s);
    if (!s) {
        snprintf(why, why_bytes, "out of memory");
        return NULL;
    }
    snprintf(s->frame_topic, sizeof s->frame_topic, "run/%s/frame", run);
    snprintf(s->event_topic, sizeof s->event_topic, "run/%s/event", run);
    zmq_msg_init(&s->body);
    const int limit = HIGH_WATER_MARK, no_linger = 0;
    s->context = zmq_ctx_new();
    s->socket = s->context ? zmq_socket(s->context, ZMQ_SUB) : NULL;
    if (!s->socket || zmq_setsockopt(s->socket, ZMQ_RCVHWM, &limit, sizeof limit) != 0 ||
        zmq_setsockopt(s->socket, ZMQ_LINGER, &no_linger, sizeof no_linger) != 0 ||
        (keys && !encrypt(s->socket, keys)) ||
        zmq_setsockopt(s->socket, ZMQ_SUBSCRIBE, s->frame_topic, strlen(s->frame_topic)) != 0 ||
        zmq_setsockopt(s->socket, ZMQ_SUBSCRIBE, s->event_topic, strlen(s->event_topic)) != 0 ||
        zmq_connect(s->socket, endpoint) != 0) {
        snprintf(why, why_bytes, "%s: %s", endpoint, zmq_strerror(zmq_errno()));
        subscribe_close(s);
        return NULL;
    }
    return s;
}

void subscribe_close(struct subscription *s) {
    if (!s)
        return;
    zmq_msg_close(&s->body);
    if (s->socket)
        zmq_close(s->socket);
    if (s->context)
        zmq_ctx_term(s->context);
    free(s);
}

static bool has_more(struct subscription *s) {
    int more = 0;
    size_t n = sizeof more;
    return zmq_getsockopt(s->socket, ZMQ_RCVMORE, &more, &n) == 0 && more;
}

enum subscribe_kind subscribe_receive(struct subscription *s, int timeout_ms, const void **body,
                                      size_t *bytes) {
    char topic[96];
    zmq_pollitem_t item = {.socket = s->socket, .events = ZMQ_POLLIN};
    const int ready = zmq_poll(&item, 1, timeout_ms);
    if (ready <= 0)
        return ready == 0 || zmq_errno() == EINTR ? SUBSCRIBE_NOTHING : SUBSCRIBE_ERROR;
    const int n = zmq_recv(s->socket, topic, sizeof topic - 1, ZMQ_DONTWAIT);
    if (n < 0)
        return zmq_errno() == EINTR || zmq_errno() == EAGAIN ? SUBSCRIBE_NOTHING : SUBSCRIBE_ERROR;
    topic[(size_t)n < sizeof topic ? (size_t)n : sizeof topic - 1] = '\0';

    enum subscribe_kind kind = SUBSCRIBE_NOTHING;
    if (has_more(s)) {
        if (zmq_msg_recv(&s->body, s->socket, 0) < 0)
            return SUBSCRIBE_NOTHING;
        if (strcmp(topic, s->frame_topic) == 0)
            kind = SUBSCRIBE_FRAME;
        else if (strcmp(topic, s->event_topic) == 0)
            kind = SUBSCRIBE_EVENT;
    }
    zmq_msg_t rest;
    while (has_more(s)) { // parts that a later version may add
        zmq_msg_init(&rest);
        zmq_msg_recv(&rest, s->socket, 0);
        zmq_msg_close(&rest);
    }
    *body = zmq_msg_data(&s->body);
    *bytes = zmq_msg_size(&s->body);
    return kind;
}
