"""Which points share a packet: looked for near the borders of the units first, over the whole strip only where needed.

A unit needs the points of other units that share packets with its own: its context. While the strip is read in order,
points within a window before each border are compared with the unit behind it. At the same time every part of the
packet file remembers the first and the last point that refers to it; where these lie closer together than the window,
nothing can have been missed. Only packets in other parts go through the disk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.buckets import spread_keys
from wavebatch.files.disk.spool import Spool
from wavebatch.files.strip.packet_check import INDEX_BITS

WINDOW = 16_384
"""Points before a border among which shared packets are found while reading on."""
MAX_RETURNS = 32
"""More points than this on one packet are damage: LAS knows 15 returns."""
BINS = 1 << 18
_LEAST_BIN = 64
_PER_BUCKET = 500_000
_KEY = np.dtype([("key", "<u8"), ("index", "<i8")])
_WANT = np.dtype([("index", "<i8"), ("unit", "<i8")])


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Entries sorted by key, then place: group g is order[starts[g]:starts[g] + counts[g]]."""

    order: np.ndarray
    starts: np.ndarray
    counts: np.ndarray


def group_keys(keys: np.ndarray) -> Groups:
    """Groups of equal keys (n,)."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    new = np.ones(len(keys), bool)
    new[1:] = ordered[1:] != ordered[:-1]
    starts = np.flatnonzero(new)
    return Groups(order, starts, np.diff(np.append(starts, len(keys))))


def expand(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """All of start, start + 1 ... start + count - 1 for every pair, one after the other."""
    total = int(counts.sum())
    begin = np.cumsum(counts) - counts
    return np.arange(total) + np.repeat(starts - begin, counts)


def cross_units(groups: Groups, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (unit, entry): the entry shares a key with entries of that unit, but lies in another.

    unit: of every entry (n,), growing within a group.
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
    """Follows the strip unit by unit and collects what is shared across borders within the window."""

    def __init__(self, low: int, high: int, context: Spool) -> None:
        self._low = np.uint64(low)
        self._width = np.uint64(max(_LEAST_BIN, -(-(high - low) // BINS)))
        bins = (high - low) // int(self._width) + 1
        self._first = np.full(bins, -1, np.int64)
        self._last = np.full(bins, -1, np.int64)
        self._new = np.zeros(bins, np.int32)
        self._context = context
        self.reach = 0
        self.overfull: list[np.ndarray] = []

    def add(self, keys: np.ndarray, index: np.ndarray, unit: np.ndarray, own: np.ndarray, records: Callable) -> Groups:
        """Takes one unit with the window before it: keys (n,), ascending file index, unit and whether it is this one's.

        records(rows) gives the entries of `context` for some of the n points. Returns the groups.
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
        np.add.at(self._new, self._bin(keys[new]), 1)

    def _bin(self, keys: np.ndarray) -> np.ndarray:
        return (((keys >> INDEX_BITS) - self._low) // self._width).astype(np.int64)

    def suspects(self) -> np.ndarray:
        """Parts of the packet file whose points lie too far apart for the window: bool per part."""
        return (self._last - self._first) >= WINDOW

    def is_suspect(self, keys: np.ndarray, suspects: np.ndarray) -> np.ndarray:
        """Whether keys (n,) lie in such a part."""
        return suspects[self._bin(keys)]

    def count_packets(self, suspects: np.ndarray) -> int:
        """Different packets in all other parts."""
        return int(self._new[~suspects].sum())


@dataclass(frozen=True, slots=True, eq=False)
class FarSharing:
    """What the packets of suspect parts turned out to be."""

    wants: Spool
    """Per unit: which of its points which other unit needs."""
    packets: int
    reach: int
    overfull: np.ndarray


def find_far(units: Iterable[tuple[np.ndarray, np.ndarray]], count: int, borders: np.ndarray) -> FarSharing:
    """Sharing among all keys that `units` give as (keys, file index), `count` in all, in bounded memory."""
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
            _append_wants(wants, groups, entries["index"], borders)
    except BaseException:
        wants.close()
        raise
    finally:
        spool.close()
    return FarSharing(wants.seal(), packets, reach, np.concatenate([np.empty(0, np.uint64), *overfull]))


def _append_wants(wants: Spool, groups: Groups, index: np.ndarray, borders: np.ndarray) -> None:
    unit = np.searchsorted(borders, index, "right") - 1
    target, member = cross_units(groups, unit)
    entries = np.empty(len(target), _WANT)
    entries["index"], entries["unit"] = index[member], target
    wants.append(unit[member], entries)


def _read_bucket(spool: Spool, bucket: int) -> np.ndarray:
    """Entries of a bucket in file order; of packets with too many points only the first few, enough to know that."""
    held = np.empty(0, _KEY)
    for part in spool.pieces(bucket):
        held = np.concatenate([held, part])
        groups = group_keys(held["key"])
        if (groups.counts > MAX_RETURNS + 1).any():
            keep = groups.order[expand(groups.starts, np.minimum(groups.counts, MAX_RETURNS + 1))]
            held = held[np.sort(keep)]
    return held
