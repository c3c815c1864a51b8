// The run's folder. What makes kill -9 harmless:
//   - whole files (checkpoint, status) are written beside and renamed;
//   - logs (events, frames) only grow, each entry in one write, and an entry that is not whole can
//     only be the last one: opening cuts it off;
//   - each frame record carries its length, a checksum, the frame's digest and a hash over the
//   record
//     before it, so that anything else than a torn tail is seen, and refused with its place.
#include "server/journal.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>
#include <xxhash.h>

#include "proto/frame.h"

#define SEGMENT_MAGIC "FBARSEG1"
#define RECORD_MAGIC "FREC"
#define CHECKPOINT_MAGIC "FBARCKP1"
#define HEADER 64                        // bytes of the header of a segment, a record, a checkpoint
#define CHECK_AT (HEADER - 8)            // where a header's own checksum stands
#define SEGMENT_MAX ((uint64_t)64 << 20) // a new segment beyond this; the unit of dropping
#define SEGMENTS_MIN 8 // of one budget, so that dropping frees an eighth of it at most

struct segment {
    uint32_t number;
    uint64_t bytes;
    uint64_t first_seq;
};

struct journal {
    char folder[PATH_MAX];
    int events; // descriptors
    int tail;   // the last segment, -1 before the first frame
    uint64_t cut_bytes;
    pthread_mutex_t lock; // over what follows
    uint64_t n_events;
    struct segment *segments;
    size_t n_segments, segments_capacity;
    struct journal_frame *frames;
    size_t n_frames, frames_capacity;
    uint64_t n_gone, frame_bytes, budget;
    uint64_t chain; // hash of the last record
};

// ---- Helpers ----------------------------------------------------------------------------------

static void explain(char *why, const char *format, ...) __attribute__((format(printf, 2, 3)));
static void explain(char *why, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    if (why != NULL)
        vsnprintf(why, JOURNAL_WHY, format, arguments);
    va_end(arguments);
}

static enum journal_result failure(int error, const char *path, char *why) {
    explain(why, "%.400s: %s", path, strerror(error));
    return error == ENOSPC || error == EDQUOT ? JOURNAL_FULL : JOURNAL_ERROR;
}

static void put32(unsigned char *at, uint32_t value) {
    memcpy(at, &value, sizeof value);
}
static void put64(unsigned char *at, uint64_t value) {
    memcpy(at, &value, sizeof value);
}
static uint32_t take32(const unsigned char *at) {
    uint32_t value;
    memcpy(&value, at, sizeof value);
    return value;
}
static uint64_t take64(const unsigned char *at) {
    uint64_t value;
    memcpy(&value, at, sizeof value);
    return value;
}

static void header_seal(unsigned char *header) {
    put64(header + CHECK_AT, XXH3_64bits(header, CHECK_AT));
}
static bool header_whole(const unsigned char *header, const char *magic, size_t magic_bytes) {
    return memcmp(header, magic, magic_bytes) == 0 &&
           take64(header + CHECK_AT) == XXH3_64bits(header, CHECK_AT);
}

// 0 or errno; writes everything or reports why not.
static int write_all(int fd, const void *from, size_t bytes) {
    const char *at = from;
    while (bytes > 0) {
        ssize_t n = write(fd, at, bytes);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0)
            return errno;
        at += n;
        bytes -= (size_t)n;
    }
    return 0;
}

static int read_all(int fd, void *out, size_t bytes, uint64_t offset) {
    char *at = out;
    while (bytes > 0) {
        ssize_t n = pread(fd, at, bytes, (off_t)offset);
        if (n < 0 && errno == EINTR)
            continue;
        if (n <= 0)
            return n < 0 ? errno : EIO;
        at += n;
        bytes -= (size_t)n;
        offset += (uint64_t)n;
    }
    return 0;
}

static bool grow(void **array, size_t *capacity, size_t needed, size_t item) {
    if (needed <= *capacity)
        return true;
    size_t larger = *capacity < 16 ? 16 : *capacity * 2;
    void *moved = realloc(*array, larger * item);
    if (moved == NULL)
        return false;
    *array = moved;
    *capacity = larger;
    return true;
}

