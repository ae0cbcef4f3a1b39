"""From true echoes to discrete returns: those of a vendor's software, and those of a receiver with a dead zone.

`strip.simulate_strip` stores the returns of `list_returns` with the waveforms; `strip.simulate_returns` stores those of
a DiscreteReceiver, which has no waveforms. Both models give a Returns table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.schema import Above, Range, check_options, option
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, PS_PER_NS
from wavebatch.tools.simulate.render import Recording

WEAKEST = 3.0
"""Echoes below this many standard deviations of the noise give no return."""

DISTINCT = 1.0
"""Echoes closer than this many full widths at half maximum give one return, that of the strongest."""


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """Discrete returns sorted by pulse, then time."""

    pulse: np.ndarray
    """Row of the pulse, i8 (k,)."""
    time: np.ndarray
    """True time after sample 0 [ns], f8 (k,)."""
    amplitude: np.ndarray
    """[count], (k,); 0 for the stand-in return of a pulse without echo."""
    number: np.ndarray
    """Return number from 1, i8 (k,)."""
    total: np.ndarray
    """Number of returns of the pulse, i8 (k,)."""


@dataclass(frozen=True, slots=True)
class DiscreteReceiver:
    """A receiver that is blind for one dead zone after each return (docs/algorithms.md 1.5).

    A return fires at the first echo from which the amplitudes, summed over one dead zone, exceed the threshold.
    """

    dead_zone: Annotated[float, Above(0.0, 1e6)] = option(
        0.65, "Discrete: least distance of two returns [m].", form="M", unset="0.65"
    )
    threshold: Annotated[float, Range(0.0, 1e10)] = option(
        12.0, "Discrete: amplitude that triggers a return [DN].", form="DN", unset="12"
    )
    most: Annotated[int, Range(1, 15)] = option(
        4, "Discrete: most returns per pulse.", name="most-returns", unset="4"
    )

    def __post_init__(self) -> None:
        check_options(self)

    def list_returns(self, truth: EchoTable, n: int) -> Returns:
        """The returns that the echoes of n pulses fire."""
        row, number, amplitude = self.fire(truth.waveform, truth.time * HALF_C, truth.amplitude)
        pulse = truth.waveform[row].astype(np.int64)
        return Returns(pulse, truth.time[row], amplitude, number, np.bincount(pulse, minlength=n)[pulse])

    def fire(
        self, pulse: np.ndarray, distance: np.ndarray, amplitude: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which echoes fire a return.

        Parameters
        ----------
        pulse, distance, amplitude : echoes (m,), sorted by pulse, then distance [m]; amplitude [count]

        Returns
        -------
        row of the echo that fired, i8 (k,); return number from 1, i8 (k,); summed amplitude, f8 (k,)
        """
        m = len(pulse)
        first = np.searchsorted(pulse, pulse, side="left")
        end = np.searchsorted(pulse, pulse, side="right")
        reach = _end_of_dead_zone(distance, distance + self.dead_zone, end)
        sums = np.concatenate([[0.0], np.cumsum(amplitude, dtype=np.float64)])
        energy = sums[reach] - sums[:m]
        loud = np.where(energy > self.threshold, np.arange(m), m)
        next_loud = np.append(np.minimum.accumulate(loud[::-1])[::-1], m)
        rows, numbers = [], []
        at = np.unique(first)
        for number in range(1, self.most + 1):
            hit = next_loud[at]
            hit = hit[hit < end[at]]
            rows.append(hit)
            numbers.append(np.full(len(hit), number))
            at = reach[hit[reach[hit] < end[hit]]]
        row = np.concatenate(rows)
        order = np.argsort(row, kind="stable")
        return row[order], np.concatenate(numbers)[order], energy[row[order]]


def _end_of_dead_zone(distance: np.ndarray, limit: np.ndarray, end: np.ndarray) -> np.ndarray:
    """First row of the same pulse at or beyond the limit, else the row after the pulse, i8 (m,)."""
    reach = np.arange(len(distance))
    moving = reach.copy()
    while len(moving):
        reach[moving] += 1
        moving = moving[reach[moving] < end[moving]]
        moving = moving[distance[reach[moving]] < limit[moving]]
    return reach


def list_returns(truth: EchoTable, n: int, recording: Recording, most: int, *, keep_empty: bool) -> Returns:
    """Returns of n pulses as a vendor delivers them with waveforms.

    One per distinguishable echo inside the window, at its true time, at most `most` per pulse. keep_empty: a pulse
    without echo gets one stand-in return in the middle of its window.
    """
    inside = (truth.time >= 0) & (truth.time <= recording.duration)
    inside &= truth.amplitude >= WEAKEST * recording.recorded_noise
    echoes = truth.take(np.flatnonzero(inside))
    echoes = echoes.take(_pick_strongest(echoes))
    echoes = echoes.take(np.flatnonzero(_count_within(echoes.waveform) < most))
    pulse, time, amplitude = echoes.waveform.astype(np.int64), echoes.time, echoes.amplitude
    if keep_empty:
        empty = np.flatnonzero(np.bincount(pulse, minlength=n) == 0)
        pulse = np.concatenate([pulse, empty])
        order = np.argsort(pulse, kind="stable")
        pulse = pulse[order]
        time = np.append(time, np.full(len(empty), recording.duration / 2))[order]
        amplitude = np.append(amplitude, np.zeros(len(empty), np.float32))[order]
    total = np.bincount(pulse, minlength=n)[pulse]
    return Returns(pulse, time, amplitude, _count_within(pulse) + 1, total)


def fill_packets(
    points: np.ndarray, index: np.ndarray, offset: np.ndarray, size: np.ndarray, time: np.ndarray, step: np.ndarray
) -> None:
    """Writes where the packets of points (k,) are, and how the points lie in them.

    index: of the descriptor, 0 without packet; offset, size [bytes]; time: after sample 0 [ns]; step: away from the
    sensor (k, 3) [m/ns].
    """
    has = index > 0
    points["wavepacket_index"] = index
    points["wavepacket_offset"] = np.where(has, offset, 0)
    points["wavepacket_size"] = np.where(has, size, 0)
    points["return_point_wave_location"] = np.where(has, time * PS_PER_NS, 0)
    for axis, name in enumerate(("x_t", "y_t", "z_t")):
        points[name] = np.where(has, -step[:, axis] / PS_PER_NS, 0)


def _pick_strongest(echoes: EchoTable) -> np.ndarray:
    """Row of the strongest echo of every run of echoes that a discrete receiver cannot separate."""
    if not len(echoes):
        return np.empty(0, np.int64)
    width = FWHM_PER_SIGMA * echoes.sigma
    apart = np.diff(echoes.time) >= DISTINCT * 0.5 * (width[1:] + width[:-1])
    starts = np.concatenate([[True], apart | (np.diff(echoes.waveform) != 0)])
    run = np.cumsum(starts) - 1
    order = np.lexsort((-echoes.amplitude, run))
    return order[np.flatnonzero(starts)]


def _count_within(group: np.ndarray) -> np.ndarray:
    """Position of every row within its run of equal values, from 0; group: sorted."""
    return np.arange(len(group)) - np.searchsorted(group, group)
