// Frames on disk: segments of records. A segment is the unit in which old frames go; a record is a
// header and the frame as published (docs/design.md).
//
// Frames below `keep` (every registered recorder has acknowledged them) may go for room; without a
// recorder all but the newest segment may. When what must stay fills the budget, a further frame is
// refused as JOURNAL_HELD, unless the budget is overdrawn for the last frames of a run.
#include <dirent.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#include "proto/frame.h"
#include "server/journal_inside.h"

#define SEGMENT_MAGIC "FBARSEG1"
#define RECORD_MAGIC "FREC"
#define SEGMENT_MAX ((uint64_t)64 << 20) // a new segment beyond this; the unit of dropping
#define PIECE ((size_t)256 << 10)        // bytes read at a time
// More records than this no segment holds: it ends with the one that passes SEGMENT_MAX.
#define SEGMENT_RECORDS (SEGMENT_MAX / (JOURNAL_HEADER + FRAME_PREAMBLE) + 1)
#define SEGMENTS_MIN 8 // of one budget, so that dropping frees an eighth of it at most

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
    memset(record, 0, JOURNAL_HEADER);
    memcpy(record, RECORD_MAGIC, 4);
    memcpy(record + 4, &info->state, 2);
    record[6] = info->end;
    journal_put32(record + 8, info->epoch);
    journal_put64(record + 16, info->bytes);
    journal_put64(record + 24, info->seq);
    journal_put64(record + 32, info->step);
    memcpy(record + 40, &info->time, 8);
}

static struct journal_frame record_frame(const unsigned char *record,
                                         const struct journal_segment *segment, uint64_t at) {
    struct journal_frame info = {.bytes = journal_take64(record + 16),
                                 .seq = journal_take64(record + 24),
                                 .step = journal_take64(record + 32),
                                 .epoch = journal_take32(record + 8),
                                 .end = record[6] != 0,
                                 .segment = segment->number,
                                 .offset = at + JOURNAL_HEADER};
    memcpy(&info.state, record + 4, 2);
    memcpy(&info.time, record + 40, 8);
    return info;
}

// Whether the frame at info->offset is what its digest says; read in pieces.
static int frame_check(int fd, const struct journal_frame *info, const char *path, char *why) {
    unsigned char preamble[FRAME_PREAMBLE];
    unsigned char *piece = malloc(PIECE);
    XXH3_state_t *state = XXH3_createState();
    struct frame_view view;
    char reason[128];
    int error = piece == NULL || state == NULL ? ENOMEM : 0;
    if (error == 0)
        error = journal_read_at(fd, preamble, sizeof preamble, info->offset);
    size_t head = error == 0 ? frame_peek_bytes(preamble) : 0;
    bool whole = error == 0 && head > 0 && head <= info->bytes;
    unsigned char *text = whole ? malloc(head) : NULL;
    if (whole && text == NULL)
        error = ENOMEM;
    if (text != NULL)
        error = journal_read_at(fd, text, head, info->offset);
    snprintf(reason, sizeof reason, "does not begin with " FRAME_MAGIC);
    whole = text != NULL && error == 0 && frame_peek(text, head, &view, reason, sizeof reason) == 0;
    if (whole && view.total_bytes != info->bytes) {
        snprintf(reason, sizeof reason, "has another length than its record");
        whole = false;
    }
    if (whole)
        XXH3_64bits_reset(state);
    for (uint64_t at = FRAME_PREAMBLE; whole && error == 0 && at < info->bytes; at += PIECE) {
        size_t n = info->bytes - at < PIECE ? (size_t)(info->bytes - at) : PIECE;
        error = journal_read_at(fd, piece, n, info->offset + at);
        if (error == 0)
            XXH3_64bits_update(state, piece, n);
    }
    if (whole && error == 0 && XXH3_64bits_digest(state) != view.digest) {
        snprintf(reason, sizeof reason, "does not match its digest");
        whole = false;
    }
    if (error != 0)
        journal_failure(error, path, why);
    else if (!whole)
        journal_explain(why, "%.300s: damaged frame at byte %llu: %s", path,
                        (unsigned long long)info->offset, reason);
    free(text);
    free(piece);
    XXH3_freeState(state);
    return error != 0 ? error : whole ? 0 : EBADMSG;
}

