"""What journal and recording cost a run, what stalled viewers cost it, and how fast fbar records. Timings are
of pairs, one right after the other in turns, so that what else the machine does meets both; ratios count.

    make bench-recording                  all of it, about three minutes
    python3 bench/recording.py cost       one part: cost, publishing, viewers, throughput
"""
import json
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "api"))

import zmq  # noqa: E402
from boxes import merged, water  # noqa: E402
from fbard import Daemon, until  # noqa: E402

FBAR = os.environ.get("FBAR") or str(ROOT / "build" / "fbar")
DT, EVERY, PAIRS = 1e-4, 10, 8
# 102,400 particles in 2D.
SCENE = water(cell=0.05, time={"dt": DT}, bodies={"pool": {"particles_per_cell": 256}},
              output={"interval": 1e6, "probe_interval": 10 * DT})  # fmt: skip


def seconds_per_step(run):
    """Of wall-clock time in the step loop, with what it waited."""
    performance = run["performance"]
    return (performance["wall_s"] + performance["phases"]["waiting"]) / run["step"]


def pairs(title, plain, other):
    """Prints and gives the median ratio of `other` to `plain`."""
    ratios, times = [], []
    for k in range(PAIRS):
        order = (plain, other) if k % 2 == 0 else (other, plain)
        took = {f: f() for f in order}
        ratios.append(took[other] / took[plain])
        times.append(took[plain])
    print(f"{title}: {1e3 * statistics.median(times):.2f} ms a step without; ratio "
          f"{statistics.median(ratios):.4f} (median of {PAIRS} pairs: {', '.join(f'{r:.3f}' for r in sorted(ratios))})")  # fmt: skip
    return statistics.median(ratios)


def cpu_seconds(daemon, *names):
    """Of the daemon's threads with these names."""
    spent = 0
    for task in pathlib.Path(f"/proc/{daemon.process.pid}/task").iterdir():
        try:
            if (task / "comm").read_text().strip() in names:
                spent += 1e-9 * int((task / "schedstat").read_text().split()[0])
        except (FileNotFoundError, ProcessLookupError):
            pass  # it ended
    return spent


def record(daemon, run, folder, *words):
    return subprocess.Popen([FBAR, "--url", daemon.http, "record", run, "-o", str(folder / "a.h5"), *words],
                            stdout=subprocess.DEVNULL)  # fmt: skip


def remove(folder):
    for path in folder.glob("a.*"):
        path.unlink()


def cost(daemon, folder, steps=600, every=100):
    scene = merged(SCENE, {"time": {"end": steps * DT}})
    output = []

    def plain():
        daemon.create(scene, id="plain")
        run = daemon.wait("plain", "completed")
        daemon.away("plain")
        return seconds_per_step(run)

    def recorded():
        daemon.create(merged(scene, {"output": {"interval": every * DT}}), id="recorded", start=False)
        recorder = record(daemon, "recorded", folder)
        until(lambda: daemon.run("recorded")["recorders"])
        daemon.act("recorded", "resume")
        run = daemon.wait("recorded", "completed")
        assert recorder.wait() == 0
        assert len(daemon.frames("recorded")) == steps // every + 1
        phases = run["performance"]["phases"]
        output.append((phases["output"] + phases["waiting"]) / run["performance"]["wall_s"])
        daemon.away("recorded")
        remove(folder)
        return seconds_per_step(run)

    plain()
    pairs(f"journal and recording, {steps} steps, a frame every {every}", plain, recorded)
    print(f"  the run's own thread spends {100 * statistics.median(output):.2f} % on frames and on waiting for their room")


