"""Pictures: matplotlib with the report's own look; every picture has units, and its colour bar says which."""
import io

import matplotlib

matplotlib.use("Agg")
import matplotlib.colors as norms  # noqa: E402,F401
import matplotlib.pyplot as plt  # noqa: E402
import matplotlib.ticker as ticker  # noqa: E402
import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

# One colour a scheme and one line style a basis, in all figures.
COLOURS = {"standard": "#c0392b", "zhao": "#1f618d", "anchored": "#1e8449", "reference": "#222222"}
STYLES = {"gimp": "-", "bspline2": "--", "bspline3": ":"}
MARKS = {"gimp": "o", "bspline2": "s", "bspline3": "^"}
SHORT = {"gimp": "uGIMP", "bspline2": "quadratic B-spline", "bspline3": "cubic B-spline"}
SCHEME = {"standard": "standard", "zhao": r"$\bar{F}$ zhao", "anchored": r"$\bar{F}$ anchored"}

plt.rcParams.update({
    "font.family": "DejaVu Sans", "font.size": 8, "axes.titlesize": 8.5, "axes.labelsize": 8, "legend.fontsize": 7,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": False, "figure.dpi": 110, "savefig.dpi": 110,
    "lines.linewidth": 1.3, "mathtext.fontset": "dejavusans",
})  # fmt: skip


def plain(title):
    """A title without mathematics, for tables."""
    return title.replace(r"$\bar{F}$ ", "")


def label(labels):
    return f"{SCHEME[labels['scheme']]}, {SHORT[labels['basis']]}"


def style(labels):
    return {"color": COLOURS[labels["scheme"]], "linestyle": STYLES[labels["basis"]]}


def legend(axis, **options):
    if axis.get_legend_handles_labels()[0]:
        axis.legend(**options)


def numbered(axis):
    """Numbers at 1, 2 and 5 of a logarithmic axis (matplotlib's axis.xaxis or axis.yaxis), at powers of ten where it is
    long: with its own labels, a decade has one number or none."""
    low, high = sorted(axis.get_view_interval())
    decades = np.log10(high / low)
    axis.set_major_locator(ticker.LogLocator(subs=(1, 1.5, 2, 3, 4, 5, 7) if decades < 0.7 else (1, 2, 5) if decades < 1.6 else (1, 3) if decades < 2.6 else (1,), numticks=20))
    axis.set_minor_locator(ticker.LogLocator(subs=range(1, 10), numticks=50))
    axis.set_major_formatter(ticker.FuncFormatter(lambda x, _: f"{x:g}" if 1e-4 < x < 1e4 else f"$10^{{{np.log10(x):.0f}}}$" if np.log10(x) % 1 < 1e-9 else ""))
    axis.set_minor_formatter(ticker.NullFormatter())


def save(figure, path):
    """Writes a figure; nothing where there was nothing to draw (None)."""
    if figure is None:
        return
    # With a palette, files are a third of the size.
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    plt.close(figure)
    Image.open(buffer).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


def curves(figsize=(7.2, 3.2), columns=1, **options):
    figure, axes = plt.subplots(1, columns, figsize=figsize, layout="constrained", squeeze=False, **options)
    for a in axes.flat:
        a.grid(True, color="#e5e5e5", linewidth=0.6)
    return figure, list(axes.flat)


def fields(panels, limits, unit, xlim, ylim, columns, cmap="RdBu_r", width=7.6, extend="both", norm=None):
    """One panel for each of `panels`: (title, x (n, 2), value (n,), spacing), or (title, text) where there is nothing
    to show. All share limits, colours and one colour bar, labelled `unit`. A particle is drawn as a square of `spacing`
    (m), the distance of particles in the beginning. None where no panel has anything."""
    if all(len(panel) == 2 for panel in panels):
        return None
    rows = -(-len(panels) // columns)
    aspect = (ylim[1] - ylim[0]) / (xlim[1] - xlim[0])
    height = rows * (0.9 * width / columns * aspect + 0.3) + 0.75
    figure, axes = plt.subplots(rows, columns, figsize=(width, height), layout="constrained", squeeze=False,
                                sharex=True, sharey=True)  # fmt: skip
    shown = []
    for axis, panel in zip(axes.flat, panels):
        axis.set_title(panel[0], pad=3)
        axis.set_xlim(xlim), axis.set_ylim(ylim)
        axis.set_aspect("equal")
        axis.tick_params(length=2, labelsize=6.5)
        if len(panel) == 2:
            axis.text(np.mean(xlim), np.mean(ylim), panel[1], ha="center", va="center", color="#777777", fontsize=7)
            continue
        _, x, value, spacing = panel
        if norm:
            value = np.maximum(value, norm.vmin)  # a logarithm has no 0
        scale = {"norm": norm} if norm else {"vmin": limits[0], "vmax": limits[1]}
        shown.append((axis, spacing, axis.scatter(x[:, 0], x[:, 1], c=value, cmap=cmap, marker="s", linewidths=0,
                                                  rasterized=True, **scale)))  # fmt: skip
    for axis in list(axes.flat)[len(panels):]:
        axis.set_axis_off()
    for axis in axes[-1, :]:
        axis.set_xlabel("x (m)", labelpad=1)
    for axis in axes[:, 0]:
        axis.set_ylabel("y (m)", labelpad=1)
    if shown:
        colour = figure.colorbar(shown[0][2], ax=axes, location="bottom", shrink=0.5, aspect=45, extend=extend, pad=0.02)
        colour.set_label(unit)
        colour.ax.tick_params(length=2, labelsize=6.5)
    figure.get_layout_engine().execute(figure)  # now the axes have their places,
    figure.set_layout_engine("none")  # and keep them: half of the time went into finding them once more
    for axis, spacing, scatter in shown:
        points = axis.get_window_extent().width * 72 / figure.dpi
        scatter.set_sizes([max(0.3, (1.05 * spacing * points / (xlim[1] - xlim[0])) ** 2)])
    return figure
