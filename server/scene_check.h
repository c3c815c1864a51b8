// A scene's JSON against the table of keys: every fault at once, and every default filled in.
#pragma once
#include <cjson/cJSON.h>

#include "server/json.h"
#include "server/mpm/mpm.h"

// Checks `scene` and adds its faults; fills defaults into it, so that without a fault every key
// that the table gives a default is there. What only the solver can see is not checked here.
void scene_check(cJSON *scene, struct faults *faults);
// Checks that a merge patch reaches nothing but keys that may change while a run goes on; what else
// it reaches is a fault and is taken out of it.
void scene_check_live(cJSON *patch, struct faults *faults);
// The components of a probe (checked JSON): the name of component `index`, NULL past the last; ""
// for the one component of a scalar.
const char *scene_probe_component(const cJSON *probe, int dimension, int index);
// The same of a field.
const char *scene_field_component(enum mpm_field field, int dimension, int index);
// Where in a table's first column a reference whose value is cited reads it: its own `at`, or the
// reference's time.
double scene_cited_at(const cJSON *reference, double end);
