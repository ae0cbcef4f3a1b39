"""Columns that need the points around an echo: a second pass over a strip's rows before the cloud is written.

1. `strip_task` adds the rows of all units; they wait in a temporary file next to the cloud.
2. `cut` sorts their positions into tiles of about equal numbers of points, each with a buffer around it.
3. Workers process tiles in any order with `process_tile`; results are kept by row.
4. The results are filled into the rows while the cloud is written.

Before you change it: a value must depend on the points within the stage's radius alone, whatever the tiles are.
"""

from __future__ import annotations

import functools
import itertools
import pickle
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.batch.counts import RunReport
from wavebatch.batch.unit import list_carried, unpack
from wavebatch.core.echoes import COLUMNS, RAY
from wavebatch.core.no_data import NoData
from wavebatch.files.cloud.layout import OutputLayout
from wavebatch.files.disk.row_file import RowStore
from wavebatch.files.disk.spool import Spool
from wavebatch.kernels.geometry.normals import FINENESS, Gap, Surroundings, thin_out
from wavebatch.kernels.geometry.tiles import Tiles, cut_tiles, is_inside, sort_into_tiles
from wavebatch.stages.chain import Step

TILE_POINTS = 150_000
"""Points of a tile without its buffer, roughly."""

SAMPLE = 1 << 18
"""Most points of the sample that tiles are cut by; when it is full, every second point is dropped."""

PART_POINTS = 1 << 18
"""Most points of a tile that are processed at a time, to bound memory where very many lie in one place."""

_ENTRY = np.dtype([("row", "<i8"), ("xyz", "<i4", 3), ("ray", "<f4", 3)])

Found = tuple[np.ndarray, np.ndarray, RunReport]
"""Rows i8 (m,), ascending; the values found for them, as `_found_dtype` has them; and the timing."""


@dataclass(frozen=True, slots=True, eq=False)
class TileTask:
    """Everything that the tiles of a strip share; picklable."""

    step: Step
    tiles: Tiles
    entries: Spool
    """Points by tile, including those of its buffer."""
    scales: tuple[float, float, float]

    def place(self, xyz: np.ndarray) -> np.ndarray:
        """Return positions [m] without the file's offset, f8 (n, 3), of stored coordinates, i4 (n, 3)."""
        return xyz * np.array(self.scales)


