"""A receiver that records discrete returns and is blind for a while after each (ALGORITHMS.md 1.5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class DiscreteReceiver:
    """A return fires at the first echo whose amplitudes, summed over one dead zone from it, exceed the threshold."""

    dead_zone: float = 0.65
    """Least distance of two returns of a pulse [m]."""
    threshold: float = 12.0
    """[count]."""
    most: int = 4
    """Returns per pulse."""

    def __post_init__(self) -> None:
        if not (self.dead_zone > 0 and self.threshold >= 0 and 1 <= self.most <= 15):
            raise ConfigError(
                f"receiver: dead zone {self.dead_zone} m must be above 0, threshold {self.threshold} not below it, "
                f"and {self.most} returns must be 1 to 15"
            )

    def fire(
        self, pulse: np.ndarray, distance: np.ndarray, amplitude: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Echoes (m,), sorted by pulse, then distance [m], to returns: row of the echo that fired, i8 (k,), return
        number from 1, i8 (k,), and summed amplitude, f8 (k,); sorted by pulse, then number."""
        m = len(pulse)
        first = np.searchsorted(pulse, pulse, side="left")
        behind = np.searchsorted(pulse, pulse, side="right")
        reach = _advance(distance, distance + self.dead_zone, behind)
        sums = np.concatenate([[0.0], np.cumsum(amplitude, dtype=np.float64)])
        energy = sums[reach] - sums[:m]
        loud = energy > self.threshold
        following = np.where(loud, np.arange(m), m)
        following = np.minimum.accumulate(following[::-1])[::-1] if m else following
        following = np.append(following, m)
        rows, numbers = [], []
        at = np.unique(first)
        for number in range(1, self.most + 1):
            end = behind[at]
            hit = following[at]
            hit = hit[hit < end]
            rows.append(hit)
            numbers.append(np.full(len(hit), number))
            more = reach[hit] < behind[hit]
            at = reach[hit[more]]
        row, number = np.concatenate(rows), np.concatenate(numbers)
        order = np.argsort(row, kind="stable")
        return row[order], number[order], energy[row[order]]


def _advance(distance: np.ndarray, limit: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """First row of the same pulse that is not nearer than the limit, else the row behind the pulse, i8 (m,)."""
    reach = np.arange(len(distance))
    moving = reach.copy()
    while len(moving):
        reach[moving] += 1
        moving = moving[reach[moving] < behind[moving]]
        moving = moving[distance[reach[moving]] < limit[moving]]
    return reach
