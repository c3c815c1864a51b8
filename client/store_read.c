// Reads FILE.h5: what a recording holds, and single arrays of it.
#include <errno.h>
#include <hdf5.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "client/store_inside.h"

struct store_file {
    char *path;
    hid_t file;
    struct store_contents contents;
    void *owned[16];
    size_t n_owned;
};

static void get_text(hid_t at, const char *name, char *out, size_t n) {
    out[0] = '\0';
    const hid_t attribute = H5Aopen(at, name, H5P_DEFAULT);
    if (attribute < 0)
        return;
    const hid_t type = H5Aget_type(attribute);
    const size_t bytes = H5Tget_size(type);
    char *text =
        H5Tget_class(type) == H5T_STRING && !H5Tis_variable_str(type) ? calloc(bytes + 1, 1) : NULL;
    if (text && H5Aread(attribute, type, text) >= 0)
        snprintf(out, n, "%s", text);
    free(text);
    H5Tclose(type);
    H5Aclose(attribute);
}

static int get_integer(hid_t at, const char *name) {
    int value = 0;
    const hid_t attribute = H5Aopen(at, name, H5P_DEFAULT);
    if (attribute >= 0) {
        H5Aread(attribute, H5T_NATIVE_INT, &value);
        H5Aclose(attribute);
    }
    return value;
}

// A whole one-dimensional dataset of `*n` values (any number, where *n is 0), owned by the file.
static const void *get_column(struct store_file *f, const char *name, hid_t type, size_t *n) {
    const hid_t dataset = H5Dopen2(f->file, name, H5P_DEFAULT);
    if (dataset < 0)
        return NULL;
    const hid_t space = H5Dget_space(dataset);
    const hssize_t points = H5Sget_simple_extent_npoints(space);
    H5Sclose(space);
    void *values = NULL;
    if (points >= 0 && (*n == SIZE_MAX || (size_t)points == *n) && f->n_owned < 16) {
        values = calloc((size_t)points + 1, H5Tget_size(type));
        if (values && H5Dread(dataset, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, values) < 0) {
            free(values);
            values = NULL;
        }
        *n = (size_t)points;
    }
    H5Dclose(dataset);
    if (values)
        f->owned[f->n_owned++] = values;
    return values;
}

static const char *get_scene(struct store_file *f) {
    const hid_t dataset = H5Dopen2(f->file, "/fbard/scene", H5P_DEFAULT);
    if (dataset < 0)
        return "";
    const hid_t type = H5Dget_type(dataset);
    char *text = NULL;
    if (H5Tget_class(type) == H5T_STRING && H5Tis_variable_str(type) == 0)
        text = calloc(H5Tget_size(type) + 1, 1);
    if (text && H5Dread(dataset, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, text) >= 0) {
        f->owned[f->n_owned++] = text;
    } else {
        free(text);
        text = NULL;
    }
    H5Tclose(type);
    H5Dclose(dataset);
    return text ? text : "";
}

static herr_t on_array(hid_t group, const char *name, const H5L_info_t *info, void *context) {
    (void)info;
    struct store_contents *c = context;
    const hid_t dataset = H5Dopen2(group, name, H5P_DEFAULT);
    if (dataset < 0 || c->n_arrays == STORE_MAX_FIELDS)
        return 0;
    struct store_array *array = &c->arrays[c->n_arrays++];
    const hid_t space = H5Dget_space(dataset), type = H5Dget_type(dataset);
    hsize_t extent[2] = {0, 1};
    if (H5Sget_simple_extent_ndims(space) <= 2)
        H5Sget_simple_extent_dims(space, extent, NULL);
    array->components = extent[1];
    snprintf(array->name, sizeof array->name, "%s", name);
    snprintf(array->dtype, sizeof array->dtype, "<%c%zu",
             H5Tget_class(type) == H5T_FLOAT ? 'f' : 'u', H5Tget_size(type));
    get_text(dataset, "unit", array->unit, sizeof array->unit);
    get_text(dataset, "long_name", array->long_name, sizeof array->long_name);
    H5Tclose(type);
    H5Sclose(space);
    H5Dclose(dataset);
    return 0;
}

