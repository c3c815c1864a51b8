#!/usr/bin/env python3
"""The hard cases (scenes/hard, and the built-in scenes that are hard): each with every basis and F-bar scheme, and a
verdict.

    bench/hard.py [--quick] [-o FOLDER] [CASE ...]

passes:     ended, and every measure is within its tolerance;
degrades:   ended, with the measure that is off most, and what it is off by;
fails:      caught by the solver, which names the kind and the time; its last good state is kept (a daemon's run
            has it as the last frame and a checkpoint: tests/api/test_hard_cases.py);
BUG:        a crash, no end, or values that are not finite and no failure. Exit code 1.

With `verdicts.csv` beside this file the exit code is 1 as well where a verdict is worse than it says."""
import argparse
import csv
import dataclasses
import itertools
import math
import pathlib
import re
import sys

import study
from study import BASES, ROOT, Point, Store, at, last, markdown, merged, number, series, write_csv

G = 9.81
SCHEMES = {**study.SCHEMES, "keep": {"scheme": "anchored", "keep": 0.1}}


@dataclasses.dataclass
class Measure:
    name: str
    value: object  # of the runner's result
    wanted: float
    tolerance: float  # of |value - wanted| / |wanted|, or of |value| where 0 is wanted
    why: str

    def off(self, result):
        found = self.value(result)
        off = abs(found - self.wanted) / (abs(self.wanted) or 1)
        return off if math.isfinite(off) else math.inf


@dataclasses.dataclass
class Case:
    name: str
    scene: str
    measures: list
    vary: dict = dataclasses.field(default_factory=lambda: {"": {}})  # label: patch
    bases: tuple = BASES
    schemes: tuple = tuple(SCHEMES)
    samples: int = 20
    seconds: float = 120
    quick: tuple = ()  # labels of `vary` that the quick table has; none: not in it
    # What is behind the verdicts that are no pass. {variant|bases|schemes|measure} is the range of a measure over those
    # (* is all bases but linear), {...|factor|format} with another unit or precision, {tearing|bases|scheme|n} the
    # stretch at which a strip parts (tearing.py): numbers are those of the run that is told of.
    why: str = ""


def energy_gain(result):
    """Most that the total energy less the work of loads and walls rises above its first value of the last stage,
    over the largest kinetic energy or change of potential energy since then."""
    rows = [r for r in result["series"] if r["time"] >= 0]
    total = [number(r["kinetic"]) + number(r["strain"]) + number(r["potential"]) for r in rows]
    scale = max(max(number(r["kinetic"]) for r in rows), abs(number(rows[0]["potential"])), 1e-300)
    return max(0.0, max(total) - total[0]) / scale


def kinetic_left(result):
    first, end = result["series"][0], result["series"][-1]
    return number(end["kinetic"]) / number(first["kinetic"])


def spin_left(result):
    first, end = result["series"][0], result["series"][-1]
    return end["angular_momentum"][0] / first["angular_momentum"][0]


def momentum_off(result):
    first, end = result["series"][0], result["series"][-1]
    scale = math.sqrt(2 * number(first["kinetic"]) * 1000)
    return max(abs(a - b) for a, b in zip(first["momentum"], end["momentum"])) / scale


def total_left(result):
    """Of the kinetic and strain energy at the start."""
    first, end = result["series"][0], result["series"][-1]
    return (number(end["kinetic"]) + number(end["strain"])) / (number(first["kinetic"]) + number(first["strain"]))


def fall_off(result):
    """Of the exact speed g t of free fall."""
    end = result["series"][-1]
    return abs(number(end["probes"]["velocity.y"]) / (-G * end["time"]) - 1)


def flight_off(axis):
    """Of the lone particle from its free flight near 0.5 s, m, at the time of the sample itself."""

    def off(result):
        row = min(result["series"], key=lambda r: abs(r["time"] - 0.5))
        t = row["time"]
        exact = {"x": 0.9 + 1.5 * t, "y": 3.1 - G * t * t / 2}[axis]
        return number(row["probes"][f"place.{axis}"]) - exact

    return off


