"""Every command against a fake daemon: what it asks, what it prints, how it exits."""
import json
import os
import signal
import struct
import subprocess
import threading
import time

import pytest

import conftest

COMMANDS = ("run scenes validate list show start pause resume step cancel set watch record probes info "
            "plot recover delete bench").split()


def test_help_names_every_command(fbar):
    for words in (["--help"], ["-h"], ["help"]):
        result = fbar(*words)
        assert result.returncode == 0
        assert all(f"\n  {name}" in result.stdout for name in COMMANDS)
        assert len(result.stdout.splitlines()) <= 45 and max(map(len, result.stdout.splitlines())) <= 100
    for name in COMMANDS:
        result = fbar(name, "--help")
        assert result.returncode == 0 and f"usage: fbar {name}" in result.stdout
        assert not result.stderr
    assert "usage: fbar record" in fbar("help", "record").stdout


def test_version(fbar):
    for words in (["--version"], ["version"], ["list", "--version"], ["step", "--version"]):
        result = fbar(*words)
        assert result.returncode == 0 and result.stdout.split()[0] == "fbar"
        assert result.stdout == fbar("--version").stdout and not result.stderr


@pytest.mark.parametrize("words", [
    [], ["nonsense"], ["list", "extra"], ["show"], ["show", "a", "b"], ["list", "--nonsense"], ["-x", "list"],
    ["record", "r1"], ["record", "-o", "a.h5"], ["record", "r1", "-o"], ["run"], ["set", "r1"],
    ["set", "r1", "novalue"], ["set", "r1", "a..b=1"], ["step", "r1", "--steps", "0"],
    ["step", "r1", "-n", "x"], ["step", "r1", "x"],
    ["step", "r1", "1.5"], ["step", "r1", "2", "-n", "2"], ["step", "r1", "-n", "2", "-u", "1"],
    ["plot", "a.h5"], ["plot", "a.h5", "-o", "a.png", "--size", "1x1"],
    ["plot", "a.h5", "-o", "a.png", "--series", "d"], ["--url", "ftp://x", "list"],
    ["record", "r1", "-o", "a.h5", "--compress", "11"], ["run", "x", "--json=1"], ["help", "nonsense"]])
def test_usage_errors_exit_2(fbar, words):
    result = fbar(*words)
    assert result.returncode == 2
    assert result.stderr.startswith("fbar: ") or "usage: fbar" in result.stdout


def test_slips_get_a_suggestion(fbar):
    assert "did you mean record" in fbar("recrod", "x").stderr
    assert "did you mean --output" in fbar("record", "r1", "--ouptut", "x").stderr


@pytest.mark.parametrize("words", [
    ["list"], ["show", "r1"], ["scenes"], ["watch", "r1"], ["probes", "r1"], ["pause", "r1"],
    ["set", "r1", "fbar=false"], ["delete", "r1"], ["record", "r1", "-o", "a.h5"], ["run", "dam-break"],
    ["validate", "dam-break"]])
def test_an_unreachable_daemon_exits_3(fbar, tmp_path, words):
    result = fbar(*words, url="http://127.0.0.1:1")
    assert result.returncode == 3
    assert len(result.stderr.splitlines()) == 1 and "http://127.0.0.1:1" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_run_exits_2(fbar, fake, tmp_path):
    daemon = fake()
    for words in (["show", "no"], ["pause", "no"], ["record", "no", "-o", "a.h5"], ["watch", "no"]):
        result = fbar(*words, url=daemon.url)
        assert result.returncode == 2 and result.stderr == "fbar: no such run\n"
    assert list(tmp_path.iterdir()) == []


def test_ids_are_escaped_in_paths(fbar, fake):
    daemon = fake()
    fbar("show", "a/b?c d", url=daemon.url)
    assert ("GET", "/v1/runs/a%2Fb%3Fc%20d") in daemon.requests


def test_list_and_show(fbar, fake):
    daemon = fake()
    daemon.advance(10, live=False)
    result = fbar("list", url=daemon.url)
    assert result.returncode == 0 and "r1" in result.stdout and "running" in result.stdout
    assert json.loads(fbar("--json", "list", url=daemon.url).stdout)["runs"][0]["id"] == "r1"
    assert json.loads(fbar("list", "--json", url=daemon.url).stdout)["runs"][0]["id"] == "r1"
    result = fbar("show", "r1", url=daemon.url)
    assert result.returncode == 0 and "50.0 %" in result.stdout and "1 s on 2 threads\n" in result.stdout
    assert json.loads(fbar("show", "--json", "r1", url=daemon.url).stdout)["step"] == 900


