// Writes FILE.h5. The VTKHDF part follows the "VTKHDF format specification", version 2.0,
// sections "Poly data" and "Temporal data": the arrays of all frames stand one behind the other and
// Steps says where each begins. One vertex cell a particle; since cells only count the points of a
// frame from 0, all frames share one connectivity (the offsets of a step may repeat).
#include <errno.h>
#include <fcntl.h>
#include <hdf5.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "client/store_inside.h"

// Chunks near this size: small enough to read one frame of many, large enough to compress.
#define CHUNK_BYTES 262144
#define CHUNK_CACHE_BYTES (16u << 20)
// Rows of position and of uint32 fields that a frame lacks read as these.
static const double fill_double = NAN;
static const uint32_t fill_integer = 0;

static const char *const topologies[] = {"Vertices", "Lines", "Polygons", "Strips"};

// What each array is, for people, and its unit where no frame says it; names that are not listed
// get their name with blanks.
static const struct {
    const char *name, *unit, *text;
} known_fields[] = {
    {"position", "m", "current position (z = 0 in 2D)"},
    {"velocity", "m/s", "velocity"},
    {"displacement", "m", "current less reference position"},
    {"mean_stress", "Pa", "mean normal stress tr(sigma)/3 with sigma33, tension positive"},
    {"mean_stress_smooth", "Pa", "mean stress averaged over the grid once, for showing"},
    {"stress", "Pa",
     "Cauchy stress, row by row, tension positive (2D: in-plane components, the rest 0)"},
    {"von_mises", "Pa", "von Mises equivalent stress"},
    {"volume_ratio", "1", "volume ratio J of the unaveraged deformation"},
    {"volume_ratio_bar", "1", "volume ratio that the stress uses (J-bar with F-bar on)"},
    {"plastic_strain", "1", "equivalent plastic strain"},
    {"density", "kg/m^3", "current density"},
    {"body", "1", "index of the body in the scene's order"},
    {"id", "1", "number of the particle, stable over the run"},
};
#define N_KNOWN_FIELDS (sizeof known_fields / sizeof *known_fields)

const char *store_field_unit(const char *name) {
    for (size_t i = 0; i < N_KNOWN_FIELDS; i++)
        if (strcmp(name, known_fields[i].name) == 0)
            return known_fields[i].unit;
    return "unknown";
}

static const char *long_name(const char *name, char *buffer, size_t n) {
    for (size_t i = 0; i < N_KNOWN_FIELDS; i++)
        if (strcmp(name, known_fields[i].name) == 0)
            return known_fields[i].text;
    snprintf(buffer, n, "%s", name);
    for (char *c = buffer; *c; c++)
        if (*c == '_')
            *c = ' ';
    return buffer;
}

// ---- Plan -------------------------------------------------------------------------------------

static const struct store_field *plan_field(const struct store_plan *plan, const char *name) {
    for (size_t i = 0; i < plan->n_fields; i++)
        if (strcmp(plan->fields[i].name, name) == 0)
            return &plan->fields[i];
    return NULL;
}

int store_plan_add(struct store_plan *plan, const struct frameinfo *info, char *why,
                   size_t why_bytes) {
    if (plan->n_frames == 0)
        plan->dimension = info->dimension;
    if (plan->dimension != info->dimension) {
        snprintf(why, why_bytes, "frame %llu has another dimension than those before",
                 (unsigned long long)info->seq);
        return -1;
    }
    for (size_t i = 0; i < info->n_fields; i++) {
        const struct frameinfo_field *field = &info->fields[i];
        const struct store_field *known = plan_field(plan, field->name);
        if (known && known->rank == field->rank && known->components == field->components) {
            plan->fields[known - plan->fields].n_rows += info->count;
            if (strcmp(field->dtype, "<f8") == 0) // the widest that occurs holds them all
                memcpy(plan->fields[known - plan->fields].dtype, "<f8", 4);
            continue;
        }
        if (known || plan->n_fields == STORE_MAX_FIELDS) {
            snprintf(why, why_bytes, "frame %llu: field %s has another shape than before",
                     (unsigned long long)info->seq, field->name);
            return -1;
        }
        struct store_field *added = &plan->fields[plan->n_fields++];
        *added = (struct store_field){
            .rank = field->rank, .components = field->components, .n_rows = info->count};
        snprintf(added->name, sizeof added->name, "%s", field->name);
        snprintf(added->unit, sizeof added->unit, "%s", field->unit);
        snprintf(added->dtype, sizeof added->dtype, "%s", field->dtype);
        added->file_components = field->rank == 1 ? 1
                                 : field->rank == 2
                                     ? (field->components < 3 ? 3 : field->components)
                                     : 9;
    }
    plan->n_frames++;
    plan->n_rows += info->count;
    if (info->count > plan->most_particles)
        plan->most_particles = info->count;
    return 0;
}

