// Run control on a small dam: states and transitions, commands at step boundaries, restart with the
// same bits. The daemon's HTTP is not needed for any of it.
#include <math.h>
#include <pthread.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "server/log.h"
#include "server/run_inside.h"
#include "server/runs.h"

static char folder[64], why[JOURNAL_WHY];
static struct run_host host;

static const char overrides[] =
    "{\"materials\":{\"water\":{\"bulk_modulus\":2e7}},\"time\":{\"dt\":2e-4,\"end\":0.1},"
    "\"stages\":null,\"bodies\":{\"reservoir\":{\"particles_per_cell\":4}},"
    "\"output\":{\"interval\":0.01}}";

static int open_host(void **state) {
    char endpoint[256], key[PUBLISH_KEY];
    (void)state;
    log_threshold(LOG_LEVEL_ERROR);
    snprintf(folder, sizeof folder, "/tmp/fbard-test-XXXXXX");
    if (mkdtemp(folder) == NULL)
        return -1;
    int lock = journal_lock(folder, why);
    if (lock < 0)
        return -1;
    close(lock);
    host = (struct run_host){
        .data_dir = folder,
        .publisher = publish_start("tcp://127.0.0.1:*", NULL, endpoint, sizeof endpoint, key, why),
        .slots = slots_create(1, (size_t)1 << 30),
        .threads = 1,
        .memory_limit = (size_t)1 << 30};
    return host.publisher != NULL && host.slots != NULL ? 0 : -1;
}

static int close_host(void **state) {
    char command[128];
    (void)state;
    publish_stop(host.publisher);
    slots_free(host.slots);
    snprintf(command, sizeof command, "rm -rf %s", folder);
    return system(command);
}

static struct scene *small_dam(const char *more) {
    struct faults faults = {0};
    cJSON *scene = scene_builtin("dam-break");
    cJSON *patch = json_parse(overrides, strlen(overrides), &faults);
    cJSON *merged = json_merge_patch(scene, patch);
    cJSON_Delete(patch);
    patch = json_parse(more, strlen(more), &faults);
    cJSON *again = json_merge_patch(merged, patch);
    struct scene *made = scene_create(again, &faults);
    cJSON_Delete(scene);
    cJSON_Delete(patch);
    cJSON_Delete(merged);
    cJSON_Delete(again);
    faults_free(&faults);
    assert_non_null(made);
    return made;
}

static struct run *begin(const char *id, bool start, const char *more) {
    struct run_definition definition = {
        .id = id, .name = "dam-break", .scene = small_dam(more), .start = start};
    bool storage;
    struct run *run = run_create(&host, &definition, &storage, why);
    assert_non_null(run);
    return run;
}

static enum run_outcome command(struct run *run, struct run_command *c) {
    run_command(run, c);
    faults_free(&c->faults);
    return c->outcome;
}

static enum run_outcome act(struct run *run, enum run_action action) {
    struct run_command c = {.action = action};
    return command(run, &c);
}

static struct run_status wait_for(struct run *run, enum run_state state) {
    struct run_status status = run_status(run);
    for (int k = 0; k < 20000 && status.state != state; k++) {
        usleep(1000);
        status = run_status(run);
    }
    assert_int_equal(status.state, state);
    return status;
}

static void step_to(struct run *run, uint64_t step) {
    struct run_command c = {.action = RUN_DO_STEP, .steps = step - run_status(run).step};
    assert_int_equal(command(run, &c), RUN_DONE);
    assert_int_equal(wait_for(run, RUN_PAUSED).step, step);
}

static uint64_t digest_of(struct run *run, uint64_t seq) {
    struct journal_frame frame;
    assert_true(journal_frame(run_journal(run), seq, &frame));
    return frame.digest;
}

static void test_run_final_states_refuse_all_but_their_own(void **state) {
    (void)state;
    for (int action = 0; action < RUN_N_ACTIONS; action++)
        for (int s = 0; s < RUN_N_STATES; s++) {
            enum run_verdict verdict = run_verdict((enum run_action)action, (enum run_state)s);
            if (run_state_is_final((enum run_state)s))
                assert_int_equal(verdict, action == RUN_DO_CANCEL && s == RUN_CANCELLED
                                              ? RUN_ALREADY
                                              : RUN_REFUSED);
            else if (action == RUN_DO_CANCEL || action == RUN_DO_CONFIGURE)
                assert_int_equal(verdict, RUN_ACTS);
        }
    assert_int_equal(run_verdict(RUN_DO_PAUSE, RUN_PAUSED), RUN_ALREADY);
    assert_int_equal(run_verdict(RUN_DO_START, RUN_RUNNING), RUN_ALREADY);
    assert_int_equal(run_verdict(RUN_DO_STEP, RUN_RUNNING), RUN_REFUSED);
}

