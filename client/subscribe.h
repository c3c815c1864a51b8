// The live stream of one run: a ZeroMQ SUB socket. What it loses is repaired over HTTP
// (recorder.c).
#pragma once
#include <stddef.h>

struct subscription;
enum subscribe_kind { SUBSCRIBE_NOTHING, SUBSCRIBE_FRAME, SUBSCRIBE_EVENT, SUBSCRIBE_ERROR };

// Keys of an encrypted socket, 40 characters of Z85 each.
#define SUBSCRIBE_KEY 41
struct subscribe_keys {
    char server[SUBSCRIBE_KEY], public[SUBSCRIBE_KEY], secret[SUBSCRIBE_KEY];
};
// A new pair. 0, or -1 when this libzmq has no CURVE.
int subscribe_keypair(char *public, char *secret);
// Reads the file that `fbar keygen` made for a subscriber. 0, or -1 with a sentence in `why`.
int subscribe_keys_read(const char *path, struct subscribe_keys *out, char *why, size_t why_bytes);

// Connects to the publisher at `endpoint` for `run`, encrypted when there are keys. NULL with a
// sentence in `why`. A publisher that is not there yet is connected to once it is.
struct subscription *subscribe_open(const char *endpoint, const char *run,
                                    const struct subscribe_keys *keys, char *why, size_t why_bytes);
void subscribe_close(struct subscription *subscription);
// Waits up to `timeout_ms` for a message, or a signal. The body is borrowed until the next call.
enum subscribe_kind subscribe_receive(struct subscription *subscription, int timeout_ms,
                                      const void **body, size_t *bytes);
