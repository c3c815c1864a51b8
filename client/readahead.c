// Two slots go round between the thread that fills them and the caller that empties them; buffers
// are swapped, not copied.
#include "client/readahead.h"

#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>

#define SLOTS 2

struct slot {
    struct framelog_record record;
    unsigned char *payload; // the slot's own buffer
    size_t capacity;
};

struct readahead {
    struct framelog *log;
    pthread_t thread;
    pthread_mutex_t lock; // over what follows
    pthread_cond_t moved;
    struct slot slots[SLOTS];
    size_t filled, emptied; // slots so far
    bool given;             // the slot `emptied` is with the caller
    bool over, stop;
    int end; // what framelog_read gave in the end: 0 or -1, with
    char why[512];
};

static void *fill(void *argument) {
    struct readahead *a = argument;
    uint64_t cut;
    for (;;) {
        struct framelog_record record;
        const int got = framelog_read(a->log, &record, &cut, a->why, sizeof a->why);
        pthread_mutex_lock(&a->lock);
        while (got == 1 && a->filled - a->emptied == SLOTS && !a->stop)
            pthread_cond_wait(&a->moved, &a->lock);
        const bool ends = got != 1 || a->stop;
        if (!ends) {
            struct slot *slot = &a->slots[a->filled++ % SLOTS];
            framelog_swap(a->log, &slot->payload, &slot->capacity);
            slot->record = record;
            slot->record.payload = slot->payload;
        } else {
            a->end = got == 1 ? 0 : got;
            a->over = true;
        }
        pthread_cond_signal(&a->moved);
        pthread_mutex_unlock(&a->lock);
        if (ends)
            return NULL;
    }
}

struct readahead *readahead_open(struct framelog *log) {
    struct readahead *a = calloc(1, sizeof *a);
    if (!a)
        return NULL;
    a->log = log;
    framelog_rewind(log);
    pthread_mutex_init(&a->lock, NULL);
    pthread_cond_init(&a->moved, NULL);
    if (pthread_create(&a->thread, NULL, fill, a) == 0)
        return a;
    pthread_mutex_destroy(&a->lock);
    pthread_cond_destroy(&a->moved);
    free(a);
    return NULL;
}

int readahead_next(struct readahead *a, struct framelog_record *out, char *why, size_t why_bytes) {
    int got = 1;
    pthread_mutex_lock(&a->lock);
    if (a->given) {
        a->given = false;
        a->emptied++;
        pthread_cond_signal(&a->moved);
    }
    while (a->filled == a->emptied && !a->over)
        pthread_cond_wait(&a->moved, &a->lock);
    if (a->filled > a->emptied) {
        *out = a->slots[a->emptied % SLOTS].record;
        a->given = true;
    } else {
        got = a->end;
        snprintf(why, why_bytes, "%s", a->why);
    }
    pthread_mutex_unlock(&a->lock);
    return got;
}

void readahead_close(struct readahead *a) {
    if (!a)
        return;
    pthread_mutex_lock(&a->lock);
    a->stop = true;
    pthread_cond_signal(&a->moved);
    pthread_mutex_unlock(&a->lock);
    pthread_join(a->thread, NULL);
    for (size_t i = 0; i < SLOTS; i++)
        free(a->slots[i].payload);
    pthread_mutex_destroy(&a->lock);
    pthread_cond_destroy(&a->moved);
    free(a);
}
