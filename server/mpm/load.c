// Loads: which particles they act on, and with what force.
//
// A pressure needs the area that each chosen particle stands for. The chosen ones are a layer one
// spacing thick, so on a flat side that is V0 / spacing. On a round one a lattice puts more
// particles in some directions than in others (by the square root of their number), so each stands
// for the angle half-way to its neighbours instead; no code here knows how much of a circle there
// is. As the surface widens, so does the area.
#include "server/mpm/load.h"

#include <stdlib.h>
#include <string.h>

#define GAP 3            // spacings between neighbours of a layer: a wider one is an end of it
#define LAYER (1 - 1e-6) // spacings: lattice neighbours one spacing further in are not of the layer

static double spacing_of(const struct mpm_particles *s, size_t p) {
    return s->dim == 2 ? sqrt(s->V0[p]) : cbrt(s->V0[p]);
}

// From the centre to a particle, across the axis in 3D; its length.
static double radius_of(const struct mpm_load_def *q, const struct mpm_particles *s, size_t p,
                        double *r) {
    double r2 = 0;
    for (int d = 0; d < s->dim; d++) {
        r[d] = s->dim == 3 && d == q->axis ? 0 : s->x[mpm_at(p, s->dim, d)] - q->centre[d];
        r2 += r[d] * r[d];
    }
    return sqrt(r2);
}

// Coordinate that the extreme is taken of, larger meaning further out.
static double outwards(const struct mpm_load_def *q, const struct mpm_particles *s, size_t p) {
    double r[MPM_MAX_DIM];
    const double x = q->round ? radius_of(q, s, p, r) : s->x[mpm_at(p, s->dim, q->axis)];
    return q->max_side ? x : -x;
}

static bool chosen(const struct mpm_load_def *q, const struct mpm_particles *s, size_t p,
                   double extreme) {
    if (!q->has_box) {
        return outwards(q, s, p) > extreme - LAYER * spacing_of(s, p);
    }
    for (int d = 0; d < s->dim; d++) {
        const double x = s->x[mpm_at(p, s->dim, d)];
        if (!(x >= q->box_min[d] && x <= q->box_max[d])) {
            return false;
        }
    }
    return true;
}

struct place {
    double layer, angle, radius; // along the axis in spacings, about it, and from it
    size_t k;
};

static int by_layer_and_angle(const void *one, const void *other) {
    const struct place *a = one, *b = other;
    return a->layer != b->layer ? (a->layer > b->layer) - (a->layer < b->layer)
                                : (a->angle > b->angle) - (a->angle < b->angle);
}

// Angle from a particle half-way to its neighbour at the angle `to` (both in one layer).
static double half_way(const struct place *from, double to, double spacing) {
    const double gap = fabs(to - from->angle), most = GAP * spacing / from->radius;
    return gap < most ? gap / 2 : spacing / from->radius / 2;
}

// Areas of a round side, per metre of radius. False when memory is short.
static bool round_areas(struct mpm_load *load, const struct mpm_particles *s) {
    const struct mpm_load_def *q = &load->def;
    const int u = s->dim == 2 ? 0 : (q->axis + 1) % 3, v = s->dim == 2 ? 1 : (q->axis + 2) % 3;
    struct place *at = calloc(load->n + 1, sizeof *at);
    if (!at) {
        return false;
    }
    for (size_t k = 0; k < load->n; k++) {
        const size_t p = load->particle[k];
        double r[MPM_MAX_DIM], along = 0;
        if (s->dim == 3) {
            const double *x = s->x;
            along = x[mpm_at(p, 3, q->axis)] - x[mpm_at(load->particle[0], 3, q->axis)];
        }
        at[k].radius = radius_of(q, s, p, r);
        at[k].angle = atan2(r[v], r[u]);
        at[k].layer = round(along / spacing_of(s, p));
        at[k].k = k;
    }
    qsort(at, load->n, sizeof *at, by_layer_and_angle);
    double sum = 0, sum_radius = 0;
    for (size_t i = 0, end = 0; i < load->n; i = end) {
        for (end = i; end < load->n && at[end].layer == at[i].layer; end++) {
        }
        for (size_t j = i; j < end; j++) {
            const double spacing = spacing_of(s, load->particle[at[j].k]);
            const double before = j > i ? at[j - 1].angle : at[end - 1].angle - 2 * M_PI;
            const double after = j + 1 < end ? at[j + 1].angle : at[i].angle + 2 * M_PI;
            const double angle =
                half_way(&at[j], before, spacing) + half_way(&at[j], after, spacing);
            load->area[at[j].k] = angle * (s->dim == 3 ? spacing : 1) / at[j].radius;
            sum += angle;
            sum_radius += angle * (at[j].radius + (q->max_side ? 1 : -1) * spacing / 2);
        }
    }
    for (size_t k = 0; k < load->n; k++) { // the surface lies half a spacing beside the layer
        load->area[k] *= sum_radius / sum;
    }
    free(at);
    return true;
}

