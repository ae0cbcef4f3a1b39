"""Classic detectors, ours and the papers': isolated echoes, detection probabilities (docs/algorithms.md 1.3), runs."""

import numpy as np
import pytest
from commands import refuses
from contract_tools import record
from given_echoes import fine_recording, known_system
from published import PULSE_SIGMA as SIGMA

from wavebatch.stages.chain import STAGES

SYSTEM = known_system(fine_recording(1.0, SIGMA))


def detect(name, block, noise, **parameters):
    return STAGES[f"detect.{name}"].function(block, noise, SYSTEM, **parameters)


@pytest.mark.parametrize(
    ("name", "parameters", "off"),
    [("threshold", {}, 0.08), ("constant_fraction", {}, 0.08), ("sustained_threshold", {}, 0.15),
     ("center_of_gravity", {}, 0.15), ("zero_crossing", {}, 0.15), ("zero_crossing", {"derivative": "second"}, 0.15)],
)  # fmt: skip
def test_isolated_echoes_are_found_at_their_peak(name, parameters, off):
    time = np.linspace(30, 42, 200)
    for amplitude in (15, 60, 240):
        block, noise = record(200, (amplitude, time), std=0.0)
        found = detect(name, block, noise, **parameters)
        assert found.waveform.tolist() == list(range(200))
        np.testing.assert_allclose(found.time, time, atol=off)
        if off < 0.1:
            assert abs(np.mean(found.time - time)) < 0.02, "early by .1 sample where the flank counts as straight"
        np.testing.assert_allclose(found.amplitude, 100 * amplitude, rtol=0.15)


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_a_fraction_must_be_one(fraction):
    block, noise = record(1, (20, [40.0]))
    refuses(ValueError, "between 0 and 1", detect, "constant_fraction", block, noise, fraction=fraction)


RATIOS = range(2, 9)
"""Amplitude over noise."""


@pytest.mark.parametrize(
    ("name", "ratio", "published"),
    # T8: the matched filter at 0.1 % false alarms; 3 standard deviations over 5 samples in a row.
    [*(("matched_filter", *row) for row in zip(RATIOS, (0.395, 0.95, 1, 1, 1, 1, 1), strict=True)),
     *(("sustained_threshold", *row)
       for row in zip(RATIOS, (0, 0.001, 0.054, 0.332, 0.699, 0.895, 0.979), strict=True))],
)  # fmt: skip
def test_detection_probabilities_of_the_paper(name, ratio, published):
    n = 3000
    time = 40 + np.random.default_rng(ratio).uniform(-0.5, 0.5, n)
    block, noise = record(n, (ratio, time), seed=10 + ratio)
    found = detect(name, block, noise)
    near = np.abs(found.time - time[found.waveform]) < 4
    assert np.bincount(found.waveform[near], minlength=n).astype(bool).mean() == pytest.approx(published, abs=0.045)


def test_pairs_with_one_run_are_one_echo_for_levels_and_two_for_derivatives():
    block, noise = record(1, (60, [30.0]), (40, [37.0]), std=0.0)
    gravity, sustained = (detect(name, block, noise).time for name in ("center_of_gravity", "sustained_threshold"))
    assert len(gravity) == len(sustained) == 1
    assert gravity[0] == pytest.approx((60 * 30 + 40 * 37) / 100, abs=0.1)
    np.testing.assert_allclose(detect("zero_crossing", block, noise).time, [30, 37], atol=0.4)
    inflections = detect("zero_crossing", block, noise, derivative="second")
    np.testing.assert_allclose(inflections.time, [30, 37], atol=0.5)


def test_half_of_the_distance_of_the_inflections_is_the_width():
    block, noise = record(20, (200, np.linspace(39, 41, 20)), std=0.0)
    np.testing.assert_allclose(detect("zero_crossing", block, noise, derivative="second").sigma, SIGMA, rtol=0.03)
