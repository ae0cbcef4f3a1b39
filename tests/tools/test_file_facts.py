"""What `wavebatch info` shows of any file, against laspy, and how a cloud was made."""

import json

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from writer_tools import data_file, write_source

import wavebatch as wb
from wavebatch.cli import main
from wavebatch.files.las.header import Vlr
from wavebatch.tools.inspect.file_facts import describe_file


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
    assert account["command"] == "wavebatch run tiny.las -o DIR --chain CHAIN.toml --names pdal --no-data nan"
    assert "decompose.closed_form" in account["chain"] and account["columns"]["range"] == "EchoRange"
    assert account["version"] == wb.__version__ and account["input"] == "tiny.las"
    assert facts["counts"]["echoes"] == counts["echoes"] and facts["counts"]["added"] == counts["added_echoes"]
    assert facts["counts"]["passed_through"] == counts["points_out"] - counts["echoes"]
    shown = CliRunner().invoke(main, ["info", str(tmp_path / "tiny.laz")]).stdout
    for line in ("command        wavebatch run tiny.las", "chain          noise.pooled", "range as EchoRange"):
        assert line in shown
    document = json.loads(CliRunner().invoke(main, ["info", "--json", str(tmp_path / "tiny.laz")]).stdout)
    assert document == {"schema": "wavebatch.info/1", **facts}


def test_headers_that_are_wrong_show():
    shown = CliRunner().invoke(main, ["info", str(data_file("no-packets/simple1_3.las"))]).stdout
    assert "the header says -235434519.000 to -234935841.000" in shown


@pytest.mark.parametrize("account", [b"[]", b"{", b'{"options": 3, "request": [], "columns": 7, "chain": {}}'])
def test_accounts_of_any_form_are_shown_as_far_as_they_go(tmp_path, account):
    write_source(tmp_path / "a.las", 6, (1, 4), vlrs=[Vlr(b"wavebatch", 1, account)])
    result = CliRunner().invoke(main, ["info", str(tmp_path / "a.las")])
    assert result.exit_code == 0, result.output
