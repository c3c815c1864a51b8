// A pass of a step: one kernel over all particles of a body, by the threads of a team side by side.
//
// Passes that add to the grid go by stretches, which wait for each other as the order of every
// node's sum wants it; others by chunks of them, so that sums of what particles find have one
// order, too (order.h). Nothing that is computed depends on how many threads there are, on what
// they have got through, or on who does what.
#pragma once
#include "server/mpm/sim.h"

// What a thread knows of a step.
struct mpm_step_work {
    struct mpm_sim *sim;
    struct mpm_plan plan;
    unsigned number; // of the last pass that added to the grid
    int pass;        // of the step, from 0; a body's own
};

// Arrays of the grid.
enum { MPM_USES_SUMS = 1, MPM_USES_VELOCITY = 2, MPM_USES_FBAR = 4 };

struct mpm_pass {
    void (*work)(const struct mpm_span *span, struct mpm_span_result *result);
    unsigned uses; // arrays of the grid, as bits
    bool adds;     // to the grid
};

// After a sort, for another number of threads, and now and then: shares particles, nodes and walls
// out among the threads of the team, by their speeds since the last time.
void mpm_share_out(struct mpm_sim *sim);
// Thread `own` of `there`: its share of a pass over a body; one body comes after the other. What is
// found stays with the threads until the step is over.
void mpm_pass(struct mpm_step_work *step, size_t body, const struct mpm_pass *pass, int own,
              int there);
// What all have found in the step: of faults the first pass' first, by its particle's id; and the
// sums, in the order of the chunks.
void mpm_join_found(const struct mpm_sim *sim, struct mpm_span_result *joined);
// Whether the nodes in use are too many to stay in a core's cache from pass to pass: then they are
// fetched a stretch ahead.
bool mpm_grid_is_far(const struct mpm_grid *g);
// s; 0 where the definition has no clock.
double mpm_now_or_zero(const struct mpm_sim *sim);
