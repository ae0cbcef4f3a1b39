"""Fits of sums of pulses against SciPy; their errors against the bounds and the closed forms."""

import naive
import naive_fit
import numpy as np
import pytest
from fits import TIGHT, decompose, fit

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import crlb, fit_closed_form
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.stages.decompose.fit import closed_form
from wavebatch.tools.bench.accuracy import find_bounds
from wavebatch.tools.simulate import PulseModel, Recording

LENGTH = 32
SHAPES = {
    "gaussian": PulseShape(),
    "skewed": PulseShape(kappa=0.15),
    "learned": PulseShape(components=((0.15, 2.5, 0.8), (0.04, 9.0, 1.2), (-0.02, 6.0, 0.5))),
}


def draw(rng, m, k, apart=6.0):
    """True parameters (m, 3, k) of k echoes that overlap a little."""
    amplitude = rng.uniform(20, 150, (m, k))
    time = 8 + apart * np.arange(k) + rng.uniform(-0.5, 0.5, (m, k))
    return np.stack([amplitude, time, rng.uniform(1.6, 2.6, (m, k))], axis=1)


def record(rng, truth, shape=GAUSSIAN, noise=1.0, length=LENGTH):
    """Waveforms (m, length) that hold the echoes."""
    x = np.arange(float(length))
    y = np.stack([naive.model(p, x, kappa=shape.kappa, components=shape.components) for p in truth])
    return y + noise * rng.standard_normal(y.shape)


def near(rng, truth):
    """Starts as a detector would give them."""
    start = truth.copy()
    start[:, 0] *= rng.uniform(0.85, 1.15, start[:, 0].shape)
    start[:, 1] += rng.uniform(-0.4, 0.4, start[:, 1].shape)
    start[:, 2] = 2.0
    return start


def assert_reaches_scipy(y, found, start, shape=GAUSSIAN, std=1.0, widths=(1.4, 8.0), slack=(2e-3, 0.05), **optional):
    """Every problem ends in the minimum that scipy finds: chi2 equal, parameters within 5 % of their errors."""
    low, high = (np.array(edge)[:, None] for edge in ((0.0, -3.0, widths[0]), (1e9, y.shape[1] + 2.0, widths[1])))
    x = np.arange(float(y.shape[1]))
    for i, one in enumerate(start):
        rows = {name: field[i] for name, field in optional.items() if name != "prior"}
        used = ~rows.pop("missing", np.zeros(len(x), bool))
        rows = {name: field[used] for name, field in rows.items()}
        prior = optional.get("prior")
        components = {"kappa": shape.kappa, "components": shape.components}
        expected, chi2 = naive.fit(y[i][used], x[used], std, one, low, high, prior=prior, **rows, **components)
        assert found.cost[i] == pytest.approx(chi2, rel=2e-4, abs=slack[0])
        assert np.abs((found.parameters[i, :3] - expected) / found.errors[i, :3]).max() < slack[1]


@pytest.fixture
def rng():
    return np.random.default_rng(23)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_free_fits_equal_scipy(rng, shape, k):
    truth = draw(rng, 12, k)
    y, start = record(rng, truth, shape), near(rng, truth)
    found = fit(y, start, shape=shape, **TIGHT)
    assert found.converged.all()
    assert not found.at_bound.any()
    assert_reaches_scipy(y, found, start, shape)


def test_default_tolerance_ends_within_a_fraction_of_the_error(rng):
    truth = draw(rng, 200, 2, apart=4.5)
    y, start = record(rng, truth), near(rng, truth)
    loose, tight = fit(y, start, tolerance=0.05), fit(y, start, **TIGHT)
    assert np.abs((loose.parameters - tight.parameters)[:, :3] / tight.errors[:, :3]).max() < 0.1


def test_times_are_as_exact_at_the_end_of_a_long_window(rng):
    truth = draw(rng, 6, 1)
    truth[:, 1] += 60_000
    found = fit(record(rng, truth, noise=0.0, length=60_040), near(rng, truth), **TIGHT)
    np.testing.assert_allclose(found.parameters[:, 1], truth[:, 1], rtol=0, atol=2e-5)


