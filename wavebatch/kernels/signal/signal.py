"""Smoothing, local maxima and quiet samples of thousands of waveforms.

Used by nearly every stage and by the survey. Arrays are (s, n), waveforms along the last, contiguous axis: this layout
is what makes NumPy fast here.
"""

from __future__ import annotations

import numpy as np

SMOOTH_GAIN = np.sqrt(6.0) / 4.0
"""Standard deviation of white noise after one pass of the [1 2 1]/4 filter (0.61237)."""


LEAST_PADDING, LEAST_RECORDED, LEAST_LEVEL = 8, 16, 3
"""Zeros at the end of a waveform are padding if there are at least LEAST_PADDING of them, after at least LEAST_RECORDED
samples that are all at least LEAST_LEVEL.
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


def transpose_samples(samples: np.ndarray) -> np.ndarray:
    """Raw counts (n, s) as contiguous float32 (s, n)."""
    return samples.T.astype(np.float32, order="C")


def smooth_121(signal: np.ndarray) -> np.ndarray:
    """Signal (s, n) filtered with [1 2 1]/4 along the samples; the end samples are repeated outwards."""
    smoothed = np.empty_like(signal)
    if len(signal) == 1:
        smoothed[:] = signal
        return smoothed
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
    top = _is_top(signal, waveform, sample)
    return waveform[top], sample[top]


def _is_top(signal: np.ndarray, waveform: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """False (m,) where the plateau that begins at a sample is a step of a rising flank."""
    top = np.ones(len(sample), bool)
    flat = np.arange(len(sample))
    ahead = sample.copy()
    while len(flat):
        ahead[flat] += 1
        flat = flat[ahead[flat] < len(signal)]
        rise = signal[ahead[flat], waveform[flat]] - signal[sample[flat], waveform[flat]]
        top[flat] = rise <= 0
        flat = flat[rise == 0]
    return top


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
        return np.logical_or.accumulate(mask, axis=0)
    wide = mask.copy()
    done = 0
    while done < reach:
        step = min(reach - done, done + 1)
        wide[step:] |= wide[:-step].copy()
        done += step
    return wide


def find_quiet(signal: np.ndarray, limit: np.ndarray | float, reach: int, recovery: int = 0) -> np.ndarray:
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
        Waveforms.
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
    total = sum_samples(np.where(quiet, signal, np.float32(0)))
    return total / np.maximum(number, 1).astype(np.float32), number


def sum_samples(values: np.ndarray) -> np.ndarray:
    """Sums (n,) over the samples of values (s, n), added in the same order for any n.

    NumPy adds a single column pairwise, others one by one: the result would depend on the block.
    """
    if values.shape[1] != 1:
        return values.sum(axis=0)
    return np.repeat(values, 2, axis=1).sum(axis=0)[:1]
