#!/usr/bin/env python3
"""`zhao` against `anchored`, and what the constants of `anchored` do: static and dynamic problems and hard cases, for
a from 0.02 to 1, C from 0 to 2, keep up to 0.1, and a = clamp(25 mu/K, 0.02, 1).

    bench/schemes.py [-o FOLDER]

Writes schemes.csv: a row a problem, basis and scheme with its measures."""
import argparse
import pathlib
import sys

from study import ROOT, Point, Store, at, composed, last, markdown, number, write_csv

FEM = 0.261735  # m, scenes/cook-membrane.json


def energy_left(result):
    first, end = result["series"][0], result["series"][-1]
    return (number(end["kinetic"]) + number(end["strain"])) / (number(first["kinetic"]) + number(first["strain"]))


def at_rest(result):
    """Kinetic over strain energy at the end."""
    end = result["series"][-1]
    return number(end["kinetic"]) / max(number(end["strain"]), 1e-300)


# The same in 3D, by merge patches.
BALLS = {"dimension": 3, "cell": 0.1, "domain": {"min": [-0.2] * 3, "max": [1.2] * 3}, "references": [], "bodies": {
    name: {"shape": {"disk": None, "sphere": {"center": [x] * 3, "radius": 0.2}}, "particles_per_cell": 8, "velocity": [v] * 3}
    for name, x, v in (("lower", 0.2, 0.1), ("upper", 0.8, -0.1))}}  # fmt: skip
COLUMN_3D = {"dimension": 3, "domain": {"min": [-0.25, -0.25, -0.25], "max": [0.5, 1.25, 0.5]}, "gravity": [0, -9.81, 0], "bodies": {
    "column": {"shape": {"box": {"min": [0, 0, 0], "max": [0.25, 1, 0.25]}}, "particles_per_cell": 8}}, "walls": {
    "near": {"axis": "z", "at": 0, "keeps": "above", "condition": "slip"},
    "far": {"axis": "z", "at": 0.25, "keeps": "below", "condition": "slip"}}}  # fmt: skip

COOK = {"materials": {"rubber": {"poisson_ratio": 0.499}}, "time": {"end": 120}}
# name: scene, patch, mu/K, measures
PROBLEMS = {
    "Cook, h = 4 m": ("hard-incompressible", COOK, 0.002, {
        "column at 40 s": lambda r: at(r, "column.y", 40) / FEM - 1, "column at 120 s": lambda r: last(r, "column.y") / FEM - 1,
        "pressure RMS": lambda r: last(r, "pressure_error")}),
    "Cook, h = 2 m": ("hard-incompressible", {**COOK, "cell": 2}, 0.002, {
        "column at 40 s": lambda r: at(r, "column.y", 40) / FEM - 1, "column at 120 s": lambda r: last(r, "column.y") / FEM - 1,
        "pressure RMS": lambda r: last(r, "pressure_error")}),
    "cylinder": ("thick-cylinder", {"cell": 0.25}, 0.002, {
        "displacement error": lambda r: last(r, "displacement_error"), "pressure error": lambda r: last(r, "pressure_error")}),
    "hydrostatic column": ("hydrostatic-column", {}, 0.0, {
        "pressure error": lambda r: last(r, "pressure_error"), "kinetic/strain": at_rest}),
    "resting column, 2e4 steps": ("hard-resting-column", {"time": {"end": 44}}, 0.0, {
        "top, m": lambda r: last(r, "top") - at(r, "top", 0), "kinetic/strain": at_rest}),
    "resting column in 3D, 1e4 steps": ("hard-resting-column", {**COLUMN_3D, "time": {"end": 22}}, 0.0, {
        "top, m": lambda r: last(r, "top") - at(r, "top", 0), "kinetic/strain": at_rest}),
    "balls in 3D": ("disk-collision", BALLS, 0.002, {"energy left": energy_left}),
    "dead load": ("hard-dead-load", {}, 0.002, {"displacement, m": lambda r: last(r, "middle.x")}),
    "stretch to 4 x, 49 per cell": ("hard-stretch", {"bodies": {"strip": {"particles_per_cell": 49}}}, 0.002, {
        "stretch": lambda r: 1 + last(r, "middle.x") / 1.5}),
    "dam break, K = 2e7": ("hard-dam-break", {"time": {"end": 0.672}}, 0.0, {
        "front at 0.336 s, m": lambda r: at(r, "front", 0.336), "largest pressure at the end, Pa": lambda r: last(r, "pressure_max")}),
    "disk collision": ("disk-collision", {}, 0.002, {"energy left": energy_left}),
    "bar impact": ("hard-bar-impact", {}, 0.002, {
        "length, m": lambda r: last(r, "length"), "largest pressure, Pa": lambda r: last(r, "pressure_max"),
        "drift": lambda r: max(number(row["drift"]) for row in r["series"])}),
}  # fmt: skip


def variants(ratio):
    yield "standard", False
    yield "zhao", {"scheme": "zhao", "a": None, "C": None}
    for a in (0.02, 0.05, 0.1, 0.2, 0.5, 1.0):
        yield f"a = {a}, C = 1", {"scheme": "anchored", "a": a, "C": 1}
    for C in (0, 2):
        yield f"a = 0.05, C = {C}", {"scheme": "anchored", "a": 0.05, "C": C}
    for keep in (0.05, 0.1):
        yield f"a = 0.05, C = 1, keep = {keep}", {"scheme": "anchored", "a": 0.05, "C": 1, "keep": keep}
    yield "a = 1, C = 0", {"scheme": "anchored", "a": 1.0, "C": 0}
    a = min(1.0, max(0.02, 25 * ratio))
    yield f"formula: a = {a:g}, C = 1", {"scheme": "anchored", "a": a, "C": 1}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "build" / "report" / "small")
    options = parser.parse_args()
    wanted = [({"problem": name, "basis": basis, "scheme": label}, measures,
               Point(scene, composed(patch, {"basis": basis, "fbar": fbar}), 12))
              for name, (scene, patch, ratio, measures) in PROBLEMS.items()
              for basis in ("gimp", "bspline2", "bspline3") for label, fbar in variants(ratio)]  # fmt: skip
    results = Store(options.output / "points.jsonl").all([p for *_, p in wanted])
    rows = []
    for (labels, measures, _), result in zip(wanted, results):
        row = {**labels, "outcome": result["outcome"], "cpu_s": round(result.get("cpu_s", 0), 3)}
        if result["outcome"] == "completed":
            row["measures"] = "; ".join(f"{m} {f(result):.4g}" for m, f in measures.items())
        rows.append(row)
    write_csv(options.output / "schemes.csv", rows)
    print(markdown(rows, ["problem", "basis", "scheme", "outcome", "cpu_s", "measures"]))


if __name__ == "__main__":
    sys.exit(main())
