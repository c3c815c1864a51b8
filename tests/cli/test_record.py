"""fbar record against a daemon that loses, repeats, reorders and damages frames, goes away, and a
recorder that is killed: the file is always that of an undisturbed recording, byte for byte."""
import json
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import threading
import time

import h5py
import numpy as np
import pytest

import conftest
from conftest import PATIENCE, wait_until, wait_until_said
from fake import unpack
from recording import check_frames, padded, read_xdmf


def undisturbed(fbar, fake, tmp_path, **options):
    daemon = fake(**options)
    daemon.advance(len(daemon.frames), live=False)
    path = tmp_path / "undisturbed.h5"
    assert fbar("record", daemon.run, "-o", path, url=daemon.url).returncode == 0
    return path.read_bytes()


def joined(daemon):
    """The recorder has subscribed and looked at the run."""
    wait_until(lambda: ("GET", f"/v1/runs/{daemon.run}/frames") in daemon.requests)


def test_record_live_run_holds_every_value(fbar, fake, start_fbar, tmp_path):
    daemon = fake(n_frames=30)
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    daemon.play().join()
    out, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 0, err
    check_frames(tmp_path / "a.h5", daemon.frames)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "a.xdmf"]
    assert daemon.acks == sorted(daemon.acks) and daemon.acks[-1] == 29
    assert any(m == "DELETE" and "/recorders/" in p for m, p in daemon.requests)
    with h5py.File(tmp_path / "a.h5") as f:
        about = f["fbard"]
        assert about.attrs["run"] == b"r1" and about.attrs["code_version"] == b"0.0-fake"
        assert json.loads(about["scene"][()]) == daemon.scene
        assert list(about["probes"]) == ['a "b", c', "force", "front"]
        assert about['probes/a "b", c/value'][2] == 14
        assert about["probes/front/value"].shape == (30,)
        assert about["probes/front/value"][2] == 4.02 and about["probes/front/time"][2] == 0.02
        assert about["probes/force"].attrs["components"] == b"x,y"
        assert about["probes/force/value"][2].tolist() == [2, -2]
        assert np.isnan(about["probes/force/value"][1, 1])
        front = about["probes/front/value"].attrs
        assert front["unit"] == b"m" and front["long_name"] == b"extent along x, max, body water"
        assert about["probes/force/value"].attrs["unit"] == b"N/m"
        assert about['probes/a "b", c/value'].attrs["unit"] == b"unknown"  # the scene has no such probe
        assert about["changes/step"][0] == 500 and about["changes/time"][0] == 0.05
        assert json.loads(about["changes/patch"][0]) == {"fbar": False}


