// A box in three dimensions seen from the front, above and the right, without perspective.
#pragma once
#include <stddef.h>
#include <stdio.h>

struct view {
    double low[3], high[3]; // m, the box; axis 2 points up
    const char *axis_names[3];
};

// Where a point lies in the picture (m, to the right and up) and how far away (larger is farther).
void view_project(const double x[3], double out[2], double *depth);
// The part of the picture that the box covers.
void view_extent(const struct view *view, double low[2], double high[2]);
// Writes gnuplot's arrows and labels: the box behind the particles, three axes with ticks. `metre`
// is the length of one metre in pixels, `scale` that of text and lines.
void view_write_axes(const struct view *view, double metre, double scale, FILE *out);
// 1, 2 or 5 times a power of ten: the distance of at most `most` ticks on an axis of that length.
double view_tick_step(double length, int most);
