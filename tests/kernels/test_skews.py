"""Echoes with a skew of their own: fits against scipy, errors, and log-normals that are tied to an origin."""

import naive
import numpy as np
import pytest
from fits import fit
from scipy.optimize import least_squares

from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.fit.render import render_echoes, render_skewed, skewed_pulse

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
