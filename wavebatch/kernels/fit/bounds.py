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


def bound_amplitude(
    sigma: np.ndarray, noise_std: np.ndarray | float, spacing: float, *, width_known: bool = False
) -> np.ndarray:
    """Least standard deviation of the amplitude of isolated Gaussian echoes [count].

    It does not depend on the amplitude; with `width_known` sigma is not estimated (0.7511 instead of 0.9199).
    """
    free = 2.0 if width_known else 3.0
    scale = np.sqrt((1.0 if width_known else free / 2.0) * spacing / (SQRT_PI * np.asarray(sigma, np.float64)))
    return noise_std * scale


def crlb(
    amplitude: np.ndarray, sigma: np.ndarray, noise_std: np.ndarray | float, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least standard deviations of time [ns], amplitude [count] and sigma [ns] of isolated Gaussian echoes."""
    time = bound_time(amplitude, sigma, noise_std, spacing)
    return time, np.broadcast_to(bound_amplitude(sigma, noise_std, spacing), time.shape), time


def bound_energy(amplitude: np.ndarray, sigma: np.ndarray, noise_std: np.ndarray | float, spacing: float) -> np.ndarray:
    """Least relative standard deviation of the energy (integral) of isolated Gaussian echoes."""
    return bound_amplitude(sigma, noise_std, spacing) / np.asarray(amplitude, np.float64)


def crlb_joint(
    time: np.ndarray,
    amplitude: np.ndarray,
    sigma: np.ndarray,
    noise_std: np.ndarray | float,
    spacing: float,
    n_samples: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least standard deviations of time, amplitude and sigma, each (k, n), of k Gaussian echoes in each of n waveforms.

    All 3 k parameters of a waveform are unknown together: the bound of overlapping and truncated echoes.
    time [ns after sample 0], amplitude [count], sigma [ns]: (k, n); noise_std scalar or (n,).
    Parameters that the samples cannot tell at all (a singular Fisher matrix) get infinity.
    """
    k, n = time.shape
    x = np.arange(n_samples)[:, None, None] * spacing
    z = (x - time) / sigma
    pulse = np.exp(-0.5 * z * z)
    slope = amplitude / sigma * pulse * z
    jacobian = np.concatenate([slope, pulse, slope * z], axis=1)
    scale = np.sqrt((jacobian**2).sum(axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    jacobian /= scale
    fisher = np.einsum("ipn,iqn->npq", jacobian, jacobian)
    # Scaled columns: the diagonal is 1, so that eigenvalues say how well parameters can be told apart.
    values, vectors = np.linalg.eigh(fisher)
    values = np.where(values > 1e-13, values, np.nan)
    variance = (vectors**2 / values[:, None, :]).sum(axis=2).T
    std = np.sqrt(np.where(np.isnan(variance), np.inf, variance)) / scale * noise_std
    return std[:k], std[k : 2 * k], std[2 * k :]
