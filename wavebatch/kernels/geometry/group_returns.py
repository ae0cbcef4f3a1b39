"""Points, pulses and returns, which belong together: the writer of clouds, positions, voxels and the simulator call it.

Which points are one pulse, which return is nearest to an echo, and return numbers along the ray: nothing here may
depend on other pulses than that of the point. `match_returns` pairs echoes and returns of a whole block, one to one,
nearest in time (kernels/c/returns.h). `fit_rays` gives the rays of discrete returns: where each pulse came from.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from typing import Any

import numpy as np

from wavebatch.core.units import MAD_TO_STD
from wavebatch.kernels import library
from wavebatch.kernels.library import call

LONGEST_PULSE = 64
"""From this many points of equal GPS time on, the time is a constant and not that of one pulse."""


def find_pulses(gps_time: np.ndarray) -> np.ndarray:
    """First point of the pulse that each point belongs to.

    A pulse is a run of points of equal time. Where the time is 0, or the same for LONGEST_PULSE points or more, each
    point is a pulse.

    Parameters
    ----------
    gps_time : float64 (n,), s
        In the order of the file.

    Returns
    -------
    int64 (n,)
    """
    time = np.ascontiguousarray(gps_time, np.float64)
    first = np.empty(len(time), np.int64)
    call("find_pulses", ctypes.c_int64(len(time)), time, ctypes.c_int64(LONGEST_PULSE), first)
    return first


ALIGNED = 1e-4
"""Largest difference of the directions of a pulse's packets [rad]: they differ by 6e-6 on real strips, those of pulses
that follow each other by 2e-4 and more."""

BESIDE = 0.1
"""Largest distance between the rays of a pulse's packets [m]: coordinates are rounded to centimetres, and footprints
are wider."""


def group_times(gps_time: np.ndarray) -> np.ndarray:
    """First packet of equal GPS time, of each packet, wherever it stands.

    Where the time is 0 or not a number, or the same for LONGEST_PULSE packets or more, each packet is alone.

    Parameters
    ----------
    gps_time : float64 (n,), s

    Returns
    -------
    int64 (n,)
    """
    time = np.nan_to_num(gps_time, nan=0.0)
    _, first, group, count = np.unique(time, return_index=True, return_inverse=True, return_counts=True)
    alone = (count >= LONGEST_PULSE)[group] | (time == 0)
    return np.where(alone, np.arange(len(time)), first[group])


def find_rays(group: np.ndarray, scanner: np.ndarray, start: np.ndarray, step: np.ndarray) -> np.ndarray:
    """First packet of the pulse that each packet belongs to: of equal time, from one scanner, and on one line.

    Parameters
    ----------
    group : int64 (n,)
        Equal for packets of equal time.
    scanner : int (n,)
    start, step : float64 (n, 3), m, m/ns
        A position on each ray, and its direction.

    Returns
    -------
    int64 (n,)
    """
    ray, left = np.arange(len(group)), np.lexsort((scanner, group))
    while len(left):
        new = np.append(True, (np.diff(group[left]) != 0) | (np.diff(scanner[left]) != 0))
        head = left[np.flatnonzero(new)[np.cumsum(new) - 1]]
        turn = step[left] - step[head]
        same = (turn * turn).sum(axis=1) <= ALIGNED**2 * (step[head] * step[head]).sum(axis=1)
        same = (same & on_ray(start[left], start[head], step[head])) | (left == head)
        ray[left[same]] = head[same]
        left = left[~same]
    return ray


def along_ray(place: np.ndarray, start: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Time (n,) [ns] at which rays from `start` pass nearest to positions (n, 3); NaN for rays without direction."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return ((place - start) * step).sum(axis=1) / (step * step).sum(axis=1)


def on_ray(place: np.ndarray, start: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Whether positions (n, 3) lie on the rays, bool (n,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        way = step * along_ray(place, start, step)[:, None]
        off = place - start - way
        allowed = BESIDE + ALIGNED * np.sqrt((way * way).sum(axis=1))
        return (off * off).sum(axis=1) <= allowed**2


def find_nearest(
    echo_waveform: np.ndarray, echo_time: np.ndarray, return_waveform: np.ndarray, return_time: np.ndarray
) -> np.ndarray:
    """The return of the same waveform that is nearest in time to each echo.

    Parameters
    ----------
    echo_waveform, echo_time : int (m,), float (m,)
        Waveform of each echo, and its time.
    return_waveform, return_time : int (k,), float (k,)
        The same of each return; time in the same unit.

    Returns
    -------
    int64 (m,)
        Row of the return, -1 without one; of two equally near ones the earlier.
    """
    echo_order, echo_waveform, echo_time = _by_group(echo_waveform, echo_time)
    return_order, return_waveform, return_time = _by_group(return_waveform, return_time)
    m, k = ctypes.c_int64(len(echo_waveform)), ctypes.c_int64(len(return_waveform))
    row = np.empty(m.value, np.int64)
    call("find_nearest", m, echo_waveform, echo_time, k, return_waveform, return_time, row)
    if return_order is not None:
        row = np.where(row >= 0, np.append(return_order, -1)[row], -1)
    (row,) = _put_back(echo_order, row)
    return row


def _by_group(group: np.ndarray, *columns: np.ndarray) -> tuple[Any, ...]:
    """The order that sorts rows by group, None where they are; the group, int64, and float64 columns in that order."""
    order = np.argsort(group, kind="stable") if np.any(group[1:] < group[:-1]) else slice(None)
    given = [np.ascontiguousarray(column[order], np.float64) for column in columns]
    if any(len(column) != len(group) for column in given):
        raise ValueError("columns of points or echoes differ in length")
    return None if isinstance(order, slice) else order, np.ascontiguousarray(group[order], np.int64), *given


def _put_back(order: np.ndarray | None, *columns: np.ndarray) -> Iterator[np.ndarray]:
    """Columns of rows in the order that they had before `_by_group`."""
    for column in columns:
        if order is not None:
            column[order] = column.copy()
        yield column


def number_returns(
    pulse: np.ndarray, xyz: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return numbers by the order along the ray of the pulse.

    Parameters
    ----------
    pulse : int (m,)
        Equal for the points of a pulse.
    xyz : float64 (m, 3), m
        Positions.
    direction : float (m, 3)
        Away from the sensor; zeros for points whose ray is not known.

    Returns
    -------
    number, count : int64 (m,)
        Return number and number of returns.
    ordered : bool (m,)
        False for pulses without a ray: their numbers mean nothing.
    """
    order, pulse, xyz, direction = _by_group(pulse, xyz, direction)
    m = len(pulse)
    if xyz.shape != (m, 3) or direction.shape != (m, 3):
        raise ValueError("positions and directions have three columns")
    number, count, ordered = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m, np.bool_)
    call("number_returns", ctypes.c_int64(m), pulse, xyz, direction, number, count, ordered)
    number, count, ordered = _put_back(order, number, count, ordered)
    return number, count, ordered


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


