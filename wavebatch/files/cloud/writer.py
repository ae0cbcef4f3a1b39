"""Writer of output clouds: points, the records of the input, and the cloud's provenance.

The batch opens one `CloudWriter` per strip. Equal input and options must give equal bytes: write no time of day, no
path and nothing that depends on the number of processes into the file.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.column_names import USER_ID
from wavebatch.files.cloud.layout import OutputLayout
from wavebatch.files.disk.publish import Draft, protecting, reporting
from wavebatch.files.las.crs import repair_evlr
from wavebatch.files.las.extra_bytes import EXTRA_BYTES_RECORD_ID
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    GEOTIFF_ID,
    MAX_EVLRS,
    PROJECTION,
    SOFTWARE,
    WAVEFORM_RECORD_ID,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    WKT_BIT,
    WKT_ID,
    Evlr,
    LasHeader,
    Vlr,
    build_wkt,
    decode_text,
    find_evlrs,
    has_record,
)
from wavebatch.files.las.write_points import PointFile, copy_bytes, waveform_head

_DESCRIPTORS = range(100, 356)
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
        self._evlrs, self.dropped = _choose_evlrs(layout.source.path, layout.source.header)
        header = _build_header(layout, provenance, self._evlrs)
        for name in _clean_ids(header.vlrs):
            self.dropped[name] = "bytes of its id or description that are no UTF-8 text are question marks"
        with protecting(self._inputs):
            super().__init__(target, header, layout.dtype, layout.extra_records, overwrite=overwrite)

    def _append_records(self) -> None:
        with reporting(self._layout.source.path), open(self._layout.source.path, "rb") as source:
            for evlr in self._evlrs:
                start = evlr.start + EVLR_HEADER_SIZE
                source.seek(evlr.start)
                head = source.read(EVLR_HEADER_SIZE)
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


def _choose_evlrs(path: Path, header: LasHeader) -> tuple[list[Evlr], dict[str, str]]:
    """Extended records to copy, and the names of the others with the reason."""
    found, missing = find_evlrs(path, header)
    kept: list[Evlr] = []
    dropped: dict[str, str] = {}
    for evlr in found:
        name = f"EVLR {evlr.user} {evlr.record_id}"
        is_waveforms = evlr.user.startswith("LAS") and evlr.record_id == WAVEFORM_RECORD_ID
        if is_waveforms or evlr.start == header.waveform_start:
            continue
        if evlr.user == "copc":
            dropped[name] = "the output is not a COPC file"
        elif has_record([evlr], "LASF_Spec", EXTRA_BYTES_RECORD_ID):
            dropped[name] = "extra bytes are described in the header"
        else:
            kept.append(evlr)
    if missing:
        dropped[f"{missing} EVLRs"] = f"they lie outside the file, or after the first {MAX_EVLRS}"
    return kept, dropped


def _build_header(layout: OutputLayout, provenance: Mapping[str, Any], evlrs: list[Evlr]) -> LasHeader:
    source = layout.source.header
    vlrs = [vlr for vlr in source.vlrs if _is_carried(vlr, layout)]
    earlier = sum(vlr.user == USER_ID for vlr in vlrs)
    if layout.wkt is not None:
        vlrs = [vlr for vlr in vlrs if not has_record([vlr], PROJECTION, WKT_ID)]
        vlrs.append(build_wkt(layout.wkt))
    vlrs.append(_encode_provenance(layout, provenance, earlier + 1))
    encoding = source.global_encoding & ~(WAVES_INTERNAL | WAVES_EXTERNAL)
    if layout.packets is not None:
        encoding |= WAVES_INTERNAL if layout.packets.internal else WAVES_EXTERNAL
    has_wkt, has_keys = has_record([*vlrs, *evlrs], PROJECTION, WKT_ID), has_record(vlrs, PROJECTION, GEOTIFF_ID)
    if layout.version < (1, 4):
        encoding &= ~WKT_BIT  # a reserved bit there
    elif not has_keys and (has_wkt or layout.point_format >= 6) or has_wkt and layout.point_format >= 6:
        encoding |= WKT_BIT
    return LasHeader(
        version=layout.version,
        point_format=layout.point_format,
        point_length=layout.dtype.itemsize,
        scales=source.scales,
        offsets=source.offsets,
        vlrs=vlrs,
        padding=source.padding,
        user_bytes=source.user_bytes,
        file_source_id=source.file_source_id,
        global_encoding=encoding,
        project_id=source.project_id,
        system_identifier=b"MODIFICATION",
        generating_software=SOFTWARE,
        creation=source.creation,
        gps_offset=source.gps_offset,
    )


def _clean_ids(vlrs: list[Vlr]) -> list[str]:
    """Make ids and descriptions UTF-8, in place, and name the records: laspy opens no file with others."""
    changed = []
    for place, vlr in enumerate(vlrs):
        clean = replace(vlr, user_id=_as_text(vlr.user_id), description=_as_text(vlr.description))
        if clean != vlr:
            vlrs[place] = clean
            changed.append(f"VLR {clean.user} {vlr.record_id}")
    return changed


def _as_text(field: bytes) -> bytes:
    """The field, with question marks for bytes before its first NUL that are not UTF-8."""
    text, end, rest = field.partition(b"\0")
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("ascii", "replace").replace("\ufffd", "?").encode() + end + rest
    return field


def _is_carried(vlr: Vlr, layout: OutputLayout) -> bool:
    if vlr.user == "copc":
        return False
    descriptor = vlr.user.startswith("LAS") and vlr.user.endswith("_Spec") and vlr.record_id in _DESCRIPTORS
    return layout.packets is not None or not descriptor


def _plain(value: Any) -> Any:
    """NumPy numbers become numbers; other types that JSON does not have, such as paths, become text."""
    return value.item() if isinstance(value, np.generic) else str(value)


def _encode_provenance(layout: OutputLayout, provenance: Mapping[str, Any], number: int) -> Vlr:
    """JSON with sorted keys and no time of day; it also keeps which program wrote the input, and names the columns.

    What a VLR cannot hold, for example the pulses of 180 digitizers, is left out and named; the report has it.
    """
    path, source = layout.source.path, layout.source.header
    made_by = {key: decode_text(getattr(source, key)) for key in ("system_identifier", "generating_software")}
    columns = {written.column: written.record.name for written in layout.written}
    whole = {"wavebatch": __version__, "input_header": made_by, "columns": columns, **provenance}
    payload = _encode_json(whole)
    if len(payload) > MOST_PAYLOAD:
        payload = _encode_json(_shorten(json.loads(payload)))
    if len(payload) > MOST_PAYLOAD:
        raise ConfigError(
            f"{path}: the provenance takes {len(payload)} bytes, a VLR holds at most {MOST_PAYLOAD}"
        )
    return Vlr(USER_ID.encode(), number, payload, b"how this cloud was made (JSON)")


def _encode_json(value: Any) -> bytes:
    text = json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"), default=_plain)
    return text.encode(errors="backslashreplace")


def _shorten(whole: dict[str, Any]) -> dict[str, Any]:
    """The provenance, with the largest tables and lists replaced by their checksums until it fits into a VLR."""
    parts = sorted(_list_parts(whole, ""), key=lambda part: (-part[0], part[1]))
    left_out: dict[str, str] = {}
    whole["left_out"] = {"why": "a VLR is too small; the report of the strip has them", "sha256": left_out}
    for _, name, holder, key in parts:
        if len(_encode_json(whole)) <= MOST_PAYLOAD:
            break
        left_out[name] = hashlib.sha256(_encode_json(holder[key])).hexdigest()
        holder[key] = None
    return whole


def _list_parts(table: dict[str, Any], prefix: str) -> Iterator[tuple[int, str, dict[str, Any], str]]:
    """Bytes, dotted name, table and key of every list and of every table without tables."""
    for key, value in table.items():
        if isinstance(value, dict) and any(isinstance(item, dict | list) for item in value.values()):
            yield from _list_parts(value, f"{prefix}{key}.")
        elif isinstance(value, dict | list | str):
            yield len(_encode_json(value)), f"{prefix}{key}", table, key