// ---- HDF5 -------------------------------------------------------------------------------------

static herr_t deepest(unsigned n, const H5E_error2_t *error, void *context) {
    if (n == 0 && error->desc)
        snprintf(context, 256, "%s", error->desc);
    return 0;
}

void store_begin(void) {
    // HDF5 1.10 crashes at the process's exit over a file that it could not close for want of room.
    H5dont_atexit();
    H5Eset_auto2(H5E_DEFAULT, NULL, NULL);
}

int store_fail(const char *path, char *why, size_t why_bytes) {
    char reason[256] = "HDF5 failed";
    H5Ewalk2(H5E_DEFAULT, H5E_WALK_UPWARD, deepest, reason);
    const char *message = strstr(reason, "error message = '");
    if (message) { // "file write failed: ..., errno = 28, error message = 'No space left on
                   // device', ..."
        message += strlen("error message = '");
        snprintf(why, why_bytes, "%s: %.*s", path, (int)strcspn(message, "'"), message);
    } else {
        snprintf(why, why_bytes, "%s: %s", path, reason);
    }
    return -1;
}

static hid_t file_type(const char *dtype) {
    return strcmp(dtype, "<f8") == 0   ? H5T_IEEE_F64LE
           : strcmp(dtype, "<f4") == 0 ? H5T_IEEE_F32LE
                                       : H5T_STD_U32LE;
}

static size_t type_bytes(const char *dtype) {
    return strcmp(dtype, "<f8") == 0 ? 8 : 4;
}

static int put_attribute(hid_t at, const char *name, hid_t type, hsize_t n, const void *value) {
    const hid_t space = n == 0 ? H5Screate(H5S_SCALAR) : H5Screate_simple(1, &n, NULL);
    const hid_t attribute = H5Acreate2(at, name, type, space, H5P_DEFAULT, H5P_DEFAULT);
    const herr_t status = attribute < 0 ? -1 : H5Awrite(attribute, type, value);
    if (attribute >= 0)
        H5Aclose(attribute);
    H5Sclose(space);
    return status < 0 ? -1 : 0;
}

// Text of fixed length, padded with zeros, and called UTF-8 only where it is not ASCII: all that
// VTK and Octave read. The caller closes it.
static hid_t text_type(size_t length, bool utf8) {
    const hid_t type = H5Tcopy(H5T_C_S1);
    H5Tset_size(type, length > 0 ? length : 1);
    H5Tset_strpad(type, H5T_STR_NULLPAD);
    if (utf8)
        H5Tset_cset(type, H5T_CSET_UTF8);
    return type;
}

static bool beyond_ascii(const char *text) {
    for (; *text; text++)
        if ((unsigned char)*text >= 0x80)
            return true;
    return false;
}

static int put_text(hid_t at, const char *name, const char *text) {
    const hid_t type = text_type(strlen(text), beyond_ascii(text));
    const int status = put_attribute(at, name, type, 0, text);
    H5Tclose(type);
    return status;
}

static int put_units(hid_t at, const char *unit, const char *name) {
    return put_text(at, "unit", unit) != 0 || put_text(at, "long_name", name) != 0 ? -1 : 0;
}