def share_offsets(
    n: int, waveform: np.ndarray, time: np.ndarray, error: np.ndarray, match: np.ndarray, return_time: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offset of fitted times from return locations, which all returns of a waveform share.

    Parameters
    ----------
    n : int
        Number of waveforms.
    waveform, time, error : int (m,), float (m,), float (m,), ns
        Echoes, sorted by waveform; an error that is no number counts as 1.
    match : int64 (m,)
        Row of each echo's return, -1 without one.
    return_time : float64 (k,), ns

    Returns
    -------
    offset : float64 (n,), ns
        Weighted by the errors.
    doubt : float64 (n,), ns
        Its error by the scatter of the returns; 0 where their errors explain it, and for single returns.
    known : bool (n,)
        Where a return is matched; elsewhere both are 0.
    """
    waveform, match = (np.ascontiguousarray(rows, np.int64) for rows in (waveform, match))
    time, error, return_time = (np.ascontiguousarray(part, np.float64) for part in (time, error, return_time))
    if not len(waveform) == len(time) == len(error) == len(match):
        raise ValueError("columns of echoes differ in length")
    if len(match) and not (match.max() < len(return_time) and 0 <= waveform.min() <= waveform.max() < n):
        raise ValueError("an echo has no return or waveform of this number")
    found = np.zeros(n), np.zeros(n), np.zeros(n, np.bool_)
    offsets = library.COffsets(*map(library.address, found))
    call("share_offsets", ctypes.c_int64(len(time)), waveform, time, error, match, return_time, offsets)
    return found


OWN = 0.5
"""Pulses whose first and last return are at least this far apart [m] have their own direction."""
_SURE = 2.0
"""Distance of first and last return [m] from which a direction is good enough to fit those of other pulses."""
_ENOUGH = 20
"""Smallest number of such pulses in a flight line."""
_CLIP = 4.0
"""Residuals above this many robust standard deviations are outliers."""


def group_pulses(time: np.ndarray, number: np.ndarray) -> np.ndarray:
    """First point of every pulse: a pulse is a row of points of equal time whose return numbers rise.

    Parameters
    ----------
    time, number : float (n,), int (n,)
        GPS time and return number, in the order of the file.

    Returns
    -------
    int64 (k,)
    """
    new = (time[1:] != time[:-1]) | (number[1:] <= number[:-1])
    return np.flatnonzero(np.append(True, new)[: len(time)])


def fit_rays(xyz: np.ndarray, starts: np.ndarray, angle: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Direction of each pulse, away from the sensor.

    From the first to the last return where these are OWN apart. For other pulses a direction that is linear in the
    tangent of the scan angle, fitted to the pulses of the same flight line with known directions; straight down where
    fewer than 20 are.

    Parameters
    ----------
    xyz : float64 (n, 3), m
        In order of range within a pulse.
    starts : int64 (k,)
        First point of each pulse.
    angle : float (n,), deg
        Scan angle.
    source : int (n,)
        Flight line.

    Returns
    -------
    float64 (k, 3)
        Unit vectors.
    """
    last = np.append(starts[1:], len(xyz)) - 1
    span = xyz[last] - xyz[starts]
    length = np.linalg.norm(span, axis=1)
    rays = np.tile([0.0, 0.0, -1.0], (len(starts), 1))
    tangent = np.tan(np.radians(np.clip(angle[starts], -80, 80)))
    for line in np.unique(source[starts]).tolist():
        rows = np.flatnonzero(source[starts] == line)
        down = -span[rows, 2]
        sure = (length[rows] >= _SURE) & (down > 0.3 * length[rows])
        if np.count_nonzero(sure) >= _ENOUGH:
            slopes = span[rows[sure], :2] / down[sure, None]
            terms = np.stack([np.ones(len(slopes)), tangent[rows[sure]]], axis=1)
            use = np.ones(len(slopes), bool)
            for _ in range(3):  # outliers are clipped twice
                factors = np.linalg.lstsq(terms[use], slopes[use], rcond=None)[0]
                off = np.linalg.norm(slopes - terms @ factors, axis=1)
                use = off <= _CLIP * max(MAD_TO_STD * float(np.median(off)), 1e-6)
            rays[rows, :2] = factors[0] + tangent[rows, None] * factors[1]
    own = length >= OWN
    rays[own] = span[own]
    return rays / np.linalg.norm(rays, axis=1)[:, None]
