// Scenes: what is refused (by pointer and code), what is filled in, what the definition then says,
// what may be patched, and that schema and documentation follow the table of keys.
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
#include "server/scene_keys.h"

#define COUNT(list) (sizeof(list) / sizeof *(list))

// The smallest scene with a bit of everything; faults are patches of it.
static const char base_text[] =
    "{\"format\":\"fbard-scene-1\",\"dimension\":2,\"domain\":{\"min\":[0,0],\"max\":[4,4]},"
    "\"cell\":0.5,"
    "\"time\":{\"end\":1},\"gravity\":[0,-9.81],"
    "\"materials\":{\"water\":{\"model\":\"newtonian\",\"density\":1000,\"bulk_modulus\":1e6},"
    "\"rubber\":{\"model\":\"neo_hookean\",\"density\":1000,\"youngs_modulus\":1e5,\"poisson_"
    "ratio\":0.3}},"
    "\"bodies\":{\"pool\":{\"material\":\"water\",\"shape\":{\"box\":{\"min\":[0,0],\"max\":[2,1]}}"
    "},"
    "\"ball\":{\"material\":\"rubber\",\"shape\":{\"disk\":{\"center\":[2,3],\"radius\":0.5}}}},"
    "\"walls\":{\"floor\":{\"axis\":\"y\",\"at\":0,\"keeps\":\"above\"},"
    "\"left\":{\"axis\":\"x\",\"at\":0,\"keeps\":\"above\",\"condition\":\"separate\"}},"
    "\"probes\":{\"front\":{\"kind\":\"extent\",\"axis\":\"x\"},\"energy\":{\"kind\":\"energy\"}},"
    "\"references\":[{\"probe\":\"front\",\"at\":\"end\",\"value\":3,\"tolerance\":0.1}]}";

// A rigid body over the pool, and more keys of it.
#define FOOT_CONTACT "\"contact\":{\"stiffness\":500,\"distance\":0.01}"
#define FOOT_SHAPE "\"shape\":{\"box\":{\"min\":[0.5,1],\"max\":[1,2]}}"
#define FOOT(more) "\"rigid_bodies\":{\"foot\":{" FOOT_SHAPE "," FOOT_CONTACT more "}}"

static cJSON *parse(const char *text) {
    struct faults faults = {0};
    cJSON *json = json_parse(text, strlen(text), &faults);
    if (!json)
        print_error("%s: %s\n", text, faults.items[0].detail);
    assert_non_null(json);
    return json;
}

static cJSON *patched_base(const char *patch_text) {
    cJSON *base = parse(base_text), *patch = parse(patch_text);
    cJSON *merged = json_merge_patch(base, patch);
    cJSON_Delete(base);
    cJSON_Delete(patch);
    return merged;
}

static void print_faults(const struct faults *faults) {
    for (size_t i = 0; i < faults->count; i++)
        print_error("  %s: %s: %s (expected %s, got %s)\n", faults->items[i].pointer,
                    faults->items[i].code, faults->items[i].detail, faults->items[i].expected,
                    faults->items[i].actual);
}

static bool has_fault(const struct faults *faults, const char *pointer, const char *code) {
    for (size_t i = 0; i < faults->count; i++)
        if (strcmp(faults->items[i].pointer, pointer) == 0 &&
            strcmp(faults->items[i].code, code) == 0)
            return true;
    return false;
}

static struct scene *create(const char *patch_text) {
    cJSON *json = patched_base(patch_text);
    struct faults faults = {0};
    struct scene *scene = scene_create(json, &faults);
    if (!scene) {
        print_error("refused: %s\n", patch_text);
        print_faults(&faults);
    }
    assert_non_null(scene);
    assert_int_equal(faults.count, 0);
    cJSON_Delete(json);
    return scene;
}

// Exactly one fault.
static void assert_fault(const char *patch_text, const char *pointer, const char *code) {
    cJSON *json = patched_base(patch_text);
    struct faults faults = {0};
    struct scene *scene = scene_create(json, &faults);
    if (scene || faults.count != 1 || !has_fault(&faults, pointer, code)) {
        print_error("%s: wanted one fault %s %s, got %zu\n", patch_text, pointer, code,
                    faults.count);
        print_faults(&faults);
    }
    assert_null(scene);
    assert_int_equal(faults.count, 1);
    assert_true(has_fault(&faults, pointer, code));
    assert_non_null(faults.items[0].detail);
    faults_free(&faults);
    cJSON_Delete(json);
}

static bool detail_has(const char *patch_text, const char *words) {
    cJSON *json = patched_base(patch_text);
    struct faults faults = {0};
    assert_null(scene_create(json, &faults));
    bool found = strstr(faults.items[0].detail, words) != NULL;
    if (!found)
        print_faults(&faults);
    faults_free(&faults);
    cJSON_Delete(json);
    return found;
}

// ---- Faults -------------------------------------------------------------------------------------

static void test_scene_refuses_wrong_types(void **state) {
    (void)state;
    assert_fault("{\"cell\":\"0.5\"}", "/cell", "type");
    assert_fault("{\"title\":3}", "/title", "type");
    assert_fault("{\"unstable_ok\":1}", "/unstable_ok", "type");
    assert_fault("{\"time\":7}", "/time", "type");
    assert_fault("{\"bodies\":[]}", "/bodies", "type");
    assert_fault("{\"stages\":{\"a\":1}}", "/stages", "type");
    assert_fault("{\"gravity\":9.81}", "/gravity", "type");
    assert_fault("{\"gravity\":[0,\"g\"]}", "/gravity/1", "type");
    assert_fault("{\"gravity\":[0,null]}", "/gravity/1", "type");
    assert_fault("{\"basis\":2}", "/basis", "type");
    assert_fault("{\"fbar\":\"zhao\"}", "/fbar", "type");
    assert_fault("{\"materials\":{\"water\":{\"density\":\"1\"}}}", "/materials/water/density",
                 "type");
    assert_fault("{\"materials\":{\"gas\":3}}", "/materials/gas", "type");
    assert_fault("{\"bodies\":{\"pool\":{\"shape\":[]}}}", "/bodies/pool/shape", "type");
    assert_fault("{\"bodies\":{\"pool\":{\"velocity\":1}}}", "/bodies/pool/velocity", "type");
    assert_fault("{\"bodies\":{\"pool\":{\"particles_per_cell\":4.5}}}",
                 "/bodies/pool/particles_per_cell", "type");
    assert_fault("{\"output\":{\"journal_bytes\":2000000.5}}", "/output/journal_bytes", "type");
    assert_fault("{\"references\":[1]}", "/references/0", "type");
    assert_fault("{\"loads\":[]}", "/loads", "type");
}

static void test_scene_refuses_values_out_of_bounds(void **state) {
    (void)state;
    assert_fault("{\"cell\":0}", "/cell", "range");
    assert_fault("{\"cell\":-1}", "/cell", "range");
    assert_fault("{\"time\":{\"end\":0}}", "/time/end", "range");
    assert_fault("{\"time\":{\"dt\":0}}", "/time/dt", "range");
    assert_fault("{\"damping\":{\"local\":1}}", "/damping/local", "range");
    assert_fault("{\"damping\":{\"mass\":-1}}", "/damping/mass", "range");
    assert_fault("{\"transfer\":{\"blend\":1.01}}", "/transfer/blend", "range");
    assert_fault("{\"fbar\":{\"scheme\":\"anchored\",\"a\":0}}", "/fbar/a", "range");
    assert_fault("{\"fbar\":{\"scheme\":\"anchored\",\"C\":-1}}", "/fbar/C", "range");
    assert_fault("{\"fbar\":{\"scheme\":\"anchored\",\"keep\":1.1}}", "/fbar/keep", "range");
    assert_fault("{\"materials\":{\"rubber\":{\"poisson_ratio\":0.5}}}",
                 "/materials/rubber/poisson_ratio", "range");
    assert_fault("{\"materials\":{\"rubber\":{\"youngs_modulus\":0}}}",
                 "/materials/rubber/youngs_modulus", "range");
    assert_fault("{\"materials\":{\"water\":{\"viscosity\":-1e-3}}}", "/materials/water/viscosity",
                 "range");
    assert_fault("{\"bodies\":{\"ball\":{\"shape\":{\"disk\":{\"radius\":0}}}}}",
                 "/bodies/ball/shape/disk/radius", "range");
    assert_fault("{\"bodies\":{\"pool\":{\"shape\":{\"box\":{\"max\":[0,1]}}}}}",
                 "/bodies/pool/shape/box/max/0", "range");
    assert_fault("{\"domain\":{\"max\":[4,0]}}", "/domain/max/1", "range");
    assert_fault("{\"probes\":{\"front\":{\"quantile\":0}}}", "/probes/front/quantile", "range");
    assert_fault("{\"output\":{\"interval\":-1}}", "/output/interval", "range");
    assert_fault("{\"dimension\":4}", "/dimension", "range");
    assert_true(detail_has("{\"cell\":-1}", "> 0 in m"));
}

static void test_scene_refuses_particles_that_are_no_lattice(void **state) {
    (void)state;
    assert_fault("{\"bodies\":{\"pool\":{\"particles_per_cell\":5}}}",
                 "/bodies/pool/particles_per_cell", "range");
    assert_fault("{\"bodies\":{\"pool\":{\"particles_per_cell\":0}}}",
                 "/bodies/pool/particles_per_cell", "range");
    assert_fault("{\"bodies\":{\"pool\":{\"particles_per_cell\":1e12}}}",
                 "/bodies/pool/particles_per_cell", "range");
    assert_true(detail_has("{\"bodies\":{\"pool\":{\"particles_per_cell\":5}}}", "4 and 9"));
    assert_true(detail_has("{\"bodies\":{\"pool\":{\"particles_per_cell\":15}}}", "9 and 16"));
}

static void test_scene_refuses_missing_keys(void **state) {
    (void)state;
    static const char *const keys[] = {"format", "dimension", "domain", "cell", "time"};
    for (size_t i = 0; i < COUNT(keys); i++) {
        char patch[64], pointer[64];
        snprintf(patch, sizeof patch, "{\"%s\":null}", keys[i]);
        snprintf(pointer, sizeof pointer, "/%s", keys[i]);
        assert_fault(patch, pointer, "required");
    }
    assert_fault("{\"time\":{\"end\":null}}", "/time/end", "required");
    assert_fault("{\"materials\":{\"water\":{\"model\":null}}}", "/materials/water/model",
                 "required");
    assert_fault("{\"materials\":{\"water\":{\"density\":null}}}", "/materials/water/density",
                 "required");
    assert_fault("{\"bodies\":{\"pool\":{\"material\":null}}}", "/bodies/pool/material",
                 "required");
    assert_fault("{\"walls\":{\"floor\":{\"at\":null}}}", "/walls/floor/at", "required");
    assert_fault("{\"probes\":{\"front\":{\"axis\":null}}}", "/probes/front/axis", "required");
    assert_fault("{\"probes\":{\"p\":{\"kind\":\"field\",\"field\":\"velocity\"}}}", "/probes/p/at",
                 "required");
    assert_fault("{\"probes\":{\"p\":{\"kind\":\"displacement\"}}}", "/probes/p/at", "required");
    assert_fault("{\"probes\":{\"p\":{\"kind\":\"reaction\"}}}", "/probes/p/wall", "required");
    assert_fault("{\"fbar\":{\"a\":0.05}}", "/fbar/scheme", "required");
}

static void test_scene_refuses_unknown_keys_with_a_suggestion(void **state) {
    (void)state;
    assert_fault("{\"gravty\":[0,0]}", "/gravty", "unknown_key");
    assert_fault("{\"Cell\":1}", "/Cell", "unknown_key");
    assert_fault("{\"a/b~c\":1}", "/a~1b~0c", "unknown_key");
    assert_fault("{\"materials\":{\"rubber\":{\"poissons_ratio\":0.3}}}",
                 "/materials/rubber/poissons_ratio", "unknown_key");
    assert_fault("{\"materials\":{\"water\":{\"youngs_modulus\":1}}}",
                 "/materials/water/youngs_modulus", "unknown_key");
    assert_fault("{\"bodies\":{\"ball\":{\"shape\":{\"disk\":{\"centre\":[0,0]}}}}}",
                 "/bodies/ball/shape/disk/centre", "unknown_key");
    assert_fault("{\"bodies\":{\"ball\":{\"shape\":{\"disk\":null,\"cone\":1}}}}",
                 "/bodies/ball/shape/cone", "unknown_key");
    assert_true(detail_has("{\"gravty\":[0,0]}", "did you mean \"gravity\""));
    assert_true(detail_has("{\"GRAVITY\":[0,0]}", "did you mean \"gravity\""));
    assert_true(detail_has("{\"materials\":{\"rubber\":{\"poissons_ratio\":0.3}}}",
                           "did you mean \"poisson_ratio\""));
    assert_false(detail_has("{\"xyzzy\":1}", "did you mean"));
}

