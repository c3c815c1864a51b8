#!/usr/bin/env python3
"""How fast the daemon answers while a run uses all cores, and what answering costs the run.

100 status requests a second, at fixed times, over 32 connections that are kept; latency counts from the time at which
a request was due, so that a late client is not flattering, to the answer's arrival at the client's socket (the kernel's
time stamp). The client wakes once for a request, to send it, and then also takes earlier answers: it is on the same cores. The run never stops; requests come in every other half second,
and the run's speed then is compared with that in the half seconds beside it: what else goes on on a machine changes more
slowly than that, and moves both."""
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
PAIRS = int(os.environ.get("PAIRS", 60))


class Connection:
    def __init__(self, host, request):
        self.socket = socket.create_connection(host)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.setblocking(False)
        self.request, self.due, self.text = request, None, b""

    def send(self, due):
        assert self.due is None, "an answer takes longer than all connections together"
        self.due = due
        self.socket.sendall(self.request)

    def receive(self, clock):
        """Seconds from when the request was due to the answer's arrival, or None. `clock`: monotonic less real time."""
        try:
            text, ancillary, _, _ = self.socket.recvmsg(65536, 64)
        except BlockingIOError:
            return None
        assert text, "closed"
        self.text += text
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


def speeds(daemon, run, connections):
    """Steps per second and latencies, slice by slice: without requests, with, with, without, ..."""
    quiet, asked, latencies = [], [], []
    for pair in range(PAIRS):
        for with_requests in (pair % 2, 1 - pair % 2):
            step, wall = place(daemon, run)
            if with_requests:
                latencies += ask_for(connections, SLICE, len(latencies))
            else:
                time.sleep(SLICE)
            after, wall_after = place(daemon, run)
            (asked if with_requests else quiet).append((after - step) / (wall_after - wall))
    return quiet, asked, latencies


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
        quiet, asked, latencies = speeds(daemon, run, connections)
        for c in connections:
            c.socket.close()
        particles = daemon.run(run)["particles"]
        daemon.away(run)
        daemon.stop()
    latencies.sort()

    def at(share):
        return 1e3 * latencies[min(len(latencies) - 1, int(share * len(latencies)))]

    # The median of the pairs, and its standard error (1.25 sigma / sqrt(n), sigma from the quartiles).
    losses = sorted(1 - b / a for a, b in zip(quiet, asked))
    loss = statistics.median(losses)
    low, _, high = statistics.quantiles(losses, n=4)
    error = 1.25 * (high - low) / 1.35 / len(losses) ** 0.5
    million = 1e-6 * particles
    print(f"{len(latencies)} status requests at {RATE}/s over {CONNECTIONS} connections, a run of {particles} particles on "
          f"{threads} threads, load {os.getloadavg()[0]:.1f}")
    print(f"latency: median {at(0.5):.2f} ms (wanted <= 2), 99 % {at(0.99):.2f} ms (wanted <= 10), most {at(1):.2f} ms")
    print(f"the run: {million * statistics.median(quiet):.2f} -> {million * statistics.median(asked):.2f} million "
          f"particle-steps/s; loss {100 * loss:.1f} +- {100 * error:.1f} % (wanted <= 3), median of {len(losses)} pairs, "
          "the client's own work on the same cores included")
    print(json.dumps({"median_ms": at(0.5), "p99_ms": at(0.99), "loss": loss, "loss_error": error}))


main()
