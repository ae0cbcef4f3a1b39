"""Pulses with a skew of their own: derivatives, agreement with the common form, and fits against scipy."""

import naive
import numpy as np
import pytest
from scipy.optimize import least_squares

from wavebatch.kernels.fit.free_skew import LEAST_AWAY, SkewPrior, evaluate_skewed, fit_skews, render_skewed
from wavebatch.kernels.fit.least_squares import OUTSIDE, Limits, Windows
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.fit.render import render_echoes

BOX = Limits(*(np.array(edge)[None, :, None] for edge in ((0, -3, 0.5, -0.6), (1e6, 90, 30, 0.6))))
FREE = SkewPrior(0.0, 1e3)


def windows_of(y, std):
    m, length = y.shape
    return Windows(y.astype(np.float32), np.tile(np.arange(length, dtype=np.float32), (m, 1)), np.full(m, std))


@pytest.mark.parametrize("skew", [-0.4, -2e-3, 0.0, 5e-4, 2e-3, 0.3])
def test_pulse_and_derivatives(skew):
    x, at = np.arange(-6.0, 14, 0.23), [3.1, 1.8, skew]
    pulse, by_time, by_width, by_skew = evaluate_skewed(x, *at)
    np.testing.assert_allclose(pulse, naive.pulse(x, *at), atol=1e-7)
    step = 1e-4
    for k, (part, unit) in enumerate(((by_time, 1.8), (by_width, 1.8), (by_skew, 1.0))):
        up, down = (np.array(at) + sign * step * np.eye(3)[k] for sign in (1, -1))
        slope = (naive.pulse(x, *up) - naive.pulse(x, *down)) / (2 * step)
        np.testing.assert_allclose(part, unit * slope, atol=2e-4)


def test_the_series_joins_the_closed_form():
    x = np.arange(-6.0, 14, 0.23)
    for near, far in zip(evaluate_skewed(x, 3.0, 2.0, 0.999e-3), evaluate_skewed(x, 3.0, 2.0, 1.001e-3), strict=True):
        np.testing.assert_allclose(near, far, atol=1e-5)


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
    start = np.tile(true, (8, 1, 1)) * rng.uniform(0.9, 1.1, (8, 4, 2))
    start[:, 3] = 0.0
    prior = SkewPrior(0.1, 0.1)
    found = fit_skews(windows_of(y, 1.0), start, BOX, prior=prior, tolerance=1e-8)
    assert found.converged.all() and not found.at_bound.any()
    for one, parameters in zip(y, found.parameters, strict=True):

        def misfit(flat, one=one):
            p = flat.reshape(4, 2)
            model = sum(a * naive.pulse(x, t, s, k) for a, t, s, k in p.T)
            return np.concatenate([one - model, (p[3] - prior.mean) / prior.spread])

        plain = least_squares(misfit, true.ravel(), x_scale="jac", xtol=1e-12, ftol=1e-12).x.reshape(4, 2)
        np.testing.assert_allclose(parameters, plain, atol=5e-3)


def test_errors_cover_the_scatter_and_the_prior_narrows_them():
    rng = np.random.default_rng(3)
    n, x = 1500, np.arange(44.0)
    time = 20 + rng.uniform(-0.5, 0.5, n)
    y = np.stack([60 * naive.pulse(x, t, 2.2, 0.2) for t in time]) + rng.standard_normal((n, 44))
    start = np.stack([np.full(n, 60.0), time, np.full(n, 2.2), np.zeros(n)], axis=1)[:, :, None]
    free = fit_skews(windows_of(y, 1.0), start, BOX, prior=FREE)
    off = (free.parameters[:, :, 0] - np.stack([np.full(n, 60.0), time, np.full(n, 2.2), np.full(n, 0.2)], axis=1))
    assert np.std(off / free.errors[:, :, 0], axis=0) == pytest.approx(np.ones(4), abs=0.08)
    assert np.abs(off[:, 3].mean()) < 0.005
    held = fit_skews(windows_of(y, 1.0), start, BOX, prior=SkewPrior(0.2, 0.01))
    assert held.errors[:, 3].max() < 0.0101 < free.errors[:, 3].min()


def test_an_origin_ties_the_skew_to_the_time():
    """The formula as printed, a exp(-(ln x - mu)^2 / (2 sigma^2)), by scipy in its own parameters."""
    rng = np.random.default_rng(4)
    x, origin = np.arange(60.0), 11.0
    z = np.maximum(x - origin, 1e-9)
    y = 90 * np.exp(-0.5 * ((np.log(z) - np.log(15.0)) / 0.16) ** 2) + rng.standard_normal(60)
    start = np.array([[[80.0], [27.0], [2.0], [0.0]]])
    found = fit_skews(windows_of(y[None], 1.0), start, BOX, origin=np.array([origin]), tolerance=1e-8)

    def misfit(p):
        return y - p[0] * np.exp(-0.5 * ((np.log(z) - p[1]) / p[2]) ** 2)

    height, mu, sigma = least_squares(misfit, [80.0, np.log(16.0), 0.14]).x
    amplitude, time, width, skew = found.parameters[0, :, 0]
    assert [amplitude, time - origin, skew] == pytest.approx([height, np.exp(mu), sigma], rel=2e-3)
    assert skew == pytest.approx(width / (time - origin), rel=1e-9)
    close = fit_skews(windows_of(y[None], 1.0), start, BOX, origin=np.array([58.0]))
    assert close.parameters[0, 1, 0] >= 58.0 + LEAST_AWAY - 1e-9 and np.isfinite(close.errors).all()


def test_samples_outside_say_nothing():
    x = np.arange(40.0)
    y = (70 * naive.pulse(x, 18.0, 2.0, 0.2))[None]
    windows = windows_of(y, 1.0)
    spoiled, position = windows.y.copy(), windows.x.copy()
    spoiled[:, 30:], position[:, 30:] = 500.0, OUTSIDE
    start = np.array([[[60.0], [18.4], [2.2], [0.0]]])
    found = fit_skews(windows._replace(y=spoiled, x=position), start, BOX, prior=FREE, tolerance=1e-9)
    np.testing.assert_allclose(found.parameters[0, :, 0], [70, 18, 2, 0.2], atol=2e-3)


@pytest.mark.parametrize(("origin", "skew"), [(11.0, 0.2), (9.0, 0.5)])
def test_errors_with_an_origin_cover_the_scatter(origin, skew):
    """The skew follows from width and time there, so that all derivatives have a part of it."""
    rng = np.random.default_rng(5)
    n, x = 1200, np.arange(60.0)
    z = np.maximum(x - origin, 1e-9)
    middle = 15.0 + rng.uniform(-0.5, 0.5, n)
    y = 90 * np.exp(-0.5 * ((np.log(z) - np.log(middle)[:, None]) / skew) ** 2) + rng.standard_normal((n, 60))
    width = skew * middle
    true = np.stack([np.full(n, 90.0), origin + middle, width], axis=1)
    start = np.concatenate([true, np.zeros((n, 1))], axis=1)[:, :, None]
    box = Limits(*(np.array(edge)[None, :, None] for edge in ((0, -3, 0.5, -np.inf), (1e6, 90, 30, np.inf))))
    found = fit_skews(windows_of(y, 1.0), start, box, origin=np.full(n, origin), tolerance=1e-6)
    off = found.parameters[:, :3, 0] - true
    assert np.std(off / found.errors[:, :3, 0], axis=0) == pytest.approx(np.ones(3), abs=0.08)
