"""Runs and flanks of whole blocks against loops over single waveforms."""

import naive
import numpy as np
import pytest

from wavebatch.kernels.signal.runs import find_runs, highest_samples, list_samples, walk_down


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


def test_highest_samples_equal_those_of_a_loop(signal):
    starts, ends, expected = runs_of(signal)
    peak = highest_samples(signal, starts, ends)
    assert len(peak) == len(expected) > 10
    for row, (w, a, b) in enumerate(expected):
        assert peak[row] == a + np.argmax(signal[a:b, w])


def test_nothing_has_no_runs():
    none = np.empty(0, np.int64)
    signal = np.zeros((5, 3), np.float32)
    assert len(highest_samples(signal, none, none)) == 0


@pytest.mark.parametrize("step", [-1, 1])
def test_walks_equal_those_of_a_loop(signal, step):
    sample, waveform = (field.ravel() for field in np.indices(signal.shape))
    level = np.random.default_rng(3).uniform(-2, 5, len(sample))
    below = level < signal[sample, waveform]
    sample, waveform, level = sample[below], waveform[below], level[below]
    place = walk_down(signal, waveform, sample, level, step)
    expected = [naive.walk_down(signal[:, w], i, v, step) for w, i, v in zip(waveform, sample, level, strict=True)]
    np.testing.assert_allclose(place, expected, atol=1e-6)
