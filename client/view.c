// The axes of 3D pictures: gnuplot's own would not let one know how long a metre is in pixels,
// which the size of the particles needs.
#include "client/view.h"

#include <math.h>
#include <stdbool.h>

#define TURN (28 * M_PI / 180)      // about the vertical: x to the right, y to the back
#define ELEVATION (24 * M_PI / 180) // of the eye above the horizon
#define MOST_TICKS 6

void view_project(const double x[3], double out[2], double *depth) {
    const double back = x[1] * cos(TURN) - x[0] * sin(TURN);
    out[0] = x[0] * cos(TURN) + x[1] * sin(TURN);
    out[1] = x[2] * cos(ELEVATION) + back * sin(ELEVATION);
    if (depth)
        *depth = back * cos(ELEVATION) - x[2] * sin(ELEVATION);
}

void view_extent(const struct view *view, double low[2], double high[2]) {
    for (int d = 0; d < 2; d++) {
        low[d] = INFINITY;
        high[d] = -INFINITY;
    }
    for (int corner = 0; corner < 8; corner++) {
        double x[3], at[2];
        for (int d = 0; d < 3; d++)
            x[d] = corner >> d & 1 ? view->high[d] : view->low[d];
        view_project(x, at, NULL);
        for (int d = 0; d < 2; d++) {
            low[d] = fmin(low[d], at[d]);
            high[d] = fmax(high[d], at[d]);
        }
    }
}

double view_tick_step(double length, int most) {
    const double least = length / most, power = pow(10, floor(log10(least)));
    const double factors[] = {1, 2, 5, 10};
    for (int i = 0; i < 4; i++)
        if (factors[i] * power >= least)
            return factors[i] * power;
    return 10 * power;
}

static void line(FILE *out, const double a[3], const double b[3], const char *style) {
    double from[2], to[2];
    view_project(a, from, NULL);
    view_project(b, to, NULL);
    fprintf(out, "set arrow from %.9g,%.9g to %.9g,%.9g nohead back %s\n", from[0], from[1], to[0],
            to[1], style);
}

// One edge of the box as an axis: along `axis` from `corner`, ticks pointing to the outside.
struct edge {
    int axis, outside; // direction of the ticks
    double corner[3];
    double sign; // of that direction
    bool right;  // labels stand to the right of the ticks, else to the left
};

static void write_edge(const struct view *v, const struct edge *e, double metre, double scale,
                       FILE *out) {
    double end[3] = {e->corner[0], e->corner[1], e->corner[2]};
    const double length = v->high[e->axis] - v->low[e->axis];
    end[e->axis] = v->high[e->axis];
    line(out, e->corner, end, "lw 0.8 lc rgb '#444444'");
    // As many ticks as their numbers have room for on the projected edge.
    double a[2], b[2];
    view_project(e->corner, a, NULL);
    view_project(end, b, NULL);
    const double pixels = hypot(b[0] - a[0], b[1] - a[1]) * metre / scale;
    const int most = (int)fmin(fmax(pixels / 75, 1), MOST_TICKS);
    const double step = view_tick_step(length, most), tick = 9 * scale / metre;
    for (double k = ceil(v->low[e->axis] / step - 1e-9); k * step <= v->high[e->axis] + 1e-9 * step;
         k++) {
        double from[3] = {e->corner[0], e->corner[1], e->corner[2]}, to[3], at[2];
        from[e->axis] = k * step;
        for (int d = 0; d < 3; d++)
            to[d] = from[d] + (d == e->outside ? e->sign * tick : 0);
        line(out, from, to, "lw 0.8 lc rgb '#444444'");
        view_project(to, at, NULL);
        fprintf(out,
                "set label '%.6g' at %.9g,%.9g %s offset character %s front tc rgb '#444444'\n",
                k * step + 0.0, at[0], at[1], e->right ? "left" : "right",
                e->right       ? "0.3,-0.4"
                : e->axis == 2 ? "-0.3,0"
                               : "0.1,-0.6");
    }
    // The name stands beside the middle of the edge, clear of the numbers.
    const double push = 62 * scale / metre, drop = 46 * scale / metre;
    const double middle[2] = {(a[0] + b[0]) / 2, (a[1] + b[1]) / 2};
    const double shift_x = e->axis == 2 ? -1.25 * push : e->right ? 0.9 * push : -0.75 * push;
    fprintf(out, "set label '%s (m)' at %.9g,%.9g %s front noenhanced%s\n", v->axis_names[e->axis],
            middle[0] + shift_x, middle[1] - (e->axis == 2 ? 0 : drop),
            e->axis == 2 ? "center"
            : e->right   ? "left"
                         : "right",
            e->axis == 2 ? " rotate" : "");
}

void view_write_axes(const struct view *v, double metre, double scale, FILE *out) {
    static const char faint[] = "lw 0.6 lc rgb '#cfcfcf'";
    const double *l = v->low, *h = v->high;
    const double corners[][2][3] = {
        {{l[0], h[1], l[2]}, {h[0], h[1], l[2]}}, {{l[0], l[1], l[2]}, {l[0], h[1], l[2]}},
        {{l[0], h[1], l[2]}, {l[0], h[1], h[2]}}, {{h[0], h[1], l[2]}, {h[0], h[1], h[2]}},
        {{l[0], l[1], h[2]}, {l[0], h[1], h[2]}}, {{l[0], h[1], h[2]}, {h[0], h[1], h[2]}},
    };
    for (size_t i = 0; i < sizeof corners / sizeof *corners; i++)
        line(out, corners[i][0], corners[i][1], faint);
    const struct edge edges[] = {
        {.axis = 0, .outside = 1, .sign = -1, .corner = {l[0], l[1], l[2]}},
        {.axis = 1, .outside = 0, .sign = 1, .corner = {h[0], l[1], l[2]}, .right = true},
        {.axis = 2, .outside = 0, .sign = -1, .corner = {l[0], l[1], l[2]}},
    };
    for (size_t i = 0; i < sizeof edges / sizeof *edges; i++)
        write_edge(v, &edges[i], metre, scale, out);
}
