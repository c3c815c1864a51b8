"""Every command that README.md and docs/tutorial.md show in a sh block, run word for word as far as a test can; those that
stand in the text of any page are there."""
import json
import os
import pathlib
import re
import shlex
import subprocess

import pytest

import conftest

README = (conftest.ROOT / "README.md").read_text()
ADDRESS = "http://127.0.0.1:7800"
# Makes the dam break, full size and 2 GPa in the README, a matter of a second.
SHORT = ["--set", "materials.water.bulk_modulus=2e6", "--set", "time.dt=null", "--set", "time.cfl=0.3",
         "--set", "time.end=0.45"]

pytestmark = pytest.mark.skipif(not os.access(conftest.FBARD, os.X_OK), reason="fbard is not built")


def commands():
    """[[word, ...]] in the order of the README, without comments."""
    return read_commands(conftest.ROOT / "README.md")


def read_commands(path):
    """The lines of a page's sh blocks."""
    text = "".join(re.findall(r"^```sh\n(.*?)^```$", path.read_text(), re.M | re.S)).replace("\\\n", " ")
    return [words for words in (shlex.split(line, comments=True) for line in text.splitlines()) if words]


@pytest.fixture
def url(tmp_path):
    ports = tmp_path / "ports.json"
    with open(tmp_path / "fbard.log", "w") as log:
        process = subprocess.Popen(
            [conftest.FBARD, "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--port-file",
             str(ports), "--data-dir", str(tmp_path / "data"), "--slots", "2"], stderr=log)
    try:
        conftest.wait_until(lambda: process.poll() is not None or ports.exists())
        assert process.poll() is None, (tmp_path / "fbard.log").read_text()
        yield json.loads(ports.read_text())["http"]
    finally:
        process.terminate()
        assert process.wait(conftest.PATIENCE) == 0


def curl(words, url):
    """(HTTP status, content type, body) of a curl line; one that is refused fails."""
    extra = ["-sS", "--max-time", "100", "-w", "\n%{http_code} %{content_type}"]
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
                              timeout=conftest.PATIENCE, cwd=tmp_path, env={**conftest.environment(), "FBAR_URL": url})
        assert done.returncode == 0, (words, done.stderr)
        for flag, name in zip(words, words[1:]):
            if flag == "-o":
                start = (tmp_path / name).read_bytes()[:4]
                assert start == (b"\x89PNG" if name.endswith(".png") else b"\x89HDF")


# ---- Commands in the texts of all pages -----------------------------------------------------------------

PAGES = [conftest.ROOT / "README.md", *sorted((conftest.ROOT / "docs").glob("*.md")),
         *(conftest.ROOT / name for name in ("scenes/README.md", "proto/README.md", "tests/README.md", "bench/report/README.md"))]
# Whose blocks are run: here, by test_install (libmpm) and by test_daemon (reading). JSON: test_json_of_the_pages_*.
RUN = {"README.md": {"sh"}, "docs/tutorial.md": {"sh"}, "docs/libmpm.md": {"sh", "c"}, "docs/reading.md": {"python", "octave"}}


def mentioned():
    """[(page, [word, ...])]: what stands in a line of text as `make ...`, `build/fbar ...`, `fbard ...` or `curl ...`."""
    found = []
    for page in PAGES:
        text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
        for command in re.findall(r"`((?:make|curl|(?:build/)?fbard?) [^`]+)`", text):
            found.append((page.name, shlex.split(command)))
    return found


def test_no_page_has_a_block_of_commands_that_no_test_runs():
    for page in PAGES:
        kinds = set(re.findall(r"^```([a-z]+)$", page.read_text(), re.M)) - {"json"}
        assert kinds == RUN.get(str(page.relative_to(conftest.ROOT)), set()), page


