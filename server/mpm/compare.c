// Errors of a field. Sums run in the order of storage over the particles that the probe reads; what
// is kept of a particle is kept by its id.
#include "server/mpm/compare.h"

#include <stdlib.h>
#include <string.h>

#include "server/mpm/seed.h"
#include "server/mpm/sim.h"
#include "server/mpm/table.h"

size_t mpm_compare_width(const struct mpm_probe_def *q, int dim) {
    return q->component >= 0 ? 1 : mpm_field_components((enum mpm_field)q->field, dim);
}

// What a solution says of a field, by component.
static void field_of(const struct mpm_exact_state *at, const double *X, enum mpm_field field,
                     int dim, double *out) {
    switch (field) {
    case MPM_FIELD_POSITION:
        for (int d = 0; d < dim; d++) {
            out[d] = X[d] + at->u[d];
        }
        break;
    case MPM_FIELD_DISPLACEMENT:
        memcpy(out, at->u, (size_t)dim * sizeof *out);
        break;
    case MPM_FIELD_VELOCITY:
        memcpy(out, at->v, (size_t)dim * sizeof *out);
        break;
    case MPM_FIELD_STRESS:
        for (int i = 0; i < dim; i++) {
            for (int j = 0; j < dim; j++) {
                out[i * dim + j] = at->sigma[3 * i + j];
            }
        }
        break;
    default:
        out[0] = (at->sigma[0] + at->sigma[4] + at->sigma[8]) / 3;
    }
}

static void pick(const struct mpm_probe_def *q, size_t width, double *value) {
    if (q->component >= 0) {
        value[0] = value[q->component];
        (void)width;
    }
}

// Calls `each` for every particle of the probe's body, in the order of storage.
#define FOR_PARTICLES(sim, q, s, p)                                                                \
    for (size_t b_ = 0; b_ < (sim)->n_sets; b_++)                                                  \
        for (const struct mpm_particles *s = &(sim)->sets[b_]; s; s = NULL)                        \
            for (size_t p = 0; ((q)->body < 0 || (q)->body == (int)b_) && p < s->n; p++)

static bool choose(struct mpm_compare *c, const struct mpm_sim *sim,
                   const struct mpm_probe_def *q) {
    c->chosen = calloc(sim->n_particles + 1, sizeof *c->chosen);
    if (!c->chosen) {
        return false;
    }
    struct mpm_load picked = {0};
    if (q->has_select) {
        const struct mpm_particles *s = &sim->sets[q->body];
        if (!mpm_load_create(&picked, &q->select, s)) {
            return false;
        }
        for (size_t k = 0; k < picked.n; k++) {
            c->chosen[s->first_id + picked.particle[k]] = 1;
        }
        mpm_load_free(&picked);
    }
    struct mpm_region *region =
        q->has_exclude
            ? mpm_region_create(&q->exclude, sim->grid.dim, MPM_COMPARE_EDGE * sim->def->cell)
            : NULL;
    if (q->has_exclude && !region) {
        return false;
    }
    FOR_PARTICLES(sim, q, s, p) {
        double x[MPM_MAX_DIM] = {0};
        bool in = !q->has_select || c->chosen[mpm_particle_id(s, p)];
        for (int d = 0; d < s->dim; d++) {
            x[d] = s->x[mpm_at(p, s->dim, d)];
            in &= !q->has_box || (x[d] >= q->box_min[d] && x[d] <= q->box_max[d]);
        }
        c->chosen[mpm_particle_id(s, p)] = in && !(region && mpm_region_contains(region, x));
    }
    mpm_region_free(region);
    return true;
}

static bool read_table(struct mpm_compare *c, const struct mpm_sim *sim,
                       const struct mpm_probe_def *q) {
    const size_t width = mpm_compare_width(q, sim->grid.dim);
    struct mpm_table table;
    if (!mpm_table_create(&table, &q->against, width)) {
        return false;
    }
    FOR_PARTICLES(sim, q, s, p) {
        double X[MPM_MAX_DIM] = {0}, *out = c->reference + mpm_particle_id(s, p) * width;
        for (int d = 0; d < s->dim; d++) {
            X[d] = s->x[mpm_at(p, s->dim, d)];
        }
        if (c->chosen[mpm_particle_id(s, p)] && !mpm_table_at(&table, X, out)) {
            c->chosen[mpm_particle_id(s, p)] = 0;
        }
    }
    mpm_table_free(&table);
    return true;
}

static void solve_once(struct mpm_compare *c, const struct mpm_sim *sim,
                       const struct mpm_probe_def *q) {
    const size_t width = mpm_compare_width(q, sim->grid.dim);
    FOR_PARTICLES(sim, q, s, p) {
        double X[MPM_MAX_DIM] = {0}, value[MPM_MAX_COMPONENTS];
        struct mpm_exact_state at;
        for (int d = 0; d < s->dim; d++) {
            X[d] = s->x[mpm_at(p, s->dim, d)];
        }
        if (!c->chosen[mpm_particle_id(s, p)]) {
            continue;
        }
        mpm_exact_state(&c->exact, X, X, 0, s->dim, &at);
        field_of(&at, X, (enum mpm_field)q->field, s->dim, value);
        pick(q, width, value);
        memcpy(c->reference + mpm_particle_id(s, p) * width, value, width * sizeof *value);
    }
}

