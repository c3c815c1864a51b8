// What the JSON reader refuses, what it lets through, merge patches (RFC 7396) and exact printing.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <cmocka.h>

#include "server/json.h"

#define COUNT(list) (sizeof(list) / sizeof *(list))

// Of exactly n bytes on the heap, so that a sanitizer sees any look beyond the end.
static cJSON *parse_bytes(const char *text, size_t n, struct faults *faults) {
    char *copy = malloc(n ? n : 1);
    memcpy(copy, text, n);
    cJSON *json = json_parse(copy, n, faults);
    free(copy);
    return json;
}

static void assert_refused_bytes(const char *text, size_t n) {
    struct faults faults = {0};
    cJSON *json = parse_bytes(text, n, &faults);
    if (json || faults.count != 1)
        print_error("accepted, or not one fault: %s\n", text);
    assert_null(json);
    assert_int_equal(faults.count, 1);
    assert_string_equal(faults.items[0].code, "json");
    assert_string_equal(faults.items[0].pointer, "");
    faults_free(&faults);
}

static void assert_refused(const char *text) {
    assert_refused_bytes(text, strlen(text));
}

static cJSON *parse(const char *text) {
    struct faults faults = {0};
    cJSON *json = parse_bytes(text, strlen(text), &faults);
    if (!json)
        print_error("%s: %s\n", text, faults.count ? faults.items[0].detail : "no fault");
    assert_non_null(json);
    assert_int_equal(faults.count, 0);
    faults_free(&faults);
    return json;
}

static void assert_prints(const char *text, const char *expected) {
    cJSON *json = parse(text);
    char *printed = json_print(json, false);
    assert_string_equal(printed, expected);
    free(printed);
    cJSON_Delete(json);
}

static void test_parse_accepts_json(void **state) {
    (void)state;
    assert_prints(" {\"a\" : [ 1 , -2.5e3, true,false , null ], \"b\":{} , \"A\":[]}\r\n\t",
                  "{\"a\":[1,-2500,true,false,null],\"b\":{},\"A\":[]}");
    assert_prints("0", "0");
    assert_prints("-0.0", "-0");
    assert_prints("1E+2", "100");
    assert_prints("1e-999", "0");
    assert_prints("\"\"", "\"\"");
    assert_prints("\"\\u00e9\\ud83d\\uDE00\\/\\b\\f\\n\\r\\t\\\\\\\"\"",
                  "\"\xC3\xA9\xF0\x9F\x98\x80/\\b\\f\\n\\r\\t\\\\\\\"\"");
}

static void test_parse_refuses_grammar_faults(void **state) {
    (void)state;
    static const char *const texts[] = {"",
                                        " ",
                                        "{",
                                        "[",
                                        "[1",
                                        "[1,",
                                        "[1,]",
                                        "[,1]",
                                        "[1 2]",
                                        "{\"a\"}",
                                        "{\"a\":}",
                                        "{\"a\":1",
                                        "{\"a\":1,",
                                        "{\"a\":1,}",
                                        "{a:1}",
                                        "{1:2}",
                                        "{'a':1}",
                                        "tru",
                                        "True",
                                        "nul",
                                        "nan",
                                        "NaN",
                                        "Infinity",
                                        "-Infinity",
                                        "undefined",
                                        "'a'",
                                        "\"a",
                                        "\"a\\",
                                        "\"\\u12\"",
                                        "\"\\x\"",
                                        "\"\\u12g4\"",
                                        "//x\n1",
                                        "/**/1",
                                        "}",
                                        "]",
                                        ",",
                                        ":",
                                        "{\"a\" 1}",
                                        "{\"a\":1 \"b\":2}"};
    for (size_t i = 0; i < COUNT(texts); i++)
        assert_refused(texts[i]);
}

static void test_parse_refuses_trailing_text(void **state) {
    (void)state;
    static const char *const texts[] = {"1 2", "{} {}", "[]x", "null,", "truefalse", "{}}"};
    for (size_t i = 0; i < COUNT(texts); i++)
        assert_refused(texts[i]);
    assert_refused_bytes("{}\0", 3);
}

static void test_parse_refuses_bad_numbers(void **state) {
    (void)state;
    static const char *const texts[] = {"01",  "-01",   "00",     "1.",      ".5",  "-.5",  "+1",
                                        "-",   "1e",    "1e+",    "1.e1",    "0x1", "1e5.", "1_0",
                                        "--1", "1e999", "-1e999", "1.8e308", "[01]"};
    for (size_t i = 0; i < COUNT(texts); i++)
        assert_refused(texts[i]);
}

