// A checked scene into the solver's definition, and the part of it that may change during a run.
#include "server/scene.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "server/scene_check.h"
#include "server/scene_keys.h"
#include "server/scene_tables.h"
#include "server/scenes_data.h"

// All arrays of a definition, freed together.
struct block {
    struct block *next;
    max_align_t bytes[];
};
struct scene {
    cJSON *json; // names and texts of the definition are borrowed from it
    struct block *blocks;
    struct mpm_def def;
    struct scene_config config;
    struct scene_reference *references;
    size_t n_references;
};

// ---- Reading checked JSON
// --------------------------------------------------------------------------- The check has been
// there: types are right and defaults are filled in.

static double number(const cJSON *object, const char *key) {
    const cJSON *member = json_member(object, key);
    return member ? member->valuedouble : 0;
}

static const char *text(const cJSON *object, const char *key) {
    const cJSON *member = json_member(object, key);
    return cJSON_IsString(member) ? member->valuestring : "";
}

static bool text_is(const cJSON *object, const char *key, const char *word) {
    return strcmp(text(object, key), word) == 0;
}

static bool flag(const cJSON *object, const char *key) {
    return cJSON_IsTrue(json_member(object, key));
}

static void numbers(const cJSON *array, double out[MPM_MAX_DIM]) {
    size_t i = 0;
    for (const cJSON *item = array ? array->child : NULL; item && i < MPM_MAX_DIM;
         item = item->next)
        out[i++] = item->valuedouble;
}

static void vector(const cJSON *object, const char *key, double out[MPM_MAX_DIM]) {
    numbers(json_member(object, key), out);
}

static void unit_length(double v[MPM_MAX_DIM]) {
    double length = hypot(hypot(v[0], v[1]), v[2]);
    for (int d = 0; d < MPM_MAX_DIM && length > 0; d++)
        v[d] /= length;
}

static int axis(const cJSON *object, const char *key) {
    const char *word = text(object, key);
    return word[0] ? word[0] - 'x' : 0;
}

static int index_of(const cJSON *map, const char *name) {
    int i = 0;
    for (const cJSON *member = map ? map->child : NULL; member; member = member->next, i++)
        if (strcmp(member->string, name) == 0)
            return i;
    return -1;
}

static size_t count(const cJSON *container) {
    return container ? (size_t)cJSON_GetArraySize(container) : 0;
}

// `n` zeroed elements that live as long as the scene; never NULL for n == 0, NULL when there is no
// memory.
static void *array(struct scene *scene, size_t n, size_t size) {
    struct block *block = calloc(1, sizeof *block + (n ? n : 1) * size);
    if (!block)
        return NULL;
    block->next = scene->blocks;
    scene->blocks = block;
    return block->bytes;
}

// ---- Settings -----------------------------------------------------------------------------------

static struct mpm_fbar read_fbar(const cJSON *json) {
    if (!cJSON_IsObject(json))
        return (struct mpm_fbar){.scheme = cJSON_IsTrue(json) ? MPM_FBAR_ZHAO : MPM_FBAR_OFF};
    return (struct mpm_fbar){
        .scheme = (enum mpm_fbar_scheme)mpm_fbar_parse(text(json, "scheme")),
        .a = number(json, "a"),
        .C = number(json, "C"),
        .keep = number(json, "keep"),
    };
}

static void read_time(const cJSON *time, struct mpm_settings *settings) {
    if (json_member(time, "dt"))
        settings->dt = number(time, "dt");
    if (json_member(time, "cfl")) {
        settings->cfl = number(time, "cfl");
        settings->dt = 0;
    }
}

static struct mpm_settings read_settings(const cJSON *root) {
    struct mpm_settings settings = mpm_settings_default();
    settings.fbar = read_fbar(json_member(root, "fbar"));
    vector(root, "gravity", settings.gravity);
    settings.damping_local = number(json_member(root, "damping"), "local");
    settings.damping_mass = number(json_member(root, "damping"), "mass");
    settings.blend = number(json_member(root, "transfer"), "blend");
    read_time(json_member(root, "time"), &settings);
    return settings;
}

static void read_output(const cJSON *root, struct scene_output *output) {
    const cJSON *json = json_member(root, "output");
    *output = (struct scene_output){
        .interval = number(json, "interval"),
        .probe_interval = number(json, "probe_interval"),
        .checkpoint_interval = number(json, "checkpoint_interval"),
        .journal_bytes = number(json, "journal_bytes"),
        .when_full_block = text_is(json, "when_full", "block"),
        .durability_power = text_is(json, "durability", "power"),
    };
    const cJSON *fields = json_member(json, "fields");
    for (const cJSON *field = fields->child; field; field = field->next)
        output->fields[output->n_fields++] = (enum mpm_field)mpm_field_parse(field->valuestring);
}

static void read_config(const cJSON *root, struct scene_config *config) {
    config->settings = read_settings(root);
    config->end = number(json_member(root, "time"), "end");
    read_output(root, &config->output);
}

