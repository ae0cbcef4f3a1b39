"""Check of packets: which points have a usable packet, and why the others have none.

The scan and the reader judge each piece of points. After this check packets are read without any further one, so a
packet is usable only if all its bytes lie inside the waveform data.

Direction and length of packet vectors are decided from the points, never assumed: vendors understood the LAS text in
two ways (docs/las-waveforms.md 1.4). Returns that share a packet show which: the position of sample 0 must be equal for
all of them; it is P + L v if v points toward the sensor, P - L v if away. Heights are the second evidence: an airborne
sensor is above its returns. The scan collects the votes.

A .wdp of another strip, under the right name, looks like any other: nothing in it names its strip. But in a strip's own
packets echoes lie where its returns say, or are as strong as these (`is_strange`). Before you change it: only packets
that are certainly strange are refused. Locations that are wrong, in another unit or all zero are no proof;
`doubt_packets` in surveying/inspect_strip.py warns of them.

How the samples of a strip are stored (the order of packed bits, and whether counts go down where light comes in) is
decided by the scan once per descriptor, from packets spread over the strip, because neither stands in the file;
`StripReader.read_rows` reads all samples through `read_packet_samples`. docs/las-waveforms.md 1.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace
from enum import IntEnum

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.frozen import changeable, frozen
from wavebatch.core.order import distinct, even_places, known_median, median, quantile
from wavebatch.core.units import HALF_C, PS_PER_NS
from wavebatch.core.waveforms import Digitizer, WaveformBlock
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.strip.packets import (
    BLOCK_BYTES,
    COMPRESSED,
    MAX_SAMPLES,
    PacketFile,
    StripFacts,
    refuse_compressed,
)
from wavebatch.kernels.packets import FIELDS, Geometry, PacketRules, judge_packets
from wavebatch.kernels.signal.signal import LEAST_PADDING, find_fill, recorded_lengths

DIRECTIONS = ("auto", "toward", "away")
VECTORS = ("x_t", "y_t", "z_t")
LEAST_RATIO, LARGEST_RATIO = 0.7, 1.02
"""Outside these limits the length of vectors over c/2 gives a warning; usual files have 0.96 to 1.00."""
RANGE_RATIO = 100.0
"""Longer vectors, over c/2, are not speeds: Optech wrote the whole path from sample 0 to the return."""
_APART = 2.0 * PS_PER_NS
"""Least difference of return locations of a pair [ps]; closer returns give no evidence."""
_PER_CALL = 256
"""Most votes of one part, so that each part of the strip counts about the same."""
_CLEAR, _MOSTLY = 0.95, 0.8
"""Share of votes that decides: of heights, which terrestrial strips break, and of pairs."""
_ENOUGH = 3
"""Fewer pairs than this decide nothing if heights do."""


@frozen
class VectorDecision:
    """Meaning of the packet vectors of a strip."""

    direction: str
    """`toward` or `away` from the sensor (for the form `range`: after division by minus the location)."""
    form: str
    """`stored`: metres per picosecond; `range`: the whole path, to be divided by minus the location."""
    ratio: float
    """Median length over c/2; NaN without waveforms."""
    evidence: str
    warnings: tuple[str, ...]
    problems: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    """Warnings by which echoes lie wrong."""


@changeable
class DirectionTally:
    """Votes for both directions, collected in parts; each part counts with at most a few hundred points."""

    form: str
    """See `VectorDecision`."""
    pairs: list[int] = field(default_factory=lambda: [0, 0])
    """Pairs of returns that vote for toward, for away."""
    heights: list[int] = field(default_factory=lambda: [0, 0])
    """Vectors that point up, down."""
    ratios: list[np.ndarray] = field(default_factory=list)
    """Lengths over c/2."""

    def join(self, other: DirectionTally) -> None:
        """Add the votes of further points."""
        self.pairs = [mine + more for mine, more in zip(self.pairs, other.pairs, strict=True)]
        self.heights = [mine + more for mine, more in zip(self.heights, other.heights, strict=True)]
        self.ratios += other.ratios

    def add_points(self, points: np.ndarray) -> None:
        """Add the votes of usable points (n,): length and height of their vectors."""
        some = points[:: max(1, len(points) // _PER_CALL)]
        height = read_toward(some, "toward", self.form)[:, 2]
        self.heights[0] += int((height > 0).sum())
        self.heights[1] += int((height < 0).sum())
        self.ratios.append(measure_ratio(some, self.form))

    def add_pairs(self, xyz: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
        """Add the votes of pairs of usable points that share a packet: xyz f8 (2, n, 3) [m], records (n,)."""
        a, b = widen_integers(first["return_point_wave_location"]), widen_integers(second["return_point_wave_location"])
        use = np.flatnonzero(np.abs(a - b) > _APART)
        use = use[:: max(1, len(use) // _PER_CALL)]
        if not len(use):
            return
        step = xyz[0, use] - xyz[1, use]
        paths = read_toward(first[use], "toward", self.form) * a[use, None]
        paths -= read_toward(second[use], "toward", self.form) * b[use, None]
        toward = np.sqrt(((step + paths) ** 2).sum(axis=1))
        away = np.sqrt(((step - paths) ** 2).sum(axis=1))
        large, small = np.maximum(toward, away), np.minimum(toward, away)
        clear = (large > 0.1) & (small < 0.5 * large)
        self.pairs[0] += int((clear & (toward < away)).sum())
        self.pairs[1] += int((clear & (away < toward)).sum())


def measure_ratio(points: np.ndarray, form: str) -> np.ndarray:
    """Return the length of the vectors over c/2, f8 (n,); not finite if it cannot be computed."""
    vectors = stack_vectors(points)
    length = np.sqrt((vectors * vectors).sum(axis=1)) * (PS_PER_NS / HALF_C)
    if form == "range":
        with np.errstate(divide="ignore", invalid="ignore"):
            length = length / np.abs(widen_integers(points["return_point_wave_location"]))
    return length


def stack_vectors(points: np.ndarray) -> np.ndarray:
    """Return the vectors of records (n,) as stored, f8 (n, 3)."""
    return np.stack([widen_integers(points[name]) for name in VECTORS], axis=1)


def read_toward(points: np.ndarray, direction: str, form: str) -> np.ndarray:
    """Return vectors toward the sensor [m/ps], f8 (n, 3), with the length of the file."""
    vectors = stack_vectors(points)
    if form == "range":
        vectors /= -widen_integers(points["return_point_wave_location"])[:, None]
    return vectors if direction == "toward" else -vectors


def decide_direction(tally: DirectionTally, option: str, metres: float = 1.0) -> VectorDecision:
    """Return the decision by the votes; with `auto`, contradicting or missing votes are a problem of the strip.

    metres: of a unit of the coordinates, in which vectors may be, too.
    """
    if not any(len(part) for part in tally.ratios):
        chosen = "toward" if option == "auto" else option
        return VectorDecision(chosen, tally.form, float("nan"), "no waveform to decide from", (), ())
    ratio = quantile(np.concatenate(tally.ratios), 0.5)
    warnings, problems, doubts = [], [], []
    if tally.form == "range":
        warnings.append(
            f"packet vectors are more than {RANGE_RATIO:g} times c/2 long; they are read as whole paths (as Optech "
            "wrote them) and divided by minus the return location"
        )
    if not any(LEAST_RATIO <= length <= LARGEST_RATIO for length in (ratio, metres * ratio)):
        doubts.append(
            f"packet vectors are {ratio:.4g} times c/2 long (usual: 0.96 to 1.00), as unit vectors are, or those in "
            "another unit than metres per ps; new echoes may lie wrong"
        )
    (toward, away), (up, down) = tally.pairs, tally.heights
    pairs, heights = (
        "toward" if 0 < share * (one + other) <= one else "away" if 0 < share * (one + other) <= other else ""
        for one, other, share in ((toward, away, _MOSTLY), (up, down, _CLEAR))
    )
    evidence = f"{toward} of {toward + away} pairs that share a packet and {up} of {up + down} heights say toward"
    if toward + away < _ENOUGH and heights:
        pairs = ""
    chosen = pairs or heights or "toward"
    if pairs and heights and pairs != heights:
        problems.append(f"packet vectors contradict each other: {evidence}; pass --direction toward or away")
    elif not (pairs or heights):
        problems.append(f"the direction of packet vectors is not clear: {evidence}; pass --direction toward or away")
    if option != "auto":
        if chosen != option or problems:
            warnings.append(f"--direction {option} overrides the evidence of the file: {evidence}")
        chosen, problems, evidence = option, [], f"given; {evidence}"
    return VectorDecision(chosen, tally.form, ratio, evidence, tuple(warnings), tuple(problems), tuple(doubts))


WAVEFORMS, SAMPLES = 1024, 1 << 20
"""Most waveforms that are compared with their returns, and about the most samples of them."""

LEAST_PACKETS = 50
"""Fewer returns prove nothing: the error of a rank correlation is 0.14."""

MOST_GAIN = 0.3
"""Share of the largest possible gain in height, of a return's own packet over those of others, that must be excluded.
Own packets gain .4 to 1.0, or .05 to .3 where only weak returns or mostly noise are there: then a gain of four standard
errors still shows. Those of other strips gain -.05 to .07 (real strips in every wrong combination)."""

MOST_ALIKE = 0.4
"""Largest rank correlation, in packets of another strip, of location and place of the highest sample, and of intensity
and height. At least one of them is .5 to 1.0 in own packets. Scenes and scanners that are alike bring others to .3,
rarely .5: these are left to the warning."""

_SHIFTS = np.arange(1, 5) / 5
"""How far away the returns are, as a share of all of them, at whose locations a return's packet is looked at too."""