@pytest.mark.parametrize("path", [True, False], ids=["all at their path", "all in the run object"])
def test_record_takes_all_changes_of_daemons_old_and_new(fbar, fake, tmp_path, path):
    daemon = fake(n_frames=2)
    daemon.changes = [{"revision": k, "step": k, "time": 1e-4 * k, "patch": {"fbar": k % 2 == 0}} for k in range(1, 41)]
    daemon.changes_path = path  # then the run object has the newest alone
    daemon.advance(2, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    with h5py.File(tmp_path / "a.h5") as f:
        assert list(f["fbard/changes/step"]) == list(range(1, 41))
        assert [json.loads(p)["fbar"] for p in f["fbard/changes/patch"]] == [k % 2 == 0 for k in range(1, 41)]


def test_record_3d_tensors_and_integers(fbar, fake, tmp_path):
    daemon = fake(n_frames=4, dimension=3, count=27)
    daemon.advance(4, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames)


def test_record_late_join_takes_frames_over_http(fbar, fake, tmp_path):
    daemon = fake()
    daemon.advance(20, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames)


def test_record_repairs_lost_damaged_doubled_and_reordered_frames(fbar, fake, start_fbar, tmp_path):
    wanted = undisturbed(fbar, fake, tmp_path, n_frames=60)
    daemon = fake(n_frames=60)
    daemon.damaged = {5, 31}  # also over HTTP, once
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    rng, held = random.Random(7), []
    while daemon.ready < 60:
        seq = daemon.ready
        daemon.advance(live=False)
        fate = rng.random()
        if fate < 0.2:
            continue  # lost
        elif fate < 0.3:
            frame = bytearray(daemon.frames[seq])
            frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
            daemon.publish(seq, bytes(frame))
        elif fate < 0.4:
            daemon.publish(seq, daemon.frames[seq][:rng.randrange(len(daemon.frames[seq]))] or b"x")
        elif fate < 0.5:
            held.append(seq)  # comes late
        else:
            daemon.publish(seq)
            if fate > 0.9:
                daemon.publish(seq)
            if held and fate > 0.7:
                daemon.publish(held.pop())
        time.sleep(0.003)
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 0, err
    assert (tmp_path / "a.h5").read_bytes() == wanted


def test_record_refuses_a_frame_published_twice_with_other_contents(fake, start_fbar):
    daemon, other = fake(), fake(count=40)
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    daemon.advance(3)
    wait_until(lambda: 2 in daemon.acks)
    while recorder.poll() is None:  # it may not be heard yet: so far all frames may have come over HTTP
        daemon.publish(1, other.frames[1])
        time.sleep(0.02)
    _, err = recorder.communicate()
    assert recorder.returncode == 4 and "frame 1" in err


def test_record_acknowledges_only_what_is_in_the_log(fake, start_fbar, tmp_path):
    daemon = fake(n_frames=40)
    faults = []

    def on_ack(acked):
        data = (tmp_path / "a.h5.log").read_bytes()
        if acked >= 0 and daemon.frames[acked] not in data:
            faults.append(acked)
    daemon.on_ack = on_ack
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    daemon.play(0.005).join()
    assert recorder.wait(PATIENCE) == 0
    assert daemon.acks[0] == -1 and daemon.acks[-1] == 39 and not faults


def test_record_without_recorders_carries_on(fbar, fake, tmp_path):
    daemon = fake(recorders=False)
    daemon.advance(20, live=False)
    result = fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    assert result.returncode == 0 and result.stderr == ""  # a reason to speak is a frame that is gone
    check_frames(tmp_path / "a.h5", daemon.frames)


def test_record_survives_a_daemon_that_goes_and_comes_back(fbar, fake, start_fbar, tmp_path):
    wanted = undisturbed(fbar, fake, tmp_path, n_frames=30)
    daemon = fake(n_frames=30)
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    for _ in range(2):
        daemon.advance(7)
        wait_until(lambda: daemon.ready - 1 in daemon.acks)
        daemon.down()
        daemon.ready += 3  # the run went on, or was simulated again
        wait_until_said(recorder, "waiting up to")
        daemon.up()
    daemon.play()
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 0, err
    assert "is back" in err
    assert (tmp_path / "a.h5").read_bytes() == wanted


def test_record_gives_up_on_a_daemon_that_stays_away_and_resumes(fbar, fake, start_fbar, tmp_path):
    daemon = fake()
    recorder = start_fbar("record", "r1", "-o", "a.h5", "--wait", 0.5, url=daemon.url)
    joined(daemon)
    daemon.advance(7)
    wait_until(lambda: 6 in daemon.acks)
    daemon.down()
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 3, err
    check_frames(tmp_path / "a.h5", daemon.frames[:7], complete=False)
    daemon.up()
    daemon.advance(13, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames)
    assert not (tmp_path / "a.h5.log").exists()


def test_record_killed_at_random_moments_is_as_if_it_never_was(fbar, fake, start_fbar, tmp_path):
    wanted = undisturbed(fbar, fake, tmp_path, n_frames=60, count=2000)
    rng = random.Random(11)
    daemon = fake(n_frames=60, count=2000)
    killed = threading.Event()
    player = daemon.play(0.02, until=killed)
    for _ in range(8):
        recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
        time.sleep(rng.uniform(0.005, 0.15))
        assert recorder.poll() is None
        recorder.kill()
        recorder.wait()
    killed.set()
    player.join()
    result = fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "a.h5").read_bytes() == wanted
    assert not (tmp_path / "a.h5.log").exists() and not (tmp_path / "a.h5.tmp").exists()


