// What the files of bench-solver share: bench/solver.c has all of it, and says what is measured.
#pragma once
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "server/mpm/sim.h"

#define MAX_ROUNDS 15

extern bool quick;

double now(void);      // s, processor time of this thread
double wall_now(void); // s
double median(const double *values, int n);
// Seconds of a fused multiply-add of one double, in the widest vectors that the kernels use.
double fma_seconds(void);
// Seconds per particle and step, of steps that take about `seconds`; NaN when one fails.
double timed(struct mpm_sim *sim, double seconds);
// Medians of the rounds' ratios, one / other, by processor time, and of one's ns per particle and
// step.
double pair_of(struct mpm_sim *one, struct mpm_sim *other, double *ns);
// The same of two threads, by the wall clock, against the mean of two simulations of one thread
// each that run at the same time: what cores lose when both are at work (clock, cache, neighbours
// in a virtual machine) is the machine's doing, and is in both.
double threads_pair(struct mpm_sim *two, struct mpm_sim *const one[2], double *ns);
// Seconds in which a cache line goes from core to core and back.
double line_there_and_back(void);
void verdict_row(const char *group, const char *what, double ns, double ratio, double most);

// A row of the JSON.
bool wanted(const char *group);
bool asked_for(const char *group); // by its whole name: what takes too long otherwise
void open_row(const char *group);
void number(const char *key, double value); // left out when it is not finite
void text(const char *key, const char *value);
void close_row(void);

void stages_of(struct mpm_sim *sim); // bench/stages.c: rows of its passes
void scenes(void);                   // bench/scenes.c
