#!/usr/bin/env python3
"""How far the time increment can be raised: for every dimension, basis, F-bar scheme and kind of material, the
largest multiple of the stability limit that the daemon states at which a shaken block that moves through the grid
stays whole for STEPS (1,500 in 2D, 600 in 3D) steps, and the smallest at which it does not.

    bench/ladder.py [-o FOLDER]

The block's strain energy cannot pass the kinetic energy of its shake; a run blows up when it fails or has BLOWN
times as much. What blows up at FIRST of the limit too does so for another reason than the increment. The linear basis
is listed and not judged: a particle that barely reaches a node throws that away, at any increment."""
import argparse
import itertools
import pathlib
import re
import sys

from study import BASES, ROOT, SCHEMES, Point, Store, markdown, merged, number, run, write_csv

STEPS, BLOWN, FIRST = {2: 1500, 3: 600}, 3, 0.4
STEPS_OF_LIMIT = [FIRST, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.66, 1.8, 2.0, 2.5, 3.3, 5.0]
WIDEST = 1 / 0.6  # the limit may be 40 % below the blow-up, no more

MATERIALS = {
    "elastic, nu = 0.3": {"model": "neo_hookean", "density": 1000, "youngs_modulus": 1e6, "poisson_ratio": 0.3},
    "elastic, nu = 0.499": {"model": "neo_hookean", "density": 1000, "youngs_modulus": 1e4, "poisson_ratio": 0.499},
    "fluid": {"model": "newtonian", "density": 1000, "bulk_modulus": 1e6, "viscosity": 1e-3},
    "fluid, c/h = 2 dim nu/h^2": {"model": "newtonian", "density": 1000, "bulk_modulus": 1e6, "viscosity": 2000},
    "viscous fluid": {"model": "newtonian", "density": 1000, "bulk_modulus": 1e4, "viscosity": 2e4},
    "plastic": {"model": "hencky_j2", "density": 1000, "youngs_modulus": 1e6, "poisson_ratio": 0.49,
                "yield_strength": 1e3},
}  # fmt: skip
STATED = {}  # (basis, dimension, particles in each direction of a cell): CFL number of the limit


def cases(dimensions, bases, schemes, materials, n=0):
    """n: particles in each direction of a cell, 0: 2."""
    for dim, material, basis, scheme in itertools.product(dimensions, materials, bases, schemes):
        stuff = MATERIALS[material]
        patch = {"materials": {"stuff": None}, "basis": basis, "fbar": SCHEMES[scheme], "unstable_ok": True,
                 "gravity": [0.5, 0.3]}  # fmt: skip
        patch["materials"] = {"stuff": {**{k: None for k in ("youngs_modulus", "poisson_ratio")}, **stuff}}
        if dim == 3:
            patch = merged(patch, {"dimension": 3, "gravity": [0.5, 0.3, 0.2],
                                   "domain": {"min": [-32, -32, -32], "max": [96, 96, 96]},
                                   "bodies": {"block": {"shape": {"box": {"min": [0, 0, 0], "max": [1.5, 1.25, 1]}},
                                                        "particles_per_cell": 8}}})  # fmt: skip
        if n:
            patch = merged(patch, {"bodies": {"block": {"particles_per_cell": n**dim}}})
        yield {"dimension": dim, "n": n or 2, "material": material, "basis": basis, "scheme": scheme}, patch


def ask_limits(wanted):
    """The daemon's own words: a scene with a CFL number of 9 is refused, and the fault names the limit."""
    for labels, _ in wanted:
        key = labels["basis"], labels["dimension"], labels["n"]
        if key not in STATED:
            (_, patch), = cases([key[1]], [key[0]], ["standard"], ["fluid"], key[2])
            result = run(Point("hard-dt-ladder", merged(patch, {"unstable_ok": False, "time": {"end": 1, "cfl": 9}})))
            STATED[key] = float(re.search(r"stability limit of ([0-9.e-]+)", result["detail"])[1])


def stated(labels):
    return STATED[labels["basis"], labels["dimension"], labels["n"]]


def blown(result):
    if result["outcome"] == "bug":
        raise SystemExit(f"a bug of the solver: {result['bug']}")
    if result["outcome"] == "failed":
        return True
    kinetic = number(result["series"][0]["kinetic"])
    return any(number(row["strain"]) > BLOWN * kinetic for row in result["series"])


def rung(labels, patch, multiple):
    cfl = multiple * stated(labels)
    return Point("hard-dt-ladder", merged(patch, {"time": {"end": 1000, "cfl": cfl}}), samples=4000,
                 steps=STEPS[labels["dimension"]])  # fmt: skip


def climb(store, wanted, say):
    """All cases go up the ladder together, until each has blown up."""
    going = {k: {} for k in range(len(wanted))}
    for multiple in STEPS_OF_LIMIT:
        climbing = [k for k in going if not any(going[k].values())]
        points = [rung(*wanted[k], multiple) for k in climbing]
        for k, result in zip(climbing, store.all(points)):
            if result["outcome"] == "refused":
                raise SystemExit(f"{wanted[k]}: {result['detail']}")
            going[k][multiple] = blown(result)
        say(f"{multiple} of the limit: {sum(any(g.values()) for g in going.values())} of {len(going)} blown")
    rows = []
    for k, (labels, _) in enumerate(wanted):
        bad = [m for m, b in going[k].items() if b]
        good = [m for m, b in going[k].items() if not b]
        first = bad[0] if bad else None
        safe = first is None or first > 1
        verdict = ("none is safe" if labels["basis"] == "linear" else "not the increment" if first == FIRST else
                   "UNSAFE" if not safe else
                   "too careful" if max(good) >= WIDEST else "safe")  # fmt: skip
        rows.append({**labels, "limit": stated(labels), "whole": max(good, default=""), "blown": first or f"> {STEPS_OF_LIMIT[-1]}",
                     "verdict": verdict})  # fmt: skip
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "build" / "report" / "small")
    options = parser.parse_args()
    wanted = list(cases([2, 3], BASES, SCHEMES, MATERIALS))
    for n in (7, 10):  # many particles: uGIMP bears the less the more there are
        wanted += cases([2], BASES[1:], ["standard", "anchored"], ["elastic, nu = 0.3", "viscous fluid"], n)
    wanted += cases([3], ["gimp"], ["standard"], ["elastic, nu = 0.3"], 5)
    store = Store(options.output / "points.jsonl")
    ask_limits(wanted)
    rows = climb(store, wanted, lambda text: print(text, file=sys.stderr))
    write_csv(options.output / "dt-ladder.csv", rows)
    print(markdown(rows, ["dimension", "n", "material", "basis", "scheme", "limit", "whole", "blown", "verdict"]))
    return any(row["verdict"] in ("UNSAFE", "too careful") for row in rows)


if __name__ == "__main__":
    sys.exit(main())
