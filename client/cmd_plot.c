// fbar plot: pictures of recordings. Particles coloured by a field, or by the difference of two; the
// curves of probes (curves.c).
#include <cjson/cJSON.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/curves.h"
#include "client/interrupt.h"
#include "client/montage.h"
#include "client/picture.h"
#include "client/plotted.h"
#include "client/report.h"
#include "client/terminal.h"

// Frames that are looked at for the axes and for the range of a series.
#define SAMPLE_FRAMES 24
#define DEFAULT_WIDTH 1600

static const struct option_spec options[] = {
    {"output", 'o', "FILE.png", "the picture"},
    {"field", 'f', "NAME", "what colours the particles (default mean_stress)"},
    {"component", 'c', "NAME",
     "x, y, z or xx, xy, ... or magnitude (default) of a vector or tensor"},
    {"time", 't', "TIME", "the nearest frame, s (default: the last); T1,T2,... are a row each"},
    {"difference", 'd', NULL, "the second recording less the first, or the second of two times"},
    {"probe", 'p', "PROBE,...", "curves of these probes instead of particles, or of `all`"},
    {"series", 0, "DIR", "a picture of every frame into DIR, with one range, for a film"},
    {"range", 'r', "LOW:HIGH", "of the colours, in the field's unit (default: 1 % to 99 %)"},
    {"axes", 0, "X0:X1,Y0:Y1", "part that is shown, m (3D: and Z0:Z1; curves: s and value)"},
    {"size", 0, "WxH", "pixels (default: 1600 wide, as high as the shape asks for)"},
    {NULL, 0, NULL, NULL},
};

struct plot {
    int n_columns, n_rows; // recordings and times
    struct plotted columns[MONTAGE_MOST_COLUMNS];
    struct plotted minus; // of a difference; its path is NULL where there is none
    double times[MONTAGE_MOST_ROWS];
    size_t n_frames, frames[MONTAGE_MOST_COLUMNS][SAMPLE_FRAMES]; // what each column looks at
    double low[3], high[3];                                       // of all axes
    int width, height;
    bool range_given;
    double range[2];
};
_Static_assert(MONTAGE_MOST_ROWS <= SAMPLE_FRAMES, "a grid looks at all of its frames");

// ---- What the options say ---------------------------------------------------------------------

static int parse_range(const char *text, double range[2]) {
    char *end;
    range[0] = strtod(text, &end);
    if (end != text && *end == ':') {
        const char *second = end + 1;
        range[1] = strtod(second, &end);
        if (end != second && !*end && isfinite(range[0]) && isfinite(range[1]) &&
            range[0] < range[1])
            return 0;
    }
    terminal_error("--range: must be LOW:HIGH with LOW below HIGH, got \"%s\"", text);
    return -1;
}

static int parse_axes(const char *text, int dimension, double low[3], double high[3]) {
    const char *at = text;
    for (int d = 0; d < dimension; d++) {
        char *end;
        low[d] = strtod(at, &end);
        if (end == at || *end != ':')
            break;
        at = end + 1;
        high[d] = strtod(at, &end);
        if (end == at || *end != (d + 1 < dimension ? ',' : '\0') || !(low[d] < high[d]))
            break;
        at = end + 1;
        if (d + 1 == dimension)
            return 0;
    }
    terminal_error("--axes: must be X0:X1,Y0:Y1%s, got \"%s\"", dimension == 3 ? ",Z0:Z1" : "",
                   text);
    return -1;
}

static int parse_times(const char *text, struct plot *p) {
    const char *at = text;
    p->n_rows = 0;
    while (p->n_rows < MONTAGE_MOST_ROWS) {
        char *end;
        const double time = strtod(at, &end);
        if (end == at || !isfinite(time) || (*end && *end != ','))
            break;
        p->times[p->n_rows++] = time;
        if (!*end)
            return 0;
        at = end + 1;
    }
    terminal_error("--time: must be a number or 2 to %d joined by commas, got \"%s\"",
                   MONTAGE_MOST_ROWS, text);
    return -1;
}

static int parse_size(const char *text, struct plot *p) {
    char rest;
    if (sscanf(text, "%dx%d%c", &p->width, &p->height, &rest) == 2 && p->width >= 200 &&
        p->height >= 200 && p->width <= 20000 && p->height <= 20000)
        return 0;
    terminal_error("--size: must be WxH with 200 to 20000 pixels each, got \"%s\"", text);
    return -1;
}

