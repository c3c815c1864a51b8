// What the user sees: faults and notes on standard error, and one status line that is redrawn in
// place.
#pragma once
#include <stdbool.h>

// "fbar: ...", one line. Any status line is wiped first.
void terminal_error(const char *format, ...) __attribute__((format(printf, 1, 2)));
// The same for what is worth knowing and no fault; silent after terminal_quiet.
void terminal_note(const char *format, ...) __attribute__((format(printf, 1, 2)));
void terminal_quiet(void);

// Standard error is a terminal that can redraw a line.
bool terminal_interactive(void);
bool terminal_utf8(void);
int terminal_columns(void);
// Redraws the status line, cut to the terminal's width. Only where terminal_interactive().
void terminal_status(const char *text);
// Leaves the status line standing (`keep`) or wipes it.
void terminal_status_end(bool keep);
