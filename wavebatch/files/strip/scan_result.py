"""What one pass over the points of a strip found, and the lines that say what is wrong with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.spool import Spool
from wavebatch.files.strip.facts import StripFacts
from wavebatch.files.strip.packet_check import REASON_TEXTS, Reason


@dataclass(frozen=True, slots=True, eq=False)
class StripScan:
    """What one pass over the points found; picklable. `close` it (or use `with`) to remove its temporary file."""

    points: int
    with_waveform: int
    """Points with a usable packet."""
    without_waveform: int
    """Points that have none: descriptor index 0 or packet size 0."""
    broken: int
    """Points with a packet that cannot be used; the three add up to `points`."""
    packets: int
    """Different usable packets."""
    short: int
    """Points whose packet is shorter than its descriptor says."""
    reasons: dict[Reason, tuple[int, int]]
    """Per reason for not using a packet: points, and the first of them."""
    by_descriptor: dict[int, int]
    """Points that refer to a packet, by descriptor index."""
    reach: int
    """Largest distance, in points, between two points that share a packet."""
    direction: str
    direction_evidence: str
    vector_form: str
    vector_ratio: float
    borders: np.ndarray
    """First point of every unit, and the number of points, i8 (units + 1,)."""
    overfull: np.ndarray
    """Keys of packets that more points refer to than a pulse can have, u8, sorted."""
    context: Spool
    """Per unit: the points of other units that share packets with it."""
    warnings: tuple[str, ...]
    problems: tuple[str, ...]
    """What keeps the strip from being processed; empty for scans that `StripReader.scan` returns."""

    @property
    def is_hopeless(self) -> bool:
        """Whether points have packets, but none that can be used."""
        return self.broken > 0 and not self.with_waveform

    @property
    def spool(self) -> Path | None:
        """Temporary file of shared packets, where there are many."""
        return self.context.path

    def close(self) -> None:
        """Removes the temporary file."""
        self.context.close()

    def __enter__(self) -> StripScan:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def describe_hopeless(facts: StripFacts, reasons: dict[Reason, tuple[int, int]]) -> str:
    """The line on a strip none of whose packets can be used."""
    if facts.packet_file is None:
        beside = facts.path.with_suffix(".wdp").name
        return f"points refer to packets, which are neither in the file nor beside it: put {beside} beside the strip"
    reason = max(reasons, key=lambda r: reasons[r][0])
    count, first = reasons[reason]
    remedy = f"{facts.packet_file.name} is cut, damaged or of another strip: get it again"
    if reason is Reason.PACKED:
        remedy = "have them written with 8, 16 or 32 bits"
    return (
        f"no packet can be used: {count} of {facts.point_count} points (first: point {first}) {REASON_TEXTS[reason]}; "
        f"{remedy}"
    )


def describe_oddities(reasons: dict[Reason, tuple[int, int]], short: int) -> Iterator[str]:
    """Lines on what is odd about a strip that can be processed nevertheless."""
    for reason, (count, first) in reasons.items():
        yield f"{count} points (first: point {first}) {REASON_TEXTS[reason]}; they are passed through"
    if short:
        yield f"{short} points have packets shorter than their descriptor says; what is there is used"


def raise_problem(facts: StripFacts, scan: StripScan) -> None:
    """Raises InputError with what keeps the strip from being processed, if anything does."""
    if scan.problems:
        scan.close()
        raise InputError(f"{facts.path}: {scan.problems[0]}")
