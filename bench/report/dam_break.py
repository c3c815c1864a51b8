"""Dam break: figure 12 of the paper."""
from cases import grid

TITLE = "Dam break"
# A softer fluid has the same flow in some 5,000 steps; waves are slower, settling takes longer (scenes/README.md).
SOFT = {
    "materials": {"water": {"bulk_modulus": 2e7}},
    "time": {"dt": None, "cfl": 0.3},
    "stages": [
        {"name": "settle", "duration": 0.6, "damping": {"local": 0.5}},
        {"name": "flow", "remove": {"walls": ["gate"]}},
    ],
}


def cases(size):
    made = grid("dam", "dam-break", SOFT if size == "small" else {}, 20)
    return made + grid("dam-column", "dam-break-column", {}, 21)


def sections(shelf):
    return []
