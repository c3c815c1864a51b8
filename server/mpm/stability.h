// The stability limit of the time increment, as it was measured: bench/ladder.py raises the
// increment for each dimension, basis, F-bar scheme and kind of material until a shaken, moving
// block blows up.
#pragma once
#include "server/mpm/mpm.h"

// Factors of the two limits: dt <= wave h/(c + v) and dt <= viscous h^2/nu.
struct mpm_stability {
    double wave, viscous;
};

// Those of the body that bears least, 1.
struct mpm_stability mpm_stability_of(const struct mpm_def *def);

// Explicit waves and explicit diffusion together, s: (dt/dt_wave)^2 + dt/dt_viscous = 1, the limit
// of a damped oscillator whose damping is a step late; damping in proportion to mass, alpha in 1/s,
// adds alpha dt/2, since alone it holds up to alpha dt = 2. Speeds in m/s, diffusivity (kinematic
// viscosity) in m^2/s.
double mpm_stability_limit(struct mpm_stability s, double cell, double speed, double diffusivity,
                           double alpha);