STRETCH = 64
"""Waveforms of the sample that are looked at together: some more than prove something."""

_HIGHEST, _WHERE, _LOCATION, _INTENSITY, _OWN, _OTHERS, _DEPTH, _POINT = range(8)
"""Columns of a table of returns."""


def is_strange(table: np.ndarray, errors: float = 4.0) -> bool:
    """Return whether nothing ties returns, f8 (m, 8) of `compare_returns`, to their packets, though own ones would.

    errors: standard errors that a gain of own packets may be off.
    """
    # In a packet of noise the highest sample is as far above the median as the lowest one below it.
    table = table[table[:, _HIGHEST] > 2.0 * median(table[:, _DEPTH])] if len(table) else table
    if len(table) < LEAST_PACKETS:
        return False
    # Where all returns lie at one place, own packets would look the same; intensities alone may be scaled.
    if quantile(table[:, _LOCATION], 0.75) - quantile(table[:, _LOCATION], 0.25) < 1.0:
        return False
    gains, possible = table[:, _OWN] - table[:, _OTHERS], 1.0 - table[:, _OTHERS].mean()
    error = errors * gains.std() / np.sqrt(len(gains))
    if gains.mean() > error or gains.mean() + error > MOST_GAIN * possible:
        return False
    pairs = (_LOCATION, _WHERE), (_INTENSITY, _HIGHEST)
    return all(abs(_correlate(table[:, one], table[:, other])) < MOST_ALIKE for one, other in pairs)


