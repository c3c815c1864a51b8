// Every command of fbar, by what it is for: help, completion and the manual page follow this list.
#include "client/commands.h"

#include <string.h>

#include "client/arguments.h"
#include "client/terminal.h"

#define COMMANDS_MOST 64

#define GROUP(...) ((const struct command *const[]){__VA_ARGS__, NULL})
const struct commands_group commands_groups[] = {
    {"compute", GROUP(&cmd_run, &cmd_scenes, &cmd_validate, &cmd_bench)},
    {"runs of a daemon", GROUP(&cmd_list, &cmd_show, &cmd_watch, &cmd_probes, &cmd_set, &cmd_pause,
                               &cmd_resume, &cmd_start, &cmd_step, &cmd_cancel, &cmd_delete)},
    {"recordings", GROUP(&cmd_record, &cmd_info, &cmd_plot, &cmd_recover)},
    {"set up", GROUP(&cmd_keygen, &cmd_completion)},
    {NULL, NULL},
};

const struct command *commands_find(const char *name) {
    for (const struct commands_group *g = commands_groups; g->title; g++)
        for (const struct command *const *c = g->commands; *c; c++)
            if (strcmp((*c)->name, name) == 0)
                return *c;
    return NULL;
}

const struct command *commands_expect(const char *name) {
    const char *names[COMMANDS_MOST + 1] = {NULL};
    size_t n = 0;
    const struct command *found = commands_find(name);
    if (found)
        return found;
    for (const struct commands_group *g = commands_groups; g->title; g++)
        for (const struct command *const *c = g->commands; *c && n < COMMANDS_MOST; c++)
            names[n++] = (*c)->name;
    const char *closest = arguments_closest(name, names);
    terminal_error("%s: unknown command%s%s%s; `fbar help` lists them", name,
                   closest ? "; did you mean " : "", closest ? closest : "", closest ? "?" : "");
    return NULL;
}
