// A frame's header as plain numbers, with every place in it checked against the frame's length.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "proto/frame.h"

struct frameinfo_field {
    char name[48], unit[32], dtype[8];
    int rank;
    size_t shape[3];
    size_t components; // product of the shape but for the particles
    size_t offset, bytes;
};

struct frameinfo {
    char run[72], state[24];
    uint64_t epoch, seq, step;
    double time; // s
    int dimension;
    size_t count;
    bool fbar, end;
    size_t n_fields;
    struct frameinfo_field fields[FRAME_MAX_FIELDS];
    uint64_t digest, total_bytes;
};

// Checks and reads the frame in `frame`. 0, or -1 with one sentence in `why`.
int frameinfo_read(const void *frame, size_t bytes, struct frameinfo *out, char *why,
                   size_t why_bytes);
// The same of the beginning of a frame whose digest is known to be right.
int frameinfo_peek(const void *frame, size_t bytes, struct frameinfo *out, char *why,
                   size_t why_bytes);
// The field of that name, or NULL.
const struct frameinfo_field *frameinfo_field(const struct frameinfo *info, const char *name);
