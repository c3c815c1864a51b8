// How a failure is recorded: one expression at the place that knows the cause.
#include "server/mpm/error.h"

#include <stdarg.h>
#include <stdio.h>

static void fill(struct mpm_error *err, enum mpm_status status, const char *pointer,
                 const char *expected, const char *actual, const char *format, va_list arguments) {
    *err = (struct mpm_error){.status = status, .particle = -1};
    snprintf(err->pointer, sizeof err->pointer, "%s", pointer ? pointer : "");
    snprintf(err->expected, sizeof err->expected, "%s", expected ? expected : "");
    snprintf(err->actual, sizeof err->actual, "%s", actual ? actual : "");
    vsnprintf(err->message, sizeof err->message, format, arguments);
}

enum mpm_status mpm_fail(struct mpm_error *err, enum mpm_status status, const char *pointer,
                         const char *format, ...) {
    if (err) {
        va_list arguments;
        va_start(arguments, format);
        fill(err, status, pointer, NULL, NULL, format, arguments);
        va_end(arguments);
    }
    return status;
}

enum mpm_status mpm_fail_value(struct mpm_error *err, enum mpm_status status, const char *pointer,
                               const char *expected, const char *actual, const char *format, ...) {
    if (err) {
        va_list arguments;
        va_start(arguments, format);
        fill(err, status, pointer, expected, actual, format, arguments);
        va_end(arguments);
    }
    return status;
}

const char *mpm_status_name(enum mpm_status status) {
    static const char *const names[] = {
#define X(code, name, text) name,
        MPM_STATUS_LIST(X)
#undef X
    };
    return names[status];
}

const char *mpm_status_meaning(enum mpm_status status) {
    static const char *const texts[] = {
#define X(code, name, text) text,
        MPM_STATUS_LIST(X)
#undef X
    };
    return texts[status];
}
