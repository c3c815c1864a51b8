// FILE.h5: the only file that knows HDF5. Layout (docs/reading.md): /VTKHDF is a temporal PolyData
// of version 2.0, /fbard holds what VTK has no place for. Nothing here depends on when or how often
// a recording was interrupted, so equal frames give equal files, byte for byte.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "client/frameinfo.h"

#define STORE_FORMAT "fbard-recording-1"
#define STORE_MAX_FIELDS 32
#define STORE_MAX_PROBES 128 // that reading looks at

// ---- Writing ----------------------------------------------------------------------------------

// A point array of the file: a field of the frames, padded to 3 or 9 components in 2D.
struct store_field {
    char name[48], unit[32], dtype[8];
    int rank;               // 1 scalar, 2 vector, 3 tensor
    size_t components;      // in the frame
    size_t file_components; // 1, 3 or 9
    size_t n_rows;          // that the frames have of it
};

// What the frames hold altogether: HDF5 is told the sizes before the first frame.
struct store_plan {
    size_t n_frames, n_rows, most_particles; // rows: particles of all frames
    int dimension;
    size_t n_fields;
    struct store_field fields[STORE_MAX_FIELDS]; // position is among them
};
// Adds what a frame needs. -1 with `why` when it does not fit to the frames before.
int store_plan_add(struct store_plan *plan, const struct frameinfo *info, char *why,
                   size_t why_bytes);

// The unit of a field that no frame has; "unknown" where this version does not know it.
const char *store_field_unit(const char *name);

struct store_about {
    const char *run, *code_version; // borrowed
    const char *scene;              // JSON text, or NULL
    const char *state;              // of the run, as in its last frame
    bool complete;                  // all frames of the run are here
    int compress;                   // 0, or the deflate level
};

struct store_probe {
    const char *name, *components; // borrowed; component names are joined by commas
    size_t n_components;
    const char *unit, *long_name;
};

struct store;
// Functions return 0, or -1 with a sentence in `why`; after a failure only store_abandon may
// follow.
struct store *store_create(const char *path, const struct store_plan *plan,
                           const struct store_about *about, char *why, size_t why_bytes);
// Frames in the order of their seq; as many as the plan counts.
int store_add_frame(struct store *store, const struct frameinfo *info, const void *frame, char *why,
                    size_t why_bytes);
// One probe: `values` is (n, n_components), row by row.
int store_add_probe(struct store *store, const struct store_probe *probe, size_t n,
                    const uint64_t *steps, const double *times, const double *values, char *why,
                    size_t why_bytes);
// All parameter changes: (n) each; `patches` are JSON texts.
int store_add_changes(struct store *store, size_t n, const uint64_t *steps, const double *times,
                      const char *const *patches, char *why, size_t why_bytes);
// Writes what is left, closes and frees: on 0 the file is on disk.
int store_finish(struct store *store, char *why, size_t why_bytes);
void store_abandon(struct store *store); // closes without a promise; NULL is accepted

// ---- Reading ----------------------------------------------------------------------------------

struct store_file;

struct store_array {
    char name[48], unit[32], long_name[96], dtype[8];
    size_t components;
};
struct store_contents {
    char format[32], run[72], code_version[48], state[24];
    bool complete;
    int dimension;
    size_t n_frames, n_arrays, n_probes, n_changes;
    struct store_array arrays[STORE_MAX_FIELDS]; // without position
    // (n_frames) each, owned by the store_file
    const uint64_t *seq, *step, *digest, *epoch, *count, *row;
    const double *time;
    const uint8_t *fbar;
    const char *scene; // JSON text, "" when there is none
    char probes[STORE_MAX_PROBES][96];
    const double *change_time; // (n_changes) s
};

// The series of a probe, owned by the caller: n samples of n_components values, row by row.
struct store_series {
    size_t n, n_components;
    double *time, *value; // s, `unit`
    char unit[48], long_name[192], components[256];
};

// NULL with `why`; *foreign says that the file is there and is none of ours.
struct store_file *store_open(const char *path, bool *foreign, char *why, size_t why_bytes);
const struct store_contents *store_contents(const struct store_file *file);
// Positions, (count, 3), or another point array, (count, components), as doubles. `out` must hold
// it.
int store_read_array(struct store_file *file, const char *name, size_t frame, double *out,
                     char *why, size_t why_bytes);
int store_read_series(struct store_file *file, const char *probe, struct store_series *out,
                      char *why, size_t why_bytes);
void store_series_free(struct store_series *series);
void store_close(struct store_file *file);
