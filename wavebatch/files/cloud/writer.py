"""Writer of output clouds: layout and rows of the points, the records of the input, and the cloud's provenance.

The batch opens one `CloudWriter` per strip. Equal input and options must give equal bytes: write no time of day, no
path and nothing that depends on the number of processes into the file.

The batch plans the layout once per strip, workers make the rows of each unit, and `CloudWriter` writes them. A row
depends only on its input point and echo, never on the block or unit that it is made in.

`choose_version` gives the LAS version, point format and CRS record. PDAL, and all that reads with it, sees extra bytes
only in LAS 1.4, and writers of COPC take only point formats 6 to 8: that is what a cloud gets, whatever the strip is.

Extra bytes of a strip are copied unchanged, every dimension. An added echo has none in the input: it gets the "no data"
value of a dimension, or, where no value is free for that, the value of the nearest return of its packet, as the
standard fields do. Before you change it: a dimension must never be dropped, vendors have no other place for their data.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.files.cloud.column_names import USER_ID, WrittenColumn, style_columns
from wavebatch.files.disk.publish import Draft, protecting, reporting
from wavebatch.files.las import header as las
from wavebatch.files.las.crs import convert_geotiff, repair_evlr, repair_records
from wavebatch.files.las.read_points import CheckedHeader
from wavebatch.files.las.write_points import PointFile, copy_bytes, waveform_head
from wavebatch.files.strip.packets import PacketPlace, StripFacts


@frozen(eq=False)
class Version:
    """What `choose_version` chose."""

    version: tuple[int, int]
    point_format: int
    wkt: str | None
    """WKT in place of that of the input: where this gives GeoTIFF keys only, or a WKT that GIS misunderstand."""
    notes: tuple[str, ...]
    """What the user should know about the format."""


def choose_version(path: Path, header: las.LasHeader, wanted: str, point_format: int | None, keep: bool) -> Version:
    """Return version and point format of the cloud of a strip.

    wanted: as --las-version. point_format: that which the user wants, or None. keep: packets are kept, and with them
    the format's waveform fields. Raises ConfigError for options that contradict each other, InputError for a strip that
    cannot be written in this way.
    """
    target = las.choose_format(path, header, point_format, keep)
    evlrs, _ = las.find_evlrs(path, header)
    pairs = zip(header.vlrs, repair_records(header.vlrs), strict=True)
    repaired = next((new.payload.rstrip(b"\0").decode() for old, new in pairs if new is not old), None)
    # CloudWriter repairs extended records as it copies them; the note is about these too.
    wrong = repaired is not None or any(repair_evlr(path, evlr) is not None for evlr in evlrs)
    notes = (_REPAIRED,) * wrong
    if wanted == "1.3":  # if it can hold all that the strip has
        if target >= 6:
            clash = "has no point format" if point_format is None else "contradicts --point-format"
            what = "leave one of the two out"
            if header.point_format >= 6:
                what = f"leave --las-version out: points of format {header.point_format} fit into formats 6 to 10 only"
            raise ConfigError(f"{path}: --las-version 1.3 {clash} {target}: its last format is 5; {what}")
        if any(evlr.record_id != las.WAVEFORM_RECORD_ID for evlr in evlrs):
            raise InputError(f"{path}: has extended records, which LAS 1.3 cannot hold; leave --las-version out")
        if _has_crs(header.vlrs) == (True, False):
            raise InputError(f"{path}: its CRS is given as WKT, which LAS 1.3 does not have; leave --las-version out")
        return Version((1, 3), target, repaired, notes)
    records: list[Any] = [*header.vlrs, *evlrs]
    only_keys = _has_crs(records) == (False, True)
    if wanted == "1.4" and point_format is None and not keep:
        modern = las.MODERN.get(target, target)
        wkt = convert_geotiff(path, header.vlrs, asked=False) if only_keys else None
        if only_keys and wkt is None:
            why = "its CRS is given by GeoTIFF keys that wavebatch cannot turn into WKT, "
            why += "which point formats 6 to 10 need"
            note = f"{why}: PDAL will not read the cloud unless readers.las gets nosrs=true; "
            note += "add a WKT record to the strip"
            if target < 6:
                note = f"written in point format {target} of LAS 1.4 in place of {modern}: {why}; "
                note += f"to try that format, give --point-format {modern}"
            return Version(max(header.version, (1, 4)), target, None, (note, *notes))
        return Version(max(header.version, (1, 4)), modern, wkt or repaired, notes)
    wkt = repaired
    if only_keys and target >= 6:
        wkt = convert_geotiff(path, header.vlrs, asked=header.point_format < 6)
    oldest = (1, 4) if wanted == "1.4" or target >= 6 else header.version
    return Version(max(header.version, oldest), target, wkt, notes)


_REPAIRED = (
    "the strip's WKT says metres where it means degrees, as RiPROCESS writes it: GIS programs show the strip "
    "in a wrong place; the cloud's WKT is right"
)


def _has_crs(records: Sequence[Any]) -> tuple[bool, bool]:
    """Whether records, extended or not, have the CRS as WKT, and as GeoTIFF keys."""
    has = (las.has_record(records, las.PROJECTION, number) for number in (las.WKT_ID, las.GEOTIFF_ID))
    return next(has), next(has)


@frozen
class Carried:
    """An extra dimension of the input that is copied to the output."""

    record: las.ExtraRecord
    source: int
    """Byte offset in the input record; the output's dtype has the offset there."""
    copied: bool = False
    """Whether added echoes get the value of the nearest return, because no value is free for "no data"."""


