// The readers of a run's folder. The first byte says which file the rest is: 0 events.jsonl,
// 1 frames-00000000.seg, 2 checkpoint.bin, 3 recorders.json, 4 probes.log, 5 run.json; with 0x80
// added, the checksums of its headers are made right, so that what they guard is reached too.
// Damage must be told with a reason; what is read as whole must be readable to its end.
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "proto/frame.h"
#include "server/history.h"
#include "server/journal_inside.h"
#include "server/recorders.h"
#include "server/series.h"
#include "tests/fuzz/fuzz.h"

static const char *const names[] = {"events.jsonl",   "frames-00000000.seg", "checkpoint.bin",
                                    "recorders.json", "probes.log",          "run.json"};
#define N_NAMES (sizeof names / sizeof *names)
static char root[64], folder[128];

static void clean(void) {
    char path[256];
    for (size_t k = 0; k < N_NAMES; k++) {
        snprintf(path, sizeof path, "%s/%s", folder, names[k]);
        unlink(path);
    }
    rmdir(folder);
    snprintf(path, sizeof path, "%s/runs", root);
    rmdir(path);
    rmdir(root);
}

static void make_folder(void) {
    char path[128];
    snprintf(root, sizeof root, "%s/fbard-fuzz-XXXXXX",
             access("/dev/shm", W_OK) == 0 ? "/dev/shm" : "/tmp");
    FUZZ_MUST(mkdtemp(root) != NULL);
    snprintf(path, sizeof path, "%s/runs", root);
    FUZZ_MUST(mkdir(path, 0700) == 0);
    snprintf(folder, sizeof folder, "%s/runs/r", root);
    FUZZ_MUST(mkdir(folder, 0700) == 0);
    atexit(clean);
}

static void mend_header(unsigned char *header) {
    uint64_t check = XXH3_64bits(header, JOURNAL_CHECK_AT);
    memcpy(header + JOURNAL_CHECK_AT, &check, sizeof check);
}

static void mend(unsigned char *file, size_t size) {
    for (size_t at = 0; at + JOURNAL_HEADER <= size; at += JOURNAL_HEADER)
        if (at == 0 || memcmp(file + at, "FREC", 4) == 0)
            mend_header(file + at);
}

static void read_frames(struct journal *j) {
    char why[JOURNAL_WHY];
    struct journal_frame frame;
    struct journal_map map;
    uint64_t n = journal_n_frames(j);
    FUZZ_MUST(journal_n_gone(j) <= n);
    for (uint64_t seq = 0; seq < n && seq < 100; seq++) {
        FUZZ_MUST(journal_frame(j, seq, &frame) && frame.seq == seq);
        why[0] = '\0';
        int fd = journal_frame_open(j, seq, &frame, why);
        FUZZ_MUST(fd >= 0 || frame.gone || why[0] != '\0');
        if (fd >= 0)
            close(fd);
        if (fd >= 0 && journal_frame_map(j, seq, &map, why)) {
            struct frame_view view;
            FUZZ_MUST(frame_open(map.frame, map.bytes, &view, why, sizeof why) == 0);
            journal_frame_unmap(&map);
        }
    }
    journal_frame_at_step(j, n, &frame);
    journal_bytes_from(j, n / 2);
}

static void read_events(struct journal *j) {
    char why[JOURNAL_WHY] = "", *line;
    uint64_t offset = 0, lines = 0;
    size_t bytes;
    struct history history = {0};
    struct faults faults = {0};
    while ((line = journal_event_next(j, &offset)) != NULL) {
        cJSON_Delete(json_parse(line, strlen(line), &faults));
        faults_free(&faults);
        free(line);
        lines++;
    }
    FUZZ_MUST(lines <= journal_n_events(j));
    char *text = journal_text(j, "events.jsonl", &bytes);
    if (text != NULL && !history_read(text, bytes, &history, why))
        FUZZ_MUST(why[0] != '\0');
    history_free(&history);
    free(text);
}

static void read_checkpoint(struct journal *j) {
    char *meta;
    void *state;
    size_t bytes;
    if (!journal_checkpoint_read(j, 0, &meta, &state, &bytes))
        return;
    struct run_status status;
    struct faults faults = {0};
    cJSON *json = json_parse(meta, strlen(meta), &faults);
    history_status_read(json_member(json, "status"), &status);
    cJSON_Delete(json);
    faults_free(&faults);
    free(meta);
    free(state);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    char path[256], why[JOURNAL_WHY] = "";
    if (root[0] == '\0')
        make_folder();
    if (size == 0)
        return 0;
    const char *name = names[(data[0] & 0x7f) % N_NAMES];
    unsigned char *file = malloc(size);
    memcpy(file, data + 1, size - 1);
    if (data[0] & 0x80)
        mend(file, size - 1);
    snprintf(path, sizeof path, "%s/%s", folder, name);
    int fd = open(path, O_WRONLY | O_CREAT | O_TRUNC, 0600);
    FUZZ_MUST(fd >= 0 && write(fd, file, size - 1) == (ssize_t)(size - 1));
    close(fd);
    struct journal *j = journal_open(root, "r", why);
    FUZZ_MUST(j != NULL || why[0] != '\0');
    if (j != NULL) {
        read_events(j);
        read_frames(j);
        read_checkpoint(j);
        why[0] = '\0';
        struct recorders *recorders = recorders_open(j, why);
        FUZZ_MUST(recorders != NULL || why[0] != '\0');
        recorders_free(recorders);
        journal_close(j);
    }
    if (strcmp(name, "probes.log") == 0) {
        struct series *series = series_load(path, why);
        if (series != NULL)
            cJSON_Delete(series_values(series, UINT64_MAX));
        series_free(series);
    }
    if (strcmp(name, "run.json") == 0) {
        struct history_meta meta;
        history_meta_read((const char *)file, size - 1, &meta);
        history_meta_free(&meta);
    }
    unlink(path);
    free(file);
    return 0;
}
