// What of a run is written as JSON, and read back by the next daemon: run.json (what it is), the
// event log (what happened), the status in checkpoints (where it stood).
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/run.h"

#define HISTORY_TIME 40
void history_now(char *out); // RFC 3339, UTC, HISTORY_TIME bytes

// {"event": kind, "at": now, "step", "time"}; the caller adds to it.
cJSON *history_event(const char *kind, const struct run_status *status);

struct history_meta {
    char created[HISTORY_TIME];
    char *name;                // owned
    uint64_t wait_subscribers; // before its first frame
    char key[RUN_KEY_MAX + 1]; // Idempotency-Key of its creation, or ""
    char request[17];          // digest of the body that came with the key
    size_t n_references;
    struct run_reference *references; // owned, with their texts
};
char *history_meta_text(const char *id, const struct history_meta *meta);
bool history_meta_read(const char *text, size_t bytes, struct history_meta *out);
void history_meta_free(struct history_meta *meta);

cJSON *history_status(const struct run_status *status);
bool history_status_read(const cJSON *json, struct run_status *out);
cJSON *history_error(const struct run_error *error); // null when there is none

// A change of the configuration that the log tells of.
struct history_change {
    uint64_t number; // of its line, from 0
    uint64_t step;   // took effect after this many steps
    double time;     // s
    uint64_t frames; // frames taken by then
    cJSON *patch;
};
struct history {
    bool has_state;
    enum run_state state; // the last one logged
    uint64_t stop_step;   // where that state was to end, UINT64_MAX = nowhere
    double stop_time;     // likewise, INFINITY
    struct run_error error;
    size_t n_changes;
    struct history_change *changes;
    uint64_t epoch; // the newest one begun
};
// {"revision", "step", "time", "patch"} of a change, as the API tells it; takes the patch.
cJSON *history_change_json(uint64_t revision, uint64_t step, double time, cJSON *patch);
// The same of a line of the event log; NULL when it tells of something else.
cJSON *history_change_of(const char *line);
// False when a line is no event; `why` (JOURNAL_WHY bytes) names it.
bool history_read(const char *text, size_t bytes, struct history *out, char *why);
void history_changes_free(struct history *history); // leaves the rest
void history_free(struct history *history);
