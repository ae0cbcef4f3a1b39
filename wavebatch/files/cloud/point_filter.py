"""Which points are used: flags, classes, box, polygons and --where, tested and counted in one place.

`run`, `plot`, `stats`, `compare`, `grid`, `voxelize` and `calibrate` make a PointFilter of their options. `plan` looks
up its columns in a file, once; `PlannedFilter.test` tests the rows of every piece.
Before you change it: a row's values and its neighbours must not depend on what is written, only its return numbers do.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.condition import Condition, parse_condition, read_flags
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.files.las.header import LasHeader

if TYPE_CHECKING:
    from wavebatch.files.geojson import Polygon

TESTS = ("drop_flags", "flags", "classes", "bbox", "polygon", "where")
"""The tests in their order: a point that is left out counts for the first one that it does not meet."""

ReadColumn = Callable[[Any], np.ndarray]
"""Gives the values (n,) of a column from rows, NaN for no data."""


@frozen
class PointFilter:
    """Which points are used; picklable. By default all."""

    drop_flags: int = 0
    """EchoFlag bits that points must not have. A row of `run` with one of them is no echo of its pulse, whose return
    numbers are counted without it.
    """
    flags: int = 0
    """EchoFlag bits of which points must have one; 0: any point."""
    classes: tuple[int, ...] = ()
    """Classes that are used; empty: all."""
    bbox: tuple[float, float, float, float] | None = None
    """West, south, east, north in the coordinates of the points; the border belongs to it."""
    polygons: tuple[Polygon, ...] = ()
    """Points must lie in one of them; in the coordinates of their file, those of the points after `place`."""
    polygon_file: Mapping[str, Any] | None = None
    """Path, hash of the corners and CRS of the file of the polygons."""
    where: Condition | None = None
    """Points must meet this."""

    def __bool__(self) -> bool:
        return self != EVERY

    @classmethod
    def build(
        cls,
        *,
        drop_flags: str | None = None,
        classes: Sequence[int] | None = None,
        bbox: Sequence[float] | None = None,
        polygon: Path | str | None = None,
        where: Condition | str | None = None,
    ) -> PointFilter:
        """Make a filter of the options of a run.

        Returns
        -------
        PointFilter

        Raises
        ------
        ConfigError
            For whatever is wrong with them.
        """
        flags = 0 if drop_flags is None else read_flags([drop_flags], "--drop-flags")
        chosen = () if classes is None else tuple(sorted({int(number) for number in classes}))
        if classes is not None and not (chosen and 0 <= chosen[0] <= chosen[-1] <= 255):
            raise ConfigError(f"--classes: {list(classes)} must be numbers from 0 to 255, e.g. 2,6")
        polygons: tuple[Polygon, ...] = ()
        file = None
        if polygon is not None:
            from wavebatch.files.geojson import load_polygons  # most runs have none

            polygons = tuple(load_polygons(polygon))
            # What decides where they lie, besides the header of the strip, which --resume compares too.
            corners = b"".join(ring.tobytes() + b"|" for one in polygons for ring in one.rings)
            crs = next((one.file.crs for one in polygons if one.file is not None), None)
            file = {"file": str(polygon), "corners_sha256": hashlib.sha256(corners).hexdigest(), "crs": crs}
        return cls(
            drop_flags=flags,
            classes=chosen,
            bbox=None if bbox is None else read_bbox(bbox),
            polygons=polygons,
            polygon_file=file,
            where=parse_condition(where) if isinstance(where, str) else where,
        )

    def place(self, path: Path, header: LasHeader) -> PointFilter:
        """Return the filter with polygons in the coordinates of a strip; raises as `Polygon.place`, `check_bbox`."""
        if self.bbox is not None:
            check_bbox(self.bbox, path, header)
        return replace(self, polygons=tuple(one.place(path, header) for one in self.polygons))

    def plan(self, standard: Mapping[str, ReadColumn], find: Callable[[str], ReadColumn], name: str) -> PlannedFilter:
        """Look up the columns that the filter reads.

        Parameters
        ----------
        standard : mapping of str to callable
            The columns echo_flags (without it, no point can be chosen by flags), classification, x and y.
        find : callable
            Gives the column that a name of --where means; raises ConfigError where there is none.
        name : str
            Of the file, for messages.

        Returns
        -------
        PlannedFilter

        Raises
        ------
        ConfigError
            For a column that does not exist; the message says where it stands in --where.
        """
        columns = {}
        if self.where is not None:
            for column in self.where.columns:
                try:
                    columns[column] = find(column)
                except ConfigError as error:
                    raise self.where.complain(column, str(error)) from error
        if (self.flags or self.drop_flags) and "echo_flags" not in standard:
            raise ConfigError(f"{name}: has no column echo_flags to select points by")
        return PlannedFilter(self, standard, columns)

    def describe(self) -> dict[str, Any]:
        """Return plain values for the report and for --resume, with the polygons' corners as a hash and their CRS."""
        file = self.polygon_file
        return {
            "drop_flags": [flag.name for flag in EchoFlag if self.drop_flags & flag],
            "classes": list(self.classes),
            "bbox": None if self.bbox is None else list(self.bbox),
            "polygon": None if file is None else {**file, "file": Path(file["file"]).name},
            "where": None if self.where is None else self.where.text,
        }

    def describe_extent(self, header: LasHeader) -> str:
        """Say that box and placed polygons lie outside a strip by its header; empty where they do not."""
        areas = [[ring for polygon in self.polygons for ring in polygon.rings]]
        areas += [] if self.bbox is None else [[np.array(self.bbox).reshape(2, 2)]]
        areas = [area for area in areas if area]
        if not areas:
            return ""
        from wavebatch.files.geojson import describe_miss

        return next(filter(None, (describe_miss(area, header) for area in areas)), "")


