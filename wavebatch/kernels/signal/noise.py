"""Noise of integer waveforms: level, variance, correlation and spread of baselines, pooled over thousands.

Called by the survey and by the noise stages. Before a change: variance and correlation are those of deviations from
each waveform's own quiet mean, corrected for that mean (docs/algorithms.md H10, H11).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.core.units import QUANTISATION_STD
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, STRONG, accumulate, find_quiet, quiet_mean, smooth_121

ROUNDS, SETTLED = 4, 0.001
"""Times, at most, that level and quiet samples are found from each other; change in noise that ends it."""


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
    recovery: int = 0
    """Samples after a strong signal until the level is back to what it was before it."""


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
        Samples that were not recorded; a waveform without any other does not count.

    Returns
    -------
    PooledNoise

    Notes
    -----
    docs/algorithms.md H10 (rounding) and H11 (correlation).
    """
    if missing is not None:
        recorded = ~missing.all(axis=0)
        if not recorded.all():  # a short waveform may be all transient; zeros in its place would count as quiet
            signal, missing = (np.compress(recorded, values, axis=1) for values in (signal, missing))
    if not signal.size:
        return PooledNoise(0.0, QUANTISATION_STD, QUANTISATION_STD, 0.0, 0.0)
    if missing is not None:
        signal = np.where(missing, np.float32(np.nan), signal)
        signal = np.where(missing, np.nanmedian(signal, axis=0), signal)
    signal = signal.astype(np.float32)
    first, std = first_level(signal)
    found = _estimate_from(signal, first, std, 0.0, reach, limit, missing, 0)
    recovery = measure_recovery(signal, found, reach, limit, missing)
    if not recovery:
        return found
    again = _estimate_from(signal, found.level, found.std, found.spread, reach, limit, missing, recovery)
    return again if again.share > 0 else found


def _estimate_from(
    signal: np.ndarray,
    level: float,
    std: float,
    spread: float,
    reach: int,
    limit: float,
    missing: np.ndarray | None,
    recovery: int,
) -> PooledNoise:
    """The noise of quiet samples, found from each other from a first level, noise and spread of baselines on."""
    for _ in range(ROUNDS):
        width = limit * np.hypot(SMOOTH_GAIN * std, spread) + 0.25
        deviation = signal - np.float32(level)
        quiet = find_quiet(deviation, width, reach, recovery)
        if missing is not None:
            quiet &= ~missing
        mean, number = quiet_mean(deviation, quiet)
        if not number.any():
            return PooledNoise(level, std, std, 0.0, 0.0, recovery=recovery)
        last = level, std, spread
        level += float(np.sum(mean * number, dtype=np.float64) / np.sum(number))
        np.subtract(signal, np.float32(level), out=deviation)
        deviation *= quiet
        std, spread = _split_variance(deviation, quiet, number, reach)
        if max(abs(new - old) for new, old in zip((level, std, spread), last, strict=True)) < SETTLED * std:
            break
    if spread > DRIFT * std:
        drifting = _estimate_drifting(signal, reach, limit, missing, recovery)
        return drifting or PooledNoise(level, std, std, spread, float(quiet.mean()), recovery=recovery)
    correlation = correlate_quiet(signal, quiet, std)
    # About means of few samples both are too small.
    smoothed = _smoothed_std(signal, quiet, std) * std / _within_waveforms(deviation, number)
    return PooledNoise(level, std, smoothed, spread, float(quiet.mean()), correlation, recovery)


RECOVERED = 0.1
"""Difference of a baseline from the level before the signal that does not matter [count, or noise of a sample]."""

LEAST_BEFORE = 4
"""Quiet samples before its first signal from which a waveform shows the level without a tail ..."""

LEAST_WAVEFORMS = 50
"""... and waveforms that must show it."""


