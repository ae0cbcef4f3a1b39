"""Check of packets: which points have a usable packet, and why the others have none.

The scan and the reader judge each piece of points. After this check packets are read without any further one, so a
packet is usable only if all its bytes lie inside the waveform data.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.order import distinct
from wavebatch.core.units import HALF_C, PS_PER_NS
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.packet_vectors import RANGE_RATIO, VECTORS
from wavebatch.files.strip.packets import BLOCK_BYTES, COMPRESSED, MAX_SAMPLES, PacketFile, refuse_compressed
from wavebatch.kernels.packets import FIELDS, Geometry, PacketRules, judge_packets

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
        known, good, odd, packs, self._compressed = (np.zeros(256, bool) for _ in range(5))
        width, samples, packed = np.ones(256, np.int64), np.zeros(256, np.int64), np.full(256, -1, np.int64)
        for index, digitizer in facts.digitizers.items():
            known[index] = True
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
        fields = dict(zip(FIELDS, (points[name] for name in _NAMES), strict=True))
        if self._compressed.any():
            self._refuse_compressed(fields["index"][(fields["index"] > 0) & (fields["size"] > 0)])
        geometry = Geometry(form == "range", PS_PER_NS / HALF_C, RANGE_RATIO, MAX_LOCATION)
        reason, n_samples, keys, short, packed = judge_packets(fields, self._rules, geometry)
        if overfull is not None and len(overfull):
            place = np.minimum(np.searchsorted(overfull, keys), len(overfull) - 1)
            reason[(overfull[place] == keys) & (reason == Reason.USABLE)] = Reason.OVERFULL
        if self._rules.packs.any():
            rows = np.flatnonzero(self._rules.packs[fields["index"]] & (reason == Reason.USABLE))
            index, offset, size = (fields[name][rows] for name in ("index", "offset", "size"))
            whole = self._decode(index, offset, size.astype(np.int64))
            reason[rows[~whole]] = Reason.DAMAGED
        bad = reason != Reason.USABLE
        n_samples[bad], short[bad] = 0, False
        return Judged(reason, n_samples, keys, short, packed)

    def _decode(self, index: np.ndarray, offset: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Whether compressed packets are whole, bool (n,): only decoding them shows it."""
        good = np.zeros(len(index), bool)
        packets = PacketFile(self._facts.packets, self._facts.compressed)
        try:
            for kind in distinct(index).tolist():
                same = np.flatnonzero(index == kind)
                n_samples, bits = int(self._rules.samples[kind]), 8 * int(self._rules.width[kind])
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
