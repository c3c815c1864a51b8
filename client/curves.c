// A row of panels that share the axis of time. A line is a recording, or a component of a vector
// probe of it; references are points with their tolerance.
#include "client/curves.h"

#include <cjson/cJSON.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/gnuplot.h"
#include "client/report.h"
#include "client/store.h"
#include "client/terminal.h"

#define MOST_FILES 8
#define MOST_PANELS 12
#define MOST_LINES 8 // of a panel: more cannot be told apart

// Pixels at a width of 1600; all scale with the width.
enum { LEFT = 190, RIGHT = 50, TOP = 130, BOTTOM = 100, PANEL = 420, LOW_PANEL = 300, GAP = 46 };
enum { FONT = 22 };
#define FULL_WIDTH 1600.0

// Okabe and Ito's colours (2008), which people of any colour vision tell apart.
static const char *const colours[MOST_LINES] = {"#0072b2", "#d55e00", "#009e73", "#cc79a7",
                                                "#e69f00", "#56b4e9", "#000000", "#8c8c00"};

struct curve {
    int file;
    size_t component;
    char label[400];
    double last;
};

struct panel_of_curves {
    const char *probe;
    struct store_series series[MOST_FILES]; // of each recording
    int n_lines;
    struct curve lines[MOST_LINES];
};

struct curves {
    const struct curves_options *options;
    struct store_file *h5[MOST_FILES];
    const struct store_contents *contents[MOST_FILES];
    cJSON *scenes[MOST_FILES];
    int n_panels;
    struct panel_of_curves panels[MOST_PANELS];
    char names[MOST_PANELS][96];
    char title[160], why[1024];
};

static int complain_probe(const struct curves *c, int file, const char *name) {
    const struct store_contents *contents = c->contents[file];
    const char *names[STORE_MAX_PROBES + 1] = {NULL};
    char list[400] = "";
    for (size_t i = 0; i < contents->n_probes; i++) {
        const size_t n = strlen(list);
        names[i] = contents->probes[i];
        snprintf(list + n, sizeof list - n, "%s%s", i ? ", " : "", names[i]);
    }
    const char *closest = arguments_closest(name, names);
    if (contents->n_probes == 0)
        terminal_error("--probe: %s has no probes", c->options->files[file]);
    else
        terminal_error("--probe: %s has no %s%s%s%s; it has %s", c->options->files[file], name,
                       closest ? "; did you mean " : "", closest ? closest : "", closest ? "?" : "",
                       list);
    return CLIENT_USAGE;
}

static bool has_probe(const struct store_contents *contents, const char *name) {
    for (size_t i = 0; i < contents->n_probes; i++)
        if (strcmp(contents->probes[i], name) == 0)
            return true;
    return false;
}

static int choose_probes(struct curves *c) {
    const char *rest = c->options->probes;
    if (strcmp(rest, "all") == 0) {
        for (size_t i = 0; i < c->contents[0]->n_probes && c->n_panels < MOST_PANELS; i++)
            snprintf(c->names[c->n_panels++], sizeof c->names[0], "%s", c->contents[0]->probes[i]);
        return c->n_panels > 0 ? CLIENT_DONE : complain_probe(c, 0, rest);
    }
    while (*rest) {
        const size_t n = strcspn(rest, ",");
        if (c->n_panels == MOST_PANELS) {
            terminal_error("--probe: a picture has room for %d probes", MOST_PANELS);
            return CLIENT_USAGE;
        }
        snprintf(c->names[c->n_panels++], sizeof c->names[0], "%.*s", (int)n, rest);
        rest += n + (rest[n] == ',');
    }
    return CLIENT_DONE;
}

// Component k of "x,y,..." into `out`.
static void component_name(const char *components, size_t k, char *out, size_t n) {
    while (k-- > 0 && *components) {
        components += strcspn(components, ",");
        components += *components == ',';
    }
    snprintf(out, n, "%.*s", (int)strcspn(components, ","), components);
}

static int open_files(struct curves *c) {
    for (int k = 0; k < c->options->n_files; k++) {
        bool foreign;
        c->h5[k] = store_open(c->options->files[k], &foreign, c->why, sizeof c->why);
        if (!c->h5[k]) {
            terminal_error("%s", c->why);
            return CLIENT_IO;
        }
        c->contents[k] = store_contents(c->h5[k]);
        c->scenes[k] = cJSON_Parse(c->contents[k]->scene);
    }
    const char *title =
        cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(c->scenes[0], "title"));
    snprintf(c->title, sizeof c->title, "%s", title && *title ? title : c->contents[0]->run);
    return CLIENT_DONE;
}

