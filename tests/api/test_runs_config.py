"""What may change while a run goes on."""
import pytest
from boxes import endless, water
from fbard import Daemon, fbar_is_on, until
from frames import Frame


@pytest.fixture(scope="module")
def live(daemon):
    run = daemon.create(endless())["id"]
    daemon.wait_step(run, 1)
    yield run
    daemon.away(run)


def test_config_shows_what_can_be_patched(daemon, live):
    config = daemon.get(f"/v1/runs/{live}/config")
    for key in ("fbar", "damping", "transfer", "time", "output", "gravity"):
        assert key in config, key
    assert config["time"]["end"] == 1e6
    assert config["time"]["dt"] == 1e-3
    for key in ("materials", "bodies", "walls", "cell", "basis"):
        assert key not in config


def test_fbar_toggles_in_mid_run(daemon, live):
    for form in (True, False, {"scheme": "anchored", "a": 0.05, "C": 1}, {"scheme": "anchored", "keep": 0.1}, {"scheme": "zhao"}, False):
        before = daemon.run(live)["step"]
        answer = daemon.patch(live, {"fbar": form})
        assert answer["effective_step"] >= before
        run = daemon.run(live)
        assert run["state"] == "running"
        assert run["step"] >= answer["effective_step"]
        assert fbar_is_on(run) == bool(form)
        config = daemon.get(f"/v1/runs/{live}/config")["fbar"]
        assert bool(config) == bool(form)
        if isinstance(form, dict) and form["scheme"] == "anchored":
            assert (config["scheme"], config["a"], config["C"], config["keep"]) == ("anchored", 0.05, 1, form.get("keep", 0))
        assert daemon.get(f"/v1/runs/{live}/scene")["fbar"] == config


def test_patch_takes_both_content_types(daemon, live):
    for kind in ("application/json", "application/merge-patch+json", "application/json; charset=utf-8",
                 "Application/JSON"):  # fmt: skip
        reply = daemon.ask("PATCH", f"/v1/runs/{live}/config", {"damping": {"mass": 0}}, {"Content-Type": kind})
        assert "effective_step" in reply.json
    for kind in ("text/plain", "application/xml", "application/x-www-form-urlencoded"):
        daemon.ask("PATCH", f"/v1/runs/{live}/config", {"damping": {"mass": 1}}, {"Content-Type": kind}, status=415)
    assert daemon.get(f"/v1/runs/{live}/config")["damping"]["mass"] == 0


def test_damping_blend_gravity_and_output_are_settable(daemon, live):
    patch = {"damping": {"local": 0.1, "mass": 2}, "transfer": {"blend": 0.9}, "gravity": [0, -0.001],
             "output": {"interval": 2e5}}  # fmt: skip
    daemon.patch(live, patch)
    config = daemon.get(f"/v1/runs/{live}/config")
    assert config["damping"] == {"local": 0.1, "mass": 2}
    assert config["transfer"]["blend"] == 0.9
    assert config["gravity"] == [0, -0.001]
    assert config["output"]["interval"] == 2e5
    daemon.patch(live, {"damping": {"local": 0, "mass": 0}, "transfer": {"blend": 1}, "gravity": [0, 0]})


def test_dt_and_cfl_replace_each_other(daemon, live):
    daemon.patch(live, {"time": {"cfl": 0.2, "dt": None}})
    until(lambda: daemon.run(live)["dt"] == pytest.approx(0.2 * 0.25 / 10, rel=0.05))
    config = daemon.get(f"/v1/runs/{live}/config")["time"]
    assert config["cfl"] == 0.2
    assert config.get("dt") is None
    daemon.patch(live, {"time": {"dt": 2e-3, "cfl": None}})
    until(lambda: daemon.run(live)["dt"] == 2e-3)
    assert daemon.get(f"/v1/runs/{live}/config")["time"].get("cfl") is None
    daemon.patch(live, {"time": {"dt": 1e-3}})


