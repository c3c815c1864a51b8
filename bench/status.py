#!/usr/bin/env python3
"""How fast the daemon answers while a run uses all cores, and what answering costs the run.

100 status requests a second, at fixed times, over 32 connections that are kept; latency counts from the time at which
a request was due, so that a late client is not flattering. The run is timed with and without requests in turn."""
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
SECONDS = float(os.environ.get("SECONDS", 10))
ROUNDS = int(os.environ.get("ROUNDS", 5))


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


def ask_for(daemon, run, seconds):
    host, port = daemon.host.split(":")
    request = f"GET /v1/runs/{run} HTTP/1.1\r\nHost: {daemon.host}\r\n\r\n".encode()
    selector, latencies = selectors.DefaultSelector(), []
    connections = [Connection((host, int(port)), request) for _ in range(CONNECTIONS)]
    for c in connections:
        selector.register(c.socket, selectors.EVENT_READ, c)
    began = time.monotonic()
    sent, total = 0, int(RATE * seconds)
    while len(latencies) < total:
        now = time.monotonic()
        while sent < total and began + sent / RATE <= now:
            connections[sent % CONNECTIONS].send(began + sent / RATE)
            sent += 1
        wait = max(0.0, began + sent / RATE - time.monotonic()) if sent < total else 1.0
        for key, _ in selector.select(wait):
            latencies += key.data.receive()
    for c in connections:
        c.socket.close()
    return latencies


def speed(daemon, run, work):
    """Particle-steps per second of the step loop while `work` is done."""
    before = daemon.act(run, "resume")
    done = work()
    after = daemon.act(run, "pause")
    steps = after["step"] - before["step"]
    seconds = after["performance"]["wall_s"] - before["performance"]["wall_s"]
    return after["particles"] * steps / seconds, done


def main():
    threads = len(os.sched_getaffinity(0))
    latencies, quiet, asked = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        daemon = fbard.Daemon(folder, slots=1, threads=threads)
        daemon.start()
        run = daemon.create(big(16), start=False)["id"]
        speed(daemon, run, lambda: time.sleep(2))
        for _ in range(ROUNDS):
            quiet.append(speed(daemon, run, lambda: time.sleep(SECONDS))[0])
            rate, more = speed(daemon, run, lambda: ask_for(daemon, run, SECONDS))
            asked.append(rate)
            latencies += more
        particles = daemon.run(run)["particles"]
        daemon.away(run)
        daemon.stop()
    latencies.sort()

    def at(share):
        return 1e3 * latencies[min(len(latencies) - 1, int(share * len(latencies)))]

    loss = 1 - statistics.median(asked) / statistics.median(quiet)
    print(f"{len(latencies)} status requests at {RATE}/s over {CONNECTIONS} connections, a run of {particles} particles on "
          f"{threads} threads")
    print(f"latency: median {at(0.5):.2f} ms (wanted <= 2), 99 % {at(0.99):.2f} ms (wanted <= 10), most {at(1):.2f} ms")
    print(f"the run: {statistics.median(quiet) / 1e6:.2f} -> {statistics.median(asked) / 1e6:.2f} million particle-steps/s, "
          f"loss {100 * loss:.1f} % (wanted <= 3), the client's own work on the same cores included")
    print(json.dumps({"median_ms": at(0.5), "p99_ms": at(0.99), "loss": loss, "quiet": quiet, "asked": asked}))


main()
