// The list of all constitutive models, from laws.h.
#include "server/mpm/laws.h"

#include <string.h>

#define X(name, keeps) extern const struct mpm_material mpm_material_##name;
MPM_LAWS(X)
#undef X

static const struct mpm_material *const materials[] = {
#define X(name, keeps) [MPM_LAW_##name] = &mpm_material_##name,
    MPM_LAWS(X)
#undef X
};

size_t mpm_material_count(void) {
    return sizeof materials / sizeof *materials;
}

const struct mpm_material *mpm_material_at(size_t index) {
    return materials[index];
}

const struct mpm_material *mpm_material_find(const char *model) {
    for (size_t k = 0; k < mpm_material_count(); k++) {
        if (strcmp(materials[k]->name, model) == 0) {
            return materials[k];
        }
    }
    return NULL;
}

const char *mpm_material_name(const struct mpm_material *model) {
    return model->name;
}

const char *mpm_material_doc(const struct mpm_material *model) {
    return model->doc;
}

bool mpm_material_yields(const struct mpm_material *model) {
    return model->plastic;
}

const struct mpm_parameter *mpm_material_parameter(const struct mpm_material *model, size_t k) {
    for (size_t i = 0; i < k; i++) {
        if (!model->parameters[i].key) {
            return NULL;
        }
    }
    return model->parameters[k].key ? &model->parameters[k] : NULL;
}

enum mpm_law mpm_material_law(const struct mpm_material *model) {
    int law = 0;
    while (law < MPM_N_LAWS && materials[law] != model) {
        law++;
    }
    return (enum mpm_law)law;
}
