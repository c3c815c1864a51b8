// A private fbard for one `fbar run`: free ports, a temporary data folder, gone afterwards.
#pragma once
#include <sys/types.h>

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
