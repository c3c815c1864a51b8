// What the writing and the reading of FILE.h5 share.
#pragma once
#include "client/store.h"

// To be called before anything of HDF5 is.
void store_begin(void);
// Fills `why` from HDF5's error stack, whose innermost entry knows the system's reason. -1.
int store_fail(const char *path, char *why, size_t why_bytes);