static int parse(struct plot *p, const struct arguments *arguments) {
    const char *size = arguments_value(arguments, "size");
    const char *time = arguments_value(arguments, "time");
    const char *range = arguments_value(arguments, "range");
    const bool series = arguments_flag(arguments, "series");
    if (!arguments_flag(arguments, "output") == !series) {
        terminal_error(
            "usage: fbar plot FILE.h5... [--field NAME], and either -o FILE.png or --series DIR");
        return -1;
    }
    p->n_columns = arguments->n_positionals;
    if (p->n_columns > MONTAGE_MOST_COLUMNS) {
        terminal_error("a picture has room for %d recordings, got %d", MONTAGE_MOST_COLUMNS,
                       p->n_columns);
        return -1;
    }
    if ((size && parse_size(size, p) != 0) || (time && parse_times(time, p) != 0) ||
        (range && parse_range(range, p->range) != 0))
        return -1;
    p->range_given = range != NULL;
    if (series && time) {
        terminal_error("--series: draws every frame, so --time has no place");
        return -1;
    }
    if (arguments_flag(arguments, "difference") &&
        !(p->n_columns == 2 && p->n_rows <= 1) && !(p->n_columns == 1 && p->n_rows == 2)) {
        terminal_error("--difference: must have two recordings (and one time, or none), or one "
                       "recording and --time T1,T2; got %d recording%s and %d time%s",
                       p->n_columns, p->n_columns == 1 ? "" : "s", p->n_rows,
                       p->n_rows == 1 ? "" : "s");
        return -1;
    }
    return 0;
}

// ---- Frames, axes and ranges ------------------------------------------------------------------

static void choose_frames(struct plot *p, bool series) {
    for (int k = 0; k < p->n_columns; k++) {
        const size_t n = p->columns[k].contents->n_frames;
        p->n_frames = !series ? (size_t)p->n_rows : n < SAMPLE_FRAMES ? n : SAMPLE_FRAMES;
        for (size_t i = 0; i < p->n_frames; i++)
            p->frames[k][i] = !series           ? plotted_nearest_frame(&p->columns[k], p->times[i])
                              : p->n_frames > 1 ? i * (n - 1) / (p->n_frames - 1)
                                                : 0;
    }
}

// Times that were asked for beyond a recording, by more than half its mean interval of frames.
static void warn_of_times(const struct plot *p) {
    for (int k = 0; k < p->n_columns; k++)
        for (int i = 0; i < p->n_rows; i++) {
            const struct store_contents *c = p->columns[k].contents;
            if (c->n_frames == 0)
                continue;
            const double asked = p->times[i], last = c->time[c->n_frames - 1];
            const double half =
                c->n_frames > 1 ? 0.5 * (last - c->time[0]) / (c->n_frames - 1.0) : 0;
            if (isfinite(asked) && (asked > last + half || asked < c->time[0] - half))
                terminal_note(
                    "warning: %s has no frame near t = %g s; drawing the nearest, t = %.4g s",
                    p->columns[k].path, asked, c->time[p->frames[k][i]]);
        }
}

static int fit_axes(struct plot *p) {
    double longest = 0;
    for (int d = 0; d < 3; d++) {
        p->low[d] = INFINITY;
        p->high[d] = -INFINITY;
    }
    for (int k = 0; k < p->n_columns; k++) {
        if (plotted_widen_axes(&p->columns[k], p->frames[k], p->n_frames, p->low, p->high) != 0)
            return k;
        longest = fmax(longest, p->columns[k].panel.spacing);
    }
    for (int d = 0; d < p->columns[0].contents->dimension; d++)
        longest = fmax(longest, p->high[d] - p->low[d]);
    for (int d = 0; d < p->columns[0].contents->dimension; d++) {
        p->low[d] -= 0.02 * longest;
        p->high[d] += 0.02 * longest;
    }
    return -1;
}

// The column that could not be read, or -1.
static int fit(struct plot *p) {
    const int unread = fit_axes(p);
    if (unread >= 0)
        return unread;
    for (int k = 0; k < p->n_columns; k++) {
        double range[2] = {p->range[0], p->range[1]};
        if (!p->range_given &&
            plotted_fit_range(&p->columns[k], p->frames[k], p->n_frames, range) != 0)
            return k;
        plotted_apply_range(&p->columns[k], range, p->range_given);
    }
    return -1;
}

