"""Packets of points: which can be used (kernels/c/packets.h), and how compressed ones are decoded (kernels/c/wdz.h).

`files/strip/packet_check.py` and `files/strip/packets.py` call it. Compressed packets are those of LAStools (.wdz).
"""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.kernels.library import CJudged, CPoints, CRules, address, call, place

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
    points = CPoints(n, stride, *(address(fields[name]) for name in FIELDS))
    call("judge_packets", points, CRules(*tables, rules.least, rules.end, *geometry),
         CJudged(*map(address, out)))  # fmt: skip
    return out


MOST_BYTES = 5
"""Most bytes that a sample takes: 15 bits for its length, 15 coded and 8 plain ones, and carries."""


def decode_packets(
    data: np.ndarray, start: np.ndarray, end: np.ndarray, n_samples: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Decode packets of one number of samples.

    Parameters
    ----------
    data : uint8 (m,)
        Bytes that hold the packets.
    start, end : int64 (n,)
        First byte of each packet, and the one behind its last.
    n_samples : int
        Of each packet.
    width : int
        Bytes of a sample: 1 or 2.

    Returns
    -------
    samples : uint8 or uint16 (n, n_samples)
        Zeros where a packet is broken.
    good : bool (n,)
        Whether a packet is whole.

    Raises
    ------
    ValueError
        For places outside of the bytes, and other widths: C code would read there.
    """
    start, end = (np.ascontiguousarray(places, np.int64) for places in (start, end))
    inside = (start >= 0) & (start <= end) & (end <= len(data))
    if width not in (1, 2) or n_samples < 1 or len(start) != len(end) or not inside.all():
        raise ValueError("packets must lie inside the bytes and have samples of 1 or 2 bytes")
    samples, good = np.empty((len(start), n_samples), f"<u{width}"), np.zeros(len(start), np.uint8)
    n, s, w = (ctypes.c_int64(number) for number in (len(start), n_samples, width))
    call("decode_packets", np.ascontiguousarray(data, np.uint8), n, start, end, s, w, samples, good)
    return samples, good.astype(bool)
