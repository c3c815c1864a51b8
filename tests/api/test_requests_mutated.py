"""Valid requests with random damage: each answer is one of the declared, and the daemon lives on.

Deterministic: a failure names the seed, which makes the same request again."""
import copy
import json
import random

import jsonschema
import pytest
from boxes import WATER, endless, water

VALUES = [None, True, False, 0, 1, -1, 0.5, -0.0, 1e-300, 1e300, -1e300, 5e-324, 2**31, 2**53, 2**63, 2**64, 1e20, "",
          "x", "end", "zhao", "a" * 70, "../..", "\u0001", "é\U0001f600", [], {}, [[]], [0, 0], [0, 0, 0], [1e300, -1e300],
          {"": 0}, {"x": None}, "water", "pool", 3, 16, 25, 1e6, 1e9, 0.1, 1e-3, "position", ["position"] * 3]  # fmt: skip
RICH = water(
    references=[{"probe": "front", "at": "end", "value": 1, "tolerance": 0.1, "source": ""}],
    stages=[{"name": "settle", "duration": 0.02, "ramp": 0.01, "damping": {"local": 0.5}},
            {"name": "calm", "until": {"kinetic_energy_ratio": 0.5, "duration": 0.02}, "fbar": False},
            {"name": "flow", "remove": {"walls": ["right"]}, "materials": {"water": {"viscosity": 0.1}},
             "reset": ["velocity"], "gravity": {"vector": [0, -9], "ramp": 0.01}}],
    bodies={"ball": {"material": "water", "shape": {"difference": [
        {"disk": {"center": [1.5, 0.5], "radius": 0.4}}, {"box": {"min": [1.4, 0.4], "max": [1.6, 0.6]}}]},
        "velocity": {"rotation": {"center": [1.5, 0.5], "rate": 1}}}},
)  # fmt: skip


