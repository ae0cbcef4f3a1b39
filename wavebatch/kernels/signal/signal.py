"""Smoothing, local maxima and quiet samples of thousands of waveforms.

Used by nearly every stage and by the survey. Arrays are (s, n), waveforms along the last, contiguous axis: this layout
is what makes NumPy fast here.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.order import distinct
from wavebatch.kernels.signal.runs import find_stretches

SMOOTH_GAIN = np.sqrt(6.0) / 4.0
"""Standard deviation of white noise after one pass of the [1 2 1]/4 filter (0.61237)."""


LEAST_PADDING, LEAST_RECORDED, LEAST_LEVEL = 8, 16, 3
"""Zeros at the end of a waveform are padding if there are at least LEAST_PADDING of them, after at least LEAST_RECORDED
samples that are all at least LEAST_LEVEL.
"""

RARE_ZEROS = 0.1
"""Share of zeros among recorded samples up to which LEAST_PADDING zeros in a row are fill, not noise of a low level."""

STEP_FROM_ZERO, STEP_FROM_TOP = 3 / 4, 15 / 16
"""Share of the way from fill to the level of the next recording that the first recorded sample must go. From the
largest count it is more: a clipped echo of 8 samples falls by up to three quarters from one sample to the next.
"""


def recorded_lengths(samples: np.ndarray) -> np.ndarray:
    """Length of each waveform without the zeros that fill its packet.

    Trailing zeros are padding only where no real sample is near zero.

    Parameters
    ----------
    samples : uint (n, s), count
        Raw counts.

    Returns
    -------
    int64 (n,), samples
    """
    n, s = samples.shape
    length = np.full(n, s, np.int64)
    if s < LEAST_RECORDED + LEAST_PADDING:
        return length
    rows = np.flatnonzero(samples[:, -1] == 0)
    rows = rows[(samples[rows, -LEAST_PADDING:] == 0).all(axis=1)]
    if len(rows):
        real = s - np.argmax(samples[rows, ::-1] != 0, axis=1)
        low = (samples[rows] < LEAST_LEVEL) & (np.arange(s) < real[:, None])
        padded = (real < s) & (real >= LEAST_RECORDED) & ~low.any(axis=1)
        length[rows[padded]] = real[padded]
    return length


def find_fill(samples: np.ndarray, *tops: int) -> np.ndarray | None:
    """Samples that only fill a packet, between two recordings or before the first.

    Fill is a run of at least LEAST_PADDING zeros or largest counts to which the waveform steps within one sample:
    echoes, also clipped ones, and waveforms that are cut off at a threshold come near it on their flanks. Zeros are
    fill only where no recorded sample of the waveform is near zero. On both sides of a run at least LEAST_RECORDED
    samples are recorded, or the waveform ends.

    Parameters
    ----------
    samples : uint (n, s), count
        Raw counts.
    *tops : int, count
        Largest counts: of the digitizer, of the bytes of a sample.

    Returns
    -------
    bool (n, s) or None
        None where nothing is fill.
    """
    n, s = samples.shape
    if s < LEAST_RECORDED + LEAST_PADDING or not n:
        return None
    least, largest = samples.min(), samples.max()
    fill = None
    for value in {0, *tops}:
        if least > 0 if value == 0 else largest < value:
            continue
        # Rows that may hold a long run of the count: all that do, and few others. Every long run holds every eighth
        # sample of the block at least once, and the four before or after it.
        flat = samples.reshape(-1)
        first, half = LEAST_PADDING - 1, LEAST_PADDING // 2
        seen = flat[first::LEAST_PADDING]
        at = np.flatnonzero(seen == value) * LEAST_PADDING + first
        after = np.minimum(at + half, len(flat) - 1)
        at = at[(flat[at - half] == value) | (flat[after] == value)]
        rows = distinct(at // s)
        found = _find_fill_rows(samples[rows], value) if len(rows) else None
        if found is not None and found.any():
            fill = np.zeros(samples.shape, bool) if fill is None else fill
            fill[rows] |= found
    return fill


def _find_fill_rows(samples: np.ndarray, value: int) -> np.ndarray:
    """Runs of one count in samples (n, s) that are fill, bool (n, s)."""
    n, s = samples.shape
    row, start, end = find_stretches(samples == value)
    long = end - start >= LEAST_PADDING
    row, start, end = row[long], start[long], end[long]
    marks = _mark_runs(row, start, end, n, s)
    # The recorded samples next to both ends of each run, where it does not end with the waveform.
    beside, first = np.concatenate((row, row)), np.concatenate((start - 1, end))
    at = first[:, None] + np.repeat([-1, 1], len(row))[:, None] * np.arange(LEAST_RECORDED)
    place = beside[:, None], np.clip(at, 0, s - 1)
    known, outside = ((at >= 0) & (at < s) & ~marks[place]).all(axis=1), (first < 0) | (first >= s)
    near = samples[place].astype(np.float64)
    ordered = np.sort(near, axis=1)
    near, level, middle = near[:, 0], ordered[:, 2], ordered[:, LEAST_RECORDED // 2]
    if value:
        # From the largest count the waveform falls to its level within one sample.
        steps = known & (value - near >= STEP_FROM_TOP * (value - level)) & (near <= 0.5 * value)
    else:
        # From zeros it rises to its level, or to an echo, within one sample. At half of the edges of a waveform at
        # least there is no echo; the level there counts at the others. The flank of a clipped echo that goes down lies
        # far below a level that hardly varies.
        least = np.maximum(STEP_FROM_ZERO * level, level - 4 * (middle - level) - 1)
        sure = known & ~outside & (near >= least)
        common = np.full(n, np.inf)
        np.minimum.at(common, beside[sure], level[sure])
        enough = 2 * np.bincount(beside[sure], minlength=n) >= np.bincount(beside[~outside], minlength=n)
        steps = (sure | (known & (near >= STEP_FROM_ZERO * common[beside]))) & enough[beside]
    good = outside | steps
    good = (good[: len(row)] & good[len(row) :]) & ((start > 0) | (end < s))
    if value == 0:
        low = ((samples < LEAST_LEVEL) & ~marks).any(axis=1)
        doubtful = low.copy()
        doubtful[row[~good]] = True
        # Zeros are none of a level near zero where the level before them is low and steady, so that no echo falls, and
        # zeros are rare elsewhere in the waveform.
        inner = (start >= LEAST_RECORDED) & ((end <= s - LEAST_RECORDED) | (end == s))
        before = samples[row[:, None], np.maximum(start[:, None] - 1 - np.arange(LEAST_RECORDED), 0)].astype(np.int64)
        ordered = np.sort(before, axis=1)
        middle = ordered[:, LEAST_RECORDED // 2]
        steady = (middle >= 1) & (middle < 2 * LEAST_LEVEL) & (ordered[:, -3] - middle <= LEAST_LEVEL)
        others = (samples == 0).sum(axis=1)[row] - (end - start)
        stands_out = inner & steady & (others <= RARE_ZEROS * (s - (end - start)))
        good = (good & ~doubtful[row]) | (low[row] & stands_out)
    return _mark_runs(row[good], start[good], end[good], n, s)


def _mark_runs(row: np.ndarray, start: np.ndarray, end: np.ndarray, n: int, s: int) -> np.ndarray:
    """True from start to end (k,) in rows (k,) of a bool (n, s)."""
    count = np.zeros((n, s + 1), np.int8)
    count[row, start] = 1
    count[row, end] -= 1
    return np.cumsum(count[:, :-1], axis=1, dtype=np.int8) > 0


def quiet_fill(samples: np.ndarray, fill: np.ndarray) -> np.ndarray:
    """Samples (n, s) with the lower quartile of each waveform's recorded samples in place of fill, as a copy."""
    quiet = samples.copy()
    rows = np.flatnonzero(fill.any(axis=1))
    part = np.sort(np.where(fill[rows], np.iinfo(samples.dtype).max, samples[rows]), axis=1)
    level = part[np.arange(len(rows)), np.count_nonzero(~fill[rows], axis=1) // 4]
    quiet[rows] = np.where(fill[rows], level[:, None], samples[rows])
    return quiet


def find_varying(samples: np.ndarray) -> np.ndarray:
    """Waveforms (n, s) whose samples are not all the same, bool (n,): only these have echoes."""
    return (samples != samples[:, :1]).any(axis=1)


def transpose_samples(samples: np.ndarray) -> np.ndarray:
    """Raw counts (n, s) as contiguous float32 (s, n)."""
    return samples.T.astype(np.float32, order="C")


def smooth_121(signal: np.ndarray) -> np.ndarray:
    """Signal (s, n) filtered with [1 2 1]/4; the end samples are repeated outwards."""
    if len(signal) < 2:
        return signal.copy()
    smoothed = np.empty_like(signal)
    np.add(signal[:-2], signal[2:], out=smoothed[1:-1])
    np.add(signal[0], signal[1], out=smoothed[0])
    np.add(signal[-1], signal[-2], out=smoothed[-1])
    smoothed += signal
    smoothed += signal
    smoothed *= np.float32(0.25)
    return smoothed


def find_peaks(signal: np.ndarray, threshold: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Local maxima above a threshold.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms.
    threshold : float or float (n,), count
        Peaks must be higher.

    Returns
    -------
    waveform, sample : int64 (m,)
        Sorted by both. A plateau counts once, at its first sample; the first and the last sample count when they are
        higher than their one neighbour. A constant waveform has no peak.
    """
    s, n = signal.shape
    if s < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    rising = np.empty((s + 1, n), bool)
    rising[0] = True
    rising[-1] = False
    np.greater(signal[1:], signal[:-1], out=rising[1:-1])
    peak = rising[:-1]
    falling = ~rising[1:]
    np.less(signal[1], signal[0], out=falling[0])
    falling &= peak
    falling &= signal > threshold
    flat = np.flatnonzero(falling)
    sample, waveform = np.divmod(flat, n)
    order = np.argsort(waveform.astype(np.uint16) if n <= 65536 else waveform, kind="stable")
    waveform, sample = waveform[order], sample[order]
    # A plateau is no peak where it is a step of a rising flank.
    top = np.ones(len(sample), bool)
    flat = np.arange(len(sample))
    ahead = sample.copy()
    while len(flat):
        ahead[flat] += 1
        flat = flat[ahead[flat] < len(signal)]
        rise = signal[ahead[flat], waveform[flat]] - signal[sample[flat], waveform[flat]]
        top[flat] = rise <= 0
        flat = flat[rise == 0]
    return waveform[top], sample[top]


def widen(mask: np.ndarray, reach: int) -> np.ndarray:
    """Mask, bool (s, n), in which each true sample also marks the `reach` samples on both sides."""
    wide = mask.copy()
    done = 0
    while done < reach:
        step = min(reach - done, max(done, 1))
        shifted = wide.copy()
        shifted[step:] |= wide[:-step]
        shifted[:-step] |= wide[step:]
        wide = shifted
        done += step
    return wide


STRONG = 3.0
"""Signal this many times as far from the level as the least signal is strong: its tail may be seen."""


def widen_after(mask: np.ndarray, reach: int) -> np.ndarray:
    """Mask, bool (s, n), in which each true sample also marks the `reach` samples after it."""
    if reach >= len(mask):
        return accumulate(np.logical_or, mask)
    wide = mask.copy()
    done = 0
    while done < reach:
        step = min(reach - done, done + 1)
        wide[step:] |= wide[:-step].copy()
        done += step
    return wide


def find_quiet(
    signal: np.ndarray, limit: np.ndarray | np.floating | float, reach: int, recovery: int = 0
) -> np.ndarray:
    """Samples far from any signal.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms without baseline.
    limit : float or float (n,), count
        A smoothed sample beyond +-limit is signal.
    reach : int, samples
        Samples this near to signal are not quiet.
    recovery : int, samples
        Nor are samples within this of an earlier strong signal: its tail lies below the limit, but it is no baseline.

    Returns
    -------
    bool (s, n)
    """
    smoothed = np.abs(smooth_121(signal))
    busy = widen(smoothed > limit, reach)
    if recovery > reach:
        busy |= widen_after(smoothed > np.multiply(limit, np.float32(STRONG), dtype=np.float32), recovery)
    return ~busy


def quiet_mean(signal: np.ndarray, quiet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the quiet samples of each waveform.

    Parameters
    ----------
    signal : float32 (s, n), count
        Waveforms, all of them finite.
    quiet : bool (s, n)
        Samples that count.

    Returns
    -------
    mean : float32 (n,), count
        0 where no sample is quiet.
    number : int32 (n,)
        Quiet samples.
    """
    number = quiet.sum(axis=0, dtype=np.int32)
    total = sum_samples(signal * quiet)
    return total / np.maximum(number, 1).astype(np.float32), number


NARROW = 128
"""Waveforms below which NumPy accumulates faster along them than this module does sample by sample."""


def accumulate(function: np.ufunc, values: np.ndarray) -> np.ndarray:
    """As function.accumulate(values, axis=0) of values (s, n), in the same order and of the same dtype.

    NumPy goes down every waveform, across the memory; all waveforms at once are up to 40 times as fast.
    """
    if values.shape[1] < NARROW or not len(values):
        return function.accumulate(values, axis=0)
    result = np.empty_like(values)
    result[0] = values[0]
    for at in range(1, len(values)):
        function(result[at - 1], values[at], out=result[at])
    return result


def sum_samples(values: np.ndarray) -> np.ndarray:
    """Sums (n,) over the samples of values (s, n), added in the same order for any n.

    NumPy adds a single column pairwise, others one by one: the result would depend on the block.
    """
    if values.shape[1] != 1:
        return values.sum(axis=0)
    return np.repeat(values, 2, axis=1).sum(axis=0)[:1]
