"""Bad input: each a clear error of the right status; the daemon lives on and no other run is touched."""
import contextlib
import json
import socket
import time

import pytest
from boxes import endless, merged, water
from fbard import FINAL, PATIENCE, Reply, check_form, is_sanitized, until

JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module", autouse=True)
def bystander(daemon):
    """A run that is there all the while, and must come out as its twin that nobody disturbed."""
    run = daemon.create(water(), start=False)["id"]
    daemon.act(run, "step", {"steps": 50})
    daemon.wait(run, "paused")
    runs = daemon.get("/v1/runs")["runs"]
    yield run
    daemon.act(run, "resume")
    assert daemon.wait(run, "completed")["step"] == 100
    assert len(daemon.get("/v1/runs")["runs"]) == len(runs), "a refused request made a run"
    twin = daemon.create(water())["id"]
    daemon.wait(twin, "completed")
    assert daemon.csv(twin) == daemon.csv(run)


# ---- Not JSON: 400 ----

DEEP = b"[" * 65 + b"]" * 65
NOT_JSON = {
    "empty": b"",
    "blank": b"  \n",
    "word": b"nonsense",
    "unclosed": b'{"scene": "dam-break"',
    "trailing_comma": b'{"scene": "dam-break",}',
    "trailing_text": b'{"scene": "dam-break"} x',
    "two_values": b'{"scene": "dam-break"}{}',
    "comment": b'{"scene": "dam-break"} // the paper\'s',
    "single_quotes": b"{'scene': 'dam-break'}",
    "duplicate_key": b'{"scene": "dam-break", "scene": "axial-bar"}',
    "duplicate_key_deep": b'{"scene": {"time": {"end": 1, "end": 2}}}',
    "duplicate_key_escaped": b'{"scene": "dam-break", "\\u0073cene": "axial-bar"}',
    "nan": b'{"scene": {"cell": NaN}}',
    "infinity": b'{"scene": {"cell": Infinity}}',
    "minus_infinity": b'{"scene": {"cell": -Infinity}}',
    "overflow": b'{"scene": {"cell": 1e999}}',
    "leading_zero": b'{"scene": {"cell": 01}}',
    "plus": b'{"scene": {"cell": +1}}',
    "bare_point": b'{"scene": {"cell": .5}}',
    "hexadecimal": b'{"scene": {"cell": 0x10}}',
    "raw_newline": b'{"scene": "dam\nbreak"}',
    "raw_nul": b'{"scene": "dam\0break"}',
    "nul_after": b'{"scene": "dam-break"}\0',
    "escaped_nul": b'{"scene": "dam-break\\u0000"}',
    "bad_escape": b'{"scene": "\\x"}',
    "lone_surrogate": b'{"scene": "\\ud800"}',
    "bad_utf8": b'{"scene": "\xff"}',
    "overlong_utf8": b'{"scene": "\xc0\xaf"}',
    "cut_utf8": b'{"scene": "\xe2\x82"}',
    "utf8_surrogate": b'{"scene": "\xed\xa0\x80"}',
    "utf16": '{"scene": "dam-break"}'.encode("utf-16"),
    "deep": DEEP,
    "very_deep": b"[" * 1_000_000,
    "deep_objects": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
}


@pytest.mark.parametrize("path", ["/v1/runs", "/v1/scenes:validate"])
@pytest.mark.parametrize("case", NOT_JSON)
def test_body_that_is_not_json_is_400(daemon, path, case):
    reply = daemon.ask("POST", path, NOT_JSON[case], JSON, status=400)
    assert len(reply.body) < 4000, "the body is not sent back"


def test_depth_64_is_still_json(daemon):
    body = b'{"scene": ' + b"[" * 63 + b"]" * 63 + b"}"
    daemon.ask("POST", "/v1/runs", body, JSON, status=422)


def test_byte_order_mark_is_refused(daemon):
    daemon.ask("POST", "/v1/runs", b"\xef\xbb\xbf{}", JSON, status=400)


# ---- JSON but no valid scene: 422 ----

