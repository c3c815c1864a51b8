"""A small model of the API against the daemon: random requests (hypothesis), each answer is what the model allows.

1,000 requests and more in `make check`, 100,000 in `make check-long`. A failure prints the shortest sequence that
shows it."""
import collections
import http.client
import json
import os
import re
import sys
import time
import traceback

import jsonschema
import pytest

hypothesis = pytest.importorskip("hypothesis")
from boxes import ENDLESS, endless, water  # noqa: E402
from fbard import FINAL, Daemon, Reply, check_form, until  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, multiple, rule  # noqa: E402
from test_openapi_document import operations, resolve  # noqa: E402

LONG = bool(os.environ.get("FBARD_LONG"))
EXAMPLES, STEPS = (2600, 50) if LONG else (40, 35)
WANTED = 100_000 if LONG else 1_000
HANGS = 600.0  # s without an answer: more than a machine may stand still on which this is not alone
SLOTS, QUEUE = 2, 4
ALIVE = {"queued", "running", "waiting", "paused"}
GOING = {"queued", "running", "waiting"}

# What an action does in a state: "acts", is "already" so, or is refused ("no").
ACTIONS = {
    "start": dict(queued="already", running="already", waiting="already", paused="acts"),
    "resume": dict(queued="already", running="already", waiting="already", paused="acts"),
    "pause": dict(queued="acts", running="acts", waiting="acts", paused="already"),
    "step": dict(paused="acts"),
    "cancel": dict(queued="acts", running="acts", waiting="acts", paused="acts", cancelled="already"),
    "checkpoint": dict(running="acts", waiting="acts", paused="acts"),
    "snapshot": dict(running="acts", waiting="acts", paused="acts"),
}
AFTER = {"start": GOING, "resume": GOING, "pause": {"paused"}, "step": GOING | {"paused"}, "cancel": {"cancelled"}}


class Kept(Daemon):
    """Asks over one connection that is kept: what an answer leaves behind would spoil the next one. Answers are held
    against the document as they come, and not kept for test_openapi_document: there are too many."""

    connection, asked = None, 0.0
    judge = staticmethod(lambda reply: None)

    def request(self, method, path, body=None, headers=None, check=True):
        headers = dict(headers or {})
        if body is not None and not isinstance(body, bytes):
            body = json.dumps(body).encode()
            headers.setdefault("Content-Type", "application/json")
        now = time.monotonic()
        try:
            answer = self.send(method, path, body, headers)
        except (http.client.RemoteDisconnected, ConnectionResetError, BrokenPipeError):
            self.connection = None
            if time.monotonic() - self.asked < 20:  # idle connections are closed after 30 s, also where both sides stood still
                raise
            answer = self.send(method, path, body, headers)
        self.asked = now
        reply = check_form(Reply(method, path, answer.status, answer.getheaders(), answer.read()))
        self.judge(reply)
        return reply

    def send(self, method, path, body, headers):
        if self.connection is None:
            self.connection = http.client.HTTPConnection(self.host, timeout=HANGS)
        self.connection.request(method, path, body, headers)
        return self.connection.getresponse()


class Service:
    """The daemon with what all examples share: the document, counts, runs that nobody may touch."""

    def __init__(self, folder):
        self.daemon = Kept(folder, "--queue", str(QUEUE), slots=SLOTS)
        self.daemon.start()
        self.document = self.daemon.get("/openapi.json")
        self.routes = []
        for path, method, operation in operations(self.document):
            pattern = re.sub(r"\\\{[^}]*\\\}", "[^/:]+", re.escape(path))
            self.routes.append((re.compile(pattern + r"(\?.*)?"), path, method.upper(), operation))
        self.routes.sort(key=lambda r: r[1].count("{"))
        self.resolver = jsonschema.RefResolver.from_schema(self.document)
        self.validators, self.requests, self.statuses = {}, 0, collections.Counter()
        self.daemon.judge = self.judge
        self.daemon.create(water(), id="bystander-over")
        self.daemon.wait("bystander-over", "completed")
        self.daemon.create(endless(), id="bystander-paused", start=False)
        self.daemon.act("bystander-paused", "step", {"steps": 7})
        self.daemon.wait("bystander-paused", "paused")
        self.untouched = self.bystanders()

    def bystanders(self):
        found = []
        for run in ("bystander-over", "bystander-paused"):
            now = self.daemon.run(run)
            found.append((now["state"], now["step"], now["time"], now["balance"], now["probes"], now["changes"],
                          self.daemon.get(f"/v1/runs/{run}/config"), self.daemon.frames(run)))  # fmt: skip
        return found

    def judge(self, reply):
        """Whether an answer is as the document says."""
        assert reply.status < 500 or reply.status in (503, 507), reply
        for pattern, route, verb, operation in self.routes:
            if verb == reply.method and pattern.fullmatch(reply.path):
                break
        else:
            assert reply.status == (400 if "%zz" in reply.path else 404) or reply.status == 405, reply
            return
        assert str(reply.status) in operation["responses"], f"not declared: {reply}"
        content = resolve(self.document, operation["responses"][str(reply.status)]).get("content", {})
        if reply.body:
            assert reply.type in content, reply
        if reply.body and reply.type.endswith("json"):
            key = (route, verb, reply.status)
            if key not in self.validators:
                self.validators[key] = jsonschema.Draft202012Validator(content[reply.type].get("schema", {}),
                                                                       resolver=self.resolver)  # fmt: skip
            error = jsonschema.exceptions.best_match(self.validators[key].iter_errors(reply.json))
            assert error is None, f"{error.json_path}: {error.message[:300]}: {reply}"

    def ask(self, method, path, body=None, headers=None):
        """One request of a rule."""
        reply = self.daemon.request(method, path, body, headers)
        self.requests += 1
        self.statuses[reply.status] += 1
        return reply


