#!/usr/bin/python3
"""shake.py freeze|starve COMMAND...: runs the command and disturbs what it has started, as busy machines do.

freeze: one or two of its processes stand still (SIGSTOP) for up to 0.4 s, now and then for up to 2.5 s, again and again.
starve: one or two of its threads get a core only where nothing else wants it (SCHED_IDLE), while as many processes as there
are cores compute. Nothing but the command's descendants is touched; those with SHAKE=no in their environment are left alone.
FBARD_SEED picks other victims. Exits as the command does."""
import contextlib
import ctypes
import os
import pathlib
import random
import signal
import subprocess
import sys
import time

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
prctl = ctypes.CDLL(None).prctl


def burn():
    child = os.fork()
    if child == 0:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        os.nice(5)
        while True:
            pass
    return child


def stat(process):
    """(parent, state), or (0, "") of one that is gone."""
    try:
        fields = pathlib.Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return int(fields[1]), fields[0]
    except OSError:
        return 0, ""


def victims(burners):
    """Descendants that run or wait; not those that are stopped, by a test or by a debugger, and not those that ended."""
    parent = {int(p.name): stat(p.name)[0] for p in pathlib.Path("/proc").iterdir() if p.name.isdigit()}
    found, todo = [], [os.getpid()]
    while todo:
        above = todo.pop()
        below = [p for p, q in parent.items() if q == above and p not in burners]
        todo += below
        for process in below:
            with contextlib.suppress(OSError):
                left_alone = b"SHAKE=no" in pathlib.Path(f"/proc/{process}/environ").read_bytes().split(b"\0")
                if stat(process)[1] in ("R", "S", "D") and not left_alone:
                    found.append(process)
    return found


def freeze(random_, processes, seconds):
    stopped = []
    for process in random_.sample(processes, min(len(processes), random_.choice([1, 1, 1, 2]))):
        with contextlib.suppress(OSError):
            os.kill(process, signal.SIGSTOP)
            stopped.append(process)
    try:
        time.sleep(seconds)
    finally:
        for process in stopped:
            with contextlib.suppress(OSError):
                os.kill(process, signal.SIGCONT)


def starve(random_, processes, seconds):
    starved = []
    with contextlib.suppress(OSError):
        threads = [int(t) for t in os.listdir(f"/proc/{random_.choice(processes)}/task")]
        for thread in random_.sample(threads, min(len(threads), random_.choice([1, 1, 2]))):
            os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))
            starved.append(thread)
    time.sleep(seconds)
    for thread in starved:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def main(way, *command):
    shake = {"freeze": freeze, "starve": starve}[way]
    random_ = random.Random(int(os.environ.get("FBARD_SEED", 1)))
    prctl(PR_SET_CHILD_SUBREAPER, 1)  # what its parent has left is a descendant all the same
    burners = [burn() for _ in range(os.cpu_count())] if way == "starve" else []
    child, long_at = subprocess.Popen(command), time.monotonic()
    while child.poll() is None:
        time.sleep(random_.choice([0.002, 0.01, 0.05, 0.1, 0.2]) * random_.uniform(0.5, 1.5))
        seconds = random_.choice([0.001, 0.005, 0.02, 0.06, 0.15, 0.4]) * random_.uniform(0.3, 1)
        if way == "freeze" and time.monotonic() - long_at > 15:
            seconds, long_at = random_.uniform(1, 2.5), time.monotonic()
        if processes := victims(burners):
            shake(random_, processes, seconds)
    for burner in burners:
        os.kill(burner, signal.SIGKILL)
    return child.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
