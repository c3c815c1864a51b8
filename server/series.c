// Rows of doubles behind one lock. The log is a text header (names), padded, and then fixed-size
// rows, each with its own checksum, so that a row that a kill cut short is seen and dropped; its
// samples are taken again by the continued run.
#include "server/series.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include <xxhash.h>

#include "server/journal.h"

#define LOG_MAGIC "FBARPRB1"
#define TIME_SLACK 1e-9 // relative: times are sums or multiples of dt
#define VISIT_ROWS 1024 // copied at a time, so that who appends never waits for a reader
#define PREAMBLE 16     // magic, u32 header bytes, u32 zero

struct series {
    size_t n_probes, n_columns;
    struct series_probe *probes;
    pthread_mutex_t lock; // over what follows
    double *rows;         // (n_rows, 2 + n_columns): step as bits, time, values
    size_t n_rows, capacity, n_saved;
    char *path; // of the log that is to be, where it could not be begun yet
    int fd;
    off_t saved_bytes;
    size_t header_bytes;
};

static size_t row_doubles(const struct series *s) {
    return 2 + s->n_columns;
}
static uint64_t row_step(const double *row) {
    uint64_t step;
    memcpy(&step, row, sizeof step);
    return step;
}

static char *copied(const char *text) {
    return strdup(text != NULL ? text : "");
}

struct series *series_create(size_t n_probes, const char *const *names, const size_t *n_components,
                             const char *const *const *components) {
    struct series *s = calloc(1, sizeof *s);
    if (s == NULL)
        return NULL;
    pthread_mutex_init(&s->lock, NULL);
    s->fd = -1;
    s->probes = calloc(n_probes > 0 ? n_probes : 1, sizeof *s->probes);
    if (s->probes == NULL)
        goto fail;
    for (size_t k = 0; k < n_probes; k++) {
        struct series_probe *probe = &s->probes[k];
        s->n_probes = k + 1;
        probe->n_components = n_components[k];
        probe->column = s->n_columns;
        probe->name = copied(names[k]);
        probe->components = calloc(n_components[k] > 0 ? n_components[k] : 1, sizeof(char *));
        if (probe->name == NULL || probe->components == NULL)
            goto fail;
        for (size_t c = 0; c < n_components[k]; c++)
            if ((probe->components[c] = copied(components[k][c])) == NULL)
                goto fail;
        s->n_columns += n_components[k];
    }
    return s;
fail:
    series_free(s);
    return NULL;
}

void series_free(struct series *s) {
    if (s == NULL)
        return;
    for (size_t k = 0; k < s->n_probes; k++) {
        for (size_t c = 0; s->probes[k].components != NULL && c < s->probes[k].n_components; c++)
            free(s->probes[k].components[c]);
        free(s->probes[k].components);
        free(s->probes[k].name);
    }
    free(s->probes);
    free(s->rows);
    free(s->path);
    if (s->fd >= 0)
        close(s->fd);
    pthread_mutex_destroy(&s->lock);
    free(s);
}

size_t series_n_probes(const struct series *s) {
    return s->n_probes;
}
size_t series_n_columns(const struct series *s) {
    return s->n_columns;
}
const struct series_probe *series_probe(const struct series *s, size_t index) {
    return &s->probes[index];
}

// ---- The log ----------------------------------------------------------------------------------

static size_t log_row_bytes(const struct series *s) {
    return (row_doubles(s) + 1) * sizeof(double); // the checksum comes last
}

static char *header_text(const struct series *s) {
    cJSON *list = cJSON_CreateArray();
    for (size_t k = 0; k < s->n_probes; k++) {
        cJSON *probe = cJSON_CreateObject(), *components = cJSON_CreateArray();
        cJSON_AddStringToObject(probe, "name", s->probes[k].name);
        for (size_t c = 0; c < s->probes[k].n_components; c++)
            cJSON_AddItemToArray(components, cJSON_CreateString(s->probes[k].components[c]));
        cJSON_AddItemToObject(probe, "components", components);
        cJSON_AddItemToArray(list, probe);
    }
    char *text = json_print(list, false);
    cJSON_Delete(list);
    return text;
}

