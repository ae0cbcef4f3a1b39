"""How well chains will do on a strip: its own echoes simulated anew with its own pulse and noise, and found again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import HALF_C, QUANTISATION_STD
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.stages.chain import Chain
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.maximum import maximum
from wavebatch.stages.noise import pooled
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits
from wavebatch.stages.score import match_echoes

WAVEFORMS = 2048
"""Waveforms of a trial."""

SEED = 20071
"""Of a trial's noise: a strip gets the same prediction every time."""


LEAST_SNR = 5.0
"""Amplitude over noise from which an echo of the sample is taken for one: a bound goes as its inverse."""

_DOUBTFUL = EchoFlag.AT_BOUND | EchoFlag.NOT_CONVERGED | EchoFlag.NEAR_EDGE


@dataclass(frozen=True, slots=True)
class Prediction:
    """What a chain is expected to do on a strip."""

    name: str
    bound: float
    """Root mean square of the Cramer-Rao bounds of the strip's echoes, each as if it were alone [m along the ray]."""
    factor: float
    """Root mean square error of the echoes found in the trial over that of their bounds."""
    completeness: float
    """Share of the trial's echoes that were found."""

    @property
    def range_error(self) -> float:
        """Root mean square error of the range [m]; infinite where nothing was found."""
        return self.bound * self.factor

    def to_json(self) -> dict[str, object]:
        """The numbers under names with their units; None for what is not finite."""
        told = {"range_error_m": self.range_error, "bound_m": self.bound, "factor": self.factor}
        told["completeness"] = self.completeness
        numbers = {name: float(f"{value:.6g}") if np.isfinite(value) else None for name, value in told.items()}
        return {"chain": self.name, **numbers}


def predict_errors(block: WaveformBlock, system: SystemPulse, chains: Mapping[str, Chain]) -> list[Prediction]:
    """Predictions for chains, from a sample of a strip and its system pulse; in the order of `chains`.

    The sample's echoes, as the adaptive decomposer finds them, are rendered with the strip's pulse and get new noise of
    the strip's level; what a chain finds in these waveforms is compared with them. Targets so close together that they
    were one echo in the sample are one target here: the error is that of echoes that can be told apart.
    """
    block = block.rows(slice(0, None, max(len(block) // WAVEFORMS, 1)))
    noise = pooled(block, system)
    truth = adaptive(block, noise, system, maximum(block, noise, system))
    sure = truth.amplitude >= LEAST_SNR * noise.std[truth.waveform]
    truth = truth.take(np.flatnonzero(sure & ((truth.flags & int(_DOUBTFUL)) == 0)))
    trial = simulate_again(block, system, truth, np.random.default_rng(SEED))
    bounds = bound_time(truth.amplitude, truth.sigma.astype(np.float64), system.noise_std, block.spacing) * HALF_C
    bound = _rms(bounds)
    predictions = []
    for name, chain in chains.items():
        found = chain.run(trial, system)
        match = match_echoes(found, truth)
        error = (found.time[match.found] - truth.time[match.truth]) * HALF_C
        if len(error):
            factor = _rms(error) / _rms(bounds[match.truth])
        else:
            factor = np.inf if len(truth) else 1.0
        predictions.append(Prediction(name, bound, float(factor), len(error) / max(len(truth), 1)))
    return predictions


def simulate_again(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, rng: np.random.Generator
) -> WaveformBlock:
    """Waveforms that hold `echoes` of the block, with the strip's pulse, new baselines and new noise."""
    n, s = block.samples.shape
    shape, limits = pulse_shape(system, block.spacing), shape_limits(system, block.spacing)
    start = [echoes.amplitude, echoes.time / block.spacing, echoes.sigma / block.spacing]
    amplitude, time, width = model_parameters(shape, limits, np.stack(start, axis=1).astype(np.float64)).T
    signal = render_echoes(shape, n, s, echoes.waveform, time, amplitude, width)
    # Rounding to whole counts adds its own share of the noise again.
    white = max(system.noise_std**2 - QUANTISATION_STD**2, 0.0)
    variance = white + system.noise_gain * np.maximum(signal, 0)
    signal += np.sqrt(variance).astype(np.float32) * rng.standard_normal((n, s), dtype=np.float32)
    signal += system.baseline + system.baseline_spread * rng.standard_normal((n, 1))
    top = block.digitizer.max_count if system.saturation is None else min(system.saturation, block.digitizer.max_count)
    counts = np.clip(np.rint(signal), 0, top).astype(block.samples.dtype)
    trial = WaveformBlock.from_samples(counts, spacing=block.spacing, bits=block.digitizer.bits)
    return replace(trial, digitizer=block.digitizer)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
