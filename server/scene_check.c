// Walks a scene along the table of keys (scene_keys.c). Faults carry the JSON pointer of the place,
// a code and what was expected; the pointer's text is built only when there is one.
#include "server/scene_check.h"

#include <ctype.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/scene_fault.h"
#include "server/scene_keys.h"
#include "server/scene_tables.h"

struct check {
    cJSON *root;
    struct faults *faults;
    int dimension; // 0 while it is not known
    double end;    // s, 0 while it is not known
    int shape_depth;
};

static void check_value(struct check *check, const struct scene_value *value, cJSON *json,
                        const struct scene_cursor *at);

static void type_fault(struct check *check, const struct scene_cursor *at,
                       const struct scene_value *value, const cJSON *json) {
    char expected[400];
    scene_describe(value, expected, sizeof expected);
    scene_value_fault(check->faults, at, "type", expected, json);
}

static void unknown_key(struct check *check, const struct scene_key *keys, const char *name,
                        const struct scene_cursor *at) {
    struct scene_suggestion s = {.word = name};
    char expected[400] = "one of";
    if (check->faults->count >= FAULTS_MAX) { // only counted: no need to look for what was meant
        check->faults->more++;
        return;
    }
    for (const struct scene_key *key = keys; key->name; key++) {
        if (key->dimension && check->dimension && key->dimension != check->dimension)
            continue;
        scene_suggest(&s, key->name);
        size_t length = strlen(expected);
        snprintf(expected + length, sizeof expected - length, "%s%s", key == keys ? " " : ", ",
                 key->name);
    }
    scene_unknown_fault(check->faults, at, "unknown_key", expected, "there is no key", &s);
}

// ---- Single values ------------------------------------------------------------------------------

static bool is_number(const cJSON *json) {
    return cJSON_IsNumber(json) && isfinite(json->valuedouble);
}

static void check_number(struct check *check, const struct scene_value *value, const cJSON *json,
                         const struct scene_cursor *at) {
    if (!is_number(json)) {
        type_fault(check, at, value, json);
        return;
    }
    double x = json->valuedouble;
    char expected[160];
    scene_describe(value, expected, sizeof expected);
    if (value->type == SCENE_INTEGER && x != floor(x))
        scene_value_fault(check->faults, at, "type", expected, json);
    else if (x < value->min || x > value->max || (value->min_open && x == value->min) ||
             (value->max_open && x == value->max))
        scene_value_fault(check->faults, at, "range", expected, json);
}

// n^dimension for some n >= 1; otherwise the two nearest are named.
static void check_lattice(struct check *check, const cJSON *json, const struct scene_cursor *at) {
    int dimension = check->dimension ? check->dimension : 2;
    if (!is_number(json) || json->valuedouble != floor(json->valuedouble)) {
        scene_value_fault(check->faults, at, "type", "an integer n^dimension", json);
        return;
    }
    double x = json->valuedouble;
    double most = pow(SCENE_MAX_PARTICLES_PER_DIRECTION, dimension);
    double n = round(pow(fmin(fmax(x, 1), most), 1.0 / dimension));
    if (x == pow(n, dimension) || !check->dimension)
        return;
    char expected[80];
    double low = pow(n, dimension) < x ? n : n - 1;
    if (x < 1 || x > most)
        snprintf(expected, sizeof expected, "n^%d from 1 to %.15g", dimension, most);
    else
        snprintf(expected, sizeof expected, "n^%d; the nearest are %.15g and %.15g", dimension,
                 pow(low, dimension), pow(low + 1, dimension));
    scene_value_fault(check->faults, at, "range", expected, json);
}

static void check_text(struct check *check, const struct scene_value *value, const cJSON *json,
                       const struct scene_cursor *at) {
    if (!cJSON_IsString(json)) {
        type_fault(check, at, value, json);
        return;
    }
    size_t characters = 0;
    for (const char *c = json->valuestring; *c; c++)
        characters += ((unsigned char)*c & 0xC0) != 0x80;
    char expected[64];
    snprintf(expected, sizeof expected, "at most %d characters", SCENE_MAX_TEXT);
    if (characters > SCENE_MAX_TEXT)
        scene_value_fault(check->faults, at, "length", expected, json);
}

static void check_choice(struct check *check, const struct scene_value *value, const cJSON *json,
                         const struct scene_cursor *at) {
    if (!cJSON_IsString(json)) {
        type_fault(check, at, value, json);
        return;
    }
    int index = scene_choice_index(value, json->valuestring);
    bool is_axis = value->choice == scene_axis_choice;
    char expected[400];
    scene_describe(value, expected, sizeof expected);
    if (index < 0) {
        struct scene_suggestion s = {.word = json->valuestring};
        const char *word;
        for (size_t i = 0; (word = value->choice(i)); i++)
            scene_suggest(&s, word);
        scene_unknown_fault(check->faults, at, "choice", expected, "unknown word", &s);
    } else if (is_axis && check->dimension && index >= check->dimension) {
        scene_value_fault(check->faults, at, "dimension", "\"x\" or \"y\" in 2D", json);
    }
}

static void check_name(struct check *check, const struct scene_value *value, const cJSON *json,
                       const struct scene_cursor *at) {
    if (!cJSON_IsString(json)) {
        type_fault(check, at, value, json);
        return;
    }
    const cJSON *map = json_member(check->root, value->of);
    if (json_member(map, json->valuestring))
        return;
    char expected[80];
    scene_describe(value, expected, sizeof expected);
    struct scene_suggestion s = {.word = json->valuestring};
    for (const cJSON *named = map ? map->child : NULL; named && named->string; named = named->next)
        scene_suggest(&s, named->string);
    scene_unknown_fault(check->faults, at, "unknown_name", expected, "nothing has the name", &s);
}