// Groups and datasets carry no time stamps, so that equal content is equal bytes.
static hid_t make_group(hid_t at, const char *name) {
    const hid_t properties = H5Pcreate(H5P_GROUP_CREATE);
    H5Pset_obj_track_times(properties, 0);
    const hid_t group = H5Gcreate2(at, name, H5P_DEFAULT, properties, H5P_DEFAULT);
    H5Pclose(properties);
    return group;
}

static hsize_t chunk_rows(size_t rows, size_t per_frame, size_t row_bytes) {
    const size_t frame_bytes = per_frame * row_bytes;
    size_t chunk;
    if (rows == 0 || per_frame == 0)
        return 1;
    if (frame_bytes > CHUNK_BYTES) { // equal parts of a frame
        const size_t parts = (frame_bytes + CHUNK_BYTES - 1) / CHUNK_BYTES;
        chunk = (per_frame + parts - 1) / parts;
    } else { // whole frames
        chunk = per_frame * (CHUNK_BYTES / frame_bytes);
    }
    return chunk < rows ? chunk : rows;
}

struct shape {
    size_t rows, columns; // columns 0: one-dimensional
    size_t per_frame;     // rows that are read together
    bool whole;           // every row will be written: HDF5 need not fill it before
};

// Compressed arrays need chunks. Others lie in one piece: rows go from the frame to the file
// without a stay in a chunk cache, which halves the time of building the file.
static void put_layout(hid_t create, struct shape shape, size_t row_bytes, int compress) {
    if (compress > 0) {
        const hsize_t chunk[2] = {chunk_rows(shape.rows, shape.per_frame, row_bytes),
                                  shape.columns};
        H5Pset_chunk(create, shape.columns ? 2 : 1, chunk);
        H5Pset_shuffle(create);
        H5Pset_deflate(create, (unsigned)compress);
    } else {
        H5Pset_layout(create, H5D_CONTIGUOUS);
        H5Pset_alloc_time(create, H5D_ALLOC_TIME_EARLY); // so that its place depends on no write
    }
    H5Pset_fill_time(create, shape.whole ? H5D_FILL_TIME_NEVER : H5D_FILL_TIME_ALLOC);
}

static hid_t make_dataset(hid_t at, const char *name, hid_t type, struct shape shape, int compress,
                          const char *unit, const char *text) {
    const int rank = shape.columns ? 2 : 1;
    const hsize_t extent[2] = {shape.rows, shape.columns};
    const size_t row_bytes = H5Tget_size(type) * (shape.columns ? shape.columns : 1);
    const hid_t space = H5Screate_simple(rank, extent, NULL);
    const hid_t create = H5Pcreate(H5P_DATASET_CREATE), access = H5Pcreate(H5P_DATASET_ACCESS);
    H5Pset_obj_track_times(create, 0);
    put_layout(create, shape, row_bytes, compress);
    if (H5Tget_class(type) == H5T_FLOAT)
        H5Pset_fill_value(create, H5T_NATIVE_DOUBLE, &fill_double);
    else
        H5Pset_fill_value(create, H5T_NATIVE_UINT32, &fill_integer);
    H5Pset_chunk_cache(access, 521, CHUNK_CACHE_BYTES, 1.0);
    const hid_t dataset = H5Dcreate2(at, name, type, space, H5P_DEFAULT, create, access);
    H5Pclose(create);
    H5Pclose(access);
    H5Sclose(space);
    if (dataset >= 0 && put_units(dataset, unit, text) != 0) {
        H5Dclose(dataset);
        return -1;
    }
    return dataset;
}

// A whole small dataset at once.
static int put_dataset(hid_t at, const char *name, hid_t type, hid_t memory_type, size_t rows,
                       size_t columns, const void *values, const char *unit, const char *text) {
    const struct shape shape = {.rows = rows, .columns = columns, .per_frame = rows, .whole = true};
    const hid_t dataset = make_dataset(at, name, type, shape, 0, unit, text);
    if (dataset < 0)
        return -1;
    const herr_t status =
        rows ? H5Dwrite(dataset, memory_type, H5S_ALL, H5S_ALL, H5P_DEFAULT, values) : 0;
    return H5Dclose(dataset) < 0 || status < 0 ? -1 : 0;
}

