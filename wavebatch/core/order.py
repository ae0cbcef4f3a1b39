"""Order of the rows of tables. Kernels use it too: it knows arrays only."""

from __future__ import annotations

import numpy as np


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
