"""A run's life: creation, actions, states, what it says of itself, deletion."""
import math
import os
import time
import uuid

import pytest
from boxes import WATER_MASS, WATER_PARTICLES, WATER_STEPS, big, endless, escaping, water
from fbard import FINAL, STATES, fbar_is_on, timestamp, until

NUMBER = (int, float)
RUN = {
    "id": str, "state": str, "step": int, "time": NUMBER, "end_time": NUMBER, "progress": NUMBER,
    "eta_s": (int, float, type(None)), "dt": NUMBER, "fbar": (bool, str, dict), "particles": int,
    "scene": (str, dict), "created": str, "error": (dict, type(None)), "warnings": list,
    "performance": dict, "balance": dict, "probes": dict, "accuracy": list,
}  # fmt: skip
PERFORMANCE = {"wall_s": NUMBER, "particle_steps_per_s": (int, float, type(None)),
               "bytes_per_particle": NUMBER, "threads": int, "phases": dict}  # fmt: skip
BALANCE = {"mass", "momentum", "angular_momentum", "kinetic_energy", "strain_energy", "external_work"}


def check_run(run):
    for key, kind in RUN.items():
        assert key in run, f"no {key}"
        assert isinstance(run[key], kind), (key, run[key])
        assert kind is not NUMBER or not isinstance(run[key], bool), key
    for key, kind in PERFORMANCE.items():
        assert isinstance(run["performance"].get(key), kind), (key, run["performance"])
    assert BALANCE <= set(run["balance"])
    assert run["state"] in STATES
    assert 0 <= run["progress"] <= 1
    assert run["step"] >= 0
    assert run["dt"] > 0
    timestamp(run["created"])
    return run


# ---- Creation ----


def test_create_answers_201_location_and_the_run(daemon, name):
    reply = daemon.ask("POST", "/v1/runs", {"scene": water(), "id": name, "start": False}, status=201)
    assert reply.headers["location"].endswith(f"/v1/runs/{name}")
    assert reply.type == "application/json"
    run = check_run(reply.json)
    assert run["id"] == name
    assert run["state"] == "paused"
    assert (run["step"], run["progress"], run["error"]) == (0, 0, None)
    assert run["end_time"] == 0.1
    assert fbar_is_on(run)
    assert check_run(daemon.run(name))["particles"] == WATER_PARTICLES
    daemon.away(name)


def test_create_without_id_makes_ids_of_the_documented_form(daemon):
    import re

    runs = [daemon.create(endless(), start=False)["id"] for _ in range(3)]
    assert len(set(runs)) == 3
    for run in runs:
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", run)
    daemon.away(*runs)


@pytest.mark.parametrize("length", [1, 64])
def test_create_takes_ids_up_to_64_characters(daemon, length):
    run = (uuid.uuid4().hex + uuid.uuid4().hex)[:length]
    assert daemon.create(endless(), id=run, start=False)["id"] == run
    daemon.away(run)


def test_create_takes_dots_dashes_and_underscores(daemon, name):
    run = f"0.{name}-_..x"
    daemon.create(endless(), id=run, start=False)
    assert daemon.run(run)["id"] == run
    daemon.away(run)


def test_create_starts_by_itself_and_completes(daemon, name):
    created = daemon.create(water(), id=name)
    assert created["state"] in ("queued", "running", "waiting", "completed")
    run = check_run(daemon.wait(name, "completed"))
    assert run["step"] == WATER_STEPS
    assert run["time"] == pytest.approx(0.1, rel=1e-12)
    assert run["progress"] == 1
    assert run["error"] is None
    assert run["particles"] == WATER_PARTICLES
    daemon.away(name)


def test_create_takes_a_builtin_by_name_with_overrides(daemon, name):
    patch = {"time": {"end": 0.01, "cfl": 0.3, "dt": None},
             "materials": {"water": {"bulk_modulus": 2e6}},
             "stages": None, "references": None}  # fmt: skip
    run = daemon.create("dam-break", overrides=patch, id=name)
    scene = run["scene"] if isinstance(run["scene"], str) else run["scene"].get("name", "")
    assert "dam-break" in scene
    run = daemon.wait(name, "completed")
    assert run["particles"] == 3200
    assert daemon.get(f"/v1/runs/{name}/scene")["materials"]["water"]["bulk_modulus"] == 2e6
    daemon.away(name)


