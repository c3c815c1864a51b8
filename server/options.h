// The daemon's command line.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "server/mpm/mpm.h"

enum options_resume { OPTIONS_RESUME_AUTO, OPTIONS_RESUME_PAUSED, OPTIONS_RESUME_OFF };

struct options {
    char http_host[256]; // without brackets
    char http_port[8];
    char publish[300]; // a ZeroMQ endpoint
    bool publish_loopback;
    char data_dir[4096 - 256]; // room for the files inside within PATH_MAX
    char token_file[4096], tls_cert[4096], tls_key[4096], port_file[4096], curve_dir[4000];
    enum options_resume resume;
    bool insecure;
    int threads;                   // solver threads of one run, at the most
    bool threads_given;            // --threads says so: small runs have as many
    int slots;                     // runs at a time
    int queue;                     // runs that may wait for a slot
    size_t memory_limit, max_body; // bytes
    enum mpm_isa isa;              // of the solver's kernels, from FBARD_ISA
};

enum options_result { OPTIONS_RUN, OPTIONS_PRINTED, OPTIONS_BAD };

// PRINTED: --help or --version, whose text is in `message`; BAD: `message` says what is wrong.
enum options_result options_parse(int argc, char *const *argv, struct options *out, char *message,
                                  size_t message_bytes);

// "512M", "8G", "65536": bytes. False when it is no such thing.
bool options_bytes(const char *text, size_t *out);
// Whether the host names this machine's loopback interface.
bool options_is_loopback(const char *host);
