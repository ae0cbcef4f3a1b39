"""Noise of a strip's quiet samples, measured apart from the survey: standard deviation and correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from bench.real.pool import Pool, Solver, each_echo, find_gaps
from scipy.linalg import solve_toeplitz
from scipy.ndimage import maximum_filter1d, uniform_filter1d
from scipy.special import ndtr, ndtri

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import WaveformBlock

LAGS = 4
"""Lags at which the covariance is measured [samples]; beyond them it counts as none."""

LONG = 64
"""Quiet samples from which on their mean is that of the noise."""

QUIET_BEFORE, QUIET_AFTER = 6.0, 25.0
"""Samples this far from every echo are quiet [sigma of the system pulse]: pulses rise fast and have long tails."""

LEAST_QUIET = 6
"""Quiet samples of a waveform that is looked at."""

OUTLIER = 4.5
"""Samples further off are echoes too weak to be found, or spikes [standard deviations]."""


SWEEPS = 3
"""Times that all samples are drawn; more change nothing in the covariance of the result."""


MISSED = 3.5
"""Means over the width of an echo that are higher are echoes that were not found [their standard deviations]."""


@dataclass(frozen=True, slots=True)
class QuietNoise:
    """Noise of samples far from any echo."""

    std: float
    """[DN]."""
    correlation: tuple[float, ...]
    """With the next sample, the one after it, ..."""
    samples: int

    def regression(self) -> tuple[np.ndarray, float]:
        """Weights of the neighbours on either side (4,), and the standard deviation of a sample given these.

        Before rounding: of the autoregressive process with the measured covariances, less the variance of rounding.
        """
        variance = max(self.std**2 - QUANTISATION_STD**2, 0.01)
        tail = np.array(self.correlation) * self.std**2
        tail *= min(1.0, 0.95 * variance / max(float(np.abs(tail).max(initial=0.0)), 1e-9))
        # A little more variance keeps the equations well posed where the correlations are not those of any process.
        ahead = solve_toeplitz(np.r_[1.02 * variance, tail[:-1]], tail) if len(tail) else tail
        innovation = max(variance - float(ahead @ tail), 0.05 * variance)
        filter_ = np.r_[1.0, -ahead]
        power = np.correlate(filter_, filter_, "full")[len(ahead) :]
        return -power[1:] / power[0], float(np.sqrt(innovation / power[0]))


def measure_noise(pool: Pool, solver: Solver, echoes: Sequence[EchoTable]) -> QuietNoise:
    """Noise about the mean of each waveform's quiet samples.

    The mean of a few correlated samples follows their noise; what it takes away is added again. echoes: of the pool's
    blocks.
    """
    products, pairs = np.zeros(LAGS + 1), np.zeros(LAGS + 1)
    lengths = []
    for block, table in zip(pool.blocks, echoes, strict=True):
        quiet = _find_quiet(block, table, solver.system.sigma_ref)
        quiet &= (quiet.sum(axis=1) >= LEAST_QUIET)[:, None]
        number = quiet.sum(axis=1)
        mean = np.sum(block.samples * quiet, axis=1) / np.maximum(number, 1)
        deviation = block.samples - mean[:, None]
        if not quiet.any():
            continue
        kept = quiet & (np.abs(deviation) < OUTLIER * max(_usual(deviation[quiet]), QUANTISATION_STD))
        kept &= ~_find_missed(deviation, quiet, solver.fwhm / block.spacing)
        for lag in range(min(LAGS + 1, kept.shape[1])):
            end = kept.shape[1] - lag
            both = kept[:, lag:] & kept[:, :end]
            products[lag] += (deviation[:, lag:] * deviation[:, :end])[both].sum()
            pairs[lag] += both.sum()
        lengths.append(np.repeat(number, number))
    if not lengths or pairs[0] < 100:
        return QuietNoise(solver.system.noise.std, (), int(pairs[0]))
    covariance = _add_mean(products / np.maximum(pairs, 1), np.concatenate(lengths))
    std = float(np.sqrt(max(covariance[0], QUANTISATION_STD**2)))
    return QuietNoise(std, tuple(map(float, covariance[1:] / std**2)), int(pairs[0]))


def _find_quiet(block: WaveformBlock, table: EchoTable, sigma: float) -> np.ndarray:
    """Recorded samples far from every echo, bool (n, s)."""
    quiet = ~find_gaps(block)
    time = np.arange(block.samples.shape[1]) * block.spacing
    for rows, echo in each_echo(table, np.arange(len(block))):
        lag = (time - table.time[echo][:, None]) / sigma
        quiet[rows] &= (lag < -QUIET_BEFORE) | (lag > QUIET_AFTER)
    return quiet


def _find_missed(deviation: np.ndarray, quiet: np.ndarray, width: float) -> np.ndarray:
    """Samples of echoes that a chain with too high a threshold left in quiet stretches, bool (n, s).

    width: of an echo [samples].
    """
    size = max(round(width), 1)
    smoothed = uniform_filter1d(np.where(quiet, deviation, 0.0), size, axis=1, mode="constant")
    high = quiet & (smoothed > MISSED * _usual(smoothed[quiet]))
    return maximum_filter1d(high, 4 * size + 1, axis=1, mode="constant")


def _usual(values: np.ndarray) -> float:
    """Standard deviation from the median of squares, which is 0.455 for standard normal numbers."""
    return float(np.sqrt(np.median(values**2) / 0.455))


def _add_mean(covariance: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Covariance (LAGS + 1,) about the true mean, from that about means of `lengths` samples, one per sample.

    What is expected about such means is linear in the true covariance, which counts as 0 beyond the last lag.
    """
    kinds, weights = np.unique(np.minimum(lengths, LONG), return_counts=True)
    expected = sum(weight * _expect_covariance(int(n)) for n, weight in zip(kinds, weights, strict=True))
    return np.linalg.lstsq(expected / weights.sum(), covariance, rcond=1e-3)[0]


