"""Runs that come and go leave no memory and no descriptor behind."""
import http.client
import json
import os

import pytest
from boxes import water
from fbard import PATIENCE, is_sanitized, until

CYCLES = 10_000 if os.environ.get("FBARD_LONG") else 150
WARM = CYCLES // 5
GROWTH = 3e6  # bytes: an arena more; a leak of 1 kB in a run would be 8 MB in 8,000


class Line:
    """One connection, kept: sockets that wait to be forgotten would be counted otherwise."""

    def __init__(self, daemon):
        self.connection = http.client.HTTPConnection(daemon.host, timeout=PATIENCE)

    def __call__(self, method, path, body=None, headers=None):
        self.connection.request(method, path, json.dumps(body) if body is not None else None, headers or {})
        answer = self.connection.getresponse()
        return answer.status, answer.read()


def test_creating_and_deleting_runs_leaves_memory_and_descriptors_flat(fresh):
    if is_sanitized():
        pytest.skip("a sanitizer keeps freed memory, and looks for leaks by itself")
    d = fresh()
    d.start()
    ask = Line(d)
    scene = water(time={"end": 0.002}, output={"interval": 0.001})
    before = None
    for k in range(CYCLES):
        if k == WARM:
            before = d.memory(), d.descriptors(), d.n_threads()
        status, body = ask("POST", "/v1/runs", {"scene": scene, "id": "r", "start": k % 2 == 0},
                           {"Content-Type": "application/json", "Idempotency-Key": f"k{k}"})  # fmt: skip
        assert status == 201, body
        if k % 2:
            ask("POST", "/v1/runs/r:cancel")
        until(lambda: json.loads(ask("GET", "/v1/runs/r")[1])["state"] in ("completed", "cancelled"), every=0.0005)
        status, body = ask("DELETE", "/v1/runs/r")
        assert status == 204, body
    grown = d.memory() - before[0]
    assert grown < GROWTH, f"{grown / 1e3:.0f} kB more after {CYCLES - WARM} runs"
    until(lambda: (d.descriptors(), d.n_threads()) == before[1:])
    print(f"{CYCLES} runs: {grown / 1e3:+.0f} kB, descriptors {before[1]}, threads {before[2]}")
