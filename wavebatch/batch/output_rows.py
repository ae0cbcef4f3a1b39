"""The output rows of a unit: one per echo or per return, with return numbers and the points that pass through.

`unit.process_unit` calls `gather_echoes`, then `assemble_echoes` or `assemble_returns` (--points).
Points of several units can share a packet. The unit that holds the packet's first point owns it and writes its echoes;
before you change anything here, make sure that each packet and each point still has exactly one owner.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.batch.counts import RunReport, count_flags
from wavebatch.core.echoes import COLUMNS, EchoFlag, EchoTable, count_reasons
from wavebatch.core.errors import StageError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import find_order
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.disk.raw_bytes import take_whole_records, widen_integers
from wavebatch.files.las.header import GROUND, locate, read_classes, read_scanner, split_numbers
from wavebatch.kernels.geometry.group_returns import (
    along_ray,
    find_nearest,
    find_pulses,
    find_rays,
    group_times,
    match_returns,
    number_returns,
)
from wavebatch.surveying.look import kind_of

if TYPE_CHECKING:
    from wavebatch.files.cloud.writer import OutputLayout
    from wavebatch.files.las.header import LasHeader
    from wavebatch.files.strip.reader import Unit
    from wavebatch.surveying.systems.figures import Kind

_REFLECTING = ("level_reflectance", "facing_reflectance")
"""Columns that no matt surface has above 1."""

NEEDED = ("x", "y", "z", "point")
"""Attribute columns that every point needs."""


@frozen(eq=False)
class UnitEchoes:
    """The echoes of all packets that a unit read."""

    table: EchoTable
    """`waveform` is the row of unit.packets; sorted by waveform, then time."""
    nearest: np.ndarray
    """Index in the file of each echo's return; of an echo without one, the nearest of its packet, i8 (m,)."""
    read: np.ndarray
    """Whether a packet of the unit was read, bool (packets,)."""
    direction: np.ndarray
    """Away from the sensor, per packet [m/ns], f8 (packets, 3)."""
    origin: np.ndarray
    """Position of the first sample of each packet from the raw return location [m], f8 (packets, 3)."""
    digitizer: np.ndarray
    """Descriptor of each packet, u1 (packets,); the first of those that differ in their number of samples only, as some
    sensors have one per length. Two of one length are two channels."""


@frozen(eq=False)
class _Members:
    """Points of the unit, then the points of other units that share its packets."""

    own: int
    """Number of the unit's points."""
    source: np.ndarray
    """Their records."""
    index: np.ndarray
    """Their positions in the file, i8 (k,)."""
    packet: np.ndarray
    """Row of unit.packets, -1 for none, i8 (k,)."""

    def find(self, index: np.ndarray) -> np.ndarray:
        """Return the rows of the points at `index` in the file; raises StageError where one is missing."""
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


class Assembled(NamedTuple):
    """The rows of a unit."""

    rows: np.ndarray
    """Structured array (m,) in the cloud's layout."""
    echo: np.ndarray
    """Row of the unit's echo table, -1 for points that are passed through, i8 (m,)."""
    columns: Mapping[str, np.ndarray]
    """The columns that were asked for as they were computed, arrays (m,), and echo_flags."""
    counted: np.ndarray
    """Echoes of the table that count in this unit, bool (k,)."""
    report: RunReport
    """Without the counts of what is written, which the selection adds."""


