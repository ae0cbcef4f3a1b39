"""Point clouds written whole or not at all, with their input's records and the account of how they were made."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.layout import OutputLayout
from wavebatch.files.disk.publish import Draft, publish_together, remove_stale, reporting
from wavebatch.files.las.extra_bytes import EXTRA_BYTES_RECORD_ID
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    GEOTIFF_ID,
    PROJECTION,
    WAVEFORM_RECORD_ID,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    WKT_BIT,
    WKT_ID,
    Evlr,
    LasHeader,
    Vlr,
    find_evlrs,
    has_record,
    read_header,
)
from wavebatch.files.las.write_points import PointFile, copy_bytes, waveform_head

__all__ = ["CloudWriter", "read_provenance", "remove_stale"]

_USER_ID = "wavebatch"
_DESCRIPTORS = range(100, 356)


class CloudWriter:
    """Writes one output file: `write` rows in order, then `commit` or `abort`; as a context manager it aborts itself.

    layout: from `plan_output`. target: its suffix says LAS or LAZ.
    provenance: what made the cloud; goes as JSON into a VLR of user id "wavebatch", with the same bytes every time.
    `dropped` lists the records of the input that are not carried over, and why.
    Raises InputError where the target exists (without overwrite), is the input itself, or cannot be written.
    """

    def __init__(
        self, layout: OutputLayout, target: Path, *, provenance: Mapping[str, Any], overwrite: bool = False
    ) -> None:
        self.target = Path(target)
        self._layout = layout
        self._refuse_input(self.target)
        source = read_header(layout.source)
        self._evlrs, self.dropped = _choose_evlrs(layout.source, source)
        header = _build_header(layout, source, provenance, self._evlrs)
        self._file = PointFile(self.target, header, layout.dtype, layout.extra_records, overwrite=overwrite)
        self._overwrite = overwrite
        self._open = True

    def __enter__(self) -> CloudWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.abort()

    def write(self, rows: np.ndarray) -> None:
        """Appends output records as `OutputLayout.rows` makes them."""
        self._file.write(rows)

    def commit(self) -> None:
        """Completes and publishes the file (and its .wdp, first); on an error nothing of it remains."""
        drafts = [self._file.draft]
        try:
            self._file.finish_points()
            with reporting(self._layout.source), open(self._layout.source, "rb") as source:
                for evlr in self._evlrs:
                    start = evlr.start + EVLR_HEADER_SIZE
                    self._file.append_record(_read(source, evlr.start), source, start, start + evlr.length)
            if self._layout.packets is not None:
                self._write_packets(drafts)
            self._file.finish()
        except BaseException:
            for draft in drafts:
                draft.discard()
            raise
        publish_together(drafts)
        self._open = False

    def abort(self) -> None:
        """Removes what was written so far; harmless after commit."""
        if self._open:
            self._file.abort()
            self._open = False

    def _write_packets(self, drafts: list[Draft]) -> None:
        packets = self._layout.packets
        head = waveform_head(packets.end - packets.start)
        with reporting(self.target), open(packets.path, "rb") as source:
            if packets.internal:
                self._file.append_record(head, source, packets.start, packets.end, waveforms=True)
                return
            beside = self.target.with_suffix(".wdp")
            self._refuse_input(beside)
            draft = Draft(beside, overwrite=self._overwrite)
            drafts.insert(0, draft)
            draft.file.write(head)
            copy_bytes(source, packets.start, packets.end, draft.file)

    def _refuse_input(self, target: Path) -> None:
        packets = self._layout.packets
        for path in (self._layout.source, *([packets.path] if packets else [])):
            if target.exists() and os.path.samefile(target, path):
                raise InputError(f"{target}: is the input itself; choose another output folder")


def read_provenance(path: Path) -> list[dict[str, Any]]:
    """What the wavebatch VLRs of a file say, oldest first; empty where wavebatch did not make it."""
    return [json.loads(vlr.payload) for vlr in read_header(Path(path)).vlrs if vlr.user == _USER_ID]


def _read(source: Any, start: int) -> bytes:
    source.seek(start)
    return source.read(EVLR_HEADER_SIZE)


def _choose_evlrs(path: Path, header: LasHeader) -> tuple[list[Evlr], dict[str, str]]:
    """Extended records to copy, and what is left out, with the reason."""
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
        dropped[f"{missing} EVLRs"] = "they lie outside the file"
    return kept, dropped


def _build_header(
    layout: OutputLayout, source: LasHeader, provenance: Mapping[str, Any], evlrs: list[Evlr]
) -> LasHeader:
    vlrs = [vlr for vlr in source.vlrs if _is_carried(vlr, layout)]
    earlier = sum(vlr.user == _USER_ID for vlr in vlrs)
    vlrs.append(_encode_provenance(layout.source, source, provenance, earlier + 1))
    encoding = source.global_encoding & ~(WAVES_INTERNAL | WAVES_EXTERNAL)
    if layout.packets is not None:
        encoding |= WAVES_INTERNAL if layout.packets.internal else WAVES_EXTERNAL
    if layout.point_format >= 6 and (
        has_record([*vlrs, *evlrs], PROJECTION, WKT_ID) or not has_record(vlrs, PROJECTION, GEOTIFF_ID)
    ):
        encoding |= WKT_BIT
    return LasHeader(
        version=layout.version,
        point_format=layout.point_format,
        point_length=layout.dtype.itemsize,
        scales=layout.scales,
        offsets=layout.offsets,
        vlrs=vlrs,
        padding=source.padding,
        user_bytes=source.user_bytes,
        file_source_id=source.file_source_id,
        global_encoding=encoding,
        project_id=source.project_id,
        system_identifier=b"MODIFICATION",
        generating_software=f"wavebatch {__version__}".encode(),
        creation=source.creation,
        gps_offset=source.gps_offset,
    )


def _is_carried(vlr: Vlr, layout: OutputLayout) -> bool:
    if vlr.user == "copc":
        return False
    descriptor = vlr.user.startswith("LAS") and vlr.user.endswith("_Spec") and vlr.record_id in _DESCRIPTORS
    return layout.packets is not None or not descriptor


def _plain(value: Any) -> Any:
    """NumPy's numbers as numbers, anything else that JSON does not know (paths) as text."""
    return value.item() if isinstance(value, np.generic) else str(value)


def _encode_provenance(path: Path, source: LasHeader, provenance: Mapping[str, Any], number: int) -> Vlr:
    """JSON with sorted keys and no time of day; what the input's header said of its maker is kept in it."""
    made_by = {
        "system_identifier": source.system_identifier.split(b"\0")[0].decode("latin-1"),
        "generating_software": source.generating_software.split(b"\0")[0].decode("latin-1"),
    }
    account = {"wavebatch": __version__, "input_header": made_by, **provenance}
    text = json.dumps(account, sort_keys=True, ensure_ascii=False, separators=(",", ":"), default=_plain)
    payload = text.encode(errors="backslashreplace")
    if len(payload) > 65535:
        raise ConfigError(f"{path}: the provenance of its output takes {len(payload)} bytes, a VLR holds 65535")
    return Vlr(_USER_ID.encode(), number, payload, b"how this cloud was made (JSON)")