def test_fits_at_the_bounds_equal_scipy(rng):
    truth = draw(rng, 16, 1)
    truth[:8, 2], truth[8:, 2] = 0.9, 5.0
    y, start = record(rng, truth), near(rng, truth)
    found = fit(y, start, width_high=4.0, **TIGHT)
    assert found.converged.all()
    assert found.at_bound.all()
    np.testing.assert_array_equal(found.parameters[:8, 2], 1.4)
    np.testing.assert_array_equal(found.parameters[8:, 2], 4.0)
    assert_reaches_scipy(y, found, start, widths=(1.4, 4.0))


def test_clipped_samples_only_bound_the_signal_from_below(rng):
    truth = draw(rng, 12, 1)
    truth[:, 0] = 400
    y, start = np.minimum(record(rng, truth), 250), near(rng, truth)
    found = fit(y, start, clip=250.0, **TIGHT)
    assert_reaches_scipy(y, found, start, clipped=y >= 250)
    assert np.abs((found.parameters[:, :3] - truth) / found.errors[:, :3]).max() < 4.5
    assert (fit(y, start, **TIGHT).parameters[:, 0] < 300).all()


@pytest.mark.parametrize("whitening", [None, np.diag([1.0, 1.0, 1.0])])
def test_samples_at_the_floor_only_bound_the_signal_from_above(rng, whitening):
    shape = PulseShape(components=((-0.15, 6.0, 2.0),))
    truth = draw(rng, 12, 1)
    truth[:, 0] = 150
    y, start = np.maximum(record(rng, truth, shape), -5), near(rng, truth)
    found = fit(y, start, shape=shape, floor=-5.0, whitening=whitening, **TIGHT)
    assert np.abs((found.parameters[:, :3] - truth) / found.errors[:, :3]).max() < 4.5
    samples = LENGTH - np.count_nonzero(y <= -5, axis=1)
    assert found.cost.sum() == pytest.approx(samples.sum(), rel=0.2)
    assert (fit(y, start, shape=shape, **TIGHT).cost > 3 * LENGTH).all()


def test_samples_at_the_floor_count_where_the_model_is_above_them(rng):
    truth = draw(rng, 6, 1)
    y, start = record(rng, truth), near(rng, truth)
    y[:, 12] = -5.0  # on the flank of each echo
    found, plain = (fit(y, start, floor=floor, **TIGHT) for floor in (-5.0, None))
    np.testing.assert_allclose(found.cost, plain.cost, rtol=1e-4)
    assert (found.cost > 2 * LENGTH).all()


@pytest.mark.parametrize("level_err", [None, 0.7])
def test_noise_that_grows_with_the_signal_weighs_samples(rng, level_err):
    truth = draw(rng, 8, 1)
    y, start = record(rng, truth), near(rng, truth)
    smooth = np.pad(y, ((0, 0), (2, 2)), mode="edge") @ np.stack([np.roll([1, 4, 6, 4, 1] + [0] * (LENGTH - 1), i)
                                                                  for i in range(LENGTH)], axis=1) / 16  # fmt: skip
    weight = 1 / np.sqrt(1 + 0.2 * np.maximum(smooth, 0))
    found = fit(y, start, noise_gain=0.2, level_err=level_err, **TIGHT)
    white = np.array([naive_fit.free_level(np.diag(row), np.zeros(LENGTH, bool), level_err or 0.0) for row in weight])
    assert_reaches_scipy(y, found, start, white=white)


def test_missing_samples_take_no_part(rng):
    truth = draw(rng, 8, 1)
    y, start = record(rng, truth), near(rng, truth)
    missing = np.zeros(y.shape, bool)
    missing[:, 10], missing[:, 20:] = True, True
    spoilt = np.where(missing, 500.0, y)
    assert_reaches_scipy(spoilt, fit(spoilt, start, missing=missing, **TIGHT), start, missing=missing)


def test_the_width_prior_costs_narrow_echoes_only(rng):
    truth = draw(rng, 12, 2, apart=3.5)
    truth[:, 2] = [1.7, 2.6]
    y, start = record(rng, truth), near(rng, truth)
    held, free = fit(y, start, width_ref=2.2, prior_spread=0.15, **TIGHT), fit(y, start, **TIGHT)
    # The prior sets in with a kink of the slope, around which steps alternate.
    assert_reaches_scipy(y, held, start, prior=(2.2, 0.15, False), slack=(0.1, 0.3))
    assert (held.cost > free.cost).all()
    wide = fit(y, start, width_ref=0.5, prior_spread=0.15, **TIGHT)
    np.testing.assert_array_equal(wide.parameters, free.parameters)


