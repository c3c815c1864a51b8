#include "server/bodies.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "server/recorders.h"
#include "server/routes_inside.h"
#include "server/run.h"
#include "server/scene.h"
#include "server/scene_fault.h"

enum body_type {
    BODY_FLAG,
    BODY_WHOLE,
    BODY_NUMBER,
    BODY_ID,
    BODY_IDS,
    BODY_SCENE, // a built-in scene's name, or a scene: what is in it, the table of scenes says
    BODY_OBJECT,
};
struct body_key {
    const char *name;
    enum body_type type;
    bool required;
    double least, most;   // of numbers; how many of lists at most
    const char *expected; // in words
    const char *fallback; // as JSON
    const char *doc;
};
struct body {
    const char *schema;
    const struct body_key *keys; // ends with a NULL name
    bool one;                    // exactly one of them
    const char *other;           // a schema that the body may be of instead
    const char *doc;
};

static const struct body_key create_keys[] = {
    {"scene", BODY_SCENE, .required = true, .expected = "a built-in scene's name, or a scene"},
    {"overrides", BODY_OBJECT, .expected = "a merge patch on the scene: an object",
     .doc = "merge patch (RFC 7396) on the scene"},
    {"id", BODY_ID, .expected = RUNS_ID_PATTERN,
     .doc = "made up from the scene's name where it lacks"},
    {"start", BODY_FLAG, .expected = "true or false", .fallback = "true"},
    {"wait_subscribers", BODY_WHOLE, .most = RUN_SUBSCRIBERS_MAX,
     .expected = "a whole number, 0 to 10000", .fallback = "0",
     .doc = "who must listen before the first frame is taken"},
    {"recorders", BODY_IDS, .most = RECORDERS_MAX, .expected = "at most 64 names " RUNS_ID_PATTERN,
     .doc = "registered before the first frame: it is kept for them"},
    {0},
};
_Static_assert(RUN_SUBSCRIBERS_MAX == 10000 && RECORDERS_MAX == 64, "as the words above say");
static const struct body_key wrapped_keys[] = {
    {"scene", BODY_SCENE, .required = true, .expected = "a built-in scene's name, or a scene"},
    {"overrides", BODY_OBJECT, .expected = "a merge patch on the scene: an object",
     .doc = "merge patch (RFC 7396) on the scene"},
    {0},
};
static const struct body_key step_keys[] = {
    {"steps", BODY_WHOLE, .least = 1, .most = INFINITY, .expected = "a whole number, 1 or more"},
    {"until", BODY_NUMBER, .least = -INFINITY, .most = INFINITY, .expected = "a time in s",
     .doc = "s of simulated time"},
    {0},
};
static const struct body_key acknowledge_keys[] = {
    {"acked", BODY_WHOLE, .required = true, .least = -1, .most = JSON_COUNTED,
     .expected = "a whole number, -1 (nothing yet) or more",
     .doc = "number of the last frame that is safe, with all before it; -1: none yet"},
    {0},
};
static const struct body_key no_keys[] = {{0}};

static const struct body bodies[] = {
    {"Create", create_keys, .doc = "a new run"},
    {"Validate", wrapped_keys, .other = "Scene", .doc = "a scene, or a scene with overrides"},
    {"Step", step_keys, .one = true},
    {"Acknowledge", acknowledge_keys, .doc = "what is safe with the recorder"},
    {"Empty", no_keys, .doc = "nothing"},
    {"Patch", NULL, .doc = "merge patch (RFC 7396) of what may change while a run goes on"},
};
#define BODIES (sizeof bodies / sizeof *bodies)

// ---- Checks -----------------------------------------------------------------------------------

static void value_fault(struct faults *faults, const struct body_key *key, const char *code,
                        const cJSON *value) {
    routes_value_fault(faults, key->name, code, key->expected, value);
}

static bool is_id(const cJSON *item) {
    return cJSON_IsString(item) && runs_id_valid(item->valuestring);
}

