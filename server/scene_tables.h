// Built-in reference tables: the files scenes/reference/NAME.csv, embedded at build. Lines that
// begin with # are about the source; then a line with the columns' names; then rows of numbers.
//
// Columns X, Y, Z are reference positions; a field's columns are named as its components are
// (`mean_stress`, `displacement.x`, `stress.xx`). A table without positions can be interpolated in
// its first column, which rises.
#pragma once
#include <stdbool.h>
#include <stddef.h>

#include "server/mpm/mpm.h"

#define SCENE_TABLE_COLUMNS 16

struct scene_table {
    size_t n_columns, n_rows;
    char names[SCENE_TABLE_COLUMNS][40];
    double *values; // (n_rows, n_columns), owned
};

const char *scene_table_choice(size_t index); // names; NULL past the last
// False when there is none of that name, or no memory.
bool scene_table_read(const char *name, struct scene_table *out);
void scene_table_free(struct scene_table *table);
// Index of a column, or -1.
int scene_table_column(const struct scene_table *table, const char *name);
// The columns of a field's components (of one where component >= 0), written to `columns`. False
// where the table lacks one, whose name is then in `lacks`.
bool scene_table_field(const struct scene_table *table, enum mpm_field field, int component,
                       int dimension, int *columns, char lacks[40]);
// The column's value where the first column is `at`; NaN outside the table.
double scene_table_value(const struct scene_table *table, int column, double at);
