"""Filters of the detectors, along the samples of arrays (s, n), and the noise that they let through.

Used by stages/detect. A filter is given by half of its taps: the centre first.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.elementary import exp, log


def gaussian_taps(width: float, reach: float = 3.0) -> np.ndarray:
    """Half of a Gaussian filter of height 1: taps 0, 1, ... up to `reach` widths [samples], float64."""
    return exp(-0.5 * (np.arange(int(np.ceil(reach * width)) + 1) / width) ** 2)


def curvature_taps(width: float, reach: float = 4.0) -> np.ndarray:
    """Half of the negative second derivative of a Gaussian, made to sum to zero: taps 0, 1, ... [samples], float64."""
    x = np.arange(int(np.ceil(reach * width)) + 1) / width
    taps = (1 - x * x) * exp(-0.5 * x * x)
    total = taps[0] + 2 * taps[1:].sum()
    bell = exp(-0.5 * x * x)
    return taps - bell * total / (bell[0] + 2 * bell[1:].sum())


def slope_taps(width: float, reach: float = 4.0) -> np.ndarray:
    """Half of an antisymmetric filter, the derivative of a Gaussian: taps 0, 1, ... [samples], float64.

    The first one is 0. It gives the slope per sample of a straight line.
    """
    x = np.arange(int(np.ceil(reach * width)) + 1)
    taps = x * exp(-0.5 * (x / width) ** 2)
    return taps / (2 * np.sum(taps * x))


def filter_energy(taps: np.ndarray) -> float:
    """Sum of the squares of a symmetric filter given by its half: the gain of the variance of white noise."""
    return float(taps[0] ** 2 + 2 * np.sum(taps[1:] ** 2))


def filter_autocorrelation(taps: np.ndarray) -> np.ndarray:
    """Correlation (2 k - 1,) at lags 0, 1, ... of white noise behind a symmetric filter given by its half (k,)."""
    whole = np.concatenate([taps[:0:-1], taps])
    products = np.correlate(whole, whole, "full")[len(whole) - 1 :]
    return products / products[0]


def filter_symmetric(signal: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Signal correlated with a symmetric filter.

    Parameters
    ----------
    signal : float32 (s, n)
        Waveforms; zero outside.
    taps : float (k,)
        Half of the filter.

    Returns
    -------
    float32 (s, n)
    """
    s = len(signal)
    total = np.float32(taps[0]) * signal
    for i, tap in enumerate(taps[1:s], start=1):
        part = np.float32(tap) * signal
        total[i:] += part[:-i]
        total[:-i] += part[i:]
    return total


def filter_antisymmetric(signal: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Signal correlated with an antisymmetric filter.

    Parameters
    ----------
    signal : float32 (s, n)
        Waveforms; zero outside.
    taps : float (k,)
        Taps 0, 1, ... towards later samples; earlier samples have the negative ones.

    Returns
    -------
    float32 (s, n)
    """
    s = len(signal)
    total = np.zeros_like(signal)
    for i, tap in enumerate(taps[1:s], start=1):
        part = np.float32(tap) * signal
        total[:-i] += part[i:]
        total[i:] -= part[:-i]
    return total


def refine_peaks(filtered: np.ndarray, waveform: np.ndarray, sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and height of peaks between samples, by a parabola through the logarithms of three samples.

    Parameters
    ----------
    filtered : float (s, n)
        Filtered waveforms.
    waveform, sample : int64 (m,)
        Place of each peak.

    Returns
    -------
    time, height : float64 (m,), samples and units of `filtered`
        The sample itself where a neighbour is not positive, and at the first and the last sample.
    """
    s, n = filtered.shape
    flat = filtered.reshape(-1)
    left, middle, right = (flat[np.clip(sample + d, 0, s - 1) * n + waveform].astype(np.float64) for d in (-1, 0, 1))
    good = (sample > 0) & (sample < s - 1) & (left > 0) & (right > 0)
    a, b, c = (log(np.where(good, y, 1.0)) for y in (left, middle, right))
    curve = a - 2 * b + c
    good &= curve < -1e-12
    shift = np.where(good, 0.5 * (a - c) / np.where(good, curve, -1.0), 0.0)
    shift = np.clip(shift, -0.5, 0.5)
    height = np.where(good, exp(b - 0.25 * (a - c) * shift), middle)
    return sample + shift, height
