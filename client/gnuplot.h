// One run of gnuplot: a script and data files in a temporary folder become a PNG, or nothing.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>

struct gnuplot {
    FILE *script;     // to be written by the caller
    bool missing;     // after gnuplot_finish: it could not be started
    const char *path; // borrowed, the PNG
    char *png;        // where it is drawn first
    char folder[512];
    int n_data;
};

// 0, or -1 with a sentence in `why` and nothing to finish. The PNG must be writable.
int gnuplot_begin(struct gnuplot *g, const char *path, char *why, size_t why_bytes);
// Makes one more data file, whose path goes to `path`; the caller closes it. NULL: see errno.
FILE *gnuplot_data(struct gnuplot *g, char *path, size_t path_bytes);
// Writes the first lines of the script: the terminal and the output, `width` x `height` pixels.
void gnuplot_put_terminal(const struct gnuplot *g, double width, double height, double font,
                          double line);
// Draws, puts the PNG into its place and removes the rest. -1 with a sentence in `why`.
int gnuplot_finish(struct gnuplot *g, char *why, size_t why_bytes);
void gnuplot_abandon(struct gnuplot *g); // removes everything

void gnuplot_put_text(FILE *script, const char *text); // as a quoted string