static void copy_axes(struct plot *p) {
    for (int k = 0; k < p->n_columns; k++) {
        struct panel *panel = &p->columns[k].panel;
        memcpy(panel->low, p->low, sizeof panel->low);
        memcpy(panel->high, p->high, sizeof panel->high);
    }
}

// ---- Pictures ---------------------------------------------------------------------------------

// What frame of what run a picture shows, and what was subtracted.
static void put_when(const struct plotted *p, size_t frame, char *out, size_t n) {
    const struct store_contents *c = p->contents;
    const char *fbar = c->fbar[frame] ? "F-bar on" : "F-bar off";
    if (!p->minus) {
        snprintf(out, n, "t = %.4g s  ·  %s  ·  %s", c->time[frame], fbar, c->run);
        return;
    }
    const size_t other = plotted_minus_frame(p, frame);
    const struct store_contents *m = p->minus->contents;
    if (strcmp(p->path, p->minus->path) == 0)
        snprintf(out, n, "t = %.4g s less t = %.4g s  ·  %s  ·  %s", c->time[frame], m->time[other],
                 fbar, c->run);
    else
        snprintf(out, n, "t = %.4g s  ·  %s (%s) less %s (%s)", c->time[frame], c->run, fbar, m->run,
                 m->fbar[other] ? "F-bar on" : "F-bar off");
}

static int draw(struct plot *p, size_t frame, const char *path) {
    struct plotted *column = &p->columns[0];
    const struct store_contents *c = column->contents;
    char subtitle[1024], when[600];
    struct picture picture = {.path = path,
                              .title = *column->title ? column->title : c->run,
                              .subtitle = subtitle,
                              .width = p->width,
                              .height = p->height};
    put_when(column, frame, when, sizeof when);
    snprintf(subtitle, sizeof subtitle, "%s  ·  %s", column->name, when);
    if (plotted_panel(column, frame, &picture.panel) != 0)
        return -1;
    return picture_draw(&picture, column->why, sizeof column->why);
}

// Whether F-bar is on in the frames that column k shows.
static const char *fbar_state(const struct plot *p, int k) {
    const uint8_t *fbar = p->columns[k].contents->fbar;
    for (int i = 1; i < p->n_rows; i++)
        if (fbar[p->frames[k][i]] != fbar[p->frames[k][0]])
            return "F-bar switched";
    return fbar[p->frames[k][0]] ? "F-bar on" : "F-bar off";
}

// What all columns have in common stands in the titles, what tells them apart in the headings.
struct words {
    char title[96], subtitle[320], headings[MONTAGE_MOST_COLUMNS][320], rows[MONTAGE_MOST_ROWS][40];
};

static void append(char *line, size_t bytes, const char *part) {
    const size_t n = strlen(line);
    if (*part)
        snprintf(line + n, bytes - n, "%s%s", n ? "  ·  " : "", part);
}

static void choose_words(const struct plot *p, struct words *w) {
    const struct plotted *first = &p->columns[0];
    const char *fbar = fbar_state(p, 0), *run = first->contents->run;
    bool same_title = true, same_fbar = true, same_run = true;
    *w = (struct words){0};
    for (int k = 1; k < p->n_columns; k++) {
        same_title = same_title && strcmp(p->columns[k].title, first->title) == 0;
        same_fbar = same_fbar && strcmp(fbar_state(p, k), fbar) == 0;
        same_run = same_run && strcmp(p->columns[k].contents->run, run) == 0;
    }
    const bool titled = same_title && *first->title;
    append(w->title, sizeof w->title, titled ? first->title : first->name);
    if (titled)
        append(w->subtitle, sizeof w->subtitle, first->name);
    if (same_fbar)
        append(w->subtitle, sizeof w->subtitle, fbar);
    if (p->n_columns == 1)
        append(w->subtitle, sizeof w->subtitle, run);
    for (int k = 0; k < p->n_columns; k++) {
        const struct plotted *q = &p->columns[k];
        char *heading = w->headings[k];
        const size_t bytes = sizeof w->headings[k];
        if (!same_title)
            append(heading, bytes, *q->title ? q->title : q->contents->run);
        if (!same_fbar)
            append(heading, bytes, fbar_state(p, k));
        if (!*heading)
            append(heading, bytes, same_run ? q->path : q->contents->run);
    }
    for (int i = 0; i < p->n_rows; i++)
        snprintf(w->rows[i], sizeof w->rows[i], "t = %.4g s",
                 first->contents->time[p->frames[0][i]]);
}

