#!/usr/bin/env python3
"""What a second thread is worth to a run, by its size: on cores that are free, and on cores that others want too.

Each scene runs in turns on one thread and on all cores; the others are one process a core that computes without end.
The daemon's rule (RUN_PARTICLES_PER_THREAD in server/run.h) is judged by this table; docs/design.md says why it is as it is."""
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "api"))
import fbard  # noqa: E402

SECONDS = float(os.environ.get("SECONDS", 0.4))
ROUNDS = int(os.environ.get("ROUNDS", 5))
CORES = len(os.sched_getaffinity(0))


def flat(cell, per_cell):
    return f"2D, {per_cell} a cell", "dam-break", {"cell": cell, "bodies": {"reservoir": {"particles_per_cell": per_cell}}}


def solid(cell):
    return "3D, 8 a cell", "landslide", {"cell": cell}


CASES = [flat(c, 25) for c in (0.5, 0.25, 0.125, 0.0625)] + [flat(c, 4) for c in (0.125, 0.0625, 0.03125)] + [
    solid(c) for c in (1, 0.5, 0.25)]  # fmt: skip


def speed(daemon, run):
    """Particle-steps per second of wall time (M/s) over SECONDS of the step loop."""
    before = daemon.act(run, "resume")
    time.sleep(SECONDS)
    after = daemon.act(run, "pause")
    steps = after["step"] - before["step"]
    return 1e-6 * after["particles"] * steps / (after["performance"]["wall_s"] - before["performance"]["wall_s"])


def speeds(one, all_of_them, run):
    """Medians over rounds, in turns: (on one thread, on all cores)."""
    rounds = [(speed(one, run), speed(all_of_them, run)) for _ in range(ROUNDS)]
    return [statistics.median(r[k] for r in rounds) for k in (0, 1)]


def main():
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        daemons = [fbard.Daemon(pathlib.Path(folder) / str(n), threads=n, slots=1).start() for n in (1, CORES)]
        busy = []
        try:
            for k, (kind, scene, overrides) in enumerate(CASES):
                run = f"r{k}"
                for d in daemons:
                    d.create(scene, id=run, start=False, overrides=at_rest(overrides))
                    d.act(run, "start")
                    d.act(run, "pause")
                free = speeds(*daemons, run)
                busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(CORES)]
                wanted = speeds(*daemons, run)
                for process in busy:
                    process.kill()
                    process.wait()
                busy = []
                particles = daemons[0].get(f"/v1/runs/{run}")["particles"]
                for d in daemons:
                    d.away(run)
                rows.append((kind, particles, free, wanted))
                if k == 0:
                    print(f"M particle-steps/s on one thread and on {CORES}, and their ratio; medians of {ROUNDS}\n"
                          f"{'':14} {'particles':>9}  {'cores free':^24}  {'cores wanted by others':^24}")  # fmt: skip
                cells = "  ".join(f"{a:7.2f} {b:7.2f} {b / a:8.2f}" for a, b in (free, wanted))
                print(f"{kind:14} {particles:9}  {cells}", flush=True)
        finally:
            for process in busy:
                process.kill()
            for d in daemons:
                d.stop()


def at_rest(overrides):
    return {**overrides, "time": {"dt": None, "cfl": 0.3, "end": 1e3}, "output": {"interval": 1e3}, "references": [],
            "stages": None}  # the gate stays, the clay keeps its strength: what rests may be stepped for ever


if __name__ == "__main__":
    main()
