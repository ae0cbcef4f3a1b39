"""Candidates are the maxima above the stated threshold, no more and no fewer, as a loop over samples finds them."""

import naive
import numpy as np
import pytest

from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.filters import curvature_taps, gaussian_taps
from wavebatch.stages.chain import STAGES


def each(function, signal):
    """The function of every waveform of signal (s, n)."""
    return np.stack([function(column) for column in signal.T], axis=1)


def gain(filter_one):
    """Standard deviation of white noise of unit variance behind a linear filter."""
    impulse = np.zeros(81)
    impulse[40] = 1.0
    return np.sqrt(np.sum(filter_one(impulse) ** 2))


@pytest.fixture
def block(rng):
    """Noise whose maxima lie around every threshold, and some echoes."""
    y = 12 + rng.normal(0, 1.0, (400, 60))
    y[::4] += 30 * np.exp(-0.5 * ((np.arange(60) - rng.uniform(10, 50, (100, 1))) / 2.0) ** 2)
    return WaveformBlock.from_samples(np.rint(100 * y).astype(np.uint16))


def detect(name, block, **parameters):
    n = len(block)
    system = SystemPulse(2.0, noise=ReceiverNoise(baseline=1200.0, std=100.0))
    noise = Noise(np.full(n, 1200, np.float32), np.full(n, 100, np.float32))
    found = STAGES[f"detect.{name}"].function(block, noise, system, **parameters)
    return sorted(zip(found.waveform.tolist(), np.rint(found.time).astype(int).tolist(), strict=True))


def expect(block, filter_one, threshold):
    signal = block.samples.T.astype(float) - 1200
    return naive.find_peaks(each(filter_one, signal), np.full(len(block), 100 * threshold * gain(filter_one)))


def hold(found, expected):
    """The same waveforms, and places within a sample: a parabola may lead to the next one."""
    assert [w for w, _ in found] == [w for w, _ in expected] and len(found) > 100
    assert max(abs(a - b) for (_, a), (_, b) in zip(found, expected, strict=True)) <= 2


@pytest.mark.parametrize("threshold", [2.0, 4.0])
def test_maxima_are_those_of_the_twice_smoothed_waveform(block, threshold):
    hold(
        detect("maximum", block, threshold=threshold),
        expect(block, lambda y: naive.smooth_121(naive.smooth_121(y)), threshold),
    )


def test_the_matched_filter_has_the_threshold_of_its_noise(block):
    taps = gaussian_taps(2.0)
    hold(
        detect("matched_filter", block, threshold=3.0),
        expect(block, lambda y: naive.correlate_symmetric(y, taps), 3.0),
    )


def test_the_second_derivative_has_the_threshold_of_its_noise_and_a_least_height(block):
    taps = curvature_taps(0.85 * 2.0)
    peaks = expect(block, lambda y: naive.correlate_symmetric(y, taps), 2.0)
    smoothed = each(naive.smooth_121, block.samples.T.astype(float) - 1200)
    high = [(w, i) for w, i in peaks if smoothed[i, w] > 2.0 * 100 * gain(naive.smooth_121)]
    hold(detect("second_derivative", block, level=2.0), high)
    assert len(high) < len(peaks)


@pytest.mark.parametrize("sigma", [2.0, 5.0, 10.0])
def test_candidates_have_the_height_and_width_of_their_echo(sigma):
    """Broad pulses are smoothed by a Gaussian first, which makes them lower and wider."""
    y = 1200 + 5000 * np.exp(-0.5 * ((np.arange(160) - 80.3) / sigma) ** 2)
    block = WaveformBlock.from_samples(np.rint(y[None]).astype(np.uint16))
    noise = Noise(np.full(1, 1200, np.float32), np.full(1, 100, np.float32))
    system = SystemPulse(sigma, noise=ReceiverNoise(baseline=1200.0, std=100.0))
    found = STAGES["detect.maximum"].function(block, noise, system)
    assert len(found) == 1 and found.time[0] == pytest.approx(80.3, abs=0.05)
    assert found.amplitude[0] == pytest.approx(5000, rel=0.1 if sigma < 4 else 0.02)
    assert found.sigma[0] == pytest.approx(sigma, rel=0.1 if sigma < 4 else 0.02)
