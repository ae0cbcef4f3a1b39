"""Search for points of different units that share a packet: near the borders first, over the whole strip if needed.

The scan uses it. A unit needs the points of other units that share packets with its points: its context. The near
search compares each unit with a window of points before it. It also notes, for each bin of the packet file, the first
and the last point that refers to it: if these are closer than the window, nothing was missed. Only packets of the
other, suspect bins go through a sort on disk. Both searches must find the same groups; the tests compare them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.temp_store import Spool, spread_keys
from wavebatch.files.strip.packet_check import INDEX_BITS

WINDOW = 16_384
"""Points before a border that are compared with the unit after it; vendors write returns of a pulse together."""
MAX_RETURNS = 32
"""More points on one packet are damage: LAS has at most 15 returns."""
BINS = 1 << 18
"""Bins of the packet file: 5 MiB of memory."""
_LEAST_BIN = 64
_PER_BUCKET = 500_000
"""Keys that are sorted at a time, about 20 MB."""
_KEY = np.dtype([("key", "<u8"), ("index", "<i8")])
_WANT = np.dtype([("index", "<i8"), ("unit", "<i8")])


@dataclass(frozen=True, slots=True, eq=False)
class PacketGroups:
    """Entries sorted by key, then by place: group g is order[starts[g] : starts[g] + counts[g]]."""

    order: np.ndarray
    starts: np.ndarray
    counts: np.ndarray


def group_keys(keys: np.ndarray) -> PacketGroups:
    """Return the groups of equal keys (n,)."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    new = np.ones(len(keys), bool)
    new[1:] = ordered[1:] != ordered[:-1]
    starts = np.flatnonzero(new)
    return PacketGroups(order, starts, np.diff(np.append(starts, len(keys))))


