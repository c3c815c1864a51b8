// FILE.xdmf: lets ParaView (5.11 and others) open FILE.h5, as a series of particle clouds.
#pragma once
#include <stddef.h>
#include <stdint.h>

#include "client/store.h"

// Writes `path` anew, for the arrays of `h5_name` (the file's name as seen from the folder of
// `path`). rows and counts are those of each frame. 0, or -1 with `why`.
int xdmf_write(const char *path, const char *h5_name, const struct store_plan *plan,
               const double *times, const uint64_t *rows, const uint64_t *counts, char *why,
               size_t why_bytes);
