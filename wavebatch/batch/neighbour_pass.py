"""Columns that need the points around an echo: a second pass over a strip's points before its rows are made.

1. Workers run the chain on all units (`begin_unit`). Their rows wait in temporary files next to the cloud, with the
   echoes, but not the samples, where stages need the columns.
2. `cut` sorts the places into tiles of about equal numbers of points, each with a buffer around it.
3. Workers process tiles in any order with `process_tile`; results are kept by row.
4. Workers finish the units (`end_unit`): stages that need the columns run again, and the rows are filled and chosen.

Before you change it: a value must depend on the points within the stage's radius alone, whatever the tiles are.
"""

from __future__ import annotations

import functools
import itertools
import pickle
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.batch.counts import RunReport
from wavebatch.batch.output_rows import spread
from wavebatch.batch.unit import Prepared, UnitResult, finish_rows, solve_unit, unpack
from wavebatch.core.echoes import COLUMNS, SUFFIX, EchoTable, NoData, count_reasons
from wavebatch.core.errors import StageError
from wavebatch.core.frozen import frozen
from wavebatch.core.process import Seconds
from wavebatch.files.disk.temp_store import SPOOL_MEMORY, STORE_PIECE, RowStore, Spool
from wavebatch.files.las.header import field_names
from wavebatch.kernels.geometry import normals
from wavebatch.stages.chain import Step
from wavebatch.surveying.sensor import LARGEST_MISS

TILE_POINTS = 150_000
"""Points of a tile without its buffer, roughly."""

SAMPLE = 1 << 18
"""Most points of the sample that tiles are cut by; when it is full, every second point is dropped."""

PART_POINTS = 1 << 18
"""Most points of a tile that are processed at a time, to bound memory where very many lie in one place."""

ENTRY = np.dtype([("row", "<i8"), ("xyz", "<i4", 3), ("ray", "<f4", 3)])
"""One row: its number, its position as it is stored, and the unit vector of its ray (NaN: none)."""

_REASONS = np.array([NoData[gap.name] for gap in normals.Gap], np.uint8)
"""Why an echo has no value, by its gap."""

PROTOCOL = pickle.HIGHEST_PROTOCOL

Found = tuple[np.ndarray, np.ndarray, RunReport]
"""Rows i8 (m,), ascending; the values found for them, as `_found_dtype` has them; and the timing."""


@frozen(eq=False)
class TileTask:
    """Everything that the tiles of a strip share; picklable."""

    step: Step
    tiles: normals.Tiles
    entries: Spool
    """Points by tile, including those of its buffer."""
    scales: tuple[float, ...]
    part_points: int
    """Most points of a tile that are processed at a time."""

    def place(self, xyz: np.ndarray) -> np.ndarray:
        """Return positions [m] without the file's offset, f8 (n, 3), of stored coordinates, i4 (n, 3)."""
        return xyz * np.array(self.scales)


