"""make install and uninstall: what is put where, and that it works from there."""
import json
import os
import pathlib
import re
import shutil
import subprocess
import time

import pytest

import conftest

ROOT = conftest.ROOT
LONG = bool(os.environ.get("FBARD_LONG"))
BARE = {"PATH": "/usr/bin:/bin", "LC_ALL": "C"}
PROGRAMS = ["bin/fbard", "bin/fbar"]
OTHERS = ["share/man/man1/fbar.1", "share/man/man8/fbard.8", "share/bash-completion/completions/fbar",
          "share/zsh/site-functions/_fbar", "lib/systemd/system/fbard.service", "lib/pkgconfig/libmpm.pc",
          "lib/libmpm.a", "include/libmpm/mpm.h", "share/fbard/scenes/dam-break.json",
          "share/fbard/scenes/reference/cook_base_log_particles_h1.csv"]

pytestmark = pytest.mark.skipif(not os.access(conftest.FBARD, os.X_OK) or "release" not in os.path.realpath(
    conftest.FBARD) and "FBARD" in os.environ, reason="only the release build is installed")


def make(*words):
    environment = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MFLAGS", "DESTDIR", "PREFIX")}
    done = subprocess.run(["make", "-s", *words], cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """An empty root into which PREFIX=/usr was installed."""
    folder = tmp_path_factory.mktemp("root")
    make("install", "PREFIX=/usr", f"DESTDIR={folder}")
    return folder


def run(*words, **options):
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=conftest.PATIENCE,
                          **{"env": BARE, **options})


def test_install_puts_everything_below_destdir(root):
    for name in PROGRAMS:
        assert os.access(root / "usr" / name, os.X_OK)
    for name in OTHERS:
        path = root / "usr" / name
        assert path.is_file() and path.stat().st_size > 0 and path.stat().st_mode & 0o777 == 0o644, name
        if path.stat().st_size < 200_000 and path.suffix != ".a":
            assert str(root) not in path.read_text(), f"{name} names DESTDIR"
    assert [p.name for p in root.iterdir()] == ["usr"]
    scenes = {p.name for p in (ROOT / "scenes").glob("*.json")}
    assert {p.name for p in (root / "usr/share/fbard/scenes").glob("*.json")} == scenes


def test_installed_programs_work_without_an_environment(root, tmp_path):
    for name in ("fbard", "fbar"):
        shown = run(root / "usr/bin" / name, "--version", env={})
        assert shown.returncode == 0 and shown.stdout.startswith(name + " ")
    # A private daemon is the installed one beside it; an installed scene is a file like any other.
    done = run(root / "usr/bin/fbar", "run", root / "usr/share/fbard/scenes/rotating-disk.json", "--set", "time.end=0.01",
               "-o", "a.h5", cwd=tmp_path, env={})  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "a.xdmf"]


def test_manual_pages_follow_the_tables(root):
    client = (root / "usr/share/man/man1/fbar.1").read_text()
    daemon = (root / "usr/share/man/man8/fbard.8").read_text()
    shown = run(root / "usr/bin/fbar", "help").stdout
    commands = re.findall(r"^  ([a-z]+) ", shown.split("examples")[0], re.M)
    assert len(commands) >= 20
    for command in commands:
        assert re.search(rf'^\.SS "{command}[ "]', client, re.M), command
        for option in re.findall(r"--([a-z-]+)", run(root / "usr/bin/fbar", "help", command).stdout):
            assert "\\-\\-" + option.replace("-", "\\-") in client, (command, option)
    options = re.findall(r"^  --([a-z-]+)", run(root / "usr/bin/fbard", "--help").stdout, re.M)
    assert len(options) > 12
    for option in options:
        assert "\\-\\-" + option.replace("-", "\\-") in daemon, option
    for page in (client, daemon):
        assert all(f".SH {section}" in page for section in ("NAME", "SYNOPSIS", "DESCRIPTION", "OPTIONS", "EXIT STATUS"))


@pytest.mark.skipif(not LONG and not shutil.which("groff"), reason="groff is not installed")
def test_manual_pages_are_set_without_warnings(root):
    for page in (root / "usr/share/man").rglob("*.[18]"):
        done = run("groff", "-man", "-Tutf8", "-ww", "-rHY=0", page)
        assert done.returncode == 0 and not done.stderr and len(done.stdout) > 1000, done.stderr


