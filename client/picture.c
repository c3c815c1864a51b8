// The layout of a picture of one panel. A column is not drawn as a tower, and what is flat gets its
// colour bar below.
#include "client/picture.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

// Pixels at the default width of 1600; all scale with the width.
enum {
    LEFT = 120,
    RIGHT = 60,
    TOP = 120,
    BOTTOM = 110,
    BAR_RIGHT = 190,
    BAR_BOTTOM = 130,
    FONT = 22
};
enum { BAR_GAP = 34, BAR_GAP_3D = 84, BAR_DROP = 164, BAR_THICK = 26 };
#define DEFAULT_WIDTH 1600.0
// Wider pictures than this get their colour bar below.
#define FLAT_ASPECT 0.28

struct layout {
    struct panel_box box, bar;
    bool bar_below;
};

static struct layout lay_out(const struct picture *p) {
    struct layout l = {.box = {.width = p->width, .scale = p->width / DEFAULT_WIDTH}};
    struct panel_box *b = &l.box;
    const bool solid = p->panel.dimension == 3;
    double low[2], high[2];
    panel_extent(&p->panel, low, high);
    const double aspect = (high[1] - low[1]) / (high[0] - low[0]);
    l.bar_below = aspect < FLAT_ASPECT;
    const double side =
        b->scale *
        (LEFT + RIGHT + (l.bar_below ? 0 : BAR_RIGHT + (solid ? BAR_GAP_3D - BAR_GAP : 0)));
    const double ends = b->scale * (TOP + BOTTOM + (l.bar_below ? BAR_BOTTOM : 0));
    double wide = b->width - side, tall = wide * aspect;
    const double most = p->height > 0 ? fmax(p->height - ends, 50) : 0.8 * b->width;
    if (tall > most) {
        tall = most;
        wide = tall / aspect;
    }
    b->height = p->height > 0 ? p->height : ceil(tall + ends);
    b->left = b->scale * LEFT + (b->width - side - wide) / 2;
    b->right = b->left + wide;
    b->bottom =
        b->scale * (BOTTOM + (l.bar_below ? BAR_BOTTOM : 0)) + (b->height - ends - tall) / 2;
    b->top = b->bottom + tall;
    l.bar = *b;
    if (l.bar_below) {
        l.bar.bottom = b->bottom - BAR_DROP * b->scale;
        l.bar.top = l.bar.bottom + BAR_THICK * b->scale;
    } else {
        l.bar.left = b->right + (solid ? BAR_GAP_3D : BAR_GAP) * b->scale;
        l.bar.right = l.bar.left + BAR_THICK * b->scale;
    }
    return l;
}

static void put_titles(const struct picture *p, const struct panel_box *b, FILE *out) {
    const double s = b->scale;
    // About 0.62 of the font's size a character: a long title is set smaller.
    const double fits = (b->width - b->left) / (0.62 * (double)(strlen(p->title) + 1));
    fputs("set label 1 ", out);
    gnuplot_put_text(out, p->title);
    fprintf(out, " at screen %.6f,%.6f left noenhanced font 'DejaVu Sans Bold,%.2f'\n",
            b->left / b->width, (b->top + 78 * s) / b->height, 0.75 * fmin(30 * s, fits));
    fputs("set label 2 ", out);
    gnuplot_put_text(out, p->subtitle);
    fprintf(out, " at screen %.6f,%.6f left noenhanced tc rgb '#555555'\n", b->left / b->width,
            (b->top + 36 * s) / b->height);
}

int picture_draw(const struct picture *p, char *why, size_t why_bytes) {
    const struct layout l = lay_out(p);
    const struct panel_box *b = &l.box;
    struct gnuplot g;
    if (gnuplot_begin(&g, p->path, why, why_bytes) != 0)
        return -1;
    gnuplot_put_terminal(&g, b->width, b->height, FONT * 0.75 * b->scale, 1.6 * b->scale);
    panel_put_margins(b, g.script);
    put_titles(p, b, g.script);
    panel_put_axes(&p->panel, b, true, true, g.script);
    panel_put_colours(&p->panel, g.script);
    panel_put_bar(&p->panel, &l.bar, l.bar_below, l.bar_below ? "0,0.2" : "2,0", g.script);
    if (panel_put_particles(&p->panel, &g) != 0) {
        snprintf(why, why_bytes, "%s: %s", g.folder, strerror(errno));
        gnuplot_abandon(&g);
        return -1;
    }
    return gnuplot_finish(&g, why, why_bytes);
}
