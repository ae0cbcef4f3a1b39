"""Average square difference (ASDF) of waveforms and a reference pulse, and its significant minima.

Used by the stage detect.asdf (Wagner et al., docs/algorithms.md 1.1).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.signal.signal import accumulate

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
