// Particle-grid transfers: the plain scalar kernels, written once for every dimension and basis.
//
// They follow docs/method.md equation by equation: the baseline that server/mpm/transfer_lanes.c is
// checked against, and what runs where its instruction sets are missing. Zhao, Jiang, Choo, eqs.
// 7-17; F-bar: their Algorithm 1, and docs/method.md section 4 for the anchored scheme.
#include "server/mpm/transfer.h"

#include <stdint.h>

#include "server/mpm/basis.h"
#include "server/mpm/fbar.h"
#include "server/mpm/kernels.h"

#define BATCH 64 // particles whose velocity gradient is kept for one call of a material's rate part

// The nodes that one particle reaches, row-major, and weights by direction.
struct stencil {
    uint32_t key, n_runs; // the cell whose nodes these are; how often it has changed
    uint32_t nodes[MPM_MAX_STENCIL];
    double w[MPM_MAX_DIM][MPM_MAX_SUPPORT], dw[MPM_MAX_DIM][MPM_MAX_SUPPORT];
};
#define NO_CELL UINT32_MAX // no key: the domain has fewer nodes

MPM_KERNEL void stencil_at(struct stencil *t, const struct mpm_span *span, size_t p, const int dim,
                           const enum mpm_basis basis) {
    const struct mpm_grid *g = span->grid;
    int base[MPM_MAX_DIM];
    for (int d = 0; d < dim; d++) {
        const double xi = (span->s->x[mpm_at(p, dim, d)] - g->origin[d]) * g->inv_h;
        base[d] =
            (int)mpm_weights(basis, xi, span->s->half, span->s->inv_4_half, t->w[d], t->dw[d]);
    }
    const uint32_t key = mpm_cell_key(g, base, dim);
    if (key != t->key) {
        mpm_grid_stencil(g, key, mpm_support(basis), dim, t->nodes);
        t->key = key;
        t->n_runs++;
    }
}

// The nodes of a stencil in rows along the last direction. FOR_ROWS runs its body for each row,
// with its nodes and the product of the weights (or, for direction e, of the gradient's factors,
// per cell) of the other directions. All bounds are constants.
#define FOR_ROWS(dim, basis)                                                                       \
    for (int a_ = 0; a_ < mpm_support(basis); a_++)                                                \
        for (int b_ = 0; b_ < ((dim) == 3 ? mpm_support(basis) : 1); b_++)
#define ROW_NODES(t, dim, basis)                                                                   \
    ((t).nodes + (((dim) == 3 ? a_ * mpm_support(basis) + b_ : a_) * mpm_support(basis)))
#define ROW_WEIGHT(t, dim) ((t).w[0][a_] * ((dim) == 3 ? (t).w[1][b_] : 1))
#define ROW_GRADIENT(t, dim, e)                                                                    \
    (((e) == 0 ? (t).dw[0][a_] : (t).w[0][a_]) * ((dim) == 2 ? 1                                   \
                                                  : (e) == 1 ? (t).dw[1][b_]                       \
                                                             : (t).w[1][b_]))