static void check_numbers(struct check *check, const char *what, int count, const cJSON *json,
                          const struct scene_cursor *at) {
    char expected[120];
    if (count)
        snprintf(expected, sizeof expected, "%s, an array of %d numbers", what, count);
    else
        snprintf(expected, sizeof expected, "%s, an array of numbers", what);
    if (!cJSON_IsArray(json)) {
        scene_value_fault(check->faults, at, "type", expected, json);
        return;
    }
    if (count && cJSON_GetArraySize(json) != count) {
        scene_value_fault(check->faults, at, "length", expected, json);
        return;
    }
    size_t i = 0;
    for (const cJSON *item = json->child; item; item = item->next, i++) {
        struct scene_cursor here = {.parent = at, .index = i};
        if (!is_number(item))
            scene_value_fault(check->faults, &here, "type", "a number", item);
    }
}

static bool is_zero(const cJSON *vector) {
    if (!cJSON_IsArray(vector))
        return false;
    for (const cJSON *item = vector->child; item; item = item->next)
        if (!is_number(item) || item->valuedouble != 0)
            return false;
    return true;
}

static void check_points(struct check *check, const cJSON *json, const struct scene_cursor *at) {
    const char *expected = "an array of positions with a volume";
    if (!cJSON_IsArray(json)) {
        scene_value_fault(check->faults, at, "type", expected, json);
        return;
    }
    int n = cJSON_GetArraySize(json), width = check->dimension ? check->dimension + 1 : 0;
    if (n < 1 || n > SCENE_MAX_POINTS) {
        scene_value_fault(check->faults, at, "count", "from 1 to 10000000 points", json);
        return;
    }
    size_t i = 0;
    for (const cJSON *row = json->child; row; row = row->next, i++) {
        struct scene_cursor here = {.parent = at, .index = i};
        size_t before = check->faults->count + check->faults->more;
        check_numbers(check, "a position and a volume", width, row, &here);
        if (!width || check->faults->count + check->faults->more != before)
            continue;
        const cJSON *volume = row->child->prev; // cJSON: the first item's prev is the last
        struct scene_cursor last = {.parent = &here, .index = (size_t)width - 1};
        if (!(volume->valuedouble > 0))
            scene_value_fault(check->faults, &last, "range", "a volume > 0", volume);
    }
}

// That its edges do not meet is for the solver to see.
static void check_outline(struct check *check, const struct scene_value *value, const cJSON *json,
                          const struct scene_cursor *at) {
    if (!cJSON_IsArray(json)) {
        type_fault(check, at, value, json);
        return;
    }
    int n = cJSON_GetArraySize(json);
    char expected[40];
    snprintf(expected, sizeof expected, "from 3 to %d points", SCENE_MAX_OUTLINE);
    if (n < 3 || n > SCENE_MAX_OUTLINE) {
        scene_value_fault(check->faults, at, "count", expected, json);
        return;
    }
    size_t i = 0;
    for (const cJSON *row = json->child; row; row = row->next, i++) {
        struct scene_cursor here = {.parent = at, .index = i};
        check_numbers(check, "a point", 2, row, &here);
    }
}

// ---- Objects ------------------------------------------------------------------------------------

static bool present(const cJSON *object, const struct scene_key *keys, const char *name) {
    const cJSON *member = json_member(object, name);
    for (const struct scene_key *key = keys; member && key->name; key++)
        if (strcmp(key->name, name) == 0 && key->nullable && cJSON_IsNull(member))
            return false;
    return member != NULL;
}

static const struct scene_key *find_key(const struct scene_key *keys, const char *name) {
    for (const struct scene_key *key = keys; key->name; key++)
        if (strcmp(key->name, name) == 0)
            return key;
    return NULL;
}

// The default of a key as a new value; NULL where what it depends on is itself at fault.
static cJSON *default_value(const struct check *check, const struct scene_key *key) {
    const struct scene_value *value =
        key->value.type == SCENE_EITHER ? key->value.items : &key->value;
    int dimension = check->dimension;
    double divisor;
    if (sscanf(key->fallback, "end / %lf", &divisor) == 1)
        return check->end > 0 ? cJSON_CreateNumber(check->end / divisor) : NULL;
    if (value->type == SCENE_LATTICE)
        return dimension ? cJSON_CreateNumber(pow(2, dimension)) : NULL;
    if (value->type == SCENE_VECTOR)
        return dimension ? cJSON_CreateDoubleArray((double[MPM_MAX_DIM]){0}, dimension) : NULL;
    struct faults none = {0};
    cJSON *json = json_parse(key->fallback, strlen(key->fallback), &none);
    faults_free(&none);
    return json;
}

// Whether the table's conditions (dimension, selector) let the object have this key. `chosen` is
// the index of the selector's choice, -1 when there is none that is valid.
static bool key_applies(const struct check *check, const struct scene_key *key, int chosen) {
    if (key->dimension && check->dimension && key->dimension != check->dimension)
        return false;
    return !key->only || chosen < 0 || (key->only & 1U << chosen);
}

static void misplaced_key(struct check *check, const struct scene_key *key,
                          const struct scene_key *selector, const cJSON *object,
                          const struct scene_cursor *at) {
    if (key->dimension && check->dimension && key->dimension != check->dimension) {
        char expected[32];
        snprintf(expected, sizeof expected, "a scene in %dD", key->dimension);
        scene_fault(check->faults, at, "dimension", expected, check->dimension == 2 ? "2D" : "3D",
                    "`%s` is for scenes in %dD", key->name, key->dimension);
    } else {
        const cJSON *choice = json_member(object, selector->name);
        scene_fault(check->faults, at, "conflict", "absent", key->name,
                    "`%s` does not go with %s \"%s\"", key->name, selector->name,
                    choice->valuestring);
    }
}

