"""Completion in shells, and results that cannot be printed."""

import os
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wavebatch.cli.program.command import complete_files

ROOT = Path(__file__).parents[2]
PROGRAM = "from wavebatch.cli import main; main.main(prog_name='wavebatch')"


def complete(words, number, shell="bash"):
    """What the program offers for the word `number`."""
    environment = {
        **os.environ, "PYTHONPATH": str(ROOT), "COMP_WORDS": words, "COMP_CWORD": str(number),
        "_WAVEBATCH_COMPLETE": f"{shell}_complete",
    }  # fmt: skip
    result = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    return result.stdout.split()


@pytest.mark.quick_cases("run", "voxelize", "stats")
@pytest.mark.parametrize("command", ["run", "info", "survey", "voxelize", "slice", "check", "stats"])
def test_arguments_are_files(command):
    assert complete(f"wavebatch {command} fl", 2) == ["file,fl"]


def test_commands_profiles_and_choices():
    assert complete("wavebatch vox", 1) == ["plain,voxelize"]
    assert complete("wavebatch run --profile a", 3) == ["plain,auto", "plain,accurate"]
    assert complete("wavebatch run --names p", 3) == ["plain,pdal"]
    assert complete("wavebatch run --las", 2) == ["plain,--las-version"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_a_real_bash_completes_file_names(tmp_path):
    (tmp_path / "flight 7.las").touch()
    program = tmp_path / "wavebatch"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "{PROGRAM}" "$@"\n')
    program.chmod(0o755)
    script = """
        eval "$(_WAVEBATCH_COMPLETE=bash_source ./wavebatch)"
        COMP_WORDS=(./wavebatch run --profile ba) COMP_CWORD=3
        _wavebatch_completion ./wavebatch
        echo "${COMPREPLY[@]}"
        complete -p wavebatch
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    run = subprocess.run(["bash", "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert "balanced" in run.stdout.splitlines() and "-F _wavebatch_completion wavebatch" in run.stdout, run.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_its_script(shell):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "_WAVEBATCH_COMPLETE": f"{shell}_source"}
    result = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert f"_WAVEBATCH_COMPLETE={shell}_complete" in result.stdout

@pytest.mark.quick_cases("*drop-flags*", "*+ran*", "*decompose.resid*", "*bench*")
@pytest.mark.parametrize(
    ("words", "number", "offers"),
    [
        ("wavebatch run a --drop-flags weak,ring", 4, ["weak,RINGING_SUSPECT"]),
        ("wavebatch plot map a --drop-flags NO_E", 5, ["NO_ECHO"]),
        ("wavebatch run a --columns +ran", 4, ["+range", "+range_err", "+range_error"]),
        ("wavebatch run a --columns +range,+rang", 4, ["+range,+range_err", "+range,+range_error"]),
        ("wavebatch grid a --column echo_w", 4, ["echo_width", "echo_width_err"]),
        ("wavebatch stages decompose.resid", 2, ["decompose.residual_loop"]),
        ("wavebatch simulate fore", 2, ["forest"]),
        ("wavebatch bench --scene fore", 3, ["forest"]),
    ],
)
def test_names_of_flags_columns_stages_and_scenes(words, number, offers):
    assert complete(words, number) == [f"plain,{offer}" for offer in offers]


def test_lists_are_completed_with_their_sign(tmp_path, monkeypatch):
    (tmp_path / "strips").mkdir()
    (tmp_path / "strips" / "strip list.txt").touch()
    monkeypatch.chdir(tmp_path)
    assert complete("wavebatch run @str", 2) == ["plain,@strips/"]
    assert [item.value for item in complete_files(None, None, "@strips/st")] == ["@strips/strip list.txt"]
    assert complete_files(None, None, "@nowhere/x") == []


STARTS = {
    "bash": (["bash", "--norc", "-i"], 'eval "$(_WAVEBATCH_COMPLETE=bash_source wavebatch)"'),
    "zsh": (["zsh", "-f", "-i"],
            'autoload -U compinit; compinit -u; eval "$(_WAVEBATCH_COMPLETE=zsh_source wavebatch)"'),
    "fish": (["fish", "--no-config", "-i"], "_WAVEBATCH_COMPLETE=fish_source wavebatch | source"),
}  # fmt: skip
TYPED = {
    "wavebatch run --profile ba\t": "--profile balanced",
    "wavebatch run fl\t": "flight\\ 7.las",
    "wavebatch run --system oth\t": "--system other.toml",
    "wavebatch plot histogram Ü\t": "histogram Übung.laz",
    "wavebatch vox\t": "wavebatch voxelize",
    "wavebatch check @oth\t": "check @other.toml",
}


@pytest.mark.parametrize("shell", STARTS)
def test_a_terminal_completes_names_after_tab(shell, tmp_path):
    """Keys are typed into a real shell in a terminal of its own; the shell starts as docs/index.md says."""
    if shutil.which(shell) is None or not hasattr(os, "fork"):
        pytest.skip(f"{shell} is not installed")
    for name in ("flight 7.las", "other.toml", "Übung.laz"):
        (tmp_path / name).touch()
    program = tmp_path / "bin" / "wavebatch"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "{PROGRAM}" "$@"\n')
    program.chmod(0o755)
    words, start = STARTS[shell]
    assert start.split("; ")[-1] in (ROOT / "docs" / "index.md").read_text("utf-8")
    environment = {
        **os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        "TERM": "dumb", "HOME": str(tmp_path), "LC_ALL": "C.UTF-8",
    }  # fmt: skip
    terminal = [sys.executable, "-c", "import pty, sys; pty.spawn(sys.argv[1:])", *words]
    with subprocess.Popen(terminal, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=tmp_path, env=environment,
                          start_new_session=True) as child:  # fmt: skip
        try:
            _talk(child, start + "; echo rea''dy\n", "ready")
            for keys, shown in TYPED.items():
                _talk(child, keys, shown)
                _talk(child, "\x15echo n''ext\n", "next")  # first kills the line
        finally:
            os.killpg(child.pid, signal.SIGKILL)


def _talk(child, keys, wanted, seconds=100.0):
    """Types keys and waits until the terminal shows the text."""
    child.stdin.write(keys.encode())
    child.stdin.flush()
    shown, end = b"", time.monotonic() + seconds
    while wanted.encode() not in shown:
        assert time.monotonic() < end, (keys, wanted, shown.decode(errors="replace"))
        if select.select([child.stdout], [], [], 0.2)[0]:
            shown += os.read(child.stdout.fileno(), 65536)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["stages"], ["stages", "--help"], ["run", "-h"]])
def test_a_full_disk_behind_stdout_is_one_line(arguments):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "wavebatch", *arguments], stdout=full, stderr=subprocess.PIPE, env=environment
        )
    (line,) = result.stderr.decode().splitlines()
    assert result.returncode == 1 and line.startswith("error: ") and "No space left on device" in line
    assert "bug" not in line
