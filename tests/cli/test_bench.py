"""fbar bench: the points of the study of errors are those of bench/accuracy.py, and run the same."""
import json
import os
import pathlib
import subprocess
import sys

import pytest

import conftest

RUNNER = pathlib.Path(conftest.FBARD).resolve().with_name("runner")
STUDY = conftest.ROOT / "bench" / "accuracy.py"


def study(*words):
    return subprocess.run([sys.executable, STUDY, *words], capture_output=True, text=True, check=True,
                          env={**os.environ, "RUNNER": str(RUNNER)}).stdout  # fmt: skip


def test_bench_names_the_points_of_the_study(fbar):
    result = fbar("bench", "accuracy", "--list")
    assert result.returncode == 0 and result.stdout == study("paper", "--list")
    assert json.loads(fbar("--json", "bench", "accuracy", "--list").stdout) == {"cases": result.stdout.splitlines()}


@pytest.mark.parametrize("words, told", [
    (["accuracy"], "--case NAME is missing"), (["speed", "--list"], "unknown study"),
    (["accuracy", "--case", "dam-gimp-zhao-0.3-4-1-0.2"], "did you mean dam-gimp-zhao-0.3-4-1-0.25?")])
def test_bench_says_what_is_missing(fbar, words, told):
    result = fbar("bench", *words)
    assert result.returncode == 2 and told in result.stderr


# One with a value that follows from the cell, one against the scene's own references, one of three errors.
@pytest.mark.skipif(not (os.access(conftest.FBARD, os.X_OK) and RUNNER.exists()), reason="fbard and runner are not built")
@pytest.mark.parametrize("name", ["footing-bspline2-anchored-0.3-9-1-0.25", "cook-gimp-standard-0.3-4-1-8",
                                  "dam-measured-gimp-zhao-0.3-16-1-0.028575", "column-bspline2-anchored-0.5-16-1-0.25"])  # fmt: skip
def test_bench_runs_a_point_as_the_study_does(fbar, name):
    run = json.loads(fbar("--json", "bench", "accuracy", "--case", name).stdout)
    rows = [json.loads(line) for line in study("--case", name).splitlines()]
    assert run["state"] == "completed" and run["particles"] == rows[0]["particles"] and run["step"] == rows[0]["steps"]
    errors = {a["source"]: abs(a["relative_error"]) for a in run["accuracy"]}
    if rows[0]["measure"] == "fronts":  # the daemon has a sample each 1/500 of the end, the study 36
        squares = [e * e for e in (a["relative_error"] for a in run["accuracy"])]
        assert rows[0]["error"] == pytest.approx((sum(squares) / len(squares)) ** 0.5, rel=0.05)
    else:
        assert errors == pytest.approx({r["measure"]: r["error"] for r in rows}, rel=1e-9)
