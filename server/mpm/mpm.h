// The solver's one public header: definition -> create -> step -> read fields -> free.
//
// Explicit MPM, update stress last, in 2D plane strain or 3D. All quantities are SI (kg, m, s, Pa;
// per metre of thickness in 2D), stress is positive in tension. A simulation is owned by one thread
// at a time; two simulations are independent. The library does no I/O, reads no clock, and has no
// globals.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/mpm/error.h"

#define MPM_MAX_DIM 3
#define MPM_MAX_PARAMETERS 8
#define MPM_MAX_COMPONENTS 9 // of a field at one particle, and of a probe

// ---- Enumerations that appear in a scene: X(ENUM, "text in JSON")
// --------------------------------

#define MPM_BASIS_LIST(X)                                                                          \
    X(LINEAR, "linear") X(GIMP, "gimp") X(BSPLINE2, "bspline2") X(BSPLINE3, "bspline3")
#define MPM_FBAR_LIST(X) X(OFF, "off") X(ZHAO, "zhao") X(ANCHORED, "anchored")
#define MPM_WALL_LIST(X) X(FIXED, "fixed") X(SLIP, "slip") X(SEPARATE, "separate")
#define MPM_PROBE_LIST(X)                                                                          \
    X(EXTENT, "extent")                                                                            \
    X(DISPLACEMENT, "displacement")                                                                \
    X(FIELD, "field")                                                                              \
    X(REACTION, "reaction")                                                                        \
    X(MAXIMUM, "maximum")                                                                          \
    X(MINIMUM, "minimum")                                                                          \
    X(MEAN, "mean")                                                                                \
    X(ERROR, "error") X(ENERGY, "energy") X(MOMENTUM, "momentum") X(DRIFT, "drift")
// How an error is measured: RMS over the standard deviation of the reference, over its RMS; largest
// over largest; and RMS itself, in the field's unit.
#define MPM_NORM_LIST(X) X(RMS, "rms") X(L2, "l2") X(MAX, "max") X(ABSOLUTE, "absolute")
#define MPM_SOLUTION_LIST(X)                                                                       \
    X(ROTATION, "rotation")                                                                        \
    X(MODE, "mode")                                                                                \
    X(COLUMN, "column")                                                                            \
    X(LAME, "lame")                                                                                \
    X(CYLINDER, "cylinder")                                                                        \
    X(TUBE, "tube") X(VORTEX, "vortex") X(TAYLOR_GREEN, "taylor_green") X(RITTER, "ritter")

// Instruction sets of the kernels: plain scalar code, and lanes of 4 or 8 (x86-64-v3 and v4).
#define MPM_ISA_LIST(X) X(AUTO, "auto") X(BASELINE, "baseline") X(AVX2, "avx2") X(AVX512, "avx512")

enum mpm_basis {
#define X(code, text) MPM_##code,
    MPM_BASIS_LIST(X)
#undef X
        MPM_N_BASES
};
enum mpm_fbar_scheme {
#define X(code, text) MPM_FBAR_##code,
    MPM_FBAR_LIST(X)
#undef X
        MPM_N_FBAR_SCHEMES
};
enum mpm_wall_condition {
#define X(code, text) MPM_WALL_##code,
    MPM_WALL_LIST(X)
#undef X
        MPM_N_WALL_CONDITIONS
};
enum mpm_probe_kind {
#define X(code, text) MPM_PROBE_##code,
    MPM_PROBE_LIST(X)
#undef X
        MPM_N_PROBE_KINDS
};
enum mpm_norm {
#define X(code, text) MPM_NORM_##code,
    MPM_NORM_LIST(X)
#undef X
        MPM_N_NORMS
};
enum mpm_solution_kind {
#define X(code, text) MPM_SOLUTION_##code,
    MPM_SOLUTION_LIST(X)
#undef X
        MPM_N_SOLUTIONS
};

