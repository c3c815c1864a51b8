// Interpolation in a table: a plane through the nearest points, weighted by 1/distance^2. Exact for
// linear fields; four points of a square lattice seen from their centre give their mean.
#include "server/mpm/table.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MOST 8    // 2^3 nearest points
#define HERE 1e-6 // spacings: a point so near is the place itself (digits of a printed table)
#define FLAT 1e-9 // of the largest pivot: the nearest points lie on a line, and the mean must do

struct entry {
    double x;
    size_t k;
};

static int by_x(const void *one, const void *other) {
    const struct entry *a = one, *b = other;
    return a->x != b->x ? (a->x > b->x) - (a->x < b->x) : (a->k > b->k) - (a->k < b->k);
}

bool mpm_table_create(struct mpm_table *table, const struct mpm_against *of, size_t width) {
    const size_t axes = (size_t)of->n_axes;
    double volume = 1;
    *table = (struct mpm_table){.of = of, .width = width};
    for (size_t d = 0; d < axes; d++) {
        double min = INFINITY, max = -INFINITY;
        for (size_t k = 0; k < of->n; k++) {
            min = fmin(min, of->points[k * axes + d]);
            max = fmax(max, of->points[k * axes + d]);
        }
        volume *= max - min;
    }
    const double gaps = fmax(pow((double)of->n, 1.0 / of->n_axes) - 1, 1);
    table->spacing = pow(volume, 1.0 / of->n_axes) / gaps;
    struct entry *entries = calloc(of->n + 1, sizeof *entries);
    table->order = calloc(of->n + 1, sizeof *table->order);
    if (!entries || !table->order) {
        free(entries);
        mpm_table_free(table);
        return false;
    }
    for (size_t k = 0; k < of->n; k++) {
        entries[k] = (struct entry){of->points[k * axes], k};
    }
    qsort(entries, of->n, sizeof *entries, by_x);
    for (size_t k = 0; k < of->n; k++) {
        table->order[k] = entries[k].k;
    }
    free(entries);
    return true;
}

void mpm_table_free(struct mpm_table *table) {
    free(table->order);
    *table = (struct mpm_table){0};
}

struct nearest {
    size_t n, most, k[MOST];
    double r2[MOST]; // ascending
};

static void consider(struct nearest *near, size_t k, double r2) {
    size_t place = near->most - 1;
    if (near->n < near->most) {
        place = near->n++;
    } else if (r2 >= near->r2[place]) {
        return;
    }
    for (; place > 0 && near->r2[place - 1] > r2; place--) {
        near->r2[place] = near->r2[place - 1];
        near->k[place] = near->k[place - 1];
    }
    near->r2[place] = r2;
    near->k[place] = k;
}

// Considers a point; false where its first coordinate alone is too far away.
static bool look_at(const struct mpm_table *table, size_t k, const double *X,
                    struct nearest *near) {
    const struct mpm_against *of = table->of;
    const size_t axes = (size_t)of->n_axes;
    double r2 = 0;
    for (size_t d = 0; d < axes; d++) {
        const double e = of->points[k * axes + d] - X[of->axis[d]];
        r2 += e * e;
        if (d == 0 && near->n == near->most && r2 > near->r2[near->most - 1]) {
            return false;
        }
    }
    consider(near, k, r2);
    return true;
}

// Both ways from X along the first coordinate, until no point can be nearer than those found.
static struct nearest find_nearest(const struct mpm_table *table, const double *X) {
    const struct mpm_against *of = table->of;
    const size_t axes = (size_t)of->n_axes;
    struct nearest near = {.most = (size_t)1 << axes};
    size_t low = 0, high = of->n;
    while (low < high) {
        const size_t middle = (low + high) / 2;
        if (of->points[table->order[middle] * axes] < X[of->axis[0]]) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    for (size_t j = low; j < of->n && look_at(table, table->order[j], X, &near); j++) {
    }
    for (size_t j = low; j > 0 && look_at(table, table->order[j - 1], X, &near); j--) {
    }
    return near;
}

// Solves the n x n symmetric system A x = b in place, by elimination with pivots. False where it is
// singular.
static bool solve(double A[MPM_MAX_DIM + 1][MPM_MAX_DIM + 1], double *b, int n) {
    double largest = 0;
    for (int i = 0; i < n; i++) {
        largest = fmax(largest, fabs(A[i][i]));
    }
    for (int i = 0; i < n; i++) {
        int best = i;
        for (int j = i + 1; j < n; j++) {
            best = fabs(A[j][i]) > fabs(A[best][i]) ? j : best;
        }
        if (!(fabs(A[best][i]) > FLAT * largest)) {
            return false;
        }
        for (int j = 0; j < n; j++) {
            const double swap = A[i][j];
            A[i][j] = A[best][j];
            A[best][j] = swap;
        }
        const double swap = b[i];
        b[i] = b[best];
        b[best] = swap;
        for (int j = i + 1; j < n; j++) {
            const double factor = A[j][i] / A[i][i];
            for (int k = i; k < n; k++) {
                A[j][k] -= factor * A[i][k];
            }
            b[j] -= factor * b[i];
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) {
            b[i] -= A[i][k] * b[k];
        }
        b[i] /= A[i][i];
    }
    return true;
}

bool mpm_table_at(const struct mpm_table *table, const double *X, double *out) {
    const struct mpm_against *of = table->of;
    const size_t axes = (size_t)of->n_axes, width = table->width;
    const struct nearest near = find_nearest(table, X);
    const double scale = table->spacing > 0 ? table->spacing : 1;
    if (near.n == 0 || !(near.r2[0] <= scale * scale)) {
        return false;
    }
    const double *first = of->values + near.k[0] * width;
    if (near.r2[0] <= HERE * HERE * scale * scale || near.n < axes + 1) {
        memcpy(out, first, width * sizeof *out);
        return true;
    }
    for (size_t c = 0; c < width; c++) {
        // Unknowns: the value at X, and the slopes per `scale`.
        double A[MPM_MAX_DIM + 1][MPM_MAX_DIM + 1] = {{0}}, b[MPM_MAX_DIM + 1] = {0};
        double mean = 0, weights = 0;
        for (size_t j = 0; j < near.n; j++) {
            const double value = of->values[near.k[j] * width + c];
            const double w = scale * scale / near.r2[j];
            double row[MPM_MAX_DIM + 1] = {1};
            for (size_t d = 0; d < axes; d++) {
                row[1 + d] = (of->points[near.k[j] * axes + d] - X[of->axis[d]]) / scale;
            }
            for (size_t d = 0; d <= axes; d++) {
                for (size_t e = 0; e <= axes; e++) {
                    A[d][e] += w * row[d] * row[e];
                }
                b[d] += w * row[d] * value;
            }
            mean += w * value;
            weights += w;
        }
        out[c] = solve(A, b, (int)axes + 1) ? b[0] : mean / weights;
    }
    return true;
}