// ---- Parts of the definition --------------------------------------------------------------------

static bool read_materials(struct scene *scene) {
    const cJSON *map = json_member(scene->json, "materials");
    struct mpm_def *def = &scene->def;
    struct mpm_material_def *materials = array(scene, count(map), sizeof *materials);
    if (!materials)
        return false;
    for (const cJSON *json = map->child; json; json = json->next) {
        struct mpm_material_def *material = &materials[def->n_materials++];
        material->name = json->string;
        material->model = mpm_material_find(text(json, "model"));
        material->fbar = flag(json, "fbar");
        const struct mpm_parameter *parameter;
        for (size_t k = 0; k < MPM_MAX_PARAMETERS; k++)
            if ((parameter = mpm_material_parameter(material->model, k)))
                material->parameters[k] = number(json, parameter->key);
            else
                break;
    }
    def->materials = materials;
    return true;
}

// Rows of `width` numbers.
static bool read_points(struct scene *scene, const cJSON *rows, size_t width,
                        struct mpm_shape *shape) {
    shape->n_points = count(rows);
    double *points = array(scene, shape->n_points * width, sizeof *points);
    shape->points = points;
    for (const cJSON *row = rows->child; row && points; row = row->next)
        for (const cJSON *item = row->child; item; item = item->next)
            *points++ = item->valuedouble;
    return shape->points != NULL;
}

static bool read_shape(struct scene *scene, const cJSON *json, struct mpm_shape *shape) {
    const cJSON *form = json->child;
    const char *kind = form->string;
    int dimension = scene->def.dimension;
    if (strcmp(kind, "box") == 0) {
        shape->kind = MPM_SHAPE_BOX;
        vector(form, "min", shape->min);
        vector(form, "max", shape->max);
        return true;
    }
    if (strcmp(kind, "disk") == 0 || strcmp(kind, "sphere") == 0) {
        shape->kind = MPM_SHAPE_BALL;
        vector(form, "center", shape->centre);
        shape->radius = number(form, "radius");
        return true;
    }
    if (strcmp(kind, "points") == 0) {
        shape->kind = MPM_SHAPE_POINTS;
        return read_points(scene, form, (size_t)dimension + 1, shape);
    }
    if (strcmp(kind, "polygon") == 0) {
        shape->kind = MPM_SHAPE_POLYGON;
        return read_points(scene, json_member(form, "points"), 2, shape);
    }
    if (strcmp(kind, "extrude") == 0) {
        const cJSON *polygon = json_member(form, "polygon");
        shape->kind = MPM_SHAPE_EXTRUDE;
        shape->min[2] = number(form, "from");
        shape->max[2] = number(form, "to");
        return read_points(
            scene, cJSON_IsObject(polygon) ? json_member(polygon, "points") : polygon, 2, shape);
    }
    if (strcmp(kind, "cylinder") == 0) {
        shape->kind = MPM_SHAPE_CYLINDER;
        vector(form, "from", shape->min);
        vector(form, "to", shape->max);
        shape->radius = number(form, "radius");
        return true;
    }
    shape->kind = strcmp(kind, "union") == 0        ? MPM_SHAPE_UNION
                  : strcmp(kind, "difference") == 0 ? MPM_SHAPE_DIFFERENCE
                                                    : MPM_SHAPE_INTERSECTION;
    struct mpm_shape *children = array(scene, count(form), sizeof *children);
    shape->children = children;
    for (const cJSON *child = form->child; child; child = child->next)
        if (!children || !read_shape(scene, child, &children[shape->n_children++]))
            return false;
    return true;
}

// {KIND: {...}}: which members a kind has is the table of keys' matter.
static void read_solution(const cJSON *json, struct mpm_solution *q) {
    const cJSON *form = json->child;
    q->kind = (enum mpm_solution_kind)mpm_solution_parse(form->string);
    vector(form, "center", q->centre);
    vector(form, "axis", q->vector);
    unit_length(q->vector);
    q->axis = axis(form, "axis");
    q->number = (int)number(form, "number");
    q->from = number(form, json_member(form, "gate") ? "gate" : "from");
    q->length = number(form, json_member(form, "wavelength") ? "wavelength"
                             : json_member(form, "depth")    ? "depth"
                                                             : "length");
    q->inner = number(form, "inner");
    q->outer = number(form, "outer");
    q->amplitude = number(form, json_member(form, "speed") ? "speed" : "amplitude");
    q->rate = number(form, "rate");
    q->period = number(form, "period");
    q->pressure = number(form, "pressure");
}

static void read_body_force(const cJSON *json, struct mpm_body_force_def *force) {
    if (cJSON_IsArray(json)) {
        numbers(json, force->vector);
        for (int d = 0; d < MPM_MAX_DIM; d++)
            if (force->vector[d] != 0)
                force->kind = MPM_BODY_FORCE_UNIFORM;
    } else if (cJSON_IsObject(json)) {
        force->kind = MPM_BODY_FORCE_SOLUTION;
        read_solution(json, &force->solution);
    }
}