// "F-bar on", "F-bar off", or "F-bar switched".
static const char *fbar_word(const struct store_contents *contents) {
    for (size_t i = 1; i < contents->n_frames; i++)
        if (contents->fbar[i] != contents->fbar[0])
            return "F-bar switched";
    return contents->n_frames > 0 && contents->fbar[0] ? "F-bar on" : "F-bar off";
}

static int read_panel(struct curves *c, struct panel_of_curves *p) {
    for (int k = 0; k < c->options->n_files; k++) {
        struct store_series *s = &p->series[k];
        if (!has_probe(c->contents[k], p->probe))
            return complain_probe(c, k, p->probe);
        if (store_read_series(c->h5[k], p->probe, s, c->why, sizeof c->why) != 0) {
            terminal_error("%s", c->why);
            return CLIENT_IO;
        }
        for (size_t i = 0; i < s->n_components; i++) {
            if (p->n_lines == MOST_LINES) {
                terminal_note("%s: only the first %d curves are drawn", p->probe, MOST_LINES);
                return CLIENT_DONE;
            }
            struct curve *line = &p->lines[p->n_lines++];
            char component[48];
            *line = (struct curve){.file = k, .component = i, .last = NAN};
            component_name(s->components, i, component, sizeof component);
            snprintf(line->label, sizeof line->label, "%s%s%s%s%s", component,
                     *component && c->options->n_files > 1 ? ", " : "",
                     c->options->n_files > 1 ? c->options->files[k] : "",
                     c->options->n_files > 1 ? ", " : "",
                     c->options->n_files > 1 ? fbar_word(c->contents[k]) : "");
            for (size_t j = 0; j < s->n; j++)
                if (isfinite(s->value[j * s->n_components + i]))
                    line->last = s->value[j * s->n_components + i];
        }
    }
    return CLIENT_DONE;
}

// ---- Drawing ----------------------------------------------------------------------------------

static int put_line(struct curves *c, struct gnuplot *g, const struct panel_of_curves *p, int line,
                    bool first) {
    const struct curve *l = &p->lines[line];
    const struct store_series *s = &p->series[l->file];
    char path[600];
    FILE *out = gnuplot_data(g, path, sizeof path);
    bool written = out != NULL;
    for (size_t j = 0; written && j < s->n; j++) {
        const double record[2] = {s->time[j], s->value[j * s->n_components + l->component]};
        written = fwrite(record, sizeof record, 1, out) == 1;
    }
    if (out && fclose(out) != 0)
        written = false;
    if (!written) {
        snprintf(c->why, sizeof c->why, "%s: %s", g->folder, strerror(errno));
        return -1;
    }
    fputs(first ? "plot " : ", \\\n  ", g->script);
    gnuplot_put_text(g->script, path);
    // Of several recordings of a vector, a colour is a component and a dash a recording.
    const bool dashed = s->n_components > 1 && c->options->n_files > 1;
    fprintf(g->script,
            " binary format='%%2double' using 1:2 with lines lw 2 dt %d lc rgb '%s' %s ",
            dashed ? l->file + 1 : 1, colours[dashed ? l->component % MOST_LINES : (size_t)line],
            *l->label ? "title" : "notitle");
    if (*l->label)
        gnuplot_put_text(g->script, l->label);
    return 0;
}

// The references of the probe that are numbers, of the first recording's scene; "end" is its last
// sample. Tables are the daemon's.
static int put_references(struct curves *c, struct gnuplot *g, const struct panel_of_curves *p) {
    const struct store_series *s = &p->series[0];
    const cJSON *list = cJSON_GetObjectItemCaseSensitive(c->scenes[0], "references"), *reference;
    char path[600];
    size_t n = 0;
    FILE *out = gnuplot_data(g, path, sizeof path);
    if (!out)
        return -1;
    cJSON_ArrayForEach(reference, list) {
        const char *probe =
            cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(reference, "probe"));
        const cJSON *at = cJSON_GetObjectItemCaseSensitive(reference, "at");
        const cJSON *value = cJSON_GetObjectItemCaseSensitive(reference, "value");
        const cJSON *tolerance = cJSON_GetObjectItemCaseSensitive(reference, "tolerance");
        if (!probe || strcmp(probe, p->probe) != 0 || !cJSON_IsNumber(value))
            continue;
        const double t = cJSON_IsNumber(at) ? at->valuedouble : s->n ? s->time[s->n - 1] : 0;
        const double v = value->valuedouble;
        const double spread = cJSON_IsNumber(tolerance) ? tolerance->valuedouble : 0;
        fprintf(out, "%.17g %.17g %.17g\n", t, v, spread * (v == 0 ? 1 : fabs(v)));
        n++;
    }
    if (fclose(out) != 0)
        return -1;
    if (n == 0)
        return 0;
    fputs(", \\\n  ", g->script);
    gnuplot_put_text(g->script, path);
    fputs(" using 1:2:3 with yerrorbars pt 7 ps 1.1 lw 1.2 lc rgb '#555555' title 'reference'",
          g->script);
    return 0;
}

