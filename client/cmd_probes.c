// fbar probes: the time series of a run's probes.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/report.h"
#include "client/request.h"
#include "client/terminal.h"

static const struct option_spec options[] = {
    {"csv", 0, NULL, "comma-separated values: step, time, a column a probe (the default)"},
    {"since", 0, "STEP", "only what came after this step"},
    {NULL, 0, NULL, NULL},
};

static int run(struct client *client, const struct arguments *arguments) {
    struct reply reply;
    char after[64];
    double since = 0;
    if (arguments_number(arguments, "since", 0, 1e15, &since) != 0)
        return CLIENT_USAGE;
    if (client->json && arguments_flag(arguments, "csv")) {
        terminal_error("--json and --csv exclude each other");
        return CLIENT_USAGE;
    }
    snprintf(after, sizeof after, "/probes");
    if (arguments_flag(arguments, "since"))
        snprintf(after, sizeof after, "/probes?since_step=%.0f", since);
    char *path = request_path("/v1/runs/", arguments->positionals[0], after);
    const struct request_spec spec = {.method = "GET",
                                      .path = path ? path : "/",
                                      .accept = client->json ? "application/json" : "text/csv"};
    const int code = request_expect(client, &spec, &reply);
    free(path);
    if (code != CLIENT_DONE)
        return code;
    if (client->json) {
        report_json_text(reply.body);
    } else {
        fwrite(reply.body, 1, reply.bytes, stdout);
        if (reply.bytes > 0 && reply.body[reply.bytes - 1] != '\n')
            putchar('\n');
    }
    request_reply_free(&reply);
    return CLIENT_DONE;
}

const struct command cmd_probes = {
    .name = "probes",
    .positionals = "RUN",
    .summary = "print the time series of the probes",
    .examples = "fbar probes dam > dam.csv\n"
                "fbar --json probes dam --since 1000",
    .least = 1,
    .most = 1,
    .options = options,
    .run = run,
};
