"""Blocks of waveforms to profiles along their rays: deconvolved, freed of noise, placed against known returns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.deconvolve import (
    deconvolve_gold,
    deconvolve_richardson_lucy,
    deconvolve_wiener,
    wiener_taps,
)
from wavebatch.kernels.signal.profiles import fit_height, keep_signal, measure_offsets, window_signal
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, smooth_121, widen
from wavebatch.stages.detect.candidates import signal_above
from wavebatch.stages.noise import pooled
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.stages.reference_pulse import reference_pulse
from wavebatch.surveying.learn_pulse import AFTER, BEFORE

METHODS = ("richardson_lucy", "gold", "wiener")
ITERATIONS = {"richardson_lucy": 40, "gold": 100}
"""Unless told otherwise."""

SNR = 20.0
"""Amplitude over noise that the Wiener filter is made for, unless told otherwise."""

SUPPORT = 2.0
"""Smoothed samples above this many standard deviations of their noise may hold signal."""

FLOOR = 0.1
"""Deconvolved samples below this share of the least signal, spread over the pulse, count as zero."""

BACKGROUND = 3.0
"""Added to waveform and model of the Richardson-Lucy iteration, in standard deviations of the noise."""

TOLERANCE = 2.5
"""Distance in time between a return's location and the signal that it belongs to [ns], beyond half a sample."""

AT_A_TIME = 1024
"""Waveforms whose arrays stay in the cache together."""

_REACH = 4.0
"""Half of a pulse that was not learned, and what is looked at beside signal, in widths of the system pulse."""


@dataclass(frozen=True, slots=True)
class Deconvolution:
    """How waveforms are deconvolved, and what of the result is taken for noise."""

    method: str = "richardson_lucy"
    iterations: int | None = None
    snr: float | None = None
    threshold: float = 4.27
    """Least sum of a run of signal, in standard deviations that an echo would have if it were alone."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(f"method {self.method!r} is unknown; choose {', '.join(METHODS)}")
        if self.iterations is not None and (self.method not in ITERATIONS or not 1 <= self.iterations <= 10_000):
            raise ConfigError("iterations are those of richardson_lucy or gold, 1 to 10000")
        if self.snr is not None and (self.method != "wiener" or not 0 < self.snr < 1e9):
            raise ConfigError("the signal-to-noise ratio is that of method wiener, above 0")
        if not 0 <= self.threshold < 1e9:
            raise ConfigError("the threshold must not be below 0")

    @property
    def steps(self) -> int | None:
        """Iterations; None for the linear filter."""
        return self.iterations or ITERATIONS.get(self.method)


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """What the n waveforms of a block say along their rays."""

    value: np.ndarray
    """Height of the system pulses, one at every sample, that make up the waveform, f8 (n, s) [count]; 0 is none."""
    area: float
    """Integral of a system pulse of height 1 [ns]."""
    seen: np.ndarray
    """Waveforms with any signal, bool (n,)."""
    offset: np.ndarray
    """How far the signal lies behind the known returns of its packet, f8 (n,) [ns]."""
    anchored: np.ndarray
    """Whether that is known, bool (n,); else it is 0."""
    clipped: np.ndarray
    """Waveforms with samples at the digitizer's limit, bool (n,)."""


