"""Noise of integer waveforms: level, variance, correlation and spread of baselines, pooled over thousands.

Called by the survey and by the noise stages. Before a change: variance and correlation are those of deviations from
each waveform's own quiet mean, corrected for that mean (docs/algorithms.md H10, H11).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.core.units import QUANTISATION_STD
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_quiet, quiet_mean, smooth_121

ROUNDS = 4
"""Times that level and quiet samples are found from each other."""


DRIFT = 1.0
"""Spread of the baselines, over the noise, from which each waveform's level is found from itself."""

BELOW_QUARTILE = 0.773
"""Root mean square distance from the lower quartile of what lies below it, for normal noise of unit variance."""


class PooledNoise(NamedTuple):
    """Noise of one recorded sample over many waveforms [count]."""

    level: float
    """Mean of the quiet samples."""
    std: float
    """Standard deviation of a quiet sample about its waveform's baseline, at least 0.289."""
    smoothed_std: float
    """Standard deviation after the [1 2 1]/4 filter over 0.61237: larger than std where noise is coloured."""
    spread: float
    """Standard deviation of the true baseline between waveforms."""
    share: float
    """Share of quiet samples."""
    correlation: np.ndarray = np.empty(0)
    """Correlation of quiet samples 1, 2, ... apart (k,)."""


def first_level(signal: np.ndarray) -> tuple[float, float]:
    """Most frequent value among the lower half of signal (s, n), and the spread below it: a start, echoes ignored.

    Where nothing lies below it, because counts end there, the spread up to the third quartile of all values: too large
    a start becomes smaller later.
    """
    median = np.median(signal, axis=0)
    low = signal[signal <= np.median(median) + 1]
    values, counts = np.unique(low, return_counts=True)
    level = float(values[np.argmax(counts)])
    below = low[low <= level] - level
    if not below.any():
        return level, max(float(np.quantile(signal, 0.75) - level) / 0.674, QUANTISATION_STD)
    return level, max(float(np.sqrt(np.mean(below * below))), QUANTISATION_STD)


LAGS = 12
"""Lags of the noise's correlation that are measured: beyond them a drift of the baseline takes over."""

CLIPPED = 3.5
"""Robust standard deviations at which residuals are cut off."""

LEAST_PAIRS = 2000
"""Pairs of quiet samples from which a correlation is measured."""


def estimate_noise(
    signal: np.ndarray, reach: int, limit: float = 4.0, missing: np.ndarray | None = None
) -> PooledNoise:
    """Level, variance and correlation of quiet samples, right for rounded data.

    Parameters
    ----------
    signal : float32 (s, n)
        Raw counts, one waveform per column [count].
    reach : int
        Samples next to a signal that are not quiet.
    limit : float
        A smoothed sample further from the level than this many standard deviations is signal.
    missing : bool (s, n), optional
        Samples that were not recorded.

    Returns
    -------
    PooledNoise

    Notes
    -----
    docs/algorithms.md H10 (rounding) and H11 (correlation).
    """
    if missing is not None:
        signal = np.where(missing, np.float32(np.nan), signal)
        level = np.nan_to_num(np.nanmedian(signal, axis=0))
        signal = np.where(missing, level, signal)
    if not signal.size:
        return PooledNoise(0.0, QUANTISATION_STD, QUANTISATION_STD, 0.0, 0.0)
    signal = signal.astype(np.float32)
    level, std = first_level(signal)
    spread = 0.0
    mean, number, quiet = np.zeros(signal.shape[1]), np.zeros(signal.shape[1]), np.zeros(signal.shape, bool)
    for _ in range(ROUNDS):
        width = limit * np.hypot(SMOOTH_GAIN * std, spread) + 0.25
        quiet = find_quiet(signal - np.float32(level), width, reach)
        if missing is not None:
            quiet &= ~missing
        mean, number = quiet_mean(signal - np.float32(level), quiet)
        if not number.any():
            return PooledNoise(level, std, std, 0.0, 0.0)
        level += float(np.sum(mean * number, dtype=np.float64) / np.sum(number))
        deviation = np.where(quiet, signal - np.float32(level), np.float32(0))
        std, spread = _split_variance(deviation, number)
    if spread > DRIFT * std:
        return _estimate_drifting(signal, reach, limit, missing) or PooledNoise(
            level, std, std, spread, float(quiet.mean())
        )
    correlation = correlate_quiet(signal, quiet, std)
    return PooledNoise(level, std, _smoothed_std(signal, quiet, std), spread, float(quiet.mean()), correlation)