def find_strange(table: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last point of each stretch where `is_strange` holds, of a strip where it does not.

    It gives a warning, no refusal, so that two standard errors do: by them no stretch of 32 simulated strips, with
    noises of 1 to 30, and of the real ones is strange, with or without intensities.
    """
    table = table[np.argsort(table[:, _POINT], kind="stable")]
    parts = np.array_split(table, max(len(table) // STRETCH, 1))
    strange = [is_strange(part, errors=2.0) for part in parts]
    found: list[tuple[int, int]] = []
    for part, before, now in zip(parts, [False, *strange], strange, strict=False):
        if now:
            found.append((found.pop()[0] if before else int(part[0, _POINT]), int(part[-1, _POINT])))
    return found


def _correlate(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation of values (m,); 0 where one of them is always the same."""
    ranks = []
    for values in (a, b):
        _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(counts) - 0.5 * counts)[which] - 0.5 * len(values))
    scale = np.sqrt((ranks[0] ** 2).sum() * (ranks[1] ** 2).sum())
    return float(ranks[0] @ ranks[1] / scale) if scale > 0 else 0.0


def compare_returns(blocks: Iterable[tuple[WaveformBlock, np.ndarray]]) -> np.ndarray:
    """Compare packets with their strongest returns.

    Parameters
    ----------
    blocks : iterable of WaveformBlock and array
        A sample of the strip, with the intensities of the returns of each block.

    Returns
    -------
    f8 (m, 8)
        A row per packet with signal: height above the median and place of its highest sample; location, in samples, and
        intensity of the return; how high the packet is there, as a share of its highest sample, and at the locations of
        the returns of others; depth of its lowest sample below the median; index of the return's point.
    """
    groups: dict[int, list[tuple[np.ndarray, ...]]] = {}
    for block, strength in blocks:
        returns = block.returns
        if returns is None:
            continue
        order = np.lexsort((-strength, returns.waveform))
        strongest = order[np.unique(returns.waveform[order], return_index=True)[1]]
        part = block.samples, returns.time[strongest] / block.spacing, strength[strongest], returns.point[strongest]
        groups.setdefault(block.digitizer.index, []).append(part)
    tables = [np.empty((0, 8))]
    for group in groups.values():
        places = np.concatenate([place for _, place, *_ in group])
        sets = [places, *(np.roll(places, int(share * len(places))) for share in _SHIFTS)]
        first = 0
        for samples, place, strength, point in group:
            last = first + len(samples)
            height, level = samples.max(axis=1).astype(float), median(samples, axis=1)
            height -= level
            # The highest of three samples at each place; one beyond the end has that of the end.
            end, row = samples.shape[1] - 1, np.arange(len(samples))[:, None]
            middles = (np.rint(np.clip(at[first:last, None], 0, end)).astype(np.int64) for at in sets)
            near = [samples[row, np.clip(middle + (-1, 0, 1), 0, end)].max(axis=1) for middle in middles]
            found = (np.stack(near) - level) / np.maximum(height, 1.0)
            table = [height, samples.argmax(axis=1), place, strength, found[0], found[1:].mean(axis=0)]
            tables.append(np.column_stack([*table, level - samples.min(axis=1), point])[height > 0])
            first = last
    return np.concatenate(tables)


