// The kernels in lanes, 3D: compiled for each instruction set.
#define DIM 3
#include "server/mpm/transfer_lanes.h"
