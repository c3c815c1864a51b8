// Options as one table that parses the command line and prints the help.
#include "server/options.h"

#include <arpa/inet.h>
#include <errno.h>
#include <limits.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define MAX_THREADS 1024
#define MAX_QUEUE 100000
#define MEMORY_SHARE 0.8           // of the machine, when --memory-limit is not given
#define MAX_BODY ((size_t)8 << 20) // contract, section 2

bool options_bytes(const char *text, size_t *out) {
    char *end;
    errno = 0;
    if (*text < '0' || *text > '9')
        return false;
    unsigned long long value = strtoull(text, &end, 10);
    unsigned shift = 0;
    switch (*end) {
    case 'K':
        shift = 10;
        break;
    case 'M':
        shift = 20;
        break;
    case 'G':
        shift = 30;
        break;
    case 'T':
        shift = 40;
        break;
    default:
        break;
    }
    if (errno != 0 || (shift != 0 ? end[1] : end[0]) != '\0' || value > (SIZE_MAX >> shift))
        return false;
    *out = (size_t)value << shift;
    return true;
}

bool options_is_loopback(const char *host) {
    struct in_addr v4;
    struct in6_addr v6;
    if (strcmp(host, "localhost") == 0)
        return true;
    if (inet_pton(AF_INET, host, &v4) == 1)
        return ntohl(v4.s_addr) >> 24 == 127;
    return inet_pton(AF_INET6, host, &v6) == 1 && IN6_IS_ADDR_LOOPBACK(&v6);
}

static bool copy(char *out, size_t n, const char *text) {
    size_t length = strlen(text);
    if (length >= n)
        return false;
    memcpy(out, text, length + 1);
    return true;
}

static bool parse_int(const char *text, int max, int *out) {
    char *end;
    errno = 0;
    long value = strtol(text, &end, 10);
    if (errno != 0 || *text < '0' || *text > '9' || *end != '\0' || value < 1 || value > max)
        return false;
    *out = (int)value;
    return true;
}

// HOST:PORT or [IPv6]:PORT.
static bool parse_address(const char *text, struct options *o) {
    const char *colon = strrchr(text, ':');
    if (colon == NULL || colon == text)
        return false;
    const char *from = text;
    size_t n = (size_t)(colon - text);
    if (text[0] == '[') {
        if (text[n - 1] != ']')
            return false;
        from++;
        n -= 2;
    } else if (memchr(text, ':', n) != NULL) {
        return false;
    }
    char *end;
    if (colon[1] < '0' || colon[1] > '9')
        return false;
    unsigned long port = strtoul(colon + 1, &end, 10);
    if (*end != '\0' || port > 65535 || n == 0 || n >= sizeof o->http_host)
        return false;
    memcpy(o->http_host, from, n);
    o->http_host[n] = '\0';
    snprintf(o->http_port, sizeof o->http_port, "%lu", port);
    return true;
}

// tcp://HOST:PORT (0 picks a port) or ipc://PATH.
static bool parse_publish(const char *text, struct options *o) {
    if (strncmp(text, "ipc://", 6) == 0 && text[6] != '\0') {
        o->publish_loopback = true;
        return copy(o->publish, sizeof o->publish, text);
    }
    struct options address;
    if (strncmp(text, "tcp://", 6) != 0 || !parse_address(text + 6, &address))
        return false;
    if (strcmp(address.http_host, "localhost") == 0) // ZeroMQ binds to addresses, not names
        snprintf(address.http_host, sizeof address.http_host, "127.0.0.1");
    bool v6 = strchr(address.http_host, ':') != NULL;
    const char *port = strcmp(address.http_port, "0") == 0 ? "*" : address.http_port;
    o->publish_loopback = options_is_loopback(address.http_host);
    return snprintf(o->publish, sizeof o->publish, v6 ? "tcp://[%s]:%s" : "tcp://%s:%s",
                    address.http_host, port) < (int)sizeof o->publish;
}

static bool parse_resume(const char *text, enum options_resume *out) {
    static const char *const names[] = {"auto", "paused", "off"};
    for (int k = 0; k < 3; k++)
        if (strcmp(text, names[k]) == 0) {
            *out = (enum options_resume)k;
            return true;
        }
    return false;
}

