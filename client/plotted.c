// Which numbers of a recording a picture shows.
#include "client/plotted.h"

#include <cjson/cJSON.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/terminal.h"

// A few particles at a shock or a corner would otherwise take all the colours.
#define QUANTILE 0.01
#define NEIGHBOUR_SAMPLES 200

static const struct {
    const char *name, *text;
} labels[] = {
    {"mean_stress", "mean normal stress"},
    {"mean_stress_smooth", "mean normal stress, smooth"},
    {"volume_ratio", "volume ratio J"},
    {"volume_ratio_bar", "volume ratio of the stress"},
    {"von_mises", "von Mises stress"},
    {"plastic_strain", "equivalent plastic strain"},
};

static int choose_field(struct plotted *p, const char *name) {
    const struct store_contents *c = p->contents;
    const char *names[STORE_MAX_FIELDS + 1] = {NULL};
    for (size_t i = 0; i < c->n_arrays; i++) {
        names[i] = c->arrays[i].name;
        if (strcmp(names[i], name) == 0)
            p->array = &c->arrays[i];
    }
    if (p->array)
        return 0;
    const char *closest = arguments_closest(name, names);
    terminal_error("--field: the recording has no %s%s%s%s; `fbar info` lists the fields", name,
                   closest ? "; did you mean " : "", closest ? closest : "", closest ? "?" : "");
    return -1;
}

static int choose_component(struct plotted *p, const char *name) {
    static const char *const vector[] = {"x", "y", "z"};
    static const char *const tensor[] = {"xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"};
    const size_t n = p->array->components;
    const char *const *names = n == 3 ? vector : tensor;
    p->component = n;
    if (n == 1) {
        p->component = 0;
        if (!name)
            return 0;
        terminal_error("--component: %s is a scalar", p->array->name);
        return -1;
    }
    if (!name || strcmp(name, "magnitude") == 0)
        return 0;
    for (size_t i = 0; (n == 3 || n == 9) && i < n; i++)
        if (strcmp(name, names[i]) == 0)
            p->component = i;
    if (p->component < n)
        return 0;
    terminal_error("--component: %s has %s, ... and magnitude, not %s", p->array->name, names[0],
                   name);
    return -1;
}

// "x velocity", "velocity magnitude", "mean normal stress".
static void name_quantity(struct plotted *p) {
    static const char *const vector[] = {"x", "y", "z"};
    static const char *const tensor[] = {"xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"};
    const size_t n = p->array->components;
    char base[48];
    snprintf(base, sizeof base, "%s", p->array->name);
    for (size_t i = 0; i < sizeof labels / sizeof *labels; i++)
        if (strcmp(labels[i].name, p->array->name) == 0)
            snprintf(base, sizeof base, "%s", labels[i].text);
    for (char *c = base; *c; c++)
        if (*c == '_')
            *c = ' ';
    if (n > 1 && p->component == n)
        snprintf(p->name, sizeof p->name, "%s magnitude", base);
    else if (n > 1)
        snprintf(p->name, sizeof p->name, "%s %s", base, (n == 3 ? vector : tensor)[p->component]);
    else
        snprintf(p->name, sizeof p->name, "%s", base);
}

// What the scene tells: its title, if any, and the axis against gravity (else z).
static void read_scene(struct plotted *p) {
    cJSON *parsed = cJSON_Parse(p->contents->scene);
    const cJSON *gravity = cJSON_GetObjectItemCaseSensitive(parsed, "gravity"), *g;
    const char *title = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(parsed, "title"));
    int axis = 0;
    double most = 0;
    snprintf(p->title, sizeof p->title, "%s", title ? title : "");
    p->up = 2;
    cJSON_ArrayForEach(g, gravity) {
        if (cJSON_IsNumber(g) && fabs(g->valuedouble) > most && axis < 3) {
            most = fabs(g->valuedouble);
            p->up = axis;
        }
        axis++;
    }
    cJSON_Delete(parsed);
}

