"""Kernels of signal against what was put in, or a slow, plain twin: noise, defects, sums, runs, deconvolution."""

import naive
import naive_fit
import naive_signal
import numpy as np
import pytest
from scipy.linalg import toeplitz

from wavebatch.kernels.signal import noise as noise_kernels
from wavebatch.kernels.signal.deconvolve import correlate_pulse, deconvolve_wiener, fit_height, wiener_taps
from wavebatch.kernels.signal.defects import fill_spikes, find_pattern, find_spikes, find_transient, fit_slopes
from wavebatch.kernels.signal.filters import curvature_taps, filter_autocorrelation, gaussian_taps
from wavebatch.kernels.signal.runs import find_stretches, lobe_edges
from wavebatch.kernels.signal.signal import NARROW, accumulate, sum_samples, widen_after

PULSE = np.exp(-0.5 * (np.arange(-5, 6) / 1.7) ** 2)


def record(rng, n=40, s=64, level=12.0, std=1.2, amplitude=60.0):
    """Whole counts (s, n): noise about a level, and an echo at a random place."""
    y = level + std * rng.standard_normal((s, n))
    y += amplitude * np.exp(-0.5 * ((np.arange(s)[:, None] - rng.uniform(15, s - 10, n)) / 2.0) ** 2)
    return np.clip(np.rint(y), 0, 255).astype(np.float32)


@pytest.mark.parametrize("reach", [0, 1, 2, 3, 7, 12, 40])
def test_masks_widened_to_one_side(rng, reach):
    mask = rng.random((30, 50)) < 0.04
    np.testing.assert_array_equal(widen_after(mask, reach), naive_signal.widen_after(mask, reach))


@pytest.mark.parametrize("n", [1, 2, NARROW - 1, NARROW, 300])
def test_sums_are_those_of_a_loop_bit_for_bit(rng, n):
    values = rng.normal(0, 1, (40, n)).astype(np.float32)
    np.testing.assert_array_equal(sum_samples(values), naive_signal.add_up(values))
    for end in (1, 17, 40):
        np.testing.assert_array_equal(accumulate(np.add, values)[end - 1], naive_signal.add_up(values[:end]))
    mask = values < 1.5
    np.testing.assert_array_equal(accumulate(np.logical_and, mask)[-1], mask.all(axis=0))
    assert accumulate(np.add, values[:0]).shape == (0, n)


def test_stretches_and_edges_of_lobes(rng):
    mask = rng.random((30, 40)) < 0.5
    mask[0], mask[1] = False, True
    again, edges = np.zeros_like(mask), np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(int), axis=1)
    found = list(zip(*(part.tolist() for part in find_stretches(mask)), strict=True))
    for row, first, end in found:
        again[row, first:end] = True
    assert found == sorted(found) and len(found) == (edges > 0).sum() and np.array_equal(again, mask)
    x = np.cumsum(rng.uniform(0.5, 1.5, 60))
    for _ in range(20):
        curve = np.exp(-0.5 * ((x - rng.uniform(20, 40)) / rng.uniform(2, 5)) ** 2) + 0.1 * rng.random(60)
        left, right = lobe_edges(x, curve, 0.4)
        assert np.interp([left, right], x, curve) == pytest.approx(0.4) and left < x[curve.argmax()] < right
        assert (curve[(x > left) & (x < right)] > 0.4).all()


def test_spikes_are_those_of_a_loop_and_get_the_mean_of_their_neighbours(rng):
    above = record(rng, n=300) - 12
    for row, height in enumerate(np.linspace(-30, 30, 200)):
        above[rng.integers(1, 63), row] += np.float32(height)
    spikes = find_spikes(above, 1.25, 2.0)
    np.testing.assert_array_equal(spikes, naive_signal.find_spikes(above, 1.25, 2.0))
    assert 50 < spikes.sum() < 250 and not find_spikes(above[:2], 1.25, 2.0).any()
    filled = above.copy()
    fill_spikes(filled, spikes)
    for i, w in zip(*np.nonzero(spikes), strict=True):
        assert filled[i, w] == 0.5 * (above[i - 1, w] + above[i + 1, w])
    np.testing.assert_array_equal(filled[~spikes], above[~spikes])


