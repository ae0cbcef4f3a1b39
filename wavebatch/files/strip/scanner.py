"""The pass over the points of a strip: checks packets, sets the borders of units, finds packets that cross borders.

`StripReader.scan` calls it. It reads the samples of a few packets only, and its memory does not grow with the strip.
Borders depend only on the file, so that results are equal for any number of processes.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.order import distinct
from wavebatch.files.disk.raw_bytes import take_whole_records
from wavebatch.files.disk.spool import Spool
from wavebatch.files.las.crs import metres_per_unit
from wavebatch.files.las.point_formats import locate
from wavebatch.files.las.read_points import PointSource
from wavebatch.files.strip import shared_packets
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.packet_check import REASON_TEXTS, Judge, Judged, Reason
from wavebatch.files.strip.packet_vectors import DirectionTally, decide_direction, find_form
from wavebatch.files.strip.packets import PacketFile
from wavebatch.files.strip.sample_form import FormSample, find_forms
from wavebatch.files.strip.scan_result import StripScan, describe_hopeless, describe_oddities
from wavebatch.files.strip.shared_packets import MAX_RETURNS, NearSharing, PacketGroups, find_far, group_keys

LONGEST_RUN = 64
"""Shorter runs of points with one GPS time (a pulse) are not cut by a border; longer ones are no pulses."""
MOST_OVERLAP = 4
"""Times that packets may claim the bytes of the waveform data: once is right, and damaged points claim some again. 1 MB
of packets that begin a byte apart would be 1e9 samples. Returns far apart in the file claim their packet once each."""
_PAIRS, _VOTERS = 4096, 256
"""Most pairs and points of a unit that vote on the direction of vectors."""
_FAR_SAMPLES = 32
"""Units of a shuffled strip that vote again with their context."""
_FIRST_POINTS, _FIRST_BYTES = 10_000, 1 << 26
_KEPT_BYTES = 1 << 28
"""Most bytes of decompressed points that a scan keeps for later passes, in a temporary file."""


def scan_strip(facts: StripFacts, source: PointSource, packets: PacketFile, unit_points: int) -> StripScan:
    """Scan all points of a strip.

    unit_points: points per unit before borders are moved to the next pulse.
    Raises InputError if points cannot be read; other reasons against processing are in the scan's `problems`.
    """
    return _Scanner(facts, source, packets, unit_points).run()


@dataclass(slots=True)
class _Tally:
    reasons: np.ndarray = field(default_factory=lambda: np.zeros(len(Reason), np.int64))
    first: np.ndarray = field(default_factory=lambda: np.full(len(Reason), -1, np.int64))
    by_descriptor: np.ndarray = field(default_factory=lambda: np.zeros(256, np.int64))
    short: int = 0

    def add(self, points: np.ndarray, start: int, judged: Judged) -> None:
        self.reasons += np.bincount(judged.reason, minlength=len(Reason))
        for reason in np.flatnonzero((self.reasons > 0) & (self.first < 0)).tolist():
            self.first[reason] = start + int(np.argmax(judged.reason == reason))
        has = judged.reason != Reason.NO_WAVEFORM
        self.by_descriptor += np.bincount(points["wavepacket_index"][has], minlength=256)
        self.short += int(judged.short.sum())

    def describe(self) -> dict[Reason, tuple[int, int]]:
        return {r: (int(self.reasons[r]), int(self.first[r])) for r in Reason if r in REASON_TEXTS and self.reasons[r]}


class _Scanner:
    def __init__(self, facts: StripFacts, source: PointSource, packets: PacketFile, unit_points: int) -> None:
        self._facts, self._source, self._unit_points = facts, source, unit_points
        self._packets, self._sample = packets, FormSample()
        self._judge = Judge(facts)
        self._form = find_form(self._take_first())
        self._tally, self._votes = _Tally(), DirectionTally(self._form)
        self._claimed = 0
        self._borders = [0]
        units = -(-facts.header.point_count // unit_points)
        self._context = Spool(units, np.dtype([("index", "<i8"), ("record", facts.dtype)]))
        self._decoded = Spool(units, facts.dtype)
        self._keeps = facts.header.compressed
        low, high = facts.packets.offsets
        self._widths = np.zeros(256, np.int64)
        self._widths[list(facts.digitizers)] = [digitizer.width for digitizer in facts.digitizers.values()]
        self._near = NearSharing(low, max(low, high), self._context)
        self._window: list[_Part] = []

    def _take_first(self) -> np.ndarray:
        """Those of the first points that have packets."""
        most = min(_FIRST_POINTS, _FIRST_BYTES // self._facts.header.point_length)
        points = self._source.read(0, min(self._facts.header.point_count, most))
        return points[(points["wavepacket_index"] > 0) & (points["wavepacket_size"] > 0)]

    def run(self) -> StripScan:
        try:
            for start, points in self._cut_units():
                self._add_unit(start, points)
            suspects = self._near.suspects()
            packets, reach = self._near.count_packets(suspects), self._near.reach
            found = [np.empty(0, np.uint64), *self._near.overfull]
            if suspects.any():
                more, far_reach, far_overfull = self._go_far(suspects)
                packets, reach = packets + more, max(reach, far_reach)
                found.append(far_overfull)
            self._context.seal()
            overfull = distinct(np.concatenate(found))
            if suspects.any():
                self._vote_far()
            if len(overfull):
                self._count_overfull(overfull)
            self._try_keeping(self._decoded.seal)
        except BaseException:
            self._context.close()
            self._decoded.close()
            raise
        return self._finish(packets - len(overfull), reach, overfull, MAX_RETURNS if suspects.any() else MOST_OVERLAP)

    def _cut_units(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yields first index and points of each unit, and collects the borders."""
        step, count = self._unit_points, self._facts.header.point_count
        rest = np.empty(0, self._facts.dtype)
        for begin in range(0, count, step):
            part = self._source.read(begin, min(begin + step, count))
            if begin:
                cut = _find_cut(rest["gps_time"][-LONGEST_RUN:], part["gps_time"][:LONGEST_RUN])
                start = self._borders[-1]
                self._borders.append(begin + cut)
                yield start, np.concatenate([rest, part[:cut]]) if cut else rest
                rest = part[cut:]
            else:
                rest = part
        if count:
            self._borders.append(count)
            yield self._borders[-2], rest

    def _keep(self, unit: int, points: np.ndarray) -> None:
        """Keep the points of a compressed strip: to decode them again takes twenty times as long as to read them."""
        size = (self._decoded.count + len(points)) * self._decoded.dtype.itemsize
        self._keeps = self._keeps and size <= _KEPT_BYTES
        if self._keeps:
            self._try_keeping(lambda: self._decoded.append(np.full(len(points), unit), points))

    def _try_keeping(self, write: Callable[[], object]) -> None:
        """Do without the kept points where there is no room for them."""
        try:
            write()
        except InputError:
            self._decoded.close()
            self._decoded, self._keeps = Spool(self._decoded.buckets, self._decoded.dtype).seal(), False

    def _add_unit(self, start: int, points: np.ndarray) -> None:
        self._keep(len(self._borders) - 2, points)
        judged = self._judge.judge(points, self._form)
        self._tally.add(points, start, judged)
        rows = np.flatnonzero(judged.usable)
        part = _Part(judged.keys[rows], start + rows, len(self._borders) - 2, points, start)
        tails = (old.tail(start - shared_packets.WINDOW) for old in self._window)
        self._window = [tail for tail in tails if len(tail.keys)]
        parts = _Parts([*self._window, part])
        own = np.arange(len(parts.keys)) >= len(parts.keys) - len(rows)
        groups = self._near.add(parts.keys, parts.index, parts.unit, own, lambda rows: self._entries(parts, rows))
        first = groups.order[groups.starts] - (len(parts.keys) - len(rows))
        new = rows[first[first >= 0]]
        self._sample.add(judged, new)
        width = np.take(self._widths, points["wavepacket_index"][new])
        self._claimed += int(np.minimum(judged.n_samples[new] * width, points["wavepacket_size"][new]).sum())
        if len(rows):
            self._votes.add_points(take_whole_records(points, rows[:: max(1, len(rows) // _VOTERS)]))
            self._vote(groups, parts, own)
        self._window.append(part)

    def _entries(self, parts: _Parts, rows: np.ndarray) -> np.ndarray:
        entries = np.empty(len(rows), self._context.dtype)
        entries["index"], entries["record"] = parts.index[rows], parts.take(rows)
        return entries

    def _vote(self, groups: PacketGroups, parts: _Parts, own: np.ndarray) -> None:
        follows = np.ones(len(groups.order), bool)
        follows[groups.starts] = False
        place = np.flatnonzero(follows)
        place = place[own[groups.order[place]]]
        place = place[:: max(1, len(place) // _PAIRS)]
        first, second = parts.take(groups.order[place - 1]), parts.take(groups.order[place])
        xyz = np.stack([locate(records, self._facts.header) for records in (first, second)])
        self._votes.add_pairs(xyz, first, second)

    def _go_far(self, suspects: np.ndarray) -> tuple[int, int, np.ndarray]:
        """Finds points anywhere in the strip that share packets of suspect bins, and adds them to the context."""
        borders = np.array(self._borders)
        count = int(self._tally.reasons[Reason.USABLE])
        far = find_far(self._suspect_keys(suspects), count, borders)
        try:
            for unit in range(len(borders) - 1):
                wants = far.wants.read(unit)
                if len(wants):
                    self._give(int(borders[unit]), int(borders[unit + 1]), wants)
        finally:
            far.wants.close()
        return far.packets, far.reach, far.overfull

    def _judge_again(self, overfull: np.ndarray | None = None) -> Iterator[tuple[int, Judged]]:
        """First index and check of each unit, for passes after the first one."""
        for start, stop in itertools.pairwise(self._borders):
            yield start, self._judge.judge(self._source.read(start, stop), self._form, overfull)

    def _suspect_keys(self, suspects: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for start, judged in self._judge_again():
            rows = np.flatnonzero(judged.usable)
            rows = rows[self._near.is_suspect(judged.keys[rows], suspects)]
            yield judged.keys[rows], start + rows

    def _give(self, start: int, stop: int, wants: np.ndarray) -> None:
        points = self._source.read(start, stop)
        entries = np.empty(len(wants), self._context.dtype)
        entries["index"], entries["record"] = wants["index"], take_whole_records(points, wants["index"] - start)
        self._context.append(wants["unit"], entries)

    def _vote_far(self) -> None:
        """Some units vote again with their context: in a shuffled strip only there the returns of a packet meet."""
        units = len(self._borders) - 1
        for unit in range(0, units, max(1, units // _FAR_SAMPLES)):
            start, stop = self._borders[unit], self._borders[unit + 1]
            context = unique_entries(self._context.read(unit))
            points = np.concatenate([self._source.read(start, stop), context["record"]])
            index = np.concatenate([np.arange(start, stop), context["index"]])
            judged = self._judge.judge(points, self._form)
            rows = np.flatnonzero(judged.usable)
            rows = rows[np.argsort(index[rows], kind="stable")]
            parts = _Parts([_Part(judged.keys[rows], np.arange(len(rows)), unit, take_whole_records(points, rows), 0)])
            self._vote(group_keys(parts.keys), parts, np.ones(len(rows), bool))

    def _count_overfull(self, overfull: np.ndarray) -> None:
        for start, judged in self._judge_again(overfull):
            here = judged.reason == Reason.OVERFULL
            many = int(here.sum())
            if many and self._tally.first[Reason.OVERFULL] < 0:
                self._tally.first[Reason.OVERFULL] = start + int(np.argmax(here))
            self._tally.reasons[Reason.OVERFULL] += many
            self._tally.reasons[Reason.USABLE] -= many

    def _finish(self, packets: int, reach: int, overfull: np.ndarray, most: int) -> StripScan:
        """most: how many times packets may claim the bytes that are there."""
        tally, facts, points = self._tally, self._facts, self._facts.header.point_count
        usable, missing = int(tally.reasons[Reason.USABLE]), int(tally.reasons[Reason.NO_WAVEFORM])
        decision = decide_direction(self._votes, facts.direction_option, metres_per_unit(facts.units)[0])
        reasons = tally.describe()
        problems = list(decision.problems)
        if not usable and missing < points:
            problems.insert(0, describe_hopeless(facts, reasons))
        low, high = facts.packets.offsets
        if self._claimed > most * max(high - low, 0):
            problems.append(
                f"packets overlap: they claim {self._claimed:,} bytes of {high - low:,}; the strip is damaged, or its "
                "packets belong to another one: get both again"
            )
        return StripScan(
            points=points,
            with_waveform=usable,
            without_waveform=missing,
            broken=points - usable - missing,
            packets=packets,
            short=tally.short,
            reasons=reasons,
            by_descriptor={i: int(tally.by_descriptor[i]) for i in np.flatnonzero(tally.by_descriptor).tolist()},
            reach=reach,
            vectors=decision,
            borders=np.array(self._borders),
            overfull=overfull,
            context=self._context,
            decoded=self._decoded,
            warnings=(*describe_oddities(reasons, tally.short), *decision.warnings),
            problems=tuple(problems),
            forms=find_forms(facts.digitizers, self._packets, self._sample),
        )


class _Part:
    """Usable points of one unit that following units may share packets with."""

    def __init__(self, keys: np.ndarray, index: np.ndarray, unit: int, points: np.ndarray, start: int) -> None:
        self.keys, self.index, self.unit = keys, index, unit
        self._points, self._start = points, start

    def take(self, rows: np.ndarray) -> np.ndarray:
        """Returns the records of the usable points `rows`."""
        return take_whole_records(self._points, self.index[rows] - self._start)

    def tail(self, least: int) -> _Part:
        """The part from file index `least` on; a copy if that frees memory."""
        at = int(np.searchsorted(self.index, least))
        if not at:
            return self
        first = max(self._start, least)
        points = self._points[first - self._start :].copy()
        return _Part(self.keys[at:].copy(), self.index[at:].copy(), self.unit, points, first)


class _Parts:
    """Several parts in one sequence."""

    def __init__(self, parts: list[_Part]) -> None:
        self.keys = np.concatenate([part.keys for part in parts])
        self.index = np.concatenate([part.index for part in parts])
        self.unit = np.concatenate([np.full(len(part.keys), part.unit) for part in parts])
        self._starts = np.cumsum([0, *(len(part.keys) for part in parts)])
        self._parts = parts

    def take(self, rows: np.ndarray) -> np.ndarray:
        """Returns the records at `rows` of the whole sequence."""
        taken, places = [], []
        for start, stop, part in zip(self._starts[:-1], self._starts[1:], self._parts, strict=True):
            here = np.flatnonzero((rows >= start) & (rows < stop))
            taken.append(part.take(rows[here] - start))
            places.append(here)
        back = np.empty(len(rows), np.int64)
        back[np.concatenate(places)] = np.arange(len(rows))
        return take_whole_records(np.concatenate(taken), back)


def _find_cut(before: np.ndarray, after: np.ndarray) -> int:
    """Number of points after a border that belong to the pulse before it, and so to the unit before it."""
    time = before[-1]
    head = np.flatnonzero(after != time)
    tail = np.flatnonzero(before[::-1] != time)
    after_border = int(head[0]) if len(head) else len(after)
    before_border = int(tail[0]) if len(tail) else len(before)
    return after_border if after_border + before_border < LONGEST_RUN else 0


def unique_entries(entries: np.ndarray) -> np.ndarray:
    """Return context entries by file index, each once; near and far search may both find the same point."""
    _, first = np.unique(entries["index"], return_index=True)
    return entries[first]
