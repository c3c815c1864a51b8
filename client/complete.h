// What may stand at a place of the command line: `fbar __complete WORD...`, asked by the scripts of
// `fbar completion`.
#pragma once

// `words` are those after `fbar`, the last one being what is typed so far. Prints a candidate a
// line, with a tab and a description where there is one; ":files PATTERN", ":files" and ":folders"
// leave the rest to the shell. Prints no faults. An exit code.
int complete_print(int n, char **words);