def places(node, path=()):
    """Paths of all values inside."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield path + (key,)
        if isinstance(value, (dict, list)):
            yield from places(value, path + (key,))


def mutated(random_, scene):
    scene = copy.deepcopy(scene)
    for _ in range(random_.choice([1, 1, 1, 2, 4])):
        *way, last = random_.choice(list(places(scene)))
        node = scene
        for key in way:
            node = node[key]
        what = random_.randrange(6)
        if what == 0:
            del node[last]
        elif what == 1 and isinstance(node, dict):
            node[random_.choice(["x", "", "min", "model", "/", "~", "a/b~c", last + "s"])] = node[last]
        elif what == 2 and isinstance(node[last], (int, float)) and not isinstance(node[last], bool):
            node[last] = max(-1e308, min(1e308, node[last] * random_.choice([-1, 0.5, 2, 10, 1e3, 1e-3, 1e9])))
        elif what == 3 and isinstance(node[last], list):
            node[last] = node[last] * random_.choice([0, 2, 3])
        else:
            node[last] = copy.deepcopy(random_.choice(VALUES))
        if not scene:
            break
    return scene


def damaged(random_, text):
    """The same for bytes."""
    text = bytearray(text)
    for _ in range(random_.choice([1, 1, 2, 5])):
        at = random_.randrange(len(text) + 1)
        what = random_.randrange(4)
        if what == 0:
            del text[at : at + random_.randrange(1, 20)]
        elif what == 1:
            text[at:at] = random_.choice([b"\0", b"\xff", b"{", b"}", b"[", b"]", b'"', b"\\", b",", b":", b"1e999", b"-"])
        elif what == 2 and at < len(text):
            text[at] = random_.randrange(256)
        else:
            text[at:at] = text[: random_.randrange(50)]
    return bytes(text)


def scenes(daemon, seeds):
    tried = 0
    for seed in seeds:
        random_ = random.Random(seed)
        scene = mutated(random_, random_.choice([WATER, RICH, endless()]))
        reply = daemon.request("POST", "/v1/scenes:validate", scene)
        assert reply.status in (200, 422), (seed, reply)
        if reply.status == 200:
            cost = reply.json["estimate"]
            tried += 1
            if cost["particles"] > 20_000 or cost["nodes"] > 1_000_000:
                continue
            # What is called valid can be run: two steps, or an honest failure.
            run = daemon.create(scene, start=False)["id"]
            assert daemon.run(run)["particles"] == cost["particles"], seed
            daemon.request("POST", f"/v1/runs/{run}:step", {"steps": 2})
            state = daemon.wait(run, "paused", "completed", "failed")["state"]
            assert state != "failed" or daemon.run(run)["error"]["kind"], seed
            daemon.away(run)
        else:
            assert reply.json["errors"], seed
    assert tried > 0


def texts(daemon, seeds):
    body = json.dumps({"scene": WATER, "start": False}).encode()
    for seed in seeds:
        text = damaged(random.Random(seed), body)
        reply = daemon.request("POST", "/v1/runs", text, {"Content-Type": "application/json"})
        assert reply.status in (201, 400, 422), (seed, reply)
        if reply.status == 201:
            daemon.away(reply.json["id"])


WHOLE_PATCH = {
    "fbar": {"scheme": "anchored", "a": 0.05, "C": 1}, "damping": {"local": 0.1, "mass": 0.1}, "transfer": {"blend": 0.9},
    "time": {"dt": 1e-3, "end": 1e6}, "gravity": [0, -0.001],
    "output": {"interval": 1e5, "fields": ["position"], "probe_interval": 1e5},
}  # fmt: skip


def of_a_patch(daemon):
    """What the document says of a patch: a function that tells whether one is of its form."""
    document = daemon.get("/openapi.json")
    body = document["paths"]["/v1/runs/{id}/config"]["patch"]["requestBody"]
    schema = body["content"]["application/merge-patch+json"]["schema"]
    return jsonschema.Draft202012Validator({**schema, "components": document["components"]}).is_valid


def test_nulls_in_a_patch_delete_known_keys_and_no_others(daemon):
    """At every depth: what the document does not allow is a 422 at its place, and nothing is changed."""
    run = daemon.create(endless(), start=False)["id"]
    fits = of_a_patch(daemon)
    inside = [()] + [way for way in places(WHOLE_PATCH) if isinstance(whole_at(way), dict)]
    refused = taken = 0
    for way in inside:
        for key in [*whole_at(way), "x", "", "locl", "a/b~c", "format"]:
            for siblings in (True, False):  # beside the other keys, and alone
                patch = copy.deepcopy(WHOLE_PATCH) if siblings else {}
                node = patch
                for step in way:
                    node = node.setdefault(step, {})
                node[key] = None
                before = daemon.get(f"/v1/runs/{run}/config")
                reply = daemon.request("PATCH", f"/v1/runs/{run}/config", patch)
                unknown = key not in whole_at(way)
                assert fits(patch) or reply.status == 422, (patch, reply)
                if unknown:
                    assert not fits(patch), patch
                    pointer = "".join("/" + s.replace("~", "~0").replace("/", "~1") for s in (*way, key))
                    assert reply.status == 422 and reply.fault(pointer)["code"] in ("unknown_key", "immutable"), (patch, reply)
                    assert daemon.get(f"/v1/runs/{run}/config") == before, patch
                    refused += 1
                else:  # 422: what must be there, as time.end and fbar.scheme
                    assert reply.status in (200, 422), (patch, reply)
                    taken += reply.status == 200
    assert refused == 2 * 5 * len(inside) and taken > 10, (refused, taken)
    daemon.away(run)


def whole_at(way):
    node = WHOLE_PATCH
    for key in way:
        node = node[key]
    return node


def patches(daemon, seeds):
    fits = of_a_patch(daemon)
    run = daemon.create(endless(), start=False)["id"]
    for seed in seeds:
        patch = mutated(random.Random(seed), WHOLE_PATCH)
        before = daemon.get(f"/v1/runs/{run}/config")
        reply = daemon.request("PATCH", f"/v1/runs/{run}/config", patch)
        assert reply.status in (200, 422), (seed, patch, reply)
        assert fits(patch) or reply.status == 422, (seed, patch)
        if reply.status == 422:
            assert daemon.get(f"/v1/runs/{run}/config") == before, seed
        assert daemon.run(run)["state"] == "paused", seed
    # Whatever was made of it, it is still a valid scene.
    daemon.ask("POST", "/v1/scenes:validate", daemon.get(f"/v1/runs/{run}/scene"))
    daemon.away(run)


@pytest.mark.parametrize("attack", [scenes, texts, patches])
def test_damage_is_answered(daemon, attack):
    attack(daemon, range(100))


@pytest.mark.long
@pytest.mark.parametrize("attack", [scenes, texts, patches])
def test_much_damage_is_answered(daemon, attack):
    attack(daemon, range(1000, 9000))
