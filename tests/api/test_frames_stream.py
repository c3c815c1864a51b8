"""Frames: over HTTP, in the index, and as ZeroMQ published them."""
import concurrent.futures
import threading
import time

import numpy as np
import pytest
import zmq
import zmq.utils.monitor
from boxes import WATER_PARTICLES, WATER_STEPS, big, endless, escaping, merged, water
from fbard import PATIENCE, is_sanitized, strict_json, until
from frames import Frame

ALL_FIELDS = {
    "position": ("m", "<f8", 2), "velocity": ("m/s", "<f8", 2), "displacement": ("m", "<f8", 2),
    "mean_stress": ("Pa", "<f8", 1), "mean_stress_smooth": ("Pa", "<f8", 1), "stress": ("Pa", "<f8", 3), "von_mises": ("Pa", "<f8", 1),
    "volume_ratio": ("1", "<f8", 1), "volume_ratio_bar": ("1", "<f8", 1), "density": ("kg/m^3", "<f8", 1),
    "body": ("1", "<u4", 1), "id": ("1", "<u4", 1),
}  # fmt: skip


class Subscriber:
    """Connected before it returns, and `heard` where it says so: the daemon knows what it has subscribed to, which it tells
    nobody. Reads one message, or in `follow`."""

    def __init__(self, daemon, topic, heard=False):
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.SUB)
        monitor = self.socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
        self.socket.subscribe(topic)
        self.socket.connect(daemon.publish)
        assert monitor.poll(int(1000 * PATIENCE)), "no handshake"
        zmq.utils.monitor.recv_monitor_message(monitor)
        self.socket.disable_monitor()
        self.knock = None
        if heard:
            self.wait_until_heard(daemon)

    def wait_until_heard(self, daemon):
        """Subscribes to another run as well, and has that one tell of changes until one comes: what was subscribed to
        before is known then, too."""
        run = daemon.create(endless(), start=False)["id"]
        self.knock = f"run/{run}/event".encode()
        self.socket.subscribe(self.knock)
        count = 0
        while (self.receive(0.02, knocks=True) or [None])[0] != self.knock:
            daemon.patch(run, {"gravity": [0, 1e-9 * (count := count + 1)]})
        self.socket.unsubscribe(self.knock)
        daemon.away(run)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.context.destroy(linger=0)

    def receive(self, seconds=PATIENCE, knocks=False):
        while self.socket.poll(int(1000 * seconds)):
            message = self.socket.recv_multipart()
            if knocks or message[0] != self.knock:
                return message
        return None

    def follow(self, daemon, run):
        """Steps a run of water from frame to frame, so that none is lost; all messages up to its last frame."""
        messages = []
        while True:
            daemon.act(run, "step", {"steps": 10})
            state = daemon.wait(run, "paused", "completed")["state"]
            last, seq = daemon.frames(run)[-1]["seq"], -1
            while seq < last:
                message = self.receive()
                assert message is not None, f"nothing after {len(messages)} messages"
                messages.append(message)
                seq = Frame(message[1]).header["seq"] if message[0].endswith(b"/frame") else seq
            if state == "completed":
                return messages


@pytest.fixture(scope="module")
def finished(daemon):
    """A completed run of water, 11 frames."""
    run = daemon.create(water())["id"]
    daemon.wait(run, "completed")
    yield run
    daemon.away(run)


# ---- Over HTTP ----


def test_index_is_dense_from_step_0_to_the_end(daemon, finished):
    index = daemon.frames(finished)
    assert [f["seq"] for f in index] == list(range(11))
    assert [f["step"] for f in index] == list(range(0, WATER_STEPS + 1, 10))
    for f in index:
        assert f["time"] == pytest.approx(f["step"] * 1e-3, abs=1e-12)
        assert f["bytes"] == len(daemon.frame(finished, f["seq"]))


def test_header_agrees_with_index_and_run(daemon, finished):
    for f in daemon.frames(finished):
        header = Frame(daemon.frame(finished, f["seq"])).header
        assert (header["run"], header["seq"], header["step"]) == (finished, f["seq"], f["step"])
        assert header["time"] == f["time"]
        assert (header["dimension"], header["count"]) == (2, WATER_PARTICLES)
        assert header["fbar"] is True
        assert isinstance(header["epoch"], int)
        assert header["end"] is (f["step"] == WATER_STEPS)
        assert header["state"] == ("completed" if header["end"] else header["state"])
        assert header["state"] in ("queued", "running", "waiting", "paused", "completed")
        assert set(header["probes"]) == {"front", "energy", "momentum", "middle"}


