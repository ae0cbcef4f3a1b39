"""How the samples of a strip are stored: the order of packed bits, and whether counts go down where light comes in.

The scan decides both once per descriptor, from packets spread over the strip, because neither stands in the file;
`StripReader.read_rows` reads all samples through `read_packet_samples`. docs/las-waveforms.md 1.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from wavebatch.core.order import distinct, even_places, median
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.strip.packet_check import INDEX_BITS, Judged, packed_bytes
from wavebatch.files.strip.packets import PacketFile
from wavebatch.kernels.signal.signal import find_fill, recorded_lengths

SAMPLED, SAMPLED_PER_UNIT = 1024, 512
"""Packets of a descriptor, and of a unit, that decide."""
LEAST_HEIGHT, CLEAR = 5.0, 3.0
"""A waveform votes if it leaves its median by this many counts, to one side this many times as far as to the other."""
LEAST_VOTES, MAJORITY = 20, 9
"""Votes that decide, and how many times as many they must be as the others."""
LEAST_SKEWNESS = 1.0
"""Skewness of the deviations from the median that decides; one side of a Gaussian noise has 0, echoes have 3 to 10."""


@dataclass(frozen=True, slots=True)
class SampleForm:
    """How the samples of one descriptor are stored."""

    little: bool = False
    """Packed samples begin with their lowest bit, in the lowest bit of a byte; else both with the highest."""
    inverted: bool = False
    """Counts go down where light comes in."""
    notes: tuple[str, ...] = ()
    """What was decided and why, for users."""

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


@dataclass(slots=True)
class FormSample:
    """Packets spread over a strip: for each its key (see `Judged.keys`), samples and whether they are packed."""

    keys: list[np.ndarray] = field(default_factory=list)
    n_samples: list[np.ndarray] = field(default_factory=list)
    packed: list[np.ndarray] = field(default_factory=list)

    def add(self, judged: Judged, rows: np.ndarray) -> None:
        """Take some of the packets of a unit; rows: points with different packets, ordered by byte offset."""
        rows = rows[even_places(len(rows), SAMPLED_PER_UNIT)]
        self.keys.append(judged.keys[rows])
        self.n_samples.append(judged.n_samples[rows])
        self.packed.append(judged.packed[rows])

    def join(self, other: FormSample) -> None:
        """Take the packets of the units that follow."""
        self.keys += other.keys
        self.n_samples += other.n_samples
        self.packed += other.packed

    def by_kind(self) -> dict[tuple[int, int, bool], np.ndarray]:
        """Return byte offsets (k,) by descriptor, number of samples and whether they are packed."""
        if not self.keys:
            return {}
        keys, n_samples, packed = (np.concatenate(part) for part in (self.keys, self.n_samples, self.packed))
        index = (keys & np.uint64(255)).astype(np.int64)
        found: dict[tuple[int, int, bool], np.ndarray] = {}
        for number in distinct(index).tolist():
            rows = np.flatnonzero(index == number)
            rows = rows[even_places(len(rows), SAMPLED)]
            kinds, kind = np.unique(np.stack([n_samples[rows], packed[rows]], axis=1), axis=0, return_inverse=True)
            for place, (length, is_packed) in enumerate(kinds.tolist()):
                found[number, length, bool(is_packed)] = keys[rows[kind.ravel() == place]] >> INDEX_BITS
        return found


@dataclass(slots=True)
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
        values -= np.nanmedian(values, axis=1, keepdims=True) if gaps.any() else _medians(values)
        np.nan_to_num(values, copy=False)
        up, down = values.max(axis=1), -values.min(axis=1)
        self.up += int(np.count_nonzero((up >= LEAST_HEIGHT) & (up >= CLEAR * down)))
        self.down += int(np.count_nonzero((down >= LEAST_HEIGHT) & (down >= CLEAR * up)))
        self.number += values.size
        self.squares += float(np.sum(values**2))
        self.cubes += float(np.sum(values**3))

    def join(self, other: _Votes) -> _Votes:
        """Return both together."""
        return _Votes(*(getattr(self, name) + getattr(other, name) for name in _Votes.__slots__))

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


def _medians(values: np.ndarray) -> np.ndarray:
    return median(values, axis=1)[:, None]


def find_forms(digitizers: Mapping[int, Digitizer], packets: PacketFile, sample: FormSample) -> dict[int, SampleForm]:
    """Decide how the samples of each descriptor are stored.

    Parameters
    ----------
    digitizers : mapping
        Descriptors by index.
    packets : PacketFile
    sample : FormSample
        Packets spread over the strip.

    Returns
    -------
    dict of int to SampleForm
        Without descriptors whose counts are read as they are.
    """
    kinds = sample.by_kind()
    little = _find_orders(digitizers, packets, kinds)
    votes: dict[int, _Votes] = {}
    for (index, length, packed), offsets in kinds.items():
        stored = digitizers[index]
        form = SampleForm(little=little[index][0] if packed else False)
        samples = read_packet_samples(packets, offsets, length, stored, packed, form)
        tops = (stored.max_count, form.digitizer(stored, packed).max_count)
        votes.setdefault(index, _Votes()).add(samples, tops)
    forms = {}
    for index in votes:
        inverted, why = _decide_direction(digitizers, votes, index)
        order, notes = little.get(index, (False, ""))
        lines = tuple(f"descriptor {index}: {line}" for line in (notes, why) if line)
        if inverted or lines:
            forms[index] = SampleForm(order, inverted, lines)
    return forms


def _find_orders(
    digitizers: Mapping[int, Digitizer], packets: PacketFile, kinds: Mapping[tuple[int, int, bool], np.ndarray]
) -> dict[int, tuple[bool, str]]:
    """Order of packed bits by descriptor, with the reason: in the right one, neighbouring samples differ less."""
    steps: dict[int, np.ndarray] = {}
    for (index, length, packed), offsets in kinds.items():
        if packed:
            bits = digitizers[index].bits
            rows = packets.read_bytes(offsets, packed_bytes(length, bits))
            both = [unpack_samples(rows, length, bits, order).astype(np.int64) for order in (False, True)]
            here = np.array([np.abs(np.diff(values, axis=1)).sum() for values in both], np.float64)
            steps[index] = steps.get(index, np.zeros(2)) + here / max(length - 1, 1) / len(rows)
    found = {}
    for index, (big, small) in steps.items():
        little = bool(small < big)
        first, second = ("lowest", "highest") if little else ("highest", "lowest")
        found[index] = little, (
            f"samples of {digitizers[index].bits} bits are packed, {first} bit first: neighbouring samples differ by "
            f"{min(big, small):.1f} DN, with the {second} bit first by {max(big, small):.1f} DN"
        )
    return found


def _decide_direction(
    digitizers: Mapping[int, Digitizer], votes: Mapping[int, _Votes], index: int
) -> tuple[bool, str]:
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