static void test_run_state_names_read_back(void **state) {
    (void)state;
    for (int s = 0; s < RUN_N_STATES; s++)
        assert_int_equal(run_state_parse(run_state_name((enum run_state)s)), s);
    assert_int_equal(run_state_parse("sleeping"), -1);
}

static void test_run_threads_follow_its_size(void **state) {
    (void)state;
    struct run_host four = {.threads = 4, .threads_fit = true};
    const uint64_t each = RUN_PARTICLES_PER_THREAD;
    const uint64_t size[] = {0, 1, each, 2 * each - 1, 2 * each, 3 * each, 4 * each, UINT64_MAX};
    const int threads[] = {1, 1, 1, 1, 2, 3, 4, 4};
    for (size_t k = 0; k < sizeof size / sizeof *size; k++) {
        assert_int_equal(run_threads(&four, size[k]), threads[k]);
    }
    four.threads_fit = false; // the user has said how many
    assert_int_equal(run_threads(&four, 1), 4);
}

static void test_run_completes_with_dense_frames(void **state) {
    (void)state;
    struct run *run = begin("complete", true, "{}");
    struct run_status status = wait_for(run, RUN_COMPLETED);
    assert_int_equal(status.step, 500);
    assert_true(fabs(status.time - 0.1) < 1e-12);
    struct journal_frame frame;
    assert_int_equal(journal_n_frames(run_journal(run)), 11);
    for (uint64_t seq = 0; seq < 11; seq++) {
        assert_true(journal_frame(run_journal(run), seq, &frame));
        assert_int_equal(frame.step, 50 * seq); // a fixed dt hits its frame times exactly
        assert_int_equal(frame.end, seq == 10);
    }
    assert_int_equal(frame.state, RUN_COMPLETED);
    double known = 0;
    for (int k = 0; k < RUN_N_PHASES; k++)
        known += k == RUN_PHASE_WAITING ? 0 : status.phases[k];
    assert_true(fabs(known - status.wall_s) < 1e-3 * status.wall_s + 1e-4);
    assert_int_equal(act(run, RUN_DO_PAUSE), RUN_ILLEGAL);
    run_release(run);
}

static void test_run_step_counts_and_pauses(void **state) {
    (void)state;
    struct run *run = begin("step", false, "{}");
    assert_int_equal(wait_for(run, RUN_PAUSED).step, 0);
    step_to(run, 7);
    struct run_command until = {.action = RUN_DO_STEP, .until = 0.02};
    assert_int_equal(command(run, &until), RUN_DONE);
    assert_int_equal(until.effective_step, 7);
    assert_int_equal(wait_for(run, RUN_PAUSED).step, 100);
    until = (struct run_command){.action = RUN_DO_STEP, .until = 0.01};
    assert_int_equal(command(run, &until), RUN_INVALID);
    assert_int_equal(act(run, RUN_DO_PAUSE), RUN_DONE);
    assert_int_equal(act(run, RUN_DO_CANCEL), RUN_DONE);
    assert_int_equal(run_status(run).state, RUN_CANCELLED);
    assert_int_equal(act(run, RUN_DO_CANCEL), RUN_DONE);
    struct journal_frame last;
    uint64_t n = journal_n_frames(run_journal(run));
    assert_true(journal_frame(run_journal(run), n - 1, &last) && last.end);
    run_release(run);
}

static void test_run_snapshot_of_one_step_is_one_frame(void **state) {
    (void)state;
    struct run *run = begin("snapshot", false, "{}");
    step_to(run, 3);
    struct run_command c = {.action = RUN_DO_SNAPSHOT};
    assert_int_equal(command(run, &c), RUN_DONE);
    uint64_t seq = c.frame_seq, n = journal_n_frames(run_journal(run));
    assert_int_equal(n, seq + 1);
    assert_int_equal(command(run, &c), RUN_DONE);
    assert_int_equal(c.frame_seq, seq);
    assert_int_equal(journal_n_frames(run_journal(run)), n);
    run_release(run);
}

