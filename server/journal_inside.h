// The inside of struct journal, for the files journal*.c only.
#pragma once
#include <errno.h>
#include <limits.h>
#include <pthread.h>
#include <stdatomic.h>
#include <string.h>
#include <xxhash.h>

#include "server/journal.h"

#define JOURNAL_HEADER 64 // bytes of the header of a segment, a record, a checkpoint
#define JOURNAL_CHECK_AT (JOURNAL_HEADER - 8) // where a header's own checksum stands

struct journal_segment {
    uint32_t number;
    uint64_t bytes;
    uint64_t first_seq;
};

struct journal {
    char folder[PATH_MAX];
    int events; // descriptors
    int tail;   // the last segment, -1 before the first frame
    uint64_t cut_bytes;
    atomic_bool power;    // every entry is fsynced before it counts
    uint64_t event_check; // of the last line
    pthread_mutex_t lock; // over what follows
    uint64_t event_bytes; // of whole lines; only the run's thread appends
    uint64_t n_events;
    struct journal_segment *segments;
    size_t n_segments, segments_capacity;
    struct journal_frame *frames;
    size_t n_frames, frames_capacity;
    uint64_t n_gone, frame_bytes, budget;
    uint64_t keep; // frames from this one on must not go
    bool overdraw;
    uint64_t chain; // hash of the last record
};

void journal_explain(char *why, const char *format, ...) __attribute__((format(printf, 2, 3)));
// Fills `why` with what the system said of `path`; the result that goes with `error`.
enum journal_result journal_failure(int error, const char *path, char *why);

// 0 or errno; everything is written or read, or it is reported why not.
int journal_write_at(int fd, const void *from, size_t bytes, uint64_t offset);
int journal_read_at(int fd, void *out, size_t bytes, uint64_t offset);
int journal_sync_folder(const char *path);
// Whether a file that is open has lost its name: what is written to it then is nowhere.
bool journal_vanished(int fd);
bool journal_grow(void **array, size_t *capacity, size_t needed, size_t item);
char *journal_file_text(const char *path, size_t *bytes);

static inline void journal_put32(unsigned char *at, uint32_t value) {
    memcpy(at, &value, sizeof value);
}
static inline void journal_put64(unsigned char *at, uint64_t value) {
    memcpy(at, &value, sizeof value);
}
static inline uint32_t journal_take32(const unsigned char *at) {
    uint32_t value;
    memcpy(&value, at, sizeof value);
    return value;
}
static inline uint64_t journal_take64(const unsigned char *at) {
    uint64_t value;
    memcpy(&value, at, sizeof value);
    return value;
}
static inline void journal_header_seal(unsigned char *header) {
    journal_put64(header + JOURNAL_CHECK_AT, XXH3_64bits(header, JOURNAL_CHECK_AT));
}
static inline bool journal_header_whole(const unsigned char *header, const char *magic,
                                        size_t magic_bytes) {
    return memcmp(header, magic, magic_bytes) == 0 &&
           journal_take64(header + JOURNAL_CHECK_AT) == XXH3_64bits(header, JOURNAL_CHECK_AT);
}

bool journal_events_open(struct journal *journal, char *why); // journal_events.c
bool journal_frames_open(struct journal *journal, char *why); // journal_frames.c
