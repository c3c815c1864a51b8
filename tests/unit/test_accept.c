// Which media type an Accept header asks for (RFC 9110, 12.4.2 and 12.5.1).
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/accept.h"

static const char *const types[] = {"application/json", "text/csv"};
enum { NONE = -1, JSON, CSV };

static void assert_best(const char *header, int expected) {
    // Of exactly its length on the heap, so that a sanitizer sees any look beyond the end.
    char *copy = header != NULL ? strdup(header) : NULL;
    int best = accept_best(copy, types, 2);
    if (best != expected)
        print_error("%s: %d, not %d\n", header != NULL ? header : "none", best, expected);
    assert_int_equal(best, expected);
    free(copy);
}

static void test_accept_takes_the_highest_quality(void **state) {
    (void)state;
    assert_best("text/csv", CSV);
    assert_best("application/json", JSON);
    assert_best("application/json;q=0.5, text/csv", CSV);
    assert_best("text/csv;q=0.5, application/json;q=0.4", CSV);
    assert_best("text/csv; q=0.499 ,\tapplication/json ;Q=0.5", JSON);
    assert_best("text/csv;q=1.000,application/json;q=0.999", CSV);
    assert_best("TEXT/CSV, application/json;q=0.9", CSV);
}

static void test_accept_takes_the_most_specific_range(void **state) {
    (void)state;
    assert_best("text/*", CSV);
    assert_best("*/*;q=1, application/json;q=0.1", CSV);
    assert_best("text/*;q=0.2, text/csv;q=0.9, */*;q=0.5", CSV);
    assert_best("text/*;q=0.9, text/csv;q=0.2, */*;q=0.5", JSON);
    assert_best("text/csv;q=0.9, text/csv;header=present;q=0.1, application/json;q=0.5", JSON);
}

static void test_accept_refuses_with_zero(void **state) {
    (void)state;
    assert_best("text/csv;q=0, */*", JSON);
    assert_best("application/json;q=0, */*;q=0.1", CSV);
    assert_best("application/json;q=0.000, text/csv;q=0.001", CSV);
    assert_best("text/csv;q=0, text/*", JSON);
    assert_best("application/json;q=0, text/csv;q=0", NONE);
    assert_best("*/*;q=0", NONE);
    assert_best("text/csv;q=0", JSON); // of which it says nothing
}

static void test_accept_prefers_exact_then_first_then_its_own_order(void **state) {
    (void)state;
    assert_best("text/csv, */*", CSV);
    assert_best("*/*, text/csv", CSV);
    assert_best("text/csv, application/json", CSV);
    assert_best("application/json, text/csv", JSON);
    assert_best("text/*, application/*", CSV);
    assert_best("*/*", JSON);
}

static void test_accept_without_a_wish_takes_the_first(void **state) {
    (void)state;
    assert_best(NULL, JSON);
    assert_best("", JSON);
    assert_best(" , ,", JSON);
    assert_best("image/png, text/html;q=0.9", JSON);
}

static void test_accept_passes_over_what_is_no_range(void **state) {
    (void)state;
    static const char *const bad[] = {
        "text/csv;q=2", "text/csv;q=1.001", "text/csv;q=0.0001", "text/csv;q=", "text/csv;q=-1",
        "text/csv;q=.5", "text/csv;q", "text/csv;=1", "text/csv;a=\"b", "text/csv;a=\"b\\",
        "text/csv x", "csv", "text", "text/", "/csv", "text/csvx", "text/cs", "*/csv", "*",
        "text/csv;q=0x1", "text/csv\"", ";q=1", "text/csv;a=\"\\\"",
    };
    for (size_t k = 0; k < sizeof bad / sizeof *bad; k++) {
        char header[80];
        assert_best(bad[k], JSON);
        strcpy(header, bad[k]);
        if (strchr(bad[k], '"') == NULL) { // an open quotation takes all that follows
            strcat(header, ", text/csv;q=0.3, application/json;q=0.2");
            assert_best(header, CSV);
        }
    }
    assert_best("text/csv;a=\",;\\\"q=0\";q=0.5, application/json;q=0.4", CSV);
    assert_best("text/csv;;q=0.5;, application/json;q=0.4", CSV);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_accept_takes_the_highest_quality),
        cmocka_unit_test(test_accept_takes_the_most_specific_range),
        cmocka_unit_test(test_accept_refuses_with_zero),
        cmocka_unit_test(test_accept_prefers_exact_then_first_then_its_own_order),
        cmocka_unit_test(test_accept_without_a_wish_takes_the_first),
        cmocka_unit_test(test_accept_passes_over_what_is_no_range),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