static int put_rows(hid_t dataset, hid_t memory_type, size_t row, size_t rows, size_t columns,
                    const void *values) {
    if (rows == 0)
        return 0;
    const int rank = columns ? 2 : 1;
    const hsize_t start[2] = {row, 0}, count[2] = {rows, columns};
    const hid_t file = H5Dget_space(dataset), memory = H5Screate_simple(rank, count, NULL);
    H5Sselect_hyperslab(file, H5S_SELECT_SET, start, NULL, count, NULL);
    const herr_t status = H5Dwrite(dataset, memory_type, memory, file, H5P_DEFAULT, values);
    H5Sclose(file);
    H5Sclose(memory);
    return status < 0 ? -1 : 0;
}

// n JSON texts as rows of the length of the longest; or one as a scalar.
static int put_json(hid_t at, const char *name, size_t n, const char *const *texts, bool scalar,
                    const char *description) {
    size_t longest = 1;
    bool utf8 = false;
    for (size_t i = 0; i < n; i++) {
        if (strlen(texts[i]) > longest)
            longest = strlen(texts[i]);
        utf8 = utf8 || beyond_ascii(texts[i]);
    }
    char *rows = calloc(n + 1, longest);
    if (!rows)
        return -1;
    for (size_t i = 0; i < n; i++)
        memcpy(rows + i * longest, texts[i], strlen(texts[i]));
    const hsize_t extent = n;
    const hid_t type = text_type(longest, utf8);
    const hid_t space = scalar ? H5Screate(H5S_SCALAR) : H5Screate_simple(1, &extent, NULL);
    const hid_t create = H5Pcreate(H5P_DATASET_CREATE);
    H5Pset_obj_track_times(create, 0);
    const hid_t dataset = H5Dcreate2(at, name, type, space, H5P_DEFAULT, create, H5P_DEFAULT);
    int status = dataset < 0 || put_units(dataset, "1", description) != 0 ||
                         (n && H5Dwrite(dataset, type, H5S_ALL, H5S_ALL, H5P_DEFAULT, rows) < 0)
                     ? -1
                     : 0;
    if (dataset >= 0 && H5Dclose(dataset) < 0)
        status = -1;
    H5Pclose(create);
    H5Sclose(space);
    H5Tclose(type);
    free(rows);
    return status;
}

// ---- Writing ----------------------------------------------------------------------------------

struct store {
    char *path;
    struct store_plan plan;
    hid_t file, vtk, fbard, probes;
    hid_t arrays[STORE_MAX_FIELDS];
    size_t n_added, row;
    uint64_t *seq, *step, *digest, *epoch, *count, *first_row;
    double *time;
    uint8_t *fbar;
    unsigned char *padded;
    size_t padded_bytes;
};

static int put_header(struct store *s, const struct store_about *about) {
    const int64_t version[2] = {2, 0};
    const int32_t complete = about->complete, dimension = s->plan.dimension;
    const char *scene = about->scene ? about->scene : "";
    s->vtk = make_group(s->file, "VTKHDF");
    s->fbard = make_group(s->file, "fbard");
    if (s->vtk < 0 || s->fbard < 0 ||
        put_attribute(s->vtk, "Version", H5T_STD_I64LE, 2, version) != 0 ||
        put_text(s->vtk, "Type", "PolyData") != 0 ||
        put_text(s->fbard, "format", STORE_FORMAT) != 0 ||
        put_text(s->fbard, "run", about->run) != 0 ||
        put_text(s->fbard, "code_version", about->code_version) != 0 ||
        put_text(s->fbard, "state", about->state) != 0 ||
        put_attribute(s->fbard, "complete", H5T_STD_I32LE, 0, &complete) != 0 ||
        put_attribute(s->fbard, "dimension", H5T_STD_I32LE, 0, &dimension) != 0 ||
        put_json(s->fbard, "scene", 1, &scene, true, "the scene as run, JSON") != 0)
        return -1;
    s->probes = make_group(s->fbard, "probes");
    return s->probes < 0 ? -1 : 0;
}

