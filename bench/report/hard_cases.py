"""Hard cases: what bench/hard.py and ladder.py have run (`make report` calls them first)."""
from collections import Counter

import hard
from draw import COLOURS, plt, save
from page import Picture, Section, Table
from work_precision import rows_of, table

TITLE = "Hard cases"
BASES = {"linear": "linear", "gimp": "uGIMP", "bspline2": "quadratic", "bspline3": "cubic"}
SCHEMES = ("standard", "zhao", "anchored", "keep")
SIGNS = {"passes": "✓", "degrades": "d", "fails": "✗", "BUG": "BUG"}


def cases(size):
    return []  # the studies keep their own points


def verdicts(rows):
    """A row a case and variant, a column a basis; in each cell the verdicts of standard, zhao, anchored, and anchored with keep = 0.1."""
    lines = {}
    for r in rows:
        line = lines.setdefault((r["case"], r["variant"]), {})
        line[r["basis"], r["scheme"]] = SIGNS[r["verdict"]]
    return Table(None, ["case", *BASES.values()], [
        [f"{case}, {variant}" if variant else case,
         *(" ".join(found[b, s] for s in SCHEMES if (b, s) in found) or "–" for b in BASES)]
        for (case, variant), found in lines.items()],
        "✓ passes, d degrades, ✗ fails (caught and named), in the order standard, zhao, anchored, anchored with keep = 0.1. How far each is off: "
        "`hard-cases.csv`.", shown=100, docs=True)  # fmt: skip


def reasons(rows, tearing):
    there = {r["case"] for r in rows if r["verdict"] != "passes"}
    return Table(None, ["case", "what is behind the verdicts that are no pass"],
                 [[c.name + (f", {next(iter(c.vary))}" if len(c.vary) == 1 and next(iter(c.vary)) else ""), hard.told(c, rows, tearing)]
                  for c in hard.CASES if c.name in there and c.why], "Why", shown=100, docs=True)  # fmt: skip


def tearing(rows):
    """The stretch at which a strip parts over the particles in each direction of a cell, a panel a basis."""

    def draw(path):
        figure, axes = plt.subplots(1, 3, figsize=(9, 3), layout="constrained", sharey=True)
        for axis, basis in zip(axes, ("gimp", "bspline2", "bspline3")):
            axis.grid(True, color="#e5e5e5", linewidth=0.6)
            axis.plot([1, 4], [1, 4], color="#777777", linewidth=0.8, linestyle="--", label="neighbours a cell apart")
            for scheme in SCHEMES:
                curve = [r for r in rows if (r["basis"], r["scheme"]) == (basis, scheme)]
                colour = COLOURS.get(scheme, "#b9770e")
                axis.plot([int(r["n"]) for r in curve], [float(r["parts at"] or 4) for r in curve], color=colour, linewidth=1,
                          label={"keep": "anchored, keep = 0.1"}.get(scheme, scheme))
                for r in curve:
                    axis.plot(int(r["n"]), float(r["parts at"] or 4), marker="." if r["parts at"] else "^", color=colour, clip_on=False)
            axis.set(title=BASES[basis], xlabel="particles in each direction of a cell", ylim=(1, 4.2))
        axes[0].set_ylabel("stretch at which the strip parts")
        axes[-1].legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=6.5)
        save(figure, path)

    return draw


def tearing_table(rows):
    def cell(basis, scheme, n):
        found = next((r for r in rows if (r["basis"], r["scheme"], r["n"]) == (basis, scheme, n)), None)
        return "–" if not found else f"{found['parts at']} ({found['particles apart, cells']})" if found["parts at"] else "holds"

    counts = list(dict.fromkeys(r["n"] for r in rows))
    return Table(None, ["basis and scheme", *(f"n = {n}" for n in counts)],
                 [[f"{BASES[b]} {s}", *(cell(b, s, n) for n in counts)] for b in ("gimp", "bspline2", "bspline3") for s in SCHEMES],
                 "Stretch at which the strip parts, and in parentheses how far apart its particles are then, in cells", shown=100, docs=True)  # fmt: skip


