// fbar.1 in the man(7) macros, from the same tables as the help.
#include <stdio.h>
#include <string.h>

#include "client/arguments.h"
#include "client/commands.h"
#include "client/help.h"

// A line that begins with a dot or a quote would be a request; a backslash an escape; a hyphen a
// typographic one, which cannot be pasted.
static void put(const char *text) {
    bool start = true;
    for (; *text; start = *text++ == '\n') {
        if (start && (*text == '.' || *text == '\''))
            fputs("\\&", stdout);
        if (*text == '\\')
            fputs("\\e", stdout);
        else if (*text == '-')
            fputs("\\-", stdout);
        else
            putchar(*text);
    }
}

static void put_options(const struct option_spec *options) {
    for (; options && options->name; options++) {
        printf(".TP\n");
        if (options->letter)
            printf("\\fB\\-%c\\fR, ", options->letter);
        fputs("\\fB\\-\\-", stdout);
        put(options->name);
        fputs("\\fR", stdout);
        if (options->value) {
            fputs(" \\fI", stdout);
            put(options->value);
            fputs("\\fR", stdout);
        }
        putchar('\n');
        put(options->doc);
        putchar('\n');
    }
}

static void put_command(const struct command *command) {
    fputs(".SS \"", stdout);
    put(command->name);
    if (*command->positionals)
        putchar(' ');
    put(command->positionals);
    fputs("\"\n", stdout);
    printf("%c", command->summary[0] >= 'a' && command->summary[0] <= 'z'
                     ? command->summary[0] - 'a' + 'A'
                     : command->summary[0]);
    put(command->summary + 1);
    fputs(".\n", stdout);
    if (command->doc) {
        fputs(".PP\n", stdout);
        put(command->doc);
        putchar('\n');
    }
    put_options(command->options);
    if (command->examples) {
        fputs(".PP\n.EX\n", stdout);
        put(command->examples);
        fputs("\n.EE\n", stdout);
    }
}

void help_print_manual(void) {
    fputs(".TH FBAR 1 \"\" \"fbard " FBARD_VERSION "\" \"User Commands\"\n"
          ".SH NAME\nfbar \\- client of fbard: runs and records material\\-point simulations\n"
          ".SH SYNOPSIS\n.B fbar\n[\\fIoptions\\fR] \\fIcommand\\fR ...\n"
          ".SH DESCRIPTION\nAsks a\n.BR fbard (8)\ndaemon to compute scenes with the material "
          "point method, and records every frame into an HDF5 file. Options may stand anywhere, as "
          "\\fB\\-\\-name\\fR \\fIvalue\\fR or \\fB\\-\\-name=\\fIvalue\\fR.\n"
          ".SH OPTIONS\n",
          stdout);
    put_options(arguments_global);
    fputs(".SH COMMANDS\n", stdout);
    for (const struct commands_group *g = commands_groups; g->title; g++)
        for (const struct command *const *c = g->commands; *c; c++)
            put_command(*c);
    fputs(".SH EXIT STATUS\n"
          ".TP\n0\ndone\n.TP\n1\nthe run failed or was cancelled\n.TP\n2\nusage, or an invalid "
          "scene\n.TP\n3\nthe daemon cannot be reached\n.TP\n4\na file cannot be read or written\n"
          ".TP\n130\ninterrupted\n"
          ".SH ENVIRONMENT\n"
          ".TP\n.B FBAR_URL\nthe daemon, where no \\fB\\-\\-url\\fR is given\n"
          ".TP\n.B NO_COLOR\nno colours on a terminal\n"
          ".TP\n.B TMPDIR\nwhere a private daemon keeps its data, and pictures are made\n"
          ".SH FILES\n"
          ".TP\n.I FILE.h5\na recording: VTKHDF PolyData with what VTK has no place for under "
          "/fbard\n.TP\n.I FILE.xdmf\nopens it in ParaView 5.11\n"
          ".TP\n.I FILE.h5.log\nwhat is recorded so far, until the recording is complete\n"
          ".SH SEE ALSO\n.BR fbard (8),\n.BR gnuplot (1)\n",
          stdout);
}
