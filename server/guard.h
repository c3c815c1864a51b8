// Who may ask: the Host and Origin headers (against DNS rebinding and foreign pages) and the token.
#pragma once
#include <stdbool.h>
#include <stddef.h>

struct guard {
    char bound[256]; // host that the server was bound to
    char *token;     // NULL: none is asked for; owned
};

// Reads the token file: one line. False with a sentence in `why`.
bool guard_init(struct guard *guard, const char *bound, const char *token_file, char *why,
                size_t why_bytes);
void guard_free(struct guard *guard);

// 0, or the HTTP status to refuse with. Headers that were not sent are NULL.
int guard_verdict(const struct guard *guard, const char *host, const char *origin,
                  const char *authorization);
