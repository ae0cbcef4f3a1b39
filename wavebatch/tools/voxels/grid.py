"""Sums over the voxels of a grid: rays, light, path, energy and cross section.

`strip.voxelize_strip` adds the rays of every block, then writes `pieces`. Sums are integers, in the units below, so
that the result does not depend on block size or order.

Voxels are written as a sparse .npz, or as a point cloud with a point at the centre of each: `write_npz`, `write_las`.
`ProfileWriter` writes the deconvolved profiles of single pulses as an .npz: sigma(t) of every pulse, not only its sum
in voxels. Only samples with signal are stored, so a file is about as large as the cloud of the strip. It must not
depend on block size: nothing there may mix pulses of a batch. `VoxelFile` reads voxels as points, for sections and
height profiles.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.echoes import Column
from wavebatch.core.errors import ConfigError, InputError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.disk.npz import NpzWriter, read_npz, reading_npz
from wavebatch.files.disk.publish import Draft, protecting, publish_together
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.disk.temp_store import ROWS_IN_MEMORY, KeyedSums
from wavebatch.files.las import header as las
from wavebatch.files.las.crs import name_crs, repair_records, repair_wkt
from wavebatch.files.las.write_points import PointFile
from wavebatch.files.strip.packets import StripFacts
from wavebatch.kernels.geometry import voxels as kernel
from wavebatch.kernels.physics.gap_probability import measure_attenuation
from wavebatch.tools.cells import Tally
from wavebatch.tools.voxels.rays import Floor, LightRule, Rays, measure_lengths

NO_BORDERS = np.empty(0, np.uint64)

LIGHT_UNIT = 2.0**-30
"""Unit in which light is summed [rays]."""

PATH_UNIT = 2.0**-20
"""Unit in which path is summed [m]."""

SECTION_UNIT = 2.0**-40
"""Unit in which cross sections are summed [m2]."""

_RAYS, _LIGHT, _CAUGHT, _PATH, _ENERGY, _SQUARES, _CAUGHT_BY_RATIO, _LIGHT_BY_RATIO, _SECTION, _UNKNOWN = range(10)
_GROUND, _FREE = 10, 11

_NEXT_Y = np.uint64(1 << kernel.KEY_BITS[2])
"""From the key of a voxel to that of its neighbour along y."""

_CLASSES = 40
"""Classes of voxels, by doublings of the rays in them."""

_LEAST_PAIRS = 10.0
"""Pairs of neighbours that weigh as much as the spread of all classes."""

COLUMNS = (
    Column("energy", "f4", "DN ns", "signal from the voxel", None),
    Column("cross_section", "f4", "m2", "backscatter cross section"),
    Column("rays", "u4", "-", "rays that crossed with light", None),
    Column("path", "f4", "m", "length of these rays in it", None),
    Column("light", "f4", "rays", "light that reached it", None),
    Column("share", "f4", "-", "share of it returned here"),
    Column("share_error", "f4", "-", "std of share, 1 sigma"),
)
"""Values of every voxel; cross_section only with a calibration. Meaning and unit have at most 32 bytes together, for
the description in LAS. No data is NaN in .npz files."""

FOREST_COLUMNS = (
    Column("height", "f4", "m", "centre above the ground"),
    Column("ground", "f4", "-", "share returned by ground"),
    Column("free_path", "f4", "m", "light times its path", None),
    Column("attenuation", "f4", "1/m", "caught by plants"),
    Column("attenuation_error", "f4", "1/m", "std of attenuation"),
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
    without them. borders, in_memory: see KeyedSums.
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
        borders: np.ndarray = NO_BORDERS,
        in_memory: int = ROWS_IN_MEMORY,
    ) -> None:
        self.size, self.anchor = size, anchor
        self.columns = tuple(column for column in COLUMNS if sections or column.name != "cross_section")
        self.columns += () if floor is None else FOREST_COLUMNS
        self._unit, self._sections, self._everything, self._floor = unit, sections, everything, floor
        self._width = 8 if floor is None and not sections else 10 if floor is None else 12
        self._sums = KeyedSums(self._width, borders, in_memory=in_memory)
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
        good = kernel.fits_keys(local, step, begin, end, self.size)
        self.outside += int(np.count_nonzero(~good))
        self.unknown += int(rays.table["unknown"][good].sum())
        good = np.flatnonzero(good)
        rays, local = rays.take(good), local[good]
        step, begin, end = (rays.table[name] for name in ("step", "begin", "end"))
        self.rays += len(good)
        for part in kernel.split_rays(local, step, begin, end, self.size):
            found = kernel.cross_voxels(local[part], step[part], begin[part], end[part], self.size)
            values = self._list_values(found, rays.take(part), rule)
            kept = slice(None) if self._everything else values[:, _ENERGY] > 0
            index = found.voxel[kept]
            if len(index):
                self._low = np.minimum(self._low, index.min(axis=0))
                self._high = np.maximum(self._high, index.max(axis=0))
            self._energy += int(values[:, _ENERGY].sum())
            self._sums.add(kernel.pack_index(found.voxel), values)

    def _list_values(self, found: kernel.Crossings, rays: Rays, rule: LightRule) -> np.ndarray:
        """Values that every crossing adds to its voxel, i8 (m, columns); over a ray they add up to its total."""
        ray, table, samples = found.ray, rays.table, rays.samples
        first = np.append(True, ray[1:] != ray[:-1])[: len(ray)]
        caught, ground = (_count(part, LIGHT_UNIT) for part in rule.weigh(rays))
        summed = [caught, ground, _count(samples["energy"], self._unit), _count(samples["section"], SECTION_UNIT)]
        summed += [] if self._floor is None else [np.rint(caught * samples["time"]).astype(np.int64)]
        summed = kernel.VoxelSamples(samples["time"], samples["spacing"], np.stack(summed, axis=1))
        each = np.arange(len(table))
        last = kernel.sum_before(summed, table["first"], table["count"], each, np.full(len(table), np.inf))
        before = kernel.sum_before(summed, table["first"], table["count"], ray, found.enter)
        before[first] = 0
        part = kernel.differences_along(before, ray, last)
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
            index = kernel.unpack_index(key)
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
            yield index - self._low, {column.name: columns[column.name].astype(column.dtype) for column in self.columns}


def _count(values: np.ndarray | float, unit: float) -> np.ndarray:
    return np.rint(values * (1.0 / unit)).astype(np.int64)


def _list_shares(sums: np.ndarray) -> np.ndarray:
    """Share of the light that was caught, the whole rays with the same error, and the light, f8 (m, 3)."""
    light = np.maximum(sums[:, _LIGHT], 1)
    rays = np.maximum(light * (light * LIGHT_UNIT) / np.maximum(sums[:, _SQUARES], 1), LIGHT_UNIT)
    return np.stack([sums[:, _CAUGHT] / light, rays, light * LIGHT_UNIT], axis=1)


def _classify(rays: np.ndarray) -> np.ndarray:
    return np.clip(np.log2(rays).astype(np.int64) + 8, 0, _CLASSES - 1)


SUFFIXES = (".npz", ".las", ".laz")

Piece = tuple[np.ndarray, Mapping[str, np.ndarray]]
"""Index (m, 3) and columns of some voxels."""


@frozen(eq=False)
class VoxelSpace:
    """Contents of a voxel file besides the values of the voxels."""

    columns: Sequence[Column]
    facts: StripFacts
    """Facts of the strip, for its CRS and header."""
    origin: np.ndarray
    """Lower corner of voxel 0, f8 (3,) [m]."""
    size: float
    """Edge of a voxel [m]."""
    meta: Mapping[str, Any]
    """How the voxels were made."""


def write_npz(
    target: Path, space: VoxelSpace, pieces: Iterable[Piece], others: Sequence[Draft], overwrite: bool
) -> int:
    """Writes an .npz and returns its number of voxels; after an error nothing remains.

    It has index i4 (n, 3), an array per column, origin f8 (3,) [m], size [m], crs (WKT or empty), meta (JSON).
    Voxel i lies between origin + i size and origin + (i + 1) size. No-data is NaN.
    pieces: some voxels at a time. others: complete files that are published with this one.
    Raises InputError where the target cannot be written.
    """
    dtypes = {"index": np.dtype(("<i4", (3,)))}
    dtypes |= {column.name: np.dtype(f"<{column.dtype}") for column in space.columns}
    meta = json.dumps(space.meta, sort_keys=True)
    number = 0
    with NpzWriter(target, dtypes, overwrite=overwrite) as file:
        for index, columns in pieces:
            file.add({"index": index, **columns})
            number += len(index)
        facts = {"origin": space.origin, "size": space.size, "crs": space.facts.crs or "", "meta": meta}
        publish_together([*others, file.complete(facts)])
    return number


def write_las(
    target: Path, space: VoxelSpace, pieces: Iterable[Piece], others: Sequence[Draft], overwrite: bool
) -> int:
    """As `write_npz`, a .las or .laz: a point at the centre of each voxel, columns as extra bytes, the strip's CRS.

    The centres are exact: coordinates count half voxels from the lower corner of the grid.
    """
    facts, source = space.facts, las.read_header(space.facts.path)
    vlrs = repair_records(vlr for vlr in source.vlrs if las.is_projection(vlr))
    if not las.has_record(vlrs, las.PROJECTION, las.WKT_ID) and (facts.crs or "").endswith("]"):
        record = las.build_wkt(repair_wkt(facts.crs))  # from an extended record
        if len(record.payload) > 65535:
            raise InputError(f"{facts.path}: its CRS is longer than the record of a point cloud; write an .npz")
        vlrs.append(record)
    modern = source.point_format >= 6
    encoding = source.global_encoding & 1
    if modern and (las.has_record(vlrs, las.PROJECTION, las.WKT_ID) or not vlrs):
        encoding |= las.WKT_BIT
    text = json.dumps(space.meta, sort_keys=True, separators=(",", ":")).encode()
    header = las.LasHeader(
        version=(1, 4) if modern else source.version,
        point_format=6 if modern else 0,
        point_length=0,
        scales=(0.5 * space.size,) * 3,
        offsets=tuple(float(value) for value in space.origin),
        vlrs=[*vlrs, las.Vlr(b"wavebatch", 1, text, b"how voxels were made (JSON)")],
        file_source_id=source.file_source_id,
        global_encoding=encoding,
        project_id=source.project_id,
        system_identifier=b"EXTRACTION",
        generating_software=f"wavebatch {__version__}".encode(),
        creation=source.creation,
    )
    texts = [one.meaning if one.unit == "-" else f"{one.meaning} [{one.unit}]" for one in space.columns]
    columns = zip(space.columns, texts, strict=True)
    records = [las.ExtraRecord.build(one.name, one.dtype, text, no_data=one.no_data) for one, text in columns]
    dtype = las.build_dtype(header.point_format, records)
    number = 0
    with PointFile(target, header, dtype, records, overwrite=overwrite) as file:
        for index, columns in pieces:
            rows = np.zeros(len(index), dtype)
            for axis, name in enumerate("XYZ"):
                rows[name] = 2 * index[:, axis] + 1
            rows["bit_fields"] = 0b1_0001 if header.point_format >= 6 else 0b1001  # return 1 of 1
            for column in space.columns:
                values = columns[column.name]
                if column.no_data is not None:
                    values = np.where(np.isnan(values), values.dtype.type(column.no_data), values)
                rows[column.name] = values
            file.write(rows)
            number += len(rows)
        file.drafts[:0] = others
        file.commit()
    return number


PULSE_COLUMNS = {
    "point": ("<i8", "index in the file of the first point of the pulse's packets"),
    "gps_time": ("<f8", "time of the pulse [s]"),
    "start": (("<f8", (3,)), "position at time 0, from the returns of the packet where they are known [m]"),
    "step": (("<f8", (3,)), "away from the sensor, per time [m/ns]"),
    "packets": ("<u2", "number of the pulse's packets; between them nothing was recorded: no light triggered it"),
    "known": ("<f8", "time up to which the light is known: infinite, unless a packet of the pulse was lost [ns]"),
    "anchored": ("<u1", "1 where a return of each packet lies at the signal, else the raw location is used"),
    "clipped": ("<u1", "1 where samples are at the digitizer's limit: energies are too low"),
    "first": ("<i8", "row of the pulse's first sample in the arrays of samples"),
    "count": ("<i8", "number of its samples with signal"),
}
"""Arrays with a value per pulse that has signal: dtype and meaning."""

SAMPLE_COLUMNS = {
    "time": ("<f4", "after sample 0 of the pulse's first packet along the ray [ns]"),
    "spacing": ("<f4", "time that the sample spans [ns]"),
    "energy": ("<f4", "integral of the signal from this sample, as if each was a pulse of its own [DN ns]"),
    "cross_section": ("<f4", "backscatter cross section of this sample [m2]; NaN where the range is unknown"),
}
"""Arrays with a value per sample with signal; cross_section only with a calibration."""


class ProfileWriter(NpzWriter):
    """Writes profiles batch by batch: `add_rays` for each, then `complete`."""

    def __init__(self, target: Path, strip: Path, *, sections: bool, overwrite: bool) -> None:
        if target.suffix.lower() != ".npz":
            raise ConfigError(f"--profiles {target}: profiles are written as .npz")
        self._names = [name for name in SAMPLE_COLUMNS if sections or name != "cross_section"]
        columns = {**PULSE_COLUMNS, **{name: SAMPLE_COLUMNS[name] for name in self._names}}
        self.meanings = {name: meaning for name, (_, meaning) in columns.items()}
        """Of the columns."""
        with protecting([strip]):
            super().__init__(target, {name: dtype for name, (dtype, _) in columns.items()}, overwrite=overwrite)
        self.samples = 0

    def add_rays(self, rays: Rays) -> None:
        """Adds the pulses that have signal."""
        rays = rays.take(np.flatnonzero(rays.table["count"]))
        table, samples = rays.table, rays.samples
        values = {name: table[name] for name in PULSE_COLUMNS} | {"first": self.samples + table["first"]}
        values |= {name: samples[name] for name in ("time", "spacing", "energy")}
        if "cross_section" in self._names:
            values["cross_section"] = np.where(table["unknown"][rays.owner], np.nan, samples["section"])
        self.add(values)
        self.samples += len(samples)


_PIECE = 1_000_000

_LARGEST = 1e12
"""Largest coordinate and size [m] of voxels, and the root of their largest value; damaged files have larger ones."""


class VoxelFile:
    """The voxels of an .npz of `wavebatch voxelize`, read as the points at their centres.

    Has the interface of `cells.Clouds`. Raises InputError for a file that holds no voxels, ConfigError without the
    column.
    """

    def __init__(self, path: Path, column: str | None, selection: PointFilter) -> None:
        self.paths, self._column = (path,), column
        if selection.flags or selection.drop_flags:
            raise ConfigError(f"{path}: voxels have no echo_flags to select by")
        what, remedy = "voxels of `wavebatch voxelize`", "make them again"
        columns = {f"{column.name}?": ("fu", 1) for column in COLUMNS}
        needed = {"index": ("i", 2), "origin": ("f", 1), "size": ("f", 0), "crs": ("U", 0), "meta": ("U", 0)}
        self._data = read_npz(path, {**needed, **columns}, what, remedy)
        self._index, self._origin = self._data["index"], self._data["origin"].astype(np.float64)
        self.size = float(self._data["size"])
        known = {column.name: column for column in COLUMNS if column.name in self._data}
        values = [self._data[name] for name in known]
        lengths = set(map(len, values))
        is_sound = self._index.shape[1] == 3 and lengths == {len(self._index)} and self._origin.shape == (3,)
        is_sound &= bool((np.abs(self._origin) < _LARGEST).all()) and 1e-6 <= self.size < _LARGEST
        if not is_sound or any((np.abs(one) > _LARGEST**2).any() for one in values):
            raise InputError(f"{path}: holds no {what}: its arrays do not fit; {remedy}")
        with reading_npz(path, what, remedy):
            json.loads(str(self._data["meta"]))
        self.crs = name_crs(str(self._data["crs"])) if str(self._data["crs"]) else ""
        if column is not None and column not in known:
            raise ConfigError(f"{path}: has no column {column!r}; {nearest(column, known)}")
        drawn = known.get(column)
        unit, meaning = (drawn.unit, drawn.meaning) if drawn else ("-", "")
        self.facts = ColumnFacts(column or "voxels", unit, meaning, 0.0)

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """As Clouds.read, with the height of the centre as second value."""
        dtype = [("x", "<f8"), ("y", "<f8"), ("values", "<f8", (2,))]
        for start in range(0, len(self._index), _PIECE):
            part = slice(start, start + _PIECE)
            place = self._origin + (self._index[part] + 0.5) * self.size
            rows = np.zeros(len(place), dtype)
            rows["x"], rows["y"], rows["values"][:, 1] = place.T
            rows["values"][:, 0] = 1.0 if self._column is None else self._data[self._column][part]
            good = rows[~np.isnan(rows["values"][:, 0])]
            yield 0, good, Tally(len(rows), 0, len(rows) - len(good), len(good))

    def complain(self, tally: Tally) -> InputError:
        """The error that says why nothing can be drawn."""
        return InputError(f"{self.paths[0]}: nothing to draw: {tally.points} voxels, {tally.no_data} without data")
