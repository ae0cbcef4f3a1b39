"""Conversion of the standard fields between point formats: which conversions lose nothing, and how fields change.

The output layout of a cloud uses it. A conversion is allowed only if it loses nothing except the waveform fields.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.las.header import STANDARD_DTYPES, LasHeader, field_names

WITHOUT_WAVES = {4: 1, 5: 3, 9: 6, 10: 8}
"""For each waveform format the format with the same fields except the waveform fields."""
MODERN = {0: 6, 1: 6, 2: 7, 3: 7}
"""For each format of LAS 1.0 to 1.3 the one of LAS 1.4 that holds its fields; those without GPS time get zero."""
_WAVE_FIELDS = frozenset(field_names(STANDARD_DTYPES[4])) - frozenset(field_names(STANDARD_DTYPES[1]))
ANGLE_UNIT = 0.006
"""Degrees per count of `scan_angle` in formats 6-10; `scan_angle_rank` of formats 0-5 counts whole degrees."""
_OVERLAP_CLASS = 12

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


def choose_format(path: Path, header: LasHeader, wanted: int | None, keep: bool) -> int:
    """Return the point format of the output: that of the input without waveforms, or the `wanted` one.

    keep: the output keeps the waveform fields. Raises ConfigError if the wanted format would lose anything else.
    """
    given = header.point_format
    if wanted is None:
        return given if keep else WITHOUT_WAVES.get(given, given)
    legal = [number for number in STANDARD_DTYPES if _can_hold(given, number) and (number in WITHOUT_WAVES) == keep]
    if wanted not in legal:
        raise ConfigError(
            f"{path}: point format {given} cannot be written as {wanted}{' with its packets' if keep else ''} without "
            f"loss; possible are {', '.join(map(str, legal))}"
        )
    return wanted


def _can_hold(old: int, new: int) -> bool:
    """Whether format `new` has all fields of `old` except the waveform fields; never from 6-10 back to 0-5."""
    if old >= 6 > new:
        return False
    have = set(field_names(STANDARD_DTYPES[old])) - _WAVE_FIELDS
    if new >= 6:
        have -= {"raw_classification", "scan_angle_rank"}
    return have <= set(field_names(STANDARD_DTYPES[new]))


def _whole(size: int, length: int) -> np.dtype:
    """The first bytes of records of some length, as one field."""
    record: Any = {"names": ["record"], "formats": [f"V{size}"], "offsets": [0], "itemsize": length}
    return np.dtype(record)


def copy_standard(source: np.ndarray, rows: np.ndarray, old: int, new: int) -> None:
    """Copy the standard fields of records (n,) from format `old` to format `new`.

    Formats of one family begin with the same bytes: these are copied in one piece, which is several times faster.
    """
    base_old, base_new = WITHOUT_WAVES.get(old, old), WITHOUT_WAVES.get(new, new)
    if base_old == base_new:
        wave = old in WITHOUT_WAVES and new in WITHOUT_WAVES
        size = STANDARD_DTYPES[new if wave else base_new].itemsize
        target, given = (records.view(_whole(size, records.dtype.itemsize)) for records in (rows, source))
        target["record"] = given["record"]
        return
    for name in field_names(STANDARD_DTYPES[new]):
        if name in field_names(STANDARD_DTYPES[old]):
            rows[name] = source[name]
    if old < 6 <= new:
        _promote_bits(source, rows)


def _promote_bits(source: np.ndarray, rows: np.ndarray) -> None:
    """Writes flags, class, returns and angle of formats 0-5 into formats 6-10; class 12 also sets the overlap bit."""
    bits, flags = source["bit_fields"], source["raw_classification"]
    kind = flags & 0b11111
    rows["bit_fields"] = (bits & 0b111) | ((bits & 0b111000) << 1)
    rows["classification"] = kind
    rows["classification_flags"] = (
        (flags >> 5) | ((kind == _OVERLAP_CLASS).astype(np.uint8) << np.uint8(3)) | (bits & 0b11000000)
    )
    rows["scan_angle"] = np.rint(source["scan_angle_rank"] / ANGLE_UNIT).astype(np.int16)
