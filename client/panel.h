// Particles coloured by a scalar, with axes and a colour bar, as gnuplot text: what pictures of one
// panel (picture.h) and of several (montage.h) share.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>

#include "client/gnuplot.h"

struct panel {
    const char *label;         // of the colour bar, with unit
    const char *axis_names[3]; // the last one points up in 3D
    int dimension;
    size_t count;
    const double *position; // (count, 3), m
    const double *value;    // (count), in the label's unit
    double low[3], high[3]; // m, what the axes show
    double range[2];        // of the colours
    bool diverging;         // a map with a neutral middle
    double spacing;         // m, between neighbouring particles
    bool filled;            // 2D: gaps between particles that moved apart are coloured
};

// Where it stands: pixels from the figure's left and lower edges.
struct panel_box {
    double left, right, top, bottom;
    double width, height; // of the figure
    double scale;         // of fonts and lines
};

// The part of the plane that the panel shows: in 3D its projection.
void panel_extent(const struct panel *panel, double low[2], double high[2]);

void panel_put_margins(const struct panel_box *box, FILE *script);
// In 2D numbers and name stand only at the axes that are asked for; in 3D at all of them.
void panel_put_axes(const struct panel *panel, const struct panel_box *box, bool at_x, bool at_y,
                    FILE *script);
// Colours, and where the bar stands: `bar` has the figure's size too. `offset`: of the label.
void panel_put_colours(const struct panel *panel, FILE *script);
void panel_put_bar(const struct panel *panel, const struct panel_box *bar, bool horizontal,
                   const char *offset, FILE *script);
// The plot command, with the particles in a data file. -1: see errno.
int panel_put_particles(const struct panel *panel, struct gnuplot *g);