def gather_echoes(unit: Unit, results: Iterable[tuple[WaveformBlock, np.ndarray, EchoTable]]) -> UnitEchoes:
    """Collect the echoes of a unit's blocks in packet order.

    Parameters
    ----------
    unit : Unit
    results : iterable of (WaveformBlock, ndarray, EchoTable)
        Block, row of unit.packets per waveform i8 (n,), and the block's echoes.

    Returns
    -------
    UnitEchoes

    Raises
    ------
    StageError
        Where an owned packet was not read, or a packet was read twice.
    """
    n = len(unit.packets.owned)
    times_read = np.zeros(n, np.int64)
    direction, origin, digitizer = np.zeros((n, 3)), np.zeros((n, 3)), unit.packets.digitizer.copy()
    tables, nearest = [], [np.empty(0, np.int64)]
    kinds: dict[Kind, dict[int, int]] = {}
    for block, index, table in results:
        one, lengths = block.digitizer, kinds.setdefault(kind_of(block), {})
        lengths[one.index] = max(one.n_samples, lengths.get(one.index, 0))
        times_read += np.bincount(index, minlength=n)
        direction[index], origin[index] = block.direction, block.origin
        near = table.attributes["point"].astype(np.int64)
        free = np.flatnonzero(near < 0)
        returns = block.returns
        if returns is None:
            raise _bug(unit, "a block has no returns")
        row = find_nearest(table.waveform[free], table.time[free], returns.waveform, returns.time)
        if np.any(row < 0):
            raise _bug(unit, "an echo lies in a packet of no point")
        near[free] = returns.point[row]
        nearest.append(near)
        tables.append((replace(table, waveform=index[table.waveform].astype(np.int32)), 0))
    if np.any(times_read > 1) or np.any(unit.packets.owned & (times_read == 0)):
        raise _bug(unit, "its packets were not read exactly once each")
    table = EchoTable.concatenate(tables)
    if not tables:
        table = table.with_attributes(**{name: np.empty(0, "i8" if name == "point" else "f8") for name in NEEDED})
    near = np.concatenate(nearest)
    if np.any(np.diff(table.waveform) < 0):  # blocks of several digitizers or lengths
        order = np.argsort(table.waveform, kind="stable")
        table, near = table.take(order), near[order]
    for lengths in kinds.values():
        if len(set(lengths.values())) == len(lengths):
            digitizer[np.isin(digitizer, list(lengths))] = min(lengths)
    return UnitEchoes(table, near, times_read > 0, direction, origin, digitizer)


def assemble_echoes(
    unit: Unit, echoes: UnitEchoes, layout: OutputLayout, needed: Collection[str] = (), dropped: int = 0
) -> Assembled:
    """Make a row per echo, and a row per point that no echo matches.

    Parameters
    ----------
    unit : Unit
    echoes : UnitEchoes
        Of the packets that the unit owns, and of no others.
    layout : OutputLayout
    needed : collection of str, optional
        Columns to give beside those of the layout.
    dropped : int, optional
        EchoFlag bits of rows that will not be written: return numbers are counted without them.

    Returns
    -------
    Assembled
        Ordered by the packet's first point, then time; points without a packet keep their place.

    Raises
    ------
    StageError
        Where echoes and points do not fit together.

    Notes
    -----
    A return that no echo of its packet matches is passed through with a flag, so that no return of the vendor is lost.
    A return without a packet takes the added echo at its place, which another packet of its pulse shows.
    Index -1 means none: `np.append(x, y)[index]` gives y there, the last element.
    """
    if np.any((unit.packet_of_point >= 0) != (unit.point_flags == 0)):
        raise _bug(unit, "a point has neither a packet nor a reason for that")
    own, index = np.asarray(unit.points), np.arange(unit.start, unit.start + len(unit.points), dtype=np.int64)
    source, packet = own, unit.packet_of_point
    if len(unit.context):
        source = np.concatenate([own, np.asarray(unit.context)])
        index = np.concatenate([index, unit.context_index])
        packet = np.concatenate([packet, unit.packet_of_context])
    members = _Members(len(own), source, index, packet.astype(np.int64))
    owned = np.append(unit.packets.owned, False)
    if not owned[echoes.table.waveform].all():
        raise _bug(unit, "an echo lies in a packet of another unit")
    pulse = _find_pulses(unit, echoes, layout.source.header)
    counted = ~_find_copies(unit, echoes, pulse)
    written = np.flatnonzero(counted)
    table = _match_alone(unit, echoes, pulse, counted, layout.source.header)
    point = table.attributes["point"]
    nearest = np.where(point >= 0, point, echoes.nearest)
    found = np.zeros(len(members.index), bool)
    found[members.find(point[point >= 0])] = True
    # Passed through: points without a usable packet or echo, and points of owned packets that no echo matches.
    missing = np.flatnonzero((unit.point_flags > 0) & ~found[: len(own)])
    silent = np.flatnonzero(owned[members.packet] & ~found)
    passed = np.concatenate([missing, silent])
    no_echo = np.full(len(silent), EchoFlag.NO_ECHO, np.uint16)
    # Rows are sorted by the first point of their packet, or by their point where they have no packet.
    owner = np.append(unit.packets.owner - unit.start, -1)
    owner = owner[np.concatenate([table.waveform[written], members.packet[passed]])]
    source = np.concatenate([members.find(nearest[written]), passed])
    owner = np.where(owner < 0, source, owner)
    # Points that share a packet are sorted by their return locations; NaN comes first.
    located = widen_integers(members.source["return_point_wave_location"][passed]) / PS_PER_NS
    order: Any = find_order(owner, np.concatenate([table.time[written], np.nan_to_num(located, nan=-np.inf)]))
    order = slice(None) if order is None else order
    # Rows in the order of the output: their echo or -1, their point, the point that owns their packet, and their flags.
    echo = np.concatenate([written, np.full(len(passed), -1)])[order]
    source, owner = source[order], owner[order]
    reason = np.concatenate([np.zeros(len(written), np.uint16), unit.point_flags[missing], no_echo])[order]
    records = take_whole_records(members.source, source)
    xyz = np.stack([np.append(table.attributes[name], np.nan)[echo] for name in "xyz"], axis=1)
    packet = np.where(echo >= 0, np.append(table.waveform, -1)[echo], members.packet[source])
    direction = np.append(echoes.direction, np.zeros((1, 3)), axis=0).take(packet, axis=0)
    absent = np.isnan(xyz)
    # For all rows at once: to take those that are passed through takes longer than to locate the others too.
    places = np.where(absent, locate(records, layout.source.header), xyz) if absent.any() else xyz
    flags = np.append(table.flags, np.uint16(0))[echo] | reason
    # Pulses without any waveform, rows that are not written, and points that are stored twice keep the input's numbers.
    number, total = (given.astype(np.int64) for given in split_numbers(records))
    kept = ((flags & np.uint16(dropped)) == 0) & ~((echo < 0) & _find_repeated(members, silent, found)[source])
    at: Any = slice(None) if kept.all() else np.flatnonzero(kept)
    numbers, count, known = number_returns(pulse[owner][at], places[at], direction[at])
    number[at] = np.where(known, numbers, number[at])
    total[at] = np.where(known, count, total[at])
    flags |= np.where(number > layout.max_return, np.uint16(EchoFlag.RETURN_LIMIT), np.uint16(0))

    columns = {**_columns(table, echo, layout, needed), "echo_flags": flags}
    output = layout.rows(
        records,
        xyz=xyz,
        return_number=number,
        number_of_returns=total,
        columns=columns,
        matched=(echo < 0) | np.append(point >= 0, False)[echo],
        time=np.append(table.time, np.nan)[echo],
    )
    report = _count(unit, table, counted, members.source, members.packet, found, owned[members.packet], reason)
    return Assembled(output, echo, columns, counted, replace(report, copied_echoes=len(table) - len(written)))


