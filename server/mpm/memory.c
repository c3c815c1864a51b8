// Memory of the large arrays: the kernels go through a dozen of them at a time, stretch by stretch,
// which takes more pages of 4 kB than a processor's first table of translations has places for.
#include "server/mpm/memory.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __linux__
#include <sys/mman.h>
#endif

#define LINE 64
#define HUGE ((size_t)2 << 20)

void *mpm_memory(size_t bytes) {
    const size_t alignment = bytes >= HUGE ? HUGE : LINE;
    void *memory; // aligned_alloc would take whole multiples of the alignment only
    if (posix_memalign(&memory, alignment, bytes)) {
        return NULL;
    }
#ifdef MADV_HUGEPAGE
    if (bytes >= HUGE) { // whole ones, or memory beyond the array would be taken with it
        (void)madvise(memory, bytes / HUGE * HUGE, MADV_HUGEPAGE); // where refused, small ones do
    }
#endif
    return memset(memory, 0, bytes);
}
