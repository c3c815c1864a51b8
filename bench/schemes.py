#!/usr/bin/env python3
"""`zhao` against `anchored`, and what the constants of `anchored` do: static and dynamic problems and hard cases, for
a from 0.02 to 1, C from 0 to 2, keep up to 0.1, and a = clamp(25 mu/K, 0.02, 1); and keep in long flows and in the
balance of energy.

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


def balance(result):
    """Kinetic and strain energy less the work of gravity and body forces, of every sample of the last stage, over the
    largest kinetic energy: exactly constant."""
    rows = [row for row in result["series"] if row["time"] >= 0]
    scale = max(number(row["kinetic"]) for row in rows)
    return [(number(row["kinetic"]) + number(row["strain"]) - number(row["work"])) / scale for row in rows]


def energy_lost(result):
    b = balance(result)
    return b[0] - b[-1]


def energy_gained(result):
    b = balance(result)
    return max(b) - b[0]


def drift(result):
    return max(number(row["drift"]) for row in result["series"])


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
        "front at 0.336 s, m": lambda r: at(r, "front", 0.336), "largest pressure at the end, Pa": lambda r: last(r, "pressure_max"),
        "drift": drift, "energy gained": energy_gained}),
    "disk collision": ("disk-collision", {}, 0.002, {"energy left": energy_left}),
    "bar impact": ("hard-bar-impact", {}, 0.002, {
        "length, m": lambda r: last(r, "length"), "largest pressure, Pa": lambda r: last(r, "pressure_max"),
        "drift": drift}),
}  # fmt: skip

# What keep costs in long flows and in the balance of energy; without the scan of a and C.
KEPT = {
    "landslide slice, h = 0.25 m": ("landslide-slice", {"cell": 0.25, "time": {"dt": None, "cfl": 0.3}, "probes": {
        "pressure": {"kind": "minimum", "field": "mean_stress", "scale": -1, "average": 0.1}}}, ("gimp", "bspline2"), (0, 0.02, 0.1), {
        "run-out at 2.5 s, m": lambda r: at(r, "runout", 2.5) - 15, "at 5.5 s, m": lambda r: last(r, "runout") - 15,
        "largest pressure at 2.5 s, kPa": lambda r: at(r, "pressure", 2.5) / 1000, "drift": drift, "energy gained": energy_gained}),
    "oscillating column": ("hydrostatic-column", {"damping": {"mass": 0}, "materials": {"water": {"viscosity": 0}}}, ("gimp", "bspline2", "bspline3"), (0, 0.02, 0.1), {
        "energy lost": energy_lost, "energy gained": energy_gained, "drift": drift}),
    "vortex, a whole swing": ("vortex-incompressible", {}, ("gimp", "bspline2", "bspline3"), (0, 0.02, 0.1), {
        "energy lost": energy_lost, "energy gained": energy_gained, "drift": drift}),
    "Cook at nu = 0.49999, h = 4 m": ("hard-incompressible", {"materials": {"rubber": {"poisson_ratio": 0.49999}}}, ("gimp", "bspline2", "bspline3"), (0, 0.01, 0.1), {
        "pressure RMS": lambda r: last(r, "pressure_error")}),
    "dead load at nu = 0.49999": ("hard-dead-load", {"materials": {"rubber": {"poisson_ratio": 0.49999}}}, ("gimp", "bspline2", "bspline3"), (0, 0.01, 0.1), {
        "displacement, m": lambda r: last(r, "middle.x")}),
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


def kept(keeps):
    yield "standard", False
    yield "zhao", {"scheme": "zhao", "a": None, "C": None}
    for keep in keeps:
        yield "a = 0.05, C = 1" + (f", keep = {keep}" if keep else ""), {"scheme": "anchored", "a": 0.05, "C": 1, "keep": keep}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "build" / "report" / "small")
    options = parser.parse_args()
    wanted = [({"problem": name, "basis": basis, "scheme": label}, measures,
               Point(scene, composed(patch, {"basis": basis, "fbar": fbar}), 12))
              for name, (scene, patch, ratio, measures) in PROBLEMS.items()
              for basis in ("gimp", "bspline2", "bspline3") for label, fbar in variants(ratio)]  # fmt: skip
    wanted += [({"problem": name, "basis": basis, "scheme": label}, measures,
                Point(scene, composed(patch, {"basis": basis, "fbar": fbar}), 110))
               for name, (scene, patch, bases, keeps, measures) in KEPT.items() for basis in bases for label, fbar in kept(keeps)]  # fmt: skip
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
