"""Search for waveforms of a strip: by packet, point or GPS time, by flags of their echoes, or a few spread evenly.

`wavebatch plot waveform` calls `find_places` and reads the waveforms at these places with `waveform.read_views`. The
strip is read unit by unit, only as far as needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.order import even_places
from wavebatch.core.suggest import nearest
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.cloud.point_filter import PlannedFilter, PointFilter, ReadColumn
from wavebatch.files.strip.reader import StripReader, StripScan, Unit

FARTHEST = 1e-3
"""Largest distance of a pulse from the wanted GPS time [s]."""

FEW = 6
"""Waveforms of a picture if their number is not given."""

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
    chosen: PointFilter = PointFilter()
    """The first waveforms with an echo that it chooses."""
    most: int | None = None
    """Most waveforms with such an echo, or spread evenly; None: FEW of them, or a full sheet."""
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

    @property
    def number(self) -> int:
        """Most waveforms with chosen echoes, or spread evenly."""
        return self.most or (MOST_ON_SHEET if self.sheet else FEW)


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
    if wanted.number > wanted.limit:
        raise _too_many(path, wanted)
    if wanted.chosen:
        return _find_flagged(reader, scan, wanted, run)
    numbers = _list_numbers(scan, wanted, str(path))
    if len(numbers) + len(wanted.points) + len(wanted.times) > wanted.limit:
        raise _too_many(path, wanted)
    for point in wanted.points:
        if not 0 <= point < scan.points:
            raise ConfigError(f"{path}: there is no point {point}; points are 0 to {scan.points - 1}")
    found: dict[tuple[str, float], Place] = {}
    away = dict.fromkeys(wanted.times, np.inf)
    for unit, base in _read_units(reader, scan):
        owned = np.flatnonzero(unit.packets.owned)
        rows = {number: owned[number - base] for number in numbers if base <= number < base + len(owned)}
        found |= {("packet", number): Place(unit.number, int(row), number) for number, row in rows.items()}
        for point in wanted.points:
            if 0 <= point - unit.start < len(unit.points):
                found["point", point] = _find_point(unit, base, point, str(path))
        for time in wanted.times:
            row, apart = _find_nearest(unit, time)
            if apart < away[time]:
                away[time], found["time", time] = apart, _place(unit, base, row)
        # Times need not be in order: all units are read for them.
        if not wanted.times and len(found) == len({*numbers}) + len({*wanted.points}):
            break
    for time, apart in away.items():
        if apart > FARTHEST:
            why = f"the nearest is {apart:g} s away" if np.isfinite(apart) else "no pulse has a time"
            raise ConfigError(f"{path}: no pulse lies within {FARTHEST:g} s of GPS time {time!r}: {why}")
    for number in numbers:
        if ("packet", number) not in found:
            raise InputError(f"{path}: packet {number} was not found; the file changed while it was read")
    wants = [("packet", numbers), ("point", wanted.points), ("time", wanted.times)]
    places = [found[kind, one] for kind, each in wants for one in each]
    return list({(place.unit, place.row): place for place in places}.values())


def _too_many(path: Any, wanted: Wanted) -> ConfigError:
    more = "" if wanted.sheet else f", {MOST_ON_SHEET} with --sheet"
    return ConfigError(f"{path}: too many waveforms for a picture; {wanted.limit} fit{more}")


def _list_numbers(scan: StripScan, wanted: Wanted, path: str) -> list[int]:
    """Numbers of the wanted packets; by default a few, spread evenly."""
    if wanted.random:
        number = min(wanted.random, scan.packets)
        return np.sort(np.random.default_rng(wanted.seed).choice(scan.packets, number, replace=False)).tolist()
    if not (wanted.packets or wanted.points or wanted.times):
        return even_places(scan.packets, wanted.number).tolist()
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


def _find_point(unit: Unit, base: int, point: int, path: str) -> Place:
    row = int(unit.packet_of_point[point - unit.start])
    if row < 0:
        broken = unit.point_flags[point - unit.start] & EchoFlag.BROKEN_PACKET
        why = "a packet that cannot be used" if broken else "no waveform"
        raise ConfigError(f"{path}: point {point} has {why}; name another")
    return _place(unit, base, row)


def _find_nearest(unit: Unit, time: float) -> tuple[int, float]:
    """Packet of the unit that is nearest to a GPS time, and how far away it is [s]; infinity if none has a time."""
    points = np.flatnonzero(unit.packet_of_point >= 0)
    with np.errstate(invalid="ignore"):
        away = np.abs(unit.points["gps_time"][points] - time)
    away[np.isnan(away)] = np.inf
    nearest = int(np.argmin(away)) if len(away) else -1
    return (int(unit.packet_of_point[points[nearest]]), float(away[nearest])) if len(away) else (-1, np.inf)


def _find_flagged(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """The first waveforms in the file with an echo that is chosen."""
    keep: PlannedFilter | None = None
    found: list[Place] = []
    for unit, base in _read_units(reader, scan):
        rows = np.flatnonzero(unit.packets.owned)
        for begin in range(0, len(rows), _BLOCK):
            hits = []
            for block, index in reader.read_rows(unit, rows[begin : begin + _BLOCK], _BLOCK):
                table = run(block)
                keep = keep or _plan(wanted.chosen, table)
                kept = keep.test((table, len(block)), len(table)) == 0
                hits += index[np.unique(table.waveform[kept])].tolist()
            found += [_place(unit, base, row) for row in sorted(hits)]
            if len(found) >= wanted.number:
                return found[: wanted.number]
    if not found:
        text = "has one of these flags" if wanted.chosen.where is None else f"meets {wanted.chosen.where.text!r}"
        raise InputError(f"{reader.facts.path}: no echo {text}: nothing to draw")
    return found


def _plan(chosen: PointFilter, some: EchoTable) -> PlannedFilter:
    """The filter for tables of echoes like this one, given with their numbers of waveforms."""
    made: dict[str, ReadColumn] = {
        "echo_time": lambda rows: rows[0].time,
        "echo_flags": lambda rows: rows[0].flags,
        "number_of_returns": lambda rows: rows[0].count(rows[1])[rows[0].waveform],
    }

    def find(name: str) -> ReadColumn:
        have = {**some.attributes, **made}
        if name not in have:
            raise ConfigError(f"echoes have no column {name!r}; {nearest(name, have)}")
        return made.get(name) or (lambda rows: rows[0].attributes[name])

    return chosen.plan(made, find, "echoes")
