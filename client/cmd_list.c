// fbar list and fbar show: the runs of a daemon.
#include <cjson/cJSON.h>
#include <stdlib.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/report.h"
#include "client/request.h"

static int list(struct client *client, const struct arguments *arguments) {
    (void)arguments;
    cJSON *answer;
    const int code = request_json(client, "GET", "/v1/runs", NULL, &answer);
    if (code != CLIENT_DONE)
        return code;
    if (client->json)
        report_json(answer);
    else
        report_runs(cJSON_GetObjectItemCaseSensitive(answer, "runs"));
    cJSON_Delete(answer);
    return CLIENT_DONE;
}

static int show(struct client *client, const struct arguments *arguments) {
    cJSON *run;
    char *path = request_path("/v1/runs/", arguments->positionals[0], "");
    const int code = request_json(client, "GET", path ? path : "/", NULL, &run);
    free(path);
    if (code != CLIENT_DONE)
        return code;
    if (client->json)
        report_json(run);
    else
        report_run(run);
    cJSON_Delete(run);
    return CLIENT_DONE;
}

const struct command cmd_list = {
    .name = "list", .positionals = "", .summary = "list the runs", .run = list};

const struct command cmd_show = {.name = "show",
                                 .positionals = "RUN",
                                 .summary = "show one run: state, speed, balance, probes",
                                 .least = 1,
                                 .most = 1,
                                 .run = show};