enum mpm_isa {
#define X(code, text) MPM_ISA_##code,
    MPM_ISA_LIST(X)
#undef X
        MPM_N_ISAS
};
// Whether this machine and build have it; what AUTO, or one that they lack, comes to.
bool mpm_isa_available(enum mpm_isa isa);
enum mpm_isa mpm_isa_in_use(enum mpm_isa isa);

// The text of an enumerator, static; and the enumerator of a text, or -1.
const char *mpm_basis_name(enum mpm_basis basis);
const char *mpm_fbar_name(enum mpm_fbar_scheme scheme);
const char *mpm_wall_condition_name(enum mpm_wall_condition condition);
const char *mpm_probe_kind_name(enum mpm_probe_kind kind);
const char *mpm_isa_name(enum mpm_isa isa);
const char *mpm_norm_name(enum mpm_norm norm);
const char *mpm_solution_name(enum mpm_solution_kind kind);
int mpm_basis_parse(const char *text);
int mpm_fbar_parse(const char *text);
int mpm_wall_condition_parse(const char *text);
int mpm_probe_kind_parse(const char *text);
int mpm_isa_parse(const char *text);
int mpm_norm_parse(const char *text);
int mpm_solution_parse(const char *text);

// ---- Materials
// ------------------------------------------------------------------------------------

struct mpm_parameter {
    const char *key, *unit, *doc;
    double min, max; // bounds; min is exclusive where min_open, max where max_open
    bool min_open, max_open;
    bool required;
    double fallback; // the default where not required
};
struct mpm_material; // one constitutive model: server/mpm/material.h has its inside

size_t mpm_material_count(void);
const struct mpm_material *mpm_material_at(size_t index);        // in the order of the list; static
const struct mpm_material *mpm_material_find(const char *model); // NULL when there is none
const char *mpm_material_name(const struct mpm_material *model);
const char *mpm_material_doc(const struct mpm_material *model); // one sentence
bool mpm_material_yields(const struct mpm_material *model);     // has an equivalent plastic strain
// Parameter k (k < MPM_MAX_PARAMETERS), NULL past the last; its position is that in
// mpm_material_def.
const struct mpm_parameter *mpm_material_parameter(const struct mpm_material *model, size_t k);

// ---- Definition
// ----------------------------------------------------------------------------------- Plain data.
// Every pointer in it is borrowed: it must live as long as the simulations made from it. Names are
// used in the JSON pointers of errors only. Vectors have `dimension` components in use.

struct mpm_fbar {
    enum mpm_fbar_scheme scheme;
    double a, C, keep; // of MPM_FBAR_ANCHORED (docs/method.md), else unused
};

struct mpm_material_def {
    const char *name;
    const struct mpm_material *model;
    double parameters[MPM_MAX_PARAMETERS]; // in the order of the model's table
    bool fbar;                             // false excepts this material from the run's F-bar
};

enum mpm_shape_kind {
    MPM_SHAPE_BOX,        // min, max
    MPM_SHAPE_BALL,       // centre, radius: a disk in 2D, a sphere in 3D
    MPM_SHAPE_POLYGON,    // points: (n_points, 2), a simple polygon in x and y; 2D
    MPM_SHAPE_EXTRUDE,    // the same polygon from min[2] to max[2] in z; 3D
    MPM_SHAPE_CYLINDER,   // from min to max along its axis, radius; 3D
    MPM_SHAPE_POINTS,     // points: (n_points, dimension + 1), position and volume of each particle
    MPM_SHAPE_UNION,      // of the children
    MPM_SHAPE_DIFFERENCE, // the first child less the others
    MPM_SHAPE_INTERSECTION, // of the children
};
struct mpm_shape {
    enum mpm_shape_kind kind;
    double min[MPM_MAX_DIM], max[MPM_MAX_DIM]; // m
    double centre[MPM_MAX_DIM], radius;        // m
    size_t n_points;
    const double *points;
    size_t n_children;
    const struct mpm_shape *children;
};

