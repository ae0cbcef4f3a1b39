"""LAS headers, VLRs and EVLRs as the bytes they are: what is not understood is carried over unchanged."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from laspy import PointFormat

from wavebatch.core.errors import InputError
from wavebatch.files.disk.raw_bytes import open_regular

HEADER_SIZES = {(1, 0): 227, (1, 1): 227, (1, 2): 227, (1, 3): 235, (1, 4): 375, (1, 5): 393}
"""Bytes of the header by LAS version."""

WAVES_INTERNAL = 0b10
WAVES_EXTERNAL = 0b100
WKT_BIT = 0b1_0000

STANDARD_DTYPES = {number: PointFormat(number).dtype() for number in range(11)}
"""Record of every point format without extra bytes; fields are named as in laspy's raw arrays."""

EVLR_HEADER_SIZE = 60
WAVEFORM_RECORD_ID = 65535
PROJECTION = "LASF_Projection"
"""User of the records that hold the CRS."""
WKT_ID, GEOTIFF_ID = 2112, 34735
_VLR = struct.Struct("<H16sHH32s")
_EVLR = struct.Struct("<H16sHQ32s")
_FRONT = struct.Struct("<4sHH16sBB32s32sHHHIIBHI5I12d")
"""All that the headers of every version begin with, 227 bytes."""


@dataclass(frozen=True, slots=True)
class Vlr:
    """One variable length record; user id and description are the raw bytes, NUL-padded."""

    user_id: bytes
    record_id: int
    payload: bytes
    description: bytes = b""
    reserved: int = 0

    @property
    def user(self) -> str:
        """The user id up to its first NUL; bytes that are not ASCII show as Latin-1."""
        return self.user_id.split(b"\0")[0].decode("latin-1")

    def encode(self) -> bytes:
        """The record as it stands in a file."""
        front = (self.reserved, self.user_id, self.record_id, len(self.payload), self.description)
        return _VLR.pack(*front) + self.payload


@dataclass(frozen=True, slots=True)
class Evlr:
    """Where an extended record lies: `start` is the offset of its 60-byte header, `length` that of its payload."""

    start: int
    length: int
    user: str
    record_id: int


@dataclass(slots=True)
class LasHeader:
    """Every field of a LAS header; `vlrs` hold no "laszip encoded" record unless read from a LAZ file."""

    version: tuple[int, int]
    point_format: int
    point_length: int
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    compressed: bool = False
    vlrs: list[Vlr] = field(default_factory=list)
    padding: bytes = b""
    """Bytes between the last VLR and the first point."""
    user_bytes: bytes = b""
    """Bytes between the header proper and the first VLR."""
    offset_to_points: int = 0
    file_source_id: int = 0
    global_encoding: int = 0
    project_id: bytes = bytes(16)
    system_identifier: bytes = b""
    generating_software: bytes = b""
    creation: tuple[int, int] = (0, 0)
    """Day of the year and year."""
    point_count: int = 0
    by_return: tuple[int, ...] = (0,) * 15
    maxs: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mins: tuple[float, float, float] = (0.0, 0.0, 0.0)
    waveform_start: int = 0
    evlr_start: int = 0
    evlr_count: int = 0
    gps_range: tuple[float, float] = (0.0, 0.0)
    """Largest and smallest gps time; LAS 1.5 only."""
    gps_offset: int = 0

    @property
    def size(self) -> int:
        """Bytes before the first VLR."""
        return HEADER_SIZES[self.version] + len(self.user_bytes)

    def encode(self) -> bytes:
        """Header, VLRs and padding as they stand in front of the points; also sets `offset_to_points`."""
        vlrs = b"".join(vlr.encode() for vlr in self.vlrs)
        self.offset_to_points = self.size + len(vlrs) + len(self.padding)
        legacy = self.version < (1, 4) or (self.point_format < 6 and self.point_count < 2**32)
        bounds = [value for pair in zip(self.maxs, self.mins, strict=True) for value in pair]
        front = _FRONT.pack(
            b"LASF", self.file_source_id, self.global_encoding, self.project_id, *self.version,
            self.system_identifier, self.generating_software, *self.creation, self.size, self.offset_to_points,
            len(self.vlrs), self.point_format | (0x80 if self.compressed else 0), self.point_length,
            *((self.point_count, *self.by_return[:5]) if legacy else (0,) * 6),
            *self.scales, *self.offsets, *bounds,
        )  # fmt: skip
        return front + self._encode_tail() + self.user_bytes + vlrs + self.padding

    def _encode_tail(self) -> bytes:
        tail = b""
        if self.version >= (1, 3):
            tail += struct.pack("<Q", self.waveform_start)
        if self.version >= (1, 4):
            tail += struct.pack("<QIQ15Q", self.evlr_start, self.evlr_count, self.point_count, *self.by_return)
        if self.version >= (1, 5):
            tail += struct.pack("<ddH", *self.gps_range, self.gps_offset)
        return tail


def read_header(path: Path) -> LasHeader:
    """Header and VLRs of the LAS or LAZ file at `path`; the points are not looked at.

    Raises InputError where the bytes are not those of a LAS file of version 1.0 to 1.5.
    """
    try:
        with open_regular(path) as file:
            return _read_header(file, path)
    except OSError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def read_header_of(file: BinaryIO) -> LasHeader:
    """Header and VLRs of an open LAS or LAZ file."""
    file.seek(0)
    return _read_header(file, Path(str(file.name)))


