"""The command line, signals, and what survives them."""
import concurrent.futures
import http.client
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import ssl
import stat
import subprocess
import threading
import time
import warnings

import pytest
from boxes import big, endless, merged, water
from fbard import PATIENCE, PROGRAM, Daemon, fbar_is_on, is_sanitized, until
from frames import Frame
from test_watching import metrics


def launch(*options, **more):
    """Runs a daemon that is not expected to stay."""
    return subprocess.run([PROGRAM, *map(str, options)], capture_output=True, text=True, timeout=PATIENCE, **more)


def refused(*options, code=None, **more):
    ended = launch(*options, **more)
    assert ended.returncode > 0, ended
    assert code is None or ended.returncode == code, ended
    assert ended.stderr.strip(), "no message"
    assert "Sanitizer" not in ended.stderr, ended.stderr
    return ended.stderr


FREE = ("--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0")


# ---- Starting ----


def test_help_and_version(tmp_path):
    ended = launch("--help")
    assert ended.returncode == 0
    for option in ("--http", "--publish", "--data-dir", "--threads", "--slots", "--resume", "--token-file", "--tls-cert",
                   "--tls-key", "--curve-dir", "--port-file", "--insecure"):  # fmt: skip
        assert option in ended.stdout
    ended = launch("--version")
    assert ended.returncode == 0
    assert re.search(r"\d+\.\d+", ended.stdout)
    assert not ended.stderr


@pytest.mark.parametrize(
    "options",
    [("--colour",), ("blue",), ("--http",), ("--http", "nonsense"), ("--http", "127.0.0.1:99999"),
     ("--http", "127.0.0.1:-1"), ("--publish", "udp://x"), ("--threads", "0"), ("--threads", "many"), ("--slots", "-1"),
     ("--resume", "maybe"), ("--tls-cert", "x"), ("--data-dir", "")],
)  # fmt: skip
def test_bad_options_exit_2(tmp_path, options):
    refused("--data-dir", tmp_path / "data", *options, code=2)


@pytest.mark.parametrize(
    "option, value, expected",
    [("--slots", "0", "1 to 1024"), ("--threads", "1025", "1 to 1024"), ("--queue", "-1", "1 to 100000"),
     ("--memory-limit", "1e9", "bytes"), ("--publish", "udp://x", "tcp://"), ("--http", "::1:0", "in brackets")],
)  # fmt: skip
def test_bad_options_say_what_was_expected(tmp_path, option, value, expected):
    message = refused("--data-dir", tmp_path / "data", option, value, code=2)
    assert f"fbard: {option}: must be " in message and expected in message and f"got '{value}'" in message


def test_publish_takes_localhost_as_http_does(tmp_path):
    d = Daemon(tmp_path, "--publish", "tcp://localhost:0").start()
    try:
        assert re.fullmatch(r"tcp://127\.0\.0\.1:[1-9]\d+", d.publish)
    finally:
        d.stop()


def test_port_file_has_both_addresses_and_they_answer(daemon):
    ports = json.loads((daemon.folder / "ports.json").read_text())
    assert set(ports) == {"http", "publish"}
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+", ports["http"])
    assert re.fullmatch(r"tcp://127\.0\.0\.1:\d+", ports["publish"])
    assert daemon.ask("GET", "/healthz").status == 200
    assert daemon.ask("GET", "/readyz").status == 200
    with socket.create_connection(("127.0.0.1", int(ports["publish"].rsplit(":", 1)[1])), timeout=PATIENCE):
        pass
    assert [p.name for p in daemon.folder.iterdir() if p.name.startswith("ports")] == ["ports.json"]


def test_version_resource_describes_the_daemon(daemon):
    about = daemon.get("/v1")
    assert re.search(r"\d+\.\d+", str(about["version"]))
    text = json.dumps(about)
    assert daemon.http in text and daemon.publish in text
    assert "threads" in text and "limits" in about


def test_process_is_called_by_its_name(daemon):
    """Not "exe", by which it starts itself once more: ps, top and pidof must find it."""
    with open(f"/proc/{daemon.process.pid}/comm") as f:
        assert f.read() == "fbard\n"


