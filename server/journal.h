// One run's folder on disk: scene, event log, frames, checkpoints. Everything that must outlive a
// kill -9 at any instant passes through here. The layout is in docs/design.md.
//
// Frames are appended by one thread (the publisher's) and read by any; the event log and
// checkpoints belong to the run's thread. Functions that fail write one sentence to `why`
// (JOURNAL_WHY bytes).
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define JOURNAL_WHY 512

enum journal_result {
    JOURNAL_OK,
    JOURNAL_FULL,  // no room on the disk now; the same call may succeed later
    JOURNAL_HELD,  // no room in the budget: likewise, once a recorder has acknowledged more
    JOURNAL_ERROR, // anything else
};

struct journal_frame {
    uint64_t seq, step, bytes, digest; // digest: the frame's own
    double time;                       // s
    uint32_t epoch;
    uint16_t state; // enum run_state that its header names
    bool end;
    bool gone;        // its segment was dropped for want of room
    uint32_t segment; // place on disk, the journal's
    uint64_t offset;
};

struct journal;

// Makes `data_dir` with its `runs` folder where missing and takes the lock that keeps a second
// daemon out. The descriptor that holds the lock until it is closed, or -1.
int journal_lock(const char *data_dir, char *why);

// Whether another run's folder could be made there now: it is there, may be written to, there is
// room, and there are file descriptors for it. Writes nothing.
bool journal_has_room(const char *data_dir, char *why);

// Ids of all runs on disk, sorted; the caller frees the array and its strings. Also clears away
// what a killed daemon left of runs that it had not answered for or had been told to delete.
char **journal_list(const char *data_dir, size_t *count);

// A new folder with these two files. It appears whole or not at all. NULL when it cannot be made.
struct journal *journal_create(const char *data_dir, const char *id, const char *scene,
                               const char *meta, char *why);
// An existing one: rebuilds the index, cuts a torn tail. NULL on damage before the tail, with its
// place.
struct journal *journal_open(const char *data_dir, const char *id, char *why);
void journal_close(struct journal *journal); // leaves the files
// Closes its files, of a run that is over: nothing is appended any more, and all can be read still.
void journal_rest(struct journal *journal);                          // NULL is fine
int journal_remove(const char *data_dir, const char *id, char *why); // 0 or -1

// What an entry survives: the process (as created), or with `on` a power failure as well: then
// every entry is fsynced before it counts, and so is all that was there before.
enum journal_result journal_power(struct journal *journal, bool on, char *why);

uint64_t journal_cut_bytes(const struct journal *journal); // of the torn tail, when opened

// ---- Small files ------------------------------------------------------------------------------

// "<folder>/<name>" into `out`.
void journal_path(const struct journal *journal, const char *name, char *out, size_t bytes);
// A whole file, terminated; NULL when it cannot be read. The caller frees it.
char *journal_text(const struct journal *journal, const char *name, size_t *bytes);
// The same of a run that may not be open.
char *journal_text_of(const char *data_dir, const char *id, const char *name, size_t *bytes);
// Replaces a file as a whole (written new, renamed).
enum journal_result journal_replace(struct journal *journal, const char *name, const void *text,
                                    size_t bytes, char *why);

// ---- Events: events.jsonl, one JSON object a line ---------------------------------------------

// Appends `json` (an object, no newline in it); it survives kill -9 once this returns.
enum journal_result journal_append_event(struct journal *journal, const char *json, char *why);
uint64_t journal_n_events(struct journal *journal); // lines in the log
// Keeps room on the disk for a line of so many bytes, so that one that must not fail can be written.
enum journal_result journal_events_room(struct journal *journal, size_t bytes, char *why);
// The line that begins at `*offset` (0: the first), without its check, which the caller frees;
// moves the offset to the next one. NULL when there is none yet. May be called from any thread.
char *journal_event_next(struct journal *journal, uint64_t *offset);

// ---- Frames -----------------------------------------------------------------------------------

// Bytes of frames to keep; the oldest segments go beyond it, as far as they may.
void journal_budget(struct journal *journal, uint64_t bytes);
// Frames from this number on must not go (none when it is UINT64_MAX, as at first). May be called
// from any thread.
void journal_keep(struct journal *journal, uint64_t seq);
// Whether frames that must not go fill the budget.
bool journal_held(struct journal *journal);
// While allowed, the budget does not hold frames back: for those that are on their way when a
// checkpoint needs them, and for the end of a run.
void journal_overdraw(struct journal *journal, bool allowed);
// Appends a sealed frame of info->bytes bytes as number info->seq, which must be the next one.
enum journal_result journal_append_frame(struct journal *journal, const void *frame,
                                         const struct journal_frame *info, char *why);
uint64_t journal_n_frames(struct journal *journal);                 // seq of the next one
uint64_t journal_n_gone(struct journal *journal);                   // frames 0 .. n-1 were dropped
uint64_t journal_frame_bytes(struct journal *journal);              // on disk
uint64_t journal_bytes_from(struct journal *journal, uint64_t seq); // of the frames from this on
bool journal_frame(struct journal *journal, uint64_t seq, struct journal_frame *out);
// The newest frame with step <= `step`; false when there is none.
bool journal_frame_at_step(struct journal *journal, uint64_t step, struct journal_frame *out);
// A new descriptor on the frame's segment (frame at out->offset), which the caller closes; -1 when
// there is no such frame or it fails its digest.
int journal_frame_open(struct journal *journal, uint64_t seq, struct journal_frame *out, char *why);

// The frame itself, checked, from malloc; NULL where journal_frame_open would give -1, or without
// memory.
unsigned char *journal_frame_read(struct journal *journal, uint64_t seq, struct journal_frame *out,
                                  char *why);

// A frame in the journal as memory that the file stands behind, so that who still waits to send it
// holds none of the process's own. It stays readable when its segment goes.
struct journal_map {
    void *base;
    size_t base_bytes;
    unsigned char *frame;
    size_t bytes;
};
bool journal_frame_map(struct journal *journal, uint64_t seq, struct journal_map *out, char *why);
void journal_frame_unmap(struct journal_map *map);

// ---- Checkpoints ------------------------------------------------------------------------------

// Written new, fsynced (with the frames and events before it), renamed into place; the previous one
// is kept.
enum journal_result journal_checkpoint(struct journal *journal, const char *meta, const void *state,
                                       size_t bytes, char *why);
// The newest (0) or the previous (1) checkpoint, checked; false when there is none that is whole.
// The caller frees both blocks; `state` may be NULL when only meta is wanted.
bool journal_checkpoint_read(const struct journal *journal, int which, char **meta, void **state,
                             size_t *bytes);
