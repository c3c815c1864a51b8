// The snapshot frame: layout, header text, digest, and the check of a frame that came from outside.
//
// The header's own length moves the arrays, whose offsets it states; frame_layout iterates to the
// fixed point. Digest: XXH3-64 over all that follows the preamble, which is small enough to be
// checked field by field.
#include "proto/frame.h"

#include <assert.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <xxhash.h>

// Arrays are written as the machine holds them, so a big-endian port needs a swap here and in
// readers.
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "frames are little-endian");

// Places in the preamble; the rest of it is zero.
enum { AT_HEADER_BYTES = 8, AT_FLAGS = 12, AT_TOTAL = 16, AT_DIGEST = 24, AT_ZEROS = 32 };

// Text that is only counted where `out` is NULL.
struct text {
    char *out;
    size_t n, capacity;
};

static size_t padded(size_t n) {
    return (n + FRAME_ALIGN - 1) / FRAME_ALIGN * FRAME_ALIGN;
}

static void put(struct text *t, const char *s, size_t n) {
    if (t->out && t->n + n <= t->capacity)
        memcpy(t->out + t->n, s, n);
    t->n += n;
}

static void put_text(struct text *t, const char *s) {
    put(t, s, strlen(s));
}

__attribute__((format(printf, 2, 3))) static void put_format(struct text *t, const char *format,
                                                             ...) {
    char part[128];
    va_list args;
    va_start(args, format);
    const int n = vsnprintf(part, sizeof part, format, args);
    va_end(args);
    assert(n >= 0 && (size_t)n < sizeof part);
    put(t, part, (size_t)n);
}

// The fewest digits that read back to the same double: any reader gets the very value.
static void put_number(struct text *t, double value) {
    char digits[40];
    if (!isfinite(value)) {
        put_text(t, "null");
        return;
    }
    for (int precision = 15; precision <= 17; precision++) {
        snprintf(digits, sizeof digits, "%.*g", precision, value);
        if (strtod(digits, NULL) == value)
            break;
    }
    put_text(t, digits);
}

// Ids, states, field names and dtypes come from closed sets: that they need no escape is a promise.
static void put_plain(struct text *t, const char *s) {
    for (const char *c = s; *c; c++)
        assert((unsigned char)*c >= 0x20 && *c != '"' && *c != '\\');
    put(t, "\"", 1);
    put_text(t, s);
    put(t, "\"", 1);
}

static void put_escaped(struct text *t, const char *s) {
    put(t, "\"", 1);
    for (; *s; s++) {
        if ((unsigned char)*s < 0x20)
            put_format(t, "\\u%04x", (unsigned)(unsigned char)*s);
        else if (*s == '"' || *s == '\\')
            put_format(t, "\\%c", *s);
        else
            put(t, s, 1);
    }
    put(t, "\"", 1);
}

static void put_field(struct text *t, const struct frame_field *field) {
    put_text(t, "{\"name\":");
    put_plain(t, field->name);
    put_text(t, ",\"dtype\":");
    put_plain(t, field->dtype);
    put_text(t, ",\"shape\":[");
    for (int d = 0; d < field->rank; d++)
        put_format(t, "%s%zu", d ? "," : "", field->shape[d]);
    put_text(t, "],\"unit\":");
    put_escaped(t, field->unit);
    put_format(t, ",\"offset\":%zu,\"bytes\":%zu}", field->offset, field->bytes);
}

static void put_header(struct text *t, const struct frame_plan *plan) {
    put_text(t, "{\"run\":");
    put_plain(t, plan->run);
    put_format(t, ",\"epoch\":%lu,\"seq\":%llu,\"step\":%llu,\"time\":", (unsigned long)plan->epoch,
               (unsigned long long)plan->seq, (unsigned long long)plan->step);
    put_number(t, plan->time);
    put_format(t, ",\"dimension\":%d,\"count\":%zu,\"fbar\":%s,\"state\":", plan->dimension,
               plan->count, plan->fbar ? "true" : "false");
    put_plain(t, plan->state);
    put_text(t, ",\"fields\":[");
    for (size_t i = 0; i < plan->n_fields; i++) {
        if (i)
            put(t, ",", 1);
        put_field(t, &plan->fields[i]);
    }
    put_text(t, "],\"probes\":");
    put_text(t, plan->probes && *plan->probes ? plan->probes : "{}");
    put_format(t, ",\"end\":%s}", plan->end ? "true" : "false");
}

