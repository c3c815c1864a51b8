// Loads: which particles they act on, and with what force.
//
// A pressure needs the area that each chosen particle stands for. The chosen ones are a layer one
// spacing thick, so that is V0 / spacing; of a round surface, which lies half a spacing beside the
// layer's middle, times the ratio of the radii. No code here knows how much of a circle there is.
#include "server/mpm/load.h"

#include <stdlib.h>
#include <string.h>

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
    load->force = calloc(load->n * dim + 1, sizeof *load->force);
    load->x_before = calloc(load->n * dim + 1, sizeof *load->x_before);
    if (!load->particle || !load->force || !load->x_before) {
        mpm_load_free(load);
        return false;
    }
    size_t k = 0;
    for (size_t p = 0; p < s->n; p++) {
        if (chosen(def, s, p, extreme)) {
            load->particle[k++] = (uint32_t)p;
        }
    }
    return true;
}

void mpm_load_free(struct mpm_load *load) {
    free(load->particle);
    free(load->force);
    free(load->x_before);
    *load = (struct mpm_load){0};
}

void mpm_load_update(struct mpm_load *load, const struct mpm_particles *s, double since_start) {
    const struct mpm_load_def *q = &load->def;
    const double part = q->ramp > 0 ? fmin(1, since_start / q->ramp) : 1;
    for (size_t k = 0; k < load->n; k++) {
        const size_t p = load->particle[k], dim = (size_t)s->dim;
        double *f = load->force + k * dim, r[MPM_MAX_DIM] = {0};
        for (size_t d = 0; d < dim; d++) {
            load->x_before[k * dim + d] = s->x[mpm_at(p, s->dim, (int)d)];
            f[d] = part * q->force[d] / (double)load->n;
        }
        if (!q->is_pressure) {
            continue;
        }
        // Onto the body: against the outward direction of the side that was chosen.
        const double spacing = spacing_of(s, p), sign = q->max_side ? -1 : 1;
        double area = s->V0[p] / spacing;
        if (q->round) {
            const double radius = radius_of(q, s, p, r);
            area *= (radius - sign * spacing / 2) / radius;
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
                    (s->x[mpm_at(load->particle[k], s->dim, (int)d)] - load->x_before[k * dim + d]);
        }
    }
    return work;
}
