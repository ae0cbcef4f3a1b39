"""Type checkers see what the documentation shows, and refuse what a run would refuse."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CHECKERS = {
    "mypy": ["--follow-imports", "silent", "--cache-dir", "cache", "--hide-error-context", "--no-error-summary"],
    "pyright": [],
}
GOOD = """\
from typing import assert_type

assert_type(strip, wb.Strip)
assert_type(survey, wb.Survey)
assert_type(chain, wb.Chain)
assert_type(result, wb.BatchResult)
result.raise_for_failures()
with wb.open_strip("strip.las") as other:
    more = chain.run(next(other.blocks()), survey.system)
    assert_type(more, wb.EchoTable)
    assert_type(other.digitizers[1], wb.Digitizer)
    more.to_frame().describe()
wb.run("strips", "clouds", where="amplitude > 5", bbox=(0.0, 0.0, 9.0, 9.0), chain=chain, system=survey, classes=(2,))
"""
BAD = """\
wb.run("a.las", "out", jobs="4")
wb.run("a.las", "out", profil="x")
wb.run("a.las", "out", names="rigl")
wb.open_strip("a.las", direction=1)
with wb.open_strip("a.las") as strip: strip.block()
wb.survey("a.las").sytem
with wb.open_strip("a.las") as strip: next(strip.blocks()).sampels
wb.load_chain("fast").run(next(wb.open_strip("a.las").blocks()), wb.survey("a.las").system).amplitud
wb.Digitizer(index="x", bits=8, n_samples=3, spacing=1.0, gain=1.0, offset=0.0)
wb.survey("a.las").system.noise.std = 3
"""


@pytest.fixture(scope="module", params=CHECKERS)
def check(request, tmp_path_factory):
    """A function: lines of a program -> numbers of its lines that the checker refuses, and what it prints."""
    if importlib.util.find_spec(request.param) is None:
        pytest.skip(f"{request.param} is not installed")
    folder = tmp_path_factory.mktemp(request.param)
    (folder / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT)]}))

    def check(text: str) -> tuple[set[int], str]:
        (folder / "program.py").write_text(text)
        command = [sys.executable, "-m", request.param, *CHECKERS[request.param], "program.py"]
        if request.param == "pyright":
            command += ["--pythonpath", sys.executable]
        done = subprocess.run(
            command, cwd=folder, env={**os.environ, "MYPYPATH": str(ROOT)}, capture_output=True, text=True
        )
        told = done.stdout + done.stderr
        found = {int(number) for number in re.findall(r"program\.py:(\d+):.*\berror\b", told)}
        assert done.returncode == (1 if found else 0), told
        return found, told

    return check


@pytest.mark.slow
def test_the_documented_python_has_types(check):
    (example,) = re.findall(r"(?s)```python\n(import wavebatch as wb\n.*?)```", (ROOT / "README.md").read_text("utf-8"))
    found, told = check(example + GOOD)
    assert not found, told


@pytest.mark.slow
def test_what_a_run_refuses_a_type_checker_refuses(check):
    found, told = check("import wavebatch as wb\n" + BAD)
    assert found == set(range(2, 2 + len(BAD.splitlines()))), told
