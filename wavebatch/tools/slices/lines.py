"""The waveforms of a strip, scan line by scan line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.files.strip.shared_packets import expand
from wavebatch.kernels.geometry.scan_lines import find_sweeps

LEAST_PULSES = 8
"""Shorter lines are left out."""
MOST_PULSES = 16_384
"""Longer ones are cut: without a moving mirror a strip is one line."""
_BLOCK = 4096
_FLOOR = 0.25
"""Quantile of a waveform that counts as its level without signal."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pulses:
    """n pulses in the order of the file; the samples of pulse i are values[first[i] : first[i] + count[i]]."""

    point: np.ndarray
    gps_time: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    spacing: np.ndarray
    first: np.ndarray
    count: np.ndarray
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.point)

    def take(self, rows: np.ndarray) -> _Pulses:
        """Some pulses, with their own samples only."""
        count = self.count[rows]
        kept = {field.name: getattr(self, field.name)[rows] for field in fields(self)[:5]}
        return _Pulses(
            **kept, first=np.cumsum(count) - count, count=count, values=self.values[expand(self.first[rows], count)]
        )


@dataclass(frozen=True, slots=True, eq=False)
class ScanLine:
    """n consecutive pulses of one sweep, and m samples of them."""

    number: int
    """From 0, over all lines of the strip that are long enough."""
    point: np.ndarray
    """Index in the file of the pulse's first point, i8 (n,)."""
    gps_time: np.ndarray
    origin: np.ndarray
    """Position of sample 0, f8 (n, 3) [m]."""
    direction: np.ndarray
    """f8 (n, 3) [m/ns]."""
    spacing: float
    """Time between two samples of the first pulse [ns]."""
    row: np.ndarray
    """Pulse of the sample, i8 (m,)."""
    time: np.ndarray
    """After sample 0 [ns], f8 (m,)."""
    value: np.ndarray
    """Above the level without signal [count], f4 (m,)."""

    def __len__(self) -> int:
        return len(self.point)


def read_scan_lines(reader: StripReader, scan: StripScan) -> Iterator[ScanLine]:
    """The scan lines of a strip in the order of the file: found where the angle turns or jumps, and at pauses.

    Lines of fewer than LEAST_PULSES pulses are left out, longer ones than MOST_PULSES are cut. Memory is bounded.
    Raises InputError where the pulses of most lines are too few: the file is not in the order of time.
    """
    number = lost = total = 0
    axis = None
    rest: _Pulses | None = None
    for unit_number in range(reader.unit_count()):
        pulses = _read_pulses(reader, reader.read_unit(unit_number, scan))
        if rest is not None:
            pulses = _join([rest, pulses])
        if not len(pulses):
            continue
        axis = _find_axis(pulses.direction) if axis is None else axis
        edges = _cut_long(np.append(find_sweeps(_measure_angle(pulses, axis), pulses.gps_time), len(pulses)))
        last = unit_number == reader.unit_count() - 1
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if b == len(pulses) and not last:
                break
            total += b - a
            if b - a < LEAST_PULSES:
                lost += b - a
                continue
            yield _build_line(number, pulses.take(np.arange(a, b)))
            number += 1
        rest = pulses.take(np.arange(edges[-2], len(pulses)))
    if lost > total / 2:
        raise InputError(
            f"{reader.facts.path}: {lost} of {total} pulses lie in scan lines of fewer than {LEAST_PULSES}; slices "
            "need pulses in the order of time: sort the strip by gps time"
        )


def _read_pulses(reader: StripReader, unit: Unit) -> _Pulses:
    parts = [_shape(block) for block, _ in reader.read_blocks(unit, _BLOCK, True)]
    if not parts:
        empty, three = np.empty(0), np.empty((0, 3))
        none = np.empty(0, np.int64)
        return _Pulses(none, empty, three, three, empty, none, none, np.empty(0, np.float32))
    pulses = _join(parts)
    return pulses.take(np.argsort(pulses.point, kind="stable"))


def _shape(block) -> _Pulses:
    n, s = block.samples.shape
    values = block.samples.astype(np.float32)
    at = int(_FLOOR * (s - 1))
    values -= np.partition(values, at, axis=1)[:, at : at + 1]
    return _Pulses(
        point=block.point,
        gps_time=block.gps_time,
        origin=block.origin,
        direction=block.direction,
        spacing=np.full(n, block.spacing),
        first=np.arange(n) * s,
        count=np.full(n, s),
        values=values.reshape(-1),
    )


def _join(parts: list[_Pulses]) -> _Pulses:
    shifts = np.cumsum([0, *(len(part.values) for part in parts[:-1])])
    joined = {field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(_Pulses)}
    joined["first"] = np.concatenate([part.first + shift for part, shift in zip(parts, shifts, strict=True)])
    return _Pulses(**joined)


def _find_axis(direction: np.ndarray) -> np.ndarray:
    """Horizontal axis (2,) along which the rays spread most: across the flight."""
    flat = direction[:, :2] / np.linalg.norm(direction, axis=1)[:, None]
    flat = flat - flat.mean(axis=0)
    axis = np.linalg.eigh(flat.T @ flat)[1][:, 1]
    return axis if axis[np.argmax(np.abs(axis))] > 0 else -axis


def _measure_angle(pulses: _Pulses, axis: np.ndarray) -> np.ndarray:
    return np.arcsin(np.clip(pulses.direction[:, :2] @ axis / np.linalg.norm(pulses.direction, axis=1), -1, 1))


def _cut_long(edges: np.ndarray) -> np.ndarray:
    """Edges with more between those that are too far apart."""
    more = [np.arange(a, b, MOST_PULSES) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    return np.concatenate([*more, edges[-1:]])


def _build_line(number: int, pulses: _Pulses) -> ScanLine:
    row = np.repeat(np.arange(len(pulses)), pulses.count)
    return ScanLine(
        number=number,
        point=pulses.point,
        gps_time=pulses.gps_time,
        origin=pulses.origin,
        direction=pulses.direction,
        spacing=float(pulses.spacing[0]),
        row=row,
        time=(np.arange(len(row)) - pulses.first[row]) * pulses.spacing[row],
        value=pulses.values,
    )
