// A browser that was lured to a hostile page sends that page's Origin, or (after DNS rebinding) its
// Host: both are refused on every route, so that only programs that name this server reach it.
#include "server/guard.h"

#include <arpa/inet.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

#include "server/log.h"
#include "server/options.h"

#define TOKEN_MAX 4096

bool guard_init(struct guard *guard, const char *bound, const char *token_file, char *why,
                size_t why_bytes) {
    char text[TOKEN_MAX + 2];
    *guard = (struct guard){0};
    snprintf(guard->bound, sizeof guard->bound, "%s", bound);
    if (token_file == NULL || token_file[0] == '\0')
        return true;
    FILE *file = fopen(token_file, "re");
    struct stat info;
    if (file == NULL || fstat(fileno(file), &info) != 0) {
        snprintf(why, why_bytes, "%s: %s", token_file, strerror(errno));
        if (file != NULL)
            fclose(file);
        return false;
    }
    if ((info.st_mode & 077) != 0) {
        snprintf(why, why_bytes, "%s: others can read it: chmod 600", token_file);
        fclose(file);
        return false;
    }
    size_t n = fread(text, 1, TOKEN_MAX + 1, file);
    fclose(file);
    if (n > TOKEN_MAX) {
        snprintf(why, why_bytes, "%s: a token has at most %d characters", token_file, TOKEN_MAX);
        return false;
    }
    while (n > 0 && strchr(" \t\r\n", text[n - 1]) != NULL)
        n--;
    text[n] = '\0';
    if (n == 0 || strlen(text) != n || strpbrk(text, " \t\r\n") != NULL) {
        snprintf(why, why_bytes, "%s: must hold one token without spaces", token_file);
        return false;
    }
    guard->token = strdup(text);
    return guard->token != NULL;
}

void guard_free(struct guard *guard) {
    free(guard->token);
    guard->token = NULL;
}

// The host of "host", "host:port", "[v6]:port". False when it is none of these.
static bool split_host(const char *text, char *host, size_t bytes) {
    const char *end;
    if (text[0] == '[') {
        text++;
        end = strchr(text, ']');
        if (end == NULL || (end[1] != '\0' && end[1] != ':'))
            return false;
    } else {
        end = strchr(text, ':');
        if (end == NULL)
            end = text + strlen(text);
    }
    size_t n = (size_t)(end - text);
    if (n == 0 || n >= bytes)
        return false;
    memcpy(host, text, n);
    host[n] = '\0';
    const char *port = *end == ']' ? end + 1 : end;
    return *port == '\0' || strspn(port + 1, "0123456789") == strlen(port + 1);
}

static bool is_address(const char *host) {
    unsigned char address[sizeof(struct in6_addr)];
    return inet_pton(AF_INET, host, address) == 1 || inet_pton(AF_INET6, host, address) == 1;
}

static bool host_allowed(const struct guard *guard, const char *text) {
    char host[256], own[256];
    if (!split_host(text, host, sizeof host))
        return false;
    if (strcasecmp(host, "localhost") == 0 || options_is_loopback(host) ||
        strcasecmp(host, guard->bound) == 0)
        return true;
    // Bound to every address: any literal address is this machine's (rebinding needs a name).
    bool everywhere = strcmp(guard->bound, "0.0.0.0") == 0 || strcmp(guard->bound, "::") == 0;
    if (everywhere && is_address(host))
        return true;
    return !options_is_loopback(guard->bound) && gethostname(own, sizeof own) == 0 &&
           strcasecmp(host, own) == 0;
}

// A page may ask only the server that it came from.
static bool origin_allowed(const char *origin, const char *host) {
    const char *authority = strstr(origin, "://");
    if (authority == NULL || host == NULL)
        return false;
    size_t scheme = (size_t)(authority - origin);
    bool web = (scheme == 4 && strncasecmp(origin, "http", 4) == 0) ||
               (scheme == 5 && strncasecmp(origin, "https", 5) == 0);
    return web && strcasecmp(authority + 3, host) == 0;
}

// Takes as long for every guess of one length.
static bool token_equal(const char *token, const char *guess) {
    size_t n = strlen(token), m = strlen(guess);
    volatile unsigned char difference = n != m;
    for (size_t k = 0; k < n; k++)
        difference = (unsigned char)(difference | (token[k] ^ (k < m ? guess[k] : 0)));
    return difference == 0;
}

int guard_verdict(const struct guard *guard, const char *host, const char *origin,
                  const char *authorization) {
    if (host != NULL && !host_allowed(guard, host))
        return 421;
    if (origin != NULL && !origin_allowed(origin, host))
        return 403;
    if (guard->token == NULL)
        return 0;
    if (authorization == NULL || strncasecmp(authorization, "Bearer ", 7) != 0)
        return 401;
    return token_equal(guard->token, authorization + 7) ? 0 : 401;
}
