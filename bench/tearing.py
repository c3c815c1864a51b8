#!/usr/bin/env python3
"""At what stretch a body of material points parts for want of particles: the strip of scenes/hard/stretch.json, pulled
slowly, with 2 to 7 particles in each direction of a cell, every basis and scheme.

    bench/tearing.py [-o FOLDER]

A strip stretched by s has its particles s/n of a cell apart. The stretch at which it parts is the exact one under the
load at which its middle is first OFF away from it, or at which the run fails. Writes tearing.csv."""
import argparse
import itertools
import math
import pathlib
import sys

from study import ROOT, SCHEMES, Point, Store, markdown, number, write_csv

SLOW = 80  # s of loading; the strip follows its load some 2 s late (damping over the square of its frequency), by 2 %
FULL = 13290.1101  # N, scenes/hard/stretch.json: the force of a stretch of 4
MU = 1e4 / (2 * 1.499)  # Pa
OFF = 0.05
COUNTS = (2, 3, 4, 5, 7)


def exact(force):
    """Stretch of an incompressible strip in plane strain, 1 m high: force = mu (s - s^-3), by bisection."""
    low, high = 1.0, 10.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if MU * (middle - middle**-3) < force else (low, middle)
    return low


def parts_at(result):
    """The exact stretch when the strip has parted, or None where it holds to the end."""
    for row in result["series"]:
        stretch, found = exact(FULL * row["time"] / SLOW), number(row["probes"]["middle.x"])
        if stretch > 1.1 and not abs((1 + found / 1.5) / stretch - 1) <= OFF:  # NaN has parted
            return stretch
    return exact(FULL * result["error"]["time"] / SLOW) if result["outcome"] == "failed" else None


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "build" / "report" / "small")
    options = parser.parse_args()
    schemes = {**SCHEMES, "keep": {"scheme": "anchored", "keep": 0.1}}
    wanted = [({"basis": basis, "scheme": scheme, "n": n}, Point("hard-stretch", {
        "basis": basis, "fbar": schemes[scheme], "time": {"end": SLOW}, "loads": {"pull": {"ramp": SLOW}},
        "bodies": {"strip": {"particles_per_cell": n * n}},
        "probes": {"middle": {"box": {"min": [1.37, 0], "max": [1.63, 1]}}}}, 320))
        for basis, scheme, n in itertools.product(("gimp", "bspline2", "bspline3"), schemes, COUNTS)]  # fmt: skip
    results = Store(options.output / "points.jsonl").all([p for _, p in wanted])
    rows = []
    for (labels, _), result in zip(wanted, results):
        stretch = parts_at(result)
        rows.append({**labels, "outcome": result["outcome"], "cpu_s": round(result.get("cpu_s", 0), 2),
                     "parts at": f"{stretch:.3f}" if stretch else "", "particles apart, cells": f"{(stretch or math.nan) / labels['n']:.3f}" if stretch else ""})
    write_csv(options.output / "tearing.csv", rows)
    print(markdown(rows, list(rows[0])))


if __name__ == "__main__":
    sys.exit(main())
