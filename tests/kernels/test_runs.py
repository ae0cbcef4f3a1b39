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


@pytest.mark.parametrize(("text", "peak", "level", "ahead", "behind"), [
    ("0 2 4 8 6 2 1", 3, 3.0, 4.75, 1.5), ("0 2 4 8 6 2 1", 3, 8.0, 3.0, 3.0), ("0 2 4 8 6 2 1", 3, 2.0, 5.0, 1.0),
    ("0 2 4 8 6 2 1", 3, -1.0, 6.0, 0.0), ("5 3 8 5 6 0 0", 2, 4.0, 3.0, 1.2), ("8 8 8 4 4 4 0", 1, 4.0, 3.0, 0.0),
    ("8 8 8 4 4 4 0", 1, 3.0, 5.25, 0.0), ("8 8 8 4 4 4 0", 1, 8.0, 2.0, 0.0), ("9", 0, 1.0, 0.0, 0.0),
])  # fmt: skip
def test_walks_end_at_the_level_a_rise_or_the_end(text, peak, level, ahead, behind):
    signal = np.array(text.split(), np.float32)[:, None] * np.ones(3, np.float32)
    for step, place in ((1, ahead), (-1, behind)):
        found = walk_down(signal, np.array([2, 0]), np.full(2, peak), np.full(2, level), step)
        assert found.tolist() == pytest.approx([place] * 2)
