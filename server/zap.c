// A REP socket at inproc://zeromq.zap.01, as RFC 27 has it, and a thread that answers there until
// the context ends.
#include "server/zap.h"

#include <dirent.h>
#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <zmq.h>

#include "server/journal.h"
#include "server/log.h"

#define ZAP_FRAMES 7 // version, request, domain, address, identity, mechanism, key
#define ZAP_FRAME 256
#define ZAP_RAW_KEY 32

struct zap {
    pthread_t thread;
    void *socket;
    char clients[4096];
};

// The key in a file: one line of 40 characters of Z85.
static bool read_key(const char *path, char *out, char *why) {
    char text[128];
    unsigned char raw[ZAP_RAW_KEY];
    FILE *file = fopen(path, "re");
    if (file == NULL) {
        snprintf(why, JOURNAL_WHY, "%.400s: %s", path, strerror(errno));
        return false;
    }
    size_t n = fread(text, 1, sizeof text - 1, file);
    fclose(file);
    while (n > 0 && strchr(" \t\r\n", text[n - 1]) != NULL)
        n--;
    text[n] = '\0';
    if (n != ZAP_KEY - 1 || zmq_z85_decode(raw, text) == NULL) {
        snprintf(why, JOURNAL_WHY,
                 "%.400s: must hold a key of %d characters (Z85), has %zu; fbar keygen makes one",
                 path, ZAP_KEY - 1, n);
        return false;
    }
    memcpy(out, text, ZAP_KEY);
    return true;
}

static bool is_client(const struct zap *z, const char *key, char *name, size_t name_bytes) {
    char path[4096 + 300], other[ZAP_KEY], why[JOURNAL_WHY];
    bool found = false;
    DIR *folder = opendir(z->clients);
    if (folder == NULL) {
        log_error("zap", "folder=\"%s\" why=\"%s\"", z->clients, strerror(errno));
        return false;
    }
    for (const struct dirent *entry; !found && (entry = readdir(folder)) != NULL;) {
        const char *end = strstr(entry->d_name, ".public");
        if (end == NULL || strcmp(end, ".public") != 0 || entry->d_name[0] == '.')
            continue;
        snprintf(path, sizeof path, "%s/%s", z->clients, entry->d_name);
        if (!read_key(path, other, why))
            log_warn("zap", "why=\"%s\"", why);
        else
            found = strcmp(other, key) == 0;
        if (found)
            snprintf(name, name_bytes, "%.*s", (int)(end - entry->d_name), entry->d_name);
    }
    closedir(folder);
    return found;
}

// One request. False when the context ends.
static bool answer(const struct zap *z) {
    unsigned char frames[ZAP_FRAMES][ZAP_FRAME];
    size_t bytes[ZAP_FRAMES] = {0};
    int count = 0, more = 1;
    for (; more != 0; count++) {
        unsigned char rest[ZAP_FRAME];
        int n = zmq_recv(z->socket, count < ZAP_FRAMES ? frames[count] : rest, ZAP_FRAME, 0);
        size_t size = sizeof more;
        if (n < 0)
            return errno != ETERM && errno != ENOTSOCK;
        if (count < ZAP_FRAMES)
            bytes[count] = (size_t)n < ZAP_FRAME ? (size_t)n : ZAP_FRAME;
        zmq_getsockopt(z->socket, ZMQ_RCVMORE, &more, &size);
    }
    char key[ZAP_KEY] = "", name[256] = "";
    bool ours = count == ZAP_FRAMES && bytes[2] == strlen(ZAP_DOMAIN) &&
                memcmp(frames[2], ZAP_DOMAIN, bytes[2]) == 0 && bytes[5] == 5 &&
                memcmp(frames[5], "CURVE", 5) == 0 && bytes[6] == ZAP_RAW_KEY;
    if (ours)
        zmq_z85_encode(key, frames[6], ZAP_RAW_KEY);
    bool allowed = ours && is_client(z, key, name, sizeof name);
    if (allowed)
        log_info("subscriber", "name=\"%s\" address=%.*s", name, (int)bytes[3],
                 (const char *)frames[3]);
    else
        log_warn("subscriber_refused", "key=\"%s\" address=%.*s", key, (int)bytes[3],
                 (const char *)frames[3]);
    zmq_send(z->socket, "1.0", 3, ZMQ_SNDMORE);
    zmq_send(z->socket, frames[1], bytes[1], ZMQ_SNDMORE);
    zmq_send(z->socket, allowed ? "200" : "400", 3, ZMQ_SNDMORE);
    zmq_send(z->socket, allowed ? "OK" : "unknown key", allowed ? 2 : 11, ZMQ_SNDMORE);
    zmq_send(z->socket, name, strlen(name), ZMQ_SNDMORE);
    zmq_send(z->socket, "", 0, 0);
    return true;
}

static void *zap_thread(void *argument) {
    struct zap *z = argument;
    pthread_setname_np(pthread_self(), "zap");
    while (answer(z))
        continue;
    zmq_close(z->socket);
    return NULL;
}

struct zap *zap_start(void *context, const char *folder, char *public_key, char *secret_key,
                      char *why) {
    char path[4096 + 32];
    struct stat info;
    struct zap *z = calloc(1, sizeof *z);
    int no_linger = 0;
    if (z == NULL) {
        snprintf(why, JOURNAL_WHY, "out of memory");
        return NULL;
    }
    if (!zmq_has("curve")) {
        snprintf(why, JOURNAL_WHY, "--curve-dir: this libzmq was built without CURVE");
        goto fail;
    }
    snprintf(path, sizeof path, "%s/server.public", folder);
    if (!read_key(path, public_key, why))
        goto fail;
    snprintf(path, sizeof path, "%s/server.secret", folder);
    if (!read_key(path, secret_key, why))
        goto fail;
    if (stat(path, &info) == 0 && (info.st_mode & 077) != 0) {
        snprintf(why, JOURNAL_WHY, "%.400s: others can read it: chmod 600", path);
        goto fail;
    }
    snprintf(z->clients, sizeof z->clients, "%.4000s/clients", folder);
    if (stat(z->clients, &info) != 0 || !S_ISDIR(info.st_mode)) {
        snprintf(why, JOURNAL_WHY,
                 "%.400s: must be a folder with the keys of those who may subscribe", z->clients);
        goto fail;
    }
    z->socket = zmq_socket(context, ZMQ_REP);
    if (z->socket == NULL ||
        zmq_setsockopt(z->socket, ZMQ_LINGER, &no_linger, sizeof no_linger) != 0 ||
        zmq_bind(z->socket, "inproc://zeromq.zap.01") != 0) {
        snprintf(why, JOURNAL_WHY, "--curve-dir: %s", zmq_strerror(errno));
        goto fail;
    }
    if (pthread_create(&z->thread, NULL, zap_thread, z) == 0)
        return z;
    snprintf(why, JOURNAL_WHY, "cannot start the thread that admits subscribers");
fail:
    if (z->socket != NULL)
        zmq_close(z->socket);
    free(z);
    return NULL;
}

void zap_join(struct zap *z) {
    if (z == NULL)
        return;
    pthread_join(z->thread, NULL);
    free(z);
}