static herr_t on_probe(hid_t group, const char *name, const H5L_info_t *info, void *context) {
    (void)group, (void)info;
    struct store_contents *c = context;
    if (c->n_probes == STORE_MAX_PROBES)
        return 1;
    snprintf(c->probes[c->n_probes], sizeof c->probes[0], "%s", name);
    c->n_probes++;
    return 0;
}

static int get_contents(struct store_file *f) {
    struct store_contents *c = &f->contents;
    const hid_t fbard = H5Gopen2(f->file, "/fbard", H5P_DEFAULT);
    if (fbard < 0)
        return -1;
    get_text(fbard, "format", c->format, sizeof c->format);
    get_text(fbard, "run", c->run, sizeof c->run);
    get_text(fbard, "code_version", c->code_version, sizeof c->code_version);
    get_text(fbard, "state", c->state, sizeof c->state);
    c->complete = get_integer(fbard, "complete") != 0;
    c->dimension = get_integer(fbard, "dimension");
    H5Gclose(fbard);
    if (strcmp(c->format, STORE_FORMAT) != 0)
        return -1;
    size_t n = SIZE_MAX, changes = SIZE_MAX;
    c->seq = get_column(f, "/fbard/frames/seq", H5T_NATIVE_UINT64, &n);
    c->step = get_column(f, "/fbard/frames/step", H5T_NATIVE_UINT64, &n);
    c->digest = get_column(f, "/fbard/frames/digest", H5T_NATIVE_UINT64, &n);
    c->epoch = get_column(f, "/fbard/frames/epoch", H5T_NATIVE_UINT64, &n);
    c->count = get_column(f, "/fbard/frames/count", H5T_NATIVE_UINT64, &n);
    c->row = get_column(f, "/fbard/frames/row", H5T_NATIVE_UINT64, &n);
    c->time = get_column(f, "/fbard/frames/time", H5T_NATIVE_DOUBLE, &n);
    c->fbar = get_column(f, "/fbard/frames/fbar", H5T_NATIVE_UINT8, &n);
    if (!c->seq || !c->step || !c->digest || !c->epoch || !c->count || !c->row || !c->time ||
        !c->fbar)
        return -1;
    c->n_frames = n;
    c->scene = get_scene(f);
    if (get_column(f, "/fbard/changes/step", H5T_NATIVE_UINT64, &changes))
        c->n_changes = changes;
    c->change_time = get_column(f, "/fbard/changes/time", H5T_NATIVE_DOUBLE, &changes);
    if (!c->change_time)
        c->n_changes = 0;
    const hid_t probes = H5Gopen2(f->file, "/fbard/probes", H5P_DEFAULT);
    hsize_t first = 0;
    if (probes >= 0) {
        H5Literate(probes, H5_INDEX_NAME, H5_ITER_INC, &first, on_probe, c);
        H5Gclose(probes);
    }
    const hid_t data = H5Gopen2(f->file, "/VTKHDF/PointData", H5P_DEFAULT);
    if (data < 0)
        return -1;
    hsize_t at = 0;
    H5Literate(data, H5_INDEX_NAME, H5_ITER_INC, &at, on_array, c);
    H5Gclose(data);
    return 0;
}

struct store_file *store_open(const char *path, bool *foreign, char *why, size_t why_bytes) {
    store_begin();
    *foreign = false;
    if (access(path, R_OK) != 0) {
        snprintf(why, why_bytes, "%s: %s", path, strerror(errno));
        return NULL;
    }
    struct store_file *f = calloc(1, sizeof *f);
    if (!f || !(f->path = strdup(path))) {
        free(f);
        snprintf(why, why_bytes, "out of memory");
        return NULL;
    }
    f->file = H5Fopen(path, H5F_ACC_RDONLY, H5P_DEFAULT);
    if (f->file < 0 || get_contents(f) != 0) {
        *foreign = true;
        snprintf(why, why_bytes, "%s: is no recording of fbard", path);
        store_close(f);
        return NULL;
    }
    return f;
}