# (patch of the scene, pointer, code or None)
INVALID = {
    "unknown_key": ({"colour": "blue"}, "/colour", "unknown_key"),
    "unknown_key_deep": ({"bodies": {"pool": {"materiel": "water"}}}, "/bodies/pool/materiel", "unknown_key"),
    "unknown_material_key": ({"materials": {"water": {"bulk": 1}}}, "/materials/water/bulk", "unknown_key"),
    "case_matters": ({"Cell": 1}, "/Cell", "unknown_key"),
    "wrong_type_number": ({"cell": "0.25"}, "/cell", "type"),
    "wrong_type_string": ({"basis": 3}, "/basis", "type"),
    "wrong_type_object": ({"materials": []}, "/materials", "type"),
    "wrong_type_list": ({"gravity": {"x": 0}}, "/gravity", "type"),
    "wrong_type_bool": ({"unstable_ok": 1}, "/unstable_ok", "type"),
    "wrong_type_inside": ({"gravity": [0, "9.81"]}, "/gravity/1", "type"),
    "fraction_for_integer": ({"dimension": 2.5}, "/dimension", None),
    "four_dimensions": ({"dimension": 4}, "/dimension", "range"),
    "unknown_format": ({"format": "fbard-scene-9"}, "/format", "choice"),
    "no_format": ({"format": None}, "/format", "required"),
    "no_time": ({"time": None}, "/time", "required"),
    "no_end": ({"time": {"end": None}}, "/time/end", "required"),
    "negative_cell": ({"cell": -0.25}, "/cell", "range"),
    "zero_cell": ({"cell": 0}, "/cell", "range"),
    "tiny_cell": ({"cell": 1e-300}, None, None),
    "huge_domain": ({"domain": {"max": [1e300, 1e300]}}, None, None),
    "negative_end": ({"time": {"end": -1}}, "/time/end", "range"),
    "dt_and_cfl": ({"time": {"cfl": 0.3}}, None, None),
    "dt_above_limit": ({"time": {"dt": 0.1}}, "/time/dt", None),
    "negative_density": ({"materials": {"water": {"density": -1}}}, "/materials/water/density", "range"),
    "no_density": ({"materials": {"water": {"density": None}}}, "/materials/water/density", "required"),
    "no_model": ({"materials": {"water": {"model": None}}}, "/materials/water/model", "required"),
    "unknown_model": ({"materials": {"water": {"model": "newtonean"}}}, "/materials/water/model", None),
    "no_materials": ({"materials": None}, "/materials", "required"),
    "unknown_material": ({"bodies": {"pool": {"material": "wader"}}}, "/bodies/pool/material", "unknown_name"),
    "no_bodies": ({"bodies": None}, "/bodies", "required"),
    "no_body": ({"bodies": {"pool": None}, "probes": None}, "/bodies", None),
    "no_shape": ({"bodies": {"pool": {"shape": None}}}, "/bodies/pool/shape", "required"),
    "two_shapes": ({"bodies": {"pool": {"shape": {"disk": {"center": [0, 0], "radius": 1}}}}},
                   "/bodies/pool/shape", None),
    "negative_size": ({"bodies": {"pool": {"shape": {"box": {"min": [1, 1], "max": [0, 0]}}}}},
                      "/bodies/pool/shape/box", None),
    "negative_radius": ({"bodies": {"pool": {"shape": {"box": None, "disk": {"center": [1, 1], "radius": -1}}}}},
                        "/bodies/pool/shape/disk/radius", "range"),
    "body_outside": ({"bodies": {"pool": {"shape": {"box": {"min": [1.5, 0], "max": [9, 1]}}}}}, "/bodies/pool", None),
    "body_far_outside": ({"bodies": {"pool": {"shape": {"box": {"min": [50, 50], "max": [51, 51]}}}}},
                         "/bodies/pool", None),
    "no_particles": ({"bodies": {"pool": {"shape": {"box": {"min": [0, 0], "max": [0.001, 0.001]}}}}},
                     "/bodies/pool", None),
    "particles_no_square": ({"bodies": {"pool": {"particles_per_cell": 5}}}, "/bodies/pool/particles_per_cell", None),
    "no_particles_per_cell": ({"bodies": {"pool": {"particles_per_cell": 0}}}, "/bodies/pool/particles_per_cell", None),
    "negative_particles": ({"bodies": {"pool": {"particles_per_cell": -4}}}, "/bodies/pool/particles_per_cell", None),
    "velocity_too_long": ({"bodies": {"pool": {"velocity": [1, 2, 3]}}}, "/bodies/pool/velocity", "length"),
    "wall_off_the_nodes": ({"walls": {"left": {"at": 0.1}}}, "/walls/left/at", None),
    "wall_axis_z": ({"walls": {"left": {"axis": "z"}}}, "/walls/left/axis", None),
    "wall_condition": ({"walls": {"left": {"condition": "slippery"}}}, "/walls/left/condition", "choice"),
    "domain_inside_out": ({"domain": {"min": [3, 3]}}, "/domain", None),
    "poisson_half": ({"materials": {"water": {"model": "neo_hookean", "youngs_modulus": 1, "poisson_ratio": 0.5,
                                              "bulk_modulus": None, "viscosity": None}}},
                     "/materials/water/poisson_ratio", "range"),
    "fbar_scheme": ({"fbar": {"scheme": "zhoa"}}, "/fbar/scheme", "choice"),
    "probe_kind": ({"probes": {"front": {"kind": "extend"}}}, "/probes/front/kind", "choice"),
    "probe_body": ({"probes": {"front": {"body": "pond"}}}, "/probes/front/body", "unknown_name"),
    "reference_probe": ({"references": [{"probe": "frond", "at": 1, "value": 1, "tolerance": 1}]},
                        "/references/0/probe", "unknown_name"),
    "output_field": ({"output": {"fields": ["velosity"]}}, "/output/fields/0", "choice"),
    "output_field_twice": ({"output": {"fields": ["position", "position"]}}, "/output/fields/1", "conflict"),
    "output_interval": ({"output": {"interval": 0}}, "/output/interval", "range"),
    "stage_without_duration": ({"stages": [{"name": "a"}, {"name": "b"}]}, "/stages/0/duration", "required"),
    "stage_removes_nothing": ({"stages": [{"name": "a", "remove": {"walls": ["gate"]}}]},
                              "/stages/0/remove/walls/0", "unknown_name"),
    "name_with_slash": ({"bodies": {"a/b": {"material": "water", "shape": {"box": {"min": [0, 0], "max": [1, 1]}}}}},
                        "/bodies/a~1b", "name"),
}  # fmt: skip