def deconvolve_block(block: WaveformBlock, system: SystemPulse, options: Deconvolution) -> Profiles:
    """Profiles of a block: waveforms without baseline and noise, deconvolved with the system pulse.

    Where nothing rises above the noise there is nothing: runs of samples whose sum is less than `threshold` standard
    deviations of a lone echo's amplitude are dropped. Each waveform is treated on its own.
    """
    system = system.of(block)
    taps, area = _pulse_taps(system, block.spacing)
    noise = pooled(block, system)
    signal = signal_above(block, noise)
    n, s = block.samples.shape
    support = widen(smooth_121(signal) > np.float32(SUPPORT * SMOOTH_GAIN) * noise.std, 1)
    width = system.sigma_ref / block.spacing
    first, length = window_signal(support, int(np.ceil(_REACH * width)))
    least = options.threshold * _lone_error(taps, width, options)
    floor = FLOOR * max(least, 1e-3) / max(width, 1.0)
    value, seen = np.zeros((n, s)), np.zeros(n, bool)
    for rows in _group_rows(length):
        place = first[rows] + np.arange(length[rows[0]])[:, None]
        std = noise.std[rows].astype(np.float64)
        part = signal[place, rows]
        profile = _deconvolve(part, taps, noise.std[rows], options)
        near = np.ascontiguousarray(support[place, rows].T)
        kept, seen[rows] = keep_signal(np.ascontiguousarray(profile.T), near, least * std, floor * std)
        if options.method != "richardson_lucy":  # whose iteration keeps the energy
            kept = fit_height(kept, part, taps, near)
        value[rows[:, None], place.T] = kept
    offset, anchored = _find_offsets(block, value)
    clipped = (block.samples >= clip_level(block, system)).any(axis=1)
    return Profiles(value, area, seen, offset, anchored, clipped)


def _group_rows(length: np.ndarray) -> Iterator[np.ndarray]:
    """Waveforms with windows of one length, some at a time; those without signal are left out."""
    order = np.argsort(length, kind="stable")
    edges = np.append(np.flatnonzero(np.diff(length[order], prepend=0)), len(order))
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        for begin in range(low, high, AT_A_TIME):
            yield order[begin : min(begin + AT_A_TIME, high)]


def _lone_error(taps: np.ndarray, width: float, options: Deconvolution) -> float:
    """Standard deviation of the sum of a lone echo's profile, in that of a sample.

    The iterations come near the matched filter's; what the linear filter lets through is summed over the pulse.
    """
    if options.method != "wiener":
        return float(1.0 / np.sqrt(np.sum(taps**2)))
    inverse = wiener_taps(taps, (options.snr or SNR) ** -2.0, 4 * len(taps))
    box = np.ones(2 * max(int(round(width)), 1) + 1)
    return float(np.sqrt(np.sum(np.convolve(inverse, box) ** 2)))


def _deconvolve(signal: np.ndarray, taps: np.ndarray, std: np.ndarray, options: Deconvolution) -> np.ndarray:
    if options.method == "wiener":
        return deconvolve_wiener(signal, taps, (options.snr or SNR) ** -2.0)
    if options.method == "gold":
        return deconvolve_gold(signal, taps, options.steps)
    return deconvolve_richardson_lucy(signal, taps, np.float32(BACKGROUND) * std, options.steps)


def _pulse_taps(system: SystemPulse, spacing: float) -> tuple[np.ndarray, float]:
    """Samples of the system pulse of height 1, its tail and after-pulses too, and its integral [ns].

    A learned pulse is cut where the echoes that it was learned from were: what its Gaussians say beyond is nothing
    that anybody measured.
    """
    if not system.components:
        taps = reference_pulse(system, spacing, "system", _REACH).taps
        return taps, float(np.sum(taps)) * spacing
    width = system.sigma_ref / spacing
    unit = max(width / 2, 1.0)
    given = reference_pulse(system, spacing, "system", AFTER * unit / width)
    lag = np.arange(len(given.taps)) - given.middle
    taps = np.where((lag >= -BEFORE * unit) & (lag <= AFTER * unit), given.taps, 0.0)
    return taps, float(np.sum(taps)) * spacing


def _find_offsets(block: WaveformBlock, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of the profiles from the returns of their packets [ns], and where they are known."""
    returns = block.returns
    if returns is None or not len(returns):
        return np.zeros(len(block)), np.zeros(len(block), bool)
    reach = int(np.ceil(TOLERANCE / block.spacing + 0.5))
    row = returns.waveform.astype(np.int64)
    offset, known = measure_offsets(value, row, returns.time / block.spacing, reach)
    return offset * block.spacing, known