def correlate_quiet(signal: np.ndarray, quiet: np.ndarray, std: float, lags: int = LAGS) -> np.ndarray:
    """Correlation of quiet samples at lags 1, 2, ...

    Parameters
    ----------
    signal : float32 (s, n)
        Raw counts.
    quiet : bool (s, n)
        Samples without signal.
    std : float
        Standard deviation of a quiet sample [count].
    lags : int
        Largest lag [samples].

    Returns
    -------
    float64 (k,)
        k <= lags; empty where there are too few pairs. What the mean of a waveform's few quiet samples takes away is
        added again: without this every correlation is too low by the variance of that mean.
    """
    number = quiet.sum(axis=0)
    several = number >= 4 * lags
    if not several.any():
        return np.empty(0)
    part, used = signal[:, several], quiet[:, several]
    mean = np.where(used, part, 0).sum(axis=0, dtype=np.float64) / number[several]
    deviation = np.where(used, part - mean.astype(np.float32), np.float32(0))
    found = []
    for lag in range(min(lags, len(part) - 1) + 1):
        pairs = np.count_nonzero(used[lag:] & used[: len(used) - lag]) if lag else np.count_nonzero(used)
        if pairs < LEAST_PAIRS:
            break
        head, tail = deviation[lag:], deviation[: len(deviation) - lag]
        found.append(np.einsum("sn,sn->", head, tail, dtype=np.float64) / pairs)
    if len(found) < 2:
        return np.empty(0)
    covariance = np.array(found)
    # The variance of the mean is sum(covariance at all lags) / samples; two rounds settle it.
    share = float(np.mean(1 / number[several]))
    raw = covariance.copy()
    for _ in range(3):
        covariance = raw + share * max(covariance[0] + 2 * covariance[1:].sum(), 0.0)
    return covariance[1:] / max(covariance[0], std * std)


