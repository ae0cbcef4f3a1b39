"""The README names every command, column, flag, profile and exit code, and its chain loads."""

import re
import textwrap
from pathlib import Path

import pytest

from wavebatch.cli import COMMANDS
from wavebatch.core.echoes import COLUMNS, FLAG_MEANINGS, EchoFlag
from wavebatch.stages.chain_file import list_profiles, parse_chain

TEXT = (Path(__file__).resolve().parent.parent / "README.md").read_text("utf-8")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_is_described(name):
    assert f"| `wavebatch {name}` |" in TEXT


@pytest.mark.parametrize("column", [c for c in COLUMNS.values() if c.extra_bytes], ids=lambda column: column.name)
def test_every_column_is_described_as_it_is_declared(column):
    assert f"| {column.name} | {column.unit} | {column.meaning} |" in TEXT


@pytest.mark.parametrize("flag", list(EchoFlag), ids=lambda flag: flag.name)
def test_every_flag_is_described_as_it_is_declared(flag):
    assert f"| {int(flag)} | {flag.name} | {FLAG_MEANINGS[flag]} |" in TEXT


def test_profiles_are_named():
    for name in list_profiles():
        assert name in TEXT


def test_the_chain_in_it_loads():
    block = re.search(r"(?m)^    \[\[chain\]\]\n(?:    .*\n|\n)+", TEXT)
    assert len(parse_chain(textwrap.dedent(block.group()), "README").steps) == 5
