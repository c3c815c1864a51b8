// Routes that give out what a run has produced: probes and frames.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/accept.h"
#include "server/log.h"
#include "server/routes_inside.h"

bool routes_query_number(struct call *c, const char *key, uint64_t absent, uint64_t *out) {
    char text[32];
    *out = absent;
    if (!http_query(c->request, key, text, sizeof text))
        return true;
    if (text[0] == '\0' || strlen(text) > 19 || strspn(text, "0123456789") != strlen(text)) {
        reply_problem(c->reply, 400, NULL, "%s must be a whole number, 0 or more", key);
        return false;
    }
    *out = strtoull(text, NULL, 10);
    return true;
}

bool routes_thinning(struct call *c, struct thin *out) {
    char text[256], *rest = text;
    *out = (struct thin){0};
    if (http_query(c->request, "max_particles", text, sizeof text)) {
        if (strlen(text) <= 15 && strspn(text, "0123456789") == strlen(text))
            out->max_particles = (size_t)strtoull(text, NULL, 10);
        if (out->max_particles == 0) {
            reply_problem(c->reply, 400, NULL,
                          "max_particles must be a whole number, 1 or more, got %.40s", text);
            return false;
        }
    }
    if (!http_query(c->request, "fields", text, sizeof text))
        return true;
    for (char *name; (name = strsep(&rest, ",")) != NULL;) {
        int field = mpm_field_parse(name);
        if (field < 0) {
            reply_problem(c->reply, 400, NULL, "fields: there is no field %.40s", name);
            return false;
        }
        out->fields |= (uint32_t)1 << field;
    }
    return true;
}

// ---- Probes -----------------------------------------------------------------------------------

struct rows {
    const struct series *series;
    cJSON *step, *time;
    cJSON **columns;
    FILE *csv;
};

static void row_json(void *context, const struct series_row *row) {
    struct rows *rows = context;
    cJSON_AddItemToArray(rows->step, cJSON_CreateNumber((double)row->step));
    cJSON_AddItemToArray(rows->time, json_number(row->time));
    for (size_t k = 0; k < series_n_columns(rows->series); k++)
        cJSON_AddItemToArray(rows->columns[k], json_number(row->values[k]));
}

static void probes_json(struct call *c, struct series *series, bool all, uint64_t after) {
    cJSON *json = cJSON_CreateObject();
    struct rows rows = {.series = series,
                        .step = cJSON_AddArrayToObject(json, "step"),
                        .time = cJSON_AddArrayToObject(json, "time")};
    cJSON *probes = cJSON_AddObjectToObject(json, "probes");
    size_t n = series != NULL ? series_n_probes(series) : 0;
    rows.columns =
        calloc(series != NULL ? series_n_columns(series) + 1 : 1, sizeof(struct cJSON *));
    for (size_t k = 0; k < n && rows.columns != NULL; k++) {
        const struct series_probe *probe = series_probe(series, k);
        bool scalar = probe->n_components == 1 && probe->components[0][0] == '\0';
        cJSON *inside = scalar ? probes : cJSON_AddObjectToObject(probes, probe->name);
        for (size_t d = 0; d < probe->n_components; d++)
            rows.columns[probe->column + d] =
                cJSON_AddArrayToObject(inside, scalar ? probe->name : probe->components[d]);
    }
    if (series != NULL && rows.columns != NULL)
        series_visit(series, all, after, row_json, &rows);
    free(rows.columns);
    reply_json(c->reply, 200, json);
}

static void put_number(FILE *csv, double value) {
    char digits[40];
    if (!isfinite(value))
        return; // an empty field
    for (int precision = 15; precision <= 17; precision++) {
        snprintf(digits, sizeof digits, "%.*g", precision, value);
        if (strtod(digits, NULL) == value)
            break;
    }
    fputs(digits, csv);
}

// As RFC 4180, but lines end as Unix tools expect: a name with a comma, a quote or a line break is
// quoted.
static void put_name(FILE *csv, const char *name, const char *component) {
    bool quoted = strpbrk(name, ",\"\r\n") != NULL;
    fputs(quoted ? ",\"" : ",", csv);
    for (; *name != '\0'; name++) {
        if (*name == '"')
            fputc('"', csv);
        fputc(*name, csv);
    }
    if (component[0] != '\0')
        fprintf(csv, ".%s", component);
    if (quoted)
        fputc('"', csv);
}

static void row_csv(void *context, const struct series_row *row) {
    struct rows *rows = context;
    fprintf(rows->csv, "%llu,", (unsigned long long)row->step);
    put_number(rows->csv, row->time);
    for (size_t k = 0; k < series_n_columns(rows->series); k++) {
        fputc(',', rows->csv);
        put_number(rows->csv, row->values[k]);
    }
    fputs("\n", rows->csv);
}

static void probes_csv(struct call *c, struct series *series, bool all, uint64_t after) {
    char *text = NULL;
    size_t bytes = 0;
    struct rows rows = {.series = series, .csv = open_memstream(&text, &bytes)};
    if (rows.csv == NULL) {
        reply_problem(c->reply, 503, NULL, "out of memory");
        return;
    }
    fputs("step,time", rows.csv);
    for (size_t k = 0; series != NULL && k < series_n_probes(series); k++)
        for (size_t d = 0; d < series_probe(series, k)->n_components; d++)
            put_name(rows.csv, series_probe(series, k)->name,
                     series_probe(series, k)->components[d]);
    fputs("\n", rows.csv);
    if (series != NULL)
        series_visit(series, all, after, row_csv, &rows);
    fclose(rows.csv);
    reply_text(c->reply, 200, "text/csv; charset=utf-8", text);
}

