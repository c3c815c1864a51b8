"""The time that is said to be left, against what it then took. Long: it needs a machine that is quiet."""
import time

import pytest
from fbard import FINAL, until


@pytest.mark.long
def test_eta_of_the_dam_break_is_good_from_a_tenth_on(daemon, name):
    daemon.create("dam-break", id=name, overrides={"time": {"end": 0.5}})
    seen = []

    def over():
        now = daemon.run(name)
        if now["progress"] >= 0.1 and now["eta_s"] is not None:
            seen.append((time.monotonic(), now["progress"], now["eta_s"]))
        return now["state"] in FINAL

    until(over, seconds=600, every=0.2)
    end = time.monotonic()
    assert len(seen) > 10
    took = end - seen[0][0]
    worst = max(abs(eta - (end - t)) / took for t, _, eta in seen)
    print(f"{len(seen)} looks over {took:.0f} s, error {100 * worst:.1f} % of what was left at a tenth")
    assert worst < 0.2
    daemon.away(name)
