// One shape for all errors; what a client sent is quoted back only as valid text.
#include "server/reply.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static const char *title_of(int status) {
    switch (status) {
    case 400:
        return "Bad Request";
    case 401:
        return "Unauthorized";
    case 403:
        return "Forbidden";
    case 404:
        return "Not Found";
    case 405:
        return "Method Not Allowed";
    case 409:
        return "Conflict";
    case 412:
        return "Precondition Failed";
    case 413:
        return "Content Too Large";
    case 415:
        return "Unsupported Media Type";
    case 421:
        return "Misdirected Request";
    case 422:
        return "Unprocessable Content";
    case 431:
        return "Request Header Fields Too Large";
    case 503:
        return "Service Unavailable";
    case 507:
        return "Insufficient Storage";
    default:
        return "Internal Server Error";
    }
}

void reply_text(struct http_reply *reply, int status, const char *type, char *text) {
    reply->status = text != NULL ? status : 500;
    reply->type = type;
    reply->body = text;
    reply->bytes = text != NULL ? strlen(text) : 0;
}

void reply_json(struct http_reply *reply, int status, cJSON *json) {
    reply_text(reply, status, "application/json", json_print_away(json));
}

// Length of the UTF-8 character at `c`, 0 when it is none.
static size_t utf8_length(const unsigned char *c) {
    size_t n = c[0] < 0x80                   ? 1
               : c[0] >= 0xc2 && c[0] < 0xe0 ? 2
               : (c[0] & 0xf0) == 0xe0       ? 3
               : c[0] >= 0xf0 && c[0] < 0xf5 ? 4
                                             : 0;
    for (size_t k = 1; k < n; k++)
        if ((c[k] & 0xc0) != 0x80)
            return 0;
    bool surrogate = c[0] == 0xed && c[1] >= 0xa0, overlong = c[0] == 0xe0 && c[1] < 0xa0;
    bool outside = (c[0] == 0xf0 && c[1] < 0x90) || (c[0] == 0xf4 && c[1] >= 0x90);
    return surrogate || overlong || outside ? 0 : n;
}

// What a client sent is quoted back to it, cut to a length or not text at all: make it text.
static void utf8_mend(char *text) {
    for (unsigned char *c = (unsigned char *)text; *c != '\0';) {
        size_t n = utf8_length(c);
        if (n == 0)
            *c = '?';
        c += n > 0 ? n : 1;
    }
}

void reply_problem(struct http_reply *reply, int status, const struct faults *faults,
                   const char *format, ...) {
    char detail[1024];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(detail, sizeof detail, format, arguments);
    va_end(arguments);
    cJSON *json = cJSON_CreateObject();
    cJSON_AddStringToObject(json, "type", "about:blank"); // RFC 9457: the title says it all
    cJSON_AddStringToObject(json, "title", title_of(status));
    cJSON_AddNumberToObject(json, "status", status);
    cJSON_AddStringToObject(json, "detail", detail);
    cJSON_AddItemToObject(json, "errors",
                          faults != NULL ? faults_json(faults) : cJSON_CreateArray());
    if (faults != NULL && faults->more > 0)
        cJSON_AddNumberToObject(json, "more_errors", (double)faults->more);
    reply_json(reply, status, json);
    reply->type = "application/problem+json";
    if (reply->body != NULL)
        utf8_mend(reply->body);
    if (status == 503 || status == 429)
        http_reply_header(reply, "Retry-After", "1");
    if (status == 401)
        http_reply_header(reply, "WWW-Authenticate", "Bearer");
}

void reply_faults(struct http_reply *reply, int status, const struct faults *faults) {
    const struct fault *first = faults->count > 0 ? &faults->items[0] : NULL;
    size_t total = faults->count + faults->more;
    if (first == NULL)
        reply_problem(reply, status, faults, "the body is not valid");
    else if (total == 1)
        reply_problem(reply, status, faults, "%.200s%s%.700s", first->pointer,
                      first->pointer[0] != '\0' ? ": " : "", first->detail);
    else
        reply_problem(reply, status, faults, "%zu faults, the first: %.200s%s%.700s", total,
                      first->pointer, first->pointer[0] != '\0' ? ": " : "", first->detail);
}

void reply_add(cJSON *object, const char *key, double value) {
    cJSON_AddItemToObject(object, key, json_number(value));
}