static void check_ordered(struct check *check, const cJSON *object, const struct scene_cursor *at) {
    const cJSON *low = json_member(object, "min"), *high = json_member(object, "max");
    if (!cJSON_IsArray(low) || !cJSON_IsArray(high))
        return;
    struct scene_cursor max = {.parent = at, .key = "max"};
    low = low->child;
    high = high->child;
    for (size_t i = 0; low && high; low = low->next, high = high->next, i++) {
        struct scene_cursor here = {.parent = &max, .index = i};
        char expected[64];
        snprintf(expected, sizeof expected, "a number > %.15g (`min`)", low->valuedouble);
        if (is_number(low) && is_number(high) && !(high->valuedouble > low->valuedouble))
            scene_value_fault(check->faults, &here, "range", expected, high);
    }
}

static void check_keys(struct check *check, const struct scene_key *keys, cJSON *object,
                       const struct scene_cursor *at) {
    const struct scene_key *selector = keys;
    while (selector->name && !selector->selector)
        selector++;
    const cJSON *choice = selector->name ? json_member(object, selector->name) : NULL;
    int chosen =
        cJSON_IsString(choice) ? scene_choice_index(&selector->value, choice->valuestring) : -1;

    for (const cJSON *member = object->child; member; member = member->next) {
        struct scene_cursor here = {.parent = at, .key = member->string};
        if (!find_key(keys, member->string))
            unknown_key(check, keys, member->string, &here);
    }
    // In the order of the table: what others refer to comes first.
    for (const struct scene_key *key = keys; key->name; key++) {
        struct scene_cursor here = {.parent = at, .key = key->name};
        cJSON *member = json_member(object, key->name);
        if (member && key->nullable && cJSON_IsNull(member)) {
            cJSON_Delete(cJSON_DetachItemViaPointer(object, member));
            member = NULL;
        }
        const struct scene_key *rival = key->excludes ? find_key(keys, key->excludes) : NULL;
        bool excluded = rival && present(object, keys, rival->name);
        if (member && !key_applies(check, key, chosen)) {
            misplaced_key(check, key, selector, object, &here);
        } else if (member) {
            if (excluded && rival < key)
                scene_fault(check->faults, &here, "conflict", "only one of the two", key->name,
                            "`%s` and `%s` exclude each other; leave one out or set it to null",
                            rival->name, key->name);
            check_value(check, &key->value, member, &here);
        } else if (!key_applies(check, key, chosen)) {
            continue;
        } else if (key->required || (chosen >= 0 && (key->needs & 1U << chosen))) {
            char expected[400];
            scene_describe(&key->value, expected, sizeof expected);
            scene_fault(check->faults, &here, "required", expected, NULL, "`%s` is missing: %s",
                        key->name, key->doc);
        } else if (key->fallback && !excluded && (!key->only || chosen >= 0)) {
            member = default_value(check, key);
            if (member) {
                cJSON_AddItemToObject(object, key->name, member);
                check_value(check, &key->value, member, &here); // fills what it contains
            }
        }
    }
}

static void check_one_key(struct check *check, const struct scene_value *value, cJSON *json,
                          const struct scene_cursor *at) {
    if (!cJSON_IsObject(json)) {
        type_fault(check, at, value, json);
        return;
    }
    if (cJSON_GetArraySize(json) != 1) {
        char expected[400];
        scene_describe(value, expected, sizeof expected);
        char actual[40];
        snprintf(actual, sizeof actual, "%d keys", cJSON_GetArraySize(json));
        scene_fault(check->faults, at, "count", expected, actual, "must be %s, got %s", expected,
                    actual);
    }
    for (cJSON *member = json->child; member; member = member->next) {
        struct scene_cursor here = {.parent = at, .key = member->string};
        const struct scene_key *key = find_key(value->keys, member->string);
        if (!key)
            unknown_key(check, value->keys, member->string, &here);
        else if (!key_applies(check, key, -1))
            misplaced_key(check, key, NULL, json, &here);
        else
            check_value(check, &key->value, member, &here);
    }
}

// A shape may contain shapes; the limit keeps the solver's recursion short.
static void check_shape(struct check *check, const struct scene_value *value, cJSON *json,
                        const struct scene_cursor *at) {
    if (check->shape_depth == SCENE_MAX_SHAPE_DEPTH) {
        char expected[64];
        snprintf(expected, sizeof expected, "shapes nested at most %d deep", SCENE_MAX_SHAPE_DEPTH);
        scene_fault(check->faults, at, "depth", expected, NULL, "must be %s", expected);
        return;
    }
    check->shape_depth++;
    check_one_key(check, value, json, at);
    check->shape_depth--;
}

static bool is_name(const char *text) {
    size_t n = strlen(text);
    if (n < 1 || n > 64 || isdigit((unsigned char)text[0]) || text[0] == '-')
        return false;
    for (const char *c = text; *c; c++)
        if (!((*c >= 'a' && *c <= 'z') || (*c >= 'A' && *c <= 'Z') || (*c >= '0' && *c <= '9') ||
              *c == '_' || *c == '-'))
            return false;
    return true;
}

static bool count_good(struct check *check, const cJSON *json, const struct scene_cursor *at) {
    if (cJSON_GetArraySize(json) <= SCENE_MAX_NAMED)
        return true;
    char expected[40], actual[40];
    snprintf(expected, sizeof expected, "at most %d", SCENE_MAX_NAMED);
    snprintf(actual, sizeof actual, "%d", cJSON_GetArraySize(json));
    scene_fault(check->faults, at, "count", expected, actual, "must have %s entries, got %s",
                expected, actual);
    return false;
}

