// libmicrohttpd glue: a thread a connection, a bounded number of connections, bodies into memory up
// to the limit. A body over it is read and thrown away as far as is decent, so that the client gets
// to see the 413 instead of a reset connection.
#include "server/http.h"

#include <errno.h>
#include <fcntl.h>
#include <microhttpd.h>
#include <netdb.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "server/log.h"

#define CONNECTIONS_MAX 256
#define IDLE_SECONDS 30
#define BACKLOG 128
#define DRAIN_MAX ((uint64_t)1 << 30) // bytes of an unwanted body that are read before giving up
#define STREAM_BLOCK (64 * 1024)
#define TLS_FILE_MAX (1 << 20)

struct http_request {
    const struct http_service *service;
    struct MHD_Connection *connection;
    const char *method;
    char *path, *query; // as sent; query may be NULL
    char *body;
    size_t bytes, capacity;
    uint64_t drained;
    bool begun, refused, replied;
    struct http_reply reply;
};

struct http_server {
    struct MHD_Daemon *daemon;
    struct http_service service;
    char *cert, *key;
    int listener; // closed by quiescing
};

// ---- What routes call -------------------------------------------------------------------------

const char *http_method(const struct http_request *q) {
    return q->method;
}
const char *http_path(const struct http_request *q) {
    return q->path;
}
const char *http_header(const struct http_request *q, const char *name) {
    return MHD_lookup_connection_value(q->connection, MHD_HEADER_KIND, name);
}
const char *http_body(const struct http_request *q, size_t *bytes) {
    *bytes = q->bytes;
    return q->body != NULL ? q->body : "";
}

