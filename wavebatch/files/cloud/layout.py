"""Layout of the points of one output cloud, and the rows that are made for it from input records and columns.

The batch plans the layout once per strip, workers make the rows of each unit, and `writer.CloudWriter` writes them.
A row depends only on its input point and echo, never on the block or unit that it is made in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.carried_bytes import Carried, plan_carried
from wavebatch.files.cloud.column_names import WrittenColumn, style_columns
from wavebatch.files.cloud.las_version import choose_version
from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.point_formats import copy_standard
from wavebatch.files.point_dtypes import field_names
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.packets import PacketPlace


@dataclass(frozen=True, slots=True, eq=False)
class OutputLayout:
    """Layout of the output points of one strip; picklable, so that workers can make rows with it."""

    source: CheckedHeader
    """Of the input; the output has its scales and offsets."""
    version: tuple[int, int]
    point_format: int
    dtype: np.dtype
    """One output record: the standard fields with laspy's names, then the extra dimensions."""
    carried: tuple[Carried, ...]
    written: tuple[WrittenColumn, ...]
    whole: bool
    """Whether all rows keep the input's extra bytes (returns), or only matched rows (echoes)."""
    packets: PacketPlace | None
    """The packets of the input, if the output keeps them."""
    wkt: str | None = None
    """WKT in place of that of the input: where this gives GeoTIFF keys only, or a WKT that GIS misunderstand."""
    notes: tuple[str, ...] = ()
    """What the user should know about the format."""

    @property
    def copied(self) -> tuple[str, ...]:
        """Extra bytes of the input that added echoes copy from the nearest return."""
        fields = self.extra_fields
        return tuple(name for name, carried in zip(fields, self.carried, strict=False) if carried.copied)

    @property
    def max_return(self) -> int:
        """Largest return number that the point format can hold; larger ones are written as this."""
        return 15 if self.point_format >= 6 else 7

    @property
    def extra_records(self) -> tuple[ExtraRecord, ...]:
        """Records of all extra dimensions of the output, in order."""
        return (*(carried.record for carried in self.carried), *(column.record for column in self.written))

    @property
    def extra_fields(self) -> tuple[str, ...]:
        """Names of the fields of `dtype` with extra dimensions, in order."""
        names = field_names(self.dtype)
        return names[len(names) - len(self.carried) - len(self.written) :]

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
        """Return output records, one per input record.

        Parameters
        ----------
        source : structured array (m,)
            Input records; never changed.
        xyz : f8 (m, 3), m
            New coordinates; NaN, or None for all rows, keeps the integers of the input exactly.
        return_number, number_of_returns : integers (m,)
            None keeps those of the input; values above `max_return` are written as `max_return`.
        columns : mapping of str to array (m,)
            Physical values by name in COLUMNS; missing columns and values that are not finite become no-data.
        matched : bool (m,)
            Rows that keep the input's extra bytes; in other rows those that can become no-data. None: all rows.
        time : float (m,), ns
            Echo times; with kept packets they become the return location of rows with a new position.

        Returns
        -------
        structured array (m,) of `dtype`

        Raises
        ------
        InputError
            If a coordinate does not fit the scale and offset of the file.
        """
        columns = columns or {}
        rows = np.zeros(len(source), self.dtype)
        copy_standard(np.ascontiguousarray(source), rows, self.source.header.point_format, self.point_format)
        if xyz is not None and len(rows):
            self._set_coordinates(rows, np.asarray(xyz, np.float64))
        self._set_returns(rows, return_number, number_of_returns)
        self._carry(rows, source, matched)
        if self.packets is not None:
            self._point_at_packets(self.packets, rows, None if xyz is None else xyz[:, 0], time)
        self.fill(rows, columns)
        for field, column in self._columns:
            if column.column not in columns:
                rows[field] = 0 if column.record.no_data is None else column.record.no_data[0]
        return rows

    def fill(self, rows: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns into rows; arguments as for `rows`."""
        for field, column in self._columns:
            if column.column in columns:
                rows[field] = column.encode(columns[column.column])

    @property
    def _columns(self) -> list[tuple[str, WrittenColumn]]:
        return list(zip(self.extra_fields[len(self.carried) :], self.written, strict=True))

    def _set_coordinates(self, rows: np.ndarray, xyz: np.ndarray) -> None:
        new = ~np.isnan(xyz).all(axis=1)
        header = self.source.header
        for axis, (name, scale, offset) in enumerate(zip("XYZ", header.scales, header.offsets, strict=True)):
            with np.errstate(all="ignore"):
                counts = np.rint((xyz[:, axis] - offset) / np.float64(scale))
            bad = new & ~(np.abs(counts) <= 2**31 - 1)
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(
                    f"{self.source.path}: {name.lower()} = {xyz[row, axis]:.3f} of output row {row} does not fit "
                    f"32-bit integers at scale {scale:g} and offset {offset:g}; rescale the strip (las2las "
                    "-rescale ... -reoffset ...) and run again"
                )
            rows[name] = np.where(new, counts, rows[name])

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
        fields: Any = {"names": list(names), "formats": formats, "offsets": places, "itemsize": source.dtype.itemsize}
        values = np.ascontiguousarray(source).view(np.dtype(fields))
        for carried, name in zip(self.carried, names, strict=True):
            rows[name] = values[name]
            empty = carried.record.no_data
            if not (self.whole or matched is None or empty is None):
                rows[name][~np.asarray(matched)] = empty if len(empty) > 1 else empty[0]

    @staticmethod
    def _point_at_packets(
        packets: PacketPlace, rows: np.ndarray, x: np.ndarray | None, time: np.ndarray | None
    ) -> None:
        if packets.shift:
            has_packet = rows["wavepacket_index"] > 0
            offset = rows["wavepacket_offset"]
            offset[has_packet] = offset[has_packet] + np.uint64(packets.shift)
        if time is not None and x is not None:
            new = np.isfinite(time) & np.isfinite(x)
            rows["return_point_wave_location"][new] = np.asarray(time)[new] * 1000.0


def plan_output(
    checked: CheckedHeader,
    columns: Sequence[str],
    *,
    point_format: int | None = None,
    las_version: str = "1.4",
    packets: StripFacts | None = None,
    names: str = "wavebatch",
    no_data: str = "-9999",
    points: str = "echoes",
    strict: bool = False,
) -> OutputLayout:
    """Return the layout of the output of a strip.

    Parameters
    ----------
    checked : CheckedHeader
        Header of the strip, or of any LAS or LAZ file.
    columns : sequence of str
        Names in COLUMNS, in the order in which they are written.
    point_format : int or None
        None: that of `las_version` with the fields of the input, without its waveform fields unless packets are kept.
    las_version : {"1.4", "1.3", "keep"}
        Of the output. "1.4" also turns point formats 0 to 5 into 6 and 7, unless packets are kept; LAS 1.5 stays 1.5.
    packets : StripFacts or None
        Facts of the strip, to keep its packets; None leaves them out.
    names : str
        Style of the column names, a key of STYLES.
    no_data : str
        What floating-point columns hold where there is no value, a key of NO_DATA.
    points : {"echoes", "returns"}
        Whether extra bytes of the input are kept in matched rows only, or in all rows.
    strict : bool
        Refuse a strip whose extra bytes cannot be marked as missing for added echoes.

    Raises
    ------
    InputError
        For a strip that cannot be written in this way.
    ConfigError
        For wrong options.
    """
    if points not in ("echoes", "returns"):
        raise ConfigError(f"points {points!r}: must be echoes or returns")
    path = checked.path
    chosen = choose_version(path, checked.header, las_version, point_format, packets is not None)
    carried = plan_carried(checked, points == "returns")
    written = style_columns(columns, names, [entry.record.name for entry in carried], no_data)
    records = [*(entry.record for entry in carried), *(entry.record for entry in written)]
    dtype = build_dtype(chosen.point_format, records)
    if dtype.itemsize > 65535:
        raise InputError(f"{path}: its extra bytes leave no room for the columns in a 65535-byte record; choose fewer")
    if packets is not None and packets.packets.file is None:
        raise InputError(f"{path}: has no packets to keep; leave --keep-packets out")
    layout = OutputLayout(
        source=checked,
        version=chosen.version,
        point_format=chosen.point_format,
        dtype=dtype,
        carried=carried,
        written=tuple(written),
        whole=points == "returns",
        packets=None if packets is None else packets.packets,
        wkt=chosen.wkt,
        notes=chosen.notes,
    )
    if strict and layout.copied:
        raise InputError(
            f"{path}: --strict: no value is free to mark added echoes in its extra bytes {', '.join(layout.copied)}; "
            "leave --strict out to give them the value of the nearest return, or write --points returns"
        )
    return layout
