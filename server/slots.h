// Who may run: a number of slots and a limit of memory, shared by all runs, granted first come,
// first served (a request that does not fit in memory lets later ones pass).
#pragma once
#include <stdbool.h>
#include <stddef.h>

struct slots;

// One run's part in it; zero-initialise but for `wake` and `context`. The members below the line
// are the slots' own.
struct slot {
    void (*wake)(void *context); // called, without locks, when a slot was granted to it
    void *context;
    // ----
    struct slot *next;
    size_t needs; // bytes to reserve with the slot
    bool asked, granted;
    size_t reserved;
};

struct slots *slots_create(int count, size_t memory);
void slots_free(struct slots *slots);

// Asks for a slot together with `bytes` of memory (0 when it has its memory already). Whether it is
// granted at once.
bool slots_ask(struct slots *slots, struct slot *slot, size_t bytes);
bool slots_granted(struct slots *slots, const struct slot *slot);
// Whether the slot waits for memory alone: one is free. `*left`: bytes that nobody has reserved.
bool slots_lack_memory(struct slots *slots, const struct slot *slot, size_t *left);
void slots_leave(struct slots *slots,
                 struct slot *slot); // gives the slot back, or the place in the queue
// Memory without a slot: false when it does not fit now.
bool slots_reserve(struct slots *slots, struct slot *slot, size_t bytes);
void slots_unreserve(struct slots *slots, struct slot *slot); // all that it reserved