const struct store_contents *store_contents(const struct store_file *file) {
    return &file->contents;
}

int store_read_array(struct store_file *f, const char *name, size_t frame, double *out, char *why,
                     size_t why_bytes) {
    char place[96];
    if (strcmp(name, "position") == 0)
        snprintf(place, sizeof place, "/VTKHDF/Points");
    else
        snprintf(place, sizeof place, "/VTKHDF/PointData/%s", name);
    const hid_t dataset = H5Dopen2(f->file, place, H5P_DEFAULT);
    if (dataset < 0)
        return store_fail(f->path, why, why_bytes);
    const hid_t space = H5Dget_space(dataset);
    const int rank = H5Sget_simple_extent_ndims(space);
    hsize_t extent[2] = {0, 0}, start[2] = {f->contents.row[frame], 0};
    int status = -1;
    if (rank == 1 || rank == 2) {
        H5Sget_simple_extent_dims(space, extent, NULL);
        const hsize_t count[2] = {f->contents.count[frame], extent[1]};
        const hid_t memory = H5Screate_simple(rank, count, NULL);
        if (H5Sselect_hyperslab(space, H5S_SELECT_SET, start, NULL, count, NULL) >= 0 &&
            H5Dread(dataset, H5T_NATIVE_DOUBLE, memory, space, H5P_DEFAULT, out) >= 0)
            status = 0;
        H5Sclose(memory);
    }
    H5Sclose(space);
    H5Dclose(dataset);
    return status == 0 ? 0 : store_fail(f->path, why, why_bytes);
}

// The whole of a dataset as doubles: (rows[, columns]).
static double *read_table(hid_t group, const char *name, size_t *rows, size_t *columns) {
    const hid_t dataset = H5Dopen2(group, name, H5P_DEFAULT);
    if (dataset < 0)
        return NULL;
    const hid_t space = H5Dget_space(dataset);
    hsize_t extent[2] = {0, 1};
    double *values = NULL;
    if (H5Sget_simple_extent_ndims(space) <= 2 &&
        H5Sget_simple_extent_dims(space, extent, NULL) >= 0)
        values = calloc((size_t)(extent[0] * extent[1]) + 1, sizeof *values);
    if (values &&
        H5Dread(dataset, H5T_NATIVE_DOUBLE, H5S_ALL, H5S_ALL, H5P_DEFAULT, values) < 0) {
        free(values);
        values = NULL;
    }
    *rows = (size_t)extent[0];
    *columns = (size_t)extent[1];
    H5Sclose(space);
    H5Dclose(dataset);
    return values;
}

int store_read_series(struct store_file *f, const char *probe, struct store_series *out, char *why,
                      size_t why_bytes) {
    char place[128];
    size_t rows = 0, columns = 0;
    *out = (struct store_series){0};
    snprintf(place, sizeof place, "/fbard/probes/%s", probe);
    const hid_t group = H5Gopen2(f->file, place, H5P_DEFAULT);
    if (group < 0)
        return store_fail(f->path, why, why_bytes);
    get_text(group, "components", out->components, sizeof out->components);
    out->time = read_table(group, "time", &rows, &columns);
    out->value = read_table(group, "value", &out->n, &out->n_components);
    const hid_t dataset = H5Dopen2(group, "value", H5P_DEFAULT);
    if (dataset >= 0) {
        get_text(dataset, "unit", out->unit, sizeof out->unit);
        get_text(dataset, "long_name", out->long_name, sizeof out->long_name);
        H5Dclose(dataset);
    }
    H5Gclose(group);
    if (out->time && out->value && rows == out->n)
        return 0;
    store_series_free(out);
    return store_fail(f->path, why, why_bytes);
}

void store_series_free(struct store_series *series) {
    free(series->time);
    free(series->value);
    *series = (struct store_series){0};
}

void store_close(struct store_file *f) {
    if (!f)
        return;
    for (size_t i = 0; i < f->n_owned; i++)
        free(f->owned[i]);
    if (f->file >= 0)
        H5Fclose(f->file);
    free(f->path);
    free(f);
}
