"""From the echoes of a unit to the rows of its output: who owns what, return numbers, and what is passed through."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.batch.counts import RunReport, count_flags
from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import StageError
from wavebatch.core.no_data import count_reasons
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.disk.raw_bytes import widen
from wavebatch.kernels.geometry.group_returns import find_nearest, find_pulses, number_returns

if TYPE_CHECKING:
    from wavebatch.files.cloud.layout import OutputLayout
    from wavebatch.files.strip.reader import Unit

NEEDED = ("x", "y", "z", "point")
"""Attribute columns without which echoes cannot become points."""


@dataclass(frozen=True, slots=True, eq=False)
class UnitEchoes:
    """The echoes of all packets of a unit that were read."""

    table: EchoTable
    """`waveform` is the row of unit.packets; sorted by it, then time."""
    nearest: np.ndarray
    """Index in the file of the packet's return nearest to each echo, i8 (m,)."""
    read: np.ndarray
    """Whether a packet of the unit was read, bool (packets,)."""
    direction: np.ndarray
    """Away from the sensor, per packet [m/ns], f8 (packets, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Members:
    """Points of the unit, own ones first, then those of other units that share its packets."""

    own: int
    source: np.ndarray
    """Their records."""
    index: np.ndarray
    """Their places in the file, i8 (k,)."""
    packet: np.ndarray
    """Row of unit.packets, -1 none, i8 (k,)."""

    def find(self, index: np.ndarray) -> np.ndarray:
        """Rows of the points at `index` in the file."""
        rows = index - self.index[0] if self.own else np.full(len(index), -1)
        far = np.flatnonzero((rows < 0) | (rows >= self.own))
        if not len(far):
            return rows
        others = np.argsort(self.index[self.own :], kind="stable")
        known = self.index[self.own :][others]
        place = np.searchsorted(known, index[far])
        if not len(known) or np.any(known[np.minimum(place, len(known) - 1)] != index[far]):
            raise StageError("an echo belongs to a point that does not share its packet; please report it as a bug")
        rows[far] = self.own + others[place]
        return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """What each output row is made from, in output order."""

    echo: np.ndarray
    """Row of the echo table, -1 for points that are passed through, i8 (m,)."""
    source: np.ndarray
    """Row of the members whose record it takes, i8 (m,)."""
    owner: np.ndarray
    """Own point that owns the packet, or the point itself: its pulse is the row's, i8 (m,)."""
    reason: np.ndarray
    """Why it is passed through, EchoFlag, u2 (m,)."""


def gather_echoes(unit: Unit, results: Iterable[tuple[WaveformBlock, np.ndarray, EchoTable]]) -> UnitEchoes:
    """The echoes of a unit's blocks in packet order.

    results: block, row of unit.packets per waveform (n,), and the block's echoes.
    Raises StageError where an owned packet was not read, or one was read twice.
    """
    n = len(unit.packets.owned)
    times_read = np.zeros(n, np.int64)
    direction = np.zeros((n, 3))
    tables, nearest = [], [np.empty(0, np.int64)]
    for block, index, table in results:
        times_read += np.bincount(index, minlength=n)
        direction[index] = block.direction
        row = find_nearest(table.waveform, table.time, block.returns.waveform, block.returns.time)
        if np.any(row < 0):
            raise _bug(unit, "an echo lies in a packet of no point")
        nearest.append(block.returns.point[row])
        tables.append((replace(table, waveform=index[table.waveform].astype(np.int32)), 0))
    if np.any(times_read > 1) or np.any(unit.packets.owned & (times_read == 0)):
        raise _bug(unit, "its packets were not read exactly once each")
    table = EchoTable.concatenate(tables)
    if not tables:
        table = table.with_attributes(**{name: np.empty(0, "i8" if name == "point" else "f8") for name in NEEDED})
    order = np.argsort(table.waveform, kind="stable")
    return UnitEchoes(table.take(order), np.concatenate(nearest)[order], times_read > 0, direction)


