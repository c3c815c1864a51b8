// The frame: what is written is read back, and whatever is damaged is refused without reading on.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cjson/cJSON.h>
#include <cmocka.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/frame.h"

static struct frame_plan example(size_t count) {
    return (struct frame_plan){
        .run = "dam-1",
        .epoch = 3,
        .seq = 17,
        .step = 123456789012,
        .time = 0.1 + 0.2, // needs 17 digits
        .dimension = 2,
        .count = count,
        .fbar = true,
        .state = "running",
        .end = false,
        .probes = "{\"front\":4.25,\"note\":\"a } in \\\" text\"}",
        .n_fields = 3,
        .fields =
            {{.name = "position", .unit = "m", .dtype = "<f8", .rank = 2, .shape = {count, 2}},
             {.name = "id", .unit = "1", .dtype = "<u4", .rank = 1, .shape = {count}},
             {.name = "stress",
              .unit = "Pa \"\\",
              .dtype = "<f4",
              .rank = 3,
              .shape = {count, 2, 2}}},
    };
}

// A sealed frame of exactly its length on the heap, so that ASan sees any read past its end.
static unsigned char *sealed(struct frame_plan *plan) {
    assert_int_equal(frame_layout(plan), 0);
    unsigned char *frame = malloc(plan->total_bytes);
    memset(frame, 0xa5, plan->total_bytes);
    frame_write_header(plan, frame);
    for (size_t i = 0; i < plan->n_fields; i++)
        for (size_t b = 0; b < plan->fields[i].bytes; b++)
            frame[plan->fields[i].offset + b] = (unsigned char)(31 * i + 7 * b);
    frame_seal(frame);
    return frame;
}

static int opens(const void *frame, size_t bytes) {
    struct frame_view view;
    char why[128] = "";
    const int status = frame_open(frame, bytes, &view, why, sizeof why);
    if (status != 0)
        assert_true(strlen(why) > 0);
    return status;
}

static double number(const cJSON *object, const char *key) {
    const cJSON *item = cJSON_GetObjectItemCaseSensitive(object, key);
    assert_non_null(item);
    assert_true(cJSON_IsNumber(item));
    return item->valuedouble;
}

static const char *string(const cJSON *object, const char *key) {
    const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    assert_non_null(text);
    return text;
}

static void test_frame_round_trip(void **state) {
    (void)state;
    struct frame_plan plan = example(5);
    unsigned char *frame = sealed(&plan);
    struct frame_view view;
    char why[128];
    assert_int_equal(frame_open(frame, plan.total_bytes, &view, why, sizeof why), 0);
    assert_int_equal(view.total_bytes, plan.total_bytes);
    assert_int_equal(view.header_bytes, plan.header_bytes);
    assert_ptr_equal(view.header, frame + FRAME_PREAMBLE);
    assert_int_equal(frame_stated_bytes(frame, FRAME_PREAMBLE), plan.total_bytes);

    cJSON *header = cJSON_ParseWithLength(view.header, view.header_bytes);
    assert_non_null(header);
    assert_string_equal(string(header, "run"), "dam-1");
    assert_string_equal(string(header, "state"), "running");
    assert_true(number(header, "epoch") == 3);
    assert_true(number(header, "seq") == 17);
    assert_true(number(header, "step") == 123456789012.0);
    assert_true(number(header, "time") == 0.1 + 0.2); // the very bits
    assert_true(number(header, "dimension") == 2);
    assert_true(number(header, "count") == 5);
    assert_true(cJSON_IsTrue(cJSON_GetObjectItemCaseSensitive(header, "fbar")));
    assert_true(cJSON_IsFalse(cJSON_GetObjectItemCaseSensitive(header, "end")));
    assert_true(number(cJSON_GetObjectItemCaseSensitive(header, "probes"), "front") == 4.25);

    const cJSON *fields = cJSON_GetObjectItemCaseSensitive(header, "fields");
    assert_int_equal(cJSON_GetArraySize(fields), 3);
    for (int i = 0; i < 3; i++) {
        const cJSON *field = cJSON_GetArrayItem(fields, i);
        const struct frame_field *planned = &plan.fields[i];
        assert_string_equal(string(field, "name"), planned->name);
        assert_string_equal(string(field, "dtype"), planned->dtype);
        assert_string_equal(string(field, "unit"), planned->unit);
        assert_true(number(field, "offset") == (double)planned->offset);
        assert_true(number(field, "bytes") == (double)planned->bytes);
        const cJSON *shape = cJSON_GetObjectItemCaseSensitive(field, "shape");
        assert_int_equal(cJSON_GetArraySize(shape), planned->rank);
        for (size_t b = 0; b < planned->bytes; b++)
            assert_int_equal(frame[planned->offset + b], (unsigned char)(31 * i + 7 * (int)b));
    }
    const char *keys[] = {"run",   "epoch", "seq",   "step",   "time",   "dimension",
                          "count", "fbar",  "state", "fields", "probes", "end"};
    const cJSON *member = header->child;
    for (size_t i = 0; i < sizeof keys / sizeof *keys; i++, member = member->next)
        assert_string_equal(member->string, keys[i]);
    assert_null(member);
    cJSON_Delete(header);
    free(frame);
}

