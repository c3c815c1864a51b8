// What the table of keys says about scenes, for machines (JSON Schema 2020-12) and for people
// (the tables of docs/scene.md).
#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/scene.h"
#include "server/scene_keys.h"

// ---- JSON Schema --------------------------------------------------------------------------------

static void put_text(cJSON *object, const char *key, const char *text) {
    cJSON_AddItemToObject(object, key, cJSON_CreateString(text));
}

static void put_number(cJSON *object, const char *key, double value) {
    cJSON_AddItemToObject(object, key, json_number(value));
}

static void put_bounds(cJSON *schema, const struct scene_value *value) {
    if (isfinite(value->min))
        put_number(schema, value->min_open ? "exclusiveMinimum" : "minimum", value->min);
    if (isfinite(value->max))
        put_number(schema, value->max_open ? "exclusiveMaximum" : "maximum", value->max);
}

// {"type": "array", "items": {"type": "number"}} of these lengths.
static cJSON *numbers_schema(int least, int most) {
    cJSON *schema = cJSON_CreateObject(), *item = cJSON_CreateObject();
    put_text(schema, "type", "array");
    put_text(item, "type", "number");
    cJSON_AddItemToObject(schema, "items", item);
    put_number(schema, "minItems", least);
    put_number(schema, "maxItems", most);
    return schema;
}

static cJSON *value_schema(const struct scene_value *value);

// The default as JSON where it does not depend on the rest of the scene, else NULL.
static cJSON *plain_default(const struct scene_key *key) {
    const struct scene_value *value =
        key->value.type == SCENE_EITHER ? key->value.items : &key->value;
    if (!key->fallback || value->type == SCENE_VECTOR)
        return NULL;
    struct faults none = {0};
    cJSON *json = json_parse(key->fallback, strlen(key->fallback), &none);
    faults_free(&none);
    return json;
}

static cJSON *key_schema(const struct scene_key *key) {
    cJSON *schema = value_schema(&key->value), *fallback = plain_default(key);
    char description[400];
    bool computed = key->fallback && !fallback;
    snprintf(description, sizeof description, "%s%s%s%s", key->doc, computed ? "; default: " : "",
             computed ? key->fallback : "",
             key->dimension == 2   ? " (2D only)"
             : key->dimension == 3 ? " (3D only)"
                                   : "");
    put_text(schema, "description", description);
    if (key->value.unit)
        put_text(schema, "unit", key->value.unit);
    if (fallback)
        cJSON_AddItemToObject(schema, "default", fallback);
    if (key->nullable) {
        cJSON *types = cJSON_CreateArray();
        cJSON_AddItemToArray(types, cJSON_DetachItemFromObjectCaseSensitive(schema, "type"));
        cJSON_AddItemToArray(types, cJSON_CreateString("null"));
        cJSON_AddItemToObject(schema, "type", types);
    }
    return schema;
}

// {"not": {"required": [a, b]}}, where null counts as absent.
static cJSON *exclusion_schema(const char *a, const char *b) {
    cJSON *rule = cJSON_CreateObject(), *both = cJSON_AddObjectToObject(rule, "not");
    cJSON *properties = cJSON_AddObjectToObject(both, "properties");
    cJSON *required = cJSON_AddArrayToObject(both, "required");
    const char *const names[] = {a, b};
    for (int i = 0; i < 2; i++) {
        cJSON *property = cJSON_AddObjectToObject(properties, names[i]);
        put_text(cJSON_AddObjectToObject(property, "not"), "type", "null");
        cJSON_AddItemToArray(required, cJSON_CreateString(names[i]));
    }
    return rule;
}