@pytest.mark.parametrize("s", [64, 63, 9])
def test_a_pattern_of_the_converter_is_found_within_its_error(rng, s):
    pattern = [0.5, -0.2, 0.1, -0.4]
    signal = (rng.normal(12, 1, (s, 60)) + np.resize(pattern, s)[:, None]).astype(np.float32)
    quiet = rng.random(signal.shape) < 0.95
    signal[~quiet] += 50
    mean, error = find_pattern(signal, quiet)
    # A sample less the mean of the period around it, where all five samples are quiet.
    number = 60 * 0.95**5 * np.array([len(range((phase - 2) % 4, s - 4, 4)) for phase in range(4)])
    assert error == pytest.approx(np.sqrt(0.71875 / number), rel=0.2)
    assert (np.abs(mean - pattern) < 4 * error).all() and mean.sum() == pytest.approx(0, abs=1e-6)
    nothing = find_pattern(signal[:7], quiet[:7])  # not once around for every phase
    assert not nothing[0].any() and np.isinf(nothing[1]).all()


@pytest.mark.parametrize(("length", "height"), [(0, 0.0), (1, 2.0), (2, 3.0), (3, 1.0), (5, -3.0), (7, 0.8), (8, 5.0)])
def test_a_transient_ends_with_its_last_sample(rng, length, height):
    above = rng.normal(0, 1, (40, 200)).astype(np.float32)
    above[:length] += np.float32(height)
    assert find_transient(above, 1.0) == length % 8
    above[2, ::3] += 8  # scatter without a mean
    above[2, 1::3] -= 8
    assert find_transient(above, 1.0) == (3 if length == 2 else length % 8)
    above[:, ::3] += np.float32(40)
    assert find_transient(above, 1.0) == 0  # echoes lie there
    assert find_transient(above[:23], 1.0) == 0


def test_feet_of_echoes_after_the_first_samples_are_no_transient(rng):
    """Packets that begin 8 to 16 samples before the first echo, as those of NEON: their first 7 samples were lost."""
    above = rng.normal(0, 3, (64, 200)).astype(np.float32)
    mean = np.array([4, 4, 4, 5, 5, 6, 6, 7, 6, 7, 7, 8, 9, 11, 15, 19, *[40] * 48], np.float32)  # of NEON
    above += mean[:, None]
    assert find_transient(above, 3.0) == 0


@pytest.mark.parametrize("recovery", [0, 9])
def test_slopes_are_found_within_their_errors(rng, recovery):
    true = rng.uniform(-0.3, 0.3, 600)
    signal = record(rng, n=600, level=40.0, amplitude=rng.uniform(9, 60, 600))
    signal = (signal + true * np.arange(64)[:, None]).astype(np.float32)
    missing = np.zeros(signal.shape, bool)
    missing[40:] = rng.random((24, 600)) < 0.1
    missing[20:, 500:] = True  # only one end of these is known
    slope, error = fit_slopes(signal, 1.25, 3, missing=missing, recovery=recovery)
    known = np.isfinite(error)
    off = (slope - true)[known] / error[known]
    assert np.abs(np.median(off)) < 0.15 and np.std(off) == pytest.approx(1, rel=0.12) and np.abs(off).max() < 5
    assert not known[500:].any() and known[:500].mean() > (0.9 if recovery else 0.99)


def test_edges_give_level_and_noise_before_anything_is_known(rng):
    signal = record(rng, n=400, level=rng.uniform(10, 90, 400))
    signal[:12, ::5] += np.float32(40)  # begins within an echo
    level, std = noise_kernels.quiet_edges(signal)
    for w in range(400):
        first, last = signal[: noise_kernels.EDGE, w], signal[-noise_kernels.EDGE :, w]
        lower = last if last.mean() < first.mean() else first
        assert np.isnan(level[w]) or level[w] == pytest.approx(lower.mean(), abs=1e-3)
    assert np.isfinite(level).mean() > 0.9 and std == pytest.approx(np.hypot(1.2, 12**-0.5), rel=0.1)


@pytest.mark.parametrize("recovery", [0, 25])
def test_ends_lie_before_the_first_and_after_the_last_signal(rng, recovery):
    above = record(rng, level=0.0) - np.float32(0.3)
    above[:, 3] = 0
    found = noise_kernels.find_ends(above, 3.1, 6, recovery)
    for w in range(above.shape[1]):
        height = np.abs(naive.smooth_121(above[:, w]))
        busy, strong = np.flatnonzero(height > 3.1), np.flatnonzero(height > 9.3)
        quiet = np.ones(len(above), bool)
        if len(busy):
            quiet[max(busy[0] - 2, 0) : busy[-1] + 7] = False
        if len(strong) and recovery:
            quiet[busy[0] : strong[-1] + recovery + 1] = False
        np.testing.assert_array_equal(found[:, w], quiet)
    assert not noise_kernels.find_ends(np.full((20, 2), np.nan, np.float32), 3.0, 6).any()