// An exact or manufactured solution: docs/method.md section 11. Each kind uses some of these. The
// round ones lie in the plane of x and y, about `centre`.
struct mpm_solution {
    enum mpm_solution_kind kind;
    double centre[MPM_MAX_DIM]; // m
    double vector[MPM_MAX_DIM]; // of a rotation in 3D: its axis, of length 1
    int axis, number;           // of a mode and a column: along it; number of the mode
    double from, length;        // m, of a mode, a column, ritter's gate and depth, a vortex pair
    double inner, outer;        // m, radii of the round ones
    double amplitude;           // m/s of a mode and of taylor_green, rad of a vortex
    double rate;                // rad/s of a rotation; m^2/s of a tube, d(r^2)/dt at t = 0
    double period;              // s, of a vortex: of half its swing
    double pressure;            // Pa, inside lame's and the finite cylinder
};

enum mpm_velocity_kind {
    MPM_VELOCITY_UNIFORM,  // vector
    MPM_VELOCITY_ROTATION, // rate (rad/s) about centre: in 2D about z, in 3D about `vector` (unit
                           // axis)
    MPM_VELOCITY_MODE,     // v_axis = amplitude sin((2 number - 1) pi (x_axis - from) / (2 length))
    MPM_VELOCITY_SOLUTION, // as `solution` begins
};
struct mpm_velocity {
    enum mpm_velocity_kind kind;
    double vector[MPM_MAX_DIM]; // m/s
    double centre[MPM_MAX_DIM], rate;
    int axis, number;
    double from, length, amplitude; // m, m, m/s
    struct mpm_solution solution;
};

// A force on all matter, per mass, besides gravity; it does not enter the potential energy.
struct mpm_body_force_def {
    enum { MPM_BODY_FORCE_NONE, MPM_BODY_FORCE_UNIFORM, MPM_BODY_FORCE_SOLUTION } kind;
    double vector[MPM_MAX_DIM];   // m/s^2
    struct mpm_solution solution; // at a particle's reference position, in its own material
};

struct mpm_body_def {
    const char *name;
    int material; // index in mpm_def.materials
    struct mpm_shape shape;
    int particles_per_direction; // n of the n^dimension lattice in each cell
    bool closed;                 // lattice points exactly on the edge belong to the body
    struct mpm_velocity velocity;
};

struct mpm_wall_def {
    const char *name;
    int axis;  // 0, 1, 2: the normal
    double at; // m, on a node plane
    bool keeps_above;
    enum mpm_wall_condition condition;
    bool has_span; // limits the wall in the other directions
    double span_min[MPM_MAX_DIM], span_max[MPM_MAX_DIM];
    double velocity[MPM_MAX_DIM]; // m/s, prescribed at the plane, which itself stays where it is
};

// What may change between any two steps.
struct mpm_settings {
    struct mpm_fbar fbar;
    double gravity[MPM_MAX_DIM];        // m/s^2
    double damping_local, damping_mass; // alpha in [0, 1); 1/s
    double blend;                       // 1 FLIP .. 0 PIC
    double dt;                          // s; 0 = from cfl
    double cfl;                         // h / (c + largest particle speed) times this
};
enum mpm_setting { // bits: which settings a stage states
    MPM_SET_FBAR = 1,
    MPM_SET_GRAVITY = 2,
    MPM_SET_DAMPING = 4,
    MPM_SET_BLEND = 8,
    MPM_SET_TIME = 16,
};
enum mpm_reset { MPM_RESET_VELOCITY = 1, MPM_RESET_PLASTIC_STRAIN = 2, MPM_RESET_DISPLACEMENT = 4 };

