"""Shapes of pulses: their curves and seams, skews, bends, and echoes of the whole pulse."""

import naive
import naive_fit
import numpy as np
import pytest
from fits import fit
from scipy.optimize import least_squares

from wavebatch.kernels.fit.decompose import Clusters, Solution, WholePulse, describe_whole, keep_echoes
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, evaluate_pulse
from wavebatch.kernels.fit.render import render_echoes, render_skewed, skewed_pulse
from wavebatch.kernels.geometry.slice_lines import LEAST_POINTS, find_bend
from wavebatch.kernels.signal.defects import find_seam
from wavebatch.stages.pulse_tables import ShapeLimits, whole_pulse

DRAWN = {
    "gaussian": PulseShape(),
    "skewed": PulseShape(kappa=0.12),
    "skewed to the left": PulseShape(kappa=-0.2),
    "strongly skewed": PulseShape(kappa=0.45),
    "after-pulse": PulseShape(components=((0.16, 2.4, 1.2), (0.04, 10.5, 1.4))),
    "ringing": PulseShape(components=((-0.05, 6.0, 0.3), (0.05, 12.0, -0.5), (0.01, -3.0, 2.0))),
}


def evaluate(shape, x, t, s, dtype=np.float64):
    """Pulse and derivatives times s, (L, k) each; the kernel may use its arguments as work space."""
    t, s = np.atleast_1d(t).astype(dtype), np.atleast_1d(s).astype(dtype)
    return evaluate_pulse(shape, np.asarray(x, dtype)[:, None].copy(), t, s)


@pytest.fixture(params=DRAWN)
def shape(request):
    return DRAWN[request.param]


def test_pulses_equal_the_plain_formula(shape):
    x = np.arange(-12, 30, 0.25)
    pulse = evaluate(shape, x, [3.2, 4.0], [1.4, 2.6])[0]
    for column, t, s in ((0, 3.2, 1.4), (1, 4.0, 2.6)):
        plain = naive.pulse(x, t, s, shape.kappa, shape.components)
        np.testing.assert_allclose(pulse[:, column], plain, atol=3e-7)


def test_derivatives_equal_differences(shape):
    x = np.arange(-6, 24, 0.25)
    for t, s in ((3.2, 1.4), (4.0, 2.6), (5.5, 6.0)):
        _, by_time, by_width = (part[:, 0] for part in evaluate(shape, x, t, s))
        plain = naive.differentiate(lambda p: naive.pulse(x, p[0], p[1], shape.kappa, shape.components), [t, s])  # noqa: B023
        np.testing.assert_allclose(by_time, s * plain[:, 0], atol=5e-6)
        np.testing.assert_allclose(by_width, s * plain[:, 1], atol=5e-6)


def test_single_precision_is_close_to_double(shape):
    x = np.arange(40.0)
    for single, double in zip(evaluate(shape, x, 17.3, 2.1, np.float32), evaluate(shape, x, 17.3, 2.1), strict=True):
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, double, atol=2e-5)


@pytest.mark.parametrize("kappa", [1e-2, 1e-3, 1e-4, -1e-3])
def test_skew_moves_a_gaussian_by_0_580_of_its_size(kappa):
    """max |z^3| exp(-z^2/2) / 2 = 0.5797 at z = sqrt(3); the 0.548 of docs/algorithms.md H4 is too small."""
    z = np.arange(-6, 6, 0.01)
    skewed = evaluate(PulseShape(kappa=kappa), z, 0.0, 1.0)[0][:, 0]
    gauss = np.exp(-0.5 * z * z)
    assert np.abs(skewed - gauss).max() == pytest.approx(0.5797 * abs(kappa), rel=0.02, abs=2e-7)


def naive_gains(x, y):
    """What a bend at each x takes off the sum of squares, by least squares of each."""

    def left(*columns):
        terms = np.stack([np.ones(len(x)), x, *columns], axis=1)
        return np.sum((y - terms @ np.linalg.lstsq(terms, y, rcond=None)[0]) ** 2)

    return np.array([left() - left(np.maximum(x - at, 0)) for at in x[2:-2]])


