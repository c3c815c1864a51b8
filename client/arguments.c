// Parsing of command lines from the option tables of the commands.
#include "client/arguments.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "client/terminal.h"

const struct option_spec arguments_global[] = {
    {"url", 0, "URL", "the daemon (default " CLIENT_DEFAULT_URL ", or FBAR_URL)"},
    {"token-file", 0, "FILE", "file that holds the daemon's token"},
    {"curve-file", 0, "FILE", "keys for an encrypted live stream, from `fbar keygen`"},
    {"json", 0, NULL, "answer in JSON on standard output"},
    {"help", 'h', NULL, "show this help"},
    {"version", 0, NULL, "print the version"},
    {NULL, 0, NULL, NULL},
};

// Levenshtein distance of two short words.
static size_t distance(const char *a, const char *b) {
    size_t row[64];
    const size_t n = strlen(b);
    if (n >= 64)
        return n;
    for (size_t j = 0; j <= n; j++)
        row[j] = j;
    for (size_t i = 0; a[i]; i++) {
        size_t diagonal = row[0];
        row[0] = i + 1;
        for (size_t j = 0; j < n; j++) {
            const size_t above = row[j + 1];
            size_t best = diagonal + (a[i] != b[j]);
            if (above + 1 < best)
                best = above + 1;
            if (row[j] + 1 < best)
                best = row[j] + 1;
            diagonal = above;
            row[j + 1] = best;
        }
    }
    return row[n];
}

const char *arguments_closest(const char *word, const char *const *names) {
    const char *closest = NULL;
    size_t least = 1 + strlen(word) / 3; // farther away is another word, not a slip
    for (; *names; names++) {
        const size_t d = distance(word, *names);
        if (d <= least) {
            least = d;
            closest = *names;
        }
    }
    return closest;
}

static const struct option_spec *spec_named(const struct option_spec *specs, const char *name,
                                            size_t n) {
    for (; specs && specs->name; specs++)
        if (strlen(specs->name) == n && strncmp(specs->name, name, n) == 0)
            return specs;
    return NULL;
}

static const struct option_spec *spec_lettered(const struct option_spec *specs, char letter) {
    for (; specs && specs->name; specs++)
        if (specs->letter && specs->letter == letter)
            return specs;
    return NULL;
}

static int complain_unknown(const char *word, const struct option_spec *own) {
    const char *names[64];
    size_t n = 0;
    for (const struct option_spec *s = own; s && s->name && n < 63; s++)
        names[n++] = s->name;
    for (const struct option_spec *s = arguments_global; s->name && n < 63; s++)
        names[n++] = s->name;
    names[n] = NULL;
    const char *closest = strncmp(word, "--", 2) == 0 ? arguments_closest(word + 2, names) : NULL;
    if (closest)
        terminal_error("%s: unknown option; did you mean --%s?", word, closest);
    else
        terminal_error("%s: unknown option; try --help", word);
    return -1;
}

int arguments_parse(int argc, char **argv, const struct command *command, struct arguments *out) {
    const struct option_spec *own = command ? command->options : NULL;
    bool options_over = false;
    *out = (struct arguments){0};
    for (int i = 0; i < argc; i++) {
        const char *word = argv[i], *value = NULL;
        const struct option_spec *spec;
        if (out->n_options == ARGUMENTS_MAX || out->n_positionals == ARGUMENTS_MAX) {
            terminal_error("too many arguments");
            return -1;
        }
        if (options_over || word[0] != '-' || word[1] == '\0') {
            if (!command)
                return i;
            out->positionals[out->n_positionals++] = word;
            continue;
        }
        if (strcmp(word, "--") == 0) {
            options_over = true;
            continue;
        }
        if (word[1] == '-') {
            const char *equals = strchr(word, '=');
            const size_t n = equals ? (size_t)(equals - word - 2) : strlen(word + 2);
            value = equals ? equals + 1 : NULL;
            spec = spec_named(own, word + 2, n);
            if (!spec)
                spec = spec_named(arguments_global, word + 2, n);
        } else {
            value = word[2] ? word + 2 : NULL;
            spec = spec_lettered(own, word[1]);
            if (!spec)
                spec = spec_lettered(arguments_global, word[1]);
        }
        if (!spec)
            return complain_unknown(word, own);
        if (!spec->value && value) {
            terminal_error("--%s takes no value", spec->name);
            return -1;
        }
        if (spec->value && !value) {
            if (i + 1 == argc) {
                terminal_error("--%s needs a value: %s", spec->name, spec->value);
                return -1;
            }
            value = argv[++i];
        }
        out->options[out->n_options].spec = spec;
        out->options[out->n_options++].value = value;
    }
    if (command && !arguments_flag(out, "help") && !arguments_flag(out, "version") &&
        (out->n_positionals < command->least ||
         (command->most >= 0 && out->n_positionals > command->most))) {
        terminal_error("usage: fbar %s %s; `fbar %s --help` tells more", command->name,
                       command->positionals, command->name);
        return -1;
    }
    return argc;
}

const char *arguments_next(const struct arguments *arguments, const char *name, int *cursor) {
    while (*cursor < arguments->n_options) {
        const int i = (*cursor)++;
        if (strcmp(arguments->options[i].spec->name, name) == 0)
            return arguments->options[i].value ? arguments->options[i].value : "";
    }
    return NULL;
}

const char *arguments_value(const struct arguments *arguments, const char *name) {
    const char *last = NULL, *value;
    int cursor = 0;
    while ((value = arguments_next(arguments, name, &cursor)))
        last = value;
    return last;
}

bool arguments_flag(const struct arguments *arguments, const char *name) {
    return arguments_value(arguments, name) != NULL;
}

int arguments_number(const struct arguments *arguments, const char *name, double least, double most,
                     double *out) {
    const char *text = arguments_value(arguments, name);
    char option[64];
    snprintf(option, sizeof option, "--%s", name);
    return text ? arguments_read_number(option, text, least, most, out) : 0;
}

int arguments_read_number(const char *name, const char *text, double least, double most,
                          double *out) {
    char *end;
    const double value = strtod(text, &end);
    if (end == text || *end || !isfinite(value) || value < least || value > most) {
        terminal_error("%s: must be a number from %g to %g, got \"%s\"", name, least, most, text);
        return -1;
    }
    *out = value;
    return 0;
}
