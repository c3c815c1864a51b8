// fbard: options, log, output thread, runs, HTTP, wait for a signal, stop in reverse order.
#include <errno.h>
#include <malloc.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <unistd.h>

#include "server/log.h"
#include "server/notify.h"
#include "server/options.h"
#include "server/routes.h"

#define EXIT_USAGE 2
#define OPEN_FILES 65536
#define ARENAS 8        // of malloc; the usual one a thread takes 64 MiB of address space each
#define EXIT_RESOURCE 4 // a port, a folder or a file that cannot be had

// Written whole beside it and renamed, so that who waits for the file never reads half of it.
static bool port_file_write(const char *path, const struct routes *routes) {
    char fresh[4200];
    snprintf(fresh, sizeof fresh, "%s.%ld", path, (long)getpid());
    FILE *file = fopen(fresh, "we");
    bool written = file != NULL && fprintf(file, "{\"http\":\"%s\",\"publish\":\"%s\"}\n",
                                           routes->http_url, routes->publish_url) > 0;
    if (file != NULL)
        written = fclose(file) == 0 && written;
    if (written && rename(fresh, path) == 0)
        return true;
    fprintf(stderr, "fbard: --port-file %s: %s\n", path, strerror(errno));
    unlink(fresh);
    return false;
}

static enum run_restore restore_mode(enum options_resume resume) {
    switch (resume) {
    case OPTIONS_RESUME_AUTO:
        return RUN_RESTORE_CONTINUE;
    case OPTIONS_RESUME_PAUSED:
        return RUN_RESTORE_PAUSE;
    case OPTIONS_RESUME_OFF:
        break;
    }
    return RUN_RESTORE_KEEP;
}

// Everything between the lock on the data folder and the signal. The exit status.
static int run_daemon(const struct options *options, const sigset_t *signals) {
    char why[JOURNAL_WHY] = "out of memory";
    int status = EXIT_RESOURCE, received = 0;
    struct routes routes = {.options = options};
    struct run_host host = {.data_dir = options->data_dir,
                            .threads = options->threads,
                            .threads_fit = !options->threads_given,
                            .isa = options->isa,
                            .memory_limit = options->memory_limit};
    struct http_server *http = NULL;
    struct run_meters meters = {0};
    host.meters = &meters;
    struct run_bell bell;
    run_bell_init(&bell);
    host.bell = &bell;
    if (!guard_init(&routes.guard, options->http_host, options->token_file, why, sizeof why))
        goto done;
    host.slots = slots_create(options->slots, options->memory_limit);
    host.publisher =
        publish_start(options->publish, options->curve_dir[0] != '\0' ? options->curve_dir : NULL,
                      routes.publish_url, sizeof routes.publish_url, routes.publish_key, why);
    routes.host = &host;
    routes.runs = runs_create(&host, options->slots, options->queue);
    if (host.slots == NULL || host.publisher == NULL || routes.runs == NULL)
        goto done;
    struct http_service service = routes_service(&routes);
    http = http_start(&(struct http_address){.host = options->http_host,
                                             .port = options->http_port,
                                             .tls_cert = options->tls_cert,
                                             .tls_key = options->tls_key},
                      &service, routes.http_url, sizeof routes.http_url, why, sizeof why);
    if (http == NULL)
        goto done;
    routes.http = http;
    runs_restore(routes.runs, restore_mode(options->resume));
    atomic_store(&routes.open, true);
    if (options->port_file[0] != '\0' && !port_file_write(options->port_file, &routes)) {
        why[0] = '\0';
    } else {
        log_info("ready", "http=%s publish=%s data_dir=\"%s\" threads=%d slots=%d isa=%s",
                 routes.http_url, routes.publish_url, options->data_dir, options->threads,
                 options->slots, mpm_isa_name(mpm_isa_in_use(options->isa)));
        notify_send("READY=1");
        sigwait(signals, &received);
        notify_send("STOPPING=1");
        log_info("ending", "signal=%d", received);
        status = 0;
    }
done:
    if (status != 0 && why[0] != '\0')
        fprintf(stderr, "fbard: %s\n", why);
    atomic_store(&routes.ending, true);
    run_bell_ring(host.bell);
    if (http != NULL)
        http_quiesce(http);
    if (routes.runs != NULL)
        runs_stop(routes.runs);
    http_stop(http);
    runs_free(routes.runs);
    publish_stop(host.publisher);
    slots_free(host.slots);
    guard_free(&routes.guard);
    run_bell_destroy(&bell);
    return status;
}

// libgomp's threads spin for about a millisecond at every barrier, which costs a step many times
// its own length as soon as anything else wants the core: HTTP, the output thread, another run. It
// reads its settings when it is loaded, so the program starts itself once more with shorter spins.
static void start_with_short_spins(char **argv) {
    if (getenv("GOMP_SPINCOUNT") != NULL || getenv("OMP_WAIT_POLICY") != NULL)
        return;
    if (setenv("GOMP_SPINCOUNT", "2000", 1) == 0) // some 10 us: no longer than a wake-up
        execv("/proc/self/exe", argv);            // on failure, go on as we are
}

// Who started itself by way of /proc/self/exe is called "exe" in ps and top otherwise.
static void take_name(void) {
    prctl(PR_SET_NAME, "fbard");
}

// A run that steps holds two files, a connection one or two; the usual soft limit of 1024 is there
// for the sake of select(), which nothing here uses.
static void raise_open_files(void) {
    struct rlimit limit;
    if (getrlimit(RLIMIT_NOFILE, &limit) != 0 || limit.rlim_cur >= OPEN_FILES)
        return;
    limit.rlim_cur = limit.rlim_max < OPEN_FILES ? limit.rlim_max : OPEN_FILES;
    setrlimit(RLIMIT_NOFILE, &limit);
}

int main(int argc, char **argv) {
    start_with_short_spins(argv);
    take_name();
    static struct options options;
    char message[8192], why[JOURNAL_WHY];
    switch (options_parse(argc, argv, &options, message, sizeof message)) {
    case OPTIONS_PRINTED:
        fputs(message, stdout);
        return 0;
    case OPTIONS_BAD:
        fprintf(stderr, "fbard: %s\n", message);
        return EXIT_USAGE;
    case OPTIONS_RUN:
        break;
    }
    // Blocked in every thread; main waits for them.
    sigset_t signals;
    sigemptyset(&signals);
    sigaddset(&signals, SIGINT);
    sigaddset(&signals, SIGTERM);
    pthread_sigmask(SIG_BLOCK, &signals, NULL);
    signal(SIGPIPE, SIG_IGN);
    signal(SIGXFSZ,
           SIG_IGN); // a file at its limit is an error of that write, not the end of all runs
    raise_open_files();
    mallopt(M_ARENA_MAX, ARENAS);
    int lock = journal_lock(options.data_dir, why);
    if (lock < 0) {
        fprintf(stderr, "fbard: --data-dir: %s\n", why);
        return EXIT_RESOURCE;
    }
    int status = run_daemon(&options, &signals);
    close(lock);
    log_info("ended", "status=%d", status);
    return status;
}
