"""Two strips where they overlap: differences of brightness and height on flat places that both saw.

`wavebatch compare --overlap` calls `compare_overlap`. It does not pair echoes, since two strips have none in common:
medians of single echoes in cells are compared, as in the calibration of a flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import PASSED_THROUGH, UNCLEAN
from wavebatch.core.errors import InputError
from wavebatch.core.order import group_medians, robust_std
from wavebatch.core.units import MEDIAN_ERROR
from wavebatch.files.cloud.echo_reader import CloudReader
from wavebatch.surveying.calibrating.tie_cells import TIE, Ties, choose_size, hash_squares, measure_ties

LIGHT_COLUMNS = ("backscatter_coefficient", "relative_backscatter")
"""Columns that depend on the angle of incidence, as the cosine does on matt surfaces."""

OVERLAP_COLUMNS = (*LIGHT_COLUMNS, "reflectance", "relative_reflectance")
"""These, and columns from which the angle is taken off."""

ANGLE = "incidence_angle_normals"

OVERLAP_DTYPE = np.dtype(
    [
        ("xyz", "<f8", 3), ("scan_angle", "<f4"), (ANGLE, "<f4"), ("total", "u1"), ("flags", "<u2"),
        *((f"{name}{end}", "<f4") for name in OVERLAP_COLUMNS for end in ("", "_err")),
    ]  # fmt: skip
)
"""What is read of clouds."""

MOST_ECHOES = 1_000_000
"""Most echoes of a cloud that are used; they come from whole squares of 10 m, spread by chance."""

LEVEL = 5.0
"""Largest slope [deg] of cells on which the scan angle stands for the angle of incidence."""

BLOCK = 50.0
"""Edge of blocks [m] that count as independent: neighbouring cells share fields, roads and wet ground."""


@dataclass(frozen=True, slots=True)
class OverlapFigure:
    """How a column, or the height, differs between two clouds; NaN where no cell has it in both."""

    cells: int
    median: float
    """A over B less 1; for the height A less B [m]."""
    error: float
    """Standard deviation of the median, from the scatter between blocks of 50 m."""
    nmad: float
    """Robust standard deviation between cells."""
    stated: float = math.nan
    """Relative error that the clouds state for one echo, of both together; mostly that of the calibration."""


@dataclass(frozen=True, slots=True)
class OverlapComparison:
    """Differences of two strips on flat cells with single echoes of both."""

    a: str
    b: str
    cell: float
    """Edge of a cell [m]."""
    height: OverlapFigure
    columns: dict[str, OverlapFigure]
    """Columns that both clouds have: gamma and its like without the cosine of the angle of incidence."""
    angles: str
    """Where that angle comes from: `normals` (column incidence_angle_normals) or `scan angle` (on level cells only)."""


def compare_overlap(a: Path, b: Path) -> OverlapComparison:
    """Compare two clouds where they overlap.

    Parameters
    ----------
    a, b : Path
        Clouds of two strips, best of `wavebatch run` with a calibration.

    Returns
    -------
    OverlapComparison

    Raises
    ------
    InputError
        Where a cloud cannot be read, or they do not overlap.
    """
    with CloudReader(a, OVERLAP_DTYPE) as first, CloudReader(b, OVERLAP_DTYPE) as second:
        rows = [_read(first, second), _read(second, first)]
        shared = set(first.columns) & set(second.columns)
        angles = "normals" if ANGLE in shared else "scan angle"
    if not all(map(len, rows)):
        raise InputError(f"{a} and {b}: have no single echoes in a common area; they do not overlap")
    origin = rows[0]["xyz"][0]
    size = choose_size(_table(rows, [np.ones(len(part)) for part in rows], origin))
    height = _tie(rows, [np.ones(len(part)) for part in rows], origin, size)
    columns = {}
    for name in OVERLAP_COLUMNS:
        if name in shared:
            values = [_take_off_angle(part, name, angles) for part in rows]
            level = name in LIGHT_COLUMNS and angles != "normals"
            ties = _tie(rows, values, origin, size, math.radians(LEVEL) if level else None)
            stated = math.hypot(*(_typical_error(part, name) for part in rows))
            figure = _summarise(ties, np.expm1(_difference(ties, ties.value)), stated)
            columns[name] = (
                replace(figure, error=math.hypot(figure.error, _azimuth_error(ties, rows))) if level else figure
            )
    return OverlapComparison(
        str(a), str(b), size, _summarise(height, _difference(height, height.height)), columns, angles
    )


def _read(reader: CloudReader, other: CloudReader) -> np.ndarray:
    """Single echoes of a cloud inside the box of the other, array of OVERLAP_DTYPE."""
    low, high = (np.array(corner[:2]) for corner in other.bounds)
    share = min(1.0, MOST_ECHOES / max(reader.point_count, 1))
    parts = [np.empty(0, OVERLAP_DTYPE)]
    for rows in reader.read_pieces():
        rows = rows[(rows["total"] <= 1) & ((rows["flags"] & np.uint16(PASSED_THROUGH | UNCLEAN)) == 0)]
        near = ((rows["xyz"][:, :2] >= low) & (rows["xyz"][:, :2] <= high)).all(axis=1)
        near &= hash_squares(rows["xyz"]) < share
        parts.append(rows[near])
    return np.concatenate(parts)


def _take_off_angle(rows: np.ndarray, name: str, angles: str) -> np.ndarray:
    """The column as a surface that faces the sensor would have it."""
    if name not in LIGHT_COLUMNS:
        return rows[name].astype(np.float64)
    angle = rows[ANGLE if angles == "normals" else "scan_angle"].astype(np.float64)
    angle[~(np.abs(angle) < 90)] = np.nan  # no surface is seen from there
    return rows[name] / np.cos(np.radians(angle))


def _table(rows: list[np.ndarray], values: list[np.ndarray], origin: np.ndarray) -> np.ndarray:
    parts = []
    for source, (part, value) in enumerate(zip(rows, values, strict=True)):
        known = np.isfinite(value) & (value > 0)
        short = np.zeros(int(known.sum()), TIE)
        short["xyz"] = part["xyz"][known] - origin
        # The angle is off already: a ray straight down adds the same factor to both clouds.
        short["ray"], short["light"], short["source"] = (0.0, 0.0, -1.0), value[known], source
        parts.append(short)
    return np.concatenate(parts)


def _tie(
    rows: list[np.ndarray], values: list[np.ndarray], origin: np.ndarray, size: float, slope: float | None = None
) -> Ties:
    return measure_ties(_table(rows, values, origin), size, slope)


def _difference(ties: Ties, values: np.ndarray) -> np.ndarray:
    """Values of a less those of b in each cell; rows of ties are sorted by cell, then source."""
    first = np.flatnonzero(ties.source == 0)
    return values[first] - values[first + 1]


def _summarise(ties: Ties, difference: np.ndarray, stated: float = math.nan) -> OverlapFigure:
    if not len(difference):
        return OverlapFigure(0, math.nan, math.nan, math.nan, stated)
    middle = float(np.median(difference))
    spread = robust_std(difference)
    centre = ties.centre[ties.source == 0]
    _, block = np.unique(np.floor(centre / BLOCK), axis=0, return_inverse=True)
    block = block.ravel()
    means = group_medians(difference, block)[0]
    apart = MEDIAN_ERROR * robust_std(means) / math.sqrt(len(means))
    return OverlapFigure(
        len(difference), middle, max(apart, MEDIAN_ERROR * spread / math.sqrt(len(difference))), spread, stated
    )


def _azimuth_error(ties: Ties, rows: list[np.ndarray]) -> float:
    """Relative error that slopes of level cells leave, since the scan angle does not say from which side a ray came."""
    angles = [np.radians(np.abs(part["scan_angle"])) for part in rows]
    seen = math.hypot(*(math.tan(float(np.median(angle))) for angle in angles))
    return seen * float(np.median(ties.slope)) if len(ties.slope) else math.nan


def _typical_error(rows: np.ndarray, name: str) -> float:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        relative = rows[f"{name}_err"] / rows[name]
    relative = relative[np.isfinite(relative)]
    return float(np.median(relative)) if len(relative) else math.nan