static int make_arrays(struct store *s, int compress) {
    char buffer[64];
    const hid_t data = make_group(s->vtk, "PointData");
    if (data < 0)
        return -1;
    int status = 0;
    for (size_t i = 0; i < s->plan.n_fields && status == 0; i++) {
        const struct store_field *f = &s->plan.fields[i];
        const bool position = strcmp(f->name, "position") == 0;
        const struct shape shape = {.rows = s->plan.n_rows,
                                    .columns = f->file_components > 1 ? f->file_components : 0,
                                    .per_frame = s->plan.most_particles,
                                    .whole = f->n_rows == s->plan.n_rows};
        s->arrays[i] = make_dataset(position ? s->vtk : data, position ? "Points" : f->name,
                                    file_type(f->dtype), shape, compress, f->unit,
                                    long_name(f->name, buffer, sizeof buffer));
        if (s->arrays[i] < 0)
            status = -1;
    }
    return H5Gclose(data) < 0 ? -1 : status;
}

struct store *store_create(const char *path, const struct store_plan *plan,
                           const struct store_about *about, char *why, size_t why_bytes) {
    store_begin();
    struct store *s = calloc(1, sizeof *s);
    const size_t n = plan->n_frames + 1; // never calloc(0)
    if (!s || !(s->path = strdup(path)) || !(s->seq = calloc(n, 8)) || !(s->step = calloc(n, 8)) ||
        !(s->digest = calloc(n, 8)) || !(s->epoch = calloc(n, 8)) || !(s->count = calloc(n, 8)) ||
        !(s->first_row = calloc(n, 8)) || !(s->time = calloc(n, 8)) || !(s->fbar = calloc(n, 1))) {
        snprintf(why, why_bytes, "out of memory");
        store_abandon(s);
        return NULL;
    }
    s->plan = *plan;
    s->file = s->vtk = s->fbard = s->probes = -1;
    for (size_t i = 0; i < STORE_MAX_FIELDS; i++)
        s->arrays[i] = -1;
    const hid_t create = H5Pcreate(H5P_FILE_CREATE);
    H5Pset_obj_track_times(create, 0);
    s->file = H5Fcreate(path, H5F_ACC_TRUNC, create, H5P_DEFAULT);
    H5Pclose(create);
    if (s->file < 0 || put_header(s, about) != 0 || make_arrays(s, about->compress) != 0) {
        store_fail(path, why, why_bytes);
        store_abandon(s);
        return NULL;
    }
    return s;
}

static size_t index_of_array(const struct store *s, const char *name) {
    return (size_t)(plan_field(&s->plan, name) - s->plan.fields);
}

// Rows of `side` (or, of a tensor, side x side) components into rows of 3 (3 x 3), the rest 0.
// Nearly every value of a 2D recording goes through here, so each type has its own loop.
#define DEFINE_PAD(name, type)                                                                     \
    static void name(void *out, const void *in, size_t count, size_t side, bool tensor) {          \
        type *to = out;                                                                            \
        const type *from = in;                                                                     \
        if (!tensor && side == 2) {                                                                \
            for (size_t p = 0; p < count; p++) {                                                   \
                to[3 * p] = from[2 * p];                                                           \
                to[3 * p + 1] = from[2 * p + 1];                                                   \
                to[3 * p + 2] = 0;                                                                 \
            }                                                                                      \
            return;                                                                                \
        }                                                                                          \
        const size_t rows = tensor ? side : 1, width = tensor ? 9 : 3;                             \
        for (size_t p = 0; p < count; p++, to += width)                                            \
            for (size_t r = 0; r < width / 3; r++)                                                 \
                for (size_t c = 0; c < 3; c++)                                                     \
                    to[3 * r + c] = r < rows && c < side ? from[(p * rows + r) * side + c] : 0;    \
    }
