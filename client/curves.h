// Probes of recordings as curves over time, a panel a probe, with the references that their scenes
// cite.
#pragma once
#include "client/arguments.h"
#include "client/client.h"

struct curves_options {
    int n_files;
    const char *const *files;
    const char *probes;    // names joined by commas; "all"
    const char *path;      // the PNG
    int width, height;     // pixels; height 0: as the number of panels asks for
    double low[3], high[3]; // of time (s) and value, where `limited`
    bool limited;
};

// An exit code, with the fault printed.
int curves_plot(const struct client *client, const struct curves_options *options);
