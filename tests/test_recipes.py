"""The recipes of the documentation and the examples run."""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import laspy
import numpy as np
import pytest
from batch_tools import read_cloud
from commands import succeed

import wavebatch
from wavebatch.core.echoes import COLUMNS
from wavebatch.files.las.crs import read_crs_definition
from wavebatch.files.las.read_points import read_checked_header

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "recipes.md").read_text("utf-8")
BLOCKS = dict(re.findall(r'(?ms)^```\w+ title="([^"]+)"\n(.*?)^```$', PAGE))
RECIPES = {title: text for title, text in BLOCKS.items() if "." not in title}
PROGRAMS = {"wavebatch", "python"}
GIS = Path(__file__).resolve().parent.parent / "examples" / "gis"


def _programs(text: str) -> list[str]:
    """The program of each command; lines that go on with a backslash are one command."""
    return [line.split()[0] for line in text.replace("\\\n", " ").splitlines() if line.strip()]


@pytest.fixture(scope="module")
def folder(tiny_strip, tmp_path_factory):
    """A strip, the files of the page, and programs `wavebatch` and `python` of this checkout."""
    folder = tmp_path_factory.mktemp("recipes")
    shutil.copy(tiny_strip, folder / "strip.las")
    for title, text in BLOCKS.items():
        if "." in title:
            (folder / title).write_text(text)
    shutil.copytree(GIS, folder / "examples" / "gis")
    (folder / "bin").mkdir()
    programs = {"wavebatch": f"{sys.executable} -m wavebatch", "python": sys.executable}
    if shutil.which("qgis_process.bin"):  # Debian 12: its `qgis_process` adds an option that the program does not have
        programs["qgis_process"] = "qgis_process.bin"
    for name, words in programs.items():
        path = folder / "bin" / name
        path.write_text(f'#!/bin/sh\nexec {words} "$@"\n')
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return folder


def _run(folder, text):
    paths = os.pathsep.join([str(Path(__file__).resolve().parent.parent), *filter(None, sys.path)])
    environment = {**os.environ, "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": paths}
    environment.setdefault("QT_QPA_PLATFORM", "offscreen")
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", text], cwd=folder, env=environment, capture_output=True,
                          text=True, timeout=300)  # fmt: skip
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def _opens_las(folder):
    """Whether CloudCompare reads LAS: Debian's package leaves that plugin out."""
    done = subprocess.run(["CloudCompare", "-SILENT", "-O", "strip.las"], cwd=folder, capture_output=True, text=True,
                          env={**os.environ, "QT_QPA_PLATFORM": "offscreen"}, timeout=300)  # fmt: skip
    return "unhandled file extension" not in done.stdout + done.stderr


def test_the_page_has_the_programs_of_the_field():
    named = {program for text in RECIPES.values() for program in _programs(text)}
    assert {"gdalinfo", "pdal", "untwine", "Rscript", "CloudCompare", "qgis_process"} <= named


def test_every_pipeline_reads_a_cloud_and_is_in_a_recipe():
    pipelines = {path.name: json.loads(path.read_text()) for path in GIS.glob("*.json")}
    for name, stages in pipelines.items():
        assert stages[0] == {"type": "readers.las", "filename": "clouds/strip.laz", "use_eb_vlr": True}
        assert stages[-1]["type"].startswith("writers.") and f"pdal pipeline examples/gis/{name}" in PAGE
        for stage in stages:
            if stage["type"] == "filters.range":
                assert stage["limits"].split("[")[0] in COLUMNS
            assert stage.get("dimension", "amplitude") in COLUMNS
    assert len(pipelines) == 4


def test_every_style_draws_a_column_and_hides_no_data():
    for path in GIS.glob("*.qml"):
        renderer = ElementTree.parse(path).getroot().find("renderer")
        assert renderer.get("attribute") == path.stem and path.stem in COLUMNS and f"`{path.stem}`" in PAGE
        ramp = renderer.find("colorrampshader")
        values = [float(item.get("value")) for item in ramp.findall("item")]
        assert ramp.get("clip") == "1" and values == sorted(values) and values[0] > -9999


