"""Noise of integer waveforms: level, variance, correlation and spread of baselines, pooled over thousands.

Called by the survey and by the noise stages. Before a change: variance and correlation are those of deviations from
each waveform's own quiet mean, corrected for that mean (docs/algorithms.md H10, H11).

Noise that a digitizer cuts off at count 0: `undo_floor` gives its level, size and correlation before the cut. Nothing
there may move a strip whose level is some noise above 0.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from math import pi, sqrt

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import known_median, median, quantile
from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR, QUANTISATION_STD
from wavebatch.kernels.elementary import exp, log, solve
from wavebatch.kernels.library import CQuiet, call
from wavebatch.kernels.signal.signal import (
    SMOOTH_GAIN,
    STRONG,
    accumulate,
    find_quiet,
    quiet_mean,
    smooth_121,
    sum_samples,
    widen,
)

ROUNDS, SETTLED = 6, 0.01
"""Times, at most, that quiet samples and their noise are found from each other, after the first look at the edges; and
the change of the noise, as a share of it, below which it stays. Where weak echoes follow the last signal the first
limits are too high for them."""

LEVEL_ROUNDS = 2
"""Of these, the ones that only need levels where the noise is known: levels of the first have tails of echoes in them,
since the quiet edges that it begins from are wrong by some noise."""

DRIFT = 1.0
"""Spread of the baselines, over the noise, from which each waveform's level is found from itself."""

EDGE = 6
"""First and last samples of a waveform that may be quiet: the least from which a level and a scatter can be seen."""

ALIKE = 5.0
"""Variance of an edge, over the mean of the quieter ones, from which it holds signal: of six correlated samples of
noise one in a hundred has more."""

QUIET_EDGES = 0.25
"""Share of the edges that noise begins from: at least these are taken to be quiet."""

LOPSIDED = 1.5
"""Sum of squares of smoothed quiet samples above their median, over that of those below it, from which weak echoes are
among them: of noise it is 1, of the receivers of real strips 0.55 to 1.31. Echoes of 3 to 8 standard deviations make
the noise 15 % too large where it is 1.4, and four times where it is 6."""

TIGHTER, LEAST_LIMIT = 0.8, 2.6
"""Factor by which the limit of signal then falls, and the limit up to which it does: at 2.56 a few per cent of noise
are cut off."""

SEEN = 7
"""Reach of a pulse [samples] up to which single smoothed samples show every echo of five standard deviations of energy,
the least that is fitted. Echoes of wider pulses stand out in means only: those of canopies that single samples do not
show made noise 1.7 times as large."""

BY_CHANCE = 0.1
"""Share of the waveforms, at most, in which noise alone makes a mean over a wide pulse that is taken for an echo."""

MUCH_CUT = 1.05
"""Noise before a digitizer cut it off at 0, over what is left of it, from which quiet samples are found once more."""

BEFORE_SIGNAL = 3
"""Part of the reach that is left out before a signal: a pulse rises faster than its tail falls."""

LAGS, MOST_LAGS, RISE = (12, 20), 48, 4
"""Lags of the noise's covariance that are measured, for narrow and for wide pulses: each adds its error to the noise of
a pulse. Up to MOST_LAGS follow while the variogram is higher at each of the last RISE lags than at those before."""

LEAST_PAIRS = 2000
"""Pairs of quiet samples from which the shape of their correlation is measured."""

LEAST_QUIET_PAIRS = 100
"""Pairs of quiet neighbours from which a covariance is measured: their variance is then known to a seventh."""

CHANCE = 3.0
"""Standard errors up to which a covariance is none: those of many lags add up in the noise of a wide pulse."""

MOST_SLOW, BENDS = 0.92, (1.0, 1.5, 2.0)
"""Most correlation of neighbours in noise of one pole that is followed beyond the lags that are seen: its length, 12
samples, is also the most of others. And the powers of its shapes: one pole, a receiver's bell, and between them."""

HIGH, SKEWED = 2.0, 1.15
"""Standard deviations above the level from which quiet samples may be an echo, and how much larger than by samples
below the level the variance of noise may be: it may be skewed."""

DITHER = np.array([0.75487767, 0.56984029], np.float32)
"""Steps along samples and waveforms, modulo 1, that fill the unit interval evenly: powers of the plastic number."""

ROUNDED, ENOUGH = 0.5, 500
"""Noise [DN] below which rounding makes it lopsided, and quiet samples from which it is known not to be."""

LEAST_SHARE = 0.25
"""Pairs at a lag, over those of neighbours, from which it counts: the few longest runs are not like the others."""


