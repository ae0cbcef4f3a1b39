"""The examples of the papers: every one runs, and at full size meets what is accepted, whatever the seed."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "examples" / "papers"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("s?_*.py"))


@pytest.fixture
def load(monkeypatch):
    """`load(name)`: a module of the examples."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module


def test_there_is_one_for_every_paper():
    assert [name[:2] for name in SCRIPTS] == ["s0", "s1", "s2", "s3", "s4"]
    told = (FOLDER / "README.md").read_text("utf-8")
    assert all(f"{name}.py" in told for name in SCRIPTS)


@pytest.mark.parametrize("name", SCRIPTS)
def test_papers_run(name, load):
    tables = [table for table in load(name).measure(300, 1) if not isinstance(table, str)]
    assert len(tables) >= 4
    for table in tables:
        assert len(table.rows) == len(table.values) >= 2, table.title
        assert np.isfinite(list(table.values.values())).all(), str(table)
        assert len(str(table).splitlines()) == 1 + len(table.rows)
    # A tenth of the waveforms scatter three times as much: most figures are accepted even so.
    assert sum(len(table.failures) for table in tables) <= 0.1 * sum(len(table.rows) for table in tables)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", SCRIPTS)
def test_papers_are_reproduced(name, seed):
    command = [sys.executable, str(FOLDER / f"{name}.py"), "--seed", str(seed)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "FAIL" not in result.stdout and result.stdout.endswith("\n0 figures not accepted\n")


def test_a_figure_outside_its_band_fails(load, monkeypatch, capsys):
    table = load("table")

    def measure(number, seed):
        made = table.Table("things", 1)
        made.add("good", 1.04, 0.9, 1.1, paper=1.0)
        made.near("bad", 1.5, 1.0, within=0.1, share=0.2)
        made.add("unknown", float("nan"), 0.0)
        made.add("told only", number + seed)
        return [made, "a text"]

    monkeypatch.setattr(sys, "argv", ["x", "--seed", "3", "--number", "4"])
    assert table.main(measure, "Things.", 10) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines[1:5]] == ["ok", "FAIL", "FAIL", "-"]
    assert lines[2].split() == ["bad", "-", "1.0", "1.5", "0.8..1.2", "FAIL"]
    assert lines[4].split()[-2] == "7.0"
    assert lines[6] == "a text"
    assert lines[-3:] == ["2 figures not accepted", "  things: bad", "  things: unknown"]
    assert table.main(lambda number, seed: [], "Things.", 10) == 0
