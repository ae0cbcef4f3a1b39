"""Angles between rays and the surface through the points around, for many points at once.

Used by the second pass of the stage attribute.incidence_angle_normals. The result of a point must not depend on the
tile it is computed in: neighbours are thinned, sorted and summed in an order that tiles do not change.

`cut_tiles` cuts space into boxes with about as many points each, so that batch/neighbour_pass handles neighbourhoods
box by box: every point lies in exactly one tile, and a buffer adds the points around.
"""

from __future__ import annotations

import ctypes
from enum import IntEnum

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels import library
from wavebatch.kernels.geometry.planes import (
    FLAT,
    Planes,
    compare_halves,
    fit_planes,
    in_two_lines,
    measure_angles,
    misfit_of_angles,
)
from wavebatch.kernels.physics.incidence import STEEPEST


class Tiles(NamedTuple):
    """A tree of cuts across x, y or z; its leaves are the tiles, which together fill space."""

    axis: np.ndarray
    """Axis that a node cuts, -1 for leaves, int64 (nodes,)."""
    at: np.ndarray
    """Place of the cut: the second child has what is not below, float64 (nodes,), m."""
    child: np.ndarray
    """First child of a node, the second one follows; for leaves the number of the tile, int64 (nodes,)."""
    low: np.ndarray
    """Lower corners of the tiles, float64 (tiles, 3), m."""
    high: np.ndarray
    """Upper corners, which do not belong to the tiles, float64 (tiles, 3), m."""

    def __len__(self) -> int:
        """Number of tiles."""
        return len(self.low)


