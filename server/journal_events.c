// events.jsonl: one JSON object a line, which a person can read. The last member of each is
// "check": XXH3-64 of the line before it, seeded with the check of the line before, so that a line
// that was changed, lost or added is seen. A line without its end can only be the last one.
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "server/journal_inside.h"

#define CHECK_BYTES 27 // "check":"0123456789abcdef"}

static uint64_t check_of(const char *line, size_t bytes, uint64_t before) {
    return XXH3_64bits_withSeed(line, bytes, before);
}

// Whether the line (without its end) carries the check that follows from `*check`, which it moves.
static bool line_whole(const char *line, size_t bytes, uint64_t *check) {
    char wanted[CHECK_BYTES + 1];
    if (bytes <= CHECK_BYTES)
        return false;
    *check = check_of(line, bytes - CHECK_BYTES, *check);
    snprintf(wanted, sizeof wanted, "\"check\":\"%016llx\"}", (unsigned long long)*check);
    return memcmp(line + bytes - CHECK_BYTES, wanted, CHECK_BYTES) == 0;
}

bool journal_events_open(struct journal *j, char *why) {
    char path[PATH_MAX];
    journal_path(j, "events.jsonl", path, sizeof path);
    j->events = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (j->events < 0) {
        journal_failure(errno, path, why);
        return false;
    }
    size_t bytes = 0, whole = 0;
    char *text = journal_file_text(path, &bytes);
    if (text == NULL) {
        journal_failure(errno, path, why);
        return false;
    }
    bool sound = true;
    for (const char *end; sound && (end = memchr(text + whole, '\n', bytes - whole)) != NULL;) {
        size_t n = (size_t)(end - text) - whole;
        sound = line_whole(text + whole, n, &j->event_check);
        j->n_events++;
        whole += n + 1;
    }
    free(text);
    if (!sound) {
        journal_explain(why, "%.400s: damaged line %llu", path, (unsigned long long)j->n_events);
        return false;
    }
    if (whole < bytes && ftruncate(j->events, (off_t)whole) != 0) {
        journal_failure(errno, path, why);
        return false;
    }
    j->event_bytes = whole;
    j->cut_bytes += bytes - whole;
    return true;
}

enum journal_result journal_append_event(struct journal *j, const char *json, char *why) {
    size_t n = strlen(json);
    char *line = malloc(n + CHECK_BYTES + 3);
    if (line == NULL)
        return journal_failure(ENOMEM, j->folder, why);
    // The object's closing brace gives way to the check and comes back behind it.
    size_t stem = (size_t)sprintf(line, "%.*s%s", (int)n - 1, json, n > 2 ? "," : "");
    uint64_t check = check_of(line, stem, j->event_check);
    size_t whole =
        stem + (size_t)sprintf(line + stem, "\"check\":\"%016llx\"}\n", (unsigned long long)check);
    int error = journal_vanished(j->events)
                    ? ENOENT
                    : journal_write_at(j->events, line, whole, j->event_bytes);
    if (error == 0 && j->power && fdatasync(j->events) != 0)
        error = errno;
    free(line);
    if (error != 0) {
        // What was written of it is cut; where that fails too, the next line is written over it.
        int ignored = ftruncate(j->events, (off_t)j->event_bytes);
        (void)ignored;
        return journal_failure(error, j->folder, why);
    }
    j->event_check = check;
    pthread_mutex_lock(&j->lock);
    j->event_bytes += whole; // written by this thread alone, which needs no lock to read it
    j->n_events++;
    pthread_mutex_unlock(&j->lock);
    return JOURNAL_OK;
}

enum journal_result journal_events_room(struct journal *j, size_t bytes, char *why) {
    int error = 0;
    if (journal_vanished(j->events))
        error = ENOENT;
    else if (fallocate(j->events, FALLOC_FL_KEEP_SIZE, (off_t)j->event_bytes,
                       (off_t)(bytes + CHECK_BYTES + 2)) != 0)
        error = errno;
    // A file system that cannot promise room is asked as the line is written.
    return error == 0 || error == EOPNOTSUPP || error == ENOSYS
               ? JOURNAL_OK
               : journal_failure(error, j->folder, why);
}

uint64_t journal_n_events(struct journal *j) {
    pthread_mutex_lock(&j->lock);
    uint64_t n = j->n_events;
    pthread_mutex_unlock(&j->lock);
    return n;
}

#define EVENT_BLOCK 4096 // longer than almost every line

static char *next_line(int fd, uint64_t end, uint64_t *offset) {
    for (size_t bytes = EVENT_BLOCK; *offset < end; bytes *= 4) {
        if (bytes > end - *offset)
            bytes = (size_t)(end - *offset);
        char *text = malloc(bytes + 1);
        if (text == NULL || journal_read_at(fd, text, bytes, *offset) != 0) {
            free(text);
            return NULL;
        }
        const char *newline = memchr(text, '\n', bytes);
        size_t line = newline != NULL ? (size_t)(newline - text) : 0;
        if (newline != NULL && line > CHECK_BYTES) {
            size_t stem = line - CHECK_BYTES;
            stem -= text[stem - 1] == ','; // what the check came behind
            memcpy(text + stem, "}", 2);
            *offset += line + 1;
            return text;
        }
        free(text);
        if (newline != NULL || bytes == end - *offset)
            return NULL;
    }
    return NULL;
}

// The log to read from, the caller's to close; that of the run may be closed meanwhile.
static int events_reopen(struct journal *j, uint64_t *end) {
    char path[PATH_MAX];
    pthread_mutex_lock(&j->lock);
    *end = j->event_bytes;
    int fd = j->events >= 0 ? fcntl(j->events, F_DUPFD_CLOEXEC, 0) : -1;
    pthread_mutex_unlock(&j->lock);
    if (fd >= 0)
        return fd;
    journal_path(j, "events.jsonl", path, sizeof path);
    return open(path, O_RDONLY | O_CLOEXEC);
}

char *journal_event_next(struct journal *j, uint64_t *offset) {
    uint64_t end;
    int fd = events_reopen(j, &end);
    char *line = fd >= 0 ? next_line(fd, end, offset) : NULL;
    if (fd >= 0)
        close(fd);
    return line;
}
