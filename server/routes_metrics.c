// GET /metrics in the text format of Prometheus. Counters are of this daemon's life; what is told
// of single runs is told of those that are not over, so that the page stays short.
#include <dirent.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

#include "server/routes_inside.h"

// Statuses that the API gives; what is not among them is counted as the last.
static const int statuses[ROUTES_STATUSES] = {200, 201, 204, 400, 401, 403, 404, 405, 409, 412,
                                              413, 415, 421, 422, 431, 500, 503, 507, 0};

void routes_tally(struct routes *routes, const struct route *route, int status, double seconds) {
    size_t row = route != NULL ? (size_t)(route - routes_table) : ROUTES_MAX, column = 0;
    while (column < ROUTES_STATUSES - 1 && statuses[column] != status)
        column++;
    atomic_fetch_add(&routes->tally[row].replies[column], 1);
    atomic_fetch_add(&routes->tally[row].microseconds, (uint64_t)(1e6 * seconds));
}

static void family(FILE *out, const char *name, const char *type, const char *help) {
    fprintf(out, "# HELP %s %s\n# TYPE %s %s\n", name, help, name, type);
}

static void put(FILE *out, double value) {
    if (isfinite(value))
        fprintf(out, " %.17g\n", value);
    else
        fputs(isnan(value) ? " NaN\n" : value > 0 ? " +Inf\n" : " -Inf\n", out);
}

static void single(FILE *out, const char *name, const char *type, const char *help, double value) {
    family(out, name, type, help);
    fputs(name, out);
    put(out, value);
}

static void of_run(FILE *out, const char *name, struct run *run, double value) {
    fprintf(out, "%s{run=\"%s\"}", name, run_id(run));
    put(out, value);
}

// ---- HTTP -------------------------------------------------------------------------------------

static void put_http(FILE *out, struct routes *routes) {
    family(out, "fbard_http_requests_total", "counter", "Requests by route and status.");
    for (size_t k = 0; k <= ROUTES_MAX; k++)
        for (size_t s = 0; s < ROUTES_STATUSES; s++) {
            uint64_t n = atomic_load(&routes->tally[k].replies[s]);
            bool known = k < routes_count;
            if (n > 0)
                fprintf(
                    out,
                    "fbard_http_requests_total{method=\"%s\",route=\"%s\",status=\"%d\"} %llu\n",
                    known ? routes_table[k].method : "", known ? routes_table[k].pattern : "",
                    statuses[s], (unsigned long long)n);
        }
    family(out, "fbard_http_request_seconds_total", "counter",
           "Seconds from the whole request to its reply, by route.");
    for (size_t k = 0; k < routes_count; k++)
        fprintf(out, "fbard_http_request_seconds_total{method=\"%s\",route=\"%s\"} %.6f\n",
                routes_table[k].method, routes_table[k].pattern,
                1e-6 * (double)atomic_load(&routes->tally[k].microseconds));
    struct http_counts counts;
    http_count(routes->http, &counts);
    single(out, "fbard_http_connections", "gauge", "Connections that are open.", counts.open);
    single(out, "fbard_http_connections_total", "counter", "Connections so far.",
           (double)counts.accepted);
    single(out, "fbard_http_connections_evicted_total", "counter",
           "Connections closed because others needed their place.", (double)counts.evicted);
    single(out, "fbard_http_connections_refused_total", "counter",
           "Connections answered with 503 for want of a place.", (double)counts.refused);
    single(out, "fbard_streams", "gauge", "Streams of events and frames that are open.",
           atomic_load(&routes->streams));
}

// ---- Frames -----------------------------------------------------------------------------------

static void put_frames(FILE *out, struct routes *routes, double gone) {
    struct publish_counts counts;
    publish_count(routes->host->publisher, &counts);
    family(out, "fbard_frames_published_total", "counter",
           "Frames given out: once to the ZeroMQ socket, and to each stream over HTTP.");
    fprintf(out, "fbard_frames_published_total{class=\"zeromq\"} %llu\n",
            (unsigned long long)counts.frames);
    fprintf(out, "fbard_frames_published_total{class=\"stream\"} %llu\n",
            (unsigned long long)atomic_load(&routes->stream_sent));
    family(out, "fbard_frames_dropped_total", "counter",
           "Frames that a stream passed over because newer ones were there. ZeroMQ does not tell "
           "what its subscribers lose.");
    fprintf(out, "fbard_frames_dropped_total{class=\"stream\"} %llu\n",
            (unsigned long long)atomic_load(&routes->stream_skipped));
    single(out, "fbard_journal_frames_gone", "gauge",
           "Frames that journals dropped for want of room, over the runs there are.", gone);
    single(out, "fbard_published_bytes_total", "counter", "Bytes of frames given to ZeroMQ.",
           (double)counts.frame_bytes);
    single(out, "fbard_events_published_total", "counter", "Events given to ZeroMQ.",
           (double)counts.events);
    single(out, "fbard_subscriptions", "gauge", "ZeroMQ subscriptions there are.",
           (double)counts.subscriptions);
}