static void check_number(const struct body_key *key, const cJSON *value, struct faults *faults) {
    const double x = value->valuedouble;
    if (!cJSON_IsNumber(value))
        value_fault(faults, key, "type", value);
    else if (x < key->least || x > key->most || (key->type == BODY_WHOLE && x != floor(x)))
        value_fault(faults, key, "range", value);
}

static void check_ids(const struct body_key *key, const cJSON *value, struct faults *faults) {
    const cJSON *item;
    if (!cJSON_IsArray(value)) {
        value_fault(faults, key, "type", value);
        return;
    }
    if (cJSON_GetArraySize(value) > (int)key->most) {
        value_fault(faults, key, "length", value);
        return;
    }
    const struct scene_cursor root = {0}, list = {.parent = &root, .key = key->name};
    struct scene_cursor at = {.parent = &list};
    cJSON_ArrayForEach(item, value) {
        if (!is_id(item))
            scene_value_fault(faults, &at, cJSON_IsString(item) ? "pattern" : "type",
                              RUNS_ID_PATTERN, item);
        at.index++;
    }
}

static void check_key(const struct body_key *key, const cJSON *value, struct faults *faults) {
    switch (key->type) {
    case BODY_FLAG:
        if (!cJSON_IsBool(value))
            value_fault(faults, key, "type", value);
        break;
    case BODY_WHOLE:
    case BODY_NUMBER:
        check_number(key, value, faults);
        break;
    case BODY_ID:
        if (!is_id(value))
            value_fault(faults, key, cJSON_IsString(value) ? "pattern" : "type", value);
        break;
    case BODY_IDS:
        check_ids(key, value, faults);
        break;
    case BODY_SCENE:
        if (!cJSON_IsString(value) && !cJSON_IsObject(value))
            value_fault(faults, key, "type", value);
        break;
    case BODY_OBJECT:
        if (!cJSON_IsObject(value))
            value_fault(faults, key, "type", value);
        break;
    }
}

static void unknown_fault(const struct body_key *keys, const cJSON *item, struct faults *faults) {
    const struct scene_cursor root = {0}, at = {.parent = &root, .key = item->string};
    struct scene_suggestion near = {.word = item->string};
    char expected[160] = "no keys";
    size_t n = 0;
    for (const struct body_key *key = keys; key->name != NULL; key++) {
        n += (size_t)snprintf(expected + n, sizeof expected - n, "%s%s", n == 0 ? "one of " : ", ",
                              key->name);
        scene_suggest(&near, key->name);
    }
    scene_unknown_fault(faults, &at, "unknown_key", expected, "there is no key", &near);
}

static void check_one(const struct body_key *keys, unsigned there, struct faults *faults) {
    char expected[160] = "";
    if (there == 1)
        return;
    size_t n = 0;
    for (const struct body_key *key = keys; key->name != NULL; key++)
        n += (size_t)snprintf(expected + n, sizeof expected - n, "%s%s",
                              n == 0                ? ""
                              : key[1].name != NULL ? ", "
                                                    : " or ",
                              key->name);
    faults_add(faults, "", there == 0 ? "required" : "conflict", expected, NULL,
               "must have exactly one of %s", expected);
}

void bodies_check(const char *name, const cJSON *body, struct faults *faults) {
    const struct body *b = bodies;
    while (b < bodies + BODIES && strcmp(b->schema, name) != 0)
        b++;
    if (b == bodies + BODIES || b->keys == NULL)
        return; // checked where scenes are
    unsigned there = 0;
    const cJSON *item;
    cJSON_ArrayForEach(item, body) {
        const struct body_key *key = b->keys;
        while (key->name != NULL && strcmp(key->name, item->string) != 0)
            key++;
        if (key->name == NULL) {
            unknown_fault(b->keys, item, faults);
            continue;
        }
        check_key(key, item, faults);
        there++;
    }
    for (const struct body_key *key = b->keys; key->name != NULL; key++)
        if (key->required && json_member(body, key->name) == NULL) {
            char pointer[64];
            snprintf(pointer, sizeof pointer, "/%s", key->name);
            faults_add(faults, pointer, "required", key->expected, NULL, "is missing: %s",
                       key->doc != NULL ? key->doc : key->expected);
        }
    if (b->one)
        check_one(b->keys, there, faults);
}

