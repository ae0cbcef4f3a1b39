"""The parts of a SystemPulse beside the pulse: the receiver's noise and defects, the widths of level ground, the light.

The survey measures the first three, `surveying.calibration` and options of a run give the last. Fields with a Key
stand in system files (`surveying/system_file.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Annotated

import numpy as np

from wavebatch.core.frozen import frozen
from wavebatch.core.schema import Key, Range
from wavebatch.core.units import AIR_ATTENUATION, QUANTISATION_STD


@frozen
class ReceiverNoise:
    """What a receiver records without signal."""

    baseline: Annotated[float, Range(-1e10, 1e10), Key("baseline_dn", "level without signal", needed=True)] = 0.0
    """Typical level without signal [count]."""
    baseline_spread: Annotated[
        float, Range(0.0, 1e10), Key("baseline_spread_dn", "its standard deviation between waveforms", needed=True)
    ] = 0.0
    """Standard deviation of the true baseline between waveforms [count]."""
    recovery: Annotated[float, Range(0.0, 1e9), Key("recovery_ns", "after strong signal, until the level is back")] = (
        0.0
    )
    """Time after a strong signal until the level is back to what it was before it [ns]."""
    std: Annotated[
        float, Range(1e-3, 1e10), Key("noise_std_dn", "noise of one sample, for thresholds and errors", needed=True)
    ] = QUANTISATION_STD
    """Noise of one sample that thresholds and errors use [count]."""
    by_kind: Annotated[Mapping[str, Annotated[float, Range(0.0, 1e30)]], Key("noise_by_kind_dn", needed=True)] = field(
        default_factory=dict
    )
    """The estimates that `std` was chosen from: quiet, outside of echoes, core ... [count]."""
    correlation: Annotated[
        tuple[Annotated[float, Range(-1.0, 1.0)], ...],
        Key("correlation", "of the noise of two samples 1, 2, ... spacings apart; empty: white noise", blank=True),
    ] = ()
    """Correlation of the noise of two samples 1, 2, ... spacings apart; empty where it is white."""
    gain: Annotated[
        float, Range(0.0, 1e6), Key("noise_gain", "growth of the noise's variance per count of signal", needed=True)
    ] = 0.0
    """Signal-dependent noise variance per count of signal [count] (docs/algorithms.md H12)."""
    whitening: Annotated[
        tuple[Annotated[float, Range(-2.0, 2.0)], ...],
        Key(
            "whitening", "what predicts the noise of a sample from the two before it; empty: fits take noise for white"
        ),
    ] = ()
    """What predicts the noise of a sample from the two before it; empty where fits take noise for white."""

    @property
    def quiet(self) -> float:
        """Noise of a quiet sample [count]: `std` is larger where noise is coloured."""
        return min(self.std, self.by_kind.get("quiet") or self.std)


@frozen
class Defects:
    """What waveforms have before any signal, and what is taken off them before they are read."""

    pattern: Annotated[
        tuple[Annotated[float, Range(-1e6, 1e6)], ...],
        Key("pattern_dn", "offsets that repeat along the samples, taken off; empty: none", blank=True),
    ] = ()
    """Offsets that repeat along the samples, of converters that take samples in turn [count]; empty for none."""
    slope_spread: Annotated[
        float, Range(0.0, 1e9), Key("slope_spread_dn_ns", "of baselines within a waveform, taken off")
    ] = 0.0
    """Standard deviation of the slopes of baselines [count/ns]; 0 where baselines are level."""
    spikes: Annotated[float, Range(0.0, 1e6), Key("spikes", "of one sample, per waveform, taken off")] = 0.0
    """Spikes of one sample per waveform; 0 where they are not taken off."""
    transient: Annotated[float, Range(0.0, 1e9), Key("transient_ns", "at the start of waveforms, left out")] = 0.0
    """Time at the start of every waveform in which its receiver is not at rest [ns]."""

    def __bool__(self) -> bool:
        """Whether waveforms must be cleaned before they are read."""
        return bool(self.pattern or self.slope_spread or self.spikes or self.transient)


@frozen
class LevelWidths:
    """How wide the echoes of level ground are, seen from above."""

    variance: Annotated[
        float, Range(-1e8, 0.0), Key("level_variance_ns2", "of level ground's echoes less the pulse's")
    ] = 0.0
    """Their variance minus that of the system pulse [ns2]: zero or negative, because the echoes that the pulse was
    learned from come from slopes too.
    """
    error: Annotated[float | None, Range(0.0, 1e8), Key("level_error_ns2", "standard deviation of level_variance")] = (
        None
    )
    """Standard deviation of `variance` [ns2]; None where it was not measured, infinite where surfaces of known slope
    were sought and not found, so that widths mean no angle.
    """
    scatter: Annotated[
        float, Range(0.0, 1e4), Key("width_scatter_ns", "of echo widths beyond the errors of their fits")
    ] = 0.0
    """Scatter of the echo widths of one surface beyond their fit errors [ns]: no pulse model is exact."""


@frozen
class Radiometry:
    """What turns amplitudes and times into light: beam, calibration, air, and the errors of each."""

    divergence: Annotated[
        float | None,
        Range(1e-3, 100.0),
        Key("divergence_mrad", "full angle of the beam, 1/e^2, from its data sheet"),
    ] = None
    """Full angle of the beam between the 1/e^2 points [mrad]; None where it is not known."""
    divergence_error: Annotated[
        float, Range(0.0, 1.0), Key("divergence_error", "standard deviation of the divergence, relative")
    ] = 0.0
    """Relative standard deviation of the divergence."""
    constant: float | None = None
    """Constant C' of kernels/physics/radiometry [1/(m2 count ns)]; None where the strip is not calibrated."""
    constant_error: float = 0.0
    """Relative standard deviation of the constant."""
    shot_error: float = 0.0
    """Relative standard deviation of the emitted energy from shot to shot, where the block does not hold it."""
    channels: Mapping[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    """Constant and its relative error of single channels, by (index of the digitizer, scanner channel)."""
    swath: tuple[float, ...] = ()
    """How the constant grows with the angle t of the ray across the flight: largest angle T [rad], a, b and c of
    exp(a u^2 + b u^4 + c u), u = t / T from -1 to 1; empty where it does not.
    """
    right: tuple[float, float] = (0.0, 0.0)
    """Unit vector to the right of the strip's flight."""
    attenuation: float = AIR_ATTENUATION
    """Attenuation of the light in the air, one way [dB/km]."""
    attenuation_error: float = 0.0
    """Standard deviation of the attenuation [dB/km]."""
    sensor_error: float = 0.0
    """Standard deviation of the distance to the sensor's position [m]."""
    returns: float = 0.0
    """Standard deviation of the vendor's returns along the ray [m], which echoes are placed by."""
    phase: float = 0.0
    """Root mean square of what locations of returns differ from echoes [m]: the error of echoes without a return."""


def angle_to_vertical(direction: np.ndarray) -> np.ndarray:
    """Angle of rays to the vertical, at which they strike level ground; direction: f8 (n, 3), angle: f8 (n,) [rad]."""
    x, y, z = direction.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        down = -z / np.sqrt(x * x + y * y + z * z)
    return np.arccos(np.clip(down, -1.0, 1.0))


def angle_across(direction: np.ndarray, right: np.ndarray | tuple[float, float]) -> np.ndarray:
    """Angle of rays f8 (n, 3) across the flight, from the vertical to its right, f8 (n,) [rad]; right: unit vector
    (2,), or one for each ray (n, 2)."""
    return np.arctan2((direction[:, :2] * right).sum(axis=1), -direction[:, 2])


def swath_columns(angle: np.ndarray, most: float) -> np.ndarray:
    """u^2, u^4 and u of angles (n,) [rad], f8 (n, 3), u = angle / most from -1 to 1: see `Radiometry.swath`."""
    share = np.clip(angle / most, -1.0, 1.0)
    return np.stack([share**2, share**4, share], axis=1)
