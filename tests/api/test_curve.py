"""The encrypted ZeroMQ socket: who has an admitted key hears, nobody else does."""
import os
import re
import stat
import subprocess

import pytest
import zmq
from boxes import endless, water
from fbard import PATIENCE, PROGRAM, ROOT, until
from frames import Frame

FBAR = os.environ.get("FBAR") or str(ROOT / "build" / "fbar")


def keygen(*arguments):
    return subprocess.run([FBAR, "keygen", *map(str, arguments)], capture_output=True, text=True, timeout=PATIENCE)


def keys_of(path):
    return dict(line.split() for line in path.read_text().splitlines() if not line.startswith("#"))


@pytest.fixture
def folder(tmp_path):
    made = keygen(tmp_path / "keys")
    assert (made.returncode, made.stdout) == (0, f"{tmp_path}/keys/client.curve\n"), made
    return tmp_path / "keys"


def listen(daemon, keys, seconds=PATIENCE, until_logged=""):
    """The first message of a run that makes frames, or None; not before the log has so much."""
    context = zmq.Context()
    try:
        s = context.socket(zmq.SUB)
        if keys:
            s.curve_serverkey, s.curve_publickey, s.curve_secretkey = (
                keys[k].encode() for k in ("server", "public", "secret"))  # fmt: skip
        s.subscribe(b"run/")
        s.connect(daemon.publish)
        until(lambda: until_logged in daemon.stderr())
        return s.recv_multipart() if s.poll(int(1000 * seconds)) else None
    finally:
        context.destroy(linger=0)


@pytest.fixture
def encrypted(fresh, folder):
    d = fresh("--curve-dir", str(folder))
    d.start()
    d.create(endless(output={"interval": 0.05}), id="r")
    yield d


def test_curve_keys_are_made_once_and_kept_secret(folder):
    def modes():
        return {p.name: stat.S_IMODE(p.stat().st_mode) for p in folder.iterdir() if p.is_file()}

    assert modes() == {"server.public": 0o644, "server.secret": 0o600, "client.curve": 0o600}
    server = (folder / "server.public").read_text()
    again = keygen(folder)
    assert again.returncode == 4 and "client.curve" in again.stderr, "an earlier key is not overwritten"
    assert keygen(folder, "second").returncode == 0
    assert (folder / "server.public").read_text() == server
    assert keys_of(folder / "second.curve")["server"] == server.strip()
    assert keys_of(folder / "second.curve")["secret"] != keys_of(folder / "client.curve")["secret"]
    for name in ("", "../up", ".hidden", "a/b", "x" * 65):
        assert keygen(folder, name).returncode == 2, name


def test_curve_lets_admitted_keys_hear(encrypted, folder):
    keys = keys_of(folder / "client.curve")
    topic, block = listen(encrypted, keys)
    assert topic == b"run/r/frame" and Frame(block).header["run"] == "r"
    assert encrypted.get("/v1")["endpoints"]["publish_key"] == keys["server"]
    assert 'event=subscriber name="client"' in encrypted.stderr()


def test_curve_keeps_others_out(encrypted, folder):
    keys = keys_of(folder / "client.curve")
    assert listen(encrypted, None, 1) is None, "in the clear"
    public, secret = (k.decode() for k in zmq.curve_keypair())
    refused = f'event=subscriber_refused key="{public}"'
    assert listen(encrypted, {**keys, "public": public, "secret": secret}, 1, refused) is None, "a key of one's own"
    wrong = zmq.curve_keypair()[0].decode()
    assert listen(encrypted, {**keys, "server": wrong}, 1) is None, "for another server"
    assert listen(encrypted, keys) is not None
    assert keys["secret"] not in encrypted.stderr()


def test_curve_keys_come_and_go_while_the_daemon_runs(encrypted, folder):
    assert keygen(folder, "late").returncode == 0
    late = keys_of(folder / "late.curve")
    assert listen(encrypted, late) is not None
    (folder / "clients" / "late.public").unlink()
    assert listen(encrypted, late, 1) is None
    (folder / "clients" / "broken.public").write_text("no key")
    assert listen(encrypted, keys_of(folder / "client.curve")) is not None


@pytest.mark.parametrize("spoil, named", [
    (lambda f: (f / "server.secret").unlink(), "server.secret"),
    (lambda f: (f / "server.public").write_text("short\n"), "40 characters"),
    (lambda f: (f / "server.secret").chmod(0o644), "chmod 600"),
    (lambda f: (f / "clients").rename(f / "c"), "clients"),
], ids=["missing", "damaged", "open", "no clients"])  # fmt: skip
def test_curve_folder_that_is_not_in_order_is_refused(folder, tmp_path, spoil, named):
    spoil(folder)
    refused = subprocess.run(
        [PROGRAM, "--http", "127.0.0.1:0", "--publish", "tcp://127.0.0.1:0", "--data-dir", str(tmp_path / "d"),
         "--curve-dir", str(folder)], capture_output=True, text=True, timeout=PATIENCE)  # fmt: skip
    assert refused.returncode == 4 and named in refused.stderr, refused


def test_curve_beyond_loopback_needs_no_insecure(fresh, folder):
    d = fresh("--curve-dir", str(folder))
    d.command = lambda: [a if a != "tcp://127.0.0.1:0" else "tcp://0.0.0.0:0" for a in type(d).command(d)]
    d.start()
    d.publish = re.sub(r"0\.0\.0\.0", "127.0.0.1", d.publish)
    d.create(endless(output={"interval": 0.05}), id="r")
    assert listen(d, keys_of(folder / "client.curve")) is not None


@pytest.mark.parametrize("keyed", [True, False])
def test_recorder_of_an_encrypted_daemon(fresh, folder, tmp_path, keyed):
    d = fresh("--curve-dir", str(folder))
    d.start()
    d.create(water(), id="r", start=False, recorders=["first"])
    file = tmp_path / "r.h5"
    with open(tmp_path / "out", "w") as out:
        recorder = subprocess.Popen(
            [FBAR, "--url", d.http, *(["--curve-file", str(folder / "client.curve")] if keyed else []), "record", "r",
             "-o", str(file)], stdout=out, stderr=out)  # fmt: skip
        until(lambda: len(d.get("/v1/runs/r/recorders")["recorders"]) == 2)
        if keyed:
            until(lambda: 'event=subscriber name="client"' in d.stderr())
        d.act("r", "start")
        assert recorder.wait(PATIENCE) == 0, (tmp_path / "out").read_text()
    assert file.exists()
    assert ("--curve-file has the keys" in (tmp_path / "out").read_text()) == (not keyed)
