// Messages and the status line. State of the terminal is the process's own, hence the statics.
#include "client/terminal.h"

#include <langinfo.h>
#include <locale.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>

#define FAULTS_MOST 64

static bool status_shown, quiet, mute;
static char *faults[FAULTS_MOST];
static int n_faults;

const char *terminal_paint(FILE *stream, enum terminal_style style) {
    static const char *const escapes[] = {
        [TERMINAL_PLAIN] = "\033[0m", [TERMINAL_BOLD] = "\033[1m",  [TERMINAL_GOOD] = "\033[32m",
        [TERMINAL_BAD] = "\033[31m",  [TERMINAL_WARN] = "\033[33m", [TERMINAL_BUSY] = "\033[36m"};
    const char *term = getenv("TERM"), *no_color = getenv("NO_COLOR");
    const bool painted = isatty(fileno(stream)) && term && strcmp(term, "dumb") != 0 &&
                         !(no_color && *no_color);
    return painted ? escapes[style] : "";
}

bool terminal_interactive(void) {
    const char *term = getenv("TERM");
    return isatty(STDERR_FILENO) && term && strcmp(term, "dumb") != 0;
}

bool terminal_utf8(void) {
    // LC_CTYPE only: numbers stay in the C locale, since they are data.
    setlocale(LC_CTYPE, "");
    return strcmp(nl_langinfo(CODESET), "UTF-8") == 0;
}

int terminal_columns(void) {
    struct winsize size;
    return ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 0 ? size.ws_col : 80;
}

void terminal_status_end(bool keep) {
    if (!status_shown)
        return;
    fputs(keep ? "\n" : "\r\033[K", stderr);
    status_shown = false;
}

void terminal_status(const char *text) {
    int columns = terminal_columns() - 1;
    const char *end = text;
    while (*end && columns > 0) {
        if (*end == '\033') { // a style takes no room
            end += strcspn(end, "m");
            end += *end != '\0';
            continue;
        }
        end++; // a character is a byte that does not continue one
        while (((unsigned char)*end & 0xC0) == 0x80)
            end++;
        columns--;
    }
    fprintf(stderr, "\r\033[K%.*s%s", (int)(end - text), text,
            terminal_paint(stderr, TERMINAL_PLAIN));
    fflush(stderr);
    status_shown = true;
}

static void say(enum terminal_style style, const char *text) {
    if (mute)
        return;
    terminal_status_end(false);
    fprintf(stderr, "%sfbar:%s %s\n", terminal_paint(stderr, style),
            terminal_paint(stderr, TERMINAL_PLAIN), text ? text : "out of memory");
}

void terminal_error(const char *format, ...) {
    va_list args;
    char *text = NULL;
    va_start(args, format);
    if (vasprintf(&text, format, args) < 0)
        text = NULL;
    va_end(args);
    say(TERMINAL_BAD, text);
    if (text && n_faults < FAULTS_MOST)
        faults[n_faults++] = text; // kept until the end
    else
        free(text);
}

const char *terminal_fault(int index) {
    return index < n_faults ? faults[index] : NULL;
}

void terminal_note(const char *format, ...) {
    va_list args;
    char *text = NULL;
    if (quiet)
        return;
    va_start(args, format);
    if (vasprintf(&text, format, args) < 0)
        text = NULL;
    va_end(args);
    say(TERMINAL_WARN, text);
    free(text);
}

void terminal_quiet(void) {
    quiet = true;
}

void terminal_mute(void) {
    mute = true;
}
