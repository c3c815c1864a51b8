"""Fixtures of the API tests. FBARD names the program (default: build/fbard); FBARD_LONG=1 runs all."""
import os
import uuid

import pytest

import fbard


def pytest_collection_modifyitems(config, items):
    if not os.environ.get("FBARD_LONG"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(reason="long: needs FBARD_LONG=1"))
    # What checks the answers of the whole session comes last.
    items.sort(key=lambda item: item.path.name == "test_openapi_document.py")


@pytest.fixture(scope="module")
def daemon(tmp_path_factory):
    d = fbard.Daemon(tmp_path_factory.mktemp("fbard"))
    d.start()
    yield d
    d.stop()


@pytest.fixture
def fresh(tmp_path):
    """Makes daemons that a test starts, kills and starts again; what is left of them is stopped."""
    made = []

    def make(*options, name=None, **more):
        made.append(fbard.Daemon(tmp_path / (name or f"d{len(made)}"), *options, **more))
        return made[-1]

    yield make
    for d in made:
        d.stop()


@pytest.fixture
def name():
    """An id that no other run has."""
    return "r" + uuid.uuid4().hex[:12]
