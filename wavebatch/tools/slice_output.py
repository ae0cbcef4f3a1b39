"""Segments as CSV or GeoJSON, written and read again; pictures of segments and of slices of a data cube.

`wavebatch slice` adds segments line by line; the file appears only when it is complete. `--cube` writes samples by
line, pulse and time on one axis: windows open at other heights for every pulse, and counted from their first samples
the relief would be lost. Lines of an oscillating mirror run to and fro, and some begin late: pulses of equal scan angle
have the same column.

`wavebatch plot profile` reads them to measure how much of them lies at each height.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.disk.npz import read_npz
from wavebatch.files.disk.publish import Draft, refuse_existing, reporting
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.figure_file import open_picture, plain_text, set_head, set_layout, space_ticks
from wavebatch.files.geojson import GeoJsonCrs
from wavebatch.tools.cells import Tally
from wavebatch.tools.scan_slices import ScanLine, Segment, Slice, align_times, find_main_axis

MOST_VALUES = 200_000_000
"""Most values of a cube (800 MB): it is built in memory."""

_LARGEST = 1e30
"""Largest time [ns] and sample [DN]; damaged files have larger ones."""


def write_cube(
    target: Path, lines: Sequence[ScanLine], meta: dict[str, Any], crs: str | None, *, overwrite: bool
) -> tuple[int, int, int]:
    """Writes scan lines as a cube; returns its shape: lines, pulses, times.

    values f4 (lines, pulses, times): samples above the level without signal [DN], NaN where nothing was recorded.
    time f8 (times,): two-way [ns], from the plane across the mean ray through the sample nearest to the sensor.
    offset f4 (lines, pulses): to add to the times of a pulse [ns], within half a sample: samples are moved, not
    interpolated. line i8 (lines,), and gps_time, origin (place of the first recorded sample), direction of each
    pulse; NaN where a line has no pulse at that scan angle. Raises InputError without a line, and where lines differ in
    their spacing.
    """
    if not lines:
        raise InputError(f"{target}: not written, because there is no scan line")
    spacing = lines[0].spacing
    if any(abs(line.spacing - spacing) > 1e-6 * spacing for line in lines):
        raise InputError(f"{target}: scan lines differ in their spacing of samples; choose --lines of one digitizer")
    # Time from the common plane to the first sample of each pulse [ns]; 0 where it is not known.
    origin, direction = (np.concatenate([getattr(line, key) for line in lines]) for key in ("origin", "direction"))
    starts = np.split(align_times(origin, direction), np.cumsum([len(line) for line in lines])[:-1])
    shift = [np.rint(start / spacing).astype(np.int64) for start in starts]
    columns = align_pulses(lines)
    pulses = 1 + max(int(column.max()) for column in columns)
    times = 1 + max(int((shift[i][line.row] + np.rint(line.time / spacing)).max()) for i, line in enumerate(lines))
    if len(lines) * pulses * times > MOST_VALUES:
        raise ConfigError(
            f"{target}: {len(lines)} lines of up to {pulses} pulses over {times} samples are too many: choose fewer"
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
    arrays: dict[str, Any] = {"values": values, "time": np.arange(times) * spacing, "line": number, **place}
    arrays |= {"crs": np.array(crs or ""), "meta": np.array(json.dumps(meta, sort_keys=True))}
    with Draft(target, overwrite=overwrite) as draft:
        with reporting(target):
            np.savez_compressed(draft.file, **arrays)
        draft.publish()
    return arrays["values"].shape


def align_pulses(lines: Sequence[ScanLine]) -> list[np.ndarray]:
    """Column of every pulse of each line, from 0: neighbours in a line are neighbours, angles ascend.

    A line whose angles descend is turned; then it is shifted as a whole to the angles of the longest line, because
    mirrors repeat their motion from line to line.
    """
    direction = np.concatenate([line.direction for line in lines])
    unit = direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-12)[:, None]
    apart = unit - unit.mean(axis=0)
    # Across the flight [rad], from the rays: 0 for the mean ray.
    angle = np.arcsin(np.clip(apart @ find_main_axis(apart), -1.0, 1.0))
    angles = np.split(angle, np.cumsum([len(line) for line in lines])[:-1])
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


@frozen(eq=False)
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


_LEAST_HEIGHT = 0.15
"""Least height of the box in 3D, as a share of its longest side: flat ground would else be a line."""


def draw_segments(
    segments: Sequence[Segment], target: Path, *, strip: str, lines: int, crs: str = "", overwrite: bool = False
) -> None:
    """Writes all segments in plan and in 3D, coloured by height; raises as figure_file.open_picture does."""
    from matplotlib.collections import LineCollection
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    ends = np.array([(segment.start, segment.end) for segment in segments])
    height = ends[:, :, 2].mean(axis=1)
    low, high = ends.reshape(-1, 3).min(axis=0), ends.reshape(-1, 3).max(axis=0)
    extent = np.maximum(high - low, 1e-3)
    with open_picture(target, (12.0, 6.0), overwrite=overwrite) as figure:
        numbers = [f"{number:,} {name}{'s' * (number != 1)}" for number, name in
                   ((len(segments), "segment"), (lines, "scan line"))]  # fmt: skip
        parts = (plain_text(strip), " in ".join(numbers), f"CRS: {plain_text(crs, 90) or 'not given'}")
        set_head(figure, parts, size=10.5)
        plan = figure.add_subplot(1, 2, 1)
        # Coordinates from a corner: seven digits per tick would cover each other in 3D.
        base = np.floor(low / 10.0) * 10.0
        shown = plan.add_collection(LineCollection(ends[:, :, :2] - base[:2], cmap="viridis", linewidths=1.0))
        shown.set_array(height)
        margin = 0.04 * extent[:2].max()
        first, last = (low - base - margin)[:2], (high - base + margin)[:2]
        plan.set(xlim=(first[0], last[0]), ylim=(first[1], last[1]), aspect="equal")
        names = [f"{name} {'-' if value >= 0 else '+'} {abs(value):.10g} [m]" if value else f"{name} [m]"
                 for name, value in zip("xyz", base, strict=True)]  # fmt: skip
        plan.set(xlabel=names[0], ylabel=names[1])
        figure.colorbar(shown, ax=plan, label="height [m]", orientation="horizontal", aspect=40)
        space = figure.add_subplot(1, 2, 2, projection="3d")
        tubes = space.add_collection3d(Line3DCollection(ends - base, cmap="viridis", linewidths=0.9))
        tubes.set_array(height)
        for axis, first, last in zip("xyz", low - base, high - base, strict=True):
            getattr(space, f"set_{axis}lim")(first, max(last, first + 1e-3))
            getattr(space, f"set_{axis}label")(axis, fontsize=8, labelpad=8)
            space.tick_params(axis=axis, labelsize=7)
        tall = max(extent[2], _LEAST_HEIGHT * extent.max())
        sides = np.append(np.maximum(extent[:2], 0.05 * extent.max()), tall)
        # A long box is seen along its diagonal, and leaves more room around it than a cube.
        space.set_box_aspect(sides, zoom=0.85 + 0.35 * (1.0 - np.sort(sides)[1] / sides.max()))
        for axis, side in zip("xyz", sides / sides.max(), strict=True):
            space_ticks(getattr(space, f"{axis}axis"), 5.0 * side, 1.0)
        for flat, side in zip((plan.xaxis, plan.yaxis), extent[:2] / extent.max(), strict=True):
            space_ticks(flat, 7.0 * side, 1.0)
        factor = tall / extent[2]
        scales = "equal scales" if factor < 1.01 else f"heights {factor:.2g} times exaggerated"
        space.set_title(f"{scales}; z above {base[2]:.10g} m", fontsize=9)


def draw_cube(slices: Sequence[CubeSlice], target: Path, *, name: str, overwrite: bool = False) -> None:
    """Writes slices of a cube side by side, with one scale of grey; raises as figure_file.open_picture does."""
    known = np.concatenate([one.image[np.isfinite(one.image)] for one in slices])
    high = float(np.percentile(known, 99.8)) if len(known) else 1.0
    with open_picture(target, (max(4.6 * len(slices), 6.0), 4.8), overwrite=overwrite) as figure:
        set_head(figure, (plain_text(name), "blue: no sample"), size=10.5)
        panels = figure.subplots(1, len(slices), squeeze=False)[0]
        for axes, one in zip(panels, slices, strict=True):
            axes.grid(visible=False)
            axes.set_facecolor(NO_SAMPLE)
            shown = axes.imshow(one.image, extent=one.extent, origin="lower", aspect="auto", cmap="Greys", vmin=0.0,
                                vmax=max(high, 1e-6), interpolation="nearest")  # fmt: skip
            if one.down:
                axes.invert_yaxis()
            axes.set(xlabel=one.across, ylabel=one.up, title=one.title)
        figure.colorbar(shown, ax=panels.tolist(), label="above the level without signal [DN]", extend="max")


SEGMENT_SUFFIXES = (".csv", ".geojson")
_PLACE = ("pulses", "first_pulse", "last_pulse", "first_point")
_FIGURES = ("length", "slope", "residual", *_PLACE, "theta", "rho", "weight")
_HEAD = ("line", "segment", "x1", "y1", "z1", "x2", "y2", "z2", *_FIGURES)
NO_SAMPLE = "#d9e6f2"
"""Colour of what was not recorded: a light blue, because samples without signal are white."""

_ROOM = 0.15
"""What is drawn above and below the signal, as a share of its depth: the rest of the samples is empty."""

_TALLEST = 8.0
"""Largest height of the axes of a slice [inches]."""
_MOST_PIXELS = 40_000_000
"""Most pixels of a picture (160 MB): more come from damaged coordinates."""


class SegmentWriter(Closing):
    """Writes segments to a .csv or .geojson file: `write` as often as needed, then `commit`.

    A context manager: without `commit` no file remains. crs: how points are written as GeoJSON; a .csv has the
    coordinates of the strip. Raises ConfigError for another suffix, InputError if the target exists (without overwrite)
    or cannot be written.
    """

    def __init__(self, target: Path, *, crs: GeoJsonCrs | None = None, overwrite: bool = False) -> None:
        self.target = Path(target)
        suffix = self.target.suffix.lower()
        if suffix not in SEGMENT_SUFFIXES:
            raise ConfigError(f"{target}: segments are written as .csv or .geojson")
        refuse_existing(self.target, overwrite)
        self._geojson, self._count, self._crs = suffix == ".geojson", 0, crs or GeoJsonCrs(None, None)
        self._draft = Draft(self.target, overwrite=overwrite)
        if self._geojson:
            member = "" if self._crs.member is None else f'"crs": {json.dumps(self._crs.member)}, '
            self._put('{"type": "FeatureCollection", ' + member + '"features": [')
        else:
            self._put(",".join(_HEAD) + "\n")

    def close(self) -> None:
        """Removes the file if it was not committed."""
        self._draft.discard()

    def write(self, segments: Sequence[Segment]) -> None:
        """Appends segments."""
        for segment in segments:
            if self._geojson:
                ends = np.array([segment.start, segment.end])
                feature = {
                    "type": "Feature",
                    "geometry": {"type": "LineString", "coordinates": self._crs.place(ends)},
                    "properties": {name: getattr(segment, name) for name in ("line", "segment", *_FIGURES)},
                }
                self._put((",\n" if self._count else "\n") + json.dumps(feature))
            else:
                places = [f"{value:.4f}" for value in (*segment.start, *segment.end)]
                values = [getattr(segment, name) for name in _FIGURES]
                texts = [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
                self._put(",".join([str(segment.line), str(segment.segment), *places, *texts]) + "\n")
            self._count += 1

    def commit(self) -> None:
        """Completes the file and moves it to its place."""
        if self._geojson:
            self._put("\n]}\n")
        self._draft.publish()

    def _put(self, text: str) -> None:
        with reporting(self.target):
            self._draft.file.write(text.encode())


def draw_slice(
    piece: Slice, segments: Sequence[Segment], target: Path, *, strip: str = "", overwrite: bool = False
) -> None:
    """Writes a picture of a slice with its segments; scales are equal where both axes are metres.

    Raises as figure_file.open_picture does.
    """
    image, extent = _paint(piece)
    plane = piece.geometry == "plane"
    tall = (extent[3] - extent[2]) / (extent[1] - extent[0]) if plane else 0.4
    width = min(11.0, _TALLEST / tall)
    with open_picture(target, (max(width + 1.0, 6.0), max(width * tall, 0.6) + 2.2), overwrite=overwrite) as figure:
        set_layout(figure, compress=True)
        axes = figure.subplots()
        axes.grid(visible=False)
        axes.set_facecolor(NO_SAMPLE)
        shown = axes.imshow(image, extent=extent, origin="lower", aspect="equal" if plane else "auto", cmap="gray_r",
                            interpolation="nearest")  # fmt: skip
        figure.colorbar(shown, ax=axes, label="DN above the level without signal", orientation="horizontal", aspect=40)
        for segment in segments:
            ends = np.array(segment.ends)
            axes.plot(ends[:, 0], ends[:, 1], color="tab:red", linewidth=1.2)
        axes.set(xlim=extent[:2], ylim=extent[2:])
        space_ticks(axes.yaxis, width * tall, 0.3)
        axes.set_xlabel("along the slice [m]" if plane else "time from the nearest sample of all [ns]")
        axes.set_ylabel("height [m]" if plane else "pulse")
        parts = [plain_text(strip), f"scan line {piece.line.number}", f"{len(piece.line)} pulses"]
        parts += [f"{len(segments)} segment" + "s" * (len(segments) != 1), "blue: no sample"]
        set_head(figure, [part for part in parts if part], size=10.5)


def _paint(piece: Slice) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Largest value per pixel, and the extent of the picture in its units; samples far from all signal are left out."""
    x, y, value = np.rint(piece.x).astype(np.int64), np.rint(piece.y).astype(np.int64), piece.line.value
    depth = y if piece.geometry == "plane" else x
    loud = depth[value > value.std(dtype=np.float64)]
    if len(loud):
        room = _ROOM * (np.ptp(loud) + 1)
        near = (depth >= loud.min() - room) & (depth <= loud.max() + room)
        x, y, value = x[near], y[near], value[near]
    low_x, low_y = int(x.min()), int(y.min())
    width, height = int(x.max()) - low_x + 1, int(y.max()) - low_y + 1
    if width * height > _MOST_PIXELS:
        raise ConfigError(f"scan line {piece.line.number}: a slice of {width} x {height} pixels is too large to draw")
    image = np.full(height * width, np.nan, np.float32)
    np.fmax.at(image, (y - low_y) * width + x - low_x, value)
    step_x = piece.pixel
    step_y, base = (piece.pixel, piece.base[2]) if piece.geometry == "plane" else (1.0, 0.0)
    edges_x = ((low_x - 0.5) * step_x, (low_x + width - 0.5) * step_x)
    edges_y = (base + (low_y - 0.5) * step_y, base + (low_y + height - 0.5) * step_y)
    return image.reshape(height, width), (*edges_x, *edges_y)


