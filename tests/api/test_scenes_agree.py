"""The JSON Schema and the daemon's own check come from one table: they agree on randomly damaged scenes."""
import random
import re

import jsonschema
import pytest
from boxes import WATER, endless
from test_requests_mutated import RICH, mutated

# Faults of the form of one value, which the schema states as well; the others (range of a time increment,
# names that lead nowhere, walls off the grid, ...) look at several values or at the whole.
FORM = {"type", "unknown_key", "required", "enum"}
PATCHED = re.compile(r"/stages/\d+/materials/[^/]+/")


def agree(daemon, seeds):
    schema = jsonschema.Draft202012Validator(daemon.get("/v1/schemas/scene.json"))
    counts = {"valid": 0, "of its form": 0, "only beyond": 0}
    for seed in seeds:
        random_ = random.Random(seed)
        scene = mutated(random_, random_.choice([WATER, RICH, endless()]))
        if "scene" in scene:
            continue  # reads as {scene, overrides}
        fits = schema.is_valid(scene)
        reply = daemon.request("POST", "/v1/scenes:validate", scene)
        if reply.status == 200:
            assert fits, (seed, next(schema.iter_errors(scene)).message)
            counts["valid"] += 1
            continue
        assert reply.status == 422, (seed, reply)
        # What is required only because of another key's value is beyond the form, and so is which parameters a
        # stage may change of a material: its model stands elsewhere.
        faults = [e for e in reply.json["errors"]
                  if e["code"] in FORM and (e["code"] != "required" or "is missing:" in e["detail"])
                  and not (e["code"] == "unknown_key" and PATCHED.search(e["pointer"]))]  # fmt: skip
        assert not (fits and faults), (seed, faults)
        counts["of its form" if faults else "only beyond"] += 1
    return counts


def test_schema_and_validation_agree(daemon):
    counts = agree(daemon, range(300))
    assert counts["valid"] >= 20 and counts["of its form"] > 100, counts


@pytest.mark.long
def test_schema_and_validation_agree_on_very_many(daemon):
    counts = agree(daemon, range(10_000, 16_000))
    print(counts)
    assert sum(counts.values()) >= 5_000, counts
