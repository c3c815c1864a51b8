// A scene's JSON against the table of keys: every fault at once, and every default filled in.
#pragma once
#include <cjson/cJSON.h>

#include "server/json.h"

// Checks `scene` and adds its faults; fills defaults into it, so that without a fault every key
// that the table gives a default is there. What only the solver can see is not checked here.
void scene_check(cJSON *scene, struct faults *faults);
// Checks that a merge patch reaches nothing but keys that may change while a run goes on; what else
// it reaches is a fault and is taken out of it.
void scene_check_live(cJSON *patch, struct faults *faults);
// The components of a probe (checked JSON): the name of component `index`, NULL past the last; ""
// for the one component of a scalar.
const char *scene_probe_component(const cJSON *probe, int dimension, int index);
