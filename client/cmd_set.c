// fbar set: change the configuration of a run while it runs.
#include <cjson/cJSON.h>
#include <stdio.h>
#include <stdlib.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/overrides.h"
#include "client/report.h"
#include "client/request.h"

static int run(struct client *client, const struct arguments *arguments) {
    cJSON *patch = cJSON_CreateObject(), *answer = NULL;
    int code = CLIENT_DONE;
    for (int i = 1; i < arguments->n_positionals && code == CLIENT_DONE; i++)
        if (overrides_add(patch, arguments->positionals[i]) != 0)
            code = CLIENT_USAGE;
    char *body = cJSON_PrintUnformatted(patch);
    char *path = request_path("/v1/runs/", arguments->positionals[0], "/config");
    if (code == CLIENT_DONE)
        code = request_json(client, "PATCH", path ? path : "/", body, &answer);
    if (code == CLIENT_DONE) {
        const cJSON *step = cJSON_GetObjectItemCaseSensitive(answer, "effective_step");
        if (client->json)
            report_json(answer);
        else
            printf("%s changed at step %.0f\n", arguments->positionals[0],
                   cJSON_IsNumber(step) ? step->valuedouble : 0);
    }
    free(path);
    free(body);
    cJSON_Delete(patch);
    cJSON_Delete(answer);
    return code;
}

const struct command cmd_set = {
    .name = "set",
    .positionals = "RUN KEY=VALUE...",
    .summary = "change a run while it runs, as in `fbar set RUN fbar=false`",
    .doc =
        "Keys are fbar, damping.local, damping.mass, transfer.blend, time.dt, time.cfl, time.end,\n"
        "output.interval, gravity and the like; values are JSON.",
    .examples = "fbar set dam fbar=false\n"
                "fbar set dam 'fbar={\"scheme\": \"anchored\"}'\n"
                "fbar set dam time.end=3 output.interval=0.01",
    .least = 2,
    .most = -1,
    .run = run,
};