static void read_velocity(const cJSON *json, struct mpm_velocity *velocity) {
    const cJSON *form = json->child;
    if (cJSON_IsArray(json)) {
        velocity->kind = MPM_VELOCITY_UNIFORM;
        numbers(json, velocity->vector);
    } else if (strcmp(form->string, "rotation") == 0) {
        velocity->kind = MPM_VELOCITY_ROTATION;
        vector(form, "center", velocity->centre);
        velocity->rate = number(form, "rate");
        vector(form, "axis", velocity->vector);
        unit_length(velocity->vector);
    } else if (strcmp(form->string, "mode") != 0) {
        velocity->kind = MPM_VELOCITY_SOLUTION;
        read_solution(json, &velocity->solution);
    } else {
        velocity->kind = MPM_VELOCITY_MODE;
        velocity->axis = axis(form, "axis");
        velocity->number = (int)number(form, "number");
        velocity->from = number(form, "from");
        velocity->length = number(form, "length");
        velocity->amplitude = number(form, "amplitude");
    }
}

static bool read_bodies(struct scene *scene) {
    const cJSON *map = json_member(scene->json, "bodies");
    const cJSON *materials = json_member(scene->json, "materials");
    struct mpm_def *def = &scene->def;
    struct mpm_body_def *bodies = array(scene, count(map), sizeof *bodies);
    if (!bodies)
        return false;
    for (const cJSON *json = map->child; json; json = json->next) {
        struct mpm_body_def *body = &bodies[def->n_bodies++];
        double particles = number(json, "particles_per_cell");
        body->name = json->string;
        body->material = index_of(materials, text(json, "material"));
        body->particles_per_direction = (int)lround(pow(particles, 1.0 / def->dimension));
        body->closed = text_is(json, "edge", "closed");
        read_velocity(json_member(json, "velocity"), &body->velocity);
        if (!read_shape(scene, json_member(json, "shape"), &body->shape))
            return false;
    }
    def->bodies = bodies;
    return true;
}

static bool read_walls(struct scene *scene) {
    const cJSON *map = json_member(scene->json, "walls");
    struct mpm_def *def = &scene->def;
    struct mpm_wall_def *walls = array(scene, count(map), sizeof *walls);
    if (!walls)
        return false;
    for (const cJSON *json = map->child; json; json = json->next) {
        struct mpm_wall_def *wall = &walls[def->n_walls++];
        const cJSON *span = json_member(json, "span");
        wall->name = json->string;
        wall->axis = axis(json, "axis");
        wall->at = number(json, "at");
        wall->keeps_above = text_is(json, "keeps", "above");
        wall->condition =
            (enum mpm_wall_condition)mpm_wall_condition_parse(text(json, "condition"));
        wall->has_span = span != NULL;
        vector(span, "min", wall->span_min);
        vector(span, "max", wall->span_max);
        vector(json, "velocity", wall->velocity);
    }
    def->walls = walls;
    return true;
}

static void read_select(const cJSON *select, struct mpm_load_def *load) {
    const cJSON *box = json_member(select, "box");
    const char *extreme = text(select, "extreme");
    load->has_box = box != NULL;
    vector(box, "min", load->box_min);
    vector(box, "max", load->box_max);
    if (!box) {
        load->max_side = extreme[0] == '+';
        load->round = extreme[1] == 'r';
        load->axis = load->round ? axis(select, "axis") : extreme[1] - 'x';
        vector(select, "center", load->centre);
    }
}

static bool read_loads(struct scene *scene) {
    const cJSON *map = json_member(scene->json, "loads");
    const cJSON *bodies = json_member(scene->json, "bodies");
    struct mpm_def *def = &scene->def;
    struct mpm_load_def *loads = array(scene, count(map), sizeof *loads);
    if (!loads)
        return false;
    for (const cJSON *json = map->child; json; json = json->next) {
        struct mpm_load_def *load = &loads[def->n_loads++];
        load->name = json->string;
        load->body = index_of(bodies, text(json, "body"));
        read_select(json_member(json, "select"), load);
        load->is_pressure = json_member(json, "pressure") != NULL;
        vector(json, "force", load->force);
        load->pressure = number(json, "pressure");
        load->ramp = number(json, "ramp");
    }
    def->loads = loads;
    return true;
}

static bool read_rigid_bodies(struct scene *scene) {
    const cJSON *map = json_member(scene->json, "rigid_bodies");
    struct mpm_def *def = &scene->def;
    struct mpm_rigid_def *rigids = array(scene, count(map), sizeof *rigids);
    if (!rigids)
        return false;
    for (const cJSON *json = map->child; json; json = json->next) {
        struct mpm_rigid_def *rigid = &rigids[def->n_rigids++];
        const cJSON *contact = json_member(json, "contact");
        rigid->name = json->string;
        vector(json, "velocity", rigid->velocity);
        rigid->stiffness = number(contact, "stiffness");
        rigid->distance = number(contact, "distance");
        rigid->friction = number(contact, "friction");
        if (!read_shape(scene, json_member(json, "shape"), &rigid->shape))
            return false;
    }
    def->rigids = rigids;
    return true;
}