static int draw_grid(struct plot *p, const char *path, struct plotted **failed) {
    struct words words;
    struct montage m = {.path = path,
                        .title = words.title,
                        .subtitle = words.subtitle,
                        .n_columns = p->n_columns,
                        .n_rows = p->n_rows,
                        .one_bar = p->range_given,
                        .width = p->width,
                        .height = p->height};
    choose_words(p, &words);
    for (int k = 0; k < p->n_columns; k++)
        m.headings[k] = words.headings[k];
    for (int i = 0; i < p->n_rows; i++)
        m.row_labels[i] = words.rows[i];
    struct plotted *column = *failed = &p->columns[0];
    struct montage_drawing *drawing =
        montage_begin(&m, &column->panel, column->why, sizeof column->why);
    if (!drawing)
        return -1;
    for (int i = 0; i < p->n_rows; i++)
        for (int k = 0; k < p->n_columns; k++) {
            const size_t frame = p->frames[k][i];
            struct panel panel;
            char note[40];
            column = *failed = &p->columns[k];
            column->panel.filled = true;
            snprintf(note, sizeof note, "t = %.4g s", column->contents->time[frame]);
            if (interrupt_count() || plotted_panel(column, frame, &panel) != 0 ||
                montage_add(drawing, &panel, strcmp(note, words.rows[i]) != 0 ? note : NULL,
                            column->why, sizeof column->why) != 0) {
                montage_abandon(drawing);
                return -1;
            }
        }
    return montage_finish(drawing, column->why, sizeof column->why);
}

// A picture of every frame of the first recording; beside it the frames of the others that are
// nearest in time.
static int draw_series(struct plot *p, const char *folder, struct plotted **failed) {
    struct plotted *first = *failed = &p->columns[0];
    const size_t n = first->contents->n_frames;
    char path[4096];
    if (mkdir(folder, 0777) != 0 && errno != EEXIST) {
        snprintf(first->why, sizeof first->why, "%s: %s", folder, strerror(errno));
        return -1;
    }
    for (size_t i = 0; i < n; i++) {
        snprintf(path, sizeof path, "%s/%s-%06zu.png", folder, first->array->name, i);
        if (interrupt_count())
            return -1;
        for (int k = 0; k < p->n_columns; k++)
            p->frames[k][0] =
                k == 0 ? i : plotted_nearest_frame(&p->columns[k], first->contents->time[i]);
        if (p->n_columns > 1 ? draw_grid(p, path, failed) != 0 : draw(p, i, path) != 0)
            return -1;
        if (terminal_interactive()) {
            char line[96];
            snprintf(line, sizeof line, "picture %zu of %zu", i + 1, n);
            terminal_status(line);
        }
    }
    terminal_status_end(false);
    return 0;
}

// ---- Answers ----------------------------------------------------------------------------------

static const char *unit_of(const struct plotted *p) {
    return strcmp(p->unit, "1") == 0 ? "" : p->unit;
}

// The file is the picture, or the recording of a panel.
static cJSON *describe(const struct plotted *p, size_t frame, const char *file) {
    cJSON *answer = cJSON_CreateObject();
    cJSON_AddStringToObject(answer, "file", file);
    cJSON_AddStringToObject(answer, "field", p->array->name);
    cJSON_AddNumberToObject(answer, "time", p->contents->time[frame]);
    cJSON_AddNumberToObject(answer, "step", (double)p->contents->step[frame]);
    cJSON_AddNumberToObject(answer, "low", p->panel.range[0] / p->scale);
    cJSON_AddNumberToObject(answer, "high", p->panel.range[1] / p->scale);
    cJSON_AddStringToObject(answer, "unit", p->array->unit);
    return answer;
}

