"""Order of rows, and medians of groups of rows. Kernels use it too: it knows arrays only.

`distinct`, `median`, `known_median`, `quantile` and `quantiles` stand in for `np.unique`, `np.median`, `np.nanmedian`
and `np.quantile` where every `info`, `survey` and `run` comes by: those import `numpy.ma`, which takes a tenth of the
time of a small strip, and each call of them 30 us more. So does `draw` for `numpy.random`, which takes 9 ms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from random import Random
from typing import Any

import numpy as np

from wavebatch.core.units import MAD_TO_STD


def even_places(number: int, most: int) -> np.ndarray:
    """Places of at most `most` of so many rows, spread evenly from the first to the last.

    Parameters
    ----------
    number, most : int
        From 0 and from 1.

    Returns
    -------
    int64 (k,)
        Ascending, each once.
    """
    return distinct(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))


def join_ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The numbers start, start + 1, ..., start + count - 1 of all ranges, one behind the other."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - (ends - counts), counts)


def draw(seed: int, *shape: int) -> np.ndarray:
    """Numbers between 0 and 1 that look like chance, float64 of a shape: always the same for a seed."""
    source, size, most = Random(seed), 4 * int(np.prod(shape)), 1 << 24  # 2^28 bytes at once are an OverflowError
    drawn = b"".join(source.randbytes(min(most, size - at)) for at in range(0, size, most))
    return ((np.frombuffer(drawn, "<u4") + 0.5) / 2**32).reshape(shape)


def distinct(values: np.ndarray) -> np.ndarray:
    """Each of the values (n,) once, ascending; without NaN."""
    ordered = np.sort(values)
    first = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=first[1:])
    return ordered[first]


def median(values: np.ndarray, axis: int | None = None) -> Any:
    """Median along an axis, or of all values; NaN where one is NaN, or there is none. To the bit that of NumPy."""
    if axis is None:
        values, axis = values.ravel(), 0
    n = values.shape[axis]
    if not n:
        return np.full(np.delete(values.shape, axis), np.nan)[()]
    # One place for `partition`: for two it takes up to eighteen times as long.
    ordered = np.partition(values, n // 2, axis=axis)
    ordered = np.moveaxis(ordered, axis, 0) if axis else ordered
    last = ordered[n // 2 :].max(axis=0)  # NaN comes last
    middle = ordered[n // 2] / 1
    middle = middle if n % 2 else (ordered[: n // 2].max(axis=0) / 1 + middle) / 2
    return np.where(np.isnan(last), last, middle)[()]


def known_median(values: np.ndarray, axis: int) -> np.ndarray:
    """Median along an axis of the values that are not NaN; NaN where there is none. To the bit that of NumPy."""
    ordered = np.sort(values, axis=axis)  # NaN comes last
    n = np.count_nonzero(~np.isnan(values), axis=axis, keepdims=True)
    low, high = (np.take_along_axis(ordered, place, axis) for place in (np.maximum(n - 1, 0) // 2, n // 2))
    return np.squeeze((low + high) / 2, axis=axis)


def quantile(values: np.ndarray, share: float) -> float:
    """Value below which a share of the floats (n,), n > 0, lies, by a line between the two next to it; without NaN."""
    ordered, place = np.sort(values), share * (len(values) - 1)
    low = int(place)
    below, above, rest = ordered[low], ordered[min(low + 1, len(ordered) - 1)], place - low
    step = above - below
    return float(above - step * (1 - rest) if rest >= 0.5 else below + step * rest)


def quantiles(values: np.ndarray, shares: Sequence[float] | np.ndarray) -> np.ndarray:
    """As `quantile` along the last axis, for several shares, which come first: float64 (k, ...)."""
    ordered, place = np.sort(values, axis=-1), np.asarray(shares, np.float64) * (values.shape[-1] - 1)
    low = place.astype(np.int64)
    below, above = (ordered.take(np.minimum(at, values.shape[-1] - 1), axis=-1) for at in (low, low + 1))
    rest, step = place - low, above - below
    return np.moveaxis(np.where(rest >= 0.5, above - step * (1 - rest), below + step * rest), -1, 0)


def find_order(waveform: np.ndarray, time: np.ndarray) -> np.ndarray | None:
    """Order of rows by waveform, then time.

    For tables that are a few sorted runs in which hardly a waveform has its echoes out of order, as fits give them: a
    stable sort of the waveforms, and one by both of those few, takes less time than a sort of all by both.

    Parameters
    ----------
    waveform : int (m,)
        From 0; memory grows with the largest.
    time : float (m,)
        Finite; rows of NaN keep their place.

    Returns
    -------
    int64 (m,) or None
        None where the rows have that order.
    """
    order = None
    if np.any(waveform[1:] < waveform[:-1]):
        order = np.argsort(waveform, kind="stable")
        waveform, time = waveform[order], time[order]
    late = (waveform[1:] == waveform[:-1]) & (time[1:] < time[:-1])
    if not late.any():
        return order
    order = np.arange(len(waveform)) if order is None else order
    mixed = np.zeros(int(waveform[-1]) + 1, bool)
    mixed[waveform[1:][late]] = True
    rows = np.flatnonzero(mixed[waveform])
    order[rows] = order[rows[np.lexsort((time[rows], waveform[rows]))]]
    return order


def robust_std(values: np.ndarray) -> float:
    """Standard deviation by the median of the distances from the median, of values (m,), m > 0."""
    return MAD_TO_STD * float(median(np.abs(values - median(values))))


def group_medians(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median of each group of values, and their standard deviation by the median of their distances from it.

    One sort for all groups: a call of `np.median` takes longer than the sort of a small group.

    Parameters
    ----------
    values : float (m,)
    group : int (m,)
        From 0.

    Returns
    -------
    median, std : float (g,)
        0 for groups without a value.
    """
    count = np.bincount(group)
    start = np.cumsum(count) - count
    some = count > 0
    small = group.astype(np.uint16) if len(count) <= 1 << 16 else group  # numbers so small are sorted by their digits

    def middle(values: np.ndarray) -> np.ndarray:
        order = np.argsort(values)
        ordered = values[order[np.argsort(small[order], kind="stable")]]
        middles = np.zeros(len(count), values.dtype)
        low, high = (start + (count - 1) // 2)[some], (start + count // 2)[some]
        middles[some] = (ordered[low] + ordered[high]) * values.dtype.type(0.5)
        return middles

    centre = middle(values)
    return centre, MAD_TO_STD * middle(np.abs(values - centre[group]))


class EvenSample:
    """An evenly spaced sample of rows that arrive in pieces: all up to a limit, then every second, fourth ... row.

    It does not depend on the size of the pieces: results are the same for any block size and any number of jobs.

    Parameters
    ----------
    limit : int, optional
        Largest number of rows that are kept; LIMIT if not given.
    """

    LIMIT = 1_000_000
    """Keeps percentiles right to about 0.1 % in some 10 MB per column."""

    def __init__(self, limit: int | None = None) -> None:
        self.limit = limit or self.LIMIT
        self.step, self.seen = 1, 0
        self._parts: list[dict[str, np.ndarray]] = []
        self._kept = 0

    def add(self, columns: Mapping[str, np.ndarray]) -> None:
        """Adds rows: columns are arrays (k, ...) by name, with the same names every time."""
        start, number = -self.seen % self.step, _length(columns)
        self.seen += number
        # Copies, because slices would keep the whole records alive.
        self._parts.append({name: values[start :: self.step].copy() for name, values in columns.items()})
        self._kept += _length(self._parts[-1])
        while self._kept > self.limit:
            self._parts = [{name: values[::2].copy() for name, values in self.read().items()}]
            self._kept = _length(self._parts[0])
            self.step *= 2

    def read(self) -> dict[str, np.ndarray]:
        """The columns of the sample, rows in order of arrival; empty when no rows were added."""
        if len(self._parts) > 1:
            names = self._parts[0]
            self._parts = [{name: np.concatenate([part[name] for part in self._parts]) for name in names}]
        return self._parts[0] if self._parts else {}


def _length(columns: Mapping[str, np.ndarray]) -> int:
    return len(next(iter(columns.values())))