class PooledNoise(NamedTuple):
    """Noise of one recorded sample over many waveforms [DN]."""

    level: float
    """Mean of the quiet samples."""
    std: float
    """Standard deviation of a quiet sample about its waveform's baseline, at least 0.289."""
    spread: float
    """Standard deviation of the true baseline between waveforms."""
    share: float
    """Share of quiet samples; 0 where too few are quiet for the noise to be known."""
    correlation: np.ndarray = np.empty(0)
    """Correlation of quiet samples 1, 2, ... apart (k,)."""
    recovery: int = 0
    """Samples after a strong signal until the level is back to what it was before it."""


def estimate_noise(
    signal: np.ndarray, reach: int, limit: float = 4.0, missing: np.ndarray | None = None, recovery: int = 0,
    begin: np.ndarray | None = None,
) -> PooledNoise:  # fmt: skip
    """Level, variance and correlation of the samples before the first and after the last signal of each waveform.

    Parameters
    ----------
    signal : float32 (s, n)
        Raw counts, one waveform per column [DN].
    reach : int
        Samples next to a signal that are not quiet.
    limit : float
        A smoothed sample further from the level than this many standard deviations is signal.
    missing : bool (s, n), optional
        Samples that were not recorded; a waveform without any other does not count.
    recovery : int, samples
        Until the level is back after strong signal, where it is known; else it is measured.
    begin : float64 (k,), optional
        Covariance of quiet samples 0, 1, 2, ... apart, as fewer waveforms show it: LEVEL_ROUNDS only need levels.

    Returns
    -------
    PooledNoise

    Notes
    -----
    The noise begins from the quieter edge of each waveform: those that scatter like the quietest of them. No level of
    the strip and no threshold is needed for it, so that a canopy is not taken for noise. Between echoes nothing is
    quiet. The covariance is the sill of the variogram, half the mean square difference of samples 1, 2, ... apart,
    less its value at each lag: a baseline's error, which spoils variances of few correlated samples, is in neither
    (docs/algorithms.md H10, H11).
    """
    if missing is not None:
        recorded = ~missing.all(axis=0)
        if not recorded.all():  # a short waveform may be all transient; zeros in its place would count as quiet
            signal, missing = (np.compress(recorded, values, axis=1) for values in (signal, missing))
    if not signal.size:
        return PooledNoise(0.0, QUANTISATION_STD, 0.0, 0.0)
    if missing is not None:
        signal = np.where(missing, np.float32(np.nan), signal)
        signal = np.where(missing, known_median(signal, 0), signal)
    signal = signal.astype(np.float32)
    known = _estimate_from(signal, reach, limit, missing, recovery, begin=begin) if recovery else None
    if known is not None and known.share > 0:
        return known
    found = _estimate_from(signal, reach, limit, missing, 0, begin=begin)
    recovery = measure_recovery(signal, found, reach, limit, missing) if found.share else 0
    if not recovery:
        return found
    again = _estimate_from(signal, reach, limit, missing, recovery, begin=begin)
    return again if again.share > 0 else found