#define OPTION_LIST(X)                                                                             \
    X(HTTP, "--http", "HOST:PORT", "address of the HTTP API (127.0.0.1:7800); port 0 picks one")   \
    X(PUBLISH, "--publish", "ENDPOINT", "ZeroMQ endpoint of the frames (tcp://127.0.0.1:7801)")    \
    X(DATA_DIR, "--data-dir", "DIR", "one folder a run ($XDG_STATE_HOME/fbard)")                   \
    X(THREADS, "--threads", "N", "solver threads of a run (cores / slots; fewer for a small run)") \
    X(SLOTS, "--slots", "N", "runs at a time (1)")                                                 \
    X(QUEUE, "--queue", "N", "unfinished runs beyond --slots, paused ones included (64)")          \
    X(RESUME, "--resume", "auto|paused|off",                                                       \
      "runs that were running: go on, pause, or wait for auto (auto)")                             \
    X(TOKEN_FILE, "--token-file", "FILE", "every request must carry this bearer token")            \
    X(TLS_CERT, "--tls-cert", "FILE", "serve HTTPS with this certificate (PEM)")                   \
    X(TLS_KEY, "--tls-key", "FILE", "its key (PEM)")                                               \
    X(CURVE_DIR, "--curve-dir", "DIR", "encrypt ZeroMQ with the keys of fbar keygen DIR")          \
    X(PORT_FILE, "--port-file", "FILE", "receives {\"http\": ..., \"publish\": ...} when ready")   \
    X(MEMORY_LIMIT, "--memory-limit", "BYTES", "of all simulations; suffix K, M, G (80 % of RAM)") \
    X(MAX_BODY, "--max-body", "BYTES", "largest request body (8M)")                                \
    X(INSECURE, "--insecure", NULL, "allow addresses beyond loopback without token and TLS")       \
    X(HELP, "--help", NULL, "print this")                                                          \
    X(MANUAL, "--manual", NULL, "print the manual page, fbard.8 (troff)")                          \
    X(VERSION, "--version", NULL, "print the version")

enum option {
#define X(code, name, value, doc) OPTION_##code,
    OPTION_LIST(X)
#undef X
        N_OPTIONS
};
static const struct {
    const char *name, *value, *doc;
} table[] = {
#define X(code, name, value, doc) {name, value, doc},
    OPTION_LIST(X)
#undef X
};

static void print_help(char *message, size_t n) {
    size_t used = (size_t)snprintf(message, n,
                                   "usage: fbard [options]\n\nHosts simulations with the material "
                                   "point method behind an HTTP API.\n\n");
    for (int k = 0; k < N_OPTIONS && used < n; k++) {
        char left[64];
        snprintf(left, sizeof left, "%s %s", table[k].name,
                 table[k].value != NULL ? table[k].value : "");
        used += (size_t)snprintf(message + used, n - used, "  %-26s %s\n", left, table[k].doc);
    }
    if (used < n)
        snprintf(message + used, n - used,
                 "\nFBARD_ISA in the environment: auto, baseline, avx2 or avx512: the solver's "
                 "instruction set.\nThe page and the API are then at http://127.0.0.1:7800; `fbar "
                 "help` is the client.\n");
}

// fbard.8 in the man(7) macros. A hyphen is written so that it can be pasted.
static void print_manual(char *message, size_t n) {
    static const char before[] =
        ".TH FBARD 8 \"\" \"fbard " FBARD_VERSION "\" \"System Administration\"\n"
        ".SH NAME\nfbard \\- hosts material\\-point simulations behind an HTTP API\n"
        ".SH SYNOPSIS\n.B fbard\n[\\fIoptions\\fR]\n"
        ".SH DESCRIPTION\nComputes scenes with the material point method, with the F\\-bar cure of "
        "volumetric locking. Runs are created, watched, steered and read over HTTP/JSON; every frame "
        "is journaled and published over ZeroMQ. A run that was accepted is there after a crash, and "
        "goes on from its last checkpoint.\n.PP\n"
        "Only loopback addresses are allowed without a token and TLS (HTTP) or CURVE (ZeroMQ).\n"
        ".SH OPTIONS\n";
    static const char after[] =
        ".SH ENVIRONMENT\n"
        ".TP\n.B FBARD_ISA\nthe solver's instruction set: auto, baseline, avx2 or avx512\n"
        ".TP\n.B XDG_STATE_HOME\nruns are kept in its folder fbard (else ~/.local/state/fbard)\n"
        ".TP\n.B NOTIFY_SOCKET\nset by a service manager: told READY=1 once both sockets answer, "
        "and STOPPING=1\n"
        ".SH SIGNALS\nSIGTERM and SIGINT end it in order: runs make checkpoints, and go on when it "
        "is started again.\n"
        ".SH EXIT STATUS\n0 after a signal, 2 for wrong options, 4 for a port, folder or file that "
        "cannot be had.\n"
        ".SH SEE ALSO\n.BR fbar (1)\n";
    size_t used = (size_t)snprintf(message, n, "%s", before);
    for (int k = 0; k < N_OPTIONS && used + 1 < n; k++) {
        char line[256];
        snprintf(line, sizeof line, ".TP\n\\fB%s\\fR%s\\fI%s\\fR\n%s\n", table[k].name,
                 table[k].value != NULL ? " " : "", table[k].value != NULL ? table[k].value : "",
                 table[k].doc);
        for (const char *c = line; *c != '\0' && used + 2 < n; c++) {
            if (*c == '-')
                message[used++] = '\\';
            message[used++] = *c;
        }
    }
    snprintf(message + used, n - used, "%s", after);
}