@pytest.mark.parametrize("case", INVALID)
def test_invalid_scene_is_422_with_pointer(daemon, case):
    patch, pointer, code = INVALID[case]
    scene = merged(water(), patch)
    reply = daemon.ask("POST", "/v1/scenes:validate", scene, status=422)
    create = daemon.ask("POST", "/v1/runs", {"scene": scene}, status=422)
    if pointer is not None:
        found = [e for e in reply.json["errors"] if e["pointer"] == pointer or e["pointer"].startswith(pointer + "/")]
        assert found, reply
        assert any(p == "/scene" + f["pointer"] or p == f["pointer"] for f in found for p in create.pointers), create
        if code is not None:
            assert code in [e["code"] for e in found], reply


def test_did_you_mean(daemon):
    scene = water()
    scene["gravty"] = scene.pop("gravity")
    scene["bodies"]["pool"]["particles_per_cel"] = 4
    scene["materials"]["water"]["bulk_modlus"] = scene["materials"]["water"].pop("bulk_modulus")
    reply = daemon.ask("POST", "/v1/scenes:validate", scene, status=422)
    assert "gravity" in reply.fault("/gravty")["detail"]
    assert "particles_per_cell" in reply.fault("/bodies/pool/particles_per_cel")["detail"]
    assert "bulk_modulus" in reply.fault("/materials/water/bulk_modlus")["detail"]


def test_faults_state_expected_and_actual(daemon):
    reply = daemon.ask("POST", "/v1/scenes:validate", water(cell=-0.25, basis="cubic"), status=422)
    fault = reply.fault("/cell")
    assert "0" in fault["expected"] and "-0.25" in fault["actual"]
    fault = reply.fault("/basis")
    assert "gimp" in fault["expected"] and "cubic" in fault["actual"]


def test_dt_above_the_limit_states_the_limit_and_can_be_insisted_on(daemon):
    reply = daemon.ask("POST", "/v1/scenes:validate", water(time={"dt": 0.1}), status=422)
    fault = reply.fault("/time/dt")
    limit = max(float(w) for w in fault["expected"].replace("=", " ").split() if w[:1].isdigit())
    assert 1e-3 < limit < 0.1
    daemon.ask("POST", "/v1/scenes:validate", water(time={"dt": 0.5 * limit}))
    daemon.ask("POST", "/v1/scenes:validate", water(time={"dt": 0.1}, unstable_ok=True))


def test_all_faults_come_at_once(daemon):
    scene = water(colour=1, cell=-1, basis="none", gravity=[1], time={"end": -2},
                  materials={"water": {"density": "heavy"}}, bodies={"pool": {"material": "milk"}},
                  walls={"left": {"axis": "w"}}, output={"fields": ["taste"]})  # fmt: skip
    pointers = daemon.ask("POST", "/v1/scenes:validate", scene, status=422).pointers
    assert {"/colour", "/cell", "/basis", "/gravity", "/time/end", "/materials/water/density",
            "/bodies/pool/material", "/walls/left/axis", "/output/fields/0"} <= set(pointers)  # fmt: skip


def test_very_many_faults_stay_a_small_answer(daemon):
    scene = water(**{f"key{k}": k for k in range(5000)})
    reply = daemon.ask("POST", "/v1/scenes:validate", scene, status=422)
    assert len(reply.json["errors"]) >= 20
    assert len(reply.body) < 500_000


def test_long_words_are_not_sent_back_whole(daemon):
    reply = daemon.ask("POST", "/v1/scenes:validate", water(basis="x" * 100_000), status=422)
    assert len(reply.body) < 20_000
    reply = daemon.ask("POST", "/v1/scenes:validate", water(**{"k" * 100_000: 1}), status=422)
    assert len(reply.body) < 500_000