def _expect_covariance(n: int) -> np.ndarray:
    """Covariance at each lag about the mean of n samples, per true covariance at each lag, (LAGS + 1, LAGS + 1)."""
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    centre = np.eye(n) - 1 / n
    found = [centre @ (lag == true) @ centre for true in range(LAGS + 1)]
    return np.array([[np.diagonal(part, at).mean() if at < n else 0.0 for part in found] for at in range(LAGS + 1)])


def unround(samples: np.ndarray, expected: np.ndarray, noise: QuietNoise, rng: np.random.Generator) -> np.ndarray:
    """Values before the digitizer rounded them, drawn from those that it rounds to these counts, f8 (n, s).

    Values near to what the neighbours and the noise make likely are drawn more often. Drawing evenly, or rounding the
    sum of a count and an echo as it is, would add 8 to 15 % to the variance of noise of 1 DN and take from its
    correlation. Gibbs sampling: every fifth sample at a time, given the values drawn for its neighbours.

    expected: samples without their noise (n, s).
    """
    weights, std = noise.regression()
    reach = len(weights)
    deviation = np.zeros((samples.shape[0], samples.shape[1] + 2 * reach))
    inner = deviation[:, reach : reach + samples.shape[1]]
    rounded = samples - expected
    inner[:] = rounded
    for _ in range(SWEEPS):
        for first in range(reach + 1):
            at = np.arange(first, samples.shape[1], reach + 1)
            mean = np.zeros((len(samples), len(at)))
            for lag, weight in enumerate(weights, 1):
                mean += weight * (deviation[:, at + reach - lag] + deviation[:, at + reach + lag])
            inner[:, at] = _draw_rounded(rounded[:, at], mean, std, rng)
    return expected + inner


def _draw_rounded(rounded: np.ndarray, mean: np.ndarray, std: float, rng: np.random.Generator) -> np.ndarray:
    """Normal values within half a count of the rounded ones."""
    low, high = (ndtr((rounded + side - mean) / std) for side in (-0.5, 0.5))
    u = rng.random(rounded.shape)
    with np.errstate(invalid="ignore"):
        drawn = mean + std * ndtri(low + u * (high - low))
    # So far out that the distribution has no digits left: spikes, and echoes that were not fitted.
    lost = ~(high - low > 1e-9) | ~(np.abs(drawn - rounded) <= 0.5)
    return np.where(lost, rounded + u - 0.5, drawn)