def test_create_twice_with_one_id_is_409_and_leaves_the_first(daemon, name):
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"steps": 7})
    before = daemon.wait(name, "paused")
    reply = daemon.ask("POST", "/v1/runs", {"scene": endless(), "id": name}, status=409)
    assert name in reply.json["detail"]
    assert daemon.run(name) == before
    daemon.away(name)


def test_list_has_every_run(daemon):
    before = {r["id"] for r in daemon.get("/v1/runs")["runs"]}
    runs = {daemon.create(endless(), start=False)["id"] for _ in range(3)}
    listed = daemon.get("/v1/runs")["runs"]
    assert {r["id"] for r in listed} == before | runs
    for run in listed:
        assert run["state"] in STATES
        assert run["step"] >= 0
    daemon.away(*runs)
    assert {r["id"] for r in daemon.get("/v1/runs")["runs"]} == before


# ---- Actions ----


def test_start_false_waits_at_step_0_until_start(daemon, name):
    daemon.create(water(), id=name, start=False)
    assert daemon.run(name)["step"] == 0
    answer = daemon.act(name, "start")
    assert answer["state"] in ("running", "completed")
    assert answer["effective_step"] >= 0
    assert daemon.wait(name, "completed")["step"] == WATER_STEPS
    daemon.away(name)


def test_pause_stops_at_effective_step_and_resume_goes_on(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait_step(name, 10)
    answer = check_run(daemon.act(name, "pause"))
    assert answer["state"] == "paused"
    step = answer["effective_step"]
    assert step == answer["step"] >= 10
    assert daemon.run(name)["step"] == step
    again = daemon.act(name, "pause")
    assert (again["state"], again["effective_step"], again["step"]) == ("paused", step, step)
    answer = daemon.act(name, "resume")
    assert answer["state"] == "running"
    assert answer["effective_step"] >= step
    daemon.wait_step(name, step + 10)
    assert daemon.act(name, "resume")["state"] == "running"
    assert daemon.act(name, "start")["state"] == "running"
    daemon.away(name)


def test_step_runs_exactly_n_steps_and_pauses(daemon, name):
    daemon.create(water(), id=name, start=False)
    for n, at in ((1, 1), (5, 6), (30, 36)):
        answer = daemon.act(name, "step", {"steps": n})
        assert answer["effective_step"] == at - n
        assert answer["state"] in ("running", "queued") or answer["step"] == at
        run = daemon.wait(name, "paused")
        assert run["step"] == at
        assert run["time"] == pytest.approx(at * 1e-3, rel=1e-12)
    daemon.away(name)


def test_step_answers_as_running_when_its_steps_have_begun(daemon, name):
    daemon.create(endless(), id=name, start=False)
    assert daemon.act(name, "step", {"steps": 10**9})["state"] == "running"
    reply = daemon.ask("POST", f"/v1/runs/{name}:step", {"steps": 1}, status=409)
    assert "running" in reply.json["detail"]
    daemon.act(name, "pause")
    daemon.away(name)


def test_step_until_a_time(daemon, name):
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"until": 0.05})
    run = daemon.wait(name, "paused")
    assert run["step"] == 50
    assert run["time"] == pytest.approx(0.05, rel=1e-12)
    reply = daemon.ask("POST", f"/v1/runs/{name}:step", {"until": 0.01}, status=422)
    assert "/until" in reply.pointers
    assert daemon.run(name)["step"] == 50
    daemon.away(name)


def test_step_past_the_end_completes(daemon, name):
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"steps": 10 * WATER_STEPS})
    assert daemon.wait(name, "completed")["step"] == WATER_STEPS
    daemon.away(name)


