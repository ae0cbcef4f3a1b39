"""Reader of full-waveform strips, unit by unit: points, the packets they refer to, and blocks of their samples.

Survey, batch and tools read strips only through `StripReader`. Units depend only on the file and a packet belongs to
exactly one of them; results must not depend on blocks or processes.

`surveying/sensor.py` finds the positions of the sensor from the rays sampled along a strip: a few points of each unit
with times and directions. The sample is the same every time and bounded, for strips of any size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import distinct, even_places, find_order, join_ranges, quantile
from wavebatch.core.units import HALF_C, PS_PER_NS
from wavebatch.core.waveforms import Digitizer, ReturnTable, WaveformBlock
from wavebatch.files.cloud.point_filter import PlannedFilter
from wavebatch.files.disk.raw_bytes import Closing, join_records, reading, take_whole_records, undoing, widen_integers
from wavebatch.files.las.header import GROUND, locate, read_classes, read_scanner, split_numbers
from wavebatch.files.las.read_points import open_points
from wavebatch.files.strip import packet_check, scanner
from wavebatch.files.strip.packets import BLOCK_BYTES, PacketFile, StripFacts, find_facts
from wavebatch.files.strip.scanner import SCAN_SIZES, Scanner, ScanPart, ScanSizes, StripScan
from wavebatch.kernels.signal.signal import find_fill, quiet_fill, recorded_lengths

__all__ = ["UNIT_POINTS", "PacketTable", "StripFacts", "StripReader", "StripScan", "Unit"]

UNIT_POINTS = 50_000
"""Points per unit of work, as many as usual in a LAZ chunk, so that a unit decompresses one or two chunks."""
UNIT_BYTES = 1 << 26
"""Most bytes of points per unit: very long records make smaller units."""
_SAMPLED_UNITS = 16
"""Units that a sample is read from: enough to cover the strip, few enough to be fast."""

LONG, LONG_SAMPLES = 2048, 1 << 17
"""Of waveforms with more samples than LONG a sample of the strip has at most LONG_SAMPLES samples. No sensor records so
much of one pulse; where all of it is echoes, a survey takes 50 us per sample, twenty times as long as the chain."""

SAMPLE_WAVEFORMS = 8192
"""Waveforms that a survey looks at."""

SAMPLE_SAMPLES = 1 << 21
"""Most samples that a survey reads: 8192 waveforms of 256 samples."""

LEAST_WAVEFORMS = 64
"""Waveforms that it reads even if they are long."""


@frozen(eq=False)
class PacketTable:
    """m different packets in the order of their owners."""

    digitizer: np.ndarray
    """Descriptor index, u1 (m,)."""
    offset: np.ndarray
    """Byte offset as in the points, u8 (m,)."""
    size: np.ndarray
    """Bytes of the packet by its owner, u4 (m,)."""
    n_samples: np.ndarray
    """Samples, as many as descriptor and size allow, i4 (m,)."""
    owner: np.ndarray
    """File index of the first point with this packet, i8 (m,)."""
    owned: np.ndarray
    """Whether the owner lies in this unit, bool (m,)."""
    packed: np.ndarray
    """Whether samples follow each other without a gap, bool (m,)."""

    def __len__(self) -> int:
        return len(self.offset)


@frozen(eq=False)
class Unit:
    """Consecutive points of a strip, with all that is needed to process their packets."""

    number: int
    start: int
    """File index of points[0]."""
    points: np.ndarray
    """Records (n,) of the unit, unchanged, with laspy's field names."""
    context: np.ndarray
    """Records (k,) of points of other units that share packets with these points."""
    context_index: np.ndarray
    """Their file indices, i8 (k,), ascending."""
    packets: PacketTable
    packet_of_point: np.ndarray
    """Row of `packets` for each point, i4 (n,); -1: no usable packet."""
    packet_of_context: np.ndarray
    """Row of `packets` for each context point, i4 (k,)."""
    point_flags: np.ndarray
    """EchoFlag.NO_WAVEFORM, EchoFlag.BROKEN_PACKET or 0, u2 (n,)."""
    vectors: packet_check.VectorDecision
    forms: Mapping[int, packet_check.SampleForm]
    """How samples are stored, by descriptor index; see `StripScan.forms`."""

    def choose_packets(self, keep: PlannedFilter) -> np.ndarray:
        """Return whether a point of each packet is kept, bool (packets,)."""
        chosen = np.zeros(len(self.packets) + 1, bool)
        chosen[self.packet_of_point[keep.test(self.points, len(self.points)) == 0]] = True
        if len(self.context):
            chosen[self.packet_of_context[keep.test(self.context, len(self.context)) == 0]] = True
        return chosen[:-1]  # the last one is that of points without a packet, -1


