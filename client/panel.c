// Margins are set in pixels, so that a metre is as long in x as in y whatever the figure's shape;
// particles are circles of their true size. 3D is projected here (view.c) and drawn back to front,
// each particle with a rim.
#include "client/panel.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "client/view.h"

// viridis (van der Walt and Smith, 2015, CC0) and a blue-red map with a grey middle (Moreland,
// 2009): both even in lightness, so that equal steps of the value look equal.
static const unsigned viridis[] = {0x440154, 0x482878, 0x3e4989, 0x31688e, 0x26828e,
                                   0x1f9e89, 0x35b779, 0x6ece58, 0xb5de2b, 0xfde725};
static const unsigned blue_red[] = {0x3b4cc0, 0x5977e3, 0x7b9ff9, 0x9ebeff, 0xc0d4f5, 0xdddcdc,
                                    0xf2cbb7, 0xf7ac8e, 0xee8468, 0xd65244, 0xb40426};

// Half the diagonal of a square lattice: neighbours just close the gaps between them.
#define RADIUS_PER_SPACING 0.71
// Larger discs below all others: they close the gaps where particles moved apart to twice their
// distance, and let the surface and the spray look a little thicker.
// distance.
#define FILL_PER_SPACING 1.1
// 3D: the rim is a darker disc below each particle.
#define RIM_DARKER 0.72
#define RIM_INSIDE 0.84

static struct view view_of(const struct panel *p) {
    struct view v;
    memcpy(v.low, p->low, sizeof v.low);
    memcpy(v.high, p->high, sizeof v.high);
    memcpy(v.axis_names, p->axis_names, sizeof v.axis_names);
    return v;
}

void panel_extent(const struct panel *p, double low[2], double high[2]) {
    if (p->dimension == 3) {
        const struct view v = view_of(p);
        view_extent(&v, low, high);
        return;
    }
    memcpy(low, p->low, 2 * sizeof *low);
    memcpy(high, p->high, 2 * sizeof *high);
}

void panel_put_margins(const struct panel_box *b, FILE *out) {
    fprintf(out,
            "set lmargin at screen %.6f\nset rmargin at screen %.6f\n"
            "set bmargin at screen %.6f\nset tmargin at screen %.6f\n",
            b->left / b->width, b->right / b->width, b->bottom / b->height, b->top / b->height);
}

static void put_axis(char axis, const char *name, FILE *out) {
    if (name)
        fprintf(out, "set format %c\nset %clabel '%s (m)' noenhanced\n", axis, axis, name);
    else
        fprintf(out, "set format %c ''\nunset %clabel\n", axis, axis);
}

void panel_put_axes(const struct panel *p, const struct panel_box *b, bool at_x, bool at_y,
                    FILE *out) {
    double low[2], high[2];
    panel_extent(p, low, high);
    fprintf(out, "set xrange [%.9g:%.9g]\nset yrange [%.9g:%.9g]\n", low[0], high[0], low[1],
            high[1]);
    if (p->dimension == 3) {
        const struct view v = view_of(p);
        fputs("unset border\nunset xtics\nunset ytics\n", out);
        view_write_axes(&v, (b->right - b->left) / (high[0] - low[0]), b->scale, out);
        return;
    }
    fputs("set border 3 lw 0.8 lc rgb '#444444'\nset tics nomirror out scale 0.6\n", out);
    put_axis('x', at_x ? p->axis_names[0] : NULL, out);
    put_axis('y', at_y ? p->axis_names[1] : NULL, out);
}

void panel_put_colours(const struct panel *p, FILE *out) {
    const unsigned *map = p->diverging ? blue_red : viridis;
    const size_t n =
        p->diverging ? sizeof blue_red / sizeof *blue_red : sizeof viridis / sizeof *viridis;
    fputs("set palette maxcolors 0 defined (", out);
    for (size_t i = 0; i < n; i++)
        fprintf(out, "%s%zu '#%06x'", i ? ", " : "", i, map[i]);
    fprintf(out, ")\nset cbrange [%.9g:%.9g]\nset format cb '%%g'\n", p->range[0], p->range[1]);
}

