// Frames from outside: the decoder of proto/ and the client's reader of the header. Each input is
// read as it is, and once more with its digest made right, since behind a right digest a faulty
// sender may still have written anything. Every place that is told must lie in the frame.
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "client/frameinfo.h"
#include "tests/fuzz/fuzz.h"

static uint64_t touch(const unsigned char *from, size_t bytes) {
    uint64_t sum = 0;
    for (size_t k = 0; k < bytes; k++)
        sum += from[k];
    return sum;
}

static void read_all(const unsigned char *frame, size_t size) {
    struct frame_view view;
    struct frameinfo info;
    char why[256];
    volatile uint64_t sum = 0;
    for (size_t bytes = size;; bytes /= 2) { // whole, and cut
        if (frame_open(frame, bytes, &view, why, sizeof why) == 0)
            sum += touch((const unsigned char *)view.header, view.header_bytes);
        else
            FUZZ_MUST(why[0] != '\0');
        if (frame_peek(frame, bytes, &view, why, sizeof why) == 0)
            sum += touch((const unsigned char *)view.header, view.header_bytes);
        if (bytes >= FRAME_PREAMBLE) {
            sum += frame_peek_bytes(frame);
            sum += frame_stated_bytes(frame, bytes);
        }
        if (bytes == 0)
            break;
    }
    if (frameinfo_read(frame, size, &info, why, sizeof why) == 0) {
        FUZZ_MUST(info.n_fields <= FRAME_MAX_FIELDS && info.total_bytes <= size);
        for (size_t k = 0; k < info.n_fields; k++) {
            const struct frameinfo_field *f = &info.fields[k];
            FUZZ_MUST(f->offset <= size && f->bytes <= size - f->offset);
            sum += touch(frame + f->offset, f->bytes);
        }
    } else {
        FUZZ_MUST(why[0] != '\0');
    }
    frameinfo_peek(frame, size, &info, why, sizeof why);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    unsigned char *frame =
        aligned_alloc(FRAME_ALIGN, (size + FRAME_ALIGN) / FRAME_ALIGN * FRAME_ALIGN);
    unsigned char *exact = malloc(size > 0 ? size : 1);
    memcpy(frame, data, size);
    memcpy(exact, data, size);
    read_all(exact, size);
    uint64_t stated = size >= FRAME_PREAMBLE ? frame_stated_bytes(frame, size) : 0;
    if (stated >= FRAME_PREAMBLE && stated <= size) {
        frame_seal(frame);
        memcpy(exact, frame, size);
        read_all(exact, size);
    }
    free(frame);
    free(exact);
    return 0;
}
