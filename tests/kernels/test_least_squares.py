"""The batched fit against scipy on the same windows: free, at bounds, clipped, weighted, with a prior; and alone."""

import naive
import numpy as np
import pytest

from wavebatch.kernels.fit.least_squares import (
    OUTSIDE,
    Limits,
    WidthPrior,
    Windows,
    evaluate_model,
    fit_windows,
)
from wavebatch.kernels.fit.normal_equations import fit_errors, gram_matrix, parameter_errors
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.stages.decompose.solve import relative_energy_errors

NOISE = 1.0
LENGTH = 32
SHAPES = {
    "gaussian": PulseShape(),
    "skewed": PulseShape(kappa=0.15),
    "learned": PulseShape(components=((0.15, 2.5, 0.8), (0.04, 9.0, 1.2), (-0.02, 6.0, 0.5))),
}
TIGHT = {"tolerance": 1e-8, "max_iterations": 60}


def draw(rng, m, k, apart=6.0):
    """True parameters (m, 3, k) of k echoes that overlap a little."""
    amplitude = rng.uniform(20, 150, (m, k))
    time = 8 + apart * np.arange(k) + rng.uniform(-0.5, 0.5, (m, k))
    return np.stack([amplitude, time, rng.uniform(1.6, 2.6, (m, k))], axis=1)


def record(rng, truth, shape=GAUSSIAN, noise=NOISE):
    """Windows that hold the echoes; x as the fit sees it, (m, L) both."""
    m = len(truth)
    x = np.arange(float(LENGTH))
    y = np.stack([naive.model(p, x, kappa=shape.kappa, components=shape.components) for p in truth])
    y += noise * rng.standard_normal(y.shape)
    return Windows(y.astype(np.float32), np.tile(x, (m, 1)).astype(np.float32), np.full(m, NOISE))


def box(m, low=(0.0, -3.0, 1.4), high=(1e9, LENGTH + 2.0, 8.0)):
    return Limits(*(np.tile(np.array(edge)[None, :, None], (m, 1, 1)) for edge in (low, high)))


def near(rng, truth):
    """Starts as a detector would give them."""
    start = truth.copy()
    start[:, 0] *= rng.uniform(0.85, 1.15, start[:, 0].shape)
    start[:, 1] += rng.uniform(-0.4, 0.4, start[:, 1].shape)
    start[:, 2] = 2.0
    return start


def assert_reaches_scipy(windows, fit, start, limits, shape=GAUSSIAN, prior=None, slack=(2e-3, 0.05)):
    """Every problem ends in the minimum that scipy finds: chi2 equal, parameters within 5 % of their errors."""
    errors = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    for i in range(len(start)):
        inside = windows.x[i] > OUTSIDE
        optional = {
            name: None if field is None else field[i][inside]
            for name, field in (("clipped", windows.clipped), ("weight", getattr(windows, "weight", None)))
        }
        expected, chi2 = naive.fit(
            windows.y[i][inside].astype(float),
            windows.x[i][inside].astype(float),
            windows.std[i],
            start[i],
            limits.low[i],
            limits.high[i],
            prior=prior,
            kappa=shape.kappa,
            components=shape.components,
            **optional,
        )
        assert fit.cost[i] == pytest.approx(chi2, rel=2e-4, abs=slack[0])
        assert np.abs((fit.parameters[i] - expected) / errors[i]).max() < slack[1]


@pytest.fixture
def rng():
    return np.random.default_rng(23)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_free_fits_equal_scipy(rng, shape, k):
    truth = draw(rng, 12, k)
    windows = record(rng, truth, shape)
    start, limits = near(rng, truth), box(12)
    fit = fit_windows(windows, start, limits, shape, **TIGHT)
    assert fit.converged.all()
    assert not fit.at_bound.any()
    assert_reaches_scipy(windows, fit, start, limits, shape)


def test_default_tolerance_ends_within_a_fraction_of_the_error(rng):
    truth = draw(rng, 200, 2, apart=4.5)
    windows = record(rng, truth)
    start, limits = near(rng, truth), box(200)
    loose = fit_windows(windows, start, limits, GAUSSIAN, tolerance=0.05)
    tight = fit_windows(windows, start, limits, GAUSSIAN, **TIGHT)
    errors = parameter_errors(tight.parameters, windows.std, tight.rows, tight.gram)
    assert np.abs((loose.parameters - tight.parameters) / errors).max() < 0.1


