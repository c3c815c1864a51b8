// Runs for people: the table of `fbar list`, the page of `fbar show`, the outcome of a run.
#pragma once
#include <cjson/cJSON.h>
#include <stdbool.h>

// Prints any JSON, indented, on standard output.
void report_json(const cJSON *value);
// The same of text that is JSON already, as it is.
void report_json_text(const char *text);
bool report_printed(void); // whether either has printed anything
void report_runs(const cJSON *runs);
void report_run(const cJSON *run);
// One summary line and the references; a failure's problem goes to standard error. Returns the exit
// code that the run's state stands for.
int report_outcome(const cJSON *run);
int report_exit_code(const cJSON *run);
