// Who may subscribe when the ZeroMQ socket is encrypted (CURVE): the keys in a folder, asked for by
// libzmq over ZAP (RFC 27) at every handshake.
//
//   DIR/server.public, DIR/server.secret   this daemon's keys, 40 characters of Z85 each
//   DIR/clients/NAME.public                 one file for each who may subscribe
//
// `fbar keygen DIR` makes them. The folder of clients is read at each handshake: a key that is
// added or removed counts from the next connection on.
#pragma once
#include <stdbool.h>
#include <stddef.h>

#define ZAP_DOMAIN "fbard"
#define ZAP_KEY 41 // bytes of a key in Z85, with its end

struct zap;

// Reads the daemon's keys and begins to answer on the context (a ZeroMQ one, borrowed), which must
// be done before a socket is bound. NULL with a sentence in `why` (JOURNAL_WHY bytes).
struct zap *zap_start(void *context, const char *folder, char *public_key, char *secret_key,
                      char *why);
// After the context was told to end and before it has: ends the thread.
void zap_join(struct zap *zap);