def test_unstable_dt_is_refused_with_its_limit(daemon, live):
    reply = daemon.ask("PATCH", f"/v1/runs/{live}/config", {"time": {"dt": 1.0}}, status=422)
    fault = reply.fault("/time/dt")
    assert any(c.isdigit() for c in fault["expected"])
    assert "1" in fault["actual"]
    assert daemon.get(f"/v1/runs/{live}/config")["time"]["dt"] == 1e-3
    # So is damping that makes the present one unstable.
    daemon.ask("PATCH", f"/v1/runs/{live}/config", {"damping": {"mass": 1e4}}, status=422).fault("/time/dt")
    assert daemon.get(f"/v1/runs/{live}/config")["damping"]["mass"] == 0
    assert daemon.run(live)["state"] == "running"


@pytest.mark.parametrize(
    "patch, pointer",
    [
        ({"materials": {"bar": {"youngs_modulus": 1}}}, "/materials"),
        ({"cell": 0.5}, "/cell"), ({"basis": "gimp"}, "/basis"), ({"dimension": 3}, "/dimension"),
        ({"bodies": None}, "/bodies"), ({"walls": {"end": None}}, "/walls"), ({"domain": {}}, "/domain"),
        ({"probes": {}}, "/probes"), ({"stages": []}, "/stages"),
        ({"transfer": {"scheme": "apic"}}, "/transfer/scheme"),
        ({"fbarr": True}, "/fbarr"), ({"fbar": "yes"}, "/fbar"), ({"fbar": 1}, "/fbar"),
        ({"fbar": {"scheme": "hao"}}, "/fbar/scheme"),
        ({"damping": {"local": -0.1}}, "/damping/local"), ({"damping": {"local": 1}}, "/damping/local"),
        ({"damping": {"mass": "a"}}, "/damping/mass"), ({"damping": {"lokal": 0.1}}, "/damping/lokal"),
        ({"transfer": {"blend": 1.01}}, "/transfer/blend"),
        ({"gravity": [0]}, "/gravity"), ({"gravity": [0, "g"]}, "/gravity/1"), ({"gravity": [0, 0, 0]}, "/gravity"),
        ({"time": {"dt": 0}}, "/time/dt"), ({"time": {"dt": -1e-3}}, "/time/dt"),
        ({"time": {"cfl": 0, "dt": None}}, "/time/cfl"), ({"time": {"end": -1}}, "/time/end"),
        ({"time": {"end": 1e-9}}, "/time/end"),
        ({"output": {"fields": ["position", "colour"]}}, "/output/fields/1"),
        ({"output": {"interval": 0}}, "/output/interval"),
    ],
)  # fmt: skip
def test_what_may_not_change_is_422_with_its_pointer(daemon, live, patch, pointer):
    before = daemon.get(f"/v1/runs/{live}/config")
    reply = daemon.ask("PATCH", f"/v1/runs/{live}/config", patch, status=422)
    assert any(p == pointer or p.startswith(pointer + "/") for p in reply.pointers), reply
    assert daemon.get(f"/v1/runs/{live}/config") == before
    assert daemon.run(live)["state"] == "running"


def test_all_faults_of_a_patch_come_at_once_and_nothing_of_it_is_done(daemon, live):
    before = daemon.get(f"/v1/runs/{live}/config")
    patch = {"fbar": True, "cell": 1, "damping": {"local": 7, "mass": "x"}, "gravity": [1, 2, 3]}
    reply = daemon.ask("PATCH", f"/v1/runs/{live}/config", patch, status=422)
    assert {"/cell", "/damping/local", "/damping/mass", "/gravity"} <= set(reply.pointers)
    assert daemon.get(f"/v1/runs/{live}/config") == before


@pytest.mark.parametrize("body", [b"", b"{", b'{"fbar": true,}', b'{"fbar": true, "fbar": false}', b'{"fbar": nan}'])
def test_patch_that_is_no_json_is_400(daemon, live, body):
    daemon.ask("PATCH", f"/v1/runs/{live}/config", body, {"Content-Type": "application/json"}, status=400)


