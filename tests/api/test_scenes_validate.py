"""Built-in scenes, materials, the scene's JSON Schema, validation and its cost estimate."""
import json

import jsonschema
import pytest
from boxes import WATER_PARTICLES, endless, merged, water
from fbard import ROOT, Daemon

BUILTIN = sorted(p.stem for p in (ROOT / "scenes").glob("*.json"))


def estimate(answer):
    """The numbers may stand in the answer itself or in its `estimate`."""
    numbers = answer.get("estimate", answer)
    for key in ("particles", "nodes", "dt", "steps", "bytes"):
        assert numbers[key] > 0, key
    return numbers


def validate(daemon, scene, status=200):
    return daemon.ask("POST", "/v1/scenes:validate", scene, status=status)


def test_list_names_every_builtin(daemon):
    listed = daemon.get("/v1/scenes")["scenes"]
    names = [s if isinstance(s, str) else s["name"] for s in listed]
    assert sorted(names) == BUILTIN
    assert "dam-break" in names


def test_materials_list_their_parameters(daemon):
    models = {m["name"]: m for m in daemon.get("/v1/materials")["materials"]}
    assert {"neo_hookean", "newtonian"} <= set(models)
    water_keys = {p.get("key", p.get("name")) for p in models["newtonian"]["parameters"]}
    assert {"density", "bulk_modulus", "viscosity"} <= water_keys
    for model in models.values():
        for parameter in model["parameters"]:
            assert parameter["unit"]


@pytest.mark.parametrize("scene", BUILTIN)
def test_builtin_is_the_bare_file_and_valid(daemon, scene):
    bare = daemon.get(f"/v1/scenes/{scene}")
    assert bare == json.loads((ROOT / "scenes" / f"{scene}.json").read_text())
    estimate(validate(daemon, bare).json)


@pytest.mark.parametrize("scene", BUILTIN)
def test_builtin_fits_the_schema(daemon, scene):
    schema = daemon.get("/v1/schemas/scene.json")
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(daemon.get(f"/v1/scenes/{scene}"))


@pytest.mark.parametrize("scene", BUILTIN)
def test_builtin_runs_posted_back_or_by_name(daemon, scene):
    by_name = daemon.create(scene, start=False)
    inline = daemon.create(daemon.get(f"/v1/scenes/{scene}"), start=False)
    as_run = [daemon.get(f"/v1/runs/{r['id']}/scene") for r in (by_name, inline)]
    assert as_run[0] == as_run[1]
    for run in (by_name, inline):
        daemon.act(run["id"], "step", {"steps": 3})
    for run in (by_name, inline):
        assert daemon.wait(run["id"], "paused")["step"] == 3
    daemon.away(by_name["id"], inline["id"])


@pytest.mark.parametrize("scene", BUILTIN)
def test_scene_as_run_fits_the_schema_and_is_valid(daemon, scene):
    run = daemon.create(scene, start=False)["id"]
    as_run = daemon.get(f"/v1/runs/{run}/scene")
    jsonschema.Draft202012Validator(daemon.get("/v1/schemas/scene.json")).validate(as_run)
    validate(daemon, as_run)
    daemon.away(run)


def test_dam_break_costs_what_the_paper_says(daemon):
    numbers = estimate(validate(daemon, daemon.get("/v1/scenes/dam-break")).json)
    assert numbers["particles"] == 3200
    assert numbers["dt"] == 1e-5
    # the paper's 200,000 steps of 1e-5 s to t = 2 s, and the settling before
    assert 200_000 <= numbers["steps"] <= 215_000
    assert 3200 * 50 < numbers["bytes"] < 1e9


def test_validate_counts_what_a_run_then_does(daemon, name):
    numbers = estimate(validate(daemon, water()).json)
    assert (numbers["particles"], numbers["steps"], numbers["dt"]) == (WATER_PARTICLES, 100, 1e-3)
    run = daemon.create(water(), id=name)
    assert run["particles"] == WATER_PARTICLES
    daemon.away(name)


def test_validate_takes_scene_and_overrides(daemon):
    body = {"scene": water(), "overrides": {"cell": 0.125, "bodies": {"pool": {"particles_per_cell": 4}}}}
    assert estimate(validate(daemon, body).json)["particles"] == 8 * 8 * 4
    body = {"scene": "dam-break", "overrides": {"bodies": {"reservoir": {"particles_per_cell": 4}}}}
    assert estimate(validate(daemon, body).json)["particles"] == 16 * 8 * 4
    reply = validate(daemon, {"scene": water(), "overrides": {"cell": -1}}, 422)
    assert any(p.endswith("/cell") for p in reply.pointers)