// An object of these keys; with `chosen` >= 0 of those that go with that choice of the selector.
static cJSON *keys_schema(const struct scene_key *keys, int chosen) {
    cJSON *schema = cJSON_CreateObject();
    put_text(schema, "type", "object");
    cJSON *properties = cJSON_AddObjectToObject(schema, "properties");
    cJSON *required = cJSON_CreateArray(), *rules = cJSON_CreateArray();
    for (const struct scene_key *key = keys; key->name; key++) {
        if (chosen >= 0 && key->only && !(key->only & 1U << chosen))
            continue;
        cJSON *property = key_schema(key);
        if (key->selector && chosen >= 0) {
            cJSON_DeleteItemFromObjectCaseSensitive(property, "enum");
            put_text(property, "const", key->value.choice((size_t)chosen));
        }
        cJSON_AddItemToObject(properties, key->name, property);
        if ((key->required && !key->dimension) || (chosen >= 0 && (key->needs & 1U << chosen)))
            cJSON_AddItemToArray(required, cJSON_CreateString(key->name));
        for (const struct scene_key *rival = keys; key->excludes && rival < key; rival++)
            if (strcmp(rival->name, key->excludes) == 0)
                cJSON_AddItemToArray(rules, exclusion_schema(rival->name, key->name));
    }
    if (required->child)
        cJSON_AddItemToObject(schema, "required", required);
    else
        cJSON_Delete(required);
    if (rules->child)
        cJSON_AddItemToObject(schema, "allOf", rules);
    else
        cJSON_Delete(rules);
    cJSON_AddFalseToObject(schema, "additionalProperties");
    return schema;
}

static cJSON *object_schema(const struct scene_key *keys) {
    const struct scene_key *selector = keys;
    while (selector->name && !selector->selector)
        selector++;
    if (!selector->name)
        return keys_schema(keys, -1);
    cJSON *schema = cJSON_CreateObject(), *forms = cJSON_AddArrayToObject(schema, "oneOf");
    for (int i = 0; selector->value.choice((size_t)i); i++)
        cJSON_AddItemToArray(forms, keys_schema(keys, i));
    return schema;
}

static cJSON *one_key_schema(const struct scene_value *value) {
    cJSON *schema = keys_schema(value->keys, -1);
    put_number(schema, "minProperties", 1);
    put_number(schema, "maxProperties", 1);
    return schema;
}

static cJSON *material_schema(void) {
    cJSON *schema = cJSON_CreateObject(), *forms = cJSON_AddArrayToObject(schema, "oneOf");
    const struct mpm_material *model;
    for (size_t i = 0; i < mpm_material_count(); i++) {
        struct scene_material_keys table;
        model = mpm_material_at(i);
        scene_material_keys(model, &table);
        cJSON *form = keys_schema(table.keys, -1);
        put_text(form, "description", mpm_material_doc(model));
        cJSON *property = json_member(json_member(form, "properties"), "model");
        cJSON_DeleteItemFromObjectCaseSensitive(property, "enum");
        put_text(property, "const", mpm_material_name(model));
        cJSON_AddItemToArray(forms, form);
    }
    return schema;
}

// What a stage may change of a material: which of these parameters it has depends on its model,
// which stands elsewhere. A name that several models have means the same in all of them, bounds
// included.
static cJSON *material_patch_schema(void) {
    cJSON *schema = cJSON_CreateObject();
    put_text(schema, "type", "object");
    cJSON *properties = cJSON_AddObjectToObject(schema, "properties");
    for (size_t i = 0; i < mpm_material_count(); i++) {
        struct scene_material_keys table;
        scene_material_keys(mpm_material_at(i), &table);
        for (const struct scene_key *key = table.keys; key->name; key++) {
            if (key->value.type != SCENE_NUMBER || strcmp(key->name, "density") == 0 ||
                json_member(properties, key->name))
                continue;
            cJSON *property = key_schema(key);
            cJSON *types = cJSON_CreateArray(); // null: back to the default
            cJSON_AddItemToArray(types, cJSON_CreateString("number"));
            cJSON_AddItemToArray(types, cJSON_CreateString("null"));
            cJSON_DeleteItemFromObjectCaseSensitive(property, "type");
            cJSON_AddItemToObject(property, "type", types);
            cJSON_AddItemToObject(properties, key->name, property);
        }
    }
    cJSON_AddFalseToObject(schema, "additionalProperties");
    return schema;
}

