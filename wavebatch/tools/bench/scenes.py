"""Scenes of the benchmark: the named ones, and one shaped like a real strip.

`command` and `speed` call this. The strip is surveyed and a sample of it decomposed; the scene draws whole waveforms of
that sample with small changes, so that counts, amplitudes, widths and gaps of its echoes are real ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.files.strip.shared_packets import expand
from wavebatch.stages.chain import Chain
from wavebatch.surveying import SAMPLE, survey_blocks
from wavebatch.surveying.survey import pool_blocks
from wavebatch.tools.bench.truth import smoothed_power
from wavebatch.tools.simulate import PulseModel, Recording, Scene
from wavebatch.tools.simulate.draws import Drawn

LEAST_WAVEFORMS = 200
"""Least waveforms of a strip whose echoes can be resampled."""

JITTER = 0.05
"""Relative change of the amplitudes and gaps of a resampled waveform, one standard deviation."""

STRONG = 20.0
"""Signal to noise from which measured widths show the true spread of widths."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Echoes of decomposed waveforms, to draw from."""

    first: np.ndarray
    """Row of each waveform's first echo, i8 (n,)."""
    count: np.ndarray
    """Echoes of each waveform, i8 (n,)."""
    time: np.ndarray
    amplitude: np.ndarray
    sigma: np.ndarray
    """Of the main lobe [ns], without the scatter of its error, f8 (m,)."""


@dataclass(frozen=True, slots=True)
class StripScene(Scene):
    """Waveforms like those of a strip, drawn from a sample of its echoes."""

    sample: Sample | None = None

    def draw(self, rng: np.random.Generator, n: int, incidence: np.ndarray) -> Drawn:
        """Echoes of n waveforms: whole waveforms of the strip, shifted by part of a sample, with JITTER.

        Echoes outside the window are dropped.
        """
        sample, recording = self.sample, self.recording
        chosen = rng.integers(0, len(sample.count), n)
        count = sample.count[chosen]
        waveform = np.repeat(np.arange(n), count)
        row = expand(sample.first[chosen], count)
        start = sample.time[np.repeat(sample.first[chosen], count)]
        stretch = np.exp(JITTER * rng.standard_normal(n))[waveform]
        shift = rng.uniform(-0.5, 0.5, n)[waveform] * recording.spacing
        time = start + shift + (sample.time[row] - start) * stretch
        amplitude = sample.amplitude[row] * np.exp(JITTER * rng.standard_normal(len(row)))
        inside = (time > 0) & (time < recording.duration)
        return Drawn(waveform[inside], time[inside], amplitude[inside], sample.sigma[row][inside])


def shape_scene(strip: Path, chain: Chain) -> StripScene:
    """A scene like the strip: noise, baselines and pulse of its survey, and the echoes that `chain` finds in it.

    Raises InputError where the strip cannot be read or holds too few waveforms.
    """
    with StripReader(strip) as reader, reader.scan() as scan:
        blocks = [block for block in reader.sample_blocks(scan, SAMPLE) if len(block)]
    kinds = {(block.spacing, block.samples.shape[1]) for block in blocks}
    largest = max(kinds, key=lambda kind: sum(b.samples.size for b in blocks if _kind(b) == kind), default=None)
    chosen = [block for block in blocks if _kind(block) == largest]
    number = sum(len(block) for block in chosen)
    if number < LEAST_WAVEFORMS:
        raise InputError(
            f"{strip}: {number} waveforms of one length are too few to shape a benchmark like it ({LEAST_WAVEFORMS} "
            "are needed); name a scene with --scene"
        )
    block = pool_blocks(chosen)
    system = survey_blocks([block]).system
    recording = describe_recording(system, block)
    sample = _take_sample(chain.run(block, system), len(block), system, recording)
    return StripScene(strip.name, f"like {strip.name}", recording=recording, sample=sample)


def _kind(block: WaveformBlock) -> tuple[float, int]:
    return block.spacing, block.samples.shape[1]


def describe_recording(system: SystemPulse, block: WaveformBlock) -> Recording:
    """The receiver that a survey found: levels, noise and its colour, clipping, learned pulse."""
    color = _find_color(system)
    gain = np.sqrt(smoothed_power(color) / 6)
    pulse = PulseModel(sigma=system.sigma_ref, kappa=system.kappa)
    if len(system.components) > 1:
        weight, delay, sigma = system.components[0]
        pulse = PulseModel(sigma, 0.0, tuple((w / weight, d - delay, s) for w, d, s in system.components[1:]))
    clip = None if system.saturation is None else int(min(system.saturation, block.digitizer.max_count))
    return Recording(
        n_samples=block.samples.shape[1],
        spacing=block.spacing,
        bits=block.digitizer.bits,
        baseline=system.noise.baseline,
        baseline_spread=system.noise.baseline_spread,
        noise_std=float(np.sqrt(max(_sample_noise(system) ** 2 - QUANTISATION_STD**2, 0.0))) / float(gain),
        rho=color / (color + 1),
        noise_gain=system.noise.gain,
        saturation=clip,
        pulse=pulse,
    )


def _sample_noise(system: SystemPulse) -> float:
    """Noise of one sample [count]; `noise.std` is what coloured noise does to the amplitude of a pulse."""
    kinds = system.noise.by_kind
    return kinds.get("outside") or kinds.get("quiet") or system.noise.std


def _find_color(system: SystemPulse) -> int:
    """Order of the binomial filter whose noise changes by smoothing as the noise of the strip does."""
    kinds = system.noise.by_kind
    pairs = [(kinds.get(f"{kind}_smoothed", 0.0), kinds.get(kind, 0.0)) for kind in ("tail", "quiet")]
    ratio = next((smoothed / raw for smoothed, raw in pairs if raw > 0), 1.0)
    return int(np.argmin(np.abs(np.sqrt(smoothed_power(np.arange(5)) / 6) - ratio)))


def _take_sample(found: EchoTable, n: int, system: SystemPulse, recording: Recording) -> Sample:
    bad = int(EchoFlag.NOT_CONVERGED | EchoFlag.NEAR_EDGE | EchoFlag.AMPLITUDE_UNRELIABLE)
    keep = (found.flags & bad) == 0
    keep &= (found.time > 0) & (found.time < recording.duration)
    found = found.take(np.flatnonzero(keep))
    count = found.count(n)
    scale = recording.pulse.sigma / system.sigma_ref
    sigma = _free_widths(found, system) * scale
    return Sample(
        first=np.cumsum(count) - count,
        count=count,
        time=found.time,
        amplitude=np.clip(found.amplitude.astype(np.float64), 1.0, 4.0 * (1 << recording.bits)),
        sigma=np.clip(sigma, 0.85 * recording.pulse.sigma, 4.0 * recording.pulse.sigma),
    )


def _free_widths(found: EchoTable, system: SystemPulse) -> np.ndarray:
    """Widths [ns] moved towards the typical one by the share of their spread that their error explains."""
    sigma = found.sigma.astype(np.float64)
    strong = sigma[found.amplitude > STRONG * system.noise.std]
    if len(strong) < 2:
        return np.full(len(sigma), system.sigma_ref)
    typical, spread = float(np.median(strong)), float(strong.var())
    error = np.nan_to_num(found.sigma_err.astype(np.float64), nan=0.0, posinf=1e3)
    return typical + (sigma - typical) * spread / np.maximum(spread + error**2, 1e-12)
