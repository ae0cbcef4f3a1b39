"""What the headers of a strip say once they are checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.waveforms import Digitizer
from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.crs import CrsUnits, read_crs
from wavebatch.files.strip.packets import Descriptors, PacketPlace


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
    units: tuple[CrsUnits, ...]
    """What WKT and GeoTIFF keys say of them, as far as either is there."""
    warnings: tuple[str, ...]


def collect_facts(checked: CheckedHeader, found: Descriptors, place: PacketPlace, direction: str) -> StripFacts:
    """The facts of a strip whose header, descriptors and packets have been looked at."""
    header = checked.header
    crs, units = read_crs(checked.path, header)
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
        crs=crs,
        units=units,
        warnings=(*checked.warnings, *found.warnings, *place.warnings),
    )
