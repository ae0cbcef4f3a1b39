"""Sums over the voxels of a grid: rays, light, path, energy and cross section.

`strip.voxelize_strip` adds the rays of every block, then writes `pieces`. Sums are integers, in the units below, so
that the result does not depend on block size or order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.disk.temp_store import HELD, KeyedSums
from wavebatch.kernels.geometry.voxels import (
    KEY_BITS,
    Crossings,
    VoxelSamples,
    cross_voxels,
    differences_along,
    fits_keys,
    pack_index,
    split_rays,
    sum_before,
    unpack_index,
)
from wavebatch.kernels.physics.gap_probability import measure_attenuation
from wavebatch.tools.voxels.floor import Floor
from wavebatch.tools.voxels.rays import LightRule, Rays, measure_lengths

LIGHT_UNIT = 2.0**-30
"""Unit in which light is summed [rays]."""

PATH_UNIT = 2.0**-20
"""Unit in which path is summed [m]."""

SECTION_UNIT = 2.0**-40
"""Unit in which cross sections are summed [m2]."""

_RAYS, _LIGHT, _CAUGHT, _PATH, _ENERGY, _SQUARES, _CAUGHT_BY_RATIO, _LIGHT_BY_RATIO, _SECTION, _UNKNOWN = range(10)
_GROUND, _FREE = 10, 11

_NEXT_Y = np.uint64(1 << KEY_BITS[2])
"""From the key of a voxel to that of its neighbour along y."""

_CLASSES = 40
"""Classes of voxels, by doublings of the rays in them."""

_LEAST_PAIRS = 10.0
"""Pairs of neighbours that weigh as much as the spread of all classes."""

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
    VoxelColumn("share_error", "f4", "-", "std of share, 1 sigma", -9999.0),
)
"""Values of every voxel; cross_section only with a calibration."""

FOREST_COLUMNS = (
    VoxelColumn("height", "f4", "m", "centre above the ground", -9999.0),
    VoxelColumn("ground", "f4", "-", "share returned by ground", -9999.0),
    VoxelColumn("free_path", "f4", "m", "light times its path"),
    VoxelColumn("attenuation", "f4", "1/m", "caught by plants", -9999.0),
    VoxelColumn("attenuation_error", "f4", "1/m", "std of attenuation", -9999.0),
)
"""Further values that forest metrics need. free_path: light times the way that it goes in the voxel until it is caught.
attenuation: the part of the light that plants catch per metre."""


def energy_unit(bits: int) -> float:
    """Unit in which energies are summed [DN ns]: fine, but with room for the sum of all samples in 63 bits."""
    return 2.0**-20 if bits <= 16 else 2.0**-8


class VoxelGrid(Closing):
    """Sums of the rays of a strip per voxel; a context manager, since large sums lie partly on disk.

    size: of the voxels [m]; faces lie at multiples of it. anchor: index of a voxel in the middle of the strip, counted
    from the origin of the coordinates, i8 (3,). unit: of energies [DN ns]. sections: whether rays have cross sections.
    everything: also keeps voxels that rays crossed without any signal. floor: the ground, for FOREST_COLUMNS; None:
    without them. held: see KeyedSums.
    """

    def __init__(
        self,
        size: float,
        anchor: np.ndarray,
        unit: float,
        *,
        sections: bool,
        everything: bool,
        floor: Floor | None = None,
        held: int = HELD,
    ) -> None:
        self.size, self.anchor = size, anchor
        self.columns = tuple(column for column in COLUMNS if sections or column.name != "cross_section")
        self.columns += () if floor is None else FOREST_COLUMNS
        self._unit, self._sections, self._everything, self._floor = unit, sections, everything, floor
        self._width = 8 if floor is None and not sections else 10 if floor is None else 12
        self._sums = KeyedSums(self._width, held=held)
        self._low = np.full(3, np.iinfo(np.int64).max)
        self._high = np.full(3, np.iinfo(np.int64).min)
        self._energy = 0
        self.rays = 0
        """Rays that were added."""
        self.outside = 0
        """Rays left out: their position is not a number, or too far from all others."""
        self.unknown = 0
        """Rays with signal of unknown cross section."""
        self.spread = np.ones(_CLASSES)
        """Variance of shares over that of a binomial, by class of voxel."""

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

    def add(self, rays: Rays, rule: LightRule) -> None:
        """Adds rays, with the light that the rule finds in them."""
        local = rays.table["start"] - self.anchor * self.size
        step, begin, end = (rays.table[name] for name in ("step", "begin", "end"))
        good = fits_keys(local, step, begin, end, self.size)
        self.outside += int(np.count_nonzero(~good))
        self.unknown += int(rays.table["unknown"][good].sum())
        good = np.flatnonzero(good)
        rays, local = rays.take(good), local[good]
        step, begin, end = (rays.table[name] for name in ("step", "begin", "end"))
        self.rays += len(good)
        for part in split_rays(local, step, begin, end, self.size):
            found = cross_voxels(local[part], step[part], begin[part], end[part], self.size)
            values = self._list_values(found, rays.take(part), rule)
            kept = slice(None) if self._everything else values[:, _ENERGY] > 0
            index = found.voxel[kept]
            if len(index):
                self._low = np.minimum(self._low, index.min(axis=0))
                self._high = np.maximum(self._high, index.max(axis=0))
            self._energy += int(values[:, _ENERGY].sum())
            self._sums.add(pack_index(found.voxel), values)

    def _list_values(self, found: Crossings, rays: Rays, rule: LightRule) -> np.ndarray:
        """Values that every crossing adds to its voxel, i8 (m, columns); over a ray they add up to its total."""
        ray, table, samples = found.ray, rays.table, rays.samples
        first = np.append(True, ray[1:] != ray[:-1])[: len(ray)]
        caught, ground = (_count(part, LIGHT_UNIT) for part in rule.weigh(rays))
        summed = [caught, ground, _count(samples["energy"], self._unit), _count(samples["section"], SECTION_UNIT)]
        summed += [] if self._floor is None else [np.rint(caught * samples["time"]).astype(np.int64)]
        summed = VoxelSamples(samples["time"], samples["spacing"], np.stack(summed, axis=1))
        each = np.arange(len(table))
        last = sum_before(summed, table["first"], table["count"], each, np.full(len(table), np.inf))
        before = sum_before(summed, table["first"], table["count"], ray, found.enter)
        before[first] = 0
        part = differences_along(before, ray, last)
        # What is beyond a lost packet has energy, but light is known up to there only.
        known = found.enter < table["known"][ray]
        inside = np.clip(table["known"][ray] - found.enter, 0.0, found.inside)
        light = np.where(known, np.maximum(_count(1.0, LIGHT_UNIT) - before[:, 0], 0), 0)
        share = last[ray, 1] * LIGHT_UNIT
        values = np.zeros((len(ray), self._width), np.int64)
        values[:, _RAYS], values[:, _LIGHT], values[:, _CAUGHT] = known, light, part[:, 0]
        values[:, _PATH] = _count(inside * measure_lengths(table["step"])[ray], PATH_UNIT)
        values[:, _ENERGY] = part[:, 2]
        values[:, _SQUARES] = _count((light * LIGHT_UNIT) ** 2, LIGHT_UNIT)
        # Derivatives over the logarithm of the ratio of reflectances: it moves light between canopy and ground.
        values[:, _CAUGHT_BY_RATIO] = part[:, 1] - np.rint(share * part[:, 0]).astype(np.int64)
        by_ratio = np.rint(share * before[:, 0]).astype(np.int64) - before[:, 1]
        values[:, _LIGHT_BY_RATIO] = np.where(known, by_ratio, 0)
        if self._sections:
            values[:, _SECTION] = part[:, 3]
            values[:, _UNKNOWN] = table["unknown"][ray] & (part[:, 2] > 0)
        if self._floor is not None:
            values[:, _GROUND] = np.where(known, part[:, 1], 0)
            # The light times the way it goes here: all of it to the far side, less what is caught before.
            stopped = (found.enter + inside) * part[:, 0] - part[:, 4]
            free = np.clip(inside * light - stopped, 0.0, inside * light) * LIGHT_UNIT
            values[:, _FREE] = np.where(known, _count(free * measure_lengths(table["step"])[ray], PATH_UNIT), 0)
        return values

    def measure_spread(self) -> None:
        """Compares neighbouring voxels, once all rays are in: how much more than a binomial their shares spread.

        Neighbours along y are close to each other in the order of the sums. By doublings of the rays in them, because
        leaves come in clumps: the more rays a voxel has, the more of them meet the same clump.
        """
        sums = np.zeros((3, _CLASSES), np.int64)
        old_key, old = np.empty(0, np.uint64), np.empty((0, 3))
        for key, rows in self._sums.pieces():
            lit = rows[:, _LIGHT] > 0
            key, value = np.concatenate([old_key, key[lit]]), np.concatenate([old, _list_shares(rows[lit])])
            if not len(key):
                continue
            at = np.minimum(np.searchsorted(key, key + _NEXT_Y), len(key) - 1)
            some = np.flatnonzero((key[at] == key + _NEXT_Y) & (at >= len(old_key)))
            (share, rays, light), (other, more, brighter) = value[some].T, value[at[some]].T
            both = (share * light + other * brighter) / (light + brighter)
            kind = _classify(np.minimum(rays, more))
            expected = both * (1.0 - both) * (1.0 / rays + 1.0 / more)
            for row, part in zip(sums, ((share - other) ** 2, expected, np.full(len(some), LIGHT_UNIT)), strict=True):
                np.add.at(row, kind, _count(part, LIGHT_UNIT))
            late = key + _NEXT_Y >= key[-1]
            old_key, old = key[late], value[late]
        found, expected, pairs = sums
        of_all = found.sum() / expected.sum() if expected.any() else 1.0
        each = np.where(expected > 0, found / np.maximum(expected, 1), of_all)
        self.spread = (pairs * each + _LEAST_PAIRS * of_all) / (pairs + _LEAST_PAIRS)

    def pieces(self, log_error: float = 0.0) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Index and columns of the voxels, some at a time, in the order of x, then y, then z.

        The index i8 (m, 3) counts from `low`. log_error: that of the logarithm of the ratio of reflectances.
        """
        for key, sums in self._sums.pieces():
            if not self._everything:
                some = np.flatnonzero(sums[:, _ENERGY] > 0)
                key, sums = key[some], sums[some]
            index = unpack_index(key)
            yield index - self._low, self._finish(index, sums, log_error)

    def _finish(self, index: np.ndarray, sums: np.ndarray, log_error: float) -> dict[str, np.ndarray]:
        lit = sums[:, _LIGHT] > 0
        share, rays, light = _list_shares(sums).T
        rays = rays / self.spread[_classify(rays)]
        # A share of 0 or 1 alone states no error: half a ray of light and of shade are added.
        near = (share * rays + 0.5) / (rays + 1.0)
        spread = near * (1.0 - near) / rays
        by_ratio = (sums[:, _CAUGHT_BY_RATIO] - share * sums[:, _LIGHT_BY_RATIO]) * LIGHT_UNIT / light
        columns = {
            "energy": sums[:, _ENERGY] * self._unit,
            "rays": sums[:, _RAYS],
            "path": sums[:, _PATH] * PATH_UNIT,
            "light": sums[:, _LIGHT] * LIGHT_UNIT,
            "share": np.where(lit, share, np.nan),
            "share_error": np.where(lit, np.sqrt(spread + (by_ratio * log_error) ** 2), np.nan),
        }
        if self._sections:
            columns["cross_section"] = np.where(sums[:, _UNKNOWN] > 0, np.nan, sums[:, _SECTION] * SECTION_UNIT)
        if self._floor is not None:
            height = self._floor.measure_height((index + self.anchor + 0.5) * self.size)
            columns["height"] = np.where(np.isfinite(height), height, np.nan)
            ground = sums[:, _GROUND] * LIGHT_UNIT / light
            columns["ground"] = np.where(lit, ground, np.nan)
            columns["free_path"] = sums[:, _FREE] * PATH_UNIT
            free = np.where(lit, columns["free_path"] / light, 0.0)
            found = measure_attenuation(np.clip(share - ground, 0.0, 1.0), rays, free)
            columns["attenuation"], columns["attenuation_error"] = found
        return {column.name: columns[column.name].astype(column.dtype) for column in self.columns}


def _count(values: np.ndarray | float, unit: float) -> np.ndarray:
    return np.rint(values * (1.0 / unit)).astype(np.int64)


def _list_shares(sums: np.ndarray) -> np.ndarray:
    """Share of the light that was caught, the whole rays with the same error, and the light, f8 (m, 3)."""
    light = np.maximum(sums[:, _LIGHT], 1)
    rays = np.maximum(light * (light * LIGHT_UNIT) / np.maximum(sums[:, _SQUARES], 1), LIGHT_UNIT)
    return np.stack([sums[:, _CAUGHT] / light, rays, light * LIGHT_UNIT], axis=1)


def _classify(rays: np.ndarray) -> np.ndarray:
    return np.clip(np.log2(rays).astype(np.int64) + 8, 0, _CLASSES - 1)
