"""16 clients, 8 subscribers and patches at once: what `make check-tsan` runs under ThreadSanitizer."""
import concurrent.futures
import os
import random
import time

import zmq
from boxes import endless, water
from fbard import PATIENCE, until
from frames import Frame
from test_watching import Stream

SECONDS = 20 if os.environ.get("FBARD_LONG") else 3


def zeromq(daemon, end):
    """Frames that came, each whole."""
    context, count = zmq.Context(), 0
    try:
        s = context.socket(zmq.SUB)
        s.subscribe(b"run/")
        s.connect(daemon.publish)
        # At least one, however slow a sanitizer and a busy machine make it.
        while time.monotonic() < end or (count == 0 and time.monotonic() < end + PATIENCE):
            if s.poll(100):
                topic, block = s.recv_multipart()
                count += topic.endswith(b"/frame") and Frame(block).header["seq"] >= 0
    finally:
        context.destroy(linger=0)
    return count


def streamed(daemon, run, kind, end):
    count = 0
    with Stream(daemon, f"/v1/runs/{run}/{kind}") as stream:
        for _ in stream.frames() if kind == "stream" else stream.events():
            count += 1
            if time.monotonic() > end:
                return count
    return count


def client(daemon, runs, seed, end):
    random_, asked = random.Random(seed), 0
    while time.monotonic() < end or asked < 5:
        run, what = random_.choice(runs), random_.randrange(12)
        if what < 3:
            reply = daemon.request("GET", f"/v1/runs/{run}" + random_.choice(["", "/config", "/changes", "/probes", "/frames/latest"]))
        elif what < 6:
            patch = random_.choice([{"fbar": True}, {"fbar": False}, {"damping": {"mass": random_.random()}},
                                    {"time": {"dt": 5e-4 + 5e-4 * random_.random()}}])  # fmt: skip
            reply = daemon.request("PATCH", f"/v1/runs/{run}/config", patch)
        elif what < 8:
            reply = daemon.request("POST", f"/v1/runs/{run}:" + random_.choice(["pause", "resume", "snapshot", "checkpoint"]))
        elif what < 9:
            reply = daemon.request("PUT", f"/v1/runs/{run}/recorders/c{seed}", {"acked": -1})
            daemon.request("DELETE", f"/v1/runs/{run}/recorders/c{seed}")
        elif what < 10:
            reply = daemon.request("GET", random_.choice(["/metrics", "/v1/runs", "/v1", "/readyz"]))
        else:
            own = f"c{seed}x{asked}"
            reply = daemon.request("POST", "/v1/runs", {"scene": water(time={"end": 0.01}), "id": own})
            if reply.status == 201:
                daemon.away(own)
        assert reply.status in (200, 201, 409, 503), reply
        asked += 1
    return asked


def test_many_clients_subscribers_and_patches_at_once(fresh):
    d = fresh("--queue", "40", slots=3)
    d.start()
    scene = endless(output={"interval": 0.02, "probe_interval": 0.02, "journal_bytes": 1 << 20})
    runs = [d.create(scene)["id"] for _ in range(3)]
    end = time.monotonic() + SECONDS
    with concurrent.futures.ThreadPoolExecutor(24) as pool:
        listeners = [pool.submit(zeromq, d, end) for _ in range(4)]
        listeners += [pool.submit(streamed, d, runs[0], kind, end) for kind in ("events", "stream") * 2]
        clients = [pool.submit(client, d, runs, seed, end) for seed in range(16)]
        asked = sum(c.result() for c in clients)
        for run in runs:  # whatever they were left in: so that each listener gets something
            until(lambda: d.request("POST", f"/v1/runs/{run}:resume").status == 200)
        heard = [listener.result() for listener in listeners]
        for run in runs:
            d.request("POST", f"/v1/runs/{run}:cancel")
        assert all(heard), heard
    assert asked > 16
    d.stop()  # and looks for what a sanitizer wrote
