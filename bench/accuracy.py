#!/usr/bin/env python3
"""Error against cost: problems with a known answer, each at four resolutions with every basis and F-bar scheme, and
with one factor at a time changed from the default (quadratic B-splines, anchored, CFL 0.3): time increment,
particles per cell, FLIP blend. One thread; the cost is processor seconds inside the step loop, which other work on
the machine changes little, and particle-steps, which it does not change at all.

    bench/accuracy.py [small|paper] [-o FOLDER] [--only PROBLEM] [--list] [--case NAME]

Writes accuracy.csv and pareto.csv (for each problem and measure the runs that nothing beats in both error and cost).
--case runs one point again and prints it; --list names them. What is done is kept; it goes on where it was stopped."""
import argparse
import csv
import dataclasses
import itertools
import json
import math
import pathlib
import sys

from study import BASES, ROOT, SCHEMES, Point, Store, at, composed, last, markdown, run, scene_path, series, write_csv

DEFAULT = {"basis": "bspline2", "scheme": "anchored", "cfl": 0.3, "ppc": None, "blend": 1.0}
FACTORS = {"cfl": (0.1, 0.5), "ppc": (4, 9, 16), "blend": (0.99, 0.9, 0.0)}


@dataclasses.dataclass
class Problem:
    name: str
    scene: str
    body: str
    cells: tuple  # coarse to fine, m
    measures: dict  # name: (of the result) relative error
    patch: object = lambda cell, n: {}  # of the cell and the particles in each direction
    ppc: int = 4  # the scene's own
    samples: int = 4
    paper: tuple = ()  # finer cells of SIZE=paper


def footing(cell, n):
    return {"rigid_bodies": {"footing": {"shape": {"box": {"min": [-0.5, 1.5 - cell / (2 * n) + 1e-3]}}}},
            "time": {"dt": None, "end": 1.3}, "bodies": {"soil": {"particles_per_cell": n * n}}}  # fmt: skip