static void test_scene_refuses_unknown_words_and_names(void **state) {
    (void)state;
    assert_fault("{\"format\":\"fbard-scene-2\"}", "/format", "choice");
    assert_fault("{\"basis\":\"bspline\"}", "/basis", "choice");
    assert_fault("{\"transfer\":{\"scheme\":\"apic\"}}", "/transfer/scheme", "choice");
    assert_fault("{\"fbar\":{\"scheme\":\"zao\"}}", "/fbar/scheme", "choice");
    assert_fault("{\"materials\":{\"water\":{\"model\":\"newton\"}}}", "/materials/water/model",
                 "choice");
    assert_fault("{\"walls\":{\"floor\":{\"condition\":\"sticky\"}}}", "/walls/floor/condition",
                 "choice");
    assert_fault("{\"walls\":{\"floor\":{\"axis\":\"w\"}}}", "/walls/floor/axis", "choice");
    assert_fault("{\"probes\":{\"front\":{\"kind\":\"extend\"}}}", "/probes/front/kind", "choice");
    assert_fault("{\"output\":{\"fields\":[\"position\",\"pressure\"]}}", "/output/fields/1",
                 "choice");
    assert_fault("{\"stages\":[{\"name\":\"a\",\"reset\":[\"strain\"]}]}", "/stages/0/reset/0",
                 "choice");
    assert_fault("{\"bodies\":{\"pool\":{\"material\":\"watr\"}}}", "/bodies/pool/material",
                 "unknown_name");
    assert_fault("{\"probes\":{\"front\":{\"body\":\"poool\"}}}", "/probes/front/body",
                 "unknown_name");
    assert_fault("{\"probes\":{\"r\":{\"kind\":\"reaction\",\"wall\":\"roof\"}}}", "/probes/r/wall",
                 "unknown_name");
    assert_fault("{\"stages\":[{\"name\":\"a\",\"remove\":{\"walls\":[\"flor\"]}}]}",
                 "/stages/0/remove/walls/0", "unknown_name");
    assert_fault(
        "{\"stages\":[{\"name\":\"a\",\"materials\":{\"rubbr\":{\"poisson_ratio\":0.2}}}]}",
        "/stages/0/materials/rubbr", "unknown_name");
    assert_fault("{\"references\":[{\"probe\":\"frnt\",\"at\":1,\"value\":1,\"tolerance\":1}]}",
                 "/references/0/probe", "unknown_name");
    assert_true(detail_has("{\"bodies\":{\"pool\":{\"material\":\"watr\"}}}", "mean \"water\""));
    assert_true(detail_has("{\"basis\":\"bspline\"}", "mean \"bspline2\""));
}

static void test_scene_refuses_what_does_not_go_together(void **state) {
    (void)state;
    assert_fault("{\"time\":{\"dt\":1e-4,\"cfl\":0.3}}", "/time/cfl", "conflict");
    assert_fault("{\"fbar\":{\"scheme\":\"zhao\",\"a\":0.1}}", "/fbar/a", "conflict");
    assert_fault("{\"fbar\":{\"scheme\":\"zhao\",\"keep\":0.1}}", "/fbar/keep", "conflict");
    assert_fault("{\"probes\":{\"energy\":{\"axis\":\"x\"}}}", "/probes/energy/axis", "conflict");
    assert_fault("{\"output\":{\"fields\":[\"position\",\"position\"]}}", "/output/fields/1",
                 "conflict");
    assert_fault("{\"probes\":{\"d\":{\"kind\":\"displacement\",\"at\":[0,0],"
                 "\"box\":{\"min\":[0,0],\"max\":[1,1]}}}}",
                 "/probes/d/box", "conflict");
    assert_fault("{\"references\":[{\"probe\":\"front\",\"component\":\"x\",\"at\":1,\"value\":1,"
                 "\"tolerance\":1}]}",
                 "/references/0/component", "conflict");
    assert_fault("{\"references\":[{\"probe\":\"energy\",\"at\":1,\"value\":1,\"tolerance\":1}]}",
                 "/references/0/component", "required");
    assert_fault("{\"references\":[{\"probe\":\"energy\",\"component\":\"knetic\",\"at\":1,"
                 "\"value\":1,\"tolerance\":1}]}",
                 "/references/0/component", "choice");
    assert_fault("{\"probes\":{\"p\":{\"kind\":\"reaction\",\"wall\":\"floor\",\"rigid_body\":"
                 "\"foot\"}}," FOOT("") "}",
                 "/probes/p/rigid_body", "conflict");
    assert_fault("{\"bodies\":{\"pool\":{\"shape\":{\"disk\":{\"center\":[1,1],\"radius\":1}}}}}",
                 "/bodies/pool/shape", "count");
    assert_fault("{\"bodies\":{\"pool\":{\"shape\":{\"box\":null}}}}", "/bodies/pool/shape",
                 "count");
}

static void test_scene_refuses_bad_stages(void **state) {
    (void)state;
    assert_fault("{\"stages\":[{\"name\":\"a\"},{\"name\":\"b\"}]}", "/stages/0/duration",
                 "required");
    assert_fault("{\"stages\":[{\"name\":\"a\",\"duration\":1}]}", "/stages/0/duration",
                 "conflict");
    assert_fault("{\"stages\":[{\"name\":\"a\",\"until\":{\"kinetic_energy_ratio\":0.1,"
                 "\"duration\":1}}]}",
                 "/stages/0/until", "conflict");
    assert_fault(
        "{\"stages\":[{\"name\":\"a\",\"duration\":1,\"until\":{\"kinetic_energy_ratio\":0.1,"
        "\"duration\":1}},{\"name\":\"b\"}]}",
        "/stages/0/until", "conflict");
    assert_fault("{\"stages\":[{\"duration\":1},{\"name\":\"b\"}]}", "/stages/0/name", "required");
    assert_fault("{\"stages\":[{\"name\":\"b\",\"time\":{\"dt\":1e-4,\"cfl\":0.2}}]}",
                 "/stages/0/time/cfl", "conflict");
    assert_fault("{\"stages\":[{\"name\":\"b\",\"ramp\":1,\"gravity\":{\"vector\":[0,0]}}]}",
                 "/stages/0/ramp", "conflict");
    assert_fault("{\"stages\":[{\"name\":\"b\",\"cell\":1}]}", "/stages/0/cell", "unknown_key");
    assert_fault("{\"stages\":[{\"name\":\"b\",\"materials\":{\"rubber\":{\"density\":1}}}]}",
                 "/stages/0/materials/rubber/density", "immutable");
    assert_fault(
        "{\"stages\":[{\"name\":\"b\",\"materials\":{\"rubber\":{\"model\":\"newtonian\"}}}]}",
        "/stages/0/materials/rubber/model", "immutable");
    assert_fault(
        "{\"stages\":[{\"name\":\"b\",\"materials\":{\"rubber\":{\"poisson_ratio\":0.6}}}]}",
        "/stages/0/materials/rubber/poisson_ratio", "range");
    assert_fault(
        "{\"stages\":[{\"name\":\"b\",\"materials\":{\"rubber\":{\"poisson_ratio\":null}}}]}",
        "/stages/0/materials/rubber/poisson_ratio", "required");
    assert_fault(
        "{\"stages\":[{\"name\":\"b\",\"materials\":{\"rubber\":{\"poison_ratio\":0.1}}}]}",
        "/stages/0/materials/rubber/poison_ratio", "unknown_key");
}

static void test_scene_refuses_what_is_for_the_other_dimension(void **state) {
    (void)state;
    assert_fault("{\"gravity\":[0,0,-9.81]}", "/gravity", "length");
    assert_fault("{\"gravity\":[0]}", "/gravity", "length");
    assert_fault("{\"walls\":{\"floor\":{\"axis\":\"z\"}}}", "/walls/floor/axis", "dimension");
    assert_fault("{\"bodies\":{\"ball\":{\"shape\":{\"disk\":null,\"sphere\":{\"center\":[2,3],"
                 "\"radius\":0.5}}}}}",
                 "/bodies/ball/shape/sphere", "dimension");
    assert_fault("{\"bodies\":{\"ball\":{\"velocity\":{\"rotation\":{\"center\":[2,3],\"rate\":1,"
                 "\"axis\":[0,0,1]}}}}}",
                 "/bodies/ball/velocity/rotation/axis", "dimension");
}

static void test_scene_refuses_bad_names_and_sizes(void **state) {
    (void)state;
    assert_fault("{\"walls\":{\"a b\":{\"axis\":\"x\",\"at\":4,\"keeps\":\"below\"}}}",
                 "/walls/a b", "name");
    assert_fault("{\"walls\":{\"\":{\"axis\":\"x\",\"at\":4,\"keeps\":\"below\"}}}", "/walls/",
                 "name");
    assert_fault("{\"walls\":{\"4\":{\"axis\":\"x\",\"at\":4,\"keeps\":\"below\"}}}", "/walls/4",
                 "name");
    char title[1000] = "{\"title\":\"";
    for (int i = 0; i < 201; i++)
        strcat(title, "\xC3\xA9");
    strcat(title, "\"}");
    assert_fault(title, "/title", "length");

    char shape[2000] = "{\"bodies\":{\"pool\":{\"shape\":{\"box\":null,";
    char pointer[1000] = "/bodies/pool/shape";
    for (int i = 0; i < SCENE_MAX_SHAPE_DEPTH; i++) {
        strcat(shape, i ? "{\"union\":[" : "\"union\":[");
        strcat(pointer, "/union/0");
    }
    strcat(shape, "{\"box\":{\"min\":[0,0],\"max\":[2,1]}}");
    for (int i = 0; i < SCENE_MAX_SHAPE_DEPTH; i++)
        strcat(shape, i + 1 < SCENE_MAX_SHAPE_DEPTH ? "]}" : "]");
    strcat(shape, "}}}}");
    assert_fault(shape, pointer, "depth");

    cJSON *json = patched_base("{\"probes\":{\"energy\":null}}");
    cJSON *probes = json_member(json, "probes");
    for (int i = 0; i < SCENE_MAX_NAMED; i++) {
        char name[16];
        snprintf(name, sizeof name, "p%d", i);
        cJSON_AddItemToObject(probes, name, parse("{\"kind\":\"energy\"}"));
    }
    struct faults faults = {0};
    assert_null(scene_create(json, &faults));
    assert_true(has_fault(&faults, "/probes", "count"));
    faults_free(&faults);
    cJSON_Delete(json);
}

#define POINTS(list) "{\"bodies\":{\"pool\":{\"shape\":{\"box\":null,\"points\":" list "}}}}"

// All at once, each with its place.
static void test_scene_reports_all_faults(void **state) {
    (void)state;
    cJSON *json = patched_base(
        "{\"cell\":-1,\"basis\":\"quadratic\",\"gravity\":[0,0,0],\"time\":{\"end\":null},"
        "\"bodies\":{\"pool\":{\"material\":\"oil\"}},\"extra\":1,"
        "\"stages\":[{\"name\":\"a\"},{\"name\":\"b\",\"fbar\":3}]}");
    struct faults faults = {0};
    assert_null(scene_create(json, &faults));
    static const char *const expected[][2] = {
        {"/cell", "range"},         {"/basis", "choice"},
        {"/gravity", "length"},     {"/time/end", "required"},
        {"/extra", "unknown_key"},  {"/bodies/pool/material", "unknown_name"},
        {"/stages/1/fbar", "type"}, {"/stages/0/duration", "required"}};
    for (size_t i = 0; i < COUNT(expected); i++)
        if (!has_fault(&faults, expected[i][0], expected[i][1])) {
            print_faults(&faults);
            fail_msg("no fault %s %s", expected[i][0], expected[i][1]);
        }
    assert_int_equal(faults.count, COUNT(expected));
    faults_free(&faults);
    cJSON_Delete(json);
}

static void test_scene_that_is_no_object_is_refused(void **state) {
    (void)state;
    static const char *const texts[] = {"null", "[]", "3", "\"dam-break\"", "{}"};
    for (size_t i = 0; i < COUNT(texts); i++) {
        cJSON *json = parse(texts[i]);
        struct faults faults = {0};
        assert_null(scene_create(json, &faults));
        assert_true(faults.count > 0);
        faults_free(&faults);
        cJSON_Delete(json);
    }
}