// A stage runs with the scene's settings, but for those that it states itself. What it removes,
// resets and patches stays so for the stages after it.
struct mpm_stage_def {
    const char *name;
    double duration; // s; of the last stage: the end time
    // > 0: ends the stage early, once kinetic energy has fallen to this fraction of its largest
    // value
    double kinetic_energy_ratio;
    unsigned states; // enum mpm_setting
    struct mpm_settings settings;
    double gravity_ramp;       // s, linear from the gravity before the stage (0 before the first)
    unsigned resets;           // enum mpm_reset, done as the stage begins
    const bool *removes_wall;  // (n_walls), or NULL
    const bool *removes_load;  // (n_loads), or NULL
    const bool *removes_rigid; // (n_rigids), or NULL
    const struct mpm_material_def *materials; // (n_materials) from this stage on, or NULL
};

// A rigid body that moves at a given velocity and touches every deformable body. Its pressure on a
// particle closer than `distance` (d < D) to its surface is that of a barrier,
// p(d) = stiffness [2 (d - D) ln(d/D) + (d - D)^2/d] / D, over the particle's area.
struct mpm_rigid_def {
    const char *name;
    struct mpm_shape shape;       // a box, ball or polygon
    double velocity[MPM_MAX_DIM]; // m/s
    double stiffness;             // Pa
    double distance;              // m
    double friction;              // coefficient
};

// A force on particles that stays with them. They are chosen in the reference configuration: those
// of `body` that lie within one particle spacing of its outermost ones along an axis (or, with
// `round`, of its innermost or outermost ones about `centre`), or those in a box.
struct mpm_load_def {
    const char *name;
    int body;
    bool has_box, round, max_side;
    int axis; // of the extreme; of a round one in 3D, the axis of the cylinder about `centre`
    double centre[MPM_MAX_DIM];
    double box_min[MPM_MAX_DIM], box_max[MPM_MAX_DIM];
    bool is_pressure;
    double force[MPM_MAX_DIM]; // N in all (per metre of thickness in 2D), shared equally
    double pressure; // Pa, onto the body, along its axis or radius as it moves; not of a box
    double ramp;     // s, linear from 0 since the first step
};

// What an error is held against: a solution in the material of the probe's body as the last stage
// has it, with the scene's gravity; or n points and the values there, interpolated (table.h).
struct mpm_against {
    bool is_table;
    struct mpm_solution solution;
    size_t n;
    int n_axes;            // coordinates that the points have, up to the dimension
    int axis[MPM_MAX_DIM]; // which
    const double *points;  // (n, n_axes) m, reference positions
    const double *values;  // (n, components of the field, or 1 where `component` >= 0)
};

struct mpm_probe_def {
    const char *name;
    enum mpm_probe_kind kind;
    int body; // index, -1 = all
    int wall; // of a reaction, or -1: of `rigid`
    int rigid;
    int field; // enum mpm_field
    int axis;
    bool max_side;   // of an extent
    double quantile; // of an extent, 1 = the outermost particle
    double at[MPM_MAX_DIM];
    bool has_box; // only the particles whose reference position lies in it
    double box_min[MPM_MAX_DIM], box_max[MPM_MAX_DIM];
    bool has_select; // only the particles that a load of this place would act on; needs a body
    struct mpm_load_def select;
    bool has_exclude; // of an error: not the particles that begin in this shape
    struct mpm_shape exclude;
    struct mpm_against against; // of an error
    enum mpm_norm norm;
    int component;  // of an error: of its field; -1: all of them
    double scale;   // factor on every value
    double average; // s, moving mean over this window; 0 = the value itself
};

