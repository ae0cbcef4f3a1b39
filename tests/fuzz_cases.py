"""The fuzzer of `tests/fuzzing.py`: what it has found stays mended, it finds planted defects, and hundreds of cases."""

import os
import re
import sys
import tempfile
import time
from pathlib import Path

import click
import pytest
from fuzz_inputs import COMMANDS
from fuzz_options import SOUND
from fuzzing import Case, Fuzzer, Limits, fuzz, load_kept

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks a process per case")


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory):
    made = Fuzzer(tmp_path_factory.mktemp("fuzz"))
    yield made
    made.close()


@pytest.mark.parametrize("case", load_kept(), ids=lambda case: case.kind)
def test_what_failed_once_does_not_fail_again(fuzzer, case):
    assert fuzzer.run(case) == ""


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(COMMANDS))
def test_sound_inputs_do_not_fail(fuzzer, kind):
    """Else the fuzzer would only see how commands refuse."""
    for command in COMMANDS[kind]:
        assert fuzzer.run(Case(kind, command, [])) == ""
        done = fuzzer.last
        is_cloud = kind in ("cloud.laz", "cloud.las", "carried.las")
        notes = command.startswith("check") and ("--strict" in command or is_cloud)
        small = "does not show which width" in done["err"]
        # With pyproj, degrees are projected: far from the strip, which is told by the rays.
        far = "--trajectory" in command and "it belongs to another strip" in done["err"]
        assert done["code"] == 0 or notes or small or far or "pip install" in done["err"], (command, done)


@pytest.mark.slow
@pytest.mark.parametrize("command", SOUND.values(), ids=SOUND)
def test_sound_options_do_not_fail(fuzzer, command):
    if "bench" not in command:  # takes seconds
        assert fuzzer.run(Case("options", command, [])) == ""
        assert fuzzer.last["code"] == 0, fuzzer.last


def test_every_kind_of_the_document_is_damaged():
    text = Path(__file__).parents[1].joinpath("docs", "reliability.md").read_text("utf-8")
    assert f"inputs of {len(COMMANDS)} kinds" in " ".join(text.split())


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


def _replace_input(words):
    with open(words[1], "ab") as file:
        file.write(b"x")


def _leave_file_half(words):
    with open(words[words.index("-o") + 1].replace("a.toml", "b.laz"), "wb") as file:
        file.write(b"LASF")


def _leave_temporary(words):
    with open(os.path.join(tempfile.gettempdir(), "x"), "w"):
        pass


def _leave_open(words):
    for _ in range(30):
        os.dup(0)


def _drop(words):
    class Dropped:
        def __del__(self):
            raise ValueError("lost")

    Dropped()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "why"),
    [
        (_fail, "traceback: .*KeyError"),
        (_replace_input, "changes an input"),
        (_leave_file_half, "b.laz is not whole"),
        (_leave_temporary, "leaves in TMPDIR"),
        (_leave_open, "leaves files open"),
        (_drop, "Python dropped ValueError"),
        (lambda words: time.sleep(60), "waits for more than"),
        (_leave, "leaves .*a.toml"),
        (lambda words: sys.exit(7), "exit code 7"),
        (lambda words: sys.exit(1), "fails without a word"),
        (lambda words: os.kill(os.getpid(), 9), "ended with status 9"),
        (lambda words: len(b"x" * len(words) * (200 << 20)), "took [0-9]+ MB"),
        (lambda words: [0 for _ in iter(int, 1)], "ran for more than"),
        (lambda words: click.echo("error: this is a bug", err=True), "says this is a bug"),
        (lambda words: click.echo("a \x07 name", err=True), "control characters"),
        (lambda words: click.echo("a \r name", err=True), "control characters"),
        (lambda words: len(words) > os.write(2, b"x"), "a library writes to stderr"),
    ],
)
def test_the_fuzzer_sees_every_kind_of_failure(fuzzer, what, why):
    limits = Limits(0.3 if "ran" in why else 10, 1 if "waits" in why else 60, 600 << 20)
    planted = Fuzzer(fuzzer.base.parent, _plant(what), limits)
    assert re.search(why, planted.run(Case("strip.las", "survey {input} -o {out}/a.toml", [])))
    planted.close()


@pytest.mark.slow
def test_a_failing_case_is_made_small(fuzzer):
    """Hypothesis finds damage that matters and keeps little else."""

    def look(words):
        for name in words:
            if name.endswith(".las") and os.path.isfile(name):
                with open(name, "rb") as file:
                    assert file.read(4) == b"LASF"

    planted = Fuzzer(fuzzer.base.parent, _plant(look))
    known = set()
    case, why = fuzz(planted, 2000, 1, known, float("inf"))
    assert "AssertionError" in why and len(case.edits) == 1 and len(known) == 1
    assert planted.run(case) and planted.run(case._replace(edits=[])) == ""
    planted.close()


@pytest.mark.quick_cases("30")
@pytest.mark.parametrize("number", [30, 600])
def test_damaged_inputs_break_no_promise(fuzzer, number):
    fresh = Fuzzer(fuzzer.base.parent)
    assert fuzz(fresh, number, int(os.environ.get("FUZZ_SEED", "1")), set(), float("inf")) is None
    assert sum(sum(codes.values()) for name, codes in fresh.codes.items() if name.startswith("[")) >= number
    inside = [codes[0] > 0 for codes in fresh.codes.values()]
    assert number < 600 or sum(inside) > 0.6 * len(inside)  # commands and kinds of which some end well
    fresh.close()