// The solver's own checks come through as faults.
static void test_scene_passes_on_faults_of_the_solver(void **state) {
    (void)state;
    assert_fault("{\"walls\":{\"floor\":{\"at\":0.1}}}", "/walls/floor/at", "range");
    assert_fault("{\"time\":{\"dt\":1}}", "/time/dt", "unstable_dt");
    assert_fault("{\"bodies\":{\"ball\":{\"shape\":{\"disk\":{\"center\":[2,9]}}}}}",
                 "/bodies/ball/shape", "range");
    assert_fault("{\"cell\":1e-6}", "/cell", "range");
    assert_fault("{\"cell\":1e-3,\"time\":{\"dt\":1e-7},\"bodies\":{\"pool\":{\"particles_per_"
                 "cell\":1024}}}",
                 "/bodies/pool/shape", "memory");
    scene_free(create("{\"time\":{\"dt\":1},\"unstable_ok\":true}"));
    scene_free(create("{\"time\":{\"dt\":1,\"unstable_ok\":true}}"));
    struct scene *held = create("{\"mirror_walls\":false}"), *mirrored = create("{}");
    assert_true(scene_def(held)->walls_hold_nodes && !scene_def(mirrored)->walls_hold_nodes);
    scene_free(held);
    scene_free(mirrored);
}

// ---- Shapes, loads and plasticity ---------------------------------------------------------------

#define POLYGON(points) SHAPE("\"polygon\":{\"points\":" points "}")
#define SHAPE(text) "{\"bodies\":{\"pool\":{\"shape\":{\"box\":null," text "}}}}"

static void test_scene_refuses_polygons_that_are_not_simple(void **state) {
    (void)state;
    static const char points[] = "/bodies/pool/shape/polygon/points";
    assert_fault(SHAPE("\"polygon\":[[0,0],[2,0],[2,1]]"), "/bodies/pool/shape/polygon", "type");
    assert_fault(SHAPE("\"polygon\":{}"), points, "required");
    assert_fault(POLYGON("3"), points, "type");
    assert_fault(POLYGON("[[0,0],[2,0]]"), points, "count");
    assert_fault(POLYGON("[[0,0],[2,0],[2]]"), "/bodies/pool/shape/polygon/points/2", "length");
    assert_fault(POLYGON("[[0,0],[2,0],[2,\"1\"]]"), "/bodies/pool/shape/polygon/points/2/1",
                 "type");
    assert_fault(POLYGON("[[0,0],[1,1],[2,2]]"), points, "empty");
    assert_fault(POLYGON("[[0,0],[2,1],[2,0],[0,1]]"), points, "empty"); // a bow tie, equal halves
    assert_fault(POLYGON("[[0,0],[2,1],[2,0],[0,2]]"), points, "conflict");       // unequal ones
    assert_fault(POLYGON("[[0,0],[2,0],[2,1],[0,1],[0,0]]"), points, "conflict"); // closed twice
    assert_fault(POLYGON("[[0,0],[2,0],[2,0],[0,1]]"), points, "conflict");
    // A spike that folds back; a corner on another edge; a corner twice.
    assert_fault(POLYGON("[[0,0],[2,0],[2,1],[2,0.5],[0,1]]"), points, "conflict");
    assert_fault(POLYGON("[[0,0],[2,0],[2,2],[1,0],[0,2]]"), points, "conflict");
    assert_fault(POLYGON("[[0,0],[2,0],[1,1],[2,2],[0,2],[1,1]]"), points, "conflict");
    assert_true(detail_has(POLYGON("[[0,0],[2,1],[2,0],[0,2]]"), "corner 0"));
    assert_fault(SHAPE("\"union\":[{\"box\":{\"min\":[0,0],\"max\":[2,1]}},"
                       "{\"difference\":[{\"polygon\":{\"points\":[[0,0],[2,1],[2,0],[0,2]]}}]}]"),
                 "/bodies/pool/shape/union/1/difference/0/polygon/points", "conflict");
    assert_fault(SHAPE("\"extrude\":{\"polygon\":[[0,0],[1,0],[1,1]],\"from\":0,\"to\":1}"),
                 "/bodies/pool/shape/extrude", "dimension");
    assert_fault(SHAPE("\"cylinder\":{\"from\":[0,0],\"to\":[1,0],\"radius\":1}"),
                 "/bodies/pool/shape/cylinder", "dimension");
}

static size_t particles_of(const char *patch_text) {
    struct scene *scene = create(patch_text);
    struct mpm_estimate estimate;
    mpm_estimate(scene_def(scene), &estimate);
    scene_free(scene);
    return estimate.particles;
}

// Spacing 0.25: the disk has 12 particles, the polygon what one counts by hand.
static void test_scene_takes_polygons_either_way_round(void **state) {
    (void)state;
    size_t disk = particles_of("{\"bodies\":{\"pool\":null}}");
    assert_int_equal(particles_of(POLYGON("[[0,0],[2,0],[2,1],[0,1]]")) - disk, 8 * 4);
    assert_int_equal(particles_of(POLYGON("[[0,1],[2,1],[2,0],[0,0]]")) - disk, 8 * 4);
    // Corners on a straight edge are fine.
    assert_int_equal(particles_of(POLYGON("[[0,0],[1,0],[2,0],[2,1],[0,1]]")) - disk, 8 * 4);
    // Below the diagonal of a square of 8 x 8, without and with the diagonal itself.
    assert_int_equal(particles_of(POLYGON("[[0,0],[2,0],[2,2]]")) - disk, 8 * 7 / 2);
    assert_int_equal(
        particles_of("{\"bodies\":{\"pool\":{\"edge\":\"closed\",\"shape\":{\"box\":null,"
                     "\"polygon\":{\"points\":[[0,0],[2,0],[2,2]]}}}}}") -
            disk,
        8 * 9 / 2);
    // Inside set operations.
    assert_int_equal(particles_of(SHAPE("\"difference\":[{\"box\":{\"min\":[0,0],\"max\":[2,2]}},"
                                        "{\"polygon\":{\"points\":[[0,0],[2,0],[2,2]]}}]")) -
                         disk,
                     8 * 7 / 2); // neither half has its edge
}

// A cube of 2 m with a shape in it.
static cJSON *solid_scene(const char *shape, const char *patch_text) {
    char text[2000];
    snprintf(text, sizeof text,
             "{\"format\":\"fbard-scene-1\",\"dimension\":3,\"domain\":{\"min\":[0,0,0],"
             "\"max\":[2,2,2]},\"cell\":0.5,\"time\":{\"end\":1},\"materials\":{\"m\":{\"model\":"
             "\"neo_hookean\",\"density\":1,\"youngs_modulus\":10,\"poisson_ratio\":0}},"
             "\"bodies\":{\"b\":{\"material\":\"m\",\"shape\":%s}}}",
             shape);
    cJSON *base = parse(text), *patch = parse(patch_text), *merged = json_merge_patch(base, patch);
    cJSON_Delete(base);
    cJSON_Delete(patch);
    return merged;
}

static void assert_solid_fault(const char *shape, const char *patch_text, const char *pointer,
                               const char *code) {
    cJSON *json = solid_scene(shape, patch_text);
    struct faults faults = {0};
    assert_null(scene_create(json, &faults));
    if (faults.count != 1 || !has_fault(&faults, pointer, code))
        print_faults(&faults);
    assert_int_equal(faults.count, 1);
    assert_true(has_fault(&faults, pointer, code));
    faults_free(&faults);
    cJSON_Delete(json);
}

static size_t solid_particles(const char *shape) {
    cJSON *json = solid_scene(shape, "{}");
    struct faults faults = {0};
    struct scene *scene = scene_create(json, &faults);
    print_faults(&faults);
    assert_non_null(scene);
    struct mpm_estimate estimate;
    mpm_estimate(scene_def(scene), &estimate);
    scene_free(scene);
    cJSON_Delete(json);
    return estimate.particles;
}

static void test_scene_reads_extrusions_and_cylinders(void **state) {
    (void)state;
    static const char triangle[] =
        "{\"extrude\":{\"polygon\":[[0,0],[2,0],[2,2]],\"from\":0.5,\"to\":1.5}}";
    assert_int_equal(solid_particles(triangle), 28 * 4);
    assert_int_equal(solid_particles("{\"extrude\":{\"polygon\":{\"points\":[[0,0],[2,0],[2,2]]},"
                                     "\"from\":0.5,\"to\":1.5}}"),
                     28 * 4);
    cJSON *json = solid_scene(triangle, "{}");
    struct faults faults = {0};
    struct scene *scene = scene_create(json, &faults);
    const struct mpm_shape *shape = &scene_def(scene)->bodies[0].shape;
    assert_int_equal(shape->kind, MPM_SHAPE_EXTRUDE);
    assert_true(shape->n_points == 3 && shape->points[4] == 2);
    assert_true(shape->min[2] == 0.5 && shape->max[2] == 1.5);
    scene_free(scene);
    cJSON_Delete(json);
    // 12 lattice points lie in a circle of 0.5 m about a cell's corner; 4 layers, or all 8.
    assert_int_equal(
        solid_particles("{\"cylinder\":{\"from\":[1,1,0.5],\"to\":[1,1,1.5],\"radius\":0.5}}"),
        12 * 4);
    assert_int_equal(
        solid_particles("{\"cylinder\":{\"from\":[2,1,1],\"to\":[0,1,1],\"radius\":0.5}}"), 12 * 8);
    assert_int_equal(
        solid_particles("{\"difference\":[{\"box\":{\"min\":[0,0,0],\"max\":[2,2,2]}},"
                        "{\"cylinder\":{\"from\":[1,1,0],\"to\":[1,1,2],\"radius\":0.5}}]}"),
        (64 - 12) * 8);
    static const char at[] = "/bodies/b/shape";
    char pointer[80];
    snprintf(pointer, sizeof pointer, "%s/polygon", at);
    assert_solid_fault("{\"polygon\":{\"points\":[[0,0],[2,0],[2,2]]}}", "{}", pointer,
                       "dimension");
    snprintf(pointer, sizeof pointer, "%s/extrude/polygon", at);
    assert_solid_fault("{\"extrude\":{\"polygon\":[[0,0],[2,1],[2,0],[0,2]],\"from\":0,\"to\":1}}",
                       "{}", pointer, "conflict");
    snprintf(pointer, sizeof pointer, "%s/extrude/to", at);
    assert_solid_fault("{\"extrude\":{\"polygon\":[[0,0],[2,0],[2,2]],\"from\":1,\"to\":1}}", "{}",
                       pointer, "range");
    assert_solid_fault("{\"extrude\":{\"polygon\":[[0,0],[2,0],[2,2]],\"from\":1}}", "{}", pointer,
                       "required");
    snprintf(pointer, sizeof pointer, "%s/cylinder/to", at);
    assert_solid_fault("{\"cylinder\":{\"from\":[1,1,1],\"to\":[1,1,1],\"radius\":0.5}}", "{}",
                       pointer, "range");
    snprintf(pointer, sizeof pointer, "%s/cylinder/radius", at);
    assert_solid_fault("{\"cylinder\":{\"from\":[1,1,1],\"to\":[1,1,2],\"radius\":0}}", "{}",
                       pointer, "range");
}

#define LOAD(text) "{\"loads\":{\"push\":{\"body\":\"ball\"," text "}}}"
#define TOP "\"select\":{\"extreme\":\"+y\"},"

static void test_scene_reads_loads(void **state) {
    (void)state;
    struct scene *scene =
        create("{\"loads\":{\"a\":{\"body\":\"ball\"," TOP "\"force\":[1,-2],\"ramp\":0.5},"
               "\"b\":{\"body\":\"pool\",\"select\":{\"box\":{\"min\":[0,0],\"max\":[1,1]}},"
               "\"force\":[3,0]},"
               "\"c\":{\"body\":\"ball\",\"select\":{\"extreme\":\"-r\",\"center\":[2,3]},"
               "\"pressure\":7}},"
               "\"stages\":[{\"name\":\"one\",\"duration\":1},"
               "{\"name\":\"two\",\"remove\":{\"loads\":[\"c\",\"a\"],\"walls\":[\"left\"]}}]}");
    const struct mpm_def *def = scene_def(scene);
    const struct mpm_load_def *a = &def->loads[0], *b = &def->loads[1], *c = &def->loads[2];
    assert_int_equal(def->n_loads, 3);
    assert_string_equal(a->name, "a");
    assert_true(a->body == 1 && a->axis == 1 && a->max_side && !a->round && !a->has_box);
    assert_true(a->force[0] == 1 && a->force[1] == -2 && a->ramp == 0.5 && !a->is_pressure);
    assert_true(b->body == 0 && b->has_box && b->box_max[1] == 1 && b->ramp == 0);
    assert_true(c->round && !c->max_side && c->centre[1] == 3);
    assert_true(c->is_pressure && c->pressure == 7);
    assert_null(def->stages[0].removes_load);
    const bool *removed = def->stages[1].removes_load;
    assert_true(removed[0] && !removed[1] && removed[2]);
    assert_true(def->stages[1].removes_wall[1]);
    scene_free(scene);

    cJSON *json = solid_scene("{\"cylinder\":{\"from\":[1,1,0.5],\"to\":[1,1,1.5],\"radius\":0.5}}",
                              "{\"loads\":{\"p\":{\"body\":\"b\",\"select\":{\"extreme\":\"+r\","
                              "\"center\":[1,1,0],\"axis\":\"z\"},\"pressure\":-1}}}");
    struct faults faults = {0};
    scene = scene_create(json, &faults);
    print_faults(&faults);
    assert_non_null(scene);
    const struct mpm_load_def *p = scene_def(scene)->loads;
    assert_true(p->round && p->max_side && p->axis == 2 && p->pressure == -1);
    scene_free(scene);
    cJSON_Delete(json);
}

