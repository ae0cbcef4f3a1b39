"""Filters of the detectors along the samples of arrays (s, n), the noise that they let through, and maxima.

Used by stages/detect and the stage noise.pooled. A filter is given by half of its taps: the centre first. Quiet levels
and maxima are found by the compiled library (kernels/c/signal.h). The B3-spline wavelet transform with holes is that
of the stage detect.wavelet (Wang et al., docs/algorithms.md 1.2).

The average square difference (ASDF) of waveforms and a reference pulse, and its significant minima, are those of the
stage detect.asdf (Wagner et al., docs/algorithms.md 1.1).
"""

from __future__ import annotations

import ctypes
from functools import lru_cache

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels import library
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.library import Samples, call, place
from wavebatch.kernels.signal.signal import accumulate


def gaussian_taps(width: float) -> np.ndarray:
    """Half of a Gaussian filter of height 1: taps 0, 1, ... up to three widths [samples], float64."""
    return exp(-0.5 * (np.arange(int(np.ceil(3.0 * width)) + 1) / width) ** 2)


def curvature_taps(width: float) -> np.ndarray:
    """Half of the negative second derivative of a Gaussian, made to sum to zero: taps 0, 1, ... [samples], float64."""
    x = np.arange(int(np.ceil(4.0 * width)) + 1) / width
    taps = (1 - x * x) * exp(-0.5 * x * x)
    total = taps[0] + 2 * taps[1:].sum()
    bell = exp(-0.5 * x * x)
    return taps - bell * total / (bell[0] + 2 * bell[1:].sum())


def slope_taps(width: float) -> np.ndarray:
    """Half of an antisymmetric filter, the derivative of a Gaussian: taps 0, 1, ... [samples], float64.

    The first one is 0. It gives the slope per sample of a straight line.
    """
    x = np.arange(int(np.ceil(4.0 * width)) + 1)
    taps = x * exp(-0.5 * (x / width) ** 2)
    return taps / (2 * np.sum(taps * x))


def filter_energy(taps: np.ndarray) -> float:
    """Sum of the squares of a symmetric filter given by its half: the gain of the variance of white noise."""
    return float(taps[0] ** 2 + 2 * np.sum(taps[1:] ** 2))


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
    s, n = signal.shape
    by_waveform = signal.flags.f_contiguous
    rows = np.ascontiguousarray(signal.T if by_waveform else signal, np.float32)
    half, total = np.ascontiguousarray(taps, np.float32), np.empty_like(rows)
    sizes = (n, s, 1) if by_waveform else (1, s * n, n)
    call("filter_rows", rows, *map(ctypes.c_int64, sizes), half, ctypes.c_int64(len(half) - 1), total)
    return total.T if by_waveform else total


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


