"""Dead zones: the shortest distances of two returns of a pulse that occur, by return number, from histograms.

`returns` adds the distances of all pairs. A sensor that looks for its second and its third return in another way has
another dead zone for each, so there is one per return number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from wavebatch.tools.return_stats.areas import RANKS

BIN, BINS = 0.01, 10_000
"""Width [m] and number of the bins of distances: to 1 cm, up to 100 m."""

LEAST_PAIRS = 100
"""Fewer pairs give no dead zone."""

EDGE = 0.001
"""Share of the distances that may lie within the dead zone, so that a few duplicate points do not hide it."""

_NEXT = 10
"""Pairs above the edge from which the distance of neighbouring pairs is measured."""


@dataclass(frozen=True, slots=True)
class DeadZone:
    """The shortest distance between a return and the next one."""

    pairs: int
    size: float
    """Distance [m], to 1 cm, below which at most one pair in a thousand lies. NaN with fewer than LEAST_PAIRS, and
    where it lies in the last bin, which holds all larger distances too (100 m)."""
    error: float
    """How much shorter the sensor's own distance may well be [m]: where pairs are rare, none is at the very edge. To
    1 mm; NaN where the size is."""


class Distances:
    """Histograms of the distances between consecutive returns, one per class of RANKS."""

    def __init__(self) -> None:
        self.bins = np.zeros((len(RANKS), BINS), np.int64)

    def add(self, number: np.ndarray, distance: np.ndarray) -> None:
        """Adds pairs; number: return number of the first of each, from 1, (k,). distance: f8 (k,) [m]."""
        rank = np.minimum(number.astype(np.int64), len(RANKS)) - 1
        place = np.minimum(distance / BIN, BINS - 1).astype(np.int64)
        np.add.at(self.bins, (rank, place), 1)

    def merge(self, other: Distances) -> None:
        """Adds the pairs of another cloud."""
        self.bins += other.bins

    def list_zones(self) -> dict[str, DeadZone]:
        """The dead zone of `all` pairs, and of the classes of RANKS that have pairs."""
        zones = {"all": find_dead_zone(self.bins.sum(axis=0))}
        return zones | {name: find_dead_zone(bins) for name, bins in zip(RANKS, self.bins, strict=True) if bins.any()}

    def count_hidden(self, size: float) -> int:
        """Pairs that a dead zone would hold if they were as frequent there as up to twice its size."""
        return int(self.bins[:, round(size / BIN) : round(2 * size / BIN)].sum())


def find_dead_zone(bins: np.ndarray) -> DeadZone:
    """The dead zone of the pairs of a histogram: the 0.1 % quantile of their distances."""
    pairs = int(bins.sum())
    if pairs < LEAST_PAIRS:
        return DeadZone(pairs, math.nan, math.nan)
    below = np.cumsum(bins)
    edge = int(np.searchsorted(below, EDGE * pairs, side="right"))
    if edge == BINS - 1:
        return DeadZone(pairs, math.nan, math.nan)
    # The pairs that were left out may be pairs of surfaces: then the edge is as many gaps between pairs below.
    rank = int(EDGE * pairs) + 1
    gap = (int(np.searchsorted(below, rank + _NEXT)) - edge) * BIN / _NEXT
    return DeadZone(pairs, round(edge * BIN, 2), round(max(rank * gap, BIN), 3))
