// The simulation's inside, shared by the files of the solver.
#pragma once
#include <stdatomic.h>

#include "server/mpm/body_force.h"
#include "server/mpm/boundary.h"
#include "server/mpm/compare.h"
#include "server/mpm/contact.h"
#include "server/mpm/fbar.h"
#include "server/mpm/load.h"
#include "server/mpm/order.h"
#include "server/mpm/smooth.h"
#include "server/mpm/transfer.h"

#define MPM_AVERAGE_SLOTS 64 // points of a probe's running integral kept over its averaging window

// Running integral of a probe's value over time, for its moving mean.
struct mpm_average {
    double integral[MPM_MAX_COMPONENTS];
    size_t n, next; // points kept (at most MPM_AVERAGE_SLOTS + 1), place of the next
    double time[MPM_AVERAGE_SLOTS + 1];
    double at[MPM_AVERAGE_SLOTS + 1][MPM_MAX_COMPONENTS];
};

// All of the state that is neither particles nor grid: saved and restored as it is.
struct mpm_clockwork {
    uint64_t step;
    size_t stage;
    // time = anchor + steps_since * dt while dt is fixed, so that it does not gather round-off
    double time, anchor_time, dt;
    uint64_t steps_since_anchor;
    double stage_begin, stage_end, end;        // s; end of the last stage
    double kinetic_max;                        // J, largest of this stage
    double gravity_before[MPM_MAX_DIM];        // m/s^2, where this stage's ramp starts
    struct mpm_settings base;                  // the scene's settings, with the changes made since
    struct mpm_settings now;                   // in force: the base with what the stage states
    double external_work;                      // J
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM]; // m, bounding box of the particles
    double v2_max;                             // (m/s)^2
    // How stale the order of the particles is: 0 = it must be made anew.
    uint64_t is_sorted, steps_since_sort;
    double drift;                // cells, that a particle can have moved since
    uint64_t runs_at_sort, runs; // particles of one cell in a row: after the sort, and now
};

#define MPM_FEW 32 // stretches or chunks: a part of fewer its thread goes through alone

// A thread's part and what the thread has found; cache lines for each.
struct mpm_turn {
    // Which stretch or chunk of the part is next, and the end: if it has MPM_FEW or more. With
    // fewer only the thread knows, and here is left what was of an earlier pass: nothing to take.
    _Alignas(128) _Atomic uint64_t next;
    _Alignas(64) struct mpm_span_result found; // in this step, but for sums
    int fault_pass;                            // if it found a fault: in which pass
    size_t fault_body;                         // and whose particle's
    // Since work was shared out: at work, without waiting, s, and on how many particles, pass by
    // pass.
    double seconds, work;
    double speed, share; // particles a second before that, and its share of all work
};

// What threads do in a step, but for what changes from step to step.
struct mpm_plan {
    bool fbar;            // in force, and some body takes part
    bool forces;          // of loads, body forces or rigid bodies
    bool clears_sums;     // of the nodes, as after a sort
    struct mpm_span span; // settings of the transfers
    struct mpm_motion motion;
};

