"""Seconds of a task, on a processor and on a clock. Chain, batch and bench measure with it; reports name both."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Seconds:
    """Time that tasks took; sums and differences are taken part by part."""

    processor: float = 0.0
    """Of all threads of the process that did the task [s]."""
    wall: float = 0.0
    """By the clock, with waiting for the disk and for other programs [s]."""

    @classmethod
    def now(cls) -> Seconds:
        """Return the times of this process; only differences mean something."""
        return cls(time.process_time(), time.perf_counter())

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.processor + other.processor, self.wall + other.wall)

    def __sub__(self, other: Seconds) -> Seconds:
        return Seconds(self.processor - other.processor, self.wall - other.wall)
