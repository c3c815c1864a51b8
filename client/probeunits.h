// The unit of a probe, and what it measures, from the scene as run.
#pragma once
#include <cjson/cJSON.h>
#include <stddef.h>

#include "client/store.h"

struct probeunits {
    char unit[48], long_name[256];
};

// `scene` NULL or without the probe: unit "unknown" and the probe's name. A field has the unit that
// the frames of `plan` give it. In 2D forces, energies and momenta are per metre of thickness.
void probeunits_find(const cJSON *scene, const struct store_plan *plan, const char *probe,
                     struct probeunits *out);
