// Filling shapes: exact counts and places, whatever the domain's corner and the unit of length.
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "server/mpm/seed.h"

static void near_at(double a, double b, double tol, int line) {
    if (!(fabs(a - b) <= tol)) {
        print_error("%.17g is not within %g of %.17g\n", a, tol, b);
        _fail(__FILE__, line);
    }
}
#define assert_near(a, b, tol) near_at(a, b, tol, __LINE__)

// A domain of 10 cells a side with its corner at `corner`, lengths times `scale`.
static struct mpm_def domain(int dim, double h, const double *corner) {
    struct mpm_def def = mpm_def_default();
    def.dimension = dim;
    def.cell = h;
    for (int d = 0; d < dim; d++) {
        def.domain_min[d] = corner[d];
        def.domain_max[d] = corner[d] + 10 * h;
    }
    return def;
}

static const double zero[3] = {0};

static struct mpm_shape box(double x0, double y0, double x1, double y1) {
    return (struct mpm_shape){.kind = MPM_SHAPE_BOX, .min = {x0, y0}, .max = {x1, y1}};
}

static size_t count(const struct mpm_def *def, const struct mpm_shape *shape, int n, bool closed) {
    const struct mpm_body_def body = {
        .shape = *shape, .particles_per_direction = n, .closed = closed};
    const size_t found = mpm_seed(def, &body, NULL, NULL);
    assert_true((double)found <= mpm_seed_bound(def, &body)); // memory is planned with it
    return found;
}

static void test_seed_fills_whole_cells(void **state) {
    (void)state;
    for (int n = 1; n <= 6; n++) {
        const struct mpm_def flat = domain(2, 0.1, zero), solid = domain(3, 0.1, zero);
        // Edges at multiples of 0.1, which are not exact in binary.
        const struct mpm_shape a = box(0.1, 0.3, 0.7, 0.5);
        assert_int_equal(count(&flat, &a, n, false), 6 * 2 * n * n);
        assert_int_equal(count(&flat, &a, n, true), 6 * 2 * n * n);
        const struct mpm_shape b = {
            .kind = MPM_SHAPE_BOX, .min = {0.1, 0.3, 0.2}, .max = {0.7, 0.5, 0.3}};
        assert_int_equal(count(&solid, &b, n, false), 6 * 2 * n * n * n);
    }
}

// Edges through lattice points: `closed` takes the points on them, open does not.
static void test_seed_edges_are_open_or_closed(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 0.2, zero);
    const struct mpm_shape a = box(0.25, 0.25, 0.65, 0.45); // points at 0.05 + 0.1 k
    assert_int_equal(count(&def, &a, 2, false), 3 * 1);
    assert_int_equal(count(&def, &a, 2, true), 5 * 3);
    // One round-off to either side changes nothing.
    const struct mpm_shape b =
        box(nextafter(0.25, 0), nextafter(0.25, 1), nextafter(0.65, 1), nextafter(0.45, 0));
    assert_int_equal(count(&def, &b, 2, false), 3 * 1);
    assert_int_equal(count(&def, &b, 2, true), 5 * 3);
}

static void test_seed_combines_shapes(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 1, zero);
    const struct mpm_shape parts[] = {box(1, 1, 5, 5), box(3, 3, 7, 7)};
    struct mpm_shape both = {.kind = MPM_SHAPE_UNION, .n_children = 2, .children = parts};
    assert_int_equal(count(&def, &both, 2, false), 4 * (16 + 16 - 4)); // the overlap once
    both.kind = MPM_SHAPE_INTERSECTION;
    assert_int_equal(count(&def, &both, 2, false), 4 * 4);
    both.kind = MPM_SHAPE_DIFFERENCE;
    assert_int_equal(count(&def, &both, 2, false), 4 * (16 - 4));

    // A seam through lattice points: an open union leaves them out, a closed one has them once; a
    // closed difference keeps the cut's edge, so that the two parts of a cut make up the whole.
    const struct mpm_shape halves[] = {box(0, 0, 2.25, 4), box(2.25, 0, 4, 4)};
    both = (struct mpm_shape){.kind = MPM_SHAPE_UNION, .n_children = 2, .children = halves};
    assert_int_equal(count(&def, &both, 2, true), 64);
    assert_int_equal(count(&def, &both, 2, false), 64 - 8);
    const struct mpm_shape cut[] = {box(0, 0, 4, 4), box(2.25, 0, 9, 9)};
    both = (struct mpm_shape){.kind = MPM_SHAPE_DIFFERENCE, .n_children = 2, .children = cut};
    assert_int_equal(count(&def, &both, 2, true), 5 * 8);
    assert_int_equal(count(&def, &both, 2, false), 4 * 8);

    // A union inside a difference.
    const struct mpm_shape holes[] = {box(1, 1, 2, 2), box(3, 1, 4, 2)};
    const struct mpm_shape nested[] = {
        box(0, 0, 5, 3), {.kind = MPM_SHAPE_UNION, .n_children = 2, .children = holes}};
    both = (struct mpm_shape){.kind = MPM_SHAPE_DIFFERENCE, .n_children = 2, .children = nested};
    assert_int_equal(count(&def, &both, 3, false), 9 * 13);
}

