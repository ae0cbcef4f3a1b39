"""Reads the waveforms of a strip scan line by scan line.

A line ends where the scan angle turns or jumps back, or at a pause. Pulses must be in the order of time. The last line
of a unit is joined with the next unit, so that no line is cut between units.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.files.strip.shared_packets import expand
from wavebatch.kernels.geometry.group_returns import find_pulses
from wavebatch.kernels.geometry.scan_lines import find_sweeps

LEAST_PULSES = 8
"""Shorter lines are left out: they hold no surface to find."""
MOST_PULSES = 16_384
"""Longer lines are cut: without a moving mirror, a strip would be one line and memory would not be bounded."""
_BLOCK = 4096
_SAME_RAY = 1e-4
"""Largest relative difference of the directions of two waveforms of one pulse: they are in single precision. Pulses
whose times are rounded to the same lie at least 10 cm apart at 1 km."""
_FLOOR = 0.25
"""Quantile of a waveform that is used as its level without signal: signal fills less than three quarters."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pulses:
    """n pulses, or first their waveforms, in file order, with count[i] samples of pulse i in `time` and `values`, one
    pulse after the other."""

    point: np.ndarray
    gps_time: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    spacing: np.ndarray
    count: np.ndarray
    time: np.ndarray
    """After sample 0 [ns], of each sample."""
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.point)

    @property
    def first(self) -> np.ndarray:
        """Where the samples of each pulse begin."""
        return np.cumsum(self.count) - self.count

    def take(self, rows: np.ndarray) -> _Pulses:
        """Some pulses, with only their samples."""
        kept = {field.name: getattr(self, field.name)[rows] for field in fields(self)[:-2]}
        samples = expand(self.first[rows], kept["count"])
        return _Pulses(**kept, time=self.time[samples], values=self.values[samples])


@dataclass(frozen=True, slots=True, eq=False)
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
    """Sample above the level without signal [count], f4 (m,)."""

    def __len__(self) -> int:
        return len(self.point)


def read_scan_lines(reader: StripReader, scan: StripScan) -> Iterator[ScanLine]:
    """The scan lines of a strip in file order.

    Lines of fewer than LEAST_PULSES pulses are left out, lines of more than MOST_PULSES are cut. Memory is bounded.
    Raises InputError if most pulses are in lines that are too short: the file is not in the order of time.
    """
    number = lost = total = 0
    axis = None
    rest: list[_Pulses] = []
    for unit in reader.read_units(scan):
        parts = rest + [_shape(block) for block, _ in reader.read_blocks(unit, _BLOCK, True)]
        if not parts:
            continue
        pulses = _join(parts)
        pulses = _join_waveforms(pulses.take(np.argsort(pulses.point, kind="stable")))
        axis = _find_across(pulses.direction) if axis is None else axis
        edges = _cut_long(np.append(find_sweeps(_measure_angle(pulses, axis), pulses.gps_time), len(pulses)))
        last = unit.number == reader.unit_count() - 1
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if b == len(pulses) and not last:
                break
            total += b - a
            if b - a < LEAST_PULSES:
                lost += b - a
                continue
            yield _build_line(number, pulses.take(np.arange(a, b)))
            number += 1
        rest = [pulses.take(np.arange(edges[-2], len(pulses)))]
    if 0 < total < LEAST_PULSES:
        need = f"a scan line to find surfaces in needs {LEAST_PULSES}"
        raise InputError(f"{reader.facts.path}: has {total} pulse{'s' * (total > 1)}, {need}")
    if lost > total / 2:
        raise InputError(
            f"{reader.facts.path}: {lost} of {total} pulses lie in scan lines of fewer than {LEAST_PULSES} pulses; "
            "slices need pulses in the order of time: sort the strip by GPS time"
        )


def _shape(block: WaveformBlock) -> _Pulses:
    n, s = block.samples.shape
    # Fill holds the lower quartile of what was recorded (docs/algorithms.md H8), so it does not move the level.
    values = block.samples.astype(np.float32)
    at = int(_FLOOR * (s - 1))
    values -= np.partition(values, at, axis=1)[:, at : at + 1]
    if block.missing is not None:
        values[block.missing] = np.nan
    place = (block.point, block.gps_time, block.origin, block.direction)
    time = np.tile(np.arange(s) * block.spacing, n)
    return _Pulses(*place, np.full(n, block.spacing), np.full(n, s), time, values.reshape(-1))


def _join(parts: list[_Pulses]) -> _Pulses:
    names = [field.name for field in fields(_Pulses)]
    return _Pulses(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _join_waveforms(waveforms: _Pulses) -> _Pulses:
    """Pulses from waveforms in file order: those of one time and direction are one pulse, the earliest first."""
    ray, n = waveforms.direction, len(waveforms)
    new = find_pulses(waveforms.gps_time) == np.arange(n)
    turned = np.linalg.norm(np.diff(ray, axis=0), axis=1) > _SAME_RAY * np.linalg.norm(ray[1:], axis=1)
    new[1:] |= turned
    start, pulse = np.flatnonzero(new), np.cumsum(new) - 1
    lead = start[pulse]
    lag = ((waveforms.origin - waveforms.origin[lead]) * ray[lead]).sum(axis=1) / (ray[lead] ** 2).sum(axis=1)
    order = np.lexsort((lag, pulse))
    waveforms, lag = waveforms.take(order), lag[order]
    first = {field.name: getattr(waveforms, field.name)[start] for field in fields(waveforms)[:-3]}
    time = waveforms.time + np.repeat(lag - lag[start][pulse], waveforms.count)
    return _Pulses(**first, count=np.add.reduceat(waveforms.count, start), time=time, values=waveforms.values)


def find_main_axis(apart: np.ndarray) -> np.ndarray:
    """Direction (k,) of the largest spread of vectors (n, k), positive along its longest component."""
    axis = np.linalg.eigh(apart.T @ apart)[1][:, -1]
    return axis if axis[np.argmax(np.abs(axis))] > 0 else -axis


def _find_across(direction: np.ndarray) -> np.ndarray:
    """Horizontal axis (2,) with the largest spread of the rays: across the flight."""
    flat = direction[:, :2] / np.linalg.norm(direction, axis=1)[:, None]
    return find_main_axis(flat - flat.mean(axis=0))


def _measure_angle(pulses: _Pulses, axis: np.ndarray) -> np.ndarray:
    return np.arcsin(np.clip(pulses.direction[:, :2] @ axis / np.linalg.norm(pulses.direction, axis=1), -1, 1))


def _cut_long(edges: np.ndarray) -> np.ndarray:
    """The edges, with further edges in lines that are too long."""
    more = [np.arange(a, b, MOST_PULSES) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return np.concatenate([*more, edges[-1:]])


def _build_line(number: int, pulses: _Pulses) -> ScanLine:
    row = np.repeat(np.arange(len(pulses)), pulses.count)
    place, there = (pulses.point, pulses.gps_time, pulses.origin, pulses.direction), ~np.isnan(pulses.values)
    return ScanLine(number, *place, float(pulses.spacing[0]), row[there], pulses.time[there], pulses.values[there])


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
