"""Completion in shells, and results that cannot be printed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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