static void test_scene_refuses_bad_loads(void **state) {
    (void)state;
    assert_fault("{\"loads\":{\"push\":{" TOP "\"force\":[0,1]}}}", "/loads/push/body", "required");
    assert_fault("{\"loads\":{\"push\":{\"body\":\"bal\"," TOP "\"force\":[0,1]}}}",
                 "/loads/push/body", "unknown_name");
    assert_fault(LOAD("\"force\":[0,1]"), "/loads/push/select", "required");
    assert_fault(LOAD("\"select\":{},\"force\":[0,1]"), "/loads/push/select", "required");
    assert_fault(LOAD("\"select\":\"+x\",\"force\":[0,1]"), "/loads/push/select", "type");
    assert_fault(LOAD(TOP "\"ramp\":1"), "/loads/push/force", "required");
    assert_fault(LOAD(TOP "\"force\":[0,1],\"pressure\":1"), "/loads/push/pressure", "conflict");
    assert_fault(LOAD(TOP "\"force\":[0,1,0]"), "/loads/push/force", "length");
    assert_fault(LOAD(TOP "\"force\":5"), "/loads/push/force", "type");
    assert_fault(LOAD(TOP "\"force\":[0,1],\"ramp\":-1"), "/loads/push/ramp", "range");
    assert_fault(LOAD(TOP "\"force\":[0,1],\"stage\":1"), "/loads/push/stage", "unknown_key");
    assert_fault(LOAD("\"select\":{\"extreme\":\"x\"},\"force\":[0,1]"),
                 "/loads/push/select/extreme", "choice");
    assert_fault(LOAD("\"select\":{\"extreme\":\"+z\"},\"force\":[0,1]"),
                 "/loads/push/select/extreme", "dimension");
    assert_fault(LOAD("\"select\":{\"extreme\":\"+r\"},\"pressure\":1"),
                 "/loads/push/select/center", "required");
    assert_fault(LOAD("\"select\":{\"extreme\":\"+y\",\"center\":[2,3]},\"pressure\":1"),
                 "/loads/push/select/center", "conflict");
    assert_fault(
        LOAD("\"select\":{\"extreme\":\"+r\",\"center\":[2,3],\"axis\":\"y\"},\"pressure\":1"),
        "/loads/push/select/axis", "dimension");
#define BOXED "\"box\":{\"min\":[1.5,2.5],\"max\":[2.5,3.5]}"
    assert_fault(LOAD("\"select\":{" BOXED ",\"extreme\":\"+y\"},\"force\":[0,1]"),
                 "/loads/push/select/extreme", "conflict");
    assert_fault(LOAD("\"select\":{" BOXED ",\"center\":[2,3]},\"force\":[0,1]"),
                 "/loads/push/select/center", "conflict");
    assert_fault(LOAD("\"select\":{" BOXED "},\"pressure\":1"), "/loads/push/pressure", "conflict");
    // A box beside the body, and one between its particles.
    assert_fault(LOAD("\"select\":{\"box\":{\"min\":[0,0],\"max\":[2,1]}},\"force\":[0,1]"),
                 "/loads/push/select", "empty");
    assert_fault(LOAD("\"select\":{\"box\":{\"min\":[1.9,2.9],\"max\":[2.1,3.1]}},\"force\":[0,1]"),
                 "/loads/push/select", "empty");
    // Pressing on a particle in the middle: in which direction?
    assert_fault(LOAD("\"select\":{\"extreme\":\"-r\",\"center\":[1.875,2.875]},\"pressure\":1"),
                 "/loads/push/select/center", "conflict");
    scene_free(create(LOAD("\"select\":{" BOXED "},\"force\":[0,1]")));
    assert_fault("{\"stages\":[{\"name\":\"a\",\"remove\":{\"loads\":[\"push\"]}}]}",
                 "/stages/0/remove/loads/0", "unknown_name");
    assert_solid_fault("{\"box\":{\"min\":[0,0,0],\"max\":[2,2,2]}}",
                       "{\"loads\":{\"p\":{\"body\":\"b\",\"select\":{\"extreme\":\"+r\","
                       "\"center\":[1,1,0]},\"pressure\":-1}}}",
                       "/loads/p/select/axis", "required");
}

static void test_scene_reads_rigid_bodies(void **state) {
    (void)state;
    struct scene *scene = create("{" FOOT(
        ",\"velocity\":[1,-2]") ",\"probes\":{"
                                "\"push\":{\"kind\":\"reaction\",\"rigid_body\":\"foot\"},"
                                "\"weight\":{\"kind\":\"reaction\",\"wall\":\"left\"}},"
                                "\"references\":[{\"probe\":\"push\",\"component\":\"y\",\"at\":"
                                "\"end\",\"value\":3,"
                                "\"tolerance\":0.1}],"
                                "\"stages\":[{\"name\":\"one\",\"duration\":1},"
                                "{\"name\":\"two\",\"remove\":{\"rigid_bodies\":[\"foot\"]}}]}");
    const struct mpm_def *def = scene_def(scene);
    const struct mpm_rigid_def *foot = &def->rigids[0];
    assert_int_equal(def->n_rigids, 1);
    assert_string_equal(foot->name, "foot");
    assert_int_equal(foot->shape.kind, MPM_SHAPE_BOX);
    assert_true(foot->shape.min[0] == 0.5 && foot->shape.max[1] == 2);
    assert_true(foot->velocity[0] == 1 && foot->velocity[1] == -2);
    assert_true(foot->stiffness == 500 && foot->distance == 0.01 && foot->friction == 0);
    assert_null(def->stages[0].removes_rigid);
    assert_true(def->stages[1].removes_rigid[0]);
    bool found[2] = {false};
    for (size_t k = 0; k < def->n_probes; k++) {
        const struct mpm_probe_def *q = &def->probes[k];
        found[0] |= strcmp(q->name, "push") == 0 && q->wall == -1 && q->rigid == 0;
        found[1] |= strcmp(q->name, "weight") == 0 && q->wall == 1;
    }
    assert_true(found[0] && found[1]);
    scene_free(scene);
    scene = create(
        "{\"rigid_bodies\":{\"a\":{\"shape\":{\"disk\":{\"center\":[3,3],\"radius\":0.25}},"
        "\"contact\":{\"kind\":\"barrier\",\"stiffness\":1,\"distance\":0.1,\"friction\":2}},"
        "\"b\":{\"shape\":{\"polygon\":{\"points\":[[3,0],[4,0],[4,1]]}}," FOOT_CONTACT "}}}");
    def = scene_def(scene);
    assert_int_equal(def->n_rigids, 2);
    assert_true(def->rigids[0].shape.kind == MPM_SHAPE_BALL && def->rigids[0].friction == 2);
    assert_true(def->rigids[1].shape.kind == MPM_SHAPE_POLYGON);
    assert_true(def->rigids[1].shape.n_points == 3 && def->rigids[1].velocity[1] == 0);
    scene_free(scene);
}

// ---- Solutions, tables, errors ------------------------------------------------------------------

#define VORTEX "\"inner\":0.1,\"outer\":0.4,\"amplitude\":1,\"period\":2"
#define ERROR_OF(text) "{\"probes\":{\"e\":{\"kind\":\"error\"," text "}}}"
#define AGAINST(text)                                                                              \
    ERROR_OF("\"field\":\"displacement\",\"body\":\"ball\",\"against\":{" text "}")
#define ONLY_BALL "\"bodies\":{\"pool\":null},\"materials\":{\"water\":null}"

static void test_scene_reads_solutions(void **state) {
    (void)state;
    struct scene *scene = create(
        "{\"materials\":{\"water\":null},"
        "\"body_force\":{\"vortex\":{\"center\":[2,3]," VORTEX "}},"
        "\"bodies\":{\"pool\":null,\"ball\":{\"velocity\":{\"tube\":{\"inner\":1,\"outer\":2,"
        "\"rate\":3}}}},"
        "\"probes\":{\"e\":{\"kind\":\"error\",\"field\":\"stress\",\"component\":\"yx\",\"norm\":"
        "\"l2\",\"against\":{\"lame\":{\"inner\":1,\"outer\":2,\"pressure\":5}},\"exclude\":{"
        "\"disk\":{\"center\":[2,3],\"radius\":0.1}}},"
        "\"f\":{\"kind\":\"error\",\"field\":\"mean_stress\",\"against\":{\"column\":{\"axis\":"
        "\"y\",\"length\":4}}},"
        "\"s\":{\"kind\":\"displacement\",\"select\":{\"extreme\":\"+r\",\"center\":[2,3]}}}}");
    const struct mpm_def *def = scene_def(scene);
    assert_int_equal(def->body_force.kind, MPM_BODY_FORCE_SOLUTION);
    const struct mpm_solution *q = &def->body_force.solution;
    assert_int_equal(q->kind, MPM_SOLUTION_VORTEX);
    assert_true(q->centre[0] == 2 && q->centre[1] == 3 && q->inner == 0.1 && q->outer == 0.4 &&
                q->amplitude == 1 && q->period == 2);
    assert_int_equal(def->bodies[0].velocity.kind, MPM_VELOCITY_SOLUTION);
    assert_true(def->bodies[0].velocity.solution.rate == 3);
    const struct mpm_probe_def *e = &def->probes[2], *f = &def->probes[3], *s = &def->probes[4];
    assert_true(e->kind == MPM_PROBE_ERROR && e->norm == MPM_NORM_L2 && e->component == 2);
    assert_true(e->against.solution.kind == MPM_SOLUTION_LAME &&
                e->against.solution.pressure == 5 && e->has_exclude);
    assert_true(f->norm == MPM_NORM_RMS && f->component == -1 && f->against.solution.axis == 1 &&
                f->against.solution.length == 4 && f->against.solution.from == 0);
    assert_true(s->has_select && s->select.round && s->select.max_side && s->body == 0);
    scene_free(scene);
    scene = create("{\"body_force\":[0,0]}");
    assert_int_equal(scene_def(scene)->body_force.kind, MPM_BODY_FORCE_NONE);
    scene_free(scene);
    scene = create("{\"body_force\":[0,1]}");
    assert_int_equal(scene_def(scene)->body_force.kind, MPM_BODY_FORCE_UNIFORM);
    scene_free(scene);
}

// A body 96 m wide, so that Cook's table has points in it.
#define WIDE                                                                                       \
    "\"domain\":{\"min\":[0,0],\"max\":[60,60]},\"cell\":2,\"walls\":null,\"bodies\":{\"pool\":"   \
    "null,"                                                                                        \
    "\"ball\":{\"shape\":{\"disk\":{\"center\":[24,40],\"radius\":5}}}}"
#define COOK "\"against\":\"cook_base_log_particles_h1\""

static void test_scene_reads_tables(void **state) {
    (void)state;
    struct scene *scene = create(
        "{" WIDE ",\"probes\":{\"e\":{\"kind\":\"error\",\"field\":\"displacement\"," COOK "}},"
        "\"references\":[{\"probe\":\"energy\",\"component\":\"total\",\"at\":0.25,\"tolerance\":1,"
        "\"value\":{\"table\":\"tube_free_radial_oscillation\",\"column\":\"a\"}},"
        "{\"probe\":\"energy\",\"component\":\"total\",\"at\":\"end\",\"tolerance\":1,"
        "\"value\":{\"table\":\"footing_rough_W5_D5_NB20\",\"column\":\"q_over_su\",\"at\":"
        "0.00015}}]}");
    const struct mpm_probe_def *e = &scene_def(scene)->probes[2];
    assert_true(e->against.is_table && e->against.n == 5776 && e->against.n_axes == 2);
    assert_true(e->against.points[0] == 0.25 && e->against.points[3] == 0.75);
    assert_true(fabs(e->against.values[3] - 0.000644) < 1e-6);
    size_t n;
    const struct scene_reference *references = scene_references(scene, &n);
    assert_int_equal(n, 2);
    assert_true(fabs(references[0].value - 1.5951430448) < 1e-9);
    assert_true(fabs(references[1].value - (1.129444 + 2.218599) / 2) < 1e-4); // 5 digits
    scene_free(scene);
}

