"""The n-th call on the disk fails, for every n: what was promised before is kept, nothing is promised that is
not there, no file that is whole to the eye is damaged, and once the disk is well again all comes to the
end of an undisturbed run. (failing.c is preloaded; FAIL_HOW there.)"""
import errno
import os
import pathlib
import shutil
import subprocess
import time

import fbard
import pytest
import zmq
from boxes import merged, water
from fbard import FINAL, until
from frames import Frame
from harness import check_same_recording, contents

SHIM = os.environ.get("FAILING") or str(fbard.ROOT / "build" / "release" / "tests" / "failing.so")
# `make check` takes every fifth call, other ones for each kind of fault; `make check-long` every one.
STRIDE = 1 if os.environ.get("FBARD_LONG") else 5

pytestmark = pytest.mark.skipif(fbard.is_sanitized(), reason="a preloaded library and sanitizers exclude each other")

POOL = water(time={"end": 0.04, "dt": 1e-3}, output={"interval": 2e-3, "probe_interval": 2e-3},
             bodies={"pool": {"particles_per_cell": 4}})  # fmt: skip
FAULTS = [("once", errno.EIO), ("on", errno.ENOSPC), ("short", errno.ENOSPC)]


def failing(folder, n, how="once", number=errno.EIO):
    tell = folder.parent / "told"
    tell.unlink(missing_ok=True)
    return {"LD_PRELOAD": SHIM, "FAIL_UNDER": str(folder), "FAIL_AT": str(n), "FAIL_ERRNO": str(number),
            "FAIL_HOW": how, "FAIL_TELL": str(tell)}  # fmt: skip


def told(folder):
    """(number, name) of the call that failed, or of the last one; None before any."""
    try:
        number, name = (folder.parent / "told").read_text().split()
        return int(number), name
    except (OSError, ValueError):
        return None


# ---- The recorder ----


@pytest.fixture
def finished(place):
    """A daemon with a finished run of some frames, its frames, and the recording that it should become."""
    daemon = place().start()
    daemon.create(POOL, id="run")
    daemon.wait("run", "completed")
    assert daemon.fbar("record", "run", "-o", "wanted.h5").returncode == 0
    return daemon, [daemon.frame("run", f["seq"]) for f in daemon.frames("run")], daemon.folder / "wanted.h5"


def check_recorder(daemon, frames, wanted, n, how, number):
    """One recording with a fault, one without. Whether the fault was reached."""
    out = daemon.folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    for recorder in daemon.run("run")["recorders"]:
        daemon.ask("DELETE", f"/v1/runs/run/recorders/{recorder['name']}")
    first = daemon.fbar("record", "run", "-o", "out/a.h5", env={**os.environ, **failing(out, n, how, number)})
    where = told(out)
    reached = where is not None
    context = (n, how, where, first.returncode, first.stderr)
    assert first.returncode in (0, 4), context
    if first.returncode == 4:
        assert "fbar: " in first.stderr and "out/a." in first.stderr, context
    log, file = out / "a.h5.log", out / "a.h5"
    recorders = daemon.run("run")["recorders"]
    if file.exists():  # sealed: whole, whatever happened
        contents(file)
        assert file.read_bytes() == wanted.read_bytes(), context
    elif recorders:
        kept = log.read_bytes() if log.exists() else b""
        for frame in frames[: recorders[0]["acked"] + 1]:
            assert frame in kept, ("acknowledged and not there", context)
    if first.returncode == 0:
        assert file.exists(), context
    second = daemon.fbar("record", "run", "-o", "out/a.h5")
    assert second.returncode == 0, (context, second.stderr)
    check_same_recording(file, wanted)
    assert sorted(p.name for p in out.iterdir()) == ["a.h5", "a.xdmf"], context
    return reached


@pytest.mark.parametrize("how, number", FAULTS, ids=[how for how, _ in FAULTS])
def test_recorder_every_call_that_fails(finished, how, number):
    n, tried = 1 + [how for how, _ in FAULTS].index(how), 0
    while check_recorder(*finished, n, how, number):
        n += STRIDE
        tried += 1
    assert n > 60, "so few calls?"
    print(f"\nrecorder, {how}: {tried} of {n - 1} calls failed; nothing lost")


# ---- The daemon ----

PLAN_STEP = 15


class Witness:
    """Sees what the daemon promises: answers, and frames on the wire."""

    def __init__(self, daemon):
        self.daemon, self.promised, self.frames = daemon, [], {}
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.SUB)
        self.socket.subscribe(b"run/run/frame")
        self.socket.connect(daemon.publish)

    def ask(self, method, path, body=None):
        try:
            reply = self.daemon.request(method, path, body)
        except OSError:
            return None
        assert reply.status < 500 or reply.status in (503, 507), reply
        if reply.status < 300 and method != "GET":
            self.promised.append((method, path, body))
        return reply

    def look(self):
        while self.socket.poll(0):
            _, frame = self.socket.recv_multipart()
            head = fbard.strict_json(frame[64 : 64 + int.from_bytes(frame[8:12], "little")].decode())
            assert self.frames.setdefault(head["seq"], frame) == frame

    def close(self):
        self.socket.close(0)
        self.context.term()


