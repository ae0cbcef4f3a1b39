"""Reads a strip scan line by scan line, cuts slices from the lines and finds straight segments of surfaces in them.

A line ends where the scan angle turns or jumps back, or at a pause. Pulses must be in the order of time. The last line
of a unit is joined with the next unit, so that no line is cut between units. A slice is either a vertical plane, in
metres, or an image of pulses by time. Segments are found by a Hough transform of the samples
above a threshold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import join_ranges
from wavebatch.core.schema import Above, CheckedOptions, Range, option
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.geometry.group_returns import find_pulses
from wavebatch.kernels.geometry.slice_lines import find_lines, find_sweeps

LEAST_PULSES = 8
"""Shorter lines are left out: they hold no surface to find."""
MOST_PULSES = 16_384
"""Longer lines are cut: without a moving mirror, a strip would be one line and memory would not be bounded."""
MOST_SAMPLES = 1 << 23
"""Lines of more samples are cut, too: a slice takes up to 100 bytes for each."""
_BLOCK = 4096
_SAME_RAY = 1e-4
"""Largest relative difference of the directions of two waveforms of one pulse: they are in single precision. Pulses
whose times are rounded to the same lie at least 10 cm apart at 1 km."""
_FLOOR = 0.25
"""Quantile of a waveform that is used as its level without signal: signal fills less than three quarters."""


_PULSE = np.dtype([
    ("point", "<i8"), ("gps_time", "<f8"), ("origin", "<f8", (3,)), ("direction", "<f8", (3,)),
    ("spacing", "<f8"), ("count", "<i8"),
])  # fmt: skip
"""A pulse, or first one of its waveforms; `count` samples of it lie one after the other."""
_SAMPLE = np.dtype([("time", "<f8"), ("value", "<f4")])
"""A sample: its time after sample 0 [ns], and what it is above the level without signal [count]."""


@frozen(eq=False)
class ScanLine:
    """n consecutive pulses of one sweep, with m samples."""

    number: int
    """Number of the line in the strip, from 0; short lines are not counted."""
    point: np.ndarray
    """Index in the file of the first point of each pulse, i8 (n,)."""
    gps_time: np.ndarray
    origin: np.ndarray
    """Position of sample 0, f8 (n, 3) [m]."""
    direction: np.ndarray
    """Away from the sensor, f8 (n, 3) [m/ns]."""
    spacing: float
    """Time between two samples of the first pulse [ns]."""
    row: np.ndarray
    """Pulse of each sample, i8 (m,)."""
    time: np.ndarray
    """Time after sample 0 [ns], f8 (m,)."""
    value: np.ndarray
    """Sample above the level without signal [DN], f4 (m,)."""

    def __len__(self) -> int:
        return len(self.point)


def read_scan_lines(
    reader: StripReader, scan: StripScan, *, least: int = LEAST_PULSES, most: int = MOST_PULSES
) -> Iterator[ScanLine]:
    """The scan lines of a strip in file order.

    Lines of fewer than `least` pulses are left out, lines of more than `most` are cut. Memory is bounded.
    Raises InputError if most pulses are in lines that are too short: the file is not in the order of time; or if the
    coordinates have no height, or one in another unit.
    """
    for crs in reader.facts.units:
        if crs.kind in ("geocentric", "geographic"):
            what = f"coordinates are {crs.describe()}; slices need heights: project the strip"
            raise InputError(f"{reader.facts.path}: {what}")
    number = lost = total = 0
    axis = None
    rest = (np.empty(0, _PULSE), np.empty(0, _SAMPLE))
    for unit in reader.read_units(scan):
        parts = [rest, *(_shape(block) for block, _ in reader.read_blocks(unit, _BLOCK, True))]
        pulses, samples = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        if not len(pulses):
            continue
        # Waveforms of one time and direction are one pulse, the earliest first.
        pulses, samples = _take(pulses, samples, np.argsort(pulses["point"], kind="stable"))
        ray, origin, n = pulses["direction"], pulses["origin"], len(pulses)
        new = find_pulses(pulses["gps_time"]) == np.arange(n)
        turned = np.linalg.norm(np.diff(ray, axis=0), axis=1) > _SAME_RAY * np.linalg.norm(ray[1:], axis=1)
        new[1:] |= turned
        start, pulse = np.flatnonzero(new), np.cumsum(new) - 1
        lead = start[pulse]
        lag = ((origin - origin[lead]) * ray[lead]).sum(axis=1) / (ray[lead] ** 2).sum(axis=1)
        order = np.lexsort((lag, pulse))
        (pulses, samples), lag = _take(pulses, samples, order), lag[order]
        samples["time"] += np.repeat(lag - lag[start][pulse], pulses["count"])
        count = np.add.reduceat(pulses["count"], start)
        pulses = pulses[start]
        pulses["count"] = count
        flat, length = pulses["direction"][:, :2], np.linalg.norm(pulses["direction"], axis=1)
        if axis is None:  # across the flight: where rays spread most
            unit_rays = flat / length[:, None]
            axis = find_main_axis(unit_rays - unit_rays.mean(axis=0))
        angle = np.arcsin(np.clip(flat @ axis / length, -1, 1))
        edges = np.append(find_sweeps(angle, pulses["gps_time"]), len(pulses))
        # Lines that are too long are cut.
        step = min(most, max(least, MOST_SAMPLES // int(pulses["count"].max())))
        pieces = [np.arange(a, b, step) for a, b in zip(edges[:-1], edges[1:], strict=True)]
        edges = np.concatenate([*pieces, edges[-1:]])
        last = unit.number == reader.unit_count() - 1
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if b == len(pulses) and not last:
                break
            total += b - a
            if b - a < least:
                lost += b - a
                continue
            yield _build_line(number, *_take(pulses, samples, np.arange(a, b)))
            number += 1
        rest = _take(pulses, samples, np.arange(edges[-2], len(pulses)))
    if 0 < total < least:
        need = f"a scan line to find surfaces in needs {least}"
        raise InputError(f"{reader.facts.path}: has {total} pulse{'s' * (total > 1)}, {need}")
    if lost > total / 2:
        raise InputError(
            f"{reader.facts.path}: {lost} of {total} pulses lie in scan lines of fewer than {least} pulses; "
            "slices need pulses in the order of time: sort the strip by GPS time"
        )


def _shape(block: WaveformBlock) -> tuple[np.ndarray, np.ndarray]:
    """The waveforms of a block and their samples."""
    n, s = block.samples.shape
    # Fill holds the lower quartile of what was recorded (docs/algorithms.md H8), so it does not move the level.
    values = block.samples.astype(np.float32)
    at = int(_FLOOR * (s - 1))
    values -= np.partition(values, at, axis=1)[:, at : at + 1]
    if block.missing is not None:
        values[block.missing] = np.nan
    pulses, samples = np.empty(n, _PULSE), np.empty((n, s), _SAMPLE)
    for name in ("point", "gps_time", "origin", "direction", "spacing"):
        pulses[name] = getattr(block, name)
    pulses["count"], samples["time"], samples["value"] = s, np.arange(s) * block.spacing, values
    return pulses, samples.reshape(-1)


def _take(pulses: np.ndarray, samples: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some pulses with only their samples."""
    first = np.cumsum(pulses["count"]) - pulses["count"]
    return pulses[rows], samples[join_ranges(first[rows], pulses["count"][rows])]