// eqs. 7, 8, 10. The internal force is -sum_p V sigma grad w.
MPM_KERNEL void p2g(const struct mpm_span *span, struct mpm_span_result *result, const int dim,
                    const enum mpm_basis basis) {
    const struct mpm_particles *s = span->s;
    const struct mpm_grid *g = span->grid;
    const int last = dim - 1;
    struct stencil t = {.key = NO_CELL};
    for (size_t p = span->begin; p < span->end; p++) {
        stencil_at(&t, span, p, dim, basis);
        const double m = s->density * s->V0[p];
        const double V_over_h = s->V[p] * g->inv_h, V_fbar = span->fbar ? s->V[p] : 0;
        double mv[3], V_sigma[6];
        for (int d = 0; d < dim; d++) {
            mv[d] = m * s->v[mpm_at(p, dim, d)];
        }
        for (int k = 0; k < MPM_SYM(dim); k++) {
            V_sigma[k] = V_over_h * s->sigma[mpm_at(p, MPM_SYM(dim), k)];
        }
        FOR_ROWS(dim, basis) {
            const uint32_t *row = ROW_NODES(t, dim, basis);
            const double w_row = ROW_WEIGHT(t, dim), m_row = w_row * m, V_row = w_row * V_fbar;
            double mv_row[3], f_w[3], f_dw[3]; // force = f_w w + f_dw dw along the row
            for (int d = 0; d < dim; d++) {
                mv_row[d] = w_row * mv[d];
                f_dw[d] = -V_sigma[mpm_sym_index(d, last)] * w_row;
                f_w[d] = 0;
                for (int e = 0; e < last; e++) {
                    f_w[d] -= V_sigma[mpm_sym_index(d, e)] * ROW_GRADIENT(t, dim, e);
                }
            }
            for (int c = 0; c < mpm_support(basis); c++) {
                double *node = g->node + (size_t)row[c] * MPM_NODE;
                const double w = t.w[last][c], dw = t.dw[last][c];
                node[0] += w * m_row;
                node[MPM_NODE_VOLUME(dim)] += w * V_row;
                for (int d = 0; d < dim; d++) {
                    node[1 + d] += w * mv_row[d];
                    node[MPM_NODE_FORCE + d] += w * f_w[d] + dw * f_dw[d];
                }
            }
        }
    }
    *result = mpm_nothing_found();
    result->n_runs = t.n_runs;
}

MPM_KERNEL void move_nodes(const struct mpm_grid *grid, uint32_t begin, uint32_t end,
                           const struct mpm_motion *by, const int dim) {
    const size_t nodes = MPM_BLOCK_NODES(dim);
    for (size_t i = begin * nodes; i < end * nodes; i++) {
        const double *node = grid->node + i * MPM_NODE, m = node[0];
        double *velocity = grid->velocity + i * MPM_VELOCITY(dim);
        const double r = m > 0 ? 1 / m : 0;
        for (int d = 0; d < dim; d++) {
            const double v = node[1 + d] * r;
            double f = node[MPM_NODE_FORCE + d] + m * by->gravity[d];
            if (by->local != 0 && v != 0) {
                f -= copysign(by->local * fabs(f), v);
            }
            f -= by->mass * node[1 + d];
            const double dv = by->dt * f * r;
            velocity[d] = v + dv;
            velocity[dim + d] = dv;
        }
    }
}

MPM_KERNEL void force(const struct mpm_span *span, const uint32_t *particle, const double *f,
                      size_t n, const int dim, const enum mpm_basis basis) {
    const struct mpm_grid *g = span->grid;
    struct stencil t = {.key = NO_CELL};
    for (size_t k = 0; k < n; k++) {
        stencil_at(&t, span, particle[k], dim, basis);
        FOR_ROWS(dim, basis) {
            const uint32_t *row = ROW_NODES(t, dim, basis);
            for (int c = 0; c < mpm_support(basis); c++) {
                const double w = ROW_WEIGHT(t, dim) * t.w[dim - 1][c];
                for (int d = 0; d < dim; d++) {
                    g->node[(size_t)row[c] * MPM_NODE + (size_t)(MPM_NODE_FORCE + d)] +=
                        w * f[k * (size_t)dim + (size_t)d];
                }
            }
        }
    }
}

static void fault(struct mpm_span_result *r, size_t p, enum mpm_status status, double value) {
    if (r->bad == SIZE_MAX) {
        r->bad = p;
        r->status = status;
        r->value = value;
    }
}

