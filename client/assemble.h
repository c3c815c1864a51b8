// From the recorder's log to FILE.h5 and FILE.xdmf.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct framelog;

struct assemble_result {
    size_t n_frames;
    uint64_t bytes; // of FILE.h5
    bool complete;  // the log held the whole run
    char run[72], state[24];
};

// Builds `file` anew from all records of `log` that were read and found good, or appended, and
// renames it into place, FILE.xdmf after it. compress 0..9. 0, or -1 with `why`; then what was at
// `file` before is still there.
int assemble(struct framelog *log, const char *file, int compress, struct assemble_result *out,
             char *why, size_t why_bytes);

// The name of the log that belongs to a recording, and of its XDMF; the caller frees them.
char *assemble_log_name(const char *file);
char *assemble_xdmf_name(const char *file);
