// The mean stress as it is shown, not as it is used: averaged over the grid.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct mpm_sim;

struct mpm_smooth_node {
    int32_t at[3], used; // cells from the grid's origin; 0: the place is free
    double V, V_p;       // m^3, and m^3 Pa
};

struct mpm_smooth {
    struct mpm_smooth_node *nodes; // open addressing; as many as are reached take at most half
    size_t capacity, n;            // a power of two; in use
    double *value;                 // (n_particles) Pa, by id
    uint64_t step;                 // that `value` is of, plus one; 0: none
};

// Brings `value` up to date with the particles, if it is not. In a scene that does not ask for the
// field it is never called, and nothing is ever taken. Without memory, all values are NaN or, if
// there is none for them either, `value` is NULL.
void mpm_smooth_update(const struct mpm_sim *sim);
void mpm_smooth_free(struct mpm_smooth *smooth);
// What is held now; and what will be for n_particles that reach n_nodes, while the table grows to
// that.
size_t mpm_smooth_bytes(const struct mpm_smooth *smooth);
size_t mpm_smooth_estimate(size_t n_nodes, size_t n_particles);
