"""Speed against error: what bench/accuracy.py, creep.py and schemes.py have run (`make report` calls them first)."""
import math
from collections import Counter, defaultdict

import accuracy
from draw import COLOURS, STYLES, legend, numbered, plt, save
from measured import (ANCHORED, BASES, FACTORS, SCHEMES, WARNED, Measured, compare_smooth, drift_of_errors, factor, keeping, locking, mean, method, motions, of_schemes,
                      pressures, ratio, read, shown, typical, values)  # fmt: skip
from page import Picture, Section, Table

TITLE = "Speed against error"
GOALS = (0.2, 0.1, 0.05, 0.02)
CHANGED = ["#222222", "#e67e22", "#f1c40f", "#8e44ad", "#c39bd3", "#2980b9", "#16a085", "#7f8c8d", "#c0392b"]  # curves of one factor at a time
LINES = {**STYLES, "linear": "-."}


def cases(size):
    return []  # the studies keep their own points


def rows_of(shelf, name):
    return read(shelf.folder.parent / name)


def table(file, rows, caption, columns=None, **options):
    columns = columns or list(rows[0])
    return Table(file, columns, [[r.get(c, "") for c in columns] for r in rows], caption, shown=400, **options)


def diagrams(data, problem):
    """log error against cost: basis and scheme over seconds and over particle-steps, and one factor at a time."""

    def draw(path):
        measures = [m for p, m in data.measures() if p == problem]
        if not measures:
            return
        figure, axes = plt.subplots(3, len(measures), figsize=(1.5 + 2.5 * max(2, len(measures)), 7), layout="constrained",
                                    squeeze=False, sharex="row")  # fmt: skip
        for column, measure in enumerate(measures):
            for line, (cost, unit) in enumerate((("cpu_s", "processor s"), ("particle_steps", "particle-steps"), ("cpu_s", "processor s"))):
                axis = axes[line][column]
                axis.grid(True, color="#e5e5e5", linewidth=0.6)
                curves = defaultdict(list)
                for r in data.of(problem, measure):
                    if (line < 2 and not r["changed"]) or (line == 2 and (r["basis"], r["scheme"]) == ("bspline2", "anchored")):
                        curves[method(r)].append(r)
                for k, (name, rows) in enumerate(curves.items()):
                    if not any(r["error"] > 0 for r in rows):
                        continue  # all of them failed
                    style = ({"color": COLOURS[rows[0]["scheme"]], "linestyle": LINES[rows[0]["basis"]]} if line < 2
                             else {"color": CHANGED[k]} if rows[0]["changed"] else {"color": "#222222", "linewidth": 2})  # fmt: skip
                    axis.loglog([r[cost] for r in rows], [r["error"] for r in rows], marker=".", markersize=3,
                                label=name.removeprefix("quadratic anchored, ") if line == 2 else name, **{"linewidth": 0.9, **style})  # fmt: skip
                axis.set_xlabel(f"cost ({unit})")
                if line == 0:
                    axis.set_title(measure)
                if column == 0:
                    axis.set_ylabel("relative error (1)" if line < 2 else "relative error (1),\none factor at a time")
        for axis in axes.flat:
            numbered(axis.xaxis), numbered(axis.yaxis)
            axis.tick_params(labelsize=6.5)
        for line in (0, 2):
            legend(axes[line][-1], fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
        save(figure, path)

    return draw


def comparison(data, file, caption, choices):
    """A row a measure, a column a choice: how its error compares with the default's at the same cells; and the cost."""
    rows = [[f"{p}: {m}", *(shown(ratio(data, p, m, c)) for c in choices.values())] for p, m in data.measures()]
    cost = []
    for c in choices.values():
        all_costs = [ratio(data, p, m, c, "cpu_s") for p, m in {p: (p, m) for p, m in data.measures()}.values()]
        cost.append(shown(mean(all_costs) if any(all_costs) else None))
    return Table(file, ["error over the default's", *choices], [*rows, ["processor seconds over the default's", *cost]], caption,
                 shown=100, docs=True)  # fmt: skip


def by_basis(data):
    def is_one(basis, scheme):
        return lambda r: (r["basis"], r["scheme"]) == (basis, scheme) and not r["changed"]

    return comparison(data, "work-bases.csv", "Bases and schemes: error over that of the default (quadratic B-splines, anchored, "
                      "CFL 0.3, FLIP) at the same cells, geometric mean of the resolutions; below 1 is better",
                      {f"{BASES[b]} {s}": is_one(b, s) for b in BASES for s in SCHEMES if (b, s) != ("bspline2", "anchored")})  # fmt: skip


def by_factor(data):
    def is_one(factor, value):
        return lambda r: (r["basis"], r["scheme"]) == ("bspline2", "anchored") and r["changed"] == [factor] and float(r[factor]) == value

    return comparison(data, "work-factors.csv", "One factor at a time from the default: the same",
                      {FACTORS[f].format(v): is_one(f, v) for f, values in accuracy.FACTORS.items() for v in values})  # fmt: skip


def cheapest(data):
    """For each measure and goal the cheapest run that reaches it."""
    lines = []
    for problem, measure in data.measures():
        line = [f"{problem}: {measure}"]
        for goal in GOALS:
            there = [r for r in data.of(problem, measure) if r["error"] <= goal]
            best = min(there, key=lambda r: r["cpu_s"], default=None)
            mine = min((r["cpu_s"] for r in there if (r["basis"], r["scheme"]) == ("bspline2", "anchored") and not r["changed"]), default=None)
            line.append("–" if best is None else f"{method(best)}, h = {best['cell']:.3g}, {best['cpu_s']:.2g} s"
                        + ("" if mine is None else " (default: the same)" if mine == best["cpu_s"] else f" (default: {mine:.2g} s)"))  # fmt: skip
        lines.append(line)
    return Table("work-goals.csv", ["measure", *(f"within {100 * g:g} %" for g in GOALS)], lines,
                 "The cheapest of all runs that reaches a goal, and what the default takes for it (processor seconds of one thread; – not reached "
                 "at these cells). Chance plays a part where an error changes its sign under refinement: displacements, load, front", shown=100, docs=True)  # fmt: skip


def advice(data):
    """What the numbers say, as sentences; each is worked out from the data."""
    def smooth(scheme):
        found = [(p, compare_smooth(data, p, scheme)) for p, m in data.measures() if m == "pressure, smooth"]
        return ", ".join(f"{p} {x:.2f}" for p, x in found if x)

    uniform = ratio(data, "cylinder", "pressure", lambda r: (r["basis"], r["scheme"], r["changed"]) == ("bspline2", "zhao", []))
    return [
        f"<b>F̄ on</b> for pressure in nearly incompressible matter: without it the pressure error is {typical(data, locking(data), 'gimp', 'standard'):.0f} "
        f"(uGIMP), {typical(data, locking(data), 'bspline2', 'standard'):.1f} (quadratic), {typical(data, locking(data), 'bspline3', 'standard'):.1f} "
        "(cubic) times that of the default.",
        f"<b>anchored</b>: zhao's pressure error is {typical(data, locking(data), 'bspline2', 'zhao'):.2f} and its error of motion "
        f"{typical(data, motions(data), 'bspline2', 'zhao'):.2f} times that of anchored (quadratic), at the end times of these problems, and grows with time (creep, "
        f"below); a uniform pressure (cylinder) is zhao's: {uniform or math.nan:.2f} times.",
        f"<b>Quadratic B-splines</b>: uGIMP has {typical(data, motions(data), 'gimp', 'anchored'):.2f} times the error of motion and {typical(data, locking(data), 'gimp', 'anchored'):.2f} "
        f"times that of pressure for the same cost, cubic ones {typical(data, motions(data), 'bspline3', 'anchored'):.2f} and {typical(data, locking(data), 'bspline3', 'anchored'):.2f} times.",
        f"<b>CFL 0.5</b> instead of 0.3 makes errors {factor(data, motions(data), 'cfl', 0.5):.2f} (motion) and {factor(data, pressures(data), 'cfl', 0.5):.2f} (pressure) times as large for "
        f"{factor(data, pressures(data), 'cfl', 0.5, 'cpu_s'):.2f} of the cost; B-splines bear it (method.md, section 7), uGIMP only in 2D with up to 4 particles a cell, so 0.3 "
        "stays what a scene gets that says nothing.",
        f"<b>FLIP</b>: a blend of 0.99 makes the error of motion {factor(data, motions(data), 'blend', 0.99):.2f} times as large, PIC {factor(data, motions(data), 'blend', 0):.1f} times.",
        "<b>mean_stress_smooth</b> for looking at pressure. Its error over that of mean_stress, quadratic: anchored " + smooth("anchored") + "; without F̄ " + smooth("standard")
        + ". It helps where noise rules, and not where the field changes within two cells (vortex) or where the last digit at a wall counts (column).",
    ]


def default_stands(data):
    """Whether the data still justify fbard's defaults and advice: no other basis, scheme or blend has notably less error of
    pressure or motion on the whole (5 %, a geometric mean over seven problems), and a larger increment costs none."""
    others = [("gimp", "anchored"), ("bspline3", "anchored"), *((b, s) for b in ("gimp", "bspline2", "bspline3") for s in ("standard", "zhao"))]
    return (all(typical(data, k(data), b, s) > 0.95 for b, s in others for k in (locking, motions)) and all(factor(data, motions(data), "blend", v) > 0.95 for v in (0.99, 0.9, 0))
            and all(factor(data, k(data), "cfl", 0.5) < 1.05 for k in (motions, pressures)))  # fmt: skip


def creep(rows):
    def draw(path):
        figure, axes = plt.subplots(1, 2, figsize=(7.6, 3.6), layout="constrained")
        for axis in axes:
            axis.grid(True, color="#e5e5e5", linewidth=0.6)
        for key in sorted({(r["basis"], r["scheme"], r["cell"], r["cfl"]) for r in rows if r["scheme"] != "standard"}):
            curve = [r for r in rows if (r["basis"], r["scheme"], r["cell"], r["cfl"]) == key]
            style = {"color": COLOURS.get(key[1]), "linestyle": STYLES.get(key[0], ":"),
                     "linewidth": {"0.5": 0.6, "0.3": 1.2, "0.15": 2.0}.get(key[3], 1), "alpha": 1 if key[2] == "4" else 0.5}  # fmt: skip
            axes[0].plot([float(r["time"]) for r in curve], [100 * float(r["error"]) for r in curve], **style)
            axes[1].plot([max(float(r["drift"]), 1e-5) for r in curve], [100 * float(r["error"]) for r in curve], **style)
        axes[1].axvline(WARNED, color="#222222", linewidth=0.8, linestyle="--")
        axes[1].text(WARNED, axes[1].get_ylim()[1], " warning", fontsize=6, va="top")
        axes[0].set(xlabel="t (s)", ylabel="loaded column against FEM (%)")
        axes[1].set(xlabel=r"drift, max $|\ln(J/\bar{J})|$", xscale="log", ylabel="loaded column against FEM (%)")
        handles = [plt.Line2D([], [], color=COLOURS[s], label=s) for s in ("zhao", "anchored")]
        handles += [plt.Line2D([], [], color="#777777", linestyle=STYLES[b], label=BASES[b]) for b in ("gimp", "bspline2", "bspline3")]
        handles += [plt.Line2D([], [], color="#777777", linewidth=w, label=f"CFL {c}") for c, w in (("0.5", 0.6), ("0.3", 1.2), ("0.15", 2.0))]
        handles += [plt.Line2D([], [], color="#777777", alpha=0.5, label="pale: h = 2 m, else 4 m")]
        axes[0].legend(handles=handles, fontsize=5.5)
        save(figure, path)

    return draw


def creep_verdict(rows):
    found = drift_of_errors(rows)
    if not found:
        return "not shown yet", "no run of zhao has crept by 5 %"
    told = WARNED <= round(min(found), 4) and WARNED > 0.8 * min(found)  # not late, and not long before any error
    return ("holds" if told else "holds in part",
            f"The displacement of zhao is 5 % beyond that of anchored at a drift of {min(found):.2g} to {max(found):.2g} (of {len(found)} grids and increments); "
            f"the daemon warns from {WARNED} on. The smaller the increment, the faster the creep; the drift of anchored stays "
            f"below {max(float(r['drift']) for r in rows if r['scheme'] == 'anchored'):.2g}.")  # fmt: skip


BETWEEN = ("a = 0.1, C = 1", "a = 0.2, C = 1", "a = 1, C = 0")  # in schemes.csv only: nothing happens there


def scheme_tables(rows):
    """A table a problem: a row a scheme and constants, in each cell the measures with uGIMP, quadratic, cubic."""
    made = []
    for problem in dict.fromkeys(r["problem"] for r in rows):
        mine = [r for r in rows if r["problem"] == problem]
        names = list(dict.fromkeys(n for r in mine for n in values(r["measures"])))
        bases = list(dict.fromkeys(r["basis"] for r in mine))
        lines = []
        for scheme in dict.fromkeys(r["scheme"] for r in mine):
            if scheme in BETWEEN or scheme.startswith("formula: a = 0.05"):
                continue
            found = {r["basis"]: values(r["measures"]) for r in mine if r["scheme"] == scheme}
            lines.append([scheme, *(" / ".join(found.get(b, {}).get(n, "fails") for b in bases) for n in names)])
        made.append(Table(None, [problem, *(f"{n}: {' / '.join(BASES[b] for b in bases)}" for n in names)], lines, "", shown=100, docs=True))
    return made


def schemes_verdict(rows):
    of = of_schemes(rows)
    cook, top = "Cook, h = 2 m", "resting column, 2e4 steps"
    change = max(abs(of(cook, b, "a = 0.02,", "column at 120 s") - of(cook, b, "a = 0.1,", "column at 120 s")) for b in ("gimp", "bspline2", "bspline3"))
    ended = {(r["problem"], r["basis"], r["scheme"]): float(r["cpu_s"]) for r in rows if r["outcome"] == "completed"}
    both = [(p, b) for p, b, s in ended if s == "zhao" and (p, b, "a = 0.05, C = 1") in ended]
    cost = [sum(ended[p, b, s] for p, b in both) for s in ("zhao", "a = 0.05, C = 1")]
    bases = ("gimp", "bspline2", "bspline3")
    rests = max(abs(of("resting column, 2e4 steps", "bspline2", keeping(k), "top, m")) for k in (0.05, 0.1))
    still = max(abs(of(cook, b, ANCHORED, "column at 120 s") - of(cook, b, ANCHORED, "column at 40 s")) for b in bases)
    moves = min(abs(of(cook, b, "zhao", "column at 120 s") - of(cook, b, "zhao", "column at 40 s")) for b in bases)
    return ("holds" if still < 0.05 < moves else "holds in part", f"anchored does not creep, keeps the energy of the disk collision ({of('disk collision', 'bspline2', 'a = 0.05, C = 1', 'energy left'):.2f} against "
            f"{of('disk collision', 'bspline2', 'zhao', 'energy left'):.2f} of zhao, quadratic) and rests with uGIMP (with B-splines see keep); zhao's pressure is the smoother one in the cylinder. "
            f"Cost: {cost[1] / cost[0]:.2f} times zhao's processor time over what both complete. From a = 0.02 to 0.1 Cook's column moves by at most {100 * change:.1f} % of FEM; C hardly "
            "matters. <b>The formula a = clamp(25 mu/K, 0.02, 1) is not taken</b>: at nu = 0.499 it gives the default of 0.05, and for water 0.02, with which the resting column of "
            f"quadratic splines sinks by {-1000 * of(top, 'bspline2', 'a = 0.02,', 'top, m'):.0f} mm in 2e4 steps (a = 0.05: {-1000 * of(top, 'bspline2', 'a = 0.05, C = 1', 'top, m'):.0f} mm, "
            f"a = 0.5: {-1000 * of(top, 'bspline2', 'a = 0.5,', 'top, m'):.1f} mm), while no front, energy or pressure here is notably better for it. <b>keep</b> = 0.05 to "
            f"0.1 (method.md, section 4) holds what tears and sinks without it: the dead load at {of('dead load', 'bspline2', 'a = 0.05, C = 1, keep = 0.05', 'displacement, m'):.4f} and "
            f"{of('dead load', 'bspline2', 'a = 0.05, C = 1, keep = 0.1', 'displacement, m'):.4f} m (exact 0.75) and the resting column within {1000 * rests:.1f} mm, quadratic; Cook's pressure error at h = 2 m goes "
            f"from {of(cook, 'bspline2', 'a = 0.05, C = 1', 'pressure RMS'):.3f} to {of(cook, 'bspline2', 'a = 0.05, C = 1, keep = 0.05', 'pressure RMS'):.3f} and "
            f"{of(cook, 'bspline2', 'a = 0.05, C = 1, keep = 0.1', 'pressure RMS'):.3f}. " + kept_verdict(of))  # fmt: skip


def kept_verdict(of):
    """keep in flows, and in the balance of energy, whose error should not grow with it."""
    names = {0: ANCHORED, 0.02: keeping(0.02), 0.1: keeping(0.1)}
    slope, dam, column, vortex = "landslide slice, h = 0.25 m", "dam break, K = 2e7", "oscillating column", "vortex, a whole swing"

    def both(problem, measure, form, factor=1, made=tuple(names.values())):
        return "; ".join(f"{BASES[b]} {', '.join(format(factor * of(problem, b, n, measure), form) for n in made)}" for b in ("gimp", "bspline2"))

    if math.isnan(of(slope, "bspline2", ANCHORED, "drift")):
        return ""
    gained = [of(p, b, n, "energy gained") for p in (column, vortex) for b in ("gimp", "bspline2", "bspline3") for n in names.values()]
    without = [of(p, b, "standard", "energy gained") for p in (column, vortex) for b in ("gimp", "bspline2", "bspline3")]
    more = ANCHORED, keeping(0.05), keeping(0.1)
    return (f"<b>In plastic flow keep brings locking back</b>, since little but K resists there: for 0, 0.02 and 0.1 the landslide slice runs out by {both(slope, 'at 5.5 s, m', '.1f')} m (zhao "
            f"{of(slope, 'gimp', 'zhao', 'at 5.5 s, m'):.1f} and {of(slope, 'bspline2', 'zhao', 'at 5.5 s, m'):.1f}), with a largest pressure at 2.5 s of {both(slope, 'largest pressure at 2.5 s, kPa', '.0f')} kPa and a drift of "
            f"{both(slope, 'drift', '.2g')}. The dam break hardly feels it: for 0, 0.05 and 0.1 the front is at {both(dam, 'front at 0.336 s, m', '.3f', made=more)} m at 0.336 s, the largest pressure at the end "
            f"{both(dam, 'largest pressure at the end, Pa', '.0f', 0.001, more)} kPa, the drift {both(dam, 'drift', '.2f', made=more)}. <b>The balance of energy is {'no worse' if max(gained) <= max(without) else 'worse'} "
            f"for it</b>: nothing gains more than {max(gained):.2g} of the largest kinetic energy (without F̄ {max(without):.2g}). Lost by the end, for 0, 0.02 and 0.1: undamped water that oscillates eleven times in a "
            f"column of eight cells {both(column, 'energy lost', '.2f')} (without F̄ {of(column, 'gimp', 'standard', 'energy lost'):.2f} and {of(column, 'bspline2', 'standard', 'energy lost'):.2f}; 1 is all of the oscillation, "
            f"more means that it sank); the vortex at nu = 0.499 over a whole swing {both(vortex, 'energy lost', '.2f', 100)} % (without F̄ {100 * of(vortex, 'gimp', 'standard', 'energy lost'):.2f} and "
            f"{100 * of(vortex, 'bspline2', 'standard', 'energy lost'):.2f} %).")  # fmt: skip


def sections(shelf):
    made = []
    rows, best = rows_of(shelf, "accuracy.csv"), rows_of(shelf, "pareto.csv")
    if rows and best:
        data = Measured(rows)
        ended = Counter(r["outcome"] for r in {r["name"]: r for r in rows}.values())
        made.append(Section(
            "work-precision", "Work and precision", "nothing of the kind.",
            "Problems with a known answer at four resolutions and more, with every basis and scheme, and from the default (quadratic B-splines, anchored, CFL 0.3, "
            "FLIP) one factor at a time. The cost is processor seconds of one thread inside the step loop, and particle-steps. <code>fbar bench accuracy --case "
            "NAME</code> runs one point again (<code>--list</code> names them).",
            "finite elements (cook), exact and manufactured solutions (cylinder, taylor-green, vortex at nu = 0.3 and 0.499, column, footing), the front of the "
            "finest run (dam: h = 1/32 m), measured fronts (dam-measured: computed fronts lead them by some 12 %, which refinement shows and does not mend).",
            ("holds" if default_stands(data) else "holds in part", "<ul>" + "".join(f"<li>{t}</li>" for t in advice(data)) + f"</ul> ({len(rows)} errors of {sum(ended.values())} runs: "
             + ", ".join(f"{n} {o}" for o, n in ended.items()) + ".)"),
            [Picture(f"work-{p.name}.png", f"{p.name}: error against cost. Above: each basis and scheme; below: one factor at a time from the default.",
                     diagrams(data, p.name)) for p in accuracy.PROBLEMS if any(r["problem"] == p.name for r in data.rows)],
            [by_basis(data), by_factor(data), cheapest(data),
             table("pareto-shown.csv", best, "Settings that nothing beats in both error and cost")],
            data=["accuracy.csv", "pareto.csv"]))  # fmt: skip
    series = rows_of(shelf, "creep.csv")
    if series:
        made.append(Section(
            "creep", "The creep of Algorithm 1, and what the drift tells", "nothing of the kind.",
            "Cook's membrane under its load three times as long as it needs to come to rest, for several time increments (<code>bench/creep.py</code>).",
            "finite elements (P2/P1).", creep_verdict(series),
            [Picture("creep.png", "Displacement of the loaded column over time, and over the drift", creep(series))],
            [table("creep-shown.csv", rows_of(shelf, "creep-summary.csv"), "Errors and drift", docs=True)], data=["creep.csv"]))  # fmt: skip
    schemes = rows_of(shelf, "schemes.csv")
    if schemes:
        made.append(Section(
            "schemes", "zhao against anchored, and the constants of anchored", "one scheme.",
            "Static and dynamic problems with a from 0.02 to 1, C from 0 to 2, and a = clamp(25 mu/K, 0.02, 1), and keep in long flows and in the balance of energy "
            "(<code>bench/schemes.py</code>). Energy lost (by the end) and gained (at most) is that of kinetic and strain energy less the work of gravity and body forces, over the largest kinetic "
            "energy; exactly 0.", "as the problems' own: errors are relative, the column's top should not move, the disks should part with all of their energy.",
            schemes_verdict(schemes), [], scheme_tables(schemes) +
            [table("schemes-shown.csv", schemes, "Measures", ["problem", "basis", "scheme", "outcome", "cpu_s", "measures"])], data=["schemes.csv"]))  # fmt: skip
    return made
