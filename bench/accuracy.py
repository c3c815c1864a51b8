#!/usr/bin/env python3
"""Error against cost: problems with a known answer, each at four resolutions with every basis and F-bar scheme, and
with one factor at a time changed from the default (quadratic B-splines, anchored, CFL 0.3): time increment,
particles per cell, FLIP blend. One thread; the cost is processor seconds inside the step loop, which other work on
the machine changes little, and particle-steps, which it does not change at all.

    bench/accuracy.py [small|paper] [-o FOLDER] [--only PROBLEM] [--list] [--case NAME]

Writes accuracy.csv and pareto.csv (for each problem and measure the runs that nothing beats in both error and cost).
--case runs one point again and prints it; --list names them. What is done is kept; it goes on where it was stopped."""
import argparse
import dataclasses
import itertools
import json
import math
import pathlib
import sys

from study import BASES, ROOT, SCHEMES, Point, Store, at, composed, last, markdown, run, write_csv

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


PROBLEMS = [
    Problem("cook", "hard-incompressible", "membrane", (8, 4, 2, 1.6), {
        "displacement": lambda r: abs(last(r, "column.y") / 0.261735 - 1),
        "pressure": lambda r: last(r, "pressure_error")},
        lambda cell, n: {"materials": {"rubber": {"poisson_ratio": 0.499}}}, paper=(1, 0.5)),
    Problem("cylinder", "thick-cylinder", "ring", (0.5, 0.25, 0.1875, 0.125), {
        "displacement": lambda r: last(r, "displacement_error"), "pressure": lambda r: last(r, "pressure_error")},
        ppc=9, paper=(0.0625,)),
    Problem("taylor-green", "taylor-green", "vortex", (0.25, 0.125, 0.0625, 0.03125), {
        "velocity": lambda r: last(r, "velocity_error"), "pressure": lambda r: last(r, "pressure_error")},
        lambda cell, n: {"time": {"end": 0.5}, "references": []}, ppc=9, paper=(0.015625,)),
    Problem("vortex", "vortex", "ring", (0.25, 0.125, 0.08125, 0.0625), {
        "displacement": lambda r: last(r, "displacement_error"), "stress": lambda r: last(r, "stress_error")},
        lambda cell, n: {"time": {"end": 0.25}, "references": []}, ppc=16, paper=(0.03125,)),
    Problem("vortex-0.499", "vortex-incompressible", "ring", (0.25, 0.125, 0.08125), {
        "displacement": lambda r: last(r, "displacement_error"), "pressure": lambda r: last(r, "pressure_error")},
        lambda cell, n: {"time": {"end": 0.25}, "references": []}, ppc=16, paper=(0.0625, 0.03125)),
    Problem("column", "hydrostatic-column", "column", (0.5, 0.25, 0.125, 0.0625), {
        "pressure": lambda r: last(r, "pressure_error")}, ppc=16),
    Problem("footing", "strip-footing-small", "soil", (0.25, 0.125, 0.1, 0.0625), {
        "load": lambda r: abs(last(r, "load.y") / (2 + math.pi) - 1)}, footing, paper=(0.05, 0.025)),
    Problem("dam", "hard-dam-break", "reservoir", (0.5, 0.25, 0.125), {
        "front": lambda r: abs(at(r, "front", 0.336) / 5.26 - 1)},  # m: extrapolated from h = 1/8 and 1/16 m
        lambda cell, n: {"time": {"end": 0.672}}, samples=2, paper=(0.0625,)),
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
            labels = {"problem": problem.name, **method, "ppc": ppc, "cell": cell}
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
