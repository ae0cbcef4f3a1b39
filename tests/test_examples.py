"""Every example runs."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from batch_tools import read_cloud
from commands import succeed

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
