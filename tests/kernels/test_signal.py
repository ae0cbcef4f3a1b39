"""Filters, peaks, runs and quiet samples of whole blocks against loops over single waveforms."""

import naive
import numpy as np
import pytest

from wavebatch.kernels.signal import signal as signals
from wavebatch.kernels.signal.filters import (
    curvature_taps,
    filter_energy,
    filter_symmetric,
    gaussian_taps,
    refine_peaks,
)
from wavebatch.kernels.signal.runs import find_runs, walk_down


@pytest.fixture
def rng():
    return np.random.default_rng(17)


def integers(rng, s, n, top):
    """Small whole numbers, so that ties and plateaus are everywhere."""
    return rng.integers(0, top, (s, n)).astype(np.float32)


def test_transposed_samples_are_contiguous_floats(rng):
    raw = rng.integers(0, 65536, (5, 9)).astype(np.uint16)
    signal = signals.transpose_samples(raw)
    assert signal.dtype == np.float32
    assert signal.flags.c_contiguous
    np.testing.assert_array_equal(signal, raw.T)


@pytest.mark.parametrize("s", [1, 2, 3, 40])
def test_smoothing_equals_the_plain_filter(rng, s):
    signal = integers(rng, s, 6, 200)
    expected = np.stack([naive.smooth_121(column) for column in signal.T], axis=1)
    np.testing.assert_array_equal(signals.smooth_121(signal), expected)


def test_smoothing_lets_the_stated_noise_through(rng):
    noise = rng.standard_normal((400, 500)).astype(np.float32)
    assert signals.smooth_121(noise)[1:-1].std() == pytest.approx(signals.SMOOTH_GAIN, rel=0.01)


@pytest.mark.parametrize("s", [1, 2, 3, 25])
@pytest.mark.parametrize("top", [2, 4, 50])
def test_peaks_equal_those_of_a_loop(rng, s, top):
    signal = integers(rng, s, 120, top)
    threshold = rng.uniform(-1, top - 1, 120).astype(np.float32)
    waveform, sample = signals.find_peaks(signal, threshold)
    assert list(zip(waveform.tolist(), sample.tolist(), strict=True)) == naive.find_peaks(signal, threshold)


def test_peaks_of_nothing():
    waveform, sample = signals.find_peaks(np.zeros((8, 0), np.float32), 1.0)
    assert len(waveform) == len(sample) == 0


def test_a_step_of_a_flank_is_no_peak():
    signal = np.array([[0, 1, 1, 2, 2, 3, 1, 2, 2, 0]], np.float32).T
    assert signals.find_peaks(signal, 0.0)[1].tolist() == [5, 7]


def test_peaks_of_more_waveforms_than_sixteen_bits_count():
    signal = np.zeros((3, 70_000), np.float32)
    signal[1, [3, 65_540, 69_999]] = 5
    assert signals.find_peaks(signal, 1.0)[0].tolist() == [3, 65_540, 69_999]


@pytest.mark.parametrize("reach", [0, 1, 2, 3, 7, 12, 40])
def test_widened_masks_equal_those_of_a_loop(rng, reach):
    mask = rng.random((30, 50)) < 0.04
    np.testing.assert_array_equal(signals.widen(mask, reach), naive.widen(mask, reach))


@pytest.mark.parametrize("s", [1, 2, 17])
def test_runs_equal_those_of_a_loop(rng, s):
    signal = integers(rng, s, 60, 4)
    level = rng.integers(0, 4, 60).astype(np.float32)
    starts, ends = find_runs(signal, level)
    expected = naive.find_runs(signal, level)
    assert starts.tolist() == [w * s + a for w, a, _ in expected]
    assert ends.tolist() == [w * s + b for w, _, b in expected]


