// How far a run is: a line that is redrawn on a terminal, a plain line every few seconds elsewhere.
#pragma once
#include <cjson/cJSON.h>
#include <stdbool.h>

// Seconds between two looks at the run that make sense for the present output.
double progress_interval(void);
// `run`: the API's run object.
void progress_show(const cJSON *run);
// Leaves the last state of the line standing.
void progress_end(void);
// "running", ...; "" when the object has none.
const char *progress_state(const cJSON *run);
// Whether the state is final: completed, failed or cancelled.
bool progress_over(const cJSON *run);
// "1:02:03", "4:05" or "12 s" into `out`.
void progress_duration(double seconds, char *out, size_t n);
