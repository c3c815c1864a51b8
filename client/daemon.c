// Starts and stops a private fbard. It is put into its own process group, so that Ctrl-C reaches
// only fbar, which then says what is to happen; PR_SET_PDEATHSIG ends it when fbar is killed.
#include "client/daemon.h"

#include <cjson/cJSON.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "client/interrupt.h"
#include "client/request.h"
#include "client/terminal.h"

#define START_S 30
#define STOP_S 10

static void nap(void) {
    nanosleep(&(struct timespec){.tv_nsec = 10000000}, NULL);
}

// The fbard next to this program, or the bare name for PATH. `out` has PATH_MAX bytes.
static void program_beside(char *out) {
    char self[PATH_MAX - 8];
    const ssize_t length = readlink("/proc/self/exe", self, sizeof self - 1);
    self[length > 0 ? length : 0] = '\0';
    char *slash = strrchr(self, '/');
    if (slash) {
        *slash = '\0';
        snprintf(out, PATH_MAX, "%s/fbard", self);
    }
    if (!slash || access(out, X_OK) != 0)
        snprintf(out, PATH_MAX, "fbard");
}

static int remove_one(const char *path, const struct stat *status, int kind, struct FTW *place) {
    (void)status, (void)kind, (void)place;
    return remove(path);
}

static void run_child(const char *program, const char *folder, pid_t parent) {
    char data[600], ports[600], log[600];
    snprintf(data, sizeof data, "%s/data", folder);
    snprintf(ports, sizeof ports, "%s/ports.json", folder);
    snprintf(log, sizeof log, "%s/log", folder);
    setpgid(0, 0);
    prctl(PR_SET_PDEATHSIG, SIGKILL); // its data is temporary: nothing to save
    if (getppid() != parent)
        _exit(127);
    const int null = open("/dev/null", O_RDWR),
              file = open(log, O_WRONLY | O_CREAT | O_APPEND, 0600);
    dup2(null, STDIN_FILENO);
    dup2(file >= 0 ? file : null, STDOUT_FILENO);
    dup2(file >= 0 ? file : null, STDERR_FILENO);
    signal(SIGPIPE, SIG_DFL);
    execlp(program, "fbard", "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0",
           "--data-dir", data, "--port-file", ports, (char *)NULL);
    fprintf(stderr, "%s: %s\n", program, strerror(errno));
    _exit(127);
}

// The last line that the daemon logged, for a message.
static void last_line(const char *folder, char *out, size_t n) {
    char path[600], line[512];
    snprintf(path, sizeof path, "%s/log", folder);
    snprintf(out, n, "it gave no reason");
    FILE *file = fopen(path, "r");
    if (!file)
        return;
    while (fgets(line, sizeof line, file)) {
        line[strcspn(line, "\n")] = '\0';
        if (*line)
            snprintf(out, n, "%s", line);
    }
    fclose(file);
}

static int read_url(struct daemon *daemon) {
    char path[600], text[512];
    snprintf(path, sizeof path, "%s/ports.json", daemon->folder);
    FILE *file = fopen(path, "r");
    if (!file)
        return -1;
    const size_t n = fread(text, 1, sizeof text - 1, file);
    fclose(file);
    cJSON *ports = cJSON_ParseWithLength(text, n);
    const char *url = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(ports, "http"));
    if (url)
        snprintf(daemon->url, sizeof daemon->url, "%s", url);
    cJSON_Delete(ports);
    return url ? 0 : -1;
}

int daemon_start(struct daemon *daemon) {
    char program[PATH_MAX], reason[512];
    const char *folder = getenv("TMPDIR");
    *daemon = (struct daemon){0};
    if (!folder || !*folder || strlen(folder) > sizeof daemon->folder - 16)
        folder = "/tmp";
    snprintf(daemon->folder, sizeof daemon->folder, "%s/fbar-XXXXXX", folder);
    if (!mkdtemp(daemon->folder)) {
        terminal_error("%s: %s", daemon->folder, strerror(errno));
        daemon->folder[0] = '\0';
        return -1;
    }
    program_beside(program);
    const pid_t parent = getpid();
    daemon->pid = fork();
    if (daemon->pid == 0)
        run_child(program, daemon->folder, parent);
    if (daemon->pid < 0) {
        terminal_error("cannot start a daemon: %s", strerror(errno));
        daemon_stop(daemon);
        return -1;
    }
    for (int naps = 0; naps < START_S * 100 && !interrupt_count(); naps++) {
        if (read_url(daemon) == 0)
            return 0;
        if (waitpid(daemon->pid, NULL, WNOHANG) == daemon->pid) {
            daemon->pid = 0;
            break;
        }
        nap();
    }
    last_line(daemon->folder, reason, sizeof reason);
    if (!interrupt_count())
        terminal_error("cannot start a daemon: %s", reason);
    daemon_stop(daemon);
    return -1;
}

void daemon_stop(struct daemon *daemon) {
    if (daemon->pid > 0) {
        kill(daemon->pid, SIGTERM);
        for (int naps = 0; naps < STOP_S * 100; naps++) {
            if (waitpid(daemon->pid, NULL, WNOHANG) == daemon->pid) {
                daemon->pid = 0;
                break;
            }
            nap();
        }
        if (daemon->pid > 0) {
            kill(daemon->pid, SIGKILL);
            waitpid(daemon->pid, NULL, 0);
        }
    }
    if (daemon->folder[0])
        nftw(daemon->folder, remove_one, 16, FTW_DEPTH | FTW_PHYS);
    *daemon = (struct daemon){0};
}

bool daemon_private(const struct daemon *daemon) {
    return daemon->pid > 0;
}

static bool answers(struct request *requests) {
    struct reply reply;
    char why[256];
    const struct request_spec spec = {.method = "GET", .path = "/healthz", .timeout_ms = 2000};
    if (request_send(requests, &spec, &reply, why, sizeof why) != 0)
        return false;
    const bool good = reply.status == 200;
    request_reply_free(&reply);
    return good;
}

int daemon_reach(const struct client *client, struct daemon *daemon, struct client *out) {
    *daemon = (struct daemon){0};
    *out = *client;
    if (client->url_given || answers(client->requests))
        return CLIENT_DONE;
    if (interrupt_count())
        return CLIENT_INTERRUPTED;
    if (daemon_start(daemon) != 0)
        return interrupt_count() ? CLIENT_INTERRUPTED : CLIENT_UNREACHABLE;
    out->url = daemon->url;
    out->token_file = NULL;
    out->requests = request_create(daemon->url, NULL);
    if (out->requests)
        return CLIENT_DONE;
    daemon_stop(daemon);
    return CLIENT_IO;
}

void daemon_leave(struct daemon *daemon, struct client *out) {
    if (!daemon_private(daemon))
        return;
    request_free(out->requests);
    daemon_stop(daemon);
}
