// The inside of a recording in progress, for the files recorder*.c only.
#pragma once
#include <cjson/cJSON.h>

#include "client/frameinfo.h"
#include "client/framelog.h"
#include "client/recorder.h"
#include "client/request.h"
#include "client/subscribe.h"

// How a step of the recording went: AWAY, the daemon is not there; OVER, there is no more; LOST and
// DISK are final, and the fault is printed.
enum recorder_outcome { RECORDER_GOOD, RECORDER_AWAY, RECORDER_OVER, RECORDER_LOST, RECORDER_DISK };

struct recorder {
    struct client *client;
    const struct recorder_options *options;
    struct recorder_result *result;
    struct framelog *log;
    struct subscription *subscription;
    char *log_name;
    char created[64], code_version[64], publish[256], name[RECORDER_NAME];
    uint64_t *digests; // of the frames in the log, by seq
    uint64_t next;     // seq of the next frame
    size_t capacity;
    uint64_t synced_frames, synced_bytes;
    double synced_at, heard_at, shown_at, indexed_at, polled_step;
    int interrupts; // that were heeded; one more ends what waits
    bool has_scene, complete, ended, registered, no_recorders;
    char why[512];
};

double recorder_now(void);                                      // monotonic seconds
enum recorder_outcome recorder_disk(struct recorder *recorder); // prints `why`

// ---- recorder_daemon.c: what it says to the daemon
// A GET of /v1/runs/{id}<after>: GOOD with the reply of any status, or AWAY.
enum recorder_outcome recorder_get(struct recorder *recorder, const char *after, const char *accept,
                                   struct reply *out);
// LOST, with the fault printed, where the status is not 200.
enum recorder_outcome recorder_get_json(struct recorder *recorder, const char *after, cJSON **out);
const char *recorder_text(const cJSON *object, const char *key); // "" where there is none
// Learns the publisher from GET /v1 and subscribes, anew where it has moved.
enum recorder_outcome recorder_connect(struct recorder *recorder);
// Registers, or tells the daemon that all before `next` is durable here.
void recorder_acknowledge(struct recorder *recorder, uint64_t next);
void recorder_unregister(struct recorder *recorder);

// ---- recorder_log.c: what it writes
// Reads a log that a former recording left. *empty: there is nothing in it.
enum recorder_outcome recorder_resume_log(struct recorder *recorder, bool *empty);
enum recorder_outcome recorder_start_log(struct recorder *recorder);
// A frame that was checked: the next one is kept, an earlier one must be the same again.
enum recorder_outcome recorder_take(struct recorder *recorder, const struct frameinfo *info,
                                    const void *frame);
// On GOOD all that was taken is on the disk, and acknowledged.
enum recorder_outcome recorder_make_durable(struct recorder *recorder);
// Scene and probes as far as they are known.
enum recorder_outcome recorder_append_texts(struct recorder *recorder);
// Every frame is in the log; the rest of it is asked once the daemon calls the run over. GOOD
// without `complete`: interrupted before.
enum recorder_outcome recorder_complete_log(struct recorder *recorder);
