"""Built-in scenes, materials, the scene's JSON Schema, validation and its cost estimate."""
import json
import math
import resource

import jsonschema
import pytest
from boxes import WATER_PARTICLES, endless, merged, water
from fbard import ROOT, Daemon, is_sanitized

FILES = {p.stem: p for p in (ROOT / "scenes").glob("*.json")}
FILES |= {f"hard-{p.stem}": p for p in (ROOT / "scenes" / "hard").glob("*.json")}
BUILTIN = sorted(FILES)


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
    assert bare == json.loads(FILES[scene].read_text())
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
    fault = reply.fault("/scene")
    assert "dam-break" in fault["detail"], "did you mean"
    names = [scene["name"] for scene in daemon.get("/v1/scenes")["scenes"]]
    assert fault["expected"] == "one of " + ", ".join(names), "all of them, not cut"


def test_a_scene_costs_what_its_smooth_mean_stress_takes(daemon):
    """By frames or by a probe: a number a particle at least, and two places of 32 bytes a node that is reached."""
    probe = {"probes": {"smooth": {"kind": "mean", "field": "mean_stress_smooth", "body": "reservoir"}}}
    bytes_of = lambda patch: estimate(validate(daemon, {"scene": "dam-break", "overrides": patch}).json)["bytes"]
    plain = bytes_of({"output": {"fields": ["position", "mean_stress"]}})
    reached = 18 * 10  # nodes around 16 x 8 cells of water
    for patch in ({"output": {"fields": ["position", "mean_stress_smooth"]}}, merged(probe, {"output": {"fields": ["position", "mean_stress"]}})):
        assert 8 * 3200 + 64 * reached <= bytes_of(patch) - plain < 8 * 3200 + 1e6


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


def stars(count, corners):
    """Polygons in polygons, each with many corners."""
    def star(k):
        def radius(i):
            return 0.4 * (1 - 0.004 * k) * (1 + 0.05 * math.sin(14 * math.pi * i / corners + 0.1 * k) + 0.02 * (i % 2))
        return [[round(0.5 + radius(i) * math.cos(2 * math.pi * i / corners), 6),
                 round(0.5 + radius(i) * math.sin(2 * math.pi * i / corners), 6)] for i in range(corners)]  # fmt: skip
    return [{"polygon": {"points": star(k)}} for k in range(count)]


def fine(shape):
    """Over 8 million lattice points where the shape fills the domain."""
    return merged(endless(), {"domain": {"min": [0, 0], "max": [1, 1]}, "cell": 1 / 180, "walls": None, "time": {"dt": None},
                              "bodies": {"bar": {"shape": shape, "particles_per_cell": 256, "velocity": None}}})  # fmt: skip


def seconds_of_children():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.skipif(is_sanitized(), reason="counts the processor's time")
def test_many_polygons_of_many_corners_take_the_time_of_points_and_corners(tmp_path):
    d = Daemon(tmp_path, "--memory-limit", "8G").start()
    before = seconds_of_children()
    reply = validate(d, fine({"box": None, "intersection": stars(100, 900)}))
    assert 1e6 < reply.json["estimate"]["particles"] < 4e6
    d.stop()
    # 1 s of the processor; 86 s when each point was held against the edges of its band in each polygon.
    assert seconds_of_children() - before < 20


@pytest.mark.skipif(is_sanitized(), reason="counts the processor's time")
def test_a_scene_that_would_take_too_long_to_check_is_422_at_once(tmp_path):
    d = Daemon(tmp_path, "--memory-limit", "8G").start()
    before = seconds_of_children()
    boxes = [{"box": {"min": [0, 0], "max": [1, 1 - k / 10000]}} for k in range(1000)]
    for path, scene in (("/v1/scenes:validate", fine({"box": None, "union": boxes})),
                        ("/v1/runs", {"scene": fine({"box": None, "union": boxes})})):  # fmt: skip
        fault = d.ask("POST", path, scene, status=422).fault("" if "scene" not in scene else "/scene")
        assert fault["code"] == "work" and "2e+10" in fault["expected"], fault
    d.stop()
    assert seconds_of_children() - before < 5  # where nothing is filled it is 0.1 s


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


