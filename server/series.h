// The probes' time series of one run: in memory, and as a log on disk that outlives the daemon.
// One thread appends (the run's); any thread reads.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/json.h"

struct series_probe {
    char *name;
    size_t n_components, column; // its values are columns [column, column + n_components) of a row
    char **components;           // "x", "kinetic", ...; "" for a scalar
};
// A row as read: `values` holds n_columns doubles, NaN where a probe has none.
struct series_row {
    uint64_t step;
    double time; // s
    const double *values;
};

struct series;

// What was agreed, owned by the series; fixed from creation on.
struct series *series_create(size_t n_probes, const char *const *names, const size_t *n_components,
                             const char *const *const *components);
void series_free(struct series *series);
size_t series_n_probes(const struct series *series);
size_t series_n_columns(const struct series *series);
const struct series_probe *series_probe(const struct series *series, size_t index);

// The log: a new file, or an existing one whose torn tail is cut. 0, or -1 with a sentence in `why`
// (JOURNAL_WHY bytes); a new file that cannot be begun now is tried again by series_flush.
int series_save_as(struct series *series, const char *path, char *why);
struct series *series_load(const char *path, char *why);

enum series_verdict { SERIES_APPENDED, SERIES_SAME, SERIES_DIFFERENT };
// Adds a row. A step that is there already (simulated again after a restart) is compared instead:
// SAME, or DIFFERENT, when that row and all after it give way to the new one.
enum series_verdict series_append(struct series *series, uint64_t step, double time,
                                  const double *values);
// Writes to the log what has been appended since; 0 or errno.
int series_flush(struct series *series);
int series_sync(struct series *series); // what was flushed survives a power failure; 0 or errno
size_t series_unsaved(struct series *series); // rows
void series_rest(struct series *series);      // closes the log, of a run that is over; NULL is fine

size_t series_n_rows(struct series *series);
// The last row with step <= `step`; false when there is none. `values` has n_columns.
bool series_at_step(struct series *series, uint64_t step, uint64_t *row_step, double *time,
                    double *values);
// {name: value, or {component: value} of a vector} of that row, new; every value null without one.
cJSON *series_values(struct series *series, uint64_t step);
// Column value interpolated linearly at `time`; false before the first or after the last row.
bool series_at_time(struct series *series, size_t column, double time, double *value);
// Calls `visit` for every row with step > `after` (or every row, when `all`), on copies: who
// appends is not held up. Nothing where there is no memory for them.
void series_visit(struct series *series, bool all, uint64_t after,
                  void (*visit)(void *context, const struct series_row *row), void *context);
