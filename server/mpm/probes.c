// Probes, and the balance of conserved quantities. Sums run in the order of the particles.
#include <string.h>

#include "server/mpm/sim.h"

struct mpm_medium mpm_probe_medium(const struct mpm_def *def, const struct mpm_probe_def *q) {
    const size_t last = def->n_stages - 1;
    const struct mpm_material_def *m =
        mpm_material_of(def, def->bodies[q->body < 0 ? 0 : q->body].material, last);
    const struct mpm_settings settings = mpm_stage_settings(def, last, &def->settings);
    return mpm_medium_of(m->model, m->parameters, settings.gravity);
}

static bool takes_field(enum mpm_probe_kind kind) {
    return kind == MPM_PROBE_FIELD || kind == MPM_PROBE_MAXIMUM || kind == MPM_PROBE_MINIMUM ||
           kind == MPM_PROBE_MEAN;
}

bool mpm_probe_reads(const struct mpm_probe_def *q, enum mpm_field field) {
    return (takes_field(q->kind) || q->kind == MPM_PROBE_ERROR) && q->field == (int)field;
}

size_t mpm_probe_components(const struct mpm_sim *sim, size_t probe) {
    const struct mpm_probe_def *q = &sim->def->probes[probe];
    if (takes_field(q->kind)) {
        return mpm_field_components((enum mpm_field)q->field, sim->grid.dim);
    }
    switch (q->kind) {
    case MPM_PROBE_DISPLACEMENT:
    case MPM_PROBE_REACTION:
    case MPM_PROBE_MOMENTUM:
        return (size_t)sim->grid.dim;
    case MPM_PROBE_ENERGY:
        return 4;
    default:
        return 1;
    }
}

const char *mpm_probe_component_name(const struct mpm_sim *sim, size_t probe, size_t component) {
    static const char *const vector[] = {"x", "y", "z"};
    static const char *const tensor[2][9] = {
        {"xx", "xy", "yx", "yy"}, {"xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz"}};
    static const char *const energy[] = {"kinetic", "strain", "potential", "total"};
    const size_t n = mpm_probe_components(sim, probe);
    if (n == 1) {
        return "";
    }
    if (sim->def->probes[probe].kind == MPM_PROBE_ENERGY) {
        return energy[component];
    }
    return n == (size_t)sim->grid.dim ? vector[component] : tensor[sim->grid.dim - 2][component];
}

// The particle of the probe's body nearest to its point in the reference configuration.
void mpm_probes_find_particles(struct mpm_sim *sim) {
    for (size_t k = 0; k < sim->def->n_probes; k++) {
        const struct mpm_probe_def *q = &sim->def->probes[k];
        double least = INFINITY;
        for (size_t b = 0; b < sim->n_sets; b++) {
            const struct mpm_particles *s = &sim->sets[b];
            for (size_t p = 0; (q->body < 0 || q->body == (int)b) && p < s->n; p++) {
                double r2 = 0;
                for (int d = 0; d < s->dim; d++) {
                    const double e = s->x[mpm_at(p, s->dim, d)] - q->at[d];
                    r2 += e * e;
                }
                if (r2 < least) {
                    least = r2;
                    sim->probe_set[k] = b;
                    sim->probe_particle[k] = s->id[p];
                }
            }
        }
    }
}

// Whether the probe reads the particle at place p of a set.
static bool reads(const struct mpm_sim *sim, size_t probe, const struct mpm_particles *s,
                  size_t p) {
    const struct mpm_probe_def *q = &sim->def->probes[probe];
    if (sim->compares[probe].chosen) {
        return sim->compares[probe].chosen[mpm_particle_id(s, p)];
    }
    if (!q->has_box) {
        return true;
    }
    for (int d = 0; d < s->dim; d++) {
        const double x = s->x0[mpm_at(p, s->dim, d)];
        if (!(x >= q->box_min[d] && x <= q->box_max[d])) {
            return false;
        }
    }
    return true;
}

// Maximum, minimum or mean of a field over the probe's particles; NaN over none.
static void fold_field(const struct mpm_sim *sim, size_t probe, double *out) {
    const struct mpm_probe_def *q = &sim->def->probes[probe];
    const enum mpm_field field =
        q->kind == MPM_PROBE_DISPLACEMENT ? MPM_FIELD_DISPLACEMENT : (enum mpm_field)q->field;
    const size_t width = mpm_field_components(field, sim->grid.dim);
    size_t n = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; (q->body < 0 || q->body == (int)b) && p < s->n; p++) {
            if (!reads(sim, probe, s, p)) {
                continue;
            }
            double value[MPM_MAX_COMPONENTS];
            mpm_particle_field(s, p, field, value);
            for (size_t c = 0; c < width; c++) {
                out[c] = n == 0                         ? value[c]
                         : q->kind == MPM_PROBE_MAXIMUM ? fmax(out[c], value[c])
                         : q->kind == MPM_PROBE_MINIMUM ? fmin(out[c], value[c])
                                                        : out[c] + value[c];
            }
            n++;
        }
    }
    for (size_t c = 0; c < width; c++) {
        if (n == 0) {
            out[c] = NAN;
        } else if (q->kind == MPM_PROBE_MEAN || q->kind == MPM_PROBE_DISPLACEMENT) {
            out[c] /= (double)n;
        }
    }
}

