// SIGINT, SIGTERM and SIGHUP as a count that loops look at, so that files are closed and daemons
// stopped.
#pragma once

void interrupt_catch(void);
// How often one came since the start.
int interrupt_count(void);