static void test_parse_refuses_bad_text(void **state) {
    (void)state;
    assert_refused("\"a\nb\"");
    assert_refused("\"a\tb\"");
    assert_refused("\"\x01\"");
    assert_refused_bytes("\"a\0b\"", 5);
    assert_refused("\"\\u0000\"");
    assert_refused("{\"a\\u0000b\":1}");
    assert_refused("\"\\ud800\"");
    assert_refused("\"\\udc00\"");
    assert_refused("\"\\ud800\\u0041\"");
    assert_refused("\"\\ud800x\"");
    assert_refused("\"\\ud800\\ud800\"");
    static const char *const bytes[] = {"\"\x80\"",
                                        "\"\xC0\x80\"",
                                        "\"\xC1\xBF\"",
                                        "\"\xC3\"",
                                        "\"\xE0\x80\x80\"",
                                        "\"\xED\xA0\x80\"",
                                        "\"\xF0\x80\x80\x80\"",
                                        "\"\xF4\x90\x80\x80\"",
                                        "\"\xF5\x80\x80\x80\"",
                                        "\"\xE2\x82\"",
                                        "\"\xFF\"",
                                        "{\"\xFF\":1}"};
    for (size_t i = 0; i < COUNT(bytes); i++)
        assert_refused(bytes[i]);
    assert_refused("\xEF\xBB\xBF{}");
}

static void test_parse_refuses_duplicate_keys(void **state) {
    (void)state;
    assert_refused("{\"a\":1,\"a\":2}");
    assert_refused("{\"a\":1,\"b\":2,\"\\u0061\":3}");
    assert_refused("[{\"x\":{\"a\":1,\"b\":{\"a\":2},\"a\":3}}]");
    assert_prints("{\"a\":{\"a\":{\"a\":1}},\"b\":{\"a\":1}}",
                  "{\"a\":{\"a\":{\"a\":1}},\"b\":{\"a\":1}}");
    assert_prints("{\"a\":1,\"A\":2}", "{\"a\":1,\"A\":2}");
}

static void test_parse_limits_depth(void **state) {
    (void)state;
    char text[2 * JSON_MAX_DEPTH + 3];
    for (size_t depth = JSON_MAX_DEPTH; depth <= JSON_MAX_DEPTH + 1; depth++) {
        memset(text, '[', depth);
        memset(text + depth, ']', depth);
        text[2 * depth] = 0;
        if (depth == JSON_MAX_DEPTH)
            cJSON_Delete(parse(text));
        else
            assert_refused(text);
    }
    // An attack by depth costs neither stack nor time.
    size_t n = 1000000;
    char *deep = malloc(n + 1);
    memset(deep, '[', n);
    deep[n] = 0;
    assert_refused(deep);
    free(deep);
}

static void test_parse_names_line_and_column(void **state) {
    (void)state;
    static const struct {
        const char *text, *place;
    } cases[] = {{"{\n  \"a\": 01}", "line 2, column 8:"},
                 {"[1,\n\n x]", "line 3, column 2:"},
                 {"{\"\xC3\xA9\": 1,\n\"b\": 2, \"b\": 3}", "line 2, column 9:"},
                 {"\"\xC3\xA9\n\"", "line 1, column 3:"}};
    for (size_t i = 0; i < COUNT(cases); i++) {
        struct faults faults = {0};
        assert_null(json_parse(cases[i].text, strlen(cases[i].text), &faults));
        assert_memory_equal(faults.items[0].detail, cases[i].place, strlen(cases[i].place));
        faults_free(&faults);
    }
}

static void test_parse_keeps_long_numbers(void **state) {
    (void)state;
    char text[400] = "0.1";
    memset(text + 3, '0', 300);
    strcpy(text + 303, "7");
    cJSON *json = parse(text);
    assert_true(json->valuedouble == 0.1);
    cJSON_Delete(json);
}

