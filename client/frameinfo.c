// Reads the JSON header of a frame. The digest says that it arrived whole; the checks here keep a
// faulty sender from making us read outside the frame.
#include "client/frameinfo.h"

#include <cjson/cJSON.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

// Integers in JSON are exact up to here.
#define LARGEST_EXACT 9007199254740992.0

static bool integer(const cJSON *object, const char *key, uint64_t *out) {
    const cJSON *item = cJSON_GetObjectItemCaseSensitive(object, key);
    if (!cJSON_IsNumber(item) || item->valuedouble < 0 || item->valuedouble > LARGEST_EXACT ||
        item->valuedouble != floor(item->valuedouble))
        return false;
    *out = (uint64_t)item->valuedouble;
    return true;
}

static bool boolean(const cJSON *object, const char *key, bool *out) {
    const cJSON *item = cJSON_GetObjectItemCaseSensitive(object, key);
    *out = cJSON_IsTrue(item);
    return cJSON_IsBool(item);
}

static bool text(const cJSON *object, const char *key, char *out, size_t n) {
    const char *value = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return value && (size_t)snprintf(out, n, "%s", value) < n;
}

static size_t dtype_bytes(const char *dtype) {
    return strcmp(dtype, "<f8") == 0                                ? 8
           : strcmp(dtype, "<f4") == 0 || strcmp(dtype, "<u4") == 0 ? 4
                                                                    : 0;
}

static bool read_field(const cJSON *item, const struct frameinfo *info, struct frameinfo_field *f) {
    uint64_t offset, bytes, extent;
    const cJSON *shape = cJSON_GetObjectItemCaseSensitive(item, "shape"), *side;
    if (!text(item, "name", f->name, sizeof f->name) ||
        !text(item, "unit", f->unit, sizeof f->unit) ||
        !text(item, "dtype", f->dtype, sizeof f->dtype) || !integer(item, "offset", &offset) ||
        !integer(item, "bytes", &bytes) || dtype_bytes(f->dtype) == 0 || strpbrk(f->name, "/."))
        return false;
    f->rank = cJSON_GetArraySize(shape);
    if (f->rank < 1 || f->rank > 3)
        return false;
    f->components = 1;
    int d = 0;
    cJSON_ArrayForEach(side, shape) {
        if (!cJSON_IsNumber(side) || side->valuedouble < 0 || side->valuedouble > LARGEST_EXACT)
            return false;
        extent = (uint64_t)side->valuedouble;
        f->shape[d] = extent;
        if (d++ > 0) {
            if (extent < 1 || extent > 9)
                return false;
            f->components *= extent;
        }
    }
    f->offset = offset;
    f->bytes = bytes;
    return f->shape[0] == info->count && offset >= FRAME_PREAMBLE && offset % FRAME_ALIGN == 0 &&
           offset <= info->total_bytes && bytes <= info->total_bytes - offset &&
           info->count <= info->total_bytes &&
           bytes == info->count * f->components * dtype_bytes(f->dtype);
}

static int read_header(const struct frame_view *view, struct frameinfo *out, char *why,
                       size_t why_bytes) {
    *out = (struct frameinfo){.digest = view->digest, .total_bytes = view->total_bytes};
    cJSON *header = cJSON_ParseWithLength(view->header, view->header_bytes);
    const cJSON *fields = cJSON_GetObjectItemCaseSensitive(header, "fields"), *item;
    const cJSON *time = cJSON_GetObjectItemCaseSensitive(header, "time");
    uint64_t dimension = 0, count = 0;
    bool good = text(header, "run", out->run, sizeof out->run) &&
                text(header, "state", out->state, sizeof out->state) &&
                integer(header, "epoch", &out->epoch) && integer(header, "seq", &out->seq) &&
                integer(header, "step", &out->step) && cJSON_IsNumber(time) &&
                integer(header, "dimension", &dimension) && (dimension == 2 || dimension == 3) &&
                integer(header, "count", &count) && boolean(header, "fbar", &out->fbar) &&
                boolean(header, "end", &out->end) && cJSON_GetArraySize(fields) <= FRAME_MAX_FIELDS;
    out->dimension = (int)dimension;
    out->count = count;
    if (good) {
        out->time = time->valuedouble;
        cJSON_ArrayForEach(item, fields) good =
            good && read_field(item, out, &out->fields[out->n_fields++]);
    }
    cJSON_Delete(header);
    if (!good)
        snprintf(why, why_bytes, "has a header that lacks a member or contradicts its length");
    return good ? 0 : -1;
}

int frameinfo_read(const void *frame, size_t bytes, struct frameinfo *out, char *why,
                   size_t why_bytes) {
    struct frame_view view;
    if (frame_open(frame, bytes, &view, why, why_bytes) != 0)
        return -1;
    return read_header(&view, out, why, why_bytes);
}

int frameinfo_peek(const void *frame, size_t bytes, struct frameinfo *out, char *why,
                   size_t why_bytes) {
    struct frame_view view;
    if (frame_peek(frame, bytes, &view, why, why_bytes) != 0)
        return -1;
    return read_header(&view, out, why, why_bytes);
}

const struct frameinfo_field *frameinfo_field(const struct frameinfo *info, const char *name) {
    for (size_t i = 0; i < info->n_fields; i++)
        if (strcmp(info->fields[i].name, name) == 0)
            return &info->fields[i];
    return NULL;
}
