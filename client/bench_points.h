// The points of bench/accuracy.json (built in), as names and as overrides of a scene.
#pragma once
#include <cjson/cJSON.h>

#define BENCH_NAME 120

struct bench_point {
    char name[BENCH_NAME];
    const cJSON *problem; // borrowed from the study
    const char *scene, *basis, *scheme;
    double cfl, ppc, blend, cell;
};

// The study; NULL with the fault printed. The caller deletes it.
cJSON *bench_study(void);
// Calls `visit` for every point, in the order of bench/accuracy.py.
void bench_each(const cJSON *study, void (*visit)(void *context, const struct bench_point *point),
                void *context);
// The merge patch on the point's scene, its measures as references. The caller deletes it.
cJSON *bench_overrides(const struct bench_point *point);