def publishing(daemon, folder, every=100, turns=24):
    """What a frame each `every` steps costs the thread that steps, in its own processor time: one run that in every
    other turn gives out frames, to a subscriber. Waiting and what else the machine does are not in it."""
    daemon.create(merged(SCENE, {"time": {"end": 2}}), id="giving", start=False)
    context = zmq.Context()
    subscriber = context.socket(zmq.SUB)
    subscriber.subscribe(b"run/giving")
    subscriber.connect(daemon.publish)
    steps, done, took, shares = 2 * every, 0, {True: [], False: []}, []

    def clocks():
        performance = daemon.run("giving")["performance"]
        return performance["wall_s"], performance["phases"]["output"] + performance["phases"]["waiting"]

    for k in range(2 * turns + 2):
        gives = k % 4 in (1, 2)
        daemon.patch("giving", {"output": {"interval": every * DT if gives else 1e6}})
        before, then = cpu_seconds(daemon, "run giving"), clocks()
        done += steps
        daemon.act("giving", "step", {"until": done * DT})
        daemon.wait("giving", "paused")
        if k >= 2:  # the first are for the caches, and the threads' start
            took[gives].append((cpu_seconds(daemon, "run giving") - before) / steps)
            if gives:
                shares.append((clocks()[1] - then[1]) / (clocks()[0] - then[0]))
        while subscriber.poll(0):
            subscriber.recv_multipart()
    ratios = sorted(g / s for g, s in zip(took[True], took[False]))
    ratio, share = statistics.median(ratios), statistics.median(shares)
    performance = daemon.run("giving")["performance"]
    sort = performance["phases"]["sort"] / performance["wall_s"]
    print(f"publishing, a frame every {every} steps of 102,400 particles on one thread: {1e3 * statistics.median(took[False]):.2f} ms "
          f"of its processor time a step without; ratio {ratio:.4f} (median of {turns} turns, middle half "
          f"{ratios[turns // 4]:.3f} to {ratios[-turns // 4]:.3f}); on frames and their room {100 * share:.2f} % of its "
          f"time, on sorting {100 * sort:.2f} %  {'met' if share <= 0.02 else 'MISSED'} (at most 2 %)")  # fmt: skip
    (ROOT / "build" / "bench-publishing.json").write_text(json.dumps([{
        "group": "publishing", "ratio": ratio, "middle": [ratios[turns // 4], ratios[-turns // 4]], "share": share, "sort": sort,
        "ms": 1e3 * statistics.median(took[False])}]))  # fmt: skip
    subscriber.close(0)
    context.term()
    daemon.act("giving", "cancel")
    daemon.away("giving")


def viewers(daemon, folder):
    # First 40 frames of 4 MB, which fill what the viewers and the kernel take in before they are stalled: a copy of
    # 10 to 20 MB a viewer, once. Then 40 more.
    half = 40 * EVERY * DT
    scene = merged(SCENE, {"time": {"end": 2 * half}, "output": {"interval": EVERY * DT}})
    filling = {"alone": [], "watched": []}
    output = {"alone": [], "watched": []}

    def second_half(name):
        daemon.create(scene, id=name, start=False)
        daemon.act(name, "step", {"until": half})
        first = daemon.wait(name, "paused")
        before = cpu_seconds(daemon, "publish", "ZMQbg/IO/0")
        daemon.act(name, "resume")
        run = daemon.wait(name, "completed")
        output[name].append(cpu_seconds(daemon, "publish", "ZMQbg/IO/0") - before)
        daemon.away(name)
        filling[name].append(seconds_per_step(first))
        return 2 * seconds_per_step(run) - seconds_per_step(first)

    def alone():
        return second_half("alone")

    def watched():
        context = zmq.Context()
        stalled = [context.socket(zmq.SUB) for _ in range(16)]
        for viewer in stalled:
            viewer.set_hwm(1)
            viewer.subscribe(b"run/")
            viewer.connect(daemon.publish)
        time.sleep(0.5)
        took = second_half("watched")
        for viewer in stalled:
            viewer.close(0)
        context.term()
        return took

    pairs(f"16 viewers that stall, a frame every {EVERY} steps", alone, watched)
    ratios = [w / a for a, w in zip(filling["alone"], filling["watched"])]
    spent = [1e3 * statistics.median(output[name]) for name in output]
    print(f"  the output threads' CPU time for these 40 frames: {spent[0]:.0f} ms without, {spent[1]:.0f} ms with them")
    print(f"  while the buffers of the 16 fill (the first 40 frames): ratio {statistics.median(ratios):.3f}")


def throughput(daemon, folder):
    scene = merged(SCENE, {"time": {"end": 120 * DT}, "output": {"interval": DT}})
    daemon.create(scene, id="frames")
    daemon.wait("frames", "completed")
    frames = daemon.frames("frames")
    megabytes = 1e-6 * sum(f["bytes"] for f in frames)
    for words in ((), ("--compress", "1"), ("--compress", "6")):
        rates = []
        for _ in range(5 if not words else 1):
            began = time.monotonic()
            assert record(daemon, "frames", folder, *words).wait() == 0
            rates.append(megabytes / (time.monotonic() - began))
            size = 1e-6 * (folder / "a.h5").stat().st_size
            remove(folder)
        print(f"fbar record {' '.join(words) or 'uncompressed'}: {len(frames)} frames, {megabytes:.0f} MB: "
              f"{statistics.median(rates):.0f} MB/s from start to FILE.h5 in place "
              f"({min(rates):.0f} to {max(rates):.0f}), file {size:.0f} MB")  # fmt: skip
    daemon.away("frames")


def main():
    parts = {f.__name__: f for f in (cost, publishing, viewers, throughput)}
    wanted = sys.argv[1:] or list(parts)
    if set(wanted) - set(parts):
        sys.exit(f"usage: recording.py [{' | '.join(parts)}] ...")
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = pathlib.Path(tempfile.mkdtemp(prefix="fbard-bench-", dir=memory))
    print(f"one solver thread, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, in {folder.parent}")
    daemon = Daemon(folder, slots=1, threads=1).start()
    try:
        for part in wanted:
            parts[part](daemon, folder)
    finally:
        daemon.stop()
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
