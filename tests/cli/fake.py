"""A daemon made of Python: synthetic frames, and every fault of a network on demand."""
import ctypes
import http.server
import json
import struct
import threading
import time

import numpy as np
import ports
import zmq

_xxhash = ctypes.CDLL("libxxhash.so.0")
_xxhash.XXH3_64bits.restype = ctypes.c_uint64
_xxhash.XXH3_64bits.argtypes = [ctypes.c_char_p, ctypes.c_size_t]

UNITS = {"position": "m", "velocity": "m/s", "mean_stress": "Pa", "stress": "Pa", "id": "1"}
DTYPES = {np.dtype("<f8"): "<f8", np.dtype("<f4"): "<f4", np.dtype("<u4"): "<u4"}


def digest(data):
    return _xxhash.XXH3_64bits(data, len(data))


def pack(header, arrays):
    """A frame as contract §4 has it; independent of proto/frame.c, and a check of it."""
    def pad(n):
        return (n + 63) // 64 * 64

    size = 0
    while True:
        at, fields = 64 + size, []
        for name, a in arrays.items():
            fields.append({"name": name, "dtype": DTYPES[a.dtype], "shape": list(a.shape),
                           "unit": UNITS.get(name, "1"), "offset": at, "bytes": a.nbytes})
            at = pad(at + a.nbytes)
        text = json.dumps({**header, "fields": fields, "probes": header.get("probes", {}),
                           "end": header["end"]}).encode()
        if pad(len(text)) <= size:
            break
        size = pad(len(text))
    body = bytearray(text.ljust(size))
    for a in arrays.values():
        body += bytes(pad(len(body)) - len(body))
        body += a.tobytes()
    body += bytes(pad(len(body)) - len(body))
    body = bytes(body)
    return struct.pack("<8sIIQQ32x", b"FBARFRM1", size, 0, 64 + len(body), digest(body)) + body


def unpack(frame):
    """Header and arrays of a frame."""
    magic, size, flags, total, stated = struct.unpack_from("<8sIIQQ", frame)
    assert magic == b"FBARFRM1" and flags == 0 and total == len(frame)
    assert digest(frame[64:]) == stated
    header = json.loads(frame[64:64 + size])
    arrays = {f["name"]: np.frombuffer(frame, f["dtype"], int(np.prod(f["shape"])), f["offset"])
              .reshape(f["shape"]) for f in header["fields"]}
    return header, arrays, stated


def make_frames(run="r1", n_frames=20, count=50, dimension=2, fields=None):
    frames = []
    for seq in range(n_frames):
        rng = np.random.default_rng(1000 + seq)
        t = 0.01 * seq
        side = int(np.ceil(count ** (1 / dimension)))
        grid = np.stack(np.meshgrid(*[np.arange(side)] * dimension, indexing="ij"), -1)
        x = 0.1 * grid.reshape(-1, dimension)[:count] + np.eye(dimension)[0] * t
        arrays = {
            "position": x,
            "velocity": rng.normal(size=(count, dimension)),
            "mean_stress": -9810 * (x.max(axis=0)[-1] - x[:, -1]) + rng.normal(size=count),
            "stress": rng.normal(size=(count, dimension, dimension)).astype("<f4"),
            "id": np.arange(count, dtype="<u4"),
        }
        if fields:
            arrays = {k: v for k, v in arrays.items() if k in fields}
        frames.append(pack({"run": run, "epoch": 0, "seq": seq, "step": 100 * seq, "time": t,
                            "dimension": dimension, "count": count, "fbar": seq < n_frames // 2,
                            "state": "running" if seq < n_frames - 1 else "completed",
                            "probes": {"front": float(x[:, 0].max())},
                            "end": seq == n_frames - 1}, arrays))
    return frames


