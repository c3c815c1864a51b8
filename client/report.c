// Prints run objects of the API (contract §2).
#include "client/report.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/client.h"
#include "client/progress.h"
#include "client/terminal.h"

static bool printed;

void report_json(const cJSON *value) {
    char *text = cJSON_Print(value);
    report_json_text(text ? text : "null");
    free(text);
}

void report_json_text(const char *text) {
    puts(text);
    printed = true;
}

bool report_printed(void) {
    return printed;
}

static const cJSON *member(const cJSON *object, const char *key) {
    return cJSON_GetObjectItemCaseSensitive(object, key);
}

static double number(const cJSON *object, const char *key) {
    const cJSON *item = member(object, key);
    return cJSON_IsNumber(item) ? item->valuedouble : NAN;
}

static const char *text(const cJSON *object, const char *key) {
    const char *value = cJSON_GetStringValue(member(object, key));
    return value ? value : "";
}

static const char *fbar_word(const cJSON *run) {
    const cJSON *fbar = member(run, "fbar");
    if (cJSON_IsObject(fbar))
        return text(fbar, "scheme");
    return cJSON_IsString(fbar) ? fbar->valuestring : cJSON_IsTrue(fbar) ? "on" : "off";
}

// A scene may be named, or given whole.
static const char *scene_word(const cJSON *run) {
    const cJSON *scene = member(run, "scene");
    if (cJSON_IsString(scene))
        return scene->valuestring;
    const char *title = text(scene, "title");
    return *title ? title : "";
}

// The state in its colour, padded to `width` where that is not 0.
static void print_state(const cJSON *run, int width) {
    static const struct {
        const char *state;
        enum terminal_style style;
    } styles[] = {{"running", TERMINAL_BUSY}, {"completed", TERMINAL_GOOD}, {"failed", TERMINAL_BAD},
                  {"waiting", TERMINAL_WARN}, {"paused", TERMINAL_WARN},    {"cancelled", TERMINAL_WARN}};
    const char *state = text(run, "state"), *paint = "";
    for (size_t i = 0; i < sizeof styles / sizeof *styles; i++)
        if (strcmp(styles[i].state, state) == 0)
            paint = terminal_paint(stdout, styles[i].style);
    printf("%s%s%s%*s", paint, state, *paint ? terminal_paint(stdout, TERMINAL_PLAIN) : "",
           width > (int)strlen(state) ? width - (int)strlen(state) : 0, "");
}

static void print_value(const cJSON *value) {
    if (cJSON_IsNumber(value)) {
        printf("%.6g", value->valuedouble);
    } else if (cJSON_IsArray(value) || cJSON_IsObject(value)) {
        const cJSON *item;
        bool first = true;
        cJSON_ArrayForEach(item, value) {
            if (!first)
                fputs(", ", stdout);
            if (item->string)
                printf("%s ", item->string);
            print_value(item);
            first = false;
        }
    } else {
        char *other = cJSON_PrintUnformatted(value);
        fputs(other ? other : "?", stdout);
        free(other);
    }
}

void report_runs(const cJSON *runs) {
    const cJSON *run;
    if (cJSON_GetArraySize(runs) == 0) {
        puts("no runs; `fbar run SCENE` makes one");
        return;
    }
    printf("%s%-26s %-10s %7s %10s %10s %10s %-8s %s%s\n", terminal_paint(stdout, TERMINAL_BOLD),
           "RUN", "STATE", "DONE", "STEP", "TIME / s", "PARTICLES", "F-BAR", "SCENE",
           terminal_paint(stdout, TERMINAL_PLAIN));
    cJSON_ArrayForEach(run, runs) {
        printf("%-26s ", text(run, "id"));
        print_state(run, 10);
        printf(" %5.1f %% %10.0f %10.4g %10.0f %-8s %s\n", 100 * number(run, "progress"),
               number(run, "step"), number(run, "time"), number(run, "particles"), fbar_word(run),
               scene_word(run));
    }
}

static void print_references(const cJSON *accuracy) {
    const cJSON *entry;
    cJSON_ArrayForEach(entry, accuracy) {
        const cJSON *at = member(entry, "at"), *value = member(entry, "value");
        const double reference = number(entry, "reference");
        printf("  %s", text(entry, "probe"));
        if (*text(entry, "component"))
            printf(".%s", text(entry, "component"));
        if (cJSON_IsNumber(at))
            printf(" at t = %.4g s", at->valuedouble);
        fputs(": ", stdout);
        if (cJSON_IsNull(value))
            fputs("not reached", stdout);
        else
            print_value(value);
        printf(", reference %.6g", reference);
        // Of a reference of 0 the value itself is the error.
        if (cJSON_IsNumber(member(entry, "relative_error")) && reference != 0)
            printf(" (off by %.2f %%)", 100 * fabs(number(entry, "relative_error")));
        printf("  [%s]\n", text(entry, "source"));
    }
}

