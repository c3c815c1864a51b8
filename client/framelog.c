// Append-only log with checksums, chained heads and a torn tail that is told from damage
// (framelog.h).
#include "client/framelog.h"

#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>
#include <xxhash.h>

#include "proto/frame.h"

#define HEAD 64
#define MAGIC "FBARREC1"
#define SCAN_BYTES (1u << 20)

struct head {
    char magic[8];
    uint32_t kind, zero;
    uint64_t bytes, digest, durable, previous, own;
    uint64_t zeros;
};
_Static_assert(sizeof(struct head) == HEAD, "the head is written as it lies in memory");

struct framelog {
    int fd;
    char *path;
    uint64_t end;      // of the good records
    uint64_t durable;  // length known to be on disk, by this process
    uint64_t known;    // likewise, by those before, as the records tell
    uint64_t good;     // length of the records that were checked or written here
    uint64_t previous; // digest of the last head
    uint64_t cursor, cursor_previous;
    bool read_to_end;
    unsigned char *payload;
    size_t capacity;
};

static uint64_t padded(uint64_t n) {
    return (n + HEAD - 1) / HEAD * HEAD;
}

static uint64_t head_digest(const struct head *head) {
    return XXH3_64bits(head, offsetof(struct head, own));
}

// Of a frame, its preamble stands for all of it: the frame's own digest is in there.
static uint64_t payload_digest(enum framelog_kind kind, const void *payload, size_t bytes) {
    const bool frame = kind == FRAMELOG_FRAME && bytes > FRAME_PREAMBLE;
    return XXH3_64bits(payload, frame ? FRAME_PREAMBLE : bytes);
}

static bool payload_whole(const struct head *head, const void *payload) {
    struct frame_view view;
    char why[128];
    return payload_digest((enum framelog_kind)head->kind, payload, head->bytes) == head->digest &&
           (head->kind != FRAMELOG_FRAME ||
            frame_open(payload, head->bytes, &view, why, sizeof why) == 0);
}

static bool head_valid(const struct head *head) {
    return memcmp(head->magic, MAGIC, 8) == 0 && head->own == head_digest(head) &&
           head->zeros == 0 && head->bytes <= (uint64_t)INT64_MAX / 2;
}

// Reads exactly `n` bytes at `at`: 1, 0 when the file ends before, -1 on an error.
static int read_at(int fd, void *out, size_t n, uint64_t at) {
    size_t done = 0;
    while (done < n) {
        const ssize_t got = pread(fd, (char *)out + done, n - done, (off_t)(at + done));
        if (got < 0 && errno == EINTR)
            continue;
        if (got < 0)
            return -1;
        if (got == 0)
            return 0;
        done += (size_t)got;
    }
    return 1;
}

struct framelog *framelog_open(const char *path, bool create, char *why, size_t why_bytes) {
    struct framelog *log = calloc(1, sizeof *log);
    if (!log || !(log->path = strdup(path))) {
        free(log);
        snprintf(why, why_bytes, "out of memory");
        return NULL;
    }
    log->fd = open(path, O_RDWR | O_CLOEXEC | (create ? O_CREAT : 0), 0666);
    if (log->fd < 0) {
        snprintf(why, why_bytes, "%s: %s", path, strerror(errno));
        goto fail;
    }
    if (flock(log->fd, LOCK_EX | LOCK_NB) != 0) {
        snprintf(why, why_bytes, "%s: another fbar is recording into it", path);
        goto fail;
    }
    return log;
fail:;
    const int error = errno;
    framelog_close(log);
    errno = error;
    return NULL;
}

void framelog_close(struct framelog *log) {
    if (!log)
        return;
    if (log->fd >= 0)
        close(log->fd);
    free(log->payload);
    free(log->path);
    free(log);
}

void framelog_rewind(struct framelog *log) {
    log->cursor = log->cursor_previous = 0;
}

void framelog_swap(struct framelog *log, unsigned char **buffer, size_t *capacity) {
    unsigned char *payload = log->payload;
    const size_t bytes = log->capacity;
    log->payload = *buffer;
    log->capacity = *capacity;
    *buffer = payload;
    *capacity = bytes;
}