@pytest.mark.parametrize(
    "body, pointer",
    [
        ({}, "/scene"), ({"scene": None}, "/scene"), ({"scene": 5}, "/scene"), ({"scene": []}, "/scene"),
        ({"scene": ""}, "/scene"), ({"scene": "no-such-scene"}, "/scene"), ({"scene": "../dam-break"}, "/scene"),
        ({"scene": "dam-break", "overrides": []}, "/overrides"), ({"scene": "dam-break", "overrides": "x"}, "/overrides"),
        ({"scene": "dam-break", "start": "yes"}, "/start"), ({"scene": "dam-break", "start": 1}, "/start"),
        ({"scene": "dam-break", "wait_subscribers": -1}, "/wait_subscribers"),
        ({"scene": "dam-break", "wait_subscribers": 0.5}, "/wait_subscribers"),
        ({"scene": "dam-break", "wait_subscribers": "one"}, "/wait_subscribers"),
        ({"scene": "dam-break", "stard": True}, "/stard"),
        ({"scene": "dam-break", "id": 7}, "/id"), ({"scene": "dam-break", "id": ""}, "/id"),
        ({"scene": "dam-break", "id": "a" * 65}, "/id"), ({"scene": "dam-break", "id": "a" * 100_000}, "/id"),
        ({"scene": "dam-break", "id": "a/b"}, "/id"), ({"scene": "dam-break", "id": "../x"}, "/id"),
        ({"scene": "dam-break", "id": ".hidden"}, "/id"), ({"scene": "dam-break", "id": "-x"}, "/id"),
        ({"scene": "dam-break", "id": "a b"}, "/id"), ({"scene": "dam-break", "id": "a:pause"}, "/id"),
        ({"scene": "dam-break", "id": "é"}, "/id"), ({"scene": "dam-break", "id": "a\n"}, "/id"),
        ({"scene": "dam-break", "id": "a%2fb"}, "/id"),
        ([], ""), ("dam-break", ""), (5, ""), (True, ""),
    ],
)  # fmt: skip
def test_invalid_request_for_a_run_is_422(daemon, body, pointer):
    reply = daemon.ask("POST", "/v1/runs", body, status=422)
    assert pointer in reply.pointers, reply
    assert len(reply.body) < 20_000


def test_faults_of_request_and_scene_come_at_once(daemon):
    body = {"scene": water(cell=-1), "id": "a/b", "start": "no", "extra": 1}
    pointers = daemon.ask("POST", "/v1/runs", body, status=422).pointers
    assert {"/id", "/start", "/extra"} <= set(pointers)
    assert any(p.endswith("/cell") for p in pointers)


# ---- Routes ----


@pytest.mark.parametrize(
    "path",
    ["/nowhere", "/v1/", "/v2/runs", "/v1/run", "/v1/runs/", "/v1/runs/a/b", "/v1/runs/nobody", "/v1/runs/nobody/frames",
     "/v1/runs/nobody/frames/0", "/v1/runs/nobody/probes", "/v1/runs/nobody/scene", "/v1/scenes/nothing",
     "/v1/scenes/..%2f..%2fetc%2fpasswd", "/v1/runs/..%2f..", "/v1/runs/" + "a" * 65, "/v1/runs/" + "a" * 5000,
     "/v1/runs/%ff%fe", "/v1/runs/nobody%0d%0aX:%20y", "//v1/runs", "/V1/runs",
     "/v1/schemas/run.json"],
)  # fmt: skip
def test_unknown_path_is_404(daemon, path):
    daemon.ask("GET", path, status=404)


@pytest.mark.parametrize("path", ["/v1/runs/%00", "/v1/runs/a%00b", "/healthz%00", "/v1/runs/%zz", "/v1/runs/a%2", "/v1%"])
def test_path_with_a_zero_byte_or_a_broken_escape_is_400(daemon, path):
    daemon.ask("GET", path, status=400)


def test_query_that_no_route_declares_is_400_and_names_those_that_there_are(daemon, bystander):
    """Of every route, by the document; each that is declared is taken."""
    for path, item in daemon.get("/openapi.json")["paths"].items():
        for method, operation in item.items():
            url = path.replace("{id}", bystander).replace("{seq}", "0").replace("{name}", "dam-break")
            url = url.replace("{file}", "page.css")
            known = [p["name"] for p in operation["parameters"] if p["in"] == "query"]
            body = {} if "requestBody" in operation else None
            detail = daemon.ask(method.upper(), url + "?pretty=1", body, status=400).json["detail"]
            assert '"pretty"' in detail and all(name in detail for name in known), detail
            for name in known:
                reply = daemon.ask(method.upper(), f"{url}?{name}=1&{name}=1", body, status=400)
                assert f"{name} twice" in reply.json["detail"]


@pytest.mark.parametrize(
    "query, status",
    [("limit=1", 200), ("", 200), ("&&limit=1&", 200), ("%6cimit=1", 200), ("limit", 400), ("Limit=1", 400), ("limit[]=1", 400),
     ("=1", 400), ("x", 400), ("limit%00=1", 400), ("limit=1%00", 400), ("limit=%zz", 400), ("%zz=1", 400),
     ("a" * 5000, 400), ("limit=1&state=paused", 200), ("limit=1&state=paused&stat=1", 400)],
)  # fmt: skip
def test_query_is_read_strictly(daemon, query, status):
    daemon.ask("GET", "/v1/runs?" + query, status=status)


