"""Facts of a strip: all that its checked headers contain, found once and then passed on, also to other processes.

`StripReader` finds them; the survey, the batch and the reports read them. Keep them picklable, and add nothing here
that needs a pass over the points: that belongs into `StripScan`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.waveforms import Digitizer
from wavebatch.files.las.checked_header import CheckedHeader, read_checked_header
from wavebatch.files.las.crs import CrsUnits, read_crs
from wavebatch.files.las.read_points import open_points
from wavebatch.files.strip.packets import locate_packets, read_descriptors, settle_headerless

_FIRST_POINTS = 10_000
"""Points that show from where a .wdp without header counts its byte offsets."""


@dataclass(frozen=True, slots=True, eq=False)
class StripFacts:
    """Facts of a strip after all checks; picklable."""

    checked: CheckedHeader
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
    """One point record with laspy's field names."""
    digitizers: Mapping[int, Digitizer]
    """All descriptors by index, also unused and empty ones."""
    compression: Mapping[int, int]
    """Compression type of every descriptor."""
    packet_file: Path | None
    """The strip itself or its .wdp; None if there is no packet and the header claims none."""
    internal: bool
    packet_start: int
    packet_base: int
    packet_end: int
    """Packets may use bytes [packet_start, packet_end) of packet_file; one begins at packet_base + its byte offset."""
    direction_option: str
    extra_dimensions: tuple[str, ...]
    crs: str | None
    units: tuple[CrsUnits, ...]
    """Units of the coordinates, one entry from the WKT and one from the GeoTIFF keys, if these are there."""
    warnings: tuple[str, ...]


def find_facts(path: Path, direction: str, headerless: bool) -> StripFacts:
    """Return the facts of a strip; reads its headers, descriptors and CRS, not its points.

    direction, headerless: as for `StripReader`. Raises InputError if the strip cannot be what it claims to be.
    """
    checked = read_checked_header(path)
    header = checked.header
    found = read_descriptors(header)
    place = locate_packets(checked, found.compression, headerless)
    if place.base < 0:
        with contextlib.closing(open_points(checked)) as points:
            place = settle_headerless(place, points.read(0, min(header.point_count, _FIRST_POINTS)))
    crs, units = read_crs(path, header)
    return StripFacts(
        checked=checked,
        path=path,
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
