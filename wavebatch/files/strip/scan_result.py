"""Result of the pass over the points of a strip, and the messages about what is wrong with it.

`scanner.scan_strip` makes it; reader, survey and reports use it. It is pickled for other processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.files.disk.temp_store import Spool
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.packet_check import REASON_TEXTS, Reason
from wavebatch.files.strip.packet_vectors import VectorDecision
from wavebatch.files.strip.sample_form import SampleForm


@dataclass(frozen=True, slots=True, eq=False)
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
    reasons: dict[Reason, tuple[int, int]]
    """For each reason not to use a packet: number of points, and index of the first."""
    by_descriptor: dict[int, int]
    """Points with a packet, by descriptor index."""
    reach: int
    """Largest distance in the file, in points, of two points that share a packet."""
    vectors: VectorDecision
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
    forms: Mapping[int, SampleForm]
    """How samples are stored, by descriptor index; only descriptors whose counts are not simply read as they are."""
    stranger: str = ""
    """Why the packets are certainly those of another strip; empty where they are not, or where it was not asked."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know about how samples are stored, one line each."""
        return tuple(note for form in self.forms.values() for note in form.notes)

    @property
    def cut(self) -> int:
        """Points whose packet lies past the end of the file: it is shorter than its packets need."""
        return self.reasons.get(Reason.CUT, (0, 0))[0]

    @property
    def losses(self) -> tuple[str, ...]:
        """Those of the warnings about points whose packets cannot be used."""
        return tuple(describe_oddities(self.reasons, 0))

    def close(self) -> None:
        """Remove the temporary files."""
        self.context.close()
        self.decoded.close()


def describe_hopeless(facts: StripFacts, reasons: dict[Reason, tuple[int, int]]) -> str:
    """Return the message about a strip without any usable packet."""
    if facts.packets.file is None:
        name = facts.path.with_suffix(".wdp").name
        return f"points refer to packets that are neither in the file nor next to it: put {name} next to the strip"
    reason = max(reasons, key=lambda r: reasons[r][0])
    count, first = reasons[reason]
    remedy = f"{facts.packets.file.name} is cut, damaged or belongs to another strip: get it again"
    if reason is Reason.PACKED:
        remedy = "write the packets with 8, 16 or 32 bits per sample"
    return (
        f"no packet can be used: {count} of {facts.header.point_count} points (first: point {first}) "
        f"{REASON_TEXTS[reason]}; {remedy}"
    )


def describe_oddities(reasons: dict[Reason, tuple[int, int]], short: int) -> Iterator[str]:
    """Yield warnings about a strip that can be processed."""
    for reason, (count, first) in reasons.items():
        remedy = "; get it again, whole, then run with --resume" if reason is Reason.CUT else ""
        yield f"{count} points (first: point {first}) {REASON_TEXTS[reason]}; they are written unchanged{remedy}"
    if short:
        yield f"{short} points have packets with fewer samples than their descriptor gives; these samples are used"