// Whether a record after `from` was appended when the place `from` was already known to be on disk.
static int durable_beyond(struct framelog *log, uint64_t from, uint64_t size, bool *out) {
    unsigned char *block = malloc(SCAN_BYTES);
    int status = block ? 0 : -1;
    *out = false;
    for (uint64_t at = padded(from + 1); status == 0 && !*out && at + HEAD <= size;) {
        const uint64_t left = (size - at) / HEAD * HEAD;
        const size_t n = left < SCAN_BYTES ? (size_t)left : SCAN_BYTES;
        if (read_at(log->fd, block, n, at) < 0)
            status = -1;
        for (size_t i = 0; status == 0 && !*out && i < n; i += HEAD) {
            struct head head;
            memcpy(&head, block + i, HEAD);
            *out = head_valid(&head) && head.durable > from;
        }
        at += n;
    }
    free(block);
    return status;
}

static int fail_errno(const struct framelog *log, char *why, size_t why_bytes) {
    snprintf(why, why_bytes, "%s: %s", log->path, strerror(errno));
    return -1;
}

// What is wrong at the cursor: a torn tail is cut (0), anything else is reported (-1).
static int end_of_log(struct framelog *log, uint64_t size, uint64_t *cut, char *why,
                      size_t why_bytes) {
    bool damaged;
    if (durable_beyond(log, log->cursor, size, &damaged) != 0)
        return fail_errno(log, why, why_bytes);
    if (damaged) {
        snprintf(why, why_bytes,
                 "%s: damaged at byte %llu, before its end; it is left as it is (`fbar recover` "
                 "builds a file from what precedes the damage)",
                 log->path, (unsigned long long)log->cursor);
        errno = EBADMSG;
        return -1;
    }
    *cut = size - log->cursor;
    if (*cut > 0 && ftruncate(log->fd, (off_t)log->cursor) != 0)
        return fail_errno(log, why, why_bytes);
    if (!log->read_to_end) {
        log->end = log->cursor;
        log->previous = log->cursor_previous;
        log->read_to_end = true;
    }
    return 0;
}

static int reserve(struct framelog *log, size_t bytes, char *why, size_t why_bytes) {
    if (bytes <= log->capacity)
        return 0;
    unsigned char *grown = realloc(log->payload, bytes);
    if (!grown) {
        snprintf(why, why_bytes, "out of memory");
        return -1;
    }
    log->payload = grown;
    log->capacity = bytes;
    return 0;
}

int framelog_read(struct framelog *log, struct framelog_record *out, uint64_t *cut, char *why,
                  size_t why_bytes) {
    struct stat status;
    struct head head;
    *cut = 0;
    if (fstat(log->fd, &status) != 0)
        return fail_errno(log, why, why_bytes);
    const uint64_t size = (uint64_t)status.st_size;
    if (log->cursor + HEAD > size)
        return end_of_log(log, size, cut, why, why_bytes);
    if (read_at(log->fd, &head, HEAD, log->cursor) < 0)
        return fail_errno(log, why, why_bytes);
    if (!head_valid(&head) || head.previous != log->cursor_previous ||
        head.bytes > size - log->cursor - HEAD)
        return end_of_log(log, size, cut, why, why_bytes);
    if (reserve(log, head.bytes, why, why_bytes) != 0)
        return -1;
    const int got = read_at(log->fd, log->payload, head.bytes, log->cursor + HEAD);
    if (got < 0)
        return fail_errno(log, why, why_bytes);
    if (got == 0 || !payload_whole(&head, log->payload) ||
        log->cursor + HEAD + padded(head.bytes) > size)
        return end_of_log(log, size, cut, why, why_bytes);
    log->cursor += HEAD + padded(head.bytes);
    log->cursor_previous = head.own;
    log->good = log->cursor > log->good ? log->cursor : log->good;
    log->known = head.durable > log->known ? head.durable : log->known;
    *out = (struct framelog_record){
        .kind = (enum framelog_kind)head.kind, .payload = log->payload, .bytes = head.bytes};
    return 1;
}