static bool make_folders(const char *path, char *why) {
    char partial[PATH_MAX];
    snprintf(partial, sizeof partial, "%s", path);
    for (char *slash = partial + 1;; slash++) {
        if (*slash != '/' && *slash != '\0')
            continue;
        bool last = *slash == '\0';
        *slash = '\0';
        if (mkdir(partial, 0700) != 0 && errno != EEXIST) {
            failure(errno, partial, why);
            return false;
        }
        if (last)
            return true;
        *slash = '/';
    }
}

static void remove_tree(const char *path) {
    DIR *dir = opendir(path);
    if (dir != NULL) {
        for (const struct dirent *entry; (entry = readdir(dir)) != NULL;) {
            char inside[PATH_MAX];
            if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0)
                continue;
            if (snprintf(inside, sizeof inside, "%s/%s", path, entry->d_name) < (int)sizeof inside)
                unlink(inside); // a run's folder holds plain files only
        }
        closedir(dir);
    }
    rmdir(path);
}

void journal_path(const struct journal *journal, const char *name, char *out, size_t bytes) {
    int n = snprintf(out, bytes, "%s/%s", journal->folder, name);
    if (n < 0 || (size_t)n >= bytes)
        out[0] = '\0'; // then opening it fails
}

static char *file_text(const char *path, size_t *bytes) {
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    struct stat info;
    if (fd < 0)
        return NULL;
    char *text = NULL;
    if (fstat(fd, &info) == 0 && S_ISREG(info.st_mode))
        text = malloc((size_t)info.st_size + 1);
    if (text != NULL && read_all(fd, text, (size_t)info.st_size, 0) == 0) {
        text[info.st_size] = '\0';
        *bytes = (size_t)info.st_size;
    } else {
        free(text);
        text = NULL;
    }
    close(fd);
    return text;
}

static enum journal_result write_file(const char *path, const void *text, size_t bytes, char *why) {
    int fd = open(path, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
        return failure(errno, path, why);
    int error = write_all(fd, text, bytes);
    if (close(fd) != 0 && error == 0)
        error = errno;
    if (error == 0)
        return JOURNAL_OK;
    unlink(path);
    return failure(error, path, why);
}

// ---- The data folder --------------------------------------------------------------------------

int journal_lock(const char *data_dir, char *why) {
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%s/runs", data_dir);
    if (!make_folders(path, why))
        return -1;
    if (access(path, W_OK | X_OK) != 0) {
        failure(errno, path, why);
        return -1;
    }
    snprintf(path, sizeof path, "%s/lock", data_dir);
    int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (fd < 0) {
        failure(errno, path, why);
        return -1;
    }
    if (flock(fd, LOCK_EX | LOCK_NB) != 0) {
        if (errno == EWOULDBLOCK)
            explain(why, "%.400s is in use by another fbard", data_dir);
        else
            failure(errno, path, why);
        close(fd);
        return -1;
    }
    return fd;
}

static int compare_text(const void *a, const void *b) {
    return strcmp(*(char *const *)a, *(char *const *)b);
}

char **journal_list(const char *data_dir, size_t *count) {
    char path[PATH_MAX];
    char **ids = NULL;
    size_t n = 0, capacity = 0;
    snprintf(path, sizeof path, "%s/runs", data_dir);
    DIR *dir = opendir(path);
    *count = 0;
    if (dir == NULL)
        return NULL;
    for (const struct dirent *entry; (entry = readdir(dir)) != NULL;) {
        char inside[PATH_MAX];
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0)
            continue;
        if (entry->d_name[0] == '.') { // .new-ID, .old-ID: no id begins with a dot
            if (snprintf(inside, sizeof inside, "%s/%s", path, entry->d_name) < (int)sizeof inside)
                remove_tree(inside);
            continue;
        }
        if (!grow((void **)&ids, &capacity, n + 1, sizeof *ids))
            break;
        ids[n] = strdup(entry->d_name);
        if (ids[n] == NULL)
            break;
        n++;
    }
    closedir(dir);
    if (n > 0)
        qsort(ids, n, sizeof *ids, compare_text);
    *count = n;
    return ids;
}

int journal_remove(const char *data_dir, const char *id, char *why) {
    char path[PATH_MAX], away[PATH_MAX];
    snprintf(path, sizeof path, "%s/runs/%s", data_dir, id);
    snprintf(away, sizeof away, "%s/runs/.old-%s", data_dir, id);
    if (rename(path, away) != 0 && errno != ENOENT) {
        failure(errno, path, why);
        return -1;
    }
    remove_tree(away);
    return 0;
}