static void test_scene_refuses_bad_errors(void **state) {
    (void)state;
    assert_fault(ERROR_OF("\"field\":\"velocity\""), "/probes/e/against", "required");
    assert_fault(ERROR_OF("\"against\":\"cook_base_log_particles_h1\""), "/probes/e/field",
                 "required");
    assert_fault(ERROR_OF("\"field\":\"velocity\",\"against\":3"), "/probes/e/against", "type");
    assert_fault(ERROR_OF("\"field\":\"mean_stress\",\"against\":\"cook_base_log_particles\""),
                 "/probes/e/against", "choice");
    assert_fault(ERROR_OF("\"field\":\"velocity\"," COOK), "/probes/e/against", "conflict");
    assert_fault(ERROR_OF("\"field\":\"mean_stress\",\"against\":\"footing_rough_W5_D5_NB20\""),
                 "/probes/e/against", "conflict");
    assert_fault(AGAINST("\"vortx\":{}"), "/probes/e/against/vortx", "unknown_key");
    assert_fault(AGAINST("\"vortex\":{\"inner\":1,\"outer\":2,\"period\":1}"),
                 "/probes/e/against/vortex/amplitude", "required");
    assert_fault(AGAINST("\"lame\":{\"inner\":2,\"outer\":2,\"pressure\":1}"),
                 "/probes/e/against/lame/outer", "range");
    assert_fault(AGAINST("\"lame\":{\"inner\":0,\"outer\":2,\"pressure\":1}"),
                 "/probes/e/against/lame/inner", "range");
    assert_fault(AGAINST("\"cylinder\":{\"inner\":1,\"outer\":2,\"pressure\":1e6}"),
                 "/probes/e/against/cylinder/pressure", "range");
    assert_fault(AGAINST("\"taylor_green\":{\"wavelength\":2,\"speed\":1}"), "/probes/e/field",
                 "conflict"); // it tells velocities
    assert_fault(ERROR_OF("\"field\":\"velocity\",\"body\":\"ball\",\"against\":{\"taylor_green\":"
                          "{\"wavelength\":2,\"speed\":1}}"),
                 "/probes/e/against/taylor_green", "conflict"); // of a fluid
    assert_fault(
        ERROR_OF("\"field\":\"displacement\",\"body\":\"pool\",\"against\":{\"vortex\":{" VORTEX
                 "}}"),
        "/probes/e/against/vortex", "conflict"); // of rubber
    assert_fault(ERROR_OF("\"field\":\"displacement\",\"against\":{\"vortex\":{" VORTEX "}}"),
                 "/probes/e/body", "reference");
    assert_fault("{\"gravity\":[0,0],\"probes\":{\"e\":{\"kind\":\"error\",\"field\":\"velocity\","
                 "\"body\":\"pool\",\"against\":{\"ritter\":{\"gate\":2,\"depth\":1}}}}}",
                 "/probes/e/against/ritter", "conflict");
    assert_fault(
        "{\"materials\":{\"water\":{\"bulk_modulus\":9000}},\"probes\":{\"e\":{\"kind\":"
        "\"error\",\"field\":\"velocity\",\"body\":\"pool\",\"against\":{\"column\":{\"axis\":"
        "\"y\",\"length\":1}}}}}",
        "/probes/e/against/column/length", "range");
    assert_fault(AGAINST("\"mode\":{\"axis\":\"z\",\"length\":1,\"amplitude\":1}"),
                 "/probes/e/against/mode/axis", "dimension");
    assert_fault(ERROR_OF("\"field\":\"displacement\",\"component\":\"xx\"," COOK),
                 "/probes/e/component", "choice");
    assert_fault(ERROR_OF("\"field\":\"mean_stress\",\"component\":\"x\"," COOK),
                 "/probes/e/component", "conflict");
    assert_fault(ERROR_OF("\"field\":\"mean_stress\",\"norm\":\"L2\"," COOK), "/probes/e/norm",
                 "choice");
    assert_fault("{\"probes\":{\"energy\":{\"norm\":\"l2\"}}}", "/probes/energy/norm", "conflict");
    assert_fault(
        "{\"probes\":{\"front\":{\"exclude\":{\"disk\":{\"center\":[0,0],\"radius\":1}}}}}",
        "/probes/front/exclude", "conflict");
    // No particle is left to compare: out of the table, the box, or all excluded.
    assert_fault(
        "{\"domain\":{\"min\":[0,-40]},\"cell\":2,\"walls\":null,\"bodies\":{\"pool\":null,"
        "\"ball\":{\"shape\":{\"disk\":{\"center\":[2,-30],\"radius\":2}}}},"
        "\"probes\":{\"e\":{\"kind\":\"error\",\"field\":\"mean_stress\"," COOK "}}}",
        "/probes/e", "empty");
    assert_fault("{" WIDE ",\"probes\":{\"e\":{\"kind\":\"error\",\"field\":\"mean_stress\"," COOK
                 ",\"box\":{\"min\":[0,0],\"max\":[1,1]}}}}",
                 "/probes/e", "empty");
    assert_fault("{" WIDE ",\"probes\":{\"e\":{\"kind\":\"error\",\"field\":\"mean_stress\"," COOK
                 ",\"exclude\":{\"disk\":{\"center\":[24,40],\"radius\":6}}}}}",
                 "/probes/e", "empty");
}

static void test_scene_refuses_bad_selections(void **state) {
    (void)state;
#define SELECT(text)                                                                               \
    "{\"probes\":{\"d\":{\"kind\":\"displacement\",\"body\":\"ball\",\"select\":{" text "}}}}"
    scene_free(create(SELECT("\"extreme\":\"+y\"")));
    assert_fault(SELECT(""), "/probes/d/select", "required");
    assert_fault(SELECT("\"extreme\":\"+z\""), "/probes/d/select/extreme", "dimension");
    assert_fault(SELECT("\"extreme\":\"-r\""), "/probes/d/select/center", "required");
    assert_fault(SELECT("\"box\":{\"min\":[0,0],\"max\":[1,1]}"), "/probes/d/select", "empty");
    assert_fault("{\"probes\":{\"d\":{\"kind\":\"displacement\",\"select\":{\"extreme\":\"+y\"}}}}",
                 "/probes/d/body", "reference"); // there are two
    assert_fault("{\"probes\":{\"d\":{\"kind\":\"displacement\",\"body\":\"ball\",\"at\":[2,3],"
                 "\"select\":{\"extreme\":\"+y\"}}}}",
                 "/probes/d/select", "conflict");
    assert_fault("{\"probes\":{\"d\":{\"kind\":\"displacement\"}}}", "/probes/d/at", "required");
    assert_fault("{\"probes\":{\"front\":{\"select\":{\"extreme\":\"+y\"}}}}",
                 "/probes/front/select", "conflict");
}

static void test_scene_refuses_bad_body_forces(void **state) {
    (void)state;
    assert_fault("{\"body_force\":[0]}", "/body_force", "length");
    assert_fault("{\"body_force\":7}", "/body_force", "type");
    assert_fault("{\"body_force\":{}}", "/body_force", "count");
    assert_fault("{\"body_force\":{\"tube\":{\"inner\":1,\"outer\":2,\"rate\":3}}}",
                 "/body_force/tube", "unknown_key");
    assert_fault("{\"body_force\":{\"vortex\":{" VORTEX "}}}", "/body_force/vortex",
                 "conflict"); // the pool is of water
    assert_fault("{" ONLY_BALL
                 ",\"body_force\":{\"vortex\":{\"inner\":2,\"outer\":1,\"amplitude\":1,"
                 "\"period\":1}}}",
                 "/body_force/vortex/outer", "range");
    assert_fault("{\"bodies\":{\"ball\":{\"velocity\":{\"vortex\":{\"inner\":2,\"outer\":1,"
                 "\"amplitude\":1,\"period\":1}}}}}",
                 "/bodies/ball/velocity/vortex/outer", "range");
    assert_fault("{\"bodies\":{\"ball\":{\"velocity\":{\"lame\":{\"inner\":1,\"outer\":2,"
                 "\"pressure\":1}}}}}",
                 "/bodies/ball/velocity/lame", "unknown_key");
}

static void test_scene_refuses_bad_citations(void **state) {
    (void)state;
#define CITE(text)                                                                                 \
    "{\"references\":[{\"probe\":\"front\",\"at\":0.5,\"tolerance\":1,\"value\":{" text "}}]}"
#define TUBE "\"table\":\"tube_free_radial_oscillation\""
    scene_free(create(CITE(TUBE ",\"column\":\"b\"")));
    assert_fault(CITE("\"column\":\"b\""), "/references/0/value/table", "required");
    assert_fault(CITE(TUBE), "/references/0/value/column", "required");
    assert_fault(CITE("\"table\":\"tube\",\"column\":\"b\""), "/references/0/value/table",
                 "choice");
    assert_fault(CITE(TUBE ",\"column\":\"d\""), "/references/0/value/column", "choice");
    assert_fault(CITE(TUBE ",\"column\":\"b\",\"at\":1e6"), "/references/0/value/at", "range");
    assert_fault(CITE(TUBE ",\"column\":\"b\",\"at\":\"end\""), "/references/0/value/at", "type");
    assert_fault(CITE(TUBE ",\"column\":\"b\",\"row\":3"), "/references/0/value/row",
                 "unknown_key");
    assert_fault(
        "{\"references\":[{\"probe\":\"front\",\"at\":0.5,\"tolerance\":1,\"value\":\"1\"}]}",
        "/references/0/value", "type");
}

#define RIGID(text) "{\"rigid_bodies\":{\"foot\":{" text "}}}"
#define CONTACT(text) RIGID(FOOT_SHAPE ",\"contact\":{" text "}")

static void test_scene_refuses_bad_rigid_bodies(void **state) {
    (void)state;
    assert_fault("{\"rigid_bodies\":[]}", "/rigid_bodies", "type");
    assert_fault(RIGID(FOOT_CONTACT), "/rigid_bodies/foot/shape", "required");
    assert_fault(RIGID(FOOT_SHAPE), "/rigid_bodies/foot/contact", "required");
    assert_fault(CONTACT("\"distance\":0.01"), "/rigid_bodies/foot/contact/stiffness", "required");
    assert_fault(CONTACT("\"stiffness\":1"), "/rigid_bodies/foot/contact/distance", "required");
    assert_fault(CONTACT("\"stiffness\":0,\"distance\":0.01"),
                 "/rigid_bodies/foot/contact/stiffness", "range");
    assert_fault(CONTACT("\"stiffness\":1,\"distance\":0"), "/rigid_bodies/foot/contact/distance",
                 "range");
    assert_fault(CONTACT("\"stiffness\":1,\"distance\":0.5"), // a cell
                 "/rigid_bodies/foot/contact/distance", "range");
    assert_fault(CONTACT("\"stiffness\":1,\"distance\":0.1,\"friction\":-1"),
                 "/rigid_bodies/foot/contact/friction", "range");
    assert_fault(CONTACT("\"stiffness\":1,\"distance\":0.1,\"kind\":\"penalty\""),
                 "/rigid_bodies/foot/contact/kind", "choice");
    assert_fault(CONTACT("\"stiffness\":1,\"distance\":0.1,\"damping\":1"),
                 "/rigid_bodies/foot/contact/damping", "unknown_key");
    assert_fault("{" FOOT(",\"velocity\":[0,0,0]") "}", "/rigid_bodies/foot/velocity", "length");
    assert_fault("{" FOOT(",\"mass\":1") "}", "/rigid_bodies/foot/mass", "unknown_key");
    // Shapes: one of those whose distance is known.
    assert_fault(
        RIGID("\"shape\":{\"union\":[{\"box\":{\"min\":[0,2],\"max\":[1,3]}}]}," FOOT_CONTACT),
        "/rigid_bodies/foot/shape/union", "unknown_key");
    assert_fault(RIGID("\"shape\":{\"points\":[[0,0,1]]}," FOOT_CONTACT),
                 "/rigid_bodies/foot/shape/points", "unknown_key");
    assert_fault(RIGID("\"shape\":{\"sphere\":{\"center\":[3,3],\"radius\":0.25}}," FOOT_CONTACT),
                 "/rigid_bodies/foot/shape/sphere", "dimension");
    assert_fault(
        RIGID("\"shape\":{\"polygon\":{\"points\":[[3,0],[4,1],[4,0],[3,1]]}}," FOOT_CONTACT),
        "/rigid_bodies/foot/shape/polygon/points", "empty");
    assert_fault(RIGID("\"shape\":{\"box\":{\"min\":[0,2],\"max\":[0,3]}}," FOOT_CONTACT),
                 "/rigid_bodies/foot/shape/box/max/0", "range");
    // It stands in the pool, or on its particles.
#define AT(y) RIGID("\"shape\":{\"box\":{\"min\":[0.5," y "],\"max\":[1,2]}}," FOOT_CONTACT)
    assert_fault(AT("0.5"), "/rigid_bodies/foot/shape", "conflict");
    assert_true(detail_has(AT("0.5"), "4 particles of body 'pool'"));
    assert_fault(AT("0.875"), "/rigid_bodies/foot/shape", "conflict");
    scene_free(create(AT("0.8751")));
    // Both or neither, and names.
    assert_fault("{\"probes\":{\"p\":{\"kind\":\"energy\",\"rigid_body\":\"foot\"}}," FOOT("") "}",
                 "/probes/p/rigid_body", "conflict");
    assert_fault("{\"probes\":{\"p\":{\"kind\":\"reaction\",\"rigid_body\":\"fot\"}}," FOOT("") "}",
                 "/probes/p/rigid_body", "unknown_name");
    assert_fault("{\"stages\":[{\"name\":\"a\",\"remove\":{\"rigid_bodies\":[\"foot\"]}}]}",
                 "/stages/0/remove/rigid_bodies/0", "unknown_name");
    // Gone before the first step, it may be anywhere.
    scene_free(create("{\"rigid_bodies\":{\"foot\":{\"shape\":{\"box\":{\"min\":[0.5,0.5],\"max\":["
                      "1,2]}}," FOOT_CONTACT
                      "}},\"stages\":[{\"name\":\"a\",\"remove\":{\"rigid_bodies\":"
                      "[\"foot\"]}}]}"));
}