def test_overrides_are_a_merge_patch(daemon, name):
    overrides = {"materials": {"water": {"bulk_modulus": 1e6}}, "walls": {"right": None}, "basis": "bspline2",
                 "probes": {"front": None, "drift": {"kind": "drift"}}}  # fmt: skip
    daemon.create(water(), overrides=overrides, id=name, start=False)
    scene = daemon.get(f"/v1/runs/{name}/scene")
    assert scene["materials"]["water"]["bulk_modulus"] == 1e6
    assert scene["materials"]["water"]["density"] == 997.5
    assert set(scene["walls"]) == {"left", "floor"}
    assert set(scene["probes"]) == {"energy", "momentum", "middle", "drift"}
    daemon.away(name)


def test_estimate_grows_with_the_scene(daemon):
    coarse = estimate(validate(daemon, water()).json)
    fine = estimate(validate(daemon, water(cell=0.125)).json)
    assert fine["particles"] == 4 * coarse["particles"]
    assert fine["nodes"] > coarse["nodes"]
    assert fine["bytes"] > coarse["bytes"]


def test_three_dimensions(daemon, name):
    scene = {
        "format": "fbard-scene-1", "dimension": 3, "domain": {"min": [-1, -1, -1], "max": [2, 2, 2]}, "cell": 0.25,
        "basis": "bspline2", "time": {"end": 0.01, "dt": 1e-3}, "gravity": [0, 0, -9.81],
        "materials": {"jelly": {"model": "neo_hookean", "density": 1000, "youngs_modulus": 1e5, "poisson_ratio": 0.3}},
        "bodies": {"cube": {"material": "jelly", "shape": {"box": {"min": [0, 0, 0], "max": [0.5, 0.5, 0.5]}},
                            "particles_per_cell": 8}},
        "walls": {"floor": {"axis": "z", "at": 0, "keeps": "above", "condition": "slip"}},
        "probes": {"momentum": {"kind": "momentum"}},
    }  # fmt: skip
    assert estimate(validate(daemon, scene).json)["particles"] == 64
    daemon.create(scene, id=name)
    run = daemon.wait(name, "completed")
    assert run["balance"]["mass"] == pytest.approx(125, rel=1e-12)
    assert len(run["balance"]["momentum"]) == 3 and run["balance"]["momentum"][2] < 0
    assert daemon.csv(name).splitlines()[0] == "step,time,momentum.x,momentum.y,momentum.z"
    daemon.away(name)


def test_scene_of_no_such_name_is_404_to_read_and_422_to_run(daemon):
    daemon.ask("GET", "/v1/scenes/dam-brake", status=404)
    reply = daemon.ask("POST", "/v1/runs", {"scene": "dam-brake"}, status=422)
    assert "dam-break" in reply.fault("/scene")["detail"], "did you mean"


def test_a_scene_beyond_the_memory_limit_is_422_before_anything_is_allocated(tmp_path):
    d = Daemon(tmp_path, "--memory-limit", "100M").start()
    try:
        huge = merged(endless(), {"bodies": {"bar": {"particles_per_cell": 1000000}}})
        before = d.memory()
        reply = d.ask("POST", "/v1/runs", {"scene": huge}, status=422)
        assert reply.json["errors"]
        assert d.memory() < before + 50e6
        assert d.get("/v1/runs")["runs"] == []
    finally:
        d.stop()


def test_faults_of_keys_and_of_the_solver_come_at_once(daemon):
    overrides = {"foo": 1, "time": {"dt": 1e-2},
                 "bodies": {"reservoir": {"shape": {"box": {"min": [-1, 0], "max": [4, 2]}}}}}  # fmt: skip
    reply = validate(daemon, {"scene": "dam-break", "overrides": overrides}, 422)
    assert {"/scene/foo", "/scene/time/dt", "/scene/bodies/reservoir/shape"} <= set(reply.pointers)


def test_validate_warns_as_the_run_does(daemon, name):
    scene = endless(fbar=True)
    warnings = validate(daemon, scene).json["warnings"]
    assert warnings and "compressible" in warnings[0]
    assert daemon.create(scene, id=name, start=False)["warnings"] == warnings
    assert validate(daemon, water()).json["warnings"] == []
    daemon.away(name)


def test_a_field_or_an_end_that_no_run_can_give_is_a_fault(daemon):
    reply = validate(daemon, water(output={"fields": ["plastic_strain"]}), 422)
    assert reply.fault("/output/fields/0")["actual"] == '"plastic_strain"'
    assert "steps" in validate(daemon, water(time={"end": 1e300}), 422).fault("/time/end")["detail"]
