// libcurl: one easy handle a daemon, so the connection is kept; every body is gathered in memory.
#include "client/request.h"

#include <curl/curl.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/interrupt.h"
#include "client/report.h"
#include "client/terminal.h"

#define CONNECT_TIMEOUT_MS 5000L
// A daemon that sends nothing for this long is taken for gone; actions answer at a step's boundary.
#define SILENCE_TIMEOUT_S 60L
#define RECEIVE_BYTES (512 * 1024L) // at once; curl's own 16 KiB cost a frame many calls

struct request {
    CURL *curl;
    const char *url; // borrowed
    char *authorization;
    bool broken_off;
};

void request_reply_free(struct reply *reply) {
    free(reply->body);
    *reply = (struct reply){0};
}

static char *token_header(const char *token_file) {
    char token[4096];
    FILE *file = fopen(token_file, "r");
    if (!file) {
        terminal_error("%s: %s", token_file, strerror(errno));
        return NULL;
    }
    const size_t n = fread(token, 1, sizeof token - 1, file);
    fclose(file);
    token[n] = '\0';
    token[strcspn(token, " \t\r\n")] = '\0';
    char *header = NULL;
    if (asprintf(&header, "Authorization: Bearer %s", token) < 0)
        header = NULL;
    return header;
}

struct request *request_create(const char *url, const char *token_file) {
    struct request *request = calloc(1, sizeof *request);
    if (!request || !(request->curl = curl_easy_init())) {
        terminal_error("out of memory");
        free(request);
        return NULL;
    }
    request->url = url;
    if (token_file && !(request->authorization = token_header(token_file))) {
        request_free(request);
        return NULL;
    }
    return request;
}

void request_free(struct request *request) {
    if (!request)
        return;
    curl_easy_cleanup(request->curl);
    free(request->authorization);
    free(request);
}

struct body {
    CURL *curl;
    struct reply *reply;
    size_t capacity;
};

static size_t on_body(char *data, size_t size, size_t n, void *context) {
    struct body *body = context;
    struct reply *reply = body->reply;
    const size_t bytes = size * n, need = reply->bytes + bytes + 1;
    if (need > body->capacity) {
        curl_off_t stated = -1;
        curl_easy_getinfo(body->curl, CURLINFO_CONTENT_LENGTH_DOWNLOAD_T, &stated);
        size_t capacity = need > 2 * body->capacity ? need : 2 * body->capacity;
        if (stated >= 0 && (size_t)stated + 1 > need && stated < 1 << 30)
            capacity = (size_t)stated + 1; // a claim that is not kept only costs address space
        char *grown = realloc(reply->body, capacity);
        if (!grown)
            return 0;
        reply->body = grown;
        body->capacity = capacity;
    }
    memcpy(reply->body + reply->bytes, data, bytes);
    reply->bytes += bytes;
    reply->body[reply->bytes] = '\0';
    return bytes;
}

// Lets a second Ctrl-C end a request that hangs.
static int on_progress(void *context, curl_off_t a, curl_off_t b, curl_off_t c, curl_off_t d) {
    (void)context, (void)a, (void)b, (void)c, (void)d;
    return interrupt_count() > 1;
}

