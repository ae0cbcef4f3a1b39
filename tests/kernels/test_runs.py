"""Runs, flanks and slopes of whole blocks against loops over single waveforms."""

import naive
import numpy as np
import pytest

from wavebatch.kernels.signal.filters import filter_antisymmetric, slope_taps
from wavebatch.kernels.signal.runs import find_runs, highest_samples, list_samples, run_moments, walk_down


@pytest.fixture(params=[1, 2, 17])
def signal(request):
    """Small whole numbers, so that ties are everywhere, and many runs."""
    return np.random.default_rng(request.param).integers(-1, 5, (request.param, 80)).astype(np.float32)


def runs_of(signal):
    level = np.random.default_rng(2).integers(-2, 4, signal.shape[1]).astype(np.float32)
    return (*find_runs(signal, level), naive.find_runs(signal, level))


def test_samples_of_runs(signal):
    starts, ends, expected = runs_of(signal)
    run, place = list_samples(starts, ends)
    listed = [(r, w * len(signal) + i) for r, (w, a, b) in enumerate(expected) for i in range(a, b)]
    assert list(zip(run.tolist(), place.tolist(), strict=True)) == listed


def test_highest_samples_and_moments_equal_those_of_a_loop(signal):
    starts, ends, expected = runs_of(signal)
    peak = highest_samples(signal, starts, ends)
    mean, spread = run_moments(signal, starts, ends)
    assert len(peak) == len(mean) == len(expected) > 10
    for row, (w, a, b) in enumerate(expected):
        assert peak[row] == a + np.argmax(signal[a:b, w])
        y, x = np.maximum(signal[a:b, w], 0), np.arange(a, b)
        middle = np.average(x, weights=y) if y.any() else (a + b - 1) / 2
        assert mean[row] == pytest.approx(middle, abs=1e-9)
        variance = np.average((x - middle) ** 2, weights=y) if y.any() else 0
        assert spread[row] ** 2 == pytest.approx(variance, abs=1e-9)


def test_nothing_has_no_runs():
    none = np.empty(0, np.int64)
    signal = np.zeros((5, 3), np.float32)
    assert len(highest_samples(signal, none, none)) == len(run_moments(signal, none, none)[0]) == 0


@pytest.mark.parametrize("step", [-1, 1])
def test_walks_equal_those_of_a_loop(signal, step):
    sample, waveform = (field.ravel() for field in np.indices(signal.shape))
    level = np.random.default_rng(3).uniform(-2, 5, len(sample))
    below = level < signal[sample, waveform]
    sample, waveform, level = sample[below], waveform[below], level[below]
    place = walk_down(signal, waveform, sample, level, step)
    expected = [naive.walk_down(signal[:, w], i, v, step) for w, i, v in zip(waveform, sample, level, strict=True)]
    np.testing.assert_allclose(place, expected, atol=1e-6)


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
    np.testing.assert_allclose(filter_antisymmetric(line, taps)[reach:-reach], 3, rtol=1e-5)