// 8 MiB of keys, all different and with a repetition at the end: seconds if it were quadratic.
static void test_parse_of_many_keys_is_fast(void **state) {
    (void)state;
    size_t n_keys = 300000, capacity = n_keys * 32, n = 0;
    char *text = malloc(capacity);
    text[n++] = '{';
    for (size_t i = 0; i < n_keys; i++)
        n += (size_t)snprintf(text + n, capacity - n, "\"key-%zu-padding\":%zu,", i, i);
    text[n - 1] = '}';
    clock_t start = clock();
    struct faults faults = {0};
    cJSON *json = json_parse(text, n, &faults);
    assert_non_null(json);
    // A patch of as many keys: half of them are there, half are new.
    cJSON *patch = json_parse(text, n, &faults);
    for (cJSON *item = patch->child; item; item = item->next)
        item->string[0] = item->valuedouble < (double)n_keys / 2 ? 'k' : 'K';
    cJSON *merged = json_merge_patch(json, patch);
    assert_int_equal(cJSON_GetArraySize(merged), (int)(n_keys + n_keys / 2));
    cJSON_Delete(merged);
    cJSON_Delete(patch);
    cJSON_Delete(json);
    n += (size_t)snprintf(text + n - 1, capacity - n, ",\"key-7-padding\":0}") - 1;
    assert_null(json_parse(text, n, &faults));
    assert_int_equal(faults.count, 1);
    faults_free(&faults);
    double seconds = (double)(clock() - start) / CLOCKS_PER_SEC;
    assert_true(seconds < 20); // 1.5 s in a release build; the margin is for sanitizers
    free(text);
}

static void assert_merges(const char *target, const char *patch, const char *expected) {
    cJSON *a = parse(target), *b = parse(patch), *merged = json_merge_patch(a, b);
    char *text = json_print(merged, false), *target_after = json_print(a, false);
    char *patch_after = json_print(b, false);
    assert_string_equal(text, expected);
    assert_string_equal(target_after, target); // neither is changed
    assert_string_equal(patch_after, patch);
    free(text);
    free(target_after);
    free(patch_after);
    cJSON_Delete(merged);
    cJSON_Delete(a);
    cJSON_Delete(b);
}

// RFC 7396, appendix A, in full.
static void test_merge_patch_rfc7396_appendix_a(void **state) {
    (void)state;
    assert_merges("{\"a\":\"b\"}", "{\"a\":\"c\"}", "{\"a\":\"c\"}");
    assert_merges("{\"a\":\"b\"}", "{\"b\":\"c\"}", "{\"a\":\"b\",\"b\":\"c\"}");
    assert_merges("{\"a\":\"b\"}", "{\"a\":null}", "{}");
    assert_merges("{\"a\":\"b\",\"b\":\"c\"}", "{\"a\":null}", "{\"b\":\"c\"}");
    assert_merges("{\"a\":[\"b\"]}", "{\"a\":\"c\"}", "{\"a\":\"c\"}");
    assert_merges("{\"a\":\"c\"}", "{\"a\":[\"b\"]}", "{\"a\":[\"b\"]}");
    assert_merges("{\"a\":{\"b\":\"c\"}}", "{\"a\":{\"b\":\"d\",\"c\":null}}",
                  "{\"a\":{\"b\":\"d\"}}");
    assert_merges("{\"a\":[{\"b\":\"c\"}]}", "{\"a\":[1]}", "{\"a\":[1]}");
    assert_merges("[\"a\",\"b\"]", "[\"c\",\"d\"]", "[\"c\",\"d\"]");
    assert_merges("{\"a\":\"b\"}", "[\"c\"]", "[\"c\"]");
    assert_merges("{\"a\":\"foo\"}", "null", "null");
    assert_merges("{\"a\":\"foo\"}", "\"bar\"", "\"bar\"");
    assert_merges("{\"e\":null}", "{\"a\":1}", "{\"e\":null,\"a\":1}");
    assert_merges("[1,2]", "{\"a\":\"b\",\"c\":null}", "{\"a\":\"b\"}");
    assert_merges("{}", "{\"a\":{\"bb\":{\"ccc\":null}}}", "{\"a\":{\"bb\":{}}}");
}

static void test_merge_patch_keeps_order_and_case(void **state) {
    (void)state;
    assert_merges("{\"a\":1,\"b\":2,\"c\":3}", "{\"b\":{\"x\":1},\"a\":null,\"B\":4}",
                  "{\"b\":{\"x\":1},\"c\":3,\"B\":4}");
    assert_merges("{\"a\":{\"k\":[1]},\"b\":1}", "{\"a\":null,\"b\":null}", "{}");
    cJSON *patch = parse("{\"a\":{\"b\":null,\"c\":1}}");
    cJSON *merged = json_merge_patch(NULL, patch);
    char *text = json_print(merged, false);
    assert_string_equal(text, "{\"a\":{\"c\":1}}");
    free(text);
    cJSON_Delete(merged);
    cJSON_Delete(patch);
}

