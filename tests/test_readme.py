"""The README is short, names every command and profile, and its two first commands are targets of the Makefile."""

import re
from pathlib import Path

import pytest

import wavebatch
from wavebatch.cli import COMMANDS
from wavebatch.stages.chain import list_profiles

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text("utf-8")


def test_it_is_short():
    assert len(TEXT.splitlines()) <= 250


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_is_described(name):
    assert f"| `wavebatch {name}` |" in TEXT


def test_profiles_are_named():
    for name in (*list_profiles(), "auto"):
        assert f"`{name}`" in TEXT


def test_the_first_commands_are_two_targets_of_the_makefile():
    block = re.search(r"## Try it\n\n((?:    .*\n)+)", TEXT).group(1)
    commands = [line.split("#")[0].split() for line in block.splitlines()]
    assert commands == [["make", "demo"], ["make", "test"]]
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for target in re.findall(r"`?make ([a-z]+)", TEXT):
        assert re.search(rf"(?m)^{target}:", makefile), target


def test_the_python_example_uses_public_names():
    names = set(re.findall(r"\bwb\.(\w+)", TEXT))
    assert len(names) > 4 and names <= set(wavebatch.__all__)


def test_versions_agree():
    for name in ("CITATION.cff", "CHANGELOG.md"):
        assert wavebatch.__version__ in (ROOT / name).read_text("utf-8")