def cut_tiles(sample: np.ndarray, most: int, least_side: float) -> Tiles:
    """Tiles with at most a number of points, or of a smallest size.

    Parameters
    ----------
    sample : float64 (k, 3), m
        A sample of the points.
    most : int
        Largest number of points of the sample in a tile ...
    least_side : float, m
        ... unless they are at most this wide.

    Returns
    -------
    Tiles
    """
    low: list[np.ndarray] = []
    high: list[np.ndarray] = []
    axis, at, child = [-1], [0.0], [0]
    waiting = [(0, sample, np.full(3, -np.inf), np.full(3, np.inf))]
    while waiting:
        node, points, lower, upper = waiting.pop()
        extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
        wide = int(np.argmax(extent))
        if len(points) <= most or not extent[wide] > least_side:
            child[node] = len(low)
            low.append(lower)
            high.append(upper)
            continue
        values = points[:, wide]
        cut = float(np.partition(values, len(values) // 2)[len(values) // 2])
        if cut == values.min():
            cut = float(values[values > cut].min())
        axis[node], at[node], child[node] = wide, cut, len(axis)
        axis, at, child = [*axis, -1, -1], [*at, 0.0, 0.0], [*child, 0, 0]
        middle_high, middle_low = upper.copy(), lower.copy()
        middle_high[wide] = middle_low[wide] = cut
        waiting.append((child[node] + 1, points[values >= cut], middle_low, upper))
        waiting.append((child[node], points[values < cut], lower, middle_high))
    return Tiles(np.array(axis), np.array(at), np.array(child), np.array(low), np.array(high))


def sort_into_tiles(tiles: Tiles, xyz: np.ndarray, buffer: float) -> tuple[np.ndarray, np.ndarray]:
    """Tiles that points lie in, or near.

    Parameters
    ----------
    tiles : Tiles
        All tiles.
    xyz : float64 (n, 3), m
        Points.
    buffer : float, m
        Distance up to which a point is near a tile; at corners it is a box, so that some points further off are listed
        too.

    Returns
    -------
    rows, numbers : int64 (k,)
        A pair of point and tile for each; rows ascend within a tile.
    """
    rows, numbers = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    waiting = [(0, np.arange(len(xyz)))]
    while waiting:
        node, index = waiting.pop()
        if not len(index):
            continue
        if tiles.axis[node] < 0:
            rows.append(index)
            numbers.append(np.full(len(index), tiles.child[node]))
            continue
        values = xyz[index, tiles.axis[node]]
        waiting.append((tiles.child[node], index[values < tiles.at[node] + buffer]))
        waiting.append((tiles.child[node] + 1, index[values >= tiles.at[node] - buffer]))
    return np.concatenate(rows), np.concatenate(numbers)


def is_inside(tiles: Tiles, number: int, xyz: np.ndarray) -> np.ndarray:
    """Whether points lie in one tile; every point lies in exactly one.

    Parameters
    ----------
    tiles : Tiles
        All tiles.
    number : int
        Number of the tile.
    xyz : float64 (n, 3), m
        Points.

    Returns
    -------
    bool (n,)
    """
    inside = np.ones(len(xyz), bool)
    for axis in range(3):
        inside &= (xyz[:, axis] >= tiles.low[number, axis]) & (xyz[:, axis] < tiles.high[number, axis])
    return inside


PAIRS = 500_000
"""Pairs of neighbours that are handled at a time, about 100 bytes each."""

FINENESS = 4.0
"""Radius of a neighbourhood divided by the side of the cells in which dense points are thinned."""

MOST_PER_CELL = 4
"""Points of a cell that count as neighbours: a surface has at most 200, even if points are dense."""

LEAST_KEPT = 0.6
"""Smallest share of the neighbours that must lie in the plane."""

RING, MOST_NEIGHBOURS = 5, 128
"""Echoes within one distance of pulses of another, with itself; and the most that are looked at."""

SPACED = 2000
"""Echoes from which the distance of pulses is measured."""

SAME_RAY = 0.1
"""Distance over the reach of a footprint below which two echoes are of one pulse."""

_CELLS = 2**20
"""Cells of Surroundings on either side of its first point, along each axis: their number has 63 bits."""

_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd factors that make one number of 64 bits of three, or a lot of one."""

_LARGEST_CHUNK = 4096
"""Points that are handled at a time at most."""


class Gap(IntEnum):
    """Why a point has no angle; KNOWN if it has one."""

    NO_RAY = 0
    """No waveform, no echo, or a direction of length 0."""
    KNOWN = 1
    """It has an angle."""
    FEW_NEIGHBOURS = 2
    """Fewer than min_points neighbours, or all that are in the plane on one or two scan lines."""
    NO_PLANE = 3
    """The neighbours form no plane that the point lies in."""
    TOO_STEEP = 4
    """The ray nearly lies in the plane."""
    UNCERTAIN = 5
    """The angle is less certain than max_error."""


def thin_out(xyz: np.ndarray, row: np.ndarray, radius: float) -> np.ndarray:
    """Which points count as neighbours of others: at most MOST_PER_CELL in each cell.

    Parameters
    ----------
    xyz : float64 (n, 3), m
        Positions.
    row : int64 (n,)
        Places in the file; a hash of them decides which points of a full cell stay, so that the choice is the same in
        every tile that holds the whole cell.
    radius : float, m
        Of the neighbourhoods.

    Returns
    -------
    bool (n,)
    """
    cell = np.floor(xyz / (radius / FINENESS)).astype(np.int64).view(np.uint64)
    number = cell[:, 0] * _MIX[0] + cell[:, 1] * _MIX[1] + cell[:, 2] * _MIX[2]  # no two cells have one
    order = np.argsort(number)
    number = number[order]
    start = np.flatnonzero(np.append(True, number[1:] != number[:-1])) if len(order) else np.empty(0, np.int64)
    count = np.diff(np.append(start, len(order)))
    full = np.flatnonzero(np.repeat(count > MOST_PER_CELL, count))
    lot = row[order[full]].astype(np.uint64) * _MIX[0]
    by_lot = np.lexsort((lot, number[full]))
    rank = (np.arange(len(order)) - np.repeat(start, count))[full]
    kept = np.ones(len(order), bool)
    kept[order[full[by_lot]]] = rank < MOST_PER_CELL
    return kept


class Surroundings:
    """Points (m, 3) [m], finite, that may be neighbours of others. Sums run in the order of these points.

    They are sorted into cells by the first radius that is asked for; those of `widest` [m] serve down to half of it.
    """

    def __init__(self, xyz: np.ndarray, widest: float = 0.0) -> None:
        self._xyz = np.ascontiguousarray(xyz, np.float64)
        self._side, self._widest = 0.0, widest * (1 + 1e-6)

    def _number_cells(self, points: np.ndarray) -> np.ndarray:
        """Cells of points, counted along x, then y, then z; what is far away is in the outermost ones."""
        cell = np.clip(np.floor((points - self._xyz[0]) / self._side), 2 - _CELLS, _CELLS - 2).astype(np.int64)
        return (cell[:, 2] * 2 * _CELLS + cell[:, 1]) * 2 * _CELLS + cell[:, 0]

    def find(self, points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Pairs (point, neighbour) that are at most `radius` apart.

        Parameters
        ----------
        points : float64 (n, 3), m
            Points to look around.
        radius : float, m
            Largest distance.

        Returns
        -------
        point : int64 (k,)
            Number of the point; pairs are sorted by point, then neighbour.
        offset : float64 (k, 3), m
            From the point to the neighbour.
        """
        if not len(points) or not len(self._xyz):
            return np.empty(0, np.int64), np.empty((0, 3))
        points, side = np.ascontiguousarray(points, np.float64), radius * (1 + 1e-6)
        if not side <= self._side <= 2 * side:  # larger cells serve too
            self._side = self._widest if side <= self._widest <= 2 * side else side
            cell = self._number_cells(self._xyz)
            self._order = np.argsort(cell)
            self._cell, self._sorted = cell[self._order], self._xyz[self._order]
        # Neighbours are at most one cell away; cells along x follow each other.
        away = np.array([-1, 0, 1])
        row = self._number_cells(points)[:, None] + ((away[:, None] * 2 * _CELLS + away) * 2 * _CELLS).ravel()
        first, last = np.searchsorted(self._cell, row - 1), np.searchsorted(self._cell, row + 1, side="right")
        key = np.empty(int((last - first).sum()), np.int64)
        n, m = ctypes.c_int64(len(points)), ctypes.c_int64(len(self._xyz))
        square = ctypes.c_double(radius * radius)
        found = library.call("find_around", n, points, first, last, self._sorted, self._order, m, square, key)
        point, neighbour = np.divmod(np.sort(key[:found]), len(self._xyz))
        return point, self._xyz.take(neighbour, axis=0) - points.take(point, axis=0)


def measure_normals(
    points: np.ndarray, ray: np.ndarray, around: Surroundings, *, radius: float, min_points: int, max_error: float,
    pairs: int = PAIRS,
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Angle between ray and surface normal at each point.

    The surface is the robust plane through the neighbours.

    Parameters
    ----------
    points : float64 (n, 3), m
        Positions.
    ray : float (n, 3)
        Directions, of any length.
    around : Surroundings
        Points that count as neighbours.
    radius : float, m
        Of the neighbourhood.
    min_points : int
        Smallest number of neighbours.
    max_error : float, deg
        Angles that are less certain are not given.
    pairs : int
        Pairs of neighbours at a time, about; bounds memory.

    Returns
    -------
    (angle, error) : float32 (n,), deg
        Angle and its standard deviation, with what two planes in place of one would change; NaN where `gap` is not
        KNOWN.
    gap : uint8 (n,)
        Codes of Gap. NO_PLANE: less than 60 % of the neighbours in the plane, thicker than a fifth of its width, the
        point itself not in it, or two planes (a ridge) fit so much better that the angle may be off by more than
        max_error. TOO_STEEP: the ray nearly lies in the plane; plants seen by one sweep of the scanner form such a
        plane, which is no surface.
        FEW_NEIGHBOURS: also where those in the plane lie on one or two scan lines, through which a plane always goes.
    """
    angle, error = np.full((2, len(points)), np.nan, np.float32)
    gap = np.full(len(points), Gap.NO_RAY, np.uint8)
    x, y, z = np.ascontiguousarray(ray.T, np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.sqrt(x * x + y * y + z * z)
        unit = np.stack([x / length, y / length, z / length], axis=1)  # NaN where the length is 0
    able = np.flatnonzero(np.isfinite(unit).all(axis=1) & np.isfinite(points).all(axis=1))
    # Cell by cell: points that are searched together should lie together.
    able = able[np.lexsort(tuple(np.floor(points[able, axis] / (8 * radius)) for axis in (2, 1, 0)))]
    at, size = 0, 512
    while at < len(able):
        rows = able[at : at + size]
        at += len(rows)
        point, offset = around.find(points[rows], radius)
        angles, errors, gap[rows] = _judge(offset, point, unit[rows], min_points, np.radians(max_error))
        angle[rows], error[rows] = np.degrees(angles), np.degrees(errors)
        size = int(np.clip(pairs * len(rows) // max(len(point), 1), 64, _LARGEST_CHUNK))
    return (angle, error), gap


def _judge(
    offset: np.ndarray, point: np.ndarray, unit: np.ndarray, min_points: int, max_error: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles and errors [rad] of points from their neighbours, NaN where the Gap is not KNOWN."""
    n = len(unit)
    count = np.bincount(point, minlength=n)
    planes = fit_planes(offset, point, n)
    angle, error = measure_angles(planes, unit)
    flat = planes.spreads[:, 0] <= FLAT * planes.spreads[:, 1]
    surface = flat & (planes.kept >= LEAST_KEPT * count) & (planes.kept >= min_points)
    surface &= planes.offset() <= planes.limit
    folded = np.zeros(n)
    rows = np.flatnonzero(surface)
    # How far angles may be off because the neighbours are two planes [rad].
    apart, of, some = _take(offset, point, planes, rows)
    folded[rows] = misfit_of_angles(compare_halves(apart, of, some), some, unit[rows])
    surface &= ~((error <= max_error) & (np.hypot(error, folded) > max_error))
    untried = np.zeros(n, bool)
    # A plane through two scan lines only, which nothing could contradict.
    apart = apart - some.centre.take(of, axis=0)
    axes = (some.axes[:, :, axis].take(of, axis=0) for axis in range(3))
    away, u, v = (np.einsum("ki,ki->k", apart, one) for one in axes)
    near = np.abs(away) <= some.limit.take(of)
    untried[rows] = in_two_lines(u[near], v[near], of[near], len(rows))
    error = np.hypot(error, folded)
    gap = np.where(error <= max_error, Gap.KNOWN, Gap.UNCERTAIN)
    gap = np.where(angle > STEEPEST, Gap.TOO_STEEP, gap)
    gap = np.where(surface, gap, Gap.NO_PLANE)
    gap = np.where((count < min_points) | (untried & surface), Gap.FEW_NEIGHBOURS, gap).astype(np.uint8)
    known = gap == Gap.KNOWN
    return np.where(known, angle, np.nan), np.where(known, error, np.nan), gap


def _take(
    offset: np.ndarray, point: np.ndarray, planes: Planes, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Planes]:
    """Only the neighbourhoods of some points, numbered by their place among these."""
    place = np.full(len(planes.kept), -1)
    place[rows] = np.arange(len(rows))
    local = place.take(point)
    near = np.flatnonzero(local >= 0)
    return offset.take(near, axis=0), local.take(near), Planes(*(part[rows] for part in planes))


def find_edges(
    points: np.ndarray, ray: np.ndarray, time: np.ndarray, before: np.ndarray, after: np.ndarray, reach: float
) -> np.ndarray:
    """Find echoes beside which the next pulse, or the same one, met a surface outside of the packet.

    Parameters
    ----------
    points : float64 (m, 3), m
        Positions.
    ray : float64 (m, 3)
        Unit vectors away from the sensor; those of neighbours are nearly parallel.
    time : float64 (m,), s
        Of the pulse.
    before, after : float64 (m,), m
        How far the packet of each echo reaches towards the sensor and away from it.
    reach : float, m
        How far the footprint reaches from its centre.

    Returns
    -------
    bool (m,)

    Notes
    -----
    Neighbours are those of the rays, by where they meet one level: behind a roof the ground begins metres away in plan.
    """
    edge = np.zeros(len(points), bool)
    able = np.flatnonzero(np.isfinite(points).all(axis=1) & np.isfinite(ray).all(axis=1) & (ray[:, 2] != 0))
    if len(able) < 2:
        return edge
    with np.errstate(invalid="ignore", divide="ignore"):
        level = points[:, :2] - (points[:, 2:] - np.median(points[able, 2])) * (ray[:, :2] / ray[:, 2:])
    from scipy.spatial import cKDTree  # here, because most runs need none of it

    tree = cKDTree(level[able])
    few = level[able[:: max(len(able) // SPACED, 1)]]
    spacing = float(np.median(tree.query(few, k=[min(RING, len(able))])[0]))
    # The footprint reaches over the edge, and so does that of the pulses behind it that still see this surface.
    most = 2.0 * reach + spacing
    given = [values[able] for values in (level, points[:, 2], ray, time, before, after)]
    rows = able[_may_lie_apart(most, *given)]
    number = int(np.clip(np.ceil(1.5 * np.pi * (most / max(spacing, 1e-6)) ** 2), RING, MOST_NEIGHBOURS))
    for start in range(0, len(rows), _LARGEST_CHUNK):
        own = rows[start : start + _LARGEST_CHUNK]
        apart, near = tree.query(level[own], k=min(number + 1, len(able)), distance_upper_bound=most)
        other = able[np.minimum(near, len(able) - 1)]
        deeper = np.einsum("mki,mi->mk", points[other] - points[own][:, None], ray[own])
        mine = (apart < SAME_RAY * reach) & (time[other] == time[own, None])
        deep = (deeper > after[own, None]) & np.isfinite(apart)
        # One echo alone, as noise makes them, is no surface.
        edge[own] = (deep.sum(axis=1) > 1) | ((deep | (deeper < -before[own, None])) & mine).any(axis=1)
    return edge


def _may_lie_apart(
    most: float,
    level: np.ndarray, z: np.ndarray, ray: np.ndarray, time: np.ndarray, before: np.ndarray, after: np.ndarray,
) -> np.ndarray:
    """Whether the cell of an echo, or one of those around it, has heights that lie outside of its packet, bool (m,)."""
    cell = np.floor((level - level.min(axis=0)) / most)
    width = cell[:, 1].max() + 3.0
    cells, own = np.unique(cell[:, 0] * width + cell[:, 1], return_inverse=True)
    ends = np.full((2, len(cells)), -np.inf)
    np.maximum.at(ends[0], own, -z)
    np.maximum.at(ends[1], own, z)
    reach = ends.copy()
    for step in (a * width + b for a in (-1, 0, 1) for b in (-1, 0, 1)):
        at = np.minimum(np.searchsorted(cells, cells + step), len(cells) - 1)
        there = cells[at] == cells + step
        reach[:, there] = np.maximum(reach[:, there], ends[:, at[there]])
    tilt, down = most * np.hypot(*ray[:, :2].T), np.abs(ray[:, 2])
    lower, higher = (reach[0][own] + z) / down + tilt, (reach[1][own] - z) / down + tilt
    _, pulse, number = np.unique(time, return_inverse=True, return_counts=True)
    return (lower > after) | ((higher > before) & (number[pulse] > 1))