def partial(fbar, fake, start_fbar, tmp_path, n=6):
    """A killed recording of n frames, and its daemon."""
    daemon = fake()
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    for _ in range(n):
        daemon.advance()
        wait_until(lambda: daemon.ready - 1 in daemon.acks)
    recorder.kill()
    recorder.wait()
    return daemon


def test_record_cuts_a_torn_tail_of_any_length(fbar, fake, start_fbar, tmp_path):
    wanted = undisturbed(fbar, fake, tmp_path)
    daemon = partial(fbar, fake, start_fbar, tmp_path)
    daemon.advance(14, live=False)
    log = (tmp_path / "a.h5.log").read_bytes()
    rng = random.Random(3)
    for length in [0, 63, 64, len(log) - 1] + [rng.randrange(len(log)) for _ in range(3)]:
        (tmp_path / "a.h5").unlink(missing_ok=True)
        (tmp_path / "a.h5.log").write_bytes(log[:length])
        result = fbar("record", "r1", "-o", "a.h5", url=daemon.url)
        assert result.returncode == 0, (length, result.stderr)
        assert (tmp_path / "a.h5").read_bytes() == wanted, length


def test_record_refuses_damage_before_the_tail_and_recover_saves_what_precedes_it(
        fbar, fake, start_fbar, tmp_path):
    daemon = partial(fbar, fake, start_fbar, tmp_path)
    log = bytearray((tmp_path / "a.h5.log").read_bytes())
    place = log.find(daemon.frames[2])
    log[place + 200] ^= 4
    (tmp_path / "a.h5.log").write_bytes(log)
    daemon.advance(14, live=False)
    result = fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    assert result.returncode == 4 and f"damaged at byte {place - 64}" in result.stderr
    assert (tmp_path / "a.h5.log").read_bytes() == log
    assert fbar("recover", "a.h5").returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames[:2], complete=False)
    assert (tmp_path / "a.h5.log").exists()


def test_recover_builds_a_file_without_a_daemon(fbar, fake, start_fbar, tmp_path):
    daemon = partial(fbar, fake, start_fbar, tmp_path)
    result = fbar("--json", "recover", "a.h5")
    assert result.returncode == 0
    assert json.loads(result.stdout)["frames"] == 6
    check_frames(tmp_path / "a.h5", daemon.frames[:6], complete=False)
    assert fbar("recover", "missing.h5").returncode == 4


def test_record_resumed_while_the_daemon_is_away_waits_for_it(fbar, fake, start_fbar, tmp_path):
    wanted = undisturbed(fbar, fake, tmp_path)
    daemon = partial(fbar, fake, start_fbar, tmp_path)
    daemon.down()
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    wait_until_said(recorder, "waiting up to")
    daemon.up()
    daemon.advance(14, live=False)
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 0 and "is back" in err, err
    assert (tmp_path / "a.h5").read_bytes() == wanted
    daemon.down()  # with nothing recorded there is nothing to wait for
    assert fbar("record", "r1", "-o", "b.h5", url=daemon.url).returncode == 3
    daemon.up()


def test_record_ahead_of_a_daemon_that_lost_frames_registers_from_the_start(fbar, fake, start_fbar, tmp_path):
    """After a power failure the daemon may know fewer frames than are safe here; it makes them again."""
    wanted = undisturbed(fbar, fake, tmp_path)
    daemon = partial(fbar, fake, start_fbar, tmp_path, n=6)
    daemon.ready, known, route = 3, len(daemon.acks), daemon.route
    refused = (422, "application/problem+json", b'{"title": "x", "status": 422, "detail": "x", "errors": []}')

    def strict(method, path, body, headers):
        ahead = method == "PUT" and "/recorders/" in path and json.loads(body)["acked"] >= daemon.ready
        return refused if ahead else route(method, path, body, headers)

    daemon.route = strict
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    wait_until(lambda: len(daemon.acks) > known)
    assert daemon.acks[known:] == [-1], "registered, with nothing acknowledged"
    daemon.play()
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 0, err
    assert daemon.acks[-1] == 19
    assert (tmp_path / "a.h5").read_bytes() == wanted