def measure_recovery(
    signal: np.ndarray, noise: PooledNoise, reach: int, limit: float, missing: np.ndarray | None = None
) -> int:
    """Samples after strong signal that would draw the baseline away from the level before the first signal.

    Parameters
    ----------
    signal : float32 (s, n), count
        Waveforms.
    noise : PooledNoise
        Their noise, with such samples in it.
    reach : int, samples
        As for `estimate_noise`; differences are taken in steps of it.
    limit : float
        As for `estimate_noise`.
    missing : bool (s, n), optional
        Samples that were not recorded.

    Returns
    -------
    int
        0 where baselines agree with the samples before the signal to RECOVERED, or to chance, or where too few
        waveforms begin without signal.

    Notes
    -----
    A tail of a hundredth of an echo lies below any limit of single samples, but the mean over thousands of waveforms
    shows it; those with the stronger half of the echoes decide. Weak echoes after the first one have the same effect,
    and the same remedy. Fewer samples make a noisier baseline: a slight tail of many samples is the lesser evil.
    """
    s = len(signal)
    above = signal - np.float32(noise.level)
    if noise.spread > DRIFT * noise.std:
        above = signal - find_levels(signal, noise.std, reach, limit)[0]
    width = limit * np.hypot(SMOOTH_GAIN * noise.std, min(noise.spread, noise.std)) + 0.25
    quiet = find_quiet(above, width, reach)
    early = accumulate(np.logical_and, quiet)
    if missing is not None:
        quiet &= ~missing
        early &= ~missing
    before, number = quiet_mean(above, early)
    strong = np.abs(smooth_121(above)) > STRONG * width
    rows = np.flatnonzero((number >= LEAST_BEFORE) & strong.any(axis=0))
    if len(rows) < 2 * LEAST_WAVEFORMS:
        return 0
    peak = above[:, rows].max(axis=0)
    rows = rows[peak >= np.median(peak)]
    strong, quiet, above = strong[:, rows], quiet[:, rows], above[:, rows] - before[rows]
    place = np.arange(s, dtype=np.int32)[:, None]
    last = accumulate(np.maximum, (place + np.int32(1)) * strong) - np.int32(1)
    step = max(reach, 1)
    bins = (place - last) // step
    bins[(last < 0) | ~quiet] = -1
    most = s // step + 1
    # One value per waveform and bin: the error of the bin is then that of the waveforms' scatter, whatever its colour.
    flat = np.where(bins >= 0, bins * len(rows) + np.arange(len(rows)), most * len(rows))
    size = (most + 1) * len(rows)
    count = np.bincount(flat.ravel(), minlength=size)[: most * len(rows)].reshape(most, -1)
    total = np.bincount(flat.ravel(), above.ravel(), minlength=size)[: most * len(rows)].reshape(most, -1)
    # Baselines from the samples before the signal and those at least 0, 1, 2 ... steps after it, less the former alone.
    kept = np.cumsum(count[::-1], axis=0)[::-1]
    difference = np.cumsum(total[::-1], axis=0)[::-1] / (kept + number[rows])
    bias = np.abs(difference.mean(axis=1))
    error = difference.std(axis=1) / np.sqrt(len(rows))
    # Without those samples a baseline is that of a few before the signal, or the strip's: no worse than its spread.
    alone = min(noise.spread, noise.std / np.sqrt(np.median(number[rows])))
    least = np.clip(alone, RECOVERED, 2 * RECOVERED) * max(noise.std, 1.0)
    right = bias <= np.maximum(least, 4 * error)
    return int(np.argmax(np.r_[right, True])) * step


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
    mean = (part * used).sum(axis=0, dtype=np.float64) / number[several]
    deviation = (part - mean.astype(np.float32)) * used
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
    signal: np.ndarray, std: float, reach: int, limit: float = 4.0, recovery: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level of each waveform of signal (s, n) from itself alone, (n,), its quiet samples (s, n) and their number (n,).

    For baselines that scatter by more than the noise: a common level with so much room would take echoes for quiet.
    Begins with the lower quartile, which echoes on up to half of the samples hardly move. std: noise of a sample.
    recovery: as for `find_quiet`, where it leaves enough samples.
    """
    level = np.partition(signal, len(signal) // 4, axis=0)[len(signal) // 4]
    width = np.float32(limit * SMOOTH_GAIN * std + 0.25)
    for extra in (std, 0.0, 0.0):
        quiet = find_quiet(signal - level, width + np.float32(extra), reach)
        mean, number = quiet_mean(signal - level, quiet)
        level = level + mean
    if recovery > reach:
        clear = find_quiet(signal - level, width, reach, recovery)
        mean, clear_number = quiet_mean(signal - level, clear)
        enough = clear_number >= LEAST_BEFORE
        level = level + np.where(enough, mean, np.float32(0))
        quiet, number = np.where(enough, clear, quiet), np.where(enough, clear_number, number)
    return level, quiet, number


def _estimate_drifting(
    signal: np.ndarray, reach: int, limit: float, missing: np.ndarray | None = None, recovery: int = 0
) -> PooledNoise | None:
    """As `estimate_noise` for baselines that scatter by more than the noise; None without quiet samples."""
    quartile = np.partition(signal, len(signal) // 4, axis=0)[len(signal) // 4]
    below = signal[signal < quartile] - np.broadcast_to(quartile, signal.shape)[signal < quartile]
    std = max(float(np.sqrt(np.mean(below * below))) / BELOW_QUARTILE, QUANTISATION_STD) if len(below) else 1.0
    for _ in range(ROUNDS):
        levels, quiet, number = find_levels(signal, std, reach, limit, recovery)
        if missing is not None:
            quiet &= ~missing
            number = quiet.sum(axis=0, dtype=np.int32)
        several = number >= 8
        if not several.any():
            return None
        std = _within_waveforms((signal - levels) * quiet, number)
    known = levels[several].astype(np.float64)
    scatter = np.mean((known - known.mean()) ** 2) - std**2 * np.mean(1 / number[several])
    spread = float(np.sqrt(max(scatter, 0.0)))
    smoothed, correlation = _smoothed_std(signal, quiet, std), correlate_quiet(signal, quiet, std)
    return PooledNoise(float(known.mean()), std, smoothed, spread, float(quiet.mean()), correlation, recovery)


def _split_variance(deviation: np.ndarray, quiet: np.ndarray, number: np.ndarray, apart: int) -> tuple[float, float]:
    """Standard deviation within waveforms and between their levels, from deviations (0 where not quiet).

    What two samples more than `apart` from each other have in common is their waveform's level: neighbours also share
    coloured noise, and so do the means of few samples.
    """
    several = np.flatnonzero(number > 1)
    part, used = deviation, quiet
    if len(several) < len(number):
        part, used = np.take(deviation, several, axis=1), np.take(quiet, several, axis=1)
    gap = min(apart + 1, len(part))
    used = used.astype(np.float32)
    earlier, partners = (accumulate(np.add, values[: len(values) - gap]) for values in (part, used))
    products = np.einsum("sn,sn->n", part[gap:], earlier)
    pairs = np.einsum("sn,sn->n", used[gap:], partners)
    if np.count_nonzero(pairs) < LEAST_WAVEFORMS:
        return _within_waveforms(deviation, number), _between_waveforms(deviation, number)
    weight = 1 / number[several]
    between = max(float(products @ weight / (pairs @ weight)), 0.0)
    total = float(np.sum(part * part, dtype=np.float64) / np.sum(number[several]))
    return max(float(np.sqrt(max(total - between, 0.0))), QUANTISATION_STD), float(np.sqrt(between))


def _within_waveforms(deviation: np.ndarray, number: np.ndarray) -> float:
    """Standard deviation of quiet samples about the mean of their waveform; about 0 where all have too few."""
    several = number >= 8
    if not several.any():
        total = np.sum(deviation.astype(np.float64) ** 2) / max(number.sum(), 1)
        return max(float(np.sqrt(total)), QUANTISATION_STD)
    part, count = deviation[:, several].astype(np.float64), number[several].astype(np.float64)
    total, squares = part.sum(axis=0), (part * part).sum(axis=0)
    within = np.sum(squares - total * total / count) / np.sum(count - 1)
    return max(float(np.sqrt(max(within, 0.0))), QUANTISATION_STD)


def _between_waveforms(deviation: np.ndarray, number: np.ndarray) -> float:
    """Standard deviation of the levels of waveforms with at least 8 quiet samples, from their means."""
    several = number >= 8
    if not several.any():
        return 0.0
    count = number[several].astype(np.float64)
    means = deviation[:, several].sum(axis=0, dtype=np.float64) / count
    within = _within_waveforms(deviation, number) ** 2
    between = np.average(means * means, weights=count) - within * len(count) / np.sum(count)
    return float(np.sqrt(max(between, 0.0)))


def _smoothed_std(signal: np.ndarray, quiet: np.ndarray, std: float) -> float:
    """Standard deviation of the smoothed quiet samples about their waveform's mean, as that of white noise."""
    smoothed = smooth_121(signal)[1:-1]
    inside = quiet[2:] & quiet[1:-1] & quiet[:-2]
    if not inside.any():
        return std
    mean, number = quiet_mean(smoothed, inside)
    deviation = (smoothed - mean) * inside
    freedom = np.maximum(number - 1, 0).sum()
    return float(np.sqrt(np.sum(deviation * deviation, dtype=np.float64) / freedom) / SMOOTH_GAIN) if freedom else std