def test_probes_in_the_header_are_those_of_the_series(daemon, finished):
    rows = [line.split(",") for line in daemon.csv(finished).splitlines()]
    front = {int(r[0]): float(r[rows[0].index("front")]) for r in rows[1:]}
    for f in daemon.frames(finished):
        header = Frame(daemon.frame(finished, f["seq"])).header
        latest = max(step for step in front if step <= f["step"])
        assert header["probes"]["front"] == front[latest]


def test_latest_is_the_last(daemon, finished):
    assert daemon.frame(finished, "latest") == daemon.frame(finished, 10)


def test_frames_never_change(daemon, finished):
    assert daemon.frame(finished, 3) == daemon.frame(finished, 3)


def test_seq_beyond_the_last_is_404(daemon, finished):
    daemon.ask("GET", f"/v1/runs/{finished}/frames/11", status=404)


def test_fields_are_those_asked_for_and_position(daemon, name):
    daemon.create(water(output={"fields": ["velocity", "body"]}, time={"end": 0.005}), id=name)
    daemon.wait(name, "completed")
    assert set(Frame(daemon.frame(name, 0)).fields) == {"position", "velocity", "body"}
    daemon.away(name)


def test_every_field_has_its_unit_type_and_shape(daemon, name):
    scene = water(output={"fields": list(ALL_FIELDS)}, time={"end": 0.02})
    daemon.create(scene, id=name)
    daemon.wait(name, "completed")
    first, last = Frame(daemon.frame(name, 0)), Frame(daemon.frame(name, "latest"))
    assert set(first.fields) == set(last.fields) == set(ALL_FIELDS)
    for field, (unit, dtype, rank) in ALL_FIELDS.items():
        assert last.units[field] == unit
        assert last[field].dtype == np.dtype(dtype)
        assert last[field].shape == (WATER_PARTICLES, 2, 2)[:rank]
        assert np.all(np.isfinite(last[field]))
    assert np.all(first["displacement"] == 0) and np.all(first["velocity"] == 0)
    assert np.allclose(first["density"], 997.5) and np.allclose(first["volume_ratio"], 1)
    a, b = np.argsort(first["id"]), np.argsort(last["id"])
    assert np.array_equal(first["id"][a], last["id"][b]), "id is stable"
    assert np.allclose(last["position"][b] - last["displacement"][b], first["position"][a], atol=1e-12)
    assert np.allclose(last["density"] * last["volume_ratio_bar"], 997.5, rtol=1e-2)
    shear = last["stress"][:, 0, 1]
    assert np.array_equal(shear, last["stress"][:, 1, 0])
    daemon.away(name)


def test_first_frame_is_the_lattice_of_the_body(daemon, finished):
    position = Frame(daemon.frame(finished, 0))["position"]
    lattice = (np.arange(16) + 0.5) / 16
    expected = {(x, y) for x in lattice for y in lattice}
    assert {(round(x, 12), round(y, 12)) for x, y in position} == {(round(x, 12), round(y, 12)) for x, y in expected}


def test_body_is_the_index_in_the_scene(daemon, name):
    other = {"material": "water", "shape": {"box": {"min": [1.5, 0], "max": [2, 0.5]}}, "particles_per_cell": 4}
    daemon.create(water(bodies={"drop": other}, output={"fields": ["position", "body"]}), id=name, start=False)
    until(lambda: daemon.frames(name))
    frame = Frame(daemon.frame(name, 0))
    assert frame["body"].dtype == np.dtype("<u4")
    assert np.array_equal(frame["body"], (frame["position"][:, 0] > 1.25).astype("u4"))
    daemon.away(name)


def test_water_at_rest_has_hydrostatic_pressure(daemon, name):
    # rho g (H - y) within 5 % of the largest: what 2 s of damping leave, and a free surface on 4 cells
    scene = water(walls={"right": {"at": 1}}, damping={"mass": 10}, time={"end": 2, "dt": 1e-3},
                  fbar={"scheme": "anchored", "a": 0.05, "C": 1}, output={"interval": 2})  # fmt: skip
    daemon.create(scene, id=name)
    daemon.wait(name, "completed")
    frame = Frame(daemon.frame(name, "latest"))
    y, p = frame["position"][:, 1], -frame["mean_stress"]
    weight = 997.5 * 9.81
    assert np.mean(p) == pytest.approx(weight / 2, rel=0.02)
    slope, at_floor = np.polyfit(y, p, 1)
    assert slope == pytest.approx(-weight, rel=0.1)
    assert at_floor == pytest.approx(weight, rel=0.1)
    daemon.away(name)


