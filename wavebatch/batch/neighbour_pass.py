"""Columns that need a point's neighbours: a second pass over a strip's rows, tile by tile, before they are a cloud.

The rows of all units are kept in a file beside the cloud. When the last one is there, their positions are sorted into
tiles of about as many points each, with a buffer around. Tiles are worked on anywhere, in any order; what they find is
kept by row, and filled in while the cloud is written. A value depends on the points within the stage's radius alone,
whatever the tiles are.
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
from wavebatch.batch.unit import unpack
from wavebatch.core.echoes import COLUMNS, RAY
from wavebatch.core.no_data import NoData
from wavebatch.files.cloud.layout import OutputLayout
from wavebatch.files.disk.row_file import RowStore
from wavebatch.files.disk.spool import Spool
from wavebatch.kernels.geometry.normals import FINENESS, Gap, Surroundings, thin_out
from wavebatch.kernels.geometry.tiles import Tiles, cut_tiles, is_inside, sort_into_tiles
from wavebatch.stages.chain import Step

TILE_POINTS = 150_000
"""Points of a tile, about, without its buffer."""

SAMPLE = 1 << 18
"""Most points by which tiles are cut; then every second one is dropped."""

PART_POINTS = 1 << 18
"""Most points of a tile that are worked on at a time: a tile has more only where hardly any space holds very many."""

_ENTRY = np.dtype([("row", "<i8"), ("xyz", "<i4", 3), ("ray", "<f4", 3)])
_REASONS = {
    Gap.KNOWN: NoData.KNOWN,
    Gap.FEW_NEIGHBOURS: NoData.FEW_NEIGHBOURS,
    Gap.NO_PLANE: NoData.NO_PLANE,
    Gap.TOO_STEEP: NoData.TOO_STEEP,
    Gap.UNCERTAIN: NoData.UNCERTAIN,
}

Found = tuple[np.ndarray, np.ndarray, RunReport]
"""Rows (m,), ascending, what was found for them, and the time it took."""


@dataclass(frozen=True, slots=True, eq=False)
class TileTask:
    """All that the tiles of a strip share; picklable."""

    step: Step
    tiles: Tiles
    entries: Spool
    """Points by tile, those of the buffer too."""
    scales: tuple[float, float, float]

    def place(self, xyz: np.ndarray) -> np.ndarray:
        """Positions [m] of stored coordinates, i4 (n, 3), but for the file's offset."""
        return xyz * np.array(self.scales)


class SecondPass:
    """The rows of one strip: `add` all, `cut` them into tiles, `take` what is found in each `next_tile`, read `rows`.

    layout: of the cloud; rows come as `layout.extended(RAY)` has them. target: the cloud, beside which the rows wait.
    tile_points: TILE_POINTS by default; the result does not depend on it.
    """

    def __init__(self, step: Step, layout: OutputLayout, target: Path, *, tile_points: int | None = None) -> None:
        self._step, self._layout = step, layout
        self._tile_points = tile_points or TILE_POINTS
        self._rows = RowStore(target, layout.extended(RAY).dtype)
        self._found = RowStore(target, _found_dtype(step))
        self._entries: Spool | None = None
        self._blob = b""
        self._parts: deque[tuple[int, int]] = deque()
        self._waiting = 0
        self._gaps = np.zeros(len(Gap), np.int64)
        self._sample, self._every = [np.empty((0, 3))], 1

    def add(self, rows: np.ndarray) -> None:
        """Keeps rows (m,), in the order in which they will be written."""
        first = -len(self._rows) % self._every
        self._sample.append(self._place(rows[first :: self._every]))
        self._rows.add(rows)
        while sum(map(len, self._sample)) > SAMPLE:
            self._sample = [np.concatenate(self._sample)[::2].copy()]
            self._every *= 2

    def cut(self) -> RunReport:
        """Sorts all rows into tiles."""
        start = time.perf_counter()
        reach = _reach(self._step)
        sample = np.concatenate(self._sample)
        self._sample = []
        sample = sample[np.isfinite(sample).all(axis=1)]
        # Tiles much smaller than their buffers would list every point many times.
        tiles = cut_tiles(sample, max(self._tile_points // self._every, 1), 8 * reach)
        self._found.extend(len(self._rows))
        self._entries = Spool(len(tiles), _ENTRY)
        counts, at = np.zeros(len(tiles), np.int64), 0
        for rows in self._rows.pieces():
            place = self._place(rows)
            able = np.flatnonzero(np.isfinite(place).all(axis=1))
            index, tile = sort_into_tiles(tiles, place[able], reach)
            counts += np.bincount(tile, minlength=len(tiles))
            self._entries.append(tile, _list_entries(rows, at)[able[index]])
            at += len(rows)
        task = TileTask(self._step, tiles, self._entries.seal(), self._layout.scales)
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
        """Whether all that was cut is done."""
        return not self._parts and not self._waiting

    def next_tile(self) -> tuple[bytes, int, int]:
        """Arguments of `process_tile`, whose result is what `take` wants."""
        self._waiting += 1
        return (self._blob, *self._parts.popleft())

    def take(self, result: Found) -> RunReport:
        """Keeps what was found in a tile."""
        index, found, report = result
        self._found.put(index, found)
        self._waiting -= 1
        return report

    def rows(self) -> Iterator[np.ndarray]:
        """All rows as the cloud's layout has them, with what was found."""
        final = self._layout.dtype
        fields = zip(self._layout.extra_fields[len(self._layout.carried) :], self._layout.written, strict=True)
        filled = [(field, column) for field, column in fields if column.column in self._found.dtype.names]
        for rows, found in zip(self._rows.pieces(), self._found.pieces(), strict=True):
            self._gaps += np.bincount(found["gap"], minlength=len(Gap))
            known = found["gap"] == Gap.KNOWN
            for field, column in filled:
                rows[field] = column.encode(np.where(known, found[column.column], np.float32(np.nan)))
            plain = rows.view(np.uint8).reshape(len(rows), -1)[:, : final.itemsize]
            yield np.ascontiguousarray(plain).view(final)[:, 0]

    def count_reasons(self, echoes: int) -> dict[str, dict[str, int]]:
        """Echoes of the strip by what became of them, once all rows were read; for RunReport.no_data."""
        counts = {reason.name: int(self._gaps[gap]) for gap, reason in _REASONS.items()}
        counts[NoData.NO_RAY.name] = echoes - sum(counts.values())
        return {self._found.dtype.names[0]: {name: number for name, number in counts.items() if number}}

    def close(self) -> None:
        """Removes all temporary files; harmless twice."""
        self._rows.close()
        self._found.close()
        if self._entries is not None:
            self._entries.close()

    def _place(self, rows: np.ndarray) -> np.ndarray:
        return np.stack([rows[name] for name in "XYZ"], axis=1) * np.array(self._layout.scales)


def process_tile(blob: bytes, number: int, part: int) -> Found:
    """What a tile's own points get, of those among the part's PART_POINTS; blob: a pickled TileTask."""
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
    """How far around its own points a tile needs others [m]: the cells within the radius must be whole."""
    return step.effective()["radius"] * (1.0 + 2.0 / FINENESS)


def _found_dtype(step: Step) -> np.dtype:
    names = [name for name in step.stage.makes if COLUMNS[name].extra_bytes]
    return np.dtype([*((name, "<f4") for name in names), ("gap", "u1")])