def measured_fronts():
    """Times (s) and fronts (m) of Martin and Moyce after the water has begun to move."""
    lines = (ROOT / "scenes" / "reference" / "dam_break_martin_moyce.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [(float(r["t"]), float(r["front"])) for r in rows if 0.03 < float(r["t"]) < 0.17]


def front_error(result):
    """RMS over the measured fronts of the relative difference, the computed front interpolated in time."""
    computed = [(t, x) for t, x in series(result, "front") if t >= 0]

    def front(time):
        (t0, x0), (t1, x1) = next(pair for pair in itertools.pairwise(computed) if pair[1][0] >= time)
        return x0 + (x1 - x0) * (time - t0) / (t1 - t0)

    return math.sqrt(sum((front(t) / x - 1) ** 2 for t, x in MEASURED) / len(MEASURED))


def pressure(r):
    return last(r, "pressure_error")


def smooth(r):
    """Of the reported average, mean_stress_smooth."""
    return last(r, "smooth_error")


WIDTH = 0.05715  # m, of the column of water that was measured
FINEST = 5.180  # m: front at 0.336 s with h = 1/32 m, the default method (uGIMP: 5.183)
MEASURED = measured_fronts()

PROBLEMS = [
    Problem("cook", "hard-incompressible", "membrane", (8, 4, 2, 1.6), {
        "displacement": lambda r: abs(last(r, "column.y") / 0.261735 - 1), "pressure": pressure, "pressure, smooth": smooth},
        lambda cell, n: {"materials": {"rubber": {"poisson_ratio": 0.499}}}, paper=(1, 0.5)),
    Problem("cylinder", "thick-cylinder", "ring", (0.5, 0.25, 0.1875, 0.125), {
        "displacement": lambda r: last(r, "displacement_error"), "pressure": pressure, "pressure, smooth": smooth},
        ppc=9, paper=(0.0625,)),
    Problem("taylor-green", "taylor-green", "vortex", (0.25, 0.125, 0.0625, 0.03125), {
        "velocity": lambda r: last(r, "velocity_error"), "pressure": pressure, "pressure, smooth": smooth},
        lambda cell, n: {"time": {"end": 0.5}, "references": []}, ppc=9, paper=(0.015625,)),
    Problem("vortex", "vortex", "ring", (0.25, 0.125, 0.08125, 0.0625), {
        "displacement": lambda r: last(r, "displacement_error"), "pressure": pressure, "pressure, smooth": smooth},
        lambda cell, n: {"time": {"end": 0.25}, "references": []}, ppc=16, paper=(0.03125,)),
    Problem("vortex-0.499", "vortex-incompressible", "ring", (0.25, 0.125, 0.08125, 0.0625), {
        "displacement": lambda r: last(r, "displacement_error"), "pressure": pressure, "pressure, smooth": smooth},
        lambda cell, n: {"time": {"end": 0.25}, "references": []}, ppc=16, paper=(0.03125,)),
    Problem("column", "hydrostatic-column", "column", (0.5, 0.25, 0.125, 0.0625), {
        "pressure": pressure, "pressure, smooth": smooth}, ppc=16),
    Problem("footing", "strip-footing-small", "soil", (0.25, 0.125, 0.1, 0.0625), {
        "load": lambda r: abs(last(r, "load.y") / (2 + math.pi) - 1)}, footing, paper=(0.05, 0.025)),
    Problem("dam", "hard-dam-break", "reservoir", (0.5, 0.25, 0.125, 0.0625), {
        "front": lambda r: abs(at(r, "front", 0.336) / FINEST - 1)},
        lambda cell, n: {"time": {"end": 0.672}}, samples=2, paper=(0.03125,)),
    Problem("dam-measured", "dam-break-column", "reservoir", (WIDTH / 2, WIDTH / 4, WIDTH / 8, WIDTH / 12), {
        "fronts": front_error}, lambda cell, n: {"references": []}, ppc=16, samples=36, paper=(WIDTH / 16,)),
]  # fmt: skip


def methods():
    for basis, scheme in itertools.product(BASES[1:], SCHEMES):
        yield {**DEFAULT, "basis": basis, "scheme": scheme}
    for scheme in SCHEMES:
        yield {**DEFAULT, "basis": "linear", "scheme": scheme}
    for factor, values in FACTORS.items():
        for value in values:
            yield {**DEFAULT, factor: value}


def points(size, only=()):
    for problem in PROBLEMS:
        if only and problem.name not in only:
            continue
        for method, cell in itertools.product(methods(), problem.cells + (problem.paper if size == "paper" else ())):
            ppc = method["ppc"] or problem.ppc
            if method["ppc"] == problem.ppc:
                continue  # the default itself
            n = math.isqrt(ppc)
            patch = {"cell": cell, "basis": method["basis"], "fbar": SCHEMES[method["scheme"]],
                     "transfer": {"blend": method["blend"]}, "time": {"cfl": method["cfl"]},
                     "bodies": {problem.body: {"particles_per_cell": ppc}}}  # fmt: skip
            if smooth in problem.measures.values():
                probe = json.loads(scene_path(problem.scene).read_text())["probes"]["pressure_error"]
                patch["probes"] = {"smooth_error": {**probe, "field": "mean_stress_smooth"}}
            labels = {"problem": problem.name, **method, "ppc": ppc, "cell": round(cell, 8)}
            name = "-".join(str(v) for v in labels.values())
            yield problem, {"name": name, **labels}, Point(problem.scene, composed(patch, problem.patch(cell, n)),
                                                           problem.samples)  # fmt: skip


def measured(problem, labels, result):
    row = {**labels, "outcome": result["outcome"], "particles": result.get("particles"), "steps": result.get("steps")}
    if result["outcome"] != "completed":
        return [{**row, "measure": m, "error": None, "why": json.dumps(result.get("error") or result.get("detail"))}
                for m in problem.measures]  # fmt: skip
    return [{**row, "cpu_s": result["cpu_s"], "particle_steps": result["particles"] * result["steps"], "measure": m,
             "error": error(result)} for m, error in problem.measures.items()]  # fmt: skip


def pareto(rows):
    """Of each problem and measure, the runs with less error than every cheaper one."""
    best = []
    for key, group in itertools.groupby(sorted((r for r in rows if r["error"] is not None and math.isfinite(r["error"])),
                                               key=lambda r: (r["problem"], r["measure"], r["cpu_s"])),
                                        key=lambda r: (r["problem"], r["measure"])):  # fmt: skip
        least = math.inf
        for r in group:
            if r["error"] < least:
                least = r["error"]
                best.append({k: r[k] for k in ("problem", "measure", "error", "cpu_s", "basis", "scheme", "cfl", "ppc", "blend", "cell")})
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("size", nargs="?", choices=("small", "paper"), default="small")
    parser.add_argument("-o", "--output", type=pathlib.Path)
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--case")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    folder = options.output or ROOT / "build" / "report" / options.size
    wanted = list(points(options.size, options.only))
    if options.list or options.case:
        for problem, labels, point in wanted:
            if options.list:
                print(labels["name"])
            elif labels["name"] == options.case:
                for row in measured(problem, labels, run(point)):
                    print(json.dumps(row))
                return 0
        return 0 if options.list else f"there is no case {options.case}; --list names them"
    store = Store(folder / "points.jsonl")
    results = store.all([p for _, _, p in wanted], say=lambda n, of, p: sys.stderr.isatty() and print(n, of, p.scene, file=sys.stderr))
    rows = [row for (problem, labels, _), result in zip(wanted, results) for row in measured(problem, labels, result)]
    write_csv(folder / "accuracy.csv", rows)
    best = pareto(rows)
    write_csv(folder / "pareto.csv", best)
    print(markdown([{**b, "error": f"{b['error']:.3g}", "cpu_s": f"{b['cpu_s']:.2f}"} for b in best], list(best[0]) if best else []))
    bugs = [r for r in rows if r["outcome"] == "bug"]
    return f"bugs of the solver: {bugs}" if bugs else 0


if __name__ == "__main__":
    sys.exit(main())
