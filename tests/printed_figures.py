"""Figures that README and docs print: runs the commands of their blocks, and writes what they print into the blocks.

    python tests/printed_figures.py [PAGE ...]   (`make figures`; needs a RIEGL LMS-Q680i strip, see strips_of)

A block is indented by four blanks; below `$ wavebatch ...` stand lines of what the command prints. A page may leave
lines out, cut one with `...`, and set blanks as it likes; its words and numbers must stand side by side in the output.
`tests/test_printed.py` compares them without tolerance: the same strip gives the same bytes everywhere.
"""

import contextlib
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from commands import run_command

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(path for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
               if "\n    $ " in path.read_text("utf-8"))  # fmt: skip

MADE_ELSEWHERE = ["wavebatch compare a.laz b.laz --overlap"]
"""Commands on strips that a page describes in words only."""

TOKEN = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?|#+|[^\d\s#]+")


def split(text: str) -> list[str]:
    """Words, numbers and bars, without what stands between them."""
    return TOKEN.findall(text)


def is_alike(one: str, other: str) -> bool:
    """Whether two tokens are the same word, or both are figures or bars."""
    return one == other or bool(re.match(r"[-+]?\d|#", one) and re.match(r"[-+]?\d|#", other))


def find_tokens(printed: list[str], wanted: list[str], begin: int) -> tuple[int, list[str]] | None:
    """Place and tokens of the output with the words of `wanted`, side by side: with most numbers in common, then first.

    Those from `begin` on go first: an output may say the same words of two tables.
    """
    size = len(wanted)
    for places in (range(begin, len(printed) - size + 1), range(min(begin, len(printed) - size + 1))):
        parts = ((place, printed[place : place + size]) for place in places)
        alike = [found for found in parts if all(map(is_alike, found[1], wanted))]
        if alike:
            return max(alike, key=lambda found: sum(map(str.__eq__, found[1], wanted)))
    return None


def renew(line: str, printed: list[str], begin: int = 0) -> tuple[str, int] | None:
    """A line of a page with the figures of the output, columns kept, and where it ends; None without its words."""
    parts = line.split("...")
    for number, part in enumerate(parts):
        wanted = split(part)
        found = find_tokens(printed, wanted, begin)
        if found is None:
            return None
        begin = found[0] + len(wanted)
        for place, token in reversed(list(zip(TOKEN.finditer(part), found[1], strict=True))):
            start, end = place.span()
            grown = len(token) - (end - start)
            room = len(part[:start]) - len(part[:start].rstrip(" ")) - 2
            if grown > 0:
                start -= max(0, min(grown, room))
            elif room >= 0:
                token = " " * -grown + token
            part = part[:start] + token + part[end:]
        parts[number] = part
    return "...".join(parts), begin


def list_blocks(text: str) -> Iterator[tuple[str, range]]:
    """Each command of a page, and the numbers of the lines of its output."""
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if line.startswith("    $ "):
            end = number + 1
            while end < len(lines) and lines[end].startswith("    ") and not lines[end].startswith("    $ "):
                end += 1
            yield line[6:].split("  #")[0].rstrip(), range(number + 1, end)


def renew_page(text: str) -> tuple[str, list[str]]:
    """The page with the figures of its commands, run in order in the current folder, and what else is wrong in it."""
    lines, wrong = text.splitlines(), []
    for command, places in list_blocks(text):
        program, *words = shlex.split(command)
        if program == "cat":
            Path(words[0]).write_text("".join(f"{lines[place][4:]}\n" for place in places), "utf-8")
        elif command not in MADE_ELSEWHERE:
            done = run_command(*words)
            printed = split(f"{done.stdout} {done.stderr}")
            if done.exit_code and words[0] != "check":
                wrong.append(f"{command}: exit code {done.exit_code}: {done.stderr}")
            begin = 0
            for place in places:
                found = renew(lines[place], printed, begin)
                if found is None:
                    wrong.append(f"{command}: does not print: {lines[place].strip()}")
                else:
                    lines[place], begin = found
    return "\n".join(lines) + "\n", wrong


def strips_of(riegl: Path, folder: Path) -> None:
    """Put the files that the pages speak of into a folder; riegl: the public strip with its .wdp, .pls and .wvs."""
    for suffix, name in ((".las", "strip"), (".wdp", "strip"), (".pls", "line"), (".wvs", "line")):
        shutil.copy(riegl.with_suffix(suffix), folder / f"{name}{suffix}")
    (folder / "cut.las").write_bytes((folder / "strip.las").read_bytes()[:40_000])
    shutil.copytree(ROOT / "examples", folder / "examples")


def main_program() -> None:
    """Rewrite the pages that are named, or all; exit code 1 where a page has words that are not printed."""
    given = Path(os.environ.get("WAVEBATCH_DATA", ROOT.parent / "shared" / "data"))
    riegl = next(path for path in sorted(given.rglob("*.las")) if path.with_suffix(".pls").exists())
    failed = False
    for page in [Path(name).resolve() for name in sys.argv[1:]] or PAGES:
        with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
            strips_of(riegl, Path(place))
            text, wrong = renew_page(page.read_text("utf-8"))
        changed = text != page.read_text("utf-8")
        page.write_text(text, "utf-8")
        print(f"{page.relative_to(ROOT)}: {'written' if changed else 'is up to date'}", *wrong, sep="\n  ")
        failed = failed or bool(wrong)
    sys.exit(failed)


if __name__ == "__main__":
    main_program()
