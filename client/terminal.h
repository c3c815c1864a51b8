// What the user sees: faults and notes on standard error, and one status line that is redrawn in
// place.
#pragma once
#include <stdbool.h>
#include <stdio.h>

// "fbar: ...", one line. Any status line is wiped first.
void terminal_error(const char *format, ...) __attribute__((format(printf, 1, 2)));
// The same for what is worth knowing and no fault; silent after terminal_quiet.
void terminal_note(const char *format, ...) __attribute__((format(printf, 1, 2)));
void terminal_quiet(void);
// Prints no faults and notes at all.
void terminal_mute(void);
// The faults printed so far, in their order (the first 64): NULL past the last.
const char *terminal_fault(int index);

// Colours are for terminals only, and not where NO_COLOR is set (no-color.org).
enum terminal_style {
    TERMINAL_PLAIN,
    TERMINAL_BOLD,
    TERMINAL_GOOD,
    TERMINAL_BAD,
    TERMINAL_WARN,
    TERMINAL_BUSY
};
// The escape sequence that begins the style on standard output or standard error, or "".
const char *terminal_paint(FILE *stream, enum terminal_style style);

// Standard error is a terminal that can redraw a line.
bool terminal_interactive(void);
bool terminal_utf8(void);
int terminal_columns(void);
// Redraws the status line, cut to the terminal's width. Only where terminal_interactive().
void terminal_status(const char *text);
// Leaves the status line standing (`keep`) or wipes it.
void terminal_status_end(bool keep);
