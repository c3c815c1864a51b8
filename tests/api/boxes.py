"""Small scenes: some hundred particles, steps of well under a millisecond."""
import copy

WATER = {
    "format": "fbard-scene-1",
    "title": "A box of water",
    "dimension": 2,
    "domain": {"min": [-0.25, -0.25], "max": [2.25, 8]},
    "cell": 0.25,
    "basis": "gimp",
    "fbar": True,
    "time": {"end": 0.1, "dt": 1e-3},
    "gravity": [0, -9.81],
    "materials": {
        "water": {"model": "newtonian", "density": 997.5, "bulk_modulus": 2e6, "viscosity": 1e-3}
    },
    "bodies": {
        "pool": {"material": "water", "shape": {"box": {"min": [0, 0], "max": [1, 1]}}, "particles_per_cell": 16}
    },
    "walls": {
        "left": {"axis": "x", "at": 0, "keeps": "above", "condition": "slip"},
        "floor": {"axis": "y", "at": 0, "keeps": "above", "condition": "slip"},
        "right": {"axis": "x", "at": 2, "keeps": "below", "condition": "slip"},
    },
    "output": {"interval": 0.01, "fields": ["position", "velocity", "mean_stress"]},
    "probes": {
        "front": {"kind": "extent", "body": "pool", "axis": "x", "side": "max"},
        "energy": {"kind": "energy"},
        "momentum": {"kind": "momentum"},
        "middle": {"kind": "displacement", "body": "pool", "at": [0.5, 0.5]},
    },
}  # 256 particles, 100 steps
WATER_PARTICLES, WATER_MASS, WATER_STEPS = 256, 997.5, 100

# A bar that vibrates between walls, without gravity and with next to no amplitude: it never comes to an
# end or to grief, whatever is patched.
ENDLESS = {
    "format": "fbard-scene-1",
    "dimension": 2,
    "domain": {"min": [-0.5, -0.5], "max": [2, 1]},
    "cell": 0.25,
    "basis": "bspline2",
    "fbar": False,
    "time": {"end": 1e6, "dt": 1e-3},
    "materials": {"bar": {"model": "neo_hookean", "density": 1000, "youngs_modulus": 1e5, "poisson_ratio": 0}},
    "bodies": {
        "bar": {
            "material": "bar",
            "shape": {"box": {"min": [0, 0], "max": [1, 0.5]}},
            "particles_per_cell": 4,
            "velocity": {"mode": {"axis": "x", "from": 0, "length": 1, "number": 1, "amplitude": 1e-3}},
        }
    },
    "walls": {
        "end": {"axis": "x", "at": 0, "keeps": "above", "condition": "slip"},
        "below": {"axis": "y", "at": 0, "keeps": "above", "condition": "slip"},
        "above": {"axis": "y", "at": 0.5, "keeps": "below", "condition": "slip"},
    },
    "output": {"interval": 1e5, "probe_interval": 1e5},
    "probes": {"energy": {"kind": "energy"}},
}


def merged(target, patch):
    """RFC 7396."""
    if not isinstance(patch, dict):
        return copy.deepcopy(patch)
    result = copy.deepcopy(target) if isinstance(target, dict) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = merged(result.get(key), value)
    return result


def water(**patch):
    return merged(WATER, patch)


def endless(**patch):
    return merged(ENDLESS, patch)


def escaping(**patch):
    """A block that flies out of the domain and fails."""
    return merged(
        merged(ENDLESS, {"time": {"end": 10}, "output": {"interval": 0.01, "probe_interval": 0.01}}),
        {
            "bodies": {
                "bar": {"shape": {"box": {"min": [0.5, 0], "max": [1, 0.5]}}, "velocity": [10, 0]}
            },
            "walls": {"end": None},
            **patch,
        },
    )


def big(particles_per_cell=100, **patch):
    """Steps of many milliseconds: 40,000 particles and more."""
    return merged(
        merged(WATER, {"time": {"end": 100, "dt": 1e-4}, "cell": 0.05,
                       "output": {"interval": 1e3, "probe_interval": 1e3},
                       "bodies": {"pool": {"particles_per_cell": particles_per_cell}}}),
        patch,
    )  # fmt: skip
