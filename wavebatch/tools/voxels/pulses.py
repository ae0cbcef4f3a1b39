"""The packets of a strip in batches in which those of one pulse are together.

`strip.voxelize_strip` and `light.find_rule` read a strip with it. A pulse's packets lie in one unit or in two that
follow each other, in any order; the batches do not depend on processes, and results must not depend on batches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from wavebatch.files.cloud.point_filter import PlannedFilter
from wavebatch.files.las.point_formats import locate
from wavebatch.files.strip.reader import StripReader, StripScan, Unit, read_scanner
from wavebatch.kernels.geometry.group_returns import LONGEST_PULSE, group_times

BATCH_SAMPLES = 1 << 20
"""Samples read at a time."""

LOST = np.dtype([("time", "f8"), ("group", "i8"), ("scanner", "u1"), ("place", "f8", 3)])
"""Returns whose packet is missing or broken."""


class Batch(NamedTuple):
    """Packets of whole pulses."""

    parts: list[tuple[Unit, np.ndarray, np.ndarray, np.ndarray]]
    """Units, rows of their packets, the index in the file of the first packet of equal time of each, and whether `keep`
    keeps a point of it.
    """
    lost: np.ndarray
    """Returns of these pulses whose packet is missing or broken, LOST (k,)."""


def read_batches(
    reader: StripReader,
    scan: StripScan,
    *,
    numbers: Sequence[int] | None = None,
    choose: Callable[[np.ndarray], np.ndarray] | None = None,
    keep: PlannedFilter | None = None,
    block_size: int | None = None,
) -> Iterator[Batch]:
    """Yield all packets of a strip, or of the units `numbers`, in batches.

    choose: of the groups of a unit, those to read. keep: of points; only groups with such a point are read.
    block_size: packets per batch; as many as have BATCH_SAMPLES if not given. A batch ends with its last pulse.
    """
    units: dict[int, Unit] = {}
    lost: dict[int, np.ndarray] = {}
    taken = np.empty(0, np.int64)
    for number in range(reader.unit_count()) if numbers is None else numbers:
        near = [one for one in (number, number + 1) if one < reader.unit_count()]
        units = {one: units.get(one) or reader.read_unit(one, scan) for one in near}
        lost = {one: lost.get(one, np.empty(0, LOST)) for one in (number - 1, *near)}
        lost |= {one: _list_lost(reader, unit) for one, unit in units.items() if not len(lost[one])}
        rows = [np.flatnonzero(unit.packets.owned) for unit in units.values()]
        rows[0] = rows[0][~np.isin(units[number].packets.owner[rows[0]], taken)]
        tables = list(zip(units.values(), rows, strict=True))
        owner = np.concatenate([unit.packets.owner[some] for unit, some in tables])
        time = np.concatenate([unit.points["gps_time"][unit.packets.owner[some] - unit.start] for unit, some in tables])
        group = group_times(time)
        here = np.flatnonzero(group < len(rows[0]))
        taken = owner[here[here >= len(rows[0])]]
        known = _match_lost(np.concatenate(list(lost.values())), time, owner)
        kept = np.ones(len(owner), bool)
        if keep is not None:
            kept = np.concatenate([_choose_packets(unit, keep)[some] for unit, some in tables])
            here = here[np.isin(group[here], group[kept])]
        if choose is not None:
            here = here[np.isin(group[here], choose(np.unique(group[here])))]
        here = here[np.argsort(group[here], kind="stable")]
        cost = np.concatenate([unit.packets.n_samples[some] for unit, some in tables])[here]
        cost, limit = (np.maximum(cost, 1), BATCH_SAMPLES) if block_size is None else (np.ones(len(here)), block_size)
        starts = np.append(True, np.diff(group[here]) != 0)[: len(here)]
        before = (np.cumsum(cost) - cost)[np.flatnonzero(starts)] // limit
        for some in np.split(here, np.flatnonzero(np.diff(before[np.cumsum(starts) - 1])) + 1):
            groups = owner[group[some]]
            parts = []
            for (unit, mine), shift in zip(tables, (0, len(rows[0])), strict=False):
                inside = (some >= shift) & (some < shift + len(mine))
                parts.append((unit, mine[some[inside] - shift], groups[inside], kept[some[inside]]))
            if len(some):
                yield Batch(parts, known[np.isin(known["group"], groups)])


def _list_lost(reader: StripReader, unit: Unit) -> np.ndarray:
    """The returns of a unit without a packet that can be read."""
    points = unit.points[unit.packet_of_point < 0]
    lost = np.zeros(len(points), LOST)
    lost["time"], lost["place"] = points["gps_time"], locate(points, reader.facts.header)
    scanner = read_scanner(points)
    lost["scanner"] = 0 if scanner is None else scanner
    return lost


def _match_lost(lost: np.ndarray, time: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Those of equal time with packets, with their group."""
    values, first, count = np.unique(time, return_index=True, return_counts=True)
    if not len(values):
        return lost[:0]
    at = np.minimum(np.searchsorted(values, lost["time"]), len(values) - 1)
    lost["group"] = owner[first[at]]
    return lost[(values[at] == lost["time"]) & (lost["time"] != 0) & (count[at] < LONGEST_PULSE)]


def _choose_packets(unit: Unit, keep: PlannedFilter) -> np.ndarray:
    """Whether a point of each packet of the unit is kept, bool (packets,)."""
    chosen = np.zeros(len(unit.packets.owned) + 1, bool)
    chosen[unit.packet_of_point[keep.test(unit.points, len(unit.points)) == 0]] = True
    if len(unit.context):
        chosen[unit.packet_of_context[keep.test(unit.context, len(unit.context)) == 0]] = True
    return chosen[:-1]  # the last one is that of points without a packet, -1