static void check_map(struct check *check, const struct scene_value *value, cJSON *json,
                      const struct scene_cursor *at) {
    if (!cJSON_IsObject(json)) {
        type_fault(check, at, value, json);
        return;
    }
    if (!count_good(check, json, at))
        return;
    for (cJSON *member = json->child; member; member = member->next) {
        struct scene_cursor here = {.parent = at, .key = member->string};
        if (!is_name(member->string)) {
            char actual[80];
            scene_clip(actual, sizeof actual, member->string);
            scene_fault(
                check->faults, &here, "name", SCENE_NAME_PATTERN, actual,
                "a name begins with a letter or _, goes on with letters, digits, _ and -, and has "
                "at most 64 characters");
        }
        check_value(check, value->items, member, &here);
    }
}

static bool same_text(const cJSON *a, const cJSON *b) {
    return cJSON_IsString(a) && cJSON_IsString(b) && strcmp(a->valuestring, b->valuestring) == 0;
}

static void check_list(struct check *check, const struct scene_value *value, cJSON *json,
                       const struct scene_cursor *at) {
    if (!cJSON_IsArray(json)) {
        type_fault(check, at, value, json);
        return;
    }
    if (!count_good(check, json, at))
        return;
    bool is_shapes = value->items->definition != NULL;
    if (is_shapes && !json->child)
        scene_value_fault(check->faults, at, "count", "at least one shape", json);
    size_t i = 0;
    for (cJSON *item = json->child; item; item = item->next, i++) {
        struct scene_cursor here = {.parent = at, .index = i};
        check_value(check, value->items, item, &here);
        for (const cJSON *other = json->child; value->unique && other != item; other = other->next)
            if (same_text(item, other)) {
                scene_value_fault(check->faults, &here, "conflict", "in the list once", item);
                break;
            }
    }
}

// ---- Values of two kinds ------------------------------------------------------------------------

static bool type_fits(const struct scene_value *value, const cJSON *json) {
    switch (value->type) {
    case SCENE_BOOL:
        return cJSON_IsBool(json);
    case SCENE_NUMBER:
    case SCENE_INTEGER:
    case SCENE_LATTICE:
        return cJSON_IsNumber(json);
    case SCENE_TEXT:
    case SCENE_CHOICE:
    case SCENE_NAME:
        return cJSON_IsString(json);
    case SCENE_VECTOR:
    case SCENE_POINTS:
    case SCENE_OUTLINE:
    case SCENE_LIST:
        return cJSON_IsArray(json);
    case SCENE_OBJECT:
    case SCENE_ONE_KEY:
    case SCENE_MAP:
    case SCENE_MATERIAL:
    case SCENE_MATERIAL_PATCH:
        return cJSON_IsObject(json);
    case SCENE_EITHER:
        break;
    }
    return false;
}

static void check_either(struct check *check, const struct scene_value *value, cJSON *json,
                         const struct scene_cursor *at) {
    for (size_t i = 0; i < value->n_items; i++)
        if (type_fits(&value->items[i], json)) {
            check_value(check, &value->items[i], json, at);
            return;
        }
    type_fault(check, at, value, json);
}

// ---- Materials ----------------------------------------------------------------------------------

static const struct mpm_material *model_of(const cJSON *json) {
    const cJSON *model = json_member(json, "model");
    return cJSON_IsString(model) ? mpm_material_find(model->valuestring) : NULL;
}

static void check_material(struct check *check, cJSON *json, const struct scene_cursor *at) {
    struct scene_material_keys table;
    const struct mpm_material *model = model_of(json);
    scene_material_keys(model, &table);
    if (!cJSON_IsObject(json)) {
        scene_value_fault(check->faults, at, "type", "an object", json);
    } else if (model) {
        check_keys(check, table.keys, json, at);
    } else { // without a model there is no telling which other keys are right
        struct scene_cursor here = {.parent = at, .key = "model"};
        cJSON *word = json_member(json, "model");
        char expected[400];
        scene_describe(&table.keys[0].value, expected, sizeof expected);
        if (word)
            check_value(check, &table.keys[0].value, word, &here);
        else
            scene_fault(check->faults, &here, "required", expected, NULL, "`model` is missing: %s",
                        expected);
    }
}

static void check_material_patch(struct check *check, cJSON *json, const struct scene_cursor *at) {
    static const struct scene_value name = {.type = SCENE_NAME, .of = "materials"};
    if (!cJSON_IsObject(json)) {
        scene_value_fault(check->faults, at, "type", "an object keyed by material", json);
        return;
    }
    const cJSON *materials = json_member(check->root, "materials");
    for (cJSON *patch = json->child; patch; patch = patch->next) {
        struct scene_cursor here = {.parent = at, .key = patch->string};
        const cJSON *material = json_member(materials, patch->string);
        const struct mpm_material *model = model_of(material);
        if (!material) {
            cJSON *text = cJSON_CreateString(patch->string);
            check_name(check, &name, text, &here);
            cJSON_Delete(text);
        } else if (!cJSON_IsObject(patch)) {
            scene_value_fault(check->faults, &here, "type", "an object", patch);
        }
        if (!model || !cJSON_IsObject(patch))
            continue;
        struct scene_material_keys table;
        scene_material_keys(model, &table);
        for (cJSON *change = patch->child; change; change = change->next) {
            struct scene_cursor member = {.parent = &here, .key = change->string};
            const struct scene_key *key = find_key(table.keys, change->string);
            if (!key)
                unknown_key(check, table.keys, change->string, &member);
            else if (key->value.type != SCENE_NUMBER || strcmp(key->name, "density") == 0)
                scene_given_fault(check->faults, &member, "immutable", "absent", change,
                                  "`%s` of a material cannot change from stage to stage",
                                  key->name);
            else if (!cJSON_IsNull(change))
                check_value(check, &key->value, change, &member);
            else if (key->required)
                scene_fault(check->faults, &member, "required", "a number", "null",
                            "`%s` has no default to go back to", key->name);
        }
    }
}

