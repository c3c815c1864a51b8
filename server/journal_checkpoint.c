// Checkpoints: the complete state of a run, written new, fsynced, renamed; the previous one is
// kept.
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include "server/journal_inside.h"

#define CHECKPOINT_MAGIC "FBARCKP1"

static size_t padded(size_t bytes) {
    return (bytes + JOURNAL_HEADER - 1) / JOURNAL_HEADER * JOURNAL_HEADER;
}

static uint64_t checkpoint_hash(const char *meta, size_t meta_bytes, const void *state,
                                size_t bytes) {
    return XXH3_64bits_withSeed(state, bytes, XXH3_64bits(meta, meta_bytes));
}

enum journal_result journal_checkpoint(struct journal *j, const char *meta, const void *state,
                                       size_t bytes, char *why) {
    char path[PATH_MAX], fresh[PATH_MAX], previous[PATH_MAX];
    unsigned char header[JOURNAL_HEADER] = {0}, padding[JOURNAL_HEADER] = {0};
    size_t meta_bytes = strlen(meta);
    journal_path(j, "checkpoint.bin", path, sizeof path);
    journal_path(j, "checkpoint.new", fresh, sizeof fresh);
    journal_path(j, "checkpoint.prev", previous, sizeof previous);
    memcpy(header, CHECKPOINT_MAGIC, 8);
    journal_put32(header + 8, 1);
    journal_put32(header + 12, (uint32_t)meta_bytes);
    journal_put64(header + 16, bytes);
    journal_put64(header + 24, checkpoint_hash(meta, meta_bytes, state, bytes));
    journal_header_seal(header);

    // What the checkpoint counts on must be on the disk before it is: else a power failure could
    // leave a checkpoint that is ahead of its own frames.
    if (fdatasync(j->events) != 0 || (j->tail >= 0 && fdatasync(j->tail) != 0))
        return journal_failure(errno, j->folder, why);
    int fd = open(fresh, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
        return journal_failure(errno, fresh, why);
    int error = journal_write_at(fd, header, sizeof header, 0);
    if (error == 0)
        error = journal_write_at(fd, meta, meta_bytes, JOURNAL_HEADER);
    if (error == 0)
        error = journal_write_at(fd, padding, padded(meta_bytes) - meta_bytes,
                                 JOURNAL_HEADER + meta_bytes);
    if (error == 0)
        error = journal_write_at(fd, state, bytes, JOURNAL_HEADER + padded(meta_bytes));
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
        return journal_failure(error, fresh, why);
    }
    error = journal_sync_folder(j->folder);
    if (error != 0)
        return journal_failure(error, j->folder, why);
    return JOURNAL_OK;
}

bool journal_checkpoint_read(const struct journal *j, int which, char **meta, void **state,
                             size_t *bytes) {
    char path[PATH_MAX];
    unsigned char header[JOURNAL_HEADER];
    struct stat info;
    char *text = NULL;
    void *block = NULL;
    journal_path(j, which == 0 ? "checkpoint.bin" : "checkpoint.prev", path, sizeof path);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return false;
    if (fstat(fd, &info) != 0 || journal_read_at(fd, header, JOURNAL_HEADER, 0) != 0 ||
        !journal_header_whole(header, CHECKPOINT_MAGIC, 8))
        goto fail;
    size_t meta_bytes = journal_take32(header + 12), n = journal_take64(header + 16);
    if ((uint64_t)info.st_size != JOURNAL_HEADER + padded(meta_bytes) + n)
        goto fail;
    text = malloc(meta_bytes + 1);
    block = malloc(n > 0 ? n : 1);
    if (text == NULL || block == NULL ||
        journal_read_at(fd, text, meta_bytes, JOURNAL_HEADER) != 0 ||
        journal_read_at(fd, block, n, JOURNAL_HEADER + padded(meta_bytes)) != 0 ||
        checkpoint_hash(text, meta_bytes, block, n) != journal_take64(header + 24))
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
