"""A daemon that keeps its addresses over kills, recorders that are killed and started again, and what is
compared in the end: the recorded files, dataset by dataset and byte by byte."""
import http.client
import json
import os
import random
import signal
import subprocess
import threading
import time

import h5py

import fbard
import ports
from fbard import FINAL, ROOT, until

FBAR = os.environ.get("FBAR") or str(ROOT / "build" / "fbar")
AWAY = (OSError, http.client.HTTPException)  # what a killed daemon looks like from outside


class Place(fbard.Daemon):
    """A daemon at fixed addresses, and a folder for recordings."""

    def __init__(self, folder, *options, **more):
        super().__init__(folder, *options, **more)
        http_port, publish_port = ports.fixed(2)
        self.addresses = [f"127.0.0.1:{http_port}", f"tcp://127.0.0.1:{publish_port}"]
        self.recorders = []

    def command(self):
        words = super().command()
        words[words.index("--http") + 1] = self.addresses[0]
        words[words.index("--publish") + 1] = self.addresses[1]
        return words

    def fbar(self, *words, **more):
        return subprocess.run([FBAR, "--url", "http://" + self.addresses[0], *map(str, words)], cwd=self.folder,
                              capture_output=True, text=True, timeout=fbard.PATIENCE, **more)  # fmt: skip

    def record(self, run, file, *words, environment=None):
        """Starts `fbar record`; its messages go to FILE.txt."""
        with open(self.folder / (file + ".txt"), "ab") as log:
            process = subprocess.Popen([FBAR, "--url", "http://" + self.addresses[0], "record", run, "-o", file,
                                        *map(str, words)], cwd=self.folder, stdout=log, stderr=log,
                                       stdin=subprocess.DEVNULL,
                                       env={**os.environ, **(environment or {})})  # fmt: skip
        self.recorders.append(process)
        return process

    def said(self, file):
        return (self.folder / (file + ".txt")).read_text()

    def clear(self):
        for process in self.recorders:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.wait()
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def contents(path):
    """{place: bytes and form} of everything in a recording, attributes too."""
    found = {}

    def visit(name, thing):
        for key, value in thing.attrs.items():
            found[f"{name}@{key}"] = (getattr(value, "dtype", None), getattr(value, "tobytes", lambda: value)())
        if isinstance(thing, h5py.Dataset):
            value = thing[()]
            found[name] = (thing.dtype, thing.shape, value.tobytes() if hasattr(value, "tobytes") else value)

    with h5py.File(path) as f:
        f.visititems(visit)
        assert f["fbard"].attrs["complete"] == 1
        n = len(f["fbard/frames/seq"])
        assert list(f["fbard/frames/seq"]) == list(range(n))
    return found, n


def check_same_recording(ours, theirs):
    """Dataset by dataset, so that a difference has a name; then the file itself. The number of frames."""
    (a, n), (b, _) = contents(ours), contents(theirs)
    assert sorted(a) == sorted(b)
    different = [name for name in a if a[name] != b[name]]
    assert not different, different
    assert ours.read_bytes() == theirs.read_bytes()
    return n


