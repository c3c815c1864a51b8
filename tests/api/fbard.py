"""Starts a daemon and speaks to it as curl would, over connections that are never reused."""
import datetime
import http.client
import json
import os
import pathlib
import re
import resource
import signal
import subprocess
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROGRAM = os.environ.get("FBARD") or str(ROOT / "build" / "fbard")
# Sanitizers make the daemon several times slower; a busy machine is allowed for besides. No test measures anything by
# it: what would take so long hangs.
PATIENCE = 120.0
FINAL = ("completed", "failed", "cancelled")
STATES = ("queued", "running", "waiting", "paused") + FINAL
SANITIZER = re.compile(r"AddressSanitizer|LeakSanitizer|ThreadSanitizer|UndefinedBehavior|runtime error:")

# What was asked and answered in this session, for test_openapi: {(method, path, status): [Reply]}.
EXCHANGES = []


def is_sanitized():
    with open(PROGRAM, "rb") as f:
        return re.search(rb"__(asan|tsan)_init", f.read()) is not None


def until(condition, seconds=PATIENCE, every=0.005):
    """The first true value of `condition`, asked again and again. Where all stood still between two looks, as machines do
    now and then, only a second of it counts."""
    left, now = seconds, time.monotonic()
    while True:
        value = condition()
        if value:
            return value
        assert left > 0, f"not within {seconds} s: {condition}"
        time.sleep(every)
        before, now = now, time.monotonic()
        left -= min(now - before, 1.0)


def strict_json(text):
    """JSON as RFC 8259 has it: no NaN, no key twice."""

    def pairs(items):
        keys = [k for k, _ in items]
        assert len(keys) == len(set(keys)), f"a key twice in {keys}"
        return dict(items)

    def constant(word):
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, object_pairs_hook=pairs, parse_constant=constant)


class Reply:
    def __init__(self, method, path, status, headers, body):
        self.method, self.path, self.status, self.body = method, path, status, body
        self.headers = {k.lower(): v for k, v in headers}

    @property
    def type(self):
        return self.headers.get("content-type", "").split(";")[0].strip()

    @property
    def json(self):
        return strict_json(self.body.decode("utf-8"))

    @property
    def pointers(self):
        return [e["pointer"] for e in self.json.get("errors", [])]

    def fault(self, pointer):
        """The one error of this pointer."""
        found = [e for e in self.json.get("errors", []) if e["pointer"] == pointer]
        assert len(found) == 1, f"{len(found)} errors of {pointer!r}: {self}"
        return found[0]

    def __repr__(self):
        return f"{self.method} {self.path} -> {self.status} {self.headers} {self.body[:2000]!r}"


def check_form(reply):
    """What holds of every answer."""
    if reply.status >= 400:
        assert reply.type == "application/problem+json", reply
        problem = reply.json
        for key, kind in (("type", str), ("title", str), ("status", int), ("detail", str)):
            assert isinstance(problem.get(key), kind), (key, reply)
        assert problem["status"] == reply.status, reply
        assert problem["title"] and problem["detail"], reply
        for error in problem.get("errors", []):
            for key in ("pointer", "code", "detail"):
                assert isinstance(error.get(key), str), (key, reply)
            assert error["pointer"] == "" or error["pointer"].startswith("/"), reply
            for key in ("expected", "actual"):
                assert key in error, (key, reply)
        if reply.status == 422:
            assert problem.get("errors"), reply
        if reply.status in (429, 503):
            assert "retry-after" in reply.headers, reply
        if reply.status == 405:
            assert reply.headers.get("allow"), reply
    elif reply.type == "application/json":
        reply.json
    return reply


