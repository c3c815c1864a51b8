// One scene, run to its end in this process and measured: what the studies of hard cases and of speed
// against error run many of.
//
//     runner SCENE [--patch JSON] [--samples N] [--steps N] [--seconds S] [--threads N]
//
// SCENE is a built-in scene or a file. On stdout one JSON object: how it ended (as the daemon would say
// it), and at N equally spaced times of the last stage and at its end every probe, the balance, the drift
// and whether all fields are finite. Exit code 0 whenever that object was printed, failed run or not; 2 for
// a scene that is refused (its faults on stderr). The step loop alone is timed, in wall and in processor
// seconds; S limits the latter.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "server/scene.h"

static double seconds(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static char *read_file(const char *path) {
    FILE *file = fopen(path, "rb");
    if (file == NULL)
        return NULL;
    char *text = NULL;
    size_t n = 0;
    for (size_t got = 1; got > 0; n += got) {
        text = realloc(text, n + 65537);
        if (text == NULL)
            exit(4);
        got = fread(text + n, 1, 65536, file);
    }
    text[n] = '\0';
    fclose(file);
    return text;
}

static cJSON *read_scene(const char *name) {
    cJSON *json = scene_builtin(name);
    char *text = json == NULL ? read_file(name) : NULL;
    struct faults faults = {0};
    if (text != NULL)
        json = json_parse(text, strlen(text), &faults);
    free(text);
    faults_free(&faults);
    return json;
}

static void add(cJSON *to, const char *key, double value) {
    if (isfinite(value))
        cJSON_AddNumberToObject(to, key, value);
    else
        cJSON_AddStringToObject(to, key, isnan(value) ? "nan" : value > 0 ? "inf" : "-inf");
}

static bool all_finite(const struct mpm_sim *sim, int dimension) {
    static const enum mpm_field fields[] = {MPM_FIELD_POSITION, MPM_FIELD_VELOCITY,
                                            MPM_FIELD_STRESS, MPM_FIELD_VOLUME_RATIO_BAR};
    const size_t n = mpm_n_particles(sim);
    bool finite = true;
    double *values = malloc((n + 1) * 9 * sizeof *values);
    if (values == NULL)
        exit(4);
    for (size_t k = 0; k < sizeof fields / sizeof *fields && finite; k++) {
        const size_t components = mpm_field_components(fields[k], dimension);
        mpm_field_copy(sim, fields[k], values);
        for (size_t i = 0; i < n * components; i++)
            finite = finite && isfinite(values[i]);
    }
    free(values);
    return finite;
}

static void sample(struct mpm_sim *sim, const struct mpm_def *def, cJSON *series) {
    cJSON *row = cJSON_CreateObject(), *probes, *list;
    add(row, "time", mpm_time(sim));
    cJSON_AddNumberToObject(row, "step", (double)mpm_step_count(sim));
    cJSON_AddBoolToObject(row, "finite", all_finite(sim, def->dimension));
    add(row, "drift", mpm_drift(sim));
    struct mpm_balance balance;
    mpm_balance(sim, &balance);
    add(row, "kinetic", balance.kinetic_energy);
    add(row, "strain", balance.strain_energy);
    add(row, "potential", balance.potential_energy);
    add(row, "work", balance.external_work);
    list = cJSON_AddArrayToObject(row, "momentum");
    for (int d = 0; d < def->dimension; d++)
        cJSON_AddItemToArray(list, cJSON_CreateNumber(balance.momentum[d]));
    list = cJSON_AddArrayToObject(row, "angular_momentum");
    for (int d = def->dimension == 2 ? 2 : 0; d < 3; d++)
        cJSON_AddItemToArray(list, cJSON_CreateNumber(balance.angular_momentum[d]));
    probes = cJSON_AddObjectToObject(row, "probes");
    for (size_t k = 0; k < def->n_probes; k++) {
        double value[MPM_MAX_COMPONENTS];
        mpm_probe_value(sim, k, value);
        const size_t n = mpm_probe_components(sim, k);
        for (size_t c = 0; c < n; c++) {
            char key[200];
            snprintf(key, sizeof key, n > 1 ? "%s.%s" : "%s", def->probes[k].name,
                     mpm_probe_component_name(sim, k, c));
            add(probes, key, value[c]);
        }
    }
    cJSON_AddItemToArray(series, row);
}

static const char *option(int argc, char **argv, const char *name, const char *fallback) {
    for (int k = 2; k + 1 < argc; k++)
        if (strcmp(argv[k], name) == 0)
            return argv[k + 1];
    return fallback;
}

int main(int argc, char **argv) {
    if (argc < 2) {
        fprintf(stderr, "usage: %s SCENE [--patch JSON] [--samples N] [--steps N] [--seconds S] "
                        "[--threads N]\n",
                argv[0]);
        return 2;
    }
    const char *patch_text = option(argc, argv, "--patch", "{}");
    const double n_samples = fmax(1, atof(option(argc, argv, "--samples", "1")));
    const double most_steps = atof(option(argc, argv, "--steps", "1e18"));
    const double most_seconds = atof(option(argc, argv, "--seconds", "1e9"));

    struct faults faults = {0};
    cJSON *json = read_scene(argv[1]), *patch = json_parse(patch_text, strlen(patch_text), &faults);
    if (json == NULL || patch == NULL) {
        fprintf(stderr, "%s: %s\n", argv[0],
                json == NULL ? "there is no such scene" : "the patch is no JSON");
        return 2;
    }
    cJSON *merged = json_merge_patch(json, patch);
    struct scene *scene = scene_create(merged, &faults);
    for (size_t k = 0; k < faults.count; k++)
        fprintf(stderr, "%s: %s\n", faults.items[k].pointer, faults.items[k].detail);
    if (scene == NULL)
        return 2;
    struct mpm_def *def = scene_def(scene);
    def->n_threads = atoi(option(argc, argv, "--threads", "1"));
    struct mpm_sim *sim;
    struct mpm_error error = {0};
    if (mpm_create(def, &sim, &error)) {
        fprintf(stderr, "%s: %s\n", error.pointer, error.message);
        return 2;
    }

    cJSON *out = cJSON_CreateObject(), *series = cJSON_AddArrayToObject(out, "series");
    const double end = mpm_end_time(sim), dt = mpm_next_dt(sim), limit = mpm_dt_limit(sim);
    double wall = 0, cpu = 0, next = 0;
    const char *outcome = "completed";
    sample(sim, def, series);
    for (double k = 0; !mpm_finished(sim);) {
        const double since = seconds(CLOCK_MONOTONIC), cpu_since = seconds(CLOCK_PROCESS_CPUTIME_ID);
        enum mpm_status status = MPM_OK;
        // The clock is looked at once in 64 steps.
        for (int i = 0; i < 64 && !mpm_finished(sim) && mpm_time(sim) < next - 1e-9 * dt &&
                        (double)mpm_step_count(sim) < most_steps && !status;
             i++)
            status = mpm_step(sim, &error);
        wall += seconds(CLOCK_MONOTONIC) - since;
        cpu += seconds(CLOCK_PROCESS_CPUTIME_ID) - cpu_since;
        if (status) {
            outcome = "failed";
            cJSON *problem = cJSON_AddObjectToObject(out, "error");
            cJSON_AddStringToObject(problem, "kind", mpm_status_name(status));
            cJSON_AddNumberToObject(problem, "step", (double)error.step);
            cJSON_AddNumberToObject(problem, "time", error.time);
            cJSON_AddNumberToObject(problem, "particle", (double)error.particle);
            cJSON_AddStringToObject(problem, "quantity", error.quantity ? error.quantity : "");
            add(problem, "value", error.value);
            break;
        }
        if ((double)mpm_step_count(sim) >= most_steps || cpu > most_seconds) {
            outcome = cpu > most_seconds ? "out of time" : "stopped";
            break;
        }
        if (mpm_time(sim) >= next - 1e-9 * dt && !mpm_finished(sim)) {
            if (mpm_time(sim) >= 0 && mpm_step_count(sim) > 0)
                sample(sim, def, series);
            while (next <= mpm_time(sim) + 1e-9 * dt)
                next = end * ++k / n_samples;
        }
    }
    if (strcmp(outcome, "failed") != 0)
        sample(sim, def, series);
    cJSON_AddStringToObject(out, "outcome", outcome);
    cJSON_AddNumberToObject(out, "steps", (double)mpm_step_count(sim));
    cJSON_AddNumberToObject(out, "particles", (double)mpm_n_particles(sim));
    add(out, "time", mpm_time(sim));
    add(out, "wall_s", wall);
    add(out, "cpu_s", cpu);
    add(out, "dt", dt);
    add(out, "dt_limit", limit);
    char *text = cJSON_PrintUnformatted(out);
    puts(text);
    free(text);
    cJSON_Delete(out);
    cJSON_Delete(merged);
    cJSON_Delete(json);
    cJSON_Delete(patch);
    mpm_free(sim);
    scene_free(scene);
    return 0;
}