// Whether a whole record header stands anywhere in [from, bytes) of the file: then what lies before
// is no torn tail. 0 or errno. Pieces overlap by a header, so that none falls between two.
static int record_follows(int fd, uint64_t from, uint64_t bytes, bool *follows) {
    unsigned char *piece = malloc(PIECE);
    int error = piece == NULL ? ENOMEM : 0;
    *follows = false;
    while (error == 0 && !*follows && from + JOURNAL_HEADER <= bytes) {
        size_t n = bytes - from < PIECE ? (size_t)(bytes - from) : PIECE;
        error = journal_read_at(fd, piece, n, from);
        for (size_t at = 0; error == 0 && !*follows && at + JOURNAL_HEADER <= n; at++) {
            const unsigned char *hit = memmem(piece + at, n - at, RECORD_MAGIC, 4);
            at = hit != NULL ? (size_t)(hit - piece) : n;
            *follows = at + JOURNAL_HEADER <= n && journal_header_whole(hit, RECORD_MAGIC, 4);
        }
        from += n - JOURNAL_HEADER + 1;
    }
    free(piece);
    return error;
}

static uint64_t scan_failed(int error, const char *path, char *why) {
    journal_failure(error, path, why);
    return UINT64_MAX;
}

// Reads one segment into the index. Returns the bytes that are whole, or UINT64_MAX on damage.
// Not by a mapping: a sector that cannot be read would end the daemon there instead of this run.
static uint64_t segment_scan(struct journal *j, const struct journal_segment *segment, int fd,
                             bool last, const char *path, char *why) {
    uint64_t at = JOURNAL_HEADER;
    while (at < segment->bytes) {
        unsigned char record[JOURNAL_HEADER + FRAME_PREAMBLE];
        uint64_t left = segment->bytes - at;
        bool torn = left < sizeof record, follows = false;
        int error = torn ? 0 : journal_read_at(fd, record, sizeof record, at);
        if (error != 0)
            return scan_failed(error, path, why);
        torn = torn || !journal_header_whole(record, RECORD_MAGIC, 4);
        struct journal_frame info = {0};
        if (!torn) {
            info = record_frame(record, segment, at);
            torn = info.bytes > left - JOURNAL_HEADER || info.bytes < FRAME_PREAMBLE;
        }
        if (torn) {
            error = last ? record_follows(fd, at + 1, segment->bytes, &follows) : 0;
            if (error != 0)
                return scan_failed(error, path, why);
            if (last && !follows)
                return at;
            journal_explain(why, "%.400s: damaged record at byte %llu", path,
                            (unsigned long long)at);
            return UINT64_MAX;
        }
        uint64_t chain = chained(j->chain, record, record + JOURNAL_HEADER);
        if (info.seq != j->n_frames || chain != journal_take64(record + 48)) {
            journal_explain(why, "%.400s: record at byte %llu does not follow the one before it",
                            path, (unsigned long long)at);
            return UINT64_MAX;
        }
        error = last ? frame_check(fd, &info, path, why) : 0;
        if (error == EBADMSG && at + JOURNAL_HEADER + info.bytes == segment->bytes)
            return at;
        if (error != 0)
            return UINT64_MAX; // explained
        memcpy(&info.digest, record + JOURNAL_HEADER + 24, 8);
        if (!journal_grow((void **)&j->frames, &j->frames_capacity, j->n_frames + 1,
                          sizeof *j->frames))
            return scan_failed(ENOMEM, path, why);
        j->frames[j->n_frames++] = info;
        j->chain = chain;
        at += JOURNAL_HEADER + info.bytes;
    }
    return at;
}