// Patches accumulate: a stage keeps what the stages before it changed.
static bool patch_materials(struct scene *scene, const cJSON *patch,
                            const struct mpm_material_def *before, struct mpm_stage_def *stage) {
    const cJSON *map = json_member(scene->json, "materials");
    size_t n = scene->def.n_materials;
    struct mpm_material_def *materials = array(scene, n, sizeof *materials);
    if (!materials)
        return false;
    if (n)
        memcpy(materials, before, n * sizeof *materials);
    for (const cJSON *change = patch->child; change; change = change->next) {
        struct mpm_material_def *material = &materials[index_of(map, change->string)];
        const struct mpm_parameter *parameter;
        for (size_t k = 0; k < MPM_MAX_PARAMETERS; k++) {
            if (!(parameter = mpm_material_parameter(material->model, k)))
                break;
            const cJSON *value = json_member(change, parameter->key);
            if (value)
                material->parameters[k] =
                    cJSON_IsNull(value) ? parameter->fallback : value->valuedouble;
        }
    }
    stage->materials = materials;
    return true;
}

static void read_stage_settings(const cJSON *json, struct mpm_stage_def *stage) {
    struct mpm_settings *settings = &stage->settings;
    const cJSON *fbar = json_member(json, "fbar"), *gravity = json_member(json, "gravity");
    const cJSON *damping = json_member(json, "damping"), *time = json_member(json, "time");
    const cJSON *blend = json_member(json_member(json, "transfer"), "blend");
    if (fbar) {
        settings->fbar = read_fbar(fbar);
        stage->states |= MPM_SET_FBAR;
    }
    if (gravity) {
        stage->states |= MPM_SET_GRAVITY;
        if (cJSON_IsObject(gravity))
            vector(gravity, "vector", settings->gravity);
        else
            numbers(gravity, settings->gravity);
        stage->gravity_ramp = number(gravity, "ramp");
    }
    if (json_member(json, "ramp")) { // alone, it ramps up the scene's gravity
        stage->states |= MPM_SET_GRAVITY;
        stage->gravity_ramp = number(json, "ramp");
    }
    if (damping && damping->child) {
        stage->states |= MPM_SET_DAMPING;
        if (json_member(damping, "local"))
            settings->damping_local = number(damping, "local");
        if (json_member(damping, "mass"))
            settings->damping_mass = number(damping, "mass");
    }
    if (blend) {
        settings->blend = blend->valuedouble;
        stage->states |= MPM_SET_BLEND;
    }
    if (time && time->child) {
        read_time(time, settings);
        stage->states |= MPM_SET_TIME;
    }
}

// Flags for the members of `map`, `n` of them, whose names are in the list; NULL in `out` for none.
static bool read_removed(struct scene *scene, const cJSON *names, const cJSON *map, size_t n,
                         const bool **out) {
    if (!names || !names->child)
        return true;
    bool *removes = array(scene, n, sizeof *removes);
    if (!removes)
        return false;
    for (const cJSON *name = names->child; name; name = name->next)
        removes[index_of(map, name->valuestring)] = true;
    *out = removes;
    return true;
}

static bool read_stages(struct scene *scene) {
    const cJSON *list = json_member(scene->json, "stages");
    const cJSON *walls = json_member(scene->json, "walls");
    const cJSON *loads = json_member(scene->json, "loads");
    const cJSON *rigids = json_member(scene->json, "rigid_bodies");
    struct mpm_def *def = &scene->def;
    struct mpm_stage_def *stages = array(scene, count(list), sizeof *stages);
    if (!stages)
        return false;
    const struct mpm_material_def *materials = def->materials;
    for (const cJSON *json = list->child; json; json = json->next) {
        struct mpm_stage_def *stage = &stages[def->n_stages++];
        const cJSON *until = json_member(json, "until"), *patch = json_member(json, "materials");
        const cJSON *remove = json_member(json, "remove");
        const cJSON *resets = json_member(json, "reset");
        stage->name = text(json, "name");
        stage->duration = !json->next ? scene->config.end
                          : until     ? number(until, "duration")
                                      : number(json, "duration");
        stage->kinetic_energy_ratio = number(until, "kinetic_energy_ratio");
        stage->settings = def->settings;
        read_stage_settings(json, stage);
        for (const cJSON *word = resets ? resets->child : NULL; word; word = word->next)
            stage->resets |= strcmp(word->valuestring, "velocity") == 0 ? MPM_RESET_VELOCITY
                             : strcmp(word->valuestring, "plastic_strain") == 0
                                 ? MPM_RESET_PLASTIC_STRAIN
                                 : MPM_RESET_DISPLACEMENT;
        if (!read_removed(scene, json_member(remove, "walls"), walls, def->n_walls,
                          &stage->removes_wall) ||
            !read_removed(scene, json_member(remove, "loads"), loads, def->n_loads,
                          &stage->removes_load) ||
            !read_removed(scene, json_member(remove, "rigid_bodies"), rigids, def->n_rigids,
                          &stage->removes_rigid))
            return false;
        if (patch && patch->child) {
            if (!patch_materials(scene, patch, materials, stage))
                return false;
            materials = stage->materials;
        }
    }
    def->stages = stages;
    return true;
}

