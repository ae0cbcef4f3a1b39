"""Whether the points around a place are one plane or two: a ridge, a valley, a step.

Used by `normals`. The plane through both sides of a shallow ridge leaves so little that none of its points is an
outlier, but its angle is that of neither side. So each neighbourhood is cut in two through its middle, in six
directions, and planes through the two halves are compared with the plane through both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.geometry.planes import LEAST_SPREAD, Planes

CUTS = 6
"""Directions in which a neighbourhood is cut: a ridge is at most 15 degrees off one of them."""

LEAST_IN_HALF = 4
"""Smallest number of points of a half: three are always in a plane."""

SURE, DOUBTFUL = 0.05, 0.2
"""Chances below which a neighbourhood counts as two planes, and above which as one. With lower ones, ridges of a dozen
points keep errors that are too small; with higher ones, the errors of single planes grow."""

_SECTORS = 2 * CUTS
_SINGULAR = 1e-6
"""Points of a half whose variances differ by more than this are in line: they have no plane."""


class Halves(NamedTuple):
    """The cut of each neighbourhood whose two planes fit best."""

    chance: np.ndarray
    """Chance that one plane with noise shows two planes that fit so much better, float64 (n,); 1 without a cut."""
    tilts: np.ndarray
    """Slopes of the plane of each half against the plane of all, along its longer and its shorter axis, float64
    (n, 2, 2); 0 without a cut."""


def compare_halves(offset: np.ndarray, point: np.ndarray, planes: Planes) -> Halves:
    """Fit planes to both halves of neighbourhoods, and judge whether they fit better than one.

    Parameters
    ----------
    offset : float64 (k, 3), m
        From the middle of a neighbourhood to its points.
    point : int64 (k,)
        Number of the neighbourhood, ascending.
    planes : Planes
        n planes through the neighbourhoods; points beyond their limits do not count.

    Returns
    -------
    Halves

    Notes
    -----
    An F test of the sums of squares, three parameters against six; the chance is that of the best of six cuts
    (docs/algorithms.md 1.4). A half without a plane (fewer than four points, or in line) makes its cut impossible.
    """
    n = len(planes.kept)
    flat = [_project(offset, planes.axes[:, :, axis], point) for axis in (2, 1, 0)]
    flat[2] -= np.einsum("ni,ni->n", planes.centre, planes.normal)[point]
    near = np.abs(flat[2]) <= planes.limit[point]
    u, v, r = (part[near] for part in flat)
    sector = ((np.arctan2(v, u) + np.pi) * (_SECTORS / (2 * np.pi))).astype(np.int64) % _SECTORS
    cell = point[near] * _SECTORS + sector
    sums = np.empty((n * _SECTORS, 9))
    sums[:, 0] = np.bincount(cell, minlength=len(sums))
    for number, values in enumerate((u, v, r, u * u, u * v, v * v, u * r, v * r), 1):
        sums[:, number] = np.bincount(cell, values, minlength=len(sums))
    squares = np.bincount(point[near], r * r, minlength=n)
    return _choose_cut(sums.reshape(n, _SECTORS, 9), squares)


def misfit_of_angles(halves: Halves, planes: Planes, ray: np.ndarray) -> np.ndarray:
    """How far angles between rays and planes may be off because the points are two planes.

    Parameters
    ----------
    halves : Halves
    planes : Planes
        n planes.
    ray : float64 (n, 3)
        Unit vectors.

    Returns
    -------
    float64 (n,), rad
        The larger difference to the angles of the two halves; less of it where their chance lies between SURE and
        DOUBTFUL, nothing above.
    """
    facing, short, long = (np.einsum("ni,ni->n", ray, planes.axes[:, :, axis]) for axis in range(3))
    angle = _angle_of(facing)
    off = np.zeros(len(ray))
    for b, c in (halves.tilts[:, side].T for side in range(2)):
        off = np.maximum(off, np.abs(_angle_of((facing - b * long - c * short) / np.sqrt(1.0 + b * b + c * c)) - angle))
    with np.errstate(divide="ignore"):
        share = (np.log(DOUBTFUL) - np.log(halves.chance)) / np.log(DOUBTFUL / SURE)
    return off * np.sqrt(np.clip(share, 0.0, 1.0))


def _angle_of(cosine: np.ndarray) -> np.ndarray:
    return np.arccos(np.minimum(np.abs(cosine), 1.0))


def _project(offset: np.ndarray, axis: np.ndarray, point: np.ndarray) -> np.ndarray:
    return offset[:, 0] * axis[point, 0] + offset[:, 1] * axis[point, 1] + offset[:, 2] * axis[point, 2]


def _choose_cut(sums: np.ndarray, squares: np.ndarray) -> Halves:
    """The best cut from sums over sectors (n, 12, 9) and the sums of squared distances (n,)."""
    ring = np.concatenate([sums, sums[:, : CUTS - 1]], axis=1)
    window = np.stack([ring[:, start : start + CUTS].sum(axis=1) for start in range(_SECTORS)], axis=1)
    explained, tilts = _fit(window)
    both = explained[:, :CUTS] + explained[:, CUTS:]
    whole, _ = _fit(window[:, 0] + window[:, CUTS])
    count = sums[:, :, 0].sum(axis=1)
    rows = np.arange(len(sums))
    best = np.argmax(both, axis=1)
    known = np.isfinite(both[rows, best]) & np.isfinite(whole) & (count > 6)
    both, whole = np.where(known, both[rows, best], 0.0), np.where(known, whole, 0.0)
    left = np.maximum(squares - both, 0.0) + count * LEAST_SPREAD**2
    freedom = np.maximum(count - 6.0, 1.0)
    ratio = np.maximum(both - whole, 0.0) / 3.0 * freedom / np.maximum(left, LEAST_SPREAD**2)
    import scipy.special  # here, because most runs need none of it

    chance = scipy.special.fdtrc(3.0, freedom, ratio)
    chance = np.where(known, np.minimum(CUTS * chance, 1.0), 1.0)
    pair = np.stack([tilts[rows, best], tilts[rows, best + CUTS]], axis=1)
    return Halves(chance, np.where(known[:, None, None], pair, 0.0))


def _fit(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a plane r = a + b u + c v explains of the squares of r, (...,), -inf without a plane; b and c (..., 2)."""
    number, u, v, r, uu, uv, vv, ur, vr = np.moveaxis(sums, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        uu, uv, vv = uu - u * u / number, uv - u * v / number, vv - v * v / number
        ur, vr = ur - u * r / number, vr - v * r / number
        size = uu * vv - uv * uv
        b, c = (ur * vv - vr * uv) / size, (vr * uu - ur * uv) / size
        explained = r * r / number + b * ur + c * vr
        known = (number >= LEAST_IN_HALF) & (size > _SINGULAR * (uu + vv) ** 2)
    return np.where(known, explained, -np.inf), np.stack([b, c], axis=-1)
