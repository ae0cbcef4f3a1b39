"""No output of any command replaces a file that the command reads, with or without --overwrite, also through links."""

import json
import os
import shutil

import pytest
from commands import run_command, succeed

from wavebatch.cli import COMMANDS, main
from wavebatch.cli.options import OutputPath
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.strip import StripOptions


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Strips with packets next to them, a chain file and more."""
    folder = tmp_path_factory.mktemp("files")
    for name in ("s.las", "t.las"):
        simulate_strip("flat", folder / name, pulses=200, seed=1, options=StripOptions(internal=False))
    succeed("survey", folder / "s.las", "-o", folder / "sys.toml", "--chain", folder / "chain.toml")
    for name in ("list.txt", "list.csv"):
        (folder / name).write_text("s.las\n")
    (folder / "targets.csv").write_text("reflectance,x,y,radius\n0.5,0,0,5\n")
    (folder / "areas.json").write_text('{"type": "FeatureCollection", "features": []}')
    (folder / "energy.txt").write_text("time energy\n0 1\n1e9 1\n")
    (folder / "path.txt").write_text("time x y z\n0 0 0 900\n1e9 9 9 900\n")
    corners = [[0, 0], [9e6, 0], [9e6, 9e6], [0, 9e6], [0, 0]]
    (folder / "area.json").write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def place(files, tmp_path, monkeypatch):
    """A copy of the files with links to some, in the folder in which commands run."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    os.symlink("s.las", "link.las")
    os.symlink(".", "here")
    os.link("s.las", "hard.las")
    os.symlink("s.wdp", "link.wdp")
    return tmp_path


_RUN = "run s.las -o out --profile fast"
_CASES = [
    f"{_RUN} --report s.las",
    f"{_RUN} --report s.wdp",
    f"{_RUN} --report link.wdp",
    f"{_RUN} --report hard.las",
    "run s.las -o out -c chain.toml --report chain.toml",
    "run s.las -o out --system sys.toml --report sys.toml",
    "run @list.txt -o out --report list.txt",
    "run s.las -o out --trajectory path.txt --energy energy.txt --report energy.txt",
    "run s.las -o out --trajectory path.txt --energy energy.txt --report path.txt",
    "run s.las -o out --polygon area.json --report area.json",
    "run @list.txt -o out --report s.las",
    "run s.las -o empty --report empty/s.laz",
    "run s.las -o empty --report empty/s.report.json",
    "run s.las -o . --format las --overwrite",
    "run s.las -o here --format las --overwrite",
    "run s.las -o . --keep-packets --overwrite",
    "survey s.las -o s.las --overwrite",
    "survey s.las -o s.wdp --overwrite",
    "survey s.las -o new.toml --chain link.las --overwrite",
    "survey s.las -o new.toml --chain new.toml",
    "synthesize s.las -o s.las --overwrite",
    "synthesize s.las -o s.laz --external --overwrite",
    "synthesize s.las -o hard.las --overwrite",
    "stats s.las -o s.las --overwrite",
    "stats @list.txt -o s.las --overwrite",
    "stats @list.csv -o list.csv --overwrite",
    "stats s.las --area 5 -o link.las --overwrite",
    "stats s.las --polygon areas.json -o areas.json --overwrite",
    "calibrate s.las --targets targets.csv -o targets.csv --overwrite",
    "calibrate s.las --targets targets.csv -o s.las --overwrite",
    "calibrate s.las --targets targets.csv --system sys.toml -o sys.toml --overwrite",
    "slice s.las -o s.las --overwrite",
    "voxelize s.las -o link.las --size 1 --overwrite",
    "voxelize s.las -o hard.las --size 1 --overwrite",
    "voxelize s.las -o v.las --profiles s.las --size 1 --overwrite",
]


@pytest.mark.parametrize("words", _CASES)
def test_an_input_is_never_replaced(place, words):
    before = {path.name: path.read_bytes() for path in place.iterdir() if path.is_file()}
    result = run_command(*words.split())
    assert result.exit_code == 2 and result.stderr.count("\n") == 1, result.stderr
    assert "would replace this input" in result.stderr or "choose another" in result.stderr
    assert {path.name: path.read_bytes() for path in place.iterdir() if path.is_file()} == before
    assert not (place / "out").exists() and not list((place / "empty").iterdir())


def test_outputs_next_to_an_input_are_fine(place):
    for words in ("synthesize s.las -o s.laz", f"{_RUN} --report all.json", "synthesize s.las -o u.laz --external"):
        succeed(*words.split(), catch_exceptions=False)
    succeed("synthesize", "s.laz", "-o", "u.laz", "--external", "--overwrite")


def test_every_option_that_writes_is_known_as_such():
    """An output that is declared as a file to read would not be protected, and its old file would count as an input."""
    found = set()
    for name in COMMANDS:
        command = main.get_command(None, name)
        for one in getattr(command, "commands", {name: command}).values():
            found |= {f"{one.name} {p.opts[-1]}" for p in one.params if isinstance(p.type, OutputPath)}
    logs = {name for name in found if name.endswith(" --log-file")}
    assert len(logs) == len(COMMANDS) + 5  # `plot` has six commands
    assert found - logs == {
        "run --output", "run --report", "survey --output", "survey --chain", "simulate --output", "simulate --truth",
        "stats --output", "synthesize --output", "slice --output", "slice --png", "voxelize --output",
        "voxelize --profiles", "slice --overview", "slice --cube", "survey --angles", "compare --output",
        "section --output", "profile --output", "cube --output",
        "waveform --output", "histogram --output", "map --output", "calibrate --output", "calibrate --report",
        "bench --output", "import --output", "export --output",
        "grid --output", *(f"{command} --html" for command in ("run", "survey", "bench", "calibrate", "compare")),
    }  # fmt: skip
