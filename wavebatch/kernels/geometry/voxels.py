"""Rays through a grid of voxels: which voxels they cross, when, and which part of a profile lies in each.

Used by the voxel tool. A voxel is named by its index (x, y, z), counted from the voxel that holds the origin of the
coordinates. Rays do not influence each other, bit for bit.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.frozen import NamedTuple

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
    voxel: np.ndarray
    """The voxel, int64 (m, 3)."""


class VoxelSamples(NamedTuple):
    """Samples with signal along rays, ray after ray, each in the order of time."""

    time: np.ndarray
    """Middle of the sample, float64 (m,), ns."""
    spacing: np.ndarray
    """Time that it spans, float64 (m,), ns."""
    value: np.ndarray
    """What is summed, in units so small that whole numbers do: sums then depend on no order. int64 (m, k)."""


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


def split_rays(
    start: np.ndarray, step: np.ndarray, begin: np.ndarray, end: np.ndarray, size: float, crossings: int | None = None
) -> list[slice]:
    """Slices of the rays that `cross_voxels` can handle at a time in bounded memory.

    Parameters
    ----------
    start, step, begin, end, size
        As for `cross_voxels`.
    crossings : int or None
        Most of a slice of several rays; None: AT_A_TIME.

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
        taken = max(int(np.searchsorted(cost, crossings or AT_A_TIME, side="right")), 1)
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


def sum_before(
    samples: VoxelSamples, first: np.ndarray, count: np.ndarray, ray: np.ndarray, time: np.ndarray
) -> np.ndarray:
    """Sums of the samples of each ray up to given times.

    Parameters
    ----------
    samples : Samples
        Of all rays, ray after ray, in the order of time.
    first, count : int64 (n,)
        The samples of each ray.
    ray : int64 (m,)
        Number of the ray.
    time : float64 (m,), ns

    Returns
    -------
    int64 (m, k)
        A sample counts evenly from half its spacing before its time to half its spacing after it.
    """
    edge = samples.time - 0.5 * samples.spacing
    low, high = first[ray], first[ray] + count[ray]
    base = low
    # Bisection: the number of samples of the ray that begin before the time.
    for _ in range(int(count.max(initial=0)).bit_length()):
        middle = (low + high) // 2
        right = (low < high) & (edge[np.minimum(middle, len(edge) - 1)] < time)
        low, high = np.where(right, middle + 1, low), np.where(right, high, np.minimum(middle, high))
    total = np.zeros((len(samples.value) + 1, samples.value.shape[1]), np.int64)
    np.cumsum(samples.value, axis=0, out=total[1:])
    sums = total[low] - total[base]
    begun = np.flatnonzero(low > base)
    last = low[begun] - 1
    after = np.clip(1.0 - (time[begun] - edge[last]) / samples.spacing[last], 0.0, 1.0)
    sums[begun] -= np.rint(samples.value[last] * after[:, None]).astype(np.int64)
    return sums


def differences_along(values: np.ndarray, ray: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The part of each crossing, from sums at the entry of each voxel.

    Parameters
    ----------
    values : int64 (m, k)
        Sums at the entry of each voxel, 0 at the first voxel of every ray.
    ray : int64 (m,)
        Number of the ray, ascending.
    last : int64 (n, k)
        Sums of whole rays.

    Returns
    -------
    int64 (m, k)
        The differences of a ray add up to its `last` exactly.
    """
    after = np.empty_like(values)
    after[:-1] = values[1:]
    ends = np.append(ray[1:] != ray[:-1], True)[: len(ray)]
    after[ends] = last[ray[ends]]
    return after - values
