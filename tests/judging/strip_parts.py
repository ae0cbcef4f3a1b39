"""A part of a strip as a file, so that any version of wavebatch surveys it alone; and a checkout without a sensor."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np

COUNT, WAVES, EVLR, LONG_COUNT = 107, 227, 235, 247
"""Places in the header: of the number of points, the packets, the first extended record, and the number in LAS 1.4."""


def list_packets(path: Path) -> np.ndarray:
    """Rank of each point's packet in the order of the file: points of one packet share it."""
    _, records, where = _read(path)
    keys = records[:, where : where + 9].copy().view("S9")[:, 0]  # descriptor and offset
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    rank = np.empty(len(first), int)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def write_part(path: Path, keep: np.ndarray, target: Path) -> Path:
    """The points of a strip where `keep` (one per point) holds, with all packets."""
    data, records, _ = _read(path)
    begin, length = struct.unpack_from("<I", data, 96)[0], records.shape[1]
    head, rest = bytearray(data[:begin]), data[begin + records.size :]
    number, gone = int(keep.sum()), int((~keep).sum()) * length
    if head[25] == 3 or struct.unpack_from("<I", head, COUNT)[0]:
        struct.pack_into("<I", head, COUNT, number)
        struct.pack_into("<5I", head, COUNT + 4, *(0,) * 5)
    places = [(WAVES, "<Q")]
    if head[25] >= 4:
        struct.pack_into("<Q", head, LONG_COUNT, number)
        struct.pack_into("<15Q", head, LONG_COUNT + 8, *(0,) * 15)
        places.append((EVLR, "<Q"))
    for place, kind in places:
        at = struct.unpack_from(kind, head, place)[0]
        if at >= begin + records.size:
            struct.pack_into(kind, head, place, at - gone)
    target.write_bytes(bytes(head) + records[keep].tobytes() + rest)
    packets = path.with_suffix(".wdp")
    if packets.exists():
        shutil.copyfile(packets, target.with_suffix(".wdp"))
    return target


def _read(path: Path) -> tuple[bytes, np.ndarray, int]:
    """All bytes, the point records (n, length), and where a record has its descriptor."""
    data = path.read_bytes()
    begin, _, kind, length, number = struct.unpack_from("<IIBHI", data, 96)
    if data[25] >= 4:
        number = struct.unpack_from("<Q", data, LONG_COUNT)[0]
    where = {4: 28, 5: 34, 9: 30, 10: 38}[kind & 0x3F]
    return data, np.frombuffer(data, np.uint8, number * length, begin).reshape(number, length), where


def without_sensor(root: Path, name: str, target: Path) -> Path:
    """A copy of a checkout's package that lacks a shipped sensor: what surveys do on a strip that they do not know."""
    shutil.copytree(root / "wavebatch", target / "wavebatch", ignore=shutil.ignore_patterns(f"{name}.*", "__pycache__"))
    return target
