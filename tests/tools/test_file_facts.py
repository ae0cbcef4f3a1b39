"""What `wavebatch info` shows of any file, against laspy, and how a cloud was made."""

import json
import shlex
import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import laspy
import numpy as np
import pytest
from commands import run_command, succeed
from writer_tools import data_file, write_source

import wavebatch as wb
from wavebatch.files.las.header import Vlr
from wavebatch.tools.file_facts import _describe_time, describe_file


@pytest.mark.parametrize("point_format", [0, 1, 3, 6, 8])
def test_points_and_records_of_any_file(tmp_path, point_format):
    version = (1, 4) if point_format >= 6 else (1, 2)
    vlrs = [Vlr(b"me", 7, b"abc", b"of a test")]
    write_source(tmp_path / "a.las", point_format, version, vlrs=vlrs, evlrs=[(b"me", 8, b"x")] * (point_format >= 6))
    facts = describe_file(tmp_path / "a.las")
    cloud = laspy.read(tmp_path / "a.las")
    for name, end in (("least", np.min), ("largest", np.max)):
        assert facts["bounds"][name] == pytest.approx([end(cloud[axis]) for axis in "xyz"])
        assert facts["header_bounds"][name] == pytest.approx(facts["bounds"][name])
    numbers, counts = np.unique(np.asarray(cloud.return_number), return_counts=True)
    assert facts["returns"] == {str(k): n for k, n in zip(numbers.tolist(), counts.tolist(), strict=True)}
    kinds, counts = np.unique(np.asarray(cloud.classification), return_counts=True)
    assert facts["classes"] == {str(k): n for k, n in zip(kinds.tolist(), counts.tolist(), strict=True)}
    assert facts["point_sources"] == dict(Counter(map(str, np.asarray(cloud.point_source_id).tolist())))
    assert len(facts["point_sources"]) > 20
    assert facts["intensity"] == [cloud.intensity.min(), cloud.intensity.max()]
    if point_format == 0:
        assert facts["gps_time"] is None
    else:
        assert facts["gps_time"]["least"] == cloud.gps_time.min()
        assert facts["gps_time"]["largest"] == cloud.gps_time.max()
    records = [(one["user"], one["id"], one["bytes"], one["extended"]) for one in facts["records"]]
    assert records == [("me", 7, 3, False), *([("me", 8, 1, True)] * (point_format >= 6))]
    assert facts["provenance"] == [] and "counts" not in facts and facts["problems"] == []


def test_a_cloud_shows_how_it_was_made(tiny_strip, tmp_path):
    result = wb.run(tiny_strip, tmp_path, chain="fast", names="pdal", columns="+range", no_data="nan")
    counts = result.report.counts
    facts = describe_file(tmp_path / "tiny.laz")
    (account,) = facts["provenance"]
    typed = "wavebatch run tiny.las -o DIR --profile fast --columns +range --names pdal --no-data nan"
    assert account["command"] == typed
    assert "decompose.closed_form" in account["chain"] and account["columns"]["range"] == "EchoRange"
    assert account["version"] == wb.__version__ and account["input"] == "tiny.las"
    assert facts["counts"]["echoes"] == counts["echoes"] and facts["counts"]["added"] == counts["added_echoes"]
    assert facts["counts"]["passed_through"] == counts["points_out"] - counts["echoes"]
    shown = run_command("info", tmp_path / "tiny.laz").stdout
    for line in ("command           wavebatch run tiny.las", "chain             noise.pooled", "range as EchoRange"):
        assert line in shown
    document = json.loads(run_command("info", "--json", tmp_path / "tiny.laz").stdout)
    assert document == {"schema": "wavebatch.info/1", **facts}


def test_the_command_that_is_shown_makes_the_cloud_again(tiny_strip, tmp_path, monkeypatch):
    """It named neither what was written of the strip, nor the air, nor the energies of the pulses."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(tiny_strip, "a strip.las")
    with laspy.open(tiny_strip) as strip:
        (west, south, _), (east, north, _) = strip.header.mins, strip.header.maxs
    Path("energy.txt").write_text("time energy\n" + "".join(f"{300_000_000 + k / 1e4:.4f} 1\n" for k in range(400)))
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    Path("area.json").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    box = f"{west},{south},{east},{north}"
    words = ["run", "a strip.las", "--columns", "+amplitude_normalized", "--where", "amplitude > 20 and not 'z' == 3",
             "--drop-flags", "WEAK,AT_BOUND", "--classes", "0,1,2", "--bbox", box, "--polygon", "area.json",
             "--points", "returns", "--attenuation", "0.3", "--attenuation-error", "0.1",
             "--energy", "energy.txt"]  # fmt: skip
    first = _make(words, "one")
    again = shlex.split(describe_file(Path("one/a strip.laz"))["provenance"][0]["command"])
    assert again[:2] == ["wavebatch", "run"] and again[3:5] == ["-o", "DIR"]
    second = _make(["run", again[2], *again[5:]], "two")
    assert first["counts"]["left_out"]["where"] and second["output"]["size"] == first["output"]["size"]
    for key in ("options", "request", "counts"):
        assert second[key] == first[key]


def test_the_command_is_what_was_typed_without_folders():
    """A profile was recorded as `--chain CHAIN.toml`."""
    options = wb.RunOptions("there", profile="accurate", trajectory="a/b c.txt", lever_arm=(0.1, -0.2, 0.3), jobs=4)
    typed = "wavebatch run 'a strip.las' -o DIR --profile accurate --trajectory 'b c.txt' --lever-arm 0.1,-0.2,0.3"
    assert options.command("a strip.las") == typed
    options = wb.RunOptions("there", tolerance=0.02, chain=None, calibration="x/cal.toml", strict=True, resume=True)
    assert options.command("s.las").endswith("-o DIR --tolerance 0.02m --calibration cal.toml --strict")


def _make(words, folder):
    """The report of a run."""
    succeed(*words, "-o", folder)
    return json.loads(Path(folder, "a strip.report.json").read_text())


def test_headers_that_are_wrong_show():
    shown = run_command("info", data_file("no-packets/simple1_3.las")).stdout
    assert "the header says -235434519 to -234935841" in shown


@pytest.mark.parametrize("account", [b"[]", b"{", b'{"options": 3, "request": [], "columns": 7, "chain": {}}'])
def test_accounts_of_any_form_are_shown_as_far_as_they_go(tmp_path, account):
    write_source(tmp_path / "a.las", 6, (1, 4), vlrs=[Vlr(b"wavebatch", 1, account)])
    succeed("info", tmp_path / "a.las")


def test_times_that_are_no_seconds_of_the_week_are_not_called_so():
    header = SimpleNamespace(global_encoding=0)
    assert _describe_time(header, (1e9, 1.1e9))["kind"].startswith("unknown (the header says seconds of the week")
    assert _describe_time(header, (5.0, 604_000.0))["kind"] == "seconds of the week"
    header = SimpleNamespace(global_encoding=1)
    assert [_describe_time(header, (1e8, end)).get("dates_gps") is None for end in (2e8, 5e9)] == [False, True]
