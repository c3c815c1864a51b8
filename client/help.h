// Help, from the tables of commands and options: for people, and as a manual page.
#pragma once
#include "client/client.h"

void help_print(void); // one screen
void help_print_command(const struct command *command);
void help_print_manual(void); // fbar.1
