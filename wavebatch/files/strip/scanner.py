"""The pass over the points of a strip: checks packets, sets the borders of units, finds packets that cross borders.

`StripReader.scan` calls it. It reads the samples of a few packets only, and its memory does not grow with the strip.
Borders depend only on the file, so that results are equal for any number of processes. The result, `StripScan`, and the
messages about what is wrong with the strip go to reader, survey and reports; it is pickled for other processes.

Points of different units that share a packet are searched near the borders first, over the whole strip if needed: a
unit needs the points of other units that share packets with its points, its context. The near search compares each unit
with a window of points before it. It also notes, for each bin of the packet file, the first and the last point that
refers to it: if these are closer than the window, nothing was missed. Only packets of the other, suspect bins go
through a sort on disk. Both searches must find the same groups; the tests compare them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import changeable, frozen
from wavebatch.core.order import distinct, even_places, join_ranges, quantile
from wavebatch.core.units import count
from wavebatch.files.disk.raw_bytes import Closing, join_records, take_whole_records, undoing
from wavebatch.files.disk.temp_store import SPOOL_MEMORY, Spool, spread_keys
from wavebatch.files.las.crs import metres_per_unit
from wavebatch.files.las.header import LasHeader, locate
from wavebatch.files.las.read_points import PointSource
from wavebatch.files.strip import packet_check as check
from wavebatch.files.strip.packets import PacketFile, StripFacts
from wavebatch.kernels.geometry.group_returns import on_ray

MAX_RETURNS = 32
"""More points on one packet are damage: LAS has at most 15 returns."""
_LEAST_BIN = 64
_KEY = np.dtype([("key", "<u8"), ("index", "<i8")])
_WANT = np.dtype([("index", "<i8"), ("unit", "<i8")])


@frozen
class ScanSizes:
    """What a scan holds at a time; its result does not depend on it."""

    window: int = 16_384
    """Points before a border that are compared with the unit after it; vendors write returns of a pulse together."""
    bins: int = 1 << 18
    """Bins of the packet file: 5 MiB of memory."""
    keys: int = 500_000
    """Keys that are sorted at a time, about 20 MB."""
    part_units: int = 4
    """Fewest units that a process scans: it reads again what lies before them, up to one unit."""
    kept_bytes: int = 1 << 28
    """Most bytes of decompressed points that are kept for later passes, in a temporary file."""
    spooled: int = SPOOL_MEMORY
    """Bytes of each table that are written to a temporary file at a time."""


SCAN_SIZES = ScanSizes()


@frozen(eq=False)
class PacketGroups:
    """Entries sorted by key, then by place: group g is order[starts[g] : starts[g] + counts[g]]."""

    order: np.ndarray
    starts: np.ndarray
    counts: np.ndarray


def group_keys(keys: np.ndarray) -> PacketGroups:
    """Return the groups of equal keys (n,)."""
    if np.all(keys[1:] >= keys[:-1]):  # as most vendors write them
        order, ordered = np.arange(len(keys)), keys
    else:
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
    new = np.ones(len(keys), bool)
    new[1:] = ordered[1:] != ordered[:-1]
    starts = np.flatnonzero(new)
    return PacketGroups(order, starts, np.diff(np.append(starts, len(keys))))


def cross_units(groups: PacketGroups, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (unit, entry): the entry shares a key with entries of that unit, but lies in another unit.

    unit: unit of each entry (n,), ascending within a group.
    """
    lead = groups.starts
    last = lead + groups.counts - 1
    crossing = unit[groups.order[lead]] != unit[groups.order[last]]
    starts, counts = lead[crossing], groups.counts[crossing]
    members = groups.order[join_ranges(starts, counts)]
    group = np.repeat(np.arange(len(starts)), counts)
    first = np.ones(len(members), bool)
    first[1:] = (group[1:] != group[:-1]) | (unit[members[1:]] != unit[members[:-1]])
    place = np.cumsum(counts) - counts
    targets, owners = unit[members[first]], group[first]
    rows = join_ranges(place[owners], counts[owners])
    target = np.repeat(targets, counts[owners])
    away = unit[members[rows]] != target
    return target[away], members[rows[away]]