// A folder of pictures, and how they become a film.
static void print_series(const struct plot *p, bool json, const char *folder) {
    const struct plotted *q = &p->columns[0];
    const size_t n = q->contents->n_frames;
    if (!json) {
        printf("%s: %zu pictures of %s, t = %.4g to %.4g s\n"
               "a film of them: ffmpeg -framerate 25 -i %s/%s-%%06d.png -pix_fmt yuv420p film.mp4\n",
               folder, n, q->name, q->contents->time[0], q->contents->time[n - 1], folder,
               q->array->name);
        return;
    }
    cJSON *answer = describe(q, n - 1, folder);
    cJSON_AddNumberToObject(answer, "pictures", (double)n);
    report_json(answer);
    cJSON_Delete(answer);
}

static void print_result(const struct plot *p, bool json, const char *path, size_t frame) {
    const struct plotted *q = &p->columns[0];
    if (!json) {
        printf("%s: %s at t = %.4g s, %.4g to %.4g%s%s\n", path, q->name, q->contents->time[frame],
               q->panel.range[0], q->panel.range[1], *unit_of(q) ? " " : "", unit_of(q));
        return;
    }
    cJSON *answer = describe(q, frame, path);
    report_json(answer);
    cJSON_Delete(answer);
}

// A line for the picture and one for each column; in JSON a list of the panels, row by row.
static void print_grid(const struct plot *p, bool json, const char *path) {
    if (!json) {
        printf("%s: %s at t =", path, p->columns[0].name);
        for (int i = 0; i < p->n_rows; i++)
            printf(" %.4g%s", p->columns[0].contents->time[p->frames[0][i]],
                   i + 1 < p->n_rows ? "," : " s\n");
        for (int k = 0; k < p->n_columns; k++) {
            const struct plotted *q = &p->columns[k];
            printf("  %s: %s, %.4g to %.4g%s%s\n", q->path, fbar_state(p, k), q->panel.range[0],
                   q->panel.range[1], *unit_of(q) ? " " : "", unit_of(q));
        }
        return;
    }
    cJSON *answer = cJSON_CreateObject();
    cJSON_AddStringToObject(answer, "file", path);
    cJSON *panels = cJSON_AddArrayToObject(answer, "panels");
    for (int i = 0; i < p->n_rows; i++)
        for (int k = 0; k < p->n_columns; k++) {
            const struct plotted *q = &p->columns[k];
            cJSON *panel = describe(q, p->frames[k][i], q->path);
            cJSON_AddStringToObject(panel, "run", q->contents->run);
            cJSON_AddBoolToObject(panel, "fbar", q->contents->fbar[p->frames[k][i]]);
            cJSON_AddItemToArray(panels, panel);
        }
    report_json(answer);
    cJSON_Delete(answer);
}

// Of two times: the second less the first, of one recording. Of two recordings: the second, which
// was opened as the only column, less the first.
static int subtract(struct plot *p) {
    size_t frame = PLOTTED_NEAREST;
    if (p->minus.contents->dimension != p->columns[0].contents->dimension) {
        terminal_error("%s: is %dD, unlike %s", p->columns[0].path,
                       p->columns[0].contents->dimension, p->minus.path);
        return CLIENT_USAGE;
    }
    if (p->n_rows == 2) {
        frame = plotted_nearest_frame(&p->minus, p->times[0]);
        p->times[0] = p->times[1];
        p->n_rows = 1;
    }
    return plotted_subtract(&p->columns[0], &p->minus, frame);
}

static int plot(struct plot *p, const struct client *client, const struct arguments *arguments) {
    const char *output = arguments_value(arguments, "output");
    const char *series = arguments_value(arguments, "series");
    const char *axes = arguments_value(arguments, "axes");
    if (p->minus.path) { // one picture, of the second recording or time
        const int code = subtract(p);
        if (code != CLIENT_DONE)
            return code;
    }
    const bool grid = p->n_columns > 1 || p->n_rows > 1;
    struct plotted *failed = &p->columns[0];
    for (int k = 1; k < p->n_columns; k++)
        if (p->columns[k].contents->dimension != failed->contents->dimension) {
            terminal_error("%s: is %dD, unlike %s", p->columns[k].path,
                           p->columns[k].contents->dimension, failed->path);
            return CLIENT_USAGE;
        }
    if (p->n_rows == 0)
        p->times[p->n_rows++] = INFINITY; // the last frame
    choose_frames(p, series != NULL);
    if (!series)
        warn_of_times(p);
    const int unread = fit(p);
    if (unread >= 0) {
        terminal_error("%s", p->columns[unread].why);
        return CLIENT_IO;
    }
    if (axes && parse_axes(axes, failed->contents->dimension, p->low, p->high) != 0)
        return CLIENT_USAGE;
    copy_axes(p);
    const size_t frame = series ? failed->contents->n_frames - 1 : p->frames[0][0];
    const int status = series ? draw_series(p, series, &failed)
                       : grid ? draw_grid(p, output, &failed)
                              : draw(p, frame, output);
    if (status != 0 && interrupt_count())
        return CLIENT_INTERRUPTED;
    if (status != 0) {
        terminal_error("%s", failed->why);
        return CLIENT_IO;
    }
    if (series)
        print_series(p, client->json, series);
    else if (grid)
        print_grid(p, client->json, output);
    else
        print_result(p, client->json, output, frame);
    return CLIENT_DONE;
}

