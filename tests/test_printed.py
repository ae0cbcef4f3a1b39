"""Every `$ wavebatch` command that README and docs print is run, and prints the lines that stand below it.

Lines may be left out of a page, or cut with `...`; each one that is there must be in the output, whatever its spaces.
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


def squeeze(text):
    """Only single spaces, no lines."""
    return " ".join(text.split())


@pytest.fixture
def place(riegl, tmp_path, monkeypatch):
    """A folder with the files that the pages speak of."""
    for suffix in (".las", ".wdp"):
        shutil.copy(riegl.with_suffix(suffix), tmp_path / f"strip{suffix}")
    (tmp_path / "cut.las").write_bytes((tmp_path / "strip.las").read_bytes()[:40_000])
    for name, stages in CHAINS.items():
        chain = "".join(f'[[chain]]\nstage = "{stage}"\n' for stage in ("noise.pooled", *stages))
        (tmp_path / f"{name}.toml").write_text(chain)
    monkeypatch.chdir(tmp_path)
    return tmp_path


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
        if words[0] == "run" and "--overwrite" not in words:
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(words[words.index("-o") + 1])
        result = CliRunner().invoke(main, words)
        printed = squeeze(result.stdout + " " + result.stderr)
        for line in lines:
            parts = [squeeze(part) for part in re.split(r"\.\.\.", line)]
            wrong += [f"{command}: {part}" for part in parts if part not in printed]
    assert not wrong, "\n".join(wrong)
