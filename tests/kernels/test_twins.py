"""Kernels give what their slow twins give: signals, fits, geometry, lines, physics and rays."""

import math

import naive
import naive_fit
import naive_geometry
import naive_physics
import naive_signal
import numpy as np
import pytest
from scipy.linalg import toeplitz

from wavebatch.kernels.elementary import exp, log, log1p, solve
from wavebatch.kernels.fit import pulse_shape
from wavebatch.kernels.fit.learn_pulse import Stack, _as_fit, _refine, _sum
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.geometry import normals
from wavebatch.kernels.geometry.group_returns import LONGEST_PULSE, find_rays, fit_rays, group_times, number_returns
from wavebatch.kernels.geometry.normals import thin_out
from wavebatch.kernels.geometry.ray_convergence import fit_best, fit_sensor, range_error, sensor_at
from wavebatch.kernels.physics import incidence
from wavebatch.kernels.physics.gap_probability import estimate_canopy_ratio
from wavebatch.kernels.physics.radiometry import judge_energies
from wavebatch.kernels.signal import noise as noise_kernels
from wavebatch.kernels.signal.deconvolve import correlate_pulse, deconvolve_wiener, fit_height, wiener_taps
from wavebatch.kernels.signal.defects import fill_spikes, find_pattern, find_spikes, find_transient, fit_slopes
from wavebatch.kernels.signal.outgoing import find_reference, measure_outgoing
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