def fall_stress(result):
    """Largest stress on the way, over Young's modulus."""
    return max(max(abs(number(r["probes"][k])) for k in ("stress_max", "pressure_max")) for r in result["series"]) / 1e5


def settle(k):
    return 0.3 * max(1.0, math.sqrt(2e7 / k))


NO_GAIN = Measure("energy gained", energy_gain, 0, 1e-3, "nothing brings any in")
DRIFT = Measure("drift", lambda r: max(number(row["drift"]) for row in r["series"]), 0, 0.1,
                "the volume that forces use and that of the stress are within 10 %")  # fmt: skip

CASES = [
    Case("nu to 0.49999", "hard-incompressible", [
        Measure("column", lambda r: last(r, "column.y"), 0.2617, 0.15, "P2/P1 FEM; h = 4 m has some % of its own"),
        Measure("pressure RMS", lambda r: last(r, "pressure_error"), 0, 0.6, "of the FEM pressure's spread; h = 4 m")],
        {f"nu = {nu}": {"materials": {"rubber": {"poisson_ratio": nu}}} for nu in (0.499, 0.4999, 0.49999)},
        quick=("nu = 0.499",),
        why="Without F̄ the pressure is noise that grows with K (quadratic: {nu = 0.499|bspline2|standard|pressure RMS} of "
        "the pressure's spread at nu = 0.499, {nu = 0.49999|bspline2|standard|pressure RMS} at 0.49999), and linear and "
        "uGIMP are too stiff as well (uGIMP at nu = 0.49999: {nu = 0.49999|gimp|standard|column} m, not 0.262). zhao "
        "creeps, with cubic splines at nu = 0.499 past the tolerance. keep = 0.1 is for nu = 0.499: beyond, it brings the "
        "noise back, linear and uGIMP from 0.4999, all at 0.49999; take about sqrt(5 mu/K)."),
    Case("disk, 10 turns", "hard-rotating-disk", [
        Measure("angular momentum", spin_left, 1, 0.1, "exact"),
        Measure("energy gained", energy_gain, 0, 1e-3, "nothing brings any in")],
        why="FLIP on a grid loses spin, whatever the scheme: {|*|*|angular momentum} of it is left, and the disk's radius is "
        "4 cells. Linear: cell crossings turn particles inside out."),
    Case("disk collision", "disk-collision", [
        Measure("momentum", momentum_off, 0, 1e-10, "exact; round-off of some thousand steps"),
        Measure("energy left", total_left, 0.85, 0.25, "elastic; standard quadratic B-splines keep 0.76"), NO_GAIN],
        why="zhao leaves {|*|zhao|energy left} of the energy where anchored leaves {|*|anchored|energy left}, and with "
        "B-splines makes some on the way ({|bspline2 bspline3|zhao|energy gained} of the kinetic energy): it has no "
        "energy proof. Linear: cell crossings turn particles inside out."),
    Case("bar impact", "hard-bar-impact", [
        Measure("length", lambda r: last(r, "length"), 0.2483, 0.15, "h = 0.05 m, quadratic B-splines, anchored"),
        NO_GAIN, DRIFT], {"10 m/s": {}}, quick=("10 m/s",),
        why="Without F̄ the bar locks: it ends {10 m/s|*|standard|length} m long, not 0.248; with keep = 0.1 a little, with "
        "uGIMP and cubic splines past the tolerance ({10 m/s|gimp|keep|length} and {10 m/s|bspline3|keep|length} m). zhao "
        "has the length right, but the volumes of forces and stresses part, by {10 m/s|*|zhao|drift} in the logarithm. "
        "Linear: cell crossings turn particles inside out."),
    Case("bar impact", "hard-bar-impact-fast", [
        Measure("length at 0.025 s", lambda r: at(r, "length", 0.025), 0.2373, 0.15,
                "h = 0.05 m, quadratic B-splines, anchored"), NO_GAIN, DRIFT],
        {"40 m/s": {}},
        why="uGIMP without F̄ locks ({40 m/s|gimp|standard|length at 0.025 s} m, not 0.237); B-splines without F̄ are within "
        "the tolerance, since inertia rules. zhao: the volumes of forces and stresses part, by {40 m/s|*|zhao|drift}. "
        "Linear: cell crossings."),
    Case("stretch to 4 x", "hard-stretch", [
        Measure("stretch of the middle", lambda r: 1 + last(r, "middle.x") / 1.5, 4, 0.05, "exact"), DRIFT],
        {f"{n} per cell": {"bodies": {"strip": {"particles_per_cell": n}}} for n in (9, 49)},
        seconds=60,
        why="Particles end s/n of a cell apart, s the stretch and n their number in each direction of a cell. Without F̄ a "
        "B-spline strip parts when that passes one cell, so that there are cells without a particle, whose stiffness "
        "nobody carries (quadratic: at {tearing|bspline2|standard|2}, {tearing|bspline2|standard|3} and "
        "{tearing|bspline2|standard|4} for n = 2, 3, 4; 9 per cell is n = 3, too few for 4 whatever the scheme), long "
        "before the supports of neighbours part (3 and 4 cells). uGIMP parts at {tearing|gimp|standard|4} and "
        "{tearing|gimp|standard|5} for n = 4 and 5: its particles keep the size they began with, so that gaps open "
        "between them at once, and its gradients are nearly steps, so that a cell's force hangs on how many particles "
        "are in it (cpGIMP and CPDI let particles grow; fbard has neither). With 49 per cell (n = 7) that is no matter, but F̄ lets "
        "particles gather within cells, which nothing but the shear modulus resists, until the strip tears: anchored at "
        "{tearing|gimp bspline2 bspline3|anchored|7}; zhao with uGIMP at {tearing|gimp|zhao|7}, and with B-splines it "
        "holds with volumes far apart; keep later ({tearing|gimp bspline2|keep|7}), with cubic splines never."),
    Case("dead load on a column", "hard-dead-load", [
        Measure("displacement", lambda r: last(r, "middle.x"), 0.75, 0.05, "exact"), DRIFT], seconds=60,
        why="A load on the outermost particles meets a stress that F̄ averages over a cell: with anchored the layer comes off "
        "(method.md, section 4), with zhao and uGIMP too. Spread the load over a cell. With keep = 0.1 it holds: "
        "{|*|keep|displacement} m, exact 0.75. zhao with B-splines holds it, with volumes apart by {|bspline2 "
        "bspline3|zhao|drift} in the logarithm. Linear: cell crossings turn particles inside out."),
    Case("residual strength 0.05 kPa", "hard-residual-strength", [
        Measure("run-out", lambda r: last(r, "runout"), 29.9, 0.1, "h = 0.25 m with the anchored F-bar: 29.98, 29.82"),
        NO_GAIN, DRIFT],
        why="Without F̄ the slope locks (linear and uGIMP stop at {|gimp|standard|run-out} m, B-splines at {|bspline2 "
        "bspline3|standard|run-out}, not 29.9), with keep = 0.1 a little (uGIMP {|gimp|keep|run-out}, quadratic "
        "{|bspline2|keep|run-out} m; anchored {|gimp|anchored|run-out} and {|bspline2|anchored|run-out}). zhao's volumes "
        "part, by {|*|zhao|drift} in the logarithm. Cubic splines run out less at this h, with every scheme. Linear with "
        "F̄: cell crossings."),
    Case("footing at a tenth of the rate", "hard-footing-slow", [
        Measure("load", lambda r: last(r, "load.y"), 5.14159, 0.15, "2 + pi; FEM at this h 5.29"), DRIFT],
        why="Without F̄ too stiff ({|*|standard|load} where 5.14 is exact), linear and uGIMP with keep = 0.1 still ({|linear "
        "gimp|keep|load}): where the flow is plastic, little but K resists. zhao with B-splines: the load creeps away in "
        "so many steps ({|bspline2 bspline3|zhao|load})."),
    Case("dam break", "hard-dam-break", [
        Measure("front at 0.336 s", lambda r: at(r, "front", 0.336), 5.0, 0.05, "h = 0.25 m, 25 per cell, K = 2e9"),
        NO_GAIN],
        {f"K = {k:g}, CFL {cfl}": {"materials": {"water": {"bulk_modulus": k}}, "time": {"cfl": cfl, "end": 0.672},
                                   "stages": [{"name": "settle", "duration": settle(k), "damping": {"local": 0.5}},
                                              {"name": "flow", "remove": {"walls": ["gate"]}}]}
         for k in (2e6, 2e7, 2e8, 2e9) for cfl in (0.1, 0.3, 0.5)},
        bases=("gimp", "bspline2"), samples=16, quick=("K = 2e+06, CFL 0.5",),
        why="Without F̄ uGIMP is late from K = 2e7 on (front at {K = 2e+07, CFL 0.3|gimp|standard|front at 0.336 s} m, not "
        "5.0; {K = 2e+09, CFL 0.3|gimp|standard|front at 0.336 s} at 2e9) and quadratic splines at 2e9 ({K = 2e+09, CFL "
        "0.3|bspline2|standard|front at 0.336 s}); with keep = 0.1 uGIMP at 2e9 ({K = 2e+09, CFL 0.3|gimp|keep|front at "
        "0.336 s}). Increments do not matter."),
    Case("dam break to 6 s", "hard-dam-break", [NO_GAIN],
         {"K = 2e7": {"time": {"end": 6}}}, samples=60,
        why="Linear: cell crossings turn particles inside out before the gate goes."),
    Case("one particle per cell", "hard-one-per-cell", [
        Measure("weight", lambda r: last(r, "floor_force.y"), -19570.95, 0.01, "exact"),
        Measure("pressure", lambda r: last(r, "pressure_error"), 0, 0.1, "largest error over that at the foot")],
        {"": {}}, quick=("",),
        why="zhao never comes to rest (as the resting column, below); its pressure is off by {|*|zhao|pressure} of that at "
        "the foot."),
    Case("49 particles per cell", "hard-many-per-cell", [
        Measure("weight", lambda r: last(r, "floor_force.y"), -19570.95, 0.01, "exact"),
        Measure("pressure", lambda r: last(r, "pressure_error"), 0, 0.1, "largest error over that at the foot")],
        why="zhao never comes to rest, as with one particle per cell; its pressure is off by {|*|zhao|pressure}."),
    Case("on edges, walls, corners", "hard-on-edges", [
        Measure("weight", lambda r: last(r, "floor.y"), -9810, 0.01, "exact"),
        Measure("top", lambda r: last(r, "top"), 1, 0.03, "exact: 3 mm below 1 m; 3 % is a tenth of a cell")],
        {"": {}}, quick=("",),
        why="Linear only: particles that barely reach a node, where the weight of a neighbour is nearly 0. Without F̄ one "
        "turns inside out, zhao and anchored carry {|linear|zhao|weight||.0f} and {|linear|anchored|weight||.0f} N of -9810."),
    Case("lone particle", "hard-lone-particle", [
        Measure("height at 0.5 s", flight_off("y"), 0, 0.0044, "free flight; a step's increment acts on its whole step: g t dt/2"),
        Measure("distance at 0.5 s", flight_off("x"), 0, 1e-9, "free flight, no force"),
        Measure("energy gained", energy_gain, 0, 0.01, "a step's work of gravity")],
        {"": {}}, quick=("",),
        why="Linear only: in the last cell before the wall its volume becomes negative."),
    Case("resting column", "hard-resting-column", [
        Measure("pressure", lambda r: last(r, "pressure"), 4905, 0.05, "exact"),
        Measure("sinking of the top", lambda r: (last(r, "top") - at(r, "top", 0)) / 0.005, 0, 0.2,
                "over the 5 mm that the column is compressed by"),
        Measure("kinetic energy", lambda r: last(r, "energy.kinetic"), 0, 1e-3 * 4.0, "of the strain energy, 4 J")],
        {"1e6 steps": {}, "2e4 steps": {"time": {"end": 44}}}, seconds=300, quick=("2e4 steps",),
        why="F̄ has no stiffness against motions whose change of volume cancels within every cell (the particles around every "
        "other node move together), and water resists nothing else: at the free surface, where few particles carry a "
        "node, they are pushed. zhao collapses. anchored with B-splines sinks, by {2e4 steps|bspline2|anchored|sinking of "
        "the top|-5|.0f} and {2e4 steps|bspline3|anchored|sinking of the top|-5|.0f} mm in 2e4 steps, quadratic ones by "
        "{1e6 steps|bspline2|anchored|sinking of the top|-5|.0f} mm in 1e6, where cubic ones leave the domain and linear "
        "ones turn inside out; with uGIMP it rests. With keep = 0.1 all do (the top is within {1e6 "
        "steps|bspline2|keep|sinking of the top|5|.1f} mm of where it belongs), and without F̄."),
    Case("free fall of 1,000 cells", "hard-free-fall", [
        Measure("speed", fall_off, 0, 1e-12, "exact; round-off of 9,000 steps"),
        Measure("stress", fall_stress, 0, 1e-11,
                "exact 0; a position of 1,000 cells is known to 1e-13 of a cell, the speed is 400 cells/s"),
        Measure("drift", lambda r: number(r["series"][-1]["drift"]), 0, 1e-11, "exact 0, as the stress")],
        {"": {}}, quick=("",),
        why="Linear without F̄: particles that barely reach a node; their round-off comes to the tolerance "
        "({|linear|standard|stress} of Young's modulus; 1.05e-11 and 6.1e-12 on builds that differ in the order of "
        "operations)."),
]  # fmt: skip