static int hex(char c) {
    if (c >= '0' && c <= '9')
        return c - '0';
    if (c >= 'a' && c <= 'f')
        return c - 'a' + 10;
    return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

bool http_decode(char *text) {
    char *out = text;
    for (const char *c = text; *c != '\0'; c++) {
        if (*c != '%') {
            *out++ = *c;
            continue;
        }
        int high = hex(c[1]), low = high < 0 ? -1 : hex(c[2]);
        if (low < 0 || (high == 0 && low == 0))
            return false;
        *out++ = (char)(16 * high + low);
        c += 2;
    }
    *out = '\0';
    return true;
}

bool http_query(const struct http_request *q, const char *key, char *out, size_t bytes) {
    size_t length = strlen(key);
    for (const char *at = q->query; at != NULL && *at != '\0';) {
        const char *end = strchr(at, '&');
        size_t n = end != NULL ? (size_t)(end - at) : strlen(at);
        if (n >= length && strncmp(at, key, length) == 0 && (n == length || at[length] == '=')) {
            size_t skip = n == length ? n : length + 1;
            out[0] = '\0';
            if (n - skip >= bytes)
                return true;
            memcpy(out, at + skip, n - skip);
            out[n - skip] = '\0';
            for (char *c = out; *c != '\0'; c++)
                if (*c == '+')
                    *c = ' ';
            if (!http_decode(out))
                out[0] = '\0';
            return true;
        }
        at = end != NULL ? end + 1 : NULL;
    }
    return false;
}

void http_reply_header(struct http_reply *reply, const char *name, const char *format, ...) {
    if (reply->n_headers == HTTP_HEADERS_MAX)
        return;
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(reply->headers[reply->n_headers].value, sizeof reply->headers[0].value, format,
              arguments);
    va_end(arguments);
    reply->headers[reply->n_headers++].name = name;
}

// ---- Replies ----------------------------------------------------------------------------------

static void reply_clear(struct http_reply *reply) {
    free(reply->body);
    if (reply->fd >= 0)
        close(reply->fd);
    if (reply->close != NULL)
        reply->close(reply->stream);
    *reply = (struct http_reply){.fd = -1};
}

static ssize_t produce(void *cls, uint64_t position, char *out, size_t bytes) {
    struct http_reply *reply = cls;
    (void)position;
    size_t n = reply->produce(reply->stream, out, bytes);
    return n > 0 ? (ssize_t)n : MHD_CONTENT_READER_END_OF_STREAM;
}

static void produce_end(void *cls) {
    struct http_reply *reply = cls;
    reply_clear(reply);
    free(reply);
}

static struct MHD_Response *make_response(struct http_reply *reply) {
    struct MHD_Response *response = NULL;
    if (reply->produce != NULL) {
        struct http_reply *own = malloc(sizeof *own);
        if (own == NULL)
            return NULL;
        *own = *reply;
        response = MHD_create_response_from_callback(MHD_SIZE_UNKNOWN, STREAM_BLOCK, produce, own,
                                                     produce_end);
        if (response == NULL)
            free(own);
        else
            reply->close = NULL;
    } else if (reply->fd >= 0) {
        response = MHD_create_response_from_fd_at_offset64(reply->bytes, reply->fd, reply->offset);
        if (response != NULL)
            reply->fd = -1;
    } else {
        response =
            MHD_create_response_from_buffer(reply->bytes, reply->body, MHD_RESPMEM_MUST_FREE);
        if (response != NULL)
            reply->body = NULL;
    }
    return response;
}

static enum MHD_Result send_reply(struct http_request *q) {
    struct http_reply *reply = &q->reply;
    struct MHD_Response *response = make_response(reply);
    if (response == NULL)
        return MHD_NO;
    if (reply->type != NULL)
        MHD_add_response_header(response, "Content-Type", reply->type);
    MHD_add_response_header(response, "Cache-Control", "no-store");
    MHD_add_response_header(response, "X-Content-Type-Options", "nosniff");
    for (unsigned k = 0; k < reply->n_headers; k++)
        MHD_add_response_header(response, reply->headers[k].name, reply->headers[k].value);
    enum MHD_Result result = MHD_queue_response(q->connection, (unsigned)reply->status, response);
    MHD_destroy_response(response);
    q->replied = true;
    return result;
}

// ---- Requests ---------------------------------------------------------------------------------

// The first that libmicrohttpd tells of a request: its target as it was sent, before any decoding.
static void *on_target(void *cls, const char *target, struct MHD_Connection *connection) {
    struct http_server *server = cls;
    struct http_request *q = calloc(1, sizeof *q);
    (void)connection;
    if (q == NULL)
        return NULL;
    q->service = &server->service;
    q->reply.fd = -1;
    q->path = strdup(target);
    if (q->path != NULL && (q->query = strchr(q->path, '?')) != NULL)
        *q->query++ = '\0';
    return q;
}

static void on_completed(void *cls, struct MHD_Connection *connection, void **request,
                         enum MHD_RequestTerminationCode code) {
    struct http_request *q = *request;
    (void)cls;
    (void)connection;
    (void)code;
    if (q == NULL)
        return;
    reply_clear(&q->reply);
    free(q->path);
    free(q->body);
    free(q);
    *request = NULL;
}

static void refuse_size(struct http_request *q) {
    q->refused = true;
    free(q->body);
    q->body = NULL;
    q->bytes = q->capacity = 0;
    reply_clear(&q->reply);
    q->service->too_large(q->service->context, &q->reply);
}

static enum MHD_Result begin(struct http_request *q) {
    const char *text = http_header(q, "Content-Length"), *expect = http_header(q, "Expect");
    uint64_t length = text != NULL ? strtoull(text, NULL, 10) : 0;
    q->begun = true;
    q->refused = !q->service->admit(q->service->context, q, &q->reply);
    if (!q->refused && length > q->service->max_body)
        refuse_size(q);
    // A client that asks first, or sends more than is decent to read, is told at once.
    if (q->refused && ((expect != NULL && (text == NULL || length > 0)) || length > DRAIN_MAX))
        return send_reply(q);
    return MHD_YES;
}

static bool body_append(struct http_request *q, const char *from, size_t n) {
    if (q->bytes + n + 1 > q->capacity) {
        size_t larger = q->capacity * 2 > q->bytes + n + 1 ? q->capacity * 2 : q->bytes + n + 1;
        char *moved = realloc(q->body, larger);
        if (moved == NULL)
            return false;
        q->body = moved;
        q->capacity = larger;
    }
    memcpy(q->body + q->bytes, from, n);
    q->bytes += n;
    q->body[q->bytes] = '\0';
    return true;
}

static enum MHD_Result on_request(void *cls, struct MHD_Connection *connection, const char *url,
                                  const char *method, const char *version, const char *upload,
                                  size_t *upload_bytes, void **request) {
    struct http_request *q = *request;
    (void)cls;
    (void)url;
    (void)version;
    if (q == NULL || q->path == NULL)
        return MHD_NO;
    q->connection = connection;
    q->method = method;
    if (!q->begun)
        return begin(q);
    if (*upload_bytes > 0) {
        q->drained += *upload_bytes;
        if (!q->refused && q->drained > q->service->max_body)
            refuse_size(q);
        if (q->refused ? q->drained > DRAIN_MAX : !body_append(q, upload, *upload_bytes))
            return MHD_NO;
        *upload_bytes = 0;
        return MHD_YES;
    }
    if (q->replied)
        return MHD_YES;
    if (!q->refused)
        q->service->serve(q->service->context, q, &q->reply);
    return send_reply(q);
}

// ---- Server -----------------------------------------------------------------------------------

static void on_log(void *cls, const char *format, va_list arguments) {
    char text[512];
    (void)cls;
    vsnprintf(text, sizeof text, format, arguments);
    log_line(LOG_LEVEL_DEBUG, "http", "%s", text);
}

static int listen_on(const struct http_address *address, bool tls, char *url, size_t url_bytes,
                     char *why, size_t why_bytes) {
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM, .ai_flags = AI_PASSIVE}, *found;
    int error = getaddrinfo(address->host, address->port, &hints, &found);
    if (error != 0) {
        snprintf(why, why_bytes, "--http %s: %s", address->host, gai_strerror(error));
        return -1;
    }
    int one = 1;
    int fd = socket(found->ai_family, SOCK_STREAM | SOCK_CLOEXEC, 0);
    struct sockaddr_storage bound;
    socklen_t bytes = sizeof bound;
    char host[256], port[16];
    if (fd < 0 || setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &one, sizeof one) != 0 ||
        bind(fd, found->ai_addr, found->ai_addrlen) != 0 || listen(fd, BACKLOG) != 0 ||
        getsockname(fd, (struct sockaddr *)&bound, &bytes) != 0) {
        snprintf(why, why_bytes, "cannot listen on %s:%s: %s", address->host, address->port,
                 strerror(errno));
        freeaddrinfo(found);
        if (fd >= 0)
            close(fd);
        return -1;
    }
    freeaddrinfo(found);
    getnameinfo((struct sockaddr *)&bound, bytes, host, sizeof host, port, sizeof port,
                NI_NUMERICHOST | NI_NUMERICSERV);
    snprintf(url, url_bytes, strchr(host, ':') != NULL ? "%s://[%s]:%s" : "%s://%s:%s",
             tls ? "https" : "http", host, port);
    return fd;
}