int framelog_skim(struct framelog *log, struct framelog_record *out, char *why, size_t why_bytes) {
    struct head head;
    if (log->cursor >= log->good)
        return 0;
    int got = read_at(log->fd, &head, HEAD, log->cursor);
    size_t bytes = 0;
    if (got == 1 && (!head_valid(&head) || head.bytes > log->good - log->cursor - HEAD))
        got = 0;
    if (got == 1 && head.kind == FRAMELOG_FRAME && head.bytes >= FRAME_PREAMBLE) {
        unsigned char preamble[FRAME_PREAMBLE];
        got = read_at(log->fd, preamble, FRAME_PREAMBLE, log->cursor + HEAD);
        bytes = got == 1 ? frame_peek_bytes(preamble) : 0;
    }
    if (bytes == 0 || bytes > head.bytes)
        bytes = head.bytes;
    if (got == 1 && reserve(log, bytes, why, why_bytes) != 0)
        return -1;
    if (got == 1 && bytes > 0)
        got = read_at(log->fd, log->payload, bytes, log->cursor + HEAD);
    if (got < 0)
        return fail_errno(log, why, why_bytes);
    if (got == 0) {
        snprintf(why, why_bytes, "%s: changed at byte %llu while it was read", log->path,
                 (unsigned long long)log->cursor);
        return -1;
    }
    log->cursor += HEAD + padded(head.bytes);
    *out = (struct framelog_record){
        .kind = (enum framelog_kind)head.kind, .payload = log->payload, .bytes = bytes};
    return 1;
}

int framelog_append(struct framelog *log, enum framelog_kind kind, const void *payload,
                    size_t bytes, char *why, size_t why_bytes) {
    static const unsigned char zeros[HEAD];
    struct head head = {.kind = kind,
                        .bytes = bytes,
                        .digest = payload_digest(kind, payload, bytes),
                        .durable = log->durable,
                        .previous = log->previous};
    memcpy(head.magic, MAGIC, 8);
    head.own = head_digest(&head);
    struct iovec parts[3] = {{.iov_base = &head, .iov_len = HEAD},
                             {.iov_base = (void *)payload, .iov_len = bytes},
                             {.iov_base = (void *)zeros, .iov_len = padded(bytes) - bytes}};
    uint64_t at = log->end;
    const uint64_t end = at + HEAD + padded(bytes);
    int first = 0;
    while (at < end) {
        ssize_t wrote = pwritev(log->fd, parts + first, 3 - first, (off_t)at);
        if (wrote < 0 && errno == EINTR)
            continue;
        if (wrote <= 0) {
            const int error = wrote < 0 ? errno : EIO;
            // Best effort: what is left of the record is a torn tail, which the next open cuts.
            if (ftruncate(log->fd, (off_t)log->end) != 0)
                errno = error;
            errno = error;
            return fail_errno(log, why, why_bytes);
        }
        at += (uint64_t)wrote;
        while (first < 3 && (size_t)wrote >= parts[first].iov_len)
            wrote -= (ssize_t)parts[first++].iov_len;
        if (first < 3) {
            parts[first].iov_base = (char *)parts[first].iov_base + wrote;
            parts[first].iov_len -= (size_t)wrote;
        }
    }
    log->end = log->good = end;
    log->previous = head.own;
    return 0;
}

int framelog_sync(struct framelog *log, char *why, size_t why_bytes) {
    if (log->durable == log->end)
        return 0;
    struct stat here, named;
    if (fdatasync(log->fd) != 0) {
        fail_errno(log, why, why_bytes);
        // A second fdatasync would report success for pages that the first one has given up.
        const uint64_t safe = log->durable > log->known ? log->durable : log->known;
        int ignored = ftruncate(log->fd, (off_t)safe);
        (void)ignored;
        return -1;
    }
    // A log whose name is gone would be lost with this process: not durable.
    if (fstat(log->fd, &here) != 0 || stat(log->path, &named) != 0)
        return fail_errno(log, why, why_bytes);
    if (here.st_ino != named.st_ino || here.st_dev != named.st_dev) {
        snprintf(why, why_bytes, "%s: was replaced while recording", log->path);
        return -1;
    }
    if (log->durable == 0) { // once: the name itself
        char folder[PATH_MAX];
        snprintf(folder, sizeof folder, "%s", log->path);
        const int fd = open(dirname(folder), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
        if (fd < 0 || fsync(fd) != 0) {
            if (fd >= 0)
                close(fd);
            return fail_errno(log, why, why_bytes);
        }
        close(fd);
    }
    log->durable = log->end;
    return 0;
}

uint64_t framelog_bytes(const struct framelog *log) {
    return log->end;
}
