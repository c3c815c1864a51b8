// The snapshot frame: the one format on the wire, over HTTP and in the journal (proto/README.md).
//
// One contiguous little-endian block: a 64-byte preamble, a UTF-8 JSON header padded with spaces to
// a multiple of 64, then raw arrays, each starting on a multiple of 64, C order, particle first.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define FRAME_MAGIC "FBARFRM1"
#define FRAME_PREAMBLE 64
#define FRAME_ALIGN 64
#define FRAME_MAX_FIELDS 16

struct frame_field {
    const char *name, *unit, *dtype; // borrowed; dtype "<f8", "<f4", "<u4"
    int rank; // 1: (count); 2: (count, shape[1]); 3: (count, shape[1], shape[2])
    size_t shape[3];
    size_t offset, bytes; // filled by frame_plan: from the frame's first byte
};

struct frame_plan {
    const char *run; // borrowed: id, which needs no JSON escapes
    uint32_t epoch;
    uint64_t seq, step;
    double time; // s
    int dimension;
    size_t count;
    bool fbar;          // whether F-bar is on
    const char *state;  // state of the run, as the API names it
    bool end;           // the last frame of the run
    const char *probes; // borrowed: a JSON object, the latest value of each probe
    size_t n_fields;
    struct frame_field fields[FRAME_MAX_FIELDS];
    size_t header_bytes, total_bytes; // filled by frame_layout
};

// Places header and arrays: fills offset and bytes of each field, header_bytes (preamble excluded,
// padding included) and total_bytes. 0, or -1 when a dtype is unknown or there are too many fields.
int frame_layout(struct frame_plan *plan);
// Writes preamble (digest still 0), header and the padding between the arrays into `frame`
// (plan->total_bytes, 8-byte aligned). The arrays are the caller's to write at their offsets.
void frame_write_header(const struct frame_plan *plan, void *frame);
// Computes the digest over all that follows the preamble, stores and returns it. Call it last.
uint64_t frame_seal(void *frame);

// A frame that came from outside, checked. Pointers are into the block that was given.
struct frame_view {
    const char *header; // JSON text, not terminated
    size_t header_bytes;
    uint64_t digest, total_bytes;
};
// 0, or -1 with one sentence in `why` (magic, flags, length, digest, ...). Reads no byte past
// `bytes`.
int frame_open(const void *frame, size_t bytes, struct frame_view *out, char *why,
               size_t why_bytes);
// The same of a frame of which only the first `bytes` are there, preamble and header among them:
// all is checked but the digest and that the rest is there.
int frame_peek(const void *frame, size_t bytes, struct frame_view *out, char *why,
               size_t why_bytes);
// How much of a frame frame_peek needs, by its preamble (FRAME_PREAMBLE bytes); 0 when it is none.
size_t frame_peek_bytes(const void *preamble);
// The total length that a preamble states, or 0 when it is no preamble. `bytes` >= FRAME_PREAMBLE.
uint64_t frame_stated_bytes(const void *preamble, size_t bytes);
