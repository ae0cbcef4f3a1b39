"""Rays sampled along a strip: a few points of every unit, with their times and where they came from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.io.direction import read_toward
from wavebatch.io.rawbytes import widen
from wavebatch.io.scanner import locate
from wavebatch.io.strip import StripReader, StripScan
from wavebatch.units import HALF_C, PS_PER_NS

MOST_SLICES = 4096
"""Places of a strip at which rays are taken."""

SLICE_POINTS, RAYS_PER_SLICE = 2048, 256
"""Points read at a place, and rays kept of them."""

SLICE_SECONDS = 0.1
"""Time after which another place of the same unit is looked at."""

_SLICES_PER_UNIT = 4
_LEAST_RATIO, _LARGEST_RATIO = 0.3, 3.0
_LEAST_PAIR = 2.0


class Rays(NamedTuple):
    """n rays, ordered by time."""

    time: np.ndarray
    """f8 (n,) [s]."""
    point: np.ndarray
    """Where they struck, f8 (n, 3) [m]."""
    direction: np.ndarray
    """Away from the sensor, any length, f8 (n, 3)."""
    weight: np.ndarray
    """Inverse variance of the direction, relative, f8 (n,)."""


def sample_rays(reader: StripReader, scan: StripScan) -> tuple[Rays, Rays]:
    """Rays of a strip from its packets' vectors, and from pulses with two returns; the same ones every time.

    No more than a few hundred rays at no more than MOST_SLICES places: bounded memory whatever the strip's size.
    """
    kept, pairs = [], []
    for start, stop in _places(reader, scan):
        points = reader.read_points(start, stop)
        xyz, time = locate(points, reader.facts), widen(points["gps_time"])
        pairs.append(_pair_returns(xyz, time))
        rows = np.arange(0, len(points), max(1, len(points) // RAYS_PER_SLICE))
        kept.append(_read_vectors(points[rows], xyz[rows], time[rows], scan))
    return _join(kept), _join(pairs)


def _places(reader: StripReader, scan: StripScan) -> list[tuple[int, int]]:
    """Stretches of points [start, stop): one per unit and more where a unit takes long, all over the strip."""
    borders = scan.borders
    units = np.unique(np.linspace(0, len(borders) - 2, min(len(borders) - 1, MOST_SLICES)).round().astype(int))
    if not scan.points or not len(units):
        return []
    share = max(1, min(_SLICES_PER_UNIT, MOST_SLICES // len(units)))
    places = []
    for unit in units.tolist():
        start, stop = int(borders[unit]), int(borders[unit + 1])
        if stop <= start:
            continue
        first = widen(reader.read_points(start, start + 1)["gps_time"])[0]
        last = widen(reader.read_points(stop - 1, stop)["gps_time"])[0] if share > 1 else first
        seconds = abs(last - first)
        number = int(np.clip(np.ceil(seconds / SLICE_SECONDS), 1, share)) if np.isfinite(seconds) else share
        edges = start + np.arange(number) * ((stop - start) // number)
        places += [(int(edge), min(int(edge) + SLICE_POINTS, stop)) for edge in edges]
    end = int(borders[-1])
    return [*places, (max(places[-1][1], end - SLICE_POINTS), end)] if places and places[-1][1] < end else places


def _read_vectors(points: np.ndarray, xyz: np.ndarray, time: np.ndarray, scan: StripScan) -> Rays:
    with np.errstate(all="ignore"):
        away = -read_toward(points, scan.direction, scan.vector_form)
        ratio = np.sqrt((away * away).sum(axis=1)) * (PS_PER_NS / HALF_C)
        good = (points["wavepacket_index"] > 0) & (ratio > _LEAST_RATIO) & (ratio < _LARGEST_RATIO)
    good &= np.isfinite(time) & np.isfinite(xyz).all(axis=1)
    rows = np.flatnonzero(good)
    return Rays(time[rows], xyz[rows], away[rows], np.ones(len(rows)))


def _pair_returns(xyz: np.ndarray, time: np.ndarray) -> Rays:
    """Returns of one pulse that follow each other in the file: the farther apart, the better."""
    place = np.flatnonzero(time[1:] == time[:-1])
    apart = xyz[place + 1] - xyz[place]
    square = (apart * apart).sum(axis=1)
    far = np.flatnonzero(np.isfinite(square) & (square > _LEAST_PAIR**2))[:RAYS_PER_SLICE]
    middle = 0.5 * (xyz[place[far]] + xyz[place[far] + 1])
    return Rays(time[place[far]], middle, apart[far], square[far])


def _join(parts: list[Rays]) -> Rays:
    if not parts:
        return Rays(np.empty(0), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    joined = [np.concatenate(values) for values in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return Rays(*(values[order] for values in joined))
