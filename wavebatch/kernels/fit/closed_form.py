"""Closed-form Gaussians: weighted parabolas through the logarithms of the samples around peaks (Guo 2011); and bounds.

Used by detectors for start values and by the fast stages as the fit. Cheap, but wrong for echoes that overlap.
`bound_time` and `crlb` are the smallest errors that any unbiased decomposer can reach with isolated Gaussian echoes:
tools, survey and score expect them. They hold for a known baseline and white noise; overlapping echoes have larger ones
(docs/algorithms.md 2.1, 2.2).
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.units import SQRT_PI
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.signal.signal import sum_samples


def fit_closed_form(y: np.ndarray, fraction: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gaussians through the samples around peaks, without iterations.

    Parameters
    ----------
    y : float (m, 2 r + 1), count
        Signal with the peak in the middle; 0 where there is no sample.
    fraction : float
        Used are the contiguous samples around the peak that are at least this share of it.

    Returns
    -------
    amplitude : float64 (m,), count
    time : float64 (m,), samples
        After the middle sample.
    width : float64 (m,), samples
    holds : bool (m,)
        False where the parabola opens upwards or its peak lies two samples or more away; the values are void there.

    Notes
    -----
    ln y = c0 + c1 x + c2 x^2 with weights y^2; s = sqrt(-1 / (2 c2)), t = -c1 / (2 c2), A = exp(c0 - c1^2 / (4 c2)).

    References
    ----------
    Guo (2011), IEEE Signal Processing Magazine 28(5); docs/algorithms.md 4.1.
    """
    middle = y.shape[1] // 2
    y = y.astype(np.float64)
    high = y >= np.maximum(fraction * y[:, middle : middle + 1], 1e-9)
    used = np.empty_like(high)
    np.logical_and.accumulate(high[:, middle:], axis=1, out=used[:, middle:])
    used[:, : middle + 1] = np.logical_and.accumulate(high[:, middle::-1], axis=1)[:, ::-1]
    safe = np.where(used, y, 1.0)
    weight = np.where(used, y * y, 0.0)
    x = np.arange(-middle, y.shape[1] - middle, dtype=np.float64)
    c0, c1, c2 = fit_parabola(weight, x, log(safe), axis=1)
    holds = c2 < 0
    c2 = np.where(holds, c2, -1.0)
    time = -c1 / (2 * c2)
    holds &= np.abs(time) < 2
    amplitude = exp(np.clip(c0 - c1 * c1 / (4 * c2), -50, 50))
    return amplitude, time, np.sqrt(-1 / (2 * c2)), holds


