"""The daemon, the recorder, or both are killed (SIGKILL) at random moments, again and again; the recording
is that of an undisturbed run, byte for byte. FBARD_SEED picks other moments."""
import pytest
from boxes import merged, water
from harness import check_same_recording, disturbed, seeded, undisturbed

# Steps of a fraction of a millisecond: some seconds in all, with a checkpoint every tenth of one.
POOL = water(time={"end": 16, "dt": 2e-4}, output={"interval": 0.02, "probe_interval": 0.004, "checkpoint_interval": 0.1})
SWITCHES = [(700, {"fbar": False}), (2500, {"damping": {"local": 0.05}, "gravity": [0.5, -9.81]}),
            (4000, {"fbar": {"scheme": "anchored", "a": 0.05}}), (6000, {"time": {"dt": 1e-4}})]  # fmt: skip

STAGED = merged(POOL, {
    "stages": [{"name": "settle", "duration": 0.4, "damping": {"local": 0.5}},
               {"name": "flow", "remove": {"walls": ["gate"]}}],
    "walls": {"gate": {"axis": "x", "at": 1, "keeps": "below", "condition": "slip"}},
    "time": {"end": 4}, "output": {"durability": "power"}})  # fmt: skip

METAL = merged(POOL, {
    "materials": {"water": None, "metal": {"model": "hencky_j2", "density": 2000, "youngs_modulus": 2e6,
                                           "poisson_ratio": 0.45, "yield_strength": 5e3}},
    "bodies": {"pool": {"material": "metal"}}, "basis": "bspline2",
    "output": {"fields": ["position", "stress", "plastic_strain"]}, "time": {"end": 4}})  # fmt: skip

SOLID = merged(POOL, {
    "dimension": 3, "domain": {"min": [-0.25, -0.25, -0.25], "max": [1.25, 1.25, 4]}, "gravity": [0, 0, -9.81],
    "materials": {"water": None, "rubber": {"model": "neo_hookean", "density": 1000, "youngs_modulus": 1e5,
                                            "poisson_ratio": 0.49}},
    "bodies": {"pool": {"material": "rubber", "particles_per_cell": 8, "velocity": [0, 0, 0],
                        "shape": {"box": {"min": [0, 0, 0.5], "max": [0.5, 0.5, 1]}}}},
    "walls": {"left": None, "right": None, "floor": {"axis": "z", "at": 0}},
    "probes": {"middle": None, "front": None, "drift": {"kind": "drift"}}, "time": {"end": 8}})  # fmt: skip

SCENES = {"pool": (POOL, SWITCHES), "staged": (STAGED, SWITCHES[:1]), "metal": (METAL, []), "solid": (SOLID, [])}


def survive(place, name, rng, kills, files, longest=0.25):
    scene, plan = SCENES[name]
    wanted, calm = undisturbed(place("calm-" + name), scene, plan)
    worn = place("worn-" + name)
    done, run = disturbed(worn, scene, plan, rng, kills, files, longest)
    assert run["state"] == calm["state"] == "completed" and run["epoch"] == 0, run["warnings"]
    assert [c["patch"] for c in run["changes"]] == [patch for _, patch in plan]
    frames = [check_same_recording(worn.folder / file, wanted) for file in files]
    assert not list(worn.folder.glob("*.log")) and not list(worn.folder.glob("*.tmp"))
    n = sum(done.values())
    print(f"\n{name}: survived {n} kills {done}, {worn.starts} starts of the daemon; "
          f"{sum(frames)} frames recorded, 0 lost")  # fmt: skip
    return n


def test_kills_at_random_moments_leave_the_same_recordings(place):
    """The short version."""
    assert survive(place, "pool", seeded("short"), 20, ["a.h5", "b.h5"]) == 20


@pytest.mark.long
def test_kills_by_the_hundred_leave_the_same_recordings(place):
    rng, n, turn = seeded("long"), 0, 0
    while n < 320:
        for name in SCENES:
            n += survive(lambda p: place(f"{p}-{turn}"), name, rng, 30, ["a.h5", "b.h5"][: 1 + turn % 2],
                         rng.choice([0.1, 0.2, 0.4]))  # fmt: skip
            turn += 1
    print(f"\n{n} kills survived in {turn} runs, 0 frames lost")