def keep_longest(missing: np.ndarray) -> np.ndarray:
    """Mark all recordings of a packet but its longest as missing: others may have a level of their own.

    Parameters
    ----------
    missing : bool (s, n)
        Samples that were not recorded.

    Returns
    -------
    bool (s, n)
    """
    recorded = ~missing
    begins = recorded.copy()
    begins[1:] &= missing[:-1]
    number = accumulate(np.add, begins.astype(np.int32)) * recorded
    sizes = np.stack([np.count_nonzero(number == k, axis=0) for k in range(1, int(number.max(initial=1)) + 1)])
    return number != np.argmax(sizes, axis=0) + 1


def residual_noise(
    residual: np.ndarray, used: np.ndarray, lost: np.ndarray, lags: int = LAGS
) -> tuple[float, np.ndarray] | None:
    """Standard deviation and correlation of what fits leave outside of their echoes.

    Parameters
    ----------
    residual : float32 (n, s)
        Waveforms less baseline and echoes [count].
    used : bool (n, s)
        Samples that count.
    lost : float (k,)
        Covariance at lags 0, 1, ... that the choice of these waveforms has taken away [count^2]; 0 beyond.
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
    # Quantiles of whole counts may give half of the spread, so that it is found in two steps.
    wide = 2 * CLIPPED * max(0.5 * (high - low), QUANTISATION_STD)
    spread = np.sqrt(np.mean(np.clip(values - np.float32(middle), -wide, wide) ** 2, dtype=np.float64))
    limit = CLIPPED * max(float(spread), QUANTISATION_STD)
    deviation = np.where(used, np.clip(residual - np.float32(middle), -limit, limit), np.float32(0))
    # The median of whole counts is one of them; taken for the mean it would make all samples seem correlated.
    deviation -= used * np.float32(np.sum(deviation, dtype=np.float64) / len(values))
    variance = np.sum(deviation * deviation, dtype=np.float64) / len(values)
    found = []
    for lag in range(1, min(lags, residual.shape[1] - 1) + 1):
        pairs = np.count_nonzero(used[:, lag:] & used[:, :-lag])
        if pairs < LEAST_PAIRS:
            break
        found.append(np.einsum("ns,ns->", deviation[:, lag:], deviation[:, :-lag], dtype=np.float64) / pairs)
    covariance = np.array([variance, *found])
    common = min(len(covariance), len(lost))
    covariance[:common] += lost[:common]
    return float(np.sqrt(covariance[0])), covariance[1:] / max(covariance[0], 1e-12)


LEAST_FACTOR = 0.05
"""Least variance in coloured noise, over that in white noise: an estimated correlation may be none that can be."""


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
    if not len(correlation):
        return 1.0, 1.0, 1.0, 1.0
    joint = np.stack([pulse, by_time, by_width], axis=1).astype(np.float64)
    weights = np.linalg.solve(joint.T @ joint, joint.T)
    matrix = correlation_matrix(correlation, len(joint))
    rows = (joint[:, 0], *weights)
    return tuple(float(np.sqrt(max((row @ matrix @ row) / (row @ row), LEAST_FACTOR))) for row in rows)


def correlation_matrix(correlation: tuple[float, ...] | np.ndarray, size: int) -> np.ndarray:
    """Correlation of noise between any two of `size` samples.

    Parameters
    ----------
    correlation : (k,)
        At lags 1, 2, ... [samples]; beyond them 0.
    size : int

    Returns
    -------
    float64 (size, size)
    """
    rho = np.asarray(correlation, np.float64)
    lag = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    return np.r_[1.0, rho, 0.0][np.minimum(lag, len(rho) + 1)]
