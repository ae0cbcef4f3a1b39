"""Space cut into boxes with about as many points each, so that neighbourhoods can be handled box by box.

Used by batch/neighbour_pass. Every point lies in exactly one tile; a buffer adds the points around.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


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
