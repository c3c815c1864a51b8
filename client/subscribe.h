// The live stream of one run: a ZeroMQ SUB socket. What it loses is repaired over HTTP
// (recorder.c).
#pragma once
#include <stddef.h>

struct subscription;
enum subscribe_kind { SUBSCRIBE_NOTHING, SUBSCRIBE_FRAME, SUBSCRIBE_EVENT, SUBSCRIBE_ERROR };

// Connects to the publisher at `endpoint` for `run`. NULL with a sentence in `why`. A publisher
// that is not there yet is connected to once it is.
struct subscription *subscribe_open(const char *endpoint, const char *run, char *why,
                                    size_t why_bytes);
void subscribe_close(struct subscription *subscription);
// Waits up to `timeout_ms` for a message, or a signal. The body is borrowed until the next call.
enum subscribe_kind subscribe_receive(struct subscription *subscription, int timeout_ms,
                                      const void **body, size_t *bytes);
