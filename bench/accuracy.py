#!/usr/bin/env python3
"""Error against cost: problems with a known answer, each at four resolutions with every basis and F-bar scheme, and
with one factor at a time changed from the default (quadratic B-splines, anchored, CFL 0.3): time increment,
particles per cell, FLIP blend. One thread; the cost is processor seconds inside the step loop, which other work on
the machine changes little, and particle-steps, which it does not change at all.

    bench/accuracy.py [small|paper] [-o FOLDER] [--only PROBLEM] [--list] [--case NAME]

Writes accuracy.csv and pareto.csv (for each problem and measure the runs that nothing beats in both error and cost).
--case runs one point again and prints it, as `fbar bench accuracy --case NAME` does; --list names them. What is done is kept; it goes on where it was stopped."""
import argparse
import csv
import dataclasses
import functools
import itertools
import json
import math
import pathlib
import sys

from study import ROOT, SCHEMES, Point, Store, composed, last, markdown, run, scene_path, series, write_csv

STUDY = json.loads(pathlib.Path(__file__).with_suffix(".json").read_text())  # fbar has it too (client/cmd_bench.c)
DEFAULT, FACTORS = STUDY["default"], STUDY["factors"]


@dataclasses.dataclass
class Problem:
    name: str
    scene: str
    body: str
    ppc: int  # particles per cell, the scene's own
    cells: list  # coarse to fine, m
    finer: list  # of SIZE=paper, beyond these
    samples: int
    overrides: dict  # {"constant": c, "per_spacing": k} in it is c + k times the distance of particles
    measures: dict  # name: a reference as a scene has it, whose relative error counts; or "references": the scene's own


PROBLEMS = [Problem(**p) for p in STUDY["problems"]]


def methods(problem):
    default = {**DEFAULT, "ppc": problem.ppc}
    for basis, scheme in itertools.product(STUDY["bases"], SCHEMES):
        yield {**default, "basis": basis, "scheme": scheme}
    for factor, values in FACTORS.items():
        for value in values:
            if value != default[factor]:
                yield {**default, factor: value}


def resolved(value, spacing):
    if isinstance(value, dict):
        if "per_spacing" in value:
            return value["constant"] + value["per_spacing"] * spacing
        return {k: resolved(v, spacing) for k, v in value.items()}
    return [resolved(v, spacing) for v in value] if isinstance(value, list) else value


def points(size, only=()):
    for problem in PROBLEMS:
        if only and problem.name not in only:
            continue
        for method, cell in itertools.product(methods(problem), problem.cells + (problem.finer if size == "paper" else [])):
            patch = {"cell": cell, "basis": method["basis"], "fbar": SCHEMES[method["scheme"]],
                     "transfer": {"blend": method["blend"]}, "time": {"cfl": method["cfl"]},
                     "bodies": {problem.body: {"particles_per_cell": method["ppc"]}}, "references": []}  # fmt: skip
            patch = composed(patch, resolved(problem.overrides, cell / math.isqrt(method["ppc"])))
            labels = {"problem": problem.name, **{k: method[k] for k in ("basis", "scheme", "cfl", "ppc", "blend")}, "cell": cell}
            name = "-".join(v if isinstance(v, str) else f"{v:g}" for v in labels.values())
            yield problem, {"name": name, **labels}, Point(problem.scene, patch, problem.samples, 120 if size == "small" else 1200)


def interpolated(rows, time):
    (t0, x0), (t1, x1) = next(pair for pair in itertools.pairwise(rows) if pair[1][0] >= time)
    return x0 + (x1 - x0) * (time - t0) / (t1 - t0)


@functools.cache
def table(name, column):
    lines = (ROOT / "scenes" / "reference" / f"{name}.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [(float(r["t"]), float(r[column])) for r in rows]


def relative_error(result, reference):
    """As the daemon has it (docs/api.md, `accuracy`)."""
    probe = ".".join(filter(None, (reference["probe"], reference.get("component"))))
    time, value = reference["at"], reference["value"]
    if isinstance(value, dict):
        value = interpolated(table(value["table"], value["column"]), time)
    found = last(result, probe) if time == "end" else interpolated(
        [(t, x) for t, x in series(result, probe) if t >= 0], time)  # fmt: skip
    return found / value - 1 if value else found


def error_of(problem, measure, result):
    if measure != "references":
        return abs(relative_error(result, measure))
    own = json.loads(scene_path(problem.scene).read_text())["references"]
    return math.sqrt(sum(relative_error(result, r) ** 2 for r in own) / len(own))


def measured(problem, labels, result):
    row = {**labels, "outcome": result["outcome"], "particles": result.get("particles"), "steps": result.get("steps")}
    if result["outcome"] != "completed":
        return [{**row, "measure": m, "error": None, "why": json.dumps(result.get("error") or result.get("detail"))}
                for m in problem.measures]  # fmt: skip
    return [{**row, "cpu_s": result["cpu_s"], "particle_steps": result["particles"] * result["steps"], "measure": m,
             "error": error_of(problem, how, result)} for m, how in problem.measures.items()]  # fmt: skip


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