static void test_seed_of_nothing_is_empty(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 1, zero);
    const struct mpm_shape apart[] = {box(1, 1, 2, 2), box(3, 3, 4, 4)};
    const struct mpm_shape meet = {
        .kind = MPM_SHAPE_INTERSECTION, .n_children = 2, .children = apart};
    assert_int_equal(count(&def, &meet, 2, true), 0);
    const struct mpm_shape none = {.kind = MPM_SHAPE_UNION};
    assert_int_equal(count(&def, &none, 2, true), 0);
    const struct mpm_shape thin = box(1, 1, 2, 1.1); // between the rows at 0.75 and 1.25
    assert_int_equal(count(&def, &thin, 2, true), 0);
}

// The number of lattice points in a ball times their volume is its volume, up to half a spacing
// along its surface.
static void test_seed_ball_has_its_volume(void **state) {
    (void)state;
    const struct mpm_shape ball = {
        .kind = MPM_SHAPE_BALL, .centre = {0.51, 0.48, 0.5}, .radius = 0.3};
    for (int n = 1; n <= 8; n++) {
        const struct mpm_def flat = domain(2, 0.1, zero), solid = domain(3, 0.1, zero);
        const double spacing = 0.1 / n;
        assert_near((double)count(&flat, &ball, n, false) * spacing * spacing, M_PI * 0.09,
                    M_PI * 0.6 * spacing / 2);
        assert_near((double)count(&solid, &ball, n, false) * pow(spacing, 3),
                    4.0 / 3 * M_PI * 0.027, 4 * M_PI * 0.09 * spacing / 2);
    }
}

// A ball whose surface goes through lattice points: 3-4-5 triangles, in half spacings.
static void test_seed_ball_edge_is_open_or_closed(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 0.2, zero);
    // Centre on a lattice point, radius 5 spacings: 81 points within, 12 of them on the circle.
    const struct mpm_shape ball = {.kind = MPM_SHAPE_BALL, .centre = {1.05, 1.05}, .radius = 0.5};
    assert_int_equal(count(&def, &ball, 2, true), 81);
    assert_int_equal(count(&def, &ball, 2, false), 69);
}

struct list {
    double x[4096][3], volume[4096];
    size_t n, stop;
    int dim;
};
static bool append(void *context, const double *x, double volume) {
    struct list *list = context;
    memcpy(list->x[list->n], x, (size_t)list->dim * sizeof *x);
    list->volume[list->n++] = volume;
    return list->n != list->stop;
}
static struct list lists[2];

static void seed(struct list *list, const struct mpm_def *def, const struct mpm_shape *shape,
                 int n) {
    const struct mpm_body_def body = {.shape = *shape, .particles_per_direction = n};
    *list = (struct list){.dim = def->dimension};
    const size_t n_seeded = mpm_seed(def, &body, append, list);
    assert_int_equal(n_seeded, list->n);
}

static void test_seed_places_cell_centred_lattice(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 1, zero);
    const struct mpm_shape a = box(2, 3, 4, 4);
    seed(&lists[0], &def, &a, 2);
    assert_int_equal(lists[0].n, 8);
    for (int i = 0; i < 4; i++) { // the last direction is the fastest
        for (int j = 0; j < 2; j++) {
            assert_near(lists[0].x[2 * i + j][0], 2.25 + 0.5 * i, 0);
            assert_near(lists[0].x[2 * i + j][1], 3.25 + 0.5 * j, 0);
            assert_near(lists[0].volume[2 * i + j], 0.25, 0);
        }
    }
}

