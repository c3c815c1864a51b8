"""Ports for those that go away and come back at the same address."""
import contextlib
import pathlib
import random
import socket


def fixed(count):
    """So many free ports of 127.0.0.1 that nobody is given meanwhile: not of those that the kernel picks from for port 0 and
    for the near end of connections. (A client that asks for a port of that range again and again, where nobody listens, may
    even be connected to itself.)"""
    low, high = map(int, pathlib.Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split())
    others = [*range(max(1025, low - 10_000), low), *range(high + 1, 65_536)] or range(low, high + 1)
    ports = []
    with contextlib.ExitStack() as held:
        while len(ports) < count:
            s = held.enter_context(socket.socket())
            with contextlib.suppress(OSError):  # taken
                s.bind(("127.0.0.1", random.choice(others)))
                ports.append(s.getsockname()[1])
    return ports
