// What can be wrong with probes, with the solutions and tables that they are held against, and with
// the body force.
#include <stddef.h>

#include "server/mpm/check_inside.h"
#include "server/mpm/compare.h"
#include "server/mpm/seed.h"
#include "server/mpm/sim.h"
#include "server/mpm/table.h"

// Of a solution's own numbers; `pointer` is its place.
void mpm_check_solution(struct report *r, const struct mpm_solution *q, const char *pointer) {
    static const struct {
        const char *key;
        size_t offset;
        unsigned kinds; // that use it
    } positive[] = {
#define RING                                                                                       \
    (1U << MPM_SOLUTION_LAME | 1U << MPM_SOLUTION_CYLINDER | 1U << MPM_SOLUTION_TUBE |             \
     1U << MPM_SOLUTION_VORTEX)
        {"inner", offsetof(struct mpm_solution, inner), RING},
        {"outer", offsetof(struct mpm_solution, outer), RING},
        {"period", offsetof(struct mpm_solution, period), 1U << MPM_SOLUTION_VORTEX},
        {"length", offsetof(struct mpm_solution, length),
         1U << MPM_SOLUTION_MODE | 1U << MPM_SOLUTION_COLUMN},
        {"depth", offsetof(struct mpm_solution, length), 1U << MPM_SOLUTION_RITTER},
        {"wavelength", offsetof(struct mpm_solution, length), 1U << MPM_SOLUTION_TAYLOR_GREEN},
    };
    for (size_t k = 0; k < sizeof positive / sizeof *positive; k++) {
        const double value = *(const double *)((const char *)q + positive[k].offset);
        if ((positive[k].kinds & 1U << q->kind) && !(value > 0 && is_finite(value))) {
            FAULT(r, MPM_ERR_RANGE, TEXT("%s/%s", pointer, positive[k].key), "above 0",
                  TEXT("%.9g", value), "%s must be above 0, got %.9g", positive[k].key, value);
        }
    }
    if ((RING & 1U << q->kind) && q->inner > 0 && !(q->outer > q->inner)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("%s/outer", pointer), TEXT("above %.9g m (inner)", q->inner),
              TEXT("%.9g", q->outer), "the outer radius must be above the inner one");
    }
}

// That the solution tells the field, of this body and material, and exists.
static void check_against(struct report *r, const struct mpm_def *def,
                          const struct mpm_probe_def *q) {
    const struct mpm_solution *s = &q->against.solution;
    const char *pointer = TEXT("/probes/%s/against/%s", q->name, mpm_solution_name(s->kind));
    const char *field = mpm_field_info((enum mpm_field)q->field)->name;
    const size_t before = r->count;
    mpm_check_solution(r, s, pointer);
    if (!mpm_solution_tells(s->kind, (enum mpm_field)q->field)) {
        FAULT(r, MPM_ERR_CONFLICT, TEXT("/probes/%s/field", q->name),
              TEXT("a field that %s tells", mpm_solution_name(s->kind)), field,
              "the solution '%s' does not tell the %s", mpm_solution_name(s->kind), field);
    }
    if (def->n_bodies == 0 || r->count != before) {
        return;
    }
    if (q->body < 0 && def->n_bodies > 1) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/probes/%s/body", q->name), "a body", "none",
              "a solution is that of one body; the scene has several, so probe '%s' must name it",
              q->name);
        return;
    }
    const struct mpm_medium medium = mpm_probe_medium(def, q);
    if (!mpm_solution_holds(s->kind, &medium)) {
        FAULT(r, MPM_ERR_CONFLICT, pointer, "a body of the material that it is for",
              def->bodies[q->body < 0 ? 0 : q->body].name,
              "the solution '%s' does not hold for the material of this body",
              mpm_solution_name(s->kind));
        return;
    }
    if (s->kind == MPM_SOLUTION_COLUMN && medium.is_fluid &&
        !(medium.bulk + medium.rho * medium.g[s->axis] * s->length > 0)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("%s/length", pointer), "a column that bears its weight",
              TEXT("%.9g", s->length), "a column of this fluid would collapse under its weight");
    }
    if (s->kind == MPM_SOLUTION_RITTER && !(medium.g[def->dimension - 1] < 0)) {
        FAULT(r, MPM_ERR_CONFLICT, pointer, "gravity down the last axis",
              TEXT("%.9g", medium.g[def->dimension - 1]), "the solution 'ritter' needs gravity");
        return;
    }
    struct mpm_exact e;
    if (mpm_exact_create(&e, s, &medium) == MPM_ERR_RANGE) {
        FAULT(r, MPM_ERR_RANGE, TEXT("%s/pressure", pointer), "a pressure that it can hold, Pa",
              TEXT("%.9g", s->pressure), "no cylinder of this material and size holds %.9g Pa",
              s->pressure);
    }
    mpm_exact_free(&e);
}

#define TABLE_LOOKS 200 // that reading a table takes as long as, where the point is in it
#define LINE_LOOKS 8    // and a line of it, where the point is far away

static bool is_in_table(void *context, const double *x) {
    double value[MPM_MAX_COMPONENTS];
    return mpm_table_at(context, x, value);
}