def test_light_in_all_later_samples_makes_no_transient_of_the_first(rng):
    """A canopy whose echoes never begin in the first five samples: 3 % of the clear ones were lost with these."""
    above = rng.normal(0, 1, (40, 400)).astype(np.float32)
    above[5:] += 0.9
    assert find_transient(above, 1.0) == 0
    above[:5] -= 0.9  # no light goes below the baseline
    assert find_transient(above, 1.0) == 5


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
    counted = rng.integers(0, len(signal) + 9, signal.shape[1])
    levels, quiet, number, lowest = noise_kernels.find_levels(signal, 1.25, 3, recovery=recovery, counted=counted)
    for w in range(signal.shape[1]):
        level, used = naive_signal.find_level(signal[:, w].astype(float), 1.25, 3, recovery=recovery)
        assert levels[w] == pytest.approx(level, abs=1e-4)
        np.testing.assert_array_equal(quiet[:, w], used)
        assert number[w] == used[: counted[w]].sum()
        assert lowest[w] == sorted(signal[:, w])[len(signal) // 10]


def test_levels_without_noise_give_no_warning():
    """NumPy printed that it divides by zero; the covariance was the same."""
    signal, quiet = np.zeros((40, 5000), np.float32), np.ones((40, 5000), bool)
    signal[22:], quiet[20:22] = 3, False
    found = noise_kernels.measure_covariance(signal, quiet, lags=8)
    assert np.isfinite(found).all() and found[1] == found[0] > 0


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


@pytest.mark.parametrize("taps", [None, [1.3, -0.6, 0.2]])
def test_factors_of_errors_are_those_of_matrices(taps):
    x = np.arange(-12, 13) / 2.0
    pulse = np.exp(-0.5 * x * x) + 0.1 * np.exp(-0.5 * (x - 3) ** 2)
    given = np.stack([pulse, x * pulse, x * x * pulse]), 0.3, -0.2, taps and np.array(taps), (0.5, 0.2, -0.05)
    assert noise_kernels.fit_factors(*given) == pytest.approx(naive_signal.fit_factors(*given))


def test_sums_of_coloured_samples_vary_as_their_matrix_says(rng):
    for correlation, size in (((0.5, 0.2), 7), ((0.6, 0.3, 0.1, -0.1), 3), ((), 4), ((0.9,), 1)):
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


def test_functions_are_those_of_the_math_module(rng):
    x = np.r_[rng.uniform(-700, 700, 300), 0.0, -0.0, 1e-300, -1e-300, 1.0, -1.0]
    assert exp(x) == pytest.approx([math.exp(value) for value in x], rel=1e-15)
    positive = np.exp(x)
    assert log(positive) == pytest.approx([math.log(value) for value in positive], rel=1e-14, abs=1e-15)
    small = rng.uniform(-0.99, 3, 300) * 10.0 ** rng.integers(-17, 1, 300)
    assert log1p(small) == pytest.approx([math.log1p(value) for value in small], rel=1e-14)
    assert log(np.array([0.0]))[0] == -math.inf and math.isnan(log(np.array([-1.0]))[0])


@pytest.mark.parametrize("size", [1, 2, 3, 9, 20])
def test_equations_are_solved_as_by_numpy(rng, size):
    half = rng.normal(size=(size + 3, size)) * 10.0 ** rng.uniform(-3, 3, size)
    matrix, right = half.T @ half, rng.normal(size=(size, 4))
    for wanted in (right, right[:, 0]):
        np.testing.assert_allclose(matrix @ solve(matrix, wanted), wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())
        np.testing.assert_allclose(solve(matrix, wanted), np.linalg.solve(matrix, wanted), rtol=1e-5)


def test_moments_of_residuals_are_those_of_the_twin(rng):
    """Also of echoes at the ends of the waveform, and narrower or wider than it."""
    s = 60
    residual = rng.normal(0, 2, (30, s)).astype(np.float32)
    time, width = rng.uniform(-2, s + 2, 30), rng.uniform(0.6, 5, 30)
    width[:2] = 40.0

    def read(rows, at):
        return np.take_along_axis(residual[rows], at, axis=1)

    h3, h4 = pulse_shape.residual_moments(read, s, time, width, np.full(30, 2.0))
    x = np.arange(float(s))
    for row in range(30):
        expected = naive_fit.moments(np.array([[1.0], [time[row]], [width[row]]]), x, residual[row].astype(float), 2.0)
        assert (h3[row], h4[row]) == pytest.approx((expected[0][0], expected[1][0]), abs=0.02)


@pytest.mark.parametrize("s", [40, 1300])
@pytest.mark.parametrize(
    "shape", [{}, {"kappa": 0.2}, {"components": ((0.3, 4.0, 2.0), (-0.1, 9.0, 0.5))}], ids=["gauss", "skewed", "sum"]
)
def test_rendered_waveforms_are_sums_of_pulses(rng, shape, s):
    """Long waveforms are made in parts, with the echoes that reach each part."""
    m = 60
    waveform = np.sort(rng.integers(0, 7, m))
    time, amplitude, width = rng.uniform(-3, s + 3, m), rng.uniform(-5, 200, m), rng.uniform(0.8, 6, m)
    found = render_echoes(pulse_shape.PulseShape(**shape), 8, s, waveform, time, amplitude, width)
    x = np.arange(float(s))
    for row in range(8):
        own = waveform == row
        expected = naive.model(np.stack([amplitude, time, width])[:, own], x, **shape) if own.any() else np.zeros(s)
        np.testing.assert_allclose(found[row], expected, atol=0.02)


@pytest.mark.parametrize("components", [1, 2, 3, 4])
@pytest.mark.parametrize("hard", [False, True])
def test_sums_of_gaussians_are_fitted_as_by_the_twin(rng, components, hard):
    """Hard: an undershoot deeper than allowed, and a tail that two sigmas keep from beginning before the pulse."""
    lag = np.sort(rng.uniform(-12, 60, 300))
    true = np.array([[1.0, 0.3, 2.0], [0.3, 5.0, 2.5], [-0.5 if hard else -0.1, 11.0, 3.0], [0.2, 4.0, 11.0]])
    value = sum(w * np.exp(-0.5 * ((lag - d) / s) ** 2) for w, d, s in true[:components])
    value = value + 1e-3 * rng.standard_normal(len(lag))
    stack = Stack(lag, value, np.full(len(lag), 1e-3))
    start = true[:components] * [1.0, 1.0, 1.1] + [0.0, 0.1, 0.0]
    start[:, 0] = np.maximum(start[:, 0], -0.2)
    found = _as_fit(_refine(stack, np.ones(len(lag)), start.ravel()), 0.0)
    expected = naive_fit.fit_stack(stack, start, np.ones(len(lag)))
    weight, delay, _ = expected[0]
    assert found.datum == pytest.approx(delay, abs=1e-4)
    assert found.components == pytest.approx(expected / [weight, 1, 1] - [0, delay, 0], abs=3e-4)
    if hard and components > 2:
        assert (found.components[:, 0] * weight).min() == pytest.approx(-0.3, abs=1e-6), "it is held at its bound"


def test_of_several_starts_the_sum_that_misses_least_is_taken(rng):
    """As the fit of this start alone."""
    lag = np.sort(rng.uniform(-12, 60, 301))
    value = sum(w * np.exp(-0.5 * ((lag - d) / s) ** 2) for w, d, s in ((1.0, 0.3, 2.0), (0.3, 6.0, 2.5)))
    stack = Stack(lag, value + 1e-3 * rng.standard_normal(301), np.full(301, 1e-3))
    weight = 1 / (1 + np.arange(301.0) / 30)
    starts = np.array([[1.0, 0.3, 2.0, 0.1, at, 2.0] for at in (-3.0, 6.0, 30.0, 50.0)])
    each = [_refine(stack, weight, start, 12) for start in starts]
    missed = [np.sum((_sum(one, lag) - stack.value) ** 2) for one in each]
    found = _refine(stack, weight, starts, 12)
    assert np.argmin(missed) == 1 and missed[1] < 0.1 * np.delete(missed, 1).min()
    np.testing.assert_allclose(found, each[1], atol=1e-6)


@pytest.mark.parametrize("shape", [{}, {"components": ((0.2, 2.5, 1.0),)}])
def test_measures_of_pulses_are_those_of_roots(shape):
    found = pulse_shape.measure_pulse(pulse_shape.PulseShape(**shape), 1.2, 4.0)
    for row in (0, 90, 199):
        expected = naive_fit.measure(shape, found.width[row])
        assert (found.peak[row], found.half_width[row]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_outgoing_pulses_are_measured_within_their_errors(rng, spread):
    """Levels that differ, coloured noise, clipped and empty recordings, peaks near both ends."""
    x, centre = np.arange(40), rng.uniform(2, 38, 2500)
    noise, level_of = rng.normal(0, 1, (2500, 41)), rng.normal(20, spread, 2500)
    level = level_of[:, None] + 1.2 * noise[:, 1:] + 0.8 * noise[:, :-1]
    height = np.where(np.arange(2500) % 30 == 0, 0.0, rng.uniform(60, 220, 2500))[:, None]
    z = (x - centre[:, None]) / 1.8
    samples = np.clip(np.rint(level + height * np.exp(-0.5 * z**2)), 0, 200).astype(np.uint8)
    reference = find_reference(samples)
    # Of noise 1.2 a + 0.8 b neighbours share one; against the level of all, quiet samples share that of their shot.
    gain = 1 + 2 * (0.96 + 4 * spread**2) / (2.08 + spread**2)
    assert reference[:2] == pytest.approx((4 / 2.3548, 2.08**0.5), rel=0.012), "four samples are above half"
    assert reference[2:5] == pytest.approx((gain, 20.0, spread), rel=0.12, abs=0.3)
    found = measure_outgoing(samples, reference)
    sent = height[:, 0] > 0
    assert np.isnan(np.stack(found)[:, ~sent]).all() and np.isfinite(np.stack(found)[:, sent]).all()
    inner = sent & (centre > 16) & (centre < 26) & (samples.max(axis=1) < 200)
    assert inner.sum() > 400 and np.std((found.time - centre)[inner]) < 0.05
    assert 0.6 < np.std(((found.time - centre) / found.time_error)[inner]) < 1.3
    clipped = measure_outgoing(samples, reference._replace(top=200))
    assert np.array_equal(np.isnan(clipped.energy), ~sent | (samples.max(axis=1) == 200))
    flat = sent & (centre > 16) & (centre < 26) & (samples.max(axis=1) == 200)
    assert flat.sum() > 50 and np.std((clipped.time - centre)[flat]) < 0.1
    for value, error, true in (
        (found.energy, found.energy_error, 1.8 * np.sqrt(2 * np.pi) * height[:, 0]),
        (found.amplitude, found.amplitude_error, height[:, 0]),
    ):
        off = ((value - true) / error)[inner]
        assert np.abs(off.mean()) < 0.3 and 0.4 < np.std(off) < 1.15 and (spread or np.std(off) > 0.75), spread
    assert np.std((found.level - level_of)[inner]) < 0.7
    assert (found.amplitude_error[inner] > (1.05 if spread else 0.99) * 1.1 * reference.noise).all()


def test_packets_of_equal_time_are_those_of_a_loop(rng):
    time = np.concatenate([rng.integers(0, 40, 120).astype(float), np.full(LONGEST_PULSE, 77.0), [np.nan] * 3])
    rng.shuffle(time)
    assert group_times(time).tolist() == naive_geometry.group_times(time)
    assert group_times(time[:0]).tolist() == []


def test_packets_of_a_pulse_lie_on_one_line(rng):
    """In any order; other directions, rays beside it, other scanners and other times are other pulses."""
    ray = rng.integers(0, 12, 150)
    group, scanner, side = ray // 6, (ray // 3) % 2, ray % 3
    step = np.array([[0.01, 0.0, -0.15], [0.01, 0.0, -0.15], [0.01, 2e-4, -0.15]])[side]
    step = step * (1 + 1e-6 * rng.standard_normal((150, 3)))
    start = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0, 0]])[side] + step * rng.uniform(-900, 900, (150, 1))
    start += 0.01 * rng.standard_normal((150, 3))
    found = find_rays(group, scanner, start, step)
    assert found.tolist() == naive_geometry.find_rays(group, scanner, start, step)
    assert found.tolist() == [int(np.flatnonzero(ray == one)[0]) for one in ray]
    start[3], step[5] = np.nan, 0.0
    alone = find_rays(group, scanner, start, step)
    assert alone[3] == 3 and alone[5] == 5 and np.count_nonzero(alone == 3) == 1


