"""Reports: they add up, merge, and survive being written."""

import json

import numpy as np
import pytest

from wavebatch.batch.counts import AMPLITUDE_BINS, COUNTS, OVERFLOW, WIDTH_BINS, RunReport, count_flags
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import StageError
from wavebatch.core.process import Seconds
from wavebatch.core.units import FWHM_PER_SIGMA


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
    with pytest.raises(StageError, match=r"strip\.las: .* add up to"):
        wrong.check("echoes", "strip.las")


def test_reports_merge_in_any_order():
    a, b = _report(), _report(echoes=5)
    assert (a + b).to_json() == (b + a).to_json()
    assert (a + b).count("echoes") == 13
    assert (a + RunReport()).to_json() == a.to_json()


def test_a_report_reads_back_from_its_json():
    report = _report()
    again = RunReport.from_json(json.loads(json.dumps(report.to_json())))
    assert again.to_json() == report.to_json()
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