def test_exact_waveforms_give_exact_parameters(rng):
    truth = draw(rng, 40, 2)
    fit = fit_windows(record(rng, truth, noise=0.0), near(rng, truth), box(40), GAUSSIAN, **TIGHT)
    np.testing.assert_allclose(fit.parameters, truth, rtol=1e-5)
    np.testing.assert_allclose(fit.cost, 0, atol=1e-4)


def test_fits_at_the_bounds_equal_scipy(rng):
    truth = draw(rng, 16, 1)
    truth[:8, 2], truth[8:, 2] = 0.9, 5.0
    windows = record(rng, truth)
    start = near(rng, truth)
    limits = box(16, low=(0.0, -3.0, 1.4), high=(1e9, 40.0, 4.0))
    fit = fit_windows(windows, start, limits, GAUSSIAN, **TIGHT)
    assert fit.converged.all()
    assert fit.at_bound.all()
    np.testing.assert_array_equal(fit.parameters[:8, 2], 1.4)
    np.testing.assert_array_equal(fit.parameters[8:, 2], 4.0)
    assert_reaches_scipy(windows, fit, start, limits)


def test_an_echo_that_is_not_there_ends_at_amplitude_zero(rng):
    truth = draw(rng, 20, 1)
    windows = record(rng, truth, noise=0.05)
    windows.y[:, 20:] -= 1.0
    start = np.concatenate([near(rng, truth), np.tile([[[8.0], [25.0], [2.0]]], (20, 1, 1))], axis=2)
    fit = fit_windows(windows, start, box(20), GAUSSIAN, **TIGHT)
    assert fit.at_bound[:, 1].all()
    np.testing.assert_array_equal(fit.parameters[:, 0, 1], 0)


def test_clipped_samples_only_bound_the_signal_from_below(rng):
    truth = draw(rng, 12, 1)
    truth[:, 0] = 400
    windows = record(rng, truth)
    windows = windows._replace(y=np.minimum(windows.y, 250), clipped=windows.y >= 250)
    start, limits = near(rng, truth), box(12)
    fit = fit_windows(windows, start, limits, GAUSSIAN, **TIGHT)
    assert_reaches_scipy(windows, fit, start, limits)
    errors = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    assert np.abs((fit.parameters - truth) / errors).max() < 4.5
    naive_fit = fit_windows(windows._replace(clipped=None), start, limits, GAUSSIAN, **TIGHT)
    assert (naive_fit.parameters[:, 0] < 300).all()


def test_weighted_samples_count_by_their_weight(rng):
    truth = draw(rng, 8, 1)
    windows = record(rng, truth)
    windows = windows._replace(weight=rng.uniform(0.2, 1.0, windows.y.shape).astype(np.float32))
    start, limits = near(rng, truth), box(8)
    assert_reaches_scipy(windows, fit_windows(windows, start, limits, GAUSSIAN, **TIGHT), start, limits)


def test_masked_samples_take_no_part(rng):
    truth = draw(rng, 8, 1)
    windows = record(rng, truth)
    spoilt = windows._replace(x=windows.x.copy(), y=windows.y.copy())
    spoilt.x[:, 20:] = OUTSIDE
    spoilt.y[:, 20:] = 0
    short = windows._replace(x=windows.x[:, :20].copy(), y=windows.y[:, :20].copy())
    start, limits = near(rng, truth), box(8)
    masked = fit_windows(spoilt, start, limits, GAUSSIAN, **TIGHT)
    np.testing.assert_allclose(
        masked.parameters, fit_windows(short, start, limits, GAUSSIAN, **TIGHT).parameters, rtol=1e-5
    )
    assert_reaches_scipy(spoilt, masked, start, limits)