class Fake:
    """The daemon: `frames` exist up to `ready`; publish() sends them over ZeroMQ."""

    def __init__(self, run="r1", n_frames=20, recorders=True, **options):
        self.run, self.frames, self.ready = run, make_frames(run, n_frames, **options), 0
        self.recorders, self.acks, self.requests, self.bodies = recorders, [], [], []
        self.created, self.state, self.on_ack, self.damaged = "2026-01-01T00:00:00Z", "running", None, set()
        self.probes_csv = 'step,time,front,"a ""b"", c",force.x,force.y\r\n' + "".join(
            f"{100 * i},{0.01 * i!r},{4 + 0.01 * i!r},{7 * i},{i},{'' if i == 1 else -i}\r\n"
            for i in range(n_frames))
        self.changes = [{"step": 500, "time": 0.05, "patch": {"fbar": False}}]
        self.changes_path = True  # else they are in the run object alone, as with earlier daemons
        self.scene = {"title": "Fake", "dimension": 2, "gravity": [0, -9.81], "probes": {
            "front": {"kind": "extent", "axis": "x", "side": "max", "body": "water"},
            "force": {"kind": "reaction", "wall": "floor"}}}
        self.problem = None
        self.http_port, self.publish_port = ports.fixed(2)
        self.up()

    # -- life ------------------------------------------------------------------------------------
    def up(self):
        fake = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def log_message(self, *_):
                pass

            def answer(self):
                n = int(self.headers.get("Content-Length", 0))
                status, kind, body = fake.route(self.command, self.path, self.rfile.read(n),
                                                self.headers)
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                if fake.closing:
                    self.send_header("Connection", "close")
                self.end_headers()
                self.wfile.write(body)

            do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = answer

        class Server(http.server.ThreadingHTTPServer):
            daemon_threads = True
            connections = []

            def process_request(self, request, address):
                self.connections.append(request)
                super().process_request(request, address)

            def handle_error(self, *_):
                pass

        self.closing = False
        Server.connections = []
        self.server = Server(("127.0.0.1", self.http_port), Handler)
        self.url = f"http://127.0.0.1:{self.http_port}"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()
        self.context = zmq.Context()
        self.pub = self.context.socket(zmq.PUB)
        self.pub.linger = 0
        while True:
            try:
                self.pub.bind(f"tcp://127.0.0.1:{self.publish_port}")
                break
            except zmq.ZMQError:  # the one before is being closed
                time.sleep(0.02)

    def down(self):
        self.closing = True
        self.server.shutdown()
        self.server.server_close()
        for connection in self.server.connections:
            try:
                connection.shutdown(2)
            except OSError:
                pass
        self.pub.close()
        self.context.term()

    # -- frames ----------------------------------------------------------------------------------
    def publish(self, seq, body=None):
        self.pub.send_multipart([f"run/{self.run}/frame".encode(), body or self.frames[seq]])

    def advance(self, n=1, live=True):
        """Makes the next n frames exist, and sends them."""
        for _ in range(n):
            seq = self.ready
            self.ready += 1
            if self.ready == len(self.frames):
                self.state = "completed"
            if live:
                self.publish(seq)

    def advance_when_asked(self, times):
        """One frame, not sent, for each of the first `times` looks at the run."""
        route, asked = self.route, []

        def advancing(method, path, body, headers):
            answer = route(method, path, body, headers)
            if path == f"/v1/runs/{self.run}" and len(asked) < times:
                asked.append(path)
                self.advance(live=False)
            return answer
        self.route = advancing

    def play(self, interval=0.01, live=True, until=None):
        """All frames, one after the other; the last one not before the event `until`."""
        def go():
            while self.ready < len(self.frames) and not self.closing:
                if until and self.ready == len(self.frames) - 1:
                    until.wait()
                self.advance(live=live)
                time.sleep(interval)
        thread = threading.Thread(target=go, daemon=True)
        thread.start()
        return thread

    # -- HTTP ------------------------------------------------------------------------------------
    def run_object(self):
        last = unpack(self.frames[max(self.ready - 1, 0)])[0]
        return {"id": self.run, "state": self.state, "created": self.created, "scene": "fake",
                "step": last["step"], "time": last["time"], "end_time": 0.01 * len(self.frames),
                "progress": self.ready / len(self.frames), "eta_s": 1.0, "dt": 1e-4, "fbar": True,
                "particles": last["count"], "error": None, "warnings": [],
                "performance": {"wall_s": 1.0, "particle_steps_per_s": 1e6, "threads": 2},
                "balance": {"mass": 1.0}, "probes": last["probes"], "accuracy": [],
                "changes": self.changes[-1:] if self.changes_path else self.changes}

    def route(self, method, path, body, headers):
        self.requests.append((method, path))
        if body:
            self.bodies.append((method, path, json.loads(body)))
        ok = lambda value, status=200: (status, "application/json", json.dumps(value).encode())
        missing = (404, "application/problem+json",
                   json.dumps({"title": "Not found", "status": 404, "detail": "no such run"}).encode())
        base = f"/v1/runs/{self.run}"
        if self.problem and method in ("POST", "PATCH"):
            return 422, "application/problem+json", json.dumps(self.problem).encode()
        if path == "/healthz":
            return ok({"status": "ok"})
        if path == "/v1":
            return ok({"version": "0.0-fake", "endpoints": {
                "http": self.url, "publish": f"tcp://127.0.0.1:{self.publish_port}"}})
        if path == "/v1/scenes":
            return ok({"scenes": [{"name": "fake", "title": "A fake"}]})
        if path == "/v1/scenes/fake":
            return ok(self.scene)
        if path == "/v1/scenes:validate":
            return ok({"valid": True, "estimate": {"particles": 50, "steps": 2000}})
        if path == "/v1/runs" and method == "POST" and self.state == "paused":
            self.state = "running"
        if path == "/v1/runs":
            return ok({"runs": [self.run_object()]}) if method == "GET" else ok(self.run_object(), 201)
        if path.startswith(base + "/recorders/"):
            if not self.recorders:
                return missing
            if method == "PUT":
                acked = json.loads(body)["acked"]
                if self.on_ack:
                    self.on_ack(acked)
                self.acks.append(acked)
            return ok({}) if method == "PUT" else (204, "application/json", b"")
        if path == base:
            return (204, "application/json", b"") if method == "DELETE" else ok(self.run_object())
        if path == base + "/scene":
            return ok(self.scene)
        if path == base + "/changes" and self.changes_path:
            return ok({"changes": self.changes})
        if path.startswith(base + "/probes"):
            return 200, "text/csv", self.probes_csv.encode()
        if path == base + "/frames":
            return ok({"frames": [{"seq": i, "step": 100 * i, "time": 0.01 * i, "bytes": len(f)}
                                  for i, f in enumerate(self.frames[:self.ready])]})
        if path.startswith(base + "/frames/"):
            seq = int(path.rsplit("/", 1)[1])
            if seq >= self.ready:
                return missing
            frame = self.frames[seq]
            if seq in self.damaged:
                self.damaged.discard(seq)
                frame = frame[:100] + bytes([frame[100] ^ 1]) + frame[101:]
            return 200, "application/vnd.fbard.frame", frame
        if path == base + "/config" or path.startswith(base + ":"):
            action = path.rpartition(":")[2]
            if action == "cancel" or self.state not in ("completed", "failed", "cancelled"):
                self.state = {"cancel": "cancelled", "pause": "paused", "resume": "running",
                              "start": "running"}.get(action, self.state)
            return ok({**self.run_object(), "effective_step": 700})
        return missing