@pytest.mark.parametrize("reach", [0, 3])
def test_quiet_samples_keep_away_from_signal(rng, reach):
    signal = rng.standard_normal((40, 30)).astype(np.float32)
    signal[20, ::2] += 40
    smoothed = np.stack([naive.smooth_121(column) for column in signal.T], axis=1)
    quiet = signals.find_quiet(signal, 2.5, reach)
    np.testing.assert_array_equal(quiet, ~naive.widen(np.abs(smoothed) > 2.5, reach))
    mean, number = signals.quiet_mean(signal, quiet)
    for w in range(30):
        assert number[w] == quiet[:, w].sum()
        assert mean[w] == pytest.approx(signal[quiet[:, w], w].mean(), abs=1e-5)


def test_mean_without_quiet_samples_is_zero():
    mean, number = signals.quiet_mean(np.full((5, 2), 9.0, np.float32), np.zeros((5, 2), bool))
    assert mean.tolist() == [0, 0]
    assert number.tolist() == [0, 0]


def test_mean_of_a_single_quiet_sample_is_that_sample():
    mean, number = signals.quiet_mean(np.full((5, 1), 9.0, np.float32), np.arange(5)[:, None] == 3)
    assert mean.tolist() == [9] and number.tolist() == [1]


@pytest.mark.parametrize("taps", [gaussian_taps(2.0), curvature_taps(1.4), np.array([1.0]), gaussian_taps(300.0)])
@pytest.mark.parametrize("s", [1, 4, 50, 700])
def test_symmetric_filters_equal_a_double_loop(rng, taps, s):
    signal = rng.standard_normal((s, 5)).astype(np.float32)
    expected = np.stack([naive.correlate_symmetric(column, taps) for column in signal.T], axis=1)
    np.testing.assert_allclose(filter_symmetric(signal, taps), expected, rtol=1e-4, atol=1e-4 if s > 99 else 1e-5)


@pytest.mark.parametrize("taps", [gaussian_taps(2.0), gaussian_taps(300.0)])
def test_symmetric_filters_give_the_same_bits_however_waveforms_lie_in_memory(rng, taps):
    signal = rng.standard_normal((700, 5)).astype(np.float32)
    filtered = filter_symmetric(signal, taps)
    np.testing.assert_array_equal(filter_symmetric(np.asfortranarray(signal), taps), filtered)
    np.testing.assert_array_equal(filter_symmetric(signal[:, 2:3], taps), filtered[:, 2:3])


@pytest.mark.parametrize("taps", [gaussian_taps(2.0), curvature_taps(1.4)])
def test_filters_let_the_stated_noise_through(rng, taps):
    noise = rng.standard_normal((200, 1000)).astype(np.float32)
    reach = len(taps)
    assert filter_symmetric(noise, taps)[reach:-reach].std() == pytest.approx(np.sqrt(filter_energy(taps)), rel=0.01)


def test_curvature_ignores_the_level():
    taps = curvature_taps(1.4)
    assert taps[0] + 2 * taps[1:].sum() == pytest.approx(0, abs=1e-12)


def test_refined_peaks_of_gaussians_are_exact():
    time = np.array([10.0, 10.3, 9.6, 10.49])
    x = np.arange(21)[:, None]
    signal = (37.0 * np.exp(-0.5 * ((x - time) / 2.0) ** 2)).astype(np.float32)
    waveform, sample = signals.find_peaks(signal, 20.0)
    refined, height = refine_peaks(signal, waveform, sample)
    np.testing.assert_allclose(refined, time, atol=2e-5)
    np.testing.assert_allclose(height, 37.0, rtol=1e-5)


def test_refined_peaks_stay_put_where_no_parabola_holds():
    signal = np.array([[5, 1, 0, 0, 7, -1, 0, 9], [9, 9, 9, 9, 9, 9, 9, 9]], np.float32).T.copy()
    at = (np.array([0, 0, 0, 1]), np.array([0, 4, 7, 3]))
    refined, height = refine_peaks(signal, *at)
    assert refined.tolist() == [0, 4, 7, 3]
    assert height.tolist() == [5, 7, 9, 9]


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