DEFINE_PAD(pad_doubles, uint64_t) // bits are copied, not numbers
DEFINE_PAD(pad_words, uint32_t)

// A 2D vector or tensor with its third components 0.
static const void *pad_field(struct store *s, const struct frameinfo_field *from, size_t count,
                             const struct store_field *to, const unsigned char *values) {
    const size_t bytes = type_bytes(from->dtype), side = from->shape[1];
    const size_t need = count * to->file_components * bytes;
    if (from->components == to->file_components)
        return values;
    if (need > s->padded_bytes) {
        unsigned char *grown = realloc(s->padded, need);
        if (!grown)
            return NULL;
        s->padded = grown;
        s->padded_bytes = need;
    }
    if (bytes == 8)
        pad_doubles(s->padded, values, count, side, from->rank == 3);
    else
        pad_words(s->padded, values, count, side, from->rank == 3);
    return s->padded;
}

int store_add_frame(struct store *s, const struct frameinfo *info, const void *frame, char *why,
                    size_t why_bytes) {
    if (s->n_added == s->plan.n_frames || s->row + info->count > s->plan.n_rows) {
        snprintf(why, why_bytes, "%s: more frames than were planned", s->path);
        return -1;
    }
    for (size_t i = 0; i < info->n_fields; i++) {
        const struct frameinfo_field *from = &info->fields[i];
        const size_t k = index_of_array(s, from->name);
        const struct store_field *to = &s->plan.fields[k];
        const void *values =
            pad_field(s, from, info->count, to, (const unsigned char *)frame + from->offset);
        if (!values) {
            snprintf(why, why_bytes, "out of memory");
            return -1;
        }
        if (put_rows(s->arrays[k], file_type(from->dtype), s->row, info->count,
                     to->file_components > 1 ? to->file_components : 0, values) != 0)
            return store_fail(s->path, why, why_bytes);
    }
    const size_t n = s->n_added++;
    s->seq[n] = info->seq;
    s->step[n] = info->step;
    s->digest[n] = info->digest;
    s->epoch[n] = info->epoch;
    s->count[n] = info->count;
    s->first_row[n] = s->row;
    s->time[n] = info->time;
    s->fbar[n] = info->fbar;
    s->row += info->count;
    return 0;
}

int store_add_probe(struct store *s, const struct store_probe *probe, size_t n,
                    const uint64_t *steps, const double *times, const double *values, char *why,
                    size_t why_bytes) {
    const hid_t group = make_group(s->probes, probe->name);
    if (group < 0)
        return store_fail(s->path, why, why_bytes);
    int status = put_text(group, "components", probe->components);
    if (status == 0)
        status = put_dataset(group, "step", H5T_STD_I64LE, H5T_NATIVE_UINT64, n, 0, steps, "1",
                             "steps done");
    if (status == 0)
        status = put_dataset(group, "time", H5T_IEEE_F64LE, H5T_NATIVE_DOUBLE, n, 0, times, "s",
                             "time since the start of the last stage");
    if (status == 0)
        status = put_dataset(group, "value", H5T_IEEE_F64LE, H5T_NATIVE_DOUBLE, n,
                             probe->n_components > 1 ? probe->n_components : 0, values, probe->unit,
                             probe->long_name);
    if (H5Gclose(group) < 0)
        status = -1;
    return status == 0 ? 0 : store_fail(s->path, why, why_bytes);
}

int store_add_changes(struct store *s, size_t n, const uint64_t *steps, const double *times,
                      const char *const *patches, char *why, size_t why_bytes) {
    const hid_t group = make_group(s->fbard, "changes");
    int status = group < 0 ? -1 : 0;
    if (status == 0)
        status = put_dataset(group, "step", H5T_STD_I64LE, H5T_NATIVE_UINT64, n, 0, steps, "1",
                             "the change holds from the step after this one");
    if (status == 0)
        status = put_dataset(group, "time", H5T_IEEE_F64LE, H5T_NATIVE_DOUBLE, n, 0, times, "s",
                             "time at which it took effect");
    if (status == 0)
        status =
            put_json(group, "patch", n, patches, false, "merge patch of the configuration, JSON");
    if (group >= 0 && H5Gclose(group) < 0)
        status = -1;
    return status == 0 ? 0 : store_fail(s->path, why, why_bytes);
}

