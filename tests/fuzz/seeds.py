#!/usr/bin/env python3
"""Makes tests/fuzz/corpus from valid things: scenes of the tests, the files of a short run.

usage: FBARD=build/release/fbard tests/fuzz/seeds.py   (what is there already is kept)"""
import json
import pathlib
import sys
import tempfile

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "api"))
import fbard  # noqa: E402
from boxes import endless, water  # noqa: E402
from test_requests_mutated import RICH  # noqa: E402

SOLID = {
    "format": "fbard-scene-1", "dimension": 3, "domain": {"min": [-1, -1, -1], "max": [3, 3, 3]}, "cell": 1,
    "basis": "bspline2", "fbar": {"scheme": "anchored", "a": 0.05}, "time": {"end": 0.01, "cfl": 0.2},
    "materials": {"clay": {"model": "hencky_j2", "density": 2000, "youngs_modulus": 1e6, "poisson_ratio": 0.4,
                           "yield_strength": 1e3, "residual_strength": 500, "softening": 0.1}},
    "bodies": {"ball": {"material": "clay", "shape": {"intersection": [
        {"sphere": {"center": [1, 1, 1], "radius": 0.9}}, {"box": {"min": [0, 0, 0], "max": [2, 2, 2]}}]},
        "particles_per_cell": 8, "velocity": [0, 0, -1]}},
    "walls": {"floor": {"axis": "z", "at": 0, "keeps": "above", "condition": "separate"}},
    "loads": {"push": {"body": "ball", "select": {"extreme": "+x"}, "force": [1, 0, 0], "ramp": 0.001}},
    "rigid_bodies": {"foot": {"shape": {"box": {"min": [0, 0, 2.2], "max": [2, 2, 2.5]}}, "velocity": [0, 0, -1],
                              "contact": {"kind": "barrier", "stiffness": 1e6, "distance": 0.2, "friction": 0.3}}},
    "probes": {"r": {"kind": "reaction", "rigid_body": "foot"}, "d": {"kind": "drift"},
               "m": {"kind": "maximum", "field": "von_mises", "body": "ball"}},
}  # fmt: skip
JSON = {
    "numbers": b'[0,-0,1e0,1E+2,-1.5e-300,123456789012345678901234567890,0.1,5e-324,1.7976931348623157e308]',
    "strings": rb'["","\"\\\/\b\f\n\r\t","\u00e9\ud83d\ude00","' + "é😀".encode() + b'"]',
    "nested": b"[" * 60 + b"]" * 60, "too-deep": b"[" * 65 + b"]" * 65, "object": b'{"a":{"b":null,"c":[true,false]}}',
    "twice": b'{"a":1,"a":2}', "zero": b'"\\u0000"', "surrogate": b'"\\ud800"', "leading": b"[01]", "huge": b"[1e999]",
    "tail": b"{} x", "latin": b'"\xe9"', "overlong": b'"\xc0\x80"', "raw": b'"\x01"', "bom": b"\xef\xbb\xbf{}", "empty": b"",
    "escaped-twice": b'{"a":1,"\\u0061":2}', "nan": b"[NaN]", "comma": b"[1,]", "null-patch": b'{"a":null,"b":{"c":null}}',
}  # fmt: skip


def put(kind, name, data):
    path = HERE / "corpus" / kind / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_bytes(data)


def main():
    for name, text in JSON.items():
        put("json", name, text)
    patch = {"fbar": False, "damping": {"local": 0.1}, "time": {"end": 1, "dt": None, "cfl": 0.1},
             "output": {"interval": 0.1}, "transfer": {"blend": 0.5}, "gravity": [0, 0]}  # fmt: skip
    scenes = {"water": {"scene": water(), "patch": patch}, "endless": endless(), "rich": {"scene": RICH, "patch": patch},
              "solid": SOLID, "builtin": {"scene": "dam-break", "overrides": {"cell": 1, "time": {"dt": 1e-6}}},
              "cook": {"scene": "cook-membrane"}, "slice": {"scene": "landslide-slice"}, "nothing": {}}  # fmt: skip
    for name, scene in scenes.items():
        put("scene", name, json.dumps(scene, separators=(",", ":")).encode())
        put("json", name, json.dumps(scene, separators=(",", ":")).encode()[:2000])
    tiny = water(time={"end": 0.002}, output={"interval": 0.001}, bodies={"pool": {"particles_per_cell": 4, "shape": {
        "box": {"min": [0, 0], "max": [0.5, 0.25]}}}})  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        d = fbard.Daemon(folder)
        d.start()
        d.create(tiny, id="r", start=False)
        d.patch("r", {"fbar": False})
        d.ask("PUT", "/v1/runs/r/recorders/me", {"acked": -1})
        d.act("r", "start")
        d.wait("r", "completed")
        put("frame", "last", d.frame("r", "latest"))
        put("frame", "first", d.frame("r", 0))
        put("frame", "cut", d.frame("r", 0)[:700])
        d.stop()
        run = pathlib.Path(folder) / "data" / "runs" / "r"
        for k, name in enumerate(["events.jsonl", "frames-*.seg", "checkpoint.bin", "recorders.json", "probes.log",
                                  "run.json"]):  # fmt: skip
            (path,) = run.glob(name)
            text = path.read_bytes()
            for flag in (0, 0x80):
                put("journal", f"{path.name}{'-mended' if flag else ''}", bytes([k | flag]) + text)
            put("journal", f"{path.name}-cut", bytes([k]) + text[: 2 * len(text) // 3])


main()