EVERY = PointFilter()
"""All points."""


def read_bbox(bbox: Sequence[float]) -> tuple[float, float, float, float]:
    """Return a box as four numbers; raises ConfigError for any that is empty, or in another order."""
    box = tuple(map(float, bbox))
    if not (len(box) == 4 and 0 < box[2] - box[0] < math.inf and 0 < box[3] - box[1] < math.inf):
        order = "must be west, south, east, north, with west < east and south < north"
        raise ConfigError(f"--bbox: {','.join(f'{edge:.15g}' for edge in box)} {order}")
    return box


def check_bbox(bbox: Sequence[float], path: Path, header: LasHeader) -> None:
    """Raise ConfigError for a box in the order west, east, south, north, where x and y of a strip tell it from ours.

    Such a box is large and holds any part of the strip. It is known by numbers beyond x and y of the strip, the second
    nearer to x, the third nearer to y. In local coordinates, whose x and y are not far apart, a correct box looks so.
    """
    west, south, east, north = bbox
    (left, low, _), (right, high, _) = header.mins, header.maxs
    is_apart = low - right >= 10.0 * max(right - left, high - low)  # x above y would be a box with east below west
    has_width = west < south and east < north  # in our order
    is_whole = west <= left and right <= east and south <= low and high <= north
    would_meet = west <= right and south >= left and east <= high and north >= low
    x, y = 0.5 * (left + right), 0.5 * (low + high)
    is_likely = is_apart and has_width and would_meet and not is_whole
    if is_likely and abs(south - x) < abs(south - y) and abs(east - y) < abs(east - x):
        raise ConfigError(
            f"{path}: --bbox: the order must be west, south, east, north; the strip has x {left:.10g} to {right:.10g}, "
            f"y {low:.10g} to {high:.10g}; give {west:.15g},{east:.15g},{south:.15g},{north:.15g}"
        )


@frozen(eq=False)
class PlannedFilter:
    """A filter whose columns are found, from `PointFilter.plan`; picklable if they are."""

    filter: PointFilter
    standard: Mapping[str, ReadColumn]
    columns: Mapping[str, ReadColumn]
    """Those of --where by their names there."""

    def test(self, rows: Any, n: int) -> np.ndarray:
        """Test n rows.

        Returns
        -------
        int8 (n,)
            0 for rows that are used; for the others the number of the test in TESTS, from 1.
        """
        left = np.zeros(n, np.int8)
        for reason, meets in self._test(rows):
            left[(left == 0) & ~meets] = 1 + TESTS.index(reason)
        return left

    def _test(self, rows: Any) -> Iterator[tuple[str, np.ndarray]]:
        """Each test that is asked for, and whether the rows meet it, bool (n,)."""
        asked, read = self.filter, self.standard
        if asked.drop_flags:
            yield "drop_flags", (read["echo_flags"](rows) & np.uint16(asked.drop_flags)) == 0
        if asked.flags:
            yield "flags", (read["echo_flags"](rows) & np.uint16(asked.flags)) != 0
        if asked.classes:
            yield "classes", np.isin(read["classification"](rows), asked.classes)
        if asked.bbox is not None or asked.polygons:
            x, y = read["x"](rows), read["y"](rows)
            if asked.bbox is not None:
                west, south, east, north = asked.bbox
                yield "bbox", (x >= west) & (x <= east) & (y >= south) & (y <= north)
            if asked.polygons:
                from wavebatch.files.geojson import find_inside

                inside = [find_inside(one.rings, x, y) for one in asked.polygons]
                yield "polygon", np.logical_or.reduce(inside)
        if asked.where is not None:
            yield "where", asked.where.choose({name: column(rows) for name, column in self.columns.items()})
