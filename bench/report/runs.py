"""Runs cases on a daemon of the report's own and records them; goes on where an earlier call was stopped or killed.

FOLDER/data is the daemon's, FOLDER/runs/NAME.h5 a recording. What is finished is not run again: a recording that is
complete and whose scene is the wanted one (`Daemon.full`). A run that was under way is continued by the daemon from
its checkpoint, and its recording by `fbar record`; both are made for that (proto/README.md, "Recording").
"""
import concurrent.futures
import ctypes
import fcntl
import http.client
import json
import math
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
import urllib.parse

import h5py

from cases import merged

ROOT = pathlib.Path(__file__).resolve().parents[2]
FBARD = os.environ.get("FBARD") or str(ROOT / "build" / "fbard")
FBAR = os.environ.get("FBAR") or str(ROOT / "build" / "fbar")
FINAL = ("completed", "failed", "cancelled")
PATIENCE = 600  # s for a request, and for the daemon and recorders of an earlier call to end; the machine may be busy


class Trouble(Exception):
    """Something that the user must mend; its text is all that is shown."""


LIBC = ctypes.CDLL(None)


def dies_with_parent():
    # PR_SET_PDEATHSIG: also when the report is killed, the daemon makes its checkpoints and ends, and fbar with it.
    LIBC.prctl(1, signal.SIGTERM)


class Daemon:
    def __init__(self, folder, jobs, threads):
        self.folder, self.jobs, self.threads = folder, jobs, threads

    def __enter__(self):
        ports = self.folder / "ports.json"
        self.folder.mkdir(parents=True, exist_ok=True)
        log = self.folder / "fbard.log"
        until = time.monotonic() + PATIENCE
        while True:
            ports.unlink(missing_ok=True)
            with open(log, "wb") as stderr:
                self.process = subprocess.Popen(
                    [FBARD, "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--port-file", ports,
                     "--data-dir", self.folder / "data", "--slots", str(self.jobs), "--threads", str(self.threads)],
                    stdin=subprocess.DEVNULL, stderr=stderr, preexec_fn=dies_with_parent)  # fmt: skip
            while self.process.poll() is None and not ports.exists():
                time.sleep(0.02)
            if self.process.poll() is None:
                break
            # The daemon of a report that was killed a moment ago still holds the folder.
            if time.monotonic() > until or "lock" not in log.read_text(errors="replace"):
                raise Trouble(f"{FBARD} does not start:\n{log.read_text(errors='replace')}")
            time.sleep(0.5)
        self.url = json.loads(ports.read_text())["http"]
        self.host = urllib.parse.urlsplit(self.url).netloc
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()

    def ask(self, method, path, body=None, good=(200, 201, 204)):
        """The JSON that is answered; with a status outside `good`, Trouble. (status, JSON) where good is None."""
        connection = http.client.HTTPConnection(self.host, timeout=PATIENCE)
        try:
            text = None if body is None else json.dumps(body)
            connection.request(method, path, text, {"Content-Type": "application/json"} if text else {})
            reply = connection.getresponse()
            content = reply.read()
        except OSError as e:
            raise Trouble(f"{method} {path}: {e}") from None
        finally:
            connection.close()
        answer = json.loads(content) if content else None
        if good is None:
            return reply.status, answer
        if reply.status not in good:
            raise Trouble(f"{method} {path}: {reply.status} {answer and answer.get('detail')}")
        return answer

    def bare(self, case):
        """The scene of a case as it would be posted."""
        scene = case.scene
        if isinstance(scene, str) and scene.endswith(".json"):
            scene = json.loads((ROOT / scene).read_text())
        elif isinstance(scene, str):
            scene = self.ask("GET", f"/v1/scenes/{scene}")
        return merged(scene, case.overrides)

    def full(self, scene):
        """The scene as this daemon would run it, every default filled in: two scenes are the same when these are.
        (Not a comparison of texts: a later version may know more keys.)"""
        made = self.ask("POST", "/v1/runs", {"scene": scene, "start": False})
        try:
            return self.ask("GET", f"/v1/runs/{made['id']}/scene")
        finally:
            self.forget(made["id"])

    def forget(self, run):
        """Removes a run, in whatever state; without a complaint when there is none."""
        status, answer = self.ask("GET", f"/v1/runs/{run}", good=None)
        if status == 404:
            return
        if answer["state"] not in FINAL:
            self.ask("POST", f"/v1/runs/{run}:cancel", good=(200, 409))
        until = time.monotonic() + PATIENCE
        while True:
            status, answer = self.ask("DELETE", f"/v1/runs/{run}", good=None)
            if status in (204, 404):
                return
            if time.monotonic() > until:
                raise Trouble(f"run {run} cannot be removed: {answer and answer.get('detail')}")
            time.sleep(0.05)


def recorded(path):
    """(scene, state) of a recording that is complete, otherwise None."""
    try:
        with h5py.File(path) as f:
            about = f["fbard"]
            if not about.attrs["complete"]:
                return None
            state = about.attrs["state"]
            return json.loads(about["scene"][()]), state.decode() if isinstance(state, bytes) else str(state)
    except (OSError, KeyError, ValueError):
        return None


def holds(full, bare):
    """Whether a scene with its defaults filled in has all that the bare one says."""
    if isinstance(bare, dict):
        return isinstance(full, dict) and all(k in full and holds(full[k], v) for k, v in bare.items())
    if isinstance(bare, list):
        return isinstance(full, list) and len(full) == len(bare) and all(map(holds, full, bare))
    return full == bare


def remove(folder, name):
    for path in folder.glob(f"{name}.h5*"):
        path.unlink()
    (folder / f"{name}.xdmf").unlink(missing_ok=True)