// A shape with all kinds in it, for the tests of invariance.
static void shift_and_scale(struct mpm_shape out[4], const double *corner, double scale) {
    out[0] = box(0.1, 0.2, 0.8, 0.7);
    out[1] = (struct mpm_shape){.kind = MPM_SHAPE_BALL, .centre = {0.4, 0.4}, .radius = 0.15};
    for (int k = 0; k < 2; k++) {
        for (int d = 0; d < 2; d++) {
            out[k].min[d] = corner[d] + scale * out[k].min[d];
            out[k].max[d] = corner[d] + scale * out[k].max[d];
            out[k].centre[d] = corner[d] + scale * out[k].centre[d];
        }
        out[k].radius *= scale;
    }
    out[2] = (struct mpm_shape){.kind = MPM_SHAPE_DIFFERENCE, .n_children = 2, .children = out};
}

static void test_seed_does_not_depend_on_the_corner(void **state) {
    (void)state;
    const double corners[][3] = {{-3.7, 100.3}, {1e4 / 3, -1e4 / 7}, {-0.1, -0.9}};
    struct mpm_shape here[4], there[4];
    shift_and_scale(here, zero, 1);
    for (int n = 1; n <= 4; n++) {
        const struct mpm_def def = domain(2, 0.1, zero);
        seed(&lists[0], &def, &here[2], n);
        for (size_t c = 0; c < sizeof corners / sizeof *corners; c++) {
            const struct mpm_def moved = domain(2, 0.1, corners[c]);
            shift_and_scale(there, corners[c], 1);
            seed(&lists[1], &moved, &there[2], n);
            assert_int_equal(lists[1].n, lists[0].n);
            for (size_t p = 0; p < lists[0].n; p++) {
                for (int d = 0; d < 2; d++) { // round-off of the corner's coordinates
                    assert_near(lists[1].x[p][d] - corners[c][d], lists[0].x[p][d], 1e-11);
                }
            }
        }
    }
}

// Powers of two are exact, so every bit but the exponent is the same.
static void test_seed_scales_exactly(void **state) {
    (void)state;
    struct mpm_shape here[4], there[4];
    shift_and_scale(here, zero, 1);
    for (int k = -30; k <= 30; k += 15) {
        const double scale = ldexp(1, k);
        const struct mpm_def def = domain(2, 0.1, zero), scaled = domain(2, 0.1 * scale, zero);
        shift_and_scale(there, zero, scale);
        seed(&lists[0], &def, &here[2], 3);
        seed(&lists[1], &scaled, &there[2], 3);
        assert_int_equal(lists[1].n, lists[0].n);
        assert_true(lists[0].n > 100);
        for (size_t p = 0; p < lists[0].n; p++) {
            assert_true(lists[1].x[p][0] == scale * lists[0].x[p][0]);
            assert_true(lists[1].x[p][1] == scale * lists[0].x[p][1]);
            assert_true(lists[1].volume[p] == scale * scale * lists[0].volume[p]);
        }
    }
}

static void test_seed_takes_points_as_they_are(void **state) {
    (void)state;
    const double points[] = {0.1, 0.2, 1e-3, 0.3, 0.25, 2e-3, 0.55, 0.5, 3e-3};
    const struct mpm_shape shape = {.kind = MPM_SHAPE_POINTS, .n_points = 3, .points = points};
    const struct mpm_def def = domain(2, 0.1, zero);
    seed(&lists[0], &def, &shape, 2);
    assert_int_equal(lists[0].n, 3);
    for (int p = 0; p < 3; p++) {
        assert_near(lists[0].x[p][0], points[3 * p], 0);
        assert_near(lists[0].x[p][1], points[3 * p + 1], 0);
        assert_near(lists[0].volume[p], points[3 * p + 2], 0);
    }
    assert_int_equal(count(&def, &shape, 2, false), 3);
}

static void test_seed_stops_when_told(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 1, zero);
    const struct mpm_body_def body = {.shape = box(0, 0, 4, 4), .particles_per_direction = 2};
    lists[0] = (struct list){.dim = 2, .stop = 5};
    mpm_seed(&def, &body, append, &lists[0]);
    assert_int_equal(lists[0].n, 5);
}

// Sides are told apart whatever the sign of the coordinates, with a margin at the edge.
static void test_seed_shape_contains_a_point(void **state) {
    (void)state;
    const struct mpm_shape shape = box(-1, -2, 1, 2);
    const double inside[] = {-0.9, 1.9}, edge[] = {1, 0}, outside[] = {0, 2.1};
    assert_true(mpm_shape_contains(&shape, inside, 2, 0.05));
    assert_false(mpm_shape_contains(&shape, edge, 2, 0.05));
    assert_false(mpm_shape_contains(&shape, outside, 2, 0.05));
}

