// The command line: what is accepted, what is refused, and the rule on addresses beyond loopback.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/guard.h"
#include "server/options.h"

static struct options options;
static char message[8192];

#define PARSE(...)                                                                                 \
    parse((char *[]){"fbard", __VA_ARGS__},                                                        \
          sizeof((char *[]){"fbard", __VA_ARGS__}) / sizeof(char *))
static enum options_result parse(char **argv, size_t n) {
    return options_parse((int)n, argv, &options, message, sizeof message);
}

static void test_options_defaults_are_loopback(void **state) {
    (void)state;
    assert_int_equal(PARSE("--data-dir", "/tmp/x"), OPTIONS_RUN);
    assert_string_equal(options.http_host, "127.0.0.1");
    assert_string_equal(options.http_port, "7800");
    assert_string_equal(options.publish, "tcp://127.0.0.1:7801");
    assert_int_equal(options.slots, 1);
    assert_true(options.threads >= 1 && !options.threads_given);
    assert_int_equal(options.resume, OPTIONS_RESUME_AUTO);
    assert_int_equal(options.max_body, 8 << 20);
}

static void test_options_values_are_read(void **state) {
    (void)state;
    assert_int_equal(PARSE("--http", "[::1]:0", "--publish=tcp://127.0.0.1:0", "--threads", "3",
                           "--slots=2", "--resume", "off", "--memory-limit", "2G", "--data-dir",
                           "/tmp/x"),
                     OPTIONS_RUN);
    assert_string_equal(options.http_host, "::1");
    assert_string_equal(options.http_port, "0");
    assert_string_equal(options.publish, "tcp://127.0.0.1:*");
    assert_true(options.threads == 3 && options.threads_given);
    assert_int_equal(options.slots, 2);
    assert_int_equal(options.resume, OPTIONS_RESUME_OFF);
    assert_int_equal(options.memory_limit, (size_t)2 << 30);
}

static void test_options_nonsense_is_refused(void **state) {
    (void)state;
    char *bad[][2] = {
        {"--frob", "1"},          {"--http", "nowhere"},   {"--http", "127.0.0.1:65536"},
        {"--http", "::1:80"},     {"--http", ":80"},       {"--publish", "udp://127.0.0.1:1"},
        {"--publish", "tcp://x"}, {"--slots", "0"},        {"--slots", "2x"},
        {"--threads", "-1"},      {"--resume", "perhaps"}, {"--memory-limit", "much"},
        {"--max-body", "0"},      {"--data-dir", ""},      {"--curve-dir", ""},
        {"--tls-cert", "/tmp/c"}, {"--insecure=1", "x"},   {"--port-file", ""},
    };
    for (size_t k = 0; k < sizeof bad / sizeof *bad; k++) {
        assert_int_equal(PARSE("--data-dir", "/tmp/x", bad[k][0], bad[k][1]), OPTIONS_BAD);
        assert_true(message[0] != '\0');
    }
    assert_int_equal(PARSE("--slots"), OPTIONS_BAD);
}

static void test_options_beyond_loopback_needs_a_guard(void **state) {
    (void)state;
    assert_int_equal(PARSE("--data-dir", "/tmp/x", "--http", "0.0.0.0:0"), OPTIONS_BAD);
    assert_int_equal(PARSE("--data-dir", "/tmp/x", "--http", "0.0.0.0:0", "--token-file", "/t"),
                     OPTIONS_BAD);
    assert_int_equal(PARSE("--data-dir", "/tmp/x", "--http", "0.0.0.0:0", "--token-file", "/t",
                           "--tls-cert", "/c", "--tls-key", "/k"),
                     OPTIONS_RUN);
    assert_int_equal(PARSE("--data-dir", "/tmp/x", "--http", "0.0.0.0:0", "--insecure"),
                     OPTIONS_RUN);
    assert_int_equal(PARSE("--data-dir", "/tmp/x", "--publish", "tcp://0.0.0.0:0"), OPTIONS_BAD);
    assert_int_equal(
        PARSE("--data-dir", "/tmp/x", "--publish", "tcp://0.0.0.0:0", "--curve-dir", "/k"),
        OPTIONS_RUN);
}

static void test_options_default_folder_follows_xdg(void **state) {
    (void)state;
    setenv("XDG_STATE_HOME", "/var/x", 1);
    assert_int_equal(PARSE("--slots", "1"), OPTIONS_RUN);
    assert_string_equal(options.data_dir, "/var/x/fbard");
    unsetenv("XDG_STATE_HOME");
    setenv("HOME", "/home/me", 1);
    assert_int_equal(PARSE("--slots", "1"), OPTIONS_RUN);
    assert_string_equal(options.data_dir, "/home/me/.local/state/fbard");
}

