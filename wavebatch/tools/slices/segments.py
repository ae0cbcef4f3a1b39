"""Cuts slices from scan lines and finds the straight segments of surfaces in them.

A slice is either a vertical plane, in metres, or an image of pulses by time. Lines are found by a Hough transform
(`kernels.geometry.hough`) of the samples above a threshold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.schema import Above, Range, check_options, option
from wavebatch.core.units import HALF_C
from wavebatch.kernels.geometry.hough import HoughLine, find_lines
from wavebatch.tools.slices.lines import ScanLine, align_times, find_main_axis

_POSITIVE = Above(0.0, math.inf)
_GAP, _PULSES_PER_GAP = 10.0, 3.0
"""Largest hole in a segment [pixels, pulses]: whichever is larger in a plane."""


@dataclass(frozen=True, slots=True)
class SliceOptions:
    """How slices are cut and searched."""

    geometry: Literal["plane", "time"] = option(
        "plane", "plane: slices are vertical planes; time: rows are pulses, columns times on one axis."
    )
    std: Annotated[float, _POSITIVE] = option(
        2.0, "Search samples above this many standard deviations of the slice, and above the noise.", form="STD"
    )
    sigma: Annotated[float, _POSITIVE] = option(
        2.0, "Standard deviation of the pulse [ns].", form="NS", unset="surveyed from the strip"
    )
    shortest: Annotated[float, _POSITIVE] = option(
        20.0, "Least length of a segment [pixels of one sample].", form="PIXELS"
    )
    most: Annotated[int, Range(1, math.inf)] = option(20, "Most segments per slice.", form="N")
    floor: float = 0.0
    """Samples up to this far above their level are not searched [DN]: the noise of the strip."""

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """A scan line with the coordinates of its m samples in the slice, in pixels."""

    line: ScanLine
    geometry: str
    x: np.ndarray
    """Plane: along the ground; time: sample, f8 (m,)."""
    y: np.ndarray
    """Plane: height; time: pulse, f8 (m,)."""
    pixel: float
    """Size of a pixel in x [m], or [ns]."""
    base: np.ndarray
    """Plane: the point (3,) at x = y = 0 [m]."""
    axis: np.ndarray
    """Plane: its horizontal direction (3,), of length 1."""
    roi: np.ndarray
    """Samples that are searched, bool (m,)."""
    start: np.ndarray
    """Time: where the first sample of each pulse lies on the common axis, f8 (n,) [ns]."""

    def locate(self, end: tuple[float, float]) -> tuple[float, float, float]:
        """Position in space of a point of the slice [m]."""
        if self.geometry == "plane":
            place = self.base + self.pixel * (end[0] * self.axis + np.array([0.0, 0.0, end[1]]))
        else:
            rows = np.arange(len(self.line))
            after = end[0] * self.pixel - self.start
            lines = self.line.origin + after[:, None] * self.line.direction
            place = np.array([np.interp(end[1], rows, lines[:, axis]) for axis in range(3)])
        x, y, z = place.tolist()
        return x, y, z

    def scale(self, end: tuple[float, float]) -> tuple[float, float]:
        """A point of the slice in the units of its axes: [m] and height [m], or time [ns] and pulse."""
        if self.geometry == "plane":
            return end[0] * self.pixel, float(self.base[2] + end[1] * self.pixel)
        return end[0] * self.pixel, end[1]


@dataclass(frozen=True, slots=True)
class Segment:
    """A straight piece of a surface in one slice."""

    line: int
    """Scan line."""
    segment: int
    """Number in the slice, from 0, the strongest first."""
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    """Ends in space [m]."""
    ends: tuple[tuple[float, float], tuple[float, float]]
    """Ends in the slice: [m] along it and height [m], or time [ns] and pulse."""
    length: float
    """Distance of the ends in space [m]."""
    slope: float
    """Angle above the horizontal, from start to end [deg]."""
    residual: float
    """Root mean square distance of the centroids of pulses from the line: across it [m], or along time [ns]."""
    pulses: int
    first_pulse: int
    last_pulse: int
    """Pulses of the scan line on the segment: number, first and last."""
    first_point: int
    """Index in the file of the first point of first_pulse."""
    theta: float
    rho: float
    """Normal form of the line in the slice [deg, pixels]."""
    weight: float
    """Sum of intensities [count]."""


def cut_slice(line: ScanLine, options: SliceOptions) -> Slice:
    """The slice of a scan line."""
    limit = np.float64(options.std) * line.value.std(dtype=np.float64)  # no float32 holds the largest --std
    limit = max(limit, options.floor)  # a slice of water and sky has lines of noise
    roi = line.value > limit
    zero, start = np.zeros(3), np.zeros(len(line))
    if options.geometry == "time":
        start = align_times(line.origin, line.direction)
        x, y = (line.time + start[line.row]) / line.spacing, line.row.astype(np.float64)
        pixel, base, axis = line.spacing, zero, zero
    else:
        pixel = line.spacing * HALF_C
        base, axis = _find_plane(line, roi)
        place = line.origin[line.row] - base + line.time[:, None] * line.direction[line.row]
        x, y = place @ axis / pixel, place[:, 2] / pixel
    return Slice(line, options.geometry, x, y, pixel, base, axis, roi, start)


def find_segments(piece: Slice, options: SliceOptions) -> list[Segment]:
    """The straight segments of a slice, the strongest first."""
    rows = np.flatnonzero(piece.roi)
    if len(rows) < 2:
        return []
    x, y = piece.x[rows], piece.y[rows]
    weight, sigma = piece.line.value[rows].astype(np.float64), options.sigma / piece.line.spacing
    gap = _choose_gap(piece)
    # A flat surface is no straight line over time, so bends mean ridges in a plane only.
    pulse = piece.line.row[rows] if piece.geometry == "plane" else None
    lines = find_lines(x, y, weight, sigma=sigma, gap=gap, shortest=options.shortest, most=options.most, pulse=pulse)
    return [_describe(piece, found, rows[found.rows], number) for number, found in enumerate(lines)]


def _find_plane(line: ScanLine, roi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point of the vertical plane and its direction: the main axis of the searched samples, seen from above."""
    use = np.flatnonzero(roi) if roi.any() else np.arange(len(line.row))
    place = line.origin[line.row[use]] + line.time[use, None] * line.direction[line.row[use]]
    base = place.mean(axis=0)
    return base, np.append(find_main_axis(place[:, :2] - base[:2]), 0.0)