size_t plotted_nearest_frame(const struct plotted *p, double time) {
    const struct store_contents *c = p->contents;
    size_t best = 0;
    for (size_t i = 1; i < c->n_frames; i++) // of equally near ones the later
        if (fabs(c->time[i] - time) <= fabs(c->time[best] - time))
            best = i;
    return best;
}

size_t plotted_minus_frame(const struct plotted *p, size_t frame) {
    return p->minus_frame == PLOTTED_NEAREST
               ? plotted_nearest_frame(p->minus, p->contents->time[frame])
               : p->minus_frame;
}

static bool has_ids(const struct plotted *p) {
    for (size_t i = 0; i < p->contents->n_arrays; i++)
        if (strcmp(p->contents->arrays[i].name, "id") == 0)
            return true;
    return false;
}

// The particles' ids into p->value, or their places where the recording has no ids: particles keep
// their order over a run.
static int load_ids(struct plotted *p, size_t frame) {
    const size_t n = p->contents->count[frame];
    if (has_ids(p))
        return store_read_array(p->h5, "id", frame, p->value, p->why, sizeof p->why);
    for (size_t i = 0; i < n; i++)
        p->value[i] = (double)i;
    return 0;
}

// Takes the same particles of `minus` from p->raw; what it does not have becomes NaN.
static int subtract(struct plotted *p, size_t frame) {
    struct plotted *q = p->minus;
    const size_t other = plotted_minus_frame(p, frame), k = p->array->components;
    const size_t n = p->contents->count[frame], m = q->contents->count[other];
    if (load_ids(q, other) != 0 ||
        store_read_array(q->h5, q->array->name, other, q->raw, q->why, sizeof q->why) != 0) {
        snprintf(p->why, sizeof p->why, "%s", q->why);
        return -1;
    }
    memset(p->minus_row, 0xff, p->minus_ids * sizeof *p->minus_row);
    for (size_t j = 0; j < m; j++)
        if (q->value[j] >= 0 && q->value[j] < (double)p->minus_ids)
            p->minus_row[(size_t)q->value[j]] = (uint32_t)j;
    if (load_ids(p, frame) != 0)
        return -1;
    for (size_t i = 0; i < n; i++) {
        const double id = p->value[i];
        const uint32_t row = id >= 0 && id < (double)p->minus_ids ? p->minus_row[(size_t)id]
                                                                  : UINT32_MAX;
        for (size_t c = 0; c < k; c++)
            p->raw[i * k + c] = row == UINT32_MAX ? NAN : p->raw[i * k + c] - q->raw[row * k + c];
    }
    return 0;
}

int plotted_subtract(struct plotted *p, struct plotted *minus, size_t frame) {
    size_t most = 0, most_minus = 0;
    for (size_t i = 0; i < p->contents->n_frames; i++)
        most = p->contents->count[i] > most ? p->contents->count[i] : most;
    for (size_t i = 0; i < minus->contents->n_frames; i++)
        most_minus = minus->contents->count[i] > most_minus ? minus->contents->count[i] : most_minus;
    if (most != most_minus) {
        terminal_error("--difference: %s has %zu particles and %s %zu; it is taken particle by "
                       "particle, of scenes with the same bodies and cells",
                       minus->path, most_minus, p->path, most);
        return CLIENT_USAGE;
    }
    p->minus_ids = most;
    p->minus_row = malloc((most + 1) * sizeof *p->minus_row);
    if (!p->minus_row) {
        terminal_error("out of memory");
        return CLIENT_IO;
    }
    p->minus = minus;
    p->minus_frame = frame;
    // A magnitude is that of the difference.
    const bool magnitude = p->array->components > 1 && p->component == p->array->components;
    char name[sizeof p->name];
    snprintf(name, sizeof name, "%s", magnitude ? minus->array->name : minus->name);
    snprintf(p->name, sizeof p->name, "difference of %.36s%s", name, magnitude ? ", magnitude" : "");
    return CLIENT_DONE;
}

