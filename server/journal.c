// The run's folder. What makes kill -9 harmless:
//   - whole files (checkpoint, status, recorders) are written beside and renamed;
//   - logs (events, frames) only grow, and an entry that is not whole can only be the last one:
//     opening cuts it off;
//   - each frame record carries its length, a checksum, the frame's digest and a hash over the
//     record before it, and each event a check over the one before it, so that anything else than a
//     torn tail is seen, and refused with its place.
// An entry is written at a place that is remembered, not at the end of the file: what a failed
// write left there is written over by the next one, even where it cannot be cut.
#include "server/journal.h"

#include <dirent.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include "server/journal_inside.h"

#define ROOM_MIN ((uint64_t)1 << 20) // bytes: a small run's files and its first checkpoint
#define FILES_MIN 16                 // a run's folder, its files, and those written beside them
#define DESCRIPTORS_MIN 8 // that a run which begins has open at a time, and some to spare

// ---- Helpers ----------------------------------------------------------------------------------

void journal_explain(char *why, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    if (why != NULL)
        vsnprintf(why, JOURNAL_WHY, format, arguments);
    va_end(arguments);
}

enum journal_result journal_failure(int error, const char *path, char *why) {
    journal_explain(why, "%.400s: %s", path, strerror(error));
    return error == ENOSPC || error == EDQUOT ? JOURNAL_FULL : JOURNAL_ERROR;
}

int journal_write_at(int fd, const void *from, size_t bytes, uint64_t offset) {
    const char *at = from;
    while (bytes > 0) {
        ssize_t n = pwrite(fd, at, bytes, (off_t)offset);
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

int journal_read_at(int fd, void *out, size_t bytes, uint64_t offset) {
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

int journal_sync_folder(const char *path) {
    int fd = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd < 0)
        return errno;
    int error = fsync(fd) != 0 ? errno : 0;
    close(fd);
    return error;
}

bool journal_vanished(int fd) {
    struct stat info;
    return fstat(fd, &info) != 0 || info.st_nlink == 0;
}

bool journal_grow(void **array, size_t *capacity, size_t needed, size_t item) {
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
            journal_failure(errno, partial, why);
            return false;
        }
        if (last)
            return true;
        *slash = '/';
    }
}

