"""Connections that ask nothing, or ask slowly, keep nobody out."""
import contextlib
import select
import shutil
import socket
import subprocess
import time

import pytest
from boxes import big, endless, merged, water
from fbard import PATIENCE, is_sanitized, until
from test_watching import Stream, metrics

SOON = 5 if is_sanitized() else 1  # s: of the quickest of several, since a machine may stand still for longer
MANY = 300  # more than the daemon takes in all


def connect(daemon):
    host, port = daemon.host.split(":")
    return socket.create_connection((host, int(port)), timeout=PATIENCE)


@contextlib.contextmanager
def held(daemon, n, text=b""):
    """Connections that are opened and sent the beginning of a request, and then nothing."""
    sockets = []
    try:
        for _ in range(n):
            sockets.append(connect(daemon))
            with contextlib.suppress(OSError):
                sockets[-1].sendall(text)
        yield sockets
    finally:
        for s in sockets:
            s.close()


def seconds(ask):
    began = time.monotonic()
    ask()
    return time.monotonic() - began


@pytest.mark.parametrize(
    "text",
    [b"", b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-a: ", b"GET /heal",
     b"POST /v1/runs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n{",
     b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"],
    ids=["nothing", "half a header", "half a line", "half a body", "kept alive"],
)  # fmt: skip
def test_idle_connections_give_way_to_new_ones(daemon, text):
    most = daemon.get("/v1")["limits"]["connections"]
    before = metrics(daemon)["fbard_http_connections_evicted_total", ""]
    with held(daemon, MANY, text):
        assert min(seconds(lambda: daemon.get("/healthz")) for _ in range(20)) < SOON
        # Room was made for each, and did not come by itself.
        assert metrics(daemon)["fbard_http_connections_evicted_total", ""] - before >= MANY - most > 0
        until(lambda: metrics(daemon)["fbard_http_connections", ""] <= most)  # but for those being closed
    until(lambda: metrics(daemon)["fbard_http_connections", ""] < 20)


def test_streams_and_uploads_are_not_what_gives_way(daemon, name):
    daemon.create(endless(), id=name)
    with Stream(daemon, f"/v1/runs/{name}/events") as stream:
        events = stream.events()
        next(events)
        with connect(daemon) as upload:
            body = b'{"scene": "no-such"}'
            upload.sendall(b"POST /v1/scenes:validate HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
                           b"Content-Length: %d\r\n\r\n" % len(body))  # fmt: skip
            with held(daemon, 100):
                upload.sendall(body[:5])
                with held(daemon, 80):
                    upload.sendall(body[5:])  # it has come a piece further than those before it
                    assert upload.recv(65536).startswith(b"HTTP/1.1 422")
                    with held(daemon, 200):
                        daemon.get("/healthz")
                        daemon.act(name, "pause")
                        assert any(k == "state" and d["state"] == "paused" for _, k, d in events)
    daemon.away(name)


def test_daemon_takes_as_many_streams_as_it_says(daemon, name):
    daemon.create(water(), id=name, start=False)
    most = daemon.get("/v1")["limits"]["streams"]
    streams = []
    try:
        for _ in range(most):
            streams.append(Stream(daemon, f"/v1/runs/{name}/events"))
            assert streams[-1].status == 200
        daemon.ask("GET", f"/v1/runs/{name}/events", status=503)
        daemon.ask("GET", f"/v1/runs/{name}/stream", status=503)
        assert min(seconds(lambda: daemon.get("/healthz")) for _ in range(5)) < SOON
    finally:
        for stream in streams:
            stream.connection.close()
            stream.answer.close()
    until(lambda: daemon.request("GET", f"/v1/runs/{name}/probes").status == 200
          and metrics(daemon)["fbard_streams", ""] == 0)  # fmt: skip
    daemon.away(name)


def test_newcomer_is_told_when_everybody_is_busy(daemon, name):
    """All places of this address are taken by those who are being answered."""
    limits = daemon.get("/v1")["limits"]
    fields = ["position", "velocity", "displacement", "stress", "mean_stress", "von_mises", "volume_ratio"]
    daemon.create(merged(big(256), {"output": {"fields": fields}}), id=name, start=False)
    until(lambda: daemon.frames(name))
    assert daemon.frames(name)[0]["bytes"] > 10e6, "more than sockets hold"
    host, port = daemon.host.split(":")
    streams, readers = [], []
    try:
        for _ in range(limits["streams"]):
            streams.append(Stream(daemon, f"/v1/runs/{name}/events"))
        for _ in range(limits["connections_of_address"] - limits["streams"]):
            s = socket.socket()
            s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            s.settimeout(PATIENCE)
            s.connect((host, int(port)))
            s.sendall(f"GET /v1/runs/{name}/frames/0 HTTP/1.1\r\nHost: {daemon.host}\r\n\r\n".encode())
            assert s.recv(12) == b"HTTP/1.1 200"
            readers.append(s)
        reply = daemon.ask("GET", "/healthz", status=503)
        assert reply.headers["connection"] == "close" and "192" in reply.json["detail"]
        assert reply.headers["retry-after"]
    finally:
        for stream in streams:
            stream.connection.close()
            stream.answer.close()
        for s in readers:
            s.close()
    until(lambda: daemon.request("GET", "/healthz").status == 200)
    assert metrics(daemon)["fbard_http_connections_refused_total", ""] >= 1
    daemon.away(name)


@pytest.mark.parametrize("how", [["-H"], ["-B"], ["-X"]], ids=["slow headers", "slow bodies", "slow reading"])
def test_slowhttptest_leaves_the_api_answering(daemon, how):
    if shutil.which("slowhttptest") is None:
        pytest.skip("no slowhttptest")
    if is_sanitized():
        pytest.skip("a matter of time, not of memory; the idle connections above are for that")
    def answers():
        """s that each took while the attack went on."""
        attack = subprocess.Popen(
            ["slowhttptest", *how, "-c", "600", "-r", "200", "-i", "1", "-l", "3", "-x", "24", "-p", "1",
             "-u", daemon.http + ("/openapi.json" if how == ["-X"] else "/v1/runs")],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
        took = []
        try:
            while attack.poll() is None:
                took.append(seconds(lambda: daemon.get("/v1/runs")))
                time.sleep(0.05)
        finally:
            attack.kill()
            attack.wait()
        return sorted(took)

    # Kept out, it would be answered once or twice, when the attack is over; so it would be, too, where all stood still
    # for as long, but hardly three times.
    took = next((t for t in (answers() for _ in range(3)) if len(t) > 5), [])
    assert took and took[len(took) // 2] < SOON, took


@pytest.mark.long
def test_idle_connections_end_after_30_s_and_streams_are_kept_by_heartbeats(daemon, name):
    daemon.create(endless(), id=name, start=False)
    with held(daemon, 1) as nothing, held(daemon, 1, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n") as kept, \
            Stream(daemon, f"/v1/runs/{name}/events") as stream:  # fmt: skip
        began, ended, beats = time.monotonic(), {}, []
        sockets = {nothing[0]: "nothing", kept[0]: "kept alive", stream.answer.fp.raw._sock: "stream"}
        kept[0].recv(4096)
        while time.monotonic() < began + 45:
            for s in select.select([s for s in sockets if s not in ended], [], [], 1)[0]:
                part = s.recv(4096)
                if not part:
                    ended[s] = time.monotonic() - began
                elif sockets[s] == "stream" and b": still here" in part:
                    beats.append(time.monotonic() - began)
    ended = {sockets[s]: t for s, t in ended.items()}
    assert set(ended) == {"nothing", "kept alive"}, "the stream stays"
    assert all(29 < t < 40 for t in ended.values()), ended
    assert len(beats) in (3, 4), beats
    daemon.away(name)
