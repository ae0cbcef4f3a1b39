"""Other pulse models: the tables of docs/algorithms.md 1.2 (T7), plain twins."""

import naive
import numpy as np
import pytest
from published import PULSE_SIGMA

from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse, fit_one_gaussian, tabulate_pulse
from wavebatch.stages.chain import STAGES, Step
from wavebatch.stages.decompose.models import echo_pulses, rebuild_waveforms
from wavebatch.stages.pulse_tables import ShapeLimits, model_parameters

FINE = 100.0
"""Counts per unit of amplitude."""


def record(y, spacing=1.0, std=1.0):
    """Waveforms (n, s) as a block of fine counts above 2000; the noise (in units of y) known."""
    block = WaveformBlock.from_samples(np.rint(2000 + FINE * y).astype(np.uint16), spacing=spacing)
    n = len(y)
    return block, Noise(np.full(n, 2000, np.float32), np.full(n, FINE * max(std, 0.01), np.float32))


def decompose(name, block, noise, system, **parameters):
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    return STAGES[f"decompose.{name}"].function(block, noise, system, candidates, **parameters)


def place_peaks(kappa, ref, echoes):
    """Times of the peaks of skewed echoes, whose times are those of their datum [samples]."""
    shape, limits = PulseShape(kappa=kappa), ShapeLimits(ref, 0.7 * ref, 4 * ref)
    whole = np.stack([echoes.amplitude, echoes.time, echoes.sigma], axis=1).astype(float)
    return model_parameters(shape, limits, whole)[:, 1]


def evaluate(shape, x, t, s):
    return [part[:, 0] for part in evaluate_pulse(shape, x[:, None].copy(), np.array([t]), np.array([s]))]


def test_tabulated_pulses_and_their_derivatives():
    samples = np.exp(-0.5 * ((np.arange(25) - 9.3) / 2) ** 2) + 0.2 * np.exp(-0.5 * ((np.arange(25) - 14) / 2) ** 2)
    table = tabulate_pulse(np.arange(25.0), samples)
    assert table.value.max() == pytest.approx(1, abs=1e-5)
    shape = PulseShape(table=table)
    x = np.arange(-20, 30, 0.21)
    pulse, by_time, by_width = evaluate(shape, x, 3.1, 2.6)
    above = x[pulse > 0.5]
    assert np.ptp(above) == pytest.approx(2.354820 * 2.6, abs=0.42)
    assert x[np.argmax(pulse)] == pytest.approx(3.1, abs=0.11)
    step = 0.05
    for k, (part, scale) in enumerate(((by_time, 2.6), (by_width, 2.6))):
        up, down = ([3.1, 2.6] + sign * step * np.eye(2)[k] for sign in (1, -1))
        slope = (evaluate(shape, x, *up)[0] - evaluate(shape, x, *down)[0]) / (2 * step)
        np.testing.assert_allclose(part, scale * slope, atol=2e-3)
    assert [part.item() for part in evaluate(shape, np.array([-1e4]), 3.0, 2.0)] == [0, 0, 0]


WANG = [(0.104, 0.0214, 0.0089, 0.0069), (0.184, 0.0158, 0.0100, 0.0037), (0, 0.0097, 0.0014, 0.0014)]
WANG += [(0.05, 0.0186, 0.0058, 0.0052)]


@pytest.mark.parametrize(("kappa", "noise_share", "gaussian", "log_normal"), WANG)
def test_goodness_of_fit_of_wang(kappa, noise_share, gaussian, log_normal):
    """T7: E = |f - y|^2 / |f|^2 of Gaussian and log-normal fits to 60 samples, FWHM 5 ns, within 10 %."""
    n, x, sigma = 400, np.arange(60.0), PULSE_SIGMA
    rng = np.random.default_rng(int(1e4 * noise_share))
    time = 30 + rng.uniform(-0.5, 0.5, n)
    std = 100 * noise_share
    y = np.stack([100 * naive.pulse(x, t, sigma, kappa) for t in time]) + std * rng.standard_normal((n, 60))
    block, noise = record(y, std=std)
    system = SystemPulse(sigma, kappa=kappa)
    for name, published in (("gaussian", gaussian), ("skewed", log_normal)):
        found = decompose(name, block, noise, system)
        alone = found.take(found.count(n)[found.waveform] == 1)
        assert len(alone) > 0.95 * n
        skew = kappa if name == "skewed" else 0
        ratios = []
        for echo in range(len(alone)):
            peak = place_peaks(skew, sigma, alone)[echo]
            f = alone.amplitude[echo] / FINE * naive.pulse(x, peak, alone.sigma[echo], skew)
            ratios.append(np.sum((f - y[alone.waveform[echo]]) ** 2) / np.sum(f**2))
        assert np.mean(ratios) == pytest.approx(published, rel=0.10), name