# What a scene of the paper can get wrong: refused before anything runs, with the place, what was expected and what came.
# (scene, overrides, pointer in the scene, code, in `expected`, in `actual` or the detail)
SHAPE_OUT = {"polygon": {"points": [[0, 0], [60, 44], [60, 60], [0, 44]]}}
BOW_TIE = {"polygon": {"points": [[0, 0], [48, 60], [48, 44], [0, 44]]}}
TWIN = {"material": "rubber", "shape": {"disk": {"center": [0.35, 0.3], "radius": 0.2}}, "particles_per_cell": 4}
STAGES = [{"name": "gravity", "duration": 0.1}, {"name": "slide", "materials": {"clay": {"yield_strength": 2e3}}}]
BAD = {
    "rigid_body_inside": ("strip-footing-small", {"rigid_bodies": {"footing": {"shape": {"box": {"min": [-0.5, 1.3]}}}}},
                          "/rigid_bodies/footing/shape", "conflict", "outside body 'soil'", "640 particles"),
    "load_of_nothing": ("cook-membrane", {"loads": {"shear": {"select": {"extreme": None, "box": {
                            "min": [49, 0], "max": [50, 66]}}}}},
                        "/loads/shear/select", "empty", "at least one particle", "0"),
    "unknown_wall": ("dam-break", {"stages": [{"name": "a", "remove": {"walls": ["gaet"]}}]},
                     "/stages/0/remove/walls/0", "unknown_name", "walls", "gaet"),
    "unknown_load": ("cook-membrane", {"stages": [{"name": "a", "remove": {"loads": ["sheer"]}}]},
                     "/stages/0/remove/loads/0", "unknown_name", "loads", "sheer"),
    "unknown_rigid_body": ("strip-footing", {"stages": [{"name": "a", "remove": {"rigid_bodies": ["foot"]}}]},
                           "/stages/0/remove/rigid_bodies/0", "unknown_name", "rigid_bodies", "foot"),
    "polygon_meets_itself": ("cook-membrane", {"bodies": {"membrane": {"shape": BOW_TIE}}},
                             "/bodies/membrane/shape/polygon/points", "conflict", "do not meet", "corners 0 and 2"),
    "bodies_overlap": ("disk-collision", {"bodies": {"twin": TWIN}},
                       "/bodies/twin/shape", "conflict", "overlap", "particles"),
    "shape_outside": ("cook-membrane", {"bodies": {"membrane": {"shape": SHAPE_OUT}}},
                      "/bodies/membrane/shape", "range", "inside the domain", "572 of 7204"),
    "nu_one_half": ("cook-membrane", {"materials": {"rubber": {"poisson_ratio": 0.5}}},
                    "/materials/rubber/poisson_ratio", "range", "< 0.5", "0.5"),
    "nu_one_half_plastic": ("landslide", {"materials": {"clay": {"poisson_ratio": 0.5}}},
                            "/materials/clay/poisson_ratio", "range", "< 0.5", "0.5"),
    "residual_above_peak": ("landslide-slice", {"materials": {"clay": {"residual_strength": 6e4}}},
                            "/materials/clay/residual_strength", "conflict", "exceed yield_strength", "60000"),
    "residual_above_patched_peak": ("landslide-slice", {"stages": STAGES},
                                    "/stages/1/materials/clay/residual_strength", "conflict",
                                    "exceed yield_strength", "3000"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_scene_is_refused_with_place_and_reason(daemon, case):
    scene, overrides, pointer, code, expected, actual = BAD[case]
    reply = validate(daemon, {"scene": scene, "overrides": overrides}, 422)
    fault = reply.fault("/scene" + pointer)
    assert fault["code"] == code and expected in fault["expected"] + fault["detail"]
    assert actual in f"{fault['actual']} {fault['detail']}"
    create = daemon.ask("POST", "/v1/runs", {"scene": scene, "overrides": overrides}, status=422)
    assert create.fault("/scene" + pointer)["code"] == code


def test_a_run_whose_volume_drifts_is_warned_of(daemon, name):
    # Cook's membrane in coarse cells under a load that stretches it: 0.18 of drift after 4 s (docs/method.md, section 3).
    overrides = {"cell": 2, "damping": {"mass": 0}, "loads": {"shear": {"force": [0, 120]}}, "references": [],
                 "time": {"end": 4}, "probes": {"pressure_error": None, "displacement_error": None}}  # fmt: skip
    for scheme, warned in (("zhao", True), ("anchored", False)):
        overrides["fbar"] = {"scheme": scheme}
        run = daemon.ask("POST", "/v1/runs", {"id": f"{name}-{scheme}", "scene": "cook-membrane", "overrides": overrides},
                         status=201).json  # fmt: skip
        run = daemon.wait(run["id"], "completed")
        assert any("drifted" in w for w in run["warnings"]) == warned, (scheme, run["warnings"], run["probes"]["drift"])
        assert warned == (run["probes"]["drift"] > (0.0045 if scheme == "zhao" else 0.05))
        daemon.away(run["id"])