class Run:
    """What the model knows: the states that the run may be in now, and what it was told."""

    def __init__(self, name, ends, states):
        self.name, self.ends, self.states = name, ends, set(states)
        self.etag = '"0"'
        self.config = {}
        self.recorders = set()
        self.steps = 0  # at least
        self.stepping = False  # pauses by itself

    def moves(self):
        """States that it may have come to by itself."""
        if self.states & GOING:
            self.states |= GOING | ({"completed"} if self.ends else set()) | ({"paused"} if self.stepping else set())
        return self.states

    def saw(self, state):
        assert state in self.moves(), f"{self.name} is {state}, can be {self.states}"
        self.states = {state}


service = None
names = iter(f"m{k}" for k in range(10**9))
# Without NUL: a body that has one in a text is a 400 (test_requests_refused), whatever else is wrong with it.
texts = st.text(st.characters(min_codepoint=1, blacklist_categories=("Cs",)), max_size=4)
numbers = st.one_of(st.integers(-3, 200), st.floats(allow_nan=False, allow_infinity=False), st.booleans(), st.none(),
                    texts, st.just([]), st.just({}))  # fmt: skip


class Model(RuleBasedStateMachine):
    runs = Bundle("runs")

    def __init__(self):
        super().__init__()
        self.known = []

    def teardown(self):
        error = sys.exc_info()[1]
        if isinstance(error, Exception) and not isinstance(error, hypothesis.errors.HypothesisException):
            traceback.print_exception(error)  # what does not come again when hypothesis repeats it would be lost
        for run in self.known:
            service.daemon.request("POST", f"/v1/runs/{run.name}:cancel")
            until(lambda: service.daemon.run(run.name)["state"] in FINAL, HANGS)
            service.daemon.ask("DELETE", f"/v1/runs/{run.name}", status=204)
        assert service.bystanders() == service.untouched
        assert {r["id"] for r in service.daemon.get("/v1/runs")["runs"]} == {"bystander-over", "bystander-paused"}

    # ---- Runs ----

    @rule(target=runs, ends=st.booleans(), start=st.booleans(), keyed=st.booleans(), again=st.booleans())
    def create(self, ends, start, keyed, again):
        name = next(names)
        body = {"scene": water() if ends else ENDLESS, "id": name, "start": start}
        headers = {"Idempotency-Key": name} if keyed else {}
        surely = 1 + sum(not (r.moves() & set(FINAL)) for r in self.known)  # 1: the bystander
        perhaps = 1 + sum(bool(r.moves() & ALIVE) for r in self.known)
        reply = service.ask("POST", "/v1/runs", body, headers)
        if reply.status == 503:
            assert perhaps >= SLOTS + QUEUE, "there is room"
            return multiple()
        assert reply.status == 201 and surely < SLOTS + QUEUE, reply
        assert reply.headers["location"] == f"/v1/runs/{name}"
        run = Run(name, ends, GOING if start else {"paused"})
        run.saw(reply.json["state"])
        self.known.append(run)
        if again:
            reply = service.ask("POST", "/v1/runs", body, headers)
            assert reply.status == (201 if keyed else 409), reply
            if keyed:
                run.saw(reply.json["state"])
        return run

    @rule(run=runs)
    def look(self, run):
        now = service.ask("GET", f"/v1/runs/{run.name}").json
        run.saw(now["state"])
        assert now["step"] >= run.steps, "steps do not go back"
        assert not run.states == {"failed"}
        run.steps = now["step"]

    @rule(run=runs, what=st.sampled_from(["scene", "probes", "frames", "recorders", "config", "changes", "frames/latest",
                                          "probes?since_step=5"]))  # fmt: skip
    def read(self, run, what):
        reply = service.ask("GET", f"/v1/runs/{run.name}/{what}")
        assert reply.status == 200 or (what == "frames/latest" and reply.status == 404), reply
        if what == "recorders":
            assert {r["name"] for r in reply.json["recorders"]} == run.recorders
        if what == "changes":
            assert [c["revision"] for c in reply.json["changes"]] == list(range(1, int(run.etag.strip('"')) + 1))
        if what == "config":
            assert reply.headers["etag"] == run.etag
            for key, value in run.config.items():
                assert reply.json[key] == value or key == "damping", (key, reply)

    @rule(run=runs, action=st.sampled_from(sorted(set(ACTIONS) - {"step"})))
    def act(self, run, action):
        self.judge(run, action, service.ask("POST", f"/v1/runs/{run.name}:{action}"))

    @rule(run=runs, steps=st.integers(1, 30))
    def step(self, run, steps):
        before = max(run.steps, 0)
        reply = service.ask("POST", f"/v1/runs/{run.name}:step", {"steps": steps})
        self.judge(run, "step", reply)
        if reply.status == 200 and not run.ends:
            now = until(lambda: (r := service.daemon.run(run.name))["state"] == "paused" and r or self.crowded(), HANGS)
            run.stepping = now is True
            if now is not True:
                run.states = {"paused"}
                assert now["step"] == reply.json["effective_step"] + steps >= before + steps
                run.steps = now["step"]

    def crowded(self):
        """Whether others may keep the slots."""
        return sum(bool(r.moves() & GOING) for r in self.known) > SLOTS

    def judge(self, run, action, reply):
        """The answer to an action, by the states that the run may have been in."""
        verdicts = {ACTIONS[action].get(s, "no") for s in run.moves()}
        if reply.status == 409:
            assert "no" in verdicts, reply
            named = re.search(r"is (\w+):", reply.json["detail"])[1]
            assert ACTIONS[action].get(named, "no") == "no", reply
            run.saw(named)
        elif reply.status == 503:
            assert action in ("checkpoint", "snapshot", "step") or run.ends, reply
        else:
            assert reply.status == 200 and verdicts - {"no"}, reply
            now = reply.json
            if action in AFTER:
                after = AFTER[action] | ({"completed"} if run.ends and AFTER[action] & GOING else set())
                assert now["state"] in after, reply
                run.states = {now["state"]}
                run.stepping = action == "step"
            else:
                run.saw(now["state"])
            assert now["effective_step"] >= run.steps
            run.steps = now["effective_step"]

    @rule(run=consumes(runs))
    def delete(self, run):
        reply = service.ask("DELETE", f"/v1/runs/{run.name}")
        if reply.status == 409:
            assert run.moves() & ALIVE, reply
            service.daemon.request("POST", f"/v1/runs/{run.name}:cancel")
            until(lambda: service.daemon.run(run.name)["state"] in FINAL, HANGS)
            reply = service.ask("DELETE", f"/v1/runs/{run.name}")
        else:
            assert run.moves() & set(FINAL), reply
        assert reply.status == 204, reply
        assert service.ask("GET", f"/v1/runs/{run.name}").status == 404
        self.known.remove(run)

    # ---- Configuration ----

    @rule(run=runs, patch=st.sampled_from([{"fbar": True}, {"fbar": False}, {"transfer": {"blend": 0.9}},
                                           {"gravity": [0, 0]}, {"damping": {"mass": 0.1}}, {}]),
          tag=st.sampled_from([None, "right", "wrong", "*", 'W/"0"', '"7", "8"']))  # fmt: skip
    def configure(self, run, patch, tag):
        headers = {} if tag is None else {"If-Match": {"right": run.etag, "wrong": '"999"'}.get(tag, tag)}
        reply = service.ask("PATCH", f"/v1/runs/{run.name}/config", patch, headers)
        over = run.moves() & set(FINAL)
        if tag in ("wrong", 'W/"0"') or (tag == '"7", "8"' and run.etag not in ('"7"', '"8"')):
            assert reply.status == 412 or (over and reply.status == 409), reply
        elif reply.status == 409:
            assert over, reply
            run.states &= set(FINAL)
        elif reply.status == 503:
            assert run.ends, reply
        else:
            assert reply.status == 200 and run.states & ALIVE, reply
            old, new = int(run.etag.strip('"')), int(reply.headers["etag"].strip('"'))
            assert new in (old, old + 1)
            changed = any(run.config.get(k) != v for k, v in patch.items())
            assert new == old or changed, "what says nothing new is no change"
            run.etag = reply.headers["etag"]
            run.config.update({k: v for k, v in patch.items() if k == "fbar"})

    @rule(run=runs, patch=st.sampled_from([{"cell": 1}, {"fbar": "off?"}, {"time": {"dt": 1e9}}, {"gravity": [0]}, [],
                                           {"damping": {"local": 2}}, {"output": {"interval": -1}}, 3]))  # fmt: skip
    def configure_badly(self, run, patch):
        reply = service.ask("PATCH", f"/v1/runs/{run.name}/config", patch)
        assert reply.status == 422 or (reply.status == 409 and run.moves() & set(FINAL)) or (
            reply.status == 503 and run.ends), reply  # fmt: skip
        assert service.ask("GET", f"/v1/runs/{run.name}/config").headers["etag"] == run.etag

    # ---- Recorders ----

    @rule(run=runs, name=st.sampled_from(["a", "b", "c d", "x" * 65]), acked=numbers)
    def record(self, run, name, acked):
        reply = service.ask("PUT", f"/v1/runs/{run.name}/recorders/{name.replace(' ', '%20')}", {"acked": acked})
        valid = not isinstance(acked, bool) and isinstance(acked, (int, float)) and acked == int(acked) and acked >= -1
        if len(name) > 1 or not valid:
            assert reply.status == 422, reply
        elif acked == -1:
            assert reply.status == 200, reply
        else:
            assert reply.status in (200, 422), reply
        if reply.status == 200:
            run.recorders.add(name)
            assert reply.json["acked"] == acked

    @rule(run=runs, name=st.sampled_from(["a", "b", "c"]))
    def unrecord(self, run, name):
        reply = service.ask("DELETE", f"/v1/runs/{run.name}/recorders/{name}")
        assert reply.status == (200 if name in run.recorders else 404), reply
        run.recorders.discard(name)

    # ---- What is not there, and what is no request ----

    @rule(path=st.sampled_from(["/v1/runs/none", "/v1/runs/none/events", "/v1/runs/none:pause", "/v1/nothing", "/v2",
                                "/v1/runs/bystander-over:frob", "/v1/scenes/none", "/v1/runs/%zz", "/v1//runs"]),
          method=st.sampled_from(["GET", "POST", "PATCH", "PUT", "DELETE", "OPTIONS"]))  # fmt: skip
    def miss(self, path, method):
        assert service.ask(method, path, {} if method in ("POST", "PATCH", "PUT") else None).status in (400, 404, 405, 422)

    @rule(text=st.one_of(st.binary(max_size=40), st.recursive(numbers, lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.sampled_from(
            ["scene", "overrides", "id", "start", "wait_subscribers", "recorders", "x"]), inner, max_size=4)), max_leaves=8
    ).map(lambda value: json.dumps(value).encode())), path=st.sampled_from(["/v1/runs", "/v1/scenes:validate"]))  # fmt: skip
    def babble(self, text, path):
        reply = service.ask("POST", path, text, {"Content-Type": "application/json"})
        assert reply.status in (400, 422), reply

    @rule(value=numbers)
    def create_badly(self, value):
        body = {"scene": water(), "wait_subscribers": value, "idd": 1}
        assert service.ask("POST", "/v1/runs", body).status == 422

    @rule(what=st.sampled_from(["/v1", "/v1/runs", "/healthz", "/readyz", "/v1/scenes", "/v1/materials", "/metrics"]))
    def ask_the_service(self, what):
        reply = service.ask("GET", what)
        assert reply.status == 200 or what == "/readyz", reply

    @invariant()
    def lives(self):
        assert service is None or service.daemon.process.poll() is None, service.daemon.stderr()[-2000:]


def test_answers_are_those_of_the_model(tmp_path):
    global service
    service = Service(tmp_path)
    began = time.monotonic()
    Model.TestCase.settings = hypothesis.settings(
        max_examples=EXAMPLES, stateful_step_count=STEPS, deadline=None, derandomize=not LONG, database=None,
        print_blob=True, suppress_health_check=list(hypothesis.HealthCheck))  # fmt: skip
    try:
        Model.TestCase("runTest").runTest()
        assert service.requests >= WANTED, service.requests
        assert {200, 201, 204, 400, 404, 405, 409, 412, 422} <= set(service.statuses), service.statuses
        print(f"{service.requests} requests in {time.monotonic() - began:.0f} s: {dict(sorted(service.statuses.items()))}")
    finally:
        daemon, service = service.daemon, None
        daemon.stop()
