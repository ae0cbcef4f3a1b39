"""Cramer-Rao bounds: the smallest errors that any unbiased decomposer can reach with isolated Gaussian echoes.

Used as expected errors by tools, survey and score. They hold for a known baseline and white noise; overlapping echoes
have larger bounds (docs/algorithms.md 2.1, 2.2).
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import SQRT_PI


def bound_time(
    amplitude: np.ndarray | float, sigma: np.ndarray | float, noise_std: np.ndarray | float, spacing: float
) -> np.ndarray:
    """Smallest standard deviation of the time of isolated Gaussian echoes; that of sigma is the same.

    Parameters
    ----------
    amplitude : float, count
        Peak of the echo; broadcast with sigma and noise_std.
    sigma : float, ns
        Gaussian standard deviation of the echo.
    noise_std : float, count
        Noise of one recorded sample.
    spacing : float, ns
        Time between two samples.

    Returns
    -------
    float64, ns
        Of the broadcast shape.

    Notes
    -----
    Inverse of the Fisher matrix, docs/algorithms.md 2.1. Good to 1 % for sigma >= spacing; below 0.7 spacing it depends
    on the phase of the samples.
    """
    return noise_std / np.asarray(amplitude, np.float64) * np.sqrt(2.0 * spacing * sigma / SQRT_PI)


def crlb(
    amplitude: np.ndarray, sigma: np.ndarray, noise_std: np.ndarray | float, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smallest standard deviations of time, amplitude and sigma of isolated Gaussian echoes.

    Parameters
    ----------
    amplitude, sigma, noise_std, spacing
        As for `bound_time`.

    Returns
    -------
    time, amplitude, sigma : float64, ns, count, ns
        Source: docs/algorithms.md 2.1.
    """
    time = bound_time(amplitude, sigma, noise_std, spacing)
    height = noise_std * np.sqrt(1.5 * spacing / (SQRT_PI * np.asarray(sigma, np.float64)))
    return time, np.broadcast_to(height, time.shape), time
