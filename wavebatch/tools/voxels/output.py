"""Voxels as a sparse NPZ, or as a point cloud with a point at the centre of each."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.npz import NpzWriter
from wavebatch.files.disk.publish import Draft
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
from wavebatch.files.strip.facts import StripFacts
from wavebatch.tools.voxels.grid import VoxelColumn

SUFFIXES = (".npz", ".las", ".laz")


def check_target(target: Path, strip: Path) -> None:
    """Raises ConfigError for a name that says no format, InputError where the output is the strip, or cannot be."""
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{target}: voxels are written as {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    if target.exists() and strip.exists() and target.samefile(strip):
        raise InputError(f"{target}: is the strip itself; choose another output")
    Draft(target, overwrite=True).discard()


@dataclass(frozen=True, slots=True, eq=False)
class VoxelSpace:
    """What a file says of its voxels beside their values."""

    columns: Sequence[VoxelColumn]
    facts: StripFacts
    """Of the strip."""
    origin: np.ndarray
    """Lower corner of voxel 0, f8 (3,) [m]."""
    size: float
    """Of a voxel [m]."""
    meta: Mapping[str, Any]
    """How they were made."""


class NpzVoxels:
    """Writes voxels to an .npz: `write`, then `commit`; as a context manager nothing remains unless committed.

    Arrays: index i4 (n, 3), one array per column, origin f8 (3,) [m], size [m], crs (WKT, or empty), meta (JSON). Voxel
    i lies between origin + i size and origin + (i + 1) size. No-data is NaN. Raises InputError where it cannot write.
    """

    def __init__(self, target: Path, space: VoxelSpace, *, overwrite: bool) -> None:
        text = json.dumps(space.meta, sort_keys=True)
        self._single = {"origin": space.origin, "size": space.size, "crs": space.facts.crs or "", "meta": text}
        dtypes = {"index": np.dtype(("<i4", (3,)))}
        dtypes |= {column.name: np.dtype(f"<{column.dtype}") for column in space.columns}
        self._file = NpzWriter(target, dtypes, overwrite=overwrite)

    def __enter__(self) -> NpzVoxels:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.discard()

    def write(self, index: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """Appends voxels (m, 3) and their columns."""
        self._file.add({"index": index, **columns})

    def commit(self) -> None:
        """Completes and publishes the file."""
        self._file.publish(self._single)


class LasVoxels:
    """Writes voxels as points with extra bytes to a .las or .laz; used as NpzVoxels is.

    The centre of every voxel is exact: coordinates count half voxels from the lower corner of the grid. The strip's CRS
    is kept.
    """

    def __init__(self, target: Path, space: VoxelSpace, *, overwrite: bool) -> None:
        self._columns = space.columns
        records = [
            ExtraRecord.build(
                column.name,
                column.dtype,
                column.meaning if column.unit == "-" else f"{column.meaning} [{column.unit}]",
                no_data=column.no_data,
            )
            for column in space.columns
        ]
        header = _build_header(space)
        self._returns = 0b1_0001 if header.point_format >= 6 else 0b1001
        self._dtype = build_dtype(header.point_format, records)
        self._file = PointFile(target, header, self._dtype, records, overwrite=overwrite)

    def __enter__(self) -> LasVoxels:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.abort()

    def write(self, index: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """Appends voxels (m, 3) and their columns."""
        rows = np.zeros(len(index), self._dtype)
        for axis, name in enumerate("XYZ"):
            rows[name] = 2 * index[:, axis] + 1
        rows["bit_fields"] = self._returns
        for column in self._columns:
            values = columns[column.name]
            if column.no_data is not None:
                values = np.where(np.isnan(values), values.dtype.type(column.no_data), values)
            rows[column.name] = values
        self._file.write(rows)

    def commit(self) -> None:
        """Completes and publishes the file."""
        self._file.finish_points()
        self._file.finish()
        self._file.draft.publish()


def open_voxels(target: Path, space: VoxelSpace, *, overwrite: bool) -> NpzVoxels | LasVoxels:
    """The writer of the format that the target's suffix says."""
    return (NpzVoxels if target.suffix.lower() == ".npz" else LasVoxels)(target, space, overwrite=overwrite)


def _build_header(space: VoxelSpace) -> LasHeader:
    facts, source = space.facts, read_header(space.facts.path)
    vlrs = [vlr for vlr in source.vlrs if is_projection(vlr)]
    if not has_record(vlrs, PROJECTION, WKT_ID) and (facts.crs or "").endswith("]"):
        record = build_wkt(facts.crs)  # from an extended record
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
        vlrs=[*vlrs, Vlr(b"wavebatch", 1, text, b"how these voxels were made (JSON)")],
        file_source_id=source.file_source_id,
        global_encoding=encoding,
        project_id=source.project_id,
        system_identifier=b"EXTRACTION",
        generating_software=f"wavebatch {__version__}".encode(),
        creation=source.creation,
    )
