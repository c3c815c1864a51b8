// Particle-grid transfers in lanes: what server/mpm/transfer.c does, many particles at a time. A unit
// that defines DIM includes it, and is compiled once for each instruction set, with MPM_LANES.
//
// A stretch is worked on in batches that stay in the first-level cache, in four stages (docs/design.md
// has the picture):
//
//   weights   particles in lanes: base functions of each particle along each direction, and its
//             cell; then runs of particles of one cell
//   gather    particles in lanes, the values of one node at a time for all of them
//   update    particles in lanes: eqs. 11-17, the material's law, and the records of what the
//             particle gives to its nodes, one particle after another
//   scatter   the components of a node in lanes: a run's sums for one node after another stay in
//             registers and are added to the grid once a run
//
// Arithmetic differs from the plain kernels' in the order of sums only.
#include <string.h>

#include "server/mpm/basis.h"
#include "server/mpm/kernels.h"
#include "server/mpm/laws.h"

#if MPM_LANES == 1
#error "the plain kernels are server/mpm/transfer.c"
#endif

// bench/stages.c leaves stages out to see what each takes; elsewhere nothing of this is there.
#ifdef MPM_STAGES
extern int MPM_STAGES;
#define STAGE(n) if (MPM_STAGES >= (n))
#else
#define STAGE(n)
#endif

#define BATCH MPM_BATCH
#define MOST (BATCH + MPM_BLOCK) // of the last batch of a span, which takes what would be left over
#define ROOM (MOST + 8)          // whole vectors, rows of cache lines
#define PARTS (8 / MPM_LANES)    // vectors of one node's eight components
#define UNROLL _Pragma("GCC unroll 8")
#if DIM == 2
#define UNROLL_2D UNROLL
#else // the planes of a stencil: more code than the instruction cache wants
#define UNROLL_2D _Pragma("GCC unroll 1")
#endif

// What a particle gives to its nodes, in the node's order of components (m, mv, f, V):
//   2D: m mv_x mv_y V | -V/h (s_xx s_xy) -V/h (s_xy s_yy)
//   3D: m mv (3) | -V/h (s_xx s_xy s_xz) V, then -V/h (s_xz s_yz s_zz) 0 | -V/h (s_xy s_yy s_yz) 0
// so that the force of each direction of the gradient is found, within its half, where the node
// keeps its force.

struct extent {
    size_t first;   // particle of lane 0, a multiple of MPM_BLOCK
    int begin, end; // lanes that belong to the span
    size_t next;    // like first, of the batch that comes next
};

struct batch {
    struct extent in;
    int n_runs, run[MOST + 1]; // first lane of each run, and the end of the last
    uint32_t key[MOST];         // by run
    uint32_t nodes[MOST][MPM_MAX_STENCIL]; // by run: of its stencil
    MPM_ALIGNED double t[MPM_MAX_DIM][ROOM]; // place in the cell, that the weights follow from
    MPM_ALIGNED double w[MPM_MAX_DIM][MPM_MAX_SUPPORT][ROOM], dw[MPM_MAX_DIM][MPM_MAX_SUPPORT][ROOM];
    MPM_ALIGNED double v[MPM_MAX_DIM][ROOM], dv[MPM_MAX_DIM][ROOM], l[9][ROOM]; // gathered
    MPM_ALIGNED double ratio[2][ROOM]; // F-bar's averages, or what goes into them
    MPM_ALIGNED double row[ROOM][4];   // weights along the last direction, particle by particle
    MPM_ALIGNED double record[ROOM][16];
};

// Stages take what they read of a batch's extent, of the particles' and of the grid's description as
// local copies: vectors may alias anything, so after each store the compiler would read all of it
// again from where others can see it.

// The vector of lanes at `lane` of one component of a field in blocks.
MPM_KERNEL double *at(double *field, struct extent in, int lane, int n_components, int c) {
    return field + mpm_at(in.first + (size_t)lane, n_components, c);
}
// Where a batch ends within a vector, lanes of the same cache lines may belong to another thread's
// stretch, or to no particle: these are neither read nor written. Elsewhere vectors are moved whole:
// that is faster, and what a masked store has written reaches later loads only through the cache.
MPM_KERNEL mpm_vec get(struct extent in, int lane, const double *from, double other,
                       const bool whole) {
    return whole ? mpm_load_aligned(from)
                 : mpm_load_lanes_or(from, in.begin - lane, in.end - lane, other);
}
MPM_KERNEL void put(struct extent in, int lane, double *to, mpm_vec a, const bool whole) {
    if (whole) {
        mpm_store_aligned(to, a);
    } else {
        mpm_store_lanes(to, a, in.begin - lane, in.end - lane);
    }
}
// The same from a field of the particles, and the next batch's on the way to the cache: stretches
// follow each other in another order than in memory, where the processor does not look ahead.
MPM_KERNEL void ahead(double *field, struct extent in, int lane, int n_components, int c) {
    if (MPM_LANES == 8 || lane % MPM_BLOCK == 0) { // a cache line
        __builtin_prefetch(field + mpm_at(in.next + (size_t)lane, n_components, c));
    }
}
MPM_KERNEL mpm_vec fetch(struct extent in, int lane, double *field, int n_components, int c,
                         double other, const bool whole) {
    ahead(field, in, lane, n_components, c);
    return get(in, lane, at(field, in, lane, n_components, c), other, whole);
}
// One loop over a batch's vectors, of which the body knows whether they are whole.
#define FOR_VECTORS(in, body)                                                                      \
    for (int lane = 0; lane < (in).end; lane += MPM_LANES) {                                       \
        if (MPM_UNLIKELY(lane < (in).begin || lane + MPM_LANES > (in).end)) {                      \
            body(false);                                                                           \
        } else {                                                                                   \
            body(true);                                                                            \
        }                                                                                          \
    }

// ---- Weights ----

// Runs begin where the cell is not the one before: `begins` has a bit for each lane.
MPM_KERNEL void find_runs(struct batch *b, uint64_t *begins, const int32_t *key) {
    const struct extent in = b->in;
    int n = 0;
    begins[0] = (begins[0] | (uint64_t)1 << in.begin) & UINT64_MAX << in.begin;
    for (int word = 0; word <= (in.end - 1) / 64; word++) {
        const int left = in.end - word * 64;
        uint64_t bits = begins[word] & (left < 64 ? ~(UINT64_MAX << left) : UINT64_MAX);
        for (; bits; bits &= bits - 1) {
            const int lane = word * 64 + __builtin_ctzll(bits);
            b->run[n] = lane;
            b->key[n++] = (uint32_t)key[lane];
        }
    }
    b->n_runs = n;
    b->run[n] = in.end;
}

// Cells, runs, and places in the cells.
MPM_KERNEL void find_cells(struct batch *b, const struct mpm_span *span, const int dim,
                           const enum mpm_basis basis) {
    const struct mpm_particles part = *span->s, *s = &part;
    const struct mpm_grid grid = *span->grid, *g = &grid;
    const struct extent in = b->in;
    int32_t key[ROOM];
    uint64_t begins[2] = {0};
    mpm_vec before = mpm_splat(-1);
    for (int lane = 0; lane < in.end; lane += MPM_LANES) {
        mpm_vec block = mpm_splat(0), cell = mpm_splat(0);
        UNROLL for (int d = 0; d < dim; d++) {
            // Lanes of other stretches are read, too: no pass that has them writes positions.
            const mpm_vec x = mpm_load_aligned(at(s->x, in, lane, dim, d));
            ahead(s->x, in, lane, dim, d);
            const mpm_vec xi = (x - g->origin[d]) * g->inv_h;
            const mpm_vec base = mpm_base(basis, xi);
            const mpm_vec of = mpm_floor(base * (1.0 / MPM_EDGE));
            block = d == 0 ? of : block * (double)g->n_blocks[d] + of;
            const mpm_vec inner = base - of * (double)MPM_EDGE;
            cell = d == 0 ? inner : cell * (double)MPM_EDGE + inner;
            mpm_store_aligned(&b->t[d][lane], xi - base);
        }
        const mpm_vec number = block * (double)MPM_BLOCK_NODES(dim) + cell;
        begins[lane / 64] |= (uint64_t)mpm_bits(number != mpm_follow(before, number))
                             << lane % 64;
        before = number;
        mpm_store_int32(&key[lane], number);
    }
    find_runs(b, begins, key);
}