static void print_error(const cJSON *error) {
    if (!cJSON_IsObject(error))
        return;
    const cJSON *item;
    const char *first = *text(error, "detail") ? text(error, "detail") : text(error, "kind");
    printf("error      %s\n", first);
    cJSON_ArrayForEach(item, error) if (item->string && !cJSON_IsNull(item) &&
                                        strcmp(item->string, "detail") != 0) {
        printf("           %s: ", item->string);
        print_value(item);
        putchar('\n');
    }
}

void report_run(const cJSON *run) {
    char eta[32], wall[32];
    const cJSON *item, *performance = member(run, "performance"), *balance = member(run, "balance");
    progress_duration(number(run, "eta_s"), eta, sizeof eta);
    progress_duration(number(performance, "wall_s"), wall, sizeof wall);
    printf("run        %s (%s)\n", text(run, "id"), text(run, "created"));
    printf("scene      %s\n", scene_word(run));
    fputs("state      ", stdout);
    print_state(run, 0);
    const bool ends = strcmp(text(run, "state"), "running") == 0;
    printf(", %.1f %%%s%s\n", 100 * number(run, "progress"), ends ? ", ETA " : "", ends ? eta : "");
    printf("step       %.0f, t = %.6g s of %.6g s, dt = %.4g s\n", number(run, "step"),
           number(run, "time"), number(run, "end_time"), number(run, "dt"));
    printf("particles  %.0f, F-bar %s\n", number(run, "particles"), fbar_word(run));
    printf("speed      %.3g million particle-steps/s, %s",
           1e-6 * number(performance, "particle_steps_per_s"), wall);
    const double threads = number(performance, "threads");
    if (threads > 0)
        printf(" on %.0f thread%s", threads, threads > 1 ? "s" : "");
    putchar('\n');
    cJSON_ArrayForEach(item, balance) {
        printf("%-10s %s = ", item == balance->child ? "balance" : "", item->string);
        print_value(item);
        putchar('\n');
    }
    const cJSON *probes = member(run, "probes");
    cJSON_ArrayForEach(item, probes) {
        printf("%-10s %s = ", item == probes->child ? "probes" : "", item->string);
        print_value(item);
        putchar('\n');
    }
    if (cJSON_GetArraySize(member(run, "accuracy")) > 0) {
        puts("accuracy");
        print_references(member(run, "accuracy"));
    }
    cJSON_ArrayForEach(item, member(run, "warnings")) {
        fputs("warning    ", stdout);
        print_value(item);
        putchar('\n');
    }
    print_error(member(run, "error"));
}

int report_exit_code(const cJSON *run) {
    return strcmp(text(run, "state"), "failed") == 0 || strcmp(text(run, "state"), "cancelled") == 0
               ? CLIENT_RUN_FAILED
               : CLIENT_DONE;
}

static void complain(const cJSON *error) {
    const char *detail = text(error, "detail"), *quantity = text(error, "quantity");
    if (*detail)
        terminal_error("%s", detail);
    else if (*quantity)
        terminal_error("%s: %s of particle %.0f is %g at step %.0f, t = %g s", text(error, "kind"),
                       quantity, number(error, "particle"), number(error, "value"),
                       number(error, "step"), number(error, "time"));
    else
        terminal_error("the run failed: %s", text(error, "kind"));
    if (*text(error, "advice"))
        terminal_error("%s", text(error, "advice"));
}

int report_outcome(const cJSON *run) {
    char wall[32];
    const cJSON *performance = member(run, "performance");
    progress_duration(number(performance, "wall_s"), wall, sizeof wall);
    printf("%s ", text(run, "id"));
    print_state(run, 0);
    printf(": %.0f particles, %.0f steps, t = %.4g s in %s, %.3g million particle-steps/s\n",
           number(run, "particles"), number(run, "step"), number(run, "time"), wall,
           1e-6 * number(performance, "particle_steps_per_s"));
    print_references(member(run, "accuracy"));
    fflush(stdout);
    if (cJSON_IsObject(member(run, "error")))
        complain(member(run, "error"));
    return report_exit_code(run);
}