def test_dense_points_are_thinned_as_by_a_loop(rng):
    xyz = rng.normal(0, 1.0, (3000, 3))
    row = rng.permutation(10**6)[:3000]
    kept = thin_out(xyz, row, 2.0)
    expected = naive_geometry.thin_out(xyz, row, 2.0, normals.FINENESS, normals.MOST_PER_CELL)
    np.testing.assert_array_equal(kept, expected)
    assert 0.1 < kept.mean() < 0.9


@pytest.mark.parametrize("threshold", [2.0, 4.0])
def test_angles_above_a_threshold_are_those_of_the_conditional_law(rng, threshold):
    over, error = np.r_[0.01, 0.05, rng.uniform(0.1, 7.9, 20), 9.0, 40.0, 1e4], rng.uniform(0.1, 1.0, 25)
    variance, distance = error * (threshold + over), rng.uniform(300, 900, 25)
    found = incidence.angles_above(variance, error, distance, 1.1e-3, threshold)
    for row in range(25):
        expected = naive_physics.angle_above(variance[row], error[row], distance[row], 1.1e-3, threshold)
        assert (found[0][row], found[1][row]) == pytest.approx(expected, nan_ok=True, rel=2e-3), row


def shared_light(rng, n, ratio, scatter):
    gap = rng.beta(0.7, 1.0, n)
    energy = 500 * np.exp(scatter * rng.standard_normal(n))
    canopy, ground = energy * (1 - gap), energy / ratio * gap
    canopy[::40], ground[7::40] = 30 * canopy[::40], 0.0
    canopy[3::90], ground[5::70] = np.nan, -1.0
    return canopy, ground


