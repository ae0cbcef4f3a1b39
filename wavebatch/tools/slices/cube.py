"""The data cube of scan lines: samples by line, pulse and time on one axis, as an .npz, and slices of it.

`wavebatch slice --cube` writes it, `wavebatch plot cube` draws slices of it. The axis of time is one for all pulses:
windows open at other heights for every pulse, and counted from their first samples the relief would be lost. Lines
of an oscillating mirror run to and fro, and some begin late: pulses of equal scan angle have the same column.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.npz import read_npz
from wavebatch.files.disk.publish import Draft, reporting
from wavebatch.tools.slices.segments import ScanLine, align_times, find_main_axis

MOST_VALUES = 200_000_000
"""Most values of a cube (800 MB): it is built in memory."""

_LARGEST = 1e30
"""Largest time [ns] and sample [DN]; damaged files have larger ones."""


class CubeBuilder:
    """Collects scan lines, one after the other, and writes them as a cube."""

    def __init__(self, target: Path) -> None:
        if target.suffix.lower() != ".npz":
            raise ConfigError(f"--cube {target}: a cube is written as .npz")
        self._target = target
        self._lines: list[ScanLine] = []
        self._samples = 0

    def add(self, line: ScanLine) -> None:
        """Adds a line; ConfigError where the cube grows too large."""
        self._lines.append(line)
        self._samples += len(line.row)
        if self._samples > MOST_VALUES:
            raise ConfigError(f"--cube {self._target}: more than {MOST_VALUES} samples; choose fewer --lines")

    def write(self, meta: dict[str, Any], crs: str | None, *, overwrite: bool) -> tuple[int, int, int]:
        """Writes the cube; returns its shape: lines, pulses, times.

        Raises InputError without a line, and where lines differ in their spacing.
        """
        arrays: dict[str, Any] = build_cube(self._lines, str(self._target))
        arrays |= {"crs": np.array(crs or ""), "meta": np.array(json.dumps(meta, sort_keys=True))}
        with Draft(self._target, overwrite=overwrite) as draft:
            with reporting(self._target):
                np.savez_compressed(draft.file, **arrays)
            draft.publish()
        return arrays["values"].shape


def build_cube(lines: Sequence[ScanLine], name: str) -> dict[str, np.ndarray]:
    """Arrays of the cube of some lines; name: of the file, for messages.

    values f4 (lines, pulses, times): samples above the level without signal [DN], NaN where nothing was recorded.
    time f8 (times,): two-way [ns], from the plane across the mean ray through the sample nearest to the sensor. offset
    f4 (lines, pulses): to add to the times of a pulse [ns], within half a sample: samples are moved, not interpolated.
    line i8 (lines,), and gps_time, origin, direction of each pulse; NaN where a line has no pulse at that scan angle.
    """
    if not lines:
        raise InputError(f"{name}: not written, because there is no scan line")
    spacing = lines[0].spacing
    if any(abs(line.spacing - spacing) > 1e-6 * spacing for line in lines):
        raise InputError(f"{name}: scan lines differ in their spacing of samples; choose --lines of one digitizer")
    # Time from the common plane to the first sample of each pulse [ns]; 0 where it is not known.
    origin, direction = (np.concatenate([getattr(line, name) for line in lines]) for name in ("origin", "direction"))
    starts = _split(align_times(origin, direction), lines)
    shift = [np.rint(start / spacing).astype(np.int64) for start in starts]
    columns = align_pulses(lines)
    pulses = 1 + max(int(column.max()) for column in columns)
    times = 1 + max(int((shift[i][line.row] + np.rint(line.time / spacing)).max()) for i, line in enumerate(lines))
    if len(lines) * pulses * times > MOST_VALUES:
        raise ConfigError(
            f"{name}: {len(lines)} lines of up to {pulses} pulses over {times} samples are too many: choose fewer"
        )
    shape = (len(lines), pulses)
    values = np.full((*shape, times), np.nan, np.float32)
    place = {"gps_time": np.full(shape, np.nan), "offset": np.full(shape, np.nan, np.float32)}
    place |= {name: np.full((*shape, 3), np.nan) for name in ("origin", "direction")}
    for i, line in enumerate(lines):
        sample = shift[i][line.row] + np.rint(line.time / spacing).astype(np.int64)
        values[i, columns[i][line.row], sample] = line.value
        for key in ("gps_time", "origin", "direction"):
            place[key][i, columns[i]] = getattr(line, key)
        place["offset"][i, columns[i]] = starts[i] - shift[i] * spacing
    number = np.array([line.number for line in lines])
    return {"values": values, "time": np.arange(times) * spacing, "line": number, **place}


def align_pulses(lines: Sequence[ScanLine]) -> list[np.ndarray]:
    """Column of every pulse of each line, from 0: neighbours in a line are neighbours, angles ascend.

    A line whose angles descend is turned; then it is shifted as a whole to the angles of the longest line, because
    mirrors repeat their motion from line to line.
    """
    direction = np.concatenate([line.direction for line in lines])
    unit = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-12)[:, None]
    apart = unit - unit.mean(axis=0)
    # Across the flight [rad], from the rays: 0 for the mean ray.
    angles = _split(np.arcsin(np.clip(apart @ find_main_axis(apart), -1.0, 1.0)), lines)
    longest = max(range(len(lines)), key=lambda i: len(lines[i]))
    # Order of the pulses of each line in which their angles ascend.
    found = [np.arange(len(angle))[:: -1 if len(angle) > 1 and angle[-1] < angle[0] else 1] for angle in angles]
    model = np.maximum.accumulate(angles[longest][found[longest]])
    step = max((model[-1] - model[0]) / max(len(model) - 1, 1), 1e-12)
    shifts = []
    for angle, order in zip(angles, found, strict=True):
        turned = angle[order]
        inside = (turned >= model[0]) & (turned <= model[-1])
        at = np.where(inside, np.interp(turned, model, np.arange(len(model))), (turned - model[0]) / step)
        off = (at - np.arange(len(turned)))[inside if inside.any() else slice(None)]
        shifts.append(round(float(np.median(off))) if model[-1] > model[0] else 0)
    columns = []
    for order, shift in zip(found, shifts, strict=True):
        column = np.empty(len(order), np.int64)
        column[order] = np.arange(len(order)) + shift - min(shifts)
        columns.append(column)
    return columns


def _split(values: np.ndarray, lines: Sequence[ScanLine]) -> list[np.ndarray]:
    """Values of the pulses of all lines, line by line."""
    return np.split(values, np.cumsum([len(line) for line in lines])[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class CubeSlice:
    """One slice of a cube, ready to draw."""

    image: np.ndarray
    """f4 (rows, columns), the first row at the lower edge."""
    extent: tuple[float, float, float, float]
    """Left, right, lower and upper edge."""
    across: str
    up: str
    """Labels of the axes."""
    title: str
    down: bool = False
    """Whether the vertical axis is time, which grows downwards: away from the sensor."""


def cut_cube(path: Path, wanted: dict[str, float | None]) -> list[CubeSlice]:
    """Slices of a cube: `x` a pulse of the lines, `y` a scan line, `t` a time [ns]; the middle ones if none is wanted.

    Raises InputError for a file that holds no cube, ConfigError for a slice outside of it.
    """
    what = "cube of `wavebatch slice --cube`"
    names = {"values": ("f", 3), "time": ("f", 1), "line": ("iu", 1)}
    values, time, number = read_npz(path, names, what, "make it again").values()
    if not values.size or values.shape[2] != len(time) or values.shape[0] != len(number):
        raise InputError(f"{path}: holds no {what}: its arrays do not fit")
    ascends = (np.abs(time) < _LARGEST).all() and (np.diff(time) > 0).all()
    if not ascends or (np.abs(values) > _LARGEST).any() or not np.isfinite(values).any():
        raise InputError(f"{path}: holds no {what}: its times do not ascend, or its values are none; make it again")
    spacing = float(time[1] - time[0]) if len(time) > 1 else 1.0
    if all(value is None for value in wanted.values()):
        peak = int(np.nanargmax(np.nansum(values, axis=(0, 1))))
        wanted = {"x": values.shape[1] // 2, "y": int(number[len(number) // 2]), "t": float(time[peak])}
    axes = {
        "x": ("pulse, aligned by scan angle [-]", -0.5, values.shape[1] - 0.5),
        "y": ("scan line, in the order of the cube [-]", -0.5, len(number) - 0.5),
        "t": ("time [ns]", float(time[0]) - 0.5 * spacing, float(time[-1]) + 0.5 * spacing),
    }

    def cut(image: np.ndarray, across: str, up: str, title: str) -> CubeSlice:
        extent = (*axes[across][1:], *axes[up][1:])
        return CubeSlice(image, extent, axes[across][0], axes[up][0], title, up == "t")

    found = []
    if wanted["x"] is not None:
        place = _check("--x", wanted["x"], values.shape[1])
        found.append(cut(values[:, place].T, "y", "t", f"x = {place}"))
    if wanted["y"] is not None:
        row = np.flatnonzero(number == int(wanted["y"]))
        if not len(row):
            raise ConfigError(f"--y {int(wanted['y'])}: the cube has scan lines {number.min()} to {number.max()}")
        found.append(cut(values[row[0]].T, "x", "t", f"y = {int(wanted['y'])} (scan line)"))
    if wanted["t"] is not None:
        sample = round((wanted["t"] - float(time[0])) / spacing)
        place = _check("--t", sample, len(time), f"{time[0]:g} to {time[-1]:g} ns")
        found.append(cut(values[:, :, place], "x", "y", f"t = {time[place]:.4g} ns"))
    return found


def _check(option: str, value: float, number: int, has: str = "") -> int:
    place = int(value)
    if not 0 <= place < number:
        raise ConfigError(f"{option} {value:g}: lies outside of the cube, which has {has or f'0 to {number - 1}'}")
    return place
