// One panel with a title and a colour bar as a PNG, drawn by gnuplot.
#pragma once
#include <stddef.h>

#include "client/panel.h"

struct picture {
    const char *path;             // the PNG
    const char *title, *subtitle; // title bold, subtitle below it
    struct panel panel;
    int width, height; // pixels; height 0: as the shape asks for
};

// 0, or -1 with a sentence in `why`.
int picture_draw(const struct picture *picture, char *why, size_t why_bytes);
