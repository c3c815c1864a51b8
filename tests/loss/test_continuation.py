"""A killed run goes on with the same bits: every built-in scene, at another number of threads; and what does
not repeat what was published is a new epoch, and says so."""
import json
import socket
import struct

import h5py
import pytest
from boxes import merged
from fbard import PATIENCE, until
from harness import contents
from test_kills import POOL


def steps_and_snapshots(daemon, run, steps, scene_steps):
    """Runs so many steps and gives the frame that is taken there."""
    daemon.act(run, "step", {"steps": steps})
    now = daemon.wait(run, "paused")
    assert now["step"] == scene_steps, now
    return daemon.frame(run, daemon.act(run, "snapshot")["frame_seq"])


def names():
    from fbard import ROOT

    scenes = ROOT / "scenes"
    return sorted(str(p.relative_to(scenes).with_suffix("")) for p in scenes.rglob("*.json"))


def scene_of(name):
    from fbard import ROOT

    return json.loads((ROOT / "scenes" / f"{name}.json").read_text())


def check_scene(place, name, steps):
    first = place("first", threads=2).start()
    quiet = merged(scene_of(name), {"output": {"interval": 1e9, "fields": ["position", "velocity", "stress", "volume_ratio"]}})
    first.create(quiet, id="run", start=False)
    steps_and_snapshots(first, "run", steps, steps)
    wanted = steps_and_snapshots(first, "run", steps, 2 * steps)
    energies = first.run("run")["balance"]
    first.stop()
    killed = place("killed", threads=1).start()
    killed.create(quiet, id="run", start=False)
    steps_and_snapshots(killed, "run", steps, steps)
    killed.act("run", "checkpoint")
    killed.act("run", "step", {"steps": steps})
    killed.kill()  # somewhere on the way
    killed.threads = 2
    killed.start()
    run = killed.wait("run", "paused")
    assert run["step"] == 2 * steps and run["epoch"] == 0, run
    frame = killed.frame("run", killed.act("run", "snapshot")["frame_seq"])
    assert frame == wanted
    assert killed.run("run")["balance"] == energies
    killed.stop()


SMALL = ["axial-bar", "cook-membrane", "dam-break", "hydrostatic-column", "strip-footing-small"]


@pytest.mark.parametrize("name", [n for n in names() if n in SMALL])
def test_killed_scene_goes_on_with_the_same_bits(place, name):
    check_scene(place, name, 40)


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in names() if n not in SMALL])
def test_every_other_killed_scene_goes_on_with_the_same_bits(place, name):
    check_scene(place, name, 10)


def test_what_does_not_repeat_itself_is_a_new_epoch(place):
    """The scene is changed behind the daemon's back: what was published stays, what comes now is marked."""
    daemon = place().start()
    scene = merged(POOL, {"output": {"checkpoint_interval": 1e6, "interval": 0.02}, "time": {"end": 0.4}})
    daemon.create(scene, id="run", start=False, recorders=["keeper"])
    recorder = daemon.record("run", "a.h5")
    until(lambda: len(daemon.run("run")["recorders"]) == 2)  # before, a daemon that is away ends a new recording
    daemon.act("run", "step", {"steps": 1050})  # frames 0 to 10
    daemon.wait("run", "paused")
    n = until(lambda: len(f := daemon.frames("run")) == 11 and len(f))
    before = [daemon.frame("run", k) for k in range(n)]
    daemon.act("run", "step", {"steps": 500})
    daemon.kill()  # in motion, or paused there: not over
    folder = daemon.data / "runs" / "run"
    for path in folder.glob("checkpoint.*"):
        path.unlink()
    stored = json.loads((folder / "scene.json").read_text())
    stored["materials"]["water"]["viscosity"] = 0.5
    (folder / "scene.json").write_text(json.dumps(stored))
    daemon.start()
    run = daemon.wait("run", "completed", "paused")
    if run["state"] == "paused":
        daemon.act("run", "resume")
        run = daemon.wait("run", "completed")
    assert run["epoch"] == 1
    assert any("epoch 1" in w and "differ" in w for w in run["warnings"]), run["warnings"]
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    (epoch,) = [e for e in events if e["event"] == "epoch"]
    frames = daemon.frames("run")
    assert [daemon.frame("run", k) for k in range(n)] == before, "what was published stays"
    assert [f["seq"] for f in frames] == list(range(len(frames)))
    assert [f["epoch"] for f in frames] == [0] * epoch["seq"] + [1] * (len(frames) - epoch["seq"])
    assert epoch["seq"] >= n and frames[epoch["seq"]]["step"] < frames[epoch["seq"] - 1]["step"]
    assert recorder.wait(PATIENCE) == 0, daemon.said("a.h5")
    contents(daemon.folder / "a.h5")
    with h5py.File(daemon.folder / "a.h5") as f:
        assert list(f["fbard/frames/epoch"]) == [x["epoch"] for x in frames]
        assert list(f["fbard/frames/step"]) == [x["step"] for x in frames]


def test_checkpoint_that_counts_on_lost_probes_is_not_used(place):
    """Probes that went with a power failure are sampled again, from an older state."""
    daemon = place().start()
    scene = merged(POOL, {"output": {"checkpoint_interval": 1e6}, "time": {"end": 0.2}})
    daemon.create(scene, id="calm")
    daemon.wait("calm", "completed")
    daemon.create(scene, id="run", start=False)
    daemon.act("run", "step", {"steps": 600})
    daemon.wait("run", "paused")  # with a checkpoint
    daemon.kill()
    log = daemon.data / "runs" / "run" / "probes.log"
    log.write_bytes(log.read_bytes()[:-500])
    daemon.start()
    daemon.act("run", "resume")
    assert daemon.wait("run", "completed")["epoch"] == 0
    assert daemon.csv("run") == daemon.csv("calm")
    assert [f["digest"] for f in daemon.frames("run")] != []




def test_new_recording_waits_for_a_daemon_that_breaks_its_first_request_off(place):
    """A daemon that is killed while it is asked for the first time was there; one that never answered is an error."""
    daemon = place().start()
    daemon.create(POOL, id="run", start=False)
    daemon.stop()
    host, port = daemon.addresses[0].split(":")
    nobody = daemon.record("run", "a.h5")
    assert nobody.wait(PATIENCE) == 3 and "cannot reach" in daemon.said("a.h5")
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, int(port)))
        listener.listen()
        recorder = daemon.record("run", "b.h5")
        taken, _ = listener.accept()
        taken.recv(1)
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, as a kill gives
        taken.close()
    until(lambda: "waiting up to" in daemon.said("b.h5"))
    daemon.start()
    until(lambda: len(daemon.run("run")["recorders"]) == 1)
    daemon.act("run", "resume")
    assert recorder.wait(PATIENCE) == 0, daemon.said("b.h5")
    with h5py.File(daemon.folder / "b.h5") as f:
        assert f["fbard"].attrs["complete"] == 1
