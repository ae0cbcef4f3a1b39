"""Order of rows, and medians of groups of rows. Kernels use it too: it knows arrays only."""

from __future__ import annotations

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
    return np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(np.int64))


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
    return MAD_TO_STD * float(np.median(np.abs(values - np.median(values))))


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

    def middle(values: np.ndarray) -> np.ndarray:
        ordered, middles = values[np.lexsort((values, group))], np.zeros(len(count), values.dtype)
        low, high = (start + (count - 1) // 2)[some], (start + count // 2)[some]
        middles[some] = (ordered[low] + ordered[high]) * values.dtype.type(0.5)
        return middles

    median = middle(values)
    return median, MAD_TO_STD * middle(np.abs(values - median[group]))