def test_errors_count_what_the_prior_knows_of_widths(rng):
    truth = draw(rng, 12, 2, apart=3.5)
    truth[:, 2] = [1.7, 2.6]
    y, prior = record(rng, truth), (2.2, 0.15, False)
    held = fit(y, near(rng, truth), width_ref=prior[0], prior_spread=prior[1], **TIGHT)
    for p, errors in zip(held.parameters[:, :3], held.errors[:, :3], strict=True):
        expected = naive_fit.errors_of(p, np.arange(float(LENGTH)), 1.0, prior, np.ones(LENGTH), {})
        np.testing.assert_allclose(errors, expected, rtol=5e-3)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_counts_of_any_size_are_read_as_they_are(rng, kind):
    truth = draw(rng, 20, 2)
    truth[:, 0] *= 1.2 if kind is np.uint8 else 200.0
    top = np.iinfo(kind).max
    counts = np.clip(np.rint(record(rng, truth)), 0, top).astype(kind)
    start = near(rng, truth)
    whole, plain = fit(counts, start, **TIGHT), fit(counts.astype(np.float32), start, **TIGHT)
    np.testing.assert_array_equal(whole.parameters, plain.parameters)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize(("k", "apart"), [(1, 6.0), (2, 6.0), (2, 3.0), (3, 4.0)])
def test_errors_are_those_of_the_inverse_fisher_matrix(rng, shape, k, apart):
    truth = draw(rng, 10, k, apart)
    found = fit(record(rng, truth, shape, noise=0.7), truth, shape=shape, std=0.7, **TIGHT)
    x = np.arange(float(LENGTH))
    for i in np.flatnonzero(~found.at_bound.any(axis=1)):
        p = found.parameters[i, :3]
        plain, _ = naive.fisher_errors(p, x, 0.7, kappa=shape.kappa, components=shape.components)
        # Errors are those of the last step but one: where echoes overlap, they change with every step.
        np.testing.assert_allclose(found.errors[i, :3], plain, rtol=2e-3 if apart > 5 else 0.15)


def test_two_echoes_in_one_place_do_not_break_the_fit(rng):
    truth = draw(rng, 10, 1)
    start = np.repeat(truth, 2, axis=2)
    start[:, 0] /= 2
    found = fit(record(rng, truth), start)
    assert np.isfinite(found.parameters).all()
    assert np.isfinite(found.errors).all()
    assert (found.errors[:, 0].max(axis=1) > 100).all(), "amplitudes that cannot be told apart must have large errors"
    np.testing.assert_allclose(found.parameters[:, 0].sum(axis=1), truth[:, 0, 0], rtol=0.2)


def test_a_lone_echo_of_which_two_samples_are_seen_has_errors(rng):
    """Rounding of float32 products made the variance of its time less than nothing, and the error 0."""
    truth = np.stack([np.full(500, 30.0), rng.uniform(0.0, 4.0, 500), rng.uniform(1.4, 3.0, 500)], axis=1)[:, :, None]
    found = fit(record(rng, truth, length=2), truth, max_iterations=1)
    assert np.isfinite(found.errors[:, :3]).all() and (found.errors[:, :3] > 0).all()
    rows = (field[:, :size, 0] for field, size in ((found.parameters, 3), (found.errors, 3), (found.shared, 2)))
    assert (naive_fit.relative_energy_errors(*rows)[found.parameters[:, 0, 0] > 0] > 0).all()


@pytest.mark.parametrize("level", [0.0, 200.0])
def test_windows_without_information_stay_finite(level):
    missing = np.ones((3, 8), bool)
    missing[0] = False
    start = np.tile([[[10.0], [3.0], [2.0]]], (3, 1, 1))
    found = fit(np.full((3, 8), level), start, missing=missing)
    assert np.isfinite(found.parameters).all()
    assert np.isfinite(found.errors).all()


def test_too_few_iterations_are_reported(rng):
    truth = draw(rng, 10, 2, apart=3.0)
    start = truth.copy()
    start[:, 1] += 1.5
    found = fit(record(rng, truth), start, tolerance=1e-8, max_iterations=2)
    assert not found.converged.any()
    assert np.isfinite(found.cost).all()


