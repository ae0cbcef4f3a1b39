"""How the points of one output file look, and the rows made for it from input records and columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.carried_bytes import Carried, PacketSource, find_packets, plan_carried
from wavebatch.files.cloud.column_names import Naming, WrittenColumn, describe, name_columns
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.header import GEOTIFF_ID, PROJECTION, WKT_ID, LasHeader, find_evlrs, has_record, read_header
from wavebatch.files.las.point_formats import choose_format, copy_standard


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

    @property
    def extra_fields(self) -> tuple[str, ...]:
        """Names of the fields of `dtype` that hold the extra bytes, in their order."""
        return self.dtype.names[len(self.dtype.names) - len(self.carried) - len(self.written) :]

    def extended(self, columns: Sequence[str]) -> OutputLayout:
        """The layout with columns that never leave the program behind: for rows that are still on their way."""
        more = []
        for name in columns:
            column = COLUMNS[name]
            more.append(WrittenColumn(name, ExtraRecord.build(name, column.dtype, describe(column)), Naming(name)))
        dtype = build_dtype(self.point_format, [*self.extra_records, *(column.record for column in more)])
        return replace(self, dtype=dtype, written=(*self.written, *more))

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
        copy_standard(np.ascontiguousarray(source), rows, self.source_format, self.point_format)
        if xyz is not None and len(rows):
            self._set_coordinates(rows, np.asarray(xyz, np.float64))
        self._set_returns(rows, return_number, number_of_returns)
        self._carry(rows, source, matched)
        if self.packets is not None:
            times = columns.get("echo_time") if time is None else time
            self._point_at_packets(rows, None if xyz is None else xyz[:, 0], times)
        for field, column in zip(self.extra_fields[len(self.carried) :], self.written, strict=True):
            values = columns.get(column.column)
            if values is None:
                empty = column.record.no_data
                rows[field] = 0 if empty is None else empty[0]
            else:
                rows[field] = column.encode(values)
        return rows

    def _set_coordinates(self, rows: np.ndarray, xyz: np.ndarray) -> None:
        new = ~np.isnan(xyz).all(axis=1)
        for axis, name in enumerate("XYZ"):
            with np.errstate(all="ignore"):
                counts = np.rint((xyz[:, axis] - self.offsets[axis]) / np.float64(self.scales[axis]))
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
        names = self.extra_fields[: len(self.carried)]
        formats = [carried.record.dtype for carried in self.carried]
        places = [carried.source for carried in self.carried]
        fields = {"names": list(names), "formats": formats, "offsets": places, "itemsize": source.dtype.itemsize}
        values = np.ascontiguousarray(source).view(np.dtype(fields))
        for carried, name in zip(self.carried, names, strict=True):
            rows[name] = values[name]
            if not (self.whole or matched is None):
                empty = carried.record.no_data
                rows[name][~np.asarray(matched)] = empty if len(empty) > 1 else empty[0]

    def _point_at_packets(self, rows: np.ndarray, x: np.ndarray | None, time: np.ndarray | None) -> None:
        if self.packets.shift:
            has_packet = rows["wavepacket_index"] > 0
            rows["wavepacket_offset"][has_packet] += np.uint64(self.packets.shift)
        if time is not None and x is not None:
            new = np.isfinite(time) & np.isfinite(x)
            rows["return_point_wave_location"][new] = np.asarray(time)[new] * 1000.0


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

    path_or_facts: path of the strip, or the reader's StripFacts of it.
    columns: names in COLUMNS, in the order in which they are written.
    point_format: None keeps the input's family without waveforms (with them, under keep_packets).
    points: "echoes" carries the input's extra bytes on matched rows only, "returns" on all of them.
    ranges: true least and largest stored value of input extra bytes by name, where measured; see `choose_no_data`.
    Raises InputError for a strip that cannot be written this way, ConfigError for wrong options.
    """
    if points not in ("echoes", "returns"):
        raise ConfigError(f"points {points!r}: must be echoes or returns")
    path = Path(getattr(path_or_facts, "path", path_or_facts))
    header = read_header(path)
    target = choose_format(path, header, point_format, keep_packets)
    _check_crs(path, header, target)
    carried, dropped = plan_carried(path, header, points == "returns", ranges or {})
    written = name_columns(columns, names, [entry.record.name for entry in carried])
    return OutputLayout(
        source=path,
        version=header.version if target < 6 else max(header.version, (1, 4)),
        point_format=target,
        source_format=header.point_format,
        scales=header.scales,
        offsets=header.offsets,
        dtype=_build_dtype(path, target, [*carried, *written]),
        carried=carried,
        written=tuple(written),
        whole=points == "returns",
        packets=find_packets(path_or_facts, path, header) if keep_packets else None,
        dropped=dropped,
        renamed={entry.column: entry.record.name for entry in written if entry.record.name != entry.column},
    )


def _check_crs(path: Path, header: LasHeader, target: int) -> None:
    if not header.point_format < 6 <= target or not has_record(header.vlrs, PROJECTION, GEOTIFF_ID):
        return
    evlrs, _ = find_evlrs(path, header)
    if not has_record([*header.vlrs, *evlrs], PROJECTION, WKT_ID):
        raise InputError(
            f"{path}: its CRS is given by GeoTIFF keys only, point format {target} needs WKT, and wavebatch does not "
            "convert them; keep the point format's family, or add a WKT record to the strip first"
        )


def _build_dtype(path: Path, target: int, extra: Sequence[Carried | WrittenColumn]) -> np.dtype:
    dtype = build_dtype(target, [entry.record for entry in extra])
    if dtype.itemsize > 65535:
        raise InputError(f"{path}: its extra bytes leave no room for the columns in a 65535-byte record; choose fewer")
    return dtype