static bool segment_open(struct journal *j, uint32_t number, bool last, char *why) {
    char path[PATH_MAX];
    segment_path(j, number, path, sizeof path);
    int fd = open(path, O_RDWR | O_CLOEXEC);
    struct stat info;
    if (fd < 0 || fstat(fd, &info) != 0) {
        journal_failure(errno, path, why);
        if (fd >= 0)
            close(fd);
        return false;
    }
    struct journal_segment segment = {.number = number, .bytes = (uint64_t)info.st_size};
    unsigned char header[JOURNAL_HEADER];
    bool follows = false, begun = segment.bytes >= JOURNAL_HEADER;
    uint64_t whole = UINT64_MAX;
    int error = begun ? journal_read_at(fd, header, sizeof header, 0) : 0;
    if (error != 0) {
        journal_failure(error, path, why);
        close(fd);
        return false;
    }
    if (!begun) {
        whole = 0;
        if (!last) {
            journal_explain(why, "%.400s: cut short at byte %llu", path,
                            (unsigned long long)segment.bytes);
            whole = UINT64_MAX;
        }
    } else if (!journal_header_whole(header, SEGMENT_MAGIC, 8) ||
               journal_take32(header + 12) != number) {
        error = last ? record_follows(fd, 0, segment.bytes, &follows) : 0;
        if (error != 0)
            journal_failure(error, path, why);
        else if (last && !follows)
            whole = 0; // its header never reached the disk, nor did anything after it
        else
            journal_explain(why, "%.400s: damaged header at byte 0", path);
    } else {
        segment.first_seq = journal_take64(header + 16);
        // Else an index as long as the header says would be made for frames that never were.
        const bool possible = segment.first_seq <= number * SEGMENT_RECORDS;
        if (j->n_segments == 0 && possible) { // earlier ones were dropped
            j->chain = journal_take64(header + 24);
            while (j->n_frames < segment.first_seq &&
                   journal_grow((void **)&j->frames, &j->frames_capacity, j->n_frames + 1,
                                sizeof *j->frames)) {
                j->frames[j->n_frames] = (struct journal_frame){.seq = j->n_frames, .gone = true};
                j->n_frames++;
            }
            j->n_gone = j->n_frames;
        }
        if (!possible)
            journal_explain(why,
                            "%.400s: begins with frame %llu, which so few segments cannot hold",
                            path, (unsigned long long)segment.first_seq);
        else if (journal_take64(header + 24) != j->chain || segment.first_seq != j->n_frames)
            journal_explain(why, "%.400s: does not follow the segment before it", path);
        else
            whole = segment_scan(j, &segment, fd, last, path, why);
    }
    if (whole != UINT64_MAX && whole < segment.bytes) {
        j->cut_bytes += segment.bytes - whole;
        if (ftruncate(fd, (off_t)whole) != 0) {
            journal_failure(errno, path, why);
            whole = UINT64_MAX;
        }
        segment.bytes = whole;
    }
    if (whole == 0) { // killed while it was begun
        unlink(path);
        close(fd);
        return true;
    }
    if (whole == UINT64_MAX || !journal_grow((void **)&j->segments, &j->segments_capacity,
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

bool journal_frames_open(struct journal *j, char *why) {
    DIR *dir = opendir(j->folder);
    uint32_t first = UINT32_MAX, last = 0, count = 0;
    if (dir == NULL) {
        journal_failure(errno, j->folder, why);
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
        j->tail = open(path, O_RDWR | O_CLOEXEC);
        if (j->tail < 0) {
            journal_failure(errno, path, why);
            return false;
        }
    }
    return true;
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

// Whether a recorder still needs frames that are there.
static bool held(const struct journal *j) {
    return j->keep < j->n_frames;
}

// Drops the oldest segments until `bytes` more fit the budget; the present one always stays, and so
// does what a recorder has not acknowledged.
static void make_room(struct journal *j, uint64_t bytes) {
    while (j->n_segments > 1 && j->frame_bytes + bytes > j->budget &&
           j->segments[1].first_seq <= j->keep) {
        char path[PATH_MAX];
        segment_path(j, j->segments[0].number, path, sizeof path);
        if (unlink(path) != 0 && errno != ENOENT)
            return; // it takes its room, and is there
        j->frame_bytes -= j->segments[0].bytes;
        memmove(j->segments, j->segments + 1, (j->n_segments - 1) * sizeof *j->segments);
        j->n_segments--;
        for (; j->n_gone < j->segments[0].first_seq; j->n_gone++)
            j->frames[j->n_gone].gone = true;
    }
}

void journal_keep(struct journal *j, uint64_t seq) {
    pthread_mutex_lock(&j->lock);
    j->keep = seq;
    pthread_mutex_unlock(&j->lock);
}

void journal_overdraw(struct journal *j, bool allowed) {
    pthread_mutex_lock(&j->lock);
    j->overdraw = allowed;
    pthread_mutex_unlock(&j->lock);
}

bool journal_held(struct journal *j) {
    pthread_mutex_lock(&j->lock);
    bool full = held(j) && !j->overdraw && j->frame_bytes >= j->budget;
    pthread_mutex_unlock(&j->lock);
    return full;
}

// Begins the next segment. Only the appending thread changes `tail`.
static enum journal_result segment_begin(struct journal *j, char *why) {
    char path[PATH_MAX];
    uint32_t number = j->n_segments > 0 ? j->segments[j->n_segments - 1].number + 1 : 0;
    unsigned char header[JOURNAL_HEADER] = {0};
    memcpy(header, SEGMENT_MAGIC, 8);
    journal_put32(header + 8, 1);
    journal_put32(header + 12, number);
    journal_put64(header + 16, j->n_frames);
    journal_put64(header + 24, j->chain);
    journal_header_seal(header);
    segment_path(j, number, path, sizeof path);
    int fd = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
        return journal_failure(errno, path, why);
    int error = journal_write_at(fd, header, sizeof header, 0);
    if (error == 0 && j->tail >= 0)
        error = fdatasync(j->tail) != 0 ? errno : 0; // a checkpoint syncs the last segment only
    if (error == 0 && j->power)
        error = journal_sync_folder(j->folder);
    if (error == 0 && !journal_grow((void **)&j->segments, &j->segments_capacity, j->n_segments + 1,
                                    sizeof *j->segments))
        error = ENOMEM;
    if (error != 0) {
        unlink(path);
        close(fd);
        return journal_failure(error, path, why);
    }
    if (j->tail >= 0)
        close(j->tail);
    j->tail = fd;
    j->segments[j->n_segments++] = (struct journal_segment){
        .number = number, .bytes = JOURNAL_HEADER, .first_seq = j->n_frames};
    j->frame_bytes += JOURNAL_HEADER;
    return JOURNAL_OK;
}

// Header and frame in one call, at the place that follows the last whole record. 0 or errno.
static int record_write(int fd, unsigned char *record, const void *frame, size_t bytes,
                        uint64_t offset) {
    struct iovec parts[2] = {{.iov_base = record, .iov_len = JOURNAL_HEADER},
                             {.iov_base = (void *)(uintptr_t)frame, .iov_len = bytes}};
    ssize_t wrote;
    do
        wrote = pwritev(fd, parts, 2, (off_t)offset);
    while (wrote < 0 && errno == EINTR);
    if (wrote < 0)
        return errno;
    size_t done = (size_t)wrote;
    int error = 0;
    if (done < JOURNAL_HEADER) {
        error = journal_write_at(fd, record + done, JOURNAL_HEADER - done, offset + done);
        done = JOURNAL_HEADER;
    }
    if (error == 0 && done < JOURNAL_HEADER + bytes)
        error = journal_write_at(fd, (const char *)frame + (done - JOURNAL_HEADER),
                                 JOURNAL_HEADER + bytes - done, offset + done);
    return error;
}

static enum journal_result record_append(struct journal *j, const void *frame,
                                         const struct journal_frame *info, char *why) {
    unsigned char record[JOURNAL_HEADER];
    record_fill(record, info);
    uint64_t chain = chained(j->chain, record, frame);
    journal_put64(record + 48, chain);
    journal_header_seal(record);
    struct journal_segment *segment = &j->segments[j->n_segments - 1];
    int error = journal_vanished(j->tail)
                    ? ENOENT
                    : record_write(j->tail, record, frame, info->bytes, segment->bytes);
    if (error == 0 && j->power && fdatasync(j->tail) != 0)
        error = errno;
    if (error != 0) {
        // What was written of it is cut; where that fails too, the next record is written over it.
        int ignored = ftruncate(j->tail, (off_t)segment->bytes);
        (void)ignored;
        return journal_failure(error, j->folder, why);
    }
    struct journal_frame entry = *info;
    entry.segment = segment->number;
    entry.offset = segment->bytes + JOURNAL_HEADER;
    memcpy(&entry.digest, (const char *)frame + 24, 8);
    pthread_mutex_lock(&j->lock);
    j->frames[j->n_frames++] = entry;
    segment->bytes += JOURNAL_HEADER + info->bytes;
    j->frame_bytes += JOURNAL_HEADER + info->bytes;
    j->chain = chain;
    pthread_mutex_unlock(&j->lock);
    return JOURNAL_OK;
}

// Under the lock: room, memory and a segment for the frame.
static enum journal_result append_prepare(struct journal *j, const struct journal_frame *info,
                                          char *why) {
    uint64_t bytes = JOURNAL_HEADER + info->bytes;
    enum journal_result result = JOURNAL_OK;
    if (info->seq != j->n_frames) {
        journal_explain(why, "frame %llu does not follow frame %llu", (unsigned long long)info->seq,
                        (unsigned long long)j->n_frames - 1);
        return JOURNAL_ERROR;
    }
    make_room(j, bytes);
    if (held(j) && !j->overdraw && j->frame_bytes + bytes > j->budget) {
        journal_explain(why,
                        "the journal's %llu bytes (output.journal_bytes) hold frames from %llu on "
                        "that a recorder has not acknowledged",
                        (unsigned long long)j->budget, (unsigned long long)j->keep);
        return JOURNAL_HELD;
    }
    if (j->n_segments == 0 || j->segments[j->n_segments - 1].bytes > segment_limit(j)) {
        result = segment_begin(j, why);
        if (result == JOURNAL_OK)
            make_room(j, bytes);
    }
    if (result == JOURNAL_OK &&
        !journal_grow((void **)&j->frames, &j->frames_capacity, j->n_frames + 1, sizeof *j->frames))
        result = journal_failure(ENOMEM, j->folder, why);
    return result;
}

enum journal_result journal_append_frame(struct journal *j, const void *frame,
                                         const struct journal_frame *info, char *why) {
    pthread_mutex_lock(&j->lock);
    enum journal_result result = append_prepare(j, info, why);
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

uint64_t journal_bytes_from(struct journal *j, uint64_t seq) {
    uint64_t bytes = 0;
    pthread_mutex_lock(&j->lock);
    for (size_t k = seq < j->n_gone ? j->n_gone : seq; k < j->n_frames; k++)
        bytes += j->frames[k].bytes;
    pthread_mutex_unlock(&j->lock);
    return bytes;
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

int journal_frame_open(struct journal *j, uint64_t seq, struct journal_frame *out, char *why) {
    char path[PATH_MAX];
    if (!journal_frame(j, seq, out) || out->gone) {
        journal_explain(why, "no frame %llu", (unsigned long long)seq);
        return -1;
    }
    segment_path(j, out->segment, path, sizeof path);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0) {
        journal_failure(errno, path, why);
        return -1;
    }
    struct stat info;
    if (fstat(fd, &info) != 0 || (uint64_t)info.st_size < out->offset + out->bytes) {
        journal_explain(why, "%.400s: cut short at byte %llu", path,
                        (unsigned long long)info.st_size);
        close(fd);
        return -1;
    }
    if (frame_check(fd, out, path, why) != 0) {
        close(fd);
        return -1;
    }
    return fd;
}

unsigned char *journal_frame_read(struct journal *j, uint64_t seq, struct journal_frame *out,
                                  char *why) {
    int fd = journal_frame_open(j, seq, out, why);
    unsigned char *bytes = fd >= 0 ? malloc(out->bytes) : NULL;
    int error = fd >= 0 && bytes == NULL ? ENOMEM : 0;
    if (bytes != NULL)
        error = journal_read_at(fd, bytes, out->bytes, out->offset);
    if (error != 0) {
        journal_failure(error, j->folder, why);
        free(bytes);
        bytes = NULL;
    }
    if (fd >= 0)
        close(fd);
    return bytes;
}

bool journal_frame_map(struct journal *j, uint64_t seq, struct journal_map *out, char *why) {
    char path[PATH_MAX];
    struct journal_frame info;
    if (!journal_frame(j, seq, &info) || info.gone) {
        journal_explain(why, "no frame %llu", (unsigned long long)seq);
        return false;
    }
    segment_path(j, info.segment, path, sizeof path);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    uint64_t page = (uint64_t)sysconf(_SC_PAGESIZE), from = info.offset / page * page;
    size_t lead = (size_t)(info.offset - from);
    void *base = MAP_FAILED;
    if (fd >= 0)
        base = mmap(NULL, lead + info.bytes, PROT_READ, MAP_SHARED, fd, (off_t)from);
    int error = errno;
    if (fd >= 0)
        close(fd);
    if (base == MAP_FAILED) {
        journal_failure(error, path, why);
        return false;
    }
    *out = (struct journal_map){.base = base,
                                .base_bytes = lead + info.bytes,
                                .frame = (unsigned char *)base + lead,
                                .bytes = info.bytes};
    return true;
}

void journal_frame_unmap(struct journal_map *map) {
    munmap(map->base, map->base_bytes);
}
