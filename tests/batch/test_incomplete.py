"""Strips that are cut, counts that do not add up, and reports that are damaged."""

import json
import math
import shutil
import struct

import numpy as np
import pytest
from batch_tools import run_one
from commands import refuses, run_command
from writer_tools import data_file

from wavebatch.batch.counts import AMPLITUDE_BINS, COUNTS, OVERFLOW, WIDTH_BINS, RunReport, count_flags
from wavebatch.batch.report_file import _sum_up
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import StageError
from wavebatch.core.process import Seconds
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.files.las.header import read_header
from wavebatch.tools.simulate import simulate_strip


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


def test_a_wrong_claim_of_a_whole_wdp_is_a_warning(strip, tmp_path):
    packets = strip.with_suffix(".wdp")
    content = bytearray(packets.read_bytes())
    content[20:28] = struct.pack("<Q", 2 * len(content))
    packets.write_bytes(content)
    done = run_command("run", strip, "-o", tmp_path / "out", "--profile", "fast")
    assert done.exit_code == 0 and "warning: " in done.stderr and " bytes of packets" in done.stderr
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


def _report(**changes):
    counts = {
        "points_in": 10, "points_with_waveform": 7, "points_without_waveform": 2, "points_broken": 1, "waveforms": 6,
        "echoes": 8, "matched_returns": 5, "unmatched_returns": 1, "no_echo_returns": 1, "added_echoes": 3,
        "points_out": 13,
    }  # fmt: skip
    passed = {"NO_WAVEFORM": 2, "BROKEN_PACKET": 1, "NO_ECHO": 2}
    quality = RunReport.of_echoes(np.array([1, 2, 2, 2, 1, 0]), np.full(8, 50.0), np.full(8, 1.9))
    return RunReport(counts={**counts, **changes}, passed_through=passed) + quality


def test_a_right_report_passes():
    _report().check("echoes", "strip.las")
    _report(points_out=10).check("returns", "strip.las")


@pytest.mark.parametrize("name", list(COUNTS))
def test_any_count_that_is_off_by_one_is_noticed(name):
    part_of = {"points_cut": "points_broken"}.get(name, name)
    wrong = _report(**{name: _report().count(part_of) + 1})
    refuses(StageError, r"strip\.las: .* add up to", wrong.check, "echoes", "strip.las")


def test_reports_merge_in_any_order():
    a, b = _report(), _report(echoes=5)
    assert (a + b).to_json() == (b + a).to_json()
    assert (a + b).count("echoes") == 13
    assert (a + RunReport()).to_json() == a.to_json()


def test_a_report_reads_back_from_its_json():
    report = _report() + RunReport(above_one=1, last_left_out=2, strayed_returns=256, unseen_returns=7, copied_echoes=3)
    report += RunReport(ground_points=4)
    again = RunReport.from_json(json.loads(json.dumps(report.to_json())))
    assert again.to_json() == report.to_json() != _report().to_json()
    assert (again + report).to_json() == (report + report).to_json()


def test_reasons_for_no_data_merge_survive_being_written_and_must_add_up():
    a = _report() + RunReport(no_data={"range": {"KNOWN": 5, "NO_SENSOR": 3}}, remarks=("one",))
    b = _report() + RunReport(no_data={"range": {"KNOWN": 8}}, remarks=("one", "another"))
    both = a + b
    assert both.no_data == (b + a).no_data == {"range": {"KNOWN": 13, "NO_SENSOR": 3}}
    assert both.remarks == (b + a).remarks == ("another", "one")
    both.check("echoes", "strip.las")
    again = RunReport.from_json(json.loads(json.dumps(both.to_json())))
    assert again.no_data == both.no_data and again.remarks == both.remarks
    with pytest.raises(StageError, match="echoes is 8 but its parts add up to 9"):
        (a + RunReport(no_data={"range": {"KNOWN": 1}})).check("echoes", "strip.las")


def test_timing_is_kept_apart():
    timed = _report() + RunReport(timing={"read": Seconds(2.0, 3.0)})
    assert timed.to_json() == _report().to_json()
    assert (timed + timed).timing == {"read": Seconds(4.0, 6.0)}


def test_quantiles_are_those_of_the_values_to_the_width_of_a_bin(rng):
    values = rng.lognormal(3.0, 1.0, 20_000)
    for bins in (AMPLITUDE_BINS, WIDTH_BINS):
        counts = bins.count(values)
        assert counts.sum() == len(values)
        for share in (0.05, 0.5, 0.95):
            assert bins.quantile(counts, share) == pytest.approx(np.quantile(values, share), rel=0.03)
    assert AMPLITUDE_BINS.quantile(AMPLITUDE_BINS.count(np.empty(0)), 0.5) is None


