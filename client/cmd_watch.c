// fbar watch: the progress of a run until it is over.
#include <cjson/cJSON.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/interrupt.h"
#include "client/progress.h"
#include "client/report.h"
#include "client/request.h"

static int run(struct client *client, const struct arguments *arguments) {
    char *path = request_path("/v1/runs/", arguments->positionals[0], "");
    cJSON *run = NULL;
    int code;
    double until_shown = 0;
    for (;;) {
        cJSON_Delete(run);
        run = NULL;
        code = request_json(client, "GET", path ? path : "/", NULL, &run);
        if (code != CLIENT_DONE)
            break;
        const bool over = progress_over(run);
        if (until_shown <= 0 || over) {
            until_shown = progress_interval();
            if (client->json) { // a line a look, for pipes
                char *line = cJSON_PrintUnformatted(run);
                report_json_text(line ? line : "null");
                fflush(stdout);
                free(line);
            } else {
                progress_show(run);
            }
        }
        if (over || interrupt_count())
            break;
        usleep(250000);
        until_shown -= 0.25;
    }
    progress_end();
    if (code == CLIENT_DONE) // Ctrl-C ends the watching, not the run
        code = !progress_over(run) ? CLIENT_INTERRUPTED
               : client->json      ? report_exit_code(run)
                                   : report_outcome(run);
    cJSON_Delete(run);
    free(path);
    return code;
}

const struct command cmd_watch = {
    .name = "watch",
    .positionals = "RUN",
    .summary = "show the progress of a run until it is over",
    .least = 1,
    .most = 1,
    .run = run,
};
