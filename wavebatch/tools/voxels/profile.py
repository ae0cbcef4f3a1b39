"""Waveforms to profiles along their rays: deconvolved, noise removed, placed by the returns of their packets.

`strip.voxelize_strip` calls `deconvolve_block` for every block. Waveforms are handled one by one in effect: a profile
does not depend on the other waveforms of its block.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Above, Range, check_options, option
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.deconvolve import (
    deconvolve_gold,
    deconvolve_richardson_lucy,
    deconvolve_wiener,
    fit_height,
    keep_signal,
    measure_offsets,
    wiener_taps,
    window_signal,
)
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, smooth_121, widen
from wavebatch.stages.detect.candidates import signal_above
from wavebatch.stages.noise import pooled
from wavebatch.stages.pulse_tables import clip_level, reference_pulse
from wavebatch.surveying.measuring.learn_pulse import AFTER, BEFORE

ITERATIONS = {"richardson_lucy": 40, "gold": 100}
"""Default iterations: Gold converges more slowly (docs/algorithms.md 2.5)."""

SNR = 20.0
"""Default ratio of amplitude to noise for the Wiener filter."""

SUPPORT = 2.0
"""Smoothed samples above this many standard deviations of their noise may hold signal."""

FLOOR = 0.1
"""Deconvolved samples below this share of the least signal, spread over the pulse, are set to zero."""

BACKGROUND = 3.0
"""Level added to waveform and model of the Richardson-Lucy iteration, which needs positive values [noise std]."""

TOLERANCE = 2.5
"""Largest distance between the location of a return and its signal [ns], beyond half a sample."""

AT_A_TIME = 1024
"""Waveforms deconvolved together: few enough for the cache."""

_REACH = 4.0
"""Half length of a Gaussian pulse, and margin around signal, in widths of the system pulse."""


@dataclass(frozen=True, slots=True)
class Deconvolution:
    """How waveforms are deconvolved, and how much signal counts as noise."""

    method: Literal["richardson_lucy", "gold", "wiener"] = option(
        "richardson_lucy", "How waveforms are deconvolved with the system pulse."
    )
    iterations: Annotated[int | None, Range(1, 10_000)] = option(
        None, "Iterations: more resolve closer surfaces, but take longer.", form="N", unset="40; gold: 100"
    )
    snr: Annotated[float | None, Above(0.0, 1e9)] = option(
        None, "wiener: amplitude over noise for which the filter is designed.", form="RATIO", unset="20"
    )
    threshold: Annotated[float, Range(0.0, 1e9)] = option(
        4.27, "Ignore signal weaker than a single echo of this many standard deviations of the noise.", form="STD"
    )

    def __post_init__(self) -> None:
        check_options(self)
        if self.iterations is not None and self.method == "wiener":
            raise ConfigError("--method wiener has no --iterations")
        if self.snr is not None and self.method != "wiener":
            raise ConfigError("--snr needs --method wiener")

    @property
    def steps(self) -> int | None:
        """Iterations; None for the linear filter."""
        return self.iterations or ITERATIONS.get(self.method)


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Signal of n waveforms along their rays."""

    value: np.ndarray
    """Heights of system pulses, one at every sample, whose sum is the waveform, f8 (n, s) [count]; 0: no signal."""
    area: float
    """Integral of a system pulse of height 1 [ns]."""
    seen: np.ndarray
    """Waveforms with any signal, bool (n,)."""
    offset: np.ndarray
    """Delay of the signal after the returns of its packet, f8 (n,) [ns]; 0 where unknown."""
    anchored: np.ndarray
    """Waveforms with a known offset, bool (n,)."""
    clipped: np.ndarray
    """Waveforms with samples at the digitizer's limit, bool (n,)."""


def deconvolve_block(block: WaveformBlock, system: SystemPulse, options: Deconvolution) -> Profiles:
    """Profiles of a block: waveforms without baseline and noise, deconvolved with the system pulse.

    Runs of samples whose sum is less than `threshold` standard deviations of a lone echo's amplitude are dropped.
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
        if options.method != "richardson_lucy":  # that iteration keeps the energy, the others do not
            kept = fit_height(kept, part, taps, near)
        if block.missing is not None:
            kept = np.where(block.missing[rows[:, None], place.T], 0.0, kept)
        value[rows[:, None], place.T] = kept
    offset, anchored = _find_offsets(block, value)
    clipped = (block.samples >= clip_level(block, system)).any(axis=1)
    return Profiles(value, area, seen, offset, anchored, clipped)


def _group_rows(length: np.ndarray) -> Iterator[np.ndarray]:
    """Rows of waveforms with windows of equal length, AT_A_TIME at most; those without signal are left out."""
    order = np.argsort(length, kind="stable")
    edges = np.append(np.flatnonzero(np.diff(length[order], prepend=0)), len(order))
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        for begin in range(low, high, AT_A_TIME):
            yield order[begin : min(begin + AT_A_TIME, high)]


def _lone_error(taps: np.ndarray, width: float, options: Deconvolution) -> float:
    """Standard deviation of the sum of a lone echo's profile, in units of that of a sample.

    That of the iterations is near the matched filter's; that of the linear filter follows from its taps.
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
    """Samples of the system pulse of height 1, with tail and after-pulses, and its integral [ns].

    A learned pulse is cut where the echoes it was learned from were cut: beyond, its Gaussians are extrapolated.
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