def quiet_levels(samples: Samples, limit: float, reach: int, recovery: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the samples of each waveform that are far from any signal.

    Parameters
    ----------
    samples : Samples
        Waveforms, with one level each.
    limit : float, count
        A smoothed sample beyond +-limit around the level is signal.
    reach : int, samples
        Samples this near to signal are not quiet.
    recovery : int, samples
        Nor are samples within this after a signal of three times the limit.

    Returns
    -------
    mean : float32 (n,), count
        Above the level; 0 where no sample is quiet.
    number : int32 (n,)
        Quiet samples.

    References
    ----------
    docs/algorithms.md H10.
    """
    samples, n = samples.checked(), len(samples.counts)
    mean, number = np.empty(n, np.float32), np.empty(n, np.int32)
    sizes = ctypes.c_int64(n), ctypes.c_double(limit), ctypes.c_int64(reach), ctypes.c_int64(recovery)
    call("quiet_levels", samples.as_block(), *sizes, mean, number)
    return mean, number


def find_maxima(
    samples: Samples, threshold: float, width: float, broad: float = 0.0, taps: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Local maxima of smoothed waveforms, with starts for a fit.

    Parameters
    ----------
    samples : Samples
        Waveforms with their levels; missing samples count as 0.
    threshold : float
        Least height in the smoothed waveform [noise of one sample].
    width : float, samples
        Width of the system pulse.
    broad : float, samples
        Width of the Gaussian that smooths; 0 for [1 2 1]/4 twice.
    taps : float (k,), optional
        Half of that Gaussian, the centre first.

    Returns
    -------
    waveform : int64 (m,)
    time, amplitude, width : float64 (m,), samples, count, samples
        From a log-parabola through five samples; constant waveforms have no maximum.

    References
    ----------
    Wagner et al. (2007), max-detection; docs/algorithms.md 1.1, 4.1.
    """
    taps = np.zeros(1) if taps is None else taps
    return _list_maxima("find_maxima", samples.checked(), threshold, width, broad, taps)


def find_correlated(
    samples: Samples, threshold: float, width: float, taps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Local maxima of waveforms correlated with a pulse, outside of gaps, with starts for a fit.

    Parameters
    ----------
    samples, width
        As for `find_maxima`.
    threshold : float
        Least height of the correlation [noise of one sample].
    taps : float (k,)
        Half of the pulse, the centre first.

    Returns
    -------
    waveform : int64 (m,)
    time, amplitude, width : float64 (m,), samples, units of the correlation, samples
        From a parabola through the logarithms of three correlations; the width, 0.8 to 2 times the given one, from five
        samples.

    References
    ----------
    docs/algorithms.md 1.1 (4).
    """
    return _list_maxima("find_correlated", samples.checked(finite=False), threshold, width, 0.0, taps)


def _list_maxima(
    name: str, samples: Samples, threshold: float, width: float, broad: float, taps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What a function of the library finds, called again where there was too little room."""
    n, half = len(samples.counts), np.ascontiguousarray(taps, np.float32)
    detector = library.Detector(threshold, width, broad, place(half, np.float32), len(half) - 1)
    room, done, parts = 2 * n + samples.counts.shape[1], 0, []
    while done < n:
        columns = np.empty(room, np.int64), np.empty(room), np.empty(room), np.empty(room)
        out, found = library.CCandidates(room, *map(library.address, columns)), ctypes.c_int64()
        sizes = ctypes.c_int64(n), detector, ctypes.c_int64(done)
        done = call(name, samples.as_block(), *sizes, out, ctypes.byref(found))
        parts.append([column[: found.value] for column in columns])
        room *= 2
    waveform, amplitude, time, wide = map(np.concatenate, zip(*parts, strict=True)) if parts else np.empty((4, 0))
    return waveform.astype(np.int64, copy=False), time, amplitude, wide


def smooth_b3(signal: np.ndarray, step: int) -> np.ndarray:
    """Signal (s, n) filtered with [1 4 6 4 1]/16, taps `step` samples apart; the end samples are repeated outwards."""
    s = len(signal)
    padded = np.concatenate([np.repeat(signal[:1], 2 * step, axis=0), signal, np.repeat(signal[-1:], 2 * step, axis=0)])
    inner = padded[step : step + s] + padded[3 * step : 3 * step + s]
    inner *= 4
    inner += padded[:s]
    inner += padded[4 * step : 4 * step + s]
    padded = padded[2 * step : 2 * step + s]
    inner += 6 * padded
    inner *= signal.dtype.type(1 / 16)
    return inner


def b3_detail(signal: np.ndarray, level: int) -> np.ndarray:
    """Detail of signal (s, n) at a level, 1 or more: what the last of `level` smoothings removes."""
    for step in range(level - 1):
        signal = smooth_b3(signal, 1 << step)
    return signal - smooth_b3(signal, 1 << (level - 1))


@lru_cache(maxsize=16)
def b3_gain(level: int) -> float:
    """Standard deviation of the detail of white noise of standard deviation 1."""
    reach = 2 * (1 << level)
    impulse = np.zeros((2 * reach + 1, 1))
    impulse[reach] = 1.0
    return float(np.sqrt(np.sum(b3_detail(impulse, level) ** 2)))


def b3_level(width: float) -> int:
    """The level that separates echoes of a Gaussian width [samples] best: round(log2(width)) + 1, at least 1."""
    return max(int(round(float(np.log2(width)))) + 1, 1)


COLUMNS_AT_A_TIME = 512
"""Waveforms per part, so that the arrays of a part stay in the cache together."""


class Minima(NamedTuple):
    """Local minima of functions (n, rows), sorted by waveform, then row."""

    waveform: np.ndarray
    """int64 (m,)."""
    row: np.ndarray
    """int64 (m,)."""
    value: np.ndarray
    """Value of the function, float (m,)."""
    left: np.ndarray
    """Highest value between the minimum and the one before it, or the beginning, float (m,)."""
    right: np.ndarray
    """Highest value between the minimum and the next one, or the end, float (m,)."""

    def take(self, rows: np.ndarray) -> Minima:
        """The minima at `rows`; barriers stay as they are."""
        return Minima(*(field[rows] for field in self))


def pad_samples(signal: np.ndarray, number: int) -> np.ndarray:
    """Signal (s, n) with `number` rows of zeros on both sides."""
    s, n = signal.shape
    padded = np.zeros((s + 2 * number, n), signal.dtype)
    padded[number : number + s] = signal
    return padded


def slide_taps(padded: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Sums of taps times rows t .. t + k - 1, for every t.

    Parameters
    ----------
    padded : float (s, n)
        Waveforms.
    taps : float (k,)
        Weights.

    Returns
    -------
    float (s - k + 1, n)
    """
    k = len(taps)
    rows = len(padded) - k + 1
    taps = taps.astype(padded.dtype)
    even = bool(np.array_equal(taps, taps[::-1]))
    pairs = k // 2 if even else 0
    total = np.zeros((rows, padded.shape[1]), padded.dtype)
    part = np.empty_like(total)
    for i in range(pairs):
        np.add(padded[i : i + rows], padded[k - 1 - i : k - 1 - i + rows], out=part)
        part *= taps[i]
        total += part
    for i in range(pairs, k - pairs):
        np.multiply(padded[i : i + rows], taps[i], out=part)
        total += part
    return total


def slide_energy(padded: np.ndarray, k: int) -> np.ndarray:
    """Sums of the squares of rows t .. t + k - 1 of padded (s, n), for every t: (s - k + 1, n)."""
    total = np.zeros((len(padded) + 1, padded.shape[1]), padded.dtype)
    total[1:] = accumulate(np.add, padded * padded)
    return total[k:] - total[:-k]


def square_differences(signal: np.ndarray, taps: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ASDF of waveforms and a reference, and their correlation.

    Parameters
    ----------
    signal : float (s, n), count
        Waveforms without baseline.
    taps : float (k,)
        Reference of unit height.
    height : float (n,), count
        Height of the reference in each waveform; ASDF is 0 where it is not positive.

    Returns
    -------
    difference, correlation : float (s + k - 1, n)
        Row t belongs to the lag t - (k - 1) of the reference's first sample.

    Notes
    -----
    R = E1 + (energy of the window) - 2 C, the fast form (docs/algorithms.md 1.1).
    """
    k = len(taps)
    padded = pad_samples(signal, k - 1)
    correlation = slide_taps(padded, taps)
    height = np.maximum(height, 0)
    difference = slide_energy(padded, k)
    difference -= (2 * height) * correlation
    difference += signal.dtype.type(np.sum(taps**2)) * height * height
    difference *= height > 0
    return difference, correlation


def find_minima(values: np.ndarray, wanted: np.ndarray | None = None) -> Minima:
    """Minima of functions: below the value before, not above the one after; never at the ends.

    Parameters
    ----------
    values : float (n, rows)
        Contiguous.
    wanted : bool (n, rows), optional
        Where minima count; others neither count nor separate.

    Returns
    -------
    Minima
    """
    n, rows = values.shape
    low = np.zeros((n, rows), bool)
    if rows > 2:
        np.less(values[:, 1:-1], values[:, :-2], out=low[:, 1:-1])
        low[:, 1:-1] &= values[:, 1:-1] <= values[:, 2:]
    if wanted is not None:
        low &= wanted
    flat = np.flatnonzero(low)
    waveform = flat // rows
    number = np.bincount(waveform, minlength=n)
    # Parts of every waveform: from its beginning to its first minimum, from each minimum to the next, or the end.
    place = np.arange(len(flat)) + waveform + 1
    borders = np.empty(len(flat) + n, np.int64)
    borders[place] = flat
    borders[np.arange(n) + np.cumsum(number) - number] = np.arange(n) * rows
    line = values.reshape(-1)
    highest = np.maximum.reduceat(line, borders) if n else line
    return Minima(waveform, flat - waveform * rows, line[flat], highest[place - 1], highest[place])


def keep_prominent(minima: Minima, least: np.ndarray) -> np.ndarray:
    """Minima that are left when the least prominent one is removed as long as its prominence is too small.

    The prominence is the lower barrier to the two neighbours that are left, or to the ends. All minima that are less
    prominent than both neighbours are removed at once, with the same result: removals only raise prominences.

    Parameters
    ----------
    minima : Minima
        Changed: barriers are updated in place.
    least : float (n,)
        Smallest prominence in each waveform.

    Returns
    -------
    int64
        Rows of the minima that are left, ascending.
    """
    rows, kept = np.arange(len(minima.row)), []
    limit = least[minima.waveform]
    while len(rows):
        prominence = np.minimum(minima.left, minima.right) - minima.value
        low = prominence < limit
        same = minima.waveform[1:] == minima.waveform[:-1]
        goes = low.copy()
        goes[1:] &= ~same | (prominence[1:] < prominence[:-1])
        goes[:-1] &= ~same | (prominence[:-1] <= prominence[1:])
        at = np.flatnonzero(goes)
        barrier = np.maximum(minima.left[at], minima.right[at])
        before, after = at > 0, at < len(rows) - 1
        before[before] = same[at[before] - 1]
        after[after] = same[at[after]]
        minima.right[at[before] - 1] = barrier[before]
        minima.left[at[after] + 1] = barrier[after]
        # Waveforms in which nothing is too low are finished.
        busy = np.zeros(len(least), bool)
        busy[minima.waveform[low]] = True
        going_on = busy[minima.waveform]
        kept.append(rows[~going_on])
        left = np.flatnonzero(going_on & ~goes)
        rows, limit, minima = rows[left], limit[left], minima.take(left)
    return np.sort(np.concatenate(kept)) if kept else rows
