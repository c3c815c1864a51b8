"""What is run for the report: a case is a built-in scene (or a scene of one's own) with overrides. Each part of the
report lists its own (`cases(size)` in cook.py and its neighbours)."""
import dataclasses
import itertools
import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))
from study import merged  # noqa: E402

SIZES = ("small", "paper", "tiny")  # tiny: for the test of the report itself, seconds and no physics

BASES = {"gimp": "uGIMP", "bspline2": "quadratic B-spline", "bspline3": "cubic B-spline"}
SCHEMES = {"standard": False, "zhao": {"scheme": "zhao"}, "anchored": {"scheme": "anchored"}}
SCHEME_TITLES = {"standard": "standard", "zhao": "F\u0304 (zhao)", "anchored": "F\u0304 (anchored)"}


@dataclasses.dataclass
class Case:
    name: str  # of the run and of its files; unique in the report
    scene: object  # name of a built-in scene, path of a scene file, or the scene itself
    overrides: dict = dataclasses.field(default_factory=dict)  # merge patch (RFC 7396)
    rank: float = 0  # lower ranks run first
    labels: dict = dataclasses.field(default_factory=dict)  # what a part knows it by: basis, scheme, cell, ...


def grid(prefix, scene, overrides, ranks, bases=("gimp", "bspline2"), schemes=tuple(SCHEMES), **labels):
    """Cases of one scene for each basis and scheme. ranks: a rank, or ranks(basis, scheme) that gives it, or None where
    there is no such case."""
    made = []
    for basis, scheme in itertools.product(bases, schemes):
        rank = ranks(basis, scheme) if callable(ranks) else ranks
        if rank is not None:
            rank += 0.5 * (scheme == "anchored")  # what the paper shows comes first
            own = merged(overrides, {"basis": basis, "fbar": SCHEMES[scheme]})
            made.append(Case(f"{prefix}-{basis}-{scheme}", scene, own, rank,
                             dict(labels, basis=basis, scheme=scheme)))  # fmt: skip
    return made
