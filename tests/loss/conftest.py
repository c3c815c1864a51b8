"""Fixtures of the tests that nothing is lost. FBARD and FBAR name the programs; FBARD_LONG=1 runs all."""
import os
import pathlib
import sys

import pytest

sys.path[:0] = [str(pathlib.Path(__file__).resolve().parents[1] / folder) for folder in (".", "api")]

# Memory spares the suite some thousand waits for the disk; what fsync promises is tested by its calls.
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
def place(tmp_path):
    """Makes Places; what still runs in them at the end is killed."""
    import harness

    made = []

    def make(name="d", **more):
        made.append(harness.Place(tmp_path / name, **more))
        return made[-1]

    yield make
    for p in made:
        p.clear()
