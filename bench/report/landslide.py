"""Landslide: figures 14 to 16 of the paper."""
import numpy as np

from cases import BASES, grid
from draw import COLOURS, SCHEME, SHORT, curves, fields, label, legend, norms, save, style
from page import Picture, Section, Table, number

TITLE = "Landslide"


def cases(size):
    if size == "tiny":
        coarse = {"cell": 1, "time": {"dt": 1e-3}, "output": {"interval": 0.5},
                  "materials": {"clay": {"poisson_ratio": 0.45}}}  # slower waves: a third of the steps
        return grid("slice", "landslide-slice", coarse, 25, ("gimp",), ("standard", "zhao"), slice=True)
    # A coarse one of seconds stands in until the slice itself is there.
    coarse = {"cell": 0.4, "domain": {"min": [-1.2, -1.2], "max": [44.8, 8]}, "time": {"dt": 1e-4}, "references": [],
              "output": {"interval": 0.1}}  # fmt: skip
    made = grid("slice-coarse", "landslide-slice", coarse, 24, coarse=True)
    made += grid("slice", "landslide-slice", {}, 25, slice=True)
    made += grid("slice-held", "landslide-slice", {"mirror_walls": False}, 26, ("bspline2",), ("standard", "zhao"), held=True)
    if size == "paper":
        order = {("gimp", "zhao"): 5, ("bspline2", "zhao"): 50, ("bspline2", "standard"): 60,
                 ("gimp", "standard"): 61, ("gimp", "anchored"): 90, ("bspline2", "anchored"): 91}  # fmt: skip
        made += grid("landslide", "landslide", {}, lambda b, s: order[b, s], whole=True)
    return made


# ---- What the page shows of them ----

TIMES = (1.5, 2.5, 3.5, 5.5)  # s: the paper's
TOE = 15.0  # m
KINDS = [(b, s) for b in ("gimp", "bspline2") for s in SCHEME]
# Run-out of an independent prototype in plane strain, h = 0.2 m (method.md, section 5), m beyond the toe at TIMES.
PROTOTYPE = {("gimp", "zhao"): (1.5, 6.0, 11.8, 21.8), ("bspline2", "zhao"): (1.3, 5.3, 10.6, 21.2),
             ("bspline2", "standard"): (-0.1, 1.5, 6.3, 14.8)}  # fmt: skip


HELD = "slice, nodes held"  # B-splines with walls that are no mirror planes


def by_kind(shelf, **labels):
    return {(r.labels["basis"], r.labels["scheme"]): r for r in shelf.find(partial=True, **labels)}


def slices(shelf):
    """Of each basis and scheme the slice of h = 0.2 m, or the coarse one as long as it has not been run."""
    fine, coarse = by_kind(shelf, slice=True), by_kind(shelf, coarse=True)
    return {k: fine.get(k) or coarse[k] for k in KINDS if k in fine or k in coarse}


def cells_of(shelf):
    """A sentence on the cells of the slices that are shown."""
    cells = sorted({r.scene["cell"] for r in slices(shelf).values()})
    return ("" if cells in ([], [0.2]) else " Slices here have h = " + " and ".join(f"{c:g}" for c in cells)
            + " m: run-out depends on the mesh, and coarse slopes fail later and run less far (method.md).")  # fmt: skip


def word(shelf, good):
    """Coarse slices show no more than a part of what the paper does."""
    coarse = any(r.scene["cell"] != 0.2 for r in slices(shelf).values()) and shelf.size != "tiny"
    return "holds in part" if coarse or not good else "holds"


def spacing(run):
    return run.scene["cell"] / 2


def oblique(x):
    """Positions (n, 3) seen from the front and above: ((n, 2) places in the picture, order in which to draw them)."""
    order = np.lexsort((x[:, 1], x[:, 2]))  # from the far side, z = 0, to the near one; higher ones last
    depth = x[:, 2].max() - x[:, 2]
    return np.column_stack([x[:, 0] + 0.40 * depth, x[:, 1] + 0.34 * depth]), order


