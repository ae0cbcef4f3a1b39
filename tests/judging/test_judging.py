"""The judges say what is true of answers that are known; the fast tests run one small stranger."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from injections import classify, format_classes, inject
from real import Decomposed, main
from reference_fit import FINE, Fitter, Waveform
from stranger_strips import draw_sensor, make_shape, make_strip
from strangers import judge_strip, score, tabulate, verdict
from strip_parts import list_packets, write_part

import wavebatch as wb

SMALL = 7
"""A stranger with few packets of open ground: any survey should be right."""
LONE = 0
"""A stranger with enough lone echoes to stack its pulse."""


@pytest.fixture(scope="module")
def strip(tmp_path_factory) -> Path:
    return make_strip(SMALL, tmp_path_factory.mktemp("strangers"))


@pytest.fixture(scope="module")
def answer(strip) -> dict[str, np.ndarray]:
    """The truth as an answer that a decomposition could give."""
    with np.load(strip.with_suffix(".npz")) as truth:
        found = {name: truth[name] for name in ("packet", "time", "amplitude")}
    order = np.lexsort((found["time"], found["packet"]))
    found = {name: column[order] for name, column in found.items()}
    ones = np.ones(len(order))
    return found | {"time_err": 0.01 * ones, "amplitude_err": 0.1 * ones}


def judge(strip: Path, found: dict[str, np.ndarray]) -> dict:
    with np.load(strip.with_suffix(".npz")) as truth:
        return score(draw_sensor(SMALL)[0], dict(truth), found)


def test_the_truth_is_right_also_where_all_of_it_is_late(strip, answer):
    for late in (0.0, 1.5):
        result = judge(strip, answer | {"time": answer["time"] + late})
        assert result["right"] and result["missed"] == result["extra"] == 0
        assert result["clear"] > 0.9 * result["true"] and result["time_scatter"] < 1e-6


def test_missing_echoes_are_missed(strip, answer):
    result = judge(strip, {name: column[::2] for name, column in answer.items()})
    assert not result["right"] and 0.4 < result["missed"] < 0.6 and result["extra"] == 0


def test_one_half_of_a_split_echo_is_extra(strip, answer):
    both = {name: np.repeat(column, 2) for name, column in answer.items()}
    both["time"] = both["time"] + np.tile([-0.2, 0.2], len(answer["time"])) * draw_sensor(SMALL)[0].fwhm
    result = judge(strip, both)
    assert not result["right"] and result["missed"] == 0 and result["extra"] == pytest.approx(0.5)


def test_a_small_stranger_is_judged(strip):
    result = judge_strip(SMALL, strip.parent)
    assert "error" not in result and result["survey_s"] > 0
    assert result["missed"] < 0.05 and result["extra"] < 0.05 and abs(result["width_ratio"] - 1) < 0.1
    head, every, *_ = tabulate([result], [result | {"right": False}]).splitlines()
    assert "wrong before" in head and every.split()[:2] == ["all", "1"]
    assert verdict({"right": False, "doubts": []}) == "silent"


def test_a_part_of_a_strip_holds_its_packets_only(strip, tmp_path):
    keep = list_packets(strip) % 3 == 1
    with wb.open_strip(strip) as whole, wb.open_strip(write_part(strip, keep, tmp_path / "part.las")) as part:
        one, other = next(whole.blocks()), next(part.blocks())
    np.testing.assert_array_equal(one.samples[keep], other.samples)
    np.testing.assert_allclose(one.origin[keep], other.origin)


@pytest.mark.slow
def test_the_reference_fit_finds_clear_echoes(tmp_path):
    sensor, path = draw_sensor(LONE)[0], make_strip(LONE, tmp_path)
    with wb.open_strip(path) as opened:
        block = next(opened.blocks(200))
    every = np.ones(sensor.samples, bool)
    waveforms = [Waveform(row, samples.astype(float), every) for row, samples in enumerate(block.samples)]
    fitter = Fitter(waveforms, None)
    assert fitter.pulse.fwhm == pytest.approx(sensor.fwhm, rel=0.06)
    with np.load(path.with_suffix(".npz")) as truth:
        packet, time = truth["packet"], truth["time"]
    for row in range(0, 40, 4):
        true, times = np.sort(time[packet == row]), fitter.fit(waveforms[row])[0][:, 0]
        assert len(times) == len(true)
        assert np.abs(times - true).max(initial=0) < 0.2 * sensor.fwhm


@pytest.mark.slow
def test_injected_echoes_are_counted_by_height_and_separation(tmp_path):
    """With the true pulse strong ones are found, weak and close ones are not, and a survey that is deaf is seen."""
    sensor, path = draw_sensor(LONE)[0], make_strip(LONE, tmp_path)
    lag, height, _ = make_shape(sensor)
    fine = np.arange(lag[0] * sensor.fwhm, lag[-1] * sensor.fwhm, 1 / FINE)
    with wb.open_strip(path) as opened:
        strip, survey = Decomposed(opened), wb.survey(opened)
    noise = survey.system.noise.std
    reference = {"lag": fine, "pulse": np.interp(fine / sensor.fwhm, lag, height[0]), "noise": noise}
    deaf = replace(survey, system=replace(survey.system, noise=replace(survey.system.noise, std=4 * noise)))
    tables = strip.run(survey)
    one, same, off = (classify(strip, system, tables, reference, seed=1) for system in (survey, survey, deaf))
    for name in one:
        np.testing.assert_array_equal(one[name], same[name])

    def share(echoes, kind, low, high, near=None):
        beside = np.isnan(echoes["lag"]) if near is None else (abs(echoes["lag"]) >= near[0]) & (
            abs(echoes["lag"]) < near[1])  # fmt: skip
        which = beside & (echoes["height"] >= low) & (echoes["height"] < high)
        assert which.sum() > 40
        return echoes[kind][which].mean()

    assert share(one, "found", 10, 160) > 0.98 and share(one, "found", 2.5, 4) < 0.9
    assert share(one, "found", 4, 10, (2, 4)) > 0.9 > 0.7 > share(one, "found", 2.5, 8, (0.5, 0.75))
    assert share(one, "further", 10, 160) < 0.02 and share(off, "found", 8, 12) < 0.5
    strong = (one["height"] > 10) & np.isnan(one["lag"]) & (one["found"] > 0)
    for kind in ("time", "amplitude"):
        assert 0.8 < 1.4826 * np.median(np.abs(one[kind][strong])) < 1.25
    text = format_classes(one)
    assert "alone, noises" in text and "before 10-20" in text and "0.5-0.75" in text
    result = inject(strip, survey, tables, reference)
    assert result["found_far"] > 98 and 0.8 < result["t_far"] < 1.25 and result["injected"] > 100


def test_a_strip_that_cannot_be_judged_is_said(tmp_path, capfd):
    assert main(["--strips", str(tmp_path / "none.las"), "--brief", "--cache", str(tmp_path)]) == 1
    assert "none.las: cannot be read" in capfd.readouterr().err


@pytest.mark.slow
def test_a_strip_is_judged_by_its_path(strip, tmp_path, capfd):
    out = tmp_path / "real.jsonl"
    assert main(["--strips", str(strip), "--brief", "--classes", "1", "--cache", str(tmp_path), "-o", str(out)]) == 0
    result = json.loads(out.read_text())
    assert result["strip"] == strip.stem and result["complete"] > 90 and "alone, noises" in result["classes"]
    assert f"{strip.stem}: injected echoes" in capfd.readouterr().out
