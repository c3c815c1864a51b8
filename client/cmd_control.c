// fbar start, pause, resume, step, cancel and delete: actions on a run.
#include <cjson/cJSON.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/progress.h"
#include "client/report.h"
#include "client/request.h"
#include "client/terminal.h"

static int act(struct client *client, const char *id, const char *action, const char *body) {
    char after[24];
    cJSON *run;
    snprintf(after, sizeof after, ":%s", action);
    char *path = request_path("/v1/runs/", id, after);
    const int code = request_json(client, "POST", path ? path : "/", body, &run);
    free(path);
    if (code != CLIENT_DONE)
        return code;
    const cJSON *step = cJSON_GetObjectItemCaseSensitive(run, "effective_step");
    if (client->json)
        report_json(run);
    else if (cJSON_IsNumber(step))
        printf("%s %s at step %.0f\n", id, progress_state(run), step->valuedouble);
    else
        printf("%s %s\n", id, progress_state(run));
    cJSON_Delete(run);
    return CLIENT_DONE;
}

static int start(struct client *client, const struct arguments *arguments) {
    return act(client, arguments->positionals[0], "start", NULL);
}

static int hold(struct client *client, const struct arguments *arguments) {
    return act(client, arguments->positionals[0], "pause", NULL);
}

static int resume(struct client *client, const struct arguments *arguments) {
    return act(client, arguments->positionals[0], "resume", NULL);
}

static int cancel(struct client *client, const struct arguments *arguments) {
    return act(client, arguments->positionals[0], "cancel", NULL);
}

static int step(struct client *client, const struct arguments *arguments) {
    char body[80];
    double steps = 1, until = 0;
    const bool counted = arguments->n_positionals > 1;
    if (counted + arguments_flag(arguments, "steps") + arguments_flag(arguments, "until") > 1) {
        terminal_error("step takes one of N, --steps N and --until TIME");
        return CLIENT_USAGE;
    }
    if ((counted && arguments_read_number("N", arguments->positionals[1], 1, 1e15, &steps) != 0) ||
        arguments_number(arguments, "steps", 1, 1e15, &steps) != 0 ||
        arguments_number(arguments, "until", -1e300, 1e300, &until) != 0)
        return CLIENT_USAGE;
    if (steps != floor(steps)) {
        terminal_error("the number of steps must be an integer, got %g", steps);
        return CLIENT_USAGE;
    }
    if (arguments_flag(arguments, "until"))
        snprintf(body, sizeof body, "{\"until\":%.17g}", until);
    else
        snprintf(body, sizeof body, "{\"steps\":%.0f}", steps);
    return act(client, arguments->positionals[0], "step", body);
}

static int delete (struct client *client, const struct arguments *arguments) {
    struct reply reply;
    char *path = request_path("/v1/runs/", arguments->positionals[0], "");
    const struct request_spec spec = {.method = "DELETE", .path = path ? path : "/"};
    const int code = request_expect(client, &spec, &reply);
    free(path);
    if (code != CLIENT_DONE)
        return code;
    request_reply_free(&reply);
    if (client->json)
        report_json_text("{\"deleted\": true}");
    return CLIENT_DONE;
}

static const struct option_spec step_options[] = {
    {"steps", 'n', "N", "number of steps (default 1), like N"},
    {"until", 'u', "TIME", "run to this time, s, instead"},
    {NULL, 0, NULL, NULL},
};

#define ACTION(NAME, FUNCTION, SUMMARY)                                                            \
    const struct command cmd_##NAME = {.name = #NAME,                                              \
                                       .positionals = "RUN",                                       \
                                       .summary = SUMMARY,                                         \
                                       .least = 1,                                                 \
                                       .most = 1,                                                  \
                                       .run = FUNCTION}
ACTION(start, start, "start a run that was created without starting");
ACTION(pause, hold, "pause a run at the next step");
ACTION(resume, resume, "continue a paused run");
ACTION(cancel, cancel, "end a run for good, keeping its frames");
ACTION(delete, delete, "remove a finished run and its files");

const struct command cmd_step = {
    .name = "step",
    .positionals = "RUN [N]",
    .summary = "run N steps (1) of a paused run, then pause again",
    .examples = "fbar step dam 100\n"
                "fbar step dam --until 0.4",
    .least = 1,
    .most = 2,
    .options = step_options,
    .run = step,
};
