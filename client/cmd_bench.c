// fbar bench: one point of a study of the report, run again.
//
// The points follow from bench/accuracy.json, which bench/accuracy.py runs them all by and which is
// built in: a problem, a cell, and the default method or one that differs from it in basis and
// scheme or in one factor. What is measured goes along as the references of the run, so that its
// errors are the daemon's.
#include <cjson/cJSON.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/arguments.h"
#include "client/bench_points.h"
#include "client/client.h"
#include "client/cmd_run.h"
#include "client/daemon.h"
#include "client/overrides.h"
#include "client/report.h"
#include "client/terminal.h"

static const struct option_spec options[] = {
    {"case", 'c', "NAME", "the point to run"},
    {"list", 'l', NULL, "name all points"},
    {NULL, 0, NULL, NULL},
};

static void print_name(void *context, const struct bench_point *point) {
    cJSON *names = context;
    if (names)
        cJSON_AddItemToArray(names, cJSON_CreateString(point->name));
    else
        puts(point->name);
}

static int list(const struct client *client, const cJSON *study) {
    cJSON *answer = client->json ? cJSON_CreateObject() : NULL;
    bench_each(study, print_name, answer ? cJSON_AddArrayToObject(answer, "cases") : NULL);
    if (answer)
        report_json(answer);
    cJSON_Delete(answer);
    return CLIENT_DONE;
}

struct search {
    const char *name;
    char *body; // of the request, when the point was found
    char closest[BENCH_NAME];
    size_t shared; // characters that the closest one begins with as well
};

static void look(void *context, const struct bench_point *point) {
    struct search *search = context;
    size_t shared = 0;
    while (point->name[shared] && point->name[shared] == search->name[shared])
        shared++;
    if (shared > search->shared) {
        search->shared = shared;
        snprintf(search->closest, sizeof search->closest, "%s", point->name);
    }
    if (strcmp(point->name, search->name) == 0) {
        cJSON *patch = bench_overrides(point);
        char scene[100];
        snprintf(scene, sizeof scene, "\"%s\"", point->scene);
        search->body = overrides_body(scene, patch, "\"start\":true");
        cJSON_Delete(patch);
    }
}

static int run(struct client *client, const struct arguments *arguments) {
    const char *name = arguments_value(arguments, "case");
    if (strcmp(arguments->positionals[0], "accuracy") != 0) {
        terminal_error("%s: unknown study; there is accuracy", arguments->positionals[0]);
        return CLIENT_USAGE;
    }
    cJSON *study = bench_study();
    if (!study)
        return CLIENT_IO;
    if (arguments_flag(arguments, "list") || !name) {
        const bool asked = arguments_flag(arguments, "list");
        const int code = asked ? list(client, study) : CLIENT_USAGE;
        if (!asked)
            terminal_error("--case NAME is missing; `fbar bench accuracy --list` names the points, "
                           "`make report` runs them all");
        cJSON_Delete(study);
        return code;
    }
    struct search search = {.name = name};
    bench_each(study, look, &search);
    cJSON_Delete(study);
    if (!search.body) {
        terminal_error(
            "--case: there is no point %s%s%s%s; `fbar bench accuracy --list` names them", name,
            *search.closest ? "; did you mean " : "", search.closest, *search.closest ? "?" : "");
        return CLIENT_USAGE;
    }
    struct daemon daemon;
    struct client own;
    int code = daemon_reach(client, &daemon, &own);
    if (code == CLIENT_DONE) {
        code = cmd_run_body(&own, search.body, daemon_private(&daemon));
        daemon_leave(&daemon, &own);
    }
    free(search.body);
    return code;
}

const struct command cmd_bench = {
    .name = "bench",
    .positionals = "STUDY",
    .summary = "run one point of the report's study of errors again",
    .doc = "STUDY is accuracy. NAME says problem, basis, scheme, CFL number, particles per cell, "
           "FLIP\n"
           "blend and cell. What is printed is the run's speed and its errors, each with the "
           "measure's\n"
           "name behind it; `make report` draws all points, docs/report-small.md shows them.",
    .examples = "fbar bench accuracy --list\n"
                "fbar bench accuracy --case cook-bspline2-anchored-0.3-4-1-2",
    .least = 1,
    .most = 1,
    .options = options,
    .run = run,
};
