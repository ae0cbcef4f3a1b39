"""Wrong usage of any command is one line on stderr that says where help is, and exit code 2.

Plausible mistakes of a first hour: the line says what to do next, not only what is wrong.
"""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from commands import run_command, succeed
from strips import cut_strip, place_header

from wavebatch.cli import COMMANDS, main
from wavebatch.files.text_file import find_files


def invoke(*arguments):
    return run_command(*arguments, prog_name="wavebatch")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_says_what_its_exit_codes_are(name):
    result = invoke(name, "--help")
    assert result.exit_code == 0 and result.stderr == ""
    words = " ".join(result.stdout.split())
    assert name == "plot" or name == "stages" or "Exit code" in words


def test_options_that_commands_share_have_one_name():
    short = {"-o": "--output", "-q": "--quiet", "-v": "--verbose", "-c": "--chain", "-h": "--help"}
    for name in COMMANDS:
        command = main.get_command(None, name)
        parts = [command, *getattr(command, "commands", {}).values()]
        options = [option for part in parts for option in part.params if option.param_type_name == "option"]
        for option in options:
            for flag in set(option.opts) & set(short):
                assert short[flag] in option.opts, f"{name}: {option.opts}"
            assert all(opt.startswith("--") or opt in short for opt in option.opts), f"{name}: {option.opts}"


@pytest.fixture
def place(tmp_path, tiny_strip, monkeypatch):
    """A folder to work in, with a strip."""
    shutil.copy(tiny_strip, tmp_path / "strip.las")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_home_folder_is_found_in_lists_and_quotes(place, monkeypatch):
    monkeypatch.setenv("HOME", str(place))
    monkeypatch.setenv("USERPROFILE", str(place))
    (place / "sub").mkdir()
    (place / "sub" / "list.txt").write_text("~/strip.las\n")
    assert find_files(["@sub/list.txt"]) == find_files(["~/strip.las"]) == [place / "strip.las"]
    (place / "~odd.las").touch()  # a file of such a name stays a file
    assert [path.name for path in find_files(["~odd.las"])] == ["~odd.las"]


def test_stages_lists_those_of_a_kind():
    result = run_command("stages", "decompose")
    names = [line.split()[0] for line in result.stdout.splitlines()]
    assert result.exit_code == 0 and "decompose.residual_loop" in names
    assert all(name.startswith("decompose.") for name in names)


def test_clouds_without_an_echo_in_common_are_doubted(place):
    place_header(place / "strip.las", lambda old: old + 1e5 * (np.arange(12) == 3), place / "moved.las")
    result = run_command("compare", "strip.las", "moved.las")
    assert result.exit_code == 0 and "warning: A and B have no echo in common" in result.stderr
    assert "identical         0\n" in result.stdout and "100.00%" not in result.stdout  # not a line for each class
    result = run_command("compare", "strip.las", "strip.las")
    assert "in common" not in result.stderr


def test_strips_that_share_their_times_only_are_doubted(place):
    """Other scenes have the GPS times of the strip: one echo in a hundred agrees by chance."""
    for scene in ("urban", "mixed"):
        words = ["simulate", scene, "-o", f"{scene}.las", "--pulses", "500", "-q"]
        assert run_command(*words).exit_code == 0
    assert "echoes in common; are they results of one strip" in succeed("compare", "urban.las", "mixed.las").stderr
    result = run_command("compare", "urban.las", "mixed.las", "--within", "0.5")
    assert "echoes in common" not in result.stderr


def test_points_are_shown_where_the_packets_are_missing(place):
    content = bytearray((place / "strip.las").read_bytes())
    content[6:8] = bytes((0b101, 0))  # global encoding: packets in a .wdp
    (place / "lost.las").write_bytes(content)
    shown = run_command("info", "lost.las")
    assert shown.exit_code == 1 and "points         " in shown.stdout and "classes " in shown.stdout
    assert shown.stderr == "error: lost.las: its packets are missing: put lost.wdp next to the strip\n"
    assert shown.stdout.splitlines()[-1].split(maxsplit=1) == [
        "problem", "its packets are missing: put lost.wdp next to the strip"
    ]  # fmt: skip


def test_strips_without_points_pass_through_every_stage(place):
    empty = cut_strip(place / "strip.las", place / "empty.las", 0)
    columns = "+range,+incidence_angle_normals,+amplitude_normalized"
    succeed("run", empty, "-o", "o", "--columns", columns)
    assert "warning: the strip has no points, so its cloud has none" in succeed("run", empty, "-o", "q", "-q").stderr
    assert run_command("check", empty).stdout.endswith("ok (0 points, 0 packets)\n")
    one = cut_strip(place / "strip.las", place / "one.las", 1)
    assert "ok (1 point, 1 packet, " in run_command("check", one).stdout
    shown = run_command("compare", "o/empty.laz", empty).stdout
    assert "nan" not in shown and "completeness      no-data\ncorrectness       no-data\n" in shown


@pytest.mark.quick_cases("*--help", "*check strip.las --json")
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is full")
@pytest.mark.parametrize("words", ["--help", "info strip.las", "check strip.las --json", "stats strip.las", "stages"])
@pytest.mark.parametrize(
    ("to", "problem"), [("/dev/full", "No space left on device"), ("&-", "Bad file descriptor")], ids=["full", "closed"]
)
def test_a_stdout_that_cannot_be_written_is_named(place, words, to, problem):
    """A result went nowhere with exit code 0 where a service or a script had closed stdout."""
    command = f"'{sys.executable}' -m wavebatch {words} >{to}"
    done = subprocess.run(command, shell=True, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, f"error: stdout: cannot be written: {problem}\n")


@pytest.mark.parametrize("words", ["--help", "info strip.las", "check strip.las --json", "stats strip.las"])
def test_a_reader_that_has_gone_ends_a_command_quietly_and_not_as_a_problem(place, words):
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "wavebatch", *words.split()], stdout=writer, stderr=subprocess.PIPE,
                          text=True, check=False)  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_cloud_without_permission_is_one_of_those_that_cannot_be_read(place, monkeypatch):
    """Not wrong usage: the others are counted. Root may read everything, so click's question is answered with no."""
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    (place / "other.las").write_bytes(b"no permission")
    result = run_command("stats", "strip.las", "other.las")
    assert result.exit_code == 1 and "strip.las" in result.stdout and "not a LAS or LAZ file" in result.stderr