def ranged(numbers, form=""):
    """`low to high`, or one number."""
    texts = list(dict.fromkeys(f"{x:{form or '.3g'}}" for x in (min(numbers), max(numbers))))
    return " to ".join(texts)


def told(case, rows, tearing):
    """The case's `why` with numbers of hard-cases.csv (rows) and tearing.csv."""

    def resolve(found):
        variant, bases, schemes, measure, factor, form = (found[1].split("|") + ["", ""])[:6]
        bases = BASES[1:] if bases == "*" else bases.split()
        if variant == "tearing":
            numbers = [float(r["parts at"]) for r in tearing if r["basis"] in bases and r["scheme"] == schemes and r["n"] == measure and r["parts at"]]
            return ranged(numbers, ".1f") if numbers else "no stretch up to 4"
        schemes = list(SCHEMES) if schemes == "*" else schemes.split()
        numbers = [float(m.rsplit(" ", 1)[1]) * float(factor or 1) for r in rows
                   if (r["case"], r["variant"]) == (case.name, variant) and r["basis"] in bases and r["scheme"] in schemes
                   for m in r["measures"].split("; ") if m.rsplit(" ", 1)[0] == measure]  # fmt: skip
        if not numbers:
            raise KeyError(f"{case.name}: nothing is measured of {found[0]}")
        return ranged(numbers, form)

    return re.sub(r"\{([^{}]*)\}", resolve, case.why)


