// Recording a run without loss: subscribe, repair gaps over HTTP, log, then build FILE.h5.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "client/client.h"

struct recorder_options {
    const char *run, *file; // borrowed
    int compress;           // 0, or the deflate level
    double patience_s;      // how long an unreachable daemon is waited for
    bool progress;          // show the run's progress while recording
    // What the first Ctrl-C asks of the daemon: "pause", "cancel", or NULL (only the recording
    // ends).
    const char *on_interrupt;
};

struct recorder_result {
    size_t n_frames;
    uint64_t bytes;              // of FILE.h5
    bool complete, was_complete; // was_complete: there was nothing left to do
    size_t repaired;             // frames that came over HTTP
};

// Returns an exit code, with every fault printed. CLIENT_INTERRUPTED and CLIENT_UNREACHABLE leave a
// file of what is there and the log, from which the same call goes on.
int recorder_record(struct client *client, const struct recorder_options *options,
                    struct recorder_result *result);

// The name under which a recording into `file` is known to the daemon: the same command is the same
// recorder. RECORDER_NAME bytes.
#define RECORDER_NAME 40
void recorder_name(const char *file, char *out);

// Whether the file may take a recording of `run`: CLIENT_DONE, otherwise the fault is printed. To
// be asked before a run is created.
int recorder_check_file(const char *file, const char *run);