void panel_put_bar(const struct panel *p, const struct panel_box *bar, bool horizontal,
                   const char *offset, FILE *out) {
    fprintf(out, "set colorbox %s user origin screen %.6f,%.6f size screen %.6f,%.6f noborder\n",
            horizontal ? "horizontal" : "vertical", bar->left / bar->width,
            bar->bottom / bar->height, (bar->right - bar->left) / bar->width,
            (bar->top - bar->bottom) / bar->height);
    fputs("set cblabel ", out);
    gnuplot_put_text(out, p->label);
    fprintf(out,
            " noenhanced offset %s tc rgb '#000000'\nset cbtics nomirror out scale 0.5 tc rgb "
            "'#444444'\n",
            offset);
}

static unsigned colour_of(const struct panel *p, double value, double lightness) {
    const unsigned *map = p->diverging ? blue_red : viridis;
    const int n =
        (int)(p->diverging ? sizeof blue_red / sizeof *blue_red : sizeof viridis / sizeof *viridis);
    const double at =
        fmin(fmax((value - p->range[0]) / (p->range[1] - p->range[0]), 0), 1) * (n - 1);
    const int i = isfinite(at) ? (int)fmin(at, n - 2) : 0;
    unsigned colour = 0;
    for (int shift = 0; shift <= 16; shift += 8) {
        const double a = map[i] >> shift & 0xff, b = map[i + 1] >> shift & 0xff;
        colour |= (unsigned)lround(lightness * (a + (b - a) * (at - i))) << shift;
    }
    return colour;
}

// What is drawn later covers what was drawn before.
struct disc {
    double x, y, value, order;
};

static int earlier(const void *a, const void *b) {
    const double d = ((const struct disc *)a)->order - ((const struct disc *)b)->order;
    return (d > 0) - (d < 0);
}

static int write_disc(const struct disc *d, double radius, double colour, FILE *out) {
    const double record[4] = {d->x, d->y, radius, colour};
    return fwrite(record, sizeof record, 1, out) == 1 ? 0 : -1;
}

static int write_particles(const struct panel *p, FILE *out) {
    struct disc *discs = malloc((p->count + 1) * sizeof *discs);
    const double radius = RADIUS_PER_SPACING * p->spacing;
    int status = discs ? 0 : -1;
    size_t n = 0;
    for (size_t i = 0; status == 0 && i < p->count; i++) {
        const double *x = p->position + 3 * i;
        double at[2] = {x[0], x[1]}, depth = 0;
        bool inside = true;
        for (int d = 0; d < p->dimension; d++)
            inside = inside && x[d] >= p->low[d] && x[d] <= p->high[d];
        if (!inside)
            continue;
        if (p->dimension == 3)
            view_project(x, at, &depth);
        discs[n++] = (struct disc){.x = at[0], .y = at[1], .value = p->value[i], .order = -depth};
    }
    if (status == 0 && p->dimension == 3)
        qsort(discs, n, sizeof *discs, earlier);
    for (size_t i = 0; status == 0 && p->filled && p->dimension == 2 && i < n; i++)
        status = write_disc(&discs[i], FILL_PER_SPACING * p->spacing, discs[i].value, out);
    for (size_t i = 0; status == 0 && i < n; i++) {
        const struct disc *d = &discs[i];
        if (p->dimension == 2)
            status = write_disc(d, radius, d->value, out);
        else if (write_disc(d, radius, colour_of(p, d->value, RIM_DARKER), out) != 0 ||
                 write_disc(d, RIM_INSIDE * radius, colour_of(p, d->value, 1), out) != 0)
            status = -1;
    }
    free(discs);
    return status;
}

int panel_put_particles(const struct panel *p, struct gnuplot *g) {
    char path[600];
    FILE *out = gnuplot_data(g, path, sizeof path);
    if (!out)
        return -1;
    const int status = write_particles(p, out);
    if (fclose(out) != 0 || status != 0)
        return -1;
    // The second plot of 3D draws nothing and only asks for the colour bar.
    fputs("plot ", g->script);
    gnuplot_put_text(g->script, path);
    fprintf(g->script,
            " binary format='%%4double' using 1:2:3:4 with circles fill solid noborder "
            "linecolor %s\n",
            p->dimension == 3 ? "rgb variable, NaN with points palette" : "palette");
    return 0;
}