static void test_seed_velocity_fields(void **state) {
    (void)state;
    double v[3];
    const double x[3] = {3, 5, 7};
    struct mpm_velocity field = {.kind = MPM_VELOCITY_UNIFORM, .vector = {1, 2, 3}};
    mpm_velocity_at(&field, x, 3, v);
    assert_near(v[0], 1, 0), assert_near(v[1], 2, 0), assert_near(v[2], 3, 0);

    field = (struct mpm_velocity){
        .kind = MPM_VELOCITY_ROTATION, .centre = {1, 1, 1}, .rate = 2, .vector = {0, 0, 1}};
    mpm_velocity_at(&field, x, 2, v);
    assert_near(v[0], -8, 0), assert_near(v[1], 4, 0);
    mpm_velocity_at(&field, x, 3, v); // about z: the same, and nothing along z
    assert_near(v[0], -8, 0), assert_near(v[1], 4, 0), assert_near(v[2], 0, 0);
    field.vector[0] = 1, field.vector[2] = 0; // about x
    mpm_velocity_at(&field, x, 3, v);
    assert_near(v[0], 0, 0), assert_near(v[1], -12, 0), assert_near(v[2], 8, 0);

    field = (struct mpm_velocity){.kind = MPM_VELOCITY_MODE,
                                  .axis = 1,
                                  .number = 2,
                                  .from = 1,
                                  .length = 6,
                                  .amplitude = 0.5};
    mpm_velocity_at(&field, x, 2, v); // sin(3 pi/2 * 4/6) = sin(pi)
    assert_near(v[0], 0, 0), assert_near(v[1], 0, 1e-15);
    const double end[] = {0, 7};
    mpm_velocity_at(&field, end, 2, v); // a free end is an antinode
    assert_near(v[1], -0.5, 1e-15);
}

// The quick bound must hold, and must not be silly.
static void test_seed_bound_is_close(void **state) {
    (void)state;
    const struct mpm_def def = domain(3, 0.1, zero);
    const struct mpm_body_def body = {
        .shape = {.kind = MPM_SHAPE_BOX, .min = {0.2, 0.2, 0.2}, .max = {0.8, 0.8, 0.8}},
        .particles_per_direction = 4};
    const double n = (double)mpm_seed(&def, &body, NULL, NULL);
    assert_true(mpm_seed_bound(&def, &body) >= n && mpm_seed_bound(&def, &body) < 2 * n);
}

// ---- Polygons, extrusions, cylinders
// -------------------------------------------------------------

static struct mpm_shape polygon(const double *points, size_t n) {
    return (struct mpm_shape){.kind = MPM_SHAPE_POLYGON, .n_points = n, .points = points};
}

// The same outline run through the other way, and from another vertex.
static void turned(const double *points, size_t n, size_t from, bool back, double *out) {
    for (size_t k = 0; k < n; k++) {
        const size_t j = (from + (back ? n - k : k)) % n;
        memcpy(out + 2 * k, points + 2 * j, 2 * sizeof *out);
    }
}

// Every orientation and first vertex of an outline gives this count.
static void assert_counts(const struct mpm_def *def, const double *points, size_t n_points, int n,
                          size_t open, size_t closed) {
    double list[32];
    for (size_t from = 0; from < n_points; from++) {
        for (int back = 0; back < 2; back++) {
            turned(points, n_points, from, back, list);
            const struct mpm_shape shape = polygon(list, n_points);
            assert_int_equal(count(def, &shape, n, false), open);
            assert_int_equal(count(def, &shape, n, true), closed);
        }
    }
}

// Cook's membrane, the paper's 5,776 and 23,072 with the slanted edges' own points. How many points
// lie on those edges is counted here in whole numbers: 44 x = 48 y, 16 x = 48 (y - 44).
static void test_seed_cook_has_the_papers_counts(void **state) {
    (void)state;
    const double cook[] = {0, 0, 48, 44, 48, 60, 0, 44};
    const double corners[][3] = {{0, 0}, {0, -4}, {-1.5, -7}, {-100, -1000}};
    for (int k = 0; k < 2; k++) {
        const double h = k ? 0.5 : 1;
        const int per_metre = k ? 8 : 4; // half spacings
        int open = 0, closed = 0;
        for (int i = 1; i < 48 * per_metre; i += 2) {
            for (int j = 1; j < 64 * per_metre; j += 2) {
                const int below = 44 * i - 48 * j, above = 48 * (j - 44 * per_metre) - 16 * i;
                closed += below <= 0 && above <= 0;
                open += below < 0 && above < 0;
            }
        }
        assert_int_equal(closed, k ? 23072 : 5776);
        assert_true(open < closed);
        for (size_t c = 0; c < 4; c++) {
            struct mpm_def def = domain(2, h, corners[c]);
            assert_counts(&def, cook, 4, 2, (size_t)open, (size_t)closed);
        }
    }
    // In another unit, in which the vertices are not exact: the same.
    double small[8];
    for (int k = 0; k < 8; k++) {
        small[k] = 1e-3 * cook[k];
    }
    const struct mpm_def def = domain(2, 1e-3, zero);
    const struct mpm_shape shape = polygon(small, 4);
    assert_int_equal(count(&def, &shape, 2, true), 5776);
}

