"""Finding waveforms of a strip: by packet, point or time, by a flag of their echoes, or a few of them spread evenly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan, Unit

FARTHEST = 1e-3
"""A pulse further from the time asked for is not meant [s]."""

MOST = 24
"""Waveforms of a picture."""

MOST_ON_SHEET = 100
"""Waveforms of a contact sheet."""

_BLOCK = 4096


@dataclass(frozen=True, slots=True)
class Wanted:
    """Which waveforms; with nothing set a few of them, spread evenly over the strip."""

    packets: tuple[tuple[int, int], ...] = ()
    """First number and the one behind the last, of packets in the order of their first points, from 0 on."""
    points: tuple[int, ...] = ()
    """Indices of points in the file."""
    times: tuple[float, ...] = ()
    """GPS times [s]; of each the nearest pulse."""
    flags: int = 0
    """EchoFlag bits: the first waveforms with an echo that has one of them."""
    most: int = 6
    """Of those with flags, and of those spread evenly."""
    random: int = 0
    """Packets drawn at random in place of those spread evenly."""
    seed: int = 0
    """Of the random ones."""
    sheet: bool = False
    """For a contact sheet, which has room for more."""

    @property
    def limit(self) -> int:
        """Waveforms that the picture has room for."""
        return MOST_ON_SHEET if self.sheet else MOST


@dataclass(frozen=True, slots=True)
class Place:
    """Where a waveform is."""

    unit: int
    row: int
    """Of unit.packets."""
    packet: int
    """Its number in the strip; -1 where its first point lies in another unit."""


def find_places(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """Places of the waveforms that are wanted, each once: packets, then points, then times, in the order asked for.

    run: the echoes of a block; only used to look for flags. Raises ConfigError for what the strip does not have and for
    more than MOST, InputError where it has no waveform at all.
    """
    path = reader.facts.path
    if not scan.packets:
        raise InputError(f"{path}: holds no waveform that could be drawn; `wavebatch check` says what it holds")
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
    """Numbers of the packets that are asked for; without any request those spread evenly."""
    if wanted.random:
        number = min(wanted.random, scan.packets)
        return np.sort(np.random.default_rng(wanted.seed).choice(scan.packets, number, replace=False)).tolist()
    if not (wanted.packets or wanted.points or wanted.times):
        return np.unique(np.linspace(0, scan.packets - 1, min(wanted.most, wanted.limit)).round().astype(int)).tolist()
    numbers: list[int] = []
    for first, behind in wanted.packets:
        if not 0 <= first < behind <= scan.packets:
            asked = str(first) if behind == first + 1 else f"{first}:{behind}"
            raise ConfigError(f"{path}: there is no packet {asked}; packets are 0 to {scan.packets - 1}")
        numbers += range(first, min(behind, first + wanted.limit + 1))
    return numbers


def _read_units(reader: StripReader, scan: StripScan) -> Iterator[tuple[Unit, int]]:
    """Units from the first one on, and how many packets those before it own."""
    base = 0
    for number in range(reader.unit_count()):
        unit = reader.read_unit(number, scan)
        yield unit, base
        base += int(np.count_nonzero(unit.packets.owned))


def _place(unit: Unit, base: int, row: int) -> Place:
    owned = unit.packets.owned
    return Place(unit.number, row, base + int(np.count_nonzero(owned[:row])) if owned[row] else -1)


class _Number:
    """Looks for a packet by its number."""

    def __init__(self, number: int) -> None:
        self._number = number
        self.place: Place | None = None

    @property
    def is_done(self) -> bool:
        """Whether no later unit can have it."""
        return self.place is not None

    def look(self, unit: Unit, base: int) -> None:
        owned = np.flatnonzero(unit.packets.owned)
        if base <= self._number < base + len(owned):
            self.place = Place(unit.number, int(owned[self._number - base]), self._number)

    def finish(self, path: str) -> Place:
        if self.place is None:
            raise InputError(f"{path}: packet {self._number} was not found; the file changed while it was read")
        return self.place


class _Point:
    """Looks for the packet of a point."""

    def __init__(self, point: int) -> None:
        self._point = point
        self.place: Place | None = None
        self.is_done = False
        self._flags = 0

    def look(self, unit: Unit, base: int) -> None:
        own = self._point - unit.start
        if not 0 <= own < len(unit.points):
            return
        self.is_done = True
        row = int(unit.packet_of_point[own])
        self._flags = int(unit.point_flags[own])
        self.place = _place(unit, base, row) if row >= 0 else None

    def finish(self, path: str) -> Place:
        if self.place is None:
            why = "a packet that cannot be used" if self._flags & EchoFlag.BROKEN_PACKET else "no waveform"
            raise ConfigError(f"{path}: point {self._point} has {why}; name another")
        return self.place


class _Time:
    """Looks for the pulse nearest to a time."""

    is_done = False

    def __init__(self, time: float) -> None:
        self._time, self._away = time, np.inf
        self.place: Place | None = None

    def look(self, unit: Unit, base: int) -> None:
        points = np.flatnonzero(unit.packet_of_point >= 0)
        with np.errstate(invalid="ignore"):
            away = np.abs(unit.points["gps_time"][points] - self._time)
        away[np.isnan(away)] = np.inf
        if len(away) and away.min() < self._away:
            nearest = int(np.argmin(away))
            self._away = float(away[nearest])
            self.place = _place(unit, base, int(unit.packet_of_point[points[nearest]]))

    def finish(self, path: str) -> Place:
        if self.place is None or self._away > FARTHEST:
            told = "no pulse has a time" if self.place is None else f"the nearest is {self._away:g} s away"
            raise ConfigError(f"{path}: no pulse lies within {FARTHEST:g} s of GPS time {self._time!r}: {told}")
        return self.place


def _find_flagged(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """The first waveforms, in the order of the file, with an echo that has one of the flags."""
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
