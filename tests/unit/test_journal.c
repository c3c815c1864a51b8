// The journal: what was appended is read back; a torn tail is cut at every length; damage before
// the tail is refused with its place; checkpoints are whole or not there; series likewise.
#include <fcntl.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

#include "proto/frame.h"
#include "server/journal.h"
#include "server/recorders.h"
#include "server/series.h"

static char folder[64], why[JOURNAL_WHY];

static int make_folder(void **state) {
    (void)state;
    snprintf(folder, sizeof folder, "/tmp/fbard-test-XXXXXX");
    if (mkdtemp(folder) == NULL)
        return -1;
    int lock = journal_lock(folder, why);
    return lock < 0 ? -1 : close(lock);
}

static int remove_folder(void **state) {
    char command[128];
    (void)state;
    snprintf(command, sizeof command, "rm -rf %s", folder);
    return system(command);
}

static void *make_frame(uint64_t seq, size_t count, struct journal_frame *info) {
    struct frame_plan plan = {
        .run = "r",
        .seq = seq,
        .step = 10 * seq,
        .time = 0.1 * (double)seq,
        .dimension = 2,
        .count = count,
        .state = "running",
        .probes = "{}",
        .n_fields = 1,
        .fields = {
            {.name = "position", .unit = "m", .dtype = "<f8", .rank = 2, .shape = {count, 2}}}};
    assert_int_equal(frame_layout(&plan), 0);
    unsigned char *frame = calloc(1, plan.total_bytes);
    frame_write_header(&plan, frame);
    for (size_t k = 0; k < plan.fields[0].bytes; k++)
        frame[plan.fields[0].offset + k] = (unsigned char)(k * 31 + seq);
    frame_seal(frame);
    *info = (struct journal_frame){
        .seq = seq, .step = plan.step, .time = plan.time, .bytes = plan.total_bytes};
    return frame;
}

static void append_frames(struct journal *journal, uint64_t from, uint64_t to, size_t count) {
    for (uint64_t seq = from; seq < to; seq++) {
        struct journal_frame info;
        void *frame = make_frame(seq, count, &info);
        assert_int_equal(journal_append_frame(journal, frame, &info, why), JOURNAL_OK);
        free(frame);
    }
}

static void assert_frame_reads(struct journal *journal, uint64_t seq, size_t count) {
    struct journal_frame info, there;
    unsigned char *frame = make_frame(seq, count, &info), *read = malloc(info.bytes);
    int fd = journal_frame_open(journal, seq, &there, why);
    assert_true(fd >= 0);
    assert_int_equal(there.bytes, info.bytes);
    assert_int_equal(there.step, info.step);
    assert_int_equal(pread(fd, read, info.bytes, (off_t)there.offset), info.bytes);
    assert_memory_equal(read, frame, info.bytes);
    close(fd);
    free(read);
    free(frame);
}

static struct journal *fresh(const char *id) {
    struct journal *journal = journal_create(folder, id, "{}", "{}", why);
    assert_non_null(journal);
    return journal;
}

static void segment_of(const char *id, char *path, size_t bytes) {
    snprintf(path, bytes, "%s/runs/%s/frames-00000000.seg", folder, id);
}

static void test_journal_reads_back_what_was_appended(void **state) {
    (void)state;
    struct journal *journal = fresh("a");
    append_frames(journal, 0, 5, 7);
    assert_int_equal(journal_append_event(journal, "{\"event\":\"x\"}", why), JOURNAL_OK);
    journal_close(journal);
    journal = journal_open(folder, "a", why);
    assert_non_null(journal);
    assert_int_equal(journal_n_frames(journal), 5);
    assert_int_equal(journal_n_events(journal), 1);
    assert_int_equal(journal_cut_bytes(journal), 0);
    append_frames(journal, 5, 8, 7);
    for (uint64_t seq = 0; seq < 8; seq++)
        assert_frame_reads(journal, seq, 7);
    struct journal_frame at;
    assert_true(journal_frame_at_step(journal, 35, &at) && at.seq == 3);
    assert_int_equal(journal_frame_open(journal, 8, &at, why), -1);
    journal_close(journal);
}