def expand(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return start, start + 1, ..., start + count - 1 of all pairs in one array."""
    total = int(counts.sum())
    begin = np.cumsum(counts) - counts
    return np.arange(total) + np.repeat(starts - begin, counts)


def cross_units(groups: PacketGroups, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (unit, entry): the entry shares a key with entries of that unit, but lies in another unit.

    unit: unit of each entry (n,), ascending within a group.
    """
    lead = groups.starts
    last = lead + groups.counts - 1
    crossing = unit[groups.order[lead]] != unit[groups.order[last]]
    starts, counts = lead[crossing], groups.counts[crossing]
    members = groups.order[expand(starts, counts)]
    group = np.repeat(np.arange(len(starts)), counts)
    first = np.ones(len(members), bool)
    first[1:] = (group[1:] != group[:-1]) | (unit[members[1:]] != unit[members[:-1]])
    place = np.cumsum(counts) - counts
    targets, owners = unit[members[first]], group[first]
    rows = expand(place[owners], counts[owners])
    target = np.repeat(targets, counts[owners])
    away = unit[members[rows]] != target
    return target[away], members[rows[away]]


class NearSharing:
    """Near search: takes the strip unit by unit and collects what is shared across borders within the window."""

    def __init__(self, low: int, high: int, context: Spool) -> None:
        self._low = np.uint64(low)
        self._width = np.uint64(max(_LEAST_BIN, -(-(high - low) // BINS)))
        bins = (high - low) // int(self._width) + 1
        self._first = np.full(bins, -1, np.int64)
        self._last = np.full(bins, -1, np.int64)
        self._new = np.zeros(bins, np.int32)
        self._context = context
        self._lowest = 0
        """First of the bins that are kept."""
        self.reach = 0
        self.overfull: list[np.ndarray] = []

    def add(
        self, keys: np.ndarray, index: np.ndarray, unit: np.ndarray, own: np.ndarray, records: Callable
    ) -> PacketGroups:
        """Take one unit with the window before it and return the groups of its keys.

        Parameters
        ----------
        keys : u8 (n,)
            Keys of usable packets; see `packet_check.Judged`.
        index, unit : i8 (n,)
            Ascending file index, and number of the unit.
        own : bool (n,)
            Whether the point belongs to this unit, not to the window.
        records : function
            From row numbers to the entries of these points for the context.
        """
        groups = group_keys(keys)
        first, last = groups.order[groups.starts], groups.order[groups.starts + groups.counts - 1]
        current = own[last]
        if current.any():
            self.reach = max(self.reach, int((index[last] - index[first])[current].max()))
        self._mark(keys, index, own, first[current & own[first]])
        self.overfull.append(keys[first[groups.counts > MAX_RETURNS]])
        target, member = cross_units(groups, unit)
        here = unit[-1] if len(unit) else -1
        fresh = own[member] | (target == here)
        self._context.append(target[fresh], records(member[fresh]))
        return groups

    def _mark(self, keys: np.ndarray, index: np.ndarray, own: np.ndarray, new: np.ndarray) -> None:
        place = self._bin(keys[own])
        where = index[own]
        self._last[place] = where
        fresh = place[::-1]
        unseen = self._first[fresh] < 0
        self._first[fresh[unseen]] = where[::-1][unseen]
        fresh = self._bin(keys[new])
        if not len(fresh):
            return
        low, high = int(fresh.min()), int(fresh.max())
        if high - low < 8 * len(fresh):  # as nearly always: packets follow the points, and counting takes a tenth
            self._new[low : high + 1] += np.bincount(fresh - low).astype(np.int32)
        else:
            np.add.at(self._new, fresh, 1)

    def _bin(self, keys: np.ndarray) -> np.ndarray:
        return (((keys >> INDEX_BITS) - self._low) // self._width).astype(np.int64)

    def __getstate__(self) -> dict[str, object]:
        """Only bins that points refer to: a part of a strip has few of them."""
        used = np.flatnonzero(self._first >= 0)
        low, high = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 0)
        bins = {name: getattr(self, name)[low:high] for name in ("_first", "_last", "_new")}
        return {**self.__dict__, **bins, "_lowest": self._lowest + low, "_context": None}

    def join(self, other: NearSharing) -> None:
        """Add what another process found in the units that follow; it has compared them with those before them."""
        here = slice(other._lowest, other._lowest + len(other._first))
        for name, least in (("_first", True), ("_last", False)):
            mine, theirs = getattr(self, name)[here], getattr(other, name)
            change = (theirs >= 0) & ((mine < 0) if least else True)
            mine[change] = theirs[change]
        self._new[here] += other._new
        self.reach = max(self.reach, other.reach)
        self.overfull += other.overfull

    def suspects(self) -> np.ndarray:
        """Return for each bin whether its points lie too far apart for the window."""
        return (self._last - self._first) >= WINDOW

    def is_suspect(self, keys: np.ndarray, suspects: np.ndarray) -> np.ndarray:
        """Return whether keys (n,) lie in suspect bins, bool (n,)."""
        return suspects[self._bin(keys)]

    def count_packets(self, suspects: np.ndarray) -> int:
        """Return the number of different packets in all other bins."""
        return int(self._new[~suspects].sum())


def find_far(
    units: Iterable[tuple[np.ndarray, np.ndarray]], count: int, borders: np.ndarray
) -> tuple[Spool, int, int, np.ndarray]:
    """Far search among all keys of `units`, as (keys, file index), `count` in all, in bounded memory.

    Returns for each unit which of its points which other unit needs, the number of packets, how far apart points of a
    packet lie, and the keys of overfull packets.
    """
    buckets = count // _PER_BUCKET + 1
    spool = Spool(buckets, _KEY)
    wants = Spool(len(borders) - 1, _WANT)
    packets, reach, overfull = 0, 0, []
    try:
        for keys, index in units:
            entries = np.empty(len(keys), _KEY)
            entries["key"], entries["index"] = keys, index
            spool.append(spread_keys(keys, buckets), entries)
        spool.seal()
        for bucket in range(buckets):
            entries = _read_bucket(spool, bucket)
            groups = group_keys(entries["key"])
            packets += len(groups.starts)
            if len(entries):
                lead, tail = groups.order[groups.starts], groups.order[groups.starts + groups.counts - 1]
                reach = max(reach, int((entries["index"][tail] - entries["index"][lead]).max()))
                overfull.append(entries["key"][lead[groups.counts > MAX_RETURNS]])
            unit = np.searchsorted(borders, entries["index"], "right") - 1
            target, member = cross_units(groups, unit)
            asked = np.empty(len(target), _WANT)
            asked["index"], asked["unit"] = entries["index"][member], target
            wants.append(unit[member], asked)
    except BaseException:
        wants.close()
        raise
    finally:
        spool.close()
    return wants.seal(), packets, reach, np.concatenate([np.empty(0, np.uint64), *overfull])


def _read_bucket(spool: Spool, bucket: int) -> np.ndarray:
    """Entries of a bucket in file order; of overfull packets only the first ones, enough to know them."""
    held = np.empty(0, _KEY)
    for part in spool.pieces(bucket):
        held = np.concatenate([held, part])
        groups = group_keys(held["key"])
        if (groups.counts > MAX_RETURNS + 1).any():
            keep = groups.order[expand(groups.starts, np.minimum(groups.counts, MAX_RETURNS + 1))]
            held = held[np.sort(keep)]
    return held
