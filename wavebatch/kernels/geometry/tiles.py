"""Space cut into boxes with about as many points each, so that neighbourhoods can be worked on box by box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Tiles(NamedTuple):
    """A tree of cuts across x, y or z; its leaves are the tiles, which together fill space."""

    axis: np.ndarray
    """Axis that a node cuts, -1 for leaves, i8 (nodes,)."""
    at: np.ndarray
    """Where: the second child has what is not below, f8 (nodes,) [m]."""
    child: np.ndarray
    """First child of a node, the second one follows; the tile's number for leaves, i8 (nodes,)."""
    low: np.ndarray
    """Lower corners of the tiles, f8 (tiles, 3)."""
    high: np.ndarray
    """Upper corners, which the tiles do not hold themselves, f8 (tiles, 3)."""

    def __len__(self) -> int:
        return len(self.low)


def cut_tiles(sample: np.ndarray, most: int, least_side: float) -> Tiles:
    """Tiles that hold at most `most` points of the sample (k, 3), or are at most `least_side` [m] wide."""
    axis, at, child, low, high = [-1], [0.0], [0], [], []
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
    """Tiles that points (n, 3) lie in or within `buffer` [m] of: rows and tiles, a pair for each.

    Rows ascend within a tile. A corner's buffer is a box, so that some points further off are listed too.
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
    """Whether points (n, 3) lie in a tile, bool (n,): every point lies in exactly one."""
    inside = np.ones(len(xyz), bool)
    for axis in range(3):
        inside &= (xyz[:, axis] >= tiles.low[number, axis]) & (xyz[:, axis] < tiles.high[number, axis])
    return inside
