"""Search for waveforms of a strip: by packet, point or GPS time, by flags of their echoes, or a few spread evenly.

`wavebatch plot waveform` calls `find_places` and reads the waveforms at these places with `waveform.read_views`. The
strip is read unit by unit, only as far as needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan, Unit

FARTHEST = 1e-3
"""Largest distance of a pulse from the wanted GPS time [s]."""

MOST = 24
"""Most waveforms of a picture: more would be too small to read."""

MOST_ON_SHEET = 100
"""Most waveforms of a contact sheet."""

_BLOCK = 4096
"""Waveforms that run through the chain at once when flags are searched."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which waveforms to find; by default a few of them, spread evenly over the strip."""

    packets: tuple[tuple[int, int | None], ...] = ()
    """Spans of packets: first number and end (not included; None: the last), in the order of their first points."""
    points: tuple[int, ...] = ()
    """Indices of points in the file."""
    times: tuple[float, ...] = ()
    """GPS times [s]; the nearest pulse of each."""
    flags: int = 0
    """EchoFlag bits: the first waveforms with an echo that has one of them."""
    most: int = 6
    """Most waveforms with flags, or spread evenly."""
    random: int = 0
    """Number of packets to draw at random; 0: none."""
    seed: int = 0
    """Seed of the random packets."""
    sheet: bool = False
    """Whether the picture is a contact sheet."""

    @property
    def limit(self) -> int:
        """Most waveforms of the picture."""
        return MOST_ON_SHEET if self.sheet else MOST


@dataclass(frozen=True, slots=True)
class Place:
    """Where a waveform is in the strip."""

    unit: int
    row: int
    """Row of unit.packets."""
    packet: int
    """Number of the packet in the strip; -1 if its first point is in another unit."""


def find_places(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """Places of the wanted waveforms, each once: packets, then points, then times, in the given order.

    run: gives the echoes of a block; only used to search for flags. Raises ConfigError for packets, points and times
    that the strip does not have and for more waveforms than fit, InputError if the strip has no waveform.
    """
    path = reader.facts.path
    if not scan.packets:
        raise InputError(f"{path}: holds no waveform to draw; `wavebatch check` shows what it holds")
    if wanted.flags:
        return _find_flagged(reader, scan, wanted, run)
    searches = [_Number(number) for number in _list_numbers(scan, wanted, str(path))]
    searches += [_Point(point) for point in wanted.points]
    searches += [_Time(time) for time in wanted.times]
    if len(searches) > wanted.limit:
        raise ConfigError(f"{path}: {len(searches)} waveforms are too many for a picture; {wanted.limit} fit")
    for point in wanted.points:
        if not 0 <= point < scan.points:
            raise ConfigError(f"{path}: there is no point {point}; points are 0 to {scan.points - 1}")
    for unit, base in _read_units(reader, scan):
        for search in searches:
            search.look(unit, base)
        if all(search.is_done for search in searches):
            break
    places = [search.finish(str(path)) for search in searches]
    return list({(place.unit, place.row): place for place in places}.values())


def _list_numbers(scan: StripScan, wanted: Wanted, path: str) -> list[int]:
    """Numbers of the wanted packets; by default a few, spread evenly."""
    if wanted.random:
        number = min(wanted.random, scan.packets)
        return np.sort(np.random.default_rng(wanted.seed).choice(scan.packets, number, replace=False)).tolist()
    if not (wanted.packets or wanted.points or wanted.times):
        return np.unique(np.linspace(0, scan.packets - 1, min(wanted.most, wanted.limit)).round().astype(int)).tolist()
    numbers: list[int] = []
    for first, end in wanted.packets:
        end = scan.packets if end is None else end
        if not 0 <= first < end <= scan.packets:
            span = str(first) if end == first + 1 else f"{first}:{end}"
            raise ConfigError(f"{path}: there is no packet {span}; packets are 0 to {scan.packets - 1}")
        numbers += range(first, min(end, first + wanted.limit + 1))
    return numbers


def _read_units(reader: StripReader, scan: StripScan) -> Iterator[tuple[Unit, int]]:
    """The units of the strip, each with the number of packets in the units before it."""
    base = 0
    for unit in reader.read_units(scan):
        yield unit, base
        base += int(np.count_nonzero(unit.packets.owned))


def _place(unit: Unit, base: int, row: int) -> Place:
    owned = unit.packets.owned
    return Place(unit.number, row, base + int(np.count_nonzero(owned[:row])) if owned[row] else -1)


class _Search:
    """Search for one waveform: `look` at unit after unit until `is_done`, then `finish`."""

    is_done = False

    def __init__(self, wanted: float) -> None:
        self.wanted = wanted
        self.place: Place | None = None


class _Number(_Search):
    """Search for a packet by its number."""

    def look(self, unit: Unit, base: int) -> None:
        owned = np.flatnonzero(unit.packets.owned)
        if base <= self.wanted < base + len(owned):
            self.place = Place(unit.number, int(owned[self.wanted - base]), self.wanted)
            self.is_done = True

    def finish(self, path: str) -> Place:
        if self.place is None:
            raise InputError(f"{path}: packet {self.wanted} was not found; the file changed while it was read")
        return self.place


class _Point(_Search):
    """Search for the packet of a point."""

    flags = 0

    def look(self, unit: Unit, base: int) -> None:
        index = self.wanted - unit.start
        if 0 <= index < len(unit.points):
            self.is_done = True
            row = int(unit.packet_of_point[index])
            self.flags = int(unit.point_flags[index])
            self.place = _place(unit, base, row) if row >= 0 else None

    def finish(self, path: str) -> Place:
        if self.place is None:
            why = "a packet that cannot be used" if self.flags & EchoFlag.BROKEN_PACKET else "no waveform"
            raise ConfigError(f"{path}: point {self.wanted} has {why}; name another")
        return self.place


class _Time(_Search):
    """Search for the pulse nearest to a GPS time; it looks at all units, because times need not be in order."""

    away = np.inf

    def look(self, unit: Unit, base: int) -> None:
        points = np.flatnonzero(unit.packet_of_point >= 0)
        with np.errstate(invalid="ignore"):
            away = np.abs(unit.points["gps_time"][points] - self.wanted)
        away[np.isnan(away)] = np.inf
        if len(away) and away.min() < self.away:
            nearest = int(np.argmin(away))
            self.away = float(away[nearest])
            self.place = _place(unit, base, int(unit.packet_of_point[points[nearest]]))

    def finish(self, path: str) -> Place:
        if self.place is None or self.away > FARTHEST:
            why = "no pulse has a time" if self.place is None else f"the nearest is {self.away:g} s away"
            raise ConfigError(f"{path}: no pulse lies within {FARTHEST:g} s of GPS time {self.wanted!r}: {why}")
        return self.place


def _find_flagged(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """The first waveforms in the file with an echo that has one of the flags."""
    found: list[Place] = []
    most = min(wanted.most, wanted.limit)
    for unit, base in _read_units(reader, scan):
        rows = np.flatnonzero(unit.packets.owned)
        for begin in range(0, len(rows), _BLOCK):
            hits = []
            for block, index in reader.read_rows(unit, rows[begin : begin + _BLOCK], _BLOCK):
                table = run(block)
                hits += index[np.unique(table.waveform[(table.flags & np.uint16(wanted.flags)) != 0])].tolist()
            found += [_place(unit, base, row) for row in sorted(hits)]
            if len(found) >= most:
                return found[:most]
    if not found:
        raise InputError(f"{reader.facts.path}: no echo has one of these flags: nothing to draw")
    return found