// ---- The walk -----------------------------------------------------------------------------------

static void check_value(struct check *check, const struct scene_value *value, cJSON *json,
                        const struct scene_cursor *at) {
    switch (value->type) {
    case SCENE_BOOL:
        if (!cJSON_IsBool(json))
            type_fault(check, at, value, json);
        break;
    case SCENE_NUMBER:
    case SCENE_INTEGER:
        check_number(check, value, json, at);
        break;
    case SCENE_LATTICE:
        check_lattice(check, json, at);
        break;
    case SCENE_TEXT:
        check_text(check, value, json, at);
        break;
    case SCENE_CHOICE:
        check_choice(check, value, json, at);
        break;
    case SCENE_NAME:
        check_name(check, value, json, at);
        break;
    case SCENE_VECTOR:
        check_numbers(check, "a vector", check->dimension, json, at);
        if (value->nonzero && is_zero(json))
            scene_value_fault(check->faults, at, "range", "a vector with a direction", json);
        break;
    case SCENE_POINTS:
        check_points(check, json, at);
        break;
    case SCENE_OUTLINE:
        check_outline(check, value, json, at);
        break;
    case SCENE_OBJECT:
        if (!cJSON_IsObject(json)) {
            type_fault(check, at, value, json);
            break;
        }
        check_keys(check, value->keys, json, at);
        if (value->ordered)
            check_ordered(check, json, at);
        break;
    case SCENE_ONE_KEY:
        if (value->definition)
            check_shape(check, value, json, at);
        else
            check_one_key(check, value, json, at);
        break;
    case SCENE_MAP:
        check_map(check, value, json, at);
        break;
    case SCENE_LIST:
        check_list(check, value, json, at);
        break;
    case SCENE_EITHER:
        check_either(check, value, json, at);
        break;
    case SCENE_MATERIAL:
        check_material(check, json, at);
        break;
    case SCENE_MATERIAL_PATCH:
        check_material_patch(check, json, at);
        break;
    }
}

// ---- What no single key can tell ----------------------------------------------------------------

static void check_stages(struct check *check, const cJSON *stages,
                         const struct scene_cursor *root) {
    struct scene_cursor list = {.parent = root, .key = "stages"};
    size_t i = 0;
    for (const cJSON *stage = stages->child; stage; stage = stage->next, i++) {
        struct scene_cursor at = {.parent = &list, .index = i};
        struct scene_cursor duration = {.parent = &at, .key = "duration"};
        struct scene_cursor until = {.parent = &at, .key = "until"};
        struct scene_cursor ramp = {.parent = &at, .key = "ramp"};
        bool has_duration = json_member(stage, "duration") != NULL;
        bool has_until = json_member(stage, "until") != NULL;
        if (!cJSON_IsObject(stage))
            continue;
        if (!stage->next && (has_duration || has_until))
            scene_fault(
                check->faults, has_duration ? &duration : &until, "conflict", "absent", NULL,
                "the last stage lasts to `time.end`; it has neither `duration` nor `until`");
        if (stage->next && !has_duration && !has_until)
            scene_fault(check->faults, &duration, "required", "a number > 0 in s", NULL,
                        "every stage but the last needs `duration` or `until`");
        if (json_member(stage, "ramp") && cJSON_IsObject(json_member(stage, "gravity")))
            scene_fault(check->faults, &ramp, "conflict", "only one of the two", NULL,
                        "`ramp` stands either next to `gravity` or inside it");
    }
}

// `+r` and `-r` are about a centre, in 3D about an axis through it; other extremes are not.
static void check_extreme(struct check *check, const cJSON *select, const char *extreme,
                          const struct scene_cursor *at) {
    static const char *const keys[] = {"center", "axis"};
    bool round = extreme[1] == 'r';
    struct scene_cursor here = {.parent = at, .key = "extreme"};
    if (extreme[1] == 'z' && check->dimension == 2)
        scene_value_fault(check->faults, &here, "dimension", "an extreme along x, y or r in 2D",
                          json_member(select, "extreme"));
    for (int i = 0; i < 2; i++) {
        here.key = keys[i];
        bool is_there = json_member(select, keys[i]) != NULL;
        if (is_there && !round)
            scene_fault(check->faults, &here, "conflict", "absent", NULL,
                        "`%s` does not go with extreme \"%s\"", keys[i], extreme);
        if (!is_there && round && (i == 0 || check->dimension == 3))
            scene_fault(check->faults, &here, "required",
                        i ? "one of \"x\", \"y\", \"z\"" : "a vector in m", NULL,
                        "extreme \"%s\" needs `%s`", extreme, keys[i]);
    }
}

// What is chosen by `extreme` or by `box`.
static void check_select(struct check *check, const cJSON *select, const struct scene_cursor *at) {
    const cJSON *box = json_member(select, "box"), *extreme = json_member(select, "extreme");
    if (cJSON_IsObject(select) && !box && !extreme)
        scene_fault(check->faults, at, "required", "`extreme` or `box`", NULL,
                    "`select` needs `extreme` or `box`");
    if (!box && cJSON_IsString(extreme) && strlen(extreme->valuestring) == 2)
        check_extreme(check, select, extreme->valuestring, at);
}

