// Fields as a frame carries them: in the order of the particles' ids, C order, particle first.
#include <string.h>

#include "server/mpm/sim.h"

static const struct mpm_field_info infos[] = {
#define X(code, text, form, type, units, about)                                                    \
    {.name = text, .unit = units, .doc = about, .shape = form, .dtype = type},
#include "server/mpm/fields.def"
#undef X
};

const struct mpm_field_info *mpm_field_info(enum mpm_field field) {
    return &infos[field];
}

int mpm_field_parse(const char *name) {
    for (int k = 0; k < MPM_N_FIELDS; k++) {
        if (strcmp(infos[k].name, name) == 0) {
            return k;
        }
    }
    return -1;
}

size_t mpm_field_components(enum mpm_field field, int dim) {
    const size_t d = (size_t)dim;
    switch (infos[field].shape) {
    case MPM_SCALAR:
        return 1;
    case MPM_VECTOR:
        return d;
    case MPM_TENSOR:
        return d * d;
    }
    return 0;
}

bool mpm_field_present(const struct mpm_sim *sim, enum mpm_field field) {
    switch (field) {
    case MPM_FIELD_DISPLACEMENT:
        return sim->n_sets > 0 && sim->sets[0].x0 != NULL;
    case MPM_FIELD_PLASTIC_STRAIN:
        for (size_t b = 0; b < sim->n_sets; b++) {
            if (sim->sets[b].plastic_strain) {
                return true;
            }
        }
        return false;
    default:
        return true;
    }
}

double mpm_mean_stress(const struct mpm_particles *s, size_t p) {
    double sum = 0;
    for (int k = 0; k < 3; k++) {
        sum += s->sigma[mpm_at(p, MPM_SYM(s->dim), k)];
    }
    return sum / 3;
}

static double von_mises(const struct mpm_particles *s, size_t p) {
    const double mean = mpm_mean_stress(s, p);
    double sum = 0;
    for (int k = 0; k < MPM_SYM(s->dim); k++) {
        const double t = s->sigma[mpm_at(p, MPM_SYM(s->dim), k)] - (k < 3 ? mean : 0);
        sum += (k < 3 ? 1 : 2) * t * t;
    }
    return sqrt(1.5 * sum);
}

void mpm_particle_field(const struct mpm_particles *s, size_t p, enum mpm_field field,
                        double *out) {
    const int dim = s->dim;
    switch (field) {
    case MPM_FIELD_POSITION:
    case MPM_FIELD_VELOCITY:
        for (int d = 0; d < dim; d++) {
            out[d] = (field == MPM_FIELD_POSITION ? s->x : s->v)[mpm_at(p, dim, d)];
        }
        break;
    case MPM_FIELD_DISPLACEMENT:
        for (int d = 0; d < dim; d++) {
            out[d] = s->x0 ? s->x[mpm_at(p, dim, d)] - s->x0[mpm_at(p, dim, d)] : 0;
        }
        break;
    case MPM_FIELD_MEAN_STRESS:
        out[0] = mpm_mean_stress(s, p);
        break;
    case MPM_FIELD_MEAN_STRESS_SMOOTH:
        out[0] = s->smooth ? s->smooth[mpm_particle_id(s, p)] : NAN;
        break;
    case MPM_FIELD_STRESS:
        for (int i = 0; i < dim; i++) {
            for (int j = 0; j < dim; j++) {
                out[i * dim + j] = s->sigma[mpm_at(p, MPM_SYM(dim), mpm_sym_index(i, j))];
            }
        }
        break;
    case MPM_FIELD_VON_MISES:
        out[0] = von_mises(s, p);
        break;
    case MPM_FIELD_VOLUME_RATIO:
        out[0] = s->J_raw ? s->J_raw[p] : s->V[p] / s->V0[p];
        break;
    case MPM_FIELD_VOLUME_RATIO_BAR:
        out[0] = mpm_ratio_in_use(s, p);
        break;
    case MPM_FIELD_DENSITY:
        out[0] = s->density * s->V0[p] / s->V[p];
        break;
    case MPM_FIELD_BODY:
        out[0] = s->body;
        break;
    case MPM_FIELD_ID:
        out[0] = (double)(s->first_id + s->id[p]);
        break;
    case MPM_FIELD_PLASTIC_STRAIN:
        out[0] = s->plastic_strain ? s->plastic_strain[p] : 0;
        break;
    case MPM_N_FIELDS:
        out[0] = 0;
        break;
    }
}

void mpm_field_copy(const struct mpm_sim *sim, enum mpm_field field, void *out) {
    const size_t width = mpm_field_components(field, sim->grid.dim);
    const bool is_u4 = strcmp(infos[field].dtype, "<u4") == 0;
    if (field == MPM_FIELD_MEAN_STRESS_SMOOTH) {
        mpm_smooth_update(sim);
    }
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            const size_t id = s->first_id + s->id[p];
            if (is_u4) {
                double value;
                mpm_particle_field(s, p, field, &value);
                ((uint32_t *)out)[id] = (uint32_t)value;
            } else {
                mpm_particle_field(s, p, field, (double *)out + id * width);
            }
        }
    }
}