// The weights of all particles, for the stages that take one particle after another.
MPM_KERNEL void write_weights(struct batch *b, const struct mpm_particles *s, const int dim,
                              const enum mpm_basis basis, const bool gradients) {
    const double half = s->half, inv_4_half = s->inv_4_half;
    const struct extent in = b->in;
    const int support = mpm_support(basis);
    for (int lane = 0; lane < in.end; lane += MPM_LANES) {
        UNROLL for (int d = 0; d < dim; d++) {
            mpm_vec w[MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT];
            mpm_weights_at(basis, mpm_load_aligned(&b->t[d][lane]), half, inv_4_half, w, dw);
            UNROLL for (int a = 0; a < support; a++) {
                mpm_store_aligned(&b->w[d][a][lane], w[a]);
                if (gradients) {
                    mpm_store_aligned(&b->dw[d][a][lane], dw[a]);
                }
            }
        }
    }
}

// Weights along the last direction, particle by particle, for sums whose nodes lie in lanes.
MPM_KERNEL void find_rows(struct batch *b, const int dim, const enum mpm_basis basis) {
    const struct extent in = b->in;
    for (int lane = 0; lane < in.end; lane += 4) {
        mpm_transpose_4(b->w[dim - 1][0] + lane, b->w[dim - 1][1] + lane,
                        mpm_support(basis) > 2 ? b->w[dim - 1][2] + lane : NULL,
                        mpm_support(basis) > 3 ? b->w[dim - 1][3] + lane : NULL, b->row[lane]);
    }
}

// mpm_grid_stencil for all runs, from the grid's table and many nodes at a time: before anything
// else, since each is a long chain of loads.
MPM_KERNEL void find_nodes(struct batch *b, const struct mpm_grid *grid, const int dim,
                           const enum mpm_basis basis) {
    const int support = mpm_support(basis);
    const int n = dim == 2 ? support * support : support * support * support;
    const struct mpm_grid copy = *grid, *g = &copy;
    const int n_runs = b->n_runs;
    for (int r = 0; r < n_runs; r++) {
        const uint32_t key = b->key[r];
        const size_t row = (key & (uint32_t)(MPM_BLOCK_NODES(dim) - 1)) * MPM_MAX_STENCIL;
        const uint32_t *near = g->near[g->slot[key >> MPM_BLOCK_BITS(dim)]];
        UNROLL for (int k = 0; k < n; k += 8) {
            mpm_pick_8(near, g->which + row + k, g->place + row + k, b->nodes[r] + k);
        }
    }
}

// ---- Gather ----

// The value of one component at a node, for lanes of two cells: of the first cell's node, but of the
// second's where `second`.
MPM_KERNEL mpm_vec node_value(const double *one, const double *other, mpm_tail second,
                              const bool two) {
    return two ? mpm_splat_tail(one, other, second) : mpm_splat(*one);
}

// eqs. 11, 12, 16: v^{n+1}, its increment and its gradient (per cell) at the particles of one
// vector, whose cells' nodes are given: of one cell, or of two.
MPM_KERNEL void gather_velocity_at(const struct batch *b, int lane,
                                   const struct mpm_particles *s, const double *velocity,
                                   const uint32_t *nodes, const uint32_t *others, mpm_tail second,
                                   const bool two, mpm_vec *out, const int dim,
                                   const enum mpm_basis basis) {
    const int support = mpm_support(basis), last = dim - 1, planes = dim == 3 ? support : 1;
    mpm_vec *v = out, *dv = out + dim, *l = out + 2 * dim;
    mpm_vec w[MPM_MAX_DIM][MPM_MAX_SUPPORT], dw[MPM_MAX_DIM][MPM_MAX_SUPPORT];
    UNROLL for (int d = 0; d < dim; d++) {
        mpm_weights_at(basis, mpm_load_aligned(&b->t[d][lane]), s->half, s->inv_4_half, w[d], dw[d]);
    }
    const mpm_vec *w_last = w[last], *dw_last = dw[last];
    UNROLL for (int k = 0; k < 2 * dim + dim * dim; k++) {
        out[k] = mpm_splat(0);
    }
    // In 3D with 16 registers one component after the other, so that its sums stay in them.
    const int at_once = MPM_LANES == 8 || dim == 2 ? dim : 1;
    UNROLL for (int first = 0; first < dim; first += at_once) {
        UNROLL_2D for (int a = 0; a < support; a++) {
            const mpm_vec wa = w[0][a], dwa = dw[0][a];
            UNROLL for (int p = 0; p < planes; p++) {
                const int row = (dim == 3 ? a * support + p : a) * support;
                mpm_vec v_w[3], v_dw[3], dv_w[3]; // sums along the row
                UNROLL for (int c = 0; c < support; c++) {
                    const double *one =
                        velocity + (size_t)nodes[row + c] * MPM_VELOCITY(dim) + first;
                    const double *other =
                        two ? velocity + (size_t)others[row + c] * MPM_VELOCITY(dim) + first : one;
                    UNROLL for (int d = 0; d < at_once; d++) {
                        const mpm_vec of = node_value(one + d, other + d, second, two);
                        v_w[d] = c == 0 ? w_last[c] * of : v_w[d] + w_last[c] * of;
                        v_dw[d] = c == 0 ? dw_last[c] * of : v_dw[d] + dw_last[c] * of;
                        const mpm_vec change =
                            node_value(one + dim + d, other + dim + d, second, two);
                        dv_w[d] = c == 0 ? w_last[c] * change : dv_w[d] + w_last[c] * change;
                    }
                }
                mpm_vec w_row = wa, dw_row[2] = {dwa, dwa};
                if (dim == 3) {
                    w_row = wa * w[1][p];
                    dw_row[0] = dwa * w[1][p];
                    dw_row[1] = wa * dw[1][p];
                }
                UNROLL for (int d = 0; d < at_once; d++) {
                    mpm_vec *l_d = l + (first + d) * dim;
                    v[first + d] += w_row * v_w[d];
                    dv[first + d] += w_row * dv_w[d];
                    l_d[last] += w_row * v_dw[d];
                    UNROLL for (int e = 0; e < last; e++) {
                        l_d[e] += dw_row[e] * v_w[d];
                    }
                }
            }
        }
    }
}

// eq. 20: the averages at the particles of one vector.
MPM_KERNEL void gather_ratios_at(const struct batch *b, int lane, const struct mpm_particles *s,
                                 const double *fbar,
                                 const uint32_t *nodes, const uint32_t *others, mpm_tail second,
                                 const bool two, mpm_vec *sum, const int dim,
                                 const enum mpm_basis basis, const int scalars) {
    const int support = mpm_support(basis), last = dim - 1, planes = dim == 3 ? support : 1;
    mpm_vec w[MPM_MAX_DIM][MPM_MAX_SUPPORT], dw[MPM_MAX_SUPPORT];
    UNROLL for (int d = 0; d < dim; d++) {
        mpm_weights_at(basis, mpm_load_aligned(&b->t[d][lane]), s->half, s->inv_4_half, w[d], dw);
    }
    const mpm_vec *w_last = w[last];
    UNROLL for (int k = 0; k < scalars; k++) {
        sum[k] = mpm_splat(0);
    }
    UNROLL_2D for (int a = 0; a < support; a++) {
        const mpm_vec wa = w[0][a];
        UNROLL for (int p = 0; p < planes; p++) {
            const int row = (dim == 3 ? a * support + p : a) * support;
            const mpm_vec w_row = dim == 3 ? wa * w[1][p] : wa;
            UNROLL for (int k = 0; k < scalars; k++) {
                mpm_vec along;
                UNROLL for (int c = 0; c < support; c++) {
                    const double *one = fbar + (size_t)nodes[row + c] * (size_t)scalars + k;
                    const double *other =
                        two ? fbar + (size_t)others[row + c] * (size_t)scalars + k : one;
                    const mpm_vec of = node_value(one, other, second, two);
                    along = c == 0 ? w_last[c] * of : along + w_last[c] * of;
                }
                sum[k] += w_row * along;
            }
        }
    }
}

