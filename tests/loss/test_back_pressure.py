"""A recorder that does not keep up holds the run back, or fails it, and loses nothing; a viewer that does
not keep up costs neither the run nor the daemon anything."""
import json
import re
import signal
import time

import pytest
import zmq
from boxes import merged, water
from fbard import PATIENCE, is_sanitized, until
from harness import check_same_recording, contents

BUDGET = 1_000_000
# 10 kB a frame, 600 frames: six times the budget.
POOL = water(time={"end": 0.6, "dt": 1e-3}, output={"interval": 1e-3, "probe_interval": 0.01, "journal_bytes": BUDGET,
                                                    "checkpoint_interval": 0.2})  # fmt: skip


@pytest.fixture
def daemon(place):
    return place().start()


def put(daemon, name, acked, run="run", status=200):
    return daemon.ask("PUT", f"/v1/runs/{run}/recorders/{name}", {"acked": acked}, status=status).json


def index(daemon, run="run"):
    return daemon.get(f"/v1/runs/{run}/frames")


def held(daemon):
    """The run, once it waits for a recorder: it may have waited for the disk before."""
    return until(lambda: (now := daemon.run("run"))["state"] == "waiting" and any("recorder" in w for w in now["warnings"])
                 and now)  # fmt: skip


def bytes_kept(daemon, run="run"):
    return sum(f["bytes"] for f in index(daemon, run)["frames"])


def test_run_waits_for_a_recorder_and_goes_on_when_it_acknowledges(daemon):
    calm = merged(POOL, {"output": {"journal_bytes": 10**9}})
    daemon.create(calm, id="calm")
    daemon.create(POOL, id="run", recorders=["slow"])
    run = held(daemon)
    assert any("recorder slow" in w for w in run["warnings"]), run["warnings"]
    assert [(r["name"], r["acked"]) for r in run["recorders"]] == [("slow", -1)]
    there = index(daemon)
    assert there["gone"] == [] and there["first"] == 0
    # A checkpoint takes the frames on their way, four at most, over the budget; one may be on its way to a slow disk.
    until(lambda: 0.8 * BUDGET < bytes_kept(daemon))
    time.sleep(0.3)
    n = len(index(daemon)["frames"])
    assert bytes_kept(daemon) <= BUDGET + 5 * there["frames"][0]["bytes"] and daemon.run("run")["state"] == "waiting"
    # A second recorder that is ahead changes nothing; what both have may go.
    put(daemon, "quick", n - 1)
    time.sleep(0.2)
    assert len(index(daemon)["frames"]) == n
    acked, kept = -1, {}
    while daemon.run("run")["state"] not in ("completed", "failed"):
        frames = index(daemon)
        assert frames["first"] <= acked + 1, "dropped before it was acknowledged"
        assert frames["gone"] == ([{"from": 0, "to": frames["first"] - 1}] if frames["first"] else [])
        last = frames["frames"][-1]["seq"]
        for seq in range(acked + 1, last + 1):
            kept[seq] = daemon.frame("run", seq)
        put(daemon, "quick", last)
        put(daemon, "slow", last)
        acked = last
    frames = index(daemon)
    assert frames["first"] > 0 and frames["frames"][-1]["end"]
    for seq in range(acked + 1, frames["frames"][-1]["seq"] + 1):
        kept[seq] = daemon.frame("run", seq)
    daemon.wait("calm", "completed")
    theirs = [daemon.frame("calm", k) for k in range(len(kept))]
    assert len(index(daemon, "calm")["frames"]) == len(kept)
    assert [arrays(kept[k]) for k in sorted(kept)] == [arrays(f) for f in theirs]
    daemon.ask("GET", "/v1/runs/run/frames/0", status=404)
    assert not any("recorder" in w for w in daemon.run("run")["warnings"])


def arrays(frame):
    """All but the header, which names the run."""
    return frame[64 + int.from_bytes(frame[8:12], "little"):]