@pytest.mark.parametrize("bins", [AMPLITUDE_BINS, WIDTH_BINS])
def test_a_quantile_is_the_middle_of_its_bin(bins):
    for place in (0, 200, 700):
        centre = bins.low * np.exp((place + 0.5) * bins.step)
        edges = centre * np.exp(0.49 * bins.step * np.array([-1.0, 1.0]))
        for value in edges:
            assert bins.quantile(bins.count(np.array([value])), 0.5) == pytest.approx(centre, rel=5e-4)


def test_histograms_leave_out_what_is_no_positive_number_and_keep_what_is_beyond():
    counts = WIDTH_BINS.count(np.array([np.nan, np.inf, -1.0, 0.0, 1e-9, 1e9]))
    assert counts.sum() == 2 and counts[0] == 1 and counts[-1] == 1


def test_widths_are_full_widths_and_many_echoes_share_a_bin():
    report = RunReport.of_echoes(np.array([0, 1, OVERFLOW + 5]), np.array([9.0]), np.array([2.0]))
    quality = report.to_json()["quality"]
    assert quality["echoes_per_waveform"][0] == 1 and quality["echoes_per_waveform"][OVERFLOW] == 1
    assert quality["echo_width_ns"]["p50"] == pytest.approx(2.0 * FWHM_PER_SIGMA, rel=0.011)


def test_flags_are_counted_by_name():
    flags = np.array([EchoFlag.WEAK | EchoFlag.ADDED, EchoFlag.WEAK, 0], np.uint16)
    assert count_flags(flags) == {"WEAK": 2, "ADDED": 1}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("done")
    simulate_strip("flat", folder / "a.las", pulses=100, seed=1)
    run_one(folder / "a.las", folder / "out")
    return folder


def _alter(value, *keys):
    def alter(document):
        place = document
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        return document

    return alter


BY_HAND = (
    _alter(7, "counts", "echoes"),
    _alter("0" * 64, "checksum"),
    lambda document: [document],
    lambda document: {key: value for key, value in document.items() if key != "checksum"},
)
BY_ANOTHER_PROGRAM = (
    _alter(math.inf, "counts", "echoes"),
    _alter(3, "counts", "no_data"),
    _alter(None, "quality"),
    _alter("other.laz", "output", "file"),
    _alter(1, "output", "size"),
    _alter("9.9", "version"),
    _alter("wavebatch.strip-report/0", "schema"),
)
"""Their checksum is right."""


@pytest.mark.parametrize(
    ("alter", "is_right"), [*((one, False) for one in BY_HAND), *((one, True) for one in BY_ANOTHER_PROGRAM)]
)
def test_a_report_that_was_altered_is_made_anew(done, alter, is_right):
    path = done / "out" / "a.report.json"
    sound = path.read_bytes()
    document = alter(json.loads(sound))
    if is_right:
        document["checksum"] = _sum_up(document)
    path.write_text(json.dumps(document, indent=2))
    outcome = run_one(done / "a.las", done / "out", batch={"resume": True})
    assert outcome.status == "written"
    assert json.loads(path.read_text())["checksum"] == json.loads(sound)["checksum"]


@pytest.mark.parametrize("data", [b"", b"[" * 100_000, b"\xff", b"null"])
def test_a_report_that_is_no_report_is_made_anew(done, data):
    (done / "out" / "a.report.json").write_bytes(data)
    assert run_one(done / "a.las", done / "out", batch={"resume": True}).status == "written"


@pytest.mark.parametrize(
    ("scene", "samples", "points"), [("flat", 10, "echoes"), ("flat", 10, "returns"), ("empty", 80, "echoes")]
)
def test_returns_without_an_echo_are_named_where_they_have_an_intensity(tmp_path, scene, samples, points):
    """Echoes that fill their packets were taken for noise: four of five were lost in silence."""
    simulate = "simulate", scene, "-o", tmp_path / "s.las", "--samples", str(samples), "--pulses", "1000", "-q"
    assert run_command(*simulate).exit_code == 0
    done = run_command("run", tmp_path / "s.las", "-o", tmp_path / "out", "--points", points, "--quiet")
    unseen = read(tmp_path / "out")["quality"]["unseen_returns"]
    assert (unseen > 500) == (scene == "flat")
    assert (f"{unseen} of 992 returns with an intensity have packets" in done.stderr) == (scene == "flat")