static void test_journal_cuts_a_torn_tail_at_every_length(void **state) {
    char path[256];
    (void)state;
    struct journal *journal = fresh("t");
    struct journal_frame last;
    append_frames(journal, 0, 3, 2);
    assert_true(journal_frame(journal, 2, &last));
    journal_close(journal);
    segment_of("t", path, sizeof path);
    struct stat whole;
    assert_int_equal(stat(path, &whole), 0);
    // From the last byte down to none of the last record, and then append again.
    for (off_t size = whole.st_size - 1; size >= (off_t)last.offset - 64; size -= 13) {
        assert_int_equal(truncate(path, size), 0);
        journal = journal_open(folder, "t", why);
        assert_non_null(journal);
        assert_int_equal(journal_n_frames(journal), 2);
        append_frames(journal, 2, 3, 2);
        journal_close(journal);
        journal = journal_open(folder, "t", why);
        assert_non_null(journal);
        assert_int_equal(journal_n_frames(journal), 3);
        assert_frame_reads(journal, 2, 2);
        journal_close(journal);
    }
    // Down to the segment's own header.
    for (off_t size = 63; size >= 0; size -= 21) {
        assert_int_equal(truncate(path, size), 0);
        journal = journal_open(folder, "t", why);
        assert_non_null(journal);
        assert_int_equal(journal_n_frames(journal), 0);
        append_frames(journal, 0, 1, 2);
        journal_close(journal);
    }
}

static void test_journal_refuses_damage_before_the_tail(void **state) {
    char path[256];
    (void)state;
    struct journal *journal = fresh("d");
    append_frames(journal, 0, 4, 2);
    struct journal_frame second;
    assert_true(journal_frame(journal, 1, &second));
    journal_close(journal);
    segment_of("d", path, sizeof path);
    // In the segment's header, a record's header, its chain, the frame's preamble, and its array.
    const uint64_t places[] = {20, second.offset - 60, second.offset - 14, second.offset + 9,
                               second.offset + second.bytes - 20};
    for (size_t k = 0; k < sizeof places / sizeof *places; k++) {
        unsigned char byte;
        int fd = open(path, O_RDWR);
        assert_int_equal(pread(fd, &byte, 1, (off_t)places[k]), 1);
        byte ^= 0x10;
        assert_int_equal(pwrite(fd, &byte, 1, (off_t)places[k]), 1);
        why[0] = '\0';
        assert_null(journal_open(folder, "d", why));
        assert_non_null(strstr(why, "frames-00000000.seg"));
        byte ^= 0x10;
        assert_int_equal(pwrite(fd, &byte, 1, (off_t)places[k]), 1);
        close(fd);
    }
    journal = journal_open(folder, "d", why);
    assert_non_null(journal);
    journal_close(journal);
}

static void test_journal_drops_oldest_segments_beyond_its_budget(void **state) {
    (void)state;
    struct journal *journal = fresh("b");
    const size_t count = 1000; // 16 kB a frame
    journal_budget(journal, 400000);
    append_frames(journal, 0, 60, count);
    uint64_t gone = journal_n_gone(journal);
    assert_true(gone > 0 && gone < 60);
    assert_true(journal_frame_bytes(journal) <= 400000);
    struct journal_frame info;
    assert_int_equal(journal_frame_open(journal, gone - 1, &info, why), -1);
    assert_true(info.gone);
    assert_frame_reads(journal, gone, count);
    journal_close(journal);
    journal = journal_open(folder, "b", why);
    assert_non_null(journal);
    assert_int_equal(journal_n_gone(journal), gone);
    assert_int_equal(journal_n_frames(journal), 60);
    assert_frame_reads(journal, 59, count);
    append_frames(journal, 60, 61, count);
    journal_close(journal);
}

static void test_journal_refuses_a_gap_in_seq(void **state) {
    (void)state;
    struct journal *journal = fresh("g");
    struct journal_frame info;
    void *frame = make_frame(1, 2, &info);
    assert_int_equal(journal_append_frame(journal, frame, &info, why), JOURNAL_ERROR);
    free(frame);
    journal_close(journal);
}

static void test_journal_cuts_half_an_event(void **state) {
    char path[256];
    size_t bytes;
    (void)state;
    struct journal *journal = fresh("e");
    journal_append_event(journal, "{\"event\":\"one\"}", why);
    journal_close(journal);
    snprintf(path, sizeof path, "%s/runs/e/events.jsonl", folder);
    FILE *file = fopen(path, "a");
    fputs("{\"event\":\"tw", file);
    fclose(file);
    journal = journal_open(folder, "e", why);
    assert_non_null(journal);
    journal_append_event(journal, "{\"event\":\"three\"}", why);
    assert_int_equal(journal_n_events(journal), 2);
    char *text = journal_text(journal, "events.jsonl", &bytes);
    char *second = strchr(text, '\n') + 1;
    const char one[] = "{\"event\":\"one\",\"check\":\"",
               three[] = "{\"event\":\"three\",\"check\":\"";
    assert_memory_equal(text, one, sizeof one - 1);
    assert_memory_equal(second, three, sizeof three - 1);
    assert_ptr_equal(strchr(second, '\n'), text + bytes - 1);
    free(text);
    journal_close(journal);
}