INDEX_BITS = np.uint64(8)
"""Bits of the descriptor index in a key; see `Judged.keys`."""
WHOLE_BITS = (8, 16, 32)
"""Bits per sample that fill whole bytes; others (12 bits) are stored in two bytes, or packed."""
PACKED_BITS = (10, 12)
"""Bits per sample that are also read where they follow each other without a gap."""
MOST_BITS = 32
MAX_SPACING = 1000.0
"""Largest spacing of samples [ns]; digitizers have 0.2 to 10 ns, a larger one is damage."""
USUAL_SPACINGS = 0.01, 100.0
"""Spacings of samples [ns] without a warning: no converter is faster, and no pulse of lidar so long; ps that are ns, fs
or µs are off by 1000."""
MOST_STORED = 2**31 - 1
"""Largest stored coordinate."""
MAX_LOCATION = 1e9
"""Largest return location [ps]: 1 ms is 150 km of range; a larger one is damage."""

_NAMES = (
    "wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", *VECTORS,
)  # fmt: skip
"""Fields that decide, in the order of `kernels.packets.FIELDS`."""


class Reason(IntEnum):
    """Reason why the packet of a point cannot be used; kernels/c/packets.h has the same numbers."""

    USABLE = 0
    NO_WAVEFORM = 1
    NO_DESCRIPTOR = 2
    BAD_DESCRIPTOR = 3
    EMPTY = 4
    OUTSIDE = 5
    NO_GEOMETRY = 6
    OVERFULL = 7
    PACKED = 8
    DAMAGED = 9
    CUT = 10
    AT_LIMIT = 11


REASON_TEXTS = {
    Reason.NO_DESCRIPTOR: "with a descriptor that the header does not have",
    Reason.BAD_DESCRIPTOR: "with a descriptor that is empty, too long, without spacing, or of more than 32 bits",
    Reason.EMPTY: "with a packet without a whole sample",
    Reason.CUT: "with a packet past the end of the waveform data",
    Reason.OUTSIDE: "with a packet before the start of the waveform data",
    Reason.NO_GEOMETRY: "with an impossible return location or packet vector (not a number, 0, or far too long)",
    Reason.OVERFULL: "in a packet of more points than a pulse can have",
    Reason.PACKED: "with samples of other than 8, 16 or 32 bits, and a packet size that fits neither whole bytes "
    "nor packed samples of 10 or 12 bits",
    Reason.DAMAGED: "with a compressed packet that is damaged",
    Reason.AT_LIMIT: "with coordinates at the limit of the file's integers, where echoes cannot be stored (damage, or "
    "too small a scale)",
}


@frozen(eq=False)
class Judged:
    """Result of the check for n points."""

    reason: np.ndarray
    """u1 (n,): a Reason."""
    n_samples: np.ndarray
    """Samples of the packet, i4 (n,); 0 if it cannot be used."""
    keys: np.ndarray
    """u8 (n,): byte offset and descriptor index in one number, equal for all returns of a packet."""
    short: np.ndarray
    """bool (n,): usable, but the packet has fewer samples than its descriptor gives."""
    packed: np.ndarray
    """bool (n,): samples follow each other without a gap; see `unpack_samples`."""
    ends: Sequence[tuple[int, int]]
    """Least and largest stored X, Y and Z; empty without points."""

    @property
    def usable(self) -> np.ndarray:
        """Whether each packet can be used, bool (n,)."""
        return self.reason == Reason.USABLE

    @property
    def flags(self) -> np.ndarray:
        """u2 (n,): NO_WAVEFORM, BROKEN_PACKET or 0."""
        table = np.full(len(Reason), int(EchoFlag.BROKEN_PACKET), np.uint16)
        table[Reason.USABLE], table[Reason.NO_WAVEFORM] = 0, int(EchoFlag.NO_WAVEFORM)
        return table[self.reason]