def _read_header(file: BinaryIO, path: Path) -> LasHeader:
    front = file.read(_FRONT.size)
    if len(front) < _FRONT.size or front[:4] != b"LASF":
        raise InputError(f"{path}: not a LAS or LAZ file (it does not begin with LASF)")
    (_, source_id, encoding, project, major, minor, system, software, day, year, size, offset, n_vlrs,
     point_format, length, count, *rest) = _FRONT.unpack(front)  # fmt: skip
    standard = HEADER_SIZES.get((major, minor))
    if standard is None:
        raise InputError(f"{path}: LAS version {major}.{minor} is not known; versions 1.0 to 1.5 can be read")
    file_size = os.fstat(file.fileno()).st_size
    if not standard <= size <= offset <= file_size:
        raise InputError(
            f"{path}: a header of {size} bytes with points at byte {offset} of {file_size} contradicts itself; damaged"
        )
    by_return, numbers = rest[:5], rest[5:]
    header = LasHeader(
        (major, minor), point_format & 0x3F, length, tuple(numbers[0:3]), tuple(numbers[3:6]),
        compressed=bool(point_format & 0xC0), offset_to_points=offset, file_source_id=source_id,
        global_encoding=encoding, project_id=project, system_identifier=system, generating_software=software,
        creation=(day, year), point_count=count, by_return=(*by_return, *(0,) * 10),
        maxs=tuple(numbers[6::2]), mins=tuple(numbers[7::2]),
    )  # fmt: skip
    _read_tail(header, file.read(standard - _FRONT.size))
    header.user_bytes = file.read(size - standard)
    header.vlrs = list(_read_vlrs(file.read(offset - size), n_vlrs, path))
    header.padding = _read_padding(file, header)
    return header


def _read_tail(header: LasHeader, tail: bytes) -> None:
    if header.version >= (1, 3):
        (header.waveform_start,) = struct.unpack_from("<Q", tail)
    if header.version >= (1, 4):
        header.evlr_start, header.evlr_count, count, *by_return = struct.unpack_from("<QIQ15Q", tail, 8)
        if count:
            header.point_count, header.by_return = count, tuple(by_return)
    if header.version >= (1, 5):
        largest, smallest, header.gps_offset = struct.unpack_from("<ddH", tail, 148)
        header.gps_range = (largest, smallest)


def _read_vlrs(data: bytes, count: int, path: Path) -> Iterator[Vlr]:
    at = 0
    for number in range(count):
        if at + _VLR.size > len(data):
            raise InputError(f"{path}: VLR {number} of {count} runs into the points; the header is damaged")
        reserved, user_id, record_id, length, description = _VLR.unpack_from(data, at)
        at += _VLR.size
        if at + length > len(data):
            raise InputError(f"{path}: VLR {number} of {count} runs into the points; the header is damaged")
        yield Vlr(user_id, record_id, data[at : at + length], description, reserved)
        at += length


def _read_padding(file: BinaryIO, header: LasHeader) -> bytes:
    used = header.size + sum(_VLR.size + len(vlr.payload) for vlr in header.vlrs)
    file.seek(used)
    return file.read(header.offset_to_points - used)


def find_evlrs(path: Path, header: LasHeader) -> tuple[list[Evlr], int]:
    """The EVLRs of a LAS 1.4 or 1.5 file that lie wholly inside it, in file order, and how many more the header claims.

    Payloads are not read. The walk ends at the first record that runs over the end of the file.
    """
    found: list[Evlr] = []
    points_end = header.offset_to_points
    if not header.compressed:
        points_end += header.point_count * header.point_length
    if header.version < (1, 4) or not header.evlr_count or header.evlr_start < points_end:
        return found, header.evlr_count
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        start = header.evlr_start
        while len(found) < header.evlr_count and start + EVLR_HEADER_SIZE <= size:
            file.seek(start)
            _, user_id, record_id, length, _ = _EVLR.unpack(file.read(EVLR_HEADER_SIZE))
            if start + EVLR_HEADER_SIZE + length > size:
                break
            found.append(Evlr(start, length, user_id.split(b"\0")[0].decode("latin-1"), record_id))
            start += EVLR_HEADER_SIZE + length
    return found, header.evlr_count - len(found)


def encode_evlr_header(user_id: bytes, record_id: int, length: int, description: bytes) -> bytes:
    """The 60 bytes in front of an extended record, which are also the first of a `.wdp` file."""
    return _EVLR.pack(0, user_id, record_id, length, description)


def is_projection(vlr: Vlr | Evlr) -> bool:
    """Whether it is a record of the CRS, however its user id is written."""
    return vlr.user.lower() == PROJECTION.lower()


def build_wkt(wkt: str) -> Vlr:
    """The record that holds the WKT of a CRS."""
    return Vlr(PROJECTION.encode(), WKT_ID, wkt.encode() + b"\0", b"OGC coordinate system WKT")


def has_record(vlrs: Iterable[Vlr | Evlr], user: str, record_id: int) -> bool:
    """Whether one of the records has this user id (any case) and number."""
    return any(vlr.record_id == record_id and vlr.user.lower() == user.lower() for vlr in vlrs)