def test_unknown_run_is_404_for_every_action(daemon):
    for action in ("start", "pause", "resume", "cancel", "checkpoint", "snapshot"):
        daemon.ask("POST", f"/v1/runs/nobody:{action}", status=404)
    daemon.ask("POST", "/v1/runs/nobody:step", {"steps": 1}, status=404)
    daemon.ask("DELETE", "/v1/runs/nobody", status=404)


def test_unknown_action_is_404(daemon, bystander):
    for action in ("explode", "", "PAUSE", "pause:pause", "configure"):
        daemon.ask("POST", f"/v1/runs/{bystander}:{action}", status=404)
    assert daemon.run(bystander)["state"] == "paused"


def test_wrong_method_is_405_with_allow(daemon, bystander):
    for method, path, allowed in (
        ("DELETE", "/v1/runs", {"GET", "POST"}),
        ("PUT", "/v1/runs", {"GET", "POST"}),
        ("PATCH", f"/v1/runs/{bystander}", {"GET", "DELETE"}),
        ("POST", f"/v1/runs/{bystander}/config", {"GET", "PATCH"}),
        ("GET", f"/v1/runs/{bystander}:cancel", {"POST"}),
        ("DELETE", f"/v1/runs/{bystander}:cancel", {"POST"}),
        ("POST", "/healthz", {"GET"}),
        ("GET", "/v1/scenes:validate", {"POST"}),
        ("DELETE", f"/v1/runs/{bystander}/frames/0", {"GET"}),
        ("POST", "/openapi.json", {"GET"}),
    ):
        reply = daemon.ask(method, path, status=405)
        assert set(reply.headers["allow"].replace(" ", "").split(",")) - {"HEAD", "OPTIONS"} == allowed, reply
    assert daemon.run(bystander)["state"] == "paused"


@pytest.mark.parametrize("method", ["FOO", "TRACE", "get", "PROPFIND", "OPTIONS"])
def test_unknown_method_is_refused(daemon, method):
    assert daemon.request(method, "/v1/runs", check=False).status in (400, 405, 501)
    assert daemon.get("/v1/runs")


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x",
                                  "application/jsonp", "json", "text/json"])  # fmt: skip
def test_other_content_types_are_415(daemon, kind):
    body = json.dumps({"scene": "dam-break"}).encode()
    daemon.ask("POST", "/v1/runs", body, {"Content-Type": kind}, status=415)
    daemon.ask("POST", "/v1/scenes:validate", body, {"Content-Type": kind}, status=415)


@pytest.mark.parametrize("query", ["since_step=x", "since_step=-1", "since_step=1.5", "since_step=1e3", "since_step=",
                                   "since_step=99999999999999999999999", "since_step=" + "9" * 100])  # fmt: skip
def test_nonsense_in_a_query_is_refused(daemon, bystander, query):
    assert daemon.request("GET", f"/v1/runs/{bystander}/probes?{query}").status in (400, 422)


@pytest.mark.parametrize("seq", ["-1", "1.5", "x", "first", "999999", "18446744073709551616", "99999999999999999999999",
                                 "%30", "+0", "0x0", "00"])  # fmt: skip
def test_frame_of_no_such_number_is_an_error(daemon, bystander, seq):
    status = daemon.request("GET", f"/v1/runs/{bystander}/frames/{seq}", check=False).status
    assert status in (400, 404, 422) or (status == 200 and seq in ("%30", "00"))


# ---- Who may ask ----


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "[::1", "10.0.0.1",
                                  "localhost.evil.example", "evil.example:{port}", "user@127.0.0.1", " "])  # fmt: skip
def test_foreign_host_is_421(daemon, bystander, host):
    host = host.replace("{port}", daemon.host.split(":")[1])
    for path in ("/v1/runs", "/healthz", "/openapi.json", "/nowhere"):
        daemon.ask("GET", path, headers={"Host": host}, status=421)
    daemon.ask("POST", f"/v1/runs/{bystander}:cancel", headers={"Host": host}, status=421)
    assert daemon.run(bystander)["state"] == "paused"


def test_own_host_by_any_of_its_names_is_served(daemon):
    port = daemon.host.split(":")[1]
    for host in (daemon.host, f"localhost:{port}", f"LOCALHOST:{port}"):
        daemon.ask("GET", "/v1/runs", headers={"Host": host})


@pytest.mark.parametrize("origin", ["http://evil.example", "https://127.0.0.1.evil.example", "null", "http://127.0.0.1:1",
                                    "file://", "http://localhost.evil.example"])  # fmt: skip
def test_foreign_origin_is_403(daemon, bystander, origin):
    for method, path in (("GET", "/v1/runs"), ("POST", f"/v1/runs/{bystander}:cancel"), ("GET", "/openapi.json"),
                         ("GET", f"/v1/runs/{bystander}/frames/0")):  # fmt: skip
        reply = daemon.ask(method, path, headers={"Origin": origin}, status=403)
        assert "access-control-allow-origin" not in reply.headers
    assert daemon.run(bystander)["state"] == "paused"