def test_no_fit_ends_worse_than_it_says(rng):
    """Close echoes lie in a curved valley: a last step along it may climb its side, however little it promises."""
    m = 4000
    truth = draw(rng, m, 2, apart=2.5)
    start = truth.copy()
    start[:, 0] *= rng.uniform(0.4, 1.6, start[:, 0].shape)
    start[:, 1] += rng.uniform(-1.5, 1.5, start[:, 1].shape)
    y = record(rng, truth)
    found = decompose(y, start, tolerance=0.5)
    ends = np.cumsum(found.number)
    x = np.arange(float(LENGTH))
    for i in range(0, m, 4):
        p = found.parameters[ends[i] - found.number[i] : ends[i], :3].T
        assert np.sum((y[i].astype(np.float32) - naive.model(p, x)) ** 2) - found.cost[i] < 10


@pytest.mark.parametrize("apart", [1.8, 2.2, 2.7, 6.0])
def test_the_error_of_an_energy_is_its_scatter_also_where_echoes_overlap(rng, apart):
    """With the correlation of lone echoes, -1/sqrt(3), errors were 1.4 to 1.9 times too small."""
    truth = np.empty((800, 3, 2))
    truth[:, 0], truth[:, 2] = (60.0, 45.0), 2.0
    truth[:, 1, 0] = rng.uniform(10.0, 11.0, 800)
    truth[:, 1, 1] = truth[:, 1, 0] + 2.0 * apart
    found = fit(record(rng, truth), truth.copy(), **TIGHT)
    rows = [field.transpose(0, 2, 1).reshape(1600, -1) for field in found[:3]]
    energy = naive_fit.relative_energy_errors(rows[0][:, :3], rows[1][:, :3], rows[2])
    area = found.parameters[:, 0] * found.parameters[:, 2]
    off = area / (truth[:, 0] * truth[:, 2]) - 1.0
    inside = np.mean(np.abs(off) < energy.reshape(800, 2), axis=0)
    assert inside == pytest.approx(0.683, abs=0.075)


@pytest.mark.parametrize("power", [1.4, 2.4, 4.0])
def test_generalized_gaussians_are_fitted_exactly(rng, power):
    truth = draw(rng, 20, 1)
    x = np.arange(float(LENGTH))
    y = np.stack([a * naive.power_pulse(x, t, s, power) for a, t, s in truth[:, :, 0]])
    found = fit(y, near(rng, truth), shape=PulseShape(power=power), **TIGHT)
    np.testing.assert_allclose(found.parameters[:, :3], truth, rtol=2e-4)


def test_undamped_steps_lead_to_the_least_squares(rng):
    truth = np.stack([[60, 50], [15, 21.5], [2.0, 2.5]]) * np.ones((6, 1, 1))
    y = record(rng, truth, length=40)
    start = truth * rng.uniform(0.97, 1.03, truth.shape)
    found = fit(y, start, undamped=True, tolerance=1e-8, max_iterations=12)
    assert found.converged.all()
    box = np.array([[0.0], [0.0], [0.5]]), np.array([[1e3], [40.0], [9.0]])
    plain = np.stack([naive.fit(y[i], np.arange(40.0), 1.0, start[i], *box)[0] for i in range(6)])
    np.testing.assert_allclose(found.parameters[:, :3], plain, atol=2e-3)


@pytest.mark.parametrize(
    ("sigma", "spacing", "tolerance"),
    [(1.5, 1.0, 1e-3), (2.0, 1.0, 1e-3), (4.0, 2.0, 1e-3), (1.0, 1.0, 1e-2), (0.5, 0.25, 1e-3)],
)
@pytest.mark.parametrize("phase", [0.0, 0.21, 0.5])
def test_closed_forms_equal_the_fisher_matrix(sigma, spacing, tolerance, phase):
    truth = np.array([[50.0], [(30 + phase) * spacing], [sigma]])
    (amplitude, time, width), covariance = naive.fisher_errors(truth, spacing * np.arange(64), 1.3)
    found = np.array(crlb(np.full(2, 50.0), np.full(2, sigma), np.array([1.3, 2.6]), spacing))
    assert np.allclose(found, np.array([time, amplitude, width]) * [1.0, 2.0], rtol=tolerance)
    if tolerance < 1e-2:
        correlation = covariance[0, 2] / np.sqrt(covariance[0, 0] * covariance[2, 2])
        assert correlation == pytest.approx(-1 / np.sqrt(3), abs=2e-3)