static int put_panel(struct curves *c, struct gnuplot *g, int panel, double low, double high,
                     double scale) {
    const struct panel_of_curves *p = &c->panels[panel];
    const struct curves_options *o = c->options;
    const bool last = panel + 1 == c->n_panels;
    const double width = o->width;
    fprintf(g->script,
            "set lmargin at screen %.6f\nset rmargin at screen %.6f\nset bmargin at screen %.6f\n"
            "set tmargin at screen %.6f\nset border 3 lw 0.8 lc rgb '#444444'\n"
            "set tics nomirror out scale 0.6\nset grid lc rgb '#dddddd' lt 1 lw 0.6\n",
            LEFT * scale / width, 1 - RIGHT * scale / width, low, high);
    if (last)
        fputs("set format x\nset xlabel 't (s)'\n", g->script);
    else
        fputs("set format x ''\nunset xlabel\n", g->script);
    if (o->limited)
        fprintf(g->script, "set xrange [%.9g:%.9g]\nset yrange [%.9g:%.9g]\n", o->low[0],
                o->high[0], o->low[1], o->high[1]);
    const char *unit = p->series[0].unit;
    char label[160];
    const bool has_unit = *unit && strcmp(unit, "1") != 0 && strcmp(unit, "unknown") != 0;
    snprintf(label, sizeof label, "%s%s%s%s", p->probe, has_unit ? " (" : "",
             has_unit ? unit : "", has_unit ? ")" : "");
    // Fixed places for the names: the widths of the numbers differ from panel to panel.
    fputs("unset ylabel\nset label 9 ", g->script);
    gnuplot_put_text(g->script, label);
    fprintf(g->script, " at screen %.6f,%.6f center rotate by 90 noenhanced\n",
            34 * scale / width, (low + high) / 2);
    for (size_t i = 0; i < c->contents[0]->n_changes && o->n_files == 1; i++)
        fprintf(g->script,
                "set arrow from first %.9g,graph 0 to first %.9g,graph 1 nohead back dt 2 lw 1.2 "
                "lc rgb '#888888'\n",
                c->contents[0]->change_time[i], c->contents[0]->change_time[i]);
    fputs("set key top left opaque noenhanced samplen 2 spacing 1.1\n", g->script);
    for (int i = 0; i < p->n_lines; i++)
        if (put_line(c, g, p, i, i == 0) != 0)
            return -1;
    if (put_references(c, g, p) != 0) {
        snprintf(c->why, sizeof c->why, "%s: %s", g->folder, strerror(errno));
        return -1;
    }
    fputs("\nunset label\nunset arrow\n", g->script);
    return 0;
}