def test_own_origin_is_served_without_cors(daemon):
    reply = daemon.ask("GET", "/v1/runs", headers={"Origin": daemon.http})
    assert not [h for h in reply.headers if h.startswith("access-control-")]


# ---- Size ----


def send_slowly_read(daemon, head, chunks):
    """Sends until the daemon answers or hangs up; the answer's first line and how much was sent."""
    address, port = daemon.host.split(":")
    sent, answer = 0, b""
    with socket.create_connection((address, int(port)), timeout=PATIENCE) as s:
        s.sendall(head)
        s.setblocking(False)
        pending = b""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                part = s.recv(65536)
                answer += part
                if not part or b"\r\n\r\n" in answer:
                    break
            except BlockingIOError:
                pass
            except ConnectionError:
                break
            try:
                pending = pending or next(chunks, b"")
                if pending:
                    n = s.send(pending)
                    sent, pending = sent + n, pending[n:]
                else:
                    time.sleep(0.001)
            except BlockingIOError:
                time.sleep(0.001)
            except ConnectionError:
                s.setblocking(True)
                try:
                    answer += s.recv(65536)
                except ConnectionError:
                    pass
                break
    return answer.split(b"\r\n")[0], sent


HUGE = 100_000_000


def check_refused_quickly(daemon, head, chunks, most_sent):
    before, used = daemon.memory(), daemon.cpu_seconds()
    line, sent = send_slowly_read(daemon, head.replace(b"HOST", daemon.host.encode()), chunks)
    assert line.startswith(b"HTTP/1.1 413"), line
    assert sent <= most_sent
    assert daemon.cpu_seconds() - used < 30
    if not is_sanitized():
        assert daemon.memory() < before + 40e6
    daemon.get("/v1/runs")


POST = b"POST /v1/runs HTTP/1.1\r\nHost: HOST\r\nContent-Type: application/json\r\n"