def test_targets_that_pages_name_exist():
    """Running them is their own business."""
    assert ["make", "deps"] in commands() and "`make demo`" in README and "`make check`" in README
    lines = [words[1:] for _, words in mentioned() if words[0] == "make"] + [
        words[1:] for words in commands() if words[0] == "make"]  # fmt: skip
    targets = {word for words in lines for word in words if word[0] != "-" and "=" not in word}
    settings = {word.split("=")[0] for words in lines for word in words if "=" in word}
    assert len(targets) > 15 and {"SIZE", "PREFIX"} <= settings
    makefile = (conftest.ROOT / "Makefile").read_text()
    for name in settings:
        assert re.search(rf"^{name} \?=|\$\({name}\)", makefile, re.M), name
    # All at once, and MAKE=: so that no part is read anew for each target that calls it: all are targets of their own.
    done = subprocess.run(["make", "-n", "MAKE=:", *sorted(targets)], cwd=conftest.ROOT, capture_output=True, text=True,
                          env={k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS")})
    assert done.returncode == 0, done.stderr


def test_commands_and_options_that_pages_name_exist():
    known = {}

    def said(*words):
        if words not in known:
            known[words] = subprocess.run(words, capture_output=True, text=True).stdout
        return known[words]

    lines = [(page, words) for page, words in mentioned() if words[0].removeprefix("build/") in ("fbar", "fbard")]
    assert len(lines) > 20
    for page, words in lines:
        if words[0].endswith("fbard"):
            text = said(conftest.FBARD, "--help")
        else:
            command = next((w for w in words[1:] if re.fullmatch("[a-z]+", w) and f"\n  {w} " in said(conftest.FBAR, "help")), "")
            assert command or set(words[1:]) <= {"help", "COMMAND", "--version"}, (page, words)
            text = said(conftest.FBAR, "help") + said(conftest.FBAR, "help", command or "run")
        for option in (w.split("=")[0] for w in words if w[:2] == "--"):
            assert re.search(rf"(?<![\w-]){option}(?![\w-])", text), (page, words)


def test_curl_lines_in_texts(url):
    lines = [words for _, words in mentioned() if words[0] == "curl" and words[-1].startswith(ADDRESS)]
    assert lines
    for words in lines:
        assert curl(words, url)[2]


def places(path):
    """The places of a file's headings, as GitHub names them, and those that it names itself."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.M | re.S)
    return {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)$", text, re.M)} | set(
        re.findall(r'<a id="([^"]+)"', text))


@pytest.mark.parametrize("name", ["README.md", "scenes/README.md", *(f"docs/{p.name}" for p in sorted(
    (conftest.ROOT / "docs").glob("*.md")))])
def test_links_lead_somewhere(name):
    """Files and headings exist. The web is not asked."""
    page = conftest.ROOT / name
    links = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S))
    assert len(links) > 5 or name != "README.md"
    for link in links:
        if "://" in link:
            continue
        file, _, place = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), f"{name}: {link}"
        assert not place or target.suffix != ".md" or place in places(target), f"{name}: {link}"


def test_json_of_the_pages_is_json_and_scenes_are_valid(url):
    """Fragments parse; what stands there as a whole, a scene, a request or a patch of the dam break, is valid."""
    blocks = [(page.name, text) for page in PAGES for text in re.findall(r"^```json\n(.*?)^```$", page.read_text(), re.M | re.S)]
    assert len(blocks) > 8
    whole = []
    for page, text in blocks:
        value = json.loads(text if text.lstrip()[0] == "{" else "{" + text + "}")
        if value.get("format") == "fbard-scene-1":
            whole.append({"scene": value})
        elif "overrides" in value:
            whole.append({key: value[key] for key in ("scene", "overrides")})
        elif page == "README.md":  # of scenes/
            whole.append({"scene": "dam-break", "overrides": value})
    assert len(whole) >= 3
    for body in whole:
        assert curl(["curl", "--json", json.dumps(body), f"{url}/v1/scenes:validate"], url)[0] == 200


def test_nothing_is_left_out():
    assert {words[0] for words in commands()} <= {"make", "curl", "build/fbar"}
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert pathlib.Path(conftest.ROOT / picture).stat().st_size <= 250_000


# ---- docs/tutorial.md -----------------------------------------------------------------------------------

TUTORIAL = conftest.ROOT / "docs" / "tutorial.md"
# Full-size runs of the tutorial, made short; the one that is steered ends soon after it was.
MADE_SHORT = [*SHORT[:-1], "time.end=0.42"]


def test_tutorial_lines_work_in_their_order(url, tmp_path):
    """From a clean home, word for word, but for the length of the runs and where the daemon listens."""
    folder, home = tmp_path / "clone", tmp_path / "home"
    (folder / "build").mkdir(parents=True)
    home.mkdir()
    for program, path in (("fbar", conftest.FBAR), ("fbard", conftest.FBARD)):
        os.symlink(path, folder / "build" / program)
    environment = {"PATH": os.environ["PATH"], "HOME": str(home), "TMPDIR": str(tmp_path)}
    lines, steered = read_commands(TUTORIAL), []
    assert [words for words in lines if words[0] == "make"] == [["make", "deps"], ["make", "-j4"]]
    assert ["build/fbard", "&"] in lines
    for words in lines:
        if words[0] == "make":
            continue
        if words == ["build/fbard", "&"]:  # `url` is that daemon, at another address
            environment["FBAR_URL"] = url
            continue
        assert words[0] == "build/fbar", f"no test runs {words}"
        more = []
        if words[1] == "run" and "--detach" in words:
            more = ["--set", "output.interval=0.01"]
            steered = ["show", words[words.index("--id") + 1]]
        elif words[1] == "run" and words[2] == "dam-break":
            more = MADE_SHORT
        elif words[1] == "record":  # what was steered ends a thousand steps later, which are not over before it is told
            def steer(*words):
                return subprocess.run([conftest.FBAR, "--json", *words], capture_output=True, text=True, env=environment,
                                      check=True).stdout  # fmt: skip

            time = json.loads(steer("pause", steered[1]))["time"]
            steer("set", steered[1], f"time.end={max(time, 0) + 0.01}")
            steer("resume", steered[1])
        line = " ".join(shlex.quote(w) if w != ">" else w for w in [*words, *more])
        done = subprocess.run(["sh", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, timeout=conftest.PATIENCE)
        assert done.returncode == 0, (line, done.stdout, done.stderr)
        for flag, name in zip(words, words[1:]):
            if flag == "-o":
                start = (folder / name).read_bytes()[:4]
                assert start == (b"\x89PNG" if name.endswith(".png") else b"\x89HDF"), line
    run = json.loads(subprocess.run([conftest.FBAR, "--json", *steered], capture_output=True, text=True,
                                    env=environment).stdout)  # fmt: skip
    assert run["fbar"] is True and [change["patch"] for change in run["changes"]][0] == {"fbar": True}
    assert json.loads((folder / "mine.json").read_text())["format"] == "fbard-scene-1"
    for command in re.findall(r"`build/fbar ([a-z]+)", TUTORIAL.read_text()):
        assert command == "help" or command in {word for words in lines for word in words[1:2]} | {"watch", "completion"}
