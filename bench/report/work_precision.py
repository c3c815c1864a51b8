"""Speed against error: what bench/accuracy.py, creep.py and schemes.py have run (`make report` calls them first)."""
import csv

from draw import COLOURS, STYLES, curves, legend, save
from page import Picture, Section, Table

TITLE = "Speed against error"
WARNED = 0.005  # DRIFT_ZHAO of server/run_frames.c


def cases(size):
    return []  # the studies keep their own points


def rows_of(shelf, name):
    path = shelf.folder.parent / name
    return list(csv.DictReader(path.open())) if path.exists() else []


def table(file, rows, caption, columns=None):
    columns = columns or list(rows[0])
    return Table(file, columns, [[r.get(c, "") for c in columns] for r in rows], caption, shown=400)


def diagrams(rows, problem):
    """log error against processor seconds, a curve a basis and scheme; one panel a measure."""

    def draw(path):
        mine = [r for r in rows if r["problem"] == problem and r["error"] and r["cfl"] == "0.3" and r["blend"] == "1.0"]
        default = {r["ppc"] for r in mine if r["basis"] == "gimp"}  # the others are of the factor ppc
        mine = [r for r in mine if r["ppc"] in default]
        measures = sorted({r["measure"] for r in mine})
        if not measures:
            return
        figure, axes = curves(columns=len(measures))
        for axis, measure in zip(axes, measures):
            for basis, scheme in sorted({(r["basis"], r["scheme"]) for r in mine}):
                curve = sorted((float(r["cpu_s"]), float(r["error"])) for r in mine
                               if (r["basis"], r["scheme"], r["measure"]) == (basis, scheme, measure))  # fmt: skip
                if curve:
                    axis.loglog(*zip(*curve), color=COLOURS.get(scheme), linestyle=STYLES.get(basis, ":"), marker=".",
                                label=f"{basis}, {scheme}")  # fmt: skip
            axis.set(title=f"{problem}: {measure}", xlabel="processor seconds, one thread", ylabel="relative error")
        legend(axes[-1], ncols=2, fontsize=5)
        save(figure, path)

    return draw


def creep(rows):
    def draw(path):
        figure, axes = curves(columns=2)
        for key in sorted({(r["basis"], r["scheme"], r["cell"], r["cfl"]) for r in rows if r["scheme"] != "standard"}):
            curve = [r for r in rows if (r["basis"], r["scheme"], r["cell"], r["cfl"]) == key]
            style = {"color": COLOURS.get(key[1]), "linestyle": STYLES.get(key[0], ":")}
            axes[0].plot([float(r["time"]) for r in curve], [100 * float(r["error"]) for r in curve], **style,
                         label=f"{key[0]}, {key[1]}, h = {key[2]}, CFL {key[3]}")  # fmt: skip
            axes[1].plot([float(r["drift"]) for r in curve], [100 * float(r["error"]) for r in curve], **style)
        axes[0].set(xlabel="t, s", ylabel="column's displacement against FEM, %")
        axes[1].set(xlabel="drift", xscale="symlog", ylabel="the same, %")
        axes[1].set_xscale("symlog", linthresh=1e-4)
        legend(axes[0], fontsize=4)
        save(figure, path)

    return draw


def drift_of_errors(rows, level=0.05):
    """For every basis, cell and increment: the drift of zhao when its displacement is first `level` beyond that of
    anchored at the same time."""
    found = []
    for key in sorted({(r["basis"], r["cell"], r["cfl"]) for r in rows}):
        of = lambda scheme: [r for r in rows if (r["basis"], r["cell"], r["cfl"], r["scheme"]) == (*key, scheme)]
        for z, a in zip(of("zhao"), of("anchored")):
            if float(z["error"]) - float(a["error"]) > level:
                found.append(float(z["drift"]))
                break
    return found


def creep_verdict(rows):
    found = drift_of_errors(rows)
    if not found:
        return "not shown yet", "no run of zhao has crept by 5 %"
    told = min(found) > WARNED / 2 and max(found) < 2 * WARNED
    return ("holds" if told else "does not hold",
            f"the displacement is 5 % beyond that of anchored at a drift of {min(found):.2g} to {max(found):.2g} (sampled); the "
            f"daemon warns from {WARNED} on")  # fmt: skip


def sections(shelf):
    made = []
    accuracy, best = rows_of(shelf, "accuracy.csv"), rows_of(shelf, "pareto.csv")
    if accuracy and best:
        made.append(Section(
            "work-precision", "Work and precision", "nothing of the kind",
            "Problems with a known answer at several resolutions, with every basis and scheme, and from the default (quadratic "
            "B-splines, anchored, CFL 0.3) one factor at a time; <code>bench/accuracy.py --case NAME</code> runs a point again.",
            "finite elements, exact and manufactured solutions", ("holds", f"{len(accuracy)} errors of {len({r['name'] for r in accuracy})} runs; the table has the settings that nothing beats"),
            [Picture(f"work-{p}.png", f"{p}: error against cost", diagrams(accuracy, p)) for p in sorted({r["problem"] for r in accuracy})],
            [table("pareto-shown.csv", best, "Settings that nothing beats in both error and cost")]))  # fmt: skip
    series = rows_of(shelf, "creep.csv")
    if series:
        made.append(Section(
            "creep", "The creep of Algorithm 1, and what the drift tells", "nothing of the kind",
            "Cook's membrane under its load three times as long as it needs to come to rest, for several time increments.",
            "finite elements (P2/P1)", creep_verdict(series),
            [Picture("creep.png", "Displacement of the loaded column over time, and over the drift", creep(series))],
            [table("creep-shown.csv", rows_of(shelf, "creep-summary.csv"), "Errors and drift")]))  # fmt: skip
    schemes = rows_of(shelf, "schemes.csv")
    if schemes:
        made.append(Section(
            "schemes", "zhao against anchored, and the constants of anchored", "one scheme",
            "Static and dynamic problems with a from 0.02 to 1, C from 0 to 2, and a = clamp(25 mu/K, 0.02, 1).",
            "as the problems' own", ("holds", "measured; the table has where each is better"), [],
            [table("schemes-shown.csv", schemes, "Measures", ["problem", "basis", "scheme", "outcome", "cpu_s", "measures"])]))  # fmt: skip
    return made