int request_send(struct request *request, const struct request_spec *spec, struct reply *out,
                 char *why, size_t why_bytes) {
    CURL *curl = request->curl;
    char address[2048], accept[128], message[CURL_ERROR_SIZE] = "";
    struct curl_slist *headers = NULL;
    struct body body = {.curl = curl, .reply = out};
    *out = (struct reply){0};
    snprintf(address, sizeof address, "%s%s", request->url, spec->path);
    snprintf(accept, sizeof accept, "Accept: %s", spec->accept ? spec->accept : "*/*");
    headers = curl_slist_append(headers, accept);
    headers = curl_slist_append(headers, "Expect:"); // no round trip before a large scene
    if (spec->body)
        headers = curl_slist_append(headers, "Content-Type: application/json");
    if (request->authorization)
        headers = curl_slist_append(headers, request->authorization);

    curl_easy_reset(curl); // keeps the connection
    curl_easy_setopt(curl, CURLOPT_URL, address);
    curl_easy_setopt(curl, CURLOPT_CUSTOMREQUEST, spec->method);
    curl_easy_setopt(curl, CURLOPT_HTTPHEADER, headers);
    curl_easy_setopt(curl, CURLOPT_PROTOCOLS_STR, "http,https");
    curl_easy_setopt(curl, CURLOPT_PROXY, "");
    curl_easy_setopt(curl, CURLOPT_NOSIGNAL, 1L);
    curl_easy_setopt(curl, CURLOPT_CONNECTTIMEOUT_MS, CONNECT_TIMEOUT_MS);
    if (spec->timeout_ms > 0)
        curl_easy_setopt(curl, CURLOPT_TIMEOUT_MS, spec->timeout_ms);
    curl_easy_setopt(curl, CURLOPT_LOW_SPEED_LIMIT, 1L);
    curl_easy_setopt(curl, CURLOPT_LOW_SPEED_TIME, SILENCE_TIMEOUT_S);
    curl_easy_setopt(curl, CURLOPT_ERRORBUFFER, message);
    curl_easy_setopt(curl, CURLOPT_BUFFERSIZE, RECEIVE_BYTES);
    curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, on_body);
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, &body);
    curl_easy_setopt(curl, CURLOPT_XFERINFOFUNCTION, on_progress);
    curl_easy_setopt(curl, CURLOPT_NOPROGRESS, 0L);
    if (spec->body) {
        curl_easy_setopt(curl, CURLOPT_POSTFIELDSIZE_LARGE, (curl_off_t)strlen(spec->body));
        curl_easy_setopt(curl, CURLOPT_POSTFIELDS, spec->body);
    }
    const CURLcode code = curl_easy_perform(curl);
    curl_slist_free_all(headers);
    request->broken_off = code == CURLE_SEND_ERROR || code == CURLE_RECV_ERROR ||
                          code == CURLE_GOT_NOTHING || code == CURLE_PARTIAL_FILE;
    if (code != CURLE_OK) {
        request_reply_free(out);
        snprintf(why, why_bytes, "%s", *message ? message : curl_easy_strerror(code));
        return -1;
    }
    curl_easy_getinfo(curl, CURLINFO_RESPONSE_CODE, &out->status);
    if (!out->body && !(out->body = calloc(1, 1))) {
        snprintf(why, why_bytes, "out of memory");
        return -1;
    }
    return 0;
}

bool request_broken_off(const struct request *request) {
    return request->broken_off;
}

char *request_path(const char *before, const char *id, const char *after) {
    char *escaped = curl_easy_escape(NULL, id, 0), *path = NULL;
    if (!escaped || asprintf(&path, "%s%s%s", before, escaped, after) < 0)
        path = NULL;
    curl_free(escaped);
    return path;
}

static const char *text_member(const cJSON *object, const char *key) {
    const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return text && *text ? text : NULL;
}

int request_complain(const struct reply *reply) {
    cJSON *problem = cJSON_Parse(reply->body);
    const cJSON *errors = cJSON_GetObjectItemCaseSensitive(problem, "errors"), *error;
    if (cJSON_GetArraySize(errors) > 0) {
        cJSON_ArrayForEach(error, errors) {
            const char *pointer = text_member(error, "pointer");
            const char *detail = text_member(error, "detail");
            terminal_error("%s: %s", pointer ? pointer : "/", detail ? detail : "is wrong");
        }
    } else {
        const char *detail = text_member(problem, "detail"), *title = text_member(problem, "title");
        if (detail || title)
            terminal_error("%s", detail ? detail : title);
        else
            terminal_error("the daemon answered %ld", reply->status);
    }
    cJSON_Delete(problem);
    return reply->status >= 500 ? CLIENT_UNREACHABLE : CLIENT_USAGE;
}

int request_expect(struct client *client, const struct request_spec *spec, struct reply *out) {
    char why[512];
    if (request_send(client->requests, spec, out, why, sizeof why) != 0) {
        terminal_error("cannot reach the daemon at %s: %s; start one with `fbard`%s", client->url, why,
                       client->url_given ? ", or name another with --url" : "");
        return interrupt_count() ? CLIENT_INTERRUPTED : CLIENT_UNREACHABLE;
    }
    if (out->status >= 200 && out->status < 300)
        return CLIENT_DONE;
    const int code = request_complain(out);
    cJSON *problem = client->json ? cJSON_Parse(out->body) : NULL;
    if (problem)
        report_json(problem);
    cJSON_Delete(problem);
    request_reply_free(out);
    return code;
}

int request_json(struct client *client, const char *method, const char *path, const char *body,
                 cJSON **out) {
    struct reply reply;
    const struct request_spec spec = {
        .method = method, .path = path, .body = body, .accept = "application/json"};
    const int code = request_expect(client, &spec, &reply);
    if (out)
        *out = NULL;
    if (code != CLIENT_DONE)
        return code;
    if (out && !(*out = cJSON_Parse(reply.body))) {
        terminal_error("%s: the answer is no JSON; is this an fbard?", client->url);
        request_reply_free(&reply);
        return CLIENT_UNREACHABLE;
    }
    request_reply_free(&reply);
    return CLIENT_DONE;
}
