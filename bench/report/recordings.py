"""Reads recordings (docs/reading.md) and the reference tables, with numpy. Figures are made of these alone, so that the
page can be drawn again without running anything."""
import csv
import json
import pathlib

import h5py
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]


def text(value):
    return value.decode() if isinstance(value, bytes) else str(value)


def table(name):
    """Columns of scenes/reference/NAME.csv: {name: (n,) array}."""
    with open(ROOT / "scenes" / "reference" / f"{name}.csv") as f:
        rows = list(csv.reader(line for line in f if not line.startswith("#")))
    return {key: np.array([float(row[k]) for row in rows[1:]]) for k, key in enumerate(rows[0])}


class Recording:
    """A recording; of a run that is still under way what `fbar record` left when it was stopped (`complete` says)."""

    def __init__(self, path, labels=None):
        self.path, self.name, self.labels = pathlib.Path(path), pathlib.Path(path).stem, labels or {}
        with h5py.File(path) as f:
            about = f["fbard"]
            self.complete = bool(about.attrs["complete"])
            self.state, self.version = text(about.attrs["state"]), text(about.attrs["code_version"])
            self.dimension = int(about.attrs["dimension"])
            self.scene = json.loads(about["scene"][()])
            self.times = about["frames/time"][:]  # (frames,) s
            self.steps = int(about["frames/step"][-1])
            self._rows = list(zip(about["frames/row"][:].tolist(), about["frames/count"][:].tolist()))
            self.particles = self._rows[0][1]
        run = self.path.with_suffix(".run.json")  # as the daemon showed it when it was over
        self.run = json.loads(run.read_text()) if run.exists() else {}

    @property
    def failed(self):
        return self.state == "failed"

    def why(self):
        """Of a run that failed: what the daemon said."""
        error = self.run.get("error") or {}
        return error.get("detail") or error.get("kind") or self.state

    def reaches(self, time):
        return self.times[-1] >= time - 1e-3 * abs(time)

    def nearest(self, time):
        """Index of the frame nearest to a time."""
        return int(np.argmin(abs(self.times - time)))

    def frame(self, time, *fields):
        """[(n, dim) positions, fields...] of the frame nearest to a time; vectors (n, 3), scalars (n,)."""
        first, count = self._rows[self.nearest(time)]
        with h5py.File(self.path) as f:
            found = [f["VTKHDF/Points"][first:first + count, :self.dimension]]
            return found + [f["VTKHDF/PointData"][name][first:first + count] for name in fields]

    def probe(self, name, component=None):
        """(times (n,), values (n,)) of a probe, of one component of a vector."""
        with h5py.File(self.path) as f:
            probe = f["fbard/probes"][name]
            value = probe["value"][:]
            if component is not None:
                names = [text(c) for c in np.atleast_1d(probe.attrs["components"])]
                if len(names) == 1:
                    names = names[0].replace(",", " ").split()
                value = value[:, names.index(component)]
            return probe["time"][:], value

    def at(self, time, name, component=None):
        """A probe at a time, interpolated; NaN outside what was sampled."""
        t, value = self.probe(name, component)
        return float(np.interp(time, t, value, left=np.nan, right=np.nan))

    def speed(self):
        """Million particle-steps a second, as run here (on how many threads, and beside what, is not known)."""
        return 1e-6 * (self.run.get("performance", {}).get("particle_steps_per_s") or np.nan)


class Shelf:
    """The recordings that are there, of the cases that are wanted. shelf.cases has them all."""

    def __init__(self, cases, folder, size):
        self.cases, self.folder, self.size = cases, pathlib.Path(folder), size
        self._there = {}
        for case in cases:
            path = self.folder / f"{case.name}.h5"
            if path.exists():
                try:
                    self._there[case.name] = Recording(path, case.labels)
                except (OSError, KeyError, ValueError):
                    pass  # being written, or left by a kill: not there

    def get(self, name):
        return self._there.get(name)

    def find(self, partial=False, **labels):
        """All recordings whose case carries these labels, in the order of the cases; with `partial` also those of
        runs that are not over."""
        return [self._there[c.name] for c in self.cases
                if c.name in self._there and (partial or self._there[c.name].complete) and all(c.labels.get(k) == v for k, v in labels.items())]  # fmt: skip

    def missing(self, prefix=""):
        return [c.name for c in self.cases if c.name.startswith(prefix) and not (c.name in self._there and self._there[c.name].complete)]
