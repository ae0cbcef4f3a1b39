"""Shapes of the simulated echo: Gaussian, skewed, with ringing, or a sum of components as real sensors have them.

`render` paints the lobes that `spread_lobes` returns; tools.bench.truth measures the same lobes. Truth is given by the
main lobe, so both must scale the other lobes alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian


@dataclass(frozen=True, slots=True)
class PulseModel:
    """The system pulse: a main lobe, Gaussian or skewed, and further lobes.

    The time of an echo is the datum of the pulse: the centre of the Gaussian that fits the echo of a flat target best.
    A target that broadens the main lobe from `sigma` to s adds the variance s^2 - sigma^2 to every lobe, and lobes lose
    height as they widen. A skewed main lobe is stretched instead, and placed as such a target would place it.
    The amplitude of an echo is the height of the peak of all lobes together.
    """

    sigma: float = 2.0
    """Standard deviation of the main lobe for a flat target [ns]."""
    kappa: float = 0.0
    """Skew of the main lobe (docs/algorithms.md 0); its height is the amplitude."""
    lobes: tuple[tuple[float, float, float], ...] = ()
    """(height relative to the main lobe, delay [ns], sigma [ns]) of every further lobe."""

    def with_ringing(self, share: float) -> PulseModel:
        """The pulse with a lobe of -share at 4 sigma and +share at 8 sigma after its peak."""
        if share == 0:
            return self
        ring = ((-share, 4 * self.sigma, self.sigma), (share, 8 * self.sigma, self.sigma))
        return replace(self, lobes=self.lobes + ring)


LEAST_SIGMA = 0.001
"""Shortest pulse [ns]: no detector shows 1 ps, and times in units of far shorter ones overflow."""

PULSES: dict[str, PulseModel] = {
    "gaussian": PulseModel(),
    "skewed": PulseModel(kappa=0.1),
    "riegl": PulseModel(1.85, 0.0, ((0.16, 2.4, 2.2), (0.04, 10.5, 2.2), (0.016, 20.0, 4.0), (0.008, 40.0, 8.0))),
    "leica": PulseModel(3.0, 0.0, ((0.22, 7.2, 4.0), (0.03, 15.0, 5.0))),
}
"""Named pulses: riegl has the after-pulse of +4 % at 10.5 ns and the tail of the Q680i, leica the skew of the ALS."""


def find_pulse(name: str) -> PulseModel:
    """The pulse called `name`; ConfigError when there is none."""
    if name not in PULSES:
        raise ConfigError(f"pulse {name!r} is unknown; {nearest(name, PULSES)}")
    return PULSES[name]


def shape_pulse(
    old: PulseModel,
    *,
    pulse: str | None = None,
    sigma: float | None = None,
    kappa: float | None = None,
    ringing: float = 0.0,
) -> PulseModel:
    """The system pulse `old` with the given values replaced.

    pulse: name of a shape in PULSES; those of real sensors replace sigma too. sigma [ns], kappa: width and skew of the
    main lobe. ringing: share of the amplitude in lobes 4 and 8 sigma after the peak.
    Raises ConfigError for an unknown name or a value out of range.
    """
    shape = old if pulse is None else find_pulse(pulse)
    width = sigma or (shape.sigma if shape.lobes else old.sigma)
    skew = shape.kappa if kappa is None else kappa
    if not (LEAST_SIGMA <= width < 1000 and abs(skew) <= 0.5 and abs(ringing) <= 0.5):
        limits = f"above 0 ({LEAST_SIGMA} to 1000)"
        raise ConfigError(f"pulse: sigma {width} ns must be {limits}, kappa {skew} and ringing {ringing} within +-0.5")
    return replace(shape, sigma=width, kappa=skew).with_ringing(ringing)


def spread_lobes(
    pulse: PulseModel, time: np.ndarray, amplitude: np.ndarray, sigma: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Lobes of echoes, the main lobe first: (time [ns], height [count], sigma [ns]) of each, (m,).

    time, amplitude, sigma: (m,) as in the truth table. Heights are scaled so that all lobes together peak at
    `amplitude`.
    """
    start = time - _find_delay(pulse, sigma)
    if not pulse.lobes:
        return [(start, amplitude, sigma)]
    grid = np.linspace(sigma.min(initial=pulse.sigma), sigma.max(initial=pulse.sigma), 129)
    main = amplitude / np.interp(sigma, grid, _paint(pulse, grid)[1].max(axis=0))
    parts = [(start, main, sigma)]
    for share, delay, width, scale in _widen(pulse, sigma):
        parts.append((start + delay, main * share * scale, width))
    return parts


def _widen(pulse: PulseModel, sigma: np.ndarray):
    """(share, delay, width, relative height) of every further lobe when a target broadens the main lobe to sigma."""
    extra = sigma**2 - pulse.sigma**2
    for share, delay, flat in pulse.lobes:
        width = np.sqrt(np.maximum(flat**2 + extra, 0.01 * flat**2))
        yield share, delay, width, flat / width * sigma / pulse.sigma


def _find_delay(pulse: PulseModel, sigma: np.ndarray) -> np.ndarray | float:
    """Datum after the main lobe's peak of echoes of these widths [ns], (m,)."""
    if not (pulse.lobes or pulse.kappa):
        return 0.0
    delay = _find_flat(pulse)
    if not pulse.kappa:
        return delay
    ratio = np.maximum(sigma / pulse.sigma, 0.7)
    return delay + _find_flat(replace(pulse, lobes=())) * (ratio + ratio**-2 - 2)


@cache
def _find_flat(pulse: PulseModel) -> float:
    """Datum after the main lobe's peak of a flat target's echo [ns]."""
    x, total = _paint(pulse, np.array([pulse.sigma]))
    return fit_one_gaussian(x, total[:, 0])[0]


def _paint(pulse: PulseModel, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times after the main lobe's peak [ns], (r,), and the pulse there per unit of its main lobe, (r, m)."""
    x = np.arange(-1200, 1201) * (pulse.sigma / 200)
    total = main_lobe(x[:, None] / sigma, pulse.kappa)
    for share, delay, width, scale in _widen(pulse, sigma):
        total = total + share * scale * np.exp(-0.5 * ((x[:, None] - delay) / width) ** 2)
    return x, total


def main_lobe(z: np.ndarray, kappa: float) -> np.ndarray:
    """Height of the unit pulse at z = (time - peak)/sigma: exp(-L^2/2) with L = log1p(kappa z)/kappa.

    Source: docs/algorithms.md 0.
    """
    if abs(kappa) < 1e-6:
        return np.exp(-0.5 * z * z)
    inside = kappa * z
    gone = inside <= -1 + 1e-6
    level = np.log1p(np.where(gone, 0, inside)) / kappa
    return np.where(gone, 0, np.exp(-0.5 * level * level)).astype(z.dtype)