// The landslide: base 15 m, height 5 m, crest 10 m, 5 m thick, at 0.1 m: 50 columns deep, and the
// face at 45 degrees goes through lattice points, which lie not strictly inside.
static void test_seed_landslide_has_the_papers_count(void **state) {
    (void)state;
    const double outline[] = {0, 0, 15, 0, 10, 5, 0, 5};
    struct mpm_shape shape = {
        .kind = MPM_SHAPE_EXTRUDE, .n_points = 4, .points = outline, .max = {0, 0, 5}};
    const struct mpm_def def = domain(3, 0.2, zero);
    assert_int_equal(count(&def, &shape, 2, false), 311250);
    assert_int_equal(count(&def, &shape, 2, true), 311250 + 50 * 50);
    const struct mpm_def flat = domain(2, 0.2, zero);
    assert_counts(&flat, outline, 4, 2, 6225, 6225 + 50);
    // Ends of the extrusion through lattice points.
    shape.min[2] = 0.05;
    shape.max[2] = 0.25;
    assert_int_equal(count(&def, &shape, 2, false), 6225);
    assert_int_equal(count(&def, &shape, 2, true), 3 * (6225 + 50));
}

// An L, a comb and a star's notch: what a ray meets several times.
static void test_seed_polygons_need_not_be_convex(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 1, zero);
    const double ell[] = {1, 1, 6, 1, 6, 3, 3, 3, 3, 6, 1, 6};
    assert_counts(&def, ell, 6, 2, 4 * (10 + 6), 4 * (10 + 6));
    const double comb[] = {0, 0, 7, 0, 7, 4, 6, 4, 6, 1, 5, 1, 5, 4, 4, 4,
                           4, 1, 3, 1, 3, 4, 2, 4, 2, 1, 1, 1, 1, 4, 0, 4};
    assert_counts(&def, comb, 16, 3, 9 * (7 + 4 * 3), 9 * (7 + 4 * 3));
    // A notch down to (4, 2.875) whose edges go through lattice points: above 2.875 + 2 abs(x - 4).
    const double notch[] = {0, 0, 8, 0, 8, 8, 6.5625, 8, 4, 2.875, 1.4375, 8, 0, 8};
    int open = 0, closed = 0;
    for (int i = 0; i < 32; i++) {
        for (int j = 0; j < 32; j++) {
            const double x = 0.125 + 0.25 * i, y = 0.125 + 0.25 * j;
            const double over = y - (2.875 + 2 * fabs(x - 4)); // exact
            open += over < 0;
            closed += over <= 0;
        }
    }
    assert_counts(&def, notch, 7, 4, (size_t)open, (size_t)closed);
    assert_true(closed > open);
}

// Vertices on lattice points, edges along rows of them, and a tip that touches one.
static void test_seed_polygon_vertices_on_lattice_points(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 0.2, zero); // points at 0.05 + 0.1 k
    const double square[] = {0.25, 0.25, 0.65, 0.25, 0.65, 0.45, 0.25, 0.45};
    assert_counts(&def, square, 4, 2, 3 * 1, 5 * 3);
    const double wedge[] = {0.25, 0.25, 1.05, 0.25, 0.65, 0.65}; // 45 degrees: Pick's theorem
    assert_counts(&def, wedge, 3, 2, 9, 25);
    const double diamond[] = {0.65, 0.25, 1.05, 0.65, 0.65, 1.05, 0.25, 0.65};
    assert_counts(&def, diamond, 4, 2, 25, 41);
    // A vertex in the middle of an edge changes nothing.
    const double more[] = {0.25, 0.25, 0.45, 0.25, 0.65, 0.25, 0.65, 0.45, 0.25, 0.45};
    assert_counts(&def, more, 5, 2, 3 * 1, 5 * 3);
    // One round-off to any side changes nothing.
    double moved[8];
    for (int k = 0; k < 8; k++) {
        moved[k] = nextafter(square[k], k % 3 ? 0 : 1);
    }
    assert_counts(&def, moved, 4, 2, 3 * 1, 5 * 3);
}

