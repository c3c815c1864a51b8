"""Hard cases on the daemon: what cannot be computed fails with a name and keeps its last good state; what becomes
unreliable says so. Their verdicts are bench/hard.py's."""
import math

import pytest
from fbard import FINAL, until
from frames import Frame

COARSE = "hard-incompressible"
SOFTER = {"materials": {"rubber": {"poisson_ratio": 0.499}}, "time": {"end": 35}}


def test_a_strip_that_tears_fails_with_its_last_good_state(daemon, name):
    scene = {"scene": "hard-dead-load", "overrides": {"fbar": True, "output": {"interval": 1}}}
    daemon.create(scene["scene"], id=name, overrides=scene["overrides"])
    run = daemon.wait(name, "failed")
    error = run["error"]
    assert error["kind"] == "left_domain" and error["quantity"] == "position.x", error
    assert error["particle"] >= 0 and error["step"] == run["step"] + 1 and error["advice"]
    frames = daemon.get(f"/v1/runs/{name}/frames")["frames"]
    assert len(frames) > 5, "the frames before the failure are kept"
    last = Frame(daemon.frame(name, frames[-1]["seq"]))
    assert last.header["time"] <= error["time"]
    for field in last.fields.values():
        assert all(map(math.isfinite, field.ravel().tolist()))
    assert list(daemon.data.glob(f"runs/{name}/checkpoint.bin"))
    daemon.away(name)


@pytest.mark.parametrize("fbar, warned", [(True, True), ({"scheme": "anchored"}, False)])
def test_drift_is_warned_of_where_errors_are(daemon, name, fbar, warned):
    daemon.create(COARSE, id=name, overrides={**SOFTER, "fbar": fbar})
    run = daemon.wait(name, "completed")
    drifted = [w for w in run["warnings"] if "drifted apart" in w]
    assert bool(drifted) == warned, run["warnings"]
    if warned:  # told at a sample: at the same time however often the run was asked
        daemon.create(COARSE, id=name + "-again", overrides={**SOFTER, "fbar": fbar})
        again = until(lambda: (r := daemon.run(name + "-again"))["state"] in FINAL and r, every=0)
        assert again["state"] == "completed"
        assert [w for w in again["warnings"] if "drifted apart" in w] == drifted
        daemon.away(name + "-again")
    daemon.away(name)


def test_the_linear_basis_comes_with_a_warning(daemon, name):
    run = daemon.create("hard-free-fall", id=name, start=False, overrides={"basis": "linear"})
    assert any("linear" in w for w in run["warnings"])
    daemon.away(name)


@pytest.mark.parametrize("basis, limit", [("gimp", 0.5), ("bspline2", 0.6), ("bspline3", 0.75)])
def test_the_limit_on_the_increment_is_the_basis_s(daemon, basis, limit):
    scene = daemon.get("/v1/scenes/hard-dt-ladder")
    scene["basis"] = basis
    scene["time"] = {"end": 1, "cfl": limit}
    daemon.ask("POST", "/v1/scenes:validate", scene)
    scene["time"]["cfl"] = limit + 0.01
    (fault,) = daemon.ask("POST", "/v1/scenes:validate", scene, status=422).json["errors"]
    assert fault["pointer"] == "/time/cfl" and fault["code"] == "unstable_dt" and str(limit) in fault["expected"]