// What is gathered: velocities (scalars = 0), or F-bar's averages.
MPM_KERNEL void gather_at(const struct batch *b, int lane, const struct mpm_particles *s,
                          const struct mpm_grid *g, const uint32_t *nodes, const uint32_t *others, mpm_tail second,
                          const bool two, mpm_vec *out, const int dim, const enum mpm_basis basis,
                          const int scalars) {
    if (scalars == 0) {
        gather_velocity_at(b, lane, s, g->velocity, nodes, others, second, two, out, dim, basis);
    } else {
        gather_ratios_at(b, lane, s, g->fbar, nodes, others, second, two, out, dim, basis, scalars);
    }
}

// A vector mostly has particles of one cell or of two, seldom of more: then it is gathered again
// for the next two, from their first lane on.
MPM_KERNEL void keep_gathered(double *to, mpm_vec a, int from) {
    if (from == 0) {
        mpm_store_aligned(to, a);
    } else {
        mpm_store_lanes(to, a, from, MPM_LANES);
    }
}
MPM_KERNEL void gather(struct batch *b, const struct mpm_span *span, const int dim,
                       const enum mpm_basis basis, const int scalars) {
    const struct extent in = b->in;
    const struct mpm_particles part = *span->s, *s = &part;
    const struct mpm_grid grid = *span->grid, *g = &grid;
    int run = 0; // the one that the vector begins in
    for (int lane = in.begin / MPM_LANES * MPM_LANES; lane < in.end; lane += MPM_LANES) {
        for (int from = 0; from < MPM_LANES;) {
            mpm_vec out[6 + 9];
            const int next = run + 1 < b->n_runs ? b->run[run + 1] - lane : MPM_LANES;
            if (next >= MPM_LANES) {
                gather_at(b, lane, s, g, b->nodes[run], b->nodes[run], mpm_tail_from(MPM_LANES),
                          false, out, dim, basis, scalars);
            } else {
                gather_at(b, lane, s, g, b->nodes[run], b->nodes[run + 1], mpm_tail_from(next), true,
                          out, dim, basis, scalars);
                run++;
            }
            UNROLL for (int k = 0; k < scalars; k++) {
                keep_gathered(&b->ratio[k][lane], out[k], from);
            }
            UNROLL for (int d = 0; scalars == 0 && d < dim; d++) {
                keep_gathered(&b->v[d][lane], out[d], from);
                keep_gathered(&b->dv[d][lane], out[dim + d], from);
                UNROLL for (int e = 0; e < dim; e++) {
                    keep_gathered(&b->l[d * dim + e][lane], out[2 * dim + d * dim + e], from);
                }
            }
            from = run + 1 < b->n_runs ? b->run[run + 1] - lane : MPM_LANES;
            run += from < MPM_LANES;
        }
        run += run + 1 < b->n_runs && b->run[run + 1] == lane + MPM_LANES;
    }
}

// ---- Scatter ----

// eqs. 7, 8, 10: mass, momentum, force and volume of the records to the nodes. In 3D one plane of
// nodes at a time stays in registers, those of one place along the first direction.
MPM_KERNEL void scatter_part(const struct batch *b, double *node, const uint32_t *nodes, int begin,
                             int end, const int part, const enum mpm_basis basis) {
    const int support = mpm_support(basis), at = part * MPM_LANES;
    const bool has_force = MPM_LANES == 8 || part == 1;
    for (int plane = 0; plane < support; plane++) {
        mpm_vec sum[MPM_MAX_SUPPORT][MPM_MAX_SUPPORT];
        UNROLL for (int i = 0; i < support; i++) {
            UNROLL for (int c = 0; c < support; c++) {
                sum[i][c] = mpm_splat(0);
            }
        }
        for (int p = begin; p < end; p++) {
            const mpm_vec own = mpm_load_aligned(b->record[p] + at);
            const mpm_vec w0 = mpm_splat(b->w[0][plane][p]);
            mpm_vec Q = mpm_keep(own, mpm_sums(part)) * w0, Y, Z;
            if (has_force) {
                const mpm_word force = mpm_forces(part);
                Q += mpm_keep(own, force) * mpm_splat(b->dw[0][plane][p]);
                Y = mpm_keep(mpm_load_aligned(b->record[p] + 8 + at), force) * w0;
                Z = mpm_keep(mpm_load_upper(b->record[p] + 8), force) * w0;
            }
            UNROLL for (int i = 0; i < support; i++) {
                const mpm_vec w1 = mpm_splat(b->w[1][i][p]);
                mpm_vec R = Q * w1, S;
                if (has_force) {
                    R += Y * mpm_splat(b->dw[1][i][p]);
                    S = Z * w1;
                }
                UNROLL for (int c = 0; c < support; c++) {
                    sum[i][c] += R * mpm_splat(b->w[2][c][p]);
                    if (has_force) {
                        sum[i][c] += S * mpm_splat(b->dw[2][c][p]);
                    }
                }
            }
        }
        UNROLL for (int i = 0; i < support; i++) {
            UNROLL for (int c = 0; c < support; c++) {
                double *to =
                    node + (size_t)nodes[(plane * support + i) * support + c] * MPM_NODE + at;
                mpm_store_aligned(to, mpm_load_aligned(to) + sum[i][c]);
            }
        }
    }
}

// The next run's cell is the next one along the last direction: all but the first of its columns
// are there already.
MPM_KERNEL bool next_shares(const struct batch *b, int r) {
    return r + 1 < b->n_runs && b->key[r + 1] == b->key[r] + 1 &&
           (b->key[r] & (MPM_EDGE - 1)) != MPM_EDGE - 1;
}

MPM_KERNEL void add_to_node(double *node, uint32_t i, mpm_vec sum, const int part) {
    double *to = node + (size_t)i * MPM_NODE + part * MPM_LANES;
    mpm_store_aligned(to, mpm_load_aligned(to) + mpm_join_pairs(sum, part));
}

// The same in 2D, where the records have room for both directions of the gradient side by side, so
// that a node takes one multiplication: the sums of both meet when no more comes to a node. The
// sums that the next run goes on with stay in registers.
MPM_KERNEL void scatter_part_2d(const struct batch *b, double *node, const int part,
                                const enum mpm_basis basis) {
    const int support = mpm_support(basis), at = part * MPM_LANES;
    mpm_vec sum[MPM_MAX_SUPPORT][MPM_MAX_SUPPORT];
    UNROLL for (int i = 0; i < support; i++) {
        UNROLL for (int c = 0; c < support; c++) {
            sum[i][c] = mpm_splat(0);
        }
    }
    const int n_runs = b->n_runs;
    for (int r = 0; r < n_runs; r++) {
        for (int p = b->run[r]; p < b->run[r + 1]; p++) {
            const mpm_vec own = mpm_load_aligned(b->record[p] + at);
            mpm_vec R[MPM_MAX_SUPPORT], B[MPM_MAX_SUPPORT];
            UNROLL for (int i = 0; i < support; i++) {
                R[i] = own * mpm_splat_two(b->w[0][i] + p, b->dw[0][i] + p, 4, part);
                B[i] = mpm_splat_two(b->w[1][i] + p, b->dw[1][i] + p, 6, part);
            }
            UNROLL for (int i = 0; i < support; i++) {
                UNROLL for (int c = 0; c < support; c++) {
                    sum[i][c] += R[i] * B[c];
                }
            }
        }
        const uint32_t *nodes = b->nodes[r];
        const bool shares = next_shares(b, r);
        UNROLL for (int i = 0; i < support; i++) {
            add_to_node(node, nodes[i * support], sum[i][0], part);
        }
        if (!shares) {
            UNROLL for (int i = 0; i < support; i++) {
                UNROLL for (int c = 1; c < support; c++) {
                    add_to_node(node, nodes[i * support + c], sum[i][c], part);
                    sum[i][c] = mpm_splat(0);
                }
            }
        }
        UNROLL for (int i = 0; i < support; i++) {
            UNROLL for (int c = 0; c + 1 < support; c++) {
                sum[i][c] = sum[i][c + 1];
            }
            sum[i][support - 1] = mpm_splat(0);
        }
    }
}

