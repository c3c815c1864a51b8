#!/usr/bin/env python3
"""How long the tutorial takes: the commands of docs/tutorial.md, word for word, in a clone of this repository with an
empty home, one after the other. What a reader takes to read and look is not in it. CC="ccache gcc" shows the build where
all has been compiled before."""
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[1]


def lines():
    text = (ROOT / "docs" / "tutorial.md").read_text()
    return [line for block in re.findall(r"^```sh\n(.*?)^```$", text, re.M | re.S) for line in block.splitlines() if line.strip()]


def main():
    with tempfile.TemporaryDirectory() as folder:
        clone, home = pathlib.Path(folder) / "fbard", pathlib.Path(folder) / "home"
        home.mkdir()
        subprocess.run(["git", "clone", "--quiet", "--local", ROOT, clone], check=True)
        kept = {k: v for k, v in os.environ.items() if k in ("PATH", "CC", "LANG") or k.startswith("CCACHE_")}
        environment, daemons, total = {**kept, "HOME": str(home), "TMPDIR": folder}, [], 0
        try:
            for line in lines():
                began = time.monotonic()
                command = line.split("#")[0].strip()
                if command.endswith("&"):
                    daemons.append(subprocess.Popen(command[:-1].split(), cwd=clone, env=environment, stderr=subprocess.DEVNULL))
                    time.sleep(1)
                else:
                    done = subprocess.run(["bash", "-c", command], cwd=clone, env=environment, capture_output=True, text=True)
                    if done.returncode != 0:
                        sys.exit(f"{command}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
                total += time.monotonic() - began
                print(f"{time.monotonic() - began:7.1f} s  {command}", flush=True)
            print(f"{total:7.1f} s  in all, on {len(os.sched_getaffinity(0))} cores")
        finally:
            for daemon in daemons:
                daemon.send_signal(signal.SIGTERM)
                daemon.wait()


if __name__ == "__main__":
    main()