// The value of the given rank (0 = smallest) among n, which it reorders: Hoare's selection. qsort
// may allocate.
static double ranked(double *value, size_t n, size_t rank) {
    ptrdiff_t lo = 0, hi = (ptrdiff_t)n - 1;
    const ptrdiff_t k = (ptrdiff_t)rank;
    while (lo < hi) {
        const double pivot = value[lo + (hi - lo) / 2];
        ptrdiff_t i = lo, j = hi;
        while (i <= j) {
            while (value[i] < pivot) {
                i++;
            }
            while (value[j] > pivot) {
                j--;
            }
            if (i <= j) {
                const double swap = value[i];
                value[i++] = value[j];
                value[j--] = swap;
            }
        }
        if (k <= j) {
            hi = j;
        } else if (k >= i) {
            lo = i;
        } else {
            break;
        }
    }
    return value[k];
}

// How far a body reaches along an axis: its outermost particle, or the one at a quantile of them.
static double extent(struct mpm_sim *sim, const struct mpm_probe_def *q) {
    double far = q->max_side ? -INFINITY : INFINITY;
    size_t n = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; (q->body < 0 || q->body == (int)b) && p < s->n; p++) {
            const double x = s->x[mpm_at(p, s->dim, q->axis)];
            far = q->max_side ? fmax(far, x) : fmin(far, x);
            if (q->quantile < 1) {
                sim->scratch[n++] = x;
            }
        }
    }
    if (q->quantile < 1 && n > 0) {
        const size_t rank = (size_t)ceil(q->quantile * (double)n) - 1;
        far = ranked(sim->scratch, n, q->max_side ? rank : n - 1 - rank);
    }
    return far;
}

// A field of the particle that the probe follows.
static void particle_field(const struct mpm_sim *sim, size_t probe, enum mpm_field field,
                           double *out) {
    const struct mpm_particles *s = &sim->sets[sim->probe_set[probe]];
    mpm_particle_field(s, mpm_place_of(s, sim->probe_particle[probe]), field, out);
}

static void present_value(struct mpm_sim *sim, size_t probe, double *out) {
    const struct mpm_probe_def *q = &sim->def->probes[probe];
    struct mpm_balance balance;
    if (mpm_probe_reads(q, MPM_FIELD_MEAN_STRESS_SMOOTH)) {
        mpm_smooth_update(sim);
    }
    switch (q->kind) {
    case MPM_PROBE_EXTENT:
        out[0] = extent(sim, q);
        break;
    case MPM_PROBE_DISPLACEMENT:
        if (q->has_box || q->has_select) {
            fold_field(sim, probe, out);
            break;
        }
        particle_field(sim, probe, MPM_FIELD_DISPLACEMENT, out);
        break;
    case MPM_PROBE_FIELD:
        particle_field(sim, probe, (enum mpm_field)q->field, out);
        break;
    case MPM_PROBE_REACTION:
        memcpy(out, q->wall >= 0 ? sim->walls[q->wall].reaction : sim->rigids[q->rigid].reaction,
               (size_t)sim->grid.dim * sizeof *out);
        break;
    case MPM_PROBE_MAXIMUM:
    case MPM_PROBE_MINIMUM:
    case MPM_PROBE_MEAN:
        fold_field(sim, probe, out);
        break;
    case MPM_PROBE_ERROR:
        out[0] = mpm_compare_error(&sim->compares[probe], sim, q);
        break;
    case MPM_PROBE_ENERGY:
        mpm_balance(sim, &balance);
        out[0] = balance.kinetic_energy;
        out[1] = balance.strain_energy;
        out[2] = balance.potential_energy;
        out[3] = out[0] + out[1] + out[2];
        break;
    case MPM_PROBE_MOMENTUM:
        mpm_balance(sim, &balance);
        memcpy(out, balance.momentum, (size_t)sim->grid.dim * sizeof *out);
        break;
    case MPM_PROBE_DRIFT:
        out[0] = 0;
        for (size_t b = 0; b < sim->n_sets; b++) {
            if (q->body < 0 || q->body == (int)b) {
                out[0] = fmax(out[0], mpm_fbar_drift(&sim->sets[b]));
            }
        }
        break;
    case MPM_N_PROBE_KINDS:
        break;
    }
    for (size_t c = 0; c < mpm_probe_components(sim, probe); c++) {
        out[c] *= q->scale;
    }
}