MPM_KERNEL void scatter_records(const struct batch *b, const struct mpm_grid *g, const int dim,
                                const enum mpm_basis basis) {
    UNROLL for (int part = 0; part < PARTS && dim == 2; part++) {
        scatter_part_2d(b, g->node, part, basis);
    }
    for (int r = 0; r < b->n_runs && dim == 3; r++) {
        UNROLL for (int part = 0; part < PARTS; part++) {
            scatter_part(b, g->node, b->nodes[r], b->run[r], b->run[r + 1], part, basis);
        }
    }
}

// eq. 19: what F-bar averages, b->ratio, to the nodes; the nodes of a row lie in lanes.
MPM_KERNEL void scatter_ratios(struct batch *b, const struct mpm_grid *g, const int dim,
                               const enum mpm_basis basis) {
    const int support = mpm_support(basis), planes = dim == 3 ? support : 1;
    for (int r = 0; r < b->n_runs; r++) {
        mpm_four sum[MPM_MAX_SUPPORT][MPM_MAX_SUPPORT];
        UNROLL for (int a = 0; a < support; a++) {
            UNROLL for (int i = 0; i < planes; i++) {
                sum[a][i] = (mpm_four){0};
            }
        }
        for (int p = b->run[r]; p < b->run[r + 1]; p++) {
            const mpm_four of = mpm_load_four(b->row[p]) * b->ratio[0][p];
            UNROLL for (int a = 0; a < support; a++) {
                const mpm_four plane = of * b->w[0][a][p];
                UNROLL for (int i = 0; i < planes; i++) {
                    sum[a][i] = dim == 3 ? sum[a][i] + plane * b->w[1][i][p] : sum[a][i] + plane;
                }
            }
        }
        const uint32_t *row = b->nodes[r];
        UNROLL for (int a = 0; a < support; a++) {
            UNROLL for (int i = 0; i < planes; i++, row += support) {
                UNROLL for (int c = 0; c < support; c++) {
                    g->fbar[row[c]] += sum[a][i][c];
                }
            }
        }
    }
}

// The same of the anchored scheme's two scalars: in lanes node by node, the two of a node together.
MPM_KERNEL void scatter_pairs(struct batch *b, const struct mpm_grid *g, const int dim,
                              const enum mpm_basis basis) {
    const int support = mpm_support(basis), planes = dim == 3 ? support : 1;
    const int part_nodes = MPM_LANES / 2, parts = (support + part_nodes - 1) / part_nodes;
    for (int r = 0; r < b->n_runs; r++) {
        UNROLL for (int part = 0; part < parts; part++) {
            mpm_vec sum[MPM_MAX_SUPPORT][MPM_MAX_SUPPORT];
            UNROLL for (int a = 0; a < support; a++) {
                UNROLL for (int i = 0; i < planes; i++) {
                    sum[a][i] = mpm_splat(0);
                }
            }
            for (int p = b->run[r]; p < b->run[r + 1]; p++) {
                const mpm_vec of = mpm_load_twice(b->row[p] + part * part_nodes) *
                                   mpm_splat_pair(b->ratio[0] + p, b->ratio[1] + p);
                UNROLL for (int a = 0; a < support; a++) {
                    const mpm_vec plane = of * b->w[0][a][p];
                    UNROLL for (int i = 0; i < planes; i++) {
                        sum[a][i] = dim == 3 ? sum[a][i] + plane * b->w[1][i][p] : sum[a][i] + plane;
                    }
                }
            }
            const uint32_t *row = b->nodes[r] + part * part_nodes;
            UNROLL for (int a = 0; a < support; a++) {
                UNROLL for (int i = 0; i < planes; i++, row += support) {
                    UNROLL for (int c = 0; c < part_nodes; c++) {
                        if (part * part_nodes + c < support) {
                            mpm_add_pair(g->fbar + (size_t)row[c] * 2, sum[a][i], c);
                        }
                    }
                }
            }
        }
    }
}

// ---- Update ----

// What the lanes of a stretch find, until it is over.
struct found {
    mpm_vec min[MPM_MAX_DIM], max[MPM_MAX_DIM], v2_max, dx_max, mass_dx[MPM_MAX_DIM];
};

MPM_KERNEL void found_nothing(struct found *f) {
    for (int d = 0; d < MPM_MAX_DIM; d++) {
        f->min[d] = mpm_splat(INFINITY);
        f->max[d] = mpm_splat(-INFINITY);
        f->mass_dx[d] = mpm_splat(0);
    }
    f->v2_max = f->dx_max = mpm_splat(0);
}

MPM_KERNEL void found_all(const struct found *f, struct mpm_span_result *r, const int dim) {
    for (int d = 0; d < dim; d++) {
        r->min[d] = mpm_hmin(f->min[d]);
        r->max[d] = mpm_hmax(f->max[d]);
        r->mass_dx[d] = mpm_hsum(f->mass_dx[d]);
    }
    r->v2_max = mpm_hmax(f->v2_max);
    r->dx_max = mpm_hmax(f->dx_max);
}

// The first lane at fault is the stretch's, unless there was one before.
__attribute__((cold, noinline)) static void fault(struct mpm_span_result *r, struct extent in,
                                                  int lane, unsigned lanes, enum mpm_status status,
                                                  const double *value) {
    for (int i = 0; i < MPM_LANES && r->bad == SIZE_MAX; i++) {
        if (lanes >> i & 1 && lane + i >= in.begin && lane + i < in.end) {
            r->bad = in.first + (size_t)(lane + i);
            r->status = status;
            r->value = value[i];
        }
    }
}
MPM_KERNEL void fault_unless(mpm_mask good, struct mpm_span_result *r, struct extent in, int lane,
                             enum mpm_status status, mpm_vec value) {
    if (MPM_UNLIKELY(!mpm_all(good))) {
        double values[MPM_LANES];
        mpm_store(values, value);
        fault(r, in, lane, ~mpm_bits(good), status, values);
    }
}

#define EACH_KEEPS_F_KEEPS_F(text) text
#define EACH_KEEPS_F_KEEPS_B(text)
#define EACH_KEEPS_F_KEEPS_J(text)
#define EACH_KEEPS_B_KEEPS_F(text)
#define EACH_KEEPS_B_KEEPS_B(text) text
#define EACH_KEEPS_B_KEEPS_J(text)
#define EACH_KEEPS_J_KEEPS_F(text)
#define EACH_KEEPS_J_KEEPS_B(text)
#define EACH_KEEPS_J_KEEPS_J(text) text

MPM_KERNEL enum mpm_kinematics kept_by(const enum mpm_law law) {
    switch (law) {
#define X(name, keeps)                                                                             \
    case MPM_LAW_##name:                                                                           \
        return MPM_##keeps;
        MPM_LAWS(X)
#undef X
    default:
        return MPM_KEEPS_F;
    }
}

// The stress of what is kept: F (dim x dim) or J (1), to which a fluid's rate part in
// sigma is added.
MPM_KERNEL void stress(const enum mpm_law law, const void *constants, mpm_vec *kept,
                       mpm_vec *sigma, const int dim) {
    switch (law) {
#define X(name, keeps)                                                                             \
    case MPM_LAW_##name:                                                                           \
        EACH_KEEPS_F_##keeps(name##_stress(constants, kept, sigma, dim);)                          \
            EACH_KEEPS_J_##keeps(name##_stress(constants, kept[0], sigma, dim);) break;
        MPM_LAWS(X)
#undef X
    default:
        break;
    }
}
// The same of laws that keep b, of n vectors.
MPM_KERNEL void flow_stress(const enum mpm_law law, const void *constants, int n, mpm_vec (*b)[6],
                            mpm_vec *a, mpm_vec (*sigma)[6], const int dim) {
    switch (law) {
#define X(name, keeps)                                                                             \
    case MPM_LAW_##name:                                                                           \
        EACH_KEEPS_B_##keeps(name##_stress(constants, n, b, a, sigma, dim);) break;
        MPM_LAWS(X)
#undef X
    default:
        break;
    }
}