// A table's positions and values, as far as the scene has those coordinates.
static bool read_table(struct scene *scene, const char *name, struct mpm_probe_def *probe) {
    struct mpm_against *against = &probe->against;
    struct scene_table table;
    const int dimension = scene->def.dimension;
    int places[MPM_MAX_DIM], columns[MPM_MAX_COMPONENTS];
    const int width = probe->component >= 0
                          ? 1
                          : (int)mpm_field_components((enum mpm_field)probe->field, dimension);
    char lacks[40];
    if (!scene_table_read(name, &table))
        return false;
    against->is_table = true;
    against->n = table.n_rows;
    for (int d = 0; d < dimension; d++) {
        const int column = scene_table_column(&table, (const char[2]){(char)('X' + d), 0});
        if (column >= 0) {
            places[against->n_axes] = column;
            against->axis[against->n_axes++] = d;
        }
    }
    scene_table_field(&table, (enum mpm_field)probe->field, probe->component, dimension, columns,
                      lacks);
    double *points = array(scene, table.n_rows * (size_t)against->n_axes, sizeof *points);
    double *values = array(scene, table.n_rows * (size_t)width, sizeof *values);
    against->points = points;
    against->values = values;
    for (size_t k = 0; k < table.n_rows && points && values; k++) {
        const double *row = table.values + k * table.n_columns;
        for (int d = 0; d < against->n_axes; d++)
            *points++ = row[places[d]];
        for (int c = 0; c < width; c++)
            *values++ = row[columns[c]];
    }
    scene_table_free(&table);
    return against->points && against->values;
}

static bool read_error(struct scene *scene, const cJSON *json, struct mpm_probe_def *probe) {
    const cJSON *against = json_member(json, "against"), *exclude = json_member(json, "exclude");
    const char *name;
    probe->norm = (enum mpm_norm)mpm_norm_parse(text(json, "norm"));
    probe->component = -1;
    for (int c = 0;
         (name = scene_field_component((enum mpm_field)probe->field, scene->def.dimension, c)); c++)
        if (*name && text_is(json, "component", name))
            probe->component = c;
    if (exclude && !read_shape(scene, exclude, &probe->exclude))
        return false;
    probe->has_exclude = exclude != NULL;
    if (cJSON_IsString(against))
        return read_table(scene, against->valuestring, probe);
    read_solution(against, &probe->against.solution);
    return true;
}

static bool read_probes(struct scene *scene) {
    const cJSON *map = json_member(scene->json, "probes");
    const cJSON *bodies = json_member(scene->json, "bodies");
    const cJSON *walls = json_member(scene->json, "walls");
    const cJSON *rigids = json_member(scene->json, "rigid_bodies");
    struct mpm_def *def = &scene->def;
    struct mpm_probe_def *probes = array(scene, count(map), sizeof *probes);
    if (!probes)
        return false;
    for (const cJSON *json = map->child; json; json = json->next) {
        struct mpm_probe_def *probe = &probes[def->n_probes++];
        const cJSON *box = json_member(json, "box"), *field = json_member(json, "field");
        probe->name = json->string;
        probe->kind = (enum mpm_probe_kind)mpm_probe_kind_parse(text(json, "kind"));
        probe->body = index_of(bodies, text(json, "body")); // no name: -1, all
        probe->wall = index_of(walls, text(json, "wall"));
        probe->rigid = index_of(rigids, text(json, "rigid_body"));
        probe->field = field ? mpm_field_parse(field->valuestring) : 0;
        probe->axis = axis(json, "axis");
        probe->max_side = text_is(json, "side", "max");
        probe->quantile = number(json, "quantile");
        vector(json, "at", probe->at);
        probe->has_box = box != NULL;
        vector(box, "min", probe->box_min);
        vector(box, "max", probe->box_max);
        probe->scale = number(json, "scale");
        probe->average = number(json, "average");
        if ((probe->has_select = json_member(json, "select") != NULL)) {
            read_select(json_member(json, "select"), &probe->select);
            if (probe->body < 0 && def->n_bodies == 1)
                probe->body = 0;
        }
        if (probe->kind == MPM_PROBE_ERROR && !read_error(scene, json, probe))
            return false;
    }
    def->probes = probes;
    return true;
}

// A value that stands in a table.
static double cited(const cJSON *reference, double end) {
    const cJSON *value = json_member(reference, "value");
    struct scene_table table;
    double found = NAN;
    if (scene_table_read(text(value, "table"), &table))
        found = scene_table_value(&table, scene_table_column(&table, text(value, "column")),
                                  scene_cited_at(reference, end));
    scene_table_free(&table);
    return found;
}

