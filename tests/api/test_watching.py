"""Watching a run: server-sent events, the stream of frames, /metrics."""
import contextlib
import http.client
import json
import os
import pathlib
import re
import select
import shutil
import socket
import struct
import subprocess
import threading
import time

import pytest
from boxes import WATER_PARTICLES, big, endless, water
from fbard import FINAL, PATIENCE, strict_json, until
from frames import Frame, picked


class Stream:
    """An answer that is read as it comes. Every byte is kept in `seen`."""

    def __init__(self, daemon, path, headers=None, seconds=PATIENCE):
        self.connection = http.client.HTTPConnection(daemon.host, timeout=seconds)
        self.connection.request("GET", path, headers=headers or {})
        self.answer = self.connection.getresponse()
        self.type = self.answer.getheader("content-type")
        self.status = self.answer.status

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.connection.close()

    def events(self):
        """(id or None, event, data) of each; heartbeats are passed over."""
        assert (self.status, self.type) == (200, "text/event-stream")
        fields = {}
        for line in self.answer:
            line = line.decode().rstrip("\n")
            if line == "":
                if fields:
                    yield fields.get("id"), fields["event"], strict_json(fields["data"])
                fields = {}
            elif not line.startswith(":"):
                key, value = line.split(": ", 1)
                assert key in ("id", "event", "data") and key not in fields, line
                fields[key] = value
        assert fields == {}, "an event that is cut"

    def frames(self):
        """Each frame's bytes, to the end of the stream."""
        assert (self.status, self.type) == (200, "application/vnd.fbard.frame")
        while True:
            preamble = self.answer.read(64)
            if preamble == b"":
                return
            assert preamble[:8] == b"FBARFRM1"
            (total,) = struct.unpack_from("<Q", preamble, 16)
            rest = self.answer.read(total - 64)
            assert len(rest) == total - 64
            yield preamble + rest


def without_waits(states):
    """States in their order: a run whose frames have to wait for the disk tells of it, and that it goes on."""
    kept = []
    for state in states:
        if state != "waiting" and kept[-1:] != [state]:
            kept.append(state)
    return kept


# ---- Events ----


def test_events_tell_the_life_of_a_run(daemon, name):
    daemon.create(water(), id=name, start=False)
    with Stream(daemon, f"/v1/runs/{name}/events") as stream:
        events = stream.events()
        number, kind, data = next(events)
        assert (number, kind, data["state"]) == ("1", "state", "paused")
        assert next(events)[1] == "progress", "how far it is, whatever its state"
        daemon.patch(name, {"fbar": False, "damping": {"mass": 0.5}})
        daemon.act(name, "start")
        rest = list(events)
    kinds = [k for _, k, _ in rest]
    assert kinds[-1] == "end" and rest[-1][2]["state"] == "completed"
    states = [d["state"] for _, k, d in rest if k == "state"]
    assert without_waits(states) == ["running", "completed"]
    ((number, _, change),) = [e for e in rest if e[1] == "config"]
    assert (number, change["patch"], change["step"]) == ("2", {"fbar": False, "damping": {"mass": 0.5}}, 0)
    ids = [int(i) for i, _, _ in rest if i is not None]
    assert ids == list(range(2, 2 + len(ids))), "dense, and none twice"
    assert all(i is None for i, k, _ in rest if k in ("progress", "end")), "what is not kept has no id"
    last = [d for _, k, d in rest if k == "progress"][-1]
    assert (last["step"], last["progress"]) == (100, 1)
    daemon.away(name)


def test_events_are_replayed_from_any_of_them(daemon, name):
    daemon.create(water(), id=name, start=False)
    for k in range(5):
        daemon.patch(name, {"damping": {"mass": 0.1 * (k + 1)}})
    daemon.act(name, "start")
    daemon.wait(name, "completed")

    def logged(**headers):
        with Stream(daemon, f"/v1/runs/{name}/events", headers) as stream:
            return [e for e in stream.events() if e[0] is not None]

    everything = logged(**{"Last-Event-ID": "0"})
    assert [int(e[0]) for e in everything] == list(range(1, len(everything) + 1))
    assert [e[1] for e in everything[:6]] == ["state"] + ["config"] * 5
    assert without_waits(e[2]["state"] for e in everything[6:] if e[1] == "state") == ["running", "completed"]
    assert "check" not in json.dumps(everything), "the file's own"
    for k in range(len(everything) + 2):
        assert logged(**{"Last-Event-ID": str(k)}) == everything[k:]
    assert logged() == everything[-1:], "without an id, from the present state on"
    daemon.away(name)