@pytest.mark.quick_cases("80-*", "130-*")
@pytest.mark.parametrize(("n", "ratio", "scatter"), [(160, 0.4, 0.1), (160, 2.5, 0.3), (80, 1.0, 0.1), (130, 1.0, 2.5)])
def test_the_ratio_of_canopy_and_ground_is_that_of_a_loop(rng, n, ratio, scatter):
    """Outliers, pulses that know nothing, too few of them, and light that is all chance."""
    canopy, ground = shared_light(rng, n, ratio, scatter)
    found, expected = estimate_canopy_ratio(canopy, ground), naive_physics.estimate_canopy_ratio(canopy, ground)
    assert (found is None) == (expected is None) == (n == 80 or scatter > 1)
    if found is not None:
        assert found.ratio == pytest.approx(expected[0], rel=2e-3)
        assert found.error == pytest.approx(expected[1], rel=0.015)


def test_energies_are_judged_as_by_a_loop(rng):
    """True ones, logs that are a pulse early or late, shuffled ones, constant ones; some pulses are not known."""
    seen = set()
    for turn in range(30):
        energy = np.exp(rng.choice([0.002, 0.05, 0.3]) * rng.standard_normal(200))
        light = energy * np.repeat(rng.uniform(1, 5, 20), 10) * np.exp(0.03 * rng.standard_normal(200))
        light[rng.permutation(200)[:6]] = 0.0, math.nan, math.inf, -3.0, 1e-9, 1e9
        given = [energy, np.roll(energy, 1), np.roll(energy, -1), rng.permutation(energy), np.ones(200)][turn % 5]
        given = np.where(rng.random(200) < 0.05, np.nan, given)
        with np.errstate(invalid="ignore"):
            found, lacks = judge_energies(light, given)
        expected, less = naive_physics.judge_energies(light.tolist(), given.tolist())
        assert lacks == pytest.approx(less, abs=1e-9)
        assert {"": "", "early": "too early", "late": "too late", "others": "other pulses"}[expected] in found
        assert bool(found) == bool(expected)
        seen.add(expected)
    assert seen == {"", "early", "late", "others"}