void routes_serve_probes(struct call *c) {
    uint64_t after;
    if (!routes_query_number(c, "since_step", UINT64_MAX, &after))
        return;
    bool all = after == UINT64_MAX;
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    static const char *const types[] = {"application/json", "text/csv"};
    char *accept = http_header_lines(c->request, "Accept");
    // Who wants neither gets the first: RFC 9110, 12.5.1 leaves that to the server.
    bool csv = accept_best(accept, types, sizeof types / sizeof *types) == 1;
    free(accept);
    if (csv)
        probes_csv(c, run_series(run), all, after);
    else
        probes_json(c, run_series(run), all, after);
    http_reply_header(c->reply, "Vary", "Accept");
    run_release(run);
}

// ---- Frames -----------------------------------------------------------------------------------

void routes_serve_frames(struct call *c) {
    uint64_t since;
    if (!routes_query_number(c, "since_seq", UINT64_MAX, &since))
        return;
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    struct journal *journal = run_journal(run);
    struct journal_frame frame;
    cJSON *json = cJSON_CreateObject();
    uint64_t first = journal != NULL ? journal_n_gone(journal) : 0;
    reply_add(json, "first", (double)first);
    cJSON *gone = cJSON_AddArrayToObject(json, "gone"); // dropped for want of room
    if (first > 0) {
        cJSON *range = cJSON_CreateObject();
        reply_add(range, "from", 0);
        reply_add(range, "to", (double)first - 1);
        cJSON_AddItemToArray(gone, range);
    }
    cJSON *list = cJSON_AddArrayToObject(json, "frames");
    uint64_t begin = since == UINT64_MAX || since < first ? first : since + 1;
    for (uint64_t seq = begin; journal != NULL && journal_frame(journal, seq, &frame); seq++) {
        char digest[24];
        cJSON *item = cJSON_CreateObject();
        snprintf(digest, sizeof digest, "%016llx", (unsigned long long)frame.digest);
        reply_add(item, "seq", (double)frame.seq);
        reply_add(item, "step", (double)frame.step);
        reply_add(item, "time", frame.time);
        reply_add(item, "bytes", (double)frame.bytes);
        reply_add(item, "epoch", frame.epoch);
        cJSON_AddStringToObject(
            item, "state",
            frame.state < RUN_N_STATES ? run_state_name((enum run_state)frame.state) : "");
        cJSON_AddBoolToObject(item, "end", frame.end);
        cJSON_AddStringToObject(item, "digest", digest);
        cJSON_AddItemToArray(list, item);
    }
    reply_json(c->reply, 200, json);
    run_release(run);
}

static void reply_frame(struct call *c, struct run *run, const struct thin *thin) {
    struct journal *journal = run_journal(run);
    struct journal_frame frame;
    char why[JOURNAL_WHY];
    uint64_t n = journal != NULL ? journal_n_frames(journal) : 0, seq = n - 1;
    const char *text = c->names[1];
    bool latest = strcmp(text, "latest") == 0;
    bool number = !latest && text[0] != '\0' && strlen(text) <= 19 &&
                  strspn(text, "0123456789") == strlen(text);
    if (number)
        seq = strtoull(text, NULL, 10);
    if ((!latest && !number) || seq >= n) {
        reply_problem(c->reply, 404, NULL, "run %.80s has no frame %.40s; it has %llu so far",
                      c->names[0], text, (unsigned long long)n);
        return;
    }
    unsigned char *whole = thin_asked(thin) ? journal_frame_read(journal, seq, &frame, why) : NULL;
    if (whole != NULL) {
        size_t bytes = 0;
        c->reply->body = (char *)thin_frame(thin, whole, frame.bytes, &bytes);
        c->reply->bytes = bytes;
        free(whole);
        if (c->reply->body == NULL) {
            reply_problem(c->reply, 503, NULL, "no memory for the frame");
            return;
        }
        c->reply->status = 200;
        c->reply->type = "application/vnd.fbard.frame";
        http_reply_header(c->reply, "Fbard-Seq", "%llu", (unsigned long long)seq);
        return;
    }
    int fd = journal_frame_open(journal, seq, &frame, why);
    if (fd < 0 && frame.gone) {
        reply_problem(c->reply, 404, NULL, "frame %.40s of run %.80s was dropped for want of room",
                      text, c->names[0]);
        return;
    }
    struct run *listed = fd < 0 ? runs_find(c->routes->runs, c->names[0]) : NULL;
    run_release(listed);
    if (fd < 0 && listed != run) {
        reply_problem(c->reply, 404, NULL, "there is no run %.80s any more", c->names[0]);
        return;
    }
    if (fd < 0) {
        log_error("frame", "run=%s why=\"%s\"", c->names[0], why);
        reply_problem(c->reply, 500, NULL, "%s", why);
        return;
    }
    c->reply->status = 200;
    c->reply->type = "application/vnd.fbard.frame";
    c->reply->fd = fd;
    c->reply->offset = frame.offset;
    c->reply->bytes = frame.bytes;
    http_reply_header(c->reply, "ETag", "\"%016llx\"", (unsigned long long)frame.digest);
    http_reply_header(c->reply, "Fbard-Seq", "%llu", (unsigned long long)seq);
}

void routes_serve_frame(struct call *c) {
    struct thin thin;
    if (!routes_thinning(c, &thin))
        return;
    struct run *run = routes_run_of(c);
    if (run == NULL)
        return;
    reply_frame(c, run, &thin);
    run_release(run);
}