MPM_KERNEL void rate_stress(const enum mpm_law law, const void *constants, const mpm_vec *L,
                            mpm_vec *sigma, const int dim) {
    switch (law) {
#define X(name, keeps)                                                                             \
    case MPM_LAW_##name:                                                                           \
        EACH_KEEPS_J_##keeps(name##_rate(constants, L, sigma, dim);) break;
        MPM_LAWS(X)
#undef X
    default:
        break;
    }
}

MPM_KERNEL int n_kept(const enum mpm_kinematics kinematics, const int dim) {
    return kinematics == MPM_KEEPS_F ? dim * dim : kinematics == MPM_KEEPS_B ? MPM_SYM(dim) : 1;
}
MPM_KERNEL double *field_kept(const struct mpm_particles *s, const enum mpm_kinematics kinematics) {
    return kinematics == MPM_KEEPS_F ? s->F : kinematics == MPM_KEEPS_B ? s->b : s->Jbar;
}
MPM_KERNEL void load_kept(const struct mpm_particles *s, struct extent in, int lane,
                          mpm_vec *kept, const int dim, const enum mpm_kinematics kinematics,
                          const bool whole) {
    const int n = n_kept(kinematics, dim);
    UNROLL for (int k = 0; k < n; k++) { // the undeformed state where lanes are not the batch's
        const bool one = kinematics == MPM_KEEPS_F ? k % (dim + 1) == 0 : k < 3;
        kept[k] = fetch(in, lane, field_kept(s, kinematics), n, k, one, whole);
    }
}
MPM_KERNEL void store_kept(const struct mpm_particles *s, struct extent in, int lane,
                           const mpm_vec *kept, const int dim, const enum mpm_kinematics kinematics,
                           const bool whole) {
    const int n = n_kept(kinematics, dim);
    UNROLL for (int k = 0; k < n; k++) {
        put(in, lane, at(field_kept(s, kinematics), in, lane, n, k), kept[k], whole);
    }
}

// eq. 14 with dF = 1 + D, on what the material keeps.
MPM_KERNEL void deform(mpm_vec *kept, const mpm_vec *D, mpm_vec dJ_minus_one, const int dim,
                       const enum mpm_kinematics kinematics) {
    if (kinematics == MPM_KEEPS_J) {
        kept[0] += kept[0] * dJ_minus_one;
        return;
    }
    mpm_vec A[9], DA[9]; // F, or b in full
    UNROLL for (int i = 0; i < dim; i++) {
        UNROLL for (int j = 0; j < dim; j++) {
            A[i * dim + j] = kept[kinematics == MPM_KEEPS_F ? i * dim + j : mpm_sym_index(i, j)];
        }
    }
    UNROLL for (int i = 0; i < dim; i++) {
        UNROLL for (int j = 0; j < dim; j++) {
            DA[i * dim + j] = D[i * dim] * A[j];
            UNROLL for (int k = 1; k < dim; k++) {
                DA[i * dim + j] += D[i * dim + k] * A[k * dim + j];
            }
        }
    }
    if (kinematics == MPM_KEEPS_F) {
        UNROLL for (int k = 0; k < dim * dim; k++) {
            kept[k] = A[k] + DA[k];
        }
        return;
    }
    UNROLL for (int i = 0; i < dim; i++) { // dF b dF^T = b + D b + (D b)^T + D b D^T
        UNROLL for (int j = i; j < dim; j++) {
            mpm_vec change = DA[i * dim + j] + DA[j * dim + i];
            UNROLL for (int k = 0; k < dim; k++) {
                change += DA[i * dim + k] * D[j * dim + k];
            }
            kept[mpm_sym_index(i, j)] += change;
        }
    }
}

MPM_KERNEL mpm_vec ratio_of(const mpm_vec *kept, const int dim,
                            const enum mpm_kinematics kinematics) {
    return kinematics == MPM_KEEPS_F   ? mpm_det(kept, dim)
           : kinematics == MPM_KEEPS_B ? mpm_sqrt(mpm_det_sym(kept, dim))
                                       : kept[0];
}

// What a step does to particles.
struct by {
    double dt, blend, inv_h, a, C, keep;
};
MPM_KERNEL struct by what_by(const struct mpm_span *span) {
    return (struct by){.dt = span->dt,
                       .blend = span->blend,
                       .inv_h = span->grid->inv_h,
                       .a = span->a,
                       .C = span->C,
                       .keep = span->keep};
}

// The stages of an update are short loops over the vectors of a batch, so that the processor has
// several vectors of each in work at a time: every one is a long chain of dependent operations.

MPM_KERNEL void update_velocity(struct batch *b, struct extent in, int lane,
    const struct mpm_particles *s, const struct by *by,
                                struct mpm_span_result *r, mpm_vec *v2_max, const int dim,
                                const bool keeps_step, const bool whole) {
    mpm_vec v2 = mpm_splat(0);
    UNROLL for (int d = 0; d < dim; d++) { // eqs. 11-13
        const mpm_vec v_pic = get(in, lane, &b->v[d][lane], 0, whole);
        const mpm_vec dv = get(in, lane, &b->dv[d][lane], 0, whole);
        double *to = at(s->v, in, lane, dim, d);
        const mpm_vec flip = fetch(in, lane, s->v, dim, d, 0, whole) + dv;
        const mpm_vec v = v_pic + by->blend * (flip - v_pic);
        put(in, lane, to, v, whole);
        v2 += v * v;
        const mpm_vec dx = by->dt * v_pic;
        mpm_store_aligned(&b->v[d][lane], dx); // from here on the step
        if (keeps_step) {
            put(in, lane, at(s->dx, in, lane, dim, d), dx, whole);
            ahead(s->dx, in, lane, dim, d);
        }
    }
    fault_unless(v2 < INFINITY, r, in, lane, MPM_ERR_NOT_FINITE, v2);
    *v2_max = mpm_max(v2, *v2_max);
}

// Deformation and, without F-bar, volume; else what will be averaged.
MPM_KERNEL void update_deformation(struct batch *b, struct extent in, int lane,
    const struct mpm_particles *s, const struct by *by,
                                   struct mpm_span_result *r, const int dim,
                                   const enum mpm_law law, const enum mpm_fbar_scheme scheme,
                                   const bool whole) {
    const enum mpm_kinematics kinematics = kept_by(law);
    const int n_sym = MPM_SYM(dim);
    const double inv_h = by->inv_h, dt_over_h = by->dt * inv_h;
    mpm_vec D[9], kept[9], sigma[6];
    UNROLL for (int k = 0; k < dim * dim; k++) { // the relative deformation gradient less 1
        D[k] = get(in, lane, &b->l[k][lane], 0, whole) * dt_over_h;
    }
    const mpm_vec dJ_minus_one = mpm_det_minus_one(D, dim);
    load_kept(s, in, lane, kept, dim, kinematics, whole);
    deform(kept, D, dJ_minus_one, dim, kinematics);
    store_kept(s, in, lane, kept, dim, kinematics, whole);
    const mpm_vec ratio = ratio_of(kept, dim, kinematics);
    double *to_V = at(s->V, in, lane, 1, 0);
    mpm_vec V = fetch(in, lane, s->V, 1, 0, 1, whole);
    if (kinematics == MPM_KEEPS_J) {
        if (s->J_raw) {
            double *to = at(s->J_raw, in, lane, 1, 0);
            const mpm_vec J = get(in, lane, to, 0, whole);
            put(in, lane, to, J + J * dJ_minus_one, whole);
        }
        mpm_vec L[9];
        UNROLL for (int k = 0; k < dim * dim; k++) {
            L[k] = get(in, lane, &b->l[k][lane], 0, whole) * inv_h;
        }
        rate_stress(law, s->constants, L, sigma, dim);
        UNROLL for (int k = 0; k < n_sym; k++) {
            put(in, lane, at(s->sigma, in, lane, n_sym, k), sigma[k], whole);
        }
    }
    if (scheme == MPM_FBAR_OFF) {
        V += V * dJ_minus_one; // eq. 15
        put(in, lane, to_V, V, whole);
        fault_unless(ratio > 0.0, r, in, lane, MPM_ERR_VOLUME, ratio);
        fault_unless(V > 0.0, r, in, lane, MPM_ERR_VOLUME, V);
        return;
    }
    const mpm_vec dJ = 1.0 + dJ_minus_one;
    put(in, lane, at(s->dJ, in, lane, 1, 0), dJ, whole);
    ahead(s->dJ, in, lane, 1, 0);
    if (kinematics == MPM_KEEPS_B) { // sqrt(det b) would not tell
        fault_unless(dJ > 0.0, r, in, lane, MPM_ERR_VOLUME, dJ);
    }
    // Algorithm 1, step 3; the trial ratio Jbar^n dJ is the ratio in use.
    if (scheme == MPM_FBAR_ZHAO) {
        mpm_store_aligned(&b->ratio[0][lane], V * ratio);
    } else {
        const mpm_vec A = V * dJ, H = V / fetch(in, lane, s->V0, 1, 0, 1, whole);
        mpm_store_aligned(&b->ratio[0][lane], A);
        mpm_store_aligned(&b->ratio[1][lane], (1 - by->a) * V * ratio + by->a * A * H);
    }
}