static size_t dtype_bytes(const char *dtype) {
    static const struct {
        const char *name;
        size_t bytes;
    } known[] = {{"<f8", 8}, {"<f4", 4}, {"<u4", 4}};
    for (size_t i = 0; i < sizeof known / sizeof *known; i++)
        if (dtype && strcmp(dtype, known[i].name) == 0)
            return known[i].bytes;
    return 0;
}

int frame_layout(struct frame_plan *plan) {
    if (plan->n_fields > FRAME_MAX_FIELDS)
        return -1;
    for (size_t i = 0; i < plan->n_fields; i++) {
        struct frame_field *field = &plan->fields[i];
        size_t bytes = dtype_bytes(field->dtype);
        if (bytes == 0 || field->rank < 1 || field->rank > 3)
            return -1;
        for (int d = 0; d < field->rank; d++)
            if (__builtin_mul_overflow(bytes, field->shape[d], &bytes))
                return -1;
        field->bytes = bytes;
    }
    plan->header_bytes = 0;
    for (;;) { // ends: the header only grows, and by a few digits at most
        size_t end = FRAME_PREAMBLE + plan->header_bytes;
        for (size_t i = 0; i < plan->n_fields; i++) {
            plan->fields[i].offset = end;
            if (__builtin_add_overflow(end, plan->fields[i].bytes, &end) ||
                end > SIZE_MAX - FRAME_ALIGN)
                return -1;
            end = padded(end);
        }
        plan->total_bytes = end;
        struct text text = {0};
        put_header(&text, plan);
        if (padded(text.n) <= plan->header_bytes)
            return 0;
        plan->header_bytes = padded(text.n);
    }
}

void frame_write_header(const struct frame_plan *plan, void *frame) {
    unsigned char *bytes = frame;
    const uint32_t header_bytes = (uint32_t)plan->header_bytes;
    const uint64_t total_bytes = plan->total_bytes;
    memset(bytes, 0, FRAME_PREAMBLE);
    memcpy(bytes, FRAME_MAGIC, 8);
    memcpy(bytes + AT_HEADER_BYTES, &header_bytes, sizeof header_bytes);
    memcpy(bytes + AT_TOTAL, &total_bytes, sizeof total_bytes);

    memset(bytes + FRAME_PREAMBLE, ' ', plan->header_bytes);
    struct text text = {.out = (char *)bytes + FRAME_PREAMBLE, .capacity = plan->header_bytes};
    put_header(&text, plan);
    assert(padded(text.n) == plan->header_bytes);

    for (size_t i = 0; i < plan->n_fields; i++) {
        const size_t end = plan->fields[i].offset + plan->fields[i].bytes;
        memset(bytes + end, 0, padded(end) - end);
    }
}

uint64_t frame_seal(void *frame) {
    unsigned char *bytes = frame;
    uint64_t total_bytes;
    memcpy(&total_bytes, bytes + AT_TOTAL, sizeof total_bytes);
    const uint64_t digest = XXH3_64bits(bytes + FRAME_PREAMBLE, total_bytes - FRAME_PREAMBLE);
    memcpy(bytes + AT_DIGEST, &digest, sizeof digest);
    return digest;
}

uint64_t frame_stated_bytes(const void *preamble, size_t bytes) {
    uint64_t total_bytes;
    if (bytes < FRAME_PREAMBLE || memcmp(preamble, FRAME_MAGIC, 8) != 0)
        return 0;
    memcpy(&total_bytes, (const unsigned char *)preamble + AT_TOTAL, sizeof total_bytes);
    return total_bytes;
}