def fly(rng, pulses, noise=3e-4, view=50.0, height=700.0):
    """Times, points, directions and weights of pulses in a quarter of a second; every tenth direction is noisier."""
    time = np.sort(rng.uniform(3.0, 3.25, pulses))
    sensor = np.array([4e5, 5.2e6, height + 100]) + np.outer(time - 3.1, [55.0, 20.0, 0.5])
    side, ahead = np.radians(view / 2) * rng.uniform(-1, 1, pulses), np.radians(view / 16) * rng.uniform(-1, 1, pulses)
    direction = np.stack([np.tan(ahead), np.tan(side), -np.ones(pulses)], axis=1)
    point = sensor + direction * rng.uniform(0.9, 1.0, pulses)[:, None] * height
    spread = np.where(np.arange(pulses) % 10 == 0, 4.0, 1.0) * noise
    return time, point, direction + spread[:, None] * rng.standard_normal((pulses, 3)), (noise / spread) ** 2


def assert_same_fit(found, expected):
    for name in ("centre", "half", "distance", "residual", "condition", "spread"):
        assert getattr(found, name) == pytest.approx(expected[name], rel=2e-3), name
    error = np.sqrt(np.diag(found.covariance)).reshape(found.coefficients.shape)
    assert (np.abs(found.coefficients - expected["coefficients"]) < 0.02 * error).all()
    np.testing.assert_allclose(found.covariance, expected["covariance"], rtol=0.01, atol=1e-3 * error.max() ** 2)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_a_path_is_that_of_scipy(rng, order):
    """With outliers, opposite signs, pulses that know nothing, and lengths of directions as in a file."""
    time, point, direction, weight = fly(rng, 150)
    point[::25] += 30 * rng.standard_normal((6, 3))
    direction *= rng.choice([-1.5e-4, 1.5e-4], 150)[:, None]
    direction[7], point[8, 1], direction[9, 2], time[10] = 0.0, np.nan, np.inf, np.nan
    found = fit_sensor(time, point, direction, weight, order)
    expected = naive_geometry.fit_sensor(time, point, direction, weight, order)
    assert found.pulses == 146 and found.is_sound
    assert_same_fit(found, expected)
    unit = direction[:5] / np.linalg.norm(direction[:5], axis=1)[:, None]
    position, velocity = sensor_at(found, time[:5])
    errors = range_error(found, time[:5], unit)
    for row in range(5):
        place, speed = naive_geometry.sensor_at(expected, time[row])
        assert position[row] == pytest.approx(place, abs=0.02 * errors[row])
        assert velocity[row] == pytest.approx(speed, abs=0.1 * errors[row] / found.half)
        assert errors[row] == pytest.approx(naive_geometry.range_error(expected, time[row], unit[row]), rel=0.01)