def live_through(daemon, witness):
    """A life in short: created with a recorder, paused, changed, gone on with, over."""
    reply = witness.ask("POST", "/v1/runs", {"scene": POOL, "id": "run", "start": False, "recorders": ["r"]})
    if reply is None or reply.status != 201:
        return
    witness.ask("POST", "/v1/runs/run:step", {"steps": PLAN_STEP})
    end = time.monotonic() + 5

    def state(*wanted):
        while time.monotonic() < end:
            witness.look()
            reply = witness.ask("GET", "/v1/runs/run")
            if reply is None or reply.json["state"] in wanted + FINAL:
                return
            if any("room" in w for w in reply.json["warnings"]):
                return  # it waits for room on the disk, for ever
            time.sleep(0.002)

    state("paused")
    witness.ask("PATCH", "/v1/runs/run/config", {"fbar": False})
    witness.ask("PUT", "/v1/runs/run/recorders/other", {"acked": -1})
    witness.ask("POST", "/v1/runs/run:resume")
    state()
    for k in range(25):
        reply = witness.ask("GET", f"/v1/runs/run/frames/{k}")
        if reply is not None and reply.status == 200:
            assert witness.frames.setdefault(k, reply.body) == reply.body
    witness.look()


def computed(block):
    """A frame but for the state that the run was in when it was taken: one that was lost is taken again, and the
    run may be paused then where it was running."""
    frame = Frame(block)
    header = {key: value for key, value in frame.header.items() if key not in ("state", "fields")}
    return header, {name: (frame.units[name], array.tobytes()) for name, array in frame.fields.items()}


def end_of(daemon):
    """Frames and probes of the finished run."""
    return [computed(daemon.frame("run", f["seq"])) for f in daemon.frames("run")], daemon.csv("run")


@pytest.fixture
def calm(place):
    daemon = place("calm").start()
    daemon.create(POOL, id="run", start=False)
    daemon.act("run", "step", {"steps": PLAN_STEP})
    daemon.wait("run", "paused")
    daemon.patch("run", {"fbar": False})
    daemon.act("run", "resume")
    daemon.wait("run", "completed")
    result = end_of(daemon)
    daemon.stop()
    return result


def check_daemon(daemon, calm, n, how, number):
    data = daemon.data
    shutil.rmtree(data, ignore_errors=True)
    data.mkdir()
    daemon.environment = failing(data, n, how, number)
    witness, started = None, True
    try:
        daemon.start()
    except AssertionError:  # it may refuse to start, and says why
        started = False
        assert daemon.process.poll() not in (None, 0) and str(data) in daemon.stderr(), daemon.stderr()
        daemon.process = None
    if started:
        witness = Witness(daemon)
        live_through(daemon, witness)
        witness.close()
        daemon.kill()
    where = told(data)
    context = (n, how, where, witness and witness.promised, daemon.stderr()[-3000:])
    daemon.environment = {}
    daemon.start()
    runs = {run["id"] for run in daemon.get("/v1/runs")["runs"]}
    promised = witness.promised if witness else []
    if any(path == "/v1/runs" for _, path, _ in promised):
        assert "run" in runs, context
    if "run" in runs:
        for seq, frame in witness.frames.items():
            assert daemon.frame("run", seq) == frame, ("published, and other now", seq, context)
        run = daemon.run("run")
        if any(method == "PATCH" for method, _, _ in promised):
            assert [c["patch"] for c in run["changes"]] == [{"fbar": False}], context
        names = {r["name"] for r in run["recorders"]}
        for _, path, _ in promised:
            if "/recorders/" in path:
                assert path.rsplit("/", 1)[1] in names, context
        if run["state"] not in FINAL:
            if not run["changes"]:
                finish_plan(daemon)
            run = until(lambda: go_on(daemon))
        if run["state"] == "completed":
            frames, text = end_of(daemon)
            if [c["patch"] for c in run["changes"]] == [{"fbar": False}] and run["changes"][0]["step"] == PLAN_STEP:
                assert frames == calm[0] and text == calm[1], context
        else:
            assert run["state"] == "failed" and run["error"]["kind"] == "journal", (run["error"], context)
            assert where is not None, context
        assert run["epoch"] == 0, (run["warnings"], context)
    daemon.stop()
    return where is not None


def finish_plan(daemon):
    """The change did not get so far: it is made now, where the run still can."""
    run = daemon.run("run")
    if run["state"] == "paused" and run["step"] < PLAN_STEP:
        daemon.act("run", "step", {"steps": PLAN_STEP - run["step"]})
        run = daemon.wait("run", "paused", "failed", "completed")
    if run["state"] == "paused" and run["step"] == PLAN_STEP:
        daemon.patch("run", {"fbar": False})


def go_on(daemon):
    run = daemon.run("run")
    if run["state"] == "paused":
        daemon.request("POST", "/v1/runs/run:resume")
    return run if run["state"] in FINAL else None


