"""The header of a strip or cloud, checked before anything else is believed: sizes, counts, format, scale."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.raw_bytes import open_regular
from wavebatch.files.las.extra_bytes import EXTRA_BYTES_RECORD_ID, ExtraRecord, build_dtype, read_records
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    HEADER_SIZES,
    STANDARD_DTYPES,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    LasHeader,
    has_record,
    read_header_of,
)

WAVEFORM_FORMATS = (4, 5, 9, 10)
MAX_FRONT = 1 << 26
"""Most bytes of header and VLRs: they are held in memory."""
MAX_VLRS = 1 << 16
LEAST_SCALE, LARGEST_SCALE, LARGEST_OFFSET = 1e-12, 1e6, 1e12
"""Beyond these, scale and offset of coordinates are damage [m]."""
MAX_FILE = 1 << 54
"""Byte offsets below this can share 64 bits with the number of a descriptor."""
_FRONT_FIELDS = struct.Struct("<4s20xBB68xHIIBH")


@dataclass(frozen=True, slots=True, eq=False)
class CheckedHeader:
    """A header that keeps its word, as far as the file's size can tell."""

    path: Path
    size: int
    """Of the file in bytes."""
    header: LasHeader
    dtype: np.dtype
    """One point record under laspy's field names, extra bytes included."""
    records: tuple[ExtraRecord, ...]
    points_end: int
    """Where the points end at the latest: exact for LAS, the first thing known to follow for LAZ."""
    warnings: tuple[str, ...]


def read_checked_header(path: Path, *, waveforms: bool = True) -> CheckedHeader:
    """Header of the full-waveform strip at `path`; its VLRs are read, its points and EVLRs are not.

    waveforms: False takes any LAS or LAZ file, of any version and point format.
    Raises InputError where it is not a LAS/LAZ strip with waveforms, or contradicts itself.
    """
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            _check_front(path, file, size, (1, 3) if waveforms else (1, 0))
            header = read_header_of(file)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; check name and permissions") from error
    if waveforms:
        _check_waveforms(path, header)
    _check_format(path, header)
    _check_numbers(path, header)
    payloads = [vlr.payload for vlr in header.vlrs if has_record([vlr], "LASF_Spec", EXTRA_BYTES_RECORD_ID)]
    extra = header.point_length - STANDARD_DTYPES[header.point_format].itemsize
    records = tuple(read_records(payloads[0] if payloads else b"", extra))
    warnings = _find_warnings(path, header)
    points_end = _check_room(path, header, size)
    return CheckedHeader(path, size, header, build_dtype(header.point_format, records), records, points_end, warnings)


def _check_front(path: Path, file: BinaryIO, size: int, least: tuple[int, int]) -> None:
    """Refuses versions before `least`, and what would make reading the header cost more than a header may."""
    front = file.read(_FRONT_FIELDS.size)
    if len(front) < _FRONT_FIELDS.size or front[:4] != b"LASF":
        raise InputError(f"{path}: not a LAS or LAZ file (it does not begin with LASF)")
    _, major, minor, header_size, offset, vlrs, _, _ = _FRONT_FIELDS.unpack(front)
    known = HEADER_SIZES.get((major, minor))
    if known is None or (major, minor) < least:
        what = "has no waveforms" if known else "is not known"
        raise InputError(
            f"{path}: LAS version {major}.{minor} {what}; wavebatch reads versions {least[0]}.{least[1]} to 1.5 here"
        )
    if size >= MAX_FILE:
        raise InputError(f"{path}: a file of {size} bytes is beyond what wavebatch addresses; tile the strip")
    if not known <= header_size <= offset <= size:
        raise InputError(
            f"{path}: a header of {header_size} bytes with points at byte {offset} of {size} contradicts itself; "
            "the file is damaged or cut: get it again"
        )
    if offset > MAX_FRONT or vlrs > MAX_VLRS:
        raise InputError(
            f"{path}: header and {vlrs} VLRs of {offset} bytes are beyond all reason ({MAX_VLRS} VLRs, {MAX_FRONT} "
            "bytes); the header is damaged: get the file again"
        )


def _check_waveforms(path: Path, header: LasHeader) -> None:
    number = header.point_format
    if any(vlr.user == "lascompatible" for vlr in header.vlrs):
        raise InputError(
            f"{path}: written in LAStools' LAS 1.4 compatibility mode; restore it first: laszip -i {path.name} -o "
            f"{path.stem}_restored.las"
        )
    if number not in WAVEFORM_FORMATS:
        raise InputError(f"{path}: point format {number} has no waveforms; wavebatch needs format 4, 5, 9 or 10")
    both = WAVES_INTERNAL | WAVES_EXTERNAL
    if header.global_encoding & both == both:
        raise InputError(
            f"{path}: the header says that packets are in the file and in a .wdp (global encoding bits 1 and 2); "
            "clear the wrong bit of byte 6"
        )


def _check_format(path: Path, header: LasHeader) -> None:
    number = header.point_format
    if number not in STANDARD_DTYPES:
        raise InputError(f"{path}: point format {number} is not known; the header is damaged: get the file again")
    if number >= 6 and header.version < (1, 4):
        major, minor = header.version
        raise InputError(
            f"{path}: point format {number} needs LAS 1.4, the header says {major}.{minor}; the header is damaged"
        )
    least = STANDARD_DTYPES[number].itemsize
    if header.point_length < least:
        raise InputError(
            f"{path}: point records of {header.point_length} bytes are too short for format {number} ({least}); "
            "the header is damaged: get the file again"
        )


def _check_numbers(path: Path, header: LasHeader) -> None:
    for axis, scale, offset in zip("xyz", header.scales, header.offsets, strict=True):
        if not (LEAST_SCALE <= abs(scale) <= LARGEST_SCALE and abs(offset) <= LARGEST_OFFSET):
            raise InputError(
                f"{path}: scale {scale} and offset {offset} of {axis} give no coordinates; the header is damaged: "
                "get the file again"
            )


def _find_warnings(path: Path, header: LasHeader) -> tuple[str, ...]:
    if header.version < (1, 4):
        return ()
    with open(path, "rb") as file:
        front = file.read(255)
    legacy, count = struct.unpack_from("<I", front, 107)[0], struct.unpack_from("<Q", front, 247)[0]
    if legacy and legacy != count:
        used = "the legacy count is used" if not count else "the 64-bit count is used"
        return (f"legacy point count {legacy} differs from the 64-bit count {count}; {used}",)
    return ()


def _check_room(path: Path, header: LasHeader, size: int) -> int:
    """Byte at which the points end; raises InputError where the claimed points do not fit before what follows."""
    start = header.offset_to_points
    room = size
    followers = {"its EVLRs begin": header.evlr_start if header.evlr_count else 0}
    if not header.global_encoding & WAVES_EXTERNAL:
        followers["its waveform record begins"] = header.waveform_start
    limit = "it ends"
    for what, at in followers.items():
        if start <= at <= size - EVLR_HEADER_SIZE and at < room:
            room, limit = at, what
    if header.compressed:
        return room
    end = start + header.point_count * header.point_length
    if end > room:
        raise InputError(
            f"{path}: the header claims {header.point_count} points of {header.point_length} bytes from byte {start} "
            f"on, but {limit} at byte {room}, which leaves room for {(room - start) // header.point_length}; the file "
            "is cut or its header damaged: get it again"
        )
    return end