class NearSharing:
    """Near search: takes the strip unit by unit and collects what is shared across borders within the window."""

    def __init__(self, low: int, high: int, context: Spool, sizes: ScanSizes) -> None:
        self._low, self._window = np.uint64(low), sizes.window
        self._width = np.uint64(max(_LEAST_BIN, -(-(high - low) // sizes.bins)))
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
        place, where = self.bin(keys[own]), index[own]
        self._last[place] = where
        bins = place[::-1]
        unseen = self._first[bins] < 0
        self._first[bins[unseen]] = where[::-1][unseen]
        new = self.bin(keys[first[current & own[first]]])
        if len(new):
            low, high = int(new.min()), int(new.max())
            if high - low < 8 * len(new):  # as nearly always: packets follow the points, and counting takes a tenth
                self._new[low : high + 1] += np.bincount(new - low).astype(np.int32)
            else:
                np.add.at(self._new, new, 1)
        self.overfull.append(keys[first[groups.counts > MAX_RETURNS]])
        target, member = cross_units(groups, unit)
        here = unit[-1] if len(unit) else -1
        fresh = own[member] | (target == here)
        self._context.append(target[fresh], records(member[fresh]))
        return groups

    def bin(self, keys: np.ndarray) -> np.ndarray:
        """Return the bin of each key (n,)."""
        return (((keys >> check.INDEX_BITS) - self._low) // self._width).astype(np.int64)

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
        return (self._last - self._first) >= self._window


@frozen(eq=False)
class StripScan(Closing):
    """Result of one pass over the points; picklable. `close` it (or use `with`) to remove its temporary files."""

    points: int
    with_waveform: int
    """Points with a usable packet."""
    without_waveform: int
    """Points without a packet: descriptor index 0 or packet size 0."""
    broken: int
    """Points with a packet that cannot be used; these three counts add up to `points`."""
    packets: int
    """Different usable packets."""
    short: int
    """Points with a packet of fewer samples than its descriptor gives."""
    reasons: dict[check.Reason, tuple[int, int]]
    """For each reason not to use a packet: number of points, and index of the first."""
    by_descriptor: dict[int, int]
    """Points with a packet, by descriptor index."""
    reach: int
    """Largest distance in the file, in points, of two points that share a packet."""
    vectors: check.VectorDecision
    borders: np.ndarray
    """First point of each unit, then the number of points, i8 (units + 1,)."""
    overfull: np.ndarray
    """Sorted keys, u8, of packets with more points than a pulse can have."""
    context: Spool
    """For each unit the points of other units that share packets with it."""
    decoded: Spool
    """Points of the first units of a compressed strip, so that they are decoded once; empty for other units."""
    warnings: tuple[str, ...]
    problems: tuple[str, ...]
    """Reasons why the strip cannot be processed; empty unless the scan was `tolerant`."""
    forms: Mapping[int, check.SampleForm]
    """How samples are stored, by descriptor index; only descriptors whose counts are not simply read as they are."""
    stranger: str = ""
    """Why the packets are certainly those of another strip; empty where they are not, or where it was not asked."""
    doubts: Mapping[str, str] = field(default_factory=dict)
    """Those of `warnings` by which results are wrong, each with its code of `core.errors.WARNINGS`."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know about how samples are stored, one line each."""
        return tuple(note for form in self.forms.values() for note in form.notes)

    @property
    def cut(self) -> int:
        """Points whose packet lies past the end of the file: it is shorter than its packets need."""
        return self.reasons.get(check.Reason.CUT, (0, 0))[0]

    def close(self) -> None:
        """Remove the temporary files."""
        self.context.close()
        self.decoded.close()


def describe_oddities(reasons: dict[check.Reason, tuple[int, int]], short: int) -> Iterator[str]:
    """Yield warnings about a strip that can be processed."""
    for reason, (number, first) in reasons.items():
        remedy = "; get it again, whole, then run with --resume" if reason is check.Reason.CUT else ""
        where = f"{count(number, 'point')} (first: point {first})"
        yield f"{where} {check.REASON_TEXTS[reason]}; written unchanged{remedy}"
    if short:
        where = count(short, "point")
        yield f"{where} with packets of fewer samples than their descriptor gives; these samples are used"


def _find_bounds(header: LasHeader) -> list[tuple[float, float]]:
    """Least and largest stored X, Y and Z that the header's bounds allow; infinite for an axis without bounds.

    Points may lie as far outside as the box is wide: bounds that are rounded, or of shifted heights, are no damage.
    Bounds that no stored coordinate reaches are in another unit; Leica wrote the stored integers.
    """
    ends = np.array([header.mins, header.maxs])
    with np.errstate(all="ignore"):
        slack = np.maximum(ends[1] - ends[0], ROUNDED * np.abs(header.scales))
        stored, (low, high) = (
            np.sort((of - header.offsets) / header.scales, axis=0) for of in (ends, ends + [-slack, slack])
        )
        known = (ends[0] < ends[1]) & np.isfinite(high - low) & np.all(np.abs(stored) <= check.MOST_STORED + 1)
    return list(zip(np.where(known, low, -np.inf).tolist(), np.where(known, high, np.inf).tolist(), strict=True))


PADDING = 8
"""Fewer bytes behind the samples of a packet are no samples: packets may be filled up to whole words."""
ROUNDED = 1000
"""Steps of the coordinates to which bounds of a header may be rounded: a metre, in millimetres."""
LONGEST_RUN = 64
"""Shorter runs of points with one GPS time (a pulse) are not cut by a border; longer ones are no pulses."""
MOST_OVERLAP = 4
"""Times that packets may claim the bytes of the waveform data: once is right, and damaged points claim some again. 1 MB
of packets that begin a byte apart would be 1e9 samples. Returns far apart in the file claim their packet once each."""
MANY_TWICE = 0.01
"""Share of pairs with one place from which points are stored twice: coarse coordinates hide some short distances."""
_PAIRS, _VOTERS = 4096, 256
"""Most pairs and points of a unit that vote on the direction of vectors."""
MANY_UNITS = 256
"""Units from which on each gives fewer votes and packets: they are kept until all are scanned, and took 80 MB of a
strip of 10^8 waveforms."""
_FAR_SAMPLES = 32
"""Units of a shuffled strip that vote again with their context."""
_FIRST_POINTS, _FIRST_BYTES = 10_000, 1 << 26


def cut_scan(units: int, unit_points: int, parts: int, sizes: ScanSizes = SCAN_SIZES) -> list[tuple[int, int]]:
    """Cut a strip into at most so many runs of units [first, last) that `scan_units` may take one by one."""
    most = units // sizes.part_units if unit_points >= sizes.window + LONGEST_RUN else 1
    parts = max(1, min(parts, most))
    # The first runs are the longer ones: the others also decode what lies before them.
    return list(itertools.pairwise(-(-units * part // parts) for part in range(parts + 1)))


@changeable
class _Tally:
    reasons: np.ndarray = field(default_factory=lambda: np.zeros(len(check.Reason), np.int64))
    first: np.ndarray = field(default_factory=lambda: np.full(len(check.Reason), -1, np.int64))
    by_descriptor: np.ndarray = field(default_factory=lambda: np.zeros(256, np.int64))
    short: int = 0
    long: int = 0
    new: int = 0
    in_samples: int = 0
    """Packets, and those of as many bytes as their descriptor gives samples, which are too few."""
    stray: int = 0
    """Points far outside the bounds of the header."""
    pairs: int = 0
    twice: int = 0
    """Pairs of points with one packet that were looked at, and those of one return."""
    looked: int = 0
    one_ray: int = 0
    """Points that were looked at, and those with the ray of the packet before and a time that does not part them."""

    def add(self, points: np.ndarray, start: int, judged: check.Judged, bounds: list[tuple[float, float]]) -> None:
        if any(least < low or most > high for (least, most), (low, high) in zip(judged.ends, bounds, strict=False)):
            stored = (points[axis] for axis in "XYZ")
            outside = [(one < low) | (one > high) for one, (low, high) in zip(stored, bounds, strict=True)]
            self.stray += int(np.count_nonzero(np.logical_or.reduce(outside)))
        self.reasons += np.bincount(judged.reason, minlength=len(check.Reason))
        for reason in np.flatnonzero((self.reasons > 0) & (self.first < 0)).tolist():
            self.first[reason] = start + int(np.argmax(judged.reason == reason))
        has = judged.reason != check.Reason.NO_WAVEFORM
        self.by_descriptor += np.bincount(points["wavepacket_index"][has], minlength=256)
        self.short += int(judged.short.sum())

    def join(self, other: _Tally) -> None:
        self.first = np.where(self.first < 0, other.first, self.first)
        self.reasons += other.reasons
        self.by_descriptor += other.by_descriptor
        self.short += other.short
        self.long += other.long
        self.new += other.new
        self.in_samples += other.in_samples
        self.stray += other.stray
        self.pairs += other.pairs
        self.twice += other.twice
        self.looked += other.looked
        self.one_ray += other.one_ray

    def describe(self) -> dict[check.Reason, tuple[int, int]]:
        found = [reason for reason in check.Reason if reason in check.REASON_TEXTS and self.reasons[reason]]
        return {reason: (int(self.reasons[reason]), int(self.first[reason])) for reason in found}

    def doubt(self) -> dict[str, str]:
        doubts = {}
        if self.long:
            more = f"{count(self.long, 'packet')} longer than the descriptor gives: what lies behind is not read"
            doubts[f"{more}, so echoes may be missing; get the strip with right descriptors"] = "lost-samples"
        if 2 * self.in_samples > self.new:
            where = f"{count(self.in_samples, 'packet')} of as many bytes as samples"
            doubts[f"{where}: sizes seem to be numbers of samples, and half of each waveform or more is not read; get "
                   "the strip with sizes in bytes"] = "lost-samples"  # fmt: skip
        if self.stray:
            where = f"{count(self.stray, 'point')} outside the bounds that the header claims, by more than their width"
            doubts[f"{where}: points or header are damaged, or axes are swapped; get the file again"] = "units"
        if self.twice > MANY_TWICE * self.pairs:
            where = f"of {count(self.pairs, 'pair')} of points with one packet that were looked at, {self.twice} have"
            line = f"{where} one place, time and return number: points are stored twice, also in the cloud, so that "
            doubts[f"{line}densities are too high; remove the copies"] = "packets"
        if self.one_ray > MANY_TWICE * self.looked:
            where = f"{self.one_ray} of {self.looked} points that were looked at have the ray of the packet before them"
            doubts[f"{where}, and no GPS time of their own: if both are of one pulse, its echoes are in the cloud once "
                   "for each packet, and return numbers are wrong; give each pulse its time"] = "repeated"  # fmt: skip
        return doubts


class ScanPart(Closing):
    """What was found in consecutive units of a strip; sealed it can be pickled."""

    def __init__(self, facts: StripFacts, form: str, units: int, sizes: ScanSizes) -> None:
        self.borders: list[int] = []
        self.tally, self.votes, self.claimed = _Tally(), check.DirectionTally(form), 0
        self.sample: list[check.SomePackets] = []
        self.context = Spool(units, np.dtype([("index", "<i8"), ("record", facts.dtype)]), memory=sizes.spooled)
        self.decoded = Spool(units, facts.dtype, memory=sizes.spooled)
        low, high = facts.packets.offsets
        self.near = NearSharing(low, max(low, high), self.context, sizes)

    def seal(self) -> ScanPart:
        self.context.seal()
        return self

    def join(self, other: ScanPart) -> None:
        """Add what was found in the units that follow."""
        self.borders += other.borders[1:] if self.borders else other.borders
        for name in ("tally", "votes", "near", "context", "decoded"):
            getattr(self, name).join(getattr(other, name))
        self.sample += other.sample
        self.claimed += other.claimed

    def close(self) -> None:
        """Remove the temporary files."""
        self.context.close()
        self.decoded.close()


class Scanner:
    """Scans all units of a strip, or some; a new one for each scan.

    unit_points: points per unit before borders are moved to the next pulse. Raises InputError if points cannot be read.
    """

    def __init__(
        self, facts: StripFacts, source: PointSource, packets: PacketFile, unit_points: int, sizes: ScanSizes
    ) -> None:
        self._facts, self._source, self._unit_points, self._sizes = facts, source, unit_points, sizes
        self._packets = packets
        self._judge = check.Judge(facts)
        most = min(_FIRST_POINTS, _FIRST_BYTES // facts.header.point_length, facts.header.point_count)
        self._head = source.read(0, most)
        """The first points, until they are scanned: those of a small strip take longer to decode than to scan."""
        has_packet = (self._head["wavepacket_index"] > 0) & (self._head["wavepacket_size"] > 0)
        ratio = check.measure_ratio(self._head[has_packet], "stored")
        ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
        self._form = "range" if len(ratio) and quantile(ratio, 0.5) > check.RANGE_RATIO else "stored"
        self._units = -(-facts.header.point_count // unit_points)
        self._thinning = max(-(-self._units // MANY_UNITS), 1)
        self._found = ScanPart(facts, self._form, self._units, sizes)
        self._keeps = facts.header.compressed
        self._widths = np.zeros(256, np.int64)
        self._widths[list(facts.digitizers)] = [digitizer.width for digitizer in facts.digitizers.values()]
        self._lengths = np.zeros(256, np.int64)
        self._lengths[list(facts.digitizers)] = [digitizer.n_samples for digitizer in facts.digitizers.values()]
        self._bounds = _find_bounds(facts.header)
        self._first = 0
        """Number of the first unit that is scanned."""
        none = np.empty(0, np.int64)
        self._window = _Near(none.astype(np.uint64), none, none, np.empty(0, facts.dtype), 0)

    def scan_units(self, first: int, last: int) -> ScanPart:
        """Scan the units [first, last)."""
        self._first = first
        with undoing(self._found.close):
            for start, points in self._cut_units(first, last):
                self._add_unit(start, points)
            self._try_keeping(self._found.decoded.seal)
        return self._found

    def run(self, parts: Sequence[ScanPart]) -> StripScan:
        """Scan all units, or join what was found in them; then look at all of them together."""
        found = self._found
        for part in parts:
            found.join(part)
        if not parts:
            self.scan_units(0, self._units)
        near = found.near
        with undoing(found.close):
            suspects = near.suspects()
            packets, reach = int(near._new[~suspects].sum()), near.reach
            full = [np.empty(0, np.uint64), *near.overfull]
            if suspects.any():
                more, far_reach, far_overfull = self._go_far(suspects)
                packets, reach = packets + more, max(reach, far_reach)
                full.append(far_overfull)
            found.seal()
            overfull = distinct(np.concatenate(full))
            if suspects.any():
                # Some units vote again with their context: in a shuffled strip only there the returns of a packet meet.
                for unit in range(0, self._units, max(1, self._units // _FAR_SAMPLES)):
                    start, stop = found.borders[unit], found.borders[unit + 1]
                    context = unique_entries(found.context.read(unit))
                    records = np.concatenate([self._source.read(start, stop), context["record"]])
                    index = np.concatenate([np.arange(start, stop), context["index"]])
                    judged = self._judge.judge(records, self._form)
                    rows = np.flatnonzero(judged.usable)
                    rows = rows[np.argsort(index[rows], kind="stable")]
                    keys, records = judged.keys[rows], take_whole_records(records, rows)
                    voters = _Near(keys, np.arange(len(rows)), rows, records, 0)
                    self._vote(group_keys(keys), voters, np.ones(len(rows), bool))
            for start, judged in self._judge_again(overfull) if len(overfull) else ():
                here, tally = judged.reason == check.Reason.OVERFULL, found.tally
                many = int(here.sum())
                if many and tally.first[check.Reason.OVERFULL] < 0:
                    tally.first[check.Reason.OVERFULL] = start + int(np.argmax(here))
                tally.reasons[check.Reason.OVERFULL] += many
                tally.reasons[check.Reason.USABLE] -= many
        facts, points, tally = self._facts, self._facts.header.point_count, found.tally
        usable, missing = int(tally.reasons[check.Reason.USABLE]), int(tally.reasons[check.Reason.NO_WAVEFORM])
        decision = check.decide_direction(found.votes, facts.direction_option, metres_per_unit(facts.units)[0])
        reasons = tally.describe()
        problems = list(decision.problems)
        doubts = {**tally.doubt(), **dict.fromkeys(decision.doubts, "units")}
        forms = check.find_forms(facts.digitizers, self._packets, found.sample)
        doubts |= {form.doubt: "packets" for form in forms.values() if form.doubt}
        fastest, slowest = check.USUAL_SPACINGS
        for kind, one in facts.digitizers.items():
            if tally.by_descriptor[kind] and (0 < one.spacing < fastest or slowest < one.spacing <= check.MAX_SPACING):
                line = f"descriptor {kind} has samples {one.spacing:g} ns apart, as no digitizer has: widths, energies"
                doubts[f"{line} and their errors are wrong if its unit is not the picosecond; correct it"] = "units"
        if not usable and missing < points:
            packet_file = facts.packets.file
            if packet_file is None:
                name = facts.path.with_suffix(".wdp").name
                why = "points refer to packets that are neither in the file nor next to it"
                problems.insert(0, f"{why}: put {name} next to the strip")
            else:
                reason = max(reasons, key=lambda one: reasons[one][0])
                number, first = reasons[reason]
                remedy = f"{packet_file.name} is cut, damaged or belongs to another strip: get it again"
                if reason is check.Reason.PACKED:
                    remedy = "write the packets with 8, 16 or 32 bits per sample"
                problems.insert(0, f"no packet can be used: {number} of {points} points (first: point {first}) "
                                   f"{check.REASON_TEXTS[reason]}; {remedy}")  # fmt: skip
        low, high = facts.packets.offsets
        most = MAX_RETURNS if suspects.any() else MOST_OVERLAP
        if found.claimed > most * max(high - low, 0):
            problems.append(
                f"packets overlap: they claim {found.claimed:,} bytes of {high - low:,}; the strip is damaged, or its "
                "packets belong to another one: get both again"
            )
        return StripScan(
            points=points,
            with_waveform=usable,
            without_waveform=missing,
            broken=points - usable - missing,
            packets=packets - len(overfull),
            short=tally.short,
            reasons=reasons,
            by_descriptor={i: int(tally.by_descriptor[i]) for i in np.flatnonzero(tally.by_descriptor).tolist()},
            reach=reach,
            vectors=decision,
            borders=np.array(found.borders or [0]),
            overfull=overfull,
            context=found.context,
            decoded=found.decoded,
            warnings=(*describe_oddities(reasons, tally.short), *decision.warnings, *doubts),
            doubts=doubts,
            problems=tuple(problems),
            forms=forms,
        )

    def _cut_units(self, first: int, last: int) -> Iterator[tuple[int, np.ndarray]]:
        """Yields first index and points of each unit, and collects the borders."""
        step, count, borders = self._unit_points, self._facts.header.point_count, self._found.borders
        begin, end = first * step, min(last * step, count)
        rest = self._source.read(max(begin - self._sizes.window, 0), begin)
        for at in range(begin, end, step):
            stop = min(at + step, count)
            part, self._head = self._head[at:stop], self._head if stop < len(self._head) else self._head[:0]
            if len(part) < stop - at:
                more = self._source.read(at + len(part), stop)
                part = join_records(part, more) if len(part) else more
            cut = _find_cut(rest, part) if at else 0
            if at == begin:
                # The window begins with the last points before the first unit.
                points, start = join_records(rest, part[:cut]), at - len(rest)
                judged = self._judge.judge(points, self._form)
                rows = np.flatnonzero(judged.usable)
                unit = np.full(len(rows), self._first - 1)
                self._window = _Near(judged.keys[rows], start + rows, unit, points, start)
            else:
                yield borders[-1], join_records(rest, part[:cut]) if cut else rest
            borders.append(at + cut)
            rest = part[cut:]
        if end > begin:
            after = self._source.read(end, min(end + LONGEST_RUN, count))
            cut = _find_cut(rest, after) if len(after) else 0
            yield borders[-1], join_records(rest, after[:cut]) if cut else rest
            borders.append(end + cut)

    def _try_keeping(self, write: Callable[[], object]) -> None:
        """Do without the kept points where there is no room for them."""
        try:
            write()
        except InputError:
            self._found.decoded.close()
            self._found.decoded, self._keeps = Spool(self._units, self._facts.dtype).seal(), False

    def _add_unit(self, start: int, points: np.ndarray) -> None:
        unit = self._first + len(self._found.borders) - 1
        # Of a compressed strip, because to decode points again takes twenty times as long as to read them.
        size = (unit + 1) * self._unit_points * points.itemsize
        if self._keeps and size <= self._sizes.kept_bytes:
            self._try_keeping(lambda: self._found.decoded.append(np.full(len(points), unit), points))
        judged = self._judge.judge(points, self._form)
        self._found.tally.add(points, start, judged, self._bounds)
        rows = np.flatnonzero(judged.usable)
        near = self._window.follow(start - self._sizes.window, judged.keys[rows], start + rows, unit, points)
        own = near.index >= start
        groups = self._found.near.add(near.keys, near.index, near.unit, own, lambda rows: self._entries(near, rows))
        first = groups.order[groups.starts] - (len(near.keys) - len(rows))
        new = rows[first[first >= 0]]
        some = new[even_places(len(new), max(check.SAMPLED_PER_UNIT // self._thinning, 1))]
        self._found.sample.append((judged.keys[some], judged.n_samples[some], judged.packed[some]))
        size, kind = points["wavepacket_size"][new], points["wavepacket_index"][new]
        width, length = np.take(self._widths, kind), np.take(self._lengths, kind)
        least = judged.n_samples[new] * width
        self._found.claimed += int(np.minimum(least, size).sum())
        self._found.tally.long += int(np.count_nonzero(size >= least + PADDING))
        self._found.tally.new += len(new)
        in_samples = judged.short[new] & (size == length)
        if in_samples.any():  # and the rest is there: a short recording ends where the next one begins
            at = points["wavepacket_offset"][new]
            ahead = np.append(np.unique(at), np.uint64(2**64 - 1))
            in_samples &= ahead[np.searchsorted(ahead, at, "right")] - at >= (length * width).astype(np.uint64)
        self._found.tally.in_samples += int(np.count_nonzero(in_samples))
        if len(rows):
            # Packets of one ray whose time is that of many others: a pulse with a packet for each return, it may be.
            time, some = np.nan_to_num(points["gps_time"]), rows[rows < len(points) - LONGEST_RUN][:_PAIRS]
            head, next_one = some[:-1], some[1:]
            one_ray = (judged.keys[head] != judged.keys[next_one]) & (time[head] == time[next_one + LONGEST_RUN])
            for name in check.VECTORS:
                one_ray &= points[name][head] == points[name][next_one]
            self._found.tally.looked += len(some)
            if one_ray.any():
                pair = [take_whole_records(points, place[one_ray]) for place in (head, next_one)]
                head, next_one = (locate(records, self._facts.header) for records in pair)
                self._found.tally.one_ray += int(np.count_nonzero(on_ray(head, next_one, check.stack_vectors(pair[1]))))
            step = max(1, self._thinning * len(rows) // _VOTERS)
            self._found.votes.add_points(take_whole_records(points, rows[::step]))
            self._vote(groups, near, own)
        self._window = near

    def _entries(self, near: _Near, rows: np.ndarray) -> np.ndarray:
        entries = np.empty(len(rows), self._found.context.dtype)
        entries["index"], entries["record"] = near.index[rows], near.take(rows)
        return entries

    def _vote(self, groups: PacketGroups, near: _Near, own: np.ndarray) -> None:
        follows = np.ones(len(groups.order), bool)
        follows[groups.starts] = False
        place = np.flatnonzero(follows)
        place = place[own[groups.order[place]]]
        place = place[:: max(1, len(place) // _PAIRS)]
        first, second = near.take(groups.order[place - 1]), near.take(groups.order[place])
        xyz = np.stack([locate(records, self._facts.header) for records in (first, second)])
        self._found.votes.add_pairs(xyz, first, second)
        same = (xyz[0] == xyz[1]).all(axis=1) & (first["gps_time"] == second["gps_time"])
        same &= first["bit_fields"] == second["bit_fields"]
        self._found.tally.pairs += len(same)
        self._found.tally.twice += int(np.count_nonzero(same))

    def _go_far(self, suspects: np.ndarray) -> tuple[int, int, np.ndarray]:
        """Finds points anywhere in the strip that share packets of suspect bins, and adds them to the context.

        In bounded memory. Returns the number of packets, how far apart points of a packet lie, and the keys of overfull
        packets.
        """
        borders = np.array(self._found.borders)
        count = int(self._found.tally.reasons[check.Reason.USABLE])
        buckets = count // self._sizes.keys + 1
        spool = Spool(buckets, _KEY, memory=self._sizes.spooled)
        # For each unit, which of its points which other unit needs.
        wants = Spool(len(borders) - 1, _WANT, memory=self._sizes.spooled)
        packets, reach, overfull = 0, 0, []
        with spool, undoing(wants.close):
            for start, judged in self._judge_again():
                rows = np.flatnonzero(judged.usable)
                rows = rows[suspects[self._found.near.bin(judged.keys[rows])]]
                entries = np.empty(len(rows), _KEY)
                entries["key"], entries["index"] = judged.keys[rows], start + rows
                spool.append(spread_keys(entries["key"], buckets), entries)
            spool.seal()
            for bucket in range(buckets):
                # In file order; of overfull packets only the first entries, enough to know them.
                entries = np.empty(0, _KEY)
                for part in spool.pieces(bucket):
                    entries = np.concatenate([entries, part])
                    groups = group_keys(entries["key"])
                    if (groups.counts > MAX_RETURNS + 1).any():
                        keep = groups.order[join_ranges(groups.starts, np.minimum(groups.counts, MAX_RETURNS + 1))]
                        entries = entries[np.sort(keep)]
                groups = group_keys(entries["key"])
                packets += len(groups.starts)
                if len(entries):
                    lead, tail = groups.order[groups.starts], groups.order[groups.starts + groups.counts - 1]
                    reach = max(reach, int((entries["index"][tail] - entries["index"][lead]).max()))
                    overfull.append(entries["key"][lead[groups.counts > MAX_RETURNS]])
                home = np.searchsorted(borders, entries["index"], "right") - 1
                target, member = cross_units(groups, home)
                asked = np.empty(len(target), _WANT)
                asked["index"], asked["unit"] = entries["index"][member], target
                wants.append(home[member], asked)
        far = wants.seal()
        try:
            for unit in range(len(borders) - 1):
                needed = far.read(unit)
                if len(needed):
                    start, context = int(borders[unit]), self._found.context
                    points = self._source.read(start, int(borders[unit + 1]))
                    records = np.empty(len(needed), context.dtype)
                    records["index"] = needed["index"]
                    records["record"] = take_whole_records(points, needed["index"] - start)
                    context.append(needed["unit"], records)
        finally:
            far.close()
        return packets, reach, np.concatenate([np.empty(0, np.uint64), *overfull])

    def _judge_again(self, overfull: np.ndarray | None = None) -> Iterator[tuple[int, check.Judged]]:
        """First index and check of each unit, for passes after the first one."""
        for start, stop in itertools.pairwise(self._found.borders):
            yield start, self._judge.judge(self._source.read(start, stop), self._form, overfull)


@frozen(eq=False)
class _Near:
    """Usable points of a unit and of the window before it, in the order of the file."""

    keys: np.ndarray
    index: np.ndarray
    """In the file."""
    unit: np.ndarray
    points: np.ndarray
    """All records from `start` on, usable or not."""
    start: int

    def take(self, rows: np.ndarray) -> np.ndarray:
        """Returns the records of the usable points `rows`."""
        return take_whole_records(self.points, self.index[rows] - self.start)

    def follow(self, least: int, keys: np.ndarray, index: np.ndarray, unit: int, points: np.ndarray) -> _Near:
        """The part from file index `least` on, copied, which frees memory, and the points that follow.

        These are all of one unit; those at `index` are usable.
        """
        at, first = int(np.searchsorted(self.index, least)), max(self.start, least)
        keys, index = np.concatenate([self.keys[at:], keys]), np.concatenate([self.index[at:], index])
        units = np.append(self.unit[at:], np.full(len(keys) - len(self.unit[at:]), unit))
        return _Near(keys, index, units, join_records(self.points[first - self.start :], points), first)


def _find_cut(rest: np.ndarray, part: np.ndarray) -> int:
    """Number of points after a border that belong to the pulse before it, and so to the unit before it."""
    before, after = rest["gps_time"][-LONGEST_RUN:], part["gps_time"][:LONGEST_RUN]
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
