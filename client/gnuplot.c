// gnuplot is given files and not a pipe, so that what it complains about can be told apart from
// what it draws; the PNG appears under its name only when it is whole.
#include "client/gnuplot.h"

#include <errno.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

static void file_path(const struct gnuplot *g, const char *name, int number, char *out, size_t n) {
    if (number < 0)
        snprintf(out, n, "%s/%s", g->folder, name);
    else
        snprintf(out, n, "%s/%s%d", g->folder, name, number);
}

// Runs gnuplot with its input from `script` and its messages into `messages`.
static int run_gnuplot(const char *script, const char *messages, bool *missing) {
    const pid_t pid = fork();
    if (pid < 0)
        return -1;
    if (pid == 0) {
        if (!freopen(messages, "w", stderr) || !freopen("/dev/null", "r", stdin) ||
            !freopen("/dev/null", "w", stdout))
            _exit(126);
        signal(SIGPIPE, SIG_DFL);
        execlp("gnuplot", "gnuplot", script, (char *)NULL);
        _exit(127);
    }
    int status;
    while (waitpid(pid, &status, 0) < 0)
        if (errno != EINTR)
            return -1;
    *missing = WIFEXITED(status) && WEXITSTATUS(status) == 127;
    return WIFEXITED(status) && WEXITSTATUS(status) == 0 ? 0 : -1;
}

// gnuplot's complaint: the last line of its messages that says something.
static void last_message(const char *path, char *out, size_t n) {
    char line[512];
    FILE *file = fopen(path, "r");
    while (file && fgets(line, sizeof line, file)) {
        line[strcspn(line, "\n")] = '\0';
        if (strspn(line, " \t^") < strlen(line))
            snprintf(out, n, "gnuplot: %s", line);
    }
    if (file)
        fclose(file);
}

void gnuplot_put_text(FILE *script, const char *text) {
    fputc('\'', script); // where only the quote itself is doubled
    for (; *text; text++) {
        if (*text == '\'')
            fputc('\'', script);
        if ((unsigned char)*text >= 0x20)
            fputc(*text, script);
    }
    fputc('\'', script);
}

void gnuplot_put_terminal(const struct gnuplot *g, double width, double height, double font,
                          double line) {
    fprintf(g->script,
            "set encoding utf8\nset minussign\n"
            "set terminal pngcairo size %.0f,%.0f font 'DejaVu Sans,%.2f' linewidth %.3f "
            "background '#ffffff' enhanced\nset output ",
            width, height, font, line);
    gnuplot_put_text(g->script, g->png);
    fputs("\nunset key\n", g->script);
}

int gnuplot_begin(struct gnuplot *g, const char *path, char *why, size_t why_bytes) {
    const char *folder = getenv("TMPDIR");
    char script[600];
    *g = (struct gnuplot){.path = path};
    snprintf(g->folder, sizeof g->folder, "%s/fbar-plot-XXXXXX",
             folder && *folder && strlen(folder) < sizeof g->folder - 24 ? folder : "/tmp");
    if (asprintf(&g->png, "%s.tmp", path) < 0 || !mkdtemp(g->folder)) {
        snprintf(why, why_bytes, "%s: %s", g->folder, strerror(errno));
        free(g->png);
        return -1;
    }
    FILE *out = fopen(g->png, "wb"); // gnuplot would not say which file it cannot write
    if (!out) {
        snprintf(why, why_bytes, "%s: %s", path, strerror(errno));
        gnuplot_abandon(g);
        return -1;
    }
    fclose(out);
    file_path(g, "script", -1, script, sizeof script);
    g->script = fopen(script, "w");
    if (!g->script) {
        snprintf(why, why_bytes, "%s: %s", script, strerror(errno));
        gnuplot_abandon(g);
        return -1;
    }
    return 0;
}

FILE *gnuplot_data(struct gnuplot *g, char *path, size_t path_bytes) {
    file_path(g, "data", g->n_data++, path, path_bytes);
    return fopen(path, "wb");
}

void gnuplot_abandon(struct gnuplot *g) {
    char path[600];
    if (g->script)
        fclose(g->script);
    g->script = NULL;
    unlink(g->png);
    file_path(g, "script", -1, path, sizeof path);
    unlink(path);
    file_path(g, "messages", -1, path, sizeof path);
    unlink(path);
    for (int i = 0; i < g->n_data; i++) {
        file_path(g, "data", i, path, sizeof path);
        unlink(path);
    }
    rmdir(g->folder);
    free(g->png);
    g->png = NULL;
}

int gnuplot_finish(struct gnuplot *g, char *why, size_t why_bytes) {
    char script[600], messages[600];
    const bool failed = ferror(g->script) | (fclose(g->script) != 0);
    int status = -1;
    g->script = NULL;
    file_path(g, "script", -1, script, sizeof script);
    file_path(g, "messages", -1, messages, sizeof messages);
    if (failed) {
        snprintf(why, why_bytes, "%s: %s", script, strerror(errno));
    } else if (run_gnuplot(script, messages, &g->missing) != 0) {
        snprintf(why, why_bytes, "gnuplot failed");
        last_message(messages, why, why_bytes);
        if (g->missing)
            snprintf(why, why_bytes,
                     "cannot start gnuplot: install it (Debian: gnuplot-nox), or "
                     "open the file in ParaView");
    } else if (rename(g->png, g->path) != 0) {
        snprintf(why, why_bytes, "%s: %s", g->path, strerror(errno));
        last_message(messages, why, why_bytes);
    } else {
        status = 0;
    }
    gnuplot_abandon(g); // after the renaming there is no PNG to remove
    return status;
}