def _choose_gap(piece: Slice) -> float:
    """Largest hole in a segment [pixels]: ten, or three pulses if they lie farther apart."""
    if piece.geometry == "time":
        return _GAP
    step = np.diff(piece.line.origin @ piece.axis) / piece.pixel
    return max(_GAP, _PULSES_PER_GAP * float(np.median(np.abs(step))))


def _describe(piece: Slice, found: HoughLine, rows: np.ndarray, number: int) -> Segment:
    line = piece.line
    start, end = piece.locate(found.start), piece.locate(found.end)
    apart = np.subtract(end, start)
    pulses = np.unique(line.row[rows])
    return Segment(
        line=line.number,
        segment=number,
        start=start,
        end=end,
        ends=(piece.scale(found.start), piece.scale(found.end)),
        length=float(np.linalg.norm(apart)),
        slope=float(np.degrees(np.arctan2(apart[2], np.hypot(apart[0], apart[1])))),
        residual=_measure_residual(piece, found, rows),
        pulses=len(pulses),
        first_pulse=int(pulses[0]),
        last_pulse=int(pulses[-1]),
        first_point=int(line.point[pulses[0]]),
        theta=found.theta,
        rho=found.rho,
        weight=found.weight,
    )


def _measure_residual(piece: Slice, found: HoughLine, rows: np.ndarray) -> float:
    """Spread of the centroids of pulses about the line, so that the width of a pulse does not count."""
    theta = np.radians(found.theta)
    off = piece.x[rows] * np.cos(theta) + piece.y[rows] * np.sin(theta) - found.rho
    if piece.geometry == "time":
        off = off / max(np.cos(theta), 1e-9)
    weight = piece.line.value[rows].astype(np.float64)
    sums = np.bincount(piece.line.row[rows], weight)
    moments = np.bincount(piece.line.row[rows], weight * off)
    centroid = moments[sums > 0] / sums[sums > 0]
    return float(np.sqrt(np.mean(centroid**2)) * piece.pixel)