#define CLAY(more)                                                                                 \
    "{\"materials\":{\"rubber\":{\"model\":\"hencky_j2\",\"yield_strength\":1000" more "}}}"

static void test_scene_reads_plastic_materials(void **state) {
    (void)state;
    struct scene *scene = create(CLAY(""));
    const double *par = scene_def(scene)->materials[1].parameters;
    assert_true(par[3] == 1000 && par[4] == 0 && par[5] == 0); // perfect plasticity
    scene_free(scene);
    scene = create("{\"materials\":{\"rubber\":{\"model\":\"hencky_j2\",\"yield_strength\":1000,"
                   "\"residual_strength\":100,\"softening\":5}},"
                   "\"stages\":[{\"name\":\"a\",\"duration\":1},{\"name\":\"b\",\"reset\":["
                   "\"plastic_strain\"],"
                   "\"materials\":{\"rubber\":{\"yield_strength\":600}}}]}");
    const struct mpm_stage_def *last = &scene_def(scene)->stages[1];
    assert_true(last->materials[1].parameters[3] == 600);
    assert_true(last->materials[1].parameters[4] == 100);
    assert_int_equal(last->resets, MPM_RESET_PLASTIC_STRAIN);
    scene_free(scene);
    assert_fault("{\"materials\":{\"rubber\":{\"model\":\"hencky_j2\"}}}",
                 "/materials/rubber/yield_strength", "required");
    assert_fault("{\"materials\":{\"rubber\":{\"model\":\"hencky_j2\",\"yield_strength\":0}}}",
                 "/materials/rubber/yield_strength", "range");
    assert_fault(CLAY(",\"residual_strength\":1001"), "/materials/rubber/residual_strength",
                 "conflict");
    // 3 mu = 115 kPa over a fall of 900 Pa: 128.
    assert_fault(CLAY(",\"residual_strength\":100,\"softening\":130"),
                 "/materials/rubber/softening", "conflict");
    assert_fault(
        "{\"materials\":{\"rubber\":{\"model\":\"hencky_j2\",\"yield_strength\":1000,"
        "\"residual_strength\":500}},"
        "\"stages\":[{\"name\":\"a\",\"materials\":{\"rubber\":{\"yield_strength\":400}}}]}",
        "/stages/0/materials/rubber/residual_strength", "conflict");
    static const char *const fixed[][2] = {
        {"density", "1"}, {"model", "\"newtonian\""}, {"fbar", "false"}};
    for (size_t i = 0; i < COUNT(fixed); i++) {
        char patch[200], pointer[80];
        snprintf(patch, sizeof patch,
                 "{\"stages\":[{\"name\":\"a\",\"materials\":{\"rubber\":{\"%s\":%s}}}]}",
                 fixed[i][0], fixed[i][1]);
        snprintf(pointer, sizeof pointer, "/stages/0/materials/rubber/%s", fixed[i][0]);
        assert_fault(patch, pointer, "immutable");
    }
}

// What the keys and what the solver finds wrong come together, as far as the scene can be built.
static void test_scene_reports_the_solver_s_faults_with_its_own(void **state) {
    (void)state;
    static const char *const patches[] = {
        "{\"time\":{\"dt\":1},\"foo\":1}",
        "{\"time\":{\"dt\":1},\"materials\":{\"water\":{\"foo\":1}}}",
        "{\"time\":{\"dt\":1},\"gravity\":[0,\"g\"]}",
        "{\"time\":{\"dt\":1},\"probes\":{\"front\":{\"kind\":\"colour\"}}}",
        "{\"time\":{\"dt\":1},\"output\":7}",
        "{\"time\":{\"dt\":1},\"references\":[{\"probe\":\"nothing\"}]}",
        "{\"time\":{\"dt\":1},\"loads\":{\"a\":1}}",
    };
    for (size_t i = 0; i < sizeof patches / sizeof *patches; i++) {
        cJSON *json = patched_base(patches[i]);
        struct faults faults = {0};
        assert_null(scene_create(json, &faults));
        if (faults.count < 2 || !has_fault(&faults, "/time/dt", "unstable_dt"))
            print_error("%s: %zu faults\n", patches[i], faults.count);
        assert_true(faults.count >= 2);
        assert_true(has_fault(&faults, "/time/dt", "unstable_dt"));
        faults_free(&faults);
        cJSON_Delete(json);
    }
    // What hangs on the fault is left alone.
    assert_fault("{\"time\":{\"dt\":1},\"cell\":\"a\"}", "/cell", "type");
    assert_fault(
        "{\"time\":{\"dt\":1},\"bodies\":{\"ball\":{\"shape\":{\"disk\":null,\"foo\":1}}}}",
        "/bodies/ball/shape/foo", "unknown_key");
}

static void test_scene_refuses_what_no_run_can_give(void **state) {
    (void)state;
    assert_fault("{\"output\":{\"fields\":[\"velocity\",\"plastic_strain\"]}}", "/output/fields/1",
                 "unsupported");
    assert_fault("{\"time\":{\"end\":1e300}}", "/time/end", "range");
}

// ---- The definition -----------------------------------------------------------------------------

static void test_scene_definition_follows_the_scene(void **state) {
    (void)state;
    struct scene *scene = create(
        "{\"title\":\"T\",\"basis\":\"bspline2\",\"fbar\":{\"scheme\":\"anchored\",\"a\":0.1},"
        "\"transfer\":{\"blend\":0.9},\"damping\":{\"local\":0.1,\"mass\":0.2},"
        "\"materials\":{\"rubber\":{\"fbar\":false}},"
        "\"bodies\":{\"pool\":{\"particles_per_cell\":9,\"edge\":\"closed\",\"velocity\":[1,2],"
        "\"shape\":{\"box\":null,\"difference\":[{\"box\":{\"min\":[0,0],\"max\":[2,1]}},"
        "{\"disk\":{\"center\":[1,0.5],\"radius\":0.25}}]}},"
        "\"ball\":{\"velocity\":{\"rotation\":{\"center\":[2,3],\"rate\":4}}}},"
        "\"walls\":{\"left\":{\"span\":{\"min\":[0,0],\"max\":[0,2]},\"velocity\":[0,1]}},"
        "\"probes\":{\"m\":{\"kind\":\"minimum\",\"field\":\"mean_stress\",\"body\":\"ball\","
        "\"box\":{\"min\":[0,0],\"max\":[4,4]},\"scale\":-1,\"average\":0.1},"
        "\"r\":{\"kind\":\"reaction\",\"wall\":\"left\"},"
        "\"d\":{\"kind\":\"displacement\",\"at\":[2,3]}},"
        "\"references\":[{\"probe\":\"r\",\"component\":\"y\",\"at\":0.5,\"value\":2,\"tolerance\":"
        "0.1,"
        "\"source\":\"S\"}]}");
    const struct mpm_def *def = scene_def(scene);
    assert_string_equal(scene_title(scene), "T");
    assert_int_equal(def->dimension, 2);
    assert_int_equal(def->basis, MPM_BSPLINE2);
    assert_true(def->cell == 0.5 && def->domain_max[1] == 4);
    assert_int_equal(def->settings.fbar.scheme, MPM_FBAR_ANCHORED);
    assert_true(def->settings.fbar.a == 0.1 && def->settings.fbar.C == 1);
    assert_true(def->settings.fbar.keep == 0);
    assert_true(def->settings.blend == 0.9 && def->settings.damping_mass == 0.2);
    assert_true(def->settings.gravity[1] == -9.81);
    assert_true(def->settings.dt == 0 && def->settings.cfl == 0.3);
    assert_int_equal(def->n_materials, 2);
    assert_string_equal(mpm_material_name(def->materials[1].model), "neo_hookean");
    assert_true(def->materials[0].fbar && !def->materials[1].fbar);
    assert_true(def->materials[1].parameters[2] == 0.3);
    assert_int_equal(def->n_bodies, 2);
    const struct mpm_body_def *pool = &def->bodies[0], *ball = &def->bodies[1];
    assert_string_equal(pool->name, "pool");
    assert_int_equal(pool->particles_per_direction, 3);
    assert_int_equal(ball->particles_per_direction, 2);
    assert_true(pool->closed && !ball->closed);
    assert_true(pool->velocity.vector[1] == 2);
    assert_int_equal(ball->velocity.kind, MPM_VELOCITY_ROTATION);
    assert_true(ball->velocity.rate == 4 && ball->velocity.centre[1] == 3);
    assert_int_equal(ball->material, 1);
    assert_int_equal(pool->shape.kind, MPM_SHAPE_DIFFERENCE);
    assert_int_equal(pool->shape.n_children, 2);
    assert_true(pool->shape.children[1].radius == 0.25);
    assert_int_equal(def->n_walls, 2);
    assert_int_equal(def->walls[0].condition, MPM_WALL_SLIP);
    assert_int_equal(def->walls[1].condition, MPM_WALL_SEPARATE);
    assert_true(def->walls[0].keeps_above && def->walls[0].axis == 1 && !def->walls[0].has_span);
    assert_true(def->walls[1].has_span && def->walls[1].span_max[1] == 2);
    assert_true(def->walls[1].velocity[1] == 1);
    assert_int_equal(def->n_probes, 5);
    const struct mpm_probe_def *front = &def->probes[0], *least = &def->probes[2];
    assert_true(front->kind == MPM_PROBE_EXTENT && front->body == -1 && front->max_side);
    assert_true(front->quantile == 1 && front->scale == 1);
    assert_true(least->kind == MPM_PROBE_MINIMUM && least->field == MPM_FIELD_MEAN_STRESS);
    assert_true(least->body == 1 && least->has_box && least->scale == -1 && least->average == 0.1);
    assert_int_equal(def->probes[3].wall, 1);
    assert_int_equal(def->n_stages, 1);
    assert_string_equal(def->stages[0].name, "run");
    assert_true(def->stages[0].duration == 1 && def->stages[0].states == 0);
    assert_true(def->wants_displacement);
    size_t n;
    const struct scene_reference *reference = scene_references(scene, &n);
    assert_int_equal(n, 1);
    assert_int_equal(reference->probe, 3);
    assert_int_equal(reference->component, 1);
    assert_true(!reference->at_end && reference->at == 0.5 && reference->value == 2);
    assert_string_equal(reference->source, "S");
    const struct scene_config *config = scene_config(scene);
    assert_true(config->end == 1 && config->output.interval == 0.01);
    assert_true(config->output.probe_interval == 0.002 && config->output.when_full_block);
    assert_int_equal(config->output.fields[0], MPM_FIELD_POSITION);
    scene_free(scene);
}

