// fbar run: create a run, record it, show its progress, exit with its outcome.
#include <cjson/cJSON.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "client/arguments.h"
#include "client/client.h"
#include "client/cmd_run.h"
#include "client/daemon.h"
#include "client/interrupt.h"
#include "client/overrides.h"
#include "client/progress.h"
#include "client/recorder.h"
#include "client/report.h"
#include "client/request.h"
#include "client/terminal.h"

static const struct option_spec options[] = {
    {"output", 'o', "FILE.h5", "record every frame into FILE.h5 (and FILE.xdmf)"},
    {"set", 's', "KEY=VALUE",
     "override a value of the scene, as in --set materials.water.density=1e3"},
    {"id", 0, "ID", "name of the run"},
    {"detach", 'd', NULL, "leave the run to the daemon and end at once (without -o)"},
    {"compress", 0, "1..9", "shuffle and deflate the recording"},
    {NULL, 0, NULL, NULL},
};

static char *request_body(const struct arguments *arguments) {
    char *scene = overrides_scene(arguments->positionals[0]), *body = NULL, *rest = NULL;
    cJSON *patch = cJSON_CreateObject(), *members = cJSON_CreateObject();
    const char *word, *id = arguments_value(arguments, "id");
    int cursor = 0, status = scene ? 0 : -1;
    while (status == 0 && (word = arguments_next(arguments, "set", &cursor)))
        status = overrides_add(patch, word);
    cJSON_AddTrueToObject(members, "start");
    if (arguments_value(arguments, "output")) { // from the first frame on nothing is dropped
        char name[RECORDER_NAME];
        recorder_name(arguments_value(arguments, "output"), name);
        cJSON_AddItemToArray(cJSON_AddArrayToObject(members, "recorders"),
                             cJSON_CreateString(name));
    }
    if (id)
        cJSON_AddStringToObject(members, "id", id);
    rest = cJSON_PrintUnformatted(members);
    if (status == 0 && rest) {
        rest[strlen(rest) - 1] = '\0'; // members without the braces
        body = overrides_body(scene, patch, rest + 1);
    }
    free(rest);
    free(scene);
    cJSON_Delete(patch);
    cJSON_Delete(members);
    return body;
}

// Looks at the run until it is over. On Ctrl-C it is paused, or cancelled where nobody else could.
static int watch(struct client *client, const char *path, bool private, cJSON **run) {
    bool asked = false;
    double shown = -INFINITY, clock = 0;
    for (;;) {
        cJSON_Delete(*run);
        const int code = request_json(client, "GET", path, NULL, run);
        if (code != CLIENT_DONE)
            return code;
        const bool over = progress_over(*run);
        if (over || clock - shown >= progress_interval()) {
            progress_show(*run);
            shown = clock;
        }
        if (over || (asked && !private)) {
            progress_end();
            return asked ? CLIENT_INTERRUPTED : CLIENT_DONE;
        }
        if (interrupt_count() > 1)
            return CLIENT_INTERRUPTED;
        if (interrupt_count() && !asked) {
            char *action = NULL;
            terminal_note("asking the daemon to %s the run; Ctrl-C again leaves at once",
                          private ? "cancel" : "pause");
            if (asprintf(&action, "%s:%s", path, private ? "cancel" : "pause") > 0)
                request_json(client, "POST", action, NULL, NULL);
            free(action);
            asked = true;
            continue;
        }
        usleep(100000);
        clock += 0.1;
    }
}

// After an interruption: the run is another's to command, or still this user's.
static void say_how_to_go_on(const struct client *client, const cJSON *run, const char *id,
                             const char *file) {
    char to[1100] = "";
    if (client->url_given)
        snprintf(to, sizeof to, " --url %s", client->url);
    if (strcmp(progress_state(run), "paused") == 0)
        terminal_note("%s is paused; go on with `fbar%s resume %s`", id, to, id);
    else
        terminal_note("%s goes on in the daemon; look with `fbar%s watch %s`", id, to, id);
    if (file)
        terminal_note("%s holds what came so far; record the rest with `fbar%s record %s -o %s`", file,
                      to, id, file);
}