def test_events_are_replayed_after_kill_9(fresh, name):
    d = fresh()
    d.start()
    d.create(endless(), id=name)
    d.wait_step(name, 20)
    with Stream(d, f"/v1/runs/{name}/events", {"Last-Event-ID": "0"}) as stream:
        events = stream.events()
        before = [next(events), next(events)]
    d.kill()
    d.start()
    d.wait(name, "running")
    with Stream(d, f"/v1/runs/{name}/events", {"Last-Event-ID": "0"}) as stream:
        events = stream.events()
        after = [next(events) for _ in range(3)]
    assert after[:2] == before
    assert (after[2][0], after[2][2]["state"]) == ("3", "running")
    d.act(name, "cancel")


def test_events_of_a_daemon_that_stops_end_and_say_so(fresh, name):
    d = fresh()
    d.start()
    d.create(endless(), id=name)
    d.wait_step(name, 5)
    with Stream(d, f"/v1/runs/{name}/events") as stream, Stream(d, f"/v1/runs/{name}/stream") as frames:
        began = time.monotonic()
        ending = threading.Thread(target=d.stop)
        ending.start()
        events = list(stream.events())
        list(frames.frames())
        ending.join()
    assert events[-1][1:] == ("end", {"event": "end", "state": "running", "reason": "stopping"})
    assert time.monotonic() - began < 29  # before idle connections are closed


@pytest.mark.parametrize("bad", ["x", "-1", "1.5", "", "1e3", "99999999999999999999"])
def test_events_after_no_event_are_refused(daemon, name, bad):
    daemon.create(water(), id=name, start=False)
    reply = daemon.ask("GET", f"/v1/runs/{name}/events", headers={"Last-Event-ID": bad}, status=400)
    assert "Last-Event-ID" in reply.json["detail"]
    daemon.away(name)
    daemon.ask("GET", f"/v1/runs/{name}/events", status=404)


def test_readers_that_hang_up_are_noticed_while_nothing_happens(daemon, name):
    daemon.create(endless(), id=name, start=False)
    daemon.settle(name)

    def open_now():
        return metrics(daemon)[("fbard_streams", "")]

    until(lambda: open_now() == 0)  # those of other tests are noticed, too
    streams = [Stream(daemon, f"/v1/runs/{name}/{kind}") for kind in ("events", "stream") * 4]
    for stream in streams:
        stream.answer.read(10)
    stays = Stream(daemon, f"/v1/runs/{name}/events")
    assert [next(stays.events())[1] for _ in range(2)] == ["state", "progress"]
    assert open_now() == 9
    for stream in streams:
        stream.connection.sock and stream.connection.sock.close()
        stream.answer.close()
        stream.connection.close()
    until(lambda: open_now() == 1)
    # Sooner than something had to be sent to them: the one that was opened last has not been told that it is still here.
    assert select.select([stays.answer.fp.raw._sock], [], [], 0)[0] == []
    stays.connection.close()
    stays.answer.close()
    daemon.away(name)


# ---- Frames as they come ----


def test_stream_gives_the_published_bytes_to_the_end(daemon, name):
    daemon.create(water(), id=name, start=False)
    until(lambda: daemon.frames(name))
    with Stream(daemon, f"/v1/runs/{name}/stream") as stream:
        frames = stream.frames()
        blocks = [next(frames)]
        while not Frame(blocks[-1]).header["end"]:
            daemon.wait(name, "paused")  # a frame is on its way before its run has paused
            daemon.act(name, "step", {"steps": 10})
            blocks.append(next(frames))
        assert list(frames) == []
    assert [Frame(b).header["seq"] for b in blocks] == list(range(11))
    for seq, block in enumerate(blocks):
        assert block == daemon.frame(name, seq)
    daemon.away(name)


def test_stream_of_a_run_that_is_over_is_its_last_frame(daemon, name):
    daemon.create(water(time={"end": 0.02}), id=name)
    daemon.wait(name, "completed")
    with Stream(daemon, f"/v1/runs/{name}/stream") as stream:
        (block,) = stream.frames()
    assert block == daemon.frame(name, "latest")
    daemon.away(name)


def test_stream_reader_that_is_slow_gets_the_newest(daemon, name):
    scene = water(time={"end": 2}, output={"interval": 0.001, "fields": ["position", "velocity", "stress"]})
    daemon.create(scene, id=name, start=False)
    until(lambda: daemon.frames(name))
    with Stream(daemon, f"/v1/runs/{name}/stream") as stream:
        frames = stream.frames()
        seqs = [Frame(next(frames)).header["seq"]]
        daemon.act(name, "start")
        n = daemon.wait(name, "completed") and len(daemon.frames(name))
        seqs += [Frame(b).header["seq"] for b in frames]
    assert seqs == sorted(set(seqs)) and seqs[-1] == n - 1
    assert len(seqs) < n, "2001 frames of some 10 kB do not fit in what a socket holds"
    daemon.away(name)