static bool read_references(struct scene *scene) {
    const cJSON *list = json_member(scene->json, "references");
    const cJSON *probes = json_member(scene->json, "probes");
    scene->references = array(scene, count(list), sizeof *scene->references);
    if (!scene->references)
        return false;
    for (const cJSON *json = list->child; json; json = json->next) {
        struct scene_reference *reference = &scene->references[scene->n_references++];
        const cJSON *at = json_member(json, "at");
        const cJSON *probe = json_member(probes, text(json, "probe"));
        const char *name;
        reference->probe = (size_t)index_of(probes, text(json, "probe"));
        for (int c = 0; (name = scene_probe_component(probe, scene->def.dimension, c)); c++)
            if (text_is(json, "component", name))
                reference->component = c;
        reference->at_end = cJSON_IsString(at);
        reference->at = reference->at_end ? 0 : at->valuedouble;
        reference->value = number(json, "value");
        if (cJSON_IsObject(json_member(json, "value")))
            reference->value = cited(json, scene->config.end);
        reference->tolerance = number(json, "tolerance");
        reference->source = text(json, "source");
    }
    return true;
}

// Whether frames or probes need a field that the solver keeps only on demand.
static bool wants(const cJSON *root, enum mpm_field field) {
    const char *name = mpm_field_info(field)->name;
    const cJSON *fields = json_member(json_member(root, "output"), "fields");
    const cJSON *probes = json_member(root, "probes");
    for (const cJSON *item = fields ? fields->child : NULL; item; item = item->next)
        if (strcmp(item->valuestring, name) == 0)
            return true;
    for (const cJSON *probe = probes ? probes->child : NULL; probe; probe = probe->next)
        if (text_is(probe, "field", name) || text_is(probe, "kind", name) ||
            (field == MPM_FIELD_VOLUME_RATIO && text_is(probe, "kind", "drift")))
            return true;
    return false;
}

// What the machine has, so that a scene beyond it is refused before its particles are counted one
// by one; the caller may set less.
static size_t physical_memory(void) {
    long pages = sysconf(_SC_PHYS_PAGES), bytes = sysconf(_SC_PAGESIZE);
    return pages > 0 && bytes > 0 ? (size_t)pages * (size_t)bytes : 0;
}

static bool read_definition(struct scene *scene) {
    const cJSON *root = scene->json, *domain = json_member(root, "domain");
    struct mpm_def *def = &scene->def;
    *def = mpm_def_default();
    read_config(root, &scene->config);
    def->dimension = (int)number(root, "dimension");
    vector(domain, "min", def->domain_min);
    vector(domain, "max", def->domain_max);
    def->cell = number(root, "cell");
    def->basis = (enum mpm_basis)mpm_basis_parse(text(root, "basis"));
    def->settings = scene->config.settings;
    read_body_force(json_member(root, "body_force"), &def->body_force);
    def->unstable_ok = flag(root, "unstable_ok") || flag(json_member(root, "time"), "unstable_ok");
    def->walls_hold_nodes = !flag(root, "mirror_walls");
    def->memory_limit = physical_memory();
    def->wants_displacement = wants(root, MPM_FIELD_DISPLACEMENT);
    def->wants_volume_ratio = wants(root, MPM_FIELD_VOLUME_RATIO);
    def->wants_mean_stress_smooth = wants(root, MPM_FIELD_MEAN_STRESS_SMOOTH);
    return read_materials(scene) && read_bodies(scene) && read_walls(scene) && read_loads(scene) &&
           read_rigid_bodies(scene) && read_stages(scene) && read_probes(scene) &&
           read_references(scene);
}

// ---- Public -------------------------------------------------------------------------------------

static void report(void *context, const struct mpm_error *error) {
    faults_add(context, error->pointer, mpm_status_name(error->status),
               error->expected[0] ? error->expected : NULL, error->actual[0] ? error->actual : NULL,
               "%s", error->message);
}

// The object that holds the member a pointer names, and the member's name in `key`; NULL when there
// is none.
static cJSON *holder_of(cJSON *root, const char *pointer, char *key, size_t n) {
    cJSON *at = root, *holder = NULL;
    while (*pointer == '/') {
        size_t length = 0;
        for (pointer++; *pointer && *pointer != '/' && length < n - 1; pointer++)
            key[length++] =
                *pointer == '~' && pointer[1] ? (*++pointer == '1' ? '/' : '~') : *pointer;
        key[length] = 0;
        holder = at;
        at = cJSON_IsArray(holder) ? cJSON_GetArrayItem(holder, atoi(key))
                                   : json_member(holder, key);
    }
    return at && cJSON_IsObject(holder) ? holder : NULL;
}