// Every single byte: none can be changed, and no line be taken out, without its place being named.
static void test_journal_refuses_a_changed_event(void **state) {
    char path[256], wanted[32];
    size_t bytes;
    (void)state;
    struct journal *journal = fresh("ec");
    for (int k = 0; k < 3; k++) {
        char event[32];
        snprintf(event, sizeof event, "{\"event\":\"number %d\"}", k);
        assert_int_equal(journal_append_event(journal, event, why), JOURNAL_OK);
    }
    char *text = journal_text(journal, "events.jsonl", &bytes);
    journal_close(journal);
    snprintf(path, sizeof path, "%s/runs/ec/events.jsonl", folder);
    int fd = open(path, O_RDWR), line = 1;
    for (size_t at = 0; at < bytes; at++) {
        char changed = text[at] ^ 1;
        assert_int_equal(pwrite(fd, &changed, 1, (off_t)at), 1);
        if (at + 1 < bytes) { // the very last byte is the end of the last line: a torn tail
            assert_null(journal_open(folder, "ec", why));
            snprintf(wanted, sizeof wanted, "damaged line %d", line);
            assert_non_null(strstr(why, wanted));
        }
        assert_int_equal(pwrite(fd, text + at, 1, (off_t)at), 1);
        line += text[at] == '\n';
    }
    char *second = strchr(text, '\n') + 1, *third = strchr(second, '\n') + 1;
    size_t tail = bytes - (size_t)(third - text);
    assert_int_equal(pwrite(fd, third, tail, second - text), tail);
    assert_int_equal(ftruncate(fd, (second - text) + (off_t)tail), 0);
    close(fd);
    assert_null(journal_open(folder, "ec", why));
    assert_non_null(strstr(why, "damaged line 2"));
    free(text);
}

// What a recorder has not acknowledged stays, whatever the budget; then there is no room, but for
// the last frames of a run; and what it acknowledges makes room.
static void test_journal_keeps_what_is_not_acknowledged(void **state) {
    (void)state;
    struct journal *journal = fresh("k");
    const size_t count = 1000; // 16 kB a frame
    struct journal_frame info;
    journal_budget(journal, 400000);
    journal_keep(journal, 0);
    uint64_t n = 0;
    void *frame = make_frame(n, count, &info);
    while (journal_append_frame(journal, frame, &info, why) == JOURNAL_OK) {
        free(frame);
        frame = make_frame(++n, count, &info);
        assert_true(n < 60);
    }
    assert_int_equal(journal_append_frame(journal, frame, &info, why), JOURNAL_HELD);
    assert_int_equal(n, journal_n_frames(journal));
    assert_int_equal(journal_n_gone(journal), 0);
    assert_true(journal_frame_bytes(journal) <= 400000 && n > 400000 / 20000);
    journal_overdraw(journal, true);
    assert_int_equal(journal_append_frame(journal, frame, &info, why), JOURNAL_OK);
    assert_false(journal_held(journal));
    journal_overdraw(journal, false);
    assert_true(journal_held(journal));
    free(frame);
    frame = make_frame(n + 1, count, &info);
    assert_int_equal(journal_append_frame(journal, frame, &info, why), JOURNAL_HELD);
    for (uint64_t keep = 0; journal_append_frame(journal, frame, &info, why) != JOURNAL_OK;
         keep++) {
        assert_true(keep <= n);
        journal_keep(journal, keep);
        assert_true(journal_n_gone(journal) <= keep);
    }
    assert_true(journal_n_gone(journal) > 0);
    for (uint64_t seq = journal_n_gone(journal); seq < n; seq++)
        assert_frame_reads(journal, seq, count);
    free(frame);
    // All acknowledged: even where the newest segment alone fills the budget there is room.
    journal_budget(journal, 20000);
    for (uint64_t seq = n + 2; seq < n + 8; seq++) {
        journal_keep(journal, seq);
        append_frames(journal, seq, seq + 1, count);
    }
    journal_close(journal);
}

