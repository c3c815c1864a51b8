// What `fbar run` does, for other commands that create a run.
#pragma once
#include <stdbool.h>

#include "client/client.h"

// Creates the run of a request's body, shows its progress and its outcome; `private` where its
// daemon is this command's own. The exit code of `fbar run`.
int cmd_run_body(struct client *client, const char *body, bool private);