def assemble_returns(
    unit: Unit, echoes: UnitEchoes, layout: OutputLayout, needed: Collection[str] = ()
) -> Assembled:
    """Make a row per point of the unit, with the columns of the echo that matches it.

    Parameters
    ----------
    unit : Unit
    echoes : UnitEchoes
        Of all packets of the unit's points.
    layout : OutputLayout
    needed : collection of str, optional
        Columns to give beside those of the layout.

    Returns
    -------
    Assembled
        In the order of the points; standard fields are unchanged.

    Raises
    ------
    StageError
        Where a packet was not read, or echoes and returns are not matched one to one.
    """
    if not echoes.read.all():
        raise _bug(unit, "a packet of its points was not read")
    pulse, n = _find_pulses(unit, echoes, layout.source.header), len(unit.points)
    repeated = _find_copies(unit, echoes, pulse)
    table = _match_alone(unit, echoes, pulse, ~repeated, layout.source.header)
    local = table.attributes["point"] - unit.start
    mine = np.flatnonzero((table.attributes["point"] >= 0) & (local >= 0) & (local < n))
    echo = np.full(n, -1, np.int64)
    echo[local[mine]] = mine
    found = echo >= 0
    strange = (unit.packet_of_point[local[mine]] != table.waveform[mine]) & (unit.point_flags[local[mine]] == 0)
    if np.count_nonzero(found) != len(mine) or strange.any():
        raise _bug(unit, "echoes and returns are not matched one to one")
    reason = np.where(unit.point_flags > 0, unit.point_flags, np.uint16(EchoFlag.NO_ECHO)).astype(np.uint16)
    flags = np.where(found, np.append(table.flags, np.uint16(0))[echo], reason).astype(np.uint16)
    columns = {**_columns(table, echo, layout, needed), "echo_flags": flags}
    output = layout.rows(np.asarray(unit.points), columns=columns)

    packet = unit.packet_of_point
    # An echo counts in the unit of its point, where the second pass has seen it; without one in that of its packet.
    counted = unit.packets.owned[table.waveform] & (table.attributes["point"] < 0)
    copied = counted & repeated
    counted[copied], counted[mine] = False, True
    rest = np.where(found, np.uint16(0), reason)
    report = _count(unit, table, counted, unit.points, packet, found, packet >= 0, rest)
    report = replace(report, copied_echoes=int(copied.sum()))
    return Assembled(output, echo, columns, counted, report)


