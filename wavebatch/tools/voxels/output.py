"""Voxels as a sparse .npz, or as a point cloud with a point at the centre of each.

`strip.voxelize_strip` calls `check_voxel_target` before it reads the strip, and `write_voxels` at the end.

`ProfileWriter` writes the deconvolved profiles of single pulses as an .npz: sigma(t) of every pulse, not only its sum
in voxels. Only samples with signal are stored, so a file is about as large as the cloud of the strip. It must not
depend on block size: nothing there may mix pulses of a batch. `VoxelFile` reads voxels as points, for sections and
height profiles.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.disk.npz import NpzWriter, read_npz, reading_npz
from wavebatch.files.disk.publish import Draft, protecting, publish_together
from wavebatch.files.las.crs import name_crs, repair_records, repair_wkt
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.header import (
    PROJECTION,
    WKT_BIT,
    WKT_ID,
    LasHeader,
    Vlr,
    build_wkt,
    has_record,
    is_projection,
    read_header,
)
from wavebatch.files.las.write_points import PointFile
from wavebatch.files.strip.packets import StripFacts
from wavebatch.tools.plots.values import Tally
from wavebatch.tools.voxels.grid import COLUMNS, VoxelColumn
from wavebatch.tools.voxels.rays import Rays

SUFFIXES = (".npz", ".las", ".laz")

Piece = tuple[np.ndarray, Mapping[str, np.ndarray]]
"""Index (m, 3) and columns of some voxels."""


def check_voxel_target(target: Path, strip: Path) -> None:
    """Raises ConfigError for an unknown suffix or where the output is the strip, InputError if it cannot be written."""
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{target}: voxels are written as {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    with protecting([strip]):
        Draft(target, overwrite=True).discard()


@dataclass(frozen=True, slots=True, eq=False)
class VoxelSpace:
    """Contents of a voxel file besides the values of the voxels."""

    columns: Sequence[VoxelColumn]
    facts: StripFacts
    """Facts of the strip, for its CRS and header."""
    origin: np.ndarray
    """Lower corner of voxel 0, f8 (3,) [m]."""
    size: float
    """Edge of a voxel [m]."""
    meta: Mapping[str, Any]
    """How the voxels were made."""


def write_voxels(
    target: Path, space: VoxelSpace, pieces: Iterable[Piece], *, others: Sequence[Draft] = (), overwrite: bool
) -> int:
    """Writes voxels in the format of the target's suffix; returns their number.

    pieces: index i8 (m, 3) and columns of some voxels at a time. others: complete files that are published with this
    one. After an error nothing remains.
    Raises InputError where the target cannot be written.
    """
    write = _write_npz if target.suffix.lower() == ".npz" else _write_las
    return write(target, space, pieces, others, overwrite)


def _write_npz(
    target: Path, space: VoxelSpace, pieces: Iterable[Piece], others: Sequence[Draft], overwrite: bool
) -> int:
    """An .npz of index i4 (n, 3), an array per column, origin f8 (3,) [m], size [m], crs (WKT or empty), meta (JSON).

    Voxel i lies between origin + i size and origin + (i + 1) size. No-data is NaN.
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


def _write_las(
    target: Path, space: VoxelSpace, pieces: Iterable[Piece], others: Sequence[Draft], overwrite: bool
) -> int:
    """A .las or .laz with a point at the centre of each voxel, the columns as extra bytes, and the CRS of the strip.

    The centres are exact: coordinates count half voxels from the lower corner of the grid.
    """
    header = _build_header(space)
    texts = [one.meaning if one.unit == "-" else f"{one.meaning} [{one.unit}]" for one in space.columns]
    columns = zip(space.columns, texts, strict=True)
    records = [ExtraRecord.build(one.name, one.dtype, text, no_data=one.no_data) for one, text in columns]
    dtype = build_dtype(header.point_format, records)
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