// Stress and position of particles whose deformation is final: eqs. 9 and 17. The position is
// checked by the step that joins the results: what it finds out of the domain or not finite fails
// the step.
MPM_KERNEL void finish(const struct mpm_span *span, size_t begin, size_t end,
                       struct mpm_span_result *r, double (*dx)[3], const int dim) {
    struct mpm_particles *s = span->s;
    s->material->stress[dim - 2](s, begin, end);
    for (size_t p = begin; p < end; p++) {
        const double m = s->density * s->V0[p];
        for (int d = 0; d < dim; d++) {
            double *x = &s->x[mpm_at(p, dim, d)];
            const double step = dx ? dx[p - begin][d] : s->dx[mpm_at(p, dim, d)];
            *x += step;
            r->mass_dx[d] += m * step;
            r->dx_max = fabs(step) > r->dx_max ? fabs(step) : r->dx_max;
            r->min[d] = *x < r->min[d] ? *x : r->min[d];
            r->max[d] = *x > r->max[d] ? *x : r->max[d];
            if (!(fabs(*x) < INFINITY)) {
                fault(r, p, MPM_ERR_NOT_FINITE, *x);
            }
        }
    }
}

// eq. 14 with dF = 1 + D, on what the material keeps.
MPM_KERNEL void deform(struct mpm_particles *s, size_t p, const double *D, double dJ_minus_one,
                       const int dim, const enum mpm_kinematics kinematics) {
    if (kinematics == MPM_KEEPS_J) {
        s->Jbar[p] += s->Jbar[p] * dJ_minus_one;
        if (s->J_raw) {
            s->J_raw[p] += s->J_raw[p] * dJ_minus_one;
        }
        return;
    }
    double A[9], DA[9]; // F, or b in full
    for (int i = 0; i < dim; i++) {
        for (int j = 0; j < dim; j++) {
            A[i * dim + j] = kinematics == MPM_KEEPS_F
                                 ? s->F[mpm_at(p, dim * dim, i * dim + j)]
                                 : s->b[mpm_at(p, MPM_SYM(dim), mpm_sym_index(i, j))];
        }
    }
    for (int i = 0; i < dim; i++) {
        for (int j = 0; j < dim; j++) {
            DA[i * dim + j] = 0;
            for (int k = 0; k < dim; k++) {
                DA[i * dim + j] += D[i * dim + k] * A[k * dim + j];
            }
        }
    }
    if (kinematics == MPM_KEEPS_F) {
        for (int k = 0; k < dim * dim; k++) {
            s->F[mpm_at(p, dim * dim, k)] = A[k] + DA[k];
        }
        return;
    }
    for (int i = 0; i < dim; i++) { // dF b dF^T = b + D b + (D b)^T + D b D^T
        for (int j = i; j < dim; j++) {
            double change = DA[i * dim + j] + DA[j * dim + i];
            for (int k = 0; k < dim; k++) {
                change += DA[i * dim + k] * D[j * dim + k];
            }
            s->b[mpm_at(p, MPM_SYM(dim), mpm_sym_index(i, j))] += change;
        }
    }
}

// mpm_ratio_in_use with its choices made.
MPM_KERNEL double ratio_in_use(const struct mpm_particles *s, size_t p, const int dim,
                               const enum mpm_kinematics kinematics) {
    double A[9];
    switch (kinematics) {
    case MPM_KEEPS_J:
        return s->Jbar[p];
    case MPM_KEEPS_B:
        for (int k = 0; k < MPM_SYM(dim); k++) {
            A[k] = s->b[mpm_at(p, MPM_SYM(dim), k)];
        }
        return sqrt(mpm_det_sym(A, dim));
    default:
        for (int k = 0; k < dim * dim; k++) {
            A[k] = s->F[mpm_at(p, dim * dim, k)];
        }
        return mpm_det(A, dim);
    }
}