static bool assign(struct options *o, enum option option, const char *value) {
    switch (option) {
    case OPTION_HTTP:
        return parse_address(value, o);
    case OPTION_PUBLISH:
        return parse_publish(value, o);
    case OPTION_DATA_DIR:
        return *value != '\0' && copy(o->data_dir, sizeof o->data_dir, value);
    case OPTION_THREADS:
        o->threads_given = true;
        return parse_int(value, MAX_THREADS, &o->threads);
    case OPTION_SLOTS:
        return parse_int(value, MAX_THREADS, &o->slots);
    case OPTION_QUEUE:
        return parse_int(value, MAX_QUEUE, &o->queue);
    case OPTION_RESUME:
        return parse_resume(value, &o->resume);
    case OPTION_TOKEN_FILE:
        return *value != '\0' && copy(o->token_file, sizeof o->token_file, value);
    case OPTION_TLS_CERT:
        return *value != '\0' && copy(o->tls_cert, sizeof o->tls_cert, value);
    case OPTION_TLS_KEY:
        return *value != '\0' && copy(o->tls_key, sizeof o->tls_key, value);
    case OPTION_CURVE_DIR:
        return *value != '\0' && copy(o->curve_dir, sizeof o->curve_dir, value);
    case OPTION_PORT_FILE:
        return *value != '\0' && copy(o->port_file, sizeof o->port_file, value);
    case OPTION_MEMORY_LIMIT:
        return options_bytes(value, &o->memory_limit) && o->memory_limit > 0;
    case OPTION_MAX_BODY:
        return options_bytes(value, &o->max_body) && o->max_body > 0;
    case OPTION_INSECURE:
        o->insecure = true;
        return true;
    case OPTION_HELP:
    case OPTION_MANUAL:
    case OPTION_VERSION:
    case N_OPTIONS:
        break;
    }
    return false;
}

static int available_cores(void) {
    cpu_set_t set;
    if (sched_getaffinity(0, sizeof set, &set) == 0 && CPU_COUNT(&set) > 0)
        return CPU_COUNT(&set);
    return 1;
}

static bool default_data_dir(struct options *o) {
    const char *state = getenv("XDG_STATE_HOME"), *home = getenv("HOME");
    int n;
    if (state != NULL && state[0] == '/') // the XDG base directory specification: else ignore it
        n = snprintf(o->data_dir, sizeof o->data_dir, "%s/fbard", state);
    else if (home != NULL && home[0] == '/')
        n = snprintf(o->data_dir, sizeof o->data_dir, "%s/.local/state/fbard", home);
    else
        return false;
    return n < (int)sizeof o->data_dir;
}

// FBARD_ISA chooses the solver's kernels, for comparisons and for a processor that throttles.
static bool isa_from_environment(struct options *o, char *message, size_t n) {
    const char *text = getenv("FBARD_ISA");
    int isa = text != NULL && *text != '\0' ? mpm_isa_parse(text) : MPM_ISA_AUTO;
    if (isa < 0) {
        size_t used = (size_t)snprintf(message, n, "FBARD_ISA: must be one of");
        for (int k = 0; k < MPM_N_ISAS && used < n; k++)
            used +=
                (size_t)snprintf(message + used, n - used, " %s", mpm_isa_name((enum mpm_isa)k));
        if (used < n)
            snprintf(message + used, n - used, ", got '%.60s'", text);
        return false;
    }
    if (!mpm_isa_available((enum mpm_isa)isa)) {
        snprintf(message, n, "FBARD_ISA: this processor or build has no %s; it has %s", text,
                 mpm_isa_name(mpm_isa_in_use(MPM_ISA_AUTO)));
        return false;
    }
    o->isa = (enum mpm_isa)isa;
    return true;
}

