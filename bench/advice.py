#!/usr/bin/env python3
"""Numbers of the report in docs: fills what stands between `<!--= NAME -->` and `<!--/-->` in the files of DOCS from
the CSV files that docs keep of the small report, so that no number is typed. `make report-docs` calls it.

    bench/advice.py [--check] [--data FOLDER]

--check writes nothing and fails where a number differs; the names are those of NUMBERS and TABLES below."""
import argparse
import functools
import pathlib
import re
import sys

import hard
from measured import (ANCHORED, CREPT, WARNED, Measured, compare_smooth, drift_of_errors, factor, keeping, locking, method, motions, of_schemes, pressures,
                      ratio, read, typical)  # fmt: skip
from study import ROOT, markdown

DOCS = ("docs/choosing.md", "docs/method.md")
MARK = re.compile(r"<!--= ([\w.-]+) -->(.*?)<!--/-->", re.DOTALL)


class Study:
    """The CSV files of one report, read when they are asked for."""

    def __init__(self, folder):
        self.folder = folder

    @functools.cached_property
    def work(self):
        return Measured(read(self.folder / "accuracy.csv"))

    @functools.cached_property
    def scheme(self):
        return of_schemes(read(self.folder / "schemes.csv"))

    @functools.cached_property
    def creep(self):
        return read(self.folder / "creep.csv")

    @functools.cached_property
    def cases(self):
        return read(self.folder / "hard-cases.csv")

    @functools.cached_property
    def tearing(self):
        return read(self.folder / "tearing.csv")

    def error(self, problem, measure, basis, scheme, cell):
        row, = (r for r in self.work.of(problem, measure, basis=basis, scheme=scheme, cell=cell) if not r["changed"])
        return row["error"]

    def drifts(self, cell):
        return drift_of_errors([r for r in self.creep if r["cell"] == cell])

    def runout(self, basis, scheme):
        return f"{self.scheme('landslide slice, h = 0.25 m', basis, scheme, 'at 5.5 s, m'):.1f}"

    def enough(self, bases, scheme):
        """The fewest particles a cell from which on the strip of bench/tearing.py holds with all of these bases."""
        rows = [r for r in self.tearing if r["basis"] in bases and r["scheme"] == scheme]
        parted = max((int(r["n"]) for r in rows if r["parts at"]), default=0)
        return f"{min(n for n in (int(r['n']) for r in rows) if n > parted) ** 2}"

    def case(self, text):
        """A number of hard-cases.csv or tearing.csv, as bench/hard.py's texts have them."""
        case, rest = text.split(": ", 1)
        return hard.told(hard.Case(case, "", [], why=f"{{{rest}}}"), self.cases, self.tearing)


def x(value):
    return f"{value:.2f}" if value < 2.95 else f"{value:.1f}"


def percent(value):
    return f"{100 * value:.1f}" if value < 0.995 else f"{100 * value:.0f}"


