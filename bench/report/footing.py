"""Strip footing: figures 8 to 10 of the paper."""
from cases import Case, grid, merged

TITLE = "Strip footing"
B = 1.0  # width of the footing, m
SLOW = 0.0025  # m/s: half the rate of the scenes


def at_cell(n, height, rate=0.005, frames=10):
    """Overrides that give a footing scene h = B/n on ground of this height: the footing starts one barrier distance
    above the highest particles, and settlement is theirs."""
    cell = B / n
    end = round(1.2 * 0.005 / rate + 0.1, 6)
    return {
        "cell": cell,
        "time": {"dt": round(1.529e-4 * 20 / n, 12), "end": end},
        "rigid_bodies": {"footing": {"velocity": [0, -rate],
                                     "shape": {"box": {"min": [-0.5, round(height - cell / 8 + 1e-3, 9)]}}}},
        "probes": {"settlement": {"box": {"min": [0, round(height - 0.6 * cell / 4, 9)]}}},
        "output": {"interval": round(end / frames, 9)}, "references": [],
    }  # fmt: skip


def levels(size):
    """n of h = B/n, coarsest first."""
    return {"small": (10, 20), "paper": (10, 20, 40, 80)}[size]


def cases(size):
    made = []
    scene, height = {"small": ("strip-footing-small", 1.5), "paper": ("strip-footing", 6.0)}[size]
    for n in levels(size):
        ranks = {
            10: lambda b, s: 31, 20: lambda b, s: 30,
            40: lambda b, s: {"zhao": 40, "standard": 55, "anchored": 70}[s] + (b == "bspline2"),
            80: lambda b, s: 95 if (b, s) == ("gimp", "zhao") else None,
        }[n]  # fmt: skip
        made += grid(f"footing-B{n}", scene, at_cell(n, height, frames=10 if n <= 20 else 5), ranks, n=n)
    # On the smaller ground a finer grid is within reach.
    if size == "paper":
        for n in (10, 20, 40, 80):
            made += grid(f"footing-near-B{n}", "strip-footing-small", at_cell(n, 1.5, frames=5), 85 if n == 80 else 32,
                         schemes=("zhao",), near=n)  # fmt: skip
    made += grid("footing-slow-B20", "strip-footing-small", at_cell(20, 1.5, SLOW), 33,
                 schemes=("zhao", "anchored"), slow=20)  # fmt: skip
    return made


def sections(shelf):
    return []