static bool keeps_reference(const struct mpm_probe_def *q) {
    return q->kind == MPM_PROBE_ERROR &&
           (q->against.is_table || mpm_solution_is_static(q->against.solution.kind));
}

bool mpm_compare_create(struct mpm_compare *c, const struct mpm_sim *sim,
                        const struct mpm_probe_def *q) {
    *c = (struct mpm_compare){0};
    const bool is_error = q->kind == MPM_PROBE_ERROR;
    if (!is_error && !q->has_select) {
        return true;
    }
    if (!choose(c, sim, q)) {
        return false;
    }
    if (!is_error) {
        return true;
    }
    if (keeps_reference(q)) {
        c->reference = calloc(sim->n_particles * mpm_compare_width(q, sim->grid.dim) + 1,
                              sizeof *c->reference);
        if (!c->reference) {
            return false;
        }
    }
    if (q->against.is_table) {
        return read_table(c, sim, q);
    }
    const struct mpm_def *def = sim->def;
    const struct mpm_medium medium = mpm_probe_medium(def, q);
    if (mpm_exact_create(&c->exact, &q->against.solution, &medium)) {
        return false;
    }
    if (c->reference) {
        solve_once(c, sim, q);
    }
    return true;
}

void mpm_compare_free(struct mpm_compare *c) {
    free(c->chosen);
    free(c->reference);
    mpm_exact_free(&c->exact);
    *c = (struct mpm_compare){0};
}

size_t mpm_compare_bytes(const struct mpm_probe_def *q, int dim, size_t n) {
    return (q->kind == MPM_PROBE_ERROR || q->has_select ? n : 0) +
           (keeps_reference(q) ? n * mpm_compare_width(q, dim) * sizeof(double) : 0);
}

// Sums of a field's error and of its reference, by component.
struct sums {
    double n, error2, reference2, largest_error, largest, mean[MPM_MAX_COMPONENTS];
};

static double norm_of(enum mpm_norm norm, const struct sums *s, size_t width) {
    double mean2 = 0;
    if (s->n == 0) {
        return NAN;
    }
    for (size_t c = 0; c < width; c++) {
        mean2 += s->mean[c] / s->n * (s->mean[c] / s->n);
    }
    const double error = sqrt(s->error2 / s->n), size2 = s->reference2 / s->n;
    // What is left of a constant field by round-off is no variation.
    const double variance = size2 - mean2 > 1e-12 * size2 ? size2 - mean2 : 0;
    const double over = norm == MPM_NORM_RMS   ? sqrt(variance)
                        : norm == MPM_NORM_L2  ? sqrt(size2)
                        : norm == MPM_NORM_MAX ? s->largest
                                               : 1;
    return over > 0 ? (norm == MPM_NORM_MAX ? s->largest_error : error) / over : NAN;
}

double mpm_compare_error(struct mpm_compare *c, const struct mpm_sim *sim,
                         const struct mpm_probe_def *q) {
    const size_t width = mpm_compare_width(q, sim->grid.dim);
    const double t = sim->c.time;
    struct sums sums = {0};
    if (!c->reference) {
        mpm_exact_move(&c->exact, t);
    }
    FOR_PARTICLES(sim, q, s, p) {
        const size_t id = mpm_particle_id(s, p);
        double value[MPM_MAX_COMPONENTS], exact[MPM_MAX_COMPONENTS], error2 = 0, size2 = 0;
        if (!c->chosen[id]) {
            continue;
        }
        mpm_particle_field(s, p, (enum mpm_field)q->field, value);
        pick(q, width, value);
        if (c->reference) {
            memcpy(exact, c->reference + id * width, width * sizeof *exact);
        } else {
            double X[MPM_MAX_DIM] = {0}, x[MPM_MAX_DIM] = {0};
            struct mpm_exact_state at;
            for (int d = 0; d < s->dim; d++) {
                X[d] = s->x0[mpm_at(p, s->dim, d)];
                x[d] = s->x[mpm_at(p, s->dim, d)];
            }
            mpm_exact_state(&c->exact, X, x, t, s->dim, &at);
            field_of(&at, X, (enum mpm_field)q->field, s->dim, exact);
            pick(q, width, exact);
        }
        for (size_t k = 0; k < width; k++) {
            const double e = value[k] - exact[k];
            error2 += e * e;
            size2 += exact[k] * exact[k];
            sums.mean[k] += exact[k];
        }
        sums.n++;
        sums.error2 += error2;
        sums.reference2 += size2;
        sums.largest_error = fmax(sums.largest_error, sqrt(error2));
        sums.largest = fmax(sums.largest, sqrt(size2));
    }
    return norm_of(q->norm, &sums, width);
}
