"""Which points belong to one pulse, which return is nearest to an echo, and numbers along the ray."""

from __future__ import annotations

import numpy as np

LONGEST_PULSE = 64
"""Points of equal gps time from which on the time is taken for a constant, not for that of one pulse."""


def find_pulses(gps_time: np.ndarray) -> np.ndarray:
    """First point of the pulse that each point belongs to, i8 (n,).

    A pulse is a run of points of equal time. Where the time is 0, or the same for LONGEST_PULSE points or more, it says
    nothing and each point stands for itself.
    """
    n = len(gps_time)
    index = np.arange(n)
    if not n:
        return index
    start = np.flatnonzero(np.append(True, gps_time[1:] != gps_time[:-1]))
    length = np.diff(np.append(start, n))
    alone = np.repeat((length >= LONGEST_PULSE) | (gps_time[start] == 0), length)
    return np.where(alone, index, np.repeat(start, length))


def find_nearest(
    echo_waveform: np.ndarray, echo_time: np.ndarray, return_waveform: np.ndarray, return_time: np.ndarray
) -> np.ndarray:
    """Row of the return of the same waveform that is nearest in time to each echo, -1 without one, i8 (m,).

    Of two equally near ones the earlier. Times are compared as they are, so that the answer depends on nothing but the
    waveform's own echoes and returns.
    """
    if not len(return_waveform) or not len(echo_waveform):
        return np.full(len(echo_waveform), -1, np.int64)
    number = np.bincount(return_waveform, minlength=int(echo_waveform.max()) + 1)
    last = np.full(len(number), -1, np.int64)
    last[return_waveform] = np.arange(len(return_waveform))
    nearest = last[echo_waveform]
    # Most waveforms have one return: only the others need an order.
    echoes = np.flatnonzero(number[echo_waveform] > 1)
    if len(echoes):
        returns = np.flatnonzero(number[return_waveform] > 1)
        found = _find_nearest_of_many(
            echo_waveform[echoes], echo_time[echoes], return_waveform[returns], return_time[returns]
        )
        nearest[echoes] = np.where(found >= 0, returns[found], -1)
    return nearest


def _find_nearest_of_many(
    echo_waveform: np.ndarray, echo_time: np.ndarray, return_waveform: np.ndarray, return_time: np.ndarray
) -> np.ndarray:
    """As find_nearest, with any number of returns in each waveform."""
    k, m = len(return_waveform), len(echo_waveform)
    first = np.lexsort((return_time, return_waveform))
    waveform, time = return_waveform[first], return_time[first]
    is_echo = np.repeat([False, True], [k, m])
    order = np.lexsort((is_echo, np.concatenate([time, echo_time]), np.concatenate([waveform, echo_waveform])))
    returns_before = np.empty(k + m, np.int64)
    returns_before[order] = np.cumsum(~is_echo[order])
    after = returns_before[k:]
    before = after - 1
    gaps = []
    for rows in (before, after):
        clipped = np.clip(rows, 0, k - 1)
        same = (rows >= 0) & (rows < k) & (waveform[clipped] == echo_waveform)
        gaps.append(np.where(same, np.abs(time[clipped] - echo_time), np.inf))
    nearest = first[np.clip(np.where(gaps[0] <= gaps[1], before, after), 0, k - 1)]
    return np.where(np.isinf(np.minimum(*gaps)), -1, nearest)


def number_returns(
    pulse: np.ndarray, xyz: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return number and number of returns (m,) by the order along the ray of the pulse, and where they mean something.

    pulse: equal for the points of a pulse (m,). xyz: where the points lie [m] (m, 3).
    direction: away from the sensor (m, 3), zeros for points whose ray is not known; a pulse of only such points has no
    order.
    """
    m = len(pulse)
    if not m:
        none = np.empty(0, np.int64)
        return none, none, np.empty(0, bool)
    has_ray = np.any(direction != 0, axis=1)
    grouped = np.lexsort((~has_ray, pulse))
    is_first = np.append(True, pulse[grouped][1:] != pulse[grouped][:-1])
    group = np.empty(m, np.int64)
    group[grouped] = np.cumsum(is_first) - 1
    head = grouped[is_first][group]
    away = xyz - xyz[head]
    ray = direction[head]
    along = away[:, 0] * ray[:, 0] + away[:, 1] * ray[:, 1] + away[:, 2] * ray[:, 2]
    order = np.lexsort((along, group))
    number = np.empty(m, np.int64)
    number[order] = np.arange(m) - np.flatnonzero(is_first)[group[order]] + 1
    return number, np.bincount(group)[group], has_ray[head]
