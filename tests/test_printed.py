"""Every command that README, docs and examples show is run on an empty disk; what they print is compared.

Below a `$ wavebatch` command stand lines of its output, which it must print (tests/printed_figures.py). All others
must end with exit code 0.
"""

import glob
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command, succeed
from printed_figures import PAGES, renew, renew_page, split, strips_of

from wavebatch.cli import COMMANDS

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def place(riegl, tmp_path, monkeypatch):
    """A folder with the files that the pages speak of."""
    strips_of(riegl, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_figures_are_made_anew_and_columns_kept():
    printed = split("strip.las: 2535 points, 2,672 echoes, ... all      12.5 % ####")
    new = "    strip.las: 2535 points, 2,672 echoes, ..."
    assert renew("    strip.las: 2530 points, 999 echoes, ...", printed)[0] == new
    assert renew("    all       9.81 % ##", printed)[0] == "    all       12.5 % ####"
    assert renew("    all     1009.81 %", printed)[0] == "    all        12.5 %"
    assert renew("    none      9.81 %", printed) is None
    assert renew("    2 echoes", split("1 points 1 echoes 2 echoes"))[0] == "    2 echoes"


def test_figures_of_a_second_table_come_from_it():
    printed = split("missed 4 a 1 b 2 extra 5 a 7 b 8")
    line, begin = renew("    extra 9", printed)
    assert (line, renew("    b 2", printed, begin)[0]) == ("    extra 5", "    b 8")
    assert renew("    missed 3", printed, begin)[0] == "    missed 4"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="paths are printed as POSIX has them")
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_what_a_page_prints_is_what_its_commands_print(page, place):
    """To the digit, in order, on an empty disk; `make figures` rewrites what differs."""
    text = page.read_text("utf-8")
    found, wrong = renew_page(text)
    assert not wrong, "\n".join(wrong)
    assert found.splitlines() == text.splitlines()


_NAMES = "|".join(COMMANDS)
COMMAND = re.compile(rf"(?m)^(?:    |#   |)((?:\d+ \d+ \* \* \*  )?(?:wavebatch (?:{_NAMES})|make -C) .*?)\s*$")
"""A line of a block, of a chain file's head or of a crontab."""

WITH_EXAMPLES = (ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").rglob("*.toml"),
                 *(ROOT / "examples").rglob("Makefile"))  # fmt: skip
SHOWN = {
    str(path.relative_to(ROOT)): lines
    for path in sorted(WITH_EXAMPLES)
    # The blocks of these two are run by test_recipes.py and test_docs.py.
    if path.name not in ("recipes.md", "extending.md") and (lines := COMMAND.findall(path.read_text("utf-8")))
}
MADE_BEFORE = {
    "strip.laz": "simulate urban -o strip.laz --pulses 3000",
    "clouds": "run strip.las a.las -o clouds --profile fast",
    "clouds/strip.laz": "run strip.las -o clouds --profile fast --resume",
}
"""Files that a line reads, and what makes them."""
ELSEWHERE = (
    "wavebatch plot waveform 100429_152240_2535pt_UTM.las --random 64 --seed 1 --sheet -o sheet.png",
    "wavebatch calibrate strips/*.laz --targets targets.csv -o cal.toml --report cal.json --html cal.html",
)
"""Lines on strips that only the page describes, and one that takes many minutes; their commands have tests."""


@pytest.fixture
def disk(riegl, tiny_strip, tmp_path, monkeypatch):
    """A disk with the strips that the lines name, in a folder of their own and in /data, and nothing else."""
    data = tmp_path / "data"
    for folder in ("flight7", "strips", "data/new", "data/flight7"):
        (tmp_path / folder).mkdir(parents=True)
        for name in ("a.las", "b.las"):
            shutil.copy(tiny_strip, tmp_path / folder / name)
    for suffix in (".las", ".wdp"):
        shutil.copy(riegl.with_suffix(suffix), tmp_path / f"strip{suffix}")
    for name in ("a.las", "b.las", "c.las"):
        shutil.copy(tiny_strip, tmp_path / name)
    (tmp_path / "more.txt").write_text("c.las\n")
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    return data


def run_program(*words):
    """The process of a program that finds this checkout."""
    return subprocess.run(words, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})


def run_line(line, data):
    """The line as a shell would run it: without remark and schedule, and with /data where it is here."""
    line = re.sub(r"^\d+ \d+ \* \* \*  ", "", line.split("  #")[0]).replace("/data", str(data))
    if line.startswith("make"):
        line += f" WAVEBATCH='{sys.executable} -m wavebatch'"
        done = run_program(*shlex.split(line))
        return f"{line}: {done.stderr}" if done.returncode else ""
    words = [name for word in shlex.split(line)[1:] for name in (sorted(glob.glob(word)) or [word])]
    done = run_command(*words)
    return f"{line}: {done.output}" if done.exit_code else ""


def make_inputs(line):
    """What a line reads and another page or line has made before it."""
    for name, words in MADE_BEFORE.items():
        if re.search(rf"(?<![\w/-]){re.escape(name)}(?![\w.])", line.partition(" -o ")[0]) and not Path(name).exists():
            succeed(*shlex.split(words))


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt" or shutil.which("make") is None, reason="lines are for a POSIX shell with make")
@pytest.mark.parametrize("page", SHOWN)
def test_every_line_runs_on_an_empty_disk(page, disk):
    wrong = []
    for line in SHOWN[page]:
        if line in ELSEWHERE:
            continue
        make_inputs(line)
        wrong.append(run_line(line, disk))
    assert not any(wrong), "\n".join(filter(None, wrong))


def test_the_lines_are_found():
    lines = [line for found in SHOWN.values() for line in found]
    assert len(lines) > 35 and any(line.startswith("15 1 * * *") for line in lines)
    assert set(ELSEWHERE) <= set(lines)


SNIPPETS = {
    page: re.findall(r"(?ms)^```python\n(.*?)^```$", (ROOT / page).read_text("utf-8"))
    for page in ("README.md", "docs/data.md")
}


@pytest.mark.slow
@pytest.mark.parametrize("page", SNIPPETS)
def test_every_python_snippet_is_a_script(page, disk):
    """Without a guard for __main__: workers do not import the user's script."""
    assert run_command("export", "strip.las", "-o", "X.npz").exit_code == 0
    for number, text in enumerate(SNIPPETS[page]):
        Path(f"script{number}.py").write_text(text, "utf-8")
        done = run_program(sys.executable, f"script{number}.py")
        assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert SNIPPETS[page]