static int open_columns(struct plot *p, const struct arguments *arguments) {
    const char *field = arguments_value(arguments, "field");
    const char *component = arguments_value(arguments, "component");
    const char *const *files = arguments->positionals;
    int code = CLIENT_DONE;
    if (!field)
        field = "mean_stress";
    if (arguments_flag(arguments, "difference")) {
        code = plotted_open(&p->minus, files[0], field, component);
        files += p->n_columns - 1;
        p->n_columns = 1;
    }
    for (int k = 0; k < p->n_columns && code == CLIENT_DONE; k++)
        code = plotted_open(&p->columns[k], files[k], field, component);
    return code;
}

static int plot_curves(const struct client *client, const struct arguments *arguments,
                       const struct plot *p) {
    static const char *const others[] = {"field", "component", "time", "difference", "series",
                                         "range"};
    const char *axes = arguments_value(arguments, "axes");
    for (size_t i = 0; i < sizeof others / sizeof *others; i++)
        if (arguments_flag(arguments, others[i])) {
            terminal_error("--%s: is for pictures of particles, not for --probe", others[i]);
            return CLIENT_USAGE;
        }
    struct curves_options curves = {.n_files = p->n_columns,
                                     .files = arguments->positionals,
                                     .probes = arguments_value(arguments, "probe"),
                                     .path = arguments_value(arguments, "output"),
                                     .width = p->width,
                                     .height = p->height,
                                     .limited = axes != NULL};
    if (axes && parse_axes(axes, 2, curves.low, curves.high) != 0)
        return CLIENT_USAGE;
    return curves_plot(client, &curves);
}

static int run(struct client *client, const struct arguments *arguments) {
    struct plot *p = calloc(1, sizeof *p);
    int code = CLIENT_USAGE;
    if (!p) {
        terminal_error("out of memory");
        return CLIENT_IO;
    }
    p->width = DEFAULT_WIDTH;
    const bool parsed = parse(p, arguments) == 0;
    if (parsed && arguments_flag(arguments, "probe")) {
        code = plot_curves(client, arguments, p);
    } else if (parsed) {
        code = open_columns(p, arguments);
        if (code == CLIENT_DONE)
            code = plot(p, client, arguments);
        for (int k = 0; k < p->n_columns && k < MONTAGE_MOST_COLUMNS; k++)
            plotted_close(&p->columns[k]);
        plotted_close(&p->minus);
    }
    free(p);
    return code;
}

const struct command cmd_plot = {
    .name = "plot",
    .positionals = "FILE.h5... -o PNG",
    .summary = "draw particles coloured by a field, or curves of probes",
    .doc = "Several recordings or several times give one picture: a column for each recording, a\n"
           "row for each time, all with the same axes. Each column has its own range and colour\n"
           "bar, unless --range gives one to all. A difference is taken particle by particle.\n"
           "Curves have the references of the scene as points.",
    .examples = "fbar plot dam.h5 --field velocity --time 0.4 -o dam.png\n"
                "fbar plot off.h5 on.h5 --time 0.4,1,2 -o both.png\n"
                "fbar plot off.h5 on.h5 --difference --time 0.4 -o difference.png\n"
                "fbar plot off.h5 on.h5 --probe front,energy -o curves.png\n"
                "fbar plot off.h5 on.h5 --series film",
    .least = 1,
    .most = -1,
    .options = options,
    .run = run,
};