@pytest.mark.parametrize("body", [[], 1, "fbar", None, True])
def test_patch_that_is_no_object_is_422(daemon, live, body):
    data = b"null" if body is None else body
    headers = {"Content-Type": "application/json"}
    assert "" in daemon.ask("PATCH", f"/v1/runs/{live}/config", data, headers, status=422).pointers


def test_empty_patch_changes_nothing(daemon, live):
    before = daemon.ask("GET", f"/v1/runs/{live}/config")
    assert "effective_step" in daemon.patch(live, {})
    after = daemon.ask("GET", f"/v1/runs/{live}/config")
    assert after.json == before.json
    assert after.headers["etag"] == before.headers["etag"]


def test_etag_guards_against_a_lost_update(daemon, live):
    path = f"/v1/runs/{live}/config"
    first = daemon.ask("GET", path).headers["etag"]
    assert first.startswith('"') and first.endswith('"')
    assert daemon.ask("GET", path).headers["etag"] == first
    reply = daemon.ask("PATCH", path, {"damping": {"mass": 3}}, {"If-Match": first})
    second = daemon.ask("GET", path).headers["etag"]
    assert second != first
    assert reply.headers.get("etag", second) == second
    daemon.ask("PATCH", path, {"damping": {"mass": 4}}, {"If-Match": first}, status=412)
    assert daemon.get(path)["damping"]["mass"] == 3
    daemon.ask("PATCH", path, {"damping": {"mass": 5}}, {"If-Match": "*"})
    third = daemon.ask("GET", path).headers["etag"]
    daemon.ask("PATCH", path, {"damping": {"mass": 0}}, {"If-Match": f"{first}, {third}"})
    assert daemon.get(path)["damping"]["mass"] == 0
    daemon.ask("PATCH", path, {"damping": {"mass": 1}}, {"If-Match": '"nonsense"'}, status=412)


def test_end_can_be_moved_and_the_run_ends_there(daemon, name):
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"steps": 20})
    daemon.wait(name, "paused")
    reply = daemon.ask("PATCH", f"/v1/runs/{name}/config", {"time": {"end": 0.01}}, status=422)
    assert reply.pointers == ["/time/end"]
    daemon.patch(name, {"time": {"end": 0.04}})
    run = daemon.run(name)
    assert run["end_time"] == 0.04
    assert run["progress"] == pytest.approx(0.5, abs=0.01)
    daemon.act(name, "resume")
    run = daemon.wait(name, "completed")
    assert run["step"] == 40
    assert Frame(daemon.frame(name, "latest")).header["time"] == pytest.approx(0.04)
    daemon.away(name)


def test_patch_shows_in_the_frames_after_its_step(daemon, name):
    daemon.create(water(output={"interval": 0.002}), id=name, start=False)
    daemon.act(name, "step", {"steps": 30})
    daemon.wait(name, "paused")
    assert daemon.patch(name, {"fbar": False})["effective_step"] == 30
    daemon.act(name, "step", {"steps": 30})
    daemon.wait(name, "paused")
    assert daemon.patch(name, {"fbar": {"scheme": "anchored", "a": 0.05, "C": 1}})["effective_step"] == 60
    daemon.act(name, "resume")
    daemon.wait(name, "completed")
    for entry in daemon.frames(name):
        header = Frame(daemon.frame(name, entry["seq"])).header
        if header["step"] not in (30, 60):
            assert header["fbar"] == (not 30 < header["step"] < 60), header["step"]
    daemon.away(name)


def test_patch_of_output_changes_the_frames_that_come(daemon, name):
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"steps": 50})
    daemon.wait(name, "paused")
    daemon.patch(name, {"output": {"interval": 0.002, "fields": ["position", "density"]}})
    daemon.act(name, "resume")
    daemon.wait(name, "completed")
    index = daemon.frames(name)
    assert [f["step"] for f in index] == list(range(0, 51, 10)) + list(range(52, 101, 2))
    assert list(Frame(daemon.frame(name, "latest")).fields) == ["position", "density"]
    assert list(Frame(daemon.frame(name, 0)).fields) == ["position", "velocity", "mean_stress"]
    daemon.away(name)


