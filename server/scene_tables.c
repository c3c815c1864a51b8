// Reading and interpolating the embedded tables.
#include "server/scene_tables.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/scene_check.h"
#include "server/scenes_data.h"

const char *scene_table_choice(size_t index) {
    size_t n = 0;
    while (n < index && tables_data[n].name)
        n++;
    return tables_data[n].name;
}

static const char *next_line(const char *line) {
    const char *end = strchr(line, '\n');
    return end ? end + 1 : line + strlen(line);
}

static void read_names(const char *line, struct scene_table *out) {
    while (out->n_columns < SCENE_TABLE_COLUMNS) {
        size_t length = strcspn(line, ",\n");
        char *name = out->names[out->n_columns++];
        snprintf(name, sizeof out->names[0], "%.*s", (int)length, line);
        if (line[length] != ',')
            return;
        line += length + 1;
    }
}

bool scene_table_read(const char *name, struct scene_table *out) {
    *out = (struct scene_table){0};
    const struct embedded *data = tables_data;
    while (data->name && strcmp(data->name, name) != 0)
        data++;
    if (!data->name)
        return false;
    const char *line = data->text;
    while (*line == '#')
        line = next_line(line);
    read_names(line, out);
    const char *first = line = next_line(line);
    for (; *line; line = next_line(line))
        out->n_rows++;
    double *value = out->values = calloc(out->n_rows * out->n_columns + 1, sizeof *value);
    for (line = first; *line && value; line = next_line(line)) {
        char *at = (char *)line;
        for (size_t c = 0; c < out->n_columns; c++, at += *at == ',')
            *value++ = strtod(at, &at);
    }
    return value != NULL;
}

void scene_table_free(struct scene_table *table) {
    free(table->values);
    *table = (struct scene_table){0};
}

int scene_table_column(const struct scene_table *table, const char *name) {
    for (size_t c = 0; c < table->n_columns; c++)
        if (strcmp(table->names[c], name) == 0)
            return (int)c;
    return -1;
}

bool scene_table_field(const struct scene_table *table, enum mpm_field field, int component,
                       int dimension, int *columns, char lacks[40]) {
    const char *part;
    if (field == MPM_FIELD_MEAN_STRESS_SMOOTH) // what it should be is the mean stress
        field = MPM_FIELD_MEAN_STRESS;
    for (int c = 0; (part = scene_field_component(field, dimension, c)); c++) {
        if (component >= 0 && c != component)
            continue;
        snprintf(lacks, 40, "%s%s%s", mpm_field_info(field)->name, *part ? "." : "", part);
        if ((*columns++ = scene_table_column(table, lacks)) < 0)
            return false;
    }
    return true;
}

double scene_table_value(const struct scene_table *table, int column, double at) {
    const size_t width = table->n_columns;
    for (size_t k = 0; k + 1 < table->n_rows; k++) {
        const double *a = table->values + k * width, *b = a + width;
        if (a[0] <= at && at <= b[0])
            return a[column] +
                   (b[0] > a[0] ? (at - a[0]) / (b[0] - a[0]) : 0) * (b[column] - a[column]);
    }
    return NAN;
}
