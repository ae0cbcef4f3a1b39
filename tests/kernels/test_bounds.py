"""T1: the closed forms of the Cramer-Rao bounds against a numeric Fisher matrix, and those of the bench."""

import numpy as np
import pytest

from wavebatch.core.echoes import EchoTable
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.tools.bench.accuracy import find_bounds
from wavebatch.tools.simulate import PulseModel, Recording


def numeric_bounds(parameters, noise_std, spacing, n_samples):
    """Naive twin: derivatives by central differences, Fisher matrix and its inverse, one waveform."""
    x = np.arange(n_samples) * spacing

    def model(p):
        return sum(a * np.exp(-0.5 * ((x - t) / s) ** 2) for t, a, s in p.reshape(-1, 3))

    start = np.array(parameters, float).ravel()
    columns = []
    for i in range(len(start)):
        step = np.zeros(len(start))
        step[i] = 1e-6 * max(abs(start[i]), 1.0)
        columns.append((model(start + step) - model(start - step)) / (2 * step[i]))
    jacobian = np.array(columns).T
    covariance = np.linalg.inv(jacobian.T @ jacobian) * noise_std**2
    return np.sqrt(np.diag(covariance)).reshape(-1, 3), covariance


@pytest.mark.parametrize(
    ("sigma", "spacing", "tolerance"),
    [(1.5, 1.0, 1e-3), (2.0, 1.0, 1e-3), (4.0, 2.0, 1e-3), (1.0, 1.0, 1e-2), (0.5, 0.25, 1e-3)],
)
@pytest.mark.parametrize("phase", [0.0, 0.21, 0.5])
def test_closed_forms_equal_the_fisher_matrix(sigma, spacing, tolerance, phase):
    time = (30 + phase) * spacing
    (expected,), covariance = numeric_bounds([(time, 50.0, sigma)], 1.3, spacing, 64)
    found = crlb(np.array(50.0), np.array(sigma), 1.3, spacing)
    assert np.allclose(np.array(found), expected, rtol=tolerance)
    if tolerance < 1e-2:
        correlation = covariance[1, 2] / np.sqrt(covariance[1, 1] * covariance[2, 2])
        assert correlation == pytest.approx(-1 / np.sqrt(3), abs=2e-3)


def test_constants_of_the_specification():
    time, amplitude, sigma = crlb(np.array([20.0]), np.array([1.7]), 1.0, 1.0)
    assert time == pytest.approx(1.0623 / 20 * np.sqrt(1.7), rel=1e-4)
    assert sigma == pytest.approx(time)
    assert amplitude == pytest.approx(0.9199 / np.sqrt(1.7), rel=1e-4)
    assert time * 14.9896 == pytest.approx(1.04, abs=0.005)


def test_bounds_broadcast_noise_per_echo():
    noise = np.array([1.0, 2.0])
    time, amplitude, sigma = crlb(np.array([50.0, 50.0]), np.array([2.0, 2.0]), noise, 1.0)
    assert time[1] == pytest.approx(2 * time[0])
    assert amplitude[1] == pytest.approx(2 * amplitude[0])
    assert sigma.shape == (2,)


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
