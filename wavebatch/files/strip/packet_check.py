"""Check of packets: which points have a usable packet, and why the others have none.

The scan and the reader judge each piece of points. After this check packets are read without any further one, so a
packet is usable only if all its bytes lie inside the waveform data.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.packet_vectors import RANGE_RATIO, measure_ratio
from wavebatch.files.strip.packets import BLOCK_BYTES, COMPRESSED, MAX_SAMPLES, PacketFile, refuse_compressed

INDEX_BITS = np.uint64(8)
"""Bits of the descriptor index in a key; see `Judged.keys`."""
WHOLE_BITS = (8, 16, 32)
"""Bits per sample that fill whole bytes; others (12 bits) are stored in two bytes, or packed."""
PACKED_BITS = (10, 12)
"""Bits per sample that are also read where they follow each other without a gap."""
MOST_BITS = 32
MAX_SPACING = 1000.0
"""Largest spacing of samples [ns]; digitizers have 0.2 to 10 ns, a larger one is damage."""
MAX_LOCATION = 1e9
"""Largest return location [ps]: 1 ms is 150 km of range; a larger one is damage."""


class Reason(IntEnum):
    """Reason why the packet of a point cannot be used."""

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


REASON_TEXTS = {
    Reason.NO_DESCRIPTOR: "refer to a descriptor that the header does not have",
    Reason.BAD_DESCRIPTOR: "refer to a descriptor that is empty, too long, without spacing, or of more than 32 bits",
    Reason.EMPTY: "have a packet without a whole sample",
    Reason.CUT: "have a packet past the end of the waveform data",
    Reason.OUTSIDE: "have a packet before the start of the waveform data",
    Reason.NO_GEOMETRY: "have an impossible return location or packet vector (not a number, 0, or far too long)",
    Reason.OVERFULL: "share one packet with more points than a pulse can have",
    Reason.PACKED: "have samples of other than 8, 16 or 32 bits, and a packet size that fits neither whole bytes "
    "nor packed samples of 10 or 12 bits",
    Reason.DAMAGED: "have a compressed packet that is damaged",
}


@dataclass(frozen=True, slots=True, eq=False)
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
    """bool (n,): samples follow each other without a gap; see `sample_form.unpack_samples`."""

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
        self._known, self._good, self._compressed, self._packs = (np.zeros(256, bool) for _ in range(4))
        self._width, self._samples = np.ones(256, np.int64), np.zeros(256, np.int64)
        self._odd, self._packed = np.zeros(256, bool), np.full(256, -1, np.int64)
        for index, digitizer in facts.digitizers.items():
            self._known[index] = True
            self._good[index] = 0 < digitizer.bits <= MOST_BITS and 0 < digitizer.spacing <= MAX_SPACING
            self._good[index] &= 0 < digitizer.n_samples <= MAX_SAMPLES
            kind = facts.compression.get(index, 0)
            self._packs[index] = kind == COMPRESSED and digitizer.bits in (8, 16)
            self._compressed[index] = kind != 0 and not self._packs[index] and digitizer.n_samples > 0
            if self._good[index]:
                self._width[index], self._samples[index] = digitizer.width, digitizer.n_samples
                self._odd[index] = digitizer.bits not in WHOLE_BITS
                if digitizer.bits in PACKED_BITS:
                    self._packed[index] = packed_bytes(digitizer.n_samples, digitizer.bits)
        self._least, self._end = facts.packets.offsets

    def judge(self, points: np.ndarray, form: str, overfull: np.ndarray | None = None) -> Judged:
        """Check the packets of points.

        Parameters
        ----------
        points : structured array (n,)
            Point records with waveform fields.
        form : {"stored", "range"}
            How vectors are stored; see `packet_vectors.Decision`.
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
        index = np.ascontiguousarray(points["wavepacket_index"])
        size = points["wavepacket_size"].astype(np.int64)
        offset = points["wavepacket_offset"].astype(np.uint64)
        has = (index > 0) & (size > 0)
        self._refuse_compressed(index[has])
        n_samples = np.minimum(self._samples[index], size // self._width[index])
        packs = self._packs[index]
        # A compressed packet has all samples of its descriptor, in any number of bytes.
        n_samples = np.where(packs & (size > self._width[index]), self._samples[index], np.where(packs, 0, n_samples))
        # Only the size of the packet shows whether samples of 12 bits have two bytes each.
        packed = (size == self._packed[index]) & ~packs
        n_samples = np.where(packed, self._samples[index], n_samples)
        room = self._end - np.where(packed | packs, size, n_samples * self._width[index])
        inside = (room >= 0) & (offset <= np.maximum(room, 0).astype(np.uint64))
        keys = (offset << INDEX_BITS) | index
        reason = np.zeros(len(points), np.uint8)
        if overfull is not None and len(overfull):
            place = np.minimum(np.searchsorted(overfull, keys), len(overfull) - 1)
            reason[overfull[place] == keys] = Reason.OVERFULL
        reason[~_has_geometry(points, form)] = Reason.NO_GEOMETRY
        reason[~inside] = Reason.CUT
        reason[offset < np.uint64(self._least)] = Reason.OUTSIDE
        reason[n_samples == 0] = Reason.EMPTY
        reason[self._odd[index] & (n_samples < self._samples[index])] = Reason.PACKED
        reason[~self._good[index]] = Reason.BAD_DESCRIPTOR
        reason[~self._known[index]] = Reason.NO_DESCRIPTOR
        reason[~has] = Reason.NO_WAVEFORM
        if packs.any():
            rows = np.flatnonzero(packs & (reason == Reason.USABLE))
            reason[rows[~self._decode(index[rows], offset[rows], size[rows])]] = Reason.DAMAGED
        good = reason == Reason.USABLE
        short = good & (n_samples < self._samples[index])
        return Judged(reason, np.where(good, n_samples, 0).astype(np.int32), keys, short, packed)

    def _decode(self, index: np.ndarray, offset: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Whether compressed packets are whole, bool (n,): only decoding them shows it."""
        good = np.zeros(len(index), bool)
        packets = PacketFile(self._facts.packets, self._facts.compressed)
        try:
            for kind in np.unique(index).tolist():
                same = np.flatnonzero(index == kind)
                n_samples, bits = int(self._samples[kind]), 8 * int(self._width[kind])
                for rows in np.array_split(same, -(-len(same) * n_samples * bits // 8 // BLOCK_BYTES)):
                    good[rows] = packets.decode(offset[rows], size[rows], n_samples, bits)[1]
        finally:
            packets.close()
        return good

    def _refuse_compressed(self, index: np.ndarray) -> None:
        bad = self._compressed[index]
        if bad.any():
            raise refuse_compressed(self._facts.path, self._facts.compression[int(index[np.argmax(bad)])])


def packed_bytes(n_samples: int, bits: int) -> int:
    """Return the bytes of a packet of packed samples."""
    return -(-n_samples * bits // 8)


def _has_geometry(points: np.ndarray, form: str) -> np.ndarray:
    """Whether return location and vector of points are possible, so that the packet has a place in space."""
    ratio = measure_ratio(points, form)
    location = np.abs(widen_integers(points["return_point_wave_location"]))
    return (ratio > 0) & (ratio <= RANGE_RATIO) & (location <= MAX_LOCATION)
