"""The argument in proto/README.md names the test that each step would break: they exist."""
import re

from fbard import ROOT


def test_tests_that_the_protocol_names_exist():
    named = set(re.findall(r"`(test_[a-z0-9_]+)`", (ROOT / "proto" / "README.md").read_text()))
    there = set()
    for path in (ROOT / "tests").rglob("*.[cp]*"):
        if path.suffix in (".c", ".py"):
            there |= set(re.findall(r"\b(test_[a-z0-9_]+)\(", path.read_text()))
    assert len(named) > 25
    assert sorted(named - there) == []
