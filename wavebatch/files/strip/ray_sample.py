"""Rays sampled along a strip: a few points of each unit with times and directions.

`surveying/sensor.py` finds the positions of the sensor from them. The sample is the same every time and bounded, for
strips of any size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.core.order import even_places, quantile
from wavebatch.core.units import HALF_C, PS_PER_NS
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.las.header import locate
from wavebatch.files.strip.packet_check import read_toward
from wavebatch.files.strip.reader import StripReader, StripScan

MOST_SLICES = 4096
"""Most places of a strip at which rays are read."""

SLICE_POINTS, RAYS_PER_SLICE = 2048, 256
"""Points read at one place, and rays kept of them."""

SLICE_SECONDS = 0.5
"""Time [s] after which another place of the same unit is read: an aircraft moves 30 m in it."""

SCALE_PLACES = 16
"""Most places at which distances of returns are compared with their times."""

LEAST_PAIRS, SCALE_SPREAD = 20, 0.05
"""Fewest pairs of returns that show the unit of coordinates, and largest relative distance of their quartiles."""

_SLICES_PER_UNIT = 4
_LEAST_RATIO, _LARGEST_RATIO = 0.3, 3.0
"""Vectors with other lengths over c/2 are no directions."""
_LEAST_PAIR = 2.0
"""Least distance of two returns [m] that give a direction: returns are placed to a few cm."""


class RaySample(NamedTuple):
    """n rays in order of time."""

    time: np.ndarray
    """f8 (n,) [s]."""
    point: np.ndarray
    """Position of the echo, f8 (n, 3) [m]."""
    direction: np.ndarray
    """Away from the sensor, any length, f8 (n, 3)."""
    weight: np.ndarray
    """Relative weight (inverse variance) of the direction, f8 (n,)."""


def sample_rays(reader: StripReader, scan: StripScan) -> tuple[RaySample, RaySample]:
    """Return the rays of a strip from packet vectors, and those from pulses with two returns.

    At most RAYS_PER_SLICE rays at each of about MOST_SLICES places.
    """
    kept, pairs = [], []

    def take(start: int, stop: int) -> float:
        points = reader.read_points(start, stop)
        xyz, time = locate(points, reader.facts.header), widen_integers(points["gps_time"])
        pairs.append(_pair_returns(xyz, time))
        rows = np.arange(0, len(points), max(1, len(points) // RAYS_PER_SLICE))
        kept.append(_read_vectors(points[rows], xyz[rows], time[rows], scan))
        return float(time[0])

    units = _choose_units(scan)
    starts = [take(start, min(start + SLICE_POINTS, stop)) for start, stop in units]
    if units:
        end = units[-1][1]
        starts.append(take(max(units[-1][0], end - SLICE_POINTS), end))
    share = min(_SLICES_PER_UNIT, MOST_SLICES // max(len(units), 1))
    for (start, stop), begin, until in zip(units, starts, starts[1:], strict=False):
        seconds = abs(until - begin)
        number = int(np.clip(np.ceil(seconds / SLICE_SECONDS), 1, share)) if np.isfinite(seconds) else share
        for edge in (start + np.arange(1, number) * ((stop - start) // number)).tolist():
            take(edge, min(edge + SLICE_POINTS, stop))
    return _join(kept), _join(pairs)


def measure_scale(reader: StripReader, scan: StripScan) -> float | None:
    """Distance of returns of one pulse by their coordinates over that by their times in the packet.

    1 where coordinates and packet vectors have the same unit. From up to SCALE_PLACES places of the strip; None where
    fewer than LEAST_PAIRS pairs of returns, or pairs that do not agree, show it.
    """
    ratios = [np.empty(0)]
    units = _choose_units(scan)
    for start, stop in units[:: max(1, -(-len(units) // SCALE_PLACES))]:
        points = reader.read_points(start, min(start + SLICE_POINTS, stop))
        xyz, time = locate(points, reader.facts.header), widen_integers(points["gps_time"])
        with np.errstate(all="ignore"):
            vectors = read_toward(points, scan.vectors.direction, scan.vectors.form)
            place = widen_integers(points["return_point_wave_location"])
            same = (time[1:] == time[:-1]) & (points["wavepacket_offset"][1:] == points["wavepacket_offset"][:-1])
            by_time = np.abs(np.diff(place)) * np.sqrt((vectors[1:] ** 2).sum(axis=1))
            apart = np.sqrt((np.diff(xyz, axis=0) ** 2).sum(axis=1))
            good = same & (points["wavepacket_index"][1:] > 0) & (by_time > _LEAST_PAIR) & np.isfinite(apart)
            ratios.append((apart / by_time)[good])
    ratio = np.concatenate(ratios)
    if len(ratio) < LEAST_PAIRS:
        return None
    low, middle, high = (quantile(ratio, share) for share in (0.25, 0.5, 0.75))
    return middle if high - low < SCALE_SPREAD * middle else None


def _choose_units(scan: StripScan) -> list[tuple[int, int]]:
    """Units [start, stop) all over the strip, at most MOST_SLICES of them."""
    borders = scan.borders
    chosen = even_places(len(borders) - 1, MOST_SLICES)
    return [(int(borders[i]), int(borders[i + 1])) for i in chosen.tolist() if borders[i + 1] > borders[i]]


def _read_vectors(points: np.ndarray, xyz: np.ndarray, time: np.ndarray, scan: StripScan) -> RaySample:
    with np.errstate(all="ignore"):
        away = -read_toward(points, scan.vectors.direction, scan.vectors.form)
        ratio = np.sqrt((away * away).sum(axis=1)) * (PS_PER_NS / HALF_C)
        good = (points["wavepacket_index"] > 0) & (ratio > _LEAST_RATIO) & (ratio < _LARGEST_RATIO)
    good &= np.isfinite(time) & np.isfinite(xyz).all(axis=1)
    rows = np.flatnonzero(good)
    return RaySample(time[rows], xyz[rows], away[rows], np.ones(len(rows)))


def _pair_returns(xyz: np.ndarray, time: np.ndarray) -> RaySample:
    """Rays from neighbouring returns of one pulse; returns far apart get a large weight."""
    place = np.flatnonzero(time[1:] == time[:-1])
    apart = xyz[place + 1] - xyz[place]
    square = (apart * apart).sum(axis=1)
    far = np.flatnonzero(np.isfinite(square) & (square > _LEAST_PAIR**2))[:RAYS_PER_SLICE]
    middle = 0.5 * (xyz[place[far]] + xyz[place[far] + 1])
    return RaySample(time[place[far]], middle, apart[far], square[far])


def _join(parts: list[RaySample]) -> RaySample:
    if not parts:
        return RaySample(np.empty(0), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    joined = [np.concatenate(values) for values in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return RaySample(*(values[order] for values in joined))
