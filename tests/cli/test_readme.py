"""Every command that README.md shows in a sh block, run word for word as far as a test can."""
import json
import os
import pathlib
import re
import shlex
import subprocess
import time

import pytest

import conftest

README = (conftest.ROOT / "README.md").read_text()
ADDRESS = "http://127.0.0.1:7800"
# Makes the dam break, full size and 2 GPa in the README, a matter of a second.
SHORT = ["--set", "materials.water.bulk_modulus=2e7", "--set", "time.dt=null", "--set", "time.cfl=0.3",
         "--set", "time.end=0.45"]

pytestmark = pytest.mark.skipif(not os.access(conftest.FBARD, os.X_OK), reason="fbard is not built")


def commands():
    """[[word, ...]] in the order of the README, without comments."""
    text = "".join(re.findall(r"^```sh\n(.*?)^```$", README, re.M | re.S)).replace("\\\n", " ")
    return [words for words in (shlex.split(line, comments=True) for line in text.splitlines()) if words]


@pytest.fixture
def url(tmp_path):
    ports = tmp_path / "ports.json"
    with open(tmp_path / "fbard.log", "w") as log:
        process = subprocess.Popen(
            [conftest.FBARD, "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--port-file",
             str(ports), "--data-dir", str(tmp_path / "data"), "--slots", "2"], stderr=log)
    try:
        end = time.monotonic() + 10
        while not ports.exists():
            assert process.poll() is None and time.monotonic() < end, (tmp_path / "fbard.log").read_text()
            time.sleep(0.01)
        yield json.loads(ports.read_text())["http"]
    finally:
        process.terminate()
        assert process.wait(20) == 0


def curl(words, url):
    """(HTTP status, content type, body) of a curl line; one that is refused fails."""
    extra = ["-sS", "--max-time", "10", "-w", "\n%{http_code} %{content_type}"]
    done = subprocess.run([words[0], *extra, *(w.replace(ADDRESS, url) for w in words[1:])],
                          capture_output=True, text=True)
    assert done.returncode == 0, (words, done.stderr)
    body, last = done.stdout.rsplit("\n", 1)
    status, kind = last.split(" ", 1)
    assert 200 <= int(status) < 300, (words, done.stdout)
    return int(status), kind, body


def test_curl_lines(url):
    lines = [words for words in commands() if words[0] == "curl"]
    assert len(lines) >= 5 and all(any(ADDRESS in w for w in words) for words in lines)
    answers = {}
    for words in lines:
        status, kind, body = curl(words, url)
        if "text/csv" in " ".join(words):
            assert kind.startswith("text/csv")
            header, *rows = body.strip().splitlines()
            assert header.startswith("step,time") and all(row.count(",") == header.count(",") for row in rows)
        else:
            assert kind.startswith("application/json") and isinstance(json.loads(body), dict)
            answers[words[-1].rsplit("/", 1)[1]] = json.loads(body)
            assert status in (200, 201, 202)
    # The walk leads through one run: it was there, F-bar was switched off, it is paused.
    assert answers["dam"]["id"] == "dam" and answers["config"]["fbar"] is False
    run = json.loads(curl(["curl", f"{url}/v1/runs/dam"], url)[2])
    assert run["state"] == "paused" and run["fbar"] is False


def test_client_lines(url, tmp_path):
    lines = [words for words in commands() if words[0].startswith("build/")]
    assert any(words[:2] == ["build/fbar", "run"] for words in lines)
    assert any(words[:2] == ["build/fbar", "plot"] for words in lines)
    for words in lines:
        assert words[0] == "build/fbar", f"no test runs {words}"
        extra = SHORT if words[1] == "run" else []
        done = subprocess.run([conftest.FBAR, *words[1:], *extra], capture_output=True, text=True,
                              timeout=30, cwd=tmp_path, env={**conftest.environment(), "FBAR_URL": url})
        assert done.returncode == 0, (words, done.stderr)
        for flag, name in zip(words, words[1:]):
            if flag == "-o":
                start = (tmp_path / name).read_bytes()[:4]
                assert start == (b"\x89PNG" if name.endswith(".png") else b"\x89HDF")


def test_make_lines():
    """The targets exist, those named in the text too; running them is their own business."""
    shown = [words[1] for words in commands() if words[0] == "make"]
    assert {"demo", "check"} <= set(shown)
    for target in {*shown, *re.findall(r"`make ([a-z-]+)`", README)}:
        done = subprocess.run(["make", "-n", target], cwd=conftest.ROOT, capture_output=True, text=True,
                              env={k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS")})
        assert done.returncode == 0, done.stderr


def test_links_lead_somewhere():
    """Files exist; headings have the place that GitHub gives them. The web is not asked."""
    places = {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in
              re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", README, flags=re.M | re.S), re.M)}
    links = re.findall(r"\]\(([^)\s]+)\)", README)
    assert len(links) > 5
    for link in links:
        if link.startswith("#"):
            assert link[1:] in places, link
        elif "://" not in link:
            assert (conftest.ROOT / link.split("#")[0]).is_file(), link


def test_nothing_is_left_out():
    assert {words[0] for words in commands()} <= {"make", "curl", "build/fbar"}
    for command in re.findall(r"`build/fbar ([a-z]+)`", README):
        assert f"\n  {command} " in subprocess.run([conftest.FBAR, "--help"], capture_output=True,
                                                   text=True).stdout
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert pathlib.Path(conftest.ROOT / picture).stat().st_size <= 250_000