def panel(run, time, field, factor):
    x, value = run.frame(time, field)
    if run.dimension == 3:
        x, order = oblique(x)
        return x[order], factor * value[order], 1.15 * spacing(run)
    return x, factor * value, spacing(run)


def snapshots(there, kinds, field, file, caption, limits, unit, high, **options):
    """Kinds down, times across."""
    factor = options.pop("factor", 1)

    def draw(path):
        panels = []
        for kind in kinds:
            run = there.get(kind)
            for time in TIMES:
                title = f"{SCHEME[kind[1]]}, {SHORT[kind[0]]}, {time:g} s".replace("quadratic ", "")
                if run and run.reaches(time):
                    panels.append((title, *panel(run, time, field, factor)))
                else:
                    panels.append((title, "failed" if run and run.failed else "not run"))
        save(fields(panels, limits, unit, (0, 40), (-0.2, high), 2, **options), path)

    return Picture(file, caption, draw)


def pictures(shelf, field, stem, unit, limits, title, **options):
    flat, whole = slices(shelf), by_kind(shelf, whole=True)
    made = []
    for kind in [k for k in KINDS if k in whole]:
        run = whole[kind]
        made.append(snapshots(whole, [kind], field, f"{stem}-3d-{kind[0]}-{kind[1]}.png",
                              f"{title}, 3D, {run.particles:,} particles, seen from the front and above (axes of the near face): {BASES[kind[0]]}, {kind[1]}"
                              + ("" if run.complete else f" (under way, t = {run.times[-1]:.1f} s)") + ".",
                              limits, unit, 7.0, **options))  # fmt: skip
    for basis in ("gimp", "bspline2"):
        made.append(snapshots(flat, [(basis, s) for s in SCHEME], field, f"{stem}-{basis}.png",
                              f"{title}, plane strain, {BASES[basis]}.", limits, unit, 5.3, **options))  # fmt: skip
    held = by_kind(shelf, held=True)
    if held:
        made.append(snapshots(held, list(held), field, f"{stem}-bspline2-held.png",
                              f"{title}, plane strain, {BASES['bspline2']}, walls that hold nodes.", limits, unit, 5.3, **options))  # fmt: skip
    return made


def moved(run, time):
    """(where the scarp is: the least X of what was near the surface and has moved by half a metre, m;
    share of the mass that has; of the mass strained by 0.1 or more, the share that is strained by 1 or more)."""
    X = run.frame(run.times[0])[0]
    x, strain = run.frame(time, "plastic_strain")
    far = np.linalg.norm(x - X, axis=1) > 0.5
    top = far & (X[:, 1] > 4.5)
    yielded = strain >= 0.1
    return (float(X[top, 0].min()) if top.any() else np.nan, float(far.mean()),
            float((strain >= 1).sum() / yielded.sum()) if yielded.any() else np.nan)  # fmt: skip


def runs_of(shelf):
    return ([(r, "3D" if r.dimension == 3 else "slice") for r in [*shelf.find(partial=True, whole=True), *slices(shelf).values()]]
            + [(r, HELD) for r in by_kind(shelf, held=True).values()])  # fmt: skip