def test_failed_run_ends_with_its_last_good_frame(daemon, name):
    daemon.create(escaping(), id=name)
    daemon.wait(name, "failed")
    index = daemon.frames(name)
    assert [f["seq"] for f in index] == list(range(len(index)))
    last = Frame(daemon.frame(name, "latest"))
    assert last.header["end"] is True and last.header["state"] == "failed"
    assert np.all(np.isfinite(last["position"]))
    assert np.all(last["position"] < 2) and np.all(last["position"] > -0.5)
    assert not Frame(daemon.frame(name, index[-1]["seq"] - 1)).header["end"]
    daemon.away(name)


def test_cancelled_run_ends_with_a_frame(daemon, name):
    daemon.create(water(time={"end": 100}, output={"interval": 0.5}), id=name)
    daemon.wait_step(name, 10)
    step = daemon.act(name, "cancel")["effective_step"]
    daemon.wait(name, "cancelled")
    last = Frame(daemon.frame(name, "latest"))
    assert (last.header["end"], last.header["state"], last.header["step"]) == (True, "cancelled", step)
    daemon.away(name)


def test_first_frame_is_there_while_the_run_is_paused_at_step_0(daemon, name):
    daemon.create(water(), id=name, start=False)
    (first,) = until(lambda: daemon.frames(name))
    assert (first["seq"], first["step"], first["time"]) == (0, 0, 0)
    daemon.away(name)


# ---- As published ----


def test_published_frames_are_those_over_http(daemon, name):
    daemon.create(water(), id=name, start=False)
    until(lambda: daemon.frames(name))
    with Subscriber(daemon, f"run/{name}/", heard=True) as subscriber:
        messages = subscriber.follow(daemon, name)
    daemon.wait(name, "completed")
    published = {}
    for message in messages:
        assert len(message) == 2
        if message[0] == f"run/{name}/frame".encode():
            seq = Frame(message[1]).header["seq"]
            assert seq not in published
            published[seq] = message[1]
        else:
            assert message[0] == f"run/{name}/event".encode()
    assert list(published) == sorted(published)
    for seq, block in published.items():
        assert daemon.frame(name, seq) == block
    assert set(published) >= set(range(1, 11)), "the first was published before it came"
    daemon.away(name)


def test_events_tell_of_states_and_changes(daemon, name):
    daemon.create(water(), id=name, start=False)
    until(lambda: daemon.frames(name))
    with Subscriber(daemon, f"run/{name}/event", heard=True) as subscriber:
        daemon.patch(name, {"fbar": False})
        daemon.act(name, "start")
        daemon.wait(name, "completed")
        events = []
        while not any("completed" in str(e) for e in events):
            assert (message := subscriber.receive()) is not None, events
            topic, text = message
            assert topic == f"run/{name}/event".encode()
            events.append(strict_json(text.decode()))
    assert any("running" in str(e) for e in events)
    assert any("fbar" in str(e) for e in events)
    daemon.away(name)


def test_topics_keep_runs_apart(daemon, name):
    other = name + "x"
    for run in (name, other):
        daemon.create(water(time={"end": 0.03}), id=run, start=False)
        until(lambda: daemon.frames(run))
    with Subscriber(daemon, f"run/{name}/frame", heard=True) as subscriber:
        daemon.act(other, "start")
        for topic, block in subscriber.follow(daemon, name):
            assert topic == f"run/{name}/frame".encode()
            assert Frame(block).header["run"] == name
    daemon.wait(other, "completed")
    daemon.away(name, other)


def test_subscriber_that_comes_late_repairs_its_gap_over_http(daemon, name):
    daemon.create(water(), id=name, start=False)
    daemon.act(name, "step", {"steps": 35})
    daemon.wait(name, "paused")
    with Subscriber(daemon, f"run/{name}/frame", heard=True) as subscriber:
        seqs = [Frame(m[1]).header["seq"] for m in subscriber.follow(daemon, name)]
    assert seqs[0] >= 4 and seqs[-1] == 10
    for seq in range(11):
        assert Frame(daemon.frame(name, seq)).header["seq"] == seq
    daemon.away(name)


def test_wait_subscribers_holds_the_run_until_somebody_listens(daemon, name):
    daemon.create(water(), id=name, wait_subscribers=1)
    assert daemon.wait(name, "waiting")["step"] == 0
    assert daemon.frames(name) == [], "its first frame is for those it waits for"
    with Subscriber(daemon, f"run/{name}/frame") as subscriber:
        first = Frame(subscriber.receive()[1]).header["seq"]
    assert first == 0, "who was waited for misses nothing at first"
    daemon.wait(name, "completed")
    daemon.away(name)


