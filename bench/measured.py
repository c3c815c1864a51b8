"""Numbers of the studies (accuracy.py, creep.py, schemes.py, tearing.py, hard.py), worked out of their CSV files: what
the report draws and tells, and what docs say (advice.py). Reads nothing else, draws nothing."""
import csv
import math

import accuracy

WARNED = 0.0045  # DRIFT_ZHAO of server/run_frames.c
BASES = {"linear": "linear", "gimp": "uGIMP", "bspline2": "quadratic", "bspline3": "cubic"}
SCHEMES = ("standard", "zhao", "anchored")
FACTORS = {"cfl": "CFL {}", "ppc": "{} per cell", "blend": "blend {}"}
CREPT = 0.05  # of the displacement: what counts as creep
ANCHORED = "a = 0.05, C = 1"  # its defaults, as schemes.csv names them


def read(path):
    """Rows of a CSV file, as dictionaries of texts; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def mean(values):
    """Geometric mean of those that there are."""
    logs = [math.log(x) for x in values if x]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


class Measured:
    """accuracy.csv with numbers, and what each row changes from the default."""

    def __init__(self, rows):
        ppc = {p.name: p.ppc for p in accuracy.PROBLEMS}
        self.rows = []
        for r in rows:
            row = {**r, "cell": float(r["cell"]), "error": number(r["error"]), "cpu_s": number(r["cpu_s"]),
                   "particle_steps": number(r["particle_steps"])}  # fmt: skip
            default = {**accuracy.DEFAULT, "ppc": ppc[r["problem"]]}
            row["changed"] = [f for f in FACTORS if default[f] != float(r[f])]
            self.rows.append(row)

    def measures(self):
        return list(dict.fromkeys((r["problem"], r["measure"]) for r in self.rows))

    def of(self, problem, measure, **wanted):
        """Rows of one curve, coarse to fine."""
        found = [r for r in self.rows if (r["problem"], r["measure"]) == (problem, measure)
                 and all(r[k] == v for k, v in wanted.items())]  # fmt: skip
        return sorted(found, key=lambda r: -r["cell"])


def number(text):
    return float(text) if text not in ("", None) else math.nan


def method(row):
    """A short name: basis and scheme, and the factor that is changed."""
    changed = ", ".join(FACTORS[f].format(row[f]) for f in row["changed"])
    return f"{BASES[row['basis']]} {row['scheme']}" + (f", {changed}" if changed else "")

def ratio(data, problem, measure, chosen, value="error"):
    """Geometric mean over the resolutions of `value` over the default's, where both are there; None where not half are."""
    default = {r["cell"]: r for r in data.of(problem, measure, basis="bspline2", scheme="anchored") if not r["changed"]}
    found = [r[value] / default[r["cell"]][value] for r in data.of(problem, measure) if chosen(r)
             and default[r["cell"]][value] > 0 and r[value] > 0]  # fmt: skip
    return mean(found) if 2 * len(found) >= len(default) > 0 else None


def shown(value):
    return "–" if value is None else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def typical(data, measures, basis, scheme, of="error"):
    """Over these measures: `of` with another basis or scheme, over the default's."""
    return mean(ratio(data, *k, lambda r: (r["basis"], r["scheme"], r["changed"]) == (basis, scheme, []), of) for k in measures)


def factor(data, measures, name, value, of="error"):
    """The same with one factor changed."""
    return mean(ratio(data, *k, lambda r: (r["basis"], r["scheme"], r["changed"]) == ("bspline2", "anchored", [name])
                      and float(r[name]) == value, of) for k in measures)  # fmt: skip


def pressures(data):
    return [k for k in data.measures() if k[1] == "pressure"]


def locking(data):
    """Measures of pressure of nearly incompressible matter."""
    return [k for k in pressures(data) if k[0] != "vortex"]


def motions(data):
    return [k for k in data.measures() if not k[1].startswith("pressure") and k[0] != "dam-measured"]


def compare_smooth(data, problem, scheme):
    """The error of the smooth mean stress over that of the mean stress, quadratic B-splines."""
    raw = {r["cell"]: r["error"] for r in data.of(problem, "pressure", basis="bspline2", scheme=scheme) if not r["changed"]}
    found = [r["error"] / raw[r["cell"]] for r in data.of(problem, "pressure, smooth", basis="bspline2", scheme=scheme)
             if not r["changed"] and raw.get(r["cell"])]  # fmt: skip
    return mean(found) if found else None


def drift_of_errors(rows, level=CREPT):
    """For every basis, cell and increment: the drift of zhao when its displacement is first `level` beyond that of
    anchored at the same time."""
    found = []
    for key in sorted({(r["basis"], r["cell"], r["cfl"]) for r in rows}):
        of = lambda scheme: [r for r in rows if (r["basis"], r["cell"], r["cfl"], r["scheme"]) == (*key, scheme)]
        before = 0, 0
        for z, a in zip(of("zhao"), of("anchored")):
            beyond, drift = float(z["error"]) - float(a["error"]), float(z["drift"])
            if beyond > level:  # in between: on the line through both samples
                found.append(before[1] + (level - before[0]) / (beyond - before[0]) * (drift - before[1]))
                break
            before = beyond, drift
    return found


def values(measures):
    """`name number; name number` as a dictionary."""
    return {m.rsplit(" ", 1)[0]: m.rsplit(" ", 1)[1] for m in measures.split("; ") if " " in m}


def of_schemes(rows):
    """(problem, basis, scheme, measure) -> number in schemes.csv, nan where there is none; a scheme that ends with a
    comma is the first that begins so."""

    def of(problem, basis, scheme, name):
        for r in rows:
            if (r["problem"], r["basis"]) == (problem, basis) and (r["scheme"] == scheme or scheme.endswith(",") and r["scheme"].startswith(scheme)):
                return float(values(r["measures"]).get(name, "nan"))
        return math.nan

    return of


def keeping(k):
    return f"{ANCHORED}, keep = {k:g}"