class SecondPass:
    """The second pass of one strip: `add` all rows, `cut` them, `take` the result of each `next_tile`, read `rows`.

    Parameters
    ----------
    step : Step
        Of the chain, with a second pass.
    layout : OutputLayout
        Of the cloud; rows that are added have `layout.extended(RAY)`.
    target : Path
        The cloud; temporary files lie next to it.
    late : tuple of Step
        Steps whose columns are completed from those of the second pass; rows that are added carry what they need.
    tile_points : int, optional
        TILE_POINTS by default; the result does not depend on it.
    """

    def __init__(
        self,
        step: Step,
        layout: OutputLayout,
        target: Path,
        *,
        late: tuple[Step, ...] = (),
        tile_points: int | None = None,
    ) -> None:
        self._step, self._layout, self._late = step, layout, late
        self._tile_points = tile_points or TILE_POINTS
        self._carrying = layout.extended(list_carried(late))
        self._completed = dict.fromkeys((step.stage.makes[0] for step in late), 0)
        self._rows = RowStore(target, self._carrying.dtype)
        self._found = RowStore(target, _found_dtype(step))
        self._entries: Spool | None = None
        self._blob = b""
        self._parts: deque[tuple[int, int]] = deque()
        self._waiting = 0
        self._gaps = np.zeros(len(Gap), np.int64)
        self._sample, self._every = [np.empty((0, 3))], 1

    def add(self, rows: np.ndarray) -> None:
        """Keep rows (m,), in the order in which they will be written."""
        first = -self._rows.count % self._every
        self._sample.append(self._place(rows[first :: self._every]))
        self._rows.add(rows)
        while sum(map(len, self._sample)) > SAMPLE:
            self._sample = [np.concatenate(self._sample)[::2].copy()]
            self._every *= 2

    def cut(self) -> RunReport:
        """Sort all rows into tiles; returns the timing."""
        start = time.perf_counter()
        reach = _reach(self._step)
        sample = np.concatenate(self._sample)
        self._sample = []
        sample = sample[np.isfinite(sample).all(axis=1)]
        # Tiles much smaller than their buffers would list each point many times.
        tiles = cut_tiles(sample, max(self._tile_points // self._every, 1), 8 * reach)
        self._found.extend(self._rows.count)
        self._entries = Spool(len(tiles), _ENTRY)
        counts, at = np.zeros(len(tiles), np.int64), 0
        for rows in self._rows.pieces():
            place = self._place(rows)
            able = np.flatnonzero(np.isfinite(place).all(axis=1))
            index, tile = sort_into_tiles(tiles, place[able], reach)
            counts += np.bincount(tile, minlength=len(tiles))
            self._entries.append(tile, _list_entries(rows, at)[able[index]])
            at += len(rows)
        task = TileTask(self._step, tiles, self._entries.seal(), self._layout.source.header.scales)
        self._blob = pickle.dumps(task, pickle.HIGHEST_PROTOCOL)
        for tile, count in enumerate(counts.tolist()):
            self._parts.extend((tile, part) for part in range(-(-count // PART_POINTS)))
        return RunReport(timing={"tiles": time.perf_counter() - start})

    @property
    def has_more(self) -> bool:
        """Whether there is a `next_tile`."""
        return bool(self._parts)

    @property
    def is_complete(self) -> bool:
        """Whether all tiles are done."""
        return not self._parts and not self._waiting

    def next_tile(self) -> tuple[bytes, int, int]:
        """Return the arguments of `process_tile` for the next tile."""
        self._waiting += 1
        return (self._blob, *self._parts.popleft())

    def take(self, result: Found) -> RunReport:
        """Keep the result of a tile; returns its timing."""
        index, found, report = result
        self._found.put(index, found)
        self._waiting -= 1
        return report

    def rows(self) -> Iterator[np.ndarray]:
        """Yield all rows in the cloud's layout, with the results filled in."""
        final = self._layout.dtype
        fields = zip(self._layout.extra_fields[len(self._layout.carried) :], self._layout.written, strict=True)
        filled = [(field, column) for field, column in fields if column.column in self._found.dtype.names]
        for rows, found in zip(self._rows.pieces(), self._found.pieces(), strict=True):
            self._gaps += np.bincount(found["gap"], minlength=len(Gap))
            known = found["gap"] == Gap.KNOWN
            values = {name: np.where(known, found[name], np.float32(np.nan)) for name in found.dtype.names[:-1]}
            for field, column in filled:
                rows[field] = column.encode(values[column.column])
            self._complete(rows, values)
            plain = rows.view(np.uint8).reshape(len(rows), -1)[:, : final.itemsize]
            yield np.ascontiguousarray(plain).view(final)[:, 0]

    def count_reasons(self, echoes: int) -> dict[str, dict[str, int]]:
        """Count the echoes by reason for RunReport.no_data, once all rows were read."""
        counts = {NoData[gap.name].name: int(self._gaps[gap]) for gap in Gap if gap != Gap.NO_RAY}
        counts[NoData.NO_RAY.name] = echoes - sum(counts.values())
        counts = {name: number for name, number in counts.items() if number}
        # The units counted these as echoes without an angle; counts of a strip are sums.
        late = {name: {NoData.KNOWN.name: k, NoData.NO_ANGLE.name: -k} for name, k in self._completed.items() if k}
        return {self._found.dtype.names[0]: counts, **late}

    def close(self) -> None:
        """Remove all temporary files; harmless twice."""
        self._rows.close()
        self._found.close()
        if self._entries is not None:
            self._entries.close()

    def _complete(self, rows: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Fill the columns of late steps into the rows; values: the columns of the second pass."""
        layout, fields = self._carrying, {}
        for field, column in zip(layout.extra_fields[len(layout.carried) :], layout.written, strict=True):
            fields[column.column] = (field, column)
        for step in self._late:
            needed = {name: fields[name][0] for name in step.stage.makes if not COLUMNS[name].extra_bytes}
            carried = {name: _decode(name, rows[field]) for name, field in needed.items()}
            for name, found in step.stage.complete({**values, **carried}).items():
                if name in self._completed:
                    self._completed[name] += int(np.count_nonzero(np.isfinite(found)))
                if name in fields:
                    field, column = fields[name]
                    rows[field] = column.encode(found)

    def _place(self, rows: np.ndarray) -> np.ndarray:
        return np.stack([rows[name] for name in "XYZ"], axis=1) * np.array(self._layout.source.header.scales)


def process_tile(blob: bytes, number: int, part: int) -> Found:
    """Compute the second pass for one part of a tile.

    Parameters
    ----------
    blob : bytes
        A pickled TileTask.
    number : int
        Of the tile.
    part : int
        Of its PART_POINTS points.

    Returns
    -------
    Found
        For the points inside the tile, not for those of its buffer.
    """
    start = time.perf_counter()
    task: TileTask = unpack(blob)
    stage = task.step.stage
    entries = _read_part(task.entries, number, part)
    place = task.place(entries["xyz"])
    own = np.flatnonzero(is_inside(task.tiles, number, place))
    around = _gather(blob, number)
    values, gap = stage.second_pass(place[own], entries["ray"][own], around, **task.step.effective())
    found = np.empty(len(own), _found_dtype(task.step))
    for name, column in zip(found.dtype.names, (*values, gap), strict=True):
        found[name] = column
    return entries["row"][own], found, RunReport(timing={f"{stage.name}, second pass": time.perf_counter() - start})


@functools.lru_cache(maxsize=1)
def _gather(blob: bytes, number: int) -> Surroundings:
    """The points of a tile and its buffer that count as neighbours."""
    task: TileTask = unpack(blob)
    radius = task.step.effective()["radius"]
    kept = np.empty(0, _ENTRY)
    held: list[np.ndarray] = []
    for piece in itertools.chain(task.entries.pieces(number), [None]):
        if piece is not None:
            held.append(piece)
        if held and (piece is None or sum(map(len, held)) >= PART_POINTS):
            kept = np.concatenate([kept, *held])
            kept = kept[thin_out(task.place(kept["xyz"]), kept["row"], radius)]
            held = []
    return Surroundings(task.place(kept["xyz"]))


def _read_part(entries: Spool, number: int, part: int) -> np.ndarray:
    """Entries of a tile that are its PART_POINTS of that number, in the order of their rows."""
    low, high, at = part * PART_POINTS, (part + 1) * PART_POINTS, 0
    found = [np.empty(0, _ENTRY)]
    for piece in entries.pieces(number):
        found.append(piece[max(low - at, 0) : max(high - at, 0)])
        at += len(piece)
        if at >= high:
            break
    return np.concatenate(found)


def _list_entries(rows: np.ndarray, first: int) -> np.ndarray:
    """Entries (n,) of rows that start at the strip's row `first`."""
    entries = np.empty(len(rows), _ENTRY)
    entries["row"] = np.arange(first, first + len(rows))
    for axis, name in enumerate("XYZ"):
        entries["xyz"][:, axis] = rows[name]
    for axis, name in enumerate(rows.dtype.names[-len(RAY) :]):
        entries["ray"][:, axis] = rows[name]
    return entries


def _reach(step: Step) -> float:
    """Width of a tile's buffer [m]: cells that the radius touches must be complete."""
    return step.effective()["radius"] * (1.0 + 2.0 / FINENESS)


def _decode(name: str, values: np.ndarray) -> np.ndarray:
    """Values of a temporary column, NaN where they are no-data."""
    return np.where(values == np.float32(COLUMNS[name].no_data), np.float32(np.nan), values)


def _found_dtype(step: Step) -> np.dtype:
    names = [name for name in step.stage.makes if COLUMNS[name].extra_bytes]
    return np.dtype([*((name, "<f4") for name in names), ("gap", "u1")])
