// The table of runs behind one lock; `making` keeps creation and deletion of folders apart.
#include "server/runs.h"

#include <ctype.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "server/log.h"

struct runs {
    const struct run_host *host;
    size_t live_max;
    pthread_mutex_t making;
    pthread_mutex_t lock; // over what follows; taken inside `making`
    struct run **items;   // oldest first
    size_t count, capacity;
    bool stopped;
};

bool runs_id_valid(const char *id) {
    size_t n = strlen(id);
    if (n == 0 || n > RUN_ID_MAX || !isalnum((unsigned char)id[0]))
        return false;
    for (size_t k = 0; k < n; k++)
        if ((unsigned char)id[k] > 127 ||
            (!isalnum((unsigned char)id[k]) && strchr("._-", id[k]) == NULL))
            return false;
    return true;
}

struct runs *runs_create(const struct run_host *host, int slots, int queue) {
    struct runs *s = calloc(1, sizeof *s);
    if (s == NULL)
        return NULL;
    s->host = host;
    s->live_max = (size_t)slots + (size_t)queue;
    pthread_mutex_init(&s->making, NULL);
    pthread_mutex_init(&s->lock, NULL);
    return s;
}

static bool append(struct runs *s, struct run *run) {
    if (s->count == s->capacity) {
        size_t larger = s->capacity < 16 ? 16 : 2 * s->capacity;
        struct run **moved = realloc(s->items, larger * sizeof(struct run *));
        if (moved == NULL)
            return false;
        s->items = moved;
        s->capacity = larger;
    }
    s->items[s->count++] = run;
    return true;
}

static int compare_created(const void *a, const void *b) {
    const struct run *one = *(struct run *const *)a, *two = *(struct run *const *)b;
    int order = strcmp(run_created(one), run_created(two));
    return order != 0 ? order : strcmp(run_id(one), run_id(two));
}

void runs_restore(struct runs *s, enum run_restore how) {
    size_t count;
    char **ids = journal_list(s->host->data_dir, &count);
    for (size_t k = 0; k < count; k++) {
        struct run *run = runs_id_valid(ids[k]) ? run_restore(s->host, ids[k], how) : NULL;
        pthread_mutex_lock(&s->lock);
        if (run != NULL && !append(s, run))
            run_release(run);
        pthread_mutex_unlock(&s->lock);
        free(ids[k]);
    }
    free(ids);
    pthread_mutex_lock(&s->lock);
    if (s->count > 0)
        qsort(s->items, s->count, sizeof(struct run *), compare_created);
    pthread_mutex_unlock(&s->lock);
}

void runs_stop(struct runs *s) {
    pthread_mutex_lock(&s->making);
    pthread_mutex_lock(&s->lock);
    s->stopped = true;
    pthread_mutex_unlock(&s->lock);
    pthread_mutex_unlock(&s->making);
    size_t count;
    struct run **all = runs_all(s, &count);
    for (size_t k = 0; k < count; k++)
        run_ask_to_stop(all[k]);
    for (size_t k = 0; k < count; k++) {
        run_join(all[k]);
        run_release(all[k]);
    }
    free(all);
}

void runs_free(struct runs *s) {
    if (s == NULL)
        return;
    for (size_t k = 0; k < s->count; k++)
        run_release(s->items[k]);
    free(s->items);
    pthread_mutex_destroy(&s->making);
    pthread_mutex_destroy(&s->lock);
    free(s);
}

// Under the lock.
static size_t find(const struct runs *s, const char *id) {
    size_t k = 0;
    while (k < s->count && strcmp(run_id(s->items[k]), id) != 0)
        k++;
    return k;
}

struct run *runs_find(struct runs *s, const char *id) {
    pthread_mutex_lock(&s->lock);
    size_t k = find(s, id);
    struct run *run = k < s->count ? s->items[k] : NULL;
    if (run != NULL)
        run_retain(run);
    pthread_mutex_unlock(&s->lock);
    return run;
}

struct run **runs_all(struct runs *s, size_t *count) {
    pthread_mutex_lock(&s->lock);
    struct run **all = calloc(s->count + 1, sizeof(struct run *));
    *count = all != NULL ? s->count : 0;
    for (size_t k = 0; k < *count; k++) {
        all[k] = s->items[k];
        run_retain(all[k]);
    }
    pthread_mutex_unlock(&s->lock);
    return all;
}

// NAME-20261122T073102Z, with a number behind when that is taken.
static void make_id(const struct runs *s, const char *name, char *out) {
    char stem[36], stamp[32];
    size_t n = 0;
    time_t now = time(NULL);
    struct tm utc;
    for (const char *c = name; *c != '\0' && n < sizeof stem - 1; c++)
        if (isalnum((unsigned char)*c) && (unsigned char)*c < 128)
            stem[n++] = (char)tolower((unsigned char)*c);
        else if (n > 0 && stem[n - 1] != '-')
            stem[n++] = '-';
    while (n > 0 && stem[n - 1] == '-')
        n--;
    stem[n] = '\0';
    gmtime_r(&now, &utc);
    strftime(stamp, sizeof stamp, "%Y%m%dT%H%M%SZ", &utc);
    snprintf(out, RUN_ID_MAX + 1, "%.40s-%.17s", n > 0 ? stem : "run", stamp);
    for (unsigned k = 2; find(s, out) < s->count; k++)
        snprintf(out, RUN_ID_MAX + 1, "%.40s-%.17s-%u", n > 0 ? stem : "run", stamp, k);
}