// ---- Events -----------------------------------------------------------------------------------

static bool events_open(struct journal *j, char *why) {
    char path[PATH_MAX];
    journal_path(j, "events.jsonl", path, sizeof path);
    j->events = open(path, O_RDWR | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    if (j->events < 0) {
        failure(errno, path, why);
        return false;
    }
    size_t bytes = 0;
    char *text = file_text(path, &bytes);
    if (text == NULL) {
        failure(errno, path, why);
        return false;
    }
    size_t whole = 0;
    for (size_t k = 0; k < bytes; k++)
        if (text[k] == '\n') {
            whole = k + 1;
            j->n_events++;
        }
    free(text);
    if (whole < bytes && ftruncate(j->events, (off_t)whole) != 0) {
        failure(errno, path, why);
        return false;
    }
    j->cut_bytes += bytes - whole;
    return true;
}

enum journal_result journal_append_event(struct journal *j, const char *json, char *why) {
    size_t n = strlen(json);
    char *line = malloc(n + 1);
    if (line == NULL)
        return failure(ENOMEM, j->folder, why);
    memcpy(line, json, n);
    line[n] = '\n';
    struct stat before;
    enum journal_result result = JOURNAL_OK;
    if (fstat(j->events, &before) != 0) {
        result = failure(errno, j->folder, why);
    } else {
        int error = write_all(j->events, line, n + 1);
        if (error != 0) {
            // Half a line must not join the next one; when this fails too, opening refuses the log.
            int ignored = ftruncate(j->events, before.st_size);
            (void)ignored;
            result = failure(error, j->folder, why);
        }
    }
    free(line);
    if (result == JOURNAL_OK) {
        pthread_mutex_lock(&j->lock);
        j->n_events++;
        pthread_mutex_unlock(&j->lock);
    }
    return result;
}

uint64_t journal_n_events(struct journal *j) {
    pthread_mutex_lock(&j->lock);
    uint64_t n = j->n_events;
    pthread_mutex_unlock(&j->lock);
    return n;
}

// ---- Frames: reading back ---------------------------------------------------------------------

static void segment_path(const struct journal *j, uint32_t number, char *out, size_t bytes) {
    char name[32];
    snprintf(name, sizeof name, "frames-%08u.seg", number);
    journal_path(j, name, out, bytes);
}

// Hash over a record (less its chain and checksum) and the frame's preamble, which holds its
// digest.
static uint64_t chained(uint64_t before, const unsigned char *record, const void *preamble) {
    unsigned char block[48 + FRAME_PREAMBLE];
    memcpy(block, record, 48);
    memcpy(block + 48, preamble, FRAME_PREAMBLE);
    return XXH3_64bits_withSeed(block, sizeof block, before);
}

static void record_fill(unsigned char *record, const struct journal_frame *info) {
    memset(record, 0, HEADER);
    memcpy(record, RECORD_MAGIC, 4);
    memcpy(record + 4, &info->state, 2);
    record[6] = info->end;
    put32(record + 8, info->epoch);
    put64(record + 16, info->bytes);
    put64(record + 24, info->seq);
    put64(record + 32, info->step);
    memcpy(record + 40, &info->time, 8);
}

static struct journal_frame record_frame(const unsigned char *record, const struct segment *segment,
                                         uint64_t at) {
    struct journal_frame info = {.bytes = take64(record + 16),
                                 .seq = take64(record + 24),
                                 .step = take64(record + 32),
                                 .epoch = take32(record + 8),
                                 .end = record[6] != 0,
                                 .segment = segment->number,
                                 .offset = at + HEADER};
    memcpy(&info.state, record + 4, 2);
    memcpy(&info.time, record + 40, 8);
    return info;
}

// Whether a whole record header stands anywhere in [from, bytes): then what lies before is no torn
// tail.
static bool record_follows(const unsigned char *map, uint64_t from, uint64_t bytes) {
    while (from + HEADER <= bytes) {
        const unsigned char *hit = memmem(map + from, bytes - from, RECORD_MAGIC, 4);
        if (hit == NULL || (uint64_t)(hit - map) + HEADER > bytes)
            return false;
        if (header_whole(hit, RECORD_MAGIC, 4))
            return true;
        from = (uint64_t)(hit - map) + 1;
    }
    return false;
}

// Reads one segment that is mapped at `map` into the index. Returns the bytes that are whole, or
// UINT64_MAX on damage.
static uint64_t segment_scan(struct journal *j, const struct segment *segment,
                             const unsigned char *map, bool last, const char *path, char *why) {
    uint64_t at = HEADER;
    while (at < segment->bytes) {
        const unsigned char *record = map + at;
        uint64_t left = segment->bytes - at;
        bool torn = left < HEADER + FRAME_PREAMBLE || !header_whole(record, RECORD_MAGIC, 4);
        struct journal_frame info = {0};
        if (!torn) {
            info = record_frame(record, segment, at);
            torn = info.bytes > left - HEADER || info.bytes < FRAME_PREAMBLE;
        }
        if (torn) {
            if (last && !record_follows(map, at + 1, segment->bytes))
                return at;
            explain(why, "%.400s: damaged record at byte %llu", path, (unsigned long long)at);
            return UINT64_MAX;
        }
        uint64_t chain = chained(j->chain, record, record + HEADER);
        if (info.seq != j->n_frames || chain != take64(record + 48)) {
            explain(why, "%.400s: record at byte %llu does not follow the one before it", path,
                    (unsigned long long)at);
            return UINT64_MAX;
        }
        struct frame_view view;
        char reason[128];
        if (last && frame_open(record + HEADER, info.bytes, &view, reason, sizeof reason) != 0) {
            if (at + HEADER + info.bytes == segment->bytes)
                return at;
            explain(why, "%.300s: damaged frame at byte %llu: %s", path, (unsigned long long)at,
                    reason);
            return UINT64_MAX;
        }
        memcpy(&info.digest, record + HEADER + 24, 8);
        if (!grow((void **)&j->frames, &j->frames_capacity, j->n_frames + 1, sizeof *j->frames)) {
            failure(ENOMEM, path, why);
            return UINT64_MAX;
        }
        j->frames[j->n_frames++] = info;
        j->chain = chain;
        at += HEADER + info.bytes;
    }
    return at;
}

static bool segment_open(struct journal *j, uint32_t number, bool last, char *why) {
    char path[PATH_MAX];
    segment_path(j, number, path, sizeof path);
    int fd = open(path, O_RDWR | O_APPEND | O_CLOEXEC);
    struct stat info;
    if (fd < 0 || fstat(fd, &info) != 0) {
        failure(errno, path, why);
        if (fd >= 0)
            close(fd);
        return false;
    }
    struct segment segment = {.number = number, .bytes = (uint64_t)info.st_size};
    const unsigned char *map = NULL;
    uint64_t whole = UINT64_MAX;
    if (segment.bytes >= HEADER)
        map = mmap(NULL, segment.bytes, PROT_READ, MAP_PRIVATE, fd, 0);
    if (segment.bytes >= HEADER && map == MAP_FAILED) {
        failure(errno, path, why);
        close(fd);
        return false;
    }
    if (map == NULL) {
        whole = 0;
        if (!last) {
            explain(why, "%.400s: cut short at byte %llu", path, (unsigned long long)segment.bytes);
            whole = UINT64_MAX;
        }
    } else if (!header_whole(map, SEGMENT_MAGIC, 8) || take32(map + 12) != number) {
        explain(why, "%.400s: damaged header at byte 0", path);
    } else {
        segment.first_seq = take64(map + 16);
        if (j->n_segments == 0) { // earlier ones were dropped
            j->chain = take64(map + 24);
            while (j->n_frames < segment.first_seq && grow((void **)&j->frames, &j->frames_capacity,
                                                           j->n_frames + 1, sizeof *j->frames)) {
                j->frames[j->n_frames] = (struct journal_frame){.seq = j->n_frames, .gone = true};
                j->n_frames++;
            }
            j->n_gone = j->n_frames;
        }
        if (take64(map + 24) != j->chain || segment.first_seq != j->n_frames)
            explain(why, "%.400s: does not follow the segment before it", path);
        else
            whole = segment_scan(j, &segment, map, last, path, why);
    }
    if (map != NULL)
        munmap((void *)(uintptr_t)map, segment.bytes);
    if (whole != UINT64_MAX && whole < segment.bytes) {
        j->cut_bytes += segment.bytes - whole;
        if (ftruncate(fd, (off_t)whole) != 0) {
            failure(errno, path, why);
            whole = UINT64_MAX;
        }
        segment.bytes = whole;
    }
    if (whole == 0) { // killed while it was begun
        unlink(path);
        close(fd);
        return true;
    }
    if (whole == UINT64_MAX || !grow((void **)&j->segments, &j->segments_capacity,
                                     j->n_segments + 1, sizeof *j->segments)) {
        close(fd);
        return false;
    }
    j->segments[j->n_segments++] = segment;
    j->frame_bytes += segment.bytes;
    if (last)
        j->tail = fd;
    else
        close(fd);
    return true;
}

static bool frames_open(struct journal *j, char *why) {
    DIR *dir = opendir(j->folder);
    uint32_t first = UINT32_MAX, last = 0, count = 0;
    if (dir == NULL) {
        failure(errno, j->folder, why);
        return false;
    }
    for (const struct dirent *entry; (entry = readdir(dir)) != NULL;) {
        unsigned number;
        int used = 0;
        if (sscanf(entry->d_name, "frames-%8u.seg%n", &number, &used) != 1 || used == 0 ||
            entry->d_name[used] != '\0')
            continue;
        first = number < first ? number : first;
        last = number > last ? number : last;
        count++;
    }
    closedir(dir);
    if (count == 0)
        return true;
    for (uint32_t number = first; number <= last; number++)
        if (!segment_open(j, number, number == last, why))
            return false;
    if (j->tail < 0 && j->n_segments > 0) { // the last file was empty: append to the one before
        char path[PATH_MAX];
        segment_path(j, j->segments[j->n_segments - 1].number, path, sizeof path);
        j->tail = open(path, O_RDWR | O_APPEND | O_CLOEXEC);
        if (j->tail < 0) {
            failure(errno, path, why);
            return false;
        }
    }
    return true;
}

// ---- Create, open, close ----------------------------------------------------------------------

static struct journal *journal_new(void) {
    struct journal *j = calloc(1, sizeof *j);
    if (j == NULL)
        return NULL;
    pthread_mutex_init(&j->lock, NULL);
    j->events = j->tail = -1;
    j->budget = UINT64_MAX;
    return j;
}

struct journal *journal_create(const char *data_dir, const char *id, const char *scene,
                               const char *meta, char *why) {
    char building[PATH_MAX], path[PATH_MAX];
    struct journal *j = journal_new();
    if (j == NULL) {
        explain(why, "out of memory");
        return NULL;
    }
    snprintf(j->folder, sizeof j->folder, "%s/runs/%s", data_dir, id);
    snprintf(building, sizeof building, "%s/runs/.new-%s", data_dir, id);
    remove_tree(building);
    if (mkdir(building, 0700) != 0) {
        failure(errno, building, why);
        goto fail;
    }
    if (snprintf(path, sizeof path, "%s/scene.json", building) >= (int)sizeof path ||
        write_file(path, scene, strlen(scene), why) != JOURNAL_OK ||
        snprintf(path, sizeof path, "%s/run.json", building) >= (int)sizeof path ||
        write_file(path, meta, strlen(meta), why) != JOURNAL_OK)
        goto fail;
    if (rename(building, j->folder) != 0) {
        failure(errno, j->folder, why);
        goto fail;
    }
    if (!events_open(j, why)) {
        remove_tree(j->folder);
        goto fail;
    }
    return j;
fail:
    remove_tree(building);
    journal_close(j);
    return NULL;
}

struct journal *journal_open(const char *data_dir, const char *id, char *why) {
    struct journal *j = journal_new();
    if (j == NULL) {
        explain(why, "out of memory");
        return NULL;
    }
    snprintf(j->folder, sizeof j->folder, "%s/runs/%s", data_dir, id);
    if (events_open(j, why) && frames_open(j, why))
        return j;
    journal_close(j);
    return NULL;
}

void journal_close(struct journal *j) {
    if (j == NULL)
        return;
    if (j->events >= 0)
        close(j->events);
    if (j->tail >= 0)
        close(j->tail);
    pthread_mutex_destroy(&j->lock);
    free(j->segments);
    free(j->frames);
    free(j);
}

uint64_t journal_cut_bytes(const struct journal *j) {
    return j->cut_bytes;
}

char *journal_text(const struct journal *j, const char *name, size_t *bytes) {
    char path[PATH_MAX];
    journal_path(j, name, path, sizeof path);
    return file_text(path, bytes);
}

char *journal_text_of(const char *data_dir, const char *id, const char *name, size_t *bytes) {
    char path[PATH_MAX];
    if (snprintf(path, sizeof path, "%s/runs/%s/%s", data_dir, id, name) >= (int)sizeof path)
        return NULL;
    return file_text(path, bytes);
}

enum journal_result journal_replace(struct journal *j, const char *name, const void *text,
                                    size_t bytes, char *why) {
    char path[PATH_MAX], fresh[PATH_MAX + 8];
    journal_path(j, name, path, sizeof path);
    snprintf(fresh, sizeof fresh, "%s.new", path);
    enum journal_result result = write_file(fresh, text, bytes, why);
    if (result == JOURNAL_OK && rename(fresh, path) != 0)
        result = failure(errno, path, why);
    return result;
}

// ---- Frames: appending ------------------------------------------------------------------------

void journal_budget(struct journal *j, uint64_t bytes) {
    pthread_mutex_lock(&j->lock);
    j->budget = bytes;
    pthread_mutex_unlock(&j->lock);
}

static uint64_t segment_limit(const struct journal *j) {
    uint64_t share = j->budget / SEGMENTS_MIN;
    return share < SEGMENT_MAX ? share : SEGMENT_MAX;
}

// Drops the oldest segments until `bytes` more fit the budget; the present one always stays.
static void make_room(struct journal *j, uint64_t bytes) {
    while (j->n_segments > 1 && j->frame_bytes + bytes > j->budget) {
        char path[PATH_MAX];
        segment_path(j, j->segments[0].number, path, sizeof path);
        unlink(path);
        j->frame_bytes -= j->segments[0].bytes;
        memmove(j->segments, j->segments + 1, (j->n_segments - 1) * sizeof *j->segments);
        j->n_segments--;
        for (; j->n_gone < j->segments[0].first_seq; j->n_gone++)
            j->frames[j->n_gone].gone = true;
    }
}

// Begins the next segment. Only the appending thread changes `tail`.
static enum journal_result segment_begin(struct journal *j, char *why) {
    char path[PATH_MAX];
    uint32_t number = j->n_segments > 0 ? j->segments[j->n_segments - 1].number + 1 : 0;
    unsigned char header[HEADER] = {0};
    memcpy(header, SEGMENT_MAGIC, 8);
    put32(header + 8, 1);
    put32(header + 12, number);
    put64(header + 16, j->n_frames);
    put64(header + 24, j->chain);
    header_seal(header);
    segment_path(j, number, path, sizeof path);
    int fd = open(path, O_RDWR | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0600);
    if (fd < 0)
        return failure(errno, path, why);
    int error = write_all(fd, header, sizeof header);
    if (error == 0 && j->tail >= 0)
        error = fdatasync(j->tail) != 0 ? errno : 0; // a checkpoint syncs the last segment only
    if (error == 0 &&
        !grow((void **)&j->segments, &j->segments_capacity, j->n_segments + 1, sizeof *j->segments))
        error = ENOMEM;
    if (error != 0) {
        unlink(path);
        close(fd);
        return failure(error, path, why);
    }
    if (j->tail >= 0)
        close(j->tail);
    j->tail = fd;
    j->segments[j->n_segments++] =
        (struct segment){.number = number, .bytes = HEADER, .first_seq = j->n_frames};
    j->frame_bytes += HEADER;
    return JOURNAL_OK;
}

static enum journal_result record_append(struct journal *j, const void *frame,
                                         const struct journal_frame *info, char *why) {
    unsigned char record[HEADER];
    record_fill(record, info);
    uint64_t chain = chained(j->chain, record, frame);
    put64(record + 48, chain);
    header_seal(record);
    struct segment *segment = &j->segments[j->n_segments - 1];
    int error = write_all(j->tail, record, sizeof record);
    if (error == 0)
        error = write_all(j->tail, frame, info->bytes);
    if (error != 0) {
        // Cut what was written of it: the next record must follow the last whole one.
        int ignored = ftruncate(j->tail, (off_t)segment->bytes);
        (void)ignored;
        return failure(error, j->folder, why);
    }
    struct journal_frame entry = *info;
    entry.segment = segment->number;
    entry.offset = segment->bytes + HEADER;
    memcpy(&entry.digest, (const char *)frame + 24, 8);
    pthread_mutex_lock(&j->lock);
    j->frames[j->n_frames++] = entry;
    segment->bytes += HEADER + info->bytes;
    j->frame_bytes += HEADER + info->bytes;
    j->chain = chain;
    pthread_mutex_unlock(&j->lock);
    return JOURNAL_OK;
}

enum journal_result journal_append_frame(struct journal *j, const void *frame,
                                         const struct journal_frame *info, char *why) {
    enum journal_result result = JOURNAL_OK;
    pthread_mutex_lock(&j->lock);
    if (info->seq != j->n_frames) {
        explain(why, "frame %llu does not follow frame %llu", (unsigned long long)info->seq,
                (unsigned long long)j->n_frames - 1);
        result = JOURNAL_ERROR;
    }
    bool full = j->n_segments == 0 || j->segments[j->n_segments - 1].bytes > segment_limit(j);
    if (result == JOURNAL_OK && full)
        result = segment_begin(j, why);
    if (result == JOURNAL_OK)
        make_room(j, HEADER + info->bytes);
    if (result == JOURNAL_OK &&
        !grow((void **)&j->frames, &j->frames_capacity, j->n_frames + 1, sizeof *j->frames))
        result = failure(ENOMEM, j->folder, why);
    pthread_mutex_unlock(&j->lock);
    return result == JOURNAL_OK ? record_append(j, frame, info, why) : result;
}

uint64_t journal_n_frames(struct journal *j) {
    pthread_mutex_lock(&j->lock);
    uint64_t n = j->n_frames;
    pthread_mutex_unlock(&j->lock);
    return n;
}

uint64_t journal_n_gone(struct journal *j) {
    pthread_mutex_lock(&j->lock);
    uint64_t n = j->n_gone;
    pthread_mutex_unlock(&j->lock);
    return n;
}

uint64_t journal_frame_bytes(struct journal *j) {
    pthread_mutex_lock(&j->lock);
    uint64_t n = j->frame_bytes;
    pthread_mutex_unlock(&j->lock);
    return n;
}

bool journal_frame(struct journal *j, uint64_t seq, struct journal_frame *out) {
    pthread_mutex_lock(&j->lock);
    bool found = seq < j->n_frames;
    if (found)
        *out = j->frames[seq];
    pthread_mutex_unlock(&j->lock);
    return found;
}

bool journal_frame_at_step(struct journal *j, uint64_t step, struct journal_frame *out) {
    bool found = false;
    pthread_mutex_lock(&j->lock);
    for (size_t k = j->n_frames; k > j->n_gone && !found; k--)
        if (j->frames[k - 1].step <= step) {
            *out = j->frames[k - 1];
            found = true;
        }
    pthread_mutex_unlock(&j->lock);
    return found;
}

// Whether the frame at out->offset is what its digest says.
static bool frame_whole(int fd, const struct journal_frame *info, const char *path, char *why) {
    long page = sysconf(_SC_PAGESIZE);
    uint64_t from = info->offset / (uint64_t)page * (uint64_t)page;
    size_t lead = (size_t)(info->offset - from);
    void *map = mmap(NULL, lead + info->bytes, PROT_READ, MAP_PRIVATE, fd, (off_t)from);
    if (map == MAP_FAILED) {
        failure(errno, path, why);
        return false;
    }
    struct frame_view view;
    char reason[128];
    bool whole = frame_open((char *)map + lead, info->bytes, &view, reason, sizeof reason) == 0;
    if (!whole)
        explain(why, "%.300s: damaged frame at byte %llu: %s", path,
                (unsigned long long)info->offset, reason);
    munmap(map, lead + info->bytes);
    return whole;
}

int journal_frame_open(struct journal *j, uint64_t seq, struct journal_frame *out, char *why) {
    char path[PATH_MAX];
    if (!journal_frame(j, seq, out) || out->gone) {
        explain(why, "no frame %llu", (unsigned long long)seq);
        return -1;
    }
    segment_path(j, out->segment, path, sizeof path);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0) {
        failure(errno, path, why);
        return -1;
    }
    struct stat info;
    if (fstat(fd, &info) != 0 || (uint64_t)info.st_size < out->offset + out->bytes) {
        explain(why, "%.400s: cut short at byte %llu", path, (unsigned long long)info.st_size);
        close(fd);
        return -1;
    }
    if (!frame_whole(fd, out, path, why)) {
        close(fd);
        return -1;
    }
    return fd;
}