@pytest.mark.parametrize(
    ("noise", "view", "order"),
    [(1e-5, 50.0, 2), (3e-4, 50.0, 1), (8e-3, 50.0, 1), (0.02, 20.0, None), (1e-5, 1.0, None)],
)
def test_the_order_is_that_of_the_least_error(rng, noise, view, order):
    """Exact directions show an acceleration, noisy ones a speed at most, and noise or parallel ones nothing."""
    time, point, direction, weight = fly(rng, 120, noise, view)
    found = fit_best(time, point, direction, weight)
    expected = naive_geometry.fit_best(time, point, direction, weight)
    assert (None if found is None else len(found.coefficients) - 1) == expected
    assert expected == order


def test_numbers_along_rays_are_those_of_a_loop(rng):
    """Two rays of a pulse that differ (the first one counts), equal places, and pulses without any ray."""
    for _ in range(20):
        m = int(rng.integers(1, 25))
        pulse = rng.integers(0, 7, m)
        direction = rng.normal(size=(m, 3)) * (rng.random(m) < 0.6)[:, None]
        xyz = np.array([4e5, 5e6, 300.0]) + rng.integers(0, 3, (m, 3))
        found = list(zip(*(values.tolist() for values in number_returns(pulse, xyz, direction)), strict=True))
        assert found == naive_geometry.number_returns(pulse, xyz, direction)


@pytest.mark.parametrize("pulses", [10, 120])
def test_rays_follow_their_pulse_or_the_scan_angles_of_their_line(rng, pulses):
    """Two flight lines with pitches of their own; one pulse goes sideways, one upwards, and two are far off."""
    count = np.tile([1, 2, 3, 2], pulses // 2)
    starts, line = np.cumsum(count) - count, np.arange(len(count)) // pulses
    angle, ahead = rng.uniform(-30, 30, len(count)), np.array([0.1, -0.2])[line]
    angle[4] = 89.0  # counts as 80
    way = np.stack([0.9 * np.tan(np.radians(angle.clip(-80, 80))), ahead, -np.ones(len(count))], axis=1)
    unit = way / np.linalg.norm(way, axis=1)[:, None]
    apart = np.where(np.arange(len(count)) % 3, 3.0, 0.2)  # between returns [m]; rays of their own from .5 m on
    unit[1], unit[5] = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    unit[7], unit[9] = [0.8, 0.0, -0.6], [0.0, 0.8, -0.6]
    pulse = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(pulse)) - starts[pulse]
    xyz = np.array([4e5, 5e6, 300.0]) + unit[pulse] * (apart[pulse] * number)[:, None]
    found = fit_rays(xyz, starts, angle[pulse], line[pulse])
    own = (count - 1) * apart >= 0.5
    np.testing.assert_allclose(found[own], unit[own], atol=1e-6)
    fitted = way / np.linalg.norm(way, axis=1)[:, None] if pulses > 20 else [[0.0, 0.0, -1.0]] * len(count)
    np.testing.assert_allclose(found[~own], np.array(fitted)[~own], atol=1e-6)
    assert 0.3 < own.mean() < 0.7
