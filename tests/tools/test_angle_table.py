"""`wavebatch survey --angles`: the table says what the stage would write, and what the survey predicts."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from commands import run_command

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA, C
from wavebatch.core.waveforms import LevelWidths, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.physics.incidence import angles_of_variance, spread_of_angle
from wavebatch.stages.attribute.basic import added_variance
from wavebatch.surveying.flat_ground import REFERENCE_ERROR, SLOPE, predict_angles
from wavebatch.tools.sheets.survey import ANGLES, tabulate_angles

GAUSSIAN = SystemPulse(sigma_ref=2.0, noise=ReceiverNoise(baseline=12.0, std=1.0), widths=LevelWidths(scatter=0.01))


def run(*words):
    return run_command("survey", *words)


def test_widths_are_the_pulse_and_the_spread_of_a_plane():
    found = tabulate_angles(GAUSSIAN, 1.0, 700.0, 0.5, 80.0)
    spread = 700.0 * 0.5e-3 / 2 * np.tan(np.radians(ANGLES)) / C
    assert found.spread == pytest.approx(spread, rel=1e-9)
    assert found.width == pytest.approx(FWHM_PER_SIGMA * np.hypot(2.0, spread), rel=1e-3)
    assert (np.diff(found.width) >= 0).all() and (np.diff(found.error[40:]) < 0).all()


def test_errors_are_those_that_the_survey_predicts():
    # Of weak echoes many are read as far less, even as 0: the rms error is larger than the error of the middle width.
    for amplitude, distance, within in ((30.0, 700.0, 0.2), (300.0, 700.0, 0.35), (300.0, 3000.0, 0.02)):
        found = tabulate_angles(GAUSSIAN, 1.0, distance, 0.5, amplitude)
        predicted = predict_angles(GAUSSIAN, 1.0, distance, 0.5, amplitude).error
        assert found.error[int(SLOPE)] == pytest.approx(predicted, rel=within)


def test_level_ground_that_is_wider_than_the_pulse_shifts_the_table():
    wide = replace(GAUSSIAN, widths=replace(GAUSSIAN.widths, variance=0.5))
    found = tabulate_angles(wide, 1.0, 700.0, 0.5, 80.0)
    assert found.width[0] == pytest.approx(FWHM_PER_SIGMA * np.sqrt(4.5), rel=1e-3)


def test_angles_that_no_width_means_are_empty():
    found = tabulate_angles(replace(GAUSSIAN, widths=replace(GAUSSIAN.widths, variance=-3.999)), 1.0, 700.0, 0.5, 80.0)
    assert np.isnan(found.width[0]) and np.isnan(found.error[0])


def test_command_writes_and_draws(riegl, tmp_path):
    target = tmp_path / "a.csv"
    result = run(riegl, "--divergence", 0.5, "--angles", target)
    assert result.exit_code == 0 and f"{target}: written" in result.stderr, result.output
    rows = list(csv.DictReader(target.read_text().splitlines()))
    assert [float(row["angle_deg"]) for row in rows] == ANGLES.tolist()
    assert {row["divergence_mrad"] for row in rows} == {"0.5"} and 100 < float(rows[0]["distance_m"]) < 5000
    refused = run(riegl, "--divergence", 0.5, "--angles", target)
    assert refused.exit_code in (1, 2) and "--overwrite" in refused.stderr
    assert run(riegl, "--divergence", 0.5, "--angles", tmp_path / "a.svg").exit_code == 0
    text = (tmp_path / "a.svg").read_text("utf-8")
    assert "incidence angle [deg]" in text and riegl.name in text


@pytest.mark.parametrize("amplitude", [20.0, 100.0, 1000.0])
def test_errors_are_those_of_many_echoes_through_the_stage_and_do_not_jump(amplitude):
    """Widths of echoes with noise at the bound go through the stage; the scatter of their angles is the error."""
    distance, divergence, rng = 700.0, 0.5, np.random.default_rng(3)
    found = tabulate_angles(GAUSSIAN, 1.0, distance, divergence, amplitude)
    block = WaveformBlock.from_samples(np.zeros((1, 2), np.uint8), bits=8, spacing=1.0)
    for angle in (0, 3, 10, 30, 60):
        true = found.width[angle] / FWHM_PER_SIGMA
        bound = bound_time(amplitude, true, GAUSSIAN.noise.std, 1.0)
        # The survey's widths scatter, and its reference has an error, as the stage assumes.
        width = true + rng.normal(0, np.hypot(bound, GAUSSIAN.widths.scatter), 4000)
        width += rng.normal(0, 2.0 * 2.0 * REFERENCE_ERROR / (2 * true) * 2.0, 4000)
        zero = np.zeros(len(width))
        echoes = EchoTable.build(zero.astype(int), zero, zero + amplitude, width, sigma_err=zero + bound)
        variance, error = added_variance(block, GAUSSIAN, echoes, "system", REFERENCE_ERROR)
        given = angles_of_variance(variance, error, np.full(len(width), distance), 1e-3 * divergence)[0]
        rms = np.sqrt(np.nanmean((np.degrees(given) - angle) ** 2))
        assert found.error[angle] == pytest.approx(rms, rel=0.06), angle
    assert np.abs(np.diff(np.log(found.error))).max() < 0.25, "the error jumped by 40 % from one degree to the next"


@pytest.mark.parametrize("level_error", [0.02, 0.2])
def test_what_is_not_known_of_level_ground_is_in_the_error_of_every_angle(level_error):
    """The least variance of a facing surface has an error, which no strong echo can undercut."""
    block = WaveformBlock.from_samples(np.zeros((1, 2), np.uint8), bits=8, spacing=1.0)
    echoes = EchoTable.build([0, 0], [5.0, 30.0], [1e4, 50.0], [2.5, 2.5], sigma_err=np.array([1e-4, 0.05]))
    sharp = replace(GAUSSIAN, widths=replace(GAUSSIAN.widths, scatter=0.0))
    alone = added_variance(block, sharp, echoes, "system", 1e-4)[1]
    system = replace(sharp, widths=replace(sharp.widths, error=level_error))
    found = added_variance(block, system, echoes, "system", 1e-4)[1]
    assert found == pytest.approx(np.hypot(alone, level_error), rel=1e-6) and found.min() >= level_error
    unsure = replace(sharp, widths=replace(sharp.widths, error=0.2))
    flat, given = (tabulate_angles(one, 1.0, 700.0, 0.5, 1000.0) for one in (sharp, unsure))
    assert (given.error[10:70] > 2 * flat.error[10:70]).all()


def test_a_picture_of_angles_is_refused_before_the_survey(riegl, tmp_path, monkeypatch):
    monkeypatch.setattr("wavebatch.cli.survey._survey", None)  # nothing is surveyed
    refused = run(riegl, "--divergence", 0.5, "--angles", tmp_path / "a.bmp")
    assert refused.exit_code == 2 and "a.bmp" in refused.stderr and ".svg" in refused.stderr, refused.output


def test_what_rough_ground_adds_is_in_the_errors_of_the_table_and_of_the_prediction():
    """Rough ground of so much variance looks like 30 degrees: all of them are the error there, and less beyond."""
    added = float(spread_of_angle(np.radians(SLOPE), 700.0, 0.5e-3)) ** 2
    rough = replace(GAUSSIAN, widths=replace(GAUSSIAN.widths, rough=added))
    smooth, found = (tabulate_angles(one, 1.0, 700.0, 0.5, 1000.0).error for one in (GAUSSIAN, rough))
    assert found[30] == pytest.approx(np.hypot(smooth[30], 30.0), rel=1e-3) and found[60] < 0.3 * found[30]
    before, after = (predict_angles(one, 1.0, 700.0, 0.5, 1000.0).error for one in (GAUSSIAN, rough))
    assert after == pytest.approx(np.hypot(before, 30.0), rel=1e-3)
