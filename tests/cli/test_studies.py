"""What bench's studies keep (bench/study.py): points are run once for one program, also when a run was killed."""
import json
import os
import sys

import pytest

from conftest import ROOT

sys.path.insert(0, str(ROOT / "bench"))
import study  # noqa: E402

POINTS = [study.Point("axial-bar", {"cell": cell}) for cell in (1, 2, 3)]


@pytest.fixture
def runner(tmp_path, monkeypatch):
    """A program in the runner's place that writes down what it is asked for; gives (make it anew, what it was asked)."""
    program, asked = tmp_path / "runner", tmp_path / "asked"

    def make(mark):
        program.write_text(f'#!/bin/sh\n# {mark}\necho "$3" >> {asked}\necho \'{{"outcome": "completed", "series": []}}\'\n')
        program.chmod(0o755)

    monkeypatch.setattr(study, "RUNNER", program)
    make("first")
    return make, lambda: [json.loads(line)["cell"] for line in asked.read_text().splitlines()]


def run_all(tmp_path):
    return study.Store(tmp_path / "points.jsonl").all(POINTS, jobs=1)


def test_studies_run_a_point_once(runner, tmp_path):
    _, asked = runner
    assert [r["outcome"] for r in run_all(tmp_path)] == ["completed"] * 3
    os.utime(study.RUNNER)  # built anew, the same: newer than what is kept
    run_all(tmp_path)
    assert sorted(asked()) == [1, 2, 3]


def test_studies_go_on_behind_a_cut_line(runner, tmp_path):
    _, asked = runner
    run_all(tmp_path)
    file = tmp_path / "points.jsonl"
    file.write_text(file.read_text()[:-20])  # as a kill leaves it
    run_all(tmp_path)
    assert sorted(asked())[:3] == [1, 2, 3] and len(asked()) == 4
    run_all(tmp_path)  # and what was run behind it is read again
    assert len(asked()) == 4


def test_studies_begin_anew_with_another_program(runner, tmp_path):
    make, asked = runner
    run_all(tmp_path)
    make("second")
    run_all(tmp_path)
    assert sorted(asked()) == [1, 1, 2, 2, 3, 3]