static void check_loads(struct check *check, const cJSON *loads, const struct scene_cursor *root) {
    struct scene_cursor map = {.parent = root, .key = "loads"};
    for (const cJSON *load = loads->child; load; load = load->next) {
        struct scene_cursor item = {.parent = &map, .key = load->string};
        struct scene_cursor selected = {.parent = &item, .key = "select"};
        struct scene_cursor force = {.parent = &item, .key = "force"};
        struct scene_cursor pressure = {.parent = &item, .key = "pressure"};
        const cJSON *select = json_member(load, "select"), *box = json_member(select, "box");
        if (!cJSON_IsObject(load))
            continue;
        if (!json_member(load, "force") && !json_member(load, "pressure"))
            scene_fault(check->faults, &force, "required", "a vector in N", NULL,
                        "a load needs `force` or `pressure`");
        if (box && json_member(load, "pressure"))
            scene_fault(check->faults, &pressure, "conflict", "absent", NULL,
                        "a pressure acts on a layer and not on a box; select an extreme");
        check_select(check, select, &selected);
    }
}

// The index of a component of the error probe's field; -1 without one, and where it is at fault.
static int error_component(struct check *check, const cJSON *probe, const struct scene_cursor *at) {
    const cJSON *word = json_member(probe, "component"), *field = json_member(probe, "field");
    int code = cJSON_IsString(field) ? mpm_field_parse(field->valuestring) : -1;
    if (!cJSON_IsString(word) || code < 0 || !check->dimension)
        return -1;
    struct scene_suggestion s = {.word = word->valuestring};
    char expected[160] = "one of";
    const char *name;
    for (int c = 0; (name = scene_field_component((enum mpm_field)code, check->dimension, c));
         c++) {
        if (*name && strcmp(name, word->valuestring) == 0)
            return c;
        scene_suggest(&s, name);
        size_t length = strlen(expected);
        snprintf(expected + length, sizeof expected - length, "%s%s", c ? ", " : " ", name);
    }
    struct scene_cursor here = {.parent = at, .key = "component"};
    if (!*scene_field_component((enum mpm_field)code, check->dimension, 0))
        scene_fault(check->faults, &here, "conflict", "absent", NULL,
                    "`%s` has one value and no components", field->valuestring);
    else
        scene_unknown_fault(check->faults, &here, "choice", expected, "unknown component", &s);
    return -1;
}

// A table needs a position and the components of the field.
static void check_error_table(struct check *check, const cJSON *probe,
                              const struct scene_cursor *at) {
    const cJSON *against = json_member(probe, "against"), *field = json_member(probe, "field");
    int component = error_component(check, probe, at);
    int code = cJSON_IsString(field) ? mpm_field_parse(field->valuestring) : -1;
    struct scene_table table;
    if (!cJSON_IsString(against) || code < 0 || !check->dimension ||
        !scene_table_read(against->valuestring, &table))
        return;
    struct scene_cursor here = {.parent = at, .key = "against"};
    int columns[MPM_MAX_COMPONENTS];
    char lacks[40] = "X";
    bool placed = scene_table_column(&table, "X") >= 0 || scene_table_column(&table, "Y") >= 0 ||
                  (check->dimension == 3 && scene_table_column(&table, "Z") >= 0);
    if (!placed || !scene_table_field(&table, (enum mpm_field)code, component, check->dimension,
                                      columns, lacks))
        scene_given_fault(check->faults, &here, "conflict", "a table with that column", against,
                          "the table `%s` has no column `%s`", against->valuestring, lacks);
    scene_table_free(&table);
}

// A displacement is that of one place or the mean over some; a reaction is on a wall or a rigid
// body.
static void check_probes(struct check *check, const cJSON *probes,
                         const struct scene_cursor *root) {
    struct scene_cursor map = {.parent = root, .key = "probes"};
    for (const cJSON *probe = probes->child; probe; probe = probe->next) {
        struct scene_cursor item = {.parent = &map, .key = probe->string};
        struct scene_cursor at = {.parent = &item, .key = "at"};
        struct scene_cursor wall = {.parent = &item, .key = "wall"};
        const cJSON *word = json_member(probe, "kind");
        int kind = cJSON_IsString(word) ? mpm_probe_kind_parse(word->valuestring) : -1;
        if (kind == MPM_PROBE_REACTION && !json_member(probe, "wall") &&
            !json_member(probe, "rigid_body"))
            scene_fault(check->faults, &wall, "required", "a name in `walls`", NULL,
                        "a reaction needs `wall` or `rigid_body`");
        if (kind == MPM_PROBE_DISPLACEMENT && !json_member(probe, "at") &&
            !json_member(probe, "box") && !json_member(probe, "select"))
            scene_fault(check->faults, &at, "required", "a vector in m", NULL,
                        "a displacement needs `at`, or `box` or `select` for the mean over it");
        struct scene_cursor select = {.parent = &item, .key = "select"};
        check_select(check, json_member(probe, "select"), &select);
        if (kind == MPM_PROBE_ERROR)
            check_error_table(check, probe, &item);
    }
}

static const char *shape_component(enum mpm_shape_of_field shape, int dimension, int index) {
    static const char *const tensor[2][9] = {
        {"xx", "xy", "yx", "yy"}, {"xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"}};
    if (shape == MPM_SCALAR)
        return index == 0 ? "" : NULL;
    if (shape == MPM_VECTOR)
        return index < dimension ? scene_axis_choice((size_t)index) : NULL;
    return index < dimension * dimension ? tensor[dimension - 2][index] : NULL;
}

