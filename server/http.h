// HTTP as the routes see it: a request with its body in memory, a reply to fill. The only file that
// knows libmicrohttpd is http.c.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define HTTP_HEADERS_MAX 8
#define HTTP_END SIZE_MAX

struct http_request;
const char *http_method(const struct http_request *request);
const char *http_path(const struct http_request *request); // as sent, without query, not decoded
const char *http_header(const struct http_request *request, const char *name); // or NULL
// All lines of a header, joined with ", " (RFC 9110, 5.3), new; NULL when there is none, or no
// memory.
char *http_header_lines(const struct http_request *request, const char *name);
// Whom the request is for: of a target in absolute form its authority, else the Host header.
const char *http_host(const struct http_request *request);
// A query parameter, decoded into `out`; false when it is not there. One that does not fit, or
// whose escapes are wrong, reads as empty.
bool http_query(const struct http_request *request, const char *key, char *out, size_t bytes);
// The parameters one by one, decoded, from *at on (begin with 0); false at the end. `sound` is
// false where one does not fit or its escapes are wrong; `value` may be NULL.
bool http_query_next(const struct http_request *request, size_t *at, char *key, size_t key_bytes,
                     char *value, size_t value_bytes, bool *sound);
const char *http_body(const struct http_request *request, size_t *bytes); // terminated
// Decodes %XX in place; false on a bad escape or a zero byte.
bool http_decode(char *text);

struct http_reply {
    int status;
    const char *type;     // of the body, static; NULL = no body
    char *body;           // from malloc; the server's
    const char *constant; // the body instead, when it is part of the program
    const char *cache;    // Cache-Control, static; NULL: no-store
    size_t bytes;
    int fd; // >= 0: the body is `bytes` bytes of it from `offset`; the server closes it
    uint64_t offset;
    // Not NULL: a body without end, after which the connection is closed. Returns how many bytes it
    // wrote, HTTP_END at the end, 0 when there is nothing now: then it is asked again at once, so
    // it may block for about a second. `close` ends it.
    size_t (*produce)(void *stream, char *out, size_t bytes);
    void (*close)(void *stream);
    void *stream;
    unsigned n_headers;
    struct {
        const char *name; // static
        char value[256];
    } headers[HTTP_HEADERS_MAX];
};
void http_reply_header(struct http_reply *reply, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));

struct http_counts {
    unsigned open, most, most_of_address; // connections: now, and at most
    uint64_t accepted, evicted, refused;  // connections
};

struct http_service {
    void *context;
    size_t max_body;
    // Called when the headers are in. False with the reply filled to refuse.
    bool (*admit)(void *context, struct http_request *request, struct http_reply *reply);
    // Called when the body is in, from any thread, several at a time.
    void (*serve)(void *context, struct http_request *request, struct http_reply *reply);
    // Fills the reply to a head that is not HTTP as it should be, with the status and a sentence.
    void (*malformed)(void *context, int status, const char *why, struct http_reply *reply);
    // Fills the reply to a body over the limit.
    void (*too_large)(void *context, struct http_reply *reply);
    // Fills the reply on a connection for which there is no place.
    void (*too_many)(void *context, const struct http_counts *counts, struct http_reply *reply);
};
struct http_address {
    const char *host, *port;        // port "0" picks one
    const char *tls_cert, *tls_key; // files, or NULL
};

#define HTTP_HEADER_BYTES 16384 // of the head of a request; more is a 431
// At most so many connections, and of one address; fewer where the process may have few files.
// Beyond that the one is closed that has been without a request for longest; where all are busy,
// requests are answered with 503.
#define HTTP_CONNECTIONS 240
#define HTTP_CONNECTIONS_OF_ADDRESS 192

struct http_server;
// `url` receives "http://127.0.0.1:40123". NULL with a sentence in `why`.
struct http_server *http_start(const struct http_address *address,
                               const struct http_service *service, char *url, size_t url_bytes,
                               char *why, size_t why_bytes);
void http_count(struct http_server *server, struct http_counts *out);
void http_quiesce(struct http_server *server); // accepts no more connections
void http_stop(struct http_server *server);    // after the replies under way