class Runner:
    """Runs cases, `jobs` at a time, on `threads` threads each."""

    def __init__(self, folder, jobs, threads):
        self.base, self.jobs, self.threads = pathlib.Path(folder), jobs, threads
        self.folder = self.base / "runs"
        self.lock = threading.Lock()
        self.clients, self.stopping = set(), False

    def say(self, text):
        with self.lock:
            print(text, flush=True)

    def alone(self):
        """A file whose lock every fbar of ours holds as well. The ones of a report that was killed a moment ago end soon
        after it; until then they are at their recordings, which must not be touched."""
        held, until, told = open(self.folder / "lock", "w"), time.monotonic() + PATIENCE, False
        while True:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return held
            except BlockingIOError:
                if not told:
                    self.say(f"an earlier report's recorders are still at work in {self.folder}: waiting for them")
                told = True
            if time.monotonic() > until:
                raise Trouble(f"another report works in {self.folder}")
            time.sleep(0.2)

    def client(self, name, *words):
        """Runs fbar, its output into NAME.log; gives its exit status."""
        with open(self.folder / f"{name}.log", "ab") as log:
            with self.lock:
                if self.stopping:
                    raise Trouble("stopped")
                process = subprocess.Popen([FBAR, "--url", self.daemon.url, *map(str, words)],
                                           stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                                           pass_fds=[self.held.fileno()], preexec_fn=dies_with_parent)  # fmt: skip
                self.clients.add(process)
            status = process.wait()
            with self.lock:
                self.clients.discard(process)
        return status

    def one(self, case):
        file, posted = self.folder / f"{case.name}.h5", self.folder / f"{case.name}.json"
        bare = self.daemon.bare(case)
        done = recorded(file)
        if done and done[1] != "cancelled":
            # What was posted and what was recorded both say so: no need to make two runs of it.
            if posted.exists() and json.loads(posted.read_text()) == bare and holds(done[0], bare):
                return "there"
            if self.daemon.full(done[0]) == self.daemon.full(bare):
                return "there"
        wanted = self.daemon.full(bare)
        status, run = self.daemon.ask("GET", f"/v1/runs/{case.name}", good=None)
        here = status == 200 and run["state"] != "cancelled"
        if here and self.daemon.ask("GET", f"/v1/runs/{case.name}/scene") == wanted:
            self.say(f"  {case.name}: goes on at {100 * run['progress']:.0f} %")
            if run["state"] == "paused":
                self.daemon.ask("POST", f"/v1/runs/{case.name}:resume")
            words = ("record", case.name, "-o", file)
        else:
            self.daemon.forget(case.name)
            remove(self.folder, case.name)
            posted.write_text(json.dumps(bare))
            words = ("run", posted, "--id", case.name, "-o", file)
        began = time.monotonic()
        status = self.client(case.name, *words)
        done = recorded(file)
        if not done:
            log = (self.folder / f"{case.name}.log").read_text(errors="replace").strip().splitlines()
            raise Trouble(f"{case.name}: fbar {words[0]} ends with {status}: {log[-1] if log else ''}")
        run = self.daemon.ask("GET", f"/v1/runs/{case.name}")
        (self.folder / f"{case.name}.run.json").write_text(json.dumps(run, indent=1))
        self.daemon.forget(case.name)
        speed = run["performance"]["particle_steps_per_s"] or math.nan
        self.say(f"  {case.name}: {done[1]} after {time.monotonic() - began:.0f} s, {run['step']} steps of "
                 f"{run['particles']} particles, {1e-6 * speed:.1f} M particle-steps/s")  # fmt: skip
        return "ran"

    def all(self, cases):
        """Runs them by rank. Gives {name: why} of those that could not be run; a run that *failed* is a result."""
        troubles = {}
        cases = sorted(cases, key=lambda c: c.rank)
        names = [c.name for c in cases]
        twice = {n for n in names if names.count(n) > 1}
        if twice:
            raise Trouble(f"two cases of the same name: {', '.join(sorted(twice))}")
        self.folder.mkdir(parents=True, exist_ok=True)
        with self.alone() as self.held, Daemon(self.base, self.jobs, self.threads) as self.daemon:
            wanted = set(names)
            for run in self.daemon.ask("GET", "/v1/runs")["runs"]:
                if run["id"] not in wanted:  # of another list of cases, or left by full()
                    self.daemon.forget(run["id"])
                elif run["state"] not in FINAL:  # its turn comes
                    self.daemon.ask("POST", f"/v1/runs/{run['id']}:pause", good=(200, 409))
            pool = concurrent.futures.ThreadPoolExecutor(self.jobs)
            try:
                tasks = {pool.submit(self.one, c): c for c in cases}
                for task in concurrent.futures.as_completed(tasks):
                    try:
                        task.result()
                    except Trouble as e:
                        if self.daemon.process.poll() is not None:
                            raise Trouble("the daemon ended; call again to go on") from None
                        troubles[tasks[task].name] = str(e)
                        self.say(f"  {tasks[task].name}: {e}")
            finally:
                with self.lock:
                    self.stopping = True
                    for process in self.clients:
                        process.terminate()
                pool.shutdown(cancel_futures=True)
        return troubles


def main(cases, folder, jobs=None):
    """Runs `cases` in `folder` on all cores; {name: why} of those that could not be run."""
    cores = len(os.sched_getaffinity(0))
    jobs = jobs or max(1, min(cores, len(cases)))
    return Runner(folder, jobs, max(1, cores // jobs)).all(cases)


if __name__ == "__main__":
    sys.exit("run by bench/report")