// A run's folder, which holds plain files only. Never what a link names: that is not the daemon's;
// the link alone goes.
static void remove_tree(const char *path) {
    int fd = open(path, O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
    DIR *dir = fd >= 0 ? fdopendir(fd) : NULL;
    if (dir != NULL) {
        for (const struct dirent *entry; (entry = readdir(dir)) != NULL;)
            if (strcmp(entry->d_name, ".") != 0 && strcmp(entry->d_name, "..") != 0)
                unlinkat(fd, entry->d_name, 0);
        closedir(dir);
    } else if (fd >= 0) {
        close(fd);
    }
    if (rmdir(path) != 0)
        unlink(path); // which no folder minds
}

void journal_path(const struct journal *journal, const char *name, char *out, size_t bytes) {
    int n = snprintf(out, bytes, "%s/%s", journal->folder, name);
    if (n < 0 || (size_t)n >= bytes)
        out[0] = '\0'; // then opening it fails
}

char *journal_file_text(const char *path, size_t *bytes) {
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    struct stat info;
    if (fd < 0)
        return NULL;
    char *text = NULL;
    if (fstat(fd, &info) == 0 && S_ISREG(info.st_mode))
        text = malloc((size_t)info.st_size + 1);
    if (text != NULL && journal_read_at(fd, text, (size_t)info.st_size, 0) == 0) {
        text[info.st_size] = '\0';
        *bytes = (size_t)info.st_size;
    } else {
        free(text);
        text = NULL;
    }
    close(fd);
    return text;
}

static enum journal_result write_file(const char *path, const void *text, size_t bytes, bool sync,
                                      char *why) {
    int fd = open(path, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (fd < 0)
        return journal_failure(errno, path, why);
    int error = journal_write_at(fd, text, bytes, 0);
    if (error == 0 && sync && fsync(fd) != 0)
        error = errno;
    if (close(fd) != 0 && error == 0)
        error = errno;
    if (error == 0)
        return JOURNAL_OK;
    unlink(path);
    return journal_failure(error, path, why);
}

// ---- The data folder --------------------------------------------------------------------------

int journal_lock(const char *data_dir, char *why) {
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%s/runs", data_dir);
    if (!make_folders(path, why))
        return -1;
    if (access(path, W_OK | X_OK) != 0) {
        journal_failure(errno, path, why);
        return -1;
    }
    snprintf(path, sizeof path, "%s/lock", data_dir);
    int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
    if (fd < 0) {
        journal_failure(errno, path, why);
        return -1;
    }
    if (flock(fd, LOCK_EX | LOCK_NB) != 0) {
        if (errno == EWOULDBLOCK)
            journal_explain(why, "%.400s is in use by another fbard", data_dir);
        else
            journal_failure(errno, path, why);
        close(fd);
        return -1;
    }
    return fd;
}

// Holds as many as a new run would, for a moment: to count those that are open says nothing of the
// system's own limit.
static bool has_descriptors(const char *path, char *why) {
    int held[DESCRIPTORS_MIN], error = 0;
    size_t n = 0;
    for (; n < DESCRIPTORS_MIN && error == 0; n++) {
        held[n] = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
        if (held[n] < 0)
            error = errno;
    }
    for (size_t k = 0; k < n; k++)
        if (held[k] >= 0)
            close(held[k]);
    if (error == EMFILE || error == ENFILE)
        journal_explain(why, "fewer than %d file descriptors are left: %s", DESCRIPTORS_MIN,
                        strerror(error));
    else if (error != 0)
        journal_failure(error, path, why);
    return error == 0;
}

bool journal_has_room(const char *data_dir, char *why) {
    char path[PATH_MAX];
    struct statvfs disk;
    snprintf(path, sizeof path, "%s/runs", data_dir);
    if (access(path, R_OK | W_OK | X_OK) != 0 || statvfs(path, &disk) != 0) {
        journal_failure(errno, path, why);
        return false;
    }
    uint64_t room = (uint64_t)disk.f_bavail * disk.f_frsize;
    // A file system that counts no files says 0 of 0.
    if (room < ROOM_MIN || (disk.f_files > 0 && disk.f_favail < FILES_MIN)) {
        journal_explain(why, "%.400s: %llu bytes and %llu files are left on the disk", path,
                        (unsigned long long)room, (unsigned long long)disk.f_favail);
        return false;
    }
    return has_descriptors(path, why);
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
        if (entry->d_name[0] == '.') { // no id begins with a dot
            bool own = strncmp(entry->d_name, ".new-", 5) == 0 ||
                       strncmp(entry->d_name, ".old-", 5) == 0; // others are somebody else's
            if (own &&
                snprintf(inside, sizeof inside, "%s/%s", path, entry->d_name) < (int)sizeof inside)
                remove_tree(inside);
            continue;
        }
        if (!journal_grow((void **)&ids, &capacity, n + 1, sizeof *ids))
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
    remove_tree(away); // what could not be cleared last time
    if (rename(path, away) != 0 && errno != ENOENT) {
        journal_failure(errno, path, why);
        return -1;
    }
    remove_tree(away);
    return 0;
}
// ---- Create, open, close ----------------------------------------------------------------------

static struct journal *journal_new(void) {
    struct journal *j = calloc(1, sizeof *j);
    if (j == NULL)
        return NULL;
    pthread_mutex_init(&j->lock, NULL);
    j->events = j->tail = -1;
    j->budget = j->keep = UINT64_MAX;
    return j;
}

struct journal *journal_create(const char *data_dir, const char *id, const char *scene,
                               const char *meta, char *why) {
    char building[PATH_MAX], path[PATH_MAX];
    struct journal *j = journal_new();
    if (j == NULL) {
        journal_explain(why, "out of memory");
        return NULL;
    }
    snprintf(building, sizeof building, "%s/runs/.new-%s", data_dir, id);
    snprintf(j->folder, sizeof j->folder, "%s", building);
    remove_tree(building);
    if (mkdir(building, 0700) != 0) {
        journal_failure(errno, building, why);
        goto fail;
    }
    if (snprintf(path, sizeof path, "%s/scene.json", building) >= (int)sizeof path ||
        write_file(path, scene, strlen(scene), false, why) != JOURNAL_OK ||
        snprintf(path, sizeof path, "%s/run.json", building) >= (int)sizeof path ||
        write_file(path, meta, strlen(meta), false, why) != JOURNAL_OK)
        goto fail;
    // Whole before it has its name: what has failed is no run for the next daemon, even where there
    // are no descriptors left to clear it away with.
    if (!journal_events_open(j, why))
        goto fail;
    snprintf(j->folder, sizeof j->folder, "%s/runs/%s", data_dir, id);
    if (rename(building, j->folder) != 0) {
        journal_failure(errno, j->folder, why);
        goto fail;
    }
    return j;
fail:
    journal_close(j); // first: to clear a folder takes a descriptor
    remove_tree(building);
    return NULL;
}

struct journal *journal_open(const char *data_dir, const char *id, char *why) {
    struct journal *j = journal_new();
    if (j == NULL) {
        journal_explain(why, "out of memory");
        return NULL;
    }
    snprintf(j->folder, sizeof j->folder, "%s/runs/%s", data_dir, id);
    if (journal_events_open(j, why) && journal_frames_open(j, why))
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

void journal_rest(struct journal *j) {
    if (j == NULL)
        return;
    pthread_mutex_lock(&j->lock);
    if (j->events >= 0)
        close(j->events);
    if (j->tail >= 0)
        close(j->tail);
    j->events = j->tail = -1;
    pthread_mutex_unlock(&j->lock);
}

uint64_t journal_cut_bytes(const struct journal *j) {
    return j->cut_bytes;
}

char *journal_text(const struct journal *j, const char *name, size_t *bytes) {
    char path[PATH_MAX];
    journal_path(j, name, path, sizeof path);
    return journal_file_text(path, bytes);
}

char *journal_text_of(const char *data_dir, const char *id, const char *name, size_t *bytes) {
    char path[PATH_MAX];
    if (snprintf(path, sizeof path, "%s/runs/%s/%s", data_dir, id, name) >= (int)sizeof path)
        return NULL;
    return journal_file_text(path, bytes);
}

enum journal_result journal_replace(struct journal *j, const char *name, const void *text,
                                    size_t bytes, char *why) {
    char path[PATH_MAX], fresh[PATH_MAX + 8];
    journal_path(j, name, path, sizeof path);
    snprintf(fresh, sizeof fresh, "%s.new", path);
    enum journal_result result = write_file(fresh, text, bytes, j->power, why);
    if (result == JOURNAL_OK && rename(fresh, path) != 0) {
        result = journal_failure(errno, path, why);
        unlink(fresh);
    }
    if (result == JOURNAL_OK && j->power) {
        int error = journal_sync_folder(j->folder);
        if (error != 0)
            result = journal_failure(error, j->folder, why);
    }
    return result;
}

// ---- Durability -------------------------------------------------------------------------------

static int sync_file(const char *path) {
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return errno == ENOENT ? 0 : errno;
    int error = fsync(fd) != 0 ? errno : 0;
    close(fd);
    return error;
}

enum journal_result journal_power(struct journal *j, bool on, char *why) {
    static const char *const files[] = {"scene.json", "run.json", "probes.log", "recorders.json"};
    static const char *const above[] = {"", "/..", "/../.."};
    char path[PATH_MAX + 8];
    if (!on || j->power) {
        j->power = on;
        return JOURNAL_OK;
    }
    // What is there already, then the names: the run's folder, the one it is in, the data folder.
    // The flag comes first, so that no frame that is appended meanwhile falls between.
    j->power = true;
    int error = fdatasync(j->events) != 0 ? errno : 0;
    pthread_mutex_lock(&j->lock); // the appending thread may go on to another segment
    if (error == 0 && j->tail >= 0 && fdatasync(j->tail) != 0)
        error = errno;
    pthread_mutex_unlock(&j->lock);
    for (size_t k = 0; k < sizeof files / sizeof *files && error == 0; k++) {
        journal_path(j, files[k], path, PATH_MAX);
        error = sync_file(path);
    }
    for (size_t k = 0; k < sizeof above / sizeof *above && error == 0; k++) {
        snprintf(path, sizeof path, "%s%s", j->folder, above[k]);
        error = journal_sync_folder(path);
    }
    if (error == 0)
        return JOURNAL_OK;
    j->power = false;
    return journal_failure(error, j->folder, why);
}