@frozen(eq=False)
class OutputLayout(Version):
    """Layout of the output points of one strip; picklable, so that workers can make rows with it."""

    source: CheckedHeader
    """Of the input; the output has its scales and offsets."""
    dtype: np.dtype
    """One output record: the standard fields with laspy's names, then the extra dimensions."""
    carried: tuple[Carried, ...]
    written: tuple[WrittenColumn, ...]
    whole: bool
    """Whether all rows keep the input's extra bytes (returns), or only matched rows (echoes)."""
    packets: PacketPlace | None
    """The packets of the input, if the output keeps them."""

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
    def extra_records(self) -> tuple[las.ExtraRecord, ...]:
        """Records of all extra dimensions of the output, in order."""
        return (*(carried.record for carried in self.carried), *(column.record for column in self.written))

    @property
    def extra_fields(self) -> tuple[str, ...]:
        """Names of the fields of `dtype` with extra dimensions, in order."""
        names = las.field_names(self.dtype)
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
        las.copy_standard(np.ascontiguousarray(source), rows, self.source.header.point_format, self.point_format)
        if xyz is not None and len(rows):
            xyz = np.asarray(xyz, np.float64)
            header, absent = self.source.header, np.isnan(xyz)
            new = ~(absent[:, 0] & absent[:, 1] & absent[:, 2])
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
        bits = 4 if self.point_format >= 6 else 3
        for shift, values in ((0, return_number), (bits, number_of_returns)):
            if values is not None:
                cut = np.minimum(values, self.max_return).astype(np.uint8) << np.uint8(shift)
                rows["bit_fields"] = (rows["bit_fields"] & np.uint8(255 ^ (self.max_return << shift))) | cut
        if self.carried:
            names = self.extra_fields[: len(self.carried)]
            formats = [carried.record.dtype for carried in self.carried]
            places, size = [carried.source for carried in self.carried], source.dtype.itemsize
            fields: Any = {"names": list(names), "formats": formats, "offsets": places, "itemsize": size}
            values = np.ascontiguousarray(source).view(np.dtype(fields))
            for carried, name in zip(self.carried, names, strict=True):
                rows[name] = values[name]
                empty = carried.record.no_data
                if not (self.whole or matched is None or empty is None):
                    rows[name][~np.asarray(matched)] = empty if len(empty) > 1 else empty[0]
        if self.packets is not None and self.packets.shift:
            has_packet = rows["wavepacket_index"] > 0
            rows["wavepacket_offset"][has_packet] += np.uint64(self.packets.shift)
        if self.packets is not None and time is not None and xyz is not None:
            new = np.isfinite(time) & np.isfinite(xyz[:, 0])
            rows["return_point_wave_location"][new] = np.asarray(time)[new] * 1000.0
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
    path = checked.path
    chosen = choose_version(path, checked.header, las_version, point_format, packets is not None)
    whole = points == "returns"
    # All extra dimensions of the input are copied. Where every row comes from an input point, none needs a value for
    # "no data".
    at, copies = las.STANDARD_DTYPES[checked.header.point_format].itemsize, []
    readable = [record.with_readable_texts() for record in checked.records]
    for record in las.name_uniquely(readable, checked.header.point_format):
        empty = None if whole else las.choose_no_data(record)
        marked = record if empty is None else record.with_no_data(empty)
        copies.append(Carried(marked, at, copied=not whole and empty is None))
        at += record.dtype.itemsize
    carried = tuple(copies)
    written = style_columns(columns, names, [entry.record.name for entry in carried], no_data)
    records = [*(entry.record for entry in carried), *(entry.record for entry in written)]
    dtype = las.build_dtype(chosen.point_format, records)
    if dtype.itemsize > 65535:
        raise InputError(f"{path}: its extra bytes leave no room for the columns in a 65535-byte record; choose fewer")
    if packets is not None and packets.packets.file is None:
        raise InputError(f"{path}: has no packets to keep; leave --keep-packets out")
    layout = OutputLayout(
        **{one.name: getattr(chosen, one.name) for one in fields(chosen)},
        source=checked,
        dtype=dtype,
        carried=carried,
        written=tuple(written),
        whole=whole,
        packets=None if packets is None else packets.packets,
    )
    if strict and layout.copied:
        raise InputError(
            f"{path}: --strict: no value is free to mark added echoes in its extra bytes {', '.join(layout.copied)}; "
            "leave --strict out to give them the value of the nearest return, or write --points returns"
        )
    return layout


