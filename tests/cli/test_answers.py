"""What fbar says: JSON where it is asked for, colours on terminals only, and what to do next."""
import json
import os
import re

import pytest

from conftest import on_a_terminal

ESCAPE = re.compile(r"\x1b\[[0-9;]*m")


def parsed(result):
    return json.loads(result.stdout)


@pytest.fixture
def recording(fbar, fake):
    daemon = fake(n_frames=4, count=60)
    daemon.advance(4, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    return daemon


def test_json_of_every_command_is_json(fbar, fake, recording):
    daemon = fake(n_frames=4)
    daemon.advance(4, live=False)
    lines = {
        "run": ["fake", "-o", "b.h5"], "scenes": [], "validate": ["fake"], "list": [], "show": ["r1"], "watch": ["r1"],
        "set": ["r1", "fbar=false"], "pause": ["r1"], "resume": ["r1"], "start": ["r1"], "step": ["r1"],
        "record": ["r1", "-o", "c.h5"], "info": ["a.h5"], "plot": ["a.h5", "-o", "a.png", "--size", "400x300"],
        "recover": ["d.h5"], "keygen": ["keys"], "completion": ["bash"], "cancel": ["r1"], "delete": ["r1"],
        "bench": ["accuracy", "--list"],
    }  # fmt: skip
    shown = re.findall(r"^  ([a-z]+) ", fbar("help").stdout.split("examples")[0], re.M)
    assert set(lines) | {"probes"} == set(shown)
    for command, words in lines.items():
        result = fbar("--json", command, *words, url=daemon.url)
        assert result.returncode == (4 if command == "recover" else 0), (command, result.stderr)
        assert isinstance(parsed(result), dict), command
    for command in ("list", "plot"):
        assert parsed(fbar(command, "--json", *lines[command], "--nonsense", url=daemon.url))["exit_code"] == 2
    assert parsed(fbar("--json", "--version"))["version"] == fbar("--version").stdout.split()[1]


def test_json_of_a_fault_says_what_is_wrong(fbar, fake):
    daemon = fake()
    result = fbar("--json", "show", "no", url=daemon.url)
    assert result.returncode == 2 and parsed(result)["status"] == 404
    daemon.problem = {"title": "Invalid", "status": 422, "detail": "1 fault",
                      "errors": [{"pointer": "/cell", "code": "range", "detail": "must be positive"}]}
    result = fbar("--json", "run", "fake", url=daemon.url)
    assert result.returncode == 2 and parsed(result)["errors"] == daemon.problem["errors"]
    result = fbar("--json", "list", url="http://127.0.0.1:1")
    assert result.returncode == 3 and parsed(result)["exit_code"] == 3 and "127.0.0.1:1" in parsed(result)["faults"][0]
    result = fbar("--json", "info", "none.h5")
    assert result.returncode == 4 and parsed(result)["faults"] == [result.stderr.removeprefix("fbar: ").strip()]


def test_colours_are_for_terminals(fbar, fake):
    daemon = fake(n_frames=2)
    daemon.advance(2, live=False)
    for words in (["list"], ["show", "r1"], ["watch", "r1"], ["show", "no"], ["help"]):
        plain = fbar(*words, url=daemon.url)
        assert not ESCAPE.search(plain.stdout + plain.stderr)
        assert ESCAPE.search(on_a_terminal("--url", daemon.url, *words)), words
        assert not ESCAPE.search(on_a_terminal("--url", daemon.url, *words, NO_COLOR="1")), words
        assert not ESCAPE.search(on_a_terminal("--url", daemon.url, *words, TERM="dumb")), words
    assert not ESCAPE.search(on_a_terminal("--url", daemon.url, "--json", "list"))


@pytest.mark.parametrize("columns", [80, 100, 200])
def test_progress_line_has_everything_in_any_width(fake, columns):
    daemon = fake(n_frames=3)
    daemon.advance_when_asked(3)
    text = on_a_terminal("--url", daemon.url, "watch", "r1", columns=columns)
    line = [ESCAPE.sub("", part) for part in re.split(r"\r(?:\x1b\[K)?", text) if "step" in part][0]
    assert re.search(r"[█░▏▎▍▌▋▊▉]+ +\d+\.\d %  step \d+  t = \S+ s  1 M.*/s  ETA 1 s  F-bar on", line), line
    assert len(line) < columns and ("r1" in line) == (columns > 96)


def test_messages_say_what_to_do_next(fbar, fake, recording, tmp_path):
    assert "start one with `fbard`" in fbar("list", url="http://127.0.0.1:1").stderr
    daemon = fake()
    requests = len(daemon.requests)
    result = fbar("run", "fake", "-o", "none/a.h5", url=daemon.url)
    assert result.returncode == 4 and "none/a.h5" in result.stderr and "choose another -o" in result.stderr
    assert len(daemon.requests) == requests  # no run was made that nobody records
    result = fbar("run", "fake", "-o", "a.h5", url=daemon.url)
    assert result.returncode == 4 and "holds the run r1; choose another -o" in result.stderr
    os.chmod(tmp_path / "a.h5", 0o444)
    assert fbar("info", "a.h5").returncode == 0


def test_a_detached_run_is_left_to_the_daemon(fbar, fake):
    daemon = fake()
    result = fbar("run", "fake", "--id", "r1", "--detach", url=daemon.url)
    assert result.returncode == 0 and result.stdout == "r1\n" and "fbar watch r1" in result.stderr
    assert parsed(fbar("--json", "run", "fake", "-d", url=daemon.url))["id"] == "r1"
    posted = [body for method, path, body in daemon.bodies if path == "/v1/runs"]
    assert len(posted) == 2 and all("recorders" not in body for body in posted)
    assert fbar("run", "fake", "--detach", "-o", "a.h5", url=daemon.url).returncode == 2
    assert fbar("run", "fake", "--detach", url="http://127.0.0.1:1").returncode == 3
