// Two passes over the log: the first learns sizes and texts, the second writes the frames. The file
// is written under a temporary name, so that FILE.h5 is at all times absent, or whole, or the one
// before.
#include "client/assemble.h"

#include <cjson/cJSON.h>
#include <errno.h>
#include <fcntl.h>
#include <libgen.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "client/framelog.h"
#include "client/probeunits.h"
#include "client/readahead.h"
#include "client/store.h"
#include "client/xdmf.h"

struct contents {
    struct store_plan plan;
    char *run, *scene, *probes, *changes; // texts of the log's records
    double *times;                        // (n_frames)
    uint64_t *rows, *counts;
    size_t capacity;
    char state[24];
    bool complete;
};

static void contents_free(struct contents *c) {
    free(c->run);
    free(c->scene);
    free(c->probes);
    free(c->changes);
    free(c->times);
    free(c->rows);
    free(c->counts);
}

static char *with_suffix(const char *file, const char *old, const char *suffix) {
    const size_t n = strlen(file), m = strlen(old);
    const bool has = m > 0 && n > m && strcmp(file + n - m, old) == 0;
    char *name = NULL;
    if (asprintf(&name, "%.*s%s", (int)(has ? n - m : n), file, suffix) < 0)
        return NULL;
    return name;
}

char *assemble_log_name(const char *file) {
    return with_suffix(file, "", ".log");
}

char *assemble_xdmf_name(const char *file) {
    return with_suffix(file, ".h5", ".xdmf");
}

static int keep_text(char **kept, const struct framelog_record *record) {
    free(*kept);
    *kept = strndup(record->payload, record->bytes);
    return *kept ? 0 : -1;
}

static int keep_frame(struct contents *c, const struct framelog_record *record, char *why,
                      size_t why_bytes) {
    struct frameinfo info;
    const size_t i = c->plan.n_frames, row = c->plan.n_rows;
    if (frameinfo_peek(record->payload, record->bytes, &info, why, why_bytes) != 0 ||
        store_plan_add(&c->plan, &info, why, why_bytes) != 0)
        return -1;
    if (i == c->capacity) {
        const size_t capacity = i ? 2 * i : 256;
        double *times = realloc(c->times, capacity * sizeof *times);
        c->times = times ? times : c->times;
        uint64_t *rows = realloc(c->rows, capacity * sizeof *rows);
        c->rows = rows ? rows : c->rows;
        uint64_t *counts = realloc(c->counts, capacity * sizeof *counts);
        c->counts = counts ? counts : c->counts;
        if (!times || !rows || !counts) {
            snprintf(why, why_bytes, "out of memory");
            return -1;
        }
        c->capacity = capacity;
    }
    c->times[i] = info.time;
    c->rows[i] = row;
    c->counts[i] = info.count;
    snprintf(c->state, sizeof c->state, "%s", info.state);
    return 0;
}

static int learn(struct framelog *log, struct contents *c, char *why, size_t why_bytes) {
    struct framelog_record record;
    int got, status = 0;
    framelog_rewind(log);
    while (status == 0 && (got = framelog_skim(log, &record, why, why_bytes)) == 1)
        switch (record.kind) {
        case FRAMELOG_RUN:
            status = keep_text(&c->run, &record);
            break;
        case FRAMELOG_SCENE:
            status = keep_text(&c->scene, &record);
            break;
        case FRAMELOG_PROBES:
            status = keep_text(&c->probes, &record);
            break;
        case FRAMELOG_CHANGES:
            status = keep_text(&c->changes, &record);
            break;
        case FRAMELOG_FRAME:
            if (keep_frame(c, &record, why, why_bytes) != 0)
                return -1;
            break;
        case FRAMELOG_COMPLETE:
            c->complete = true;
            break;
        }
    if (status != 0) {
        snprintf(why, why_bytes, "out of memory");
        return -1;
    }
    return got;
}

static int write_frames(struct framelog *log, struct store *store, size_t n, char *why,
                        size_t why_bytes) {
    struct framelog_record record;
    struct frameinfo info;
    struct readahead *ahead = readahead_open(log);
    int status = ahead ? 0 : -1;
    if (!ahead)
        snprintf(why, why_bytes, "out of memory");
    while (status == 0 && n > 0) {
        const int got = readahead_next(ahead, &record, why, why_bytes);
        if (got == 0)
            snprintf(why, why_bytes, "the log became shorter while it was read");
        if (got != 1)
            status = -1;
        if (status != 0 || record.kind != FRAMELOG_FRAME)
            continue;
        // The record's digest, checked just now, covers the frame.
        if (frameinfo_peek(record.payload, record.bytes, &info, why, why_bytes) != 0 ||
            store_add_frame(store, &info, record.payload, why, why_bytes) != 0)
            status = -1;
        n--;
    }
    readahead_close(ahead);
    return status;
}

// ---- Probes: the daemon's CSV -----------------------------------------------------------------
// `step,time`, then a column a scalar probe, or a component `name.x` of another.