@pytest.mark.quick_cases("laspy")  # tiles and rasters have tests of their own
@pytest.mark.parametrize("title", list(RECIPES))
def test_recipe(folder, title):
    text = RECIPES[title]
    missing = sorted({name for name in _programs(text) if name not in PROGRAMS and shutil.which(name) is None})
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    for name in ("clouds", *(path.name for path in folder.glob("*.tif"))):
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    if "to_copc.py" in text:
        pytest.importorskip("copclib", reason="copclib is not installed (make readers)")
        for made in folder.glob("*.copc.laz"):
            made.unlink()
    if "CloudCompare" in text and not _opens_las(folder):
        pytest.skip("the CloudCompare here has no LAS plugin")
    if "copc" in title and "pdal" in text and "writers.copc" not in _run(folder, "pdal --drivers"):
        pytest.skip("the PDAL here writes no COPC")
    shown = _run(folder, text)
    if title == "gdal-raster":
        assert "Description = median of echo_width" in shown and "NoData Value=-9999" in shown
        assert "Unit Type: ns" in shown and "STATISTICS_MEAN=" in shown
    if title == "qgis-process":
        assert re.search(r"MEAN:\s+[2-9]\.", shown), shown
    if title == "csv":
        table = (folder / "strip.csv").read_text()
        assert table.startswith("x,y,z,classification") and ",,,," in table and "nan" not in table
    if title == "laspy":
        assert 2 < float(shown) < 20
    if title == "lidr":
        assert "Median" in shown


