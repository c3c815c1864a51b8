"""The same bits for any number of threads, paused or not, looked at or not: the paper's scenes, by their frames."""
import json
import os

import pytest
from boxes import merged
from fbard import ROOT, Daemon
from frames import Frame

STEPS = 60
SCENES = {
    "dam-break": {},
    # Thrown upwards: 3 cells in 60 steps, so that the particles are sorted again on the way.
    "dam-break thrown": {
        "materials": {"water": {"bulk_modulus": 2e7}},
        "time": {"dt": None, "cfl": 0.3},
        "bodies": {"reservoir": {"velocity": [0, 25]}},
    },
    "cook-membrane": {},
    "strip-footing-small": {},
    "landslide-slice": {},
}


def frames(folder, scene, threads, disturbed):
    daemon = Daemon(folder, threads=threads).start()
    try:
        daemon.create(scene, id="run", start=False)
        parts = [20, 5, 35] if disturbed else [STEPS]
        for steps in parts:
            daemon.act("run", "step", {"steps": steps})
            daemon.wait("run", "paused")
            if disturbed:  # looks change nothing
                daemon.act("run", "snapshot")
                daemon.run("run")
        assert daemon.run("run")["step"] == STEPS
        last = Frame(daemon.frame("run", daemon.act("run", "snapshot")["frame_seq"]))
        return {name: array.tobytes() for name, array in last.fields.items()}, daemon.run("run")["balance"]
    finally:
        daemon.stop()


def scene_of(name, overrides):
    scene = json.loads((ROOT / "scenes" / f"{name}.json").read_text())
    fields = ["position", "velocity", "stress", "volume_ratio", "volume_ratio_bar"]
    return merged(merged(scene, {"output": {"interval": 1e9, "fields": fields}}), overrides)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_frames_do_not_depend_on_threads(tmp_path, name):
    scene = scene_of(name.split()[0], SCENES[name])
    first = frames(tmp_path / "1", scene, 1, False)
    for threads in (2, 3, 4, 7):
        assert frames(tmp_path / str(threads), scene, threads, threads % 2 == 1) == first, threads


@pytest.mark.skipif(not os.environ.get("FBARD_LONG"), reason="long: needs FBARD_LONG=1")
def test_frames_of_the_whole_landslide_do_not_depend_on_threads(tmp_path):
    scene = scene_of("landslide", {})
    first = frames(tmp_path / "1", scene, 1, False)
    for threads in (2, 7):
        assert frames(tmp_path / str(threads), scene, threads, threads == 7) == first, threads