// ---- The process ------------------------------------------------------------------------------

// Seconds since 1970, found once: found anew, rounding would make other starts of it. As
// Prometheus's own clients have it: boot time and the ticks after it (proc(5)).
static double start_time;

static void find_start_time(void) {
    struct timespec now, up;
    unsigned long long ticks = 0;
    char text[1024];
    FILE *file = fopen("/proc/self/stat", "re");
    size_t n = file != NULL ? fread(text, 1, sizeof text - 1, file) : 0;
    if (file != NULL)
        fclose(file);
    text[n] = '\0';
    const char *at = strrchr(text, ')'); // behind the name, which may hold anything
    for (int field = 2; at != NULL && field < 22; field++)
        at = strchr(at + 1, ' ');
    if (at == NULL || sscanf(at, "%llu", &ticks) != 1 || clock_gettime(CLOCK_REALTIME, &now) != 0 ||
        clock_gettime(CLOCK_BOOTTIME, &up) != 0)
        return;
    start_time = (double)(now.tv_sec - up.tv_sec) + 1e-9 * (double)(now.tv_nsec - up.tv_nsec) +
                 (double)ticks / (double)sysconf(_SC_CLK_TCK);
    start_time = round(100 * start_time) / 100; // a tick is 0.01 s
}

static void put_process(FILE *out) {
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    pthread_once(&once, find_start_time);
    if (start_time > 0)
        single(out, "process_start_time_seconds", "gauge",
               "Start of the process, seconds since 1970.", start_time);
    struct rusage usage;
    unsigned long long size = 0, resident = 0;
    FILE *file = fopen("/proc/self/statm", "re");
    if (file != NULL && fscanf(file, "%llu %llu", &size, &resident) == 2) {
        double page = (double)sysconf(_SC_PAGESIZE);
        single(out, "process_resident_memory_bytes", "gauge", "Resident memory.",
               page * (double)resident);
        single(out, "process_virtual_memory_bytes", "gauge", "Virtual memory.",
               page * (double)size);
    }
    if (file != NULL)
        fclose(file);
    if (getrusage(RUSAGE_SELF, &usage) == 0)
        single(out, "process_cpu_seconds_total", "counter", "User and system time.",
               (double)(usage.ru_utime.tv_sec + usage.ru_stime.tv_sec) +
                   1e-6 * (double)(usage.ru_utime.tv_usec + usage.ru_stime.tv_usec));
    DIR *folder = opendir("/proc/self/fd");
    if (folder != NULL) {
        int n = -3; // ".", ".." and the folder itself
        while (readdir(folder) != NULL)
            n++;
        closedir(folder);
        single(out, "process_open_fds", "gauge", "Open file descriptors.", n);
    }
    struct rlimit files;
    if (getrlimit(RLIMIT_NOFILE, &files) == 0 && files.rlim_cur != RLIM_INFINITY)
        single(out, "process_max_fds", "gauge", "Most file descriptors that may be open.",
               (double)files.rlim_cur);
}

// ---- Runs -------------------------------------------------------------------------------------

static void put_run_values(FILE *out, struct run **all, const struct run_status *status,
                           size_t count) {
    family(out, "fbard_run_step", "gauge", "Steps done by a run.");
    for (size_t k = 0; k < count; k++)
        if (!run_state_is_final(status[k].state))
            of_run(out, "fbard_run_step", all[k], (double)status[k].step);
    family(out, "fbard_run_progress_ratio", "gauge", "Simulated time done, of all.");
    for (size_t k = 0; k < count; k++)
        if (!run_state_is_final(status[k].state))
            of_run(out, "fbard_run_progress_ratio", all[k], routes_progress(&status[k]));
    family(out, "fbard_run_particle_steps_per_second", "gauge",
           "Particles times steps, per second inside the step loop.");
    for (size_t k = 0; k < count; k++)
        if (!run_state_is_final(status[k].state) && status[k].wall_s > 0)
            of_run(out, "fbard_run_particle_steps_per_second", all[k],
                   (double)status[k].particles * (double)status[k].step / status[k].wall_s);
    family(out, "fbard_run_phase_seconds", "gauge", "Seconds that a run spent, by phase.");
    for (size_t k = 0; k < count; k++)
        for (int p = 0; p < RUN_N_PHASES && !run_state_is_final(status[k].state); p++)
            fprintf(out, "fbard_run_phase_seconds{run=\"%s\",phase=\"%s\"} %.6f\n", run_id(all[k]),
                    run_phase_name(p), status[k].phases[p]);
}

