"""Hard cases: what bench/hard.py and ladder.py have run (`make report` calls them first)."""
from collections import Counter

from page import Section
from work_precision import rows_of, table

TITLE = "Hard cases"


def cases(size):
    return []  # the studies keep their own points


def sections(shelf):
    made = []
    rows = rows_of(shelf, "hard-cases.csv")
    if rows:
        count = Counter(r["verdict"] for r in rows)
        made.append(Section(
            "hard-cases", "Verdicts", "nothing of the kind",
            "Each case with every basis and scheme. <i>Passes</i>: every measure within its tolerance. <i>Degrades</i>: it ends, and is off by "
            "what is said. <i>Fails</i>: caught, with kind and time; the last good frame and a checkpoint are kept.",
            "exact values, finite elements, finer grids (bench/hard.py names each)",
            ("does not hold" if count["BUG"] else "holds",
             f"no crash, hang or silent NaN in {len(rows)} runs: {count['passes']} pass, {count['degrades']} degrade, {count['fails']} fail"
             if not count["BUG"] else f"{count['BUG']} bugs"),
            [], [table("hard-cases-shown.csv", rows, "Verdicts", ["case", "variant", "basis", "scheme", "verdict", "detail"])]))  # fmt: skip
    rungs = rows_of(shelf, "dt-ladder.csv")
    if rungs:
        judged = [r for r in rungs if r["basis"] != "linear"]
        bad = [r for r in judged if r["verdict"] != "safe"]
        made.append(Section(
            "dt-ladder", "The stability limit", "a Courant number",
            "A shaken block that moves through the grid, with increments from 0.4 to 5 times the limit that the daemon states; <i>whole</i> and "
            "<i>blown</i> are multiples of it.", "safe, and at most 40 % below the blow-up (1.67 of the limit)",
            ("holds" if not bad else "holds in part", f"{len(judged) - len(bad)} of {len(judged)} are safe and not too careful; the linear basis "
             "has no safe increment and is not judged"),
            [], [table("dt-ladder-shown.csv", rungs, "Multiples of the stated limit")]))  # fmt: skip
    return made