MPM_KERNEL void g2p(const struct mpm_span *span, struct mpm_span_result *result, const int dim,
                    const enum mpm_basis basis, const enum mpm_kinematics kinematics) {
    struct mpm_particles *s = span->s;
    const struct mpm_grid *g = span->grid;
    const int last = dim - 1;
    const bool fbar = span->fbar;
    struct mpm_span_result r = mpm_nothing_found();
    struct stencil t = {.key = NO_CELL};
    double L[BATCH][9], dx[BATCH][3];
    for (size_t begin = span->begin; begin < span->end; begin += BATCH) {
        const size_t end = begin + BATCH < span->end ? begin + BATCH : span->end;
        for (size_t p = begin; p < end; p++) {
            stencil_at(&t, span, p, dim, basis);
            double v_pic[3] = {0}, dv[3] = {0}, *l = L[p - begin];
            for (int k = 0; k < dim * dim; k++) {
                l[k] = 0;
            }
            FOR_ROWS(dim, basis) {
                const uint32_t *row = ROW_NODES(t, dim, basis);
                const double w_row = ROW_WEIGHT(t, dim);
                double v_w[3] = {0}, v_dw[3] = {0}, dv_w[3] = {0}; // sums along the row
                for (int c = 0; c < mpm_support(basis); c++) {
                    const double *v = g->velocity + (size_t)row[c] * MPM_VELOCITY(dim);
                    for (int d = 0; d < dim; d++) {
                        v_w[d] += t.w[last][c] * v[d];
                        v_dw[d] += t.dw[last][c] * v[d];
                        dv_w[d] += t.w[last][c] * v[dim + d];
                    }
                }
                for (int d = 0; d < dim; d++) {
                    v_pic[d] += w_row * v_w[d];
                    dv[d] += w_row * dv_w[d];
                    l[d * dim + last] += w_row * v_dw[d];
                    for (int e = 0; e < last; e++) {
                        l[d * dim + e] += ROW_GRADIENT(t, dim, e) * v_w[d];
                    }
                }
            }
            double v2 = 0;
            for (int d = 0; d < dim; d++) { // eqs. 11-13
                double *v = &s->v[mpm_at(p, dim, d)];
                *v = span->blend * (*v + dv[d]) + (1 - span->blend) * v_pic[d];
                v2 += *v * *v;
                dx[p - begin][d] = span->dt * v_pic[d];
            }
            if (!(v2 < INFINITY)) {
                fault(&r, p, MPM_ERR_NOT_FINITE, v2);
            }
            r.v2_max = v2 > r.v2_max ? v2 : r.v2_max;
            double D[9]; // the relative deformation gradient less 1
            for (int k = 0; k < dim * dim; k++) {
                l[k] *= g->inv_h;
                D[k] = span->dt * l[k];
            }
            const double dJ_minus_one = mpm_det_minus_one(D, dim);
            deform(s, p, D, dJ_minus_one, dim, kinematics);
            const double ratio = ratio_in_use(s, p, dim, kinematics);
            if (fbar) {
                s->dJ[p] = 1 + dJ_minus_one;
                if (kinematics == MPM_KEEPS_B && !(s->dJ[p] > 0)) { // sqrt(det b) would not tell
                    fault(&r, p, MPM_ERR_VOLUME, s->dJ[p] * s->V[p] / s->V0[p]);
                }
                for (int d = 0; d < dim; d++) {
                    s->dx[mpm_at(p, dim, d)] = dx[p - begin][d];
                }
            } else {
                s->V[p] += s->V[p] * dJ_minus_one; // eq. 15
                if (!(ratio > 0 && s->V[p] > 0)) {
                    fault(&r, p, MPM_ERR_VOLUME, ratio > 0 ? s->V[p] / s->V0[p] : ratio);
                }
            }
        }
        if (s->material->rate_stress[dim - 2]) {
            s->material->rate_stress[dim - 2](s, begin, end, L);
        }
        if (!fbar) {
            finish(span, begin, end, &r, dx, dim);
        }
    }
    *result = r;
}