def test_url_from_the_environment(fake):
    daemon = fake()
    result = subprocess.run([conftest.FBAR, "list"], capture_output=True, text=True,
                            env={**os.environ, "FBAR_URL": daemon.url + "/"})
    assert result.returncode == 0 and "r1" in result.stdout


def test_token_is_sent(fbar, fake, tmp_path):
    daemon, seen = fake(), []
    route = daemon.route
    daemon.route = lambda m, p, b, h: seen.append(h.get("Authorization")) or route(m, p, b, h)
    (tmp_path / "token").write_text("secret\n")
    assert fbar("--token-file", "token", "list", url=daemon.url).returncode == 0
    assert seen == ["Bearer secret"]
    assert fbar("--token-file", "none", "list", url=daemon.url).returncode == 4


@pytest.mark.parametrize("action", ["start", "pause", "resume", "cancel"])
def test_actions_are_posted(fbar, fake, action):
    daemon = fake()
    result = fbar(action, "r1", url=daemon.url)
    assert result.returncode == 0 and "at step 700" in result.stdout
    assert ("POST", f"/v1/runs/r1:{action}") in daemon.requests


def test_step_set_and_delete_send_their_bodies(fbar, fake):
    daemon = fake()
    assert fbar("step", "r1", url=daemon.url).returncode == 0
    assert fbar("step", "r1", "--steps", "20", url=daemon.url).returncode == 0
    assert fbar("step", "r1", "30", url=daemon.url).returncode == 0
    assert fbar("step", "r1", "--until", "0.25", url=daemon.url).returncode == 0
    assert fbar("set", "r1", "fbar=false", "damping.local=0.1", "damping.mass=2", "time.cfl=null",
                'fbar={"scheme":"anchored"}', "title=plain text", "gravity=[0,-1]",
                url=daemon.url).returncode == 0
    assert fbar("delete", "r1", url=daemon.url).returncode == 0
    assert [body for _, _, body in daemon.bodies] == [
        {"steps": 1}, {"steps": 20}, {"steps": 30}, {"until": 0.25},
        {"fbar": {"scheme": "anchored"}, "damping": {"local": 0.1, "mass": 2}, "time": {"cfl": None},
         "title": "plain text", "gravity": [0, -1]}]
    assert ("DELETE", "/v1/runs/r1") in daemon.requests
    assert ("PATCH", "/v1/runs/r1/config") in daemon.requests


def test_every_fault_is_a_line(fbar, fake, tmp_path):
    daemon = fake()
    daemon.problem = {"title": "Invalid scene", "status": 422, "detail": "2 faults", "errors": [
        {"pointer": "/materials/rubber/poisson_ratio", "code": "range",
         "detail": "must be below 0.5, got 0.5"},
        {"pointer": "/cell", "code": "required", "detail": "is missing"}]}
    (tmp_path / "scene.json").write_text('{"cell": 1}')
    for words in (["validate", "scene.json"], ["run", "scene.json"], ["set", "r1", "a=1"]):
        result = fbar(*words, url=daemon.url)
        assert result.returncode == 2
        assert result.stderr == ("fbar: /materials/rubber/poisson_ratio: must be below 0.5, got 0.5\n"
                                 "fbar: /cell: is missing\n")


def test_scene_files_are_sent_as_they_are(fbar, fake, tmp_path):
    daemon = fake()
    daemon.ready, daemon.state = 20, "completed"
    (tmp_path / "scene.json").write_text('{"cell": 0.1, "big": 12345678901234567890}')
    result = fbar("run", "scene.json", "--set", "materials.water.density=1e3", "--id", "r1",
                  url=daemon.url)
    assert result.returncode == 0, result.stderr
    body = daemon.bodies[0][2]
    assert body["scene"] == {"cell": 0.1, "big": 12345678901234567890}
    assert body["overrides"] == {"materials": {"water": {"density": 1000}}}
    assert body["id"] == "r1" and body["start"] is True
    assert fbar("run", "fake", url=daemon.url).returncode == 0
    assert daemon.bodies[1][2]["scene"] == "fake"
    for text in ("{", '{"a": 1}, "start": false, "x": {}', "\x00", ""):
        (tmp_path / "bad.json").write_text(text)
        result = fbar("run", "bad.json", url=daemon.url)
        assert result.returncode == 2 and "bad.json" in result.stderr
    assert fbar("run", "missing.json", url=daemon.url).returncode == 2