static cJSON *patch_of(const char *text) {
    struct faults faults = {0};
    cJSON *patch = json_parse(text, strlen(text), &faults);
    assert_non_null(patch);
    return patch;
}

static enum run_outcome configure(struct run *run, const char *text, uint64_t *step) {
    cJSON *patch = patch_of(text);
    struct run_command c = {.action = RUN_DO_CONFIGURE, .patch = patch};
    enum run_outcome outcome = command(run, &c);
    cJSON_Delete(patch);
    *step = c.effective_step;
    return outcome;
}

static void test_run_configuration_changes_at_a_step(void **state) {
    uint64_t step;
    (void)state;
    struct run *run = begin("configure", false, "{}");
    step_to(run, 20);
    assert_true(run_status(run).fbar);
    assert_int_equal(configure(run, "{\"fbar\":false}", &step), RUN_DONE);
    assert_int_equal(step, 20);
    assert_false(run_status(run).fbar);
    assert_int_equal(run_status(run).revision, 1);
    assert_int_equal(configure(run, "{\"fbar\":false}", &step), RUN_DONE);
    assert_int_equal(run_status(run).revision, 1); // nothing changed
    assert_int_equal(configure(run, "{\"cell\":1}", &step), RUN_INVALID);
    assert_int_equal(configure(run, "{\"time\":{\"dt\":1}}", &step), RUN_INVALID);
    cJSON *patch = patch_of("{\"fbar\":true}");
    struct run_command stale = {
        .action = RUN_DO_CONFIGURE, .patch = patch, .has_revision = true, .revision = 0};
    assert_int_equal(command(run, &stale), RUN_STALE);
    cJSON_Delete(patch);
    assert_int_equal(configure(run, "{\"time\":{\"end\":0.05}}", &step), RUN_DONE);
    act(run, RUN_DO_RESUME);
    assert_int_equal(wait_for(run, RUN_COMPLETED).step, 250);
    run_release(run);
}

static void test_run_continues_with_the_same_bits(void **state) {
    uint64_t step, digests[11];
    (void)state;
    struct run *run = begin("restart", false, "{}");
    step_to(run, 120);
    assert_int_equal(
        configure(run, "{\"fbar\":false,\"time\":{\"dt\":1.234567890123456e-4}}", &step), RUN_DONE);
    act(run, RUN_DO_RESUME);
    wait_for(run, RUN_COMPLETED);
    uint64_t n = journal_n_frames(run_journal(run));
    assert_int_equal(n, 11);
    for (uint64_t seq = 0; seq < n; seq++)
        digests[seq] = digest_of(run, seq);
    run_release(run);
    assert_int_equal(journal_remove(folder, "restart", why), 0);
    // Once more, with a stop of the daemon before and after the change, and one in mid-run.
    run = begin("restart", false, "{}");
    step_to(run, 120);
    run_release(run);
    run = run_restore(&host, "restart", RUN_RESTORE_CONTINUE);
    assert_int_equal(run_status(run).state, RUN_PAUSED);
    assert_int_equal(run_status(run).step, 120);
    assert_int_equal(
        configure(run, "{\"fbar\":false,\"time\":{\"dt\":1.234567890123456e-4}}", &step), RUN_DONE);
    assert_int_equal(step, 120);
    run_release(run);
    run = run_restore(&host, "restart", RUN_RESTORE_CONTINUE);
    assert_int_equal(run_status(run).revision, 1);
    step_to(run, 300);
    act(run, RUN_DO_RESUME);
    run_release(run);
    run = run_restore(&host, "restart", RUN_RESTORE_CONTINUE);
    wait_for(run, RUN_COMPLETED);
    assert_int_equal(journal_n_frames(run_journal(run)), n);
    for (uint64_t seq = 0; seq < n; seq++)
        assert_int_equal(digest_of(run, seq), digests[seq]);
    assert_int_equal(run_status(run).epoch, 0);
    run_release(run);
    run = run_restore(&host, "restart", RUN_RESTORE_CONTINUE);
    assert_int_equal(run_status(run).state, RUN_COMPLETED);
    run_release(run);
}

