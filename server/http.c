// libmicrohttpd glue: a thread a connection, a bounded number of connections in all and of one
// address, bodies into memory up to the limit. Who holds a connection without asking anything, or
// asks slowly, loses it to who comes when places are short. A body over it is read and thrown away
// as far as is decent, so that the client gets to see the 413 instead of a reset connection.
#include "server/http.h"

#include <errno.h>
#include <fcntl.h>
#include <microhttpd.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "server/log.h"

// What libmicrohttpd holds at most: those that are being closed have threads for a while yet, and
// it drops newcomers at its own limit without an answer.
#define CONNECTIONS_MAX (HTTP_CONNECTIONS + 784)
#define SLOW_SECONDS 10  // a reply that takes so long to be read may be given up for others
#define STOP_SECONDS 2.0 // for what is being answered when the daemon ends
#define PEER_SECONDS 30  // what was sent and is not acknowledged for so long ends the connection
#define IDLE_SECONDS 30
#define THREAD_STACK (1024 * 1024)    // JSON is 64 deep at most; the usual 8 MiB are address space
#define CONNECTION_MEMORY (64 * 1024) // the head of a request and its pieces; see HTTP_HEADER_BYTES
#define BACKLOG 128
#define DRAIN_MAX ((uint64_t)1 << 30) // bytes of an unwanted body that are read before giving up
#define STREAM_BLOCK (64 * 1024)
#define TLS_FILE_MAX (1 << 20)
#define TLS_PRIORITIES "NORMAL:-VERS-ALL:+VERS-TLS1.3:+VERS-TLS1.2" // RFC 8996: none before 1.2

enum peer_stage {
    PEER_QUIET, // asks nothing, or has not finished asking
    PEER_BUSY,  // is being served
    PEER_REPLYING,
    PEER_STREAMING,
};
// A connection from its acceptance to its end.
struct peer {
    struct peer *next;
    int socket;
    unsigned char address[16];
    enum peer_stage stage;
    double since; // of the stage, or of the last piece of a body
    bool evicted, refused;
};

struct http_request {
    struct http_server *server;
    struct peer *peer;
    const struct http_service *service;
    struct MHD_Connection *connection;
    const char *method;
    char *target;       // as sent, then cut into:
    char *path, *query; // query may be NULL
    char *authority;    // of a target in absolute form, else NULL
    size_t target_bytes;
    char *body;
    size_t bytes, capacity;
    uint64_t drained;
    bool begun, refused, replied;
    bool closes; // the connection after this: where the next request begins is not known
    struct http_reply reply;
};

struct http_server {
    struct MHD_Daemon *daemon;
    struct http_service service;
    char *cert, *key;
    int listener; // closed by quiescing
    bool cuts_at_zeroes;
    pthread_mutex_t lock;
    struct peer *peers;
    struct http_counts counts; // most, most_of_address: fixed from the start on
};