// One vertex a particle, shared by all frames; the other topologies of PolyData are there and
// empty.
static int put_topology(struct store *s) {
    const size_t n = s->n_added, m = s->plan.most_particles;
    int64_t *ids = calloc(m + 1, sizeof *ids);
    uint64_t *none = calloc(n + 1, sizeof *none);
    int status = ids && none ? 0 : -1;
    for (size_t i = 0; ids && i <= m; i++)
        ids[i] = (int64_t)i;
    for (size_t t = 0; t < 4 && status == 0; t++) {
        const hid_t group = make_group(s->vtk, topologies[t]);
        const size_t cells = t == 0 ? m : 0;
        const uint64_t *count = t == 0 ? s->count : none;
        if (group < 0 ||
            put_dataset(group, "NumberOfCells", H5T_STD_I64LE, H5T_NATIVE_UINT64, n, 0, count, "1",
                        "cells of each step") != 0 ||
            put_dataset(group, "NumberOfConnectivityIds", H5T_STD_I64LE, H5T_NATIVE_UINT64, n, 0,
                        count, "1", "connectivity ids of each step") != 0 ||
            put_dataset(group, "Offsets", H5T_STD_I64LE, H5T_NATIVE_INT64, cells + 1, 0, ids, "1",
                        "where each cell begins in Connectivity, shared by all steps") != 0 ||
            put_dataset(group, "Connectivity", H5T_STD_I64LE, H5T_NATIVE_INT64, cells, 0, ids, "1",
                        "points of the cells, shared by all steps") != 0)
            status = -1;
        if (group >= 0)
            H5Gclose(group);
    }
    free(ids);
    free(none);
    return status;
}

static int put_steps(struct store *s) {
    const size_t n = s->n_added;
    const int64_t n_steps = (int64_t)n;
    uint64_t *zeros = calloc(4 * n + 1, 8), *ones = calloc(n + 1, 8), *parts = calloc(n + 1, 8);
    const hid_t steps = make_group(s->vtk, "Steps"), data = make_group(steps, "PointDataOffsets");
    int status = zeros && ones && parts && steps >= 0 && data >= 0 ? 0 : -1;
    for (size_t i = 0; status == 0 && i < n; i++) {
        ones[i] = 1;
        parts[i] = i;
    }
    const struct {
        const char *name, *text;
        size_t columns;
        const uint64_t *values;
    } offsets[] = {
        {"PartOffsets", "part of each step", 0, parts},
        {"NumberOfParts", "parts of each step", 0, ones},
        {"PointOffsets", "first row of each step in Points", 0, s->first_row},
        {"CellOffsets", "first cell of each step: Vertices, Lines, Polygons, Strips", 4, zeros},
        {"ConnectivityIdOffsets", "first connectivity id of each step", 4, zeros},
    };
    if (status == 0 && (put_attribute(steps, "NSteps", H5T_STD_I64LE, 0, &n_steps) != 0 ||
                        put_dataset(steps, "Values", H5T_IEEE_F64LE, H5T_NATIVE_DOUBLE, n, 0,
                                    s->time, "s", "time of each step") != 0))
        status = -1;
    for (size_t i = 0; status == 0 && i < sizeof offsets / sizeof *offsets; i++)
        status = put_dataset(steps, offsets[i].name, H5T_STD_I64LE, H5T_NATIVE_UINT64, n,
                             offsets[i].columns, offsets[i].values, "1", offsets[i].text);
    for (size_t i = 0; status == 0 && i < s->plan.n_fields; i++)
        if (strcmp(s->plan.fields[i].name, "position") != 0)
            status = put_dataset(data, s->plan.fields[i].name, H5T_STD_I64LE, H5T_NATIVE_UINT64, n,
                                 0, s->first_row, "1", "first row of each step in the array");
    if (data >= 0)
        H5Gclose(data);
    if (steps >= 0)
        H5Gclose(steps);
    free(zeros);
    free(ones);
    free(parts);
    if (status == 0)
        status = put_dataset(s->vtk, "NumberOfPoints", H5T_STD_I64LE, H5T_NATIVE_UINT64, n, 0,
                             s->count, "1", "particles of each step");
    return status;
}

