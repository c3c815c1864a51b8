"""The report (bench/report) in its size `tiny`: seconds of runs and no physics, but every section, killed on the way."""
import base64
import contextlib
import io
import os
import pathlib
import re
import signal
import subprocess
import time

import h5py
import numpy as np
import pytest
from PIL import Image

from conftest import FBAR, FBARD, ROOT, wait_until

FIGURES = ("3", "4", "5", "6", "8", "9", "10", "12", "14", "15", "16")


def report(folder, *words, **options):
    return subprocess.Popen(["/usr/bin/python3", str(ROOT / "bench" / "report"), "tiny", "--folder", str(folder), *words],
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            env={**os.environ, "FBARD": FBARD, "FBAR": FBAR}, **options)  # fmt: skip


def finished(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err + out
    assert "Traceback" not in err, err
    return out


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(folder, what the report printed): it was killed with kill -9 in mid-run, and called again while a recorder of the
    first call was still there."""
    folder = tmp_path_factory.mktemp("report")
    first = report(folder)
    stopped = []

    def stop_a_recorder():
        for pid in recorders_of(first.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
                file = words_of(f"/proc/{pid}/cmdline", "\0")[-2]
                if state_of(pid) == "T" and pathlib.Path(file + ".log").exists():
                    stopped.append(pid)
                    return True
                os.kill(pid, signal.SIGCONT)
        return first.poll() is not None

    wait_until(stop_a_recorder)
    assert first.poll() is None
    first.send_signal(signal.SIGKILL)
    first.communicate()
    second, said = report(folder), []
    try:
        for line in second.stdout:
            said.append(line)
            if "waiting for them" in line:
                break
        assert "waiting for them" in said[-1], said
    finally:
        os.kill(stopped[0], signal.SIGCONT)
    return folder, "".join(said) + finished(second)


def recorders_of(pid):
    """The fbar among the children of a report."""
    children = [p for task in pathlib.Path(f"/proc/{pid}/task").glob("*/children") for p in words_of(task)]
    return [int(p) for p in children if "fbar" in words_of(f"/proc/{p}/comm")]


def words_of(path, between=None):
    try:
        return pathlib.Path(path).read_text().split(between)
    except OSError:  # gone
        return ["", ""]


def state_of(pid):
    """Of a process that was told to stop: "T" once it has, another letter if it ends."""
    while (state := (words_of(f"/proc/{pid}/stat", ")")[-1].split() or ["X"])[0]) in ("R", "S", "D"):
        time.sleep(0.001)
    return state


def test_report_goes_on_after_a_kill(made):
    folder, out = made
    recordings = sorted((folder / "runs").glob("*.h5"))
    assert len(recordings) == int(re.search(r"(\d+) cases", out)[1]) > 10
    for path in recordings:
        with h5py.File(path) as f:
            assert f["fbard"].attrs["complete"] and f["fbard"].attrs["state"] == b"completed"
            # every frame from the first on, in their order
            assert np.array_equal(f["fbard/frames/seq"][:], np.arange(len(f["fbard/frames/seq"])))


def test_report_runs_nothing_twice_but_what_changed(made):
    folder, _ = made
    path = folder / "runs" / "dam-gimp-zhao.h5"
    others = {p: p.stat().st_mtime_ns for p in (folder / "runs").glob("*.h5") if p != path}
    with h5py.File(path, "r+") as f:  # as if the case had been another one
        scene = f["fbard/scene"][()].decode()
        assert '"viscosity": 0.001' in scene or '"viscosity":0.001' in scene
        del f["fbard/scene"]
        f["fbard"].create_dataset("scene", data=re.sub(r'("viscosity": ?)0.001', r"\g<1>0.002", scene))
    out = finished(report(folder, "--runs", "--only", "dam-", "--only", "cook-h4"))
    assert "dam-gimp-zhao: completed" in out and "dam-gimp-standard" not in out and "cook" not in out
    assert others == {p: p.stat().st_mtime_ns for p in others}


def test_report_page_needs_nothing_else(made):
    folder, _ = made
    text = (folder / "report.html").read_text(encoding="utf-8")
    places = re.findall(r'(?:src|href|url|action|data)\s*=\s*"([^"]*)"', text)
    assert places and all(p.startswith(("data:image/png;base64,", "#")) for p in places)
    assert not re.search(r"@import|url\(|<script|<link|<iframe", text)
    # Every section has its figure's number, all that a section must say, and a verdict.
    sections = dict(re.findall(r'<section id="figure-(\d+)">(.*?)</section>', text, re.S))
    assert sorted(sections, key=int) == list(FIGURES)
    for number, section in sections.items():
        for word in ("The paper shows", "We measure", "Against", "Verdict: "):
            assert word in section, (number, word)
        assert f'href="#figure-{number}"' in text
    # What runs exist for is drawn: figure 4 has none of its basis here.
    for number in set(FIGURES) - {"4"}:
        assert "<img" in sections[number], number


def test_report_pictures_show_something(made):
    folder, _ = made
    text = (folder / "report.html").read_text(encoding="utf-8")
    pictures = re.findall(r'<img alt="([^"]+)" src="data:image/png;base64,([^"]+)">', text)
    assert len(pictures) >= 10
    for caption, data in pictures:
        image = Image.open(io.BytesIO(base64.b64decode(data, validate=True)))
        assert image.format == "PNG" and image.width > 300 and image.height > 200, caption
        # curves or particles, not axes alone: some colour covers more than a few pixels
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
        assert (np.ptp(pixels, axis=1) > 40).sum() > 200, caption
    files = {p.name for p in folder.glob("figure-*.png")}
    assert len(files) == len(pictures)


def test_report_tables_lie_beside_it(made):
    folder, _ = made
    for name in ("figure-03", "figure-05", "figure-06", "figure-08", "figure-09", "figure-10", "figure-12", "figure-16", "runs"):
        header, *rows = (folder / f"{name}.csv").read_text().splitlines()
        assert header.count(",") >= 2 and rows, name
