"""What of the input goes to the output as it is: its extra bytes and the bytes of its packets."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wavebatch.core.errors import InputError
from wavebatch.files.las.extra_bytes import EXTRA_BYTES_RECORD_ID, ExtraRecord, choose_no_data, read_records
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    STANDARD_DTYPES,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    LasHeader,
    has_record,
)


@dataclass(frozen=True, slots=True)
class PacketSource:
    """The bytes of all packets of the input, and what takes their offsets to those of the output."""

    path: Path
    start: int
    end: int
    internal: bool
    shift: int


@dataclass(frozen=True, slots=True)
class Carried:
    """One of the input's extra dimensions on its way to the output."""

    record: ExtraRecord
    source: int
    """Byte offset in the input record; that in the output record is where the dtype says."""


def plan_carried(
    path: Path, header: LasHeader, whole: bool, ranges: Mapping[str, tuple[float, float]]
) -> tuple[tuple[Carried, ...], dict[str, str]]:
    """Input extra dimensions that are carried over, and why others are not; `whole`: every row has them."""
    at = STANDARD_DTYPES[header.point_format].itemsize
    payloads = [vlr.payload for vlr in header.vlrs if has_record([vlr], "LASF_Spec", EXTRA_BYTES_RECORD_ID)]
    records = read_records(payloads[0] if payloads else b"", header.point_length - at)
    carried, dropped = [], {}
    for record in records:
        empty = choose_no_data(record, ranges.get(record.name))
        if whole:
            carried.append(Carried(record, at))
        elif empty is None:
            dropped[record.name] = "no value is free to mark echoes that the input does not have as a return"
        else:
            carried.append(Carried(record.with_no_data(empty), at))
        at += record.dtype.itemsize
    return tuple(carried), dropped


def find_packets(facts: Any, path: Path, header: LasHeader) -> PacketSource:
    """Where the packets lie: as the reader found, or as the header says where there is only a path."""
    if getattr(facts, "packet_file", None) is not None:
        shift = max(0, EVLR_HEADER_SIZE - (facts.packet_start - facts.packet_base))
        return PacketSource(Path(facts.packet_file), facts.packet_start, facts.packet_end, facts.internal, shift)
    internal = bool(header.global_encoding & WAVES_INTERNAL) or not header.global_encoding & WAVES_EXTERNAL
    if not internal:
        for suffix in (".wdp", ".WDP"):
            beside = path.with_suffix(suffix)
            if beside.is_file():
                return PacketSource(beside, EVLR_HEADER_SIZE, os.path.getsize(beside), False, 0)
        raise InputError(f"{path}: {path.with_suffix('.wdp').name} with its packets is not beside it")
    start, size = header.waveform_start, os.path.getsize(path)
    if not 0 < start <= size - EVLR_HEADER_SIZE:
        raise InputError(f"{path}: the record of its packets would begin at byte {start} of {size}; damaged or cut")
    with open(path, "rb") as file:
        file.seek(start + 18)
        length = int.from_bytes(file.read(8), "little")
    end = min(size, start + EVLR_HEADER_SIZE + length) if length else size
    return PacketSource(path, start + EVLR_HEADER_SIZE, end, True, 0)
