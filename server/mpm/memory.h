// Memory of the large arrays.
#pragma once
#include <stddef.h>

// Zeros, on a cache line's boundary, for free(); NULL when memory is short. What is large lies in
// huge pages where the system has them for who asks.
void *mpm_memory(size_t bytes);