static bool complete(struct options *o, char *message, size_t n) {
    if (!isa_from_environment(o, message, n))
        return false;
    if (o->data_dir[0] == '\0' && !default_data_dir(o)) {
        snprintf(message, n, "no --data-dir, and neither XDG_STATE_HOME nor HOME names a folder");
        return false;
    }
    if ((o->tls_cert[0] == '\0') != (o->tls_key[0] == '\0')) {
        snprintf(message, n, "--tls-cert and --tls-key need each other");
        return false;
    }
    bool guarded = o->token_file[0] != '\0' && o->tls_cert[0] != '\0';
    if (!options_is_loopback(o->http_host) && !guarded && !o->insecure) {
        snprintf(message, n,
                 "--http %s is beyond loopback: give --token-file, --tls-cert and --tls-key, or "
                 "--insecure",
                 o->http_host);
        return false;
    }
    if (!o->publish_loopback && o->curve_dir[0] == '\0' && !o->insecure) {
        snprintf(
            message, n,
            "--publish %s is beyond loopback: give --curve-dir (fbar keygen), or --insecure to "
            "publish in the clear",
            o->publish);
        return false;
    }
    if (o->threads == 0)
        o->threads = available_cores() / o->slots > 0 ? available_cores() / o->slots : 1;
    if (o->memory_limit == 0)
        o->memory_limit = (size_t)(MEMORY_SHARE * (double)sysconf(_SC_PHYS_PAGES) *
                                   (double)sysconf(_SC_PAGESIZE));
    return true;
}

// In words, for the message about a value that is none.
static const char *expected_of(enum option option) {
    switch (option) {
    case OPTION_HTTP:
        return "HOST:PORT (an IPv6 address in brackets, a port up to 65535)";
    case OPTION_PUBLISH:
        return "tcp://HOST:PORT or ipc://PATH";
    case OPTION_THREADS:
    case OPTION_SLOTS:
        return "a whole number, 1 to 1024";
    case OPTION_QUEUE:
        return "a whole number, 1 to 100000";
    case OPTION_MEMORY_LIMIT:
    case OPTION_MAX_BODY:
        return "a whole number of bytes above 0, with or without K, M, G or T behind it";
    default:
        return table[option].value;
    }
}
_Static_assert(MAX_THREADS == 1024 && MAX_QUEUE == 100000, "as the words above say");

enum options_result options_parse(int argc, char *const *argv, struct options *out, char *message,
                                  size_t message_bytes) {
    *out = (struct options){.http_host = "127.0.0.1",
                            .http_port = "7800",
                            .publish = "tcp://127.0.0.1:7801",
                            .publish_loopback = true,
                            .slots = 1,
                            .queue = 64,
                            .max_body = MAX_BODY};
    for (int k = 1; k < argc; k++) {
        const char *equals = strchr(argv[k], '=');
        size_t length = equals != NULL ? (size_t)(equals - argv[k]) : strlen(argv[k]);
        int option = 0;
        while (option < N_OPTIONS && (strlen(table[option].name) != length ||
                                      strncmp(table[option].name, argv[k], length) != 0))
            option++;
        if (option == N_OPTIONS) {
            snprintf(message, message_bytes, "unknown option %s (see fbard --help)", argv[k]);
            return OPTIONS_BAD;
        }
        if (option == OPTION_HELP) {
            print_help(message, message_bytes);
            return OPTIONS_PRINTED;
        }
        if (option == OPTION_MANUAL) {
            print_manual(message, message_bytes);
            return OPTIONS_PRINTED;
        }
        if (option == OPTION_VERSION) {
            snprintf(message, message_bytes, "fbard %s\n", FBARD_VERSION);
            return OPTIONS_PRINTED;
        }
        const char *value = equals != NULL ? equals + 1 : NULL;
        if (table[option].value == NULL && value != NULL) {
            snprintf(message, message_bytes, "%s takes no value", table[option].name);
            return OPTIONS_BAD;
        }
        if (table[option].value != NULL && value == NULL) {
            if (++k == argc) {
                snprintf(message, message_bytes, "%s needs a value: %s", table[option].name,
                         table[option].value);
                return OPTIONS_BAD;
            }
            value = argv[k];
        }
        if (!assign(out, (enum option)option, value)) {
            snprintf(message, message_bytes, "%s: must be %s, got '%s'", table[option].name,
                     expected_of((enum option)option), value);
            return OPTIONS_BAD;
        }
    }
    return complete(out, message, message_bytes) ? OPTIONS_RUN : OPTIONS_BAD;
}
