"""Numbers in docs that come from the report: from the data that docs keep of it (bench/advice.py)."""
import re
import subprocess
import sys

import pytest

from conftest import ROOT

sys.path.insert(0, str(ROOT / "bench"))
import advice  # noqa: E402
import hard  # noqa: E402
import measured  # noqa: E402
import study  # noqa: E402

DATA = ROOT / "docs" / "report" / "small"


def marked():
    return {name: (ROOT / name).read_text(encoding="utf-8") for name in advice.DOCS}


def test_docs_numbers_are_those_of_the_data():
    done = subprocess.run(["/usr/bin/python3", ROOT / "bench" / "advice.py", "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_docs_numbers_that_differ_are_named(tmp_path):
    """The check can fail: with an error of the data changed, the numbers that hang on it are told."""
    for path in DATA.glob("*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    rows = measured.read(DATA / "accuracy.csv")
    next(r for r in rows if r["name"] == "cook-bspline2-standard-0.3-4-1-2" and r["measure"] == "pressure")["error"] = "0.5"
    study.write_csv(tmp_path / "accuracy.csv", rows)
    done = subprocess.run(["/usr/bin/python3", ROOT / "bench" / "advice.py", "--check", "--data", tmp_path], capture_output=True, text=True)
    assert done.returncode == 1 and "docs/choosing.md: hidden-pressure: " in done.stderr and "'50.0'" in done.stderr


def test_docs_numbers_are_all_of_them():
    used = {m[1] for text in marked().values() for m in advice.MARK.finditer(text)}
    assert used == {*advice.NUMBERS, *advice.TABLES}
    # What is measured has a decimal point or is a percentage: in the page of advice none stands outside the marks, but
    # for settings, which are code.
    bare = advice.MARK.sub("", marked()["docs/choosing.md"])
    bare = re.sub(r"```.*?```|`[^`\n]*`|\]\([^)]*\)", "", bare, flags=re.DOTALL)
    assert re.findall(r"\d+\.\d+|\d+ ?%", bare) == []


def test_docs_marks_stand_where_markdown_goes_on():
    """A line that begins with a comment is HTML to its end: only marks of tables may, alone on their lines."""
    for name, text in marked().items():
        for m in advice.MARK.finditer(text):
            begins = text[: m.start()].rsplit("\n", 1)[-1].strip() == ""
            assert begins == (m[1] in advice.TABLES), (name, m[1])


@pytest.mark.parametrize("case", hard.CASES, ids=lambda c: f"{c.name}-{c.scene}".replace(" ", "-"))
def test_docs_reasons_have_their_numbers(case):
    rows = measured.read(DATA / "hard-cases.csv")
    bad = [r for r in rows if r["case"] == case.name and r["verdict"] != "passes"]
    text = hard.told(case, rows, measured.read(DATA / "tearing.csv"))
    assert "{" not in text and (text or not bad)