class Daemon:
    def __init__(self, folder, *options, slots=2, threads=1):
        self.folder = pathlib.Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.data = self.folder / "data"
        self.options = options
        self.slots, self.threads = slots, threads
        self.process = None
        self.token = None
        self.starts = 0
        self.environment = {}
        self.limits = {}  # of the process: resource.RLIMIT_... -> value

    # ---- The process ----

    def command(self):
        return [
            PROGRAM, "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0",
            "--port-file", str(self.folder / "ports.json"), "--data-dir", str(self.data),
            "--slots", str(self.slots), *(["--threads", str(self.threads)] if self.threads else []), *self.options,
        ]  # fmt: skip

    def start(self):
        ports = self.folder / "ports.json"
        ports.unlink(missing_ok=True)
        self.starts += 1
        self.log = self.folder / f"stderr-{self.starts}.txt"
        with open(self.log, "wb") as log:
            suppressions = pathlib.Path(__file__).with_name("tsan.supp")
            environment = {"TSAN_OPTIONS": f"suppressions={suppressions}", **os.environ, **self.environment}
            self.process = subprocess.Popen(self.command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                                            env=environment, preexec_fn=self.limit)  # fmt: skip

        def ready():
            assert self.process.poll() is None, f"exit {self.process.returncode}: {self.stderr()}"
            return ports.exists()

        until(ready)
        where = strict_json(ports.read_text())
        self.http, self.publish = where["http"], where["publish"]
        self.host = self.http.split("//")[1]
        return self

    def limit(self):
        for what, value in self.limits.items():
            resource.setrlimit(what, (value, value))

    def stderr(self):
        return self.log.read_text(errors="replace")

    def stop(self, how=signal.SIGTERM):
        """Ends it as an operator would, and checks that nothing went wrong on the way."""
        if self.process is None:
            return
        process, self.process = self.process, None
        early = process.poll()
        if early is None:
            process.send_signal(how)
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise AssertionError(f"does not stop: {self.stderr()[-4000:]}")
        assert early is None, f"it was gone already, exit {early}: {self.stderr()[-4000:]}"
        assert not SANITIZER.search(self.stderr()), self.stderr()[-8000:]
        assert process.returncode == 0, f"exit {process.returncode}: {self.stderr()[-4000:]}"

    def kill(self):
        """kill -9."""
        self.process.kill()
        self.process.wait()
        self.process = None
        assert not SANITIZER.search(self.stderr()), self.stderr()[-8000:]

    def memory(self):
        """Resident bytes."""
        with open(f"/proc/{self.process.pid}/status") as f:
            return 1024 * int(re.search(r"VmRSS:\s+(\d+)", f.read())[1])

    def descriptors(self):
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def n_threads(self):
        return len(os.listdir(f"/proc/{self.process.pid}/task"))

    def cpu_seconds(self):
        """Processor time of the process, by the kernel's account (proc(5): utime, stime)."""
        with open(f"/proc/{self.process.pid}/stat") as f:
            fields = f.read().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def was_over(self, run):
        """Whether a run was over when its daemon was killed or stopped, by what is on the disk."""
        log = (self.data / "runs" / run / "events.jsonl").read_text()
        return any(f'"state":"{state}"' in log for state in FINAL)

    # ---- HTTP ----

    def request(self, method, path, body=None, headers=None, check=True):
        """One request. `body`: bytes as they are, anything else as JSON."""
        headers = dict(headers or {})
        if body is not None and not isinstance(body, bytes):
            body = json.dumps(body).encode()
            headers.setdefault("Content-Type", "application/json")
        if self.token:
            headers.setdefault("Authorization", "Bearer " + self.token)
        connection = http.client.HTTPConnection(self.host, timeout=PATIENCE)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            reply = Reply(method, path, answer.status, answer.getheaders(), answer.read())
        finally:
            connection.close()
        EXCHANGES.append(reply)
        return check_form(reply) if check else reply

    def ask(self, method, path, body=None, headers=None, status=200):
        reply = self.request(method, path, body, headers)
        assert reply.status == status, reply
        return reply

    def get(self, path, **headers):
        return self.ask("GET", path, headers=headers).json

    # ---- Runs ----

    def create(self, scene, **more):
        return self.ask("POST", "/v1/runs", {"scene": scene, **more}, status=201).json

    def run(self, run):
        return self.get(f"/v1/runs/{run}")

    def act(self, run, action, body=None):
        return self.ask("POST", f"/v1/runs/{run}:{action}", body).json

    def patch(self, run, patch, **headers):
        return self.ask("PATCH", f"/v1/runs/{run}/config", patch, headers).json

    def wait(self, run, *states):
        def there():
            now = self.run(run)
            assert now["state"] in states or now["state"] not in FINAL, now
            return now["state"] in states and now

        return until(there)

    def settle(self, run):
        """Until a run that was created and not started has its simulation and its first frame, after which nothing of it
        changes by itself."""
        return until(lambda: (now := self.run(run))["balance"]["mass"] and now["journal"]["frames"] > 0 and now)

    def wait_step(self, run, step):
        """Until it has come so far."""
        return until(lambda: (now := self.run(run))["step"] >= step and now)

    def frame(self, run, seq):
        reply = self.ask("GET", f"/v1/runs/{run}/frames/{seq}")
        assert reply.type == "application/vnd.fbard.frame", reply.headers
        return reply.body

    def frames(self, run):
        return self.get(f"/v1/runs/{run}/frames")["frames"]

    def csv(self, run, query=""):
        reply = self.ask("GET", f"/v1/runs/{run}/probes{query}", headers={"Accept": "text/csv"})
        assert reply.type == "text/csv", reply
        return reply.body.decode()

    def away(self, *runs):
        """Cancels and deletes: no test leaves anything for the next."""
        for run in runs:
            if self.run(run)["state"] not in FINAL:
                reply = self.request("POST", f"/v1/runs/{run}:cancel")
                assert reply.status in (200, 409), reply  # it may have ended meanwhile
                until(lambda run=run: self.run(run)["state"] in FINAL)  # a slow disk has it wait for its last frame
            self.ask("DELETE", f"/v1/runs/{run}", status=204)


def fbar_is_on(run):
    """`fbar` of a run object: a boolean, a scheme's name, or its object."""
    value = run["fbar"]
    return value if isinstance(value, bool) else value not in (None, "off")


def timestamp(text):
    return datetime.datetime.fromisoformat(text.replace("Z", "+00:00"))
