"""Every command that README, docs and examples show is run on an empty disk; what they print is compared.

Below a `$ wavebatch` command stand lines of its output, which it must print. All others must end with exit code 0.

Lines may be left out of a page, or cut with `...`; each one that is there must be in the output, whatever its spaces.
Numbers may differ a little: processors round in different ways, and a survey may find one echo more.
"""

import contextlib
import glob
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from wavebatch.cli import COMMANDS, main

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
    for suffix in (".pls", ".wvs"):
        shutil.copy(riegl.with_suffix(suffix), tmp_path / f"line{suffix}")
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
        if words[0] == "run" and "--overwrite" not in words:
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(words[words.index("-o") + 1])
        result = CliRunner().invoke(main, words)
        printed = split(result.stdout + " " + result.stderr)
        for line in lines:
            wrong += [f"{command}: {part}" for part in line.split("...") if not prints(printed, split(part))]
    assert not wrong, "\n".join(wrong)


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
    "cube.npz": "slice strip.las --cube cube.npz --lines 0:60",
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
    if words[0] == "run" and "--overwrite" not in words and "--resume" not in words:
        shutil.rmtree(words[words.index("-o") + 1], ignore_errors=True)
    done = CliRunner().invoke(main, words)
    return f"{line}: {done.output}" if done.exit_code else ""


def make_inputs(line):
    """What a line reads and another page or line has made before it."""
    for name, words in MADE_BEFORE.items():
        if re.search(rf"(?<![\w/-]){re.escape(name)}(?![\w.])", line.partition(" -o ")[0]) and not Path(name).exists():
            done = CliRunner().invoke(main, shlex.split(words))
            assert done.exit_code == 0, done.output


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt" or shutil.which("make") is None, reason="lines are for a POSIX shell with make")
@pytest.mark.parametrize("page", SHOWN)
def test_every_line_runs_on_an_empty_disk(page, disk):
    pytest.importorskip("matplotlib")
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
    for page in ("README.md", "docs/index.md", "docs/data.md")
}


@pytest.mark.slow
@pytest.mark.parametrize("page", SNIPPETS)
def test_every_python_snippet_is_a_script(page, disk):
    """Without a guard for __main__: workers do not import the user's script."""
    assert CliRunner().invoke(main, ["export", "strip.las", "-o", "X.npz"]).exit_code == 0
    for number, text in enumerate(SNIPPETS[page]):
        Path(f"script{number}.py").write_text(text, "utf-8")
        done = run_program(sys.executable, f"script{number}.py")
        assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert SNIPPETS[page]
