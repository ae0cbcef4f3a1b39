"""Stands of plants over level ground: a small model that explains published statistics of returns.

`scenes.find_scene` makes a scene `canopy.<name>` of each. Source: Ussyshkin and Theriault, docs/algorithms.md 1.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.tools.simulate.draws import Drawn
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
