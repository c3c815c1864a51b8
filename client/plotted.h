// A recording as pictures show it: one quantity of it, frame by frame, with its range and unit.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "client/panel.h"
#include "client/store.h"

struct plotted {
    const char *path;      // borrowed
    struct store_file *h5; // owned
    const struct store_contents *contents;
    const struct store_array *array;
    size_t component; // array->components: the magnitude
    int up;           // 3D: the axis against gravity
    double scale;     // of the values, to the unit with its prefix
    char title[96];   // of the scene, or ""
    char name[64];    // of the quantity: "x velocity", "mean normal stress"
    char unit[40], label[128], why[512];
    double *position, *raw, *value; // of one frame, sized for the largest
    struct panel panel;             // what all frames share; low and high are the caller's
    // What is subtracted, particle by particle (borrowed, or NULL), and its frame; PLOTTED_NEAREST:
    // the one nearest in time to the frame that is shown.
    struct plotted *minus;
    size_t minus_frame;
    uint32_t *minus_row; // of each id, in the frame of `minus`; sized for it
    size_t minus_ids;
};
#define PLOTTED_NEAREST SIZE_MAX

// Opens a recording and chooses a field and a component (NULL: the magnitude, or the scalar).
// An exit code, with the fault printed; plotted_close in any case.
int plotted_open(struct plotted *p, const char *path, const char *field, const char *component);
void plotted_close(struct plotted *p);

// From now on `p` shows its quantity less that of `minus`, which was opened with the same field and
// component and must outlive it. An exit code, with the fault printed.
int plotted_subtract(struct plotted *p, struct plotted *minus, size_t frame);
// The frame of `minus` that belongs to a frame of `p`.
size_t plotted_minus_frame(const struct plotted *p, size_t frame);

size_t plotted_nearest_frame(const struct plotted *p, double time);
// Reads a frame's particles: (count, 3) into position, the last axis up, and (count) into value, in
// the field's unit. 0, or -1 with p->why, as all below.
int plotted_load(struct plotted *p, size_t frame);
// The panel of a frame, which borrows position and value, now in the unit with its prefix.
int plotted_panel(struct plotted *p, size_t frame, struct panel *out);
// Widens the box to hold the particles of the frames, and those of the first frame: where the
// material was helps to see where it went.
int plotted_widen_axes(struct plotted *p, const size_t *frames, size_t n, double low[3],
                       double high[3]);
// The range without the outermost hundredths, over the frames, in the field's unit.
int plotted_fit_range(struct plotted *p, const size_t *frames, size_t n, double range[2]);
// Chooses colours and the unit's prefix. A range that was not `given` may be widened.
void plotted_apply_range(struct plotted *p, const double range[2], bool given);
