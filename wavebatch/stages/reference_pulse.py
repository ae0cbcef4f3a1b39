"""Reference pulses that detectors and decomposers compare waveforms with: samples of unit height and their peak."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse
from wavebatch.kernels.elementary import exp
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.kernels.signal.filters import refine_peaks
from wavebatch.stages.pulse_tables import describe_fitted, pulse_shape, shape_limits

ReferenceKind = Literal["gaussian", "system", "given"]


class PulseReference(NamedTuple):
    """Samples of a reference pulse."""

    taps: np.ndarray
    """float64 (k,), k odd; peak about 1."""
    peak: float
    """Place of the peak, of the survey's pulse that of its datum, among the samples; times of echoes refer to it."""

    @property
    def middle(self) -> int:
        """Index of the middle sample."""
        return (len(self.taps) - 1) // 2


def reference_pulse(
    system: SystemPulse, spacing: float, kind: ReferenceKind, reach: float = 5.0, pulse: str = ""
) -> PulseReference:
    """Sample the reference pulse: a Gaussian of the system's width, the pulse of the survey, or a given one.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].
    kind : {"gaussian", "system", "given"}
        Which pulse.
    reach : float
        Half of its length, in widths of the system pulse.
    pulse : str
        Samples of the given pulse, separated by spaces.

    Returns
    -------
    Reference
        Samples and peak.

    Raises
    ------
    ConfigError
        Where the given samples are no pulse.
    """
    if kind == "given":
        return _read_pulse(pulse)
    half = int(np.ceil(reach * system.sigma_ref / spacing))
    x = np.arange(-half, half + 1, dtype=np.float64)
    if kind == "gaussian":
        return PulseReference(exp(-0.5 * (x * spacing / system.sigma_ref) ** 2), float(half))
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    flat = np.array([[1.0, 0.0, limits.ref]])
    (peak, datum, _), *_ = describe_fitted(shape, limits, flat, np.ones((1, 3)), np.zeros((1, 2)))[0]
    taps = evaluate_pulse(shape, x[:, None], np.full(1, -datum), np.full(1, limits.ref))[0][:, 0]
    return PulseReference(taps / peak, float(half))


@lru_cache(maxsize=8)
def _read_pulse(text: str) -> PulseReference:
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
    return PulseReference(samples / height[0], float(peak[0]))
