"""The closed form of single echoes: the test vector of docs/algorithms.md 4.1, and a plain weighted parabola."""

import numpy as np
import pytest

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import fit_closed_form
from wavebatch.stages.decompose.fit import closed_form

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
