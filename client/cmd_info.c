// fbar info: what a recording holds.
#include <cjson/cJSON.h>
#include <stdio.h>
#include <sys/stat.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/report.h"
#include "client/store.h"
#include "client/terminal.h"

static size_t most_particles(const struct store_contents *c) {
    size_t most = 0;
    for (size_t i = 0; i < c->n_frames; i++)
        if (c->count[i] > most)
            most = c->count[i];
    return most;
}

static void print_json(const char *file, const struct store_contents *c, double bytes) {
    const size_t last = c->n_frames ? c->n_frames - 1 : 0;
    cJSON *answer = cJSON_CreateObject(), *arrays;
    cJSON_AddStringToObject(answer, "file", file);
    cJSON_AddNumberToObject(answer, "bytes", bytes);
    cJSON_AddStringToObject(answer, "format", c->format);
    cJSON_AddStringToObject(answer, "run", c->run);
    cJSON_AddStringToObject(answer, "code_version", c->code_version);
    cJSON_AddStringToObject(answer, "state", c->state);
    cJSON_AddBoolToObject(answer, "complete", c->complete);
    cJSON_AddNumberToObject(answer, "dimension", c->dimension);
    cJSON_AddNumberToObject(answer, "frames", (double)c->n_frames);
    cJSON_AddNumberToObject(answer, "particles", (double)most_particles(c));
    cJSON_AddNumberToObject(answer, "probes", (double)c->n_probes);
    cJSON_AddNumberToObject(answer, "changes", (double)c->n_changes);
    if (c->n_frames) {
        cJSON_AddNumberToObject(answer, "first_time", c->time[0]);
        cJSON_AddNumberToObject(answer, "last_time", c->time[last]);
        cJSON_AddNumberToObject(answer, "first_step", (double)c->step[0]);
        cJSON_AddNumberToObject(answer, "last_step", (double)c->step[last]);
    }
    arrays = cJSON_AddArrayToObject(answer, "fields");
    for (size_t i = 0; i < c->n_arrays; i++) {
        cJSON *array = cJSON_CreateObject();
        cJSON_AddStringToObject(array, "name", c->arrays[i].name);
        cJSON_AddStringToObject(array, "unit", c->arrays[i].unit);
        cJSON_AddStringToObject(array, "dtype", c->arrays[i].dtype);
        cJSON_AddNumberToObject(array, "components", (double)c->arrays[i].components);
        cJSON_AddStringToObject(array, "long_name", c->arrays[i].long_name);
        cJSON_AddItemToArray(arrays, array);
    }
    report_json(answer);
    cJSON_Delete(answer);
}

static void print_text(const char *file, const struct store_contents *c, double bytes) {
    const size_t last = c->n_frames ? c->n_frames - 1 : 0;
    size_t on = 0;
    printf("%s: run %s, %s%s, fbard %s, %.1f MB\n", file, c->run, c->state,
           c->complete ? "" : " (recording not complete)", c->code_version, 1e-6 * bytes);
    printf("  %zu frames of %zu particles in %dD", c->n_frames, most_particles(c), c->dimension);
    if (c->n_frames)
        printf(", t = %.4g .. %.4g s, steps %llu .. %llu", c->time[0], c->time[last],
               (unsigned long long)c->step[0], (unsigned long long)c->step[last]);
    for (size_t i = 0; i < c->n_frames; i++)
        on += c->fbar[i];
    printf("\n  F-bar %s, %zu changes of parameters, %zu probes\n",
           on == c->n_frames ? "on"
           : on == 0         ? "off"
                             : "on in some frames",
           c->n_changes, c->n_probes);
    for (size_t i = 0; i < c->n_arrays; i++) {
        const struct store_array *a = &c->arrays[i];
        printf("  %-18s %s x %zu  %-7s %s\n", a->name, a->dtype, a->components, a->unit,
               a->long_name);
    }
}

static int run(struct client *client, const struct arguments *arguments) {
    char why[512];
    bool foreign;
    struct stat status;
    const char *file = arguments->positionals[0];
    struct store_file *h5 = store_open(file, &foreign, why, sizeof why);
    if (!h5) {
        terminal_error("%s", why);
        return CLIENT_IO;
    }
    const double bytes = stat(file, &status) == 0 ? (double)status.st_size : 0;
    if (client->json)
        print_json(file, store_contents(h5), bytes);
    else
        print_text(file, store_contents(h5), bytes);
    store_close(h5);
    return CLIENT_DONE;
}

const struct command cmd_info = {
    .name = "info",
    .positionals = "FILE.h5",
    .summary = "tell what a recording holds",
    .least = 1,
    .most = 1,
    .run = run,
};