def figure_14(shelf):
    rows, scarps = [], {}
    for r, what in runs_of(shelf):
        for t in TIMES:
            if r.reaches(t):
                x, share, narrow = moved(r, t)
                rows.append([what, SHORT[r.labels["basis"]], r.labels["scheme"], t, x, share, narrow, r.at(t, "strain"), r.scene["cell"]])
        if what == "slice":
            times = [t for t in r.times if t >= 0][::2]
            scarps[label(r.labels)] = (r, times, [moved(r, t)[0] for t in times])

    def draw_scarp(path):
        if not scarps:
            return
        figure, (axis,) = curves((5.2, 3.0))
        for title, (r, t, x) in scarps.items():
            if np.isfinite(np.array(x, dtype=float)).any():  # else nothing has moved
                axis.plot(t, x, **style(r.labels), label=title)
        axis.set_xlabel("t (s)"), axis.set_ylabel("scarp, X (m)"), axis.set_ylim(0, 11), axis.legend()
        save(figure, path)

    found = {(r[0], r[1], r[2], r[3]): r for r in rows}
    g, b = SHORT["gimp"], SHORT["bspline2"]
    keys = [(x, s) for x in (g, b) for s in ("standard", "zhao")]
    if any(("slice", *k, 5.5) not in found for k in keys):
        verdict = ("not shown yet", "Slices are missing.")
    else:
        at = {k: found["slice", *k, 5.5] for k in keys}
        back = {x: found["slice", x, "zhao", 2.5][4] - at[x, "zhao"][4] for x in (g, b)}
        still = at[g, "standard"][5] < 0.01
        diffuse = at[b, "standard"][5] > 0.01
        held = found.get((HELD, b, "standard", 5.5))
        good = still and diffuse and all(v > 1 for v in back.values())
        verdict = (word(shelf, good),
                   f"Standard uGIMP: {100 * at[g, 'standard'][5]:.1f} % of the mass has moved by half a metre at 5.5 s "
                   f"({'the slope does not fail' if still else 'the slope fails'}). With F\u0304 (zhao) it is {100 * at[g, 'zhao'][5]:.0f} % and "
                   f"{100 * at[b, 'zhao'][5]:.0f} % (uGIMP, B-spline), and the scarp goes back by {number(back[g])} and {number(back[b])} m between 2.5 and 5.5 s: "
                   f"retrogressive. Standard B-spline: {100 * at[b, 'standard'][5]:.0f} % has moved; of what yielded, {100 * number_or(at[b, 'standard'][6]):.0f} % is strained "
                   f"by more than 1, with F\u0304 {100 * number_or(at[b, 'zhao'][6]):.0f} %."
                   + ("" if diffuse else " <b>It stands here, unlike the paper's</b>: our walls are mirror planes, on which the base is at rest.")
                   + (f" With walls that hold nodes instead (\"mirror_walls\": false), past which the base slips at an eighth of the velocity one cell "
                      f"above, {100 * held[5]:.0f} % moves, and {100 * number_or(held[6]):.0f} % of what yielded is strained by more than 1: "
                      "the paper's diffuse failure." if held else ""))  # fmt: skip
        whole = {k for k in KINDS if ("3D", SHORT[k[0]], k[1], 5.5) in found}
        verdict = (verdict[0], verdict[1] + (f" In 3D to 5.5 s: {', '.join(f'{SHORT[k[0]]} {k[1]}' for k in KINDS if k in whole)}." if whole
                                             else " The 3D runs are for SIZE=paper." if shelf.size != "paper" else " No 3D run has reached 5.5 s yet.")
                   + cells_of(shelf))  # fmt: skip
    return Section(
        "figure-14", "Figure 14: equivalent plastic strain of the landslide",
        "Standard uGIMP: the slope does not fail. Standard B-splines: diffuse plastic strain. With F\u0304 retrogressive failure, "
        "alike with both bases.",
        "Plane-strain slices with every basis and scheme, and the 3D slope as far as it was run: 311,250 particles, h = 0.2 m, dt = 5e-5 s, "
        "gravity for 0.8 s, then the peak strength divided by 1.65. The scarp is the rearmost particle near the crest that has moved by half a metre.",
        "No reference solution exists (the paper says so); both bases beside each other, and the slice beside 3D.",
        verdict,
        pictures(shelf, "plastic_strain", "figure-14", "equivalent plastic strain (1)", None, "Equivalent plastic strain",
                 cmap="turbo", extend="both", norm=norms.LogNorm(0.05, 10))
        + [Picture("figure-14-scarp.png", "Retrogression: how far back the failure reaches (the crest is at X = 10 m), slices.", draw_scarp)],
        [Table("figure-14.csv", ["run", "basis", "scheme", "t (s)", "scarp X (m)", "mass moved (1)", "strained > 1 of yielded (1)",
                                 "largest strain (1)", "h (m)"], rows, shown=60)],
        [m for m in shelf.missing("slice-") if "coarse" not in m] + shelf.missing("landslide-"),
    )  # fmt: skip