struct mpm_def {
    int dimension; // 2 (plane strain) or 3
    double domain_min[MPM_MAX_DIM],
        domain_max[MPM_MAX_DIM]; // m; node planes are domain_min + k cell
    double cell;                 // h, m
    enum mpm_basis basis;
    struct mpm_settings settings;
    struct mpm_body_force_def body_force;
    bool unstable_ok; // accept a dt above the stability limit
    // With B-splines, too, walls hold the nodes on and beyond them instead of mirror-folding them.
    bool walls_hold_nodes;
    size_t n_materials, n_bodies, n_walls, n_loads, n_rigids, n_stages, n_probes;
    const struct mpm_material_def *materials;
    const struct mpm_body_def *bodies;
    const struct mpm_wall_def *walls;
    const struct mpm_load_def *loads;
    const struct mpm_rigid_def *rigids;
    const struct mpm_stage_def *stages; // at least one
    const struct mpm_probe_def *probes;
    bool wants_displacement; // a frame will ask for it
    bool
        wants_volume_ratio; // a frame will ask for the raw volume ratio, also of fluids under F-bar
    bool wants_mean_stress_smooth; // a frame will ask for it; counted in the estimate of memory
    size_t memory_limit;           // bytes, 0 = none
    int n_threads;                 // >= 1; results do not depend on it
    enum mpm_isa isa;              // of the kernels; another one changes results by round-off only
    // Wall-clock seconds, to time the phases; NULL = no timing. Called from the stepping thread
    // only.
    double (*clock)(void);
};

// A definition with every default of docs/scene.md, and nothing in it.
struct mpm_def mpm_def_default(void);
struct mpm_settings mpm_settings_default(void);

// Calls `report` for every fault of the definition that the library can see (bounds, node planes,
// bodies outside the domain or overlapping, empty bodies, dt above the limit, memory); returns how
// many.
size_t mpm_check(const struct mpm_def *def,
                 void (*report)(void *context, const struct mpm_error *fault), void *context);

// What a run will cost. `dt` is that of the first step of the last stage; `steps` assumes that it
// stays.
struct mpm_estimate {
    size_t particles, nodes;
    double dt, dt_limit; // s
    uint64_t steps;      // all stages
    size_t bytes;        // of the simulation
};
// The definition must have passed mpm_check.
void mpm_estimate(const struct mpm_def *def, struct mpm_estimate *out);

// ---- Simulation
// -----------------------------------------------------------------------------------

struct mpm_sim;

// Fails with the first fault that mpm_check reports, or MPM_ERR_MEMORY.
enum mpm_status mpm_create(const struct mpm_def *def, struct mpm_sim **out, struct mpm_error *err);
void mpm_free(struct mpm_sim *sim);

// One time step. A failure (see enum mpm_status) names step, time, particle, quantity and value;
// the simulation must then only be read or freed.
enum mpm_status mpm_step(struct mpm_sim *sim, struct mpm_error *err);
// Calls body(context), which takes some steps, with the simulation's threads standing by between
// them too: to have them come and go takes a small scene some hundredths of a step. They look for
// the next step some ten microseconds, then sleep. The simulation must not be freed within.
void mpm_hold(struct mpm_sim *sim, void (*body)(void *context), void *context);
bool mpm_finished(const struct mpm_sim *sim); // the last stage is over

uint64_t mpm_step_count(const struct mpm_sim *sim); // steps done, all stages
double mpm_time(const struct mpm_sim *sim);         // s, 0 at the start of the last stage
double mpm_end_time(const struct mpm_sim *sim);     // s
double mpm_start_time(const struct mpm_sim *sim);   // s, <= 0: the time of step 0
double mpm_next_dt(const struct mpm_sim *sim);      // s, the increment that the next step will use
double mpm_dt_limit(const struct mpm_sim *sim); // s, stability limit at the present largest speed
size_t mpm_stage(const struct mpm_sim *sim);    // index of the present stage
size_t mpm_n_particles(const struct mpm_sim *sim);
size_t mpm_n_nodes(const struct mpm_sim *sim);
size_t mpm_bytes(const struct mpm_sim *sim); // allocated for particles and grid

// The settings in force, and a change of them between two steps: fails with ERR_RANGE or
// ERR_UNSTABLE_DT and changes nothing, or takes effect from the next step on. It also becomes the
// scene's value for later stages. Neither stress nor volume jumps when F-bar is switched
// (docs/method.md). ERR_MEMORY when F-bar needs arrays that cannot be had.
struct mpm_settings mpm_settings_now(const struct mpm_sim *sim);
enum mpm_status mpm_change(struct mpm_sim *sim, const struct mpm_settings *settings, unsigned which,
                           struct mpm_error *err);
