// A file that is part of a program: the Makefile's `embed` writes a list of them as C.
#pragma once
#include <stddef.h>

struct embedded {
    const char *name, *text; // text: `bytes` of them and a 0
    size_t bytes;
};
