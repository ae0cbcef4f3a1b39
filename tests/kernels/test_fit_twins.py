"""Kernels around the fit, and those of outgoing pulses and profiles, against slow twins and the math module."""

import math

import naive
import naive_fit
import numpy as np
import pytest

from wavebatch.kernels.elementary import exp, log, log1p, solve
from wavebatch.kernels.fit import pulse_shape
from wavebatch.kernels.fit.learn_pulse import Stack, refine_gaussians
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.signal.outgoing import find_reference, measure_outgoing


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
    found = refine_gaussians(stack, start)
    expected = naive_fit.fit_stack(stack, start, np.ones(len(lag)))
    weight, delay, _ = expected[0]
    assert found.datum == pytest.approx(delay, abs=1e-4)
    assert found.components == pytest.approx(expected / [weight, 1, 1] - [0, delay, 0], abs=3e-4)
    if hard and components > 2:
        assert (found.components[:, 0] * weight).min() == pytest.approx(-0.3, abs=1e-6), "it is held at its bound"


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