@pytest.mark.parametrize("most", [1, 7, 100, WATER_PARTICLES - 1, WATER_PARTICLES, 10**9])
def test_stream_is_thinned(daemon, name, most):
    daemon.create(water(time={"end": 0.02}), id=name)
    daemon.wait(name, "completed")
    whole = Frame(daemon.frame(name, "latest"))
    with Stream(daemon, f"/v1/runs/{name}/stream?max_particles={most}") as stream:
        (block,) = stream.frames()
    thin = Frame(block)  # which checks digest, lengths and places
    stride = -(-WATER_PARTICLES // most)
    assert thin.header["count"] == -(-WATER_PARTICLES // stride) <= most
    assert [f["name"] for f in thin.header["fields"]] == [f["name"] for f in whole.header["fields"]]
    assert len(set(picked(thin, whole, stride))) == thin.header["count"]
    for key in ("run", "seq", "step", "time", "state", "end", "probes", "fbar", "dimension"):
        assert thin.header[key] == whole.header[key]
    daemon.away(name)


@pytest.mark.parametrize("bad", ["0", "-1", "x", "", "1.5", "9" * 20])
def test_stream_thinned_to_nonsense_is_refused(daemon, name, bad):
    daemon.create(water(), id=name, start=False)
    daemon.ask("GET", f"/v1/runs/{name}/stream?max_particles={bad}", status=400)
    daemon.away(name)


def test_run_does_not_wait_for_readers_of_streams(daemon, name):
    """Readers that never read: the run goes on, and waits for none of them."""
    def seconds(run):
        performance = daemon.wait(run, "completed")["performance"]
        return performance["wall_s"], performance["phases"]["waiting"]

    scene = water(time={"end": 0.5}, output={"interval": 0.001})
    daemon.create(scene, id=name)
    alone, _ = seconds(name)
    daemon.create(scene, id=name + "x", start=False)
    until(lambda: daemon.frames(name + "x"))
    streams = [Stream(daemon, f"/v1/runs/{name}x/stream") for _ in range(6)]
    daemon.act(name + "x", "start")
    assert seconds(name + "x")[1] < 2 * alone + 1  # what it waited; how long it takes is also who else uses the cores
    for stream in streams:
        stream.connection.close()
        stream.answer.close()
    daemon.away(name, name + "x")


# ---- Metrics ----


def metrics(daemon):
    """{(name, labels): value}."""
    reply = daemon.ask("GET", "/metrics")
    assert reply.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    found = {}
    for line in reply.body.decode().splitlines():
        if not line.startswith("#"):
            key, labels, value = re.fullmatch(r"([a-z_]+)(\{.*\})? (\S+)", line).groups()
            assert (key, labels or "") not in found, line
            found[key, labels or ""] = float(value)
    return found


def two_clocks():
    """(when the machine started, within how many seconds that is known)."""
    before = time.time()
    up = time.clock_gettime(time.CLOCK_BOOTTIME)
    return before - up, time.time() - before


def test_metrics_count_what_was_done(daemon, name):
    before = metrics(daemon)
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"steps": 35})
    daemon.wait(name, "paused")
    daemon.ask("GET", "/v1/runs/none", status=404)
    daemon.ask("GET", "/nowhere", status=404)
    daemon.ask("PUT", f"/v1/runs/{name}/recorders/me", {"acked": 1})
    now = metrics(daemon)

    def grown(key, labels=""):
        return now[key, labels] - before.get((key, labels), 0)

    assert grown("fbard_steps_total") == 35
    assert grown("fbard_particle_steps_total") == 35 * WATER_PARTICLES
    assert grown("fbard_frames_published_total", '{class="zeromq"}') == 4
    assert grown("fbard_runs", '{state="paused"}') == 1
    assert grown("fbard_http_requests_total", '{method="GET",route="/v1/runs/{id}",status="404"}') == 1
    assert grown("fbard_http_requests_total", '{method="",route="",status="404"}') == 1
    assert grown("fbard_http_requests_total", '{method="POST",route="/v1/runs",status="201"}') == 1
    assert now["fbard_recorder_lag_frames", f'{{run="{name}",recorder="me"}}'] == 2
    assert now["fbard_run_step", f'{{run="{name}"}}'] == 35
    assert now["fbard_journal_bytes", ""] > 0 and now["process_resident_memory_bytes", ""] > 1e6
    assert 0 < now["process_open_fds", ""] < now["process_max_fds", ""]
    ticks = int(pathlib.Path(f"/proc/{daemon.process.pid}/stat").read_text().rsplit(") ", 1)[1].split()[19])
    booted = min((two_clocks() for _ in range(100)), key=lambda pair: pair[1])[0]
    began = booted + ticks / os.sysconf("SC_CLK_TCK")
    assert abs(now["process_start_time_seconds", ""] - began) < 1, "by the kernel's clocks"
    assert sum(v for (k, label), v in now.items() if k == "fbard_run_phase_seconds" and name in label) > 0
    daemon.away(name)
    assert not any(name in label for _, label in metrics(daemon)), "what is gone is not told of"