// ---- Schemas ----------------------------------------------------------------------------------

static cJSON *key_schema(const struct body_key *key) {
    cJSON *schema = cJSON_CreateObject(), *items;
    const char *const either[] = {"string", "object"};
    switch (key->type) {
    case BODY_FLAG:
        cJSON_AddStringToObject(schema, "type", "boolean");
        break;
    case BODY_WHOLE:
    case BODY_NUMBER:
        cJSON_AddStringToObject(schema, "type", key->type == BODY_WHOLE ? "integer" : "number");
        if (isfinite(key->least))
            cJSON_AddItemToObject(schema, "minimum", json_number(key->least));
        if (isfinite(key->most))
            cJSON_AddItemToObject(schema, "maximum", json_number(key->most));
        break;
    case BODY_ID:
        cJSON_AddStringToObject(schema, "type", "string");
        cJSON_AddStringToObject(schema, "pattern", "^" RUNS_ID_PATTERN "$");
        break;
    case BODY_IDS:
        cJSON_AddStringToObject(schema, "type", "array");
        items = cJSON_AddObjectToObject(schema, "items");
        cJSON_AddStringToObject(items, "type", "string");
        cJSON_AddStringToObject(items, "pattern", "^" RUNS_ID_PATTERN "$");
        cJSON_AddItemToObject(schema, "maxItems", json_number(key->most));
        break;
    case BODY_SCENE:
        cJSON_AddItemToObject(schema, "type", cJSON_CreateStringArray(either, 2));
        break;
    case BODY_OBJECT:
        cJSON_AddStringToObject(schema, "type", "object");
        break;
    }
    cJSON_AddStringToObject(schema, "description", key->doc != NULL ? key->doc : key->expected);
    if (key->fallback != NULL) {
        struct faults none = {0};
        cJSON_AddItemToObject(schema, "default",
                              json_parse(key->fallback, strlen(key->fallback), &none));
        faults_free(&none);
    }
    return schema;
}

static cJSON *object_schema(const struct body *b) {
    cJSON *schema = cJSON_CreateObject(), *required = cJSON_CreateArray();
    cJSON_AddStringToObject(schema, "type", "object");
    cJSON *properties = cJSON_AddObjectToObject(schema, "properties");
    for (const struct body_key *key = b->keys; key->name != NULL; key++) {
        cJSON_AddItemToObject(properties, key->name, key_schema(key));
        if (key->required)
            cJSON_AddItemToArray(required, cJSON_CreateString(key->name));
    }
    if (required->child != NULL)
        cJSON_AddItemToObject(schema, "required", required);
    else
        cJSON_Delete(required);
    if (b->one) {
        cJSON_AddNumberToObject(schema, "minProperties", 1);
        cJSON_AddNumberToObject(schema, "maxProperties", 1);
    }
    cJSON_AddFalseToObject(schema, "additionalProperties");
    return schema;
}

const char *bodies_name(size_t index) {
    return index < BODIES ? bodies[index].schema : NULL;
}

cJSON *bodies_schema(size_t index) {
    const struct body *b = &bodies[index];
    cJSON *schema = b->keys != NULL ? object_schema(b) : scene_patch_schema();
    if (b->other != NULL) {
        char reference[64];
        cJSON *either = cJSON_CreateObject(), *forms = cJSON_AddArrayToObject(either, "anyOf");
        cJSON *other = cJSON_CreateObject();
        snprintf(reference, sizeof reference, "#/components/schemas/%s", b->other);
        cJSON_AddStringToObject(other, "$ref", reference);
        cJSON_AddItemToArray(forms, other);
        cJSON_AddItemToArray(forms, schema);
        schema = either;
    }
    if (b->doc != NULL)
        cJSON_AddStringToObject(schema, "description", b->doc);
    return schema;
}