// Mapped frames are those of the journal, and outlive their segment.
static void test_journal_maps_frames_that_outlive_their_segment(void **state) {
    (void)state;
    struct journal *journal = fresh("m");
    struct journal_map maps[3];
    struct journal_frame info;
    journal_budget(journal, 100000);
    append_frames(journal, 0, 3, 1000);
    for (uint64_t seq = 0; seq < 3; seq++)
        assert_true(journal_frame_map(journal, seq, &maps[seq], why));
    append_frames(journal, 3, 30, 1000);
    assert_true(journal_n_gone(journal) >= 3);
    for (uint64_t seq = 0; seq < 3; seq++) {
        void *frame = make_frame(seq, 1000, &info);
        assert_int_equal(maps[seq].bytes, info.bytes);
        assert_memory_equal(maps[seq].frame, frame, info.bytes);
        journal_frame_unmap(&maps[seq]);
        free(frame);
    }
    assert_false(journal_frame_map(journal, 0, &maps[0], why));
    journal_close(journal);
}

static void test_journal_says_that_its_folder_is_gone(void **state) {
    char command[256];
    struct journal_frame info;
    (void)state;
    struct journal *journal = fresh("v");
    append_frames(journal, 0, 2, 2);
    snprintf(command, sizeof command, "rm -rf %s/runs/v", folder);
    assert_int_equal(system(command), 0);
    void *frame = make_frame(2, 2, &info);
    assert_int_equal(journal_append_frame(journal, frame, &info, why), JOURNAL_ERROR);
    assert_int_equal(journal_append_event(journal, "{}", why), JOURNAL_ERROR);
    assert_int_equal(journal_checkpoint(journal, "{}", "x", 1, why), JOURNAL_ERROR);
    free(frame);
    journal_close(journal);
}

// Names go bad, acknowledgements go forth and back, and a registration is there after a restart.
static void test_recorders_are_kept_over_a_restart(void **state) {
    struct recorder all[RECORDERS_MAX];
    char name[16];
    (void)state;
    struct journal *journal = fresh("rec");
    append_frames(journal, 0, 10, 2);
    struct recorders *recorders = recorders_open(journal, why);
    assert_int_equal(recorders_list(recorders, all), 0);
    assert_int_equal(recorders_put(recorders, "a", -1, why), RECORDERS_OK);
    assert_int_equal(recorders_put(recorders, "b", 4, why), RECORDERS_OK);
    assert_int_equal(recorders_put(recorders, "a", 10, why), RECORDERS_AHEAD);
    assert_int_equal(recorders_put(recorders, "a", 9, why), RECORDERS_OK);
    assert_int_equal(recorders_put(recorders, "b", 2, why), RECORDERS_OK); // it lost its file
    assert_true(recorders_slowest(recorders, all));
    assert_string_equal(all[0].name, "b");
    recorders_free(recorders);
    recorders = recorders_open(journal, why);
    assert_int_equal(recorders_list(recorders, all), 2);
    assert_true(all[0].acked <= 9); // may be older than what was acknowledged, never newer
    assert_int_equal(all[1].acked, 2);
    assert_int_equal(recorders_remove(recorders, "c", why), RECORDERS_UNKNOWN);
    assert_int_equal(recorders_remove(recorders, "b", why), RECORDERS_OK);
    recorders_free(recorders);
    recorders = recorders_open(journal, why);
    assert_int_equal(recorders_list(recorders, all), 1);
    for (int k = 1; k < RECORDERS_MAX; k++) {
        snprintf(name, sizeof name, "n%d", k);
        assert_int_equal(recorders_put(recorders, name, -1, why), RECORDERS_OK);
    }
    assert_int_equal(recorders_put(recorders, "more", -1, why), RECORDERS_TOO_MANY);
    recorders_free(recorders);
    assert_int_equal(journal_replace(journal, "recorders.json", "{", 1, why), JOURNAL_OK);
    assert_null(recorders_open(journal, why));
    journal_close(journal);
}

static void test_journal_keeps_the_previous_checkpoint(void **state) {
    char path[256], *meta;
    void *data;
    size_t bytes;
    (void)state;
    struct journal *journal = fresh("c");
    assert_false(journal_checkpoint_read(journal, 0, &meta, &data, &bytes));
    assert_int_equal(journal_checkpoint(journal, "{\"n\":1}", "first", 5, why), JOURNAL_OK);
    assert_int_equal(journal_checkpoint(journal, "{\"n\":2}", "second", 6, why), JOURNAL_OK);
    for (int which = 0; which < 2; which++) {
        assert_true(journal_checkpoint_read(journal, which, &meta, &data, &bytes));
        assert_string_equal(meta, which == 0 ? "{\"n\":2}" : "{\"n\":1}");
        assert_int_equal(bytes, which == 0 ? 6 : 5);
        assert_memory_equal(data, which == 0 ? "second" : "first", bytes);
        free(meta);
        free(data);
    }
    // Cut or changed, it is not there: the previous one serves.
    snprintf(path, sizeof path, "%s/runs/c/checkpoint.bin", folder);
    assert_int_equal(truncate(path, 130), 0);
    assert_false(journal_checkpoint_read(journal, 0, &meta, &data, &bytes));
    assert_true(journal_checkpoint_read(journal, 1, &meta, &data, &bytes));
    free(meta);
    free(data);
    journal_close(journal);
}