def _bug(unit: Unit, what: str) -> StageError:
    last = unit.start + len(unit.points) - 1
    return StageError(f"points {unit.start} to {last}: {what}; please report it as a bug")


def _find_repeated(members: _Members, silent: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Which of the returns without an echo repeat another one of their packet, bool (members,)."""
    repeated, near = np.zeros(len(found), bool), np.zeros(max(members.packet.max(initial=-1), 0) + 2, bool)
    near[members.packet[silent]] = True
    rows = np.flatnonzero(near[members.packet])
    fields = [members.source[name][rows] for name in ("return_point_wave_location", *"XYZ")]
    order = np.lexsort((~found[rows], *fields, members.packet[rows]))
    table = [values[order] for values in (members.packet[rows], *fields)]
    repeated[rows[order[1:]]] = np.all([values[1:] == values[:-1] for values in table], axis=0)
    return repeated & ~found


def _find_pulses(unit: Unit, echoes: UnitEchoes, header: LasHeader) -> np.ndarray:
    """First point of the pulse of each point of the unit that owns a packet or has none, i8 (n,).

    Points of equal time and scanner on one line are a pulse, wherever they stand in the unit: lasers may fire at the
    same time, times may be rounded, and points may be sorted.
    """
    time = unit.points["gps_time"]
    pulse = find_pulses(time)
    heads = time[pulse == np.arange(len(time))]
    if np.any(heads[1:] <= heads[:-1]):
        pulse = group_times(time)
    packet = np.full(len(time), -1)
    rows = np.flatnonzero(unit.packets.owned)
    packet[unit.packets.owner[rows] - unit.start] = rows
    lead = np.flatnonzero((packet >= 0) | (unit.point_flags > 0))
    number = np.bincount(pulse[lead], minlength=len(time))
    # Points without a packet have no ray: they belong to the pulse if they lie on the ray of a packet of their group.
    known = np.full(len(time), -1)
    owners = lead[packet[lead] >= 0][::-1]
    known[pulse[owners]] = packet[owners]
    lead = lead[(number[pulse[lead]] > 1) & (known[pulse[lead]] >= 0)]
    points = take_whole_records(unit.points, lead)
    scanner = read_scanner(points)
    scanner = np.zeros(len(lead), np.uint8) if scanner is None else scanner
    step = echoes.direction[np.where(packet[lead] >= 0, packet[lead], known[pulse[lead]])]
    pulse[lead] = lead[find_rays(pulse[lead], scanner, locate(points, header), step)]
    return pulse


def _match_alone(
    unit: Unit, echoes: UnitEchoes, pulse: np.ndarray, counted: np.ndarray, header: LasHeader
) -> EchoTable:
    """The echoes, with points that have no packet as the returns of added ones that a packet of their pulse shows.

    Some strips have a packet for one return of a pulse only: the other returns were in the cloud twice. Vendors place
    returns within a pulse's width of their echoes.
    """
    table, point = echoes.table, echoes.table.attributes["point"].copy()
    owned = unit.packets.owned[table.waveform]
    group = pulse[np.where(owned, unit.packets.owner[table.waveform] - unit.start, 0)]
    head = np.full(len(pulse), -1)
    head[group[owned]] = table.waveform[owned]
    alone = np.flatnonzero((unit.point_flags == EchoFlag.NO_WAVEFORM) & (head[pulse] >= 0))
    free = np.flatnonzero(owned & counted & (point < 0))
    if len(alone) and len(free):
        sides = []
        for of, places in (
            (group[free], np.stack([table.attributes[name][free] for name in "xyz"], axis=1)),
            (pulse[alone], locate(take_whole_records(unit.points, alone), header)),
        ):
            time = along_ray(places, echoes.origin[head[of]], echoes.direction[head[of]])
            order = np.lexsort((time, of))
            sides.append((order, of[order], time[order]))
        (mine, echo_pulse, echo_time), (theirs, point_pulse, point_time) = sides
        match = match_returns(echo_pulse, echo_time, point_pulse, point_time, np.inf)
        pairs = np.flatnonzero(match >= 0)
        pairs = pairs[np.abs(echo_time[pairs] - point_time[match[pairs]]) <= table.sigma[free[mine[pairs]]]]
        point[free[mine[pairs]]] = unit.start + alone[theirs[match[pairs]]]
        table = replace(table.with_attributes(point=point), flags=table.flags & ~np.uint16(EchoFlag.ADDED))
    return table.with_flags(EchoFlag.ADDED, point < 0)


def find_shared(unit: Unit, echoes: UnitEchoes, header: LasHeader) -> np.ndarray:
    """Find the echoes that share their pulse with echoes of another one of its packets: bool (k,).

    Some files have a packet for each return, in which its echo seems to be alone.
    """
    table, packets, shared = echoes.table, unit.packets, np.zeros(len(echoes.table), bool)
    rows = np.flatnonzero(packets.owned)
    key = np.full(len(packets), -1)
    pulse = _find_pulses(unit, echoes, header)[packets.owner[rows] - unit.start]
    key[rows] = 256 * pulse + echoes.digitizer[rows]
    own = np.flatnonzero(key[table.waveform] >= 0)
    packet = table.waveform[own]
    first, group = np.unique(key[packet], return_index=True, return_inverse=True)[1:]
    head = packet[first][group]
    time = table.time[own] + along_ray(echoes.origin[packet], echoes.origin[head], echoes.direction[head])
    early, late = np.full(len(first), np.inf), np.full(len(first), -np.inf)
    np.minimum.at(early, group, time + table.sigma[own])
    np.maximum.at(late, group, time - table.sigma[own])
    shared[own] = (late > early)[group]
    return shared


CUT_REACH = 3.0
"""Widths (standard deviations) from the top of a pulse to where it is below a hundredth of its height: an echo that a
packet still shows has its top so far outside at most."""


def _find_copies(unit: Unit, echoes: UnitEchoes, pulse: np.ndarray) -> np.ndarray:
    """Which echoes without a return another packet of their pulse and digitizer shows too, bool (k,).

    Packets of a pulse may overlap, and some files have one for each return: each of them shows the same echoes, of
    which that of a return counts, or that of the first packet. No decomposer parts echoes within a pulse's width. Where
    a packet cuts an echo, another one shows it whole, CUT_REACH widths away at most.
    """
    table, packets = echoes.table, unit.packets
    copied, key = np.zeros(len(table), bool), np.full(len(packets), -1)
    rows = np.flatnonzero(packets.owned)
    key[rows] = pulse[packets.owner[rows] - unit.start]
    rows = rows[np.bincount(key[rows], minlength=len(pulse))[key[rows]] > 1]
    if not len(rows):
        return copied
    key = key * 256 + echoes.digitizer
    first, group = np.unique(key[rows], return_index=True, return_inverse=True)[1:]
    head, shift = rows[first][group], np.full(len(packets), np.nan)
    shift[rows] = along_ray(echoes.origin[rows], echoes.origin[head], echoes.direction[head])
    time = table.time + shift[table.waveform]
    left = table.attributes["point"] < 0
    edge = (table.flags & EchoFlag.NEAR_EDGE) != 0
    cut = left & edge
    at = np.flatnonzero(np.isfinite(time))
    at = at[np.lexsort((table.waveform[at], time[at], key[table.waveform[at]]))]
    pairs, behind = [np.empty((2, 0), np.int64)], 1
    while behind < len(at):
        one, other = at[:-behind], at[behind:]
        near = key[table.waveform[one]] == key[table.waveform[other]]
        if not near.any():  # no pulse has so many; what others have decides nothing
            break
        reach = np.minimum(table.sigma[one], table.sigma[other])
        for part, whole in ((one, other), (other, one)):
            reach = np.where(cut[part] & ~edge[whole], CUT_REACH * table.sigma[whole], reach)
        near &= time[other] - time[one] <= reach
        pairs.append(np.stack([one, other])[:, near & (table.waveform[one] != table.waveform[other])])
        behind += 1
    pair = np.concatenate(pairs, axis=1)
    rank = table.waveform[pair] + len(packets) * cut[pair]  # a cut echo counts last
    early, late = np.take_along_axis(pair, np.argsort(rank, axis=0), axis=0)
    for copy, of in ((late, early), (early, late)):
        copied[copy[left[copy] & (table.attributes["point"][of] >= 0)]] = True
    left &= ~copied  # what is a copy itself shows nothing
    copied[late[left[late] & left[early]]] = True
    return copied


def _columns(
    table: EchoTable, echo: np.ndarray, layout: OutputLayout, needed: Collection[str]
) -> dict[str, np.ndarray]:
    """The layout's columns and those needed of the echoes at `echo`; no-data where that is -1."""
    values = {**table.attributes, "echo_time": table.time}
    names = dict.fromkeys([*(written.column for written in layout.written), *needed])
    # Without any waveform a table has no attributes, but conditions ask for them.
    values |= {name: np.empty(0, COLUMNS[name].dtype) for name in needed if name not in values}
    return {name: spread(name, values[name], echo) for name in names if name in values}


def spread(name: str, values: np.ndarray, echo: np.ndarray) -> np.ndarray:
    """Return a column (m,) of rows from its values (k,) by echo; no-data where `echo` is -1."""
    # NaN becomes no-data when it is written. Integers have no NaN: they need the declared value itself.
    values = np.asarray(values)
    if values.dtype.kind != "f":
        values = values.astype(np.result_type(values, COLUMNS[name].dtype), copy=False)  # of a plug-in: any integers
    empty = np.nan if values.dtype.kind == "f" else COLUMNS[name].no_data or 0
    return np.append(values, values.dtype.type(empty))[echo]


STRETCH, STRAYED = 256, 0.65
"""Returns that follow each other, and share of them that match an echo below which they have stray locations: .97 to 1
do in real and simulated strips, and .74 of all where a tenth of the packets is weaker than the noise."""


def _count(
    unit: Unit,
    table: EchoTable,
    counted: np.ndarray,
    source: np.ndarray,
    packet: np.ndarray,
    found: np.ndarray,
    inside: np.ndarray,
    reason: np.ndarray,
) -> RunReport:
    """The report of a unit, without what is written of it.

    counted: echoes of the table (k,) that count in this unit.
    source, packet, found, inside: of the points (k,) that are counted as returns: records, row of unit.packets, whether
    an echo matches, whether it is counted. reason: of the output rows (m,).
    """
    owned = unit.packets.owned
    per_packet = np.append(table.count(len(owned)), 0)
    has_echoes = per_packet[packet] > 0
    table = table if counted.all() else table.take(counted)
    counts = {
        "points_in": len(unit.points),
        "points_with_waveform": (unit.packet_of_point >= 0) | found[: len(unit.points)],
        "points_without_waveform": ((unit.point_flags & EchoFlag.NO_WAVEFORM) > 0) & ~found[: len(unit.points)],
        "points_broken": unit.point_flags & np.uint16(EchoFlag.BROKEN_PACKET),
        "waveforms": owned,
        "echoes": len(table),
        "added_echoes": table.attributes["point"] < 0,
        "matched_returns": found & (inside | (packet < 0)),
        "no_echo_returns": inside & ~has_echoes,
        "unmatched_returns": inside & has_echoes & ~found,
    }
    parts = found[inside & has_echoes]
    parts = parts[: len(parts) // STRETCH * STRETCH].reshape(-1, STRETCH).mean(axis=1)
    above = np.any([table.attributes[name] > 1 for name in _REFLECTING if name in table.attributes], axis=0)
    report = RunReport(
        counts={name: n if isinstance(n, int) else int(np.count_nonzero(n)) for name, n in counts.items()},
        passed_through=count_flags(reason),
        no_data=count_reasons(table.attributes),
        above_one=int(np.count_nonzero(above)),
        ground_points=int(np.count_nonzero(read_classes(unit.points) == GROUND)),
        strayed_returns=STRETCH * int(np.count_nonzero(parts < STRAYED)),
        unseen_returns=int(np.count_nonzero(source["intensity"][inside & ~has_echoes])),
    )
    return report + RunReport.of_echoes(per_packet[:-1][owned], table.amplitude, table.sigma)
