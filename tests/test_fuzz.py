"""The fuzzer of `tests/fuzzing.py`: what it has found stays mended, it finds planted defects, and two minutes of it."""

import os
import re
import sys
import time

import click
import fuzzing
import pytest
from fuzzing import COMMANDS, Case, Fuzzer, fuzz, load_kept

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks a process per case")


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory):
    return Fuzzer(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.parametrize("case", load_kept(), ids=lambda case: case.kind)
def test_what_failed_once_does_not_fail_again(fuzzer, case):
    assert fuzzer.run(case) == ""


@pytest.mark.parametrize("kind", sorted(COMMANDS))
def test_sound_inputs_do_not_fail(fuzzer, kind):
    """Else the fuzzer would only see how commands refuse."""
    for command in range(len(COMMANDS[kind])):
        assert fuzzer.run(Case(kind, command, [])) == ""
        done = fuzzer.last
        assert done["code"] == 0 or "pip install" in done["err"], done


def _plant(what):
    @click.command(context_settings={"ignore_unknown_options": True})
    @click.argument("words", nargs=-1)
    def main(words):
        what(words)

    return main


def _leave(words):
    with open(words[words.index("-o") + 1], "w") as file:
        file.write("partial")
    click.echo("error: no", err=True)
    sys.exit(1)


def _fail(words):
    raise KeyError("x")


@pytest.mark.parametrize(
    ("what", "why"),
    [
        (_fail, "traceback: .*KeyError"),
        (_leave, "leaves .*a.toml"),
        (lambda words: sys.exit(7), "exit code 7"),
        (lambda words: sys.exit(1), "fails without a word"),
        (lambda words: os.kill(os.getpid(), 9), "ended with status 9"),
        (lambda words: len(b"x" * len(words) * (200 << 20)), "took [0-9]+ MB"),
        (lambda words: time.sleep(60), "ran for more than"),
        (lambda words: click.echo("error: this is a bug", err=True), "says this is a bug"),
        (lambda words: click.echo("a \x07 name", err=True), "control characters"),
    ],
)
def test_the_fuzzer_sees_every_kind_of_failure(fuzzer, monkeypatch, what, why):
    monkeypatch.setattr(fuzzing, "main", _plant(what))
    monkeypatch.setattr(fuzzing, "MOST_SECONDS", 5)
    monkeypatch.setattr(fuzzing, "MOST_MEMORY", 600 << 20)
    assert re.search(why, fuzzer.run(Case("strip.las", 4, [])))


def test_a_failing_case_is_made_small(fuzzer, monkeypatch):
    """Only the edit that matters is kept."""

    def look(words):
        with open(words[0], "rb") as file:
            assert file.read(4) == b"LASF"

    monkeypatch.setattr(fuzzing, "main", _plant(lambda words: look(words[1:])))
    edits = [["set", 500, "00"], ["set", 1, "00"], ["insert", 900, "ff", 3]]
    assert fuzzer.run(Case("strip.las", 2, edits))
    assert fuzzer.shrink(Case("strip.las", 2, edits)).edits == [["set", 1, "00"]]


@pytest.mark.slow
def test_two_minutes_of_damaged_inputs_break_no_promise(tmp_path):
    seed = int(os.environ.get("FUZZ_SEED", "1"))
    said = []
    assert list(fuzz(tmp_path, 120, seed, tell=said.append)) == []
    assert int(said[0].split()[0]) > 100  # cases
