// The table of every key that a scene can hold. Validation and defaults (scene_check.c), the JSON
// Schema and the reference in docs/scene.md (scene_schema.c) all read it; nothing else lists keys.
#pragma once
#include <stdbool.h>
#include <stddef.h>

#include "server/mpm/mpm.h"

// What nonsense may not exceed; a scene is refused before anything of this size is built.
#define SCENE_MAX_NAMED 1000 // materials, bodies, walls, loads, probes, ...: each
#define SCENE_MAX_POINTS 10000000
#define SCENE_MAX_OUTLINE 1000 // points of a polygon; every edge is held against every other
#define SCENE_MAX_SHAPE_DEPTH 16
#define SCENE_MAX_TEXT 200 // characters
#define SCENE_NAME_PATTERN "^[A-Za-z_][A-Za-z0-9_-]{0,63}$"
#define SCENE_MAX_PARTICLES_PER_DIRECTION 32

enum scene_type {
    SCENE_BOOL,
    SCENE_NUMBER,
    SCENE_INTEGER,
    SCENE_LATTICE, // an integer n^dimension
    SCENE_TEXT,
    SCENE_CHOICE,         // one of a list of words
    SCENE_NAME,           // names a member of the scene's map `of`
    SCENE_VECTOR,         // `dimension` numbers
    SCENE_POINTS,         // rows of a position and a volume
    SCENE_OUTLINE,        // the corners [x, y] of a polygon
    SCENE_OBJECT,         // `keys`
    SCENE_ONE_KEY,        // an object with exactly one of `keys`
    SCENE_MAP,            // an object of `items` keyed by name
    SCENE_LIST,           // an array of `items`
    SCENE_EITHER,         // `items`, `n_items` of them, that differ in their JSON type
    SCENE_MATERIAL,       // keys by `model`: scene_material_keys
    SCENE_MATERIAL_PATCH, // a merge patch of the scene's materials
};

struct scene_value {
    enum scene_type type;
    const char *unit;
    double min, max; // of numbers; -INFINITY, INFINITY where there is none
    bool min_open, max_open;
    const char *(*choice)(size_t index); // NULL past the last
    const char *of;
    const struct scene_key *keys; // ends with a NULL name
    const struct scene_value *items;
    size_t n_items;
    bool unique;            // no item of a list twice
    bool nonzero;           // a vector that has a direction
    bool ordered;           // an object with min < max in every component
    const char *section;    // heading of the object's keys in docs/scene.md
    const char *definition; // name in the schema's $defs, of a value that contains itself
};
struct scene_key {
    const char *name;
    struct scene_value value;
    bool required;
    bool nullable; // null is as good as absent, so that a merge patch inside an array can say it
    bool live;     // may be patched while the run goes on; of an object: all of its keys
    // The default as JSON; or "0" of a vector, for every component; "end / n" of `time.end`;
    // "2^dimension". NULL: what happens without the key is said in `doc`.
    const char *fallback;
    const char *excludes; // sibling that may not be there as well; the default gives way to it
    int dimension;        // 2 or 3: only there; 0: both
    // Where a choice among the siblings (the key `selector`) decides: bit i for the i-th choice.
    unsigned only, needs; // allowed for these (0 = all), required for these
    bool selector;
    const char *doc;
};

extern const struct scene_value scene_root;

// Keys of one material model: `model`, `fbar` and the parameters of the model's own table, written
// to `keys` (room for SCENE_MATERIAL_KEYS), with the text of defaults in `texts`.
#define SCENE_MATERIAL_KEYS (MPM_MAX_PARAMETERS + 3)
struct scene_material_keys {
    struct scene_key keys[SCENE_MATERIAL_KEYS];
    char texts[MPM_MAX_PARAMETERS][32];
};
void scene_material_keys(const struct mpm_material *model, struct scene_material_keys *out);
const char *scene_model_choice(size_t index);

const char *scene_axis_choice(size_t index);
// Position of `text` among the choices, or -1.
int scene_choice_index(const struct scene_value *value, const char *text);
// "one of slip, fixed", "a number > 0 in m", ...: what the value must be.
void scene_describe(const struct scene_value *value, char *out, size_t n);