def test_validate_prints_the_estimate(fbar, fake):
    daemon = fake()
    result = fbar("validate", "fake", "--set", "cell=0.5", url=daemon.url)
    assert result.returncode == 0 and "particles" in result.stdout
    assert daemon.bodies[0][2] == {"scene": daemon.scene, "overrides": {"cell": 0.5}}
    assert json.loads(fbar("--json", "validate", "fake", url=daemon.url).stdout)["valid"] is True
    assert fbar("validate", "unknown", url=daemon.url).returncode == 2


def test_scenes(fbar, fake):
    daemon = fake()
    assert fbar("scenes", url=daemon.url).stdout.split() == ["fake", "A", "fake"]
    assert json.loads(fbar("scenes", "fake", url=daemon.url).stdout) == daemon.scene


def test_probes_pass_the_csv_through(fbar, fake):
    daemon = fake()
    result = fbar("probes", "r1", "--csv", url=daemon.url)
    assert result.returncode == 0
    assert result.stdout.replace("\r\n", "\n") == daemon.probes_csv.replace("\r\n", "\n")


def test_watch_exits_with_the_outcome(fbar, fake, start_fbar):
    daemon = fake(n_frames=4)
    watcher = start_fbar("watch", "r1", url=daemon.url)
    daemon.play(0.1)
    out, err = watcher.communicate(timeout=conftest.PATIENCE)
    assert watcher.returncode == 0 and "r1 completed" in out
    assert "\r" not in err and "\033" not in err  # no terminal
    daemon.state = "failed"
    assert fbar("watch", "r1", url=daemon.url).returncode == 1
    result = fbar("--json", "watch", "r1", url=daemon.url)
    assert json.loads(result.stdout.splitlines()[-1])["state"] == "failed"


def test_watch_on_a_terminal_redraws_one_line(fake):
    daemon = fake(n_frames=6)
    daemon.advance_when_asked(6)
    shown = conftest.on_a_terminal("--url", daemon.url, "watch", "r1")
    assert shown.count("\r\033[K") >= 2 and "█" in shown


def test_no_progress_line_is_printed_twice(fbar, fake):
    daemon = fake(n_frames=4)
    daemon.advance(4, live=False)
    for state in ("failed", "completed"):
        daemon.state = state
        for words in (["run", "fake", "-o", f"{state}.h5"], ["run", "fake"], ["watch", "r1"]):
            lines = [x for x in fbar(*words, url=daemon.url).stderr.splitlines() if "step" in x]
            assert len(lines) == len(set(lines)) == 1, (words, lines)


def test_run_records_and_reports(fbar, fake, tmp_path):
    daemon = fake()
    daemon.play(0.005)
    result = fbar("run", "fake", "-o", "a.h5", url=daemon.url)
    assert result.returncode == 0, result.stderr
    assert "r1 completed" in result.stdout and "a.h5: 20 frames" in result.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "a.xdmf"]
    result = fbar("run", "fake", "-o", "a.h5", url=daemon.url)  # the file holds a run: nothing is begun
    assert result.returncode == 4 and len(daemon.bodies) == 1 + len(daemon.acks)


def test_run_interrupted_pauses_the_run_of_a_shared_daemon(fake, start_fbar, tmp_path):
    daemon = fake()
    for words in (["-o", "a.h5"], []):
        runner = start_fbar("run", "fake", *words, url=daemon.url)
        conftest.wait_until(lambda: any(p == "/v1/runs/r1" for _, p in daemon.requests))
        time.sleep(0.3)
        runner.send_signal(signal.SIGINT)
        _, err = runner.communicate(timeout=conftest.PATIENCE)
        assert runner.returncode == 130, err
        assert ("POST", "/v1/runs/r1:pause") in daemon.requests
        assert f"`fbar --url {daemon.url} resume r1`" in err and "Ctrl-C again leaves at once" in err
        assert not words or f"`fbar --url {daemon.url} record r1 -o a.h5`" in err
        daemon.requests.clear()


