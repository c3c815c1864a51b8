// fbar validate: every fault of a scene, or what it will cost.
#include <cjson/cJSON.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/daemon.h"
#include "client/overrides.h"
#include "client/report.h"
#include "client/request.h"
#include "client/terminal.h"

static const struct option_spec options[] = {
    {"set", 's', "KEY=VALUE", "override a value of the scene"},
    {NULL, 0, NULL, NULL},
};

// A built-in scene is asked for first: the daemon validates scenes, not names.
static int scene_text(struct client *client, const char *word, char **out) {
    *out = overrides_scene(word);
    if (!*out)
        return CLIENT_USAGE;
    if ((*out)[0] != '"')
        return CLIENT_DONE;
    free(*out);
    *out = NULL;
    struct reply reply;
    char *path = request_path("/v1/scenes/", word, "");
    const struct request_spec spec = {
        .method = "GET", .path = path ? path : "/", .accept = "application/json"};
    const int code = request_expect(client, &spec, &reply);
    free(path);
    if (code == CLIENT_DONE)
        *out = reply.body;
    return code;
}

// What else there is in the estimate of a later daemon is shown as it is.
static const struct {
    const char *key, *label;
    double factor;
    const char *unit;
} lines[] = {
    {"dt", "dt", 1, " s"},
    {"dt_limit", "dt at most", 1, " s"},
    {"bytes", "memory", 1e-6, " MB"},
};

static void print_estimate(const cJSON *answer) {
    const cJSON *estimate = cJSON_GetObjectItemCaseSensitive(answer, "estimate"), *item;
    if (!cJSON_IsObject(estimate))
        estimate = answer;
    puts("valid");
    cJSON_ArrayForEach(item, estimate) {
        const char *label = item->string, *unit = "";
        double factor = 1;
        for (size_t k = 0; k < sizeof lines / sizeof *lines; k++) {
            if (strcmp(item->string, lines[k].key) == 0) {
                label = lines[k].label;
                factor = lines[k].factor;
                unit = lines[k].unit;
            }
        }
        if (cJSON_IsNumber(item))
            printf("%-12s %.6g%s\n", label, factor * item->valuedouble, unit);
    }
    cJSON_ArrayForEach(item, cJSON_GetObjectItemCaseSensitive(answer, "warnings")) {
        if (cJSON_IsString(item))
            terminal_note("warning: %s", item->valuestring);
    }
}

static int validate(struct client *client, const struct arguments *arguments) {
    char *scene, *body = NULL;
    cJSON *patch = cJSON_CreateObject(), *answer = NULL;
    const char *word;
    int cursor = 0, code = CLIENT_DONE;
    while (code == CLIENT_DONE && (word = arguments_next(arguments, "set", &cursor)))
        if (overrides_add(patch, word) != 0)
            code = CLIENT_USAGE;
    if (code == CLIENT_DONE &&
        (code = scene_text(client, arguments->positionals[0], &scene)) == CLIENT_DONE) {
        body = overrides_body(scene, patch, "");
        code = body ? request_json(client, "POST", "/v1/scenes:validate", body, &answer)
                    : CLIENT_USAGE;
        free(scene);
    }
    if (code == CLIENT_DONE && client->json)
        report_json(answer);
    else if (code == CLIENT_DONE)
        print_estimate(answer);
    free(body);
    cJSON_Delete(patch);
    cJSON_Delete(answer);
    return code;
}

static int run(struct client *client, const struct arguments *arguments) {
    struct daemon daemon;
    struct client own;
    int code = daemon_reach(client, &daemon, &own);
    if (code == CLIENT_DONE) {
        code = validate(&own, arguments);
        daemon_leave(&daemon, &own);
    }
    return code;
}

const struct command cmd_validate = {
    .name = "validate",
    .positionals = "SCENE",
    .summary = "check a scene and estimate its cost",
    .doc = "Every fault comes with its place (a JSON pointer), what was expected and what was there.",
    .examples = "fbar validate my-scene.json\n"
                "fbar validate dam-break --set cell=0.125",
    .least = 1,
    .most = 1,
    .options = options,
    .run = run,
};