static void test_run_failure_keeps_the_last_good_frame(void **state) {
    (void)state;
    struct run *run =
        begin("fail", true, "{\"time\":{\"dt\":4e-3,\"end\":1,\"unstable_ok\":true}}");
    struct run_status status = wait_for(run, RUN_FAILED);
    assert_true(status.error.present);
    assert_true(status.error.kind[0] != '\0' && status.error.advice[0] != '\0');
    struct journal_frame last, before;
    uint64_t n = journal_n_frames(run_journal(run));
    assert_true(journal_frame(run_journal(run), n - 1, &last) && last.end);
    assert_int_equal(last.state, RUN_FAILED);
    assert_true(journal_frame(run_journal(run), n - 2, &before));
    assert_int_equal(last.step, before.step);
    run_release(run);
    run = run_restore(&host, "fail", RUN_RESTORE_CONTINUE);
    assert_int_equal(run_status(run).state, RUN_FAILED);
    assert_string_equal(run_status(run).error.kind, status.error.kind);
    run_release(run);
}

static void test_run_slots_are_granted_in_turn(void **state) {
    (void)state;
    struct run *first = begin("one", true, "{\"time\":{\"end\":100}}");
    wait_for(first, RUN_RUNNING);
    struct run *second = begin("two", true, "{}");
    assert_int_equal(run_status(second).state, RUN_QUEUED);
    assert_int_equal(act(second, RUN_DO_SNAPSHOT), RUN_ILLEGAL);
    assert_int_equal(act(first, RUN_DO_PAUSE), RUN_DONE); // a paused run holds no slot
    wait_for(second, RUN_COMPLETED);
    assert_int_equal(act(first, RUN_DO_RESUME), RUN_DONE);
    assert_int_equal(run_status(first).state, RUN_RUNNING);
    assert_int_equal(act(first, RUN_DO_CANCEL), RUN_DONE);
    run_release(first);
    run_release(second);
}

static void *pester(void *context) {
    struct run *run = context;
    for (int k = 0; k < 60; k++) {
        act(run, k % 3 == 0 ? RUN_DO_PAUSE : k % 3 == 1 ? RUN_DO_RESUME : RUN_DO_SNAPSHOT);
        run_status(run);
    }
    return NULL;
}

// Pauses and snapshots from many sides change nothing of the result.
static void test_run_result_does_not_depend_on_commands(void **state) {
    pthread_t threads[4];
    (void)state;
    struct run *calm = begin("calm", true, "{}");
    wait_for(calm, RUN_COMPLETED);
    struct run *run = begin("pestered", true, "{}");
    for (int k = 0; k < 4; k++)
        assert_int_equal(pthread_create(&threads[k], NULL, pester, run), 0);
    for (int k = 0; k < 4; k++)
        pthread_join(threads[k], NULL);
    act(run, RUN_DO_RESUME);
    wait_for(run, RUN_COMPLETED);
    struct run_status a = run_status(calm), b = run_status(run);
    assert_memory_equal(&a.balance, &b.balance, sizeof a.balance);
    assert_int_equal(series_n_rows(run_series(calm)), series_n_rows(run_series(run)));
    run_release(calm);
    run_release(run);
}

static void test_runs_ids_follow_the_pattern(void **state) {
    char long_id[80];
    (void)state;
    memset(long_id, 'a', sizeof long_id);
    long_id[64] = '\0';
    assert_true(runs_id_valid(long_id));
    assert_true(runs_id_valid("a.b_c-1"));
    long_id[64] = 'a';
    long_id[65] = '\0';
    const char *bad[] = {"", ".a", "-a", "a/b", "..", "a b", "\xc3\xa4", long_id};
    for (size_t k = 0; k < sizeof bad / sizeof *bad; k++)
        assert_false(runs_id_valid(bad[k]));
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_run_final_states_refuse_all_but_their_own),
        cmocka_unit_test(test_run_state_names_read_back),
        cmocka_unit_test(test_run_threads_follow_its_size),
        cmocka_unit_test(test_run_completes_with_dense_frames),
        cmocka_unit_test(test_run_step_counts_and_pauses),
        cmocka_unit_test(test_run_snapshot_of_one_step_is_one_frame),
        cmocka_unit_test(test_run_configuration_changes_at_a_step),
        cmocka_unit_test(test_run_continues_with_the_same_bits),
        cmocka_unit_test(test_run_failure_keeps_the_last_good_frame),
        cmocka_unit_test(test_run_slots_are_granted_in_turn),
        cmocka_unit_test(test_run_result_does_not_depend_on_commands),
        cmocka_unit_test(test_runs_ids_follow_the_pattern),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, open_host, close_host);
}