def points(cases, quick):
    for case in cases:
        for label, basis, scheme in itertools.product(case.vary, case.bases, case.schemes):
            if quick and label not in case.quick:
                continue
            patch = merged(case.vary[label], {"basis": basis, "fbar": SCHEMES[scheme]})
            yield case, {"case": case.name, "variant": label, "basis": basis, "scheme": scheme}, Point(
                case.scene, patch, case.samples, case.seconds)  # fmt: skip


def judged(case, labels, result):
    row = {**labels, "cpu_s": round(result.get("cpu_s", 0), 2), "steps": result.get("steps", "")}
    if result["outcome"] == "failed":
        error = result["error"]
        end = result["series"][-1]["time"] if len(result["series"]) > 1 else 0
        return {**row, "verdict": "fails", "detail": f"{error['kind']} at t = {error['time']:.3g} s",
                "measures": f"last sample t = {end:.3g} s"}  # fmt: skip
    if result["outcome"] != "completed":
        return {**row, "verdict": "BUG", "detail": result.get("bug") or result.get("detail") or result["outcome"],
                "measures": ""}  # fmt: skip
    offs = [(m.off(result) / m.tolerance, m) for m in case.measures]
    worst, measure = max(offs, key=lambda o: o[0])
    return {**row, "verdict": "passes" if worst <= 1 else "degrades",
            "detail": f"{measure.name}: {measure.value(result):.4g}" + (f", not {measure.wanted:g}" if worst > 1 else ""),
            "measures": "; ".join(f"{m.name} {m.value(result):.4g}" for m in case.measures)}  # fmt: skip


