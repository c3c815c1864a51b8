"""fbar plot: curves of probes, differences particle by particle, films of several recordings."""
import json
import shutil
import struct

import h5py
import numpy as np
import pytest


def size_of(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 3000
    return struct.unpack(">II", data[16:24])


@pytest.fixture
def recording(fbar, fake):
    daemon = fake(n_frames=6, count=100)
    daemon.advance(6, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    return daemon


def test_curves_are_those_of_the_file(fbar, recording, tmp_path):
    with h5py.File(tmp_path / "a.h5") as f:
        probes = {name: (p["value"][:], p["value"].attrs["unit"].decode()) for name, p in f["fbard/probes"].items()}
    assert probes
    result = fbar("--json", "plot", "a.h5", "--probe", "all", "-o", "c.png")
    assert result.returncode == 0, result.stderr
    curves = json.loads(result.stdout)["curves"]
    assert {c["probe"] for c in curves} == set(probes)
    for c in curves:
        value, unit = probes[c["probe"]]
        column = value if value.ndim == 1 else value[:, [x["component"] for x in curves if x["probe"] == c["probe"]]
                                                     .index(c["component"])]  # fmt: skip
        finite = column[np.isfinite(column)]
        assert c["samples"] == len(column) and c["unit"] == unit
        assert c["last"] == (finite[-1] if len(finite) else None)
    assert size_of(tmp_path / "c.png")[0] == 1600
    one = "front"
    result = fbar("plot", "a.h5", "a.h5", "-p", one, "-o", "d.png", "--size", "700x500", "--axes", "0:1,-1:1")
    assert result.returncode == 0 and size_of(tmp_path / "d.png") == (700, 500)


def test_curves_say_what_is_wrong(fbar, recording, tmp_path):
    name = "front"
    result = fbar("plot", "a.h5", "-p", "frnt", "-o", "c.png")
    assert result.returncode == 2 and f"did you mean {name}" in result.stderr
    for words in (["-f", "velocity"], ["-t", "0.1"], ["--series", "film"]):
        result = fbar("plot", "a.h5", "-p", name, *(["-o", "c.png"] if words[0] != "--series" else []), *words)
        assert result.returncode == 2 and words[0].strip("-")[0] in result.stderr
    assert fbar("plot", "missing.h5", "-p", name, "-o", "c.png").returncode == 4
    result = fbar("plot", "a.h5", "-p", name, "-o", "none/c.png")
    assert result.returncode == 4 and "none/c.png" in result.stderr
    assert not list(tmp_path.glob("*.png*"))


def shuffled(source, to, change):
    """A copy whose particles stand in another order in every frame; `change` maps mean_stress."""
    shutil.copy(source, to)
    rng = np.random.default_rng(3)
    with h5py.File(to, "r+") as f:
        frames, data = f["fbard/frames"], f["VTKHDF/PointData"]
        for row, count in zip(frames["row"][:], frames["count"][:]):
            order = rng.permutation(count)
            for array in (f["VTKHDF/Points"], *data.values()):
                array[row:row + count] = array[row:row + count][order]
            data["mean_stress"][row:row + count] = change(data["mean_stress"][row:row + count])


def frame(path, name, i):
    with h5py.File(path) as f:
        row, count = f["fbard/frames/row"][i], f["fbard/frames/count"][i]
        return f["VTKHDF/PointData/" + name][row:row + count]


def robust(values):
    """The range of the colours: from the 1 % to the 99 % quantile, about 0 where it has both signs."""
    v = np.sort(values)
    low, high = v[int(0.01 * (len(v) - 1))], v[int(np.ceil(0.99 * (len(v) - 1)))]
    if low < 0 < high:
        high = max(-low, high)
        low = -high
    return low, high


def test_difference_goes_particle_by_particle(fbar, recording, tmp_path):
    shuffled(tmp_path / "a.h5", tmp_path / "b.h5", lambda p: 3 * p + 7)
    result = fbar("--json", "plot", "a.h5", "b.h5", "--difference", "-t", "0.02", "-o", "d.png")
    assert result.returncode == 0, result.stderr
    answer, p = json.loads(result.stdout), frame(tmp_path / "a.h5", "mean_stress", 2)
    # Only with each particle less itself is this 2 p + 7, to the round-off of the subtraction.
    np.testing.assert_allclose([answer["low"], answer["high"]], robust(2 * p + 7), rtol=1e-12)
    size_of(tmp_path / "d.png")
    # The other way round, the sign changes.
    answer = json.loads(fbar("--json", "plot", "b.h5", "a.h5", "-d", "-t", "0.02", "-o", "d.png").stdout)
    np.testing.assert_allclose([answer["low"], answer["high"]], robust(-2 * p - 7), rtol=1e-12)


def test_difference_of_two_times_and_of_vectors(fbar, recording, tmp_path):
    answer = json.loads(fbar("--json", "plot", "a.h5", "-d", "-t", "0.01,0.03", "-o", "d.png").stdout)
    change = frame(tmp_path / "a.h5", "mean_stress", 3) - frame(tmp_path / "a.h5", "mean_stress", 1)
    np.testing.assert_allclose([answer["low"], answer["high"]], robust(change), rtol=1e-12)
    assert answer["time"] == 0.03
    answer = json.loads(fbar("--json", "plot", "a.h5", "-d", "-t", "0.01,0.03", "-f", "velocity", "-o", "d.png").stdout)
    change = frame(tmp_path / "a.h5", "velocity", 3) - frame(tmp_path / "a.h5", "velocity", 1)
    # The magnitude of the difference, not the difference of the magnitudes.
    np.testing.assert_allclose([answer["low"], answer["high"]], robust(np.linalg.norm(change, axis=1)), rtol=1e-12)


def test_difference_of_other_particles_is_refused(fbar, fake, recording, tmp_path):
    daemon = fake(n_frames=2, count=40)
    daemon.advance(2, live=False)
    assert fbar("record", "r1", "-o", "b.h5", url=daemon.url).returncode == 0
    result = fbar("plot", "a.h5", "b.h5", "-d", "-o", "d.png")
    assert result.returncode == 2 and "a.h5 has 100 particles and b.h5 40" in result.stderr
    for words in (["a.h5"], ["a.h5", "-t", "0,0.01,0.02"], ["a.h5", "a.h5", "-t", "0,0.01"], ["a.h5"] * 3):
        result = fbar("plot", *words, "-d", "-o", "d.png")
        assert result.returncode == 2 and "--difference" in result.stderr
    assert not (tmp_path / "d.png").exists()


def test_series_of_several_has_a_picture_for_every_frame_of_the_first(fbar, fake, recording, tmp_path):
    daemon = fake(n_frames=3, count=40)
    daemon.advance(3, live=False)
    assert fbar("record", "r1", "-o", "b.h5", url=daemon.url).returncode == 0
    result = fbar("plot", "b.h5", "a.h5", "--series", "film", "--size", "500x300", "-f", "velocity")
    assert result.returncode == 0, result.stderr
    assert "ffmpeg" in result.stdout and "film/velocity-%06d.png" in result.stdout
    pictures = sorted(p.name for p in (tmp_path / "film").iterdir())
    assert pictures == [f"velocity-{i:06d}.png" for i in range(3)]
    assert {size_of(tmp_path / "film" / p) for p in pictures} == {(500, 300)}
    result = fbar("--json", "plot", "a.h5", "b.h5", "-d", "--series", "x", "--size", "400x300")
    assert result.returncode == 2  # other particles
    assert fbar("plot", "a.h5", "--series", "film", "-t", "0").returncode == 2