def test_record_interrupted_closes_the_file_and_resumes(fbar, fake, start_fbar, tmp_path):
    daemon = fake()
    recorder = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    daemon.advance(5)
    wait_until(lambda: 4 in daemon.acks)
    recorder.send_signal(signal.SIGINT)
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 130, err
    check_frames(tmp_path / "a.h5", daemon.frames[:5], complete=False)
    daemon.advance(15, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames)


def test_record_interrupted_while_the_daemon_goes_away_does_not_wait_for_it(fake, start_fbar, tmp_path):
    """The signal comes while an answer is waited for, and instead of the answer the end of the connection."""
    daemon, asked, held = fake(), threading.Event(), threading.Event()
    recorder = start_fbar("record", "r1", "-o", "a.h5", "--wait", 5, url=daemon.url)
    joined(daemon)
    daemon.advance(3)
    wait_until(lambda: 2 in daemon.acks)
    route = daemon.route

    def hold(method, path, body, headers):
        if path == "/v1/runs/r1":
            asked.set()
            held.wait()
        return route(method, path, body, headers)
    daemon.route = hold
    assert asked.wait(PATIENCE)
    recorder.send_signal(signal.SIGINT)
    daemon.down()
    held.set()
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 130 and "waiting up to" not in err, err
    check_frames(tmp_path / "a.h5", daemon.frames[:3], complete=False)
    daemon.up()


