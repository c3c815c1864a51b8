// Who records a run, and how far: frames that one of them has not acknowledged stay in the journal.
// The list outlives the daemon (recorders.json), because a recorder that is away for a while counts
// on it; an acknowledgement that a kill takes back only keeps frames longer than needed.
//
// Any thread may call. Functions that fail write one sentence to `why` (JOURNAL_WHY bytes).
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/journal.h"

#define RECORDERS_MAX 64
#define RECORDER_NAME_MAX 64

struct recorder {
    char name[RECORDER_NAME_MAX + 1];
    int64_t acked; // all frames up to this one are safe with it; -1: none
    double heard;  // s ago
};

struct recorders;

// Reads what an earlier daemon left and tells the journal (borrowed) what to keep. NULL without
// memory or when the file is damaged.
struct recorders *recorders_open(struct journal *journal, char *why);
void recorders_free(struct recorders *recorders);

enum recorders_result {
    RECORDERS_OK,
    RECORDERS_TOO_MANY,
    RECORDERS_UNKNOWN, // no such recorder
    RECORDERS_AHEAD,   // the frame that it acknowledges is not there
    RECORDERS_STORAGE, // the list cannot be written: nothing has changed
};
// Registers, or moves the acknowledgement of one that is registered. Once it returns RECORDERS_OK a
// registration survives a restart.
enum recorders_result recorders_put(struct recorders *recorders, const char *name, int64_t acked,
                                    char *why);
enum recorders_result recorders_remove(struct recorders *recorders, const char *name, char *why);
// Copies up to RECORDERS_MAX of them, in the order of their registration; their number.
size_t recorders_list(struct recorders *recorders, struct recorder *out);
// The one that is furthest behind: false when there is none.
bool recorders_slowest(struct recorders *recorders, struct recorder *out);
