"""Pairs of echoes and returns: one to one, nearest in time, for a whole block at once: kernels/c/returns.h.

Used where echoes are placed on returns, and by the score.
"""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.kernels.library import call


def match_returns(
    echo_waveform: np.ndarray,
    echo_time: np.ndarray,
    return_waveform: np.ndarray,
    return_time: np.ndarray,
    tolerance: float,
) -> np.ndarray:
    """The return that each echo is matched with.

    Pairs are mutual nearest neighbours within one waveform. Taken pairs are removed and the rest is paired again, until
    no pair is left.

    Parameters
    ----------
    echo_waveform, echo_time : int (m,), float (m,), ns
        Echoes, sorted by waveform.
    return_waveform, return_time : int (k,), float (k,), ns
        Returns, sorted by waveform.
    tolerance : float, ns
        Largest distance of a pair.

    Returns
    -------
    int64 (m,)
        Row of the return, -1 without one.
    """
    echo_waveform, return_waveform = (np.ascontiguousarray(w, np.int64) for w in (echo_waveform, return_waveform))
    echo_time, return_time = (np.ascontiguousarray(time, np.float64) for time in (echo_time, return_time))
    m, k = len(echo_waveform), len(return_waveform)
    if echo_time.shape != (m,) or return_time.shape != (k,):
        raise ValueError("an echo or a return has no time")
    matched = np.empty(m, np.int64)
    call("match_returns", ctypes.c_int64(m), echo_waveform, echo_time, ctypes.c_int64(k), return_waveform, return_time,
         ctypes.c_double(tolerance), matched)  # fmt: skip
    return matched
