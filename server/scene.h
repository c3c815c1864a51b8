// Scenes: JSON (docs/scene.md) -> struct mpm_def, from one table of keys that also gives the JSON
// Schema.
#pragma once
#include <cjson/cJSON.h>

#include "server/json.h"
#include "server/mpm/mpm.h"

struct scene_output {
    double interval;            // s of simulated time between frames
    double probe_interval;      // s of simulated time between samples of the probes
    double checkpoint_interval; // s of wall time
    double journal_bytes;       // budget of the frames on disk
    bool when_full_block;       // true "block", false "fail"
    bool durability_power;      // true "power", false "process"
    size_t n_fields;
    enum mpm_field fields[MPM_N_FIELDS]; // always begins with position
};
// What PATCH /v1/runs/{id}/config reaches.
struct scene_config {
    struct mpm_settings settings;
    double end; // s
    struct scene_output output;
};
struct scene_reference {
    size_t probe;  // index in the definition
    int component; // of a vector probe, else 0
    bool at_end;
    double at;               // s, where not at_end
    double value, tolerance; // tolerance relative
    const char *source;
};

struct scene; // a valid scene: definition, output, references, and its JSON

// Checks `json` against the table and the solver's own checks (mpm_check), and adds every fault.
// NULL when there is any. `json` is copied.
struct scene *scene_create(const cJSON *json, struct faults *faults);
// The same in two halves. The first holds it against the table only, quickly; it adds the solver's
// faults where the table finds some, so that all are told at once. The second asks the solver, who
// fills the shapes with particles; what would need more than `memory_limit` bytes (0: any) is a
// fault. False with faults; then the scene is still the caller's.
struct scene *scene_read(const cJSON *json, size_t memory_limit, struct faults *faults);
bool scene_examine(struct scene *scene, size_t memory_limit, struct faults *faults);
void scene_free(struct scene *scene);

struct mpm_def *scene_def(
    struct scene *scene); // owned by the scene; threads, clock, limits are the caller's to set
const cJSON *
scene_json(const struct scene *scene); // as run: defaults filled in; owned by the scene
const char *scene_title(const struct scene *scene);
const struct scene_config *scene_config(const struct scene *scene);
const struct scene_reference *scene_references(const struct scene *scene, size_t *count);

// The settable part of `scene_as_run` (an object of the same shape as the scene: fbar, damping,
// transfer, time, gravity, output), new.
cJSON *scene_config_json(const cJSON *scene_as_run);
// Applies a merge patch to the settable part. On success returns a new "scene as run" with the
// patch in it, fills `out` and sets in `which` the bits of enum mpm_setting that the patch touches
// (`end_changed`, `output_changed` likewise); NULL with faults when the patch reaches anything else
// or is invalid.
cJSON *scene_config_patch(const cJSON *scene_as_run, const cJSON *patch, struct scene_config *out,
                          unsigned *which, bool *end_changed, bool *output_changed,
                          struct faults *faults);

// JSON Schema 2020-12 of a scene; new.
cJSON *scene_schema(void);
// The same of a merge patch of what may change while a run goes on, new.
cJSON *scene_patch_schema(void);
// The tables of keys in docs/scene.md, Markdown; freed with free. A unit test compares the two.
char *scene_reference_markdown(void);
// GET /v1/materials: {"materials": [{name, description, parameters: [...]}]}; new.
cJSON *scene_materials_json(void);

// Built-in scenes: the files of scenes/, embedded at build.
size_t scene_builtin_count(void);
const char *scene_builtin_name(size_t index);
const char *scene_builtin_text(size_t index, size_t *bytes); // the file's JSON
// Parsed; new; NULL when there is none of that name.
cJSON *scene_builtin(const char *name);