// Algorithm 1, step 3, with the weights and the volume of time n. The trial ratio Jbar^n dJ is
// already the ratio in use: g2p has applied the plain increment to the deformation.
MPM_KERNEL void fbar_scatter(const struct mpm_span *span, const int dim, const enum mpm_basis basis,
                             const enum mpm_fbar_scheme scheme) {
    const struct mpm_particles *s = span->s;
    const struct mpm_grid *g = span->grid;
    const size_t stride = scheme == MPM_FBAR_ANCHORED ? 2 : 1;
    struct stencil t = {.key = NO_CELL};
    for (size_t p = span->begin; p < span->end; p++) {
        stencil_at(&t, span, p, dim, basis);
        const double V = s->V[p], trial = mpm_ratio_in_use(s, p);
        double a = V * trial, b = 0;
        if (scheme == MPM_FBAR_ANCHORED) {
            a = V * s->dJ[p];
            b = (1 - span->a) * V * trial + span->a * a * (V / s->V0[p]);
        }
        FOR_ROWS(dim, basis) {
            const uint32_t *row = ROW_NODES(t, dim, basis);
            const double w_row = ROW_WEIGHT(t, dim);
            for (int c = 0; c < mpm_support(basis); c++) {
                double *node = g->fbar + row[c] * stride;
                const double w = w_row * t.w[dim - 1][c];
                node[0] += w * a;
                if (scheme == MPM_FBAR_ANCHORED) {
                    node[1] += w * b;
                }
            }
        }
    }
}

MPM_KERNEL void fbar_finish(const struct mpm_span *span, struct mpm_span_result *result,
                            const int dim, const enum mpm_basis basis,
                            const enum mpm_fbar_scheme scheme) {
    struct mpm_particles *s = span->s;
    const struct mpm_grid *g = span->grid;
    const size_t stride = scheme == MPM_FBAR_ANCHORED ? 2 : 1;
    struct mpm_span_result r = mpm_nothing_found();
    struct stencil t = {.key = NO_CELL};
    for (size_t p = span->begin; p < span->end; p++) {
        stencil_at(&t, span, p, dim, basis);
        double A = 0, B = 0;
        FOR_ROWS(dim, basis) {
            const uint32_t *row = ROW_NODES(t, dim, basis);
            double A_row = 0, B_row = 0;
            for (int c = 0; c < mpm_support(basis); c++) {
                const double *node = g->fbar + row[c] * stride;
                A_row += t.w[dim - 1][c] * node[0];
                if (scheme == MPM_FBAR_ANCHORED) {
                    B_row += t.w[dim - 1][c] * node[1];
                }
            }
            A += ROW_WEIGHT(t, dim) * A_row;
            B += ROW_WEIGHT(t, dim) * B_row;
        }
        const double trial = mpm_ratio_in_use(s, p);
        if (scheme == MPM_FBAR_ANCHORED) { // what is not averaged resists motion within a cell
            A = (1 - span->keep) * A + span->keep * s->dJ[p];
            B = (1 - span->keep) * B + span->keep * A * (s->V[p] / s->V0[p]);
        }
        const double ratio = scheme == MPM_FBAR_ANCHORED ? B : A;
        if (!(trial > 0 && ratio > 0)) {
            fault(&r, p, MPM_ERR_VOLUME, trial > 0 ? ratio : trial);
        }
        if (scheme == MPM_FBAR_ANCHORED) {
            double dx2 = 0;
            for (int d = 0; d < dim; d++) {
                const double dx = s->dx[mpm_at(p, dim, d)];
                dx2 += dx * dx;
            }
            const double reach = span->C * sqrt(dx2) * g->inv_h, beta = reach < 1 ? reach : 1;
            s->V[p] = (1 - beta) * s->V[p] * A + beta * s->V0[p] * ratio;
        } else if (s->Jbar) {
            s->V[p] *= s->dJ[p] * ratio / trial; // a fluid's volume follows Jbar
        } else {
            s->V[p] *= s->dJ[p]; // eq. 15: forces use the unaveraged volume
        }
        if (!(s->V[p] > 0)) {
            fault(&r, p, MPM_ERR_VOLUME, s->V[p] / s->V0[p]);
        }
        if (s->Jbar) {
            s->Jbar[p] = ratio;
        } else { // Algorithm 1, step 4, applied to the trial deformation instead of to dF
            const double q = ratio / trial, scale = dim == 2 ? sqrt(q) : cbrt(q);
            for (int k = 0; s->F && k < dim * dim; k++) {
                s->F[mpm_at(p, dim * dim, k)] *= scale;
            }
            for (int k = 0; s->b && k < MPM_SYM(dim); k++) { // not b33 in plane strain
                s->b[mpm_at(p, MPM_SYM(dim), k)] *= dim == 2 && k == 2 ? 1 : scale * scale;
            }
        }
    }
    finish(span, span->begin, span->end, &r, NULL, dim);
    *result = r;
}