// Takes out what is at fault where nothing that mpm_check looks at hangs on it: unknown keys, and
// sections about output and forces. Whether what is left is worth another look.
static bool prune(cJSON *json, const struct faults *faults, size_t from) {
    static const char *const apart[] = {"title", "references",   "probes",    "output",
                                        "loads", "rigid_bodies", "gravity",   "damping",
                                        "fbar",  "transfer",     "body_force"};
    for (size_t i = from; i < faults->count; i++) {
        const struct fault *fault = &faults->items[i];
        char key[256] = "";
        cJSON *holder = NULL;
        if (strcmp(fault->code, "unknown_key") == 0) {
            holder = holder_of(json, fault->pointer, key, sizeof key);
        } else {
            size_t length = strcspn(fault->pointer + !!*fault->pointer, "/");
            for (size_t k = 0; k < sizeof apart / sizeof *apart && !holder; k++)
                if (length == strlen(apart[k]) &&
                    strncmp(fault->pointer + 1, apart[k], length) == 0) {
                    holder = json;
                    snprintf(key, sizeof key, "%s", apart[k]);
                }
            if (!holder)
                return false;
        }
        cJSON_DeleteItemFromObjectCaseSensitive(holder, key);
        if (holder == json && strcmp(key, "probes") == 0) // they name probes
            cJSON_DeleteItemFromObjectCaseSensitive(json, "references");
    }
    return faults->more == 0;
}

// The solver's faults of a scene that has others: as far as it can be built without what is at
// fault.
static void check_rest(const cJSON *json, size_t memory_limit, struct faults *faults, size_t from) {
    struct faults left = {0};
    struct scene *scene = calloc(1, sizeof *scene);
    if (scene && (scene->json = cJSON_Duplicate(json, true)) && cJSON_IsObject(scene->json) &&
        prune(scene->json, faults, from)) {
        scene_check(scene->json, &left);
        if (left.count + left.more == 0 && read_definition(scene))
            scene_examine(scene, memory_limit, faults);
    }
    faults_free(&left);
    scene_free(scene);
}

struct scene *scene_read(const cJSON *json, size_t memory_limit, struct faults *faults) {
    size_t before = faults->count + faults->more, first = faults->count;
    struct scene *scene = calloc(1, sizeof *scene);
    if (!scene || !(scene->json = cJSON_Duplicate(json, true)))
        goto out_of_memory;
    scene_check(scene->json, faults);
    if (faults->count + faults->more == before) {
        if (read_definition(scene))
            return scene;
        goto out_of_memory;
    }
    check_rest(json, memory_limit, faults, first);
    scene_free(scene);
    return NULL;

out_of_memory:
    faults_add(faults, "", "memory", NULL, NULL, "no memory for the scene");
    scene_free(scene);
    return NULL;
}

bool scene_examine(struct scene *scene, size_t memory_limit, struct faults *faults) {
    const size_t limit = scene->def.memory_limit;
    scene->def.memory_limit = memory_limit;
    const bool valid = mpm_check(&scene->def, report, faults) == 0;
    scene->def.memory_limit = limit;
    return valid;
}

struct scene *scene_create(const cJSON *json, struct faults *faults) {
    struct scene *scene = scene_read(json, 0, faults);
    if (scene && !scene_examine(scene, 0, faults)) {
        scene_free(scene);
        return NULL;
    }
    return scene;
}

void scene_free(struct scene *scene) {
    if (!scene)
        return;
    for (struct block *block = scene->blocks, *next; block; block = next) {
        next = block->next;
        free(block);
    }
    cJSON_Delete(scene->json);
    free(scene);
}

struct mpm_def *scene_def(struct scene *scene) {
    return &scene->def;
}

const cJSON *scene_json(const struct scene *scene) {
    return scene->json;
}

const char *scene_title(const struct scene *scene) {
    return text(scene->json, "title");
}

const struct scene_config *scene_config(const struct scene *scene) {
    return &scene->config;
}

const struct scene_reference *scene_references(const struct scene *scene, size_t *n) {
    *n = scene->n_references;
    return scene->references;
}

// ---- What may change during a run ---------------------------------------------------------------

// The members of `from` whose keys are live; of an object with some live keys, those.
static cJSON *live_members(const cJSON *from, const struct scene_key *keys) {
    cJSON *out = cJSON_CreateObject();
    for (const struct scene_key *key = keys; key->name; key++) {
        const cJSON *member = json_member(from, key->name);
        cJSON *copy = NULL;
        if (member && key->live) {
            copy = cJSON_Duplicate(member, true);
        } else if (cJSON_IsObject(member) && key->value.type == SCENE_OBJECT) {
            copy = live_members(member, key->value.keys);
            if (!copy->child) {
                cJSON_Delete(copy);
                copy = NULL;
            }
        }
        if (copy && copy->string)
            cJSON_AddItemToArray(out, copy); // a duplicate carries its key
        else if (copy)
            cJSON_AddItemToObject(out, key->name, copy);
    }
    return out;
}

cJSON *scene_config_json(const cJSON *scene_as_run) {
    return live_members(scene_as_run, scene_root.keys);
}