// Algorithm 1, step 4, from the averages that were gathered, applied to the trial deformation
// instead of to dF; and the volume.
MPM_KERNEL void rescale(struct batch *b, struct extent in, int lane,
    const struct mpm_particles *s, const struct by *by,
                        struct mpm_span_result *r, const int dim, const enum mpm_law law,
                        const enum mpm_fbar_scheme scheme, const bool whole) {
    const enum mpm_kinematics kinematics = kept_by(law);
    mpm_vec kept[9], dx2 = mpm_splat(0);
    load_kept(s, in, lane, kept, dim, kinematics, whole);
    UNROLL for (int d = 0; d < dim; d++) {
        const mpm_vec dx = fetch(in, lane, s->dx, dim, d, 0, whole);
        mpm_store_aligned(&b->v[d][lane], dx);
        dx2 += dx * dx;
    }
    const mpm_vec trial = ratio_of(kept, dim, kinematics);
    mpm_vec A = get(in, lane, &b->ratio[0][lane], 1, whole);
    double *to_V = at(s->V, in, lane, 1, 0);
    mpm_vec ratio = A, V = fetch(in, lane, s->V, 1, 0, 1, whole), V0 = mpm_splat(0);
    if (scheme == MPM_FBAR_ANCHORED) {
        const mpm_vec dJ = fetch(in, lane, s->dJ, 1, 0, 1, whole);
        V0 = fetch(in, lane, s->V0, 1, 0, 1, whole);
        A = (1 - by->keep) * A + by->keep * dJ;
        ratio = (1 - by->keep) * get(in, lane, &b->ratio[1][lane], 1, whole) +
                by->keep * A * (V / V0);
    }
    fault_unless(trial > 0.0, r, in, lane, MPM_ERR_VOLUME, trial);
    fault_unless(ratio > 0.0, r, in, lane, MPM_ERR_VOLUME, ratio);
    const mpm_vec q = ratio / trial;
    if (scheme == MPM_FBAR_ANCHORED) {
        const mpm_vec reach = (by->C * by->inv_h) * mpm_sqrt(dx2);
        const mpm_vec beta = mpm_min(reach, mpm_splat(1));
        V = (1.0 - beta) * V * A + beta * V0 * ratio;
    } else { // eq. 15: forces use the unaveraged volume; but a fluid's follows Jbar
        const mpm_vec dJ = fetch(in, lane, s->dJ, 1, 0, 1, whole);
        V = kinematics == MPM_KEEPS_J ? V * (dJ * q) : V * dJ;
    }
    put(in, lane, to_V, V, whole);
    fault_unless(V > 0.0, r, in, lane, MPM_ERR_VOLUME, V);
    if (kinematics == MPM_KEEPS_J) {
        kept[0] = ratio;
    } else {
        mpm_vec factor = q; // of b: the square of F's
        if (!(kinematics == MPM_KEEPS_B && dim == 2)) {
            const mpm_vec scale = dim == 2 ? mpm_sqrt(q) : mpm_cbrt(q);
            factor = kinematics == MPM_KEEPS_B ? scale * scale : scale;
        }
        const int n = n_kept(kinematics, dim);
        UNROLL for (int k = 0; k < n; k++) { // not b33 in plane strain
            if (!(kinematics == MPM_KEEPS_B && dim == 2 && k == 2)) {
                kept[k] *= factor;
            }
        }
    }
    store_kept(s, in, lane, kept, dim, kinematics, whole);
}

MPM_KERNEL void put_stress(struct extent in, int lane, const struct mpm_particles *s,
                           const mpm_vec *sigma, const int dim, const bool whole) {
    const int n_sym = MPM_SYM(dim);
    UNROLL for (int k = 0; k < n_sym; k++) {
        put(in, lane, at(s->sigma, in, lane, n_sym, k), sigma[k], whole);
        ahead(s->sigma, in, lane, n_sym, k);
    }
}

MPM_KERNEL void update_stress(struct extent in, int lane, const struct mpm_particles *s,
                              const int dim, const enum mpm_law law, const bool whole) {
    const enum mpm_kinematics kinematics = kept_by(law);
    const int n_sym = MPM_SYM(dim);
    mpm_vec kept[9], sigma[6];
    load_kept(s, in, lane, kept, dim, kinematics, whole);
    UNROLL for (int k = 0; k < n_sym && kinematics == MPM_KEEPS_J; k++) { // the rate part
        sigma[k] = get(in, lane, at(s->sigma, in, lane, n_sym, k), 0, whole);
    }
    stress(law, s->constants, kept, sigma, dim);
    put_stress(in, lane, s, sigma, dim, whole);
}

// Laws that keep b get several vectors at a time.
MPM_KERNEL void update_flow_stress(struct extent in, const struct mpm_particles *s, const int dim,
                                   const enum mpm_law law) {
    for (int begin = in.begin / MPM_LANES * MPM_LANES; begin < in.end;
         begin += MPM_VECTORS * MPM_LANES) {
        mpm_vec b[MPM_VECTORS][6], a[MPM_VECTORS], sigma[MPM_VECTORS][6];
        struct extent these = in; // FOR_VECTORS begins at lane 0
        these.first += (size_t)begin;
        these.next += (size_t)begin;
        these.begin = in.begin > begin ? in.begin - begin : 0;
        these.end = in.end - begin < MPM_VECTORS * MPM_LANES ? in.end - begin
                                                             : MPM_VECTORS * MPM_LANES;
        const int n = (these.end + MPM_LANES - 1) / MPM_LANES;
#define LOAD(whole)                                                                                \
    load_kept(s, these, lane, b[lane / MPM_LANES], dim, MPM_KEEPS_B, whole);                       \
    a[lane / MPM_LANES] = s->plastic_strain                                                        \
                              ? get(these, lane, at(s->plastic_strain, these, lane, 1, 0), 0, whole) \
                              : mpm_splat(0)
        FOR_VECTORS(these, LOAD)
        flow_stress(law, s->constants, n, b, a, sigma, dim);
#define STORE(whole)                                                                               \
    store_kept(s, these, lane, b[lane / MPM_LANES], dim, MPM_KEEPS_B, whole);                      \
    if (s->plastic_strain) {                                                                       \
        put(these, lane, at(s->plastic_strain, these, lane, 1, 0), a[lane / MPM_LANES], whole);    \
    }                                                                                              \
    put_stress(these, lane, s, sigma[lane / MPM_LANES], dim, whole)
        FOR_VECTORS(these, STORE)
    }
}

// eq. 17, by the step in b->v.
MPM_KERNEL void update_position(struct batch *b, struct extent in, int lane, const struct mpm_particles *s,
                                struct mpm_span_result *r, struct found *found, const int dim,
                                const bool whole) {
    const mpm_vec m = s->density * fetch(in, lane, s->V0, 1, 0, 0, whole);
    const size_t one = in.first + (size_t)in.begin; // stands for lanes that are not the batch's
    UNROLL for (int d = 0; d < dim; d++) {
        double *to = at(s->x, in, lane, dim, d);
        const mpm_vec dx = get(in, lane, &b->v[d][lane], 0, whole);
        const mpm_vec x = get(in, lane, to, s->x[mpm_at(one, dim, d)], whole) + dx;
        put(in, lane, to, x, whole);
        found->mass_dx[d] += m * dx;
        found->min[d] = mpm_min(x, found->min[d]);
        found->max[d] = mpm_max(x, found->max[d]);
        found->dx_max = mpm_max(mpm_abs(dx), found->dx_max);
        fault_unless(mpm_abs(x) < INFINITY, r, in, lane, MPM_ERR_NOT_FINITE, x);
    }
}