class Control(threading.Thread):
    """What an operator does to a run whose daemon may be away at any moment: runs it to each step of the
    plan, changes the configuration there, and lets it go on to its end, but not further than `allowed`, a share of its
    time."""

    def __init__(self, place, scene, plan, run="run", recorders=()):
        super().__init__(daemon=True)
        self.place, self.scene, self.plan, self.id = place, scene, plan, run
        self.recorders, self.fault, self.created = list(recorders), None, threading.Event()
        self.allowed = 1.0

    def once(self, method, path, body=None):
        """The reply, or None while the daemon is away or asks for patience."""
        try:
            connection = http.client.HTTPConnection(self.place.addresses[0], timeout=20)
            data = None if body is None else json.dumps(body).encode()
            connection.request(method, path, data, {"Content-Type": "application/json"})
            answer = connection.getresponse()
            reply = answer.status, json.loads(answer.read() or b"null")
            connection.close()
        except (*AWAY, ValueError):
            return None
        return None if reply[0] == 503 else reply

    def ask(self, method, path, body=None, good=(200, 201)):
        reply = until(lambda: self.once(method, path, body), every=0.01)
        assert reply[0] in good, (method, path, reply)
        return reply[1]

    def state(self):
        return self.ask("GET", f"/v1/runs/{self.id}")

    def reach(self, step):
        while True:
            run = self.state()
            assert run["state"] not in FINAL, run
            if run["state"] == "paused":
                assert run["step"] <= step, run
                if run["step"] == step:
                    return
                self.step({"steps": step - run["step"]})
            time.sleep(0.01)

    def step(self, body):
        """Once: if its answer is lost, it may be where it was to by the next look, and must not be told so again."""
        reply = self.once("POST", f"/v1/runs/{self.id}:step", body)
        assert reply is None or reply[0] in (200, 409), reply

    def go(self):
        body = {"scene": self.scene, "id": self.id, "start": False, "recorders": self.recorders}
        self.ask("POST", "/v1/runs", body, good=(201, 409))  # 409: answered, but the answer was lost
        self.created.set()
        for step, patch in self.plan:
            self.reach(step)
            self.ask("PATCH", f"/v1/runs/{self.id}/config", patch)
        while True:
            run = self.state()
            if run["state"] in FINAL:
                return
            if run["state"] == "paused" and self.allowed >= 1:
                self.ask("POST", f"/v1/runs/{self.id}:resume", good=(200, 409))
            elif run["state"] == "paused":
                # Between two frames: one that is taken while it is paused there would say so.
                interval = self.scene["output"]["interval"]
                stop = (round(self.allowed * run["end_time"] / interval) - 0.5) * interval
                if stop > run["time"] + 0.25 * interval:
                    self.step({"until": stop})
            time.sleep(0.02)

    def run(self):
        try:
            self.go()
        except BaseException as fault:  # for the test's thread, which asks for it
            self.fault = fault
            self.created.set()

    def finish(self):
        self.join(fbard.PATIENCE)
        if self.fault:
            raise self.fault
        assert not self.is_alive(), "the run does not come to its end"
        return self.state()


def undisturbed(place, scene, plan):
    """The recording of a run that nothing happens to, and the run."""
    place.start()
    control = Control(place, scene, plan)
    control.start()
    assert control.created.wait(fbard.PATIENCE) and not control.fault, control.fault
    recorder = place.record("run", "a.h5")
    run = control.finish()
    assert recorder.wait(fbard.PATIENCE) == 0, place.said("a.h5")
    place.stop()
    return place.folder / "a.h5", run


def disturbed(place, scene, plan, rng, kills, files=("a.h5",), longest=0.5):
    """The same with `kills` kills at random moments; how many there were. The run comes no further than a share of it for
    each kill, so that it is not over before them, however slowly they go."""
    place.start()
    control = Control(place, scene, plan)
    control.allowed = 1 / kills
    control.start()
    assert control.created.wait(fbard.PATIENCE) and not control.fault, control.fault
    recorders = {file: place.record("run", file) for file in files}
    done = {"daemon": 0, "recorder": 0, "both": 0}
    while sum(done.values()) < kills:
        # Often within a start, when logs are read and cut, and else anywhere.
        time.sleep(rng.uniform(0, 0.03) if rng.random() < 0.2 else rng.uniform(0, longest))
        assert not control.fault, control.fault
        alive = [f for f, r in recorders.items() if r.poll() is None]
        for file in set(recorders) - set(alive):
            assert recorders[file].returncode in (0, 3), place.said(file)
            if recorders[file].returncode == 3:  # had nothing yet, and the daemon was away
                recorders[file] = place.record("run", file)
                alive.append(file)
        if not alive:
            break
        victim = rng.choice(["daemon", "recorder", "both"])
        file = rng.choice(alive)
        if victim != "daemon":
            recorders[file].kill()
        if victim != "recorder":
            place.kill()
        done[victim] += 1
        control.allowed = (1 + sum(done.values())) / kills
        if victim != "daemon":
            recorders[file].wait()
        if rng.random() < 0.3:
            time.sleep(rng.uniform(0, 0.1))
        if victim == "both" and rng.random() < 0.5:  # the recorder comes back first
            recorders[file] = place.record("run", file)
            place.start()
        else:
            if victim != "recorder":
                place.start()
            if victim != "daemon":
                recorders[file] = place.record("run", file)
    run = control.finish()
    for file in files:
        for _ in range(3):  # started when the daemon was away, it may have given up
            if recorders[file].wait(fbard.PATIENCE) != 3:
                break
            recorders[file] = place.record("run", file)
        assert recorders[file].returncode == 0, place.said(file)
    place.stop()
    return done, run


def seeded(name):
    seed = int(os.environ.get("FBARD_SEED", "20261001"))
    return random.Random(f"{seed} {name}")