ORDER = ["passes", "degrades", "fails", "BUG"]


def worse(rows, file):
    """Rows whose verdict is worse than the recorded one."""
    if not file.exists():
        return []
    with file.open() as kept:
        known = {(r["case"], r["variant"], r["basis"], r["scheme"]): r["verdict"] for r in csv.DictReader(kept)}
    return [r for r in rows
            if ORDER.index(r["verdict"]) > ORDER.index(known.get((r["case"], r["variant"], r["basis"], r["scheme"]), "fails"))]  # fmt: skip


def table(rows):
    """One line a case and variant, one column a basis and scheme."""
    lines = {}
    for r in rows:
        line = lines.setdefault((r["case"], r["variant"]), {"case": r["case"], "variant": r["variant"]})
        line[f"{r['basis']} {r['scheme']}"] = {"passes": "passes", "degrades": f"degrades ({r['detail']})",
                                               "fails": f"fails ({r['detail']})", "BUG": f"BUG {r['detail']}"}[r["verdict"]]  # fmt: skip
    columns = ["case", "variant"] + [f"{b} {s}" for b in BASES for s in SCHEMES]
    return markdown(lines.values(), columns)


def judge(store, quick=False, names=(), say=None):
    wanted = list(points([c for c in CASES if not names or c.name in names], quick))
    results = store.all([p for _, _, p in wanted], say=say)
    return [judged(case, labels, result) for (case, labels, _), result in zip(wanted, results)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="the sample that `make check` runs")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "build" / "report" / "small")
    parser.add_argument("--record", action="store_true", help="write verdicts.csv anew")
    parser.add_argument("cases", nargs="*")
    options = parser.parse_args()

    def say(n, of, point):
        if sys.stderr.isatty() or n == of:
            print(f"{n} of {of}: {point.scene}", file=sys.stderr)

    rows = judge(Store(options.output / "points.jsonl"), options.quick, options.cases, say)
    write_csv(options.output / "hard-cases.csv", rows)
    (options.output / "hard-cases.md").write_text(table(rows))
    kept = pathlib.Path(__file__).with_name("verdicts.csv")
    if options.record:
        write_csv(kept, [{k: r[k] for k in ("case", "variant", "basis", "scheme", "verdict")} for r in rows])
    for r in rows:
        print(f"{r['case']:30} {r['variant']:18} {r['basis']:9}{r['scheme']:9} {r['verdict']:9} {r['detail']}  [{r['measures']}]")
    bad = [r for r in rows if r["verdict"] == "BUG"] + worse(rows, kept)
    for r in bad:
        print(f"WORSE THAN RECORDED: {r}", file=sys.stderr)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
