"""Which rows of a strip are written: --drop-flags, --classes, --bbox, --polygon and --where of `wavebatch run`.

`cli.run` and the public API build a `RowFilter`; workers apply it to the rows of each unit. Every row that is left
out is counted by the first reason, in the order above.
Before you change it: a row's values and its neighbours must not depend on what is written, only its return numbers do.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.batch.counts import LEFT_OUT, RunReport, count_flags
from wavebatch.batch.options import RunOptions
from wavebatch.core.condition import Condition, parse_condition, read_flags
from wavebatch.core.echoes import COLUMNS, EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.files.area_crs import describe_miss
from wavebatch.files.cloud.column_names import resolve
from wavebatch.files.cloud.echo_reader import name_standard, read_field
from wavebatch.files.cloud.layout import OutputLayout
from wavebatch.files.geojson import Polygon, find_inside, load_polygons
from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.point_formats import read_classes, split_numbers
from wavebatch.stages.chain import STAGES, Chain

WITHOUT_STAGE = ("echo_time", "echo_flags")
"""Columns that need no attribute stage."""


@dataclass(frozen=True, slots=True)
class RowFilter:
    """What is written of a strip; picklable. By default everything."""

    drop_flags: int = 0
    """EchoFlag bits: rows with one of them are no echoes of their pulse, whose return numbers are counted without them.
    """
    classes: tuple[int, ...] = ()
    """Classes that are written; empty: all."""
    bbox: tuple[float, float, float, float] | None = None
    """West, south, east, north of the part that is written, in the coordinates of the strip; the border belongs to it.
    """
    polygon: str | None = None
    """The file of `polygons`."""
    polygons: tuple[Polygon, ...] = ()
    """Rows must lie in one of them; in the coordinates of the file."""
    placed: tuple[Polygon, ...] | None = None
    """The same in the coordinates of the strip; None: not yet placed."""
    where: Condition | None = None
    """Rows must meet this."""

    def __bool__(self) -> bool:
        return self != RowFilter()

    def place(self, facts: CheckedHeader) -> RowFilter:
        """Return the selection with its polygons in the coordinates of a strip; raises as `Polygon.place`."""
        if not self.polygons:
            return self
        return replace(self, placed=tuple(one.place(facts.path, facts.header) for one in self.polygons))

    @property
    def areas(self) -> tuple[Polygon, ...]:
        """The polygons to test rows with."""
        return self.polygons if self.placed is None else self.placed

    def describe(self) -> dict[str, Any]:
        """Return plain values for the report and for --resume, with the polygons' corners as a hash and their CRS."""
        return {
            "drop_flags": [flag.name for flag in EchoFlag if self.drop_flags & flag],
            "classes": list(self.classes),
            "bbox": None if self.bbox is None else list(self.bbox),
            "polygon": None if self.polygon is None else self._describe_polygons(),
            "where": None if self.where is None else self.where.text,
        }

    def _describe_polygons(self) -> dict[str, Any]:
        """All that decides where they lie; the strip's part of it is in its header, which --resume compares too."""
        rings = [ring for polygon in self.polygons for ring in polygon.rings]
        corners = hashlib.sha256(b"".join(ring.tobytes() + b"|" for ring in rings)).hexdigest() if rings else None
        crs = next((polygon.file.crs for polygon in self.polygons if polygon.file is not None), None)
        return {"file": Path(self.polygon or "").name, "corners_sha256": corners, "crs": crs}

    def list_wanted(self) -> tuple[str, ...]:
        """Return the wavebatch columns that --where names exactly, so that the chain gets their stages."""
        named = () if self.where is None else self.where.columns
        return tuple(name for name in named if name in COLUMNS and COLUMNS[name].extra_bytes)


