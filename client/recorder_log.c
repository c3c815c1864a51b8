// What a recording writes to its log: frames as they come, and the texts at the end.
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <xxhash.h>

#include "client/interrupt.h"
#include "client/progress.h"
#include "client/recorder_inside.h"
#include "client/terminal.h"

#define LOG_FORMAT "fbard-recording-log-1"
#define TELL_S 10.0 // of waiting for the end of a run whose last frame is there

// ---- Frames into the log ----------------------------------------------------------------------

static enum recorder_outcome remember(struct recorder *r, const struct frameinfo *info) {
    if (r->next == r->capacity) {
        const size_t capacity = r->capacity ? 2 * r->capacity : 256;
        uint64_t *grown = realloc(r->digests, capacity * sizeof *grown);
        if (!grown) {
            snprintf(r->why, sizeof r->why, "out of memory");
            return recorder_disk(r);
        }
        r->digests = grown;
        r->capacity = capacity;
    }
    r->digests[r->next++] = info->digest;
    r->ended = r->ended || info->end;
    return RECORDER_GOOD;
}

static enum recorder_outcome append(struct recorder *r, enum framelog_kind kind,
                                    const void *payload, size_t bytes) {
    return framelog_append(r->log, kind, payload, bytes, r->why, sizeof r->why) == 0
               ? RECORDER_GOOD
               : recorder_disk(r);
}

// A frame that was checked: the next one is kept, an earlier one must be the same again.
enum recorder_outcome recorder_take(struct recorder *r, const struct frameinfo *info,
                                    const void *frame) {
    if (info->seq < r->next) {
        if (info->digest == r->digests[info->seq])
            return RECORDER_GOOD;
        terminal_error("frame %llu of %s was published twice with different contents",
                       (unsigned long long)info->seq, r->options->run);
        return RECORDER_LOST;
    }
    const enum recorder_outcome outcome = append(r, FRAMELOG_FRAME, frame, info->total_bytes);
    return outcome == RECORDER_GOOD ? remember(r, info) : outcome;
}
enum recorder_outcome recorder_make_durable(struct recorder *r) {
    if (framelog_sync(r->log, r->why, sizeof r->why) != 0)
        return recorder_disk(r);
    r->synced_at = recorder_now();
    r->synced_bytes = framelog_bytes(r->log);
    if (r->synced_frames != r->next) {
        r->synced_frames = r->next;
        recorder_acknowledge(r, r->next);
    }
    return RECORDER_GOOD;
}

// ---- The log at the start ---------------------------------------------------------------------

void recorder_name(const char *file, char *out) {
    char folder[PATH_MAX], host[256] = "";
    char *real = realpath(file, NULL), *whole = NULL;
    gethostname(host, sizeof host - 1);
    if (!getcwd(folder, sizeof folder))
        folder[0] = '\0';
    if (asprintf(&whole, "%s:%s/%s", host, real ? "" : folder, real ? real : file) < 0)
        whole = NULL;
    snprintf(out, RECORDER_NAME, "fbar-%016llx",
             (unsigned long long)(whole ? XXH3_64bits(whole, strlen(whole)) : 0));
    free(whole);
    free(real);
}

enum recorder_outcome recorder_start_log(struct recorder *r) {
    recorder_name(r->options->file, r->name);
    cJSON *head = cJSON_CreateObject();
    cJSON_AddStringToObject(head, "format", LOG_FORMAT);
    cJSON_AddStringToObject(head, "run", r->options->run);
    cJSON_AddStringToObject(head, "created", r->created);
    cJSON_AddStringToObject(head, "code_version", r->code_version);
    cJSON_AddStringToObject(head, "recorder", r->name);
    char *text = cJSON_PrintUnformatted(head);
    cJSON_Delete(head);
    const enum recorder_outcome outcome =
        append(r, FRAMELOG_RUN, text ? text : "{}", text ? strlen(text) : 2);
    free(text);
    return outcome;
}

static enum recorder_outcome resume_head(struct recorder *r, const struct framelog_record *record) {
    cJSON *head = cJSON_ParseWithLength(record->payload, record->bytes);
    enum recorder_outcome outcome = RECORDER_GOOD;
    if (strcmp(recorder_text(head, "format"), LOG_FORMAT) != 0) {
        terminal_error("%s is no log of this version of fbar", r->log_name);
        outcome = RECORDER_DISK;
    } else if (strcmp(recorder_text(head, "run"), r->options->run) != 0) {
        terminal_error("%s holds a recording of run %s; choose another -o", r->log_name,
                       recorder_text(head, "run"));
        outcome = RECORDER_DISK;
    }
    snprintf(r->created, sizeof r->created, "%s", recorder_text(head, "created"));
    snprintf(r->name, sizeof r->name, "%s", recorder_text(head, "recorder"));
    cJSON_Delete(head);
    return outcome;
}

