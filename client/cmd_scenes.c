// fbar scenes: the built-in scenes, or one of them to start from.
#include <cjson/cJSON.h>
#include <stdio.h>
#include <stdlib.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/daemon.h"
#include "client/report.h"
#include "client/request.h"

static const char *text(const cJSON *object, const char *key) {
    const char *value = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(object, key));
    return value ? value : "";
}

static int list(struct client *client, const struct arguments *arguments) {
    cJSON *answer;
    char *path = arguments->n_positionals
                     ? request_path("/v1/scenes/", arguments->positionals[0], "")
                     : request_path("/v1/scenes", "", "");
    const int code = request_json(client, "GET", path ? path : "/", NULL, &answer);
    free(path);
    if (code != CLIENT_DONE)
        return code;
    const cJSON *scenes = cJSON_GetObjectItemCaseSensitive(answer, "scenes"), *scene;
    if (client->json || arguments->n_positionals || !cJSON_IsArray(scenes)) {
        report_json(answer);
    } else {
        cJSON_ArrayForEach(scene, scenes)
            printf("%-26s %s\n", cJSON_IsString(scene) ? scene->valuestring : text(scene, "name"),
                   text(scene, "title"));
    }
    cJSON_Delete(answer);
    return CLIENT_DONE;
}

static int run(struct client *client, const struct arguments *arguments) {
    struct daemon daemon;
    struct client own;
    int code = daemon_reach(client, &daemon, &own);
    if (code == CLIENT_DONE) {
        code = list(&own, arguments);
        daemon_leave(&daemon, &own);
    }
    return code;
}

const struct command cmd_scenes = {
    .name = "scenes",
    .positionals = "[NAME]",
    .summary = "list the built-in scenes, or print one",
    .doc = "A scene that is printed may be changed and run: `fbar run FILE.json`.",
    .examples = "fbar scenes\n"
                "fbar scenes dam-break > my-scene.json",
    .least = 0,
    .most = 1,
    .run = run,
};