// The mean over the window is (integral now - integral then) / window; "then" is interpolated
// between the points kept. Before a whole window has passed, it is the mean since the start.
static void moving_mean(const struct mpm_average *a, double now, double window, size_t n_components,
                        double *out) {
    const double begin = now - window;
    const size_t oldest = a->n <= MPM_AVERAGE_SLOTS ? 0 : a->next;
    double then = a->time[oldest], from[MPM_MAX_COMPONENTS];
    memcpy(from, a->at[oldest], sizeof from);
    for (size_t k = 0; k + 1 < a->n; k++) {
        const size_t i = (oldest + k) % (MPM_AVERAGE_SLOTS + 1),
                     j = (i + 1) % (MPM_AVERAGE_SLOTS + 1);
        if (a->time[i] <= begin && begin <= a->time[j]) {
            const double part = (begin - a->time[i]) / (a->time[j] - a->time[i]);
            then = begin;
            for (size_t c = 0; c < n_components; c++) {
                from[c] = a->at[i][c] + part * (a->at[j][c] - a->at[i][c]);
            }
        }
    }
    for (size_t c = 0; c < n_components; c++) {
        out[c] = (a->integral[c] - from[c]) / (now - then);
    }
}

void mpm_probes_after_step(struct mpm_sim *sim, double dt) {
    for (size_t k = 0; sim->averages && k < sim->def->n_probes; k++) {
        const double window = sim->def->probes[k].average;
        struct mpm_average *a = &sim->averages[k];
        if (window <= 0) {
            continue;
        }
        if (a->n == 0) { // the integral's zero
            a->time[0] = sim->c.time - dt;
            a->n = a->next = 1;
        }
        double value[MPM_MAX_COMPONENTS];
        present_value(sim, k, value);
        for (size_t c = 0; c < mpm_probe_components(sim, k); c++) {
            a->integral[c] += dt * value[c];
        }
        const size_t last = (a->next + MPM_AVERAGE_SLOTS) % (MPM_AVERAGE_SLOTS + 1);
        if (sim->c.time - a->time[last] >= window / (MPM_AVERAGE_SLOTS - 1)) {
            a->time[a->next] = sim->c.time;
            memcpy(a->at[a->next], a->integral, sizeof a->integral);
            a->next = (a->next + 1) % (MPM_AVERAGE_SLOTS + 1);
            a->n = a->n <= MPM_AVERAGE_SLOTS ? a->n + 1 : a->n;
        }
    }
}

void mpm_probe_value(struct mpm_sim *sim, size_t probe, double *out) {
    const double window = sim->def->probes[probe].average;
    if (window > 0 && sim->averages[probe].n > 0) {
        moving_mean(&sim->averages[probe], sim->c.time, window, mpm_probe_components(sim, probe),
                    out);
    } else {
        present_value(sim, probe, out);
    }
}

double mpm_kinetic_energy(const struct mpm_sim *sim) {
    double sum = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            double v2 = 0;
            for (int d = 0; d < s->dim; d++) {
                const double v = s->v[mpm_at(p, s->dim, d)];
                v2 += v * v;
            }
            sum += 0.5 * s->density * s->V0[p] * v2;
        }
    }
    return sum;
}

double mpm_drift(const struct mpm_sim *sim) {
    double largest = 0;
    for (size_t b = 0; b < sim->n_sets; b++) {
        largest = fmax(largest, mpm_fbar_drift(&sim->sets[b]));
    }
    return largest;
}

void mpm_balance(const struct mpm_sim *sim, struct mpm_balance *out) {
    *out = (struct mpm_balance){.kinetic_energy = mpm_kinetic_energy(sim),
                                .external_work = sim->c.external_work};
    double gravity[MPM_MAX_DIM];
    mpm_gravity_at(sim, sim->c.time, gravity);
    for (size_t b = 0; b < sim->n_sets; b++) {
        const struct mpm_particles *s = &sim->sets[b];
        for (size_t p = 0; p < s->n; p++) {
            const double m = s->density * s->V0[p];
            double x[MPM_MAX_DIM] = {0}, mv[MPM_MAX_DIM] = {0};
            for (int d = 0; d < s->dim; d++) {
                x[d] = s->x[mpm_at(p, s->dim, d)];
                mv[d] = m * s->v[mpm_at(p, s->dim, d)];
                out->momentum[d] += mv[d];
                out->potential_energy -= m * gravity[d] * x[d];
            }
            out->mass += m;
            out->angular_momentum[0] += x[1] * mv[2] - x[2] * mv[1];
            out->angular_momentum[1] += x[2] * mv[0] - x[0] * mv[2];
            out->angular_momentum[2] += x[0] * mv[1] - x[1] * mv[0];
            out->strain_energy += s->V0[p] * s->material->energy(s, p);
        }
    }
}
