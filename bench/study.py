"""Many small runs of one kind: a table of points, each a scene with a patch, run by build/release/runner, as many
at a time as there are cores (or JOBS), and kept, so that what is done is not done again.

A point that crashes, hangs or ends in values that are not finite without saying so is a bug of the solver, and is
reported as one; a run that fails as a run may (the daemon's `failed`) is a result.
"""
import concurrent.futures
import csv
import dataclasses
import hashlib
import json
import os
import pathlib
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[1]
RUNNER = pathlib.Path(os.environ.get("RUNNER") or ROOT / "build" / "release" / "runner")
HANG = 10  # s of wall time for each of the processor that a point may take, and 900: --seconds ends what is merely slow
JOBS = int(os.environ.get("JOBS") or len(os.sched_getaffinity(0)))  # points at a time
SCHEMES = {"standard": False, "zhao": True, "anchored": {"scheme": "anchored"}}
BASES = ("linear", "gimp", "bspline2", "bspline3")


@dataclasses.dataclass
class Point:
    scene: str  # of a built-in scene
    patch: dict = dataclasses.field(default_factory=dict)
    samples: int = 20
    seconds: float = 120  # of the processor, then the run is given up
    steps: int = 0  # 0: to the end
    labels: dict = dataclasses.field(default_factory=dict)

    def key(self, scene_text):
        parts = [scene_text, json.dumps(self.patch, sort_keys=True), self.samples, self.steps]
        return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()[:16]


def merged(target, patch):
    """`target` with the merge patch (RFC 7396) applied; neither is changed."""
    if not isinstance(patch, dict):
        return patch
    result = dict(target) if isinstance(target, dict) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = merged(result.get(key), value)
    return result


def composed(first, second):
    """One merge patch that does what `first` and then `second` do to objects: members that are null stay."""
    if not isinstance(second, dict) or not isinstance(first, dict):
        return second
    return {**first, **{k: composed(first.get(k), v) for k, v in second.items()}}


def scene_path(name):
    plain = ROOT / "scenes" / f"{name}.json"
    return plain if plain.exists() else ROOT / "scenes" / "hard" / f"{name.removeprefix('hard-')}.json"


def run(point):
    command = [RUNNER, point.scene, "--patch", json.dumps(point.patch), "--samples", str(point.samples),
               "--seconds", str(point.seconds)]  # fmt: skip
    if point.steps:
        command += ["--steps", str(point.steps)]
    try:
        hang = 900 + HANG * point.seconds
        done = subprocess.run(command, capture_output=True, text=True, timeout=hang)
    except subprocess.TimeoutExpired:
        return {"outcome": "bug", "bug": f"no end after {hang:g} s"}
    if done.returncode == 2:
        return {"outcome": "refused", "detail": done.stderr.strip()}
    try:
        result = json.loads(done.stdout)
    except ValueError:
        return {"outcome": "bug", "bug": f"exit code {done.returncode}: {done.stderr.strip()[-200:]}"}
    if not all(row["finite"] for row in result["series"]):
        result.update(outcome="bug", bug="values that are not finite, and no failure")
    return result


class Store:
    """Results by the key of their point: one line of JSON each in FILE, whose first line says which program they are
    of. They hold for one build of the solver; another program starts the file anew."""

    def __init__(self, file):
        self.file, self.results = file, {}
        program = json.dumps(["runner", hashlib.sha256(RUNNER.read_bytes()).hexdigest()])
        lines = file.read_text().splitlines() if file.exists() else []
        kept = [program]
        for line in lines[1:] if lines[:1] == [program] else []:
            try:
                key, result = json.loads(line)
            except ValueError:
                continue  # the line that a kill cut
            self.results[key] = result
            kept.append(line)
        file.parent.mkdir(parents=True, exist_ok=True)
        scratch = file.with_suffix(".new")
        scratch.write_text("".join(line + "\n" for line in kept))
        scratch.replace(file)

    def all(self, points, jobs=None, say=None):
        """The result of every point, in order."""
        texts = {p.scene: scene_path(p.scene).read_text() for p in points}
        keys = [p.key(texts[p.scene]) for p in points]
        todo = {k: p for k, p in zip(keys, points) if k not in self.results}
        with concurrent.futures.ThreadPoolExecutor(jobs or JOBS) as pool, self.file.open("a") as kept:
            waiting = {pool.submit(run, p): k for k, p in todo.items()}
            for n, future in enumerate(concurrent.futures.as_completed(waiting), 1):
                key = waiting[future]
                self.results[key] = future.result()
                kept.write(json.dumps([key, self.results[key]]) + "\n")
                kept.flush()
                if say:
                    say(n, len(todo), todo[key])
        return [self.results[k] for k in keys]


def number(value):
    """Of what the runner writes: numbers, and "nan", "inf"."""
    return float(value)


def series(result, probe):
    return [(row["time"], number(row["probes"][probe])) for row in result["series"]]


def last(result, probe):
    return number(result["series"][-1]["probes"][probe])


def at(result, probe, time):
    return number(min(result["series"], key=lambda row: abs(row["time"] - time))["probes"][probe])


def write_csv(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def markdown(rows, columns):
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row.get(c, "")) for c in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"