static void test_member_is_case_sensitive(void **state) {
    (void)state;
    cJSON *json = parse("{\"A\":1,\"a\":2}");
    assert_true(json_member(json, "a")->valuedouble == 2);
    assert_null(json_member(json, "b"));
    assert_null(json_member(json_member(json, "a"), "x"));
    assert_null(json_member(NULL, "x"));
    cJSON_Delete(json);
}

static void test_pointer_escapes_and_stays_in_bounds(void **state) {
    (void)state;
    char out[16] = "";
    json_pointer_append(out, sizeof out, "a/b~c");
    assert_string_equal(out, "/a~1b~0c");
    json_pointer_append(out, sizeof out, "12345/789");
    assert_string_equal(out, "/a~1b~0c/12345"); // no half of an escape
    char small[6] = "/ab";
    json_pointer_append(small, sizeof small, "\xC3\xA9");
    assert_string_equal(small, "/ab/"); // no half of a character
}

static void test_numbers_print_exactly_and_short(void **state) {
    (void)state;
    static const struct {
        double value;
        const char *text;
    } cases[] = {{0.1, "0.1"},
                 {0.1 + 0.2, "0.30000000000000004"},
                 {1e-5, "1e-05"},
                 {2e9, "2000000000"},
                 {1.0 / 3, "0.3333333333333333"},
                 {5e-324, "4.94065645841247e-324"},
                 {4096, "4096"},
                 {1e22, "1e+22"},
                 {-2.5, "-2.5"}};
    for (size_t i = 0; i < COUNT(cases); i++) {
        cJSON *number = json_number(cases[i].value), *plain = cJSON_CreateNumber(cases[i].value);
        char *text = cJSON_PrintUnformatted(number), *printed = json_print(plain, false);
        assert_string_equal(text, cases[i].text);
        assert_string_equal(printed, cases[i].text);
        assert_true(strtod(text, NULL) == cases[i].value);
        assert_true(number->valuedouble == cases[i].value);
        free(text);
        free(printed);
        cJSON_Delete(number);
        cJSON_Delete(plain);
    }
    cJSON *none = json_number(strtod("nan", NULL));
    assert_true(cJSON_IsNull(none));
    cJSON_Delete(none);
}

static void test_faults_are_bounded_and_printed(void **state) {
    (void)state;
    struct faults faults = {0};
    for (int i = 0; i < FAULTS_MAX + 5; i++)
        faults_add(&faults, "/a", "range", i ? NULL : "1", NULL, "number %d", i);
    assert_int_equal(faults.count, FAULTS_MAX);
    assert_int_equal(faults.more, 5);
    cJSON *json = faults_json(&faults);
    char *text = cJSON_PrintUnformatted(json->child);
    assert_string_equal(text, "{\"pointer\":\"/a\",\"code\":\"range\",\"expected\":\"1\","
                              "\"actual\":null,\"detail\":\"number 0\"}");
    free(text);
    cJSON_Delete(json);
    faults_free(&faults);
    assert_int_equal(faults.count, 0);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_parse_accepts_json),
        cmocka_unit_test(test_parse_refuses_grammar_faults),
        cmocka_unit_test(test_parse_refuses_trailing_text),
        cmocka_unit_test(test_parse_refuses_bad_numbers),
        cmocka_unit_test(test_parse_refuses_bad_text),
        cmocka_unit_test(test_parse_refuses_duplicate_keys),
        cmocka_unit_test(test_parse_limits_depth),
        cmocka_unit_test(test_parse_names_line_and_column),
        cmocka_unit_test(test_parse_keeps_long_numbers),
        cmocka_unit_test(test_parse_of_many_keys_is_fast),
        cmocka_unit_test(test_merge_patch_rfc7396_appendix_a),
        cmocka_unit_test(test_merge_patch_keeps_order_and_case),
        cmocka_unit_test(test_member_is_case_sensitive),
        cmocka_unit_test(test_pointer_escapes_and_stays_in_bounds),
        cmocka_unit_test(test_numbers_print_exactly_and_short),
        cmocka_unit_test(test_faults_are_bounded_and_printed),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