def number_or(value):
    return 0.0 if value != value else value


def figure_15(shelf):
    rows = []
    for r, what in runs_of(shelf):
        for t in TIMES:
            if r.reaches(t):
                p = 1e-3 * r.frame(t, "mean_stress")[1]
                rows.append([what, SHORT[r.labels["basis"]], r.labels["scheme"], t, float(p.std()), *map(float, np.percentile(p, [1, 50, 99])), r.scene["cell"]])
    found = {(r[0], r[1], r[2], r[3]): r[4] for r in rows}
    pairs = [(x, found.get(("slice", x, "standard", 1.5)), found.get(("slice", x, "zhao", 1.5))) for x in (SHORT["gimp"], SHORT["bspline2"])]
    if any(s is None or z is None for _, s, z in pairs):
        verdict = ("not shown yet", "Slices are missing.")
    else:
        good = all(s > 1.5 * z for _, s, z in pairs)
        verdict = (word(shelf, good),
                   "Standard deviation of the mean stress over the slope at 1.5 s: "
                   + "; ".join(f"{x}: standard {s:.0f} kPa, zhao {z:.0f} kPa" for x, s, z in pairs) + "." + cells_of(shelf)
                   + " (The weight alone gives a range of 0 to about 105 kPa of vertical stress.)")  # fmt: skip
    return Section(
        "figure-15", "Figure 15: mean stress of the landslide",
        "The standard solutions oscillate without physical reason; those with F\u0304 do not.",
        "Mean stress at the same times.", "The weight of the slope: 21.1 kPa of vertical stress a metre.", verdict,
        pictures(shelf, "mean_stress", "figure-15", "mean stress (kPa)", (-100, 100), "Mean stress", factor=1e-3),
        [Table("figure-15.csv", ["run", "basis", "scheme", "t (s)", "standard deviation (kPa)", "1 % (kPa)", "median (kPa)", "99 % (kPa)", "h (m)"],
               rows, shown=60)],
        shelf.missing("landslide-"),
    )  # fmt: skip


def beyond_the_toe(three):
    if not three:
        return ""
    return (f" 3D, uGIMP, zhao: {', '.join(number(v) for v in three[4:8])} m at 1.5, 2.5, 3.5, 5.5 s; the prototype's slice of the "
            f"same h: {', '.join(f'{v:g}' for v in PROTOTYPE['gimp', 'zhao'])} m.")  # fmt: skip


def held_run_out(found):
    standard, zhao = (found.get((HELD, SHORT["bspline2"], s)) for s in ("standard", "zhao"))
    if not standard or not zhao:
        return ""
    rows = {"standard": standard, "zhao": zhao}
    return (" B-splines with walls that hold nodes: "
            + "; ".join(f"{s} {', '.join(number(v) for v in row[4:8])} m at 1.5, 2.5, 3.5, 5.5 s (prototype "
                        f"{', '.join(f'{v:g}' for v in PROTOTYPE['bspline2', s])})" for s, row in rows.items())
            + ": what the wall lets slip decides whether the locked B-spline slope moves, and hardly matters with F\u0304.")  # fmt: skip