def _build_header(space: VoxelSpace) -> LasHeader:
    facts, source = space.facts, read_header(space.facts.path)
    vlrs = repair_records(vlr for vlr in source.vlrs if is_projection(vlr))
    if not has_record(vlrs, PROJECTION, WKT_ID) and (facts.crs or "").endswith("]"):
        record = build_wkt(repair_wkt(facts.crs))  # from an extended record
        if len(record.payload) > 65535:
            raise InputError(f"{facts.path}: its CRS is longer than the record of a point cloud; write an .npz")
        vlrs.append(record)
    modern = source.point_format >= 6
    encoding = source.global_encoding & 1
    if modern and (has_record(vlrs, PROJECTION, WKT_ID) or not vlrs):
        encoding |= WKT_BIT
    text = json.dumps(space.meta, sort_keys=True, separators=(",", ":")).encode()
    return LasHeader(
        version=(1, 4) if modern else source.version,
        point_format=6 if modern else 0,
        point_length=0,
        scales=(0.5 * space.size,) * 3,
        offsets=tuple(float(value) for value in space.origin),
        vlrs=[*vlrs, Vlr(b"wavebatch", 1, text, b"how voxels were made (JSON)")],
        file_source_id=source.file_source_id,
        global_encoding=encoding,
        project_id=source.project_id,
        system_identifier=b"EXTRACTION",
        generating_software=f"wavebatch {__version__}".encode(),
        creation=source.creation,
    )


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
    """Writes profiles batch by batch: `add_rays` for each, then `complete_profiles`."""

    def __init__(self, target: Path, strip: Path, *, sections: bool, overwrite: bool) -> None:
        if target.suffix.lower() != ".npz":
            raise ConfigError(f"--profiles {target}: profiles are written as .npz")
        self._names = [name for name in SAMPLE_COLUMNS if sections or name != "cross_section"]
        columns = {**PULSE_COLUMNS, **{name: SAMPLE_COLUMNS[name] for name in self._names}}
        self._meanings = {name: meaning for name, (_, meaning) in columns.items()}
        with protecting([strip]):
            super().__init__(target, {name: dtype for name, (dtype, _) in columns.items()}, overwrite=overwrite)
        self.pulses = self.samples = 0

    def add_rays(self, rays: Rays) -> None:
        """Adds the pulses that have signal."""
        rays = rays.take(np.flatnonzero(rays.table["count"]))
        table, samples = rays.table, rays.samples
        values = {name: table[name] for name in PULSE_COLUMNS} | {"first": self.samples + table["first"]}
        values |= {name: samples[name] for name in ("time", "spacing", "energy")}
        if "cross_section" in self._names:
            values["cross_section"] = np.where(table["unknown"][rays.owner], np.nan, samples["section"])
        self.add(values)
        self.pulses += len(table)
        self.samples += len(samples)

    def complete_profiles(self, meta: Mapping[str, Any], crs: str) -> Draft:
        """Writes the file, with how it was made as JSON in `meta`."""
        text = json.dumps({**meta, "columns": self._meanings}, sort_keys=True)
        return self.complete({"crs": crs, "meta": text})


_PIECE = 1_000_000

_LARGEST = 1e12
"""Largest coordinate and size [m] of voxels, and the root of their largest value; damaged files have larger ones."""


class VoxelFile:
    """The voxels of an .npz of `wavebatch voxelize`, read as the points at their centres.

    Has the interface of `values.Clouds`. Raises InputError for a file that holds no voxels, ConfigError without the
    column.
    """

    def __init__(self, path: Path, column: str | None, chosen: PointFilter) -> None:
        self.paths, self._column = (path,), column
        if chosen.flags or chosen.drop_flags:
            raise ConfigError(f"{path}: voxels have no echo_flags to select by")
        what, remedy = "voxels of `wavebatch voxelize`", "make them again"
        columns = {f"{column.name}?": ("fu", 1) for column in COLUMNS}
        needed = {"index": ("i", 2), "origin": ("f", 1), "size": ("f", 0), "crs": ("U", 0), "meta": ("U", 0)}
        self._data = read_npz(path, {**needed, **columns}, what, remedy)
        self._index, self._origin = self._data["index"], self._data["origin"].astype(np.float64)
        self.size = float(self._data["size"])
        lengths = {len(self._data[column.name]) for column in COLUMNS if column.name in self._data}
        is_sound = self._index.shape[1] == 3 and lengths == {len(self._index)} and self._origin.shape == (3,)
        is_sound &= bool((np.abs(self._origin) < _LARGEST).all()) and 1e-6 <= self.size < _LARGEST
        values = [self._data[column.name] for column in COLUMNS if column.name in self._data]
        if not is_sound or any((np.abs(one) > _LARGEST**2).any() for one in values):
            raise InputError(f"{path}: holds no {what}: its arrays do not fit; {remedy}")
        with reading_npz(path, what, remedy):
            json.loads(str(self._data["meta"]))
        self.crs = name_crs(str(self._data["crs"])) if str(self._data["crs"]) else ""
        known = {column.name: column for column in COLUMNS if column.name in self._data}
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
