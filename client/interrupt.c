// The signal handler only counts; nothing else is safe in it.
#include "client/interrupt.h"

#include <signal.h>

static volatile sig_atomic_t count;

static void on_signal(int signal_number) {
    (void)signal_number;
    count++;
}

void interrupt_catch(void) {
    // No SA_RESTART: a wait is to end early.
    struct sigaction action = {.sa_handler = on_signal};
    sigemptyset(&action.sa_mask);
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGHUP, &action, NULL);
}

int interrupt_count(void) {
    return count;
}