// ---- The tables ----

#define DEFINE(D, B)                                                                               \
    static void p2g_##D##d_##B(const struct mpm_span *span, struct mpm_span_result *result) {      \
        p2g(span, result, D, MPM_##B);                                                             \
    }                                                                                              \
    static void g2p_##D##d_##B(const struct mpm_span *span, struct mpm_span_result *result) {      \
        switch (span->s->material->kinematics) {                                                   \
        case MPM_KEEPS_F:                                                                          \
            g2p(span, result, D, MPM_##B, MPM_KEEPS_F);                                            \
            break;                                                                                 \
        case MPM_KEEPS_J:                                                                          \
            g2p(span, result, D, MPM_##B, MPM_KEEPS_J);                                            \
            break;                                                                                 \
        case MPM_KEEPS_B:                                                                          \
            g2p(span, result, D, MPM_##B, MPM_KEEPS_B);                                            \
            break;                                                                                 \
        }                                                                                          \
        if (span->fbar && span->scheme == MPM_FBAR_ZHAO) {                                         \
            fbar_scatter(span, D, MPM_##B, MPM_FBAR_ZHAO);                                         \
        } else if (span->fbar) {                                                                   \
            fbar_scatter(span, D, MPM_##B, MPM_FBAR_ANCHORED);                                     \
        }                                                                                          \
    }                                                                                              \
    static void move_nodes_##D##d_##B(const struct mpm_grid *grid, uint32_t begin, uint32_t end,   \
                                      const struct mpm_motion *motion) {                           \
        move_nodes(grid, begin, end, motion, D);                                                   \
    }                                                                                              \
    static void force_##D##d_##B(const struct mpm_span *span, const uint32_t *particle,            \
                                 const double *f, size_t n) {                                      \
        force(span, particle, f, n, D, MPM_##B);                                                   \
    }                                                                                              \
    static void fbar_##D##d_##B(const struct mpm_span *span, struct mpm_span_result *result) {     \
        if (span->scheme == MPM_FBAR_ZHAO) {                                                       \
            fbar_finish(span, result, D, MPM_##B, MPM_FBAR_ZHAO);                                  \
        } else {                                                                                   \
            fbar_finish(span, result, D, MPM_##B, MPM_FBAR_ANCHORED);                              \
        }                                                                                          \
    }
MPM_EACH_KERNEL(DEFINE)

#define ENTRY(D, B)                                                                                \
    [(D - 2) * MPM_N_BASES + MPM_##B] = {                                                          \
        .p2g = p2g_##D##d_##B,                                                                     \
        .move_nodes = move_nodes_##D##d_##B,                                                       \
        .g2p = g2p_##D##d_##B,                                                                     \
        .divide_nodes = mpm_fbar_divide,                                                           \
        .fbar = fbar_##D##d_##B,                                                                   \
        .force = force_##D##d_##B,                                                                 \
    },
const struct mpm_kernels mpm_kernels_plain[2 * MPM_N_BASES] = {MPM_EACH_KERNEL(ENTRY)};