@pytest.mark.parametrize(
    "body, pointer",
    [
        ({"steps": 0}, "/steps"), ({"steps": -1}, "/steps"), ({"steps": 1.5}, "/steps"),
        ({"steps": "5"}, "/steps"), ({"steps": None}, "/steps"),
        ({"until": "0.1"}, "/until"), ({"until": [1]}, "/until"), ({"steps": 1, "stepz": 1}, "/stepz"),
        ({}, None), ({"steps": 1, "until": 0.05}, None), ([], None), (5, None),
    ],
)  # fmt: skip
def test_step_refuses_what_is_no_count_and_no_time(daemon, shared_paused, body, pointer):
    reply = daemon.ask("POST", f"/v1/runs/{shared_paused}:step", body, status=422)
    if pointer:
        assert pointer in reply.pointers, reply
    assert daemon.run(shared_paused)["step"] == 0


@pytest.fixture(scope="module")
def shared_paused(daemon):
    run = daemon.create(water(), start=False)["id"]
    yield run
    daemon.away(run)


def test_step_without_a_body_is_refused(daemon, shared_paused):
    assert daemon.request("POST", f"/v1/runs/{shared_paused}:step").status in (400, 415, 422)
    assert daemon.run(shared_paused)["step"] == 0


@pytest.mark.parametrize("action", ["start", "pause", "resume", "cancel", "checkpoint", "snapshot"])
def test_actions_take_an_empty_object_as_body(daemon, name, action):
    daemon.create(endless(), id=name, start=False)
    daemon.act(name, action, {})
    daemon.away(name)


def test_snapshot_takes_a_frame_of_this_very_step(daemon, name):
    daemon.create(water(output={"interval": 1}), id=name, start=False)
    daemon.act(name, "step", {"steps": 3})
    daemon.wait(name, "paused")
    answer = daemon.act(name, "snapshot")
    assert answer["effective_step"] == 3
    index = daemon.frames(name)
    assert index[-1]["step"] == 3
    daemon.act(name, "snapshot")  # idempotent
    assert daemon.frames(name) == index
    daemon.away(name)