struct table {
    char *text;     // cut into cells in place
    char **columns; // names
    size_t n_columns, n_rows;
    double *values; // (n_rows, n_columns)
};

static void table_free(struct table *t) {
    free(t->text);
    free(t->columns);
    free(t->values);
}

// The next cell, without the quotes of RFC 4180, which names may have; *line is NULL after the
// last.
static char *next_cell(char **line) {
    char *cell = *line, *from = cell, *to = cell;
    const bool quoted = *from == '"';
    if (quoted)
        from++;
    for (; *from; from++) {
        if (quoted && *from == '"' && *++from != '"')
            break;
        if (!quoted && *from == ',')
            break;
        *to++ = *from;
    }
    *line = *from == ',' ? from + 1 : NULL;
    *to = '\0';
    return cell;
}

static int table_parse(const char *csv, struct table *t) {
    *t = (struct table){.text = strdup(csv)};
    if (!t->text)
        return -1;
    size_t lines = 0, commas = 0;
    for (char *c = t->text; *c; c++) {
        lines += *c == '\n';
        commas += *c == ',' && lines == 0;
        if (*c == '\r')
            *c = '\n';
    }
    char *rest = t->text, *line = strsep(&rest, "\n"), *cell;
    t->columns = calloc(commas + 2, sizeof *t->columns);
    t->values = calloc((lines + 2) * (commas + 1), sizeof *t->values);
    if (!t->columns || !t->values)
        return -1;
    while (line && (cell = next_cell(&line)))
        t->columns[t->n_columns++] = cell;
    while (rest && (line = strsep(&rest, "\n"))) {
        if (!*line)
            continue;
        double *row = t->values + t->n_rows++ * t->n_columns;
        for (size_t k = 0; k < t->n_columns; k++) {
            cell = line ? next_cell(&line) : NULL;
            char *end = NULL;
            const double value = cell ? strtod(cell, &end) : NAN;
            row[k] = cell && *cell && end != cell ? value : NAN; // an empty cell has no value
        }
    }
    return t->n_columns >= 2 ? 0 : -1;
}

// How many columns from `k` on are components of one probe, whose name goes to `name`.
static size_t probe_span(const struct table *t, size_t k, char *name, size_t n, char *components,
                         size_t components_bytes) {
    const char *dot = strrchr(t->columns[k], '.');
    size_t span = 1, used = 0;
    components[0] = '\0';
    if (!dot) {
        snprintf(name, n, "%s", t->columns[k]);
        return 1;
    }
    const size_t stem = (size_t)(dot - t->columns[k]);
    snprintf(name, n, "%.*s", (int)stem, t->columns[k]);
    while (k + span < t->n_columns && strncmp(t->columns[k + span], name, stem) == 0 &&
           strrchr(t->columns[k + span], '.') == t->columns[k + span] + stem)
        span++;
    for (size_t i = 0; i < span && used < components_bytes; i++)
        used += (size_t)snprintf(components + used, components_bytes - used, "%s%s", i ? "," : "",
                                 t->columns[k + i] + stem + 1);
    return span;
}

static int write_probes(struct store *store, const struct contents *c, char *why,
                        size_t why_bytes) {
    struct table t;
    int status = 0;
    if (!c->probes || table_parse(c->probes, &t) != 0) {
        if (c->probes)
            table_free(&t);
        return 0; // a run without probes
    }
    cJSON *scene = c->scene ? cJSON_Parse(c->scene) : NULL;
    uint64_t *steps = calloc(t.n_rows + 1, sizeof *steps);
    double *times = calloc(t.n_rows + 1, sizeof *times);
    double *values = calloc(t.n_rows * t.n_columns + 1, sizeof *values);
    if (!steps || !times || !values) {
        snprintf(why, why_bytes, "out of memory");
        status = -1;
    }
    for (size_t r = 0; status == 0 && r < t.n_rows; r++) {
        steps[r] = (uint64_t)t.values[r * t.n_columns];
        times[r] = t.values[r * t.n_columns + 1];
    }
    for (size_t k = 2, span; status == 0 && k < t.n_columns; k += span) {
        char name[128], components[128];
        span = probe_span(&t, k, name, sizeof name, components, sizeof components);
        struct probeunits units;
        probeunits_find(scene, &c->plan, name, &units);
        for (char *letter = name; *letter; letter++)
            if (*letter == '/')
                *letter = '_'; // a path separator in HDF5
        for (size_t r = 0; r < t.n_rows; r++)
            memcpy(values + r * span, t.values + r * t.n_columns + k, span * sizeof *values);
        const struct store_probe probe = {.name = name,
                                          .components = components,
                                          .n_components = span,
                                          .unit = units.unit,
                                          .long_name = units.long_name};
        status = store_add_probe(store, &probe, t.n_rows, steps, times, values, why, why_bytes);
    }
    cJSON_Delete(scene);
    free(steps);
    free(times);
    free(values);
    table_free(&t);
    return status;
}

// ---- Changes: [{"step": n, "time": t, "patch": {...}}] ----------------------------------------

