#!/usr/bin/env python3
"""How fast the daemon answers while a run uses all cores, and what answering costs the run.

100 status requests a second, at fixed times, over 32 connections that are kept; latency counts from the time at which
a request was due, so that a late client is not flattering, to the answer's arrival at the client's socket (the kernel's
time stamp). The client is on the same cores as the run. So half seconds of three kinds take turns: nothing is asked;
the client asks itself, with the same calls at the same times; the client asks the daemon. The run never stops, and its
speed in a half second is compared with that in those of the other kinds beside it: what else goes on on a machine
changes more slowly than that, and moves all three. What answering costs is the third against the second."""
import json
import os
import pathlib
import socket
import statistics
import struct
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "api"))
import fbard  # noqa: E402
from boxes import big  # noqa: E402

RATE, CONNECTIONS = 100, 32
SO_TIMESTAMPNS = 35  # socket(7); of <asm-generic/socket.h>
SLICE = 0.5  # s; the status is at most 20 ms old, steps and seconds in it are of one moment
TURNS = int(os.environ.get("TURNS", 60))


class Connection:
    """To the daemon, or to `listener` of this process: then what is sent is taken at the other end, in the place of
    an answer."""

    def __init__(self, host, request, listener=None):
        self.socket, self.other_end = socket.create_connection(host), None
        if listener is not None:
            self.other_end, _ = listener.accept()
            self.socket, self.other_end = self.other_end, self.socket
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.setblocking(False)
        self.request, self.due, self.text = request, None, b""

    def send(self, due):
        assert self.due is None, "an answer takes longer than all connections together"
        self.due = due
        (self.other_end or self.socket).sendall(self.request)

    def receive(self, clock):
        """Seconds from when the request was due to the answer's arrival, or None. `clock`: monotonic less real time."""
        try:
            text, ancillary, _, _ = self.socket.recvmsg(65536, 64)
        except BlockingIOError:
            return None
        assert text, "closed"
        self.text += text
        if self.other_end is not None:
            self.due, self.text = None, b""
            return 0.0
        head, _, body = self.text.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200"), head[:200]
        if len(body) < int(head.split(b"Content-Length: ")[1].split(b"\r\n")[0]):
            return None
        ((_, kind, stamp),) = ancillary
        assert kind == SO_TIMESTAMPNS
        seconds, nanoseconds = struct.unpack("qq", stamp)
        latency = seconds + 1e-9 * nanoseconds + clock - self.due
        self.due, self.text = None, b""
        return latency


def ask_for(connections, seconds, first):
    """Latencies of RATE requests a second, sent in turn over the connections from number `first` on."""
    clock, latencies, asked = time.monotonic() - time.time(), [], []
    began = time.monotonic()

    def gather():
        for c in list(asked):
            latency = c.receive(clock)
            if latency is not None:
                latencies.append(latency)
                asked.remove(c)

    for k in range(int(RATE * seconds)):
        due = began + k / RATE
        time.sleep(max(0.0, due - time.monotonic()))
        connection = connections[(first + k) % CONNECTIONS]
        connection.send(due)
        gather()
        asked.append(connection)
    while asked:
        time.sleep(0.5 / RATE)
        gather()
    return latencies


def place(daemon, run):
    """Steps, and seconds within the step loop."""
    now = daemon.run(run)
    assert now["state"] == "running", now
    return now["step"], now["performance"]["wall_s"]


def used(daemon):
    """Processor seconds of the daemon's threads that answer, and of this process."""
    daemon_s = 0.0
    for task in pathlib.Path(f"/proc/{daemon.process.pid}/task").iterdir():
        try:
            if (task / "comm").read_text().startswith("MHD-connection"):
                daemon_s += 1e-9 * float((task / "schedstat").read_text().split()[0])
        except OSError:
            pass  # it has ended
    return daemon_s, 1e-9 * float(pathlib.Path("/proc/self/schedstat").read_text().split()[0])


NOTHING, ITSELF, DAEMON = range(3)


def speeds(daemon, run, connections, own):
    """Steps per second in half seconds of each kind, latencies, and processor seconds (used())."""
    found, latencies, costs = ([], [], []), [], [0.0, 0.0]
    for turn in range(TURNS):
        for kind in ((NOTHING, ITSELF, DAEMON), (DAEMON, ITSELF, NOTHING))[turn % 2]:
            step, wall = place(daemon, run)
            if kind == DAEMON:
                before = used(daemon)
                latencies += ask_for(connections, SLICE, len(latencies))
                costs = [c + a - b for c, a, b in zip(costs, used(daemon), before)]
            elif kind == ITSELF:
                ask_for(own, SLICE, len(latencies))
            else:
                time.sleep(SLICE)
            after, wall_after = place(daemon, run)
            found[kind].append((after - step) / (wall_after - wall))
    return found, latencies, costs


def loss(before, after):
    """The median of the turns, and its standard error (1.25 sigma / sqrt(n), sigma from the quartiles)."""
    losses = [1 - b / a for a, b in zip(before, after)]
    low, _, high = statistics.quantiles(losses, n=4)
    return statistics.median(losses), 1.25 * (high - low) / 1.35 / len(losses) ** 0.5


def main():
    threads = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder:
        daemon = fbard.Daemon(folder, slots=1, threads=threads)
        daemon.start()
        run = daemon.create(big(16))["id"]
        time.sleep(2)
        host, port = daemon.host.split(":")
        request = f"GET /v1/runs/{run} HTTP/1.1\r\nHost: {daemon.host}\r\n\r\n".encode()
        connections = [Connection((host, int(port)), request) for _ in range(CONNECTIONS)]
        with socket.create_server(("127.0.0.1", 0)) as listener:
            own = [Connection(listener.getsockname(), request, listener) for _ in range(CONNECTIONS)]
        found, latencies, costs = speeds(daemon, run, connections, own)
        for c in connections + own:
            c.socket.close()
        particles = daemon.run(run)["particles"]
        daemon.away(run)
        daemon.stop()
    latencies.sort()

    def at(share):
        return 1e3 * latencies[min(len(latencies) - 1, int(share * len(latencies)))]

    answering, answering_error = loss(found[ITSELF], found[DAEMON])
    both, both_error = loss(found[NOTHING], found[DAEMON])
    million = 1e-6 * particles
    quiet, itself, asked = (million * statistics.median(f) for f in found)
    print(f"{len(latencies)} status requests at {RATE}/s over {CONNECTIONS} connections, a run of {particles} particles on "
          f"{threads} threads, load {os.getloadavg()[0]:.1f}")
    print(f"latency: median {at(0.5):.2f} ms (wanted <= 2), 99 % {at(0.99):.2f} ms (wanted <= 10), most {at(1):.2f} ms")
    print(f"the run: {quiet:.2f}, while the client asks itself {itself:.2f}, the daemon {asked:.2f} million particle-steps/s; "
          f"loss by answering {100 * answering:.1f} +- {100 * answering_error:.1f} % (wanted <= 3), with the client's own "
          f"work on the same cores {100 * both:.1f} +- {100 * both_error:.1f} %; medians of {TURNS} turns")
    in_daemon, in_client = (1e6 * c / len(latencies) for c in costs)
    print(f"a request: {in_daemon:.0f} us of the processor in the daemon, {in_client:.0f} us in this client")
    print(json.dumps({"median_ms": at(0.5), "p99_ms": at(0.99), "loss": answering, "loss_error": answering_error, "loss_with_client": both}))


main()