static int follow(struct client *client, const struct arguments *arguments, const char *id,
                  bool private) {
    const char *file = arguments_value(arguments, "output");
    char *path = request_path("/v1/runs/", id, "");
    double compress = 0;
    cJSON *run = NULL;
    struct recorder_result result = {0};
    int code =
        arguments_number(arguments, "compress", 1, 9, &compress) == 0 ? CLIENT_DONE : CLIENT_USAGE;
    if (code == CLIENT_DONE && file) {
        const struct recorder_options record = {.run = id,
                                                .file = file,
                                                .compress = (int)compress,
                                                .patience_s = private ? 1 : 60,
                                                .progress = true,
                                                .on_interrupt = private ? "cancel" : "pause"};
        code = recorder_record(client, &record, &result);
    } else if (code == CLIENT_DONE) {
        code = watch(client, path, private, &run);
    }
    if (code == CLIENT_DONE || code == CLIENT_INTERRUPTED) {
        cJSON_Delete(run);
        const int shown = interrupt_count() > 1 ? CLIENT_INTERRUPTED
                                                : request_json(client, "GET", path, NULL, &run);
        if (shown != CLIENT_DONE)
            run = NULL;
        if (run && client->json)
            report_json(run);
        const int outcome = !run           ? shown
                            : client->json ? report_exit_code(run)
                                           : report_outcome(run);
        if (file && !client->json)
            printf("%s: %zu frames, %.1f MB%s\n", file, result.n_frames,
                   1e-6 * (double)result.bytes, result.complete ? "" : ", not complete");
        if (code == CLIENT_DONE && private && !file && !client->json && arguments->n_positionals > 0)
            terminal_note("nothing of it is kept; -o FILE.h5 records every frame");
        if (code == CLIENT_DONE)
            code = outcome;
        else if (!private)
            say_how_to_go_on(client, run, id, file);
        else
            terminal_note("the run is over: its daemon was its own; under `fbard` it would have "
                          "been paused, to go on later");
    }
    cJSON_Delete(run);
    free(path);
    return code;
}

// What a run that was left to the daemon is called.
static void report_detached(const struct client *client, const cJSON *run, const char *id) {
    if (client->json) {
        report_json(run);
        return;
    }
    puts(id);
    terminal_note("%s runs in the daemon; `fbar watch %s` looks at it, `fbar record %s -o FILE.h5` "
                  "records it",
                  id, id, id);
}

static int create_and_follow(struct client *client, const struct arguments *arguments,
                             const char *body, bool private) {
    cJSON *run;
    const int code = request_json(client, "POST", "/v1/runs", body, &run);
    if (code != CLIENT_DONE)
        return code;
    const char *id = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(run, "id"));
    int result = CLIENT_DONE;
    if (arguments_flag(arguments, "detach"))
        report_detached(client, run, id ? id : "");
    else
        result = follow(client, arguments, id ? id : "", private);
    cJSON_Delete(run);
    return result;
}

int cmd_run_body(struct client *client, const char *body, bool private) {
    static const struct arguments none; // no scene: what runs is no run that anybody wants to keep
    return create_and_follow(client, &none, body, private);
}

static int run(struct client *client, const struct arguments *arguments) {
    const char *file = arguments_value(arguments, "output");
    double compress = 0;
    if (arguments_number(arguments, "compress", 1, 9, &compress) != 0)
        return CLIENT_USAGE;
    const bool detach = arguments_flag(arguments, "detach");
    if (detach && file) {
        terminal_error("--detach and --output exclude each other; `fbar record` records a run that "
                       "is on its way, from its first frame");
        return CLIENT_USAGE;
    }
    if (file) { // better now than after an hour
        const int code = recorder_check_file(file, arguments_value(arguments, "id"));
        if (code != CLIENT_DONE)
            return code;
    }
    char *body = request_body(arguments);
    if (!body)
        return CLIENT_USAGE;
    struct daemon daemon;
    struct client asked = *client, own;
    asked.url_given = client->url_given || detach; // a private daemon would end with this command
    int code = daemon_reach(&asked, &daemon, &own);
    if (code == CLIENT_DONE) {
        code = create_and_follow(&own, arguments, body, daemon_private(&daemon));
        daemon_leave(&daemon, &own);
    }
    free(body);
    return code;
}

const struct command cmd_run = {
    .name = "run",
    .positionals = "SCENE",
    .summary = "create a run, record it, show its progress",
    .doc = "SCENE is the name of a built-in scene (`fbar scenes`) or a .json file. Without --url, "
           "and\n"
           "with no daemon at the default address, a private one is started for this run.\n"
           "Ctrl-C pauses the run (a private daemon's is cancelled), closes the file and says how to\n"
           "go on; a second one leaves at once. Values are JSON, or else text.",
    .examples = "fbar run dam-break -o dam.h5\n"
                "fbar run dam-break -o off.h5 --set fbar=false --set time.end=0.5\n"
                "fbar run dam-break --id dam --detach\n"
                "fbar run my-scene.json -o mine.h5 --set materials.water.density=1e3",
    .least = 1,
    .most = 1,
    .options = options,
    .run = run,
};
