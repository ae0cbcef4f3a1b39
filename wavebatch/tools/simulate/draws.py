"""Distributions of the echoes of a scene: amplitude, width and time, each a small object that is called.

`scenes` combines them. Their order of calls to the random generator is part of the result: changing it changes every
simulated strip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.units import C
from wavebatch.tools.simulate.geometry import AIR_SPEED
from wavebatch.tools.simulate.render import Recording

MARGIN = 6.0
"""Distance that echoes keep from the ends of the window, in sigma of the pulse."""


@dataclass(frozen=True, slots=True)
class Canopy:
    """Scatterers at random heights: each takes a random part of the light that is left, the ground the rest."""

    height: float
    """Height of the stand [m]."""
    density: float
    """Scatterers that a pulse meets per metre."""
    cover: float
    """Share of the pulses that meet plants; the others see the ground only."""
    full: float = 200.0
    """Amplitude of the echo that takes a whole pulse [count]."""

    @property
    def duration(self) -> float:
        """Two-way travel time through the stand [ns]."""
        return self.height / AIR_SPEED

    def draw(self, rng: np.random.Generator, n: int, recording: Recording) -> Drawn:
        """Echoes of n waveforms, the ground's last."""
        plants = np.where(rng.random(n) < self.cover, rng.poisson(self.density * self.height, n), 0)
        count = plants + 1
        waveform = np.repeat(np.arange(n), count)
        ground = np.cumsum(count) - 1
        depth = self.duration * rng.random(len(waveform))
        depth[ground] = self.duration
        taken = rng.random(len(waveform))
        depth = depth[np.lexsort((depth, waveform))]
        passed = np.log1p(-taken)
        passed[ground] = 0.0
        before = np.cumsum(passed) - passed
        left = np.exp(before - np.repeat(before[ground - plants], count))
        taken[ground] = 1.0
        sigma = recording.pulse.sigma
        room = max(recording.duration - self.duration - 2 * MARGIN * sigma, 0.0)
        start = MARGIN * sigma + room * rng.random(n)
        return Drawn(waveform, start[waveform] + depth, self.full * taken * left, np.full(len(waveform), sigma))


CANOPIES: dict[str, tuple[str, Canopy]] = {
    "corn": ("a cornfield 2.2 m high", Canopy(2.2, 2.0, 0.9)),
    "orion-6": ("trees 6 m high, as the Orion's table of 6 m", Canopy(6.0, 0.3, 0.85)),
    "orion-20": ("trees 20 m high, as the Orion's table of 20 m", Canopy(20.0, 0.6, 0.9)),
    "orion-22": ("trees 22.5 m high, as the Orion's table of 22.5 m", Canopy(22.5, 0.3, 0.85)),
    "gemini-6": ("thin trees 6.5 m high, as the Gemini's table of 6 to 7 m (dead zone 2 m)", Canopy(6.5, 0.06, 0.9)),
    "gemini-24": ("trees 24.5 m high, as the Gemini's table of 22 to 27 m (dead zone 2 m)", Canopy(24.5, 0.16, 1.0)),
}
"""Meaning and model of every stand: `canopy.<name>` is its scene. Fitted to return-number tables with a threshold of
6 % of a whole pulse. Density and threshold can replace each other in the fit: do not read the density of real plants
from them."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Echoes of n waveforms, sorted by waveform, and lobes that are painted but are no echo."""

    waveform: np.ndarray
    """Row of the waveform, i8 (m,)."""
    time: np.ndarray
    """Peak after sample 0 [ns], f8 (m,)."""
    amplitude: np.ndarray
    """[count], f8 (m,)."""
    sigma: np.ndarray
    """Of the main lobe [ns], f8 (m,)."""
    ghost: np.ndarray | None = None
    """True for lobes that are no echo (ringing); None when all are echoes."""
    constant: np.ndarray | None = None
    """Level of waveforms whose samples are all equal [count], NaN for the others, (n,); None when there is none."""


def tabulate_echoes(time: np.ndarray, amplitude, sigma, ghost: np.ndarray | None = None) -> Drawn:
    """Arrays (n, k), or values broadcast to them, as a flat list sorted by waveform, then time, without NaN times."""
    n, k = time.shape
    order = np.argsort(time, axis=1, kind="stable")
    keep = ~np.isnan(np.take_along_axis(time, order, 1)).ravel()

    def flatten(values) -> np.ndarray:
        return np.take_along_axis(np.broadcast_to(values, (n, k)), order, 1).ravel()[keep]

    ghosts = None if ghost is None else flatten(ghost)
    return Drawn(np.repeat(np.arange(n), k)[keep], flatten(time), flatten(amplitude), flatten(sigma), ghosts)


@dataclass(frozen=True, slots=True)
class LogUniform:
    """Amplitudes between low and high [count], evenly spread over their logarithm."""

    low: float
    high: float

    def __call__(self, rng: np.random.Generator, m: int | tuple[int, ...]) -> np.ndarray:
        return np.exp(rng.uniform(np.log(self.low), np.log(self.high), m))