@pytest.mark.parametrize("model", ["broadened", "stretched", "given"])
def test_system_pulses_are_found_with_datum_peak_and_width(model):
    """A learned pulse with an after-pulse, fitted as what it is, convolved or stretched; one echo per waveform."""
    components = ((1.0, 0.0, 2.0), (0.12, 7.0, 2.0))
    x = np.arange(80.0)
    time = np.linspace(30, 31, 11)
    y = 200 * sum(w * np.exp(-0.5 * ((x - time[:, None] - d) / s) ** 2) for w, d, s in components)
    block, noise = record(y, std=0.3)
    shown = np.arange(-9, 18)
    pulse = " ".join(f"{sum(w * np.exp(-0.5 * ((v - d) / s) ** 2) for w, d, s in components):.6f}" for v in shown)
    found = decompose("reference", block, noise, SystemPulse(2.0, components=components), model=model, pulse=pulse)
    strong = found.take(found.amplitude > 100 * FINE)
    fine = np.arange(-15, 25, 0.01)
    whole = sum(w * np.exp(-0.5 * ((fine - d) / s) ** 2) for w, d, s in components)
    np.testing.assert_allclose(strong.time, time + fit_one_gaussian(fine, whole)[0], atol=0.002)
    np.testing.assert_allclose(strong.amplitude, 200 * FINE, rtol=0.01)
    np.testing.assert_allclose(strong.sigma, 2.0, rtol=0.02)
    if model == "broadened":
        assert found.count(len(time)).tolist() == [1] * len(time)


@pytest.mark.parametrize("power", [1.4, 2.0, 3.0])
def test_generalized_gaussians_fit_flat_and_peaked_echoes(power):
    x, time = np.arange(60.0), np.linspace(30, 31, 21)
    y = 200 * naive.power_pulse(x, time[:, None], 3.0, power)
    y = y + 0.5 * np.random.default_rng(1).standard_normal(y.shape)
    block, noise = record(y, std=0.5)
    system = SystemPulse(2.0)
    found = decompose("generalized_gaussian", block, noise, system)
    assert found.count(21).tolist() == [1] * 21
    np.testing.assert_allclose(found.time, time, atol=0.03)
    fwhm = 2 * (2 * np.log(2)) ** (1 / power) * 3.0
    np.testing.assert_allclose(2.354820 * found.sigma, fwhm, rtol=0.03)
    assert np.median(found.residual) < 1.3
    # Amplitude and width are correlated: their product is known better or worse than both.
    parts = [naive.power_pulse(x, 30.5, 3.0 + off, power) for off in (-0.01, 0.01)]
    slopes = np.stack([200 * np.gradient(sum(parts) / 2, x), sum(parts) / 2, 200 * (parts[1] - parts[0]) / 0.02])
    share = np.array([0.0, 1 / 200, 1 / 3.0])
    expected = 0.5 * np.sqrt(share @ np.linalg.inv(slopes @ slopes.T) @ share)
    assert np.median(found.relative_energy_err) == pytest.approx(expected, rel=0.02)
    drawn = rebuild_waveforms(block, system, Step(STAGES["decompose.generalized_gaussian"]), found)
    assert np.abs(drawn - (block.samples - 2000.0)).max() < 0.02 * 200 * FINE
    np.testing.assert_allclose(echo_pulses(PulseShape(), system, 1.0, found)(x), drawn, atol=1e-3 * FINE)
    if power != 2.0:
        assert np.median(decompose("gaussian", block, noise, system).residual) > 3


def test_skewed_echoes_are_drawn_where_they_were_fitted_on_a_strip_with_a_learned_pulse():
    """They were drawn by the width of the main component of the learned pulse, .05 samples off."""
    x, time, sigma = np.arange(64.0)[None, :], 30.3 + 0.1 * np.arange(20)[:, None], 2.1
    y = 100 * evaluate_pulse(PulseShape(kappa=0.2), np.repeat(x, 20, 0), time, np.full((20, 1), sigma))[0]
    block, noise = record(y, std=0.1)
    step = Step(STAGES["decompose.skewed"])
    for components in ((), ((1.0, 0.0, 1.6), (0.4, 2.5, 1.9))):
        system = SystemPulse(sigma, components=components, skew=0.2)
        found = decompose("skewed", block, noise, system)
        drawn = rebuild_waveforms(block, system, step, found)
        assert np.abs(drawn - (block.samples - 2000.0)).max() < 0.002 * 100 * FINE