const char *scene_field_component(enum mpm_field field, int dimension, int index) {
    return shape_component(mpm_field_info(field)->shape, dimension, index);
}

const char *scene_probe_component(const cJSON *probe, int dimension, int index) {
    static const char *const energy[] = {"kinetic", "strain", "potential", "total"};
    const cJSON *word = json_member(probe, "kind"), *field = json_member(probe, "field");
    int kind = cJSON_IsString(word) ? mpm_probe_kind_parse(word->valuestring) : -1;
    enum mpm_shape_of_field shape = MPM_SCALAR;
    switch (kind) {
    case MPM_PROBE_ENERGY:
        return index < 4 ? energy[index] : NULL;
    case MPM_PROBE_DISPLACEMENT:
    case MPM_PROBE_REACTION:
    case MPM_PROBE_MOMENTUM:
        shape = MPM_VECTOR;
        break;
    case MPM_PROBE_FIELD:
    case MPM_PROBE_MAXIMUM:
    case MPM_PROBE_MINIMUM:
    case MPM_PROBE_MEAN: {
        int code = cJSON_IsString(field) ? mpm_field_parse(field->valuestring) : -1;
        if (code >= 0)
            shape = mpm_field_info((enum mpm_field)code)->shape;
        break;
    }
    }
    return shape_component(shape, dimension, index);
}

// A value from a table: the column is there, and the place within the rows.
static void check_cited(struct check *check, const cJSON *reference,
                        const struct scene_cursor *item) {
    const cJSON *value = json_member(reference, "value"), *name = json_member(value, "table");
    const cJSON *column = json_member(value, "column");
    struct scene_table table;
    if (!cJSON_IsString(name) || !cJSON_IsString(column) ||
        !scene_table_read(name->valuestring, &table))
        return;
    struct scene_cursor here = {.parent = item, .key = "value"};
    struct scene_cursor place = {.parent = &here, .key = "column"};
    struct scene_suggestion s = {.word = column->valuestring};
    char expected[400] = "one of";
    const int index = scene_table_column(&table, column->valuestring);
    for (size_t c = 0; c < table.n_columns; c++) {
        size_t length = strlen(expected);
        scene_suggest(&s, table.names[c]);
        snprintf(expected + length, sizeof expected - length, "%s%s", c ? ", " : " ",
                 table.names[c]);
    }
    if (index < 0) {
        scene_unknown_fault(check->faults, &place, "choice", expected, "unknown column", &s);
    } else if (isnan(scene_table_value(&table, index, scene_cited_at(reference, check->end)))) {
        place.key = "at";
        snprintf(expected, sizeof expected, "from %.9g to %.9g, as the table's %s", table.values[0],
                 table.values[(table.n_rows - 1) * table.n_columns], table.names[0]);
        scene_fault(check->faults, &place, "range", expected, NULL,
                    "the place in the table must be %s", expected);
    }
    scene_table_free(&table);
}

double scene_cited_at(const cJSON *reference, double end) {
    const cJSON *at = json_member(json_member(reference, "value"), "at");
    if (!at)
        at = json_member(reference, "at");
    return cJSON_IsNumber(at) ? at->valuedouble : end;
}

static void check_references(struct check *check, const cJSON *references,
                             const struct scene_cursor *root) {
    const cJSON *probes = json_member(check->root, "probes");
    struct scene_cursor list = {.parent = root, .key = "references"};
    size_t i = 0;
    for (const cJSON *reference = references->child; reference; reference = reference->next, i++) {
        struct scene_cursor item = {.parent = &list, .index = i};
        struct scene_cursor at = {.parent = &item, .key = "component"};
        const cJSON *name = json_member(reference, "probe");
        const cJSON *component = json_member(reference, "component");
        const cJSON *probe = cJSON_IsString(name) ? json_member(probes, name->valuestring) : NULL;
        check_cited(check, reference, &item);
        if (!probe || !check->dimension || (component && !cJSON_IsString(component)))
            continue;
        struct scene_suggestion s = {.word = component ? component->valuestring : ""};
        char expected[160] = "one of";
        bool found = false;
        const char *word;
        for (int c = 0; (word = scene_probe_component(probe, check->dimension, c)); c++) {
            found = found || strcmp(word, s.word) == 0;
            scene_suggest(&s, word);
            size_t length = strlen(expected);
            snprintf(expected + length, sizeof expected - length, "%s%s", c ? ", " : " ", word);
        }
        bool scalar = !scene_probe_component(probe, check->dimension, 1);
        if (scalar && component)
            scene_fault(check->faults, &at, "conflict", "absent", NULL,
                        "`%s` has one value and no components", name->valuestring);
        else if (!scalar && !component)
            scene_fault(check->faults, &at, "required", expected, NULL,
                        "`%s` has several components; name one", name->valuestring);
        else if (!found)
            scene_unknown_fault(check->faults, &at, "choice", expected, "unknown component", &s);
    }
}

// Whether a material of the scene has a plastic strain; also where its model cannot be told.
static bool any_yields(const cJSON *materials) {
    for (const cJSON *material = materials->child; material; material = material->next) {
        const cJSON *name = json_member(material, "model");
        const struct mpm_material *model =
            cJSON_IsString(name) ? mpm_material_find(name->valuestring) : NULL;
        if (!model || mpm_material_yields(model))
            return true;
    }
    return false;
}