@pytest.mark.parametrize("words", [["-o", "a.h5"], []])
def test_a_second_interrupt_leaves_at_once(fake, fbar, start_fbar, tmp_path, words):
    """Also while the daemon does not answer the first one's pause; what was recorded goes on from there."""
    daemon, held = fake(), threading.Event()
    daemon.advance(5, live=False)
    route = daemon.route

    def hold_pauses(method, path, body, headers):
        answer = route(method, path, body, headers)
        if path.endswith(":pause"):
            held.wait()
        return answer
    daemon.route = hold_pauses
    runner = start_fbar("run", "fake", *words, url=daemon.url)

    def wait_for(condition):
        conftest.wait_until(lambda: runner.poll() is not None or condition())
        assert runner.poll() is None
    wait_for(lambda: any(p == "/v1/runs/r1" for _, p in daemon.requests) and (not words or 4 in daemon.acks))
    runner.send_signal(signal.SIGINT)
    wait_for(lambda: ("POST", "/v1/runs/r1:pause") in daemon.requests)
    time.sleep(0.3)
    assert runner.poll() is None  # it waits for the answer
    runner.send_signal(signal.SIGINT)
    out, err = runner.communicate(timeout=conftest.PATIENCE)  # the answer has not come
    assert runner.returncode == 130, err
    assert err.count("Ctrl-C again leaves at once") == 1
    held.set()
    if words:
        daemon.state = "running"
        daemon.advance(20 - daemon.ready, live=False)
        assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
        assert json.loads(fbar("--json", "info", "a.h5").stdout)["frames"] == 20


# ---- Recordings -------------------------------------------------------------------------------------