def find_levels(
    signal: np.ndarray, std: float, reach: int, limit: float = 4.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level of each waveform of signal (s, n) from itself alone, (n,), its quiet samples (s, n) and their number (n,).

    For baselines that scatter by more than the noise: a common level with so much room would take echoes for quiet.
    Begins with the lower quartile, which echoes on up to half of the samples hardly move. std: noise of a sample.
    """
    level = np.partition(signal, len(signal) // 4, axis=0)[len(signal) // 4]
    width = np.float32(limit * SMOOTH_GAIN * std + 0.25)
    for extra in (std, 0.0, 0.0):
        quiet = find_quiet(signal - level, width + np.float32(extra), reach)
        mean, number = quiet_mean(signal - level, quiet)
        level = level + mean
    return level, quiet, number


def _estimate_drifting(
    signal: np.ndarray, reach: int, limit: float, missing: np.ndarray | None = None
) -> PooledNoise | None:
    """As `estimate_noise` for baselines that scatter by more than the noise; None without quiet samples."""
    quartile = np.partition(signal, len(signal) // 4, axis=0)[len(signal) // 4]
    below = signal[signal < quartile] - np.broadcast_to(quartile, signal.shape)[signal < quartile]
    std = max(float(np.sqrt(np.mean(below * below))) / BELOW_QUARTILE, QUANTISATION_STD) if len(below) else 1.0
    for _ in range(ROUNDS):
        levels, quiet, number = find_levels(signal, std, reach, limit)
        if missing is not None:
            quiet &= ~missing
            number = quiet.sum(axis=0, dtype=np.int32)
        several = number >= 8
        if not several.any():
            return None
        std, _ = _split_variance(np.where(quiet, signal - levels, np.float32(0)), number)
    known = levels[several].astype(np.float64)
    scatter = np.mean((known - known.mean()) ** 2) - std**2 * np.mean(1 / number[several])
    spread = float(np.sqrt(max(scatter, 0.0)))
    smoothed, correlation = _smoothed_std(signal, quiet, std), correlate_quiet(signal, quiet, std)
    return PooledNoise(float(known.mean()), std, smoothed, spread, float(quiet.mean()), correlation)


def _split_variance(deviation: np.ndarray, number: np.ndarray) -> tuple[float, float]:
    """Standard deviation within waveforms and between their means, from deviations (0 where not quiet)."""
    several = number >= 8
    if not several.any():
        total = np.sum(deviation.astype(np.float64) ** 2) / max(number.sum(), 1)
        return max(float(np.sqrt(total)), QUANTISATION_STD), 0.0
    part = deviation[:, several].astype(np.float64)
    count = number[several].astype(np.float64)
    total, squares = part.sum(axis=0), (part * part).sum(axis=0)
    within = np.sum(squares - total * total / count) / np.sum(count - 1)
    means = total / count
    between = np.average(means * means, weights=count) - within * len(count) / np.sum(count)
    return max(float(np.sqrt(max(within, 0.0))), QUANTISATION_STD), float(np.sqrt(max(between, 0.0)))


def _smoothed_std(signal: np.ndarray, quiet: np.ndarray, std: float) -> float:
    """Standard deviation of the smoothed quiet samples about their waveform's mean, as that of white noise."""
    smoothed = smooth_121(signal)[1:-1]
    inside = quiet[2:] & quiet[1:-1] & quiet[:-2]
    if not inside.any():
        return std
    mean, number = quiet_mean(smoothed, inside)
    deviation = np.where(inside, smoothed - mean, 0).astype(np.float64)
    freedom = np.maximum(number - 1, 0).sum()
    return float(np.sqrt(np.sum(deviation * deviation) / freedom) / SMOOTH_GAIN) if freedom else std


def residual_noise(residual: np.ndarray, used: np.ndarray, lags: int = LAGS) -> tuple[float, np.ndarray] | None:
    """Standard deviation and correlation of what fits leave outside of their echoes.

    Parameters
    ----------
    residual : float32 (n, s)
        Waveforms less baseline and echoes [count].
    used : bool (n, s)
        Samples that count.
    lags : int
        Largest lag [samples].

    Returns
    -------
    (std, correlation (k,)) or None
        None where fewer than LEAST_PAIRS samples count.

    Notes
    -----
    Values are limited to CLIPPED robust standard deviations, so that weak echoes nobody fitted do not count as noise.
    No mean of a waveform is taken off: what its baseline is wrong by is noise to its amplitudes.
    """
    values = residual[used]
    if len(values) < LEAST_PAIRS:
        return None
    low, middle, high = np.quantile(values, [0.1587, 0.5, 0.8413])
    limit = CLIPPED * max(0.5 * (high - low), QUANTISATION_STD)
    deviation = np.where(used, np.clip(residual - np.float32(middle), -limit, limit), np.float32(0))
    variance = np.sum(deviation * deviation, dtype=np.float64) / len(values)
    found = []
    for lag in range(1, min(lags, residual.shape[1] - 1) + 1):
        pairs = np.count_nonzero(used[:, lag:] & used[:, :-lag])
        if pairs < LEAST_PAIRS:
            break
        found.append(np.einsum("ns,ns->", deviation[:, lag:], deviation[:, :-lag], dtype=np.float64) / pairs)
    return float(np.sqrt(variance)), np.array(found) / max(variance, 1e-12)


def colour_factors(
    correlation: tuple[float, ...] | np.ndarray, pulse: np.ndarray, by_time: np.ndarray, by_width: np.ndarray
) -> tuple[float, float, float, float]:
    """Errors of a fitted pulse in coloured noise over those in white noise of the same variance.

    Parameters
    ----------
    correlation : (k,)
        Of the noise at lags 1, 2, ... [samples].
    pulse, by_time, by_width : (s,)
        The pulse and its derivatives at every sample.

    Returns
    -------
    (alone, amplitude, time, width)
        Each 1 for white noise. The first is that of the amplitude of a pulse of known time and width: the factor by
        which noise seems larger to a matched filter. The others are those of a fit of all three.

    Notes
    -----
    A least-squares fit with white weights has the covariance (J'J)^-1 J'RJ (J'J)^-1; J holds the derivatives of the
    pulse, R the correlation matrix (docs/algorithms.md H11).
    """
    rho = np.asarray(correlation, np.float64)
    if not len(rho):
        return 1.0, 1.0, 1.0, 1.0
    joint = np.stack([pulse, by_time, by_width], axis=1).astype(np.float64)
    weights = np.linalg.solve(joint.T @ joint, joint.T)
    lag = np.abs(np.subtract.outer(np.arange(len(joint)), np.arange(len(joint))))
    matrix = np.r_[1.0, rho, 0.0][np.minimum(lag, len(rho) + 1)]
    rows = (joint[:, 0], *weights)
    least = 0.05
    return tuple(float(np.sqrt(max((row @ matrix @ row) / (row @ row), least))) for row in rows)
