// Scenes: what is refused (by pointer and code), what is filled in, what the definition then says,
// what may be patched, and that schema and documentation follow the table of keys.
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
    assert_fault("{\"loads\":{\"push\":{}}}", "/loads", "unsupported");
    assert_fault("{\"rigid_bodies\":{\"foot\":{}}}", "/rigid_bodies", "unsupported");
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
    assert_fault("{\"cell\":1e-3,\"bodies\":{\"pool\":{\"particles_per_cell\":1024}}}",
                 "/bodies/pool/shape", "memory");
    scene_free(create("{\"time\":{\"dt\":1},\"unstable_ok\":true}"));
    scene_free(create("{\"time\":{\"dt\":1,\"unstable_ok\":true}}"));
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
        assert_memory_equal(&scene_config(first)->settings, &scene_config(second)->settings,
                            sizeof(struct mpm_settings));
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
    assert_string_equal(json_member(json, "basis")->valuestring, "gimp");
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
        cmocka_unit_test(test_schema_covers_the_table),
        cmocka_unit_test(test_materials_are_listed),
        cmocka_unit_test(test_documentation_follows_the_table),
    };
    if (argc > 1)
        cmocka_set_test_filter(argv[1]);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