def test_metrics_pass_promtool(daemon, name):
    if shutil.which("promtool") is None:
        pytest.skip("no promtool (Debian: prometheus)")
    daemon.create(water(), id=name)
    daemon.ask("PUT", f"/v1/runs/{name}/recorders/me", {"acked": -1})
    text = daemon.ask("GET", "/metrics").body
    check = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, timeout=PATIENCE)
    assert (check.returncode, check.stdout + check.stderr) == (0, b"")
    daemon.wait(name, "completed")
    daemon.away(name)


def test_stepping_shows_while_it_goes_on(daemon, name):
    daemon.create(endless(), id=name)
    daemon.wait_step(name, 1)
    first = metrics(daemon)["fbard_steps_total", ""]
    until(lambda: metrics(daemon)["fbard_steps_total", ""] > first)
    assert daemon.run(name)["state"] not in FINAL
    daemon.away(name)


def segment(daemon, run):
    return daemon.data / "runs" / run / "frames-00000000.seg"


def test_frame_that_rots_on_the_disk_is_an_error_and_no_more(daemon, name):
    """A byte of the header that is read for thinning; whole or thinned, at once or as a stream."""
    daemon.create(water(), id=name)
    daemon.wait(name, "completed")
    text = segment(daemon, name).read_bytes()
    segment(daemon, name).write_bytes(text.replace(b'"count"', b'"kount"'))
    for query in ("", "?max_particles=10", "?fields=position"):
        reply = daemon.ask("GET", f"/v1/runs/{name}/frames/3{query}", status=500)
        assert "digest" in reply.json["detail"], reply
        with Stream(daemon, f"/v1/runs/{name}/stream{query}") as stream:
            assert stream.answer.read() == b""
    segment(daemon, name).write_bytes(text)
    daemon.frame(name, 3)
    daemon.away(name)


def test_file_that_is_cut_under_a_stream_ends_the_stream_and_no_more(daemon, name):
    """A mapping of it would be the end of the daemon."""
    daemon.create(big(particles_per_cell=900), id=name, start=False)
    whole = until(lambda: daemon.frames(name))[0]["bytes"]
    assert whole > 10e6, "more than the sockets hold"
    with Stream(daemon, f"/v1/runs/{name}/stream") as stream:
        got = len(stream.answer.read(1000))
        with open(segment(daemon, name), "r+b") as f:
            f.truncate(1000)
        with contextlib.suppress(http.client.IncompleteRead, ConnectionError):
            while part := stream.answer.read(1 << 20):
                got += len(part)
        assert got < whole
    assert daemon.request("GET", f"/v1/runs/{name}/frames/0").status == 500
    assert daemon.run(name)["state"] == "paused"
    daemon.away(name)


def test_head_of_a_stream_is_its_head_and_nothing_else(daemon, name):
    daemon.create(endless(), id=name, start=False)
    host, port = daemon.host.split(":")
    for path in ("/v1/events", f"/v1/runs/{name}/events", f"/v1/runs/{name}/stream"):
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as s:
            s.sendall(f"HEAD {path} HTTP/1.1\r\nHost: {daemon.host}\r\n\r\n".encode())
            answer = b""
            while part := s.recv(65536):  # it closes
                answer += part
        head, rest = answer.split(b"\r\n\r\n", 1)
        assert head.startswith(b"HTTP/1.1 200 ") and rest == b"", answer
        assert b"Content-Type: " + (b"application/vnd" if "stream" in path else b"text/event-stream") in head, answer
    streams = re.compile(r"^fbard_streams (\d+)$", re.M)
    until(lambda: streams.search(daemon.ask("GET", "/metrics").body.decode())[1] == "0")
    daemon.away(name)
