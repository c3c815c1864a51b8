// A request body to a scene to the solver's definition, and patches of it. What is refused has a
// fault with a pointer into the body; what is accepted is accepted again as it is given out, with
// the same result, and a small one can be created and stepped.
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "server/scene.h"
#include "tests/fuzz/fuzz.h"

#define SMALL 500 // particles
#define SMALL_NODES 20000
#define SMALL_BYTES ((size_t)64 << 20)

static void must_name_faults(const struct faults *faults) {
    FUZZ_MUST(faults->count > 0);
    for (size_t k = 0; k < faults->count; k++) {
        const struct fault *f = &faults->items[k];
        FUZZ_MUST(f->pointer[0] == '\0' || f->pointer[0] == '/');
        FUZZ_MUST(f->code[0] != '\0' && f->detail[0] != '\0');
    }
}

// Any end but a crash is good: a scene may blow up, but must say so.
static void try_steps(struct scene *scene) {
    struct mpm_estimate estimate;
    struct mpm_def *def = scene_def(scene);
    struct mpm_sim *sim = NULL;
    struct mpm_error error;
    mpm_estimate(def, &estimate);
    if (estimate.particles > SMALL || estimate.nodes > SMALL_NODES || estimate.bytes > SMALL_BYTES)
        return;
    def->n_threads = 1;
    def->memory_limit = SMALL_BYTES;
    if (mpm_create(def, &sim, &error) != MPM_OK)
        return;
    for (int k = 0; k < 3 && !mpm_finished(sim) && mpm_step(sim, &error) == MPM_OK; k++)
        continue;
    mpm_free(sim);
}

static void must_be_the_same_again(struct scene *scene) {
    struct faults faults = {0};
    char *text = json_print(scene_json(scene), false);
    cJSON *json = json_parse(text, strlen(text), &faults);
    struct scene *again = scene_create(json, &faults);
    FUZZ_MUST(again != NULL && faults.count == 0);
    char *twice = json_print(scene_json(again), false);
    FUZZ_MUST(strcmp(text, twice) == 0);
    free(text);
    free(twice);
    cJSON_Delete(json);
    scene_free(again);
    faults_free(&faults);
}

static void try_patch(const struct scene *scene, const cJSON *patch) {
    struct faults faults = {0};
    struct scene_config config;
    unsigned which;
    bool end, output;
    cJSON *patched =
        scene_config_patch(scene_json(scene), patch, &config, &which, &end, &output, &faults);
    if (patched == NULL)
        must_name_faults(&faults);
    else
        FUZZ_MUST(faults.count == 0);
    cJSON_Delete(patched);
    faults_free(&faults);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    struct faults faults = {0};
    cJSON *body = json_parse((const char *)data, size, &faults);
    if (body == NULL || !cJSON_IsObject(body)) {
        cJSON_Delete(body);
        faults_free(&faults);
        return 0;
    }
    // {"scene", "overrides", "patch"} as the API takes them, or a bare scene.
    const cJSON *given = json_member(body, "scene"), *over = json_member(body, "overrides");
    const char *name = cJSON_GetStringValue(given);
    cJSON *base = name != NULL    ? scene_builtin(name)
                  : given != NULL ? cJSON_Duplicate(given, true)
                                  : cJSON_Duplicate(body, true);
    cJSON *merged = over != NULL ? json_merge_patch(base, over) : cJSON_Duplicate(base, true);
    struct scene *scene = merged != NULL ? scene_create(merged, &faults) : NULL;
    if (scene != NULL) {
        FUZZ_MUST(faults.count == 0);
        must_be_the_same_again(scene);
        if (cJSON_IsObject(json_member(body, "patch")))
            try_patch(scene, json_member(body, "patch"));
        try_steps(scene);
    } else if (merged != NULL) {
        must_name_faults(&faults);
    }
    scene_free(scene);
    cJSON_Delete(merged);
    cJSON_Delete(base);
    cJSON_Delete(body);
    faults_free(&faults);
    return 0;
}
