// The output thread: takes filled frames and events, seals them, writes them to the run's journal
// and then publishes them on the one ZeroMQ PUB socket, which only it touches.
//
// Each run has an outlet: a short queue, so that a run waits for the disk only when it is
// OUTLET_DEPTH frames ahead of it, and never for a subscriber.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/journal.h"

#define OUTLET_DEPTH 4 // frames of one run on their way to the disk

struct publisher;
struct outlet;

// Since the daemon began; subscriptions: those that there are now.
struct publish_counts {
    uint64_t frames, frame_bytes, events, subscriptions;
};

// A frame being filled: header and arrays at `frame`, by the layout that frame_layout made.
struct outlet_frame {
    struct journal_frame info;
    unsigned char *frame; // info.bytes bytes, 64-byte aligned
    size_t room;          // bytes that there is memory for
};

#define PUBLISH_KEY 41 // bytes of a public key

// Binds the socket and starts the thread; with a folder of keys (server/zap.h), encrypted.
// `endpoint` receives the address with the port that was picked, `key` (PUBLISH_KEY bytes) the
// public key or "". NULL with a sentence in `why` (JOURNAL_WHY bytes).
struct publisher *publish_start(const char *address, const char *curve_dir, char *endpoint,
                                size_t endpoint_bytes, char *key, char *why);
void publish_count(struct publisher *publisher, struct publish_counts *out);
// Writes and publishes what is queued, waits about a second for subscribers to take it, and ends.
void publish_stop(struct publisher *publisher);

// `wake` is called (from the output thread, without locks) when there is room again or something
// failed. `journal` must outlive the outlet.
struct outlet *publish_open(struct publisher *publisher, const char *run, struct journal *journal,
                            void (*wake)(void *context), void *context);
void publish_close(struct outlet *outlet); // what is still queued is dropped

// How many subscriptions there are that a frame of this run goes to. A subscriber that asks for
// several topics which all match counts as often. They are looked at every half second, or, while
// somebody awaits them, without delay.
uint64_t publish_subscribers(struct outlet *outlet);
void publish_await(struct outlet *outlet, bool awaits);

// Of a run that is over: drops what could not be written, and nothing more is taken from it.
void publish_retire(struct outlet *outlet);

// False also while frames that a recorder has not acknowledged fill the journal's budget.
bool publish_has_room(struct outlet *outlet);
// Tries again at once what found no room.
void publish_retry(struct outlet *outlet);
// A buffer for a frame of `bytes`, or NULL without memory. Give it back by publish_push or
// publish_drop (which takes NULL).
struct outlet_frame *publish_buffer(struct outlet *outlet, size_t bytes);
void publish_drop(struct outlet *outlet, struct outlet_frame *frame);
// Takes the frame: from now on it is the outlet's.
void publish_push(struct outlet *outlet, struct outlet_frame *frame);
// Publishes an event that the journal has already, after the frames pushed before it. Copies
// `json`.
void publish_event(struct outlet *outlet, const char *json);

// How the writing stands: JOURNAL_FULL while a frame waits for room on the disk (it is tried
// again), JOURNAL_HELD while it waits for a recorder, JOURNAL_ERROR once it has failed for good;
// `why` says why.
enum journal_result publish_status(struct outlet *outlet, char *why);
// Waits until all that was pushed is in the journal and handed to the socket; false when it is not
// within `seconds` (< 0: as long as it takes) or the writing failed.
bool publish_flush(struct outlet *outlet, double seconds);
