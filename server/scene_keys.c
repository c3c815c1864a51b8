// The keys of a scene: type, unit, bounds, default and meaning of each. Read from the bottom up:
// the scene is the last table.
#include "server/scene_keys.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "server/scene_tables.h"

// ---- Choices ------------------------------------------------------------------------------------

#define CHOICES(name, ...)                                                                         \
    static const char *name##_choice(size_t index) {                                               \
        static const char *const words[] = {__VA_ARGS__};                                          \
        return index < sizeof words / sizeof *words ? words[index] : NULL;                         \
    }
CHOICES(format, "fbard-scene-1")
CHOICES(transfer, "flip")
CHOICES(keeps, "above", "below")
CHOICES(side, "min", "max")
CHOICES(edge, "open", "closed")
CHOICES(contact, "barrier")
CHOICES(extreme, "+x", "-x", "+y", "-y", "+z", "-z", "+r", "-r")
CHOICES(end, "end")
CHOICES(when_full, "block", "fail")
CHOICES(durability, "process", "power")
CHOICES(reset, "velocity", "plastic_strain", "displacement") // the order of enum mpm_reset's bits

const char *scene_axis_choice(size_t index) {
    static const char *const words[] = {"x", "y", "z"};
    return index < MPM_MAX_DIM ? words[index] : NULL;
}
static const char *basis_choice(size_t index) {
    return index < MPM_N_BASES ? mpm_basis_name((enum mpm_basis)index) : NULL;
}
static const char *fbar_choice(size_t index) {
    return index < MPM_N_FBAR_SCHEMES ? mpm_fbar_name((enum mpm_fbar_scheme)index) : NULL;
}
static const char *condition_choice(size_t index) {
    return index < MPM_N_WALL_CONDITIONS ? mpm_wall_condition_name((enum mpm_wall_condition)index)
                                         : NULL;
}
static const char *probe_choice(size_t index) {
    return index < MPM_N_PROBE_KINDS ? mpm_probe_kind_name((enum mpm_probe_kind)index) : NULL;
}
static const char *norm_choice(size_t index) {
    return index < MPM_N_NORMS ? mpm_norm_name((enum mpm_norm)index) : NULL;
}
static const char *field_choice(size_t index) {
    return index < MPM_N_FIELDS ? mpm_field_info((enum mpm_field)index)->name : NULL;
}
const char *scene_model_choice(size_t index) {
    return index < mpm_material_count() ? mpm_material_name(mpm_material_at(index)) : NULL;
}

// clang-format off: below are tables
// ---- Shorthand ----------------------------------------------------------------------------------

#define NUMBER(u)                                                                                  \
    { .type = SCENE_NUMBER, .unit = u, .min = -INFINITY, .max = INFINITY }
#define POSITIVE(u)                                                                                \
    { .type = SCENE_NUMBER, .unit = u, .max = INFINITY, .min_open = true }
#define NOT_NEGATIVE(u)                                                                            \
    { .type = SCENE_NUMBER, .unit = u, .max = INFINITY }