def test_fields_that_were_not_kept_cannot_be_asked_for_later(daemon, name):
    daemon.create(water(), id=name, start=False)
    patch = {"output": {"fields": ["position", "velocity", "displacement"]}}
    reply = daemon.request("PATCH", f"/v1/runs/{name}/config", patch)
    assert reply.status in (200, 422), reply
    daemon.act(name, "snapshot")
    daemon.away(name)


def test_patch_of_a_queued_run_holds_when_it_starts(daemon):
    runs = [daemon.create(endless())["id"] for _ in range(2)]
    third = daemon.create(water(), start=False)["id"]
    daemon.act(third, "start")
    if daemon.run(third)["state"] == "queued":
        assert daemon.patch(third, {"fbar": False})["effective_step"] == 0
    daemon.away(*runs)
    assert not fbar_is_on(daemon.wait(third, "completed"))
    daemon.away(third)


def test_patch_of_a_run_that_waits_for_its_slot_after_a_restart(fresh):
    """What is possible depends on where it stands, which is known once it is paused or runs."""
    d = fresh(slots=2).start()
    for run in ("a", "b"):
        d.create(endless(output={"interval": 1.0}), id=run)
        d.wait_step(run, 1500)
    d.stop()
    d.slots = 1
    d.start()
    # Both are queued until one has been given the only slot.
    states = until(lambda: (lambda by: "running" in by and by)({r["state"]: r["id"] for r in d.get("/v1/runs")["runs"]}))
    waits = states["queued"]
    reply = d.ask("PATCH", f"/v1/runs/{waits}/config", {"time": {"end": 0.5}}, status=503)
    assert "pause it" in reply.json["detail"], reply
    at = d.act(waits, "pause")
    assert at["step"] >= 1500 and at["revision"] == 0, at
    d.ask("PATCH", f"/v1/runs/{waits}/config", {"time": {"end": 0.5}}, status=422)  # in its past
    d.patch(waits, {"time": {"end": at["time"] + 0.01}})
    d.away("a" if waits == "b" else "b")
    d.act(waits, "resume")
    end = d.wait(waits, "completed")
    assert (end["epoch"], end["revision"], end["step"] - at["step"]) == (0, 1, 10), end


def test_patch_of_a_finished_run_is_409(daemon, name):
    daemon.create(water(time={"end": 0.005}), id=name)
    daemon.wait(name, "completed")
    reply = daemon.ask("PATCH", f"/v1/runs/{name}/config", {"fbar": False}, status=409)
    assert "completed" in reply.json["detail"]
    assert daemon.get(f"/v1/runs/{name}/config")["fbar"] is not False
    daemon.away(name)


def test_config_of_an_unknown_run_is_404(daemon):
    daemon.ask("GET", "/v1/runs/nobody/config", status=404)
    daemon.ask("PATCH", "/v1/runs/nobody/config", {"fbar": True}, status=404)


def test_run_tells_its_changes_also_after_a_restart(tmp_path):
    d = Daemon(tmp_path).start()
    patches = [{"fbar": True}, {"damping": {"mass": 1}}, {"fbar": False}]
    try:
        d.create(endless(), id="r", start=False)
        assert d.run("r")["changes"] == []
        told = []
        for patch in patches:
            d.act("r", "step", {"steps": 10})
            d.wait("r", "paused")
            told.append({"step": d.patch("r", patch)["effective_step"], "patch": patch})
        d.patch("r", {"fbar": False})  # changes nothing
        changes = d.run("r")["changes"]
        assert [{"step": c["step"], "patch": c["patch"]} for c in changes] == told
        assert [c["time"] for c in changes] == pytest.approx([0.01, 0.02, 0.03])
        d.kill()
        d.start()
        assert d.run("r")["changes"] == changes
        d.act("r", "cancel")
        d.stop()
        d.start()
        assert d.run("r")["changes"] == changes
    finally:
        d.stop()


