"""Average square difference of waveforms and a reference pulse, and its significant minima (ALGORITHMS 1.1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

COLUMNS_AT_A_TIME = 512
"""Waveforms whose arrays stay in the cache together."""


class Minima(NamedTuple):
    """Local minima of functions (n, rows), sorted by waveform, then row."""

    waveform: np.ndarray
    row: np.ndarray
    value: np.ndarray
    left: np.ndarray
    """Highest value between the minimum and the one before it, or the beginning."""
    right: np.ndarray
    """Highest value between the minimum and the next one, or the end."""

    def take(self, rows: np.ndarray) -> Minima:
        """The minima at `rows`; their barriers are kept as they are."""
        return Minima(*(field[rows] for field in self))


def pad_samples(signal: np.ndarray, number: int) -> np.ndarray:
    """Signal (s, n) with `number` rows of zeros on both sides."""
    s, n = signal.shape
    padded = np.zeros((s + 2 * number, n), signal.dtype)
    padded[number : number + s] = signal
    return padded


def slide_taps(padded: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Sums of taps (k,) times rows t .. t + k - 1 of padded (s, n), for every t: (s - k + 1, n)."""
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
    np.cumsum(padded * padded, axis=0, out=total[1:])
    return total[k:] - total[:-k]


def square_differences(signal: np.ndarray, taps: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ASDF of signal (s, n) and a reference of unit height (k,), and their correlation: (s + k - 1, n) each.

    Row t belongs to the lag t - (k - 1) of the reference's first sample. The reference is multiplied by height (n,):
    R = E1 + (energy of the window) - 2 C, the fast form; where the height is not positive, R is 0.
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
    """Minima of contiguous values (n, rows): below the value before, not above the one behind; never at the ends.

    wanted: rows at which minima count at all, bool (n, rows); others neither count nor separate.
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
    """Rows of the minima that are left when the least prominent one is removed as long as it lies below `least` (n,).

    Prominence: the lower barrier to the two neighbours that are still there, or to the ends. All minima that are less
    prominent than both of their neighbours go at once, which comes to the same: removals only raise prominences.
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