def assemble_echoes(unit: Unit, echoes: UnitEchoes, layout: OutputLayout) -> tuple[np.ndarray, RunReport]:
    """A row per echo of the packets that the unit owns, and one per point that no echo matches; with the account.

    Rows are ordered by the packet's first point, then time; points without a packet stand at their own place. A return
    that no echo of its packet matches is passed through as it is: what the vendor saw there is flagged, not lost.
    """
    members = _join_points(unit)
    owned = np.append(unit.packets.owned, False)
    mine = np.flatnonzero(owned[echoes.table.waveform])
    table, nearest = echoes.table.take(mine), echoes.nearest[mine]
    point = table.attributes["point"]
    table = table.with_flags(EchoFlag.ADDED, point < 0)
    per_packet = np.append(table.count(len(owned) - 1), 0)
    found = np.zeros(len(members.index), bool)
    found[members.find(point[point >= 0])] = True
    rows = _place_rows(unit, members, table, np.where(point >= 0, point, nearest), found, owned)

    records = members.source[rows.source]
    xyz = np.stack([np.append(table.attributes[name], np.nan)[rows.echo] for name in "xyz"], axis=1)
    packet = np.where(rows.echo >= 0, np.append(table.waveform, -1)[rows.echo], members.packet[rows.source])
    direction = np.append(echoes.direction, np.zeros((1, 3)), axis=0)[packet]
    places = np.where(np.isnan(xyz), _coordinates(records, layout), xyz)
    number, total = _number_rows(find_pulses(unit.points["gps_time"])[rows.owner], places, direction, records, layout)
    flags = np.append(table.flags, np.uint16(0))[rows.echo] | rows.reason
    flags |= np.where(number > layout.max_return, np.uint16(EchoFlag.RETURN_LIMIT), np.uint16(0))

    output = layout.rows(
        records,
        xyz=xyz,
        return_number=number,
        number_of_returns=total,
        columns={**_columns(table, rows.echo), "echo_flags": flags},
        matched=(rows.echo < 0) | np.append(point >= 0, False)[rows.echo],
        time=np.append(table.time, np.nan)[rows.echo],
    )
    inside = owned[members.packet]
    report = _count_packets(unit, table, per_packet, owned)
    report += _count_returns(inside, per_packet[members.packet] > 0, found)
    return output, report + _count_rows(output, rows.reason, flags)


def assemble_returns(unit: Unit, echoes: UnitEchoes, layout: OutputLayout) -> tuple[np.ndarray, RunReport]:
    """A row per point of the unit, unchanged but for the columns of the echo that matches it; with the account."""
    if not echoes.read.all():
        raise _bug(unit, "a packet of its points was not read")
    table, n = echoes.table, len(unit.points)
    local = table.attributes["point"] - unit.start
    mine = np.flatnonzero((table.attributes["point"] >= 0) & (local >= 0) & (local < n))
    echo = np.full(n, -1, np.int64)
    echo[local[mine]] = mine
    found = echo >= 0
    if np.count_nonzero(found) != len(mine) or np.any(unit.packet_of_point[local[mine]] != table.waveform[mine]):
        raise _bug(unit, "echoes and returns are not matched one to one")
    reason = np.where(unit.point_flags > 0, unit.point_flags, np.uint16(EchoFlag.NO_ECHO)).astype(np.uint16)
    flags = np.where(found, np.append(table.flags, np.uint16(0))[echo], reason).astype(np.uint16)
    output = layout.rows(np.asarray(unit.points), columns={**_columns(table, echo), "echo_flags": flags})

    owned = np.append(unit.packets.owned, False)
    per_packet = np.append(table.count(len(owned) - 1), 0)
    inside = unit.packet_of_point >= 0
    has_echoes = per_packet[unit.packet_of_point] > 0
    report = _count_packets(unit, table.take(np.flatnonzero(owned[table.waveform])), per_packet, owned)
    report += _count_returns(inside, has_echoes, found)
    return output, report + _count_rows(output, np.where(found, np.uint16(0), reason), flags)


def _bug(unit: Unit, what: str) -> StageError:
    last = unit.start + len(unit.points) - 1
    return StageError(f"points {unit.start} to {last}: {what}; please report it as a bug")


def _join_points(unit: Unit) -> _Members:
    if np.any((unit.packet_of_point >= 0) != (unit.point_flags == 0)):
        raise _bug(unit, "a point has neither a packet nor a reason for that")
    own, index = np.asarray(unit.points), np.arange(unit.start, unit.start + len(unit.points), dtype=np.int64)
    source, packet = own, unit.packet_of_point
    if len(unit.context):
        source = np.concatenate([own, np.asarray(unit.context)])
        index = np.concatenate([index, unit.context_index])
        packet = np.concatenate([packet, unit.packet_of_context])
    return _Members(len(own), source, index, packet.astype(np.int64))


