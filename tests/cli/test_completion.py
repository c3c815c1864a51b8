"""Completion: what `fbar __complete` offers, and that the shells' scripts hand it on."""
import os
import shutil
import subprocess
import time

import pytest

import conftest

LONG = bool(os.environ.get("FBARD_LONG"))


ANSWER = 1.0  # s that a completion waits for the daemon (client/complete.c)


def in_time(call):
    """What is offered, by a daemon that answered in time: the tests' own may stand still for longer."""
    for _ in range(20):
        began = time.monotonic()
        offered = call()
        if time.monotonic() - began < ANSWER:
            break
    return offered


def offered(fbar, *words):
    result = in_time(lambda: fbar("__complete", *words))
    assert result.returncode == 0 and not result.stderr, result.stderr
    return [line.split("\t")[0] for line in result.stdout.splitlines()]


def test_commands_and_options_come_from_the_tables(fbar):
    commands = offered(fbar, "")
    shown = fbar("help").stdout
    assert len(commands) > 20 and all(f"\n  {c} " in shown for c in commands if c != "help")
    assert offered(fbar, "re") == ["resume", "record", "recover"]
    assert offered(fbar, "help", "reco") == ["record", "recover"]
    for command in ("run", "list", "plot"):
        shown = fbar(command, "--help").stdout
        assert all(f"{option} " in shown for option in offered(fbar, command, "--")), command
    assert offered(fbar, "plot", "a.h5", "--fi") == ["--field"]
    assert offered(fbar, "nonsense", "") == []


def test_files_are_left_to_the_shell(fbar):
    assert offered(fbar, "info", "") == [":files *.h5"]
    assert offered(fbar, "record", "r1", "-o", "") == [":files *.h5"]
    assert offered(fbar, "plot", "a.h5", "b.h5", "") == [":files *.h5"]
    assert offered(fbar, "--token-file", "") == [":files"]
    assert offered(fbar, "keygen", "") == [":folders"]
    assert offered(fbar, "info", "a.h5", "") == []
    assert offered(fbar, "completion", "") == ["bash", "zsh"]


def test_runs_scenes_and_keys_come_from_the_daemon(fbar, fake):
    daemon = fake()
    url = ["--url", daemon.url]
    assert offered(fbar, *url, "show", "") == ["r1"]
    assert offered(fbar, "show", *url, "r") == ["r1"]
    assert offered(fbar, *url, "show", "x") == []
    assert offered(fbar, *url, "show", "r1", "") == []
    assert offered(fbar, *url, "run", "f") == ["fake", ":files *.json"]
    assert offered(fbar, *url, "scenes", "") == ["fake"]
    assert offered(fbar, *url, "set", "r1", "time") == ["time="]  # of the fake's flat configuration
    assert offered(fbar, "--url", "http://127.0.0.1:1", "show", "") == []


def test_fields_come_from_the_recording(fbar, fake):
    daemon = fake(n_frames=2)
    daemon.advance(2, live=False)
    assert fbar("record", "r1", "-o", "a.h5", url=daemon.url).returncode == 0
    assert offered(fbar, "plot", "a.h5", "--field", "") == ["id", "mean_stress", "stress", "velocity"]


@pytest.mark.skipif(not os.access(conftest.FBARD, os.X_OK), reason="fbard is not built")
def test_scenes_are_known_without_a_daemon(fbar):
    assert "dam-break" in offered(fbar, "run", "dam")


def test_bash_script_completes(fbar, fake, tmp_path):
    daemon = fake()
    (tmp_path / "a.h5").touch()
    (tmp_path / "a.txt").touch()
    (tmp_path / "completion").write_text(fbar("completion", "bash").stdout)

    def complete(*words):
        line = " ".join(f'"{w}"' for w in ("fbar", "--url", daemon.url, *words))
        done = in_time(lambda: subprocess.run(["bash", "-c", f"""
            compopt() {{ :; }}  # there is no line to complete
            source ./completion && complete -p fbar >/dev/null || exit 1
            COMP_WORDS=({line}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
            _fbar {conftest.FBAR}; printf '%s\\n' "${{COMPREPLY[@]}}" """], cwd=tmp_path, text=True,
            capture_output=True, env=conftest.environment()))  # fmt: skip
        assert done.returncode == 0 and not done.stderr, done.stderr
        return done.stdout.split()

    assert complete("show", "r") == ["r1"]
    assert complete("res") == ["resume"]
    assert complete("info", "a") == ["a.h5"]


@pytest.mark.skipif(not LONG and not shutil.which("zsh"), reason="zsh is not installed")
def test_zsh_script_completes(fbar, fake, tmp_path):
    daemon = fake()
    (tmp_path / "_fbar").write_text(fbar("completion", "zsh").stdout)

    def complete(*words):
        line = " ".join(f'"{w}"' for w in (conftest.FBAR, "--url", daemon.url, *words))
        done = subprocess.run(["zsh", "-f", "-c", f"""
            compdef() {{ :; }}  # what stands in for the completion system shows what it is given
            _files() {{ print files "$@"; }}
            _describe() {{ local list=${{@[4]}}; print -l -- "${{(@P)list}}"; }}
            source ./_fbar
            words=({line}); CURRENT=$#words; _fbar"""], cwd=tmp_path, text=True, capture_output=True,
            env=conftest.environment())  # fmt: skip
        assert done.returncode == 0 and not done.stderr, done.stderr
        return done.stdout.splitlines()

    assert complete("show", "r") == ["r1:running"]
    assert complete("info", "") == ["files -g *.h5"]
    assert complete("res") == ["resume:continue a paused run"]
