"""Facts of a strip: all that its checked headers contain, found once and then passed on, also to other processes.

`StripReader` finds them; the survey, the batch and the reports read them. Keep them picklable, and add nothing here
that needs a pass over the points: that belongs into `StripScan`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from wavebatch.core.waveforms import Digitizer
from wavebatch.files.las.checked_header import CheckedHeader, read_checked_header
from wavebatch.files.las.crs import CrsUnits, read_crs
from wavebatch.files.las.read_points import open_points
from wavebatch.files.strip.packets import COMPRESSED, PacketPlace, locate_packets, read_descriptors, settle_headerless

_FIRST_POINTS = 10_000
"""Points that show from where a .wdp without header counts its byte offsets."""


@dataclass(frozen=True, slots=True, eq=False)
class StripFacts(CheckedHeader):
    """Facts of a strip after all checks: its header, and what follows from it; picklable."""

    digitizers: Mapping[int, Digitizer]
    """All descriptors by index, also unused and empty ones."""
    compression: Mapping[int, int]
    """Compression type of every descriptor."""
    packets: PacketPlace
    direction_option: str
    crs: str | None
    units: tuple[CrsUnits, ...]
    """Units of the coordinates, one entry from the WKT and one from the GeoTIFF keys, if these are there."""

    @property
    def compressed(self) -> frozenset[int]:
        """Indices of descriptors with compressed packets."""
        return frozenset(index for index, kind in self.compression.items() if kind == COMPRESSED)


def find_facts(path: Path, direction: str, headerless: bool) -> StripFacts:
    """Return the facts of a strip; reads its headers, descriptors and CRS, not its points.

    direction, headerless: as for `StripReader`. Raises InputError if the strip cannot be what it claims to be.
    """
    checked = read_checked_header(path)
    header = checked.header
    digitizers, compression, odd = read_descriptors(header)
    place = locate_packets(checked, compression, headerless)
    if place.base < 0:
        with contextlib.closing(open_points(checked)) as points:
            place = settle_headerless(place, points.read(0, min(header.point_count, _FIRST_POINTS)))
    crs, units = read_crs(path, header)
    values = {entry.name: getattr(checked, entry.name) for entry in fields(checked)}
    values["warnings"] = (*checked.warnings, *odd, *place.warnings)
    return StripFacts(**values, digitizers=digitizers, compression=compression, packets=place,
                      direction_option=direction, crs=crs, units=units)  # fmt: skip