static void put_recorders(FILE *out, struct run **all, size_t count, bool bytes) {
    const char *name = bytes ? "fbard_recorder_lag_bytes" : "fbard_recorder_lag_frames";
    family(out, name, "gauge", "What a recorder has not acknowledged yet.");
    for (size_t k = 0; k < count; k++) {
        struct recorder list[RECORDERS_MAX];
        struct journal *journal = run_journal(all[k]);
        size_t n = run_recorders(all[k]) != NULL ? recorders_list(run_recorders(all[k]), list) : 0;
        for (size_t r = 0; r < n; r++) {
            uint64_t frames = journal_n_frames(journal), from = (uint64_t)(list[r].acked + 1);
            fprintf(out, "%s{run=\"%s\",recorder=\"%s\"} %llu\n", name, run_id(all[k]),
                    list[r].name,
                    (unsigned long long)(bytes           ? journal_bytes_from(journal, from)
                                         : frames > from ? frames - from
                                                         : 0));
        }
    }
}

// `gone` receives the frames that were dropped from journals.
static void put_runs(FILE *out, struct routes *routes, double *gone) {
    size_t count, states[RUN_N_STATES] = {0};
    double bytes = 0, frames = 0;
    struct run **all = runs_all(routes->runs, &count);
    struct run_status *status = calloc(count + 1, sizeof *status);
    *gone = 0;
    for (size_t k = 0; k < count && status != NULL; k++) {
        struct journal *journal = run_journal(all[k]);
        status[k] = run_status(all[k]);
        states[status[k].state]++;
        bytes += journal != NULL ? (double)journal_frame_bytes(journal) : 0;
        frames += journal != NULL ? (double)journal_n_frames(journal) : 0;
        *gone += journal != NULL ? (double)journal_n_gone(journal) : 0;
    }
    family(out, "fbard_runs", "gauge", "Runs by state.");
    for (int k = 0; k < RUN_N_STATES; k++)
        fprintf(out, "fbard_runs{state=\"%s\"} %zu\n", run_state_name((enum run_state)k),
                states[k]);
    if (status != NULL) {
        put_run_values(out, all, status, count);
        put_recorders(out, all, count, false);
        put_recorders(out, all, count, true);
    }
    single(out, "fbard_journal_bytes", "gauge", "Frames on disk, over all runs.", bytes);
    single(out, "fbard_journal_frames", "gauge", "Frames taken, over all runs there are.", frames);
    free(status);
    for (size_t k = 0; k < count; k++)
        run_release(all[k]);
    free(all);
}

void routes_serve_metrics(struct call *c) {
    struct routes *routes = c->routes;
    char *text = NULL;
    size_t bytes = 0;
    double gone = 0;
    FILE *out = open_memstream(&text, &bytes);
    if (out == NULL) {
        reply_problem(c->reply, 503, NULL, "out of memory");
        return;
    }
    family(out, "fbard_info", "gauge", "What this daemon is.");
    fprintf(out,
            "fbard_info{version=\"%s\",instruction_set=\"%s\",threads=\"%d\",slots=\"%d\"} 1\n",
            FBARD_VERSION, mpm_isa_name(mpm_isa_in_use(routes->options->isa)),
            routes->options->threads, routes->options->slots);
    put_runs(out, routes, &gone);
    const struct run_meters *meters = routes->host->meters;
    single(out, "fbard_steps_total", "counter", "Steps of all runs.",
           (double)atomic_load(&meters->steps));
    single(out, "fbard_particle_steps_total", "counter", "Particles times steps of all runs.",
           (double)atomic_load(&meters->particle_steps));
    put_frames(out, routes, gone);
    put_http(out, routes);
    put_process(out);
    fclose(out);
    reply_text(c->reply, 200, "text/plain; version=0.0.4; charset=utf-8", text);
}