# name: what it is of a Study, as text
NUMBERS = {
    "uGIMP-motion": lambda s: x(typical(s.work, motions(s.work), "gimp", "anchored")),
    "uGIMP-pressure": lambda s: x(typical(s.work, locking(s.work), "gimp", "anchored")),
    "uGIMP-cost": lambda s: x(typical(s.work, motions(s.work), "gimp", "anchored", "cpu_s")),
    "cubic-motion": lambda s: x(typical(s.work, motions(s.work), "bspline3", "anchored")),
    "cubic-pressure": lambda s: x(typical(s.work, locking(s.work), "bspline3", "anchored")),
    "cubic-cost": lambda s: x(typical(s.work, motions(s.work), "bspline3", "anchored", "cpu_s")),
    "standard-pressure": lambda s: x(typical(s.work, locking(s.work), "bspline2", "standard")),
    "zhao-pressure": lambda s: x(typical(s.work, locking(s.work), "bspline2", "zhao")),
    "zhao-uniform": lambda s: x(ratio(s.work, "cylinder", "pressure", lambda r: (r["basis"], r["scheme"], r["changed"]) == ("bspline2", "zhao", []))),
    "cfl-motion": lambda s: x(factor(s.work, motions(s.work), "cfl", 0.5)),
    "cfl-pressure": lambda s: x(factor(s.work, pressures(s.work), "cfl", 0.5)),
    "cfl-cost": lambda s: x(factor(s.work, pressures(s.work), "cfl", 0.5, "cpu_s")),
    "blend-0.99": lambda s: x(factor(s.work, motions(s.work), "blend", 0.99)),
    "blend-0": lambda s: x(factor(s.work, motions(s.work), "blend", 0)),
    "nine": lambda s: x(factor(s.work, [("cook", "pressure")], "ppc", 9)),
    "nine-cost": lambda s: x(factor(s.work, [("cook", "pressure")], "ppc", 9, "cpu_s")),
    "sixteen": lambda s: x(factor(s.work, [("cook", "pressure")], "ppc", 16)),
    "sixteen-cost": lambda s: x(factor(s.work, [("cook", "pressure")], "ppc", 16, "cpu_s")),
    "hidden-motion": lambda s: percent(s.error("cook", "displacement", "bspline2", "standard", 2.0)),
    "hidden-pressure": lambda s: percent(s.error("cook", "pressure", "bspline2", "standard", 2.0)),
    "smooth-cylinder": lambda s: x(compare_smooth(s.work, "cylinder", "anchored")),
    "smooth-cook": lambda s: x(compare_smooth(s.work, "cook", "standard")),
    "smooth-vortex": lambda s: x(compare_smooth(s.work, "vortex", "anchored")),
    "creep-4": lambda s: hard.ranged(s.drifts("4"), ".2g"),
    "creep-2": lambda s: hard.ranged(s.drifts("2"), ".2g"),
    "creep-first": lambda s: f"{min(drift_of_errors(s.creep)):.2g}",
    "crept": lambda s: f"{100 * CREPT:g}",
    "warned": lambda s: f"{WARNED:g}",
    "rest-keep": lambda s: percent(s.scheme("hydrostatic column", "bspline2", keeping(0.1), "pressure error")),
    "rest-standard": lambda s: percent(s.scheme("hydrostatic column", "bspline2", "standard", "pressure error")),
    "rest-anchored": lambda s: percent(s.scheme("hydrostatic column", "bspline2", ANCHORED, "pressure error")),
    "keep-dead": lambda s: s.case("dead load on a column: |*|keep|displacement"),
    "keep-cook": lambda s: f"{s.scheme('Cook, h = 4 m', 'bspline2', keeping(0.1), 'pressure RMS'):.2f}",
    "anchored-cook": lambda s: f"{s.scheme('Cook, h = 4 m', 'bspline2', ANCHORED, 'pressure RMS'):.2f}",
    "dead-hard": lambda s: f"{s.scheme('dead load at nu = 0.49999', 'bspline2', keeping(0.01), 'displacement, m'):.3f}",
    "cook-hard-anchored": lambda s: f"{s.scheme('Cook at nu = 0.49999, h = 4 m', 'bspline2', ANCHORED, 'pressure RMS'):.2f}",
    "cook-hard-keep": lambda s: f"{s.scheme('Cook at nu = 0.49999, h = 4 m', 'bspline2', keeping(0.01), 'pressure RMS'):.2f}",
    "cook-hard-much": lambda s: f"{s.scheme('Cook at nu = 0.49999, h = 4 m', 'bspline2', keeping(0.1), 'pressure RMS'):.2g}",
    "keep-rest": lambda s: f"{1000 * abs(s.scheme('resting column, 2e4 steps', 'bspline2', keeping(0.1), 'top, m')):.1f}",
    "anchored-rest": lambda s: f"{-1000 * s.scheme('resting column, 2e4 steps', 'bspline2', ANCHORED, 'top, m'):.0f}",
    "slice": lambda s: s.runout("bspline2", ANCHORED),
    "slice-02": lambda s: s.runout("bspline2", keeping(0.02)),
    "slice-10": lambda s: s.runout("bspline2", keeping(0.1)),
    "slice-uGIMP": lambda s: s.runout("gimp", ANCHORED),
    "slice-uGIMP-10": lambda s: s.runout("gimp", keeping(0.1)),
    "parts-standard": lambda s: hard.ranged([float(r["particles apart, cells"]) for r in s.tearing
                                             if r["scheme"] == "standard" and r["basis"] != "gimp" and r["parts at"]], ".2f"),
    "parts-uGIMP": lambda s: hard.ranged([float(r["particles apart, cells"]) for r in s.tearing
                                          if r["scheme"] == "standard" and r["basis"] == "gimp" and r["parts at"]], ".2f"),
    "parts-anchored": lambda s: s.case("stretch to 4 x: tearing|gimp bspline2 bspline3|anchored|7"),
    "enough-standard": lambda s: s.enough(("bspline2", "bspline3"), "standard"),
    "enough-keep": lambda s: s.enough(("bspline3",), "keep"),
    "holds-cubic": lambda s: s.case("stretch to 4 x: 49 per cell|bspline3|keep|stretch of the middle||.3g"),
}  # fmt: skip


