// The paper's moving scenes, whole, as a user runs them: how fast, whether the speed lasts, what
// the phases take, and how well two threads share the work once the particles lie scattered.
#include "bench/bench.h"
#include "server/scene.h"

#define MOMENTS 3 // states that are kept on the way

struct run {
    struct scene *scene;
    struct mpm_sim *sim;
};

static struct run open_scene(const char *name, const char *patch_text, int n_threads) {
    struct run run = {0};
    struct faults faults = {0};
    cJSON *bare = scene_builtin(name), *patch = json_parse(patch_text, strlen(patch_text), &faults);
    cJSON *json = json_merge_patch(bare, patch);
    struct mpm_error err = {0};
    run.scene = scene_create(json, &faults);
    if (run.scene) {
        struct mpm_def *def = scene_def(run.scene);
        def->n_threads = n_threads;
        def->clock = wall_now;
        if (mpm_create(def, &run.sim, &err)) {
            printf("FAILED: %s: %s %s\n", name, err.pointer, err.message);
        }
    } else {
        printf("FAILED: %s: %s %s\n", name, faults.items[0].pointer, faults.items[0].detail);
    }
    faults_free(&faults);
    cJSON_Delete(json);
    cJSON_Delete(patch);
    cJSON_Delete(bare);
    return run;
}

static void close_run(struct run *run) {
    mpm_free(run->sim);
    scene_free(run->scene);
}

// The same scene, from a state on.
static struct run continue_scene(const char *name, const char *patch, int n_threads,
                                 const void *state, size_t bytes) {
    struct run run = open_scene(name, patch, n_threads);
    struct mpm_error err;
    if (run.sim && mpm_state_load(run.sim, state, bytes, &err)) {
        printf("FAILED: %s: %s\n", name, err.message);
        mpm_free(run.sim);
        run.sim = NULL;
    }
    return run;
}

static void close_verdict(const char *name, const char *what, double ns, double ratio,
                          double at_most, const struct mpm_sim *sim) {
    char text_of[100];
    snprintf(text_of, sizeof text_of, "%s: %s", name, what);
    verdict_row("scenes", text_of, ns, ratio, at_most);
    number("particles", (double)mpm_n_particles(sim));
    close_row();
}

// Two states in turns, each on one thread.
static void compare(const char *name, const char *patch, void *const *state, const size_t *bytes,
                    int late, int early) {
    struct run a = continue_scene(name, patch, 1, state[late], bytes[late]);
    struct run b = continue_scene(name, patch, 1, state[early], bytes[early]);
    if (a.sim && b.sim) {
        double ns;
        const double ratio = pair_of(a.sim, b.sim, &ns);
        close_verdict(name, "ns in the last tenth / in the first", ns, ratio, 1 / 0.9, a.sim);
    }
    close_run(&a);
    close_run(&b);
}

// One state, by two threads and by one.
static void share(const char *title, const char *name, const char *patch, const void *state,
                  size_t bytes) {
    struct run two = continue_scene(name, patch, 2, state, bytes);
    struct run one = continue_scene(name, patch, 1, state, bytes);
    struct run other = continue_scene(name, patch, 1, state, bytes);
    if (two.sim && one.sim && other.sim) {
        double ns;
        const double ratio = threads_pair(two.sim, (struct mpm_sim *[]){one.sim, other.sim}, &ns);
        close_verdict(title, "spread out, two threads / one", ns, ratio, 1 / 1.7, two.sim);
    }
    close_run(&two);
    close_run(&one);
    close_run(&other);
}

// ---- What two threads need to meet ----

#define STEPS 2000
#define MEETINGS 4 // of a step of one body with F-bar, without loads or rigid bodies

static void meetings(void *context, int own, int there) {
    for (int k = 0; k < MEETINGS; k++) {
        mpm_team_barrier(context, own, there);
    }
}
static void steps_of_nothing(void *context) {
    for (int k = 0; k < STEPS; k++) {
        mpm_team_run(context, meetings, context);
    }
}

// Steps begin, meet and end, with nothing in between: us.
static void meeting(const char *name, const char *patch, const void *state, size_t bytes) {
    struct run run = continue_scene(name, patch, 2, state, bytes);
    if (run.sim) {
        double us[MAX_ROUNDS], step[MAX_ROUNDS];
        const int rounds = quick ? 5 : MAX_ROUNDS;
        struct run one = continue_scene(name, patch, 1, state, bytes);
        for (int r = 0; r < rounds; r++) {
            const double t = wall_now();
            mpm_team_hold(run.sim->team, steps_of_nothing, run.sim->team);
            us[r] = 1e6 * (wall_now() - t) / STEPS;
            step[r] = one.sim ? 1e6 * timed(one.sim, 0.02) * (double)mpm_n_particles(one.sim) : NAN;
        }
        close_run(&one);
        const double empty = median(us, rounds), whole = median(step, rounds);
        const double line = 1e9 * line_there_and_back();
        printf("  a step of which all parts do nothing takes two threads %.2f us, a step on one "
               "thread %.1f us: so at most %.2f times as fast; a cache line takes %.0f ns to the "
               "other core and back\n",
               empty, whole, whole / (whole / 2 + empty), line);
        open_row("meeting");
        text("scene", name);
        number("us_an_empty_step", empty);
        number("us_a_step_on_one_thread", whole);
        number("at_most_times_as_fast", whole / (whole / 2 + empty));
        number("line_there_and_back_ns", line);
        close_row();
    }
    close_run(&run);
}

