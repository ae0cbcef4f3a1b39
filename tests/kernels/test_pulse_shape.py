"""Pulse models: values and derivatives against differences; the skewed pulse near zero skew (H4)."""

import naive
import numpy as np
import pytest

from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse

SHAPES = {
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


@pytest.fixture(params=SHAPES)
def shape(request):
    return SHAPES[request.param]


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