def test_wait_subscribers_counts_those_of_this_run(daemon, name):
    daemon.create(water(), id=name, wait_subscribers=2)
    with Subscriber(daemon, f"run/{name}x/frame"), Subscriber(daemon, f"run/{name}/event"):
        with Subscriber(daemon, f"run/{name}/"):
            warned = until(lambda: (w := daemon.run(name)["warnings"]) and "1 of 2" in w[0] and w)
            assert name in warned[0]
            time.sleep(0.3)
            assert daemon.run(name)["state"] == "waiting"
            with Subscriber(daemon, b"") as last:
                while (message := last.receive())[0] != f"run/{name}/frame".encode():
                    pass
                assert Frame(message[1]).header["seq"] == 0
    now = daemon.wait(name, "completed")
    assert now["warnings"] == [] and now["step"] == WATER_STEPS
    daemon.away(name)


def test_wait_subscribers_survives_pauses_changes_and_restarts(fresh, name):
    d = fresh()
    d.start()
    d.create(water(), id=name, wait_subscribers=1)
    d.wait(name, "waiting")
    assert d.act(name, "pause")["state"] == "paused"
    d.patch(name, {"fbar": False})
    d.act(name, "resume")
    d.wait(name, "waiting")
    d.kill()
    d.start()
    assert d.wait(name, "waiting")["step"] == 0
    with Subscriber(d, f"run/{name}/frame") as subscriber:
        first = Frame(subscriber.receive()[1]).header
    assert first["seq"] == 0 and first["fbar"] is False
    d.wait(name, "completed")


def test_step_and_cancel_do_not_wait_for_subscribers(daemon, name):
    daemon.create(water(), id=name, wait_subscribers=5, start=False)
    daemon.act(name, "step", {"steps": 3})
    assert daemon.wait(name, "paused")["step"] == 3
    daemon.create(water(), id=name + "x", wait_subscribers=5)
    daemon.wait(name + "x", "waiting")
    assert daemon.act(name + "x", "cancel")["state"] == "cancelled"
    daemon.away(name, name + "x")


FAT = merged(big(16), {"time": {"end": 0.008}, "output": {"interval": 2e-4, "probe_interval": 1,
                                                          "fields": list(ALL_FIELDS)}})  # fmt: skip


def test_stalled_subscriber_costs_the_run_nothing(daemon):
    def seconds():
        """In all, and waiting for frames to go out: that alone is what a subscriber could cost, and does not hang on who
        else uses the machine's cores."""
        run = daemon.create(FAT)["id"]
        performance = daemon.wait(run, "completed")["performance"]
        assert len(daemon.frames(run)) == 41
        daemon.away(run)
        return performance["wall_s"], performance["phases"]["waiting"]

    alone, before = min(seconds()[0] for _ in range(2)), daemon.memory()
    context = zmq.Context()
    try:
        sockets = []
        for _ in range(4):
            s = context.socket(zmq.SUB)
            s.set(zmq.RCVHWM, 1)
            s.set(zmq.RCVBUF, 4096)
            monitor = s.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
            s.subscribe(b"")
            s.connect(daemon.publish)
            assert monitor.poll(int(1000 * PATIENCE))
            s.disable_monitor()
            sockets.append(s)  # and is never read
        waited = min(seconds()[1] for _ in range(2))
        grown = daemon.memory() - before
    finally:
        context.destroy(linger=0)
    assert waited < 2 * alone + 1
    # 41 frames of some 0.7 MB to four subscribers, twice, would be 240 MB
    if not is_sanitized():
        assert grown < 100e6, f"{grown / 1e6:.0f} MB"


def test_subscribers_that_come_and_go_leave_no_descriptor(daemon):
    def visit():
        with Subscriber(daemon, b"run/"):
            pass

    visit()
    before = daemon.descriptors()
    for _ in range(20):
        visit()
    until(lambda: daemon.descriptors() <= before + 1)


def test_frames_are_read_by_many_at_once_while_the_run_goes_on(daemon, name):
    daemon.create(merged(FAT, {"time": {"end": 0.004}}), id=name, start=False)
    daemon.settle(name)
    ready = threading.Barrier(7)
    with concurrent.futures.ThreadPoolExecutor(6) as pool:

        def read(_):
            state = None
            while state not in ("completed", "failed"):
                state = daemon.run(name)["state"]
                for f in daemon.frames(name)[-3:]:
                    frame = Frame(daemon.frame(name, f["seq"]))
                    assert frame.header["seq"] == f["seq"]
                if state == "paused":  # each has read once before it starts
                    ready.wait(PATIENCE)
                    started.wait(PATIENCE)
            return state

        started = threading.Event()
        readers = [pool.submit(read, k) for k in range(6)]
        ready.wait(PATIENCE)
        daemon.act(name, "start")
        started.set()
        assert {reader.result() for reader in readers} == {"completed"}
    daemon.away(name)
