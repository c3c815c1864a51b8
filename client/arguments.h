// Command lines: options may stand anywhere, --name value or --name=value, and `--` ends them.
#pragma once
#include <stdbool.h>

#include "client/client.h"

#define ARGUMENTS_MAX 256

struct arguments {
    int n_positionals, n_options;
    const char *positionals[ARGUMENTS_MAX];
    struct {
        const struct option_spec *spec;
        const char *value; // NULL for a flag
    } options[ARGUMENTS_MAX];
};

// Options that every command takes; ends with a NULL name.
extern const struct option_spec arguments_global[];

// Sorts argv[0..argc) into `out`; `command` NULL admits the global options only and stops at the
// first positional, whose index is returned. -1 with the fault printed, otherwise the number of
// words used.
int arguments_parse(int argc, char **argv, const struct command *command, struct arguments *out);

bool arguments_flag(const struct arguments *arguments, const char *name);
// The last value given, or NULL.
const char *arguments_value(const struct arguments *arguments, const char *name);
// The next value of a repeated option, or NULL; *cursor starts at 0.
const char *arguments_next(const struct arguments *arguments, const char *name, int *cursor);
// A number within [least, most]: 0 and *out untouched when the option was not given; -1 with the
// fault printed when it is none.
int arguments_number(const struct arguments *arguments, const char *name, double least, double most,
                     double *out);
// The same of a text; `name` is what a fault calls it.
int arguments_read_number(const char *name, const char *text, double least, double most,
                          double *out);
// The name in a NULL-ended list that is closest to `word`, or NULL when none is close.
const char *arguments_closest(const char *word, const char *const *names);