static int put_frames(struct store *s) {
    const size_t n = s->n_added;
    const hid_t group = make_group(s->fbard, "frames");
    if (group < 0)
        return -1;
    const struct {
        const char *name, *unit, *text;
        const uint64_t *values;
    } numbers[] = {
        {"seq", "1", "number of the frame, dense from 0", s->seq},
        {"step", "1", "steps done", s->step},
        {"digest", "1", "XXH3-64 of the frame as it was published", s->digest},
        {"epoch", "1", "epoch of the run's history", s->epoch},
        {"count", "1", "particles", s->count},
        {"row", "1", "first row of the frame in Points and in the point arrays", s->first_row},
    };
    int status = 0;
    for (size_t i = 0; status == 0 && i < sizeof numbers / sizeof *numbers; i++)
        // Signed where people compute with them: numpy turns uint64 + int into a float.
        status = put_dataset(
            group, numbers[i].name, numbers[i].values == s->digest ? H5T_STD_U64LE : H5T_STD_I64LE,
            H5T_NATIVE_UINT64, n, 0, numbers[i].values, numbers[i].unit, numbers[i].text);
    if (status == 0)
        status = put_dataset(group, "time", H5T_IEEE_F64LE, H5T_NATIVE_DOUBLE, n, 0, s->time, "s",
                             "time since the start of the last stage");
    if (status == 0)
        status = put_dataset(group, "fbar", H5T_STD_U8LE, H5T_NATIVE_UINT8, n, 0, s->fbar, "1",
                             "1 where F-bar was on");
    return H5Gclose(group) < 0 ? -1 : status;
}

static int close_all(struct store *s) {
    int status = 0;
    for (size_t i = 0; i < s->plan.n_fields; i++)
        if (s->arrays[i] >= 0 && H5Dclose(s->arrays[i]) < 0)
            status = -1;
    if (s->probes >= 0 && H5Gclose(s->probes) < 0)
        status = -1;
    if (s->fbard >= 0 && H5Gclose(s->fbard) < 0)
        status = -1;
    if (s->vtk >= 0 && H5Gclose(s->vtk) < 0)
        status = -1;
    if (s->file >= 0 && H5Fclose(s->file) < 0)
        status = -1;
    s->file = s->vtk = s->fbard = s->probes = -1;
    s->plan.n_fields = 0;
    return status;
}

int store_finish(struct store *s, char *why, size_t why_bytes) {
    int status = -1;
    if (s->n_added != s->plan.n_frames)
        snprintf(why, why_bytes, "%s: fewer frames than were planned", s->path);
    else if (put_topology(s) != 0 || put_steps(s) != 0 || put_frames(s) != 0 || close_all(s) != 0)
        store_fail(s->path, why, why_bytes);
    else
        status = 0;
    if (status == 0) {
        const int fd = open(s->path, O_RDONLY | O_CLOEXEC);
        if (fd < 0 || fsync(fd) != 0) {
            snprintf(why, why_bytes, "%s: %s", s->path, strerror(errno));
            status = -1;
        }
        if (fd >= 0)
            close(fd);
    }
    store_abandon(s);
    return status;
}

void store_abandon(struct store *s) {
    if (!s)
        return;
    close_all(s);
    free(s->path);
    free(s->seq);
    free(s->step);
    free(s->digest);
    free(s->epoch);
    free(s->count);
    free(s->first_row);
    free(s->time);
    free(s->fbar);
    free(s->padded);
    free(s);
}
