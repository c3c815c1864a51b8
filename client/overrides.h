// key=value words of the command line as a JSON merge patch, and SCENE words as JSON text.
#pragma once
#include <cjson/cJSON.h>

#include "client/client.h"

// Sets the dotted key of `word` ("materials.water.density=1000") in `patch`; the value is JSON
// where it parses, else a string. 0, or -1 with the fault printed.
int overrides_add(cJSON *patch, const char *word);

// What SCENE names, as JSON text to put into a request: a built-in name quoted, or the text of a
// file (a word that ends in .json or has a slash). NULL with the fault printed. The caller frees
// it.
char *overrides_scene(const char *word);
// {"scene": <scene>, "overrides": <patch>, <rest>} with `scene` as overrides_scene gives it; `rest`
// is JSON members or "". The caller frees it; NULL with the fault printed.
char *overrides_body(const char *scene, const cJSON *patch, const char *rest);