_DESCRIPTORS = range(100, 356)
"""Record numbers of wave packet descriptors."""
MOST_PAYLOAD = 65535
"""Bytes that a VLR can hold."""


class CloudWriter(PointFile):
    """Writes one output cloud: `write` rows in order, then `commit` or `abort`; a context manager aborts.

    layout: from `plan_output`. target: its suffix selects LAS or LAZ.
    provenance: how the cloud was made; becomes JSON in a VLR of user id "wavebatch".
    `dropped` lists the records of the input that are not copied, and why.
    Raises InputError if the target exists (without overwrite) or cannot be written, ConfigError if it is the input.
    """

    def __init__(
        self,
        layout: OutputLayout,
        target: Path,
        *,
        provenance: Mapping[str, Any],
        overwrite: bool = False,
    ) -> None:
        self._layout = layout
        packets = layout.packets
        self._inputs = [layout.source.path, *([packets.file] if packets else [])]
        source = layout.source.header
        found, missing = las.find_evlrs(layout.source.path, source)
        self._evlrs: list[las.Evlr] = []
        self.dropped: dict[str, str] = {}
        for evlr in found:
            name = f"EVLR {evlr.user} {evlr.record_id}"
            is_waveforms = evlr.user.startswith("LAS") and evlr.record_id == las.WAVEFORM_RECORD_ID
            if is_waveforms or evlr.start == source.waveform_start:
                continue
            if evlr.user == "copc":
                self.dropped[name] = "the output is not a COPC file"
            elif las.has_record([evlr], "LASF_Spec", las.EXTRA_BYTES_RECORD_ID):
                self.dropped[name] = "extra bytes are described in the header"
            else:
                self._evlrs.append(evlr)
        if missing:
            self.dropped[f"{missing} EVLRs"] = f"they lie outside the file, or after the first {las.MAX_EVLRS}"
        vlrs = []
        for vlr in source.vlrs:
            descriptor = vlr.user.startswith("LAS") and vlr.user.endswith("_Spec") and vlr.record_id in _DESCRIPTORS
            if vlr.user != "copc" and (layout.packets is not None or not descriptor):
                vlrs.append(vlr)
        earlier = sum(vlr.user == USER_ID for vlr in vlrs)
        if layout.wkt is not None:
            vlrs = [vlr for vlr in vlrs if not las.has_record([vlr], las.PROJECTION, las.WKT_ID)]
            vlrs.append(las.build_wkt(layout.wkt))
        vlrs.append(_encode_provenance(layout, provenance, earlier + 1))
        encoding = source.global_encoding & ~(las.WAVES_INTERNAL | las.WAVES_EXTERNAL)
        if layout.packets is not None:
            encoding |= las.WAVES_INTERNAL if layout.packets.internal else las.WAVES_EXTERNAL
        has_wkt, has_keys = _has_crs([*vlrs, *self._evlrs])[0], _has_crs(vlrs)[1]
        if layout.version < (1, 4):
            encoding &= ~las.WKT_BIT  # a reserved bit there
        # Where a file has both, formats 6 to 10 mean the WKT, older ones the keys; without either, the former say WKT.
        elif not has_keys and (has_wkt or layout.point_format >= 6) or has_wkt and layout.point_format >= 6:
            encoding |= las.WKT_BIT
        # `PointFile` sets what follows from the points: their number, length, bounds, times and compression.
        header = replace(
            source,
            version=layout.version,
            point_format=layout.point_format,
            vlrs=vlrs,
            global_encoding=encoding,
            system_identifier=b"MODIFICATION",
            generating_software=las.SOFTWARE,
            waveform_start=0,
            evlr_start=0,
            evlr_count=0,
        )
        for place, vlr in enumerate(header.vlrs):  # laspy opens no file with ids that are no UTF-8
            clean = replace(vlr, user_id=_as_text(vlr.user_id), description=_as_text(vlr.description))
            if clean != vlr:
                header.vlrs[place] = clean
                name = f"VLR {clean.user} {vlr.record_id}"
                self.dropped[name] = "bytes of its id or description that are no UTF-8 text are question marks"
        with protecting(self._inputs):
            super().__init__(target, header, layout.dtype, layout.extra_records, overwrite=overwrite)

    def _append_records(self) -> None:
        with reporting(self._layout.source.path), open(self._layout.source.path, "rb") as source:
            for evlr in self._evlrs:
                start = evlr.start + las.EVLR_HEADER_SIZE
                source.seek(evlr.start)
                head = source.read(las.EVLR_HEADER_SIZE)
                head = head[:2] + _as_text(head[2:18]) + head[18:28] + _as_text(head[28:])
                repaired = repair_evlr(self._layout.source.path, evlr)
                if repaired is None:
                    self.append_record(head, source, start, start + evlr.length)
                else:
                    head = head[:20] + struct.pack("<Q", len(repaired)) + head[28:]
                    self.append_record(head, io.BytesIO(repaired), 0, len(repaired))
        packets = self._layout.packets
        if packets is None or packets.file is None:
            return
        head = waveform_head(packets.end - packets.start)
        with reporting(self.target), open(packets.file, "rb") as source:
            if packets.internal:
                self.append_record(head, source, packets.start, packets.end, waveforms=True)
                return
            packet_file = self.target.with_suffix(packets.file.suffix.lower())
            with protecting(self._inputs):
                draft = Draft(packet_file, overwrite=self.draft.overwrite)
            self.drafts.insert(0, draft)
            draft.file.write(head)
            copy_bytes(source, packets.start, packets.end, draft.file)