// Under the lock: what forbids another run of this id.
static enum runs_result admission(const struct runs *s, const char *id, char *why) {
    size_t live = 0;
    if (s->stopped) {
        snprintf(why, JOURNAL_WHY, "the daemon is ending");
        return RUNS_STOPPED;
    }
    if (find(s, id) < s->count) {
        snprintf(why, JOURNAL_WHY, "there is a run %s already", id);
        return RUNS_DUPLICATE;
    }
    for (size_t k = 0; k < s->count; k++)
        live += !run_state_is_final(run_status(s->items[k]).state);
    if (live >= s->live_max) {
        snprintf(why, JOURNAL_WHY, "%zu runs are queued, running or paused; no more than that",
                 live);
        return RUNS_FULL;
    }
    return RUNS_CREATED;
}

// Under the lock: a run that the same key has made already.
static struct run *made_with_key(const struct runs *s, const char *key) {
    for (size_t k = 0; key != NULL && k < s->count; k++)
        if (strcmp(run_key(s->items[k]), key) == 0)
            return s->items[k];
    return NULL;
}

// Under the lock.
static enum runs_result admit(const struct runs *s, const struct run_definition *definition,
                              const char *id, struct run **out, char *why) {
    struct run *earlier = made_with_key(s, definition->key);
    if (earlier == NULL)
        return admission(s, id, why);
    if (strcmp(run_request(earlier), definition->request) == 0) {
        *out = earlier;
        run_retain(earlier);
        return RUNS_THERE;
    }
    snprintf(why, JOURNAL_WHY, "the key was used already, with another body, for run %s",
             run_id(earlier));
    return RUNS_KEY_REUSED;
}

enum runs_result runs_admit(struct runs *s, const struct run_definition *definition,
                            struct run **out, char *why) {
    pthread_mutex_lock(&s->lock);
    const enum runs_result result =
        admit(s, definition, definition->id != NULL ? definition->id : "", out, why);
    pthread_mutex_unlock(&s->lock);
    return result;
}

enum runs_result runs_add(struct runs *s, const struct run_definition *definition, struct run **out,
                          char *why) {
    char id[RUN_ID_MAX + 1];
    struct run_definition named = *definition;
    pthread_mutex_lock(&s->making);
    pthread_mutex_lock(&s->lock);
    for (size_t k = 0; k < s->count && !s->stopped; k++)
        run_reap(s->items[k]);
    if (definition->id == NULL)
        make_id(s, definition->name, id);
    else
        snprintf(id, sizeof id, "%s", definition->id);
    named.id = id;
    enum runs_result result = admit(s, definition, id, out, why);
    pthread_mutex_unlock(&s->lock);
    if (result == RUNS_CREATED) {
        bool storage;
        *out = run_create(s->host, &named, &storage, why);
        if (*out == NULL)
            result = storage ? RUNS_STORAGE : RUNS_MEMORY;
    }
    if (result == RUNS_CREATED) {
        pthread_mutex_lock(&s->lock);
        run_retain(*out);
        if (!append(s, *out))
            log_error("memory", "run=%s is not in the table", id); // its folder is; and it runs
        pthread_mutex_unlock(&s->lock);
    }
    pthread_mutex_unlock(&s->making);
    if (result == RUNS_CREATED)
        run_bell_ring(s->host->bell);
    return result;
}

enum runs_removal runs_remove(struct runs *s, const char *id, enum run_state *state, char *why) {
    enum runs_removal result = RUNS_REMOVED;
    struct run *run = NULL;
    pthread_mutex_lock(&s->making);
    pthread_mutex_lock(&s->lock);
    size_t k = find(s, id);
    if (k == s->count) {
        result = RUNS_MISSING;
    } else {
        *state = run_status(s->items[k]).state;
        if (!run_state_is_final(*state))
            result = RUNS_ALIVE;
    }
    if (result == RUNS_REMOVED) {
        run = s->items[k];
        memmove(s->items + k, s->items + k + 1, (s->count - k - 1) * sizeof(struct run *));
        s->count--;
    }
    pthread_mutex_unlock(&s->lock); // out of the table, then off the disk, which can take its time
    if (run != NULL && journal_remove(s->host->data_dir, id, why) != 0) {
        result = RUNS_REMOVAL_FAILED;
        pthread_mutex_lock(&s->lock); // `making` is still held: its room is still there
        memmove(s->items + k + 1, s->items + k, (s->count - k) * sizeof(struct run *));
        s->items[k] = run;
        s->count++;
        pthread_mutex_unlock(&s->lock);
        run = NULL;
    }
    pthread_mutex_unlock(&s->making);
    if (run != NULL) {
        log_info("deleted", "run=%s", id);
        run_bell_ring(s->host->bell);
    }
    run_release(run);
    return result;
}

bool runs_ready(struct runs *s, char *why) {
    pthread_mutex_lock(&s->lock);
    bool ready = admission(s, "", why) == RUNS_CREATED;
    pthread_mutex_unlock(&s->lock);
    return ready && journal_has_room(s->host->data_dir, why);
}
