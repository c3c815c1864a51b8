"""fbar with the real fbard: a recording against the daemon's own frames, and `fbar run` on its own."""
import json
import os
import pathlib
import re
import select
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.request

import h5py
import numpy as np
import pytest

import conftest
from fake import unpack
from recording import check_frames, read_xdmf

pytestmark = pytest.mark.skipif(not os.access(conftest.FBARD, os.X_OK), reason="fbard is not built")

# The dam break, small: 512 particles, some hundred steps.
SMALL = ["--set", "materials.water.bulk_modulus=2e6", "--set", "time.dt=null",
         "--set", "time.cfl=0.3", "--set", "time.end=0.3", "--set", "output.interval=0.01",
         "--set", "bodies.reservoir.particles_per_cell=4", "--set", "output.fields="
         '["position","velocity","mean_stress","stress","volume_ratio","id","body"]',
         "--set", "references=[]"]


def get(url, accept="*/*"):
    request = urllib.request.Request(url, headers={"Accept": accept})
    with urllib.request.urlopen(request, timeout=conftest.PATIENCE) as reply:
        return reply.read()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fbard")
    ports = folder / "ports.json"
    process = subprocess.Popen([conftest.FBARD, "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0",
                                "--port-file", str(ports), "--data-dir", str(folder / "data")],
                               stderr=open(folder / "log", "w"))
    conftest.wait_until(lambda: process.poll() is not None or ports.exists())
    assert process.poll() is None, (folder / "log").read_text()
    yield json.loads(ports.read_text())["http"]
    process.terminate()
    assert process.wait(conftest.PATIENCE) == 0


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Where a private daemon keeps its things; empty again at the end."""
    folder = tmp_path / "t"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.fixture(autouse=True)
def no_default_daemon():
    """`fbar run` starts a private daemon only where none answers at the default address."""
    try:
        get("http://127.0.0.1:7800/healthz")
        pytest.skip("a daemon runs at the default address")
    except OSError:
        pass


def all_frames(url, run):
    index = json.loads(get(f"{url}/v1/runs/{run}/frames"))["frames"]
    return [get(f"{url}/v1/runs/{run}/frames/{entry['seq']}") for entry in index]


def test_run_records_what_the_daemon_published(daemon, fbar, tmp_path):
    result = fbar("run", "dam-break", *SMALL, "--id", "whole", "-o", "a.h5", url=daemon)
    assert result.returncode == 0, result.stderr
    frames = all_frames(daemon, "whole")
    assert len(frames) > 20
    check_frames(tmp_path / "a.h5", frames)
    assert len(read_xdmf(tmp_path / "a.xdmf")) == len(frames)
    scene = json.loads(get(f"{daemon}/v1/runs/whole/scene"))
    csv = get(f"{daemon}/v1/runs/whole/probes", "text/csv").decode().splitlines()
    with h5py.File(tmp_path / "a.h5") as f:
        assert json.loads(f["fbard/scene"][()]) == scene
        names = csv[0].split(",")
        table = np.array([[float(x or "nan") for x in line.split(",")] for line in csv[1:]])
        front = f["fbard/probes/front"]
        np.testing.assert_array_equal(front["step"][:], table[:, 0])
        np.testing.assert_array_equal(front["time"][:], table[:, 1])
        np.testing.assert_array_equal(front["value"][:], table[:, names.index("front")])
        assert f["VTKHDF/Points"].shape[0] == 512 * len(frames)
        units = {name: probe["value"].attrs["unit"] for name, probe in f["fbard/probes"].items()}
        assert units == {"front": b"m", "crest": b"m", "energy": b"J/m", "momentum": b"kg/s",
                         "drift": b"1", "pressure_max": b"Pa"}
        assert len(f["fbard/changes/step"]) == 0
    # A recording of the finished run, over HTTP alone, is the same file.
    assert fbar("record", "whole", "-o", "b.h5", url=daemon).returncode == 0
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def send(url, method, body=None):
    request = urllib.request.Request(url, method=method, data=json.dumps(body or {}).encode(),
                                     headers={"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=conftest.PATIENCE) as reply:
        return json.loads(reply.read())


def test_record_keeps_the_changes_of_parameters(daemon, fbar, start_fbar, tmp_path):
    run = f"{daemon}/v1/runs/changed"
    runner = start_fbar("run", "dam-break", *SMALL, "--set", "time.end=1e3", "--id", "changed", "-o",
                        "a.h5", url=daemon)
    conftest.wait_until(lambda: runner.poll() is not None or (
        fbar("show", "changed", url=daemon).returncode == 0 and json.loads(get(run))["step"] >= 20))
    assert runner.poll() is None
    wanted = []
    patches = {"fbar": False}, {"damping": {"local": 0.25}}, {"fbar": {"scheme": "anchored", "a": 0.1}}
    send(run + ":pause", "POST")
    for i, patch in enumerate(patches):
        wanted.append((send(run + "/config", "PATCH", patch)["effective_step"], patch))
        if i == 0:
            send(run + ":resume", "POST")  # the others come while it runs
        time.sleep(0.1)
    assert fbar("set", "changed", "time.end=1e-9", url=daemon).returncode == 2  # a refused one is none
    send(run + ":cancel", "POST")
    assert runner.wait(conftest.PATIENCE) == 1
    told = [(c["step"], c["patch"]) for c in json.loads(get(run))["changes"]]
    with h5py.File(tmp_path / "a.h5") as f:
        changes, frames = f["fbard/changes"], f["fbard/frames"]
        kept = [(int(step), json.loads(patch)) for step, patch in zip(changes["step"], changes["patch"])]
        assert kept == told == wanted
        assert list(changes["time"][:]) == sorted(changes["time"][:]) and changes["time"][0] > -0.06
        # a frame that had to wait for the disk comes after the change at its own step
        before = frames["step"][:] < wanted[0][0]
        between = (frames["step"][:] > wanted[0][0]) & (frames["step"][:] < wanted[2][0])
        assert frames["fbar"][:][before].all() and not frames["fbar"][:][between].any()
    assert ", 3 changes of parameters" in fbar("info", "a.h5").stdout


def test_record_killed_beside_a_live_run(daemon, fbar, start_fbar, tmp_path):
    result = start_fbar("run", "dam-break", *SMALL, "--set", "time.end=1", "--id", "killed", "-o",
                        "whole.h5", url=daemon)
    conftest.wait_until(lambda: fbar("show", "killed", url=daemon).returncode == 0)
    for _ in range(6):
        recorder = start_fbar("record", "killed", "-o", "a.h5", url=daemon)
        time.sleep(0.08)
        recorder.kill()
        recorder.wait()
    final = fbar("record", "killed", "-o", "a.h5", url=daemon)
    assert final.returncode == 0, final.stderr
    assert result.wait(conftest.PATIENCE) == 0
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_commands_on_a_live_run(daemon, fbar):
    scenes = fbar("scenes", url=daemon)
    assert scenes.returncode == 0 and "dam-break" in scenes.stdout
    assert fbar("validate", "dam-break", url=daemon).returncode == 0
    request = urllib.request.Request(f"{daemon}/v1/runs", method="POST", data=json.dumps(
        {"scene": "dam-break", "id": "live", "start": False}).encode(),
        headers={"Content-Type": "application/json"})
    urllib.request.urlopen(request, timeout=conftest.PATIENCE).close()
    assert "paused" in fbar("show", "live", url=daemon).stdout
    assert fbar("step", "live", "--steps", "50", url=daemon).returncode == 0
    conftest.wait_until(lambda: json.loads(fbar("--json", "show", "live", url=daemon).stdout)["step"] >= 50)
    assert fbar("set", "live", "fbar=false", url=daemon).returncode == 0
    assert json.loads(fbar("--json", "show", "live", url=daemon).stdout)["fbar"] is False
    assert fbar("resume", "live", url=daemon).returncode == 0
    assert fbar("pause", "live", url=daemon).returncode == 0
    assert fbar("cancel", "live", url=daemon).returncode == 0
    assert "live" in fbar("list", url=daemon).stdout
    assert fbar("watch", "live", url=daemon).returncode == 1
    assert fbar("probes", "live", "--csv", url=daemon).stdout.startswith("step,time")
    assert fbar("delete", "live", url=daemon).returncode == 0
    assert fbar("show", "live", url=daemon).returncode == 2


def test_an_invalid_scene_exits_2_with_its_pointers(daemon, fbar, tmp_path):
    result = fbar("run", "dam-break", "--set", "materials.water.density=-1", "--set", "cel=1",
                  "-o", "a.h5", url=daemon)
    assert result.returncode == 2
    assert "/materials/water/density: " in result.stderr and "/cel: " in result.stderr
    assert all(line.startswith("fbar: /") for line in result.stderr.splitlines())
    assert list(tmp_path.iterdir()) == []
    assert fbar("run", "dam-brake", url=daemon).returncode == 2


def test_interrupted_run_goes_on_as_it_is_told(daemon, fbar, start_fbar, tmp_path):
    """Ctrl-C pauses; the two commands that fbar then names lead to the recording of an undisturbed run."""
    words = ["run", "dam-break", *SMALL, "--set", "output.interval=0.005"]
    # It has no end of its own, so that it is not over before the signal comes; it gets one while it is paused.
    runner = start_fbar(*words, "--set", "time.end=1e3", "--id", "stopped", "-o", "a.h5", url=daemon)
    wait_for_log(runner, tmp_path, 200000)
    runner.send_signal(signal.SIGINT)
    _, err = runner.communicate(timeout=conftest.PATIENCE)
    assert runner.returncode == 130, err
    run = json.loads(get(f"{daemon}/v1/runs/stopped"))
    assert run["state"] == "paused", err
    time_end = f"time.end={round(max(run['time'], 0) + 0.1, 3)}"
    assert fbar("set", "stopped", time_end, url=daemon).returncode == 0
    with h5py.File(tmp_path / "a.h5") as f:  # closed, and what is there is whole
        assert f["fbard"].attrs["complete"] == 0 and len(f["fbard/frames/seq"]) > 2
    told = re.findall(r"`fbar (.*?)`", err)
    assert [line.split()[2] for line in told] == ["resume", "record"], err
    for line in told:
        done = fbar(*line.split())
        assert done.returncode == 0, done.stderr
    undisturbed = fbar(*words, "--set", time_end, "--id", "whole-again", "-o", "b.h5", url=daemon)
    assert undisturbed.returncode == 0, undisturbed.stderr
    with h5py.File(tmp_path / "a.h5") as a, h5py.File(tmp_path / "b.h5") as b:
        assert a["fbard"].attrs["complete"] == 1
        assert list(a["fbard/frames/step"]) == list(b["fbard/frames/step"])
        for name in b["VTKHDF/PointData"]:
            np.testing.assert_array_equal(a["VTKHDF/PointData"][name], b["VTKHDF/PointData"][name])


def test_a_failing_run_exits_1_and_its_recording_is_whole(daemon, fbar, tmp_path):
    result = fbar("run", "dam-break", *SMALL, "--set", "time.cfl=null", "--set", "time.dt=0.02",
                  "--set", "time.unstable_ok=true", "--id", "fails", "-o", "a.h5", url=daemon)
    assert result.returncode == 1, result.stderr
    assert "fbar: " in result.stderr
    check_frames(tmp_path / "a.h5", all_frames(daemon, "fails"))


# ---- Private daemons ----------------------------------------------------------------------------------

def wait_for_log(runner, tmp_path, size):
    log = tmp_path / "a.h5.log"
    conftest.wait_until(lambda: runner.poll() is not None or (log.exists() and log.stat().st_size > size))
    assert runner.poll() is None, runner.communicate()


def children(pid):
    return [int(p) for p in pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def wait_for_child(process):
    end = time.monotonic() + conftest.PATIENCE
    while time.monotonic() < end:
        for child in children(process.pid):
            if b"--port-file" in pathlib.Path(f"/proc/{child}/cmdline").read_bytes():
                return child
        time.sleep(0.005)
    raise AssertionError("no daemon was started")


def gone(pid, seconds=conftest.PATIENCE):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            if pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.01)
    return False


def test_run_alone_starts_and_stops_its_daemon(fbar, temporary, tmp_path):
    result = fbar("run", "dam-break", *SMALL, "-o", "a.h5")
    assert result.returncode == 0, result.stderr
    assert list(temporary.iterdir()) == []
    with h5py.File(tmp_path / "a.h5") as f:
        assert f["fbard"].attrs["complete"] == 1


def test_run_alone_interrupted_cancels_and_leaves_nothing(start_fbar, temporary, tmp_path):
    runner = start_fbar("run", "dam-break", "--set", "output.interval=0.001", "-o", "a.h5")
    child = wait_for_child(runner)
    assert len(list(temporary.iterdir())) == 1
    wait_for_log(runner, tmp_path, 400000)
    runner.send_signal(signal.SIGINT)
    out, err = runner.communicate(timeout=conftest.PATIENCE)
    assert runner.returncode == 130, err
    assert gone(child) and list(temporary.iterdir()) == []
    with h5py.File(tmp_path / "a.h5") as f:
        assert len(f["fbard/frames/seq"]) >= 2
        assert f["fbard"].attrs["state"] == b"cancelled" and f["fbard"].attrs["complete"] == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "a.xdmf", "t"]


def test_run_alone_killed_takes_its_daemon_along_and_recovers(start_fbar, fbar, temporary, tmp_path):
    runner = start_fbar("run", "dam-break", "--set", "output.interval=0.001", "-o", "a.h5")
    child = wait_for_child(runner)
    wait_for_log(runner, tmp_path, 400000)
    runner.kill()
    runner.wait()
    assert gone(child)
    assert len(list(temporary.iterdir())) == 1  # nobody was left to remove it
    assert fbar("recover", "a.h5").returncode == 0
    with h5py.File(tmp_path / "a.h5") as f:
        assert len(f["fbard/frames/seq"]) >= 2 and f["fbard"].attrs["complete"] == 0


def test_run_alone_without_a_file_says_that_nothing_is_kept(fbar, temporary):
    result = fbar("run", "dam-break", *SMALL, "--set", "time.end=0.01")
    assert result.returncode == 0 and "nothing of it is kept; -o FILE.h5" in result.stderr
    assert list(temporary.iterdir()) == []


def test_validate_tells_cost_with_units_and_warnings(daemon, fbar):
    result = fbar("validate", "dam-break", "--set", "basis=linear", url=daemon)
    assert result.returncode == 0 and "linear" in result.stderr and "warning: " in result.stderr
    cost = dict(re.split(r" {2,}", line) for line in result.stdout.splitlines()[1:])
    assert cost["particles"] == "3200" and cost["dt"].endswith(" s") and cost["memory"].endswith(" MB")


def test_run_alone_with_an_invalid_scene_leaves_nothing(fbar, temporary, tmp_path):
    result = fbar("run", "dam-break", "--set", "cell=-1", "-o", "a.h5")
    assert result.returncode == 2 and "/cell: " in result.stderr
    assert list(temporary.iterdir()) == [] and not (tmp_path / "a.h5").exists()


# ---- docs/reading.md ----------------------------------------------------------------------------------

def python_blocks():
    text = (conftest.ROOT / "docs" / "reading.md").read_text()
    return re.findall(r"```python\n(.*?)```", text, re.S)


def test_reading_h5py_block_runs(daemon, fbar, tmp_path):
    assert fbar("run", "dam-break", *SMALL, "-o", "dam.h5", url=daemon).returncode == 0
    result = subprocess.run(["/usr/bin/python3", "-c", python_blocks()[0]], cwd=tmp_path,
                            capture_output=True, text=True, timeout=conftest.PATIENCE)
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) >= 3


@pytest.mark.long
def test_reading_octave_block_runs(daemon, fbar, tmp_path):
    """The lines of the page, and what they read printed: as h5py reads it."""
    assert shutil.which("octave-cli"), "Octave is not installed: make deps-long"
    assert fbar("run", "dam-break", *SMALL, "-o", "dam.h5", url=daemon).returncode == 0
    text = (conftest.ROOT / "docs" / "reading.md").read_text()
    block = re.search(r"```octave\n(.*?)```", text, re.S)[1]
    (tmp_path / "read.m").write_text(block + 'printf("%d %d %.17g\\n", i, columns(x), frames.time(i));\n'
                                     'printf("%.17g %.17g %.17g\\n", [x(1:2, :); p(:)\']);\n')  # fmt: skip
    done = subprocess.run(["octave-cli", "--no-gui", "--norc", "read.m"], cwd=tmp_path, capture_output=True, text=True,
                          timeout=120)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "dam.png").read_bytes()[:4] == b"\x89PNG" and (tmp_path / "dam.png").stat().st_size > 10000
    (i, count, time_), *rows = [[float(v) for v in line.split()] for line in done.stdout.splitlines()
                                if re.fullmatch(r"(-?[\d.e+-]+ ?){3}", line)]  # fmt: skip
    with h5py.File(tmp_path / "dam.h5") as f:
        times = f["fbard/frames/time"][:]
        k = int(np.argmin(abs(times - 0.2)))
        start, n = f["fbard/frames/row"][k], f["fbard/frames/count"][k]
        x, p = f["VTKHDF/Points"][start:start + n], f["VTKHDF/PointData/mean_stress"][start:start + n]
    assert (i, count, time_) == (k + 1, n, times[k])
    np.testing.assert_array_equal(np.array(rows), np.column_stack([x[:, :2], -p]))


def test_reading_subscriber_block_runs(daemon, fbar, tmp_path):
    request = urllib.request.Request(f"{daemon}/v1/runs", method="POST", data=json.dumps(
        {"scene": "dam-break", "id": "seen", "start": False,
         "overrides": {"output": {"interval": 1e-4}}}).encode(),
        headers={"Content-Type": "application/json"})
    urllib.request.urlopen(request, timeout=conftest.PATIENCE).close()
    code = python_blocks()[1].replace("http://127.0.0.1:7800", daemon)
    viewer = subprocess.Popen(["/usr/bin/python3", "-u", "-c", code], text=True,
                              stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        end = time.monotonic() + conftest.PATIENCE
        while not select.select([viewer.stdout], [], [], 0.1)[0]:  # until it has subscribed
            assert fbar("step", "seen", "-n", "20", url=daemon).returncode == 0
            conftest.wait_until(lambda: json.loads(get(f"{daemon}/v1/runs/seen"))["state"] == "paused")
            assert time.monotonic() < end
        assert fbar("cancel", "seen", url=daemon).returncode == 0  # publishes the last frame
        out, err = viewer.communicate(timeout=conftest.PATIENCE)
    finally:
        viewer.kill()
    assert viewer.returncode == 0, err
    assert out.splitlines()[-1].startswith("seen ")
