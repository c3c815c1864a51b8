// The kernels in lanes, 2D: compiled for each instruction set.
#define DIM 2
#include "server/mpm/transfer_lanes.h"