// ---- Checkpoints ------------------------------------------------------------------------------

static size_t padded(size_t bytes) {
    return (bytes + HEADER - 1) / HEADER * HEADER;
}

static uint64_t checkpoint_hash(const char *meta, size_t meta_bytes, const void *state,
                                size_t bytes) {
    return XXH3_64bits_withSeed(state, bytes, XXH3_64bits(meta, meta_bytes));
}

enum journal_result journal_checkpoint(struct journal *j, const char *meta, const void *state,
                                       size_t bytes, char *why) {
    char path[PATH_MAX], fresh[PATH_MAX], previous[PATH_MAX];
    unsigned char header[HEADER] = {0}, padding[HEADER] = {0};
    size_t meta_bytes = strlen(meta);
    journal_path(j, "checkpoint.bin", path, sizeof path);
    journal_path(j, "checkpoint.new", fresh, sizeof fresh);
    journal_path(j, "checkpoint.prev", previous, sizeof previous);
    memcpy(header, CHECKPOINT_MAGIC, 8);
    put32(header + 8, 1);
    put32(header + 12, (uint32_t)meta_bytes);
    put64(header + 16, bytes);
    put64(header + 24, checkpoint_hash(meta, meta_bytes, state, bytes));
    header_seal(header);

    // What the checkpoint counts on must be on the disk before it is: else a power failure could
    // leave a checkpoint that is ahead of its own frames.
    if (fdatasync(j->events) != 0 || (j->tail >= 0 && fdatasync(j->tail) != 0))
        return failure(errno, j->folder, why);
    int fd = open(fresh, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
        return failure(errno, fresh, why);
    int error = write_all(fd, header, sizeof header);
    if (error == 0)
        error = write_all(fd, meta, meta_bytes);
    if (error == 0)
        error = write_all(fd, padding, padded(meta_bytes) - meta_bytes);
    if (error == 0)
        error = write_all(fd, state, bytes);
    if (error == 0 && fsync(fd) != 0)
        error = errno;
    if (close(fd) != 0 && error == 0)
        error = errno;
    if (error == 0 && rename(path, previous) != 0 && errno != ENOENT)
        error = errno;
    // Killed here, the previous one is the newest: loading looks at both.
    if (error == 0 && rename(fresh, path) != 0)
        error = errno;
    if (error != 0) {
        unlink(fresh);
        return failure(error, fresh, why);
    }
    int folder = open(j->folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (folder >= 0) {
        fsync(folder);
        close(folder);
    }
    return JOURNAL_OK;
}

bool journal_checkpoint_read(const struct journal *j, int which, char **meta, void **state,
                             size_t *bytes) {
    char path[PATH_MAX];
    unsigned char header[HEADER];
    struct stat info;
    char *text = NULL;
    void *block = NULL;
    journal_path(j, which == 0 ? "checkpoint.bin" : "checkpoint.prev", path, sizeof path);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return false;
    if (fstat(fd, &info) != 0 || read_all(fd, header, HEADER, 0) != 0 ||
        !header_whole(header, CHECKPOINT_MAGIC, 8))
        goto fail;
    size_t meta_bytes = take32(header + 12), n = take64(header + 16);
    if ((uint64_t)info.st_size != HEADER + padded(meta_bytes) + n)
        goto fail;
    text = malloc(meta_bytes + 1);
    block = malloc(n > 0 ? n : 1);
    if (text == NULL || block == NULL || read_all(fd, text, meta_bytes, HEADER) != 0 ||
        read_all(fd, block, n, HEADER + padded(meta_bytes)) != 0 ||
        checkpoint_hash(text, meta_bytes, block, n) != take64(header + 24))
        goto fail;
    text[meta_bytes] = '\0';
    *meta = text;
    if (state != NULL) {
        *state = block;
        *bytes = n;
    } else {
        free(block);
    }
    close(fd);
    return true;
fail:
    free(text);
    free(block);
    close(fd);
    return false;
}
