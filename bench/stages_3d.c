// See stages_2d.c.
#define MPM_STAGES bench_stages
#define DIM 3
#include "server/mpm/transfer_lanes.h"
