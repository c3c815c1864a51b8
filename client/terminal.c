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

static bool status_shown, quiet;

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
    while (*end && columns > 0) { // a character is a byte that does not continue one
        end++;
        while (((unsigned char)*end & 0xC0) == 0x80)
            end++;
        columns--;
    }
    fprintf(stderr, "\r\033[K%.*s", (int)(end - text), text);
    fflush(stderr);
    status_shown = true;
}

static void say(const char *format, va_list args) {
    terminal_status_end(false);
    fputs("fbar: ", stderr);
    vfprintf(stderr, format, args);
    fputc('\n', stderr);
}

void terminal_error(const char *format, ...) {
    va_list args;
    va_start(args, format);
    say(format, args);
    va_end(args);
}

void terminal_note(const char *format, ...) {
    if (quiet)
        return;
    va_list args;
    va_start(args, format);
    say(format, args);
    va_end(args);
}

void terminal_quiet(void) {
    quiet = true;
}