def test_tiles_have_every_point_once_with_all_columns(folder, riegl):
    """Of two clouds with other offsets; a tile has them in the order of the clouds."""
    clouds = folder / "flight"
    assert wavebatch.run(riegl, clouds, profile="fast").failed == 0
    old = laspy.read(clouds / f"{riegl.stem}.laz")
    moved = laspy.read(clouds / f"{riegl.stem}.laz")
    moved.change_scaling(offsets=moved.header.offsets + [7.0, -3.0, 0.5])
    moved.write(clouds / "moved.laz")
    _run(folder, f"python examples/gis/tiles.py 15 squares flight/{riegl.stem}.laz flight/moved.laz")
    tiles = {path.stem: laspy.read(path) for path in (folder / "squares").iterdir()}
    assert len(tiles) > 5 and sum(map(len, tiles.values())) == 2 * len(old)
    for name, tile in tiles.items():
        low = np.array([int(word) for word in name.split("_")])
        mine = np.all(np.stack([old.x, old.y], axis=1) // 15 * 15 == low, axis=1)
        assert tile.header.vlrs.get("WktCoordinateSystemVlr")[0].string
        assert str(list(tile.point_format.extra_dimensions)) == str(list(old.point_format.extra_dimensions))
        for column in ("x", "y", "z", *old.point_format.dimension_names):
            if column not in "XYZ":
                both = np.tile(old[column][mine], 2)
                np.testing.assert_allclose(tile[column], both, rtol=0, atol=1e-6, err_msg=column)


@pytest.mark.parametrize("most", [50_000, 60])
def test_copc_by_copclib_keeps_points_columns_and_crs(folder, riegl, most):
    """Also with nodes of a few points: readers find each node by way of those above it."""
    pytest.importorskip("copclib", reason="copclib is not installed (make readers)")
    cloud, target = folder / f"{most}" / f"{riegl.stem}.laz", folder / f"{most}.copc.laz"
    assert wavebatch.run(riegl, cloud.parent, profile="fast").failed == 0
    _run(folder, f"python examples/gis/to_copc.py {cloud} {target} {most}")
    old = laspy.read(cloud)
    with laspy.CopcReader.open(target) as reader:
        new = reader.query()
        assert len(new) == len(old)
        rows = [np.lexsort([part[name] for name in ("gps_time", "X", "Y", "Z")]) for part in (old, new)]
        for name in old.point_format.dimension_names:
            np.testing.assert_array_equal(np.asarray(new[name])[rows[1]], np.asarray(old[name])[rows[0]], err_msg=name)
        written = [(one.name, one.description, one.no_data) for one in reader.header.point_format.extra_dimensions]
    assert str(written) == str([(one.name, one.description, one.no_data) for one in old.point_format.extra_dimensions])
    texts = [read_crs_definition(path, read_checked_header(path, waveforms=False).header) for path in (cloud, target)]
    assert texts[0] == texts[1] is not None


ROOT = Path(__file__).resolve().parent.parent
CHAINS = sorted((ROOT / "examples").glob("*.toml"))


def test_there_is_a_chain_for_open_urban_and_forest_scenes():
    assert {"open", "urban", "forest"} <= {path.stem for path in CHAINS}


@pytest.mark.parametrize("chain", CHAINS, ids=lambda path: path.stem)
def test_example_chains_run(chain, tiny_strip, tmp_path):
    succeed("run", tiny_strip, "-o", tmp_path, "--chain", chain)
    cloud, _ = read_cloud(tmp_path / "tiny.laz")
    assert len(cloud) > 300


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib").use("Agg")
    from matplotlib import pyplot

    monkeypatch.chdir(tmp_path)
    notebook = json.loads((ROOT / "examples" / "strip_to_cloud.ipynb").read_text("utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell.get("outputs") for cell in notebook["cells"])  # made by the reader's version, not kept
    space: dict = {}
    for number, cell in enumerate(cells):
        exec(compile(cell, f"cell {number}", "exec"), space)
    drawn = [len(pyplot.figure(number).axes) for number in pyplot.get_fignums()]
    pyplot.close("all")
    assert drawn == [1, 2] and space["mine"].sum() > 2
    assert space["known"].sum() > 3000 and space["result"].failed == 0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_the_pipeline_makes_what_is_missing_only(tiny_strip, tmp_path):
    strips = tmp_path / "strips"
    strips.mkdir()
    for name in ("a.las", "b.las"):
        shutil.copyfile(tiny_strip, strips / name)
    out = tmp_path / "clouds"
    shutil.copy(ROOT / "examples" / "pipeline" / "Makefile", tmp_path)  # works wherever it is, without a chain file
    command = ["make", "-C", str(tmp_path), f"WAVEBATCH={sys.executable} -m wavebatch"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run(command, check=True, env=environment, capture_output=True)
    summary = json.loads((out / "summary.json").read_text())
    assert [strip["status"] for strip in summary["strips"]] == ["skipped", "skipped"]
    assert summary["counts"]["points_in"] > 800
    made = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    assert set(made) == {"a.laz", "a.report.json", "b.laz", "b.report.json", "summary.json"}
    again = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
    assert "wavebatch run" not in again.stdout
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == made
    chain = ROOT / "examples" / "open.toml"
    os.utime(strips / "b.las")
    told = subprocess.run(
        [*command, "-n", f"CHAIN={chain}"], check=True, env=environment, capture_output=True, text=True
    )
    assert told.stdout.count(f"--chain '{chain}' --resume --quiet '{strips.name}/b.las'") == 1
    (strips / "b.las").rename(strips / "b.LAS")
    (strips / "c.laz").write_bytes(b"no strip")
    (out / "summary.json").unlink()
    failing = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert failing.returncode != 0 and "c.laz: not a LAS or LAZ file" in failing.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert {Path(one["strip"]).name: one["status"] for one in summary["strips"]} == {
        "a.las": "skipped", "b.LAS": "skipped", "c.laz": "failed"
    }  # fmt: skip
    (strips / "c.laz").unlink()
    (strips / "two words ü.las").write_bytes((strips / "a.las").read_bytes())
    (strips / "-dash.las").write_bytes((strips / "a.las").read_bytes())
    for _ in range(2):
        subprocess.run(command, check=True, env=environment, capture_output=True)
        assert (out / "two words ü.laz").exists() and (out / "-dash.laz").exists()
    assert len(json.loads((out / "summary.json").read_text())["strips"]) == 4
    elsewhere = tmp_path / "some where"
    shutil.copytree(strips, elsewhere / "my strips")
    for folder in (elsewhere / "clouds", elsewhere / "my clouds"):
        given = ["STRIPS=my strips", f"OUT={folder.name}"]
        subprocess.run([*command, *given], check=True, env={**environment, "PWD": str(elsewhere)}, capture_output=True)
        assert len(json.loads((folder / "summary.json").read_text())["strips"]) == 4 and (folder / "a.laz").exists()
    nothing = subprocess.run([*command, "STRIPS=none"], env=environment, capture_output=True, text=True)
    assert nothing.returncode != 0 and "none holds no .las or .laz file; say STRIPS=FOLDER" in nothing.stderr