// `spread`: a time when two threads are asked to share the work well.
static void whole_scene(const char *name, const char *patch, double spread) {
    struct run run = open_scene(name, patch, 1);
    if (!run.sim) {
        close_run(&run);
        return;
    }
    const double first = mpm_time(run.sim), all = mpm_end_time(run.sim) - first;
    const double moments[MOMENTS] = {first + 0.05 * all, spread, first + 0.95 * all};
    void *state[MOMENTS] = {0};
    size_t bytes[MOMENTS] = {0}, n = mpm_n_particles(run.sim);
    double rate[10], since = now(), begin = since, wall = wall_now();
    uint64_t steps = 0;
    int tenth = 0, moment = 0;
    struct mpm_error err = {0};
    while (!mpm_finished(run.sim)) {
        if (mpm_step(run.sim, &err)) {
            printf("FAILED: %s: %s\n", name, err.message);
            break;
        }
        const double t = mpm_time(run.sim);
        if (moment < MOMENTS && t >= moments[moment]) {
            bytes[moment] = mpm_state_bytes(run.sim);
            state[moment] = malloc(bytes[moment]);
            mpm_state_save(run.sim, state[moment++]);
        }
        if (tenth < 10 && t - first >= (tenth + 1) * all * 0.1 - 1e-12) {
            const uint64_t done = mpm_step_count(run.sim) - steps;
            rate[tenth++] = 1e-6 * (double)done * (double)n / (now() - since);
            steps += done;
            since = now();
        }
    }
    const double all_s = now() - begin;
    wall = wall_now() - wall;
    steps = mpm_step_count(run.sim);
    printf(
        "%s: %zu particles, %llu steps in %.1f s of one thread, %.1f M particle-steps/s; by tenths",
        name, n, (unsigned long long)steps, all_s, 1e-6 * (double)steps * (double)n / all_s);
    open_row("scenes");
    text("scene", name);
    number("particles", (double)n);
    number("steps", (double)steps);
    number("cpu_s", all_s);
    for (int k = 0; k < tenth; k++) {
        char key[20];
        printf(" %.1f", rate[k]);
        snprintf(key, sizeof key, "rate_%d", k + 1);
        number(key, rate[k]);
    }
    printf("\n  phases, %% of all:");
    double sum = 0;
    for (int k = 0; k < MPM_N_PHASES; k++) {
        const double part = 100 * mpm_phase_seconds(run.sim, (enum mpm_phase)k) / wall;
        printf(" %s %.1f", mpm_phase_name((enum mpm_phase)k), part);
        number(mpm_phase_name((enum mpm_phase)k), part);
        sum += part;
    }
    printf(", together %.1f\n", sum);
    number("all_phases", sum);
    close_row();
    close_run(&run);
    if (moment == MOMENTS) {
        compare(name, patch, state, bytes, 2, 0);
        meeting(name, patch, state[1], bytes[1]);
        share(name, name, patch, state[1], bytes[1]);
    }
    for (int k = 0; k < MOMENTS; k++) {
        free(state[k]);
    }
}

// What of the landslide in 3D fits a benchmark: its first steps, and what the whole would take.
static void landslide(void) {
    const double steps = (5.5 + 0.8) / 5e-5;
    for (int threads = 1; threads <= 2; threads++) {
        struct run run = open_scene("landslide", "{}", threads);
        if (run.sim) {
            const double n = (double)mpm_n_particles(run.sim);
            timed(run.sim, 0.3);
            const double ns = 1e9 * timed(run.sim, quick ? 0.3 : 3),
                         hours = 1e-9 * ns * n * steps / 3600;
            printf("landslide: %.0f particles, %d thread%s: %.1f ns, %.1f M particle-steps/s: the "
                   "whole of %.0f steps in %.2f h (asked for: 1.5 h on two)\n",
                   n, threads, threads > 1 ? "s" : "", ns, 1e3 / ns, steps, hours);
            open_row("scenes");
            text("scene", "landslide");
            number("particles", n);
            number("threads", threads);
            number("ns_per_particle_step", ns);
            number("hours", hours);
            close_row();
        }
        close_run(&run);
    }
}

// The landslide while it runs out, as the whole run comes to it: a quarter of an hour.
static void runout(void) {
    struct run run = open_scene("landslide", "{}", 2);
    struct mpm_error err = {0};
    while (run.sim && mpm_time(run.sim) < 2.5) {
        if (mpm_step(run.sim, &err)) {
            printf("FAILED: landslide: %s\n", err.message);
            close_run(&run);
            return;
        }
    }
    const size_t bytes = run.sim ? mpm_state_bytes(run.sim) : 0;
    void *state = malloc(bytes + 1);
    if (run.sim && state) {
        mpm_state_save(run.sim, state);
        share("landslide, 311,250 particles, at 2.5 s", "landslide", "{}", state, bytes);
    }
    free(state);
    close_run(&run);
}

void scenes(void) {
    if (asked_for("runout")) {
        puts("\nThe landslide's run-out");
        runout();
    }
    if (!wanted("scenes")) {
        return;
    }
    puts("\nScenes");
    whole_scene("dam-break", quick ? "{\"time\":{\"end\":0.7}}" : "{}", 0.6);
    whole_scene("landslide-slice", quick ? "{\"time\":{\"end\":1.6}}" : "{}", quick ? 1.3 : 2.5);
    landslide();
}
