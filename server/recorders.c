// A short list behind one lock. Registrations are written before they are answered, in one file
// that is replaced as a whole; acknowledgements at most once a second.
#include "server/recorders.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "server/json.h"

#define FILE_NAME "recorders.json"
#define FILE_FORMAT "fbard-recorders-1"
#define SAVE_SECONDS 1.0 // between two writes of mere acknowledgements

struct recorders {
    struct journal *journal;
    pthread_mutex_t lock; // over what follows; the journal's is taken inside
    struct recorder items[RECORDERS_MAX];
    size_t count;
    double saved; // when the file was written
};

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// Tells the journal the first frame that somebody still needs.
static void keep(struct recorders *r) {
    uint64_t from = UINT64_MAX;
    for (size_t k = 0; k < r->count; k++) {
        uint64_t needs = (uint64_t)(r->items[k].acked + 1);
        from = needs < from ? needs : from;
    }
    journal_keep(r->journal, from);
}

static enum journal_result save(struct recorders *r, char *why) {
    cJSON *json = cJSON_CreateObject();
    cJSON_AddStringToObject(json, "format", FILE_FORMAT);
    cJSON *list = cJSON_AddArrayToObject(json, "recorders");
    for (size_t k = 0; k < r->count; k++) {
        cJSON *item = cJSON_CreateObject();
        cJSON_AddStringToObject(item, "name", r->items[k].name);
        cJSON_AddItemToObject(item, "acked", json_number((double)r->items[k].acked));
        cJSON_AddItemToArray(list, item);
    }
    char *text = json_print(json, true);
    enum journal_result result = JOURNAL_ERROR;
    snprintf(why, JOURNAL_WHY, "out of memory");
    if (text != NULL)
        result = journal_replace(r->journal, FILE_NAME, text, strlen(text), why);
    free(text);
    cJSON_Delete(json);
    if (result == JOURNAL_OK)
        r->saved = now();
    return result;
}

static bool load(struct recorders *r, const char *text, size_t bytes) {
    struct faults faults = {0};
    cJSON *json = json_parse(text, bytes, &faults);
    const char *format = cJSON_GetStringValue(json_member(json, "format"));
    bool valid = format != NULL && strcmp(format, FILE_FORMAT) == 0;
    const cJSON *item;
    cJSON_ArrayForEach(item, json_member(json, "recorders")) {
        const char *name = cJSON_GetStringValue(json_member(item, "name"));
        const cJSON *acked = json_member(item, "acked");
        valid = valid && name != NULL && cJSON_IsNumber(acked) && r->count < RECORDERS_MAX;
        if (!valid)
            break;
        struct recorder *to = &r->items[r->count++];
        *to = (struct recorder){.acked = (int64_t)acked->valuedouble, .heard = now()};
        snprintf(to->name, sizeof to->name, "%s", name);
    }
    cJSON_Delete(json);
    faults_free(&faults);
    return valid;
}

struct recorders *recorders_open(struct journal *journal, char *why) {
    struct recorders *r = calloc(1, sizeof *r);
    size_t bytes;
    if (r == NULL) {
        snprintf(why, JOURNAL_WHY, "out of memory");
        return NULL;
    }
    r->journal = journal;
    pthread_mutex_init(&r->lock, NULL);
    char *text = journal_text(journal, FILE_NAME, &bytes);
    if (text != NULL && !load(r, text, bytes)) {
        snprintf(why, JOURNAL_WHY, FILE_NAME " is damaged");
        free(text);
        recorders_free(r);
        return NULL;
    }
    free(text);
    keep(r);
    return r;
}

void recorders_free(struct recorders *r) {
    if (r == NULL)
        return;
    pthread_mutex_destroy(&r->lock);
    free(r);
}

static size_t find(const struct recorders *r, const char *name) {
    size_t k = 0;
    while (k < r->count && strcmp(r->items[k].name, name) != 0)
        k++;
    return k;
}

enum recorders_result recorders_put(struct recorders *r, const char *name, int64_t acked,
                                    char *why) {
    enum recorders_result result = RECORDERS_OK;
    uint64_t frames = journal_n_frames(r->journal);
    pthread_mutex_lock(&r->lock);
    size_t k = find(r, name);
    bool known = k < r->count;
    if (acked >= (int64_t)frames) {
        snprintf(why, JOURNAL_WHY, "%llu", (unsigned long long)frames);
        result = RECORDERS_AHEAD;
    } else if (!known && r->count == RECORDERS_MAX) {
        snprintf(why, JOURNAL_WHY, "the run has %d recorders already", RECORDERS_MAX);
        result = RECORDERS_TOO_MANY;
    } else {
        struct recorder before = r->items[known ? k : 0];
        struct recorder *to = &r->items[k];
        // A recorder that goes back, because it lost its file, needs more than it said before.
        bool needs_file = !known || acked < to->acked || now() - r->saved > SAVE_SECONDS;
        *to = (struct recorder){.acked = acked, .heard = now()};
        snprintf(to->name, sizeof to->name, "%s", name);
        r->count += !known;
        bool must = !known || acked < before.acked;
        if (needs_file && save(r, why) != JOURNAL_OK && must) {
            r->count -= !known;
            if (known)
                r->items[k] = before;
            result = RECORDERS_STORAGE;
        }
        keep(r);
    }
    pthread_mutex_unlock(&r->lock);
    return result;
}

enum recorders_result recorders_remove(struct recorders *r, const char *name, char *why) {
    enum recorders_result result = RECORDERS_UNKNOWN;
    pthread_mutex_lock(&r->lock);
    size_t k = find(r, name);
    if (k < r->count) {
        struct recorder gone = r->items[k];
        memmove(r->items + k, r->items + k + 1, (r->count - k - 1) * sizeof gone);
        r->count--;
        result = RECORDERS_OK;
        if (save(r, why) != JOURNAL_OK) { // else it would hold the run back after a restart
            memmove(r->items + k + 1, r->items + k, (r->count - k) * sizeof gone);
            r->items[k] = gone;
            r->count++;
            result = RECORDERS_STORAGE;
        }
        keep(r);
    }
    pthread_mutex_unlock(&r->lock);
    return result;
}

size_t recorders_list(struct recorders *r, struct recorder *out) {
    double t = now();
    pthread_mutex_lock(&r->lock);
    size_t n = r->count;
    for (size_t k = 0; k < n; k++) {
        out[k] = r->items[k];
        out[k].heard = fmax(t - out[k].heard, 0);
    }
    pthread_mutex_unlock(&r->lock);
    return n;
}

bool recorders_slowest(struct recorders *r, struct recorder *out) {
    struct recorder all[RECORDERS_MAX];
    size_t n = recorders_list(r, all);
    for (size_t k = 0; k < n; k++)
        if (k == 0 || all[k].acked < out->acked)
            *out = all[k];
    return n > 0;
}