def test_run_fails_with_its_frames_kept_where_full_means_fail(daemon):
    scene = merged(POOL, {"output": {"when_full": "fail"}})
    daemon.create(scene, id="run", recorders=["slow"])
    run = daemon.wait("run", "failed")
    assert run["error"]["kind"] == "journal" and "recorder slow" in run["error"]["detail"], run["error"]
    frames = index(daemon)["frames"]
    assert frames[-1]["end"] and [f["seq"] for f in frames] == list(range(len(frames)))
    assert bytes_kept(daemon) <= BUDGET + 8 * frames[0]["bytes"], "only those on their way and the last go over it"
    assert list((daemon.data / "runs" / "run").glob("checkpoint.*"))
    result = daemon.fbar("record", "run", "-o", "a.h5")
    assert result.returncode == 0, result.stderr


def test_removing_the_recorder_lets_the_run_go_on(daemon):
    daemon.create(POOL, id="run", recorders=["gone", "other"])
    held(daemon)
    daemon.ask("DELETE", "/v1/runs/run/recorders/gone")
    time.sleep(0.2)
    assert daemon.run("run")["state"] == "waiting", "there is another one"
    left = daemon.ask("DELETE", "/v1/runs/run/recorders/other").json
    assert left["recorders"] == []
    daemon.wait("run", "completed")
    daemon.ask("DELETE", "/v1/runs/run/recorders/other", status=404)


def test_waiting_survives_a_kill_and_can_be_paused_and_cancelled(daemon):
    daemon.create(POOL, id="run", recorders=["slow"])
    held(daemon)
    before = index(daemon)["frames"]
    daemon.kill()
    daemon.start()
    held(daemon)
    again = index(daemon)["frames"]
    assert again[:len(before)] == before and bytes_kept(daemon) <= BUDGET + 6 * before[0]["bytes"]
    began = time.monotonic()
    for _ in range(3):  # each writes a checkpoint, and none adds frames without end
        daemon.act("run", "pause")
        assert daemon.run("run")["state"] == "paused"
        assert not any("checkpoint" in w for w in daemon.run("run")["warnings"])
        daemon.act("run", "resume")
        held(daemon)
    assert bytes_kept(daemon) <= BUDGET + 8 * before[0]["bytes"]
    assert time.monotonic() - began < 30
    daemon.ask("POST", "/v1/runs/run:snapshot", status=503)
    daemon.act("run", "cancel")
    assert daemon.wait("run", "cancelled")
    frames = index(daemon)["frames"]
    assert frames[-1]["end"] and frames[0]["seq"] == 0
    assert daemon.fbar("record", "run", "-o", "a.h5").returncode == 0


def test_stopped_recorder_holds_the_run_until_it_goes_on(place):
    # The budget is part of the scene, which is part of the recording: both have the same.
    wide = place("wide").start()
    daemon = place("tight").start()
    for d in (wide, daemon):
        d.create(POOL, id="run", start=False)
    whole = wide.record("run", "a.h5")
    # It is stopped here, and by nobody else (shake.py).
    recorder = daemon.record("run", "a.h5", environment={"SHAKE": "no"})
    other = daemon.record("run", "b.h5")
    until(lambda: len(daemon.run("run")["recorders"]) == 2 and len(wide.run("run")["recorders"]) == 1)
    recorder.send_signal(signal.SIGSTOP)
    for d in (wide, daemon):
        d.act("run", "resume")
    run = held(daemon)
    assert min(r["acked"] for r in run["recorders"]) < 5
    time.sleep(0.5)
    assert daemon.run("run")["state"] == "waiting" and daemon.run("run")["step"] < 600
    recorder.send_signal(signal.SIGCONT)
    assert {r.wait(PATIENCE) for r in (recorder, other, whole)} == {0}, daemon.said("a.h5")
    assert daemon.run("run")["state"] == "completed"
    for file in ("a.h5", "b.h5"):
        check_same_recording(daemon.folder / file, wide.folder / "a.h5")