// `{"fbar": {"scheme": "zhao"}}` on an anchored run means what it says, though a merge alone would
// keep the parameters of the scheme that goes.
static void drop_stale_fbar(cJSON *merged, const cJSON *patch) {
    cJSON *fbar = json_member(merged, "fbar"), *stale;
    const cJSON *change = json_member(patch, "fbar");
    if (!cJSON_IsObject(change) || text_is(fbar, "scheme", mpm_fbar_name(MPM_FBAR_ANCHORED)))
        return;
    static const char *const keys[] = {"a", "C", "keep"};
    for (size_t i = 0; i < sizeof keys / sizeof *keys; i++)
        if (!json_member(change, keys[i]) && (stale = json_member(fbar, keys[i])))
            cJSON_Delete(cJSON_DetachItemViaPointer(fbar, stale));
}

// A patch that brings dt to a run with a cfl, or the other way round: the fault is the patch's.
static void check_time_rivals(cJSON *merged, const cJSON *patch, struct faults *faults) {
    static const char *const names[2] = {"dt", "cfl"};
    cJSON *time = json_member(merged, "time");
    const cJSON *change = json_member(patch, "time");
    for (int k = 0; k < 2; k++) {
        const char *name = names[k], *rival = names[!k];
        const cJSON *given = json_member(change, name);
        if (!given || cJSON_IsNull(given) || json_member(change, rival) ||
            !json_member(time, rival))
            continue;
        char pointer[16], expected[32];
        snprintf(pointer, sizeof pointer, "/time/%s", name);
        snprintf(expected, sizeof expected, "together with \"%s\": null", rival);
        char *actual = json_print(given, false);
        faults_add(faults, pointer, "conflict", expected, actual,
                   "`dt` and `cfl` exclude each other; set `%s` to null in the same patch", rival);
        free(actual);
        cJSON_DeleteItemFromObjectCaseSensitive(time, rival); // said already
    }
}

// A frame can gain a field only where the run has kept it from the start.
static void check_new_fields(const cJSON *before, const cJSON *after, struct faults *faults) {
    static const enum mpm_field kept[] = {MPM_FIELD_DISPLACEMENT, MPM_FIELD_VOLUME_RATIO};
    for (size_t i = 0; i < sizeof kept / sizeof *kept; i++)
        if (wants(after, kept[i]) && !wants(before, kept[i]))
            faults_add(faults, "/output/fields", "conflict", NULL, mpm_field_info(kept[i])->name,
                       "`%s` has to be in the scene from the start", mpm_field_info(kept[i])->name);
}

cJSON *scene_config_patch(const cJSON *scene_as_run, const cJSON *patch, struct scene_config *out,
                          unsigned *which, bool *end_changed, bool *output_changed,
                          struct faults *faults) {
    size_t before = faults->count + faults->more;
    cJSON *merged = NULL, *reachable = cJSON_Duplicate(patch, true);
    scene_check_live(reachable, faults); // what it refuses it takes out: the rest is checked too
    if (cJSON_IsObject(reachable)) {
        merged = json_merge_patch(scene_as_run, reachable);
        drop_stale_fbar(merged, reachable);
        check_time_rivals(merged, reachable, faults);
        scene_check(merged, faults);
    }
    cJSON_Delete(reachable);
    if (faults->count + faults->more == before)
        check_new_fields(scene_as_run, merged, faults);
    if (faults->count + faults->more != before) {
        cJSON_Delete(merged);
        return NULL;
    }
    *out = (struct scene_config){0};
    read_config(merged, out);
    const cJSON *time = json_member(patch, "time");
    *which = (json_member(patch, "fbar") ? MPM_SET_FBAR : 0U) |
             (json_member(patch, "gravity") ? MPM_SET_GRAVITY : 0U) |
             (json_member(patch, "damping") ? MPM_SET_DAMPING : 0U) |
             (json_member(patch, "transfer") ? MPM_SET_BLEND : 0U) |
             (json_member(time, "dt") || json_member(time, "cfl") ? MPM_SET_TIME : 0U);
    *end_changed = json_member(time, "end") != NULL;
    *output_changed = json_member(patch, "output") != NULL;
    return merged;
}

// ---- Built-in scenes ----------------------------------------------------------------------------

size_t scene_builtin_count(void) {
    size_t n = 0;
    while (scenes_data[n].name)
        n++;
    return n;
}

const char *scene_builtin_name(size_t index) {
    return scenes_data[index].name;
}

const char *scene_builtin_text(size_t index, size_t *bytes) {
    *bytes = scenes_data[index].bytes;
    return scenes_data[index].text;
}

cJSON *scene_builtin(const char *name) {
    struct faults faults = {0};
    cJSON *json = NULL;
    for (size_t i = 0; scenes_data[i].name && !json; i++)
        if (strcmp(scenes_data[i].name, name) == 0)
            json = json_parse(scenes_data[i].text, scenes_data[i].bytes, &faults);
    faults_free(&faults);
    return json;
}