static void test_seed_polygon_contains_and_bounds(void **state) {
    (void)state;
    const double wedge[] = {-1, -2, 3, -2, -1, 4};
    const struct mpm_shape shape = polygon(wedge, 3);
    double min[3], max[3];
    assert_true(mpm_shape_bounds(&shape, 2, min, max));
    assert_true(min[0] == -1 && min[1] == -2 && max[0] == 3 && max[1] == 4);
    const double inside[] = {-0.5, 2}, beyond[] = {2, 3}, edge[] = {1, 1};
    assert_true(mpm_shape_contains(&shape, inside, 2, 0.01));
    assert_false(mpm_shape_contains(&shape, beyond, 2, 0.01));
    assert_false(mpm_shape_contains(&shape, edge, 2, 0.01));
}

// A cylinder along any direction has its volume, up to half a spacing of its surface; along an axis
// it is the disk of its circle times the layers.
static void test_seed_cylinder_has_its_volume(void **state) {
    (void)state;
    const struct mpm_def flat = domain(2, 0.1, zero), def = domain(3, 0.1, zero);
    const struct mpm_shape disk = {
        .kind = MPM_SHAPE_BALL, .centre = {0.51, 0.48, 0.5}, .radius = 0.3};
    const double along[][3] = {{0, 0, 0.4}, {0, 0, -0.4}, {0.3, 0.2, 0.3}, {-0.4, 0.1, 0.2}};
    for (int n = 2; n <= 5; n++) {
        struct mpm_shape shape = {.kind = MPM_SHAPE_CYLINDER, .radius = 0.3};
        const double spacing = 0.1 / n;
        for (int axis = 0; axis < 3; axis++) {
            for (int d = 0; d < 3; d++) {
                shape.min[d] = shape.max[d] = d == axis ? 0.2 : d == (axis + 1) % 3 ? 0.51 : 0.48;
            }
            shape.max[axis] = 0.6;
            assert_int_equal(count(&def, &shape, n, false),
                             count(&flat, &disk, n, false) * (size_t)(4 * n));
        }
        for (int k = 0; k < 4; k++) {
            double length = 0;
            for (int d = 0; d < 3; d++) {
                shape.min[d] = 0.5 - along[k][d] / 2;
                shape.max[d] = 0.5 + along[k][d] / 2;
                length += along[k][d] * along[k][d];
            }
            length = sqrt(length);
            const double surface = 2 * M_PI * 0.3 * (length + 0.3);
            assert_near((double)count(&def, &shape, n, false) * pow(spacing, 3),
                        M_PI * 0.09 * length, surface * spacing / 2);
            double min[3], max[3];
            assert_true(mpm_shape_bounds(&shape, 3, min, max));
            for (int d = 0; d < 3; d++) { // the rim's highest points
                const double reach = 0.3 * sqrt(1 - pow(along[k][d] / length, 2));
                assert_near(max[d], 0.5 + fabs(along[k][d]) / 2 + reach, 1e-15);
                assert_near(min[d], 0.5 - fabs(along[k][d]) / 2 - reach, 1e-15);
            }
        }
    }
    // Ends and surface through lattice points: 3-4-5 again, 3 open or 5 closed layers.
    const struct mpm_def coarse = domain(3, 0.2, zero);
    const struct mpm_shape edge = {.kind = MPM_SHAPE_CYLINDER,
                                   .min = {1.05, 1.05, 0.25},
                                   .max = {1.05, 1.05, 0.65},
                                   .radius = 0.5};
    assert_int_equal(count(&coarse, &edge, 2, true), 5 * 81);
    assert_int_equal(count(&coarse, &edge, 2, false), 3 * 69);
}

struct brute {
    const struct mpm_shape *shape;
    double margin;
    struct mpm_region *region;
    size_t count;
};

static bool look_again(void *context, const double *x, double volume) {
    struct brute *b = context;
    (void)volume;
    assert_true(mpm_shape_contains(b->shape, x, 2, b->margin));
    assert_true(mpm_region_contains(b->region, x));
    b->count++;
    return true;
}

