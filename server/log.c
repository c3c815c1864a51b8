// One formatted line per call, given to the kernel in one write so that threads do not interleave.
#include "server/log.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static enum log_level threshold = LOG_LEVEL_INFO;

void log_threshold(enum log_level least) {
    threshold = least;
}

void log_line(enum log_level level, const char *event, const char *format, ...) {
    static const char *const names[] = {"debug", "info", "warn", "error"};
    if (level < threshold)
        return;
    char line[2048];
    struct timespec now;
    struct tm utc;
    clock_gettime(CLOCK_REALTIME, &now);
    gmtime_r(&now.tv_sec, &utc);
    size_t n = strftime(line, sizeof line, "ts=%Y-%m-%dT%H:%M:%S", &utc);
    n += (size_t)snprintf(line + n, sizeof line - n, ".%03ldZ level=%s event=%s ",
                          now.tv_nsec / 1000000, names[level], event);
    size_t text = n;
    va_list arguments;
    va_start(arguments, format);
    int wrote = vsnprintf(line + n, sizeof line - n - 1, format, arguments);
    va_end(arguments);
    if (wrote > 0)
        n += (size_t)wrote < sizeof line - n - 2 ? (size_t)wrote : sizeof line - n - 2;
    for (size_t k = text; k < n; k++)
        if ((unsigned char)line[k] < ' ')
            line[k] = ' '; // what a user sent must not start a line of its own
    while (n > 0 && line[n - 1] == ' ')
        n--;
    line[n++] = '\n';
    // A log that cannot be written must not stop the daemon.
    ssize_t ignored = write(STDERR_FILENO, line, n);
    (void)ignored;
}
