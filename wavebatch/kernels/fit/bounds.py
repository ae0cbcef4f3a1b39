"""Cramer-Rao bounds: the least errors that any unbiased decomposer can reach (ALGORITHMS.md 2.1, 2.2)."""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import SQRT_PI


def bound_time(amplitude: np.ndarray, sigma: np.ndarray, noise_std: np.ndarray | float, spacing: float) -> np.ndarray:
    """Least standard deviation of the time of isolated Gaussian echoes [ns]; the one of sigma is the same.

    amplitude [count], sigma [ns] and noise_std (of one recorded sample) [count] are broadcast; spacing [ns].
    Source: ALGORITHMS.md 2.1, inverse of the Fisher matrix with known baseline and white noise.
    Good to 1 % for sigma >= spacing; below 0.7 spacing it depends on the phase of the samples.
    """
    return noise_std / np.asarray(amplitude, np.float64) * np.sqrt(2.0 * spacing * sigma / SQRT_PI)


def crlb(
    amplitude: np.ndarray, sigma: np.ndarray, noise_std: np.ndarray | float, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least standard deviations of time [ns], amplitude [count] and sigma [ns] of isolated Gaussian echoes."""
    time = bound_time(amplitude, sigma, noise_std, spacing)
    height = noise_std * np.sqrt(1.5 * spacing / (SQRT_PI * np.asarray(sigma, np.float64)))
    return time, np.broadcast_to(height, time.shape), time