#define CHOICE(name)                                                                               \
    { .type = SCENE_CHOICE, .choice = name##_choice }
#define AXIS                                                                                       \
    { .type = SCENE_CHOICE, .choice = scene_axis_choice }
#define NAME(map)                                                                                  \
    { .type = SCENE_NAME, .of = map }
#define VECTOR(u)                                                                                  \
    { .type = SCENE_VECTOR, .unit = u, .min = -INFINITY, .max = INFINITY }
#define TEXT                                                                                       \
    { .type = SCENE_TEXT }
#define BOOL                                                                                       \
    { .type = SCENE_BOOL }
#define EITHER(table)                                                                              \
    { .type = SCENE_EITHER, .items = table, .n_items = sizeof table / sizeof *table }
#define END                                                                                        \
    { .name = NULL }

static const struct scene_value name_of_wall = NAME("walls"), name_of_load = NAME("loads");
static const struct scene_value name_of_rigid = NAME("rigid_bodies");
static const struct scene_value reset_word = CHOICE(reset);
static const struct scene_value field_word = CHOICE(field);

// ---- Boxes and shapes ---------------------------------------------------------------------------

static const struct scene_key box_keys[] = {
    {"min", VECTOR("m"), .required = true, .doc = "lower corner"},
    {"max", VECTOR("m"), .required = true, .doc = "upper corner, above `min` in every component"},
    END};
#define BOX                                                                                        \
    { .type = SCENE_OBJECT, .keys = box_keys, .ordered = true, .section = "Boxes" }

static const struct scene_key ball_keys[] = {
    {"center", VECTOR("m"), .required = true, .doc = "centre"},
    {"radius", POSITIVE("m"), .required = true, .doc = "radius"},
    END};
#define BALL                                                                                       \
    { .type = SCENE_OBJECT, .keys = ball_keys, .section = "Disks and spheres" }

#define OUTLINE                                                                                    \
    { .type = SCENE_OUTLINE, .unit = "m" }
static const struct scene_key polygon_keys[] = {
    {"points", OUTLINE, .required = true,
     .doc = "`[[x, y], ...]`: the corners in order, either way round; edges must not meet again"},
    END};
#define POLYGON                                                                                    \
    { .type = SCENE_OBJECT, .keys = polygon_keys, .section = "Polygons" }
static const struct scene_value outline_forms[] = {OUTLINE, POLYGON};

static const struct scene_key extrude_keys[] = {
    {"polygon", EITHER(outline_forms), .required = true, .doc = "the section in x and y"},
    {"from", NUMBER("m"), .required = true, .doc = "where it begins in z"},
    {"to", NUMBER("m"), .required = true, .doc = "where it ends in z, above `from`"},
    END};
static const struct scene_key cylinder_keys[] = {
    {"from", VECTOR("m"), .required = true, .doc = "centre of one end"},
    {"to", VECTOR("m"), .required = true, .doc = "centre of the other end"},
    {"radius", POSITIVE("m"), .required = true, .doc = "radius"},
    END};

static const struct scene_value shape;
static const struct scene_key shape_keys[] = {
    {"box", BOX, .doc = "an upright box"},
    {"disk", BALL, .dimension = 2, .doc = "a disk"},
    {"sphere", BALL, .dimension = 3, .doc = "a ball"},
    {"polygon", POLYGON, .dimension = 2, .doc = "a polygon"},
    {"extrude",
     {.type = SCENE_OBJECT, .keys = extrude_keys, .section = "Extrusions"},
     .dimension = 3,
     .doc = "a prism along z"},
    {"cylinder",
     {.type = SCENE_OBJECT, .keys = cylinder_keys, .section = "Cylinders"},
     .dimension = 3,
     .doc = "a round cylinder along any axis"},
    {"points",
     {.type = SCENE_POINTS, .unit = "m, m^dimension"},
     .doc = "`[[x, y, volume], ...]`: these particles and no lattice; volume per metre in 2D"},
    {"union", {.type = SCENE_LIST, .items = &shape}, .doc = "what is in any of the shapes"},
    {"difference",
     {.type = SCENE_LIST, .items = &shape},
     .doc = "what is in the first shape and in none of the others"},
    {"intersection", {.type = SCENE_LIST, .items = &shape}, .doc = "what is in every shape"},
    END};
static const struct scene_value shape = {
    .type = SCENE_ONE_KEY, .keys = shape_keys, .section = "Shapes", .definition = "shape"};

// ---- Velocities ---------------------------------------------------------------------------------

static const struct scene_key rotation_keys[] = {
    {"center", VECTOR("m"), .required = true, .doc = "a point that stays at rest"},
    {"rate", NUMBER("rad/s"), .required = true, .doc = "angular velocity, in 2D about z"},
    {"axis",
     {.type = SCENE_VECTOR, .unit = "1", .nonzero = true},
     .required = true,
     .dimension = 3,
     .doc = "direction of the axis, of any length but 0"},
    END};
static const struct scene_key mode_keys[] = {
    {"axis", AXIS, .required = true, .doc = "direction of the velocity and of its variation"},
    {"from", NUMBER("m"), .fallback = "0", .doc = "the fixed end"},
    {"length", POSITIVE("m"), .required = true, .doc = "length of the bar"},
    {"number",
     {.type = SCENE_INTEGER, .unit = "1", .min = 1, .max = 1000},
     .fallback = "1",
     .doc = "number of the mode, n"},
    {"amplitude", NUMBER("m/s"), .required = true, .doc = "velocity of the free end, v0"},
    END};

// ---- Exact and manufactured solutions -----------------------------------------------------------

#define CENTRE                                                                                     \
    { "center", VECTOR("m"), .fallback = "0", .doc = "its centre; in 3D, the axis is along z" }
#define INNER                                                                                      \
    { "inner", POSITIVE("m"), .required = true, .doc = "inner radius, A" }
#define OUTER                                                                                      \
    { "outer", POSITIVE("m"), .required = true, .doc = "outer radius, B, above `inner`" }
static const struct scene_key vortex_keys[] = {
    CENTRE,
    INNER,
    OUTER,
    {"amplitude", NUMBER("rad"), .required = true, .doc = "largest turn, G"},
    {"period", POSITIVE("s"), .required = true, .doc = "time to the first return, T"},
    END};
static const struct scene_key taylor_green_keys[] = {
    {"center", VECTOR("m"), .fallback = "0", .doc = "a point where the flow stands, at a corner"},
    {"wavelength", POSITIVE("m"), .required = true, .doc = "L; a vortex is L/2 wide"},
    {"speed", NUMBER("m/s"), .required = true, .doc = "largest speed, U"},
    END};
static const struct scene_key tube_keys[] = {
    CENTRE,
    INNER,
    OUTER,
    {"rate", NUMBER("m^2/s"), .required = true,
     .doc = "d(r^2)/dt at the start, the same for all radii; v = rate / (2 R)"},
    END};
static const struct scene_key cylinder_solution_keys[] = {
    CENTRE,
    INNER,
    OUTER,
    {"pressure", NUMBER("Pa"), .required = true, .doc = "pressure inside, p"},
    END};
static const struct scene_key column_keys[] = {
    {"axis", AXIS, .required = true, .doc = "along it, and along gravity"},
    {"from", NUMBER("m"), .fallback = "0", .doc = "the fixed end"},
    {"length", POSITIVE("m"), .required = true, .doc = "from there to the free end, H"},
    END};
static const struct scene_key ritter_keys[] = {
    {"gate", NUMBER("m"), .required = true, .doc = "where the gate was, x0; the water before it"},
    {"depth", POSITIVE("m"), .required = true, .doc = "its depth above the floor at 0, H"},
    END};
#define ROTATION_KEY(text)                                                                         \
    {                                                                                              \
        "rotation",                                                                                \
            {.type = SCENE_OBJECT,                                                                 \
             .keys = rotation_keys,                                                                \
             .section = "The velocity field `rotation`"},                                          \
            .doc = text                                                                            \
    }
#define MODE_KEY(text)                                                                             \
    {                                                                                              \
        "mode", {.type = SCENE_OBJECT, .keys = mode_keys, .section = "The velocity field `mode`"}, \
            .doc = text                                                                            \
    }
#define VORTEX_KEY(text)                                                                           \
    {                                                                                              \
        "vortex", {.type = SCENE_OBJECT, .keys = vortex_keys, .section = "The solution `vortex`"}, \
            .doc = text                                                                            \
    }
#define TAYLOR_GREEN_KEY(text)                                                                     \
    {                                                                                              \
        "taylor_green",                                                                            \
            {.type = SCENE_OBJECT,                                                                 \
             .keys = taylor_green_keys,                                                            \
             .section = "The solution `taylor_green`"},                                            \
            .doc = text                                                                            \
    }
#define TUBE_KEY(text)                                                                             \
    {                                                                                              \
        "tube", {.type = SCENE_OBJECT, .keys = tube_keys, .section = "The solution `tube`"},       \
            .doc = text                                                                            \
    }
static const struct scene_key solution_keys[] = {
    ROTATION_KEY("rigid rotation of any body: position, velocity, no stress"),
    MODE_KEY("axial vibration between slip walls, at small strain"),
    {"column",
     {.type = SCENE_OBJECT, .keys = column_keys, .section = "The solution `column`"},
     .doc = "a confined column at rest under its weight: water, or neo-Hookean at any strain"},
    {"lame",
     {.type = SCENE_OBJECT,
      .keys = cylinder_solution_keys,
      .section = "The solutions `lame` and `cylinder`"},
     .doc = "Lame's thick-walled cylinder under pressure, at small strain"},
    {"cylinder",
     {.type = SCENE_OBJECT,
      .keys = cylinder_solution_keys,
      .section = "The solutions `lame` and `cylinder`"},
     .doc = "the same of a neo-Hookean material at finite strain"},
    TUBE_KEY("free radial oscillation of an incompressible neo-Hookean tube (no stress)"),
    VORTEX_KEY("generalised vortex, with the body force of the same name"),
    TAYLOR_GREEN_KEY("decaying vortices of a viscous fluid: velocity and pressure"),
    {"ritter",
     {.type = SCENE_OBJECT, .keys = ritter_keys, .section = "The solution `ritter`"},
     .doc = "the dam break of shallow water over a dry floor: displacement and velocity"},
    END};
static const struct scene_key force_keys[] = {
    VORTEX_KEY("the force that makes the generalised vortex a solution, of a neo-Hookean material"),
    END};
static const struct scene_value force_forms[] = {
    VECTOR("m/s^2"), {.type = SCENE_ONE_KEY, .keys = force_keys, .section = "Body forces"}};

static const struct scene_key velocity_keys[] = {
    {"rotation",
     {.type = SCENE_OBJECT, .keys = rotation_keys, .section = "The velocity field `rotation`"},
     .doc = "rigid rotation: v = rate axis x (X - center)"},
    {"mode",
     {.type = SCENE_OBJECT, .keys = mode_keys, .section = "The velocity field `mode`"},
     .doc = "axial mode of a bar: v = v0 sin((2n - 1) pi (X - from) / (2 length)) along `axis`"},
    VORTEX_KEY("across the radius, v = R (pi G / T) h(R): docs/method.md, section 11"),
    TAYLOR_GREEN_KEY("v = U (sin kx cos ky, -cos kx sin ky), k = 2 pi / L"),
    TUBE_KEY("outwards, v = rate / (2 R)"),
    END};
static const struct scene_value velocity_forms[] = {
    VECTOR("m/s"), {.type = SCENE_ONE_KEY, .keys = velocity_keys, .section = "Velocity fields"}};

// ---- Settings -----------------------------------------------------------------------------------

static const struct scene_key fbar_keys[] = {
    {"scheme", CHOICE(fbar), .required = true, .selector = true,
     .doc = "`zhao`: Algorithm 1 of the paper; `anchored`: without its creep (docs/method.md)"},
    {"a",
     {.type = SCENE_NUMBER, .unit = "1", .min_open = true, .max = 1},
     .fallback = "0.05",
     .only = 1U << MPM_FBAR_ANCHORED,
     .doc = "weight of the anchor"},
    {"C", NOT_NEGATIVE("1"), .fallback = "1", .only = 1U << MPM_FBAR_ANCHORED,
     .doc = "how fast history is forgotten with travel; 0 = never"},
    {"keep",
     {.type = SCENE_NUMBER, .unit = "1", .min = 0, .max = 1},
     .fallback = "0",
     .only = 1U << MPM_FBAR_ANCHORED,
     .doc =
         "share of the volume change that is not averaged; about sqrt(5 mu/K), 0.1 at nu = 0.499, "
         "for loads on outermost particles; 0.1 for fluids that rest for long; none in plastic "
         "flow "
         "(docs/method.md)"},
    END};
static const struct scene_value fbar_forms[] = {
    BOOL, {.type = SCENE_OBJECT, .keys = fbar_keys, .section = "`fbar` as an object"}};

#define ALPHA                                                                                      \
    { .type = SCENE_NUMBER, .unit = "1", .max = 1, .max_open = true }
#define BLEND                                                                                      \
    { .type = SCENE_NUMBER, .unit = "1", .max = 1 }
#define CFL                                                                                        \
    { .type = SCENE_NUMBER, .unit = "1", .min_open = true, .max = 10 }
#define DOC_LOCAL "alpha of f - alpha |f| sign(v), by component of the total nodal force"
#define DOC_MASS "alpha of f - alpha m v"
#define DOC_BLEND "1: FLIP, 0: PIC"

static const struct scene_key damping_keys[] = {
    {"local", ALPHA, .fallback = "0", .doc = DOC_LOCAL},
    {"mass", NOT_NEGATIVE("1/s"), .fallback = "0", .doc = DOC_MASS},
    END};
static const struct scene_key transfer_keys[] = {
    {"scheme", CHOICE(transfer), .fallback = "\"flip\"", .doc = "how velocity is carried over"},
    {"blend", BLEND, .fallback = "1", .live = true, .doc = DOC_BLEND},
    END};
static const struct scene_key time_keys[] = {
    {"end", POSITIVE("s"), .required = true, .live = true,
     .doc = "end of the run, counted from the start of the last stage"},
    {"dt", POSITIVE("s"), .nullable = true, .live = true, .excludes = "cfl",
     .doc = "fixed time increment"},
    {"cfl", CFL, .nullable = true, .live = true, .fallback = "0.3", .excludes = "dt",
     .doc = "time increment as a fraction of cell / (wave speed + largest particle speed)"},
    {"unstable_ok", BOOL, .fallback = "false", .doc = "as the scene's `unstable_ok`"},
    END};
static const struct scene_key output_keys[] = {
    {"interval", POSITIVE("s"), .fallback = "end / 100", .doc = "simulated time between frames"},
    {"fields",
     {.type = SCENE_LIST, .items = &field_word, .unique = true},
     .fallback = "[\"position\", \"velocity\", \"mean_stress\"]",
     .doc = "what a frame carries; `position` is put first where it is missing"},
    {"probe_interval", POSITIVE("s"), .fallback = "end / 500",
     .doc = "simulated time between samples of the probes"},
    {"checkpoint_interval", POSITIVE("s"), .fallback = "60",
     .doc = "wall-clock time between checkpoints"},
    {"journal_bytes",
     {.type = SCENE_INTEGER, .unit = "byte", .min = 1e6, .max = 1e15},
     .fallback = "4294967296",
     .doc = "room for frames on the disk; beyond it the oldest go, but for those that a "
            "recorder has not acknowledged"},
    {"when_full", CHOICE(when_full), .fallback = "\"block\"",
     .doc = "what happens when that room is full: the run waits, or it fails"},
    {"durability", CHOICE(durability), .fallback = "\"process\"",
     .doc = "what a journaled frame survives: the end of the process, or a power cut as well"},
    END};
#define TIME                                                                                       \
    { .type = SCENE_OBJECT, .keys = time_keys, .section = "`time`" }
#define DAMPING                                                                                    \
    { .type = SCENE_OBJECT, .keys = damping_keys, .section = "`damping`" }
#define TRANSFER                                                                                   \
    { .type = SCENE_OBJECT, .keys = transfer_keys, .section = "`transfer`" }
#define OUTPUT                                                                                     \
    { .type = SCENE_OBJECT, .keys = output_keys, .section = "`output`" }

// ---- Materials, bodies, walls -------------------------------------------------------------------

static const struct scene_value material = {.type = SCENE_MATERIAL};

static const struct scene_key body_keys[] = {
    {"material", NAME("materials"), .required = true, .doc = "what it is made of"},
    {"shape",
     {.type = SCENE_ONE_KEY, .keys = shape_keys, .section = "Shapes", .definition = "shape"},
     .required = true,
     .doc = "the space that it fills at the start"},
    {"particles_per_cell",
     {.type = SCENE_LATTICE, .unit = "1"},
     .fallback = "2^dimension",
     .doc = "n^dimension, a lattice in each cell"},
    {"edge", CHOICE(edge), .fallback = "\"open\"",
     .doc = "whether lattice points exactly on the shape's boundary belong to it"},
    {"velocity", EITHER(velocity_forms), .fallback = "0", .doc = "velocity at the start"},
    END};
static const struct scene_value body = {
    .type = SCENE_OBJECT, .keys = body_keys, .section = "`bodies.NAME`"};

static const struct scene_key wall_keys[] = {
    {"axis", AXIS, .required = true, .doc = "the wall's normal"},
    {"at", NUMBER("m"), .required = true, .doc = "its place, on a plane of nodes"},
    {"keeps", CHOICE(keeps), .required = true, .doc = "the side that stays free"},
    {"condition", CHOICE(condition), .fallback = "\"slip\"",
     .doc = "`fixed`; `slip`: no normal flow either way; `separate`: slip, but matter may leave"},
    {"span",
     {.type = SCENE_OBJECT, .keys = box_keys, .section = "Boxes"},
     .doc = "limits the wall in the other directions; without it the wall has no end"},
    {"velocity", VECTOR("m/s"), .fallback = "0",
     .doc = "velocity prescribed at the plane, which itself stays where it is"},
    END};
static const struct scene_value wall = {
    .type = SCENE_OBJECT, .keys = wall_keys, .section = "`walls.NAME`"};

// ---- Loads --------------------------------------------------------------------------------------

static const struct scene_key select_keys[] = {
    {"box", BOX, .doc = "the particles that start in this box, its edge included"},
    {"extreme", CHOICE(extreme), .excludes = "box",
     .doc = "the outermost layer of particles on that side; `+r`, `-r`: the outermost, innermost "
            "about `center`"},
    {"center", VECTOR("m"), .excludes = "box",
     .doc = "a point that `+r` and `-r` go out from, which need it"},
    {"axis", AXIS, .dimension = 3, .excludes = "box",
     .doc = "direction of the axis through `center`, which `+r` and `-r` need"},
    END};
static const struct scene_key load_keys[] = {
    {"body", NAME("bodies"), .required = true, .doc = "the body that it acts on"},
    {"select",
     {.type = SCENE_OBJECT, .keys = select_keys, .section = "A load's `select`"},
     .required = true,
     .doc = "its particles, by where they start; it has either `extreme` or `box`"},
    {"force", VECTOR("N"),
     .doc = "force in all, shared equally by the particles; per metre of thickness in 2D"},
    {"pressure", NUMBER("Pa"), .excludes = "force",
     .doc = "pressure onto the body, normal to the layer that `extreme` names"},
    {"ramp", NOT_NEGATIVE("s"), .fallback = "0",
     .doc = "grows linearly over this time, from the first step on"},
    END};
static const struct scene_value load = {
    .type = SCENE_OBJECT, .keys = load_keys, .section = "`loads.NAME`"};

// ---- Rigid bodies -------------------------------------------------------------------------------

// Those that contact.c knows the distance from.
static const struct scene_key rigid_shape_keys[] = {
    {"box", BOX, .doc = "an upright box"},
    {"disk", BALL, .dimension = 2, .doc = "a disk"},
    {"sphere", BALL, .dimension = 3, .doc = "a ball"},
    {"polygon", POLYGON, .dimension = 2, .doc = "a polygon"},
    END};
static const struct scene_key contact_keys[] = {
    {"kind", CHOICE(contact), .fallback = "\"barrier\"",
     .doc = "a pressure that grows without end"},
    {"stiffness", POSITIVE("Pa"), .required = true,
     .doc = "k of the pressure k [2 (d - D) ln(d/D) + (d - D)^2/d] / D at the distance d < D"},
    {"distance", POSITIVE("m"), .required = true,
     .doc = "D: nearer particles are pushed away; less than `cell`"},
    {"friction", NOT_NEGATIVE("1"), .fallback = "0", .doc = "Coulomb's coefficient"},
    END};
static const struct scene_key rigid_keys[] = {
    {"shape",
     {.type = SCENE_ONE_KEY, .keys = rigid_shape_keys, .section = "A rigid body's `shape`"},
     .required = true,
     .doc = "the space that it takes at the start, with no particle in it"},
    {"velocity", VECTOR("m/s"), .fallback = "0", .doc = "velocity at which it moves throughout"},
    {"contact",
     {.type = SCENE_OBJECT, .keys = contact_keys, .section = "A rigid body's `contact`"},
     .required = true,
     .doc = "how it acts on particles"},
    END};
static const struct scene_value rigid_body = {
    .type = SCENE_OBJECT, .keys = rigid_keys, .section = "`rigid_bodies.NAME`"};

// ---- Stages -------------------------------------------------------------------------------------

static const struct scene_key until_keys[] = {
    {"kinetic_energy_ratio",
     {.type = SCENE_NUMBER, .unit = "1", .min_open = true, .max = 1, .max_open = true},
     .required = true,
     .doc = "ends once kinetic energy has fallen to this part of its peak"},
    {"duration", POSITIVE("s"), .required = true, .doc = "ends then at the latest"},
    END};
static const struct scene_key ramped_keys[] = {
    {"vector", VECTOR("m/s^2"), .required = true, .doc = "gravity at the end of the ramp"},
    {"ramp", NOT_NEGATIVE("s"), .fallback = "0", .doc = "as the stage's `ramp`"},
    END};
static const struct scene_value gravity_forms[] = {
    VECTOR("m/s^2"),
    {.type = SCENE_OBJECT, .keys = ramped_keys, .section = "A stage's `gravity` as an object"}};
// No defaults below: what a stage does not say is the scene's.
static const struct scene_key stage_damping_keys[] = {
    {"local", ALPHA, .doc = DOC_LOCAL}, {"mass", NOT_NEGATIVE("1/s"), .doc = DOC_MASS}, END};
static const struct scene_key stage_transfer_keys[] = {
    {"scheme", CHOICE(transfer), .doc = "as the scene's; it cannot change"},
    {"blend", BLEND, .doc = DOC_BLEND},
    END};
static const struct scene_key stage_time_keys[] = {
    {"dt", POSITIVE("s"), .nullable = true, .excludes = "cfl", .doc = "fixed time increment"},
    {"cfl", CFL, .nullable = true, .excludes = "dt", .doc = "time increment as a fraction"},
    END};
static const struct scene_key remove_keys[] = {
    {"walls",
     {.type = SCENE_LIST, .items = &name_of_wall, .unique = true},
     .doc = "names of walls that go"},
    {"loads",
     {.type = SCENE_LIST, .items = &name_of_load, .unique = true},
     .doc = "names of loads that end"},
    {"rigid_bodies",
     {.type = SCENE_LIST, .items = &name_of_rigid, .unique = true},
     .doc = "names of rigid bodies that go"},
    END};
static const struct scene_key stage_keys[] = {
    {"name", TEXT, .required = true, .doc = "shown with the run's progress"},
    {"duration", POSITIVE("s"), .excludes = "until",
     .doc = "how long it lasts; every stage but the last needs this or `until`, the last has none"},
    {"until",
     {.type = SCENE_OBJECT, .keys = until_keys, .section = "A stage's `until`"},
     .excludes = "duration",
     .doc = "ends as soon as the motion has died down"},
    {"gravity", EITHER(gravity_forms), .doc = "gravity in this stage"},
    {"ramp", NOT_NEGATIVE("s"),
     .doc = "gravity changes linearly over this time, from that before the stage (0 at first)"},
    {"damping",
     {.type = SCENE_OBJECT, .keys = stage_damping_keys, .section = "A stage's `damping`"},
     .doc = "damping in this stage"},
    {"time",
     {.type = SCENE_OBJECT, .keys = stage_time_keys, .section = "A stage's `time`"},
     .doc = "time increment in this stage"},
    {"fbar", EITHER(fbar_forms), .doc = "F-bar in this stage"},
    {"transfer",
     {.type = SCENE_OBJECT, .keys = stage_transfer_keys, .section = "A stage's `transfer`"},
     .doc = "transfer in this stage"},
    {"remove",
     {.type = SCENE_OBJECT, .keys = remove_keys, .section = "A stage's `remove`"},
     .doc = "taken away as the stage begins, for good"},
    {"materials",
     {.type = SCENE_MATERIAL_PATCH},
     .doc = "merge patch of the materials' parameters (not `model`, not `density`), for good"},
    {"reset",
     {.type = SCENE_LIST, .items = &reset_word, .unique = true},
     .doc = "set to zero as the stage begins"},
    END};
static const struct scene_value stage = {
    .type = SCENE_OBJECT, .keys = stage_keys, .section = "`stages[]`"};

// ---- Probes and references ----------------------------------------------------------------------

#define KIND(code) (1U << MPM_PROBE_##code)
#define FOLDS (KIND(MAXIMUM) | KIND(MINIMUM) | KIND(MEAN))
#define PARTICLES (KIND(DISPLACEMENT) | KIND(FIELD) | KIND(ERROR) | FOLDS)
#define CHOOSES (KIND(DISPLACEMENT) | KIND(ERROR) | FOLDS)
#define READS_FIELD (KIND(FIELD) | KIND(ERROR) | FOLDS)
static const struct scene_value against_forms[] = {
    {.type = SCENE_CHOICE, .choice = scene_table_choice},
    {.type = SCENE_ONE_KEY, .keys = solution_keys, .section = "Solutions"}};
static const struct scene_key probe_keys[] = {
    {"kind", CHOICE(probe), .required = true, .selector = true, .doc = "what is measured"},
    {"body", NAME("bodies"), .only = PARTICLES | KIND(EXTENT) | KIND(DRIFT),
     .doc = "only this body; without it, all"},
    {"wall", NAME("walls"), .only = KIND(REACTION), .doc = "the force on this wall"},
    {"rigid_body", NAME("rigid_bodies"), .only = KIND(REACTION), .excludes = "wall",
     .doc = "the force on this rigid body; a reaction is that of one of the two"},
    {"field", CHOICE(field), .only = READS_FIELD, .needs = READS_FIELD, .doc = "the field"},
    {"against", EITHER(against_forms), .only = KIND(ERROR), .needs = KIND(ERROR),
     .doc = "a solution, or a table of values at reference positions, `scenes/reference/NAME.csv`"},
    {"norm", CHOICE(norm), .only = KIND(ERROR), .fallback = "\"rms\"",
     .doc = "`rms`: RMS error over the standard deviation of the reference; `l2`: over its RMS; "
            "`max`: largest over largest; `absolute`: RMS error in the field's unit"},
    {"component", TEXT, .only = KIND(ERROR), .doc = "only this component of the field"},
    {"axis", AXIS, .only = KIND(EXTENT), .needs = KIND(EXTENT), .doc = "along this axis"},
    {"side", CHOICE(side), .only = KIND(EXTENT), .fallback = "\"max\"",
     .doc = "the greatest or the least coordinate"},
    {"quantile",
     {.type = SCENE_NUMBER, .unit = "1", .min_open = true, .max = 1},
     .only = KIND(EXTENT),
     .fallback = "1",
     .doc = "1: the outermost particle; q: this part of the particles lies inside"},
    {"at", VECTOR("m"), .only = KIND(DISPLACEMENT) | KIND(FIELD), .needs = KIND(FIELD),
     .excludes = "box", .doc = "a reference point: the particle that starts nearest to it is read"},
    {"box", BOX, .only = CHOOSES, .excludes = "at",
     .doc = "only the particles that start in this box; of a displacement, the mean over them"},
    {"select",
     {.type = SCENE_OBJECT, .keys = select_keys, .section = "A load's `select`"},
     .only = CHOOSES,
     .excludes = "at",
     .doc =
         "only the particles of `body` that a load would choose so; of a displacement, the mean"},
    {"exclude",
     {.type = SCENE_ONE_KEY, .keys = shape_keys, .section = "Shapes", .definition = "shape"},
     .only = KIND(ERROR),
     .doc = "not the particles that start in this shape"},
    {"scale", NUMBER("1"), .fallback = "1", .doc = "factor on every value"},
    {"average", NOT_NEGATIVE("s"), .fallback = "0",
     .doc = "moving mean over this window; 0: the value itself"},
    END};
static const struct scene_value probe = {
    .type = SCENE_OBJECT, .keys = probe_keys, .section = "`probes.NAME`"};

static const struct scene_value at_forms[] = {NUMBER("s"), CHOICE(end)};
static const struct scene_key cited_keys[] = {
    {"table",
     {.type = SCENE_CHOICE, .choice = scene_table_choice},
     .required = true,
     .doc = "`scenes/reference/NAME.csv`"},
    {"column", TEXT, .required = true, .doc = "name of the column that is read"},
    {"at", NUMBER("the first column's"),
     .doc = "where in the first column, between rows linearly; without it, the reference's time"},
    END};
static const struct scene_value reference_forms[] = {
    NUMBER("the probe's"),
    {.type = SCENE_OBJECT, .keys = cited_keys, .section = "A reference's `value` as an object"}};
static const struct scene_key reference_keys[] = {
    {"probe", NAME("probes"), .required = true, .doc = "the probe that is compared"},
    {"component", TEXT,
     .doc = "of a probe with several: `x`, `y`, `z`; `xx`, `xy`, ...; `kinetic`, `strain`, "
            "`potential`, `total`"},
    {"at", EITHER(at_forms), .required = true, .doc = "when: a time, or `\"end\"`"},
    {"value", EITHER(reference_forms), .required = true,
     .doc = "what it should be: a number, or one of a table"},
    {"tolerance", POSITIVE("1"), .required = true,
     .doc = "accepted relative error; of a reference of 0, accepted value"},
    {"source", TEXT, .fallback = "\"\"", .doc = "where the value comes from"},
    END};
static const struct scene_value reference = {
    .type = SCENE_OBJECT, .keys = reference_keys, .section = "`references[]`"};

// ---- The scene ----------------------------------------------------------------------------------

static const struct scene_key root_keys[] = {
    {"format", CHOICE(format), .required = true, .doc = "what this file is"},
    {"title", TEXT, .fallback = "\"\"", .doc = "one line for people"},
    {"dimension",
     {.type = SCENE_INTEGER, .unit = "1", .min = 2, .max = 3},
     .required = true,
     .doc = "2: plane strain, per metre of thickness; 3"},
    {"domain",
     {.type = SCENE_OBJECT, .keys = box_keys, .ordered = true, .section = "Boxes"},
     .required = true,
     .doc = "where particles may be; no wall, a particle that leaves it fails the run"},
    {"cell", POSITIVE("m"), .required = true, .doc = "cell size h of the background grid"},
    {"basis", CHOICE(basis), .fallback = "\"bspline2\"", .doc = "basis functions of the grid"},
    {"transfer", TRANSFER, .fallback = "{}", .doc = "between particles and grid"},
    {"fbar", EITHER(fbar_forms), .live = true, .fallback = "false",
     .doc = "F-bar against volumetric locking; `true` is `{\"scheme\": \"zhao\"}`"},
    {"time", TIME, .required = true, .doc = "end and time increment"},
    {"unstable_ok", BOOL, .fallback = "false",
     .doc = "accept a `dt` above the stability limit, which is otherwise refused"},
    {"gravity", VECTOR("m/s^2"), .live = true, .fallback = "0", .doc = "acceleration"},
    {"body_force", EITHER(force_forms), .fallback = "0",
     .doc = "force per mass on all matter, besides gravity"},
    {"damping", DAMPING, .live = true, .fallback = "{}", .doc = "artificial damping"},
    {"materials",
     {.type = SCENE_MAP, .items = &material},
     .required = true,
     .doc = "constitutive models and their parameters"},
    {"bodies",
     {.type = SCENE_MAP, .items = &body},
     .required = true,
     .doc = "what is filled with particles"},
    {"walls", {.type = SCENE_MAP, .items = &wall}, .fallback = "{}", .doc = "plane boundaries"},
    {"mirror_walls", BOOL, .fallback = "true",
     .doc = "B-splines: a wall is the mirror plane of an image of the body, so that its condition "
            "holds "
            "exactly on it; `false` holds the nodes on and behind it instead, as other codes do "
            "(and as "
            "the other bases always do): the body then slips through at an eighth (quadratic) or a "
            "sixth (cubic) of the velocity one cell away"},
    {"loads",
     {.type = SCENE_MAP, .items = &load},
     .fallback = "{}",
     .doc = "forces on particles, which they follow"},
    {"rigid_bodies",
     {.type = SCENE_MAP, .items = &rigid_body},
     .fallback = "{}",
     .doc = "bodies that move as they are told and touch every deformable one"},
    {"stages",
     {.type = SCENE_LIST, .items = &stage},
     .fallback = "[{\"name\": \"run\"}]",
     .doc = "the parts of the run, in order; the last is the run proper and starts at t = 0"},
    {"output", OUTPUT, .live = true, .fallback = "{}", .doc = "frames, samples, checkpoints"},
    {"probes", {.type = SCENE_MAP, .items = &probe}, .fallback = "{}", .doc = "time series"},
    {"references",
     {.type = SCENE_LIST, .items = &reference},
     .fallback = "[]",
     .doc = "values that probes are compared with"},
    END};
const struct scene_value scene_root = {
    .type = SCENE_OBJECT, .keys = root_keys, .section = "The scene"};

// clang-format on
// ---- Materials ----------------------------------------------------------------------------------

void scene_material_keys(const struct mpm_material *model, struct scene_material_keys *out) {
    size_t n = 0;
    out->keys[n++] = (struct scene_key){
        .name = "model",
        .value = {.type = SCENE_CHOICE, .choice = scene_model_choice},
        .required = true,
        .doc = "the constitutive model",
    };
    const struct mpm_parameter *parameter;
    for (size_t k = 0; k < MPM_MAX_PARAMETERS && model; k++) {
        if (!(parameter = mpm_material_parameter(model, k)))
            break;
        snprintf(out->texts[k], sizeof out->texts[k], "%.15g", parameter->fallback);
        out->keys[n++] = (struct scene_key){
            .name = parameter->key,
            .value = {.type = SCENE_NUMBER,
                      .unit = parameter->unit,
                      .min = parameter->min <= -DBL_MAX ? -INFINITY : parameter->min,
                      .max = parameter->max >= DBL_MAX ? INFINITY : parameter->max,
                      .min_open = parameter->min_open,
                      .max_open = parameter->max_open},
            .required = parameter->required,
            .fallback = parameter->required ? NULL : out->texts[k],
            .doc = parameter->doc,
        };
    }
    out->keys[n++] = (struct scene_key){
        .name = "fbar",
        .value = BOOL,
        .fallback = "true",
        .doc = "`false` excepts this material from the run's F-bar",
    };
    out->keys[n] = (struct scene_key)END;
}

// ---- Words --------------------------------------------------------------------------------------

int scene_choice_index(const struct scene_value *value, const char *text) {
    const char *word;
    for (int i = 0; (word = value->choice((size_t)i)); i++)
        if (strcmp(word, text) == 0)
            return i;
    return -1;
}

// snprintf at the end of what is there already.
static void append(char *out, size_t n, const char *format, const char *text) {
    size_t length = strlen(out);
    snprintf(out + length, n - length, format, text);
}

static void describe_bounds(const struct scene_value *value, char *out, size_t n) {
    char number[32];
    if (isfinite(value->min)) {
        snprintf(number, sizeof number, "%.15g", value->min);
        append(out, n, value->min_open ? " > %s" : " >= %s", number);
    }
    if (isfinite(value->max)) {
        snprintf(number, sizeof number, "%.15g", value->max);
        append(out, n, isfinite(value->min) ? " and%s" : "%s", "");
        append(out, n, value->max_open ? " < %s" : " <= %s", number);
    }
}

void scene_describe(const struct scene_value *value, char *out, size_t n) {
    out[0] = 0;
    switch (value->type) {
    case SCENE_BOOL:
        append(out, n, "%s", "true or false");
        break;
    case SCENE_NUMBER:
        append(out, n, "%s", "a number");
        describe_bounds(value, out, n);
        break;
    case SCENE_INTEGER:
        append(out, n, "%s", "an integer");
        describe_bounds(value, out, n);
        break;
    case SCENE_LATTICE:
        append(out, n, "%s", "an integer n^dimension");
        break;
    case SCENE_TEXT:
        append(out, n, "%s", "text");
        break;
    case SCENE_CHOICE: {
        const char *word;
        bool several = value->choice(1) != NULL;
        append(out, n, "%s", several ? "one of " : "");
        for (size_t i = 0; (word = value->choice(i)); i++) {
            append(out, n, i ? ", \"%s" : "\"%s", word);
            append(out, n, "%s", "\"");
        }
        break;
    }
    case SCENE_NAME:
        append(out, n, "a name in `%s`", value->of);
        break;
    case SCENE_VECTOR:
        append(out, n, "%s", "a vector");
        break;
    case SCENE_POINTS:
        append(out, n, "%s", "an array of positions with a volume");
        break;
    case SCENE_OUTLINE:
        append(out, n, "%s", "an array of 3 or more points [x, y]");
        break;
    case SCENE_OBJECT:
    case SCENE_MATERIAL:
    case SCENE_MATERIAL_PATCH:
        append(out, n, "%s", "an object");
        break;
    case SCENE_ONE_KEY: {
        append(out, n, "%s", "an object with one key of ");
        for (const struct scene_key *key = value->keys; key->name; key++)
            append(out, n, key == value->keys ? "%s" : ", %s", key->name);
        break;
    }
    case SCENE_MAP:
        append(out, n, "%s", "an object keyed by name");
        break;
    case SCENE_LIST: {
        char item[400] = "objects";
        if (value->items->type == SCENE_CHOICE || value->items->type == SCENE_NAME)
            scene_describe(value->items, item, sizeof item);
        append(out, n, "an array of %s", item);
        break;
    }
    case SCENE_EITHER:
        for (size_t i = 0; i < value->n_items; i++) {
            char one[400];
            scene_describe(&value->items[i], one, sizeof one);
            append(out, n, i ? ", or %s" : "%s", one);
        }
        break;
    }
    if (value->unit && strcmp(value->unit, "1") != 0)
        append(out, n, " in %s", value->unit);
}