class StripReader(Closing):
    """Reads one strip; opening reads only the headers. A context manager.

    Parameters
    ----------
    path : Path, str or StripFacts
        LAS or LAZ file of point format 4, 5, 9 or 10. If its facts are given, its headers are not read again.
    direction : {"auto", "toward", "away"}
        Where packet vectors point; "auto" decides from the points.
    headerless : bool
        Accept a .wdp without its 60-byte header.
    unit_points, unit_bytes : int or None
        Most points of a unit, and bytes of their records; None: UNIT_POINTS, UNIT_BYTES.
    sizes : ScanSizes
        What a scan holds at a time.

    Raises
    ------
    InputError
        If the strip cannot be read as what it claims to be.
    """

    def __init__(
        self, path: Path | str | StripFacts, *, direction: str = "auto", headerless: bool = False,
        unit_points: int | None = None, unit_bytes: int | None = None, sizes: ScanSizes = SCAN_SIZES,
    ) -> None:  # fmt: skip
        if direction not in packet_check.DIRECTIONS:
            raise ConfigError(f"direction {direction!r}: must be one of {', '.join(packet_check.DIRECTIONS)}")
        if isinstance(path, StripFacts):
            facts = path
        else:
            with reading(Path(path)):
                facts = find_facts(Path(path), direction, headerless)
        self.facts, self._sizes = facts, sizes
        most = (unit_bytes or UNIT_BYTES) // facts.header.point_length
        self._unit_points = max(1, min(unit_points or UNIT_POINTS, most))
        self._points = open_points(facts)
        with undoing(self._points.close):
            self._judge = packet_check.Judge(facts)
            self._packets = PacketFile(facts.packets, facts.compressed)

    def close(self) -> None:
        """Close the files; scans stay valid."""
        self._points.close()
        self._packets.close()

    def scan(self, *, tolerant: bool = False, force: bool = False, parts: Sequence[ScanPart] = ()) -> StripScan:
        """Return the result of one pass over the point records; samples of some packets are read.

        tolerant: put reasons against processing into `problems` instead of raising InputError. force: do not refuse
        packets of another strip. parts: of all units, in order, where other processes have passed over the points.
        """
        scan = Scanner(self.facts, self._points, self._packets, self._unit_points, self._sizes).run(parts)
        if not scan.problems:
            stranger, mixed = self._find_stranger(scan)
            remedy = "get the one of this strip, or use it all the same with `wavebatch run --force`"
            problems = (f"{stranger}; {remedy}",) if stranger and not force else ()
            warnings = (*scan.warnings, *mixed)
            doubts = {**scan.doubts, **dict.fromkeys(mixed, "foreign-packets")}
            scan = replace(scan, stranger=stranger, problems=problems, doubts=doubts, warnings=warnings)
        if scan.problems and not tolerant:
            scan.close()
            raise InputError(f"{self.facts.path}: {scan.problems[0]}")
        return scan

    def scan_units(self, first: int, last: int) -> ScanPart:
        """Return what `scan` needs to know of the units [first, last), which are among those of `cut_scan`."""
        scan = Scanner(self.facts, self._points, self._packets, self._unit_points, self._sizes)
        return scan.scan_units(first, last).seal()

    def cut_scan(self, parts: int) -> list[tuple[int, int]]:
        """Return at most so many runs of units that may be scanned one by one, by any processes."""
        return scanner.cut_scan(self.unit_count(), self._unit_points, parts, self._sizes)

    def _find_stranger(self, scan: StripScan) -> tuple[str, tuple[str, ...]]:
        """Why the packets of the .wdp are certainly those of another strip, and a line where those of some points are.
        """
        file = self.facts.packets.file
        if not scan.with_waveform or self.facts.packets.internal or file is None:
            return "", ()
        number = self.sample_size(scan, packet_check.WAVEFORMS, packet_check.SAMPLES)
        table = packet_check.compare_returns(self._sample_returns(scan, number))
        chance = "lie on echoes no more often than by chance, and are not as strong as these"
        if packet_check.is_strange(table):
            return f"{file.name} belongs to another strip: in a sample of {len(table)} packets, returns {chance}", ()
        points = ", ".join(f"{first} to {last}" for first, last in packet_check.find_strange(table))
        if not points:
            return "", ()
        where = f"{file.name}: packets of points around {points} are not theirs"
        return "", (f"{where}: returns {chance}; get the file again",)

    def _sample_returns(self, scan: StripScan, n_waveforms: int) -> Iterator[tuple[WaveformBlock, np.ndarray]]:
        """Yield about `n_waveforms` waveforms, each block with the intensities of its returns."""
        for unit, rows in self.sample_units(scan, n_waveforms):
            for block, _ in self.read_rows(unit, rows, n_waveforms):
                if block.returns is None:
                    continue
                # The few returns that stand in another unit get the intensity of a point of this one.
                near = np.clip(block.returns.point - unit.start, 0, len(unit.points) - 1)
                yield block, unit.points["intensity"][near].astype(float)

    def unit_count(self) -> int:
        """Return the number of units."""
        return -(-self.facts.header.point_count // self._unit_points)

    def read_points(self, start: int, stop: int, scan: StripScan | None = None) -> np.ndarray:
        """Return records [start, stop) of the file; those of one unit are not decoded again where scan keeps them."""
        if scan is not None:
            unit = int(np.searchsorted(scan.borders, start, "right")) - 1
            kept = scan.decoded.read(unit)[start - scan.borders[unit] : stop - scan.borders[unit]]
            if len(kept) == stop - start:
                return kept
        return self._points.read(start, stop)

    def read_unit(self, number: int, scan: StripScan) -> Unit:
        """Return unit `number` (from 0): its points and their packets; `read_blocks` reads the samples."""
        start, stop = int(scan.borders[number]), int(scan.borders[number + 1])
        points = scan.decoded.read(number)
        if not len(points):
            points = self._points.read(start, stop)
        judged = self._judge.judge(points, scan.vectors.form, scan.overfull)
        entries = scanner.unique_entries(scan.context.read(number))
        near = self._judge.judge(entries["record"], scan.vectors.form, scan.overfull)
        entries, keys, n_samples = entries[near.usable], near.keys[near.usable], near.n_samples[near.usable]
        packed = near.packed[near.usable]
        own = np.flatnonzero(judged.usable)
        index = np.concatenate([start + own, entries["index"]])
        keys = np.concatenate([judged.keys[own], keys])
        sizes = np.concatenate([points["wavepacket_size"][own], entries["record"]["wavepacket_size"]])
        n_samples = np.concatenate([judged.n_samples[own], n_samples])
        packed = np.concatenate([judged.packed[own], packed])
        # Rows of the owners of the packets, in their order, and the packet of each point.
        packet_of = np.empty(len(keys), np.int32)
        if np.all(index[1:] > index[:-1]) and np.all(keys[1:] >= keys[:-1]):  # as most vendors write them
            groups = scanner.group_keys(keys)
            packet_of[:] = np.repeat(np.arange(len(groups.starts), dtype=np.int32), groups.counts)
            lead = groups.starts
        else:
            by_index = np.argsort(index, kind="stable")
            groups = scanner.group_keys(keys[by_index])
            lead = by_index[groups.order[groups.starts]]
            order = np.argsort(index[lead], kind="stable")
            rank = np.empty(len(lead), np.int32)
            rank[order] = np.arange(len(lead), dtype=np.int32)
            packet_of[by_index[groups.order]] = np.repeat(rank, groups.counts)
            lead = lead[order]
        packets = PacketTable(
            digitizer=(keys[lead] & np.uint64(255)).astype(np.uint8),
            offset=keys[lead] >> packet_check.INDEX_BITS,
            size=sizes[lead],
            n_samples=n_samples[lead],
            owner=index[lead],
            owned=(index[lead] >= start) & (index[lead] < stop),
            packed=packed[lead],
        )
        packet_of_point = np.full(len(points), -1, np.int32)
        packet_of_point[own] = packet_of[: len(own)]
        return Unit(
            number=number,
            start=start,
            points=points,
            context=np.ascontiguousarray(entries["record"]),
            context_index=index[len(own) :],
            packets=packets,
            packet_of_point=packet_of_point,
            packet_of_context=packet_of[len(own) :],
            point_flags=judged.flags,
            vectors=scan.vectors,
            forms=scan.forms,
        )

    def read_blocks(self, unit: Unit, size: int, owned_only: bool) -> Iterator[tuple[WaveformBlock, np.ndarray]]:
        """Yield blocks of at most `size` waveforms of one digitizer and one length, each with its rows of unit.packets.

        owned_only: skip packets whose first point lies in another unit.
        """
        rows = np.flatnonzero(unit.packets.owned) if owned_only else np.arange(len(unit.packets))
        yield from self.read_rows(unit, rows, size)

    def read_units(self, scan: StripScan) -> Iterator[Unit]:
        """Yield all units of the strip."""
        return (self.read_unit(number, scan) for number in range(self.unit_count()))

    def all_blocks(self, scan: StripScan, size: int) -> Iterator[WaveformBlock]:
        """Yield every packet of the strip once, in blocks as those of `read_blocks`."""
        for unit in self.read_units(scan):
            for block, _ in self.read_blocks(unit, size, owned_only=True):
                yield block

    def sample_size(self, scan: StripScan, most: int = SAMPLE_WAVEFORMS, samples: int = SAMPLE_SAMPLES) -> int:
        """Return how many waveforms of the strip are read, by default for a survey: at most so many, and samples."""
        used = (digitizer for index, digitizer in self.facts.digitizers.items() if index in scan.by_descriptor)
        longest = max((digitizer.n_samples for digitizer in used), default=0)
        return int(np.clip(samples // max(longest, 1), LEAST_WAVEFORMS, most))

    def sample_blocks(
        self, scan: StripScan, n_waveforms: int, size: int = 4096, *, long_samples: int = LONG_SAMPLES
    ) -> Iterator[WaveformBlock]:
        """Yield about `n_waveforms` waveforms spread evenly over the strip, the same ones every time.

        Fewer of those longer than LONG, so that they have at most `long_samples` samples together.

        Within a unit the packets are taken in the order of their bytes, and blocks come in that order: a survey of the
        strip does not change where its points are sorted in another way.
        """
        if n_waveforms <= 0:
            return
        for unit, rows in self.sample_units(scan, n_waveforms, long_samples):
            for block, _ in self.read_rows(unit, rows, size):
                yield block

    def sample_units(
        self, scan: StripScan, n_waveforms: int, long_samples: int = LONG_SAMPLES
    ) -> Iterator[tuple[Unit, np.ndarray]]:
        """Yield units, each with its rows (k,) of unit.packets that `sample_blocks` reads."""
        chosen = even_places(self.unit_count(), _SAMPLED_UNITS).tolist()
        left = n_waveforms
        for position, number in enumerate(chosen):
            unit = self.read_unit(number, scan)
            rows = np.flatnonzero(unit.packets.owned)
            rows = rows[np.lexsort((unit.packets.digitizer[rows], unit.packets.offset[rows]))]
            share = -(-left // (len(chosen) - position))
            rows = rows[even_places(len(rows), share)]
            left -= len(rows)
            # Of those longer than LONG as many as have their share of the samples that are left.
            length, room = unit.packets.n_samples[rows], long_samples // (len(chosen) - position)
            long = np.flatnonzero(length > LONG)
            if length[long].sum() > room:
                long = long[even_places(len(long), room // int(length.max()))]
                rows = rows[np.union1d(np.flatnonzero(length <= LONG), long)]
            long_samples -= int(length[long].sum())
            yield unit, rows
            if left <= 0:
                return

    def read_rows(self, unit: Unit, rows: np.ndarray, size: int) -> Iterator[tuple[WaveformBlock, np.ndarray]]:
        """Yield blocks of the packets `rows` (k,) of the unit, as `read_blocks`.

        Trailing padding is cut off, other fill is marked as missing, counts of inverted waveforms are mirrored.
        """
        geometry = _Geometry(unit, self.facts)
        for samples, digitizer, chosen in self.read_counts(unit, rows, size):
            stored = self.facts.digitizers[digitizer.index]
            length = recorded_lengths(samples)
            for recorded in distinct(length).tolist():
                part = np.flatnonzero(length == recorded)
                kept = samples if len(part) == len(chosen) else samples[part]
                kept = np.ascontiguousarray(kept[:, :recorded])
                missing = find_fill(kept, stored.max_count, digitizer.max_count)
                if missing is not None:
                    kept = quiet_fill(kept, missing)
                kept.flags.writeable = False
                yield geometry.build_block(chosen[part], digitizer, kept, missing), chosen[part]

    def read_counts(
        self, unit: Unit, rows: np.ndarray, size: int
    ) -> Iterator[tuple[np.ndarray, Digitizer, np.ndarray]]:
        """Yield counts of the packets `rows` (k,) of the unit as they are stored, in groups of one kind.

        Each group has its samples (n, s), their digitizer and its rows of unit.packets. Counts of inverted waveforms
        are mirrored.
        """
        table = unit.packets
        kinds = (table.digitizer[rows].astype(np.int64) << 32) | (table.packed[rows].astype(np.int64) << 31)
        kinds |= table.n_samples[rows]
        groups = scanner.group_keys(kinds)
        for group in np.argsort(groups.order[groups.starts]).tolist():
            start = groups.starts[group]
            same = rows[groups.order[start : start + groups.counts[group]]]
            stored = self.facts.digitizers[int(table.digitizer[same[0]])]
            packed, n_samples = bool(table.packed[same[0]]), int(table.n_samples[same[0]])
            form = unit.forms.get(stored.index, packet_check.PLAIN)
            digitizer = form.digitizer(stored, packed)
            step = max(1, min(size, BLOCK_BYTES // (n_samples * digitizer.width)))
            for begin in range(0, len(same), step):
                chosen = same[begin : begin + step]
                places = table.offset[chosen]
                samples = packet_check.read_packet_samples(self._packets, places, n_samples, stored, packed, form)
                yield samples, digitizer, chosen


class _Geometry:
    """Positions and returns of the waveforms of a unit."""

    def __init__(self, unit: Unit, facts: StripFacts) -> None:
        self._unit, self._facts = unit, facts
        self._all: np.ndarray | None = None
        packet_of = np.concatenate([unit.packet_of_point, unit.packet_of_context])
        index = np.concatenate([np.arange(unit.start, unit.start + len(unit.points)), unit.context_index])
        used = np.flatnonzero(packet_of >= 0)
        order = find_order(packet_of[used], index[used])
        self._entry = used if order is None else used[order]
        self._index = index[self._entry]
        self._counts = np.bincount(packet_of[used], minlength=len(unit.packets))
        self._starts = np.cumsum(self._counts) - self._counts

    def build_block(
        self, rows: np.ndarray, digitizer: Digitizer, samples: np.ndarray, missing: np.ndarray | None
    ) -> WaveformBlock:
        """Return the block of packets `rows`; the first return of each packet is its owner."""
        counts = self._counts[rows]
        place = join_ranges(self._starts[rows], counts)
        if self._all is None:
            unit = self._unit
            self._all = join_records(unit.points, unit.context) if len(unit.context) else unit.points
        records = take_whole_records(self._all, self._entry[place])
        xyz = locate(records, self._facts.header)
        location = widen_integers(records["return_point_wave_location"])
        owner = np.cumsum(counts) - counts
        lead = take_whole_records(records, owner)
        toward = packet_check.read_toward(lead, self._unit.vectors.direction, self._unit.vectors.form)
        owners = self._unit.packets.owner[rows]
        return WaveformBlock(
            digitizer=digitizer,
            samples=samples,
            first=int(owners[0]),
            point=owners,
            gps_time=widen_integers(lead["gps_time"]),
            origin=xyz[owner] + location[owner, None] * toward,
            direction=-PS_PER_NS * toward,
            returns=ReturnTable(
                np.repeat(np.arange(len(rows), dtype=np.int32), counts), location / PS_PER_NS, self._index[place], xyz
            ),
            scanner=read_scanner(lead),
            missing=missing,
        )


MOST_SLICES = 4096
"""Most places of a strip at which rays are read."""

SLICE_POINTS, RAYS_PER_SLICE = 2048, 256
"""Points read at one place, and rays kept of them."""

SLICE_SECONDS = 0.5
"""Time [s] after which another place of the same unit is read: an aircraft moves 30 m in it."""

MIXED = 0.05
"""Share of the points that are earlier than the point before them, from which a file is not sorted by time. Of sorted
files hardly any is."""

SCALE_PLACES = 16
"""Most places at which distances of returns are compared with their times."""

LEAST_PAIRS, SCALE_SPREAD, BENT = 20, 0.05, 0.1
"""Fewest pairs of returns that show the unit of coordinates, and largest relative distance of their quartiles; and by
how much, over their distance, returns of one pulse may be off its ray: their times may be rounded to samples."""

FINE_HEIGHTS = 0.01
"""Largest step of heights of which most are 0 by normalisation only: measured ground scatters by more, but in steps of
.1 m a polder is level at 0."""

GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""What steps through a strip have over a whole number, the next smaller one: those that are whole see one sensor only
where two take turns."""

_SLICES_PER_UNIT = 4
_LEAST_RATIO, _LARGEST_RATIO = 0.3, 3.0
"""Vectors with other lengths over c/2 are no directions."""
_LEAST_PAIR = 2.0
"""Least distance of two returns [m] that give a direction: returns are placed to a few cm."""


class RaySample(NamedTuple):
    """n rays in order of time."""

    time: np.ndarray
    """f8 (n,) [s]."""
    point: np.ndarray
    """Position of the echo, f8 (n, 3) [m]."""
    direction: np.ndarray
    """Away from the sensor, any length, f8 (n, 3)."""
    weight: np.ndarray
    """Relative weight (inverse variance) of the direction, f8 (n,)."""
    vector: np.ndarray = np.empty((0, 3))
    """Of pairs: the packet's, away from the sensor, any length, f8 (n, 3); NaN where it is no direction."""
    digitizer: np.ndarray = np.empty(0, np.uint8)
    """Index of the packet's digitizer, u1 (n,)."""


def sample_rays(reader: StripReader, scan: StripScan) -> tuple[RaySample, RaySample]:
    """Return the rays of a strip from packet vectors, and those from pulses with two returns.

    RAYS_PER_SLICE rays, or somewhat more, at each of about MOST_SLICES places. Of units that are sorted by place, not
    time, rays from all over the unit are added: each of its places has rays of a short time only.
    """
    kept, pairs = [], []

    def take(start: int, stop: int) -> tuple[float, bool]:
        points = reader.read_points(start, stop, scan)
        xyz, time = locate(points, reader.facts.header), widen_integers(points["gps_time"])
        with np.errstate(all="ignore"):
            away = -packet_check.read_toward(points, scan.vectors.direction, scan.vectors.form)
            ratio = np.sqrt((away * away).sum(axis=1)) * (PS_PER_NS / HALF_C)
            good = (points["wavepacket_index"] > 0) & (ratio > _LEAST_RATIO) & (ratio < _LARGEST_RATIO)
        away = np.where(good[:, None], away, np.nan)
        # Coarse times are equal for neighbouring pulses too, whose points lie on no ray.
        number, packet = split_numbers(points)[0], points["wavepacket_offset"]
        of_pulse = (number[1:] > number[:-1]) | (packet[1:] == packet[:-1])
        place = np.flatnonzero((time[1:] == time[:-1]) & of_pulse)
        apart = xyz[place + 1] - xyz[place]
        square = (apart * apart).sum(axis=1)
        far = np.flatnonzero(np.isfinite(square) & (square > _LEAST_PAIR**2))[:RAYS_PER_SLICE]
        middle = 0.5 * (xyz[place[far]] + xyz[place[far] + 1])
        digitizer, first = points["wavepacket_index"], place[far]
        pairs.append(RaySample(time[first], middle, apart[far], square[far], away[first], digitizer[first]))
        step = len(points) // RAYS_PER_SLICE
        rows = np.arange(0, len(points), step - 1 + GOLDEN if step > 1 else 1).astype(np.int64)
        rows = rows[np.isfinite(time[rows]) & np.isfinite(xyz[rows]).all(axis=1) & np.isfinite(away[rows, 0])]
        kept.append(RaySample(time[rows], xyz[rows], away[rows], np.ones(len(rows)), away[rows], digitizer[rows]))
        return float(time[0]), bool(np.count_nonzero(time[1:] < time[:-1]) > MIXED * len(time))

    units = _choose_units(scan)
    starts = [take(start, min(start + SLICE_POINTS, stop)) for start, stop in units]
    if units:
        end = units[-1][1]
        starts.append(take(max(units[-1][0], end - SLICE_POINTS), end))
    share = min(_SLICES_PER_UNIT, MOST_SLICES // max(len(units), 1))
    for (start, stop), (begin, is_mixed), (until, _) in zip(units, starts, starts[1:], strict=False):
        if is_mixed and stop - start > SLICE_POINTS:
            take(start, stop)
            continue
        seconds = abs(until - begin)
        number = int(np.clip(np.ceil(seconds / SLICE_SECONDS), 1, share)) if np.isfinite(seconds) else share
        for edge in (start + np.arange(1, number) * ((stop - start) // number)).tolist():
            take(edge, min(edge + SLICE_POINTS, stop))
    samples = []
    for parts in (kept, pairs):
        columns = [np.empty(0), np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty((0, 3)), np.empty(0, "u1")]
        if parts:
            columns = [np.concatenate(values) for values in zip(*parts, strict=True)]
        order = np.argsort(columns[0], kind="stable")
        samples.append(RaySample(*(values[order] for values in columns)))
    return samples[0], samples[1]


class PairScale(NamedTuple):
    """How returns of one pulse lie by their coordinates, against their times in the packet and its vector."""

    scale: float | None = None
    """Distance over that by their times: 1 where coordinates and vectors have the same unit; None where pairs do not
    agree."""
    bent: float = 0.0
    """Share of the pairs whose second return lies off the ray of the first by BENT of their distance, and more."""
    pairs: int = 0
    aside: float = 0.0
    """How far the second return is from the ray of the first, over their distance and beyond the steps of coordinates:
    median."""
    level: bool = False
    """Whether heights count from the ground: most of its points, of which there are LEAST_PAIRS, have the height 0."""


def measure_scale(reader: StripReader, scan: StripScan) -> PairScale:
    """Compare returns of one pulse, and heights of the ground, at up to SCALE_PLACES places of the strip."""
    ratios, bends, asides, heights = [np.empty(0)], [np.empty(0)], [np.empty(0)], [np.empty(0)]
    units = _choose_units(scan)
    units, each = units[:: max(1, -(-len(units) // SCALE_PLACES))], max(SCALE_PLACES // max(len(units), 1), 1)
    places = [(first, stop) for begin, stop in units
              for first in range(begin, stop, max((stop - begin) // each, SLICE_POINTS))]  # fmt: skip
    for start, stop in places:
        points = reader.read_points(start, min(start + SLICE_POINTS, stop), scan)
        xyz, time = locate(points, reader.facts.header), widen_integers(points["gps_time"])
        heights.append(xyz[read_classes(points) == GROUND, 2])
        with np.errstate(all="ignore"):
            vectors = packet_check.read_toward(points, scan.vectors.direction, scan.vectors.form)
            place = np.diff(widen_integers(points["return_point_wave_location"]))
            same = (time[1:] == time[:-1]) & (points["wavepacket_offset"][1:] == points["wavepacket_offset"][:-1])
            by_time = np.abs(place) * np.sqrt((vectors[1:] ** 2).sum(axis=1))
            way = np.diff(xyz, axis=0)
            apart = np.sqrt((way**2).sum(axis=1))
            off = np.sqrt(((way + place[:, None] * vectors[1:]) ** 2).sum(axis=1))
            good = same & (points["wavepacket_index"][1:] > 0) & (by_time > 0) & np.isfinite(apart)
            good &= np.maximum(by_time, apart) > _LEAST_PAIR  # by times in ns all are close
            ratios.append((apart / by_time)[good])
            bends.append((off / by_time)[good])
            along = (way * vectors[1:]).sum(axis=1) / np.sqrt((vectors[1:] ** 2).sum(axis=1))
            side = np.sqrt(np.maximum(apart**2 - along**2, 0.0))
            # Two positions are rounded by half a step each, in two axes; programs write cm or dm in steps of mm.
            steps = (np.gcd.reduce(np.diff(points[name].astype(np.int64))) for name in "XYZ")
            rounded = 1.5 * max(step * abs(one) for step, one in zip(steps, reader.facts.header.scales, strict=True))
            asides.append(np.nan_to_num(np.maximum(side - rounded, 0.0) / apart, posinf=0.0)[good])
    ratio, height = np.concatenate(ratios), np.concatenate(heights)
    step = abs(reader.facts.header.scales[2])
    zero = np.count_nonzero(np.abs(height) < 0.5 * step) if step <= FINE_HEIGHTS else 0
    level = bool(len(height) >= LEAST_PAIRS and 2 * zero > len(height))
    if len(ratio) < LEAST_PAIRS:
        return PairScale(level=level)
    low, middle, high = (quantile(ratio, share) for share in (0.25, 0.5, 0.75))
    bent = float(np.mean(np.concatenate(bends) > BENT))
    scale = middle if high - low < SCALE_SPREAD * middle else None
    return PairScale(scale, bent, len(ratio), quantile(np.concatenate(asides), 0.5), level)


def _choose_units(scan: StripScan) -> list[tuple[int, int]]:
    """Units [start, stop) all over the strip, at most MOST_SLICES of them."""
    borders = scan.borders
    chosen = even_places(len(borders) - 1, MOST_SLICES)
    return [(int(borders[i]), int(borders[i + 1])) for i in chosen.tolist() if borders[i + 1] > borders[i]]
