"""A block of waveforms with exactly the echoes that the caller gives, and its noise and system pulse without error.

The scripts of this folder and the tests use it where a scene is too random. `known_noise` and `known_system` stand in
for a survey.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.tools.simulate.render import PulseModel, Recording, paint_echoes, record_counts
from wavebatch.tools.simulate.scenes import flag_truth, tabulate_echoes

FINE = 100.0
"""Counts per unit of amplitude of `fine_recording`."""


def simulate_echoes(
    recording: Recording, time: np.ndarray, amplitude, sigma, rng: np.random.Generator
) -> tuple[WaveformBlock, EchoTable]:
    """A block of n waveforms without geometry that hold the given echoes, and its truth.

    time: peaks (n, k) [ns after sample 0], NaN where a waveform has fewer than k; amplitude [count] and sigma of the
    main lobe [ns]: of the same shape, or broadcast to it. rng draws the noise.
    """
    drawn = tabulate_echoes(np.asarray(time, np.float64), amplitude, sigma)
    signal = paint_echoes(recording, len(time), drawn.waveform, drawn.time, drawn.amplitude, drawn.sigma)
    block = WaveformBlock.from_samples(record_counts(recording, signal, rng), spacing=recording.spacing)
    truth = EchoTable.build(drawn.waveform, drawn.time, drawn.amplitude, drawn.sigma)
    return block, flag_truth(truth, recording)


def fine_recording(
    noise_std: float, sigma: float, *, n_samples: int = 80, spacing: float = 1.0, kappa: float = 0.0
) -> Recording:
    """A receiver of 16 bits with FINE counts per unit of amplitude, so that rounding and clipping do not matter.

    noise_std: in units of amplitude; echoes must be given with FINE times their amplitude. sigma [ns] and kappa: width
    and skew of the pulse.
    """
    pulse = PulseModel(sigma, kappa)
    return Recording(n_samples, spacing, 16, 5000.0, baseline_spread=0.0, noise_std=FINE * noise_std, pulse=pulse)


def known_noise(recording: Recording, n: int, least: float = 0.0) -> Noise:
    """The true noise of n waveforms; least: smallest standard deviation to return [count]."""
    std = max(recording.recorded_noise, least)
    return Noise(np.full(n, recording.baseline, np.float32), np.full(n, std, np.float32))


def known_system(recording: Recording) -> SystemPulse:
    """The result of a survey without error; lobes of the pulse are left out."""
    return SystemPulse(
        sigma_ref=recording.pulse.sigma,
        noise=ReceiverNoise(
            baseline=recording.baseline,
            baseline_spread=recording.baseline_spread,
            std=recording.recorded_noise,
            gain=recording.noise_gain,
        ),
        kappa=recording.pulse.kappa,
    )
