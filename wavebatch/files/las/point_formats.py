"""Standard fields from one point format to another: which ways lose nothing, and how the fields change."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.las.header import STANDARD_DTYPES, LasHeader

WITHOUT_WAVES = {4: 1, 5: 3, 9: 6, 10: 8}
"""Point format of the same family without the waveform fields."""
_WAVE_FIELDS = frozenset(STANDARD_DTYPES[4].names) - frozenset(STANDARD_DTYPES[1].names)
_ANGLE_UNIT = 0.006
"""Degrees per count of `scan_angle` in formats 6-10; `scan_angle_rank` of formats 0-5 counts whole degrees."""
_OVERLAP_CLASS = 12


def choose_format(path: Path, header: LasHeader, wanted: int | None, keep: bool) -> int:
    """The point format of the output: its own family, or the `wanted` one if that loses nothing but waveforms."""
    own = header.point_format
    if own not in STANDARD_DTYPES:
        raise InputError(f"{path}: point format {own} is not known; formats 0 to 10 can be written")
    if header.point_length < STANDARD_DTYPES[own].itemsize:
        raise InputError(f"{path}: {header.point_length}-byte records are too short for point format {own}; damaged")
    if keep and own not in WITHOUT_WAVES:
        raise ConfigError(f"{path}: point format {own} has no waveforms; leave --keep-packets out")
    if wanted is None:
        return own if keep else WITHOUT_WAVES.get(own, own)
    legal = [number for number in STANDARD_DTYPES if _can_hold(own, number) and (number in WITHOUT_WAVES) == keep]
    if wanted not in legal:
        raise ConfigError(
            f"{path}: point format {own} cannot be written as {wanted}{' with its packets' if keep else ''} without "
            f"loss; possible are {', '.join(map(str, legal))}"
        )
    return wanted


def _can_hold(old: int, new: int) -> bool:
    """Whether format `new` has a place for all that `old` has, waveforms aside; never back to formats 0-5."""
    if old >= 6 > new:
        return False
    have = set(STANDARD_DTYPES[old].names) - _WAVE_FIELDS
    if new >= 6:
        have -= {"raw_classification", "scan_angle_rank"}
    return have <= set(STANDARD_DTYPES[new].names)


def copy_standard(source: np.ndarray, rows: np.ndarray, old: int, new: int) -> None:
    """Copies the standard fields; formats of one family begin with the same bytes, which go over in one piece."""
    base_old, base_new = WITHOUT_WAVES.get(old, old), WITHOUT_WAVES.get(new, new)
    if base_old == base_new:
        wave = old in WITHOUT_WAVES and new in WITHOUT_WAVES
        size = STANDARD_DTYPES[new if wave else base_new].itemsize
        piece = {"names": ["record"], "formats": [f"V{size}"], "offsets": [0]}
        target = rows.view(np.dtype({**piece, "itemsize": rows.dtype.itemsize}))
        target["record"] = source.view(np.dtype({**piece, "itemsize": source.dtype.itemsize}))["record"]
        return
    for name in STANDARD_DTYPES[new].names:
        if name in STANDARD_DTYPES[old].names:
            rows[name] = source[name]
    if old < 6 <= new:
        _promote_bits(source, rows)


def _promote_bits(source: np.ndarray, rows: np.ndarray) -> None:
    """Flags, class, returns and angle of formats 0-5 in the fields of formats 6-10; class 12 also sets overlap."""
    bits, flags = source["bit_fields"], source["raw_classification"]
    kind = flags & 0b11111
    rows["bit_fields"] = (bits & 0b111) | ((bits & 0b111000) << 1)
    rows["classification"] = kind
    rows["classification_flags"] = (
        (flags >> 5) | ((kind == _OVERLAP_CLASS).astype(np.uint8) << np.uint8(3)) | (bits & 0b11000000)
    )
    rows["scan_angle"] = np.rint(source["scan_angle_rank"] / _ANGLE_UNIT).astype(np.int16)