def find_main_axis(apart: np.ndarray) -> np.ndarray:
    """Direction (k,) of the largest spread of vectors (n, k), positive along its longest component."""
    axis = np.linalg.eigh(apart.T @ apart)[1][:, -1]
    return axis if axis[np.argmax(np.abs(axis))] > 0 else -axis


def _build_line(number: int, pulses: np.ndarray, samples: np.ndarray) -> ScanLine:
    place = {name: np.ascontiguousarray(pulses[name]) for name in ("point", "gps_time", "origin", "direction")}
    there = ~np.isnan(samples["value"])
    known = {"row": np.repeat(np.arange(len(pulses)), pulses["count"])[there], "time": samples["time"][there]}
    return ScanLine(number, spacing=float(pulses["spacing"][0]), value=samples["value"][there], **place, **known)


def align_times(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Find where the windows of pulses begin on one axis of time.

    Windows open when the receiver sees an echo, at another height for every pulse: counted from their first
    samples, the relief is lost. The axis begins at the plane across the mean ray through the sample that is nearest to
    the sensor; every pulse passes it, wherever its window is.

    Parameters
    ----------
    origin : float64 (n, 3), m
        Positions of the first samples.
    direction : float64 (n, 3), m/ns
        Away from the sensor.

    Returns
    -------
    float64 array, shape (n,)
        Two-way time from that plane to the first sample of each pulse [ns], 0 and above; 0 where it is not known.

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    along = np.linalg.norm(direction, axis=1)
    mean = (direction / np.where(along > 0, along, 1.0)[:, None]).mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    depth, speed = (origin - origin.mean(axis=0)) @ mean, direction @ mean
    # Rays across the mean one never pass the plane; none of a scan line is.
    known = speed > 1e-3 * along
    depth -= depth[known].min() if known.any() else 0.0
    return np.where(known, depth / np.where(known, speed, 1.0), 0.0)


_POSITIVE = Above(0.0, math.inf)
_GAP, _PULSES_PER_GAP = 10.0, 3.0
"""Largest hole in a segment [pixels, pulses]: whichever is larger in a plane."""


@frozen
class SliceOptions(CheckedOptions):
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


@frozen(eq=False)
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


@frozen
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
    """Sum of intensities [DN]."""


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
        # A vertical plane: its direction is the main axis of the searched samples, seen from above.
        use = np.flatnonzero(roi) if roi.any() else np.arange(len(line.row))
        searched = line.origin[line.row[use]] + line.time[use, None] * line.direction[line.row[use]]
        base = searched.mean(axis=0)
        axis = np.append(find_main_axis(searched[:, :2] - base[:2]), 0.0)
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
    gap = _GAP  # the largest hole in a segment [pixels]: ten, or three pulses if they lie farther apart
    if piece.geometry != "time":
        step = np.diff(piece.line.origin @ piece.axis) / piece.pixel
        gap = max(_GAP, _PULSES_PER_GAP * float(np.median(np.abs(step))))
    # A flat surface is no straight line over time, so bends mean ridges in a plane only.
    pulse = piece.line.row[rows] if piece.geometry == "plane" else None
    lines = find_lines(x, y, weight, sigma=sigma, gap=gap, shortest=options.shortest, most=options.most, pulse=pulse)
    line, segments = piece.line, []
    for number, found in enumerate(lines):
        on_line = rows[found.rows]
        start, end = piece.locate(found.start), piece.locate(found.end)
        apart = np.subtract(end, start)
        pulses = np.unique(line.row[on_line])
        # Spread of the centroids of pulses about the line, so that the width of a pulse does not count.
        theta = np.radians(found.theta)
        off = piece.x[on_line] * np.cos(theta) + piece.y[on_line] * np.sin(theta) - found.rho
        if piece.geometry == "time":
            off = off / max(np.cos(theta), 1e-9)
        weight = line.value[on_line].astype(np.float64)
        sums, moments = np.bincount(line.row[on_line], weight), np.bincount(line.row[on_line], weight * off)
        centroid = moments[sums > 0] / sums[sums > 0]
        segments.append(Segment(
            line=line.number,
            segment=number,
            start=start,
            end=end,
            ends=(piece.scale(found.start), piece.scale(found.end)),
            length=float(np.linalg.norm(apart)),
            slope=float(np.degrees(np.arctan2(apart[2], np.hypot(apart[0], apart[1])))),
            residual=float(np.sqrt(np.mean(centroid**2)) * piece.pixel),
            pulses=len(pulses),
            first_pulse=int(pulses[0]),
            last_pulse=int(pulses[-1]),
            first_point=int(line.point[pulses[0]]),
            theta=found.theta,
            rho=found.rho,
            weight=found.weight,
        ))  # fmt: skip
    return segments