@pytest.mark.parametrize("recovery", [0, 30])
def test_levels_are_those_of_single_waveforms(rng, recovery):
    signal = record(rng, level=rng.uniform(10, 90, 40))
    levels, quiet, number = noise_kernels.find_levels(signal, 1.25, 3, recovery=recovery)
    for w in range(signal.shape[1]):
        level, used = naive_signal.find_level(signal[:, w].astype(float), 1.25, 3, recovery=recovery)
        assert levels[w] == pytest.approx(level, abs=1e-4)
        np.testing.assert_array_equal(quiet[:, w], used)
        assert number[w] == used.sum()


def test_correlations_are_those_of_pairs(rng):
    white = rng.standard_normal((70, 50))
    signal = (12 + white[3:] + 0.6 * white[2:-1] - 0.2 * white[:-3]).astype(np.float32)
    quiet = rng.random(signal.shape) < 0.8
    quiet[15:, :10] = False  # too few
    found = noise_kernels.measure_covariance(signal, quiet, lags=6)
    assert found == pytest.approx(naive_signal.measure_covariance(signal, quiet, 6), rel=1e-4, abs=1e-4)
    beyond = signal > 13.5, signal < 11
    expected = naive_signal.measure_covariance(signal, quiet, 6, beyond)
    assert noise_kernels.measure_covariance(signal, quiet, 6, beyond) == pytest.approx(expected, rel=1e-4, abs=1e-4)
    slow, twice = np.tile(np.cumsum(white[3:], axis=0), 2).astype(np.float32), np.tile(quiet, 2)
    for columns, most in ((50, 13), (100, 49)):
        found = noise_kernels.measure_covariance(slow[:, :columns], twice[:, :columns], lags=12)
        assert 13 <= len(found) <= most and (len(found) > 20) == (columns == 100)  # tails, in few waveforms
        expected = naive_signal.measure_covariance(slow[:, :columns], twice[:, :columns], 12)
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-3)
    assert noise_kernels.measure_covariance(signal, quiet & False) is None
    residual, used = np.tile(signal.T - 12, (3, 1)), np.tile(quiet.T, (3, 1))
    residual = residual + 30 * (rng.random(residual.shape) < 0.01)  # echoes that nobody fitted
    std, correlation = noise_kernels.residual_noise(residual.astype(np.float32), used, np.array([0.1, 0.05]), lags=5)
    expected = naive_signal.residual_noise(residual.astype(np.float32), used, np.array([0.1, 0.05]), 5)
    assert std == pytest.approx(expected[0], rel=1e-5) and correlation == pytest.approx(expected[1], abs=1e-5)
    assert noise_kernels.residual_noise(residual.astype(np.float32), used & False, np.zeros(0)) is None


def test_the_longest_recording_is_kept():
    """The first one of those that are as long; all of one, and nothing of none."""
    for given, kept in (("..x...x.", "xxx...xx"), ("x..x..x.", "x..xxxxx"), ("........", "........"), ("xxx", "xxx")):
        missing = np.array([[one == "x"] for one in given])
        assert "".join("x" if lost else "." for lost in noise_kernels.keep_longest(np.tile(missing, 3))[:, 1]) == kept


def record_tails(rng, tail, n=260, s=90):
    """Waveforms (s, n) whose echoes have a tail of this share of their height."""
    time = rng.integers(12, 30, n)
    x = np.arange(s)[:, None]
    signal = 12 + rng.normal(0, 1, (s, n)) + 90 * np.exp(-0.5 * ((x - time) / 2.0) ** 2)
    return (signal + 90 * tail * (x > time) * np.exp(-np.maximum(x - time, 0) / 15.0)).astype(np.float32)


@pytest.mark.parametrize("tail", [0.0, 0.04])
def test_the_recovery_is_that_of_a_loop(rng, tail):
    signal = record_tails(rng, tail)
    pooled = noise_kernels.PooledNoise(12.0, 1.0, 1.0, 0.3, 0.7)
    found = noise_kernels.measure_recovery(signal, pooled, 4, 4.0)
    assert found == naive_signal.measure_recovery(signal, pooled, 4, 4.0)
    assert (found > 0) == (tail > 0)
    assert noise_kernels.measure_recovery(signal[:, :90], pooled, 4, 4.0) == 0