static cJSON *value_schema(const struct scene_value *value) {
    cJSON *schema = NULL;
    const char *word;
    switch (value->type) {
    case SCENE_VECTOR:
        return numbers_schema(2, MPM_MAX_DIM);
    case SCENE_OBJECT:
        return object_schema(value->keys);
    case SCENE_MATERIAL:
        return material_schema();
    case SCENE_ONE_KEY:
        if (!value->definition)
            return one_key_schema(value);
        break;
    default:
        break;
    }
    schema = cJSON_CreateObject();
    switch (value->type) {
    case SCENE_VECTOR:
    case SCENE_OBJECT:
    case SCENE_MATERIAL:
        break;
    case SCENE_BOOL:
        put_text(schema, "type", "boolean");
        break;
    case SCENE_NUMBER:
    case SCENE_INTEGER:
        put_text(schema, "type", value->type == SCENE_NUMBER ? "number" : "integer");
        put_bounds(schema, value);
        break;
    case SCENE_LATTICE:
        put_text(schema, "type", "integer");
        put_number(schema, "minimum", 1);
        put_number(schema, "maximum", pow(SCENE_MAX_PARTICLES_PER_DIRECTION, MPM_MAX_DIM));
        break;
    case SCENE_TEXT:
        put_text(schema, "type", "string");
        put_number(schema, "maxLength", SCENE_MAX_TEXT);
        break;
    case SCENE_CHOICE: {
        put_text(schema, "type", "string");
        cJSON *words = cJSON_AddArrayToObject(schema, "enum");
        for (size_t i = 0; (word = value->choice(i)); i++)
            cJSON_AddItemToArray(words, cJSON_CreateString(word));
        break;
    }
    case SCENE_NAME:
        put_text(schema, "type", "string");
        put_text(schema, "pattern", SCENE_NAME_PATTERN);
        break;
    case SCENE_POINTS:
        put_text(schema, "type", "array");
        cJSON_AddItemToObject(schema, "items", numbers_schema(3, MPM_MAX_DIM + 1));
        put_number(schema, "minItems", 1);
        put_number(schema, "maxItems", SCENE_MAX_POINTS);
        break;
    case SCENE_OUTLINE:
        put_text(schema, "type", "array");
        cJSON_AddItemToObject(schema, "items", numbers_schema(2, 2));
        put_number(schema, "minItems", 3);
        put_number(schema, "maxItems", SCENE_MAX_OUTLINE);
        break;
    case SCENE_ONE_KEY: {
        char reference[64];
        snprintf(reference, sizeof reference, "#/$defs/%s", value->definition);
        put_text(schema, "$ref", reference);
        break;
    }
    case SCENE_MAP: {
        put_text(schema, "type", "object");
        put_text(cJSON_AddObjectToObject(schema, "propertyNames"), "pattern", SCENE_NAME_PATTERN);
        cJSON_AddItemToObject(schema, "additionalProperties", value_schema(value->items));
        put_number(schema, "maxProperties", SCENE_MAX_NAMED);
        break;
    }
    case SCENE_LIST:
        put_text(schema, "type", "array");
        cJSON_AddItemToObject(schema, "items", value_schema(value->items));
        put_number(schema, "maxItems", SCENE_MAX_NAMED);
        if (value->items->definition)
            put_number(schema, "minItems", 1);
        if (value->unique)
            cJSON_AddTrueToObject(schema, "uniqueItems");
        break;
    case SCENE_EITHER: {
        cJSON *forms = cJSON_AddArrayToObject(schema, "oneOf");
        for (size_t i = 0; i < value->n_items; i++)
            cJSON_AddItemToArray(forms, value_schema(&value->items[i]));
        break;
    }
    case SCENE_MATERIAL_PATCH:
        put_text(schema, "type", "object");
        cJSON_AddItemToObject(schema, "additionalProperties", material_patch_schema());
        break;
    }
    return schema;
}

// Adds to $defs what refers to itself, wherever it is reached from `keys`.
static void add_definitions(cJSON *definitions, const struct scene_value *value) {
    if (value->definition) {
        if (json_member(definitions, value->definition))
            return;
        cJSON_AddItemToObject(definitions, value->definition, one_key_schema(value));
    }
    for (const struct scene_key *key = value->keys; key && key->name; key++)
        add_definitions(definitions, &key->value);
    size_t n = value->type == SCENE_EITHER ? value->n_items : value->items ? 1 : 0;
    for (size_t i = 0; i < n; i++)
        add_definitions(definitions, &value->items[i]);
}

