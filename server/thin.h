// Frames for viewers: one of every k particles, some of the fields, in the same format.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct thin {
    size_t max_particles; // 0: all; else one of k, with the smallest k that leaves at most these
    uint32_t fields;      // bits by enum mpm_field; 0: all
};
bool thin_asked(const struct thin *thin);
// A new frame with fewer particles and fields, of a whole frame that this daemon wrote: from
// malloc, with its own digest. NULL without memory.
unsigned char *thin_frame(const struct thin *thin, const void *frame, size_t frame_bytes,
                          size_t *bytes);