def test_changes_however_many_leave_the_run_object_small(fresh):
    """The object has the newest 32, their route has all; over a restart too, with what they made of the run."""
    d = fresh().start()
    d.create(endless(), id="r", start=False)
    d.create(endless(), id="early", start=False)
    before = len(d.ask("GET", "/v1/runs/r").body)
    for k in range(1, 101):
        d.act("r", "step", {"steps": 1})
        d.wait("r", "paused")
        assert d.patch("r", {"damping": {"mass": 0.001 * k}})["effective_step"] == k
    assert d.get("/v1/runs/early/changes") == {"changes": []}

    def check():
        run, every = d.run("r"), d.get("/v1/runs/r/changes")["changes"]
        assert [c["revision"] for c in every] == list(range(1, 101))
        assert [c["step"] for c in every] == list(range(1, 101))
        assert [c["patch"]["damping"]["mass"] for c in every] == [0.001 * k for k in range(1, 101)]
        assert run["revision"] == 100 and run["changes"] == every[-32:]
        assert len(d.ask("GET", "/v1/runs/r").body) < before + 32 * 100
        assert d.ask("GET", "/v1/runs/r/config").headers["etag"] == '"100"'
        assert d.get("/v1/runs/r/config")["damping"]["mass"] == 0.1
        assert d.get("/v1/runs/r/changes?since_revision=98")["changes"] == every[98:]
        assert d.get("/v1/runs/r/changes?since_revision=1000000000000")["changes"] == []

    check()
    d.kill()
    d.start()
    check()
    d.act("r", "step", {"steps": 5})  # makes those again that came after the last checkpoint
    assert d.wait("r", "paused")["step"] == 105
    check()
    d.act("r", "cancel")
    d.stop()
    d.start()
    check()
    d.ask("GET", "/v1/runs/r/changes?since_revision=-1", status=400)
    d.ask("GET", "/v1/runs/nobody/changes", status=404)
    d.away("r", "early")


def test_if_match_is_a_list_of_tags_and_nothing_near_them(daemon, live):
    path = f"/v1/runs/{live}/config"
    tag = daemon.ask("GET", path).headers["etag"]
    for header in (f"{tag}x", f'W/{tag}', tag.strip('"'), '"*"', '"a*"', f'{tag[:-1]}0"', "", ","):
        daemon.ask("PATCH", path, {"damping": {"mass": 7}}, {"If-Match": header}, status=412)
    daemon.ask("PATCH", path, {"damping": {"mass": 7}}, {"If-Match": f'"x" , {tag}'})


def test_dt_on_a_cfl_run_is_a_fault_of_the_patch(daemon, name):
    scene = endless(time={"dt": None, "cfl": 0.2})
    daemon.create(scene, id=name, start=False)
    reply = daemon.ask("PATCH", f"/v1/runs/{name}/config", {"time": {"dt": 1e-4}}, status=422)
    assert reply.pointers == ["/time/dt"]
    assert reply.fault("/time/dt")["actual"] == "0.0001" and "null" in reply.fault("/time/dt")["expected"]
    daemon.away(name)


def test_actual_names_what_cannot_change(daemon, live):
    reply = daemon.ask("PATCH", f"/v1/runs/{live}/config", {"cell": 0.5, "basis": "gimp"}, status=422)
    assert reply.fault("/cell")["actual"] == "0.5" and "gimp" in reply.fault("/basis")["actual"]


def test_a_finished_run_says_that_its_configuration_stays(daemon, name):
    daemon.create(water(time={"end": 0.005}), id=name)
    daemon.wait(name, "completed")
    reply = daemon.ask("PATCH", f"/v1/runs/{name}/config", {"fbar": False}, status=409)
    assert "its configuration cannot change" in reply.json["detail"]
    daemon.away(name)