cJSON *scene_schema(void) {
    cJSON *schema = object_schema(scene_root.keys), *definitions = cJSON_CreateObject();
    cJSON *full = cJSON_CreateObject();
    put_text(full, "$schema", "https://json-schema.org/draft/2020-12/schema");
    put_text(full, "title", "A scene of fbard");
    put_text(
        full, "description",
        "What a schema cannot say (names that must exist, node planes, stability) is checked by "
        "POST /v1/scenes:validate.");
    for (cJSON *member; (member = schema->child);)
        cJSON_AddItemToArray(full, cJSON_DetachItemViaPointer(schema, member));
    cJSON_Delete(schema);
    add_definitions(definitions, &scene_root);
    cJSON_AddItemToObject(full, "$defs", definitions);
    return full;
}

static cJSON *patch_of_keys(const struct scene_key *keys, bool live);

// What a merge patch may put in the place of the value, or null: back to the default.
static cJSON *patch_of_value(const struct scene_value *value) {
    cJSON *schema = cJSON_CreateObject(), *forms = cJSON_AddArrayToObject(schema, "anyOf");
    const bool either = value->type == SCENE_EITHER;
    const size_t n = either ? value->n_items : 1;
    const struct scene_value *items = either ? value->items : value;
    for (size_t i = 0; i < n; i++)
        cJSON_AddItemToArray(forms, items[i].type == SCENE_OBJECT
                                        ? patch_of_keys(items[i].keys, true)
                                        : value_schema(&items[i]));
    cJSON *null = cJSON_CreateObject();
    put_text(null, "type", "null");
    cJSON_AddItemToArray(forms, null);
    return schema;
}

// A patch of an object: any of the keys that may change. `live`: all of them may.
static cJSON *patch_of_keys(const struct scene_key *keys, bool live) {
    cJSON *schema = cJSON_CreateObject();
    put_text(schema, "type", "object");
    cJSON *properties = cJSON_AddObjectToObject(schema, "properties");
    for (const struct scene_key *key = keys; key->name; key++) {
        cJSON *property = NULL;
        if (live || key->live) {
            property = patch_of_value(&key->value);
            put_text(property, "description", key->doc);
        } else if (key->value.type == SCENE_OBJECT) {
            property = patch_of_keys(key->value.keys, false);
            if (!json_member(property, "properties")->child) {
                cJSON_Delete(property);
                continue;
            }
        }
        if (property)
            cJSON_AddItemToObject(properties, key->name, property);
    }
    cJSON_AddFalseToObject(schema, "additionalProperties");
    return schema;
}

cJSON *scene_patch_schema(void) {
    return patch_of_keys(scene_root.keys, false);
}

cJSON *scene_materials_json(void) {
    cJSON *out = cJSON_CreateObject(), *list = cJSON_AddArrayToObject(out, "materials");
    for (size_t i = 0; i < mpm_material_count(); i++) {
        const struct mpm_material *model = mpm_material_at(i);
        const struct mpm_parameter *p;
        cJSON *material = cJSON_CreateObject();
        put_text(material, "name", mpm_material_name(model));
        put_text(material, "description", mpm_material_doc(model));
        cJSON *parameters = cJSON_AddArrayToObject(material, "parameters");
        for (size_t k = 0; k < MPM_MAX_PARAMETERS && (p = mpm_material_parameter(model, k)); k++) {
            cJSON *parameter = cJSON_CreateObject();
            put_text(parameter, "key", p->key);
            put_text(parameter, "unit", p->unit);
            put_text(parameter, "description", p->doc);
            cJSON_AddBoolToObject(parameter, "required", p->required);
            put_number(parameter, "default", p->required ? NAN : p->fallback);
            put_number(parameter, "min", p->min <= -DBL_MAX ? NAN : p->min);
            put_number(parameter, "max", p->max >= DBL_MAX ? NAN : p->max);
            cJSON_AddBoolToObject(parameter, "min_open", p->min_open);
            cJSON_AddBoolToObject(parameter, "max_open", p->max_open);
            cJSON_AddItemToArray(parameters, parameter);
        }
        cJSON_AddItemToArray(list, material);
    }
    return out;
}

// ---- Reference for people -----------------------------------------------------------------------

#define MAX_SECTIONS 64
struct reference {
    FILE *out;
    const char *done[MAX_SECTIONS];
    size_t n_done;
};

