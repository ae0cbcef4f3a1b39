"""Sums over the voxels of a grid: rays, light, path, energy and cross section.

`strip.voxelize_strip` adds the rays of every block, then writes `pieces`. Sums are integers, in the units below, so
that the result does not depend on block size or order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.key_sums import HELD, KeyedSums
from wavebatch.kernels.geometry.voxels import (
    Crossings,
    cross_voxels,
    differences_along,
    fits_keys,
    pack_index,
    split_rays,
    total_until,
    unpack_index,
)
from wavebatch.tools.voxels.rays import RayTable, measure_lengths

LIGHT_UNIT = 2.0**-30
"""Unit in which light is summed [rays]."""

PATH_UNIT = 2.0**-20
"""Unit in which path is summed [m]."""

SECTION_UNIT = 2.0**-40
"""Unit in which cross sections are summed [m2]."""

_RAYS, _LIGHT, _CAUGHT, _PATH, _ENERGY, _SECTION, _UNKNOWN = range(7)


@dataclass(frozen=True, slots=True)
class VoxelColumn:
    """One value of a voxel."""

    name: str
    dtype: str
    unit: str
    meaning: str
    """With the unit at most 32 bytes, for the description in LAS."""
    no_data: float | None = None
    """Value for no data in LAS; .npz files have NaN."""


COLUMNS = (
    VoxelColumn("energy", "f4", "DN ns", "signal from the voxel"),
    VoxelColumn("cross_section", "f4", "m2", "backscatter cross section", -9999.0),
    VoxelColumn("rays", "u4", "-", "rays that crossed with light"),
    VoxelColumn("path", "f4", "m", "length of these rays in it"),
    VoxelColumn("light", "f4", "rays", "light that reached it"),
    VoxelColumn("share", "f4", "-", "share of it returned here", -9999.0),
)
"""Values of every voxel; cross_section only with a calibration."""


def energy_unit(bits: int) -> float:
    """Unit in which energies are summed [DN ns]: fine, but with room for the sum of all samples in 63 bits."""
    return 2.0**-20 if bits <= 16 else 2.0**-8


class VoxelGrid(Closing):
    """Sums of the rays of a strip per voxel; a context manager, since large sums lie partly on disk.

    size: of the voxels [m]; faces lie at multiples of it. anchor: index of a voxel in the middle of the strip, counted
    from the origin of the coordinates, i8 (3,). unit: of energies [DN ns]. sections: whether rays have cross sections.
    everything: also keeps voxels that rays crossed without any signal. held: see KeyedSums.
    """

    def __init__(
        self, size: float, anchor: np.ndarray, unit: float, *, sections: bool, everything: bool, held: int = HELD
    ) -> None:
        self.size, self.anchor = size, anchor
        self.columns = tuple(column for column in COLUMNS if sections or column.name != "cross_section")
        self._unit, self._sections, self._everything = unit, sections, everything
        self._sums = KeyedSums(7 if sections else 5, held=held)
        self._low = np.full(3, np.iinfo(np.int64).max)
        self._high = np.full(3, np.iinfo(np.int64).min)
        self._energy = 0
        self.rays = 0
        """Rays that were added."""
        self.outside = 0
        """Rays left out: their position is not a number, or too far from all others."""
        self.unknown = 0
        """Rays with signal of unknown cross section."""

    def close(self) -> None:
        """Removes what lies on disk."""
        self._sums.close()

    @property
    def energy(self) -> float:
        """Energy of all voxels [DN ns]."""
        return self._energy * self._unit

    @property
    def low(self) -> np.ndarray:
        """Least index of the voxels that are kept, from the origin of the coordinates, i8 (3,); 0 without any."""
        return np.where(self._low > self._high, 0, self._low + self.anchor)

    @property
    def shape(self) -> np.ndarray:
        """Voxels from the least to the largest index that is kept, i8 (3,)."""
        return np.where(self._low > self._high, 0, self._high - self._low + 1)

    def add(self, rays: RayTable, spacing: float) -> None:
        """Adds the rays of a block; spacing: of their samples [ns]."""
        local = rays.start - self.anchor * self.size
        good = np.flatnonzero(fits_keys(local, rays.step, rays.begin, rays.end, self.size))
        self.outside += len(local) - len(good)
        self.rays += len(good)
        rays, local = rays.take(good), local[good]
        self.unknown += int(rays.unknown.sum())
        for part in split_rays(local, rays.step, rays.begin, rays.end, self.size):
            some = rays.take(part)
            found = cross_voxels(local[part], some.step, some.begin, some.end, self.size)
            values = self._list_values(found, some, spacing)
            kept = slice(None) if self._everything else values[:, _ENERGY] > 0
            index = found.index[kept]
            if len(index):
                self._low = np.minimum(self._low, index.min(axis=0))
                self._high = np.maximum(self._high, index.max(axis=0))
            self._energy += int(values[:, _ENERGY].sum())
            self._sums.add(pack_index(found.index), values)

    def _list_values(self, found: Crossings, rays: RayTable, spacing: float) -> np.ndarray:
        """Values that every crossing adds to its voxel, i8 (m, columns); over a ray they add up to its total."""
        ray = found.ray
        first = np.append(True, ray[1:] != ray[:-1])[: len(ray)]

        def spread(total: np.ndarray, unit: float) -> np.ndarray:
            before = np.where(first, 0.0, total_until(total, ray, found.enter, spacing))
            return differences_along(_count(before, unit), ray, _count(total[:, -1], unit))

        whole = rays.caught[:, -1:]
        part = rays.caught / np.where(whole > 0, whole, 1.0)
        values = np.zeros((len(ray), 7 if self._sections else 5), np.int64)
        values[:, _RAYS] = 1
        values[:, _CAUGHT] = spread(part, LIGHT_UNIT)
        values[:, _LIGHT] = _count(1.0, LIGHT_UNIT) - _sum_before(values[:, _CAUGHT], first)
        values[:, _PATH] = _count(found.inside * measure_lengths(rays.step)[ray], PATH_UNIT)
        values[:, _ENERGY] = spread(rays.energy, self._unit)
        if self._sections:
            values[:, _SECTION] = spread(rays.section, SECTION_UNIT)
            values[:, _UNKNOWN] = rays.unknown[ray] & (values[:, _ENERGY] > 0)
        return values

    def pieces(self) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Index and columns of the voxels, some at a time, in the order of x, then y, then z.

        The index i8 (m, 3) counts from `low`.
        """
        for key, sums in self._sums.pieces():
            if not self._everything:
                some = np.flatnonzero(sums[:, _ENERGY] > 0)
                key, sums = key[some], sums[some]
            yield unpack_index(key) - self._low, self._finish(sums)

    def _finish(self, sums: np.ndarray) -> dict[str, np.ndarray]:
        light, caught = sums[:, _LIGHT], sums[:, _CAUGHT]
        columns = {
            "energy": sums[:, _ENERGY] * self._unit,
            "rays": sums[:, _RAYS],
            "path": sums[:, _PATH] * PATH_UNIT,
            "light": light * LIGHT_UNIT,
            "share": np.where(light > 0, caught / np.maximum(light, 1), np.nan),
        }
        if self._sections:
            columns["cross_section"] = np.where(sums[:, _UNKNOWN] > 0, np.nan, sums[:, _SECTION] * SECTION_UNIT)
        return {column.name: columns[column.name].astype(column.dtype) for column in self.columns}


def _count(values: np.ndarray | float, unit: float) -> np.ndarray:
    return np.rint(values * (1.0 / unit)).astype(np.int64)


def _sum_before(values: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Sum of the earlier values of the same ray, (m,); first: True where a ray begins."""
    before = np.cumsum(values) - values
    return before - before[first][np.cumsum(first) - 1] if len(values) else before
