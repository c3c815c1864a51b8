"""What a service manager is told (sd_notify), and that a stop and a start lose nothing."""
import os
import re
import signal
import socket
import subprocess

import pytest
from boxes import endless
from fbard import PATIENCE, PROGRAM, until


class Manager:
    """The receiving end of NOTIFY_SOCKET."""

    def __init__(self, address):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address[0] == "@" else address)
        self.socket.settimeout(PATIENCE)

    def next(self):
        return self.socket.recv(4096).decode()

    def silent(self):
        self.socket.setblocking(False)
        try:
            return self.socket.recv(4096).decode()
        except BlockingIOError:
            return None
        finally:
            self.socket.settimeout(PATIENCE)


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    address = str(tmp_path / "notify") if request.param == "path" else f"@fbard-test-{os.getpid()}"
    made = Manager(address)
    made.address = address
    yield made
    made.socket.close()


def test_service_is_ready_stops_and_goes_on(manager, fresh):
    d = fresh(slots=1)
    d.environment = {"NOTIFY_SOCKET": manager.address}
    d.start()
    assert manager.next() == "READY=1"
    # Ready means ready: both sockets take connections at once.
    assert d.ask("GET", "/readyz").status == 200
    host, port = re.fullmatch(r"tcp://(.*):(\d+)", d.publish).groups()
    socket.create_connection((host, int(port)), timeout=PATIENCE).close()
    d.ask("POST", "/v1/runs", {"scene": endless(), "id": "lasting"}, status=201)
    until(lambda: d.get("/v1/runs/lasting")["step"] > 5)
    assert manager.silent() is None
    d.stop(signal.SIGTERM)
    assert manager.next() == "STOPPING=1" and manager.silent() is None
    d.start()
    assert manager.next() == "READY=1"
    again = d.wait("lasting", "running")  # and not for a slot any more
    assert again["step"] > 5 and again["epoch"] == 0
    until(lambda: d.get("/v1/runs/lasting")["step"] > again["step"])
    d.ask("POST", "/v1/runs/lasting:cancel")


def test_service_is_not_ready_before_it_can_serve(manager, daemon, tmp_path):
    ended = subprocess.run([PROGRAM, "--http", daemon.host, "--data-dir", str(tmp_path / "d")], timeout=PATIENCE,
                           env={**os.environ, "NOTIFY_SOCKET": manager.address}, capture_output=True)  # fmt: skip
    assert ended.returncode == 4 and manager.silent() is None


@pytest.mark.parametrize("address", ["relative", "/nowhere/at/all", "/" + "x" * 200])
def test_service_manager_that_is_not_there_is_only_logged(fresh, address):
    d = fresh()
    d.environment = {"NOTIFY_SOCKET": address}
    d.start()
    until(lambda: "event=notify" in d.stderr() or " notify" in d.stderr())
    assert d.ask("GET", "/readyz").status == 200