def lasting(rows, goal):
    """Of one curve, coarse to fine: the coarsest run that reaches the goal with all finer ones; or None."""
    reached = None
    for r in reversed(rows):
        if not r["error"] <= goal:
            break
        reached = r
    return reached


def curves(data, problem, measure):
    made = {}
    for r in data.of(problem, measure):
        if r["basis"] != "linear":
            made.setdefault(method(r), []).append(r)
    return made


WANTED = (  # what, problem, measure, goals, over what the cells are counted, m
    ("pressure field of a bent, nearly incompressible body (RMS over its spread)", "cook", "pressure", (0.2, 0.1, 0.05), "its height", 44),
    ("displacement of that body", "cook", "displacement", (0.05,), "its height", 44),
    ("uniform pressure in the wall of a cylinder (over the pressure inside)", "cylinder", "pressure", (0.2, 0.1), "the wall", 1),
    ("pressure in a vortex of rubber (RMS over that of the stress)", "vortex-0.499", "pressure", (0.2,), "the ring", 0.5),
    ("velocity of a decaying vortex of fluid", "taylor-green", "velocity", (0.1, 0.05), "its width", 1),
    ("pressure of water at rest (largest error over that at the foot)", "column", "pressure", (0.05, 0.02), "the depth", 2),
    ("collapse load of a footing", "footing", "load", (0.1,), "its width", 1),
    ("front of a dam break (against our finest run)", "dam", "front", (0.05, 0.02), "the depth", 2),
)  # fmt: skip


def goals(s):
    """For each goal the cheapest run that reaches it and still does on all finer grids: of the quadratic, anchored
    ones, and of all."""
    rows = []
    for what, problem, measure, levels, over, size in WANTED:
        for goal in levels:
            found = {name: lasting(rows, goal) for name, rows in curves(s.work, problem, measure).items()}
            there = {name: r for name, r in found.items() if r}
            cheapest = lambda chosen: min((r for r in chosen if r), key=lambda r: r["cpu_s"], default=None)
            mine, best = cheapest(r for n, r in there.items() if n.startswith("quadratic anchored")), cheapest(there.values())
            line = {"you want": f"{what}, within {100 * goal:g} %"}
            if mine:
                line.update({"take": f"{mine['ppc']} a cell, {size / mine['cell']:.3g} cells over {over}" + "".join(
                                 f", `{f}` {mine[f]}" for f in mine["changed"] if f != "ppc"),
                             "error, %": percent(mine["error"]), "seconds": f"{mine['cpu_s']:.2g}", "shown by": f"`{mine['name']}`"})  # fmt: skip
            else:
                line.update({"take": "not reached at these cells", "error, %": "–", "seconds": "–", "shown by": "–"})
            line["cheapest of all"] = "–" if not best else "this" if mine is best else f"{method(best)}, {size / best['cell']:.3g} cells: {best['cpu_s']:.2g} s"
            rows.append(line)
    return markdown(rows, list(rows[0]))


TABLES = {"goals": goals}


def filled(text, study):
    """The text with every mark's content made anew."""

    def one(found):
        name = found[1]
        if name in TABLES:
            new = f"\n\n{TABLES[name](study)}\n"
        elif name in NUMBERS:
            new = NUMBERS[name](study)
        else:
            raise SystemExit(f"{name}: no such number in bench/advice.py")
        if "nan" in new:
            raise SystemExit(f"{name}: the data have no number for it")
        return f"<!--= {name} -->{new}<!--/-->"

    return MARK.sub(one, text)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a number differs")
    parser.add_argument("--data", type=pathlib.Path, default=ROOT / "docs" / "report" / "small")
    options = parser.parse_args()
    study, wrong = Study(options.data), []
    for name in DOCS:
        path = ROOT / name
        old = path.read_text(encoding="utf-8")
        new = filled(old, study)
        if new == old:
            continue
        if not options.check:
            path.write_text(new, encoding="utf-8")
            print(name)
        wrong += [f"{name}: {a[1]}: {a[2].strip()[:60]!r}, the data have {b[2].strip()[:60]!r}"
                  for a, b in zip(MARK.finditer(old), MARK.finditer(new)) if a[2] != b[2]]  # fmt: skip
    if options.check and wrong:
        return "\n".join(wrong + ["make report-docs SIZE=small writes them anew"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