def estimate_starts(
    smoothed: np.ndarray, waveform: np.ndarray, sample: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start values of peaks: a log-parabola through five smoothed samples, weighted by the signal.

    Parameters
    ----------
    smoothed : float32 (s, n), count
        Signal filtered with [1 2 1]/4; the width of the filter is taken off the result.
    waveform, sample : int64 (m,)
        Place of each peak.
    width : float, samples
        Width where the parabola fails; the time is the sample itself there.

    Returns
    -------
    amplitude, time, width : float64 (m,), count, samples, samples
    """
    s, n = smoothed.shape
    flat = smoothed.reshape(-1)
    offsets = np.arange(-2, 3)
    at = np.clip(sample[None] + offsets[:, None], 0, s - 1)
    y = flat[at * n + waveform].astype(np.float64)
    peak = y[2]
    floor = 0.05 * peak
    used = np.maximum(y, floor[None])
    weight = np.where((at == sample[None] + offsets[:, None]) & (y > floor), used * used, 0.0)
    logarithm = log(np.maximum(used, 1e-12))
    x = offsets[:, None].astype(np.float64)
    c0, c1, c2 = fit_parabola(weight, x, logarithm, axis=0)
    good = (c2 < -1e-4) & np.isfinite(c1)
    safe = np.where(good, c2, -1.0)
    shift = -c1 / (2 * safe)
    good &= np.abs(shift) < 1.5
    variance = -1 / (2 * safe)
    time = sample + np.where(good, shift, 0.0)
    narrow = np.sqrt(np.maximum(variance - 0.5, 0.1))
    amplitude = np.where(good, exp(np.clip(c0 - c1 * c1 / (4 * safe), -20, 20)), peak)
    amplitude *= np.where(good, np.sqrt(1 + 0.5 / narrow**2), 1.1)
    return amplitude, time, np.where(good, narrow, width)


def start_errors(amplitude: np.ndarray, width: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of amplitude and width that `estimate_starts` finds for isolated Gaussian echoes.

    Parameters
    ----------
    amplitude, width : float (m,), count, samples
        Of the echoes.
    std : float (m,), count
        Noise of one unfiltered sample.

    Returns
    -------
    amplitude_err, width_err : float64 (m,), count, samples

    Notes
    -----
    To first order in the noise, for peaks that lie on a sample. Broad echoes, where five samples cover only the top,
    have errors many times the Cramer-Rao bound.
    """
    spread = width * width + 0.5
    x = np.arange(-2, 3, dtype=spread.dtype)[:, None]
    shape = exp(-0.5 * x * x / spread)
    s0, s2, s4 = (sum_samples(shape * shape * x**p) for p in (0, 2, 4))
    determinant = s0 * s4 - s2 * s2
    # Of the parabola c0 + c2 x^2: width sqrt(-1 / (2 c2) - 1/2), amplitude exp(c0) sqrt(1 + 1 / (2 width^2)).
    by_width = spread * spread / (width * determinant) * shape * (s0 * x * x - s2)
    by_height = shape * (s4 - s2 * x * x) / determinant - 0.5 / (width * spread) * by_width
    noise = std / amplitude * np.sqrt(spread) / width
    gains = []
    for taps in (by_height, by_width):  # gain of white noise through the [1 2 1]/4 filter and then these taps
        wide = np.pad(taps, ((2, 2), (0, 0)))
        joined = (wide[:-2] + 2.0 * wide[1:-1] + wide[2:]) * 0.25
        gains.append(np.sqrt(sum_samples(joined * joined)))
    return amplitude * noise * gains[0], noise * gains[1]


def fit_parabola(weight: np.ndarray, x: np.ndarray, y: np.ndarray, axis: int) -> tuple[np.ndarray, ...]:
    """Coefficients c0, c1, c2 of weighted parabolas y = c0 + c1 x + c2 x^2, by Cramer's rule.

    Sums and not matrix products, because the sums of a matrix product depend on the number of rows.

    Parameters
    ----------
    weight, x, y : float64, of shapes that broadcast
        Weights, abscissae and values.
    axis : int
        Axis along which a parabola runs.

    Returns
    -------
    tuple of float64 arrays
        c0, c1 and c2; 0 where the system is singular.
    """
    s = [np.sum(weight * x**p, axis=axis) for p in range(5)]
    product = weight * y
    b = [np.sum(product * x**p, axis=axis) for p in range(3)]
    m0 = s[2] * s[4] - s[3] * s[3]
    m1 = s[1] * s[4] - s[2] * s[3]
    m2 = s[1] * s[3] - s[2] * s[2]
    determinant = s[0] * m0 - s[1] * m1 + s[2] * m2
    inverse = 1 / np.where(np.abs(determinant) > 1e-12, determinant, np.inf)
    c0 = (b[0] * m0 - b[1] * m1 + b[2] * m2) * inverse
    n1 = s[0] * s[4] - s[2] * s[2]
    n2 = s[0] * s[3] - s[1] * s[2]
    c1 = (-b[0] * m1 + b[1] * n1 - b[2] * n2) * inverse
    c2 = (b[0] * m2 - b[1] * n2 + b[2] * (s[0] * s[2] - s[1] * s[1])) * inverse
    return c0, c1, c2


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
