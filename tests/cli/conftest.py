import fcntl
import os
import pathlib
import pty
import select
import struct
import subprocess
import sys
import termios
import threading
import time

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from fake import Fake  # noqa: E402

# For anything that must come: a busy machine is allowed for, and nothing is measured by it.
PATIENCE = 120.0
FBAR = os.environ.get("FBAR", str(ROOT / "build" / "fbar"))
FBARD = os.environ.get("FBARD", str(ROOT / "build" / "fbard"))


# Memory spares the suite some hundred waits for the disk; what fsync promises cannot be tested here.
if os.access("/dev/shm", os.W_OK):
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", "/dev/shm")


def pytest_configure(config):
    config.addinivalue_line("markers", "long: belongs to `make check-long`; run with FBARD_LONG=1")


def pytest_collection_modifyitems(config, items):
    if os.environ.get("FBARD_LONG"):
        return
    for item in items:
        if "long" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="long: needs FBARD_LONG=1"))


@pytest.fixture
def fbar(tmp_path):
    """Runs fbar to its end: fbar("list", url=...) gives the CompletedProcess."""
    def call(*words, url=None, timeout=PATIENCE, **options):
        return subprocess.run(command(*words, url=url), capture_output=True, text=True,
                              timeout=timeout, cwd=tmp_path, env=environment(), **options)
    return call


@pytest.fixture
def start_fbar(tmp_path):
    """Starts fbar and leaves it running; what still runs at the end is killed."""
    started = []

    def start(*words, url=None, **options):
        process = subprocess.Popen(command(*words, url=url), stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE, text=True, cwd=tmp_path,
                                   env=environment(), **options)
        started.append(process)
        return process
    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def wait_until(condition, seconds=PATIENCE):
    """Where all stood still between two looks, only a second of it counts."""
    left, now = seconds, time.monotonic()
    while not condition():
        assert left > 0, f"not within {seconds} s: {condition}"
        time.sleep(0.005)
        before, now = now, time.monotonic()
        left -= min(now - before, 1.0)


def wait_until_said(process, text):
    """Reads what a process says, until a line has `text`; such lines are not among those that communicate() gives."""
    timer = threading.Timer(PATIENCE, process.kill)
    timer.start()
    try:
        assert any(text in line for line in process.stderr), f"it ended without {text!r}"
    finally:
        timer.cancel()


def on_a_terminal(*words, columns=80, **more):
    """What fbar writes to a terminal, standard output and error together."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    process = subprocess.Popen([FBAR, *map(str, words)], stdout=follower, stderr=follower, stdin=follower,
                               env={**environment(), "TERM": "xterm", "LC_ALL": "C.UTF-8", **more})  # fmt: skip
    os.close(follower)
    text, end = b"", time.monotonic() + PATIENCE
    while time.monotonic() < end:
        try:
            if select.select([leader], [], [], 0.1)[0]:
                text += os.read(leader, 65536)
        except OSError:  # the other end is closed
            break
    os.close(leader)
    process.wait(PATIENCE)
    return text.decode()


def command(*words, url=None):
    return [FBAR] + (["--url", url] if url else []) + [str(w) for w in words]


def environment():
    return {k: v for k, v in os.environ.items() if k != "FBAR_URL"}


@pytest.fixture
def fake():
    made = []

    def make(**options):
        made.append(Fake(**options))
        return made[-1]
    yield make
    for daemon in made:
        daemon.down()