def tearing_verdict(rows):
    """Without F-bar, B-splines should hold until a cell can be empty."""
    apart = [float(r["particles apart, cells"]) for r in rows if r["scheme"] == "standard" and r["basis"] != "gimp" and r["parts at"]]
    early = [float(r["particles apart, cells"]) for r in rows if r["scheme"] == "standard" and r["basis"] == "gimp" and r["parts at"]]
    gathered = [float(r["particles apart, cells"]) for r in rows if r["scheme"] == "anchored" and r["parts at"]]
    if not apart or not early or not gathered:
        return "not shown yet", "no strip has parted"
    return ("holds" if min(apart) > 0.9 and max(apart) < 1.2 else "does not hold",
            f"B-splines without F̄ part when their particles are {min(apart):.2f} to {max(apart):.2f} of a cell apart: when a cell can be empty, and not when the supports of "
            f"neighbours part (3 and 4 cells). uGIMP parts at {min(early):.2f} to {max(early):.2f} of a cell: its particles keep their size, 1/n of a cell, and gaps open between them. With anchored it is {min(gathered):.2f} to "
            f"{max(gathered):.2f}: particles gather within cells, which the average does not feel (method.md, section 4, keep).")  # fmt: skip


def sections(shelf):
    made = []
    rows = rows_of(shelf, "hard-cases.csv")
    if rows:
        count = Counter(r["verdict"] for r in rows)
        by_scheme = {s: Counter(r["verdict"] for r in rows if r["scheme"] == s and r["basis"] != "linear") for s in SCHEMES}
        made.append(Section(
            "hard-cases", "Verdicts", "nothing of the kind.",
            "Each case with every basis and scheme (<code>bench/hard.py</code>, scenes <code>hard-...</code>). <i>Passes</i>: every measure "
            "within its tolerance. <i>Degrades</i>: it ends, and is off by what is said. <i>Fails</i>: caught, with kind and time; the last good "
            "frame and a checkpoint are kept. <code>make check-long</code> runs all and fails where one is worse than recorded.",
            "exact values, finite elements, finer grids (bench/hard.py names each, with its tolerance).",
            ("does not hold" if count["BUG"] else "holds",
             f"No crash, hang or silent NaN in {len(rows)} runs: {count['passes']} pass, {count['degrades']} degrade, {count['fails']} fail; without "
             "the linear basis " + "; ".join(f"{s}: {c['passes']} pass, {c['degrades']} degrade, {c['fails']} fail" for s, c in by_scheme.items()) + "."
             if not count["BUG"] else f"{count['BUG']} bugs"),
            [], [verdicts(rows), reasons(rows, rows_of(shelf, "tearing.csv")),
                 table("hard-cases-shown.csv", rows, "Verdicts, one by one", ["case", "variant", "basis", "scheme", "verdict", "detail"])],
            data=["hard-cases.csv"]))  # fmt: skip
    strips = rows_of(shelf, "tearing.csv")
    if strips:
        made.append(Section(
            "tearing", "Where a stretched body parts", "nothing of the kind.",
            "A strip of rubber, h = 0.25 m, pulled slowly to four times its length by a force over its last third, with n particles in each direction of a cell "
            "(<code>bench/tearing.py</code>). It has parted when its middle is 5 % from the exact stretch under its load, or when the run fails; ▲ in the picture and <i>holds</i> in the "
            "table: not up to 4.", "the exact stretch of an incompressible strip in plane strain; particles a cell apart at a stretch of n.",
            tearing_verdict(strips),
            [Picture("tearing.png", "Stretch at which a strip parts, over the number of particles in each direction of a cell.", tearing(strips))],
            [tearing_table(strips)], data=["tearing.csv"]))  # fmt: skip
    rungs = rows_of(shelf, "dt-ladder.csv")
    if rungs:
        judged = [r for r in rungs if r["basis"] != "linear"]
        bad = [r for r in judged if r["verdict"] != "safe"]
        blown = [float(r["blown"]) for r in judged if not r["blown"].startswith(">")]
        made.append(Section(
            "dt-ladder", "The stability limit", "a Courant number, for their runs.",
            "A shaken block that moves through the grid, with increments from 0.4 to 5 times the limit that the daemon states; <i>whole</i> and "
            "<i>blown</i> are multiples of it (<code>bench/ladder.py</code>).", "safe, and at most 40 % below the blow-up (1.67 of the limit).",
            ("holds" if not bad else "holds in part", f"{len(judged) - len(bad)} of {len(judged)} are safe and not too careful"
             + (f": the first blow-ups are at {min(blown):g} to {max(blown):g} of the limit" if blown else "") + ". The linear basis has no safe "
             "increment and is not judged."),
            [], [table("dt-ladder-shown.csv", rungs, "Multiples of the stated limit")], data=["dt-ladder.csv"]))  # fmt: skip
    return made