def _place_rows(
    unit: Unit, members: _Members, table: EchoTable, point: np.ndarray, found: np.ndarray, owned: np.ndarray
) -> _Rows:
    """Echoes, points without a packet, and points that no echo matches, in the order of the output."""
    missing = np.flatnonzero(unit.point_flags)
    silent = np.flatnonzero(owned[members.packet] & ~found)
    passed = np.concatenate([missing, silent])
    no_echo = np.full(len(silent), EchoFlag.NO_ECHO, np.uint16)
    owner = np.append(unit.packets.owner - unit.start, -1)
    owner = owner[np.concatenate([table.waveform, members.packet[passed]])]
    source = np.concatenate([members.find(point), passed])
    owner = np.where(owner < 0, source, owner)
    order = np.lexsort((np.concatenate([table.time, _locations(members.source[passed])]), owner))
    return _Rows(
        echo=np.concatenate([np.arange(len(table)), np.full(len(passed), -1)])[order],
        source=source[order],
        owner=owner[order],
        reason=np.concatenate([np.zeros(len(table), np.uint16), unit.point_flags[missing], no_echo])[order],
    )


def _number_rows(
    pulse: np.ndarray, xyz: np.ndarray, direction: np.ndarray, records: np.ndarray, layout: OutputLayout
) -> tuple[np.ndarray, np.ndarray]:
    """Return number and number of returns; pulses without any waveform keep the input's."""
    number, total, known = number_returns(pulse, xyz, direction)
    bits = records["bit_fields"].astype(np.int64)
    width = 4 if layout.source_format >= 6 else 3
    mask = (1 << width) - 1
    return np.where(known, number, bits & mask), np.where(known, total, (bits >> width) & mask)


def _locations(records: np.ndarray) -> np.ndarray:
    """Return locations [ns], for the order of points that share a packet; what is not a number comes first."""
    return np.nan_to_num(widen(records["return_point_wave_location"]) / PS_PER_NS, nan=-np.inf)


def _coordinates(records: np.ndarray, layout: OutputLayout) -> np.ndarray:
    counts = np.stack([records[name] for name in "XYZ"], axis=1)
    return counts * np.array(layout.scales) + np.array(layout.offsets)


def _columns(table: EchoTable, echo: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of the echoes at `echo`; not a number where it is -1."""
    values = {**table.attributes, "echo_time": table.time}
    return {name: np.append(v, v.dtype.type(np.nan))[echo] for name, v in values.items() if v.dtype.kind == "f"}


def _count_packets(unit: Unit, table: EchoTable, per_packet: np.ndarray, owned: np.ndarray) -> RunReport:
    """Counts of the unit's own points, of the packets it owns, and of their echoes, `table`."""
    counts = {
        "points_in": len(unit.points),
        "points_with_waveform": int(np.count_nonzero(unit.packet_of_point >= 0)),
        "points_without_waveform": int(np.count_nonzero(unit.point_flags & np.uint16(EchoFlag.NO_WAVEFORM))),
        "points_broken": int(np.count_nonzero(unit.point_flags & np.uint16(EchoFlag.BROKEN_PACKET))),
        "waveforms": int(np.count_nonzero(owned)),
        "echoes": len(table),
        "added_echoes": int(np.count_nonzero(table.attributes["point"] < 0)),
    }
    account = RunReport(counts=counts, no_data=count_reasons(table.attributes))
    return account + RunReport.of_echoes(per_packet[owned], table.amplitude, table.sigma)


def _count_returns(inside: np.ndarray, has_echoes: np.ndarray, found: np.ndarray) -> RunReport:
    """Counts of the points `inside` packets, by whether the packet has echoes and the point's own was found."""
    counts = {
        "matched_returns": int(np.count_nonzero(inside & found)),
        "no_echo_returns": int(np.count_nonzero(inside & ~has_echoes)),
        "unmatched_returns": int(np.count_nonzero(inside & has_echoes & ~found)),
    }
    return RunReport(counts=counts)


def _count_rows(output: np.ndarray, reason: np.ndarray, flags: np.ndarray) -> RunReport:
    return RunReport(counts={"points_out": len(output)}, passed_through=count_flags(reason), flags=count_flags(flags))
