"""Which packets of points can be used, by kernels/c/packets.h; `files/strip/packet_check.py` calls it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.library import CJudged, CPoints, CRules, call, place

FIELDS = {"index": "u1", "offset": "<u8", "size": "<u4", "location": "<f4", "x": "<f4", "y": "<f4", "z": "<f4"}


class PacketRules(NamedTuple):
    """What a strip allows; arrays (256,) by descriptor."""

    known: np.ndarray
    """bool: whether the header has the descriptor."""
    good: np.ndarray
    """bool: whether it can be read."""
    odd: np.ndarray
    """bool: samples do not fill whole bytes."""
    packs: np.ndarray
    """bool: packets are compressed."""
    width: np.ndarray
    """int64: bytes of a sample, at least 1."""
    samples: np.ndarray
    """int64: of a packet."""
    packed: np.ndarray
    """int64: bytes of a packet whose samples follow each other without a gap; -1 for none."""
    least: int
    """First byte of the waveform data."""
    end: int
    """Byte behind its last."""


class Geometry(NamedTuple):
    """Which vectors and locations are possible."""

    is_range: bool
    """Vectors are whole paths: their length over that of the location counts."""
    unit: float
    """Factor on the length of a vector."""
    longest: float
    furthest: float
    """Location [as stored]."""


def judge_packets(fields: dict[str, np.ndarray], rules: PacketRules, geometry: Geometry) -> tuple[np.ndarray, ...]:
    """Check the packets of n points.

    Parameters
    ----------
    fields : dict of array (n,)
        Fields of one array of records, of the types of FIELDS.
    rules : PacketRules
    geometry : Geometry

    Returns
    -------
    reason : uint8 (n,)
        See `packet_check.Reason`; never OVERFULL or DAMAGED, which need more than the record.
    n_samples : int32 (n,)
        0 where the packet cannot be used.
    keys : uint64 (n,)
        Offset and index in one number.
    short, packed : bool (n,)
        Fewer samples than the descriptor has, of packets that can be used; samples without a gap.

    Raises
    ------
    ValueError
        For other types and shapes: C code would read outside of the arrays.
    """
    index = fields["index"]
    n, stride = len(index), index.strides[0]
    for name, kind in FIELDS.items():
        field = fields[name]
        if field.dtype != np.dtype(kind) or field.shape != (n,) or field.strides != (stride,):
            raise ValueError(f"field {name} must be of type {kind}, of the same records as the others")
    tables = [place(table, np.bool_) for table in rules[:4]] + [place(table, np.int64) for table in rules[4:7]]
    if any(len(table) != 256 for table in rules[:7]) or (rules.width < 1).any():
        raise ValueError("rules must have 256 rows, and samples of at least 1 byte")
    kinds = (np.uint8, np.int32, np.uint64, np.bool_, np.bool_)
    out = tuple(np.empty(n, kind) for kind in kinds)
    points = CPoints(n, stride, *(fields[name].ctypes.data for name in FIELDS))
    call("judge_packets", points, CRules(*tables, rules.least, rules.end, *geometry),
         CJudged(*(column.ctypes.data for column in out)))  # fmt: skip
    return out
