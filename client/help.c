// The one-screen help, and that of each command.
#include "client/help.h"

#include <stdio.h>
#include <string.h>

#include "client/arguments.h"
#include "client/commands.h"
#include "client/terminal.h"

static void print_heading(const char *text) {
    printf("%s%s%s\n", terminal_paint(stdout, TERMINAL_BOLD), text,
           terminal_paint(stdout, TERMINAL_PLAIN));
}

static void print_options(const struct option_spec *options) {
    for (; options && options->name; options++) {
        char left[64];
        const char letter[] = {'-', options->letter, ',', ' ', '\0'};
        snprintf(left, sizeof left, "%s--%s%s%s", options->letter ? letter : "    ", options->name,
                 options->value ? " " : "", options->value ? options->value : "");
        printf("  %-24s %s\n", left, options->doc);
    }
}

void help_print(void) {
    puts("fbar: runs material-point simulations on an fbard daemon, and records them\n\n"
         "usage: fbar [--url URL] [--token-file FILE] [--curve-file FILE] [--json] COMMAND ...\n");
    for (const struct commands_group *g = commands_groups; g->title; g++) {
        print_heading(g->title);
        for (const struct command *const *c = g->commands; *c; c++) {
            char left[64];
            snprintf(left, sizeof left, "%s %s", (*c)->name, (*c)->positionals);
            printf("  %-24s %s\n", left, (*c)->summary);
        }
    }
    print_heading("examples");
    puts("  fbar run dam-break -o dam.h5                   compute and record\n"
         "  fbar run dam-break -o off.h5 --set fbar=false  with another value in the scene\n"
         "  fbar set RUN fbar=false                        switch F-bar off in mid-run\n"
         "  fbar plot off.h5 dam.h5 --time 0.4 -o both.png draw two recordings side by side\n\n"
         "`fbar help COMMAND` tells more. Exit codes: 0 done, 1 the run failed, 2 usage or invalid\n"
         "scene, 3 cannot reach the daemon, 4 I/O, 130 interrupted.");
}

// Examples stand in the table one a line.
static void print_lines(const char *lines) {
    while (*lines) {
        const size_t n = strcspn(lines, "\n");
        printf("  %.*s\n", (int)n, lines);
        lines += n + (lines[n] == '\n');
    }
}

void help_print_command(const struct command *command) {
    printf("usage: fbar %s%s%s\n\n%s\n", command->name, *command->positionals ? " " : "",
           command->positionals, command->summary);
    if (command->doc)
        printf("\n%s\n", command->doc);
    if (command->options) {
        puts("");
        print_heading("options");
        print_options(command->options);
    }
    puts("");
    print_heading("options of every command");
    print_options(arguments_global);
    if (command->examples) {
        puts("");
        print_heading("examples");
        print_lines(command->examples);
    }
}