struct mpm_sim {
    const struct mpm_def *def; // borrowed
    enum mpm_isa isa;
    const struct mpm_kernels *kernels, *plain; // of that instruction set, and of the baseline
    struct mpm_grid grid;
    double exit_min[MPM_MAX_DIM], exit_max[MPM_MAX_DIM]; // m: a particle beyond them has left
    size_t n_sets, n_walls, n_loads, n_rigids, n_particles;
    struct mpm_particles *sets; // one a body
    struct mpm_order *orders;   // one a body
    struct mpm_team *team;
    struct mpm_sorter sorter;
    struct mpm_turn *turns; // (n_threads)
    uint32_t *parts;        // (n_sets, n_threads + 1) first chunk of each thread's part of a body
    uint32_t *cut;    // (n_threads + 1) thread k has the nodes of the slots [cut[k], cut[k + 1])
    int n_shared;     // threads to which nodes and walls are shared out; 0 after a sort
    int steps_shared; // since then
    bool walls_in_common;
    struct mpm_wall *walls;
    struct mpm_load *loads;
    struct mpm_rigid *rigids;
    double (*mass_dx)[MPM_MAX_DIM]; // (chunks of all bodies) what each found, kg m
    struct mpm_average *averages;   // (n_probes), NULL where no probe averages
    size_t *probe_particle;         // (n_probes) set and id of the particle of a probe at a point
    size_t *probe_set;
    struct mpm_compare *compares;       // (n_probes)
    struct mpm_body_force *body_forces; // (n_sets), NULL without a body force
    double *scratch;                    // (n_particles), where a probe sorts
    struct mpm_smooth *smooth;          // owned
    struct mpm_plan plan;
    // What one thread changes in every step, apart from what all read: to fetch a cache line again
    // takes longer than a node or ten particles.
    _Alignas(64) struct mpm_clockwork c;
    double phase_seconds[MPM_N_PHASES], phase_begin;
    bool sums_are_clear; // grid.node: of all slots
    unsigned pass;       // number of the last pass that added to the grid
};

// The material of a body with the patches of the stages up to and including `stage`.
const struct mpm_material_def *mpm_material_of(const struct mpm_def *def, int material,
                                               size_t stage);
// The base settings with what the stage states.
struct mpm_settings mpm_stage_settings(const struct mpm_def *def, size_t stage,
                                       const struct mpm_settings *base);
// Gravity in force at time t of the present stage, m/s^2.
void mpm_gravity_at(const struct mpm_sim *sim, double t, double *g);
// Fastest P-wave of the present materials, m/s.
double mpm_wave_speed(const struct mpm_sim *sim);
double mpm_largest_speed(const struct mpm_sim *sim); // of particles and rigid bodies, m/s
// The stability limit for a stage of a definition, with the bodies' initial speeds, s.
double mpm_def_dt_limit(const struct mpm_def *def, size_t stage);
// Whether settings are in their bounds; `pointer` is the place of the settings, dt_limit in s, and
// cfl_limit that of a CFL number.
enum mpm_status mpm_check_settings(const struct mpm_settings *settings, const char *pointer,
                                   int dim, double dt_limit, double cfl_limit, bool unstable_ok,
                                   struct mpm_error *err);
// Applies what stage `stage` states, removes and resets, and sets the clock to its start.
void mpm_enter_stage(struct mpm_sim *sim, size_t stage);
double mpm_kinetic_energy(const struct mpm_sim *sim);
// The parameters that the stages up to the present one have set: after a state was loaded.
void mpm_restore_stage(struct mpm_sim *sim);
// Sorts the particles by cell, and finds the blocks of the grid that they can reach and the walls'
// nodes among these. False when memory is short.
bool mpm_sort(struct mpm_sim *sim);
// The same, but for the sorting, from the tiles that a saved state brought.
bool mpm_restore_order(struct mpm_sim *sim);
// Takes the memory that a scheme needs; what is taken stays. False when memory is short.
bool mpm_provide_fbar(struct mpm_sim *sim, enum mpm_fbar_scheme scheme);
// One field at one particle, as doubles (components); mean_stress_smooth as mpm_smooth_update has
// left it.
void mpm_particle_field(const struct mpm_particles *s, size_t p, enum mpm_field field, double *out);
// The medium that an error probe's solution is for: that of its body in the last stage.
struct mpm_medium mpm_probe_medium(const struct mpm_def *def, const struct mpm_probe_def *q);
// Whether the probe's value is made of the field.
bool mpm_probe_reads(const struct mpm_probe_def *q, enum mpm_field field);
// Finds the particles of the probes that follow one.
void mpm_probes_find_particles(struct mpm_sim *sim);
// Adds the present values to the running integrals of the probes that average.
void mpm_probes_after_step(struct mpm_sim *sim, double dt);