STRIP_UNIT = "units of the strip"
"""Of lengths and heights: the file does not say which they are."""

_COLUMNS = {
    "length": ("units", ""), "slope": ("deg", "angle above the horizontal"),
    "residual": ("-", "rms distance of the centroids from the line"), "pulses": ("-", "pulses of a segment"),
    "weight": ("DN", "sum of the samples"),
}  # fmt: skip
"""Columns that can be summed or averaged, with unit and meaning."""

REMEDY = "make it again with `wavebatch slice`"
"""What to do about a damaged file."""


def is_segments(path: Path) -> bool:
    """Whether a file is one of segments, by its name."""
    return path.suffix.lower() in SEGMENT_SUFFIXES


def read_segments(path: Path, column: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Heights of both ends f8 (n, 2), and the values of a column (n,), ones without a column.

    Raises InputError for a file that cannot be read or holds no segments, ConfigError for another column.
    """
    if column is not None and column not in _COLUMNS:
        raise ConfigError(f"{path}: has no column {column!r}; {nearest(column, _COLUMNS)}")
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows: Iterable[dict] = csv.DictReader(file)
            if path.suffix.lower() == ".geojson":
                features = [(one["properties"], one["geometry"]["coordinates"]) for one in json.load(file)["features"]]
                rows = ({**values, "z1": start[2], "z2": end[2]} for values, (start, end) in features)
            found = [(float(row["z1"]), float(row["z2"]), float(row[column]) if column else 1.0) for row in rows]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; check the name and the access") from error
    except KeyError as error:
        raise InputError(f"{path}: holds no segments of `wavebatch slice`: {error} is missing; {REMEDY}") from error
    except (ValueError, TypeError, AttributeError, IndexError, RecursionError, csv.Error) as error:
        raise InputError(f"{path}: holds no segments of `wavebatch slice` ({error}); {REMEDY}") from error
    values = np.array(found, np.float64).reshape(-1, 3)
    if not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0]) + 1
        raise InputError(f"{path}: segment {bad} holds a value that is no finite number; {REMEDY}")
    return values[:, :2], values[:, 2]


class SegmentFiles:
    """Segments of several files, read as `cells.Clouds` are: the values of a row are that of the column, and the
    heights of both ends. Raises InputError for a file that cannot be read or holds no segments, ConfigError for another
    column.
    """

    def __init__(self, paths: Sequence[Path], column: str | None) -> None:
        self.paths = tuple(paths)
        self._files = [read_segments(path, column) for path in paths]
        unit, meaning = _COLUMNS[column] if column else ("-", "")
        self.facts = ColumnFacts(column or "segments", unit, meaning, 0.0)

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """As Clouds.read."""
        for number, (ends, values) in enumerate(self._files):
            rows = np.zeros(len(ends), [("values", "<f8", (3,))])
            rows["values"][:, 0], rows["values"][:, 1:] = values, ends
            yield number, rows, Tally(len(rows), 0, 0, len(rows))

    def complain(self, tally: Tally) -> InputError:
        """The error that says why nothing can be drawn."""
        return InputError(f"{self.paths[0]}: holds no segment: nothing to draw")