@pytest.mark.parametrize("how, number", FAULTS, ids=[how for how, _ in FAULTS])
def test_daemon_every_call_that_fails(place, calm, how, number):
    daemon = place("d")
    n, tried = 1 + [how for how, _ in FAULTS].index(how), 0
    while check_daemon(daemon, calm, n, how, number):
        n += STRIDE
        tried += 1
    assert n > 60, "so few calls?"
    print(f"\ndaemon, {how}: {tried} of {n - 1} calls failed; nothing lost")


# ---- durability: power ----


def test_power_syncs_each_frame_before_it_is_published(place):
    """One fdatasync more for each frame and event than with "process"; and where one fails, what it was for
    is not published, and the run says so."""
    counts = {}
    for durability in ("process", "power"):
        daemon = place(durability)
        daemon.data.mkdir()
        daemon.environment = failing(daemon.data, 0)
        daemon.start()
        scene = merged(POOL, {"output": {"durability": durability}})
        daemon.create(scene, id="run")
        daemon.wait("run", "completed")
        daemon.stop()
        counts[durability] = told(daemon.data)[0]
    frames, events = 21, 3
    assert counts["power"] >= counts["process"] + frames + events, counts
    daemon, outcomes = place("fails"), []
    daemon.data.mkdir()
    # From 12 on: the daemon has started. Every third, and which are fdatasyncs is a matter of the threads' order: those
    # between as well where there were too few.
    for n in sorted(range(12, counts["power"]), key=lambda n: n if STRIDE == 1 else n % 3):
        if STRIDE > 1 and n < 15 and outcomes.count("failed") >= 5:
            break
        shutil.rmtree(daemon.data)
        daemon.data.mkdir()
        daemon.environment = failing(daemon.data, n)
        daemon.start()
        witness = Witness(daemon)
        reply = witness.ask("POST", "/v1/runs", {"scene": scene, "id": "run", "start": False})
        if reply.status == 201:
            witness.ask("POST", "/v1/runs/run:resume")
            run = until(lambda: witness.look() or (r := daemon.run("run"))["state"] in FINAL and r)
            time.sleep(0.02)
            witness.look()
            where = told(daemon.data)
            if where and where[1] == "fdatasync":
                assert run["state"] == "completed" or "Input/output error" in run["error"]["detail"], run
                outcomes.append(run["state"])
                kept = daemon.frames("run")
                assert max(witness.frames, default=-1) < len(kept)
                for seq, frame in witness.frames.items():
                    assert daemon.frame("run", seq) == frame
        witness.close()
        daemon.kill()
    assert outcomes.count("failed") >= 5, outcomes  # each frame's fdatasync fails its run; a checkpoint's does not
    print(f"\npower: {len(outcomes)} failing fdatasyncs, {outcomes.count('failed')} of them a frame's or an event's")


# ---- A full disk, a folder that vanishes: without the shim ----


def test_data_folder_that_vanishes_fails_the_run_and_not_the_daemon(place):
    daemon = place().start()
    daemon.create(merged(POOL, {"time": {"end": 1e3}}), id="run")
    daemon.create(merged(POOL, {"time": {"end": 1e3}}), id="other")
    daemon.wait_step("run", 20)
    shutil.rmtree(daemon.data / "runs" / "run")
    run = daemon.wait("run", "failed")
    assert run["error"]["kind"] == "journal" and "runs/run" in run["error"]["detail"], run["error"]
    step = daemon.run("other")["step"]
    daemon.wait_step("other", step + 20)
    daemon.away("other")
    daemon.stop()


def test_recorder_on_a_full_disk_goes_on_when_there_is_room(finished):
    """A real one: a tmpfs of 24 kB. What was acknowledged is in the log, and the same command goes on."""
    daemon, frames, wanted = finished
    out = daemon.folder / "small"
    out.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24k", "tmpfs", out], capture_output=True).returncode:
        pytest.skip("cannot mount a small tmpfs here")
    try:
        result = daemon.fbar("record", "run", "-o", "small/a.h5")
        assert result.returncode == 4 and "No space left on device" in result.stderr, result
        (recorder,) = daemon.run("run")["recorders"]
        log = (out / "a.h5.log").read_bytes()
        assert recorder["acked"] < len(frames) - 1 and frames[0] in log
        assert all(frame in log for frame in frames[: recorder["acked"] + 1])
        subprocess.run(["mount", "-o", "remount,size=100k", out], check=True)
        result = daemon.fbar("record", "run", "-o", "small/a.h5")  # room for the log, but not for the file
        assert result.returncode == 4 and "nothing is lost" in result.stderr, result
        subprocess.run(["mount", "-o", "remount,size=10m", out], check=True)
        assert daemon.fbar("record", "run", "-o", "small/a.h5").returncode == 0
        check_same_recording(out / "a.h5", wanted)
    finally:
        subprocess.run(["umount", "-l", out])


def test_shim_is_there():
    assert pathlib.Path(SHIM).exists(), "make build/release/tests/failing.so"