static int write_changes(struct store *store, const char *text, char *why, size_t why_bytes) {
    cJSON *list = text ? cJSON_Parse(text) : NULL, *item;
    const size_t n = (size_t)cJSON_GetArraySize(list);
    uint64_t *steps = calloc(n + 1, sizeof *steps);
    double *times = calloc(n + 1, sizeof *times);
    char **patches = calloc(n + 1, sizeof *patches);
    size_t i = 0;
    int status = steps && times && patches ? 0 : -1;
    if (status != 0)
        snprintf(why, why_bytes, "out of memory");
    if (status == 0)
        cJSON_ArrayForEach(item, list) {
            const cJSON *step = cJSON_GetObjectItemCaseSensitive(item, "step");
            const cJSON *time = cJSON_GetObjectItemCaseSensitive(item, "time");
            const cJSON *patch = cJSON_GetObjectItemCaseSensitive(item, "patch");
            steps[i] = cJSON_IsNumber(step) ? (uint64_t)step->valuedouble : 0;
            times[i] = cJSON_IsNumber(time) ? time->valuedouble : NAN;
            patches[i] = patch ? cJSON_PrintUnformatted(patch) : strdup("{}");
            if (!patches[i++]) {
                snprintf(why, why_bytes, "out of memory");
                status = -1;
                break;
            }
        }
    if (status == 0)
        status =
            store_add_changes(store, n, steps, times, (const char *const *)patches, why, why_bytes);
    for (size_t k = 0; patches && k < n; k++)
        free(patches[k]);
    free(patches);
    free(steps);
    free(times);
    cJSON_Delete(list);
    return status;
}

// ---- The file ---------------------------------------------------------------------------------

static int sync_folder(const char *file) {
    char folder[PATH_MAX];
    snprintf(folder, sizeof folder, "%s", file);
    const int fd = open(dirname(folder), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (fd < 0)
        return -1;
    const int status = fsync(fd);
    close(fd);
    return status;
}

static int write_store(struct framelog *log, const struct contents *c, const char *path,
                       int compress, char *why, size_t why_bytes) {
    cJSON *run = c->run ? cJSON_Parse(c->run) : NULL;
    const char *id = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(run, "run"));
    const char *version =
        cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(run, "code_version"));
    const struct store_about about = {.run = id ? id : "",
                                      .code_version = version ? version : "",
                                      .scene = c->scene,
                                      .state = c->state,
                                      .complete = c->complete,
                                      .compress = compress};
    struct store *store = store_create(path, &c->plan, &about, why, why_bytes);
    cJSON_Delete(run);
    if (!store)
        return -1;
    if (write_frames(log, store, c->plan.n_frames, why, why_bytes) != 0 ||
        write_probes(store, c, why, why_bytes) != 0 ||
        write_changes(store, c->changes, why, why_bytes) != 0) {
        store_abandon(store);
        return -1;
    }
    return store_finish(store, why, why_bytes);
}

static int put_in_place(const char *temporary, const char *file, char *why, size_t why_bytes) {
    if (rename(temporary, file) == 0 && sync_folder(file) == 0)
        return 0;
    snprintf(why, why_bytes, "%s: %s", file, strerror(errno));
    return -1;
}

int assemble(struct framelog *log, const char *file, int compress, struct assemble_result *out,
             char *why, size_t why_bytes) {
    struct contents c = {0};
    struct stat status;
    const char *slash = strrchr(file, '/');
    char *temporary = with_suffix(file, "", ".tmp"), *xdmf = assemble_xdmf_name(file);
    char *xdmf_temporary = xdmf ? with_suffix(xdmf, "", ".tmp") : NULL;
    int result = -1;
    *out = (struct assemble_result){0};
    snprintf(why, why_bytes, "out of memory");
    if (temporary && xdmf && xdmf_temporary && learn(log, &c, why, why_bytes) == 0 &&
        write_store(log, &c, temporary, compress, why, why_bytes) == 0 &&
        xdmf_write(xdmf_temporary, slash ? slash + 1 : file, &c.plan, c.times, c.rows, c.counts,
                   why, why_bytes) == 0 &&
        put_in_place(temporary, file, why, why_bytes) == 0 &&
        put_in_place(xdmf_temporary, xdmf, why, why_bytes) == 0)
        result = 0;
    if (result != 0 && temporary && xdmf_temporary) {
        unlink(temporary);
        unlink(xdmf_temporary);
    }
    if (result == 0) {
        cJSON *run = c.run ? cJSON_Parse(c.run) : NULL;
        const char *id = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(run, "run"));
        out->n_frames = c.plan.n_frames;
        out->bytes = stat(file, &status) == 0 ? (uint64_t)status.st_size : 0;
        out->complete = c.complete;
        snprintf(out->run, sizeof out->run, "%s", id ? id : "");
        snprintf(out->state, sizeof out->state, "%s", c.state);
        cJSON_Delete(run);
    }
    contents_free(&c);
    free(temporary);
    free(xdmf);
    free(xdmf_temporary);
    return result;
}
