"""Extra bytes: the 192-byte records that describe them, and the dtype of points with extra bytes.

All readers and writers of points use this module. A record keeps its bytes as they are in the file; an unknown or
wrong description must never make a file unreadable, so its bytes become a column of unknown content.
"""

from __future__ import annotations

import struct
from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.las.header import STANDARD_DTYPES, field_names

RECORD_SIZE = 192
EXTRA_BYTES_RECORD_ID = 4
_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
_NO_DATA, _MIN, _MAX, _SCALE, _OFFSET = 1, 2, 4, 8, 16
TEXT_BYTES = 32
"""Length of name and description in a record."""

_LARGEST = 1e30
"""Larger values are damage and become no data: their squares would overflow in single precision."""

_AT_NAME, _AT_NO_DATA, _AT_MIN, _AT_MAX, _AT_SCALE, _AT_DESCRIPTION = 4, 40, 64, 88, 112, 160


@dataclass(frozen=True, slots=True)
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
    def is_known(self) -> bool:
        """Whether the size of the dimension is known."""
        return self.code <= 30 and self.dtype.itemsize > 0

    @property
    def dtype(self) -> np.dtype:
        """Stored type, with the shape (k,) of the deprecated vectors and of undocumented bytes."""
        if self.code == 0:
            return np.dtype(("u1", (self.data[3],))) if self.data[3] != 1 else np.dtype("u1")
        kind, length = _TYPES[(self.code - 1) % 10], (self.code - 1) // 10 + 1
        return np.dtype(f"<{kind}") if length == 1 else np.dtype((f"<{kind}", (length,)))

    @property
    def _container(self) -> np.dtype:
        """Type of the 8-byte numbers that hold the no-data, least and largest value."""
        return np.dtype(f"<{self.dtype.base.kind}8")

    def _numbers(self, at: int, option: int) -> np.ndarray | None:
        if self.code == 0 or not self.data[3] & option:
            return None
        dtype = self.dtype
        numbers = np.frombuffer(self.data, self._container, max(1, dtype.itemsize // dtype.base.itemsize), at)
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
            packed = np.asarray(numbers).astype(self._container).tobytes()
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
            try:
                text.decode()
            except UnicodeDecodeError:
                data[at : at + TEXT_BYTES] = _as_field(text.decode("latin-1"))
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
        if not record.is_known or record.dtype.itemsize > left:
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


def tell_apart(records: Sequence[ExtraRecord], point_format: int) -> list[ExtraRecord]:
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
        found = (name if most is None else _cut(name, most - len(end))) + end
    return found


def _cut(text: str, most: int) -> str:
    """As much of the text as so many bytes of UTF-8 hold."""
    return text.encode()[:most].decode(errors="ignore")


def _as_field(text: str) -> bytes:
    """The text as a record holds it."""
    return _cut(text, TEXT_BYTES).encode().ljust(TEXT_BYTES, b"\0")


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