// Edges are sorted into bands of height, so that a point looks at few of them: the points are those
// that looking at every edge finds. Stars with corners on lattice points, between them, and far
// out.
static void test_seed_of_many_corners_is_what_each_edge_says(void **state) {
    (void)state;
    const double h = 0.25, spacing = h / 4;
    const struct mpm_def def = domain(2, h, zero); // 40 by 40 lattice points; all exact in binary
    srand(7);
    for (int round = 0; round < 60; round++) {
        const size_t n = 3 + (size_t)(rand() % 150);
        double points[2 * 153];
        for (size_t k = 0; k < n; k++) {
            const double angle = 2 * M_PI * (double)k / (double)n;
            const double r = 0.2 + 1.0 * rand() / RAND_MAX;
            points[2 * k] = 1.25 + r * cos(angle);
            points[2 * k + 1] = 1.25 + r * sin(angle);
            if (round % 3 == 0) // on places of half a spacing: many points lie on edges
                for (size_t d = 0; d < 2; d++)
                    points[2 * k + d] = spacing / 2 * rint(points[2 * k + d] * 2 / spacing);
        }
        struct mpm_shape parts[2] = {
            {.kind = MPM_SHAPE_POLYGON, .points = points, .n_points = n},
            {.kind = MPM_SHAPE_BALL, .centre = {1.25, 1.5}, .radius = 0.3},
        };
        struct mpm_shape shape = {.kind = round % 2 == 0 ? MPM_SHAPE_UNION : MPM_SHAPE_DIFFERENCE,
                                  .children = parts,
                                  .n_children = 2};
        const struct mpm_body_def body = {.shape = shape, .particles_per_direction = 4};
        struct brute b = {.shape = &shape, .margin = spacing / 2};
        b.region = mpm_region_create(&shape, 2, b.margin);
        const size_t found = mpm_seed(&def, &body, look_again, &b);
        assert_int_equal(found, b.count);
        size_t every = 0;
        for (int i = 0; i < 40; i++)
            for (int j = 0; j < 40; j++)
                every += mpm_shape_contains(
                    &shape, (double[2]){(i + 0.5) * spacing, (j + 0.5) * spacing}, 2, b.margin);
        assert_int_equal(b.count, every);
        mpm_region_free(b.region);
    }
}

// ---- Rows: the same sides as point by point -----------------------------------------------------

#define PARTS 5
static double corners[PARTS][2 * 64];

static double random_between(double low, double high) {
    return low + (high - low) * rand() / RAND_MAX;
}

// A place near or on the lattice's: half-spacing multiples, round-off and small amounts beside
// them.
static double random_place(double unit) {
    static const double beside[] = {0, 0, 0, 1e-9, 0.9e-7, 1.1e-7, 1e-4, 3.2e-4, 2e-3};
    const double u = random_between(-4, 44);
    const double off = beside[rand() % 9] * (rand() % 2 ? 1 : -1);
    return unit * (rand() % 3 ? rint(u) + off : u);
}

static struct mpm_shape random_shape(int k, int dim, double unit) {
    struct mpm_shape shape = {.kind = (enum mpm_shape_kind)(rand() % 5),
                              .points = corners[k],
                              .n_points = 3 + (size_t)(rand() % 60),
                              .radius = unit * random_between(2, 30)};
    if (dim == 2 && shape.kind > MPM_SHAPE_POLYGON) {
        shape.kind = MPM_SHAPE_POLYGON;
    } else if (dim == 3 && shape.kind == MPM_SHAPE_POLYGON) {
        shape.kind = MPM_SHAPE_EXTRUDE;
    }
    for (int d = 0; d < 3; d++) {
        shape.min[d] = random_place(unit);
        shape.max[d] = shape.min[d] + unit * (1 + rand() % 40);
        shape.centre[d] = random_place(unit);
    }
    if (rand() % 2) { // a circle through lattice points: 3-4-5 triangles
        shape.radius = 10 * unit;
    }
    for (size_t i = 0; i < 2 * shape.n_points; i++) { // any closed line has an inside, by parity
        corners[k][i] = random_place(unit);
    }
    return shape;
}