// The end of the last stage, s: at or after the present time.
enum mpm_status mpm_change_end(struct mpm_sim *sim, double end, struct mpm_error *err);

// ---- Fields
// ---------------------------------------------------------------------------------------

enum mpm_shape_of_field { MPM_SCALAR = 0, MPM_VECTOR = 1, MPM_TENSOR = 2 }; // number of indices
enum mpm_field {
#define X(code, text, shape, dtype, unit, doc) MPM_FIELD_##code,
#include "server/mpm/fields.def"
#undef X
    MPM_N_FIELDS
};
struct mpm_field_info {
    const char *name, *unit, *doc;
    enum mpm_shape_of_field shape;
    const char *dtype; // "<f8" or "<u4"
};
const struct mpm_field_info *mpm_field_info(enum mpm_field field);
int mpm_field_parse(const char *name); // -1 when there is none
// Components at one particle: 1, dimension or dimension^2.
size_t mpm_field_components(enum mpm_field field, int dimension);
// Whether the simulation can give it (plastic strain needs a plastic material, displacement that
// the definition wants it, ...). Fields of only some materials are 0 elsewhere.
bool mpm_field_present(const struct mpm_sim *sim, enum mpm_field field);
// Writes (n_particles, components), C order, in the order of the particles' ids, in the field's
// dtype.
void mpm_field_copy(const struct mpm_sim *sim, enum mpm_field field, void *out);

// ---- Probes and balance -------------------------------------------------------------------------

size_t mpm_probe_components(const struct mpm_sim *sim, size_t probe);
// "x", "kinetic", ...: the name of a component; "" for a scalar probe.
const char *mpm_probe_component_name(const struct mpm_sim *sim, size_t probe, size_t component);
// The present value, times `scale`: (components). A value that does not exist is NaN.
void mpm_probe_value(struct mpm_sim *sim, size_t probe, double *out);

struct mpm_balance {
    double mass;                          // kg
    double momentum[MPM_MAX_DIM];         // kg m/s
    double angular_momentum[MPM_MAX_DIM]; // kg m^2/s about the origin; in 2D only [2]
    double kinetic_energy, strain_energy; // J, strain energy of the deformation that stress uses
    double potential_energy;              // J, -m g x with the gravity in force
    double external_work; // J, by gravity, loads, walls and rigid bodies since step 0
};
// Summed in a fixed order: the same bits for any number of threads.
void mpm_balance(const struct mpm_sim *sim, struct mpm_balance *out);

// max |ln(J/Jbar)| over all particles: how far the volume ratio has drifted from the one that the
// stress uses; 0 as long as F-bar was never on, infinite where J is not positive.
double mpm_drift(const struct mpm_sim *sim);

// Seconds by phase since creation (all 0 without a clock); names are static.
#define MPM_PHASE_LIST(X)                                                                          \
    X(SORT, "sort")                                                                                \
    X(P2G, "p2g") X(CONTACT, "contact") X(GRID, "grid") X(G2P, "g2p") X(FBAR, "fbar")
enum mpm_phase {
#define X(code, text) MPM_PHASE_##code,
    MPM_PHASE_LIST(X)
#undef X
        MPM_N_PHASES
};
const char *mpm_phase_name(enum mpm_phase phase);
double mpm_phase_seconds(const struct mpm_sim *sim, enum mpm_phase phase);

// ---- Whole state
// ------------------------------------------------------------------------------------ A restored
// simulation continues with the same bits, for any number of threads.

size_t mpm_state_bytes(const struct mpm_sim *sim);
void mpm_state_save(const struct mpm_sim *sim, void *out);
// Into a simulation newly created from the same definition. MPM_ERR_STATE when it does not fit.
enum mpm_status mpm_state_load(struct mpm_sim *sim, const void *in, size_t bytes,
                               struct mpm_error *err);
