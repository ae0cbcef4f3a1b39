"""LAS headers, VLRs and EVLRs: read, checked for size, and written again byte for byte; and the records of all formats.

All readers and writers of LAS and LAZ files start here. Fields that wavebatch does not use are kept unchanged, so a
header that is read and encoded again must give the same bytes. Limits stand before anything is read into memory.
`STANDARD_DTYPES` is written out here, because laspy takes 50 ms to import: every process of a run would pay that, for
names alone. A test compares it with laspy.

A conversion of records between point formats is allowed only if it loses nothing except the waveform fields.

Extra bytes: the 192-byte records that describe them, and the dtype of points with them. A record keeps its bytes as
they are in the file; an unknown or wrong description must never make a file unreadable, so its bytes become a column of
unknown content.
"""

from __future__ import annotations

import codecs
import contextlib
import functools
import os
import struct
from collections.abc import Container, Iterable, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import changeable, frozen
from wavebatch.files.disk.raw_bytes import damaged, open_regular, reporting_reads, widen_integers

_XYZ = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1")]
_OLD = [
    *_XYZ, ("raw_classification", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1"), ("point_source_id", "<u2"),
]  # fmt: skip
_NEW = [
    *_XYZ, ("classification_flags", "u1"), ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2"),
    ("point_source_id", "<u2"), ("gps_time", "<f8"),
]  # fmt: skip
_TIME = [("gps_time", "<f8")]
_RGB = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
_NIR = [("nir", "<u2")]
_WAVE = [
    ("wavepacket_index", "u1"), ("wavepacket_offset", "<u8"), ("wavepacket_size", "<u4"),
    ("return_point_wave_location", "<f4"), ("x_t", "<f4"), ("y_t", "<f4"), ("z_t", "<f4"),
]  # fmt: skip

STANDARD_DTYPES = {
    number: np.dtype(fields)
    for number, fields in enumerate(
        (
            _OLD, [*_OLD, *_TIME], [*_OLD, *_RGB], [*_OLD, *_TIME, *_RGB], [*_OLD, *_TIME, *_WAVE],
            [*_OLD, *_TIME, *_RGB, *_WAVE], _NEW, [*_NEW, *_RGB], [*_NEW, *_RGB, *_NIR], [*_NEW, *_WAVE],
            [*_NEW, *_RGB, *_NIR, *_WAVE],
        )
    )
}  # fmt: skip
"""Record of every point format without extra bytes; fields have the names of laspy's raw arrays."""

_EDGES = ("scan_direction_flag", "edge_of_flight_line")
_MARKS = ("synthetic", "key_point", "withheld")
_NUMBERS = ("return_number", "number_of_returns")


def field_names(dtype: np.dtype) -> tuple[str, ...]:
    """Return the names of the fields of a record."""
    return dtype.names or ()


def list_dimensions(point_format: int) -> tuple[str, ...]:
    """Return the names of the standard dimensions of a point format: fields, and parts of fields, as laspy has them."""
    parts: dict[str, tuple[str, ...]]
    parts = {"bit_fields": (*_NUMBERS, *_EDGES), "raw_classification": ("classification", *_MARKS)}
    if point_format > 5:
        flags = (*_MARKS, "overlap", "scanner_channel", *_EDGES)
        parts = {"bit_fields": _NUMBERS, "classification_flags": flags}
    return tuple(part for name in field_names(STANDARD_DTYPES[point_format]) for part in parts.get(name, (name,)))


HEADER_SIZES = {(1, 0): 227, (1, 1): 227, (1, 2): 227, (1, 3): 235, (1, 4): 375, (1, 5): 393}
"""Bytes of the header by LAS version."""
SOFTWARE = f"wavebatch {__version__}".encode()
"""Generating software in the headers of all outputs."""
MAX_FRONT = 1 << 26
"""Most bytes of header and VLRs, because they are kept in memory."""
MAX_VLRS = 1 << 16
"""Most VLRs: each costs time and memory even when it is empty."""
MAX_FILE = 1 << 54
"""Byte offsets below this fit into 64 bits together with the index of a descriptor."""

STANDARD_TIME = 0b1
"""GPS times are standard GPS time less 1e9 s; else seconds of the week."""
WAVES_INTERNAL = 0b10
WAVES_EXTERNAL = 0b100
WKT_BIT = 0b1_0000

EVLR_HEADER_SIZE = 60
MAX_EVLRS = 4096
"""Most EVLRs that are looked at: a damaged header can claim 4 billion."""
WAVEFORM_RECORD_ID = 65535
PROJECTION = "LASF_Projection"
"""User id of the records that hold the CRS."""
WKT_ID, GEOTIFF_ID = 2112, 34735
_VLR = struct.Struct("<H16sHH32s")
_EVLR = struct.Struct("<H16sHQ32s")
_FRONT = struct.Struct("<4sHH16sBB32s32sHHHIIBHI5I12d")
"""The first 227 bytes, which are the same in all versions."""


@frozen
class Vlr:
    """A variable length record; user id and description are the raw bytes, padded with NUL."""

    user_id: bytes
    record_id: int
    payload: bytes
    description: bytes = b""
    reserved: int = 0

    @property
    def user(self) -> str:
        """The user id up to its first NUL."""
        return decode_text(self.user_id)

    def encode(self) -> bytes:
        """Return the bytes of the record in a file."""
        front = (self.reserved, self.user_id, self.record_id, len(self.payload), self.description)
        return _VLR.pack(*front) + self.payload


@frozen
class Evlr:
    """Place of an extended record: `start` is the offset of its 60-byte header, `length` the size of its payload."""

    start: int
    length: int
    user: str
    record_id: int


@changeable
class LasHeader:
    """Every field of a LAS header; `vlrs` has a "laszip encoded" record only if it was read from a LAZ file."""

    version: tuple[int, int]
    point_format: int
    point_length: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    compressed: bool = False
    vlrs: list[Vlr] = field(default_factory=list)
    padding: bytes = b""
    """Bytes between the last VLR and the first point."""
    user_bytes: bytes = b""
    """Bytes between the standard header and the first VLR."""
    offset_to_points: int = 0
    file_source_id: int = 0
    global_encoding: int = 0
    project_id: bytes = bytes(16)
    system_identifier: bytes = b""
    generating_software: bytes = b""
    creation: tuple[int, int] = (0, 0)
    """Day of the year and year."""
    point_count: int = 0
    counts: tuple[int, int] = (0, 0)
    """Points by the 32-bit and the 64-bit field of the file that was read; `point_count` is the one to use."""
    file_size: int = 0
    """Bytes of the file that was read; 0 for a new header."""
    by_return: tuple[int, ...] = (0,) * 15
    maxs: tuple[float, ...] = (0.0, 0.0, 0.0)
    mins: tuple[float, ...] = (0.0, 0.0, 0.0)
    waveform_start: int = 0
    evlr_start: int = 0
    evlr_count: int = 0
    gps_range: tuple[float, float] = (0.0, 0.0)
    """Largest and smallest GPS time; LAS 1.5 only."""
    gps_offset: int = 0

    @classmethod
    def new(
        cls,
        version: tuple[int, int],
        point_format: int,
        scales: Sequence[float],
        offsets: Sequence[float],
        wkt: str | None = None,
        encoding: int = 0,
    ) -> LasHeader:
        """Return the header of a new file, without any date so that equal input gives equal bytes.

        encoding: bits of the global encoding besides GPS time and WKT.
        """
        is_wkt = point_format >= 6 or (wkt and version >= (1, 4))
        return cls(
            version,
            point_format,
            0,
            tuple(map(float, scales)),
            tuple(map(float, offsets)),
            vlrs=[build_wkt(wkt)] if wkt else [],
            global_encoding=STANDARD_TIME | encoding | (WKT_BIT if is_wkt else 0),
            system_identifier=b"OTHER",
            generating_software=SOFTWARE,
            creation=(1, 2025),
        )

    @property
    def size(self) -> int:
        """Number of bytes before the first VLR."""
        return HEADER_SIZES[self.version] + len(self.user_bytes)

    def encode(self) -> bytes:
        """Return header, VLRs and padding, all bytes before the points; also sets `offset_to_points`."""
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
        tail = b""
        if self.version >= (1, 3):
            tail += struct.pack("<Q", self.waveform_start)
        if self.version >= (1, 4):
            tail += struct.pack("<QIQ15Q", self.evlr_start, self.evlr_count, self.point_count, *self.by_return)
        if self.version >= (1, 5):
            tail += struct.pack("<ddH", *self.gps_range, self.gps_offset)
        return front + tail + self.user_bytes + vlrs + self.padding


def read_header(path: Path, least: tuple[int, int] = (1, 0)) -> LasHeader:
    """Return header and VLRs of a LAS or LAZ file; the points are not read.

    Raises InputError if it is not a LAS file of version `least` to 1.5, or if its header is too large or contradicts
    itself.
    """
    with reporting_reads(path, remedy="; check name and permissions"), open_regular(path) as file:
        file.seek(0)
        front = file.read(_FRONT.size)
        if len(front) < _FRONT.size or front[:4] != b"LASF":
            raise InputError(f"{path}: not a LAS or LAZ file (it does not begin with LASF){_guess(path, front)}")
        (_, source_id, encoding, project, major, minor, system, software, day, year, size, offset, n_vlrs,
         point_format, length, count, *rest) = _FRONT.unpack(front)  # fmt: skip
        standard = HEADER_SIZES.get((major, minor))
        if standard is None or (major, minor) < least:
            what = "has no waveforms" if standard else "is not known"
            versions = f"{least[0]}.{least[1]} to 1.5"
            raise InputError(f"{path}: LAS version {major}.{minor} {what}; wavebatch needs versions {versions} here")
        file_size = os.fstat(file.fileno()).st_size
        if file_size >= MAX_FILE:
            raise InputError(f"{path}: a file of {file_size} bytes is too large for wavebatch; cut it into tiles")
        if not standard <= size <= offset <= file_size:
            raise damaged(path, f"header of {size} bytes, but points at byte {offset} of {file_size}")
        if offset > MAX_FRONT or n_vlrs > MAX_VLRS:
            raise damaged(path, f"header with {n_vlrs} VLRs in {offset} bytes (at most {MAX_VLRS} in {MAX_FRONT})")
        by_return, numbers = rest[:5], rest[5:]
        header = LasHeader(
            (major, minor), point_format & 0x3F, length, tuple(numbers[0:3]), tuple(numbers[3:6]),
            compressed=bool(point_format & 0xC0), offset_to_points=offset, file_source_id=source_id,
            global_encoding=encoding, project_id=project, system_identifier=system, generating_software=software,
            creation=(day, year), point_count=count, counts=(count, 0), file_size=file_size,
            by_return=(*by_return, *(0,) * 10),
            maxs=tuple(numbers[6::2]), mins=tuple(numbers[7::2]),
        )  # fmt: skip
        tail = file.read(standard - _FRONT.size)
        if header.version >= (1, 3):
            (header.waveform_start,) = struct.unpack_from("<Q", tail)
        if header.version >= (1, 4):
            header.evlr_start, header.evlr_count, count, *by_return = struct.unpack_from("<QIQ15Q", tail, 8)
            header.counts = header.point_count, count
            if count:
                header.point_count, header.by_return = count, tuple(by_return)
        if header.version >= (1, 5):
            largest, smallest, header.gps_offset = struct.unpack_from("<ddH", tail, 148)
            header.gps_range = (largest, smallest)
        header.user_bytes = file.read(size - standard)
        records, at = file.read(offset - size), 0
        for number in range(n_vlrs):
            head = records[at : at + _VLR.size].ljust(_VLR.size, b"\0")
            reserved, user_id, record_id, length, description = _VLR.unpack(head)
            at += _VLR.size + length
            if at > len(records):
                raise damaged(path, f"VLR {number} of {n_vlrs} runs into the points")
            header.vlrs.append(Vlr(user_id, record_id, records[at - length : at], description, reserved))
        header.padding = records[at:]
        return header


def _guess(path: Path, front: bytes) -> str:
    """What a file is that is no LAS file, and what to give in its place; empty where that is not known."""
    beside = (path.with_suffix(end) for end in (".las", ".laz", ".LAS", ".LAZ"))
    strip = next((one for one in beside if one.is_file()), None)
    if front.startswith(b"PulseWaves") and path.suffix.lower() == ".plz":
        return f"; it is compressed PulseWaves: `pulsezip -i {path.name} -o {path.stem}.pls` of the PulseWaves tools " \
            f"decompresses it, then `wavebatch import {path.stem}.pls` makes a strip of it"
    if front.startswith(b"PulseWaves"):
        return f"; it is PulseWaves: `wavebatch import {path}` makes a strip of it" + f", or give {strip}" * bool(strip)
    if path.suffix.lower() in (".wdp", ".wdz"):
        return f"; it has the packets of {strip or path.with_suffix('.las')}: give that file"
    if path.suffix.lower() == ".npz":
        return "; it is a file of arrays, as `voxelize`, `slice --cube` and `simulate --truth` write them"
    if front.startswith((b"\x1f\x8b", b"PK\x03\x04", b"7z\xbc\xaf", b"BZh", b"\xfd7zXZ", b"\x28\xb5\x2f\xfd")):
        return "; it is a compressed file or an archive (gzip, ZIP, 7z, bzip2, xz or zstd): unpack it first"
    text = path.suffix.lower() in (".txt", ".lst", ".list", ".csv") or not front
    if text and b"\0" not in front:
        return f"; if it is a list of files, write @{path}" if front else "; it is empty"
    return ""


def find_evlrs(path: Path, header: LasHeader, most: int = MAX_EVLRS) -> tuple[list[Evlr], int]:
    """Return the EVLRs that lie wholly inside a file, in file order, and how many more the header claims.

    Payloads are not read. The search ends after `most` records, or at the first that runs over the end of the file.
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
        while len(found) < min(header.evlr_count, most) and start + EVLR_HEADER_SIZE <= size:
            file.seek(start)
            _, user_id, record_id, length, _ = _EVLR.unpack(file.read(EVLR_HEADER_SIZE))
            if start + EVLR_HEADER_SIZE + length > size:
                break
            found.append(Evlr(start, length, decode_text(user_id), record_id))
            start += EVLR_HEADER_SIZE + length
    return found, header.evlr_count - len(found)


def read_evlr(path: Path, evlr: Evlr) -> bytes:
    """Return the payload of an extended record."""
    with open(path, "rb") as file:
        file.seek(evlr.start + EVLR_HEADER_SIZE)
        return file.read(evlr.length)


@functools.lru_cache(256)
def decode_text(data: bytes) -> str:
    """Return a text field up to its first NUL: UTF-8, the last letter of which a full field may cut, else Latin-1."""
    text, end, _ = data.partition(b"\0")
    with contextlib.suppress(UnicodeDecodeError):
        found, used = codecs.utf_8_decode(text, "strict", bool(end))
        if used == len(text) or not found.isascii():  # after ASCII, the last byte is rather a letter of Latin-1
            return found
    return text.decode("latin-1")


def encode_evlr_header(user_id: bytes, record_id: int, length: int, description: bytes) -> bytes:
    """Return the 60 bytes before the payload of an extended record; a `.wdp` file begins with them too."""
    return _EVLR.pack(0, user_id, record_id, length, description)


def is_projection(vlr: Vlr | Evlr) -> bool:
    """Whether it is a record of the CRS; upper and lower case of its user id do not matter."""
    return vlr.user.lower() == PROJECTION.lower()


def build_wkt(wkt: str) -> Vlr:
    """Return the record that holds the WKT of a CRS."""
    return Vlr(PROJECTION.encode(), WKT_ID, wkt.encode() + b"\0", b"OGC coordinate system WKT")


def has_record(vlrs: Iterable[Vlr | Evlr], user: str, record_id: int) -> bool:
    """Whether one of the records has this user id (in any case) and number."""
    return any(vlr.record_id == record_id and vlr.user.lower() == user.lower() for vlr in vlrs)


WITHOUT_WAVES = {4: 1, 5: 3, 9: 6, 10: 8}
"""For each waveform format the format with the same fields except the waveform fields."""
MODERN = {0: 6, 1: 6, 2: 7, 3: 7}
"""For each format of LAS 1.0 to 1.3 the one of LAS 1.4 that holds its fields; those without GPS time get zero."""
_WAVE_FIELDS = frozenset(field_names(STANDARD_DTYPES[4])) - frozenset(field_names(STANDARD_DTYPES[1]))
ANGLE_UNIT = 0.006
"""Degrees per count of `scan_angle` in formats 6-10; `scan_angle_rank` of formats 0-5 counts whole degrees."""
_OVERLAP_CLASS = 12
GROUND = 2
"""Class of the ground."""

CLASS_NAMES = {
    0: "never classified", 1: "unclassified", 2: "ground", 3: "low vegetation", 4: "medium vegetation",
    5: "high vegetation", 6: "building", 7: "low point", 9: "water", 17: "bridge deck", 18: "high noise",
}  # fmt: skip
"""Names of classes in the LAS standard that all versions share."""


def locate(points: np.ndarray, header: LasHeader) -> np.ndarray:
    """Return coordinates of records (n,), f8 (n, 3) [m]."""
    axes = zip("XYZ", header.scales, header.offsets, strict=True)
    return np.stack([points[name] * scale + offset for name, scale, offset in axes], axis=1)


def split_numbers(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the return numbers and numbers of returns of records (n,), u1 (n,) each."""
    bits = points["bit_fields"]
    return (bits & 15, bits >> 4) if "classification_flags" in field_names(points.dtype) else (bits & 7, bits >> 3 & 7)


def read_classes(points: np.ndarray) -> np.ndarray:
    """Return the classes of records (n,), u1 (n,), without the flags that formats 0 to 5 keep in the same byte."""
    modern = "classification_flags" in field_names(points.dtype)
    return points["classification"] if modern else points["raw_classification"] & 31


def read_angles(points: np.ndarray) -> np.ndarray:
    """Return the scan angles of records (n,) of any point format [deg], f8 (n,)."""
    modern = "classification_flags" in field_names(points.dtype)
    return points["scan_angle"] * ANGLE_UNIT if modern else points["scan_angle_rank"].astype(np.float64)


def read_scanner(records: np.ndarray) -> np.ndarray | None:
    """Scanner channels of records (n,), u1 (n,); None for point formats 0 to 5."""
    if "classification_flags" not in field_names(records.dtype):
        return None
    return (records["classification_flags"] >> 4) & 3


def choose_format(path: Path, header: LasHeader, wanted: int | None, keep: bool) -> int:
    """Return the point format of the output: that of the input without waveforms, or the `wanted` one.

    keep: the output keeps the waveform fields. Raises ConfigError if the wanted format would lose anything else.
    """
    given = header.point_format
    if wanted is None:
        return given if keep else WITHOUT_WAVES.get(given, given)
    # All fields but the waveform fields have a place; never from 6-10 back to 0-5.
    legal = []
    for number, dtype in STANDARD_DTYPES.items():
        have = set(field_names(STANDARD_DTYPES[given])) - _WAVE_FIELDS
        have -= {"raw_classification", "scan_angle_rank"} if number >= 6 else set()
        if not given >= 6 > number and have <= set(field_names(dtype)) and (number in WITHOUT_WAVES) == keep:
            legal.append(number)
    if wanted not in legal:
        raise ConfigError(
            f"{path}: point format {given} cannot be written as {wanted}{' with its packets' if keep else ''} without "
            f"loss; possible are {', '.join(map(str, legal))}"
        )
    return wanted


def copy_standard(source: np.ndarray, rows: np.ndarray, old: int, new: int) -> None:
    """Copy the standard fields of records (n,) from format `old` to format `new`.

    Formats of one family begin with the same bytes: these are copied in one piece, which is several times faster.
    """
    base_old, base_new = WITHOUT_WAVES.get(old, old), WITHOUT_WAVES.get(new, new)
    if base_old == base_new:
        wave = old in WITHOUT_WAVES and new in WITHOUT_WAVES
        size = STANDARD_DTYPES[new if wave else base_new].itemsize
        first: Any = {"names": ["record"], "formats": [f"V{size}"], "offsets": [0]}  # the first bytes, as one field
        target, given = (records.view(first | {"itemsize": records.dtype.itemsize}) for records in (rows, source))
        target["record"] = given["record"]
        return
    for name in field_names(STANDARD_DTYPES[new]):
        if name in field_names(STANDARD_DTYPES[old]):
            rows[name] = source[name]
    if old < 6 <= new:
        # Flags, class, returns and angle of formats 0-5; class 12 also sets the overlap bit.
        bits, flags = source["bit_fields"], source["raw_classification"]
        kind = flags & 0b11111
        overlap = (kind == _OVERLAP_CLASS).astype(np.uint8) << np.uint8(3)
        rows["bit_fields"] = (bits & 0b111) | ((bits & 0b111000) << 1)
        rows["classification"] = kind
        rows["classification_flags"] = (flags >> 5) | overlap | (bits & 0b11000000)
        rows["scan_angle"] = np.rint(source["scan_angle_rank"] / ANGLE_UNIT).astype(np.int16)


RECORD_SIZE = 192
EXTRA_BYTES_RECORD_ID = 4
_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
_NO_DATA, _MIN, _MAX, _SCALE, _OFFSET = 1, 2, 4, 8, 16
TEXT_BYTES = 32
"""Length of name and description in a record."""

_LARGEST = 1e30
"""Larger values are damage and become no data: their squares would overflow in single precision."""

_AT_NAME, _AT_NO_DATA, _AT_MIN, _AT_MAX, _AT_SCALE, _AT_DESCRIPTION = 4, 40, 64, 88, 112, 160


@frozen
class ExtraRecord:
    """One described extra dimension; `data` are the 192 bytes of its record in the file."""

    data: bytes

    @classmethod
    def build(
        cls, name: str, dtype: str, description: str, *, no_data: float | None = None, scale: float | None = None
    ) -> ExtraRecord:
        """Return a record for a new dimension; `no_data` is a stored value; name and description take 32 bytes each."""
        texts = name.encode("utf-8"), description.encode("utf-8")
        if any(len(text) > TEXT_BYTES for text in texts):
            raise ValueError(f"extra bytes {name!r}: name and description hold {TEXT_BYTES} bytes at most")
        code = _TYPES.index(np.dtype(dtype).str[1:]) + 1
        options = 0 if scale is None else _SCALE | _OFFSET
        scales = (scale or 0.0, 0.0, 0.0)
        front = struct.pack("<HBB32s4x", 0, code, options, texts[0])
        record = cls(front + bytes(72) + struct.pack("<6d32s", *scales, 0.0, 0.0, 0.0, texts[1]))
        return record if no_data is None else record.with_no_data([no_data])

    @classmethod
    def undocumented(cls, name: str, size: int) -> ExtraRecord:
        """Return a record of type 0 for `size` (1 to 255) bytes of unknown content."""
        return cls(struct.pack("<HBB32s", 0, 0, size, name.encode()) + bytes(RECORD_SIZE - 36))

    @property
    def name(self) -> str:
        """The name up to the first NUL."""
        return self.data[4:36].split(b"\0")[0].decode("utf-8", "replace")

    @property
    def description(self) -> str:
        """The description up to the first NUL."""
        return self.data[_AT_DESCRIPTION:].split(b"\0")[0].decode("utf-8", "replace")

    @property
    def code(self) -> int:
        """Data type of the LAS specification: 0 undocumented, 1 to 10 scalars, 11 to 30 the deprecated vectors."""
        return self.data[2]

    @property
    def dtype(self) -> np.dtype:
        """Stored type, with the shape (k,) of the deprecated vectors and of undocumented bytes."""
        if self.code == 0:
            return np.dtype(("u1", (self.data[3],))) if self.data[3] != 1 else np.dtype("u1")
        kind, length = _TYPES[(self.code - 1) % 10], (self.code - 1) // 10 + 1
        return np.dtype(f"<{kind}") if length == 1 else np.dtype((f"<{kind}", (length,)))

    def _numbers(self, at: int, option: int) -> np.ndarray | None:
        if self.code == 0 or not self.data[3] & option:
            return None
        dtype = self.dtype
        # 8-byte numbers hold the no-data, least and largest value.
        stored, length = np.dtype(f"<{dtype.base.kind}8"), max(1, dtype.itemsize // dtype.base.itemsize)
        numbers = np.frombuffer(self.data, stored, length, at)
        with np.errstate(over="ignore", invalid="ignore"):
            return numbers.astype(dtype.base)

    @property
    def scaling(self) -> tuple[float, float] | None:
        """Scale and offset of a scalar's stored value; None if the stored value is not scaled."""
        if not self.data[3] & _SCALE or not 1 <= self.code <= 10:
            return None
        scale, offset = struct.unpack_from("<d16xd", self.data, _AT_SCALE)
        return scale, offset if self.data[3] & _OFFSET else 0.0

    @property
    def no_data(self) -> np.ndarray | None:
        """Stored value per element that means "no data"; None if the record declares none."""
        return self._numbers(_AT_NO_DATA, _NO_DATA)

    def read(self, stored: np.ndarray) -> np.ndarray:
        """Return physical values, f8 (n,), of stored values (n,); NaN for no data and for damage."""
        values, no_data = widen_integers(stored), self.no_data
        with np.errstate(over="ignore", invalid="ignore"):
            if self.scaling is not None:
                values = values * self.scaling[0] + self.scaling[1]
            if no_data is not None:
                values[stored == no_data[0]] = np.nan
            return np.where(np.abs(values) <= _LARGEST, values, np.nan)

    @property
    def declared_range(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Declared least and largest stored value per element; in many files they are wrong."""
        least, largest = self._numbers(_AT_MIN, _MIN), self._numbers(_AT_MAX, _MAX)
        return None if least is None or largest is None else (least, largest)

    def _with(self, at: int, option: int, numbers: np.ndarray | list | None) -> ExtraRecord:
        data = bytearray(self.data)
        data[at : at + 24] = bytes(24)
        data[3] &= ~option
        if numbers is not None:
            packed = np.asarray(numbers).astype(np.dtype(f"<{self.dtype.base.kind}8")).tobytes()
            data[at : at + len(packed)] = packed
            data[3] |= option
        return ExtraRecord(bytes(data))

    def with_readable_texts(self) -> ExtraRecord:
        """Return the record with name and description in UTF-8, without which laspy cannot open the file.

        Bytes that are no UTF-8 count as Latin-1, which some vendors write.
        """
        data = bytearray(self.data)
        for at in (_AT_NAME, _AT_DESCRIPTION):
            text = self.data[at : at + TEXT_BYTES].split(b"\0")[0]
            readable = decode_text(self.data[at : at + TEXT_BYTES])
            if readable.encode() != text:
                data[at : at + TEXT_BYTES] = _as_field(readable)
        return ExtraRecord(bytes(data))

    def with_name(self, name: str) -> ExtraRecord:
        """Return the record with another name, cut to 32 bytes."""
        return ExtraRecord(self.data[:_AT_NAME] + _as_field(name) + self.data[_AT_NAME + TEXT_BYTES :])

    def with_no_data(self, numbers: np.ndarray | list) -> ExtraRecord:
        """Return the record with this stored no-data value per element."""
        return self._with(_AT_NO_DATA, _NO_DATA, numbers)

    def with_range(self, least: np.ndarray | None, largest: np.ndarray | None) -> ExtraRecord:
        """Return the record with these stored extremes; None removes the declaration. Type 0 has none."""
        if self.code == 0:
            return self
        return self._with(_AT_MIN, _MIN, least)._with(_AT_MAX, _MAX, largest)


def read_records(payload: bytes, size: int) -> list[ExtraRecord]:
    """Return records for all `size` extra bytes of a point; bytes that `payload` does not describe get type 0.

    A record of unknown type, or one that needs more bytes than there are, ends the description. Records of type 0 have
    their size where others have options; laspy fails on sizes that look like a scale or an offset, so none has such.
    """
    records: list[ExtraRecord] = []
    left = size
    for at in range(0, len(payload) - RECORD_SIZE + 1, RECORD_SIZE):
        record = ExtraRecord(payload[at : at + RECORD_SIZE])
        if record.code > 30 or not 0 < record.dtype.itemsize <= left:
            break
        records.append(record)
        left -= record.dtype.itemsize
    taken = {record.name for record in records}
    number = 1
    while left:
        name = "ExtraBytes" if number == 1 else f"ExtraBytes {number}"
        number += 1
        if name not in taken:
            part = min(left, 255) & ~(_SCALE | _OFFSET) or min(left, 7)
            records.append(ExtraRecord.undocumented(name, part))
            left -= part
    return records


def name_uniquely(records: Sequence[ExtraRecord], point_format: int) -> list[ExtraRecord]:
    """Return the records with names that no other one and no field of the format has: laspy opens no other file.

    A name that is taken, or empty, gets " 2", " 3" ... at its end, as in `build_dtype`.
    """
    taken = set(field_names(STANDARD_DTYPES[point_format]))
    apart = []
    for record in records:
        name = _free_name(record.name, taken, TEXT_BYTES)
        taken.add(name)
        apart.append(record if name == record.name else record.with_name(name))
    return apart


def _free_name(name: str, taken: Container[str], most: int | None = None) -> str:
    """The name, with " 2", " 3" ... at its end if it is empty or taken; most: bytes that it may then have."""
    found, number = name, 1
    while not found or found in taken:
        number += 1
        end = f" {number}"
        found = (name if most is None else name.encode()[: most - len(end)].decode(errors="ignore")) + end
    return found


def _as_field(text: str) -> bytes:
    """The text as a record holds it."""
    return text.encode()[:TEXT_BYTES].decode(errors="ignore").encode().ljust(TEXT_BYTES, b"\0")


def build_dtype(point_format: int, records: Sequence[ExtraRecord]) -> np.dtype:
    """Return the dtype of a point record: the standard fields with laspy's names, then the extra dimensions.

    A field has the name of its record; an empty or repeated name gets " 2", " 3" ... at its end.
    """
    standard = STANDARD_DTYPES[point_format]
    fields = {name: standard[name] for name in field_names(standard)}
    for record in records:
        fields[_free_name(record.name, fields)] = record.dtype
    return np.dtype(list(fields.items()))


def choose_no_data(record: ExtraRecord) -> np.ndarray | None:
    """Return a stored value per element that no real value has, or None if none is safe.

    A declared no-data value stays. Floating-point numbers use NaN. Integers use the middle of the unused range between
    the declared largest and least value, counted across the end of the type: this is farthest from all values, also
    from one that overflowed. Equal declared values do not count, because then no writer filled them in. Undocumented
    bytes have no safe value.
    """
    if record.no_data is not None or record.code == 0:
        return record.no_data
    base = record.dtype.base
    length = max(1, record.dtype.itemsize // base.itemsize)
    if base.kind == "f":
        return np.full(length, np.nan, base)
    if record.declared_range is None:
        return None
    ranges = [(int(least), int(largest)) for least, largest in zip(*record.declared_range, strict=True)]
    if any(least >= largest for least, largest in ranges):
        return None
    count = 1 << (8 * base.itemsize)
    gaps = [count - (largest - least) for least, largest in ranges]
    if min(gaps) < 3:
        return None
    middles = [(largest + gap // 2) % count for (_, largest), gap in zip(ranges, gaps, strict=True)]
    return np.array(middles, f"<u{base.itemsize}").view(base)
