// Preloaded into fbard or fbar: the n-th call that changes something under a folder fails, as a
// full or dying disk makes it fail. What is asked of it stands in the environment:
//   FAIL_UNDER  the folder, absolute; calls on anything else pass and are not counted
//   FAIL_AT     n, from 1; 0 only counts
//   FAIL_ERRNO  a number of errno.h
//   FAIL_HOW    "once"; "on" (every call from there on fails, but what gives room back); "short" (a
//               write stops half way, and the next call fails)
//   FAIL_TELL   a file that receives "<calls> <name of the one that failed>"
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static long calls;
static bool armed; // the half that "short" has still to fail

#define REAL(name) (__extension__(__typeof__(&name)) dlsym(RTLD_NEXT, #name))

static bool is_under(const char *path) {
    const char *folder = getenv("FAIL_UNDER");
    size_t n = folder ? strlen(folder) : 0;
    char whole[8192];
    if (n == 0 || !path)
        return false;
    if (path[0] != '/') {
        if (!getcwd(whole, 4096))
            return false;
        size_t used = strlen(whole);
        snprintf(whole + used, sizeof whole - used, "/%.4000s", path);
        path = whole;
    }
    return strncmp(path, folder, n) == 0 && (path[n] == '/' || path[n] == '\0');
}

static bool fd_is_under(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n <= 0)
        return false;
    path[n] = '\0';
    return is_under(path);
}

static void tell(const char *name) {
    const char *file = getenv("FAIL_TELL");
    char text[64];
    int n = snprintf(text, sizeof text, "%-12ld %-16s\n", calls, name), fd;
    if (!file || (fd = REAL(open)(file, O_WRONLY | O_CREAT | O_CLOEXEC, 0600)) < 0)
        return;
    if (REAL(pwrite)(fd, text, (size_t)n, 0) != n)
        abort();
    REAL(close)(fd);
}

// Counts a call. 0: it passes; 1: it fails, with errno set; 2: it does half of its work.
static int verdict(const char *name, bool can_be_short, bool gives_room) {
    const char *at = getenv("FAIL_AT"), *how = getenv("FAIL_HOW"), *number = getenv("FAIL_ERRNO");
    long n = at ? atol(at) : 0;
    int result = 0;
    pthread_mutex_lock(&lock);
    calls++;
    bool is_short = how && strcmp(how, "short") == 0;
    if (armed) {
        armed = false;
        result = 1;
    } else if (n > 0 && calls == n) {
        result = is_short && can_be_short ? 2 : 1;
        armed = result == 2;
    } else if (n > 0 && calls > n && how && strcmp(how, "on") == 0 && !gives_room) {
        result = 1;
    }
    if (result != 0 || n == 0)
        tell(name);
    pthread_mutex_unlock(&lock);
    if (result == 1)
        errno = number ? atoi(number) : EIO;
    return result;
}

#define WRITING(name, fd, bytes, call, half)                                                       \
    if (!fd_is_under(fd))                                                                          \
        return call;                                                                               \
    switch (verdict(name, (bytes) > 1, false)) {                                                   \
    case 0:                                                                                        \
        return call;                                                                               \
    case 1:                                                                                        \
        return -1;                                                                                 \
    default:                                                                                       \
        return half;                                                                               \
    }

ssize_t write(int fd, const void *from, size_t n){
    WRITING("write", fd, n, REAL(write)(fd, from, n), REAL(write)(fd, from, n / 2))} ssize_t
    pwrite(int fd, const void *from, size_t n,
           off_t at){WRITING("pwrite", fd, n, REAL(pwrite)(fd, from, n, at),
                             REAL(pwrite)(fd, from, n / 2, at))} ssize_t
    pwrite64(int fd, const void *from, size_t n, off64_t at) {
    WRITING("pwrite", fd, n, REAL(pwrite64)(fd, from, n, at), REAL(pwrite64)(fd, from, n / 2, at))
}
// Half of a vector: a part of what its first non-empty piece holds.
static ssize_t half_vector(int fd, const struct iovec *parts, int n, off_t at) {
    for (int k = 0; k < n; k++)
        if (parts[k].iov_len > 1)
            return REAL(pwrite)(fd, parts[k].iov_base, parts[k].iov_len / 2, at);
    return 0;
}
ssize_t pwritev(int fd, const struct iovec *parts, int n,
                off_t at){WRITING("pwritev", fd, 2, REAL(pwritev)(fd, parts, n, at),
                                  half_vector(fd, parts, n, at))} ssize_t
    pwritev64(int fd, const struct iovec *parts, int n, off64_t at) {
    WRITING("pwritev", fd, 2, REAL(pwritev64)(fd, parts, n, at), half_vector(fd, parts, n, at))
}

int fsync(int fd) {
    return fd_is_under(fd) && verdict("fsync", false, false) ? -1 : REAL(fsync)(fd);
}
int fdatasync(int fd) {
    return fd_is_under(fd) && verdict("fdatasync", false, false) ? -1 : REAL(fdatasync)(fd);
}
int ftruncate(int fd, off_t n) {
    return fd_is_under(fd) && verdict("ftruncate", false, true) ? -1 : REAL(ftruncate)(fd, n);
}
int ftruncate64(int fd, off64_t n) {
    return fd_is_under(fd) && verdict("ftruncate", false, true) ? -1 : REAL(ftruncate64)(fd, n);
}
int rename(const char *from, const char *to) {
    return is_under(from) && verdict("rename", false, false) ? -1 : REAL(rename)(from, to);
}
int unlink(const char *path) {
    return is_under(path) && verdict("unlink", false, true) ? -1 : REAL(unlink)(path);
}
int mkdir(const char *path, mode_t mode) {
    return is_under(path) && verdict("mkdir", false, false) ? -1 : REAL(mkdir)(path, mode);
}

static bool opening_fails(const char *path, int flags) {
    return (flags & O_CREAT) != 0 && is_under(path) && verdict("open", false, false) != 0;
}
#define OPENING(name)                                                                              \
    int name(const char *path, int flags, ...) {                                                   \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        mode_t mode = (flags & O_CREAT) != 0 ? va_arg(rest, mode_t) : 0;                           \
        va_end(rest);                                                                              \
        return opening_fails(path, flags) ? -1 : REAL(name)(path, flags, mode);                    \
    }
OPENING(open)
OPENING(open64)
