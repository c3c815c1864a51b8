import os
import pathlib
import subprocess

import pytest

from fake import Fake

ROOT = pathlib.Path(__file__).resolve().parents[2]
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
    def call(*words, url=None, timeout=60, **options):
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
