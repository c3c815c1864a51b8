// A grid of panels as one PNG, drawn by gnuplot: a row for each time, a column for each recording.
#pragma once
#include <stdbool.h>
#include <stddef.h>

#include "client/panel.h"

#define MONTAGE_MOST_COLUMNS 8
#define MONTAGE_MOST_ROWS 16

struct montage {
    const char *path;             // the PNG
    const char *title, *subtitle; // title bold, subtitle below it
    int n_columns, n_rows;
    const char *headings[MONTAGE_MOST_COLUMNS]; // above the columns, when there are several
    const char *row_labels[MONTAGE_MOST_ROWS];
    bool one_bar;      // one colour bar for all columns, else one below each
    int width, height; // pixels; height 0: as the shape asks for, and the width at most
};

struct montage_drawing; // panels on their way into the picture

// Axes and dimension of all panels are those of `like`. `montage` is borrowed until the end.
// NULL with a sentence in `why`.
struct montage_drawing *montage_begin(const struct montage *montage, const struct panel *like,
                                      char *why, size_t why_bytes);
// The next panel, row by row; `note` (or NULL) stands in its corner. 0, or -1 with `why`.
int montage_add(struct montage_drawing *drawing, const struct panel *panel, const char *note,
                char *why, size_t why_bytes);
int montage_finish(struct montage_drawing *drawing, char *why, size_t why_bytes); // frees, too
void montage_abandon(struct montage_drawing *drawing);