def test_the_width_prior_costs_narrow_echoes_only(rng):
    truth = draw(rng, 12, 2, apart=3.5)
    truth[:, 2] = [1.7, 2.6]
    windows = record(rng, truth)
    start, limits = near(rng, truth), box(12)
    fit = fit_windows(windows, start, limits, GAUSSIAN, prior=WidthPrior(2.2, 0.15), **TIGHT)
    free = fit_windows(windows, start, limits, GAUSSIAN, **TIGHT)
    # The prior sets in with a kink of the slope, around which steps alternate.
    assert_reaches_scipy(windows, fit, start, limits, prior=(2.2, 0.15), slack=(0.1, 0.3))
    assert (fit.cost > free.cost).all()
    wide = fit_windows(windows, start, limits, GAUSSIAN, prior=WidthPrior(0.5, 0.15), **TIGHT)
    np.testing.assert_array_equal(wide.parameters, free.parameters)


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("k", [1, 2, 4])
def test_a_problem_alone_gives_the_same_bits_as_in_a_batch(rng, shape, k):
    truth = draw(rng, 30, k, apart=5.0)
    windows = record(rng, truth, shape)
    windows = windows._replace(clipped=windows.y > 110)
    start, limits = near(rng, truth), box(30)
    options = {"tolerance": 1e-2, "prior": WidthPrior(2.0, 0.1), "hopeless_above": np.full(30, np.inf)}
    batch = fit_windows(windows, start, limits, shape, **options)
    errors = parameter_errors(batch.parameters, windows.std, batch.rows, batch.gram)
    for part in (np.array([0]), np.array([17]), np.arange(5, 12), np.arange(30)[::-1]):
        options["hopeless_above"] = np.full(len(part), np.inf)
        alone = fit_windows(
            windows.take(part), start[part], Limits(limits.low[part], limits.high[part]), shape, **options
        )
        for one, all_ in zip(alone, batch, strict=True):
            np.testing.assert_array_equal(one, all_[part])
        np.testing.assert_array_equal(
            parameter_errors(alone.parameters, windows.std[part], alone.rows, alone.gram), errors[part]
        )


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize(("k", "apart"), [(1, 6.0), (2, 6.0), (2, 3.0), (3, 4.0)])
def test_errors_are_those_of_the_inverse_fisher_matrix(rng, shape, k, apart):
    truth = draw(rng, 10, k, apart)
    windows = record(rng, truth, shape)
    fit = fit_windows(windows, truth, box(10), shape, **TIGHT)
    fresh = evaluate_model(windows, fit.parameters, shape)
    errors = parameter_errors(fit.parameters, windows.std, fresh, gram_matrix(fresh))
    own = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    x = np.arange(float(LENGTH))
    for i in np.flatnonzero(~fit.at_bound.any(axis=1)):
        plain = naive.fisher_errors(fit.parameters[i], x, NOISE, kappa=shape.kappa, components=shape.components)
        np.testing.assert_allclose(errors[i], plain, rtol=5e-3)
        # A fit hands out the products of its last step but one: where echoes overlap, errors change with every step.
        np.testing.assert_allclose(own[i], plain, rtol=1e-3 if apart > 5 else 0.15)


def test_errors_grow_with_the_noise(rng):
    truth = draw(rng, 5, 1)
    windows = record(rng, truth)
    fit = fit_windows(windows, truth, box(5), GAUSSIAN, **TIGHT)
    errors = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    np.testing.assert_allclose(parameter_errors(fit.parameters, 3 * windows.std, fit.rows, fit.gram), 3 * errors)


def test_two_echoes_in_one_place_do_not_break_the_fit(rng):
    truth = draw(rng, 10, 1)
    windows = record(rng, truth)
    start = np.repeat(truth, 2, axis=2)
    start[:, 0] /= 2
    fit = fit_windows(windows, start, box(10), GAUSSIAN)
    errors = parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    assert np.isfinite(fit.parameters).all()
    assert np.isfinite(errors).all()
    assert (errors[:, 0].max(axis=1) > 100).all(), "amplitudes that cannot be told apart must have large errors"
    np.testing.assert_allclose(fit.parameters[:, 0].sum(axis=1), truth[:, 0, 0], rtol=0.2)