static void test_options_isa_comes_from_the_environment(void **state) {
    (void)state;
    setenv("FBARD_ISA", "baseline", 1);
    assert_int_equal(PARSE("--data-dir", "/tmp/x"), OPTIONS_RUN);
    assert_int_equal(options.isa, MPM_ISA_BASELINE);
    setenv("FBARD_ISA", "sse9", 1);
    assert_int_equal(PARSE("--data-dir", "/tmp/x"), OPTIONS_BAD);
    assert_non_null(strstr(message, "FBARD_ISA: must be one of auto baseline"));
    assert_non_null(strstr(message, "'sse9'"));
    for (int k = 0; k < MPM_N_ISAS; k++) {
        bool there = mpm_isa_available((enum mpm_isa)k);
        setenv("FBARD_ISA", mpm_isa_name((enum mpm_isa)k), 1);
        assert_int_equal(PARSE("--data-dir", "/tmp/x"), there ? OPTIONS_RUN : OPTIONS_BAD);
    }
    unsetenv("FBARD_ISA");
    assert_int_equal(PARSE("--data-dir", "/tmp/x"), OPTIONS_RUN);
    assert_int_equal(options.isa, MPM_ISA_AUTO);
}

static void test_options_bytes_know_suffixes(void **state) {
    size_t n;
    (void)state;
    assert_true(options_bytes("12", &n) && n == 12);
    assert_true(options_bytes("3K", &n) && n == 3072);
    assert_true(options_bytes("1M", &n) && n == 1048576);
    assert_false(options_bytes("", &n));
    assert_false(options_bytes("-1", &n));
    assert_false(options_bytes("1KB", &n));
    assert_false(options_bytes("99999999999999999999", &n));
    assert_false(options_bytes("99999999999G", &n));
}

static void test_options_help_names_every_option(void **state) {
    (void)state;
    assert_int_equal(PARSE("--help"), OPTIONS_PRINTED);
    assert_non_null(strstr(message, "--port-file"));
    assert_non_null(strstr(message, "--insecure"));
}

static void test_guard_refuses_foreign_hosts_and_origins(void **state) {
    char token[] = "secret";
    struct guard guard = {.bound = "127.0.0.1"};
    (void)state;
    assert_int_equal(guard_verdict(&guard, "localhost:7800", NULL, NULL), 0);
    assert_int_equal(guard_verdict(&guard, "127.0.0.1", NULL, NULL), 0);
    assert_int_equal(guard_verdict(&guard, "[::1]:80", NULL, NULL), 0);
    assert_int_equal(guard_verdict(&guard, "evil.example", NULL, NULL), 421);
    assert_int_equal(guard_verdict(&guard, "localhost.evil.example", NULL, NULL), 421);
    assert_int_equal(guard_verdict(&guard, "127.0.0.1:80@evil", NULL, NULL), 421);
    assert_int_equal(guard_verdict(&guard, "", NULL, NULL), 421);
    assert_int_equal(guard_verdict(&guard, "localhost:1", "http://localhost:1", NULL), 0);
    assert_int_equal(guard_verdict(&guard, "localhost:1", "http://localhost:2", NULL), 403);
    assert_int_equal(guard_verdict(&guard, "localhost:1", "null", NULL), 403);
    assert_int_equal(guard_verdict(&guard, "localhost:1", "http://evil.example", NULL), 403);
    guard.token = token;
    assert_int_equal(guard_verdict(&guard, "localhost", NULL, NULL), 401);
    assert_int_equal(guard_verdict(&guard, "localhost", NULL, "Bearer secre"), 401);
    assert_int_equal(guard_verdict(&guard, "localhost", NULL, "Bearer secrets"), 401);
    assert_int_equal(guard_verdict(&guard, "localhost", NULL, "Basic secret"), 401);
    assert_int_equal(guard_verdict(&guard, "localhost", NULL, "bearer secret"), 0);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_options_defaults_are_loopback),
        cmocka_unit_test(test_options_values_are_read),
        cmocka_unit_test(test_options_nonsense_is_refused),
        cmocka_unit_test(test_options_beyond_loopback_needs_a_guard),
        cmocka_unit_test(test_options_default_folder_follows_xdg),
        cmocka_unit_test(test_options_isa_comes_from_the_environment),
        cmocka_unit_test(test_options_bytes_know_suffixes),
        cmocka_unit_test(test_options_help_names_every_option),
        cmocka_unit_test(test_guard_refuses_foreign_hosts_and_origins),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
