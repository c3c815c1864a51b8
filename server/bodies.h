// The table of every key that the body of a request can hold, but for scenes (scene_keys.h): what
// is checked, and what the OpenAPI document says of it.
#pragma once
#include "server/json.h"

// Every fault of `body`, an object, as the schema `name`: keys that there are not, keys that lack,
// values of another type or out of range.
void bodies_check(const char *name, const cJSON *body, struct faults *faults);
const char *bodies_name(size_t index); // of the schema; NULL past the last
cJSON *bodies_schema(size_t index);    // new