@pytest.mark.parametrize("level", [0.0, 200.0])
def test_windows_without_information_stay_finite(level):
    windows = Windows(
        np.full((3, 8), level, np.float32), np.tile(np.arange(8, dtype=np.float32), (3, 1)), np.full(3, NOISE)
    )
    windows.x[1:] = OUTSIDE
    windows.y[1:] = 0
    start = np.tile([[[10.0, 5.0], [3.0, 30.0], [2.0, 2.0]]], (3, 1, 1))
    fit = fit_windows(windows, start, box(3, high=(1e9, 40.0, 8.0)), GAUSSIAN)
    assert np.isfinite(fit.parameters).all()
    assert np.isfinite(parameter_errors(fit.parameters, windows.std, fit.rows, fit.gram)).all()


def test_no_problems_give_no_solutions():
    windows = Windows(np.empty((0, 8), np.float32), np.empty((0, 8), np.float32), np.empty(0))
    fit = fit_windows(windows, np.empty((0, 3, 1)), box(0), GAUSSIAN)
    assert fit.parameters.shape == (0, 3, 1)


def test_hopeless_problems_are_given_up_and_others_are_not(rng):
    truth = draw(rng, 20, 1)
    windows = record(rng, truth)
    start, limits = near(rng, truth), box(20)
    free = fit_windows(windows, start, limits, GAUSSIAN, **TIGHT)
    above = np.where(np.arange(20) % 2 == 0, free.cost - 10, free.cost + 10)
    fit = fit_windows(windows, start, limits, GAUSSIAN, hopeless_above=above, **TIGHT)
    assert fit.hopeless[::2].all()
    assert not fit.hopeless[1::2].any()
    np.testing.assert_array_equal(fit.parameters[1::2], free.parameters[1::2])


def test_too_few_iterations_are_reported(rng):
    truth = draw(rng, 10, 2, apart=3.0)
    start = truth.copy()
    start[:, 1] += 1.5
    fit = fit_windows(record(rng, truth), start, box(10), GAUSSIAN, tolerance=1e-8, max_iterations=2)
    assert not fit.converged.any()
    assert np.isfinite(fit.cost).all()


def test_no_fit_ends_worse_than_it_says(rng):
    """Close echoes lie in a curved valley: a last step along it may climb its side, however little it promises."""
    m = 4000
    truth = draw(rng, m, 2, apart=2.5)
    windows, limits = record(rng, truth), box(m)
    start = truth.copy()
    start[:, 0] *= rng.uniform(0.4, 1.6, start[:, 0].shape)
    start[:, 1] += rng.uniform(-1.5, 1.5, start[:, 1].shape)
    fit = fit_windows(windows, start, limits, GAUSSIAN, tolerance=0.5, max_iterations=40)
    rows = evaluate_model(windows, fit.parameters, GAUSSIAN)
    assert (gram_matrix(rows)[:, -1, -1] - fit.cost).max() < 10


@pytest.mark.parametrize("apart", [1.8, 2.2, 2.7, 6.0])
def test_the_error_of_an_energy_is_its_scatter_also_where_echoes_overlap(rng, apart):
    """With the correlation of lone echoes, -1/sqrt(3), errors were 1.4 to 1.9 times too small."""
    truth = np.empty((800, 3, 2))
    truth[:, 0], truth[:, 2] = (60.0, 45.0), 2.0
    truth[:, 1, 0] = rng.uniform(10.0, 11.0, 800)
    truth[:, 1, 1] = truth[:, 1, 0] + 2.0 * apart
    windows = record(rng, truth)
    fit = fit_windows(windows, truth.copy(), box(800), GAUSSIAN, **TIGHT)
    errors, shared = fit_errors(fit.parameters, windows.std, fit.rows, fit.gram)
    rows = (values.transpose(0, 2, 1).reshape(1600, -1) for values in (fit.parameters, errors, shared))
    energy = relative_energy_errors(*rows).reshape(800, 2)
    area = fit.parameters[:, 0] * fit.parameters[:, 2]
    off = area / (truth[:, 0] * truth[:, 2]) - 1.0
    inside = np.mean(np.abs(off) < energy, axis=0)
    assert inside == pytest.approx(0.683, abs=0.075)
