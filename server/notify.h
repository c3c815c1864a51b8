// Tells the service manager that started the daemon how it is: the protocol of sd_notify(3).
#pragma once

// `state` is lines of NAME=VALUE: "READY=1", "STOPPING=1", "STATUS=one line for people". Does
// nothing where no service manager listens (NOTIFY_SOCKET is not set); a failure is logged.
void notify_send(const char *state);