def test_the_library_compiles_links_and_runs(root, tmp_path):
    """The program of docs/libmpm.md, through pkg-config, as C and with the header alone."""
    text = (ROOT / "docs/libmpm.md").read_text()
    (tmp_path / "fall.c").write_text(re.search(r"```c\n(.*?)```", text, re.S)[1])
    line = re.search(r"```sh\n(cc .*)\n```", text)[1]
    environment = {**BARE, "PKG_CONFIG_SYSROOT_DIR": str(root), "PKG_CONFIG_LIBDIR": str(root / "usr/lib/pkgconfig")}
    done = run("sh", "-c", line.replace("cc ", "cc -Wall -Wextra -Werror ", 1), cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    done = run(tmp_path / "fall")
    assert done.returncode == 0, done.stderr
    speed = float(re.search(r"v_y = (-[\d.]+) m/s", done.stdout)[1])
    # Free fall is exact in every explicit step: -9.81 x 0.3, printed with four decimals.
    assert abs(speed + 9.81 * 0.3) <= 0.5e-4 + 1e-12
    assert f"v_y = {speed:.4f} m/s" in text


def test_the_unit_starts_what_is_installed(root):
    unit = (root / "usr/lib/systemd/system/fbard.service").read_text()
    settings = dict(line.split("=", 1) for line in unit.splitlines() if "=" in line and line[0] != "#")
    program = settings["ExecStart"].split()[0]
    assert program == "/usr/bin/fbard" and os.access(str(root) + program, os.X_OK)
    assert settings["Type"] == "notify" and settings["StateDirectory"] == "fbard"
    assert "%S/fbard" in settings["ExecStart"]
    for word in settings["ExecStart"].split()[1:]:
        if word.startswith("--"):
            assert f"  {word} " in run(str(root) + program, "--help").stdout


def test_uninstall_leaves_nothing(tmp_path):
    make("install", "PREFIX=/opt/fbard", f"DESTDIR={tmp_path}")
    (tmp_path / "opt/fbard/bin/other").touch()
    make("uninstall", "PREFIX=/opt/fbard", f"DESTDIR={tmp_path}")
    assert [p.name for p in tmp_path.rglob("*") if not p.is_dir()] == ["other"]


# ---- In a root with nothing else in it (long) -----------------------------------------------------------

@pytest.mark.long
def test_everything_works_in_an_empty_root(root, tmp_path):
    """chroot into the installation and the shared libraries that it names, and nothing more."""
    new = tmp_path / "root"
    shutil.copytree(root, new)
    for name in PROGRAMS:
        listed = run("ldd", root / "usr" / name).stdout
        for library in re.findall(r"(/\S+) \(0x", listed):
            target = new / library.lstrip("/")
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.exists():
                shutil.copy(library, target)
    for folder in ("tmp", "dev", "proc"):
        (new / folder).mkdir()
    chroot = shutil.which("chroot", path="/usr/sbin:/sbin:/usr/bin:/bin")
    enter = [*([] if os.getuid() == 0 else [shutil.which("unshare"), "-r"]), chroot, str(new)]
    done = run(*enter, "/usr/bin/fbard", "--help", env={})
    assert done.returncode == 0, done.stderr
    command = [*enter, "/usr/bin/fbard", "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--data-dir", "/state",
               "--port-file", "/ports.json"]  # fmt: skip
    daemon = subprocess.Popen(command, env={}, stderr=open(tmp_path / "log", "w"))
    try:
        end = time.monotonic() + 20
        while not (new / "ports.json").exists():
            assert daemon.poll() is None and time.monotonic() < end, (tmp_path / "log").read_text()
            time.sleep(0.02)
        url = json.loads((new / "ports.json").read_text())["http"]
        done = run(*enter, "/usr/bin/fbar", "--url", url, "run", "/usr/share/fbard/scenes/rotating-disk.json", "--set",
                   "time.end=0.01", "-o", "/tmp/a.h5", env={})  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert (new / "tmp/a.h5").read_bytes()[:4] == b"\x89HDF"
    finally:
        daemon.terminate()
        assert daemon.wait(conftest.PATIENCE) == 0


@pytest.mark.long
def test_systemd_accepts_the_unit(tmp_path):
    assert shutil.which("systemd-analyze"), "systemd-analyze is not installed: make deps-long"
    make("install", f"PREFIX={tmp_path}/usr")
    unit = tmp_path / "usr/lib/systemd/system/fbard.service"
    done = run("systemd-analyze", "verify", "--man=no", unit)
    assert done.returncode == 0 and not done.stderr.strip(), done.stderr
    done = run("systemd-analyze", "security", "--offline=yes", "--threshold=20", unit)  # 2.0 of 10
    assert done.returncode == 0, done.stdout[-300:]


@pytest.mark.long
@pytest.mark.skipif(os.getuid() != 0, reason="a systemd of its own needs root")
def test_a_real_systemd_starts_stops_and_restarts_it(root, tmp_path):
    """The unit as installed, all of its hardening on: ready, stopped and started again, killed and restarted, and each
    time the run goes on from where it was."""
    unit = root / "usr/lib/systemd/system/fbard.service"
    done = subprocess.run([ROOT / "tests/cli/systemd.sh", tmp_path, root / "usr", unit], capture_output=True, text=True)
    assert (tmp_path / "log").exists(), done.stderr + (tmp_path / "console").read_text()[-2000:]
    log = (tmp_path / "log").read_text()
    told = dict(line.split(": ", 1) for line in log.splitlines())
    why = log + (tmp_path / "session.err").read_text()
    assert told["start"] == "0" and told["start.again"] == "0", why  # Type=notify: it has said that it is ready
    assert int(told["user"]) > 0, "not as root"
    assert told["stop"] == "0" and told["stop.result"] == "success 0", why
    assert told["restarts"] == "1", why
    runs = [json.loads((tmp_path / f"{name}.json").read_text()) for name in ("first", "second", "third")]
    assert [told[name] for name in ("first", "second", "third")] == ["active"] * 3, why
    assert [r["state"] for r in runs] == ["running"] * 3
    assert 0 < runs[0]["step"] < runs[1]["step"], "it goes on from its checkpoint"
    assert runs[2]["step"] > runs[0]["step"] and len({r["epoch"] for r in runs}) == 1, "after kill -9, too"
