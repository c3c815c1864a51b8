// The points of bench/accuracy.json: bench/accuracy.py expands the same file in the same order
// (tests/cli/test_bench.py compares the two).
#include "client/bench_points.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "client/terminal.h"
#include "proto/embedded.h"

extern const struct embedded bench_data[]; // accuracy: the Makefile

static const char *const schemes[] = {"standard", "zhao", "anchored"};

cJSON *bench_study(void) {
    cJSON *study = cJSON_Parse(bench_data[0].text);
    if (!study)
        terminal_error("no memory");
    return study;
}

static const cJSON *member(const cJSON *object, const char *key) {
    return cJSON_GetObjectItemCaseSensitive(object, key);
}

static double number(const cJSON *object, const char *key) {
    return cJSON_GetNumberValue(member(object, key));
}

static const char *text(const cJSON *object, const char *key) {
    const char *value = cJSON_GetStringValue(member(object, key));
    return value ? value : "";
}

struct visitor {
    void (*visit)(void *context, const struct bench_point *point);
    void *context;
};

static void each_cell(const struct visitor *visitor, struct bench_point point) {
    static const char *const lists[] = {"cells", "finer"};
    for (int k = 0; k < 2; k++) {
        const cJSON *cell;
        cJSON_ArrayForEach(cell, member(point.problem, lists[k])) {
            point.cell = cell->valuedouble;
            snprintf(point.name, sizeof point.name, "%s-%s-%s-%g-%g-%g-%g",
                     text(point.problem, "name"), point.basis, point.scheme, point.cfl, point.ppc,
                     point.blend, point.cell);
            visitor->visit(visitor->context, &point);
        }
    }
}

static void each_factor(const struct visitor *visitor, const cJSON *factors,
                        const struct bench_point *standard) {
    const cJSON *factor, *value;
    cJSON_ArrayForEach(factor, factors) {
        cJSON_ArrayForEach(value, factor) {
            struct bench_point point = *standard;
            double *changed = strcmp(factor->string, "cfl") == 0   ? &point.cfl
                              : strcmp(factor->string, "ppc") == 0 ? &point.ppc
                                                                   : &point.blend;
            if (*changed == value->valuedouble)
                continue; // the default itself
            *changed = value->valuedouble;
            each_cell(visitor, point);
        }
    }
}

void bench_each(const cJSON *study, void (*visit)(void *context, const struct bench_point *point),
                void *context) {
    const struct visitor visitor = {visit, context};
    const cJSON *usual = member(study, "default"), *problem, *basis;
    cJSON_ArrayForEach(problem, member(study, "problems")) {
        struct bench_point point = {.problem = problem,
                                    .scene = text(problem, "scene"),
                                    .cfl = number(usual, "cfl"),
                                    .ppc = number(problem, "ppc"),
                                    .blend = number(usual, "blend")};
        cJSON_ArrayForEach(basis, member(study, "bases")) {
            for (size_t k = 0; k < sizeof schemes / sizeof *schemes; k++) {
                point.basis = basis->valuestring;
                point.scheme = schemes[k];
                each_cell(&visitor, point);
            }
        }
        point.basis = text(usual, "basis");
        point.scheme = text(usual, "scheme");
        each_factor(&visitor, member(study, "factors"), &point);
    }
}

// Replaces {"constant": c, "per_spacing": k} by c + k times the distance of particles.
static void resolve(cJSON *value, double spacing) {
    if (member(value, "per_spacing")) {
        const double sum = number(value, "constant") + number(value, "per_spacing") * spacing;
        cJSON_Delete(value->child);
        value->child = NULL;
        value->type = (value->type & cJSON_StringIsConst) | cJSON_Number;
        cJSON_SetNumberValue(value, sum);
        return;
    }
    cJSON *item;
    cJSON_ArrayForEach(item, value) resolve(item, spacing);
}

// One merge patch that does what `to` and then `more` do; `more` is taken.
static void compose(cJSON *to, cJSON *more) {
    while (more->child) {
        cJSON *item = cJSON_DetachItemViaPointer(more, more->child);
        cJSON *there = cJSON_GetObjectItemCaseSensitive(to, item->string);
        if (cJSON_IsObject(there) && cJSON_IsObject(item)) {
            compose(there, item);
        } else {
            cJSON_DeleteItemFromObjectCaseSensitive(to, item->string);
            cJSON_AddItemToObject(to, item->string, item);
        }
    }
    cJSON_Delete(more);
}

// A measure is a reference whose source is its name; how far off is no fault here.
static void add_measures(cJSON *patch, const cJSON *measures) {
    const cJSON *measure;
    cJSON *references = cJSON_CreateArray();
    cJSON_ArrayForEach(measure, measures) {
        if (!cJSON_IsObject(measure)) { // the scene's own
            cJSON_Delete(references);
            return;
        }
        cJSON *reference = cJSON_Duplicate(measure, true);
        cJSON_AddNumberToObject(reference, "tolerance", 0.05);
        cJSON_AddStringToObject(reference, "source", measure->string);
        cJSON_AddItemToArray(references, reference);
    }
    cJSON_AddItemToObject(patch, "references", references);
}

cJSON *bench_overrides(const struct bench_point *point) {
    cJSON *patch = cJSON_CreateObject();
    cJSON_AddNumberToObject(patch, "cell", point->cell);
    cJSON_AddStringToObject(patch, "basis", point->basis);
    if (strcmp(point->scheme, "anchored") == 0)
        cJSON_AddStringToObject(cJSON_AddObjectToObject(patch, "fbar"), "scheme", point->scheme);
    else
        cJSON_AddBoolToObject(patch, "fbar", strcmp(point->scheme, "zhao") == 0);
    cJSON_AddNumberToObject(cJSON_AddObjectToObject(patch, "transfer"), "blend", point->blend);
    cJSON_AddNumberToObject(cJSON_AddObjectToObject(patch, "time"), "cfl", point->cfl);
    cJSON *body = cJSON_AddObjectToObject(cJSON_AddObjectToObject(patch, "bodies"),
                                          text(point->problem, "body"));
    cJSON_AddNumberToObject(body, "particles_per_cell", point->ppc);
    add_measures(patch, member(point->problem, "measures"));
    cJSON *more = cJSON_Duplicate(member(point->problem, "overrides"), true);
    resolve(more, point->cell / sqrt(point->ppc));
    compose(patch, more);
    return patch;
}