static void test_scene_stages_state_settings_and_keep_changes(void **state) {
    (void)state;
    struct scene *scene = create(
        "{\"damping\":{\"mass\":0.2},\"stages\":["
        "{\"name\":\"load\",\"duration\":0.8,\"gravity\":{\"vector\":[0,-5],\"ramp\":0.6},"
        "\"damping\":{\"local\":0.5},\"time\":{\"dt\":1e-4},\"fbar\":true},"
        "{\"name\":\"hold\",\"until\":{\"kinetic_energy_ratio\":0.01,\"duration\":3},\"ramp\":0.1,"
        "\"remove\":{\"walls\":[\"left\"]},\"materials\":{\"rubber\":{\"poisson_ratio\":0.4}},"
        "\"reset\":[\"velocity\",\"displacement\"],\"time\":{\"dt\":null,\"cfl\":0.2},"
        "\"transfer\":{\"blend\":0.5}},"
        "{\"name\":\"run\",\"materials\":{\"rubber\":{\"youngs_modulus\":5e4}}}]}");
    const struct mpm_def *def = scene_def(scene);
    const struct mpm_stage_def *load = &def->stages[0], *hold = &def->stages[1],
                               *run = &def->stages[2];
    assert_int_equal(def->n_stages, 3);
    assert_true(load->duration == 0.8 && hold->duration == 3 && run->duration == 1);
    assert_true(load->kinetic_energy_ratio == 0 && hold->kinetic_energy_ratio == 0.01);
    assert_int_equal(load->states, MPM_SET_GRAVITY | MPM_SET_DAMPING | MPM_SET_TIME | MPM_SET_FBAR);
    assert_true(load->settings.gravity[1] == -5 && load->gravity_ramp == 0.6);
    assert_true(load->settings.damping_local == 0.5 && load->settings.damping_mass == 0.2);
    assert_true(load->settings.dt == 1e-4);
    assert_int_equal(load->settings.fbar.scheme, MPM_FBAR_ZHAO);
    assert_int_equal(hold->states, MPM_SET_GRAVITY | MPM_SET_TIME | MPM_SET_BLEND);
    assert_true(hold->settings.gravity[1] == -9.81 && hold->gravity_ramp == 0.1);
    assert_true(hold->settings.dt == 0 && hold->settings.cfl == 0.2 && hold->settings.blend == 0.5);
    assert_true(hold->removes_wall[1] && !hold->removes_wall[0]);
    assert_int_equal(hold->resets, MPM_RESET_VELOCITY | MPM_RESET_DISPLACEMENT);
    assert_true(hold->materials[1].parameters[2] == 0.4);
    assert_true(run->materials[1].parameters[2] == 0.4);
    assert_true(run->materials[1].parameters[1] == 5e4);
    assert_int_equal(run->states, 0);
    assert_null(load->materials);
    scene_free(scene);
}

static void test_scene_in_three_dimensions(void **state) {
    (void)state;
    cJSON *json =
        parse("{\"format\":\"fbard-scene-1\",\"dimension\":3,\"domain\":{\"min\":[0,0,0],\"max\":["
              "2,2,2]},"
              "\"cell\":0.5,\"time\":{\"end\":1},"
              "\"materials\":{\"m\":{\"model\":\"neo_hookean\",\"density\":1,\"youngs_modulus\":10,"
              "\"poisson_ratio\":0}},"
              "\"bodies\":{\"b\":{\"material\":\"m\",\"shape\":{\"sphere\":{\"center\":[1,1,1],"
              "\"radius\":0.5}},"
              "\"velocity\":{\"rotation\":{\"center\":[1,1,1],\"rate\":1,\"axis\":[0,3,4]}}}}}");
    struct faults faults = {0};
    struct scene *scene = scene_create(json, &faults);
    print_faults(&faults);
    assert_non_null(scene);
    const struct mpm_body_def *body = &scene_def(scene)->bodies[0];
    assert_int_equal(body->particles_per_direction, 2);
    assert_true(body->velocity.vector[1] == 0.6 && body->velocity.vector[2] == 0.8);
    scene_free(scene);
    cJSON_Delete(json);
}

static void test_scene_reads_points(void **state) {
    (void)state;
    struct scene *scene = create(POINTS("[[0.5,0.25,0.1],[1,0.75,0.2]]"));
    const struct mpm_shape *shape = &scene_def(scene)->bodies[0].shape;
    assert_int_equal(shape->kind, MPM_SHAPE_POINTS);
    assert_int_equal(shape->n_points, 2);
    assert_true(shape->points[0] == 0.5 && shape->points[5] == 0.2);
    scene_free(scene);
    assert_fault(POINTS("[]"), "/bodies/pool/shape/points", "count");
    assert_fault(POINTS("[1]"), "/bodies/pool/shape/points/0", "type");
    assert_fault(POINTS("[[1,2]]"), "/bodies/pool/shape/points/0", "length");
    assert_fault(POINTS("[[1,0.5,0]]"), "/bodies/pool/shape/points/0/2", "range");
}

static void test_scene_puts_position_first(void **state) {
    (void)state;
    static const char *const patches[] = {
        "{\"output\":{\"fields\":[\"volume_ratio\"]}}",
        "{\"output\":{\"fields\":[\"volume_ratio\",\"position\"]}}"};
    for (size_t i = 0; i < COUNT(patches); i++) {
        struct scene *scene = create(patches[i]);
        const struct scene_output *output = &scene_config(scene)->output;
        assert_int_equal(output->n_fields, 2);
        assert_int_equal(output->fields[0], MPM_FIELD_POSITION);
        assert_int_equal(output->fields[1], MPM_FIELD_VOLUME_RATIO);
        assert_true(scene_def(scene)->wants_volume_ratio);
        assert_false(scene_def(scene)->wants_mean_stress_smooth);
        scene_free(scene);
    }
    struct scene *scene = create("{\"output\":{\"fields\":[]},\"stages\":[]}");
    assert_int_equal(scene_config(scene)->output.n_fields, 1);
    assert_int_equal(scene_def(scene)->n_stages, 1);
    scene_free(scene);
}

static char *as_run(const struct scene *scene) {
    return json_print(scene_json(scene), false);
}

// Posting the scene as run back gives the same scene, to the last digit.
static void test_scene_as_run_is_a_fixed_point(void **state) {
    (void)state;
    for (size_t i = 0; i <= scene_builtin_count(); i++) {
        cJSON *json = i < scene_builtin_count()
                          ? scene_builtin(scene_builtin_name(i))
                          : patched_base("{\"time\":{\"end\":0.7},\"cell\":0.50000000000000011,"
                                         "\"walls\":null,\"fbar\":{\"scheme\":\"anchored\"}}");
        struct faults faults = {0};
        struct scene *first = scene_create(json, &faults);
        print_faults(&faults);
        assert_non_null(first);
        char *text = as_run(first);
        cJSON *again = parse(text);
        struct scene *second = scene_create(again, &faults);
        assert_non_null(second);
        char *text_again = as_run(second);
        assert_string_equal(text, text_again);
        // By member: the padding after the scheme may hold anything.
        const struct mpm_settings *one = &scene_config(first)->settings;
        const struct mpm_settings *two = &scene_config(second)->settings;
        assert_int_equal(one->fbar.scheme, two->fbar.scheme);
        assert_true(one->fbar.a == two->fbar.a && one->fbar.C == two->fbar.C);
        assert_memory_equal(one->gravity, two->gravity, sizeof one->gravity);
        assert_true(one->damping_local == two->damping_local &&
                    one->damping_mass == two->damping_mass && one->blend == two->blend &&
                    one->dt == two->dt && one->cfl == two->cfl);
        assert_true(scene_def(first)->cell == scene_def(second)->cell);
        assert_true(scene_config(first)->output.interval == scene_config(second)->output.interval);
        free(text);
        free(text_again);
        scene_free(first);
        scene_free(second);
        cJSON_Delete(again);
        cJSON_Delete(json);
    }
}

static void test_scene_as_run_has_every_default(void **state) {
    (void)state;
    struct scene *scene = create("{\"probes\":{\"front\":{\"body\":\"pool\"}}}");
    const cJSON *json = scene_json(scene);
    for (const struct scene_key *key = scene_root.keys; key->name; key++)
        if (!json_member(json, key->name))
            fail_msg("%s is not filled in", key->name);
    assert_string_equal(json_member(json, "basis")->valuestring, "bspline2");
    assert_true(json_member(json_member(json, "time"), "cfl")->valuedouble == 0.3);
    assert_null(json_member(json_member(json, "time"), "dt"));
    assert_true(json_member(json_member(json_member(json, "materials"), "water"), "viscosity")
                    ->valuedouble == 0);
    const cJSON *pool = json_member(json_member(json, "bodies"), "pool");
    assert_int_equal(cJSON_GetArraySize(json_member(pool, "velocity")), 2);
    assert_true(json_member(pool, "particles_per_cell")->valuedouble == 4);
    scene_free(scene);
}

// ---- Patches of a run ---------------------------------------------------------------------------

struct patched {
    cJSON *scene;
    struct scene_config config;
    unsigned which;
    bool end_changed, output_changed;
};

static struct patched patch_run(struct scene *scene, const char *patch_text) {
    struct patched out = {0};
    struct faults faults = {0};
    cJSON *patch = parse(patch_text);
    out.scene = scene_config_patch(scene_json(scene), patch, &out.config, &out.which,
                                   &out.end_changed, &out.output_changed, &faults);
    print_faults(&faults);
    assert_non_null(out.scene);
    assert_int_equal(faults.count, 0);
    cJSON_Delete(patch);
    return out;
}

static void assert_patch_refused(struct scene *scene, const char *patch_text, const char *pointer,
                                 const char *code) {
    struct patched out = {0};
    struct faults faults = {0};
    cJSON *patch = parse(patch_text);
    char *before = as_run(scene);
    assert_null(scene_config_patch(scene_json(scene), patch, &out.config, &out.which,
                                   &out.end_changed, &out.output_changed, &faults));
    if (!has_fault(&faults, pointer, code)) {
        print_error("%s: wanted %s %s\n", patch_text, pointer, code);
        print_faults(&faults);
    }
    assert_true(has_fault(&faults, pointer, code));
    char *after = as_run(scene);
    assert_string_equal(before, after);
    free(before);
    free(after);
    faults_free(&faults);
    cJSON_Delete(patch);
}

static void test_config_patch_changes_what_is_live(void **state) {
    (void)state;
    struct scene *scene = create("{\"time\":{\"dt\":1e-4}}");
    struct patched out = patch_run(scene, "{\"fbar\":{\"scheme\":\"anchored\",\"a\":0.2}}");
    assert_int_equal(out.which, MPM_SET_FBAR);
    assert_int_equal(out.config.settings.fbar.scheme, MPM_FBAR_ANCHORED);
    assert_true(out.config.settings.fbar.a == 0.2 && out.config.settings.fbar.C == 1);
    assert_false(out.end_changed || out.output_changed);
    cJSON_Delete(out.scene);

    out = patch_run(scene, "{\"time\":{\"dt\":null,\"cfl\":0.2,\"end\":2},\"gravity\":[1,0],"
                           "\"damping\":{\"local\":0.3},\"transfer\":{\"blend\":0.5},"
                           "\"output\":{\"interval\":0.5}}");
    assert_int_equal(out.which, MPM_SET_TIME | MPM_SET_GRAVITY | MPM_SET_DAMPING | MPM_SET_BLEND);
    assert_true(out.end_changed && out.output_changed);
    assert_true(out.config.end == 2 && out.config.output.interval == 0.5);
    assert_true(out.config.settings.dt == 0 && out.config.settings.cfl == 0.2);
    assert_true(out.config.settings.gravity[0] == 1 && out.config.settings.damping_local == 0.3);
    assert_true(json_member(json_member(out.scene, "time"), "end")->valuedouble == 2);
    cJSON_Delete(out.scene);

    out = patch_run(scene, "{}");
    assert_int_equal(out.which, 0);
    cJSON_Delete(out.scene);
    scene_free(scene);
}

// Naming the other scheme is enough: what belongs to the old one goes with it.
static void test_config_patch_switches_fbar_schemes(void **state) {
    (void)state;
    struct scene *scene = create("{\"fbar\":{\"scheme\":\"anchored\",\"a\":0.3}}");
    struct patched out = patch_run(scene, "{\"fbar\":{\"scheme\":\"zhao\"}}");
    assert_int_equal(out.config.settings.fbar.scheme, MPM_FBAR_ZHAO);
    cJSON_Delete(out.scene);
    out = patch_run(scene, "{\"fbar\":{\"scheme\":\"anchored\"}}");
    assert_true(out.config.settings.fbar.a == 0.3);
    cJSON_Delete(out.scene);
    out = patch_run(scene, "{\"fbar\":false}");
    assert_int_equal(out.config.settings.fbar.scheme, MPM_FBAR_OFF);
    cJSON_Delete(out.scene);
    assert_patch_refused(scene, "{\"fbar\":{\"scheme\":\"zhao\",\"a\":0.1}}", "/fbar/a",
                         "conflict");
    scene_free(scene);
}

