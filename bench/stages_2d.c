// The kernels in lanes of 2D (stages_3d.c: 3D) once more, with stages that bench/stages.c leaves out.
#define MPM_STAGES bench_stages
#define DIM 2
#include "server/mpm/transfer_lanes.h"