// Every side of every row, with and without what makes rows quick, for shapes alone and combined.
static void test_rows_are_what_each_point_says(void **state) {
    (void)state;
    static struct mpm_rows rows, singly;
    size_t on_edge = 0, inside = 0;
    srand(11);
    for (int round = 0; round < 400; round++) {
        const int dim = 2 + round % 2;
        const double unit = 0.125;
        struct mpm_lattice l = {.dim = dim, .unit = unit};
        if (round % 4 > 1) { // as a body sees the particles of another
            l.spacing = round % 8 > 3 ? 2 * unit : 0.3;
            for (int d = 0; d < dim; d++) {
                l.first[d] = round % 16 > 7 ? 0 : 0.123;
            }
        }
        struct mpm_shape parts[PARTS];
        for (int k = 0; k < PARTS; k++) {
            parts[k] = random_shape(k, dim, unit);
        }
        const struct mpm_shape sets[] = {
            {.kind = MPM_SHAPE_UNION, .children = parts, .n_children = 2},
            {.kind = MPM_SHAPE_DIFFERENCE, .children = parts + 2, .n_children = 2}};
        const struct mpm_shape all = {.kind = (enum mpm_shape_kind)(MPM_SHAPE_UNION + round % 3),
                                      .children = sets,
                                      .n_children = 2};
        const struct mpm_shape *shape = round % 5 == 0 ? &all : &parts[round % 5];
        mpm_rows_create(&rows, shape, &l);
        mpm_rows_create(&singly, shape, &l);
        mpm_rows_free(&singly);
        for (long long i = -3; i < 24; i++) {
            for (long long j = -3; j < (dim == 3 ? 24 : -2); j++) {
                const long long index[] = {i, dim == 3 ? j : -3, -3};
                const signed char *quick = mpm_rows_at(&rows, index, 27);
                const signed char *slow = mpm_rows_at(&singly, index, 27);
                for (int k = 0; k < 27; k++) {
                    if (quick[k] != slow[k]) {
                        print_error("round %d: side %d at %lld %lld %d, %d point by point\n", round,
                                    quick[k], i, index[1], k - 3, slow[k]);
                        fail();
                    }
                    on_edge += slow[k] == 0;
                    inside += slow[k] > 0;
                }
            }
        }
        mpm_rows_free(&rows);
    }
    assert_true(on_edge > 1000 && inside > 100000);
}

struct sifted {
    const struct mpm_sieve *sieve;
    size_t count;
};

static bool look_sifted(void *context, const double *x, double volume) {
    struct sifted *o = context;
    const struct mpm_sieve *s = o->sieve;
    (void)volume;
    bool in = mpm_shape_contains(s->shape, x, 2, s->margin) == s->inside;
    for (int d = 0; d < 2; d++) {
        in = in && x[d] >= s->min[d] && x[d] <= s->max[d];
    }
    o->count += in;
    return true;
}

static void test_seed_sifted_is_what_each_particle_says(void **state) {
    (void)state;
    const struct mpm_def def = domain(2, 0.25, zero);
    srand(5);
    for (int round = 0; round < 100; round++) {
        const struct mpm_shape shape = random_shape(0, 2, 0.03125),
                               other = random_shape(1, 2, 0.03125);
        const struct mpm_body_def body = {
            .shape = shape, .particles_per_direction = 4, .closed = round % 2};
        struct mpm_sieve sieve = {.has_box = true,
                                  .min = {random_place(0.03125), random_place(0.03125)},
                                  .shape = &other,
                                  .margin = 0.03125,
                                  .inside = round % 4 < 2};
        for (int d = 0; d < 2; d++) {
            sieve.max[d] = sieve.min[d] + random_between(0, 1.2);
        }
        struct sifted o = {.sieve = &sieve};
        mpm_seed(&def, &body, look_sifted, &o);
        assert_int_equal(mpm_seed_sifted(&def, &body, &sieve, NULL, NULL), o.count);
    }
}

int main(int argc, char **argv) {
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_seed_fills_whole_cells),
        cmocka_unit_test(test_seed_edges_are_open_or_closed),
        cmocka_unit_test(test_seed_combines_shapes),
        cmocka_unit_test(test_seed_of_nothing_is_empty),
        cmocka_unit_test(test_seed_ball_has_its_volume),
        cmocka_unit_test(test_seed_ball_edge_is_open_or_closed),
        cmocka_unit_test(test_seed_places_cell_centred_lattice),
        cmocka_unit_test(test_seed_does_not_depend_on_the_corner),
        cmocka_unit_test(test_seed_scales_exactly),
        cmocka_unit_test(test_seed_takes_points_as_they_are),
        cmocka_unit_test(test_seed_stops_when_told),
        cmocka_unit_test(test_seed_shape_contains_a_point),
        cmocka_unit_test(test_seed_velocity_fields),
        cmocka_unit_test(test_seed_bound_is_close),
        cmocka_unit_test(test_seed_cook_has_the_papers_counts),
        cmocka_unit_test(test_seed_landslide_has_the_papers_count),
        cmocka_unit_test(test_seed_polygons_need_not_be_convex),
        cmocka_unit_test(test_seed_polygon_vertices_on_lattice_points),
        cmocka_unit_test(test_seed_polygon_contains_and_bounds),
        cmocka_unit_test(test_seed_cylinder_has_its_volume),
        cmocka_unit_test(test_seed_of_many_corners_is_what_each_edge_says),
        cmocka_unit_test(test_rows_are_what_each_point_says),
        cmocka_unit_test(test_seed_sifted_is_what_each_particle_says),
    };
    cmocka_set_test_filter(argc > 1 ? argv[1] : NULL);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