// A body without end, and the socket on which its reader may go away.
struct endless {
    struct http_reply reply;
    int socket;
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
struct lines {
    const char *name;
    char *text;
    size_t bytes;
    bool no_memory;
};

static enum MHD_Result join_line(void *cls, enum MHD_ValueKind kind, const char *name,
                                 const char *value) {
    struct lines *lines = cls;
    (void)kind;
    if (strcasecmp(name, lines->name) != 0 || value == NULL)
        return MHD_YES;
    size_t n = strlen(value);
    char *moved = realloc(lines->text, lines->bytes + n + 3);
    lines->no_memory = moved == NULL;
    if (moved == NULL)
        return MHD_NO;
    lines->text = moved;
    lines->bytes +=
        (size_t)sprintf(moved + lines->bytes, "%s%s", lines->bytes > 0 ? ", " : "", value);
    return MHD_YES;
}

char *http_header_lines(const struct http_request *q, const char *name) {
    struct lines lines = {.name = name};
    MHD_get_connection_values(q->connection, MHD_HEADER_KIND, join_line, &lines);
    if (lines.no_memory) {
        free(lines.text);
        return NULL;
    }
    return lines.text;
}
const char *http_host(const struct http_request *q) {
    return q->authority != NULL ? q->authority : http_header(q, "Host");
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

// Decodes n bytes of a query, of which + is a blank, into `out`; false on a bad escape or where
// they do not fit: then it is empty.
static bool decode_piece(const char *from, size_t n, char *out, size_t bytes) {
    out[0] = '\0';
    if (n >= bytes)
        return false;
    memcpy(out, from, n);
    out[n] = '\0';
    for (char *c = out; *c != '\0'; c++)
        if (*c == '+')
            *c = ' ';
    if (http_decode(out))
        return true;
    out[0] = '\0';
    return false;
}

bool http_query_next(const struct http_request *q, size_t *at, char *key, size_t key_bytes,
                     char *value, size_t value_bytes, bool *sound) {
    const char *text = q->query != NULL ? q->query + *at : "";
    size_t skip = strspn(text, "&"), n = strcspn(text + skip, "&"), length;
    if (n == 0)
        return false;
    text += skip;
    length = strcspn(text, "=&");
    *at += skip + n;
    *sound = decode_piece(text, length, key, key_bytes);
    length += length < n; // the =
    if (value != NULL && !decode_piece(text + length, n - length, value, value_bytes))
        *sound = false;
    return true;
}

bool http_query(const struct http_request *q, const char *key, char *out, size_t bytes) {
    char name[64];
    bool sound;
    for (size_t at = 0; http_query_next(q, &at, name, sizeof name, out, bytes, &sound);)
        if (strcmp(name, key) == 0)
            return true;
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

// ---- Connections ------------------------------------------------------------------------------

static double seconds_now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void peer_enter(struct http_server *server, struct peer *peer, enum peer_stage stage) {
    pthread_mutex_lock(&server->lock);
    peer->stage = stage;
    peer->since = seconds_now();
    pthread_mutex_unlock(&server->lock);
}

static bool same_address(const struct peer *a, const struct peer *b) {
    return memcmp(a->address, b->address, sizeof a->address) == 0;
}

// Closes the connection that has asked nothing for longest, or else the one whose reply has been
// read for longest; of `like`'s address only when that is given. Called with the lock.
static bool evict(struct http_server *server, const struct peer *newest, const struct peer *like) {
    struct peer *worst = NULL;
    double now = seconds_now();
    for (struct peer *p = server->peers; p != NULL; p = p->next) {
        bool quiet = p->stage == PEER_QUIET;
        bool slow = p->stage == PEER_REPLYING && now - p->since > SLOW_SECONDS;
        if (p == newest || p->evicted || (!quiet && !slow) ||
            (like != NULL && !same_address(p, like)))
            continue;
        if (worst == NULL || (quiet && worst->stage != PEER_QUIET) ||
            (quiet == (worst->stage == PEER_QUIET) && p->since < worst->since))
            worst = p;
    }
    if (worst == NULL)
        return false;
    worst->evicted = true;
    server->counts.evicted++;
    shutdown(worst->socket, SHUT_RDWR); // its thread ends by itself
    return true;
}

// Called with the lock, for a connection that has just come.
static void make_place(struct http_server *server, struct peer *newest) {
    unsigned all = 0, alike = 0;
    for (const struct peer *p = server->peers; p != NULL; p = p->next)
        if (!p->evicted && !p->refused) {
            all++;
            alike += same_address(p, newest);
        }
    if (alike > server->counts.most_of_address)
        newest->refused = !evict(server, newest, newest);
    else if (all > server->counts.most)
        newest->refused = !evict(server, newest, NULL);
    server->counts.refused += newest->refused;
}

static void address_of(struct MHD_Connection *connection, unsigned char *out) {
    const union MHD_ConnectionInfo *info =
        MHD_get_connection_info(connection, MHD_CONNECTION_INFO_CLIENT_ADDRESS);
    const struct sockaddr *address = info != NULL ? info->client_addr : NULL;
    memset(out, 0, 16);
    if (address != NULL && address->sa_family == AF_INET)
        memcpy(out, &((const struct sockaddr_in *)(const void *)address)->sin_addr, 4);
    else if (address != NULL && address->sa_family == AF_INET6)
        memcpy(out, &((const struct sockaddr_in6 *)(const void *)address)->sin6_addr, 8); // a /64
}

// So that the kernel finds peers that have vanished, also those that we send nothing to.
static void watch_peer(int socket) {
    int one = 1, idle = 10, interval = 5, probes = 4, unacknowledged = 1000 * PEER_SECONDS;
    setsockopt(socket, SOL_SOCKET, SO_KEEPALIVE, &one, sizeof one);
    setsockopt(socket, IPPROTO_TCP, TCP_KEEPIDLE, &idle, sizeof idle);
    setsockopt(socket, IPPROTO_TCP, TCP_KEEPINTVL, &interval, sizeof interval);
    setsockopt(socket, IPPROTO_TCP, TCP_KEEPCNT, &probes, sizeof probes);
    setsockopt(socket, IPPROTO_TCP, TCP_USER_TIMEOUT, &unacknowledged, sizeof unacknowledged);
}

static void on_connection(void *cls, struct MHD_Connection *connection, void **context,
                          enum MHD_ConnectionNotificationCode code) {
    struct http_server *server = cls;
    if (code == MHD_CONNECTION_NOTIFY_STARTED) {
        const union MHD_ConnectionInfo *info =
            MHD_get_connection_info(connection, MHD_CONNECTION_INFO_CONNECTION_FD);
        struct peer *peer = calloc(1, sizeof *peer);
        if (peer == NULL || info == NULL) {
            free(peer);
            return; // its requests are refused
        }
        peer->socket = info->connect_fd;
        peer->since = seconds_now();
        address_of(connection, peer->address);
        watch_peer(peer->socket);
        pthread_mutex_lock(&server->lock);
        peer->next = server->peers;
        server->peers = peer;
        server->counts.open++;
        server->counts.accepted++;
        make_place(server, peer);
        pthread_mutex_unlock(&server->lock);
        *context = peer;
        return;
    }
    struct peer *peer = *context;
    if (peer == NULL)
        return;
    pthread_mutex_lock(&server->lock);
    for (struct peer **link = &server->peers; *link != NULL; link = &(*link)->next)
        if (*link == peer) {
            *link = peer->next;
            break;
        }
    server->counts.open--;
    pthread_mutex_unlock(&server->lock);
    free(peer);
    *context = NULL;
}

void http_count(struct http_server *server, struct http_counts *out) {
    pthread_mutex_lock(&server->lock);
    *out = server->counts;
    pthread_mutex_unlock(&server->lock);
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

// Whether the other side has hung up. While there is nothing to send, nothing else would tell.
static bool reader_gone(int socket) {
    struct pollfd item = {.fd = socket, .events = POLLRDHUP};
    return poll(&item, 1, 0) > 0 && (item.revents & (POLLRDHUP | POLLHUP | POLLERR)) != 0;
}

static ssize_t produce(void *cls, uint64_t position, char *out, size_t bytes) {
    struct endless *own = cls;
    (void)position;
    size_t n = own->reply.produce(own->reply.stream, out, bytes);
    if (n == HTTP_END || (n == 0 && reader_gone(own->socket)))
        return MHD_CONTENT_READER_END_OF_STREAM;
    return (ssize_t)n;
}

static void produce_end(void *cls) {
    struct endless *own = cls;
    reply_clear(&own->reply);
    free(own);
}

static struct MHD_Response *make_response(struct http_reply *reply, int socket, bool head_only) {
    struct MHD_Response *response = NULL;
    if (reply->produce != NULL) {
        struct endless *own = malloc(sizeof *own);
        if (own == NULL)
            return NULL;
        *own = (struct endless){.reply = *reply, .socket = socket};
        response = MHD_create_response_from_callback(MHD_SIZE_UNKNOWN, STREAM_BLOCK, produce, own,
                                                     produce_end);
        if (response == NULL)
            free(own);
        else
            reply->close = NULL;
        // libmicrohttpd sends the last chunk even where there is no body to be sent.
        if (response != NULL && head_only)
            MHD_set_response_options(response, MHD_RF_HTTP_1_0_COMPATIBLE_STRICT, MHD_RO_END);
    } else if (reply->fd >= 0) {
        response = MHD_create_response_from_fd_at_offset64(reply->bytes, reply->fd, reply->offset);
        if (response != NULL)
            reply->fd = -1;
    } else if (reply->constant != NULL) {
        char *text = (char *)(uintptr_t)reply->constant; // which libmicrohttpd does not write to
        response = MHD_create_response_from_buffer(reply->bytes, text, MHD_RESPMEM_PERSISTENT);
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
    bool endless = reply->produce != NULL;
    struct MHD_Response *response =
        make_response(reply, q->peer->socket, strcmp(q->method, "HEAD") == 0);
    if (response == NULL)
        return MHD_NO;
    if (endless || q->peer->refused || q->closes)
        MHD_add_response_header(response, "Connection", "close");
    if (endless) // it is quiet while the run is; a peer that is gone is the kernel's to find
        MHD_set_connection_option(q->connection, MHD_CONNECTION_OPTION_TIMEOUT, 0u);
    peer_enter(q->server, q->peer, endless ? PEER_STREAMING : PEER_REPLYING);
    if (reply->type != NULL)
        MHD_add_response_header(response, "Content-Type", reply->type);
    MHD_add_response_header(response, "Cache-Control",
                            reply->cache != NULL ? reply->cache : "no-store");
    MHD_add_response_header(response, "X-Content-Type-Options", "nosniff");
    for (unsigned k = 0; k < reply->n_headers; k++)
        MHD_add_response_header(response, reply->headers[k].name, reply->headers[k].value);
    enum MHD_Result result = MHD_queue_response(q->connection, (unsigned)reply->status, response);
    MHD_destroy_response(response);
    q->replied = true;
    return result;
}

// ---- Requests ---------------------------------------------------------------------------------

// Origin form (/path?query) or absolute form (http://authority/path?query), which clients use
// towards proxies and every server must take (RFC 9112, 3.2.2).
static void target_split(struct http_request *q) {
    static char root[] = "/";
    const char *after = strncasecmp(q->target, "http://", 7) == 0    ? q->target + 7
                        : strncasecmp(q->target, "https://", 8) == 0 ? q->target + 8
                                                                     : NULL;
    q->path = q->target;
    if (after != NULL) {
        size_t n = strcspn(after, "/?");
        q->authority = strndup(after, n);
        if (q->authority == NULL) {
            q->path = NULL; // refused
            return;
        }
        q->path = q->target + (after - q->target) + n;
    }
    q->query = strchr(q->path, '?');
    if (q->query != NULL)
        *q->query++ = '\0';
    if (after != NULL && q->path[0] == '\0')
        q->path = root;
}

// By this thread's connection, from the request's first line on.
static _Thread_local struct http_request *being_read;

// The first that libmicrohttpd tells of a request: its target as it was sent, before any decoding.
static void *on_target(void *cls, const char *target, struct MHD_Connection *connection) {
    struct http_server *server = cls;
    struct http_request *q = calloc(1, sizeof *q);
    const union MHD_ConnectionInfo *info =
        MHD_get_connection_info(connection, MHD_CONNECTION_INFO_SOCKET_CONTEXT);
    if (q == NULL || info == NULL || info->socket_context == NULL) {
        free(q);
        return NULL;
    }
    q->server = server;
    q->peer = info->socket_context;
    q->service = &server->service;
    q->reply.fd = -1;
    q->target = strdup(target);
    q->target_bytes = strlen(target);
    if (q->target != NULL)
        target_split(q);
    being_read = q;
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
    being_read = NULL;
    peer_enter(q->server, q->peer, PEER_QUIET);
    reply_clear(&q->reply);
    free(q->target);
    free(q->authority);
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

// Headers that decide who is asked, who asks, and where the request ends: twice, they let two
// readers (a proxy and this server) see two requests.
static const char *const singles[] = {"Host",         "Origin",          "Authorization",
                                      "Content-Type", "Content-Length",  "Transfer-Encoding",
                                      "If-Match",     "Idempotency-Key", "Last-Event-ID"};
#define SINGLES (sizeof singles / sizeof *singles)

struct head {
    unsigned counts[SINGLES];
    size_t bytes;
    const char *fault; // what is wrong with it
    const char *end;   // of its bytes as they were received, or NULL: they are not looked at
    const char *told;  // of what was told of them so far
};

// Before 1.0 libmicrohttpd cuts lines at a zero byte and does not say so: `Host: localhost\0evil`
// would be a request for localhost, where a proxy in front may see another. There the pieces of a
// head lie where they were received, between them what it puts in the place of ':', CR and LF:
// whatever else lies there was cut off. It does so too where a line goes on in the next (RFC
// 9112, 5.2: 400).
static bool cuts_at_zeroes(void) {
    return strncmp(MHD_get_version(), "0.9.", 4) == 0;
}

// What lies between the last piece and this one: at most `zeroes`, and blanks.
static void look_between(struct head *head, const char *to, unsigned zeroes) {
    unsigned found = 0;
    if (head->end == NULL || to < head->told || to > head->end)
        return;
    for (const char *c = head->told; c < to; c++) {
        found += *c == '\0';
        if ((*c != '\0' && *c != ' ' && *c != '\t') || found > zeroes)
            head->fault = "the head has a zero byte, or a line that goes on in the next";
    }
    head->told = to;
}

// Method, target and version, with a blank between them.
static void look_at_first_line(struct head *head, const struct http_request *q,
                               const char *version) {
    size_t method = strlen(q->method);
    const union MHD_ConnectionInfo *info =
        MHD_get_connection_info(q->connection, MHD_CONNECTION_INFO_REQUEST_HEADER_SIZE);
    if (!q->server->cuts_at_zeroes || info == NULL || info->header_size > CONNECTION_MEMORY ||
        version <= q->method || (size_t)(version - q->method) > info->header_size)
        return;
    head->end = q->method + info->header_size;
    head->told = version + strlen(version);
    if ((size_t)(version - q->method) != method + 1 + q->target_bytes + 1)
        head->fault = "the request line has a zero byte, or more than one blank in a row";
}

static enum MHD_Result head_line(void *cls, enum MHD_ValueKind kind, const char *key,
                                 size_t key_bytes, const char *value, size_t value_bytes) {
    struct head *head = cls;
    (void)kind;
    look_between(head, key, 2);
    if (value != NULL && head->end != NULL && value >= head->told && value < head->end) {
        if (key >= head->told && key <= value) // else the name was moved, for what came behind
            head->told = key + key_bytes;
        look_between(head, value, 1);
        head->told = value + value_bytes;
    }
    head->bytes += key_bytes + value_bytes + 4; // ": ", CRLF
    if (key == NULL || key_bytes == 0 || strcspn(key, " \t") != key_bytes)
        head->fault = "a header's name is empty or has a blank in it";
    for (size_t k = 0; key != NULL && k < SINGLES; k++)
        head->counts[k] += strcasecmp(key, singles[k]) == 0;
    return MHD_YES;
}

// Whether the head of the request is sound (RFC 9112, 3.2, 5.1, 6.3); else the reply is filled.
static bool head_sound(struct http_request *q, const char *version) {
    struct head head = {0};
    char why[128];
    const char *coding = http_header(q, "Transfer-Encoding"),
               *length = http_header(q, "Content-Length");
    look_at_first_line(&head, q, version);
    MHD_get_connection_values_n(q->connection, MHD_HEADER_KIND, head_line, &head);
    look_between(&head, head.end, 4);
    head.bytes += strlen(q->method) + strlen(version) + 4 + q->target_bytes;
    for (size_t k = 0; k < SINGLES && head.fault == NULL; k++)
        if (head.counts[k] > 1) {
            snprintf(why, sizeof why, "the header %s may be sent once, came %u times", singles[k],
                     head.counts[k]);
            head.fault = why;
        }
    if (head.fault != NULL)
        ;
    else if (head.counts[0] == 0 && strcmp(version, "HTTP/1.0") != 0)
        head.fault = "the Host header is missing";
    else if (coding != NULL && strcasecmp(coding, "chunked") != 0)
        head.fault = "Transfer-Encoding must be chunked";
    else if (coding != NULL && length != NULL)
        head.fault = "Transfer-Encoding and Content-Length exclude each other";
    bool long_head = head.fault == NULL && head.bytes > HTTP_HEADER_BYTES;
    if (long_head) {
        snprintf(why, sizeof why, "the head of the request is over the limit of %d bytes",
                 HTTP_HEADER_BYTES);
        head.fault = why;
    }
    if (head.fault == NULL)
        return true;
    q->closes = true;
    q->service->malformed(q->service->context, long_head ? 431 : 400, head.fault, &q->reply);
    return false;
}

static enum MHD_Result begin(struct http_request *q, const char *version) {
    const char *text = http_header(q, "Content-Length"), *expect = http_header(q, "Expect");
    uint64_t length = text != NULL ? strtoull(text, NULL, 10) : 0;
    q->begun = true;
    if (q->peer->refused) {
        q->refused = true;
        q->service->too_many(q->service->context, &q->server->counts, &q->reply);
    } else if (!head_sound(q, version)) {
        q->refused = true;
        return send_reply(q);
    } else {
        q->refused = !q->service->admit(q->service->context, q, &q->reply);
    }
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
    if (q == NULL || q->path == NULL)
        return MHD_NO;
    q->connection = connection;
    q->method = method;
    if (!q->begun)
        return begin(q, version);
    if (*upload_bytes > 0) {
        q->drained += *upload_bytes;
        peer_enter(q->server, q->peer, PEER_QUIET); // makes progress
        if (!q->refused && q->drained > q->service->max_body)
            refuse_size(q);
        if (q->refused ? q->drained > DRAIN_MAX : !body_append(q, upload, *upload_bytes))
            return MHD_NO;
        *upload_bytes = 0;
        return MHD_YES;
    }
    if (q->replied)
        return MHD_YES;
    peer_enter(q->server, q->peer, PEER_BUSY);
    if (!q->refused)
        q->service->serve(q->service->context, q, &q->reply);
    return send_reply(q);
}

// ---- Server -----------------------------------------------------------------------------------

static void send_all(int socket, const char *text, size_t n) {
    while (n > 0) {
        ssize_t sent = send(socket, text, n, MSG_NOSIGNAL);
        if (sent <= 0)
            return;
        text += sent;
        n -= (size_t)sent;
    }
}

// libmicrohttpd answers some heads and bodies by itself before it asks us, in HTML, and a bad
// Content-Length twice over (before 1.0 parse_connection_headers goes on behind its own reply). It
// says so in its log first, on the connection's own thread, before it has sent anything: the answer
// is sent here, and what it sends afterwards is not let out. Not through TLS, whose session is its
// own.
static void answer_first(unsigned status) {
    struct http_request *q = being_read;
    char head[512];
    struct http_reply reply = {.fd = -1};
    if (q == NULL || q->replied || q->server->cert != NULL)
        return;
    q->replied = true;
    q->service->malformed(q->service->context, (int)status,
                          status == 413 ? "the length of the body is too large a number"
                          : status == 431
                              ? "the head of the request is too long"
                              : "this is no request of HTTP/1.1, or its Content-Length or "
                                "chunks are malformed",
                          &reply);
    int n = snprintf(head, sizeof head,
                     "HTTP/1.1 %u %s\r\nContent-Type: %s\r\nCache-Control: no-store\r\n"
                     "X-Content-Type-Options: nosniff\r\nConnection: close\r\n"
                     "Content-Length: %zu\r\n\r\n",
                     status, MHD_get_reason_phrase_for(status), reply.type, reply.bytes);
    send_all(q->peer->socket, head, (size_t)n);
    send_all(q->peer->socket, reply.body != NULL ? reply.body : "", reply.bytes);
    shutdown(q->peer->socket, SHUT_WR);
    reply_clear(&reply);
}

static void on_log(void *cls, const char *format, va_list arguments) {
    static const char own_error[] = "Error processing request (HTTP response code is %u";
    char text[512];
    va_list again;
    (void)cls;
    va_copy(again, arguments);
    vsnprintf(text, sizeof text, format, arguments);
    log_line(LOG_LEVEL_DEBUG, "http", "%s", text);
    if (strncmp(format, own_error, sizeof own_error - 1) == 0)
        answer_first(va_arg(again, unsigned));
    va_end(again);
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

static char *file_text(const char *path, bool secret, char *why, size_t why_bytes) {
    char *text = calloc(1, TLS_FILE_MAX + 1);
    FILE *file = fopen(path, "re");
    struct stat info;
    // As the token and the keys of CURVE; but a group may hold those who serve with it.
    if (secret && file != NULL && fstat(fileno(file), &info) == 0 && (info.st_mode & 07) != 0) {
        snprintf(why, why_bytes, "%s: others can read it: chmod 640", path);
        fclose(file);
        free(text);
        return NULL;
    }
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

// A quarter of the descriptors that the process may have: a connection takes one, or two while a
// frame is sent, and runs need theirs.
static void set_limits(struct http_counts *counts) {
    struct rlimit files;
    rlim_t share = getrlimit(RLIMIT_NOFILE, &files) == 0 ? files.rlim_cur / 4 : HTTP_CONNECTIONS;
    counts->most = share < HTTP_CONNECTIONS ? (unsigned)share : HTTP_CONNECTIONS;
    counts->most_of_address = counts->most * HTTP_CONNECTIONS_OF_ADDRESS / HTTP_CONNECTIONS;
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
    server->cuts_at_zeroes = cuts_at_zeroes();
    set_limits(&server->counts);
    pthread_mutex_init(&server->lock, NULL);
    if (tls && ((server->cert = file_text(address->tls_cert, false, why, why_bytes)) == NULL ||
                (server->key = file_text(address->tls_key, true, why, why_bytes)) == NULL))
        goto fail;
    server->listener = listen_on(address, tls, url, url_bytes, why, why_bytes);
    if (server->listener < 0)
        goto fail;
    struct MHD_OptionItem secure[] = {
        {MHD_OPTION_HTTPS_MEM_CERT, 0, server->cert},
        {MHD_OPTION_HTTPS_MEM_KEY, 0, server->key},
        {MHD_OPTION_HTTPS_PRIORITIES, 0, (char *)(uintptr_t)TLS_PRIORITIES},
        {MHD_OPTION_END, 0, NULL},
    };
    struct MHD_OptionItem plain[] = {{MHD_OPTION_END, 0, NULL}};
    server->daemon = MHD_start_daemon(
        MHD_USE_THREAD_PER_CONNECTION | MHD_USE_INTERNAL_POLLING_THREAD | MHD_USE_POLL |
            MHD_USE_ITC | MHD_USE_ERROR_LOG | (tls ? MHD_USE_TLS : 0),
        0, NULL, NULL, on_request, server, MHD_OPTION_EXTERNAL_LOGGER, on_log, NULL,
        MHD_OPTION_LISTEN_SOCKET, server->listener, MHD_OPTION_CONNECTION_LIMIT, CONNECTIONS_MAX,
        MHD_OPTION_THREAD_STACK_SIZE, (size_t)THREAD_STACK, MHD_OPTION_CONNECTION_MEMORY_LIMIT,
        (size_t)CONNECTION_MEMORY, MHD_OPTION_CONNECTION_TIMEOUT, IDLE_SECONDS,
        MHD_OPTION_URI_LOG_CALLBACK, on_target, server, MHD_OPTION_NOTIFY_COMPLETED, on_completed,
        NULL, MHD_OPTION_NOTIFY_CONNECTION, on_connection, server, MHD_OPTION_ARRAY,
        tls ? secure : plain, MHD_OPTION_END);
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

// libmicrohttpd cuts connections where they stand; what is being answered gets a moment to be read.
static void wait_for_replies(struct http_server *server) {
    double until = seconds_now() + STOP_SECONDS;
    bool busy = true;
    while (busy && seconds_now() < until) {
        busy = false;
        pthread_mutex_lock(&server->lock);
        for (const struct peer *p = server->peers; p != NULL && !busy; p = p->next)
            busy = p->stage != PEER_QUIET && !p->evicted;
        pthread_mutex_unlock(&server->lock);
        if (busy)
            nanosleep(&(struct timespec){.tv_nsec = 10000000}, NULL);
    }
}

void http_stop(struct http_server *server) {
    if (server == NULL)
        return;
    wait_for_replies(server);
    MHD_stop_daemon(server->daemon);
    pthread_mutex_destroy(&server->lock);
    free(server->cert);
    free(server->key);
    free(server);
}