def test_record_leaves_a_finished_recording_alone(fbar, fake, tmp_path):
    daemon = fake()
    daemon.advance(20, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    before = (tmp_path / "a.h5").stat()
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    daemon.down()
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0  # none is needed
    after = (tmp_path / "a.h5").stat()
    assert (before.st_mtime_ns, before.st_ino) == (after.st_mtime_ns, after.st_ino)
    daemon.up()


def test_record_refuses_the_file_of_another_run(fbar, fake, tmp_path):
    daemon = fake()
    daemon.advance(20, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    kept = (tmp_path / "a.h5").read_bytes()
    other = fake(run="r2")
    other.advance(20, live=False)
    result = fbar("record", "r2", "-o", "a.h5", url=other.url)
    assert result.returncode == 4 and "r1" in result.stderr
    again = fake(count=40)  # the same name, but not the same run
    again.advance(20, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=again.url).returncode == 4
    assert (tmp_path / "a.h5").read_bytes() == kept
    (tmp_path / "b.h5").write_text("precious")
    assert fbar("record", "r1", "-o", "b.h5", url=daemon.url).returncode == 4
    assert (tmp_path / "b.h5").read_text() == "precious"


def test_record_two_into_one_file_is_refused(fake, start_fbar):
    daemon = fake()
    first = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    joined(daemon)
    second = start_fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    assert second.wait(PATIENCE) == 4
    daemon.advance(20)
    assert first.wait(PATIENCE) == 0


def limit_file_size():
    resource.setrlimit(resource.RLIMIT_FSIZE, (40000, resource.RLIM_INFINITY))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)


def test_record_out_of_space_is_an_io_error_and_resumes(fbar, fake, tmp_path):
    wanted = undisturbed(fbar, fake, tmp_path)
    daemon = fake()
    daemon.advance(20, live=False)
    result = subprocess.run(conftest.command("record", "r1", "-o", "a.h5", url=daemon.url),
                            cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE,
                            preexec_fn=limit_file_size, restore_signals=False)
    assert result.returncode == 4 and "File too large" in result.stderr
    acked = daemon.acks[-1]
    log = (tmp_path / "a.h5.log").read_bytes()
    assert all(frame in log for frame in daemon.frames[:acked + 1])
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    assert (tmp_path / "a.h5").read_bytes() == wanted


def test_record_into_a_folder_that_vanishes_is_an_io_error(fake, start_fbar, tmp_path):
    (tmp_path / "out").mkdir()
    daemon = fake()
    recorder = start_fbar("record", "r1", "-o", "out/a.h5", url=daemon.url)
    joined(daemon)
    daemon.advance(3)
    wait_until(lambda: 2 in daemon.acks)
    shutil.rmtree(tmp_path / "out")
    daemon.advance(3)
    _, err = recorder.communicate(timeout=PATIENCE)
    assert recorder.returncode == 4 and "out/a.h5" in err
    assert max(daemon.acks) == 2


def test_record_into_no_folder_is_an_io_error(fbar, fake):
    daemon = fake()
    assert fbar("record", "r1", "-o", "none/a.h5", url=daemon.url).returncode == 4


@pytest.mark.parametrize("recorders", [True, False])
def test_record_a_gone_frame_is_said(fbar, fake, recorders):
    daemon = fake(recorders=recorders)
    daemon.advance(20, live=False)
    route = daemon.route
    daemon.route = lambda m, p, b, h: ((404, "application/json", b"{}") if p.endswith("/frames/3")
                                       else route(m, p, b, h))
    result = fbar("record", "r1", "-o", "a.h5", url=daemon.url)
    assert result.returncode == 4 and "frame 3" in result.stderr
    assert ("recorders" in result.stderr) == (not recorders)


# (probe of the scene, column of the daemon's CSV, unit in 2D, in 3D)
PROBES = [
    ({"kind": "extent", "axis": "y", "side": "min"}, "p", "m", "m"),
    ({"kind": "displacement", "at": [0, 0]}, "p.x", "m", "m"),
    ({"kind": "reaction", "wall": "floor"}, "p.x", "N/m", "N"),
    ({"kind": "energy"}, "p.kinetic", "J/m", "J"),
    ({"kind": "momentum"}, "p.x", "kg/s", "kg m/s"),
    ({"kind": "drift"}, "p", "1", "1"),
    ({"kind": "field", "field": "velocity", "at": [0, 0]}, "p.x", "m/s", "m/s"),
    ({"kind": "maximum", "field": "density"}, "p", "kg/m^3", "kg/m^3"),  # in no frame
    ({"kind": "mean", "field": "volume_ratio"}, "p", "1", "1"),
    ({"kind": "mean", "field": "soon"}, "p", "unknown", "unknown"),
    ({"kind": "minimum", "field": "mean_stress", "scale": -1}, "p", "Pa", "Pa"),
    ({"kind": "minimum", "field": "mean_stress", "scale": 1e-3}, "p", "scaled Pa", "scaled Pa")]


@pytest.mark.parametrize("dimension", [2, 3])
def test_record_probes_have_units(fbar, fake, tmp_path, dimension):
    daemon = fake(n_frames=2, dimension=dimension, count=8)
    daemon.scene = {"probes": {f"p{i}": probe for i, (probe, _, _, _) in enumerate(PROBES)}}
    columns = [column.replace("p", f"p{i}", 1) for i, (_, column, _, _) in enumerate(PROBES)]
    daemon.probes_csv = ",".join(["step,time", *columns]) + "\r\n0,0" + ",1" * len(PROBES) + "\r\n"
    daemon.advance(2, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    with h5py.File(tmp_path / "a.h5") as f:
        about = [f[f"fbard/probes/p{i}/value"].attrs for i in range(len(PROBES))]
        assert [a["unit"].decode() for a in about] == [row[dimension] for row in PROBES]
        assert about[-1]["long_name"] == b"minimum of mean_stress, times 0.001"


def test_record_compressed_holds_the_same(fbar, fake, tmp_path):
    daemon = fake(count=3000, n_frames=8)
    daemon.advance(8, live=False)
    assert fbar("record", "r1", "-o", "a.h5", "--compress", 4, url=daemon.url).returncode == 0
    assert fbar("record", "r1", "-o", "b.h5", url=daemon.url).returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames)
    assert (tmp_path / "a.h5").stat().st_size < (tmp_path / "b.h5").stat().st_size
    with h5py.File(tmp_path / "a.h5") as f:
        assert f["VTKHDF/Points"].compression == "gzip" and f["VTKHDF/Points"].shuffle


def test_record_fields_that_come_and_go_are_filled(fbar, fake, tmp_path):
    daemon, short = fake(), fake(fields=["position", "id"])
    daemon.frames[10] = short.frames[10]
    daemon.advance(20, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    check_frames(tmp_path / "a.h5", daemon.frames)
    with h5py.File(tmp_path / "a.h5") as f:
        assert np.isnan(f["VTKHDF/PointData/mean_stress"][500:550]).all()
        assert not np.isnan(f["VTKHDF/PointData/mean_stress"][550:]).any()


def test_record_xdmf_describes_the_same_arrays(fbar, fake, tmp_path):
    for dimension in (2, 3):
        daemon = fake(n_frames=5, dimension=dimension)
        daemon.advance(5, live=False)
        name = f"a{dimension}.h5"
        assert fbar("record", "r1", "-o", name, url=daemon.url).returncode == 0
        grids = read_xdmf(tmp_path / f"a{dimension}.xdmf")
        assert len(grids) == 5
        for (at, arrays), frame in zip(grids, daemon.frames):
            header, wanted, _ = unpack(frame)
            assert at == header["time"]
            assert set(arrays) == set(wanted)
            for key, array in wanted.items():
                np.testing.assert_array_equal(
                    arrays[key][:, :dimension] if array.ndim == 2 else
                    arrays[key].reshape(-1, 3, 3)[:, :dimension, :dimension] if array.ndim == 3
                    else arrays[key], array)


PVPYTHON = """
import json, sys
from paraview.simple import *
from paraview import servermanager
out = {}
for name, reader in (("2", XDMFReader(FileNames=[sys.argv[1]])), ("3", Xdmf3ReaderS(FileName=[sys.argv[1]])),
                     ("any", OpenDataFile(sys.argv[1]))):
    steps = out[name] = []
    for t in reader.TimestepValues:
        reader.UpdatePipeline(t)
        data = servermanager.Fetch(reader)
        while data.IsA("vtkMultiBlockDataSet"):
            data = data.GetBlock(0)
        point = data.GetPointData()
        arrays = [point.GetArray(i) for i in range(point.GetNumberOfArrays())]
        steps.append({"time": t, "n": data.GetNumberOfPoints(), "cells": data.GetNumberOfCells(),
                      "last": data.GetPoint(data.GetNumberOfPoints() - 1),
                      "arrays": {a.GetName(): [a.GetNumberOfTuples(), a.GetTuple(7)] for a in arrays}})
print("RESULT " + json.dumps(out))
"""


@pytest.mark.long
@pytest.mark.parametrize("dimension", [2, 3])
def test_record_xdmf_opens_in_paraview(fbar, fake, tmp_path, dimension):
    assert shutil.which("pvpython"), "pvpython is not installed: make deps-long"
    daemon = fake(n_frames=5, dimension=dimension)
    daemon.frames[2] = fake(n_frames=5, dimension=dimension, count=40).frames[2]  # counts may differ
    daemon.advance(5, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    (tmp_path / "look.py").write_text(PVPYTHON)
    result = subprocess.run(["pvpython", str(tmp_path / "look.py"), str(tmp_path / "a.xdmf")],
                            text=True, capture_output=True, timeout=120)
    line = [x for x in result.stdout.splitlines() if x.startswith("RESULT ")]
    assert line, result.stderr
    for steps in json.loads(line[0][7:]).values():
        assert len(steps) == 5
        for step, frame in zip(steps, daemon.frames):
            header, arrays, _ = unpack(frame)
            assert step["time"] == header["time"] and step["n"] == step["cells"] == header["count"]
            assert step["last"] == padded(arrays["position"])[-1].tolist()
            for name, array in arrays.items():
                if name != "position":
                    n, values = step["arrays"][name]
                    assert n == header["count"]
                    assert values == np.atleast_1d(padded(array)[7]).tolist()
