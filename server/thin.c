// Frames for viewers: one of every k particles, some of the fields, in the same format.
//
// Bodies are seeded row by row, so that every k-th particle of theirs stands in stripes, which look like something that
// is in the flow. So it is one at a random place in each group of k: the same one in every frame.
#include "server/thin.h"

#include <stdlib.h>
#include <string.h>

#include "proto/frame.h"
#include "server/json.h"
#include "server/mpm/mpm.h"

bool thin_asked(const struct thin *thin) {
    return thin->max_particles > 0 || thin->fields != 0;
}

static bool wanted(const struct thin *thin, const cJSON *field) {
    int number = mpm_field_parse(json_member(field, "name")->valuestring);
    return thin->fields == 0 || (number >= 0 && (thin->fields >> number & 1) != 0);
}

// Header of a frame -> plan of the same frame with one particle of every `stride`. The plan borrows
// from the JSON and from `probes`.
static bool thin_plan(const struct thin *thin, const cJSON *header, size_t stride, char *probes,
                      struct frame_plan *out) {
    const cJSON *field, *shape = NULL;
    size_t count = (size_t)json_member(header, "count")->valuedouble;
    *out = (struct frame_plan){
        .run = json_member(header, "run")->valuestring,
        .epoch = (uint32_t)json_member(header, "epoch")->valuedouble,
        .seq = (uint64_t)json_member(header, "seq")->valuedouble,
        .step = (uint64_t)json_member(header, "step")->valuedouble,
        .time = json_member(header, "time")->valuedouble,
        .dimension = (int)json_member(header, "dimension")->valuedouble,
        .count = (count + stride - 1) / stride,
        .fbar = cJSON_IsTrue(json_member(header, "fbar")),
        .state = json_member(header, "state")->valuestring,
        .end = cJSON_IsTrue(json_member(header, "end")),
        .probes = probes,
    };
    cJSON_ArrayForEach(field, json_member(header, "fields")) {
        if (!wanted(thin, field))
            continue;
        struct frame_field *to = &out->fields[out->n_fields++];
        *to = (struct frame_field){.name = json_member(field, "name")->valuestring,
                                   .unit = json_member(field, "unit")->valuestring,
                                   .dtype = json_member(field, "dtype")->valuestring};
        cJSON_ArrayForEach(shape, json_member(field, "shape")) {
            to->shape[to->rank] = to->rank == 0 ? out->count : (size_t)shape->valuedouble;
            to->rank++;
        }
    }
    return frame_layout(out) == 0;
}

// The particle that stands for the group-th `stride` particles of `count`.
static size_t thin_pick(size_t group, size_t stride, size_t count) {
    const size_t first = group * stride, left = count - first;
    uint64_t h = group; // SplitMix64's mixing (Steele, Lea, Flood 2014)
    h = (h ^ h >> 30) * 0xbf58476d1ce4e5b9u;
    h = (h ^ h >> 27) * 0x94d049bb133111ebu;
    h ^= h >> 31;
    return first + (size_t)(h % (left < stride ? left : stride));
}

unsigned char *thin_frame(const struct thin *thin, const void *frame, size_t frame_bytes,
                          size_t *bytes) {
    struct faults faults = {0};
    struct frame_view view;
    struct frame_plan plan;
    unsigned char *out = NULL;
    char why[128];
    if (frame_peek(frame, frame_bytes, &view, why, sizeof why) != 0)
        return NULL;
    cJSON *header = json_parse(view.header, view.header_bytes, &faults);
    char *probes = header != NULL ? json_print(json_member(header, "probes"), false) : NULL;
    size_t count = header != NULL ? (size_t)json_member(header, "count")->valuedouble : 0;
    size_t most =
        thin->max_particles > 0 && thin->max_particles < count ? thin->max_particles : count;
    size_t stride = most > 0 ? (count + most - 1) / most : 1;
    if (probes != NULL && thin_plan(thin, header, stride, probes, &plan))
        out = aligned_alloc(FRAME_ALIGN, plan.total_bytes);
    if (out != NULL) {
        frame_write_header(&plan, out);
        size_t k = 0;
        const cJSON *field;
        cJSON_ArrayForEach(field, json_member(header, "fields")) {
            if (!wanted(thin, field))
                continue;
            const unsigned char *from =
                (const unsigned char *)frame + (size_t)json_member(field, "offset")->valuedouble;
            size_t row = plan.count > 0 ? plan.fields[k].bytes / plan.count : 0;
            for (size_t p = 0; p < plan.count; p++)
                memcpy(out + plan.fields[k].offset + p * row,
                       from + thin_pick(p, stride, count) * row, row);
            k++;
        }
        frame_seal(out);
        *bytes = plan.total_bytes;
    }
    free(probes);
    cJSON_Delete(header);
    faults_free(&faults);
    return out;
}