static char *file_text(const char *path, char *why, size_t why_bytes) {
    char *text = calloc(1, TLS_FILE_MAX + 1);
    FILE *file = fopen(path, "re");
    size_t n = text != NULL && file != NULL ? fread(text, 1, TLS_FILE_MAX, file) : 0;
    if (n == 0) {
        snprintf(why, why_bytes, "%s: %s", path, file == NULL ? strerror(errno) : "is empty");
        free(text);
        text = NULL;
    }
    if (file != NULL)
        fclose(file);
    return text;
}

struct http_server *http_start(const struct http_address *address,
                               const struct http_service *service, char *url, size_t url_bytes,
                               char *why, size_t why_bytes) {
    struct http_server *server = calloc(1, sizeof *server);
    bool tls = address->tls_cert != NULL && address->tls_cert[0] != '\0';
    if (server == NULL)
        return NULL;
    server->service = *service;
    server->listener = -1;
    if (tls && ((server->cert = file_text(address->tls_cert, why, why_bytes)) == NULL ||
                (server->key = file_text(address->tls_key, why, why_bytes)) == NULL))
        goto fail;
    server->listener = listen_on(address, tls, url, url_bytes, why, why_bytes);
    if (server->listener < 0)
        goto fail;
    struct MHD_OptionItem secure[] = {
        {MHD_OPTION_HTTPS_MEM_CERT, 0, server->cert},
        {MHD_OPTION_HTTPS_MEM_KEY, 0, server->key},
        {MHD_OPTION_END, 0, NULL},
    };
    struct MHD_OptionItem plain[] = {{MHD_OPTION_END, 0, NULL}};
    server->daemon = MHD_start_daemon(
        MHD_USE_THREAD_PER_CONNECTION | MHD_USE_INTERNAL_POLLING_THREAD | MHD_USE_POLL |
            MHD_USE_ITC | MHD_USE_ERROR_LOG | (tls ? MHD_USE_TLS : 0),
        0, NULL, NULL, on_request, server, MHD_OPTION_EXTERNAL_LOGGER, on_log, NULL,
        MHD_OPTION_LISTEN_SOCKET, server->listener, MHD_OPTION_CONNECTION_LIMIT, CONNECTIONS_MAX,
        MHD_OPTION_CONNECTION_TIMEOUT, IDLE_SECONDS, MHD_OPTION_URI_LOG_CALLBACK, on_target, server,
        MHD_OPTION_NOTIFY_COMPLETED, on_completed, NULL, MHD_OPTION_ARRAY, tls ? secure : plain,
        MHD_OPTION_END);
    if (server->daemon != NULL)
        return server;
    snprintf(why, why_bytes,
             tls ? "cannot start HTTPS: certificate or key refused"
                 : "cannot start the HTTP server");
fail:
    if (server->listener >= 0)
        close(server->listener);
    free(server->cert);
    free(server->key);
    free(server);
    return NULL;
}

void http_quiesce(struct http_server *server) {
    int listener = (int)MHD_quiesce_daemon(server->daemon);
    if (listener >= 0)
        close(listener);
}

void http_stop(struct http_server *server) {
    if (server == NULL)
        return;
    MHD_stop_daemon(server->daemon);
    free(server->cert);
    free(server->key);
    free(server);
}