def figure_16(shelf):
    there = runs_of(shelf)

    def draw(path):
        figure, axes = curves((7.6, 3.4), 2, sharey=True)
        for axis, basis in zip(axes, ("gimp", "bspline2")):
            for r, what in there:
                if r.labels["basis"] == basis:
                    t, x = r.probe("runout")
                    axis.plot(t[t >= 0], x[t >= 0] - TOE, color=COLOURS[r.labels["scheme"]], linestyle={"3D": "-", HELD: ":"}.get(what, "--"),
                              linewidth=1.8 if what == "3D" else 1.0, label=f"{SCHEME[r.labels['scheme']]}, {what}, h = {r.scene['cell']:g} m")  # fmt: skip
            for (b, s), values in PROTOTYPE.items():
                if b == basis:
                    axis.plot(TIMES, values, "x", color=COLOURS[s], ms=5, mew=1.2)
            axis.set_title(SHORT[basis]), axis.set_xlabel("t (s)"), legend(axis, fontsize=6.5, loc="upper left")
        axes[0].set_ylabel("run-out beyond the toe (m)")
        save(figure, path)

    rows = [[what, SHORT[r.labels["basis"]], r.labels["scheme"], r.particles,
             *[r.at(t, "runout") - TOE if r.reaches(t) else np.nan for t in TIMES], r.at(r.times[-1], "drift"), r.scene["cell"]] for r, what in there]
    found = {(r[0], r[1], r[2]): r for r in rows}
    g, b = SHORT["gimp"], SHORT["bspline2"]
    if any(("slice", x, s) not in found for x in (g, b) for s in ("standard", "zhao")):
        three = found.get(("3D", g, "zhao"))
        verdict = ("not shown yet", "Slices are missing." + beyond_the_toe(three))
    else:
        s = {k[1:]: v for k, v in found.items() if k[0] == "slice"}
        good = s[g, "standard"][7] < 0.5 and s[b, "standard"][7] < 0.85 * s[b, "zhao"][7]
        three = found.get(("3D", g, "zhao"))
        verdict = (word(shelf, good),
                   f"Run-out at 5.5 s, slices: standard {number(s[g, 'standard'][7])} and {number(s[b, 'standard'][7])} m, zhao {number(s[g, 'zhao'][7])} and "
                   f"{number(s[b, 'zhao'][7])} m (uGIMP, B-spline)"
                   + (f", anchored {number(s[g, 'anchored'][7])} and {number(s[b, 'anchored'][7])} m" if (g, "anchored") in s and (b, "anchored") in s else "")
                   + "; at 2.5 s standard B-spline " + f"{number(s[b, 'standard'][5])} against zhao {number(s[b, 'zhao'][5])} m."
                   + held_run_out(found) + beyond_the_toe(three) + cells_of(shelf)
                   + " With zhao the true volume ratio parts from the averaged one: max |ln(J/J\u0304)| "
                   + f"{number(s[g, 'zhao'][8])} (uGIMP)" + (f", anchored {number(s[g, 'anchored'][8])}." if (g, "anchored") in s else "."))  # fmt: skip
    return Section(
        "figure-16", "Figure 16: run-out",
        "Without locking mitigation the run-out is significantly underestimated, or there is none.",
        "Place of the front (99.9 % of the particles are behind it) beyond the toe, x = 15 m.",
        "An independent prototype in plane strain at the same h = 0.2 m (crosses); run-out depends on the mesh, so only equal "
        "cells are compared.", verdict,
        [Picture("figure-16.png", "Run-out over time: 3D solid, plane-strain slices dashed (dotted: walls that hold nodes), the prototype's slices as crosses.", draw)],
        [Table("figure-16.csv", ["run", "basis", "scheme", "particles", *[f"at {t:g} s (m)" for t in TIMES], "max |ln(J/J\u0304)|", "h (m)"], rows)],
        [m for m in shelf.missing("slice-") if "coarse" not in m] + shelf.missing("landslide-"),
    )  # fmt: skip


def sections(shelf):
    return [figure_14(shelf), figure_15(shelf), figure_16(shelf)]