// The object behind a value, of whose keys a section tells; NULL when there is none.
static const struct scene_value *value_section(const struct scene_value *value) {
    if (value->section)
        return value;
    size_t n = value->type == SCENE_EITHER ? value->n_items : value->items ? 1 : 0;
    for (size_t i = 0; i < n; i++) {
        const struct scene_value *found = value_section(&value->items[i]);
        if (found)
            return found;
    }
    return NULL;
}

static void write_choices(FILE *out, const struct scene_key *selector, unsigned mask) {
    const char *word, *comma = "";
    for (size_t i = 0; (word = selector->value.choice(i)); i++)
        if (mask & 1U << i) {
            fprintf(out, "%s`%s`", comma, word);
            comma = ", ";
        }
}

// Text in a cell of a table.
static void write_cell(FILE *out, const char *text) {
    for (; *text; text++)
        fprintf(out, *text == '|' ? "\\%c" : "%c", *text);
}

static void write_key(FILE *out, const struct scene_key *keys, const struct scene_key *key,
                      bool live) {
    char type[400];
    scene_describe(&key->value, type, sizeof type);
    const struct scene_value *below = value_section(&key->value);
    const struct scene_key *selector = keys;
    while (selector->name && !selector->selector)
        selector++;
    fprintf(out, "| `%s` | %s", key->name, type);
    if (below)
        fprintf(out, " (see %s)", below->section);
    fprintf(out, " | ");
    if (key->required)
        fprintf(out, "required");
    else if (key->fallback)
        fprintf(out, "`%s`", key->fallback);
    fprintf(out, " | ");
    write_cell(out, key->doc);
    if (key->dimension)
        fprintf(out, " (%dD only)", key->dimension);
    if (key->only) {
        fprintf(out, "; with ");
        write_choices(out, selector, key->only);
    }
    if (key->needs && key->needs == key->only)
        fprintf(out, ", which need%s it", key->needs & (key->needs - 1) ? "" : "s");
    if (key->excludes)
        fprintf(out, "; not with `%s`", key->excludes);
    fprintf(out, " | %s |\n", live || key->live ? "yes" : "");
}

static void write_keys(FILE *out, const char *heading, const char *text,
                       const struct scene_key *keys, bool live) {
    fprintf(out, "\n### %s\n\n%s%s", heading, text, text[0] ? "\n\n" : "");
    fprintf(out, "| key | value | default | meaning | may change |\n|---|---|---|---|---|\n");
    for (const struct scene_key *key = keys; key->name; key++)
        write_key(out, keys, key, live);
}

// A section for each object reached from `value`, each once, outer ones first. `live`: the object
// as a whole may change during a run, and so its keys.
static void write_sections(struct reference *r, const struct scene_value *value, bool live) {
    if (value->section) {
        for (size_t i = 0; i < r->n_done; i++)
            if (strcmp(r->done[i], value->section) == 0)
                return;
        if (r->n_done == MAX_SECTIONS)
            return;
        r->done[r->n_done++] = value->section;
        write_keys(r->out, value->section, "", value->keys, live);
    }
    for (const struct scene_key *key = value->keys; key && key->name; key++)
        write_sections(r, &key->value, live || key->live);
    size_t n = value->type == SCENE_EITHER ? value->n_items : value->items ? 1 : 0;
    for (size_t i = 0; i < n; i++)
        write_sections(r, &value->items[i], live);
    for (size_t i = 0; value->type == SCENE_MATERIAL && i < mpm_material_count(); i++) {
        const struct mpm_material *model = mpm_material_at(i);
        struct scene_material_keys table;
        char heading[80];
        scene_material_keys(model, &table);
        snprintf(heading, sizeof heading, "`materials.NAME` of model `%s`",
                 mpm_material_name(model));
        write_keys(r->out, heading, mpm_material_doc(model), table.keys, false);
    }
}

char *scene_reference_markdown(void) {
    char *text = NULL;
    size_t bytes = 0;
    struct reference reference = {.out = open_memstream(&text, &bytes)};
    if (!reference.out)
        return NULL;
    write_sections(&reference, &scene_root, false);
    fclose(reference.out);
    return text;
}