def _as_text(field: bytes) -> bytes:
    """The field, with question marks for bytes before its first NUL that are not UTF-8."""
    text, end, rest = field.partition(b"\0")
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("ascii", "replace").replace("\ufffd", "?").encode() + end + rest
    return field


def _encode_provenance(layout: OutputLayout, provenance: Mapping[str, Any], number: int) -> las.Vlr:
    """JSON with sorted keys and no time of day; it also keeps which program wrote the input, and names the columns.

    What a VLR cannot hold, for example the pulses of 180 digitizers, is left out and named; the report has it.
    """
    path, source = layout.source.path, layout.source.header
    made_by = {key: las.decode_text(getattr(source, key)) for key in ("system_identifier", "generating_software")}
    columns = {written.column: written.record.name for written in layout.written}
    whole = {"wavebatch": __version__, "input_header": made_by, "columns": columns, **provenance}
    payload = _encode_json(whole)
    if len(payload) > MOST_PAYLOAD:
        table = json.loads(payload)
        parts = sorted(_list_parts(table, ""), key=lambda part: (-part[0], part[1]))
        left_out: dict[str, str] = {}
        table["left_out"] = {"why": "a VLR is too small; the report of the strip has them", "sha256": left_out}
        for _, name, holder, key in parts:
            if len(_encode_json(table)) <= MOST_PAYLOAD:
                break
            left_out[name] = hashlib.sha256(_encode_json(holder[key])).hexdigest()
            holder[key] = None
        payload = _encode_json(table)
    if len(payload) > MOST_PAYLOAD:
        raise ConfigError(f"{path}: the provenance takes {len(payload)} bytes, a VLR holds at most {MOST_PAYLOAD}")
    return las.Vlr(USER_ID.encode(), number, payload, b"how this cloud was made (JSON)")


def _encode_json(value: Any) -> bytes:
    # NumPy numbers become numbers; other types that JSON does not have, such as paths, become text.
    text = json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"),
                      default=lambda one: one.item() if isinstance(one, np.generic) else str(one))  # fmt: skip
    return text.encode(errors="backslashreplace")


def _list_parts(table: dict[str, Any], prefix: str) -> Iterator[tuple[int, str, dict[str, Any], str]]:
    """Bytes, dotted name, table and key of every list and of every table without tables."""
    for key, value in table.items():
        if isinstance(value, dict) and any(isinstance(item, dict | list) for item in value.values()):
            yield from _list_parts(value, f"{prefix}{key}.")
        elif isinstance(value, dict | list | str):
            yield len(_encode_json(value)), f"{prefix}{key}", table, key