def _estimate_from(
    signal: np.ndarray, reach: int, limit: float, missing: np.ndarray | None, recovery: int, room: float = 1.0,
    begin: np.ndarray | None = None,
) -> PooledNoise:  # fmt: skip
    """The noise of quiet samples, found from each other from the quiet edges on.

    room: standard deviations by which the first level, that of few samples, may be wrong; 0 with a limit that comes
    from such noise.
    """
    level, std = quiet_edges(signal, missing)
    covariance = np.array([std**2]) if begin is None else begin
    number, least = np.zeros(len(level), np.int32), signal == signal.min()
    for turn in range(ROUNDS):
        last = _smoothed_std(covariance)
        width = limit * (last + (0.0 if turn else room * std)) + 0.25
        above = signal - level
        quiet = find_ends(above, width, reach, recovery)
        if missing is not None:
            quiet &= ~missing
        if turn and reach > SEEN:
            # Means of `reach` samples above their level, which see most of a pulse, over the noise of mean and level.
            s = len(above)
            size = np.arange(1, max(s, reach) + 1)
            chance = np.maximum(_mean_variance(covariance, len(size)), QUANTISATION_STD**2 / size)
            total = accumulate(np.add, np.nan_to_num(above).astype(np.float64))
            end = np.minimum(np.arange(s) + reach - reach // 2, s)
            start = end - np.minimum(reach, end)
            summed = total[end - 1] - np.where((start > 0)[:, None], total[start - 1], 0.0)
            spread = chance[end - start - 1][:, None] + chance[np.maximum(number, 1) - 1]
            means = (summed / (end - start)[:, None] / np.sqrt(spread)).astype(np.float32)
            means = np.where(np.isnan(above), above, means)
            # Only echoes make more of them so high than so low: noise is as often below its level, however slow it is.
            bound = np.float32(np.sqrt(2 * log(max(s / reach, 1.0) / BY_CHANCE)))  # Chernoff's
            high, low = (int(np.count_nonzero((quiet & (side > bound)).any(axis=0))) for side in (means, -means))
            if high - low > CHANCE * np.sqrt(high + low):
                calm = quiet & find_ends(means, float(bound), reach // 2, 0)
                quiet = calm if np.count_nonzero(calm[1:] & calm[:-1]) >= LEAST_PAIRS else quiet
        if np.isnan(level).any():
            above = signal - np.nan_to_num(level)
        mean, number = quiet_mean(above, quiet)
        if begin is not None and turn < LEVEL_ROUNDS:
            level = np.where(number > 0, np.nan_to_num(level) + mean, np.float32(np.nan))
            continue
        # Waveforms whose quiet samples scatter like those of most others: the foot of an echo may be below a limit.
        deviation = above - mean
        power = np.einsum("sn,sn->n", deviation * quiet, deviation) / np.maximum(number, 1)
        enough = number >= EDGE
        typical = float(median(power[enough])) if enough.any() else 0.0
        used = quiet & (~enough | (power <= ALIKE * max(typical, QUANTISATION_STD**2)))
        lags = int(np.clip(2 * reach, *LAGS))
        measured = measure_covariance(signal, used, lags)
        # Noise that is rounded off or cut off is not as often above its level as below it; too few samples hide it.
        many = np.count_nonzero(used)
        cut = many < ENOUGH or np.count_nonzero(used & least) > MOST_LEAST * many
        if measured is not None and not cut and measured[0] >= ROUNDED**2:
            # The level of most, or where these scatter by more than the noise its own.
            centre = np.nan_to_num(level) + mean
            _, spread = _spread_of_levels(centre[number > 0].astype(np.float64), number[number > 0], measured)
            own = centre if spread**2 > measured[0] else np.full_like(centre, median(centre[number > 0]))
            measured = _leave_signal_out(signal, own, used, measured, lags, last if turn else _smoothed_std(measured))
        if measured is None:
            known = level[np.isfinite(level)].astype(np.float64)
            middle = float(np.mean(known)) if len(known) else float(median(signal))
            return PooledNoise(middle, max(std, QUANTISATION_STD), 0.0, 0.0, recovery=recovery)
        covariance = measured
        level = np.where(number > 0, np.nan_to_num(level) + mean, np.float32(np.nan))
        if turn and abs(_smoothed_std(covariance) - last) < SETTLED * last:
            break
    again = None  # with a tighter limit: weak echoes only add to noise
    if limit > LEAST_LIMIT and _lopsided(signal, level, quiet) > LOPSIDED:
        again = _estimate_from(signal, reach, TIGHTER * limit, missing, recovery, room=0.0)
    known = number > 0
    middle, spread = _spread_of_levels(level[known].astype(np.float64), number[known], covariance)
    std = max(float(np.sqrt(covariance[0])), QUANTISATION_STD)
    correlation = covariance[1:] / std**2
    if spread <= DRIFT * std:
        seen = std
        middle, std, spread, correlation = undo_floor(signal[quiet], middle, std, spread, correlation)
        if room and std > MUCH_CUT * seen:  # a limit of what is left of the noise cuts off its top too
            wider = limit * float(np.sqrt(std / seen))  # half way: weak echoes must not come in
            return _estimate_from(signal, reach, wider, missing, recovery, room=0.0)
    found = PooledNoise(middle, std, spread, float(quiet.mean()), correlation, recovery)
    return again if again is not None and again.share and again.std < std else found


def _lopsided(signal: np.ndarray, level: np.ndarray, quiet: np.ndarray) -> float:
    """Sum of squares of smoothed quiet samples above their median over that of those below it.

    1 also where it is not known: counts that hardly leave one value, or are cut off at the least one.
    """
    inner = quiet[1:-1] & quiet[:-2] & quiet[2:]
    values = smooth_121(np.where(quiet, signal - np.nan_to_num(level), np.float32(0)))[1:-1][inner]
    if len(values) < LEAST_PAIRS or np.std(values) < QUANTISATION_STD:
        return 1.0
    if np.count_nonzero(inner & (signal[1:-1] == signal.min())) > MOST_LEAST * len(values):
        return 1.0
    # Counts are whole: where noise stays on two of them their median is one, and either side would be an echo's.
    dither = np.arange(len(values)) * DITHER[0]
    dither -= np.floor(dither)  # % takes eight times as long
    values = values - median(values + dither.astype(np.float32)) + np.float32(0.5)
    above, below = (float(np.sum(np.square(side, dtype=np.float64))) for side in (values.clip(0), values.clip(max=0)))
    return above / max(below, 1e-12)


def quiet_edges(signal: np.ndarray, missing: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Level of each waveform at its lower edge, and the scatter of such edges, to begin with.

    Parameters
    ----------
    signal : float32 (s, n), count
        Waveforms.
    missing : bool (s, n), optional
        Samples that were not recorded.

    Returns
    -------
    level : float32 (n,), count
        NaN where no edge is quiet.
    std : float, count
        Of the samples of quiet edges about their mean.
    """
    s, n = signal.shape
    size = min(EDGE, s)
    first = np.zeros(n, np.int64) if missing is None else np.argmax(~missing, axis=0)
    last = np.full(n, s) if missing is None else s - np.argmax(~missing[::-1], axis=0)
    edges = []
    for begin in (np.minimum(first, s - size), np.maximum(last - size, 0)):
        part = signal[begin + np.arange(size)[:, None], np.arange(n)]
        mean = sum_samples(part) / np.float32(size)
        deviation = part - mean
        edges.append((mean, sum_samples(deviation * deviation) / np.float32(max(size - 1, 1))))
    lower = edges[1][0] < edges[0][0]
    level, power = (np.where(lower, edges[1][i], edges[0][i]) for i in (0, 1))
    least = QUANTISATION_STD**2
    common: float = max(quantile(power, QUIET_EDGES), least)
    for _ in range(8):
        quiet = power <= ALIKE * common
        last, common = common, max(float(np.mean(power[quiet], dtype=np.float64)), least)
        if common == last:
            break
    return np.where(quiet, level, np.float32(np.nan)), float(np.sqrt(common))


def find_ends(above: np.ndarray, width: float, reach: int, recovery: int = 0) -> np.ndarray:
    """Samples before the first and after the last signal of each waveform.

    Parameters
    ----------
    above : float32 (s, n), count
        Waveforms above their level; all NaN where that is not known: nothing is quiet then.
    width : float, count
        A smoothed sample beyond +-width is signal.
    reach : int, samples
        Samples after a signal that are not quiet; a third as many before it.
    recovery : int, samples
        The same after strong signal.

    Returns
    -------
    bool (s, n)
    """
    s = len(above)
    smoothed = np.abs(smooth_121(above))
    busy = ~(smoothed <= np.float32(width))
    place = np.arange(s, dtype=np.int32)[:, None]
    first, end = s - (busy * (s - place)).max(axis=0), (busy * (place + 1)).max(axis=0)
    quiet = (place < first - -(-reach // BEFORE_SIGNAL)) | (place >= end + reach) | (end == 0)
    if recovery > reach:
        strong = smoothed > np.float32(STRONG * width)
        end = (strong * (place + 1)).max(axis=0)
        quiet &= (place < first) | (place >= end + recovery) | (end == 0)
    return quiet


def _leave_signal_out(
    signal: np.ndarray, level: np.ndarray, quiet: np.ndarray, plain: np.ndarray, lags: int, std: float
) -> np.ndarray:
    """The covariance without echoes that are too weak to be seen as signal: they only add to noise.

    Noise is as often so far above the level as below it. So what is near a high place does not count, and what is
    near a low one counts twice. Skewed noise looks the same, so only what is more than it by SKEWED is taken off.

    level: of each waveform (n,); plain: the covariance of all quiet samples; std: of the noise after the [1 2 1]/4
    filter.
    """
    s, n = signal.shape
    above = np.where(quiet, signal - level, np.float32(0))
    smoothed = smooth_121(above)
    smoothed += _dither(s, n)
    limit, reach, number = np.float32(HIGH * std), -(-lags // 6), quiet.sum(axis=0)
    calm = ~(quiet & (np.abs(smoothed) > limit)).any(axis=0) & (number > 0)
    if calm.any():
        smoothed -= np.float32(median((sum_samples(above) / np.maximum(number, 1))[calm]))
    beyond = widen(quiet & (smoothed > limit), reach), widen(quiet & (-smoothed > limit), reach)
    mirrored = measure_covariance(signal, quiet, lags, beyond)
    if mirrored is None:
        return plain
    # Variances of noise to a pulse a sixth as wide as the lags, over that of white noise, or that of a sample.
    variances = []
    for covariance in (mirrored, plain):
        k = np.arange(1, len(covariance))
        weight = exp(-0.25 * (k * 6 / lags) ** 2)  # not by BLAS, whose last bits depend on the processor
        variances.append(float(covariance[0] + max(2 * np.einsum("k,k->", covariance[1:], weight), 0.0)))
    least, most = variances
    if most <= SKEWED * least:
        return plain
    share, size = (SKEWED - 1) * least / (most - least), max(len(plain), len(mirrored))
    longer = [np.pad(one, (0, size - len(one))) for one in (plain, mirrored)]
    return share * longer[0] + (1 - share) * longer[1]


@lru_cache(maxsize=1)
def _dither(s: int, n: int) -> np.ndarray:
    """A dither (s, n) of smoothed counts, multiples of 1/4: without it one of two limits is nearer than the other."""
    down, across = (np.arange(size) * float(step) % 1 for step, size in zip(DITHER, (s, n), strict=True))
    dither = down[:, None].astype(np.float32) + across.astype(np.float32)
    dither -= dither >= 1
    return np.float32(0.25) * (dither - np.float32(0.5))


def measure_covariance(
    signal: np.ndarray,
    quiet: np.ndarray,
    lags: int = LAGS[0],
    mirrored: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray | None:
    """Covariance of quiet samples 0, 1, 2, ... apart, from their differences.

    Parameters
    ----------
    signal : float32 (s, n), count
        Waveforms.
    quiet : bool (s, n)
        Samples without signal.
    lags : int, samples
        Largest lag; where noise is slow, and waveforms are not few, MOST_LAGS.
    mirrored : pair of bool (s, n), optional
        Pairs with a sample of the first mask do not count, those with one of the second count twice in their place;
        pairs with both count as far as the first ones are noise.

    Returns
    -------
    float64 (k,) or None
        k <= 1 + MOST_LAGS. None where fewer than LEAST_QUIET_PAIRS neighbours are quiet.
    """
    alone = np.ascontiguousarray(np.where(quiet, np.asarray(signal, np.float32), np.float32(np.nan)))
    marks = None if mirrored is None else np.ascontiguousarray(mirrored[0] + np.uint8(2) * mirrored[1])
    half: list[float] = []
    pairs: list[float] = []
    # In fewer waveforms than `measure_recovery` needs a tail of echoes looks like slow noise.
    most = MOST_LAGS if signal.shape[1] >= 2 * LEAST_WAVEFORMS else lags
    last = min(most, len(signal) - 1)
    found = _pair_differences(alone, marks, 1, min(lags, last))
    for lag in range(1, last + 1):
        # Slow noise: a variogram is higher at each of its last lags than at those before.
        if lag > lags and not (min(half[-RISE:]) > max(half[-2 * RISE : -RISE])):
            break
        if lag > len(found):  # many at a time: a call takes as long as a lag
            found += _pair_differences(alone, marks, lag, min(lag + RISE - 1, last))
        number, square = found[lag - 1]
        if number < (LEAST_SHARE * pairs[0] if pairs else LEAST_QUIET_PAIRS):
            break
        half.append(0.5 * square / number)
        pairs.append(number)
    if not half:
        return None
    # Noise of one sensor has forgotten itself by then; where runs are short their longest lags must do.
    far = len(half) // 2
    sill = float(np.average(half[far:], weights=pairs[far:]))
    rest = sill - np.array(half)
    chance = CHANCE * sill / np.sqrt(pairs)
    # Runs that reach each lag: differences of one run are no more than one.
    runs = np.maximum(-np.diff([*pairs, found[len(half)][0] if len(found) > len(half) else 0.0]), 1.0)
    rises = half[-1] - half[max(far - 1, 0)] > CHANCE * half[-1] * np.sqrt(2 / runs[-1])
    if rises and len(half) >= RISE and pairs[-1] >= LEAST_PAIRS and min(half) > 0:  # 0: there is no noise at all
        variance = float(np.var(signal[quiet], dtype=np.float64))
        slow = _extend(np.array(half), runs, max(lags, len(half)), variance)
        if slow[0] > (1 + SETTLED) * sill:
            return slow
    return np.r_[sill, np.where(np.abs(rest) > chance, rest, 0.0)]


def _pair_differences(quiet: np.ndarray, marks: np.ndarray | None, lag: int, last: int) -> list[list[float]]:
    """Pairs of samples `lag` to `last` apart and the sum of their squared differences, for each of these lags.

    quiet: float32 (s, n), the quiet samples; NaN for others. marks: uint8 (s, n), 1 and 2 by the masks of `mirrored`.
    """
    found = np.zeros((max(last - lag + 1, 0), 4, 2))
    given = ctypes.c_void_p(None) if marks is None else marks
    call("pair_differences", *map(ctypes.c_int64, quiet.shape), quiet, given, *map(ctypes.c_int64, (lag, last)), found)
    every, high, low, both = found.transpose(1, 0, 2)
    if marks is not None:
        noise = np.minimum((low[:, :1] - both[:, :1]) / np.maximum(high[:, :1] - both[:, :1], 1.0), 1.0)
        every = every + low - high - (1 - noise) * both
    return every.tolist()


def _extend(half: np.ndarray, runs: np.ndarray, lags: int, most: float) -> np.ndarray:
    """Covariance (1 + lags,) of noise whose variogram rises as far as it is seen: runs of quiet samples are too short.

    Of shapes exp(-(k/l)^p) each counts as likely as it is; what levels of waveforms differ by may be such noise, so
    that the sill is at most the variance of all quiet samples.

    Parameters
    ----------
    half : float64 (k,)
        Variogram at lags 1, 2, ... [count^2].
    runs : float64 (k,)
        Of quiet samples, by which each is known.
    lags : int
        k at least.
    most : float
        That variance [count^2].
    """
    place = -log(np.linspace(1e-9, MOST_SLOW, 50))[:, None] * np.arange(1.0, lags + 1)
    power = exp(-np.concatenate([exp(by * log(place)) for by in BENDS]))
    shape, slow, weight = 1 - power[:, : len(half)], half - QUANTISATION_STD**2, runs / (2 * half**2)
    size = np.einsum("fk,k->f", shape, slow * weight) / np.einsum("fk,fk,k->f", shape, shape, weight)
    rest = slow - size[:, None] * shape
    off = np.einsum("fk,fk,k->f", rest, rest, weight)
    likely = exp(-0.5 * (off - off.min()))
    likely /= likely.sum()
    sill = float(np.einsum("f,f->", likely, np.minimum(size + QUANTISATION_STD**2, most)))
    tail = np.einsum("f,fk->k", likely, power[:, len(half) - 1 :])
    left = max(sill - float(half[-1]), 0.0)
    return np.r_[sill, sill - half, left * tail[1:] / max(float(tail[0]), 1e-12)]


def _smoothed_std(covariance: np.ndarray) -> float:
    """Standard deviation of noise after the [1 2 1]/4 filter."""
    own, next_, second = (float(covariance[k]) if k < len(covariance) else 0.0 for k in range(3))
    return float(np.sqrt(max(6 * own + 8 * next_ + 2 * second, 6 * QUANTISATION_STD**2))) / 4


def _mean_variance(covariance: np.ndarray, most: int) -> np.ndarray:
    """Variance of the mean of 1, 2, ... `most` samples of noise (most,)."""
    many = np.arange(1, most + 1, dtype=np.float64)
    chance = np.full(most, covariance[0])
    for lag, value in enumerate(covariance[1:], 1):
        chance += 2 * value * np.maximum(1 - lag / many, 0.0)
    return np.maximum(chance, 0.0) / many


def _spread_of_levels(level: np.ndarray, number: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Mean and true spread of the levels of waveforms, each the mean of `number` samples of noise."""
    chance = _mean_variance(covariance, int(number.max()))
    middle = float(np.sum(level * number) / np.sum(number))
    scatter = float(np.average((level - middle) ** 2 - chance[number - 1], weights=number))
    return middle, float(np.sqrt(max(scatter, 0.0)))


RECOVERED = 0.1
"""Difference of a baseline from the level before the signal that does not matter [DN, or noise of a sample]."""

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
    A tail of a hundredth of an echo lies below any limit of single samples, but the median of thousands of waveforms
    shows it; those with the stronger half of the echoes decide. Weak echoes after the last strong one are in some of
    the waveforms only. Fewer samples make a noisier baseline: a slight tail of many samples is the lesser evil.
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
    rows = rows[peak >= median(peak)]
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
    middle = median(difference, axis=1)
    bias = np.abs(middle)
    spread = MAD_TO_STD * median(np.abs(difference - middle[:, None]), axis=1)
    error = MEDIAN_ERROR * spread / np.sqrt(len(rows))
    # Without those samples a baseline is that of a few before the signal, or the strip's: no worse than its spread.
    alone = min(noise.spread, noise.std / np.sqrt(median(number[rows])))
    least = np.clip(alone, RECOVERED, 2 * RECOVERED) * max(noise.std, 1.0)
    right = bias <= np.maximum(least, 4 * error)
    return int(np.argmax(np.r_[right, True])) * step


class OwnLevels(NamedTuple):
    """Levels of n waveforms from themselves alone."""

    level: np.ndarray
    """float32 (n,), count."""
    quiet: np.ndarray
    """Quiet samples, bool (s, n)."""
    number: np.ndarray
    """How many of these count, int64 (n,)."""
    lowest: np.ndarray
    """Value that a tenth of the samples lie below, float32 (n,), count."""


def find_levels(
    signal: np.ndarray,
    std: float,
    reach: int,
    limit: float = 4.0,
    recovery: int = 0,
    counted: np.ndarray | None = None,
) -> OwnLevels:
    """Level of each waveform of signal (s, n) from itself alone.

    For baselines that scatter by more than the noise: a common level with so much room would take echoes for quiet.
    Begins with the lower quartile, which echoes on up to half of the samples hardly move. std: noise of a sample.
    recovery: as for `find_quiet`, where it leaves enough samples. counted: the first samples of each that `number`
    counts, int64 (n,); all by default.
    """
    signal, (s, n) = np.ascontiguousarray(signal.T, np.float32), signal.shape
    width = np.float32(limit * SMOOTH_GAIN * std + 0.25)
    counted = np.ascontiguousarray(np.full(n, s) if counted is None else np.minimum(counted, s), np.int64)
    ordered = np.sort(signal, axis=1)
    level, lowest = (ordered[:, s // part].copy() if s else np.zeros(n, np.float32) for part in (4, 10))
    quiet, number = np.empty((n, s), np.bool_), np.zeros(n, np.int64)
    rules = CQuiet(width, std, width * np.float32(STRONG), reach, recovery, LEAST_BEFORE)
    if signal.size:
        call("find_levels", *map(ctypes.c_int64, (n, s)), signal, rules, counted, level, quiet, number)
    return OwnLevels(level, quiet.T, number, lowest)


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
    # One count of all: packets may hold thousands of recordings.
    n, most = missing.shape[1], int(number.max(initial=1))
    sizes = np.bincount((number * n + np.arange(n))[recorded], minlength=(most + 1) * n).reshape(most + 1, n)
    return number != np.argmax(sizes[1:], axis=0) + 1


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
    weights = solve(np.einsum("sp,sq->pq", joint, joint), joint.T)
    rows = np.stack([joint[:, 0], *weights])
    gain = coloured_variance(rows, correlation) / np.einsum("rs,rs->r", rows, rows)
    return tuple(np.sqrt(np.maximum(gain, LEAST_FACTOR)).tolist())


def coloured_variance(rows: np.ndarray, correlation: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Variance of sums of samples in coloured noise, over the variance of one sample.

    Parameters
    ----------
    rows : float64 (r, s)
        Weights of the samples.
    correlation : (k,)
        Of the noise at lags 1, 2, ... [samples]; beyond them 0.

    Returns
    -------
    float64 (r,)
    """
    weights, rho = np.ascontiguousarray(rows, np.float64), np.ascontiguousarray(correlation, np.float64)
    found = np.empty(len(weights))
    call("coloured_variance", *map(ctypes.c_int64, weights.shape), weights, ctypes.c_int64(len(rho)), rho, found)
    return found


def fit_factors(
    joint: np.ndarray, by_amplitude: float, by_time: float, taps: np.ndarray | None, correlation: tuple[float, ...]
) -> np.ndarray:
    """What coloured noise, and a wrong level, do to a fit of amplitude, time and width of one echo.

    Parameters
    ----------
    joint : float64 (3, s)
        A pulse of amplitude 1, and its derivatives by time and by width times the width.
    by_amplitude, by_time : float
        Change of the whole pulse's amplitude and time by the width, in these units.
    taps : float64 (3,), optional
        What a fit that whitens the noise takes of a sample and of those 1 and 2 before it.
    correlation : (k,)
        Of the noise at lags 1, 2, ... [samples].

    Returns
    -------
    float64 (8,)
        Variances of amplitude, time, width and energy over those that the fit gives; then what a level that is 1 too
        high adds to each, over its standard deviation by the fit.
    """
    joint, rho = (np.ascontiguousarray(array, np.float64) for array in (joint, correlation))
    if joint.shape[:1] != (3,) or (taps is not None and len(taps) != 3):
        raise ValueError(f"a pulse of shape {joint.shape} does not have two derivatives, or taps are not three")
    given = ctypes.c_void_p(None) if taps is None else np.ascontiguousarray(taps)
    by_width, found = map(ctypes.c_double, (by_amplitude, by_time)), np.empty((2, 4))
    call("fit_factors", ctypes.c_int64(joint.shape[1]), joint, *by_width, given, ctypes.c_int64(len(rho)), rho, *found)
    return found.reshape(-1)


def predict_noise(correlation: tuple[float, ...] | np.ndarray) -> tuple[float, float] | None:
    """Find what predicts the noise of a sample from the two before it.

    Parameters
    ----------
    correlation : (k,)
        Of the noise at lags 1, 2, ... [samples].

    Returns
    -------
    (float, float) or None
        Shares of the sample before, and of the one before that; None where no noise has such a correlation.

    References
    ----------
    The equations of Yule and Walker for an autoregression of order 2; docs/algorithms.md H11.
    """
    one, two = (float(value) for value in (*correlation, 0.0, 0.0)[:2])
    if not (abs(one) < MOST_PREDICTED and 2 * one * one - 1 < MOST_PREDICTED * two < MOST_PREDICTED**2):
        return None
    return one * (1 - two) / (1 - one * one), (two - one * one) / (1 - one * one)


MOST_PREDICTED = 0.999
"""Correlation of noise from which on it is as good as constant: nothing is left that is new in a sample."""


def whitening_filter(whitening: tuple[float, ...], gain: float = 1.0) -> np.ndarray:
    """Return the filter that makes coloured noise white.

    Parameters
    ----------
    whitening : (float, float)
        As `predict_noise` returns it.
    gain : float
        Standard deviation of the white noise over that of a coloured sample.

    Returns
    -------
    float64 (3, 3)
        Row q: coefficients of a sample and of those 1 and 2 before it, for one with q others before it. They are rows
        of the inverse Cholesky factor of the noise's correlation.
    """
    near, far = whitening
    one = near / (1 - far)
    left = 1 - one * one
    rows = np.array([[1.0, 0.0, 0.0], [1.0, -one, 0.0], [1.0, -near, -far]])
    return gain * rows / np.sqrt([1.0, left, left * (1 - far * far)])[:, None]


MOST_LEAST = 0.05
"""Share of the quiet samples with the least count of all from which noise is cut off there."""

MOST_CUT = 0.9
"""Share of the noise below the first count up to which the rest shows what is cut off."""

NORMAL = 1.5
"""Ratio, at most, of the scatter of counts to that of normal noise which is cut off: counts of 0 may be fill."""


def floor_share(level: float, std: float) -> float:
    """Share of normal noise that a digitizer records as 0."""
    z, below, _ = normal_law()
    return float(np.interp((0.5 - level) / max(std, QUANTISATION_STD), z, below))


def floor_response(level: float, std: float) -> tuple[float, float, float]:
    """What is left of normal noise that is cut off at 0.

    Parameters
    ----------
    level, std : float, count
        Mean and standard deviation before the cut.

    Returns
    -------
    offset : float, count
        Of the mean, above the level.
    response : float
        Change of the mean per count of the level.
    std : float, count
        Standard deviation after the cut.
    """
    cut = -level / std
    z, *tables = normal_law()
    below, density = (float(np.interp(cut, z, values)) for values in tables)
    mean = density + cut * below
    variance = 1 - below + cut * density + cut**2 * below - mean**2
    return std * mean, 1 - below, std * sqrt(max(variance, 0.0))


def undo_floor(
    values: np.ndarray, level: float, std: float, spread: float, correlation: np.ndarray
) -> tuple[float, float, float, np.ndarray]:
    """Noise before the digitizer cut it off at 0; the same where hardly any samples are 0, or nearly all.

    Parameters
    ----------
    values : float32 (k,), count
        Quiet samples.
    level, std, spread : float, count
        Their mean, their noise, and the spread of the levels of their waveforms.
    correlation : (l,)
        Of samples 1, 2, ... apart.

    Returns
    -------
    level, std, spread, correlation
        Of normal noise with two shares of these samples: those of count 0, and those up to the count that halves the
        rest. Weak echoes change shares less than they change a mean.
    """
    found = level, std, spread, correlation
    share = float(np.mean(values <= 0))
    if not MOST_LEAST < share <= MOST_CUT:
        return found
    step = float(values[values > 0].min())
    upper = float(np.quantile(values, 0.5 + 0.5 * share, method="inverted_cdf"))
    shares = share, min(float(np.mean(values <= upper)), 1 - 0.5 / len(values))
    z, below, _ = normal_law()
    low, high = np.interp(shares, below, z)
    whole = float(upper / (high - low))
    level = 0.5 * step - float(low) * whole
    _, response, seen = floor_response(level, whole)
    if not 1 / NORMAL < float(np.std(values)) / np.hypot(seen, QUANTISATION_STD * step) < NORMAL:
        return found
    spread /= response
    std = sqrt(max(whole**2 - spread**2 + QUANTISATION_STD**2, std**2))
    # What is left of a correlation rho is w rho + (1 - w) rho^2, within 0.03, of the first terms of Price's series.
    part = (response * whole / seen) ** 2
    root = np.sqrt(np.maximum(part**2 + 4 * (1 - part) * correlation, 0))
    return level, std, spread, 2 * correlation / (part + root)


@lru_cache
def normal_law() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard deviations from -8 to 8, the share of normal noise below them, and its density there."""
    z = np.linspace(-8.0, 8.0, 3201)
    density = exp(-0.5 * z * z) / sqrt(2 * pi)
    return z, (np.cumsum(density) - 0.5 * density) / np.sum(density), density
