"""How the points of one output file look, and the rows made for it from input records and columns."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.errors import ConfigError, InputError
from wavebatch.io.extra import EXTRA_BYTES_RECORD_ID, ExtraRecord, choose_no_data, read_records
from wavebatch.io.header import (
    EVLR_HEADER_SIZE,
    STANDARD_DTYPES,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    LasHeader,
    find_evlrs,
    has_record,
    read_header,
)
from wavebatch.io.names import WrittenColumn, name_columns

WITHOUT_WAVES = {4: 1, 5: 3, 9: 6, 10: 8}
"""Point format of the same family without the waveform fields."""
_WAVE_FIELDS = frozenset(STANDARD_DTYPES[4].names) - frozenset(STANDARD_DTYPES[1].names)
_RANK_TO_ANGLE = 1.0 / 0.006
_OVERLAP_CLASS = 12


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


@dataclass(frozen=True, slots=True, eq=False)
class OutputLayout:
    """How one strip's output points look; picklable, so that workers can build rows with it."""

    source: Path
    version: tuple[int, int]
    point_format: int
    source_format: int
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    dtype: np.dtype
    """One output record: the standard fields under laspy's names, then `extra_records` under theirs."""
    carried: tuple[Carried, ...]
    written: tuple[WrittenColumn, ...]
    whole: bool
    """Whether every row keeps its input extra bytes (returns), or only matched ones (echoes)."""
    packets: PacketSource | None
    dropped: Mapping[str, str]
    """Extra bytes of the input that are not carried, and why."""
    renamed: Mapping[str, str]
    """Our columns whose name in the file differs from their name in COLUMNS."""

    @property
    def max_return(self) -> int:
        """Largest return number that the point format holds; larger ones are written as this."""
        return 15 if self.point_format >= 6 else 7

    @property
    def extra_records(self) -> tuple[ExtraRecord, ...]:
        """Records of all extra bytes of the output, in their order."""
        return (*(carried.record for carried in self.carried), *(column.record for column in self.written))

    def rows(
        self,
        source: np.ndarray,
        *,
        xyz: np.ndarray | None = None,
        return_number: np.ndarray | None = None,
        number_of_returns: np.ndarray | None = None,
        columns: Mapping[str, np.ndarray] | None = None,
        matched: np.ndarray | None = None,
        time: np.ndarray | None = None,
    ) -> np.ndarray:
        """Output records (m,) of `dtype`, one per input record of `source` (m,).

        xyz: coordinates [m], f8 (m, 3); rows of NaN, or None for all, keep the input's integers exactly.
        return_number, number_of_returns: (m,), None keeps the input's; values beyond `max_return` are cut to it.
        columns: physical values (m,) by name in COLUMNS; what is not finite or not given becomes no-data.
        matched: bool (m,), None for all; the input's extra bytes of other rows become their no-data (echoes only).
        time: echo times [ns], (m,); with kept packets they become the return location of rows with a new position.
        Raises InputError where a coordinate does not fit the file's scale and offset.
        """
        columns = columns or {}
        rows = np.zeros(len(source), self.dtype)
        _copy_standard(np.ascontiguousarray(source), rows, self.source_format, self.point_format)
        if xyz is not None and len(rows):
            self._set_coordinates(rows, np.asarray(xyz, np.float64))
        self._set_returns(rows, return_number, number_of_returns)
        self._carry(rows, source, matched)
        if self.packets is not None:
            times = columns.get("echo_time") if time is None else time
            self._point_at_packets(rows, None if xyz is None else xyz[:, 0], times)
        for column in self.written:
            values = columns.get(column.column)
            if values is None:
                empty = column.record.no_data
                rows[column.record.name] = 0 if empty is None else empty[0]
            else:
                rows[column.record.name] = column.encode(values)
        return rows

    def _set_coordinates(self, rows: np.ndarray, xyz: np.ndarray) -> None:
        new = ~np.isnan(xyz).all(axis=1)
        for axis, name in enumerate("XYZ"):
            counts = np.rint((xyz[:, axis] - self.offsets[axis]) / self.scales[axis])
            bad = new & ~(np.abs(counts) <= 2**31 - 1)
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(
                    f"{self.source}: {name.lower()} = {xyz[row, axis]:.3f} of output row {row} does not fit 32-bit "
                    f"integers at scale {self.scales[axis]:g} and offset {self.offsets[axis]:g}; rescale the strip "
                    "(las2las -rescale ... -reoffset ...) and run again"
                )
            if new.all():
                rows[name] = counts.astype(np.int32)
            else:
                rows[name][new] = counts[new].astype(np.int32)

    def _set_returns(self, rows: np.ndarray, number: np.ndarray | None, count: np.ndarray | None) -> None:
        bits = 4 if self.point_format >= 6 else 3
        limit = self.max_return
        for shift, values in ((0, number), (bits, count)):
            if values is not None:
                cut = np.minimum(values, limit).astype(np.uint8)
                rows["bit_fields"] = (rows["bit_fields"] & np.uint8(255 ^ (limit << shift))) | (cut << np.uint8(shift))

    def _carry(self, rows: np.ndarray, source: np.ndarray, matched: np.ndarray | None) -> None:
        if not self.carried:
            return
        names = [carried.record.name for carried in self.carried]
        formats = [carried.record.dtype for carried in self.carried]
        places = [carried.source for carried in self.carried]
        view = np.dtype({"names": names, "formats": formats, "offsets": places, "itemsize": source.dtype.itemsize})
        values = np.ascontiguousarray(source).view(view)
        for carried, name in zip(self.carried, names, strict=True):
            rows[name] = values[name]
            if not (self.whole or matched is None):
                empty = carried.record.no_data
                rows[name][~matched] = empty if len(empty) > 1 else empty[0]

    def _point_at_packets(self, rows: np.ndarray, x: np.ndarray | None, time: np.ndarray | None) -> None:
        if self.packets.shift:
            has_packet = rows["wavepacket_index"] > 0
            rows["wavepacket_offset"][has_packet] += np.uint64(self.packets.shift)
        if time is not None and x is not None:
            new = np.isfinite(time) & np.isfinite(x)
            rows["return_point_wave_location"][new] = np.asarray(time)[new] * 1000.0


