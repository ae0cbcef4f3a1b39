"""Rays through a grid of voxels: which voxels they cross, when, and which part of a profile lies in each.

Used by the voxel tool. A voxel is named by its index (x, y, z), counted from the voxel that holds the origin of the
coordinates. Rays do not influence each other, bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

KEY_BITS = (23, 23, 18)
"""Bits of a key per axis: indices from -2^22 to 2^22 - 1 across, from -2^17 to 2^17 - 1 up and down."""

MOST_STEPS = 1 << 18
"""Voxels that a ray may cross per axis."""

TOUCH = 1e-6
"""Time [ns] below which a ray only touches a voxel at an edge: its part goes to the voxel before."""

AT_A_TIME = 1 << 16
"""Crossings that are sorted together, which bounds memory."""


class Crossings(NamedTuple):
    """Voxels that rays cross, sorted by ray, then time."""

    ray: np.ndarray
    """Number of the ray, int64 (m,)."""
    enter: np.ndarray
    """Time at which the ray enters the voxel, float64 (m,), ns."""
    inside: np.ndarray
    """Time for which it is inside, float64 (m,), ns."""
    index: np.ndarray
    """The voxel, int64 (m, 3)."""


def fits_keys(start: np.ndarray, step: np.ndarray, begin: np.ndarray, end: np.ndarray, size: float) -> np.ndarray:
    """Rays that stay where keys reach and cross at most MOST_STEPS voxels per axis.

    Parameters
    ----------
    start, step, begin, end, size
        As for `cross_voxels`; NaN is allowed.

    Returns
    -------
    bool (n,)
    """
    good = np.ones(len(start), bool)
    with np.errstate(over="ignore", invalid="ignore"):
        a, b = (np.floor((start + step * time[:, None]) / size) for time in (begin, end))
        for axis, bits in enumerate(KEY_BITS):
            limit = float(1 << (bits - 1)) - 1  # one voxel of margin
            # Comparisons with NaN are false, so that such rays are not good.
            good &= (np.abs(a[:, axis]) < limit) & (np.abs(b[:, axis]) < limit)
            good &= np.abs(b[:, axis] - a[:, axis]) <= MOST_STEPS
    return good


def cross_voxels(start: np.ndarray, step: np.ndarray, begin: np.ndarray, end: np.ndarray, size: float) -> Crossings:
    """The voxels that each ray crosses between two times.

    Parameters
    ----------
    start : float64 (n, 3), m
        Position at time 0.
    step : float64 (n, 3), m/ns
        Direction.
    begin, end : float64 (n,), ns
        First and last time. Rays must pass `fits_keys`.
    size : float, m
        Side of the voxels; they are half open: a point on a face belongs to the voxel above it.

    Returns
    -------
    Crossings
    """
    first, speed = start / size, step / size
    low = np.floor(first + speed * begin[:, None]).astype(np.int64)
    high = np.floor(first + speed * end[:, None]).astype(np.int64)
    count = np.abs(high - low)
    width = int(count.sum(axis=1).max(initial=0))
    times = np.empty((len(start), width + 2))
    times[:] = end[:, None]
    times[:, 0] = begin
    filled = np.ones(len(start), np.int64)
    for axis in range(3):
        number = count[:, axis]
        ray = np.repeat(np.arange(len(start)), number)
        rank = np.arange(len(ray)) - np.repeat(np.cumsum(number) - number, number)
        rising = speed[ray, axis] > 0
        plane = low[ray, axis] + np.where(rising, rank + 1, -rank)
        time = (plane - first[ray, axis]) / speed[ray, axis]
        times[ray, filled[ray] + rank] = np.clip(time, begin[ray], end[ray])
        filled += number
    times.sort(axis=1)
    inside = np.diff(times, axis=1)
    ray, place = np.nonzero(inside > TOUCH)
    enter, inside = times[ray, place], inside[ray, place]
    middle = enter + 0.5 * inside
    index = np.floor(first[ray] + speed[ray] * middle[:, None]).astype(np.int64)
    return Crossings(ray, enter, inside, index)


def split_rays(start: np.ndarray, step: np.ndarray, begin: np.ndarray, end: np.ndarray, size: float) -> list[slice]:
    """Slices of the rays that `cross_voxels` can handle at a time in bounded memory.

    Parameters
    ----------
    start, step, begin, end, size
        As for `cross_voxels`.

    Returns
    -------
    list of slice
    """
    number = 3 + (np.abs(step) * ((end - begin)[:, None] / size)).sum(axis=1)
    slices, at = [], 0
    most = np.maximum.accumulate(number)
    while at < len(start):
        if at:
            most = np.maximum.accumulate(number[at:])
        cost = most * np.arange(1, len(most) + 1)
        taken = max(int(np.searchsorted(cost, AT_A_TIME, side="right")), 1)
        slices.append(slice(at, at + taken))
        at += taken
    return slices


def pack_index(index: np.ndarray) -> np.ndarray:
    """Keys, uint64 (m,), of voxels int64 (m, 3), in the order of x, then y, then z."""
    key = np.zeros(len(index), np.uint64)
    for axis, bits in enumerate(KEY_BITS):
        key <<= np.uint64(bits)
        key |= (index[:, axis] + (1 << (bits - 1))).astype(np.uint64)
    return key


def unpack_index(key: np.ndarray) -> np.ndarray:
    """Voxels, int64 (m, 3), of keys uint64 (m,)."""
    index = np.empty((len(key), 3), np.int64)
    rest = key.copy()
    for axis in (2, 1, 0):
        bits = KEY_BITS[axis]
        index[:, axis] = (rest & np.uint64((1 << bits) - 1)).astype(np.int64) - (1 << (bits - 1))
        rest >>= np.uint64(bits)
    return index


def accumulate_profile(profile: np.ndarray) -> np.ndarray:
    """Sum of profiles (n, s) up to the end of each sample, float64 (n, s + 1), added in order of the samples."""
    total = np.zeros((profile.shape[0], profile.shape[1] + 1))
    np.cumsum(profile, axis=1, out=total[:, 1:])
    return total


def total_until(total: np.ndarray, ray: np.ndarray, time: np.ndarray, spacing: float) -> np.ndarray:
    """The part of each ray's profile before a time.

    Parameters
    ----------
    total : float64 (n, s + 1)
        From `accumulate_profile`.
    ray : int64 (m,)
        Number of the ray.
    time : float64 (m,), ns
        After sample 0.
    spacing : float, ns
        Time between two samples; each sample is spread evenly from half a spacing before it to half a spacing after it.

    Returns
    -------
    float64 (m,)
    """
    s = total.shape[1] - 1
    place = np.clip(time / spacing + 0.5, 0.0, s)
    sample = np.minimum(place.astype(np.int64), s - 1)
    flat = total.reshape(-1)
    at = ray * (s + 1) + sample
    before = flat[at]
    return before + (place - sample) * (flat[at + 1] - before)


def differences_along(values: np.ndarray, ray: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The part of each crossing, from sums at the entry of each voxel.

    Parameters
    ----------
    values : float64 (m,)
        Sums at the entry of each voxel, 0 at the first voxel of every ray.
    ray : int64 (m,)
        Number of the ray, ascending.
    last : float64 (n,)
        Sums of whole rays.

    Returns
    -------
    float64 (m,)
        The differences of a ray add up to its `last` exactly.
    """
    after = np.empty_like(values)
    after[:-1] = values[1:]
    ends = np.append(ray[1:] != ray[:-1], True)[: len(ray)]
    after[ends] = last[ray[ends]]
    return after - values