static void test_journal_lists_and_removes_runs(void **state) {
    size_t count;
    char path[256];
    (void)state;
    journal_close(fresh("one"));
    journal_close(fresh("two"));
    snprintf(path, sizeof path, "%s/runs/.new-three", folder);
    assert_int_equal(mkdir(path, 0700), 0); // killed while it was made
    assert_int_equal(journal_remove(folder, "one", why), 0);
    char **ids = journal_list(folder, &count);
    bool found = false;
    for (size_t k = 0; k < count; k++) {
        assert_string_not_equal(ids[k], "one");
        found = found || strcmp(ids[k], "two") == 0;
        free(ids[k]);
    }
    free(ids);
    assert_true(found);
    assert_int_equal(access(path, F_OK), -1);
}

static void test_journal_lock_keeps_a_second_daemon_out(void **state) {
    (void)state;
    int first = journal_lock(folder, why);
    assert_true(first >= 0);
    assert_int_equal(journal_lock(folder, why), -1);
    assert_non_null(strstr(why, "in use"));
    close(first);
    first = journal_lock(folder, why);
    assert_true(first >= 0);
    close(first);
}

static struct series *two_probes(void) {
    const char *names[] = {"front", "force"}, *scalar[] = {""}, *vector[] = {"x", "y"};
    const char *const *components[] = {scalar, vector};
    const size_t counts[] = {1, 2};
    return series_create(2, names, counts, components);
}

static void test_series_survives_a_torn_tail(void **state) {
    char path[256];
    (void)state;
    snprintf(path, sizeof path, "%s/probes.log", folder);
    struct series *series = two_probes();
    assert_int_equal(series_save_as(series, path, why), 0);
    for (uint64_t step = 0; step < 50; step++) {
        const double row[] = {(double)step, step == 7 ? NAN : 1.0 / (double)(step + 1), -1};
        assert_int_equal(series_append(series, 10 * step, 0.1 * (double)step, row),
                         SERIES_APPENDED);
    }
    assert_int_equal(series_flush(series), 0);
    series_free(series);
    struct stat info;
    stat(path, &info);
    assert_int_equal(truncate(path, info.st_size - 3), 0);
    series = series_load(path, why);
    assert_non_null(series);
    assert_int_equal(series_n_rows(series), 49);
    assert_string_equal(series_probe(series, 1)->components[1], "y");
    uint64_t step;
    double time, row[3], value;
    assert_true(series_at_step(series, 75, &step, &time, row));
    assert_int_equal(step, 70);
    assert_true(isnan(row[1]));
    assert_true(series_at_time(series, 0, 1.25, &value));
    assert_true(fabs(value - 12.5) < 1e-12); // linear in between; round-off of the times
    assert_false(series_at_time(series, 0, 4.9, &value));
    // The same sample again is known; another one takes the place of all that followed.
    const double same[] = {48, 1.0 / 49.0, -1}, other[] = {10, 2, 3};
    assert_int_equal(series_append(series, 480, 0.1 * 48.0, same), SERIES_SAME);
    assert_int_equal(series_append(series, 100, 1.0, other), SERIES_DIFFERENT);
    assert_int_equal(series_n_rows(series), 11);
    series_free(series);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_journal_reads_back_what_was_appended),
        cmocka_unit_test(test_journal_cuts_a_torn_tail_at_every_length),
        cmocka_unit_test(test_journal_refuses_damage_before_the_tail),
        cmocka_unit_test(test_journal_drops_oldest_segments_beyond_its_budget),
        cmocka_unit_test(test_journal_refuses_a_gap_in_seq),
        cmocka_unit_test(test_journal_cuts_half_an_event),
        cmocka_unit_test(test_journal_refuses_a_changed_event),
        cmocka_unit_test(test_journal_keeps_what_is_not_acknowledged),
        cmocka_unit_test(test_journal_maps_frames_that_outlive_their_segment),
        cmocka_unit_test(test_journal_says_that_its_folder_is_gone),
        cmocka_unit_test(test_recorders_are_kept_over_a_restart),
        cmocka_unit_test(test_journal_keeps_the_previous_checkpoint),
        cmocka_unit_test(test_journal_lists_and_removes_runs),
        cmocka_unit_test(test_journal_lock_keeps_a_second_daemon_out),
        cmocka_unit_test(test_series_survives_a_torn_tail),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