@dataclass(frozen=True, slots=True)
class LogNormal:
    """Amplitudes around a median [count], cut at low and high."""

    median: float
    spread: float
    low: float
    high: float

    def __call__(self, rng: np.random.Generator, m: int) -> np.ndarray:
        return np.clip(self.median * np.exp(self.spread * rng.standard_normal(m)), self.low, self.high)


@dataclass(frozen=True, slots=True)
class Mixture:
    """Amplitudes from the first law with probability `share`, else from the second."""

    share: float
    first: LogUniform | LogNormal
    second: LogUniform | LogNormal

    def __call__(self, rng: np.random.Generator, m: int) -> np.ndarray:
        return np.where(rng.random(m) < self.share, self.first(rng, m), self.second(rng, m))


@dataclass(frozen=True, slots=True)
class FoldedWidth:
    """sigma = sigma_ref sqrt(1 + g |N|): g = several for echoes in company, g = single for lone ones."""

    several: float
    single: float

    def __call__(self, rng: np.random.Generator, alone: np.ndarray, reference: float) -> np.ndarray:
        growth = np.where(alone, self.single, self.several)
        return reference * np.sqrt(1.0 + growth * np.abs(rng.standard_normal(len(alone))))


@dataclass(frozen=True, slots=True)
class HalfBroadened:
    """Half of the echoes at sigma_ref with a relative scatter, half evenly between sigma_ref and `top` times it."""

    scatter: float
    top: float

    def __call__(self, rng: np.random.Generator, alone: np.ndarray, reference: float) -> np.ndarray:
        m = len(alone)
        near = 1.0 + self.scatter * rng.standard_normal(m)
        wide = rng.uniform(1.0, self.top, m)
        return reference * np.where(rng.random(m) < 0.5, near, wide)


@dataclass(frozen=True, slots=True)
class WithinDepth:
    """Times evenly within a layer `depth` ns deep that lies anywhere in the window."""

    depth: float
    margin: float = 4.0
    """Distance that echoes keep from the ends of the window, in sigma_ref."""

    def __call__(self, rng: np.random.Generator, count: np.ndarray, recording: Recording) -> np.ndarray:
        low, high = _find_room(recording, self.margin)
        depth = min(self.depth, high - low)
        start = np.repeat(rng.uniform(low, high - depth, len(count)), count)
        return start + depth * rng.random(len(start))


@dataclass(frozen=True, slots=True)
class WithGaps:
    """Times whose gaps are log-uniform between low and high [ns]; series that leave the window are drawn again."""

    low: float
    high: float
    margin: float = 4.0

    def __call__(self, rng: np.random.Generator, count: np.ndarray, recording: Recording) -> np.ndarray:
        low, high = _find_room(recording, self.margin)
        most = int(count.max(initial=1)) - 1
        top = min(self.high, (high - low) / max(most, 1)) if most * self.low < high - low else self.low
        gaps = self._draw_gaps(rng, count, most, high - low, top)
        ends = np.cumsum(gaps, axis=1)
        span = ends[:, -1] if most > 0 else np.zeros(len(count))
        start = low + rng.random(len(count)) * np.maximum(high - low - span, 0)
        times = np.concatenate([start[:, None], start[:, None] + ends], axis=1)
        return times[np.arange(most + 1) < np.maximum(count, 0)[:, None]]

    def _draw_gaps(self, rng, count, most: int, room: float, fallback: float) -> np.ndarray:
        """Gaps (n, most), 0 after the last echo. After 32 draws that did not fit, gaps are at most `fallback`."""
        used = np.arange(1, most + 1) < count[:, None]
        gaps = np.zeros((len(count), most))
        todo = np.flatnonzero(count > 1)
        for attempt in range(33):
            top = self.high if attempt < 32 else fallback
            drawn = np.exp(rng.uniform(np.log(self.low), np.log(max(top, self.low)), (len(todo), most)))
            drawn *= used[todo]
            gaps[todo] = drawn
            todo = todo[drawn.sum(axis=1) > room]
            if not len(todo):
                break
        return gaps


def _find_room(recording: Recording, margin: float) -> tuple[float, float]:
    """First and last time at which echoes may lie [ns]."""
    keep = min(margin * recording.pulse.sigma, recording.duration / 3)
    return keep, recording.duration - keep


def draw_numbers(rng: np.random.Generator, n: int, probabilities: tuple[float, ...]) -> np.ndarray:
    """Echoes per waveform, i8 (n,), with the given probabilities of 0, 1, 2 ... echoes."""
    edges = np.cumsum(probabilities)
    return np.searchsorted(edges[:-1] / edges[-1], rng.random(n), side="right")


def widen_on_slope(
    sigma: np.ndarray, amplitude: np.ndarray, incidence: np.ndarray, beam_radius: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """sigma [ns] and amplitude of echoes of a tilted plane: s_alpha = w tan(alpha)/c (docs/algorithms.md 1.4).

    incidence: angle between ray and normal [rad]; beam_radius: 1/e^2 radius of the footprint [m]. The energy falls
    with cos(alpha) and is spread over the longer echo.
    """
    wide = np.hypot(sigma, beam_radius * np.tan(incidence) / C)
    return wide, amplitude * np.cos(incidence) * sigma / wide
