// The layout of several panels: the axes are named and numbered only at the left and the lower
// edge, colour bars stand below their columns.
#include "client/montage.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "client/view.h"

// Pixels at a width of 1600; all scale with the width.
enum { LEFT = 160, RIGHT = 40, TITLE = 84, SUBTITLE = 40, HEADINGS = 50, BOTTOM = 92, BARS = 128 };
enum { FONT = 22, TICK_DISTANCE = 66 };
enum { COLUMN_GAP = 44, ROW_GAP = 30 };
// 3D: the axes have their numbers around each panel.
enum { COLUMN_GAP_3D = 150, ROW_GAP_3D = 110 };
enum { BAR_DROP = 118, BAR_THICK = 22, ROW_LABEL_LEFT = 132, LEAST_PANEL = 40 };
#define FULL_WIDTH 1600.0
// Without a height given, rows of panels are together at most this high: widths of the figure.
#define MOST_TALL 1.75
#define LEAST_WIDTH 0.5 // of the width asked for: the titles want some
#define MOST_BAR 0.5    // of the picture's width, for one bar that serves all

struct montage_drawing {
    const struct montage *m; // borrowed
    struct gnuplot g;
    struct panel_box
        figure;        // the whole: scale and size; its edges are the outer ones of all panels
    double wide, tall; // of a panel
    double column_gap, row_gap;
    int n_panels; // so far
};

static double titles(const struct montage *m) {
    return TITLE + (*m->subtitle ? SUBTITLE : 0) + (m->n_columns > 1 ? HEADINGS : 0);
}

static void lay_out(struct montage_drawing *d, const struct panel *like) {
    const struct montage *m = d->m;
    struct panel_box *f = &d->figure;
    const double s = m->width / FULL_WIDTH;
    double low[2], high[2];
    panel_extent(like, low, high);
    const double aspect = (high[1] - low[1]) / (high[0] - low[0]);
    d->column_gap = s * (like->dimension == 3 ? COLUMN_GAP_3D : COLUMN_GAP);
    d->row_gap = s * (like->dimension == 3 ? ROW_GAP_3D : ROW_GAP);
    const double above = s * titles(m), below = s * (BOTTOM + BARS);
    const double side = s * (LEFT + RIGHT) + (m->n_columns - 1) * d->column_gap;
    const double ends = above + below + (m->n_rows - 1) * d->row_gap;
    const double most = m->height > 0 ? m->height - ends : MOST_TALL * m->width;
    d->wide = fmax((m->width - side) / m->n_columns, LEAST_PANEL);
    d->tall = d->wide * aspect;
    if (d->tall * m->n_rows > most) {
        d->tall = fmax(most / m->n_rows, LEAST_PANEL * fmin(aspect, 1));
        d->wide = d->tall / aspect;
    }
    f->scale = s;
    f->width = m->width;
    f->height = m->height;
    if (m->height == 0) {
        f->width =
            ceil(fmin(fmax(d->wide * m->n_columns + side, LEAST_WIDTH * m->width), m->width));
        f->height = ceil(d->tall * m->n_rows + ends);
    }
    const double free_x = f->width - side - d->wide * m->n_columns;
    const double free_y = f->height - ends - d->tall * m->n_rows;
    f->left = s * LEFT + free_x / 2;
    f->right = f->width - s * RIGHT - free_x / 2;
    f->bottom = below + free_y / 2;
    f->top = f->height - above - free_y / 2;
}

static struct panel_box box_of(const struct montage_drawing *d, int row, int column) {
    struct panel_box b = d->figure;
    b.left += column * (d->wide + d->column_gap);
    b.right = b.left + d->wide;
    b.top -= row * (d->tall + d->row_gap);
    b.bottom = b.top - d->tall;
    return b;
}

// A label at a place in pixels; `size` 0 is the size of all text.
static void put_label(struct montage_drawing *d, const char *text, double x, double y,
                      const char *place, bool bold, double size) {
    const struct panel_box *f = &d->figure;
    fputs("set label ", d->g.script);
    gnuplot_put_text(d->g.script, text);
    fprintf(d->g.script, " at screen %.6f,%.6f %s noenhanced", x / f->width, y / f->height, place);
    if (bold)
        fprintf(d->g.script, " font 'DejaVu Sans Bold,%.2f' tc rgb '#000000'\n", 0.75 * size);
    else
        fputs(" tc rgb '#555555'\n", d->g.script);
}

// About 0.66 of the font's size a character of bold text: what is long is set smaller.
static double fitting(const char *text, double size, double room) {
    return fmin(size, room / (0.66 * (double)(strlen(text) + 1)));
}

