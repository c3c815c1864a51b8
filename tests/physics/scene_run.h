// Built-in scenes run in a test: by name, with a merge patch, to a time; probes read by name.
#pragma once
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/scene.h"

struct scene_run {
    struct scene *scene;
    struct mpm_sim *sim;
    double before; // s, time before the last step
};

static inline struct scene_run scene_run_open(const char *name, const char *patch_text) {
    struct scene_run run = {0};
    struct faults faults = {0};
    cJSON *bare = scene_builtin(name);
    if (!bare)
        fail_msg("there is no scene %s", name);
    cJSON *patch = json_parse(patch_text, strlen(patch_text), &faults);
    cJSON *json = json_merge_patch(bare, patch);
    run.scene = scene_create(json, &faults);
    for (size_t k = 0; k < faults.count; k++)
        print_error("%s %s: %s: %s\n", name, patch_text, faults.items[k].pointer,
                    faults.items[k].detail);
    if (!run.scene)
        fail();
    struct mpm_error error;
    if (mpm_create(scene_def(run.scene), &run.sim, &error))
        fail_msg("%s: %s", error.pointer, error.message);
    cJSON_Delete(json);
    cJSON_Delete(patch);
    cJSON_Delete(bare);
    return run;
}

static inline void scene_run_close(struct scene_run *run) {
    mpm_free(run->sim);
    scene_free(run->scene);
    *run = (struct scene_run){0};
}

// To the first step that ends at `time` or later.
static inline void scene_run_to(struct scene_run *run, double time) {
    struct mpm_error error;
    while (mpm_time(run->sim) < time - 1e-12 && !mpm_finished(run->sim)) {
        run->before = mpm_time(run->sim);
        if (mpm_step(run->sim, &error))
            fail_msg("%s", error.message);
    }
}

static inline size_t scene_run_probe(const struct scene_run *run, const char *name) {
    const struct mpm_def *def = scene_def(run->scene);
    for (size_t k = 0; k < def->n_probes; k++)
        if (strcmp(def->probes[k].name, name) == 0)
            return k;
    fail_msg("the scene has no probe %s", name);
    return 0;
}

static inline double scene_run_component(const struct scene_run *run, const char *name, int c) {
    double value[MPM_MAX_COMPONENTS];
    mpm_probe_value(run->sim, scene_run_probe(run, name), value);
    return value[c];
}

static inline double scene_run_value(const struct scene_run *run, const char *name) {
    return scene_run_component(run, name, 0);
}

// Runs the scene to its end and reads every reference on the way; fails where one is not within its
// tolerance, of a reference of 0 where the value is above it. `loose` multiplies the tolerances.
static inline void scene_run_check(const char *name, const char *patch, double loose) {
    struct scene_run run = scene_run_open(name, patch);
    const struct mpm_def *def = scene_def(run.scene);
    size_t n, left, bad = 0;
    const struct scene_reference *references = scene_references(run.scene, &n);
    const double end = mpm_end_time(run.sim);
    bool *done = calloc(n + 1, sizeof *done);
    for (left = n; left > 0;) {
        size_t next = n;
        double at = INFINITY;
        for (size_t k = 0; k < n; k++) {
            const double when = references[k].at_end ? end : references[k].at;
            if (!done[k] && when < at) {
                at = when;
                next = k;
            }
        }
        const struct scene_reference *q = &references[next];
        double value[MPM_MAX_COMPONENTS];
        scene_run_to(&run, at); // a step is far below what any reference can tell
        mpm_probe_value(run.sim, q->probe, value);
        const double found = value[q->component];
        const double error = fabs(found - q->value) / (q->value != 0 ? fabs(q->value) : 1);
        const bool ok = error <= loose * q->tolerance;
        if (getenv("FBARD_LONG") || !ok)
            print_message("%-26s %-18s t = %-8.4g %12.6g, reference %12.6g: error %.2e of %.1e%s\n",
                          name, def->probes[q->probe].name, at, found, q->value, error,
                          loose * q->tolerance, ok ? "" : "  <- NOT WITHIN");
        bad += !ok;
        done[next] = true;
        left--;
    }
    free(done);
    scene_run_close(&run);
    if (bad)
        fail_msg("%zu references of %s do not hold", bad, name);
}