@pytest.mark.parametrize("count", [8, 20, 300])
@pytest.mark.parametrize("degrees", [2, 10])
def test_a_ridge_is_found_where_it_is(count, degrees):
    rng = np.random.default_rng(count)
    x = np.linspace(-20, 20, count) + rng.uniform(-12, 12, count) / count
    ridge = x[count // 3]
    y = 3 + 0.02 * x - np.tan(np.radians(degrees)) * np.abs(x - ridge) + 0.01 * rng.standard_normal(count)
    found = find_bend(x[::-1], y[::-1])
    assert found == pytest.approx(x[2 + np.argmax(naive_gains(x, y))])
    assert abs(found - ridge) < 0.5


@pytest.mark.parametrize(
    "shape",
    [
        lambda x: 0.2 * x,
        lambda x: -(x**2) / 400,
        lambda x: 0.1 * np.sin(x / 3),
        lambda x: 0.15 * (x > 0),
        lambda x: -0.01 * np.abs(x),
    ],
    ids=["line", "hill", "waves", "step", "half a degree"],
)
def test_other_shapes_are_no_ridge(shape):
    for seed in range(30):
        rng = np.random.default_rng(seed)
        x = np.sort(rng.uniform(-20, 20, 80))
        assert find_bend(x, shape(x) + 0.02 * rng.standard_normal(80)) is None


def test_few_points_or_points_in_one_place_have_no_bend():
    x = np.linspace(-1, 1, LEAST_POINTS - 1)
    assert find_bend(x, np.abs(x)) is None
    assert find_bend(np.zeros(20), np.arange(20.0)) is None
    assert find_bend(np.zeros(0), np.zeros(0)) is None
    assert find_bend(np.arange(20.0), np.zeros(20)) is None


def packets(n, seed=1):
    rng = np.random.default_rng(seed)
    time = rng.uniform(20, 60, (n, 1))
    return np.rint(10 + 100 * np.exp(-0.5 * ((np.arange(80) - time) / 1.7) ** 2) + rng.normal(0, 0.7, (n, 80)))


def interpolate(counts, at):
    counts[:, at] = np.rint(0.5 * (counts[:, at - 1] + counts[:, at + 1]))
    return counts.clip(0, 255).astype(np.uint8)


def test_a_seam_is_one_interpolated_sample():
    assert find_seam(interpolate(packets(600), 40)) == 40
    assert find_seam(packets(600).clip(0, 255).astype(np.uint8)) == 0


def test_what_proves_no_seam():
    assert find_seam(interpolate(packets(19), 40)) == 0, "too few waveforms"
    assert find_seam(interpolate(packets(600), 5)) == 0, "no recording is so short"
    assert find_seam(np.full((600, 80), 7, np.uint8)) == 0, "no signal"
    assert find_seam(interpolate(packets(600)[:, 30:50], 10)) == 0, "short packets"
    ramp = (np.arange(80) * 3 + np.zeros((600, 1))).astype(np.uint8)
    assert find_seam(ramp) == 0, "every sample is the mean of its neighbours"


WIDE = {"width_ref": 2.0, "width_low": 0.5, "width_high": 30.0}


@pytest.mark.parametrize("skew", [-0.4, -2e-3, 0.0, 5e-4, 2e-3, 0.3])
def test_pulses_are_those_of_the_common_form(skew):
    x = np.arange(-6.0, 14, 0.23)
    np.testing.assert_allclose(skewed_pulse(x, 3.1, 1.8, np.array(skew)), naive.pulse(x, 3.1, 1.8, skew), atol=1e-7)


def test_rendered_echoes_are_those_of_the_common_form():
    rng = np.random.default_rng(1)
    waveform = np.sort(rng.integers(0, 6, 40))
    columns = rng.uniform(0, 50, 40), rng.uniform(5, 99, 40), rng.uniform(1, 4, 40)
    ours = render_skewed(6, 50, waveform, *columns, np.full(40, 0.2))
    np.testing.assert_allclose(ours, render_echoes(PulseShape(kappa=0.2), 6, 50, waveform, *columns), atol=2e-3)


def test_fits_are_those_of_scipy():
    rng = np.random.default_rng(2)
    x = np.arange(50.0)
    true = np.array([[80.0, 60.0], [16.0, 29.0], [2.0, 2.6], [0.1, 0.3]])
    y = np.stack([sum(a * naive.pulse(x, t, s, k) for a, t, s, k in true.T) for _ in range(8)])
    y += rng.standard_normal(y.shape)
    start = (np.tile(true, (8, 1, 1)) * rng.uniform(0.9, 1.1, (8, 4, 2)))[:, :3]
    found = fit(y, start, skew_mean=0.1, skew_spread=0.1, tolerance=1e-8, **WIDE)
    assert found.converged.all() and not found.at_bound.any()
    for one, parameters in zip(y, found.parameters, strict=True):

        def misfit(flat, one=one):
            p = flat.reshape(4, 2)
            model = sum(a * naive.pulse(x, t, s, k) for a, t, s, k in p.T)
            return np.concatenate([one - model, (p[3] - 0.1) / 0.1])

        plain = least_squares(misfit, true.ravel(), x_scale="jac", xtol=1e-12, ftol=1e-12).x.reshape(4, 2)
        np.testing.assert_allclose(parameters, plain, atol=5e-3)


def test_errors_cover_the_scatter_and_the_prior_narrows_them():
    rng = np.random.default_rng(3)
    n, x = 1500, np.arange(44.0)
    time = 20 + rng.uniform(-0.5, 0.5, n)
    y = np.stack([60 * naive.pulse(x, t, 2.2, 0.2) for t in time]) + rng.standard_normal((n, 44))
    start = np.stack([np.full(n, 60.0), time, np.full(n, 2.2)], axis=1)[:, :, None]
    free = fit(y, start, skew_spread=1e3, tolerance=0.1, **WIDE)
    off = free.parameters[:, :, 0] - np.stack([np.full(n, 60.0), time, np.full(n, 2.2), np.full(n, 0.2)], axis=1)
    assert np.std(off / free.errors[:, :, 0], axis=0) == pytest.approx(np.ones(4), abs=0.08)
    assert np.abs(off[:, 3].mean()) < 0.005
    held = fit(y, start, skew_mean=0.2, skew_spread=0.01, tolerance=0.1, **WIDE)
    assert held.errors[:, 3].max() < 0.0101 < free.errors[:, 3].min()


def test_an_origin_ties_the_skew_to_the_time():
    """The formula as printed, a exp(-(ln x - mu)^2 / (2 sigma^2)), by scipy in its own parameters."""
    rng = np.random.default_rng(4)
    z = np.arange(1.0, 61.0)  # counted from 1
    y = 90 * np.exp(-0.5 * ((np.log(z) - np.log(15.0)) / 0.16) ** 2) + rng.standard_normal(60)
    start = np.array([[[80.0], [15.0], [2.0]]])
    for origin in ("segment", "waveform"):
        found = fit(y[None], start, shape=PulseShape(origin=origin), tolerance=1e-8, **WIDE)

        def misfit(p):
            return y - p[0] * np.exp(-0.5 * ((np.log(z) - p[1]) / p[2]) ** 2)

        height, mu, sigma = least_squares(misfit, [80.0, np.log(16.0), 0.14]).x
        amplitude, time, width, skew = found.parameters[0, :, 0]
        assert [amplitude, time + 1, skew] == pytest.approx([height, np.exp(mu), sigma], rel=2e-3)
        assert skew == pytest.approx(width / (time + 1), rel=1e-9)
    early = start - [[0], [15.5], [0]]
    close = fit(np.r_[300.0, np.zeros(59)][None], early, shape=PulseShape(origin="segment"), **WIDE)
    assert close.parameters[0, 1, 0] >= -0.75 and np.isfinite(close.errors).all()


@pytest.mark.parametrize(("middle", "skew"), [(15.0, 0.2), (17.0, 0.5)])
def test_errors_with_an_origin_cover_the_scatter(middle, skew):
    """The skew follows from width and time there, so that all derivatives have a part of it."""
    rng = np.random.default_rng(5)
    n, z = 1200, np.arange(1.0, 61.0)
    middle = middle + rng.uniform(-0.5, 0.5, n)
    y = 90 * np.exp(-0.5 * ((np.log(z) - np.log(middle)[:, None]) / skew) ** 2) + rng.standard_normal((n, 60))
    true = np.stack([np.full(n, 90.0), middle - 1, skew * middle], axis=1)
    found = fit(y, true[:, :, None], shape=PulseShape(origin="segment"), tolerance=1e-6, **WIDE)
    off = found.parameters[:, :3, 0] - true
    assert np.std(off / found.errors[:, :3, 0], axis=0) == pytest.approx(np.ones(3), abs=0.08)


LIMITS = ShapeLimits(2.0, 1.0, 30.0)
SHAPES = {
    "gaussian": GAUSSIAN,
    "skewed": PulseShape(kappa=0.3),
    "learned": PulseShape(components=((0.2, 3.0, 1.5), (-0.1, -2.0, 0.4))),
}


def draw(rng, m, most=6.0):
    """Fits of m echoes, some of them wide, faint, outside of the waveform or without errors."""
    fitted = np.stack([rng.normal(20, 15, m), rng.uniform(-6, 86, m), rng.uniform(1.0, most, m), np.zeros(m)], axis=1)
    errors = rng.uniform(0.01, 3.0, (m, 4))
    errors[rng.random(m) < 0.05, 0] = np.inf
    errors[rng.random(m) < 0.05, 2] = np.nan
    shared = rng.normal(0, 1.0, (m, 2))
    shared[rng.random(m) < 0.1] = np.nan
    return fitted, errors, shared


@pytest.mark.parametrize("level", [None, 0.3])
@pytest.mark.parametrize("most", [6.0, 60.0])
@pytest.mark.parametrize("name", SHAPES)
def test_the_library_keeps_and_describes_echoes_as_the_loop(name, most, level, rng):
    number = rng.choice([0, 1, 1, 1, 2, 5], 300)
    c, m = len(number), int(number.sum())
    fitted, errors, shared = draw(rng, m, most)
    solution = Solution(number, rng.random(c) < 0.9, np.zeros(c), rng.uniform(0.5, 3, m), fitted, errors, shared,
                        rng.random(m) < 0.1)  # fmt: skip
    windows = np.zeros((4, c), np.int64)
    windows[1] = rng.integers(20, 80, c)
    clusters = Clusters(np.sort(rng.integers(0, 200, c)), *windows)
    whole = whole_pulse(SHAPES[name], LIMITS, fitted[:, 2])
    assert bool(len(whole.wide)) == (name == "learned" and most > 8)
    factors, std = rng.uniform(0.5, 1.5, (m, 4)), rng.uniform(0.5, 2, 200).astype(np.float32)
    problem = clusters, solution, whole, factors, std, 0.5, 80, 4.5, None if level is None else level * std
    with np.errstate(all="ignore"):
        columns, row = keep_echoes(*problem)
        expected = naive_fit.keep(*problem)
    assert 0.25 * m < len(row) == len(expected) < m
    for found, wanted in zip((*columns.values(), row), zip(*expected, strict=True), strict=True):
        np.testing.assert_array_equal(found, np.array(wanted).astype(found.dtype))
    values, spreads = describe_whole(whole, fitted[:, :3], errors[:, :3], shared)
    with np.errstate(all="ignore"):
        fits = zip(fitted[:, :3], errors[:, :3], shared, strict=True)
        twins = [naive_fit.describe_whole(whole, *fit) for fit in fits]
    np.testing.assert_array_equal(values, [value for value, _ in twins])
    np.testing.assert_array_equal(spreads, [error for _, error in twins])


def test_a_call_changes_no_fit_and_no_fits_give_no_echoes(rng):
    """Errors were once multiplied in place, so that echoes of asked clusters got their factors twice."""
    fitted, errors, shared = draw(rng, 3)
    errors[:] = 0.1
    one, kept = np.ones(1, np.int64), errors.copy()
    solution = Solution(3 * one, one > 0, one * 1.0, np.ones(3), fitted, errors, shared, np.zeros(3, bool))
    clusters = Clusters(*[0 * one] * 5)
    keep_echoes(clusters, solution, WholePulse(), np.full((3, 4), 2.0), np.ones(1, np.float32), 1.0, 80, 1.0)
    np.testing.assert_array_equal(errors, kept)
    none = Solution(*(column[:0] for column in solution))
    columns, row = keep_echoes(Clusters(*(column[:0] for column in clusters)), none, WholePulse(), np.ones((0, 4)),
                               np.ones(1, np.float32), 1.0, 80, 1.0)  # fmt: skip
    assert len(row) == len(columns["time"]) == 0


def test_arrays_that_do_not_fit_are_refused(rng):
    fitted, errors, shared = draw(rng, 2)
    one = np.ones(1, np.int64)
    solution = Solution(2 * one, one > 0, one * 1.0, np.ones(2), fitted, errors, shared, np.zeros(2, bool))
    clusters, std = Clusters(*[0 * one] * 5), np.ones(1, np.float32)
    with pytest.raises(ValueError, match="differ in length"):
        keep_echoes(clusters, solution, WholePulse(), np.ones((1, 4)), std, 1.0, 80, 1.0)
    with pytest.raises(ValueError, match="differ in length"):
        keep_echoes(clusters, solution._replace(number=3 * one), WholePulse(), np.ones((2, 4)), std, 1.0, 80, 1.0)
    with pytest.raises(ValueError, match="lies in no waveform"):
        keep_echoes(clusters._replace(waveform=one), solution, WholePulse(), np.ones((2, 4)), std, 1.0, 80, 1.0)
    with pytest.raises(ValueError, match="no table for these widths"):
        describe_whole(whole_pulse(SHAPES["learned"], LIMITS, np.ones(1)), *np.full((2, 1, 3), 50.0), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="as many errors"):
        describe_whole(WholePulse(), np.ones((2, 3)), np.ones((1, 3)), np.ones((2, 2)))


@pytest.mark.parametrize(
    ("limits", "ends"),
    [
        ((2.0, 1.0, 30.0), (1.0, 8.0)),  # four widths of the pulse; wider ones have a coarser table
        ((2.0, 1.6, 30.0), (1.4, 8.0)),  # the same table for all fits that allow no less than .7 widths
        ((2.0, 1.4, 5.0), (1.4, 5.0)),
        ((2.0, 9.0, 30.0), (1.4, 9.09)),
    ],
)
def test_the_table_of_usual_widths_is_no_wider_than_fits_allow(limits, ends):
    near = whole_pulse(SHAPES["learned"], ShapeLimits(*limits), np.ones(1)).near
    assert near[[0, -1], 0] == pytest.approx(ends)
