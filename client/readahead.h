// Reads a log one record ahead, in a thread of its own: while one frame goes into FILE.h5 the next
// is read and checked.
#pragma once
#include <stddef.h>

#include "client/framelog.h"

struct readahead;

// Starts over at the first record of `log` (borrowed), which nobody else may use until
// readahead_close. NULL without memory or thread.
struct readahead *readahead_open(struct framelog *log);
// As framelog_read, which must have read the log to its end before. The payload is borrowed until
// the next call.
int readahead_next(struct readahead *ahead, struct framelog_record *out, char *why,
                   size_t why_bytes);
void readahead_close(struct readahead *ahead); // NULL is accepted