static void check_output_fields(struct check *check, const cJSON *fields, const cJSON *materials,
                                const struct scene_cursor *root) {
    if (any_yields(materials))
        return;
    struct scene_cursor output = {.parent = root, .key = "output"};
    struct scene_cursor list = {.parent = &output, .key = "fields"};
    const char *name = mpm_field_info(MPM_FIELD_PLASTIC_STRAIN)->name;
    size_t i = 0;
    for (const cJSON *field = fields->child; field; field = field->next, i++) {
        struct scene_cursor at = {.parent = &list, .index = i};
        if (cJSON_IsString(field) && strcmp(field->valuestring, name) == 0)
            scene_given_fault(check->faults, &at, "unsupported", "a field that the scene has",
                              field, "no material of the scene has a `%s`", name);
    }
}

// Frames begin with the position.
static void put_position_first(cJSON *scene) {
    cJSON *fields = json_member(json_member(scene, "output"), "fields"), *position = NULL;
    for (cJSON *field = fields ? fields->child : NULL; field && !position; field = field->next)
        if (cJSON_IsString(field) && strcmp(field->valuestring, "position") == 0)
            position = field;
    if (!cJSON_IsArray(fields) || (position && position == fields->child))
        return;
    position =
        position ? cJSON_DetachItemViaPointer(fields, position) : cJSON_CreateString("position");
    if (fields->child)
        cJSON_InsertItemInArray(fields, 0, position);
    else
        cJSON_AddItemToArray(fields, position);
}

void scene_check(cJSON *scene, struct faults *faults) {
    struct check check = {.root = scene, .faults = faults};
    struct scene_cursor root = {0};
    const cJSON *dimension = json_member(scene, "dimension");
    const cJSON *end = json_member(json_member(scene, "time"), "end");
    if (is_number(dimension) && (dimension->valuedouble == 2 || dimension->valuedouble == 3))
        check.dimension = (int)dimension->valuedouble;
    if (is_number(end) && end->valuedouble > 0)
        check.end = end->valuedouble;
    // No stages is one stage, said either way.
    cJSON *stages = json_member(scene, "stages");
    if (cJSON_IsArray(stages) && !stages->child)
        cJSON_Delete(cJSON_DetachItemViaPointer(scene, stages));

    check_value(&check, &scene_root, scene, &root);
    stages = json_member(scene, "stages");
    if (cJSON_IsArray(stages))
        check_stages(&check, stages, &root);
    const cJSON *loads = json_member(scene, "loads");
    if (cJSON_IsObject(loads) && cJSON_GetArraySize(loads) <= SCENE_MAX_NAMED)
        check_loads(&check, loads, &root);
    const cJSON *probes = json_member(scene, "probes");
    if (cJSON_IsObject(probes) && cJSON_GetArraySize(probes) <= SCENE_MAX_NAMED)
        check_probes(&check, probes, &root);
    const cJSON *references = json_member(scene, "references");
    if (cJSON_IsArray(references) && cJSON_GetArraySize(references) <= SCENE_MAX_NAMED)
        check_references(&check, references, &root);
    const cJSON *fields = json_member(json_member(scene, "output"), "fields");
    const cJSON *materials = json_member(scene, "materials");
    if (cJSON_IsArray(fields) && cJSON_IsObject(materials))
        check_output_fields(&check, fields, materials, &root);
    put_position_first(scene);
}

// ---- Patches ------------------------------------------------------------------------------------

static bool any_live(const struct scene_key *keys) {
    for (const struct scene_key *key = keys; key->name; key++)
        if (key->live)
            return true;
    return false;
}

// A null says "not this key": of keys that there are. Whatever else is wrong with the value is
// found once it is merged; an unknown key would be gone then.
static void check_nulls(struct check *check, const struct scene_value *value, cJSON *patch,
                        const struct scene_cursor *at) {
    const struct scene_value *object = value->type == SCENE_OBJECT ? value : NULL;
    for (size_t i = 0; value->type == SCENE_EITHER && i < value->n_items; i++)
        if (value->items[i].type == SCENE_OBJECT)
            object = &value->items[i];
    cJSON *next;
    for (cJSON *change = object && cJSON_IsObject(patch) ? patch->child : NULL; change;
         change = next) {
        next = change->next;
        struct scene_cursor here = {.parent = at, .key = change->string};
        const struct scene_key *key = find_key(object->keys, change->string);
        if (key) {
            check_nulls(check, &key->value, change, &here);
        } else if (cJSON_IsNull(change)) {
            unknown_key(check, object->keys, change->string, &here);
            cJSON_Delete(cJSON_DetachItemViaPointer(patch, change));
        }
    }
}

static void check_live_keys(struct check *check, const struct scene_key *keys, cJSON *patch,
                            const struct scene_cursor *at) {
    cJSON *next;
    for (cJSON *change = patch->child; change; change = next) {
        next = change->next;
        struct scene_cursor here = {.parent = at, .key = change->string};
        const struct scene_key *key = find_key(keys, change->string);
        if (key && !key->live && key->value.type == SCENE_OBJECT && any_live(key->value.keys) &&
            cJSON_IsObject(change)) {
            check_live_keys(check, key->value.keys, change, &here);
            continue;
        }
        if (key && key->live) {
            check_nulls(check, &key->value, change, &here);
            continue;
        }
        if (!key)
            unknown_key(check, keys, change->string, &here);
        else
            scene_given_fault(check->faults, &here, "immutable", "absent", change,
                              "`%s` cannot change while the run goes on", key->name);
        cJSON_Delete(cJSON_DetachItemViaPointer(patch, change));
    }
}

void scene_check_live(cJSON *patch, struct faults *faults) {
    struct check check = {.faults = faults};
    struct scene_cursor root = {0};
    if (cJSON_IsObject(patch))
        check_live_keys(&check, scene_root.keys, patch, &root);
    else
        scene_value_fault(faults, &root, "type", "an object", patch);
}