int plotted_load(struct plotted *p, size_t frame) {
    const size_t n = p->contents->count[frame], k = p->array->components;
    if (store_read_array(p->h5, "position", frame, p->position, p->why, sizeof p->why) != 0 ||
        store_read_array(p->h5, p->array->name, frame, p->raw, p->why, sizeof p->why) != 0 ||
        (p->minus && subtract(p, frame) != 0))
        return -1;
    for (size_t i = 0; i < n; i++) {
        double sum = 0;
        for (size_t c = 0; c < k; c++)
            sum += p->raw[i * k + c] * p->raw[i * k + c];
        p->value[i] = p->component == k ? sqrt(sum) : p->raw[i * k + p->component];
    }
    if (p->contents->dimension == 3) // the picture's last axis points up
        for (size_t i = 0; i < n; i++) {
            double *x = p->position + 3 * i;
            const double turned[3] = {x[(p->up + 1) % 3], x[(p->up + 2) % 3], x[p->up]};
            memcpy(x, turned, sizeof turned);
        }
    return 0;
}

static int ascending(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// The median distance to the nearest neighbour, from a sample.
static double neighbour_distance(const struct plotted *p, size_t frame) {
    double nearest[NEIGHBOUR_SAMPLES];
    const size_t n = p->contents->count[frame];
    size_t found = 0;
    const size_t stride = n / NEIGHBOUR_SAMPLES + 1;
    for (size_t i = 0; i < n && found < NEIGHBOUR_SAMPLES; i += stride) {
        double best = INFINITY;
        for (size_t j = 0; j < n; j++) {
            const double *a = p->position + 3 * i, *b = p->position + 3 * j;
            const double d = (a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) +
                             (a[2] - b[2]) * (a[2] - b[2]);
            if (j != i && d < best)
                best = d;
        }
        if (isfinite(best))
            nearest[found++] = sqrt(best);
    }
    if (found == 0)
        return 1;
    qsort(nearest, found, sizeof *nearest, ascending);
    return nearest[found / 2];
}

static int open_recording(struct plotted *p) {
    static const char *const axes[] = {"x", "y", "z"};
    const struct store_contents *c = p->contents;
    size_t most = 0;
    for (size_t i = 0; i < c->n_frames; i++)
        most = c->count[i] > most ? c->count[i] : most;
    if (most == 0) {
        snprintf(p->why, sizeof p->why, "%s: the recording holds no particles", p->path);
        return -1;
    }
    p->position = malloc(most * 3 * sizeof(double));
    p->raw = malloc(most * p->array->components * sizeof(double));
    p->value = malloc(most * sizeof(double));
    snprintf(p->why, sizeof p->why, "out of memory");
    if (!p->position || !p->raw || !p->value)
        return -1;
    read_scene(p);
    name_quantity(p);
    p->panel.dimension = c->dimension;
    for (int d = 0; d < 3; d++)
        p->panel.axis_names[d] = axes[c->dimension == 3 ? (p->up + 1 + d) % 3 : d];
    if (plotted_load(p, 0) != 0)
        return -1;
    p->panel.spacing = neighbour_distance(p, 0);
    return 0;
}

int plotted_open(struct plotted *p, const char *path, const char *field, const char *component) {
    bool foreign;
    *p = (struct plotted){.path = path};
    p->h5 = store_open(path, &foreign, p->why, sizeof p->why);
    if (!p->h5) {
        terminal_error("%s", p->why);
        return CLIENT_IO;
    }
    p->contents = store_contents(p->h5);
    if (choose_field(p, field) != 0 || choose_component(p, component) != 0)
        return CLIENT_USAGE;
    if (open_recording(p) != 0) {
        terminal_error("%s", p->why);
        return CLIENT_IO;
    }
    return CLIENT_DONE;
}

void plotted_close(struct plotted *p) {
    free(p->position);
    free(p->raw);
    free(p->value);
    free(p->minus_row);
    if (p->h5)
        store_close(p->h5);
    *p = (struct plotted){0};
}

int plotted_panel(struct plotted *p, size_t frame, struct panel *out) {
    if (plotted_load(p, frame) != 0)
        return -1;
    for (size_t i = 0; i < p->contents->count[frame]; i++)
        p->value[i] *= p->scale;
    *out = p->panel;
    out->count = p->contents->count[frame];
    out->position = p->position;
    out->value = p->value;
    return 0;
}

static int widen_axes(struct plotted *p, size_t frame, double low[3], double high[3]) {
    if (plotted_load(p, frame) != 0)
        return -1;
    for (size_t i = 0; i < p->contents->count[frame]; i++)
        for (int d = 0; d < 3; d++) {
            const double x = p->position[3 * i + (size_t)d];
            low[d] = x < low[d] ? x : low[d];
            high[d] = x > high[d] ? x : high[d];
        }
    return 0;
}

int plotted_widen_axes(struct plotted *p, const size_t *frames, size_t n, double low[3],
                       double high[3]) {
    int status = widen_axes(p, 0, low, high);
    for (size_t k = 0; k < n && status == 0; k++)
        status = widen_axes(p, frames[k], low, high);
    return status;
}

// Widens range[] by the robust range of the loaded frame.
static void widen_range(struct plotted *p, size_t frame, double range[2]) {
    size_t n = 0;
    double *sorted = p->raw; // not needed any more
    for (size_t i = 0; i < p->contents->count[frame]; i++)
        if (isfinite(p->value[i]))
            sorted[n++] = p->value[i];
    if (n == 0)
        return;
    qsort(sorted, n, sizeof *sorted, ascending);
    range[0] = fmin(range[0], sorted[(size_t)(QUANTILE * (double)(n - 1))]);
    range[1] = fmax(range[1], sorted[(size_t)ceil((1 - QUANTILE) * (double)(n - 1))]);
}

int plotted_fit_range(struct plotted *p, const size_t *frames, size_t n, double range[2]) {
    range[0] = INFINITY;
    range[1] = -INFINITY;
    for (size_t k = 0; k < n; k++) {
        if (plotted_load(p, frames[k]) != 0)
            return -1;
        widen_range(p, frames[k], range);
    }
    if (!isfinite(range[0]))
        range[0] = range[1] = 0;
    const double most = fmax(fabs(range[0]), fabs(range[1]));
    for (int i = 0; i < 2; i++) // round-off is zero
        if (fabs(range[i]) < 1e-6 * most)
            range[i] = 0;
    return 0;
}

void plotted_apply_range(struct plotted *p, const double fitted[2], bool given) {
    double range[2] = {fitted[0], fitted[1]};
    static const struct {
        double factor;
        const char *prefix;
    } prefixes[] = {{1e9, "G"}, {1e6, "M"}, {1e3, "k"}};
    const double most = fmax(fabs(range[0]), fabs(range[1]));
    p->panel.diverging =
        range[0] < 0 && range[1] > 0 && (p->minus || fmin(-range[0], range[1]) > 0.25 * most);
    if (p->panel.diverging && !given) { // the neutral colour is zero
        range[0] = -most;
        range[1] = most;
    }
    if (range[1] - range[0] <= 1e-9 * most || most <= 0) { // uniform: a range around the value
        const double half = most > 0 ? 1e-3 * most : 1;
        range[0] -= half;
        range[1] += half;
    }
    p->scale = 1;
    snprintf(p->unit, sizeof p->unit, "%s", p->array->unit);
    for (size_t i = 0; i < 3 && strcmp(p->array->unit, "Pa") == 0; i++)
        if (most >= prefixes[i].factor) {
            p->scale = 1 / prefixes[i].factor;
            snprintf(p->unit, sizeof p->unit, "%sPa", prefixes[i].prefix);
            break;
        }
    p->panel.range[0] = p->scale * range[0];
    p->panel.range[1] = p->scale * range[1];
    if (strcmp(p->unit, "1") == 0 || !*p->unit)
        snprintf(p->label, sizeof p->label, "%s", p->name);
    else
        snprintf(p->label, sizeof p->label, "%s (%s)", p->name, p->unit);
    p->panel.label = p->label;
}
