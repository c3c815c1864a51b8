"""What the log says of a run in motion is exact, to the step."""
import json
import pathlib

from boxes import endless, escaping, water
from fbard import until


def config_events(daemon, run):
    path = pathlib.Path(daemon.data) / "runs" / run / "events.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()]
    return [e for e in events if e.get("patch") is not None]


def test_patches_of_a_running_run_are_logged_at_their_effective_step(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait(name, "running")
    steps = [daemon.patch(name, {"damping": {"mass": k * 1e-6}})["effective_step"] for k in range(1, 21)]
    assert [e["step"] for e in config_events(daemon, name)] == steps
    assert steps[-1] > steps[0], "it ran meanwhile"
    daemon.away(name)


def test_patched_in_motion_and_killed_it_continues_with_the_same_bits(fresh):
    """Epoch 0: every frame that is simulated again has the digest that the journal holds."""
    d = fresh().start()
    scene = water(time={"dt": 2e-4, "end": 1e3}, output={"interval": 0.06, "probe_interval": 0.04})
    d.create(scene, id="patched")  # it has no end near enough to come before the kill
    for k in range(6):
        d.wait_step("patched", 300 * (k + 1))
        d.patch("patched", {"fbar": k % 2 == 0})
    d.wait_step("patched", 2500)
    before = [d.frame("patched", f["seq"]) for f in d.frames("patched")]
    d.kill()
    d.start()

    def end_soon():  # refused as long as what was published is repeated, and where its time has come meanwhile
        end = d.run("patched")["time"] + 0.2
        return d.request("PATCH", "/v1/runs/patched/config", {"time": {"end": end}}).status == 200

    until(end_soon)
    run = d.wait("patched", "completed")
    assert run["epoch"] == 0, run["warnings"]
    assert [d.frame("patched", k) for k in range(len(before))] == before


def test_failed_run_keeps_a_checkpoint_and_its_last_good_frame(daemon, name):
    daemon.create(escaping(), id=name)
    run = daemon.wait(name, "failed")
    folder = pathlib.Path(daemon.data) / "runs" / name
    assert list(folder.glob("checkpoint*")), sorted(p.name for p in folder.iterdir())
    frames = daemon.frames(name)
    assert frames[-1]["end"] and frames[-1]["step"] < run["error"]["step"]
    daemon.away(name)
