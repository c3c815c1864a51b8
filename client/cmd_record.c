// fbar record and fbar recover: a run into FILE.h5.
#include <cjson/cJSON.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "client/arguments.h"
#include "client/assemble.h"
#include "client/client.h"
#include "client/framelog.h"
#include "client/recorder.h"
#include "client/report.h"
#include "client/terminal.h"

static void print_result(const struct client *client, const char *run, const char *file,
                         size_t n_frames, uint64_t bytes, bool complete) {
    if (!client->json) {
        printf("%s: run %s, %zu frames, %.1f MB%s\n", file, run, n_frames, 1e-6 * (double)bytes,
               complete ? "" : ", not complete");
        return;
    }
    cJSON *answer = cJSON_CreateObject();
    cJSON_AddStringToObject(answer, "run", run);
    cJSON_AddStringToObject(answer, "file", file);
    cJSON_AddNumberToObject(answer, "frames", (double)n_frames);
    cJSON_AddNumberToObject(answer, "bytes", (double)bytes);
    cJSON_AddBoolToObject(answer, "complete", complete);
    report_json(answer);
    cJSON_Delete(answer);
}

static int record(struct client *client, const struct arguments *arguments) {
    double compress = 0, patience = 60;
    const char *file = arguments_value(arguments, "output");
    if (!file) {
        terminal_error("usage: fbar record RUN -o FILE.h5");
        return CLIENT_USAGE;
    }
    if (arguments_number(arguments, "compress", 1, 9, &compress) != 0 ||
        arguments_number(arguments, "wait", 0, 1e9, &patience) != 0)
        return CLIENT_USAGE;
    const struct recorder_options options = {.run = arguments->positionals[0],
                                             .file = file,
                                             .compress = (int)compress,
                                             .patience_s = patience,
                                             .progress = terminal_interactive()};
    struct recorder_result result;
    const int code = recorder_record(client, &options, &result);
    if (result.was_complete && code == CLIENT_DONE)
        terminal_note("%s is complete already; it is left as it is", file);
    if (code == CLIENT_DONE || code == CLIENT_INTERRUPTED)
        print_result(client, options.run, file, result.n_frames, result.bytes, result.complete);
    return code;
}

static int recover(struct client *client, const struct arguments *arguments) {
    const char *file = arguments->positionals[0];
    char why[512];
    double compress = 0;
    struct framelog_record record;
    struct assemble_result built;
    uint64_t cut = 0;
    if (arguments_number(arguments, "compress", 1, 9, &compress) != 0)
        return CLIENT_USAGE;
    char *name = assemble_log_name(file);
    struct framelog *log = name ? framelog_open(name, false, why, sizeof why) : NULL;
    if (!log) {
        if (name && errno == ENOENT && access(file, F_OK) == 0)
            terminal_error("%s has no log beside it: there is nothing to recover", file);
        else
            terminal_error("%s", why);
        free(name);
        return CLIENT_IO;
    }
    int got;
    while ((got = framelog_read(log, &record, &cut, why, sizeof why)) == 1)
        ;
    if (got < 0)
        terminal_note("%s", why);
    if (cut > 0)
        terminal_note("%s: cut %llu bytes of an unfinished record", name, (unsigned long long)cut);
    int code = CLIENT_DONE;
    if (assemble(log, file, (int)compress, &built, why, sizeof why) != 0) {
        terminal_error("%s", why);
        code = CLIENT_IO;
    } else if (built.complete && got == 0 && unlink(name) != 0) {
        terminal_error("%s: %s", name, strerror(errno));
        code = CLIENT_IO;
    }
    if (code == CLIENT_DONE)
        print_result(client, built.run, file, built.n_frames, built.bytes, built.complete);
    framelog_close(log);
    free(name);
    return code;
}

static const struct option_spec record_options[] = {
    {"output", 'o', "FILE.h5", "the file; FILE.h5.log lies beside it until it is complete"},
    {"compress", 0, "1..9", "shuffle and deflate"},
    {"wait", 0, "SECONDS", "how long to wait for a daemon that is away (default 60)"},
    {NULL, 0, NULL, NULL},
};
static const struct option_spec recover_options[] = {
    {"compress", 0, "1..9", "shuffle and deflate"},
    {NULL, 0, NULL, NULL},
};

const struct command cmd_record = {
    .name = "record",
    .positionals = "RUN -o FILE.h5",
    .summary = "record every frame of a run, from the first to the last",
    .doc = "Ends when the run ends. Interrupted or killed, the same command goes on where it was; "
           "on a\n"
           "finished recording it does nothing.",
    .examples = "fbar record dam -o dam.h5",
    .least = 1,
    .most = 1,
    .options = record_options,
    .run = record,
};

const struct command cmd_recover = {
    .name = "recover",
    .positionals = "FILE.h5",
    .summary = "build FILE.h5 from what an interrupted recording left",
    .doc = "Works without a daemon. The log stays unless the recording was complete.",
    .least = 1,
    .most = 1,
    .options = recover_options,
    .run = recover,
};