def inflate(time, amplitude):
    """Bounds of echoes of width 2 in one waveform over those of each alone in the middle of one, (k, 3)."""
    k = len(time)
    waveform, place = np.r_[np.zeros(k), 1 + np.arange(k)], np.r_[time, np.full(k, 40.3)]
    truth = EchoTable.build(waveform, place, np.tile(amplitude, 2), np.full(2 * k, 2.0))
    found = find_bounds(Recording(n_samples=80, pulse=PulseModel(2.0)), truth, k + 1)
    return found[:k] / found[k:]


@pytest.mark.parametrize(
    ("gap", "expected"),
    [
        (1.0, (129, 272, 23.6)),
        (1.5, (24.8, 30.5, 7.7)),
        (2.0, (7.6, 5.6, 3.7)),
        (3.0, (1.63, 1.02, 1.57)),
        (4.0, (1.04, 1.01, 1.10)),
    ],
)
def test_two_echoes_inflate_as_the_specification_says(gap, expected):
    for factors in inflate([30.0, 30.0 + 2.0 * gap], [80.0, 40.0]):
        assert factors == pytest.approx(expected, rel=0.04)


def test_truncated_echoes_follow_the_edge_table():
    for inside, expected in ((2, (1.00, 1.01, 1.02)), (1, (1.19, 1.04, 1.34)), (0, (4.6, 1.5, 3.3))):
        # The table counts the edge half a sample outside the first one or at it: allow for that at the very edge.
        assert inflate([inside * 2.0], [50.0])[0] == pytest.approx(expected, rel=0.35 if inside == 0 else 0.08)


VECTOR = 37.5 * np.exp(-0.5 * ((np.arange(31) - 14.3) / 1.8) ** 2)
PEAK = 14


def windows(y, reach=12):
    return y[None, PEAK - reach : PEAK + reach + 1]


def test_a_gaussian_is_found_exactly():
    amplitude, time, width, holds = fit_closed_form(windows(VECTOR), 0.2)
    assert holds.all()
    assert amplitude[0] == pytest.approx(37.5, rel=1e-12)
    assert time[0] + PEAK == pytest.approx(14.3, rel=1e-12)
    assert width[0] == pytest.approx(1.8, rel=1e-12)


def test_rounded_gaussian_gives_the_published_numbers():
    amplitude, time, width, _ = fit_closed_form(windows(np.rint(VECTOR)), 0.2)
    assert amplitude[0] == pytest.approx(37.6073, abs=5e-5)
    assert time[0] + PEAK == pytest.approx(14.28882, abs=5e-6)
    assert width[0] == pytest.approx(1.80415, abs=5e-6)


@pytest.mark.parametrize(("steps", "tolerance"), [(2, 2e-5), (30, 1e-5)])
def test_steps_lead_to_the_published_least_squares(steps, tolerance):
    """Two Gauss-Newton steps after the closed form, and the minimum itself."""
    block = WaveformBlock.from_samples(np.rint(VECTOR)[None].astype(np.uint8))
    noise = Noise(np.zeros(1, np.float32), np.full(1, 0.3, np.float32))
    start = EchoTable.build([0], [14.0], [37.0], [2.0])
    # A wide system pulse makes the window cover all samples.
    echoes = closed_form(block, noise, SystemPulse(2.4, noise=ReceiverNoise(std=0.3)), start, steps=steps)
    assert echoes.amplitude[0] == pytest.approx(37.62496, abs=5 * tolerance)
    assert echoes.time[0] == pytest.approx(14.294543, abs=tolerance)
    assert echoes.sigma[0] == pytest.approx(1.802284, abs=tolerance)


@pytest.mark.parametrize(
    ("fraction", "third", "low", "high"), [(0.1, 20, 2, 7), (0.2, 20, 2, 6), (0.5, 20, 3, 6), (0.5, 30, 2, 6)]
)
def test_only_samples_around_the_peak_that_are_high_enough_count(fraction, third, low, high):
    """Not those behind a lower one, however high: a plain weighted parabola through the logarithms of the others."""
    y = np.array([50.0, 3, third, 45, 60, 40, 10, 2, 55])
    c2, c1, c0 = np.polyfit(np.arange(low - 4, high - 4), np.log(y[low:high]), 2, w=y[low:high])
    expected = np.exp(c0 - c1 * c1 / (4 * c2)), -c1 / (2 * c2), np.sqrt(-1 / (2 * c2))
    *found, holds = fit_closed_form(y[None], fraction)
    assert holds.all() and np.concatenate(found) == pytest.approx(np.array(expected), rel=1e-7)