// The length of the JSON object that `text` begins with, or 0 when it does not end within `n`.
static size_t object_length(const char *text, size_t n) {
    size_t depth = 0;
    bool in_string = false;
    for (size_t i = 0; i < n; i++) {
        const char c = text[i];
        if (i == 0 && c != '{')
            return 0;
        if (in_string) {
            if (c == '\\')
                i++;
            else if (c == '"')
                in_string = false;
        } else if (c == '"') {
            in_string = true;
        } else if (c == '{' || c == '[') {
            depth++;
        } else if ((c == '}' || c == ']') && --depth == 0) {
            return i + 1;
        }
    }
    return 0;
}

static int refuse(char *why, size_t why_bytes, const char *sentence) {
    snprintf(why, why_bytes, "%s", sentence);
    return -1;
}

size_t frame_peek_bytes(const void *preamble) {
    uint32_t header_bytes;
    if (frame_stated_bytes(preamble, FRAME_PREAMBLE) == 0)
        return 0;
    memcpy(&header_bytes, (const unsigned char *)preamble + AT_HEADER_BYTES, sizeof header_bytes);
    return FRAME_PREAMBLE + (size_t)header_bytes;
}

int frame_peek(const void *frame, size_t bytes, struct frame_view *out, char *why,
               size_t why_bytes) {
    const unsigned char *at = frame;
    uint32_t header_bytes, flags;
    uint64_t digest;
    if (bytes < FRAME_PREAMBLE)
        return refuse(why, why_bytes, "shorter than a preamble");
    const uint64_t total = frame_stated_bytes(frame, bytes);
    if (total == 0)
        return refuse(why, why_bytes, "does not begin with " FRAME_MAGIC);
    memcpy(&header_bytes, at + AT_HEADER_BYTES, sizeof header_bytes);
    memcpy(&flags, at + AT_FLAGS, sizeof flags);
    memcpy(&digest, at + AT_DIGEST, sizeof digest);
    if (flags != 0)
        return refuse(why, why_bytes, "has flags that this version does not know");
    for (size_t i = AT_ZEROS; i < FRAME_PREAMBLE; i++)
        if (at[i] != 0)
            return refuse(why, why_bytes, "has a preamble that does not end in zeros");
    if (header_bytes == 0 || header_bytes % FRAME_ALIGN != 0 || total < FRAME_PREAMBLE ||
        header_bytes > total - FRAME_PREAMBLE)
        return refuse(why, why_bytes, "states lengths that contradict each other");
    if (bytes - FRAME_PREAMBLE < header_bytes)
        return refuse(why, why_bytes, "is cut short");

    // The digest does not cover the header's stated length; the text itself does.
    const char *header = (const char *)at + FRAME_PREAMBLE;
    const size_t length = object_length(header, header_bytes);
    if (length == 0 || padded(length) != header_bytes)
        return refuse(why, why_bytes, "has a header that is no single JSON object of its length");
    for (size_t i = length; i < header_bytes; i++)
        if (header[i] != ' ')
            return refuse(why, why_bytes, "has a header that is not padded with spaces");
    *out = (struct frame_view){
        .header = header, .header_bytes = header_bytes, .digest = digest, .total_bytes = total};
    return 0;
}

int frame_open(const void *frame, size_t bytes, struct frame_view *out, char *why,
               size_t why_bytes) {
    if (frame_peek(frame, bytes, out, why, why_bytes) != 0)
        return -1;
    if (out->total_bytes > bytes)
        return refuse(why, why_bytes, "is cut short");
    if (XXH3_64bits((const unsigned char *)frame + FRAME_PREAMBLE,
                    out->total_bytes - FRAME_PREAMBLE) != out->digest)
        return refuse(why, why_bytes, "does not match its digest");
    return 0;
}
