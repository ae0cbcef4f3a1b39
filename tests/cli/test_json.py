"""docs/json.md holds every document that `--json` prints: its schema, its keys and their types."""

import json
import re
from pathlib import Path

import click
import pytest
from commands import succeed

from wavebatch.cli import COMMANDS, main

PAGE = Path(__file__).parents[2] / "docs" / "json.md"
ROW = re.compile(r"(?m)^\| `(\w+)` \| ([^|]+) \| ([^|]*) \|$")
KINDS = {"text": str, "list": list, "object": dict, "true or false": bool, "null": type(None)}


def _read_table(text):
    """Keys of a table: types, and whether the key may be missing."""
    return {key: (kind.split(" or ") if kind != "true or false" else [kind], meaning.startswith("optional"))
            for key, kind, meaning in ROW.findall(text)}  # fmt: skip


def _schemas():
    """Tables of each schema by the place of their objects in the document; its own is at the place ""."""
    parts = re.split(r"(?m)^## (wavebatch\.\S+)$", PAGE.read_text())[1:]
    found = {}
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        first, *more = re.split(r"(?m)^### `(\S+)`$", text)
        found[name] = {"": _read_table(first), **dict(zip(more[::2], map(_read_table, more[1::2]), strict=True))}
    return found


def _find(value, place):
    """All objects at a place such as `scenes[].rows[].figures.*`; none where a key on the way is missing or null."""
    for step in re.findall(r"\w+|\[\]|\*", place):
        if step == "[]":
            value = [one for many in value for one in many]
        elif step == "*":
            value = [one for many in value for one in many.values()]
        else:
            value = [one[step] for one in value if one.get(step) is not None]
    return value


def _is(value, kind):
    if kind in ("integer", "number"):
        return isinstance(value, int if kind == "integer" else (int, float)) and not isinstance(value, bool)
    return isinstance(value, KINDS[kind])


def _hold(document, schema):
    assert document["schema"] == schema
    for place, keys in _schemas()[schema].items():
        needed = {key for key, (_, optional) in keys.items() if not optional}
        for found in _find([document], place):
            assert needed <= set(found) <= set(keys), (place, (needed ^ set(found)) & (needed | set(found) - set(keys)))
            for key, value in found.items():
                assert any(_is(value, kind) for kind in keys[key][0]), (place, key, value)


def _print(*words):
    result = succeed(*words, "--json")
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def folder(riegl, tmp_path_factory):
    """A cloud, and the document of its run."""
    place = tmp_path_factory.mktemp("json")
    columns = "+incidence_angle,+incidence_angle_normals"
    document = _print("run", riegl, "-o", place, "--profile", "fast", "--columns", columns, "-q")
    (place / "run.json").write_text(json.dumps(document))
    _print("slice", riegl, "-o", place / "s.csv", "--cube", place / "cube.npz", "-q")
    _print("voxelize", riegl, "--size", 3, "--iterations", 1, "-o", place / "voxels.npz", "-q")
    _print("simulate", "mixed", "-o", place / "sim.las", "--pulses", 300, "-q")
    return place


def test_reports(folder, riegl):
    _hold(json.loads((folder / "run.json").read_text()), "wavebatch.batch-report/1")
    _hold(json.loads((folder / f"{riegl.stem}.report.json").read_text()), "wavebatch.strip-report/1")


CASES = {
    "run STRIP -o new --dry-run": "run-plan/1",
    "plot histogram CLOUD --column z -o h.png -q": "plot-histogram/1",
    "plot histogram CLOUD --column echo_flags -o f.png -q": "plot-histogram/1",
    "plot map CLOUD --statistic count -o m.png -q": "plot-map/1",
    "plot section CLOUD -o s.png -q": "plot-section/1",
    "plot section VOXELS -o sv.png -q": "plot-section/1",
    "plot profile CLOUD -o p.png -q": "plot-profile/1",
    "plot profile CLOUD --column echo_width --statistic mean -o pm.png -q": "plot-profile/1",
    "plot cube CUBE -o c.png -q": "plot-cube/1",
    "grid CLOUD --statistic density --size 5 -o d.tif -q": "grid/1",
    "grid CLOUD --column z --column echo_width --no-data nan --where z>0 -o w.tif -q": "grid/1",
    "bench --scene flat --waveforms 500 --pulses 300 --repeat 1 --tolerance 2cm": "bench/1",
    "bench --scene empty --waveforms 800 --pulses 0 --repeat 1": "bench/1",
    "plot waveform STRIP -o w.png -q --profile fast --random 2": "plot-waveform/1",
    "stats CLOUD": "stats/1",
    "compare CLOUD STRIP": "compare/1",
    "compare fast --strip STRIP --limit 50": "compare-chains/1",
    "info STRIP": "info/1",
    "info CLOUD": "info/1",
    "check STRIP": "check/1",
    "survey STRIP --waveforms 200": "system/1",
    "stages": "stages/1",
    "calibrate STRIP --targets TARGETS -o cal.toml -q": "calibration-report/1",
    "simulate slope -o s.las --pulses 300 -q": "simulate/1",
    "import PULSES -o i.las -q": "import/1",
    "export STRIP -o e.npz -q": "export/1",
    "synthesize SIM -o y.las -q": "synthesize/1",
    "slice STRIP -o s.csv -q": "slice/1",
    "voxelize STRIP --size 3 --iterations 1 -o v.npz -q": "voxelize/1",
}


@pytest.mark.quick_cases("[!b]*")
@pytest.mark.parametrize("line", CASES)
def test_documents_of_commands(folder, riegl, tmp_path, monkeypatch, line):
    monkeypatch.chdir(tmp_path)
    names = {"STRIP": riegl, "PULSES": riegl.with_suffix(".pls"), "CLOUD": folder / f"{riegl.stem}.laz",
             "ROOT": PAGE.parents[1], "SIM": folder / "sim.las", "CUBE": folder / "cube.npz",
             "VOXELS": folder / "voxels.npz", "TARGETS": "t.csv"}  # fmt: skip
    Path("t.csv").write_text("name,reflectance,x,y,radius\ngrey,0.3,548363.742,5389952.964,3\n")
    found = _print(*(names.get(word, word) for word in line.split()))
    for document in found if isinstance(found, list) else [found]:
        _hold(document, f"wavebatch.{CASES[line]}")


def _with_json(command, path):
    if isinstance(command, click.Group):
        for name in command.list_commands(None):
            yield from _with_json(command.get_command(None, name), f"{path} {name}")
    elif any(one.name == "as_json" for one in command.params):
        yield path


def test_every_command_with_json_is_in_the_page_and_tested():
    context, text = click.Context(main), PAGE.read_text()
    paths = {path for name in COMMANDS for path in _with_json(main.get_command(context, name), name)}
    assert {"run", "plot map", "plot section", "plot profile", "plot cube", "grid", "bench"} <= paths
    for path in paths:
        assert re.search(rf"`{path}(?: [^`]*)? ?--json`", text), path
        assert any(line == path or line.startswith(f"{path} ") for line in CASES), path
