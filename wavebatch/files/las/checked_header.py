"""The header of a strip or cloud, checked before anything else in the file is believed: sizes, counts, format, scale.

The strip reader, the cloud readers and the output's layout start with `read_checked_header`. Every check here is
there because later code relies on it: allocations by counts, offsets into the file, indices of descriptors.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.raw_bytes import damaged
from wavebatch.files.las.extra_bytes import EXTRA_BYTES_RECORD_ID, ExtraRecord, build_dtype, read_records
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    STANDARD_DTYPES,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    LasHeader,
    has_record,
    read_header,
)
from wavebatch.files.point_dtypes import field_names

WAVEFORM_FORMATS = (4, 5, 9, 10)
LEAST_SCALE, LARGEST_SCALE, LARGEST_OFFSET = 1e-12, 1e6, 1e12
"""Scales and offsets of coordinates outside these limits [m] are damage: no survey needs them."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedHeader:
    """A header whose claims fit the size of the file."""

    path: Path
    size: int
    """Bytes of the file."""
    header: LasHeader
    dtype: np.dtype
    """One point record with laspy's field names, extra bytes included."""
    records: tuple[ExtraRecord, ...]
    points_end: int
    """Byte at which the points end: exact for LAS; for LAZ the start of what follows them."""
    warnings: tuple[str, ...]

    @property
    def version(self) -> str:
        """The LAS version, for example 1.4."""
        return "{}.{}".format(*self.header.version)

    @property
    def extra(self) -> dict[str, ExtraRecord]:
        """The record of each extra dimension by its field of `dtype`, in order."""
        names = field_names(self.dtype)
        return dict(zip(names[len(names) - len(self.records) :], self.records, strict=True))


def read_checked_header(path: Path, *, waveforms: bool = True) -> CheckedHeader:
    """Return the checked header of a full-waveform strip; its VLRs are read, its points and EVLRs are not.

    waveforms: False accepts any LAS or LAZ file, of any version and point format.
    Raises InputError if it is not a LAS or LAZ file with waveforms, or contradicts itself.
    """
    header = read_header(path, (1, 3) if waveforms else (1, 0))
    if waveforms:
        _check_waveforms(path, header)
    _check_format(path, header)
    _check_numbers(path, header)
    payloads = [vlr.payload for vlr in header.vlrs if has_record([vlr], "LASF_Spec", EXTRA_BYTES_RECORD_ID)]
    extra = header.point_length - STANDARD_DTYPES[header.point_format].itemsize
    records = tuple(read_records(payloads[0] if payloads else b"", extra))
    dtype = build_dtype(header.point_format, records)
    points_end = _find_points_end(path, header)
    return CheckedHeader(path, header.file_size, header, dtype, records, points_end, _find_warnings(header))


def _check_waveforms(path: Path, header: LasHeader) -> None:
    number = header.point_format
    if any(vlr.user == "lascompatible" for vlr in header.vlrs):
        restore = f"laszip -i {path.name} -o {path.stem}_restored.las"
        raise InputError(f"{path}: written in LAStools' LAS 1.4 compatibility mode; restore it first: {restore}")
    if number not in WAVEFORM_FORMATS:
        raise InputError(f"{path}: point format {number} has no waveforms; wavebatch needs format 4, 5, 9 or 10")
    both = WAVES_INTERNAL | WAVES_EXTERNAL
    if header.global_encoding & both == both:
        raise InputError(
            f"{path}: the header claims packets both in the file and in a .wdp (global encoding bits 1 and 2); clear "
            "the wrong bit in byte 6 of the file"
        )


def _check_format(path: Path, header: LasHeader) -> None:
    number = header.point_format
    if number not in STANDARD_DTYPES:
        raise damaged(path, f"point format {number} is not known")
    if number >= 6 and header.version < (1, 4):
        major, minor = header.version
        raise damaged(path, f"point format {number} needs LAS 1.4, but the header has version {major}.{minor}")
    least = STANDARD_DTYPES[number].itemsize
    if header.point_length < least:
        raise damaged(path, f"point records of {header.point_length} bytes are too short for format {number} ({least})")


def _check_numbers(path: Path, header: LasHeader) -> None:
    for axis, scale, offset in zip("xyz", header.scales, header.offsets, strict=True):
        if not (LEAST_SCALE <= abs(scale) <= LARGEST_SCALE and abs(offset) <= LARGEST_OFFSET):
            raise damaged(path, f"scale {scale} and offset {offset} of {axis} give no usable coordinates")


def _find_warnings(header: LasHeader) -> tuple[str, ...]:
    legacy, count = header.counts
    if header.version < (1, 4) or not legacy or legacy == count:
        return ()
    used = "64-bit" if count else "legacy"
    return (f"legacy point count {legacy} differs from the 64-bit count {count}; the {used} count is used",)


def _find_points_end(path: Path, header: LasHeader) -> int:
    """Byte at which the points end; raises InputError if the claimed points do not fit before what follows them."""
    start = header.offset_to_points
    room, limit = header.file_size, "it ends"
    followers = {"its EVLRs begin": header.evlr_start if header.evlr_count else 0}
    if not header.global_encoding & WAVES_EXTERNAL:
        followers["its waveform record begins"] = header.waveform_start
    for what, at in followers.items():
        if start <= at <= header.file_size - EVLR_HEADER_SIZE and at < room:
            room, limit = at, what
    if header.compressed:
        return room
    end = start + header.point_count * header.point_length
    if end > room:
        raise damaged(
            path,
            f"the header claims {header.point_count} points of {header.point_length} bytes from byte {start} on, but "
            f"{limit} at byte {room}, which leaves room for {(room - start) // header.point_length}",
        )
    return end