def test_small_runs_have_fewer_threads_unless_told_otherwise(fresh):
    """`--help`: cores / slots; fewer for a small run (one for each 4,096 particles)."""
    for threads, small, large in ((None, 1, min(len(os.sched_getaffinity(0)), 51200 // 4096)), (3, 3, 3)):
        d = fresh(slots=1, threads=threads).start()
        for cell, particles, wanted in ((0.25, 3200, small), (0.0625, 51200, large)):
            run = d.create("dam-break", start=False, overrides={"cell": cell})
            assert (run["particles"], run["performance"]["threads"]) == (particles, wanted)


def test_busy_http_port_is_an_error_that_names_it(daemon, tmp_path):
    message = refused("--http", daemon.host, "--publish", "tcp://127.0.0.1:0", "--data-dir", tmp_path / "d")
    assert daemon.host.split(":")[1] in message


def test_busy_publish_port_is_an_error_that_names_it(daemon, tmp_path):
    message = refused("--http", "127.0.0.1:0", "--publish", daemon.publish, "--data-dir", tmp_path / "d")
    assert daemon.publish.rsplit(":", 1)[1] in message


def test_second_daemon_on_one_data_folder_is_refused(daemon):
    message = refused(*FREE, "--data-dir", daemon.data)
    assert str(daemon.data) in message
    assert daemon.get("/healthz") is not None


def test_data_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    assert "file" in refused(*FREE, "--data-dir", tmp_path / "file")
    assert "file" in refused(*FREE, "--data-dir", tmp_path / "file" / "below")
    assert (tmp_path / "file").read_text() == "x"


def test_data_folder_without_write_permission_is_refused(tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    # root may write where the mode forbids it, but not below /proc
    if os.geteuid() == 0:
        folder = "/proc/fbard"
    else:
        folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    assert str(folder) in refused(*FREE, "--data-dir", folder)


def test_port_file_that_cannot_be_written_is_an_error(tmp_path):
    where = tmp_path / "none" / "ports.json"
    assert str(where) in refused(*FREE, "--data-dir", tmp_path / "d", "--port-file", where)


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "192.0.2.1"])
def test_addresses_beyond_loopback_need_protection(tmp_path, host):
    common = ("--data-dir", tmp_path / "d")
    assert "--insecure" in refused("--http", f"{host}:0", "--publish", "tcp://127.0.0.1:0", *common)
    assert refused("--http", "127.0.0.1:0", "--publish", f"tcp://{host}:0", *common)


def test_missing_or_empty_token_file_is_refused(tmp_path):
    assert "none" in refused(*FREE, "--data-dir", tmp_path / "d", "--token-file", tmp_path / "none")
    (tmp_path / "empty").write_text("")
    (tmp_path / "empty").chmod(0o600)
    refused(*FREE, "--data-dir", tmp_path / "d", "--token-file", tmp_path / "empty")


def test_token_that_is_too_long_is_refused_and_not_cut(tmp_path):
    (tmp_path / "token").write_text("a" * 4097)
    (tmp_path / "token").chmod(0o600)
    assert "4096" in refused(*FREE, "--data-dir", tmp_path / "d", "--token-file", tmp_path / "token")


def test_token_file_that_others_can_read_is_refused(tmp_path):
    (tmp_path / "token").write_text("secret\n")
    for mode in (0o644, 0o640, 0o604):
        (tmp_path / "token").chmod(mode)
        assert "chmod 600" in refused(*FREE, "--data-dir", tmp_path / "d", "--token-file", tmp_path / "token")


def test_token_is_required_where_one_is_given(fresh, tmp_path):
    token = tmp_path / "token"
    token.write_text("correct-horse-battery\n")
    token.chmod(0o600)
    d = fresh("--token-file", str(token)).start()
    for header in (None, "Bearer wrong", "Bearer ", "Bearer correct-horse-batter", "Bearer correct-horse-battery1",
                   "Basic Y29ycmVjdC1ob3JzZQ==", "correct-horse-battery"):  # fmt: skip
        headers = {"Authorization": header} if header else {}
        for method, path, body in (("GET", "/v1/runs", None), ("POST", "/v1/runs", {"scene": water()}),
                                   ("GET", "/v1/runs/x/frames/0", None)):  # fmt: skip
            reply = d.ask(method, path, body, headers, status=401)
            assert "bearer" in reply.headers["www-authenticate"].lower()
    d.token = "correct-horse-battery"
    assert d.get("/v1/runs") == {"runs": []}
    run = d.create(water())["id"]
    d.wait(run, "completed")
    assert "correct-horse" not in d.stderr()


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_it_with_exit_0(fresh, how):
    d = fresh().start()
    for _ in range(3):
        d.create(endless())
    d.create(endless(), start=False)
    d.stop(how)
    assert all("=" in line for line in d.stderr().splitlines() if line), "logs are key=value"


def test_logs_stay_one_line_each_whatever_a_request_holds(fresh):
    d = fresh().start()
    run = d.create(water(title='a\nlevel=error event="forged"\x7f\u2028'), start=False)["id"]
    d.request("GET", "/v1/runs/%0alevel=error")
    d.away(run)
    d.stop()
    assert not [line for line in d.stderr().splitlines() if line.startswith("level=error") or "forged" in line[:30]]
    assert all("=" in line for line in d.stderr().splitlines() if line)


def test_tls_serves_https(tmp_path):
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    subprocess.run(["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost",
                    "-keyout", key, "-out", cert], check=True, capture_output=True)  # fmt: skip
    assert refused(*FREE, "--data-dir", tmp_path / "x", "--tls-cert", tmp_path / "none", "--tls-key", key)
    key.chmod(0o604)
    assert "chmod 640" in refused(*FREE, "--data-dir", tmp_path / "x", "--tls-cert", cert, "--tls-key", key)
    key.chmod(0o640)
    d = Daemon(tmp_path / "d", "--tls-cert", str(cert), "--tls-key", str(key)).start()
    try:
        assert d.http.startswith("https://127.0.0.1:")
        context = ssl.create_default_context(cafile=str(cert))
        context.check_hostname = False
        connection = http.client.HTTPSConnection(d.host, timeout=PATIENCE, context=context)
        connection.request("GET", "/v1/runs")
        answer = connection.getresponse()
        assert (answer.status, json.loads(answer.read())) == (200, {"runs": []})
        connection.close()
        # RFC 8996: no TLS before 1.2. SECLEVEL=0, so that it is not this side that refuses.
        for version, taken in ((ssl.TLSVersion.TLSv1_1, False), (ssl.TLSVersion.TLSv1_2, True)):
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
            context.set_ciphers("ALL:@SECLEVEL=0")
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                context.minimum_version = context.maximum_version = version
            host, port = d.host.split(":")
            with socket.create_connection((host, int(port)), timeout=PATIENCE) as plain:
                if taken:
                    context.wrap_socket(plain).close()
                else:
                    with pytest.raises((ssl.SSLError, ConnectionError)):
                        context.wrap_socket(plain)
    finally:
        d.stop()


def test_not_ready_without_the_data_folder(fresh):
    d = fresh().start()
    d.ask("GET", "/readyz")
    away = d.data.with_name("away")
    d.data.rename(away)
    reply = d.ask("GET", "/readyz", status=503)
    assert f"{d.data}/runs: No such file" in reply.json["detail"], reply
    d.ask("POST", "/v1/runs", {"scene": endless()}, status=507)  # as it foretold
    d.ask("GET", "/healthz")
    away.rename(d.data)
    d.ask("GET", "/readyz")
    d.away(d.create(endless())["id"])


def test_not_ready_where_the_disk_is_full(fresh):
    d = fresh()
    d.data.mkdir()

    def mount(options):
        return subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", d.data], capture_output=True).returncode

    if mount("size=512k"):
        pytest.skip("cannot mount a small tmpfs here")
    try:
        d.start()
        assert "bytes and" in d.ask("GET", "/readyz", status=503).json["detail"]
        mount("remount,size=16m")
        d.ask("GET", "/readyz")
        mount("remount,nr_inodes=8")
        assert "files are left" in d.ask("GET", "/readyz", status=503).json["detail"]
        mount("remount,nr_inodes=100")
        d.ask("GET", "/readyz")
        d.stop()
    finally:
        subprocess.run(["umount", "-l", d.data])


def test_queue_that_is_full_is_503_and_not_ready(fresh):
    d = fresh("--queue", "1", slots=1).start()
    first, second = (d.create(endless())["id"] for _ in range(2))
    d.ask("POST", "/v1/runs", {"scene": endless()}, status=503)
    d.ask("GET", "/readyz", status=503)
    d.ask("GET", "/healthz")
    d.away(first)
    d.ask("GET", "/readyz")
    third = d.create(endless())["id"]
    d.wait_step(second, 1)
    d.away(second, third)


# ---- Restarting ----


def test_restart_lists_earlier_runs_with_frames_and_probes(fresh):
    d = fresh().start()
    done = d.create(water())["id"]
    d.wait(done, "completed")
    failed = d.create(merged(endless(), {"bodies": {"bar": {"velocity": [-50, 0]}}, "walls": {"end": None}}))["id"]
    d.wait(failed, "failed")
    cancelled = d.create(endless())["id"]
    d.act(cancelled, "cancel")
    paused = d.create(water(), start=False)["id"]
    d.act(paused, "step", {"steps": 33})
    d.wait(paused, "paused")
    runs = (done, failed, cancelled, paused)

    def everything():
        return {r: (d.run(r), d.csv(r), d.get(f"/v1/runs/{r}/scene"), d.get(f"/v1/runs/{r}/config"),
                    [d.frame(r, f["seq"]) for f in d.frames(r)]) for r in runs}  # fmt: skip

    before = everything()
    d.stop()
    d.start()
    after = everything()
    for run in runs:
        for was, now in zip(before[run][1:], after[run][1:]):
            assert was == now
        for key in ("id", "state", "step", "time", "end_time", "progress", "fbar", "particles", "scene", "created",
                    "error", "balance", "probes", "accuracy"):  # fmt: skip
            assert after[run][0][key] == before[run][0][key], (key, run)
        assert after[run][0]["performance"]["wall_s"] == pytest.approx(before[run][0]["performance"]["wall_s"])
    d.act(paused, "resume")
    d.wait(paused, "completed")
    assert d.csv(paused) == d.csv(done)
    for run in runs:
        d.ask("DELETE", f"/v1/runs/{run}", status=204)
    d.stop()
    d.start()
    assert d.get("/v1/runs")["runs"] == []


# 12,000 steps and 121 frames, long enough to be killed in the middle; sanitizers are that much slower
LONG = water(time={"end": 4.5 if is_sanitized() else 20}, output={"interval": 0.2, "probe_interval": 0.02})


def undisturbed(d, run):
    """(frames, CSV) of a run once it is completed."""
    d.wait(run, "completed")
    return [d.frame(run, f["seq"]) for f in d.frames(run)], d.csv(run)


@pytest.fixture(scope="module")
def reference(daemon):
    """LONG, with F-bar switched off at step 1000 and a changed end."""
    run = daemon.create(LONG, id="survivor", start=False)["id"]
    daemon.act(run, "step", {"steps": 1000})
    daemon.wait(run, "paused")
    daemon.patch(run, {"fbar": False})
    daemon.act(run, "resume")
    yield undisturbed(daemon, run)
    daemon.away(run)


def begin(d):
    d.create(LONG, id="survivor", start=False)
    d.act("survivor", "step", {"steps": 1000})
    d.wait("survivor", "paused")
    assert d.patch("survivor", {"fbar": False})["effective_step"] == 1000
    d.act("survivor", "resume")


def check_same(d, reference):
    frames, text = undisturbed(d, "survivor")
    assert len(frames) == len(reference[0])
    for ours, theirs in zip(frames, reference[0]):
        a, b = Frame(ours), Frame(theirs)
        assert a.header == b.header
        assert ours == theirs
    assert text == reference[1]
    assert not fbar_is_on(d.run("survivor"))


def in_motion(d, reach, end):
    """Begins the run, waits until it has come as far as `reach` does, and ends the daemon while the run is in motion: one
    that was over before, because all but the daemon stood still meanwhile, is made once more. What `reach` gave."""
    for _ in range(20):
        begin(d)
        reached = reach()
        end()
        if not d.was_over("survivor"):
            return reached
        d.start()
        d.away("survivor")
    raise AssertionError("too quick a machine: it is over each time")


@pytest.mark.parametrize("checkpoint", [False, True], ids=["from_the_start", "from_a_checkpoint"])
def test_killed_run_continues_to_the_same_end(fresh, reference, checkpoint):
    d = fresh().start()

    def reach():
        d.wait_step("survivor", 1500)
        if checkpoint:
            d.request("POST", "/v1/runs/survivor:checkpoint")
        d.wait_step("survivor", 2500)
        return [d.frame("survivor", f["seq"]) for f in d.frames("survivor")]

    before = in_motion(d, reach, d.kill)
    d.start()
    after = [d.frame("survivor", k) for k in range(len(before))]
    assert after == before, "a frame once published never changes"
    check_same(d, reference)


def test_killed_again_and_again_it_still_comes_to_the_same_end(fresh, reference):
    d = fresh().start()
    begin(d)
    for step in (1200, 2000, 2800, 3600):
        d.wait_step("survivor", step)
        d.kill()
        d.start()
    check_same(d, reference)


def test_stopped_run_continues_to_the_same_end(fresh, reference):
    d = fresh().start()
    step = in_motion(d, lambda: d.wait_step("survivor", 2000)["step"], d.stop)
    d.start()
    run = d.run("survivor")
    assert run["state"] in ("queued", "running", "waiting", "completed")
    assert run["step"] >= step, "it was checkpointed"
    check_same(d, reference)


def test_killed_right_after_201_the_run_is_there(fresh):
    d = fresh().start()
    runs = [d.create(water(), start=start)["id"] for start in (True, False)]
    d.kill()
    d.start()
    assert {r["id"] for r in d.get("/v1/runs")["runs"]} == set(runs)
    d.wait(runs[0], "completed")
    assert d.run(runs[1])["state"] == "paused"
    d.act(runs[1], "resume")
    d.wait(runs[1], "completed")
    assert d.csv(runs[0]) == d.csv(runs[1])


class Crowd:
    """Clients that create and delete until the daemon is gone, and what they were answered."""

    def __init__(self, daemon):
        self.daemon, self.lock = daemon, threading.Lock()
        self.there, self.gone, self.unanswered, self.count = set(), set(), set(), 0

    def create(self, random_):
        with self.lock:
            self.count += 1
            name = f"k{self.count}"
            self.unanswered.add(name)
        key = {"Idempotency-Key": name} if random_.random() < 0.5 else {}
        body = {"scene": water(time={"end": 0.002}), "id": name, "start": random_.random() < 0.5}
        assert self.daemon.request("POST", "/v1/runs", body, key).status == 201
        with self.lock:
            self.unanswered.discard(name)
            self.there.add(name)

    def delete(self, random_):
        with self.lock:
            if not self.there:
                return
            name = random_.choice(sorted(self.there))
            self.there.discard(name)
            self.unanswered.add(name)
        self.daemon.request("POST", f"/v1/runs/{name}:cancel")
        reply = self.daemon.request("DELETE", f"/v1/runs/{name}")
        assert reply.status in (204, 409), reply  # 409: it is ending
        with self.lock:
            self.unanswered.discard(name)
            (self.gone if reply.status == 204 else self.there).add(name)

    def work(self, seed):
        random_ = random.Random(seed)
        try:
            while True:
                (self.create if random_.random() < 0.6 else self.delete)(random_)
        except (OSError, http.client.HTTPException):
            pass  # killed


def test_kills_amid_creation_and_deletion_leave_what_was_answered(fresh):
    """What was answered with 201 is there, what was answered with 204 is not, and nothing is half there."""
    d = fresh("--queue", "5000").start()
    crowd, random_ = Crowd(d), random.Random(int(os.environ.get("FBARD_SEED", 3)))
    for rounds in range(1, 1 + (40 if os.environ.get("FBARD_LONG") else 4)):
        with concurrent.futures.ThreadPoolExecutor(6) as pool:
            clients = [pool.submit(crowd.work, random_.random()) for _ in range(6)]
            until(lambda: crowd.count > 5 * rounds and crowd.gone)  # some were made, and one is gone for sure
            time.sleep(random_.uniform(0.05, 0.5))
            d.kill()
            for client in clients:
                client.result()
        d.start()
        until(lambda: d.request("GET", "/v1/runs").status == 200)  # has read all of them
        runs = {run["id"]: run for run in d.get("/v1/runs")["runs"]}
        assert crowd.there <= set(runs) and not crowd.gone & set(runs)
        assert not [run for run in runs.values() if run["state"] == "failed"]
        assert set(os.listdir(d.data / "runs")) == set(runs), "nothing is left of the others"
        for name in crowd.unanswered:
            (crowd.there if name in runs else crowd.gone).add(name)
        crowd.unanswered.clear()


def test_resume_paused_and_off_leave_runs_paused(fresh):
    d = fresh("--resume", "paused").start()
    run = d.create(endless())["id"]
    d.wait_step(run, 100)
    d.stop()
    d.start()
    now = d.run(run)
    assert now["state"] == "paused" and now["step"] >= 100
    d.act(run, "resume")
    d.wait_step(run, now["step"] + 10)
    d.stop()
    d.options = ("--resume", "off")
    d.start()
    assert d.run(run)["state"] == "paused"
    d.away(run)


def test_pause_survives_a_kill(fresh):
    d = fresh().start()
    run = d.create(endless())["id"]
    d.wait_step(run, 100)
    step = d.act(run, "pause")["effective_step"]
    d.kill()
    d.start()
    assert (d.run(run)["state"], d.run(run)["step"]) == ("paused", step)
    d.act(run, "step", {"steps": 5})
    assert d.wait(run, "paused")["step"] == step + 5
    d.away(run)


def test_interrupted_step_still_ends_where_it_was_to(fresh):
    d = fresh().start()
    run = d.create(endless(), start=False)["id"]
    d.act(run, "step", {"steps": 30_000})
    d.wait_step(run, 100)
    d.kill()
    d.start()
    assert d.wait(run, "paused")["step"] == 30_000
    d.away(run)


@pytest.mark.parametrize("queued", [True, False], ids=["queued", "running"])
def test_resumed_step_has_no_end_any_more(fresh, queued):
    """Also while it waits for a slot, and over a kill."""
    d = fresh(slots=1).start()
    other = d.create(endless(), start=queued)["id"]
    run = d.create(endless(), start=False)["id"]
    step = d.act(run, "step", {"steps": 30 if queued else 3000})
    assert step["state"] in (("queued",) if queued else ("running", "queued"))
    d.act(run, "resume")
    d.kill()
    d.start()
    d.act(other, "pause")
    d.wait_step(run, 31 if queued else 3001)
    assert d.run(run)["state"] == "running"
    d.away(run, other)


def test_a_damaged_run_does_not_keep_the_daemon_from_starting(fresh):
    d = fresh().start()
    good, bad, worse = (d.create(water(), id=i)["id"] for i in ("good", "bad", "worse"))
    for run in (good, bad, worse):
        d.wait(run, "completed")
    d.stop()
    for path in d.data.rglob("*"):
        if path.is_file() and "/bad/" in str(path):
            path.write_bytes(b"\xff\0garbage" * 10)
        elif path.is_file() and "/worse/" in str(path):
            path.write_bytes(b"")
    (d.data / "runs" / "empty").mkdir()
    (d.data / "runs" / "stray").write_text("not a folder")
    d.start()
    assert d.run(good)["state"] == "completed"
    assert len(d.frames(good)) == 11
    for run in (bad, worse):
        reply = d.request("GET", f"/v1/runs/{run}")
        assert reply.status in (200, 404)
        if reply.status == 200:
            assert reply.json["state"] == "failed" and reply.json["error"]["kind"]
            d.ask("DELETE", f"/v1/runs/{run}", status=204)
    again = d.create(water())["id"]
    d.wait(again, "completed")


def test_nothing_is_removed_through_a_link_in_the_data_folder(fresh, tmp_path):
    """A run's folder may be a link to a larger disk, or to anywhere: what it names is not the daemon's."""
    d = fresh().start()
    d.stop()
    runs, foreign = d.data / "runs", tmp_path / "foreign"
    for folder in ("deleted", "old", "new"):
        (foreign / folder).mkdir(parents=True)
        (foreign / folder / "precious").write_text("x")
    (runs / ".snapshots").mkdir()
    (runs / ".snapshots" / "precious").write_text("x")
    for link, to in (("linked", "deleted"), (".old-x", "old"), (".new-x", "new")):
        (runs / link).symlink_to(foreign / to)
    d.start()
    assert d.run("linked")["state"] == "failed"
    d.ask("DELETE", "/v1/runs/linked", status=204)
    d.create(endless(), id="x", start=False)  # clears .new-x before
    assert all((foreign / folder / "precious").exists() for folder in ("deleted", "old", "new"))
    assert (runs / ".snapshots" / "precious").exists(), "neither what merely begins with a dot"
    assert sorted(p.name for p in runs.iterdir()) == [".snapshots", "x"]


def test_torn_tails_are_cut(fresh, reference):
    d = fresh().start()
    in_motion(d, lambda: d.wait_step("survivor", 2000), d.kill)
    folder = d.data / "runs" / "survivor"
    for path in folder.rglob("*"):
        if path.is_file() and (path.suffix in (".jsonl", ".log") or "frame" in path.name):
            with open(path, "ab") as f:
                f.write(b'{"event": "sta')
    d.start()
    check_same(d, reference)


def test_a_full_disk_is_warned_of_while_it_is_full(tmp_path):
    """A run waits for room, or fails; the log tells of it once, and the warning goes with its cause."""
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("cannot mount a small tmpfs here")
    try:
        d = Daemon(tmp_path).start()
        try:
            scene = water(output={"interval": 1e-3}, bodies={"pool": {"particles_per_cell": 100}})
            d.create(scene, id="waits", start=False)
            d.create(merged(scene, {"output": {"when_full": "fail"}}), id="fails", start=False)
            for run in ("waits", "fails"):  # both are there before either fills the disk
                d.settle(run)
            for run in ("waits", "fails"):
                d.act(run, "start")
            error = d.wait("fails", "failed")["error"]
            assert error["kind"] == "journal" and error["quantity"] is None
            d.wait("waits", "waiting")
            time.sleep(1.2)  # it is tried again twice
            assert "room on the disk" in d.run("waits")["warnings"][0]
            assert sum("event=journal topic=run/waits" in line for line in d.stderr().splitlines()) == 1
            subprocess.run(["mount", "-o", "remount,size=100m", tmp_path], check=True)
            assert d.wait("waits", "completed")["warnings"] == []
        finally:
            d.stop()
    finally:
        subprocess.run(["umount", "-l", tmp_path])


def test_a_change_that_a_full_disk_refuses_leaves_the_run_as_it_was(tmp_path):
    """And not failed: a change that could not be logged must not have been made."""
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("cannot mount a small tmpfs here")
    try:
        d = Daemon(tmp_path).start()
        try:
            for run, start in (("runs", True), ("paused", False)):
                d.create(endless(), id=run, start=start)
            until(lambda: d.frames("runs") and d.frames("paused"))
            fill = tmp_path / "fill"
            subprocess.run(["dd", "if=/dev/zero", f"of={fill}", "bs=4k"], capture_output=True)
            for run, state in (("runs", "running"), ("paused", "paused")):
                made = 0  # as many as what is left of the log's last page holds
                while (reply := d.request("PATCH", f"/v1/runs/{run}/config",
                                          {"gravity": [1e-9 * (made + 1), 0]})).status == 200:  # fmt: skip
                    made += 1
                assert reply.status == 507 and "No space" in reply.json["detail"], reply
                now = d.run(run)
                assert (now["state"], now["revision"], now["error"]) == (state, made, None), now
                assert d.get(f"/v1/runs/{run}/config")["gravity"] == [1e-9 * made, 0]
            fill.unlink()
            for run in ("runs", "paused"):
                d.patch(run, {"gravity": [1, 0]})
            d.away("runs", "paused")
        finally:
            d.stop()
    finally:
        subprocess.run(["umount", "-l", tmp_path])


# ---- Scarcity ----

TINY = water(time={"end": 0.002}, output={"interval": 0.001})


def stacks(d):
    """Mappings of a thread's stack's size: those of threads that nobody has joined are there still."""
    size = resource.getrlimit(resource.RLIMIT_STACK)[0]
    size = size if size != resource.RLIM_INFINITY else 2 << 20  # as glibc takes it
    with open(f"/proc/{d.process.pid}/maps") as f:
        areas = [[int(x, 16) for x in line.split()[0].split("-")] for line in f]
    return sum(end - begin == size for begin, end in areas)


def test_runs_that_are_over_hold_no_files_and_no_threads(fresh):
    """More of them than there may be files, now and after a restart; their events can still be read."""
    d = fresh()
    d.limits = {resource.RLIMIT_NOFILE: 64}
    d.start()
    runs = [f"r{k}" for k in range(70)]
    for k, run in enumerate(runs):
        d.create(TINY, id=run)
        d.wait(run, "completed")
    until(lambda: d.descriptors() < 20)
    until(lambda: stacks(d) < 30)  # 70 threads have ended; glibc keeps some stacks for the next
    d.stop()
    d.start()
    until(lambda: d.descriptors() < 20)
    for run in runs:
        now = d.run(run)
        assert now["state"] == "completed" and now["journal"]["frames"] == 3, now
    log = d.ask("GET", "/v1/runs/r0/events", headers={"Last-Event-ID": "0"}).body.decode()
    assert log.startswith("id: 1\n") and '"state":"completed"' in log


def test_few_descriptors_are_no_way_to_lock_others_out(fresh):
    d = fresh()
    d.limits = {resource.RLIMIT_NOFILE: 64}
    d.start()
    assert d.get("/v1")["limits"]["connections"] <= 16
    run = d.create(endless())["id"]
    host, port = d.host.split(":")
    idle = [socket.create_connection((host, int(port)), timeout=PATIENCE) for _ in range(100)]
    try:
        took = []
        for _ in range(10):
            began = time.monotonic()
            d.act(run, "checkpoint")
            took.append(time.monotonic() - began)
        assert min(took) < (5 if is_sanitized() else 1), took  # the disk and the machine may be slow, but not each time
        assert metrics(d)["fbard_http_connections_evicted_total", ""] > 80
    finally:
        for s in idle:
            s.close()
    assert not d.run(run)["warnings"]


def test_what_was_refused_for_want_of_descriptors_is_no_run_after_a_restart(fresh):
    d = fresh(slots=1)
    d.limits = {resource.RLIMIT_NOFILE: 32}
    d.start()
    # One that runs, then ones that wait, each of which takes one descriptor: some attempt finds one.
    answers = {f"r{k}": d.request("POST", "/v1/runs", {"id": f"r{k}", "scene": endless()}).status for k in range(30)}
    assert set(answers.values()) == {201, 507}, answers
    made = {run for run, status in answers.items() if status == 201}
    d.stop()
    d.limits = {}
    d.start()
    assert {run["id"] for run in d.get("/v1/runs")["runs"]} == made
    d.create(endless(), id=next(run for run in answers if run not in made))


def test_readyz_sees_that_descriptors_have_run_out(fresh):
    d = fresh(slots=1)
    d.limits = {resource.RLIMIT_NOFILE: 64}
    d.start()
    d.ask("GET", "/readyz")
    for k in range(60):
        reply = d.request("GET", "/readyz")
        if reply.status != 200:
            break
        # Where it is ready, there is room for one more: each that waits keeps one descriptor.
        d.ask("POST", "/v1/runs", {"id": f"r{k}", "scene": endless()}, status=201)
    # The one answer is what counts: connections that end give their descriptors back a moment later.
    assert reply.status == 503 and "descriptors" in reply.json["detail"], reply
    d.ask("GET", "/healthz")
    for k in range(10):
        d.away(f"r{k}")
    until(lambda: d.request("GET", "/readyz").status == 200)


def test_run_that_waits_for_memory_says_so(fresh):
    d = fresh().start()
    large = endless(bodies={"bar": {"particles_per_cell": 256}}, time={"dt": 1e-4})
    bytes_of = [d.ask("POST", "/v1/scenes:validate", s).json["estimate"]["bytes"] for s in (large, endless())]
    limit = bytes_of[0] + bytes_of[1]  # beside two small ones it does not fit
    d.stop()
    d.options = ("--memory-limit", str(limit))
    d.start()
    for run in ("a", "b"):
        d.create(endless(), id=run, start=False)
        until(lambda run=run: d.frames(run))  # it has its memory
    d.create(large, id="large")

    def waits():
        found = [re.search(r"waits for memory: it needs (\d+) bytes, and (\d+) are free", w)
                 for w in d.run("large")["warnings"]]  # fmt: skip
        return found and [int(x) for x in found[0].groups()]

    needs, left = until(waits)
    assert d.run("large")["state"] == "queued" and left < needs < limit
    d.create(endless(), id="small")
    d.wait("small", "running")  # it fits, and does not stand behind
    d.act("small", "cancel")
    d.act("a", "cancel")
    d.act("b", "cancel")
    assert not d.wait("large", "running")["warnings"]


def test_no_place_and_a_taken_id_are_told_before_shapes_are_filled(fresh):
    d = fresh("--queue", "1", slots=1).start()
    # Of its form, but its dt is one that only the solver finds fault with, as it does once it has filled the shapes.
    refused = {"scene": water(time={"dt": 0.1})}
    assert d.ask("POST", "/v1/runs", refused, status=422).json["errors"][0]["code"] == "unstable_dt"
    d.create(TINY, id="there", start=False)
    d.ask("POST", "/v1/runs", {**refused, "id": "there"}, status=409)
    d.create(TINY, start=False)
    d.ask("POST", "/v1/runs", refused, status=503)
    d.ask("POST", "/v1/runs", {"scene": {**refused["scene"], "cell": -1}}, status=422)


def test_repeated_request_is_answered_as_it_was_where_its_scene_no_longer_fits(fresh):
    d = fresh().start()
    body, key = {"scene": TINY, "id": "once"}, {"Idempotency-Key": "k"}
    d.ask("POST", "/v1/runs", body, key, status=201)
    d.wait("once", "completed")
    d.stop()
    d.options = ("--memory-limit", "1000")
    d.start()
    again = d.ask("POST", "/v1/runs", body, key, status=201)
    assert again.headers["idempotency-replayed"] == "true" and again.json["id"] == "once"
    other = d.ask("POST", "/v1/runs", {**body, "start": False}, key, status=422)
    assert other.fault("")["code"] == "idempotency_key"
    assert d.ask("POST", "/v1/runs", {"scene": TINY}, status=422).json["errors"][0]["code"] == "memory"


def test_run_that_no_longer_fits_says_why_it_is_queued(fresh):
    d = fresh().start()
    d.create(TINY, id="large", start=False)
    d.stop()
    d.options = ("--memory-limit", "1000")
    d.start()
    now = d.act("large", "start")
    assert now["state"] == "queued", now
    assert [w for w in now["warnings"] if "bytes of memory, this daemon gives 1000" in w], now
    d.stop()
    d.options = ()
    d.start()
    assert not d.wait("large", "completed")["warnings"]


@pytest.mark.skipif(is_sanitized(), reason="sanitizers take terabytes of address space")
def test_run_without_memory_fails_and_says_how_much_it_wanted(fresh):
    d = fresh("--memory-limit", "1000000000000")
    d.limits = {resource.RLIMIT_AS: 1_000_000_000}  # of which arenas of malloc take up to half
    d.start()
    d.create(big(particles_per_cell=1024, cell=0.0125, time={"dt": 5e-5}), id="big")
    error = d.wait("big", "failed")["error"]
    assert error["kind"] == "memory" and error["value"] is None and error["advice"], error
    assert str(6400 * 1024) in error["detail"], error
    d.create(TINY, id="small")
    d.wait("small", "completed")
