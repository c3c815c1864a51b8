// What every subcommand of fbar is given, and what it gives back.
#pragma once
#include <stdbool.h>
#include <stddef.h>

struct request;
struct arguments;

// Exit codes: contract §6. An interrupted command ends as the shell's convention for SIGINT has it.
enum client_exit {
    CLIENT_DONE = 0,
    CLIENT_RUN_FAILED = 1,
    CLIENT_USAGE = 2, // or an invalid scene: what the user gave is at fault
    CLIENT_UNREACHABLE = 3,
    CLIENT_IO = 4,
    CLIENT_INTERRUPTED = 130,
};

#define CLIENT_DEFAULT_URL "http://127.0.0.1:7800"

struct client {
    const char *url; // borrowed, without a slash at the end
    bool url_given;  // by --url or FBAR_URL, so nothing else may be tried
    const char *token_file;
    const char *curve_file;   // keys for an encrypted live stream, or NULL
    bool json;                // answer in JSON on standard output
    struct request *requests; // to `url`
};

struct option_spec {
    const char *name;  // without the dashes; NULL ends a list
    char letter;       // '\0' when there is none
    const char *value; // what the help calls its value; NULL: a flag
    const char *doc;
};

// One subcommand: its table drives parsing, help, completion and the manual page alike. What stands
// for a value ("RUN", "SCENE", "FILE.h5", ...) also says how it is completed (complete.c).
struct command {
    const char *name, *positionals, *summary;
    const char *doc;      // more lines for `fbar help NAME`, or NULL
    const char *examples; // lines of commands, or NULL
    int least, most; // number of positionals; most -1: any
    const struct option_spec *options;
    // Returns an exit code.
    int (*run)(struct client *client, const struct arguments *arguments);
};

extern const struct command cmd_run, cmd_scenes, cmd_validate, cmd_list, cmd_show, cmd_start,
    cmd_pause, cmd_resume, cmd_step, cmd_cancel, cmd_set, cmd_watch, cmd_record, cmd_probes,
    cmd_info, cmd_plot, cmd_recover, cmd_delete, cmd_keygen, cmd_completion, cmd_bench;
