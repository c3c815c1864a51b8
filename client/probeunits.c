#include "client/probeunits.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

// By kind, in 2D and 3D; kinds that are not listed read the field that they name.
static const struct {
    const char *kind, *unit[2];
} kinds[] = {
    {"extent", {"m", "m"}},   {"displacement", {"m", "m"}},     {"reaction", {"N/m", "N"}},
    {"energy", {"J/m", "J"}}, {"momentum", {"kg/s", "kg m/s"}}, // (kg m/s)/m
    {"drift", {"1", "1"}},
};

static const char *text_of(const cJSON *object, const char *key) {
    const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return text ? text : "";
}

static double number_of(const cJSON *object, const char *key, double otherwise) {
    const cJSON *number = cJSON_GetObjectItemCaseSensitive(object, key);
    return cJSON_IsNumber(number) ? number->valuedouble : otherwise;
}

static const char *unit_of(const cJSON *probe, const struct store_plan *plan) {
    const char *kind = text_of(probe, "kind"), *field = text_of(probe, "field");
    if (strcmp(kind, "error") == 0 && strcmp(text_of(probe, "norm"), "absolute") != 0)
        return "1";
    for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++)
        if (strcmp(kinds[i].kind, kind) == 0)
            return kinds[i].unit[plan->dimension == 3];
    for (size_t i = 0; i < plan->n_fields; i++)
        if (strcmp(plan->fields[i].name, field) == 0)
            return plan->fields[i].unit;
    return store_field_unit(field); // no frame has it
}

static void append(char *line, size_t bytes, const char *before, const char *text) {
    const size_t n = strlen(line);
    if (*text)
        snprintf(line + n, bytes - n, "%s%s", before, text);
}

// What an error is held against: a table's name, or a solution, whose only key is its name.
static const char *against_of(const cJSON *probe) {
    const cJSON *against = cJSON_GetObjectItemCaseSensitive(probe, "against");
    return cJSON_IsObject(against) && against->child ? against->child->string
                                                     : text_of(probe, "against");
}

static void describe(const cJSON *probe, double scale, char *out, size_t bytes) {
    char number[48];
    const double average = number_of(probe, "average", 0);
    *out = '\0';
    append(out, bytes, "", text_of(probe, "kind"));
    append(out, bytes, " of ", text_of(probe, "field"));
    append(out, bytes, " along ", text_of(probe, "axis"));
    if (*text_of(probe, "axis"))
        append(out, bytes, ", ", text_of(probe, "side"));
    append(out, bytes, " against ", against_of(probe));
    append(out, bytes, ", norm ", text_of(probe, "norm"));
    append(out, bytes, ", body ", text_of(probe, "body"));
    append(out, bytes, ", wall ", text_of(probe, "wall"));
    if (average > 0) {
        snprintf(number, sizeof number, "%g s", average);
        append(out, bytes, ", moving mean over ", number);
    }
    if (scale != 1) {
        snprintf(number, sizeof number, "%g", scale);
        append(out, bytes, ", times ", number);
    }
}

void probeunits_find(const cJSON *scene, const struct store_plan *plan, const char *name,
                     struct probeunits *out) {
    const cJSON *probe =
        cJSON_GetObjectItemCaseSensitive(cJSON_GetObjectItemCaseSensitive(scene, "probes"), name);
    if (!probe) {
        snprintf(out->unit, sizeof out->unit, "unknown");
        snprintf(out->long_name, sizeof out->long_name, "%s", name);
        return;
    }
    const double scale = number_of(probe, "scale", 1);
    // A change of sign leaves the unit what it was.
    snprintf(out->unit, sizeof out->unit, "%s%s", fabs(scale) == 1 ? "" : "scaled ",
             unit_of(probe, plan));
    describe(probe, scale, out->long_name, sizeof out->long_name);
}
