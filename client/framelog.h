// The recorder's own append-only log, FILE.h5.log: the truth of a recording until FILE.h5 is
// complete.
//
// HDF5 1.10 does not survive a killed writer; this does. A record is a 64-byte head and a payload
// padded to 64: magic "FBARREC1", u32 kind, u32 0, u64 payload bytes, u64 XXH3-64 of the payload
// (of a frame: of its preamble, which holds the digest of the rest), u64 durable, u64 digest of the
// head before, u64 XXH3-64 of all these, zeros. `durable` is the length of the log that was known
// to be on disk when the record was appended: damage beyond every such length can only be a torn
// tail and is cut; damage below one is reported with its place and nothing is touched.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum framelog_kind {
    FRAMELOG_RUN = 1,  // JSON: what is recorded, see recorder.c; the first record
    FRAMELOG_FRAME,    // a frame as received
    FRAMELOG_SCENE,    // the scene as run, JSON
    FRAMELOG_PROBES,   // CSV as the daemon gives it; the last one counts
    FRAMELOG_CHANGES,  // JSON array of parameter changes; the last one counts
    FRAMELOG_COMPLETE, // every frame is here; nothing follows
};

struct framelog;

struct framelog_record {
    enum framelog_kind kind;
    const void *payload; // borrowed until the next read
    size_t bytes;
};

// Opens, and creates where `create` says so, and takes the lock that keeps two recorders apart.
// NULL with a sentence in `why`; errno is ENOENT where the file is not there.
struct framelog *framelog_open(const char *path, bool create, char *why, size_t why_bytes);
void framelog_close(struct framelog *log);

// The next record, to be called after open until it gives 0: reads and checks. 1: a record; 0: the
// end (a torn tail is cut off; *cut says how many bytes); -1: damage or an I/O error, with `why`.
// After framelog_rewind it starts over.
int framelog_read(struct framelog *log, struct framelog_record *out, uint64_t *cut, char *why,
                  size_t why_bytes);
void framelog_rewind(struct framelog *log);
// Exchanges the buffer that holds the payload of the last read with one of the caller's (from
// malloc, or NULL), which keeps the payload.
void framelog_swap(struct framelog *log, unsigned char **buffer, size_t *capacity);

// The same without reading what is long: of a frame, `payload` is its preamble and header only
// (`bytes` counts these). Gives the records that framelog_read has found good or that were appended
// here, and no others.
int framelog_skim(struct framelog *log, struct framelog_record *out, char *why, size_t why_bytes);

// Appends at the end; only after everything has been read. A failed append leaves the log as it
// was.
int framelog_append(struct framelog *log, enum framelog_kind kind, const void *payload,
                    size_t bytes, char *why, size_t why_bytes);
// On return 0 all that was appended survives a power failure. Otherwise what is not known to be on
// the disk is cut off, since nobody can tell any more what would be there after such a failure: the
// next recording asks for it again.
int framelog_sync(struct framelog *log, char *why, size_t why_bytes);
uint64_t framelog_bytes(const struct framelog *log);