// 0 or errno.
static int write_at(int fd, const void *from, size_t n, off_t at) {
    size_t done = 0;
    while (done < n) {
        ssize_t wrote = pwrite(fd, (const char *)from + done, n - done, at + (off_t)done);
        if (wrote < 0 && errno != EINTR)
            return errno;
        if (wrote == 0)
            return EIO;
        done += wrote > 0 ? (size_t)wrote : 0;
    }
    return 0;
}

// A new log at s->path; 0 or errno.
static int log_begin(struct series *s) {
    char *text = header_text(s);
    int fd = open(s->path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    int error = text == NULL ? ENOMEM : fd < 0 ? errno : 0;
    uint32_t n = text != NULL ? (uint32_t)strlen(text) : 0;
    unsigned char preamble[PREAMBLE] = LOG_MAGIC;
    memcpy(preamble + 8, &n, sizeof n);
    if (error == 0)
        error = write_at(fd, preamble, PREAMBLE, 0);
    if (error == 0)
        error = write_at(fd, text, n, PREAMBLE);
    free(text);
    if (error != 0) {
        if (fd >= 0)
            close(fd);
        return error;
    }
    s->fd = fd;
    s->header_bytes = PREAMBLE + n;
    s->saved_bytes = (off_t)s->header_bytes;
    s->n_saved = 0;
    return 0;
}

int series_save_as(struct series *s, const char *path, char *why) {
    free(s->path);
    s->path = strdup(path);
    int error = s->path != NULL ? log_begin(s) : ENOMEM;
    if (error != 0)
        snprintf(why, JOURNAL_WHY, "%.400s: %s", path, strerror(error));
    return error != 0 ? -1 : 0;
}

static struct series *series_from_header(const char *text, size_t n) {
    struct faults faults = {0};
    cJSON *list = json_parse(text, n, &faults);
    size_t n_probes = list != NULL ? (size_t)cJSON_GetArraySize(list) : 0, k = 0;
    const char **names = calloc(n_probes + 1, sizeof *names);
    size_t *counts = calloc(n_probes + 1, sizeof *counts);
    const char ***components = calloc(n_probes + 1, sizeof *components);
    struct series *s = NULL;
    bool valid = list != NULL && names != NULL && counts != NULL && components != NULL;
    const cJSON *probe, *component;
    cJSON_ArrayForEach(probe, list) {
        const cJSON *array = json_member(probe, "components");
        if (!valid)
            break;
        names[k] = cJSON_GetStringValue(json_member(probe, "name"));
        components[k] = calloc((size_t)cJSON_GetArraySize(array) + 1, sizeof **components);
        valid = valid && names[k] != NULL && components[k] != NULL;
        cJSON_ArrayForEach(component, array) {
            if (!valid)
                break;
            components[k][counts[k]] = cJSON_GetStringValue(component);
            valid = valid && components[k][counts[k]] != NULL;
            counts[k]++;
        }
        k++;
    }
    if (valid)
        s = series_create(n_probes, names, counts, (const char *const *const *)components);
    for (k = 0; components != NULL && k < n_probes; k++)
        free(components[k]);
    free(components);
    free(counts);
    free(names);
    cJSON_Delete(list);
    faults_free(&faults);
    return s;
}

static bool rows_reserve(struct series *s, size_t n) {
    if (n <= s->capacity)
        return true;
    size_t larger = s->capacity < 64 ? 64 : s->capacity * 2;
    while (larger < n)
        larger *= 2;
    double *moved = realloc(s->rows, larger * row_doubles(s) * sizeof(double));
    if (moved == NULL)
        return false;
    s->rows = moved;
    s->capacity = larger;
    return true;
}

struct series *series_load(const char *path, char *why) {
    int fd = open(path, O_RDWR | O_CLOEXEC);
    struct stat info;
    unsigned char preamble[PREAMBLE];
    struct series *s = NULL;
    char *block = NULL;
    uint32_t n;
    if (fd < 0 || fstat(fd, &info) != 0 || pread(fd, preamble, PREAMBLE, 0) != PREAMBLE ||
        memcmp(preamble, LOG_MAGIC, 8) != 0)
        goto fail;
    memcpy(&n, preamble + 8, sizeof n);
    if ((uint64_t)info.st_size < PREAMBLE + (uint64_t)n)
        goto fail;
    size_t bytes = (size_t)info.st_size - PREAMBLE;
    block = malloc(bytes + 1);
    if (block == NULL || pread(fd, block, bytes, PREAMBLE) != (ssize_t)bytes ||
        (s = series_from_header(block, n)) == NULL)
        goto fail;
    size_t size = log_row_bytes(s), count = (bytes - n) / size, data = size - sizeof(uint64_t);
    if (!rows_reserve(s, count))
        goto fail;
    for (size_t k = 0; k < count; k++) {
        const char *row = block + n + k * size;
        uint64_t check;
        memcpy(&check, row + data, sizeof check);
        if (check != XXH3_64bits(row, data))
            break; // what follows is sampled again
        memcpy(s->rows + k * row_doubles(s), row, data);
        s->n_rows = k + 1;
    }
    s->fd = fd;
    s->n_saved = s->n_rows;
    s->header_bytes = PREAMBLE + n;
    s->saved_bytes = (off_t)(s->header_bytes + s->n_rows * size);
    free(block);
    if (ftruncate(fd, s->saved_bytes) == 0)
        return s;
    fd = -1; // now the series'
    block = NULL;
fail:
    snprintf(why, JOURNAL_WHY, "%.400s: no whole log of probes", path);
    free(block);
    series_free(s);
    if (fd >= 0)
        close(fd);
    return NULL;
}

int series_flush(struct series *s) {
    pthread_mutex_lock(&s->lock);
    size_t n = s->n_rows - s->n_saved, size = log_row_bytes(s), data = size - sizeof(uint64_t);
    char *block = NULL;
    int error = s->fd < 0 && s->path != NULL ? log_begin(s) : 0;
    if (error == 0 && n > 0 && s->fd >= 0) {
        block = malloc(n * size);
        error = block == NULL ? ENOMEM : 0;
    }
    for (size_t k = 0; block != NULL && k < n; k++) {
        memcpy(block + k * size, s->rows + (s->n_saved + k) * row_doubles(s), data);
        uint64_t check = XXH3_64bits(block + k * size, data);
        memcpy(block + k * size + data, &check, sizeof check);
    }
    off_t at = s->saved_bytes;
    pthread_mutex_unlock(&s->lock);
    if (block == NULL)
        return error;
    // Only the appending thread flushes, so that the rows stay; readers are not held up by the
    // disk.
    error = write_at(s->fd, block, n * size, at);
    free(block);
    pthread_mutex_lock(&s->lock);
    if (error == 0) {
        s->n_saved += n;
        s->saved_bytes += (off_t)(n * size);
    }
    pthread_mutex_unlock(&s->lock);
    return error;
}

int series_sync(struct series *s) {
    return s->fd >= 0 && fdatasync(s->fd) != 0 ? errno : 0;
}

size_t series_unsaved(struct series *s) {
    pthread_mutex_lock(&s->lock);
    size_t n = s->n_rows - s->n_saved;
    pthread_mutex_unlock(&s->lock);
    return n;
}

// ---- Rows -------------------------------------------------------------------------------------

// First row with step > `step`, by bisection: steps only grow.
static size_t row_after(const struct series *s, uint64_t step) {
    size_t low = 0, high = s->n_rows;
    while (low < high) {
        size_t middle = low + (high - low) / 2;
        if (row_step(s->rows + middle * row_doubles(s)) <= step)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

enum series_verdict series_append(struct series *s, uint64_t step, double time,
                                  const double *values) {
    enum series_verdict verdict = SERIES_APPENDED;
    pthread_mutex_lock(&s->lock);
    size_t at = row_after(s, step), width = row_doubles(s);
    double *there = at > 0 ? s->rows + (at - 1) * width : NULL;
    bool known = there != NULL && row_step(there) == step;
    if (known && memcmp(there + 1, &time, sizeof time) == 0 &&
        memcmp(there + 2, values, s->n_columns * sizeof *values) == 0) {
        verdict = SERIES_SAME;
    } else {
        if (known || at < s->n_rows) {
            verdict = SERIES_DIFFERENT;
            s->n_rows = known ? at - 1 : at;
            if (s->n_saved > s->n_rows) {
                s->n_saved = s->n_rows;
                s->saved_bytes = (off_t)(s->header_bytes + s->n_saved * log_row_bytes(s));
                int ignored = s->fd >= 0 ? ftruncate(s->fd, s->saved_bytes) : 0;
                (void)ignored; // else overwritten row by row, and the rest cut by its steps
            }
        }
        if (rows_reserve(s, s->n_rows + 1)) { // without memory the row is missing, the run goes on
            double *row = s->rows + s->n_rows * width;
            memcpy(row, &step, sizeof step);
            row[1] = time;
            memcpy(row + 2, values, s->n_columns * sizeof *values);
            s->n_rows++;
        }
    }
    pthread_mutex_unlock(&s->lock);
    return verdict;
}

size_t series_n_rows(struct series *s) {
    pthread_mutex_lock(&s->lock);
    size_t n = s->n_rows;
    pthread_mutex_unlock(&s->lock);
    return n;
}

bool series_at_step(struct series *s, uint64_t step, uint64_t *found_step, double *time,
                    double *values) {
    pthread_mutex_lock(&s->lock);
    size_t after = row_after(s, step);
    if (after > 0) {
        const double *row = s->rows + (after - 1) * row_doubles(s);
        *found_step = row_step(row);
        *time = row[1];
        memcpy(values, row + 2, s->n_columns * sizeof *values);
    }
    pthread_mutex_unlock(&s->lock);
    return after > 0;
}

cJSON *series_values(struct series *s, uint64_t step) {
    cJSON *object = cJSON_CreateObject();
    double time, *values = calloc(s->n_columns + 1, sizeof *values);
    uint64_t found;
    bool known = values != NULL && series_at_step(s, step, &found, &time, values);
    for (size_t k = 0; k < s->n_probes; k++) {
        const struct series_probe *probe = &s->probes[k];
        bool scalar = probe->n_components == 1 && probe->components[0][0] == '\0';
        cJSON *inside = scalar ? object : cJSON_AddObjectToObject(object, probe->name);
        for (size_t c = 0; c < probe->n_components; c++)
            cJSON_AddItemToObject(inside, scalar ? probe->name : probe->components[c],
                                  json_number(known ? values[probe->column + c] : NAN));
    }
    free(values);
    return object;
}

bool series_at_time(struct series *s, size_t column, double time, double *value) {
    pthread_mutex_lock(&s->lock);
    size_t width = row_doubles(s), low = 0, high = s->n_rows;
    while (low < high) { // first row at or after `time`
        size_t middle = low + (high - low) / 2;
        if (s->rows[middle * width + 1] < time)
            low = middle + 1;
        else
            high = middle;
    }
    if (low == s->n_rows && low > 0 &&
        time - s->rows[(low - 1) * width + 1] <= TIME_SLACK * (1 + fabs(time)))
        low--; // the end time that was asked for, but for rounding
    bool found = low < s->n_rows && (low > 0 || s->rows[1] <= time);
    if (found) {
        const double *b = s->rows + low * width, *a = low > 0 ? b - width : b;
        double span = b[1] - a[1], weight = span > 0 ? fmin((time - a[1]) / span, 1) : 1;
        double left = a[2 + column], right = b[2 + column];
        *value = weight >= 1 ? right : left + weight * (right - left);
    }
    pthread_mutex_unlock(&s->lock);
    return found;
}

void series_visit(struct series *s, bool all, uint64_t after,
                  void (*visit)(void *context, const struct series_row *row), void *context) {
    size_t width = row_doubles(s), n;
    double *some = malloc(VISIT_ROWS * width * sizeof *some);
    do {
        pthread_mutex_lock(&s->lock);
        size_t from = all ? 0 : row_after(s, after);
        n = some == NULL ? 0 : s->n_rows - from < VISIT_ROWS ? s->n_rows - from : VISIT_ROWS;
        if (n > 0)
            memcpy(some, s->rows + from * width, n * width * sizeof *some);
        pthread_mutex_unlock(&s->lock);
        for (size_t k = 0; k < n; k++) {
            const double *row = some + k * width;
            after = row_step(row);
            visit(context, &(struct series_row){.step = after, .time = row[1], .values = row + 2});
        }
        all = false;
    } while (n == VISIT_ROWS);
    free(some);
}

void series_rest(struct series *s) {
    if (s == NULL)
        return;
    pthread_mutex_lock(&s->lock);
    if (s->fd >= 0)
        close(s->fd);
    s->fd = -1;
    free(s->path);
    s->path = NULL;
    double *moved =
        s->n_rows > 0 ? realloc(s->rows, s->n_rows * row_doubles(s) * sizeof *moved) : NULL;
    if (moved != NULL) {
        s->rows = moved;
        s->capacity = s->n_rows;
    }
    pthread_mutex_unlock(&s->lock);
}