// The particles that the probe chooses from, but for those of a table.
static struct mpm_sieve sieve_of(const struct mpm_def *def, const struct mpm_probe_def *q) {
    struct mpm_sieve sieve = {.shape = q->has_exclude ? &q->exclude : NULL,
                              .margin = MPM_COMPARE_EDGE * def->cell};
    const bool selects = q->has_select && q->select.has_box;
    sieve.has_box = q->has_box || selects;
    for (int d = 0; d < def->dimension; d++) {
        sieve.min[d] = fmax(q->has_box ? q->box_min[d] : -INFINITY,
                            selects ? q->select.box_min[d] : -INFINITY);
        sieve.max[d] =
            fmin(q->has_box ? q->box_max[d] : INFINITY, selects ? q->select.box_max[d] : INFINITY);
    }
    return sieve;
}

// That the probe finds a particle to read where it chooses.
void mpm_check_probe_particles(struct report *r, const struct mpm_def *def,
                               const struct mpm_probe_def *q) {
    const struct mpm_sieve sieve = sieve_of(def, q);
    const bool reads = q->kind == MPM_PROBE_ERROR && q->against.is_table;
    const double looks_each = reads ? TABLE_LOOKS + LINE_LOOKS * (double)q->against.n : 0;
    struct mpm_table table = {0};
    bool found = false;
    if (q->kind != MPM_PROBE_ERROR && !q->has_select) {
        return;
    }
    if (reads && !mpm_table_create(&table, &q->against, mpm_compare_width(q, def->dimension))) {
        return; // memory: said when the simulation is made
    }
    for (size_t b = 0; b < def->n_bodies && !found; b++) {
        if (q->body < 0 || q->body == (int)b) {
            found = mpm_check_finds(r, def, &def->bodies[b], &sieve, looks_each,
                                    reads ? is_in_table : NULL, &table);
        }
    }
    mpm_table_free(&table);
    if (!found) {
        FAULT(r, MPM_ERR_EMPTY, TEXT("/probes/%s%s", q->name, q->has_select ? "/select" : ""),
              "at least one particle", "0", "probe '%s' reads no particle", q->name);
    }
}

void mpm_check_body_force(struct report *r, const struct mpm_def *def) {
    const struct mpm_body_force_def *f = &def->body_force;
    const char *name = mpm_solution_name(f->solution.kind);
    for (int d = 0; d < def->dimension && f->kind == MPM_BODY_FORCE_UNIFORM; d++) {
        if (!is_finite(f->vector[d])) {
            FAULT(r, MPM_ERR_RANGE, TEXT("/body_force/%d", d), "finite, m/s^2",
                  TEXT("%.9g", f->vector[d]), "the body force must be finite");
        }
    }
    if (f->kind != MPM_BODY_FORCE_SOLUTION) {
        return;
    }
    mpm_check_solution(r, &f->solution, TEXT("/body_force/%s", name));
    for (size_t b = 0; b < def->n_bodies; b++) {
        const struct mpm_material_def *m = &def->materials[def->bodies[b].material];
        const struct mpm_medium medium =
            mpm_medium_of(m->model, m->parameters, (double[MPM_MAX_DIM]){0});
        if (!mpm_solution_holds(f->solution.kind, &medium)) {
            FAULT(r, MPM_ERR_CONFLICT, TEXT("/body_force/%s", name),
                  "bodies of the material that it is for", def->bodies[b].name,
                  "the body force of '%s' does not hold for the material of body '%s'", name,
                  def->bodies[b].name);
        }
    }
}

void mpm_check_probe(struct report *r, const struct mpm_def *def, const struct mpm_probe_def *q) {
    if (q->body >= (int)def->n_bodies) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/probes/%s/body", q->name), "a body", TEXT("%d", q->body),
              "probe '%s' names no body", q->name);
    }
    if (q->kind == MPM_PROBE_REACTION &&
        (q->wall >= 0 ? (size_t)q->wall >= def->n_walls
                      : q->rigid < 0 || (size_t)q->rigid >= def->n_rigids)) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/probes/%s/wall", q->name), "a wall or rigid body",
              TEXT("%d", q->wall), "probe '%s' names no wall and no rigid body", q->name);
    }
    if (q->kind == MPM_PROBE_EXTENT && !(q->quantile > 0 && q->quantile <= 1)) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/probes/%s/quantile", q->name), "above 0 and at most 1",
              TEXT("%.9g", q->quantile), "the quantile of probe '%s' must be in (0, 1]", q->name);
    }
    if (q->has_select && q->body < 0) {
        FAULT(r, MPM_ERR_REFERENCE, TEXT("/probes/%s/body", q->name), "a body", "none",
              "probe '%s' selects particles of a body and must name it", q->name);
    }
    if (q->kind == MPM_PROBE_ERROR && !q->against.is_table) {
        check_against(r, def, q);
    }
    if (!(q->average >= 0 && is_finite(q->average))) {
        FAULT(r, MPM_ERR_RANGE, TEXT("/probes/%s/average", q->name), "at least 0, s",
              TEXT("%.9g", q->average), "the averaging window of probe '%s' must not be negative",
              q->name);
    }
}