def test_durability_and_budget_change_while_it_runs(daemon):
    # It ends when it is told to, and not before all this was done; 10,000 frames fit into its journal, 200,000 steps.
    scene = merged(POOL, {"time": {"end": 1e3}, "output": {"journal_bytes": 10**8, "interval": 0.02}})
    daemon.create(scene, id="run", recorders=["slow"])
    for k in range(10):
        step = daemon.run("run")["step"]
        daemon.patch("run", {"output": {"durability": ("power", "process")[k % 2]}})
        daemon.wait_step("run", step + 20)
    daemon.patch("run", {"output": {"journal_bytes": BUDGET}})  # what is there already stays
    run = held(daemon)
    frames = index(daemon)
    assert frames["first"] == 0 and run["warnings"] and run["epoch"] == 0
    daemon.patch("run", {"output": {"journal_bytes": 10**8}, "time": {"end": run["time"] + 0.2}})
    daemon.wait("run", "completed")
    assert index(daemon)["first"] == 0


def test_fbar_run_is_registered_before_the_first_frame(daemon):
    """Six times the budget goes through the journal, and the recording misses nothing."""
    (daemon.folder / "pool.json").write_text(json.dumps(POOL))
    result = daemon.fbar("run", "pool.json", "--id", "run", "-o", "a.h5")
    assert result.returncode == 0, result.stderr
    frames = index(daemon)
    assert frames["first"] > 0, "nothing had to go: this shows nothing"
    _, n = contents(daemon.folder / "a.h5")
    assert n == frames["frames"][-1]["seq"] + 1 == 601
    assert daemon.run("run")["recorders"] == []


def resident(daemon, kind):
    with open(f"/proc/{daemon.process.pid}/status") as f:
        return 1024 * int(re.search(rf"{kind}:\s+(\d+)", f.read())[1])


@pytest.mark.skipif(is_sanitized(), reason="sanitizers keep freed memory")
def test_viewers_that_stall_cost_no_memory_and_no_frames(daemon):
    """Each stalls at its own moment: if the daemon held what each has not taken, it would hold all."""
    scene = merged(POOL, {"cell": 0.05, "time": {"end": 0.1, "dt": 1e-4}, "bodies": {"pool": {"particles_per_cell": 100}},
                          "output": {"interval": 5e-4, "journal_bytes": 10**9,
                                     "fields": ["position", "velocity", "stress", "displacement"]}})  # fmt: skip
    daemon.create(scene, id="run", start=False)
    first = until(lambda: index(daemon)["frames"])[0]["bytes"]
    assert first > 3_000_000
    daemon.act("run", "step", {"steps": 5})
    daemon.wait("run", "paused")
    before = resident(daemon, "RssAnon")
    context, viewers = zmq.Context(), []
    try:
        for k in range(8):
            viewer = context.socket(zmq.SUB)  # takes two messages and then no more
            viewer.set_hwm(1)
            viewer.rcvbuf = 65536
            viewer.subscribe(b"run/run/frame")
            viewer.connect(daemon.publish)
            viewers.append(viewer)
            step = daemon.run("run")["step"] + 60
            daemon.act("run", "step", {"steps": 60})
            assert daemon.wait("run", "paused")["step"] == step
        frames = index(daemon)["frames"]
        assert len(frames) > 90
        grown = resident(daemon, "RssAnon") - before
        # 8 viewers with 8 messages each would be 8 * 8 * 3 MB; in flight are 4, and one is being filled.
        assert grown < 6 * first, f"{grown / 1e6:.0f} MB with frames of {first / 1e6:.1f} MB"
        assert [f["seq"] for f in frames] == list(range(len(frames)))
    finally:
        for viewer in viewers:
            viewer.close(0)
        context.term()
    until(lambda: resident(daemon, "RssFile") < 20 * first)


