"""Pairs of echoes and returns: one to one, nearest in time, for a whole block at once.

Used where echoes are placed on returns, and by the score.
"""

from __future__ import annotations

import numpy as np


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
    matched = np.full(len(echo_waveform), -1, np.int64)
    if not len(echo_waveform) or not len(return_waveform):
        return matched
    size = int(max(echo_waveform[-1], return_waveform[-1])) + 1
    lone = (np.bincount(echo_waveform, minlength=size) == 1) & (np.bincount(return_waveform, minlength=size) == 1)
    many_echoes, many_returns = np.flatnonzero(~lone[echo_waveform]), np.flatnonzero(~lone[return_waveform])
    alone, one = np.flatnonzero(lone[echo_waveform]), np.flatnonzero(lone[return_waveform])
    matched[alone] = np.where(np.abs(echo_time[alone] - return_time[one]) <= tolerance, one, -1)
    longest = max(np.abs(echo_time).max(), np.abs(return_time).max(initial=0.0))
    stride = 4.0 * (longest + tolerance) + 1.0
    echoes = _sort(many_echoes, echo_waveform * stride + echo_time)
    returns = _sort(many_returns, return_waveform * stride + return_time)
    while len(echoes) and len(returns):
        echo_key = echo_waveform[echoes] * stride + echo_time[echoes]
        return_key = return_waveform[returns] * stride + return_time[returns]
        to_return = _nearest(echo_key, return_key)
        to_echo = _nearest(return_key, echo_key)
        pair = (to_echo[to_return] == np.arange(len(echoes))) & (np.abs(echo_key - return_key[to_return]) <= tolerance)
        if not pair.any():
            break
        matched[echoes[pair]] = returns[to_return[pair]]
        taken = np.zeros(len(returns), bool)
        taken[to_return[pair]] = True
        echoes, returns = echoes[~pair], returns[~taken]
    return matched


def _sort(rows: np.ndarray, keys: np.ndarray) -> np.ndarray:
    return rows[np.argsort(keys[rows], kind="stable")]


def _nearest(keys: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Index of the nearest of sorted `others` for each key; of two equally near ones the first."""
    right = np.clip(np.searchsorted(others, keys), 0, len(others) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(keys - others[left] <= others[right] - keys, left, right)