@pytest.fixture
def recording(fbar, fake):
    daemon = fake(n_frames=6, count=400)
    daemon.advance(6, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    return daemon


def test_info(fbar, recording, tmp_path):
    result = fbar("info", "a.h5")
    assert result.returncode == 0 and "6 frames of 400 particles in 2D" in result.stdout
    info = json.loads(fbar("--json", "info", "a.h5").stdout)
    assert info["run"] == "r1" and info["frames"] == 6 and info["complete"] is True
    assert {f["name"]: f["unit"] for f in info["fields"]} == {
        "id": "1", "mean_stress": "Pa", "stress": "Pa", "velocity": "m/s"}
    (tmp_path / "no.h5").write_text("no")
    assert fbar("info", "no.h5").returncode == 4
    assert fbar("info", "missing.h5").returncode == 4


def png_size(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 5000
    return struct.unpack(">II", data[16:24])


@pytest.mark.parametrize("words, size", [
    ([], None), (["--field", "velocity", "--component", "y", "--time", "0.021"], None),
    (["--size", "800x600", "--range", "-5:5"], (800, 600)), (["--axes", "0:1,-1:1.5"], None),
    (["-f", "stress", "-c", "xy"], None)])
def test_plot_draws_a_picture(fbar, recording, tmp_path, words, size):
    result = fbar("--json", "plot", "a.h5", "-o", "a.png", *words)
    assert result.returncode == 0, result.stderr
    got = png_size(tmp_path / "a.png")
    assert got == size if size else got[0] == 1600
    answer = json.loads(result.stdout)
    if "--time" in words:
        assert answer["time"] == 0.02 and answer["field"] == "velocity"
    if "--range" in words:
        assert (answer["low"], answer["high"]) == (-5, 5)


@pytest.mark.parametrize("time, warned", [
    ("99", "0.05"), ("-1", "0"), ("0.056", "0.05"), ("0.054", None), ("0.025", None), (None, None),
    ("0.01,0.2", "0.05")])
def test_plot_warns_of_a_time_that_was_not_recorded(fbar, recording, time, warned):
    result = fbar("plot", "a.h5", "-o", "a.png", "--size", "640x400", *(["--time", time] if time else []))
    assert result.returncode == 0
    lines = result.stderr.splitlines()
    if warned is None:
        assert not lines
    else:
        asked = time.split(",")[-1]
        assert lines == [f"fbar: warning: a.h5 has no frame near t = {asked} s; drawing the nearest, "
                         f"t = {warned} s"]


def test_plot_3d_and_series(fbar, fake, tmp_path):
    daemon = fake(n_frames=2, dimension=3, count=64)
    daemon.advance(2, live=False)
    assert fbar("record", "r1", "-o", "b.h5", url=daemon.url).returncode == 0
    result = fbar("plot", "b.h5", "--field", "mean_stress", "--series", "film", "--size", "500x400")
    assert result.returncode == 0, result.stderr
    pictures = sorted((tmp_path / "film").iterdir())
    assert [png_size(p) for p in pictures] == [(500, 400)] * 2


def record_again(fbar, fake, name, **options):
    daemon = fake(**options)
    daemon.advance(options["n_frames"], live=False)
    assert fbar("record", "r1", "-o", name, url=daemon.url).returncode == 0


@pytest.mark.parametrize("files, times, size", [
    (["a.h5"], "0.01,0.02,0.05", None), (["a.h5", "b.h5"], None, None),
    (["a.h5", "b.h5"], "0,0.03", "700x500"), (["a.h5", "b.h5", "a.h5"], "0.02,0.04", "240x200")])
def test_plot_of_several_is_one_grid(fbar, fake, recording, tmp_path, files, times, size):
    record_again(fbar, fake, "b.h5", n_frames=4, count=200)
    words = ["-f", "velocity", *(["-t", times] if times else []), *(["--size", size] if size else [])]
    result = fbar("--json", "plot", *files, "-o", "g.png", *words)
    assert result.returncode == 0, result.stderr
    width, height = png_size(tmp_path / "g.png")
    assert f"{width}x{height}" == size if size else 800 <= width <= 1600 and height > 300
    answer = json.loads(result.stdout)
    panels = answer["panels"]
    assert answer["file"] == "g.png"
    assert [p["file"] for p in panels] == files * (times.count(",") + 1 if times else 1)
    if files == ["a.h5"]:
        assert [p["time"] for p in panels] == [0.01, 0.02, 0.05]
    assert all(p["field"] == "velocity" and p["unit"] == "m/s" and p["low"] < p["high"] for p in panels)
    result = fbar("plot", *files, "-o", "g.png", *words)
    assert result.returncode == 0 and len(result.stdout.splitlines()) == 1 + len(files)


def test_plot_of_several_may_share_a_range(fbar, recording, tmp_path):
    result = fbar("--json", "plot", "a.h5", "a.h5", "-o", "g.png", "-t", "0,0.05", "-r", "-5:5",
                  "--axes", "0:1,0:0.5")
    assert result.returncode == 0, result.stderr
    assert {(p["low"], p["high"]) for p in json.loads(result.stdout)["panels"]} == {(-5, 5)}
    assert sorted(p.name for p in tmp_path.iterdir() if "png" in p.name) == ["g.png"]


def test_plot_of_several_in_3d(fbar, fake, recording, tmp_path):
    record_again(fbar, fake, "c.h5", n_frames=2, dimension=3, count=64)
    assert fbar("plot", "c.h5", "c.h5", "-o", "g.png", "-t", "0,0.01").returncode == 0
    assert png_size(tmp_path / "g.png")[0] <= 1600
    result = fbar("plot", "a.h5", "c.h5", "-o", "no.png")
    assert result.returncode == 2 and "c.h5: is 3D, unlike a.h5" in result.stderr


def test_plot_of_several_says_what_is_wrong(fbar, recording, tmp_path):
    for words, part in ((["-t", "0,"], "--time"), (["-t", "0,x"], "--time"), (["-t", "0 1"], "--time"),
                        (["-t", ",".join("0" * 17)], "--time"), (["a.h5", "-f", "x"], "--field"),
                        (["a.h5"] * 8, "8 recordings"), (["a.h5", "--axes", "0:1"], "--axes")):
        result = fbar("plot", "a.h5", "-o", "g.png", *words)
        assert result.returncode == 2 and part in result.stderr, result.stderr
    for words in (["-t", "1"], ["-t", "0,1"]):
        result = fbar("plot", "a.h5", *words, "--series", "film")
        assert result.returncode == 2 and "--series" in result.stderr
    (tmp_path / "no.h5").write_text("no")
    for name in ("no.h5", "missing.h5"):
        result = fbar("plot", "a.h5", name, "-o", "g.png")
        assert result.returncode == 4 and name in result.stderr
    assert not (tmp_path / "g.png").exists()


def test_plot_says_what_is_wrong(fbar, recording, tmp_path):
    for words in (["-f", "men_stress"], ["-c", "x"], ["-f", "velocity", "-c", "q"], ["-r", "3:1"],
                  ["-t", "x"], ["--axes", "0:1"], ["--axes", "1:0,0:1"], ["--axes", "0:1,0:1,0:1"]):
        assert fbar("plot", "a.h5", "-o", "a.png", *words).returncode == 2
    assert "did you mean mean_stress" in fbar("plot", "a.h5", "-o", "a.png", "-f", "men_stress").stderr
    result = fbar("plot", "a.h5", "-o", "none/a.png")
    assert result.returncode == 4 and "none/a.png" in result.stderr
    result = subprocess.run(conftest.command("plot", "a.h5", "-o", "a.png"), cwd=tmp_path, text=True,
                            capture_output=True, env={"PATH": "/nonexistent"})
    assert result.returncode == 4 and "install it" in result.stderr
    assert not (tmp_path / "a.png").exists()