class Judge:
    """Separates usable packets from missing and broken ones, for many points at a time."""

    def __init__(self, facts: StripFacts) -> None:
        self._facts = facts
        known, good, odd, packs, self._compressed = (np.zeros(256, bool) for _ in range(5))
        self._spacing = np.zeros(256)
        width, samples, packed = np.ones(256, np.int64), np.zeros(256, np.int64), np.full(256, -1, np.int64)
        for index, digitizer in facts.digitizers.items():
            known[index], self._spacing[index] = True, digitizer.spacing
            good[index] = 0 < digitizer.bits <= MOST_BITS and 0 < digitizer.spacing <= MAX_SPACING
            good[index] &= 0 < digitizer.n_samples <= MAX_SAMPLES
            kind = facts.compression.get(index, 0)
            packs[index] = kind == COMPRESSED and digitizer.bits in (8, 16)
            self._compressed[index] = kind != 0 and not packs[index] and digitizer.n_samples > 0
            if good[index]:
                width[index], samples[index] = digitizer.width, digitizer.n_samples
                odd[index] = digitizer.bits not in WHOLE_BITS
                if digitizer.bits in PACKED_BITS:
                    packed[index] = packed_bytes(digitizer.n_samples, digitizer.bits)
        self._rules = PacketRules(known, good, odd, packs, width, samples, packed, *facts.packets.offsets)

    def judge(self, points: np.ndarray, form: str, overfull: np.ndarray | None = None) -> Judged:
        """Check the packets of points.

        Parameters
        ----------
        points : structured array (n,)
            Point records with waveform fields.
        form : {"stored", "range"}
            How vectors are stored; see `Decision`.
        overfull : u8 (k,) or None
            Sorted keys of packets that too many points refer to.

        Returns
        -------
        Judged

        Raises
        ------
        InputError
            If a point refers to compressed packets.
        """
        fields = dict(zip(FIELDS, (points[name] for name in _NAMES), strict=True))
        if self._compressed.any():
            used = fields["index"][(fields["index"] > 0) & (fields["size"] > 0)]
            bad = self._compressed[used]
            if bad.any():
                raise refuse_compressed(self._facts.path, self._facts.compression[int(used[np.argmax(bad)])])
        geometry = Geometry(form == "range", PS_PER_NS / HALF_C, RANGE_RATIO, MAX_LOCATION)
        reason, n_samples, keys, short, packed = judge_packets(fields, self._rules, geometry)
        ends = [(int(points[axis].min()), int(points[axis].max())) for axis in "XYZ"] if len(points) else []
        far = self._find_far(points, form, n_samples, ends)
        reason[far], n_samples[far], short[far] = Reason.AT_LIMIT, 0, False
        if overfull is not None and len(overfull):
            place = np.minimum(np.searchsorted(overfull, keys), len(overfull) - 1)
            full = (overfull[place] == keys) & (reason == Reason.USABLE)
            reason[full], n_samples[full], short[full] = Reason.OVERFULL, 0, False
        if self._rules.packs.any():
            rows = np.flatnonzero(self._rules.packs[fields["index"]] & (reason == Reason.USABLE))
            index, offset = fields["index"][rows], fields["offset"][rows]
            size = fields["size"][rows].astype(np.int64)
            # Whether compressed packets are whole, only decoding them shows.
            good = np.zeros(len(index), bool)
            packets = PacketFile(self._facts.packets, self._facts.compressed)
            try:
                for kind in distinct(index).tolist():
                    same = np.flatnonzero(index == kind)
                    length, bits = int(self._rules.samples[kind]), 8 * int(self._rules.width[kind])
                    for part in np.array_split(same, -(-len(same) * length * bits // 8 // BLOCK_BYTES)):
                        good[part] = packets.decode(offset[part], size[part], length, bits)[1]
            finally:
                packets.close()
            broken = rows[~good]
            reason[broken], n_samples[broken], short[broken] = Reason.DAMAGED, 0, False
        return Judged(reason, n_samples, keys, short, packed, ends)

    def _find_far(
        self, points: np.ndarray, form: str, n_samples: np.ndarray, ends: Sequence[tuple[int, int]]
    ) -> np.ndarray:
        """Return the rows of points with usable packets whose echoes may lie beyond the integers of the file.

        One damaged coordinate (-2^31) would otherwise fail the strip, and make a grid of voxels as wide as the Earth.
        """
        if max((max(-low, high) for low, high in ends), default=0) < MOST_STORED // 2:
            return np.empty(0, np.int64)
        far = np.flatnonzero(n_samples)
        xyz = np.stack([points[axis][far].astype(np.float64) for axis in "XYZ"], axis=1)
        location = np.abs(widen_integers(points["return_point_wave_location"][far]))
        # From a return to an echo: at most its location and the length of the packet; an offset may double it.
        time = 2.0 * (location + PS_PER_NS * n_samples[far] * self._spacing[points["wavepacket_index"][far]])
        with np.errstate(all="ignore"):
            reach = np.abs(read_toward(points[far], "toward", form)) * time[:, None] / self._facts.header.scales
            return far[np.any(np.abs(xyz) + np.abs(reach) > MOST_STORED, axis=1)]


def packed_bytes(n_samples: int, bits: int) -> int:
    """Return the bytes of a packet of packed samples."""
    return -(-n_samples * bits // 8)


SAMPLED, SAMPLED_PER_UNIT = 1024, 512
"""Packets of a descriptor, and of a unit, that decide."""
LEAST_HEIGHT, CLEAR = 5.0, 3.0
"""A waveform votes if it leaves its median by this many counts, to one side this many times as far as to the other."""
LEAST_VOTES, MAJORITY = 20, 9
"""Votes that decide, and how many times as many they must be as the others."""
LEAST_SKEWNESS = 1.0
"""Skewness of the deviations from the median that decides; one side of a Gaussian noise has 0, echoes have 3 to 10."""
SMOOTHER = 8
"""Neighbouring samples that differ so many times less with their bytes in the other order have that order: a byte that
changes at random is 256 times as large in the wrong place, and noise that hides the signal makes both alike."""
FILL_STEP = 3
"""Counts from fill to the first recorded sample, in the middle of all packets; echoes and noise fade into a level."""
FLOATS = 107 << 23, 157 << 23
"""Bits of 2^-20 and 2^30 as 32-bit floating-point numbers: samples that are such lie there, and are whole numbers or
lie over a factor of 2."""


@frozen
class SampleForm:
    """How the samples of one descriptor are stored."""

    little: bool = False
    """Packed samples begin with their lowest bit, in the lowest bit of a byte; else both with the highest."""
    inverted: bool = False
    """Counts go down where light comes in."""
    notes: tuple[str, ...] = ()
    """What was decided and why, for users."""
    doubt: str = ""
    """Why samples are no unsigned integers as LAS has them; empty where they are."""

    def digitizer(self, stored: Digitizer, packed: bool) -> Digitizer:
        """Return the digitizer of the counts that `read_packet_samples` gives."""
        if not packed:
            # Whole bytes may hold more bits than the descriptor says.
            stored = replace(stored, bits=8 * stored.width)
        return stored.mirrored() if self.inverted else stored


PLAIN = SampleForm()


def read_packet_samples(
    packets: PacketFile, offsets: np.ndarray, n_samples: int, stored: Digitizer, packed: bool, form: SampleForm
) -> np.ndarray:
    """Read the samples of packets that were checked before.

    Parameters
    ----------
    packets : PacketFile
    offsets : u8 (n,)
        Byte offsets as points have them.
    n_samples : int
        Samples per packet.
    stored : Digitizer
        As the descriptor says.
    packed : bool
        Samples follow each other without a gap.
    form : SampleForm
        Of the descriptor.

    Returns
    -------
    u1, u2 or u4 (n, n_samples)
        Counts that go up where light comes in.
    """
    if packed:
        rows = packets.read_bytes(offsets, packed_bytes(n_samples, stored.bits))
        samples = unpack_samples(rows, n_samples, stored.bits, form.little)
    else:
        samples = packets.read(offsets, n_samples, 8 * stored.width, stored.index)
    if not form.inverted:
        return samples
    return np.subtract(samples.dtype.type(form.digitizer(stored, packed).max_count), samples)


def unpack_samples(rows: np.ndarray, n_samples: int, bits: int, little: bool) -> np.ndarray:
    """Unpack samples of 9 to 16 bits that follow each other without a gap.

    Parameters
    ----------
    rows : u1 (n, packed bytes)
        Bytes of the packets.
    n_samples, bits : int
        Samples per packet, bits per sample.
    little : bool
        Lowest bit first, else highest bit first.

    Returns
    -------
    u2 (n, n_samples)
    """
    # A sample begins in one byte and ends in the next, or in the one after that.
    first = np.arange(n_samples) * bits
    places = [np.minimum((first >> 3) + step, rows.shape[1] - 1) for step in range(3)]
    low, middle, high = (rows[:, place].astype(np.uint32) for place in (places if little else places[::-1]))
    value = low | (middle << np.uint32(8)) | (high << np.uint32(16))
    shift = (first & 7) if little else 24 - bits - (first & 7)
    return ((value >> shift.astype(np.uint32)) & np.uint32((1 << bits) - 1)).astype(np.uint16)


SomePackets = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Packets of a unit: the key of each (see `Judged.keys`), its samples and whether they are packed."""


@changeable
class _Votes:
    """Waveforms whose signal goes up, and down; moments of all deviations from the medians."""

    up: int = 0
    down: int = 0
    number: int = 0
    squares: float = 0.0
    cubes: float = 0.0

    def add(self, samples: np.ndarray, tops: tuple[int, ...]) -> None:
        """Count the votes of raw counts (n, s)."""
        if not samples.size:
            return
        values = samples.astype(np.float64)
        # Fill looks like a signal that falls to zero.
        values[np.arange(samples.shape[1]) >= recorded_lengths(samples)[:, None]] = np.nan
        largest = samples.dtype.type(max(tops))
        for fill in (find_fill(samples, *tops), find_fill(largest - samples, *tops)):
            if fill is not None:
                values[fill] = np.nan
        gaps = np.isnan(values)
        values[gaps.all(axis=1)] = 0.0  # nothing but fill: no vote
        values -= (known_median if gaps.any() else median)(values, 1)[:, None]
        np.nan_to_num(values, copy=False)
        up, down = values.max(axis=1), -values.min(axis=1)
        self.up += int(np.count_nonzero((up >= LEAST_HEIGHT) & (up >= CLEAR * down)))
        self.down += int(np.count_nonzero((down >= LEAST_HEIGHT) & (down >= CLEAR * up)))
        self.number += values.size
        squares = values * values
        self.squares += float(np.sum(squares))
        self.cubes += float(np.sum(squares * values))  # a power of three takes as long as all the rest

    def join(self, other: _Votes) -> _Votes:
        """Return both together."""
        return _Votes(*(getattr(self, name) + getattr(other, name) for name in _Votes.__annotations__))

    @property
    def skewness(self) -> float:
        """Skewness of the deviations from the medians."""
        return self.cubes / self.number / (self.squares / self.number) ** 1.5 if self.squares else 0.0

    @property
    def direction(self) -> int:
        """1: the signal goes up, -1: it goes down, 0: not clear."""
        for sign, these, others in ((1, self.up, self.down), (-1, self.down, self.up)):
            if these >= LEAST_VOTES and these >= MAJORITY * others and sign * self.skewness >= LEAST_SKEWNESS:
                return sign
        return 0


def find_forms(
    digitizers: Mapping[int, Digitizer], packets: PacketFile, sample: Sequence[SomePackets]
) -> dict[int, SampleForm]:
    """Decide how the samples of each descriptor are stored.

    Parameters
    ----------
    digitizers : mapping
        Descriptors by index.
    packets : PacketFile
    sample : sequence of SomePackets
        Packets spread over the strip.

    Returns
    -------
    dict of int to SampleForm
        Without descriptors whose counts are read as they are.
    """
    # Byte offsets (k,) by descriptor, number of samples and whether they are packed.
    kinds: dict[tuple[int, int, bool], np.ndarray] = {}
    if sample:
        keys, n_samples, is_packed = (np.concatenate(part) for part in zip(*sample, strict=True))
        of_key = (keys & np.uint64(255)).astype(np.int64)
        for index in distinct(of_key).tolist():
            rows = np.flatnonzero(of_key == index)
            rows = rows[even_places(len(rows), SAMPLED)]
            pairs = np.stack([n_samples[rows], is_packed[rows]], axis=1)
            found, kind = np.unique(pairs, axis=0, return_inverse=True)
            for place, (length, packed) in enumerate(found.tolist()):
                kinds[index, length, bool(packed)] = keys[rows[kind.ravel() == place]] >> INDEX_BITS
    # Order of packed bits: in the right one, neighbouring samples differ less.
    steps: dict[int, np.ndarray] = {}
    for (index, length, packed), offsets in kinds.items():
        if packed:
            bits = digitizers[index].bits
            rows = packets.read_bytes(offsets, packed_bytes(length, bits))
            both = [unpack_samples(rows, length, bits, order).astype(np.int64) for order in (False, True)]
            here = np.array([np.abs(np.diff(values, axis=1)).sum() for values in both], np.float64)
            steps[index] = steps.get(index, np.zeros(2)) + here / max(length - 1, 1) / len(rows)
    orders = {}
    for index, (big, small) in steps.items():
        little = bool(small < big)
        first, second = ("lowest", "highest") if little else ("highest", "lowest")
        orders[index] = little, (
            f"samples of {digitizers[index].bits} bits are packed, {first} bit first: neighbouring samples differ by "
            f"{min(big, small):.1f} DN, with the {second} bit first by {max(big, small):.1f} DN"
        )
    votes: dict[int, _Votes] = {}
    wrong: dict[int, str] = {}
    for (index, length, packed), offsets in kinds.items():
        stored = digitizers[index]
        form = SampleForm(little=orders[index][0] if packed else False)
        samples = read_packet_samples(packets, offsets, length, stored, packed, form)
        tops = (stored.max_count, form.digitizer(stored, packed).max_count)
        votes.setdefault(index, _Votes()).add(samples, tops)
        for edge in (samples, samples[:, ::-1]):
            flat = (edge[:, :LEAST_PADDING] == edge[:, :1]).all(axis=1) & (edge[:, -1] != edge[:, 0])
            values, many = np.unique(edge[flat, 0], return_counts=True)
            value = int(values[np.argmax(many)]) if many.max(initial=0) >= LEAST_VOTES else 0
            rows = edge[flat & (edge[:, 0] == value)].astype(np.int64)
            # Where the noise is cut off at a threshold, most packets have the same count at both ends.
            fills = len(rows) > np.count_nonzero((edge[:, 0] == value) & (edge[:, -1] == value))
            if value not in (0, *tops) and fills:
                first = rows[np.arange(len(rows)), np.argmax(rows != value, axis=1)]
                if median(np.abs(first - value)) >= FILL_STEP:
                    wrong[index] = (
                        f"{len(rows)} of {len(samples)} packets that were looked at begin or end with equal counts of "
                        f"{value}, and a step: if these only fill packets up, echoes at the step are false; fill with 0"
                    )
        if packed or samples.dtype.itemsize == 1:
            continue
        # Counts may be multiples of a power of two, which make low bytes 0, but for the mark of clipped ones.
        step = int(np.bitwise_or.reduce(samples[samples != tops[0]]))
        native, swapped = (
            float(np.abs(np.diff(counts.astype(np.float64), axis=1)).sum())
            for counts in (samples // samples.dtype.type(max(step & -step, 1)), samples.byteswap())
        )
        seem = "have their bytes in the other order (big-endian)" if SMOOTHER * swapped < native else ""
        if samples.dtype.itemsize == 4 and samples.any():
            bare = samples[samples != 0] & np.uint32(2**31 - 1)  # without the sign
            least, most = quantile(bare, 0.01), quantile(bare, 0.99)
            # Integers that lie there by chance are no whole numbers with odd ones among them.
            rest = np.remainder(bare[bare < FLOATS[1]].view(np.float32), 2)
            whole = bool(np.isin(rest, (0, 1)).all() and rest.any())
            wide = most - least > 1 << 23 and step % (1 << 20)  # counts of 12 bits that were shifted up are multiples
            if FLOATS[0] < least and most < FLOATS[1] and (wide or whole):
                seem = "be floating-point numbers"
        if seem:
            wrong[index] = (
                f"samples seem to {seem}: they are read as LAS has them, as unsigned integers, so that amplitudes, "
                "widths and noise are wrong; write them so"
            )
    forms = {}
    for index in votes:
        inverted, why = _decide_direction(digitizers, votes, index)
        order, notes = orders.get(index, (False, ""))
        lines = tuple(f"descriptor {index}: {line}" for line in (notes, why) if line)
        doubt = f"descriptor {index}: {wrong[index]}" if index in wrong else ""
        if inverted or lines or doubt:
            forms[index] = SampleForm(order, inverted, lines, doubt)
    return forms


def _decide_direction(digitizers: Mapping[int, Digitizer], votes: Mapping[int, _Votes], index: int) -> tuple[bool, str]:
    """Whether the signal of a descriptor goes down, and why; where its waveforms do not show it, all that have its
    sign of the gain do."""
    negative = digitizers[index].gain < 0
    mine = votes[index]
    if not mine.direction:
        for other, more in votes.items():
            if other != index and (digitizers[other].gain < 0) == negative:
                mine = mine.join(more)
    mirrored = "the signal goes down, its counts are mirrored (largest count - count)"
    if mine.direction < 0:
        return True, f"{mirrored}: {mine.down} of {mine.down + mine.up} clear waveforms, skewness {mine.skewness:.1f}"
    if negative and mine.direction == 0:
        return True, f"{mirrored}: its gain is negative"
    if negative:
        return False, f"its gain is negative, but {mine.up} of {mine.down + mine.up} clear waveforms go up"
    return False, ""