static void test_config_patch_refuses_the_rest(void **state) {
    (void)state;
    struct scene *scene = create("{}");
    assert_patch_refused(scene, "{\"cell\":1}", "/cell", "immutable");
    assert_patch_refused(scene, "{\"cell\":null}", "/cell", "immutable");
    assert_patch_refused(scene, "{\"materials\":{\"water\":{\"viscosity\":1}}}", "/materials",
                         "immutable");
    assert_patch_refused(scene, "{\"transfer\":{\"scheme\":\"flip\"}}", "/transfer/scheme",
                         "immutable");
    assert_patch_refused(scene, "{\"transfer\":null}", "/transfer", "immutable");
    assert_patch_refused(scene, "{\"time\":{\"unstable_ok\":true}}", "/time/unstable_ok",
                         "immutable");
    assert_patch_refused(scene, "{\"time\":{\"dt\":1e-4}}", "/time/dt", "conflict");
    assert_patch_refused(scene, "{\"damping\":{\"local\":2}}", "/damping/local", "range");
    assert_patch_refused(scene, "{\"damping\":{\"locl\":0.2}}", "/damping/locl", "unknown_key");
    assert_patch_refused(scene, "{\"gravty\":[0,0]}", "/gravty", "unknown_key");
    assert_patch_refused(scene, "{\"gravity\":[0,0,0]}", "/gravity", "length");
    assert_patch_refused(scene, "{\"time\":{\"end\":null}}", "/time/end", "required");
    assert_patch_refused(scene, "{\"output\":{\"fields\":[\"displacement\"]}}", "/output/fields",
                         "conflict");
    assert_patch_refused(scene, "[]", "", "type");
    assert_patch_refused(scene, "3", "", "type");
    scene_free(scene);
}

static void test_config_json_can_be_patched_back(void **state) {
    (void)state;
    struct scene *scene = create("{\"time\":{\"dt\":1e-4}}");
    cJSON *config = scene_config_json(scene_json(scene));
    static const char *const keys[] = {"fbar", "damping", "transfer", "time", "gravity", "output"};
    assert_int_equal(cJSON_GetArraySize(config), COUNT(keys));
    for (size_t i = 0; i < COUNT(keys); i++)
        assert_non_null(json_member(config, keys[i]));
    assert_int_equal(cJSON_GetArraySize(json_member(config, "time")), 2);
    char *text = json_print(config, false), *before = as_run(scene);
    struct patched out = patch_run(scene, text);
    char *after = json_print(out.scene, false);
    assert_string_equal(before, after);
    free(text);
    free(before);
    free(after);
    cJSON_Delete(out.scene);
    cJSON_Delete(config);
    scene_free(scene);
}

// ---- Built-in scenes, schema, documentation -----------------------------------------------------

static void test_builtin_scenes_are_valid(void **state) {
    (void)state;
    assert_true(scene_builtin_count() >= 5);
    for (size_t i = 0; i < scene_builtin_count(); i++) {
        cJSON *json = scene_builtin(scene_builtin_name(i));
        assert_non_null(json);
        struct faults faults = {0};
        struct scene *scene = scene_create(json, &faults);
        print_faults(&faults);
        assert_non_null(scene);
        size_t bytes;
        const char *text = scene_builtin_text(i, &bytes);
        assert_int_equal(text[0], '{');
        size_t n;
        scene_references(scene, &n);
        assert_true(n > 0);
        scene_free(scene);
        cJSON_Delete(json);
    }
    assert_null(scene_builtin("no-such-scene"));
}

static void test_dam_break_takes_a_softer_fluid(void **state) {
    (void)state;
    cJSON *scene_text = scene_builtin("dam-break");
    cJSON *patch =
        parse("{\"materials\":{\"water\":{\"bulk_modulus\":2e7}},"
              "\"time\":{\"dt\":null,\"cfl\":0.3},"
              "\"stages\":[{\"name\":\"settle\",\"duration\":0.6,\"damping\":{\"local\":0.5}},"
              "{\"name\":\"flow\",\"remove\":{\"walls\":[\"gate\"]}}]}");
    cJSON *merged = json_merge_patch(scene_text, patch);
    struct faults faults = {0};
    struct scene *scene = scene_create(merged, &faults);
    print_faults(&faults);
    assert_non_null(scene);
    struct mpm_estimate estimate;
    mpm_estimate(scene_def(scene), &estimate);
    assert_int_equal(estimate.particles, 3200);
    assert_true(estimate.steps > 3000 && estimate.steps < 6000);
    scene_free(scene);
    cJSON_Delete(scene_text);
    cJSON_Delete(patch);
    cJSON_Delete(merged);
}

// The counts that the paper gives, at its two resolutions.
static void test_paper_scenes_have_the_particles_of_the_paper(void **state) {
    (void)state;
    static const struct {
        const char *name, *patch;
        size_t particles;
    } scenes[] = {{"cook-membrane", "{}", 5776},   {"cook-membrane", "{\"cell\":0.5}", 23072},
                  {"strip-footing", "{}", 230400}, {"strip-footing-small", "{}", 24000},
                  {"landslide-slice", "{}", 6225}, {"landslide", "{}", 311250}};
    for (size_t i = 0; i < COUNT(scenes); i++) {
        cJSON *json = scene_builtin(scenes[i].name), *patch = parse(scenes[i].patch);
        cJSON *merged = json_merge_patch(json, patch);
        struct faults faults = {0};
        struct scene *scene = scene_create(merged, &faults);
        print_faults(&faults);
        assert_non_null(scene);
        struct mpm_estimate estimate;
        mpm_estimate(scene_def(scene), &estimate);
        assert_int_equal(estimate.particles, scenes[i].particles);
        scene_free(scene);
        cJSON_Delete(merged);
        cJSON_Delete(patch);
        cJSON_Delete(json);
    }
}

// Every file can be stepped.
static void test_builtin_scenes_make_three_steps(void **state) {
    (void)state;
    for (size_t i = 0; i < scene_builtin_count(); i++) {
        cJSON *json = scene_builtin(scene_builtin_name(i));
        struct faults faults = {0};
        struct scene *scene = scene_create(json, &faults);
        struct mpm_sim *sim;
        struct mpm_error error;
        assert_int_equal(mpm_create(scene_def(scene), &sim, &error), MPM_OK);
        for (int k = 0; k < 3; k++)
            if (mpm_step(sim, &error))
                fail_msg("%s: %s", scene_builtin_name(i), error.message);
        mpm_free(sim);
        scene_free(scene);
        cJSON_Delete(json);
    }
}

// Every key of the table is somewhere in the schema's text as a property.
static void assert_schema_names(const char *schema, const struct scene_value *value, int depth) {
    for (const struct scene_key *key = value->keys; key && key->name; key++) {
        char property[80];
        snprintf(property, sizeof property, "\"%s\":{", key->name);
        if (!strstr(schema, property))
            fail_msg("the schema has no %s", key->name);
        if (depth)
            assert_schema_names(schema, &key->value, depth - 1);
    }
    size_t n = value->type == SCENE_EITHER ? value->n_items : value->items ? 1 : 0;
    for (size_t i = 0; i < n && depth; i++)
        assert_schema_names(schema, &value->items[i], depth - 1);
}

static void test_schema_covers_the_table(void **state) {
    (void)state;
    cJSON *schema = scene_schema();
    assert_string_equal(json_member(schema, "$schema")->valuestring,
                        "https://json-schema.org/draft/2020-12/schema");
    assert_non_null(json_member(json_member(schema, "$defs"), "shape"));
    char *text = json_print(schema, false);
    assert_schema_names(text, &scene_root, 8);
    for (size_t i = 0; i < mpm_material_count(); i++) {
        struct scene_material_keys keys;
        scene_material_keys(mpm_material_at(i), &keys);
        struct scene_value material = {.type = SCENE_OBJECT, .keys = keys.keys};
        assert_schema_names(text, &material, 1);
        assert_non_null(strstr(text, mpm_material_name(mpm_material_at(i))));
    }
    assert_non_null(strstr(text, "\"exclusiveMaximum\":0.5")); // Poisson's ratio
    struct faults faults = {0};
    cJSON *again = json_parse(text, strlen(text), &faults); // no key twice
    assert_non_null(again);
    cJSON_Delete(again);
    free(text);
    cJSON_Delete(schema);
}

static void test_materials_are_listed(void **state) {
    (void)state;
    cJSON *json = scene_materials_json();
    const cJSON *list = json_member(json, "materials");
    assert_int_equal(cJSON_GetArraySize(list), (int)mpm_material_count());
    for (const cJSON *material = list->child; material; material = material->next) {
        assert_non_null(mpm_material_find(json_member(material, "name")->valuestring));
        assert_string_equal(
            json_member(json_member(material, "parameters")->child, "key")->valuestring, "density");
    }
    cJSON_Delete(json);
}

static char *file_text(const char *path) {
    FILE *file = fopen(path, "rb");
    if (!file)
        return NULL;
    char *text = calloc(1, 1 << 20);
    size_t n = fread(text, 1, (1 << 20) - 1, file);
    text[n] = 0;
    fclose(file);
    return text;
}

// docs/scene.md between its markers is what the table says. FBARD_WRITE_DOCS=1 rewrites it.
static void test_documentation_follows_the_table(void **state) {
    (void)state;
    static const char path[] = "docs/scene.md", begin[] = "<!-- keys: begin -->\n",
                      end[] = "<!-- keys: end -->";
    char *text = file_text(path);
    if (!text)
        skip(); // not run from the repository's root
    char *markdown = scene_reference_markdown(), *from = strstr(text, begin),
         *to = strstr(text, end);
    assert_true(from && to && to > from);
    from += strlen(begin);
    bool same =
        strlen(markdown) == (size_t)(to - from) && memcmp(markdown, from, strlen(markdown)) == 0;
    if (!same && getenv("FBARD_WRITE_DOCS")) {
        FILE *file = fopen(path, "wb");
        assert_non_null(file);
        fprintf(file, "%.*s%s%s", (int)(from - text), text, markdown, to);
        fclose(file);
    } else if (!same) {
        fail_msg("docs/scene.md is not what the table says; run this test with FBARD_WRITE_DOCS=1");
    }
    free(markdown);
    free(text);
}

int main(int argc, char **argv) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_scene_refuses_wrong_types),
        cmocka_unit_test(test_scene_refuses_values_out_of_bounds),
        cmocka_unit_test(test_scene_refuses_particles_that_are_no_lattice),
        cmocka_unit_test(test_scene_refuses_missing_keys),
        cmocka_unit_test(test_scene_refuses_unknown_keys_with_a_suggestion),
        cmocka_unit_test(test_scene_refuses_unknown_words_and_names),
        cmocka_unit_test(test_scene_refuses_what_does_not_go_together),
        cmocka_unit_test(test_scene_refuses_bad_stages),
        cmocka_unit_test(test_scene_refuses_what_is_for_the_other_dimension),
        cmocka_unit_test(test_scene_refuses_bad_names_and_sizes),
        cmocka_unit_test(test_scene_reports_all_faults),
        cmocka_unit_test(test_scene_that_is_no_object_is_refused),
        cmocka_unit_test(test_scene_passes_on_faults_of_the_solver),
        cmocka_unit_test(test_scene_refuses_polygons_that_are_not_simple),
        cmocka_unit_test(test_scene_takes_polygons_either_way_round),
        cmocka_unit_test(test_scene_reads_extrusions_and_cylinders),
        cmocka_unit_test(test_scene_reads_loads),
        cmocka_unit_test(test_scene_refuses_bad_loads),
        cmocka_unit_test(test_scene_reads_rigid_bodies),
        cmocka_unit_test(test_scene_refuses_bad_rigid_bodies),
        cmocka_unit_test(test_scene_reads_solutions),
        cmocka_unit_test(test_scene_reads_tables),
        cmocka_unit_test(test_scene_refuses_bad_errors),
        cmocka_unit_test(test_scene_refuses_bad_selections),
        cmocka_unit_test(test_scene_refuses_bad_body_forces),
        cmocka_unit_test(test_scene_refuses_bad_citations),
        cmocka_unit_test(test_scene_reads_plastic_materials),
        cmocka_unit_test(test_scene_reports_the_solver_s_faults_with_its_own),
        cmocka_unit_test(test_scene_refuses_what_no_run_can_give),
        cmocka_unit_test(test_scene_definition_follows_the_scene),
        cmocka_unit_test(test_scene_stages_state_settings_and_keep_changes),
        cmocka_unit_test(test_scene_in_three_dimensions),
        cmocka_unit_test(test_scene_reads_points),
        cmocka_unit_test(test_scene_puts_position_first),
        cmocka_unit_test(test_scene_as_run_is_a_fixed_point),
        cmocka_unit_test(test_scene_as_run_has_every_default),
        cmocka_unit_test(test_config_patch_changes_what_is_live),
        cmocka_unit_test(test_config_patch_switches_fbar_schemes),
        cmocka_unit_test(test_config_patch_refuses_the_rest),
        cmocka_unit_test(test_config_json_can_be_patched_back),
        cmocka_unit_test(test_builtin_scenes_are_valid),
        cmocka_unit_test(test_dam_break_takes_a_softer_fluid),
        cmocka_unit_test(test_paper_scenes_have_the_particles_of_the_paper),
        cmocka_unit_test(test_builtin_scenes_make_three_steps),
        cmocka_unit_test(test_schema_covers_the_table),
        cmocka_unit_test(test_materials_are_listed),
        cmocka_unit_test(test_documentation_follows_the_table),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
