"""What the headers of a strip say once they are checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.blocks import Digitizer
from wavebatch.io.header import EVLR_HEADER_SIZE, LasHeader, find_evlrs
from wavebatch.io.las import CheckedHeader
from wavebatch.io.packets import MAX_EVLRS, Descriptors, PacketPlace

_WKT_ID, _GEOTIFF_ID, _CITATION_ID = 2112, 34735, 34737
_MAX_WKT = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class StripFacts:
    """What the headers of a strip say after they were checked; picklable."""

    path: Path
    size: int
    version: str
    point_format: int
    point_length: int
    point_count: int
    compressed: bool
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    dtype: np.dtype
    """One point record under laspy's field names."""
    digitizers: Mapping[int, Digitizer]
    """Every descriptor by index; unused, empty ones too."""
    compression: Mapping[int, int]
    """Compression type of every descriptor."""
    packet_file: Path | None
    """The strip itself or its .wdp; None where there is none and nothing says that there should be."""
    internal: bool
    packet_start: int
    packet_base: int
    packet_end: int
    """Legal bytes are [packet_start, packet_end) of packet_file; a packet begins at packet_base + its byte offset."""
    direction_option: str
    extra_dimensions: tuple[str, ...]
    crs: str | None
    warnings: tuple[str, ...]


def collect_facts(checked: CheckedHeader, found: Descriptors, place: PacketPlace, direction: str) -> StripFacts:
    """The facts of a strip whose header, descriptors and packets have been looked at."""
    header = checked.header
    return StripFacts(
        path=checked.path,
        size=checked.size,
        version=f"{header.version[0]}.{header.version[1]}",
        point_format=header.point_format,
        point_length=header.point_length,
        point_count=header.point_count,
        compressed=header.compressed,
        scales=header.scales,
        offsets=header.offsets,
        dtype=checked.dtype,
        digitizers=found.digitizers,
        compression=found.compression,
        packet_file=place.file,
        internal=place.internal,
        packet_start=place.start,
        packet_base=place.base,
        packet_end=place.end,
        direction_option=direction,
        extra_dimensions=tuple(record.name for record in checked.records),
        crs=_read_crs(checked.path, header),
        warnings=(*checked.warnings, *found.warnings, *place.warnings),
    )


def _read_crs(path: Path, header: LasHeader) -> str | None:
    """The WKT of the strip, else the names its GeoTIFF keys give, else None."""
    texts = {vlr.record_id: vlr.payload for vlr in header.vlrs if vlr.user == "LASF_Projection"}
    if _WKT_ID not in texts:
        evlrs, _ = find_evlrs(path, replace(header, evlr_count=min(header.evlr_count, MAX_EVLRS)))
        for evlr in evlrs:
            if (evlr.user, evlr.record_id) == ("LASF_Projection", _WKT_ID) and evlr.length <= _MAX_WKT:
                with open(path, "rb") as file:
                    file.seek(evlr.start + EVLR_HEADER_SIZE)
                    texts[_WKT_ID] = file.read(evlr.length)
    if _WKT_ID in texts:
        return texts[_WKT_ID].split(b"\0")[0].decode("utf-8", "replace") or None
    if _GEOTIFF_ID in texts:
        citation = texts.get(_CITATION_ID, b"").split(b"\0")[0].decode("latin-1").strip("| ")
        return f"GeoTIFF: {citation}" if citation else "GeoTIFF keys"
    return None