def test_coloured_noise_widens_errors_as_its_covariance_says():
    x = np.arange(-12, 13) / 2.0
    pulse = np.exp(-0.5 * x * x)
    columns = (pulse, x * pulse, x * x * pulse)
    for correlation in ((0.5, 0.2, -0.05), (0.6,), (-0.3, 0.1)):
        assert noise_kernels.colour_factors(correlation, *columns) == pytest.approx(
            naive_signal.colour_factors(correlation, *columns)
        )
    assert noise_kernels.colour_factors((), *columns) == (1.0, 1.0, 1.0, 1.0)


def test_sums_of_coloured_samples_vary_as_their_matrix_says(rng):
    for correlation, size in (((0.5, 0.2), 7), ((0.6, 0.0, 0.1, -0.1), 3), ((), 4), ((0.9,), 1)):
        rows = rng.standard_normal((3, size))
        matrix = toeplitz(np.r_[1.0, correlation, np.zeros(size)][:size])
        assert noise_kernels.coloured_variance(rows, correlation) == pytest.approx([row @ matrix @ row for row in rows])


@pytest.mark.parametrize("correlation", [(0.8, 0.64, 0.5), (0.5,), (0.86, 0.59, 0.25), (-0.3, -0.1)])
def test_a_whitening_filter_is_the_inverse_cholesky_factor_of_its_noise(correlation):
    near, far = noise_kernels.predict_noise(correlation)
    assert near + far * correlation[0] == pytest.approx(correlation[0])
    assert near * correlation[0] + far == pytest.approx((*correlation, 0.0)[1])
    rows, white = noise_kernels.whitening_filter((near, far), 1.5), naive_fit.whiten(8, np.zeros(8, bool), near, far)
    for i in range(8):
        q = min(i, 2)
        assert white[i, i - q : i + 1][::-1] == pytest.approx(rows[q, : q + 1] / 1.5)
        assert not np.abs(np.delete(white[i], range(i - q, i + 1))).max() > 1e-9


@pytest.mark.parametrize("correlation", [(1.0, 1.0), (0.8, 0.1), (0.5, 1.0), (-0.9, 0.5)])
def test_what_no_noise_has_is_not_predicted(correlation):
    assert noise_kernels.predict_noise(correlation) is None


@pytest.mark.parametrize("taps", [gaussian_taps(2.0), curvature_taps(1.4)])
def test_the_autocorrelation_of_a_filter_is_that_of_its_shifted_taps(taps):
    whole = np.r_[taps[:0:-1], taps]
    k = len(whole)
    expected = [sum(whole[i] * whole[i + lag] for i in range(k - lag)) for lag in range(k)]
    assert filter_autocorrelation(taps) == pytest.approx(np.array(expected) / expected[0])


def test_wiener_is_the_linear_estimate_of_least_error(rng):
    for taps in (PULSE, np.roll(PULSE, 1)):
        waveform = np.zeros(160)
        waveform[60:100] = rng.uniform(0, 30, 40)
        expected = naive_signal.wiener(waveform, taps, 0.05)
        found = deconvolve_wiener(waveform[:, None], taps, 0.05)[:, 0]
        assert found == pytest.approx(expected, abs=0.02 * np.abs(expected).max())
        assert len(wiener_taps(taps, 0.05, 9)) == 19
        matrix = naive.pulse_matrix(160, taps)
        assert correlate_pulse(waveform[:, None], taps)[:, 0] == pytest.approx(matrix.T @ waveform)


def test_heights_of_profiles_have_the_energy_of_their_waveform(rng):
    profile, signal = rng.uniform(-1, 4, (6, 50)), rng.uniform(-2, 30, (50, 6)).astype(np.float32)
    support = rng.random((6, 50)) < 0.5
    profile[4], signal[:, 5] = -1.0, -1.0  # a sum of pulses, and a signal, that are not positive
    found = fit_height(profile, signal, PULSE, support)
    for w in range(4):
        made = (naive.pulse_matrix(50, PULSE) @ found[w])[support[w]].sum()
        assert made == pytest.approx(signal[support[w], w].sum(), rel=1e-4)
        assert found[w] / profile[w] == pytest.approx(found[w, 0] / profile[w, 0])
    assert not found[4:].any() and found[:4].any()