def _copy_standard(source: np.ndarray, rows: np.ndarray, old: int, new: int) -> None:
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
    rows["scan_angle"] = np.rint(source["scan_angle_rank"] * _RANK_TO_ANGLE).astype(np.int16)


def plan_output(
    path_or_facts: Any,
    columns: Sequence[str],
    *,
    point_format: int | None = None,
    keep_packets: bool = False,
    names: str = "wavebatch",
    points: str = "echoes",
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> OutputLayout:
    """How the output of a strip looks; only the strip's header is read.

    path_or_facts: path of the strip, or what the reader says of it (StripFacts).
    columns: names in COLUMNS, in the order in which they are written.
    point_format: None keeps the input's family without waveforms (with them, under keep_packets).
    points: "echoes" carries the input's extra bytes on matched rows only, "returns" on all of them.
    ranges: true least and largest stored value of input extra bytes by name, where somebody has measured them: integers
    that declare no no-data value get one outside; without them one outside the range that their record declares.
    Raises InputError for a strip that cannot be written this way, ConfigError for wrong options.
    """
    if points not in ("echoes", "returns"):
        raise ConfigError(f"points {points!r}: must be echoes or returns")
    path = Path(getattr(path_or_facts, "path", path_or_facts))
    header = read_header(path)
    target = _choose_format(path, header, point_format, keep_packets)
    version = header.version if target < 6 else max(header.version, (1, 4))
    _check_crs(path, header, target)
    carried, dropped = _plan_carried(path, header, points == "returns", ranges or {})
    written = name_columns(columns, names, [entry.record.name for entry in carried])
    return OutputLayout(
        source=path,
        version=version,
        point_format=target,
        source_format=header.point_format,
        scales=header.scales,
        offsets=header.offsets,
        dtype=_build_dtype(path, target, [*carried, *written]),
        carried=carried,
        written=tuple(written),
        whole=points == "returns",
        packets=_find_packets(path_or_facts, path, header) if keep_packets else None,
        dropped=dropped,
        renamed={entry.column: entry.record.name for entry in written if entry.record.name != entry.column},
    )


def _choose_format(path: Path, header: LasHeader, wanted: int | None, keep: bool) -> int:
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


def _check_crs(path: Path, header: LasHeader, target: int) -> None:
    if not header.point_format < 6 <= target or not has_record(header.vlrs, "LASF_Projection", 34735):
        return
    evlrs, _ = find_evlrs(path, header)
    if not has_record([*header.vlrs, *evlrs], "LASF_Projection", 2112):
        raise InputError(
            f"{path}: its CRS is given by GeoTIFF keys only, point format {target} needs WKT, and wavebatch does not "
            "convert them; keep the point format's family, or add a WKT record to the strip first"
        )


def _plan_carried(
    path: Path, header: LasHeader, whole: bool, ranges: Mapping[str, tuple[float, float]]
) -> tuple[tuple[Carried, ...], dict[str, str]]:
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


def _build_dtype(path: Path, target: int, extra: Sequence[Carried | WrittenColumn]) -> np.dtype:
    standard = STANDARD_DTYPES[target]
    fields = [(name, standard[name]) for name in standard.names]
    fields += [(entry.record.name, entry.record.dtype) for entry in extra]
    names = [name for name, _ in fields]
    for name in names:
        if not name or names.count(name) > 1:
            raise InputError(f"{path}: two extra bytes are named {name!r}, or a standard field is; rename one of them")
    dtype = np.dtype(fields)
    if dtype.itemsize > 65535:
        raise InputError(f"{path}: its extra bytes leave no room for the columns in a 65535-byte record; choose fewer")
    return dtype


def _find_packets(facts: Any, path: Path, header: LasHeader) -> PacketSource:
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
