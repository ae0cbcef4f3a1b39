"""Voxels as a sparse .npz, or as a point cloud with a point at the centre of each.

`strip.voxelize_strip` calls `check_voxel_target` before it reads the strip, and `write_voxels` at the end.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.npz import NpzWriter
from wavebatch.files.disk.publish import Draft, protecting, publish_together
from wavebatch.files.las.crs import repair_records, repair_wkt
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
from wavebatch.tools.voxels.grid import VoxelColumn

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
