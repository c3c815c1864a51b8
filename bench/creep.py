#!/usr/bin/env python3
"""How F-bar creeps under a static load, and whether the drift tells: Cook's membrane at fixed cells, with every
scheme and several time increments, for three times as long as it needs to come to rest.

    bench/creep.py [-o FOLDER]

The error is that of the loaded column against the rest that the same grid and scheme-free physics has (finite
elements); what F-bar adds is its growth after 40 s. creep.csv has time, drift and error of every run."""
import argparse
import itertools
import pathlib
import sys

from study import ROOT, SCHEMES, Point, Store, markdown, number, write_csv

FEM = 0.261735  # m, P2/P1, converged: mean of u_y over the loaded column (scenes/cook-membrane.json)
AT_REST = 40  # s


def cases():
    for basis, scheme, cell, cfl in itertools.product(("gimp", "bspline2", "bspline3"), SCHEMES, (4, 2), (0.5, 0.3, 0.15)):
        if cell == 2 and (cfl != 0.3 or basis == "bspline3"):
            continue
        if scheme == "standard" and cfl != 0.3:
            continue
        patch = {"basis": basis, "fbar": SCHEMES[scheme], "cell": cell, "time": {"end": 120, "cfl": cfl},
                 "materials": {"rubber": {"poisson_ratio": 0.499}}}  # fmt: skip
        yield {"basis": basis, "scheme": scheme, "cell": cell, "cfl": cfl}, Point("hard-incompressible", patch, 24)


def rows_of(labels, result):
    return [{**labels, "dt": result.get("dt"), "time": row["time"], "drift": number(row["drift"]),
             "column": number(row["probes"]["column.y"]), "error": number(row["probes"]["column.y"]) / FEM - 1,
             "pressure_error": number(row["probes"]["pressure_error"])} for row in result["series"]]  # fmt: skip


def summary(series):
    by_time = lambda t: min(series, key=lambda r: abs(r["time"] - t))
    rest, end = by_time(AT_REST), series[-1]
    return {**{k: series[0][k] for k in ("basis", "scheme", "cell", "cfl")},
            "error at 40 s": f"{100 * rest['error']:+.1f} %", "at 80 s": f"{100 * by_time(80)['error']:+.1f} %",
            "at 120 s": f"{100 * end['error']:+.1f} %",
            "creep, %/10 s": f"{1000 * (end['error'] - rest['error']) / (end['time'] - rest['time']):.2f}",
            "drift at 40 s": f"{rest['drift']:.3g}", "drift at 120 s": f"{end['drift']:.3g}",
            "pressure RMS at 120 s": f"{end['pressure_error']:.2f}"}  # fmt: skip


def study(store):
    wanted = list(cases())
    results = store.all([p for _, p in wanted])
    return [rows_of(labels, result) for (labels, _), result in zip(wanted, results)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=pathlib.Path, default=ROOT / "build" / "report" / "small")
    options = parser.parse_args()
    all_series = study(Store(options.output / "points.jsonl"))
    write_csv(options.output / "creep.csv", [row for series in all_series for row in series])
    lines = [summary(series) for series in all_series]
    write_csv(options.output / "creep-summary.csv", lines)
    print(markdown(lines, list(lines[0])))


if __name__ == "__main__":
    sys.exit(main())
