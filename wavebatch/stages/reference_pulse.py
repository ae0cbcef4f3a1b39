"""Reference pulses that detectors look for: sampled, of unit height, with the place of their peak."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.kernels.signal.filters import refine_peaks
from wavebatch.stages.pulse_tables import pulse_measures, pulse_shape, shape_limits

ReferenceKind = Literal["gaussian", "system", "given"]


class Reference(NamedTuple):
    """Samples of a pulse."""

    taps: np.ndarray
    """float64 (k,), k odd; peak about 1."""
    peak: float
    """Where the pulse's peak lies among them: the datum of all times."""

    @property
    def middle(self) -> int:
        """Index of the middle sample."""
        return (len(self.taps) - 1) // 2


def reference_pulse(
    system: SystemPulse, spacing: float, kind: ReferenceKind, reach: float = 5.0, pulse: str = ""
) -> Reference:
    """The reference: a Gaussian of the system's width, the pulse that the survey found, or the one that is given.

    reach: half of its length, in system widths; pulse: samples of the given one, separated by spaces. Raises
    ConfigError where these are no pulse.
    """
    if kind == "given":
        return _read_pulse(pulse)
    half = int(np.ceil(reach * system.sigma_ref / spacing))
    x = np.arange(-half, half + 1, dtype=np.float64)
    if kind == "gaussian":
        return Reference(np.exp(-0.5 * (x * spacing / system.sigma_ref) ** 2), float(half))
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    delay, peak = 0.0, 1.0
    if shape.components:
        table = pulse_measures(shape, limits)
        delay = float(np.interp(limits.ref, table.width, table.delay))
        peak = float(np.interp(limits.ref, table.width, table.peak))
    taps = evaluate_pulse(shape, x[:, None], np.full(1, -delay), np.full(1, limits.ref))[0][:, 0]
    return Reference(taps / peak, float(half))


@lru_cache(maxsize=8)
def _read_pulse(text: str) -> Reference:
    try:
        samples = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise ConfigError(f"pulse must be numbers separated by spaces, it is {text!r}: {error}") from error
    if len(samples) < 3 or not np.isfinite(samples).all() or not samples.max() > 0:
        raise ConfigError(f"pulse must have at least three samples and a positive peak, it is {text!r}")
    if len(samples) % 2 == 0:
        samples = np.append(samples, 0.0)
    samples = samples / samples.max()
    top = np.array([int(np.argmax(samples))])
    peak, height = refine_peaks(samples[:, None], np.zeros(1, np.int64), top)
    return Reference(samples / height[0], float(peak[0]))
