// The progress line: bar, step, time, speed, ETA and F-bar, from the run object of the API.
#include "client/progress.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "client/terminal.h"

#define MOST_CELLS 24
#define LEAST_CELLS 8
// Columns of the words, at their longest; what is left goes to the bar. Narrower terminals get short
// words and no id.
#define SHORT_WORDS 69
#define LONG_WORDS 86
#define REDRAW_S 0.25
#define PLAIN_LINE_S 5.0

double progress_interval(void) {
    return terminal_interactive() ? REDRAW_S : PLAIN_LINE_S;
}

static double number(const cJSON *object, const char *key) {
    const cJSON *item = cJSON_GetObjectItemCaseSensitive(object, key);
    return cJSON_IsNumber(item) ? item->valuedouble : NAN;
}

const char *progress_state(const cJSON *run) {
    const char *state = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(run, "state"));
    return state ? state : "";
}

bool progress_over(const cJSON *run) {
    const char *state = progress_state(run);
    return strcmp(state, "completed") == 0 || strcmp(state, "failed") == 0 ||
           strcmp(state, "cancelled") == 0;
}

void progress_duration(double seconds, char *out, size_t n) {
    if (!(seconds >= 0) || seconds > 1e8) {
        snprintf(out, n, "?");
        return;
    }
    const long s = lround(seconds);
    if (s >= 3600)
        snprintf(out, n, "%ld:%02ld:%02ld", s / 3600, s / 60 % 60, s % 60);
    else if (s >= 60)
        snprintf(out, n, "%ld:%02ld", s / 60, s % 60);
    else
        snprintf(out, n, "%ld s", s);
}

static void bar(double fraction, int words, char *out, size_t n) {
    static const char *const eighths[] = {"", "▏", "▎", "▍", "▌", "▋", "▊", "▉"};
    const bool fine = terminal_utf8();
    const int spare = terminal_columns() - words;
    const int cells = spare < LEAST_CELLS ? LEAST_CELLS : spare > MOST_CELLS ? MOST_CELLS : spare;
    const int filled = (int)(fraction * cells * 8);
    size_t used = 0;
    for (int i = 0; i < cells && used + 4 < n; i++) {
        const int part = filled - 8 * i;
        const char *cell = part >= 8   ? fine ? "█" : "#"
                           : part <= 0 ? fine ? "░" : "."
                           : fine      ? eighths[part]
                                       : ".";
        used += (size_t)snprintf(out + used, n - used, "%s", cell);
    }
}

void progress_show(const cJSON *run) {
    static char plain[512]; // what was printed last where there is no terminal
    char line[512], cells[4 * MOST_CELLS + 8] = "", eta[32], speed[48] = "", state[32] = "";
    const double fraction = fmin(fmax(number(run, "progress"), 0), 1);
    const double rate =
        number(cJSON_GetObjectItemCaseSensitive(run, "performance"), "particle_steps_per_s");
    const cJSON *fbar = cJSON_GetObjectItemCaseSensitive(run, "fbar");
    const char *id = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(run, "id"));
    const bool live = terminal_interactive();
    const int words = LONG_WORDS + (int)(id ? strlen(id) : 3);
    const bool is_short = live && terminal_columns() < words + LEAST_CELLS;
    if (live)
        bar(fraction, is_short ? SHORT_WORDS : words, cells, sizeof cells);
    progress_duration(number(run, "eta_s"), eta, sizeof eta);
    if (strcmp(progress_state(run), "running") != 0)
        snprintf(state, sizeof state, "  %s", progress_state(run));
    if (rate > 0)
        snprintf(speed, sizeof speed, is_short ? "  %.3g M/s" : "  %.3g M particle-steps/s",
                 rate * 1e-6);
    snprintf(line, sizeof line, "%s%s%s%s%5.1f %%  step %.0f  t = %.4g s%s  ETA %s  F-bar %s%s",
             is_short ? "" : id ? id : "run", is_short ? "" : " ", cells, live ? " " : "",
             100 * fraction, number(run, "step"), number(run, "time"), speed,
             progress_over(run) ? "-" : eta,
             cJSON_IsTrue(fbar) || cJSON_IsObject(fbar) ? "on" : "off", state);
    if (live)
        terminal_status(line);
    else if (strcmp(line, plain) != 0)
        fprintf(stderr, "%s\n", line);
    if (!live)
        snprintf(plain, sizeof plain, "%s", line);
}

void progress_end(void) {
    terminal_status_end(true);
}