static void put_titles(struct montage_drawing *d) {
    const struct montage *m = d->m;
    const struct panel_box *f = &d->figure;
    const double s = f->scale, top = f->top + s * titles(m);
    put_label(d, m->title, f->left, top - 46 * s, "left", true,
              fitting(m->title, 30 * s, f->width - f->left - RIGHT * s));
    put_label(d, m->subtitle, f->left, top - 88 * s, "left", false, 0);
    for (int k = 0; k < m->n_columns && m->n_columns > 1; k++) {
        const struct panel_box b = box_of(d, 0, k);
        put_label(d, m->headings[k], (b.left + b.right) / 2, f->top + 30 * s, "center", true,
                  fitting(m->headings[k], 25 * s, d->wide + d->column_gap / 2));
    }
    for (int i = 0; i < m->n_rows; i++) {
        const struct panel_box b = box_of(d, i, 0);
        put_label(d, m->row_labels[i], b.left - ROW_LABEL_LEFT * s, (b.bottom + b.top) / 2,
                  "center rotate by 90", true, fitting(m->row_labels[i], 25 * s, d->tall));
    }
}

static void put_bar(struct montage_drawing *d, const struct panel *panel, int row, int column) {
    const struct montage *m = d->m;
    struct panel_box bar = box_of(d, m->n_rows - 1, column);
    if (row + 1 < m->n_rows || (m->one_bar && column + 1 < m->n_columns)) {
        fputs("unset colorbox\n", d->g.script);
        return;
    }
    if (m->one_bar) { // below the middle of all
        const double middle = (d->figure.left + bar.right) / 2;
        const double half = fmax(MOST_BAR * d->figure.width, d->wide) / 2;
        bar.left = fmax(middle - half, d->figure.left);
        bar.right = fmin(middle + half, bar.right);
    }
    bar.bottom -= BAR_DROP * bar.scale;
    bar.top = bar.bottom + BAR_THICK * bar.scale;
    panel_put_bar(panel, &bar, true, "0,0.3", d->g.script);
}

// Fewer ticks than gnuplot's own, which do not know how small a panel is.
static void put_ticks(struct montage_drawing *d, const struct panel *panel) {
    const double distance = TICK_DISTANCE * d->figure.scale;
    fprintf(d->g.script, "set xtics %.9g\nset ytics %.9g\n",
            view_tick_step(panel->high[0] - panel->low[0], (int)fmax(d->wide / distance, 2)),
            view_tick_step(panel->high[1] - panel->low[1], (int)fmax(d->tall / distance, 2)));
}

struct montage_drawing *montage_begin(const struct montage *m, const struct panel *like, char *why,
                                      size_t why_bytes) {
    struct montage_drawing *d = calloc(1, sizeof *d);
    if (!d) {
        snprintf(why, why_bytes, "out of memory");
        return NULL;
    }
    d->m = m;
    lay_out(d, like);
    if (gnuplot_begin(&d->g, m->path, why, why_bytes) != 0) {
        free(d);
        return NULL;
    }
    const double s = d->figure.scale;
    gnuplot_put_terminal(&d->g, d->figure.width, d->figure.height, FONT * 0.75 * s, 1.6 * s);
    fputs("set multiplot\n", d->g.script);
    put_titles(d);
    return d;
}

int montage_add(struct montage_drawing *d, const struct panel *panel, const char *note, char *why,
                size_t why_bytes) {
    const int row = d->n_panels / d->m->n_columns, column = d->n_panels % d->m->n_columns;
    const struct panel_box b = box_of(d, row, column);
    panel_put_margins(&b, d->g.script);
    panel_put_axes(panel, &b, row + 1 == d->m->n_rows, column == 0, d->g.script);
    if (panel->dimension == 2)
        put_ticks(d, panel);
    panel_put_colours(panel, d->g.script);
    put_bar(d, panel, row, column);
    if (note)
        put_label(d, note, b.right - 8 * b.scale, b.top - 16 * b.scale, "right front", false, 0);
    if (panel_put_particles(panel, &d->g) != 0) {
        snprintf(why, why_bytes, "%s: %s", d->g.folder, strerror(errno));
        return -1;
    }
    fputs("unset label\nunset arrow\n", d->g.script); // each panel writes its own
    d->n_panels++;
    return 0;
}

int montage_finish(struct montage_drawing *d, char *why, size_t why_bytes) {
    fputs("unset multiplot\n", d->g.script);
    const int status = gnuplot_finish(&d->g, why, why_bytes);
    free(d);
    return status;
}

void montage_abandon(struct montage_drawing *d) {
    gnuplot_abandon(&d->g);
    free(d);
}
