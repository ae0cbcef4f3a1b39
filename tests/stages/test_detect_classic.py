"""Classic detectors, ours and the papers': isolated echoes, detection probabilities (docs/algorithms.md 1.3), runs."""

import naive
import numpy as np
import pytest
from contract_tools import record
from given_echoes import fine_recording, known_system
from published import PULSE_SIGMA as SIGMA

from wavebatch.core.waveforms import Noise, WaveformBlock
from wavebatch.kernels.signal.filters import filter_antisymmetric, slope_taps
from wavebatch.kernels.signal.runs import find_runs, run_moments
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


def test_the_edge_itself_walks_with_the_amplitude():
    block, noise = record(2, ([20.0, 200.0], 40.0), std=0.0)
    edge = detect("threshold", block, noise, correct_walk=False).time
    wide = np.sqrt(SIGMA**2 + 0.5)
    trigger = 4 * np.sqrt(6) / 4 / (np.array([20, 200]) * SIGMA / wide)
    np.testing.assert_allclose(edge, 40 - wide * np.sqrt(-2 * np.log(trigger)), atol=0.13)


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_a_fraction_must_be_one(fraction):
    block, noise = record(1, (20, [40.0]))
    with pytest.raises(ValueError, match="between 0 and 1"):
        detect("constant_fraction", block, noise, fraction=fraction)


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


def test_noise_never_lasts_as_long_as_a_pulse():
    block, noise = record(5000, seed=5, s=200)
    assert len(detect("sustained_threshold", block, noise)) == 0


def test_a_pulse_of_twenty_samples_per_ns_must_last_a_hundred_samples():
    s, spacing = 400, 0.05
    y = np.zeros((2, s))
    y[0, 100:199] = y[1, 100:200] = 5
    block = WaveformBlock.from_samples(np.rint(500 + 100 * y).astype(np.uint16), spacing=spacing)
    noise = Noise(np.full(2, 500, np.float32), np.full(2, 100, np.float32))
    assert detect("sustained_threshold", block, noise).waveform.tolist() == [1]


def test_moments_of_runs_equal_those_of_a_loop():
    signal = np.random.default_rng(17).integers(-1, 5, (17, 80)).astype(np.float32)
    level = np.random.default_rng(2).integers(-2, 4, 80).astype(np.float32)
    mean, spread = run_moments(signal, *find_runs(signal, level))
    expected = naive.find_runs(signal, level)
    assert len(mean) == len(expected) > 10
    for row, (w, a, b) in enumerate(expected):
        y, x = np.maximum(signal[a:b, w], 0), np.arange(a, b)
        middle = np.average(x, weights=y) if y.any() else (a + b - 1) / 2
        assert mean[row] == pytest.approx(middle, abs=1e-9)
        variance = np.average((x - middle) ** 2, weights=y) if y.any() else 0
        assert spread[row] ** 2 == pytest.approx(variance, abs=1e-9)


@pytest.mark.parametrize("s", [1, 4, 50])
def test_antisymmetric_filters_equal_a_double_loop(s):
    signal = np.random.default_rng(4).standard_normal((s, 5)).astype(np.float32)
    taps = slope_taps(1.2)
    expected = np.stack([naive.correlate_antisymmetric(column, taps) for column in signal.T], axis=1)
    np.testing.assert_allclose(filter_antisymmetric(signal, taps), expected, atol=1e-5)


def test_slopes_of_straight_lines_are_exact():
    line = np.linspace(0, 30, 31, dtype=np.float32)[:, None] * 3
    taps = slope_taps(1.2)
    reach = len(taps)
    slopes = filter_antisymmetric(line, taps)
    np.testing.assert_allclose(slopes[reach:-reach], 3, rtol=1e-5)
