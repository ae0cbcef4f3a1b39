"""Every `$ wavebatch` command that README and docs print is run, and prints the lines that stand below it.

Lines may be left out of a page, or cut with `...`; each one that is there must be in the output, whatever its spaces.
Numbers may differ a little: processors round in different ways, and a survey may find one echo more.
"""

import contextlib
import os
import re
import shlex
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from wavebatch.cli import main

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(path for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")) if "\n    $ " in path.read_text())
CHAINS = {
    "maximum": ("detect.maximum", "decompose.gaussian"),
    "asdf": ("detect.asdf", "decompose.asdf_only"),
    "adaptive": ("detect.maximum", "decompose.adaptive"),
}
"""Chain files that docs/compare.md describes."""


def list_commands(text):
    """Commands of a page with the lines below each."""
    found = []
    for line in text.splitlines():
        if line.startswith("    $ "):
            found.append((line[6:].split("  #")[0].rstrip(), []))
        elif line.startswith("    ") and found and found[-1] is not None:
            found[-1][1].append(line[4:])
        elif found and found[-1] is not None:
            found.append(None)  # the block has ended
    return [one for one in found if one is not None]


MADE_ELSEWHERE = ["wavebatch compare a.laz b.laz --overlap"]
"""Commands on strips that a page describes in words only."""

TOKEN = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?|#+|[^\d\s#]+")


def split(text):
    """Words, numbers and bars, without what stands between them."""
    return TOKEN.findall(text)


def is_near(one, other):
    """Whether two tokens are the same: numbers within 5 % or three units of the last digit, bars of any length."""
    if one == other or one[0] == other[0] == "#":
        return True
    if not (re.match(r"[-+]?\d", one) and re.match(r"[-+]?\d", other)):
        return False
    a, b = (float(text.replace(",", "")) for text in (one, other))
    digit = 10.0 ** -len(one.partition("e")[0].partition(".")[2]) * 10.0 ** int(one.partition("e")[2] or 0)
    return abs(a - b) <= max(0.05 * abs(a), 3 * digit)


def prints(printed, wanted):
    """Whether the tokens `wanted` stand somewhere in `printed`, side by side."""
    return any(
        all(map(is_near, wanted, printed[start : start + len(wanted)]))
        for start in range(len(printed) - len(wanted) + 1)
    )


@pytest.fixture
def place(riegl, tmp_path, monkeypatch):
    """A folder with the files that the pages speak of."""
    for suffix in (".las", ".wdp"):
        shutil.copy(riegl.with_suffix(suffix), tmp_path / f"strip{suffix}")
    (tmp_path / "cut.las").write_bytes((tmp_path / "strip.las").read_bytes()[:40_000])
    for name, stages in CHAINS.items():
        chain = "".join(f'[[chain]]\nstage = "{stage}"\n' for stage in ("noise.pooled", *stages))
        (tmp_path / f"{name}.toml").write_text(chain)
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_near_is_near():
    assert prints(split("a 1,234 of 2.50% ##"), split("1240 of 2.52% ###"))
    assert not prints(split("a 1,234 of 2.50%"), split("1400 of 2.50%")) and not prints(split("4 DN"), split("4 ns"))


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="paths are printed as POSIX has them")
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_what_a_page_prints_is_what_its_commands_print(page, place):
    wrong = []
    for command, lines in list_commands(page.read_text("utf-8")):
        program, *words = shlex.split(command)
        if program == "cat":
            Path(words[0]).write_text("\n".join(lines))
            continue
        assert program == "wavebatch", command
        if command in MADE_ELSEWHERE:
            continue
        if words[0] == "run" and "--overwrite" not in words:
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(words[words.index("-o") + 1])
        result = CliRunner().invoke(main, words)
        printed = split(result.stdout + " " + result.stderr)
        for line in lines:
            wrong += [f"{command}: {part}" for part in line.split("...") if not prints(printed, split(part))]
    assert not wrong, "\n".join(wrong)