bool mpm_load_create(struct mpm_load *load, const struct mpm_load_def *def,
                     const struct mpm_particles *s) {
    *load = (struct mpm_load){.def = *def, .active = true};
    double extreme = -INFINITY;
    for (size_t p = 0; !def->has_box && p < s->n; p++) {
        extreme = fmax(extreme, outwards(def, s, p));
    }
    for (size_t p = 0; p < s->n; p++) {
        load->n += chosen(def, s, p, extreme);
    }
    const size_t dim = (size_t)s->dim;
    load->particle = calloc(load->n + 1, sizeof *load->particle);
    load->place = calloc(load->n + 1, sizeof *load->place);
    load->area = calloc(load->n + 1, sizeof *load->area);
    load->force = calloc(load->n * dim + 1, sizeof *load->force);
    load->x_before = calloc(load->n * dim + 1, sizeof *load->x_before);
    if (!load->particle || !load->place || !load->area || !load->force || !load->x_before) {
        mpm_load_free(load);
        return false;
    }
    size_t k = 0;
    for (size_t p = 0; p < s->n; p++) {
        if (chosen(def, s, p, extreme)) {
            load->area[k] = s->V0[p] / spacing_of(s, p);
            load->particle[k++] = (uint32_t)p;
        }
    }
    if (def->is_pressure && def->round && !round_areas(load, s)) {
        mpm_load_free(load);
        return false;
    }
    return true;
}

void mpm_load_free(struct mpm_load *load) {
    free(load->particle);
    free(load->place);
    free(load->area);
    free(load->force);
    free(load->x_before);
    *load = (struct mpm_load){0};
}

void mpm_load_update(struct mpm_load *load, const struct mpm_particles *s, double since_start) {
    const struct mpm_load_def *q = &load->def;
    const double part = q->ramp > 0 ? fmin(1, since_start / q->ramp) : 1;
    for (size_t k = 0; k < load->n; k++) {
        const size_t p = mpm_place_of(s, load->particle[k]), dim = (size_t)s->dim;
        load->place[k] = (uint32_t)p;
        double *f = load->force + k * dim, r[MPM_MAX_DIM] = {0};
        for (size_t d = 0; d < dim; d++) {
            load->x_before[k * dim + d] = s->x[mpm_at(p, s->dim, (int)d)];
            f[d] = part * q->force[d] / (double)load->n;
        }
        if (!q->is_pressure) {
            continue;
        }
        // Onto the body: against the outward direction of the side that was chosen.
        const double sign = q->max_side ? -1 : 1;
        double area = load->area[k];
        if (q->round) {
            const double radius = radius_of(q, s, p, r);
            area *= radius;
            for (size_t d = 0; d < dim; d++) {
                r[d] /= radius;
            }
        } else {
            r[q->axis] = 1;
        }
        for (size_t d = 0; d < dim; d++) {
            f[d] = part * sign * q->pressure * area * r[d];
        }
    }
}

double mpm_load_work(const struct mpm_load *load, const struct mpm_particles *s) {
    const size_t dim = (size_t)s->dim;
    double work = 0;
    for (size_t k = 0; k < load->n; k++) {
        for (size_t d = 0; d < dim; d++) {
            work += load->force[k * dim + d] *
                    (s->x[mpm_at(load->place[k], s->dim, (int)d)] - load->x_before[k * dim + d]);
        }
    }
    return work;
}
