"""Times refer to one point of the pulse, whatever model of it a survey chose."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.learn_pulse import fit_gaussians, fit_skewed, stack_pulse
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian
from wavebatch.kernels.signal.runs import lobe_edges
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.decompose.models import reference
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.noise import pooled

SIGMA = 2.0
FINE = np.arange(-60, 90, 0.05)
RECEIVERS = {
    "skewed": np.exp(-0.5 * (np.log1p(np.maximum(0.1 * FINE / SIGMA, -0.999)) / 0.1) ** 2),
    "tailed": np.exp(-0.5 * np.abs(FINE / SIGMA) ** 2.1) + 0.12 * np.exp(-0.5 * ((FINE - 5) / 2.5) ** 2),
    "leica": sum(w * np.exp(-0.5 * ((FINE - d) / s) ** 2) for w, d, s in ((1, 0, 1.5), (0.28, 4, 2), (0.42, -2.3, 1))),
}
"""Received pulses of a flat target, by time after about their peak [ns]; none is exactly a model's."""


def widen(pulse, factor):
    """The pulse of a target that widens a Gaussian of SIGMA by a factor, height 1."""
    if factor > 1:
        taps = np.exp(-0.5 * np.arange(-400, 401) ** 2 * 0.05**2 / (SIGMA**2 * (factor**2 - 1)))
        pulse = np.convolve(np.pad(pulse, 400), taps, "valid")
    return pulse / pulse.max()


@cache
def list_models(receiver):
    """Systems with every model of a pulse that a survey may choose and that fits it within .6 % of its height."""
    pulse = RECEIVERS[receiver]
    rng = np.random.default_rng(1)
    time, x = rng.uniform(40, 41, 400), np.arange(120.0)
    signal = 500 * np.interp(x - time[:, None], FINE, pulse) + rng.normal(0, 0.3, (400, 120))
    stack = stack_pulse(signal, np.full(400, 500.0), time, 12, 40)
    sums = [fit_gaussians(stack, SIGMA, most)[-1] for most in (2, 3, 4, 5)]
    left, right = lobe_edges(FINE, pulse, 0.5 * pulse.max())
    system = SystemPulse((right - left) / FWHM_PER_SIGMA, noise=ReceiverNoise(baseline=20.0, std=0.3))
    systems = [replace(system, components=tuple(map(tuple, fit.components))) for fit in sums if fit.rms < 0.006]
    skewed = fit_skewed(stack, SIGMA)
    if skewed.rms < 0.006:
        systems.append(replace(system, kappa=skewed.kappa, sigma_ref=float(skewed.components[0, 2])))
    return systems


@pytest.mark.parametrize("echoes", [100, 400])
def test_errors_of_a_stack_are_those_of_medians(rng, echoes):
    """Noise of 1 on echoes of 100, in bins of a quarter of a sample or so."""
    time = rng.uniform(40, 41, echoes)
    stack = stack_pulse(rng.standard_normal((echoes, 120)), np.full(echoes, 100.0), time, 12, 40)
    each = echoes * (12 + 40) / len(stack.value)
    assert np.median(stack.error) == pytest.approx(np.sqrt(np.pi / 2) * 0.01 / np.sqrt(each), rel=0.1)
    assert np.std(stack.value / stack.error) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("factor", [1.0, 1.5, 2.5])
@pytest.mark.parametrize("receiver", RECEIVERS)
def test_models_of_one_pulse_give_one_time_at_every_width(receiver, factor):
    """Peaks of 4 and 5 Gaussians were up to .25 ns apart (Leica); a target that widens an echo does not move it."""
    time = np.linspace(40, 41, 21)
    echo = widen(RECEIVERS[receiver], factor)
    counts = 20 + 300 * np.interp(np.arange(120.0) - time[:, None], FINE, echo)
    block = WaveformBlock.from_samples(np.rint(100 * counts).astype(np.uint16))
    truth = time + fit_one_gaussian(FINE, widen(RECEIVERS[receiver], 1.0))[0]
    systems = list_models(receiver)
    assert len(systems) >= 2
    amplitudes = []
    for system in systems:
        system = replace(system, noise=replace(system.noise, baseline=2000.0, std=30.0))
        noise = pooled(block, system)
        candidates = maximum(block, noise, system)
        stages = [adaptive(block, noise, system, candidates, max_echoes=1)]
        if factor == 1.0 and system.components:
            stages.append(reference(block, noise, system, candidates, model="stretched"))
        for echoes in stages:
            first = np.searchsorted(echoes.waveform, np.arange(len(time)))
            assert np.median(echoes.time[first] - truth) == pytest.approx(0.0, abs=0.02), (system, factor)
            amplitudes.append(np.median(echoes.amplitude[first]))
    assert np.ptp(amplitudes) < 0.01 * np.mean(amplitudes)