def test_body_of_100_mb_is_413_at_once(daemon):
    chunks = (b" " * 1_000_000 for _ in range(HUGE // 1_000_000))
    check_refused_quickly(daemon, POST + b"Content-Length: %d\r\n\r\n" % HUGE, chunks, HUGE)


def test_body_of_100_mb_announced_by_curl_is_never_sent(daemon):
    head = POST + b"Expect: 100-continue\r\nContent-Length: %d\r\n\r\n" % HUGE
    check_refused_quickly(daemon, head, iter(()), 0)


def test_body_of_100_mb_in_chunks_is_413(daemon):
    def chunks():
        for _ in range(100):
            yield b"f4240\r\n" + b" " * 1_000_000 + b"\r\n"
        yield b"0\r\n\r\n"

    check_refused_quickly(daemon, POST + b"Transfer-Encoding: chunked\r\n\r\n", chunks(), HUGE + 10_000)


def test_body_at_the_limit_is_read(daemon):
    daemon.ask("POST", "/v1/runs", b" " * (8 << 20), JSON, status=400)
    reply = daemon.ask("POST", "/v1/scenes:validate", json.dumps(water()).encode().ljust(8 << 20), JSON)
    assert reply.json


def test_many_entries_within_the_limit_are_refused_or_taken_but_quickly(daemon):
    scene = water()
    scene["bodies"]["pool"]["shape"] = {"union": [{"box": {"min": [0, 0], "max": [1, 1]}}] * 50_000}
    used = daemon.cpu_seconds()
    assert daemon.request("POST", "/v1/scenes:validate", scene).status in (200, 422)
    many = b'{"scene": {' + b",".join(b'"k%d": 0' % k for k in range(30_000)) + b"}}"
    daemon.ask("POST", "/v1/runs", many, JSON, status=422)
    assert daemon.cpu_seconds() - used < 60


def raw(daemon, text, wait=True):
    address, port = daemon.host.split(":")
    with socket.create_connection((address, int(port)), timeout=PATIENCE) as s:
        answer = b""
        with contextlib.suppress(OSError):  # it hung up before it had read all
            s.sendall(text)
            s.shutdown(socket.SHUT_WR)
        with contextlib.suppress(OSError):  # it hung up; what it said before counts
            while wait and (part := s.recv(65536)):
                answer += part
        return answer


def test_garbage_on_the_socket_is_survived(daemon):
    for text in (b"\0" * 1000, b"\x16\x03\x01\x02\x00" + bytes(range(256)), b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n",
                 b"A" * 100_000,
                 b"GET /v1/runs HTTP/1.1\r\nHost: x\r\n" + b"X-Y: z\r\n" * 20_000 + b"\r\n",
                 b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\nHost: x\r\n\r\n",
                 b"POST /v1/runs HTTP/1.1\r\nHost: x\r\nContent-Length: -5\r\n\r\n",
                 b"POST /v1/runs HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999999999999\r\n\r\n",
                 b"POST /v1/runs HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n"):  # fmt: skip
        answer = raw(daemon, text)
        assert not answer.startswith(b"HTTP/1.1 2"), (text[:40], answer[:100])
        daemon.get("/healthz")


HEADS = {
    "no_host": (b"", 400),
    "two_hosts": (b"Host: HOST\r\nHost: evil.example\r\n", 400),
    "own_host_twice": (b"Host: HOST\r\nHost: HOST\r\n", 400),
    "two_origins": (b"Host: HOST\r\nOrigin: http://HOST\r\nOrigin: http://evil.example\r\n", 400),
    "two_tokens": (b"Host: HOST\r\nAuthorization: Bearer a\r\nAuthorization: Bearer b\r\n", 400),
    "blank_in_name": (b"Host: HOST\r\nX-A : b\r\n", 400),
    "two_lengths": (b"Host: HOST\r\nContent-Length: 2\r\nContent-Length: 40\r\n", 400),
    "length_and_chunks": (b"Host: HOST\r\nContent-Length: 2\r\nTransfer-Encoding: chunked\r\n", 400),
    "unknown_coding": (b"Host: HOST\r\nTransfer-Encoding: gzip\r\n", 400),
    "compressed_body": (b"Host: HOST\r\nContent-Encoding: gzip\r\nContent-Length: 2\r\n", 415),
    "zero_in_host": (b"Host: HOST\0evil\r\nX-A: b\r\n", 400),
    "zero_in_the_last_line": (b"X-A: b\r\nHost: HOST\0evil\r\n", 400),
    "two_zeroes": (b"X-A: b\r\nHost: HOST\0\0evil\r\n", 400),
    "zero_at_the_end": (b"Host: HOST\0\r\n", 400),
    "zero_in_length": (b"Host: HOST\r\nContent-Length: 2\0 5\r\n", 400),
    "zero_in_name": (b"Host: HOST\r\nX\0Y: b\r\n", 400),
    "zero_in_token": (b"Host: HOST\r\nAuthorization: Bearer a\0b\r\nX-A: b\r\n", 400),
    "line_that_goes_on": (b"Host: HOST\r\nX-A: b\r\n  c\r\nX-B: d\r\n", 400),
    "no_colon": (b"Host: HOST\r\nX-A\r\n", 400),
    "word_for_length": (b"Host: HOST\r\nContent-Length: 2x\r\n", 400),
    "length_below_zero": (b"Host: HOST\r\nContent-Length: -2\r\n", 400),
    "no_length": (b"Host: HOST\r\nContent-Length:\r\n", 400),
    "length_beyond_numbers": (b"Host: HOST\r\nContent-Length: 99999999999999999999\r\n", 413),
    "no_chunks": (b"Host: HOST\r\nTransfer-Encoding: chunked\r\n", 400),
    "very_long_head": (b"Host: HOST\r\n" + b"X-Y: %s\r\n" % (b"z" * 500) * 140, 431),
    "long_head": (b"Host: HOST\r\n" + b"X-Y: %s\r\n" % (b"z" * 500) * 40, 431),
}


@pytest.mark.parametrize("case", HEADS)
def test_head_that_two_readers_would_read_differently_is_refused(daemon, case):
    head, status = HEADS[case]
    head = b"POST /v1/scenes:validate HTTP/1.1\r\nContent-Type: application/json\r\n" + head + b"\r\n{}"
    answer = raw(daemon, head.replace(b"HOST", daemon.host.encode()))
    top, body = answer.split(b"\r\n\r\n", 1)
    lines = top.decode().split("\r\n")
    headers = [tuple(line.split(": ", 1)) for line in lines[1:]]
    reply = check_form(Reply("POST", "/v1/scenes:validate", int(lines[0].split()[1]), headers, body))
    assert reply.status == status and answer.count(b"HTTP/1.1 %d " % status) == 1, answer
    assert len(body) == int(reply.headers["content-length"]), "one answer and nothing behind it"


@pytest.mark.parametrize("line", [b"GET /healthz\0evil HTTP/1.1", b"GET /healthz?\0 HTTP/1.1", b"GET\0X /healthz HTTP/1.1",
                                  b"GET /healthz \0 HTTP/1.1"])  # fmt: skip
def test_request_line_with_a_zero_byte_is_400(daemon, line):
    answer = raw(daemon, line + b"\r\nHost: %s\r\n\r\n" % daemon.host.encode())
    assert answer.startswith(b"HTTP/1.1 400 ") and b"zero byte" in answer, answer


@pytest.mark.parametrize(
    "head",
    [b"GET /healthz HTTP/1.1\r\nHost: HOST\r\n\r\n", b"GET /healthz HTTP/1.1\nHost: HOST\nX-A: b\n\n",
     b"GET /v1/runs?limit=1&state=paused HTTP/1.1\r\nHost:HOST\r\nX-A:\r\nX-B:  c  d\r\n\r\n", b"GET /healthz HTTP/1.0\r\n\r\n",
     b"\r\n\r\nGET /v1/scenes/%64am-break HTTP/1.1\r\nHost: HOST\r\nCookie: a=b; c=d\r\nX-A: e\r\n\r\n"],
)  # fmt: skip
def test_head_that_is_odd_but_sound_is_served(daemon, head):
    head = head.replace(b"HOST", daemon.host.encode())
    answer = raw(daemon, head + head)  # on one connection, where it is kept
    assert answer.startswith(b"HTTP/1.1 200 ") and answer.count(b"HTTP/1.1 200 ") in (1, 2), answer
    assert b"HTTP/1.1 4" not in answer, answer


def test_target_in_absolute_form_is_served_for_its_own_authority(daemon):
    host = daemon.host.encode()
    for target, status in ((b"http://" + host + b"/healthz", 200), (b"http://" + host + b"/v1/runs?limit=1", 200),
                           (b"HTTP://localhost/healthz", 200), (b"http://" + host, 200),
                           (b"http://evil.example/healthz", 421), (b"http://127.0.0.1@evil.example/healthz", 421),
                           (b"http:///healthz", 421), (b"ftp://" + host + b"/healthz", 404)):  # fmt: skip
        answer = raw(daemon, b"GET %s HTTP/1.1\r\nHost: %s\r\n\r\n" % (target, host))
        assert answer.startswith(b"HTTP/1.1 %d " % status), (target, answer[:100])
    answer = raw(daemon, b"GET http://%s/healthz HTTP/1.1\r\nHost: evil.example\r\n\r\n" % host)
    assert answer.startswith(b"HTTP/1.1 200 "), "the target's authority is the one that counts"


def test_client_that_hangs_up_in_the_middle_is_survived(daemon, bystander):
    for _ in range(20):
        host = daemon.host.encode()
        raw(daemon, POST.replace(b"HOST", host) + b'Content-Length: 500\r\n\r\n{"scene', wait=False)
        raw(daemon, b"GET /v1/runs/%s/frames/0 HTTP/1.1\r\nHost: %s\r\n\r\n" % (bystander.encode(), host), wait=False)
    daemon.get("/healthz")


def test_many_open_connections_do_not_keep_others_out(daemon):
    address, port = daemon.host.split(":")
    idle = [socket.create_connection((address, int(port)), timeout=PATIENCE) for _ in range(20)]
    try:
        for s in idle:
            s.sendall(b"POST /v1/runs HTTP/1.1\r\nHost: ")
        daemon.get("/healthz")
    finally:
        for s in idle:
            s.close()


# ---- And then ----


def test_a_run_still_completes_after_all_that(daemon, bystander):
    run = daemon.create(water())["id"]
    daemon.wait(run, "completed")
    daemon.away(run)
    assert daemon.run(bystander)["step"] == 50
    assert not [r for r in daemon.get("/v1/runs")["runs"] if r["id"] != bystander and r["state"] not in FINAL]


def test_two_runs_of_one_id_at_the_same_moment_are_one_201_and_the_rest_409(daemon, name):
    import concurrent.futures

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        body = {"scene": endless(), "id": name, "start": False}
        replies = list(pool.map(lambda _: daemon.request("POST", "/v1/runs", body).status, range(8)))
    assert sorted(replies) == [201] + [409] * 7
    daemon.away(name)
    until(lambda: name not in [r["id"] for r in daemon.get("/v1/runs")["runs"]])


@pytest.mark.parametrize(
    "more, pointer, actual",
    [
        ({"id": "a/b"}, "/id", '"a/b"'), ({"id": ""}, "/id", '""'), ({"id": "x" * 65}, "/id", "x" * 65),
        ({"wait_subscribers": 10001}, "/wait_subscribers", "10001"), ({"wait_subscribers": 1.5}, "/wait_subscribers", "1.5"),
        ({"overrides": {"loads": {"a": 1}}}, "/scene/loads/a", "1"), ({"idd": "a"}, "/idd", "idd"),
    ],
)  # fmt: skip
def test_actual_is_told_where_it_is_at_hand(daemon, more, pointer, actual):
    fault = daemon.ask("POST", "/v1/runs", {"scene": water(), **more}, status=422).fault(pointer)
    assert actual in fault["actual"]
    assert fault["expected"] == fault["expected"].strip()
    if pointer == "/idd":
        assert 'did you mean "id"?' in fault["detail"]


def test_actual_of_a_step_is_told(daemon, name):
    daemon.create(endless(), id=name, start=False)
    for body in ({"steps": -1}, {"steps": 1.5}, {"steps": "a"}, {"until": "a"}):
        (key, value), = body.items()
        fault = daemon.ask("POST", f"/v1/runs/{name}:step", body, status=422).fault(f"/{key}")
        assert fault["actual"] == (f'"{value}"' if value == "a" else str(value))
    fault = daemon.ask("POST", f"/v1/runs/{name}:step", {"until": -5}, status=422).fault("/until")
    assert "-0" not in fault["detail"]
    daemon.away(name)
