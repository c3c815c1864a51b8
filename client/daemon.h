// A private fbard for one command: free ports, a temporary data folder, gone afterwards.
#pragma once
#include <stdbool.h>
#include <sys/types.h>

#include "client/client.h"

struct daemon {
    pid_t pid;
    char folder[512]; // temporary: data, port file and log
    char url[128];
};

// Starts the fbard that lies next to this program, else the one in PATH, and waits until it
// listens. 0, or -1 with the fault printed.
int daemon_start(struct daemon *daemon);
// Ends it and removes its folder. It also ends by itself when this process dies.
void daemon_stop(struct daemon *daemon);

// What commands that need no particular daemon use: the one that the user named, or the one that
// answers at the default address, or else a private one. *out is `client`, or a copy that asks the
// private one. An exit code; on CLIENT_DONE daemon_leave must follow.
int daemon_reach(const struct client *client, struct daemon *daemon, struct client *out);
void daemon_leave(struct daemon *daemon, struct client *out);
// Whether daemon_reach started one.
bool daemon_private(const struct daemon *daemon);
