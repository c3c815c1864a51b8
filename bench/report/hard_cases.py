"""Hard cases: what bench/hard.py and ladder.py have run (`make report` calls them first)."""
from collections import Counter

import hard
from page import Section, Table
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


def reasons(rows):
    there = {r["case"] for r in rows if r["verdict"] != "passes"}
    return Table(None, ["case", "what is behind the verdicts that are no pass"],
                 [[c.name + (f", {next(iter(c.vary))}" if len(c.vary) == 1 and next(iter(c.vary)) else ""), c.why]
                  for c in hard.CASES if c.name in there and c.why], "Why", shown=100, docs=True)  # fmt: skip


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
            [], [verdicts(rows), reasons(rows),
                 table("hard-cases-shown.csv", rows, "Verdicts, one by one", ["case", "variant", "basis", "scheme", "verdict", "detail"])],
            data=["hard-cases.csv"]))  # fmt: skip
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
