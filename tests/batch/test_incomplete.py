"""A strip whose packets are cut is written, but the run ends with exit code 3 until they are whole."""

import json
import shutil
import struct

import pytest
from commands import run_command
from writer_tools import data_file

from wavebatch.files.las.header import read_header


@pytest.fixture
def strip(tmp_path):
    """An external strip that is whole."""
    path = tmp_path / "in" / "s.las"
    path.parent.mkdir()
    options = ["--pulses", "400", "--external", "-q"]
    assert run_command("simulate", "urban", "-o", path, *options).exit_code == 0
    return path


def run(*arguments, folder):
    return run_command("run", *arguments, "-o", folder, "--profile", "fast", "--quiet")


def read(folder, name="s"):
    return json.loads((folder / f"{name}.report.json").read_text())


def test_a_cut_wdp_is_incomplete_until_it_has_grown(strip, tmp_path):
    packets, folder = strip.with_suffix(".wdp"), tmp_path / "out"
    whole = packets.read_bytes()
    packets.write_bytes(whole[: len(whole) // 2])
    first = run(strip, "--report", tmp_path / "sum.json", folder=folder)
    assert first.exit_code == 3 and "past the end of the waveform data" in first.stderr
    report = read(folder)
    assert report["status"] == "incomplete" and 0 < report["counts"]["points_cut"] == report["counts"]["points_broken"]
    assert report["counts"]["points_out"] >= report["counts"]["points_in"]
    (summed,) = json.loads((tmp_path / "sum.json").read_text())["strips"]
    assert summed["status"] == "incomplete" and summed["error"] is None

    before = (folder / "s.laz").stat()
    again = run(strip, "--resume", "--progress", "json", folder=folder)
    assert again.exit_code == 3 and len(again.stderr.splitlines()) == 1
    assert f"{strip}: is incomplete as before" in again.stderr
    assert [json.loads(line)["event"] for line in again.stdout.splitlines()] == ["start", "incomplete"]
    after = (folder / "s.laz").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)

    packets.write_bytes(whole[: 3 * len(whole) // 4])
    assert run(strip, "--resume", folder=folder).exit_code == 3
    assert 0 < read(folder)["counts"]["points_cut"] < report["counts"]["points_cut"]
    packets.write_bytes(whole)
    assert run(strip, "--resume", folder=folder).exit_code == 0
    assert read(folder)["status"] == "complete" and read(folder)["counts"]["points_cut"] == 0
    last = run(strip, "--resume", folder=folder)
    assert (last.exit_code, last.stderr) == (0, "")


def test_a_wrong_claim_of_a_whole_wdp_is_a_note(strip, tmp_path):
    packets = strip.with_suffix(".wdp")
    content = bytearray(packets.read_bytes())
    content[20:28] = struct.pack("<Q", 2 * len(content))
    packets.write_bytes(content)
    assert run(strip, folder=tmp_path / "out").exit_code == 0
    assert read(tmp_path / "out")["status"] == "complete"


def test_packets_cut_off_at_the_end_of_the_las_are_the_same(tiny_strip, tmp_path):
    path = tmp_path / "cut.las"
    content, start = tiny_strip.read_bytes(), read_header(tiny_strip).waveform_start
    path.write_bytes(content[: (start + len(content)) // 2])
    done = run(path, folder=tmp_path / "out")
    assert done.exit_code == 3 and read(tmp_path / "out", "cut")["status"] == "incomplete"


def test_packets_of_another_strip_are_refused_by_every_command_and_taken_by_force(strip, tmp_path):
    other = tmp_path / "in" / "other.las"
    shutil.copy(data_file("riegl-q680i/100429_152240_2535pt_UTM.las"), other)
    shutil.copy(data_file("lvis/lvis1.wdp"), other.with_suffix(".wdp"))
    refused = run(other, folder=tmp_path / "out")
    assert refused.exit_code == 4 and "other.wdp belongs to another strip" in refused.stderr
    assert run(other, strip, folder=tmp_path / "two").exit_code == 3
    forced = run(other, "--force", folder=tmp_path / "forced")
    assert forced.exit_code == 0 and f"{other}: warning: --force: other.wdp belongs to another strip" in forced.stderr
    assert read(tmp_path / "forced", "other")["status"] == "complete"
    for command in (["survey"], ["slice", "-o", "s.csv"], ["voxelize", "--size", "5", "-o", "v.npz"],
                    ["plot", "waveform", "-o", "w.csv"], ["check"]):  # fmt: skip
        arguments = [str(tmp_path / one) if "." in one else one for one in command]
        done = run_command(*arguments, other)
        assert done.exit_code == 1 and "other.wdp belongs to another strip" in done.output, command
        if command[0] in ("voxelize", "plot"):
            assert run_command(*arguments, other, "--force").exit_code == 0, command
