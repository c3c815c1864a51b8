// A queue behind one lock. Slots are few and asked for seldom; a list is enough.
#include "server/slots.h"

#include <pthread.h>
#include <stdlib.h>

struct slots {
    pthread_mutex_t lock;
    int free;
    size_t memory, used;
    struct slot *queue; // first come first
};

struct slots *slots_create(int count, size_t memory) {
    struct slots *s = calloc(1, sizeof *s);
    if (s == NULL)
        return NULL;
    pthread_mutex_init(&s->lock, NULL);
    s->free = count;
    s->memory = memory;
    return s;
}

void slots_free(struct slots *s) {
    if (s == NULL)
        return;
    pthread_mutex_destroy(&s->lock);
    free(s);
}

static bool fits(const struct slots *s, size_t bytes) {
    return bytes <= s->memory && s->used <= s->memory - bytes;
}

// Grants what can be granted; returns one that is to be woken, or NULL. Called until it is NULL.
static struct slot *grant_next(struct slots *s) {
    for (struct slot **link = &s->queue; s->free > 0 && *link != NULL; link = &(*link)->next) {
        struct slot *slot = *link;
        if (!fits(s, slot->needs))
            continue;
        *link = slot->next;
        s->free--;
        s->used += slot->needs;
        slot->reserved += slot->needs;
        slot->asked = false;
        slot->granted = true;
        return slot;
    }
    return NULL;
}

static void grant_all(struct slots *s, const struct slot *not_woken) {
    pthread_mutex_lock(&s->lock);
    for (struct slot *slot; (slot = grant_next(s)) != NULL;)
        // Under the lock, so that the run cannot leave and be freed in between: a run's wake only
        // takes its own lock, and no run asks for slots with that held.
        if (slot != not_woken)
            slot->wake(slot->context);
    pthread_mutex_unlock(&s->lock);
}

bool slots_ask(struct slots *s, struct slot *slot, size_t bytes) {
    pthread_mutex_lock(&s->lock);
    if (!slot->asked && !slot->granted) {
        struct slot **link = &s->queue;
        while (*link != NULL)
            link = &(*link)->next;
        slot->next = NULL;
        slot->needs = bytes;
        slot->asked = true;
        *link = slot;
    }
    pthread_mutex_unlock(&s->lock);
    grant_all(s, slot);
    return slots_granted(s, slot);
}

bool slots_granted(struct slots *s, const struct slot *slot) {
    pthread_mutex_lock(&s->lock);
    bool granted = slot->granted;
    pthread_mutex_unlock(&s->lock);
    return granted;
}

bool slots_lack_memory(struct slots *s, const struct slot *slot, size_t *left) {
    pthread_mutex_lock(&s->lock);
    *left = s->used < s->memory ? s->memory - s->used : 0;
    bool lacks = slot->asked && s->free > 0 && !fits(s, slot->needs);
    pthread_mutex_unlock(&s->lock);
    return lacks;
}

void slots_leave(struct slots *s, struct slot *slot) {
    pthread_mutex_lock(&s->lock);
    for (struct slot **link = &s->queue; *link != NULL; link = &(*link)->next)
        if (*link == slot) {
            *link = slot->next;
            break;
        }
    if (slot->granted)
        s->free++;
    slot->asked = slot->granted = false;
    pthread_mutex_unlock(&s->lock);
    grant_all(s, slot);
}

bool slots_reserve(struct slots *s, struct slot *slot, size_t bytes) {
    pthread_mutex_lock(&s->lock);
    bool fit = fits(s, bytes);
    if (fit) {
        s->used += bytes;
        slot->reserved += bytes;
    }
    pthread_mutex_unlock(&s->lock);
    return fit;
}

void slots_unreserve(struct slots *s, struct slot *slot) {
    pthread_mutex_lock(&s->lock);
    s->used -= slot->reserved;
    slot->reserved = 0;
    pthread_mutex_unlock(&s->lock);
    grant_all(s, slot);
}