static int draw(struct curves *c) {
    const struct curves_options *o = c->options;
    struct gnuplot g;
    const double scale = o->width / FULL_WIDTH;
    const double panel = scale * (c->n_panels > 2 ? LOW_PANEL : PANEL);
    const double height = o->height > 0 ? o->height
                                        : ceil(scale * (TOP + BOTTOM) + c->n_panels * panel +
                                               (c->n_panels - 1) * scale * GAP);
    const double free_height = height - scale * (TOP + BOTTOM) - (c->n_panels - 1) * scale * GAP;
    const double tall = fmax(free_height / c->n_panels, 20);
    if (gnuplot_begin(&g, o->path, c->why, sizeof c->why) != 0)
        return -1;
    gnuplot_put_terminal(&g, o->width, height, FONT * 0.75 * scale, 1.6 * scale);
    char subtitle[400] = "";
    if (o->n_files == 1)
        snprintf(subtitle, sizeof subtitle, "%s  ·  %s%s", c->contents[0]->run,
                 fbar_word(c->contents[0]),
                 c->contents[0]->n_changes ? "  ·  dashed: parameters changed" : "");
    fputs("set multiplot\nset label 1 ", g.script);
    gnuplot_put_text(g.script, c->title);
    const double fits = (o->width - LEFT * scale) / (0.62 * (double)(strlen(c->title) + 1));
    fprintf(g.script, " at screen %.6f,%.6f left noenhanced font 'DejaVu Sans Bold,%.2f'\n",
            LEFT * scale / o->width, 1 - 46 * scale / height, 0.75 * fmin(30 * scale, fits));
    fputs("set label 2 ", g.script);
    gnuplot_put_text(g.script, subtitle);
    fprintf(g.script, " at screen %.6f,%.6f left noenhanced tc rgb '#555555'\n",
            LEFT * scale / o->width, 1 - 90 * scale / height);
    for (int k = 0; k < c->n_panels; k++) {
        const double top = height - scale * TOP - k * (tall + scale * GAP);
        if (put_panel(c, &g, k, (top - tall) / height, top / height, scale) != 0) {
            gnuplot_abandon(&g);
            return -1;
        }
    }
    fputs("unset multiplot\n", g.script);
    return gnuplot_finish(&g, c->why, sizeof c->why);
}

// ---- The answer -------------------------------------------------------------------------------

static void print_result(const struct curves *c, bool json) {
    cJSON *answer = cJSON_CreateObject();
    cJSON_AddStringToObject(answer, "file", c->options->path);
    cJSON *list = cJSON_AddArrayToObject(answer, "curves");
    if (!json)
        printf("%s: %d probe%s\n", c->options->path, c->n_panels, c->n_panels > 1 ? "s" : "");
    for (int k = 0; k < c->n_panels; k++)
        for (int i = 0; i < c->panels[k].n_lines; i++) {
            const struct panel_of_curves *p = &c->panels[k];
            const struct curve *l = &p->lines[i];
            const struct store_series *s = &p->series[l->file];
            char component[48];
            component_name(s->components, l->component, component, sizeof component);
            if (!json) {
                const char *unit = strcmp(s->unit, "1") == 0 ? "" : s->unit;
                printf("  %s%s%s%s%s: %zu samples, %.6g%s%s at the end\n", p->probe,
                       *component ? "." : "", component, c->options->n_files > 1 ? " of " : "",
                       c->options->n_files > 1 ? c->options->files[l->file] : "", s->n, l->last,
                       *unit ? " " : "", unit);
                continue;
            }
            cJSON *curve = cJSON_CreateObject();
            cJSON_AddStringToObject(curve, "file", c->options->files[l->file]);
            cJSON_AddStringToObject(curve, "probe", p->probe);
            cJSON_AddStringToObject(curve, "component", component);
            cJSON_AddStringToObject(curve, "unit", s->unit);
            cJSON_AddNumberToObject(curve, "samples", (double)s->n);
            if (isfinite(l->last))
                cJSON_AddNumberToObject(curve, "last", l->last);
            else
                cJSON_AddNullToObject(curve, "last");
            cJSON_AddItemToArray(list, curve);
        }
    if (json)
        report_json(answer);
    cJSON_Delete(answer);
}

int curves_plot(const struct client *client, const struct curves_options *options) {
    struct curves *c = calloc(1, sizeof *c);
    if (!c) {
        terminal_error("out of memory");
        return CLIENT_IO;
    }
    c->options = options;
    int code = open_files(c);
    if (code == CLIENT_DONE)
        code = choose_probes(c);
    for (int k = 0; k < c->n_panels && code == CLIENT_DONE; k++) {
        c->panels[k].probe = c->names[k];
        code = read_panel(c, &c->panels[k]);
    }
    if (code == CLIENT_DONE && draw(c) != 0) {
        terminal_error("%s", c->why);
        code = CLIENT_IO;
    }
    if (code == CLIENT_DONE)
        print_result(c, client->json);
    for (int k = 0; k < c->n_panels; k++)
        for (int f = 0; f < options->n_files; f++)
            store_series_free(&c->panels[k].series[f]);
    for (int f = 0; f < options->n_files; f++) {
        if (c->h5[f])
            store_close(c->h5[f]);
        cJSON_Delete(c->scenes[f]);
    }
    free(c);
    return code;
}