// Reads a log that a former recording left. *empty: there is nothing in it.
enum recorder_outcome recorder_resume_log(struct recorder *r, bool *empty) {
    struct framelog_record record;
    struct frameinfo info;
    uint64_t cut = 0;
    int got;
    *empty = true;
    while ((got = framelog_read(r->log, &record, &cut, r->why, sizeof r->why)) == 1) {
        enum recorder_outcome outcome = RECORDER_GOOD;
        if (*empty && record.kind != FRAMELOG_RUN) {
            snprintf(r->why, sizeof r->why, "%s is no log of fbar", r->log_name);
            return recorder_disk(r);
        }
        *empty = false;
        switch (record.kind) {
        case FRAMELOG_RUN:
            outcome = resume_head(r, &record);
            break;
        case FRAMELOG_SCENE:
            r->has_scene = true;
            break;
        case FRAMELOG_COMPLETE:
            r->complete = true;
            break;
        case FRAMELOG_FRAME:
            if (frameinfo_peek(record.payload, record.bytes, &info, r->why, sizeof r->why) != 0 ||
                info.seq != r->next) {
                snprintf(r->why, sizeof r->why, "%s: the frames in it are not in order",
                         r->log_name);
                return recorder_disk(r);
            }
            outcome = remember(r, &info);
            break;
        case FRAMELOG_PROBES:
        case FRAMELOG_CHANGES:
            break;
        }
        if (outcome != RECORDER_GOOD)
            return outcome;
    }
    if (got < 0)
        return recorder_disk(r);
    if (cut > 0)
        terminal_note("%s: cut %llu bytes of an unfinished record", r->log_name,
                      (unsigned long long)cut);
    return RECORDER_GOOD;
}

// ---- The end ----------------------------------------------------------------------------------

enum recorder_outcome recorder_append_texts(struct recorder *r) {
    struct reply reply;
    enum recorder_outcome outcome;
    if (!r->has_scene) {
        if ((outcome = recorder_get(r, "/scene", "application/json", &reply)) != RECORDER_GOOD)
            return outcome;
        if (reply.status == 200)
            outcome = append(r, FRAMELOG_SCENE, reply.body, reply.bytes);
        r->has_scene = true;
        request_reply_free(&reply);
        if (outcome != RECORDER_GOOD)
            return outcome;
    }
    if ((outcome = recorder_get(r, "/probes", "text/csv", &reply)) != RECORDER_GOOD)
        return outcome;
    if (reply.status == 200)
        outcome = append(r, FRAMELOG_PROBES, reply.body, reply.bytes);
    request_reply_free(&reply);
    return outcome;
}

// The parameter changes, all of them. A daemon without this path has them all in the run object.
static enum recorder_outcome append_changes(struct recorder *r) {
    struct reply reply;
    enum recorder_outcome outcome = recorder_get(r, "/changes", "application/json", &reply);
    if (outcome != RECORDER_GOOD)
        return outcome;
    cJSON *json = NULL;
    if (reply.status == 200)
        json = cJSON_ParseWithLength(reply.body, reply.bytes);
    else
        outcome = recorder_get_json(r, "", &json);
    request_reply_free(&reply);
    const cJSON *changes = cJSON_GetObjectItemCaseSensitive(json, "changes");
    if (outcome == RECORDER_GOOD && cJSON_IsArray(changes)) {
        char *text = cJSON_PrintUnformatted(changes);
        if (text)
            outcome = append(r, FRAMELOG_CHANGES, text, strlen(text));
        free(text);
    }
    cJSON_Delete(json);
    return outcome;
}

enum recorder_outcome recorder_complete_log(struct recorder *r) {
    const double begun = recorder_now();
    bool told = false;
    for (;;) {
        cJSON *run;
        const enum recorder_outcome answer = recorder_get_json(r, "", &run);
        const bool over = progress_over(run);
        if (over && r->options->progress)
            progress_show(run);
        // A daemon that was killed between the last frame and the end comes to the end again.
        const double waited = recorder_now() - begun;
        if (!over && answer == RECORDER_GOOD && waited > TELL_S && !told) {
            terminal_note("every frame is recorded; waiting for the run, which is %s, to end",
                          progress_state(run));
            told = true;
        }
        cJSON_Delete(run);
        if (answer != RECORDER_GOOD)
            return answer;
        if (over)
            break;
        if (interrupt_count() > r->interrupts)
            return RECORDER_GOOD;
        usleep(waited < 1 ? 20000 : 200000);
    }
    enum recorder_outcome outcome = recorder_append_texts(r);
    if (outcome == RECORDER_GOOD)
        outcome = append_changes(r);
    if (outcome == RECORDER_GOOD)
        outcome = recorder_make_durable(r);
    if (outcome == RECORDER_GOOD)
        outcome = append(r, FRAMELOG_COMPLETE, "", 0);
    if (outcome == RECORDER_GOOD)
        outcome = recorder_make_durable(r);
    r->complete = outcome == RECORDER_GOOD;
    return outcome;
}
