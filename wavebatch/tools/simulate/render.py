"""Echoes to raw counts: lobes painted into waveforms, noise, clipping and rounding, all waveforms at once.

`blocks` and `from_returns` call `paint_echoes`, then `record_counts`. This is the slow part of a
simulation: lobes of equal length are painted together, noise is drawn in cache-sized parts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Range, check_options, option
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.strip.packets import MAX_SAMPLES
from wavebatch.tools.simulate.pulses import PulseModel, main_lobe, spread_lobes

REACH = 5.5
"""Lobes are painted this many sigma to both sides: beyond it they are below 3e-7 of their height."""

MOST_NOISE = 1e10
"""More noise than any digitizer shows, as in the files of surveys: beyond it float32 overflows."""

_ROWS = 2048
"""Waveforms that get noise at a time: few enough for the cache."""


@dataclass(frozen=True, slots=True)
class Recording:
    """How the simulated receiver records: window, levels, noise and system pulse."""

    n_samples: Annotated[int, Range(8, MAX_SAMPLES)] = option(
        80, "Samples per waveform.", name="samples", unset="the scene's, 80 or 96"
    )
    spacing: Annotated[float, Range(0.001, 4000.0)] = option(
        1.0, "Time between samples [ns].", form="NS", unset="1"
    )  # descriptors hold it in 32 bits of picoseconds
    bits: Literal[8, 16, 32] = option(8, "Bits per sample.", unset="8")
    baseline: float = option(12.0, "Level without signal [DN].", unset="12")
    baseline_spread: float = 0.4
    """Standard deviation of the level between waveforms [count]."""
    noise_std: Annotated[float, Range(0.0, MOST_NOISE)] = option(
        1.0, "Standard deviation of the noise before rounding [DN].", form="DN", name="noise",
        unset="the scene's, 1 or 1.2",
    )  # fmt: skip
    rho: float = option(
        0.0, "Correlation of the noise of neighbouring samples: 0, .5, .667, .75 or .8.", unset="0"
    )  # m/(m+1), m = 1, 2, ...: binomial filters
    noise_gain: Annotated[float, Range(0.0, 1e6)] = option(
        0.0, "Noise variance that the signal adds [DN2 per DN].", form="DN", unset="0"
    )
    saturation: int | None = option(
        None, "Count at which the receiver saturates [DN].", unset="the largest that the bits can hold"
    )
    pulse: PulseModel = field(default_factory=PulseModel)

    def __post_init__(self) -> None:
        check_options(self)
        check = {
            f"the pulse's sigma, {self.pulse.sigma:g} ns, must be no longer than the "
            f"waveform, {self.n_samples} samples {self.spacing:g} ns apart": self.pulse.sigma
            <= self.n_samples * self.spacing,
            "rho must be 0 or m/(m+1): .5, .667, .75, .8 ...": 0 <= self.rho < 0.95
            and abs(self.rho - self.color / (self.color + 1)) < 0.006,
            "baseline must lie from 0 to below the largest count": 0 <= self.baseline < self.clip,
            "saturation must be a count that the bits can hold": 0 < self.clip < 1 << self.bits,
        }
        for message, good in check.items():
            if not good:
                raise ConfigError(f"simulated recording: {message}")

    @property
    def color(self) -> int:
        """Order m of the binomial filter that gives the noise its correlation."""
        return round(self.rho / (1 - self.rho))

    @property
    def clip(self) -> int:
        """Largest count that is ever recorded."""
        return (1 << self.bits) - 1 if self.saturation is None else self.saturation

    @property
    def recorded_noise(self) -> float:
        """Standard deviation of one recorded sample without signal [count]: noise and rounding."""
        return float(np.hypot(self.noise_std, QUANTISATION_STD))

    @property
    def empty_level(self) -> float:
        """Mean of the recorded samples without signal [count]: clipping and rounding may move it off the baseline."""
        spread = float(np.hypot(self.noise_std, self.baseline_spread))
        place = np.linspace(-8.0, 8.0, 16_000)  # an even number: a baseline on a whole count has no ties
        counts = np.clip(np.floor(self.baseline + 0.5 + spread * place), 0, self.clip)
        return float(np.average(counts, weights=np.exp(-0.5 * place**2)))

    @property
    def duration(self) -> float:
        """Time of the last sample [ns]."""
        return (self.n_samples - 1) * self.spacing

    @property
    def digitizer(self) -> Digitizer:
        """The wave packet descriptor of the waveforms."""
        return Digitizer(1, self.bits, self.n_samples, self.spacing)


def paint_echoes(
    recording: Recording, n: int, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """Signal without baseline and noise, float32 (n, s) [count].

    waveform (m,) must be sorted; time [ns], amplitude [count] and sigma [ns] per echo, (m,).
    """
    first = np.searchsorted(waveform, np.arange(n))
    rank = np.arange(len(waveform)) - first[waveform]
    jobs = []
    for number, (start, height, width) in enumerate(spread_lobes(recording.pulse, time, amplitude, sigma)):
        kappa = recording.pulse.kappa if number == 0 else 0.0
        long_side = (np.expm1(REACH * abs(kappa)) / abs(kappa) if abs(kappa) > 1e-6 else REACH) * width
        left = np.ceil((long_side if kappa < 0 else REACH * width) / recording.spacing).astype(np.int64)
        right = np.ceil((long_side if kappa > 0 else REACH * width) / recording.spacing).astype(np.int64)
        length = -(-(left + right + 1) // 8) * 8
        jobs.append((start, height, width, left, length, kappa))
    pad = max((int(job[4].max(initial=8)) for job in jobs), default=8)
    stride = recording.n_samples + pad
    canvas = np.zeros(n * stride + pad, np.float32)
    for job in jobs:
        _paint_lobes(canvas, pad, stride, recording, waveform, rank, *job)
    return canvas[pad:].reshape(n, stride)[:, : recording.n_samples]


def _paint_lobes(canvas, pad, stride, recording, waveform, rank, start, height, width, left, length, kappa) -> None:
    """Adds one lobe per echo.

    Echoes of equal rank lie in different waveforms, so that a gather, an add and a scatter lose nothing. Neighbouring
    waveforms share only the padding between them, which is not read.
    """
    position = start / recording.spacing
    sample = np.floor(position).astype(np.int64) - left
    inside = (sample > -pad) & (sample < recording.n_samples)
    key = rank * 4096 + length
    for value in np.unique(key[inside]):
        rows = np.flatnonzero(inside & (key == value))
        w = int(length[rows[0]])
        windows = np.lib.stride_tricks.as_strided(canvas, (len(canvas) - w + 1, w), (4, 4))
        offset = (sample[rows] - position[rows]).astype(np.float32)
        z = np.arange(w, dtype=np.float32) + offset[:, None]
        z *= (recording.spacing / width[rows]).astype(np.float32)[:, None]
        if kappa:
            z = main_lobe(z, kappa)
        else:
            z *= z
            z *= np.float32(-0.5)
            np.exp(z, out=z)
        z *= height[rows].astype(np.float32)[:, None]
        at = pad + waveform[rows].astype(np.int64) * stride + sample[rows]
        z += windows[at]
        windows[at] = z


def record_counts(
    recording: Recording, signal: np.ndarray, rng: np.random.Generator, constant: np.ndarray | None = None
) -> np.ndarray:
    """Raw counts, unsigned (n, s): baseline plus signal [count] plus noise, clipped and rounded.

    constant: level of the waveforms whose samples are all equal, NaN for the others, (n,).
    """
    n, s = signal.shape
    dtype = {8: np.uint8, 16: np.uint16, 32: np.uint32}[recording.bits]
    counts = np.empty((n, s), dtype)
    # Adding half a count makes the cast round to nearest, which is faster than np.rint.
    level = recording.baseline_spread * np.asarray(rng.standard_normal(n))
    level = (recording.baseline + 0.5 + level).astype(np.float32)
    top = recording.clip + 0.5
    for a in range(0, n, _ROWS):
        part = signal[a : a + _ROWS]
        values = _draw_noise(recording, part, rng)
        values += part
        values += level[a : a + _ROWS, None]
        if recording.bits == 32:
            values = values.astype(np.float64)
        np.clip(values, 0, top, out=values)
        counts[a : a + _ROWS] = values
    if constant is not None:
        rows = np.flatnonzero(~np.isnan(constant))
        counts[rows] = np.clip(constant[rows], 0, recording.clip).astype(dtype)[:, None]
    return counts


def _draw_noise(recording: Recording, signal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    n, s = signal.shape
    noise = rng.standard_normal((n, s + recording.color), dtype=np.float32)
    for _ in range(recording.color):
        noise = noise[:, 1:] + noise[:, :-1]
    if recording.color:
        taps = np.array([1.0])
        for _ in range(recording.color):
            taps = np.convolve(taps, [1.0, 1.0])
        noise /= np.float32(np.sqrt((taps**2).sum()))
    if recording.noise_gain:
        variance = np.float32(recording.noise_std**2) + np.float32(recording.noise_gain) * np.maximum(signal, 0)
        noise *= np.sqrt(variance)
    else:
        noise *= np.float32(recording.noise_std)
    return noise