def test_checkpoint_answers_with_the_run(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait_step(name, 5)
    answer = check_run(daemon.act(name, "checkpoint"))
    assert answer["effective_step"] >= 5
    assert answer["state"] == "running"
    daemon.away(name)


def test_cancel_ends_the_run_for_good(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait_step(name, 1)
    answer = daemon.act(name, "cancel")
    run = daemon.wait(name, "cancelled")
    assert answer["effective_step"] == run["step"]
    assert run["progress"] < 1
    assert run["error"] is None
    assert daemon.act(name, "cancel")["state"] == "cancelled"
    for action in ("start", "pause", "resume", "checkpoint"):
        reply = daemon.ask("POST", f"/v1/runs/{name}:{action}", status=409)
        assert "cancelled" in reply.json["detail"]
    daemon.ask("POST", f"/v1/runs/{name}:step", {"steps": 1}, status=409)
    daemon.away(name)


def test_actions_on_a_completed_run_name_its_state(daemon, name):
    daemon.create(water(time={"end": 0.01}), id=name)
    before = daemon.wait(name, "completed")
    for action in ("start", "pause", "resume", "cancel"):
        reply = daemon.ask("POST", f"/v1/runs/{name}:{action}", status=409)
        assert "completed" in reply.json["detail"], reply
    assert "completed" in daemon.ask("POST", f"/v1/runs/{name}:step", {"steps": 1}, status=409).json["detail"]
    assert daemon.run(name) == before
    daemon.away(name)


def test_queue_waits_for_a_slot_that_a_pause_gives_back(daemon):
    first, second, third = (daemon.create(endless())["id"] for _ in range(3))
    daemon.wait_step(first, 1)
    daemon.wait_step(second, 1)
    waiting = daemon.run(third)
    assert (waiting["state"], waiting["step"]) == ("queued", 0)
    daemon.act(first, "pause")
    daemon.wait_step(third, 1)
    assert daemon.act(first, "resume")["state"] == "queued"
    assert daemon.act(first, "pause")["state"] == "paused"
    assert daemon.act(first, "resume")["state"] == "queued"
    assert daemon.act(first, "cancel")["state"] == "cancelled"
    daemon.away(first, second, third)


# ---- What a run says of itself ----


def test_performance_of_a_completed_run_adds_up(daemon, name):
    daemon.create(water(time={"end": 1.0}), id=name)
    run = daemon.wait(name, "completed")
    performance = run["performance"]
    assert performance["wall_s"] > 0
    assert performance["bytes_per_particle"] > 0
    assert performance["particle_steps_per_s"] == pytest.approx(
        run["particles"] * run["step"] / performance["wall_s"], rel=0.5
    )
    phases = performance["phases"]
    assert phases and all(seconds >= 0 for seconds in phases.values())
    inside = sum(seconds for phase, seconds in phases.items() if phase != "waiting")
    assert inside == pytest.approx(performance["wall_s"], rel=0.02)
    assert daemon.run(name)["performance"] == performance, "exact once ended"
    daemon.away(name)


@pytest.mark.skipif(not os.environ.get("FBARD_LONG"), reason="a timing: needs FBARD_LONG=1")
def test_phases_leave_little_unnamed(daemon, name):
    daemon.create(big(time={"end": 0.1}), id=name)
    performance = daemon.wait(name, "completed")["performance"]
    assert performance["phases"]["other"] <= 0.02 * performance["wall_s"]
    daemon.away(name)


def test_wall_time_stands_still_while_paused(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait_step(name, 100)
    wall = daemon.act(name, "pause")["performance"]["wall_s"]
    assert wall > 0
    time.sleep(0.3)
    assert daemon.run(name)["performance"]["wall_s"] == wall
    daemon.act(name, "resume")
    until(lambda: daemon.run(name)["performance"]["wall_s"] > wall)
    daemon.away(name)


def test_a_kept_run_object_is_told_only_while_nothing_has_changed(daemon, name):
    path, recorder = f"/v1/runs/{name}", f"/v1/runs/{name}/recorders/somebody"
    daemon.create(endless(), id=name, start=False)
    daemon.settle(name)
    seen = daemon.get(path)
    assert daemon.get(path) == seen == next(r for r in daemon.get("/v1/runs")["runs"] if r["id"] == name)
    daemon.ask("PUT", recorder, {"acked": -1})
    assert [r["name"] for r in daemon.get(path)["recorders"]] == ["somebody"]
    daemon.ask("DELETE", recorder)
    assert daemon.get(path) == seen
    daemon.patch(name, {"time": {"end": 50}})
    changed = daemon.get(path)
    assert (changed["revision"], changed["end_time"], len(changed["changes"])) == (1, 50, 1)
    for step in range(1, 6):
        daemon.act(name, "step", {"steps": 1})
        now = until(lambda: (r := daemon.get(path))["step"] == step and r["state"] == "paused" and r)
        assert daemon.get(path) == now
    assert now["journal"]["frames"] == len(daemon.frames(name))
    daemon.away(name)


def test_progress_and_eta_while_running(daemon, name):
    daemon.create(endless(time={"end": 100}), id=name)
    run = until(lambda: (r := daemon.run(name))["eta_s"] is not None and r)
    assert run["eta_s"] > 0 or run["state"] in FINAL
    assert run["progress"] == pytest.approx(run["time"] / 100, abs=0.02)
    daemon.away(name)


def test_balance_of_water_at_rest(daemon, name):
    daemon.create(water(), id=name, start=False)
    at_rest = until(lambda: (r := daemon.run(name))["balance"]["mass"] and r)["balance"]
    assert at_rest["mass"] == pytest.approx(WATER_MASS, rel=1e-12)
    assert at_rest["kinetic_energy"] == 0
    assert all(abs(p) == 0 for p in at_rest["momentum"])
    assert len(at_rest["momentum"]) in (2, 3)
    daemon.act(name, "resume")
    balance = daemon.wait(name, "completed")["balance"]
    assert balance["mass"] == pytest.approx(WATER_MASS, rel=1e-12)
    assert balance["kinetic_energy"] > 0
    assert balance["strain_energy"] >= 0
    assert balance["external_work"] > 0, "gravity has done work on what fell"
    daemon.away(name)


def test_probes_of_a_run_are_the_latest(daemon, name):
    daemon.create(water(), id=name)
    probes = daemon.wait(name, "completed")["probes"]
    assert set(probes) == {"front", "energy", "momentum", "middle"}
    assert isinstance(probes["front"], float) and 0.9 < probes["front"] < 2
    last = daemon.csv(name).splitlines()[-1].split(",")
    assert float(last[0]) == WATER_STEPS
    columns = daemon.csv(name).splitlines()[0].split(",")
    assert float(last[columns.index("front")]) == probes["front"]
    daemon.away(name)


def test_accuracy_compares_each_reference(daemon, name):
    references = [
        {"probe": "front", "at": "end", "value": 1.0, "tolerance": 0.5, "source": "a guess"},
        {"probe": "middle", "component": "y", "at": 0.05, "value": -0.01, "tolerance": 0.5, "source": "another"},
    ]
    daemon.create(water(references=references, output={"probe_interval": 0.01}), id=name)
    accuracy = daemon.wait(name, "completed")["accuracy"]
    assert [(a["probe"], a["reference"], a["source"]) for a in accuracy] == [
        ("front", 1.0, "a guess"), ("middle", -0.01, "another")]  # fmt: skip
    for entry in accuracy:
        expected = (entry["value"] - entry["reference"]) / abs(entry["reference"])
        assert abs(entry["relative_error"]) == pytest.approx(abs(expected), rel=1e-9)
    assert accuracy[0]["value"] == daemon.run(name)["probes"]["front"]
    rows = [line.split(",") for line in daemon.csv(name).splitlines()]
    column = rows[0].index("middle.y")
    (at,) = [float(r[column]) for r in rows[1:] if r[0] == "50"]
    assert accuracy[1]["value"] == pytest.approx(at, rel=1e-12)
    daemon.away(name)


def test_accuracy_of_an_error_is_the_error(daemon, name):
    scene = daemon.get("/v1/scenes/hydrostatic-column")
    error = {"probe": "pressure_error", "at": "end", "value": 0, "tolerance": 0.5, "source": "exact"}
    cited = {"probe": "energy", "component": "total", "at": 0.05, "tolerance": 1,
             "value": {"table": "tube_free_radial_oscillation", "column": "a"}}  # fmt: skip
    daemon.create({**scene, "time": {"end": 0.1}, "references": [error, cited]}, id=name)
    run = daemon.wait(name, "completed")
    of_error, of_table = run["accuracy"]
    assert of_error["value"] == run["probes"]["pressure_error"] > 0
    assert of_error["relative_error"] == of_error["value"]
    assert of_table["reference"] == pytest.approx(1.18861967672, rel=1e-12)
    assert daemon.get(f"/v1/runs/{name}/scene")["references"][1]["value"]["column"] == "a"
    daemon.away(name)


def test_accuracy_is_there_before_its_time_has_come(daemon, name):
    reference = {"probe": "front", "at": 0.05, "value": 1.0, "tolerance": 0.5, "source": "s"}
    daemon.create(water(references=[reference]), id=name, start=False)
    (entry,) = daemon.run(name)["accuracy"]
    assert (entry["value"], entry["relative_error"]) == (None, None)
    daemon.away(name)


def test_warnings_tell_of_fbar_on_a_compressible_material(daemon, name):
    run = daemon.create(endless(fbar=True), id=name, start=False)
    assert any("bar" in str(warning) for warning in run["warnings"])
    daemon.away(name)


def test_scene_as_run_has_overrides_and_defaults(daemon, name):
    daemon.create(water(walls={"left": {"condition": None}}), overrides={"basis": "bspline2", "fbar": False},
                  id=name, start=False)  # fmt: skip
    scene = daemon.get(f"/v1/runs/{name}/scene")
    assert (scene["basis"], scene["fbar"]) == ("bspline2", False)
    assert scene["walls"]["left"]["condition"] == "slip"
    assert scene["transfer"] == {"scheme": "flip", "blend": 1}
    assert scene["output"]["probe_interval"] == pytest.approx(0.1 / 500)
    assert scene["output"]["when_full"] == "block"
    daemon.away(name)


def test_scene_as_run_posted_back_gives_the_same_run(daemon, name):
    daemon.create(water(), id=name)
    daemon.wait(name, "completed")
    twin = daemon.create(daemon.get(f"/v1/runs/{name}/scene"))["id"]
    daemon.wait(twin, "completed")
    assert daemon.csv(twin) == daemon.csv(name)
    daemon.away(name, twin)


def test_negative_time_before_the_last_stage(daemon, name):
    stages = [{"name": "settle", "duration": 0.02, "damping": {"local": 0.5}}, {"name": "flow"}]
    run = daemon.create(water(stages=stages), id=name, start=False)
    assert run["time"] == pytest.approx(-0.02)
    run = daemon.wait(name, "paused")
    daemon.act(name, "resume")
    run = daemon.wait(name, "completed")
    assert run["step"] == 120
    assert run["time"] == pytest.approx(0.1, rel=1e-9)
    daemon.away(name)


# ---- Failures ----


def check_error(run):
    error = run["error"]
    assert {"kind", "step", "time", "particle", "quantity", "value", "advice"} <= set(error)
    assert error["kind"] and error["advice"]
    assert isinstance(error["step"], int) and 0 <= error["step"]
    assert error["time"] == pytest.approx(run["time"], abs=0.05 + abs(run["time"]))
    return error


def test_particle_outside_the_domain_fails_the_run(daemon, name):
    daemon.create(escaping(), id=name)
    run = check_run(daemon.wait(name, "failed"))
    error = check_error(run)
    assert isinstance(error["particle"], int) and error["particle"] >= 0
    assert error["quantity"]
    assert run["progress"] < 1
    # (2 m - 1 m) / (10 m/s) after 0.1 s
    assert error["time"] == pytest.approx(0.1, abs=0.02)
    index = daemon.frames(name)
    assert len(index) > 2, "its last good frame is kept"
    assert "failed" in daemon.ask("POST", f"/v1/runs/{name}:resume", status=409).json["detail"]
    daemon.ask("DELETE", f"/v1/runs/{name}", status=204)


def test_unstable_dt_fails_the_run_where_it_was_asked_for(daemon, name):
    scene = water(unstable_ok=True, time={"dt": 0.02, "end": 100}, bodies={"pool": {"velocity": [1, 0.5]}})
    daemon.create(scene, id=name)
    run = daemon.wait(name, "failed")
    assert math.isfinite(check_error(run)["time"])
    daemon.away(name)


# ---- Deletion ----


def test_delete_removes_run_and_files(daemon, name):
    daemon.create(water(time={"end": 0.01}), id=name)
    daemon.wait(name, "completed")
    assert [p for p in daemon.data.rglob("*") if name in str(p)]
    reply = daemon.ask("DELETE", f"/v1/runs/{name}", status=204)
    assert reply.body == b""
    for path in ("", "/scene", "/config", "/probes", "/frames", "/frames/latest"):
        daemon.ask("GET", f"/v1/runs/{name}{path}", status=404)
    daemon.ask("DELETE", f"/v1/runs/{name}", status=404)
    daemon.ask("POST", f"/v1/runs/{name}:start", status=404)
    assert not [p for p in daemon.data.rglob("*") if name in str(p)]
    daemon.create(water(), id=name, start=False)  # the id is free again
    daemon.away(name)


def test_delete_of_an_unfinished_run_is_409(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait_step(name, 1)
    assert "running" in daemon.ask("DELETE", f"/v1/runs/{name}", status=409).json["detail"]
    daemon.act(name, "pause")
    assert "paused" in daemon.ask("DELETE", f"/v1/runs/{name}", status=409).json["detail"]
    assert daemon.act(name, "resume")["state"] == "running"
    daemon.away(name)


def test_runs_that_come_and_go_leave_nothing_behind(daemon):
    def cycle():
        run = daemon.create(water(time={"end": 0.005}))["id"]
        daemon.wait(run, "completed")
        daemon.away(run)

    for _ in range(5):
        cycle()
    threads, descriptors = daemon.n_threads(), daemon.descriptors()
    for _ in range(30):
        cycle()
    until(lambda: daemon.n_threads() <= threads + 1 and daemon.descriptors() <= descriptors + 3)
    known = {r["id"] for r in daemon.get("/v1/runs")["runs"]}
    assert {p.name for p in (daemon.data / "runs").iterdir()} == known


# ---- Creation that may be sent twice ----


def keyed(daemon, key, body, status=201):
    return daemon.ask("POST", "/v1/runs", body, {"Idempotency-Key": key}, status=status)


def test_creation_with_a_key_makes_one_run(daemon, name):
    body = {"scene": water(), "start": False}
    first = keyed(daemon, name, body)
    assert "idempotency-replayed" not in first.headers
    run = first.json["id"]
    daemon.act(run, "step", {"steps": 3})
    daemon.wait(run, "paused")
    again = keyed(daemon, name, body)
    assert again.headers["idempotency-replayed"] == "true"
    assert again.headers["location"] == first.headers["location"] == f"/v1/runs/{run}"
    assert (again.json["id"], again.json["step"]) == (run, 3), "the run as it is now"
    assert [r["id"] for r in daemon.get("/v1/runs")["runs"]].count(run) == 1
    fault = keyed(daemon, name, {**body, "start": True}, 422).fault("")
    assert fault["code"] == "idempotency_key" and run in fault["detail"]
    assert keyed(daemon, name + "x", {**body, "id": run}, 409), "another key does not excuse a taken id"
    daemon.away(run)
    other = keyed(daemon, name, body).json["id"]
    daemon.away(other)


def test_creation_with_a_key_is_remembered_over_kill_9(fresh, name):
    d = fresh()
    d.start()
    body = {"scene": water(), "id": name, "start": False}
    keyed(d, "once", body)
    d.kill()
    d.start()
    assert keyed(d, "once", body).headers["idempotency-replayed"] == "true"
    d.ask("POST", "/v1/runs", body, status=409)
    keyed(d, "once", {**body, "id": name + "x"}, 422)


def test_creation_with_a_key_by_many_at_once(daemon, name):
    import concurrent.futures

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        runs = list(pool.map(lambda _: keyed(daemon, name, {"scene": water(), "start": False}).json["id"], range(8)))
    assert len(set(runs)) == 1
    daemon.away(runs[0])


@pytest.mark.parametrize("bad", ["", "a b", "é", "x" * 256])
def test_creation_with_a_bad_key_is_refused(daemon, bad):
    reply = daemon.ask("POST", "/v1/runs", {"scene": water()}, {"Idempotency-Key": bad.encode()}, status=400)
    assert "Idempotency-Key" in reply.json["detail"]


def test_list_can_be_narrowed_and_paged(fresh):
    d = fresh().start()
    made = [d.create(water(time={"end": 0.01}), id=f"r{k}", start=k % 2 == 0)["id"] for k in range(7)]
    for run in made[::2]:
        d.wait(run, "completed")

    def listed(query):
        answer = d.get("/v1/runs" + query)
        return [r["id"] for r in answer["runs"]], answer.get("older", 0)

    assert listed("") == (made, 0)
    assert listed("?state=paused") == (made[1::2], 0)
    assert listed("?state=completed,paused&limit=3") == (made[4:], 4)
    assert listed("?state=failed") == ([], 0) and listed("?limit=0") == ([], 7)
    pages, before = [], ""
    while not pages or before:
        page, older = listed("?limit=3" + before)
        pages = page + pages
        before = f"&before={page[0]}" if older else ""
    assert pages == made
    for bad in ("?state=gone", "?state=", "?limit=-1", "?limit=many", "?before=nobody", "?before="):
        d.ask("GET", "/v1/runs" + bad, status=400)