// Stress and position of particles whose deformation is final.
MPM_KERNEL void finish(struct batch *b, const struct mpm_particles *s, struct mpm_span_result *r,
                       struct found *found, const int dim, const enum mpm_law law) {
    const struct extent in = b->in;
    struct found f = *found;
#define STRESS(whole) update_stress(in, lane, s, dim, law, whole)
#define POSITION(whole) update_position(b, in, lane, s, r, &f, dim, whole)
    if (kept_by(law) == MPM_KEEPS_B) {
        update_flow_stress(in, s, dim, law);
    } else {
        FOR_VECTORS(in, STRESS)
    }
    FOR_VECTORS(in, POSITION)
    *found = f;
}

// One for each law, shared by all that update particles.
typedef void finish_lanes(struct batch *b, const struct mpm_particles *s, struct mpm_span_result *r,
                          struct found *found);
#define X(name, keeps)                                                                             \
    __attribute__((noinline)) static void finish_##name(                                           \
        struct batch *b, const struct mpm_particles *s, struct mpm_span_result *r,                 \
        struct found *found) {                                                                     \
        const struct mpm_particles part = *s;                                                      \
        finish(b, &part, r, found, DIM, MPM_LAW_##name);                                           \
    }
MPM_LAWS(X)
#undef X
static finish_lanes *const finish_of[MPM_N_LAWS] = {
#define X(name, keeps) [MPM_LAW_##name] = finish_##name,
    MPM_LAWS(X)
#undef X
};

// eqs. 11-17 from what was gathered; with F-bar, what it will average.
MPM_KERNEL void update(struct batch *b, const struct mpm_span *span, struct mpm_span_result *r,
                       struct found *found, const int dim, const enum mpm_law law,
                       const enum mpm_fbar_scheme scheme) {
    const struct mpm_particles part = *span->s;
    const struct by by = what_by(span);
    const struct extent in = b->in;
    const bool keeps_step = scheme != MPM_FBAR_OFF;
    mpm_vec v2_max = found->v2_max;
#define VELOCITY(whole) update_velocity(b, in, lane, &part, &by, r, &v2_max, dim, keeps_step, whole)
#define DEFORMATION(whole) update_deformation(b, in, lane, &part, &by, r, dim, law, scheme, whole)
    FOR_VECTORS(in, VELOCITY)
    FOR_VECTORS(in, DEFORMATION)
    found->v2_max = v2_max;
    if (scheme == MPM_FBAR_OFF) {
        finish_of[law](b, &part, r, found);
    }
}

// Algorithm 1, steps 4 and 5.
MPM_KERNEL void finish_fbar(struct batch *b, const struct mpm_span *span,
                            struct mpm_span_result *r, struct found *found, const int dim,
                            const enum mpm_law law, const enum mpm_fbar_scheme scheme) {
    const struct mpm_particles part = *span->s;
    const struct by by = what_by(span);
    const struct extent in = b->in;
#define RESCALE(whole) rescale(b, in, lane, &part, &by, r, dim, law, scheme, whole)
    FOR_VECTORS(in, RESCALE)
    finish_of[law](b, &part, r, found);
}

// The records of what the particles give to their nodes. Lanes of other stretches are read, too: P2G
// writes no particles.
MPM_KERNEL void write_records(struct batch *b, const struct mpm_span *span, const int dim) {
    const struct mpm_particles part = *span->s, *s = &part;
    const struct extent in = b->in;
    const bool fbar = span->fbar;
    const double inv_h = span->grid->inv_h;
    const int n_sym = MPM_SYM(dim);
    for (int lane = 0; lane < in.end; lane += MPM_LANES) {
        const mpm_vec V = fetch(in, lane, s->V, 1, 0, 0, true), zero = mpm_splat(0);
        const mpm_vec m = s->density * fetch(in, lane, s->V0, 1, 0, 0, true);
        mpm_vec mv[3], f[6];
        UNROLL for (int d = 0; d < dim; d++) {
            mv[d] = m * fetch(in, lane, s->v, dim, d, 0, true);
        }
        const mpm_vec minus_V_over_h = V * -inv_h, V_fbar = fbar ? V : zero;
        UNROLL for (int k = 0; k < n_sym; k++) { // xx yy zz xy (yz zx); in 2D zz acts on no node
            f[k] = dim == 2 && k == 2
                       ? zero
                       : minus_V_over_h * fetch(in, lane, s->sigma, n_sym, k, 0, true);
        }
        if (dim == 2) {
            const mpm_vec record[8] = {m, mv[0], mv[1], V_fbar, f[0], f[3], f[3], f[1]};
            mpm_transpose(record, &b->record[lane][0], 16);
        } else {
            const mpm_vec record[8] = {m, mv[0], mv[1], mv[2], f[0], f[3], f[5], V_fbar};
            const mpm_vec rest[8] = {f[5], f[4], f[2], zero, f[3], f[1], f[4], zero};
            mpm_transpose(record, &b->record[lane][0], 16);
            mpm_transpose(rest, &b->record[lane][8], 16);
        }
    }
}

// ---- The kernels ----

// The batches of a stretch: whole blocks of particles, of which some lanes at the ends of a row
// belong to other stretches.
#define FOR_BATCHES(b, span)                                                                       \
    for (size_t first_ = (span)->begin / MPM_BLOCK * MPM_BLOCK;                                    \
         first_ < (span)->end && batch_at((b), (span), first_);                                    \
         first_ += (size_t)(b)->in.end)

MPM_KERNEL bool batch_at(struct batch *b, const struct mpm_span *span, size_t first) {
    const size_t left = span->end - first;
    b->in = (struct extent){
        .first = first,
        .begin = span->begin > first ? (int)(span->begin - first) : 0,
        .end = left <= MOST ? (int)left : BATCH,
        .next = left <= MOST ? span->next / MPM_BLOCK * MPM_BLOCK : first + BATCH,
    };
    return true;
}

MPM_KERNEL void p2g(const struct mpm_span *span, struct mpm_span_result *r, const int dim,
                    const enum mpm_basis basis) {
    struct batch b;
    *r = mpm_nothing_found();
    FOR_BATCHES(&b, span) {
        STAGE(1) find_cells(&b, span, dim, basis);
        STAGE(2) find_nodes(&b, span->grid, dim, basis);
        STAGE(3) write_weights(&b, span->s, dim, basis, true);
        STAGE(4) write_records(&b, span, dim);
        STAGE(5) scatter_records(&b, span->grid, dim, basis);
        r->n_runs += (uint32_t)b.n_runs;
    }
}

typedef void update_lanes(struct batch *b, const struct mpm_span *span, struct mpm_span_result *r,
                          struct found *found);

// By law and scheme, the same for every basis.
#define DEFINE_UPDATE(name, S)                                                                     \
    static void update_##name##_##S(struct batch *b, const struct mpm_span *span,                  \
                                    struct mpm_span_result *r, struct found *found) {              \
        update(b, span, r, found, DIM, MPM_LAW_##name, MPM_FBAR_##S);                              \
    }
#define DEFINE_FINISH(name, S)                                                                     \
    static void fbar_##name##_##S(struct batch *b, const struct mpm_span *span,                  \
                                    struct mpm_span_result *r, struct found *found) {              \
        finish_fbar(b, span, r, found, DIM, MPM_LAW_##name, MPM_FBAR_##S);                         \
    }
#define X(name, keeps)                                                                             \
    DEFINE_UPDATE(name, OFF)                                                                       \
    DEFINE_UPDATE(name, ZHAO)                                                                      \
    DEFINE_UPDATE(name, ANCHORED)                                                                  \
    DEFINE_FINISH(name, ZHAO)                                                                      \
    DEFINE_FINISH(name, ANCHORED)
MPM_LAWS(X)
#undef X

static update_lanes *const updates[MPM_N_LAWS][MPM_N_FBAR_SCHEMES] = {
#define X(name, keeps)                                                                             \
    [MPM_LAW_##name] = {update_##name##_OFF, update_##name##_ZHAO, update_##name##_ANCHORED},
    MPM_LAWS(X)
#undef X
};
static update_lanes *const finishes[MPM_N_LAWS][MPM_N_FBAR_SCHEMES] = {
#define X(name, keeps)                                                                             \
    [MPM_LAW_##name] = {NULL, fbar_##name##_ZHAO, fbar_##name##_ANCHORED},
    MPM_LAWS(X)
#undef X
};

MPM_KERNEL void g2p(const struct mpm_span *span, struct mpm_span_result *r, const int dim,
                    const enum mpm_basis basis) {
    const enum mpm_fbar_scheme scheme = span->fbar ? span->scheme : MPM_FBAR_OFF;
    update_lanes *const update_batch = updates[span->s->law][scheme];
    struct batch b;
    struct found found;
    found_nothing(&found);
    *r = mpm_nothing_found();
    FOR_BATCHES(&b, span) {
        STAGE(1) find_cells(&b, span, dim, basis);
        STAGE(2) find_nodes(&b, span->grid, dim, basis);
        STAGE(3) gather(&b, span, dim, basis, 0);
        STAGE(4) update_batch(&b, span, r, &found);
        STAGE(5) {
            if (scheme != MPM_FBAR_OFF) {
                write_weights(&b, span->s, dim, basis, false);
                find_rows(&b, dim, basis);
            }
        }
        STAGE(6) {
            if (scheme == MPM_FBAR_ZHAO) {
                scatter_ratios(&b, span->grid, dim, basis);
            } else if (scheme == MPM_FBAR_ANCHORED) {
                scatter_pairs(&b, span->grid, dim, basis);
            }
        }
    }
    found_all(&found, r, dim);
}

MPM_KERNEL void fbar(const struct mpm_span *span, struct mpm_span_result *r, const int dim,
                     const enum mpm_basis basis, const int scalars) {
    update_lanes *const finish_batch = finishes[span->s->law][span->scheme];
    struct batch b;
    struct found found;
    found_nothing(&found);
    *r = mpm_nothing_found();
    FOR_BATCHES(&b, span) {
        STAGE(1) find_cells(&b, span, dim, basis);
        STAGE(2) find_nodes(&b, span->grid, dim, basis);
        STAGE(3) gather(&b, span, dim, basis, scalars);
        STAGE(4) finish_batch(&b, span, r, &found);
    }
    found_all(&found, r, dim);
}

// eq. 9 with the components of a node in lanes: in 2D those of v^{n+1} and of its increment together.
// Nodes without mass lie among the others where a body ends: a branch would be foretold badly there.
MPM_KERNEL void move_nodes(const struct mpm_grid *grid, uint32_t begin, uint32_t end,
                           const struct mpm_motion *by, const int dim) {
    const size_t nodes = MPM_BLOCK_NODES(dim);
    const double *gravity = by->gravity;
    const mpm_four g = {gravity[0], gravity[1], dim == 3 ? gravity[2] : gravity[0], gravity[1]};
    const mpm_four has_v = {1, 1, 0, 0};
    const struct mpm_motion copy = *by;
    for (size_t i = begin * nodes; i < end * nodes; i++) {
        const double *node = grid->node + i * MPM_NODE, m = node[0];
        double *velocity = grid->velocity + i * (size_t)MPM_VELOCITY(dim);
        const mpm_four sums = mpm_load_four(node), force = mpm_load_four(node + MPM_NODE_FORCE);
        const double r = m > 0 ? 1 / m : 0;
        const mpm_four mv = dim == 2 ? __builtin_shufflevector(sums, sums, 1, 2, 1, 2)
                                     : __builtin_shufflevector(sums, sums, 1, 2, 3, 3);
        const mpm_four v = mv * r;
        mpm_four f = dim == 2 ? __builtin_shufflevector(force, force, 0, 1, 0, 1) : force;
        f += m * g;
        for (int d = 0; copy.local != 0 && d < 4; d++) { // sign(0) = 0
            f[d] -= v[d] != 0 ? copysign(copy.local * fabs(f[d]), v[d]) : 0;
        }
        f -= copy.mass * mv;
        const mpm_four dv = copy.dt * f * r;
        if (dim == 2) {
            mpm_store_four(velocity, v * has_v + dv);
            continue;
        }
        const mpm_four now = v + dv;
        UNROLL for (int d = 0; d < dim; d++) {
            velocity[d] = now[d];
            velocity[dim + d] = dv[d];
        }
    }
}

// eq. 20's averages: four nodes at a time.
MPM_KERNEL void divide_nodes(const struct mpm_grid *grid, uint32_t begin, uint32_t end,
                             const int dim, const int scalars) {
    const size_t nodes = MPM_BLOCK_NODES(dim);
    const double *volume = grid->node + MPM_NODE_VOLUME(dim);
    double *fbar = grid->fbar;
    for (size_t i = begin * nodes; i < end * nodes; i += 4) {
        const mpm_four at = {volume[i * MPM_NODE], volume[(i + 1) * MPM_NODE],
                             volume[(i + 2) * MPM_NODE], volume[(i + 3) * MPM_NODE]};
        const mpm_four V = mpm_positive_or_one(at);
        double *sums = fbar + i * (size_t)scalars;
        if (scalars == 1) {
            mpm_store_four(sums, mpm_load_four(sums) / V);
        } else {
            mpm_store_four(sums, mpm_load_four(sums) / __builtin_shufflevector(V, V, 0, 0, 1, 1));
            mpm_store_four(sums + 4,
                           mpm_load_four(sums + 4) / __builtin_shufflevector(V, V, 2, 2, 3, 3));
        }
    }
}

#ifdef MPM_STAGES
#define BASES(X) X(BSPLINE2)
#define NAME_OF(isa, dim) bench_kernels_##isa##_##dim##d
#else
#define BASES(X) X(LINEAR) X(GIMP) X(BSPLINE2) X(BSPLINE3)
#define NAME_OF(isa, dim) mpm_kernels_##isa##_##dim##d
#endif
#define DEFINE(B)                                                                                  \
    static void p2g_##B(const struct mpm_span *span, struct mpm_span_result *r) {                  \
        p2g(span, r, DIM, MPM_##B);                                                                \
    }                                                                                              \
    static void g2p_##B(const struct mpm_span *span, struct mpm_span_result *r) {                  \
        g2p(span, r, DIM, MPM_##B);                                                                \
    }                                                                                              \
    static void fbar_##B(const struct mpm_span *span, struct mpm_span_result *r) {                 \
        if (span->scheme == MPM_FBAR_ZHAO) {                                                       \
            fbar(span, r, DIM, MPM_##B, 1);                                                        \
        } else {                                                                                   \
            fbar(span, r, DIM, MPM_##B, 2);                                                        \
        }                                                                                          \
    }
BASES(DEFINE)

static void move_nodes_of(const struct mpm_grid *grid, uint32_t begin, uint32_t end,
                          const struct mpm_motion *motion) {
    move_nodes(grid, begin, end, motion, DIM);
}

static void divide_nodes_of(const struct mpm_grid *grid, uint32_t begin, uint32_t end) {
    if (grid->fbar_stride == 1) {
        divide_nodes(grid, begin, end, DIM, 1);
    } else {
        divide_nodes(grid, begin, end, DIM, 2);
    }
}

#define ENTRY(B)                                                                                   \
    [MPM_##B] = {.p2g = p2g_##B,                                                                   \
                 .move_nodes = move_nodes_of,                                                      \
                 .g2p = g2p_##B,                                                                   \
                 .divide_nodes = divide_nodes_of,                                                  \
                 .fbar = fbar_##B},
#define NAME(isa, dim) NAME_OF(isa, dim)
#if MPM_LANES == 4
const struct mpm_kernels NAME(avx2, DIM)[MPM_N_BASES] = {BASES(ENTRY)};
#else
const struct mpm_kernels NAME(avx512, DIM)[MPM_N_BASES] = {BASES(ENTRY)};
#endif
