#!/usr/bin/env python3
"""How fast the daemon answers while a run uses all cores, and what answering costs the run.

100 status requests a second, at fixed times, over 32 connections that are kept; latency counts from the time at which
a request was due, so that a late client is not flattering. The run never stops; requests come in every other half second,
and the run's speed then is compared with that in the half seconds beside it: what else goes on on a machine changes more
slowly than that, and moves both."""
import json
import os
import pathlib
import selectors
import socket
import statistics
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "api"))
import fbard  # noqa: E402
from boxes import big  # noqa: E402

RATE, CONNECTIONS = 100, 32
SLICE = 0.5  # s; the status is at most 20 ms old, steps and seconds in it are of one moment
PAIRS = int(os.environ.get("PAIRS", 60))


class Connection:
    def __init__(self, host, request):
        self.socket = socket.create_connection(host)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.request, self.due, self.left, self.head = request, [], None, b""

    def send(self, due):
        self.due.append(due)
        self.socket.sendall(self.request)

    def receive(self):
        """Latencies of the answers that are whole now."""
        self.head += self.socket.recv(65536)
        now, done = time.monotonic(), []
        while True:
            end = self.head.find(b"\r\n\r\n")
            if end < 0:
                return done
            assert self.head.startswith(b"HTTP/1.1 200"), self.head[:200]
            length = int(self.head.split(b"Content-Length: ")[1].split(b"\r\n")[0])
            if len(self.head) < end + 4 + length:
                return done
            self.head = self.head[end + 4 + length :]
            done.append(now - self.due.pop(0))


def ask_for(connections, seconds, first):
    """Latencies of RATE requests a second, sent in turn over the connections from number `first` on."""
    selector, latencies = selectors.DefaultSelector(), []
    for c in connections:
        selector.register(c.socket, selectors.EVENT_READ, c)
    began = time.monotonic()
    sent, total = 0, int(RATE * seconds)
    while len(latencies) < total:
        now = time.monotonic()
        while sent < total and began + sent / RATE <= now:
            connections[(first + sent) % CONNECTIONS].send(began + sent / RATE)
            sent += 1
        wait = max(0.0, began + sent / RATE - time.monotonic()) if sent < total else 1.0
        for key, _ in selector.select(wait):
            latencies += key.data.receive()
    selector.close()
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
