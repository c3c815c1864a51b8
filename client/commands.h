// The list of all commands.
#pragma once
#include "client/client.h"

struct commands_group {
    const char *title;
    const struct command *const *commands; // ends with NULL
};
extern const struct commands_group commands_groups[]; // ends with a NULL title

// The command of that name, or NULL.
const struct command *commands_find(const char *name);
// The same with the fault printed, and what was perhaps meant.
const struct command *commands_expect(const char *name);