static void test_frame_arrays_are_aligned_and_apart(void **state) {
    (void)state;
    for (size_t count = 0; count < 70; count++) {
        struct frame_plan plan = example(count);
        unsigned char *frame = sealed(&plan);
        size_t end = FRAME_PREAMBLE + plan.header_bytes;
        assert_int_equal(plan.header_bytes % FRAME_ALIGN, 0);
        for (size_t i = 0; i < plan.n_fields; i++) {
            assert_int_equal(plan.fields[i].offset % FRAME_ALIGN, 0);
            assert_true(plan.fields[i].offset >= end && plan.fields[i].offset - end < FRAME_ALIGN);
            for (; end < plan.fields[i].offset; end++)
                assert_int_equal(frame[end], 0); // padding carries nothing of the memory before
            end += plan.fields[i].bytes;
        }
        assert_true(plan.total_bytes >= end && plan.total_bytes - end < FRAME_ALIGN);
        assert_int_equal(opens(frame, plan.total_bytes), 0);
        free(frame);
    }
}

static void test_frame_same_content_same_bytes(void **state) {
    (void)state;
    struct frame_plan plan = example(9);
    unsigned char *one = sealed(&plan), *two = sealed(&plan);
    assert_memory_equal(one, two, plan.total_bytes);
    free(one);
    free(two);
}

static void test_frame_truncated_at_every_length_is_refused(void **state) {
    (void)state;
    struct frame_plan plan = example(3);
    unsigned char *frame = sealed(&plan);
    for (size_t n = 0; n < plan.total_bytes; n++) {
        unsigned char *part = malloc(n ? n : 1);
        memcpy(part, frame, n);
        assert_int_equal(opens(part, n), -1);
        free(part);
    }
    free(frame);
}

static void test_frame_every_flipped_bit_is_detected(void **state) {
    (void)state;
    struct frame_plan plan = example(3);
    unsigned char *frame = sealed(&plan);
    for (size_t b = 0; b < plan.total_bytes; b++)
        for (int bit = 0; bit < 8; bit++) {
            frame[b] ^= (unsigned char)(1 << bit);
            assert_int_equal(opens(frame, plan.total_bytes), -1);
            frame[b] ^= (unsigned char)(1 << bit);
        }
    assert_int_equal(opens(frame, plan.total_bytes), 0);
    free(frame);
}

// A header length that is a multiple of 64 and within the frame, but not the header's own.
static void test_frame_wrong_header_length_is_refused(void **state) {
    (void)state;
    struct frame_plan plan = example(200);
    plan.n_fields = 1;
    assert_int_equal(frame_layout(&plan), 0);
    unsigned char *frame = malloc(plan.total_bytes);
    frame_write_header(&plan, frame);
    memset(frame + plan.fields[0].offset, ' ', plan.fields[0].bytes); // looks like padding
    frame_seal(frame);
    assert_int_equal(opens(frame, plan.total_bytes), 0);
    for (uint32_t wrong = 0; wrong <= plan.total_bytes; wrong += FRAME_ALIGN) {
        if (wrong == plan.header_bytes)
            continue;
        memcpy(frame + 8, &wrong, sizeof wrong);
        assert_int_equal(opens(frame, plan.total_bytes), -1);
    }
    free(frame);
}

static void test_frame_with_more_behind_it_opens(void **state) {
    (void)state;
    struct frame_plan plan = example(4);
    unsigned char *frame = sealed(&plan);
    unsigned char *stream = malloc(2 * plan.total_bytes);
    memcpy(stream, frame, plan.total_bytes);
    memcpy(stream + plan.total_bytes, frame, plan.total_bytes);
    struct frame_view view;
    char why[128];
    assert_int_equal(frame_open(stream, 2 * plan.total_bytes, &view, why, sizeof why), 0);
    assert_int_equal(view.total_bytes, plan.total_bytes);
    free(stream);
    free(frame);
}

static void test_frame_layout_refuses_what_it_cannot_carry(void **state) {
    (void)state;
    struct frame_plan plan = example(4);
    plan.fields[1].dtype = "<f16";
    assert_int_equal(frame_layout(&plan), -1);
    plan = example(4);
    plan.n_fields = FRAME_MAX_FIELDS + 1;
    assert_int_equal(frame_layout(&plan), -1);
    plan = example(4);
    plan.fields[0].rank = 4;
    assert_int_equal(frame_layout(&plan), -1);
    plan = example(SIZE_MAX / 4);
    assert_int_equal(frame_layout(&plan), -1);
}

static void test_frame_time_without_value_is_null(void **state) {
    (void)state;
    struct frame_plan plan = example(1);
    plan.time = __builtin_nan("");
    unsigned char *frame = sealed(&plan);
    cJSON *header = cJSON_ParseWithLength((char *)frame + FRAME_PREAMBLE, plan.header_bytes);
    assert_non_null(header);
    assert_true(cJSON_IsNull(cJSON_GetObjectItemCaseSensitive(header, "time")));
    cJSON_Delete(header);
    free(frame);
}

static void test_frame_stated_bytes_of_a_stranger_is_zero(void **state) {
    (void)state;
    unsigned char preamble[FRAME_PREAMBLE] = "FBARFRM2";
    assert_int_equal(frame_stated_bytes(preamble, sizeof preamble), 0);
    memcpy(preamble, FRAME_MAGIC, 8);
    assert_int_equal(frame_stated_bytes(preamble, FRAME_PREAMBLE - 1), 0);
}

int main(int argc, char **argv) {
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_frame_round_trip),
        cmocka_unit_test(test_frame_arrays_are_aligned_and_apart),
        cmocka_unit_test(test_frame_same_content_same_bytes),
        cmocka_unit_test(test_frame_truncated_at_every_length_is_refused),
        cmocka_unit_test(test_frame_every_flipped_bit_is_detected),
        cmocka_unit_test(test_frame_wrong_header_length_is_refused),
        cmocka_unit_test(test_frame_with_more_behind_it_opens),
        cmocka_unit_test(test_frame_layout_refuses_what_it_cannot_carry),
        cmocka_unit_test(test_frame_time_without_value_is_null),
        cmocka_unit_test(test_frame_stated_bytes_of_a_stranger_is_zero),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