@dataclass(frozen=True, slots=True, eq=False)
class RowSelector:
    """A selection on the rows of one strip, from `plan`."""

    selection: RowFilter
    layout: OutputLayout
    """Of the cloud."""
    sources: Mapping[str, tuple[str, str]]
    """What each name of --where stands for: `computed`, `standard` or `carried`, and the column or field."""

    @classmethod
    def plan(cls, selection: RowFilter, chain: Chain, layout: OutputLayout) -> RowSelector:
        """Return the selector of a strip.

        Parameters
        ----------
        selection : Selection
        chain : Chain
            That makes the rows.
        layout : OutputLayout

        Returns
        -------
        RowSelector

        Raises
        ------
        ConfigError
            Where --where names a column that the rows do not have.
        """
        where = selection.where
        made = [name for name in chain.makes if name in COLUMNS and COLUMNS[name].extra_bytes]
        fields = zip(layout.carried, layout.extra_fields, strict=False)
        names = {
            "computed": {name: name for name in [*made, *WITHOUT_STAGE]},
            "standard": name_standard(layout.point_format),
            "carried": {one.record.name: field for one, field in fields if not layout.dtype[field].shape},
        }
        kinds = [{name: (kind, meant) for name, meant in known.items()} for kind, known in names.items()]
        if where is None:
            return cls(selection, layout, {})
        sources = {name: resolve(name, *kinds) for name in where.columns}
        for name in [name for name, source in sources.items() if source is None]:
            makers = [stage.name for stage in STAGES.values() if name in stage.makes and name in COLUMNS]
            remedy = nearest(name, [one for known in kinds for one in known])
            if makers:
                remedy = f"chain {chain.name} does not compute it; add stage {' or '.join(makers)} to it"
            raise where.complain(name, f"{layout.source.path}: there is no column {name!r}; {remedy}")
        return cls(selection, layout, sources)

    @property
    def needed(self) -> tuple[str, ...]:
        """The computed columns that decide what is written."""
        return tuple(found for kind, found in self.sources.values() if kind == "computed")

    def select(self, rows: np.ndarray, columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, RunReport]:
        """Choose the rows that are written.

        Parameters
        ----------
        rows : structured array (m,)
            In the cloud's layout.
        columns : mapping of str to array (m,)
            Those `needed` and echo_flags as they were computed, whatever the cloud's names and units.

        Returns
        -------
        rows : structured array (k,)
            Those that are written.
        report : RunReport
            Points and flags that are written, and points left out by reason.
        """
        left = np.zeros(len(rows), np.int64)
        for number, meets in enumerate(self._test(rows, columns) if self.selection else (), 1):
            left = np.where((left == 0) & ~np.asarray(meets), number, left)
        kept = left == 0
        numbers = np.bincount(left, minlength=len(LEFT_OUT) + 1)[1:].tolist()
        report = RunReport(
            counts={"points_out": int(np.count_nonzero(kept))},
            last_left_out=self._count_last(rows, left),
            left_out={name: number for name, number in zip(LEFT_OUT, numbers, strict=True) if number},
            flags=count_flags(columns["echo_flags"][kept]),
        )
        return rows if kept.all() else rows[kept], report

    def _count_last(self, rows: np.ndarray, left: np.ndarray) -> int:
        """Rows (m,) that are the last of their pulse and left out by --where; left: number of the reason (m,)."""
        number, total = split_numbers(rows[left == len(LEFT_OUT)])
        return int(np.count_nonzero(number == total))

    def _test(self, rows: np.ndarray, columns: Mapping[str, np.ndarray]) -> Iterator[np.ndarray | bool]:
        """Whether rows (m,) are written as far as each reason of LEFT_OUT is concerned, bool (m,) or for all."""
        chosen, header = self.selection, self.layout.source.header
        yield (columns["echo_flags"] & np.uint16(chosen.drop_flags)) == 0
        yield not chosen.classes or np.isin(read_classes(rows), chosen.classes)
        x, y = (rows[name] * header.scales[axis] + header.offsets[axis] for axis, name in enumerate("XY"))
        west, south, east, north = chosen.bbox or (-math.inf, -math.inf, math.inf, math.inf)
        yield chosen.bbox is None or (x >= west) & (x <= east) & (y >= south) & (y <= north)
        yield not chosen.areas or np.logical_or.reduce([find_inside(one.rings, x, y) for one in chosen.areas])
        values = {name: self._read(*source, rows, columns) for name, source in self.sources.items()}
        yield chosen.where is None or chosen.where.choose(values)

    def _read(self, kind: str, found: str, rows: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values (m,) of a column, NaN for no data."""
        if kind == "computed":
            return columns[found].astype(COLUMNS[found].dtype, copy=False)
        if kind == "carried":
            at = self.layout.extra_fields.index(found)
            return self.layout.carried[at].record.read(rows[found])
        return read_field(rows, self.layout.point_format, found, self.layout.source.header)


def build_selection(options: RunOptions) -> RowFilter:
    """Check the options of a selection.

    Parameters
    ----------
    options : RunOptions

    Returns
    -------
    Selection

    Raises
    ------
    ConfigError
        For whatever is wrong with them.
    """
    classes, bbox, polygon, where = options.classes, options.bbox, options.polygon, options.where
    flags = 0 if options.drop_flags is None else read_flags([options.drop_flags], "--drop-flags")
    chosen = () if classes is None else tuple(sorted({int(number) for number in classes}))
    if classes is not None and not (chosen and 0 <= chosen[0] <= chosen[-1] <= 255):
        raise ConfigError(f"--classes: {list(classes)} must be numbers from 0 to 255, e.g. 2,6")
    box: Any = None if bbox is None else tuple(map(float, bbox))
    if box is not None and not (len(box) == 4 and box[0] < box[2] < math.inf and box[1] < box[3] < math.inf):
        given = list(bbox or [])
        raise ConfigError(f"--bbox: {given} must be west, south, east, north, with west < east and south < north")
    return RowFilter(
        drop_flags=flags,
        classes=chosen,
        bbox=box,
        polygon=None if polygon is None else str(polygon),
        polygons=() if polygon is None else tuple(load_polygons(polygon)),
        where=parse_condition(where) if isinstance(where, str) else where,
    )


def describe_extent(layout: OutputLayout, selection: RowFilter) -> str:
    """Say that the areas lie outside the strip by its header; empty where they do not, or where there is none."""
    header = layout.source.header
    areas = [[ring for polygon in selection.areas for ring in polygon.rings]]
    areas += [] if selection.bbox is None else [[np.array(selection.bbox).reshape(2, 2)]]
    return next(filter(None, (describe_miss(area, header) for area in areas if area)), "")