class SecondPass:
    """The second pass of one strip: `add` all units, `cut` them, `take` the result of each `next_call`.

    Parameters
    ----------
    step : Step
        Of the chain, with a second pass.
    scales : tuple of float
        Of the stored positions.
    target : Path
        The cloud; temporary files lie next to it.
    tile_points, sample, part_points, spooled : int
        What is in memory at a time; the result does not depend on them.
    """

    def __init__(
        self, step: Step, scales: tuple[float, ...], target: Path, *, tile_points: int = TILE_POINTS,
        sample: int = SAMPLE, part_points: int = PART_POINTS, spooled: int = SPOOL_MEMORY,
    ) -> None:  # fmt: skip
        self._step, self._scales = step, scales
        self._tile_points, self._most, self._part_points, self._spooled = tile_points, sample, part_points, spooled
        self._rows, self._states = RowStore(target, ENTRY), RowStore(target, np.dtype("u1"))
        self._found = RowStore(target, _found_dtype(step))
        self._entries: Spool | None = None
        self._blob = b""
        self._parts: deque[tuple[int, int]] = deque()
        self._units: deque[tuple[slice, slice]] = deque()
        self._tiles_left = self._units_left = 0
        self._sample, self._every = [np.empty((0, 3))], 1

    def add(self, rows: np.ndarray, kept: np.ndarray) -> None:
        """Keep entries and state of `begin_unit`, in the order of the units."""
        first = -self._rows.count % self._every
        self._sample.append(rows["xyz"][first :: self._every] * np.array(self._scales))
        entries, states = self._rows.count, self._states.count
        self._units.append((slice(entries, entries + len(rows)), slice(states, states + len(kept))))
        self._rows.add(rows)
        self._states.add(kept)
        while sum(map(len, self._sample)) > self._most:
            self._sample = [np.concatenate(self._sample)[::2].copy()]
            self._every *= 2

    def cut(self) -> RunReport:
        """Sort all rows into tiles, once all units are there; returns the timing. May be called again."""
        if self._entries is not None:
            return RunReport()
        start = Seconds.now()
        # Width of a tile's buffer [m]: cells that the radius touches must be complete.
        reach = self._step.effective()["radius"] * (1.0 + 2.0 / normals.FINENESS)
        sample = np.concatenate(self._sample)
        self._sample = []
        sample = sample[np.isfinite(sample).all(axis=1)]
        # Tiles much smaller than their buffers would list each point many times.
        tiles = normals.cut_tiles(sample, max(self._tile_points // self._every, 1), 8 * reach)
        self._found.extend(self._rows.count)
        self._entries = Spool(len(tiles), ENTRY, memory=self._spooled)
        counts, at = np.zeros(len(tiles), np.int64), 0
        for rows in self._rows.pieces(min(self._part_points, STORE_PIECE)):
            rows["row"] = np.arange(at, at + len(rows))
            place = rows["xyz"] * np.array(self._scales)
            able = np.flatnonzero(np.isfinite(place).all(axis=1))
            index, tile = normals.sort_into_tiles(tiles, place[able], reach)
            counts += np.bincount(tile, minlength=len(tiles))
            self._entries.append(tile, rows[able[index]])
            at += len(rows)
        task = TileTask(self._step, tiles, self._entries.seal(), self._scales, self._part_points)
        self._blob = pickle.dumps(task, PROTOCOL)
        for number, count in enumerate(counts.tolist()):
            self._parts.extend((number, part) for part in range(-(-count // self._part_points)))
        self._tiles_left, self._units_left = len(self._parts), len(self._units)
        return RunReport(timing={"tiles": Seconds.now() - start})

    @property
    def has_more(self) -> bool:
        """Whether there is a `next_call`: of tiles, and once all of them are done of units."""
        return bool(self._parts or self._units_left and not self._tiles_left and self._units)

    @property
    def is_complete(self) -> bool:
        """Whether all units are finished."""
        return self._entries is not None and not self._tiles_left + self._units_left

    def next_call(self, blob: bytes) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Return the next function to call and its arguments; blob: as for `begin_unit`."""
        if self._parts:
            return process_tile, (self._blob, *self._parts.popleft())
        rows, state = self._units.popleft()
        return end_unit, (blob, self._states.read(state.start, state.stop), self._found.read(rows.start, rows.stop))

    def take(self, result: Any) -> UnitResult | RunReport:
        """Take the result of the oldest call: a finished unit, or of a tile the report."""
        if not self._tiles_left:
            self._units_left -= 1
            return result
        self._found.put(*result[:2])
        self._tiles_left -= 1
        return result[2]

    def close(self) -> None:
        """Remove all temporary files; harmless twice."""
        for store in (self._rows, self._states, self._found, self._entries):
            if store is not None:
                store.close()


def begin_unit(blob: bytes, number: int, block_size: int | None) -> tuple[tuple[np.ndarray, np.ndarray], RunReport]:
    """Run the chain on one unit.

    Parameters
    ----------
    blob, number, block_size
        As for `process_unit`.

    Returns
    -------
    entries, state : array
        ENTRY (m,), without numbers; and what `end_unit` needs, u1 (k,).
    report : RunReport
        The timing.
    """
    prepared: Prepared = unpack(blob)
    timing: dict[str, Seconds] = {}
    solved, echoes, made = solve_unit(prepared, number, block_size, timing)
    needed = {name: made.columns[name] for name in ("echo_flags", *prepared.needed)}
    chain = prepared.job.chain
    kept = [(index, chain.keep_needed(block)) for index, block in solved] if chain.after_second else []
    state = np.frombuffer(pickle.dumps((made._replace(columns=needed), kept), PROTOCOL), np.uint8)
    entries = np.zeros(len(made.rows), ENTRY)
    for axis, name in enumerate("XYZ"):
        entries["xyz"][:, axis] = made.rows[name]
    x, y, z = echoes.direction.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        length = np.sqrt(x * x + y * y + z * z)
        unit = (echoes.direction / length[:, None]).astype(np.float32)
    sensor = prepared.sensor
    if sensor.kind == "direction vectors" and sensor.distance is not None:
        # The vectors of most pulses meet in the path. Those of a stretch that do not are no directions of its rays.
        # Where the path is not known, nothing speaks against them.
        most = (LARGEST_MISS + np.radians(sensor.turned)) * sensor.distance
        for index, (block, *_) in solved:
            if block.sensor is not None:
                miss = np.square(np.cross(block.origin - block.sensor, unit[index])).sum(axis=1)
                unit[index[miss > most * most]] = np.nan
    ray = unit[echoes.table.waveform]
    entries["ray"] = np.append(ray, np.full((1, 3), np.nan, np.float32), axis=0)[made.echo]
    return (entries, state), RunReport(timing=timing)


def end_unit(blob: bytes, state: np.ndarray, found: np.ndarray) -> UnitResult:
    """Make the rows of a unit that are written, once the second pass has been over its points.

    Parameters
    ----------
    blob
        As for `begin_unit`.
    state : u1 (k,)
        From `begin_unit`.
    found : structured array (m,)
        Of the unit's rows.

    Returns
    -------
    UnitResult
    """
    _gather.cache_clear()  # tiles are done: their memory is needed for the unit
    prepared: Prepared = unpack(blob)
    timing: dict[str, Seconds] = {}
    made, solved = pickle.loads(state.data)
    has_echo = made.echo >= 0
    by_echo = np.zeros(len(made.counted), found.dtype)
    by_echo[made.echo[has_echo]] = found[has_echo]
    first, *_ = names = field_names(found.dtype)[:-1]
    if f"{first}_err" in names and prepared.second_step is not None:
        # A ray that is off turns the angle by as much: no plane of points shows it.
        error = by_echo[f"{first}_err"] = np.hypot(by_echo[f"{first}_err"], np.float32(prepared.sensor.turned))
        most = prepared.second_step.effective().get("max_error", np.inf)
        by_echo["gap"][(by_echo["gap"] == normals.Gap.KNOWN) & (error > most)] = normals.Gap.UNCERTAIN
    known = by_echo["gap"] == normals.Gap.KNOWN
    values = {name: np.where(known, by_echo[name], np.float32(np.nan)) for name in names}
    values[f"{first}{SUFFIX}"] = _REASONS[by_echo["gap"]]
    if solved:
        # Stages that need the columns of the second pass; these (k,) are by packet, as `gather_echoes` sorts.
        chain = prepared.job.chain
        order = np.argsort(np.concatenate([index[block.echoes.waveform] for index, block in solved]), kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        tables, at = [], 0
        for _, block in solved:
            rows = place[at : at + len(block.echoes)]
            echoes = block.echoes.with_attributes(**{name: column[rows] for name, column in values.items()})
            tables.append((chain.solve_again(block._replace(echoes=echoes), timing), 0))
            at += len(rows)
        more = EchoTable.concatenate(tables).take(order).attributes
        makes = [name for step in chain.after_second for name in step.stage.makes]
        values |= {name: more[name] for one in makes for name in (one, f"{one}{SUFFIX}") if name in more}
    columns = {name: spread(name, column, made.echo) for name, column in values.items() if name in COLUMNS}
    prepared.layout.fill(made.rows, columns)
    reasons = count_reasons({name: codes[made.counted] for name, codes in values.items()})
    report = replace(made.report, no_data={**made.report.no_data, **reasons})
    return finish_rows(prepared, made.rows, {**made.columns, **columns}, report, timing)


def process_tile(blob: bytes, number: int, part: int) -> Found:
    """Compute the second pass for one part of a tile.

    Parameters
    ----------
    blob : bytes
        A pickled TileTask.
    number : int
        Of the tile.
    part : int
        Of its points, `part_points` at a time.

    Returns
    -------
    Found
        For the points inside the tile, not for those of its buffer.
    """
    start = Seconds.now()
    task: TileTask = unpack(blob)
    stage = task.step.stage
    if stage.second_pass is None:
        raise StageError(f"{stage.name} has no second pass; please report it as a bug")
    low, high, at = part * task.part_points, (part + 1) * task.part_points, 0
    pieces = [np.empty(0, ENTRY)]
    for piece in task.entries.pieces(number):
        pieces.append(piece[max(low - at, 0) : max(high - at, 0)])
        at += len(piece)
        if at >= high:
            break
    entries = np.concatenate(pieces)
    place = task.place(entries["xyz"])
    own = np.flatnonzero(normals.is_inside(task.tiles, number, place))
    around = _gather(blob, number)
    values, gap = stage.second_pass(place[own], entries["ray"][own], around, **task.step.effective())
    found = np.empty(len(own), _found_dtype(task.step))
    for name, column in zip(field_names(found.dtype), (*values, gap), strict=True):
        found[name] = column
    return entries["row"][own], found, RunReport(timing={f"{stage.name}, second pass": Seconds.now() - start})


@functools.lru_cache(maxsize=1)
def _gather(blob: bytes, number: int) -> normals.Surroundings:
    """The points of a tile and its buffer that count as neighbours."""
    task: TileTask = unpack(blob)
    radius = task.step.effective()["radius"]
    kept = np.empty(0, ENTRY)
    waiting: list[np.ndarray] = []
    for piece in itertools.chain(task.entries.pieces(number), [None]):
        if piece is not None:
            waiting.append(piece)
        if waiting and (piece is None or sum(map(len, waiting)) >= task.part_points):
            kept = np.concatenate([kept, *waiting])
            kept = kept[normals.thin_out(task.place(kept["xyz"]), kept["row"], radius)]
            waiting = []
    return normals.Surroundings(task.place(kept["xyz"]))


def _found_dtype(step: Step) -> np.dtype:
    names = [name for name in step.stage.makes if COLUMNS[name].extra_bytes]
    return np.dtype([*((name, "<f4") for name in names), ("gap", "u1")])
